"""Design rules of a search: what single cameras, pairs and rigs of a pool must keep, and a polish with them.

What a camera breaks by itself takes it out of the selection, two cameras whose housings stand in each other's way
exclude each other, and what a rig must see together are rows. The polish gets the same as margins with Jacobians: 1 and
more where a rule is kept.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy import sparse

from warpav.core.errors import OptionError
from warpav.optimisation._camera_jacobians import placing_slope
from warpav.optimisation._mount import LOG_ZOOM, MIRROR, MOUNT_POSE_SIZE
from warpav.optimisation._single_cameras import SingleCameras
from warpav.optimisation._tangent_model import Margins
from warpav.optimisation.selection._problem import Row
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.rig import RigCamera, boxes_meet, corners_m, hidden_share, least_cosine
from warpav.sight import (
    AZIMUTH_STEP_RAD,
    NEAR_M,
    SPARED,
    Body,
    Rules,
    border_margin,
    crossing_angle_rad,
    horizon_margin,
    level_ground,
    near_ring_m,
    own_body,
    own_body_limit,
    ring_m,
    sight,
)

ALONE = ("own_body", "horizon", "crossing", "housing")
"""Rules that a camera, or a pair that mirrors itself, keeps or breaks alone."""

_MARGIN_SCALE = 5.0  # of a margin: a share of .01 of an image, or .01 rad, are .05 of it, what a polish keeps back

_CLEAR = 0.01  # how far outside of an image another camera's box is kept, as a share of the width

_STEP = 1e-3  # half a difference in every number of a mount pose [m, rad, 1]


_Expanded = tuple[np.ndarray, np.ndarray, list[CameraModel], np.ndarray]
"""Of cameras, those of pairs twice: their row, pose in the ego frame, model and the corners of their box [m]."""


class _Measured:
    """What some cameras of a mount keep and see, in the order of their mount poses."""

    def __init__(self, count: int, directions: int, near: int) -> None:
        self.breaks = np.zeros((count, len(ALONE)), bool)
        self.ring = np.zeros((count, directions), bool)
        self.near = np.zeros((count, len(NEAR_M), near), bool)


class PoolRules:
    """The design rules of a search.

    ``vehicle`` in the ego frame [m].
    """

    def __init__(self, rules: Rules, cameras: SingleCameras, vehicle: Mesh) -> None:
        self.rules, self.cameras, self.vehicle = rules, cameras, vehicle
        self.gap_steps: int | None = None  # widest gap that is allowed, in `AZIMUTH_STEP_RAD`; None: any
        self.near_level: int | None = None  # index into `NEAR_M`; None: any
        self.price_of_gap = math.inf  # what the gap that is asked for would cost of the objective, a share
        self._ring_m = ring_m(vehicle)
        self._near_m = np.stack([near_ring_m(vehicle, distance_m) for distance_m in NEAR_M])
        self._ground = level_ground(vehicle, device=cameras.mount.device)
        self._conflicting = b"", np.zeros(0, int), np.zeros(0, int)
        self._known: dict[bytes, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    @property
    def settled(self) -> Rules:
        """The rules with the limits of a search; those that it dropped allow anything, but are measured."""
        gap_rad = self.rules.azimuth_gap_rad
        if gap_rad is not None:
            gap_rad = 2.0 * math.pi if self.gap_steps is None else self.gap_steps * AZIMUTH_STEP_RAD
        near_m = None if self.near_level is None else NEAR_M[self.near_level]
        return dataclasses.replace(self.rules, azimuth_gap_rad=gap_rad, near_m=near_m)

    # ------------------------------------------------------------------------------------------- single cameras

    def allowed(self, mount_pose: np.ndarray) -> np.ndarray:
        """Which cameras keep all rules that they can keep alone, bool [camera]."""
        return np.asarray(~self._measured(mount_pose).breaks.any(axis=1))

    def refuse(self, mount_pose: np.ndarray, kept: int) -> None:
        """Say which rule most cameras, [camera, 7], break, where too few keep all; ``kept``: how many were found."""
        share = self._measured(mount_pose).breaks.mean(axis=0)
        worst = int(share.argmax())
        option = f"rules.{ALONE[worst]}" + ("_deg" if ALONE[worst] == "crossing" else "")
        raise OptionError(
            option,
            f"expected one that enough cameras can keep, got {kept} that keep all rules; {share[worst]:.0%} break this "
            "one: loosen it, let zones or rig.free allow more, or set rules=none",
        )

    def _measured(self, mount_pose: np.ndarray) -> _Measured:
        pose = np.ascontiguousarray(mount_pose, np.float32).reshape(-1, MOUNT_POSE_SIZE)
        keys = [each.tobytes() for each in pose]
        new = [k for k, key in enumerate(keys) if key not in self._known]
        if new:
            found = self._measure(pose[new])
            for k, row in enumerate(new):
                self._known[keys[row]] = found.breaks[k], found.ring[k], found.near[k]
        result = _Measured(len(pose), len(self._ring_m), self._near_m.shape[1])
        for row, key in enumerate(keys):
            result.breaks[row], result.ring[row], result.near[row] = self._known[key]
        return result

    def _measure(self, pose: np.ndarray) -> _Measured:
        result, rules = _Measured(len(pose), len(self._ring_m), self._near_m.shape[1]), self.rules
        middle_m = Body.of(self.vehicle).centre_m
        for side, row in self._sides(pose):
            own = pose[row] if side == 0 else pose[row] * MIRROR
            views, models = self.cameras.sides[side].in_ego(own)
            if rules.own_body is not None or rules.own_body_wide is not None:
                limit = np.array([own_body_limit(rules, model) for model in models])
                result.breaks[row, 0] |= self._body_shares(side, own, views, models)[0] > limit + SPARED
            if rules.horizon is not None:
                result.breaks[row, 1] |= horizon_margin(views, models) < rules.horizon - SPARED
            if rules.crossing_rad is not None:
                short_rad = rules.crossing_rad - crossing_angle_rad(views, middle_m)
                result.breaks[row, 2] |= np.degrees(short_rad) > SPARED
            cameras = self._rig_cameras(side, own, views, models)
            point_m = np.concatenate([self._ring_m, self._near_m.reshape(-1, 3)])
            seen = sight(cameras, point_m, self._ground).seen
            result.ring[row] |= seen[:, : len(self._ring_m)]
            result.near[row] |= seen[:, len(self._ring_m) :].reshape(len(row), *self._near_m.shape[:2])
        if rules.housing is not None and self.cameras.mount.is_symmetric:
            pairs = np.flatnonzero(self.cameras.mount.is_pair(pose) & ~result.breaks.any(axis=1))
            every = self._expanded(pose[pairs])
            for k, row in enumerate(pairs):
                result.breaks[row, 3] = bool(self._conflicts(every, every[0] == k, every[0] == k))
        return result

    def _sides(self, pose: np.ndarray) -> list[tuple[int, np.ndarray]]:
        """The rows of a mount on each of its sides: the own, and where pairs are their mirror images."""
        pair = np.flatnonzero(self.cameras.mount.is_pair(pose)) if len(self.cameras.sides) > 1 else []
        return [(0, np.arange(len(pose))), *([(1, np.asarray(pair))] if len(pair) else [])]

    def _rig_cameras(
        self, side: int, pose: np.ndarray, views: np.ndarray, models: Sequence[CameraModel]
    ) -> list[RigCamera]:
        panes = self.cameras.sides[side].mount.panes_of(pose)
        return [
            dataclasses.replace(RigCamera.at("camera", view, model), behind_glass=pane)
            for view, model, pane in zip(views, models, panes, strict=True)
        ]

    def _body_shares(
        self, side: int, pose: np.ndarray, views: np.ndarray, models: Sequence[CameraModel]
    ) -> tuple[np.ndarray, np.ndarray]:
        share, jacobian = np.zeros(len(pose)), np.zeros((len(pose), 7))
        panes = self.cameras.sides[side].mount.panes_of(pose)
        for pane in dict.fromkeys(panes):
            row = [k for k, each in enumerate(panes) if each == pane]
            body = own_body(self.vehicle, pane, self.cameras.mount.device)
            share[row], jacobian[row] = body.shares(views[row], [models[k] for k in row])
        return share, jacobian

    # --------------------------------------------------------------------------------------------------- pairs

    def conflict(self, mount_pose: np.ndarray, *, absent: int = 0) -> sparse.csr_array:
        """Which cameras' housings stand in each other's view or meet, bool [camera, camera]."""
        pose = np.ascontiguousarray(mount_pose, np.float32).reshape(-1, MOUNT_POSE_SIZE)
        size = len(pose) + absent
        if self.rules.housing is None:
            return sparse.csr_array((size, size), dtype=bool)
        known, one, other = self._conflicting  # a search asks often about a pool, which grows at its end
        if not pose.tobytes().startswith(known):
            known, one, other = b"", one[:0], other[:0]
        first = len(known) // max(pose[:1].nbytes, 1)
        if first < len(pose):
            every = self._expanded(pose)
            is_new = every[0] >= first
            found = self._conflicts(every, is_new, np.ones_like(is_new)) | self._conflicts(every, ~is_new, is_new)
            new = np.array(sorted(found), int).reshape(-1, 2).T
            pairs = np.unique(np.stack([[*one, *new[0], *new[1]], [*other, *new[1], *new[0]]]), axis=1)
            one, other = pairs[:, pairs[0] != pairs[1]].astype(int)
            self._conflicting = pose.tobytes(), one, other
        return sparse.csr_array((np.ones(len(one), bool), (one, other)), shape=(size, size))

    def _conflicts(self, every: _Expanded, seers: np.ndarray, seen: np.ndarray) -> set[tuple[int, int]]:
        """Which rows conflict with which others, of one row with itself its two cameras; both bool [camera]."""
        assert self.rules.housing is not None
        row, view, model, corner_m = every
        other_row, other_corner_m = row[seen], corner_m[seen]
        centre_m = other_corner_m.mean(axis=1)
        radius_m = 0.5 * np.linalg.norm(other_corner_m[:, 7] - other_corner_m[:, 0], axis=1)
        found: set[tuple[int, int]] = set()
        for k in np.flatnonzero(seers) if seen.any() else ():
            to_m = centre_m - view[k][:3, 3]
            distance_m = np.linalg.norm(to_m, axis=1)
            near = distance_m <= _reach_m(model[k], radius_m, self.rules.housing)
            near &= self._may_be_in_image(model[k], view[k], to_m, distance_m, radius_m)
            near &= np.abs(other_corner_m - corner_m[k]).max(axis=(1, 2)) > 1e-9  # itself
            which = np.flatnonzero(near)
            if not len(which):
                continue
            share = hidden_share(model[k], np.linalg.inv(view[k]), other_corner_m[which])
            found |= {(int(row[k]), int(other_row[w])) for w in which[share > self.rules.housing]}
            meet = which[distance_m[which] <= radius_m[which] + radius_m.max()]
            if len(meet):
                pairs = np.repeat(corner_m[k][None], len(meet), axis=0)
                found |= {(int(row[k]), int(other_row[w])) for w in meet[boxes_meet(pairs, other_corner_m[meet])]}
        return found

    def _expanded(self, pose: np.ndarray) -> _Expanded:
        """All cameras of some rows, those of pairs twice: their row, pose in the ego frame, model and box."""
        rows, views, models, corners = [], [], [], []
        for side, row in self._sides(pose):
            own = pose[row] if side == 0 else pose[row] * MIRROR
            in_ego, model = self.cameras.sides[side].in_ego(own)
            module = self.cameras.mount.module_of(pose[row])
            rows += row.tolist()
            views.append(in_ego)
            models += model
            corners += [corners_m(view, self.cameras.mount.housings[m]) for view, m in zip(in_ego, module, strict=True)]
        return np.array(rows), np.concatenate(views), models, np.array(corners)

    @staticmethod
    def _may_be_in_image(
        model: CameraModel, view: np.ndarray, to_m: np.ndarray, distance_m: np.ndarray, radius_m: np.ndarray
    ) -> np.ndarray:
        """Whether balls may reach into an image: by the angle from its axis to its border."""
        half_rad = math.acos(max(least_cosine(model), -1.0))
        ahead = np.clip(to_m @ view[:3, 2] / np.maximum(distance_m, 1e-9), -1.0, 1.0)
        return np.arccos(ahead) <= half_rad + np.arcsin(np.clip(radius_m / np.maximum(distance_m, 1e-9), 0.0, 1.0))

    # ---------------------------------------------------------------------------------------------------- rows

    def rows(self, mount_pose: np.ndarray, *, absent: int = 0, free_from: int = 0) -> list[Row]:
        """The rules as rows of a selection of cameras [camera, 7]; the first ``free_from`` may break what they do."""
        rows = [
            row
            for row in self._every_row(mount_pose, absent=absent, free_from=free_from)
            if row.high > 0.0 or row.coefficient.any()
        ]
        return _without_implied(rows)

    def _every_row(self, mount_pose: np.ndarray, *, absent: int = 0, free_from: int = 0) -> list[Row]:
        measured = self._measured(mount_pose)
        rows = []
        for k, name in enumerate(ALONE):
            breaks = measured.breaks[:, k].copy()
            breaks[:free_from] = False
            rows.append(Row(f"rules.{name}", _padded(breaks, absent), high=0.0))
        if self.gap_steps is not None:
            for k, seen in enumerate(_windows(measured.ring, self.gap_steps).T):
                azimuth = math.degrees((k * AZIMUTH_STEP_RAD + math.pi) % (2.0 * math.pi) - math.pi)
                rows.append(Row(f"rules.azimuth_gap at {azimuth:g} deg", _padded(seen, absent), low=1.0))
        if self.near_level is not None:
            for k, seen in enumerate(measured.near[:, self.near_level].T):
                x_m, y_m = self._near_m[self.near_level, k, :2]
                rows.append(Row(f"rules.near_ground at ({x_m:.1f}, {y_m:.1f}) m", _padded(seen, absent), low=1.0))
        return rows

    def coefficients(self, mount_pose: np.ndarray, names: Sequence[str]) -> list[np.ndarray]:
        """Coefficients of cameras in rows of a selection, by the names of these, each float [camera]."""
        named = {row.name: row.coefficient for row in self._every_row(mount_pose)}
        return [named[name] for name in names]

    def keeps(self, mount_pose: np.ndarray, *, frozen: np.ndarray | None = None) -> bool:
        """Whether a rig keeps all rules. ``frozen`` bool [camera]: those that may break what they do."""
        measured = self._measured(mount_pose)
        free = np.ones(len(mount_pose), bool) if frozen is None else ~frozen
        if measured.breaks[free].any():
            return False
        if self.gap_steps is not None and not _windows(measured.ring, self.gap_steps).any(axis=0).all():
            return False
        if self.near_level is not None and not measured.near[:, self.near_level].any(axis=0).all():
            return False
        one, other = self.conflict(mount_pose).nonzero()
        return not (free[one] | free[other]).any()

    # ------------------------------------------------------------------------------------------------- margins

    def margins(self, mount_pose: np.ndarray) -> Margins:
        """Margins of cameras: own body, horizon, crossing, then the windows of the ring and the near ground.

        Returns float64 [camera, point] and the Jacobian to the mount poses, float64 [camera, point, 7].
        """
        pose = np.ascontiguousarray(mount_pose, np.float32)
        value, slope = self._of_side(0, pose)
        for side, row in self._sides(pose)[1:]:
            image, of_image = self._of_side(side, pose[row] * MIRROR)
            alone = np.arange(value.shape[1]) < 3
            is_other = np.where(alone, image < value[row], image > value[row])
            value[row] = np.where(is_other, image, value[row])
            slope[row] = np.where(is_other[..., None], of_image * MIRROR, slope[row])
        return value, slope

    def pair_edges(self, mount_pose: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inequalities ``spare + slope . move >= 0`` that keep housings out of images and from one another.

        Returns float64 [row] and [row, camera, 7]. ``reach`` float [camera, 7]: how far the cameras may move.
        """
        pose = np.ascontiguousarray(mount_pose, np.float32)
        if self.rules.housing is None or len(pose) < 2:
            return np.zeros(0), np.zeros((0, *pose.shape))
        camera, number = np.nonzero(reach > 0.0)
        moved = np.repeat(pose[None], 1 + 2 * len(camera), axis=0)
        for sign, first in ((1.0, 1), (-1.0, 2)):
            moved[np.arange(first, len(moved), 2), camera, number] += np.float32(sign * _STEP)
        value, *ends = self._clearances(moved)
        slope = np.zeros((len(value), *pose.shape))
        slope[:, camera, number] = _differences(np.array(ends).reshape(-1, 2, len(value))).T
        is_near = value - np.einsum("rck,ck->r", np.abs(slope), reach) < _CLEAR
        return np.maximum(value[is_near] - _CLEAR, 0.0), slope[is_near]

    def _clearances(self, rigs: np.ndarray) -> np.ndarray:
        """How far every box is outside of every other camera's image, as a share of its width; float64 [rig, pair].

        A box that is in the image already counts by the share that it may still fill, negative where that is too much.
        ``rigs`` float32 [rig, camera, 7]: the same cameras elsewhere.
        """
        assert self.rules.housing is not None
        row, view, models, corner_m = self._expanded(rigs.reshape(-1, MOUNT_POSE_SIZE))
        camera = np.argsort(row // rigs.shape[1], kind="stable").reshape(len(rigs), -1)  # of each rig
        seer, seen = (camera[:, each].ravel() for each in np.nonzero(~np.eye(camera.shape[1], dtype=bool)))
        share, margin = np.zeros(len(seer)), np.zeros(len(seer))
        for model in dict.fromkeys(models):
            pair = np.flatnonzero(np.array([each == model for each in models])[seer])
            by, box_m = view[seer[pair]], corner_m[seen[pair]]
            share[pair] = hidden_share(model, np.linalg.inv(by), box_m)
            margin[pair] = border_margin(by, [model] * len(pair), box_m).max(axis=1)
        left = (self.rules.housing - share) / self.rules.housing * _CLEAR
        return np.where(share > 0.0, left, _CLEAR + np.maximum(-margin, 0.0)).reshape(len(rigs), -1)

    @property
    def needed(self) -> np.ndarray:
        """How many cameras must keep each margin: all of them what they keep alone, one what a rig must see."""
        together = (0 if self.gap_steps is None else len(self._ring_m)) + (
            0 if self.near_level is None else self._near_m.shape[1]
        )
        return np.r_[np.full(3, 10**6), np.ones(together, int)]

    def _of_side(self, side: int, pose: np.ndarray) -> Margins:
        rules, cameras = self.rules, self.cameras.sides[side]
        views, models = cameras.in_ego(pose)
        middle_m = Body.of(self.vehicle).centre_m
        parts = [np.zeros((0, 3))]
        parts += [] if self.gap_steps is None else [self._ring_m]
        parts += [] if self.near_level is None else [self._near_m[self.near_level]]
        point_m = np.concatenate(parts)
        limit = np.array([own_body_limit(rules, model) for model in models])
        share, by_view = self._body_shares(side, pose, views, models)
        body = 1.0 + _MARGIN_SCALE * (limit - share)
        body_slope = placing_slope(cameras.mount, pose).chained(-_MARGIN_SCALE * by_view[:, None])

        def closed_forms(views: np.ndarray, models: Sequence[CameraModel]) -> np.ndarray:
            horizon = horizon_margin(views, models) - (-math.inf if rules.horizon is None else rules.horizon)
            crossing = crossing_angle_rad(views, middle_m) - (
                -math.inf if rules.crossing_rad is None else rules.crossing_rad
            )
            border = border_margin(views, models, point_m)
            return 1.0 + _MARGIN_SCALE * np.c_[np.minimum(horizon, 10.0), np.minimum(crossing, 10.0), border]

        value = closed_forms(views, models)
        step = np.float32(_STEP) * np.eye(MOUNT_POSE_SIZE, dtype=np.float32)
        step[LOG_ZOOM] *= self.cameras.mount.is_free[LOG_ZOOM]  # a panorama all round has no wider field
        moved = pose + np.stack([step, -step], axis=1)[:, :, None]
        ends = closed_forms(*cameras.in_ego(moved.reshape(-1, MOUNT_POSE_SIZE)))
        slope = np.moveaxis(_differences(ends.reshape(MOUNT_POSE_SIZE, 2, *value.shape)), 0, -1)
        if len(point_m):
            seen = sight(self._rig_cameras(side, pose, views, models), point_m, self._ground).seen
            value[:, 2:] = np.where(seen, value[:, 2:], np.minimum(value[:, 2:], 0.0))
        value, slope = self._joined(value, slope)
        return np.c_[body, value], np.concatenate([body_slope, slope], axis=1)

    def _joined(self, value: np.ndarray, slope: np.ndarray) -> Margins:
        """Margins of windows of the ring instead of its points: the greatest of each."""
        if self.gap_steps is None or self.gap_steps == 1:
            return value, slope
        count = len(self._ring_m)
        index = (np.arange(count)[:, None] + np.arange(self.gap_steps)) % count
        ring, ring_slope = value[:, 2 : 2 + count][:, index], slope[:, 2 : 2 + count][:, index]
        best = ring.argmax(axis=2)
        value, slope = value.copy(), slope.copy()
        value[:, 2 : 2 + count] = np.take_along_axis(ring, best[..., None], axis=2)[..., 0]
        slope[:, 2 : 2 + count] = np.take_along_axis(ring_slope, best[..., None, None], axis=2)[:, :, 0]
        return value, slope


def _differences(ends: np.ndarray) -> np.ndarray:
    """Slopes from values a `_STEP` ahead and behind, [..., 2, ...] on the second axis."""
    return (ends[:, 0] - ends[:, 1]) / (2.0 * _STEP)


def _windows(seen: np.ndarray, width: int) -> np.ndarray:
    """Whether one of so many directions in a row is seen, going round, bool [camera, direction]."""
    result = seen.copy()
    for k in range(1, width):
        result |= np.roll(seen, -k, axis=1)
    return result


def _padded(flag: np.ndarray, absent: int) -> np.ndarray:
    return np.append(flag.astype(np.float64), np.zeros(absent))


def _without_implied(rows: list[Row]) -> list[Row]:
    """Rows without those that have the same coefficients as another."""
    kept: dict[tuple[bytes, float], Row] = {}
    for row in rows:
        kept.setdefault((row.coefficient.tobytes(), row.high), row)
    return list(kept.values())


def _reach_m(model: CameraModel, radius_m: np.ndarray, share: float) -> np.ndarray:
    """How far balls can be and still fill so much of an image: twice that of the image's middle, as corners enlarge."""
    fx, fy = np.diag(model.intrinsics)[:2]
    return 2.0 * radius_m * np.sqrt(math.pi * fx * fy / (model.width_px * model.height_px * share))
