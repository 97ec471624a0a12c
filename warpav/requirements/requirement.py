"""Requirements: an area on the ground, what stands there, and how well how many cameras have to see it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh
from warpav.requirements.area import Area, Body, grid_m
from warpav.requirements.test_object import TestObject

MAX_GHOSTS = 100_000
"""Points of all requirements together."""


@dataclass(frozen=True)
class Requirement:
    """What has to be seen on a part of the ground.

    Attributes:
        pixels: Area that is seen of it in the image at least [px^2].
    """

    name: str
    area: Area
    grid_m: float
    test_object: TestObject
    visible_share: float = 0.5
    pixels: float = 0.0
    cameras: int = 1
    sector_rad: tuple[float, float] | None = None
    weight: float | None = None
    share: float | None = 1.0

    @property
    def is_hard(self) -> bool:
        """Whether every point has to be met."""
        return self.weight is None

    def need(self) -> str:
        """What is needed, in words."""
        seen = f"{100.0 * self.visible_share:g} %"
        if self.pixels > 0.0:
            seen += f" and {self.pixels:g} px"
        kind = self.test_object.kind
        article = "an" if kind[:1].lower() in set("aeiou") else "a"
        text = f"{seen} of {article} {kind} by {self.cameras} camera{'s' if self.cameras > 1 else ''}"
        return text if self.share in (None, 1.0) else f"{text}, at {100.0 * self.share:g} % of the points"

    def points_m(self, body: Body) -> np.ndarray:
        """Where the test object is put [m], [point, 2]: only where it does not reach under the body."""
        point_m = grid_m(self.area, body, self.grid_m)
        inside = "the area"
        if self.sector_rad is not None:
            start, end = self.sector_rad
            turn = np.arctan2(*(point_m - body.centre_m).T[::-1])
            point_m = point_m[(turn - start + 1e-9) % (2.0 * math.pi) <= (end - start) % (2.0 * math.pi) + 2e-9]
            inside = "the area's part in the sector"
        if len(point_m):
            point_m = point_m[(body.distance_m(point_m[:, None] + self.test_object.footprint_m) > 0.0).all(axis=1)]
        if not len(point_m):
            raise InputError(
                f"requirement {self.name}: expected at least one point of {inside} outside of the body, got none with "
                f"a grid of {self.grid_m:g} m; enlarge the area or refine the grid"
            )
        return point_m


@dataclass(frozen=True, eq=False)
class Ghosts:
    """The test objects of some requirements, each at one point.

    Attributes:
        position_m: Where each stands, float64 [ghost, 2].
    """

    requirements: tuple[Requirement, ...]
    position_m: np.ndarray
    requirement: np.ndarray

    @classmethod
    def of(cls, requirements: Sequence[Requirement], ego: Mesh) -> Ghosts:
        """The test objects around a vehicle."""
        if not requirements:
            raise InputError("requirements: expected at least one, got none")
        body = Body.of(ego)
        points = [each.points_m(body) for each in requirements]
        count = sum(map(len, points))
        if count > MAX_GHOSTS:
            raise InputError(
                f"requirements: expected at most {MAX_GHOSTS} points together, got {count}; choose wider grids"
            )
        which = np.repeat(np.arange(len(points)), [len(each) for each in points])
        return cls(tuple(requirements), np.concatenate(points), which)

    def __len__(self) -> int:
        return len(self.position_m)

    def of_each(self, name: str) -> np.ndarray:
        """A number of every ghost's requirement, such as ``visible_share``, [ghost]."""
        return np.array([getattr(each, name) for each in self.requirements])[self.requirement]

    @cached_property
    def is_hard(self) -> np.ndarray:
        """Whether its requirement is hard, bool [ghost]."""
        return self.of_each("is_hard")

    def at(self, which: np.ndarray) -> Ghosts:
        """Some of them, int [ghost]."""
        return Ghosts(self.requirements, self.position_m[which], self.requirement[which])

    def mesh(self, ghost: int) -> Mesh:
        """The test object where it stands, in the ego frame."""
        body = self.requirements[self.requirement[ghost]].test_object.body
        return body.transformed(np.eye(3), np.append(self.position_m[ghost], 0.0))
