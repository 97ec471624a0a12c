"""A sheet to print, with frame and title block, and the table of mounts on it."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig, RigCamera

TEXT_MM = 2.2
"""Height of capital letters."""

MARK_MM = 1.0
"""Radius of the mark of a camera."""


@dataclass(frozen=True, eq=False)
class View:
    """A view of the vehicle on the page."""

    name: str
    right: np.ndarray
    up: np.ndarray
    datum_mm: np.ndarray
    scale: float

    def place_mm(self, point_m: np.ndarray) -> np.ndarray:
        """Where points of the ego frame [..., 3] are on the page, [..., 2]."""
        return self.datum_mm + 1000.0 / self.scale * (np.asarray(point_m) @ np.stack([self.right, self.up], axis=1))


@dataclass(frozen=True, eq=False)
class Stroke:
    """A line on the page through points [point, 2], on a layer; of a camera in its colour."""

    layer: str
    point_mm: np.ndarray
    is_closed: bool = False
    camera: int | None = None


@dataclass(frozen=True, eq=False)
class Note:
    """A line of text on the page; ``place_mm`` is the middle of its left end, of its middle or of its right end."""

    layer: str
    place_mm: tuple[float, float]
    text: str
    height_mm: float = TEXT_MM
    align: str = "left"
    camera: int | None = None


@dataclass(frozen=True, eq=False)
class Ordinate:
    """A coordinate of a point, from the datum of its view, as a line to its number (ISO 129 ordinate dimension)."""

    view: View
    feature_mm: np.ndarray
    end_mm: np.ndarray
    is_across: bool
    value_mm: float
    text: str


@dataclass(frozen=True, eq=False)
class Mark:
    """A camera in a view: its optical centre, and the end of its arrow."""

    view: View
    camera: int
    place_mm: np.ndarray
    tip_mm: np.ndarray


@dataclass(eq=False, kw_only=True)
class Sheet:
    """What is on a sheet."""

    scale: float
    views: tuple[View, ...]
    mounts: tuple[Mount, ...]
    strokes: list[Stroke] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    ordinates: list[Ordinate] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)


def ordinate_line_mm(ordinate: Ordinate) -> np.ndarray:
    """The line of a dimension on the page, from its feature to its number, with a bend where these are not in line."""
    along = 1 if ordinate.is_across else 0
    sign = 1.0 if ordinate.is_across else -1.0
    bend_mm = ordinate.feature_mm.copy()
    bend_mm[along] = ordinate.end_mm[along] - sign * 7.0
    before_mm = ordinate.end_mm.copy()
    before_mm[along] -= sign * 2.0
    return np.stack([ordinate.feature_mm, bend_mm, before_mm, ordinate.end_mm])


def text_width_mm(text: str, height_mm: float, *, is_bold: bool = False) -> float:
    """How wide a text is whose capital letters are so high."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(weight="bold" if is_bold else "normal", size=text_points(height_mm))
    return text_to_path.get_text_width_height_descent(text, font, ismath=False)[0] / 72.0 * 25.4


def text_points(height_mm: float) -> float:
    """The size of a font whose capital letters are so high, in points."""
    return height_mm / 0.72 / 25.4 * 72.0


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
