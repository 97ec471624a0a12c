"""Jacobians of the measures against central differences of a supersampled render."""

import functools
import math

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from tests.driving_scene import SKY, block, camera_pose, car, flat_surface, ground, on_device, vehicle
from warpav.core.frames import EGO_FROM_THESIS
from warpav.optimisation import CameraMount
from warpav.raster.areas import AMODAL_AREA, BOTTOM, BOX_AREA, LEFT, RIGHT, TOP, VISIBLE_AREA
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.raster.renderer import Renderer
from warpav.scene import BLACK_SKY, Box, DeviceScene, Scene, Vehicle

MODEL = CameraModel(256, 256, math.radians(80.0), 0.1)
POSE_COUNT = 50
# Differences of 1024 samples: smaller steps drown in the samples' grain, larger ones meet the kinks at the box's edges.
TRUTH_SUPERSAMPLING, STEP_M, STEP_RAD, VIEWS_AT_ONCE = 4, 0.06, 0.006, 10
X, Y, Z, SPIN_X, SPIN_Y, SPIN_Z, YAW = range(7)
SIX, SIX_WEIGHT = (X, Y, Z, SPIN_X, SPIN_Y, SPIN_Z), (1.0, 1.0, 1.0, 0.1, 0.1, 0.1)


@functools.cache
def two_cars():
    """A noisy car and, before it for some views, another."""
    rng = np.random.default_rng(3)
    cars = (vehicle(1, car(rng), 9.0, 0.0, 0.6), vehicle(2, car(rng), 6.0, 1.6, 0.1))
    out_of_sight = block(rng, [1, 1, 1], [0, 0, -5.0])
    return Scene("pair", ground(rng), out_of_sight, cars, SKY)


@functools.cache
def poses_round_the_car():
    rng = np.random.default_rng(1)
    poses = []
    for _ in range(POSE_COUNT):
        bearing, distance = rng.uniform(-math.pi, math.pi), rng.uniform(5.0, 14.0)
        place = np.array([9.0 + distance * math.cos(bearing), distance * math.sin(bearing), rng.uniform(1.3, 2.2)])
        yaw = math.atan2(-place[1], 9.0 - place[0]) + rng.uniform(-0.5, 0.5)
        poses.append(camera_pose(place, yaw, rng.uniform(-0.05, 0.15), rng.uniform(-0.1, 0.1)))
    return np.stack(poses)


def moved(poses, direction, step):
    """Poses moved in ego x, y, z [m], spun about a camera axis, or turned about the vertical [rad]."""
    result = poses.copy()
    if direction <= Z:
        result[:, direction, 3] += step
    elif direction == YAW:
        result[:, :3, :3] = Rotation.from_rotvec([0.0, 0.0, step]).as_matrix() @ poses[:, :3, :3]
    else:
        # the camera's own axes seen from the ego frame: a left rotation of camera_from_ego
        spin = Rotation.from_rotvec(step * np.eye(3)[direction - SPIN_X]).as_matrix()
        result[:, :3, :3] = poses[:, :3, :3] @ spin.T
    return result


@functools.cache
def measured(device, supersampling, direction=None, step=0.0):
    """Measures of every pose, in chunks, with the boxes of `boxes`; values, jac_translation, jac_rotation."""
    scene = DeviceScene.pack(two_cars(), device=device).raster
    renderer = Renderer([MODEL] * VIEWS_AT_ONCE, supersampling=supersampling, device=device)
    poses = poses_round_the_car() if direction is None else moved(poses_round_the_car(), direction, step)
    parts = []
    for first in range(0, POSE_COUNT, VIEWS_AT_ONCE):
        chunk = slice(first, first + VIEWS_AT_ONCE)
        frame = renderer.render(scene, *on_device(poses[chunk], device))
        measures = frame.measure(wp.array(boxes(device)[chunk], dtype=wp.vec4, device=device))
        parts.append([getattr(measures, name).numpy() for name in ("value", "jac_translation", "jac_rotation")])
    return [np.concatenate(part) for part in zip(*parts, strict=True)]


@functools.cache
def boxes(device):
    """Boxes that cut through the cars, whole quarters of pixels, so that every sampling sees the same box."""
    scene = DeviceScene.pack(two_cars(), device=device).raster
    renderer = Renderer([MODEL] * POSE_COUNT, device=device)
    frame = renderer.render(scene, *on_device(poses_round_the_car(), device))
    box = frame.measure().value.numpy()[:, :, [LEFT, TOP, RIGHT, BOTTOM]]
    size = np.tile(box[..., 2:] - box[..., :2], 2)
    jitter = np.random.default_rng(9).uniform(-0.15, 0.15, box.shape)
    return (np.round((box + jitter * size) * 4.0) / 4.0).astype(np.float32)


def jacobian(device, supersampling):
    """Per direction X .. SPIN_Z, [pose, vehicle, measure, direction]."""
    return np.concatenate(measured(device, supersampling)[1:], axis=-1)


def differences(device, directions):
    """Central differences, [pose, vehicle, measure, direction]."""
    columns = []
    for direction in directions:
        step = STEP_M if direction <= Z else STEP_RAD
        high, low = (measured(device, TRUTH_SUPERSAMPLING, direction, sign * step)[0] for sign in (1, -1))
        columns.append((high - low) / (2.0 * step))
    return np.stack(columns, axis=-1)


def cosines(device, measure, directions, supersampling=1, weight=None, least_norm=20.0):
    """Cosine of Jacobian and truth for every pose in which the first car's truth is not small."""
    weight = np.ones(len(directions)) if weight is None else np.asarray(weight)
    ours = jacobian(device, supersampling)[:, 0, measure][:, directions] * weight
    truth = differences(device, directions)[:, 0, measure] * weight
    norm = np.linalg.norm(truth, axis=1)
    kept = norm > least_norm
    assert kept.sum() >= 0.7 * POSE_COUNT
    cosine = (ours * truth).sum(axis=1) / np.maximum(norm * np.linalg.norm(ours, axis=1), 1e-9)
    error = np.linalg.norm(ours - truth, axis=1) / np.maximum(norm, 1e-9)
    return cosine[kept], error[kept]


# seen: .9992 .9917 .046, .9992 .9900 .045, .9983 .9622 .073
@pytest.mark.parametrize("measure", [VISIBLE_AREA, AMODAL_AREA, BOX_AREA], ids=["visible", "amodal", "box"])
def test_six_degree_gradients_match_differences(device, measure):
    # 0.1 rad weighs as much as 1 m
    cosine, error = cosines(device, measure, SIX, weight=SIX_WEIGHT)
    assert np.median(cosine) >= 0.995
    assert np.quantile(cosine, 0.1) >= 0.94
    assert np.median(error) <= 0.1


# seen: cosine .9977 or more, error .08 or less; the truth's own grain is a quarter of a pixel in steps of a few pixels
@pytest.mark.parametrize("measure", [LEFT, RIGHT, TOP, BOTTOM], ids=["left", "right", "top", "bottom"])
def test_extent_gradients_match_differences(device, measure):
    cosine, error = cosines(device, measure, SIX, weight=SIX_WEIGHT, least_norm=1.0)
    assert np.median(cosine) >= 0.995
    assert np.quantile(cosine, 0.1) >= 0.98
    assert np.median(error) <= 0.12


def workload_scene(data):
    """The benchmark's arrays as a scene in the ego frame."""
    ends, first = data["vert_ends"], 0
    meshes, face_first = [], 0
    for end, count in zip(ends, data["face_counts"], strict=True):
        faces = data["faces"][face_first : face_first + count] - first
        colour = np.round(data["colors"][first:end] * 255.0)
        meshes.append(Mesh.create(data["verts"][first:end] @ EGO_FROM_THESIS.T, faces, colour))
        first, face_first = end, face_first + count
    targets = int(data["n_targets"])
    box = Box(np.zeros(3), np.ones(3), 0.0)
    vehicles = tuple(Vehicle(k + 1, "car", mesh, box) for k, mesh in enumerate(meshes[:targets]))
    out_of_sight = Mesh.create([[0, 0, -500], [1, 0, -500], [0, 1, -500]], [[0, 1, 2]], [0, 0, 0])
    assert len(meshes) == targets + 1
    return Scene("workload", meshes[-1], out_of_sight, vehicles, BLACK_SKY)


def test_taped_gradients_match_the_truth_of_the_benchmark(device, workload_folder):
    data, truth = np.load(workload_folder / "workload.npz"), np.load(workload_folder / "truth.npz")
    assert int(data["visible"]) == 0
    scene = DeviceScene.pack(workload_scene(data), device=device).raster
    cosine, value_error = [], []
    for i, (x, z, yaw) in enumerate(truth["poses"]):
        # pose i takes the lens of camera i mod C; its x is the ego frame's y, its z the ego frame's x
        lens = i % len(data["cams"])
        size = int(data["res"])
        model = CameraModel(size, size, math.radians(data["fov_deg"][lens]), float(data["near"][lens]))
        surface = flat_surface([-5.0, -5.0], [5.0, 5.0], height_m=float(data["cam_y"][lens]))
        mount = CameraMount(surface, camera=model, height_offset_m=0.0, device=device)
        assert mount.rotation_count == 4
        pose = wp.array([[z, x, yaw, 0.0, 0.0, 0.0, 0.0]], dtype=float, device=device, requires_grad=True)
        tape = wp.Tape()
        with tape:
            views = mount.place(pose)
        renderer = Renderer([model] * 4, device=device)
        frame = renderer.render(scene, views.position_ego_m, views.camera_from_ego, content=Content.OBJECTS)
        measures = frame.measure()
        with tape:
            taped = measures.on_tape(views.position_ego_m, views.camera_from_ego)
        weight = np.zeros(taped.shape, np.float32)
        weight[:, :, AMODAL_AREA] = data["target_w"]
        tape.backward(grads={taped: wp.array(weight, dtype=float, device=device)})
        ours = pose.grad.numpy()[0, [1, 0, 2]]
        expected = truth["grad"][i, :, 2]  # weight image of ones
        cosine.append(ours @ expected / np.linalg.norm(ours) / np.linalg.norm(expected))
        value_error.append((weight * measures.value.numpy()).sum() / truth["value"][i, 2] - 1.0)
    assert np.median(cosine) >= 0.9999  # seen .99998
    assert np.abs(value_error).max() < 5e-3  # seen 3.6e-3
