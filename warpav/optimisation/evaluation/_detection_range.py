"""Detection range of a rig: up to which distance a detector is expected to find an unoccluded road user, by azimuth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from warpav.detection import CONTRAST, VISIBLE_SIZE, DetectionProbability, whole_objects
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.raster.renderer import Renderer
from warpav.rig import Rig, RigCamera
from warpav.scene import Box, DeviceScene, Scene, Vehicle, person_mesh, road_user_of, vehicle_mesh
from warpav.sight import is_in_image

_CATEGORIES = ("saloon", "van", "bus", "pedestrian", "cyclist")
"""Road users that are asked for, as far as the detector's fit knows their kind."""

_DISTANCES_M = tuple(float(each) for each in np.geomspace(5.0, 500.0, 18))
_AZIMUTH_COUNT = 72

LEAST_HEIGHT_PX = 8.0
"""Height of an image, in pixels of the network's input, below which no probability is promised.

A fit records which visible areas it has seen, those of road users that are nearly hidden among them, but not the
heights of whole ones: of a car on its own the smallest area would be two pixels high.
"""

_WIDTH_PX_MAX = 400
_SUPERSAMPLING = 2
_GREY = (0.18, 0.18, 0.18)
_PERSON_M = 1.75
_VIEWS_AT_ONCE = 24


@dataclass(frozen=True, eq=False)
class DetectionRange:
    """How probable it is that the best camera of a rig finds a road user, by category, azimuth and distance.

    Attributes:
        probability: Of the best camera, 0..1, float64 [category, azimuth, distance].
        size: Of the image in the camera that shows it largest, over the smallest that the model speaks for: it is
            `LEAST_HEIGHT_PX` high, and not less than the smallest visible area of the fit; 0: in no image. float64
            [category, azimuth, distance]; None: all are large enough.
    """

    categories: tuple[str, ...]
    azimuth_rad: np.ndarray
    distances_m: tuple[float, ...]
    probability: np.ndarray
    size: np.ndarray | None = None

    @classmethod
    def of(
        cls,
        rig: Rig,
        ego: Mesh,
        *,
        probability: Callable[[CameraModel], DetectionProbability] = DetectionProbability.builtin,
        categories: Sequence[str] | None = None,
        distances_m: Sequence[float] = _DISTANCES_M,
        azimuth_count: int = _AZIMUTH_COUNT,
        device: str = "cpu",
    ) -> DetectionRange:
        """Ask the model of detection probability about road users all around.

        Each stands alone on level ground and heads as the own vehicle does; neither traffic nor the own body hides it,
        and its colours have the contrast that adds nothing to the model's logit, that of an average object.

        Args:
            ego: The vehicle in the ego frame [m].
        """
        models = {model: probability(model) for model in dict.fromkeys(camera.model for camera in rig.cameras)}
        targets = models[rig.cameras[0].model].record.get("settings", {}).get("scenes", {}).get("targets", ("vehicle",))
        asked = [name for name in _CATEGORIES if road_user_of(name) in targets] if categories is None else categories
        azimuth_rad = np.arange(azimuth_count) * 2.0 * math.pi / azimuth_count
        middle_m = np.asarray(ego.bounds_m(), np.float64)[:, :2].mean(axis=0)
        across = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=-1)
        place_m = middle_m + np.asarray(distances_m)[:, None, None] * across
        best, size = np.zeros((2, len(asked), azimuth_count, len(distances_m)))
        scenes = [_alone(category, device) for category in asked]
        for camera in rig.cameras:
            drawn = _drawn(camera.model)
            renderer = Renderer([drawn] * _VIEWS_AT_ONCE, supersampling=_SUPERSAMPLING, device=device)
            for row, scene in enumerate(scenes):
                found = _probabilities(camera, drawn, renderer, scene, place_m.reshape(-1, 2), models[camera.model])
                for whole, one in zip((best, size), found, strict=True):
                    whole[row] = np.maximum(whole[row], one.reshape(len(distances_m), azimuth_count).T)
        return cls(tuple(asked), azimuth_rad, tuple(distances_m), best, size)

    def range_m(self, least: float) -> np.ndarray:
        """The largest distance at which the probability is at least so much.

        Between two distances the logit is taken to be linear in the logarithm of the distance.

        Returns:
            float64 [category, azimuth] [m]; 0: at none of the distances. It is at most the last of them.
        """
        return self._last_m(_logit(self.probability) - _logit(np.array(least)))

    def limit_m(self) -> np.ndarray:
        """The largest distance at which the image is as large as the model speaks for; beyond it, it is extrapolated.

        Returns:
            float64 [category, azimuth] [m]; 0: at none of the distances. It is at most the last of them.
        """
        if self.size is None:
            return np.full(self.probability.shape[:2], self.distances_m[-1])
        return self._last_m(np.log(np.maximum(self.size, 1e-9)))

    def _last_m(self, margin: np.ndarray) -> np.ndarray:
        """The last distance at which a margin [category, azimuth, distance] is not negative; see `range_m`."""
        holds = margin >= 0.0
        last = len(self.distances_m) - 1 - holds[..., ::-1].argmax(axis=-1)
        following = np.minimum(last + 1, len(self.distances_m) - 1)
        above, below = (np.take_along_axis(margin, at[..., None], axis=-1)[..., 0] for at in (last, following))
        share = np.where(following > last, above / np.maximum(above - below, 1e-12), 0.0)
        log_m = np.log(self.distances_m)
        found_m = np.exp(log_m[last] + share * (log_m[following] - log_m[last]))
        return np.where(holds.any(axis=-1), found_m, 0.0)


def _logit(probability: np.ndarray) -> np.ndarray:
    bounded = np.clip(probability, 1e-9, 1.0 - 1e-9)
    return np.log(bounded / (1.0 - bounded))


def _alone(category: str, device: str) -> DeviceScene:
    """A road user of a category on the ground, its middle above the origin, and nothing else near."""
    if road_user_of(category) == "vehicle":
        mesh = vehicle_mesh(category, np.array(_GREY), coarse=True)
    else:
        mesh = person_mesh(category, np.random.default_rng(0), height_m=_PERSON_M, coarse=True)
    low_m, high_m = np.asarray(mesh.bounds_m(), np.float64)
    offset_m = np.array([*(-0.5 * (low_m + high_m)[:2]), -low_m[2]])
    mesh = Mesh((mesh.vertex_m + offset_m).astype(np.float32), mesh.triangle, mesh.vertex_rgb)
    size_m = high_m - low_m
    user = Vehicle(1, category, mesh, Box(np.array([0.0, 0.0, 0.5 * size_m[2]]), size_m, 0.0))
    far = Mesh.create([[0, 0, -1e4], [1, 0, -1e4], [0, 1, -1e4]], [[0, 1, 2]], (0, 0, 0))
    return DeviceScene.pack(Scene(category, far, far, (user,)), device=device)


def _drawn(model: CameraModel) -> CameraModel:
    """The camera as it is drawn: wide images with fewer pixels."""
    shrink = min(1.0, _WIDTH_PX_MAX / model.width_px)
    return model.resized(max(round(model.width_px * shrink), 8), max(round(model.height_px * shrink), 8))


def _probabilities(
    camera: RigCamera,
    drawn: CameraModel,
    renderer: Renderer,
    scene: DeviceScene,
    place_m: np.ndarray,
    model: DetectionProbability,
) -> tuple[np.ndarray, np.ndarray]:
    """The probability that the camera's detector finds the object of a scene at places, x and y [m], and its size.

    Both are float64 [place], the size as in `DetectionRange`. The object stays and the camera is moved, so that the
    scene is made once. A pixel of the drawn image counts for as many of the network's as it stands for.
    """
    device = scene.raster.device
    per_px_down = model.network_scale[1]
    scale = [
        per_px * full_px / drawn_px
        for per_px, full_px, drawn_px in zip(
            model.network_scale,
            (camera.model.width_px, camera.model.height_px),
            (drawn.width_px, drawn.height_px),
            strict=True,
        )
    ]
    model = replace(model, network_scale=(scale[0], scale[1]))
    found, area_px = np.zeros((2, len(place_m)))
    asked = np.flatnonzero(_reaches_image(camera, place_m, scene))
    count = renderer.view_count
    pose = camera.ego_from_camera
    turn = np.tile(pose[:3, :3].T.astype(np.float32), (count, 1, 1))
    camera_from_ego = wp.array(turn, dtype=wp.mat33, device=device)
    contrast = wp.full((count, 1), average_contrast(model), dtype=float, device=device)
    for first in range(0, len(asked), count):
        shown = asked[np.minimum(np.arange(first, first + count), len(asked) - 1)]  # the last one fills up
        centre_m = pose[:3, 3] - np.column_stack([place_m[shown], np.zeros(count)])
        position_m = wp.array(centre_m.astype(np.float32), dtype=wp.vec3, device=device)
        frame = renderer.render(scene.raster, position_m, camera_from_ego, content=Content.COVERAGE)
        covered = frame.coverage()
        seen = model.of_measures(
            covered.value,
            covered.solid_angle_sr,
            whole_objects(position_m, camera_from_ego, frame.lens, scene.upright_box, scene.kind),
            contrast,
            width_px=drawn.width_px,
            height_px=drawn.height_px,
        )
        found[shown] = seen.probability.numpy()[:, 0]
        area_px[shown] = np.expm1(seen.feature.numpy()[:, 0, VISIBLE_SIZE].astype(np.float64))
    least_px = math.expm1(max(model.start[VISIBLE_SIZE], 0.0))
    by_area = np.sqrt(area_px / max(least_px, 1e-9))
    height_m = 2.0 * float(scene.upright_box.half_size_m.numpy()[0, 2])
    by_height = _height_px(camera, place_m, height_m) * per_px_down / LEAST_HEIGHT_PX
    return found, np.where(found > 0.0, np.minimum(by_area, by_height), 0.0)


def _height_px(camera: RigCamera, place_m: np.ndarray, height_m: float) -> np.ndarray:
    """Distance of the images of foot and top of something upright at places, float64 [place]; inf: one has none."""
    pose = camera.ego_from_camera
    end_px = [
        camera.model.project((np.column_stack([place_m, np.full(len(place_m), z_m)]) - pose[:3, 3]) @ pose[:3, :3])
        for z_m in (0.0, height_m)
    ]
    return np.nan_to_num(np.linalg.norm(end_px[1] - end_px[0], axis=-1), nan=np.inf)


def _reaches_image(camera: RigCamera, place_m: np.ndarray, scene: DeviceScene) -> np.ndarray:
    """Whether some of 5 x 5 x 3 points of the object's box are in the image, by place, bool [place]."""
    half_m = scene.upright_box.half_size_m.numpy()[0].astype(np.float64)
    along = np.linspace(-1.0, 1.0, 5)
    corner = np.stack(np.meshgrid(along, along, np.linspace(0.0, 2.0, 3), indexing="ij"), axis=-1).reshape(-1, 3)
    length, width = (half_m[0], half_m[1]) if abs(scene.upright_box.along.numpy()[0, 0]) > 0.5 else half_m[1::-1]
    point_m = corner * [length, width, half_m[2]] + np.column_stack([place_m, np.zeros(len(place_m))])[:, None]
    return np.asarray(is_in_image(camera, point_m).any(axis=1))


def average_contrast(model: DetectionProbability) -> float:
    """The contrast that adds nothing to the logit, as it does in the mean over the objects of the fit, 0..3**0.5."""
    contrast = np.linspace(0.0, math.sqrt(3.0), 1001)
    return float(contrast[np.abs(model.curve(CONTRAST, contrast)).argmin()])
