"""Design rules: what a rig must keep so that an engineer would mount it, measured on poses and the body alone.

No scene, traffic or detector takes part. Every measure is of cameras in the ego frame, given by their poses
``ego_from_camera`` [camera, 4, 4] and models; limits are those of `Rules`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import warp as wp

from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import KeptRenderers
from warpav.raster.frame import Frame
from warpav.raster.mesh import Mesh
from warpav.raster.pane import Pane
from warpav.raster.renderer import Renderer
from warpav.raster.scene import Scene as RasterScene
from warpav.rig import Housing, Rig, RigCamera, boxes_meet, corners_m, hidden_share
from warpav.sight._around import level_ground
from warpav.sight._requirement import Body
from warpav.sight._sight import seen_by_any

_WIDE_RAD = math.radians(150.0)
"""From this field of view on a camera is one for the near field, and may see more of the own body."""

AZIMUTH_STEP_RAD = math.radians(3.0)
"""Between the directions that are looked at."""

_RING_M = 15.0  # how far from the middle of the vehicle a road user must be in some image, whatever its direction [m]

_RING_HEIGHT_M = 0.75  # half the height of a car [m]

NEAR_M = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
"""Distances from the body from which on the ground may have to be seen [m]."""

SECTORS = 8
_IMAGE_PX, _VIEWS_AT_ONCE = 160, 8
"""Width of the images in which the own body is measured, and how many are drawn at once."""

SPARED = 1e-4
"""By how much a camera may break what it must keep alone, a share of an image or degrees: less is rounding."""

_MIDDLE_M = 0.3  # a camera nearer to the middle of the vehicle does not look across it [m]


@dataclass(frozen=True)
class Rules:
    """Limits; None: no such rule."""

    own_body: float | None = 0.3  # largest share of an image that the own body may fill
    own_body_wide: float | None = 0.6  # the same for cameras of `_WIDE_RAD` and more
    horizon: float | None = 0.1  # how far the horizon is below the top edge at least, as a share of the image's height
    # Widest gap of directions in which no camera sees a road user at `_RING_M` [rad]; of rigs with fields of view of
    # a whole turn together
    azimuth_gap_rad: float | None = AZIMUTH_STEP_RAD
    near_ground: bool = True  # whether the ground must be seen from as near to the body as the cameras can
    housing: float | None = 0.01  # largest share of an image that another camera's housing may fill
    # Least angle between where a camera looks and the way across the vehicle, from above [rad]
    crossing_rad: float | None = math.radians(60.0)
    # From how near to the body on the ground must be seen all round [m]; None: a search finds that out
    near_m: float | None = None


def horizon_margin(ego_from_camera: np.ndarray, models: Sequence[CameraModel]) -> np.ndarray:
    """How far the horizon straight ahead is below the top edge, as a share of the image's height, float64 [camera].

    Negative where it is above the image or the lens does not see it.
    """
    ahead = ego_from_camera[:, :2, 2]
    length = np.linalg.norm(ahead, axis=1, keepdims=True)
    ray = np.pad(ahead / np.maximum(length, 1e-12), ((0, 0), (0, 1)))[:, None]
    margin = np.full(len(models), -1.0)
    for model, row in _by_model(models):
        row_px = _projected(model, ray[row] @ ego_from_camera[row, :3, :3])[:, 0, 1]
        margin[row] = np.nan_to_num(row_px / model.height_px, nan=-1.0, posinf=-1.0, neginf=-1.0)
    return np.where(length[:, 0] < 1e-6, -1.0, margin)


def _by_model(models: Sequence[CameraModel]) -> list[tuple[CameraModel, np.ndarray]]:
    """The cameras of each model, int [camera of the model]."""
    return [(each, np.flatnonzero([model == each for model in models])) for each in dict.fromkeys(models)]


def _projected(model: CameraModel, point_m: np.ndarray) -> np.ndarray:
    """Places of points [..., 3] in an image [px], [..., 2]; not finite where the lens does not see them."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return model.project(point_m)


def crossing_angle_rad(ego_from_camera: np.ndarray, middle_m: np.ndarray) -> np.ndarray:
    """Angle between where cameras look and the way across the vehicle, from above [rad], float64 [camera].

    The way across is the line to the vehicle's middle, and for cameras on a side straight to the other side: the lesser
    angle counts. A camera so near to the middle, or to the plane of symmetry, that nothing is across has pi.
    ``middle_m`` [2].
    """
    look, there = ego_from_camera[:, :2, 2], middle_m - ego_from_camera[:, :2, 3]
    look = look / np.maximum(np.linalg.norm(look, axis=1, keepdims=True), 1e-12)
    result = np.full(len(look), math.pi)
    for across in (there, there * [0.0, 1.0]):
        distance_m = np.linalg.norm(across, axis=1)
        cosine = np.einsum("ci,ci->c", look, across) / np.maximum(distance_m, 1e-12)
        angle_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
        result = np.where(distance_m > _MIDDLE_M, np.minimum(result, angle_rad), result)
    return result


def border_margin(ego_from_camera: np.ndarray, models: Sequence[CameraModel], point_m: np.ndarray) -> np.ndarray:
    """How far points are inside the images, as a share of the image's width; negative outside, float64 [camera, point].

    -1 where the lens does not see a point. ``point_m`` [point, 3], or of each camera [camera, point, 3].
    """
    margin = np.full((len(models), point_m.shape[-2]), -1.0)
    for model, row in _by_model(models):
        pose, own_m = ego_from_camera[row], point_m[row if point_m.ndim > 2 else ...]
        place_px = _projected(model, (own_m - pose[:, None, :3, 3]) @ pose[:, :3, :3])
        edge_px = np.minimum(place_px, np.array([model.width_px, model.height_px]) - place_px).min(axis=-1)
        margin[row] = np.nan_to_num(edge_px / model.width_px, nan=-1.0, posinf=-1.0, neginf=-1.0)
    return margin


def housing_shares(
    ego_from_camera: np.ndarray, models: Sequence[CameraModel], housings: Sequence[Housing]
) -> tuple[np.ndarray, np.ndarray]:
    """Share of each camera's image behind each other's housing, and which housings meet; both [camera, camera]."""
    count = len(models)
    corner_m = np.array([corners_m(pose, each) for pose, each in zip(ego_from_camera, housings, strict=True)])
    share = np.zeros((count, count))
    for k, (pose, model) in enumerate(zip(ego_from_camera, models, strict=True)):
        others = np.arange(count) != k
        share[k, others] = hidden_share(model, np.linalg.inv(pose), corner_m[others])
    one, other = np.triu_indices(count, 1)
    meets = np.zeros((count, count), bool)
    meets[one, other] = boxes_meet(corner_m[one], corner_m[other])
    return share, meets | meets.T


class OwnBody:
    """A vehicle as its own cameras see it, drawn alone. ``vehicle`` in the ego frame [m]."""

    def __init__(self, vehicle: Mesh, *, device: str = "cpu") -> None:
        self.vehicle, self.device = vehicle, device
        self._scene = RasterScene({"body": vehicle}, device=device)
        self._renderers = KeptRenderers()

    def shares(self, ego_from_camera: np.ndarray, models: Sequence[CameraModel]) -> tuple[np.ndarray, np.ndarray]:
        """Share of each image that the body fills, float64 [camera], and its Jacobian, float64 [camera, 7].

        The Jacobian is that of `warpav.raster.areas.Areas.jacobian`.
        """
        pose = np.asarray(ego_from_camera, np.float64)
        share, jacobian = np.zeros(len(models)), np.zeros((len(models), 7))
        drawn = [
            model.resized(_IMAGE_PX, max(8, round(model.height_px * _IMAGE_PX / model.width_px))) for model in models
        ]
        for size in dict.fromkeys((model.width_px, model.height_px) for model in drawn):
            group = np.flatnonzero([(model.width_px, model.height_px) == size for model in drawn])
            pixels = size[0] * size[1]
            for first in range(0, len(group), _VIEWS_AT_ONCE):
                row = group[first : first + _VIEWS_AT_ONCE]
                # the last ones are filled up with the last camera, to a power of two
                view = row[np.minimum(np.arange(1 << (len(row) - 1).bit_length()), len(row) - 1)]
                areas = self._frame(size, [drawn[k] for k in view], pose[view]).areas()
                share[row] = areas.visible.numpy()[: len(row), 0] / pixels
                jacobian[row] = areas.jacobian.numpy()[: len(row), 0] / pixels
        return share, jacobian

    def _frame(self, size: tuple[int, int], lenses: list[CameraModel], pose: np.ndarray) -> Frame:
        [renderer] = self._renderers.of((*size, len(lenses)), lambda: [Renderer(lenses, device=self.device)])
        renderer.set_lenses(lenses)
        return renderer.render(
            self._scene,
            wp.array(pose[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=self.device),
            wp.array(pose[:, :3, :3].transpose(0, 2, 1).astype(np.float32), dtype=wp.mat33, device=self.device),
            content=Content.MEASURES,
        )


@lru_cache(maxsize=8)
def own_body(vehicle: Mesh, pane: Pane | None, device: str) -> OwnBody:
    """A vehicle as cameras behind a pane see it; None: not behind glass."""
    return OwnBody(vehicle if pane is None else pane.opened(vehicle), device=device)


@dataclass(frozen=True)
class RuleMargin:
    """How far a rig is from breaking a rule."""

    rule: str
    cameras: tuple[str, ...]
    value: float | None  # None: nowhere
    limit: float | None  # None: any value will do
    unit: str
    is_kept: bool
    asked: float | None = None  # the limit that was asked for, where a search has widened it
    price: float | None = None  # what that would have cost of the objective, a share; None: no rig keeps it


class RuleCheck:
    """A rig and the rules: its margins, the worst camera or pair of each rule.

    ``vehicle`` in the ego frame [m].
    """

    def __init__(self, rig: Rig, vehicle: Mesh, rules: Rules | None = None, *, device: str = "cpu") -> None:
        self.rig, self.vehicle, self.rules = rig, vehicle, rules or Rules()
        self.device = device
        self._pose = np.stack([camera.ego_from_camera for camera in rig.cameras])
        self._models = [camera.model for camera in rig.cameras]
        self._names = [camera.name for camera in rig.cameras]

    @cached_property
    def margins(self) -> tuple[RuleMargin, ...]:
        """The margin of every rule that is on."""
        rules, found = self.rules, list[RuleMargin]()
        if rules.own_body is not None or rules.own_body_wide is not None:
            limits = np.array([own_body_limit(rules, model) for model in self._models])
            share = np.array([self._body_share(camera) for camera in self.rig.cameras])
            found.append(self._worst("own_body", share, limits, "of the image", most=True))
        if rules.horizon is not None:
            margin = horizon_margin(self._pose, self._models)
            found.append(self._worst("horizon", margin, np.full(len(margin), rules.horizon), "of the image's height"))
        if rules.crossing_rad is not None:
            angle = np.degrees(crossing_angle_rad(self._pose, Body.of(self.vehicle).centre_m))
            limit = np.full(len(angle), math.degrees(rules.crossing_rad))
            found.append(self._worst("crossing", angle, limit, "deg"))
        if rules.housing is not None and len(self._models) > 1:
            share, meets = housing_shares(self._pose, self._models, [camera.housing for camera in self.rig.cameras])
            share[meets] = 1.0
            seer, other = np.unravel_index(share.argmax(), share.shape)
            names = (self._names[int(seer)], self._names[int(other)])
            value = float(share.max())
            found.append(RuleMargin("housing", names, value, rules.housing, "of the image", value <= rules.housing))
        goes_round = sum(model.fov_rad for model in self._models) >= 2.0 * math.pi - 1e-6
        if rules.azimuth_gap_rad is not None and goes_round:
            gap = math.degrees(self.azimuth_gap_rad)
            limit = math.degrees(rules.azimuth_gap_rad)
            found.append(RuleMargin("azimuth_gap", (), gap, limit, "deg", gap <= limit + 1e-9))
        if rules.near_ground:
            near_m = float(self.near_m.max())
            kept = rules.near_m is None or near_m <= rules.near_m
            value = near_m if math.isfinite(near_m) else None
            found.append(RuleMargin("near_ground", (), value, rules.near_m, "m", kept))
        return tuple(found)

    def _worst(self, rule: str, value: np.ndarray, limit: np.ndarray, unit: str, *, most: bool = False) -> RuleMargin:
        slack = limit - value if most else value - limit
        k = int(slack.argmin())
        return RuleMargin(rule, (self._names[k],), float(value[k]), float(limit[k]), unit, bool(slack[k] >= -SPARED))

    def _body_share(self, camera: RigCamera) -> float:
        body = own_body(self.vehicle, camera.behind_glass, self.device)
        return float(body.shares(camera.ego_from_camera[None], [camera.model])[0][0])

    @cached_property
    def azimuth_gap_rad(self) -> float:
        """The widest gap of directions in which no camera sees the ring [rad]."""
        ground = level_ground(self.vehicle, device=self.device)
        return widest_gap(seen_by_any(self.rig, ring_m(self.vehicle), ground)) * AZIMUTH_STEP_RAD

    @cached_property
    def near_m(self) -> np.ndarray:
        """From how near to the body the ground is seen in each sector, the first ahead [m], float64 [sector]."""
        scene = level_ground(self.vehicle, device=self.device)
        result = np.full(SECTORS, np.inf)
        for distance_m in reversed(NEAR_M):
            seen = seen_by_any(self.rig, near_ring_m(self.vehicle, distance_m), scene)
            whole = seen.reshape(SECTORS, -1).all(axis=1)
            result = np.where(whole, distance_m, np.where(np.isfinite(result), result, np.inf))
            if not whole.any():
                break
        return result


def own_body_limit(rules: Rules, model: CameraModel) -> float:
    """The share of the own body that a camera may see."""
    limit = rules.own_body_wide if model.fov_rad >= _WIDE_RAD else rules.own_body
    return 1.0 if limit is None else limit


def widest_gap(seen: np.ndarray) -> int:
    """The most directions in a row, going round, that are not seen. ``seen`` bool [direction]."""
    if seen.all():
        return 0
    if not seen.any():
        return len(seen)
    first = int(np.flatnonzero(seen)[0])
    place = np.flatnonzero(np.append(np.roll(seen, -first), True))
    return int(np.diff(place).max()) - 1


def ring_m(vehicle: Mesh) -> np.ndarray:
    """Points all round a vehicle where a road user must be in some image [m], float64 [direction, 3]; first ahead."""
    azimuth_rad = np.arange(round(2.0 * math.pi / AZIMUTH_STEP_RAD)) * AZIMUTH_STEP_RAD
    place_m = Body.of(vehicle).centre_m + _RING_M * np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=1)
    return np.pad(place_m, ((0, 0), (0, 1)), constant_values=_RING_HEIGHT_M)


def near_ring_m(vehicle: Mesh, distance_m: float) -> np.ndarray:
    """Points of the ground so far from the body, three a sector [m], float64 [direction, 3]; the first sector ahead."""
    azimuth_rad = (np.arange(3 * SECTORS) - 1.0) * 2.0 * math.pi / (3 * SECTORS)
    border_m = Body.of(vehicle).border_m(azimuth_rad)
    outwards = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=1)
    return np.pad(border_m + distance_m * outwards, ((0, 0), (0, 1)))
