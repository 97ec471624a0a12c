"""The thesis's losses of a scene, and the Lagrangian of them all, on the tape."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Literal

import warp as wp

from warpav.optimisation.mount import CameraMount, PlacedViews
from warpav.raster.areas import AMODAL_AREA, VISIBLE_AREA, Measures
from warpav_kernels.placement import lagrangian, placement_losses

# order of the objective losses in their array
OBJECTIVES = (
    "in_frame_rotation",
    "detected_area",
    "surface_blockage",
    "object_visibility",
    "angular_coverage",
    "missed",
)
MISSED = OBJECTIVES.index("missed")
DETECTOR_GRADIENT = "detector_gradient"  # the loss that comes from the detection network itself, where it takes part


class Reference(Enum):
    """What a vehicle's detected area is compared with, over all directions of its camera."""

    NON_OCCLUDED = VISIBLE_AREA  # Eq. 14 as printed: hiding a vehicle costs nothing, both areas shrink together
    ALONE = AMODAL_AREA  # the vehicle alone: being hidden costs as much as being missed


@dataclass(frozen=True)
class LossSettings:
    """Scales and parameters of the losses.

    Attributes:
        in_frame_rotation: Scale of the in-frame rotation loss, at least 0.
        detected_area: Scale of the detected-area loss, at least 0; 0 leaves it out altogether, as with all below.
        surface_blockage: Scale of the surface-blockage loss (appendix IX), at least 0.
        object_visibility: Scale of the object-visibility loss (appendix IX), at least 0.
        angular_coverage: Scale of the angular-coverage loss (appendix IX), at least 0.
        missed: Scale of the expected share of objects that the rig misses, at least 0; no loss of the thesis.
        detector_gradient: Scale of the detection network's own loss, at least 0.
        min_detected_area: Detected or visible share of a vehicle below which it costs something, in (0, 1].
        min_unblocked_area: Share of it that the ego vehicle leaves free below which it costs something, in (0, 1].
        reference: What the detected area is compared with.
        epsilon: Small value of the soft mask and of vehicles already in frame, in [0, 1).
        multiplier_damping: Damping of the multipliers, at least 0; 0 as in the thesis.
        window_softness_rad: Of the fields of view over the panorama, with ``missed`` [rad], positive.
        detector_share: How much of ``missed`` is what the detector really finds, in [0, 1); the rest is its model.
        combine: Whether with ``missed`` any camera may find an object (noisy or), or the surest one alone counts.
        probability: With ``missed``, ``fitted`` to the detector, or the ``visible_share`` of an object's whole box, or
            its ``in_frame_share``, to which hiding does not matter.
    """

    in_frame_rotation: float = 1.0
    detected_area: float = 10.0
    surface_blockage: float = 0.0
    object_visibility: float = 0.0
    angular_coverage: float = 0.0
    missed: float = 0.0
    detector_gradient: float = 0.0
    min_detected_area: float = 0.5
    min_unblocked_area: float = 0.5
    reference: Reference = Reference.NON_OCCLUDED
    epsilon: float = 1e-5
    multiplier_damping: float = 0.0
    window_softness_rad: float = math.radians(10.0)
    detector_share: float = 0.0
    combine: Literal["any", "best"] = "any"
    probability: Literal["fitted", "visible_share", "in_frame_share"] = "fitted"

    @property
    def needs_panorama(self) -> bool:
        """Whether a loss of the thesis takes part, all of which look round from every camera."""
        return any(getattr(self, name) > 0.0 for name in OBJECTIVES if name != "missed")

    @property
    def placement_scale(self) -> tuple[float, ...]:
        """Scales in the order of `OBJECTIVES`."""
        return tuple(getattr(self, name) for name in OBJECTIVES)

    @property
    def objectives(self) -> tuple[str, ...]:
        """Names of the objectives: `OBJECTIVES`, then `DETECTOR_GRADIENT` where it takes part."""
        return (*OBJECTIVES, DETECTOR_GRADIENT) if self.detector_gradient > 0.0 else OBJECTIVES

    @property
    def objective_scale(self) -> tuple[float, ...]:
        """Scales in the order of `objectives`."""
        return tuple(getattr(self, name) for name in self.objectives)

    @property
    def measured_objectives(self) -> tuple[str, ...]:
        """Names of the objectives whose values are known: those with a scale, and what comes with them."""
        with_others = ("in_frame_rotation",) if self.needs_panorama else ()
        return tuple(name for name in self.objectives if getattr(self, name) > 0.0 or name in with_others)

    @property
    def constraint_scale(self) -> float:
        """Scale of every constraint: the largest of the objectives', as in the thesis."""
        return max(self.objective_scale)

    @property
    def objective_count(self) -> int:
        """Number of objectives that take part."""
        return sum(scale > 0.0 for scale in self.objective_scale)


def placement_losses_of(
    mount: CameraMount,
    views: PlacedViews,
    rendered: Measures,
    assigned_camera: wp.array,
    *,
    assigned_count: int,
    settings: LossSettings,
    unblocked: Measures | None = None,
) -> wp.array:
    """One scene's losses of the thesis, recorded on the active tape.

    Args:
        mount: Knows the rotational additions and the lens.
        views: Placed views; gradients flow to their poses and yaw.
        rendered: Measures of the scene in these views.
        assigned_camera: Camera of every vehicle, -1 for none, int [vehicle].
        assigned_count: Number of vehicles that have a camera; a scene without any costs nothing.
        settings: Parameters of the losses.
        unblocked: `Frame.unblocked_area` in these views; the surface-blockage loss needs it.

    Returns:
        float [objective] in the order of `OBJECTIVES`; 0 where a loss is left out, and for ``missed``, which is not
        the thesis's.

    Raises:
        ValueError: ``unblocked`` is needed and not there.
    """
    # the bearings and ranges of these losses take one field of view for all cameras, see `RigObjective`
    if settings.surface_blockage > 0.0 and unblocked is None:
        raise ValueError("settings.surface_blockage needs the unblocked areas")
    device = rendered.value.device
    loss = wp.zeros(len(OBJECTIVES), dtype=float, device=device, requires_grad=True)
    if settings.angular_coverage > 0.0:
        _add_angular_coverage(mount, views.mount_pose, loss)
    if assigned_count == 0:
        return loss
    vehicle_count = assigned_camera.shape[0]
    shape = (int(placement_losses.VEHICLE_LOSS_COUNT), vehicle_count)
    vehicle_loss = wp.zeros(shape, dtype=float, device=device, requires_grad=True)
    bearing_rad = wp.zeros(vehicle_count, dtype=wp.vec2, device=device)
    sight = wp.zeros(vehicle_count, dtype=wp.int32, device=device)
    wp.launch(
        placement_losses.find_vehicle_bearings_kernel,
        dim=vehicle_count,
        inputs=[
            rendered.value,
            assigned_camera,
            views.mount_pose,
            mount.rotation_count,
            mount.rotation_step_rad,
            float(mount.camera.width_px),
            mount.camera.fov_rad,
        ],
        outputs=[bearing_rad, sight],
        device=device,
        record_tape=False,
    )
    wp.launch(
        placement_losses.in_frame_rotation_loss_kernel,
        dim=views.mount_pose.shape[0],
        inputs=[views.mount_pose, assigned_camera, bearing_rad, sight, settings.epsilon],
        outputs=[vehicle_loss],
        device=device,
    )
    measure = rendered.on_tape(views.position_ego_m, views.camera_from_ego, views.log_zoom)
    area_around = wp.zeros(vehicle_count, dtype=float, device=device, requires_grad=True)
    wp.launch(
        placement_losses.sum_area_around_kernel,
        dim=vehicle_count,
        inputs=[measure, assigned_camera, mount.rotation_count, settings.reference.value],
        outputs=[area_around],
        device=device,
    )
    wp.launch(
        placement_losses.detected_area_loss_kernel,
        dim=vehicle_count,
        inputs=[
            measure,
            area_around,
            assigned_camera,
            mount.rotation_count,
            settings.min_detected_area,
            settings.epsilon,
        ],
        outputs=[vehicle_loss],
        device=device,
    )
    if settings.object_visibility > 0.0:
        wp.launch(
            placement_losses.object_visibility_loss_kernel,
            dim=vehicle_count,
            inputs=[measure, area_around, assigned_camera, mount.rotation_count, settings.min_detected_area],
            outputs=[vehicle_loss],
            device=device,
        )
    if unblocked is not None and settings.surface_blockage > 0.0:
        _add_surface_blockage(mount, views, rendered, measure, unblocked, assigned_camera, settings, vehicle_loss)
    wp.launch(
        placement_losses.mean_vehicle_loss_kernel,
        dim=shape[0],
        inputs=[vehicle_loss, assigned_count],
        outputs=[loss],
        device=device,
    )
    return loss


def _add_surface_blockage(
    mount: CameraMount,
    views: PlacedViews,
    rendered: Measures,
    measure: wp.array,
    unblocked: Measures,
    assigned_camera: wp.array,
    settings: LossSettings,
    vehicle_loss: wp.array,
) -> None:
    device = measure.device
    vehicle_count = assigned_camera.shape[0]
    clearest_camera = wp.zeros(vehicle_count, dtype=wp.int32, device=device)
    wp.launch(
        placement_losses.find_clearest_cameras_kernel,
        dim=vehicle_count,
        inputs=[
            rendered.value,
            unblocked.value,
            assigned_camera,
            views.mount_pose.shape[0],
            mount.rotation_count,
        ],
        outputs=[clearest_camera],
        device=device,
        record_tape=False,
    )
    unblocked_area = unblocked.on_tape(views.position_ego_m, views.camera_from_ego, views.log_zoom)
    wp.launch(
        placement_losses.surface_blockage_loss_kernel,
        dim=vehicle_count,
        inputs=[
            measure,
            unblocked_area,
            assigned_camera,
            clearest_camera,
            mount.rotation_count,
            settings.min_unblocked_area,
        ],
        outputs=[vehicle_loss],
        device=device,
    )


def _add_angular_coverage(mount: CameraMount, mount_pose: wp.array, loss: wp.array) -> None:
    device = mount_pose.device
    camera_count = mount_pose.shape[0]
    next_camera = wp.zeros(camera_count, dtype=wp.int32, device=device)
    next_turns = wp.zeros(camera_count, dtype=wp.int32, device=device)
    wp.launch(
        placement_losses.find_next_cameras_kernel,
        dim=camera_count,
        inputs=[mount_pose],
        outputs=[next_camera, next_turns],
        device=device,
        record_tape=False,
    )
    wp.launch(
        placement_losses.angular_coverage_loss_kernel,
        dim=1,
        inputs=[mount_pose, next_camera, next_turns, mount.camera.fov_rad],
        outputs=[loss],
        device=device,
    )


def lagrangian_of(
    objective_loss: wp.array,
    constraint_loss: wp.array,
    multiplier: wp.array,
    settings: LossSettings,
    *,
    are_inequalities: bool = False,
) -> wp.array:
    """The number that descent lowers and the multipliers' ascent raises, recorded on the active tape.

    Args:
        objective_loss: Objectives, unscaled, float [objective].
        constraint_loss: As `Constraints.losses_of` gives them, float [constraint].
        multiplier: Of every constraint, float [constraint]; of inequalities at least 0.
        settings: Scales and damping.
        are_inequalities: False: constraints are losses and count as in the thesis's Eq. 1. True: they are inequalities
            g <= 0, and each adds ``m c + d/2 c^2`` once and unscaled, with ``c = max(g, -m/d)``, its multiplier m and
            the damping d.

    Returns:
        float [1].
    """
    device = objective_loss.device
    total = wp.zeros(1, dtype=float, device=device, requires_grad=True)
    objective_scale = wp.array(settings.objective_scale, dtype=float, device=device)
    if are_inequalities:
        wp.launch(
            lagrangian.damped_lagrangian_kernel,
            dim=1,
            inputs=[objective_loss, objective_scale, constraint_loss, multiplier, settings.multiplier_damping],
            outputs=[total],
            device=device,
        )
        return total
    constraint_scale = [settings.constraint_scale] * constraint_loss.shape[0]
    wp.launch(
        lagrangian.lagrangian_kernel,
        dim=1,
        inputs=[
            objective_loss,
            objective_scale,
            constraint_loss,
            wp.array(constraint_scale, dtype=float, device=device),
            multiplier,
            float(settings.objective_count),
            settings.multiplier_damping,
        ],
        outputs=[total],
        device=device,
    )
    return total
