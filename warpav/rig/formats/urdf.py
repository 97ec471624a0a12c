"""ROS 2 URDF: a chain of fixed joints to each camera's link and optical link; lenses in camera_info files beside it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from warpav.core.bounded_files import parse_xml, read_bytes
from warpav.core.errors import InputError
from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.rig.formats.camera_info import FOLDER, camera_info_files
from warpav.rig.formats.format import (
    Found,
    FoundCamera,
    Losses,
    PlacedCamera,
    RigFormat,
    file_at,
    file_in,
    link_of_transform,
)
from warpav.rig.formats.record import Record, is_number

BASE = "base_link"
_FILE = "rig.urdf"
_NAME_MAX = 200  # beyond which links are no cameras; the patterns below are quadratic in it
_OPTICAL = re.compile(r"(.+?)[/_](?:camera_)?optical_(?:link|frame)")
_LINK = re.compile(r"(.+?)[/_]camera_link|((?:.*[/_])?camera[^/]*?)_link")


@dataclass(frozen=True)
class _Joint:
    name: str
    kind: str
    parent: str
    parent_from_child: np.ndarray


def read(path: Path, part: str | None) -> Found:
    """The cameras of a URDF: its optical links, and camera links that have none, relative to ``base_link``."""
    del part
    path = file_in(path, _FILE)
    content = read_bytes(path, "a URDF file")
    root = parse_xml(content, str(path), "a URDF file")
    if root.tag != "robot":
        raise InputError(f"{path}: expected a URDF file with <robot>, got <{root.tag}>")
    if b"/xacro" in content and any("xacro" in element.tag for element in root.iter()):
        raise InputError(f"{path}: expected a plain URDF, got xacro; run: xacro {path.name} > rig.urdf")
    links = [link.get("name", "")[:_NAME_MAX] for link in root.findall("link")]
    joint_of = _joints(root, path)
    optical = {link: match[1] for link in links if (match := _OPTICAL.fullmatch(link))}
    above = _above(optical, joint_of)
    plain = {
        link: match[1] or match[2]
        for link in links
        if link not in optical and link not in above and (match := _LINK.fullmatch(link))
    }
    if not optical and not plain:
        raise InputError(
            f"{path}: expected links such as front/camera_optical_link or front/camera_link, got none among "
            f"{len(links)} links"
        )
    base = BASE if BASE in links else next((link for link in links if link not in joint_of), links[0])
    tree = _Tree(base, joint_of, path)
    cameras = []
    for link in links:
        if link in optical or link in plain:
            transform = tree.base_from(link)
            if link in plain:
                transform[:3, :3] = transform[:3, :3] @ FLU_FROM_RDF
            cameras.append(FoundCamera({**optical, **plain}[link], transform))
    notes = () if base == BASE else (f"there is no {BASE}, so poses are relative to the root link {base}",)
    return Found(tuple(cameras), notes)


def _joints(root: ElementTree.Element, path: Path) -> dict[str, _Joint]:
    """The joint that leads to every link."""
    joint_of: dict[str, _Joint] = {}
    for element in root.findall("joint"):
        name = element.get("name", "")
        ends = [None if found is None else found.get("link") for found in map(element.find, ("parent", "child"))]
        parent, child = ends
        if not parent or not child:
            raise InputError(f"{path}: joint {name!r}: expected <parent link=...> and <child link=...>, got less")
        if child in joint_of:
            raise InputError(f"{path}: joint {name!r}: expected every link once as child, got {child!r} again")
        origin = element.find("origin")
        transform = np.eye(4)
        if origin is not None:
            roll, pitch, yaw = _triple(origin, "rpy", name, path)
            transform[:3, :3] = rotation_from_yaw_pitch_roll(yaw, pitch, roll)
            transform[:3, 3] = _triple(origin, "xyz", name, path)
        joint_of[child] = _Joint(name, element.get("type", ""), parent, transform)
    return joint_of


def _triple(origin: ElementTree.Element, key: str, joint: str, path: Path) -> list[float]:
    words = origin.get(key, "0 0 0").split()
    try:
        numbers: list = [float(word) for word in words]
    except ValueError:
        numbers = words
    record = Record(f"{path}: joint {joint!r}: {key}", numbers)
    if len(numbers) != 3 or not all(map(is_number, numbers)):
        raise record.error("three finite numbers", repr(" ".join(words)))
    return numbers


def _above(links: Iterable[str], joint_of: Mapping[str, _Joint]) -> set[str]:
    """The links above some links, up to the root."""
    above: set[str] = set()
    for link in links:
        below = link
        while below in joint_of and (parent := joint_of[below].parent) not in above:
            above.add(parent)
            below = parent
    return above


class _Tree:
    """Where links are from the base; each is worked out once, so that chains of thousands of links take no time.

    Both may hang below a third link. A joint that moves matters to the links beyond it alone.
    """

    def __init__(self, base: str, joint_of: Mapping[str, _Joint], path: Path) -> None:
        self._base, self._joint_of, self._path = base, joint_of, path
        self._place: dict[str, tuple[np.ndarray, _Joint | None]] = {base: (np.eye(4), None)}
        link = base
        while link in joint_of:  # to the root, against the direction of the joints
            joint = joint_of[link]
            if joint.parent in self._place:
                raise self._circle(joint.parent)
            base_from_link, moving = self._place[link]
            self._place[joint.parent] = (
                base_from_link @ np.linalg.inv(joint.parent_from_child),
                moving or self._if_moving(joint),
            )
            link = joint.parent

    def base_from(self, link: str) -> np.ndarray:
        """Coordinates of a link brought to the base, [4, 4]."""
        climbed: dict[str, None] = {}
        at = link
        while at not in self._place:
            if at not in self._joint_of:
                raise InputError(f"{self._path}: link {link!r}: expected joints that lead to {self._base!r}, got none")
            if at in climbed:
                raise self._circle(at)
            climbed[at] = None
            at = self._joint_of[at].parent
        for child in reversed(climbed):
            joint = self._joint_of[child]
            base_from_parent, moving = self._place[joint.parent]
            self._place[child] = (base_from_parent @ joint.parent_from_child, moving or self._if_moving(joint))
        base_from_link, moving = self._place[link]
        if moving is not None:
            raise InputError(
                f"{self._path}: joint {moving.name!r}: expected a fixed joint on the path from {self._base!r} to "
                f"{link!r}, got type {moving.kind!r}"
            )
        return base_from_link.copy()

    def _circle(self, link: str) -> InputError:
        return InputError(f"{self._path}: expected a tree of links, got a circle through {link!r}")

    @staticmethod
    def _if_moving(joint: _Joint) -> _Joint | None:
        return None if joint.kind == "fixed" else joint


def write(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    """``NAME/camera_link`` and ``NAME/camera_optical_link`` below ``base_link``; camera_info files beside it."""
    robot = ElementTree.Element("robot", name="rig")
    ElementTree.SubElement(robot, "link", name=BASE)
    optical_rpy = (-0.5 * math.pi, 0.0, -0.5 * math.pi)
    for camera in cameras:
        link, optical = f"{camera.name}/camera_link", f"{camera.name}/camera_optical_link"
        position_m, angle = link_of_transform(camera.file_from_camera)
        _add_link(robot, BASE, link, position_m, [angle["roll_rad"], angle["pitch_rad"], angle["yaw_rad"]])
        _add_link(robot, link, optical, (0.0, 0.0, 0.0), optical_rpy)
    ElementTree.indent(robot)
    text = '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"
    file = file_at(target, (".urdf", ".xml"), _FILE)
    return {file: text.encode(), **camera_info_files(cameras, file.parent / FOLDER, losses)}


def _add_link(robot: ElementTree.Element, parent: str, child: str, xyz: Sequence[float], rpy: Sequence[float]) -> None:
    ElementTree.SubElement(robot, "link", name=child)
    joint = ElementTree.SubElement(robot, "joint", name=f"{child}_joint", type="fixed")
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    places = {"xyz": " ".join(map(repr, map(float, xyz))), "rpy": " ".join(map(repr, map(float, rpy)))}
    ElementTree.SubElement(joint, "origin", attrib=places)


FORMAT = RigFormat(
    "urdf",
    frame="link to base_link, x forward, y left, z up, right-handed, metres; rpy in radians about fixed axes; optical "
    "links x right, y down, z forward",
    origin="base_link's, which is taken to lie on the ground below the centre of the rear axle",
    is_ego_origin=True,
    read=read,
    write=write,
)
