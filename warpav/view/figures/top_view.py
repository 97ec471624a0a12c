"""What a run found, seen from above: how cameras moved, where one more would help, which ground no camera sees."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.figures.from_above import (
    draw_cameras,
    draw_height_map,
    draw_vehicle,
    draw_zone_border,
    start_and_end_handles,
)
from warpav.view.figures.style import (
    PALE,
    WIDTH_INCH,
    colour_bar,
    colour_map,
    empty_panel,
    figure_style,
    halo,
    metre_axes,
    new_figure,
    svg_text,
)
from warpav.view.outlines import sector_polygon_m
from warpav.view.palette import COVERAGE_RGB, INK_RGB, MUTED_RGB, camera_rgb, further_map, hex_colour

if TYPE_CHECKING:
    from warpav.optimisation.further_camera import FurtherCameras
    from warpav.raster.mesh import Mesh
    from warpav.rig.mount_surface import MountSurface
    from warpav.rig.rig import Rig

_ROOM_INCH = 1.9, 1.5
"""Beside the panel for labels and the bar, and above and below it for the key, the title and labels."""

_SECTOR_M = 1.6
"""How long fields of view are drawn [m]."""


def top_view_figure(
    *,
    rig: Rig,
    ego: Mesh,
    mount_surface: MountSurface,
    rig_initial: Rig | None = None,
    trajectory_m: np.ndarray | None = None,
    shows_zone: bool = False,
    heading: str | None = None,
) -> Any:  # noqa: ANN401 (matplotlib)
    """Draw the vehicle from above with the cameras, where they started, their paths [m] and their fields of view."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    with figure_style():
        figure = new_figure(WIDTH_INCH, 6.0)
        axis = figure.subplots()
        draw_vehicle(axis, ego)
        image = draw_height_map(axis, mount_surface, colours=colour_map(*PALE))
        if shows_zone:
            draw_zone_border(axis, mount_surface)
        moved = {"rig_initial": rig_initial, "trajectory_m": trajectory_m}
        draw_cameras(axis, rig, **moved, sector_radius_m=_SECTOR_M, has_names=True)
        if heading:
            axis.set_title(heading)
        handles, grey = start_and_end_handles() if rig_initial is not None else [], hex_colour(MUTED_RGB)
        if trajectory_m is not None:
            handles.append(Line2D([], [], color=grey, linewidth=1.8, label="path of a camera"))
        handles.append(Patch(color=grey, alpha=0.3, label=f"horizontal field of view, drawn {_SECTOR_M:g} m long"))
        figure.legend(handles=handles, loc="outside upper left", ncols=4)
        _finish(axis, 0.04)
        colour_bar(figure, image, axis, "height of the mount surface [m]", shrink=0.7)
        _set_apart(figure, axis)
        return figure


def _finish(axis: Any, margin: float) -> None:  # noqa: ANN401 (matplotlib)
    metre_axes(axis)
    axis.use_sticky_edges = False
    axis.margins(margin)
    axis.autoscale_view()


def _set_apart(figure: Any, axis: Any) -> None:  # noqa: ANN401 (matplotlib)
    """Make room for the texts of a panel, move them up or down off each other, and fit the figure's height to it."""
    low_m, high_m = np.array([axis.get_xlim(), axis.get_ylim()]).T
    for _ in range(3):  # a wider panel has a smaller scale, and there texts are longer
        boxes_m = _text_boxes_m(figure, axis)
        low_m[0] = min(low_m[0], *(box[0, 0] for box in boxes_m))
        high_m[0] = max(high_m[0], *(box[1, 0] for box in boxes_m))
        axis.set(xlim=(low_m[0], high_m[0]), ylim=(low_m[1], high_m[1]))
    middle_m, taken = 0.5 * (low_m[1] + high_m[1]), []
    for text, box in zip(axis.texts, _text_boxes_m(figure, axis), strict=True):
        outwards = math.copysign(1.1 * float(np.ptp(box, axis=0)[1]), float(box[:, 1].mean()) - middle_m)
        tried = [box + np.array([0.0, step * outwards]) for step in (0, 1, -1, 2, -2, 3, -3, 4)]
        free = (each for each in tried if not any(_overlap(each, other) for other in taken))
        taken.append(next(free, tried[0]))
        text.set_position(np.array(text.get_position()) + taken[-1][0] - box[0])
    low_m = np.min([low_m, *(box[0] for box in taken)], axis=0) - 0.05
    high_m = np.max([high_m, *(box[1] for box in taken)], axis=0) + 0.05
    axis.set(xlim=(low_m[0], high_m[0]), ylim=(low_m[1], high_m[1]))
    ratio = (high_m - low_m)[1] / (high_m - low_m)[0]
    figure.set_figheight(float(np.clip(_ROOM_INCH[1] + (WIDTH_INCH - _ROOM_INCH[0]) * ratio, 3.6, 7.5)))


def _text_boxes_m(figure: Any, axis: Any) -> list[np.ndarray]:  # noqa: ANN401 (matplotlib)
    """Lowest and highest corners of the texts of a panel in its own units, [2, 2] each."""
    figure.draw_without_rendering()
    from_px = axis.transData.inverted()
    return [from_px.transform(text.get_window_extent().get_points()) for text in axis.texts]


def _overlap(one: np.ndarray, other: np.ndarray) -> bool:
    return bool((one[0] < other[1]).all() and (other[0] < one[1]).all())


def further_figure(
    *,
    further: FurtherCameras,
    rig: Rig,
    ego: Mesh,
    mount_surface: MountSurface,
    objects: str = "vehicles",
) -> Any:  # noqa: ANN401 (matplotlib)
    """Draw what each further camera would add to a rig: a dot at its place, in the colour of it.

    The best camera of every place has an arrow in its direction, the five best places carry their ranks. Nothing is
    interpolated: between the dots nobody has looked.
    """
    if not len(further):
        return None
    ink, most = hex_colour(INK_RGB), max(100.0 * float(further.gain.max()), 1e-9)
    scale = {"cmap": further_map(), "clim": (0.0, most)}
    best = further[further.best_places()]
    with figure_style():
        figure = new_figure(WIDTH_INCH, 4.7)
        axis = figure.subplots()
        draw_vehicle(axis, ego)
        draw_height_map(axis, mount_surface, colours=colour_map(*PALE))
        for shown, size, order in ((further, 9.0, 4), (best, 22.0, 6)):
            place_m, gain = shown.position_m[::-1, :2], 100.0 * shown.gain[::-1]  # the best last, on top of the others
            dots = axis.scatter(*place_m.T, c=gain, s=size, edgecolors=ink, linewidths=0.4, zorder=order, **scale)
        arrow = {"width": 0.025, "headwidth": 3.8, "headlength": 4.2, "headaxislength": 3.8, "edgecolor": ink}
        arrow |= {"linewidth": 0.5, "angles": "xy", "scale_units": "xy", "units": "xy", "scale": 1.0, "zorder": 5}
        ahead_m = 0.2 * best.direction[::-1, :2]
        axis.quiver(*best.position_m[::-1, :2].T, *ahead_m.T, 100.0 * best.gain[::-1], **scale, **arrow)
        bold = {"ha": "center", "va": "center", "fontweight": "bold", "zorder": 9, "path_effects": halo()}
        for rank, (place_m, ahead) in enumerate(zip(best.position_m[:5], best.direction[:5, :2], strict=True), 1):
            behind_m = place_m[:2] - 0.09 * ahead / max(float(np.linalg.norm(ahead)), 1e-9)
            axis.annotate(str(rank), behind_m, **bold)
        mark: Any = {"markerfacecolor": "white", "markeredgecolor": ink, "markeredgewidth": 1.5, "markersize": 8}
        for camera in rig.cameras:
            outline = sector_polygon_m(camera, radius_m=0.45)
            axis.fill(*outline.T, facecolor="white", edgecolor=ink, alpha=0.55, linewidth=0.8, zorder=3)
            axis.plot(*camera.position_m[:2], "o", zorder=7, **mark)
        axis.plot([], [], "o", label="camera of the rig, and what it covers", **mark)
        arrow = {"linestyle": "", "marker": r"$\rightarrow$", "color": ink, "markersize": 13}
        axis.plot([], [], label="one more camera: the best at its place", **arrow)
        figure.legend(loc="outside upper left", ncols=2)
        _finish(axis, 0.03)
        colour_bar(figure, dots, axis, f"further {objects} found of 100", shrink=0.75)
        return figure


def blind_ground(
    blind_share: np.ndarray, title: str, *, cell_m: float, ego_bounds_m: np.ndarray, rig: Rig | None
) -> str:
    """Where no camera sees somebody, seen from above with the front up, as SVG.

    Shares of the scenes, 0..1, NaN where nobody can stand: rows run along x, columns along y, around the middle of the
    vehicle, whose lowest and highest corner are the bounds [m].
    """
    from matplotlib.patches import FancyBboxPatch

    colours = colour_map("blind", "#eaf1f8", (240, 170, 150), COVERAGE_RGB[0], (120, 16, 20))
    low_m, high_m = ego_bounds_m
    middle_m, (length_m, width_m) = 0.5 * (low_m + high_m), (high_m - low_m)[:2]
    reach_m = 0.5 * cell_m * len(blind_share)
    ink = hex_colour(INK_RGB)

    def draw(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
        # rows are forward and shall point up, columns are left
        style = {"cmap": colours, "vmin": 0.0, "vmax": 1.0, "interpolation": "nearest"}
        image = axis.imshow(blind_share[::-1, ::-1], extent=(reach_m, -reach_m, -reach_m, reach_m), **style)
        corner, size = (-width_m / 2 + 0.4, -length_m / 2 + 0.4), (width_m - 0.8, length_m - 0.8)
        body = {"boxstyle": "round,pad=0.4", "facecolor": "#c9d1db", "edgecolor": ink, "linewidth": 0.8}
        axis.add_patch(FancyBboxPatch(corner, *size, **body))
        axis.plot([0.0, 0.0], [0.0, 0.5 * length_m], color=ink, linewidth=0.8)
        for index, camera in enumerate(rig.cameras if rig else ()):
            forward_m, left_m = camera.position_m[:2] - middle_m[:2]
            axis.plot(left_m, forward_m, "o", color=hex_colour(camera_rgb(index)), markersize=3.0)
        turn = np.linspace(0.0, 2.0 * math.pi, 181)
        for radius_m in (5, 10, 15, 20):
            axis.plot(radius_m * np.cos(turn), radius_m * np.sin(turn), color="#8a94a0", linewidth=0.5, alpha=0.7)
            axis.text(0.0, -radius_m, f"{radius_m} m", fontsize=6.5, ha="center", va="bottom", color="#4a5360")
        empty_panel(axis)
        axis.spines[:].set_visible(False)
        axis.set_title(title)
        colour_bar(axis.figure, image, axis, shrink=0.8, aspect=26, format="{x:.0%}")

    return svg_text(draw, 3.7)
