"""ROS: URDF, Autoware's two calibration files, and camera_info YAML, which lies beside these.

URDF is a chain of fixed joints to each camera's link and optical link; camera_info is image size and lens of one
camera without its pose.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from warpav.core.bounded_files import parse_xml, read_bytes
from warpav.core.errors import InputError
from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.core.yaml_file import yaml_lines, yaml_number, yaml_row
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.rig.formats._format import (
    Found,
    FoundCamera,
    Losses,
    Optics,
    PlacedCamera,
    Record,
    RigFormat,
    brown_conrady,
    camera_matrix,
    even_beams,
    is_number,
    lidar_model,
    link_of_transform,
    optics_of_matrix,
    read_yaml_record,
    unread_note,
)

# ------------------------------------------------------------------------------------------------------ camera_info

FOLDER = "camera_info"
"""Folder of these files in exports and imports."""

_MODELS = {
    "plumb_bob": (Lens.BROWN_CONRADY, (0, 4, 5, 8)),
    "rational_polynomial": (Lens.BROWN_CONRADY, (8, 12, 14)),
    "equidistant": (Lens.FISHEYE, (4,)),
}
_RECTIFIED = ("rows", "cols", "header", "rectification_matrix", "projection_matrix", "R", "P", "r", "p")
"""Keys of the rectified image and of the message; images are read as they come from the camera."""


def read_camera_infos(path: Path) -> tuple[dict[str, Optics], list[str]]:
    """The optics in a camera_info file or in all those of a folder, and what is not read of them."""
    files = [path]
    if path.is_dir():
        files = sorted(file for end in ("yaml", "yml") for file in (*path.glob(f"*.{end}"), *path.glob(f"*/*.{end}")))
        if not files:
            raise InputError(f"{path}: expected a folder with camera_info YAML files, got none in it")
    found: dict[str, Optics] = {}
    notes: list[str] = []
    for file in files:
        record = read_yaml_record(file)
        optics = _optics_of_info(record)
        found[file.parent.name if file.stem == "camera_info" else file.stem] = optics
        if record.at("camera_name").value is not None:
            found.setdefault(record.at("camera_name").text(), optics)
        notes += unread_note(file, record.unread(*_RECTIFIED))
    return found, notes


def _optics_of_info(record: Record) -> Optics:
    """The optics of a camera_info mapping: a calibration file, or the message of a ROS topic."""
    record.mapping("a camera_info mapping with image_width, image_height, camera_matrix and distortion_model")
    lens, counts = _MODELS[record.at("distortion_model").one_of(_MODELS)]
    matrix = record.first_of("camera_matrix", "k", "K")
    is_message = isinstance(matrix.value, list)
    if is_message:
        coefficients, sides = record.first_of("d", "D"), ("width", "height")
    else:
        matrix, sides = matrix.at("data"), ("image_width", "image_height")
        coefficients = record.at("distortion_coefficients").at("data")
    distortion = []
    if coefficients.value is not None or 0 not in counts:
        distortion = coefficients.numbers(*counts) if lens is Lens.FISHEYE else brown_conrady(coefficients, *counts)
    width_px, height_px = (record.at(side).whole() for side in sides)
    optics = optics_of_matrix(matrix, lens=lens, distortion=distortion, width_px=width_px, height_px=height_px)
    return _cut(record, optics) if is_message else optics


def _cut(record: Record, optics: Optics) -> Optics:
    """The optics of the image as it is sent: a region of the sensor's, in which pixels are joined (REP 104)."""
    assert optics.focal_px is not None
    assert optics.centre_px is not None
    roi = record.at("roi")
    if roi.at("do_rectify").value not in (None, False, 0):
        raise roi.at("do_rectify").error("false; a rectified image has another camera matrix")
    joined = [max(1, record.at(f"binning_{axis}").whole(0)) for axis in "xy"]
    first = [roi.at(f"{axis}_offset").whole(0) for axis in "xy"]
    whole = (optics.width_px or 0, optics.height_px or 0)
    width_px, height_px = (
        (roi.at(side).whole(0) or whole[k]) // joined[k] for k, side in enumerate(("width", "height"))
    )
    fx, fy = (optics.focal_px[k] / joined[k] for k in (0, 1))
    cx, cy = ((optics.centre_px[k] - first[k]) / joined[k] for k in (0, 1))
    return replace(optics, width_px=width_px, height_px=height_px, focal_px=(fx, fy), centre_px=(cx, cy))


def _camera_info(camera: PlacedCamera, losses: Losses) -> bytes:
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
    with_images = (camera for camera in cameras if not camera.model.beams)
    return {folder / f"{camera.name}.yaml": _camera_info(camera, losses) for camera in with_images}


# ------------------------------------------------------------------------------------------------------------- URDF

_BASE = "base_link"
_NAME_MAX = 200  # beyond which links are no cameras; the patterns below are quadratic in it
_OPTICAL = re.compile(r"(.+?)[/_](?:camera_)?optical_(?:link|frame)")
_LINK = re.compile(r"(.+?)[/_]camera_link|((?:.*[/_])?camera[^/]*?)_link")
_NO_CAMERA = re.compile(
    r"(?:^|[/_])(?:accel|accelerometer|gyro|gyroscope|imu|depth|infra|infrared|ir|tof|lidar)\d*(?=[/_]|$)"
)
_LIDAR = re.compile(
    r"(.+?)/lidar_(?:base_)?link|(?=.*(?:lidar|velodyne|hesai|ouster|pandar|livox|robosense))(.+?)(?:_base)?_(?:link|frame)",
    re.IGNORECASE,
)
"""Links of LiDARs, by the words of Autoware's sensor kits and of drivers."""
_SENSORS_WITH_COLOUR = ("camera", "wideanglecamera", "rgbd_camera", "rgbd", "multicamera")
_SENSORS_OF_BEAMS = ("ray", "gpu_ray", "lidar", "gpu_lidar")
_TAGS = {
    "robot": {"link", "joint", "material", "gazebo", "transmission", "ros2_control"},
    "joint": {
        *("origin", "parent", "child", "axis", "limit", "dynamics", "calibration", "mimic", "safety_controller"),
        "hardwareInterface",
    },
}
"""What is known below an element; of a link nothing matters but its name."""


@dataclass(frozen=True)
class _Joint:
    name: str
    kind: str
    parent: str
    parent_from_child: np.ndarray


def _read_urdf(path: Path) -> Found:
    """The cameras of a URDF: its optical links, and camera links that have none, relative to ``base_link``; LiDARs."""
    content = read_bytes(path, "a URDF file")
    root = parse_xml(content, str(path), "a URDF file")
    if root.tag != "robot":
        raise InputError(f"{path}: expected a URDF file with <robot>, got <{root.tag}>")
    if b"/xacro" in content and any("xacro" in element.tag for element in root.iter()):
        raise InputError(f"{path}: expected a plain URDF, got xacro; run: xacro {path.name} > rig.urdf")
    links = [link.get("name", "")[:_NAME_MAX] for link in root.findall("link")]
    joint_of = _joints(root, path)
    sensors, others, beams_of = _simulated(root, path)
    optical = {link: match[1] for link in links if (match := _OPTICAL.fullmatch(link))}
    for link in optical:  # a simulator's camera hangs at the link before the optical one, and looks along its x
        before = joint_of[link].parent if link in joint_of else link
        sensors |= {link: sensors.pop(before)} if before in sensors else {}
        others |= {link} if before in others else set()
    above = _above(optical, joint_of)
    plain = {
        link: match[1] or match[2]
        for link in links
        if link not in optical and link not in above and (match := _LINK.fullmatch(link))
    }
    plain |= {link: re.sub(r"_(?:link|frame)$", "", link) for link in sensors if link in links and link not in optical}
    name_of = {**optical, **plain}
    both = [link for link in sensors if link in beams_of]
    lidars = {link: re.sub(r"_(?:link|frame)$", "", link) for link in beams_of if link in links and link not in both}
    lidars |= {
        link: match[1] or match[2]
        for link in links
        if (link in lidars or link not in name_of) and (match := _LIDAR.fullmatch(link))
    }
    above = _above(lidars, joint_of)
    lidars = {link: name for link, name in lidars.items() if link in beams_of or link not in above}
    if not optical and not plain and not lidars:
        raise InputError(
            f"{path}: expected links such as front/camera_optical_link or front/camera_link, got none among "
            f"{len(links)} links"
        )
    base = _BASE if _BASE in links else next((link for link in links if link not in joint_of), links[0])
    tree = _Tree(base, joint_of, path)
    others |= {link for link, name in name_of.items() if link not in sensors and _NO_CAMERA.search(name)}
    if others >= name_of.keys():
        others = set()
    cameras, notes = [], [f"{', '.join(both)}: the camera of <gazebo> is read, not the LiDAR"] if both else []
    for link in links:
        if link in lidars:
            try:
                transform = tree.base_from(link)
            except InputError as error:
                notes.append(f"LiDAR {lidars[link]} is not read: {error}")
                continue
            transform[:3, :3] = transform[:3, :3] @ FLU_FROM_RDF
            model = beams_of.get(link)
            cameras.append(FoundCamera(lidars[link], transform, model, lacks_beams=model is None))
        elif link in name_of and link not in others:
            transform = tree.base_from(link)
            if link in plain:
                transform[:3, :3] = transform[:3, :3] @ FLU_FROM_RDF
            cameras.append(FoundCamera(name_of[link], transform, sensors.get(link)))
    notes += [] if base == _BASE else [f"there is no {_BASE}, so poses are relative to the root link {base}"]
    if left := [link for link in links if link in others & name_of.keys()]:
        notes.append(f"{', '.join(left)}: taken for no cameras, by their names or by <gazebo>")
    strange = (f"<{below.tag}>" for above in (root, *root.findall("joint")) for below in above
               if isinstance(below.tag, str) and below.tag not in _TAGS[above.tag])  # fmt: skip
    return Found(tuple(cameras), (*notes, *unread_note(path, strange)))


def _simulated(
    root: ElementTree.Element, path: Path
) -> tuple[dict[str, Optics], set[str], dict[str, CameraModel | None]]:
    """What <gazebo> holds by link: images of cameras, links of other sensors, LiDARs (None: of a single line)."""
    cameras: dict[str, Optics] = {}
    others: set[str] = set()
    lidars: dict[str, CameraModel | None] = {}
    for holder in root.findall("gazebo"):
        link = holder.get("reference", "")[:_NAME_MAX]
        for sensor in holder.findall("sensor"):
            kind = sensor.get("type")
            if kind not in (*_SENSORS_WITH_COLOUR, *_SENSORS_OF_BEAMS):
                others.add(link)
                continue
            place = f"{path}: <gazebo reference={link!r}>"
            pose = (sensor.findtext("pose") or "0").split()
            if any(word.strip("+-0.") for word in pose):
                raise InputError(f"{place}: pose: expected none beside that of the link, got {' '.join(pose)!r}")
            if kind in _SENSORS_OF_BEAMS:
                others.add(link)
                lidars[link] = _simulated_beams(sensor, place)
                continue
            bent = [each for each in sensor.findall("camera/distortion/*") if each.tag != "center"]
            if any((each.text or "").strip("+-0. ") for each in bent) or sensor.find("camera/lens") is not None:
                raise InputError(f"{place}: expected a camera without <distortion> and <lens>, got one")
            keys = ("horizontal_fov", "image/width", "image/height")
            fov_rad, width_px, height_px = (_number_below(sensor, f"camera/{key}", place) for key in keys)
            if not 0.0 < fov_rad < math.pi:
                raise InputError(f"{place}: horizontal_fov: expected an angle between 0 and pi, got {fov_rad:g}")
            cameras[link] = Optics(int(width_px), int(height_px), fov_rad=fov_rad)
    return cameras, others - cameras.keys(), lidars


def _simulated_beams(sensor: ElementTree.Element, place: str) -> CameraModel | None:
    """The model of a sensor with <ray> or <lidar>; rays lie at both angles and evenly between."""
    below = "ray" if sensor.find("lidar") is None else "lidar"
    horizontal, vertical = (f"{below}/scan/{name}" for name in ("horizontal", "vertical"))
    lines = _samples(sensor, vertical, place, "1")
    if lines == 1:  # which is no LiDAR of warpav
        return None
    shots = _samples(sensor, horizontal, place)
    low, high, right, left = (
        _number_below(sensor, f"{name}/{key}_angle", place) for name in (vertical, horizontal) for key in ("min", "max")
    )
    if shots < 2 or not right < left:
        raise InputError(f"{place}: {horizontal}: expected 2 samples or more from min_angle up to max_angle, got other")
    step_rad = (left - right) / (shots - 1)
    return lidar_model(
        place,
        elevation_rad=(low, high),
        lines=lines,
        step_rad=step_rad,
        azimuth_rad=(right - 0.5 * step_rad, left + 0.5 * step_rad),
        range_m=_number_below(sensor, f"{below}/range/max", place),
        least_range_m=_number_below(sensor, f"{below}/range/min", place, "0"),
        rate_hz=_number_below(sensor, "update_rate", place, "10"),
    )


def _samples(sensor: ElementTree.Element, key: str, place: str, default: str = "") -> int:
    """Points of a scan: rays, and those that <resolution> adds between or takes away."""
    return round(
        _number_below(sensor, f"{key}/samples", place, default) * _number_below(sensor, f"{key}/resolution", place, "1")
    )


def _number_below(element: ElementTree.Element, key: str, place: str, default: str = "") -> float:
    text = element.findtext(key) or default
    try:
        return Record(f"{place}: {key}", float(text)).number()
    except ValueError as error:
        raise error if isinstance(error, InputError) else Record(f"{place}: {key}", text).error("a number") from None


def _joints(root: ElementTree.Element, path: Path) -> dict[str, _Joint]:
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
    if strange := set(origin.keys()) - {"xyz", "rpy"}:
        raise InputError(f"{path}: joint {joint!r}: origin: expected xyz and rpy, got {', '.join(sorted(strange))}")
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
    """``NAME/camera_link`` and ``NAME/camera_optical_link`` below ``base_link``; camera_info files beside it.

    LiDARs have ``NAME/lidar_link``, and their beams stand in <gazebo>.
    """
    robot = ElementTree.Element("robot", name="rig")
    ElementTree.SubElement(robot, "link", name=_BASE)
    optical_rpy = (-0.5 * math.pi, 0.0, -0.5 * math.pi)
    for camera in cameras:
        kind = "lidar" if camera.model.beams else "camera"
        link, optical = f"{camera.name}/{kind}_link", f"{camera.name}/camera_optical_link"
        position_m, angle = link_of_transform(camera.file_from_camera)
        _add_link(robot, _BASE, link, position_m, [angle["roll_rad"], angle["pitch_rad"], angle["yaw_rad"]])
        if camera.model.beams:
            _add_beams(robot, link, camera, losses)
            continue
        _add_link(robot, link, optical, (0.0, 0.0, 0.0), optical_rpy)
    ElementTree.indent(robot)
    text = '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"
    return {target: text.encode(), **_camera_infos(cameras, target.parent / FOLDER, losses)}


def _add_beams(robot: ElementTree.Element, link: str, camera: PlacedCamera, losses: Losses) -> None:
    """The shots of one scan: rays from the middle of the last cell to that of the first one at the left."""
    beams = even_beams(camera, losses)
    shots = max(round(beams.sector_rad / beams.step_rad), 2)
    left_rad = beams.azimuth_rad[1] - 0.5 * beams.step_rad
    up_rad = beams.elevation_rad
    gazebo = f"""<gazebo reference="{link}"><sensor name="{camera.name}" type="gpu_lidar">
        <update_rate>{beams.rate_hz!r}</update_rate>
        <lidar><scan><horizontal><samples>{shots}</samples>
            <min_angle>{left_rad - (shots - 1) * beams.step_rad!r}</min_angle><max_angle>{left_rad!r}</max_angle>
        </horizontal><vertical><samples>{len(up_rad)}</samples>
            <min_angle>{up_rad[0]!r}</min_angle><max_angle>{up_rad[-1]!r}</max_angle>
        </vertical></scan>
        <range><min>{camera.model.near_m!r}</min><max>{beams.range_m[0]!r}</max></range></lidar>
    </sensor></gazebo>"""
    robot.append(ElementTree.fromstring(gazebo))


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
_LEANS = math.sqrt(0.5)
_UNITS_MAX = 8  # that hang at one another
_LINK_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
_LINK_NAME = re.compile(r"(.+?)(?:[/_]camera)?(?:_optical)?_(?:link|frame)")


def _read_autoware(path: Path) -> Found:
    """The cameras of all files: those of the kit or of several units, and those that hang at base_link directly."""
    folder = path if path.is_dir() else path.parent
    if not (folder / _SENSORS).is_file() and not (folder / _KIT).is_file():
        raise InputError(f"{path}: expected a folder with {_SENSORS} and {_KIT}, or one of them, got neither")
    files = dict.fromkeys([folder / _SENSORS, *sorted(folder.glob("*calibration.yaml"))])
    records = [read_yaml_record(file) for file in files]
    base = records[0].at(_BASE).mapping(f"a mapping of the links at {_BASE}")
    if _KIT_LINK in base and folder / _KIT not in files:
        read_yaml_record(folder / _KIT)  # which is not there
    links: dict[str, tuple[str, Record]] = {}
    for record in records:
        for parent, below in record.mapping().items():
            links |= {child: (parent, each) for child, each in below.mapping(f"a mapping of links at {parent}").items()}
    placed: list[tuple[str, np.ndarray]] = []
    lidars: dict[str, str] = {}
    for link in links:
        if (match := _LIDAR.fullmatch(link[:_NAME_MAX])) and "camera" not in link:
            lidars[link] = match[1] or match[2]
        elif not _LINK_NAME.fullmatch(link) or "camera" not in link:
            continue
        transform, at = np.eye(4), link
        for _ in range(_UNITS_MAX):
            if at in links:
                at, record = links[at]
                transform = _link_transform(record) @ transform
        if at != _BASE:
            raise InputError(f"{folder / _SENSORS}: {at}: expected where it lies, for {link} hangs at it, got nothing")
        placed.append((link, transform))
    if not placed:
        raise InputError(f"{folder / _KIT}: {_KIT_LINK}: expected links such as camera0/camera_link, got none")
    notes = [note for file, record in zip(files, records, strict=True) for note in unread_note(file, record.unread())]
    plain = [link for link, _ in placed if "optical" not in link and link not in lidars]
    likely = [link for link, transform in placed if link in plain and _is_upright(transform)]
    are_optical = len(likely) > 1 and likely == plain
    if likely:
        how = "is read so" if are_optical else "is not read so; name such a link camera_optical_link"
        notes.append(f"{', '.join(likely)}: x right, y down, z forward, as an optical frame, by its angles; it {how}")
    for link, transform in placed:
        if link in lidars or (link in plain and not are_optical):
            transform[:3, :3] = transform[:3, :3] @ FLU_FROM_RDF
    cameras = (
        FoundCamera(lidars.get(link) or _LINK_NAME.fullmatch(link)[1], transform, lacks_beams=link in lidars)  # pyright: ignore[reportOptionalSubscript]
        for link, transform in placed
    )
    return Found(tuple(cameras), tuple(notes))


def _is_upright(transform: np.ndarray) -> bool:
    """Whether it is that of an optical frame of a camera that looks ahead and stands upright, within 45 deg each."""
    return transform[2, 1] < -_LEANS and abs(transform[2, 2]) < _LEANS


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
    # cameras that all lie on their side have links as optical frames are; they are written as such frames
    link_from_camera = np.eye(4)
    link_from_camera[:3, :3] = FLU_FROM_RDF
    with_images = [each.file_from_camera for each in cameras if not each.model.beams]
    lie = len(with_images) > 1 and all(_is_upright(each @ link_from_camera.T) for each in with_images)
    for camera in cameras:
        placed, link = camera.file_from_camera, "camera_link"
        if camera.model.beams:
            link = "lidar_base_link"
        elif lie:
            placed, link = placed @ link_from_camera, "camera_optical_link"
        position_m, angle = link_of_transform(placed)
        numbers = [*position_m, angle["roll_rad"], angle["pitch_rad"], angle["yaw_rad"]]
        kit[f"{camera.name}/{link}"] = _link(numbers)
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
        lidars="beams",
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
        lidars="frames",
    ),
)
