"""Vehicles, mount surfaces, cameras and the ground from above."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.figures.style import WIDTH_INCH, figure_style, new_figure, svg_text
from warpav.view.frustum import sector_polygon_m
from warpav.view.palette import COVERAGE_RGB, GRID_RGB, INK_RGB, MUTED_RGB, camera_rgb, further_map, hex_colour
from warpav.view.silhouette import silhouette_m

if TYPE_CHECKING:
    from warpav.optimisation.further_camera import FurtherCameras
    from warpav.raster.mesh import Mesh
    from warpav.rig.mount_surface import MountSurface
    from warpav.rig.rig import Rig


_ROOM_INCH = 1.9, 1.5
"""Beside the panel for labels and the bar, and above and below it for the key, the title and labels."""

_RIG_MARK: Any = {"markerfacecolor": "white", "markeredgecolor": hex_colour(INK_RGB), "markeredgewidth": 1.5}


def top_view_figure(
    *,
    rig: Rig,
    ego: Mesh,
    mount_surface: MountSurface,
    rig_initial: Rig | None = None,
    trajectory_m: np.ndarray | None = None,
    sector_radius_m: float = 1.6,
    shows_zone: bool = False,
    heading: str | None = None,
) -> Any:  # noqa: ANN401 (matplotlib)
    """Draw the vehicle from above with the cameras, where they started, their paths and their sectors.

    Args:
        trajectory_m: Camera positions over the iterations [m], shape [iteration, camera, 3] or [iteration, camera, 2].
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    with figure_style():
        figure = new_figure(WIDTH_INCH, 6.0)
        axis = figure.subplots()
        draw_vehicle(axis, ego)
        image = draw_height_map(axis, mount_surface, colours=pale_map())
        if shows_zone:
            draw_zone_border(axis, mount_surface)
        draw_cameras(
            axis,
            rig,
            rig_initial=rig_initial,
            trajectory_m=trajectory_m,
            sector_radius_m=sector_radius_m,
            has_names=True,
        )
        if heading:
            axis.set_title(heading)
        handles = start_and_end_handles() if rig_initial is not None else []
        grey = hex_colour(MUTED_RGB)
        if trajectory_m is not None:
            handles.append(Line2D([], [], color=grey, linewidth=1.8, label="path of a camera"))
        reach = f"horizontal field of view, drawn {sector_radius_m:g} m long"
        figure.legend(handles=[*handles, Patch(color=grey, alpha=0.3, label=reach)], loc="outside upper left", ncols=4)
        axis.set_aspect("equal")
        axis.use_sticky_edges = False
        axis.margins(0.04)
        axis.autoscale_view()
        axis.set_xlabel("x, forward [m]")
        axis.set_ylabel("y, left [m]")
        bar = figure.colorbar(image, ax=axis, shrink=0.7, pad=0.02, aspect=28)
        bar.set_label("height of the mount surface [m]")
        bar.outline.set_visible(False)
        _set_apart(figure, axis)
        return figure


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
    named: int = 5,
) -> Any:  # noqa: ANN401 (matplotlib)
    """Draw what each further camera would add to a rig: a dot at its place, in the colour of it.

    The best camera of every place has an arrow in its direction, the best places carry their ranks. Nothing is
    interpolated: between the dots nobody has looked.
    """
    from matplotlib.patheffects import withStroke

    if not len(further):
        return None
    ink, most = hex_colour(INK_RGB), max(100.0 * float(further.gain.max()), 1e-9)
    scale = {"cmap": further_map(), "clim": (0.0, most)}
    best = further[further.best_places()]
    with figure_style():
        figure = new_figure(WIDTH_INCH, 4.7)
        axis = figure.subplots()
        draw_vehicle(axis, ego)
        draw_height_map(axis, mount_surface, colours=pale_map())
        for shown, size, order in ((further, 9.0, 4), (best, 22.0, 6)):
            place_m, gain = shown.position_m[::-1, :2], 100.0 * shown.gain[::-1]  # the best last, on top of the others
            dots = axis.scatter(*place_m.T, c=gain, s=size, edgecolors=ink, linewidths=0.4, zorder=order, **scale)
        axis.quiver(
            *best.position_m[::-1, :2].T,
            *(0.2 * best.direction[::-1, :2]).T,
            100.0 * best.gain[::-1],
            **scale,
            edgecolor=ink,
            linewidth=0.5,
            angles="xy",
            scale_units="xy",
            scale=1.0,
            units="xy",
            width=0.025,
            headwidth=3.8,
            headlength=4.2,
            headaxislength=3.8,
            zorder=5,
        )
        for rank, (place_m, ahead) in enumerate(zip(best.position_m[:named], best.direction[:named], strict=True), 1):
            axis.annotate(
                str(rank),
                place_m[:2] - 0.09 * ahead[:2] / max(float(np.linalg.norm(ahead[:2])), 1e-9),
                ha="center",
                va="center",
                fontweight="bold",
                zorder=9,
                path_effects=[withStroke(linewidth=2.5, foreground="white")],
            )
        for camera in rig.cameras:
            outline = sector_polygon_m(camera, radius_m=0.45)
            axis.fill(*outline.T, facecolor="white", edgecolor=ink, alpha=0.55, linewidth=0.8, zorder=3)
            axis.plot(*camera.position_m[:2], "o", markersize=8, zorder=7, **_RIG_MARK)
        axis.plot([], [], "o", label="camera of the rig, and what it covers", markersize=8, **_RIG_MARK)
        arrow = {"linestyle": "", "marker": r"$\rightarrow$", "color": ink, "markersize": 13}
        axis.plot([], [], label="one more camera: the best at its place", **arrow)
        figure.legend(loc="outside upper left", ncols=2)
        axis.set_aspect("equal")
        axis.use_sticky_edges = False
        axis.margins(0.03)
        axis.autoscale_view()
        axis.set_xlabel("x, forward [m]")
        axis.set_ylabel("y, left [m]")
        bar = figure.colorbar(dots, ax=axis, shrink=0.75, pad=0.02, aspect=28)
        bar.set_label(f"further {objects} found of 100")
        bar.outline.set_visible(False)
        return figure


def draw_cameras(
    axis: Any,  # noqa: ANN401 (matplotlib)
    rig: Rig,
    *,
    rig_initial: Rig | None = None,
    trajectory_m: np.ndarray | None = None,
    sector_radius_m: float | None = None,
    has_names: bool = False,
) -> None:
    """Draw cameras from above, x pointing right, each in its colour; arguments as in `top_view_figure`."""
    from matplotlib.patheffects import withStroke

    if trajectory_m is not None:
        step = np.asarray(trajectory_m, dtype=np.float64)
        for index in range(step.shape[1]):
            axis.plot(*step[:, index, :2].T, color="white", linewidth=4.0, zorder=5)
            axis.plot(*step[:, index, :2].T, color=hex_colour(camera_rgb(index)), linewidth=1.8, zorder=6)
    for index, camera in enumerate(rig.cameras):
        colour = hex_colour(camera_rgb(index))
        if rig_initial is not None and index < len(rig_initial.cameras):
            start = rig_initial.cameras[index].position_m
            hollow = {"markerfacecolor": "white", "markeredgecolor": colour, "markeredgewidth": 1.8}
            axis.plot(start[0], start[1], "o", markersize=8, zorder=7, **hollow)
        solid = {"markerfacecolor": colour, "markeredgecolor": "white", "markeredgewidth": 1.5}
        axis.plot(camera.position_m[0], camera.position_m[1], "o", markersize=10, zorder=8, **solid)
        if sector_radius_m is None:
            continue
        outline = sector_polygon_m(camera, radius_m=sector_radius_m)
        axis.fill(*outline.T, color=colour, alpha=0.22, linewidth=0, zorder=3)
        axis.plot(*np.vstack([outline, outline[:1]]).T, color=colour, linewidth=1.2, alpha=0.8, zorder=4)
        if not has_names:
            continue
        arc_middle = outline[1:][(len(outline) - 1) // 2]
        direction = (arc_middle - outline[0]) / np.linalg.norm(arc_middle - outline[0])
        label = outline[0] + (sector_radius_m + 0.08 + 0.09 * np.abs(direction[1])) * direction
        side = "center" if abs(direction[0]) < 0.4 else "left" if direction[0] > 0 else "right"
        halo = [withStroke(linewidth=2.5, foreground="white")]
        style = {"color": colour, "fontweight": "bold", "path_effects": halo, "zorder": 9}
        axis.text(*label, camera.name, ha=side, va="center", **style)
        axis.update_datalim([label + np.array([math.copysign(0.09 * len(camera.name), direction[0]), 0.0])])


def start_and_end_handles() -> list[Any]:
    """Handles of a legend for cameras at the start and at the end."""
    from matplotlib.lines import Line2D

    grey = hex_colour(MUTED_RGB)
    return [
        Line2D([], [], linestyle="", marker="o", markersize=8, color=grey, markerfacecolor="white", label="start"),
        Line2D([], [], linestyle="", marker="o", markersize=9, color=grey, label="end"),
    ]


def draw_vehicle(
    axis: Any,  # noqa: ANN401 (matplotlib)
    ego: Mesh,
    *,
    from_side: bool = False,
    is_outline: bool = False,
) -> None:
    """Draw a vehicle as a silhouette in one flat colour, x pointing right: from above, or with z up.

    As an outline it is a few lines (`silhouette_m`) with a border, else all triangles.
    """
    from matplotlib.collections import PolyCollection

    if is_outline:
        _draw_outline(axis, silhouette_m(ego, np.eye(3)[0], np.eye(3)[2 if from_side else 1]))
        axis.autoscale_view()
        return
    corner_m = np.asarray(ego.vertex_m)[np.asarray(ego.triangle)][:, :, [0, 2] if from_side else [0, 1]]
    colour = hex_colour(GRID_RGB)
    axis.add_collection(PolyCollection(list(corner_m), facecolors=colour, edgecolors=colour, linewidths=0.6, zorder=1))
    axis.autoscale_view()


def _draw_outline(axis: Any, lines: Sequence[np.ndarray]) -> None:  # noqa: ANN401 (matplotlib)
    """Fill closed lines, and their holes not, in the flat colour of vehicles with a border."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    closed = [Outline(np.vstack([line, line[:1]]), closed=True) for line in lines]
    style = {"facecolor": hex_colour(GRID_RGB), "edgecolor": hex_colour(MUTED_RGB), "linewidth": 0.9, "zorder": 1}
    axis.add_patch(PathPatch(Outline.make_compound_path(*closed), **style))


def draw_height_map(axis: Any, mount_surface: MountSurface, *, colours: Any) -> Any:  # noqa: ANN401 (matplotlib)
    """Draw a height map from above, x pointing right; cells that are NaN stay empty. Returns matplotlib's image."""
    low, high = np.asarray(mount_surface.bounds_m, dtype=np.float64)
    half = mount_surface.cell_m / 2.0
    return axis.imshow(
        np.asarray(mount_surface.height_m).T,
        origin="lower",
        extent=(low[0] - half, high[0] + half, low[1] - half, high[1] + half),
        cmap=colours,
        zorder=2,
        interpolation="nearest",
    )


def draw_zone_border(axis: Any, mount_surface: MountSurface) -> None:  # noqa: ANN401 (matplotlib)
    """Draw the border of the mountable zone from above, x pointing right."""
    rows, columns = mount_surface.height_m.shape
    x_m, y_m = (
        start + mount_surface.cell_m * np.arange(-1, n + 1)
        for start, n in zip(mount_surface.origin_m, (rows, columns), strict=True)
    )
    distance_m = mount_surface.zone_distance_m(np.stack(np.meshgrid(x_m, y_m, indexing="xy"), axis=-1))
    axis.contour(x_m, y_m, distance_m, levels=[0.0], colors=hex_colour(INK_RGB), linewidths=1.0, zorder=3)


def draw_bounds(axis: Any, bounds_m: np.ndarray) -> None:  # noqa: ANN401 (matplotlib)
    """Draw the rectangle between two corners [m], shape [2, 2], from above, x pointing right."""
    from matplotlib.patches import Rectangle

    low, high = bounds_m
    axis.add_patch(Rectangle(low, *(high - low), fill=False, edgecolor=hex_colour(INK_RGB), linewidth=1.0, zorder=3))


def pale_map() -> Any:  # noqa: ANN401 (matplotlib)
    """Greys that leave room for the colours of the cameras: low is light, high is darker."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("pale", ["#f4f6f9", "#a9b5c6"])


def blind_ground(
    blind_share: np.ndarray, title: str, *, cell_m: float, ego_bounds_m: np.ndarray, rig: Rig | None
) -> str:
    """Where no camera sees somebody, seen from above with the front up, as SVG.

    Args:
        blind_share: Share of the scenes in which no camera sees somebody on a cell, 0..1, NaN where nobody can stand;
            shape [row, column], rows run along x (forward), columns along y (left), around the middle of the vehicle.
        ego_bounds_m: Lowest and highest corner of the vehicle [m], shape [2, 3].
    """
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.patches import FancyBboxPatch

    colours = LinearSegmentedColormap.from_list(
        "blind", ["#eaf1f8", *(hex_colour(rgb) for rgb in ((240, 170, 150), COVERAGE_RGB[0], (120, 16, 20)))]
    )
    low_m, high_m = ego_bounds_m
    middle_m = 0.5 * (low_m + high_m)
    reach_m = 0.5 * cell_m * len(blind_share)

    def draw(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
        # rows are forward and shall point up, columns are left
        image = axis.imshow(
            blind_share[::-1, ::-1],
            cmap=colours,
            vmin=0.0,
            vmax=1.0,
            extent=(reach_m, -reach_m, -reach_m, reach_m),
            interpolation="nearest",
        )
        length_m, width_m = (high_m - low_m)[:2]
        body = FancyBboxPatch(
            (-width_m / 2 + 0.4, -length_m / 2 + 0.4),
            width_m - 0.8,
            length_m - 0.8,
            boxstyle="round,pad=0.4",
            facecolor="#c9d1db",
            edgecolor=hex_colour(INK_RGB),
            linewidth=0.8,
        )
        axis.add_patch(body)
        axis.plot([0.0, 0.0], [0.0, 0.5 * length_m], color=hex_colour(INK_RGB), linewidth=0.8)
        for index, camera in enumerate(rig.cameras if rig else ()):
            forward_m, left_m = camera.position_m[:2] - middle_m[:2]
            axis.plot(left_m, forward_m, "o", color=hex_colour(camera_rgb(index)), markersize=3.0)
        for radius_m in (5, 10, 15, 20):
            turn = np.linspace(0.0, 2.0 * math.pi, 181)
            axis.plot(radius_m * np.cos(turn), radius_m * np.sin(turn), color="#8a94a0", linewidth=0.5, alpha=0.7)
            axis.text(0.0, -radius_m, f"{radius_m} m", fontsize=6.5, ha="center", va="bottom", color="#4a5360")
        axis.set(xticks=[], yticks=[], title=title)
        axis.grid(visible=False)
        for side in axis.spines.values():
            side.set_visible(False)
        bar = axis.figure.colorbar(image, ax=axis, shrink=0.8, pad=0.02, aspect=26, format="{x:.0%}")
        bar.outline.set_visible(False)

    return svg_text(draw, 3.7)
