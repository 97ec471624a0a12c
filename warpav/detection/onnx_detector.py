"""A detector from an ONNX file whose output is ``[batch, 4 + classes, candidates]``, run by onnxruntime.

This is the layout of an ultralytics export without built-in suppression, and of the detector that warpav ships: rows
``centre x, centre y, width, height`` in pixels of the network's input, then one score in 0..1 for every class, no
objectness. The labels stand in the file's metadata as ``names``. How the shipped detector was trained and how well it
does is told in ``models/MODEL_CARD.md``.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.detection.detector import Detections
from warpav.detection.matching import iou_matrix
from warpav.errors import InputError

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

BUILTIN_MODEL_PATH = Path(__file__).parent / "models" / "warpav_town_nano.onnx"

# Labels that mean a motor vehicle, as COCO (both spellings of its motorcycle) and the shipped detector name them.
VEHICLE_NAMES = ("car", "van", "truck", "lorry", "bus", "motorcycle", "motorbike")

_STRIDE_PX = 32
_GREY = 114
_BATCH_MAX = 32
# Suppression compares all pairs; beyond this many candidates the least confident are dropped.
_CANDIDATE_MAX = 1000
PROVIDERS = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
}
_LAYOUT = "one input [batch, 3, rows, columns] float32 and one output [batch, 4 + classes, candidates] float32"


@dataclass(frozen=True)
class Letterbox:
    """How an image is scaled and padded to the network's input, keeping its aspect ratio, in the middle.

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
    def fit(cls, height_px: int, width_px: int, input_height_px: int, input_width_px: int) -> Letterbox:
        """The letterbox that shows an image as large as the input allows."""
        scale = min(input_height_px / height_px, input_width_px / width_px)
        scaled_height_px = max(1, min(input_height_px, round(height_px * scale)))
        scaled_width_px = max(1, min(input_width_px, round(width_px * scale)))
        return cls(
            input_height_px,
            input_width_px,
            scaled_height_px,
            scaled_width_px,
            (input_height_px - scaled_height_px) // 2,
            (input_width_px - scaled_width_px) // 2,
        )

    def pack(self, images_rgb: np.ndarray) -> np.ndarray:
        """The network's input: RGB in 0..1, float32, shape [image, 3, row, column].

        Args:
            images_rgb: Images, uint8, shape [image, row, column, 3].
        """
        if images_rgb.shape[1:3] == (self.input_height_px, self.input_width_px):
            canvas = images_rgb
        else:
            import cv2

            canvas = np.full((len(images_rgb), self.input_height_px, self.input_width_px, 3), _GREY, np.uint8)
            rows = slice(self.top_px, self.top_px + self.scaled_height_px)
            columns = slice(self.left_px, self.left_px + self.scaled_width_px)
            for image_rgb, target in zip(images_rgb, canvas, strict=True):
                target[rows, columns] = cv2.resize(
                    image_rgb, (self.scaled_width_px, self.scaled_height_px), interpolation=cv2.INTER_LINEAR
                )
        network_input = np.empty((len(canvas), 3, self.input_height_px, self.input_width_px), np.float32)
        np.multiply(canvas.transpose(0, 3, 1, 2), np.float32(1.0 / 255.0), out=network_input, casting="unsafe")
        return network_input

    def unpack(self, box_input_px: np.ndarray, height_px: int, width_px: int) -> np.ndarray:
        """Boxes of the network's input as boxes of the image, cut off at its border, shape [box, 4]."""
        left_top = np.array([self.left_px, self.top_px] * 2, np.float32)
        scale = np.array([width_px / self.scaled_width_px, height_px / self.scaled_height_px] * 2, np.float32)
        size = np.array([width_px, height_px] * 2, np.float32)
        return np.clip((box_input_px - left_top) * scale, 0.0, size).astype(np.float32)


def suppress(box_px: np.ndarray, confidence: np.ndarray, *, iou_max: float) -> np.ndarray:
    """Non-maximum suppression, whatever the class: keep the most confident box, drop what overlaps it, repeat.

    Args:
        box_px: Edges ``x0, y0, x1, y1``, shape [box, 4].
        confidence: Shape [box].
        iou_max: A box that overlaps a kept one by more is dropped.

    Returns:
        Indices of the kept boxes, most confident first, int64.
    """
    order = np.argsort(-confidence, kind="stable")[:_CANDIDATE_MAX]
    overlaps = iou_matrix(box_px[order], box_px[order]) > iou_max
    alive = np.ones(len(order), bool)
    for index in range(len(order)):
        if alive[index]:
            alive[index + 1 :] &= ~overlaps[index, index + 1 :]
    return order[alive]


class OnnxDetector:
    """Vehicles in images, by an ONNX network.

    Args:
        model: Path of an ONNX file, or ``builtin`` for the shipped network.
        confidence_min: Detections below are dropped.
        nms_iou_max: Of two detections that overlap by more, the less confident is dropped.
        vehicle_names: Labels that count as vehicles, capital letters or not; None means `VEHICLE_NAMES`.
        input_px: Images are scaled so that their longer side has this many pixels, and padded to multiples of 32. None:
            as they are. A file that fixes its input size takes none.
        threads: Threads of onnxruntime; None lets it use all cores.
        provider: Where the network runs: ``cpu``, ``cuda`` or ``tensorrt``.

    Raises:
        InputError: The file is missing, not ONNX, of another layout, without labels or without vehicles; or the
            provider is not there, or gave way to another.
    """

    def __init__(
        self,
        model: str | Path,
        *,
        confidence_min: float = 0.1,
        nms_iou_max: float = 0.65,
        vehicle_names: Sequence[str] | None = None,
        input_px: int | None = None,
        threads: int | None = None,
        provider: str = "cpu",
    ) -> None:
        self._path = BUILTIN_MODEL_PATH if str(model) == "builtin" else Path(model)
        self._confidence_min = confidence_min
        self._nms_iou_max = nms_iou_max
        self._session = _open_session(self._path, threads, provider)
        self._provider = provider
        self._input = self._session.get_inputs()[0]
        self._check_layout()
        self._batch, _, rows, columns = (side if isinstance(side, int) else None for side in self._input.shape)
        self._static_input_px = None if rows is None or columns is None else (rows, columns)
        if input_px is not None and self._static_input_px not in (None, (input_px, input_px)):
            raise InputError(
                f"{self._path}: the file fixes its input at {rows} x {columns} pixels, so leave detector.input_px out, "
                f"got {input_px}; or export the network with dynamic size"
            )
        self._input_px = input_px
        self._names = self._read_names()
        wanted = {name.lower() for name in (VEHICLE_NAMES if vehicle_names is None else vehicle_names)}
        self._vehicle_class = np.array([i for i, name in enumerate(self._names) if name.lower() in wanted], np.int32)
        if len(self._vehicle_class) == 0:
            raise InputError(
                f"{self._path}: none of its labels ({_listed(self._names)}) is among the vehicle names "
                f"({', '.join(sorted(wanted))}); name them in detector.vehicle_names"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Every label of the network; only those that count as vehicles are given to detections."""
        return self._names

    def detect(self, images_rgb: np.ndarray | Sequence[np.ndarray]) -> list[Detections]:
        """Find the vehicles in every image.

        Args:
            images_rgb: Images of one size, uint8, shape [image, row, column, 3].

        Returns:
            One `Detections` for every image, in order.

        Raises:
            InputError: The network gives something else than its file promises, or numbers that are not finite.
        """
        if len(images_rgb) == 0:
            return []
        images_rgb = np.asarray(images_rgb)
        if images_rgb.ndim != 4 or images_rgb.shape[3] != 3 or images_rgb.dtype != np.uint8 or 0 in images_rgb.shape:
            raise ValueError(
                f"images_rgb must be uint8 [image, row, column, 3], got {images_rgb.dtype} {images_rgb.shape}"
            )
        height_px, width_px = images_rgb.shape[1:3]
        letterbox = Letterbox.fit(height_px, width_px, *self._input_size_px(height_px, width_px))
        raw = self._run(letterbox.pack(images_rgb))
        return [self._decode(each, letterbox, height_px, width_px) for each in raw]

    def takes_tensor(self, height_px: int, width_px: int) -> bool:
        """Whether images of this size go into the network as they are, neither scaled nor padded."""
        return self._input_size_px(height_px, width_px) == (height_px, width_px)

    def detect_tensor(self, network_input: Any) -> list[Detections]:  # noqa: ANN401 (a DLPack capsule has no type)
        """Find the vehicles in images that are laid out for the network, without a copy where that can be.

        What lies on the CPU is read where it lies by the CPU's provider, what lies on a GPU by the GPU's; otherwise it
        is copied to the host first.

        Args:
            network_input: Anything with the DLPack protocol: RGB in 0..1, float32 [image, 3, row, column], of a size
                that `takes_tensor`.

        Returns:
            One `Detections` for every image, in order.

        Raises:
            InputError: As `detect`.
            ValueError: The tensor has another layout or size.
        """
        import warp as wp

        array: Any = network_input if isinstance(network_input, wp.array) else wp.from_dlpack(network_input)
        if array.ndim != 4 or array.shape[1] != 3 or array.dtype != wp.float32 or not array.is_contiguous:
            raise ValueError(
                f"network_input must be contiguous float32 [image, 3, row, column], got {array.dtype} {array.shape}"
            )
        image_count, _, height_px, width_px = array.shape
        if not self.takes_tensor(height_px, width_px):
            raise ValueError(f"the network takes no images of {width_px} x {height_px} pixels as they are")
        if image_count == 0:
            return []
        if array.device.is_cuda and self._provider != "cpu" and self._batch is None:
            raw = self._run_on_device(array)
        else:
            raw = self._run(array.numpy())  # on the CPU a view, not a copy
        letterbox = Letterbox.fit(height_px, width_px, height_px, width_px)
        return [self._decode(each, letterbox, height_px, width_px) for each in raw]

    def _run_on_device(self, array: Any) -> np.ndarray:  # noqa: ANN401 (a Warp array whose device is known)
        """The network's raw output for an input on the GPU, read where it lies."""
        import warp as wp

        wp.synchronize_device(array.device)  # the network runs on a stream of its own
        binding = self._session.io_binding()
        binding.bind_input(self._input.name, "cuda", array.device.ordinal, np.float32, list(array.shape), array.ptr)
        binding.bind_output(self._session.get_outputs()[0].name)
        try:
            self._session.run_with_iobinding(binding)
        except Exception as error:  # onnxruntime's own types share no parent
            raise InputError(f"{self._path}: cannot run on {array.device}: {_one_line(error)}") from error
        return self._checked(binding.copy_outputs_to_cpu()[0], image_count=len(array))

    def _input_size_px(self, height_px: int, width_px: int) -> tuple[int, int]:
        """Rows and columns of the network's input for an image of this size."""
        if self._static_input_px is not None:
            return self._static_input_px
        scale = 1.0 if self._input_px is None else self._input_px / max(height_px, width_px)
        return (
            max(1, math.ceil(round(height_px * scale) / _STRIDE_PX)) * _STRIDE_PX,
            max(1, math.ceil(round(width_px * scale) / _STRIDE_PX)) * _STRIDE_PX,
        )

    def _run(self, network_input: np.ndarray) -> np.ndarray:
        """The network's raw output, shape [image, 4 + classes, candidates]."""
        batch = self._batch or min(_BATCH_MAX, len(network_input))
        parts = []
        for start in range(0, len(network_input), batch):
            part = network_input[start : start + batch]
            missing = batch - len(part) if self._batch else 0
            if missing:
                part = np.concatenate([part, np.zeros((missing, *part.shape[1:]), np.float32)])
            try:
                output = np.asarray(self._session.run(None, {self._input.name: part})[0])
            except Exception as error:  # onnxruntime's own types share no parent
                raise InputError(f"{self._path}: cannot run on input {list(part.shape)}: {_one_line(error)}") from error
            parts.append(output[: batch - missing])
        return self._checked(np.concatenate(parts) if len(parts) > 1 else parts[0], image_count=len(network_input))

    def _checked(self, raw: np.ndarray, *, image_count: int) -> np.ndarray:
        """The network's output, if it is what the file promises."""
        if raw.ndim != 3 or raw.shape[:2] != (image_count, 4 + len(self._names)):
            raise InputError(
                f"{self._path}: output {self._session.get_outputs()[0].name} came as {list(raw.shape)}, expected "
                f"[{image_count}, 4 + {len(self._names)} labels, candidates]"
            )
        if not np.isfinite(raw).all():
            raise InputError(
                f"{self._path}: output {self._session.get_outputs()[0].name} holds numbers that are not finite; export "
                "the network in float32"
            )
        return raw

    def _decode(self, raw: np.ndarray, letterbox: Letterbox, height_px: int, width_px: int) -> Detections:
        """Detections of one image from its raw output, shape [4 + classes, candidates]."""
        score = raw[4 + self._vehicle_class]
        confidence = score.max(axis=0)
        candidate = np.nonzero(confidence >= self._confidence_min)[0]
        center_px, half_px = raw[0:2, candidate].T, 0.5 * raw[2:4, candidate].T
        box_input_px = np.concatenate([center_px - half_px, center_px + half_px], axis=1)
        kept = suppress(box_input_px, confidence[candidate], iou_max=self._nms_iou_max)
        box_px = letterbox.unpack(box_input_px[kept], height_px, width_px)
        # Boxes that lie in the grey border alone are cut down to nothing.
        solid = (box_px[:, 2:] > box_px[:, :2]).all(axis=1)
        kept = candidate[kept[solid]]
        class_index = self._vehicle_class[score[:, kept].argmax(axis=0)] if len(kept) else np.zeros(0, np.int32)
        return Detections(box_px[solid], confidence[kept].astype(np.float32), class_index, self._names)

    def _check_layout(self) -> None:
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        shape_in, shape_out = inputs[0].shape, outputs[0].shape
        channels, output_rows = (shape[1] if len(shape) > 1 else 0 for shape in (shape_in, shape_out))
        fits = (
            len(inputs) == 1
            and len(outputs) == 1
            and inputs[0].type == outputs[0].type == "tensor(float)"
            and len(shape_in) == 4
            and len(shape_out) == 3
            and (not isinstance(channels, int) or channels == 3)
            and (not isinstance(output_rows, int) or output_rows > 4)
        )
        if not fits:
            came = "; ".join(
                f"{kind} {_listed([f'{each.name} {_shape(each.shape)} {each.type}' for each in listed])}"
                for kind, listed in (("inputs", inputs), ("outputs", outputs))
            )
            raise InputError(
                f"{self._path}: unknown layout, expected {_LAYOUT}, got {came}; export it without suppression"
            )

    def _read_names(self) -> tuple[str, ...]:
        """The labels in the order of the output's rows."""
        text = self._session.get_modelmeta().custom_metadata_map.get("names")
        mend = "set them with onnx.helper.set_model_props(model, {'names': \"{0: 'car', 1: 'bus'}\"})"
        if text is None:
            raise InputError(f"{self._path}: has no metadata 'names', so its labels are unknown; {mend}")
        try:
            names = ast.literal_eval(text)
            names = [names[index] for index in range(len(names))]
        except (ValueError, SyntaxError, TypeError, KeyError) as error:
            raise InputError(
                f"{self._path}: metadata 'names' is not a list of labels: {text[:80]!r}; {mend}"
            ) from error
        rows = self._session.get_outputs()[0].shape[1]
        if isinstance(rows, int) and rows != 4 + len(names):
            raise InputError(
                f"{self._path}: unknown layout, expected output [batch, 4 + {len(names)} labels, candidates], got "
                f"{_shape(self._session.get_outputs()[0].shape)}; export it without suppression"
            )
        return tuple(str(name) for name in names)


def _open_session(path: Path, threads: int | None, provider: str) -> InferenceSession:
    import onnxruntime

    known = {name: full for name, full in PROVIDERS.items() if full in onnxruntime.get_available_providers()}
    if provider not in known:
        raise InputError(
            f"detector.provider: expected one of {', '.join(known)}, which onnxruntime offers here, got {provider!r}; "
            "for a GPU install onnxruntime-gpu in place of onnxruntime"
        )
    if not path.is_file():
        raise InputError(f"detector.model: no such file: {path}; give the path of an ONNX file, or builtin")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    if threads is not None:
        options.intra_op_num_threads = threads
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=[known[provider]])
    except Exception as error:  # onnxruntime's own types share no parent
        raise InputError(f"{path}: not an ONNX file that onnxruntime can load: {_one_line(error)}") from error
    if session.get_providers()[0] != known[provider]:
        raise InputError(
            f"detector.provider: expected the network to run on {provider}, but onnxruntime fell back to "
            f"{session.get_providers()[0]}; check the GPU's driver and CUDA libraries, or set detector.provider=cpu"
        )
    return session


def _shape(shape: Sequence[int | str | None]) -> str:
    return "[" + ", ".join("?" if side is None else str(side) for side in shape) + "]"


def _listed(words: Sequence[str]) -> str:
    text = ", ".join(words)
    return text if len(text) <= 200 else text[:200] + " ..."


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else text[:200] + " ..."
