"""Lenses that are no pinholes: images against embree rays, Jacobians against differences of finer renders."""

import dataclasses
import functools
import math

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from tests.driving_scene import (
    SKY,
    block,
    camera_pose,
    car,
    ground,
    on_device,
    packed_street,
    random_poses,
    street,
    vehicle,
)
from tests.oracle.ray_cast import cast_scene
from tests.raster.bodies import depth_and_index
from warpav.raster.areas import AMODAL_AREA, BOTTOM, BOX_AREA, LEFT, RIGHT, TOP, VISIBLE_AREA
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.poses import ViewPoses
from warpav.raster.renderer import Renderer
from warpav.scene import DeviceScene, Scene

SIZE = 96
BARREL = (-0.21, 0.06, 0.002, -0.001, -0.008)
KB4 = (-0.013, 0.0021, -0.0042, 0.0007)


def models_of(size):
    """Lenses by name, with images so high [px]."""

    def calibrated(lens, focal_px, centre_px, distortion=()):
        """Given for images of 128 px."""
        focal_px, centre_px = (tuple(size / 128 * np.array(each)) for each in (focal_px, centre_px))
        return CameraModel(size, size, lens=lens, focal_px=focal_px, centre_px=centre_px, distortion=distortion)

    return {
        "brown_conrady": calibrated("brown_conrady", (75.0, 72.0), (61.5, 66.0), BARREL),
        "fisheye": CameraModel(size, size, math.radians(200.0), lens="fisheye", distortion=KB4),
        # sees 73 degrees round its axis; the image's corners are black
        "circle": calibrated("fisheye", (70.0, 72.0), (66.0, 63.0), (-0.2, 0.0, 0.0, 0.0)),
        "eucm": calibrated("eucm", (50.0, 48.0), (62.0, 65.0), (0.62, 1.15)),
        "double_sphere": CameraModel(size, size, math.radians(195.0), lens="double_sphere", distortion=(-0.2, 0.59)),
        "panorama": CameraModel(2 * size, size, 2.0 * math.pi, lens="panorama"),
        "equirectangular": CameraModel(2 * size, size, 2.0 * math.pi, lens="equirectangular"),
        "part": calibrated("panorama", (45.0, 40.0), (50.0, 60.0)),
    }


MODELS = models_of(SIZE)
SPIN_X, ZOOM = 3, 6
CALIBRATED = {"brown_conrady": 8, "fisheye": 4, "eucm": 2, "double_sphere": 2}  # coefficients


@functools.cache
def street_rays():
    return cast_scene(street())


@functools.cache
def two_cars():
    """A noisy car and, before it for some views, another."""
    rng = np.random.default_rng(3)
    cars = (vehicle(1, car(rng), 5.0, 0.0, 0.6), vehicle(2, car(rng), 4.2, 3.2, 0.1))
    return Scene("pair", ground(rng), block(rng, [1, 1, 1], [0, 0, -50.0]), cars, SKY)


def jacobian(measures):
    """To shift, spin and zoom, [view, vehicle, measure, 7]."""
    parts = [measures.jac_translation.numpy(), measures.jac_rotation.numpy(), measures.jac_log_focal.numpy()[..., None]]
    return np.concatenate(parts, axis=-1)


def moved(pose, model, direction, step):
    """A view moved along ego x, y, z [m], spun about a camera axis [rad], or zoomed (relative)."""
    pose = pose.copy()
    if direction < SPIN_X:
        pose[direction, 3] += step
    elif direction < ZOOM:
        # a left rotation of camera_from_ego
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(step * np.eye(3)[direction - SPIN_X]).as_matrix().T
    else:
        (fx, cx), (fy, cy) = model.intrinsics[:2, [0, 2]][0], model.intrinsics[:2, [1, 2]][1]
        zoomed = (fx * (1.0 + step), fy * (1.0 + step))
        model = dataclasses.replace(model, focal_px=zoomed, centre_px=(cx, cy), fov_rad=None)
    return pose, model


def measured(scene, poses, models, supersampling, device, box_px=None):
    renderer = Renderer(models, supersampling=supersampling, device=device)
    frame = renderer.render(scene, *on_device(poses, device))
    if box_px is None:
        return frame.measure()
    box_px = np.tile(np.asarray(box_px, np.float32), (len(poses), scene.object_count, 1))
    return frame.measure(wp.array(box_px, dtype=wp.vec4, device=device))


def poses_round_the_cars(count, pitch_rad=0.1):
    rng = np.random.default_rng(1)
    poses = []
    for _ in range(count):
        bearing, distance = rng.uniform(-math.pi, math.pi), rng.uniform(3.5, 6.0)
        place = np.array(
            [4.5 + distance * math.cos(bearing), 0.5 + distance * math.sin(bearing), rng.uniform(1.2, 2.5)]
        )
        yaw = math.atan2(0.5 - place[1], 4.5 - place[0]) + rng.uniform(-0.5, 0.5)
        poses.append(camera_pose(place, yaw, pitch_rad + rng.uniform(-0.1, 0.1), rng.uniform(-0.2, 0.2)))
    return np.stack(poses)


@pytest.mark.parametrize("name", MODELS)
def test_images_agree_with_rays(device, rng, name):
    model = MODELS[name]
    poses = np.r_[random_poses(rng, 3), [camera_pose([1.0, 0.0, 1.9], 0.3, 0.05, 0.02)]]
    scene = packed_street(device).raster
    renderer = Renderer([model] * len(poses), device=device)
    frame = renderer.render(scene, *on_device(poses, device))
    depth_m, object_index = depth_and_index(frame)
    rgb = frame.colours().numpy()
    different, depth_error, rgb_error = 0, [], []
    for k, pose in enumerate(poses):
        truth = street_rays().look(pose, model)
        equal = object_index[k] == truth.object_index
        different += np.count_nonzero(~equal)
        hit = equal & (object_index[k] >= 0)
        assert np.isinf(depth_m[k][object_index[k] < 0]).all()
        depth_error.append(np.abs(depth_m[k][hit] / truth.depth_m[hit] - 1.0))
        rgb_error.append(np.abs(rgb[k][equal] - truth.rgb[equal]).max(axis=-1))
        row, column = np.indices(object_index[k].shape) + 0.5
        blind = np.isnan(model.rays(np.stack([column, row], axis=-1))[..., 0])
        assert not rgb[k][blind].any()
        assert (blind.mean() > 0.1) == (name == "circle")
    assert different <= 3  # worst seen 0
    assert np.concatenate(depth_error).max() < 1e-4  # worst seen 2.2e-5
    assert np.quantile(np.concatenate(rgb_error), 0.9999) < 1e-3  # worst seen 4e-5


@functools.cache
def ours_and_truth(name, device, near_m=0.1, count=3):
    """Jacobians at one sample a pixel and differences at 25, [pose, vehicle, measure, direction]."""
    model = dataclasses.replace(MODELS[name], near_m=near_m)
    if name in ("panorama", "equirectangular"):
        model = dataclasses.replace(model, fov_rad=5.0)  # a zoomed-out whole turn would be more than one
    scene = DeviceScene.pack(two_cars(), device=device).raster
    poses = poses_round_the_cars(count)
    box = [0.4 * model.width_px, 0.3 * SIZE, 0.7 * model.width_px, 0.7 * SIZE]
    ours = jacobian(measured(scene, poses, [model] * count, 1, device, box))
    columns = []
    for direction in range(ZOOM + 1):
        step = 0.05 if direction < SPIN_X else 0.01
        both = [moved(pose, model, direction, sign * step) for sign in (1, -1) for pose in poses]
        value = measured(scene, *zip(*both, strict=True), 5, device, box).value.numpy()
        columns.append((value[:count] - value[count:]) / (2.0 * step))
    # 0.1 rad and a tenth of zoom weigh as much as 1 m
    weight = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1, 0.1])
    return ours * weight, np.stack(columns, axis=-1) * weight


def relative_error(ours, truth):
    return np.linalg.norm(ours - truth) / np.linalg.norm(truth)


# worst seen of each: visible .030, alone .028, in the box .046
@pytest.mark.parametrize("name", MODELS)
def test_jacobians_of_areas_match_differences(device, name):
    ours, truth = ours_and_truth(name, device)
    for measure in (VISIBLE_AREA, AMODAL_AREA, BOX_AREA):
        assert relative_error(ours[:, :, measure], truth[:, :, measure]) < 0.08
        for directions in (slice(0, 3), slice(6, 7)):
            assert relative_error(ours[:, :, measure, directions], truth[:, :, measure, directions]) < 0.12
    assert np.abs(truth[:, :, VISIBLE_AREA] - truth[:, :, AMODAL_AREA]).max() > 10.0  # one car hides the other


def recalibrated(model, number, step):
    """A model with another fx, fy, cx, cy [px] or coefficient."""
    fx, fy, cx, cy = model.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
    numbers = np.r_[fx, fy, cx, cy, np.pad(model.distortion, (0, 8 - len(model.distortion)))]
    numbers[number] += step
    distortion = numbers[4 : 4 + CALIBRATED.get(model.lens, 0)]
    return dataclasses.replace(
        model, fov_rad=None, focal_px=tuple(numbers[:2]), centre_px=tuple(numbers[2:4]), distortion=tuple(distortion)
    )


@pytest.mark.parametrize("name", ["pinhole", "brown_conrady", "fisheye", "eucm", "double_sphere", "part"])
def test_jacobians_to_the_calibration_match_differences(device, name):
    model = MODELS.get(name) or CameraModel(SIZE, SIZE, focal_px=(56.0, 54.0), centre_px=(46.0, 49.5))
    if name == "brown_conrady":  # one that sees the whole image, whatever is added to a coefficient
        model = dataclasses.replace(model, fov_rad=None, distortion=(-0.03, 0.01, 0.002, -0.001, 0.001, 0.01, 0.0, 0.0))
    scene, poses = DeviceScene.pack(two_cars(), device=device).raster, poses_round_the_cars(3)
    renderer = Renderer([model] * 3, supersampling=2, device=device)
    ours = renderer.render(scene, *on_device(poses, device)).calibration_jacobian().numpy()
    count = 4 + CALIBRATED.get(name, 0)
    for number in range(count):
        step = 1.5 if number < 4 else 0.01
        models = [recalibrated(model, number, sign * step) for sign in (1, -1) for _ in poses]
        value = measured(scene, np.r_[poses, poses], models, 6, device).value.numpy()[..., [VISIBLE_AREA, AMODAL_AREA]]
        truth = (value[:3] - value[3:]) / (2.0 * step)
        # differences of two areas are sure to about 1.5 px^2
        tolerance = 0.05 * np.linalg.norm(truth) + 1.5 / (2.0 * step)
        assert np.linalg.norm(ours[..., number] - truth) <= tolerance, number
    assert not ours[..., count:].any()


def vertex_extents(pose, model, car):
    """LEFT, RIGHT, TOP, BOTTOM of a car's vertices [px]; NaN where one of them has no image."""
    place = model.project((car.mesh.vertex_m.astype(float) - pose[:3, 3]) @ pose[:3, :3])
    return np.array([place[:, 0].min(), place[:, 0].max(), place[:, 1].min(), place[:, 1].max()])


@pytest.mark.parametrize("name", ["brown_conrady", "fisheye", "panorama", "part"])
def test_jacobians_of_extents_are_those_of_the_outermost_vertices(device, name):
    ours, _ = ours_and_truth(name, device)
    model = MODELS[name] if name != "panorama" else dataclasses.replace(MODELS[name], fov_rad=5.0)
    errors = []
    for k, pose in enumerate(poses_round_the_cars(3)):
        for vehicle_index, each in enumerate(two_cars().vehicles):
            extent = vertex_extents(pose, model, each)
            columns = []
            for direction in range(ZOOM + 1):
                step = 1e-4
                high, low = (vertex_extents(*moved(pose, model, direction, sign * step), each) for sign in (1, -1))
                columns.append((high - low) / (2.0 * step) * (1.0 if direction < SPIN_X else 0.1))
            truth = np.stack(columns, axis=-1)
            size = np.array([model.width_px, model.width_px, model.height_px, model.height_px])
            for i in np.flatnonzero((extent > 1.0) & (extent < size - 1.0)):
                errors.append(relative_error(ours[k, vehicle_index, LEFT + i], truth[i]))
    assert len(errors) >= 10
    # seen .044 and .10: ours is the mean over the outermost line of samples
    assert np.median(errors) < 0.07
    assert np.quantile(errors, 0.9) < 0.15


def test_a_lens_without_distortion_is_a_pinhole(device):
    """Rays and triangles decide the same, and their outlines and Jacobians agree."""
    pinhole = CameraModel(160, 120, math.radians(80.0), 0.3)
    undistorted = dataclasses.replace(pinhole, lens="brown_conrady", distortion=(0.0,) * 8)
    poses = poses_round_the_cars(6)
    scene = DeviceScene.pack(two_cars(), device=device).raster
    box = [50.0, 40.0, 100.0, 90.0]
    for occlusion in Occlusion:
        found = []
        for model in (pinhole, undistorted):
            renderer = Renderer([model] * 6, occlusion=occlusion, device=device)
            frame = renderer.render(scene, *on_device(poses, device))
            boxes = wp.array(np.tile(np.float32(box), (6, 2, 1)), dtype=wp.vec4, device=device)
            images = [array.numpy() for array in (*frame.depths_and_ids(), frame.colours())]
            found.append((frame.measure(boxes), *images))
        (one, one_depth, one_object, one_rgb), (other, depth, object_index, rgb) = found
        assert np.count_nonzero(one_object != object_index) <= 2  # worst seen 0
        np.testing.assert_allclose(depth, one_depth, rtol=1e-4)
        np.testing.assert_allclose(rgb, one_rgb, atol=1e-3)
        np.testing.assert_allclose(other.value.numpy(), one.value.numpy(), atol=2.0)
        for measure in range(7):
            error = relative_error(jacobian(other)[:, :, measure], jacobian(one)[:, :, measure])
            assert error < 1e-3  # worst seen 4e-5


def test_the_seam_of_a_panorama_changes_nothing(device):
    """A car half on the right, half on the left, has the area and Jacobian of one in the middle."""
    scene = DeviceScene.pack(two_cars(), device=device).raster
    model = CameraModel(512, 128, 2.0 * math.pi, lens="panorama")
    poses = np.stack([camera_pose([1.0, -1.5, 1.6], yaw, 0.0, 0.0) for yaw in (0.36, 0.36 + math.pi)])
    measures = measured(scene, poses, [model] * 2, 1, device)
    value, slope = measures.value.numpy(), jacobian(measures)
    assert 100.0 < value[0, 0, LEFT] < value[0, 0, RIGHT] < 400.0
    assert value[1, 0, LEFT] == 0.0
    assert value[1, 0, RIGHT] == 512.0
    for measure in (VISIBLE_AREA, AMODAL_AREA):
        np.testing.assert_allclose(value[1, :, measure], value[0, :, measure], atol=2.0)
        middle, seam = slope[:, 0, measure]
        spin = [poses[k][:3, :3] @ slope[k, 0, measure, 3:6] for k in (0, 1)]  # about the axes of the ego frame
        np.testing.assert_allclose(seam[:3], middle[:3], atol=1e-4 * np.abs(middle[:3]).max())
        np.testing.assert_allclose(spin[1], spin[0], atol=1e-4 * np.abs(spin[0]).max())
    # what is cut by the border does not move
    assert not slope[1, 0, [LEFT, RIGHT]].any()


def test_a_turning_panorama_shifts_and_a_rolling_fisheye_turns(device):
    scene = DeviceScene.pack(two_cars(), device=device).raster
    pose = camera_pose([0.5, -1.0, 1.6], 0.4, 0.1, 0.2)
    panorama = CameraModel(512, 256, 2.0 * math.pi, lens="panorama")
    slope = jacobian(measured(scene, [pose], [panorama], 1, device))[0]
    spin_y = slope[:, :, 4]
    scale = np.abs(slope[:, AMODAL_AREA, :3]).max()
    np.testing.assert_allclose(spin_y[:, [VISIBLE_AREA, AMODAL_AREA]], 0.0, atol=1e-3 * scale)
    np.testing.assert_allclose(spin_y[:, [LEFT, RIGHT]], panorama.intrinsics[0, 0], rtol=1e-4)
    np.testing.assert_allclose(spin_y[:, [TOP, BOTTOM]], 0.0, atol=1e-3)
    fisheye = CameraModel(256, 256, math.radians(180.0), lens="fisheye")
    slope = jacobian(measured(scene, [pose], [fisheye], 1, device))[0]
    scale = np.abs(slope[:, AMODAL_AREA, :3]).max()
    np.testing.assert_allclose(slope[:, AMODAL_AREA, 5], 0.0, atol=1e-3 * scale)


def colour_gradient(scene, model, pose, weight, device):
    """Gradient of the weighted sum of colours at four samples a pixel, to shift and spin."""
    position, rotation = on_device([pose], device)
    position.requires_grad = rotation.requires_grad = True
    renderer = Renderer([model], supersampling=2, device=device)
    frame = renderer.render(scene, position, rotation, content=Content.IMAGES)
    tape = wp.Tape()
    with tape:
        image = frame.colours(ViewPoses(position, rotation))
    tape.backward(grads={image: wp.array(weight, dtype=wp.vec3, device=device)})
    spin = [(rotation.grad.numpy()[0] * (np.cross(axis, np.eye(3)).T @ pose[:3, :3].T)).sum() for axis in np.eye(3)]
    return np.r_[position.grad.numpy()[0], spin] * [1.0, 1.0, 1.0, 0.1, 0.1, 0.1]


@pytest.mark.parametrize("name", ["brown_conrady", "circle", "part"])
def test_gradients_of_colours_match_differences(device, rng, name):
    model = models_of(128)[name]
    pose = poses_round_the_cars(1)[0]
    scene = DeviceScene.pack(two_cars(), device=device).raster
    weight = np.repeat(rng.normal(size=(1, 16, 16, 3)), 8, axis=1).repeat(8, axis=2).astype(np.float32)
    renderer = Renderer([model], supersampling=4, device=device)

    def loss(pose):
        frame = renderer.render(scene, *on_device([pose], device), content=Content.IMAGES)
        return (weight * frame.colours().numpy()).sum(dtype=float)

    truth = []
    for direction in range(ZOOM):
        step = 0.05 if direction < SPIN_X else 0.01
        high, low = (loss(moved(pose, model, direction, sign * step)[0]) for sign in (1, -1))
        truth.append((high - low) / (2.0 * step) * (1.0 if direction < SPIN_X else 0.1))
    # seen .11, .060, .036: weights jump from block to block
    ours = colour_gradient(scene, model, pose, weight, device)
    assert relative_error(ours, np.array(truth)) < 0.2


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_views_that_are_zoomed_on_the_device_are_those_of_zoomed_lenses(device, lens):
    model, zooms = CameraModel(96, 72, 1.4, lens=lens), np.array([0.4, 0.0, -0.2], np.float32)
    scene, poses = DeviceScene.pack(two_cars(), device=device).raster, poses_round_the_cars(3)
    expected = measured(scene, poses, [model.zoomed(float(zoom)) for zoom in zooms], 2, device)
    renderer = Renderer([model] * 3, supersampling=2, device=device)
    position, rotation = on_device(poses, device)
    log_zoom = wp.array(zooms, dtype=float, device=device)
    frame = renderer.render(scene, position, rotation, log_focal=log_zoom)
    found = frame.measure()
    np.testing.assert_allclose(found.value.numpy(), expected.value.numpy(), rtol=1e-4, atol=2e-2)
    np.testing.assert_array_equal(found.value.numpy()[1], expected.value.numpy()[1])
    # at the zooms at which it was rendered the value is the rendered one, and what moves is counted from there
    np.testing.assert_array_equal(found.on_tape(position, rotation, log_zoom).numpy(), found.value.numpy())
    np.testing.assert_array_equal(found.on_tape(position, rotation).numpy(), found.value.numpy())
    step = found.on_tape(position, rotation, wp.array(zooms + np.float32(0.01), dtype=float, device=device)).numpy()
    np.testing.assert_allclose(step - found.value.numpy(), 0.01 * found.jac_log_focal.numpy(), rtol=1e-2, atol=1e-2)
    # and the next render is as the lenses say again
    frame = renderer.render(scene, position, rotation)
    plain = measured(scene, poses, [model] * 3, 2, device)
    np.testing.assert_array_equal(frame.measure().value.numpy(), plain.value.numpy())
    with pytest.raises(ValueError, match="log_focal must be one for each of 3 views"):
        renderer.render(scene, position, rotation, log_focal=wp.zeros(2, dtype=float, device=device))
