"""Networks that ultralytics exports: YOLOv8 to YOLO26 and RT-DETR."""

from __future__ import annotations

import numpy as np

from warpav.detection.families.family import (
    COCO_80,
    Candidates,
    Family,
    ImagePlacement,
    NetworkFile,
    ScoredFamily,
    edges_of,
    listed_candidates,
    single_output_shape,
)


class Ultralytics(ScoredFamily):
    """YOLOv8, YOLO11, YOLO26 and their like without suppression; also what warpav ships."""

    name = "ultralytics"
    layout = "one output [batch, 4 + classes, candidates] or [batch, candidates, 4 + classes]"

    @classmethod
    def _class_axis(cls, file: NetworkFile) -> int | None:
        """The axis of the output along which box and classes lie."""
        shape = single_output_shape(file)
        if shape is None:
            return None
        if file.labels is not None:
            wanted = 4 + len(file.labels)
            axes = [axis for axis in (1, 2) if shape[axis] == wanted]
            return axes[0] if axes else 1 if shape[1] is None and shape[2] is None else None
        known = [axis for axis in (1, 2) if (shape[axis] or 0) > 4]
        return min(known, key=lambda axis: (shape[axis] != 84, shape[axis] or 0)) if known else None

    @classmethod
    def fits(cls, file: NetworkFile) -> bool:
        return cls._class_axis(file) is not None

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        axis, shape = cls._class_axis(file), single_output_shape(file)
        assert shape is not None
        assert axis is not None
        if file.is_ultralytics_rtdetr or (axis == 2 and shape[2] == 6):
            return None
        if file.labels is not None:
            return f"{len(file.labels)} labels, and an output with 4 + {len(file.labels)} numbers for every candidate"
        if shape[axis] != 84 or shape[3 - axis] in (6, 85):  # cells of a small input, not classes
            return None
        return "84 numbers for every candidate: a box and the 80 classes of COCO"

    def __init__(self, file: NetworkFile) -> None:
        super().__init__(file)
        self._axis = self._class_axis(file)

    @property
    def class_count(self) -> int | None:
        rows = self.file.outputs[0].shape[self._axis or 1]
        return None if rows is None else rows - 4

    def decode(
        self, outputs: tuple[np.ndarray, ...], size_px: tuple[int, int], classes: np.ndarray, confidence_min: float
    ) -> Candidates:
        raw = outputs[0] if self._axis == 1 else outputs[0].T
        label_count = len(self.file.labels or ())
        if raw.ndim != 2 or len(raw) != 4 + label_count:
            raise self._came(0, outputs[0], f"4 + {label_count} labels")
        candidate, confidence, class_index = self._best(raw[4 + classes], classes, confidence_min)
        return Candidates(edges_of(raw[:4, candidate].T), confidence, class_index)


class UltralyticsEndToEnd(Family):
    """An ultralytics network with suppression built in (``nms=True``) or without need of it (YOLOv10, YOLO26)."""

    name = "ultralytics-end2end"
    layout = "one output [batch, candidates, 6] of x0, y0, x1, y1 in pixels, score and class"

    @classmethod
    def fits(cls, file: NetworkFile) -> bool:
        shape = single_output_shape(file)
        return shape is not None and shape[2] == 6

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        if not file.is_from_ultralytics or file.is_ultralytics_rtdetr:
            return None
        return "its metadata are of an ultralytics export, and its output has 6 numbers for every box"

    def decode(
        self, outputs: tuple[np.ndarray, ...], size_px: tuple[int, int], classes: np.ndarray, confidence_min: float
    ) -> Candidates:
        rows = outputs[0]
        if rows.ndim != 2 or rows.shape[1] != 6:
            raise self._came(0, rows, "6 numbers for every box")
        return listed_candidates(self.file, rows[:, :4], rows[:, 4], rows[:, 5], classes, confidence_min)


class UltralyticsRtdetr(Family):
    """Ultralytics' RT-DETR: boxes in parts of the input; today's exports give the best class, older ones all scores."""

    name = "ultralytics-rtdetr"
    layout = "one output [batch, candidates, 6] of centre and size in 0..1, score and class"
    placement = ImagePlacement.STRETCHED
    square_px = 640

    @classmethod
    def fits(cls, file: NetworkFile) -> bool:
        shape = single_output_shape(file)
        return shape is not None and shape[2] in (6, 4 + len(COCO_80 if file.labels is None else file.labels))

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        return "its metadata name ultralytics' RT-DETR" if file.is_ultralytics_rtdetr else None

    def decode(
        self, outputs: tuple[np.ndarray, ...], size_px: tuple[int, int], classes: np.ndarray, confidence_min: float
    ) -> Candidates:
        rows = outputs[0]
        if rows.ndim != 2 or rows.shape[1] not in (6, 4 + len(self.file.labels or ())):
            raise self._came(0, rows, "6 numbers for every box")
        box_input_px = edges_of(rows) * np.array([size_px[1], size_px[0]] * 2, np.float32)
        if rows.shape[1] == 6:
            return listed_candidates(self.file, box_input_px, rows[:, 4], rows[:, 5], classes, confidence_min)
        best = rows[:, 4:].argmax(axis=1)
        return listed_candidates(self.file, box_input_px, rows[:, 4:].max(axis=1), best, classes, confidence_min)
