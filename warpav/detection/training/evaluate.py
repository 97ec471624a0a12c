"""How well a detector finds vehicles in pictures of town scenes: the figures of the model card.

python -m warpav.detection.training.evaluate --data FOLDER --model FILE.onnx --json FILE.json
"""

from __future__ import annotations

import argparse
import itertools
import json
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warpav.detection.average_precision import average_precision, score_image
from warpav.detection.detector import Detections, Detector
from warpav.detection.matching import match_detections
from warpav.detection.onnx_detector import OnnxDetector
from warpav.detection.training.data import Pictures, load_pictures

# Least height of a visible box [px] from which on a vehicle counts in the headline figure.
HEADLINE_HEIGHT_PX = 12.0
HEIGHT_BINS_PX = (0.0, 8.0, 12.0, 16.0, 24.0, 32.0, 64.0, 128.0, 1024.0)
VISIBLE_FRACTION_BINS = (0.0, 0.25, 0.5, 0.75, 1.01)
DISTANCE_BINS_M = (0.0, 5.0, 10.0, 20.0, 30.0, 40.0, 60.0, 1000.0)
# Recall, precision and the labels are judged at this confidence.
OPERATING_CONFIDENCE = 0.25

_IMAGES_PER_CALL = 32

_logger = logging.getLogger(__name__)


def evaluate(detector: Detector, pictures: Pictures) -> dict[str, object]:
    """Judge a detector on pictures of one size.

    Objects that show too little for a ground-truth box are ignored throughout.

    Args:
        detector: Asked for detections of low confidence too, or the average precision comes out too low.
        pictures: Images and objects.

    Returns:
        ``images``, ``objects``; ``ap50`` of all objects, ``ap50_headline`` of those of at least `HEADLINE_HEIGHT_PX`,
        ``ap50_by_height_px``; at confidence 0.25 and for the same objects ``recall``, ``precision``,
        ``right_label`` (share of the found ones), ``recall_by_visible_fraction``, ``recall_by_distance_m``. Shares are
        in 0..1, null where there is nothing to count; bins are ``low-high``.
    """
    labels = pictures.labels
    exists = (labels.class_index >= 0) & ~labels.too_small
    height_px = labels.box_px[..., 3] - labels.box_px[..., 1]
    detections: list[Detections] = []
    for start in range(0, len(pictures.images_rgb), _IMAGES_PER_CALL):
        detections += detector.detect(np.ascontiguousarray(pictures.images_rgb[start : start + _IMAGES_PER_CALL]))

    def ap50(low_px: float, high_px: float) -> float | None:
        scores = []
        for image, found in enumerate(detections):
            held = labels.class_index[image] >= 0
            found_height_px = found.box_px[:, 3] - found.box_px[:, 1]
            scores.append(
                score_image(
                    labels.box_px[image, held],
                    found.box_px,
                    found.confidence,
                    truth_ignored=~(exists & (height_px >= low_px) & (height_px < high_px))[image, held],
                    detection_ignored_unless_matched=(found_height_px < low_px) | (found_height_px >= high_px),
                )
            )
        return _share(average_precision(scores))

    headline = exists & (height_px >= HEADLINE_HEIGHT_PX)
    hit = np.zeros(exists.shape, bool)
    right_label = np.zeros(exists.shape, bool)
    false_alarms = 0
    for image, found in enumerate(detections):
        held = np.nonzero(labels.class_index[image] >= 0)[0]
        match = match_detections(
            labels.box_px[image, held], found.box_px, found.confidence, confidence_min=OPERATING_CONFIDENCE
        )
        hit[image, held] = match >= 0
        matched = held[match >= 0]
        right_label[image, matched] = found.class_index[match[match >= 0]] == labels.class_index[image, matched]
        free = np.setdiff1d(np.nonzero(found.confidence >= OPERATING_CONFIDENCE)[0], match)
        false_alarms += int((found.box_px[free, 3] - found.box_px[free, 1] >= HEADLINE_HEIGHT_PX).sum())

    def recall_by(value: np.ndarray, edges: Sequence[float]) -> dict[str, float | None]:
        recall = {}
        for low, high in itertools.pairwise(edges):
            counted = headline & (value >= low) & (value < high)
            recall[f"{low:g}-{high:g}"] = _share(hit[counted].mean() if counted.any() else np.nan)
        return recall

    hits = int(hit[headline].sum())
    return {
        "images": len(pictures.images_rgb),
        "objects": int(exists.sum()),
        "objects_headline": int(headline.sum()),
        "ap50": ap50(0.0, np.inf),
        "ap50_headline": ap50(HEADLINE_HEIGHT_PX, np.inf),
        "ap50_by_height_px": {f"{low:g}-{high:g}": ap50(low, high) for low, high in itertools.pairwise(HEIGHT_BINS_PX)},
        "recall": _share(hits / max(1, headline.sum())),
        "precision": _share(hits / max(1, hits + false_alarms)),
        "right_label": _share(right_label[headline & hit].mean() if hits else np.nan),
        "recall_by_visible_fraction": recall_by(labels.visible_fraction, VISIBLE_FRACTION_BINS),
        "recall_by_distance_m": recall_by(labels.distance_m, DISTANCE_BINS_M),
    }


def _share(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Judge a detector on pictures of town scenes.")
    parser.add_argument("--data", type=Path, required=True, help="folder that training.data wrote")
    parser.add_argument("--model", default="builtin", help="ONNX file, or builtin")
    parser.add_argument("--json", type=Path, required=True, help="where to write the figures")
    parser.add_argument("--image-count", type=int, default=None, help="only so many images of each size")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")

    detector = OnnxDetector(options.model, confidence_min=0.01)
    report = {}
    for side_px, pictures in load_pictures(options.data).items():
        report[str(side_px)] = evaluate(detector, pictures.first(options.image_count))
        _logger.info("%d px: %s", side_px, json.dumps(report[str(side_px)]))
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
