"""Who is seen where on the ground, against closed forms and embree."""

import math

import numpy as np
import pytest
import trimesh

from tests.driving_scene import SKY, block, ego_mesh, ground, street
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.raster.mesh import Mesh, merge
from warpav.rig import RigCamera
from warpav.scene import DeviceScene, Scene
from warpav.sight import Ground, free_shares

WIDE = CameraModel(360, 180, 2.0 * math.pi, lens=Lens.PANORAMA)
EYE_M = np.array([1.35, 0.0, 2.5])
WALL_X_M, WALL_TOP_M = 8.0, 1.2


def packed(rng, device, *blocks, height_m=0.0, tilt=0.0):
    """The ego vehicle on a plane that rises by ``tilt`` along x, with blocks around it."""
    plane = ground(rng)
    vertex_m = plane.vertex_m + np.c_[0.0 * plane.vertex_m[:, :2], height_m + tilt * plane.vertex_m[:, 0]]
    environment = merge([Mesh(vertex_m.astype(np.float32), plane.triangle, plane.vertex_rgb), *blocks])
    return DeviceScene.pack(Scene("plane", environment, ego_mesh(rng), (), SKY), device=device)


def around_eye(model=WIDE, yaw_rad=0.0):
    return RigCamera("eye", EYE_M, yaw_rad, 0.0, 0.0, model)


def places(cells):
    x_m, y_m = np.meshgrid(cells.x_m, cells.y_m, indexing="ij")
    return np.stack([x_m, y_m], axis=-1)


def test_a_wall_casts_the_shadow_of_similar_triangles(device, rng):
    # a wall across everything, as thin as paper, and a camera that sees all round
    scene = packed(rng, device, block(rng, [0.01, 200.0, WALL_TOP_M], [WALL_X_M, 0.0, 0.5 * WALL_TOP_M]))
    ahead = np.linspace(WALL_X_M + 0.2, 24.0, 60)
    for height_m in (0.4, 1.1, 1.6):
        share = free_shares(scene, EYE_M, np.c_[ahead, 0.0 * ahead, np.full(60, height_m)])
        at_wall_m = EYE_M[2] + (height_m - EYE_M[2]) * (WALL_X_M - EYE_M[0]) / (ahead - EYE_M[0])
        hidden = at_wall_m < WALL_TOP_M
        assert hidden.any() == (height_m < WALL_TOP_M)
        np.testing.assert_array_equal(share < 1.0, hidden)
        np.testing.assert_allclose(
            share[hidden], ((WALL_X_M - 0.005 - EYE_M[0]) / (ahead - EYE_M[0]))[hidden], atol=1e-5
        )


def test_a_free_plane_is_seen_all_round_but_for_the_vehicle_itself(device, rng):
    cells = Ground.around(packed(rng, device), cell_m=0.4)
    found = cells.coverage([around_eye()])
    ego_low, ego_high = ego_mesh(rng).bounds_m()
    place = places(cells)
    is_circle = np.linalg.norm(place - 0.5 * (ego_low + ego_high)[:2], axis=-1) <= cells.radius_m
    under_ego = ((place >= ego_low[:2]) & (place <= ego_high[:2])).all(axis=-1)
    np.testing.assert_array_equal(found.is_open[0], is_circle & ~under_ego)
    np.testing.assert_allclose(cells.ground_m[is_circle], 0.0, atol=1e-5)
    # who stands beside the vehicle may be hidden by it, nobody else is
    far = np.linalg.norm(place - EYE_M[:2], axis=-1) > 6.0
    assert (found.count[1][far & found.is_open[1]] == 1).all()
    assert found.covered_share[1] > 0.97
    assert found.covered_share[0] <= found.covered_share[1]
    np.testing.assert_allclose(found.blind_area_m2, (found.count == 0).sum(axis=(1, 2)) * 0.16)


def test_slopes_and_steps_are_ground_and_roofs_are_not(device, rng):
    kerb = block(rng, [1.0, 1.0, 0.6], [8.2, 0.2, 0.05 * 8.2 - 0.1])  # 20 cm high in its middle
    bench = block(rng, [1.0, 1.0, 0.5], [8.2, 5.0, 0.25 + 0.05 * 8.2])
    house = block(rng, [6.0, 6.0, 5.0], [-10.0, 0.0, 2.5])
    shelter = block(rng, [4.0, 4.0, 0.2], [0.0, 10.0, 1.5])  # a roof without walls, 1.4 m above the ground
    cells = Ground.around(packed(rng, device, kerb, bench, house, shelter, tilt=0.05), cell_m=0.4)
    x_m, y_m = np.moveaxis(places(cells), -1, 0)
    inside_house = (np.abs(x_m + 10.0) < 2.9) & (np.abs(y_m) < 2.9)
    assert (cells.headroom_m[inside_house] == 0.0).all()
    below_shelter = (np.abs(x_m) < 1.9) & (np.abs(y_m - 10.0) < 1.9)
    np.testing.assert_allclose(cells.headroom_m[below_shelter], 1.4 - 0.05 * x_m[below_shelter], atol=1e-4)
    assert cells.is_open(1.1)[below_shelter].all()
    assert not cells.is_open(1.7)[below_shelter].any()
    beside = np.abs(x_m - 8.2) < 0.4
    on_kerb, in_bench = (beside & (np.abs(y_m - side) < 0.4) for side in (0.2, 5.0))
    np.testing.assert_allclose(cells.ground_m[on_kerb], 0.2 + 0.05 * 8.2, atol=1e-4)
    assert cells.is_open(1.7)[on_kerb].all()
    assert in_bench.any()
    assert not cells.is_open(1.1)[in_bench].any()
    plain = np.isfinite(cells.ground_m) & ((np.abs(x_m - 8.2) > 0.6) | (np.abs(y_m - 0.2) > 0.6))
    np.testing.assert_allclose(cells.ground_m[plain], 0.05 * x_m[plain], atol=1e-4)


@pytest.mark.parametrize("height_m", [1.2, 6.0])
def test_yards_that_nobody_gets_to_do_not_count(device, rng, height_m):
    rows = [block(rng, [120.0, 3.0, 2.0 * height_m], [0.0, side * 9.0, 0.0]) for side in (-1, 1)]
    cells = Ground.around(packed(rng, device, *rows), cell_m=0.4)
    y_m = places(cells)[..., 1]
    assert not cells.is_open(1.1)[np.abs(y_m) > 7.5].any()
    assert cells.is_open(1.1)[(np.abs(y_m) < 7.0) & (np.abs(y_m) > 1.5)].any()


def test_sight_in_a_street_is_embrees(device, rng):
    scene = street(10)
    cells = Ground.around(DeviceScene.pack(scene, device=device), cell_m=1.0)
    cameras = [
        RigCamera("front", [2.2, 0.0, 1.9], 0.1, 0.1, 0.0, CameraModel(256, 256)),
        RigCamera("rear", [0.2, 0.3, 1.9], 3.0, 0.0, 0.1, CameraModel(256, 128, 2.6, lens=Lens.FISHEYE)),
    ]
    found = cells.coverage(cameras)
    meshes = [scene.surroundings(), scene.ego, *(each.mesh for each in scene.vehicles)]
    whole = merge(meshes)
    embree = trimesh.Trimesh(whole.vertex_m, whole.triangle, process=False).ray
    height, row, column = np.nonzero(found.is_open)
    point_m = np.stack(
        [
            cells.x_m[row],
            cells.y_m[column],
            cells.ground_m[row, column] + np.array(found.heights_m)[height],
        ],
        axis=-1,
    )
    for camera, is_seen in zip(cameras, found.is_seen, strict=True):
        transform = camera.ego_from_camera
        way = point_m - transform[:3, 3]
        place_px = camera.model.project(way @ transform[:3, :3])
        size = [camera.model.width_px, camera.model.height_px]
        with np.errstate(invalid="ignore"):
            in_image = ((place_px >= 0.0) & (place_px < size)).all(axis=1)
        start = np.tile(transform[:3, 3], (len(way), 1))
        hit_m, ray, _ = embree.intersects_location(start, way, multiple_hits=False)
        nearest = np.full(len(way), np.inf)
        nearest[ray] = np.linalg.norm(hit_m - transform[:3, 3], axis=1)
        expected = in_image & (nearest > np.linalg.norm(way, axis=1))
        # rays that graze an edge may differ; 0 of some 1500 did
        assert (expected != is_seen[height, row, column]).sum() <= 2
        assert 100 < expected.sum() < len(way) - 100


def test_sizes_are_checked(device, rng):
    scene = packed(rng, device)
    with pytest.raises(ValueError, match="cell_m must be positive"):
        Ground.around(scene, cell_m=0.0)
    with pytest.raises(ValueError, match="heights_m must be positive"):
        Ground.around(scene).coverage([around_eye()], heights_m=())
