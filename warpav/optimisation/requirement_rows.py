"""Hard requirements as rows of the selection of a rig from a pool, and those that no camera of the pool can meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpav.core.errors import InputError
from warpav.optimisation.selection.problem import Row
from warpav.requirements.requirement import Ghosts
from warpav.requirements.visibility import Visibility


@dataclass(frozen=True, eq=False)
class RequirementRows:
    """The rows that a rig must satisfy.

    Attributes:
        rows: For `warpav.optimisation.selection.select`, named after requirement and point.
        ghost: The point that each comes from, int [row].
        requirement: Its requirement, int [row].
    """

    rows: tuple[Row, ...]
    ghost: np.ndarray
    requirement: np.ndarray


@dataclass(frozen=True)
class Unmeetable:
    """A requirement with points that the cameras of a pool cannot meet.

    Attributes:
        requirement: Its name.
        points: Number of such points.
        position_m: The one furthest from being met, in the ego frame [m].
        cameras_needed: Cameras that have to see the test object there.
        cameras_found: Cameras of the pool that do.
        nearest: The camera of the pool that comes closest without meeting it; None where all that see it meet it.
        visible_share: What that camera sees of it, 0..1.
        pixels: Likewise [px^2].
    """

    requirement: str
    points: int
    position_m: tuple[float, float]
    cameras_needed: int
    cameras_found: int
    nearest: int | None
    visible_share: float
    pixels: float

    def __str__(self) -> str:
        """One line: what cannot be met, where, and what comes closest."""
        x, y = self.position_m
        text = (
            f"requirement {self.requirement}: {self.points} point{'s' if self.points > 1 else ''} that the pool cannot "
            f"meet, such as ({x:.2f}, {y:.2f}) m, which needs {self.cameras_needed} camera"
            f"{'s' if self.cameras_needed > 1 else ''} and has {self.cameras_found}"
        )
        if self.nearest is None:
            return f"{text}; no other camera sees anything there"
        return f"{text}; camera {self.nearest} comes closest with {self.visible_share:.0%} and {self.pixels:.0f} px"


def requirement_rows(meets: np.ndarray, ghosts: Ghosts) -> RequirementRows:
    """The hard requirements as rows ``sum of meets over a rig's cameras >= cameras``.

    A row that follows from another is left out: one that the same cameras, or more of them, satisfy, with as few or
    fewer cameras needed.

    Args:
        meets: Whether each camera of the pool sees enough of each test object, bool [camera, ghost].
        ghosts: The test objects.
    """
    ghost = np.flatnonzero(ghosts.is_hard)
    needed = ghosts.of_each("cameras")[ghost]
    pattern, first = np.unique(np.c_[meets[:, ghost].T, needed], axis=0, return_index=True)
    order = np.argsort(first)
    ghost, pattern, needed = ghost[first[order]], pattern[order][:, :-1].astype(np.float32), pattern[order][:, -1]
    common = pattern @ pattern.T  # exact: counts of cameras
    own = common.diagonal()
    # [i, j]: row j has no camera that row i lacks, and asks for as many at least, so i follows from j
    follows = (common == own[None, :]) & (needed[None, :] >= needed[:, None])
    np.fill_diagonal(follows, False)
    kept = ~follows.any(axis=1)
    ghost, pattern, needed = ghost[kept], pattern[kept], needed[kept]
    rows = tuple(
        Row(_row_name(ghosts, g), coefficient.astype(np.float64), low=float(low))
        for g, coefficient, low in zip(ghost, pattern, needed, strict=True)
    )
    return RequirementRows(rows, ghost, ghosts.requirement[ghost])


def unmeetable_requirements(visibility: Visibility, ghosts: Ghosts) -> list[Unmeetable]:
    """The hard requirements that a pool cannot meet, each with the camera that comes closest.

    Only single points are looked at: that a rig of few cameras meets all of them at once is for the selection to find.

    Args:
        visibility: What each camera of the pool sees of each test object.
        ghosts: The test objects.
    """
    meets = visibility.meets(ghosts)
    found, needed = meets.sum(axis=0), ghosts.of_each("cameras")
    is_short = ghosts.is_hard & (found < needed)
    closeness = np.where(meets, 0.0, visibility.closeness(ghosts))
    result = []
    for r in np.unique(ghosts.requirement[is_short]):
        points = np.flatnonzero(is_short & (ghosts.requirement == r))
        worst = points[np.lexsort((closeness[:, points].max(axis=0), (found / needed)[points]))[0]]
        nearest = int(np.argmax(closeness[:, worst]))
        is_other = bool(visibility.visible_share[nearest, worst] > 0.0) and not meets[nearest, worst]
        x, y = ghosts.position_m[worst].tolist()
        result.append(
            Unmeetable(
                ghosts.requirements[r].name,
                len(points),
                (x, y),
                int(needed[worst]),
                int(found[worst]),
                nearest if is_other else None,
                float(visibility.visible_share[nearest, worst]) if is_other else 0.0,
                float(visibility.pixels[nearest, worst]) if is_other else 0.0,
            )
        )
    return result


def require_meetable(visibility: Visibility, ghosts: Ghosts, *, count: int | None = None) -> None:
    """Make sure that a pool can meet every point of the hard requirements.

    Args:
        visibility: As for `unmeetable_requirements`.
        ghosts: The test objects.
        count: Cameras of a rig; None: any number.

    Raises:
        InputError: It names each requirement that the pool, or so few cameras, cannot meet, one a line.
    """
    lines = [
        f"requirement {each.name}: cameras: expected at most {count}, the cameras of the rig, got {each.cameras}; "
        "lower it or allow more cameras"
        for each in ghosts.requirements
        if count is not None and each.is_hard and each.cameras > count
    ]
    lines += map(str, unmeetable_requirements(visibility, ghosts))
    if lines:
        raise InputError(*lines)


def _row_name(ghosts: Ghosts, ghost: int) -> str:
    x, y = ghosts.position_m[ghost]
    return f"requirement {ghosts.requirements[ghosts.requirement[ghost]].name} at ({x:.2f}, {y:.2f}) m"
