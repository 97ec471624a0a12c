"""nuScenes: ``calibrated_sensor.json``, with ``sensor.json`` (names), ``sample_data.json`` (image sizes) beside it."""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from warpav.core.bounded_files import DATA_SET_NODES_MAX, refuse_levels
from warpav.core.errors import InputError
from warpav.core.frames import quaternion_from_rotation
from warpav.rig.formats.format import (
    Found,
    FoundCamera,
    Losses,
    PlacedCamera,
    RigFormat,
    camera_matrix,
    file_at,
    file_in,
    optics_of_matrix,
    pinhole_of,
)
from warpav.rig.formats.record import Record, read_json_record, rigid_transform

_TABLE = "calibrated_sensor.json"
_CHUNK = 1 << 20
_BETWEEN = re.compile(r"[\s,]*")


def read(path: Path, part: str | None) -> Found:
    """The cameras of a calibrated_sensor table, or of one scene of the data set (``part``)."""
    file = file_in(path, _TABLE)
    rows = [row for row in _rows(file) if row.at("camera_intrinsic").value != []]
    if part is not None:
        used = _tokens_of_scene(file.parent, part)
        rows = [row for row in rows if row.at("token").text() in used]
    if not rows:
        raise InputError(f"{file}: expected rows with a camera_intrinsic, got none" + (f" of {part}" if part else ""))
    name_of = _names(file.parent)
    names = [name_of.get(row.at("sensor_token").text(""), f"camera_{i}") for i, row in enumerate(rows)]
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise InputError(
            f"{file}: expected one row a camera, got {count} of {name}; `part` SCENE takes those of a scene, such as "
            "`part` scene-0061 (scene.json, sample.json and sample_data.json must lie beside the file)"
        )
    size_of = _sizes(file.parent, {row.at("token").text("") for row in rows})
    cameras = []
    for row, name in zip(rows, names, strict=True):
        rotation = row.at("rotation")
        transform = rigid_transform(
            rotation.unit_quaternion(rotation.numbers(4)), row.at("translation").numbers(3), rotation
        )
        width_px, height_px = size_of.get(row.at("token").text(""), (None, None))
        optics = optics_of_matrix(row.at("camera_intrinsic"), width_px=width_px, height_px=height_px)
        cameras.append(FoundCamera(name, transform, optics))
    notes = () if name_of else ("there is no sensor.json beside the file, so cameras are numbered",)
    return Found(tuple(cameras), notes)


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


def _names(folder: Path) -> dict[str, str]:
    file = folder / "sensor.json"
    if not file.is_file():
        return {}
    return {row.at("token").text(): row.at("channel").text() for row in _rows(file)}


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
    """Tokens of the calibrations that a scene's data refer to."""
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


def write(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    """The table and the two beside it; of sample_data only the image sizes."""
    tables: dict[str, list[dict]] = {_TABLE: [], "sensor.json": [], "sample_data.json": []}
    for camera in cameras:
        model = pinhole_of(camera, losses)
        sensor, calibration, data = (_token(kind, camera.name) for kind in ("sensor", "calibration", "data"))
        tables["sensor.json"].append({"token": sensor, "channel": camera.name, "modality": "camera"})
        tables[_TABLE].append(
            {
                "token": calibration,
                "sensor_token": sensor,
                "translation": camera.file_from_camera[:3, 3].tolist(),
                "rotation": quaternion_from_rotation(camera.file_from_camera[:3, :3]).tolist(),
                "camera_intrinsic": camera_matrix(model),
            }
        )
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
    table = file_at(target, (".json",), _TABLE)
    return {
        table if name == _TABLE else table.parent / name: (json.dumps(rows, indent=1) + "\n").encode()
        for name, rows in tables.items()
    }


def _token(kind: str, name: str) -> str:
    """32 hexadecimal digits, as the data set's tokens, the same for the same camera."""
    return hashlib.sha256(f"warpav {kind} {name}".encode()).hexdigest()[:32]


FORMAT = RigFormat(
    "nuscenes",
    frame="sensor to vehicle, x forward, y left, z up, right-handed, metres; quaternions w x y z; cameras x right, "
    "y down, z forward",
    origin="below the centre of the rear axle",
    is_ego_origin=True,
    read=read,
    write=write,
    parts="a scene of the data set, such as scene-0061",
)
