"""What errors of mounting cost a rig: each camera and degree of freedom alone, and all of them together by chance.

All cameras are rendered by themselves, as a pool is; a rig's expected misses follow from what each of them detects.
Errors inwards end at the skin of the body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from warpav.core.errors import ArgumentError
from warpav.core.progress import NullProgress, Progress
from warpav.evaluation.rig_evaluation import Table
from warpav.optimisation.miss_rate import expected_miss_rate, expected_miss_slope, shares_of
from warpav.optimisation.mount_errors import COLUMNS, MountErrors, outside_skin
from warpav.optimisation.single_cameras import SingleCameras
from warpav.scene.device_scene import DeviceScene


@dataclass(frozen=True)
class MountEffect:
    """One camera that is off in one degree of freedom.

    Attributes:
        per_unit: Derivative of the expected misses per 100 objects at the rig [1/m, 1/rad].
    """

    camera: str
    degree: str
    per_unit: float
    below: float
    above: float

    @property
    def worst(self) -> float:
        """The greater of both changes."""
        return max(self.below, self.above)


@dataclass(frozen=True, eq=False)
class MountTolerance:
    """What errors of mounting cost a rig in expected misses per 100 objects, weighted where objects have weights."""

    position_m: float
    angle_rad: float
    nominal: float
    samples: np.ndarray
    effects: tuple[MountEffect, ...]

    @property
    def worst(self) -> MountEffect:
        """The camera and degree of freedom that cost most; of equal ones the first."""
        return max(self.effects, key=lambda effect: effect.worst)

    def table(self) -> Table:
        """What each camera costs by degree of freedom: text when printed, HTML in a notebook."""
        cameras = dict.fromkeys(effect.camera for effect in self.effects)
        found = {(effect.camera, effect.degree): f"{effect.worst:+z.2f}" for effect in self.effects}
        limits = f"+-{100.0 * self.position_m:g} cm, +-{np.degrees(self.angle_rad):g} deg"
        high = np.quantile(self.samples, 0.95)
        return Table(
            ("misses per 100, change", *COLUMNS),
            tuple((name, *(found[name, degree] for degree in COLUMNS)) for name in cameras),
            f"Worst change with one camera off by {limits} in one direction. The rig is expected to miss "
            f"{self.nominal:.2f} of 100; with all cameras off by chance {self.samples.mean():.2f}, "
            f"in 95 % of {len(self.samples)} draws at most {high:.2f}.",
        )

    def to_json(self) -> dict[str, Any]:
        """As ``evaluation.json`` has it, angles in radians."""
        return {
            "position_m": self.position_m,
            "angle_rad": self.angle_rad,
            "expected_misses_per_100": self.nominal,
            "draws": {
                "count": len(self.samples),
                "expected_misses_per_100": float(self.samples.mean()),
                "quantile_95": float(np.quantile(self.samples, 0.95)),
            },
            "effects": [{**asdict(effect), "worst": effect.worst} for effect in self.effects],
            "worst": {"camera": self.worst.camera, "degree": self.worst.degree, "change_per_100": self.worst.worst},
        }

    @classmethod
    def of(
        cls,
        camera: Sequence[str],
        mount_pose: np.ndarray,
        cameras: SingleCameras,
        scenes: Sequence[DeviceScene],
        *,
        position_m: float,
        angle_rad: float,
        sample_count: int,
        seed: int,
        weight: np.ndarray | None = None,
        progress: Progress | None = None,
    ) -> MountTolerance:
        """Render a rig's cameras with errors of mounting; inwards they end at the surface that the cameras stand on.

        Args:
            mount_pose: The rig, float [camera, 7].
        """
        for name, value in (("position_m", position_m), ("angle_rad", angle_rad), ("sample_count", sample_count)):
            if not value > 0.0:
                raise ArgumentError(name, f"expected a positive number, got {value!r}")
        if not any(scene.vehicle_count for scene in scenes):
            raise ArgumentError("scenes", "expected at least one object, got none")
        pose, side = cameras.apart(np.asarray(mount_pose, np.float64))
        count, columns = len(pose), list(COLUMNS.values())
        tolerance = MountErrors(position_m, angle_rad).tolerance
        rng = np.random.default_rng(seed)
        drawn = np.tile(pose, (sample_count, 1, 1))
        drawn[..., columns] += tolerance * rng.uniform(-1.0, 1.0, (sample_count, count, len(columns)))
        alone = np.tile(pose, (2, len(columns), 1, 1))  # [below or above, degree, camera, 7]
        for k, column in enumerate(columns):
            alone[0, k, :, column] -= tolerance[k]
            alone[1, k, :, column] += tolerance[k]
        every = np.concatenate([pose[None], alone.reshape(-1, count, pose.shape[1]), drawn])
        every = outside_skin(every, pose, cameras.mount)
        progress = progress or NullProgress()
        found = np.zeros((*every.shape[:2], sum(scene.vehicle_count for scene in scenes)))
        first = 0
        for scene in progress.steps("mount errors", scenes, count=len(scenes)):
            objects = slice(first, first := first + scene.vehicle_count)
            for number, of_side in enumerate(cameras.sides):
                own = np.flatnonzero(side == number)
                seen = of_side.detection_probability(every[:, own].reshape(-1, pose.shape[1]), scene)
                found[:, own, objects] = seen.reshape(len(every), len(own), -1)
        share = shares_of(weight)

        def misses(probability: np.ndarray) -> float:
            return 100.0 * expected_miss_rate(probability, share)

        plain, single, together = found[0], found[1 : 1 + 2 * len(columns)], found[1 + 2 * len(columns) :]
        nominal = misses(plain)
        single = single.reshape(2, len(columns), count, -1)
        slope = _slopes(cameras, pose.astype(np.float32), side, scenes, share)
        effects = []
        for c, name in enumerate(camera):
            for k, degree in enumerate(COLUMNS):
                changes = []
                for side in range(2):
                    moved = plain.copy()
                    moved[c] = single[side, k, c]
                    changes.append(misses(moved) - nominal)
                effects.append(MountEffect(name, degree, float(slope[c, columns[k]]), *changes))
        return cls(position_m, angle_rad, nominal, np.array([misses(each) for each in together]), tuple(effects))


def _slopes(
    cameras: SingleCameras,
    mount_pose: np.ndarray,
    side: np.ndarray,
    scenes: Sequence[DeviceScene],
    share: np.ndarray | None,
) -> np.ndarray:
    """Derivatives of the expected misses per 100 to every number of every camera of a side, float64 [camera, 7]."""
    objects = sum(scene.vehicle_count for scene in scenes)
    probability, jacobian = np.zeros((len(side), objects)), np.zeros((len(side), objects, mount_pose.shape[1]))
    for number, of_side in enumerate(cameras.sides):
        own = np.flatnonzero(side == number)
        probability[own], jacobian[own] = of_side.with_jacobian(mount_pose[own], scenes)
    return 100.0 * expected_miss_slope(probability, jacobian, share)
