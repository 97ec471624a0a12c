"""Evaluation of a detector on images of town scenes: the metrics of the model card."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpav.detection._average_precision import ImageBoxes, score_images
from warpav.detection._detector import ROAD_USERS, Detections, Detector
from warpav.detection._matching import covered_fraction, match_detections
from warpav.detection.training import CLASS_NAMES
from warpav.detection.training._data import LabelledImages

# Least height of a visible box [px] from which on an object counts in the headline figure.
_HEADLINE_HEIGHT_PX = 12.0
# Least height [px] and visible share in the figure that goes by KITTI's moderate difficulty.
_MODERATE_HEIGHT_PX = 25.0
_MODERATE_VISIBLE_FRACTION = 0.5
_HEIGHT_BINS_PX = (0.0, 8.0, 12.0, 16.0, 24.0, 32.0, 64.0, 128.0, np.inf)
_VISIBLE_FRACTION_BINS = (0.0, 0.25, 0.5, 0.75, np.inf)
_DISTANCE_BINS_M = (0.0, 10.0, 20.0, 40.0, 80.0, np.inf)
# Confidence threshold of recall, precision and labels.
_OPERATING_CONFIDENCE = 0.25

# Labels that are no road user's name are kinds of vehicles.
_ROAD_USER_OF_CLASS = np.array([ROAD_USERS.index(name) if name in ROAD_USERS else 0 for name in CLASS_NAMES])
_IMAGES_PER_CALL = 32


@dataclass(frozen=True)
class _Scored:
    labelled: LabelledImages
    detections: list[Detections]
    chosen: np.ndarray  # the objects, bool [image, object]

    @property
    def exists(self) -> np.ndarray:
        return self.chosen & ~self.labelled.labels.ignored

    @property
    def height_px(self) -> np.ndarray:
        return self.labelled.labels.box_px[..., 3] - self.labelled.labels.box_px[..., 1]

    def ap50(self, chosen: np.ndarray | None = None, *, low_px: float = 0.0, high_px: float = np.inf) -> float | None:
        """Average precision of the chosen objects (None: all), bool [image, object], with boxes so high.

        Detections that find nothing count against it unless their own height is out of the range.
        """
        counted = self.exists & (self.height_px >= low_px) & (self.height_px < high_px)
        if chosen is not None:
            counted &= chosen
        images = []
        for image, found in enumerate(self.detections):
            held = self.chosen[image]
            found_height_px = found.box_px[:, 3] - found.box_px[:, 1]
            images.append(
                ImageBoxes(
                    self.labelled.labels.box_px[image, held],
                    found.box_px,
                    found.confidence,
                    truth_ignored=~counted[image, held],
                    detection_ignored_unless_matched=(found_height_px < low_px) | (found_height_px >= high_px),
                )
            )
        scores = score_images(images, iou_min=[0.5], area_px2=[(0.0, np.inf)])
        return _share(float(scores.average_precision()[0, 0]))

    def report(self) -> dict[str, object]:
        labels = self.labelled.labels
        headline = self.exists & (self.height_px >= _HEADLINE_HEIGHT_PX)
        hit, right_label = np.zeros(headline.shape, bool), np.zeros(headline.shape, bool)
        false_alarms = 0
        for image, found in enumerate(self.detections):
            held = np.nonzero(self.chosen[image])[0]
            match = match_detections(
                labels.box_px[image, held], found.box_px, found.confidence, confidence_min=_OPERATING_CONFIDENCE
            )
            hit[image, held] = match >= 0
            matched = held[match >= 0]
            said = np.array([found.names[k] for k in found.class_index[match[match >= 0]]])
            right_label[image, matched] = said == np.array(CLASS_NAMES)[labels.class_index[image, matched]]
            free = np.setdiff1d(np.nonzero(found.confidence >= _OPERATING_CONFIDENCE)[0], match)
            waived = covered_fraction(found.box_px[free], labels.box_px[image, labels.ignored[image]])
            free = free[waived.max(axis=1, initial=0.0) < 0.5]
            false_alarms += int((found.box_px[free, 3] - found.box_px[free, 1] >= _HEADLINE_HEIGHT_PX).sum())

        def within(value: np.ndarray, edges: Sequence[float]) -> dict[str, np.ndarray]:
            return {f"{low:g}-{high:g}": (value >= low) & (value < high) for low, high in itertools.pairwise(edges)}

        def recall(chosen: np.ndarray) -> float | None:
            counted = headline & chosen
            return _share(hit[counted].mean() if counted.any() else np.nan)

        hits = int(hit[headline].sum())
        by_visible_fraction = within(labels.visible_fraction, _VISIBLE_FRACTION_BINS)
        by_distance_m = within(labels.distance_m, _DISTANCE_BINS_M)
        return {
            "objects": int(self.exists.sum()),
            "objects_headline": int(headline.sum()),
            "ap50": self.ap50(),
            "ap50_headline": self.ap50(low_px=_HEADLINE_HEIGHT_PX),
            "ap50_moderate": self.ap50(
                labels.visible_fraction >= _MODERATE_VISIBLE_FRACTION, low_px=_MODERATE_HEIGHT_PX
            ),
            "ap50_by_height_px": {
                f"{low:g}-{high:g}": self.ap50(low_px=low, high_px=high)
                for low, high in itertools.pairwise(_HEIGHT_BINS_PX)
            },
            "ap50_by_visible_fraction": {
                name: self.ap50(chosen, low_px=_HEADLINE_HEIGHT_PX) for name, chosen in by_visible_fraction.items()
            },
            "ap50_by_distance_m": {
                name: self.ap50(chosen, low_px=_HEADLINE_HEIGHT_PX) for name, chosen in by_distance_m.items()
            },
            "recall": _share(hits / headline.sum() if headline.any() else np.nan),
            "precision": _share(hits / (hits + false_alarms) if hits + false_alarms else np.nan),
            "false_alarms_per_image": _share(false_alarms / max(1, len(self.detections))),
            "right_label": _share(right_label[headline & hit].mean() if hits else np.nan),
            "recall_by_visible_fraction": {name: recall(chosen) for name, chosen in by_visible_fraction.items()},
            "recall_by_distance_m": {name: recall(chosen) for name, chosen in by_distance_m.items()},
        }


def evaluate(detector: Detector, labelled: LabelledImages) -> dict[str, object]:
    """Evaluate a detector on images of one size.

    Objects that show too little for a ground-truth box are ignored throughout. Labels are pooled: any motor vehicle's
    label is right for a vehicle, except in ``right_label``.

    Returns:
        ``images``, and for every road user that the images contain and the detector knows: ``objects``; ``ap50`` of all
        objects, ``ap50_headline`` of those of at least `_HEADLINE_HEIGHT_PX`, ``ap50_moderate`` of those of at least
        `_MODERATE_HEIGHT_PX` of which nothing hides more than half (KITTI's moderate difficulty: 25 px, partly
        occluded), ``ap50_by_height_px``; of the headline's
        ``ap50_by_visible_fraction`` and ``ap50_by_distance_m``, where every false alarm counts in every bin, since it
        has neither; at confidence 0.25 and for the headline's objects ``recall``, ``precision``,
        ``false_alarms_per_image``, ``right_label`` (share of the found ones), ``recall_by_visible_fraction``,
        ``recall_by_distance_m``. Shares are in 0..1, null where there is nothing to count; bins are ``low-high``.
    """
    detections: list[Detections] = []
    for start in range(0, len(labelled.images_rgb), _IMAGES_PER_CALL):
        detections += detector.detect(np.ascontiguousarray(labelled.images_rgb[start : start + _IMAGES_PER_CALL]))
    class_index = labelled.labels.class_index
    report: dict[str, object] = {"images": len(labelled.images_rgb)}
    for index, road_user in enumerate(ROAD_USERS):
        chosen = (class_index >= 0) & (_ROAD_USER_OF_CLASS[class_index] == index)
        found = [each.only(each.road_user_index == index) for each in detections]
        if (chosen & ~labelled.labels.ignored).any():
            report[road_user] = _Scored(labelled, found, chosen).report()
    return report


def _share(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None
