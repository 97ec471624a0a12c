"""The detection network's own loss of a scene, and its way from the network's input back to the views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warpav.optimisation import HostLoss, LossOptions, LossSchedule, Needs, SceneOnTape
from warpav.raster.areas import BOTTOM, LEFT, RIGHT, TOP
from warpav.raster.poses import ViewPoses

if TYPE_CHECKING:
    from warpav.detection import DifferentiableDetector

_SIDES = [LEFT, TOP, RIGHT, BOTTOM]
# A side of the visible box that is nearer than this to that of the vehicle alone is a side of the vehicle [px].
_SAME_SIDE_PX = 1.0
_UNSEEN_LOSS = 1.0


@dataclass(frozen=True, eq=False)
class DetectorGradient(HostLoss):
    """Mean over the assigned road users of how badly the network finds them where their camera really looks.

    One that its camera does not see counts 1, the largest loss, and gives no gradient: there the in-frame rotation
    acts. The gradient takes two ways. The colours change as the static scene flows through the image (`Frame.colours`).
    The true box moves with its measured extents; a side where something else hides the object, or where the image ends,
    is held: what hides it has no extent of its own, and the border does not move.
    """

    detector: DifferentiableDetector  # the network, in PyTorch
    name = "detector_gradient"

    @classmethod
    def of(cls, options: LossOptions) -> DetectorGradient:
        """With the network of the options."""
        if options.differentiable_detector is None:
            raise ValueError("expected a differentiable detector, got none")
        return cls(options.differentiable_detector)

    def needs(self, schedule: LossSchedule) -> Needs:
        """The true boxes."""
        del schedule
        return Needs(true_boxes=True)

    def on_host(
        self, scene: SceneOnTape, weight: float | None, tape: wp.Tape | None
    ) -> tuple[float, Mapping[wp.array, wp.array]]:
        """The loss, 0..1; 0 for a scene without assigned road users. As in `HostLoss`."""
        truth_box_px = scene.truth_box_px
        assert truth_box_px is not None
        assigned = np.nonzero(scene.assigned_camera >= 0)[0]
        if len(assigned) == 0:
            return 0.0, {}
        camera = scene.assigned_camera[assigned]
        seen = np.isfinite(truth_box_px[camera, assigned]).all(axis=1)
        vehicle, camera = assigned[seen], camera[seen]
        unseen_loss = _UNSEEN_LOSS * float(len(assigned) - len(vehicle))
        if len(vehicle) == 0:
            return unseen_loss / len(assigned), {}

        shown, image_index = np.unique(camera, return_inverse=True)  # only images that show one of them
        view = np.asarray(scene.forward_view)[camera]
        box_px = truth_box_px[camera, vehicle]
        objects = (image_index, box_px, scene.scene.road_user_index[vehicle])
        shown_view = [scene.forward_view[k] for k in shown]
        if weight is None or tape is None:
            result = self.detector.loss(scene.frame.colours(views=shown_view), *objects)
            return (float(result.loss.sum()) + unseen_loss) / len(assigned), {}

        views, measure = scene.views, scene.measure
        poses = ViewPoses(views.position_ego_m, views.camera_from_ego, views.log_zoom)
        image = scene.frame.colours(poses, views=shown_view)
        result = self.detector.loss(image, *objects, weight=np.full(len(vehicle), weight / len(assigned)))
        assert result.image_gradient is not None
        assert result.box_gradient is not None
        alone_px = scene.measures.value.numpy()[view, vehicle][:, _SIDES]
        moves = np.abs(box_px - alone_px) <= _SAME_SIDE_PX
        to_measure = np.zeros(measure.shape, np.float32)
        to_measure[view[:, None], vehicle[:, None], _SIDES] = np.where(moves, result.box_gradient, 0.0)
        gradient = {image: result.image_gradient, measure: wp.array(to_measure, dtype=float, device=measure.device)}
        return (float(result.loss.sum()) + unseen_loss) / len(assigned), gradient
