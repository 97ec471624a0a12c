"""What the detector is trained on: random views of images, which cells answer for which object, and what they owe.

Cells are assigned by task alignment (Feng et al., TOOD, ICCV 2021): of the cells inside an object, those whose score
and box agree best with it. Scores are trained by the varifocal loss (Zhang et al., VarifocalNet, CVPR 2021) towards
that agreement, boxes by the generalised IoU (Rezatofighi et al., CVPR 2019).

Renders have clean edges, even exposure and no noise. Random gamma, saturation, contrast, brightness, white balance, a
gradient of the light across the image, defocus and sensor noise keep the network from leaning on that; towards the
end of a training they weaken, since renders are what the network is for.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

_NO_OBJECT = -1

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
    """The objects of a batch, padded to one count."""

    box_px: Tensor  # edges ``x0, y0, x1, y1`` [px], float32, shape [image, object, 4]
    class_index: Tensor  # label, `_NO_OBJECT` where padded, int64, shape [image, object]
    ignored: Tensor  # objects that are neither to be found nor to be taken for background, bool, shape [image, object]


def pairwise_iou(first_px: Tensor, second_px: Tensor) -> Tensor:
    """IoU of boxes [..., first, 4] and [..., second, 4], shape [..., first, second]."""
    first, second = first_px[..., :, None, :], second_px[..., None, :, :]
    size = (torch.minimum(first[..., 2:], second[..., 2:]) - torch.maximum(first[..., :2], second[..., :2])).clamp(0)
    intersection = size[..., 0] * size[..., 1]
    first_size, second_size = first[..., 2:] - first[..., :2], second[..., 2:] - second[..., :2]
    union = first_size[..., 0] * first_size[..., 1] + second_size[..., 0] * second_size[..., 1] - intersection
    return intersection / union.clamp(min=_EPSILON)


def _generalised_iou(first_px: Tensor, second_px: Tensor) -> Tensor:
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
def assign_cells(
    score_logit: Tensor, box_px: Tensor, center_px: Tensor, truth: TargetBoxes
) -> tuple[Tensor, Tensor, Tensor]:
    """What every cell should answer, of logits [image, cell, class] and boxes [image, cell, 4]; each [image, cell].

    The object it answers for, 0 where none; the score it should give to that object's label, 0 where none; whether its
    scores count at all, which they do not within ignored objects.
    """
    exists = truth.class_index != _NO_OBJECT
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
    return object_index, target, (target > 0.0) | ~in_ignored


def detection_loss(score_logit: Tensor, box_px: Tensor, center_px: Tensor, truth: TargetBoxes) -> tuple[Tensor, Tensor]:
    object_index, wanted, counts = assign_cells(score_logit, box_px, center_px, truth)
    norm = wanted.sum().clamp(min=1.0)

    label = truth.class_index.clamp(min=0).gather(1, object_index)
    target = torch.zeros_like(score_logit).scatter_(2, label[..., None], wanted[..., None])
    # Negatives weigh the less, the surer the network is of them; positives weigh as much as they should score.
    weight = torch.where(target > 0.0, target, _NEGATIVE_WEIGHT * score_logit.detach().sigmoid().square())
    weight = weight * counts[..., None]
    score_loss = (functional.binary_cross_entropy_with_logits(score_logit, target, reduction="none") * weight).sum()

    truth_px = truth.box_px.gather(1, object_index[..., None].expand(-1, -1, 4))
    box_loss = ((1.0 - _generalised_iou(box_px, truth_px)) * wanted).sum()
    return score_loss / norm, _BOX_WEIGHT * box_loss / norm


# The grey around a zoomed-out image is that of the letterbox.
_GREY = 114.0 / 255.0
_ZOOM_MIN, _ZOOM_MAX = 0.5, 1.8
_ZOOM_PROBABILITY = 0.6
# An object that the border cuts down to less than this share, or to less than this size, is ignored.
_KEPT_FRACTION_MIN = 0.25
MIN_SIDE_PX = 4.0


def augment(
    images_rgb: Tensor, truth: TargetBoxes, generator: torch.Generator, *, strength: float = 1.0
) -> tuple[Tensor, TargetBoxes]:
    """A random view of every image: the network's input, 0..1, [image, 3, row, column], and the objects in it.

    ``strength`` in 0..1 scales how often images are zoomed, and how far their colours leave the render's.
    """
    count, rows, columns = images_rgb.shape[:3]
    device = images_rgb.device

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator, device=device)

    zoomed = uniform(0, 1, count) < strength * _ZOOM_PROBABILITY
    zoom = torch.where(zoomed, uniform(math.log(_ZOOM_MIN), math.log(_ZOOM_MAX), count).exp(), 1.0)
    flipped = uniform(0, 1, count) < 0.5
    # An enlarged image is shifted within the frame that it covers, a reduced one within the frame that holds it.
    size_px = _constant((columns, rows), device)
    shift_px = uniform(0, 1, count, 2) * (1.0 - zoom)[:, None] * size_px

    image = images_rgb.permute(0, 3, 1, 2).float() / 255.0
    image = _warp(image - _GREY, zoom, shift_px / size_px, flipped) + _GREY
    image = _recolour(image, uniform, strength)
    return image, _move(truth, zoom, shift_px, flipped, size_px)


def _warp(image: Tensor, zoom: Tensor, shift: Tensor, flipped: Tensor) -> Tensor:
    """Zoom about the top left corner, shift by a share of the frame, then mirror."""
    sign = torch.where(flipped, -1.0, 1.0)
    theta = torch.zeros(len(zoom), 2, 3, device=image.device)
    theta[:, 0, 0], theta[:, 1, 1] = sign / zoom, 1.0 / zoom
    theta[:, :, 2] = (1.0 - 2.0 * shift) / zoom[:, None] - 1.0
    grid = functional.affine_grid(theta, list(image.shape), align_corners=False)
    return functional.grid_sample(image, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


def _recolour(image: Tensor, uniform, strength: float) -> Tensor:  # noqa: ANN001 - a closure of `augment`
    def factor(low: float, high: float, *shape: int) -> Tensor:
        return 1.0 + strength * (uniform(low, high, *shape) - 1.0)

    count = len(image)
    image = image.clamp(0.0, 1.0).pow((strength * uniform(math.log(0.6), math.log(1.6), count, 1, 1, 1)).exp())
    grey = image.mean(dim=1, keepdim=True)
    image = grey + (image - grey) * factor(0.3, 1.4, count, 1, 1, 1)
    middle = image.mean(dim=(1, 2, 3), keepdim=True)
    image = middle + (image - middle) * factor(0.7, 1.3, count, 1, 1, 1)
    image = image * factor(0.65, 1.35, count, 1, 1, 1) * factor(0.9, 1.1, count, 3, 1, 1)
    y = torch.linspace(-strength, strength, image.shape[2], device=image.device)[:, None]
    x = torch.linspace(-strength, strength, image.shape[3], device=image.device)
    image = image * (1.0 + uniform(-0.2, 0.2, count, 1, 1, 1) * x + uniform(-0.2, 0.2, count, 1, 1, 1) * y)
    # At full strength half of the images stay sharp, the others go through a binomial filter of 5 x 5 pixels.
    line = _constant((1.0, 4.0, 6.0, 4.0, 1.0), image.device) / 16.0
    filters = (line[:, None] * line).expand(3, 1, 5, 5).contiguous()
    blurred = functional.conv2d(functional.pad(image, (2, 2, 2, 2), mode="replicate"), filters, groups=3)
    image = image.lerp(blurred, uniform(strength - 2.0, strength, count, 1, 1, 1).clamp(0.0))
    noise = torch.rand_like(image) - 0.5
    return (image + noise * uniform(0.0, 0.12 * strength, count, 1, 1, 1)).clamp(0.0, 1.0)


@functools.cache
def _constant(values: tuple[float, ...], device: torch.device) -> Tensor:
    """These values on the device; copied once, since a copy waits for all that the device has yet to do."""
    return torch.tensor(values, dtype=torch.float32, device=device)


def _move(truth: TargetBoxes, zoom: Tensor, shift_px: Tensor, flipped: Tensor, size_px: Tensor) -> TargetBoxes:
    box_px = truth.box_px * zoom[:, None, None] + shift_px.repeat(1, 2)[:, None]
    x0, y0, x1, y1 = box_px.unbind(dim=-1)
    mirrored_px = torch.stack([size_px[0] - x1, y0, size_px[0] - x0, y1], dim=-1)
    box_px = torch.where(flipped[:, None, None], mirrored_px, box_px)
    cut_px = torch.minimum(box_px.clamp(min=0.0), size_px.repeat(2))
    area_px = (box_px[..., 2:] - box_px[..., :2]).prod(dim=-1)
    cut_size_px = cut_px[..., 2:] - cut_px[..., :2]
    gone = (cut_size_px < 1.0).any(dim=-1)
    small = (cut_size_px < MIN_SIDE_PX).any(dim=-1)
    mostly_gone = cut_size_px.prod(dim=-1) < _KEPT_FRACTION_MIN * area_px
    class_index = torch.where(gone, _NO_OBJECT, truth.class_index)
    return TargetBoxes(cut_px, class_index, truth.ignored | small | mostly_gone)
