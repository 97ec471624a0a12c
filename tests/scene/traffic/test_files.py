"""Files of recorded traffic against small ones written by hand."""

import json
import math
import re

import numpy as np
import pytest

from tests.scene.traffic.recordings import LANE_M, street, write
from tests.scene.traffic.test_drone_formats import write_highd, write_ind, write_interaction, write_sumo
from tests.scene.traffic.test_formats import write_forecast, write_nuscenes, write_waymo
from warpav.core.errors import InputError
from warpav.scene.traffic.files import read_recording, recordings_in
from warpav.scene.traffic.formats._argoverse2 import EGO_CENTRE_M

XML = """<?xml version='1.0' encoding='UTF-8'?>
<commonRoad timeStepSize="0.1" commonRoadVersion="{version}" author="A" source="by hand" benchmarkID="ZAM_Test-1_1_T-1">
  <lanelet id="1">
    <leftBound><point><x>-50.0</x><y>1.75</y></point><point><x>50</x><y>1.75</y></point></leftBound>
    <rightBound><point><x>-50.0</x><y>-1.75</y></point><point><x>50</x><y>-1.75</y></point></rightBound>
    {kind}
  </lanelet>
  {dynamic}
  {static}
  {building}
  <planningProblem id="99"><initialState><position><point><x>0</x><y>0</y></point></position></initialState>
  </planningProblem>
</commonRoad>
"""
STATE = """<{tag}><position><point><x>{x}</x><y>{y}</y></point></position><orientation>
<exact>{yaw}</exact></orientation><time><exact>{step}</exact></time><velocity><exact>{speed}</exact></velocity></{tag}>"""
SHAPE = "<shape><rectangle><length>{length}</length><width>{width}</width></rectangle></shape>"


def scenario(version, **changes):
    """A scenario with a car at 10 m/s and a parked lorry."""
    first = STATE.format(tag="initialState", x=0.0, y=0.1, yaw=0.01, step=0, speed=10.0)
    states = "".join(STATE.format(tag="state", x=k, y=0.1, yaw=0.01, step=k, speed=10.0) for k in range(1, 31))
    still = STATE.format(tag="initialState", x=20.0, y=-3.0, yaw=3.0, step=0, speed=0.0)
    shape = changes.pop("shape", SHAPE.format(length=4.4, width=1.7))
    parts = {"version": version, "kind": ""}
    body = f"{shape}{first}<trajectory>{states}</trajectory>"
    lorry = f"{SHAPE.format(length=8.0, width=2.4)}{still}"
    if version == "2018b":
        parts["dynamic"] = f'<obstacle id="7"><role>dynamic</role><type>car</type>{body}</obstacle>'
        parts["static"] = f'<obstacle id="8"><role>static</role><type>truck</type>{lorry}</obstacle>'
    else:
        parts["kind"] = "<laneletType>urban</laneletType><laneletType>intersection</laneletType>"
        parts["dynamic"] = f'<dynamicObstacle id="7"><type>car</type>{body}</dynamicObstacle>'
        parts["static"] = f'<staticObstacle id="8"><type>truck</type>{lorry}</staticObstacle>'
    parts["building"] = f'<staticObstacle id="9"><type>building</type>{lorry}</staticObstacle>'
    return XML.format(**{**parts, **changes})


@pytest.mark.parametrize("name", ["street.json", "street.json.gz"])
def test_json_is_read_as_it_is_written(tmp_path, name):
    data = street(ego="a")
    data["lanelets"][0]["type"] = "crosswalk"
    recording = read_recording(write(tmp_path, data, name))
    assert (recording.recording_id, recording.source, recording.step_s) == ("street", "by hand", 0.5)
    assert recording.ego_id == "a"
    assert recording.lanelets[0].is_crosswalk
    assert recording.lanelets[1].left_m.tolist() == data["lanelets"][1]["left"]
    for user, written in zip(recording.users, data["road_users"], strict=True):
        assert (user.user_id, user.category) == (written["id"], written["type"])
        assert user.size_m[:2] == (written["length_m"], written["width_m"])
        assert math.isnan(user.size_m[2]) == ("height_m" not in written)
        assert user.pose[:, 0].tolist() == written["x_m"]
        assert user.pose[:, 2].tolist() == written["yaw_rad"]
        assert user.speed_m_s is not None
        assert user.speed_m_s.tolist() == written["v_mps"]


@pytest.mark.parametrize("version", ["2018b", "2020a"])
def test_commonroad_scenarios_are_read(tmp_path, version):
    file = tmp_path / "scenario.xml"
    file.write_text(scenario(version))
    recording = read_recording(file)
    assert (recording.recording_id, recording.source, recording.step_s) == ("ZAM_Test-1_1_T-1", "by hand", 0.1)
    car, lorry = recording.users
    assert (car.user_id, car.category, car.size_m[:2]) == ("7", "car", (4.4, 1.7))
    assert car.pose[12].tolist() == [12.0, 0.1, 0.01]
    assert car.step.tolist() == list(range(31))
    assert (lorry.user_id, lorry.category) == ("8", "truck")
    assert lorry.step.tolist() == list(range(31))  # parked all the time
    assert (lorry.pose == [20.0, -3.0, 3.0]).all()
    [lanelet] = recording.lanelets
    assert lanelet.left_m.tolist() == [[-50.0, 1.75], [50.0, 1.75]]
    assert lanelet.kinds == (("urban", "intersection") if version == "2020a" else ())


def test_a_rectangle_beside_its_position_is_moved(tmp_path):
    shape = "<shape><rectangle><length>4</length><width>2</width><orientation>0.5</orientation>"
    file = tmp_path / "scenario.xml"
    file.write_text(scenario("2020a", shape=f"{shape}<center><x>1.0</x><y>0.5</y></center></rectangle></shape>"))
    car = read_recording(file).users[0]
    c, s = math.cos(0.01), math.sin(0.01)
    assert car.pose[0] == pytest.approx([c - 0.5 * s, 0.1 + s + 0.5 * c, 0.51])


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;">]>'


def without(name, user=None):
    data = street()
    del (data if user is None else data["road_users"][user])[name]
    return json.dumps(data).encode()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (scenario("2020a")[:-900], r"expected a whole CommonRoad scenario, got a syntax error: unclosed token"),
        (scenario("2020a").replace("?>\n", f"?>\n{BOMB}", 1), r"expected XML without a DOCTYPE"),
        (scenario("2021x"), r"commonRoadVersion: expected 2018b or 2020a, got '2021x'"),
        ("<scene/>", r"expected recorded traffic .*, got another file"),
        (scenario("2020a").replace("timeStepSize", "step"), r"timeStepSize: expected a number, got nothing"),
        (scenario("2020a", dynamic="", static=""), r"road users: expected some, got none"),
        (b"{", r"line 1: expected valid JSON \(recorded traffic\), got"),
        (b"\xff\xfe", r"expected recorded traffic, got: not UTF-8 text"),
        (b"[" * 100_000, r"expected at most 64 levels inside one another, got more"),
        (b"[]", r"expected an object, got"),
        (without("road_users"), r"road_users: expected a value, got nothing"),
        (without("dt_s"), r"dt_s: expected a value, got nothing"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path, text, message):
    file = tmp_path / ("scenario.xml" if isinstance(text, str) else "bad.json")
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(InputError, match=message) as error:
        read_recording(file)
    assert str(error.value).startswith(f"{file}: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (scenario("2020a", shape="<shape><polygon/></shape>"), r"obstacle 7: shape: expected one rectangle or circle"),
        (scenario("2020a", shape=""), r"obstacle 7: shape: expected one rectangle or circle, got nothing"),
        (scenario("2020a", shape=SHAPE.format(length="long", width=2)), r"obstacle 7: length: expected a number"),
        (scenario("2020a", shape=SHAPE.format(length="440", width=2)), r"road user 7: length_m: .*, got 440"),
        (scenario("2020a").replace("<exact>0</exact></time>", "<exact>0.5</exact></time>", 1), r"time: expected whole"),
        (
            scenario("2020a").replace("<exact>30</exact></time>", "<exact>1700000000</exact></time>"),
            r"obstacle 7: time: expected steps from 0 to 1000000, in units of dt_s, got 1700000000",
        ),
    ],
)
def test_a_bad_obstacle_costs_itself_alone(tmp_path, text, message):
    file = tmp_path / "scenario.xml"
    file.write_text(text)
    recording = read_recording(file)
    assert [user.category for user in recording.users] == ["truck"]
    assert re.search(rf"1 of 2 road users left out .*{message}", recording.account)
    assert "building 1" in recording.account
    start = text.index("<staticObstacle")
    file.write_text(text[:start] + text[text.index("</commonRoad>") :])
    with pytest.raises(InputError, match=message) as error:
        read_recording(file)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (without("length_m", 1), r"road user b: length_m: expected a value, got nothing"),
        (without("yaw_rad", 1), r"road user b: yaw_rad: expected a value, got nothing"),
        (json.dumps(street()).replace('"truck"', '"trck"').encode(), r"road user c: type: .*did you mean truck\?"),
        (json.dumps(street()).replace('"t": [0, 1,', '"t": [0, 1.5,', 1).encode(), r"t: expected whole steps, got 1.5"),
        (json.dumps(street()).replace('"t": [0, 1,', '"t": [1,', 1).encode(), r"expected as many x_m"),
        (
            json.dumps(street()).replace(" 8]", " 1732500000]", 1).encode(),
            r"t: expected steps from 0 to .*, got 1732500000",
        ),
        (json.dumps(street()).replace(" 8]", " 1e300]", 1).encode(), r"t: expected steps from 0 to .*, got 1e\+300"),
        (json.dumps(street()).replace('"t": [0,', '"t": [-1,', 1).encode(), r"t: expected steps from 0 to .*, got -1"),
    ],
)
def test_a_bad_road_user_of_json_costs_itself_alone(tmp_path, content, message):
    file = tmp_path / "bad.json"
    file.write_bytes(content)
    recording = read_recording(file)
    assert len(recording.users) == 4
    assert re.search(rf"1 of 5 road users left out .*{message}", recording.account)


def test_lanes_may_be_centre_lines_or_missing(tmp_path):
    data = street()
    del data["lanelets"]
    assert len(read_recording(write(tmp_path, data)).lanelets) == 3
    data["lanes"] = [{"centre": [[-90, -1.75], [0, -1.75], [90, -1.75]]}, {"centre": [[90, 2], [-90, 2]], "width_m": 4}]
    one, other = read_recording(write(tmp_path, data)).lanelets
    assert one.left_m == pytest.approx(np.array([[-90.0, 0.0], [0.0, 0.0], [90.0, 0.0]]))
    assert one.right_m[:, 1] == pytest.approx(-LANE_M)
    assert other.left_m[:, 1] == pytest.approx(0.0)
    assert other.right_m[:, 1] == pytest.approx(4.0)
    data["lanes"][1]["width_m"] = -1
    with pytest.raises(InputError, match=r"lane 1: width_m: expected more than 0, got -1"):
        read_recording(write(tmp_path, data))


def test_folders_are_read_in_natural_order_and_other_files_refused(tmp_path):
    for name in ("part_10.json", "part_9.json.gz", "part_2.xml"):
        write(tmp_path, street(), name)
    (tmp_path / "notes.txt").write_text("no recording")
    assert [file.name for file in recordings_in([tmp_path])] == ["part_2.xml", "part_9.json.gz", "part_10.json"]
    with pytest.raises(InputError, match=r"notes.txt: expected recorded traffic"):
        recordings_in([tmp_path / "notes.txt"])
    with pytest.raises(InputError, match=r"got no such file"):
        recordings_in([tmp_path / "nothing"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"got a folder without any"):
        recordings_in([tmp_path / "empty"])


# a log of Argoverse 2


def write_log(folder, *, boxes=None):
    """A log in which the sensors' car drives along y of the city, and sees a car 10 m ahead and a cyclist."""
    pyarrow = pytest.importorskip("pyarrow")
    feather = pytest.importorskip("pyarrow.feather")
    stamp = np.arange(5, dtype=np.int64) * 100_000_000 + 315_967_000_000_000_000
    half = math.sqrt(0.5)  # the vehicle looks along y of the city
    poses = {"timestamp_ns": stamp} | {f"q{axis}": np.full(5, half * (axis in "wz")) for axis in "wxyz"}
    poses |= {"tx_m": np.full(5, 1000.0), "ty_m": 2000.0 + 0.8 * np.arange(5), "tz_m": np.full(5, 17.0)}
    rows = []
    for each in stamp:
        rows.append((each, "car-1", "REGULAR_VEHICLE", 4.6, 1.8, 1.5, 1.0, 0.0, 10.0, 0.5))
        rows.append((each, "cone-1", "CONSTRUCTION_CONE", 0.4, 0.4, 0.8, 1.0, 0.0, 6.0, 2.5))
        rows.append((each, "rider-1", "BICYCLIST", 0.8, 0.6, 1.7, half, half, 5.0, -3.0))
        rows.append((each, "bike-1", "BICYCLE", 1.9, 0.5, 1.1, half, half, 5.1, -3.0))
        rows.append((each, "bike-2", "BICYCLE", 1.9, 0.5, 1.1, half, half, 15.1, -5.0))
    names = ("timestamp_ns", "track_uuid", "category", "length_m", "width_m", "height_m", "qw", "qz", "tx_m", "ty_m")
    columns = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
    columns |= {name: [0.0] * len(rows) for name in ("qx", "qy", "tz_m")}
    columns |= boxes or {}
    folder.mkdir(exist_ok=True)
    feather.write_feather(pyarrow.table(poses), folder / "city_SE3_egovehicle.feather")
    feather.write_feather(pyarrow.table(columns), folder / "annotations.feather")
    (folder / "map").mkdir(exist_ok=True)

    def line(x):
        return [{"x": x, "y": y, "z": 17.0} for y in (1950.0, 2080.0)]

    segment = {"left_lane_boundary": line(998.25), "right_lane_boundary": line(1001.75), "is_intersection": True}
    crossing = {"edge1": [{"x": 995.0, "y": 2020.0}, {"x": 1005.0, "y": 2020.0}]}
    crossing["edge2"] = [{"x": 995.0, "y": 2023.0}, {"x": 1005.0, "y": 2023.0}]
    data = {"lane_segments": {"1": segment}, "pedestrian_crossings": {"2": crossing}}
    (folder / "map" / "log_map_archive_x.json").write_text(json.dumps(data))
    return folder


def test_a_log_of_argoverse_2_is_read(tmp_path):
    recording = read_recording(write_log(tmp_path / "log"))
    assert recordings_in([tmp_path]) == [tmp_path / "log"]
    assert recording.account == "3 objects passed over that are no road users (BICYCLE 2, CONSTRUCTION_CONE 1)"
    assert recording.step_s == pytest.approx(0.1)
    user = {each.user_id: each for each in recording.users}
    assert list(user) == ["ego", "car-1", "rider-1"]
    assert recording.ego_id == "ego"
    # near the first place, along y
    assert user["ego"].pose[2] == pytest.approx([0.0, 1.6 + EGO_CENTRE_M, 0.5 * math.pi])
    assert user["car-1"].pose[2] == pytest.approx([-0.5, 1.6 + 10.0, 0.5 * math.pi])
    assert user["car-1"].size_m == (4.6, 1.8, 1.5)
    assert user["rider-1"].category == "bicycle"
    assert user["rider-1"].size_m == (1.9, 0.6, 1.7)  # as large as rider and bicycle
    assert np.abs(user["rider-1"].pose[0, 2]) == pytest.approx(math.pi)
    lane, crossing = recording.lanelets
    assert lane.kinds == ("intersection",)
    assert lane.left_m[0] == pytest.approx([-1.75, -50.0])
    assert lane.right_m[0] - lane.left_m[0] == pytest.approx([LANE_M, 0.0])
    assert crossing.is_crosswalk


def test_bad_logs_are_refused(tmp_path, monkeypatch):
    log = write_log(tmp_path / "two")
    (log / "city_SE3_egovehicle.feather").unlink()
    with pytest.raises(InputError, match=r"city_SE3_egovehicle.feather: expected a table"):
        read_recording(log)
    log = write_log(tmp_path / "three", boxes={"length_m": [math.nan] * 25})
    with pytest.raises(InputError, match=r"road user car-1: length_m: expected 2 to 25 m for a car, got nan"):
        read_recording(log)
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(InputError, match=r'run: pip install "warpav\[av2\]"'):
        read_recording(log)


def as_json(folder):
    return write(folder, street())


def as_commonroad(folder):
    (folder / "a.xml").write_text(scenario("2020a"))
    return folder / "a.xml"


UNKNOWN = [
    (as_json, '"dt_s"', '"offset_s": 3, "dt_s"', "offset_s"),
    (as_json, '"length_m"', '"long_m": 3, "length_m"', "road_users.long_m"),
    (as_json, '"left"', '"wide_m": 3, "left"', "lanelets.wide_m"),
    (as_commonroad, "<trajectory>", "<occupancySet/><trajectory>", "<occupancySet>"),
    (write_waymo, '"valid"', '"offset": 3, "valid"', "objects.offset"),
    (write_waymo, '"geometry"', '"offset": 3, "geometry"', "roads.offset"),
    (write_nuscenes, '"size"', '"velocity": [0, 0, 0], "size"', "velocity"),
    (write_sumo, 'lane="E0_1"', 'lane="E0_1" offset="3"', "offset"),
    (write_interaction, "track_id,frame", "case_id,track_id,frame", "case_id"),
    (write_interaction, 'k="subtype"', 'k="offset" v="3"/><tag k="subtype"', "lanelet offset"),
    (write_ind, "locationId,frameRate", "offset,locationId,frameRate", "offset"),
    (write_highd, "frame,id,x", "offset,frame,id,x", "offset"),
]


@pytest.mark.parametrize(("writer", "old", "new", "key"), UNKNOWN)
def test_a_key_that_is_not_read_is_named(tmp_path, writer, old, new, key):
    writer(tmp_path)
    [recording, *_] = recordings_in([tmp_path])
    assert "not read" not in read_recording(recording).account
    for file in tmp_path.rglob("*"):
        if file.is_file() and old in (text := file.read_text()):
            head, *rows = text.replace(old, new).split("\n")
            rows = [f"1,{row}" if row and file.suffix == ".csv" else row for row in rows]  # the column is the first
            file.write_text("\n".join([head, *rows]))
    assert f"not read: {key}" in read_recording(recording).account


def test_a_column_of_argoverse_2_that_is_not_read_is_named(tmp_path):
    assert "not read: lane_offset" in read_recording(write_forecast(tmp_path / "1", lane_offset=[0.0] * 48)).account
