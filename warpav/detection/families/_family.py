"""What all families have in common: what a file states, how images are packed, and how outputs are decoded."""

from __future__ import annotations

import ast
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import ClassVar

import numpy as np

from warpav.core.errors import InputError

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


_label_of_80 = iter(COCO_80)
COCO_91 = (BACKGROUND, *("N/A" if number in _COCO_GAPS else next(_label_of_80) for number in range(1, 91)))
"""By class of networks that were trained on COCO, whose own numbers leave ten out; 0 is the background."""


@dataclass(frozen=True)
class Tensor:
    name: str  # its name in the file
    shape: tuple[int | None, ...]  # its axes; None where an axis is dynamic
    dtype: str  # numPy's name of its numbers, such as float32

    @classmethod
    def described(cls, name: str, shape: Sequence[int | str | None], kind: str) -> Tensor:
        """One as onnxruntime describes it, such as ``tensor(float)``."""
        number = kind.removeprefix("tensor(").removesuffix(")")
        axes = tuple(side if isinstance(side, int) else None for side in shape)
        return cls(name, axes, {"float": "float32", "double": "float64"}.get(number, number))

    @property
    def is_float(self) -> bool:
        """Whether it holds floating-point numbers that onnxruntime gives to NumPy."""
        return self.dtype in ("float16", "float32", "float64")

    @property
    def is_integer(self) -> bool:
        return self.dtype in ("int32", "int64")

    def __str__(self) -> str:
        """Name, shape with ? for dynamic axes, and number type."""
        axes = ", ".join("?" if side is None else str(side) for side in self.shape)
        return f"{self.name} [{axes}] {self.dtype}"


@dataclass(frozen=True)
class NetworkFile:
    """Metadata, inputs and outputs of an ONNX file."""

    path: Path  # the file
    inputs: tuple[Tensor, ...]  # its inputs
    outputs: tuple[Tensor, ...]  # its outputs
    metadata: Mapping[str, str]  # what the exporter wrote beside the network
    # Labels in the order of the classes, from the user or else the metadata; None if unknown
    labels: tuple[str, ...] | None
    labels_origin: str  # where they come from, in words
    run: Callable[[dict[str, np.ndarray]], list[np.ndarray]]  # runs the network: inputs by name to outputs in order

    def __str__(self) -> str:
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
    def unread_metadata(self) -> list[str]:
        """What is written beside the network that nobody here knows."""
        return sorted(self.metadata.keys() - _KNOWN_METADATA)

    @property
    def is_from_ultralytics(self) -> bool:
        """Whether its metadata are those that ultralytics writes, apart from labels."""
        return bool({"head", "end2end", "imgsz", "task"} & set(self.metadata)) or "Ultralytics" in (
            self.metadata.get("description", "") + self.metadata.get("author", "")
        )

    @property
    def is_end_to_end(self) -> bool:
        """Whether its metadata say that it suppresses by itself, by its head or by what was appended to it."""
        return self.metadata.get("end2end") == "True" or "'nms': True" in self.metadata.get("args", "")

    @property
    def is_ultralytics_rtdetr(self) -> bool:
        """Whether its metadata name ultralytics' RT-DETR; older exports name no head, but the model."""
        head = self.metadata.get("head")
        description = self.metadata.get("description", "").lower().replace("-", "")
        return head == "RTDETRDecoder" if head is not None else self.is_from_ultralytics and "rtdetr" in description


def metadata_labels(path: Path, metadata: Mapping[str, str]) -> tuple[str, ...] | None:
    """The labels that a file's metadata hold as ``names``, None where they hold none."""
    text = metadata.get("names")
    if text is None:
        return None
    try:
        value = ast.literal_eval(text)
        if not isinstance(value, (list, tuple, dict)) or not value:
            raise TypeError
        if isinstance(value, dict):  # whose keys are texts in JSON
            value = {int(key): label for key, label in value.items()}
        return tuple(str(value[index]) for index in range(len(value)))
    except (ValueError, SyntaxError, TypeError, KeyError, MemoryError, RecursionError) as error:
        raise InputError(
            f"{path}: metadata 'names' is not a list of labels: {text[:80]!r}; set detector.labels"
        ) from error


_KNOWN_METADATA = {
    *("names", "stride", "batch", "args", "end2end", "head", "description", "author", "task", "imgsz", "channels"),
    *("date", "version", "license", "docs"),
}
"""Metadata that are read, or say nothing of how images go in and boxes come out."""

GREY = 114
"""Value of the padding."""


class ImagePlacement(Enum):
    """Where an image lies in the network's input."""

    CENTRED = "centred"
    TOP_LEFT = "top left"
    STRETCHED = "stretched"


@dataclass(frozen=True)
class Letterbox:
    """How an image is scaled and padded to the network's input."""

    input_height_px: int  # height of the network's input [px]
    input_width_px: int  # width of the network's input [px]
    scaled_height_px: int  # height of the scaled image in it [px]
    scaled_width_px: int  # width of the scaled image in it [px]
    top_px: int  # rows of grey above it
    left_px: int  # columns of grey left of it

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
        """The images at their position in the input, uint8, shape [image, row, column, 3]."""
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
class Asked:
    """What is wanted of an image's outputs."""

    size_px: tuple[int, int]  # rows and columns of the network's input
    classes: np.ndarray  # of the network, int32
    confidence_min: float


@dataclass(frozen=True)
class Candidates:
    """Boxes that a network proposes for one image."""

    box_input_px: np.ndarray  # edges ``x0, y0, x1, y1`` in pixels of the network's input, float32 [candidate, 4]
    confidence: np.ndarray  # in 0..1, float32 [candidate]
    class_index: np.ndarray  # class of the network, int32 [candidate]


class Family(ABC):
    """One layout of inputs and outputs; an instance serves one file."""

    name: ClassVar[str]
    layout: ClassVar[str]
    placement: ClassVar[ImagePlacement] = ImagePlacement.CENTRED
    is_bgr: ClassVar[bool] = False
    white: ClassVar[float] = 1.0
    stride_px: ClassVar[int] = 32
    suppresses: ClassVar[bool] = True
    # Side of the input of a file of dynamic size, where it must be square; None: as the image
    square_px: ClassVar[int | None] = None
    # Labels if neither user, metadata nor the number of classes determines them; None: an error
    assumed_labels: ClassVar[tuple[str, ...] | None] = COCO_80

    def __init__(self, file: NetworkFile) -> None:
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
    def step_px(self) -> int:
        """What sides of a dynamic input are multiples of: as the metadata say, else as the family's usually are."""
        stated = self.file.metadata.get("stride", "")
        return max(self.stride_px, int(stated)) if stated.isdecimal() and int(stated) <= 256 else self.stride_px

    @property
    def takes_unit_rgb(self) -> bool:
        """Whether the input is RGB in 0..1, float32, so that such tensors go in as they are."""
        return not self.is_bgr and self.white == 1.0 and self.image.dtype == "float32"

    @property
    def takes_device_tensor(self) -> bool:
        """Whether a tensor on a GPU can be the network's only input, whatever the number of images."""
        return self.takes_unit_rgb and len(self.file.inputs) == 1 and self.batch is None

    def input_size_px(self, height_px: int, width_px: int, input_px: int | None) -> tuple[int, int]:
        """Rows and columns of the network's input for an image; ``input_px``: its longer side there, None: as it is."""
        if self.file.size_px is not None:
            return self.file.size_px
        if self.square_px is not None:
            return (input_px or self.square_px, input_px or self.square_px)
        scale = 1.0 if input_px is None else input_px / max(height_px, width_px)
        fixed = self.image.shape[-2:]
        rows, columns = (
            max(1, math.ceil(round(side * scale) / self.step_px)) * self.step_px for side in (height_px, width_px)
        )
        return (fixed[0] or rows, fixed[1] or columns)

    def pack(self, images_rgb: np.ndarray, letterbox: Letterbox) -> np.ndarray:
        """Images, uint8 [image, row, column, 3], as the network wants them, float32 [image, 3, row, column]."""
        canvas = letterbox.canvas(images_rgb).transpose(0, 3, 1, 2)
        network_input = np.empty(canvas.shape, np.float32)
        scale = np.float32(self.white / 255.0)
        np.multiply(canvas[:, ::-1] if self.is_bgr else canvas, scale, out=network_input, casting="unsafe")
        return network_input

    def feed(self, network_input: np.ndarray) -> dict[str, np.ndarray]:
        array = network_input if len(self.image.shape) == 4 else network_input[0]
        return {self.image.name: array.astype(self.image.dtype, copy=False)}

    def each_image(self, outputs: Sequence[np.ndarray], image_count: int) -> list[tuple[np.ndarray, ...]]:
        for tensor, array in zip(self.file.outputs, outputs, strict=True):
            if array.ndim == 0 or len(array) != image_count:
                raise InputError(
                    f"{self.file.path}: output {tensor.name} came as {list(array.shape)}, expected {image_count} "
                    "images along the first axis; export the network with a dynamic batch"
                )
        return [tuple(array[k] for array in outputs) for k in range(image_count)]

    @abstractmethod
    def decode(self, outputs: tuple[np.ndarray, ...], asked: Asked) -> Candidates:
        """Boxes of one image."""

    def _came(self, output: int, array: np.ndarray, expected: str) -> InputError:
        """What is wrong with an output; the batch's axis is off."""
        return InputError(
            f"{self.file.path}: output {self.file.outputs[output].name} came as {list(array.shape)} for an image, "
            f"expected {expected}, as the {self.name} layout has it; name another with detector.format"
        )


class ScoredFamily(Family):
    """Families that give every candidate a score of every class."""

    suppresses = False
    assumed_labels = None

    @staticmethod
    def _best(score: np.ndarray, asked: Asked) -> tuple[np.ndarray, ...]:
        """Candidates of enough confidence, that confidence and their class, of scores [class, candidate]."""
        confidence = score.max(axis=0)
        candidate = np.nonzero(confidence >= asked.confidence_min)[0]
        return candidate, confidence[candidate], asked.classes[score[:, candidate].argmax(axis=0)]


def edges_of(centre_and_size: np.ndarray) -> np.ndarray:
    """Edges of boxes given as rows of centre and size, shape [box, 4]."""
    half = 0.5 * centre_and_size[:, 2:4]
    return np.concatenate([centre_and_size[:, :2] - half, centre_and_size[:, :2] + half], axis=1)


def single_output_shape(file: NetworkFile) -> tuple[int | None, ...] | None:
    """The shape of the only output of a network of one batched image input, if it has three axes."""
    if file.image is None or len(file.inputs) != 1 or len(file.image.shape) != 4 or len(file.outputs) != 1:
        return None
    output = file.outputs[0]
    return output.shape if len(output.shape) == 3 and output.is_float else None


def listed_candidates(
    file: NetworkFile, box_input_px: np.ndarray, confidence: np.ndarray, class_index: np.ndarray, asked: Asked
) -> Candidates:
    """Those boxes of a list that are of the wanted classes and of enough confidence."""
    sure = confidence >= asked.confidence_min
    box_input_px, confidence, class_index = box_input_px[sure], confidence[sure], np.rint(class_index[sure])
    label_count = len(file.labels or ())
    if len(class_index) and not 0 <= class_index.min() <= class_index.max() < label_count:
        raise InputError(
            f"{file.path}: gives class {class_index.max():.0f}, expected 0 to {label_count - 1}, for it has "
            f"{label_count} labels; set detector.labels to all of its labels, or name another detector.format"
        )
    wanted = np.isin(class_index, asked.classes)
    return Candidates(box_input_px[wanted], confidence[wanted], class_index[wanted].astype(np.int32))
