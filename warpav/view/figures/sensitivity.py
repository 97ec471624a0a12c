"""What errors of mounting and the loss of each camera cost a rig."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.figures.style import WIDTH_INCH, caption, figure_style, new_figure, title
from warpav.view.palette import FURTHER_RGB, INK_RGB, camera_rgb, hex_colour

if TYPE_CHECKING:
    from warpav.evaluation.perturbations import CameraOutages, MountTolerance

_LEAST_SHOWN = 0.1  # misses per 100 that have the full colour at least: less is no sensitivity
_BELOW_RGB = ((38, 102, 180), (190, 218, 242))


def sensitivity_figure(
    tolerance: MountTolerance | None, outages: CameraOutages | None = None, *, heading: str | None = None
) -> Any:  # noqa: ANN401 (matplotlib)
    """A heat map of cameras by degrees of freedom, and beside it a bar for the loss of each camera."""
    effects = [] if tolerance is None else tolerance.effects
    lost = [] if outages is None else [each.camera for each in outages.cameras]
    names = list(dict.fromkeys(effect.camera for effect in effects)) or lost
    if lost and names != lost:
        raise ValueError("tolerance and outages must be of the same cameras")
    panels = [part for part in (tolerance, outages) if part is not None]
    with figure_style():
        figure = new_figure(WIDTH_INCH, 1.5 + 0.34 * len(names))
        axes = figure.subplots(
            1, len(panels), squeeze=False, sharey=True, width_ratios=[1.7, 1.0] if len(panels) > 1 else None
        )[0]
        if heading:
            figure.suptitle(heading, fontweight="bold")
        if tolerance is not None:
            _draw_changes(axes[0], tolerance, names)
            caption(
                figure,
                f"Expected misses per 100 objects: {tolerance.nominal:.2f}; with all cameras off by chance "
                f"{tolerance.samples.mean():.2f} (mean of {len(tolerance.samples)} draws).",
            )
        if outages is not None:
            _draw_losses(axes[-1], outages)
        axes[0].set_yticks(range(len(names)), names)
        for label, index in zip(axes[0].get_yticklabels(), range(len(names)), strict=True):
            label.set(color=hex_colour(camera_rgb(index)), fontweight="bold")
        axes[0].set_ylim(len(names) - 0.5, -0.5)
        return figure


def _draw_changes(axis: Any, tolerance: MountTolerance, names: list[str]) -> None:  # noqa: ANN401 (matplotlib)
    from matplotlib.colors import LinearSegmentedColormap

    degrees = list(dict.fromkeys(effect.degree for effect in tolerance.effects))
    change = np.full((len(names), len(degrees)), math.nan)
    for effect in tolerance.effects:
        change[names.index(effect.camera), degrees.index(effect.degree)] = effect.worst
    most = max(float(np.abs(change).max()), _LEAST_SHOWN)
    stops = [hex_colour(rgb) for rgb in (*_BELOW_RGB, (255, 255, 255), *FURTHER_RGB[1:3])]
    colours = LinearSegmentedColormap.from_list("change", stops)
    axis.imshow(change, cmap=colours, vmin=-most, vmax=most, aspect="auto")
    for (row, column), value in np.ndenumerate(change):
        axis.text(column, row, f"{value:+z.2f}", ha="center", va="center", fontsize=8.5, color=hex_colour(INK_RGB))
    axis.set_xticks(range(len(degrees)), degrees)
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
    axis.tick_params(length=0)
    off = f"{100.0 * tolerance.position_m:g} cm or {math.degrees(tolerance.angle_rad):g}°"
    title(axis, f"Camera off by {off}", "misses per 100, change")


def _draw_losses(axis: Any, outages: CameraOutages) -> None:  # noqa: ANN401 (matplotlib)
    is_weighted = outages.weighted_expected_misses_per_100 is not None
    more = [
        each.difference_per_100 if each.weighted_difference_per_100 is None else each.weighted_difference_per_100
        for each in outages.cameras
    ]
    bars = axis.barh(range(len(more)), more, color=[hex_colour(camera_rgb(k)) for k in range(len(more))], height=0.62)
    axis.bar_label(bars, [f"{each:+z.1f}" for each in more], padding=3, fontsize=8.5)
    axis.margins(x=0.16)
    axis.grid(visible=False)
    axis.set_xticks([])
    axis.spines["bottom"].set_visible(False)
    axis.tick_params(left=False)
    title(axis, "Camera lost", "change, weighted" if is_weighted else "change")
