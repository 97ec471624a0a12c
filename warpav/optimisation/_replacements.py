"""What a rig would miss with another camera in place of one of its own, for all cameras of a pool, without a render.

The probabilities are those of single cameras, so a rig that differs in one camera is known as soon as that camera is. A
search that is near its end asks two things of this: from which places a single camera could still be polished into a
better one (`starts`), and where around the rig's own cameras to look next (`near`), when the objective is rougher than
the steps of a gradient.

Source: `near` is a cross-entropy method (Rubinstein and Kroese 2004), here with a distribution for each camera.
"""

from __future__ import annotations

import numpy as np

from warpav.detection import SUREST, false_alarm_cost
from warpav.optimisation._camera_loss import SOFTNESS, RobustObjective
from warpav.optimisation._mount import X_M, Y_M, YAW_RAD, CameraMount
from warpav.optimisation._pool import CameraPool

_ELITE = 12  # cameras nearby that say in which directions to look, the best ones
_FLOOR = 0.1  # standard deviation that is added in every direction, in radii
_OTHER_MODULE = 1e6  # farther than any camera of the same module


class Replacements:
    """A rig of a pool, and what would come of it with one camera replaced."""

    def __init__(
        self,
        pool: CameraPool,
        held: np.ndarray,
        replaced: np.ndarray,
        is_apart: np.ndarray,
        fits: np.ndarray,
        *,
        unit: np.ndarray,
        weight: np.ndarray | None = None,
        robust: tuple[RobustObjective, np.ndarray] | None = None,
        charge: np.ndarray | None = None,
    ) -> None:
        """All replacements of a single camera. ``held`` int [held camera]; ``replaced`` int [slot].

        ``is_apart`` bool [camera, rig camera]; ``unit`` float [7]; ``robust`` int [camera]; ``charge`` as of
        `false_alarm_cost`.
        """
        rig = np.concatenate([held, replaced])
        self._pose, self._unit, self._of_slot = np.asarray(pool.mount_pose, np.float64), unit, replaced
        missed = 1.0 - np.minimum(np.asarray(pool.detection_probability, np.float64), SUREST)
        others = [np.delete(np.arange(len(rig)), slot) for slot in range(len(held), len(rig))]
        relative = None if weight is None else weight / np.mean(weight)
        if robust is None:
            # share that the other cameras miss, for each camera that may be replaced
            self.missed_by_others = np.array([missed[rig[each]].prod(axis=0) for each in others])
            if relative is not None:
                self.missed_by_others = self.missed_by_others * relative
            miss_rate = missed @ self.missed_by_others.T / missed.shape[1]
        else:
            objective, size = robust
            count = missed.shape[1]
            share = np.full(count, 1.0 / count) if relative is None else relative / count
            slope = objective.value_and_slope(missed[rig], share, size[rig], softness=SOFTNESS)[1]
            self.missed_by_others = slope[len(held) :] * count
            value = [objective.of_completed(missed.T, share, rig[each][None], size) for each in others]
            miss_rate = np.concatenate(value, axis=1)
        can_be = np.stack([is_apart[:, each].all(axis=1) for each in others], axis=1) & fits[:, len(held) :]
        miss_rate = miss_rate + false_alarm_cost(pool.detection_probability, charge)[:, None]
        self.miss_rate = np.where(can_be, miss_rate, np.inf)  # or robust objective; without what the others cost

    def starts(self, count: int, known: np.ndarray) -> list[tuple[int, int]]:
        """The best replacements that are a unit and more from each other, from the rig and from known places.

        Returns camera of the pool, and whose slot it would take; the best first. ``known`` float [place, 7].
        """
        best = self.miss_rate.min(axis=1)
        known = np.concatenate([self._pose[self._of_slot], known])
        found: list[tuple[int, int]] = []
        for camera in np.argsort(best, kind="stable"):
            if len(found) == count or not np.isfinite(best[camera]):
                break
            pose = self._pose[camera]
            if self._distance(known, pose).min() >= 1.0:
                found.append((int(camera), int(self.miss_rate[camera].argmin())))
                known = np.concatenate([known, pose[None]])
        return found

    def near(self, radius: float, count: int, rng: np.random.Generator) -> np.ndarray:
        """Poses around every camera that may be replaced, spread as the best of the pool nearby are.

        Returns the poses, float64 [slot times count, 7]; constraints and bounds are not kept.
        """
        free = np.flatnonzero(self._unit > 0.0)
        poses = []
        for slot, camera in enumerate(self._of_slot):
            here = self._pose[camera]
            nearby = np.flatnonzero(self._distance(self._pose, here) <= 2.0 * radius)
            elite = nearby[np.argsort(self.miss_rate[nearby, slot], kind="stable")[:_ELITE]]
            offset = within_half_a_turn(self._pose[elite] - here)[:, free] / self._unit[free]
            spread = _FLOOR if len(elite) >= _ELITE else 1.0
            covariance = offset.T @ offset / len(elite) + (spread * radius) ** 2 * np.eye(len(free))
            step = rng.multivariate_normal(np.zeros(len(free)), covariance, size=count)
            pose = np.tile(here, (count, 1))
            pose[:, free] += np.clip(step, -2.0 * radius, 2.0 * radius) * self._unit[free]
            poses.append(pose)
        return np.concatenate(poses)

    def _distance(self, poses: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """The greatest difference in a free number, in units, float64 [pose]."""
        scale = np.where(self._unit > 0.0, self._unit, np.inf)
        return np.abs(within_half_a_turn(poses - pose) / scale).max(axis=1)


def within_half_a_turn(difference: np.ndarray) -> np.ndarray:
    """Differences of mount poses with the yaw's within half a turn, float64 [..., 7]."""
    result = np.array(difference, np.float64)
    result[..., YAW_RAD] = (result[..., YAW_RAD] + np.pi) % (2.0 * np.pi) - np.pi
    return result


def apart(mount_pose: np.ndarray, count: int, unit: np.ndarray) -> np.ndarray:
    """The first cameras of some that differ by more than a unit in a number, at most so many, [camera, 7]."""
    scale = np.where(unit > 0.0, unit, np.inf)
    chosen = mount_pose[:1]
    for pose in mount_pose[1:]:
        if len(chosen) >= count:
            break
        difference = within_half_a_turn(chosen - pose)
        if (np.abs(difference) / scale).max(axis=1).min() > 1.0:
            chosen = np.concatenate([chosen, pose[None]])
    return chosen


class Assembly:
    """Rigs of a mount, some of whose cameras may be frozen: their own come first in a pool, and keep their places."""

    def __init__(self, mount: CameraMount) -> None:
        self.mount, frozen = mount, mount.frozen
        self.is_frozen = np.zeros(0, bool) if frozen is None else frozen.is_frozen
        self.frozen = (
            np.zeros((0, 7), np.float32) if frozen is None else frozen.mount_pose[frozen.is_frozen].astype(np.float32)
        )

    def in_order(self, rig: np.ndarray) -> np.ndarray:
        """The cameras of a rig, the frozen ones first, as `rig` takes them."""
        return np.concatenate([self.frozen, rig[~self.is_held(len(rig))]])

    def rig(self, pose: np.ndarray, *, like: np.ndarray | None = None) -> np.ndarray:
        """The rig of chosen cameras, the frozen ones first, in the order of those of ``like`` that are nearest."""
        is_held = self.is_held(len(pose))
        result = np.empty((len(pose), 7), np.float32)
        count = len(self.frozen)
        result[is_held], free = pose[:count], pose[count:]
        if like is not None and len(like) == len(pose):
            from scipy.optimize import linear_sum_assignment

            module, other = (self.mount.module_of(each) for each in (like[~is_held], free))
            difference = within_half_a_turn(like[~is_held][:, None].astype(np.float64) - free[None])
            far = np.linalg.norm(difference[..., [X_M, Y_M, YAW_RAD]], axis=-1)  # in place [m] and direction [rad]
            _, order = linear_sum_assignment(far + _OTHER_MODULE * (module[:, None] != other))
            free = free[order]
        elif self.mount.is_mixed:
            free = free[np.argsort(self.mount.module_of(free), kind="stable")]
        result[~is_held] = free
        return result

    def is_held(self, count: int) -> np.ndarray:
        return self.is_frozen if len(self.is_frozen) else np.zeros(count, bool)
