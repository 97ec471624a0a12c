"""How the cameras of a rig are mounted on a vehicle, as numbers, as a table (CSV) and as a model (GLB)."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.rig import corners_m
from warpav.scene import Node, glb_bytes
from warpav.view._outlines import frustum_points
from warpav.view._palette import camera_rgb

if TYPE_CHECKING:
    from warpav.rig import Module, Rig, RigCamera

FRUSTUM_DEPTH_M = 1.0
"""How far frustums reach [m]."""

_SIDES = [[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]]
_BOX = ((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4),
        (1, 5, 7), (1, 7, 3))  # fmt: skip


@dataclass(frozen=True, eq=False)
class Mount:
    """How a camera is mounted; without a vehicle neither its distance nor the unit normal on its side is known."""

    camera: RigCamera
    stand_off_m: float | None = None
    normal: np.ndarray | None = None


def mounts(rig: Rig, ego: Mesh | None) -> tuple[Mount, ...]:
    """How every camera of a rig is mounted on a vehicle."""
    if ego is None:
        return tuple(Mount(camera) for camera in rig.cameras)
    import trimesh

    corner_m = ego.vertex_m.astype(np.float64)[ego.triangle]
    normal = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    doubled_area_m2 = np.linalg.norm(normal, axis=1)
    corner_m, normal = corner_m[doubled_area_m2 > 0.0], normal[doubled_area_m2 > 0.0]
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    found = []
    for camera in rig.cameras:
        foot_m = trimesh.triangles.closest_point(corner_m, np.broadcast_to(camera.position_m, (len(corner_m), 3)))
        away_m = camera.position_m - foot_m
        distance_m = np.linalg.norm(away_m, axis=1)
        facing = np.einsum("ij,ij->i", away_m, normal)
        # of triangles that share the nearest point, as at an edge, the one that faces the camera most
        ties = np.flatnonzero(distance_m <= distance_m.min() + 1e-6)
        nearest = ties[np.abs(facing[ties]).argmax()]
        sign = -1.0 if facing[nearest] < 0.0 else 1.0
        found.append(Mount(camera, float(distance_m[nearest]), sign * normal[nearest]))
    return tuple(found)


COLUMNS = (
    *("name", "module", "x_mm", "y_mm", "z_mm", "yaw_deg", "pitch_deg", "roll_deg", "fov_deg", "width_px", "height_px"),
    *("lens", "stand_off_mm", "normal_x", "normal_y", "normal_z"),
)
"""Of the CSV file. ``fov_deg`` is horizontal; what is unknown is empty."""


def mount_csv(mounts: Sequence[Mount]) -> str:
    """The table as CSV (RFC 4180), with `COLUMNS` as its first line; the same mounts give the same text."""
    text = io.StringIO()
    table = csv.writer(text)
    table.writerow(COLUMNS)
    for mount in mounts:
        camera, model = mount.camera, mount.camera.model
        normal = ("", "", "") if mount.normal is None else (plain(value, 4) for value in mount.normal)
        table.writerow(
            [
                camera.name,
                camera.module or "",
                *(plain(1000.0 * value, 1) for value in camera.position_m),
                *(plain(angle_deg, 2) for angle_deg in angles_deg(camera)),
                plain(math.degrees(model.fov_rad), 2),
                model.width_px,
                model.height_px,
                str(model.lens),
                "" if mount.stand_off_m is None else plain(1000.0 * mount.stand_off_m, 1),
                *normal,
            ]
        )
    return text.getvalue()


def angles_deg(camera: RigCamera) -> tuple[float, float, float]:
    """Yaw, pitch and roll [deg], each within -180..180."""
    yaw_deg, pitch_deg, roll_deg = (
        math.remainder(math.degrees(angle_rad), 360.0)
        for angle_rad in (camera.yaw_rad, camera.pitch_rad, camera.roll_rad)
    )
    return yaw_deg, pitch_deg, roll_deg


def plain(value: float, decimals: int) -> str:
    """A number with so many decimals, never minus zero."""
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if float(text) == 0.0 else text


def mount_glb(mounts: Sequence[Mount], ego: Mesh | None, modules: Mapping[str, Module]) -> bytes:
    """A rig as GLB: the node ``vehicle``, and for each camera ``<name>/frustum`` and, of a module, ``<name>/housing``.

    Vertices are in the ego frame [m] below one node that turns it into glTF's axes, as in scene files. Extras of a
    frustum hold the numbers of its camera. The same input gives the same bytes.
    """
    axes = "x forward, y left, z up, origin on the ground below the rear axle's centre"
    nodes: list[Node] = [] if ego is None else [("vehicle", ego, {})]
    for index, mount in enumerate(mounts):
        camera, colour = mount.camera, camera_rgb(index)
        angles = zip(("yaw_deg", "pitch_deg", "roll_deg"), angles_deg(camera), strict=True)
        numbers = {"position_m": [float(value) for value in camera.position_m], **dict(angles)}
        point_m = frustum_points(camera, depth_m=FRUSTUM_DEPTH_M)
        nodes.append((f"{camera.name}/frustum", Mesh.create(point_m, _SIDES, colour), numbers))
        module = modules.get(camera.module or "")
        if module is not None:
            corner_m = corners_m(camera.ego_from_camera, module.housing)
            nodes.append((f"{camera.name}/housing", Mesh.create(corner_m, _BOX, colour), {"module": module.name}))
    return glb_bytes({"frame": f"ego: ISO 8855, {axes}"}, nodes)
