"""The run folder: what it holds, that it opens at any moment, and what it refuses."""

import contextlib
import dataclasses
import json
import math
import os
import subprocess
import sys

import numpy as np
import pytest

from warpav.core.errors import InputError
from warpav.raster.camera import CameraModel
from warpav.rig import Rig, RigCamera, preset_rig, read_rig, write_rig
from warpav.runs import RunFolder
from warpav.runs._checkpoint import check_options
from warpav.runs._run_folder import check_new_run, held_run, new_run_folder
from warpav.runs.config import load_config


@dataclasses.dataclass
class Record:
    iteration: int
    loss: float
    terms: dict
    positions_m: list
    yaw_deg: list
    training_objective: float | None = None


def _record(iteration, loss=1.0):
    return Record(iteration, loss, {"detected_area": np.float32(0.5)}, [[1.0, 0.0, 2.0], [0.0, 1.0, 2.0]], [0.0, 90.0])


def _rig(x_m=1.0):
    return Rig([RigCamera("front", np.array([x_m, 0.0, 1.7]), 0.0, 0.0, 0.0, CameraModel(64, 48))])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A new run folder in an empty working directory."""
    monkeypatch.chdir(tmp_path)
    return RunFolder.create(load_config("quick"), name="quick")


def test_a_new_folder_holds_the_configuration_and_the_environment(folder):
    assert folder.path.as_posix() == "runs/quick"
    assert folder.config() == load_config("quick")
    environment = folder.environment()
    assert environment["seeds"] == {
        "run": 0,
        "train": list(range(60)),
        "validation": [],
        "test": list(range(5000, 5040)),
    }
    assert environment["packages"]["numpy"] == np.__version__
    assert {"warpav", "python", "platform", "device", "command", "started", "git_commit"} <= set(environment)
    assert (folder.path / "checkpoints").is_dir()
    assert (folder.path / "figures").is_dir()


def test_a_run_with_relative_paths_is_used_from_another_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for file in ("mine.onnx", "mine.obj"):
        (tmp_path / file).touch()
    (tmp_path / "mine").mkdir()
    given = ["scenes.source=folder", "scenes.folder=mine", "scenes.ego=mine.obj"]
    config = load_config("quick", [*given, "detector.model=mine.onnx"])
    folder = RunFolder.open(RunFolder.create(config, name="quick").path.absolute())
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    found = folder.config()
    assert found.detector.model == str(tmp_path / "mine.onnx")
    assert (found.scenes.folder, found.scenes.ego) == (tmp_path / "mine", tmp_path / "mine.obj")


def test_a_run_keeps_the_rig_that_it_started_from(tmp_path, monkeypatch):
    """Neither the rig's file nor the place of the folder matters afterwards."""
    monkeypatch.chdir(tmp_path)
    write_rig(_rig(0.7), "mine.yaml")
    config = load_config("quick", ["rig.start=mine.yaml"])
    RunFolder.create(config, name="quick", start=_rig(0.7)).path.rename("moved")
    (tmp_path / "mine.yaml").unlink()
    folder = RunFolder.open("moved")
    assert folder.config().rig.start == str(tmp_path / "moved" / "rig_start.yaml")
    assert read_rig(folder.config().rig.start).cameras[0].position_m[0] == 0.7
    preset = load_config("quick", ["rig.start=nuscenes", "rig.cameras=6"])
    assert RunFolder.create(preset, name="preset", start=preset_rig("nuscenes")).config().rig.start == "nuscenes"


def test_events_and_metrics_come_back(folder):
    for iteration in range(3):
        folder.append_event(_record(iteration, loss=math.nan if iteration == 1 else 2.5))
    events = RunFolder.open(folder.path).events()
    assert [event["iteration"] for event in events] == [0, 1, 2]
    assert [event["loss"] for event in events] == [2.5, None, 2.5]
    assert events[0]["terms"] == {"detected_area": 0.5}
    assert events[0]["positions_m"][1] == [0.0, 1.0, 2.0]
    lines = (folder.path / "metrics.csv").read_text().splitlines()
    assert lines[:2] == ["iteration,loss,terms.detected_area,training_objective", "0,2.5,0.5,"]
    assert len(lines) == 4


def test_a_line_cut_off_by_a_crash_is_left_out(folder):
    folder.append_event(_record(0))
    with (folder.path / "events.jsonl").open("a") as file:
        file.write('{"iteration": 1, "lo')
    assert [event["iteration"] for event in folder.events()] == [0]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"\x00\xff\xfe\n{}\n", r"events\.jsonl:2: expected one JSON object per line, got '\\x00"),
        (b"[1, 2]\n", r"events\.jsonl:2: expected an object, got \[1, 2\]"),
        (b'{"a": 1, "b": 2}\n', r"events\.jsonl:2: iteration: expected a value, got nothing; add iteration"),
        (
            b'{"iteration": 1, "loss": 1, "positions_m": [[1, 2, 3]], "yaw_deg": [0]}\n',
            r"events\.jsonl:2: positions_m: expected 2 cameras as in the lines before, got 1",
        ),
        (
            b'{"iteration": 1, "loss": 1, "positions_m": [[1, 2, null], [1, 2, 3]], "yaw_deg": [0, 0]}\n',
            r"events\.jsonl:2: positions_m\[0\]\[2\]: expected a number",
        ),
        (
            b'{"iteration": 1, "loss": 1, "positions_m": [[1, 2, 3], [1, 2, 3]], "yaw_deg": [0]}\n',
            r"events\.jsonl:2: yaw_deg: expected a number for each of 2 cameras, got \[0",
        ),
        *(
            (json.dumps({**dataclasses.asdict(Record(1, 1.0, {}, [[1, 2, 3]] * 2, [0, 0])), **part}).encode(), message)
            for part, message in [
                ({"loss": "a"}, r"events\.jsonl:2: loss: expected a number, got 'a'"),
                ({"training_objective": []}, r"training_objective: expected a number"),
                ({"terms": {"missed": "a"}}, r"terms\.missed: expected a number, got 'a'"),
                ({"multipliers": [1]}, r"multipliers: expected an object, got \[1\]"),
                ({"gradient": 5}, "gradient: expected an object, got 5"),
                ({"gradient": {"a": 1}}, r"gradient\.a.*: expected a list, got 1"),
                (
                    {"gradient": {"position_per_m": [[0, 1]] * 2, "yaw_per_rad": [0]}},
                    r"gradient\.yaw_per_rad: expected a number for each of 2 cameras, got \[0",
                ),
                ({"free": {"pitch_deg": [1]}}, r"free\.pitch_deg: expected a number for each of 2 cameras"),
            ]
        ),
    ],
)
def test_a_line_that_is_no_iteration_is_named(folder, line, message):
    folder.append_event(_record(0))
    with (folder.path / "events.jsonl").open("ab") as file:
        file.write(line)
    with pytest.raises(InputError, match=f"{message}.*; remove the line"):
        folder.events()


def test_rigs_come_back_and_the_rig_of_the_run_is_one_file(folder):
    with pytest.raises(InputError, match=r"expected rig_best\.yaml, got none; the run has none yet"):
        folder.rig()
    write_rig(_rig(1.0), folder.rig_path("initial"))
    assert folder.rig().cameras[0].position_m[0] == 1.0  # stopped before the first look
    write_rig(_rig(2.0), folder.rig_path("final"))
    write_rig(_rig(3.0), folder.rig_path("best"))
    assert folder.rig().cameras[0].position_m[0] == 3.0
    assert folder.rig("final").cameras[0].position_m[0] == 2.0
    last = RunFolder.create(load_config("quick", ["optimiser.keep=last"]), name="last")
    write_rig(_rig(3.0), last.rig_path("best"))
    write_rig(_rig(2.0), last.rig_path("final"))
    assert last.rig().cameras[0].position_m[0] == 3.0  # rig_best.yaml is the rig of the run whatever is kept


def test_what_a_run_that_has_ended_has_lost_is_missed(folder):
    for role in ("initial", "best", "final"):
        write_rig(_rig(), folder.rig_path(role))
    for iteration in range(3):
        folder.append_event(_record(iteration))
    folder.write_evaluation({"descent": {"iterations": 4}})
    with pytest.raises(InputError, match=r"events.jsonl: expected the 4 iterations of a run that has ended, got 3"):
        folder.events()
    folder.append_event(_record(3))
    assert len(folder.events()) == 4
    (folder.path / "rig_best.yaml").unlink()  # the last iteration's is another rig
    with pytest.raises(InputError, match=r"expected rig_best.yaml, got none; was it removed\?"):
        folder.rig()


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("events.jsonl", lambda folder: folder.append_event(_record(0))),
        ("checkpoints/last.npz", lambda folder: folder.write_checkpoint({"iteration": np.array(1)})),
    ],
)
def test_what_cannot_be_written_is_named(folder, name, write):
    (folder.path / name).unlink(missing_ok=True)
    (folder.path / name).mkdir()
    with pytest.raises(InputError, match=f"{name}: expected a place to write to, got: Is a directory"):
        write(folder)


def test_checkpoint_and_evaluation_come_back(folder):
    folder.write_checkpoint({"pose_value": np.arange(6.0).reshape(2, 3), "iteration": np.array(7)})
    with np.load(folder.path / "checkpoints" / "last.npz", allow_pickle=False) as file:
        assert file["iteration"] == 7
        assert file["pose_value"].shape == (2, 3)
    assert folder.evaluation() is None
    folder.write_evaluation({"scenes": {"test": 2}, "arms": {"optimised": {"ap50_pooled": math.nan}}})
    assert folder.evaluation() == {"schema": 1, "scenes": {"test": 2}, "arms": {"optimised": {"ap50_pooled": None}}}


def test_an_empty_folder_is_welcome_and_a_file_is_not(tmp_path):
    (tmp_path / "empty").mkdir()
    assert RunFolder.create(load_config("quick", [f"run.out={tmp_path}/empty"]), name="x").path.name == "empty"
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"^run\.out: expected a folder to write to, got .* which is a file"):
        check_new_run(load_config("quick", [f"run.out={tmp_path}/file"]))
    with pytest.raises(InputError, match=r"^run\.out: expected a folder that can be made, got"):
        RunFolder.create(load_config("quick", [f"run.out={tmp_path}/file/below"]), name="x")


# --- what a kill leaves -----------------------------------------------------------------------------------------------


def test_a_folder_of_which_no_run_was_made_goes_again(tmp_path):
    config = load_config("quick", [f"run.out={tmp_path / 'a' / 'b'}"])
    with contextlib.suppress(InputError), new_run_folder(config):
        assert (tmp_path / "a" / "b").is_dir()
        raise InputError("too many cameras")
    assert list(tmp_path.iterdir()) == []


def test_one_process_at_a_time_holds_a_folder(folder):
    held = "import time; from warpav.runs._run_folder import RunFolder, held_run\n"
    held += "with held_run(RunFolder.open('runs/quick')): print(1, flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", held], stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"1\n"
        with pytest.raises(InputError, match="expected one that no run writes to"), held_run(folder):
            pass
        other.kill()
    before = sorted(folder.path.rglob("*"))
    with held_run(folder):  # nobody who is dead holds anything
        assert sorted(folder.path.rglob("*")) == before


def test_iterations_that_go_on_are_those_of_the_checkpoint(folder):
    for iteration in range(4):
        folder.append_event(_record(iteration, loss=0.1 + iteration))
    names = ("events.jsonl", "metrics.csv")
    whole = [(folder.path / name).read_bytes() for name in names]
    folder.replace_events(folder.first_events(4))
    assert [(folder.path / name).read_bytes() for name in names] == whole
    folder.replace_events(folder.first_events(2))
    assert [b"".join((folder.path / name).read_bytes().splitlines(True)) for name in names] == [
        b"".join(content.splitlines(True)[:count]) for content, count in zip(whole, (2, 3), strict=True)
    ]
    folder.append_event(_record(2, loss=2.1))
    assert (folder.path / "metrics.csv").read_bytes() == b"".join(whole[1].splitlines(True)[:4])
    with pytest.raises(InputError, match=r"events\.jsonl: expected the 9 iterations of the checkpoint, got 3"):
        folder.first_events(9)
    folder.replace_events([])
    folder.append_event(_record(0, loss=0.1))
    assert (folder.path / "metrics.csv").read_bytes() == b"".join(whole[1].splitlines(True)[:2])


def test_a_checkpoint_is_on_the_disk_before_it_takes_its_place(folder, monkeypatch):
    done, fsync, replace = [], os.fsync, os.replace

    def synced(handle):
        done.append(os.path.basename(os.readlink(f"/proc/self/fd/{handle}")).rpartition("-")[2])
        fsync(handle)

    monkeypatch.setattr("os.fsync", synced)
    monkeypatch.setattr("os.replace", lambda one, other: (done.append("replaced"), replace(one, other)))
    folder.append_event(_record(0))
    folder.write_checkpoint({"iteration": np.array(1)})
    assert done == ["events.jsonl", "last.npz", "replaced", "checkpoints"]
    assert folder.checkpoint()["iteration"] == 1


def test_a_run_may_go_on_where_its_files_lie_elsewhere(tmp_path):
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
    before, after = (
        load_config("quick", ["scenes.source=folder", f"scenes.folder={tmp_path / name}"]) for name in ("one", "other")
    )
    check_options(before, after)  # what they hold is compared with the checkpoint
    with pytest.raises(InputError, match=r"command line \(rig\.cameras\): expected the values of the run"):
        check_options(before, after.replace({"rig.cameras": 3}))
