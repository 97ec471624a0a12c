"""How an image is scaled and padded to the input of a network."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

GREY = 114
"""Value of the padding."""


class ImagePlacement(Enum):
    """Where an image lies in the network's input."""

    CENTRED = "centred"
    TOP_LEFT = "top left"
    STRETCHED = "stretched"


@dataclass(frozen=True)
class Letterbox:
    """How an image is scaled and padded to the network's input.

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
    def fit(
        cls,
        height_px: int,
        width_px: int,
        input_height_px: int,
        input_width_px: int,
        placement: ImagePlacement = ImagePlacement.CENTRED,
    ) -> Letterbox:
        """The letterbox that shows an image as large as the input allows; a stretched one fills the input."""
        if placement is ImagePlacement.STRETCHED:
            return cls(input_height_px, input_width_px, input_height_px, input_width_px, 0, 0)
        scale = min(input_height_px / height_px, input_width_px / width_px)
        scaled_height_px = max(1, min(input_height_px, round(height_px * scale)))
        scaled_width_px = max(1, min(input_width_px, round(width_px * scale)))
        centred = placement is ImagePlacement.CENTRED
        return cls(
            input_height_px,
            input_width_px,
            scaled_height_px,
            scaled_width_px,
            (input_height_px - scaled_height_px) // 2 if centred else 0,
            (input_width_px - scaled_width_px) // 2 if centred else 0,
        )

    def canvas(self, images_rgb: np.ndarray) -> np.ndarray:
        """The images at their position in the input, uint8, shape [image, row, column, 3].

        Args:
            images_rgb: Images, uint8, shape [image, row, column, 3].
        """
        if images_rgb.shape[1:3] == (self.input_height_px, self.input_width_px):
            return images_rgb
        import cv2

        canvas = np.full((len(images_rgb), self.input_height_px, self.input_width_px, 3), GREY, np.uint8)
        rows = slice(self.top_px, self.top_px + self.scaled_height_px)
        columns = slice(self.left_px, self.left_px + self.scaled_width_px)
        for image_rgb, target in zip(images_rgb, canvas, strict=True):
            target[rows, columns] = cv2.resize(
                image_rgb, (self.scaled_width_px, self.scaled_height_px), interpolation=cv2.INTER_LINEAR
            )
        return canvas

    def unpack(self, box_input_px: np.ndarray, height_px: int, width_px: int) -> np.ndarray:
        """Boxes of the network's input as boxes of the image, cut off at its border, float32 [box, 4]."""
        left_top = np.array([self.left_px, self.top_px] * 2, np.float32)
        scale = np.array([width_px / self.scaled_width_px, height_px / self.scaled_height_px] * 2, np.float32)
        size = np.array([width_px, height_px] * 2, np.float32)
        return np.clip((box_input_px - left_top) * scale, 0.0, size).astype(np.float32)
