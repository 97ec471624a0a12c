"""Random crops and photographic augmentation, on the training device.

Renders have clean edges, even exposure and no noise. Random gamma, saturation, contrast, brightness, white balance, a
gradient of the light across the image, defocus and sensor noise keep the network from leaning on that.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor
from torch.nn import functional

from warpav.detection.training.loss import NO_OBJECT, TargetBoxes

# The grey around a zoomed-out image is that of the letterbox.
_GREY = 114.0 / 255.0
_ZOOM_MIN, _ZOOM_MAX = 0.5, 1.8
_ZOOM_PROBABILITY = 0.6
# An object that the border cuts down to less than this share, or to less than this size, is ignored.
_KEPT_FRACTION_MIN = 0.25
MIN_SIDE_PX = 4.0


def augment(images_rgb: Tensor, truth: TargetBoxes, generator: torch.Generator) -> tuple[Tensor, TargetBoxes]:
    """A random view of every image.

    Args:
        images_rgb: uint8, shape [image, row, column, 3].
        truth: Their objects.
        generator: Random numbers, on the images' device.

    Returns:
        The network's input, RGB in 0..1, float32, shape [image, 3, row, column], and the objects in it.
    """
    count, rows, columns = images_rgb.shape[:3]
    device = images_rgb.device

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator, device=device)

    zoomed = uniform(0, 1, count) < _ZOOM_PROBABILITY
    zoom = torch.where(zoomed, uniform(math.log(_ZOOM_MIN), math.log(_ZOOM_MAX), count).exp(), 1.0)
    flipped = uniform(0, 1, count) < 0.5
    # An enlarged image is shifted within the frame that it covers, a reduced one within the frame that holds it.
    size_px = _constant((columns, rows), device)
    shift_px = uniform(0, 1, count, 2) * (1.0 - zoom)[:, None] * size_px

    image = images_rgb.permute(0, 3, 1, 2).float() / 255.0
    image = _warp(image - _GREY, zoom, shift_px / size_px, flipped) + _GREY
    image = _recolour(image, uniform)
    return image, _move(truth, zoom, shift_px, flipped, size_px)


def _warp(image: Tensor, zoom: Tensor, shift: Tensor, flipped: Tensor) -> Tensor:
    """Zoom about the top left corner, shift by a share of the frame, then mirror."""
    sign = torch.where(flipped, -1.0, 1.0)
    theta = torch.zeros(len(zoom), 2, 3, device=image.device)
    theta[:, 0, 0], theta[:, 1, 1] = sign / zoom, 1.0 / zoom
    theta[:, :, 2] = (1.0 - 2.0 * shift) / zoom[:, None] - 1.0
    grid = functional.affine_grid(theta, list(image.shape), align_corners=False)
    return functional.grid_sample(image, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


def _recolour(image: Tensor, uniform) -> Tensor:  # noqa: ANN001 - a closure of `augment`
    count = len(image)
    image = image.clamp(0.0, 1.0).pow(uniform(math.log(0.6), math.log(1.6), count, 1, 1, 1).exp())
    grey = image.mean(dim=1, keepdim=True)
    image = grey + (image - grey) * uniform(0.3, 1.4, count, 1, 1, 1)
    middle = image.mean(dim=(1, 2, 3), keepdim=True)
    image = middle + (image - middle) * uniform(0.7, 1.3, count, 1, 1, 1)
    image = image * uniform(0.65, 1.35, count, 1, 1, 1) * uniform(0.9, 1.1, count, 3, 1, 1)
    y = torch.linspace(-1.0, 1.0, image.shape[2], device=image.device)[:, None]
    x = torch.linspace(-1.0, 1.0, image.shape[3], device=image.device)
    image = image * (1.0 + uniform(-0.2, 0.2, count, 1, 1, 1) * x + uniform(-0.2, 0.2, count, 1, 1, 1) * y)
    # Half of the images stay sharp.
    image = image.lerp(_blurred(image), (uniform(-1.0, 1.0, count, 1, 1, 1)).clamp(0.0))
    noise = torch.rand_like(image) - 0.5
    return (image + noise * uniform(0.0, 0.12, count, 1, 1, 1)).clamp(0.0, 1.0)


def _blurred(image: Tensor) -> Tensor:
    """The image through a binomial filter of 5 x 5 pixels."""
    line = _constant((1.0, 4.0, 6.0, 4.0, 1.0), image.device) / 16.0
    filters = (line[:, None] * line).expand(3, 1, 5, 5).contiguous()
    return functional.conv2d(functional.pad(image, (2, 2, 2, 2), mode="replicate"), filters, groups=3)


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
    class_index = torch.where(gone, NO_OBJECT, truth.class_index)
    return TargetBoxes(cut_px, class_index, truth.ignored | small | mostly_gone)
