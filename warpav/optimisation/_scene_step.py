"""One scene's share of an optimisation step, as launches on fixed arrays that a GPU records and replays."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from warpav.optimisation._importance import Importance
from warpav.optimisation._mount import MOUNT_POSE_SIZE, CameraMount, PlacedViews
from warpav.optimisation.losses._loss import DeviceLoss, HostLoss, LossSchedule
from warpav.optimisation.losses._scene_on_tape import AssignedScene, CameraProbability, SceneOnTape
from warpav.raster.chunks import Recording
from warpav.raster.renderer import Renderer
from warpav.scene import DeviceScene
from warpav_kernels.placement import exchange


@dataclass(frozen=True)
class _Fetched:
    """What became of a step."""

    pose_gradient: np.ndarray  # of the Lagrangian to the mount poses, float32 [camera, 7]
    multiplier_gradient: np.ndarray  # of it to the multipliers, float32 [constraint]
    batch_loss: np.ndarray  # every loss on the device, summed over the scenes of the batch, float64 [loss]
    constraint_loss: np.ndarray  # every constraint's, float64 [constraint]
    total: float  # the Lagrangian
    needed_samples: tuple[int, ...]  # of each renderer, for `Renderer.grew`


class Exchange:
    """Arrays that recorded launches read and write, always at the same place: slices of one that is sent.

    ``weight`` [loss] is that of each loss of a scene in the gradient, ``count`` [loss] what it is a mean over.
    """

    def __init__(self, camera_count: int, constraint_count: int, loss_count: int, *, device: str) -> None:
        self._device = device
        self._shape = (camera_count, MOUNT_POSE_SIZE)
        # the last is nobody's: Warp cannot slice what is empty from the end of an array
        sizes = [camera_count * MOUNT_POSE_SIZE, constraint_count, 1, 1, loss_count, loss_count, 1]
        ends = np.cumsum([0, *sizes])
        self._sent = wp.zeros(int(ends[-1]), dtype=float, device=device, requires_grad=True)
        parts = [_slice(self._sent, int(a), int(b)) for a, b in itertools.pairwise(ends)]
        self.pose, self.multiplier = parts[0].reshape(self._shape), parts[1]
        self.panorama_share, self.detector_share, self.weight, self.count, _ = parts[2:]
        assert self._sent.grad is not None
        self._gradient = _slice(self._sent.grad, 0, int(ends[2]))
        self.weights = [_slice(self.weight, k, k + 1) for k in range(loss_count)]  # the same one by one, float [1] each
        self.host_weight: tuple[float, ...] = ()  # as ``weight``, of the losses that the host computes
        self.batch_loss = wp.zeros(loss_count, dtype=wp.float64, device=device)  # every loss
        self._mean_loss = wp.zeros(loss_count, dtype=float, device=device)
        self._fetched_count = int(ends[2]) + loss_count + constraint_count + 1
        self._gathered = wp.zeros(self._fetched_count, dtype=wp.float64, device=device)

    def send(
        self,
        mount_pose: np.ndarray,
        multiplier: np.ndarray,
        schedule: LossSchedule,
        *,
        weight: Sequence[float] | np.ndarray,
        count: Sequence[float] | np.ndarray,
        host_weight: Sequence[float] = (),
    ) -> None:
        """Begin a step: one copy to the device, and gradients and sums of 0."""
        self.host_weight = tuple(host_weight)
        numbers = [
            np.ravel(mount_pose),
            multiplier,
            [schedule.panorama_share, schedule.detector_share],
            weight,
            np.where(np.asarray(count) > 0, count, 1),
            [0.0],
        ]
        self._sent.assign(np.concatenate([np.asarray(each, np.float32) for each in numbers]))
        self.zero()

    def zero(self) -> None:
        assert self._sent.grad is not None
        self._sent.grad.zero_()
        self.batch_loss.zero_()

    def add_scene(self, loss: wp.array) -> None:
        """Add a scene's losses, float [loss], to those of the scenes before it."""
        wp.launch(
            exchange.add_scene_losses_kernel,
            dim=loss.shape,
            inputs=[loss],
            outputs=[self.batch_loss],
            device=self._device,
            record_tape=False,
        )

    def mean_loss(self) -> wp.array:
        """Every loss of the batch, float [loss]; without a gradient."""
        wp.launch(
            exchange.mean_losses_kernel,
            dim=self._mean_loss.shape,
            inputs=[self.batch_loss, self.count],
            outputs=[self._mean_loss],
            device=self._device,
            record_tape=False,
        )
        return self._mean_loss

    def fetch(self, constraint_loss: wp.array, total: wp.array, renderers: Sequence[Renderer]) -> _Fetched:
        """End a step: one copy to the host, the only one that waits for the device."""
        size = self._fetched_count + len(renderers)
        if len(self._gathered) != size:
            self._gathered = wp.zeros(size, dtype=wp.float64, device=self._device)
        for k, renderer in enumerate(renderers):
            wp.launch(
                exchange.gather_needed_samples_kernel,
                dim=1,
                inputs=[renderer.needed_samples, self._fetched_count + k],
                outputs=[self._gathered],
                device=self._device,
                record_tape=False,
            )
        wp.launch(
            exchange.gather_step_kernel,
            dim=self._fetched_count,
            inputs=[self._gradient, self.batch_loss, constraint_loss, total],
            outputs=[self._gathered],
            device=self._device,
            record_tape=False,
        )
        gathered = self._gathered.numpy()
        sizes = [self._shape[0] * self._shape[1], len(self.multiplier), len(self.batch_loss), len(self.multiplier), 1]
        pose, multiplier, batch_loss, constraints, total_loss, needed = np.split(gathered, np.cumsum(sizes))
        return _Fetched(
            pose.astype(np.float32).reshape(self._shape),
            multiplier.astype(np.float32),
            batch_loss.copy(),
            constraints.copy(),
            float(total_loss[0]),
            tuple(int(each) for each in needed),
        )


def _slice(array: wp.array, first: int, end: int) -> wp.array:
    """A part of an array, in the same memory, with the same part of its gradient."""
    part = array[first:end]
    assert isinstance(part, wp.array)
    return part


@dataclass(frozen=True)
class Objective:
    """The losses of an objective, those of the device and those of the host apart."""

    device: tuple[DeviceLoss, ...]  # the losses that kernels compute, in their order
    host: tuple[HostLoss, ...] = ()  # the losses that the host computes, in their order
    camera_probability: CameraProbability | None = None  # how likely a camera is to detect; None where no loss needs it
    importance: Importance | None = None  # weights of the objects; None: all 1

    def object_weight(self, scene: DeviceScene) -> wp.array:
        """Weight of every object of a scene on its device, float [object]."""
        weight = np.ones(scene.vehicle_count) if self.importance is None else self.importance.weights(scene)
        return wp.array(weight, dtype=float, device=scene.raster.device)


class RigViews:
    """The views of a rig that losses are computed from: placed once a step, rendered scene by scene."""

    def __init__(self, mount: CameraMount, pose: wp.array, rotation_count: int, renderers: Sequence[Renderer]) -> None:
        """Views of the cameras at ``pose``, float [camera, 7], with a gradient."""
        self.mount = mount  # places the cameras
        self.rotation_count = rotation_count  # views of every camera: all rotational additions, or only the view ahead
        # the view of each camera in which it really looks
        self.ahead = [camera * rotation_count for camera in range(pose.shape[0])]
        self.renderers = list(renderers)  # one for each scene that is held at a time
        self.placed = PlacedViews.zeros(pose, rotation_count)  # poses of all views, with gradients
        self.steps: WeakKeyDictionary[AssignedScene, dict[int, SceneStep]] = WeakKeyDictionary()


class SceneLosses(NamedTuple):
    """What the cameras are worth on a scene; of a `SceneStep` until it is asked again."""

    value: wp.array  # of every loss on the device, float [loss]
    detection_probability: wp.array | None  # probability that each camera detects each vehicle
    host_value: tuple[float, ...] = ()  # of every loss on the host


class SceneStep:
    """Observes a scene from the present views, then adds up what its losses are there.

    `observe` decides what every view sees. The caller may `draw` what the cameras see ahead, run a detector on its
    ``image`` and hand the boxes over with `set_boxes`. `loss_and_grad` adds the losses to those of the batch, and the
    gradient of their weighted sum to that of the views; `loss` does so without the gradient. What they find stands in
    ``losses``. Nothing in between waits for the device, unless a loss is computed on the host.

    What a recorded launch allocates and does not free belongs to its recording, at least 32 MiB of CUDA's memory, so
    everything that outlives a call is an array from before the first one.
    """

    def __init__(
        self,
        views: RigViews,
        renderer: Renderer,
        assigned: AssignedScene,
        exchange: Exchange,
        objective: Objective,
        *,
        recorded: bool | None = None,
    ) -> None:
        self.scene = scene = assigned.scene
        self.ahead = views.ahead  # the view of each camera in which it really looks
        self._views, self._renderer = views, renderer
        self._exchange, self._objective = exchange, objective
        device, camera_count = renderer.device, len(views.ahead)
        self._detected = wp.zeros((camera_count, scene.vehicle_count), dtype=float, device=device)
        self._box_px = wp.zeros((renderer.view_count, scene.vehicle_count), dtype=wp.vec4, device=device)
        # true visible boxes ahead, NaN for none [px], float [camera, vehicle, 4]
        self.truth_box_px: np.ndarray | None = None
        self._assigned_camera = assigned.assigned_camera
        self._assigned_on_device = wp.array(assigned.assigned_camera, dtype=wp.int32, device=device)
        self._object_weight = objective.object_weight(scene)
        self.image = renderer.kept_image(camera_count)  # what `draw` has drawn, until the renderer's next, 0..1
        has_probability = objective.camera_probability is not None and scene.vehicle_count > 0
        # what the last of these found
        self.losses = SceneLosses(
            wp.zeros(len(objective.device), dtype=float, device=device),
            wp.zeros_like(self._detected) if has_probability else None,
        )
        self.observe = Recording(self._render, renderer, enabled=recorded)  # renders the scene from the present views
        # draws what the cameras saw ahead at the last `observe`
        self.draw = Recording(self._draw, renderer, enabled=recorded)
        recorded = False if objective.host else recorded
        # takes the losses of what was observed and adds their gradient to that of the views
        self.loss_and_grad = Recording(partial(self._take_losses, gradient=True), renderer, enabled=recorded)
        # the same without a gradient
        self.loss = Recording(partial(self._take_losses, gradient=False), renderer, enabled=recorded)

    def set_boxes(self, ahead_box_px: np.ndarray) -> None:
        """Boxes of the detections matched to every vehicle ahead (0 for none) [px], float [camera, vehicle, 4]."""
        box_px = np.zeros((*self._box_px.shape, 4), np.float32)
        box_px[self._views.ahead] = ahead_box_px
        self._box_px.assign(box_px)

    def set_detected(self, is_detected: np.ndarray) -> None:
        """Which camera's detector found which object, bool [camera, vehicle]."""
        self._detected.assign(np.asarray(is_detected, np.float32))

    def _render(self) -> None:
        views = self._views.placed
        self.frame = self._renderer.render(
            self.scene.raster, views.position_ego_m, views.camera_from_ego, log_focal=views.log_zoom
        )

    def _draw(self) -> None:
        self.frame.colours(views=self.ahead, into=self.image)

    def _take_losses(self, *, gradient: bool) -> None:
        tape = wp.Tape() if gradient else None
        views, exchange, objective = self._views, self._exchange, self._objective
        gradients: dict[wp.array, wp.array] = {}
        host_value = []
        with tape or contextlib.nullcontext():
            scene = SceneOnTape(
                views.mount,
                self.frame,
                self.scene,
                views.placed,
                self.frame.measure(self._box_px),
                self._assigned_camera,
                self._assigned_on_device,
                self._detected,
                exchange.panorama_share,
                exchange.detector_share,
                views.ahead,
                objective.camera_probability,
                self.truth_box_px,
                self._object_weight,
            )
            losses = [loss.on_tape(scene) for loss in objective.device]
            for loss, weight in zip(objective.host, exchange.host_weight, strict=True):
                value, of_arrays = loss.on_host(scene, weight if gradient else None, tape)
                host_value.append(value)
                for array, part in of_arrays.items():
                    if array in gradients:  # the sum of two, made on the host as they were
                        both = gradients[array].numpy() + part.numpy()
                        part = wp.array(both, dtype=part.dtype, device=part.device)  # noqa: PLW2901
                    gradients[array] = part
        if tape is not None:
            tape.backward(grads={**dict(zip(losses, exchange.weights, strict=True)), **gradients})
        for k, loss in enumerate(losses):
            wp.copy(self.losses.value, loss, dest_offset=k, count=1)
        exchange.add_scene(self.losses.value)
        if self.losses.detection_probability is not None:
            wp.copy(self.losses.detection_probability, scene.detection_probability)
        self.losses = self.losses._replace(host_value=tuple(host_value))
