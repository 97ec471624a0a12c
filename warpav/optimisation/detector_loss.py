"""The detection network's own loss of a scene, and its way from the network's input back to the views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from warpav.detection.differentiable import DifferentiableDetector
from warpav.optimisation.mount import PlacedViews
from warpav.raster.areas import BOTTOM, LEFT, RIGHT, TOP, Measures
from warpav.raster.frame import Frame
from warpav.raster.poses import ViewPoses
from warpav.scene.device_scene import DeviceScene

_SIDES = [LEFT, TOP, RIGHT, BOTTOM]
# A side of the visible box that is nearer than this to that of the vehicle alone is a side of the vehicle [px].
_SAME_SIDE_PX = 1.0
_UNSEEN_LOSS = 1.0


def detector_loss_of(
    frame: Frame,
    scene: DeviceScene,
    views: PlacedViews,
    measures: Measures,
    detector: DifferentiableDetector,
    *,
    truth_box_px: np.ndarray,
    assigned_camera: np.ndarray,
    ahead_view: Sequence[int],
    tape: wp.Tape | None = None,
    weight: float = 0.0,
) -> float:
    """Mean over the assigned road users of how badly the network finds them where their camera really looks.

    One that its camera does not see counts 1, the largest loss, and gives no gradient: there the in-frame rotation
    acts. The gradient takes two ways. The colours change as the static scene flows through the image
    (`Frame.colours`). The true box moves with its measured extents; a side where something else hides the
    object, or where the image ends, is held: what hides it has no extent of its own, and the border does not move.

    Args:
        frame: ``scene`` from ``views``.
        scene: The scene.
        views: The views of the frame; with a tape, placed on it.
        measures: Measures of the frame.
        detector: The network.
        truth_box_px: True visible boxes, NaN where too little is seen [px], float [camera, vehicle, 4].
        assigned_camera: Camera of every vehicle, -1 for none, int [vehicle].
        ahead_view: The view of each camera in which it looks straight ahead.
        tape: Its backward pass is run here, because the frame's buffers live until the next render; None: no
            gradient.
        weight: Weight of the loss in the gradient.

    Returns:
        The loss, 0..1; 0 for a scene without assigned road users.
    """
    assigned = np.nonzero(assigned_camera >= 0)[0]
    if len(assigned) == 0:
        return 0.0
    camera = assigned_camera[assigned]
    seen = np.isfinite(truth_box_px[camera, assigned]).all(axis=1)
    vehicle, camera = assigned[seen], camera[seen]
    unseen_loss = _UNSEEN_LOSS * float(len(assigned) - len(vehicle))
    if len(vehicle) == 0:
        return unseen_loss / len(assigned)

    shown, image_index = np.unique(camera, return_inverse=True)  # only images that show one of them
    view = np.asarray(ahead_view)[camera]
    box_px = truth_box_px[camera, vehicle]
    objects = (image_index, box_px, scene.road_user_index[vehicle])
    shown_view = [ahead_view[k] for k in shown]
    if tape is None:
        result = detector.loss(frame.colours(views=shown_view), *objects)
        return (float(result.loss.sum()) + unseen_loss) / len(assigned)

    with tape:
        poses = ViewPoses(views.position_ego_m, views.camera_from_ego, views.log_zoom)
        measure = measures.on_tape(*poses)
        image = frame.colours(poses, views=shown_view)
    result = detector.loss(image, *objects, weight=np.full(len(vehicle), weight / len(assigned)))
    assert result.image_gradient is not None
    assert result.box_gradient is not None
    alone_px = measures.value.numpy()[view, vehicle][:, _SIDES]
    moves = np.abs(box_px - alone_px) <= _SAME_SIDE_PX
    to_measure = np.zeros(measure.shape, np.float32)
    to_measure[view[:, None], vehicle[:, None], _SIDES] = np.where(moves, result.box_gradient, 0.0)
    tape.backward(grads={image: result.image_gradient, measure: wp.array(to_measure, dtype=float, device=frame.device)})
    return (float(result.loss.sum()) + unseen_loss) / len(assigned)
