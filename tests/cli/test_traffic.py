"""``warpav scenes traffic``, and recorded traffic in runs."""

import pytest

from tests.scene.traffic.recordings import street, write
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.runs.config import load_config
from warpav.runs.scene_set import load_scenes, recordings_digest


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


def test_a_larger_ego_vehicle_takes_other_places(tmp_path):
    options = ["scenes.source=traffic", "scenes.ego=bus", "scenes.train_seeds=[0]", "run.batch_size=1"]
    [scene] = load_scenes(load_config("quick", options), [0])
    assert scene.ego.bounds_m()[1, 2] == pytest.approx(3.31, abs=0.01)
    low, high = scene.ego.bounds_m()[:, :2]
    assert not any(user.box.meets_m(low, high) for user in scene.road_users)


def test_options_of_recordings_are_left_out_where_they_are_not_set(tmp_path):
    assert not {"recordings", "test_recordings"} & load_config("quick", []).model_dump(mode="json")["scenes"].keys()
    assert recordings_digest(load_config("quick", [])) is None
    shipped = recordings_digest(load_config("quick", ["scenes.source=traffic"]))
    own = [f"scenes.test_recordings={write(tmp_path, street())}", "scenes.source=traffic"]
    assert recordings_digest(load_config("quick", own)) not in (None, shipped)
    with pytest.raises(InputError, match=r"scenes.recordings: expected paths of recorded traffic.*no such file"):
        load_config("quick", ["scenes.source=traffic", "scenes.recordings=nowhere"])
    with pytest.raises(InputError, match=r"scenes.test_recordings: expected null, as scenes.source is not traffic"):
        load_config("quick", own[:1])
