"""What all families have in common: they pack images into a network's input and decode its outputs."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from warpav.core.errors import InputError
from warpav.detection.families.coco import COCO_80
from warpav.detection.families.letterbox import ImagePlacement, Letterbox
from warpav.detection.families.network_file import NetworkFile


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


class ScoredFamily(Family):
    """Families that give every candidate a score of every class."""

    suppresses = False
    assumed_labels = None

    @staticmethod
    def _best(score: np.ndarray, classes: np.ndarray, confidence_min: float) -> tuple[np.ndarray, ...]:
        """Candidates of enough confidence, that confidence and their class, of scores [class, candidate]."""
        confidence = score.max(axis=0)
        candidate = np.nonzero(confidence >= confidence_min)[0]
        return candidate, confidence[candidate], classes[score[:, candidate].argmax(axis=0)]


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
