"""Where cameras may stand: on the mount surface, and apart from each other."""

from __future__ import annotations

import itertools
import math

import numpy as np
import warp as wp

from warpav.errors import OptionError
from warpav.geometry.mount_surface import MountSurface
from warpav.objective.mount import PlacedViews
from warpav.rig.rig import Rig
from warpav_kernels import constraint_losses

# order of the constraint losses in their array
CONSTRAINTS = ("out_of_bounds", "camera_spacing")

PROJECTION_ROUNDS = 200
SHAKE_EVERY = 20  # rounds


def constraint_losses_of(
    views: PlacedViews, surface: MountSurface, *, min_spacing_m: float, rotation_count: int
) -> wp.array:
    """Out-of-bounds and camera-spacing loss (thesis Eqs. 5 to 9), recorded on the active tape.

    Args:
        views: Placed views.
        surface: Its bounding rectangle is where cameras may stand.
        min_spacing_m: Least distance between two camera centres [m], positive.
        rotation_count: Views per camera.

    Returns:
        float [2] in the order of `CONSTRAINTS`; gradients flow to the mount pose.
    """
    device = views.mount_pose.device
    loss = wp.zeros(len(CONSTRAINTS), dtype=float, device=device, requires_grad=True)
    low_m, high_m = surface.bounds_m
    wp.launch(
        constraint_losses.out_of_bounds_loss_kernel,
        dim=1,
        inputs=[views.mount_pose, wp.vec2(*low_m), wp.vec2(*high_m)],
        outputs=[loss],
        device=device,
    )
    wp.launch(
        constraint_losses.camera_spacing_loss_kernel,
        dim=1,
        inputs=[views.position_ego_m, rotation_count, min_spacing_m],
        outputs=[loss],
        device=device,
    )
    return loss


def min_camera_distance_m(position_m: np.ndarray) -> float:
    """Smallest distance between two of the points [camera, 3] [m]; inf for a single camera."""
    return min((math.dist(a, b) for a, b in itertools.combinations(position_m, 2)), default=math.inf)


def constraint_violation_m(rig: Rig, surface: MountSurface, *, min_spacing_m: float) -> float:
    """By how much a rig breaks the constraints [m]: all excess over the bounds plus all missing spacing; 0 if none."""
    position_m = np.array([camera.position_m for camera in rig.cameras])
    low_m, high_m = surface.bounds_m
    excess = np.maximum(low_m - position_m[:, :2], 0.0) + np.maximum(position_m[:, :2] - high_m, 0.0)
    missing = sum(max(min_spacing_m - math.dist(a, b), 0.0) for a, b in itertools.combinations(position_m, 2))
    # a rig file keeps micrometres; what is smaller is rounding, not a violation
    violation = float(excess.sum() + missing)
    return violation if violation > 1e-6 else 0.0


def project_to_constraints(
    position_surface_m: np.ndarray, surface: MountSurface, *, min_spacing_m: float
) -> np.ndarray:
    """Near places that satisfy both constraints: into the bounds, then pairs pushed apart, in turns.

    Args:
        position_surface_m: x and y of the cameras [m], float [camera, 2].
        surface: Its bounding rectangle is where cameras may stand.
        min_spacing_m: Least distance between two camera centres [m]; the distance in the plane is what is kept, which
            is never more than the distance in space.

    Returns:
        float64 [camera, 2]; equal to the input where it satisfies the constraints already.

    Raises:
        InputError: The cameras do not fit.
    """
    place = np.array(position_surface_m, np.float64)
    low_m, high_m = surface.bounds_m
    wanted_m = min_spacing_m + 1e-5  # the numbers that follow are rounded to float32
    rng = np.random.default_rng(0)
    for projection_round in range(1, PROJECTION_ROUNDS + 1):
        if projection_round % SHAKE_EVERY == 0:
            # cameras on one line, such as an edge of the surface, would push each other along it for ever
            place = place + rng.uniform(-0.5, 0.5, place.shape) * min_spacing_m
        place = np.clip(place, low_m + 1e-6, high_m - 1e-6)
        moved = False
        for i, j in itertools.combinations(range(len(place)), 2):
            points = np.c_[place[[i, j]], surface.height_at_m(place[[i, j]])]
            if math.dist(points[0], points[1]) >= min_spacing_m + 1e-6:
                continue
            between = place[j] - place[i]
            distance = float(np.linalg.norm(between))
            # two cameras at one point part along x
            direction = between / distance if distance > 1e-9 else np.array([1.0, 0.0])
            push = 0.5 * (wanted_m - distance) * direction
            place[i] -= push
            place[j] += push
            moved = True
        if not moved:
            return place
    raise cameras_do_not_fit(len(place), surface, min_spacing_m)


def cameras_do_not_fit(camera_count: int, surface: MountSurface, min_spacing_m: float) -> OptionError:
    """The error for more cameras than the mount surface holds."""
    size = np.diff(surface.bounds_m, axis=0)[0]
    return OptionError(
        "rig.cameras",
        f"expected a number that fits on the mount surface of {size[0]:.2f} m x {size[1]:.2f} m at "
        f"rig.min_spacing_m={min_spacing_m:g}, got {camera_count}; lower one of the two",
    )
