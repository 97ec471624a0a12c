"""One scene's share of an optimisation step, as launches on fixed arrays that a GPU records and replays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import warp as wp

from warpav.detection.differentiable import DifferentiableDetector
from warpav.detection.probability import DetectionProbability
from warpav.optimisation.detector_loss import detector_loss_of
from warpav.optimisation.losses import MISSED, OBJECTIVES, LossSettings, placement_losses_of
from warpav.optimisation.missed import ProbabilityLook, StageOnDevice, add_missed_loss
from warpav.optimisation.mount import CameraMount, PlacedViews
from warpav.optimisation.recording import Recording
from warpav.raster.areas import Measures
from warpav.raster.frame import Frame
from warpav.raster.renderer import Renderer
from warpav.scene.device_scene import DeviceScene


@dataclass(frozen=True, eq=False)
class AssignedScene:
    """A scene and the camera that answers for each of its vehicles; equal only to itself.

    Attributes:
        scene: The scene on the device.
        assigned_camera: Index of the camera of every vehicle, -1 for none, int32 [vehicle].
    """

    scene: DeviceScene
    assigned_camera: np.ndarray


class SceneLosses(NamedTuple):
    """What the cameras are worth on a scene; of a `SceneStep` until it judges or learns again.

    Attributes:
        value: Of every objective, 0 where it is left out, float [objective] in the order of `OBJECTIVES`.
        chance: Probability that each camera finds each vehicle, by p(detected) alone, float [camera, vehicle]; None
            where the loss ``missed`` is left out.
    """

    value: wp.array
    chance: wp.array | None


def losses_of_look(
    mount: CameraMount,
    frame: Frame,
    scene: DeviceScene,
    views: PlacedViews,
    measures: Measures,
    assigned_camera: wp.array,
    *,
    assigned_count: int,
    settings: LossSettings,
    probability: DetectionProbability | None,
    detected: wp.array,
    stage: StageOnDevice,
    image: wp.array,
) -> SceneLosses:
    """All losses of the last look at a scene but the detection network's own, recorded on the active tape.

    Args:
        mount: Knows the rotational additions and the lens.
        frame: ``scene`` from ``views``.
        scene: The scene.
        views: The views; gradients flow to their poses and yaw.
        measures: Of this render.
        assigned_camera: Camera of every vehicle, -1 for none, int [vehicle]; for the thesis's losses.
        assigned_count: Number of vehicles that have a camera.
        settings: Parameters of the losses.
        probability: Of detection; the loss ``missed`` needs it.
        detected: Which camera's detector found which vehicle, 0 or 1, float [camera, vehicle].
        stage: How far along the optimisation is.
        image: What the cameras see ahead, vec3 [camera, row, column].

    Returns:
        Losses of the thesis as means over the scene's assigned vehicles, ``missed`` as the sum over all of them.
    """
    if settings.needs_panorama:
        loss = placement_losses_of(
            mount,
            views,
            measures,
            assigned_camera,
            assigned_count=assigned_count,
            settings=settings,
            unblocked=frame.unblocked_area() if settings.surface_blockage > 0.0 else None,
        )
    else:
        loss = wp.zeros(len(OBJECTIVES), dtype=float, device=measures.value.device, requires_grad=True)
    chance = None
    if settings.missed > 0.0 and probability is not None and scene.vehicle_count:
        camera_count = detected.shape[0]
        rotation_count = frame.view_count // camera_count
        window_rad = moving_rad = None
        if rotation_count > 1:
            window_rad = mount.windows(views, requires_grad=False)
            moving_rad = mount.windows(views) if mount.windows_move else None
        look = ProbabilityLook.of(
            frame,
            scene,
            measures,
            image if frame.view_count == camera_count else None,
            window_rad=window_rad,
            softness_rad=settings.window_softness_rad,
        )
        chance = add_missed_loss(
            probability,
            look,
            views,
            detected,
            stage,
            rotation_count=rotation_count,
            settings=settings,
            place=MISSED,
            loss=loss,
            window_rad=moving_rad,
        )
    return SceneLosses(loss, chance)


class SceneStep:
    """Looks at a scene from the present poses, then learns from what was detected there.

    `look` decides what every view sees and draws what the cameras see ahead. The caller may run a detector on ``image``
    and hand its boxes over with `set_boxes`. `learn` measures, adds up the losses, and adds the gradient of their
    weighted sum to the poses' gradient. Nothing in between waits for the device.

    What a recorded launch allocates and does not free belongs to its recording, at least 32 MiB of CUDA's memory, so
    everything that outlives a call is an array from before the first one.

    Attributes:
        scene: The scene.
        image: What the cameras see ahead after `look`, until the renderer's next, 0..1, vec3 [camera, row, column].
        frame: The render of the last `look`; stale after the renderer's next.
    """

    def __init__(
        self,
        mount: CameraMount,
        renderer: Renderer,
        assigned: AssignedScene,
        *,
        pose: wp.array,
        seed: wp.array,
        ahead_view: Sequence[int],
        settings: LossSettings,
        probability: DetectionProbability | None = None,
        stage: StageOnDevice | None = None,
        recorded: bool | None = None,
    ) -> None:
        """Prepare the step.

        Args:
            mount: Places the cameras.
            renderer: Renders all views; shared by the steps of all scenes. Every camera has as many of its views: all
                rotational additions, or only that in which it really looks.
            assigned: The scene.
            pose: Mount poses, float [camera, 7], with a gradient, to which `learn` adds.
            seed: Weight of each placement loss in that gradient, float [loss].
            ahead_view: The view of each camera in which it looks straight ahead.
            settings: Parameters of the losses.
            probability: Of detection; the loss ``missed`` needs it.
            stage: How far along the optimisation is; None: at its end, without the detector.
            recorded: Whether to record the launches; None: on a GPU.

        Raises:
            ValueError: A loss needs ``probability``, or views that are not there.
        """
        if settings.missed > 0.0 and probability is None:
            raise ValueError("settings.missed needs the probability of detection")
        self.scene = scene = assigned.scene
        device = renderer.device
        self._mount, self._renderer, self._settings = mount, renderer, settings
        self._pose, self._seed, self._ahead_view = pose, seed, list(ahead_view)
        camera_count = pose.shape[0]
        self._rotation_count = renderer.view_count // camera_count
        if settings.needs_panorama and self._rotation_count != mount.rotation_count:
            raise ValueError(f"the losses need {mount.rotation_count} views of every camera")
        self._probability, self._stage = probability, stage or StageOnDevice(str(device))
        self._detected = wp.zeros((camera_count, scene.vehicle_count), dtype=float, device=device)
        self._box_px = wp.zeros((renderer.view_count, scene.vehicle_count), dtype=wp.vec4, device=device)
        self._camera_of_vehicle = assigned.assigned_camera
        self._assigned_camera = wp.array(assigned.assigned_camera, dtype=wp.int32, device=device)
        self._assigned_count = int(np.count_nonzero(assigned.assigned_camera >= 0))
        self.image = renderer.kept_image(len(self._ahead_view))
        self._losses = SceneLosses(
            wp.zeros(len(OBJECTIVES), dtype=float, device=device),
            wp.zeros_like(self._detected) if settings.missed > 0.0 and scene.vehicle_count else None,
        )
        self._recordings = [
            Recording(function, renderer, enabled=recorded) for function in (self._look, self._learn, self._judge)
        ]

    def look(self) -> None:
        """Render the scene from the present poses."""
        self._recordings[0]()

    def set_boxes(self, ahead_box_px: np.ndarray) -> None:
        """Boxes of the detections matched to every vehicle ahead (0 for none) [px], float [camera, vehicle, 4]."""
        box_px = np.zeros((*self._box_px.shape, 4), np.float32)
        box_px[self._ahead_view] = ahead_box_px
        self._box_px.assign(box_px)

    def set_detected(self, is_detected: np.ndarray) -> None:
        """Which camera's detector found which object, bool [camera, vehicle]."""
        self._detected.assign(np.asarray(is_detected, np.float32))

    def learn(self) -> SceneLosses:
        """The losses of the last look; their gradient is added to the poses'."""
        self._recordings[1]()
        return self._losses

    def judge(self) -> SceneLosses:
        """The losses of the last look, without a gradient."""
        self._recordings[2]()
        return self._losses

    def _look(self) -> None:
        views = self._views()
        self.frame = self._renderer.render(
            self.scene.raster, views.position_ego_m, views.camera_from_ego, log_focal=views.log_zoom
        )
        self.frame.colours(views=self._ahead_view, into=self.image)

    def detector_loss(
        self, detector: DifferentiableDetector, truth_box_px: np.ndarray, *, weight: float | None
    ) -> float:
        """The detection network's own loss of the last look.

        PyTorch runs the network, so this is never part of a recording.

        Args:
            detector: The network.
            truth_box_px: True visible boxes ahead, NaN for none [px], float [camera, vehicle, 4].
            weight: Weight of the loss in the poses' gradient, to which it is added; None: no gradient.
        """
        tape = None if weight is None else wp.Tape()
        measures = self.frame.measure(self._box_px)
        if tape is None:
            views = self._views()
        else:
            with tape:
                views = self._views()
        return detector_loss_of(
            self.frame,
            self.scene,
            views,
            measures,
            detector,
            truth_box_px=truth_box_px,
            assigned_camera=self._camera_of_vehicle,
            ahead_view=self._ahead_view,
            tape=tape,
            weight=0.0 if weight is None else weight,
        )

    def _views(self) -> PlacedViews:
        return self._mount.place(self._pose, self._rotation_count)

    def _losses_of_look(self) -> SceneLosses:
        return losses_of_look(
            self._mount,
            self.frame,
            self.scene,
            self._views(),
            self.frame.measure(self._box_px),
            self._assigned_camera,
            assigned_count=self._assigned_count,
            settings=self._settings,
            probability=self._probability,
            detected=self._detected,
            stage=self._stage,
            image=self.image,
        )

    def _learn(self) -> None:
        tape = wp.Tape()
        with tape:
            losses = self._losses_of_look()
        tape.backward(grads={losses.value: self._seed})
        self._keep(losses)

    def _judge(self) -> None:
        self._keep(self._losses_of_look())

    def _keep(self, losses: SceneLosses) -> None:
        for kept, found in zip(self._losses, losses, strict=True):
            if kept is not None and found is not None:
                wp.copy(kept, found)
