"""FCD output of SUMO: vehicles and people at every step, with the net and the vehicle types that lie beside it.

A position there is the middle of the front bumper, and an angle runs clockwise from north. Sizes are those of a type's
vType or, without one, SUMO's defaults of the class that the type is named after.
"""

from __future__ import annotations

import re
from array import array
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from warpav.core.bounded_files import DATA_SET_NODES_MAX, STREAM_NODES_MAX, parse_xml, read_parts
from warpav.core.errors import InputError
from warpav.scene.traffic.formats._rows import grouped, steps_of
from warpav.scene.traffic.recording import Lanelet, RecordedUser, Recording, recording_of

_TYPES = (".rou.xml", ".vtype.xml", ".add.xml")
_ATTRIBUTES, _SIZES, _LANE_WIDTH_M = ("x", "y", "angle", "speed"), ("length", "width", "height"), "3.2"

_KNOWN = {*_ATTRIBUTES, "id", "type", "z", "pos", "posLat", "lane", "edge", "slope", "signals", "odometer"}
_KNOWN |= {
    "acceleration",
    "accelerationLat",
    "speedLat",
    "distance",
    "vehicle",
    "arrivalDelay",
    "leaderID",
    "leaderGap",
    "leaderSpeed",
}
_Kind = tuple[str, tuple[float, float, float]]
# class and SUMO's default size by vClass, empty for no road user; words that are not here are as passenger
_KINDS: dict[str, _Kind] = {
    "passenger": ("car", (5.0, 1.8, 1.5)), **dict.fromkeys(("delivery", "emergency"), ("truck", (6.5, 2.16, 2.86))),
    "truck": ("truck", (7.1, 2.4, 2.4)), "trailer": ("truck", (16.5, 2.55, 4.0)),
    "bus": ("bus", (12.0, 2.5, 3.4)), "coach": ("bus", (14.0, 2.6, 4.0)),
    "motorcycle": ("motorcycle", (2.2, 0.9, 1.5)), "moped": ("motorcycle", (2.1, 0.8, 1.7)),
    "scooter": ("bicycle", (1.2, 0.5, 1.7)), **dict.fromkeys(("bicycle", "bike"), ("bicycle", (1.6, 0.65, 1.7))),
    **dict.fromkeys(("pedestrian", "ped", "wheelchair", "person"), ("pedestrian", (0.215, 0.478, 1.719))),
    **dict.fromkeys(("tram", "rail", "subway", "ship", "container", "aircraft", "drone"), ("", (0.0, 0.0, 0.0))),
}  # fmt: skip


def root_tag(file: Path) -> str:
    """The first tag of an XML file; empty where its beginning has none."""
    found = re.match(rb"(?s)(?>(?:\xef\xbb\xbf)?(?:\s+|<\?(?>.*?\?>)|<!--(?>.*?-->))*)<([\w.-]+)", _head(file))
    return found[1].decode(errors="replace") if found else ""


def files_of(file: Path) -> list[Path]:
    """The output, and the nets and types beside it."""
    return [file, *_beside(file, ".net.xml"), *_beside(file, *_TYPES)]


def read(file: Path) -> Recording:
    number_of: dict[tuple[str, str, str], int] = {}
    strange: set[str] = set()
    samples, times, at, who = array("d"), array("d"), array("q"), array("q")

    def take(timestep: Element) -> None:
        times.append(_float(timestep.get("time")))
        for each in timestep:  # people in a vehicle stand inside its element
            strange.update(each.attrib.keys() - _KNOWN)
            kind = each.get("type", "").partition("@")[0]  # behind @ stands whose own type it is
            who.append(number_of.setdefault((each.tag, each.get("id", ""), kind), len(number_of)))
            at.append(len(times) - 1)
            samples.extend([_float(each.get(name)) for name in _ATTRIBUTES])

    parse_xml(read_parts(file, "FCD output"), "", "whole FCD output", nodes_max=STREAM_NODES_MAX, take=take)
    track = np.array(samples).reshape(-1, 4)
    if np.isnan(track[:, :3]).all(axis=0).any():
        raise InputError("x, y and angle: expected all of every vehicle, got not all of any; see fcd-output.attributes")
    step_of_time, step_s = steps_of(np.array(times), "time of timesteps in seconds")
    step, yaw, has_speed = step_of_time[np.array(at)], np.radians(90.0 - track[:, 2]), np.isfinite(track[:, 3]).any()
    kinds, names, users, others = _kinds(file), list(number_of), [], []
    for row in grouped(np.array(who), step):
        tag, name, kind = names[who[row[0]]]
        category, size = kinds.get(kind) or _kind_of(kind, tag)
        if not category:
            others.append(kind or tag)
            continue
        back_m = 0.5 * size[0] * np.stack([np.cos(yaw[row]), np.sin(yaw[row])], axis=1)
        pose = np.c_[track[row, :2] - back_m, yaw[row]]
        name = f"person {name}" if tag == "person" else name  # whose ids may be those of vehicles
        users.append(RecordedUser(name, category, size, step[row], pose, track[row, 3] if has_speed else None))
    unknown = sorted({kind for _, _, kind in names} - {*kinds, *others})
    notes = [f"SUMO's default sizes without a vType of {', '.join(unknown[:5])}"] if unknown else []
    return recording_of(
        file.stem, "SUMO", step_s, _lanelets(file), users, passed_over=others, notes=notes, unread=strange
    )


def _head(file: Path) -> bytes:
    try:
        return next(read_parts(file, "XML", part_bytes=65_536), b"")
    except InputError:
        return b""


def _float(text: str | None) -> float:
    try:
        return float(text or "")
    except ValueError:
        return np.nan


def _kind_of(name: str, tag: str = "vehicle") -> _Kind:
    """Class and default size of a type by its name; the class is empty where it is no road user."""
    words = re.findall(r"[a-z]+", f"{name} {tag} passenger".lower().replace("type", " "))
    return _KINDS[next(word for word in words if word in _KINDS)]


def _beside(file: Path, *suffixes: str) -> list[Path]:
    """Files beside the output: those that the configuration at its head names or, without such, all."""
    found = [each for each in sorted(file.parent.iterdir()) if each.name.removesuffix(".gz").endswith(suffixes)]
    named = set(re.split(r'["/\\,]', _head(file).decode(errors="replace"))) if len(found) > 1 else ()
    return [each for each in found if each.name in named] or found


def _kinds(file: Path) -> dict[str, _Kind]:
    found: dict[str, _Kind] = {}

    def take(element: Element) -> None:
        for each in element.iter("vType"):
            category, usual = _kind_of(each.get("vClass") or each.get("guiShape") or each.get("id", ""))
            a, b, c = (_float(each.get(key, str(value))) for key, value in zip(_SIZES, usual, strict=True))
            found[each.get("id", "")] = category, (a, b, c)

    for each in _beside(file, *_TYPES):
        parse_xml(read_parts(each, "vTypes"), each.name, "vTypes", nodes_max=STREAM_NODES_MAX, take=take)
    return found


def _lanelets(file: Path) -> list[Lanelet]:
    nets = _beside(file, ".net.xml")
    if len(nets) > 1:
        raise InputError(f"net: expected the one that was simulated, got {nets[0].name} and {nets[1].name}; leave one")
    found: list[Lanelet] = []

    def take(edge: Element) -> None:
        function = edge.get("function", "")
        kinds = {"internal": ("intersection",), "crossing": ("crosswalk",)}.get(function, ())
        for lane in edge.findall("lane") if function != "walkingarea" else ():
            allowed = {_kind_of(word.partition("_")[0])[0] for word in lane.get("allow", "all").split()}
            if allowed <= {"", "pedestrian"} and function != "crossing":
                continue
            points = [[_float(value) for value in point.split(",")[:2]] for point in lane.get("shape", "").split()]
            if {len(point) for point in points} != {2} or not np.isfinite(points).all():
                raise InputError(f"{nets[0].name}: lane {lane.get('id')}: shape: expected points as x,y x,y")
            if np.ptp(points, axis=0).any():
                found.append(Lanelet.along(np.array(points), _float(lane.get("width", _LANE_WIDTH_M)), kinds))

    for each in nets:
        parse_xml(read_parts(each, "a net"), each.name, "a net", nodes_max=DATA_SET_NODES_MAX, take=take)
    return found
