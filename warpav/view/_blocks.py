"""Rigs, scenes and runs as trees of named pyvista blocks, to be cut, measured and saved as pyvista does.

All in the ego frame, in metres. What a block is stands in its field data; numbers there are arrays, as VTK has it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh
from warpav.rig import Rig
from warpav.scene import BLACK_SKY, Box, Scene, Sky, Vehicle
from warpav.view._layers import mesh_to_pyvista
from warpav.view._opengl import load_pyvista_data
from warpav.view._picture import FRUSTUM_DEPTH_M, camera_body, frustum_to_pyvista

if TYPE_CHECKING:
    MultiBlock = Any
    PolyData = Any

_VEHICLE = "vehicle_"


def rig_to_pyvista(rig: Rig, *, depth_m: float = FRUSTUM_DEPTH_M) -> MultiBlock:
    """A rig as ``pyvista.MultiBlock``: for every camera, under its name, a block of three.

    ``body`` is housing and lens, ``frustum`` the four sides of what it sees, ``axis`` the line from its centre along
    the optical axis. Field data of a camera's block: name, position_m, yaw_deg, pitch_deg, roll_deg, fov_deg
    (horizontal), width_px, height_px, lens.
    """
    pyvista = load_pyvista_data()
    blocks = pyvista.MultiBlock()
    for camera in rig.cameras:
        centre, ahead = np.asarray(camera.position_m), camera.ego_from_camera[:3, 2]
        housing, lens = camera_body(camera)
        parts = pyvista.MultiBlock()
        parts["body"] = pyvista.merge([housing, lens])
        parts["frustum"] = frustum_to_pyvista(camera, depth_m=depth_m)
        parts["axis"] = pyvista.Line(centre, centre + depth_m * ahead)
        model, angles = camera.model, {"yaw": camera.yaw_rad, "pitch": camera.pitch_rad, "roll": camera.roll_rad}
        about = {f"{name}_deg": math.degrees(angle) for name, angle in (angles | {"fov": model.fov_rad}).items()}
        about |= {"name": camera.name, "position_m": camera.position_m, "lens": str(model.lens)}
        _label(parts, about | {"width_px": model.width_px, "height_px": model.height_px})
        blocks[camera.name] = parts
    return blocks


def scene_to_pyvista(scene: Scene) -> MultiBlock:
    """A scene as ``pyvista.MultiBlock``: ``environment``, ``ego`` and ``vehicle_<instance id>`` of every road user.

    All have the point data ``RGB`` (uint8). Field data of a road user: instance_id, class, box_center_m, box_size_m,
    box_yaw_deg, is_target (whether rigs are to see it) and, where it is known, velocity_ego_m_s (relative to the ego
    vehicle); of the scene: name, source, sky_horizon_rgb, sky_zenith_rgb.
    """
    blocks = load_pyvista_data().MultiBlock()
    blocks["environment"] = mesh_to_pyvista(scene.environment)
    blocks["ego"] = mesh_to_pyvista(scene.ego)
    targets = {vehicle.instance_id for vehicle in scene.vehicles}
    for user in scene.road_users:
        surface = mesh_to_pyvista(user.mesh)
        about = {
            "instance_id": user.instance_id,
            "class": user.category,
            "box_center_m": user.box.center_m,
            "box_size_m": user.box.size_m,
            "box_yaw_deg": math.degrees(user.box.yaw_rad),
            "is_target": user.instance_id in targets,
        }
        if user.velocity_ego_m_s is not None:
            about["velocity_ego_m_s"] = user.velocity_ego_m_s
        _label(surface, about)
        blocks[f"{_VEHICLE}{user.instance_id}"] = surface
    about = {
        "name": scene.name,
        "source": scene.source,
        "sky_horizon_rgb": scene.sky.horizon_rgb,
        "sky_zenith_rgb": scene.sky.zenith_rgb,
    }
    _label(blocks, about)
    return blocks


def scene_from_pyvista(blocks: MultiBlock, *, name: str | None = None) -> Scene:
    """The scene of ``environment``, ``ego`` and any ``vehicle_<instance id>``; the inverse of `scene_to_pyvista`.

    A vehicle without field data is a ``car`` in an upright box along the axes, and grey without ``RGB``.
    """
    names = [str(key) for key in blocks.keys()]  # noqa: SIM118 (a MultiBlock is a list of blocks)
    missing = [key for key in ("environment", "ego") if key not in names]
    if missing:
        raise InputError(f"blocks: expected one of the name {missing[0]!r}, got {', '.join(names) or 'none'}")
    users: list[tuple[Vehicle, bool]] = []
    for key in names:
        number = key.removeprefix(_VEHICLE)
        if key.startswith(_VEHICLE) and number.isdecimal():
            surface = blocks[key]
            mesh, about = mesh_from_pyvista(surface, name=key), surface.field_data
            low, high = mesh.bounds_m().astype(np.float64)
            box = Box(
                np.asarray(about["box_center_m"] if "box_center_m" in about else (low + high) / 2, np.float64),
                np.asarray(about["box_size_m"] if "box_size_m" in about else high - low, np.float64),
                math.radians(float(about["box_yaw_deg"][0])) if "box_yaw_deg" in about else 0.0,
            )
            category = str(about["class"][0]) if "class" in about else "car"
            is_target = bool(about["is_target"][0]) if "is_target" in about else True
            velocity = np.asarray(about["velocity_ego_m_s"], np.float64) if "velocity_ego_m_s" in about else None
            users.append((Vehicle(int(number), category, mesh, box, velocity), is_target))
    users.sort(key=lambda pair: pair[0].instance_id)
    about = blocks.field_data
    has_sky = "sky_horizon_rgb" in about and "sky_zenith_rgb" in about
    sky = (np.asarray(about[f"sky_{end}_rgb"], np.uint8) for end in ("horizon", "zenith")) if has_sky else ()
    return Scene(
        name or (str(about["name"][0]) if "name" in about else "scene"),
        mesh_from_pyvista(blocks["environment"], name="environment"),
        mesh_from_pyvista(blocks["ego"], name="ego"),
        tuple(user for user, is_target in users if is_target),
        Sky(*sky) if has_sky else BLACK_SKY,
        str(about["source"][0]) if "source" in about else "pyvista",
        tuple(user for user, is_target in users if not is_target),
    )


def mesh_from_pyvista(surface: PolyData, *, name: str = "mesh") -> Mesh:
    """The triangles of a pyvista surface [m], with the colours of its point data ``RGB`` (0..255), grey without."""
    pyvista = load_pyvista_data()
    if not isinstance(surface, pyvista.PolyData):
        raise InputError(
            f"{name}: expected a surface (pyvista.PolyData), got {type(surface).__name__}; call extract_surface() first"
        )
    triangles = surface if surface.is_all_triangles else surface.triangulate()
    if triangles.n_cells == 0:
        raise InputError(f"{name}: expected a surface with faces, got none")
    colour = np.asarray(triangles.point_data["RGB"])[:, :3] if "RGB" in triangles.point_data else (150, 150, 150)
    return Mesh.create(np.asarray(triangles.points), triangles.regular_faces, colour, name=name)


def run_to_pyvista(frames: Sequence[Rig], *, start: Rig, end: Rig, scene: Scene) -> MultiBlock:
    """A run as ``pyvista.MultiBlock``: ``start``, ``path``, ``end`` and ``scene``.

    ``start`` and ``end`` are rigs as `rig_to_pyvista` makes them; ``path`` holds for every camera, under its name, the
    line of its positions with the point data ``iteration`` and ``yaw_deg``.
    """
    pyvista = load_pyvista_data()
    paths = pyvista.MultiBlock()
    for index, camera in enumerate(end.cameras):
        path = [frame.cameras[index] for frame in frames]
        point_m = np.array([each.position_m for each in path], np.float64).reshape(-1, 3)
        lines = np.r_[len(path), np.arange(len(path))] if len(path) > 1 else None
        line = pyvista.PolyData(point_m, lines=lines) if path else pyvista.PolyData()
        line.point_data["iteration"] = np.arange(len(path))
        line.point_data["yaw_deg"] = np.degrees([each.yaw_rad for each in path])
        paths[camera.name] = line
    blocks = pyvista.MultiBlock()
    blocks["start"] = rig_to_pyvista(start)
    blocks["path"] = paths
    blocks["end"] = rig_to_pyvista(end)
    blocks["scene"] = scene_to_pyvista(scene)
    return blocks


def _label(block: MultiBlock, about: Mapping[str, object]) -> None:
    for name, value in about.items():
        block.field_data[name] = [value] if isinstance(value, str) else np.atleast_1d(np.asarray(value))
