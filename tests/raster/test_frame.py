"""The rasteriser as a library: a sphere without surroundings against its closed form, frames, tapes, bad input."""

import math

import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial.transform import Rotation

from warpav import raster
from warpav.core.errors import InputError
from warpav.raster.buffers import Content
from warpav.raster.poses import ViewPoses
from warpav.raster.renderer import Renderer

FOCAL_PX, RADIUS_M = 150.0, 1.0
INTRINSICS = np.array([[[FOCAL_PX, 0.0, 64.0], [0.0, FOCAL_PX, 64.0], [0.0, 0.0, 1.0]]])
CUBE = trimesh.creation.box(extents=[1.0, 1.0, 1.0])


def sphere(centre_m=(0.0, 0.0, 0.0), subdivisions=5):
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS_M)
    return raster.Mesh(ball.vertices + np.asarray(centre_m), ball.faces, [200, 60, 40])


def wall(x_m):
    """From x onwards, in front of the sphere."""
    box = trimesh.creation.box(extents=[6.0, 6.0, 0.1])
    return raster.Mesh(box.vertices + np.array([x_m + 3.0, 0.0, 0.0]), box.faces, [90, 90, 90])


def cameras(count=1):
    return raster.Cameras(np.tile(INTRINSICS, (count, 1, 1)), width_px=128, height_px=128)


def poses():
    """Three poses from which the sphere at the origin lies off the axis, but in the image."""
    turns = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.1, -0.08, 0.4], [-0.05, 0.12, -1.0]])
    matrix = np.tile(np.eye(4), (3, 1, 1))
    matrix[:, :3, :3] = (turns * Rotation.from_rotvec([[0, 0, 0], [0, 1, 0], [0, 2.5, 0]])).as_matrix()
    matrix[:, :3, 3] = [[0.3, -0.2, 5.0], [-0.5, 0.4, 6.0], [0.2, 0.6, 4.5]]
    return matrix


def ellipse_area(centre_m, log_focal=0.0):
    """Area of the ellipse that a sphere is in the image, its centre being in camera coordinates [px^2]."""
    squared, z = float(np.dot(centre_m, centre_m)), centre_m[2]
    focal = FOCAL_PX * math.exp(log_focal)
    return math.pi * (focal * RADIUS_M) ** 2 * math.sqrt(squared - RADIUS_M**2) / (z * z - RADIUS_M**2) ** 1.5


def ellipse_jacobian(pose):
    """To the camera's centre in world axes, a spin about its axes, the log focal length; by small differences."""
    rotation, centre = pose[:3, :3], pose[:3, 3]
    result = []
    for i in range(7):
        sides = []
        for step in (1e-5, -1e-5):
            unit = step * np.eye(3)[i % 3]
            moved = centre - rotation @ unit if i < 3 else centre + np.cross(unit, centre) if i < 6 else centre
            sides.append(ellipse_area(moved, step if i == 6 else 0.0))
        result.append((sides[0] - sides[1]) / 2e-5)
    return np.array(result)


def test_a_sphere_alone_is_an_ellipse(device):
    scene = raster.Scene({"sphere": sphere()}, device=device)
    frame = raster.render(scene, cameras(3), poses(), samples=4)
    areas = frame.areas()
    expected = np.array([ellipse_area(pose[:3, 3]) for pose in poses()])
    np.testing.assert_allclose(areas.visible.numpy()[:, 0], expected, rtol=2e-3)  # worst seen .0006
    np.testing.assert_array_equal(areas.amodal.numpy(), areas.visible.numpy())
    silhouettes = frame.silhouettes().numpy()
    np.testing.assert_allclose(silhouettes.sum(axis=(2, 3)), areas.visible.numpy(), rtol=1e-5)
    # every pixel of the silhouette: a pixel's centre lies in the ellipse if its ray meets the sphere
    column, row = np.meshgrid(np.arange(128) + 0.5, np.arange(128) + 0.5)
    ray = np.stack([(column - 64.0) / FOCAL_PX, (row - 64.0) / FOCAL_PX, np.ones_like(row)], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    for pose, silhouette in zip(poses(), silhouettes[:, 0], strict=True):
        away = np.linalg.norm(np.cross(ray, pose[:3, 3]), axis=-1)
        assert (silhouette[away < RADIUS_M - 0.04] == 1.0).all()
        assert (silhouette[away > RADIUS_M + 0.04] == 0.0).all()
    truth = np.array([ellipse_jacobian(pose) for pose in poses()])
    weight = [1.0, 1.0, 1.0, 0.1, 0.1, 0.1, 0.1]
    for jacobian in (areas.jacobian, areas.amodal_jacobian):
        assert jacobian.shape == (3, 1, 7)
        error = np.linalg.norm((jacobian.numpy()[:, 0] - truth) * weight, axis=1)
        assert (error / np.linalg.norm(truth * weight, axis=1)).max() < 0.002  # worst seen .0006


def test_ids_say_object_occluder_and_nothing(device):
    scene = raster.Scene(
        {"left": sphere([-1.3, 0.0, 5.0]), "right": sphere([1.3, 0.0, 5.0])},
        occluders=[sphere([0.0, 1.2, 6.0]), sphere([0.0, -1.5, 7.0])],
        background_rgb=[[10, 20, 30], [200, 210, 220]],
        device=device,
    )
    frame = raster.render(scene, cameras(), np.eye(4)[None])
    ids = frame.object_id.numpy()[0]
    assert scene.object_names == ("left", "right")
    np.testing.assert_array_equal(np.unique(ids), [-3, -2, -1, 0, 1])
    assert (ids[64, 25], ids[64, 103], ids[100, 64], ids[30, 64]) == (0, 1, -2, -3)
    np.testing.assert_array_equal(np.isinf(frame.depth_m.numpy()[0]), ids == -1)
    assert frame.rgb.numpy()[0, 64, 25] == pytest.approx(np.array([200, 60, 40]) / 255.0, abs=1e-6)
    assert np.asarray(np.from_dlpack(frame.object_id) if device == "cpu" else ids).shape[-2:] == (128, 128)


def test_occluders_alone_are_a_scene(device):
    scene = raster.Scene(occluders=[sphere([0.0, 0.0, 5.0])], device=device)
    frame = raster.render(scene, cameras(), np.eye(4)[None])
    assert frame.areas().visible.shape == (1, 0)
    assert frame.areas().jacobian.shape == (1, 0, 7)
    assert frame.extents().jacobian.shape == (1, 0, 4, 7)
    assert frame.silhouettes().shape == (1, 0, 128, 128)
    np.testing.assert_array_equal(np.unique(frame.object_id.numpy()), [-2, -1])


def test_an_occluder_cuts_the_visible_area(device):
    half = raster.Scene({"sphere": sphere([0.0, 0.0, 5.0])}, occluders=[wall(0.0)], device=device)
    pose = np.eye(4)[None].copy()
    pose[0, 2, 3] = 2.0  # the wall stands 2 m away
    areas = raster.render(half, cameras(), pose, samples=4).areas()
    assert areas.visible.numpy()[0, 0] == pytest.approx(0.5 * areas.amodal.numpy()[0, 0], rel=0.01)
    assert areas.jacobian.numpy()[0, 0, 0] < -100.0  # to the right, the wall hides more


def test_frames_that_are_alive_at_once_do_not_disturb_each_other(device):
    scene = raster.Scene({"sphere": sphere()}, device=device)
    one = raster.render(scene, cameras(), poses()[:1])
    expected = one.areas().jacobian.numpy().copy()
    other = raster.render(scene, cameras(2), poses()[1:], samples=2)
    third = raster.render(raster.Scene({"near": sphere([0, 0, 3])}, device=device), cameras(), np.eye(4)[None])
    assert third.areas().visible.numpy()[0, 0] > one.areas().visible.numpy()[0, 0]
    np.testing.assert_array_equal(one.areas().jacobian.numpy(), expected)
    assert other.areas().visible.shape == (2, 1)
    alone = raster.render(scene, cameras(), poses()[:1])
    for name in ("object_id", "depth_m", "rgb"):
        np.testing.assert_array_equal(getattr(one, name).numpy(), getattr(alone, name).numpy())


def test_a_frame_of_a_renderer_is_stale_after_the_next_render(device):
    scene = raster.Scene({"sphere": sphere()}, device=device)
    renderer = Renderer(cameras().models, device=device)
    at = [
        (wp.array([[0.0, 0.0, -z]], dtype=wp.vec3, device=device), wp.array([np.eye(3)], dtype=wp.mat33, device=device))
        for z in (5.0, 6.0)
    ]
    first = renderer.render(scene, *at[0])
    kept = first.depth_m.numpy().copy()
    second = renderer.render(scene, *at[1], content=Content.OBJECTS)
    with pytest.raises(InputError, match=r"frame: expected the last render.*or use raster\.render"):
        first.areas()
    np.testing.assert_array_equal(first.depth_m.numpy(), kept)  # was drawn in time, in an array of its own
    with pytest.raises(InputError, match="with content images, got one that holds objects only"):
        second.colours()


@pytest.mark.parametrize("as_matrices", [False, True], ids=["floats", "mat44"])
def test_the_tape_reaches_poses_and_focal_lengths(device, as_matrices):
    scene = raster.Scene({"sphere": sphere()}, device=device)
    dtype = wp.mat44 if as_matrices else float
    pose = wp.array(poses().astype(np.float32), dtype=dtype, device=device, requires_grad=True)
    log_focal = wp.zeros(3, dtype=float, device=device, requires_grad=True)
    frame = raster.render(scene, cameras(3), pose, log_focal=log_focal)
    results = {
        "areas": lambda: frame.areas(pose, log_focal=log_focal).visible,
        "weighted": lambda: (
            frame.weighted_area(wp.full((128, 128), 1.0, dtype=float, device=device), pose, log_focal=log_focal).value
        ),
        "silhouettes": lambda: frame.silhouettes(pose, log_focal=log_focal),
    }
    jacobian = frame.areas().jacobian.numpy()[:, 0].astype(float)
    matrix = poses()
    for name, result in results.items():
        for array in (pose, log_focal):
            array.grad.zero_()
        with wp.Tape() as tape:
            value = result()
        np.testing.assert_allclose(value.numpy().sum(), frame.areas().visible.numpy().sum(), rtol=1e-5, err_msg=name)
        tape.backward(grads={value: wp.full(value.shape, 1.0, dtype=float, device=device)})
        gradient = pose.grad.numpy().reshape(3, 4, 4).astype(float)
        # the centre is -R^T t; a spin of the camera turns R and t
        to_centre = np.einsum("vij,vi->vj", -matrix[:, :3, :3], gradient[:, :3, 3])
        np.testing.assert_allclose(to_centre, jacobian[:, :3], rtol=1e-4, atol=1e-1, err_msg=name)
        turn = gradient[:, :3] @ matrix[:, :3].transpose(0, 2, 1)
        spin = np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]])
        np.testing.assert_allclose(spin.T, jacobian[:, 3:6], rtol=1e-3, atol=1.0, err_msg=name)  # of some 2000
        np.testing.assert_allclose(log_focal.grad.numpy(), jacobian[:, 6], rtol=1e-4, err_msg=name)


def test_extents_have_jacobians_and_weights_may_differ_by_object(device):
    scene = raster.Scene({"left": sphere([-1.1, 0, 6]), "right": sphere([1.1, 0, 6])}, device=device)
    frame = raster.render(scene, cameras(), np.eye(4)[None], samples=4)
    extents = frame.extents()
    assert extents.value.shape == (1, 2, 4)
    assert extents.jacobian.shape == (1, 2, 4, 7)
    left, right, top, bottom = extents.value.numpy()[0, 0]
    np.testing.assert_allclose([top + bottom, bottom - top], [128.0, 2.0 * FOCAL_PX / math.sqrt(35.0)], atol=1.0)
    assert left < 64.0 - 1.1 * FOCAL_PX / 6.0 < right
    np.testing.assert_allclose(extents.jacobian.numpy()[0, :, 0, 6], extents.value.numpy()[0, :, 0] - 64.0, atol=1.0)
    weight = np.zeros((1, 2, 128, 128), np.float32)
    weight[0, 0], weight[0, 1] = 1.0, 3.0
    found = frame.weighted_area(wp.array(weight, dtype=float, device=device))
    areas = frame.areas()
    np.testing.assert_allclose(found.value.numpy()[0, :, 0], areas.visible.numpy()[0] * [1.0, 3.0], rtol=1e-5)
    expected = areas.jacobian.numpy()[0] * [[1.0], [3.0]]
    np.testing.assert_allclose(found.jacobian.numpy()[0, :, 0], expected, rtol=1e-3, atol=0.5)


# --- what is rejected

GOOD = {"vertices": CUBE.vertices, "faces": CUBE.faces, "rgb": [1, 2, 3]}


def changed(array, place, value):
    result = np.array(array, dtype=float)
    result[place] = value
    return result


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        ({}, InputError, "objects, occluders: expected at least one mesh, got none"),
        ({"objects": {"cube": "cube.glb"}}, TypeError, r"objects\['cube'\]: expected a raster.Mesh, got str"),
        ({"objects": [sphere()]}, TypeError, "objects: expected meshes by name"),
        ({"occluders": sphere()}, TypeError, r"write occluders=\[mesh\]"),
        (
            {"occluders": [sphere()], "background_rgb": [0, 0, 256]},
            InputError,
            r"background_rgb: expected colours 0\.\.255",
        ),
        ({"occluders": [sphere()], "background_rgb": [0, 0]}, InputError, "background_rgb: expected one colour"),
        ({"occluders": [sphere()], "device": "cuda:77"}, InputError, "device: expected a Warp device"),
    ],
)
def test_scenes_of_anything_else_are_rejected(arguments, kind, message):
    with pytest.raises(kind, match=message):
        raster.Scene(**arguments)


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        ({"intrinsics": np.eye(3)}, InputError, r"intrinsics: expected matrices \[view, 3, 3\]"),
        ({"intrinsics": np.zeros((0, 3, 3))}, InputError, "at least one"),
        ({"intrinsics": "pinhole"}, TypeError, "intrinsics: expected numbers, got str"),
        ({"intrinsics": 0.0 * INTRINSICS}, InputError, "intrinsics: expected a matrix with an inverse"),
        ({"intrinsics": changed(INTRINSICS, (0, 0, 0), np.inf)}, InputError, "intrinsics: expected finite numbers"),
        ({"intrinsics": changed(INTRINSICS, (0, 0, 1), 0.1)}, InputError, "without skew"),
        (
            {"intrinsics": changed(INTRINSICS, (0, 0, 0), -5.0)},
            InputError,
            "view 0: focal_px must be positive",
        ),
        ({"width_px": 4}, InputError, "cameras: view 0: an image needs at least 8 x 8"),
        ({"width_px": 0}, InputError, "at least 8 x 8"),
        ({"height_px": 128.0}, TypeError, "height_px: expected a whole number of pixels, got 128.0"),
        ({"lens": "mirror"}, InputError, "lens must be one of"),
        ({"near_m": 0.0}, InputError, "near_m must be positive"),
        ({"distortion": [0.1]}, InputError, "cameras: view 0"),
        (
            {"distortion": np.zeros((2, 4)), "lens": "fisheye"},
            InputError,
            r"expected \[coefficient\] or \[1,",
        ),
    ],
)
def test_cameras_that_are_none_are_rejected(arguments, kind, message):
    with pytest.raises(kind, match=message):
        raster.Cameras(**({"intrinsics": INTRINSICS, "width_px": 128, "height_px": 128} | arguments))


@pytest.mark.parametrize(
    ("pose", "kind", "message"),
    [
        (np.eye(4), InputError, r"camera_from_world: expected one pose for each view, \[1, 4, 4\], got \[4, 4\]"),
        (np.tile(np.eye(4), (2, 1, 1)), InputError, r"\[1, 4, 4\], got \[2, 4, 4\]"),
        (
            changed(np.eye(4)[None], (0, 0, 3), np.nan),
            InputError,
            "got NaN or infinity in view 0",
        ),
        (2.0 * np.eye(4)[None], InputError, "expected rotations and translations"),
        (np.diag([1.0, 1.0, -1.0, 1.0])[None], InputError, "expected rotations and translations"),
        ("front", TypeError, "camera_from_world: expected numbers"),
        (
            wp.array(np.eye(4, dtype=np.int32)[None], dtype=wp.int32, device="cpu"),
            TypeError,
            "expected floats, got int32",
        ),
    ],
)
def test_poses_that_are_none_are_rejected(pose, kind, message):
    scene = raster.Scene({"cube": raster.Mesh(*GOOD.values())})
    with pytest.raises(kind, match=message):
        raster.render(scene, cameras(), pose)


def test_other_arguments_of_render_are_rejected():
    scene = raster.Scene({"cube": raster.Mesh(*GOOD.values())})
    with pytest.raises(TypeError, match=r"scene: expected a raster\.Scene, got dict"):
        raster.render({}, cameras(), np.eye(4)[None])
    with pytest.raises(TypeError, match=r"cameras: expected a raster\.Cameras, got ndarray"):
        raster.render(scene, INTRINSICS, np.eye(4)[None])
    for samples in (0, 1.5):
        with pytest.raises(InputError, match="supersampling must be a whole number"):
            raster.render(scene, cameras(), np.eye(4)[None], samples=samples)
    with pytest.raises(InputError, match="log_focal: expected one number for each of 1 views"):
        raster.render(scene, cameras(), np.eye(4)[None], log_focal=np.zeros(2))


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
def test_scenes_and_poses_of_another_device_are_rejected():
    scene = raster.Scene({"cube": raster.Mesh(*GOOD.values())}, device="cuda:0")
    pose = wp.array(np.eye(4, dtype=np.float32)[None], dtype=wp.mat44, device="cpu")
    with pytest.raises(InputError, match=r"expected an array on cuda:0, where the scene is, got one on cpu"):
        raster.render(scene, cameras(), pose)
    renderer = Renderer(cameras().models, device="cpu")
    views = ViewPoses(wp.zeros(1, dtype=wp.vec3, device="cpu"), wp.zeros(1, dtype=wp.mat33, device="cpu"))
    with pytest.raises(InputError, match="scene: expected one on cpu, the renderer's device, got one on cuda:0"):
        renderer.render(scene, *views[:2])
