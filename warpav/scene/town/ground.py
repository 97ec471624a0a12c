"""The height of a street: level around the ego vehicle, then up or down a steady grade in either direction."""

from __future__ import annotations

import numpy as np

KNOT_SPACING_M = 2.0
"""The surface is made of planes between multiples of this x; whatever is split there lies on it exactly."""
_LEVEL_REACH_M = 4.5  # the ego vehicle stands on level ground
_CURVE_LENGTH_M = 20.0  # in which the road bends from level to its grade
_REACH_M = 96.0
_FLAT_M = 1e-9  # second differences of the height below this are rounding errors


class StreetGround:
    """Height of the ground as a function of x in the town frame; it does not depend on y."""

    def __init__(
        self,
        centre_x_m: float = 0.0,
        ahead: float = 0.0,
        behind: float = 0.0,
        *,
        curve_m: float = _CURVE_LENGTH_M,
        reach_m: float = _REACH_M,
        only_bends: bool = False,
    ) -> None:
        """StreetGround through height 0."""
        self.is_level = ahead == 0.0 and behind == 0.0
        self._knot = np.arange(-reach_m, reach_m + 0.5 * KNOT_SPACING_M, KNOT_SPACING_M)
        beyond = np.maximum(np.abs(self._knot - centre_x_m) - _LEVEL_REACH_M, 0.0)
        bent = np.minimum(beyond, curve_m)
        risen = bent**2 / (2.0 * curve_m) + beyond - bent
        self._height = np.where(self._knot > centre_x_m, ahead, -behind) * risen
        self._named = self._knot
        if only_bends:
            self._named = self._knot[1:-1][np.abs(np.diff(self._height, 2)) > _FLAT_M]

    def height_m(self, x_m: np.ndarray | float) -> np.ndarray:
        """Height [m] at x [m], any shape."""
        return np.asarray(np.interp(x_m, self._knot, self._height))

    def knots_m(self, low_m: float, high_m: float) -> np.ndarray:
        """Where the surface bends between two x [m]; none on level ground."""
        if self.is_level:
            return np.empty(0)
        return self._named[(self._named > low_m + 1e-6) & (self._named < high_m - 1e-6)]

    def bulge_m(self, low_m: float, high_m: float) -> float:
        """How far the ground rises above the straight line between two x [m]; at least 0."""
        x = np.linspace(low_m, high_m, 9)
        height = self.height_m(x)
        return float(max(0.0, np.max(height - np.interp(x, x[[0, -1]], height[[0, -1]]))))

    def stand(self, x_m: float, y_m: float, yaw_rad: float, size_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How a vehicle stands: the plane through the ground below its wheels.

        Shapes: ``size_m`` [3], returns [3, 3].
        """
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        if self.is_level:
            return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([x_m, y_m, 0.0])
        wheel_x, wheel_y = 0.3 * size_m[0], 0.4 * size_m[1]
        front, rear = self.height_m(x_m + wheel_x * c), self.height_m(x_m - wheel_x * c)
        left, right = self.height_m(x_m - wheel_y * s), self.height_m(x_m + wheel_y * s)
        forward = np.array([c, s, (front - rear) / (2.0 * wheel_x)])
        forward /= np.linalg.norm(forward)
        up = np.cross(forward, np.array([-s, c, (left - right) / (2.0 * wheel_y)]))
        up /= np.linalg.norm(up)
        rotation = np.stack([forward, np.cross(up, forward), up], axis=1)
        return rotation, np.array([x_m, y_m, 0.25 * (front + rear + left + right)])
