"""A rig on one page, to print: the vehicle from above and from the side, to scale, and what every camera sees."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import ArgumentError
from warpav.view._labels import Labels
from warpav.view._outlines import seen_arcs_rad, seen_ground_m
from warpav.view._palette import INK_RGB, MUTED_RGB, camera_rgb, hex_colour
from warpav.view.figures._from_above import RING, X, Y, Z, draw_vehicle, front_up
from warpav.view.figures._style import (
    SCALES,
    Page,
    badge_pt,
    camera_cells,
    closed,
    date_text,
    draw_badge,
    figure_style,
    long_names,
    mark_cameras,
    paper,
    short_names,
    text_width_mm,
    unit_per_pt,
)

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig import Rig, RigCamera

_PAGE_MM = (210.0, 297.0)
"""A4; rigs of many cameras make it longer."""

_MARGIN_MM, _HEAD_MM, _ROW_MM, _NOTE_MM, _GAP_MM = 12.0, 17.0, 4.6, 17.0, 9.0
_ARC_STEP_RAD = math.radians(1.0)
_ANGLE_EPSILON = 1e-6

_NOTE = (
    "Above: azimuths at which a camera sees the horizon; of one that sees none, the level ground that it sees "
    "(hatched).\n"
    "Below: what it sees in the upright plane of its optical axis, turned into the page to the front or the rear, "
    "whichever is nearer.\nNothing stands in the way. Field: that of the lens itself, across and down the image, "
    "whichever way the camera is turned.\nFrame: x forward, y left, z up, origin on the ground below the rear axle."
)


def _horizontal_arcs_rad(camera: RigCamera) -> list[tuple[float, float]]:
    """Azimuths at which the camera sees the horizon, in the ego frame, see `seen_arcs_rad`."""
    return seen_arcs_rad(camera, X, Y)


def _vertical_arcs_rad(camera: RigCamera) -> list[tuple[float, float]]:
    """Elevations that the camera sees in the upright plane of its optical axis, see `seen_arcs_rad`.

    0 is the horizon where the camera looks, pi / 2 up, -pi / 2 down; beyond them it is behind. Of a camera that looks
    straight up or down the plane is that of its image's upper edge.
    """
    return seen_arcs_rad(camera, _forward(camera), Z)


def _field_of_view_rad(camera: RigCamera) -> tuple[float, float]:
    """The lens's own field of view across and down the image, through the optical axis; however the camera is turned.

    A fisheye of 190 degrees has 190 here also where it is pitched, and so sees more of the horizon than that.
    """
    right, down, ahead = camera.ego_from_camera[:3, :3].T
    arcs = (seen_arcs_rad(camera, ahead, side) for side in (-right, -down))
    across, upright = (sum(last - first for first, last in each) for each in arcs)
    return across, upright


def _forward(camera: RigCamera) -> np.ndarray:
    rotation = camera.ego_from_camera[:3, :3]
    level = rotation[:2, 2]
    if np.linalg.norm(level) < _ANGLE_EPSILON:
        level = -rotation[:2, 1]
    return np.append(level / np.linalg.norm(level), 0.0)


def rig_sheet(
    rig: Rig,
    *,
    ego: Mesh | None = None,
    range_m: Sequence[float] | None = None,
    title: str | None = None,
    vehicle: str | None = None,
) -> Any:  # noqa: ANN401 (matplotlib)
    """A rig on a page of A4: from above and from the side, in a scale that the page states, and a table.

    What is drawn follows from the lens and the rotation of each camera, not from its angles alone:

    - From above, a fan over the azimuths at which the camera sees the horizon (`_horizontal_arcs_rad`). A camera that
      sees none of it has the level ground that it sees instead, from the nearest to the farthest point at each azimuth,
      hatched; one that looks up has nothing.
    - From the side, a fan over the elevations that it sees in the upright plane of its optical axis
      (`_vertical_arcs_rad`), turned about the camera's vertical into the page, to the front or the rear, whichever is
      nearer to where it looks. It ends at the ground.

    Fans end at the outermost range ring, and from the side where the page has no more room, which is said there.
    Neither the vehicle nor anything else stands in their way.
    """
    low_m, high_m = (np.zeros(3), np.zeros(3)) if ego is None else np.asarray(ego.bounds_m(), np.float64)
    middle_m = 0.5 * (low_m + high_m)[:2]
    usual_count = max(2, math.ceil((high_m - low_m)[0] / 5.0))
    ring_m = [5.0 * (k + 1) for k in range(usual_count)] if range_m is None else sorted(map(float, range_m))
    if not ring_m or not all(0.0 < each < math.inf for each in ring_m):
        raise ArgumentError("range_m", f"expected positive radii in metres, got {ring_m}")
    reach_m = ring_m[-1]
    top_m = max(0.3 * reach_m, high_m[2] + 0.5, *(camera.position_m[2] + 0.5 for camera in rig.cameras))
    # with room for names, and for a vehicle that is longer than the rings are wide
    half_m = max(1.09 * reach_m, 0.52 * float((high_m - low_m)[:2].max()))
    rest_mm = _HEAD_MM + (len(rig.cameras) + 1) * _ROW_MM + _NOTE_MM + 2.0 * _GAP_MM + 2.0 * _MARGIN_MM
    width_mm = _PAGE_MM[0]

    def height_mm(scale: float) -> float:
        return rest_mm + 1000.0 * (2.0 * half_m + top_m) / scale

    wide = [one for one in SCALES if 2000.0 * half_m / one <= width_mm - 2.0 * _MARGIN_MM] or [SCALES[-1]]
    scale = next((one for one in wide if height_mm(one) <= _PAGE_MM[1]), wide[-1] if rest_mm < 200.0 else wide[0])
    page_mm = max(_PAGE_MM[1], height_mm(scale))
    room_m = (page_mm - height_mm(scale)) * scale / 1000.0
    top_m = min(max(reach_m, top_m), top_m + room_m)

    with figure_style():
        page = Page(width_mm, page_mm)
        drawing_mm = 2000.0 * half_m / scale
        left_mm = 0.5 * (width_mm - drawing_mm)
        below_mm = _MARGIN_MM
        count = len(rig.cameras)
        heading = title or f"Rig of {count} camera{'' if count == 1 else 's'}"
        page.text(_MARGIN_MM, below_mm, heading, fontsize=13, fontweight="bold")
        page.text(width_mm - _MARGIN_MM, below_mm, f"1 : {scale}", ha="right", fontsize=10)
        length_m, across_m, up_m = high_m - low_m
        size = "no vehicle" if ego is None else f"vehicle {length_m:.2f} x {across_m:.2f} x {up_m:.2f} m"
        about = ", ".join(filter(None, (vehicle, size, date_text())))
        page.text(_MARGIN_MM, below_mm + 6.5, about, fontsize=8, color=hex_colour(MUTED_RGB))
        below_mm += 0.5 * _HEAD_MM
        above = page.panel(left_mm, below_mm, drawing_mm, drawing_mm)
        limits_m = middle_m[0] + half_m * np.array([-1, 1])
        below_mm += drawing_mm + _GAP_MM
        side_mm = 1000.0 * top_m / scale
        side = page.panel(left_mm, below_mm, drawing_mm, side_mm)
        if ego is not None:
            draw_vehicle(above, ego, -Y, X)
            draw_vehicle(side, ego, X, Z)
        above.set(xlim=limits_m - middle_m[0] - middle_m[1], ylim=limits_m)
        side.set(xlim=limits_m, ylim=(0.0, top_m))
        _draw_rings(above, side, ring_m, middle_m)
        _draw_from_above(above, rig, middle_m, reach_m)
        _draw_from_side(side, rig, middle_m, reach_m)
        if top_m < reach_m:  # what the view from the side shows does not end there
            grey = hex_colour(MUTED_RGB)
            side.axhline(top_m, color=grey, linewidth=0.8, linestyle=(0, (1, 2)), zorder=9, clip_on=False)
            style = {"ha": "right", "va": "bottom", "fontsize": 6.5, "color": grey, "annotation_clip": False}
            place = {"xycoords": ("axes fraction", "data"), "xytext": (0, 3), "textcoords": "offset points"}
            side.annotate(f"cut {top_m:.1f} m above the ground", (1.0, top_m), **place, **style)
        place_m = np.array([camera.position_m for camera in rig.cameras])
        for axis, across_m in ((above, front_up(place_m)), (side, place_m[:, [0, 2]])):
            mark_cameras(axis, rig.cameras, across_m)
        below_mm += side_mm + _GAP_MM
        rows = [
            _HEADINGS,
            *((name, *_row(camera)) for name, camera in zip(long_names(rig.cameras), rig.cameras, strict=True)),
        ]
        names_mm = min(max(38.0, 1.65 * max(len(row[0]) for row in rows)), 54.0)
        column_mm = (0.0, names_mm, 82.0, 107.0, 127.0, 158.0)
        for (line, row), column in itertools.product(enumerate(rows), range(len(column_mm))):
            colour = hex_colour(camera_rgb(line - 1) if line and not column else INK_RGB)
            room = (names_mm - 1.5) / text_width_mm(row[column], 1.78, is_bold=True) if not column else 1.0
            style = {"fontsize": 7.0 * min(1.0, room), "color": colour}
            style["fontweight"] = "normal" if line and column else "bold"
            page.text(_MARGIN_MM + column_mm[column], below_mm + line * _ROW_MM, row[column], **style)
        grey = hex_colour(MUTED_RGB)
        page.text(_MARGIN_MM, page_mm - _MARGIN_MM, _NOTE, va="bottom", fontsize=6.5, color=grey)
        return page.figure


def _draw_rings(above: Any, side: Any, ring_m: Sequence[float], middle_m: np.ndarray) -> None:  # noqa: ANN401 (matplotlib)
    from matplotlib.patches import Circle

    label = {"fontsize": 7, "color": hex_colour(MUTED_RGB), "ha": "center", "zorder": 10}
    below = {"xytext": (0, -3), "textcoords": "offset points", "va": "top", "annotation_clip": False}
    for radius_m in ring_m:
        above.add_patch(Circle(tuple(front_up(middle_m)), radius_m, zorder=2, **RING))
        side.add_patch(Circle((middle_m[0], 0.0), radius_m, zorder=2, **RING))
        for sign in (-1.0, 1.0):
            place_m = front_up(middle_m) + radius_m * math.sqrt(0.5) * np.array([sign, -1.0])
            above.text(*place_m, f"{radius_m:g} m", va="center", bbox=paper(0.8, 0.8), **label)
            side.annotate(f"{radius_m:g} m", (middle_m[0] + sign * radius_m, 0.0), **below, **label)
    side.axhline(0.0, color=hex_colour(INK_RGB), linewidth=1.2, zorder=9, clip_on=False)


def _draw_from_above(axis: Any, rig: Rig, middle_m: np.ndarray, reach_m: float) -> None:  # noqa: ANN401 (matplotlib)
    from matplotlib.patches import Circle

    border = Circle(tuple(front_up(middle_m)), reach_m, transform=axis.transData)
    ring_m, per_pt = np.array([text.get_position() for text in axis.texts]), unit_per_pt(axis)
    half_m = per_pt * np.array([14.0, 6.0])
    labels = Labels(np.hstack([ring_m - half_m, ring_m + half_m]))
    for index, (camera, name) in enumerate(zip(rig.cameras, short_names(rig.cameras), strict=True)):
        colour, centre_m = hex_colour(camera_rgb(index)), camera.position_m[:2]
        arcs = _horizontal_arcs_rad(camera)
        for outline_m in (_fan_m(arc, centre_m, middle_m, reach_m) for arc in arcs):
            _draw_fan(axis, front_up(outline_m), colour, alpha=0.14)
        if not arcs:
            for outline_m in seen_ground_m(camera, reach_m=2.0 * reach_m):
                style = {"facecolor": "none", "edgecolor": colour, "hatch": "////", "linewidth": 0.9, "zorder": 4}
                fan = axis.fill(*front_up(outline_m).T, **style)
                fan[0].set_clip_path(border)
        forward = _forward(camera)[:2]
        ahead_m = front_up(centre_m + _distance_m(centre_m, forward, middle_m, reach_m) * forward - middle_m)
        angle_rad = math.atan2(*ahead_m[::-1]) + math.radians(1.5) * np.array(sorted(range(-119, 121), key=abs))
        tried_m = front_up(middle_m) + 1.04 * reach_m * np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1)
        draw_badge(axis, tried_m[labels.put(tried_m, per_pt * (badge_pt(name) + 1.0))], name, colour)


def _draw_from_side(axis: Any, rig: Rig, middle_m: np.ndarray, reach_m: float) -> None:  # noqa: ANN401 (matplotlib)
    ground_m = np.array([middle_m[0], 0.0])
    for index, camera in enumerate(rig.cameras):
        colour = hex_colour(camera_rgb(index))
        centre_m = camera.position_m[[0, 2]]
        sign = 1.0 if _forward(camera)[0] > -_ANGLE_EPSILON else -1.0
        for arc in _vertical_arcs_rad(camera):
            outline_m = _fan_m(arc, centre_m, ground_m, reach_m, sign=sign, on_ground=True)
            _draw_fan(axis, outline_m, colour, alpha=0.05)  # many lie on each other


def _fan_m(
    arc_rad: tuple[float, float],
    centre_m: np.ndarray,
    middle_m: np.ndarray,
    reach_m: float,
    *,
    sign: float = 1.0,
    on_ground: bool = False,
) -> np.ndarray:
    """Outline of a fan from a camera to the outermost ring or the ground, [point, 2]; a sign of -1 mirrors it."""
    first, last = arc_rad
    angle_rad = np.linspace(first, last, 2 + math.ceil((last - first) / _ARC_STEP_RAD))
    direction = np.stack([sign * np.cos(angle_rad), np.sin(angle_rad)], axis=-1)
    distance_m = _distance_m(centre_m, direction, middle_m, reach_m)
    if on_ground:
        down = np.maximum(-direction[:, 1], _ANGLE_EPSILON)
        distance_m = np.minimum(distance_m, max(centre_m[1], 0.0) / down)
    return np.vstack([centre_m, centre_m + distance_m[:, None] * direction])


def _distance_m(start_m: np.ndarray, direction: np.ndarray, middle_m: np.ndarray, radius_m: float) -> np.ndarray:
    offset_m = start_m - middle_m
    along = direction @ offset_m
    square = along * along - float(offset_m @ offset_m) + radius_m * radius_m
    return np.where(square > 0.0, np.maximum(np.sqrt(np.maximum(square, 0.0)) - along, 0.0), 0.0)


def _draw_fan(axis: Any, outline_m: np.ndarray, colour: str, *, alpha: float) -> None:  # noqa: ANN401 (matplotlib)
    axis.fill(*outline_m.T, color=colour, alpha=alpha, linewidth=0, zorder=3)
    axis.plot(*closed(outline_m).T, color=colour, linewidth=0.9, zorder=4)


_HEADINGS = ("camera", "module or lens", "image [px]", "field [°]", "x, y, z [m]", "yaw, pitch, roll [°]")


def _row(camera: RigCamera) -> tuple[str, ...]:
    seen = [f"{math.degrees(each):.0f}" for each in _field_of_view_rad(camera)]
    angles_deg = np.degrees([camera.yaw_rad, camera.pitch_rad, camera.roll_rad]) + 0.0
    place, angles = (", ".join(f"{x:.{k}f}" for x in each) for each, k in ((camera.position_m, 2), (angles_deg, 0)))
    return (*camera_cells(camera), " x ".join(seen), place, angles)
