"""The benchmark's files: a workload (scene, cameras, weights) and its truth, read, checked, and put on a device.

A workload is an ``.npz`` of format 1. Its world is the thesis's (x left, y up, z forward, metres) with the ego vehicle,
which is not rendered, at the origin. Cameras are level at a pose (x, z, yaw); each has four views, rotated by quarters
of a circle, and view = camera * 4 + rotation. The first objects are vehicles, the others only occlude them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partialmethod
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpav.core.bounded_files import read_arrays
from warpav.core.errors import InputError
from warpav.core.frames import EGO_FROM_THESIS
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.raster.mesh import Mesh

if TYPE_CHECKING:
    from warpav.raster.scene import Scene

FORMAT = 1
ROTATION_COUNT = 4
WEIGHT_NAMES = ("white", "smooth", "ones")
_MIN_SIZE_PX = 8  # of a camera model
_MAX_SIZE_PX = 1 << 14


LENSES: dict[str, tuple[float | None, tuple[float, ...]]] = {
    "pinhole": (None, ()),
    "brown_conrady": (100.0, (-0.21, 0.06, 0.002, -0.001, -0.008)),
    "fisheye": (190.0, (-0.013, 0.0021, -0.0042, 0.0007)),
    "eucm": (190.0, (0.62, 1.15)),
    "double_sphere": (190.0, (-0.2, 0.59)),
    "panorama": (360.0, ()),
    "equirectangular": (360.0, ()),
}
"""Field of view [deg], None: the workload's, and distortion of every lens that a workload can be looked at through."""


@dataclass(frozen=True)
class Workload:
    name: str
    vertex_m: np.ndarray  # vertices of all objects in the workload's world [m], float32 [vertex, 3]
    triangle: np.ndarray  # vertex indices of all objects, one behind the other, int32 [triangle, 3]
    vertex_rgb: np.ndarray  # colour of every vertex, 0..1, float32 [vertex, 3]
    triangle_count: np.ndarray
    vertex_end: np.ndarray
    vehicle_count: int
    vehicle_weight: np.ndarray
    pose: np.ndarray  # x, z [m], yaw [rad] of every camera, float64 [camera, 3]
    height_m: np.ndarray
    fov_deg: np.ndarray
    near_m: np.ndarray
    size_px: int
    is_visible: bool
    weight: dict[str, np.ndarray]  # of every pixel, float32 [row, column], by `WEIGHT_NAMES`
    scored_pose: np.ndarray  # where gradients are scored, [pose, 3]; pose i takes the rest of camera i mod C
    seed: int
    lens: str = "pinhole"

    @property
    def view_count(self) -> int:
        return ROTATION_COUNT * len(self.pose)

    @property
    def triangle_object(self) -> np.ndarray:
        return np.repeat(np.arange(len(self.triangle_count), dtype=np.int32), self.triangle_count)

    def models(self, camera: Sequence[int]) -> list[CameraModel]:
        """Camera models of the views of some cameras, four for each."""
        size, (fov_deg, distortion) = self.size_px, LENSES[self.lens]
        return [
            CameraModel(
                size,
                size,
                math.radians(fov_deg or self.fov_deg[c]),
                float(self.near_m[c]),
                lens=Lens(self.lens),
                distortion=distortion,
            )
            for c in camera
            for _ in range(ROTATION_COUNT)
        ]

    def is_same_work(self, other: Workload) -> bool:
        """Whether all numbers are those of another workload; the names may differ."""
        one, two = vars(self), vars(other)
        return all(np.array_equal(one["weight"][name], two["weight"][name]) for name in WEIGHT_NAMES) and all(
            np.array_equal(one[name], two[name]) for name in one if name not in ("name", "weight")
        )


@dataclass(frozen=True)
class Truth:
    name: str
    # of the loss at every scored pose to x, z [per m], yaw [per rad], float64 [pose, 3], by weight; empty: not known
    gradient: dict[str, np.ndarray]
    check_gradient: dict[str, np.ndarray]
    object_view: np.ndarray
    object_index: np.ndarray  # object at every pixel's centre, -1: none, integers [n, row, column]
    depth_m: np.ndarray  # depth there, as the lens has it, float32 [n, row, column]


def embedded_workload() -> Workload:
    """The workload that ships with warpav (seed 7)."""
    with as_file(files("warpav.experiments.bench").joinpath("data", "workload.npz")) as file:
        return dataclasses.replace(read_workload(file), name="embedded workload")


def embedded_truth(workload: Workload) -> Truth:
    with as_file(files("warpav.experiments.bench").joinpath("data", "truth.npz")) as file:
        return read_truth(file, workload)


def read_workload(file: Path) -> Workload:
    """Read a workload of format 1 and check it."""
    fields = _Fields(file)
    if int(fields.integers("format", ())) != FORMAT:
        raise fields.error("format", f"expected {FORMAT}", fields.raw("format"))
    size_px = int(fields.integers("res", (), lambda v: (v >= _MIN_SIZE_PX) & (v <= _MAX_SIZE_PX), "8 to 16384 pixels"))
    triangle_count = fields.integers("face_counts", (None,), lambda v: v >= 0, "counts of at least 0")
    object_count = len(triangle_count)
    vehicle_count = int(
        fields.integers(
            "n_targets", (), lambda v: (v >= 0) & (v <= object_count), f"a number of objects, 0..{object_count}"
        )
    )
    vertex = fields.floats("verts", (None, 3))
    colour = fields.floats("colors", (len(vertex), 3), lambda v: (v >= 0) & (v <= 1), "colours in 0..1")
    vertex_end = fields.integers("vert_ends", (object_count,))
    if object_count == 0 or (np.diff(vertex_end, prepend=0) < 0).any() or vertex_end[-1] != len(vertex):
        raise fields.error("vert_ends", f"expected ends that rise to {len(vertex)}, the length of verts", vertex_end)
    triangle = fields.integers("faces", (None, 3))
    if triangle_count.sum() != len(triangle):
        raise fields.error(
            "face_counts", f"expected a sum of {len(triangle)}, the length of faces", triangle_count.sum()
        )
    low = np.repeat(np.r_[0, vertex_end[:-1]], triangle_count)[:, None]
    high = np.repeat(vertex_end, triangle_count)[:, None]
    outside = np.flatnonzero(((triangle < low) | (triangle >= high)).any(axis=1))
    if len(outside):
        k = int(outside[0])
        text = f"expected vertices {low[k, 0]}..{high[k, 0] - 1} of its own object in face {k}"
        raise fields.error("faces", text, triangle[k])

    pose = fields.floats("cams", (None, 3))
    if len(pose) == 0:
        raise fields.error("cams", "expected at least one camera", "none")
    per_camera = (len(pose),)
    weight = {
        "white": fields.floats("w_white", (size_px, size_px)).astype(np.float32),
        "smooth": fields.floats("w_smooth", (size_px, size_px)).astype(np.float32),
        "ones": np.ones((size_px, size_px), np.float32),
    }
    return Workload(
        name=file.name,
        vertex_m=vertex.astype(np.float32),
        triangle=triangle.astype(np.int32),
        vertex_rgb=colour.astype(np.float32),
        triangle_count=triangle_count,
        vertex_end=vertex_end,
        vehicle_count=vehicle_count,
        vehicle_weight=fields.floats("target_w", (vehicle_count,)),
        pose=pose,
        height_m=fields.floats("cam_y", per_camera),
        fov_deg=fields.floats("fov_deg", per_camera, lambda v: (v >= 1) & (v <= 170), "angles of 1 to 170 degrees"),
        near_m=fields.floats("near", per_camera, lambda v: v > 0, "distances above 0"),
        size_px=size_px,
        is_visible=bool(fields.integers("visible", (), lambda v: (v == 0) | (v == 1), "0 or 1")),
        weight=weight,
        scored_pose=fields.floats("poses20", (None, 3)),
        seed=int(fields.integers("seed", ())) if "seed" in fields.arrays else -1,
    )


def read_truth(file: Path, workload: Workload) -> Truth:
    """Read the truth of a workload and check that it is one."""
    fields = _Fields(file)
    pose_count = len(workload.scored_pose)
    names = [str(name) for name in fields.raw("weights").ravel()]
    if not set(WEIGHT_NAMES) <= set(names):
        raise fields.error("weights", f"expected {', '.join(WEIGHT_NAMES)}", ", ".join(names))
    pose = fields.floats("poses", (pose_count, 3))
    if not np.allclose(pose, workload.scored_pose, rtol=0.0, atol=1e-6):
        raise fields.error("poses", f"expected poses20 of {workload.name}", "other poses")
    gradient = fields.floats("grad", (pose_count, 3, len(names)))
    check_gradient = fields.floats("grad_check", (pose_count, 3, len(names)))
    view = fields.integers(
        "id_views", (None,), lambda v: (v >= 0) & (v < workload.view_count), f"views 0..{workload.view_count - 1}"
    )
    image = (len(view), workload.size_px, workload.size_px)
    return Truth(
        name=file.name,
        gradient={name: gradient[:, :, names.index(name)] for name in WEIGHT_NAMES},
        check_gradient={name: check_gradient[:, :, names.index(name)] for name in WEIGHT_NAMES},
        object_view=view,
        object_index=fields.integers("ids", image),
        depth_m=fields.floats_as_they_are("depth", image),
    )


def pack_workload(workload: Workload, *, device: str = "cpu") -> Scene:
    """The scene of a workload on a device, in the ego frame: its vehicles are the objects, its others the occluders."""
    import warp as wp

    from warpav.raster.scene import Scene

    vertex_ego_m = workload.vertex_m @ EGO_FROM_THESIS.T.astype(np.float32)
    triangle_end = np.cumsum(workload.triangle_count)
    meshes, colours = [], []
    for k, (a, p) in enumerate(zip(np.r_[0, workload.vertex_end[:-1]], np.r_[0, triangle_end[:-1]], strict=True)):
        vertex, rgb = vertex_ego_m[a : workload.vertex_end[k]], workload.vertex_rgb[a : workload.vertex_end[k]]
        triangle = workload.triangle[p : triangle_end[k]] - np.int32(a)
        if len(vertex) == 0:
            vertex, rgb = np.zeros((1, 3), np.float32), np.zeros((1, 3), np.float32)
        if len(triangle) == 0:  # one that covers nothing stands in
            triangle = np.zeros((1, 3), np.int32)
        meshes.append(Mesh(vertex, triangle, np.zeros(vertex.shape, np.uint8)))
        colours.append(rgb)
    count = workload.vehicle_count
    scene = Scene({str(k): mesh for k, mesh in enumerate(meshes[:count])}, occluders=meshes[count:], device=device)
    colour = np.concatenate(colours[count:] + colours[:count])
    scene.vertex_rgb = wp.array(colour[scene.source_vertex], dtype=wp.vec3, device=device)
    return scene


def workload_objects(object_id: np.ndarray, vehicle_count: int) -> np.ndarray:
    """The rasteriser's ids as numbers of the workload's objects, -1 where none is."""
    return np.where(object_id < -1, vehicle_count - 2 - object_id, object_id)


_Shape = tuple[int | None, ...]


class _Fields:
    """The arrays of an npz file; every complaint names the file and the array."""

    def __init__(self, file: Path) -> None:
        self._file = file
        if not file.is_file():
            raise InputError(f"{file}: expected an existing .npz file, got none of that name")
        self.arrays = read_arrays(file, "a benchmark file (.npz)")

    def error(self, name: str, expected: str, got: object) -> InputError:
        return InputError(f"{self._file}: {name}: {expected}, got {' '.join(str(got).split())}")

    def raw(self, name: str) -> np.ndarray:
        if name not in self.arrays:
            raise InputError(f"{self._file}: {name}: expected an array of this name, got none")
        return self.arrays[name]

    def _numbers(
        self,
        dtype: type[np.generic] | None,
        name: str,
        shape: _Shape,
        is_good: Callable[[np.ndarray], np.ndarray] = np.isfinite,
        expected: str = "finite numbers",
    ) -> np.ndarray:
        value = self.raw(name)
        kinds, noun = ("iub", "integers") if dtype is np.int64 else ("iuf", "numbers")
        if value.dtype.kind not in kinds:
            raise self.error(name, f"expected {noun}", value.dtype)
        if value.ndim != len(shape) or any(
            want not in (None, have) for have, want in zip(value.shape, shape, strict=True)
        ):
            wanted = ", ".join("n" if want is None else str(want) for want in shape)
            raise self.error(name, f"expected the shape [{wanted}]", list(value.shape))
        value = value if dtype is None else value.astype(dtype)
        for is_fine, text in ((np.isfinite, "finite numbers"), (is_good, expected)):
            if len(bad := np.argwhere(~is_fine(value))):
                at = [int(i) for i in bad[0]]
                raise self.error(name, f"expected {text}", f"{value[tuple(at)]}{f' at {at}' if at else ''}")
        return value

    integers, floats = partialmethod(_numbers, np.int64), partialmethod(_numbers, np.float64)
    floats_as_they_are = partialmethod(_numbers, None)
