"""An ONNX network run by PyTorch, operator by operator, so that gradients flow to its input.

Only what plain convolutional detectors consist of is known here; anything else is rejected by name when the file is
read. PyTorch (extra ``torch``) is imported inside the functions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.errors import InputError, OptionError, install_text
from warpav.detection.external_data import check_external_data

MAX_ERROR = 1e-3
_MIN_OPSET = 11
_FREE_SIZE_PX = (64, 96)  # of the trial image where the file leaves its size open


def require_torch() -> None:
    """Check that PyTorch and onnx are there."""
    try:
        import onnx  # noqa: F401
        import torch  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise OptionError(
            "losses.detector_gradient",
            f"expected PyTorch and onnx, got no package {error.name!r}; "
            f"{install_text('torch')}, or set losses.detector_gradient=0",
        ) from error


@dataclass(frozen=True)
class _Node:
    """One operator: what it is called, what goes in and out, and its attributes."""

    operator: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]


class TorchNetwork:
    """The network of an ONNX file with one input and one output, as a differentiable function."""

    def __init__(self, path: str | Path, *, device: str = "cpu") -> None:
        require_torch()
        import onnx
        import torch  # pyright: ignore[reportMissingImports]
        from onnx import numpy_helper

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

        def as_tensor(value: Any) -> Any:  # noqa: ANN401 (an ONNX tensor)
            return torch.from_numpy(np.array(numpy_helper.to_array(value))).to(device)

        self._constants = {each.name: as_tensor(each) for each in model.graph.initializer}
        self._nodes: list[_Node] = []
        for node in model.graph.node:
            attributes = {each.name: onnx.helper.get_attribute_value(each) for each in node.attribute}
            if node.op_type == "Constant" and "value" in attributes:
                self._constants[node.output[0]] = as_tensor(attributes["value"])
                continue
            self._nodes.append(_Node(node.op_type, tuple(node.input), tuple(node.output), attributes))
        inputs = [each for each in model.graph.input if each.name not in self._constants]
        if len(inputs) != 1 or len(model.graph.output) != 1:
            raise InputError(
                f"{path}: losses.detector_gradient needs one input and one output, got {len(inputs)} and "
                f"{len(model.graph.output)}; export the network without suppression"
            )
        self._input, self._output = inputs[0].name, model.graph.output[0].name
        self._last_use = {name: k for k, node in enumerate(self._nodes) for name in node.inputs}
        sides = [side.dim_value if side.HasField("dim_value") else 0 for side in inputs[0].type.tensor_type.shape.dim]
        self._verify([side or free for side, free in zip(sides, (1, 3, *_FREE_SIZE_PX), strict=True)])

    def __call__(self, images: Any) -> Any:  # noqa: ANN401 (PyTorch is no import of this module)
        """The raw output for images, a tensor float32 [image, 3, row, column]; differentiable."""
        value = {self._input: images}
        for k, node in enumerate(self._nodes):
            given = [
                None if not name else value[name] if name in value else self._constants[name] for name in node.inputs
            ]
            result = _OPERATORS[node.operator](given, node.attributes)
            value.update(zip(node.outputs, result if isinstance(result, tuple) else (result,), strict=False))
            for name in node.inputs:
                if self._last_use[name] == k and name in value:
                    del value[name]
        return value[self._output]

    def _verify(self, shape: list[int]) -> None:
        """Compare PyTorch with onnxruntime on a trial image."""
        import onnxruntime
        import torch  # pyright: ignore[reportMissingImports]

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


def _convolution(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    from torch.nn import functional  # pyright: ignore[reportMissingImports]

    around, inside = _paddings(attributes)
    image = functional.pad(given[0], around) if any(around) else given[0]
    return functional.conv2d(
        image,
        given[1],
        given[2] if len(given) > 2 else None,
        stride=tuple(attributes.get("strides", (1, 1))),
        padding=tuple(inside),
        dilation=tuple(attributes.get("dilations", (1, 1))),
        groups=attributes.get("group", 1),
    )


def _max_pool(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    from torch.nn import functional  # pyright: ignore[reportMissingImports]

    around, inside = _paddings(attributes)
    image = functional.pad(given[0], around, value=float("-inf")) if any(around) else given[0]
    return functional.max_pool2d(
        image,
        tuple(attributes["kernel_shape"]),
        stride=tuple(attributes.get("strides", (1, 1))),
        padding=tuple(inside),
        dilation=tuple(attributes.get("dilations", (1, 1))),
        ceil_mode=bool(attributes.get("ceil_mode", 0)),
    )


def _resize(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Enlarging by whole numbers, every value repeated: all that detectors use."""
    scale = given[2].tolist() if len(given) > 2 and given[2] is not None and given[2].numel() else None
    if scale is None:
        scale = [to / side for to, side in zip(given[3].tolist(), given[0].shape, strict=True)]
    if attributes.get("mode", b"nearest") != b"nearest" or scale[:2] != [1, 1] or any(s != int(s) for s in scale):
        raise ValueError(f"Resize is known by repeating values a whole number of times only, got {scale}")
    return given[0].repeat_interleave(int(scale[2]), 2).repeat_interleave(int(scale[3]), 3)


def _reshape(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    keeps_zero = bool(attributes.get("allowzero", 0))
    sides = given[1].tolist()
    return given[0].reshape(
        [given[0].shape[k] if side == 0 and not keeps_zero else side for k, side in enumerate(sides)]
    )


def _slice(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    import torch  # pyright: ignore[reportMissingImports]

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


def _unsqueeze(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    result, axes = given[0], _axes(given, attributes)
    for axis in sorted(a % (result.ndim + len(axes)) for a in axes):
        result = result.unsqueeze(axis)
    return result


def _squeeze(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    return given[0].squeeze(tuple(_axes(given, attributes)))


def _gather(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    axis, index = attributes.get("axis", 0) % given[0].ndim, given[1]
    index = index + (index < 0) * given[0].shape[axis]
    chosen = given[0].index_select(axis, index.reshape(-1))
    return chosen.reshape([*given[0].shape[:axis], *index.shape, *given[0].shape[axis + 1 :]])


def _cast(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    import torch  # pyright: ignore[reportMissingImports]

    kinds = {1: torch.float32, 6: torch.int32, 7: torch.int64, 9: torch.bool, 11: torch.float64}
    if attributes["to"] not in kinds:
        raise ValueError(f"Cast to ONNX type {attributes['to']} is not known here; export the network in float32")
    return given[0].to(kinds[attributes["to"]])


def _range(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    import torch  # pyright: ignore[reportMissingImports]

    first, end, step = (each.item() for each in given)
    return torch.arange(first, end, step, dtype=given[0].dtype, device=given[0].device)


def _shape(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    import torch  # pyright: ignore[reportMissingImports]

    sides = list(given[0].shape)[attributes.get("start", 0) : attributes.get("end")]
    return torch.tensor(sides, dtype=torch.int64, device=given[0].device)


def _concat(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    import torch  # pyright: ignore[reportMissingImports]

    return torch.cat(given, attributes["axis"])


def _clip(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    low, high = ([*given, None, None][k] for k in (1, 2))
    if low is None and high is None:
        low, high = attributes.get("min"), attributes.get("max")
    return given[0].clamp(low, high)


def _cumulative_sum(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    if attributes.get("exclusive", 0) or attributes.get("reverse", 0):
        raise ValueError("CumSum is known forwards and inclusive only")
    return given[0].cumsum(int(given[1].item()))


def _divide(given: list, attributes: Mapping[str, Any]) -> Any:  # noqa: ANN401
    if given[0].is_floating_point():
        return given[0] / given[1]
    return given[0].div(given[1], rounding_mode="trunc")


_OPERATORS: dict[str, Callable[[list, Mapping[str, Any]], Any]] = {
    "Add": lambda given, _: given[0] + given[1],
    "Cast": _cast,
    "Clip": _clip,
    "Concat": _concat,
    "Constant": lambda given, _: None,  # read with the file
    "Conv": _convolution,
    "CumSum": _cumulative_sum,
    "Div": _divide,
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
    "Range": _range,
    "Relu": lambda given, _: given[0].relu(),
    "Reshape": _reshape,
    "Resize": _resize,
    "Shape": _shape,
    "Sigmoid": lambda given, _: given[0].sigmoid(),
    "Slice": _slice,
    "Softmax": lambda given, attributes: given[0].softmax(attributes.get("axis", -1)),
    "Split": _split,
    "Squeeze": _squeeze,
    "Sub": lambda given, _: given[0] - given[1],
    "Tanh": lambda given, _: given[0].tanh(),
    "Transpose": lambda given, attributes: given[0].permute(attributes["perm"]),
    "Unsqueeze": _unsqueeze,
}
