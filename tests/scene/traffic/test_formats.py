"""Recorded traffic of Argoverse 2 motion forecasting, nuScenes and Waymo against small samples written by hand."""

import gzip
import json
import math
import re

import numpy as np
import pytest

from warpav.core.errors import InputError
from warpav.scene._places import recordings_of
from warpav.scene.traffic.files import content_digest, is_recording, read_recording, recordings_in
from warpav.scene.traffic.formats import _json_rows
from warpav.scene.traffic.formats._rows import USUAL_SIZE_M, steps_of

SCENES = ("scene-0061", "scene-0103")  # of nuScenes


def line(*points):
    return [{"x": x, "y": y, "z": 7.0} for x, y in points]


def test_steps_follow_gaps_that_are_not_all_alike():
    step, step_s = steps_of(np.cumsum([7.0, *[0.5, 0.48] * 20, 1.0, 0.4])[::-1], "here")
    assert step_s == pytest.approx(0.5, abs=0.02)
    assert step.tolist() == [43, 42, *range(40, -1, -1)]


def write_forecast(folder, **columns):
    """A scenario in which the sensors' car drives along x, with a cyclist, a bus, and a bicycle that stands."""
    pyarrow, parquet = (pytest.importorskip(name) for name in ("pyarrow", "pyarrow.parquet"))
    step = np.arange(12)
    tracks = (
        ("7", "cyclist", 1020.0 - 0.4 * step, 2003.0, math.pi, -4.0),
        ("AV", "vehicle", 1000.0 + 0.8 * step, 2000.0, 0.0, 8.0),
        ("8", "bus", 1030.0 + 0.0 * step, 1996.5, 0.0, 0.0),
        ("9", "riderless_bicycle", 1010.0 + 0.0 * step, 1995.0, 0.0, 0.0),
    )
    rows = [(k, *each[:2], each[2][k], *each[3:], 0.0) for each in tracks for k in step]
    names = ("timestep", "track_id", "object_type", "position_x", "position_y", "heading", "velocity_x", "velocity_y")
    table = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True)) | columns
    table = pyarrow.table({name: column for name, column in table.items() if column is not None})
    folder.mkdir(parents=True, exist_ok=True)
    parquet.write_table(table, folder / "scenario_1.parquet")
    lane = {"left_lane_boundary": line((950, 2001.75), (1050, 2001.75))}
    lane["right_lane_boundary"] = line((950, 1998.25), (1050, 1998.25))
    crossing = {"edge1": line((1040, 1995), (1040, 2005)), "edge2": line((1043, 1995), (1043, 2005))}
    data = {"lane_segments": {"1": lane}, "pedestrian_crossings": {"2": crossing}, "drivable_areas": {}}
    (folder / "log_map_archive_1.json").write_text(json.dumps(data))
    return folder


def test_a_scenario_of_motion_forecasting_is_read(tmp_path):
    folder = write_forecast(tmp_path / "val" / "1")
    assert recordings_in([tmp_path]) == [folder]
    recording = read_recording(folder)
    assert (recording.recording_id, recording.step_s, recording.ego_id) == ("1", 0.1, "AV")
    assert recording.account == "1 objects passed over that are no road users (riderless_bicycle 1)"
    user = {each.user_id: each for each in recording.users}
    assert {name: each.category for name, each in user.items()} == {"7": "bicycle", "AV": "car", "8": "bus"}
    assert user["AV"].pose[2].tolist() == pytest.approx([1.6, 0.0, 0.0])
    assert user["7"].pose[3].tolist() == pytest.approx([18.8, 3.0, math.pi])
    assert user["7"].speed_m_s.tolist() == pytest.approx([4.0] * 12)  # along its heading
    lane, crossing = recording.lanelets
    assert (lane.left_m.tolist(), crossing.is_crosswalk) == ([[-50.0, 1.75], [50.0, 1.75]], True)


def waymo_object(number, kind, size_m, start_m, yaw_rad, speed_m_s, *, unit=1.0, **changes):
    """An object that drives straight on for 3 s, and is not seen at first."""
    ahead = np.array([math.cos(yaw_rad), math.sin(yaw_rad)])
    place = line((-10000.0, -10000.0), *(start_m + 0.1 * speed_m_s * k * ahead for k in range(1, 30)))
    velocity = line((-10000.0, -10000.0), *[speed_m_s * ahead] * 29)
    data = {"id": number, "type": kind, "length": size_m[0], "width": size_m[1], "mark_as_expert": False}
    data |= {"position": place, "heading": [-10000.0, *[yaw_rad / unit] * 29], "velocity": velocity}
    return {**data, "valid": [False, *[True] * 29], **changes}


def write_waymo(folder, name="scene.json", *, unit=1.0, second=None, **changes):
    """A scene on a road along y, 9 km from the origin, of which a second object and what else may be changed."""
    objects = [
        waymo_object(70, "vehicle", (4.6, 1.9), (9000.0, 100.0), 0.5 * math.pi, 8.0, unit=unit, height=1.5),
        waymo_object(71, "vehicle", (8.0, 2.5), (8996.5, 160.0), -0.5 * math.pi, 10.0, unit=unit, **second or {}),
        waymo_object(72, 2, (0.0, 0.0), (9006.0, 120.0), 0.25 * math.pi, 1.0, unit=unit),
        waymo_object(73, "cyclist", (1.8, 0.7), (9002.0, 130.0), 0.5 * math.pi, 4.0, unit=unit),
        waymo_object(74, "other", (1.0, 1.0), (9009.0, 130.0), 0.0, 0.0, unit=unit),
    ]
    roads = [
        {"type": "lane", "map_element_id": 2, "geometry": line((9000, 50), (9000, 100), (9000, 200))},
        {"type": "lane", "map_element_id": 3, "geometry": line((9002, 50), (9002, 200))},
        {"type": "crosswalk", "geometry": line((8995, 143), (8995, 140), (9005, 140), (9005, 143))},
        {"type": "stop_sign", "geometry": line((9005, 139))[0]},
    ]
    data = {"name": "one", "objects": objects, "roads": roads, "metadata": {"sdc_track_index": 0}, **changes}
    content = json.dumps(data).encode()
    (folder / name).write_bytes(gzip.compress(content) if name.endswith(".gz") else content)
    return folder / name


@pytest.mark.parametrize(("unit", "name"), [(1.0, "scene.json"), (math.radians(1.0), "scene.json.gz")])
def test_a_scene_of_waymo_is_read_in_either_unit(tmp_path, unit, name):
    recording = read_recording(write_waymo(tmp_path, name, unit=unit))
    assert (recording.recording_id, recording.source, recording.step_s) == ("one", "Waymo", 0.1)
    assert (recording.account, recording.ego_id) == ("1 objects passed over that are no road users (other 1)", "70")
    car, lorry, walker, _ = recording.users
    assert [each.category for each in recording.users] == ["car", "car", "pedestrian", "bicycle"]
    assert (car.size_m, walker.size_m) == ((4.6, 1.9, 1.5), USUAL_SIZE_M["pedestrian"])
    assert car.step.tolist() == list(range(1, 30))  # without the one before it was seen
    assert car.pose[3].tolist() == pytest.approx([9000.0, 103.2, 0.5 * math.pi])
    assert lorry.speed_m_s.tolist() == pytest.approx([10.0] * 29)
    lane, cycle_lane, crossing = recording.lanelets
    assert lane.left_m[1].tolist() == [8998.25, 100.0]
    assert np.ptp([cycle_lane.left_m[0], cycle_lane.right_m[0]], axis=0).tolist() == [1.5, 0.0]
    assert crossing.left_m.tolist() == [[9005.0, 143.0], [8995.0, 143.0]]  # over the road, as people go
    assert crossing.right_m.tolist() == [[9005.0, 140.0], [8995.0, 140.0]]


def test_what_a_file_of_waymo_may_lack(tmp_path):
    objects = json.loads(write_waymo(tmp_path, second={"is_sdc": True}).read_bytes())["objects"]
    for each in objects:
        del each["id"], each["velocity"]
    recording = read_recording(write_waymo(tmp_path, objects=objects, roads=[], metadata={}))
    assert [each.user_id for each in recording.users] == ["0", "1", "2", "3"]
    assert (recording.users[0].speed_m_s, recording.ego_id) == (None, "1")
    assert len(recording.lanelets) == 2  # along the tracks of car and lorry
    standing = [waymo_object(k, 1, (4.6, 1.9), (9000.0, 60.0 + k), 1.5, 0.0, unit=math.radians(1.0)) for k in (0, 9)]
    for each in read_recording(write_waymo(tmp_path, objects=standing)).users:
        assert each.pose[:, 2].tolist() == pytest.approx([1.5] * 29)  # as 86 are too many radians


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"length": None}, r"road user 71: length: expected a number, got nothing"),
        ({"heading": [1.0]}, r"road user 71: valid: expected as many positions, .*, got \[30, 1, 30, 30\]"),
        ({"heading": [math.nan] * 30}, r"road user 71: expected as many positions, .* at least one"),
        ({"id": 70}, r"road user 70: id: expected every id once, got it twice"),
    ],
)
def test_a_bad_object_of_waymo_costs_itself(tmp_path, changes, message):
    account = read_recording(write_waymo(tmp_path, second=changes)).account
    assert re.search(rf"^1 of 4 road users left out .*{message}", account)


def write_nuscenes(folder, **tables):
    """Two scenes in which the sensors' car drives along y with others around it; ``tables`` replaces some."""
    along_x, along_y = [1.0, 0.0, 0.0, 0.0], [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
    names = ("vehicle.car", "vehicle.trailer", "vehicle.bicycle", "human.pedestrian.adult", "movable_object.barrier")
    things = (
        (0, 0.0, 12.0, True, [1.8, 4.5, 1.5], along_y, []),
        (1, 6.0, 20.0, False, [2.5, 9.0, 3.8], along_x, []),
        (2, -3.0, 8.0, True, [0.6, 1.8, 1.7], along_y, ["a0"]),
        (2, -5.0, 9.0, False, [0.5, 1.7, 1.1], along_y, ["a1"]),
        (3, 5.0, 9.0, False, [0.7, 0.7, 1.8], along_x, []),
        (4, 7.0, 9.0, False, [2.0, 0.5, 1.0], along_x, []),
    )
    made = {name: [] for name in ("scene", "sample", "instance", "ego_pose", "sample_annotation")}
    made["category"] = [{"token": f"c{k}", "name": name, "description": "a {b}"} for k, name in enumerate(names)]
    made["attribute"] = [{"token": "a0", "name": "cycle.with_rider"}, {"token": "a1", "name": "cycle.without_rider"}]
    for s, scene in enumerate(SCENES):
        made["scene"].append({"token": f"s{s}", "name": scene, "description": "turns {left}"})
        made["instance"] += [{"token": f"i{s}{k}", "category_token": f"c{each[0]}"} for k, each in enumerate(things)]
        for step, elapsed_us in enumerate((0, 500_000, 950_000, 1_450_000, 1_950_000)):
            token, y = f"k{s}{step}", 2000.0 + 4e-6 * elapsed_us
            time_us = 1_532_402_927_647_951 + 60_000_000 * s + elapsed_us
            made["sample"].append({"token": token, "timestamp": time_us, "scene_token": f"s{s}"})
            for late_us in (-50_000, 0, 50_000):
                place = [1000.0, y + 4e-6 * late_us, 0.0]
                made["ego_pose"].append({"timestamp": time_us + late_us, "translation": place, "rotation": along_y})
            for k, (_, x, ahead, moves, size, rotation, attributes) in enumerate(things):
                place = [1000.0 + x, ahead + (y if moves else 2000.0), 1.0]
                row = {"sample_token": token, "instance_token": f"i{s}{k}", "attribute_tokens": attributes}
                made["sample_annotation"].append({**row, "size": size, "translation": place, "rotation": rotation})
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in (made | tables).items():
        (folder / f"{name}.json").write_text(rows if isinstance(rows, str) else json.dumps(rows, indent=0))
    return folder


def test_scenes_of_nuscenes_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(_json_rows, "_BLOCK_BYTES", 1000)  # no table is read at once
    folder = write_nuscenes(tmp_path / "v1.0-mini")
    (tmp_path / "maps.json").write_text("{}")  # is not taken for a recording
    files = recordings_in([tmp_path])
    assert files == recordings_in([folder]) == [folder / name for name in SCENES]
    assert recordings_of(str(files[1])) == files[1:]
    assert [is_recording(each) for each in (*files, folder / "scene-0062")] == [True, True, False]
    assert content_digest(files[0]) != content_digest(files[1])
    recording = read_recording(files[0])
    assert (recording.recording_id, recording.source, recording.ego_id) == (SCENES[0], "nuScenes", "ego")
    assert (recording.step_s, recording.last_step) == (0.5, 4)
    assert {each.kinds for each in recording.lanelets} == {("intersection",)}  # along the tracks
    assert "(vehicle.bicycle without rider 1, movable_object.barrier 1)" in recording.account
    user = {each.user_id: each for each in recording.users}
    assert list(user) == ["ego", "i00", "i01", "i02", "i04"]
    assert [each.category for each in recording.users] == ["car", "car", "truck", "bicycle", "pedestrian"]
    assert user["ego"].pose[2].tolist() == pytest.approx([1000.0, 2003.8 + 1.385, 0.5 * math.pi])
    assert user["i00"].pose[2].tolist() == pytest.approx([1000.0, 2015.8, 0.5 * math.pi])
    assert user["i00"].size_m == (4.5, 1.8, 1.5)  # the file has width, length, height


def test_bad_rows_of_nuscenes_cost_a_road_user(tmp_path):
    write_nuscenes(tmp_path)
    rows, poses = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("sample_annotation", "ego_pose"))
    rows.append(rows[0])  # the car twice at a time
    rows[2]["translation"] = [math.nan] * 3
    rows[6]["instance_token"] = rows[12]["sample_token"] = "nobody"
    # without the poses of two key frames
    recording = read_recording(write_nuscenes(tmp_path, sample_annotation=rows, ego_pose=poses[6:]) / SCENES[0])
    assert {each.user_id: len(each.step) for each in recording.users} == {"ego": 3, "i01": 5, "i02": 4, "i04": 5}
    assert re.search(r"road users left out \(t 1\), such as road user i00: t: .*[(]no instance 1", recording.account)


def refusal(path):
    """The one line by which a recording, or the first scene of tables, is refused."""
    path = path / SCENES[0] if (path / "scene.json").exists() else path
    with pytest.raises(InputError) as error:
        read_recording(path)
    assert "\n" not in str(error.value)
    assert str(error.value).count(str(path.parent)) == 1
    return str(error.value)


@pytest.mark.parametrize(
    ("write", "changes", "message"),
    [
        (write_forecast, {"heading": None}, r"scenario_1.parquet: expected a column heading, got timestep, track_id"),
        (write_forecast, {"timestep": [0.5] * 48}, r"timestep: expected whole steps from 0, got 0.5"),
        (write_forecast, {"timestep": list(range(10**9, 10**9 + 48))}, r"t: expected steps from 0 to 1000000"),
        (write_forecast, {"heading": [180.0] * 48}, r"yaw_rad: expected radians, got 180; degrees\?"),
        (write_forecast, {"position_x": [math.nan] * 48}, r"road user 7: expected finite positions"),
        (write_forecast, {"position_x": [9000.0] * 48}, r"lanelets: expected the lanes that the road users drive on"),
        (write_waymo, {"roads": [{"geometry": [{"x": 0.0}]}]}, r"roads\[0\].geometry\[0\].y: expected a value"),
        (write_waymo, {"roads": [{"type": "lane", "geometry": line((0, 0), (1, 1))}]}, r"lanelets: expected the lanes"),
        (write_waymo, {"unit": 0.6}, r"yaw_rad: expected headings counter-clockwise from x along which road users"),
        (write_nuscenes, {"sample": [{"token": 1, "scene_token": 1}]}, r"sample.json: .* column 'timestamp', got none"),
        (write_nuscenes, {"sample": []}, r"sample.json: expected .*times of two moments or more, got 0"),
        (write_nuscenes, {"sample_annotation": "[\n"}, r"expected a whole table, got one that is cut off"),
        (write_nuscenes, {"instance": "[{]}"}, r"instance.json \(after row 0\):1: expected valid JSON \(a table\)"),
        (write_nuscenes, {"ego_pose": []}, r"ego_pose.json: expected poses at the times of the key frames, got none"),
        (write_nuscenes, {"scene": [{"token": k, "name": "two"} for k in (0, 1)]}, r"name: .* once, got two twice"),
    ],
)
def test_bad_files_are_refused(tmp_path, write, changes, message):
    assert re.search(message, refusal(write(tmp_path, **changes)))


def test_files_that_are_cut_off_too_many_too_large_or_missing_are_refused(tmp_path, monkeypatch):
    log, scene, tables = write_forecast(tmp_path / "log"), write_waymo(tmp_path), write_nuscenes(tmp_path / "tables")
    for file in (log / "scenario_1.parquet", scene):
        file.write_bytes(file.read_bytes()[:-40])
    assert "scenario_1.parquet: expected a table, got" in refusal(log)
    assert "line 1: expected valid JSON" in refusal(scene)
    (log / "scenario_2.parquet").write_bytes(b"")
    assert "expected one scenario in a folder, got scenario_1.parquet and scenario_2.parquet" in refusal(log)
    (tables / "attribute.json").unlink()
    assert "attribute.json: expected recorded traffic, got: No such file" in refusal(tables)
    for name, message in (("TABLE_BYTES_MAX", "at most 0 MB"), ("DATA_SET_NODES_MAX", "expected at most 1 values")):
        monkeypatch.setattr(_json_rows, name, 1)
        (tables / "scene.json").touch()  # is read again
        assert message in refusal(tables)
