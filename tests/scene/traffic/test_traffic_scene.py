"""Scenes of recorded traffic: everybody where they were, on the ground, in nobody's way, the same for the same seed."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from tests.scene.traffic.recordings import recording_of, street, track, write
from warpav.raster.mesh import Mesh
from warpav.scene import ego_vehicle, read_scenes
from warpav.scene._cache import built_scenes
from warpav.scene._scene import outline_gap_m, rectangle_m
from warpav.scene.town._houses import KERB_HEIGHT_M
from warpav.scene.town._town_layout import Footprint
from warpav.scene.traffic.files import read_recording, shipped_recordings
from warpav.scene.traffic.moments import REACH_M, Moment, moment_of, moments_of
from warpav.scene.traffic.traffic_scene import TrafficSource, traffic_scene

SEEDS = range(4)


def scene_of(data, ego_id, step=0, seed=0, ego=None):
    return traffic_scene(recording_of(data), Moment(Path(data["id"]), step, ego_id), seed, ego=ego)[0]


def ego_centre_m():
    return ego_vehicle().bounds_m()[:, :2].astype(np.float64).mean(axis=0)


@pytest.mark.parametrize("turn_rad", [0.0, 1.1, -2.9])
def test_road_users_stand_where_they_were_recorded(turn_rad):
    scene = scene_of(street(turn_rad=turn_rad, shift_m=(300.0, -70.0)), "a", step=2)
    # of the street in its own frame, from the centre of car a, which drives along x
    recorded = {"b": (18.0 - 2.0, 0.0), "c": (70.0 - 18.0, 3.5), "d": (-20.0 - 4.0, -1.25), "e": (15.0 - 7.0, 7.25)}
    size = {"b": (4.2, 1.5), "c": (8.0, None), "d": (1.8, None)}
    users = dict(zip("bcde", scene.road_users, strict=False))
    assert [users[name].category for name in "cde"] == ["lorry", "cyclist", "pedestrian"]
    for name, (x, y) in recorded.items():
        box = users[name].box
        # people's meshes are not symmetric about the box's centre: a stride is .2 m longer ahead
        assert box.center_m[:2] - ego_centre_m() == pytest.approx([x, y], abs=2e-3 if name in "bc" else 0.25)
        yaw = math.pi if name == "c" else 0.0
        assert math.cos(box.yaw_rad - yaw) == pytest.approx(1.0, abs=1e-9)
    for name, (length, height) in size.items():
        assert users[name].box.size_m[0] == pytest.approx(length, abs=1e-3)
        if height is not None:
            assert users[name].box.size_m[2] == pytest.approx(height, abs=2e-3)


def test_velocities_are_relative_to_the_ego_vehicle():
    scene = scene_of(street(turn_rad=2.2), "a")
    b, c, *_ = scene.road_users
    assert b.velocity_ego_m_s == pytest.approx([-2.0, 0.0], abs=1e-6)
    assert c.velocity_ego_m_s == pytest.approx([-18.0, 0.0], abs=1e-6)
    backwards = scene_of(street(turn_rad=2.2), "c")
    assert backwards.road_users[0].velocity_ego_m_s == pytest.approx([-18.0, 0.0], abs=1e-6)
    parked = [user for user in scene.road_users if user.instance_id > 4]
    assert all(user.velocity_ego_m_s == pytest.approx([-8.0, 0.0], abs=1e-6) for user in parked)


@pytest.mark.parametrize(
    ("category", "size_m", "is_pavement"), [("pedestrian", (0.7, 0.7), True), ("bicycle", (1.8, 0.7), False)]
)
def test_people_on_foot_step_over_kerbs_and_riders_are_on_one_level(category, size_m, is_pavement):
    data = street()
    data["road_users"].append(track("x", category, size_m, (5.0, -3.6), 0.0, 1.0))
    scene = scene_of(data, "a")
    ground = EmbreeScene()
    TriangleMesh(ground, scene.environment.vertex_m[scene.environment.triangle])
    beside_m = ego_centre_m() + np.array([15.0, -3.95 + 1.75])  # of the kerb, on the side of the pavement
    origin = np.array([[*beside_m, 2.0]], np.float32)
    [away] = ground.run(origin, np.array([[0.0, 0.0, -1.0]], np.float32), query="DISTANCE")
    # shadows lie up to 2 cm above the ground
    assert 2.0 - away == pytest.approx(KERB_HEIGHT_M if is_pavement else 0.0, abs=0.02)


def test_a_longer_ego_vehicle_pushes_nobody_aside():
    """A bus around the place of a car: who would be in it is left out and counted."""
    data = street()
    ego = ego_vehicle()
    long = Mesh(ego.vertex_m * np.array([9.0, 1.0, 2.0], np.float32), ego.triangle, ego.vertex_rgb)  # 42 m
    recording = recording_of(data)
    scene, left_out = traffic_scene(recording, Moment(Path("street"), 0, "a"), 0, ego=long)
    assert left_out == 2  # car b, 18 m ahead, and the cyclist, 20 m behind
    low, high = long.bounds_m()[:, :2]
    assert not any(outline_gap_m(user.box.outline_m, rectangle_m(low, high)) < 0.0 for user in scene.road_users)
    assert scene.road_users[0].category == "lorry"
    # centre on centre
    assert scene.road_users[0].box.center_m[:2] - 0.5 * (low + high) == pytest.approx([70.0, 3.5], abs=2e-3)


def check_scene(scene, recording, moment):
    """Nobody floats, is sunk, or overlaps; no house and no furniture where recorded lanes or road users are."""
    ground = EmbreeScene()
    TriangleMesh(ground, scene.environment.vertex_m[scene.environment.triangle])
    states = recording.states_at(moment.step)
    own = next(state for state in states if state.user.user_id == moment.ego_id)
    near = [state for state in states if state is not own and np.linalg.norm(state.centre_m - own.centre_m) <= REACH_M]
    count = len([user for user in scene.road_users if user.instance_id <= len(near)])
    assert count >= len(near) - 2  # but for who stands in the ego vehicle
    low, high = ego_vehicle().bounds_m()[:, :2].astype(np.float64)
    places = [Footprint(*(0.5 * (low + high)).tolist(), 0.0, *(high - low).tolist())]
    for user in scene.road_users:
        foot = user.mesh.vertex_m[user.mesh.vertex_m[:, 2] < user.mesh.vertex_m[:, 2].min() + 2e-3]
        z = foot[:, 2].min()
        assert min(abs(z), abs(z - KERB_HEIGHT_M)) < 3e-3
        origin = np.c_[foot[:, :2], np.full(len(foot), z + 0.05)].astype(np.float32)
        down = np.ascontiguousarray(np.broadcast_to(np.array([0, 0, -1], np.float32), origin.shape))
        away = ground.run(origin, down, query="DISTANCE")
        # shadows and markings lie up to 2 cm above the ground
        if user.category != "pedestrian":
            assert np.all((away > 0.02) & (away < 0.06)), (user, away)
        assert not outline_gap_m(user.box.outline_m, rectangle_m(low, high)) < 0.0
    # everything of the environment that is high is clear of lanes and of road users
    corner = scene.environment.vertex_m[scene.environment.triangle]
    tall = corner[(corner[..., 2] > 0.3).any(axis=1) & (corner[..., 2] < 2.5).any(axis=1)]
    c, s = math.cos(own.yaw_rad), math.sin(own.yaw_rad)
    point = (tall[..., :2].reshape(-1, 2) - ego_centre_m()) @ np.array([[c, s], [-s, c]]) + own.centre_m
    for lanelet in recording.lanelets:
        outline = lanelet.outline_m.astype(np.float32)
        inside = (point >= outline.min(axis=0)).all(axis=1) & (point <= outline.max(axis=0)).all(axis=1)
        away = [cv2.pointPolygonTest(outline, tuple(map(float, each)), True) for each in point[inside]]
        reach = np.abs((point[inside] - own.centre_m) @ np.array([[c, -s], [s, c]])).max(axis=1)
        # roads end 85 m from the ego vehicle; arms of lamp posts hang over the kerb
        assert all(each < 0.3 for each, far in zip(away, reach, strict=True) if far < 80.0)
    for state in near:
        assert not _inside(point, state.corners_m()).any()
    parked = [user for user in scene.road_users if user.instance_id > len(near)]
    outlines = [*places, *(_footprint(user) for user in scene.road_users if user not in parked)]
    for user in parked:
        assert not any(_footprint(user).nearer(other, 0.0) for other in outlines)


def _footprint(user):
    box = user.box
    return Footprint(
        float(box.center_m[0]), float(box.center_m[1]), box.yaw_rad, float(box.size_m[0]), float(box.size_m[1])
    )


def _inside(point, corner):
    side = np.roll(corner, -1, axis=0) - corner
    offset = point[:, None] - corner
    return (side[:, 0] * offset[..., 1] - side[:, 1] * offset[..., 0] > 0.0).all(axis=1)


@pytest.mark.parametrize("seed", SEEDS)
def test_shipped_scenes_hold_together(seed):
    moment = moment_of(moments_of(shipped_recordings(), ego_vehicle().bounds_m()), seed)
    recording = read_recording(moment.file)
    scene, _ = traffic_scene(recording, moment, seed)
    check_scene(scene, recording, moment)
    assert 10_000 < len(scene.environment.triangle) < 60_000


def test_scenes_are_kept_by_content(tmp_path):
    file = write(tmp_path, street())
    source = TrafficSource(Moment(file, 0, "a"), 5)
    folder = tmp_path / "kept"
    [built] = built_scenes([source], folder=folder)
    [kept] = folder.glob("traffic_*.npz")
    before = kept.stat().st_mtime_ns, kept.read_bytes()
    [again] = built_scenes([source], folder=folder)
    np.testing.assert_array_equal(built.environment.vertex_m, again.environment.vertex_m)
    assert [user.category for user in again.road_users] == [user.category for user in built.road_users]
    assert kept.read_bytes() == before[1]
    data = street()
    data["road_users"][1]["width_m"] = 1.8
    write(tmp_path, data)
    list(built_scenes([source], folder=folder))
    assert len(list(folder.glob("traffic_*.npz"))) == 2


def test_read_scenes_takes_recordings(tmp_path):
    write(tmp_path, street(), "one.json.gz")
    scenes = read_scenes(tmp_path)
    assert [scene.name for scene in scenes] == [f"traffic_{number:04d}" for number in range(5)]
    assert [int(scene.source.split(" step ")[1].split()[0]) for scene in scenes] == [0, 2, 4, 6, 8]
