"""Rigs of known vehicles, moved to another vehicle."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from warpav.optimisation.constraints import Constraints
from warpav.optimisation.mount import CameraMount
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.rig.rig import Rig, RigCamera

PLACE_STEP_M = 0.05
"""Distance between the places that are tried, on the mount surface."""

FAN_RAYS = 17
"""Rays across the middle row of the image that must miss the vehicle."""


@dataclass(frozen=True, eq=False)
class MovedPreset:
    """A rig on a vehicle that it was not made for.

    Attributes:
        rig: The cameras on the mount surface. Names, directions (yaw, pitch and roll), lenses and fields of view are
            those of the original; places are new, and the size of the images where one was asked for.
        moved_m: How far every camera was moved [m], float64 [camera].
        blocked_share: Share of the middle row of every camera's image that the vehicle itself fills, 0..1, float64
            [camera]; above 0 only where no place is better.
    """

    rig: Rig
    moved_m: np.ndarray
    blocked_share: np.ndarray


def move_to_vehicle(
    rig: Rig, mount: CameraMount, ego: Mesh, *, constraints: Constraints, image: CameraModel | None = None
) -> MovedPreset:
    """Put every camera of a rig on the nearest place of a vehicle's mount surface that keeps its direction free.

    Both vehicles' frames are laid over each other: origins below the centre of the rear axle, nothing is scaled. A
    direction is free if the middle row of the image does not meet the vehicle, over the whole field of view. Cameras
    are placed in the order of the rig, each apart from those before it.

    Args:
        rig: The rig, in the frame of its own vehicle.
        mount: Where cameras may stand, and how far above the surface; its camera model plays no part.
        ego: The vehicle that carries them.
        constraints: Which places are allowed, and how far apart.
        image: Gives all cameras the size of its images and its near plane; fields of view stay.

    Raises:
        InputError: The cameras do not fit on the mount surface.
    """
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    caster = EmbreeScene()
    TriangleMesh(caster, ego.vertex_m[ego.triangle])
    place_m = _places(mount, constraints)
    is_taken = np.zeros(len(place_m), bool)
    cameras, moved_m, blocked_share = [], [], []
    for camera in rig.cameras:
        if is_taken.all():
            raise constraints.do_not_fit(len(rig.cameras))
        share = _blocked_shares(caster, camera, place_m)
        distance_m = np.linalg.norm(place_m - camera.position_m, axis=1)
        # the free places first, of these the nearest
        share[is_taken] = np.inf
        best = np.lexsort((distance_m, share))[0]
        model = camera.model
        if image is not None:
            model = dataclasses.replace(model.resized(image.width_px, image.height_px), near_m=image.near_m)
        cameras.append(dataclasses.replace(camera, position_m=place_m[best], model=model))
        moved_m.append(distance_m[best])
        blocked_share.append(share[best])
        is_taken |= np.linalg.norm(place_m - place_m[best], axis=1) < constraints.min_spacing_m
    return MovedPreset(Rig(cameras), np.array(moved_m), np.array(blocked_share))


def _places(mount: CameraMount, constraints: Constraints) -> np.ndarray:
    """Camera centres all over where they may stand [m], float64 [place, 3]."""
    low_m, high_m = mount.surface.bounds_m
    count = np.maximum(np.ceil((high_m - low_m) / PLACE_STEP_M).astype(int) + 1, 2)
    x_m, y_m = (np.linspace(low, high, n) for low, high, n in zip(low_m, high_m, count, strict=True))
    plane_m = np.stack(np.meshgrid(x_m, y_m, indexing="ij"), axis=-1).reshape(-1, 2)
    plane_m = plane_m[constraints.contains(plane_m)]
    return mount.surface.point_m(plane_m, mount.surface.height_at_m(plane_m) + mount.height_offset_m)


def _blocked_shares(caster: object, camera: RigCamera, place_m: np.ndarray) -> np.ndarray:
    """Share of the rays of a camera's middle row that meet the vehicle, from every place, float64 [place]."""
    model = camera.model
    column_px = (np.arange(FAN_RAYS) + 0.5) / FAN_RAYS * model.width_px
    ray = model.rays(np.c_[column_px, np.full(FAN_RAYS, 0.5 * model.height_px)])
    ray = ray[np.isfinite(ray).all(axis=1)] @ camera.ego_from_camera[:3, :3].T
    origin = np.repeat(place_m, len(ray), axis=0).astype(np.float32)
    direction = np.ascontiguousarray(np.tile(ray, (len(place_m), 1)), np.float32)
    hit = caster.run(origin, direction, query="OCCLUDED")  # pyright: ignore[reportAttributeAccessIssue]
    return (hit.reshape(len(place_m), -1) >= 0).mean(axis=1)
