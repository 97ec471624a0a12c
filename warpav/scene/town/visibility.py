"""Which part of a road user can be seen from a point, by rays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpav.raster.mesh import Mesh, merge

_SAMPLES = 200  # rays to a mesh


class Sight:
    """Everything that can hide something, ready for rays."""

    def __init__(self, blockers: Sequence[Mesh], targets: Sequence[Mesh]) -> None:
        """Everything, in one frame."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        meshes = [*blockers, *targets]
        whole = merge(meshes)
        self._owner = np.repeat(np.arange(len(meshes)), [len(mesh.triangle) for mesh in meshes])
        self._first = len(blockers)
        self._targets = targets
        self._caster = EmbreeScene()
        TriangleMesh(self._caster, whole.vertex_m, whole.triangle)

    def shares(self, eye_m: np.ndarray, samples: int = _SAMPLES) -> np.ndarray:
        """Share of each target's triangles whose middle can be seen from a point, 0..1, shape [target].

        Shapes: ``eye_m`` [3].
        """
        return self._shares(eye_m, [self._points(mesh, samples) for mesh in self._targets], range(len(self._targets)))

    def seen_from_any(self, eye_m: np.ndarray, samples: int) -> np.ndarray:
        """Which targets have a triangle that can be seen from any of some points [m], [eye, 3]; bool [target]."""
        point = [self._points(mesh, samples) for mesh in self._targets]
        is_seen = np.zeros(len(point), bool)
        for each in eye_m:
            waiting = np.flatnonzero(~is_seen)
            is_seen[waiting] = self._shares(each, [point[k] for k in waiting], waiting) > 0.0
        return is_seen

    @staticmethod
    def _points(mesh: Mesh, samples: int) -> np.ndarray:
        # Centres of triangles: a ray to a vertex may miss the surface by a rounding error.
        return mesh.vertex_m[mesh.triangle[:: max(1, len(mesh.triangle) // samples)]].mean(axis=1)

    def _shares(self, eye_m: np.ndarray, point: list[np.ndarray], target: Sequence[int] | np.ndarray) -> np.ndarray:
        if not point:
            return np.zeros(0)
        count = np.array([len(each) for each in point])
        direction = np.ascontiguousarray((np.concatenate(point) - eye_m).astype(np.float32))
        origin = np.ascontiguousarray(np.broadcast_to(eye_m.astype(np.float32), direction.shape))
        hit = self._caster.run(origin, direction, query="INTERSECT")
        row = np.repeat(np.arange(len(count)), count)
        is_seen = (hit >= 0) & (self._owner[np.maximum(hit, 0)] == self._first + np.asarray(target)[row])
        return np.bincount(row, is_seen, minlength=len(count)) / count


def visible_shares(eye_m: np.ndarray, blockers: Sequence[Mesh], vehicles: Sequence[Mesh]) -> np.ndarray:
    """Share of each vehicle's triangles that can be seen from a point, 0..1, shape [vehicle].

    Shapes: ``eye_m`` [3].
    """
    return Sight(blockers, vehicles).shares(eye_m)
