"""What the detector is trained on: which cells answer for which object, and what they owe.

Cells are assigned by task alignment (Feng et al., TOOD, ICCV 2021): of the cells inside an object, those whose score
and box agree best with it. Scores are trained by the varifocal loss (Zhang et al., VarifocalNet, CVPR 2021) towards
that agreement, boxes by the generalised IoU (Rezatofighi et al., CVPR 2019).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

NO_OBJECT = -1

_CELLS_PER_OBJECT = 10
_SCORE_POWER = 0.5
_IOU_POWER = 6.0
# An object smaller than twice this is treated as that large, so that it holds the centre of a cell.
_MIN_HALF_SIZE_PX = 4.0
_BOX_WEIGHT = 2.5
_NEGATIVE_WEIGHT = 0.75
_EPSILON = 1e-9


@dataclass(frozen=True)
class TargetBoxes:
    """The objects of a batch, padded to one count.

    Attributes:
        box_px: Edges ``x0, y0, x1, y1`` [px], float32, shape [image, object, 4].
        class_index: Label, `NO_OBJECT` where padded, int64, shape [image, object].
        ignored: Objects that are neither to be found nor to be taken for background, bool, shape [image, object].
    """

    box_px: Tensor
    class_index: Tensor
    ignored: Tensor


@dataclass(frozen=True)
class Assignment:
    """What every cell should answer.

    Attributes:
        object_index: The object it answers for, 0 where none, int64, shape [image, cell].
        target: The score it should give to that object's label, 0 where none, float32, shape [image, cell].
        counts: Whether its scores count at all: false within ignored objects, bool, shape [image, cell].
    """

    object_index: Tensor
    target: Tensor
    counts: Tensor


def pairwise_iou(first_px: Tensor, second_px: Tensor) -> Tensor:
    """IoU of boxes [..., first, 4] and [..., second, 4], shape [..., first, second]."""
    first, second = first_px[..., :, None, :], second_px[..., None, :, :]
    size = (torch.minimum(first[..., 2:], second[..., 2:]) - torch.maximum(first[..., :2], second[..., :2])).clamp(0)
    intersection = size[..., 0] * size[..., 1]
    first_size, second_size = first[..., 2:] - first[..., :2], second[..., 2:] - second[..., :2]
    union = first_size[..., 0] * first_size[..., 1] + second_size[..., 0] * second_size[..., 1] - intersection
    return intersection / union.clamp(min=_EPSILON)


def generalised_iou(first_px: Tensor, second_px: Tensor) -> Tensor:
    """Generalised IoU in -1..1 of each box with its partner, [..., 4] and [..., 4], shape [...]."""
    first_low, first_high = first_px[..., :2], first_px[..., 2:]
    second_low, second_high = second_px[..., :2], second_px[..., 2:]
    overlap = torch.minimum(first_high, second_high) - torch.maximum(first_low, second_low)
    hull = torch.maximum(first_high, second_high) - torch.minimum(first_low, second_low)
    intersection = _area(overlap.clamp(0))
    union = _area(first_high - first_low) + _area(second_high - second_low) - intersection
    hull_area = _area(hull).clamp(min=_EPSILON)
    return intersection / union.clamp(min=_EPSILON) - (hull_area - union) / hull_area


def _area(size: Tensor) -> Tensor:
    """Width times height, [..., 2] to [...]; the backward pass of ``prod`` would scan, and wait for the device."""
    return size[..., 0] * size[..., 1]


@torch.no_grad()
def assign_cells(score_logit: Tensor, box_px: Tensor, center_px: Tensor, truth: TargetBoxes) -> Assignment:
    """Choose the cells that answer for each object.

    Args:
        score_logit: Scores before the sigmoid, shape [image, cell, class].
        box_px: Predicted boxes, shape [image, cell, 4].
        center_px: Centres of the cells, shape [cell, 2].
        truth: The objects.

    Returns:
        The assignment.
    """
    exists = truth.class_index != NO_OBJECT
    wanted = exists & ~truth.ignored
    middle_px = 0.5 * (truth.box_px[..., :2] + truth.box_px[..., 2:])
    half_px = (0.5 * (truth.box_px[..., 2:] - truth.box_px[..., :2])).clamp(min=_MIN_HALF_SIZE_PX)
    inside = ((center_px[None, None] - middle_px[:, :, None]).abs() < half_px[:, :, None]).all(dim=-1)

    iou = pairwise_iou(truth.box_px, box_px) * (inside & wanted[..., None])
    label = truth.class_index.clamp(min=0)
    score = score_logit.sigmoid().transpose(1, 2).gather(1, label[..., None].expand(-1, -1, iou.shape[2]))
    alignment = score.pow(_SCORE_POWER) * iou.pow(_IOU_POWER)
    best = alignment.topk(min(_CELLS_PER_OBJECT, alignment.shape[2]), dim=2)
    chosen = torch.zeros_like(alignment, dtype=torch.bool).scatter_(2, best.indices, best.values > _EPSILON**2)
    # A cell that several objects chose goes to the one that its box fits best.
    iou_chosen = iou * chosen
    object_index = iou_chosen.argmax(dim=1)
    owned = torch.zeros_like(chosen).scatter_(1, object_index[:, None], True) & chosen

    # Each object's best cell is to score the object's best IoU; the others in proportion to their alignment.
    alignment = alignment * owned
    best_alignment = alignment.amax(dim=2, keepdim=True).clamp(min=_EPSILON**3)
    best_iou = (iou * owned).amax(dim=2, keepdim=True)
    target = (alignment / best_alignment * best_iou).amax(dim=1)
    in_ignored = (inside & (exists & truth.ignored)[..., None]).any(dim=1)
    return Assignment(object_index, target, (target > 0.0) | ~in_ignored)


def detection_loss(score_logit: Tensor, box_px: Tensor, center_px: Tensor, truth: TargetBoxes) -> tuple[Tensor, Tensor]:
    """Loss of a batch.

    Args:
        score_logit: See `assign_cells`.
        box_px: See `assign_cells`.
        center_px: See `assign_cells`.
        truth: The objects.

    Returns:
        The loss of the scores and the weighted loss of the boxes, scalars with gradient; train on their sum.
    """
    assignment = assign_cells(score_logit, box_px, center_px, truth)
    norm = assignment.target.sum().clamp(min=1.0)

    label = truth.class_index.clamp(min=0).gather(1, assignment.object_index)
    target = torch.zeros_like(score_logit).scatter_(2, label[..., None], assignment.target[..., None])
    # Negatives weigh the less, the surer the network is of them; positives weigh as much as they should score.
    weight = torch.where(target > 0.0, target, _NEGATIVE_WEIGHT * score_logit.detach().sigmoid().square())
    weight = weight * assignment.counts[..., None]
    score_loss = (functional.binary_cross_entropy_with_logits(score_logit, target, reduction="none") * weight).sum()

    truth_px = truth.box_px.gather(1, assignment.object_index[..., None].expand(-1, -1, 4))
    box_loss = ((1.0 - generalised_iou(box_px, truth_px)) * assignment.target).sum()
    return score_loss / norm, _BOX_WEIGHT * box_loss / norm
