"""The beams of a LiDAR as a density on its panorama: expected points on an object are its weighted area.

A scan takes one beam after the other; what counts for placement is how many of them fall on an object. With beams
spread evenly inside their cells, that is the integral of their density over what of the object is visible: a weighted
silhouette area, whose derivative to the pose follows from the boundary as that of any area does. It is the mean over
half a beam's distance of pitch, and over all phases of the azimuth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

PIXELS_PER_RAD = 2048 / (2.0 * math.pi)
"""Of panoramas, in both directions: two pixels and more on a pedestrian 50 m away."""

_MOST_BEAMS, _MOST_RATE_HZ, _LEAST_SHOTS = 4096, 1000.0, 100
_CELL_RAD = math.radians(1.0)  # of patterns: finer cells would hold too few shots


@dataclass(frozen=True)
class Radar:
    """When a radar finds a road user, judged by geometry alone: no wave, echo or clutter is modelled.

    Attributes:
        range_m: How far a vehicle, a pedestrian and a cyclist are found [m], positive.
        cell_m: Distance in range within which two in one cell of azimuth (``step_rad`` of the beams) merge [m],
            positive; of what merges the one that shows most is found.
        visible_share: Share of the solid angle of a road user's box that must be visible within the field of view for
            half of ``probability``, above 0, below 1.
        probability: To find one that is within range and clearly visible, above 0, at most 1.
    """

    range_m: tuple[float, float, float]
    cell_m: float
    visible_share: float = 0.2
    probability: float = 0.95

    def __post_init__(self) -> None:
        if len(self.range_m) != 3 or not all(0.0 < each < math.inf for each in self.range_m):
            raise ValueError(f"range_m: expected a positive distance for each road user, got {self.range_m}")
        if not 0.0 < self.cell_m < math.inf:
            raise ValueError(f"cell_m: expected a positive distance, got {self.cell_m:g}")
        if not 0.0 < self.visible_share < 1.0:
            raise ValueError(f"visible_share: expected a share between 0 and 1, got {self.visible_share:g}")
        if not 0.0 < self.probability <= 1.0:
            raise ValueError(f"probability: expected more than 0, at most 1, got {self.probability:g}")


@dataclass(frozen=True)
class Beams:
    """The directions in which a LiDAR measures, or a radar, in axes x forward, y left, z up.

    Angles are rounded to microdegrees, as files write them.

    Attributes:
        elevation_rad: Of each beam from the horizontal, upwards [rad], ascending, at least 2; of a scanner that repeats
            no line the middles of the rows of ``weight``.
        step_rad: Azimuth from one shot of a beam to the next [rad], positive.
        azimuth_rad: First and last azimuth [rad], to the left positive, within -pi..pi; both: all round.
        range_m: How far a target of 10 % and one of 80 % reflectivity is measured [m], positive, ascending.
        weight: Shots over those that ``step_rad`` gives, of each beam in equal parts of the sector from its left end,
            at least 0, [beam][part]; None: all 1. What a pattern leaves out or shoots more often, see `of_pattern`.
        rate_hz: Scans a second, up to 1000.
        radar: Of a radar, see `of_radar`; None: a LiDAR.

    Raises:
        ValueError: A number out of its range.
    """

    elevation_rad: tuple[float, ...]
    step_rad: float
    azimuth_rad: tuple[float, float] = (-math.pi, math.pi)
    range_m: tuple[float, float] = (100.0, 200.0)
    weight: tuple[tuple[float, ...], ...] | None = None
    rate_hz: float = 10.0
    radar: Radar | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "elevation_rad", tuple(map(_rounded, self.elevation_rad)))
        object.__setattr__(self, "azimuth_rad", tuple(map(_rounded, self.azimuth_rad)))
        object.__setattr__(self, "step_rad", _rounded(self.step_rad))
        up = np.array(self.elevation_rad, np.float64)
        if not 2 <= len(up) <= _MOST_BEAMS or not np.isfinite(up).all() or not (np.diff(up) > 0.0).all():
            raise ValueError(f"elevation_rad: expected 2 to {_MOST_BEAMS} ascending angles, got {_few(up)}")
        if not (up[0] > -0.5 * math.pi and up[-1] < 0.5 * math.pi):
            raise ValueError(f"elevation_rad: expected angles between the poles, got {_few(up)}")
        first, last = self.azimuth_rad
        if not -math.pi <= first < last <= math.pi:
            raise ValueError(f"azimuth_rad: expected ascending angles within -pi..pi, got {self.azimuth_rad}")
        if not 0.0 < self.step_rad <= last - first:
            raise ValueError(f"step_rad: expected a positive angle within the sector, got {self.step_rad}")
        if not 0.0 < self.range_m[0] <= self.range_m[1] < math.inf:
            raise ValueError(f"range_m: expected positive, ascending distances, got {self.range_m}")
        if not 0.0 < self.rate_hz <= _MOST_RATE_HZ:
            raise ValueError(f"rate_hz: expected more than 0 and up to {_MOST_RATE_HZ:g}, got {self.rate_hz:g}")
        weight = self._cells
        if (
            len(weight) != len(up)
            or weight.shape[1] < 1
            or not (weight >= 0.0).all()
            or not 0.0 < weight.sum() < math.inf
        ):
            raise ValueError(f"weight: expected numbers from 0 on for each of {len(up)} beams, got {_few(weight)}")

    @classmethod
    def of_pattern(
        cls, direction_rad: np.ndarray, range_m: tuple[float, float] = (100.0, 200.0), rate_hz: float = 10.0
    ) -> Beams:
        """The beams of a scanner that repeats no line, from the directions of one scan.

        Args:
            direction_rad: Azimuth, to the left positive, and elevation of every shot [rad], [shot, 2], at least 100.
            range_m: As of `Beams`.
            rate_hz: As of `Beams`.

        Raises:
            ValueError: Too few shots, or directions that are not finite or beyond a pole.
        """
        shot = np.asarray(direction_rad, np.float64)
        if shot.ndim != 2 or shot.shape[1] != 2 or len(shot) < _LEAST_SHOTS or not np.isfinite(shot).all():
            raise ValueError(
                f"pattern: expected azimuth and elevation of at least {_LEAST_SHOTS} shots, got {len(shot)}"
            )
        (right, low), (left, high) = shot.min(axis=0), shot.max(axis=0)
        parts = [max(2, math.ceil((end - first) / _CELL_RAD)) for first, end in ((low, high), (right, left))]
        count, up, _ = np.histogram2d(shot[:, 1], shot[:, 0], bins=parts)
        middle = 0.5 * (up[1:] + up[:-1])
        step_rad = (left - right) / max(len(shot) / parts[0], 1.0)
        weight = count[:, ::-1] * parts[0] * parts[1] / len(shot)
        return cls(
            tuple(middle.tolist()),
            min(step_rad, left - right),
            (right, left),
            range_m,
            tuple(tuple(row) for row in weight.tolist()),
            rate_hz,
        )

    @classmethod
    def of_radar(
        cls,
        radar: Radar,
        azimuth_rad: tuple[float, float],
        elevation_rad: tuple[float, float],
        cell_rad: float,
        rate_hz: float = 15.0,
    ) -> Beams:
        """A radar's field of view between two azimuths and two elevations [rad]; ``cell_rad``: its cell of azimuth."""
        low, high = elevation_rad
        quarter, most_m = 0.25 * (high - low), max(radar.range_m)
        return cls((low + quarter, high - quarter), cell_rad, azimuth_rad, (most_m, most_m), None, rate_hz, radar)

    @property
    def kind(self) -> str:
        return "lidar" if self.radar is None else "radar"

    @property
    def _cells(self) -> np.ndarray:
        return np.ones((len(self.elevation_rad), 1)) if self.weight is None else np.array(self.weight, np.float64)

    @property
    def count(self) -> int:
        """Beams in one scan."""
        return round(float(self._cells.mean(axis=1).sum()) * self.sector_rad / self.step_rad)

    @property
    def sector_rad(self) -> float:
        """Width of the sector in azimuth [rad]."""
        return self.azimuth_rad[1] - self.azimuth_rad[0]

    @property
    def is_all_round(self) -> bool:
        return self.sector_rad >= 2.0 * math.pi - 1e-6

    @property
    def ends_rad(self) -> np.ndarray:
        """Ends of the beams' cells in elevation [rad], float64 [beam + 1]: midway to the next beam."""
        up = np.array(self.elevation_rad)
        middle = 0.5 * (up[1:] + up[:-1])
        ends = np.concatenate([[2.0 * up[0] - middle[0]], middle, [2.0 * up[-1] - middle[-1]]])
        return np.clip(ends, -0.5 * math.pi + 1e-6, 0.5 * math.pi - 1e-6)

    @property
    def panorama(self) -> tuple[int, int, tuple[float, float], tuple[float, float]]:
        """Width and height, focal lengths and principal point of the equirectangular image of all beams [px]."""
        low, high = self.ends_rad[[0, -1]]
        width = max(round(self.sector_rad * PIXELS_PER_RAD), 8)
        focal = width / self.sector_rad
        height = max(math.ceil((high - low) * focal), 8)
        return width, height, (focal, focal), (self.azimuth_rad[1] * focal, high * focal)

    def shots(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Directions of one scan, unit vectors float64 [shot, 3], and row and column of their pixels, int [shot].

        Parts of ``weight`` that are empty are left out.
        """
        width, height, (fx, fy), (cx, cy) = self.panorama
        count = max(round(self.sector_rad / self.step_rad), 1)
        azimuth = self.azimuth_rad[1] - (np.arange(count) + 0.5) * self.step_rad
        up, around = np.meshgrid(self.elevation_rad, azimuth, indexing="ij")
        cells = self._cells
        is_shot = cells[:, (np.arange(count) * cells.shape[1]) // count] > 0.0
        up, around = up[is_shot], around[is_shot]
        direction = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=1)
        row, column = (cy - up * fy).astype(int), (cx - around * fx).astype(int)
        return direction, np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)

    def density(self) -> np.ndarray:
        """Expected beams for each pixel of the panorama, of a radar its solid angle [sr], float32 [row, column]."""
        width, height, (fx, fy), (_, cy) = self.panorama
        edge_rad = (cy - np.arange(height + 1)) / fy
        if self.radar is not None:
            edge = np.sin(np.clip(edge_rad, *self.ends_rad[[0, -1]]))
            return np.repeat((edge[:-1, None] - edge[1:, None]) / fx, width, axis=1).astype(np.float32)
        cells = self._cells
        below = np.concatenate([np.zeros((1, cells.shape[1])), np.cumsum(cells, axis=0)])
        at_edge = np.stack([np.interp(edge_rad, self.ends_rad, part) for part in below.T], axis=1)
        part = (np.arange(width) * cells.shape[1]) // width
        return ((at_edge[:-1] - at_edge[1:])[:, part] / (self.step_rad * fx)).astype(np.float32)


def _rounded(angle_rad: float) -> float:
    return math.radians(round(math.degrees(angle_rad), 6))


def _few(values: ArrayLike) -> str:
    values = list(np.ravel(values))
    return ", ".join(f"{each:g}" for each in values[:4]) + (" ..." if len(values) > 4 else "")
