"""Maps of lanelet2 (OSM): relations of type ``lanelet`` with a left and a right way.

Nodes stand where ``local_x`` and ``local_y`` say or, without them, where UTM puts their latitude and longitude.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from warpav.core.bounded_files import DATA_SET_BYTES_MAX, DATA_SET_NODES_MAX, parse_xml, read_parts
from warpav.core.errors import InputError
from warpav.scene.traffic.recording import Lanelet

_KIND = "a lanelet2 map"
_ON_FOOT = ("walkway", "shared_walkway", "stairs", "pedestrian_lane")  # subtypes that are no part of the road

_ELEMENTS = ("relation", "bounds", "note", "meta", "MetaInfo")
_TAGS = (
    "type",
    "subtype",
    "location",
    "region",
    "name",
    "one_way",
    "participant",
    "speed_limit",
    "turn_direction",
    "dynamic",
)
# UTM on WGS 84
_SCALE, _FALSE_EASTING_M = 0.9996, 500_000.0
_N = 1.0 / (2.0 * 298.257223563 - 1.0)
_RADIUS_M = 6_378_137.0 / (1.0 + _N) * (1.0 + _N**2 / 4.0 + _N**4 / 64.0)
_SERIES = (_N / 2.0 - 2.0 * _N**2 / 3.0 + 5.0 * _N**3 / 16.0, 13.0 * _N**2 / 48.0 - 3.0 * _N**3 / 5.0)  # to a cm


def maps_near(recording: Path) -> list[Path]:
    """The maps beside a recording, and in a folder ``maps`` of its folder or of the two above."""
    folders = recording.absolute().parents[:3]
    found = [*folders[0].glob("*.osm"), *(each for folder in folders for each in (folder / "maps").rglob("*.osm"))]
    return sorted(set(found))


def utm_m(latitude_deg: np.ndarray, longitude_deg: np.ndarray, meridian_deg: float) -> np.ndarray:
    """Easting and northing about a zone's central meridian, north of the equator, float64 [..., 2]."""
    latitude, longitude = np.radians(latitude_deg), np.radians(np.asarray(longitude_deg) - meridian_deg)
    root = 2.0 * math.sqrt(_N) / (1.0 + _N)
    t = np.sinh(np.arctanh(np.sin(latitude)) - root * np.arctanh(root * np.sin(latitude)))
    north, east = np.arctan2(t, np.cos(longitude)), np.arctanh(np.sin(longitude) / np.sqrt(1.0 + t**2))
    turns = [(2.0 * k * north, 2.0 * k * east, share) for k, share in enumerate(_SERIES, start=1)]
    x = east + sum(share * np.cos(a) * np.sinh(b) for a, b, share in turns)
    y = north + sum(share * np.sin(a) * np.cosh(b) for a, b, share in turns)
    return _SCALE * _RADIUS_M * np.stack([x, y], axis=-1) + [_FALSE_EASTING_M, 0.0]


def read_map(file: Path, origin_m: Sequence[float] | None = None, strange: set[str] | None = None) -> list[Lanelet]:
    """The lanes and crossings of a map; those that lack a side are left out.

    Elements, and tags of lanelets, that are not known are added to ``strange``.

    ``origin_m`` is the recording's origin in UTM, easting and northing; None where latitude and longitude are 0 there.
    """
    nodes: dict[str, list[float]] = {}
    ways: dict[str, tuple[list[str], bool]] = {}
    relations: list[tuple[str, dict[str, str]]] = []
    unknown = set() if strange is None else strange

    def take(element: Element) -> None:
        name, tags = element.get("id", ""), {each.get("k", ""): each.get("v", "") for each in element.iter("tag")}
        if element.tag == "node":
            texts = [element.get("lat"), element.get("lon"), tags.get("local_x", "nan"), tags.get("local_y", "nan")]
            try:
                nodes[name] = [float(text or "") for text in texts]
            except ValueError:
                raise InputError(f"{file}: node {name}: expected numbers as lat and lon, got {texts[:2]}") from None
        elif element.tag == "way":
            ways[name] = [each.get("ref", "") for each in element.iter("nd")], tags.get("type") == "virtual"
        elif element.tag not in _ELEMENTS:
            unknown.add(f"<{element.tag}>")
        elif element.tag == "relation" and tags.get("type") == "lanelet":
            members = [(each.get("role", ""), each.get("ref", "")) for each in element.iter("member")]
            sides = {role: ref for role, ref in members if role in ("left", "right")}
            unknown.update(f"lanelet {key}" for key in tags if key.partition(":")[0] not in _TAGS)
            relations.append((tags.get("subtype", "road"), sides))

    parts = read_parts(file, _KIND, bytes_max=DATA_SET_BYTES_MAX)
    parse_xml(parts, str(file), _KIND, nodes_max=DATA_SET_NODES_MAX, take=take)
    number = {name: k for k, name in enumerate(nodes)}
    point_m = _places(np.array([*nodes.values()]).reshape(-1, 4), origin_m)
    found = []
    for subtype, sides in relations:
        names = [ways.get(sides.get(side, ""), ([], False))[0] for side in ("left", "right")]
        lines = [point_m[[number[name] for name in each if name in number]] for each in names]
        if subtype in _ON_FOOT or min(map(len, lines)) < 2:
            continue
        unpainted = any(ways[ref][1] for ref in sides.values())
        kinds = ("crosswalk",) if subtype == "crosswalk" else ("intersection",) if unpainted else ()
        found.append(Lanelet(*_in_driving_direction(lines[0], lines[1]), kinds))
    return found


def _places(node: np.ndarray, origin_m: Sequence[float] | None) -> np.ndarray:
    """Positions [m] of nodes by latitude, longitude, and local x and y or NaN, float64 [node, 2]."""
    if np.isfinite(node[:, 2:]).all():
        return node[:, 2:]
    longitude_deg = 0.0 if origin_m is None else float(np.median(np.nan_to_num(node[:, 1])))
    meridian_deg = 6.0 * math.floor(longitude_deg / 6.0) + 3.0
    with np.errstate(all="ignore"):  # what lies nowhere becomes NaN
        place_m = utm_m(node[:, 0], node[:, 1], meridian_deg)
    return place_m - (utm_m(np.zeros(()), np.zeros(()), meridian_deg) if origin_m is None else np.asarray(origin_m))


def _in_driving_direction(left_m: np.ndarray, right_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Borders that run alike, and so that the left one lies to the left; a map may have either way round."""
    ends = [np.linalg.norm(left_m[[0, -1]] - each[[0, -1]], axis=1).sum() for each in (right_m, right_m[::-1])]
    right_m = right_m[::-1] if ends[1] < ends[0] else right_m
    x, y = np.concatenate([left_m, right_m[::-1]]).T
    clockwise = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() < 0.0
    return (left_m, right_m) if clockwise else (left_m[::-1], right_m[::-1])
