"""The detector's own loss on rendered images, with gradients to the images and to the true boxes (extra ``torch``).

The thesis's "ideal scenario": a detection model with gradient flow in the optimisation loop instead of a handcrafted
area. Only this module knows PyTorch, and only a run that asks for this loss imports it; `warpav.optimisation` carries
the gradients on to the cameras. The network is run operator by operator: only what plain convolutional detectors
consist of is known here, anything else is rejected by name when the file is read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
import warp as wp
from onnx import numpy_helper
from torch import Tensor
from torch.nn import functional

from warpav.core.errors import InputError, OptionError
from warpav.detection._detector import ROAD_USERS
from warpav.detection._external_data import check_external_data
from warpav.detection._onnx_detector import OnnxDetector
from warpav.raster.camera import CameraModel

MAX_ERROR = 1e-3
_MIN_OPSET = 11
_FREE_SIZE_PX = (64, 96)  # of the trial image where the file leaves its size open
_STRIDE_PX = 32
# The score at which the logarithmic score loss bends: a candidate far below still pulls, none pulls without bound.
_SCORE_FLOOR = 0.01
# Error of a side, in sizes of the true box along it, at which the agreement of a candidate has halved.
_TOLERANCE = 0.25
_MIN_SIZE_PX = 4.0
# How sharply a candidate must agree with the true box to answer for the object.
_AGREEMENT_POWER = 3.0
_PHASE_COUNT = 16
_REACH_PX = 8  # of the moves, to both sides
_SOFTENING = (1.0, 4.0, 6.0, 4.0, 1.0)
_GREY = 114.0 / 255.0
_TINY = 1e-20


@dataclass(frozen=True)
class _DetectionLoss:
    """The loss of every object, and its gradients."""

    loss: np.ndarray  # in 0..1, float32 [object]
    # Of the weighted sum to the colours, vec3 [image, row, column], on the device; None if not asked
    image_gradient: wp.array | None
    box_gradient: np.ndarray | None  # of the weighted sum to the true boxes [1/px], float32 [object, 4]; None likewise


class DifferentiableDetector:
    """How badly a detection network finds given objects in given images, as a smooth function of both.

    For an object with true box b of width and height s, and the network's candidates j with boxes p_j and pooled scores
    ``q_j = 1 - prod over the labels of the object's group of (1 - score)``:

        g_j = 1 / (1 + mean over the four sides of ((p_j - b) / (s / 4))^2)     agreement, 0..1
        w_j = (q_j + e) g_j^3 / sum of the same                  soft maximum: who answers for the object
        S   = sum of w_j q_j,   D = sum of w_j (1 - g_j)         its score, its disagreement
        L   = (ln((1 + e) / (S + e)) / ln((1 + e) / e) + D) / 2,   e = 0.01

    L is 0 for a sure and exact answer and at most 1. The agreement is smooth where a candidate fits exactly, which the
    generalised IoU is not, and falls off with the square of the error, so that boxes that lie apart still attract.

    A strided network responds differently when the same image is shifted by a pixel, and its slope changes within
    a part of one. What a world in motion sees is the mean over such moves, so L is the mean over ``phase_count`` = n of
    them, of the image smoothed by the filter 1 4 6 4 1 along rows and columns (standard deviation 1 px): image and
    boxes are moved by k px to the right and 5 k px down, both modulo 16 and between -8 and 7, k = 0 .. n - 1. What
    comes in is the grey of a letterbox; boxes end where the image does.

    Gradients, all by PyTorch's reverse mode: dL/dS = -1 / (2 (S + e) ln((1 + e) / e)) and dL/dD = 1/2; through S, D and
    w_j to q_j, p_j and b; through the network to the image. b enters by g_j and s alone.

    Args:
        path: ONNX file whose one output is [image, 4 + labels, candidates]: centre x, centre y, width, height in pixels
            of the input, then scores in 0..1.
    """

    def __init__(
        self,
        path: str | Path,
        label_group: Sequence[int] | np.ndarray,
        *,
        device: str = "cpu",
        phase_count: int = _PHASE_COUNT,
    ) -> None:
        self._path = Path(path)
        self._network = TorchNetwork(path, device=_torch_device(device))
        self._label_group = np.asarray(label_group, np.int64)
        self._phases_px = [  # to the right, down
            tuple((step * k + _REACH_PX) % (2 * _REACH_PX) - _REACH_PX for step in (1, 5)) for k in range(phase_count)
        ]

    @classmethod
    def of(cls, detector: OnnxDetector, camera: CameraModel, *, device: str) -> DifferentiableDetector:
        """The network of a detector, for images of a camera."""
        if detector.family.name != "ultralytics":
            raise InputError(
                f"{detector.file.path}: losses.detector_gradient expected the raw layout ultralytics, got "
                f"{detector.family.name}; export the network without suppression, or set losses.detector_gradient=0"
            )
        if not detector.takes_tensor(camera.height_px, camera.width_px):
            rows, columns = detector.input_size_px(camera.height_px, camera.width_px)
            raise OptionError(
                "losses.detector_gradient",
                f"expected images of the network's own size, {columns} x {rows} px here, got "
                f"{camera.width_px} x {camera.height_px}; set camera.width_px={columns} camera.height_px={rows}",
            )
        label_group = np.full(len(detector.names), -1)
        for user, labels in detector.road_users.items():
            label_group[np.isin(detector.names, labels)] = ROAD_USERS.index(user)
        return cls(detector.file.path, label_group, device=device)

    def loss(
        self,
        image: wp.array,
        image_index: np.ndarray,
        box_px: np.ndarray,
        group: np.ndarray,
        *,
        weight: np.ndarray | None = None,
    ) -> _DetectionLoss:
        """The loss of every object in the image that should show it.

        Args:
            image: Colours 0..1, vec3 [image, row, column], sides multiples of 32 px.
            box_px: True visible boxes ``x0, y0, x1, y1`` [px], float [object, 4].
            weight: Of every object's loss in the sum that is differentiated, float [object]; None: no gradient.
        """
        _, height_px, width_px = image.shape
        if height_px % _STRIDE_PX or width_px % _STRIDE_PX:
            raise OptionError(
                "losses.detector_gradient",
                f"expected camera.width_px and camera.height_px to be multiples of "
                f"{_STRIDE_PX}, got {width_px} x {height_px}",
            )
        if len(box_px) == 0:
            still = wp.zeros_like(image) if weight is not None else None
            return _DetectionLoss(
                np.zeros(0, np.float32), still, None if weight is None else np.zeros((0, 4), np.float32)
            )
        # a view of the renderer's memory, not a copy; gradients are asked for a fresh leaf
        rgb = wp.to_torch(image, requires_grad=False).detach().requires_grad_(weight is not None)
        truth_px = torch.from_numpy(np.asarray(box_px, np.float32)).to(rgb.device)
        truth_px = truth_px.requires_grad_(weight is not None)
        end_px = torch.tensor([width_px, height_px] * 2, dtype=torch.float32, device=rgb.device)
        with torch.set_grad_enabled(weight is not None):
            parts, gradients = [], []
            for phase_px in self._phases_px:  # one after the other, so that memory does not grow with their number
                raw = self._raw_output(_moved(_softened(rgb), *phase_px))
                moved_px = truth_px + torch.tensor([*phase_px, *phase_px], dtype=torch.float32, device=rgb.device)
                moved_px = torch.minimum(moved_px.clamp(min=0.0), end_px)
                part = self._object_losses(raw, np.asarray(image_index), moved_px, np.asarray(group))
                parts.append(part.detach() / len(self._phases_px))
                if weight is not None:
                    share = torch.from_numpy(np.asarray(weight, np.float32) / len(self._phases_px)).to(part.device)
                    gradients.append(torch.autograd.grad((part * share).sum(), [rgb, truth_px]))
        loss = torch.stack(parts).sum(dim=0).cpu().numpy()
        if weight is None:
            return _DetectionLoss(loss, None, None)
        to_image, to_truth = (torch.stack(each).sum(dim=0) for each in zip(*gradients, strict=True))
        return _DetectionLoss(loss, wp.from_torch(to_image.contiguous(), dtype=wp.vec3), to_truth.cpu().numpy())

    def _raw_output(self, rgb: Tensor) -> Tensor:
        """The network's output for colours [image, 3, row, column], checked."""
        labels = len(self._label_group)
        try:
            raw = self._network(rgb)
        except RuntimeError as error:
            raise InputError(
                f"{self._path}: losses.detector_gradient cannot run it on images of {rgb.shape[3]} x "
                f"{rgb.shape[2]} px: {' '.join(str(error).split())[:200]}; set camera.width_px and "
                "camera.height_px to the network's own size"
            ) from error
        if raw.ndim != 3 or raw.shape[0] != rgb.shape[0] or raw.shape[1] != 4 + labels:
            raise InputError(
                f"{self._path}: losses.detector_gradient expected output [{rgb.shape[0]}, 4 + {labels} labels, "
                f"candidates], got {list(raw.shape)}; export the network without suppression"
            )
        if not bool(raw.isfinite().all()):
            raise InputError(f"{self._path}: its output holds numbers that are not finite; export it in float32")
        return raw

    def _object_losses(self, raw: Tensor, image_index: np.ndarray, truth_px: Tensor, group: np.ndarray) -> Tensor:
        """L of every object."""
        where = torch.from_numpy(image_index.astype(np.int64)).to(raw.device)
        center, half = raw[:, :2], 0.5 * raw[:, 2:4]
        candidate_px = torch.cat([center - half, center + half], dim=1).transpose(1, 2)[where]
        # the complements of the scores of all labels that are not of the object's group count as 1
        counts = torch.from_numpy(self._label_group[None, :] == group[:, None]).to(raw)[:, :, None]
        score = 1.0 - (1.0 - counts * raw[where, 4:]).prod(dim=1)
        size_px = (truth_px[:, 2:] - truth_px[:, :2]).clamp(min=_MIN_SIZE_PX).repeat(1, 2)[:, None]
        error = (candidate_px - truth_px[:, None]) / (_TOLERANCE * size_px)
        agreement = 1.0 / (1.0 + error.square().mean(dim=-1))
        share = (score + _SCORE_FLOOR) * agreement**_AGREEMENT_POWER
        share = share / (share.sum(dim=1, keepdim=True) + _TINY)
        floor = torch.tensor(_SCORE_FLOOR, dtype=raw.dtype, device=raw.device)
        score_loss = torch.log((1.0 + floor) / ((share * score).sum(dim=1) + floor)) / torch.log((1.0 + floor) / floor)
        disagreement = 1.0 - (share * agreement).sum(dim=1)
        return 0.5 * (score_loss + disagreement)


def _softened(rgb: Tensor) -> Tensor:
    """Planes [image, 3, row, column] of an image batch [image, row, column, 3], smoothed; its border is repeated."""
    line = rgb.new_tensor(_SOFTENING) / sum(_SOFTENING)
    margin = len(_SOFTENING) // 2
    planes = functional.pad(rgb.permute(0, 3, 1, 2), [margin] * 4, mode="replicate")
    return functional.conv2d(planes, line.outer(line).expand(3, 1, -1, -1), groups=3)


def _moved(planes: Tensor, right_px: int, down_px: int) -> Tensor:
    """Planes [image, 3, row, column] moved by whole pixels; what comes in is grey."""
    # padding below 0 cuts off
    return functional.pad(planes, (right_px, -right_px, down_px, -down_px), value=_GREY)


def _torch_device(device: str) -> str:
    if device != "cpu" and not torch.cuda.is_available():
        raise OptionError(
            "losses.detector_gradient",
            f"expected a PyTorch that can use {device}, got one without CUDA; "
            "install PyTorch for your GPU (pytorch.org), or set device=cpu",
        )
    return device


class TorchNetwork:
    """The network of an ONNX file with one input and one output, as a differentiable function."""

    def __init__(self, path: str | Path, *, device: str = "cpu") -> None:
        self._path, self._device = Path(path), device
        check_external_data(self._path)
        try:
            model = onnx.load(str(path))
        except Exception as error:  # protobuf's own types share no parent
            raise InputError(f"{path}: not an ONNX file that onnx can read: {' '.join(str(error).split())}") from error
        opset = max((each.version for each in model.opset_import if each.domain in ("", "ai.onnx")), default=0)
        unknown = sorted({node.op_type for node in model.graph.node} - set(_OPERATORS))
        if unknown:
            raise InputError(
                f"{path}: losses.detector_gradient cannot differentiate the operator {unknown[0]}; export the network "
                "without suppression, in float32, or set losses.detector_gradient=0"
            )
        if opset < _MIN_OPSET:
            raise InputError(f"{path}: expected ONNX opset {_MIN_OPSET} or later, got {opset}; export it again")

        def as_tensor(value: onnx.TensorProto) -> Tensor:
            return torch.from_numpy(np.array(numpy_helper.to_array(value))).to(device)

        self._constants = {each.name: as_tensor(each) for each in model.graph.initializer}
        # what each operator is called, what goes in and out, and its attributes
        self._nodes: list[tuple[str, Sequence[str], Sequence[str], Mapping[str, Any]]] = []
        for node in model.graph.node:
            attributes = {each.name: onnx.helper.get_attribute_value(each) for each in node.attribute}
            if node.op_type == "Constant" and "value" in attributes:
                self._constants[node.output[0]] = as_tensor(attributes["value"])
                continue
            self._nodes.append((node.op_type, tuple(node.input), tuple(node.output), attributes))
        inputs = [each for each in model.graph.input if each.name not in self._constants]
        if len(inputs) != 1 or len(model.graph.output) != 1:
            raise InputError(
                f"{path}: losses.detector_gradient needs one input and one output, got {len(inputs)} and "
                f"{len(model.graph.output)}; export the network without suppression"
            )
        self._input, self._output = inputs[0].name, model.graph.output[0].name
        self._last_use = {name: k for k, (_, inputs, _, _) in enumerate(self._nodes) for name in inputs}
        sides = [side.dim_value if side.HasField("dim_value") else 0 for side in inputs[0].type.tensor_type.shape.dim]
        self._verify([side or free for side, free in zip(sides, (1, 3, *_FREE_SIZE_PX), strict=True)])

    def __call__(self, images: Tensor) -> Tensor:
        """The raw output for images, a tensor float32 [image, 3, row, column]; differentiable."""
        value = {self._input: images}
        for k, (operator, inputs, outputs, attributes) in enumerate(self._nodes):
            given = [None if not name else value[name] if name in value else self._constants[name] for name in inputs]
            result = _OPERATORS[operator](given, attributes)
            value.update(zip(outputs, result if isinstance(result, tuple) else (result,), strict=False))
            for name in inputs:
                if self._last_use[name] == k and name in value:
                    del value[name]
        return value[self._output]

    def _verify(self, shape: list[int]) -> None:
        """Compare PyTorch with onnxruntime on a trial image."""
        import onnxruntime

        images = np.random.default_rng(0).random(shape, np.float32)
        session = onnxruntime.InferenceSession(str(self._path), providers=["CPUExecutionProvider"])
        expected = np.asarray(session.run(None, {self._input: images})[0])
        try:
            with torch.no_grad():
                output = self(torch.from_numpy(images).to(self._device)).cpu().numpy()
            error = float((np.abs(output - expected) / np.maximum(np.abs(expected), 1.0)).max())
        except (RuntimeError, TypeError, ValueError, IndexError, KeyError) as reason:
            raise InputError(
                f"{self._path}: losses.detector_gradient cannot run it: {' '.join(str(reason).split())[:200]}"
            ) from reason
        self.error = error
        if not error <= MAX_ERROR:
            raise InputError(
                f"{self._path}: losses.detector_gradient expected PyTorch to agree with onnxruntime to {MAX_ERROR:g}, "
                f"got a difference of {error:.2g}; export the network in float32"
            )


def _paddings(attributes: Mapping[str, Any]) -> tuple[list[int], list[int]]:
    """Padding (left, right, top, bottom) and what a convolution takes itself where both ends are equal."""
    if attributes.get("auto_pad", b"NOTSET") not in (b"NOTSET", b"VALID"):
        raise ValueError("auto_pad is not known here")
    top, left, bottom, right = attributes.get("pads", [0, 0, 0, 0])
    if (top, left) == (bottom, right):
        return [0, 0, 0, 0], [top, left]
    return [left, right, top, bottom], [0, 0]


def _over_windows(given: list, attributes: Mapping[str, Any], border: float) -> tuple[Tensor, dict[str, Any]]:
    """The image, padded where its ends differ, and how windows of a convolution or a maximum lie on it."""
    around, inside = _paddings(attributes)
    image = functional.pad(given[0], around, value=border) if any(around) else given[0]
    stride, dilation = (tuple(attributes.get(name, (1, 1))) for name in ("strides", "dilations"))
    return image, {"stride": stride, "padding": tuple(inside), "dilation": dilation}


def _convolution(given: list, attributes: Mapping[str, Any]) -> Tensor:
    image, windows = _over_windows(given, attributes, 0.0)
    return functional.conv2d(image, *given[1:3], **windows, groups=attributes.get("group", 1))


def _max_pool(given: list, attributes: Mapping[str, Any]) -> Tensor:
    image, windows = _over_windows(given, attributes, float("-inf"))
    rounds_up = bool(attributes.get("ceil_mode", 0))
    return functional.max_pool2d(image, tuple(attributes["kernel_shape"]), **windows, ceil_mode=rounds_up)


def _resize(given: list, attributes: Mapping[str, Any]) -> Tensor:
    """Enlarging by whole numbers, every value repeated: all that detectors use."""
    scale = given[2].tolist() if len(given) > 2 and given[2] is not None and given[2].numel() else None
    if scale is None:
        scale = [to / side for to, side in zip(given[3].tolist(), given[0].shape, strict=True)]
    if attributes.get("mode", b"nearest") != b"nearest" or scale[:2] != [1, 1] or any(s != int(s) for s in scale):
        raise ValueError(f"Resize is known by repeating values a whole number of times only, got {scale}")
    return given[0].repeat_interleave(int(scale[2]), 2).repeat_interleave(int(scale[3]), 3)


def _reshape(given: list, attributes: Mapping[str, Any]) -> Tensor:
    keeps_zero = bool(attributes.get("allowzero", 0))
    sides = given[1].tolist()
    return given[0].reshape(
        [given[0].shape[k] if side == 0 and not keeps_zero else side for k, side in enumerate(sides)]
    )


def _slice(given: list, attributes: Mapping[str, Any]) -> Tensor:
    first, last = given[1].tolist(), given[2].tolist()
    axes = given[3].tolist() if len(given) > 3 and given[3] is not None else list(range(len(first)))
    steps = given[4].tolist() if len(given) > 4 and given[4] is not None else [1] * len(first)
    result = given[0]
    for begin, end, axis, step in zip(first, last, axes, steps, strict=True):
        index = range(result.shape[axis])[slice(begin, None if step < 0 and end < -(2**31) else end, step)]
        if step > 0:
            where = [slice(None)] * result.ndim
            where[axis] = slice(index.start, max(index.stop, index.start), index.step)
            result = result[tuple(where)]
        else:
            result = result.index_select(axis, torch.tensor(list(index), device=result.device))
    return result


def _split(given: list, attributes: Mapping[str, Any]) -> tuple:
    axis = attributes.get("axis", 0)
    sizes = given[1].tolist() if len(given) > 1 and given[1] is not None else attributes.get("split")
    if sizes is None:
        raise ValueError("Split is known with the sizes of its parts only")
    return tuple(given[0].split([int(size) for size in sizes], axis))


def _axes(given: list, attributes: Mapping[str, Any]) -> list[int]:
    return given[1].tolist() if len(given) > 1 and given[1] is not None else list(attributes["axes"])


def _unsqueeze(given: list, attributes: Mapping[str, Any]) -> Tensor:
    result, axes = given[0], _axes(given, attributes)
    for axis in sorted(a % (result.ndim + len(axes)) for a in axes):
        result = result.unsqueeze(axis)
    return result


def _gather(given: list, attributes: Mapping[str, Any]) -> Tensor:
    axis, index = attributes.get("axis", 0) % given[0].ndim, given[1]
    index = index + (index < 0) * given[0].shape[axis]
    chosen = given[0].index_select(axis, index.reshape(-1))
    return chosen.reshape([*given[0].shape[:axis], *index.shape, *given[0].shape[axis + 1 :]])


def _cast(given: list, attributes: Mapping[str, Any]) -> Tensor:
    kinds = {1: torch.float32, 6: torch.int32, 7: torch.int64, 9: torch.bool, 11: torch.float64}
    if attributes["to"] not in kinds:
        raise ValueError(f"Cast to ONNX type {attributes['to']} is not known here; export the network in float32")
    return given[0].to(kinds[attributes["to"]])


def _shape(given: list, attributes: Mapping[str, Any]) -> Tensor:
    sides = list(given[0].shape)[attributes.get("start", 0) : attributes.get("end")]
    return torch.tensor(sides, dtype=torch.int64, device=given[0].device)


def _clip(given: list, attributes: Mapping[str, Any]) -> Tensor:
    low, high = ([*given, None, None][k] for k in (1, 2))
    if low is None and high is None:
        low, high = attributes.get("min"), attributes.get("max")
    return given[0].clamp(low, high)


def _cumulative_sum(given: list, attributes: Mapping[str, Any]) -> Tensor:
    if attributes.get("exclusive", 0) or attributes.get("reverse", 0):
        raise ValueError("CumSum is known forwards and inclusive only")
    return given[0].cumsum(int(given[1].item()))


_OPERATORS: dict[str, Callable[[list, Mapping[str, Any]], Any]] = {
    "Add": lambda given, _: given[0] + given[1],
    "Cast": _cast,
    "Clip": _clip,
    "Concat": lambda given, attributes: torch.cat(given, attributes["axis"]),
    "Constant": lambda given, _: None,  # read with the file
    "Conv": _convolution,
    "CumSum": _cumulative_sum,
    "Div": lambda given, _: given[0].div(given[1], rounding_mode=None if given[0].is_floating_point() else "trunc"),
    "Exp": lambda given, _: given[0].exp(),
    "Expand": lambda given, _: given[0] * given[0].new_ones(given[1].tolist()),
    "Gather": _gather,
    "GlobalAveragePool": lambda given, _: given[0].mean((2, 3), keepdim=True),
    "Identity": lambda given, _: given[0],
    "LeakyRelu": lambda given, attributes: given[0].where(given[0] > 0.0, given[0] * attributes.get("alpha", 0.01)),
    "MatMul": lambda given, _: given[0] @ given[1],
    "MaxPool": _max_pool,
    "Mul": lambda given, _: given[0] * given[1],
    "Pow": lambda given, _: given[0] ** given[1],
    "Range": lambda given, _: torch.arange(
        *(each.item() for each in given), dtype=given[0].dtype, device=given[0].device
    ),
    "Relu": lambda given, _: given[0].relu(),
    "Reshape": _reshape,
    "Resize": _resize,
    "Shape": _shape,
    "Sigmoid": lambda given, _: given[0].sigmoid(),
    "Slice": _slice,
    "Softmax": lambda given, attributes: given[0].softmax(attributes.get("axis", -1)),
    "Split": _split,
    "Squeeze": lambda given, attributes: given[0].squeeze(tuple(_axes(given, attributes))),
    "Sub": lambda given, _: given[0] - given[1],
    "Tanh": lambda given, _: given[0].tanh(),
    "Transpose": lambda given, attributes: given[0].permute(attributes["perm"]),
    "Unsqueeze": _unsqueeze,
}
