"""Point clouds and meshes of a capture: the stages (figure 5), the sphere (6) and the window filter (7)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh
from warpav.scene.capture.capture import EGO_INSTANCE, ENVIRONMENT_INSTANCE, Capture, CapturedImage
from warpav.scene.reconstruction.point_cloud import PointCloud, first_in_cells, fuse, joined, split_at_radius, unproject
from warpav.scene.reconstruction.reconstruct import reconstruct
from warpav.scene.reconstruction.settings import CloudSettings, ReconstructionSettings
from warpav.scene.reconstruction.surface import thin_out
from warpav.scene.scene import Box
from warpav.view.cloud_view import BACKGROUND_RGB, Viewpoint, cloud_image, towards, view_of
from warpav.view.figures.style import (
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
from warpav.view.palette import PAPER_RGB, Rgb, camera_rgb, hex_colour

_SKY_DEPTH_M = 1000.0  # where CARLA's depth images put the sky
_STRAY_REACH_M = 9.0  # of what was seen through a vehicle's panes, so much is drawn
_STREET_HEIGHT_M = 3.0  # what is higher would hide the street
_GAINED_RGB, _LOST_RGB = camera_rgb(0), camera_rgb(3)


def stages(capture: Capture, path: Path | str, *, settings: ReconstructionSettings | None = None) -> Path:
    """Figure 5: the stages from images to meshes, from behind the ego vehicle, with the thesis's numbers 4 to 9.

    Its stages 1 to 3 happen inside a simulator: a capture does not know them.
    """
    settings = settings or ReconstructionSettings()
    capture = dataclasses.replace(capture, images=list(capture.images))
    how = settings.cloud
    everything = joined([_with_sky(image, how.far_depth_m) for image in capture.images])
    nearer = joined([unproject(image, far_depth_m=how.far_depth_m)[0] for image in capture.images])
    clouds = fuse(capture, capture.images, dataclasses.replace(how, radius_m=math.inf, max_height_m=math.inf))
    objects = [one.cloud for one in (clouds.ego, *clouds.vehicles)]
    near, moved = split_at_radius(clouds.environment, how.radius_m)
    low, low_moved = (cloud.below(how.max_height_m) for cloud in (near, moved))
    thinned = [
        cloud.chosen(thin_out(cloud.point_m, budget.point_count, seed=settings.seed))
        for cloud, budget in (
            (low, settings.environment),
            (objects[0], settings.ego),
            *((one, settings.vehicle) for one in objects[1:]),
        )
    ]
    scene = reconstruct(capture, settings)
    meshes = [scene.environment, scene.ego, *(vehicle.mesh for vehicle in scene.vehicles)]
    panels: dict[str, tuple[Sequence[PointCloud | Mesh], float]] = {
        "(4) With vehicles": ([everything], 0.0),
        "(5) Without far points": ([nearer], 0.0),
        f"(6) Sphere beyond {how.radius_m:g} m": ([near, moved, *objects], 1.6),
        f"(7) Nothing above {how.max_height_m:g} m": ([low, low_moved, *objects], 1.6),
        "(8) Downsampled": ([*thinned, low_moved], 0.8),
        "(9) Triangle meshes": (meshes, 0.0),
    }
    viewpoint = _behind(capture.ego_box, clouds.environment)
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
        sizes_px = panel_sizes_px(figure, axes)
        for axis, size_px, (parts, cover) in zip(axes, sizes_px, panels.values(), strict=True):
            show_image(
                axis,
                cloud_image(
                    parts,
                    viewpoint,
                    size_px=size_px,
                    point_px=1.6,
                    cover=cover,
                    background_rgb=BACKGROUND_RGB,
                ),
            )
        return save_figure(figure, path)


def sphere(capture: Capture, path: Path | str, *, settings: CloudSettings | None = None) -> Path:
    """Figure 6: the point cloud from above, without and with the sphere."""
    settings = settings or CloudSettings()
    whole = dataclasses.replace(settings, radius_m=math.inf, max_height_m=math.inf)
    clouds = fuse(capture, list(capture.images), whole)
    objects = [one.cloud for one in (clouds.ego, *clouds.vehicles)]
    around = clouds.environment
    near, moved = split_at_radius(around, settings.radius_m)
    reach_m = 1.05 * max(float(np.abs(around.point_m[:, :2]).max(initial=1.0)), settings.radius_m)
    edge_px = int(DOTS_PER_INCH * 0.43 * WIDTH_INCH)
    viewpoint = Viewpoint(np.array([0.0, 0.0, 500.0]), np.zeros(3), up=(1.0, 0.0, 0.0), height_m=2.0 * reach_m)
    turn = np.linspace(0.0, 2.0 * math.pi, 241)
    with figure_style():
        figure = new_figure(WIDTH_INCH, 5.05)
        axes = figure.subplots(1, 2, sharey=True)
        for axis, text, parts in (
            (axes[0], "Without the sphere", [around, *objects]),
            (axes[1], "With the sphere", [near, moved, *objects]),
        ):
            image = cloud_image(parts, viewpoint, size_px=(edge_px, edge_px), point_px=1.2, cover=1.0)
            axis.imshow(image, extent=(reach_m, -reach_m, -reach_m, reach_m), interpolation="antialiased")
            circle = settings.radius_m * np.stack([np.sin(turn), np.cos(turn)])
            axis.plot(*circle, color=hex_colour(camera_rgb(1)), linewidth=1.3, linestyle=(0, (5, 3)))
            axis.grid(visible=False)
            extent_m = np.ptp(joined(parts).point_m, axis=0)
            title(axis, text, " x ".join(f"{length:.0f}" for length in extent_m) + " m")
            axis.set_xlabel("y, left [m]")
        axes[0].set_ylabel("x, forward [m]")
        caption(
            figure,
            f"{capture.name} from above; length x width x height of the cloud. Dashed: the radius of "
            f"{settings.radius_m:g} m.",
        )
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
    images = list(capture.images)
    boxes = {EGO_INSTANCE: capture.ego_box, **{one.instance_id: one.box for one in capture.vehicles}}
    shown: dict[int, list[PointCloud]] = {one: [] for one in boxes}
    thinned, lost, gained = [], [], []
    for image in images:
        cloud, instance, _, _ = unproject(image, far_depth_m=settings.far_depth_m)
        for one, parts in shown.items():
            parts.append(cloud.chosen(instance == one))
        around = cloud.chosen(instance == ENVIRONMENT_INSTANCE)
        thinned.append(around.chosen(first_in_cells(around.point_m, settings.environment_grid_m)))
        lost.append(around.chosen(_in_any(boxes.values(), around, -settings.box_margin_m)))
        for one, box in boxes.items():
            stray = shown[one][-1]
            stray = stray.chosen(~box.contains(stray.point_m, margin_m=settings.box_margin_m))
            gained.append(stray.chosen(~_in_any(boxes.values(), stray, -settings.box_margin_m)))
    whole = [joined(shown[one.instance_id]) for one in capture.vehicles]
    around = joined(thinned)
    clouds = fuse(capture, images, settings)
    return _WindowClouds(
        tuple(whole),
        tuple(
            cloud.chosen(one.box.contains(cloud.point_m, margin_m=settings.box_margin_m))
            for one, cloud in zip(capture.vehicles, whole, strict=True)
        ),
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

    pale_before, pale_after = (
        dataclasses.replace(one, rgb=_mixed(one.rgb, PAPER_RGB, 0.45))
        for one in (street(clouds.around), street(clouds.environment))
    )
    lost, gained = (
        street(_painted(cloud.chosen(first_in_cells(cloud.point_m, settings.environment_grid_m)), rgb))
        for cloud, rgb in ((clouds.lost, _LOST_RGB), (clouds.gained, _GAINED_RGB))
    )
    with figure_style():
        figure = new_figure(WIDTH_INCH, 9.8)
        grid = figure.add_gridspec(3, 6, height_ratios=[1.0, 0.8, 1.0])
        whole, single, around = (boxes, every_m, high, 1.5), ([box], shown_m, oblique, 1.5), (boxes, every_m, high, 2.5)
        one_shown, one_boxed, one_outside = ([part[chosen]] for part in (clouds.shown, clouds.boxed, clouds.outside))
        panels = []
        for panel, text, counted, remark, parts, view in (
            (grid[0, :3], "Instance images alone", clouds.shown, "", clouds.shown, whole),
            (grid[0, 3:], "Inside the 3D boxes", clouds.boxed, "", clouds.boxed, whole),
            (grid[1, :2], name, one_shown, "", one_shown, single),
            (grid[1, 2:4], "Inside its box", one_boxed, "", one_boxed, single),
            (grid[1, 4:], "Its outside", one_outside, "", one_outside, single),
            (grid[2, :3], "Environment alone", [clouds.lost], " in boxes", [pale_before, lost], around),
            (grid[2, 3:], "With what panes show", [clouds.gained], " more", [pale_after, gained], around),
        ):
            axis = figure.add_subplot(panel)
            title(axis, text, count_text(sum(map(len, counted))) + remark)
            empty_panel(axis)
            panels.append((parts, *view))
        caption(
            figure,
            f"{capture.name}. Orange: 3D boxes. Middle: {name.lower()} ({capture.vehicles[chosen].category}); what its "
            "panes show of its own inside goes as well.\n"
            f"Below: the environment up to {_STREET_HEIGHT_M:g} m; magenta: its points inside boxes, which go; blue: "
            "points seen through panes, which come to it.",
        )
        for axis, size_px, (parts, wires, point_m, direction, point_px) in zip(
            figure.axes, panel_sizes_px(figure, figure.axes), panels, strict=True
        ):
            image = cloud_image(
                parts,
                view_of(point_m, direction, size_px),
                size_px=size_px,
                point_px=point_px,
                cover=1.3,
                boxes=wires,
            )
            show_image(axis, image)
        return save_figure(figure, path)


def _in_any(boxes: Iterable[Box], cloud: PointCloud, margin_m: float) -> np.ndarray:
    """Which points lie inside a box; bool [point]."""
    return np.any(
        [np.zeros(len(cloud), bool), *(box.contains(cloud.point_m, margin_m=margin_m) for box in boxes)], axis=0
    )


def _painted(cloud: PointCloud, rgb: Rgb) -> PointCloud:
    return PointCloud(cloud.point_m, np.broadcast_to(np.array(rgb, np.uint8), cloud.rgb.shape), cloud.sensor_m)


def _mixed(rgb: np.ndarray, other_rgb: Rgb, share: float) -> np.ndarray:
    return np.rint((1.0 - share) * rgb + share * np.array(other_rgb)).astype(np.uint8)


def _with_sky(image: CapturedImage, far_depth_m: float) -> PointCloud:
    """All pixels of an image as points, those that show nothing where CARLA's depth images put the sky."""
    sky_m = max(_SKY_DEPTH_M, far_depth_m)
    depth_m = np.where(np.isfinite(image.depth_m), image.depth_m, np.float32(sky_m))
    return unproject(dataclasses.replace(image, depth_m=depth_m), far_depth_m=math.inf)[0]


def _behind(ego_box: Box, around: PointCloud) -> Viewpoint:
    """From behind and above the ego vehicle, or from another side where something hides it."""
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
