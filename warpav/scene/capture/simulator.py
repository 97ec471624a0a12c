"""What warpav asks of a traffic simulator, and how a situation is set up and recorded with one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

import numpy as np

from warpav.scene.capture.capture import CapturedImage, CapturedVehicle, CaptureView
from warpav.scene.scene import Box


@dataclass(frozen=True, eq=False)
class SpawnPoint:
    """A place in line with a lane or a bay where a vehicle may be put.

    Attributes:
        position_m: On the ground, in the ego frame [m], shape [3].
        yaw_rad: Heading [rad].
    """

    position_m: np.ndarray
    yaw_rad: float


class Simulator(Protocol):
    """A simulator in which the world stands still; a context manager that leaves nothing behind.

    All poses and boxes are in the ego frame of the situation that was begun last.

    Attributes:
        name: Short name of that situation, such as ``town_0007``; letters, digits, ``_`` and ``-``.
        source: Where it comes from, such as ``town seed 7``.
        world: What its worlds are made with, as far as this side knows: captures of another one are made anew.
    """

    name: str
    source: str
    world: str

    def begin(self, seed: int) -> Box:
        """Begin a situation: the ego vehicle alone, in clear weather, the sun overhead, no vegetation.

        Args:
            seed: Chooses the place; any integer from 0, the same one gives the same situation.

        Returns:
            The ego vehicle's 3D box.
        """
        ...

    def spawn_points(self, radius_m: float) -> Sequence[SpawnPoint]:
        """Places for other vehicles within a radius of the ego vehicle, in an order that the seed chooses."""
        ...

    def spawn(self, point: SpawnPoint) -> CapturedVehicle | None:
        """Put a randomly chosen and coloured vehicle there; None where the simulator refuses, as when it is taken."""
        ...

    def remove(self, vehicle: CapturedVehicle) -> None:
        """Take a vehicle out again."""
        ...

    def look(self, view: CaptureView) -> CapturedImage:
        """Take the three images of a view."""
        ...

    def __enter__(self) -> Self:
        """The simulator itself."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        """Destroy every actor that this simulator made and restore what it changed, whatever has happened."""
        ...
