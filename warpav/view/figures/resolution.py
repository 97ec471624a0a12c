"""Pixels per degree by direction: along the horizon, and over azimuth and elevation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.sight.around import px_per_degree
from warpav.view.figures.style import WIDTH_INCH, caption, figure_style, new_figure, title
from warpav.view.palette import GROUND_RGB, camera_rgb, hex_colour

if TYPE_CHECKING:
    from warpav.rig.rig import Rig

_STEP_DEG = 0.5
_ELEVATION_DEG = 60.0


def resolution_figure(rigs: Mapping[str, Rig], *, heading: str | None = None) -> Any:  # noqa: ANN401 (matplotlib)
    """Pixels that the best camera has for a degree, along the horizon for all rigs, and below for each as a map.

    The best camera of a direction is the one with most pixels per degree there: the square root of pixels per square
    degree, from the derivative of `CameraModel.project`. On the optical axis of a pinhole with the focal length f in
    pixels it is ``f pi / 180``. Directions are taken from each camera's own centre; nothing stands in the way.
    """
    azimuth_deg = np.arange(-180.0, 180.0 + _STEP_DEG, _STEP_DEG)
    elevation_deg = np.arange(-_ELEVATION_DEG, _ELEVATION_DEG + _STEP_DEG, _STEP_DEG)
    best = {name: _best(rig, azimuth_deg, elevation_deg) for name, rig in rigs.items()}
    horizon = len(elevation_deg) // 2
    most = max(float(each.max()) for each in best.values())
    with figure_style():
        figure = new_figure(WIDTH_INCH, 3.2 + 2.3 * len(rigs))
        axes = figure.subplots(1 + len(rigs), 1, sharex=True, height_ratios=[1.2, *[1.0] * len(rigs)])
        for index, (name, found) in enumerate(best.items()):
            line = np.where(found[horizon] > 0.0, found[horizon], np.nan)
            gap_deg = 360.0 * float((found[horizon] == 0.0).mean())
            label = f"{name}: mean {np.nanmean(line):.1f}, no image on {gap_deg:.0f}°"
            axes[0].plot(azimuth_deg, line, color=hex_colour(camera_rgb(index)), label=label)
        axes[0].set(ylim=(0.0, 1.1 * max(float(each[horizon].max()) for each in best.values()) or 1.0))
        axes[0].set_ylabel("pixels per degree")
        axes[0].legend(loc="lower right", ncols=min(2, len(rigs)))
        title(axes[0], "Along the horizon, best camera")
        image = None
        for axis, (name, found) in zip(axes[1:], best.items(), strict=True):
            image = axis.pcolormesh(
                azimuth_deg,
                elevation_deg,
                np.ma.masked_equal(found, 0.0),
                cmap="viridis",
                vmin=0.0,
                vmax=most,
                rasterized=True,
            )
            axis.set_facecolor(hex_colour(GROUND_RGB))
            axis.grid(visible=False)
            axis.axhline(0.0, color="white", linewidth=0.8, linestyle="--")
            axis.set(ylabel="elevation [°]", yticks=(-60, -30, 0, 30, 60))
            title(axis, f"{name}: over azimuth and elevation" if len(rigs) > 1 else "Over azimuth and elevation")
        axes[-1].set(xlim=(180.0, -180.0), xticks=range(180, -181, -45))
        axes[-1].set_xlabel("azimuth [°]: 0 ahead, 90 to the left, -90 to the right")
        bar = figure.colorbar(image, ax=list(axes[1:]), pad=0.01, aspect=14 * len(rigs))
        bar.set_label("pixels per degree")
        bar.outline.set_visible(False)
        caption(figure, "Grey: in no image. Dashed: horizon. The own body is left out of account.")
        if heading:
            figure.suptitle(heading, x=0.01, ha="left", fontweight="bold")
        return figure


def _best(rig: Rig, azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
    """Pixels per degree of the best camera, float64 [elevation, azimuth]; 0 where a direction is in no image."""
    elevation_rad, azimuth_rad = np.meshgrid(np.radians(elevation_deg), np.radians(azimuth_deg), indexing="ij")
    level = np.cos(elevation_rad)
    direction = np.stack([level * np.cos(azimuth_rad), level * np.sin(azimuth_rad), np.sin(elevation_rad)], axis=-1)
    return np.max([px_per_degree(camera, direction) for camera in rig.cameras], axis=0)
