"""Robots in URDF files: the meshes and solids that their links show, with every joint at 0 or as near as it may come.

Lengths are metres, x points forward and z up (REP 103), relative to the root link.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element

import numpy as np

from warpav.core.bounded_files import NODES_MAX, parse_xml, read_bytes
from warpav.core.frames import rotation_from_yaw_pitch_roll

if TYPE_CHECKING:
    import trimesh

_STILL = ("fixed", "floating", "planar")
_TURNING = ("revolute", "continuous")


@dataclass(frozen=True, eq=False)
class Visual:
    """What a link shows."""

    link: str
    root_from_shape: np.ndarray  # scale of its mesh among it, [4, 4]
    mesh: str | None  # name of a mesh file, as the file has it; None: the solid
    solid: trimesh.Trimesh | None
    rgb: np.ndarray | None  # 0..255, [3]; None where the file states none


def read_urdf(path: Path) -> list[Visual]:
    """What the links of a robot show.

    Raises:
        InputError: It is no XML.
        ValueError: It is no robot whose links are known; the text says why.
    """
    root = parse_xml(read_bytes(path, "a URDF file"), "", "a URDF file", nodes_max=NODES_MAX)
    if root.tag != "robot":
        raise ValueError(f"<{root.tag}> instead of <robot>")
    if any("xacro" in element.tag for element in root.iter() if isinstance(element.tag, str)):
        raise ValueError(f"xacro, which has to be expanded first: xacro {path.name} > robot.urdf")
    colours = {each.get("name", ""): _colour(each, {}) for each in root.findall("material")}
    place = _places(root)
    found = []
    for link in root.findall("link"):
        name = link.get("name", "")
        for visual in link.findall("visual"):
            shape = visual.find("geometry/*")
            if shape is None:
                raise ValueError(f"link {name!r}: a <visual> without geometry")
            matrix = place[name] @ _origin(visual)
            material = visual.find("material")
            rgb = None if material is None else _colour(material, colours)
            if shape.tag == "mesh":
                matrix = matrix @ np.diag([*_numbers(shape, "scale", "1 1 1", 3), 1.0])
                found.append(Visual(name, matrix, shape.get("filename", ""), None, rgb))
            else:
                found.append(Visual(name, matrix, None, _solid(shape, name), rgb))
    return found


def _places(root: Element) -> dict[str, np.ndarray]:
    """Where every link lies in the root link's frame, [4, 4]."""
    below: dict[str, list[tuple[str, np.ndarray]]] = {}
    children = set()
    for joint in root.findall("joint"):
        ends = [None if found is None else found.get("link") for found in map(joint.find, ("parent", "child"))]
        if not ends[0] or not ends[1] or ends[1] in children:
            raise ValueError(f"joint {joint.get('name')!r}: expected a parent, and a child that no other joint has")
        children.add(ends[1])
        below.setdefault(ends[0], []).append((ends[1], _origin(joint) @ _motion(joint)))
    links = [link.get("name", "") for link in root.findall("link")]
    roots = [link for link in links if link not in children]
    if len(roots) != 1:
        raise ValueError(f"expected joints that make one tree of {len(links)} links, got {len(roots)} roots")
    place, waiting = {roots[0]: np.eye(4)}, [roots[0]]
    while waiting:
        parent = waiting.pop()
        for child, parent_from_child in below.get(parent, ()):
            place[child] = place[parent] @ parent_from_child
            waiting.append(child)
    lost = [link for link in links if link not in place]
    if lost:
        raise ValueError(f"expected joints that make one tree, got a circle through {lost[0]!r}")
    return place


def _motion(joint: Element) -> np.ndarray:
    """What a joint does as near to 0 as its limits allow, [4, 4]."""
    from scipy.spatial.transform import Rotation

    kind, limit, mimic = joint.get("type", ""), joint.find("limit"), joint.find("mimic")
    moved = np.eye(4)
    if kind in _STILL:
        return moved
    if kind not in (*_TURNING, "prismatic"):
        raise ValueError(f"joint {joint.get('name')!r}: the type {kind!r}, which URDF does not have")
    value = 0.0 if mimic is None else _numbers(mimic, "offset", "0", 1)[0]
    if limit is not None and kind != "continuous":
        low, high = (_numbers(limit, key, "0", 1)[0] for key in ("lower", "upper"))
        value = float(np.clip(value, low, high)) if low <= high else value
    axis = joint.find("axis")
    along = np.array([1.0, 0.0, 0.0] if axis is None else _numbers(axis, "xyz", "1 0 0", 3))
    along /= max(float(np.linalg.norm(along)), 1e-12)
    if kind == "prismatic":
        moved[:3, 3] = value * along
    else:
        moved[:3, :3] = Rotation.from_rotvec(value * along).as_matrix()
    return moved


def _origin(element: Element) -> np.ndarray:
    origin, transform = element.find("origin"), np.eye(4)
    if origin is not None:
        roll, pitch, yaw = _numbers(origin, "rpy", "0 0 0", 3)
        transform[:3, :3] = rotation_from_yaw_pitch_roll(yaw, pitch, roll)
        transform[:3, 3] = _numbers(origin, "xyz", "0 0 0", 3)
    return transform


def _solid(shape: Element, link: str) -> trimesh.Trimesh:
    """The surface of a box, a cylinder along z or a sphere around the origin."""
    from trimesh import creation

    if shape.tag == "box":
        return creation.box(_numbers(shape, "size", "", 3))
    if shape.tag == "sphere":
        return creation.icosphere(3, _numbers(shape, "radius", "", 1)[0])
    if shape.tag == "cylinder":
        [radius], [length] = (_numbers(shape, key, "", 1) for key in ("radius", "length"))
        return creation.cylinder(radius, length)
    raise ValueError(f"link {link!r}: <{shape.tag}> instead of mesh, box, cylinder or sphere")


def _colour(material: Element, known: Mapping[str, np.ndarray | None]) -> np.ndarray | None:
    """Its own colour, 0..255, else that of its name."""
    colour = material.find("color")
    if colour is None:
        return known.get(material.get("name", ""))
    return np.clip(np.round(255.0 * np.array(_numbers(colour, "rgba", "", 4)[:3])), 0.0, 255.0)


def _numbers(element: Element, key: str, default: str, count: int) -> list[float]:
    text = element.get(key, default)
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"<{element.tag} {key}={text!r}> instead of {count} finite number{'s' if count > 1 else ''}")
    return numbers
