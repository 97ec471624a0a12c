"""The share of the own body in the images: closed forms, rays of another library, and independence of traffic."""

import math

import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from tests.driving_scene import SKY, block, ego_mesh, ground, street
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.rig import Rig, RigCamera
from warpav.scene import DeviceScene, Scene
from warpav.sight import body_shares


def scene_around(ego, environment=None):
    rng = np.random.default_rng(0)
    return DeviceScene.pack(Scene("alone", environment or ground(rng), ego, (), SKY))


def camera(name, position_m, model, yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0):
    return RigCamera(name, np.array(position_m), *map(math.radians, (yaw_deg, pitch_deg, roll_deg)), model)


def test_rays_of_another_library_hit_as_much():
    rng = np.random.default_rng(3)
    ego = ego_mesh(rng)
    models = [
        CameraModel(96, 64, 1.6),
        CameraModel(64, 64, 3.2, lens=Lens.FISHEYE),
        CameraModel(80, 64, 1.9, lens=Lens.BROWN_CONRADY, distortion=(-0.1, 0.01, 0.001, -0.001)),
        CameraModel(128, 48, 2.0 * math.pi, lens=Lens.PANORAMA),
    ]
    places = [[1.1, 0.0, 1.9], [3.7, 0.3, 0.9], [0.0, 1.1, 1.2], [-1.0, 0.0, 1.4]]
    rig = Rig(
        camera(f"c{k}", place, model, yaw_deg=70.0 * k, pitch_deg=25.0, roll_deg=5.0 * k)
        for k, (place, model) in enumerate(zip(places, models, strict=True))
    )
    found = body_shares(rig, scene_around(ego))
    embree = EmbreeScene()
    TriangleMesh(embree, ego.vertex_m[ego.triangle].astype(np.float32))
    for eye in rig.cameras:
        column, row = np.meshgrid(np.arange(eye.model.width_px) + 0.5, np.arange(eye.model.height_px) + 0.5)
        ray = eye.model.rays(np.stack([column, row], axis=-1)).reshape(-1, 3)
        seen = np.isfinite(ray).all(axis=1)
        direction = ray[seen] @ eye.ego_from_camera[:3, :3].T
        start = np.broadcast_to(eye.position_m, direction.shape)
        hit = embree.run(np.ascontiguousarray(start, np.float32), np.ascontiguousarray(direction, np.float32)) >= 0
        assert 0.02 < hit.sum() / len(ray) < 0.9
        # a pixel whose centre lies on an outline may be either; worst seen none
        assert found[eye.name] == pytest.approx(hit.sum() / len(ray), abs=2.0 / len(ray))


def test_traffic_and_street_make_no_difference():
    full = street()
    alone = DeviceScene.pack(Scene("alone", ground(np.random.default_rng(0)), full.ego, (), SKY))
    high = CameraModel(64, 48, 1.5)
    rig = Rig([camera("a", [1.1, 0.0, 1.8], high, pitch_deg=30.0), camera("b", [0.0, 0.0, 1.8], CameraModel(40, 40))])
    shares = body_shares(rig, DeviceScene.pack(full))
    assert shares == body_shares(rig, alone)
    assert shares["a"] > 0.0
    # a wall between nothing and nobody: what stands before the body does not hide it
    walled = scene_around(full.ego, block(np.random.default_rng(1), [0.02, 3.0, 3.0], [1.4, 0.0, 1.6]))
    assert body_shares(rig, walled) == shares
