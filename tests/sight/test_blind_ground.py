"""Blind ground over several scenes: the counts of every scene, and their sums by sector and distance."""

import math

import numpy as np
import pytest

from tests.driving_scene import SKY, block, ego_mesh, ground
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.raster.mesh import merge
from warpav.rig import Rig, RigCamera
from warpav.scene import DeviceScene, Scene
from warpav.sight import BlindGround, Ground
from warpav.sight._ground import DISTANCE_EDGES_M, SECTORS


def scene_with(rng, *blocks):
    environment = merge([ground(rng), *blocks])
    return DeviceScene.pack(Scene("plane", environment, ego_mesh(rng), (), SKY))


def rig_of(fov_rad, yaw_rad=0.0, height_m=2.5):
    lens = Lens.PANORAMA if fov_rad > 3.0 else Lens.PINHOLE
    model = CameraModel(400, 400, fov_rad, lens=lens)
    return Rig([RigCamera("eye", np.array([1.35, 0.0, height_m]), yaw_rad, 0.0, 0.0, model)])


@pytest.fixture
def scenes(rng):
    return [scene_with(rng), scene_with(rng, block(rng, [0.4, 8.0, 1.6], [8.0, 0.0, 0.8]))]


def test_counts_are_those_of_the_single_scenes(scenes):
    rigs = {"ahead": rig_of(math.radians(90.0)), "behind": rig_of(math.radians(90.0), math.pi)}
    found = BlindGround.of(rigs, scenes)
    assert found.scene_count == 2
    covered = {name: [Ground.around(scene).coverage(rig.cameras) for scene in scenes] for name, rig in rigs.items()}
    for name, both in covered.items():
        np.testing.assert_array_equal(found.blind_count[name], sum((each.count == 0).astype(int) for each in both))
        np.testing.assert_array_equal(found.open_count, sum(each.is_open.astype(int) for each in both))
    table = found.table()
    assert np.sum(table["cells"], axis=(1, 2)).tolist() == found.open_count.sum(axis=(1, 2)).tolist()
    for name in rigs:
        blind = np.array(table["blind"][name])
        assert blind.shape == (2, len(SECTORS), len(DISTANCE_EDGES_M) - 1)
        assert blind.sum(axis=(1, 2)).tolist() == found.blind_count[name].sum(axis=(1, 2)).tolist()
        assert (blind <= np.array(table["cells"])).all()


def test_sectors_and_bands_lie_where_they_are_called(scenes):
    table = BlindGround.of({"ahead": rig_of(math.radians(90.0))}, scenes[:1]).table()
    share = dict(zip(SECTORS, np.array(table["blind"]["ahead"])[1] / np.array(table["cells"])[1], strict=True))
    far = slice(2, None)
    assert (share["front"][far] == 0.0).all()
    assert (share["rear"] == 1.0).all()
    assert (share["rear left"] == 1.0).all()
    # a wedge of 90 degrees ends in the middle of its neighbours
    for side in ("front left", "front right"):
        np.testing.assert_allclose(share[side][far], 0.5, atol=0.12)
