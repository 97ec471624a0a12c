"""Coverage of the ground: where around the vehicle a person is seen, by how many cameras, and where by none."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from warpav.core.warp_setup import checked_device
from warpav.rig import Rig, RigCamera
from warpav.scene import DeviceScene, Scene
from warpav.sight._requirement import SECTORS, sectors_of
from warpav.sight._sight import sight
from warpav_kernels.raster import ground as kernels

HEIGHTS_M = (1.1, 1.7)
"""Top of a child's and of an adult's head above the ground [m]."""

PATCH_M = 0.05
"""Of a patch of the ground itself: so high above it that the ground does not hide it [m]."""

_RADIUS_M = 25.0
_CELL_M = 0.5
_STEP_M = 0.3  # surfaces up to this height above the lowest surface count as ground [m]: kerbs, but no walls or benches


DISTANCE_EDGES_M = (0.0, 5.0, 10.0, 15.0, 20.0, _RADIUS_M)
"""Bands of the distance from the centre of the ego vehicle [m]; a band includes its lower edge, the last one both."""


def coverage(
    rig: Rig,
    scene: Scene,
    *,
    heights_m: Sequence[float] = HEIGHTS_M,
    radius_m: float = _RADIUS_M,
    cell_m: float = _CELL_M,
    device: str = "cpu",
) -> Coverage:
    """Where around the vehicle the cameras of a rig see a person, with occlusion by everything in the scene.

    Args:
        rig: Cameras of any lens.
        scene: The street, the traffic, and the vehicle that carries the rig (`Scene.around` puts another there).
        heights_m: Heights of the persons above the ground [m], at least one, positive.
        radius_m: Radius around the ego vehicle's centre [m], positive.
        cell_m: Size of a ground cell [m], positive.
        device: Warp device.

    Raises:
        InputError: The device is not there.
        ValueError: A size or a height is not positive.
    """
    packed = DeviceScene.pack(scene, device=checked_device(device))
    return Ground.around(packed, radius_m=radius_m, cell_m=cell_m).coverage(rig.cameras, heights_m=heights_m)


_HIGHEST_M, _GRADE_MAX = 0.6, 0.08  # maximum height of the ground at the vehicle, and its increase per metre: slopes
_DEPTH_M = 30.0  # maximum depth of a downhill street
_ENVIRONMENT = 0


@dataclass(frozen=True)
class Ground:
    """Ground cells around the vehicle, and where a person can stand."""

    scene: DeviceScene
    x_m: np.ndarray
    y_m: np.ndarray
    # Height of the ground in the ego frame [m], float32 [row, column]; NaN where there is none and outside of the
    # circle
    ground_m: np.ndarray
    # Distance up to the next surface [m], float32 [row, column]; infinite under the open sky, 0 inside houses and
    # where a child cannot walk to from the vehicle, such as courtyards
    headroom_m: np.ndarray
    cell_m: float
    radius_m: float

    @classmethod
    def around(cls, scene: DeviceScene, *, radius_m: float = _RADIUS_M, cell_m: float = _CELL_M) -> Ground:
        """The ground around the ego vehicle of a scene."""
        if not (radius_m > 0.0 and cell_m > 0.0):
            raise ValueError(f"radius_m and cell_m must be positive, got {radius_m} and {cell_m}")
        raster = scene.raster  # held while kernels read it
        low_m, high_m = raster.layer_bounds_world_m.numpy()[raster.foreground_layer]
        centre_m = 0.5 * (low_m + high_m)[:2].astype(np.float64)
        steps = np.arange(-int(radius_m / cell_m), int(radius_m / cell_m) + 1)
        x_m, y_m = centre_m[0] + cell_m * steps, centre_m[1] + cell_m * steps
        position_m = np.stack(np.meshgrid(x_m, y_m, indexing="ij"), axis=-1)
        distance_m = np.linalg.norm(position_m - centre_m, axis=-1)
        device, count = raster.device, distance_m.size
        ground_m = wp.empty(count, dtype=float, device=device)
        headroom_m = wp.empty(count, dtype=float, device=device)
        highest_m = (_HIGHEST_M + _GRADE_MAX * distance_m).astype(np.float32)
        wp.launch(
            kernels.ground_kernel,
            dim=count,
            inputs=[
                raster.mesh.id,
                _ENVIRONMENT,
                wp.array(position_m.reshape(-1, 2).astype(np.float32), dtype=wp.vec2, device=device),
                -_DEPTH_M,
                wp.array(highest_m.ravel(), dtype=float, device=device),
                _STEP_M,
            ],
            outputs=[ground_m, headroom_m],
            device=device,
            record_tape=False,
        )
        is_inside = distance_m <= radius_m
        height_m = np.where(is_inside, ground_m.numpy().reshape(distance_m.shape), np.float32(np.nan))
        room_m = np.where(is_inside, headroom_m.numpy().reshape(distance_m.shape), np.float32(0.0))
        beside_ego = (np.abs(position_m - centre_m) <= 0.5 * (high_m - low_m)[:2] + 2.0 * cell_m).all(axis=-1)
        room_m[~_reached_from(beside_ego, room_m >= min(HEIGHTS_M))] = 0.0
        return cls(scene, x_m, y_m, height_m, room_m, cell_m, radius_m)

    def is_open(self, height_m: float) -> np.ndarray:
        """Where a person of a height can stand; bool [row, column]."""
        return np.isfinite(self.ground_m) & (self.headroom_m >= height_m)

    def coverage(self, cameras: Sequence[RigCamera], *, heights_m: Sequence[float] = HEIGHTS_M) -> Coverage:
        """Which cameras see a person of each height in each cell."""
        if not heights_m or not all(height_m > 0.0 for height_m in heights_m):
            raise ValueError(f"heights_m must be positive, got {tuple(heights_m)}")
        is_open = np.stack([self.is_open(height_m) for height_m in heights_m])
        height, row, column, point_m = self.points_m(is_open, heights_m)
        is_seen = np.zeros((len(cameras), *is_open.shape), bool)
        is_seen[:, height, row, column] = sight(cameras, point_m, self.scene).seen
        return Coverage(self, tuple(heights_m), is_open, is_seen)

    def points_m(
        self, is_open: np.ndarray, heights_m: Sequence[float]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Heads of all who can stand in open cells [height, row, column]: these indices, and points [m]."""
        height, row, column = np.nonzero(is_open)
        top_m = self.ground_m[row, column] + np.asarray(heights_m)[height]
        return height, row, column, np.stack([self.x_m[row], self.y_m[column], top_m], axis=-1)


def _reached_from(start: np.ndarray, is_open: np.ndarray) -> np.ndarray:
    """Open cells connected with the open start cells; bool [row, column]."""
    import cv2

    _, part = cv2.connectedComponents(is_open.astype(np.uint8), connectivity=8)
    return np.isin(part, np.setdiff1d(part[start], [0]))


@dataclass(frozen=True)
class Coverage:
    """Which cameras see a person in each ground cell.

    Attributes:
        is_open: Where a person of a height can stand, bool [height, row, column].
        is_seen: Whether a camera sees the person's head, bool [camera, height, row, column]; False where nobody can
            stand.
    """

    ground: Ground
    heights_m: tuple[float, ...]
    is_open: np.ndarray
    is_seen: np.ndarray

    def with_camera(self, index: int, camera: RigCamera) -> Coverage:
        """The coverage with one camera replaced; the results of the other cameras are reused."""
        height, row, column, point_m = self.ground.points_m(self.is_open, self.heights_m)
        is_seen = self.is_seen.copy()
        is_seen[index, height, row, column] = sight([camera], point_m, self.ground.scene).seen[0]
        return Coverage(self.ground, self.heights_m, self.is_open, is_seen)

    @cached_property
    def count(self) -> np.ndarray:
        """Number of cameras that see a cell, int64 [height, row, column]; -1 where nobody can stand."""
        return np.where(self.is_open, self.is_seen.sum(axis=0), -1)

    @property
    def covered_share(self) -> np.ndarray:
        """Share of the open cells that some camera sees, float64 [height]; NaN without open cells."""
        return self._share(self.count > 0)

    @property
    def blind_area_m2(self) -> np.ndarray:
        """Area of the ground where no camera sees a person of a height [m^2], float64 [height]."""
        return (self.count == 0).sum(axis=(1, 2)) * self.ground.cell_m**2

    def share_seen_by(self, cameras: int, *, radius_m: float) -> np.ndarray:
        """Share of the open cells near the vehicle that so many cameras see, or more."""
        return self._share(self.count >= cameras, self._distance_m < radius_m)

    @property
    def _distance_m(self) -> np.ndarray:
        """Of every cell from the ego vehicle's centre [m], float64 [row, column]."""
        ground = self.ground
        centre_m = 0.5 * (ground.x_m[0] + ground.x_m[-1]), 0.5 * (ground.y_m[0] + ground.y_m[-1])
        return np.hypot(ground.x_m[:, None] - centre_m[0], ground.y_m[None] - centre_m[1])

    def _share(self, flag: np.ndarray, within: np.ndarray | None = None) -> np.ndarray:
        is_open = self.is_open if within is None else self.is_open & within
        total = is_open.sum(axis=(1, 2))
        return np.where(total > 0, (flag & is_open).sum(axis=(1, 2)) / np.maximum(total, 1), np.nan)


@dataclass(frozen=True, eq=False)
class BlindGround:
    """Per ground cell, the number of scenes in which a person can stand there, and in which no camera sees that person.

    The cells lie around the centre of the ego vehicle, x forward along the rows and y left along the columns. A cell is
    blind if it is outside all images or occluded.
    """

    scene_count: int
    open_count: np.ndarray  # scenes in which a person of a height can stand on a cell, int64 [height, row, column]
    # Of these, scenes in which no camera sees the person, same shape, for every rig by name
    blind_count: dict[str, np.ndarray]
    heights_m: tuple[float, ...] = HEIGHTS_M
    cell_m: float = _CELL_M
    radius_m: float = _RADIUS_M

    @classmethod
    def of(cls, rigs: Mapping[str, Rig], scenes: Iterable[DeviceScene]) -> BlindGround:
        """Count the blind ground of every rig over at least one scene."""
        open_counts: list[np.ndarray] = []
        blind_counts: dict[str, list[np.ndarray]] = {name: [] for name in rigs}
        for scene in scenes:
            ground = Ground.around(scene)
            for name, rig in rigs.items():
                blind_counts[name].append(ground.coverage(rig.cameras).count == 0)
            open_counts.append(np.stack([ground.is_open(height_m) for height_m in HEIGHTS_M]))
        blind_count = {name: np.sum(counts, axis=0) for name, counts in blind_counts.items()}
        return cls(len(open_counts), np.sum(open_counts, axis=0), blind_count)

    @property
    def from_ego_m(self) -> np.ndarray:
        """Cell centres relative to the centre of the ego vehicle, forward and left [m], [row, column, 2]."""
        steps = [self.cell_m * (np.arange(count) - (count - 1) / 2) for count in self.open_count.shape[1:]]
        return np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1)

    def table(self) -> dict[str, Any]:
        """The counts by height, sector and band, once per scene, for ``evaluation.json``."""
        sector = sectors_of(self.from_ego_m)
        band = np.searchsorted(DISTANCE_EDGES_M[1:-1], np.linalg.norm(self.from_ego_m, axis=-1), side="right")

        def by_sector(count: np.ndarray) -> list[list[list[int]]]:
            bands = range(len(DISTANCE_EDGES_M) - 1)
            groups = [[(sector == s) & (band == b) for b in bands] for s in range(len(SECTORS))]
            return [[[int(layer[group].sum()) for group in row] for row in groups] for layer in count]

        return {
            "scenes": self.scene_count,
            "heights_m": list(self.heights_m),
            "cell_m": self.cell_m,
            "radius_m": self.radius_m,
            "sectors": list(SECTORS),
            "bands_m": [f"{low:g}-{high:g}" for low, high in itertools.pairwise(DISTANCE_EDGES_M)],
            "cells": by_sector(self.open_count),
            "blind": {name: by_sector(count) for name, count in self.blind_count.items()},
        }
