"""Networks that list boxes, labels and scores: torchvision's, RT-DETR and D-FINE."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from warpav.detection.families.family import (
    COCO_91,
    Candidates,
    Family,
    ImagePlacement,
    NetworkFile,
    Tensor,
    listed_candidates,
)
from warpav.detection.families.ultralytics import UltralyticsEndToEnd


class _ListingFamily(Family):
    """Families with boxes, labels and scores as outputs of their own, distinguished by rank and type."""

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

    def _list(
        self, outputs: tuple[np.ndarray, ...], which: tuple[int, int, int], classes: np.ndarray, confidence_min: float
    ) -> Candidates:
        boxes, labels, scores = (outputs[k] for k in which)
        if boxes.ndim != 2 or boxes.shape[1] != 4:
            raise self._came(which[0], boxes, "4 edges for every box")
        for k, array in zip(which[1:], (labels, scores), strict=True):
            if array.shape != boxes.shape[:1]:
                raise self._came(k, array, f"one number for each of the {len(boxes)} boxes")
        return listed_candidates(self.file, boxes, scores, labels, classes, confidence_min)


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

    def __init__(self, file: NetworkFile) -> None:
        super().__init__(file)
        which = self._which(file)
        assert which is not None
        self._outputs = which
        self._is_batched = len(file.outputs[which[0]].shape) == 3

    @property
    def batch(self) -> int | None:
        # As many boxes as there are objects: an output without a batch's axis holds one image.
        return super().batch if self._is_batched else 1

    def each_image(self, outputs: Sequence[np.ndarray], image_count: int) -> list[tuple[np.ndarray, ...]]:
        return super().each_image(outputs, image_count) if self._is_batched else [tuple(outputs)]

    def decode(
        self, outputs: tuple[np.ndarray, ...], size_px: tuple[int, int], classes: np.ndarray, confidence_min: float
    ) -> Candidates:
        return self._list(outputs, self._outputs, classes, confidence_min)


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
            and cls._find(file, 1) is not None
        )

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        return f"its second input {file.inputs[1]} takes the size of the images, and it lists labels, boxes and scores"

    def __init__(self, file: NetworkFile) -> None:
        super().__init__(file)
        which, size_input = self._find(file, 1), self._size_input(file)
        assert which is not None
        assert size_input is not None
        self._outputs, self._size = which, size_input

    def feed(self, network_input: np.ndarray) -> dict[str, np.ndarray]:
        count, _, rows, columns = network_input.shape
        return super().feed(network_input) | {self._size.name: np.full((count, 2), (columns, rows), self._size.dtype)}

    def decode(
        self, outputs: tuple[np.ndarray, ...], size_px: tuple[int, int], classes: np.ndarray, confidence_min: float
    ) -> Candidates:
        return self._list(outputs, self._outputs, classes, confidence_min)


class RtdetrSingle(UltralyticsEndToEnd):
    """RT-DETRv4's exporter: one output, boxes in pixels of its input."""

    name = "rtdetr-single"
    placement = ImagePlacement.STRETCHED
    square_px = 640

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        return None  # nothing in such a file distinguishes it from an end-to-end one
