"""ROS: URDF, Autoware's two calibration files, and camera_info YAML, which lies beside these.

URDF is a chain of fixed joints to each camera's link and optical link; camera_info is image size and lens of one
camera without its pose.
"""

from __future__ import annotations

import json
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
from warpav.core.yaml_file import yaml_lines, yaml_number, yaml_row
from warpav.raster.lens import Lens
from warpav.rig.formats._format import (
    Found,
    FoundCamera,
    Losses,
    Optics,
    PlacedCamera,
    Record,
    RigFormat,
    camera_matrix,
    is_number,
    link_of_transform,
    optics_of_matrix,
    read_yaml_record,
)

# ------------------------------------------------------------------------------------------------------ camera_info

FOLDER = "camera_info"
"""Folder of these files in exports and imports."""

_MODELS = {
    "plumb_bob": (Lens.BROWN_CONRADY, (0, 4, 5)),
    "rational_polynomial": (Lens.BROWN_CONRADY, (8,)),
    "equidistant": (Lens.FISHEYE, (4,)),
}


def read_camera_infos(path: Path) -> dict[str, Optics]:
    """The optics in a camera_info file or in all those of a folder."""
    files = [path]
    if path.is_dir():
        files = sorted(file for end in ("yaml", "yml") for file in (*path.glob(f"*.{end}"), *path.glob(f"*/*.{end}")))
        if not files:
            raise InputError(f"{path}: expected a folder with camera_info YAML files, got none in it")
    found: dict[str, Optics] = {}
    for file in files:
        record = read_yaml_record(file)
        optics = _optics_of_info(record)
        found[file.parent.name if file.stem == "camera_info" else file.stem] = optics
        if record.at("camera_name").value is not None:
            found.setdefault(record.at("camera_name").text(), optics)
    return found


def _optics_of_info(record: Record) -> Optics:
    """The optics of a camera_info mapping."""
    record.mapping("a camera_info mapping with image_width, image_height, camera_matrix and distortion_model")
    lens, counts = _MODELS[record.at("distortion_model").one_of(_MODELS)]
    coefficients = record.at("distortion_coefficients").at("data")
    distortion = coefficients.numbers(*counts) if coefficients.value is not None or 0 not in counts else []
    return optics_of_matrix(
        record.at("camera_matrix").at("data"),
        lens=lens,
        distortion=distortion,
        width_px=record.at("image_width").whole(),
        height_px=record.at("image_height").whole(),
    )


def _camera_info(camera: PlacedCamera, losses: Losses) -> bytes:
    """The file of one camera."""
    model = camera.model
    if model.lens not in (Lens.PINHOLE, Lens.BROWN_CONRADY, Lens.FISHEYE):
        raise losses.unsupported(camera.name, f"a {model.lens} lens")
    wanted = {Lens.FISHEYE: 4}.get(model.lens, 8 if len(model.distortion) == 8 else 5)
    distortion = [*model.distortion, *(0.0,) * (wanted - len(model.distortion))]
    name = {4: "equidistant", 5: "plumb_bob", 8: "rational_polynomial"}[wanted]
    matrix = np.array(camera_matrix(model))
    lines = [
        f"image_width: {model.width_px}",
        f"image_height: {model.height_px}",
        f"camera_name: {json.dumps(camera.name)}",
        *_matrix("camera_matrix", matrix),
        f"distortion_model: {name}",
        *_matrix("distortion_coefficients", np.array([distortion])),
        *_matrix("rectification_matrix", np.eye(3)),
        *_matrix("projection_matrix", np.c_[matrix, np.zeros(3)]),
    ]
    return ("\n".join(lines) + "\n").encode()


def _matrix(name: str, matrix: np.ndarray) -> list[str]:
    return [f"{name}:", f"  rows: {matrix.shape[0]}", f"  cols: {matrix.shape[1]}", f"  data: {yaml_row(matrix.flat)}"]


def _camera_infos(cameras: Sequence[PlacedCamera], folder: Path, losses: Losses) -> dict[Path, bytes]:
    """The files of all cameras, ``NAME.yaml`` each."""
    return {folder / f"{camera.name}.yaml": _camera_info(camera, losses) for camera in cameras}


# ------------------------------------------------------------------------------------------------------------- URDF

_BASE = "base_link"
_NAME_MAX = 200  # beyond which links are no cameras; the patterns below are quadratic in it
_OPTICAL = re.compile(r"(.+?)[/_](?:camera_)?optical_(?:link|frame)")
_LINK = re.compile(r"(.+?)[/_]camera_link|((?:.*[/_])?camera[^/]*?)_link")


@dataclass(frozen=True)
class _Joint:
    name: str
    kind: str
    parent: str
    parent_from_child: np.ndarray


def _read_urdf(path: Path) -> Found:
    """The cameras of a URDF: its optical links, and camera links that have none, relative to ``base_link``."""
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
    base = _BASE if _BASE in links else next((link for link in links if link not in joint_of), links[0])
    tree = _Tree(base, joint_of, path)
    cameras = []
    for link in links:
        if link in optical or link in plain:
            transform = tree.base_from(link)
            if link in plain:
                transform[:3, :3] = transform[:3, :3] @ FLU_FROM_RDF
            cameras.append(FoundCamera({**optical, **plain}[link], transform))
    notes = () if base == _BASE else (f"there is no {_BASE}, so poses are relative to the root link {base}",)
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
    """Where links are from the base, each worked out once; a joint that moves matters to the links beyond it alone."""

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


def _write_urdf(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    """``NAME/camera_link`` and ``NAME/camera_optical_link`` below ``base_link``; camera_info files beside it."""
    robot = ElementTree.Element("robot", name="rig")
    ElementTree.SubElement(robot, "link", name=_BASE)
    optical_rpy = (-0.5 * math.pi, 0.0, -0.5 * math.pi)
    for camera in cameras:
        link, optical = f"{camera.name}/camera_link", f"{camera.name}/camera_optical_link"
        position_m, angle = link_of_transform(camera.file_from_camera)
        _add_link(robot, _BASE, link, position_m, [angle["roll_rad"], angle["pitch_rad"], angle["yaw_rad"]])
        _add_link(robot, link, optical, (0.0, 0.0, 0.0), optical_rpy)
    ElementTree.indent(robot)
    text = '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"
    return {target: text.encode(), **_camera_infos(cameras, target.parent / FOLDER, losses)}


def _add_link(robot: ElementTree.Element, parent: str, child: str, xyz: Sequence[float], rpy: Sequence[float]) -> None:
    ElementTree.SubElement(robot, "link", name=child)
    joint = ElementTree.SubElement(robot, "joint", name=f"{child}_joint", type="fixed")
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    places = {"xyz": " ".join(map(repr, map(float, xyz))), "rpy": " ".join(map(repr, map(float, rpy)))}
    ElementTree.SubElement(joint, "origin", attrib=places)


# --------------------------------------------------------------------------------------------------------- Autoware

_SENSORS, _KIT = "sensors_calibration.yaml", "sensor_kit_calibration.yaml"
_KIT_LINK = "sensor_kit_base_link"
_LINK_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
_LINK_NAME = re.compile(r"(.+?)(?:[/_]camera)?(?:_optical)?_(?:link|frame)")


def _read_autoware(path: Path) -> Found:
    """The cameras of both files: those of the kit, and those that hang at base_link directly."""
    folder = path if path.is_dir() else path.parent
    if not (folder / _SENSORS).is_file() and not (folder / _KIT).is_file():
        raise InputError(f"{path}: expected a folder with {_SENSORS} and {_KIT}, or one of them, got neither")
    sensors, kits = (read_yaml_record(folder / name) for name in (_SENSORS, _KIT))
    base = sensors.at(_BASE)
    base.mapping(f"a mapping of the links at {_BASE}")
    base_from_kit = _link_transform(base.at(_KIT_LINK))
    kit = kits.at(_KIT_LINK)
    kit.mapping(f"a mapping of the links at {_KIT_LINK}")
    cameras = [*_link_cameras(kit, base_from_kit), *_link_cameras(base, np.eye(4))]
    if not cameras:
        raise InputError(f"{folder / _KIT}: {_KIT_LINK}: expected links such as camera0/camera_link, got none")
    return Found(tuple(cameras))


def _link_cameras(links: Record, base_from_parent: np.ndarray) -> list[FoundCamera]:
    found = []
    for link, record in links.mapping().items():
        match = _LINK_NAME.fullmatch(link)
        if match is None or "camera" not in link:
            continue
        transform = base_from_parent @ _link_transform(record)
        if "optical" not in link:
            transform[:3, :3] = transform[:3, :3] @ FLU_FROM_RDF
        found.append(FoundCamera(match[1], transform))
    return found


def _link_transform(record: Record) -> np.ndarray:
    record.mapping("a mapping with x, y, z, roll, pitch, yaw")
    x, y, z, roll, pitch, yaw = (record.at(key).number() for key in _LINK_KEYS)
    transform = np.eye(4)
    transform[:3, :3] = rotation_from_yaw_pitch_roll(yaw, pitch, roll)
    transform[:3, 3] = x, y, z
    return transform


def _write_autoware(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    """Both files, the kit at base_link itself, and camera_info files in a folder beside them."""
    kit = {}
    for camera in cameras:
        position_m, angle = link_of_transform(camera.file_from_camera)
        numbers = [*position_m, angle["roll_rad"], angle["pitch_rad"], angle["yaw_rad"]]
        kit[f"{camera.name}/camera_link"] = _link(numbers)
    contents = {_SENSORS: {_BASE: {_KIT_LINK: _link([0.0] * 6)}}, _KIT: {_KIT_LINK: kit}}
    return {
        **{target / name: ("\n".join(yaml_lines(content)) + "\n").encode() for name, content in contents.items()},
        **_camera_infos(cameras, target / FOLDER, losses),
    }


def _link(numbers: Sequence[float]) -> dict[str, str]:
    return dict(zip(_LINK_KEYS, map(yaml_number, numbers), strict=True))


FORMATS = (
    RigFormat(
        "urdf",
        frame="link to base_link, x forward, y left, z up, right-handed, metres; rpy in radians about fixed axes; "
        "optical links x right, y down, z forward",
        origin="base_link's, which is taken to lie on the ground below the centre of the rear axle",
        is_ego_origin=True,
        files=("rig.urdf",),
        suffixes=(".urdf", ".xml"),
        read=_read_urdf,
        write=_write_urdf,
    ),
    RigFormat(
        "camera-info",
        frame="cameras x right, y down, z forward, pixels; no poses",
        origin="none",
        is_ego_origin=True,
        files=(),
        suffixes=(".yaml", ".yml"),
        read=None,
        write=_camera_info,
        note="camera_info holds no poses; urdf and autoware do",
    ),
    RigFormat(
        "autoware",
        frame="camera_link to sensor_kit_base_link to base_link, x forward, y left, z up, right-handed, metres; roll, "
        "pitch, yaw in radians about fixed axes",
        origin="base_link's, on the ground below the centre of the rear axle",
        is_ego_origin=True,
        files=(_SENSORS, _KIT),
        suffixes=(".yaml", ".yml"),
        read=_read_autoware,
        write=_write_autoware,
    ),
)
