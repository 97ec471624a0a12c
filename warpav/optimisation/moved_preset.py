"""Rigs of known vehicles, moved to another vehicle's mount surface; `warpav.rig.on_body` moves them to its body."""

from __future__ import annotations

import dataclasses

import numpy as np

from warpav.optimisation.constraints import Constraints
from warpav.optimisation.mount import CameraMount
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.rig.on_body import MovedRig, blocked_shares, ray_caster
from warpav.rig.rig import Rig

PLACE_STEP_M = 0.05
"""Distance between the places that are tried, on the mount surface."""


def move_to_vehicle(
    rig: Rig, mount: CameraMount, ego: Mesh, *, constraints: Constraints, image: CameraModel | None = None
) -> MovedRig:
    """Put every camera of a rig on the nearest place of a vehicle's mount surface that keeps its direction free.

    Both vehicles' frames are laid over each other: origins below the centre of the rear axle, nothing is scaled. A
    direction is free if the middle row of the image does not meet the vehicle, over the whole field of view. Cameras
    are placed in the order of the rig, each apart from those before it.

    Where the view is hidden from everywhere, the place with the least hidden view is taken.

    Args:
        rig: The rig, in the frame of its own vehicle.
        mount: Where cameras may stand, and how far above the surface; its camera model plays no part.
        ego: The vehicle that carries them.
        constraints: Which places are allowed, and how far apart.
        image: Gives all cameras the size of its images and its near plane; fields of view stay.

    Raises:
        InputError: The cameras do not fit on the mount surface.
    """
    caster = ray_caster(ego)
    place_m = _places(mount, constraints)
    is_taken = np.zeros(len(place_m), bool)
    cameras, moved_m, blocked_share = [], [], []
    for camera in rig.cameras:
        if is_taken.all():
            raise constraints.do_not_fit(len(rig.cameras))
        share = blocked_shares(caster, camera, place_m)
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
    return MovedRig(Rig(cameras), np.array(moved_m), np.array(blocked_share))


def _places(mount: CameraMount, constraints: Constraints) -> np.ndarray:
    """Camera centres all over where they may stand [m], float64 [place, 3]."""
    low_m, high_m = mount.surface.bounds_m
    count = np.maximum(np.ceil((high_m - low_m) / PLACE_STEP_M).astype(int) + 1, 2)
    x_m, y_m = (np.linspace(low, high, n) for low, high, n in zip(low_m, high_m, count, strict=True))
    plane_m = np.stack(np.meshgrid(x_m, y_m, indexing="ij"), axis=-1).reshape(-1, 2)
    plane_m = plane_m[constraints.contains(plane_m)]
    return mount.surface.point_m(plane_m, mount.surface.height_at_m(plane_m) + mount.height_offset_m)
