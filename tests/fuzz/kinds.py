"""Every kind of file that warpav reads: a small valid sample, and who reads it."""

import gzip
import io
import json
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from tests.experiments.bench.small_workload import small_truth, small_workload
from tests.rig.formats.known_pose import write_sample
from tests.runs.report.run_parts import fill, folder_at
from tests.scene.capture.test_folder import SETTINGS, PaintingSimulator
from tests.scene.test_mesh_colours import write_dae, write_gltf, write_obj
from tests.scene.traffic import test_drone_formats as drones
from tests.scene.traffic.recordings import street
from tests.scene.traffic.test_files import scenario, write_log
from tests.scene.traffic.test_formats import write_forecast, write_nuscenes, write_waymo
from warpav.core.bounded_files import read_text
from warpav.core.records import read_form
from warpav.detection import OnnxDetector
from warpav.experiments.bench._workload import read_truth, read_workload
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.rig import (
    ImportOptions,
    Rig,
    RigCamera,
    export_rig,
    import_rig_with_notes,
    read_modules,
    read_rig,
    read_zones,
    write_rig,
)
from warpav.runs import RunFolder
from warpav.runs._networks import _description
from warpav.runs.config import load_config
from warpav.runs.report._content import read_content
from warpav.scene import Box, Scene, Vehicle, examine, read_capture, read_scene, read_vehicle_file, write_scene
from warpav.scene._fleet import _Stated
from warpav.scene.capture._folder import record_capture
from warpav.scene.traffic.files import read_recording, recordings_in
from warpav.sight import read_requirements

ZONES = """
zones:
  roof:
    normal: up
    box_m: [[0.0, -0.6, 1.2], [2.0, 0.6, 1.7]]
    pitch_deg: [-10, 20]
    keep_out_m: [[[0.2, -0.1, 1.2], [0.4, 0.1, 1.7]]]
"""
MODULES = """
extends: builtin
modules:
  - name: mine
    sensor_px: [1920, 1080]
    network_px: [960, 540]
    network_by: crop
    lens: pinhole
    fov_deg: 90
    housing: {size_m: [0.03, 0.03, 0.04], offset_m: [0, 0, -0.01]}
    price: {value: 25, unit: EUR}
    power_w: 0.8
    zones: [roof]
    source: by hand
"""
REQUIREMENTS = """
requirements:
  near:
    area: {around_m: [0, 5]}
    grid_m: 0.5
    object: post
"""
RIG = Rig(
    [
        RigCamera("front", np.array([1.7, 0.0, 1.5]), 0.0, 0.0, 0.0, CameraModel(64, 48)),
        RigCamera("left", np.array([1.0, 0.7, 1.4]), 1.5, 0.1, 0.0, CameraModel(64, 48)),
    ]
)
CONFIG = """
extends: quick
run: {seed: 3, iterations: 4, batch_size: 2}
scenes: {train_seeds: 0..9, test_seeds: [5000, 5001], level: urban}
camera: {fov_deg: 80 deg, width_px: 128, height_px: 96, lens: pinhole}
rig: {cameras: 4, free: {pitch_deg: [-10, 20]}}
losses: {expected_miss_rate: 1.0}
mount: {margin_m: 20 cm}
"""
OVERRIDES = b"rig.cameras=4 scenes.train_seeds=0..9 camera.fov_deg=80deg run.iterations=5 rig.free.pitch_deg=[-5,5]"
SIZED = ImportOptions(width_px=640, height_px=480)
FORMATS = (
    "nuscenes",
    "argoverse2",
    "urdf",
    "autoware",
    "carla-ros-bridge",
    "carla-python",
    "kitti",
    "alpasim",
    "driveworks",
    "kalibr",
)


@dataclass(frozen=True)
class Kind:
    """A kind of file or folder.

    Attributes:
        name: For messages.
        write: Writes a sample into an empty folder and returns the file or folder that is read.
        read: Reads it.
        weight: Of how many cases of the usual kind each takes the time.
        inner: Unpacked content of a file, and how to pack it again, where a checksum would keep all edits out.
    """

    name: str
    write: Callable[[Path], Path]
    read: Callable[[Path], object]
    weight: float = 1.0
    inner: tuple[Callable[[bytes], bytes], Callable[[bytes], bytes]] | None = None


def _text(name, text):
    def write(folder):
        (folder / name).write_text(text)
        return folder / name

    return write


def _made(name, make):
    def write(folder):
        make(folder / name)
        return folder / name

    return write


def _rig_format(name):
    def write(folder):
        if name == "argoverse2":
            export_rig(RIG, name, folder)
            return folder / "calibration"
        return write_sample(name, folder)

    return Kind(f"rig {name}", write, lambda path: import_rig_with_notes(path, name, SIZED))


def _opencv(suffix):
    def write(folder):
        import cv2

        storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        storage.write("camera_name", "front")
        storage.write("image_width", 640)
        storage.write("image_height", 480)
        storage.write("camera_matrix", np.array([[320.0, 0, 319.5], [0, 320.0, 239.5], [0, 0, 1]]))
        storage.write("distortion_coefficients", np.zeros((5, 1)))
        storage.write("camera_from_ego", np.eye(4))
        (folder / f"front{suffix}").write_text(storage.releaseAndGetString())
        return folder / f"front{suffix}"

    return Kind(f"rig opencv{suffix}", write, lambda path: import_rig_with_notes(path, "opencv", SIZED))


def _overrides(path):
    text = read_text(path, "overrides")
    return load_config(None, text.split(" "), origin="override")


def box_mesh(size_m=(4.4, 1.8, 1.5), at_m=(1.3, 0.0, 0.75)):
    box = trimesh.creation.box(extents=size_m)
    vertex = np.asarray(box.vertices) + at_m
    return Mesh.create(vertex, np.asarray(box.faces), np.full((len(vertex), 3), 90, np.uint8), name="box")


def small_scene():
    ground = Mesh.create(
        np.array([[-20.0, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
        np.full((4, 3), 120, np.uint8),
        name="ground",
    )
    box = Box(np.array([9.0, 3.0, 0.75]), np.array([4.4, 1.8, 1.5]), 0.1)
    car = Vehicle(1, "car", box_mesh(at_m=(9.0, 3.0, 0.75)), box, np.array([1.0, 0.0]))
    return Scene("small", ground, box_mesh(), (car,))


def _vehicle(path):
    file = read_vehicle_file(path)
    examine(file, file.usual)


def _export(path):
    box = box_mesh()
    trimesh.Trimesh(box.vertex_m, box.triangle, vertex_colors=box.vertex_rgb, process=False).export(path)


def _ascii_ply(path):
    box = box_mesh()
    mesh = trimesh.Trimesh(box.vertex_m, box.triangle, process=False)
    path.write_bytes(trimesh.exchange.ply.export_ply(mesh, encoding="ascii"))


def _capture(folder):
    images = read_capture(folder).images
    for k in range(len(images)):
        images[k]


def _gltf(folder):
    write_gltf(folder / "model.gltf")
    return folder / "model.gltf"


def _obj(folder):
    write_obj(folder / "quad.obj")
    return folder / "quad.obj"


def _stage(suffix):
    def write(folder):
        from tests.scene.test_usd import box, stage_at

        stage = stage_at(folder / f"car.{suffix}")
        box(stage, "/car/body", size=4.0)
        stage.Save()
        return folder / f"car.{suffix}"

    return Kind(f"vehicle {suffix}", write, _vehicle, 4)


def _robot(folder):
    from tests.scene.test_urdf import robot

    return robot(folder)


def _network(folder):
    from tests.detection.tiny_networks import write_network

    write_network(folder / "tiny.onnx", "yolox", metadata={"names": "{0: 'car', 1: 'bus', 2: 'truck'}"})
    return folder / "tiny.onnx"


def _run(folder):
    return fill(folder_at(folder / "run")).path


def _workload(folder):
    arrays = small_workload(vehicle_count=2)
    np.savez_compressed(folder / "workload.npz", **arrays)
    return folder / "workload.npz"


def _truth(folder):
    _workload(folder)
    np.savez_compressed(folder / "truth.npz", **small_truth(small_workload(vehicle_count=2)))
    return folder


def _stored(content):
    """The archive with its members as they are, one behind the other, so that edits meet headers and numbers."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    return b"".join(
        struct.pack("<I", len(name)) + name.encode() + struct.pack("<I", len(data)) + data for name, data in members
    )


def _archived(content):
    """The archive of such members, whatever they are now, with checksums that fit."""
    packed = io.BytesIO()
    at = 0
    with zipfile.ZipFile(packed, "w") as archive:
        while at + 4 <= len(content):
            (length,) = struct.unpack_from("<I", content, at)
            name = content[at + 4 : at + 4 + length % 64].decode(errors="replace").replace("\0", "?") or "?"
            at += 4 + length % 64
            length = int.from_bytes(content[at : at + 4], "little")
            archive.writestr(name, content[at + 4 : at + 4 + length])
            at += 4 + length
    return packed.getvalue()


def _described(content):
    """The JSON of a GLB file."""
    return content[20 : 20 + int.from_bytes(content[12:16], "little")]


def _glb_with(content):
    def packed(described):
        described += b" " * (-len(described) % 4)
        rest = content[20 + int.from_bytes(content[12:16], "little") :]
        head = b"glTF" + struct.pack("<III", 2, 20 + len(described) + len(rest), len(described)) + b"JSON"
        return head + described + rest

    return packed


def _scene_json():
    """Scenes whose JSON is edited, with lengths that fit."""
    scene = io.BytesIO()

    def write(folder):
        write_scene(small_scene(), folder / "scene.glb")
        scene.write((folder / "scene.glb").read_bytes())
        return folder / "scene.glb"

    return Kind("scene JSON", write, read_scene, inner=(_described, lambda json: _glb_with(scene.getvalue())(json)))


SMALL = [
    Kind("configuration", _text("mine.yaml", CONFIG), load_config),
    Kind("overrides", _made("overrides.txt", lambda file: file.write_bytes(OVERRIDES)), _overrides),
    Kind("rig", _made("rig.yaml", lambda file: write_rig(RIG, file)), read_rig),
    Kind("zones", _text("zones.yaml", ZONES), read_zones),
    Kind("modules", _text("modules.yaml", MODULES), read_modules),
    Kind("requirements", _text("requirements.yaml", REQUIREMENTS), read_requirements),
    Kind(
        "vehicle of traffic",
        _text("bus.yaml", "category: [bus, lorry]\nup: z\nforward: -x\nscale: 0.01\n"),
        lambda file: read_form(_Stated, file),
    ),
    Kind(
        "network of a panel",
        _text("net.yaml", "format: yolox\ninput_px: 64\nwidth_px: 8\nheight_px: 8\n"),
        _description,
    ),
    *map(_rig_format, FORMATS),
    *map(_opencv, (".yaml", ".json", ".xml")),
]
LARGE = [
    Kind("scene", _made("scene.glb", lambda file: write_scene(small_scene(), file)), read_scene, 1.5),
    _scene_json(),
    Kind("vehicle glb", _made("car.glb", _export), _vehicle, 4),
    Kind("vehicle gltf", _gltf, _vehicle, 4),
    Kind("vehicle obj", _obj, _vehicle, 4),
    Kind("vehicle dae", _made("quad.dae", write_dae), _vehicle, 4),
    *map(_stage, ("usda", "usdc")),
    Kind("vehicle urdf", _robot, _vehicle, 4),
    Kind("vehicle ply", _made("car.ply", _export), _vehicle, 4),
    Kind("vehicle ascii ply", _made("car.ply", _ascii_ply), _vehicle, 4),
    Kind("vehicle stl", _made("car.stl", _export), _vehicle, 4),
    Kind("vehicle off", _made("car.off", _export), _vehicle, 4),
    Kind("capture", lambda folder: record_capture(PaintingSimulator(), 7, folder / "scene_7", SETTINGS), _capture, 1.5),
    Kind("traffic", _text("street.json", json.dumps(street())), read_recording),
    Kind(
        "packed traffic",
        _made("street.json.gz", lambda file: file.write_bytes(gzip.compress(json.dumps(street()).encode()))),
        read_recording,
        inner=(gzip.decompress, gzip.compress),
    ),
    Kind("CommonRoad", _text("street.xml", scenario("2020a")), read_recording),
    Kind("log", lambda folder: write_log(folder / "log"), read_recording),
    Kind("forecast", write_forecast, read_recording),
    Kind("nuScenes", write_nuscenes, lambda folder: [read_recording(each) for each in recordings_in([folder])]),
    Kind("Waymo", write_waymo, read_recording),
    *(
        Kind(name, write, lambda folder: [*map(read_recording, recordings_in([folder]))])
        for name, write in drones.SAMPLES.items()
    ),
    Kind("network", _network, OnnxDetector, 3),
    Kind("run", _run, lambda path: read_content(RunFolder.open(path)), 4),
    Kind("workload", _workload, read_workload, inner=(_stored, _archived)),
    Kind("truth", _truth, lambda path: read_truth(path / "truth.npz", read_workload(path / "workload.npz")), 2),
]
