"""The detector's own loss on rendered images, with gradients to the images and to the true boxes (extra ``torch``).

The thesis's "ideal scenario": a detection model with gradient flow in the optimisation loop instead of a handcrafted
area. Only this side knows PyTorch; `warpav.optimisation` carries the gradients on to the cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warpav.core.errors import InputError, OptionError
from warpav.detection.detector import ROAD_USERS
from warpav.detection.onnx_detector import OnnxDetector
from warpav.detection.torch_network import TorchNetwork, require_torch
from warpav.raster.camera import CameraModel

STRIDE_PX = 32
# The score at which the logarithmic score loss bends: a candidate far below still pulls, none pulls without bound.
_SCORE_FLOOR = 0.01
# Error of a side, in sizes of the true box along it, at which the agreement of a candidate has halved.
_TOLERANCE = 0.25
_MIN_SIZE_PX = 4.0
# How sharply a candidate must agree with the true box to answer for the object.
_AGREEMENT_POWER = 3.0
PHASE_COUNT = 16
_REACH_PX = 8  # of the moves, to both sides
_SOFTENING = (1.0, 4.0, 6.0, 4.0, 1.0)
_GREY = 114.0 / 255.0
_TINY = 1e-20


@dataclass(frozen=True)
class DetectionLoss:
    """The loss of every object, and its gradients.

    Attributes:
        loss: In 0..1, float32 [object].
        image_gradient: Of the weighted sum to the colours, vec3 [image, row, column], on the device; None if not asked.
        box_gradient: Of the weighted sum to the true boxes [1/px], float32 [object, 4]; None likewise.
    """

    loss: np.ndarray
    image_gradient: wp.array | None
    box_gradient: np.ndarray | None


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
        label_group: Group of every label, -1 for none, int [label]; see `warpav.detection.detector.ROAD_USERS`.
        device: Warp device of the images.
        phase_count: n, 1 to 16; the cost grows with it.

    Raises:
        InputError: PyTorch is missing or cannot use the device, or the file cannot be differentiated.
    """

    def __init__(
        self,
        path: str | Path,
        label_group: Sequence[int] | np.ndarray,
        *,
        device: str = "cpu",
        phase_count: int = PHASE_COUNT,
    ) -> None:
        self._path = Path(path)
        self._network = TorchNetwork(path, device=_torch_device(device))
        self._label_group = np.asarray(label_group, np.int64)
        self._phases_px = [  # to the right, down
            tuple((step * k + _REACH_PX) % (2 * _REACH_PX) - _REACH_PX for step in (1, 5)) for k in range(phase_count)
        ]

    @classmethod
    def of(cls, detector: OnnxDetector, camera: CameraModel, *, device: str) -> DifferentiableDetector:
        """The network of a detector, for images of a camera.

        Raises:
            InputError: As the class; or the layout or size of the network's input is another than the images'.
        """
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
    ) -> DetectionLoss:
        """The loss of every object in the image that should show it.

        Args:
            image: Colours 0..1, vec3 [image, row, column], sides multiples of 32 px.
            image_index: The image of every object, int [object].
            box_px: True visible boxes ``x0, y0, x1, y1`` [px], float [object, 4].
            group: Group of every object, int [object].
            weight: Of every object's loss in the sum that is differentiated, float [object]; None: no gradient.

        Raises:
            InputError: The images' size is none that the network takes as it is, or its output is not of the layout, or
                not finite.
        """
        import torch  # pyright: ignore[reportMissingImports]

        _, height_px, width_px = image.shape
        if height_px % STRIDE_PX or width_px % STRIDE_PX:
            raise OptionError(
                "losses.detector_gradient",
                f"expected camera.width_px and camera.height_px to be multiples of "
                f"{STRIDE_PX}, got {width_px} x {height_px}",
            )
        if len(box_px) == 0:
            still = wp.zeros_like(image) if weight is not None else None
            return DetectionLoss(
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
            return DetectionLoss(loss, None, None)
        to_image, to_truth = (torch.stack(each).sum(dim=0) for each in zip(*gradients, strict=True))
        return DetectionLoss(loss, wp.from_torch(to_image.contiguous(), dtype=wp.vec3), to_truth.cpu().numpy())

    def _raw_output(self, rgb: Any) -> Any:  # noqa: ANN401 (tensors; PyTorch is no import of this module)
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

    def _object_losses(self, raw: Any, image_index: np.ndarray, truth_px: Any, group: np.ndarray) -> Any:  # noqa: ANN401
        """L of every object."""
        import torch  # pyright: ignore[reportMissingImports]

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


def _softened(rgb: Any) -> Any:  # noqa: ANN401
    """Planes [image, 3, row, column] of an image batch [image, row, column, 3], smoothed; its border is repeated."""
    from torch.nn import functional  # pyright: ignore[reportMissingImports]

    line = rgb.new_tensor(_SOFTENING) / sum(_SOFTENING)
    margin = len(_SOFTENING) // 2
    planes = functional.pad(rgb.permute(0, 3, 1, 2), [margin] * 4, mode="replicate")
    return functional.conv2d(planes, line.outer(line).expand(3, 1, -1, -1), groups=3)


def _moved(planes: Any, right_px: int, down_px: int) -> Any:  # noqa: ANN401
    """Planes [image, 3, row, column] moved by whole pixels; what comes in is grey."""
    from torch.nn import functional  # pyright: ignore[reportMissingImports]

    # padding below 0 cuts off
    return functional.pad(planes, (right_px, -right_px, down_px, -down_px), value=_GREY)


def _torch_device(device: str) -> str:
    """PyTorch's name of a Warp device."""
    require_torch()
    import torch  # pyright: ignore[reportMissingImports]

    if device != "cpu" and not torch.cuda.is_available():
        raise OptionError(
            "losses.detector_gradient",
            f"expected a PyTorch that can use {device}, got one without CUDA; "
            "install PyTorch for your GPU (pytorch.org), or set device=cpu",
        )
    return device
