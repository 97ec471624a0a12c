"""Rigs, scenes and vehicles in space: `Picture` says what stands there, `rig_plotter` and `vehicle_plotter` draw it.

Every ``add_...`` adds to a plotter that the caller owns. Actors carry stable names (``rig/<camera>/frustum``,
``scene/vehicles`` ...), so drawing again replaces what was drawn before.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import InputError
from warpav.view._labels import Labels
from warpav.view._layers import (
    add_coverage,
    add_further_cameras,
    add_gain,
    add_labels,
    add_mount_surface,
    add_outcomes,
    add_requirements,
    add_text,
    add_visibility,
    mesh_to_pyvista,
    paint,
    remove,
)
from warpav.view._opengl import has_display, load_pyvista, load_pyvista_data
from warpav.view._outlines import beam_lines, bearing_sector_rad, frustum_points, view_edges
from warpav.view._output import Canvas, render_rgb
from warpav.view._palette import GROUND_RGB, INK_RGB, OUTCOME_RGB, PAPER_RGB, Rgb, camera_rgb, hex_colour

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from warpav.optimisation import FurtherCameras
    from warpav.raster.mesh import Mesh
    from warpav.rig import MountSurface, Rig, RigCamera
    from warpav.scene import Scene
    from warpav.sight import Coverage, RequirementResult

    Plotter = Any
    PolyData = Any

WINDOW_PX, _VEHICLE_PX = (1280, 800), (1280, 720)
_ZONES_VIEW_PX = (880, 720)
"""Of each of the two views of zones."""

WIDE_ZOOM = 0.62
"""Of images that show what a rig sees."""

FRUSTUM_DEPTH_M = 1.25
_SECTOR_RADIUS_M = 9.0
_MOST_RINGS, _RING_M = 16, 0.02
_HAZE_START_M = 20.0
_HAZE_END_M = 50.0
VIEW_AZIMUTH_RAD = math.radians(38.0)
_VIEW_ELEVATION_RAD, _VEHICLE_ELEVATION_RAD = math.radians(33.0), math.radians(36.0)
_BODY_ZOOM, _BODY_ELEVATION_RAD, _BODY_FRUSTUM_DEPTH_M = 1.9, math.radians(52.0), 0.4
"""Of images that show what stands on the vehicle."""

_SCALE_AT = (0.62, 0.025)
"""Lower left corner of the scale of what one more camera would bring, as shares of the image."""

_GROUND_CUT_M = 0.6
"""What of the environment lies lower is ground; what rises above it counts as building."""

_AXIS_RGB: dict[str, Rgb] = {"x forward": (214, 58, 58), "y left": (38, 148, 68), "z up": (36, 92, 214)}
"""Of the ego frame."""

_RING_LIFT_M, _RING_HEIGHT_M = 0.1, 0.1
"""Of range rings above the ground, so that what is painted there does not hide them, and of their texts above them."""

_GRADE_MAX = 0.08
"""Streets may rise by so much for each metre away from the vehicle and still be ground."""

_NOWHERE = np.zeros((0, 4))


@dataclass(frozen=True, eq=False, kw_only=True)
class Picture:
    """What stands in a picture of a rig or a scene; `warpav.view.plot` says what each part means."""

    rig: Rig | None = None
    ego: Mesh | None = None
    scene: Scene | None = None
    mount_surface: MountSurface | None = None
    trajectory_m: np.ndarray | None = None
    outcomes: Sequence[str] | None = None
    coverage: Coverage | None = None
    visibility: bool = False
    further: FurtherCameras | None = None
    requirements: RequirementResult | None = None

    @property
    def vehicle(self) -> Mesh | None:
        return self.scene.ego if self.ego is None and self.scene is not None else self.ego

    @property
    def is_painted(self) -> bool:
        """Whether it shows what the rig sees."""
        return self.visibility or self.coverage is not None or self.outcomes is not None

    @property
    def shows_body(self) -> bool:
        """Whether it is about what stands on the vehicle."""
        has_zones = self.mount_surface is not None and bool(self.mount_surface.zones)
        return not self.is_painted and (self.further is not None or has_zones)


def rig_plotter(picture: Picture, canvas: Canvas, *, labels: bool = True, sectors: bool = True) -> Plotter:
    """A plotter of a picture, not yet shown.

    Sectors, the bearings that each camera covers on the ground, are drawn where nothing else is painted there.
    """
    rig, scene, vehicle = picture.rig, picture.scene, picture.vehicle
    if scene is None and picture.is_painted:
        raise ValueError("visibility, coverage, outcomes: expected a scene with what is seen, got none")
    is_wide = picture.is_painted or picture.requirements is not None
    usual_zoom = WIDE_ZOOM if is_wide else _BODY_ZOOM if picture.shows_body else 1.0
    plotter = _new_plotter(canvas, WINDOW_PX)
    bounds_m = _bounds_without_ego_m(rig.cameras if rig else ()) if vehicle is None else vehicle.bounds_m()
    _look_at(
        plotter,
        bounds_m,
        azimuth_rad=_clear_azimuth_rad(scene) if scene else VIEW_AZIMUTH_RAD,
        elevation_rad=_BODY_ELEVATION_RAD if picture.shows_body else _VIEW_ELEVATION_RAD,
        zoom=usual_zoom if canvas.zoom is None else canvas.zoom,
    )
    if vehicle is None:
        _add_axes(plotter, length_m=(1.5, 1.5, 1.0))
    else:
        paint(plotter, mesh_to_pyvista(vehicle), name="ego")
    if scene is None:
        _add_ground(plotter, bounds_m, shadow=vehicle is not None)
    else:
        add_scene(plotter, scene, picture.outcomes, legend=True)
        # last, as most of it is hidden: what is drawn behind others costs little
        _add_ground(plotter, bounds_m, height_m=_lowest_m(scene), shadow=False, rings=False)
    if picture.mount_surface is not None and picture.further is None:
        add_mount_surface(plotter, picture.mount_surface)
    if rig is not None:
        is_plain = not is_wide and not picture.shows_body
        depth_m = _BODY_FRUSTUM_DEPTH_M if picture.shows_body else FRUSTUM_DEPTH_M
        add_rig(plotter, rig, depth_m=depth_m, sectors=sectors and is_plain)
        if labels:
            taken_px = _taken_px(plotter, canvas.title, has_scale=picture.further is not None)
            _add_names(plotter, rig.cameras, depth_m=depth_m, taken_px=taken_px)
    if picture.visibility and rig is not None and scene is not None:
        from warpav.scene import DeviceScene

        packed = DeviceScene.pack(scene)
        for index, camera in enumerate(rig.cameras):
            add_visibility(plotter, camera, index, packed)
    if picture.trajectory_m is not None:
        add_trajectory(plotter, picture.trajectory_m)
    if picture.coverage is not None:
        add_coverage(plotter, picture.coverage)
    add_requirements(plotter, picture.requirements)
    if picture.further is not None and picture.mount_surface is not None:
        add_gain(plotter, picture.mount_surface, picture.further, at=_SCALE_AT)
    elif picture.further is not None:
        add_further_cameras(plotter, picture.further, at=_SCALE_AT)
    if canvas.title:
        add_text(plotter, canvas.title, (0.02, 0.945), size=11, name="title")
    return plotter


def _new_plotter(canvas: Canvas, usual_px: tuple[int, int]) -> Plotter:
    off_screen = not has_display() if canvas.off_screen is None else canvas.off_screen
    window = {"off_screen": off_screen, "window_size": list(canvas.size_px(usual_px)), "title": "warpav"}
    plotter = load_pyvista().Plotter(**window, lighting="light kit")
    plotter.set_background(hex_colour(PAPER_RGB))
    plotter.enable_anti_aliasing("msaa", multi_samples=8)
    return plotter


def vehicle_plotter(
    vehicle: Mesh | None,
    canvas: Canvas,
    *,
    surface: MountSurface | None,
    axle_m: Sequence[float] = (),
    azimuth_rad: float = VIEW_AZIMUTH_RAD,
) -> Plotter:
    """A vehicle that is to carry cameras: where they may stand, its origin, its axes, its wheels; not yet shown."""
    if vehicle is not None:
        bounds_m = vehicle.bounds_m().astype(np.float64)
    elif surface is not None:  # from the ground to the highest cell
        low, high = surface.over_ground.bounds_m
        bounds_m = np.array([[*low, 0.0], [*high, np.nanmax(surface.over_ground.height_m)]], np.float64)
    else:
        raise ValueError("vehicle, surface: expected at least one of them, got neither")
    plotter = _new_plotter(canvas, _VEHICLE_PX)
    view = {"azimuth_rad": azimuth_rad, "elevation_rad": _VEHICLE_ELEVATION_RAD}
    _look_at(plotter, bounds_m, **view, zoom=1.0 if canvas.zoom is None else canvas.zoom)
    plotter.camera.view_angle = 19.0
    if vehicle is not None:
        paint(plotter, mesh_to_pyvista(vehicle), name="ego")
    _add_ground(plotter, bounds_m, rings=False, shadow=vehicle is not None)
    if surface is not None:
        size = max(11, round(18 * min(1.0, plotter.window_size[0] / _VEHICLE_PX[0])))
        scale = {"title": "height above ground [m]", "color": hex_colour(INK_RGB), "fmt": "%.2f"}
        scale |= {"n_labels": 3, "title_font_size": size, "label_font_size": size}
        scale |= {"position_x": 0.66, "position_y": 0.04, "width": 0.3, "height": 0.08}
        add_mount_surface(plotter, surface, scale=scale)
    low, high = bounds_m
    thick = float(high[0] - low[0]) / 4.5  # what is drawn of a bus is seen from farther away
    _add_axes(plotter, length_m=high + thick * np.array([0.9, 0.9, 0.7]), thick=thick)  # long enough to leave it
    for number, x in enumerate(axle_m):
        line = load_pyvista().Line((x, low[1] - 0.25, 0.01), (x, high[1] + 0.25, 0.01)).tube(radius=0.015)
        plotter.add_mesh(line, color=INK_RGB, lighting=False, name=f"axle/{number}")
    if canvas.title:
        add_text(plotter, canvas.title, (0.02, 0.93), size=11, name="title")
    return plotter


def zones_image_rgb(vehicle: Mesh, surface: MountSurface, *, title: str) -> np.ndarray:
    """A vehicle with its zones from its front left and, beside it, from its rear right; uint8 [row, column, 3]."""
    views = []
    for words, turn_rad in ((f"{title}, from the front left", 0.0), ("from the rear right", math.pi)):
        canvas = Canvas(title=words, window_size=_ZONES_VIEW_PX, zoom=1.15, off_screen=True)
        plotter = vehicle_plotter(vehicle, canvas, surface=surface, azimuth_rad=VIEW_AZIMUTH_RAD + turn_rad)
        # the legend once is enough, and most of the axes is then behind the body
        for name in ("mount_surface/legend", "axis", "axis_labels-labels", "origin") if views else ():
            remove(plotter, name)
        views.append(render_rgb(plotter))
        plotter.close()
    return np.concatenate(views, axis=1)


def _taken_px(plotter: Plotter, title: str | None, *, has_scale: bool) -> np.ndarray:
    """Where title and scale are written, left, upper, right and lower edge [px], [box, 4]; names keep clear of them."""
    width, height = plotter.window_size
    boxes = []
    if title:
        boxes.append([0.0, 0.0, 0.02 * width + 0.022 * height * len(title), 0.07 * height])
    if has_scale:
        boxes.append([(_SCALE_AT[0] - 0.01) * width, (1.0 - _SCALE_AT[1] - 0.13) * height, width, height])
    return np.reshape(np.array(boxes, np.float64), (-1, 4))


def _look_at(
    plotter: Plotter, bounds_m: np.ndarray, *, azimuth_rad: float, elevation_rad: float, zoom: float = 1.0
) -> None:
    low, high = np.asarray(bounds_m, np.float64)
    target = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, 0.62 * high[2]])
    level, distance = math.cos(elevation_rad), 4.1 * float(high[0] - low[0]) / zoom
    direction = np.array([level * math.cos(azimuth_rad), level * math.sin(azimuth_rad), math.sin(elevation_rad)])
    plotter.camera_position = [tuple(target + distance * direction), tuple(target), (0.0, 0.0, 1.0)]
    plotter.camera.view_angle = 28.0
    plotter.camera_set = True


def _clear_azimuth_rad(scene: Scene) -> float:
    """Bearing of the viewer [rad]: front left, unless traffic hides the vehicle there and less at the front right."""
    low, high = scene.ego.bounds_m().astype(np.float64)
    middle = (low[:2] + high[:2]) / 2

    def hidden(azimuth_rad: float) -> float:
        towards_viewer = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad)])
        total = 0.0
        for vehicle in scene.vehicles:
            offset = np.asarray(vehicle.box.center_m, dtype=np.float64)[:2] - middle
            along = float(offset @ towards_viewer)
            across = offset[0] * -towards_viewer[1] + offset[1] * towards_viewer[0]
            if 0.0 < along < 12.0:
                total += float(vehicle.box.size_m[2]) * math.exp(-((across / 3.0) ** 2) - along / 6.0)
        return total

    return min((VIEW_AZIMUTH_RAD, -VIEW_AZIMUTH_RAD), key=lambda azimuth: round(hidden(azimuth), 2))


def project_px(plotter: Plotter, point_m: np.ndarray) -> np.ndarray:
    """Where points of the ego frame [point, 3] appear in the image [px]: column and row from the upper left corner."""
    width, height = plotter.window_size
    matrix = plotter.camera.GetCompositeProjectionTransformMatrix(width / height, -1.0, 1.0)
    from_world = np.array([[matrix.GetElement(row, column) for column in range(4)] for row in range(4)])
    clip = np.column_stack([np.asarray(point_m, dtype=np.float64), np.ones(len(point_m))]) @ from_world.T
    unit = clip[:, :2] / clip[:, 3:]
    return np.column_stack([(unit[:, 0] + 1.0) / 2.0 * width, (1.0 - unit[:, 1]) / 2.0 * height])


def _add_ground(
    plotter: Plotter, bounds_m: np.ndarray, *, height_m: float = 0.0, shadow: bool = True, rings: bool = True
) -> None:
    low, high = np.asarray(bounds_m, np.float64)
    middle = (low[:2] + high[:2]) / 2
    turn = np.linspace(0.0, 2.0 * math.pi, 181)
    fine = 100 if shadow else 24  # rings that carry the fade and the shadow
    disc = _polar_grid(middle, np.linspace(0.0, _HAZE_END_M, fine), turn, height_m=height_m - 0.03)
    colour = np.tile(np.asarray(GROUND_RGB, dtype=np.float64), (disc.n_points, 1))
    if shadow:
        outside = np.maximum(np.abs(disc.points[:, :2] - middle) - (high[:2] - low[:2]) / 2 + 0.35, 0.0)
        colour *= 1.0 - 0.35 * np.exp(-np.square(outside / 0.45).sum(axis=1))[:, None]
    disc.point_data["RGB"] = _hazed(colour, disc.points, middle)
    paint(plotter, disc, name="ground")
    for radius in (5.0, 10.0, 15.0) if rings else ():
        ring = _polar_grid(middle, np.array([radius - 0.012, radius + 0.012]), turn, height_m=height_m - 0.01)
        plotter.add_mesh(ring, color=(205, 210, 218), lighting=False, name=f"ground/ring_{radius:.0f}m")


def add_range_rings(
    plotter: Plotter, scene: Scene | None, *, radius_m: Sequence[float] = (5.0, 10.0, 20.0, 40.0)
) -> None:
    """Add circles on the ground around the middle of a scene's vehicle, each with its radius; None takes them away.

    They follow the ground, up kerbs and down slopes.
    """
    from warpav.rig import ray_caster

    remove(plotter, "rings")
    if scene is None:
        return
    middle_m = np.asarray(scene.ego.bounds_m(), np.float64)[:, :2].mean(axis=0)
    angle, caster = np.linspace(0.0, 2.0 * math.pi, 361), ray_caster(scene.environment)
    style = {"color": INK_RGB, "line_width": 1.5, "opacity": 0.7, "lighting": False}
    at_m = []
    for radius in radius_m:
        top_m = np.full(len(angle), _GROUND_CUT_M + _GRADE_MAX * radius)
        ring_m = np.column_stack([radius * np.cos(angle) + middle_m[0], radius * np.sin(angle) + middle_m[1], top_m])
        down = np.tile(np.array([0.0, 0.0, -1.0], np.float32), (len(angle), 1))
        fall_m = np.asarray(caster.run(ring_m.astype(np.float32), down, query="DISTANCE"), np.float64)
        ring_m[:, 2] -= np.where(fall_m < 2.0 * top_m, fall_m, top_m) - _RING_LIFT_M
        plotter.add_mesh(load_pyvista().lines_from_points(ring_m), **style, name=f"rings/{radius:g} m")
        at_m.append(ring_m[0] + [0.0, 0.0, _RING_HEIGHT_M])
    add_labels(plotter, np.array(at_m), [f"{radius:g} m" for radius in radius_m], size=14, name="rings/labels")


def _add_axes(plotter: Plotter, *, length_m: Sequence[float] | np.ndarray, thick: float = 1.0) -> None:
    pyvista = load_pyvista()
    tips = []
    for axis, (label, colour) in enumerate(_AXIS_RGB.items()):
        direction, length = np.eye(3)[axis], max(float(length_m[axis]), 0.5)
        lift = np.array([0.0, 0.0, 0.02 if axis < 2 else 0.0])
        share = thick / length
        size = {"shaft_radius": 0.016 * share, "tip_radius": 0.055 * share, "tip_length": 0.2 * share}
        arrow = pyvista.Arrow(start=lift, direction=direction, scale=length, **size)
        plotter.add_mesh(arrow, color=colour, ambient=0.6, name=f"axis/{label[0]}")
        tips.append(lift + (length + 0.12 * thick) * direction)
    plotter.add_mesh(pyvista.Sphere(radius=0.07), color=INK_RGB, ambient=0.5, name="origin")
    add_labels(plotter, np.array(tips), list(_AXIS_RGB), size=15, name="axis_labels")


def add_scene(
    plotter: Plotter,
    scene: Scene,
    outcomes: Sequence[str] | None = None,
    *,
    legend: bool = False,
    colours: Mapping[str, Rgb] = OUTCOME_RGB,
) -> None:
    """Add street and traffic around the ego vehicle, fading into the background with distance.

    Vehicles with outcomes have their colours instead. Buildings are left out: they would stand before the vehicle.
    """
    from warpav.raster.mesh import merge

    if outcomes is not None:
        add_outcomes(plotter, scene, outcomes, legend=legend, colours=colours)
        scene = dataclasses.replace(scene, vehicles=())
    low, high = scene.ego.bounds_m().astype(np.float64)
    middle = (low[:2] + high[:2]) / 2
    near = [user.mesh for user in (*scene.vehicles, *scene.others) if _distance_m(user.mesh, middle) < _HAZE_END_M]
    if near:
        surface = mesh_to_pyvista(merge(near))
        distance = np.repeat([_distance_m(mesh, middle) for mesh in near], [len(mesh.vertex_m) for mesh in near])
        surface.point_data["RGB"] = _blend(surface.point_data["RGB"], 0.12 + 0.88 * _haze(distance))
        paint(plotter, surface, name="scene/vehicles")
    ground = _ground_of(scene.environment, middle)
    if ground is not None:
        ground.point_data["RGB"] = _hazed(_blend(ground.point_data["RGB"], 0.42), ground.points, middle)
        paint(plotter, ground, name="scene/ground")


def add_rig(plotter: Plotter, rig: Rig, *, depth_m: float = FRUSTUM_DEPTH_M, sectors: bool = True) -> None:
    """Add the cameras of a rig: body, frustum, sector on the ground."""
    for index, camera in enumerate(rig.cameras):
        add_camera(plotter, camera, index, depth_m=depth_m, sector=sectors)


def add_camera(
    plotter: Plotter, camera: RigCamera, index: int, *, depth_m: float = FRUSTUM_DEPTH_M, sector: bool = False
) -> None:
    """Add one camera or LiDAR: body, frustum, sector on the ground, and rings where beams meet it."""
    pyvista, colour, name = load_pyvista(), camera_rgb(index), f"rig/{camera.name}"
    flat = {"color": colour, "lighting": False}
    plotter.add_mesh(frustum_to_pyvista(camera, depth_m=depth_m), opacity=0.07, **flat, name=f"{name}/frustum")
    if camera.model.beams is None:
        point = frustum_points(camera, depth_m=depth_m)
        plane = pyvista.PolyData.from_regular_faces(point, np.array([[1, 2, 3, 4]]))
        plotter.add_mesh(plane, opacity=0.13, **flat, name=f"{name}/image_plane")
    edges = [_in_ego_m(camera, edge) for edge in view_edges(camera.model, depth_m=depth_m)]
    edges = [pyvista.lines_from_points(edge).tube(radius=0.013, n_sides=12) for edge in edges]
    edges = pyvista.MultiBlock(edges).combine().extract_surface(algorithm=None)
    plotter.add_mesh(edges, **flat, name=f"{name}/edges")
    housing, lens = camera_body(camera)
    plotter.add_mesh(housing, color=colour, ambient=0.35, name=f"{name}/body")
    plotter.add_mesh(lens, color=INK_RGB, ambient=0.3, smooth_shading=False, name=f"{name}/lens")
    if sector:
        right_rad, left_rad = bearing_sector_rad(camera)
        bearing = np.linspace(right_rad, left_rad, 2 + math.ceil((left_rad - right_rad) / math.radians(2.0)))
        wedge = _polar_grid(camera.position_m, np.linspace(0.3, _SECTOR_RADIUS_M, 40), bearing, height_m=0.16)
        distance = np.linalg.norm(wedge.points[:, :2] - camera.position_m[:2], axis=1)
        alpha = 105.0 * np.clip(1.0 - distance / _SECTOR_RADIUS_M, 0.0, 1.0) ** 0.8
        wedge.point_data["RGBA"] = np.column_stack([np.tile(colour, (len(alpha), 1)), alpha]).astype(np.uint8)
        paint(plotter, wedge, colours="RGBA", name=f"{name}/sector")
        rings = [pyvista.lines_from_points(ring).tube(radius=0.012, n_sides=8) for ring in ground_rings_m(camera)]
        if rings:
            rings = pyvista.MultiBlock(rings).combine().extract_surface(algorithm=None)
            plotter.add_mesh(rings, **flat, opacity=0.6, name=f"{name}/rings")


def ground_rings_m(camera: RigCamera) -> list[np.ndarray]:
    """Where some beams of a LiDAR meet the level ground within its sector [m], lines [point, 3]; of cameras none."""
    beams = camera.model.beams
    if beams is None or beams.radar is not None:
        return []
    up_rad = beams.elevation_rad[:: math.ceil(len(beams.elevation_rad) / _MOST_RINGS)]
    ray = beam_lines(beams, depth_m=1.0, elevation_rad=up_rad) @ camera.ego_from_camera[:3, :3].T
    far = camera.position_m[2] / np.maximum(-ray[..., 2:], 1e-9)
    is_near = far[..., 0] * np.linalg.norm(ray[..., :2], axis=-1) <= _SECTOR_RADIUS_M
    # a ring is drawn whole or not at all
    return list((camera.position_m + far * ray + [0.0, 0.0, _RING_M])[is_near.all(axis=1)])


def _in_ego_m(camera: RigCamera, point_m: np.ndarray) -> np.ndarray:
    transform = np.asarray(camera.ego_from_camera, np.float64)
    return np.asarray(point_m) @ transform[:3, :3].T + transform[:3, 3]


def frustum_to_pyvista(camera: RigCamera, *, depth_m: float = FRUSTUM_DEPTH_M) -> PolyData:
    """The sides of what a camera sees in the ego frame, from its centre (point 0) to the image's corners.

    Of a LiDAR or radar they end at the rims of the lowest and the highest beam.
    """
    if camera.model.beams is not None:
        low, high = beam_lines(camera.model.beams, depth_m=depth_m)
        point = np.concatenate([np.zeros((1, 3)), low, high])
        first = 1 + np.arange(len(low) - 1)
        fans = np.concatenate([np.c_[0 * each, each, each + 1] for each in (first, first + len(low))])
        return load_pyvista_data().PolyData.from_regular_faces(_in_ego_m(camera, point), fans)
    side = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    return load_pyvista_data().PolyData.from_regular_faces(frustum_points(camera, depth_m=depth_m), side)


def camera_body(camera: RigCamera) -> tuple[PolyData, PolyData]:
    """Housing and lens of a camera in the ego frame; the lens looks along the optical axis.

    Of a LiDAR or radar its housing, upright and round where it sees all round, and the window.
    """
    pyvista, beams = load_pyvista_data(), camera.model.beams
    width, height, depth = camera.housing.size_m
    if beams is None:
        housing = pyvista.Box(bounds=(-0.08, 0.08, -0.06, 0.06, -0.16, 0.0))
        lens = pyvista.Cylinder(center=(0, 0, 0.03), direction=(0, 0, 1), radius=0.05, height=0.06, resolution=32)
    elif beams.is_all_round:
        upright: dict[str, Any] = {"center": (0, 0, 0), "direction": (0, 1, 0), "resolution": 48}
        housing = pyvista.Cylinder(radius=0.5 * width, height=height, **upright)
        lens = pyvista.Cylinder(radius=0.515 * width, height=0.45 * height, **upright)
    else:
        half = 0.5 * np.array([width, height, depth])
        housing = pyvista.Box(bounds=np.stack([-half, half], axis=1).ravel())
        lens = pyvista.Box(bounds=(-0.9 * half[0], 0.9 * half[0], -0.6 * half[1], 0.6 * half[1], 0.0, 1.05 * half[2]))
    transform = np.asarray(camera.ego_from_camera, dtype=np.float64)
    return housing.transform(transform, inplace=False), lens.transform(transform, inplace=False)


def add_trajectory(plotter: Plotter, trajectory_m: Any) -> None:  # noqa: ANN401 (array-like)
    """Add the paths of cameras [m], [iteration, camera, 3], as tubes, with a white ball where each started."""
    pyvista, path = load_pyvista(), np.asarray(trajectory_m, dtype=np.float64)
    if path.ndim != 3 or path.shape[2] != 3 or 0 in path.shape:
        raise InputError(f"trajectory_m: expected the shape [iteration, camera, 3], got {list(path.shape)}")
    if not np.isfinite(path).all():
        raise InputError("trajectory_m: some positions are NaN or infinite")
    for index in range(path.shape[1]):
        point, name, colour = path[:, index] + np.array([0.0, 0.0, 0.012]), f"trajectory/{index}", camera_rgb(index)
        point = point[np.r_[True, np.linalg.norm(np.diff(point, axis=0), axis=1) > 1e-4]]
        start = pyvista.Sphere(radius=0.06, center=point[0])
        plotter.add_mesh(start, color="white", ambient=0.45, name=f"{name}/start", smooth_shading=True)
        ring = pyvista.Disc(center=point[0], inner=0.06, outer=0.09, normal=(0, 0, 1), c_res=40)
        plotter.add_mesh(ring, color=colour, lighting=False, name=f"{name}/start_ring")
        if len(point) > 1:
            tube = pyvista.lines_from_points(point).tube(radius=0.02, n_sides=14)
            plotter.add_mesh(tube, color=colour, name=f"{name}/path", ambient=0.5, smooth_shading=True)


def label_point_m(camera: RigCamera, depth_m: float = FRUSTUM_DEPTH_M) -> np.ndarray:
    """Where the name of a camera would stand: above the far end of its frustum [m]."""
    corner = frustum_points(camera, depth_m=depth_m)[1:]
    if camera.model.beams is not None:
        corner = _in_ego_m(camera, beam_lines(camera.model.beams, depth_m=depth_m).reshape(-1, 3))
    return np.array([*corner[:, :2].mean(axis=0), corner[:, 2].max() + 0.12])


def _add_names(plotter: Plotter, cameras: Sequence[RigCamera], *, depth_m: float, taken_px: np.ndarray) -> None:
    wanted_m = np.array([label_point_m(camera, depth_m) for camera in cameras])
    scale = min(1.0, max(0.5, plotter.window_size[0] / WINDOW_PX[0]))
    size_px = scale * np.array([[9.5 * len(camera.name) + 14.0, 28.0] for camera in cameras])
    corner_m = _label_anchors_m(plotter, wanted_m, size_px, taken_px=taken_px)
    style = {"font_size": round(17 * scale), "bold": True, "text_color": "white", "margin": round(4 * scale)}
    style |= {"shape": "rounded_rect", "shape_opacity": 1.0, "show_points": False, "always_visible": True}
    for index, camera in enumerate(cameras):
        label = {"name": f"rig/{camera.name}/label", "shape_color": camera_rgb(index)}
        plotter.add_point_labels(corner_m[index][None], [f" {camera.name} "], **label, **style)


def _label_anchors_m(
    plotter: Plotter, wanted_m: np.ndarray, size_px: np.ndarray, *, taken_px: np.ndarray = _NOWHERE
) -> np.ndarray:
    """Where the lower left corners of labels belong [m], so that none overlaps another or leaves the image.

    Their middles are as near as possible to what is wanted [m], [label, 3]. They keep clear of boxes that are taken:
    left, upper, right and lower edge [px], [box, 4].
    """
    viewer = plotter.camera
    ahead = np.asarray(viewer.direction, dtype=np.float64)
    right = np.cross(ahead, np.asarray(viewer.up, dtype=np.float64))
    right /= np.linalg.norm(right)
    above = np.cross(right, ahead)
    middle_px = project_px(plotter, wanted_m)
    px_per_m = np.linalg.norm(project_px(plotter, wanted_m + above) - middle_px, axis=1)
    step = np.stack(np.meshgrid(np.arange(-60, 61) * 8.0, np.arange(-60, 61) * 5.0), axis=-1).reshape(-1, 2)
    step = step[np.argsort(np.hypot(step[:, 0], step[:, 1]), kind="stable")]
    labels = Labels(taken_px, within=(0.0, 0.0, *plotter.window_size))
    corner_m = np.asarray(wanted_m, dtype=np.float64).copy()
    for index in np.argsort(-middle_px[:, 1], kind="stable"):  # lowest in the image first
        chosen = step[labels.put(middle_px[index] + step, size_px[index])]
        right_px, down_px = chosen + 0.5 * size_px[index] * np.array([-1.0, 1.0])
        corner_m[index] += (right_px * right - down_px * above) / px_per_m[index]
    return corner_m


def _polar_grid(centre_m: np.ndarray, radius_m: np.ndarray, bearing_rad: np.ndarray, *, height_m: float) -> PolyData:
    pyvista = load_pyvista()
    radius, bearing = np.meshgrid(radius_m, bearing_rad, indexing="ij")
    grid = pyvista.StructuredGrid(
        centre_m[0] + radius * np.cos(bearing), centre_m[1] + radius * np.sin(bearing), np.full_like(radius, height_m)
    )
    return grid.extract_surface(algorithm=None)


def _ground_of(environment: Mesh, middle_m: np.ndarray) -> PolyData | None:
    """The low part of the environment near the ego vehicle, cut small enough to carry a fade; None if there is none."""
    corner = environment.vertex_m[environment.triangle]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    top_m = corner[:, :, 2].max(axis=1)
    grade_m = _GRADE_MAX * np.linalg.norm(corner[:, :, :2].mean(axis=1) - middle_m, axis=1)
    is_flat = normal[:, 2] > 0.9 * np.linalg.norm(normal, axis=1)
    low = environment.triangle[(normal[:, 2] > -1e-6) & (top_m < _GROUND_CUT_M + np.where(is_flat, grade_m, 0.0))]
    if len(low) == 0:
        return None
    low = dataclasses.replace(environment, triangle=low)
    surface = mesh_to_pyvista(low).clean(point_merging=False)
    surface.point_data["RGB"] = surface.point_data["RGB"].astype(np.float32)
    for axis in (0, 1):
        normal = np.eye(3)[axis]
        for sign in (-1.0, 1.0):
            origin = (middle_m[axis] + sign * _HAZE_END_M) * normal
            surface = surface.clip(normal, origin=origin, invert=sign > 0)
            if surface.n_cells == 0:
                return None
    return surface.triangulate().subdivide_adaptive(max_edge_len=1.5, max_n_passes=8)


def _bounds_without_ego_m(cameras: Sequence[RigCamera]) -> np.ndarray:
    """Where a vehicle could be that carries the cameras: from the ground up around them, as long as a small car."""
    position_m = np.array([camera.position_m for camera in cameras] or np.zeros((1, 3)))
    low, high = np.minimum(position_m.min(axis=0), 0.0), np.maximum(position_m.max(axis=0), [0.0, 0.0, 1.0])
    missing_m = np.maximum([4.0, 2.0, 0.0] - (high - low), 0.0)
    return np.stack([low - missing_m / 2, high + missing_m / 2])


def _lowest_m(scene: Scene) -> float:
    low, high = scene.ego.bounds_m().astype(np.float64)
    near = np.linalg.norm(scene.environment.vertex_m[:, :2] - (low[:2] + high[:2]) / 2, axis=1) < _HAZE_END_M
    return float(scene.environment.vertex_m[near, 2].min(initial=0.0))


def _distance_m(mesh: Mesh, middle_m: np.ndarray) -> float:
    low, high = mesh.bounds_m()
    return float(np.linalg.norm((low[:2] + high[:2]) / 2 - middle_m))


def _haze(distance_m: np.ndarray) -> np.ndarray:
    t = np.clip((distance_m - _HAZE_START_M) / (_HAZE_END_M - _HAZE_START_M), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _blend(colour_rgb: np.ndarray, share: float | np.ndarray) -> np.ndarray:
    share = np.broadcast_to(np.asarray(share, dtype=np.float64), (len(colour_rgb),))[:, None]
    return np.rint(np.asarray(colour_rgb) * (1.0 - share) + np.asarray(PAPER_RGB) * share).astype(np.uint8)


def _hazed(colour_rgb: np.ndarray, point_m: np.ndarray, middle_m: np.ndarray) -> np.ndarray:
    return _blend(colour_rgb, _haze(np.linalg.norm(np.asarray(point_m)[:, :2] - middle_m, axis=1)))
