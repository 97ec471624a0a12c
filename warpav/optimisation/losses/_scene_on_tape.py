"""A rendered scene as functions of the views' poses: what losses are made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp

from warpav.detection import Appearance, DetectionProbability, LidarProbability, Seen
from warpav.optimisation._mount import LOG_ZOOM, PITCH_RAD, CameraMount, PlacedViews
from warpav.optimisation._settings import LossSettings
from warpav.raster.areas import Measures
from warpav.raster.frame import Frame
from warpav.scene import DeviceScene
from warpav_kernels.placement import expected_misses


@dataclass(frozen=True)
class CameraProbability:
    """How likely each camera is to detect an object: the model of its image, blended with that of its panorama."""

    model: DetectionProbability  # detection probability in a view
    probability: str = "fitted"  # ``fitted`` takes the model
    window_softness_rad: float = np.radians(10.0)  # of the fields of view over the panorama [rad], positive

    @classmethod
    def of(cls, settings: LossSettings, model: DetectionProbability | None) -> CameraProbability | None:
        return None if model is None else cls(model, settings.probability, settings.window_softness_rad)

    @property
    def identity(self) -> tuple[object, ...]:
        """All that the probabilities depend on."""
        model = self.model
        parts = (model.start, model.step, model.coefficient, model.constant)
        return *(np.asarray(part, np.float64).tobytes() for part in parts), self.probability

    def detected(
        self, frame: Frame, scene: DeviceScene, position_ego_m: wp.array, camera_from_ego: wp.array
    ) -> wp.array:
        """The probability that each view detects each object, nothing taped; float [view, object].

        ``frame``: a render of the scene with coverage.
        """
        seen = self.model.of_coverage(frame, scene, position_ego_m, camera_from_ego)
        return self.share_of_box(seen) or seen.probability

    def share_of_box(self, seen: Seen) -> wp.array | None:
        """What stands in for the fitted probability, on the active tape, float [view, vehicle]; None: nothing does."""
        if self.probability == "fitted":
            return None
        share = wp.zeros_like(seen.probability, requires_grad=True)
        wp.launch(
            expected_misses.box_share_kernel,
            dim=share.shape,
            inputs=[seen.feature, int(self.probability == "visible_share")],
            outputs=[share],
            device=share.device,
        )
        return share


ObjectProbability = CameraProbability | LidarProbability
"""How likely a sensor of some model is to find an object."""


@dataclass(frozen=True, eq=False)
class SceneOnTape:
    """A scene that was rendered from some views. What is asked for is recorded on the active tape, once."""

    mount: CameraMount  # knows the rotational additions and the lens
    frame: Frame  # ``scene`` from ``views``
    scene: DeviceScene  # the scene
    views: PlacedViews  # the views; gradients flow to their poses and to the mount poses
    measures: Measures  # of this render
    assigned_camera: np.ndarray  # cameras of every vehicle, -1 for none, int32 [vehicle]
    assigned_on_device: wp.array  # the same on the device
    detected: wp.array  # which camera's detector found which vehicle, 0 or 1, float [camera, vehicle]
    panorama_share: wp.array  # see `LossSchedule`, float [1]
    detector_share: wp.array  # likewise, float [1]
    forward_view: list[int]  # the view of each camera in which it looks straight ahead
    camera_probability: CameraProbability | None = None  # how likely a camera is to detect; None where no loss needs it
    truth_box_px: np.ndarray | None = None  # true visible boxes ahead, NaN for none [px], float [camera, vehicle, 4]
    weight: wp.array | None = None  # of every vehicle, float [vehicle]; None: all 1

    @property
    def camera_count(self) -> int:
        return self.views.mount_pose.shape[0]

    @property
    def rotation_count(self) -> int:
        return self.frame.view_count // self.camera_count

    @cached_property
    def object_weight(self) -> wp.array:
        """Weight of every vehicle, 1 where none is set, float [vehicle]."""
        if self.weight is not None:
            return self.weight
        return wp.ones(self.scene.vehicle_count, dtype=float, device=self.frame.device)

    @cached_property
    def assigned_count(self) -> int:
        return int(np.count_nonzero(self.assigned_camera >= 0))

    @cached_property
    def measure(self) -> wp.array:
        """Measures of every vehicle in every view, float [view, vehicle, measure], see `Measures`."""
        return self.measures.on_tape(*self._pose)

    @cached_property
    def unblocked(self) -> Measures:
        """Area of every vehicle outside the ego vehicle's silhouette, in every view; not on the tape."""
        return self.frame.unblocked_area()

    @cached_property
    def unblocked_area(self) -> wp.array:
        """The same on the tape [px^2], float [view, vehicle, 1]."""
        return self.unblocked.on_tape(*self._pose)

    @cached_property
    def detection_probability(self) -> wp.array:
        """Probability that each camera detects each vehicle, without the detector's own word, float [camera, vehicle].

        Where each camera has its panorama, what it would find if it turned is blended in by ``panorama_share``.
        """
        assert self.camera_probability is not None
        device, rotation_count = self.frame.device, self.rotation_count
        appearance = Appearance.of(self.frame, self.scene, measures=self.measures)
        seen = self.camera_probability.model.on_tape(appearance, *self._pose)
        probability = self.camera_probability.share_of_box(seen) or seen.probability
        if rotation_count == 1:
            return probability
        in_window = self.frame.window_area(
            self.mount.windows(self.views, requires_grad=False),
            softness_rad=self.camera_probability.window_softness_rad,
            visible=True,
        )
        visible = self.frame.window_area(visible=True)
        are_windows_free = self.mount.is_free[[PITCH_RAD, LOG_ZOOM]].any()
        window_rad = self.mount.windows(self.views) if are_windows_free else None
        shape = self.detected.shape
        best_view = wp.zeros(shape, dtype=wp.int32, device=device)
        in_window_sr = wp.zeros(shape, dtype=float, device=device, requires_grad=True)
        around_sr = wp.zeros(shape, dtype=float, device=device, requires_grad=True)
        wp.launch(
            expected_misses.find_best_views_kernel,
            dim=shape,
            inputs=[probability, rotation_count],
            outputs=[best_view],
            device=device,
            record_tape=False,
        )
        window_sr = in_window.on_tape(*self._pose, window_rad)
        for solid_angle, total in ((window_sr, in_window_sr), (visible.on_tape(*self._pose), around_sr)):
            wp.launch(
                expected_misses.sum_over_panorama_kernel,
                dim=shape,
                inputs=[solid_angle, rotation_count],
                outputs=[total],
                device=device,
            )
        found = wp.zeros(shape, dtype=float, device=device, requires_grad=True)
        wp.launch(
            expected_misses.camera_probability_kernel,
            dim=shape,
            inputs=[probability, best_view, in_window_sr, around_sr, self.panorama_share, rotation_count],
            outputs=[found],
            device=device,
        )
        return found

    @property
    def _pose(self) -> tuple[wp.array, wp.array, wp.array]:
        return self.views.position_ego_m, self.views.camera_from_ego, self.views.log_zoom


class AssignedScene:
    """A scene and the camera that answers for each of its vehicles; equal only to itself."""

    def __init__(self, scene: DeviceScene, assigned_camera: np.ndarray | Callable[[], np.ndarray]) -> None:
        self.scene = scene  # the scene on the device
        self._given = assigned_camera

    @cached_property
    def assigned_camera(self) -> np.ndarray:
        """Index of the camera of every vehicle, -1 for none, int32 [vehicle]."""
        return self._given() if callable(self._given) else self._given
