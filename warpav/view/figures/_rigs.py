"""Figures of the thesis: rigs side by side, the mount surface in stages, where vehicles stand."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh
from warpav.rig import MountSurface, Rig, measured_surface, mount_surface_from_mesh
from warpav.scene import EGO_INSTANCE, Box, Capture, ReconstructionSettings, fuse, object_mesh
from warpav.view._layers import SQUARE
from warpav.view._outlines import bearing_sector_rad, sector_polygon_m
from warpav.view._palette import INK_RGB, MISS_RGB, MUTED_RGB, TRUE_POSITIVE_RGB, camera_rgb, hex_colour
from warpav.view.figures._clouds import BACKGROUND_RGB, cloud_image, towards, view_of
from warpav.view.figures._from_above import (
    draw_cameras,
    draw_height_map,
    draw_vehicle,
    draw_zone_border,
    name_cameras,
    start_and_end_handles,
)
from warpav.view.figures._images import detection_handles, draw_detections
from warpav.view.figures._style import (
    PALE,
    WIDTH_INCH,
    caption,
    colour_bar,
    colour_map,
    count_text,
    empty_panel,
    figure_style,
    metre_axes,
    new_figure,
    panel_sizes_px,
    save_figure,
    show_image,
    title,
)

if TYPE_CHECKING:
    from warpav.optimisation import Constraints, RigObservation
    from warpav.scene import Scene

_IMAGES_A_ROW = 4
_SceneView: TypeAlias = "tuple[Scene, RigObservation]"
"""A scene, and what the cameras of a rig and the detector make of it."""
_HEAT = ("heat", "#2c4fa3", "#4fa3d1", "#f3e38a", "#ee7b35", "#a3121f", "#6b0612")
"""From blue, where vehicles are rare, to dark red, where most are; the thesis's colours."""


@dataclass(frozen=True, eq=False)
class OptimisedRig:
    """An optimisation of a rig, with its camera positions over the iterations [m], [iteration, camera, 3]."""

    start: Rig
    trajectory_m: np.ndarray
    end: Rig


def without_and_with_constraints(
    free: OptimisedRig,
    kept: OptimisedRig,
    path: Path | str,
    *,
    ego: Mesh,
    surface: MountSurface,
    constraints: Constraints,
    remark: str,
) -> Path:
    """Figure 10: the trajectories of the cameras over the vehicle, without constraints and with them."""
    from matplotlib.patches import Rectangle

    point_m = np.concatenate([ego.bounds_m(), *(run.trajectory_m.reshape(-1, 3) for run in (free, kept))])
    length_m, width_m = np.ptp(point_m[:, :2], axis=0)
    with figure_style():
        figure = new_figure(WIDTH_INCH, 1.9 + min(0.4 * WIDTH_INCH * length_m / width_m, 9.0))
        axes, image = figure.subplots(1, 2, sharex=True, sharey=True), None
        for axis, heading, run in zip(axes, ("Without constraints", "With constraints"), (free, kept), strict=True):
            draw_vehicle(axis, ego)
            image = draw_height_map(axis, surface, colours=colour_map(*PALE))
            if constraints.are_inequalities:
                draw_zone_border(axis, surface)
            else:
                low, high = surface.bounds_m
                style = {"fill": False, "edgecolor": hex_colour(INK_RGB), "linewidth": 1.0, "zorder": 3}
                axis.add_patch(Rectangle(low[::-1], *(high - low)[::-1], **style))
            draw_cameras(axis, run.end, rig_initial=run.start, trajectory_m=run.trajectory_m)
            excess_m = [constraints.violation_m(Rig([camera])) for camera in run.end.cameras]
            outside = int(np.count_nonzero(excess_m))
            result = f"{outside} of {len(excess_m)} cameras end outside"
            axis.set_title(heading)
            metre_axes(axis, up=axis is axes[0])
            axis.set_xlabel(f"y, left [m]\n{result}{f', by up to {max(excess_m):.2f} m' if outside else ''}")
        colour_bar(figure, image, axes, "height of the mount surface [m]", shrink=0.6)
        border = "border of the mountable zone" if constraints.are_inequalities else "bounds of the mount surface"
        text = f"{remark} Black: {border}. Without: all multipliers stay 0."
        _legend(figure, start_and_end_handles(), text)
        return save_figure(figure, path)


def before_and_after(rows: Mapping[str, tuple[Rig, Sequence[_SceneView]]], path: Path | str) -> Path:
    """Figure 11: what rigs see of scenes: all road users from above, and the fullest scene through every camera."""
    columns = 1 + max(len(rig.cameras) for rig, _ in rows.values())
    with figure_style():
        figure = new_figure(2.45 * columns, 9.2)
        figure.get_layout_engine().set(h_pad=0.08)
        grid = figure.subplots(len(rows), columns, squeeze=False)
        for (heading, (rig, views)), axes in zip(rows.items(), grid, strict=True):
            _draw_plan(axes[0], rig, views)
            axes[0].set_ylabel(heading, fontweight="bold", fontsize=11)
            _draw_images(axes[1:], rig, views)
        text = "Left: all vehicles of the scenes from above, and the cameras' fields of view. "
        text += "Right: the one of these scenes with most vehicles, through every camera."
        _legend(figure, detection_handles(), text)
        return save_figure(figure, path)


def highest_rig(rig: Rig, views: Sequence[_SceneView], path: Path | str, *, surface: MountSurface) -> Path:
    """Figure 12: the rig around the vehicle's highest point, its sectors, and what it finds in scenes."""
    ego = views[0][0].ego
    image_rows = math.ceil(len(rig.cameras) / _IMAGES_A_ROW)
    with figure_style():
        figure = new_figure(WIDTH_INCH, 5.0 + 2.35 * image_rows)
        upper, lower = figure.subfigures(2, 1, height_ratios=[4.2, 2.35 * image_rows])
        near, around = upper.subplots(1, 2, width_ratios=[1.15, 1.0])
        draw_vehicle(near, ego)
        draw_height_map(near, surface, colours=colour_map(*PALE))
        draw_cameras(near, rig, sector_radius_m=1.2)
        name_cameras(near, rig)
        title(near, "Cameras around the highest point")
        _draw_plan(around, rig, views)
        axes = lower.subplots(image_rows, _IMAGES_A_ROW, squeeze=False).flat
        for axis in axes[len(rig.cameras) :]:
            axis.set_axis_off()
        _draw_images(axes[: len(rig.cameras)], rig, views)
        covered_deg = math.degrees(covered_rad(rig))
        _legend(
            figure,
            detection_handles(),
            f"Right: all vehicles of {count_text(len(views), 'test scenes')} from above. The fields of view cover "
            f"{covered_deg:.0f} of 360 degrees.\nBelow: the one of these scenes with most vehicles.",
        )
        return save_figure(figure, path)


def covered_rad(rig: Rig) -> float:
    """Angle of all bearings that lie in some camera's field of view [rad], 0 to 2 pi."""
    ranges = []
    for right, left in (bearing_sector_rad(camera) for camera in rig.cameras):
        first = right % (2.0 * math.pi)
        end = first + (left - right)
        ranges += [(first, min(end, 2.0 * math.pi)), (0.0, max(end - 2.0 * math.pi, 0.0))]
    covered, reached = 0.0, 0.0
    for first, end in sorted(ranges):
        covered += max(end - max(first, reached), 0.0)
        reached = max(reached, end)
    return covered


def _draw_images(axes: Sequence[Any], rig: Rig, views: Sequence[_SceneView]) -> None:
    _, observation = max(views, key=lambda view: len(view[0].vehicles))
    for k, (axis, camera, seen) in enumerate(zip(axes, rig.cameras, observation.cameras, strict=True)):
        draw_detections(axis, camera.name, seen)
        axis.set(xticks=[], yticks=[])
        axis.grid(visible=False)
        for spine in axis.spines.values():
            spine.set(visible=True, color=hex_colour(camera_rgb(k)), linewidth=2.0)


def _draw_plan(axis: Any, rig: Rig, views: Sequence[_SceneView]) -> None:  # noqa: ANN401 (matplotlib)
    boxes = [vehicle.box for scene, _ in views for vehicle in scene.vehicles]
    is_found = np.concatenate([observation.detected for _, observation in views])
    reach_m = max((np.abs(box.corners_m()[:, :2]).max() for box in boxes), default=20.0)
    reach_m = 5.0 * math.ceil(reach_m / 5.0)
    draw_vehicle(axis, views[0][0].ego)
    for index, camera in enumerate(rig.cameras):
        outline = sector_polygon_m(camera, radius_m=1.5 * reach_m)  # to the corners of the panel
        axis.fill(*outline.T[::-1], color=hex_colour(camera_rgb(index)), alpha=0.13, linewidth=0, zorder=0)
    for box, found in zip(boxes, is_found, strict=True):
        colour = hex_colour(TRUE_POSITIVE_RGB if found else MISS_RGB)
        outline = box.corners_m()[[0, 4, 6, 2], 1::-1]
        axis.fill(*outline.T, facecolor=colour, alpha=0.35, linewidth=0, zorder=3)
        line = {"linestyle": "-", "zorder": 4} if found else {"linestyle": (0, (3, 2)), "zorder": 5}
        axis.fill(*outline.T, facecolor="none", edgecolor=colour, linewidth=0.9 if found else 1.3, **line)
    axis.set(xlim=(reach_m, -reach_m), ylim=(-reach_m, reach_m), aspect="equal")
    axis.grid(visible=False)
    axis.locator_params(nbins=4)
    axis.tick_params(labelsize=8)
    axis.set_xlabel("y, left [m]", fontsize=8)
    text = f"{int(is_found.sum())} of {len(is_found)} found in {count_text(len(views), 'scenes')}"
    axis.set_title(text, fontsize=9.5, fontweight="normal", pad=4)


def _legend(figure: Any, handles: Sequence[Any], text: str) -> None:  # noqa: ANN401 (matplotlib)
    legend = figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), title=text)
    legend.get_title().set(fontsize=9, color=hex_colour(MUTED_RGB), multialignment="center")


def mount_surface_stages(
    capture: Capture, path: Path | str, *, settings: ReconstructionSettings | None = None, cell_m: float = 0.02
) -> Path:
    """Figure 9: the ego vehicle's points with the height map on them, and how the map's holes are filled."""
    settings = settings or ReconstructionSettings()
    images = list(capture.images)
    cloud = fuse(dataclasses.replace(capture, vehicles=()), images, settings.cloud).ego
    if len(cloud.cloud) == 0:
        raise InputError(f"{capture.name}: expected images of the ego vehicle, got none")
    ego = object_mesh(cloud, images, EGO_INSTANCE, settings.ego, settings)
    maps = {
        "Measured": measured_surface(ego, cell_m=cell_m),
        "Filled": mount_surface_from_mesh(ego, cell_m=cell_m, smoothing_tolerance_m=math.inf),
        "Smoothed": mount_surface_from_mesh(ego, cell_m=cell_m),
    }
    surface = maps["Smoothed"]
    limits_m = float(surface.height_m.min()), float(surface.height_m.max())
    with figure_style():
        figure = new_figure(WIDTH_INCH, 5.5)
        axes = figure.subplots(1, 4)
        axes[0].set_title("Map and points")
        axes[0].set_xlabel(count_text(len(cloud.cloud)))
        empty_panel(axes[0])
        low_m, high_m = ego.bounds_m()[:, :2] + np.array([[-0.15], [0.15]])
        axes[0].set_box_aspect((high_m[0] - low_m[0]) / (high_m[1] - low_m[1]))
        image = None
        for axis, (text, one) in zip(axes[1:], maps.items(), strict=True):
            draw_vehicle(axis, ego)
            image = draw_height_map(axis, one, colours="viridis")
            image.set_clim(*limits_m)
            share = float(np.isfinite(one.height_m).mean())
            axis.set_title(f"{text}, {100.0 * share:.0f} %" if share < 1.0 else text)
            axis.set(xlim=(low_m[1], high_m[1]), ylim=(low_m[0], high_m[0]))
            metre_axes(axis, up=axis is axes[1])
        colour_bar(figure, image, axes, "height of the mount surface [m]", shrink=0.7)
        caption(
            figure,
            f"{capture.name}. Measured: what looks upwards, seen from above, in cells of {100.0 * cell_m:g} cm. "
            "Filled: other cells have the height of the nearest.\nSmoothed: until they no longer change.",
        )
        (size_px,) = panel_sizes_px(figure, axes[:1])
        viewpoint = view_of(cloud.cloud.point_m, towards(math.radians(38.0), math.radians(40.0)), size_px)
        parts = [cloud.cloud, _coloured(surface, limits_m)]
        style = {"size_px": size_px, "point_px": 1.6, "cover": 1.0, "background_rgb": BACKGROUND_RGB}
        show_image(axes[0], cloud_image(parts, viewpoint, **style))
        return save_figure(figure, path)


def _coloured(surface: MountSurface, limits_m: tuple[float, float]) -> Mesh:
    import matplotlib

    height_m = surface.height_m.astype(np.float64)
    share = (height_m - limits_m[0]) / max(limits_m[1] - limits_m[0], 1e-9)
    rgb = np.rint(255.0 * matplotlib.colormaps["viridis"](np.clip(share, 0.0, 1.0))[..., :3]).astype(np.uint8)
    place_m = surface.origin_m + surface.cell_m * np.moveaxis(np.indices(height_m.shape), 0, -1)
    centre = np.concatenate([place_m, height_m[..., None] + 0.02], axis=-1)  # clear of the points that it was made of
    corner = centre.reshape(-1, 1, 3) + surface.cell_m * np.column_stack([SQUARE, np.zeros(4)])
    first = 4 * np.arange(height_m.size)[:, None]
    triangle = np.concatenate([first + np.array(half) for half in ([0, 1, 2], [0, 2, 3])])
    return Mesh(corner.reshape(-1, 3), triangle, np.repeat(rgb.reshape(-1, 3), 4, axis=0))


def heat_maps(
    collections: Mapping[str, Sequence[Sequence[Box]]],
    path: Path | str,
    *,
    ego_box: Box,
    radius_m: float | None = None,
    cell_m: float = 0.25,
) -> Path:
    """Figure 8: how often a vehicle stands where around the ego vehicle, one map for each collection."""
    if radius_m is None:
        corners = [np.abs(box.corners_m()[:, :2]).max() for part in collections.values() for s in part for box in s]
        radius_m = 5.0 * math.ceil(max(corners, default=20.0) / 5.0)
    share = {name: vehicle_occupancy(part, radius_m=radius_m, cell_m=cell_m) for name, part in collections.items()}
    with figure_style():
        figure = new_figure(WIDTH_INCH, 1.45 + (WIDTH_INCH - 0.9) / len(share))
        axes = figure.subplots(1, len(share), sharey=True, squeeze=False)[0]
        for axis, (name, one) in zip(axes, share.items(), strict=True):
            shown = np.where(one > 0.0, 100.0 * one, np.nan)[::-1, ::-1]
            extent = (radius_m, -radius_m, -radius_m, radius_m)
            style = {"cmap": colour_map(*_HEAT), "vmin": 0.0, "vmax": 100.0 * max(float(one.max()), 1e-9)}
            image = axis.imshow(shown, extent=extent, interpolation="nearest", zorder=2, **style)
            x, y = ego_box.corners_m()[[0, 4, 6, 2], :2].T
            axis.fill(y, x, color=hex_colour(INK_RGB), linewidth=0, zorder=3)
            vehicles = count_text(sum(len(boxes) for boxes in collections[name]), "vehicles")
            title(axis, name.title(), f"{count_text(len(collections[name]), 'scenes')}, {vehicles}")
            axis.set_xlabel("y, left [m]")
            axis.locator_params(nbins=4)
            colour_bar(figure, image, axis, "scenes with a vehicle there [%]", orientation="horizontal")
        axes[0].set_ylabel("x, forward [m]")
        caption(figure, "Black: the ego vehicle. White: no vehicle in any scene. Every map has a scale of its own.")
        figure.get_layout_engine().set(w_pad=0.1)
        return save_figure(figure, path)


def vehicle_occupancy(scenes: Sequence[Sequence[Box]], *, radius_m: float, cell_m: float) -> np.ndarray:
    """Share of the scenes in which a vehicle's box covers the middle of a cell, 0..1, [row, column].

    Rows run along x, columns along y, both from ``-radius_m``.
    """
    if not scenes:
        raise InputError("a heat map needs at least one scene, got 0")
    count = math.ceil(2.0 * radius_m / cell_m)
    centre = -radius_m + (np.arange(count) + 0.5) * cell_m
    point_m = np.stack([*np.meshgrid(centre, centre, indexing="ij"), np.zeros((count, count))], axis=-1).reshape(-1, 3)
    total = np.zeros(count * count)
    for boxes in scenes:
        covered = np.zeros(count * count, bool)
        for box in boxes:
            covered |= box.contains(point_m + np.array([0.0, 0.0, box.center_m[2]]))
        total += covered
    return total.reshape(count, count) / len(scenes)
