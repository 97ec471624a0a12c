"""Expected points of LiDARs against rays of embree, their Jacobian against differences of rays, and the curve."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
import warp as wp
from trimesh.ray.ray_pyembree import RayMeshIntersector

import warpav as wa
from tests.driving_scene import SilentDetector
from warpav import detection
from warpav.core.errors import InputError
from warpav.detection import LidarCurve, LidarProbability, away_from, fit_lidar_curve, read_findings
from warpav.optimisation import CameraMount, ObjectiveOptions
from warpav.optimisation._mount import MOUNT_POSE_SIZE
from warpav.optimisation._single_cameras import SingleCameras
from warpav.optimisation.evaluation._metrics import RigObserver
from warpav.raster.beams import PIXELS_PER_RAD, Beams, Radar
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.mesh import Mesh
from warpav.raster.renderer import Renderer
from warpav.raster.scene import Scene
from warpav.rig import MountSurface, Rig, RigCamera
from warpav.scene import DeviceScene

CAMERA_FROM_EGO = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]], np.float32)
PLACE_M = np.array([1.2, 0.0, 2.0])
EVEN = Beams(tuple(np.radians(np.linspace(-25, 15, 32))), math.radians(0.2))
UNEVEN_DEG = (-25, -19, -13, -9, -6.5, -4.7, -3.2, -1.9, -1, 0, 1.3, 3.7, 7.8, 15)
UNEVEN = Beams(tuple(map(math.radians, UNEVEN_DEG)), math.radians(0.2))
FLAT = Beams(tuple(np.radians(np.linspace(-12, 12, 64))), math.radians(0.2), (-math.pi / 3, math.pi / 3))


@functools.cache
def town():
    return next(iter(wa.town(range(11, 12)))).targeting(("vehicle", "pedestrian", "cyclist"))


@functools.cache
def packed():
    return DeviceScene.pack(town())


@functools.cache
def caster():
    meshes = [*(each.mesh for each in town().vehicles), town().environment, town().ego]
    owner = np.repeat(np.arange(len(meshes)), [len(each.triangle) for each in meshes])
    parts = [trimesh.Trimesh(each.vertex_m, each.triangle, process=False) for each in meshes]
    return RayMeshIntersector(trimesh.util.concatenate(parts)), owner


def counted(beams, place_m, phases, by_incidence=False, cone_rad=0.0):
    """Mean hits on every object, ray by ray, over phases of the azimuth and places within the cells of elevation."""
    rays, owner = caster()
    normal, rng = rays.mesh.face_normals, np.random.default_rng(0)
    ends, total = beams.ends_rad, np.zeros(len(town().vehicles))
    first, last = beams.azimuth_rad
    for k in range(phases):
        azimuth = first + (np.arange(round((last - first) / beams.step_rad)) + (k + 0.5) / phases) * beams.step_rad
        a, e = np.meshgrid(azimuth, ends[:-1] + (k * 0.6180339887 + 0.5) % 1 * np.diff(ends))
        a, e = (each + cone_rad * rng.uniform(-0.5, 0.5, each.shape) for each in (a, e))
        ray = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)
        hit = rays.intersects_first(np.repeat(place_m[None], len(ray), 0), ray)
        cosine = np.abs((normal[hit] * ray).sum(axis=1)) if by_incidence else np.ones(len(ray))
        total += np.bincount(owner[hit[hit >= 0]], cosine[hit >= 0], minlength=owner[-1] + 1)[: len(total)]
    return total / phases


def rendered(beams, raster, places_m, supersampling=1, content=Content.MEASURES):
    model = CameraModel.of_beams(beams, 0.3)
    places_m = np.atleast_2d(places_m)
    options = {"supersampling": supersampling, "occlusion": Occlusion.EXACT, "device": "cpu"}
    renderer = Renderer([model] * len(places_m), **options)
    turns = wp.array(np.repeat(CAMERA_FROM_EGO[None], len(places_m), 0), dtype=wp.mat33)
    return renderer.render(raster, wp.array(places_m, dtype=wp.vec3), turns, content=content)


@pytest.mark.parametrize(
    ("by_incidence", "cone_rad"),
    [(False, 0.0), (True, 0.0), (False, 0.003)],
    ids=["all alike", "by incidence", "divergent"],
)
@pytest.mark.parametrize("beams", [EVEN, UNEVEN, FLAT], ids=["even", "uneven", "flat"])
def test_expected_points_are_the_mean_of_rays(beams, by_incidence, cone_rad):
    lidar = LidarProbability(beams, LidarCurve(by_incidence=by_incidence))
    frame = rendered(beams, packed().raster, PLACE_M, 2, lidar.content)
    expected = lidar.points(frame).value.numpy()[0, :, 0]
    true = counted(beams, PLACE_M, 24, by_incidence, cone_rad)
    assert abs(expected.sum() - true.sum()) < 0.01 * true.sum()
    is_hit = true >= 5.0
    error = abs(expected - true)[is_hit] / true[is_hit]
    assert is_hit.sum() >= 5
    # a pixel at an outline has the incidence of one of the surfaces in it, and rays within cones are drawn by chance
    assert np.median(error) < (0.05 if by_incidence else 0.015)
    assert np.quantile(error, 0.9) < (0.1 if by_incidence or cone_rad else 0.03)


def test_the_jacobian_is_that_of_rays():
    found = LidarProbability(EVEN).points(rendered(EVEN, packed().raster, PLACE_M)).jacobian.numpy()[0, :, 0, :3]
    ends = [[counted(EVEN, PLACE_M + sign * step, 40) for sign in (1, -1)] for step in 0.08 * np.eye(3)]
    true = np.array([(ahead - behind) / 0.16 for ahead, behind in ends]).T
    assert (found * true).sum() / np.linalg.norm(found) / np.linalg.norm(true) > 0.99


def test_a_thin_pole_is_hit_as_often_as_its_angles_say():
    """In the mean over places, as samples of an image are coarser: its width over a step, its height over a spacing."""
    pole = trimesh.creation.box((0.05, 0.05, 1.6))
    pole.apply_translation([20.0, 0.0, 0.0])
    raster = Scene({"pole": Mesh.create(pole.vertices, pole.faces, (200, 0, 0))})
    pixel_m = 20.0 / PIXELS_PER_RAD
    aside, up = np.meshgrid(np.arange(32) / 32, np.arange(4) / 4)
    places_m = np.stack([np.zeros(128), aside.ravel() * pixel_m, up.ravel() * pixel_m], axis=1)
    found = LidarProbability(EVEN).points(rendered(EVEN, raster, places_m)).value.numpy().mean()
    near_m = 20.0 - 0.025
    across = 2.0 * math.atan(0.025 / near_m) / EVEN.step_rad
    spacing = np.diff(EVEN.elevation_rad)[0]
    assert found == pytest.approx(across * 2.0 * math.atan(0.8 / near_m) / spacing, rel=0.05)  # a 26th of its width


def test_what_is_beyond_the_range_returns_nothing():
    points = wp.array(np.full((1, 3, 1), 50.0), dtype=float)
    near = Beams(EVEN.elevation_rad, EVEN.step_rad, range_m=(60.0, 150.0))
    returned, found = LidarProbability(near).of_points(points, np.array([[5.0, 60.0, 120.0]]), np.zeros(3, int))
    assert returned.numpy()[0] == pytest.approx([50.0, 25.0, 0.0], abs=1e-4)
    assert found.numpy()[0, 0] > 0.99
    assert found.numpy()[0, 2] < 1e-6


def test_the_curve_rises_from_nothing_and_is_that_of_the_kernel():
    curve, n = LidarCurve({"vehicle": 8.0, "pedestrian": 3.0, "cyclist": 4.0}, 2.0), np.linspace(0.0, 200.0, 401)
    value = curve.of(n)
    assert value[0] == 0.0
    assert (np.diff(value) > 0.0).all()
    assert curve.of(np.array([8.0]))[0] == pytest.approx(0.5, abs=1e-3)
    points = wp.array(np.repeat(n[None, :3, None], 1, 0), dtype=float)
    _, found = LidarProbability(EVEN, curve).of_points(points, np.ones((1, 3)), np.array([0, 1, 2]))
    expected = [curve.of(n[k : k + 1], name)[0] for k, name in enumerate(("vehicle", "pedestrian", "cyclist"))]
    assert found.numpy()[0] == pytest.approx(expected, rel=1e-5)


def test_a_table_of_findings_gives_the_curve_that_made_it(tmp_path):
    rng, true = np.random.default_rng(0), LidarCurve({"vehicle": 12.0, "pedestrian": 6.0}, 3.0)
    points, kind = rng.exponential(15.0, 4000), rng.choice(["vehicle", "pedestrian"], 4000)
    chance = np.array([true.of(n, name) for n, name in zip(points, kind, strict=True)])
    is_found = rng.random(4000) < chance
    named = np.where(kind == "vehicle", "lorry", kind)
    rows = [f"{n},{name},{int(hit)}" for n, name, hit in zip(points, named, is_found, strict=True)]
    table = tmp_path / "found.csv"
    table.write_text("\n".join(["points,class,found", *rows]))
    found = fit_lidar_curve(*read_findings(table))
    assert found.points_for_half["vehicle"] == pytest.approx(12.0, rel=0.1)
    assert found.points_for_half["pedestrian"] == pytest.approx(6.0, rel=0.1)
    assert found.points_for_half["cyclist"] == 5.0
    assert found.steepness == pytest.approx(3.0, rel=0.1)
    with pytest.raises(InputError, match="some found and some not, got 30 rows, 30 found"):
        fit_lidar_curve(points[:30], kind[:30], np.ones(30, bool))
    for text, told in (
        ("points,class,hit\n", ":1: expected the columns points, class, found"),
        ("points,class,found\n5,lorry,yes\n", ":2: found: expected 0 or 1, got 'yes'"),
        ("points,class,found\n-1,lorry,1\n", ":2: points: expected a number from 0 on, got '-1'"),
        ("points,class,found\n1,lorry\n", ":2: expected 3 values, got 2"),
    ):
        table.write_text(text)
        with pytest.raises(InputError, match=told):
            read_findings(table)


RADAR = Beams.of_radar(Radar((60.0, 30.0, 40.0), 0.6, 0.3, 0.9), (-1.2, 1.2), (-0.2, 0.2), math.radians(4.0))


def test_a_radar_finds_what_rays_say_shows_enough_of_its_box():
    """Against rays of embree spread evenly over the solid angle."""
    place = wp.array(PLACE_M[None], dtype=wp.vec3)
    rays, owner = caster()
    azimuth, sine = np.meshgrid(np.arange(-1.2, 1.2, 8e-4), np.arange(-math.sin(0.2), math.sin(0.2), 8e-4))
    level = np.sqrt(1.0 - sine**2)
    ray = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), sine], -1).reshape(-1, 3)
    hit = rays.intersects_first(np.repeat(PLACE_M[None], len(ray), 0), ray)
    shown_sr = 8e-4**2 * np.bincount(owner[hit[hit >= 0]], minlength=owner[-1] + 1)[: len(town().vehicles)]
    whole_sr = detection.whole_solid_angle(place, packed().upright_box, vehicle_count=packed().vehicle_count).numpy()[0]
    returned, found = LidarProbability(RADAR).returned(rendered(RADAR, packed().raster, PLACE_M, 2), packed(), place)
    distance_m = away_from(packed(), PLACE_M[None])[0][0]
    range_m = np.array([60.0, 30.0, 40.0])[packed().road_user_index]
    share = 100.0 * shown_sr / whole_sr / (1.0 + np.exp((distance_m - range_m) / (0.05 * range_m)))
    assert returned.numpy()[0] == pytest.approx(share, abs=2.5)
    clear = (share > 40.0) | (share < 20.0)
    assert (found.numpy()[0][clear] > 0.45).tolist() == (share > 30.0)[clear].tolist()
    assert found.numpy().max() == pytest.approx(0.9, abs=0.01)


def test_of_what_is_in_one_cell_of_a_radar_the_one_that_shows_most_is_found():
    turn = np.radians([0.0, 3.0, 10.0, 12.0, -178.5, 179.0])
    direction = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)[None]
    distance_m = np.array([[20.0, 20.5, 20.2, 21.0, 9.0, 9.1]])
    shown, whole_sr = np.array([[[50.0], [60.0], [70.0], [5.0], [80.0], [40.0]]]), np.array([[1, 1, 1, 1, 1, 3]]) * 0.01
    most = LidarProbability(RADAR).most(shown, whole_sr, distance_m, direction)
    assert most[0] == pytest.approx([0.0, 0.9, 0.9, 0.9, 0.0, 0.9])  # 3 and 4 are .8 m apart, the last two touch behind
    half = wp.array(np.full((1, 3, 1), 30.0), dtype=float)
    _, found = LidarProbability(RADAR).of_points(half, np.array([[1.0, 31.5, 10.0]]), np.array([0, 1, 2]))
    assert found.numpy()[0] == pytest.approx([0.5, 0.0, 0.5], abs=0.01)  # a pedestrian's range is 30 m


@pytest.mark.parametrize("beams", [EVEN, RADAR], ids=["lidar", "radar"])
def test_the_slope_of_single_lidars_is_that_of_their_probabilities(beams):
    """Against differences along a line, over a step that many samples cross."""
    surface = MountSurface(np.full((41, 41), 1.9), np.array([0.0, -1.0]), 0.05)
    mount = CameraMount(surface, camera=CameraModel.of_beams(beams, 0.3), height_offset_m=0.1)
    cameras = SingleCameras(mount, LidarProbability(beams, LidarCurve(steepness=1.0)), supersampling=2)
    pose, step_m = np.zeros((1, MOUNT_POSE_SIZE), np.float32), 0.15
    pose[0, :2] = PLACE_M[:2]
    value, jacobian = cameras.with_jacobian(pose, [packed()])
    assert value[0] == pytest.approx(cameras.detection_probability(pose, packed())[0], abs=1e-6)
    for number in (0, 1):
        ends = [pose + sign * step_m * np.eye(MOUNT_POSE_SIZE, dtype=np.float32)[number] for sign in (1, -1)]
        ahead, behind = (cameras.detection_probability(each, packed())[0] for each in ends)
        slope = (ahead - behind) / (2 * step_m)
        found = jacobian[0, :, number]
        assert (found @ slope) / np.linalg.norm(found) / np.linalg.norm(slope) > 0.9


def test_a_rig_finds_what_a_lidar_finds_whatever_its_cameras_see():
    lidar = RigCamera("lidar", PLACE_M, model=CameraModel.of_beams(EVEN, 0.3))
    rig = Rig([RigCamera("up", np.array([1.2, 0.0, 2.5]), pitch_rad=-1.5), lidar])
    options = ObjectiveOptions(occlusion=Occlusion.EXACT)
    seen = RigObserver(rig, SilentDetector(), options, device="cpu").observe(packed())
    frame = rendered(EVEN, packed().raster, PLACE_M)
    points = LidarProbability(EVEN).points(frame).value.numpy()[0, :, 0]
    distance_m, _ = away_from(packed(), PLACE_M[None])
    chance = LidarCurve().of(points / (1.0 + np.exp((distance_m[0] - 100.0) / 5.0)))
    clear = abs(chance - 0.5) > 0.05
    assert seen.lidar_finds[1][clear].tolist() == (chance >= 0.5)[clear].tolist()
    assert seen.detected.tolist() == (seen.lidar_finds[1] | seen.detected_by_camera[0]).tolist()
    assert np.isnan(seen.points[0]).all()
    assert len(seen.images) == 1
    fused = RigObserver(rig, SilentDetector(), replace(options, fusion=detection.Fusion(20.0)), device="cpu").observe(
        packed()
    )
    assert fused.detected.tolist() == (seen.lidar_finds[1] & (packed().distance_m >= 20.0)).tolist()


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"elevation_rad": (0.1, 0.0)}, "ascending angles, got 0.1, 0"),
        ({"elevation_rad": (0.0,)}, "expected 2 to 4096"),
        ({"step_rad": 0.0}, "a positive angle within the sector, got 0"),
        ({"range_m": (0.0, 10.0)}, "positive, ascending distances"),
        ({"azimuth_rad": (1.0, -1.0)}, "ascending angles within"),
        ({"rate_hz": 1e6}, "up to 1000, got 1e\\+06"),
        ({"weight": ((1.0,),)}, "for each of 2 beams"),
    ],
)
def test_beams_that_no_lidar_has(changed, text):
    with pytest.raises(ValueError, match=text):
        Beams(**{"elevation_rad": (-0.1, 0.1), "step_rad": 0.01, **changed})


def test_a_pattern_has_as_many_beams_as_shots_and_where_they_are():
    rng = np.random.default_rng(1)
    shot = np.stack([rng.normal(0.0, 0.2, 20_000), rng.normal(0.0, 0.1, 20_000)], axis=1)
    beams = Beams.of_pattern(shot)
    density = beams.density()
    assert density.sum() == pytest.approx(20_000, rel=0.02)
    _, _, (fx, _), (cx, cy) = beams.panorama
    left_up = (shot[:, 0] > 0.1) & (shot[:, 1] > 0.05)
    assert density[: int(cy - 0.05 * fx), : int(cx - 0.1 * fx)].sum() == pytest.approx(left_up.sum(), rel=0.1)
