"""What a rig is expected to miss near rigs that were rendered: a model of every probability, camera by camera.

A render gives, with the Jacobian, the tangent of each probability's logit at a camera's pose. Where an object begins to
leave the image or to come out from behind another, the logit has a kink, and the best pose is often right on it. The
tangent of one pose knows one side only, so steps that follow it jump to and fro across. The model is therefore the
least of the tangents at all near poses where the camera was rendered: it knows the kink as soon as both sides have been
seen. What the cameras miss is multiplied as in the true objective; so it is known too that what another camera finds is
worth nothing, and that a sure object cannot become surer.

Source: composite bundle methods (Sagastizábal 2013, Mathematical Programming 140), here with a bundle for each camera
and object.

Points of hard requirements near the edge of what they ask for, as linear inequalities of a descent.

A camera's margin at a point is what it sees over what is asked of it, so it meets the point from 1 on. A point that so
many cameras have to meet stays met while its so many best margins stay at 1 or above. Each of these that a step could
take below 1 becomes an inequality ``margin + jacobian . move >= 1``, by its tangent at the rig and by those at rigs
that were refused: where an object that is seen whole begins to leave the image the margin has a kink, of which only the
far side has a slope. They are tangents, so whether a rig meets a point is still for the render of that rig to say.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from warpav.detection import SUREST

Margins = tuple[np.ndarray, np.ndarray]
"""Margins of cameras at points [camera, point], and their Jacobian to the mount poses [camera, point, 7]."""
KEPT_BACK = 0.05  # how far above 1 a margin is kept, where it is not below already, as tangents are not exact
_MARGIN_CONTRADICTION = 0.3
"""How far below what was rendered a tangent may be; one that is lower by more has been proven wrong."""


@dataclass(frozen=True, eq=False)
class HardPoints:
    """Points that have to be met."""

    margins: Callable[[np.ndarray], Margins]  # of cameras, float [camera, 7], at every point
    needed: np.ndarray  # how many cameras must meet each, int [point]

    @classmethod
    def of_all(cls, several: Sequence[HardPoints]) -> HardPoints | None:
        """The points of several; None: of none."""
        if len(several) < 2:
            return several[0] if several else None

        def margins(mount_pose: np.ndarray) -> Margins:
            value, slope = zip(*(each.margins(mount_pose) for each in several), strict=True)
            return np.concatenate(value, axis=1), np.concatenate(slope, axis=1)

        return cls(margins, np.concatenate([each.needed for each in several]))

    def edges(
        self,
        mount_pose: np.ndarray,
        margins: Margins,
        reach: np.ndarray,
        refused: Sequence[tuple[np.ndarray, Margins]] = (),
    ) -> Edges:
        """The inequalities of a rig. ``reach`` float [camera, 7]."""
        value, jacobian = margins
        rank = np.argsort(np.argsort(-value, axis=0, kind="stable"), axis=0, kind="stable")
        counts = (rank < self.needed) & (value > 0.0)
        tangents = [(value, jacobian, counts)]
        for other_pose, (other, slope) in refused:
            here = other + np.einsum("cok,ck->co", slope, mount_pose.astype(np.float64) - other_pose)
            is_lost = counts & (value >= 1.0) & (other < 1.0) & (other > 0.0)
            tangents.append((np.maximum(here, value), slope, is_lost & (here >= value - _MARGIN_CONTRADICTION)))
        rows = []
        for each, slope, holds in tangents:
            lowest = each - np.einsum("cok,ck->co", np.abs(slope), reach)
            camera, point = np.nonzero(holds & (lowest < 1.0 + KEPT_BACK))
            rows.append((camera, each[camera, point], slope[camera, point]))
        return Edges(*(np.concatenate(each) for each in zip(*rows, strict=True)))


@dataclass(frozen=True, eq=False)
class Edges:
    camera: np.ndarray  # whose margin each is about, int [row]
    margin: np.ndarray  # what its tangent says of the margin before the move, float64 [row]
    jacobian: np.ndarray  # its Jacobian to the camera's mount pose, float64 [row, 7]

    @property
    def spare(self) -> np.ndarray:
        """How far each margin may fall: to a little over 1, not at all where it is below that, float64 [row]."""
        return np.maximum(self.margin - (1.0 + KEPT_BACK), 0.0)

    def slope(self, camera_count: int) -> np.ndarray:
        """The Jacobians as those of a rig of so many cameras, float64 [row, camera, 7]."""
        result = np.zeros((len(self.camera), camera_count, self.jacobian.shape[1]))
        result[np.arange(len(self.camera)), self.camera] = self.jacobian
        return result


TANGENTS = 6  # earlier poses of a camera whose tangents count, at most
REACH = 3.0  # how far those may be in a number, in radii of the step to be taken
CONTRADICTION = 0.3
"""Logit by which a tangent may be below what was rendered; one that is lower by more has been proven wrong."""
_RigValue = Callable[[np.ndarray, np.ndarray], tuple[float, np.ndarray]]
"""The value of a rig and its derivatives [camera, object] to what each camera misses [camera, object], by weights."""
_SOFTNESS = 0.02  # logit within which the least of some tangents is rounded, so that it has a slope everywhere
_LOGIT_MAX = 12.0


@dataclass(frozen=True, eq=False)
class Rendered:
    mount_pose: np.ndarray  # of its cameras, float [camera, 7]
    probability: np.ndarray  # what each detects, float [camera, object]
    jacobian: np.ndarray  # its Jacobian to the mount poses, float [camera, object, 7]
    objective: float  # the expected miss rate
    margins: Margins | None = None  # of its cameras at points of hard requirements; None: there are none

    @cached_property
    def logit(self) -> np.ndarray:
        """Of the probabilities, float64 [camera, object]."""
        found = np.clip(np.asarray(self.probability, np.float64), 0.0, SUREST)
        with np.errstate(divide="ignore"):
            return np.clip(np.log(found) - np.log1p(-found), -_LOGIT_MAX, _LOGIT_MAX)

    @cached_property
    def slope(self) -> np.ndarray:
        """Of the logits, float64 [camera, object, 7]; 0 of an object that the camera does not see at all."""
        found = np.clip(np.asarray(self.probability, np.float64), 0.0, SUREST)
        spread = np.maximum(found * (1.0 - found), 1e-9)
        return np.where((found > 0.0)[..., None], np.asarray(self.jacobian, np.float64) / spread[..., None], 0.0)


class TangentModel:
    """The expected miss rate or another value around a rig, as a function of how far its cameras have moved."""

    def __init__(
        self,
        here: Rendered,
        weight: np.ndarray,
        *,
        earlier: Sequence[Rendered] = (),
        reach: np.ndarray | float = 0.0,
        rig_value: _RigValue | None = None,
        charge: np.ndarray | None = None,
    ) -> None:
        """A model of what was rendered. ``reach`` float [7]; ``charge`` as of `false_alarm_cost`."""
        self._rig_value = rig_value
        is_seen = here.probability > 0.0
        # an object that no camera sees at all has no Jacobian
        used = is_seen.any(axis=0)
        self._missed_anyway = float(weight[~used].sum())
        self._weight, self._is_seen = weight[used], is_seen[:, used]
        self._charge = np.zeros(used.sum()) if charge is None else charge[used]
        near = [_near(camera, here, earlier, reach) for camera in range(len(is_seen))]
        count = 1 + max(map(len, near))
        logit = np.full((len(near), count, len(self._weight)), np.inf)
        slope = np.zeros((len(near), count, len(self._weight), here.slope.shape[-1]))
        for camera, rigs in enumerate(near):
            logit[camera, 0], slope[camera, 0] = here.logit[camera, used], here.slope[camera, used]
            for k, rig in enumerate(rigs, 1):
                moved = here.mount_pose[camera].astype(np.float64) - rig.mount_pose[camera]
                slope[camera, k] = rig.slope[camera, used]
                value = rig.logit[camera, used] + slope[camera, k] @ moved
                holds = (rig.probability[camera, used] > 0.0) & (value >= logit[camera, 0] - CONTRADICTION)
                logit[camera, k] = np.where(holds, np.maximum(value, logit[camera, 0]), np.inf)
        self._logit, self._slope = logit, slope.reshape(len(near), -1, slope.shape[-1])

    def value(self, moved: np.ndarray) -> float:
        """The modelled objective after moves of the cameras [camera, 7]."""
        return self.value_and_gradient(moved)[0]

    def value_and_gradient(self, moved: np.ndarray) -> tuple[float, np.ndarray]:
        """The modelled objective after moves of the cameras [camera, 7], and its gradient, float64 [camera, 7]."""
        tangent = self._logit + (self._slope @ moved[..., None]).reshape(self._logit.shape)
        least = tangent.min(axis=1)
        share = np.exp((least[:, None] - tangent) / _SOFTNESS)
        total = share.sum(axis=1)
        logit = np.clip(least - _SOFTNESS * np.log(total), -_LOGIT_MAX, _LOGIT_MAX)
        probability = np.where(self._is_seen, 1.0 / (1.0 + np.exp(-logit)), 0.0)
        missed = np.maximum(1.0 - probability, 1.0 - SUREST)
        product = missed.prod(axis=0)
        # d product / d logit of one camera: the others' product times -p (1 - p), and 1 - p is among the product
        if self._rig_value is None:
            value, by_logit = float(self._weight @ product), -self._weight * product * probability
        else:
            value, by_missed = self._rig_value(missed, self._weight)
            by_logit = -by_missed * missed * probability
        unsure = missed * probability
        value += float((unsure @ self._charge).sum())
        by_logit = by_logit + self._charge * unsure * (missed - probability)
        by_tangent = (share * (by_logit / total)[:, None]).reshape(len(share), 1, -1)
        return value + self._missed_anyway, (by_tangent @ self._slope)[:, 0]


def _near(camera: int, here: Rendered, earlier: Sequence[Rendered], reach: np.ndarray | float) -> list[Rendered]:
    """The last rigs before whose camera was near to where it is now, and not just there; each of its poses once."""
    pose, found = here.mount_pose[camera], []
    known = {pose.tobytes()}
    for rig in reversed(earlier):
        other = rig.mount_pose[camera]
        if len(found) < TANGENTS and other.tobytes() not in known and (np.abs(other - pose) <= reach).all():
            known.add(other.tobytes())
            found.append(rig)
    return found
