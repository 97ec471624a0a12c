"""The built-in detector's network and its ONNX file: one stage, no anchors, four strides, 1.8 million parameters.

Plain 3 x 3 convolutions and ReLU throughout: on a CPU they run several times faster than depthwise convolutions and
smooth activations of the same arithmetic. The finest stride is 4, because a car 20 m away is 10 px high in a 256 px
image.
"""

from __future__ import annotations

import copy
import logging
import math
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from warpav.detection.training import CLASS_NAMES

_STRIDES_PX = (4, 8, 16, 32)
_OPSET = 17
MAX_ERROR = 1e-3

_logger = logging.getLogger(__name__)

# exp of the network's distance output, in strides: from a fiftieth of a pixel to 150 cells.
_LOG_DISTANCE_MIN, _LOG_DISTANCE_MAX = -5.0, 5.0


def _convolution(channels_in: int, channels_out: int, *, size: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, size, stride, padding=size // 2, bias=False),
        nn.BatchNorm2d(channels_out, eps=1e-3, momentum=0.03),
        nn.ReLU(inplace=True),
    )


class _Stage(nn.Module):
    """Cross-stage block: half the channels pass through residual 3 x 3 pairs, and all are mixed at the end."""

    def __init__(self, channels_in: int, channels_out: int, depth: int, *, residual: bool = True) -> None:
        super().__init__()
        half = channels_out // 2
        self.through = _convolution(channels_in, half, size=1)
        self.past = _convolution(channels_in, half, size=1)
        self.pairs = nn.ModuleList(
            nn.Sequential(_convolution(half, half), _convolution(half, half)) for _ in range(depth)
        )
        self.mix = _convolution(channels_out, channels_out, size=1)
        self.residual = residual

    def forward(self, feature: Tensor) -> Tensor:
        through = self.through(feature)
        for pair in self.pairs:
            through = through + pair(through) if self.residual else pair(through)
        return self.mix(torch.cat([through, self.past(feature)], dim=1))


class _WideView(nn.Module):
    """Three chained 5 x 5 maxima: the coarsest stride sees the whole image."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.enter = _convolution(channels, channels // 2, size=1)
        self.leave = _convolution(channels * 2, channels, size=1)

    def forward(self, feature: Tensor) -> Tensor:
        features = [self.enter(feature)]
        for _ in range(3):
            features.append(functional.max_pool2d(features[-1], 5, 1, 2))
        return self.leave(torch.cat(features, dim=1))


class _Head(nn.Module):
    """Scores and distances of one stride, from two branches."""

    def __init__(self, channels: int, class_count: int, stride_px: int) -> None:
        super().__init__()
        self.score_branch = _convolution(channels, channels)
        self.distance_branch = _convolution(channels, channels)
        self.score = nn.Conv2d(channels, class_count, 1)
        self.distance = nn.Conv2d(channels, 4, 1)
        # Start from few objects in an image, each about four cells wide.
        objects_per_cell = 5.0 / (256.0 / stride_px) ** 2
        nn.init.constant_(self.score.bias, math.log(objects_per_cell / class_count))
        nn.init.constant_(self.distance.bias, math.log(2.0))

    def forward(self, feature: Tensor) -> tuple[Tensor, Tensor]:
        score, distance = self.score_branch(feature), self.distance_branch(feature)
        # The last layers keep full precision: a bfloat16 logarithm would round a distance by more than a per cent.
        with torch.autocast(feature.device.type, enabled=False):
            return self.score(score.float()), self.distance(distance.float())


class TownNetwork(nn.Module):
    """Images to boxes and scores at strides 4, 8, 16 and 32."""

    def __init__(
        self,
        class_count: int = len(CLASS_NAMES),
        *,
        channels: Sequence[int] = (16, 32, 64, 96, 176),
        depth: Sequence[int] = (1, 2, 2, 2),
        neck_channels: Sequence[int] = (32, 64, 96, 112),
    ) -> None:
        super().__init__()
        self.class_count = class_count
        self.stem = _convolution(3, channels[0], stride=2)
        self.down = nn.ModuleList(_convolution(channels[i], channels[i + 1], stride=2) for i in range(4))
        self.stages = nn.ModuleList(_Stage(channels[i + 1], channels[i + 1], depth[i]) for i in range(4))
        self.wide_view = _WideView(channels[4])
        self.lateral = nn.ModuleList(_convolution(channels[i + 1], neck_channels[i], size=1) for i in range(4))
        self.reduce = nn.ModuleList(_convolution(neck_channels[i + 1], neck_channels[i], size=1) for i in range(3))
        self.top_down = nn.ModuleList(
            _Stage(2 * neck_channels[i], neck_channels[i], 1, residual=False) for i in range(3)
        )
        self.neck_down = nn.ModuleList(_convolution(neck_channels[i], neck_channels[i], stride=2) for i in range(3))
        self.bottom_up = nn.ModuleList(
            _Stage(neck_channels[i] + neck_channels[i + 1], neck_channels[i + 1], 1, residual=False) for i in range(3)
        )
        self.heads = nn.ModuleList(
            _Head(each, class_count, stride_px) for each, stride_px in zip(neck_channels, _STRIDES_PX, strict=True)
        )

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Score logits [image, cell, class], box edges [px], cell centres [px], strides [px] of images in 0..1."""
        feature = self.stem(images)
        features = []
        for down, stage in zip(self.down, self.stages, strict=True):
            feature = stage(down(feature))
            features.append(feature)
        features[3] = self.wide_view(features[3])
        features = [lateral(feature) for lateral, feature in zip(self.lateral, features, strict=True)]
        for i in (2, 1, 0):
            enlarged = functional.interpolate(self.reduce[i](features[i + 1]), scale_factor=2.0, mode="nearest")
            features[i] = self.top_down[i](torch.cat([features[i], enlarged], dim=1))
        for i in (0, 1, 2):
            features[i + 1] = self.bottom_up[i](torch.cat([self.neck_down[i](features[i]), features[i + 1]], dim=1))

        score_logits, boxes_px, centers_px, strides_px = [], [], [], []
        for head, feature, stride_px in zip(self.heads, features, _STRIDES_PX, strict=True):
            score_logit, log_distance = head(feature)
            rows, columns = feature.shape[2], feature.shape[3]
            y_px = (torch.arange(rows, device=images.device, dtype=torch.float32) + 0.5) * stride_px
            x_px = (torch.arange(columns, device=images.device, dtype=torch.float32) + 0.5) * stride_px
            center_px = torch.stack(
                [x_px[None, :] + 0.0 * y_px[:, None], y_px[:, None] + 0.0 * x_px[None, :]], dim=-1
            ).reshape(-1, 2)
            distance_px = log_distance.clamp(_LOG_DISTANCE_MIN, _LOG_DISTANCE_MAX).exp() * stride_px
            distance_px = distance_px.flatten(2).transpose(1, 2)
            boxes_px.append(torch.cat([center_px - distance_px[..., :2], center_px + distance_px[..., 2:]], dim=-1))
            score_logits.append(score_logit.flatten(2).transpose(1, 2))
            centers_px.append(center_px)
            strides_px.append(torch.full_like(center_px[:, 0], float(stride_px)))
        return torch.cat(score_logits, 1), torch.cat(boxes_px, 1), torch.cat(centers_px), torch.cat(strides_px)


class _ExportedNetwork(nn.Module):
    """The network with the output layout that `warpav.detection._onnx_detector` reads."""

    def __init__(self, network: TownNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        """Rows centre x, centre y, width, height [px] and class scores in 0..1, shape [image, 4 + class, cell]."""
        score_logit, box_px, _, _ = self.network(images)
        left_top, right_bottom = box_px[..., :2], box_px[..., 2:]
        output = torch.cat([0.5 * (left_top + right_bottom), right_bottom - left_top, score_logit.sigmoid()], dim=-1)
        return output.transpose(1, 2)


def export_network(network: TownNetwork, path: Path) -> float:
    """Write the network as ONNX with dynamic batch and size, and compare the two."""
    import onnx
    import onnxruntime

    exported = _ExportedNetwork(copy.deepcopy(network).cpu()).eval()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            exported,
            (torch.zeros(2, 3, 64, 96),),
            str(path),
            input_names=["images"],
            output_names=["output0"],
            dynamic_axes={"images": {0: "batch", 2: "rows", 3: "columns"}, "output0": {0: "batch", 2: "candidates"}},
            opset_version=_OPSET,
            dynamo=False,
        )
    model = onnx.load(str(path))
    onnx.helper.set_model_props(
        model,
        {
            "description": "Road users in renders of warpav's town scenes",
            "author": "The warpav authors",
            "license": "Apache-2.0",
            "task": "detect",
            "stride": str(max(_STRIDES_PX)),
            "names": str(dict(enumerate(CLASS_NAMES[: network.class_count]))),
        },
    )
    model.producer_name, model.producer_version = "warpav", ""
    onnx.save(model, str(path))

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    error = 0.0
    for shape in ((1, 3, 256, 256), (3, 3, 160, 224)):
        images = np.random.default_rng(0).random(shape, np.float32)
        with torch.no_grad():
            expected = exported(torch.from_numpy(images)).numpy()
        got = session.run(None, {"images": images})[0]
        error = max(error, float((np.abs(got - expected) / np.maximum(np.abs(expected), 1.0)).max()))
    if not error < MAX_ERROR:
        raise RuntimeError(f"{path}: PyTorch and onnxruntime differ by {error:.2g}, at most {MAX_ERROR} is fine")
    _logger.info("%s: %.1f MB, differs from PyTorch by %.1g", path, path.stat().st_size / 1e6, error)
    return error
