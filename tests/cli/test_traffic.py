"""``warpav scenes traffic``, and recorded traffic in runs."""

import gzip
import json

import pytest

from tests.scene.traffic.recordings import street, track, write
from tests.scene.traffic.test_files import BOMB, scenario
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.runs import load_scenes
from warpav.runs.config import load_config
from warpav.scene import read_scenes


def test_scenes_of_recordings_are_written_once(tmp_path, capsys):
    file = write(tmp_path, street(), "street.json.gz")
    command = ["scenes", "traffic", str(file), "--seeds", "0..1", "--out", str(tmp_path / "out")]
    assert main(command) == 0
    assert sorted(each.name for each in (tmp_path / "out").glob("*.glb")) == ["scene_0.glb", "scene_1.glb"]
    assert main(command) == 0
    said = capsys.readouterr()
    assert (said.out + said.err).count("is there already") == 2


def test_a_bad_recording_is_one_line_and_leaves_nothing(tmp_path, capsys):
    file = write(tmp_path, street(dt_s=0.1))
    assert main(["scenes", "traffic", str(file), "--count", "1", "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "dt_s 0.5 would fit" in said
    assert not (tmp_path / "out").exists()


def without_sizes():
    data = street()
    for user in data["road_users"]:
        del user["length_m"], user["width_m"]
    return data


def mirrored():
    """Y to the right, as in image coordinates, with headings counter-clockwise: what turns left drives to the right."""
    users = [track(str(k), "car", (4.5, 1.8), (-30.0 + 20.0 * k, -1.75), 0.0, 8.0) for k in range(4)]
    data = street(users=users, turn_rad=0.8)
    for user in data["road_users"]:
        user["y_m"] = [-each for each in user["y_m"]]
    return data


TOO_LARGE = [
    track("a", "bus", (12.0, 2.5), (0.0, -1.75), 0.0, 8.0),
    track("b", "truck", (9.0, 2.5), (30.0, 1.75), 0.0, 8.0),
]
ALONE = street()["road_users"][:1]
EMPTY = {**street()["road_users"][0], "t": [], "x_m": [], "y_m": [], "yaw_rad": [], "v_mps": []}


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", json.dumps(without_sizes()), "road user a: length_m: expected a value, got nothing"),
        ("a.json", json.dumps(street(users=TOO_LARGE)), "expected a road user about as large as the ego vehicle"),
        ("a.json", json.dumps(street(users=ALONE)), "got none: they are empty"),
        (
            "a.json",
            json.dumps(street(users=[EMPTY])),
            "expected as many positions, yaws and speeds as steps, at least one",
        ),
        ("a.json", json.dumps(street(dt_s=500.0)), "dt_s: expected the time between two steps, up to 5 s, got 500"),
        ("a.json", json.dumps(mirrored()), "yaw_rad: expected headings counter-clockwise from x"),
        ("a.json.gz", gzip.compress(json.dumps(street()).encode())[:-20], "got: Compressed file ended"),
        ("a.xml", scenario("2020a")[:-900], "expected a whole CommonRoad scenario, got a syntax error: unclosed token"),
        ("a.xml.gz", gzip.compress(scenario("2020a").encode())[:-20], "got: Compressed file ended"),
        ("a.xml", scenario("2020a").replace("?>\n", f"?>\n{BOMB}", 1), "expected XML without a DOCTYPE"),
        (
            "a.xml",
            scenario("2020a").replace("UTF-8", "UTF-16").replace("?>\n", f"?>\n{BOMB}", 1).encode("utf-16"),
            "expected XML without a DOCTYPE",
        ),
    ],
)
def test_bad_recordings_are_one_line_and_leave_nothing(tmp_path, capsys, name, content, message):
    """Also beside good ones, and in Python."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    file = folder / name
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    command = ["scenes", "traffic", str(folder), "--count", "1", "--out", str(tmp_path / "out")]
    assert main(command) == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    assert f"{file}: " in said.err
    assert message in said.err
    assert not said.out
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError) as error:
        read_scenes(file)
    assert message in str(error.value)


def test_what_is_left_out_is_one_line_a_recording(tmp_path, capsys):
    data = street()
    data["road_users"].append({**data["road_users"][0], "id": "twin"})
    data["road_users"][2]["length_m"] = 400.0
    file = write(tmp_path, data)
    assert main(["scenes", "traffic", str(file), "--count", "1", "--out", str(tmp_path / "out")]) == 0
    line = capsys.readouterr().out.splitlines()[0]
    assert line == (
        f"{file}: 1 of 6 road users left out (length_m 1), such as road user c: length_m: expected 2.5 to 30 m for a "
        "truck, got 400; sizes and positions must be in metres; 1 of 5 road users left out where they overlap others "
        "by more than 0.3 m, and 6 moments with such an overlap at the ego vehicle"
    )
    [scene] = read_scenes(tmp_path / "out")
    assert "left out for overlaps: a; 1 of 6 road users left out (length_m 1)" in scene.source


def test_archives_that_unpack_without_end_are_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("warpav.scene.traffic.formats._json.DATA_SET_BYTES_MAX", 2**20)
    file = tmp_path / "bomb.json.gz"
    file.write_bytes(gzip.compress(b" " * (2**20 + 1)))
    assert main(["scenes", "traffic", str(file), "--count", "1", "--out", str(tmp_path / "out")]) == 2
    assert "bomb.json.gz: expected recorded traffic of at most 1 MB, got more" in capsys.readouterr().err


def test_test_scenes_come_from_recordings_of_their_own(tmp_path):
    for name in ("one", "two", "three"):
        write(tmp_path, street(id=name), f"{name}.json")
    config = load_config("quick", ["scenes.source=traffic", f"scenes.recordings={tmp_path}", "scenes.train_seeds=0..3"])
    name_of = {
        part: {scene.source.split()[0] for scene in load_scenes(config, seeds)}
        for part, seeds in (("train", range(4)), ("test", config.scenes.test_seeds[:3]))
    }
    assert name_of["train"] <= {"one", "three"}
    assert name_of["test"] == {"two"}
