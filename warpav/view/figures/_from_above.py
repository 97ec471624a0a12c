"""Figures from above: what they share, and what a run found, one more camera would bring, and no camera sees."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view._outlines import sector_polygon_m, silhouette_m
from warpav.view._palette import GRID_RGB, INK_RGB, MUTED_RGB, Rgb, camera_rgb, further_map, hex_colour
from warpav.view.figures._style import (
    PALE,
    WIDTH_INCH,
    caption,
    closed,
    colour_bar,
    colour_map,
    empty_panel,
    figure_style,
    halo,
    long_names,
    mark_cameras,
    metre_axes,
    new_figure,
    paper,
)

if TYPE_CHECKING:
    from warpav.optimisation import FurtherCameras
    from warpav.raster.mesh import Mesh
    from warpav.rig import MountSurface, Rig

RINGS = "Rings: distance from the middle of the vehicle."
RING: Any = {"edgecolor": hex_colour(MUTED_RGB), "linewidth": 0.6, "linestyle": (0, (5, 3)), "fill": False}
_KEY_LINE_INCH = 0.185
"""Height of a line of a key [inch]."""

X, Y, Z = np.eye(3)


def front_up(point_m: np.ndarray) -> np.ndarray:
    """Points of the ego frame [..., 2 or 3] from above with the front at the top, [..., 2]."""
    return np.stack([-point_m[..., 1], point_m[..., 0]], axis=-1)


def draw_vehicle(
    axis: Any,  # noqa: ANN401 (matplotlib)
    ego: Mesh,
    right: np.ndarray = Y,
    up: np.ndarray = X,
    *,
    edge_rgb: Rgb = MUTED_RGB,
    zorder: float = 1.0,
) -> None:
    """Draw a vehicle as a silhouette in one flat colour with a border, from above at (y, x)."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    lines = [Path(closed(line), closed=True) for line in silhouette_m(ego, right, up)]
    style = {"facecolor": hex_colour(GRID_RGB), "edgecolor": hex_colour(edge_rgb), "linewidth": 0.9, "zorder": zorder}
    axis.add_patch(PathPatch(Path.make_compound_path(*lines), **style))
    axis.autoscale_view()


def draw_height_map(axis: Any, mount_surface: MountSurface, *, colours: Any) -> Any:  # noqa: ANN401 (matplotlib)
    """Draw a height map from above at (y, x); cells that are NaN stay empty. Returns matplotlib's image."""
    low, high = np.asarray(mount_surface.bounds_m, dtype=np.float64)
    half = mount_surface.cell_m / 2.0
    extent = (low[1] - half, high[1] + half, low[0] - half, high[0] + half)
    style = {"origin": "lower", "extent": extent, "cmap": colours, "zorder": 2, "interpolation": "nearest"}
    return axis.imshow(mount_surface.height_m, **style)


def draw_zone_border(axis: Any, mount_surface: MountSurface) -> None:  # noqa: ANN401 (matplotlib)
    """Draw the border of the mountable zone from above at (y, x)."""
    x_m, y_m = (
        start + mount_surface.cell_m * np.arange(-1, n + 1)
        for start, n in zip(mount_surface.origin_m, mount_surface.height_m.shape, strict=True)
    )
    distance_m = mount_surface.zone_distance_m(np.stack(np.meshgrid(x_m, y_m, indexing="ij"), axis=-1))
    axis.contour(y_m, x_m, distance_m, levels=[0.0], colors=hex_colour(INK_RGB), linewidths=1.0, zorder=3)


def draw_cameras(
    axis: Any,  # noqa: ANN401 (matplotlib)
    rig: Rig,
    *,
    rig_initial: Rig | None = None,
    trajectory_m: np.ndarray | None = None,
    sector_radius_m: float | None = None,
) -> None:
    """Draw cameras from above at (y, x), each in its colour; paths [m] are [iteration, camera, 2 or 3]."""
    for index in range(0 if trajectory_m is None else np.shape(trajectory_m)[1]):
        path_m = np.asarray(trajectory_m, dtype=np.float64)[:, index, 1::-1].T
        axis.plot(*path_m, color="white", linewidth=4.0, zorder=5)
        axis.plot(*path_m, color=hex_colour(camera_rgb(index)), linewidth=1.8, zorder=6)
    for index, camera in enumerate(rig.cameras):
        colour = hex_colour(camera_rgb(index))
        if rig_initial is not None and index < len(rig_initial.cameras):
            hollow = {"markerfacecolor": "white", "markeredgecolor": colour, "markeredgewidth": 1.8}
            axis.plot(*rig_initial.cameras[index].position_m[1::-1], "o", markersize=8, zorder=7, **hollow)
        solid = {"markerfacecolor": colour, "markeredgecolor": "white", "markeredgewidth": 1.5}
        axis.plot(*camera.position_m[1::-1], "o", markersize=10, zorder=8, **solid)
        if sector_radius_m is not None:
            outline = sector_polygon_m(camera, radius_m=sector_radius_m)[:, ::-1]
            axis.fill(*outline.T, color=colour, alpha=0.22, linewidth=0, zorder=3)
            axis.plot(*closed(outline).T, color=colour, linewidth=1.2, alpha=0.8, zorder=4)


def start_and_end_handles() -> list[Any]:
    """Handles of a legend for cameras at the start and at the end."""
    from matplotlib.lines import Line2D

    mark: Any = {"linestyle": "", "marker": "o", "color": hex_colour(MUTED_RGB)}
    return [
        Line2D([], [], markersize=8, markerfacecolor="white", label="start", **mark),
        Line2D([], [], markersize=9, label="end", **mark),
    ]


# ------------------------------------------------------------------------------- panels with the front at the top


def middle_of(ego: Mesh) -> np.ndarray:
    """Middle of a vehicle's bounds, x and y [m], float64 [2]."""
    return np.asarray(ego.bounds_m(), np.float64)[:, :2].mean(axis=0)


def half_length_m(ego: Mesh) -> float:
    """Half of the longer side of a vehicle from above [m]."""
    return 0.5 * float(np.ptp(np.asarray(ego.bounds_m()), axis=0)[:2].max())


def ring_radii_m(reach_m: float) -> list[float]:
    """Round radii of range rings up to a distance [m], four to eight of them."""
    power = 10.0 ** math.floor(math.log10(reach_m / 4.0))
    step_m = max(step for step in (power, 2.0 * power, 5.0 * power) if step <= reach_m / 4.0)
    return [step_m * k for k in range(1, math.floor(reach_m / step_m + 1e-9) + 1)]


def write_distance(axis: Any, place_m: Sequence[float], distance_m: float, **style: Any) -> None:  # noqa: ANN401
    """Write the distance of a ring on it."""
    style = {"fontsize": 7, "color": hex_colour(INK_RGB), "bbox": paper(0.6, 0.75), "zorder": 8} | style
    axis.text(*place_m, f"{distance_m:g} m", ha="center", va="center", **style)


def draw_surroundings(axis: Any, ego: Mesh, *, reach_m: float, has_rings: bool = True) -> None:  # noqa: ANN401
    """Prepare a panel from above, x upwards and y to the left: the vehicle, rings, an arrow to the front.

    What is drawn into it is drawn at (y, x).
    """
    from matplotlib.patches import Circle

    empty_panel(axis)
    x_m, y_m = middle_of(ego)
    axis.set(xlim=(y_m + reach_m, y_m - reach_m), ylim=(x_m - reach_m, x_m + reach_m), aspect="equal")
    draw_vehicle(axis, ego, edge_rgb=INK_RGB, zorder=5.0)
    for radius_m in ring_radii_m(reach_m) if has_rings else ():
        if radius_m >= half_length_m(ego):
            axis.add_patch(Circle((y_m, x_m), radius_m, zorder=6, **RING))
            turn = math.radians(225.0)  # behind on the right, where rarely anything is written
            write_distance(axis, (y_m + radius_m * math.sin(turn), x_m + radius_m * math.cos(turn)), radius_m)
    ink = hex_colour(INK_RGB)
    style = {"ha": "center", "va": "top", "fontsize": 7, "color": ink, "bbox": paper(0.6, 0.75), "zorder": 8}
    arrow = {"arrowstyle": "-|>", "color": ink, "linewidth": 0.8}
    axis.annotate("front", (0.5, 1.0), xytext=(0.5, 0.93), xycoords="axes fraction", arrowprops=arrow, **style)


@contextmanager
def panels_with_key(
    count: int,
    columns: int,
    *,
    panel_inch: float,
    key_lines: int,
    text: str,
    heading: str | None,
    projection: str | None = None,
) -> Iterator[tuple[Any, list[Any], Any]]:
    """A figure with rows of square panels above a key, with a caption and a heading once they are drawn."""
    rows = -(-count // columns)
    key_inch = _KEY_LINE_INCH * key_lines + 0.05
    with figure_style():
        figure = new_figure(WIDTH_INCH, panel_inch * rows + key_inch + 0.3)
        grid = figure.add_gridspec(rows + 1, columns, height_ratios=[*[panel_inch] * rows, key_inch])
        panels = [figure.add_subplot(grid[k // columns, k % columns], projection=projection) for k in range(count)]
        yield figure, panels, figure.add_subplot(grid[rows, :])
        caption(figure, text, heading)


def write_key(
    axis: Any,  # noqa: ANN401 (matplotlib)
    groups: Mapping[str, Sequence[Any]],
    *,
    columns: Sequence[int] | None = None,
    widths: Sequence[float] | None = None,
) -> None:
    """Write the key of a figure into a panel of its own: groups side by side, each with a heading."""
    from matplotlib.lines import Line2D

    axis.set_axis_off()
    columns = [1] * len(groups) if columns is None else columns
    widths = columns if widths is None else widths
    style = {"fontsize": 8, "title_fontproperties": {"size": 8, "weight": "bold"}, "alignment": "left"}
    style |= {"loc": "upper left", "borderaxespad": 0.0, "borderpad": 0.0, "columnspacing": 1.2}
    place = 0.0
    for (name, lines), count, width in zip(groups.items(), columns, widths, strict=True):
        handles = [Line2D([], [], color="none", label=each) if isinstance(each, str) else each for each in lines]
        long, pad = (0.0, 0.0) if isinstance(lines[0], str) else (1.4, 0.8)
        at = {"bbox_to_anchor": (place, 1.0), "ncols": count, "handlelength": long, "handletextpad": pad}
        axis.add_artist(axis.legend(handles=handles, title=name, **at, **style))
        place += width / sum(widths)
    axis.legend_ = None


def camera_handles(rigs: Mapping[str, Rig]) -> dict[str, list[Any]]:
    """Handles of a key for cameras; where rigs do not share the names, each rig's are apart."""
    from matplotlib.patches import Patch

    def named(rig: Rig) -> list[Any]:
        return [Patch(color=hex_colour(camera_rgb(k)), label=name) for k, name in enumerate(long_names(rig.cameras))]

    largest = max(rigs.values(), key=lambda rig: len(rig.cameras))
    name = [camera.name for camera in largest.cameras]
    if all([camera.name for camera in rig.cameras] == name[: len(rig.cameras)] for rig in rigs.values()):
        return {"Cameras": named(largest)}
    return {f"Cameras, {key}": named(rig) for key, rig in rigs.items()}


# ------------------------------------------------------------------------------------------------- of runs

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
        figure = new_figure(WIDTH_INCH, 7.5)
        axis = figure.subplots()
        draw_vehicle(axis, ego)
        image = draw_height_map(axis, mount_surface, colours=colour_map(*PALE))
        if shows_zone:
            draw_zone_border(axis, mount_surface)
        moved = {"rig_initial": rig_initial, "trajectory_m": trajectory_m}
        draw_cameras(axis, rig, **moved, sector_radius_m=_SECTOR_M)
        if heading:
            axis.set_title(heading)
        handles, grey = start_and_end_handles() if rig_initial is not None else [], hex_colour(MUTED_RGB)
        if trajectory_m is not None:
            handles.append(Line2D([], [], color=grey, linewidth=1.8, label="path of a camera"))
        handles.append(Patch(color=grey, alpha=0.3, label=f"horizontal field of view, drawn {_SECTOR_M:g} m long"))
        figure.legend(handles=handles, loc="outside upper left", ncols=4)
        figure.legend(handles=camera_handles({"rig": rig})["Cameras"], loc="outside lower left", ncols=4)
        name_cameras(axis, rig)
        colour_bar(figure, image, axis, "height of the mount surface [m]", shrink=0.7)
        return figure


def name_cameras(axis: Any, rig: Rig) -> None:  # noqa: ANN401 (matplotlib)
    """Mark cameras with their short names in a panel to scale, and fit its limits to all that is drawn."""
    metre_axes(axis)
    axis.use_sticky_edges = False
    axis.margins(0.04)
    axis.autoscale_view()
    mark_cameras(axis, rig.cameras)


def further_figure(
    *, further: FurtherCameras, rig: Rig, ego: Mesh, mount_surface: MountSurface, objects: str = "vehicles"
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
        figure = new_figure(0.75 * WIDTH_INCH, 9.0)
        axis = figure.subplots()
        draw_vehicle(axis, ego)
        draw_height_map(axis, mount_surface, colours=colour_map(*PALE))
        for shown, size, order in ((further, 9.0, 4), (best, 22.0, 6)):
            # the best last, on top of the others
            place_m, gain = shown.position_m[::-1, 1::-1], 100.0 * shown.gain[::-1]
            dots = axis.scatter(*place_m.T, c=gain, s=size, edgecolors=ink, linewidths=0.4, zorder=order, **scale)
        arrow = {"width": 0.025, "headwidth": 3.8, "headlength": 4.2, "headaxislength": 3.8, "edgecolor": ink}
        arrow |= {"linewidth": 0.5, "angles": "xy", "scale_units": "xy", "units": "xy", "scale": 1.0, "zorder": 5}
        ahead_m = 0.2 * best.direction[::-1, 1::-1]
        axis.quiver(*best.position_m[::-1, 1::-1].T, *ahead_m.T, 100.0 * best.gain[::-1], **scale, **arrow)
        bold = {"ha": "center", "va": "center", "fontweight": "bold", "zorder": 9, "path_effects": halo()}
        for rank, (place_m, ahead) in enumerate(zip(best.position_m[:5], best.direction[:5, :2], strict=True), 1):
            behind_m = place_m[:2] - 0.09 * ahead / max(float(np.linalg.norm(ahead)), 1e-9)
            axis.annotate(str(rank), behind_m[::-1], **bold)
        for camera in rig.cameras:
            outline = sector_polygon_m(camera, radius_m=0.45)
            axis.fill(*outline.T[::-1], facecolor="white", edgecolor=ink, alpha=0.55, linewidth=0.8, zorder=3)
        arrow = {"linestyle": "", "marker": ">", "color": ink, "markersize": 7}
        axis.plot([], [], label="one more camera: the best at its place", **arrow)
        figure.legend(loc="outside upper left")
        name_cameras(axis, rig)
        colour_bar(figure, dots, axis, f"further {objects} found of 100", shrink=0.75)
        return figure
