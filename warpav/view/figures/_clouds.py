"""Point clouds and meshes of a capture: the stages (figure 5), the sphere (6) and the window filter (7)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh
from warpav.scene import (
    EGO_INSTANCE,
    ENVIRONMENT_INSTANCE,
    Box,
    Capture,
    CloudSettings,
    PointCloud,
    ReconstructionSettings,
    first_in_cells,
    fuse,
    joined,
    reconstruct,
    split_at_radius,
    thin_out,
    unproject,
)
from warpav.view._layers import mesh_to_pyvista
from warpav.view._opengl import load_pyvista
from warpav.view._palette import PAPER_RGB, Rgb, camera_rgb, hex_colour
from warpav.view.figures._style import (
    DOTS_PER_INCH,
    WIDTH_INCH,
    caption,
    count_text,
    empty_panel,
    figure_style,
    new_figure,
    panel_sizes_px,
    save_figure,
    show_image,
    title,
)

BACKGROUND_RGB: Rgb = (214, 205, 230)
"""Where an image shows nothing: not the colour of a vehicle, a road or the sky."""

_SUPERSAMPLING = 2
_BOX_LINE_PX = 1.6
_LARGEST_PX = 10.0  # of a point
_SPACING_SAMPLES = 2000
_SKY_DEPTH_M = 1000.0  # where CARLA's depth images put the sky
_STRAY_REACH_M = 9.0  # of what was seen through a vehicle's panes, so much is drawn
_STREET_HEIGHT_M = 3.0  # what is higher would hide the street
_GAINED_RGB, _LOST_RGB = camera_rgb(0), camera_rgb(3)

_Parts = Sequence[PointCloud | Mesh]


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """From where an image is drawn, in the ego frame [m]; with a height [m] without perspective."""

    position_m: np.ndarray
    target_m: np.ndarray
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    height_rad: float = math.radians(50.0)
    height_m: float | None = None


def cloud_image(
    parts: _Parts,
    viewpoint: Viewpoint,
    *,
    size_px: tuple[int, int],
    point_px: float = 1.5,
    cover: float = 0.0,
    boxes: Sequence[Box] = (),
    background_rgb: Rgb = PAPER_RGB,
) -> np.ndarray:
    """Draw clouds and meshes in their own colours without a window, uint8 [row, column, 3].

    Points are at least so large; with ``cover`` so many of the distances between them.
    """
    from PIL import Image

    pyvista = load_pyvista()
    drawn_px = [_SUPERSAMPLING * size for size in size_px]
    plotter = pyvista.Plotter(off_screen=True, window_size=drawn_px, lighting="none")
    coloured = {"scalars": "RGB", "rgb": True, "lighting": False}
    try:
        plotter.set_background(hex_colour(background_rgb))
        for part in parts:
            if isinstance(part, Mesh):
                if len(part.triangle):
                    plotter.add_mesh(mesh_to_pyvista(part), **coloured)
            elif len(part):
                for chosen, drawn_point_px in _by_size(part, viewpoint, size_px[1], point_px, cover):
                    points = pyvista.PolyData(part.point_m[chosen])
                    points.point_data["RGB"] = part.rgb[chosen]
                    plotter.add_mesh(points, style="points", point_size=drawn_point_px * _SUPERSAMPLING, **coloured)
        for box in boxes:
            first, second = np.triu_indices(8, 1)
            is_edge = np.isin(first ^ second, (1, 2, 4))  # corners are numbered in binary
            lines = np.stack([np.full(is_edge.sum(), 2), first[is_edge], second[is_edge]], axis=1)
            wires = pyvista.PolyData(box.corners_m(), lines=lines.ravel())
            plotter.add_mesh(wires, color=camera_rgb(1), line_width=_BOX_LINE_PX * _SUPERSAMPLING, lighting=False)
        plotter.camera_position = [tuple(viewpoint.position_m), tuple(viewpoint.target_m), viewpoint.up]
        if viewpoint.height_m is None:
            plotter.camera.view_angle = math.degrees(viewpoint.height_rad)
        else:
            plotter.enable_parallel_projection()
            plotter.camera.parallel_scale = 0.5 * viewpoint.height_m
        plotter.camera_set = True
        plotter.reset_camera_clipping_range()
        drawn = Image.fromarray(np.ascontiguousarray(plotter.screenshot(return_img=True)))
        return np.asarray(drawn.resize(size_px, Image.Resampling.LANCZOS))
    finally:
        plotter.close()


def towards(bearing_rad: float, elevation_rad: float) -> np.ndarray:
    """Unit vector of a direction in the ego frame, shape [3]."""
    level = math.cos(elevation_rad)
    return np.array([level * math.cos(bearing_rad), level * math.sin(bearing_rad), math.sin(elevation_rad)])


def view_of(point_m: np.ndarray, direction: np.ndarray, size_px: tuple[int, int]) -> Viewpoint:
    """Without perspective, just so that all points [point, 3] are in the image."""
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= np.linalg.norm(right)
    above = np.cross(direction, right)
    low, high = (reduce(point_m @ np.stack([right, above], axis=1), axis=0) for reduce in (np.min, np.max))
    middle, (width_m, height_m) = 0.5 * (low + high), high - low
    target_m = middle[0] * right + middle[1] * above + np.median(point_m @ direction) * direction
    height_m = 1.08 * max(width_m * size_px[1] / size_px[0], height_m)
    return Viewpoint(target_m + 150.0 * direction, target_m, height_m=height_m)


def _by_size(
    cloud: PointCloud, viewpoint: Viewpoint, height_px: int, point_px: float, cover: float
) -> Iterator[tuple[np.ndarray, float]]:
    """Indices of the points of each size, and the size [px], in steps of half a doubling."""
    every = np.arange(len(cloud))
    if cover <= 0.0:
        yield every, point_px
        return
    some_m = cloud.point_m[:: -(-len(cloud) // _SPACING_SAMPLES)]
    distance_m, _ = KDTree(cloud.point_m).query(some_m, k=2)
    edge_m = cover * float(np.median(distance_m[:, 1])) if len(cloud) > 1 else 0.0
    if viewpoint.height_m is not None:
        yield every, float(np.clip(edge_m * height_px / viewpoint.height_m, point_px, _LARGEST_PX))
        return
    depth_m = np.linalg.norm(cloud.point_m - np.asarray(viewpoint.position_m, np.float32), axis=1)
    focal_px = 0.5 * height_px / math.tan(0.5 * viewpoint.height_rad)
    wanted_px = np.clip(focal_px * edge_m / np.maximum(depth_m, 1e-3), point_px, _LARGEST_PX)
    step = np.round(2.0 * np.log2(wanted_px / point_px)).astype(int)
    for one in np.unique(step):
        yield np.flatnonzero(step == one), point_px * 2.0 ** (0.5 * one)


def stages(capture: Capture, path: Path | str, *, settings: ReconstructionSettings | None = None) -> Path:
    """Figure 5: the stages from images to meshes, from behind the ego vehicle, with the thesis's numbers 4 to 9.

    Its stages 1 to 3 happen inside a simulator: a capture does not know them.
    """
    settings = settings or ReconstructionSettings()
    capture = dataclasses.replace(capture, images=list(capture.images))
    how = settings.cloud
    sky_m = np.float32(max(_SKY_DEPTH_M, how.far_depth_m))
    whole = (
        dataclasses.replace(image, depth_m=np.where(np.isfinite(image.depth_m), image.depth_m, sky_m))
        for image in capture.images
    )
    everything = joined([unproject(image, far_depth_m=math.inf)[0] for image in whole])
    nearer = joined([unproject(image, far_depth_m=how.far_depth_m)[0] for image in capture.images])
    environment, objects = _without_limits(capture, how)
    near, moved = split_at_radius(environment, how.radius_m)
    low, low_moved = (cloud.below(how.max_height_m) for cloud in (near, moved))
    budgets = [settings.environment, settings.ego, *[settings.vehicle] * (len(objects) - 1)]
    thinned = [
        cloud.chosen(thin_out(cloud.point_m, budget.point_count, seed=settings.seed))
        for cloud, budget in zip((low, *objects), budgets, strict=True)
    ]
    scene = reconstruct(capture, settings)
    panels: dict[str, tuple[_Parts, float]] = {
        "(4) With vehicles": ([everything], 0.0),
        "(5) Without far points": ([nearer], 0.0),
        f"(6) Sphere beyond {how.radius_m:g} m": ([near, moved, *objects], 1.6),
        f"(7) Nothing above {how.max_height_m:g} m": ([low, low_moved, *objects], 1.6),
        "(8) Downsampled": ([*thinned, low_moved], 0.8),
        "(9) Triangle meshes": ([scene.environment, scene.ego, *(vehicle.mesh for vehicle in scene.vehicles)], 0.0),
    }
    viewpoint = _behind(capture.ego_box, environment)
    with figure_style():
        figure = new_figure(WIDTH_INCH, 10.4)
        axes = list(figure.subplots(3, 2).flat)
        for axis, (text, (parts, _)) in zip(axes, panels.items(), strict=True):
            counts = [len(part.triangle) if isinstance(part, Mesh) else len(part) for part in parts]
            title(axis, text, count_text(sum(counts), "triangles" if isinstance(parts[0], Mesh) else "points"))
            empty_panel(axis)
        caption(
            figure,
            f"{capture.name}. Stages (1) to (3), the place as it is, without vegetation, in clear weather with the sun "
            "overhead, happen in the simulator.\n"
            f"In (4) the sky lies at {_SKY_DEPTH_M:g} m. From (6) on panes are filtered as in figure 7, and of the "
            f"environment one point in every {100.0 * how.environment_grid_m:g} cm is kept.\n"
            "Plain lilac: no image shows anything there.",
        )
        style = {"point_px": 1.6, "background_rgb": BACKGROUND_RGB}
        for axis, size_px, (parts, cover) in zip(axes, panel_sizes_px(figure, axes), panels.values(), strict=True):
            show_image(axis, cloud_image(parts, viewpoint, size_px=size_px, cover=cover, **style))
        return save_figure(figure, path)


def _without_limits(capture: Capture, settings: CloudSettings) -> tuple[PointCloud, list[PointCloud]]:
    whole = dataclasses.replace(settings, radius_m=math.inf, max_height_m=math.inf)
    clouds = fuse(capture, list(capture.images), whole)
    return clouds.environment, [one.cloud for one in (clouds.ego, *clouds.vehicles)]


def sphere(capture: Capture, path: Path | str, *, settings: CloudSettings | None = None) -> Path:
    """Figure 6: the point cloud from above, without and with the sphere."""
    settings = settings or CloudSettings()
    around, objects = _without_limits(capture, settings)
    near, moved = split_at_radius(around, settings.radius_m)
    reach_m = 1.05 * max(float(np.abs(around.point_m[:, :2]).max(initial=1.0)), settings.radius_m)
    edge_px = int(DOTS_PER_INCH * 0.43 * WIDTH_INCH)
    viewpoint = Viewpoint(np.array([0.0, 0.0, 500.0]), np.zeros(3), up=(1.0, 0.0, 0.0), height_m=2.0 * reach_m)
    turn = np.linspace(0.0, 2.0 * math.pi, 241)
    circle = settings.radius_m * np.stack([np.sin(turn), np.cos(turn)])
    panels = {"Without the sphere": [around, *objects], "With the sphere": [near, moved, *objects]}
    with figure_style():
        figure = new_figure(WIDTH_INCH, 5.05)
        axes = figure.subplots(1, 2, sharey=True)
        for axis, (text, parts) in zip(axes, panels.items(), strict=True):
            image = cloud_image(parts, viewpoint, size_px=(edge_px, edge_px), point_px=1.2, cover=1.0)
            axis.imshow(image, extent=(reach_m, -reach_m, -reach_m, reach_m), interpolation="antialiased")
            axis.plot(*circle, color=hex_colour(camera_rgb(1)), linewidth=1.3, linestyle=(0, (5, 3)))
            axis.grid(visible=False)
            extent_m = np.ptp(joined(parts).point_m, axis=0)
            title(axis, text, " x ".join(f"{length:.0f}" for length in extent_m) + " m")
            axis.set_xlabel("y, left [m]")
        axes[0].set_ylabel("x, forward [m]")
        size = f"length x width x height of the cloud. Dashed: the radius of {settings.radius_m:g} m."
        caption(figure, f"{capture.name} from above; {size}")
        return save_figure(figure, path)


@dataclass(frozen=True, eq=False)
class _WindowClouds:
    """What the rule of the 3D boxes does to points that were seen through window panes."""

    shown: tuple[PointCloud, ...]
    boxed: tuple[PointCloud, ...]
    outside: tuple[PointCloud, ...]
    around: PointCloud
    lost: PointCloud
    gained: PointCloud
    environment: PointCloud


def window_clouds(capture: Capture, settings: CloudSettings) -> _WindowClouds:
    """The points of a capture before and after the rule of the 3D boxes."""
    images, margin_m = list(capture.images), settings.box_margin_m
    boxes = {EGO_INSTANCE: capture.ego_box, **{one.instance_id: one.box for one in capture.vehicles}}
    shown: dict[int, list[PointCloud]] = {one: [] for one in boxes}
    thinned, lost, gained = [], [], []
    for image in images:
        cloud, instance, _, _ = unproject(image, far_depth_m=settings.far_depth_m)
        around = cloud.chosen(instance == ENVIRONMENT_INSTANCE)
        thinned.append(around.chosen(first_in_cells(around.point_m, settings.environment_grid_m)))
        lost.append(around.chosen(_in_any(boxes.values(), around, -margin_m)))
        for one, box in boxes.items():
            shown[one].append(cloud.chosen(instance == one))
            stray = shown[one][-1]
            stray = stray.chosen(~box.contains(stray.point_m, margin_m=margin_m))
            gained.append(stray.chosen(~_in_any(boxes.values(), stray, -margin_m)))
    whole = [joined(shown[one.instance_id]) for one in capture.vehicles]
    pairs = zip(capture.vehicles, whole, strict=True)
    boxed = [cloud.chosen(one.box.contains(cloud.point_m, margin_m=margin_m)) for one, cloud in pairs]
    around, clouds = joined(thinned), fuse(capture, images, settings)
    return _WindowClouds(
        tuple(whole),
        tuple(boxed),
        tuple(one.cloud for one in clouds.vehicles),
        around.chosen(first_in_cells(around.point_m, settings.environment_grid_m)),
        joined(lost),
        joined(gained),
        clouds.environment,
    )


def window_filter(
    capture: Capture, path: Path | str, *, instance_id: int | None = None, settings: CloudSettings | None = None
) -> Path:
    """Figure 7: the rule of the 3D boxes for points that were seen through window panes, in both directions.

    Above, all vehicles without and with it; in the middle, one of them; below, the environment.
    """
    settings = settings or CloudSettings()
    known = [vehicle.instance_id for vehicle in capture.vehicles]
    if not known or (instance_id is not None and instance_id not in known):
        raise InputError(f"{capture.name}: expected a vehicle of it, got {'none' if not known else instance_id}")
    clouds = window_clouds(capture, settings)
    boxes = [vehicle.box for vehicle in capture.vehicles]
    strays_m = [
        cloud.point_m[
            ~box.contains(cloud.point_m, margin_m=settings.box_margin_m)
            & (np.linalg.norm(cloud.point_m - box.center_m, axis=1) < _STRAY_REACH_M)
        ]
        for cloud, box in zip(clouds.shown, boxes, strict=True)
    ]
    chosen = int(np.argmax([len(one) for one in strays_m])) if instance_id is None else known.index(instance_id)
    box, name = boxes[chosen], f"Vehicle {known[chosen]}"
    sight = box.center_m - capture.ego_box.center_m  # from beside it, what lies behind panes is not hidden by them
    oblique = towards(math.atan2(sight[1], sight[0]) + math.radians(142.0), math.radians(27.0))
    high = towards(capture.ego_box.yaw_rad + math.radians(200.0), math.radians(48.0))
    every_m = np.concatenate([*(one.corners_m() for one in (capture.ego_box, *boxes)), *strays_m])
    shown_m = np.concatenate([box.corners_m(), strays_m[chosen]])
    low_m, high_m = every_m.min(axis=0) - 2.0, [*(every_m.max(axis=0)[:2] + 2.0), _STREET_HEIGHT_M]

    def street(cloud: PointCloud) -> PointCloud:
        """What of the environment stands between the vehicles."""
        return cloud.chosen(((cloud.point_m > low_m) & (cloud.point_m < high_m)).all(axis=1))

    def painted(cloud: PointCloud, rgb: Rgb, share: float = 1.0) -> PointCloud:
        mixed = np.rint((1.0 - share) * cloud.rgb + share * np.array(rgb)).astype(np.uint8)
        return dataclasses.replace(cloud, rgb=mixed)

    before, after = (painted(street(one), PAPER_RGB, 0.45) for one in (clouds.around, clouds.environment))
    lost, gained = (
        street(painted(cloud.chosen(first_in_cells(cloud.point_m, settings.environment_grid_m)), rgb))
        for cloud, rgb in ((clouds.lost, _LOST_RGB), (clouds.gained, _GAINED_RGB))
    )
    one_shown, one_boxed, one_outside = ([part[chosen]] for part in (clouds.shown, clouds.boxed, clouds.outside))
    whole, single, around = (boxes, every_m, high, 1.5), ([box], shown_m, oblique, 1.5), (boxes, every_m, high, 2.5)
    with figure_style():
        figure = new_figure(WIDTH_INCH, 9.8)
        grid = figure.add_gridspec(3, 6, height_ratios=[1.0, 0.8, 1.0])
        panels: list[tuple[Any, str, str, _Parts, tuple[Any, ...]]] = [
            (grid[0, :3], "Instance images alone", _counted(clouds.shown), clouds.shown, whole),
            (grid[0, 3:], "Inside the 3D boxes", _counted(clouds.boxed), clouds.boxed, whole),
            (grid[1, :2], name, _counted(one_shown), one_shown, single),
            (grid[1, 2:4], "Inside its box", _counted(one_boxed), one_boxed, single),
            (grid[1, 4:], "Its outside", _counted(one_outside), one_outside, single),
            (grid[2, :3], "Environment alone", f"{_counted([clouds.lost])} in boxes", [before, lost], around),
            (grid[2, 3:], "With what panes show", f"{_counted([clouds.gained])} more", [after, gained], around),
        ]
        for panel, text, remark, *_ in panels:
            axis = figure.add_subplot(panel)
            title(axis, text, remark)
            empty_panel(axis)
        caption(
            figure,
            f"{capture.name}. Orange: 3D boxes. Middle: {name.lower()} ({capture.vehicles[chosen].category}); what its "
            "panes show of its own inside goes as well.\n"
            f"Below: the environment up to {_STREET_HEIGHT_M:g} m; magenta: its points inside boxes, which go; blue: "
            "points seen through panes, which come to it.",
        )
        sizes_px = panel_sizes_px(figure, figure.axes)
        for axis, size_px, (*_, parts, how) in zip(figure.axes, sizes_px, panels, strict=True):
            wires, point_m, direction, point_px = how
            style = {"size_px": size_px, "point_px": point_px, "cover": 1.3, "boxes": wires}
            show_image(axis, cloud_image(parts, view_of(point_m, direction, size_px), **style))
        return save_figure(figure, path)


def _counted(clouds: Iterable[PointCloud]) -> str:
    return count_text(sum(map(len, clouds)))


def _in_any(boxes: Iterable[Box], cloud: PointCloud, margin_m: float) -> np.ndarray:
    return np.any(
        [np.zeros(len(cloud), bool), *(box.contains(cloud.point_m, margin_m=margin_m) for box in boxes)], axis=0
    )


def _behind(ego_box: Box, around: PointCloud) -> Viewpoint:
    elevation_rad, distance_m = math.radians(24.0), 21.0
    target_m = ego_box.center_m + np.array([0.0, 0.0, 0.5])
    point_m = around.point_m.astype(np.float64) - target_m
    best = (math.inf, 0.0)
    for turn_deg in (180, 170, 190, 160, 200, 0, 10, -10, 20, -20, 45, -45, 135, -135, 90, -90):
        bearing_rad = ego_box.yaw_rad + math.radians(turn_deg)
        direction = towards(bearing_rad, elevation_rad)
        along = point_m @ direction
        beside_m = np.linalg.norm(point_m - along[:, None] * direction, axis=1)
        is_between = (along > 4.0) & (along < distance_m + 4.0) & (beside_m < 1.0 + 0.1 * along)
        hidden = int((is_between & (point_m[:, 2] > 0.5)).sum())
        if hidden < best[0]:
            best = (hidden, bearing_rad)
        if hidden == 0:
            break
    ahead = np.array([math.cos(best[1]), math.sin(best[1]), 0.0])
    return Viewpoint(
        target_m + distance_m * towards(best[1], elevation_rad), target_m - 14.0 * ahead, height_rad=math.radians(56.0)
    )
