"""Scenes as GLB files, or stages of USD, that Blender, trimesh and every glTF viewer open.

Below one root node, whose matrix turns the ego frame (z up) into glTF's axes (y up), stand the nodes ``environment``,
``ego``, one ``vehicle_<instance id>`` per vehicle, and one ``other_<instance id>`` per road user that is no vehicle.
Their vertices are in the ego frame, their colours are exact 8-bit vertex colours, and the extras of vehicles and other
road users hold instance id, class and 3D box, and where it is known their velocity relative to the ego vehicle
(``velocity_ego_m_s``: forward and left).
"""

from __future__ import annotations

import base64
import importlib.util
import json
import logging
import math
import re
import struct
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field

from warpav.core.bounded_files import (
    ARRAY_BYTES_MAX,
    BYTES_MAX,
    DATA_SET_BYTES_MAX,
    DATA_SET_NODES_MAX,
    parse_json,
    parse_xml,
    read_bytes,
)
from warpav.core.errors import InputError, install_text
from warpav.core.files import atomic_write
from warpav.core.records import Point2, Point3, Record, Word, read_record, unread, unread_text
from warpav.raster.mesh import Mesh
from warpav.scene._mesh_colours import TRIANGLES_MAX
from warpav.scene._scene import BLACK_SKY, Box, Scene, Sky, Vehicle
from warpav.scene._usd import USD_FORMATS, read_stage

if TYPE_CHECKING:
    import trimesh

_logger = logging.getLogger(__name__)
_SCHEMA = "warpav-scene/1"
_ROOT_NODE, ENVIRONMENT_NODE, EGO_NODE = "ego_frame", "environment", "ego"
_VEHICLE_PREFIX, _OTHER_PREFIX = "vehicle_", "other_"
_KNOWN_NODES = (_VEHICLE_PREFIX, _OTHER_PREFIX, ENVIRONMENT_NODE, EGO_NODE)
_HARMLESS = ("schema", "frame", "units", "role")
_EGO_FRAME = "ego: ISO 8855, x forward, y left, z up, origin on the ground below the rear axle's centre"
GLTF_FROM_EGO = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])
"""(x, y, z) in the ego frame is (x, z, -y) in glTF."""


def write_scene(scene: Scene, path: str | Path) -> None:
    """Write a scene; the same scene gives the same bytes, and the file appears only once it is complete."""
    about = {
        "name": scene.name,
        "source": scene.source,
        "sky_horizon_rgb": [int(value) for value in scene.sky.horizon_rgb],
        "sky_zenith_rgb": [int(value) for value in scene.sky.zenith_rgb],
    }
    nodes: list[Node] = [
        (ENVIRONMENT_NODE, scene.environment, {"role": "environment"}),
        (EGO_NODE, scene.ego, {"role": "ego"}),
    ]
    scene = scene.targeting(("vehicle",))
    for user in (*scene.vehicles, *scene.others):
        role, prefix = ("vehicle", _VEHICLE_PREFIX) if user.road_user == "vehicle" else ("other", _OTHER_PREFIX)
        extras = {
            "role": role,
            "instance_id": int(user.instance_id),
            "class": user.category,
            "box_center_m": [float(value) for value in user.box.center_m],
            "box_size_m": [float(value) for value in user.box.size_m],
            "box_yaw_deg": float(np.degrees(user.box.yaw_rad)),
        }
        if user.velocity_ego_m_s is not None:
            extras["velocity_ego_m_s"] = [float(value) for value in user.velocity_ego_m_s]
        nodes.append((f"{prefix}{user.instance_id}", user.mesh, extras))
    write_nodes(Path(path), _SCHEMA, about, nodes)


Node = tuple[str, Mesh, dict[str, Any]]
"""Name, mesh in the ego frame, and extras of a node."""


def glb_bytes(about: dict[str, Any], nodes: Sequence[Node]) -> bytes:
    """Nodes below one that turns the ego frame into glTF's axes, with their exact vertices and colours, as GLB."""
    import trimesh

    file = trimesh.Scene(base_frame="world")
    file.metadata = about
    file.graph.update(frame_from="world", frame_to=_ROOT_NODE, matrix=GLTF_FROM_EGO)
    for name, mesh, extras in nodes:
        opaque = np.full((len(mesh.vertex_rgb), 1), 255, np.uint8)
        geometry = trimesh.Trimesh(
            vertices=mesh.vertex_m,
            faces=mesh.triangle,
            vertex_colors=np.concatenate([mesh.vertex_rgb, opaque], axis=1),
            process=False,
            validate=False,
        )
        file.add_geometry(geometry, node_name=name, geom_name=name, parent_node_name=_ROOT_NODE, metadata=extras)
    data = file.export(file_type="glb")
    assert isinstance(data, bytes)
    return data


def write_nodes(path: Path, schema: str, about: dict[str, Any], nodes: Sequence[Node]) -> None:
    """Write a file of a schema that is either complete or absent."""
    data = glb_bytes({"schema": schema, "frame": _EGO_FRAME, "units": "m", **about}, nodes)
    try:
        with atomic_write(path) as draft:
            draft.write_bytes(data)
    except OSError as error:
        what = schema.removeprefix("warpav-").partition("/")[0]
        raise InputError(f"{path}: cannot write the {what}: {error.strerror}; choose a folder that exists") from error


def read_scene(path: str | Path) -> Scene:
    """Read a scene that `write_scene` or another program wrote, or a stage of USD with prims of the same names.

    All that stands below such a prim belongs to it. Its extras are its ``customData``, those of the whole scene the
    ``customLayerData``.
    """
    import trimesh

    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such scene file; write one with `warpav scenes make`")
    suffix = path.suffix.lower().removeprefix(".")
    is_stage = suffix in USD_FORMATS
    data, missed = bounded_mesh(path, suffix if is_stage else "glb", str(path))
    if not is_stage and data[:4] != b"glTF":
        raise InputError(f"{path}: expected a GLB file (it starts with 'glTF'), got {data[:4]!r}; export binary glTF")
    try:
        if is_stage:
            file = _stage_nodes(path, missed)
        else:
            file = trimesh.load_scene(trimesh.util.wrap_as_stream(data), file_type="glb", process=False)
    except Exception as error:
        if isinstance(error, InputError):
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        kind = suffix.upper() if is_stage else "GLB"
        raise InputError(f"{path}: the {kind} file is damaged: {reason}; write it again") from error

    nodes = _mesh_nodes(file, path)
    for name in (ENVIRONMENT_NODE, EGO_NODE):
        if name not in nodes:
            known = ", ".join(sorted(nodes)) or "none"
            remedy = "rename the node, or give a vehicle alone as scenes.ego"
            raise InputError(f"{path}: expected a mesh node named '{name}', got {known}; {remedy}")
    count = sum(len(getattr(file.geometry[file.graph.get(name)[1]], "faces", ())) for name in nodes)
    if count > TRIANGLES_MAX:
        raise InputError(f"{path}: expected at most {TRIANGLES_MAX:,} triangles in all nodes, got {count:,}")
    users, strange = [], [f"node {name!r}" for name in nodes if not name.startswith(_KNOWN_NODES)]
    for name, extras in nodes.items():
        if name.startswith((_VEHICLE_PREFIX, _OTHER_PREFIX)):
            where = f"{path}: node '{name}'"
            one = read_record(_Extras, extras, f"{where}: extras")
            strange += [f"extras.{key}" for key in unread(one)]
            box = Box(np.array(one.box_center_m), np.array(one.box_size_m), float(np.radians(one.box_yaw_deg)))
            velocity = None if one.velocity_ego_m_s is None else np.array(one.velocity_ego_m_s)
            users.append(Vehicle(one.instance_id, one.category, _read_mesh(file, name, where), box, velocity))
    ids = [user.instance_id for user in users]
    instance_id, count = max(Counter(ids).items(), key=lambda each: each[1], default=(0, 0))
    if count > 1:
        raise InputError(f"{path}: instance_id must be unique, got {instance_id} {count} times")
    about = read_record(_SceneExtras, file.metadata or {}, f"{path}: scene extras")
    strange += [f"scene extras.{key}" for key in unread(about)]
    missed += [unread_text(key for key in strange if key.partition("extras.")[2] not in _HARMLESS)]
    for text in filter(None, missed):
        _logger.warning("%s: %s", path, text)
    scene = Scene(
        path.stem if about.name is None else about.name,
        _read_mesh(file, ENVIRONMENT_NODE, f"{path}: node '{ENVIRONMENT_NODE}'"),
        _read_mesh(file, EGO_NODE, f"{path}: node '{EGO_NODE}'"),
        tuple(users),
        Sky(np.array(about.sky_horizon_rgb).astype(np.uint8), np.array(about.sky_zenith_rgb).astype(np.uint8)),
        about.source,
    )
    return scene.targeting(("vehicle",))


def _stage_nodes(path: Path, missed: list[str]) -> trimesh.Scene:
    """The prims of a scene as nodes in glTF's axes, a mesh each; adds what is missed."""
    import trimesh

    stage = read_stage(path)
    missed += stage.notes
    held: dict[str, list[trimesh.Trimesh]] = {}
    gltf_from_stage = np.diag([stage.metres] * 3 + [1.0]) @ (np.eye(4) if stage.up == "y" else GLTF_FROM_EGO)
    for place, (part, _) in stage.parts:
        words = place.split("/")
        end = next((k for k, word in enumerate(words) if word.startswith(_KNOWN_NODES)), len(words) - 1)
        opaque = np.column_stack([np.round(part.rgb), np.full(len(part.rgb), 255)]).astype(np.uint8)
        mesh = trimesh.Trimesh(part.vertex, part.triangle, vertex_colors=opaque, process=False)
        held.setdefault("/".join(words[: end + 1]), []).append(mesh.apply_transform(gltf_from_stage))
    file = trimesh.Scene(base_frame="world")
    file.metadata = stage.about
    for place, meshes in held.items():
        node = place.rpartition("/")[2]
        whole: Any = meshes[0] if len(meshes) == 1 else trimesh.util.concatenate(meshes)
        file.add_geometry(whole, node_name=node, geom_name=node, metadata=stage.extras.get(place))
    return file


def _mesh_nodes(file: trimesh.Scene, path: Path) -> dict[str, dict[str, Any]]:
    """Extras by name of every node that carries a mesh, in file order."""
    extras: dict[str, dict[str, Any]] = {}
    edges = file.graph.transforms.edge_data
    for (_, name), data in edges.items():
        if "geometry" in data:
            extras[str(name)] = data.get("metadata") or {}
    if not extras:
        raise InputError(
            f"{path}: expected mesh nodes '{ENVIRONMENT_NODE}', '{EGO_NODE}' and '{_VEHICLE_PREFIX}1', got none"
        )
    return extras


def _read_mesh(file: trimesh.Scene, name: str, where: str) -> Mesh:
    matrix, geometry_name = file.graph.get(name)
    geometry: Any = file.geometry[geometry_name]
    if not hasattr(geometry, "faces") or len(geometry.faces) == 0:
        raise InputError(f"{where}: expected a mesh with triangles, got none; export its faces")
    vertex = np.asarray(geometry.vertices, np.float64)
    ego_from_node = np.linalg.inv(GLTF_FROM_EGO) @ np.asarray(matrix, np.float64)
    if not np.allclose(ego_from_node, np.eye(4), atol=1e-9):
        vertex = vertex @ ego_from_node[:3, :3].T + ego_from_node[:3, 3]
    colour = np.asarray(geometry.visual.vertex_colors, np.uint8)[:, :3]
    return Mesh.create(vertex, geometry.faces, colour, name=where)


class _Extras(Record):
    """Extras of a node of a road user."""

    model_config = ConfigDict(allow_inf_nan=False)

    instance_id: int = Field(ge=1)
    category: Word = Field(alias="class")
    box_center_m: Point3
    box_size_m: Point3
    box_yaw_deg: float
    velocity_ego_m_s: Point2 | None = None


_Colour = Annotated[list[Annotated[float, Field(ge=0.0, le=255.0)]], Field(min_length=3, max_length=3)]


class _SceneExtras(Record):
    """Extras of the whole scene."""

    model_config = ConfigDict(allow_inf_nan=False)

    name: Word | None = None
    source: Word = ""
    sky_horizon_rgb: _Colour = BLACK_SKY.horizon_rgb.tolist()
    sky_zenith_rgb: _Colour = BLACK_SKY.zenith_rgb.tolist()


_LINES_MAX, _LINE_BYTES_MAX = 2_000_000, 1_000_000
_TEXT_FORMATS = ("obj", "off", "dae", "gltf")
_COMPONENT_COUNT = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_GLB_HEAD = 20  # bytes before the JSON


STEP_FORMATS = ("step", "stp")
_STEP_S, _CHORD_MM = 300.0, 2.0  # how long it may take; how far triangles are from a surface
_CONVERT = """
import sys, cascadio
glb = cascadio.to_glb_bytes(open(sys.argv[1], "rb").read(), tol_linear=float(sys.argv[3]), tol_angular=0.5)
open(sys.argv[2], "wb").write(glb)
"""


def _step_as_glb(file: Path, place: str) -> bytes:
    """A STEP file as triangles, in metres and its own axes.

    Open CASCADE runs in a process of its own: it prints what is wrong, and a file may bring it down.
    """
    if importlib.util.find_spec("cascadio") is None:
        raise InputError(f"{place}: expected the package cascadio, got none; {install_text('cad')}")
    with tempfile.TemporaryDirectory(prefix="warpav-") as folder:
        out = Path(folder) / "car.glb"
        command = [sys.executable, "-c", _CONVERT, str(file.absolute()), str(out), str(_CHORD_MM)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=_STEP_S, check=False)
        except subprocess.TimeoutExpired:
            raise InputError(f"it takes longer than {_STEP_S:g} s to read") from None
        said = re.sub(r"\x1b\[[\d;]*m", "", (done.stdout + done.stderr).decode(errors="replace"))
        wrong = re.search(r"\*+ ERR (.*?)\s*\**\n", said)
        if wrong:
            raise InputError(wrong[1])
        if done.returncode or not out.is_file() or not out.stat().st_size:
            raise InputError(
                f"no shape that can be read ({' '.join(said.split())[-120:] or f'status {done.returncode}'})"
            )
        return read_bytes(out, "the triangles of a STEP file", bytes_max=DATA_SET_BYTES_MAX)


def bounded_mesh(file: Path, suffix: str, place: str) -> tuple[bytes, list[str]]:
    """The content of a mesh file, once it is known to be within bounds, and what of it is not read.

    Positions of a GLB that are normalised integers come as floats, because trimesh takes them for plain numbers.
    """
    missed: list[str] = []
    kind = f"a readable {suffix} file"
    content = read_bytes(file, kind, bytes_max=DATA_SET_BYTES_MAX)
    try:
        if suffix in _TEXT_FORMATS or content.startswith(b"solid") or b"format ascii" in content[:1000]:
            if len(content) > BYTES_MAX:
                raise InputError(f"more than {BYTES_MAX // 1_000_000} MB of text")
            lines = content.split(b"\n")
            if len(lines) > _LINES_MAX:
                raise InputError(f"more than {_LINES_MAX:,} lines")
            if (suffix in ("obj", "off", "ply")) and max(map(len, lines)) > _LINE_BYTES_MAX:
                raise InputError(f"a line of more than {_LINE_BYTES_MAX:,} characters")
        if suffix in STEP_FORMATS:
            content, suffix = _step_as_glb(file, place), "glb"
        if suffix == "dae":
            parse_xml(content, "", "COLLADA", nodes_max=DATA_SET_NODES_MAX)
        elif suffix == "gltf":
            missed, _ = _checked_document(content)
        elif suffix == "glb" and content.startswith(b"glTF"):
            end = _GLB_HEAD + int.from_bytes(content[12:16], "little")
            missed, changed = _checked_document(content[_GLB_HEAD:end], content[end:])
            content = changed or content
    except InputError as error:
        if str(error).startswith(place):
            raise
        raise InputError(f"{place}: expected {kind}, got: {error}; export it again") from None
    return content, missed


_READ = re.compile(r"KHR_(mesh_quantization|materials_.*|lights_punctual|xmp.*)|EXT_texture_webp")
"""Extensions that trimesh reads, or that change neither places nor colours."""
_MISSED = re.compile(r"KHR_draco_.*|EXT_meshopt_.*|EXT_mesh_gpu_instancing")
"""Extensions without which parts are missing."""
_INTEGERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2"}
_FLOAT = 5126


def _checked_document(content: bytes, rest: bytes | None = None) -> tuple[list[str], bytes | None]:
    """What is not read of a glTF document; with the chunks behind it the GLB with floats for integers, if it has such.

    trimesh takes memory for what its arrays state, each counted where it is named; it passes over much without a word.
    """
    document = parse_json(content.rstrip(b"\0"), "", "a glTF document", nodes_max=DATA_SET_NODES_MAX)
    changed, total, missed = None, 0.0, []
    try:
        required = set(document.get("extensionsRequired", ()))
        others = {name for name in (*required, *document.get("extensionsUsed", ())) if not _READ.fullmatch(name)}
        for name in sorted(others):
            if name in required - {"KHR_texture_transform"} or _MISSED.fullmatch(name):
                raise InputError(f"the extension {name}, which is not read: leave it out")
        missed += [f"the extension {name} is not read" for name in sorted(others)]
        if document.get("skins"):
            missed.append("skeletons are not applied: what is bound to one may lie elsewhere")
        if any(any(each.get("weights", ())) for key in ("meshes", "nodes") for each in document.get(key, ())):
            missed.append("morph targets are not applied")
        for view in document.get("bufferViews", ()):
            total += _size(view["byteLength"])
        for accessor in document.get("accessors", ()):
            total += 8.0 * _COMPONENT_COUNT[accessor["type"]] * _size(accessor["count"])
            if "sparse" in accessor:
                raise InputError("sparse accessors, which are not read: leave them out")
        if total > ARRAY_BYTES_MAX:
            raise InputError(f"arrays of more than {ARRAY_BYTES_MAX // 1_000_000} MB")
        accessors = document.get("accessors", ())
        attributes = [part["attributes"] for mesh in document.get("meshes", ()) for part in mesh["primitives"]]
        named = {each[key] for each in attributes for key in ("POSITION", "TEXCOORD_0") if key in each}
        normalised = [accessors[k] for k in sorted(named) if accessors[k].get("normalized")]
        if normalised:
            if rest is None or "uri" in document["buffers"][0]:
                raise InputError("normalised integers outside of a GLB: make it one GLB")
            changed = _with_floats(document, normalised, rest)
    except (AttributeError, KeyError, TypeError, IndexError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        # it is no glTF, which trimesh says better
    return missed, changed


def _with_floats(document: dict[str, Any], normalised: list[dict[str, Any]], rest: bytes) -> bytes:
    """The GLB of a document and its chunks, in which some accessors with normalised integers hold floats instead."""
    floats = b""
    for accessor in normalised:
        view = document["bufferViews"][accessor["bufferView"]]
        if view["buffer"] != 0:
            raise InputError("normalised integers outside of a GLB: make it one GLB")
        kind, columns = np.dtype(_INTEGERS[accessor["componentType"]]), _COMPONENT_COUNT[accessor["type"]]
        step = view.get("byteStride", columns * kind.itemsize)
        begin = 8 + view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        number = np.ndarray((accessor["count"], columns), kind, rest, begin, (step, kind.itemsize))
        added = np.maximum(number / np.iinfo(kind).max, -1.0).astype("<f4").tobytes()
        views, buffers = document["bufferViews"], document["buffers"]
        accessor |= {"bufferView": len(views), "byteOffset": 0, "componentType": _FLOAT, "normalized": False}
        views.append({"buffer": len(buffers), "byteOffset": len(floats), "byteLength": len(added)})
        floats += added
    text = base64.b64encode(floats).decode()
    document["buffers"].append({"byteLength": len(floats), "uri": f"data:application/octet-stream;base64,{text}"})
    content = json.dumps(document).encode()
    content += b" " * (-len(content) % 4)
    length = _GLB_HEAD + len(content) + len(rest)
    return struct.pack("<4sIII4s", b"glTF", 2, length, len(content), b"JSON") + content + rest


def _size(count: object) -> float:
    return float(count) if isinstance(count, int) and count >= 0 else math.inf
