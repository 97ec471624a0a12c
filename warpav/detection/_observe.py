"""Observation of a rendered scene, camera by camera: ground-truth boxes, detections and their matches."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from warpav.detection._detector import Detections, Detector, TensorDetector
from warpav.detection._matching import iou_matrix, largest_component_box, match_detections
from warpav.raster.frame import Frame
from warpav.scene import EGO, DeviceScene, object_index_of
from warpav_kernels.detection import network_input as network_input_kernels

_BODY_SHARE = 0.5  # of a box, from which on it is the own body's


@dataclass(frozen=True)
class VisibleObjects:
    """Visible parts of every vehicle of a scene in every camera, without a detector."""

    scene: DeviceScene  # the scene
    supersampling: int  # samples per pixel edge of the masks
    # Silhouettes of the visible parts: left, top and mask in samples, [camera][vehicle]
    masks: list[list[tuple[int, int, np.ndarray]]]
    truth_box_px: np.ndarray  # see `Observation`
    too_small_box_px: np.ndarray  # see `Observation`

    def may_match(self, detections: Sequence[Detections]) -> list[np.ndarray]:
        """Whether a visible part of a vehicle lies in a detection of its kind, bool [camera][vehicle, detection]."""
        may = []
        for masks, found in zip(self.masks, detections, strict=True):
            inside = np.zeros((self.scene.vehicle_count, len(found)), bool)
            for vehicle, (left, top, mask) in enumerate(masks):
                if not mask.any():
                    continue
                # a visible part of the vehicle lies inside the detection
                for k, box_px in enumerate(found.box_px * self.supersampling):
                    x0, y0, x1, y1 = np.round(box_px - [left, top, left, top]).astype(int)
                    inside[vehicle, k] = mask[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)].any()
            may.append(inside & (self.scene.road_user_index[:, None] == found.road_user_index))
        return may

    def match(self, detections: Sequence[Detections], *, confidence_min: float, iou_min: float) -> np.ndarray:
        """Detection that belongs to every vehicle, -1 for none, int64 [camera, vehicle]; arguments as in `observe`."""
        may = self.may_match(detections)
        return _matched(self.truth_box_px, detections, may, confidence_min=confidence_min, iou_min=iou_min)


@dataclass(frozen=True)
class Observation:
    """Detections of one scene through the cameras of a rig."""

    image: wp.array  # rendered images, 0..1, vec3 [camera, row, column], on the device
    detections: list[Detections]  # of the detector, one per camera
    # Box around the largest visible part of every vehicle [px]; NaN where too little is visible, float32 [camera,
    # vehicle, 4]
    truth_box_px: np.ndarray
    too_small_box_px: np.ndarray  # the same for objects with too little visible for a truth box; else NaN
    match: np.ndarray  # detection matched to every vehicle, -1 for none, int64 [camera, vehicle]
    may_match: list[np.ndarray]  # see `VisibleObjects.may_match`

    @property
    def image_rgb(self) -> np.ndarray:
        """Rendered images, uint8 [camera, row, column, 3]; a copy on the host."""
        return (self.image.numpy() * 255.0 + 0.5).astype(np.uint8)

    def detected_up_to(self, iou_min: float) -> np.ndarray:
        """Highest minimum confidence at which a vehicle still has a match, -inf: none; float64 [camera, vehicle].

        Objects are matched again at every threshold; what is found at one is found at all lower ones.
        """
        up_to = np.full(self.truth_box_px.shape[:2], -np.inf)
        for camera, (found, may) in enumerate(zip(self.detections, self.may_match, strict=True)):
            truth_px = self.truth_box_px[camera]
            reaches = (may & (iou_matrix(truth_px, found.box_px) >= iou_min)).any(axis=0)
            for confidence in np.unique(found.confidence[reaches]):  # upwards: the last one that matches stays
                match = match_detections(
                    truth_px,
                    found.box_px,
                    found.confidence,
                    confidence_min=float(confidence),
                    iou_min=iou_min,
                    seen_inside=may,
                )
                up_to[camera, match >= 0] = confidence
        return up_to

    def at(self, confidence_min: float, iou_min: float) -> Observation:
        """The same by a detector that drops what is less confident."""
        counts = [int((found.confidence >= confidence_min).sum()) for found in self.detections]
        kept = [found.only(slice(count)) for found, count in zip(self.detections, counts, strict=True)]
        may = [each[:, :count] for each, count in zip(self.may_match, counts, strict=True)]
        match = _matched(self.truth_box_px, kept, may, confidence_min=confidence_min, iou_min=iou_min)
        return replace(self, detections=kept, may_match=may, match=match)

    def matched_box_px(self) -> np.ndarray:
        """Box of the detection matched to every vehicle [px], 0 where none is, float32 [camera, vehicle, 4]."""
        return matched_boxes_px(self.match, self.detections)

    def matched_confidence(self) -> np.ndarray:
        """Confidence of the detection matched to every vehicle, NaN where there is none, float64 [camera, vehicle]."""
        confidence = np.full(self.match.shape, np.nan)
        for camera, detections in enumerate(self.detections):
            found = self.match[camera] >= 0
            confidence[camera, found] = detections.confidence[self.match[camera, found]]
        return confidence


def _matched(
    truth_box_px: np.ndarray,
    detections: Sequence[Detections],
    may_match: Sequence[np.ndarray],
    *,
    confidence_min: float,
    iou_min: float,
) -> np.ndarray:
    """Detection that belongs to every vehicle, -1 for none, int64 [camera, vehicle]."""
    match = np.full(truth_box_px.shape[:2], -1, np.int64)
    for camera, (found, may) in enumerate(zip(detections, may_match, strict=True)):
        match[camera] = match_detections(
            truth_box_px[camera],
            found.box_px,
            found.confidence,
            confidence_min=confidence_min,
            iou_min=iou_min,
            seen_inside=may,
        )
    return match


def matched_boxes_px(match: np.ndarray, detections: Sequence[Detections]) -> np.ndarray:
    """Box of the detection matched to every vehicle [px], 0 where none is, float32 [camera, vehicle, 4]."""
    box = np.zeros((*match.shape, 4), np.float32)
    for camera, found in enumerate(detections):
        is_matched = match[camera] >= 0
        box[camera, is_matched] = found.box_px[match[camera, is_matched]]
    return box


def network_input_of(images: Sequence[wp.array], detector: Detector) -> wp.array | np.ndarray:
    """Rendered images of one size, 0..1, vec3 [image, row, column], as the detector takes them; for `detections_in`."""
    _, height_px, width_px = images[0].shape
    if not (isinstance(detector, TensorDetector) and detector.takes_tensor(height_px, width_px)):
        return np.concatenate([(image.numpy() * 255.0 + 0.5).astype(np.uint8) for image in images])
    count = sum(image.shape[0] for image in images)
    network_input = wp.empty((count, 3, height_px, width_px), dtype=float, device=images[0].device)
    start = 0
    for image in images:
        wp.launch(
            network_input_kernels.write_network_input_kernel,
            dim=(image.shape[0], height_px),
            inputs=[image],
            outputs=[network_input[start : start + image.shape[0]]],
            device=image.device,
            record_tape=False,
        )
        start += image.shape[0]
    return network_input


def detections_in(network_input: wp.array | np.ndarray, detector: Detector) -> list[Detections]:
    """Run a detector on the output of `network_input_of`; one result per image."""
    if isinstance(network_input, np.ndarray):
        return detector.detect(network_input)
    assert isinstance(detector, TensorDetector)
    return detector.detect_tensor(network_input)


def visible_objects(
    frame: Frame, scene: DeviceScene, *, forward_view: Sequence[int], min_area_px: int = 16
) -> VisibleObjects:
    """Visible parts of the vehicles in a render; arguments as in `observe`."""
    masks = frame.visible_masks(forward_view)
    samples = frame.supersampling
    truth_box_px = np.full((len(masks), scene.vehicle_count, 4), np.nan, np.float32)
    too_small_box_px = truth_box_px.copy()
    for camera, masks_of_camera in enumerate(masks):
        for vehicle, (left, top, mask) in enumerate(masks_of_camera):
            if not mask.any():
                continue
            box = largest_component_box(mask, min_area_px=min_area_px * samples * samples)
            boxes = truth_box_px
            if box is None:
                box, boxes = largest_component_box(mask, min_area_px=1), too_small_box_px
                assert box is not None
            boxes[camera, vehicle] = (box + np.array([left, top, left, top], np.float32)) / samples
    return VisibleObjects(scene, samples, masks, truth_box_px, too_small_box_px)


def observe(
    frame: Frame,
    scene: DeviceScene,
    detector: Detector,
    *,
    image: wp.array | None = None,
    forward_view: Sequence[int],
    confidence_min: float,
    iou_min: float,
    min_area_px: int = 16,
) -> Observation:
    """Run the detector on a render, and match its boxes to the ground truth of the same kind of road user.

    Boxes on the own body are left out, as a mask of it would in a vehicle.

    ``image``: rendered forward views, 0..1, vec3 [camera, row, column]; None: they are rendered here.
    """
    if image is None:
        image = frame.colours(views=forward_view)
    with ThreadPoolExecutor(1) as beside:
        finding = beside.submit(detections_in, network_input_of([image], detector), detector)
        is_body = object_index_of(frame.object_id.numpy()[list(forward_view)]) == EGO
        visible = visible_objects(frame, scene, forward_view=forward_view, min_area_px=min_area_px)
    detections = [_off_the_body(each, mask) for each, mask in zip(finding.result(), is_body, strict=True)]
    may = visible.may_match(detections)
    match = _matched(visible.truth_box_px, detections, may, confidence_min=confidence_min, iou_min=iou_min)
    return Observation(image, detections, visible.truth_box_px, visible.too_small_box_px, match, may)


def _off_the_body(found: Detections, is_body: np.ndarray) -> Detections:
    """Detections of whose box less than half shows the own body; ``is_body`` bool [row, column]."""
    if not is_body.any():
        return found
    corners = [np.r_[np.floor(box[:2]), np.ceil(box[2:])].astype(int) for box in found.box_px]
    share = [is_body[y0 : max(y1, y0 + 1), x0 : max(x1, x0 + 1)] for x0, y0, x1, y1 in corners]
    return found.only(np.array([each.size == 0 or each.mean() < _BODY_SHARE for each in share], bool))


@dataclass(frozen=True)
class RenderedImage:
    scene: Hashable  # the scene; compared by identity
    camera: int  # index of the camera
    pose: bytes  # everything else that the content depends on, as bytes; equal bytes mean an equal image
    image: Any  # colours 0..1, vec3 [1, row, column]; may be overwritten as soon as `DetectorInLoop.ask` returns


class DetectorInLoop:
    """Runs a detector in its own thread, and keeps the last detections of every scene and camera.

    Which images share a batch depends only on the calls, not on timing.
    """

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self._pool = ThreadPoolExecutor(1)
        self._known: WeakKeyDictionary[Any, dict[int, tuple[bytes, Detections]]] = WeakKeyDictionary()

    def ask(self, images: Sequence[RenderedImage]) -> Callable[[], list[Detections]]:
        new = [image for image in images if self._answer(image) is None]
        answers = None
        if new:
            network_input = network_input_of([image.image for image in new], self._detector)
            answers = self._pool.submit(detections_in, network_input, self._detector)

        def wait() -> list[Detections]:
            if answers is not None:
                for image, found in zip(new, answers.result(), strict=True):
                    self._known.setdefault(image.scene, {})[image.camera] = (image.pose, found)
            found = [self._answer(image) for image in images]
            assert all(each is not None for each in found)
            return [each for each in found if each is not None]

        return wait

    def _answer(self, image: RenderedImage) -> Detections | None:
        pose, found = self._known.get(image.scene, {}).get(image.camera, (None, None))
        return found if pose == image.pose else None
