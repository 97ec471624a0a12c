"""Where the vehicles of a collection stand (figure 8)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.errors import InputError
from warpav.scene.scene import Box
from warpav.view.figures.style import (
    WIDTH_INCH,
    caption,
    count_text,
    figure_style,
    new_figure,
    save_figure,
    title,
)
from warpav.view.palette import INK_RGB, hex_colour


def heat_maps(
    collections: Mapping[str, Sequence[Sequence[Box]]],
    path: Path | str,
    *,
    ego_box: Box,
    radius_m: float | None = None,
    cell_m: float = 0.25,
) -> Path:
    """Figure 8: how often a vehicle stands where around the ego vehicle, one map for each collection."""
    if radius_m is None:
        corners = [np.abs(box.corners_m()[:, :2]).max() for part in collections.values() for s in part for box in s]
        radius_m = 5.0 * math.ceil(max(corners, default=20.0) / 5.0)
    share = {name: vehicle_occupancy(part, radius_m=radius_m, cell_m=cell_m) for name, part in collections.items()}
    with figure_style():
        figure = new_figure(WIDTH_INCH, 1.45 + (WIDTH_INCH - 0.9) / len(share))
        axes = figure.subplots(1, len(share), sharey=True, squeeze=False)[0]
        for axis, (name, one) in zip(axes, share.items(), strict=True):
            image = axis.imshow(
                np.where(one > 0.0, 100.0 * one, np.nan)[::-1, ::-1],
                extent=(radius_m, -radius_m, -radius_m, radius_m),
                cmap=_heat_colours(),
                vmin=0.0,
                vmax=100.0 * max(float(one.max()), 1e-9),
                interpolation="nearest",
                zorder=2,
            )
            x, y = ego_box.corners_m()[[0, 4, 6, 2], :2].T
            axis.fill(y, x, color=hex_colour(INK_RGB), linewidth=0, zorder=3)
            vehicle_count = sum(len(boxes) for boxes in collections[name])
            title(
                axis,
                name.title(),
                f"{count_text(len(collections[name]), 'scenes')}, {count_text(vehicle_count, 'vehicles')}",
            )
            axis.set_xlabel("y, left [m]")
            axis.locator_params(nbins=4)
            bar = figure.colorbar(image, ax=axis, orientation="horizontal", pad=0.02, aspect=28)
            bar.set_label("scenes with a vehicle there [%]")
            bar.outline.set_visible(False)
        axes[0].set_ylabel("x, forward [m]")
        caption(figure, "Black: the ego vehicle. White: no vehicle in any scene. Every map has a scale of its own.")
        figure.get_layout_engine().set(w_pad=0.1)
        return save_figure(figure, path)


def vehicle_occupancy(scenes: Sequence[Sequence[Box]], *, radius_m: float, cell_m: float) -> np.ndarray:
    """Share of the scenes in which a vehicle's box covers the middle of a cell.

    Returns:
        0..1, float64, shape [row, column]; rows run along x, columns along y, both from ``-radius_m``.
    """
    if not scenes:
        raise InputError("a heat map needs at least one scene, got 0")
    count = math.ceil(2.0 * radius_m / cell_m)
    centre = -radius_m + (np.arange(count) + 0.5) * cell_m
    point_m = np.stack([*np.meshgrid(centre, centre, indexing="ij"), np.zeros((count, count))], axis=-1).reshape(-1, 3)
    total = np.zeros(count * count)
    for boxes in scenes:
        covered = np.zeros(count * count, bool)
        for box in boxes:
            covered |= box.contains(point_m + np.array([0.0, 0.0, box.center_m[2]]))
        total += covered
    return total.reshape(count, count) / len(scenes)


def _heat_colours() -> Any:  # noqa: ANN401 (matplotlib)
    """From blue, where vehicles are rare, to dark red, where most are; the thesis's colours."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("heat", ["#2c4fa3", "#4fa3d1", "#f3e38a", "#ee7b35", "#a3121f", "#6b0612"])
