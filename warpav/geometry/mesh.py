"""Triangle meshes with one colour per vertex."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpav.errors import InputError


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh on the host.

    Attributes:
        vertex_m: Vertex positions [m], float32, shape [vertex, 3], in the frame that the owner states.
        triangle: Vertex indices, int32, shape [triangle, 3], counter-clockwise seen from outside.
        vertex_rgb: sRGB colour per vertex, uint8, shape [vertex, 3].
    """

    vertex_m: np.ndarray
    triangle: np.ndarray
    vertex_rgb: np.ndarray

    @classmethod
    def create(cls, vertex_m: object, triangle: object, vertex_rgb: object, *, name: str = "mesh") -> Mesh:
        """Mesh from anything array-like, checked.

        Args:
            vertex_m: Positions [m], shape [vertex, 3], finite.
            triangle: Vertex indices, shape [triangle, 3].
            vertex_rgb: Colours 0..255, shape [vertex, 3] or [3] for one colour everywhere.
            name: What the mesh is called in messages.

        Returns:
            The mesh, with arrays of the documented types.

        Raises:
            InputError: No triangles, non-finite positions, an index out of range, or shapes that do not fit.
        """
        vertex = np.ascontiguousarray(vertex_m, dtype=np.float32)
        index = np.ascontiguousarray(triangle, dtype=np.int32)
        if vertex.ndim != 2 or vertex.shape[1] != 3:
            raise InputError(f"{name}: expected vertices of shape [n, 3], got {list(vertex.shape)}")
        if index.ndim != 2 or index.shape[1:] != (3,) or len(index) == 0:
            raise InputError(f"{name}: expected at least one triangle of three indices, got {list(index.shape)}")
        bad = np.count_nonzero(~np.isfinite(vertex).all(axis=1))
        if bad:
            raise InputError(f"{name}: {bad} of {len(vertex)} vertices are NaN or infinite; repair the mesh first")
        if index.min() < 0 or index.max() >= len(vertex):
            raise InputError(f"{name}: triangle indices must be 0..{len(vertex) - 1}, got {index.min()}..{index.max()}")
        colour = np.broadcast_to(np.asarray(vertex_rgb, dtype=np.uint8), vertex.shape)
        return cls(vertex, index, np.ascontiguousarray(colour))

    def transformed(self, rotation: np.ndarray, translation_m: np.ndarray) -> Mesh:
        """The mesh with every vertex v mapped to ``rotation @ v + translation_m``; [3, 3] and [3]."""
        moved = self.vertex_m.astype(np.float64) @ np.asarray(rotation, np.float64).T + np.asarray(translation_m)
        return Mesh(np.ascontiguousarray(moved, dtype=np.float32), self.triangle, self.vertex_rgb)

    def bounds_m(self) -> np.ndarray:
        """Lowest and highest corner [m], shape [2, 3]."""
        return np.stack([self.vertex_m.min(axis=0), self.vertex_m.max(axis=0)])


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh that holds all triangles of ``meshes`` in order; needs at least one mesh."""
    first = np.cumsum([0, *(len(mesh.vertex_m) for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertex_m for mesh in meshes]),
        np.concatenate([mesh.triangle + np.int32(offset) for mesh, offset in zip(meshes, first, strict=False)]),
        np.concatenate([mesh.vertex_rgb for mesh in meshes]),
    )
