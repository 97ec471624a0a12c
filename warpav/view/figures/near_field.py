"""The ground next to the vehicle: the first visible point, and what requirements ask to be seen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.sight.around import NearField
from warpav.sight.requirement import Body
from warpav.view.figures.plan import draw_surroundings, middle_of, panels_with_key, write_key
from warpav.view.figures.style import WIDTH_INCH, caption, figure_style, new_figure, save_figure, title
from warpav.view.figures.top_view import draw_cameras, draw_vehicle
from warpav.view.palette import COVERAGE_RGB, INK_RGB, MUTED_RGB, camera_rgb, hex_colour

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig
if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig
    from warpav.sight.check import RequirementResult

_RGB = (camera_rgb(0), camera_rgb(1), camera_rgb(3))
_RINGS_M = (0.5, 1.0, 2.0, 5.0, 10.0)
_SHORT_PT = 16.0
"""Shorter dimensions have bars at their ends: two heads would hide them."""
_ARROW: Any = {
    "arrowstyle": "<|-|>",
    "color": hex_colour(INK_RGB),
    "linewidth": 0.9,
    "shrinkA": 0,
    "shrinkB": 0,
    "mutation_scale": 7,
}
_SHORT_ARROW: Any = {**_ARROW, "arrowstyle": "|-|,widthA=0.4,widthB=0.4"}
_NAME_LETTERS = 17
"""Of a rig's name in the table."""
_SIDES = {"front": 0.0, "left": 90.0, "rear": 180.0, "right": 270.0}


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
    middle_m = middle_of(ego)
    length_m = 0.5 * float(np.ptp(np.asarray(ego.bounds_m()), axis=0)[:2].max())
    reach_m = max(float(np.linalg.norm(_line_m(field, 0) - middle_m, axis=1).max()) for field in fields.values())
    reach_m = max(1.14 * reach_m, length_m + 2.0)  # with room for the arrow to the front
    columns = min(2, len(rigs))
    with figure_style():
        lines = max(5, 1 + sum(len(field.heights_m) for field in fields.values()))
        figure, panels, key = panels_with_key(
            len(rigs), columns, panel_inch=4.65 if columns == 2 else 6.4, key_lines=lines
        )
        for axis, (name, field) in zip(panels, fields.items(), strict=True):
            draw_surroundings(axis, ego, rigs[name], reach_m=reach_m, ring_m=())
            _draw_rings(axis, ego, reach_m)
            for row, rgb in enumerate(_RGB[: len(field.heights_m)]):
                _draw_line(axis, field, row, hex_colour(rgb))
            title(axis, name if len(rigs) > 1 else "What is too near to be seen")
        handles = [
            Line2D([], [], color=hex_colour(rgb), label=f"{height_m:g} m{_meaning(height_m)}")
            for rgb, height_m in zip(_RGB, next(iter(fields.values())).heights_m, strict=False)
        ]
        handles.append(Line2D([], [], color="none", label=f"dotted: unseen up to {_reach(fields):g} m"))
        write_key(key, {"Within this line unseen, at a height of": handles})
        _write_table(key, fields, lines)
        caption(
            figure,
            "Rings: distance from the outline of the body, its hull with the mirrors. Dimensions: from there to the\n"
            "first visible ground, in directions from the middle of the vehicle. Farther out, ground may be unseen\n"
            "again: see the plan.",
        )
        if heading:
            figure.suptitle(heading, x=0.01, ha="left", fontweight="bold")
        figure.draw_without_rendering()  # texts are placed by what the layout leaves
        for axis, field in zip(panels, fields.values(), strict=True):
            _draw_dimensions(axis, field)
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


def _draw_rings(axis: Any, ego: Mesh, reach_m: float) -> None:  # noqa: ANN401 (matplotlib)
    """Lines at round distances from the outline of the body, as far as the panel reaches, and the outline itself."""
    footprint = Body.of(ego)
    room_m = reach_m - 0.5 * float(np.ptp(np.asarray(ego.bounds_m()), axis=0)[:2].max())
    grey, ink = hex_colour(MUTED_RGB), hex_colour(INK_RGB)
    paper = {"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.75}
    for distance_m in (0.0, *(each for each in _RINGS_M if 0.12 * room_m < each < room_m)):
        line_m = footprint.ring_m(distance_m)
        closed = np.vstack([line_m, line_m[:1]])
        axis.plot(*closed.T[::-1], color=grey, linewidth=0.6, linestyle=(0, (5, 3)), zorder=3.5)
        if distance_m > 0.0:
            x_m, y_m = line_m[5 * len(line_m) // 8]  # behind on the right, where rarely anything is written
            label = {"fontsize": 7, "color": ink, "ha": "center", "va": "center", "bbox": paper, "zorder": 8}
            axis.text(y_m, x_m, f"{distance_m:g} m", **label)


def _draw_dimensions(axis: Any, field: NearField) -> None:  # noqa: ANN401 (matplotlib)
    """Draw how far the unseen ground reaches from the outline; the figure has its final layout.

    What is written stands beyond the end of its line, clear of the vehicle and of all else that is written.
    """
    ink = hex_colour(INK_RGB)
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
    for k, word in places.items():
        if field.distance_m[0, k] < 0.005:
            continue
        ends = np.stack([field.border_m[k], line_m[k]])[:, ::-1]
        start_px, end_px = axis.transData.transform(ends)
        is_short = np.linalg.norm(end_px - start_px) < _SHORT_PT * per_pt
        axis.annotate("", ends[1], ends[0], arrowprops=_SHORT_ARROW if is_short else _ARROW, zorder=9)
        text = axis.annotate(
            f"{word}{_metres(field.distance_m[0, k], field.reach_m)} unseen",
            ends[1],
            xytext=(0.0, 0.0),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=8,
            fontweight="bold",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8, "alpha": 0.8},
            zorder=10,
        )
        text.set_in_layout(False)
        low_px, high_px = text.get_window_extent(renderer).extents.reshape(2, 2)
        half_px = 0.5 * (high_px - low_px) + 2.0 * per_pt
        middle_px = _free_place(start_px, end_px, half_px, taken, panel)
        taken.append(np.concatenate([middle_px - half_px, middle_px + half_px]))
        text.xyann = tuple((middle_px - end_px) / per_pt)
        near_px = np.clip(end_px, middle_px - half_px, middle_px + half_px)
        if np.linalg.norm(near_px - end_px) > 8.0 * per_pt and not _is_between(middle_px, start_px, end_px, half_px):
            place = axis.transData.inverted().transform(near_px)
            axis.plot(*np.stack([ends[1], place]).T, color=ink, linewidth=0.5, zorder=9)


def _free_place(
    start_px: np.ndarray, end_px: np.ndarray, half_px: np.ndarray, taken: Sequence[np.ndarray], panel: np.ndarray
) -> np.ndarray:
    """Middle of a text nearest to the end of its line [px], within the panel and clear of boxes that are taken.

    Beyond the end comes first; the middle of a line that ends at the border of the panel does as well.
    """
    outwards = (end_px - start_px) / max(float(np.linalg.norm(end_px - start_px)), 1e-9)
    aside = np.array([-outwards[1], outwards[0]])
    beyond = float(np.abs(outwards) @ half_px)
    step = 0.5 * half_px[1]
    tried = [
        end_px + (beyond + out * step) * outwards + sign * shift * step * aside
        for out in range(12)
        for shift in range(12)
        for sign in ((1.0, -1.0) if shift else (1.0,))
    ]
    tried.sort(key=lambda place: float(np.linalg.norm(place - end_px - beyond * outwards)))
    tried.append(0.5 * (start_px + end_px))
    for place in tried:
        low, high = place - half_px, place + half_px
        inside = (low >= panel[:2]).all() and (high <= panel[2:]).all()
        if inside and all((high <= box[:2]).any() or (low >= box[2:]).any() for box in taken):
            return np.asarray(place)
    return np.asarray(tried[-1])


def _is_between(place_px: np.ndarray, start_px: np.ndarray, end_px: np.ndarray, half_px: np.ndarray) -> bool:
    """Whether a text stands on its line."""
    return bool((np.abs(place_px - 0.5 * (start_px + end_px)) < half_px).all())


def _metres(distance_m: float, reach_m: float) -> str:
    return f"{distance_m:.2f} m" if math.isfinite(distance_m) else f"> {reach_m:g} m"


def _shortened(name: str) -> str:
    return name if len(name) <= _NAME_LETTERS else f"{name[: _NAME_LETTERS - 1]}…"


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
            where = ends.get(round(abs(turn_deg), 3), f"{abs(turn_deg):.0f}° {side}")
            label = _shortened(name) if row == 0 and len(fields) > 1 else ""
            rows.append([label, f"{height_m:g} m", *at, f"{_metres(distance_m[worst], field.reach_m)}, {where}"])
    table = axis.table(
        cellText=rows,
        colLabels=["", "height", *_SIDES, "worst, direction"],
        colWidths=[0.21, 0.1, 0.11, 0.11, 0.11, 0.11, 0.25] if len(fields) > 1 else [0.13, 0.1, *[0.13] * 4, 0.25],
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
