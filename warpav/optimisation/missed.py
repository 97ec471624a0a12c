"""The expected number of objects that a rig misses: what the default method lowers.

Every camera finds an object with the probability that `DetectionProbability` gives for what its image shows of it;
the rig misses what all its cameras miss. Early in an optimisation a panorama from every camera's place lets objects
outside the images pull, late in it the detector itself has a say; `Stage` says how much of each.
"""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from warpav.detection.probability import Appearance, DetectionProbability
from warpav.optimisation.losses import LossSettings
from warpav.optimisation.mount import PlacedViews
from warpav.raster.areas import Measures, WindowMeasures
from warpav.raster.frame import Frame
from warpav.scene.device_scene import DeviceScene
from warpav_kernels.placement import missed_loss


@dataclass(frozen=True)
class Stage:
    """How far along an optimisation is.

    Attributes:
        panorama_share: How much of a camera's probability is what it would find if it turned to the object, weighted
            by the object's share in the soft window of its field of view, in [0, 1]; 0 looks at its image alone.
        detector_share: How much of it is what the detector really found, in [0, 1).
    """

    panorama_share: float = 0.0
    detector_share: float = 0.0


class StageOnDevice:
    """The numbers of a `Stage` in arrays that recorded launches read."""

    def __init__(self, device: str) -> None:
        """Both shares 0."""
        self.panorama_share = wp.zeros(1, dtype=float, device=device)
        self.detector_share = wp.zeros(1, dtype=float, device=device)

    def set(self, stage: Stage) -> None:
        """Take over the numbers."""
        self.panorama_share.fill_(stage.panorama_share)
        self.detector_share.fill_(stage.detector_share)


@dataclass(frozen=True)
class ProbabilityLook:
    """What a render shows that the loss needs; the renderer's buffers are free again.

    Attributes:
        appearance: Of every object in every view.
        in_window: Visible solid angle inside the soft window of the camera's field of view, in every view of its
            panorama; None where each camera has one view.
        visible: Visible solid angle in every view; likewise.
    """

    appearance: Appearance
    in_window: WindowMeasures | None
    visible: WindowMeasures | None

    @classmethod
    def of(
        cls,
        frame: Frame,
        scene: DeviceScene,
        measures: Measures,
        image: wp.array | None,
        *,
        window_rad: wp.array | None,
        softness_rad: float,
    ) -> ProbabilityLook:
        """Measure a render; nothing is taped.

        Args:
            frame: All content of ``scene`` in all views.
            scene: The scene.
            measures: Of this render, from `Frame.measure`.
            image: Its colours in all views, vec3 [view, row, column]; None: they are drawn here.
            window_rad: Fields of view over the panoramas, from `CameraMount.windows`; None where each camera has
                one view.
            softness_rad: Of the windows' edges [rad].
        """
        appearance = Appearance.of(frame, scene, measures=measures, image=image)
        if window_rad is None:
            return cls(appearance, None, None)
        in_window = frame.window_area(window_rad, softness_rad=softness_rad, visible=True)
        return cls(appearance, in_window, frame.window_area(visible=True))


def add_missed_loss(
    model: DetectionProbability,
    look: ProbabilityLook,
    views: PlacedViews,
    detected: wp.array,
    stage: StageOnDevice,
    *,
    rotation_count: int,
    settings: LossSettings,
    place: int,
    loss: wp.array,
    window_rad: wp.array | None = None,
) -> wp.array:
    """The expected number of missed objects, recorded on the active tape.

    Args:
        model: Probability of detection in a view.
        look: What the views show.
        views: The views; gradients flow to their poses.
        detected: Which camera's detector really found which object, 0 or 1, float [camera, object].
        stage: Shares of the panorama and of the detector.
        rotation_count: Views of every camera.
        settings: Whether all cameras count, and what stands for the probability.
        place: Where to write.
        loss: float [loss]; the element at ``place`` is written.
        window_rad: The windows of ``look``, where they move with the cameras: from `CameraMount.windows`, on the tape.

    Returns:
        Probability that each camera finds each object, float [camera, object].
    """
    device = loss.device
    pose = views.position_ego_m, views.camera_from_ego, views.log_zoom
    seen = model.on_tape(look.appearance, *pose)
    probability = seen.probability
    if settings.probability != "fitted":
        probability = wp.zeros_like(seen.probability, requires_grad=True)
        wp.launch(
            missed_loss.box_share_kernel,
            dim=probability.shape,
            inputs=[seen.feature, int(settings.probability == "visible_share")],
            outputs=[probability],
            device=device,
        )
    shape = detected.shape
    best_view = wp.zeros(shape, dtype=wp.int32, device=device)
    in_window_sr = wp.zeros(shape, dtype=float, device=device, requires_grad=True)
    around_sr = wp.zeros(shape, dtype=float, device=device, requires_grad=True)
    if look.in_window is not None and look.visible is not None:
        wp.launch(
            missed_loss.find_best_views_kernel,
            dim=shape,
            inputs=[probability, rotation_count],
            outputs=[best_view],
            device=device,
            record_tape=False,
        )
        in_window = look.in_window.on_tape(*pose, window_rad)
        for solid_angle, total in ((in_window, in_window_sr), (look.visible.on_tape(*pose), around_sr)):
            wp.launch(
                missed_loss.sum_over_panorama_kernel,
                dim=shape,
                inputs=[solid_angle, rotation_count],
                outputs=[total],
                device=device,
            )
    found = wp.zeros(shape, dtype=float, device=device, requires_grad=True)
    wp.launch(
        missed_loss.camera_probability_kernel,
        dim=shape,
        inputs=[probability, best_view, in_window_sr, around_sr, stage.panorama_share, rotation_count],
        outputs=[found],
        device=device,
    )
    counted_camera = wp.full(shape[1], -1, dtype=wp.int32, device=device)
    if settings.combine == "best":
        wp.launch(
            missed_loss.find_surest_cameras_kernel,
            dim=shape[1],
            inputs=[found, detected, stage.detector_share],
            outputs=[counted_camera],
            device=device,
            record_tape=False,
        )
    log_missed = wp.zeros(shape[1], dtype=float, device=device, requires_grad=True)
    wp.launch(
        missed_loss.log_missed_kernel,
        dim=shape[1],
        inputs=[found, detected, stage.detector_share, counted_camera],
        outputs=[log_missed],
        device=device,
    )
    wp.launch(missed_loss.missed_loss_kernel, dim=1, inputs=[log_missed, place], outputs=[loss], device=device)
    return found
