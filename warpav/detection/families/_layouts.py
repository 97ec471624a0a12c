"""Layouts by who exports them: ultralytics, YOLOX, and networks that list boxes, labels and scores."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np

from warpav.detection.families._family import (
    COCO_80,
    COCO_91,
    GREY,
    Asked,
    Candidates,
    Family,
    ImagePlacement,
    NetworkFile,
    ScoredFamily,
    Tensor,
    edges_of,
    listed_candidates,
    single_output_shape,
)

# ------------------------------------------------------------------------------------ YOLOv8 to YOLO26 and RT-DETR


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
        if file.is_ultralytics_rtdetr or (axis == 2 and shape[2] == 6) or (shape[axis] is None and file.is_end_to_end):
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

    def decode(self, outputs: tuple[np.ndarray, ...], asked: Asked) -> Candidates:
        raw = outputs[0] if self._axis == 1 else outputs[0].T
        label_count = len(self.file.labels or ())
        if raw.ndim != 2 or len(raw) != 4 + label_count:
            raise self._came(0, outputs[0], f"4 + {label_count} labels")
        candidate, confidence, class_index = self._best(raw[4 + asked.classes], asked)
        return Candidates(edges_of(raw[:4, candidate].T), confidence, class_index)


class UltralyticsEndToEnd(Family):
    """An ultralytics network with suppression built in (``nms=True``) or without need of it (YOLOv10, YOLO26)."""

    name = "ultralytics-end2end"
    layout = "one output [batch, candidates, 6] of x0, y0, x1, y1 in pixels, score and class"

    @classmethod
    def fits(cls, file: NetworkFile) -> bool:
        return _may_have_columns(file, 6)

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        if not file.is_from_ultralytics or file.is_ultralytics_rtdetr:
            return None
        shape = single_output_shape(file)
        assert shape is not None
        if shape[2] is None:
            return "its metadata are of an ultralytics export that suppresses by itself" if file.is_end_to_end else None
        return "its metadata are of an ultralytics export, and its output has 6 numbers for every box"

    @property
    def batch(self) -> int | None:
        # A suppression that was appended (``nms=True``) is a loop over the images of its export, which the file's axes
        # do not tell; further images come out empty.
        fixed, stated = super().batch, self.file.metadata.get("batch", "")
        if fixed is not None or not self.file.is_from_ultralytics or self.file.metadata.get("end2end") == "True":
            return fixed
        return int(stated) if stated.isdecimal() and 0 < int(stated) <= 1024 else 1

    def decode(self, outputs: tuple[np.ndarray, ...], asked: Asked) -> Candidates:
        rows = outputs[0]
        if rows.ndim != 2 or rows.shape[1] != 6:
            raise self._came(0, rows, "6 numbers for every box")
        return listed_candidates(self.file, rows[:, :4], rows[:, 4], rows[:, 5], asked)


class UltralyticsRtdetr(Family):
    """Ultralytics' RT-DETR: boxes in parts of the input; today's exports give the best class, older ones all scores."""

    name = "ultralytics-rtdetr"
    layout = "one output [batch, candidates, 6] of centre and size in 0..1, score and class"
    placement = ImagePlacement.STRETCHED
    square_px = 640

    @classmethod
    def fits(cls, file: NetworkFile) -> bool:
        return _may_have_columns(file, 6, 4 + len(COCO_80 if file.labels is None else file.labels))

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        return "its metadata name ultralytics' RT-DETR" if file.is_ultralytics_rtdetr else None

    def decode(self, outputs: tuple[np.ndarray, ...], asked: Asked) -> Candidates:
        rows = outputs[0]
        if rows.ndim != 2 or rows.shape[1] not in (6, 4 + len(self.file.labels or ())):
            raise self._came(0, rows, "6 numbers for every box")
        box_input_px = edges_of(rows) * np.array([asked.size_px[1], asked.size_px[0]] * 2, np.float32)
        if rows.shape[1] == 6:
            return listed_candidates(self.file, box_input_px, rows[:, 4], rows[:, 5], asked)
        best = rows[:, 4:].argmax(axis=1)
        return listed_candidates(self.file, box_input_px, rows[:, 4:].max(axis=1), best, asked)


def _may_have_columns(file: NetworkFile, *counts: int) -> bool:
    """Whether the only output has one of so many numbers for every box, or may have: its sides are left open."""
    shape = single_output_shape(file)
    if shape is None or shape[2] is not None:
        return shape is not None and shape[2] in counts
    return shape[1] is None or file.is_end_to_end


# ----------------------------------------------------------------- YOLOX, whose boxes belong to the cells of grids


class Yolox(ScoredFamily):
    """YOLOX as its exporter leaves it by default: offsets from the cells of three (four) grids."""

    name = "yolox"
    layout = "one output [batch, cells of all grids, 5 + classes] with offsets from the cells"
    placement = ImagePlacement.TOP_LEFT
    is_bgr = True
    white = 255.0
    _decodes: ClassVar[bool] = False
    _boxes: ClassVar[int] = 1  # of every cell

    @classmethod
    def fits(cls, file: NetworkFile) -> bool:
        shape = single_output_shape(file)
        if shape is None or shape[2] is None or shape[2] < 6:
            return False
        if file.labels is not None and shape[2] != 5 + len(file.labels):
            return False
        return file.size_px is None or shape[1] is None or _grid(*file.size_px, shape[1], cls._boxes) is not None

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        shape = single_output_shape(file)
        assert shape is not None
        if file.is_from_ultralytics or (shape[2] == 6 and (file.size_px is None or shape[1] is None)):
            return None
        if file.labels is None and shape[2] != 85:
            return None
        if cls._decodes != _gives_pixels(file):
            return None
        numbers = f"{shape[2]} numbers for every cell: a box, objectness and {(shape[2] or 0) - 5} classes"
        return f"{numbers}; on a grey image its boxes {'follow the cells' if cls._decodes else 'are offsets'}"

    @property
    def class_count(self) -> int | None:
        return (self.file.outputs[0].shape[2] or 5) - 5

    def decode(self, outputs: tuple[np.ndarray, ...], asked: Asked) -> Candidates:
        raw = outputs[0]
        label_count = len(self.file.labels or ())
        grid = (
            _grid(*asked.size_px, len(raw), self._boxes) if raw.ndim == 2 and raw.shape[1] == 5 + label_count else None
        )
        if grid is None:
            raise self._came(0, raw, f"a row of 5 + {label_count} labels for every cell of {asked.size_px} px")
        score = raw[:, 5 + asked.classes] * raw[:, 4:5]
        candidate, confidence, class_index = self._best(score.T, asked)
        box = raw[candidate, :4]
        if not self._decodes:
            cell, stride_px = grid[0][candidate], grid[1][candidate, None]
            with np.errstate(over="ignore"):  # an endless box is cut off at the image's border
                box = np.concatenate([(box[:, :2] + cell) * stride_px, np.exp(box[:, 2:]) * stride_px], axis=1)
        return Candidates(edges_of(box), confidence, class_index)


class YoloxDecoded(Yolox):
    """YOLOX exported with ``--decode_in_inference``: boxes in pixels of the input."""

    name = "yolox-decoded"
    layout = "one output [batch, cells of all grids, 5 + classes] with boxes in pixels"
    _decodes = True


class YoloV5(YoloxDecoded):
    """YOLOv5 and YOLOv7 as their own repositories export them, with three boxes for every cell."""

    name = "yolov5"
    layout = "one output [batch, 3 x cells of all grids, 5 + classes] with boxes in pixels"
    placement = ImagePlacement.CENTRED
    is_bgr = False
    white = 1.0
    _boxes = 3

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        shape = single_output_shape(file)
        assert shape is not None
        if file.is_end_to_end or (file.labels is None and shape[2] != 85):
            return None
        size_px, rows = (file.size_px, np.empty(shape[1])) if file.size_px and shape[1] else _on_grey(file)
        if _grid(*size_px, len(rows), cls._boxes) is None:
            return None
        return (
            f"{shape[2]} numbers for every one of 3 boxes a cell: a box, objectness and {(shape[2] or 0) - 5} classes"
        )


@functools.lru_cache(maxsize=16)
def _grid(rows_px: int, columns_px: int, count: int, boxes: int = 1) -> tuple[np.ndarray, np.ndarray] | None:
    """Column and row of every cell of YOLO's grids [cell, 2] and their strides [px]; None: not so many boxes."""
    for strides in ((8, 16, 32), (8, 16, 32, 64)):
        shapes = [(rows_px // stride, columns_px // stride) for stride in strides]
        if boxes * sum(rows * columns for rows, columns in shapes) == count:
            cells = [np.indices(shape).reshape(2, -1)[::-1].T for shape in shapes]
            stride_px = [np.full(len(cell), stride) for cell, stride in zip(cells, strides, strict=True)]
            return np.concatenate(cells).astype(np.float32), np.concatenate(stride_px).astype(np.float32)
    return None


def _on_grey(file: NetworkFile) -> tuple[tuple[int, int], np.ndarray]:
    """Rows and columns of a grey image, and what the network makes of it."""
    assert file.image is not None
    size_px = file.size_px or (256, 256)
    grey = np.full((file.image.shape[0] or 1, 3, *size_px), GREY, file.image.dtype)
    return size_px, file.run({file.image.name: grey})[0][0]


def _gives_pixels(file: NetworkFile) -> bool | None:
    """Whether box centres follow the cells on a grey image, or are offsets; None: not as many boxes as cells."""
    size_px, centre = _on_grey(file)
    grid = _grid(*size_px, len(centre))
    if grid is None:
        return None
    place_px = (grid[0] + 0.5) * grid[1][:, None]
    centre = centre[:, :2].astype(np.float64)
    if not np.isfinite(centre).all() or (centre.std(axis=0) == 0.0).any():
        return False
    return all(np.corrcoef(centre[:, axis], place_px[:, axis])[0, 1] > 0.8 for axis in (0, 1))


# -------------------------------------------------------------------------- torchvision's networks, RT-DETR, D-FINE


class _ListingFamily(Family):
    """Families with boxes, labels and scores as outputs of their own, distinguished by rank and type."""

    def __init__(self, file: NetworkFile) -> None:
        super().__init__(file)
        which = self._which(file)
        assert which is not None
        self._outputs = which

    @classmethod
    def _which(cls, file: NetworkFile) -> tuple[int, int, int] | None:
        return cls._find(file, 1)

    @staticmethod
    def _find(file: NetworkFile, batch_axes: int) -> tuple[int, int, int] | None:
        """Which outputs are the boxes, labels and scores, with so many axes for the batch."""

        def only(name: str, wanted: Callable[[Tensor], bool]) -> int | None:
            found = [k for k, tensor in enumerate(file.outputs) if wanted(tensor)]
            named = [k for k in found if file.outputs[k].name.lower() == name]
            return found[0] if len(found) == 1 else named[0] if named else None

        found = (
            only("boxes", lambda it: it.is_float and len(it.shape) == 2 + batch_axes and it.shape[-1] in (4, None)),
            only("labels", lambda it: it.is_integer and len(it.shape) == 1 + batch_axes),
            only("scores", lambda it: it.is_float and len(it.shape) == 1 + batch_axes),
        )
        boxes, labels, scores = found
        return None if boxes is None or labels is None or scores is None else (boxes, labels, scores)

    def decode(self, outputs: tuple[np.ndarray, ...], asked: Asked) -> Candidates:
        which = self._outputs
        boxes, labels, scores = (outputs[k] for k in which)
        if boxes.ndim != 2 or boxes.shape[1] != 4:
            raise self._came(which[0], boxes, "4 edges for every box")
        for k, array in zip(which[1:], (labels, scores), strict=True):
            if array.shape != boxes.shape[:1]:
                raise self._came(k, array, f"one number for each of the {len(boxes)} boxes")
        return listed_candidates(self.file, boxes, scores, labels, asked)


class Torchvision(_ListingFamily):
    """Detection networks of torchvision: Faster R-CNN, RetinaNet, SSD and their like."""

    name = "torchvision"
    layout = "input [3, rows, columns] and outputs boxes [n, 4], labels [n], scores [n], or all with a batch's axis"
    placement = ImagePlacement.TOP_LEFT
    stride_px = 1
    assumed_labels = COCO_91

    @classmethod
    def fits(cls, file: NetworkFile) -> bool:
        return file.image is not None and len(file.inputs) == 1 and cls._which(file) is not None

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        return "its outputs are boxes, labels and scores, and images its only input"

    @classmethod
    def _which(cls, file: NetworkFile) -> tuple[int, int, int] | None:
        return cls._find(file, 0) or (cls._find(file, 1) if file.image and len(file.image.shape) == 4 else None)

    @property
    def _is_batched(self) -> bool:
        return len(self.file.outputs[self._outputs[0]].shape) == 3

    @property
    def batch(self) -> int | None:
        # As many boxes as there are objects: an output without a batch's axis holds one image.
        return super().batch if self._is_batched else 1

    def each_image(self, outputs: Sequence[np.ndarray], image_count: int) -> list[tuple[np.ndarray, ...]]:
        return super().each_image(outputs, image_count) if self._is_batched else [tuple(outputs)]


class Rtdetr(_ListingFamily):
    """RT-DETR, RT-DETRv2, D-FINE with ``orig_target_sizes`` as second input, which gets the network input's size."""

    name = "rtdetr"
    layout = "inputs images and orig_target_sizes, outputs labels [batch, n], boxes [batch, n, 4], scores [batch, n]"
    placement = ImagePlacement.STRETCHED
    square_px = 640

    @staticmethod
    def _size_input(file: NetworkFile) -> Tensor | None:
        found = [it for it in file.inputs if len(it.shape) == 2 and it.shape[1] in (2, None) and it is not file.image]
        return found[0] if len(found) == 1 and (found[0].is_integer or found[0].is_float) else None

    @classmethod
    def fits(cls, file: NetworkFile) -> bool:
        return (
            file.image is not None
            and len(file.image.shape) == 4
            and len(file.inputs) == 2
            and cls._size_input(file) is not None
            and cls._which(file) is not None
        )

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        return f"its second input {file.inputs[1]} takes the size of the images, and it lists labels, boxes and scores"

    def feed(self, network_input: np.ndarray) -> dict[str, np.ndarray]:
        count, _, rows, columns = network_input.shape
        size = self._size_input(self.file)
        assert size is not None
        return super().feed(network_input) | {size.name: np.full((count, 2), (columns, rows), size.dtype)}


class RtdetrSingle(UltralyticsEndToEnd):
    """RT-DETRv4's exporter: one output, boxes in pixels of its input."""

    name = "rtdetr-single"
    placement = ImagePlacement.STRETCHED
    square_px = 640

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        return None  # nothing in such a file distinguishes it from an end-to-end one
