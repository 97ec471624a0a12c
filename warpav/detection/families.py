"""The layouts of ONNX detectors: how each wants its images, and how its outputs become boxes.

An ONNX file states names, shapes and types of its inputs and outputs, but not what the numbers mean. Networks of
one *family* share that meaning. `recognise` finds the family of a file (the user's option wins, then the file's
metadata, then its inputs and outputs) together with the reason in words; from there on a family *packs* images into the
network's input and *decodes* its outputs into `Candidates`, boxes in pixels of that input.

======================= ============================ ===================================================================
format                  images                       outputs
======================= ============================ ===================================================================
``ultralytics``         RGB 0..1, centred on grey    [b, 4 + classes, n], [b, n, 4 + classes]: centre, size [px], scores
``ultralytics-end2end`` RGB 0..1, centred on grey    [b, n, 6]: x0, y0, x1, y1 [px], score, class
``ultralytics-rtdetr``  RGB 0..1, stretched          [b, n, 6]: centre, size in 0..1, score, class
``yolox``               BGR 0..255, top left on grey [b, n, 5 + classes]: offset, log size [cells], objectness, scores
``yolox-decoded``       BGR 0..255, top left on grey [b, n, 5 + classes]: centre, size [px], objectness, scores
``torchvision``         RGB 0..1, top left on grey   boxes, labels, scores in any order; class 0 is the background
``rtdetr``              RGB 0..1, stretched          labels, boxes, scores; second input: the size that boxes refer to
``rtdetr-single``       RGB 0..1, stretched          [b, n, 6]: x0, y0, x1, y1 [px], score, class
======================= ============================ ===================================================================

RT-DETR and D-FINE are trained, evaluated and deployed on images that are stretched to the square input, whatever their
shape, and so is ultralytics' RT-DETR; none of them is letterboxed here. torchvision pads its own batches at the right
and the bottom with what is the mean colour, a grey, after its normalisation.
"""

from __future__ import annotations

import ast
import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import ClassVar

import numpy as np

from warpav.core.errors import InputError, OptionError

GREY = 114
BACKGROUND = "__background__"

_COCO_GAPS = {12, 26, 29, 30, 45, 66, 68, 69, 71, 83}
_COCO_LABELS = """
person bicycle car motorcycle airplane bus train truck boat traffic_light fire_hydrant stop_sign parking_meter bench
bird cat dog horse sheep cow elephant bear zebra giraffe backpack umbrella handbag tie suitcase frisbee skis
snowboard sports_ball kite baseball_bat baseball_glove skateboard surfboard tennis_racket bottle wine_glass cup fork
knife spoon bowl banana apple sandwich orange broccoli carrot hot_dog pizza donut cake chair couch potted_plant bed
dining_table toilet tv laptop mouse remote keyboard cell_phone microwave oven toaster sink refrigerator book clock
vase scissors teddy_bear hair_drier toothbrush
"""
COCO_80 = tuple(label.replace("_", " ") for label in _COCO_LABELS.split())


def _coco_91() -> tuple[str, ...]:
    """COCO's labels at COCO's own numbers, which leave ten out; 0 is the background."""
    labels = iter(COCO_80)
    return (BACKGROUND, *("N/A" if number in _COCO_GAPS else next(labels) for number in range(1, 91)))


COCO_91 = _coco_91()


class ImagePlacement(Enum):
    """Where an image lies in the network's input."""

    CENTRED = "centred"
    TOP_LEFT = "top left"
    STRETCHED = "stretched"


@dataclass(frozen=True)
class Letterbox:
    """How an image is scaled and padded to the network's input.

    Attributes:
        input_height_px: Height of the network's input [px].
        input_width_px: Width of the network's input [px].
        scaled_height_px: Height of the scaled image in it [px].
        scaled_width_px: Width of the scaled image in it [px].
        top_px: Rows of grey above it.
        left_px: Columns of grey left of it.
    """

    input_height_px: int
    input_width_px: int
    scaled_height_px: int
    scaled_width_px: int
    top_px: int
    left_px: int

    @classmethod
    def fit(
        cls,
        height_px: int,
        width_px: int,
        input_height_px: int,
        input_width_px: int,
        placement: ImagePlacement = ImagePlacement.CENTRED,
    ) -> Letterbox:
        """The letterbox that shows an image as large as the input allows; a stretched one fills the input."""
        if placement is ImagePlacement.STRETCHED:
            return cls(input_height_px, input_width_px, input_height_px, input_width_px, 0, 0)
        scale = min(input_height_px / height_px, input_width_px / width_px)
        scaled_height_px = max(1, min(input_height_px, round(height_px * scale)))
        scaled_width_px = max(1, min(input_width_px, round(width_px * scale)))
        centred = placement is ImagePlacement.CENTRED
        return cls(
            input_height_px,
            input_width_px,
            scaled_height_px,
            scaled_width_px,
            (input_height_px - scaled_height_px) // 2 if centred else 0,
            (input_width_px - scaled_width_px) // 2 if centred else 0,
        )

    def canvas(self, images_rgb: np.ndarray) -> np.ndarray:
        """The images at their position in the input, uint8, shape [image, row, column, 3].

        Args:
            images_rgb: Images, uint8, shape [image, row, column, 3].
        """
        if images_rgb.shape[1:3] == (self.input_height_px, self.input_width_px):
            return images_rgb
        import cv2

        canvas = np.full((len(images_rgb), self.input_height_px, self.input_width_px, 3), GREY, np.uint8)
        rows = slice(self.top_px, self.top_px + self.scaled_height_px)
        columns = slice(self.left_px, self.left_px + self.scaled_width_px)
        for image_rgb, target in zip(images_rgb, canvas, strict=True):
            target[rows, columns] = cv2.resize(
                image_rgb, (self.scaled_width_px, self.scaled_height_px), interpolation=cv2.INTER_LINEAR
            )
        return canvas

    def unpack(self, box_input_px: np.ndarray, height_px: int, width_px: int) -> np.ndarray:
        """Boxes of the network's input as boxes of the image, cut off at its border, float32 [box, 4]."""
        left_top = np.array([self.left_px, self.top_px] * 2, np.float32)
        scale = np.array([width_px / self.scaled_width_px, height_px / self.scaled_height_px] * 2, np.float32)
        size = np.array([width_px, height_px] * 2, np.float32)
        return np.clip((box_input_px - left_top) * scale, 0.0, size).astype(np.float32)


@dataclass(frozen=True)
class Tensor:
    """One input or output of a network.

    Attributes:
        name: Its name in the file.
        shape: Its axes; None where an axis is dynamic.
        dtype: NumPy's name of its numbers, such as float32.
    """

    name: str
    shape: tuple[int | None, ...]
    dtype: str

    @property
    def is_float(self) -> bool:
        """Whether it holds floating-point numbers that onnxruntime gives to NumPy."""
        return self.dtype in ("float16", "float32", "float64")

    @property
    def is_integer(self) -> bool:
        """Whether it holds whole numbers."""
        return self.dtype in ("int32", "int64")

    def __str__(self) -> str:
        """Name, shape with ? for dynamic axes, and number type."""
        axes = ", ".join("?" if side is None else str(side) for side in self.shape)
        return f"{self.name} [{axes}] {self.dtype}"


@dataclass(frozen=True)
class NetworkFile:
    """Metadata, inputs and outputs of an ONNX file.

    Attributes:
        path: The file.
        inputs: Its inputs.
        outputs: Its outputs.
        metadata: What the exporter wrote beside the network.
        labels: Labels in the order of the classes, from the user or else the metadata; None if unknown.
        labels_origin: Where they come from, in words.
        run: Runs the network: inputs by name to outputs in order.
    """

    path: Path
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    metadata: Mapping[str, str]
    labels: tuple[str, ...] | None
    labels_origin: str
    run: Callable[[dict[str, np.ndarray]], list[np.ndarray]]

    def __str__(self) -> str:
        """Its inputs, outputs and number of labels."""
        text = f"inputs {'; '.join(map(str, self.inputs))}, outputs {'; '.join(map(str, self.outputs))}"
        text = text if len(text) <= 400 else text[:400] + " ..."
        return text + (
            ", no labels" if self.labels is None else f", {len(self.labels)} label" + "s" * (len(self.labels) != 1)
        )

    @property
    def image(self) -> Tensor | None:
        """The input that takes images, shape [batch, 3, row, column] or [3, row, column]."""
        for tensor in self.inputs:
            if len(tensor.shape) in (3, 4) and tensor.shape[-3] in (3, None) and tensor.is_float:
                return tensor
        return None

    @property
    def size_px(self) -> tuple[int, int] | None:
        """Rows and columns of the input where the file fixes them."""
        rows, columns = (None, None) if self.image is None else self.image.shape[-2:]
        return None if rows is None or columns is None else (rows, columns)

    @property
    def is_from_ultralytics(self) -> bool:
        """Whether its metadata are those that ultralytics writes, apart from labels."""
        return bool({"head", "end2end", "imgsz", "task"} & set(self.metadata)) or "Ultralytics" in (
            self.metadata.get("description", "") + self.metadata.get("author", "")
        )

    @property
    def is_ultralytics_rtdetr(self) -> bool:
        """Whether its metadata name ultralytics' RT-DETR; older exports name no head, but the model."""
        head = self.metadata.get("head")
        description = self.metadata.get("description", "").lower().replace("-", "")
        return head == "RTDETRDecoder" if head is not None else self.is_from_ultralytics and "rtdetr" in description


@dataclass(frozen=True)
class Candidates:
    """Boxes that a network proposes for one image.

    Attributes:
        box_input_px: Edges ``x0, y0, x1, y1`` in pixels of the network's input, float32 [candidate, 4].
        confidence: In 0..1, float32 [candidate].
        class_index: Class of the network, int32 [candidate].
    """

    box_input_px: np.ndarray
    confidence: np.ndarray
    class_index: np.ndarray


def _edges(centre_and_size: np.ndarray) -> np.ndarray:
    """Edges of boxes given as rows of centre and size, shape [box, 4]."""
    half = 0.5 * centre_and_size[:, 2:4]
    return np.concatenate([centre_and_size[:, :2] - half, centre_and_size[:, :2] + half], axis=1)


def _single_output(file: NetworkFile) -> tuple[int | None, ...] | None:
    """The shape of the only output of a network of one batched image input, if it has three axes."""
    if file.image is None or len(file.inputs) != 1 or len(file.image.shape) != 4 or len(file.outputs) != 1:
        return None
    output = file.outputs[0]
    return output.shape if len(output.shape) == 3 and output.is_float else None


class Family(ABC):
    """One layout of inputs and outputs; an instance serves one file.

    Attributes:
        file: The file that it serves.
        image: The input for images.
        name: What `detector.format` calls it.
        layout: Its inputs and outputs in words.
        placement: Where an image lies in the input.
        is_bgr: Whether blue comes first.
        white: The value of white.
        stride_px: Inputs of dynamic size are multiples of this.
        suppresses: Whether the network itself gives an object one box of a class.
        square_px: Side of the input of a file of dynamic size, where it must be square; None: as the image.
        assumed_labels: Labels if neither user, metadata nor the number of classes determines them; None: an error.
    """

    name: ClassVar[str]
    layout: ClassVar[str]
    placement: ClassVar[ImagePlacement] = ImagePlacement.CENTRED
    is_bgr: ClassVar[bool] = False
    white: ClassVar[float] = 1.0
    stride_px: ClassVar[int] = 32
    suppresses: ClassVar[bool] = True
    square_px: ClassVar[int | None] = None
    assumed_labels: ClassVar[tuple[str, ...] | None] = COCO_80

    def __init__(self, file: NetworkFile) -> None:
        """A family's reader of a file that it fits."""
        assert file.image is not None
        self.file = file
        self.image = file.image

    @classmethod
    @abstractmethod
    def fits(cls, file: NetworkFile) -> bool:
        """Whether the file's inputs and outputs may be of this family."""

    @classmethod
    @abstractmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        """Why a matching file is of this family and no other, in words; None if that cannot be decided."""

    @property
    def class_count(self) -> int | None:
        """Number of classes, if the outputs' shapes determine it."""
        return None

    @property
    def batch(self) -> int | None:
        """Number of images of one run, where the file fixes it."""
        return self.image.shape[0] if len(self.image.shape) == 4 else 1

    @property
    def takes_unit_rgb(self) -> bool:
        """Whether the input is RGB in 0..1, float32, so that such tensors go in as they are."""
        return not self.is_bgr and self.white == 1.0 and self.image.dtype == "float32"

    @property
    def takes_device_tensor(self) -> bool:
        """Whether a tensor on a GPU can be the network's only input, whatever the number of images."""
        return self.takes_unit_rgb and len(self.file.inputs) == 1 and self.batch is None

    def input_size_px(self, height_px: int, width_px: int, input_px: int | None) -> tuple[int, int]:
        """Rows and columns of the network's input for an image.

        Args:
            height_px: Height of the image.
            width_px: Width of the image.
            input_px: The wanted longer side of the image in it; None: as it is.
        """
        if self.file.size_px is not None:
            return self.file.size_px
        if self.square_px is not None:
            return (input_px or self.square_px, input_px or self.square_px)
        scale = 1.0 if input_px is None else input_px / max(height_px, width_px)
        fixed = self.image.shape[-2:]
        rows, columns = (
            max(1, math.ceil(round(side * scale) / self.stride_px)) * self.stride_px for side in (height_px, width_px)
        )
        return (fixed[0] or rows, fixed[1] or columns)

    def pack(self, images_rgb: np.ndarray, letterbox: Letterbox) -> np.ndarray:
        """Images as the network wants them, float32 [image, 3, row, column].

        Args:
            images_rgb: Images, uint8 [image, row, column, 3].
            letterbox: Where they lie in the input.
        """
        canvas = letterbox.canvas(images_rgb).transpose(0, 3, 1, 2)
        network_input = np.empty(canvas.shape, np.float32)
        scale = np.float32(self.white / 255.0)
        np.multiply(canvas[:, ::-1] if self.is_bgr else canvas, scale, out=network_input, casting="unsafe")
        return network_input

    def feed(self, network_input: np.ndarray) -> dict[str, np.ndarray]:
        """The network's inputs by name.

        Args:
            network_input: From `pack`, of as many images as one run takes.
        """
        array = network_input if len(self.image.shape) == 4 else network_input[0]
        return {self.image.name: array.astype(self.image.dtype, copy=False)}

    def each_image(self, outputs: Sequence[np.ndarray], image_count: int) -> list[tuple[np.ndarray, ...]]:
        """The outputs of one run, image by image.

        Raises:
            InputError: They are not of the shapes that the file promises.
        """
        for tensor, array in zip(self.file.outputs, outputs, strict=True):
            if array.ndim == 0 or len(array) != image_count:
                raise InputError(
                    f"{self.file.path}: output {tensor.name} came as {list(array.shape)}, expected {image_count} "
                    "images along the first axis; export the network with a dynamic batch"
                )
        return [tuple(array[k] for array in outputs) for k in range(image_count)]

    @abstractmethod
    def decode(
        self, outputs: tuple[np.ndarray, ...], size_px: tuple[int, int], classes: np.ndarray, confidence_min: float
    ) -> Candidates:
        """Boxes of one image.

        Args:
            outputs: All outputs of one image, the batch's axis taken off.
            size_px: Rows and columns of the network's input.
            classes: The classes to detect, int32.
            confidence_min: Least confidence.

        Raises:
            InputError: The outputs are not of the shapes that the file promises.
        """

    def _came(self, output: int, array: np.ndarray, expected: str) -> InputError:
        """What is wrong with an output; the batch's axis is off."""
        return InputError(
            f"{self.file.path}: output {self.file.outputs[output].name} came as {list(array.shape)} for an image, "
            f"expected {expected}, as the {self.name} layout has it; name another with detector.format"
        )


class _Scored(Family):
    """Families that give every candidate a score of every class."""

    suppresses = False
    assumed_labels = None

    @staticmethod
    def _best(score: np.ndarray, classes: np.ndarray, confidence_min: float) -> tuple[np.ndarray, ...]:
        """Candidates of enough confidence, that confidence and their class, of scores [class, candidate]."""
        confidence = score.max(axis=0)
        candidate = np.nonzero(confidence >= confidence_min)[0]
        return candidate, confidence[candidate], classes[score[:, candidate].argmax(axis=0)]


class _Ultralytics(_Scored):
    """YOLOv8, YOLO11, YOLO26 and their like without suppression; also what warpav ships."""

    name = "ultralytics"
    layout = "one output [batch, 4 + classes, candidates] or [batch, candidates, 4 + classes]"

    @classmethod
    def _class_axis(cls, file: NetworkFile) -> int | None:
        """The axis of the output along which box and classes lie."""
        shape = _single_output(file)
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
        axis, shape = cls._class_axis(file), _single_output(file)
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
        return Candidates(_edges(raw[:4, candidate].T), confidence, class_index)


class _Yolox(_Scored):
    """YOLOX as its exporter leaves it by default: offsets from the cells of three (four) grids."""

    name = "yolox"
    layout = "one output [batch, cells of all grids, 5 + classes] with offsets from the cells"
    placement = ImagePlacement.TOP_LEFT
    is_bgr = True
    white = 255.0
    _decodes: ClassVar[bool] = False

    @classmethod
    def fits(cls, file: NetworkFile) -> bool:
        shape = _single_output(file)
        if shape is None or shape[2] is None or shape[2] < 6:
            return False
        if file.labels is not None and shape[2] != 5 + len(file.labels):
            return False
        return file.size_px is None or shape[1] is None or _grid(*file.size_px, shape[1]) is not None

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        shape = _single_output(file)
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

    def decode(
        self, outputs: tuple[np.ndarray, ...], size_px: tuple[int, int], classes: np.ndarray, confidence_min: float
    ) -> Candidates:
        raw = outputs[0]
        label_count = len(self.file.labels or ())
        grid = _grid(*size_px, len(raw)) if raw.ndim == 2 and raw.shape[1] == 5 + label_count else None
        if grid is None:
            raise self._came(0, raw, f"a row of 5 + {label_count} labels for every cell of {size_px} px")
        score = raw[:, 5 + classes] * raw[:, 4:5]
        candidate, confidence, class_index = self._best(score.T, classes, confidence_min)
        box = raw[candidate, :4]
        if not self._decodes:
            cell, stride_px = grid[0][candidate], grid[1][candidate, None]
            with np.errstate(over="ignore"):  # an endless box is cut off at the image's border
                box = np.concatenate([(box[:, :2] + cell) * stride_px, np.exp(box[:, 2:]) * stride_px], axis=1)
        return Candidates(_edges(box), confidence, class_index)


class _YoloxDecoded(_Yolox):
    """YOLOX exported with ``--decode_in_inference``: boxes in pixels of the input."""

    name = "yolox-decoded"
    layout = "one output [batch, cells of all grids, 5 + classes] with boxes in pixels"
    _decodes = True


@functools.lru_cache(maxsize=16)
def _grid(rows_px: int, columns_px: int, count: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Column and row of every cell of YOLOX's grids, float32 [cell, 2], and their strides [px], float32 [cell].

    None where neither the grids of 8, 16 and 32 px nor those and one of 64 px have so many cells together.
    """
    for strides in ((8, 16, 32), (8, 16, 32, 64)):
        shapes = [(rows_px // stride, columns_px // stride) for stride in strides]
        if sum(rows * columns for rows, columns in shapes) == count:
            cells = [np.indices(shape).reshape(2, -1)[::-1].T for shape in shapes]
            stride_px = [np.full(len(cell), stride) for cell, stride in zip(cells, strides, strict=True)]
            return np.concatenate(cells).astype(np.float32), np.concatenate(stride_px).astype(np.float32)
    return None


def _gives_pixels(file: NetworkFile) -> bool | None:
    """Whether a YOLOX file's box centres follow its cells on a grey image, or are offsets.

    None where its boxes are not as many as its cells.
    """
    assert file.image is not None
    size_px = file.size_px or (256, 256)
    grey = np.full((file.image.shape[0] or 1, 3, *size_px), GREY, file.image.dtype)
    centre = file.run({file.image.name: grey})[0][0]
    grid = _grid(*size_px, len(centre))
    if grid is None:
        return None
    place_px = (grid[0] + 0.5) * grid[1][:, None]
    centre = centre[:, :2].astype(np.float64)
    if not np.isfinite(centre).all() or (centre.std(axis=0) == 0.0).any():
        return False
    return all(np.corrcoef(centre[:, axis], place_px[:, axis])[0, 1] > 0.8 for axis in (0, 1))


class _UltralyticsEndToEnd(Family):
    """An ultralytics network with suppression built in (``nms=True``) or without need of it (YOLOv10, YOLO26)."""

    name = "ultralytics-end2end"
    layout = "one output [batch, candidates, 6] of x0, y0, x1, y1 in pixels, score and class"

    @classmethod
    def fits(cls, file: NetworkFile) -> bool:
        shape = _single_output(file)
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
        return _listed(self.file, rows[:, :4], rows[:, 4], rows[:, 5], classes, confidence_min)


class _RtdetrSingle(_UltralyticsEndToEnd):
    """RT-DETRv4's exporter: one output, boxes in pixels of its input."""

    name = "rtdetr-single"
    placement = ImagePlacement.STRETCHED
    square_px = 640

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        return None  # nothing in such a file distinguishes it from an end-to-end one


class _UltralyticsRtdetr(Family):
    """Ultralytics' RT-DETR: boxes in parts of the input; today's exports give the best class, older ones all scores."""

    name = "ultralytics-rtdetr"
    layout = "one output [batch, candidates, 6] of centre and size in 0..1, score and class"
    placement = ImagePlacement.STRETCHED
    square_px = 640

    @classmethod
    def fits(cls, file: NetworkFile) -> bool:
        shape = _single_output(file)
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
        box_input_px = _edges(rows) * np.array([size_px[1], size_px[0]] * 2, np.float32)
        if rows.shape[1] == 6:
            return _listed(self.file, box_input_px, rows[:, 4], rows[:, 5], classes, confidence_min)
        best = rows[:, 4:].argmax(axis=1)
        return _listed(self.file, box_input_px, rows[:, 4:].max(axis=1), best, classes, confidence_min)


def _listed(
    file: NetworkFile,
    box_input_px: np.ndarray,
    confidence: np.ndarray,
    class_index: np.ndarray,
    classes: np.ndarray,
    confidence_min: float,
) -> Candidates:
    """Those boxes of a list that are of the wanted classes and of enough confidence."""
    sure = confidence >= confidence_min
    box_input_px, confidence, class_index = box_input_px[sure], confidence[sure], np.rint(class_index[sure])
    label_count = len(file.labels or ())
    if len(class_index) and not 0 <= class_index.min() <= class_index.max() < label_count:
        raise InputError(
            f"{file.path}: gives class {class_index.max():.0f}, expected 0 to {label_count - 1}, for it has "
            f"{label_count} labels; set detector.labels to all of its labels, or name another detector.format"
        )
    wanted = np.isin(class_index, classes)
    return Candidates(box_input_px[wanted], confidence[wanted], class_index[wanted].astype(np.int32))


class _Listing(Family):
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
        return _listed(self.file, boxes, scores, labels, classes, confidence_min)


class _Torchvision(_Listing):
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


class _Rtdetr(_Listing):
    """RT-DETR, RT-DETRv2, D-FINE and their like with ``orig_target_sizes`` as second input.

    That input is the size of the boxes' frame. It is given the size of the network's input, for from there boxes go
    back to the image like those of every other family.
    """

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


FAMILIES: tuple[type[Family], ...] = (
    _Ultralytics,
    _UltralyticsEndToEnd,
    _UltralyticsRtdetr,
    _Yolox,
    _YoloxDecoded,
    _Torchvision,
    _Rtdetr,
    _RtdetrSingle,
)


def recognise(file: NetworkFile, name: str = "auto") -> tuple[Family, str]:
    """Find out how a file wants its images and what its outputs mean.

    Args:
        file: Metadata, inputs and outputs.
        name: A family's name, or ``auto``.

    Returns:
        The family's reader of this file, its labels included, and the reason for the family, in words.

    Raises:
        InputError: The file fits no family, not the named one, or several; or its labels are unknown.
    """
    by_name = {family.name: family for family in FAMILIES}
    if name != "auto" and name not in by_name:
        raise OptionError("detector.format", f"expected auto or one of {', '.join(by_name)}, got {name!r}")
    if name != "auto":
        kind, reason = by_name[name], "set by detector.format"
        if not kind.fits(file):
            raise InputError(f"{file.path}: detector.format={name}: expected {_wanted(kind, file)}, got {file}")
    else:
        fitting = [family for family in FAMILIES if family.fits(file)]
        if not fitting:
            known = "; ".join(f"{family.name}: {family.layout}" for family in FAMILIES)
            raise InputError(f"{file.path}: unknown layout, got {file}; expected one of {known}")
        known = [(family, why) for family in fitting if (why := family.evidence(file)) is not None]
        if len(known) != 1:
            names = ", ".join(family.name for family, _ in known) or ", ".join(family.name for family in fitting)
            raise InputError(
                f"{file.path}: its layout could be one of {names}, got {file}; name one with detector.format"
                + ("" if file.labels or _UltralyticsEndToEnd.fits(file) else ", or its labels with detector.labels")
            )
        kind, reason = known[0]
    labels, origin = _labels(file, kind)
    return kind(replace(file, labels=labels, labels_origin=origin)), reason


def _wanted(kind: type[Family], file: NetworkFile) -> str:
    return kind.layout if file.labels is None else f"{kind.layout}, with {len(file.labels)} labels"


def _labels(file: NetworkFile, kind: type[Family]) -> tuple[tuple[str, ...], str]:
    """The labels by class of the network, and where they come from; class 0 is the background where there is one."""
    if file.labels is not None:
        if kind is _Torchvision and file.labels[0].lower() not in (BACKGROUND, "background"):
            return (BACKGROUND, *file.labels), file.labels_origin
        return file.labels, file.labels_origin
    count = kind(file).class_count
    if count == len(COCO_80):
        return COCO_80, "COCO, for there are 80 classes"
    if count == len(COCO_91):
        return COCO_91, "COCO with its gaps, for there are 91 classes"
    if kind.assumed_labels is not None:
        return (
            kind.assumed_labels,
            "COCO (assumed, since the file has no labels; if it was trained on others, set detector.labels)",
        )
    classes = "an unknown number of" if count is None else count
    raise InputError(
        f"{file.path}: has no metadata 'names' for the {classes} classes of output {file.outputs[0]}, so its labels "
        "are unknown; set detector.labels to their list, or to a file with one label a line"
    )


def metadata_labels(path: Path, metadata: Mapping[str, str]) -> tuple[str, ...] | None:
    """The labels that a file's metadata hold as ``names``, None where they hold none.

    Raises:
        InputError: They are not a list of labels.
    """
    text = metadata.get("names")
    if text is None:
        return None
    try:
        value = ast.literal_eval(text)
        if not isinstance(value, (list, tuple, dict)) or not value:
            raise TypeError
        return tuple(str(value[index]) for index in range(len(value)))
    except (ValueError, SyntaxError, TypeError, KeyError, MemoryError, RecursionError) as error:
        raise InputError(
            f"{path}: metadata 'names' is not a list of labels: {text[:80]!r}; set detector.labels"
        ) from error
