"""Data sets: nuScenes, Argoverse 2 (extra ``av2``) and KITTI.

nuScenes: ``calibrated_sensor.json``, with ``sensor.json`` (names) and ``sample_data.json`` (image sizes) beside it.

Argoverse 2: ``calibration/egovehicle_SE3_sensor.feather`` and ``calibration/intrinsics.feather``.

KITTI's object calibration: ``P0`` to ``P3``, ``R0_rect`` and ``Tr_velo_to_cam``, from the lidar's frame to cameras. One
file holds cameras with one orientation (they are rectified together), so a rig is written as a folder with one file a
camera, whose four matrices are equal; such a folder is read as a rig, and so is a single file of the data set. KITTI
keeps no image sizes here; exports add them as ``S_rect_00`` to ``S_rect_03``, the key of its raw calibration, behind
everything that its readers look for.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from warpav.core.bounded_files import DATA_SET_NODES_MAX, feather_library, read_arrow, read_text, refuse_levels
from warpav.core.errors import InputError
from warpav.core.frames import FLU_FROM_RDF, quaternion_from_rotation
from warpav.raster.lens import Lens
from warpav.rig.formats._format import (
    Found,
    FoundCamera,
    Losses,
    PlacedCamera,
    Record,
    RigFormat,
    brown_conrady,
    camera_matrix,
    optics_of,
    optics_of_matrix,
    pinhole_of,
    read_json_record,
    rigid_transform,
    unread_note,
)

# --------------------------------------------------------------------------------------------------------- nuScenes

_TABLE = "calibrated_sensor.json"
_CHUNK = 1 << 20
_BETWEEN = re.compile(r"[\s,]*")
_LIDAR_FROM_RDF = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""The axes of nuScenes's LiDAR are x right, y forward, z up."""


def _read_nuscenes(file: Path, part: str | None) -> Found:
    name_of, lidars = _names(file.parent)
    rows = _rows(file)
    rows = [row for row in rows if row.peek("camera_intrinsic").value != [] or row.at("sensor_token").value in lidars]
    if part is not None:
        used = _tokens_of_scene(file.parent, part)
        rows = [row for row in rows if row.peek("token").text() in used]
    if not rows:
        raise InputError(f"{file}: expected rows with a camera_intrinsic, got none" + (f" of {part}" if part else ""))
    names = [name_of.get(row.at("sensor_token").text(""), f"camera_{i}") for i, row in enumerate(rows)]
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise InputError(
            f"{file}: expected one row a camera, got {count} of {name}; `part` SCENE takes those of a scene, such as "
            "`part` scene-0061 (scene.json, sample.json and sample_data.json must lie beside the file)"
        )
    with_images = {row.at("token").text("") for row in rows if row.at("sensor_token").value not in lidars}
    size_of = _sizes(file.parent, with_images)
    cameras = []
    for row, name in zip(rows, names, strict=True):
        rotation = row.at("rotation")
        transform = rigid_transform(
            rotation.unit_quaternion(rotation.numbers(4)), row.at("translation").numbers(3), rotation
        )
        if row.at("sensor_token").value in lidars:
            transform[:3, :3] = transform[:3, :3] @ _LIDAR_FROM_RDF
            cameras.append(FoundCamera(name, transform, lacks_beams=True))
            continue
        width_px, height_px = size_of.get(row.at("token").text(""), (None, None))
        bent = row.at("camera_distortion")  # of nuImages and T4
        optics = optics_of_matrix(
            row.at("camera_intrinsic"),
            lens=Lens.BROWN_CONRADY,
            distortion=_opencv_distortion(bent) if bent.value else (),
            width_px=width_px,
            height_px=height_px,
        )
        cameras.append(FoundCamera(name, transform, optics))
    notes = () if name_of else ("there is no sensor.json beside the file, so cameras are numbered",)
    unread = (key for row in rows for key in row.unread("token", "camera_intrinsic"))
    return Found(tuple(cameras), (*notes, *unread_note(file, unread)))


def _opencv_distortion(record: Record) -> list[float]:
    """Of nuImages the sixth number, the next power of the radius, is that of its rear camera alone."""
    if len(record.numbers(4, 5, 6, 8)) == 6:
        if record.numbers()[5]:
            raise record.error("k1 k2 p1 p2 k3, as OpenCV has them; a sixth number that is not 0 is no lens of warpav")
        return record.numbers()[:5]
    return brown_conrady(record)


def _rows(file: Path) -> list[Record]:
    kind = f"nuScenes's {file.name}"
    return read_json_record(file, kind, nodes_max=DATA_SET_NODES_MAX).items(f"{kind}, a list of rows")


def _row_by_row(file: Path) -> Iterator[Record]:
    """The rows of a table of any size: sample_data of the whole data set takes 1 GB as text, ten times as much read."""
    decoder = json.JSONDecoder()
    text, i, count = "", 0, 0
    try:
        with file.open(encoding="utf-8") as stream:
            if stream.read(1) != "[":
                raise InputError(f"{file}: expected nuScenes's {file.name}, a list of rows, got something else")
            while chunk := stream.read(_CHUNK):
                text, i = text[i:] + chunk, 0
                while True:
                    i = _BETWEEN.match(text, i).end()  # pyright: ignore[reportOptionalMemberAccess]  # matches nothing too
                    try:
                        row, i = decoder.raw_decode(text, i)
                    except ValueError:
                        break  # the rest of the row, or the end
                    except RecursionError:
                        refuse_levels(f"{file}: [{count}]")
                    record = Record(file, row, (str(count),))
                    record.mapping("a row")
                    yield record
                    count += 1
                if len(text) - i > _CHUNK:
                    raise InputError(f"{file}: [{count}]: expected a row of at most {_CHUNK >> 20} MiB, got more")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise InputError(f"{file}: expected nuScenes's {file.name}, got: {reason}") from None
    if text[i:].strip() != "]":
        raise InputError(f"{file}: expected valid JSON, got a mistake in or behind row {count}")


def _names(folder: Path) -> tuple[dict[str, str], set[str]]:
    file = folder / "sensor.json"
    rows = _rows(file) if file.is_file() else []
    lidars = {row.at("token").text() for row in rows if row.at("modality").value == "lidar"}
    return {row.at("token").text(): row.at("channel").text() for row in rows}, lidars


def _sizes(folder: Path, tokens: set[str]) -> dict[str, tuple[int, int]]:
    file = folder / "sample_data.json"
    if not file.is_file():
        return {}
    size_of: dict[str, tuple[int, int]] = {}
    for row in _row_by_row(file):
        if len(size_of) == len(tokens):
            break
        token = row.at("calibrated_sensor_token").text("")
        if token in tokens and token not in size_of and row.at("width").value:
            size_of[token] = (row.at("width").whole(), row.at("height").whole())
    return size_of


def _tokens_of_scene(folder: Path, scene: str) -> set[str]:
    scenes = {row.at("name").text(): row.at("token").text() for row in _rows(folder / "scene.json")}
    if scene not in scenes:
        some = ", ".join(sorted(scenes)[:5])
        raise InputError(f"{folder / 'scene.json'}: expected a scene named {scene!r}, got {len(scenes)}: {some} ...")
    samples = {
        row.at("token").text() for row in _rows(folder / "sample.json") if row.at("scene_token").value == scenes[scene]
    }
    return {
        row.at("calibrated_sensor_token").text()
        for row in _row_by_row(folder / "sample_data.json")
        if row.at("sample_token").text("") in samples
    }


def _write_nuscenes(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    """The table and the two beside it; of sample_data only the image sizes."""
    tables: dict[str, list[dict]] = {_TABLE: [], "sensor.json": [], "sample_data.json": []}
    for camera in cameras:
        model = None if camera.model.beams else pinhole_of(camera, losses)
        turn = camera.file_from_camera[:3, :3] @ (np.eye(3) if model else _LIDAR_FROM_RDF.T)
        sensor, calibration, data = (_token(kind, camera.name) for kind in ("sensor", "calibration", "data"))
        modality = "camera" if model else "lidar"
        tables["sensor.json"].append({"token": sensor, "channel": camera.name, "modality": modality})
        tables[_TABLE].append(
            {
                "token": calibration,
                "sensor_token": sensor,
                "translation": camera.file_from_camera[:3, 3].tolist(),
                "rotation": quaternion_from_rotation(turn).tolist(),
                "camera_intrinsic": camera_matrix(model) if model else [],
            }
        )
        if model is None:
            continue
        tables["sample_data.json"].append(
            {
                "token": data,
                "sample_token": "",
                "ego_pose_token": "",
                "calibrated_sensor_token": calibration,
                "timestamp": 0,
                "fileformat": "jpg",
                "is_key_frame": False,
                "height": model.height_px,
                "width": model.width_px,
                "filename": "",
                "prev": "",
                "next": "",
            }
        )
    return {
        target if name == _TABLE else target.parent / name: (json.dumps(rows, indent=1) + "\n").encode()
        for name, rows in tables.items()
    }


def _token(kind: str, name: str) -> str:
    """32 hexadecimal digits, as the data set's tokens, the same for the same camera."""
    return hashlib.sha256(f"warpav {kind} {name}".encode()).hexdigest()[:32]


# ------------------------------------------------------------------------------------------------------ Argoverse 2

_POSES, _INTRINSICS = "egovehicle_SE3_sensor.feather", "intrinsics.feather"
_QUATERNION, _POSITION = ("qw", "qx", "qy", "qz"), ("tx_m", "ty_m", "tz_m")
_CAMERA, _DISTORTION = ("fx_px", "fy_px", "cx_px", "cy_px"), ("k1", "k2", "k3")


def _read_argoverse2(path: Path) -> Found:
    """The cameras and LiDARs of a log's calibration: its folder, the folder above it, or the file of poses."""
    folder = path if path.is_dir() else path.parent
    if path.is_dir() and (path / "calibration").is_dir():
        folder = path / "calibration"
    lenses = {row.at("sensor_name").text(): row for row in _feather_rows(folder / _INTRINSICS)}
    cameras, unread = [], []
    is_distorted = False
    for row in _feather_rows(folder / _POSES):
        name = row.peek("sensor_name").text()
        row.at("sensor_name")
        quaternion = [row.at(column).number() for column in _QUATERNION]
        transform = rigid_transform(
            row.unit_quaternion(quaternion), [row.at(column).number() for column in _POSITION], row
        )
        unread += row.unread()
        if name not in lenses:
            transform[:3, :3] = transform[:3, :3] @ FLU_FROM_RDF
            cameras.append(FoundCamera(name, transform, lacks_beams=True))
            continue
        lens = lenses[name]
        intrinsics_px = [lens.at(column).number() for column in _CAMERA]
        at = Record(f"{lens.location}: {', '.join(_CAMERA)}", intrinsics_px)
        width_px, height_px = (lens.at(name).whole() for name in ("width_px", "height_px"))
        optics = optics_of(at, *intrinsics_px, width_px=width_px, height_px=height_px)
        is_distorted |= any(lens.peek(column).number(0.0) for column in _DISTORTION)
        cameras.append(FoundCamera(name, transform, optics))
        unread += lens.unread("sensor_name", *_DISTORTION)
    if not cameras:
        raise InputError(f"{folder / _POSES}: expected a sensor, got none")
    note = "k1, k2, k3 are not read: Argoverse 2 publishes undistorted images, they belong to the lens before that"
    return Found(tuple(cameras), (*((note,) if is_distorted else ()), *unread_note(folder, unread)))


def _feather_rows(file: Path) -> list[Record]:
    return Record(file, read_arrow(file, "Argoverse 2's feather file").to_pylist()).items()


def _write_argoverse2(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    """Both files; k1 to k3 are 0, because they describe a lens before its images are undistorted."""
    arrow, feather = feather_library()
    poses: dict[str, list] = {"sensor_name": [], **{name: [] for name in (*_QUATERNION, *_POSITION)}}
    columns = (*_CAMERA, *_DISTORTION, "height_px", "width_px")
    lenses: dict[str, list] = {"sensor_name": [], **{name: [] for name in columns}}
    for camera in cameras:
        is_lidar = camera.model.beams is not None
        turn = camera.file_from_camera[:3, :3] @ (FLU_FROM_RDF.T if is_lidar else np.eye(3))
        quaternion = quaternion_from_rotation(turn)
        pose = [camera.name, *quaternion.tolist(), *camera.file_from_camera[:3, 3].tolist()]
        for column, value in zip(poses.values(), pose, strict=True):
            column.append(value)
        if is_lidar:
            continue
        model = pinhole_of(camera, losses)
        (fx, _, cx), (_, fy, cy), _ = camera_matrix(model)
        lens = [camera.name, fx, fy, cx, cy, 0.0, 0.0, 0.0, model.height_px, model.width_px]
        for column, value in zip(lenses.values(), lens, strict=True):
            column.append(value)
    kinds = {"sensor_name": arrow.string(), "height_px": arrow.uint16(), "width_px": arrow.uint16()}
    folder = target if target.name == "calibration" else target / "calibration"
    files = {}
    for name, table in ((_POSES, poses), (_INTRINSICS, lenses)):
        schema = arrow.schema([(column, kinds.get(column, arrow.float64())) for column in table])
        stream = io.BytesIO()
        feather.write_feather(arrow.table(table, schema=schema), stream)
        files[folder / name] = stream.getvalue()
    return files


# ------------------------------------------------------------------------------------------------------------ KITTI

_COUNT = 4
_RAW, _RAW_LIDAR = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"
_KITTI_LINE = re.compile(r"\s*([^\s:]+)(?::|\s+(?=[-+.\d]))(.*)")  # tracking leaves colons out
_UNPLACED = (
    *("Tr_imu_to_velo", "Tr_imu_velo", "calib_time", "corner_dist"),
    *(f"{key}_0{i}" for key in ("S", "K", "D", "R", "T", "R_rect") for i in range(_COUNT)),  # before rectification
)
"""Keys that say nothing of the rectified cameras."""


def _read_kitti(path: Path) -> Found:
    path = path / _RAW if (path / _RAW).is_file() else path
    notes: list[str] = []
    if not path.is_dir():
        return Found(tuple(_kitti_cameras(path, notes)), tuple(notes))
    files = sorted(path.glob("*.txt"))
    if not files:
        raise InputError(f"{path}: expected KITTI calibration files (*.txt), got none in this folder")
    cameras = []
    for file in files:
        found = _kitti_cameras(file, notes)
        if len(found) > 1:
            raise InputError(
                f"{file}: expected one camera per file in a folder (P0 to P3 equal), got {len(found)}; name this file "
                "instead of its folder to read the cameras in it"
            )
        cameras += found
    return Found(tuple(cameras), tuple(notes))


def _kitti_cameras(file: Path, notes: list[str]) -> list[FoundCamera]:
    record = _kitti_record(file)
    if record.peek("R_rect_00").value is not None:
        record = _kitti_of_raw(file, record)
    rectified = record.first_of("Tr_velo_to_cam", "Tr_velo_cam", "Tr").transform(3)
    turn = record.first_of("R0_rect", "R_rect")
    rotation = np.eye(3)
    if turn.value is not None or record.at("Tr").value is None:
        rotation = rigid_transform(np.array(turn.matrix(3, 3)), np.zeros(3), turn)[:3, :3]
    rectified[:3] = rotation @ rectified[:3]
    found: dict[tuple, FoundCamera] = {}
    for i in range(_COUNT):
        projection, size = record.at(f"P{i}"), record.at(f"S_rect_0{i}")
        if projection.value is None and i != 2:
            continue
        matrix = np.array(projection.matrix(3, 4))
        if not matrix.any():
            continue  # a camera that is not there
        width_px, height_px = (None, None) if size.value is None else map(int, size.numbers(2))
        calibration = Record(projection.location, matrix[:, :3].tolist())
        optics = optics_of_matrix(calibration, width_px=width_px, height_px=height_px)
        camera_from_velodyne = rectified.copy()
        camera_from_velodyne[:3, 3] += np.linalg.solve(matrix[:, :3], matrix[:, 3])  # the baseline
        key = (*matrix.flat, width_px, height_px)
        found.setdefault(key, FoundCamera(f"image_{i}", np.linalg.inv(camera_from_velodyne), optics))
    notes += unread_note(file, record.unread(*_UNPLACED))
    if not found:
        raise InputError(f"{file}: P2: expected a camera's 3 x 4 projection matrix, got none")
    if len(found) == 1:
        camera = next(iter(found.values()))
        return [FoundCamera(file.stem, camera.file_from_camera, camera.optics)]
    return list(found.values())


def _kitti_of_raw(file: Path, record: Record) -> Record:
    """The two files of the raw data, by the keys of the object data; cameras are the rectified ones."""
    lidar = file.with_name(_RAW_LIDAR)
    if not lidar.is_file():
        raise InputError(f"{file}: expected {_RAW_LIDAR} beside it, where the lidar is, got no such file")
    of = _kitti_record(lidar)
    turn = of.at("R")
    placed = rigid_transform(np.array(turn.matrix(3, 3)), of.at("T").numbers(3), turn)
    data = {key.replace("P_rect_0", "P"): each.value for key, each in record.mapping().items()}
    data |= {"R0_rect": data.pop("R_rect_00"), "Tr_velo_to_cam": placed[:3].ravel().tolist()}
    return Record(file, data)


def _kitti_record(file: Path) -> Record:
    numbers: dict[str, list] = {}
    for n, line in enumerate(read_text(file, "a KITTI calibration file").splitlines(), 1):
        found = _KITTI_LINE.fullmatch(line)
        if not line.strip():
            continue
        if not found:
            raise InputError(f"{file}:{n}: expected KEY: NUMBERS, got {line.strip()[:40]!r}")
        key, rest = found.groups()
        try:
            numbers[key] = [float(word) for word in rest.split()]
        except ValueError:
            numbers[key] = rest.split()  # validated on use; this may be a date
    return Record(file, numbers)


def _write_kitti(camera: PlacedCamera, losses: Losses) -> bytes:
    model = pinhole_of(camera, losses)
    projection = np.c_[np.array(camera_matrix(model)), np.zeros(3)]
    lines = [
        *(_line(f"P{i}", projection) for i in range(_COUNT)),
        _line("R0_rect", np.eye(3)),
        _line("Tr_velo_to_cam", np.linalg.inv(camera.file_from_camera)[:3]),
        _line("Tr_imu_to_velo", np.eye(4)[:3]),
        *(_line(f"S_rect_0{i}", np.array([model.width_px, model.height_px])) for i in range(_COUNT)),
    ]
    return ("\n".join(lines) + "\n").encode()


def _line(key: str, numbers: np.ndarray) -> str:
    return f"{key}: {' '.join(f'{value:.15e}' for value in numbers.flat)}"


FORMATS = (
    RigFormat(
        "nuscenes",
        frame="sensor to vehicle, x forward, y left, z up, right-handed, metres; quaternions w x y z; cameras x right, "
        "y down, z forward; LiDARs x right, y forward, z up",
        origin="below the centre of the rear axle",
        is_ego_origin=True,
        files=(_TABLE,),
        suffixes=(".json",),
        read=_read_nuscenes,
        write=_write_nuscenes,
        lidars="frames",
        parts="a scene of the data set, such as scene-0061",
    ),
    RigFormat(
        "argoverse2",
        frame="sensor to vehicle, x forward, y left, z up, right-handed, metres; quaternions w x y z; cameras x right, "
        "y down, z forward; LiDARs x forward, y left, z up",
        origin="the centre of the rear axle itself, a wheel's radius above the ground (0.33 m on the Ford Fusion)",
        is_ego_origin=False,
        files=(_POSES, _INTRINSICS),
        suffixes=(".feather", ".yaml", ".yml", ".json", ".txt"),
        read=_read_argoverse2,
        write=_write_argoverse2,
        lidars="frames",
    ),
    RigFormat(
        "kitti",
        frame="lidar to camera, lidar x forward, y left, z up, right-handed, metres; cameras x right, y down, z "
        "forward",
        origin="the lidar's (KITTI's own sits 1.73 m above the ground)",
        is_ego_origin=False,
        files=(),
        suffixes=(".txt",),
        read=_read_kitti,
        write=_write_kitti,
    ),
)
