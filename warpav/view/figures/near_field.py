"""How far from the body of the vehicle the first visible point is, by direction and height, with dimensions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.evaluation.fitting import NearField
from warpav.view.figures.from_above import RINGS, draw_surroundings, middle_of, panels_with_key, write_key
from warpav.view.figures.style import caption, figure_style, title
from warpav.view.palette import INK_RGB, camera_rgb, hex_colour

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig

_RGB = (camera_rgb(0), camera_rgb(1), camera_rgb(3))
_SIDES = {"front": 0.0, "left": 90.0, "rear": 180.0, "right": 270.0}


def near_field_figure(rigs: Mapping[str, Rig], ego: Mesh, *, heading: str | None = None) -> Any:  # noqa: ANN401
    """Lines around the vehicle from which on outwards something begins to be seen, one panel for each rig.

    Along 240 directions from the middle of the vehicle, points 0, 0.6 and 1.1 m above level ground are looked at from
    the outline of the body (its convex hull from above) outwards, in steps of 5 cm and then by bisection: the first
    that is in some camera's image with no part of the own body before it (rays against the vehicle's mesh). Up to 10 m.
    Dimensions are written for the ground in front, behind, to the sides and where it is worst; the table has all
    heights.

    Args:
        rigs: By name, at least one.
        ego: The vehicle.
        heading: Above the figure; None: none.

    Returns:
        A ``matplotlib.figure.Figure``.
    """
    from matplotlib.lines import Line2D

    fields = {name: NearField.of(rig, ego) for name, rig in rigs.items()}
    middle_m = middle_of(ego)
    length_m = 0.5 * float(np.ptp(np.asarray(ego.bounds_m()), axis=0)[:2].max())
    reach_m = 1.0 + max(float(np.linalg.norm(_line_m(field, 0) - middle_m, axis=1).max()) for field in fields.values())
    reach_m = max(reach_m, length_m + 2.0)
    columns = min(2, len(rigs))
    with figure_style():
        lines = max(5, 1 + sum(len(field.heights_m) for field in fields.values()))
        figure, panels, key = panels_with_key(
            len(rigs), columns, panel_inch=4.65 if columns == 2 else 6.4, key_lines=lines
        )
        for axis, (name, field) in zip(panels, fields.items(), strict=True):
            draw_surroundings(axis, ego, rigs[name], reach_m=reach_m)
            for row, rgb in enumerate(_RGB[: len(field.heights_m)]):
                _draw_line(axis, field, row, hex_colour(rgb))
            _draw_dimensions(axis, field)
            title(axis, name if len(rigs) > 1 else "Where something begins to be seen")
        handles = [
            Line2D([], [], color=hex_colour(rgb), label=f"{height_m:g} m{_meaning(height_m)}")
            for rgb, height_m in zip(_RGB, next(iter(fields.values())).heights_m, strict=False)
        ]
        handles.append(Line2D([], [], color="none", label=f"dotted: not up to {_reach(fields):g} m"))
        write_key(key, {"First visible point, height above ground": handles})
        _write_table(key, fields, lines)
        caption(figure, f"{RINGS} Dimensions: distance from the body to the first visible ground.")
        if heading:
            figure.suptitle(heading, x=0.01, ha="left", fontweight="bold")
        return figure


def _meaning(height_m: float) -> str:
    return {0.0: ", the ground", 1.1: ", the top of a child's head"}.get(height_m, "")


def _reach(fields: Mapping[str, NearField]) -> float:
    return next(iter(fields.values())).reach_m


def _line_m(field: NearField, row: int) -> np.ndarray:
    """Where the first visible points of a height are, x and y [m], float64 [direction, 2]; at most ``reach_m`` out."""
    outwards = np.stack([np.cos(field.azimuth_rad), np.sin(field.azimuth_rad)], axis=-1)
    return field.border_m + np.minimum(field.distance_m[row], field.reach_m)[:, None] * outwards


def _draw_line(axis: Any, field: NearField, row: int, colour: str) -> None:  # noqa: ANN401 (matplotlib)
    line_m = _line_m(field, row)
    closed = np.vstack([line_m, line_m[:1]])
    is_open = np.isinf(field.distance_m[row])
    # jumps between open directions and others are drawn as well
    is_open &= np.roll(is_open, 1) & np.roll(is_open, -1)
    is_open = np.append(is_open, is_open[0])
    axis.fill(*line_m.T[::-1], color=colour, alpha=0.10, linewidth=0, zorder=2)
    for style, hidden in (("-", is_open), (":", ~is_open)):
        shown = np.where(hidden[:, None], np.nan, closed)
        axis.plot(*shown.T[::-1], color=colour, linewidth=1.6, linestyle=style, zorder=4)


def _draw_dimensions(axis: Any, field: NearField) -> None:  # noqa: ANN401 (matplotlib)
    ink = hex_colour(INK_RGB)
    line_m = _line_m(field, 0)
    worst = field.worst()
    places = {field.toward(azimuth_deg): "" for azimuth_deg in _SIDES.values()}
    if field.distance_m[0, worst] > max(field.distance_m[0, k] for k in places):  # of equal ones, the side says it
        places[worst] = "worst "
    for k, word in places.items():
        if field.distance_m[0, k] < 0.005:
            continue
        start, end = field.border_m[k][::-1], line_m[k][::-1]
        arrow = {"arrowstyle": "<|-|>", "color": ink, "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 7}
        axis.annotate("", end, start, arrowprops=arrow, zorder=9)
        outwards = np.array([math.sin(field.azimuth_rad[k]), math.cos(field.azimuth_rad[k])])
        axis.annotate(
            f"{word}{_metres(field.distance_m[0, k], field.reach_m)}",
            0.5 * (start + end),
            xytext=(9.0 * outwards[1] * (1 if outwards[0] >= 0 else -1), 7.0 * abs(outwards[0])),
            textcoords="offset points",
            ha="left" if abs(outwards[1]) > 0.5 else "center",
            va="center" if abs(outwards[1]) > 0.5 else "bottom",
            fontsize=8,
            fontweight="bold",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8, "alpha": 0.8},
            zorder=10,
        )


def _metres(distance_m: float, reach_m: float) -> str:
    return f"{distance_m:.2f} m" if math.isfinite(distance_m) else f"> {reach_m:g} m"


def _write_table(axis: Any, fields: Mapping[str, NearField], lines: int) -> None:  # noqa: ANN401 (matplotlib)
    """Distances of all heights at the sides, at the worst direction of each, and in the mean, beside the key."""
    rows = []
    for name, field in fields.items():
        for row, height_m in enumerate(field.heights_m):
            distance_m = field.distance_m[row]
            at = [_metres(distance_m[field.toward(azimuth_deg)], field.reach_m) for azimuth_deg in _SIDES.values()]
            worst = field.worst(row)
            turn_deg = math.degrees(math.remainder(field.azimuth_rad[worst], 2.0 * math.pi))
            side = "left" if turn_deg > 0.0 else "right"
            ends = {0.0: "ahead", 180.0: "behind"}
            where = ends.get(abs(turn_deg), f"{abs(turn_deg):.0f}° {side}")
            label = name if row == 0 and len(fields) > 1 else ""
            rows.append([label, f"{height_m:g} m", *at, f"{_metres(distance_m[worst], field.reach_m)}, {where}"])
    table = axis.table(
        cellText=rows,
        colLabels=["", "height", *_SIDES, "worst, direction"],
        colWidths=[0.13, 0.1, 0.13, 0.13, 0.13, 0.13, 0.25],
        cellLoc="left",
        colLoc="left",
        edges="open",
        bbox=(0.36, 1.0 - (len(rows) + 1) / lines, 0.64, (len(rows) + 1) / lines),
    )
    table.auto_set_font_size(False)
    table.set_fontsize(8)
    for (row, _), cell in table.get_celld().items():
        if row == 0:
            cell.get_text().set_fontweight("bold")
