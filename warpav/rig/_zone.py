"""Zones: where on the body cameras may stand, each a height field over a plane of its own, and their YAML file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field

from warpav.core.files import write_text
from warpav.core.records import Form, Number, Point2, Point3, read_form
from warpav.core.section import mistake, shown
from warpav.core.yaml_file import yaml_lines, yaml_name, yaml_row

NORMALS = {
    "up": (0.0, 0.0, 1.0),
    "left": (0.0, 1.0, 0.0),
    "right": (0.0, -1.0, 0.0),
    "front": (1.0, 0.0, 0.0),
    "rear": (-1.0, 0.0, 0.0),
}
"""Names of outward normals, in the ego frame."""

_FLUSH_M = (0.0, 0.03)
"""Stand-off of a zone that says none: from level with the skin to 3 cm outwards."""

_OUTWARD_RAD = math.radians(85.0)
"""How far cameras turn from a zone's normal where the zone does not say."""

BEHIND_GLASS_M = (0.03, 0.15)
"""Stand-off of a zone behind glass that says none, inwards."""


@dataclass(frozen=True, eq=False)
class Zone:
    """A part of the body that may carry cameras, and how they may stand there.

    A camera's centre is at ``origin_m + u * U + v * V + (height(u, v) + rise) * N``, with the rows U, V and N of
    ``axes``; the rise is the stand-off, behind glass it is inwards. Yaw, pitch and roll are those of the ego frame,
    wherever the zone is.
    """

    name: str
    normal: tuple[float, float, float]
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    box_m: np.ndarray | None = None
    keep_out_m: tuple[np.ndarray, ...] = ()
    stand_off_m: tuple[float, float] = _FLUSH_M
    yaw_rad: tuple[float, float] | None = None
    pitch_rad: tuple[float, float] | None = None
    roll_rad: tuple[float, float] | None = None
    kinds: tuple[str, ...] = ()
    is_centred: bool = False
    is_behind_glass: bool = False
    recess_m: float | None = None
    # Corners of a convex polygon in the ego frame, in order along the border [m], [corner, 3]: only what is inside
    # of it, seen along the normal, belongs to the zone; None: no matter
    outline_m: np.ndarray | None = None
    # Rows U, V and N in the ego frame: V upwards along the zone, or on a level one forwards; upright zones that
    # face up have those of the ego frame; float64 [3, 3]
    axes: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        normal = np.asarray(self.normal, np.float64)
        if normal.shape != (3,) or not np.isfinite(normal).all() or not abs(np.linalg.norm(normal) - 1.0) < 1e-3:
            raise ValueError(f"normal: expected three numbers of length 1, got {self.normal!r}")
        ranges = {name: getattr(self, name) for name in ("stand_off_m", "yaw_rad", "pitch_rad", "roll_rad")}
        for name, pair in ranges.items():
            if pair is not None and not -math.inf < pair[0] <= pair[1] < math.inf:
                raise ValueError(f"{name}: expected a range, the lower end first, got {pair}")
        if self.is_centred and abs(self.normal[1]) > 1e-6:
            raise ValueError(f"centred: expected a normal without a part to the side, got {self.normal}")
        if self.is_centred and self.origin_m[1]:
            raise ValueError(f"centred: expected an origin_m with y = 0, got {self.origin_m[1]:g}")
        if self.yaw_rad is not None and self.yaw_rad[1] - self.yaw_rad[0] > 2.0 * math.pi + 1e-9:
            raise ValueError(f"yaw: expected at most a whole turn, got {self.yaw_rad}")
        normal /= np.linalg.norm(normal)
        if normal[2] > 1.0 - 1e-9:
            axes = np.eye(3)
        else:
            # v is upwards along the zone, or forwards where that is level
            upright = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
            v = upright - (upright @ normal) * normal
            v /= np.linalg.norm(v)
            axes = np.stack([np.cross(v, normal), v, normal])
        object.__setattr__(self, "axes", axes)
        if self.is_behind_glass and self.stand_off_m[0] <= 0.0:
            raise ValueError(f"stand_off_m: expected more than 0, inwards, behind glass, got {self.stand_off_m}")
        if self.recess_m is not None and (self.is_behind_glass or not 0.0 <= self.recess_m < math.inf):
            expected = "none behind glass" if self.is_behind_glass else "metres from 0 on"
            raise ValueError(f"recess_m: expected {expected}, got {self.recess_m:g}")
        if self.outline_m is not None and not _is_convex(np.asarray(self.outline_m) @ axes[:2].T):
            raise ValueError(
                "outline_m: expected at least three corners of a convex polygon, in order along its border"
            )

    @property
    def rise_m(self) -> tuple[float, float]:
        """Least and greatest height of a camera's centre above the surface [m], negative behind glass."""
        low_m, high_m = self.stand_off_m
        return (-high_m, -low_m) if self.is_behind_glass else (low_m, high_m)

    @property
    def yaw_range_rad(self) -> tuple[float, float] | None:
        """The range of yaws [rad]; None: all round. Centred ones look forwards, on a part that faces backwards back."""
        if self.is_centred and self.yaw_rad is None:
            yaw_rad = math.pi if self.axes[2, 0] < -1e-6 else 0.0
            return yaw_rad, yaw_rad
        if self.yaw_rad is not None:
            return None if self.yaw_rad[1] - self.yaw_rad[0] >= 2.0 * math.pi - 1e-9 else self.yaw_rad
        if abs(self.axes[2, 2]) > (0.99 if self.is_behind_glass else 0.5):
            return None
        outward_rad = math.atan2(self.axes[2, 1], self.axes[2, 0])
        return outward_rad - _OUTWARD_RAD, outward_rad + _OUTWARD_RAD

    def holds(self, point_m: np.ndarray) -> np.ndarray:
        """Which points of its own coordinates [..., 3] belong to it, bool [...]."""
        ego_m = point_m @ self.axes + self.origin_m
        inside = np.ones(ego_m.shape[:-1], bool)
        if self.box_m is not None:
            inside &= ((ego_m >= self.box_m[0]) & (ego_m <= self.box_m[1])).all(axis=-1)
        if self.outline_m is not None:
            corner = np.asarray(self.outline_m, np.float64) @ self.axes[:2].T
            at = ego_m @ self.axes[:2].T
            side = [
                (dx * (at[..., 1] - y) - dy * (at[..., 0] - x))
                for (x, y), (dx, dy) in zip(corner, np.roll(corner, -1, axis=0) - corner, strict=True)
            ]
            inside &= (np.min(side, axis=0) >= 0.0) | (np.max(side, axis=0) <= 0.0)
        for low_m, high_m in self.keep_out_m:
            inside &= ~((ego_m >= low_m) & (ego_m <= high_m)).all(axis=-1)
        return inside


def _corners(box: list[Any]) -> np.ndarray:
    corners = np.reshape(box, (2, 3))
    if not (corners[0] < corners[1]).all():
        mistake(f"expected a box: its lowest corner, then its highest, got {shown(corners.tolist())}")
    return corners


def _ends(value: float | list[float] | None) -> tuple[float, float] | None:
    low, high = value if isinstance(value, list) else (value, value)
    if low is None or high is None:
        return None
    return (low, high) if low <= high else mistake(f"expected a range, the lower end first, got {shown(value)}")


_Box = Annotated[
    Annotated[list[Point3], Field(min_length=2, max_length=2)]
    | Annotated[list[Number], Field(min_length=6, max_length=6)],
    AfterValidator(_corners),
]
_Ends = Annotated[Number | Point2 | None, AfterValidator(_ends)]
_RANGE_TEXT = "a number, or [least, greatest]"


class _ZoneForm(Form):
    """A zone in a file."""

    normal: Literal["up", "left", "right", "front", "rear"] | Point3 = Field(
        description=f"one of {', '.join(NORMALS)}, or three numbers: which way is outwards"
    )
    kind: str | list[str] | None = Field(
        None, description="a kind of place as modules name them, or a list of them, such as [b_pillar, mirror]"
    )
    centred: bool | None = Field(None, description="true or false: cameras stand alone in the middle, with y = 0")
    behind_glass: bool | None = Field(None, description="true or false: cameras stand inside and look through the body")
    origin_m: Point3 = Field([0.0, 0.0, 0.0], description="three numbers [m]: a point of the zone's plane")
    box_m: Annotated[_Box | None, Field(description="lowest and highest corner [m] of what belongs to the zone")] = None
    outline_m: list[Point3] = Field(
        [], description="corners [x, y, z] of a convex polygon [m], in order along its border"
    )
    keep_out_m: list[_Box] = Field([], description="a list of boxes that carry no camera")
    stand_off_m: _Ends = Field(None, description=f"{_RANGE_TEXT} [m]: how far a camera's centre stands off the skin")
    recess_m: Number | None = Field(None, description="a number [m]: how deep a housing may go into the body")
    yaw_deg: _Ends = Field(None, description=f"{_RANGE_TEXT} [deg], left positive")
    pitch_deg: _Ends = Field(None, description=f"{_RANGE_TEXT} [deg], nose down positive")
    roll_deg: _Ends = Field(None, description=f"{_RANGE_TEXT} [deg], right side down positive")
    mirror: bool | None = Field(
        None, description="true or false: whether its mirror image on the other side is a zone as well"
    )

    def zones(self, name: str) -> list[Zone]:
        """The zone, and its mirror image where that is wanted."""
        if isinstance(self.normal, str):
            normal = NORMALS[self.normal]
        else:
            x, y, z = self.normal
            length = math.hypot(x, y, z)
            if length < 1e-6:
                raise ValueError("normal: expected a direction, got one of length 0")
            normal = x / length, y / length, z / length
        if self.mirror and self.centred:
            raise ValueError("mirror: expected false, as a centred zone is its own mirror image, got true")
        x, y, z = self.origin_m
        kinds = [self.kind] if isinstance(self.kind, str) else self.kind or []
        angles_deg = {"yaw_rad": self.yaw_deg, "pitch_rad": self.pitch_deg, "roll_rad": self.roll_deg}
        zone = Zone(
            name,
            normal,
            origin_m=(x, y, z),
            box_m=self.box_m,  # pyright: ignore[reportArgumentType]
            keep_out_m=tuple(self.keep_out_m),  # pyright: ignore[reportArgumentType]
            stand_off_m=self.stand_off_m or (BEHIND_GLASS_M if self.behind_glass else _FLUSH_M),  # pyright: ignore[reportArgumentType]
            kinds=tuple(kinds),
            is_centred=bool(self.centred),
            is_behind_glass=bool(self.behind_glass),
            recess_m=self.recess_m,
            outline_m=np.array(self.outline_m) if "outline_m" in self.model_fields_set else None,
            **{key: pair and tuple(map(math.radians, pair)) for key, pair in angles_deg.items()},  # pyright: ignore
        )
        return [zone, mirrored(zone)] if self.mirror else [zone]


class ZonesForm(Form):
    """A file of zones."""

    zones: dict[str, _ZoneForm] = Field(description="a mapping from names to at least one zone", min_length=1)


def read_zones(path: Path | str) -> tuple[Zone, ...]:
    """Read a file of zones, in the ego frame [m]: ``zones``, a mapping from names to what they are.

    A zone has a ``normal`` (up, left, right, front, rear, or three numbers), and may have ``kind`` (a name or a list of
    them, as the ``zones`` of modules name them), ``centred``, ``origin_m``, ``box_m`` and
    ``keep_out_m`` (boxes as [lowest corner, highest corner]), ``outline_m`` (corners of a convex polygon),
    ``behind_glass`` (cameras stand inside and look through), ``stand_off_m``, ``yaw_deg``, ``pitch_deg`` and
    ``roll_deg`` (a number, or [least, greatest]); see `Zone`. Beside it, ``mirror: true`` adds its mirror image on the
    other side of the vehicle, called ``<name>_mirrored``. `InputError` says what is wrong with a file.
    """
    form, mistakes = read_form(ZonesForm, Path(path).expanduser())
    zones: list[Zone] = []
    for name, each in form.zones.items():
        with mistakes.noting("zones", name):
            zones += each.zones(name)
    mistakes.refuse()
    return tuple(zones)


def _is_convex(corner: np.ndarray) -> bool:
    if len(corner) < 3:
        return False
    side = np.roll(corner, -1, axis=0) - corner
    after = np.roll(side, -1, axis=0)
    turn = side[:, 0] * after[:, 1] - side[:, 1] * after[:, 0]
    turned_rad = np.arctan2(turn, (side * after).sum(axis=1)).sum()
    slack = 1e-3 * np.linalg.norm(side, axis=1) * np.linalg.norm(after, axis=1)  # numbers in files are rounded
    is_one_way = bool((turn >= -slack).all() or (turn <= slack).all())
    return is_one_way and abs(abs(turned_rad) - 2.0 * math.pi) < 1e-6


def mirrored(zone: Zone) -> Zone:
    """The mirror image of a zone on the other side of the vehicle, called ``<name>_mirrored``."""
    other_side = np.array([1.0, -1.0, 1.0])

    def box(corners: np.ndarray) -> np.ndarray:
        return np.sort(corners * other_side, axis=0)

    def turned(pair: tuple[float, float] | None) -> tuple[float, float] | None:
        return None if pair is None else (-pair[1], -pair[0])

    (x, y, z), (x_m, y_m, z_m) = zone.normal, zone.origin_m
    return replace(
        zone,
        name=f"{zone.name}_mirrored",
        normal=(x, -y, z),
        origin_m=(x_m, -y_m, z_m),
        box_m=None if zone.box_m is None else box(zone.box_m),
        keep_out_m=tuple(box(each) for each in zone.keep_out_m),
        outline_m=None if zone.outline_m is None else np.asarray(zone.outline_m)[::-1] * other_side,
        yaw_rad=turned(zone.yaw_rad),
        roll_rad=turned(zone.roll_rad),
        is_centred=False,
    )


def write_zones(zones: Sequence[Zone], path: Path | str) -> None:
    """Write zones into a YAML file that `read_zones` reads, for a person to edit; `InputError` where that cannot be."""
    names: dict[tuple[float, ...], str] = {normal: name for name, normal in NORMALS.items()}
    row = partial(yaml_row, decimals=3)

    def box(corners: np.ndarray) -> str:
        return f"[{row(corners[0])}, {row(corners[1])}]"

    def form(zone: Zone) -> dict[str, Any]:
        angles = (("yaw", zone.yaw_rad), ("pitch", zone.pitch_rad), ("roll", zone.roll_rad))
        return {
            "normal": names.get(tuple(map(float, zone.normal))) or row(zone.normal),
            "centred": "true" if zone.is_centred else None,
            "behind_glass": "true" if zone.is_behind_glass else None,
            "kind": f"[{', '.join(zone.kinds)}]" if zone.kinds else None,
            "origin_m": row(zone.origin_m) if any(zone.origin_m) else None,
            "box_m": None if zone.box_m is None else box(zone.box_m),
            "outline_m": None if zone.outline_m is None else list(map(row, zone.outline_m)),
            "keep_out_m": list(map(box, zone.keep_out_m)) or None,
            "stand_off_m": row(zone.stand_off_m),
            "recess_m": None if zone.recess_m is None else f"{zone.recess_m:g}",
            **{f"{name}_deg": None if pair is None else row(np.degrees(pair)) for name, pair in angles},
        }

    head = "# Where on the body cameras may stand; metres and degrees in the ego frame (x forward, y left, z up)."
    lines = yaml_lines({"zones": {yaml_name(zone.name): form(zone) for zone in zones}})
    write_text(Path(path).expanduser(), "\n".join((head, *lines)) + "\n")
