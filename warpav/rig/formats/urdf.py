"""ROS 2 URDF: a chain of fixed joints to each camera's link and optical link; lenses in camera_info files beside it."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

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
from warpav.rig.formats.record import Record, is_number, read_text

BASE = "base_link"
_FILE = "rig.urdf"
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
    text = read_text(path, "a URDF file")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"{path}:{error.position[0]}: expected a URDF file, got a syntax error: {error}") from None
    if root.tag != "robot":
        raise InputError(f"{path}: expected a URDF file with <robot>, got <{root.tag}>")
    if "/xacro" in text and any("xacro" in element.tag for element in root.iter()):
        raise InputError(f"{path}: expected a plain URDF, got xacro; run: xacro {path.name} > rig.urdf")
    links = [link.get("name", "") for link in root.findall("link")]
    joint_of = _joints(root, path)
    optical = {link: match[1] for link in links if (match := _OPTICAL.fullmatch(link))}
    above = {ancestor for link in optical for ancestor in _chain(link, joint_of, path)}
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
    cameras = []
    for link in links:
        if link in optical or link in plain:
            transform = _between(base, link, joint_of, path)
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


def _chain(link: str, joint_of: dict[str, _Joint], path: Path) -> list[str]:
    """The links above a link, up to the root."""
    above: list[str] = []
    while link in joint_of:
        link = joint_of[link].parent
        if link in above:
            raise InputError(f"{path}: expected a tree of links, got a circle through {link!r}")
        above.append(link)
    return above


def _between(base: str, link: str, joint_of: dict[str, _Joint], path: Path) -> np.ndarray:
    """Coordinates of ``link`` brought to ``base``; both may hang below a third link."""
    to_base, to_link = ([end, *_chain(end, joint_of, path)] for end in (base, link))
    shared = next((each for each in to_link if each in to_base), None)
    if shared is None:
        raise InputError(f"{path}: link {link!r}: expected joints that lead to {base!r}, got none")
    transforms = []
    for ends in (to_base, to_link):
        transform = np.eye(4)
        for child in ends[: ends.index(shared)]:
            joint = joint_of[child]
            if joint.kind != "fixed":
                raise InputError(
                    f"{path}: joint {joint.name!r}: expected a fixed joint on the path from {base!r} to {link!r}, got "
                    f"type {joint.kind!r}"
                )
            transform = joint.parent_from_child @ transform
        transforms.append(transform)
    shared_from_base, shared_from_link = transforms
    return np.linalg.inv(shared_from_base) @ shared_from_link if to_base[0] != shared else shared_from_link


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
