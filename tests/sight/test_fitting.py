"""What a rig sees around its vehicle alone: against closed forms of pinholes, and rays that trimesh casts."""

import math

import numpy as np
import pytest
import trimesh

from tests.view.stand_ins import block, ego, rig
from warpav.raster.camera import CameraModel
from warpav.rig import Rig, RigCamera
from warpav.sight import Body, NearField, SectorCounts, VisibleGround, px_per_degree, size_ranges_m
from warpav.sight._around import upright_px

HIGH = block((-0.5, -0.5, 0.1), (0.5, 0.5, 0.2), (90, 95, 100))  # a body that hides next to nothing


def camera(model, yaw_deg=0.0, pitch_deg=0.0, place_m=(0.0, 0.0, 1.5), name="cam"):
    return RigCamera(name, np.array(place_m), math.radians(yaw_deg), math.radians(pitch_deg), 0.0, model)


def pinhole(width_px=400, height_px=300, fov_deg=80.0):
    model = CameraModel(width_px, height_px, math.radians(fov_deg))
    return model, float(model.intrinsics[0, 0])


def test_a_level_pinhole_sees_something_upright_as_high_as_its_depth_says():
    model, focal_px = pinhole()
    one = camera(model)
    foot_m = np.array([[10.0, 0.0], [10.0, 6.0], [40.0, -20.0]])
    assert upright_px(one, foot_m, 1.5) == pytest.approx(focal_px * 1.5 / foot_m[:, 0])
    assert upright_px(one, np.array([[-5.0, 0.0], [1.0, 20.0]]), 1.5) == pytest.approx([0.0, 0.0])


@pytest.mark.parametrize("yaw_deg", [0.0, 130.0])
def test_the_range_of_a_size_is_where_the_depth_is(yaw_deg):
    model, focal_px = pinhole()
    off_deg = np.array([0.0, 20.0, -35.0, 41.0])  # the last one is beyond the image
    ranges_m = size_ranges_m(camera(model, yaw_deg), np.radians(yaw_deg + off_deg), pixels=(40.0, 12.0))
    expected_m = focal_px * 1.5 / np.array([[40.0], [12.0]]) / np.cos(np.radians(off_deg[:3]))
    assert ranges_m[:, :3, 1] == pytest.approx(expected_m, rel=1e-6)  # worst seen 4e-8: 20 bisections of 4 %
    assert np.isnan(ranges_m[:, 3]).all()
    # the middle, 0.75 m below the camera, enters the image at half its height
    near_m = 0.75 / math.tan(math.atan(150.0 / focal_px))
    assert ranges_m[1, 0, 0] == pytest.approx(near_m, rel=1e-5)


def test_pixels_per_degree_of_a_pinhole():
    model, focal_px = pinhole()
    angle_rad = np.radians([0.0, 15.0, -30.0, 45.0])
    direction = np.stack([np.cos(angle_rad), np.sin(angle_rad), 0.0 * angle_rad], axis=-1)
    # f / cos² across, f / cos upright; the last one is outside the image
    expected = math.radians(focal_px) / np.cos(angle_rad) ** 1.5 * [1, 1, 1, 0]
    assert px_per_degree(camera(model), direction) == pytest.approx(expected, rel=1e-6)  # worst seen 6e-9
    turned = camera(model, 90.0, 20.0)
    assert px_per_degree(turned, turned.ego_from_camera[None, :3, 2]) == pytest.approx([math.radians(focal_px)])


def test_the_first_ground_of_a_camera_is_below_the_edge_of_its_image():
    model, focal_px = pinhole()
    above = Rig([camera(model, place_m=(0.5, 0.0, 1.5))])
    field = NearField.of(above, HIGH, reach_m=10.0, direction_count=40)
    ahead = field.toward(0.0)
    down = math.tan(math.atan(150.0 / focal_px))
    expected_m = np.array([1.5, 0.9, 0.4]) / down
    assert field.distance_m[:, ahead] == pytest.approx(expected_m, abs=1e-4)  # worst seen 3e-6
    assert np.isinf(field.distance_m[:, field.toward(180.0)]).all()
    assert field.border_m[ahead] == pytest.approx([0.5, 0.0])
    assert math.isinf(field.distance_m[0, field.worst()])


def test_the_bonnet_hides_the_ground_up_to_its_shadow():
    """A camera in the middle of the roof looks over the edge of a block 1.4 m high: similar triangles."""
    model = CameraModel(400, 400, math.radians(150.0))
    place_m = (1.35, 0.0, 1.9)
    field = NearField.of(Rig([camera(model, pitch_deg=30.0, place_m=place_m)]), ego(), direction_count=8)
    edge_m, top_m = 3.6 - place_m[0], 1.5
    shadow_m = edge_m * np.array([1.9 - 0.0, 1.9 - 0.6, 1.9 - 1.1]) / (1.9 - top_m) - edge_m
    assert field.distance_m[:, 0] == pytest.approx(shadow_m, abs=1e-3)  # worst seen 2e-5


def test_near_ground_agrees_with_rays_of_another_library():
    one, body = rig(3, 100.0), ego()
    found = VisibleGround.of(one, body, margin_m=3.0, cell_m=0.25)
    mesh = trimesh.Trimesh(body.vertex_m, body.triangle, process=False)
    row, column = np.nonzero(~found.is_body)
    point_m = np.stack([found.x_m[row], found.y_m[column], 0.0 * row], axis=-1)
    seen = np.zeros(len(point_m), int)
    for each in one.cameras:
        pose = each.ego_from_camera
        with np.errstate(invalid="ignore"):
            px = each.model.project((point_m - pose[:3, 3]) @ pose[:3, :3])
            is_in = ((px >= 0) & (px < [each.model.width_px, each.model.height_px])).all(axis=1)
        way = point_m - pose[:3, 3]
        seen += is_in & ~mesh.ray.intersects_any(np.tile(pose[:3, 3], (len(way), 1)), way)
    differs = seen != found.seen[row, column]
    assert differs.mean() < 0.002  # rays along edges; seen 0
    assert found.is_shadow.any()
    assert found.is_outside.any()
    assert not (found.is_shadow & found.is_outside).any()
    assert found.area_m2(~found.is_body) == pytest.approx(len(point_m) * 0.0625)


def test_the_outline_of_a_body_is_its_convex_hull():
    footprint = Body.of(ego())
    assert footprint.centre_m == pytest.approx([1.35, 0.0])
    border_m = footprint.border_m(np.radians([0.0, 90.0, 180.0, 45.0]))
    assert border_m == pytest.approx(np.array([[3.6, 0.0], [1.35, 0.9], [-0.9, 0.0], [2.25, 0.9]]))
    assert footprint.contains(np.array([[0.0, 0.0], [3.7, 0.0]])).tolist() == [True, False]


@pytest.mark.parametrize("distance_m", [0.0, 0.5, 10.0])
def test_a_ring_is_everywhere_as_far_from_the_outline_and_as_long_as_steiner_says(distance_m):
    body = block((-1.0, -0.8, 0.1), (3.0, 0.8, 1.5), (90, 95, 100))
    line_m = Body.of(body).ring_m(distance_m, direction_count=7200)
    nearest_m = np.clip(line_m, [-1.0, -0.8], [3.0, 0.8])
    np.testing.assert_allclose(np.linalg.norm(line_m - nearest_m, axis=1), distance_m, atol=1e-6)
    around_m = np.linalg.norm(np.diff(line_m, axis=0, append=line_m[:1]), axis=1).sum()
    assert around_m == pytest.approx(2.0 * (4.0 + 1.6) + 2.0 * math.pi * distance_m, rel=1e-5)


def test_sectors_count_cameras_and_the_costliest_loss_is_named():
    model, _ = pinhole(fov_deg=90.0)
    ahead = [camera(model, name="left"), camera(model, name="right", place_m=(0.0, -0.3, 1.5))]
    one = Rig([*ahead, camera(model, 180.0, name="rear")])
    counts = SectorCounts.of(one, HIGH, edges_m=(3.0, 6.0, 9.0), sector_count=4)
    assert counts.count.tolist() == [[2, 2], [0, 0], [1, 1], [0, 0]]
    assert counts.camera[counts.costliest] == "rear"
    assert counts.without(2)[2].tolist() == [0, 0]
    assert counts.blind_share(counts.without(2)) > counts.blind_share(counts.count)
    assert counts.within(1).edges_m == (3.0, 6.0)
