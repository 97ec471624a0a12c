"""Zones: where on the body cameras may stand, each a height field over a plane of its own, and their YAML file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from warpav.core.errors import InputError
from warpav.core.files import atomic_write, writing
from warpav.core.json_schema import (
    FLAG,
    NUMBER,
    TEXT,
    Schema,
    described,
    document,
    either,
    items,
    mapping,
    named,
)
from warpav.core.yaml_file import yaml_name
from warpav.rig.formats.record import Record, read_yaml_record

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

_RANGE = either(NUMBER, items(NUMBER, 2), {"type": "null"})
_POINT = items(NUMBER, 3)
_BOX = either(items(_POINT, 2), items(NUMBER, 6))
_FORMS: dict[str, Schema] = {
    "normal": described(either({"enum": list(NORMALS)}, _POINT), "which way is outwards"),
    "kind": described(either(TEXT, items(TEXT), {"type": "null"}), "what kind of place it is, as modules name them"),
    "centred": described(FLAG, "cameras stand alone in the middle, with y = 0"),
    "behind_glass": described(FLAG, "cameras stand inside and look through the body"),
    "origin_m": described(_POINT, "a point of the zone's plane"),
    "box_m": described(either(_BOX, {"type": "null"}), "lowest and highest corner of what belongs to the zone"),
    "outline_m": described(items(_POINT, least=3), "corners of a convex polygon, in order along its border"),
    "keep_out_m": described(items(_BOX), "boxes that carry no camera"),
    "stand_off_m": described(_RANGE, "how far a camera's centre stands off the skin: a number, or [least, greatest]"),
    "recess_m": described(
        either({"type": "number", "minimum": 0}, {"type": "null"}), "how deep a housing may go into the body"
    ),
    "yaw_deg": described(_RANGE, "left positive: a number, or [least, greatest]"),
    "pitch_deg": described(_RANGE, "nose down positive: a number, or [least, greatest]"),
    "roll_deg": described(_RANGE, "right side down positive: a number, or [least, greatest]"),
    "mirror": described(FLAG, "whether its mirror image on the other side is a zone as well"),
}
"""Every key of a zone in a file, and its schema."""


def zones_schema() -> Schema:
    """The JSON Schema of a file of zones, of the keys by which `read_zones` reads it."""
    zones = named(mapping(_FORMS, ["normal"]), about="zones by name")
    return document("zones", "zones of a vehicle's body that may carry cameras", mapping({"zones": zones}, ["zones"]))


@dataclass(frozen=True, eq=False)
class Zone:
    """A part of the body that may carry cameras, and how they may stand there.

    A camera's centre is at ``origin_m + u * U + v * V + (height(u, v) + rise) * N``, with the rows U, V and N of
    ``axes``; the rise is the stand-off, behind glass it is inwards. Yaw, pitch and roll are those of the ego frame,
    wherever the zone is.

    Attributes:
        outline_m: Corners of a convex polygon in the ego frame, in order along the border [m], [corner, 3]: only what
            is inside of it, seen along the normal, belongs to the zone; None: no matter.
        axes: Rows U, V and N in the ego frame: V upwards along the zone, or on a level one forwards; upright zones that
            face up have those of the ego frame; float64 [3, 3].
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
    outline_m: np.ndarray | None = None
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


def read_zones(path: Path | str) -> tuple[Zone, ...]:
    """Read a file of zones: ``zones``, a mapping from names to what they are.

    A zone has a ``normal`` (up, left, right, front, rear, or three numbers), and may have ``kind`` (a name or a list of
    them, as the ``zones`` of modules name them), ``centred``, ``origin_m``, ``box_m`` and
    ``keep_out_m`` (boxes as [lowest corner, highest corner]), ``outline_m`` (corners of a convex polygon),
    ``behind_glass`` (cameras stand inside and look through), ``stand_off_m``, ``yaw_deg``, ``pitch_deg`` and
    ``roll_deg`` (a number, or [least, greatest]); see `Zone`. Beside it, ``mirror: true`` adds its mirror image on the
    other side of the vehicle, called ``<name>_mirrored``.
    """
    file = Path(path).expanduser()
    record = read_yaml_record(file)
    record.fields(("zones",), "a mapping with zones")
    zones: list[Zone] = []
    for name, each in record.at("zones").mapping("a mapping from names to zones").items():
        zone = _zone(name, each)
        zones.append(zone)
        if each.at("mirror").value is True:
            zones.append(mirrored(zone))
    if not zones:
        raise record.at("zones").error("at least one zone")
    return tuple(zones)


def _zone(name: str, record: Record) -> Zone:
    fields = record.fields(_FORMS, "a zone: a mapping with normal")
    if record.at("mirror").flag() and record.at("centred").flag():
        raise record.at("mirror").error("false, as a centred zone is its own mirror image", "true")
    box = record.at("box_m")
    try:
        return Zone(
            name=name,
            normal=_normal(record.at("normal")),
            origin_m=tuple(record.at("origin_m").numbers(3)) if "origin_m" in fields else (0.0, 0.0, 0.0),  # pyright: ignore[reportArgumentType]
            box_m=None if box.value is None else _box(box),
            keep_out_m=tuple(_box(each) for each in record.at("keep_out_m").items("a list of boxes"))
            if "keep_out_m" in fields
            else (),
            stand_off_m=_range(record.at("stand_off_m"))
            or (BEHIND_GLASS_M if record.at("behind_glass").flag() else _FLUSH_M),
            yaw_rad=_radians(record.at("yaw_deg")),
            pitch_rad=_radians(record.at("pitch_deg")),
            roll_rad=_radians(record.at("roll_deg")),
            kinds=_kinds(record.at("kind")),
            is_centred=bool(record.at("centred").flag()),
            is_behind_glass=bool(record.at("behind_glass").flag()),
            recess_m=None if record.at("recess_m").value is None else record.at("recess_m").number(),
            outline_m=np.array([each.numbers(3) for each in record.at("outline_m").items("a list of corners")])
            if "outline_m" in fields
            else None,
        )
    except ValueError as error:
        raise InputError(str(error) if isinstance(error, InputError) else f"{record.location}: {error}") from None


def _normal(record: Record) -> tuple[float, float, float]:
    if isinstance(record.value, str):
        return NORMALS[record.one_of(NORMALS, ", or three numbers")]
    numbers = np.array(record.numbers(3))
    length = float(np.linalg.norm(numbers))
    if length < 1e-6:
        raise record.error("a direction", "one of length 0")
    x, y, z = (numbers / length).tolist()
    return x, y, z


def _kinds(record: Record) -> tuple[str, ...]:
    given = record.value if isinstance(record.value, list) else [] if record.value is None else [record.value]
    for each in given:
        if not isinstance(each, str):
            raise record.error("a kind of place, or a list of them, such as [b_pillar, mirror]", f"{each!r}")
    return tuple(given)


def _is_convex(corner: np.ndarray) -> bool:
    """Whether points [corner, 2] are those of a convex polygon in order along its border."""
    if len(corner) < 3:
        return False
    side = np.roll(corner, -1, axis=0) - corner
    after = np.roll(side, -1, axis=0)
    turn = side[:, 0] * after[:, 1] - side[:, 1] * after[:, 0]
    turned_rad = np.arctan2(turn, (side * after).sum(axis=1)).sum()
    slack = 1e-3 * np.linalg.norm(side, axis=1) * np.linalg.norm(after, axis=1)  # numbers in files are rounded
    is_one_way = bool((turn >= -slack).all() or (turn <= slack).all())
    return is_one_way and abs(abs(turned_rad) - 2.0 * math.pi) < 1e-6


def _box(record: Record) -> np.ndarray:
    corners = np.array(record.matrix(2, 3))
    if not (corners[0] < corners[1]).all():
        raise record.error("a box: its lowest corner, then its highest", f"{corners.tolist()}")
    return corners


def _range(record: Record) -> tuple[float, float] | None:
    if record.value is None:
        return None
    if isinstance(record.value, list):
        low, high = record.numbers(2)
    else:
        low = high = record.number()
    if low > high:
        raise record.error("a range, the lower end first")
    return low, high


def _radians(record: Record) -> tuple[float, float] | None:
    pair = _range(record)
    return None if pair is None else (math.radians(pair[0]), math.radians(pair[1]))


def mirrored(zone: Zone) -> Zone:
    """The mirror image of a zone on the other side of the vehicle, called ``<name>_mirrored``."""

    def box(corners: np.ndarray) -> np.ndarray:
        low_m, high_m = corners
        return np.array([[low_m[0], -high_m[1], low_m[2]], [high_m[0], -low_m[1], high_m[2]]])

    x, y, z = zone.normal
    origin = zone.origin_m

    def turned(pair: tuple[float, float] | None) -> tuple[float, float] | None:
        return None if pair is None else (-pair[1], -pair[0])

    return Zone(
        name=f"{zone.name}_mirrored",
        normal=(x, -y, z),
        origin_m=(origin[0], -origin[1], origin[2]),
        box_m=None if zone.box_m is None else box(zone.box_m),
        keep_out_m=tuple(box(each) for each in zone.keep_out_m),
        stand_off_m=zone.stand_off_m,
        pitch_rad=zone.pitch_rad,
        kinds=zone.kinds,
        is_behind_glass=zone.is_behind_glass,
        recess_m=zone.recess_m,
        outline_m=None if zone.outline_m is None else np.asarray(zone.outline_m)[::-1] * [1.0, -1.0, 1.0],
        yaw_rad=turned(zone.yaw_rad),
        roll_rad=turned(zone.roll_rad),
    )


def write_zones(zones: Sequence[Zone], path: Path | str) -> None:
    """Write zones into a YAML file that `read_zones` reads, for a person to edit."""
    names = {normal: name for name, normal in NORMALS.items()}

    def numbers(values: Sequence[float] | np.ndarray) -> str:
        return "[" + ", ".join(f"{float(value) + 0.0:.3f}".rstrip("0").rstrip(".") or "0" for value in values) + "]"

    def box(corners: np.ndarray) -> str:
        return f"[{numbers(corners[0])}, {numbers(corners[1])}]"

    lines = [
        "# Where on the body cameras may stand; metres and degrees in the ego frame (x forward, y left, z up).",
        "zones:",
    ]
    for zone in zones:
        normal = names.get(tuple(float(each) for each in zone.normal))  # pyright: ignore[reportArgumentType]
        lines += [f"  {yaml_name(zone.name)}:", f"    normal: {normal or numbers(zone.normal)}"]
        if zone.is_centred:
            lines.append("    centred: true")
        if zone.is_behind_glass:
            lines.append("    behind_glass: true")
        if zone.kinds:
            lines.append(f"    kind: [{', '.join(zone.kinds)}]")
        if any(zone.origin_m):
            lines.append(f"    origin_m: {numbers(zone.origin_m)}")
        if zone.box_m is not None:
            lines.append(f"    box_m: {box(zone.box_m)}")
        if zone.outline_m is not None:
            lines += ["    outline_m:", *(f"      - {numbers(corner)}" for corner in zone.outline_m)]
        if zone.keep_out_m:
            lines += ["    keep_out_m:", *(f"      - {box(each)}" for each in zone.keep_out_m)]
        lines.append(f"    stand_off_m: {numbers(zone.stand_off_m)}")
        if zone.recess_m is not None:
            lines.append(f"    recess_m: {zone.recess_m:g}")
        for name, pair in (("yaw", zone.yaw_rad), ("pitch", zone.pitch_rad), ("roll", zone.roll_rad)):
            if pair is not None:
                lines.append(f"    {name}_deg: {numbers(np.degrees(pair))}")
    file = Path(path).expanduser()
    with writing(file), atomic_write(file) as draft:
        draft.write_text("\n".join(lines) + "\n", encoding="utf-8")
