"""A rig in 3D: ego vehicle, cameras with frustums and sectors, paths of the optimisation, traffic.

Every function adds to a plotter that the caller owns. Actors carry stable names (``rig/<camera>/frustum``,
``scene/vehicles`` ...), so drawing again replaces what was drawn before.
"""

from __future__ import annotations

import dataclasses
import math
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.frustum import bearing_sector_rad, frustum_points
from warpav.view.opengl import has_display, load_pyvista, load_pyvista_data
from warpav.view.palette import GROUND_RGB, INK_RGB, PAPER_RGB, Rgb, camera_rgb, hex_colour
from warpav.view.polydata import mesh_to_pyvista

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from warpav.optimisation.further_camera import FurtherCameras
    from warpav.raster.mesh import Mesh
    from warpav.rig.mount_surface import MountSurface
    from warpav.rig.rig import Rig, RigCamera
    from warpav.scene.scene import Scene
    from warpav.sight.check import RequirementResult
    from warpav.sight.ground import Coverage

    Plotter = Any
    PolyData = Any

WINDOW_PX = (1280, 800)
WIDE_ZOOM = 0.62
"""Of images that show what a rig sees."""

FRUSTUM_DEPTH_M = 1.25
_SECTOR_RADIUS_M = 9.0
_HAZE_START_M = 20.0
_HAZE_END_M = 50.0
VIEW_AZIMUTH_RAD = math.radians(38.0)
_VIEW_ELEVATION_RAD = math.radians(33.0)
BODY_ZOOM, BODY_ELEVATION_RAD, BODY_FRUSTUM_DEPTH_M = 1.9, math.radians(52.0), 0.4
"""Of images that show what stands on the vehicle."""

_SCALE_AT = (0.62, 0.025)
"""Lower left corner of the scale of what one more camera would bring, as shares of the image."""

_GROUND_CUT_M = 0.6
"""What of the environment lies lower is ground; what rises above it counts as building."""

_AXIS_RGB: dict[str, Rgb] = {"x forward": (214, 58, 58), "y left": (38, 148, 68), "z up": (36, 92, 214)}
"""Of the ego frame."""

_RING_HEIGHT_M = 0.18
"""Of range rings: above kerbs, which would hide them."""

_GRADE_MAX = 0.08
"""Streets may rise by so much for each metre away from the vehicle and still be ground."""


def rig_plotter(
    rig: Rig | None,
    *,
    ego: Mesh | None = None,
    scene: Scene | None = None,
    outcomes: Sequence[str] | None = None,
    coverage: Coverage | None = None,
    visibility: bool = False,
    trajectory_m: np.ndarray | None = None,
    mount_surface: MountSurface | None = None,
    further: FurtherCameras | None = None,
    requirements: RequirementResult | None = None,
    off_screen: bool | None = None,
    window_size: tuple[int, int] = WINDOW_PX,
    title: str | None = None,
    zoom: float | None = None,
    frustum_depth_m: float | None = None,
    sectors: bool | None = None,
    labels: bool = True,
) -> Plotter:
    """A plotter with all that `warpav.view.plot` draws of a rig, not yet shown.

    Most options are those of `warpav.view.plot`. ``frustum_depth_m`` is how far the frustums are drawn [m], ``labels``
    whether the cameras are named, and ``sectors`` whether the bearings that each camera covers are drawn on the ground,
    by default unless outcomes, coverage, visibility or requirements are painted. Without a rig the vehicle
    stands there as it is.
    """
    is_painted = visibility or coverage is not None or outcomes is not None
    if scene is None and is_painted:
        raise ValueError("visibility, coverage, outcomes: expected a scene with what is seen, got none")
    shows_body = not is_painted and (further is not None or bool(mount_surface is not None and mount_surface.zones))
    is_wide = is_painted or requirements is not None
    zoom = (WIDE_ZOOM if is_wide else BODY_ZOOM if shows_body else 1.0) if zoom is None else zoom
    is_plain = not is_painted and not shows_body and requirements is None
    sectors = is_plain if sectors is None else sectors and not visibility
    if frustum_depth_m is None:
        frustum_depth_m = BODY_FRUSTUM_DEPTH_M if shows_body else FRUSTUM_DEPTH_M
    pyvista = load_pyvista()
    off_screen = not has_display() if off_screen is None else off_screen
    plotter = pyvista.Plotter(
        off_screen=off_screen, window_size=list(window_size), lighting="light kit", title="warpav"
    )
    plotter.set_background(hex_colour(PAPER_RGB))
    plotter.enable_anti_aliasing("msaa", multi_samples=8)
    if ego is None and scene is not None:
        ego = scene.ego
    bounds_m = _bounds_without_ego_m(rig.cameras if rig else ()) if ego is None else ego.bounds_m()
    look_at_ego(
        plotter,
        bounds_m,
        azimuth_rad=clear_azimuth_rad(scene) if scene else VIEW_AZIMUTH_RAD,
        elevation_rad=BODY_ELEVATION_RAD if shows_body else _VIEW_ELEVATION_RAD,
        zoom=zoom,
    )
    if ego is None:
        add_axes(plotter, length_m=(1.5, 1.5, 1.0))
    else:
        add_ego(plotter, ego)
    if scene is None:
        add_ground(plotter, bounds_m, shadow=ego is not None)
    else:
        shown = scene
        if outcomes is not None:
            from warpav.view.visibility_view import add_outcomes

            add_outcomes(plotter, scene, outcomes)
            shown = dataclasses.replace(scene, vehicles=())
        add_scene(plotter, shown)
        # last, as most of it is hidden: what is drawn behind others costs little
        add_ground(plotter, bounds_m, height_m=_lowest_m(scene), shadow=False, rings=False)
    if mount_surface is not None and further is None:
        _add_mount_surface(plotter, mount_surface)
    if rig is not None:
        taken_px = _taken_px(plotter, title, has_scale=further is not None)
        add_rig(plotter, rig, frustum_depth_m=frustum_depth_m, sectors=sectors, labels=labels, taken_px=taken_px)
    if visibility and rig is not None and scene is not None:
        from warpav.scene.device_scene import DeviceScene
        from warpav.view.visibility_view import add_visibility

        add_visibility(plotter, rig, DeviceScene.pack(scene))
    if trajectory_m is not None:
        add_trajectory(plotter, trajectory_m)
    if coverage is not None:
        from warpav.view.visibility_view import add_coverage

        add_coverage(plotter, coverage)
    if requirements is not None:
        from warpav.view.requirement_view import add_requirements

        add_requirements(plotter, requirements)
    if further is not None:
        from warpav.view.body_view import add_gain
        from warpav.view.descent_view import add_further_cameras

        if mount_surface is None:
            add_further_cameras(plotter, further, scale_at=_SCALE_AT)
        else:
            add_gain(plotter, mount_surface, further, scale_at=_SCALE_AT)
    if title:
        plotter.add_text(
            title, position=(0.02, 0.945), viewport=True, font_size=11, color=hex_colour(INK_RGB), name="title"
        )
    return plotter


def _taken_px(plotter: Plotter, title: str | None, *, has_scale: bool) -> np.ndarray:
    """Where title and scale are written, left, upper, right and lower edge [px], [box, 4]; names keep clear of them."""
    width, height = plotter.window_size
    boxes = []
    if title:
        boxes.append([0.0, 0.0, 0.02 * width + 0.022 * height * len(title), 0.07 * height])
    if has_scale:
        boxes.append([(_SCALE_AT[0] - 0.01) * width, (1.0 - _SCALE_AT[1] - 0.13) * height, width, height])
    return np.reshape(np.array(boxes, np.float64), (-1, 4))


@contextmanager
def no_render(plotter: Plotter) -> Iterator[None]:
    """Change a plotter without drawing after every change, as pyvista does once it was drawn."""
    plotter.suppress_rendering = True
    try:
        yield
    finally:
        plotter.suppress_rendering = False


def look_at_ego(
    plotter: Plotter,
    bounds_m: np.ndarray,
    *,
    azimuth_rad: float = VIEW_AZIMUTH_RAD,
    elevation_rad: float = _VIEW_ELEVATION_RAD,
    zoom: float = 1.0,
) -> None:
    """Point the plotter's camera at the ego vehicle, by default from the front left.

    Args:
        bounds_m: Lowest and highest corner of the vehicle in the middle of the image [m], shape [2, 3].
    """
    low, high = np.asarray(bounds_m, np.float64)
    target = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, 0.62 * high[2]])
    distance = 4.1 * float(high[0] - low[0]) / zoom
    direction = np.array(
        [
            math.cos(elevation_rad) * math.cos(azimuth_rad),
            math.cos(elevation_rad) * math.sin(azimuth_rad),
            math.sin(elevation_rad),
        ]
    )
    plotter.camera_position = [tuple(target + distance * direction), tuple(target), (0.0, 0.0, 1.0)]
    plotter.camera.view_angle = 28.0
    plotter.camera_set = True


def clear_azimuth_rad(scene: Scene) -> float:
    """Bearing of the viewer from which the least traffic stands before the ego vehicle [rad].

    Front left, unless something stands there and less stands at the front right.
    """
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
    """Where points of the ego frame appear in the plotter's image [px], from the upper left corner.

    Args:
        point_m: Points in front of the viewer [m], shape [point, 3].

    Returns:
        Column and row [px], float64, shape [point, 2]; outside the image where the point is not in it.
    """
    width, height = plotter.window_size
    matrix = plotter.camera.GetCompositeProjectionTransformMatrix(width / height, -1.0, 1.0)
    from_world = np.array([[matrix.GetElement(row, column) for column in range(4)] for row in range(4)])
    clip = np.column_stack([np.asarray(point_m, dtype=np.float64), np.ones(len(point_m))]) @ from_world.T
    unit = clip[:, :2] / clip[:, 3:]
    return np.column_stack([(unit[:, 0] + 1.0) / 2.0 * width, (1.0 - unit[:, 1]) / 2.0 * height])


def add_ego(plotter: Plotter, ego: Mesh, *, name: str = "ego") -> None:
    """Add the ego vehicle in its own colours."""
    plotter.add_mesh(mesh_to_pyvista(ego), scalars="RGB", rgb=True, name=name, **_BAKED)


def add_ground(
    plotter: Plotter,
    bounds_m: np.ndarray,
    *,
    height_m: float = 0.0,
    shadow: bool = True,
    rings: bool = True,
    name: str = "ground",
) -> None:
    """Add a plain ground that fades into the background.

    Args:
        bounds_m: Lowest and highest corner of the vehicle in its middle [m], shape [2, 3].
    """
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
    plotter.add_mesh(disc, scalars="RGB", rgb=True, name=name, **_BAKED)
    for radius in (5.0, 10.0, 15.0) if rings else ():
        ring = _polar_grid(middle, np.array([radius - 0.012, radius + 0.012]), turn, height_m=height_m - 0.01)
        plotter.add_mesh(ring, color=(205, 210, 218), lighting=False, name=f"{name}/ring_{radius:.0f}m")


def add_range_rings(
    plotter: Plotter,
    bounds_m: np.ndarray | None,
    *,
    radius_m: Sequence[float] = (5.0, 10.0, 20.0, 40.0),
    name: str = "rings",
) -> None:
    """Add circles on the ground around the ego vehicle's middle, each with its radius; None takes them away.

    Args:
        bounds_m: Lowest and highest corner of the ego vehicle [m], [2, 3].
    """
    for actor in [each for each in plotter.actors if each.startswith(f"{name}/")]:
        plotter.remove_actor(actor)
    if bounds_m is None:
        return
    pyvista = load_pyvista()
    middle_m = np.asarray(bounds_m, np.float64)[:, :2].mean(axis=0)
    angle = np.linspace(0.0, 2.0 * math.pi, 181)
    for radius in radius_m:
        point_m = np.column_stack(
            [middle_m + radius * np.column_stack([np.cos(angle), np.sin(angle)]), 0.04 + 0 * angle]
        )
        plotter.add_mesh(
            pyvista.lines_from_points(point_m),
            color=INK_RGB,
            line_width=1.5,
            opacity=0.7,
            lighting=False,
            name=f"{name}/{radius:g} m",
        )
    at_m = [[middle_m[0] + radius, middle_m[1], _RING_HEIGHT_M] for radius in radius_m]
    plotter.add_point_labels(
        np.array(at_m),
        [f"{radius:g} m" for radius in radius_m],
        text_color=hex_colour(INK_RGB),
        font_size=14,
        shape=None,
        show_points=False,
        always_visible=True,
        name=f"{name}/labels",
    )


def add_axes(
    plotter: Plotter, *, length_m: Sequence[float] | np.ndarray, thick: float = 1.0, name: str = "axis"
) -> None:
    """Add the axes of the ego frame at its origin, with their names."""
    pyvista = load_pyvista()
    tips = []
    for axis, (label, colour) in enumerate(_AXIS_RGB.items()):
        direction = np.eye(3)[axis]
        length = max(float(length_m[axis]), 0.5)
        lift = np.array([0.0, 0.0, 0.02 if axis < 2 else 0.0])
        arrow = pyvista.Arrow(
            start=lift,
            direction=direction,
            scale=length,
            shaft_radius=0.016 * thick / length,
            tip_radius=0.055 * thick / length,
            tip_length=0.2 * thick / length,
        )
        plotter.add_mesh(arrow, color=colour, ambient=0.6, name=f"{name}/{label[0]}")
        tips.append(lift + (length + 0.12 * thick) * direction)
    plotter.add_mesh(pyvista.Sphere(radius=0.07), color=INK_RGB, ambient=0.5, name="origin")
    plotter.add_point_labels(
        np.array([*tips]),
        list(_AXIS_RGB),
        text_color=hex_colour(INK_RGB),
        font_size=15,
        shape=None,
        show_points=False,
        always_visible=True,
        name=f"{name}_labels",
    )


def add_scene(plotter: Plotter, scene: Scene, *, name: str = "scene", softness: float = 0.42) -> None:
    """Add street and traffic around the ego vehicle, fading into the background with distance.

    Buildings are left out: they would stand between the viewer and the vehicle.
    """
    from warpav.raster.mesh import merge

    low, high = scene.ego.bounds_m().astype(np.float64)
    middle = (low[:2] + high[:2]) / 2
    traffic = (*scene.vehicles, *scene.others)
    near = [user.mesh for user in traffic if _distance_m(user.mesh, middle) < _HAZE_END_M]
    if near:
        surface = mesh_to_pyvista(merge(near))
        distance = np.repeat([_distance_m(mesh, middle) for mesh in near], [len(mesh.vertex_m) for mesh in near])
        surface.point_data["RGB"] = _blend(surface.point_data["RGB"], 0.12 + 0.88 * _haze(distance))
        plotter.add_mesh(surface, scalars="RGB", rgb=True, name=f"{name}/vehicles", **_BAKED)
    ground = _ground_of(scene.environment, middle)
    if ground is not None:
        street = _blend(ground.point_data["RGB"], softness)
        ground.point_data["RGB"] = _hazed(street, ground.points, middle)
        plotter.add_mesh(ground, scalars="RGB", rgb=True, name=f"{name}/ground", **_BAKED)


def _add_mount_surface(plotter: Plotter, mount_surface: MountSurface, *, name: str = "mount_surface") -> None:
    """Add the surface on which cameras may sit, coloured by height from dark (low) to light (high), or by zone."""
    if mount_surface.zones:
        from warpav.view.body_view import add_zones

        add_zones(plotter, mount_surface, name=name)
        return
    pyvista = load_pyvista()
    height = np.asarray(mount_surface.height_m, dtype=np.float64)
    row, column = np.indices(height.shape)
    place = np.asarray(mount_surface.origin_m) + mount_surface.cell_m * np.stack([row, column], axis=-1)
    point = mount_surface.point_m(place, height + 0.035)
    grid = pyvista.StructuredGrid(*np.moveaxis(point, -1, 0))
    grid.point_data["height_m"] = height.ravel(order="F")
    plotter.add_mesh(
        grid,
        scalars="height_m",
        cmap="viridis",
        opacity=0.75,
        show_scalar_bar=False,
        lighting=False,
        name=name,
    )


def add_rig(
    plotter: Plotter,
    rig: Rig,
    *,
    name: str = "rig",
    frustum_depth_m: float = FRUSTUM_DEPTH_M,
    sectors: bool = True,
    labels: bool = True,
    taken_px: np.ndarray | None = None,
) -> None:
    """Add the cameras of a rig: body, frustum, sector on the ground, name."""
    for index, camera in enumerate(rig.cameras):
        add_camera(plotter, camera, index, name=name, frustum_depth_m=frustum_depth_m, sector=sectors)
    if labels:
        _add_labels(plotter, rig.cameras, depth_m=frustum_depth_m, name=name, taken_px=taken_px)


def add_camera(
    plotter: Plotter,
    camera: RigCamera,
    index: int,
    *,
    name: str = "rig",
    frustum_depth_m: float = FRUSTUM_DEPTH_M,
    sector: bool = False,
) -> None:
    """Add one camera: body, frustum, sector on the ground."""
    colour, first = camera_rgb(index), f"{name}/{camera.name}"
    _add_frustum(plotter, camera, colour, depth_m=frustum_depth_m, name=first)
    _add_camera_body(plotter, camera, colour, name=first)
    if sector:
        _add_sector(plotter, camera, colour, name=first)


def add_trajectory(plotter: Plotter, trajectory_m: np.ndarray, *, name: str = "trajectory") -> None:
    """Add the path of every camera over an optimisation as a tube, with a white ball where it started.

    Args:
        trajectory_m: Camera positions [m], shape [iteration, camera, 3], at least one iteration.
    """
    pyvista = load_pyvista()
    path = _checked_trajectory(trajectory_m)
    for index in range(path.shape[1]):
        point = path[:, index] + np.array([0.0, 0.0, 0.012])
        moved = np.r_[True, np.linalg.norm(np.diff(point, axis=0), axis=1) > 1e-4]
        point = point[moved]
        colour = camera_rgb(index)
        start = pyvista.Sphere(radius=0.06, center=point[0])
        plotter.add_mesh(start, color="white", ambient=0.45, name=f"{name}/{index}/start", smooth_shading=True)
        ring = pyvista.Disc(center=point[0], inner=0.06, outer=0.09, normal=(0, 0, 1), c_res=40)
        plotter.add_mesh(ring, color=colour, lighting=False, name=f"{name}/{index}/start_ring")
        if len(point) > 1:
            tube = pyvista.lines_from_points(point).tube(radius=0.02, n_sides=14)
            plotter.add_mesh(tube, color=colour, name=f"{name}/{index}/path", ambient=0.5, smooth_shading=True)


def _checked_trajectory(trajectory_m: object) -> np.ndarray:
    """The trajectory as float64, shape [iteration, camera, 3]."""
    from warpav.core.errors import InputError

    path = np.asarray(trajectory_m, dtype=np.float64)
    if path.ndim != 3 or path.shape[2] != 3 or 0 in path.shape:
        raise InputError(f"trajectory_m: expected the shape [iteration, camera, 3], got {list(path.shape)}")
    if not np.isfinite(path).all():
        raise InputError("trajectory_m: some positions are NaN or infinite")
    return path


_BAKED: dict[str, Any] = {"lighting": False, "show_edges": False}
"""Meshes of the town carry their light in their colours."""


def frustum_to_pyvista(camera: RigCamera, *, depth_m: float = FRUSTUM_DEPTH_M) -> PolyData:
    """The four sides of a camera's frustum in the ego frame, from its centre (point 0) to the image's corners."""
    point = frustum_points(camera, depth_m=depth_m)
    side = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    return load_pyvista_data().PolyData.from_regular_faces(point, side)


def _add_frustum(plotter: Plotter, camera: RigCamera, colour: Rgb, *, depth_m: float, name: str) -> None:
    pyvista = load_pyvista()
    point = frustum_points(camera, depth_m=depth_m)
    plotter.add_mesh(
        frustum_to_pyvista(camera, depth_m=depth_m),
        color=colour,
        opacity=0.07,
        lighting=False,
        name=f"{name}/frustum",
    )
    plane = pyvista.PolyData.from_regular_faces(point, np.array([[1, 2, 3, 4]]))
    plotter.add_mesh(plane, color=colour, opacity=0.13, lighting=False, name=f"{name}/image_plane")
    edges = pyvista.MultiBlock(
        [pyvista.Line(point[0], point[corner]).tube(radius=0.011, n_sides=12) for corner in (1, 2, 3, 4)]
        + [pyvista.lines_from_points(point[[1, 2, 3, 4, 1]]).tube(radius=0.013, n_sides=12)]
    )
    plotter.add_mesh(
        edges.combine().extract_surface(algorithm=None), color=colour, lighting=False, name=f"{name}/edges"
    )


def camera_body(camera: RigCamera) -> tuple[PolyData, PolyData]:
    """Housing and lens of a camera in the ego frame; the lens looks along the optical axis."""
    pyvista = load_pyvista_data()
    housing = pyvista.Box(bounds=(-0.08, 0.08, -0.06, 0.06, -0.16, 0.0))
    lens = pyvista.Cylinder(center=(0, 0, 0.03), direction=(0, 0, 1), radius=0.05, height=0.06, resolution=32)
    transform = np.asarray(camera.ego_from_camera, dtype=np.float64)
    return housing.transform(transform, inplace=False), lens.transform(transform, inplace=False)


def _add_camera_body(plotter: Plotter, camera: RigCamera, colour: Rgb, *, name: str) -> None:
    housing, lens = camera_body(camera)
    plotter.add_mesh(housing, color=colour, ambient=0.35, name=f"{name}/body")
    plotter.add_mesh(lens, color=INK_RGB, ambient=0.3, smooth_shading=False, name=f"{name}/lens")


def _add_sector(plotter: Plotter, camera: RigCamera, colour: Rgb, *, name: str) -> None:
    right_rad, left_rad = bearing_sector_rad(camera)
    bearing = np.linspace(right_rad, left_rad, 2 + math.ceil((left_rad - right_rad) / math.radians(2.0)))
    centre = np.asarray(camera.position_m, dtype=np.float64)[:2]
    radius = np.linspace(0.3, _SECTOR_RADIUS_M, 40)
    wedge = _polar_grid(centre, radius, bearing, height_m=0.16)
    distance = np.linalg.norm(wedge.points[:, :2] - centre, axis=1)
    alpha = 105.0 * np.clip(1.0 - distance / _SECTOR_RADIUS_M, 0.0, 1.0) ** 0.8
    wedge.point_data["RGBA"] = np.column_stack([np.tile(colour, (len(alpha), 1)), alpha]).astype(np.uint8)
    plotter.add_mesh(wedge, scalars="RGBA", rgb=True, lighting=False, name=f"{name}/sector")


def _add_labels(
    plotter: Plotter,
    cameras: Sequence[RigCamera],
    *,
    depth_m: float,
    name: str,
    taken_px: np.ndarray | None = None,
) -> None:
    """Names above the frustums, put so that none hides another from the present view."""
    point = [frustum_points(camera, depth_m=depth_m) for camera in cameras]
    anchor = np.array([corner[1:].mean(axis=0) for corner in point])
    anchor[:, 2] = [corner[:, 2].max() + 0.12 for corner in point]
    scale = min(1.0, max(0.5, plotter.window_size[0] / WINDOW_PX[0]))
    size_px = scale * np.array([[9.5 * len(camera.name) + 14.0, 28.0] for camera in cameras])
    anchor = label_anchors_m(plotter, anchor, size_px, taken_px=taken_px)
    for index, camera in enumerate(cameras):
        plotter.add_point_labels(
            anchor[index][None],
            [f" {camera.name} "],
            name=f"{name}/{camera.name}/label",
            font_size=round(17 * scale),
            bold=True,
            text_color="white",
            shape="rounded_rect",
            shape_color=camera_rgb(index),
            shape_opacity=1.0,
            margin=round(4 * scale),
            show_points=False,
            always_visible=True,
        )


def label_anchors_m(
    plotter: Plotter, wanted_m: np.ndarray, size_px: np.ndarray, *, taken_px: np.ndarray | None = None
) -> np.ndarray:
    """Anchors of labels so that none overlaps another or leaves the image, as near as possible to what is wanted.

    Args:
        wanted_m: Where the middles of the labels would like to be [m], shape [label, 3].
        size_px: Width and height of each label [px], shape [label, 2].
        taken_px: Boxes that labels keep clear of: left, upper, right and lower edge [px], shape [box, 4]; None: none.

    Returns:
        Points at which the lower left corners of the labels belong [m], float64, shape [label, 3].
    """
    viewer = plotter.camera
    ahead = np.asarray(viewer.direction, dtype=np.float64)
    right = np.cross(ahead, np.asarray(viewer.up, dtype=np.float64))
    right /= np.linalg.norm(right)
    above = np.cross(right, ahead)
    middle_px = project_px(plotter, wanted_m)
    px_per_m = np.linalg.norm(project_px(plotter, wanted_m + above) - middle_px, axis=1)
    image_px = np.asarray(plotter.window_size, dtype=np.float64)
    step = np.stack(np.meshgrid(np.arange(-60, 61) * 8.0, np.arange(-60, 61) * 5.0), axis=-1).reshape(-1, 2)
    step = step[np.argsort(np.hypot(step[:, 0], step[:, 1]), kind="stable")]
    placed_px = np.zeros((0, 2))
    placed: list[int] = []
    corner_m = np.asarray(wanted_m, dtype=np.float64).copy()
    for index in np.argsort(-middle_px[:, 1], kind="stable"):  # lowest in the image first
        candidate = middle_px[index] + step
        room = size_px[index] / 2.0
        clear = ((candidate >= room) & (candidate <= image_px - room)).all(axis=1)
        for other, other_px in zip(placed, placed_px, strict=True):
            clear &= (np.abs(candidate - other_px) >= room + size_px[other] / 2.0).any(axis=1)
        for box in np.zeros((0, 4)) if taken_px is None else taken_px:
            clear &= ((candidate + room <= box[:2]) | (candidate - room >= box[2:])).any(axis=1)
        chosen = int(np.argmax(clear))  # the first, its wish, should none be clear
        right_px, down_px = step[chosen] + room * np.array([-1.0, 1.0])
        corner_m[index] += (right_px * right - down_px * above) / px_per_m[index]
        placed.append(int(index))
        placed_px = np.vstack([placed_px, candidate[chosen]])
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
    from warpav.raster.mesh import Mesh

    surface = mesh_to_pyvista(Mesh(environment.vertex_m, low, environment.vertex_rgb)).clean(point_merging=False)
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
    """Height of the lowest ground within the haze [m], at most 0: a street may run downhill."""
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
    """Colours moved towards the background by ``share``, uint8."""
    share = np.broadcast_to(np.asarray(share, dtype=np.float64), (len(colour_rgb),))[:, None]
    return np.rint(np.asarray(colour_rgb) * (1.0 - share) + np.asarray(PAPER_RGB) * share).astype(np.uint8)


def _hazed(colour_rgb: np.ndarray, point_m: np.ndarray, middle_m: np.ndarray) -> np.ndarray:
    return _blend(colour_rgb, _haze(np.linalg.norm(np.asarray(point_m)[:, :2] - middle_m, axis=1)))
