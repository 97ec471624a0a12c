"""What an ONNX file states of its network: inputs, outputs, metadata and labels."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpav.core.errors import InputError


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
