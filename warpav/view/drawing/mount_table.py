"""The numbers of every camera by which it is mounted, and their CSV file."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig, RigCamera


@dataclass(frozen=True, eq=False)
class Mount:
    """How a camera is mounted.

    Attributes:
        normal: Unit normal of the vehicle there, on the side of the camera, ego frame, float64 [3]; None: likewise.
    """

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
