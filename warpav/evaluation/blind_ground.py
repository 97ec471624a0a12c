"""Blind ground around the vehicle: cells that no camera of a rig sees, counted over many scenes."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpav.evaluation.coverage import CELL_M, HEIGHTS_M, RADIUS_M, Ground
from warpav.evaluation.metrics import SECTORS, sectors_of
from warpav.rig.rig import Rig
from warpav.scene.device_scene import DeviceScene

DISTANCE_EDGES_M = (0.0, 5.0, 10.0, 15.0, 20.0, RADIUS_M)
"""Bands of the distance from the centre of the ego vehicle [m]; a band includes its lower edge, the last one both."""


@dataclass(frozen=True, eq=False)
class BlindGround:
    """Per ground cell, the number of scenes in which a person can stand there, and in which no camera sees that person.

    The cells lie around the centre of the ego vehicle, x forward along the rows and y left along the columns. A cell is
    blind if it is outside all images or occluded.

    Attributes:
        open_count: Scenes in which a person of a height can stand on a cell, int64 [height, row, column].
        blind_count: Of these, scenes in which no camera sees the person, same shape, for every rig by name.
    """

    scene_count: int
    open_count: np.ndarray
    blind_count: dict[str, np.ndarray]
    heights_m: tuple[float, ...] = HEIGHTS_M
    cell_m: float = CELL_M
    radius_m: float = RADIUS_M

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
        """The counts by sector and band, for ``evaluation.json``.

        ``cells`` and each of ``blind`` count cells, once per scene, by height, sector and band; the other keys
        describe these axes.
        """
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

    def arrays(self, ego_bounds_m: np.ndarray) -> dict[str, np.ndarray]:
        """The counts for ``figures/ground.npz``, with the ego vehicle's lowest and highest corner [m], [2, 3]."""
        return {
            "open_count": self.open_count.astype(np.uint16),
            **{f"blind_count_{name}": count.astype(np.uint16) for name, count in self.blind_count.items()},
            "heights_m": np.array(self.heights_m),
            "cell_m": np.array(self.cell_m),
            "ego_bounds_m": np.asarray(ego_bounds_m, np.float64),
        }
