"""The ground next to the vehicle: the first visible point, and what requirements ask to be seen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.sight.around import NearField
from warpav.sight.requirement import Body
from warpav.view.figures.from_above import (
    RING,
    draw_cameras,
    draw_surroundings,
    draw_vehicle,
    half_length_m,
    middle_of,
    panels_with_key,
    write_distance,
    write_key,
)
from warpav.view.figures.style import (
    WIDTH_INCH,
    closed,
    figure_style,
    metre_axes,
    new_figure,
    paper,
    save_figure,
    title,
)
from warpav.view.palette import COVERAGE_RGB, INK_RGB, MUTED_RGB, camera_rgb, hex_colour

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig
    from warpav.sight.check import RequirementResult

_RGB = (camera_rgb(0), camera_rgb(1), camera_rgb(3))
_RINGS_M = (0.5, 1.0, 2.0, 5.0, 10.0)
_SHORT_PT = 16.0
"""Shorter dimensions have bars at their ends: two heads would hide them."""
_ARROW: Any = {"color": hex_colour(INK_RGB), "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 7}
_NAME_LETTERS = 17
"""Of a rig's name in the table."""
_SIDES = {"front": 0.0, "left": 90.0, "rear": 180.0, "right": 270.0}
_MEANINGS = {0.0: ", the ground", 1.1: ", the top of a child's head"}
_TEXT = """Rings: distance from the outline of the body, its hull with the mirrors. Dimensions: from there to the
first visible ground, in directions from the middle of the vehicle. Farther out, ground may be unseen
again: see the plan."""


def near_field_figure(rigs: Mapping[str, Rig], ego: Mesh, *, heading: str | None = None) -> Any:  # noqa: ANN401
    """Lines around the vehicle from which on outwards something begins to be seen, one panel for each rig.

    Along 240 directions from the middle of the vehicle, points 0, 0.6 and 1.1 m above level ground are looked at from
    the outline of the body (its convex hull from above) outwards, in steps of 5 cm and then by bisection: the first
    that is in some camera's image with no part of the own body before it (rays against the vehicle's mesh). Up to 10 m.
    Dimensions are written for the unseen ground in front, behind, to the sides and where it is worst; the table has all
    heights. Rings are at distances from the outline, too.
    """
    from matplotlib.lines import Line2D

    fields = {name: NearField.of(rig, ego) for name, rig in rigs.items()}
    first, middle_m = next(iter(fields.values())), middle_of(ego)
    reach_m = max(float(np.linalg.norm(_line_m(field, 0) - middle_m, axis=1).max()) for field in fields.values())
    reach_m = max(1.14 * reach_m, half_length_m(ego) + 2.0)  # with room for the arrow to the front
    columns, lines = min(2, len(rigs)), max(5, 1 + sum(len(field.heights_m) for field in fields.values()))
    size: Any = {"panel_inch": 4.65 if columns == 2 else 6.4, "key_lines": lines, "text": _TEXT, "heading": heading}
    with panels_with_key(len(rigs), columns, **size) as (_, panels, key):
        for axis, (name, field) in zip(panels, fields.items(), strict=True):
            draw_surroundings(axis, ego, rigs[name], reach_m=reach_m, has_rings=False)
            _draw_rings(axis, ego, reach_m)
            for row, rgb in enumerate(_RGB[: len(field.heights_m)]):
                _draw_line(axis, field, row, hex_colour(rgb))
            title(axis, name if len(rigs) > 1 else "What is too near to be seen")
        handles = [
            Line2D([], [], color=hex_colour(rgb), label=f"{height_m:g} m{_MEANINGS.get(height_m, '')}")
            for rgb, height_m in zip(_RGB, first.heights_m, strict=False)
        ]
        handles.append(Line2D([], [], color="none", label=f"dotted: unseen up to {first.reach_m:g} m"))
        write_key(key, {"Within this line unseen, at a height of": handles})
        _write_table(key, fields, lines)
    figure = key.figure
    with figure_style():
        figure.draw_without_rendering()  # texts are placed by what the layout leaves
        for axis, field in zip(panels, fields.values(), strict=True):
            _draw_dimensions(axis, field)
    return figure


def _line_m(field: NearField, row: int) -> np.ndarray:
    """Where the first visible points of a height are, x and y [m], float64 [direction, 2]; at most ``reach_m`` out."""
    outwards = np.stack([np.cos(field.azimuth_rad), np.sin(field.azimuth_rad)], axis=-1)
    return field.border_m + np.minimum(field.distance_m[row], field.reach_m)[:, None] * outwards


def _draw_line(axis: Any, field: NearField, row: int, colour: str) -> None:  # noqa: ANN401 (matplotlib)
    line_m = _line_m(field, row)
    is_open = np.isinf(field.distance_m[row])
    # jumps between open directions and others are drawn as well
    is_open &= np.roll(is_open, 1) & np.roll(is_open, -1)
    is_open = np.append(is_open, is_open[0])
    axis.fill(*line_m.T[::-1], color=colour, alpha=0.10, linewidth=0, zorder=2)
    for style, hidden in (("-", is_open), (":", ~is_open)):
        shown = np.where(hidden[:, None], np.nan, closed(line_m))
        axis.plot(*shown.T[::-1], color=colour, linewidth=1.6, linestyle=style, zorder=4)


def _draw_rings(axis: Any, ego: Mesh, reach_m: float) -> None:  # noqa: ANN401 (matplotlib)
    """Lines at round distances from the outline of the body, as far as the panel reaches, and the outline itself."""
    footprint, room_m = Body.of(ego), reach_m - half_length_m(ego)
    for distance_m in (0.0, *(each for each in _RINGS_M if 0.12 * room_m < each < room_m)):
        line_m = footprint.ring_m(distance_m)
        axis.fill(*line_m.T[::-1], **RING, zorder=3.5)
        if distance_m > 0.0:  # behind on the right, where rarely anything is written
            write_distance(axis, line_m[5 * len(line_m) // 8][::-1], distance_m)


def _draw_dimensions(axis: Any, field: NearField) -> None:  # noqa: ANN401 (matplotlib)
    """Draw how far the unseen ground reaches from the outline; the figure has its final layout.

    What is written stands beyond the end of its line, clear of the vehicle and of all else that is written.
    """
    per_pt = axis.figure.dpi / 72.0
    line_m = _line_m(field, 0)
    worst = field.worst()
    places = {field.toward(azimuth_deg): "" for azimuth_deg in _SIDES.values()}
    if field.distance_m[0, worst] > max(field.distance_m[0, k] for k in places):  # of equal ones, the side says it
        places[worst] = "worst "
    renderer = axis.figure.canvas.get_renderer()
    taken = [text.get_window_extent(renderer).extents for text in axis.texts]
    body_px = axis.transData.transform(field.border_m[:, ::-1])
    taken.append(np.concatenate([body_px.min(axis=0), body_px.max(axis=0)]))
    panel = axis.get_window_extent(renderer).extents
    bold = {"ha": "center", "va": "center", "fontsize": 8, "fontweight": "bold", "bbox": paper(0.8, 0.8), "zorder": 10}
    for k, word in places.items():
        if field.distance_m[0, k] < 0.005:
            continue
        ends = np.stack([field.border_m[k], line_m[k]])[:, ::-1]
        start_px, end_px = axis.transData.transform(ends)
        is_short = np.linalg.norm(end_px - start_px) < _SHORT_PT * per_pt
        heads = "|-|,widthA=0.4,widthB=0.4" if is_short else "<|-|>"
        axis.annotate("", ends[1], ends[0], arrowprops={**_ARROW, "arrowstyle": heads}, zorder=9)
        said = f"{word}{_metres(field.distance_m[0, k], field.reach_m)} unseen"
        text = axis.annotate(said, ends[1], xytext=(0.0, 0.0), textcoords="offset points", **bold)
        text.set_in_layout(False)
        low_px, high_px = text.get_window_extent(renderer).extents.reshape(2, 2)
        half_px = 0.5 * (high_px - low_px) + 2.0 * per_pt
        middle_px = _free_place(start_px, end_px, half_px, taken, panel)
        taken.append(np.concatenate([middle_px - half_px, middle_px + half_px]))
        text.xyann = tuple((middle_px - end_px) / per_pt)
        near_px = np.clip(end_px, middle_px - half_px, middle_px + half_px)
        is_on_line = (np.abs(middle_px - 0.5 * (start_px + end_px)) < half_px).all()
        if np.linalg.norm(near_px - end_px) > 8.0 * per_pt and not is_on_line:
            place = axis.transData.inverted().transform(near_px)
            axis.plot(*np.stack([ends[1], place]).T, color=hex_colour(INK_RGB), linewidth=0.5, zorder=9)


def _free_place(
    start_px: np.ndarray, end_px: np.ndarray, half_px: np.ndarray, taken: Sequence[np.ndarray], panel: np.ndarray
) -> np.ndarray:
    """Middle of a text nearest to the end of its line [px], within the panel and clear of boxes that are taken.

    Beyond the end comes first; the middle of a line that ends at the border of the panel does as well.
    """
    outwards = (end_px - start_px) / max(float(np.linalg.norm(end_px - start_px)), 1e-9)
    aside = np.array([-outwards[1], outwards[0]])
    usual = end_px + float(np.abs(outwards) @ half_px) * outwards
    step = 0.5 * half_px[1]
    out, shift = np.meshgrid(np.arange(12), np.arange(-11, 12), indexing="ij")
    tried = usual + step * (out.reshape(-1, 1) * outwards + shift.reshape(-1, 1) * aside)
    tried = tried[np.argsort(np.linalg.norm(tried - usual, axis=1).round(6), kind="stable")]
    for place in (*tried, 0.5 * (start_px + end_px)):
        low, high = place - half_px, place + half_px
        inside = (low >= panel[:2]).all() and (high <= panel[2:]).all()
        if inside and all((high <= box[:2]).any() or (low >= box[2:]).any() for box in taken):
            return np.asarray(place)
    return 0.5 * (start_px + end_px)


def _metres(distance_m: float, reach_m: float) -> str:
    return f"{distance_m:.2f} m" if math.isfinite(distance_m) else f"> {reach_m:g} m"


def _write_table(axis: Any, fields: Mapping[str, NearField], lines: int) -> None:  # noqa: ANN401 (matplotlib)
    """Distances of all heights at the sides, at the worst direction of each, and in the mean, beside the key."""
    rows = []
    for name, field in fields.items():
        short = name if len(name) <= _NAME_LETTERS else f"{name[: _NAME_LETTERS - 1]}…"
        for row, height_m in enumerate(field.heights_m):
            distance_m, worst = field.distance_m[row], field.worst(row)
            at = [_metres(distance_m[field.toward(azimuth_deg)], field.reach_m) for azimuth_deg in _SIDES.values()]
            turn_deg = math.degrees(math.remainder(field.azimuth_rad[worst], 2.0 * math.pi))
            side = f"{abs(turn_deg):.0f}° {'left' if turn_deg > 0.0 else 'right'}"
            where = {0.0: "ahead", 180.0: "behind"}.get(round(abs(turn_deg), 3), side)
            label = short if row == 0 and len(fields) > 1 else ""
            rows.append([label, f"{height_m:g} m", *at, f"{_metres(distance_m[worst], field.reach_m)}, {where}"])
    widths = [0.21, 0.1, 0.11, 0.11, 0.11, 0.11, 0.25] if len(fields) > 1 else [0.13, 0.1, *[0.13] * 4, 0.25]
    high = (len(rows) + 1) / lines
    style = {"cellLoc": "left", "colLoc": "left", "edges": "open", "bbox": (0.36, 1.0 - high, 0.64, high)}
    heads = ["", "height", *_SIDES, "worst, direction"]
    table = axis.table(cellText=rows, colLabels=heads, colWidths=widths, **style)
    table.auto_set_font_size(False)
    table.set_fontsize(8)
    for (row, _), cell in table.get_celld().items():
        if row == 0:
            cell.get_text().set_fontweight("bold")


_LEFT_INCH, _RIGHT_INCH, _BELOW_INCH, _ABOVE_INCH = 0.7, 0.15, 0.95, 0.42
"""Around the panel, for labels, the key and the title."""

_COUNTS = ("no camera", "1 camera", "2 cameras", "3 or more")


def requirement_map(path: Path | str, *, result: RequirementResult, rig: Rig, ego: Mesh) -> Path:
    """Draw every point of the requirements from above, x pointing right.

    Its colour says how many cameras see enough of the test object there; what is not met has a cross. Points that
    several requirements share are drawn on top of each other, those not met last.
    """
    from matplotlib.lines import Line2D

    ghosts, body = result.ghosts, result.body
    outlines = [line for each in ghosts.requirements for line in each.area.outlines_m(body)]
    corner_m, spacing = np.concatenate([*outlines, body.bounds_m]), ghosts.of_each("grid_m")
    margin_m = 0.3 + 0.5 * float(spacing.max())
    low_m, high_m = corner_m.min(axis=0) - margin_m, corner_m.max(axis=0) + margin_m
    across, up = WIDTH_INCH - _LEFT_INCH - _RIGHT_INCH, _BELOW_INCH + _ABOVE_INCH
    height = float(np.clip(up + across * (high_m - low_m)[1] / (high_m - low_m)[0], 2.6, 9.0))
    ink, grey = hex_colour(INK_RGB), hex_colour(MUTED_RGB)
    with figure_style():
        figure = new_figure(WIDTH_INCH, height)
        figure.set_layout_engine("none")
        room = (_LEFT_INCH / WIDTH_INCH, _BELOW_INCH / height, across / WIDTH_INCH, 1.0 - up / height)
        axis = figure.add_axes(room)
        draw_vehicle(axis, ego)
        for line in outlines:
            axis.plot(*closed(line).T, color=grey, linewidth=1.0, zorder=2)
        axis.set(xlim=(low_m[0], high_m[0]), ylim=(low_m[1], high_m[1]))
        metre_axes(axis)
        figure.draw_without_rendering()
        pt_per_m = 72.0 / figure.dpi * axis.get_window_extent().width / (high_m[0] - low_m[0])
        size = np.clip(0.8 * spacing * pt_per_m, 2.5, 14.0) ** 2
        is_met, count = result.is_point_met, np.minimum(result.camera_count, 3)
        for k, rgb in enumerate(COVERAGE_RGB):
            for met, marker, order in ((True, "o", 3), (False, "X", 4)):
                shown = (count == k) & (is_met == met)
                if shown.any():
                    style = {"marker": marker, "edgecolors": ink, "linewidths": 0.3, "zorder": order}
                    axis.scatter(*ghosts.position_m[shown].T, s=size[shown], c=hex_colour(rgb), **style)
        draw_cameras(axis, rig, sector_radius_m=0.7)
        dot = {"linestyle": "", "markersize": 8, "markeredgecolor": ink, "markeredgewidth": 0.4}
        named = zip(_COUNTS, COVERAGE_RGB, strict=True)
        handles = [Line2D([], [], marker="o", color=hex_colour(rgb), label=text, **dot) for text, rgb in named]
        handles.append(Line2D([], [], marker="X", color=grey, label="not met", **dot))
        figure.legend(handles=handles, loc="lower center", ncols=6)
        names = ", ".join(each.name for each in ghosts.requirements)
        names = names if len(names) <= 60 else f"{len(ghosts.requirements)} requirements"
        title(axis, names, f"{float(is_met.mean()):.1%} of points")
        return save_figure(figure, path)
