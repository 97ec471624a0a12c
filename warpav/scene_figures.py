"""The thesis's figures of traffic scenes, drawn from captures and collections: 4 to 9, and 14 to 16.

Every function draws one figure, writes it and returns its path.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpav.capture.capture import EGO_INSTANCE, ENVIRONMENT_INSTANCE, Capture, CapturedImage, ViewKind
from warpav.capture.folder import read_capture
from warpav.capture.plan import PlanSettings, capture_plan, spawn_visible_traffic
from warpav.capture.town_simulator import TownSimulator
from warpav.collection import scene_path, split_seeds
from warpav.errors import InputError
from warpav.figures import (
    DOTS_PER_INCH,
    WIDTH_INCH,
    draw_height_map,
    draw_vehicle,
    figure_style,
    new_figure,
    save_figure,
)
from warpav.geometry.mesh import Mesh
from warpav.geometry.mount_surface import MountSurface, measured_surface, mount_surface_from_mesh
from warpav.reconstruction.point_cloud import PointCloud, fuse, is_outside, joined, split_at_radius, unproject
from warpav.reconstruction.reconstruct import object_mesh, reconstruct
from warpav.reconstruction.settings import CloudSettings, ReconstructionSettings
from warpav.reconstruction.surface import thin_out
from warpav.scene.glb import read_scene
from warpav.scene.scene import Box
from warpav.view.cloud_view import Viewpoint, cloud_picture
from warpav.view.palette import GRID_RGB, INK_RGB, MUTED_RGB, PAPER_RGB, Rgb, camera_rgb, hex_colour

CAPTURE_NUMBERS = (4, 5, 6, 7, 9, 14, 15, 16)
"""Figures of one capture, by their numbers in the thesis."""
COLLECTION_NUMBER = 8
"""The figure of a collection of scenes."""

KIND_RGB: Mapping[ViewKind, Rgb] = {
    ViewKind.EGO_TOP: (240, 126, 22),
    ViewKind.TOWARDS_VEHICLE: (244, 200, 32),
    ViewKind.VEHICLE_TOP: (52, 168, 83),
    ViewKind.SCENE_TOP: (36, 107, 224),
    ViewKind.ROTATION: (122, 86, 214),
    ViewKind.OTHER: MUTED_RGB,
}
"""Frames of the images of a capture: orange, yellow, green, blue and purple as in the thesis's appendix."""
_KIND_TEXT = {
    ViewKind.EGO_TOP: "over the ego vehicle",
    ViewKind.TOWARDS_VEHICLE: "towards another vehicle",
    ViewKind.VEHICLE_TOP: "over another vehicle",
    ViewKind.SCENE_TOP: "over the place",
    ViewKind.ROTATION: "all around",
    ViewKind.OTHER: "other",
}
_SKY_RGB = (214, 226, 240)
_ENVIRONMENT_RGB = (214, 218, 224)
_DEPTH_COLOURS = "viridis_r"
_DEPTH_TICKS_M = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_SKY_DEPTH_M = 1000.0  # where CARLA's depth images put the sky
_SHEET_COLUMNS = 6
_STRAY_REACH_M = 9.0  # of what was seen through a vehicle's panes, so much is drawn
_NOTABLE_SHARE = 0.002  # of an image's pixels: less of a vehicle is not worth showing


def draw_figure(
    number: int,
    path: Path | str,
    *,
    seed: int | None = None,
    capture_folder: Path | None = None,
    scenes_folder: Path | None = None,
) -> Path:
    """Draw a figure by its number in the thesis.

    Args:
        number: 4 to 9, or 14 to 16.
        path: PNG file to write.
        seed: Situation of the embedded town to record for it; 3 when there is no capture either.
        capture_folder: Instead, a capture.
        scenes_folder: For figure 8: the folder of scenes to count.

    Raises:
        InputError: Another number, inputs that do not go with it, or inputs that cannot be used.
    """
    path = checked_png(path)
    if number == COLLECTION_NUMBER:
        if scenes_folder is None or seed is not None or capture_folder is not None:
            raise InputError(f"figure {number}: expected --scenes with a folder of scenes and nothing else")
        return collection_heat_maps(scenes_folder, path)
    if number not in CAPTURE_NUMBERS:
        known = ", ".join(map(str, sorted((*CAPTURE_NUMBERS, COLLECTION_NUMBER))))
        raise InputError(f"figure: expected one of {known}, got {number}")
    if scenes_folder is not None:
        raise InputError(f"figure {number}: expected --seed or --capture, got --scenes; that goes with figure 8")
    if seed is not None and capture_folder is not None:
        raise InputError(f"figure {number}: expected either --seed or --capture, got both")
    capture = read_capture(capture_folder) if capture_folder is not None else recorded_town(3 if seed is None else seed)
    match number:
        case 4:
            return image_types(capture, path)
        case 5:
            return stages(capture, path)
        case 6:
            return sphere(capture, path)
        case 7:
            return window_filter(capture, path)
        case 9:
            return mount_surface_stages(capture, path)
        case _:
            return contact_sheet(capture, {14: "rgb", 15: "depth", 16: "instance"}[number], path)


def recorded_town(seed: int, settings: PlanSettings | None = None) -> Capture:
    """A situation of the embedded town, recorded into memory.

    Raises:
        InputError: The seed is negative.
    """
    if seed < 0:
        raise InputError(f"--seed: expected an integer from 0, got {seed}")
    settings = settings or PlanSettings()
    with TownSimulator() as simulator:
        ego_box = simulator.begin(seed)
        vehicles = spawn_visible_traffic(simulator, ego_box, settings)
        images = [simulator.look(view) for view in capture_plan(ego_box, vehicles, settings)]
        return Capture(simulator.name, simulator.source, ego_box, vehicles, images)


# ------------------------------------------------------------------------------------------------- images: 4, 14 to 16


def image_types(capture: Capture, path: Path | str, *, view_name: str | None = None) -> Path:
    """Figure 4: colour, depth and instances from one place.

    Args:
        capture: Where the images come from.
        path: PNG file to write.
        view_name: Name of the view; None: the one from the ego vehicle that shows most vehicles.

    Raises:
        InputError: There is no such view.
    """
    image = _telling_image(capture) if view_name is None else _named_image(capture, view_name)
    height, width = image.depth_m.shape
    limits_m = _depth_limits_m([image])
    gap_inch, below_inch = 0.12, 0.85
    across_inch = (WIDTH_INCH - gap_inch) / 3  # from one image to the next
    width_inch = across_inch - gap_inch
    down_inch = width_inch * height / width
    with figure_style():
        figure = new_figure(WIDTH_INCH, below_inch + down_inch + 0.32)
        figure.set_layout_engine("none")
        for column, (title, pixels) in enumerate(
            (
                ("Colour", image.rgb),
                ("Depth", depth_rgb(image.depth_m, limits_m)),
                ("Instance", instance_rgb(image.instance)),
            )
        ):
            axis = _axes(figure, gap_inch + column * across_inch, below_inch, width_inch, down_inch)
            _show(axis, pixels)
            axis.set_title(title)
        _depth_bar(figure, _axes(figure, gap_inch + across_inch, below_inch - 0.2, width_inch, 0.11), limits_m)
        _instance_legend(_axes(figure, gap_inch + 2 * across_inch, below_inch - 0.2, width_inch, 0.11), image)
        place = figure.text(0.5, 0.0, _place_text(capture, image), ha="center", va="bottom", fontsize=9)
        place.set(y=0.06 / figure.get_size_inches()[1], color=hex_colour(MUTED_RGB))
        return save_figure(figure, path)


def contact_sheet(capture: Capture, what: str, path: Path | str) -> Path:
    """Figures 14 to 16: all images of a capture, framed by the reason for which they were taken.

    Args:
        capture: Where the images come from.
        what: ``rgb``, ``depth`` or ``instance``.
        path: PNG file to write.

    Raises:
        InputError: There is no image.
        ValueError: Something else was asked for.
    """
    if what not in ("rgb", "depth", "instance"):
        raise ValueError(f"expected rgb, depth or instance, got {what!r}")
    order = list(ViewKind)
    images = sorted(capture.images, key=lambda image: order.index(image.view.kind))  # in the thesis's order
    if not images:
        raise InputError(f"{capture.name}: expected images, got none")
    from matplotlib.patches import Patch

    limits_m = _depth_limits_m(images)
    columns = min(_SHEET_COLUMNS, len(images))
    rows = math.ceil(len(images) / columns)
    gap_inch, below_inch = 0.07, 0.95 if what == "depth" else 0.4
    across_inch = (WIDTH_INCH - gap_inch) / columns  # from one image to the next
    aspect = max(image.depth_m.shape[0] / image.depth_m.shape[1] for image in images)
    down_inch = (across_inch - gap_inch) * aspect + gap_inch
    height_inch = rows * down_inch + gap_inch + below_inch
    with figure_style():
        figure = new_figure(WIDTH_INCH, height_inch)
        figure.set_layout_engine("none")
        for index, image in enumerate(images):
            row, column = divmod(index, columns)
            corner_inch = gap_inch + column * across_inch, height_inch - (row + 1) * down_inch
            axis = _axes(figure, *corner_inch, across_inch - gap_inch, down_inch - gap_inch)
            if what == "rgb":
                pixels = image.rgb
            elif what == "depth":
                pixels = depth_rgb(image.depth_m, limits_m)
            else:
                pixels = instance_rgb(image.instance)
            _show(axis, pixels, frame_rgb=KIND_RGB[image.view.kind])
        if what == "depth":
            _depth_bar(figure, _axes(figure, 0.2 * WIDTH_INCH, 0.8, 0.6 * WIDTH_INCH, 0.13), limits_m)
        counts = {kind: sum(image.view.kind == kind for image in images) for kind in order}
        handles = [
            Patch(color=hex_colour(KIND_RGB[kind]), label=f"{_KIND_TEXT[kind]} ({count})")
            for kind, count in counts.items()
            if count
        ]
        figure.legend(handles=handles, loc="lower center", ncols=len(handles), handlelength=1.2, columnspacing=1.6)
        return save_figure(figure, path)


def depth_rgb(depth_m: np.ndarray, limits_m: tuple[float, float]) -> np.ndarray:
    """Depths as colours on a logarithmic scale, near ones bright; a pale blue where nothing was hit.

    Args:
        depth_m: Depth [m], shape [row, column].
        limits_m: Depths at the ends of the scale [m].

    Returns:
        uint8 [row, column, 3].
    """
    import matplotlib

    low, high = np.log(limits_m)
    is_hit = np.isfinite(depth_m)
    share = (np.log(np.where(is_hit, np.maximum(depth_m, 1e-6), 1.0)) - low) / (high - low)
    rgb = matplotlib.colormaps[_DEPTH_COLOURS](np.clip(share, 0.0, 1.0))[..., :3]
    return np.where(is_hit[..., None], np.rint(255.0 * rgb), _SKY_RGB).astype(np.uint8)


def instance_rgb(instance: np.ndarray) -> np.ndarray:
    """Instances as colours: one for each vehicle, the ego vehicle dark, the rest pale; uint8 [row, column, 3]."""
    ids, index = np.unique(instance, return_inverse=True)
    colour = np.array([_instance_colour(int(instance_id)) for instance_id in ids], np.uint8)
    return colour[index.reshape(instance.shape)]


def _instance_colour(instance_id: int) -> Rgb:
    if instance_id == ENVIRONMENT_INSTANCE:
        return _ENVIRONMENT_RGB
    if instance_id == EGO_INSTANCE:
        return INK_RGB
    shade, towards = [(0.0, PAPER_RGB), (0.45, PAPER_RGB), (0.4, INK_RGB)][(instance_id - 1) // 8 % 3]
    mixed = (1.0 - shade) * np.array(camera_rgb(instance_id - 1)) + shade * np.array(towards)
    red, green, blue = np.rint(mixed).astype(int).tolist()
    return red, green, blue


def _telling_image(capture: Capture) -> CapturedImage:
    """Of the images from the ego vehicle, or else of all, the one with most vehicles, then with most of them."""

    def value(image: CapturedImage) -> tuple[bool, int, int]:
        ids, count = np.unique(image.instance, return_counts=True)
        count = count[(ids != ENVIRONMENT_INSTANCE) & (ids != EGO_INSTANCE)]
        is_level = image.view.kind in (ViewKind.TOWARDS_VEHICLE, ViewKind.ROTATION)
        return is_level, int((count >= _NOTABLE_SHARE * image.instance.size).sum()), int(count.sum())

    if not len(capture.images):
        raise InputError(f"{capture.name}: expected images, got none")
    return max(capture.images, key=value)


def _named_image(capture: Capture, name: str) -> CapturedImage:
    for image in capture.images:
        if image.view.name == name:
            return image
    raise InputError(f"{capture.name}: expected the name of a view of it, got {name!r}")


def _depth_limits_m(images: Sequence[CapturedImage]) -> tuple[float, float]:
    """Where the scale of depths begins and ends: all depths but the nearest hundredth."""
    hit = np.concatenate([image.depth_m[np.isfinite(image.depth_m) & (image.depth_m > 0.0)] for image in images])
    if not hit.size:
        return 1.0, 10.0
    near, far = float(np.quantile(hit, 0.01)), float(hit.max())
    return near, max(far, 1.01 * near)


def _axes(figure: Any, left_inch: float, low_inch: float, width_inch: float, height_inch: float) -> Any:  # noqa: ANN401
    """Axes at a place in the figure that is not left to the layout."""
    width, height = figure.get_size_inches()
    return figure.add_axes((left_inch / width, low_inch / height, width_inch / width, height_inch / height))


def _show(axis: Any, rgb: np.ndarray, *, frame_rgb: Rgb | None = None) -> None:  # noqa: ANN401 (matplotlib)
    axis.imshow(rgb, interpolation="antialiased")
    axis.grid(visible=False)
    axis.set(xticks=[], yticks=[])
    for spine in axis.spines.values():
        spine.set(visible=frame_rgb is not None, color=hex_colour(frame_rgb or MUTED_RGB), linewidth=3.0)


def _depth_bar(figure: Any, axis: Any, limits_m: tuple[float, float]) -> None:  # noqa: ANN401 (matplotlib)
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    bar = figure.colorbar(ScalarMappable(LogNorm(*limits_m), _DEPTH_COLOURS), cax=axis, orientation="horizontal")
    ticks = [tick for tick in _DEPTH_TICKS_M if limits_m[0] <= tick <= limits_m[1]]
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.ax.minorticks_off()
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=9)
    bar.set_label("depth [m]; sky pale blue", fontsize=9)


def _instance_legend(axis: Any, image: CapturedImage) -> None:  # noqa: ANN401 (matplotlib)
    """A line that tells the colours: those of vehicles as one swatch in stripes."""
    from matplotlib.legend_handler import HandlerTuple
    from matplotlib.patches import Patch

    axis.set_axis_off()
    ids = [int(instance_id) for instance_id in np.unique(image.instance)]
    vehicles = [instance_id for instance_id in ids if instance_id not in (ENVIRONMENT_INSTANCE, EGO_INSTANCE)]
    entries: dict[str, Any] = {}
    if EGO_INSTANCE in ids:
        entries["ego vehicle"] = Patch(color=hex_colour(INK_RGB))
    if vehicles:
        name = "1 vehicle" if len(vehicles) == 1 else f"{len(vehicles)} vehicles"
        entries[name] = tuple(Patch(color=hex_colour(_instance_colour(one))) for one in vehicles[:4])
    entries["environment"] = Patch(color=hex_colour(_ENVIRONMENT_RGB))
    axis.legend(
        list(entries.values()), list(entries), loc="upper center", bbox_to_anchor=(0.5, 1.4), ncols=len(entries),
        handler_map={tuple: HandlerTuple(ndivide=None, pad=0.0)}, handlelength=1.8, columnspacing=1.2, borderpad=0.0,
    )  # fmt: skip


def _place_text(capture: Capture, image: CapturedImage) -> str:
    x, y, z = image.view.ego_from_camera[:3, 3]
    return f"{capture.name}, view {image.view.name}, camera at ({x:.1f}, {y:.1f}, {z:.1f}) m in the ego frame"


# ---------------------------------------------------------------------------------------------- point clouds: 5, 6, 7


def stages(capture: Capture, path: Path | str, *, settings: ReconstructionSettings | None = None) -> Path:
    """Figure 5: the way from images to meshes, from behind the ego vehicle, with the thesis's numbers 4 to 9.

    Its stages 1 to 3 happen inside a simulator: a capture does not know them.

    Args:
        capture: What was recorded.
        path: PNG file to write.
        settings: How it becomes a scene; None: the defaults.

    Raises:
        InputError: The capture cannot be used, or this machine cannot draw.
    """
    settings = settings or ReconstructionSettings()
    capture = dataclasses.replace(capture, images=list(capture.images))
    cloud_settings = settings.cloud
    everything = joined([_with_sky(image, cloud_settings.far_depth_m) for image in capture.images])
    nearer = joined([unproject(image, far_depth_m=cloud_settings.far_depth_m)[0] for image in capture.images])
    clouds = fuse(
        capture, capture.images, dataclasses.replace(cloud_settings, radius_m=math.inf, max_height_m=math.inf)
    )
    objects = [one.cloud for one in (clouds.ego, *clouds.vehicles)]
    near, moved = split_at_radius(clouds.environment, cloud_settings.radius_m)
    low, low_moved = (cloud.below(cloud_settings.max_height_m) for cloud in (near, moved))
    thinned = [
        cloud.chosen(thin_out(cloud.point_m, how.point_count, seed=settings.seed))
        for cloud, how in (
            (low, settings.environment),
            (objects[0], settings.ego),
            *((one, settings.vehicle) for one in objects[1:]),
        )
    ]
    scene = reconstruct(capture, settings)
    meshes = [scene.environment, scene.ego, *(vehicle.mesh for vehicle in scene.vehicles)]
    panels: dict[str, Sequence[PointCloud] | Sequence[Mesh]] = {
        "(4) with vehicles": [everything],
        "(5) without far points": [nearer],
        f"(6) beyond {cloud_settings.radius_m:g} m a sphere": [near, moved, *objects],
        f"(7) nothing above {cloud_settings.max_height_m:g} m": [low, low_moved, *objects],
        "(8) downsampled": [*thinned, low_moved],
        "(9) triangle meshes": meshes,
    }
    viewpoint = _behind(capture.ego_box, clouds.environment)
    with figure_style():
        figure = new_figure(WIDTH_INCH, 10.0)
        width_px = int(DOTS_PER_INCH * (WIDTH_INCH - 0.25) / 2)
        for axis, (title, parts) in zip(figure.subplots(3, 2).flat, panels.items(), strict=True):
            picture = cloud_picture(parts, viewpoint, size_px=(width_px, round(0.64 * width_px)), point_px=1.6)
            _show(axis, picture, frame_rgb=GRID_RGB)
            counts = [len(part.triangle) if isinstance(part, Mesh) else len(part) for part in parts]
            unit = "triangles" if isinstance(parts[0], Mesh) else "points"
            axis.set_title(title)
            _right_title(axis, f"{_count_text(sum(counts))} {unit}")
        _caption(
            figure,
            f"{capture.name}. Stages (1) to (3), the place as it is, without vegetation, in clear weather with the sun "
            "overhead, happen in the simulator;\nthe embedded town has no vegetation and no weather. In (4) the sky "
            f"lies at {_SKY_DEPTH_M:g} m. From (6) on panes are filtered as in figure 7,\nand of the environment one "
            f"point in every {100.0 * cloud_settings.environment_grid_m:g} cm is kept.",
        )
        return save_figure(figure, path)


def sphere(capture: Capture, path: Path | str, *, settings: CloudSettings | None = None) -> Path:
    """Figure 6: the point cloud from above, without and with the sphere.

    Args:
        capture: What was recorded.
        path: PNG file to write.
        settings: Its radius; None: the defaults.

    Raises:
        InputError: The capture cannot be used, or this machine cannot draw.
    """
    settings = settings or CloudSettings()
    whole = dataclasses.replace(settings, radius_m=math.inf, max_height_m=math.inf)
    clouds = fuse(capture, list(capture.images), whole)
    objects = [one.cloud for one in (clouds.ego, *clouds.vehicles)]
    around = clouds.environment
    near, moved = split_at_radius(around, settings.radius_m)
    reach_m = 1.05 * max(float(np.abs(around.point_m[:, :2]).max(initial=1.0)), settings.radius_m)
    edge_px = int(DOTS_PER_INCH * 0.43 * WIDTH_INCH)
    viewpoint = Viewpoint(
        np.array([0.0, 0.0, 500.0]), np.zeros(3), up=(1.0, 0.0, 0.0), height_m=2.0 * reach_m
    )  # fmt: skip
    turn = np.linspace(0.0, 2.0 * math.pi, 241)
    with figure_style():
        figure = new_figure(WIDTH_INCH, 4.85)
        axes = figure.subplots(1, 2, sharey=True)
        for axis, title, parts in (
            (axes[0], "Without the sphere", [around, *objects]),
            (axes[1], f"With the sphere of {settings.radius_m:g} m", [near, moved, *objects]),
        ):
            picture = cloud_picture(parts, viewpoint, size_px=(edge_px, edge_px), point_px=1.2)
            axis.imshow(picture, extent=(reach_m, -reach_m, -reach_m, reach_m), interpolation="antialiased")
            colour = hex_colour(camera_rgb(1))
            circle = settings.radius_m * np.stack([np.sin(turn), np.cos(turn)])
            axis.plot(*circle, color=colour, linewidth=1.3, linestyle=(0, (5, 3)))
            axis.grid(visible=False)
            axis.set_aspect("equal")
            axis.set_title(title)
            extent_m = np.ptp(joined(parts).point_m[:, :2], axis=0)
            _right_title(axis, f"{extent_m[0]:.0f} x {extent_m[1]:.0f} m")
            axis.set_xlabel("y, left [m]")
        axes[0].set_ylabel("x, forward [m]")
        return save_figure(figure, path)


def window_filter(
    capture: Capture, path: Path | str, *, instance_id: int | None = None, settings: CloudSettings | None = None
) -> Path:
    """Figure 7: a vehicle's points as the instance images tell, inside its 3D box, and those of its outside alone.

    Args:
        capture: What was recorded.
        path: PNG file to write.
        instance_id: The vehicle; None: the one through whose panes most was seen.
        settings: The box's margin; None: the defaults.

    Raises:
        InputError: There is no such vehicle, or this machine cannot draw.
    """
    settings = settings or CloudSettings()
    known = {vehicle.instance_id: vehicle for vehicle in capture.vehicles}
    wanted = list(known) if instance_id is None else [instance_id]
    if not wanted or wanted[0] not in known:
        raise InputError(f"{capture.name}: expected a vehicle of it, got {instance_id or 'none'}")
    seen: dict[int, list[PointCloud]] = {one: [] for one in wanted}
    for image in capture.images:
        cloud, instance, _, _ = unproject(image, far_depth_m=settings.far_depth_m)
        for one, parts in seen.items():
            parts.append(cloud.chosen(instance == one))
    clouds = {one: joined(parts) for one, parts in seen.items()}
    is_inside = {
        one: known[one].box.contains(cloud.point_m, margin_m=settings.box_margin_m) for one, cloud in clouds.items()
    }

    def is_stray(one: int) -> np.ndarray:
        """Points outside the box, but near enough for the picture."""
        distance_m = np.linalg.norm(clouds[one].point_m - known[one].box.center_m, axis=1)
        return ~is_inside[one] & (distance_m < _STRAY_REACH_M)

    chosen = max(wanted, key=lambda one: int(is_stray(one).sum()))
    box, cloud = known[chosen].box, clouds[chosen]
    boxed = cloud.chosen(is_inside[chosen])
    outside = boxed.chosen(is_outside(box.local_m(boxed.point_m.astype(np.float64)), np.asarray(box.size_m)))
    ego_m = np.asarray(capture.ego_box.center_m)
    high = _direction(capture.ego_box.yaw_rad + math.radians(200.0), math.radians(48.0))
    sight = box.center_m - ego_m  # from a little beside it, what lies behind panes is not hidden by them
    oblique = _direction(math.atan2(sight[1], sight[0]) + math.radians(142.0), math.radians(27.0))
    shown_m = np.concatenate([box.corners_m(), cloud.point_m[is_stray(chosen)]])
    boxes = [known[one].box for one in wanted]
    every_m = np.concatenate([np.concatenate([one.corners_m() for one in boxes]), ego_m[None]])
    inside = [clouds[one].chosen(is_inside[one]) for one in wanted]
    upper, lower = ((0.5 * WIDTH_INCH - 0.1), 2.75), ((WIDTH_INCH - 0.2) / 3, 2.4)
    name = f"vehicle {chosen}"
    with figure_style():
        figure = new_figure(WIDTH_INCH, 6.2)
        grid = figure.add_gridspec(2, 6, height_ratios=[upper[1], lower[1]])
        for place, title, parts, wires, point_m, direction, (width_inch, height_inch) in (
            (grid[0, :3], "Instance images alone", list(clouds.values()), boxes, every_m, high, upper),
            (grid[0, 3:], "Inside the 3D boxes", inside, boxes, every_m, high, upper),
            (grid[1, :2], f"{name}, instance images", [cloud], [box], shown_m, oblique, lower),
            (grid[1, 2:4], "Inside its box", [boxed], [box], shown_m, oblique, lower),
            (grid[1, 4:], "Without its inside", [outside], [box], shown_m, oblique, lower),
        ):
            axis = figure.add_subplot(place)
            size_px = round(DOTS_PER_INCH * width_inch), round(DOTS_PER_INCH * height_inch)
            viewpoint = _around(point_m, direction, aspect=width_inch / height_inch)
            _show(axis, cloud_picture(parts, viewpoint, size_px=size_px, boxes=wires), frame_rgb=GRID_RGB)
            axis.set_title(title)
            _right_title(axis, f"{_count_text(sum(map(len, parts)))} points")
        _caption(
            figure,
            f"{capture.name}. Orange: 3D boxes. Below: {name} ({known[chosen].category}); what its panes show of its "
            "own inside goes as well.",
        )
        return save_figure(figure, path)


def _with_sky(image: CapturedImage, far_depth_m: float) -> PointCloud:
    """All pixels of an image as points, those that show nothing where CARLA's depth images put the sky."""
    sky_m = max(_SKY_DEPTH_M, far_depth_m)
    depth_m = np.where(np.isfinite(image.depth_m), image.depth_m, np.float32(sky_m))
    return unproject(dataclasses.replace(image, depth_m=depth_m), far_depth_m=math.inf)[0]


def _behind(ego_box: Box, around: PointCloud) -> Viewpoint:
    """From behind and above the ego vehicle, or from another side where something stands in the way."""
    target_m = ego_box.center_m + np.array([0.0, 0.0, 0.5])
    point_m = around.point_m.astype(np.float64) - target_m
    best = (math.inf, 0.0)
    for turn_deg in (180, 165, 195, 150, 210, 0, 15, -15, 30, -30, 60, -60, 120, -120, 90, -90):
        bearing_rad = ego_box.yaw_rad + math.radians(turn_deg)
        direction = _direction(bearing_rad, math.radians(18.0))
        along = point_m @ direction
        beside_m = np.linalg.norm(point_m - along[:, None] * direction, axis=1)
        hidden = int(((along > 4.0) & (along < 22.0) & (beside_m < 1.0 + 0.1 * along) & (point_m[:, 2] > 0.5)).sum())
        if hidden < best[0]:
            best = (hidden, bearing_rad)
        if hidden == 0:
            break
    direction = _direction(best[1], math.radians(18.0))
    ahead = np.array([math.cos(best[1]), math.sin(best[1]), 0.0])
    return Viewpoint(
        target_m + 17.0 * direction, target_m - 6.0 * ahead + [0.0, 0.0, 1.4], height_rad=math.radians(44.0)
    )


def _around(point_m: np.ndarray, direction: np.ndarray, *, aspect: float) -> Viewpoint:
    """Without perspective, from a direction, just so that all points are in the picture of this width by height."""
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= np.linalg.norm(right)
    above = np.cross(direction, right)
    low, high = (reduce(point_m @ np.stack([right, above], axis=1), axis=0) for reduce in (np.min, np.max))
    middle, (width_m, height_m) = 0.5 * (low + high), high - low
    target_m = middle[0] * right + middle[1] * above + np.median(point_m @ direction) * direction
    return Viewpoint(target_m + 150.0 * direction, target_m, height_m=1.08 * max(width_m / aspect, height_m))


def _direction(bearing_rad: float, elevation_rad: float) -> np.ndarray:
    level = math.cos(elevation_rad)
    return np.array([level * math.cos(bearing_rad), level * math.sin(bearing_rad), math.sin(elevation_rad)])


def _right_title(axis: Any, text: str) -> None:  # noqa: ANN401 (matplotlib)
    axis.set_title(text, loc="right", fontweight="normal", fontsize=9)


def _caption(figure: Any, text: str) -> None:  # noqa: ANN401 (matplotlib)
    figure.supxlabel(text, fontsize=9, color=hex_colour(MUTED_RGB))


def _count_text(count: int) -> str:
    """A count to three digits, such as 7.37 million."""
    if count >= 1_000_000:
        return f"{count / 1e6:.3g} million"
    return f"{count:,}".replace(",", " ")


# ------------------------------------------------------------------------------------------- collections of scenes: 8


def collection_heat_maps(
    folder: Path, path: Path | str, *, train: Sequence[int] | None = None, test: Sequence[int] | None = None
) -> Path:
    """Figure 8 for a folder of scenes: all of them, those for training, those for testing.

    Args:
        folder: Holds ``scene_<seed>.glb`` files.
        path: PNG file to write.
        train: Seeds for training; None: the first 60 %.
        test: Seeds for testing; None: the last 20 %.

    Raises:
        InputError: The folder or a scene is missing, or there are too few scenes to split them.
    """
    path = checked_png(path)
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of scenes, got {'a file' if folder.exists() else 'none'}")
    found = {int(match[1]) for file in folder.iterdir() if (match := re.fullmatch(r"scene_(\d+)\.glb", file.name))}
    if not found:
        raise InputError(f"{folder}: expected files scene_SEED.glb, got none; warpav scenes make --out writes them")
    split = split_seeds(sorted(found))
    parts = {"all": sorted(found), "train": train or split["train"], "test": test or split["test"]}
    for name, seeds in parts.items():
        missing = sorted(set(seeds) - found)
        if missing:
            raise InputError(f"{scene_path(folder, missing[0])}: --{name}: expected this scene, got no such file")
        if not seeds:
            raise InputError(
                f"{folder}: expected at least 3 scenes to split, got {len(found)}; name seeds with --{name}"
            )
    boxes: dict[int, list[Box]] = {}
    ego_box = None
    for seed in parts["all"]:
        scene = read_scene(scene_path(folder, seed))
        boxes[seed] = [vehicle.box for vehicle in scene.vehicles]
        if ego_box is None:
            low, high = scene.ego.bounds_m().astype(np.float64)
            ego_box = Box(0.5 * (low + high), high - low, 0.0)
    assert ego_box is not None
    return heat_maps({name: [boxes[seed] for seed in seeds] for name, seeds in parts.items()}, path, ego_box=ego_box)


def heat_maps(
    collections: Mapping[str, Sequence[Sequence[Box]]],
    path: Path | str,
    *,
    ego_box: Box,
    radius_m: float | None = None,
    cell_m: float = 0.25,
) -> Path:
    """Figure 8: how often a vehicle stands where around the ego vehicle, one map for each collection.

    Args:
        collections: For each name the boxes of the vehicles, scene by scene.
        path: PNG file to write.
        ego_box: Box of the ego vehicle.
        radius_m: Half the edge of the maps [m]; None: what all boxes need.
        cell_m: Edge of a cell [m].

    Raises:
        InputError: A collection without scenes.
    """
    if radius_m is None:
        corners = [np.abs(box.corners_m()[:, :2]).max() for part in collections.values() for s in part for box in s]
        radius_m = 5.0 * math.ceil(max(corners, default=20.0) / 5.0)
    share = {name: vehicle_occupancy(part, radius_m=radius_m, cell_m=cell_m) for name, part in collections.items()}
    top = max([1e-9, *(float(one.max()) for one in share.values())])
    with figure_style():
        figure = new_figure(WIDTH_INCH, 0.9 + (WIDTH_INCH - 1.2) / len(share))
        axes = figure.subplots(1, len(share), sharey=True, squeeze=False)[0]
        image = None
        for axis, (name, one) in zip(axes, share.items(), strict=True):
            image = axis.imshow(
                100.0 * one[::-1, ::-1],
                extent=(radius_m, -radius_m, -radius_m, radius_m),
                cmap="OrRd",
                vmin=0.0,
                vmax=100.0 * top,
                interpolation="antialiased",
            )
            axis.grid(visible=False)
            x, y = ego_box.corners_m()[[0, 4, 6, 2], :2].T
            axis.fill(y, x, color=hex_colour(INK_RGB), linewidth=0)
            axis.set_title(name)
            vehicle_count = sum(len(boxes) for boxes in collections[name])
            scene_count = len(collections[name])
            text = f"{scene_count} scene{'s' if scene_count != 1 else ''}, {vehicle_count} vehicles"
            _right_title(axis, text)
            axis.set_xlabel("y, left [m]")
        axes[0].set_ylabel("x, forward [m]")
        bar = figure.colorbar(image, ax=list(axes), shrink=0.85, pad=0.01, aspect=26)
        bar.set_label("scenes with a vehicle there [%]")
        bar.outline.set_visible(False)
        return save_figure(figure, path)


def vehicle_occupancy(scenes: Sequence[Sequence[Box]], *, radius_m: float, cell_m: float) -> np.ndarray:
    """Share of the scenes in which a vehicle's box covers the middle of a cell.

    Args:
        scenes: The boxes of the vehicles of each scene; at least one scene.
        radius_m: Half the edge of the map [m], around the origin of the ego frame.
        cell_m: Edge of a cell [m].

    Returns:
        0..1, float64, shape [row, column]; rows run along x, columns along y, both from ``-radius_m``.

    Raises:
        InputError: There is no scene.
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


# ------------------------------------------------------------------------------------------------- mount surface: 9


def mount_surface_stages(
    capture: Capture, path: Path | str, *, settings: ReconstructionSettings | None = None, cell_m: float = 0.02
) -> Path:
    """Figure 9: the ego vehicle's points with the height map on them, and how the map's holes are filled.

    Args:
        capture: What was recorded.
        path: PNG file to write.
        settings: How the ego vehicle becomes a mesh; None: the defaults.
        cell_m: Edge of a cell of the map [m].

    Raises:
        InputError: The ego vehicle cannot be reconstructed, or this machine cannot draw.
    """
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
    target_m = np.array([*surface.bounds_m.mean(axis=0), 0.75 * limits_m[1]])
    picture = cloud_picture(
        [cloud.cloud, _coloured(surface, limits_m)],
        Viewpoint(
            target_m + 9.0 * _direction(math.radians(38.0), math.radians(38.0)), target_m, height_rad=math.radians(26.0)
        ),
        size_px=(660, 380),
        point_px=1.6,
    )
    with figure_style():
        figure = new_figure(WIDTH_INCH, 4.9)
        axes = figure.subplots(2, 2)
        _show(axes[0, 0], picture)
        axes[0, 0].set_title("The map on the ego vehicle's points")
        image = None
        for axis, (title, one) in zip(axes.flat[1:], maps.items(), strict=True):
            draw_vehicle(axis, ego)
            image = draw_height_map(axis, one, colours="viridis")
            image.set_clim(*limits_m)
            axis.set_title(title)
            share = float(np.isfinite(one.height_m).mean())
            if share < 1.0:
                _right_title(axis, f"{100.0 * share:.0f} % of the cells")
            axis.set_aspect("equal")
            axis.margins(0.03)
            axis.set_ylabel("y, left [m]")
            axis.set_xlabel("x, forward [m]")
        bar = figure.colorbar(image, ax=axes, shrink=0.7, pad=0.02, aspect=28)
        bar.set_label("height of the mount surface [m]")
        bar.outline.set_visible(False)
        return save_figure(figure, path)


def _coloured(surface: MountSurface, limits_m: tuple[float, float]) -> Mesh:
    """A height map as squares, one for each cell, in colours of height."""
    import matplotlib

    height_m = surface.height_m.astype(np.float64)
    share = (height_m - limits_m[0]) / max(limits_m[1] - limits_m[0], 1e-9)
    rgb = np.rint(255.0 * matplotlib.colormaps["viridis"](np.clip(share, 0.0, 1.0))[..., :3]).astype(np.uint8)
    row, column = np.indices(height_m.shape)
    centre = np.stack(
        [
            surface.origin_m[0] + row * surface.cell_m,
            surface.origin_m[1] + column * surface.cell_m,
            height_m + 0.02,  # clear of the points that it was made of
        ],
        axis=-1,
    ).reshape(-1, 1, 3)
    corner = 0.5 * surface.cell_m * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    first = 4 * np.arange(height_m.size)[:, None]
    triangle = np.concatenate([first + np.array(half) for half in ([0, 1, 2], [0, 2, 3])])
    return Mesh(
        (centre + corner).reshape(-1, 3).astype(np.float32),
        triangle.astype(np.int32),
        np.repeat(rgb.reshape(-1, 3), 4, axis=0),
    )


def checked_png(path: Path | str) -> Path:
    """The path of a picture to write.

    Raises:
        InputError: It does not end in ``.png``.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise InputError(f"{path}: --out: expected a name that ends in .png, got {path.suffix!r}")
    return path
