"""Requirements as one more scene of a search: its objects are the test objects, each a point that has to be seen.

So pool, selection, bound, prices and polish know nothing else of them. A point is "detected" the more surely the nearer
a camera comes to what its requirement asks for, and all but surely where a camera meets it; a rig misses it as it
misses a road user.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from warpav.core.cache import digest
from warpav.core.errors import InputError
from warpav.optimisation.selection._problem import Row
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import KeptRenderers
from warpav.raster.mesh import Mesh
from warpav.raster.pane import Pane
from warpav.sight import Ghosts, GhostWorld, Requirement, Visibility, VisibilityJacobian


def _requirement_rows(meets: np.ndarray, ghosts: Ghosts) -> tuple[list[Row], np.ndarray]:
    """The hard requirements as rows ``sum of meets over a rig's cameras >= cameras``, and the point of each, int [row].

    A row that follows from another is left out: one that the same cameras, or more of them, satisfy, with as few or
    fewer cameras needed. ``meets`` bool [camera, ghost].
    """
    ghost = np.flatnonzero(ghosts.is_hard)
    needed = ghosts.of_each("cameras")[ghost]
    pattern, first = np.unique(np.c_[meets[:, ghost].T, needed], axis=0, return_index=True)
    order = np.argsort(first)
    ghost, pattern, needed = ghost[first[order]], pattern[order][:, :-1].astype(np.float32), pattern[order][:, -1]
    common = pattern @ pattern.T  # exact: counts of cameras
    # [i, j]: row j has no camera that row i lacks, and asks for as many at least, so i follows from j
    follows = (common == common.diagonal()[None, :]) & (needed[None, :] >= needed[:, None])
    np.fill_diagonal(follows, False)
    kept = np.flatnonzero(~follows.any(axis=1))
    rows = []
    for k in kept:
        (x, y), of = ghosts.position_m[ghost[k]], ghosts.requirements[ghosts.requirement[ghost[k]]]
        rows.append(
            Row(f"requirement {of.name} at ({x:.2f}, {y:.2f}) m", pattern[k].astype(np.float64), low=float(needed[k]))
        )
    return rows, ghost[kept]


def _require_meetable(visibility: Visibility, ghosts: Ghosts, count: int) -> None:
    """Make sure that a pool can meet every point of the hard requirements, each with the camera that comes closest.

    Only single points are looked at: that a rig of few cameras meets all of them at once is for the selection to find.
    """
    lines = [
        f"requirement {each.name}: cameras: expected at most {count}, the cameras of the rig, got {each.cameras}; "
        "lower it or allow more cameras"
        for each in ghosts.requirements
        if each.is_hard and each.cameras > count
    ]
    meets = visibility.meets(ghosts)
    found, needed = meets.sum(axis=0), ghosts.of_each("cameras")
    is_short = ghosts.is_hard & (found < needed)
    closeness = np.where(meets, 0.0, visibility.closeness(ghosts))
    for r in np.unique(ghosts.requirement[is_short]):
        points = np.flatnonzero(is_short & (ghosts.requirement == r))
        worst = points[np.lexsort((closeness[:, points].max(axis=0), (found / needed)[points]))[0]]
        nearest = int(np.argmax(closeness[:, worst]))
        share, pixels = visibility.visible_share[nearest, worst], visibility.pixels[nearest, worst]
        x, y = ghosts.position_m[worst]
        closest = "no other camera sees anything there"
        if share > 0.0 and not meets[nearest, worst]:
            closest = f"camera {nearest} comes closest with {share:.0%} and {pixels:.0f} px"
        lines.append(
            f"requirement {ghosts.requirements[r].name}: {len(points)} point{'s' if len(points) > 1 else ''} that the "
            f"pool cannot meet, such as ({x:.2f}, {y:.2f}) m, which needs {needed[worst]} camera"
            f"{'s' if needed[worst] > 1 else ''} and has {found[worst]}; {closest}"
        )
    if lines:
        raise InputError(*lines)


MET = 0.999  # probability of a point that a camera meets
_NEARLY_MET = 0.9  # probability just before: two cameras that do not meet a point together stay below one that does
_HARD_WEIGHT = 0.1  # weight of a hard requirement: it leads the search to where it is met, and the rows keep it there
_NEAR_EDGE = 3.0  # margin from which on a hard point counts as met whatever a step does
_SEEN_KEPT = 2  # answers with Jacobians that are kept: of a pair's two sides


@dataclass(frozen=True, eq=False)
class _Seen:
    """What some cameras see."""

    visibility: Visibility  # of all points
    which: np.ndarray  # points with Jacobians, int [point]
    found: VisibilityJacobian | None  # theirs; None where there are none


class RequiredPoints:
    """The test objects of some requirements around a vehicle; it stands where a scene stands in a pool."""

    name = "requirements"

    def __init__(self, requirements: Sequence[Requirement], ego: Mesh, *, device: str = "cpu") -> None:
        self.requirements, self.ego, self.device = tuple(requirements), ego, device
        self.ghosts = Ghosts.of(self.requirements, ego)  # the test objects
        self._opened: dict[Pane, RequiredPoints] = {}
        self._renderers = KeptRenderers()
        self._seen: dict[tuple[bytes, tuple[CameraModel, ...]], _Seen] = {}

    def __getstate__(self) -> dict[str, Any]:
        """As it travels and is copied: without what is on a device."""
        kept = {name: value for name, value in self.__dict__.items() if name != "world"}
        return {**kept, "_opened": {}, "_renderers": KeptRenderers(), "_seen": {}}

    def through(self, pane: Pane | None) -> RequiredPoints:
        """The same as cameras behind a pane of the vehicle see it; None: behind none."""
        if pane is None:
            return self
        if pane not in self._opened:
            opened = self._opened[pane] = copy.copy(self)
            opened.ego, opened._renderers, opened._seen = pane.opened(self.ego), self._renderers, {}
        return self._opened[pane]

    @cached_property
    def world(self) -> GhostWorld:
        """The points on the device."""
        return GhostWorld(self.ghosts, self.ego, device=self.device, renderers=self._renderers)

    @property
    def vehicle_count(self) -> int:
        return len(self.ghosts)

    @cached_property
    def fingerprint(self) -> str:
        """Hash of all that what cameras see of them depends on."""
        ghosts, ego = self.ghosts, self.ego
        needs = [ghosts.of_each(name).tobytes() for name in ("visible_share", "pixels")]
        bodies = [each.test_object.body for each in self.requirements]
        parts = [part for body in bodies for part in (body.vertex_m.tobytes(), body.triangle.tobytes())]
        return digest(
            "requirements", ego.vertex_m.tobytes(), ego.triangle.tobytes(), ghosts.position_m.tobytes(),
            ghosts.requirement.tobytes(), *needs, *parts, MET, _NEARLY_MET,
        )  # fmt: skip

    @cached_property
    def weight(self) -> np.ndarray:
        """What missing each point costs, where missing all the traffic costs 1: an even share, float64 [point]."""
        of_each = np.array([_HARD_WEIGHT if each.weight is None else each.weight for each in self.requirements])
        counts = np.bincount(self.ghosts.requirement, minlength=len(of_each))
        return (of_each / np.maximum(counts, 1))[self.ghosts.requirement]

    def probability(self, ego_from_camera: np.ndarray, models: Sequence[CameraModel]) -> np.ndarray:
        """How surely cameras at ``ego_from_camera`` [camera, 4, 4] see each point, 0..1, float32 [camera, point]."""
        return self._probability(self.visibility(ego_from_camera, models))[0].astype(np.float32)

    def with_jacobian(
        self, ego_from_camera: np.ndarray, models: Sequence[CameraModel]
    ) -> tuple[np.ndarray, np.ndarray]:
        """The same, and the derivatives to every camera's centre [1/m], rotation about its axes [1/rad] and zoom.

        Returns float64 [camera, point] and [camera, point, 7]; where a point is met nothing makes it surer.
        """
        seen = self._differentiated(ego_from_camera, models)
        probability, by_share, by_pixels = self._probability(seen.visibility)
        jacobian = np.zeros((*probability.shape, 7))
        if seen.found is not None:
            jacobian[:, seen.which] = by_share[:, seen.which, None] * seen.found.jac_visible_share
            jacobian[:, seen.which] += by_pixels[:, seen.which, None] * seen.found.jac_pixels
        return probability, jacobian

    def margins(self, ego_from_camera: np.ndarray, models: Sequence[CameraModel]) -> tuple[np.ndarray, np.ndarray]:
        """The lesser of share and pixels at the hard points, over what is asked of one camera: 1 where one meets it.

        Returns float64 [camera, hard point], and the derivatives as of `with_jacobian`; these are 0 where a camera sees
        the whole object or nothing of it, and from `_NEAR_EDGE` on.
        """
        seen = self._differentiated(ego_from_camera, models)
        share, pixels = self._over_needs(seen.visibility)
        jacobian = np.zeros((*share.shape, 7))
        if seen.found is not None:
            ghosts = self.ghosts.at(seen.which)
            by_share = seen.found.jac_visible_share / ghosts.of_each("visible_share")[:, None]
            by_pixels = seen.found.jac_pixels / _needed_px(ghosts)[:, None]
            is_by_share = (share <= pixels)[:, seen.which, None]
            jacobian[:, seen.which] = np.where(is_by_share, by_share, by_pixels)
        return np.minimum(share, pixels)[:, self.is_hard], jacobian[:, self.is_hard]

    def _differentiated(self, ego_from_camera: np.ndarray, models: Sequence[CameraModel]) -> _Seen:
        """What cameras see of all points, with Jacobians where something depends on them; the last answers are kept."""
        key = (np.asarray(ego_from_camera, np.float64).tobytes(), tuple(models))
        if key not in self._seen:
            seen = self.visibility(ego_from_camera, models)
            _, by_share, by_pixels = self._probability(seen)
            share, pixels = self._over_needs(seen)
            margin = np.minimum(share, pixels)
            is_partial = (seen.visible_share > 0.0) & ((seen.visible_share < 1.0) | (pixels < share))
            is_near = self.is_hard & (margin >= 1.0) & (margin < _NEAR_EDGE) & is_partial
            # most points are met, or not seen at all
            is_steep = (seen.visible_share > 0.0) & ((by_share > 0.0) | (by_pixels > 0.0))
            which = np.flatnonzero((is_steep | is_near).any(axis=0))
            found = None
            if len(which):
                ghosts = self.ghosts.at(which)
                world = GhostWorld(ghosts, self.ego, device=self.device, renderers=self._renderers)
                found = world.jacobians(ego_from_camera, models)
            while len(self._seen) >= _SEEN_KEPT:
                del self._seen[next(iter(self._seen))]
            self._seen[key] = _Seen(seen, which, found)
        return self._seen[key]

    def _over_needs(self, seen: Visibility) -> tuple[np.ndarray, np.ndarray]:
        """Shares and pixels over what is asked of one camera, each [camera, point]."""
        return seen.visible_share / self.ghosts.of_each("visible_share"), seen.pixels / _needed_px(self.ghosts)

    def _probability(self, seen: Visibility) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Probabilities, and their derivatives to share and pixels, each [camera, point]."""
        need_share, need_px = self.ghosts.of_each("visible_share"), _needed_px(self.ghosts)
        share, pixels = self._over_needs(seen)
        is_met = seen.meets(self.ghosts)
        found = np.where(is_met, MET, _NEARLY_MET * np.minimum(np.minimum(share, pixels), 1.0))
        is_by_share = ~is_met & (share < 1.0) & (share <= pixels)
        is_by_pixels = ~is_met & (pixels < 1.0) & (pixels < share)
        by_share = np.where(is_by_share, _NEARLY_MET / need_share, 0.0)
        return found, by_share, np.where(is_by_pixels, _NEARLY_MET / need_px, 0.0)

    @property
    def is_hard(self) -> np.ndarray:
        """Which points have to be met, bool [point]."""
        return self.ghosts.is_hard

    def is_kept(self, probability: np.ndarray) -> bool:
        """Whether a rig whose cameras see the points so surely, [camera, point], meets all hard requirements."""
        found = self.meets(probability).sum(axis=0)
        return bool((found >= self.ghosts.of_each("cameras"))[self.is_hard].all())

    def rows(self, probability: np.ndarray) -> tuple[list[Row], np.ndarray]:
        """`_requirement_rows` of cameras that see the points so surely, [camera, point]."""
        if not self.is_hard.any():
            return [], np.zeros(0, int)
        return _requirement_rows(self.meets(probability), self.ghosts)

    @staticmethod
    def meets(probability: np.ndarray) -> np.ndarray:
        """Whether cameras meet points that they see so surely, bool, in the shape of the probabilities."""
        return np.asarray(probability) >= MET - 1e-4

    def visibility(self, ego_from_camera: np.ndarray, models: Sequence[CameraModel]) -> Visibility:
        """What each camera sees of each point; arguments as of `probability`."""
        return self.world.visibility(ego_from_camera, models)

    def check(self, probability: np.ndarray, seen: Callable[[], Visibility], count: int) -> None:
        """Make sure that a pool of cameras can meet every hard point. ``probability`` [camera, point]."""
        needed = self.ghosts.of_each("cameras")
        if not self.is_kept(probability) or (self.is_hard & (needed > count)).any():
            _require_meetable(seen(), self.ghosts, count)


def _needed_px(ghosts: Ghosts) -> np.ndarray:
    """Pixels that are asked of one camera, above 0, [point]."""
    return np.maximum(ghosts.of_each("pixels"), 1e-9)
