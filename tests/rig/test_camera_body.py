"""Bodies of cameras against rays: what a box hides of an image, where boxes meet, and what is drawn."""

import math

import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.rig import Housing, Rig, RigCamera, bodies_of, boxes_meet, corners_m, hidden_share
from warpav.rig._camera_body import LENS_M, body_of, nearest_on

MODELS = {
    "pinhole": CameraModel(120, 80, math.radians(90.0)),
    "telephoto": CameraModel(160, 90, math.radians(30.0)),
    "fisheye": CameraModel(100, 100, math.radians(190.0), lens="fisheye"),
}


def looking(position_m, yaw_deg=0.0, pitch_deg=0.0, name="camera", **options):
    return RigCamera(name, np.array(position_m), math.radians(yaw_deg), math.radians(pitch_deg), **options)


def box_mesh(corner_m):
    from scipy.spatial import ConvexHull

    return Mesh.create(corner_m, ConvexHull(corner_m).simplices)


def hit(mesh, origin_m, direction):
    """Whether rays hit a mesh, bool [ray]."""
    caster = EmbreeScene()
    TriangleMesh(caster, mesh.vertex_m[mesh.triangle])
    origins = np.broadcast_to(np.asarray(origin_m, np.float32), direction.shape)
    return caster.run(np.ascontiguousarray(origins), direction.astype(np.float32), query="OCCLUDED") == 0


def share_by_rays(camera, mesh, density=4):
    """Share of an image that shows a mesh, by ``density`` squared rays a pixel."""
    model = camera.model
    row, column = np.indices((model.height_px * density, model.width_px * density))
    place_px = (np.stack([column, row], axis=-1).reshape(-1, 2) + 0.5) / density
    ray = model.rays(place_px)
    seen = np.isfinite(ray).all(axis=1)
    direction = ray[seen] @ camera.ego_from_camera[:3, :3].T
    is_hit = hit(mesh, camera.position_m, direction / np.linalg.norm(direction, axis=1, keepdims=True))
    return is_hit.sum() / len(ray)


@pytest.mark.parametrize("lens", MODELS)
@pytest.mark.parametrize(
    ("other", "size_m"),
    [
        (looking([0.6, 0.05, 0.02], 40.0), (0.08, 0.08, 0.08)),
        (looking([0.9, 0.3, -0.1], -80.0, 20.0), (0.2, 0.1, 0.15)),  # over the edge of some images
        (looking([-0.5, 0.2, 0.0]), (0.1, 0.1, 0.1)),  # behind
        (looking([0.3, 1.2, 0.1], 90.0), (0.1, 0.1, 0.1)),  # beside: fisheyes alone see it
    ],
)
def test_a_box_hides_what_rays_say(lens, other, size_m):
    camera = looking([0.0, 0.0, 0.0], 5.0, 3.0, model=MODELS[lens])
    corner_m = corners_m(other.ego_from_camera, Housing(size_m))
    found = hidden_share(camera.model, np.linalg.inv(camera.ego_from_camera), corner_m[None])
    expected = share_by_rays(camera, box_mesh(corner_m))
    assert found[0] == pytest.approx(expected, rel=0.03, abs=3e-4)


def test_boxes_meet_where_they_hold_points_of_each_other(rng):
    one, other = ([], [])
    for _ in range(150):
        for boxes in (one, other):
            camera = looking(rng.uniform(-0.12, 0.12, 3), *rng.uniform(-180, 180, 2))
            boxes.append(corners_m(camera.ego_from_camera, Housing(tuple(rng.uniform(0.05, 0.2, 3)))))
    found = boxes_meet(np.array(one), np.array(other))
    for k, meet in enumerate(found):
        origin_m, axes = one[k][0], np.stack([one[k][i] - one[k][0] for i in (4, 2, 1)])
        # a grid of points of the other box, in coordinates of this one, 0..1 inside
        step = np.linspace(0.0, 1.0, 25)
        grid = np.stack(np.meshgrid(step, step, step), axis=-1).reshape(-1, 3)
        point_m = other[k][0] + grid @ np.stack([other[k][i] - other[k][0] for i in (4, 2, 1)])
        share = (point_m - origin_m) @ axes.T / (axes**2).sum(axis=1)
        if ((share >= 0.0) & (share <= 1.0)).all(axis=1).any():
            assert meet
        elif meet:  # between points of the grid at most
            assert np.abs(np.clip(share, 0.0, 1.0) - share).max(axis=1).min() < 0.1
    assert 20 < found.sum() < 130


def test_bodies_stand_on_the_skin_and_nobody_sees_his_own():
    roof = Mesh.create([[-2, -1, 1.5], [2, -1, 1.5], [2, 1, 1.5], [-2, 1, 1.5]], [[0, 1, 2], [0, 2, 3]])
    ahead = looking([1.0, 0.0, 1.75], name="ahead")
    behind = looking([0.2, 0.0, 1.75], name="behind")
    there_m = nearest_on(roof, [ahead.position_m, [3, 0.5, 1.7], [3, 2, 1]])  # above a face, off a side and a corner
    np.testing.assert_allclose(there_m, [[1.0, 0.0, 1.5], [2.0, 0.5, 1.5], [2.0, 1.0, 1.5]])
    bodies = bodies_of(Rig([ahead, behind]), roof)
    assert bodies.bounds_m()[0, 2] == pytest.approx(1.5, abs=0.02)
    # the box ends at the optical centre, so that 4 of its 8 cm are there, and the camera behind sees its back
    own = body_of(ahead)
    np.testing.assert_allclose(own.bounds_m(), [[0.96, -0.04, 1.71], [1.0 - LENS_M, 0.04, 1.79]], atol=1e-6)
    forward = np.array([[1.0, 0.0, 0.0]])
    assert not hit(bodies, ahead.position_m, forward)[0]
    assert hit(bodies, behind.position_m, forward)[0]
    first_m, *others_m = np.moveaxis(own.vertex_m[own.triangle], 1, 0)
    volume_m3 = (first_m * np.cross(*others_m)).sum() / 6
    assert volume_m3 == pytest.approx(0.08 * 0.08 * 0.039, rel=1e-4)  # faces point outwards


def test_a_camera_far_from_the_body_has_no_stalk():
    camera = looking([0.0, 0.0, 3.0])
    assert len(body_of(camera, np.array([0.0, 0.0, 1.5])).vertex_m) == 8
    assert len(body_of(camera, np.array([0.0, 0.0, 2.5])).vertex_m) == 16


def test_what_is_straight_behind_a_wide_lens_is_not_in_its_image():
    """A fisheye has places for rays beyond its image: those of a box behind it lie all round."""
    model = CameraModel(640, 480, math.radians(190.0), lens="fisheye")
    camera, behind = looking([3.0, 0.0, 0.3], 0.0, 28.0), looking([1.2, 0.0, 1.3])
    box_m = corners_m(behind.ego_from_camera, Housing((0.04, 0.04, 0.05)))[None]
    assert hidden_share(model, np.linalg.inv(camera.ego_from_camera), box_m)[0] == 0.0
