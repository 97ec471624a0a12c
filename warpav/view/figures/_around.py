"""What is seen around the vehicle: the first visible ground, requirements, how far road users are detected, sectors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.detection import DetectionProbability
from warpav.optimisation import LEAST_HEIGHT_PX, DetectionRange
from warpav.sight import CAR_HEIGHT_M, PIXELS, Body, NearField, SectorCounts
from warpav.view._labels import Labels
from warpav.view._palette import COVERAGE_RGB, COVERAGE_WORDS, FURTHER_RGB, INK_RGB, MUTED_RGB, camera_rgb, hex_colour
from warpav.view.figures._from_above import (
    RING,
    RINGS,
    draw_cameras,
    draw_surroundings,
    draw_vehicle,
    half_length_m,
    middle_of,
    panels_with_key,
    ring_radii_m,
    write_distance,
    write_key,
)
from warpav.view.figures._style import (
    WIDTH_INCH,
    closed,
    figure_style,
    mark_cameras,
    metre_axes,
    new_figure,
    paper,
    save_figure,
    title,
)

if TYPE_CHECKING:
    from warpav.raster.camera import CameraModel
    from warpav.raster.mesh import Mesh
    from warpav.rig import Rig
    from warpav.sight import RequirementResult

_RGB = FURTHER_RGB[:0:-1]
"""Of heights: no colours of cameras, which are drawn as well."""
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
again: see the picture of the ground."""


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
            draw_surroundings(axis, ego, reach_m=reach_m, has_rings=False)
            _draw_rings(axis, ego, reach_m)
            mark_cameras(axis, rigs[name].cameras)
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
    body_px = axis.transData.transform(field.border_m[:, ::-1])
    panel_px = axis.get_window_extent(renderer).extents
    labels = Labels([*body_px.min(axis=0), *body_px.max(axis=0)], within=panel_px)
    labels.take([text.get_window_extent(renderer).extents for text in axis.texts])
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
        tried_px = _beyond_end(start_px, end_px, 2.0 * half_px).clip(
            panel_px[:2] + half_px + 1.0, panel_px[2:] - half_px - 1.0
        )
        middle_px = tried_px[labels.put(tried_px, 2.0 * half_px)]
        text.xyann = tuple((middle_px - end_px) / per_pt)
        near_px = np.clip(end_px, middle_px - half_px, middle_px + half_px)
        is_on_line = (np.abs(middle_px - 0.5 * (start_px + end_px)) < half_px).all()
        if np.linalg.norm(near_px - end_px) > 8.0 * per_pt and not is_on_line:
            place = axis.transData.inverted().transform(near_px)
            axis.plot(*np.stack([ends[1], place]).T, color=hex_colour(INK_RGB), linewidth=0.5, zorder=9)


def _beyond_end(start_px: np.ndarray, end_px: np.ndarray, size_px: np.ndarray) -> np.ndarray:
    """Places for a text of a size at a line [px], the best first, [place, 2]: beyond its end; its middle comes last."""
    outwards = (end_px - start_px) / max(float(np.linalg.norm(end_px - start_px)), 1e-9)
    aside = np.array([-outwards[1], outwards[0]])
    out, shift = np.meshgrid(np.arange(12), np.arange(-11, 12), indexing="ij")
    step = 0.25 * size_px[1] * (out.reshape(-1, 1) * outwards + shift.reshape(-1, 1) * aside)
    step = step[np.argsort(np.linalg.norm(step, axis=1).round(6), kind="stable")]
    usual = end_px + 0.5 * float(np.abs(outwards) @ size_px) * outwards
    return np.vstack([usual + step, 0.5 * (start_px + end_px)])


def _metres(distance_m: float, reach_m: float) -> str:
    return f"{distance_m:.2f} m" if math.isfinite(distance_m) else f"> {reach_m:g} m"


def _write_table(axis: Any, fields: Mapping[str, NearField], lines: int) -> None:  # noqa: ANN401 (matplotlib)
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
    widths = [0.19, 0.1, 0.115, 0.115, 0.115, 0.115, 0.25] if len(fields) > 1 else [0.13, 0.1, *[0.13] * 4, 0.25]
    high = (len(rows) + 1) / lines
    style = {"cellLoc": "left", "colLoc": "left", "edges": "open", "bbox": (0.36, 1.0 - high, 0.64, high)}
    heads = ["", "height", *_SIDES, "worst, direction"]
    table = axis.table(cellText=rows, colLabels=heads, colWidths=widths, **style)
    table.auto_set_font_size(False)
    table.set_fontsize(8)
    for (row, _), cell in table.get_celld().items():
        if row == 0:
            cell.get_text().set_fontweight("bold")


def requirement_map(path: Path | str, *, result: RequirementResult, rig: Rig, ego: Mesh) -> Path:
    """Draw every point of the requirements from above, the front up.

    Its colour says how many cameras see enough of the test object there; what is not met has a cross. Points that
    several requirements share are drawn on top of each other, those not met last.
    """
    from matplotlib.lines import Line2D

    ghosts, body = result.ghosts, result.body
    outlines = [line for each in ghosts.requirements for line in each.area.outlines_m(body)]
    corner_m, spacing = np.concatenate([*outlines, body.bounds_m]), ghosts.of_each("grid_m")
    margin_m = 0.3 + 0.5 * float(spacing.max())
    low_m, high_m = corner_m.min(axis=0) - margin_m, corner_m.max(axis=0) + margin_m
    length_m, width_m = high_m - low_m
    ink, grey = hex_colour(INK_RGB), hex_colour(MUTED_RGB)
    with figure_style():
        figure = new_figure(WIDTH_INCH, float(np.clip(1.4 + 8.0 * length_m / width_m, 2.6, 11.0)))
        axis = figure.subplots()
        draw_vehicle(axis, ego)
        for line in outlines:
            axis.plot(*closed(line).T[::-1], color=grey, linewidth=1.0, zorder=2)
        axis.set(xlim=(low_m[1], high_m[1]), ylim=(low_m[0], high_m[0]))
        metre_axes(axis)
        figure.draw_without_rendering()
        pt_per_m = 72.0 / figure.dpi * axis.get_window_extent().width / width_m
        size = np.clip(0.8 * spacing * pt_per_m, 2.5, 14.0) ** 2
        is_met, count = result.is_point_met, np.minimum(result.camera_count, 3)
        for k, rgb in enumerate(COVERAGE_RGB):
            for met, marker, order in ((True, "o", 3), (False, "X", 4)):
                shown = (count == k) & (is_met == met)
                if shown.any():
                    style = {"marker": marker, "edgecolors": ink, "linewidths": 0.3, "zorder": order}
                    axis.scatter(*ghosts.position_m[shown, 1::-1].T, s=size[shown], c=hex_colour(rgb), **style)
        draw_cameras(axis, rig, sector_radius_m=0.7)
        mark_cameras(axis, rig.cameras)
        dot = {"linestyle": "", "markersize": 8, "markeredgecolor": ink, "markeredgewidth": 0.4}
        named = zip(COVERAGE_WORDS, COVERAGE_RGB, strict=True)
        handles = [Line2D([], [], marker="o", color=hex_colour(rgb), label=text, **dot) for text, rgb in named]
        handles.append(Line2D([], [], marker="X", color=grey, label="not met", **dot))
        figure.legend(handles=handles, loc="outside lower center", ncols=6)
        figure.get_layout_engine().set(h_pad=0.1, rect=(0.0, 0.0, 1.0, 0.99))
        names = ", ".join(each.name for each in ghosts.requirements)
        names = names if len(names) <= 60 else f"{len(ghosts.requirements)} requirements"
        title(axis, names, f"{float(is_met.mean()):.1%} of points")
        return save_figure(figure, path)


# ------------------------------------------------------------------------------------------------- by direction

_LEVELS = {0.5: "-", 0.9: (0, (4, 1.5))}
_MARKERS = "os^Dv"
"""Of lines in their order; beyond the last they begin again."""
_MARK_EVERY = 9
"""Directions from mark to mark: those of lines after each other are between each other's."""
_TICK_EVERY = 2
"""Directions from tick to tick where a line ends at the limit of the model."""
_TICK = 0.022
"""Length of a tick over the radius of the panel."""
_TITLE_PAD_PT = 14.0
"""From a title to the panel: the name of the front is between them."""
_LEAST_GAP = 0.07
"""Between the outermost ring whose distance is written and the border, over the radius of the panel."""
_RING_AZIMUTH_RAD = math.radians(202.5)
"""Where distances of rings are written."""
_DIRECTIONS = ["front", "45°", "left", "135°", "rear", "-135°", "right", "-45°"]


def range_figure(
    rigs: Mapping[str, Rig],
    ego: Mesh,
    *,
    probability: Callable[[CameraModel], DetectionProbability] | None = None,
    heading: str | None = None,
) -> Any:  # noqa: ANN401 (matplotlib)
    """Distances up to which an unoccluded road user is found with a probability of .5 and of .9 by the best camera.

    The probability is that of the fitted model (`warpav.detection._probability`), from what a render shows of the road
    user alone: area, shape, distance from the image's border. It heads as the own vehicle does, has the contrast of an
    average object, and stands every 5 degrees at 18 distances from 5 to 500 m; see
    `detection_range`. Lines end where the image becomes smaller than the model speaks for
    (`DetectionRange.limit_m`) and have ticks outwards there: the road user is found up to there, and nothing is known
    of what is farther. The model knows neither haze nor blur: it says what the detector makes of so many clean pixels.
    """
    from matplotlib.lines import Line2D

    model_of = DetectionProbability.builtin if probability is None else probability
    found = {name: DetectionRange.of(rig, ego, probability=model_of) for name, rig in rigs.items()}
    first, is_one = next(iter(found.values())), len(rigs) == 1
    panels_of = [list(enumerate(first.categories))] if is_one else [[each] for each in enumerate(first.categories)]
    names = first.categories if is_one else list(rigs)
    limits_m = {name: each.limit_m() for name, each in found.items()}
    reach_m = max(float(np.minimum(each.range_m(0.5), limits_m[name]).max()) for name, each in found.items())
    reach_m = min(1.08 * max(reach_m, first.distances_m[0]), 1.02 * first.distances_m[-1])
    text = (
        f"From the middle of the vehicle, up to {first.distances_m[-1]:g} m. Nothing hides the road user. Fitted "
        f"model, best camera.\nIt speaks for images at least {LEAST_HEIGHT_PX:g} px high in the detector's input.\n"
        "Distances follow from sizes of images, not from tests at these distances."
    )
    size: Any = {"panel_inch": 6.2 if is_one else 3.4, "key_lines": 1 + max(len(names), 3), "projection": "polar"}
    columns = min(3, len(panels_of))
    with panels_with_key(len(panels_of), columns, **size, text=text, heading=heading) as (figure, panels, key):
        for axis, shown in zip(panels, panels_of, strict=True):
            _prepare(axis, reach_m, is_large=is_one)
            for index, (row, _) in enumerate(shown):
                for number, (name, each) in enumerate(found.items()):
                    ranges_m = {least: each.range_m(least)[row] for least in _LEVELS}
                    place = index if is_one else number
                    _draw_ranges(axis, first.azimuth_rad, ranges_m, limits_m[name][row], place, _TICK * reach_m)
            if not is_one:
                axis.set_title(shown[0][1], pad=_TITLE_PAD_PT)
        lines = [Line2D([], [], label=each, **_mark(k)) for k, each in enumerate(names)]
        ink, words = hex_colour(INK_RGB), "detected with a probability of at least"
        levels = [Line2D([], [], color=ink, linestyle=style, label=f"{words} {k:g}") for k, style in _LEVELS.items()]
        limit = f"at least so far (both): beyond the ticks, its image is less than {LEAST_HEIGHT_PX:g} px high"
        levels.append(Line2D([], [], color=ink, marker=2, markersize=5, label=limit))
        write_key(key, {"Road user" if is_one else "Rig": lines, "Up to this distance": levels}, widths=(1, 2))
        figure.get_layout_engine().set(w_pad=0.1)  # names of directions beside each other
    return figure


def _mark(place: int) -> dict[str, Any]:
    style = {"markersize": 5, "markeredgecolor": "white", "markeredgewidth": 0.6}
    return {"color": hex_colour(camera_rgb(place)), "marker": _MARKERS[place % len(_MARKERS)], **style}


def _draw_ranges(
    axis: Any,  # noqa: ANN401 (matplotlib)
    azimuth_rad: np.ndarray,
    ranges_m: Mapping[float, np.ndarray],
    limit_m: np.ndarray,
    place: int,
    tick_m: float,
) -> None:
    """Draw ranges by azimuth, one for each of `_LEVELS`, with marks by which they are known without their colour.

    Where one ends at the limit of the model it is whole, whatever its style elsewhere, and the widest has ticks there.
    """
    colour = hex_colour(camera_rgb(place))
    at = np.arange((2 * place) % _MARK_EVERY, len(azimuth_rad), _MARK_EVERY)
    for least, range_m in ranges_m.items():
        line_m, is_cut = np.minimum(range_m, limit_m), (range_m >= limit_m - 1e-6) & (limit_m > 0.0)
        # between a cut and an uncut direction the line belongs to the range
        is_range = ~is_cut | np.roll(~is_cut, 1) | np.roll(~is_cut, -1)
        for shown, dashes in ((is_range, _LEVELS[least]), (is_cut, "-")):
            part_m = np.where(shown, line_m, np.nan)
            turn_rad = np.append(azimuth_rad, 2.0 * np.pi)
            axis.plot(turn_rad, np.append(part_m, part_m[0]), color=colour, linestyle=dashes, linewidth=1.5)
        if least == min(ranges_m):
            cut = np.flatnonzero(is_cut)
            cut = cut[cut % _TICK_EVERY == 0]
            ends_m = np.stack([limit_m[cut], limit_m[cut] + tick_m, np.full(len(cut), np.nan)], axis=1)
            axis.plot(np.repeat(azimuth_rad[cut], 3), ends_m.ravel(), color=colour, linewidth=0.9)
        marked = at[line_m[at] > 0.0]
        axis.plot(azimuth_rad[marked], line_m[marked], linestyle="none", zorder=2.5, **_mark(place))


def _prepare(axis: Any, reach_m: float, *, is_large: bool) -> None:  # noqa: ANN401 (matplotlib)
    axis.set_theta_zero_location("N")
    axis.set_thetagrids(range(0, 360, 45), _DIRECTIONS, fontsize=8)
    ring_m = ring_radii_m(reach_m)
    axis.set_rgrids(ring_m, [""] * len(ring_m))
    axis.set_ylim(0.0, reach_m)
    # as many as there is room for: the innermost is among the lines, the outermost beside the names of directions
    step = 1 if is_large else 2
    for each in ring_m[step - 1 :: step]:
        if each < (1.0 - _LEAST_GAP) * reach_m:
            write_distance(axis, (_RING_AZIMUTH_RAD, each), each, bbox=paper(0.5, 0.5), zorder=3)


_SECTOR_SHARE = 0.5


def redundancy_figure(rigs: Mapping[str, Rig], ego: Mesh, *, heading: str | None = None) -> Any:  # noqa: ANN401
    """Cells of 10 degrees and distance bands by how many cameras see a road user there; one row for each rig.

    On the left the whole rig, on the right the rig without the camera whose loss leaves most ground, by area, to no
    camera. A camera sees a road user in the middle of a cell where the point 0.75 m above level ground is in its image,
    the own body does not stand before it (a ray against the vehicle's mesh), and the image of a car there, 1.5 m high,
    is at least 12 px high through the lens. Bands are drawn up to the last that is seen in half of the directions of
    the one that is seen in most: one narrow camera that sees far does not make the others small.
    """
    from matplotlib.patches import Patch

    counts_of = {name: SectorCounts.of(rig, ego) for name, rig in rigs.items()}
    sectors = np.max([counts.sees.any(axis=0).sum(axis=0) for counts in counts_of.values()], axis=0)
    bands = int(np.flatnonzero(sectors >= _SECTOR_SHARE * sectors.max())[-1]) + 1
    text = f"{RINGS} Level ground, nothing but the own body in the way."
    size: Any = {"panel_inch": 4.65, "key_lines": 5, "text": text, "heading": heading}
    with panels_with_key(2 * len(rigs), 2, **size) as (figure, panels, key):
        for name, whole, less in zip(rigs, panels[::2], panels[1::2], strict=True):
            counts, beyond = counts_of[name].within(bands), _beyond(counts_of[name], bands)
            prefix, lost = f"{name}: " if len(rigs) > 1 else "", counts.costliest
            without = f"without {counts.camera[lost]}"
            for axis, count, words in ((whole, counts.count, "all cameras"), (less, counts.without(lost), without)):
                draw_surroundings(axis, ego, reach_m=1.02 * counts.edges_m[-1])
                _draw_cells(axis, count, np.array(counts.edges_m), middle_of(ego))
                title(axis, f"{prefix}{words}")
                share = 100.0 * counts.blind_share(count)
                label = f"no camera on {share:.0f} % of the area within {counts.edges_m[-1]:g} m"
                axis.set_xlabel(f"{label}\n{beyond}" if axis is whole and beyond else label, fontsize=8)
        seen = [
            Patch(facecolor=hex_colour(rgb), label=name) for rgb, name in zip(COVERAGE_RGB, COVERAGE_WORDS, strict=True)
        ]
        rule = [
            f"its middle, {0.5 * CAR_HEIGHT_M:g} m above ground, is in the image,",
            "the own body does not hide it, and the image of",
            f"a car {CAR_HEIGHT_M:g} m high is at least {PIXELS[-1]:g} px high there",
        ]
        loss = ["without the camera whose loss", "leaves most ground to no camera,", "whatever traffic is there"]
        groups = {"A road user is seen by": seen, "A camera sees it where": rule, "Right": loss}
        write_key(key, groups, widths=(3, 5, 4))
    return figure


def _draw_cells(axis: Any, count: np.ndarray, edges_m: np.ndarray, middle_m: np.ndarray) -> None:  # noqa: ANN401
    from matplotlib.colors import ListedColormap

    edge_rad = (np.arange(len(count) + 1) - 0.5) * 2.0 * math.pi / len(count)
    x_m, y_m = (middle_m[k] + edges_m * of(edge_rad)[:, None] for k, of in enumerate((np.cos, np.sin)))
    shown = np.ma.masked_less(np.minimum(count, len(COVERAGE_RGB) - 1), 0)
    colours = ListedColormap([hex_colour(rgb) for rgb in COVERAGE_RGB])
    style = {"cmap": colours, "vmin": -0.5, "vmax": len(COVERAGE_RGB) - 0.5, "edgecolors": "white", "linewidth": 0.3}
    axis.pcolormesh(y_m, x_m, shown, **style, zorder=2)


def _beyond(counts: SectorCounts, bands: int) -> str:
    """What cameras see farther than a number of bands, in words; nothing where they do not."""
    seen = np.asarray(counts.sees.any(axis=0))[:, bands:]
    if not seen.any():
        return ""
    farthest_m = counts.edges_m[bands + 1 + int(np.flatnonzero(seen.any(axis=0))[-1])]
    return f"not drawn: seen up to {farthest_m:g} m in {int(seen.any(axis=1).sum())} of {len(seen)} directions"
