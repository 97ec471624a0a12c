"""What the panels of these figures share: titles, pictures that fill them, points of view."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.errors import InputError
from warpav.view.cloud_view import Viewpoint
from warpav.view.palette import GRID_RGB, MUTED_RGB, Rgb, hex_colour

BACKGROUND_RGB: Rgb = (214, 205, 230)
"""Where a picture shows nothing: not the colour of a vehicle, a road or the sky."""


def checked_png(path: Path | str) -> Path:
    """The path of a picture to write.

    Raises:
        InputError: It does not end in ``.png``.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise InputError(f"{path}: --out: expected a name that ends in .png, got {path.suffix!r}")
    return path


def show_picture(axis: Any, rgb: np.ndarray) -> None:  # noqa: ANN401 (matplotlib)
    """Fill a panel with an image."""
    axis.imshow(rgb, interpolation="antialiased", aspect="auto")
    empty_panel(axis)


def empty_panel(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
    """A panel without ticks in a thin frame."""
    axis.grid(visible=False)
    axis.set(xticks=[], yticks=[])
    for spine in axis.spines.values():
        spine.set(visible=True, color=hex_colour(GRID_RGB), linewidth=1.0)


def panel_sizes_px(figure: Any, axes: Iterable[Any]) -> list[tuple[int, int]]:  # noqa: ANN401 (matplotlib)
    """Width and height of panels as the layout leaves them [px]; titles and captions come before."""
    figure.draw_without_rendering()
    extents = [axis.get_window_extent() for axis in axes]
    return [(round(extent.width), round(extent.height)) for extent in extents]


def title(axis: Any, text: str, remark: str = "") -> None:  # noqa: ANN401 (matplotlib)
    """A heading on the left and a remark on the right; no longer together than the panel is wide."""
    axis.set_title(text)
    axis.set_title(remark, loc="right", fontweight="normal", fontsize=9)


def caption(figure: Any, text: str) -> None:  # noqa: ANN401 (matplotlib)
    """Lines below all panels, clear of their labels."""
    figure.get_layout_engine().set(h_pad=0.07)
    figure.supxlabel(text, fontsize=9, color=hex_colour(MUTED_RGB))


def count_text(count: int, what: str = "points") -> str:
    """A count to three digits, such as 7.37 million points."""
    number = f"{count / 1e6:.3g} million" if count >= 1_000_000 else f"{count:,}".replace(",", " ")
    return f"{number} {what.removesuffix('s') if count == 1 else what}"


def towards(bearing_rad: float, elevation_rad: float) -> np.ndarray:
    """Unit vector of a direction in the ego frame, shape [3]."""
    level = math.cos(elevation_rad)
    return np.array([level * math.cos(bearing_rad), level * math.sin(bearing_rad), math.sin(elevation_rad)])


def view_of(point_m: np.ndarray, direction: np.ndarray, size_px: tuple[int, int]) -> Viewpoint:
    """Without perspective, just so that all points are in the picture.

    Args:
        point_m: Points in the ego frame [m], shape [point, 3].
        direction: Unit vector from them to the viewer, not vertical.
        size_px: Width and height of the picture [px].
    """
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= np.linalg.norm(right)
    above = np.cross(direction, right)
    low, high = (reduce(point_m @ np.stack([right, above], axis=1), axis=0) for reduce in (np.min, np.max))
    middle, (width_m, height_m) = 0.5 * (low + high), high - low
    target_m = middle[0] * right + middle[1] * above + np.median(point_m @ direction) * direction
    height_m = 1.08 * max(width_m * size_px[1] / size_px[0], height_m)
    return Viewpoint(target_m + 150.0 * direction, target_m, height_m=height_m)
