"""Images of the rasteriser against embree rays through the sample centres."""

import math

import numpy as np
import pytest
import trimesh

from tests.driving_scene import (
    EGO_TOP_M,
    camera_pose,
    coloured,
    on_device,
    packed_street,
    random_poses,
    street,
)
from tests.oracle.ray_cast import RayCaster, cast_scene
from tests.raster.bodies import depth_and_index
from warpav.detection import render_images
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.raster.renderer import Renderer
from warpav.rig import RigCamera
from warpav.scene import DeviceScene, Scene

MODEL = CameraModel(128, 128, math.pi / 2, 0.1)
FAR_AWAY = Mesh.create([[0, 0, -500], [1, 0, -500], [0, 1, -500]], [[0, 1, 2]], [0, 0, 0])


@pytest.fixture(scope="module")
def street_rays():
    return cast_scene(street())


def images_of(renderer, scene, poses):
    """Depth, object and colour images."""
    return images_in(renderer.render(scene, *on_device(poses, renderer.device)))


def images_in(frame):
    """Depths, objects and colours of a frame, on the host."""
    return *depth_and_index(frame), frame.rgb.numpy()


def poses_on_ego(rng, count):
    return np.stack(
        [
            camera_pose(
                [rng.uniform(0.1, 2.1), rng.uniform(-0.7, 0.7), rng.uniform(EGO_TOP_M + 0.02, EGO_TOP_M + 0.5)],
                rng.uniform(-math.pi, math.pi),
                rng.uniform(-0.2, 0.4),
                rng.uniform(-0.1, 0.1),
            )
            for _ in range(count)
        ]
    )


def assert_agrees(images, rays, poses, model, *, least=0.9999):
    """Objects, depths and colours equal the rays' on nearly all pixels."""
    same, pixels, depth_error, rgb_error = 0, 0, [], []
    for pose, depth_m, object_index, rgb in zip(poses, *images, strict=True):
        truth = rays.look(pose, model)
        equal = object_index == truth.object_index
        same += equal.sum()
        pixels += equal.size
        hit = equal & (object_index >= 0)
        assert np.isinf(depth_m[object_index < 0]).all()
        depth_error.append(np.abs(depth_m[hit] / truth.depth_m[hit] - 1.0))
        rgb_error.append(np.abs(rgb[equal] - truth.rgb[equal]).max(axis=-1))
    assert same >= least * pixels, f"{pixels - same} of {pixels} pixels differ"
    # worst seen 8e-5: float32 planes of 15 m triangles cut at 0.1 m
    assert np.concatenate(depth_error).max() < 5e-4
    # worst seen 1.5e-3: a neighbour's colour across an edge
    assert np.quantile(np.concatenate(rgb_error), 0.9999) < 2e-3
    return pixels - same


def test_views_on_ego_agree_with_rays(device, rng, street_rays):
    scene, poses = packed_street(device).raster, poses_on_ego(rng, 16)
    images = images_of(Renderer([MODEL] * 16, device=device), scene, poses)
    assert assert_agrees(images, street_rays, poses, MODEL) <= 3  # worst seen 0 of 262144


def test_any_view_agrees_with_rays_though_triangles_cross_the_near_plane(device, rng, street_rays):
    scene, poses = packed_street(device).raster, random_poses(rng, 64, near_ground=True)
    # the oracle needs something to bite on: triangles that reach behind the camera and still show in the image
    near_cut = 0
    corner_m = street_rays.vertex_m[street_rays.triangle]
    for pose in poses:
        depth = (corner_m - pose[:3, 3]) @ pose[:3, 2]
        near_cut += np.count_nonzero((depth.min(axis=1) < MODEL.near_m) & (depth.max(axis=1) > MODEL.near_m))
    assert near_cut > 1000
    images = images_of(Renderer([MODEL] * 64, device=device), scene, poses)
    assert assert_agrees(images, street_rays, poses, MODEL) <= 20  # worst seen 1 of 1048576


def test_one_renderer_holds_views_of_different_lenses(device, rng, street_rays):
    models = [CameraModel(64, 64, math.radians(f), n) for f, n in ((40, 0.1), (90, 2.0), (120, 0.5))]
    poses = poses_on_ego(rng, 3)
    images = images_of(Renderer(models, device=device), packed_street(device).raster, poses)
    for k, model in enumerate(models):
        assert_agrees([image[k : k + 1] for image in images], street_rays, poses[k : k + 1], model)


def test_grazing_surfaces_do_not_break_depth(device):
    # looking along a plane from a hair above and below it: slivers whose plane equation is ill conditioned
    rng = np.random.default_rng(5)
    line = np.linspace(-30.0, 30.0, 40)
    x, y = np.meshgrid(line, line, indexing="ij")
    i = (np.arange(39)[:, None] * 40 + np.arange(39)).ravel()
    faces = np.r_[np.c_[i, i + 40, i + 41], np.c_[i, i + 41, i + 1]]
    bumpy = trimesh.Trimesh(np.c_[x.ravel(), y.ravel(), rng.normal(0, 1e-4, x.size)], faces, process=False)
    scene = Scene("graze", coloured(bumpy, rng), FAR_AWAY, ())
    poses = [camera_pose([0, 0, z], yaw) for z in (1e-3, 1e-2, -1e-3, 0.3) for yaw in (0.0, 1.0, 2.5)]
    depth_m, object_index, _ = images_of(
        Renderer([MODEL] * len(poses), device=device), DeviceScene.pack(scene, device=device).raster, poses
    )
    rays = RayCaster([scene.environment])
    wrong = 0
    for k, pose in enumerate(poses):
        truth = rays.look(pose, MODEL)
        both = (object_index[k] == 0) & (truth.object_index == 0)
        wrong += np.count_nonzero((object_index[k] == 0) != (truth.object_index == 0))
        wrong += np.count_nonzero(np.abs(depth_m[k][both] / truth.depth_m[both] - 1.0) > 1e-2)
    assert wrong <= 1e-4 * object_index.size


def test_colours_are_averaged_over_samples(device, rng):
    poses = poses_on_ego(rng, 3)
    scene = packed_street(device).raster
    twice = Renderer([MODEL] * 3, supersampling=2, device=device)
    _, _, averaged = images_of(twice, scene, poses)
    fine = CameraModel(256, 256, MODEL.fov_rad, MODEL.near_m)
    _, _, samples = images_of(Renderer([fine] * 3, device=device), scene, poses)
    mean = samples.reshape(3, 128, 2, 128, 2, 3).mean(axis=(2, 4))
    # one colour step of 255 only where a sample falls on an edge; worst seen 2e-7
    assert np.quantile(np.abs(averaged - mean), 0.9999) < 1e-4


def test_sky_is_graded_by_elevation(device):
    pose = camera_pose([0.0, 0.0, 50.0], 0.3, -math.pi / 4)
    empty = Scene("empty", FAR_AWAY, FAR_AWAY, (), street().sky)
    _, object_index, rgb = images_of(
        Renderer([MODEL], device=device), DeviceScene.pack(empty, device=device).raster, [pose]
    )
    assert (object_index == -1).all()
    truth = RayCaster([FAR_AWAY], sky=street().sky).look(pose, MODEL)
    np.testing.assert_allclose(rgb[0], truth.rgb, atol=1e-5)
    # the top of the image looks at the zenith, the bottom at the horizon
    np.testing.assert_allclose(rgb[0, 0, 64] * 255.0, street().sky.zenith_rgb, atol=2.0)
    np.testing.assert_allclose(rgb[0, -1, 64] * 255.0, street().sky.horizon_rgb, atol=2.0)


def test_render_images_takes_cameras_of_any_size(device, street_rays):
    models = [MODEL, CameraModel(64, 48, 1.0, 0.1), MODEL, CameraModel(64, 48, 2.0, 0.1)]
    cameras = [
        RigCamera(f"camera_{k}", np.array([0.5 * k, 0.0, 1.8]), 1.5 * k, 0.05 * k, 0.02 * k, model)
        for k, model in enumerate(models)
    ]
    pictures = render_images(street(), cameras, device=device)
    for camera, picture in zip(cameras, pictures, strict=True):
        truth = street_rays.look(camera.ego_from_camera, camera.model)
        assert picture.rgb.shape == (camera.model.height_px, camera.model.width_px, 3)
        assert np.mean(picture.object_index == truth.object_index) > 0.9999
        assert np.quantile(np.abs(picture.rgb / 255.0 - truth.rgb), 0.999) < 0.5 / 255.0 + 1e-3
        seen = [np.count_nonzero(picture.object_index == 2 + k) for k in range(len(street().vehicles))]
        np.testing.assert_array_equal(picture.visible_area_px, seen)
        assert (picture.amodal_area_px >= picture.visible_area_px).all()


@pytest.mark.parametrize(
    ("models", "supersampling", "message"),
    [([], 1, "at least one view"), ([MODEL, CameraModel(64, 64)], 1, "same size"), ([MODEL], 0, "at least 1, got 0")],
)
def test_renderer_refuses(models, supersampling, message):
    with pytest.raises(ValueError, match=message):
        Renderer(models, supersampling=supersampling)
