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
    """A pose along a lane or in a parking bay where a vehicle may be spawned."""

    position_m: np.ndarray  # on the ground, in the ego frame [m], shape [3]
    yaw_rad: float  # heading [rad]


class Simulator(Protocol):
    """A simulator with a static world; a context manager that restores its state on exit.

    All poses and boxes are in the ego frame of the situation that was begun last.
    """

    name: str  # short name of that situation, such as ``town_0007``; letters, digits, ``_`` and ``-``
    source: str  # where it comes from, such as ``town seed 7``
    world: str  # fingerprint of its world: captures of another world are recorded again

    def begin(self, seed: int) -> Box:
        """Begin a situation: the ego vehicle alone, in clear weather, the sun overhead, no vegetation."""
        ...

    def spawn_points(self, radius_m: float) -> Sequence[SpawnPoint]:
        """Places for other vehicles within a radius of the ego vehicle, in an order that the seed chooses."""
        ...

    def spawn(self, point: SpawnPoint) -> CapturedVehicle | None:
        """Spawn a randomly chosen and coloured vehicle; None if the simulator rejects it, for example if occupied."""
        ...

    def remove(self, vehicle: CapturedVehicle) -> None:
        """Take a vehicle out again."""
        ...

    def capture(self, view: CaptureView) -> CapturedImage:
        """Take the three images of a view."""
        ...

    def __enter__(self) -> Self:
        """The simulator itself."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        """Destroy all actors of this simulator and restore everything it changed, even after an error."""
        ...
