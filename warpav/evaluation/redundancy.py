"""Redundancy: which share of the road users near the vehicle several cameras see, or are expected to detect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpav.scene.device_scene import DeviceScene


@dataclass(frozen=True)
class Redundancy:
    """How often enough cameras see a road user."""

    radius_m: float
    cameras: int
    objects: int
    share: float | None


def probability_of_at_least(cameras: int, probability: np.ndarray) -> np.ndarray:
    """Probability that at least so many cameras detect each object, each independently of the others.

    Args:
        probability: Of each camera, 0..1; flags will do; [camera, object].
    """
    probability = np.asarray(probability, np.float64)
    # of exactly 0, 1, ... cameras so far
    exactly = np.zeros((cameras + 1, probability.shape[1]))
    exactly[0] = 1.0
    for row in probability:
        # the last one is "that many or more"
        gain = exactly[:-1] * row
        exactly[:-1] -= gain
        exactly[1:] += gain
    return np.clip(exactly[-1], 0.0, 1.0)


def redundancy(
    sees: Sequence[np.ndarray], scenes: Sequence[DeviceScene], *, radius_m: float, cameras: int
) -> Redundancy:
    """Share of the road users within a radius that enough cameras see, over some scenes.

    Args:
        sees: Of every scene which camera sees which road user, as flags (`RigObservation.visible_to_camera`), or how
            likely each is to detect it (`RigObservation.detection_probability`), [camera, object].
    """
    if not radius_m > 0.0 or cameras < 1:
        raise ValueError(f"radius_m must be positive and cameras at least 1, got {radius_m} and {cameras}")
    found = [np.zeros(0)]
    for seen, scene in zip(sees, scenes, strict=True):
        if seen.ndim != 2 or seen.shape[1] != scene.vehicle_count:
            raise ValueError(f"{scene.name}: expected [camera, {scene.vehicle_count}], got {seen.shape}")
        is_near = np.hypot(*scene.from_ego_m.T) <= radius_m
        found.append(probability_of_at_least(cameras, seen)[is_near])
    share = np.concatenate(found)
    return Redundancy(radius_m, cameras, len(share), float(share.mean()) if len(share) else None)
