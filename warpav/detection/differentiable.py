"""The detector's own loss on rendered images, with gradients to the images and to the true boxes (extra ``torch``).

The thesis's "ideal scenario": a detection model with gradient flow in the optimisation loop instead of a handcrafted
area. Only this side knows PyTorch; `warpav.objective` carries the gradients on to the cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warpav.detection.detector import ROAD_USERS
from warpav.detection.onnx_detector import OnnxDetector
from warpav.detection.torch_network import TorchNetwork, require_torch
from warpav.errors import InputError
from warpav.rig.camera import CameraModel

STRIDE_PX = 32
# The score at which the logarithmic score loss bends: a candidate far below still pulls, none pulls without bound.
_SCORE_FLOOR = 0.01
# How sharply a candidate must agree with the true box to answer for the object; a power of (1 + GIoU) / 2.
_AGREEMENT_POWER = 12.0
_TINY = 1e-12


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

    For an object with true box b, and the network's candidates j with boxes p_j and pooled scores
    ``q_j = 1 - prod over the labels of the object's group of (1 - score)``:

        g_j = (1 + GIoU(p_j, b)) / 2                           agreement, 0..1
        w_j = (q_j + e) g_j^12 / sum of the same               soft maximum: who answers for the object
        S   = sum of w_j q_j,   D = sum of w_j (1 - g_j)       its score, its disagreement
        L   = (ln((1 + e) / (S + e)) / ln((1 + e) / e) + D) / 2,   e = 0.01

    L is 0 for a sure and exact answer and at most 1. Gradients, all by PyTorch's reverse mode: dL/dS =
    -1 / (2 (S + e) ln((1 + e) / e)) and dL/dD = 1/2; through S, D and w_j to q_j, p_j and b; through the network to the
    image. b enters by g_j alone: dg_j/db is half the derivative of the generalised IoU, which does not vanish for
    boxes that lie apart.

    Args:
        path: ONNX file whose one output is [image, 4 + labels, candidates]: centre x, centre y, width, height in pixels
            of the input, then scores in 0..1.
        label_group: Group of every label, -1 for none, int [label]; see `warpav.detection.detector.ROAD_USERS`.
        device: Warp device of the images.

    Raises:
        InputError: PyTorch is missing or cannot use the device, or the file cannot be differentiated.
    """

    def __init__(self, path: str | Path, label_group: Sequence[int] | np.ndarray, *, device: str = "cpu") -> None:
        self._path = Path(path)
        self._network = TorchNetwork(path, device=_torch_device(device))
        self._label_group = np.asarray(label_group, np.int64)

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
            raise InputError(
                f"losses.detector_gradient: expected images of the network's own size, {columns} x {rows} px here, got "
                f"{camera.width_px} x {camera.height_px}; set camera.width_px={columns} camera.height_px={rows}"
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
            raise InputError(
                f"losses.detector_gradient: expected camera.width_px and camera.height_px to be multiples of "
                f"{STRIDE_PX}, got {width_px} x {height_px}"
            )
        if len(box_px) == 0:
            still = wp.zeros_like(image) if weight is not None else None
            return DetectionLoss(
                np.zeros(0, np.float32), still, None if weight is None else np.zeros((0, 4), np.float32)
            )
        # a view of the renderer's memory, not a copy; gradients are asked for a fresh leaf
        picture = wp.to_torch(image, requires_grad=False).detach().requires_grad_(weight is not None)
        truth_px = torch.from_numpy(np.asarray(box_px, np.float32)).to(picture.device)
        truth_px = truth_px.requires_grad_(weight is not None)
        with torch.set_grad_enabled(weight is not None):
            raw = self._raw_output(picture)
            loss = self._object_losses(raw, np.asarray(image_index, np.int64), truth_px, np.asarray(group, np.int64))
        if weight is None:
            return DetectionLoss(loss.cpu().numpy(), None, None)
        total = (loss * torch.from_numpy(np.asarray(weight, np.float32)).to(loss.device)).sum()
        to_picture, to_truth = torch.autograd.grad(total, [picture, truth_px])
        return DetectionLoss(
            loss.detach().cpu().numpy(), wp.from_torch(to_picture.contiguous(), dtype=wp.vec3), to_truth.cpu().numpy()
        )

    def _raw_output(self, picture: Any) -> Any:  # noqa: ANN401 (tensors; PyTorch is no import of this module)
        """The network's output for colours [image, row, column, 3], checked."""
        labels = len(self._label_group)
        try:
            raw = self._network(picture.permute(0, 3, 1, 2))
        except RuntimeError as error:
            raise InputError(
                f"{self._path}: losses.detector_gradient cannot run it on images of {picture.shape[2]} x "
                f"{picture.shape[1]} px: {' '.join(str(error).split())[:200]}; set camera.width_px and "
                "camera.height_px to the network's own size"
            ) from error
        if raw.ndim != 3 or raw.shape[0] != picture.shape[0] or raw.shape[1] != 4 + labels:
            raise InputError(
                f"{self._path}: losses.detector_gradient expected output [{picture.shape[0]}, 4 + {labels} labels, "
                f"candidates], got {list(raw.shape)}; export the network without suppression"
            )
        if not bool(raw.isfinite().all()):
            raise InputError(f"{self._path}: its output holds numbers that are not finite; export it in float32")
        return raw

    def _object_losses(self, raw: Any, image_index: np.ndarray, truth_px: Any, group: np.ndarray) -> Any:  # noqa: ANN401
        """L of every object."""
        import torch  # pyright: ignore[reportMissingImports]

        where = torch.from_numpy(image_index).to(raw.device)
        center, half = raw[:, :2], 0.5 * raw[:, 2:4]
        candidate_px = torch.cat([center - half, center + half], dim=1).transpose(1, 2)[where]
        # the complements of the scores of all labels that are not of the object's group count as 1
        counts = torch.from_numpy(self._label_group[None, :] == group[:, None]).to(raw)[:, :, None]
        score = 1.0 - (1.0 - counts * raw[where, 4:]).prod(dim=1)
        agreement = 0.5 * (1.0 + _generalised_iou(candidate_px, truth_px[:, None]))
        share = (score + _SCORE_FLOOR) * agreement.clamp(min=0.0) ** _AGREEMENT_POWER
        share = share / (share.sum(dim=1, keepdim=True) + _TINY)
        floor = torch.tensor(_SCORE_FLOOR, dtype=raw.dtype, device=raw.device)
        score_loss = torch.log((1.0 + floor) / ((share * score).sum(dim=1) + floor)) / torch.log((1.0 + floor) / floor)
        # shares sum to 1 unless no candidate agrees at all: then nothing answers, and the disagreement is 1
        disagreement = 1.0 - (share * agreement).sum(dim=1)
        return 0.5 * (score_loss + disagreement)


def _generalised_iou(first_px: Any, second_px: Any) -> Any:  # noqa: ANN401
    """Generalised IoU in -1..1 of boxes [..., 4] and [..., 4] (Rezatofighi et al., CVPR 2019)."""
    overlap = (first_px[..., 2:].minimum(second_px[..., 2:]) - first_px[..., :2].maximum(second_px[..., :2])).clamp(0.0)
    hull = first_px[..., 2:].maximum(second_px[..., 2:]) - first_px[..., :2].minimum(second_px[..., :2])
    intersection, hull_area = overlap.prod(dim=-1), hull.prod(dim=-1)
    first_area = (first_px[..., 2:] - first_px[..., :2]).prod(dim=-1)
    union = first_area + (second_px[..., 2:] - second_px[..., :2]).prod(dim=-1) - intersection
    return intersection / (union + _TINY) - (hull_area - union) / (hull_area + _TINY)


def _torch_device(device: str) -> str:
    """PyTorch's name of a Warp device.

    Raises:
        InputError: PyTorch is missing, or has no such device.
    """
    require_torch()
    import torch  # pyright: ignore[reportMissingImports]

    if device != "cpu" and not torch.cuda.is_available():
        raise InputError(
            f"losses.detector_gradient: expected a PyTorch that can use {device}, got one without CUDA; "
            "install PyTorch for your GPU (pytorch.org), or set device=cpu"
        )
    return device
