"""How a rig is fitted to its vehicle: what its cameras see around the vehicle alone, on level ground.

No street, no traffic and no detector take part: each number follows from the lenses, the poses and the body. Azimuths
are 0 ahead and positive to the left; where they start from the middle of the vehicle, that is the middle of its bounds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import warp as wp

from warpav.raster.buffers import Content
from warpav.raster.mesh import Mesh
from warpav.raster.renderer import Renderer
from warpav.raster.scene import BACKGROUND_ID
from warpav.raster.scene import Scene as RasterScene
from warpav.rig import Rig, RigCamera
from warpav.scene import DeviceScene, Scene
from warpav.sight._requirement import Body
from warpav.sight._sight import is_in_image, seen_by_any, sight

CAR_HEIGHT_M = 1.5
"""Of the car whose image is measured [m]."""

PIXELS = (40.0, 20.0, 12.0)
"""Heights of its image [px]: easily recognised, recognised, at the limit of most detectors."""

_HEIGHTS_M = (0.0, 0.6, 1.1)
"""Of what has to be seen near the vehicle [m]: the ground, something small, the top of a child's head."""

_BAND_EDGES_M = (3.0, 5.0, 7.5, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0, 50.0, 60.0, 80.0, 100.0, 150.0, 200.0)
_SECTOR_COUNT = 36

_NEAREST_M, _FARTHEST_M, _DISTANCE_COUNT = 0.2, 1000.0, 96
_BISECTIONS = 20
_BELOW_M = 1.0  # of the ground that stands there for the rays, so that points at height 0 are free
_TURN_RAD = 1e-4


@lru_cache(maxsize=4)
def level_ground(ego: Mesh, *, device: str = "cpu") -> DeviceScene:
    """The vehicle with nothing around it, in which points from the height of the ground upwards are free."""
    side_m, below_m = 1e3, -_BELOW_M
    corner_m = [[side_m * x, side_m * y, below_m] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    ground = Mesh.create(corner_m, [[0, 1, 2], [0, 2, 3]], (128, 128, 128))
    return DeviceScene.pack(Scene("level ground", ground, ego, ()), device=device)


# ------------------------------------------------------------------------------------------------- size of an image


def upright_px(camera: RigCamera, foot_m: np.ndarray, height_m: float) -> np.ndarray:
    """Height of the image of something upright on level ground [px]; inf where an end is beyond the lens, 0 outside."""

    def at(z_m: float) -> np.ndarray:
        return np.concatenate([foot_m, np.full((*foot_m.shape[:-1], 1), z_m)], axis=-1)

    pose = camera.ego_from_camera
    in_camera_m = ((at(z_m) - pose[:3, 3]) @ pose[:3, :3] for z_m in (0.0, height_m))
    with np.errstate(invalid="ignore"):
        foot_px, top_px = map(camera.model.project, in_camera_m)
    size_px = np.nan_to_num(np.linalg.norm(top_px - foot_px, axis=-1), nan=np.inf)
    return np.where(is_in_image(camera, at(0.5 * height_m)), size_px, 0.0)


def size_ranges_m(
    camera: RigCamera, azimuth_rad: np.ndarray, *, pixels: Sequence[float] = PIXELS, height_m: float = CAR_HEIGHT_M
) -> np.ndarray:
    """Nearest and farthest distance at which something upright is ``pixels`` high, by direction; NaN: none up to 1 km.

    From the camera over the ground [m], where its middle is in the image, float64 [pixels, direction, 2].
    """
    across = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=-1)
    foot_m = np.asarray(camera.position_m, np.float64)[:2]

    def size_px(distance_m: np.ndarray) -> np.ndarray:
        return upright_px(camera, foot_m + distance_m[..., None] * across, height_m)

    tried_m = np.geomspace(_NEAREST_M, _FARTHEST_M, _DISTANCE_COUNT)
    found_px = size_px(np.broadcast_to(tried_m[:, None], (_DISTANCE_COUNT, len(across))))
    least_px = np.reshape(pixels, (-1, 1))
    is_large = np.asarray(found_px >= least_px[..., None])  # [pixels, distance, direction]
    first, last = is_large.argmax(axis=1), _DISTANCE_COUNT - 1 - is_large[:, ::-1].argmax(axis=1)
    outside = np.clip([first - 1, last + 1], 0, _DISTANCE_COUNT - 1)
    edges_m = _edge(lambda distance_m: size_px(distance_m) >= least_px, tried_m[[first, last]], tried_m[outside])
    has_any = np.asarray(is_large.any(axis=1))
    return np.where(has_any[..., None], np.moveaxis(edges_m, 0, -1), np.nan)


def px_per_degree(camera: RigCamera, direction: np.ndarray) -> np.ndarray:
    """Square root of a camera's pixels per square degree along directions; ``f pi / 180`` on a pinhole's axis."""
    level = np.stack([-direction[..., 1], direction[..., 0], 0.0 * direction[..., 0]], axis=-1)
    level /= np.linalg.norm(level, axis=-1, keepdims=True)
    turn = camera.ego_from_camera[:3, :3]
    moved_px = [
        [camera.model.project((direction + sign * 0.5 * _TURN_RAD * side) @ turn) for sign in (1.0, -1.0)]
        for side in (level, np.cross(direction, level))
    ]
    with np.errstate(invalid="ignore"):
        (a, b), (c, d) = (np.moveaxis((ahead - behind) / _TURN_RAD, -1, 0) for ahead, behind in moved_px)
        density = math.radians(1.0) * np.sqrt(np.abs(a * d - b * c))
    is_seen = is_in_image(camera, camera.position_m + direction)
    return np.where(is_seen & np.isfinite(density), density, 0.0)


# ---------------------------------------------------------------------------------------------- beside the body


@dataclass(frozen=True, eq=False)
class NearField:
    """How far from the body the first point is that some camera sees, by direction."""

    heights_m: tuple[float, ...]
    azimuth_rad: np.ndarray
    border_m: np.ndarray  # where each leaves the outline of the vehicle [m], float64 [direction, 2]
    # From there on outwards to the first visible point [m], float64 [height, direction]; inf: none up to
    # ``reach_m``
    distance_m: np.ndarray
    reach_m: float

    @classmethod
    def of(
        cls,
        rig: Rig,
        ego: Mesh,
        *,
        heights_m: Sequence[float] = _HEIGHTS_M,
        reach_m: float = 10.0,
        direction_count: int = 240,
        device: str = "cpu",
    ) -> NearField:
        """Look along every direction in steps of 5 cm, then by bisection; lines of sight end at the body."""
        scene = level_ground(ego, device=device)
        azimuth_rad = np.arange(direction_count) * 2.0 * math.pi / direction_count
        border_m = Body.of(ego).border_m(azimuth_rad)
        outwards = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=-1)
        tried_m = np.linspace(0.0, reach_m, 1 + math.ceil(reach_m / 0.05))

        def is_seen(distance_m: np.ndarray) -> np.ndarray:
            """Of points at every height that far along each direction, [height, ..., direction]."""
            place_m = border_m + distance_m[..., None] * outwards
            height_m = np.reshape(heights_m, (-1, *(1,) * (distance_m.ndim - 1)))
            point_m = np.concatenate([place_m, np.broadcast_to(height_m, distance_m.shape)[..., None]], axis=-1)
            return seen_by_any(rig, point_m, scene)

        shape = len(heights_m), len(tried_m), direction_count
        seen = is_seen(np.broadcast_to(tried_m[:, None], shape))
        first = seen.argmax(axis=1)
        found_m = _edge(is_seen, tried_m[first], tried_m[np.maximum(first - 1, 0)])
        distance_m = np.where(seen.any(axis=1), np.where(first == 0, 0.0, found_m), np.inf)
        return cls(tuple(heights_m), azimuth_rad, border_m, distance_m, reach_m)

    def toward(self, azimuth_deg: float) -> int:
        """The direction nearest to an azimuth."""
        return round(azimuth_deg / 360.0 * len(self.azimuth_rad)) % len(self.azimuth_rad)

    def worst(self, height: int = 0) -> int:
        """The direction with the largest distance at a height."""
        return int(self.distance_m[height].argmax())


@dataclass(frozen=True, eq=False)
class VisibleGround:
    """Level ground near the vehicle: how many cameras see it, and in how many images it would be without the body."""

    x_m: np.ndarray
    y_m: np.ndarray
    is_body: np.ndarray  # cells below the vehicle, bool [row, column]
    in_image: np.ndarray  # number of cameras in whose image a cell is, int64 [row, column]
    seen: np.ndarray  # number of cameras that see it past the body, int64 [row, column]

    @classmethod
    def of(cls, rig: Rig, ego: Mesh, *, margin_m: float, cell_m: float = 0.1, device: str = "cpu") -> VisibleGround:
        """Of the ground up to a distance from the bounds of the vehicle."""
        scene = level_ground(ego, device=device)
        low_m, high_m = np.asarray(ego.bounds_m(), np.float64)[:, :2]
        x_m, y_m = (
            np.arange(low - margin_m + 0.5 * cell_m, high + margin_m, cell_m)
            for low, high in zip(low_m, high_m, strict=True)
        )
        place_m = np.stack(np.meshgrid(x_m, y_m, indexing="ij"), axis=-1)
        is_body = Body.of(ego).contains(place_m)
        point_m = np.concatenate([place_m, np.zeros((*is_body.shape, 1))], axis=-1)[~is_body]
        in_image, seen = np.zeros(is_body.shape, np.int64), np.zeros(is_body.shape, np.int64)
        found = sight(rig, point_m, scene)
        in_image[~is_body], seen[~is_body] = found.in_image.sum(axis=0), found.count
        return cls(x_m, y_m, is_body, in_image, seen)

    @property
    def is_shadow(self) -> np.ndarray:
        """Ground in some image that no camera sees, because the body stands in the way; bool [row, column]."""
        return ~self.is_body & (self.in_image > 0) & (self.seen == 0)

    @property
    def is_outside(self) -> np.ndarray:
        """Ground in no image; bool [row, column]."""
        return ~self.is_body & (self.in_image == 0)

    def area_m2(self, flag: np.ndarray) -> float:
        """Area of some of the cells [m²]."""
        return float(flag.sum() * (self.x_m[1] - self.x_m[0]) * (self.y_m[1] - self.y_m[0]))


# ------------------------------------------------------------------------------------------------ how many cameras


@dataclass(frozen=True, eq=False)
class SectorCounts:
    """How many cameras see a road user, by sector and distance band around the middle of the vehicle."""

    camera: tuple[str, ...]
    edges_m: tuple[float, ...]
    is_body: np.ndarray  # whether the middle of a cell is within the vehicle, bool [sector, band]
    sees: np.ndarray  # whether a camera sees a road user there, bool [camera, sector, band]

    @classmethod
    def of(
        cls,
        rig: Rig,
        ego: Mesh,
        *,
        sector_count: int = _SECTOR_COUNT,
        edges_m: Sequence[float] = _BAND_EDGES_M,
        least_px: float = PIXELS[-1],
        device: str = "cpu",
    ) -> SectorCounts:
        """Ask every camera about a road user in the middle of every cell; the first sector is centred ahead.

        It sees one where the point at half the height of a car is in its image, free of the own body, and the car large
        enough.
        """
        scene, body = level_ground(ego, device=device), Body.of(ego)
        azimuth_rad = np.arange(sector_count) * 2.0 * math.pi / sector_count
        distance_m = 0.5 * (np.asarray(edges_m)[1:] + np.asarray(edges_m)[:-1])
        across = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=-1)
        foot_m = body.centre_m + distance_m[:, None] * across[:, None]
        point_m = np.concatenate([foot_m, np.full((*foot_m.shape[:2], 1), 0.5 * CAR_HEIGHT_M)], axis=-1)
        is_large = [upright_px(camera, foot_m, CAR_HEIGHT_M) >= least_px for camera in rig.cameras]
        seen = sight(rig, point_m, scene).seen & np.stack(is_large)
        return cls(tuple(camera.name for camera in rig.cameras), tuple(edges_m), body.contains(foot_m), seen)

    def within(self, bands: int) -> SectorCounts:
        """The first bands alone."""
        return SectorCounts(self.camera, self.edges_m[: bands + 1], self.is_body[:, :bands], self.sees[..., :bands])

    @cached_property
    def count(self) -> np.ndarray:
        """Number of cameras that see a road user, int64 [sector, band]; -1 within the vehicle."""
        return np.where(self.is_body, -1, self.sees.sum(axis=0))

    def without(self, camera: int) -> np.ndarray:
        """`count` after the loss of a camera."""
        return np.where(self.is_body, -1, self.count - self.sees[camera])

    @cached_property
    def costliest(self) -> int:
        """The camera whose loss leaves most ground to no camera; of equal ones the one that saw most."""
        area_m2 = np.where(self.is_body, 0.0, np.diff(np.square(self.edges_m)) * math.pi / len(self.sees[0]))
        lost_m2 = [
            ((area_m2 * (self.without(k) == 0)).sum(), (area_m2 * seen).sum()) for k, seen in enumerate(self.sees)
        ]
        return max(range(len(lost_m2)), key=lost_m2.__getitem__)

    def blind_share(self, count: np.ndarray) -> float:
        """Share of the area outside the vehicle that no camera sees, where cells are seen by so many."""
        area = np.where(self.is_body, 0.0, np.diff(np.square(self.edges_m)))
        return float((area * (count == 0)).sum() / area.sum())


def _edge(holds: Callable[[np.ndarray], np.ndarray], inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Where something ceases to hold between places where it does and places where it does not, by bisection."""
    inside, outside = np.array(inside), np.array(outside)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (inside + outside)
        is_inside = holds(middle)
        inside, outside = np.where(is_inside, middle, inside), np.where(is_inside, outside, middle)
    return inside


# --------------------------------------------------------------------------------------- the body in the images


def body_shares(rig: Rig, scene: DeviceScene) -> dict[str, float]:
    """Share of the image of every camera that the body of the own vehicle covers; nothing else of the scene counts."""
    share: dict[str, float] = {}
    kinds = [(camera.model.width_px, camera.model.height_px, camera.behind_glass) for camera in rig.cameras]
    for kind in dict.fromkeys(kinds):
        group = [camera for camera, each in zip(rig.cameras, kinds, strict=True) if each == kind]
        raster = scene.raster.through(kind[2])
        body = RasterScene(occluders=[raster.foreground_mesh()], device=raster.device)
        transform = np.stack([camera.ego_from_camera for camera in group])
        renderer = Renderer([camera.model for camera in group], device=str(body.device))
        frame = renderer.render(
            body,
            wp.array(transform[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=body.device),
            wp.array(transform[:, :3, :3].transpose(0, 2, 1).astype(np.float32), dtype=wp.mat33, device=body.device),
            content=Content.IMAGES,
        )
        covered = (frame.object_id.numpy() != BACKGROUND_ID).mean(axis=(1, 2), dtype=np.float64)
        share |= {camera.name: float(value) for camera, value in zip(group, covered, strict=True)}
    return {camera.name: share[camera.name] for camera in rig.cameras}
