"""What cameras see of ghosts: closed forms, rays of another library, finite differences, and independence."""

import math

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from tests.sight.test_area import box
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.rig import RigCamera
from warpav.scene import town_scene
from warpav.sight import Ghosts, GhostWorld, Requirement, read_requirements
from warpav.sight._requirement import SIZES_M, Polygon, TestObject
from warpav.sight._visibility import whole_solid_angle_sr

MODEL = CameraModel(640, 480, math.radians(90.0))
FISHEYE = CameraModel(640, 480, math.radians(180.0), lens=Lens.FISHEYE, distortion=(0.0, 0.0, 0.0, 0.0))
FAR_AWAY = box((1.0, 1.0, 1.0), (-1e3, 0.0, 0.5))


@pytest.fixture(scope="module")
def car():
    return town_scene(0).ego


def pose(position_m, yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0):
    return RigCamera(
        "c", np.array(position_m), *map(math.radians, (yaw_deg, pitch_deg, roll_deg)), MODEL
    ).ego_from_camera


def ghosts_at(test_object, *position_m):
    dummy = Requirement("dummy", Polygon(((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))), 1.0, test_object)
    return Ghosts((dummy,), np.array(position_m, np.float64), np.zeros(len(position_m), int))


def subset(ghosts, which):
    return Ghosts(ghosts.requirements, ghosts.position_m[which], ghosts.requirement[which])


def test_a_slab_in_front_of_a_pinhole_has_the_area_of_its_face(device):
    # at the height of its middle the camera sees its front alone, which is 4 m away
    slab = ghosts_at(TestObject("lying", (0.2, 1.5, 0.8)), (4.1, 0.0))
    seen = GhostWorld(slab, FAR_AWAY, device=device).visibility(pose([0.0, 0.0, 0.4])[None], [MODEL])
    focal_px = 320.0
    assert seen.pixels[0, 0] == pytest.approx(focal_px**2 * 1.5 * 0.8 / 16.0, rel=1e-3)
    assert seen.visible_share[0, 0] == 1.0


@pytest.mark.parametrize("setback_m", [0.3, 0.8])
def test_the_shadow_of_a_box_is_as_long_as_similar_triangles_say(device, setback_m):
    # the camera stands 0.5 m above the roof of a box 1.5 m high, behind whose rear edge the ground is hidden
    ego = box((4.0, 2.0, 1.5), (1.0, 0.0, 0.75))
    length_m = 1.5 * setback_m / 0.5
    x = -1.0 - length_m + np.array([-0.05, 0.05])
    plates = ghosts_at(TestObject("lying", (0.02, 0.02, 0.002)), *((each, 0.0) for each in x))
    camera = pose([-1.0 + setback_m, 0.0, 2.0], yaw_deg=180.0, pitch_deg=35.0)
    seen = GhostWorld(plates, ego, supersampling=4, device=device).visibility(
        camera[None], [CameraModel(640, 480, math.radians(60.0))]
    )
    np.testing.assert_array_equal(seen.visible_share[0], [1.0, 0.0])


@given(
    st.floats(0.05, 3.0), st.floats(0.05, 3.0), st.floats(0.05, 3.0),
    st.floats(3.0, 20.0), st.floats(-math.pi, math.pi), st.floats(-1.0, 4.0),
)  # fmt: skip
def test_whole_solid_angles_are_those_of_faces(length, width, height, distance, turn, z):
    """Of a box: the faces that are seen, each by the closed form of a rectangle's four corners."""
    ghosts = ghosts_at(TestObject("lying", (length, width, height)), (0.0, 0.0))
    centre = np.array([distance * math.cos(turn), distance * math.sin(turn), z])
    low, high = np.array([-length / 2, -width / 2, 0.0]), np.array([length / 2, width / 2, height])
    expected = 0.0
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        away = max(centre[axis] - high[axis], low[axis] - centre[axis])
        if away > 0.0:
            for a, b, sign in ((high, high, 1), (low, high, -1), (high, low, -1), (low, low, 1)):
                p, q = a[u] - centre[u], b[v] - centre[v]
                expected += sign * math.atan(p * q / (away * math.sqrt(p * p + q * q + away * away)))
    found = whole_solid_angle_sr(centre[None], ghosts, np.array([0]))[0]
    assert found == pytest.approx(expected, rel=2e-4, abs=1e-9)  # corners are float32


RANDOM_RIG = [
    (pose([2.2, 0.5, 1.6], 40.0, 20.0), MODEL),
    (pose([-0.6, -0.6, 1.5], -140.0, 25.0, 5.0), MODEL),
    (pose([-0.95, 0.0, 1.0], 180.0, 30.0), FISHEYE),
    (pose([2.1, 1.05, 1.0], 150.0, 20.0), FISHEYE),
]


@pytest.mark.parametrize("k", range(len(RANDOM_RIG)))
def test_visible_shares_are_embrees(device, rng, car, k):
    camera, model = RANDOM_RIG[k]
    ghosts = Ghosts.of(read_requirements("near_field"), car)
    ghosts = subset(ghosts, rng.choice(len(ghosts), 200, replace=False))
    seen = GhostWorld(ghosts, car, render_width_px=640, supersampling=2, device=device).visibility(
        camera[None], [model]
    )
    centre = camera[:3, 3]
    body = trimesh.Trimesh(car.vertex_m, car.triangle, process=False).ray
    expected = np.zeros(len(ghosts))
    for g in range(len(ghosts)):
        mesh = ghosts.mesh(g)
        middle = mesh.vertex_m.mean(axis=0) - centre
        cosine = np.min((mesh.vertex_m - centre) @ middle / np.linalg.norm(mesh.vertex_m - centre, axis=1))
        cosine /= np.linalg.norm(middle)
        # equally spread over the cone around it
        z = rng.uniform(cosine, 1.0, 3000)
        turn = rng.uniform(0.0, 2.0 * math.pi, len(z))
        axis = middle / np.linalg.norm(middle)
        side = np.cross(axis, [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side)
        radius = np.sqrt(1.0 - z**2)
        way = z[:, None] * axis + (radius * np.cos(turn))[:, None] * side
        way += (radius * np.sin(turn))[:, None] * np.cross(axis, side)
        place, ray, _ = trimesh.Trimesh(mesh.vertex_m, mesh.triangle, process=False).ray.intersects_location(
            np.broadcast_to(centre, way.shape), way, multiple_hits=False
        )
        if not len(ray):
            continue
        distance = np.linalg.norm(place - centre, axis=1)
        in_camera = (place - centre) @ camera[:3, :3]
        with np.errstate(invalid="ignore", divide="ignore"):
            px = model.project(in_camera)
            shown = ((px >= 0.0) & (px <= [model.width_px, model.height_px])).all(axis=1)
        start = centre + model.near_m * way[ray]
        hit, of, _ = body.intersects_location(start, way[ray], multiple_hits=False)
        blocked = np.full(len(ray), np.inf)
        blocked[of] = np.linalg.norm(hit - centre, axis=1)
        expected[g] = (shown & (blocked > distance)).sum() / len(ray)
    difference = np.abs(seen.visible_share[0] - expected)
    assert 30 < (expected > 0.5).sum() < 190
    assert ((expected > 0.02) & (expected < 0.98)).sum() >= 5
    assert difference.max() < 0.06  # of 600 to 2500 random rays each
    assert difference.mean() < 0.01


def test_jacobians_are_finite_differences():
    # partly hidden by the bonnet, twice cut by the image, and one as a whole
    car = box((4.0, 2.0, 1.2), (1.0, 0.0, 0.6))
    ghosts = ghosts_at(TestObject("post", SIZES_M["post"]), (4.4, 0.6), (5.0, -2.8), (6.0, 4.6), (9.0, 1.0))
    model = CameraModel(640, 480, math.radians(80.0))
    camera, options = pose([1.2, 0.1, 1.62], 3.0, 8.0, 1.0), {"supersampling": 3}
    found = GhostWorld(ghosts, car, **options).jacobians(camera[None], [model])
    still = GhostWorld(ghosts, car, **options).visibility(camera[None], [model])
    np.testing.assert_allclose(found.visible_share, still.visible_share, rtol=1e-5)
    np.testing.assert_allclose(found.pixels, still.pixels, rtol=1e-5)
    assert ((still.visible_share > 0.1) & (still.visible_share < 0.95)).sum() >= 2
    for k in range(7):
        step = 0.02 if k < 3 else 0.01
        ends = []
        for sign in (1.0, -1.0):
            moved, zoom = camera.copy(), 0.0
            if k < 3:
                moved[k, 3] += sign * step
            elif k < 6:
                turn = trimesh.transformations.rotation_matrix(sign * step, np.eye(3)[k - 3])[:3, :3]
                moved[:3, :3] = (turn @ camera[:3, :3].T).T
            else:
                zoom = sign * step
            ends.append(GhostWorld(ghosts, car, **options).visibility(moved[None], [model.zoomed(zoom)]))
        for name, least in (("visible_share", 0.12), ("pixels", 150.0)):
            difference = (getattr(ends[0], name) - getattr(ends[1], name))[0] / (2.0 * step)
            jacobian = getattr(found, f"jac_{name}")[0, :, k]
            np.testing.assert_allclose(jacobian, difference, rtol=0.08, atol=least, err_msg=f"{name} {k}")
    assert np.abs(found.jac_visible_share[0, -1]).max() == 0.0  # it is whole, and stays so


def test_more_ghosts_than_one_scene_holds_and_images_of_several_sizes(device, car):
    ghosts = Ghosts.of(read_requirements("r158_like"), car)
    assert len(ghosts) > 128
    wide, small = CameraModel(2000, 1000, math.radians(120.0)), CameraModel(100, 80, math.radians(100.0))
    poses = np.stack([pose([-0.95, 0.0, 1.0], 180.0, 30.0)] * 3)
    seen = GhostWorld(ghosts, car, device=device).visibility(poses, [wide, small, wide])
    np.testing.assert_array_equal(seen.pixels[0], seen.pixels[2])
    assert (seen.pixels[0] > 3.0 * seen.pixels[1]).mean() > 0.5
    assert seen.meets(ghosts)[0].sum() > 100
