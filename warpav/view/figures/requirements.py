"""Requirements from above: which points of the ground are met, and how many cameras see enough there."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.figures.style import WIDTH_INCH, figure_style, new_figure, save_figure, title
from warpav.view.figures.top_view import draw_cameras, draw_vehicle
from warpav.view.palette import COVERAGE_RGB, INK_RGB, MUTED_RGB, hex_colour

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig
    from warpav.sight.check import RequirementResult

_LEFT_INCH, _RIGHT_INCH, _BELOW_INCH, _ABOVE_INCH = 0.7, 0.15, 0.95, 0.42
"""Around the panel, for labels, the key and the title."""

_COUNTS = ("no camera", "1 camera", "2 cameras", "3 or more")


def requirement_map(path: Path | str, *, result: RequirementResult, rig: Rig, ego: Mesh) -> Path:
    """Draw every point of the requirements from above, x pointing right.

    Its colour says how many cameras see enough of the test object there; what is not met has a cross. Points that
    several requirements share are drawn on top of each other, those not met last.
    """
    ghosts, body = result.ghosts, result.body
    outlines = [each.area.outlines_m(body) for each in ghosts.requirements]
    corner_m = np.concatenate([line for lines in outlines for line in lines] + [body.bounds_m])
    spacing = ghosts.of_each("grid_m")
    margin_m = 0.3 + 0.5 * float(spacing.max())
    low_m, high_m = corner_m.min(axis=0) - margin_m, corner_m.max(axis=0) + margin_m
    across, up = WIDTH_INCH - _LEFT_INCH - _RIGHT_INCH, _BELOW_INCH + _ABOVE_INCH
    height = float(np.clip(up + across * (high_m - low_m)[1] / (high_m - low_m)[0], 2.6, 9.0))
    ink = hex_colour(INK_RGB)
    with figure_style():
        figure = new_figure(WIDTH_INCH, height)
        figure.set_layout_engine("none")
        room = (_LEFT_INCH / WIDTH_INCH, _BELOW_INCH / height, across / WIDTH_INCH, 1.0 - up / height)
        axis = figure.add_axes(room)
        draw_vehicle(axis, ego)
        for lines in outlines:
            for line in lines:
                axis.plot(*np.vstack([line, line[:1]]).T, color=hex_colour(MUTED_RGB), linewidth=1.0, zorder=2)
        scale = _points_per_metre(figure, axis, low_m, high_m)
        size = np.clip(0.8 * spacing * scale, 2.5, 14.0) ** 2
        is_met, count = result.is_point_met, np.minimum(result.camera_count, 3)
        for k, rgb in enumerate(COVERAGE_RGB):
            for met, marker, order in ((True, "o", 3), (False, "X", 4)):
                shown = (count == k) & (is_met == met)
                if shown.any():
                    axis.scatter(
                        *ghosts.position_m[shown].T, s=size[shown], c=hex_colour(rgb), marker=marker,
                        edgecolors=ink, linewidths=0.3, zorder=order,
                    )  # fmt: skip
        draw_cameras(axis, rig, sector_radius_m=0.7)
        figure.legend(handles=_handles(), loc="lower center", ncols=6)
        share = float(is_met.mean())
        names = ", ".join(each.name for each in ghosts.requirements)
        title(axis, names if len(names) <= 60 else f"{len(ghosts.requirements)} requirements", f"{share:.1%} of points")
        axis.set(xlabel="x, forward [m]", ylabel="y, left [m]")
        axis.set_aspect("equal")
        return save_figure(figure, path)


def _points_per_metre(figure: Any, axis: Any, low: np.ndarray, high: np.ndarray) -> float:  # noqa: ANN401 (matplotlib)
    """Typographic points that a metre is wide, once the limits are a lowest and a highest corner [2]."""
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axis.set_aspect("equal")
    figure.draw_without_rendering()
    return float(72.0 / figure.dpi * axis.get_window_extent().width / (high[0] - low[0]))


def _handles() -> list[Any]:
    from matplotlib.lines import Line2D

    ink, grey = hex_colour(INK_RGB), hex_colour(MUTED_RGB)
    dot = {"linestyle": "", "markersize": 8, "markeredgecolor": ink, "markeredgewidth": 0.4}
    return [
        *(
            Line2D([], [], marker="o", color=hex_colour(rgb), label=text, **dot)
            for rgb, text in zip(COVERAGE_RGB, _COUNTS, strict=True)
        ),
        Line2D([], [], marker="X", color=grey, label="not met", **dot),
    ]
