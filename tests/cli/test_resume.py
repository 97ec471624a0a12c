"""``warpav optimise --resume``: runs that are stopped, killed, or out of disk go on to what they come to at once."""

import errno
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import warp as wp

import warpav as wa
from tests.cli.small_run import RESUMED_POOL as POOL
from tests.cli.small_run import RUNS, complaint
from warpav.cli.app import main
from warpav.core.files import DRAFT
from warpav.runs import RunFolder

pytestmark = pytest.mark.usefixtures("working_directory")

GPU = wp.is_cuda_available()
SHORT_POLISH = """
import warpav.optimisation._pool_search as search
search._FIRST_POLISH = search._FURTHER_POLISH = search._LAST_POLISH = (3, 0.4)
"""
COMMAND = f"{SHORT_POLISH}import sys; from warpav.cli.app import main; sys.exit(main())"
KILLED_AT_A_FILE = f"""{SHORT_POLISH}
import os, signal, sys
left, replace = int(sys.argv.pop(1)), os.replace

def killed(draft, file):
    global left
    left -= 1
    if not left:
        os.kill(os.getpid(), signal.SIGKILL)
    replace(draft, file)

os.replace = killed
from warpav.cli.app import main
sys.exit(main())
"""
"""A run that is killed when so many files were written, but the last one is not in its place yet."""


def optimised(name, *overrides):
    assert main(["optimise", *RUNS[name][1], *overrides]) == 0


def stopped(name, folder, monkeypatch, *overrides, after=2):
    """A run that Ctrl-C ends after some steps."""
    search, options = RUNS[name]
    step = search.step

    def interrupted_later(self):
        if self.iteration == after:
            raise KeyboardInterrupt
        return step(self)

    with monkeypatch.context() as patch:
        patch.setattr(search, "step", interrupted_later)
        assert main(["optimise", *options, f"run.out={folder}", *overrides]) == 130


def check_same(found, expected):
    """The same run but for times."""
    one, other = RunFolder.open(found), RunFolder.open(expected)

    def events(folder):
        return [{**event, "seconds": None} for event in folder.events()]

    def numbers(folder):
        names, *rows = [line.split(",") for line in (folder.path / "metrics.csv").read_text().splitlines()]
        kept = [k for k, name in enumerate(names) if not name.startswith("seconds")]
        return names, [[row[k] for k in kept] for row in rows]

    assert events(one) == events(other)
    assert numbers(one) == numbers(other)
    for role in ("initial", "best", "final"):
        assert one.rig_path(role).read_bytes() == other.rig_path(role).read_bytes()
    assert {**one.evaluation(), "seconds": None} == {**other.evaluation(), "seconds": None}
    files = [
        {file.relative_to(folder.path).as_posix() for file in folder.path.rglob("*") if file.is_file()}
        for folder in (one, other)
    ]
    assert files[0] == files[1]
    for name in files[0]:
        if name.endswith((".png", "further_cameras.csv")):
            assert (one.path / name).read_bytes() == (other.path / name).read_bytes(), name


@pytest.mark.parametrize(
    "name",
    [
        *("pool", "descent", pytest.param("thesis", marks=pytest.mark.nightly)),
        *(pytest.param(f"{name} on a GPU", marks=pytest.mark.gpu) for name in ("pool", "descent") if GPU),
    ],
)
def test_a_stopped_run_goes_on_to_what_it_comes_to_at_once(at_once, monkeypatch, capsys, working_directory, name):
    expected = at_once(name)
    stopped(name, "stopped", monkeypatch, after=3)
    assert "warpav optimise --resume stopped goes on" in capsys.readouterr().out
    (working_directory / "stopped" / "figures" / f"{DRAFT}0-rig.png").write_bytes(b"half")
    with (working_directory / "stopped" / "events.jsonl").open("a") as file:
        file.write('{"iteration": 3, "lo')  # cut off
    assert main(["optimise", "--resume", "stopped"]) == 0
    check_same("stopped", expected)
    [resumed] = RunFolder.open("stopped").environment()["resumed"]
    assert resumed["iteration"] == 3


def test_a_run_that_is_stopped_after_its_last_step_is_completed(at_once, monkeypatch):
    """It may have an evaluation already, and a report that somebody asked for."""

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("warpav.runs.report.report.write_report", interrupted)
        assert main(["optimise", *POOL, "run.out=stopped"]) == 130
    assert RunFolder.open("stopped").evaluation() is not None
    assert main(["report", "stopped"]) == 0
    assert main(["optimise", "--resume", "stopped"]) == 0
    check_same("stopped", at_once("pool"))


def test_a_run_that_has_ended_stays_as_it_is_and_goes_on_with_more(at_once, working_directory, capsys):
    shutil.copytree(at_once("pool"), "run")
    before = {file: file.read_bytes() for file in (working_directory / "run").rglob("*") if file.is_file()}
    result = wa.resume("run")
    assert {file: file.read_bytes() for file in (working_directory / "run").rglob("*") if file.is_file()} == before
    folder = RunFolder.open("run")
    assert result.objective == folder.evaluation()["training_objective"]["optimised"]
    assert len(result.records) == len(folder.events())
    further = wa.resume("run", options={"optimiser.pool_rounds": 2, "optimiser.pool_gap": 0.0})
    assert further.objective <= result.objective
    assert folder.config().optimiser.pool_rounds == 2
    events = folder.events()
    assert [event["iteration"] for event in events] == list(range(len(events)))
    assert [event["stage"] for event in events].count("pricing") == 2
    assert len(events) == len(further.records) == folder.evaluation()["descent"]["iterations"] > len(result.records)
    metrics = (working_directory / "run" / "metrics.csv").read_text().splitlines()
    assert len(metrics) == 1 + len(events)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["camera.fov_deg=80", "rig.cameras=3"], r"command line (rig.cameras, camera.fov_deg): expected the values of"),
        (["run.iterations=2"], "command line (run.iterations=2): run.iterations: expected at least the 14 of the run"),
        (["thesis"], "command line (--resume): expected no configuration, as the run has its own, got thesis"),
        (["run.iterations=a"], "command line (run.iterations=a): run.iterations: expected a whole number"),
    ],
)
def test_what_may_not_change_is_one_line(at_once, capsys, words, message):
    run = at_once("pool")
    count = len(RunFolder.open(run).events())
    capsys.readouterr()
    found = complaint(capsys, "optimise", *words, "--resume", str(run))
    assert found.startswith(message.replace("14", str(count)))


@pytest.mark.parametrize("name", ["scenes", "vehicle", "cameras", "detector", "version"])
def test_a_run_of_something_else_is_refused_by_its_content(at_once, capsys, working_directory, name):
    shutil.copytree(at_once("pool"), "run")
    folder = RunFolder.open("run")
    state = folder.checkpoint()
    identity = json.loads(str(state["identity"]))
    folder.write_checkpoint({**state, "identity": np.array(json.dumps({**identity, name: "0"}))})
    before = (working_directory / "run" / "events.jsonl").read_bytes()
    capsys.readouterr()
    message = complaint(capsys, "optimise", "--resume", "run")
    assert message.startswith(f"checkpoint: {name}: expected the ")
    assert (working_directory / "run" / "events.jsonl").read_bytes() == before


def test_what_holds_no_run_that_can_go_on_is_one_line(at_once, capsys, working_directory):
    (working_directory / "empty").mkdir()
    assert "expected a folder written by warpav optimise" in complaint(capsys, "optimise", "--resume", "empty")
    assert "expected an existing folder" in complaint(capsys, "optimise", "--resume", "none")
    shutil.copytree(at_once("pool"), "run")
    folder = RunFolder.open("run")
    capsys.readouterr()
    checkpoint = working_directory / "run" / "checkpoints" / "last.npz"
    whole = checkpoint.read_bytes()
    checkpoint.write_bytes(whole[:1000])
    assert "last.npz: expected arrays in NumPy's format" in complaint(capsys, "optimise", "--resume", "run")
    folder.write_checkpoint({"iteration": np.array(2)})
    message = complaint(capsys, "optimise", "--resume", "run")
    assert message == "checkpoint: expected one that a run can go on from, got one of an earlier version"
    checkpoint.write_bytes(whole)
    (working_directory / "run" / "events.jsonl").unlink()
    assert "events.jsonl: expected the 1" in complaint(capsys, "optimise", "--resume", "run")


@pytest.mark.parametrize("place", ["append_event", "write_checkpoint"])
def test_ctrl_c_between_a_step_and_what_is_written_of_it_loses_nothing(at_once, monkeypatch, place):
    write, calls = getattr(RunFolder, place), []

    def interrupted(self, *arguments):
        calls.append(None)
        if len(calls) == 4:
            raise KeyboardInterrupt
        write(self, *arguments)

    expected = at_once("pool")
    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, place, interrupted)
        assert main(["optimise", *POOL, "run.out=stopped"]) == 130
    folder = RunFolder.open("stopped")
    events = [{**event, "seconds": None} for event in folder.events()]
    assert events == [{**event, "seconds": None} for event in RunFolder.open(expected).events()[:4]]
    assert folder.checkpoint()["iteration"] == 4


@pytest.mark.parametrize("number", [errno.ENOSPC, pytest.param(errno.EROFS, marks=pytest.mark.nightly)])
def test_a_disk_that_is_full_loses_nothing(at_once, capsys, monkeypatch, number):
    replace, written = os.replace, []

    def full(draft, file):
        if "checkpoints" in str(file):
            written.append(file)
        if len(written) > 2:
            raise OSError(number, os.strerror(number))
        replace(draft, file)

    expected = at_once("pool")
    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr("os.replace", full)
        assert main(["optimise", *POOL, "run.out=full"]) == 2
    captured = capsys.readouterr()
    assert captured.err == f"full/checkpoints/last.npz: expected a place to write to, got: {os.strerror(number)}\n"
    assert "warpav optimise --resume full goes on" in captured.out
    assert RunFolder.open("full").rig().cameras
    assert main(["optimise", "--resume", "full"]) == 0
    check_same("full", expected)


def begun(*words, command=COMMAND):
    arguments = [sys.executable, "-c", command, *words]
    return subprocess.Popen(
        arguments,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),  # whoever started pytest may ignore it
    )


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGTERM, 143), pytest.param(signal.SIGHUP, 129, marks=pytest.mark.nightly)]
)
def test_signals_end_as_ctrl_c_does(working_directory, number, status):
    process = begun("optimise", *POOL, "run.out=run")
    events = working_directory / "run" / "events.jsonl"
    while process.poll() is None and not (events.is_file() and events.read_text().count("\n") >= 2):
        time.sleep(0.01)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == status
    assert err.splitlines()[-1] == f"interrupted by {number.name}"
    assert "warpav optimise --resume run goes on" in out
    folder = RunFolder.open("run")
    assert folder.rig().cameras
    assert int(folder.checkpoint()["iteration"]) >= 2
    assert main(["report", "run"]) == 0


def check_whole(path):
    """Whatever a kill has left opens, and no more than a step is lost."""
    folder = RunFolder.open(path)
    events, state = folder.events(), folder.checkpoint()
    assert len(events) - (0 if state is None else int(state["iteration"])) in (0, 1)
    folder.evaluation()
    if events:
        assert folder.rig().cameras
        assert main(["report", str(path)]) == 0


def kill(words, rng):
    """Start a command and kill it: at any time, or between a file's draft and the file; whether it had ended."""
    if rng.random() < 0.5:
        process = begun(str(rng.randint(1, 60)), *words, command=KILLED_AT_A_FILE)
    else:
        process = begun(*words)
        try:
            process.wait(rng.uniform(2.0, 20.0))
        except subprocess.TimeoutExpired:
            process.kill()
    _, err = process.communicate()
    assert process.returncode in (0, -signal.SIGKILL), err
    return process.returncode == 0


def killed_run(working_directory, folder, rng, *, most):
    """A run that is killed and goes on, so often at most, until it has ended; returns how often."""
    for count in range(most):
        path = working_directory / folder
        is_begun = (path / "config.yaml").is_file()
        if kill(["optimise", "--resume", folder] if is_begun else ["optimise", *POOL, f"run.out={folder}"], rng):
            return count
        if (path / "config.yaml").is_file():
            check_whole(path)
    assert main(["optimise", "--resume", folder]) == 0
    return most


@pytest.mark.parametrize("files", [9, pytest.param(12, marks=pytest.mark.nightly)])
def test_a_run_that_is_killed_while_a_file_is_written_goes_on(at_once, working_directory, files):
    expected = at_once("pool")
    process = begun(str(files), "optimise", *POOL, "run.out=run", command=KILLED_AT_A_FILE)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert list((working_directory / "run").rglob(f"{DRAFT}*"))
    check_whole(working_directory / "run")
    assert main(["optimise", "--resume", "run"]) == 0
    check_same("run", expected)


@pytest.mark.nightly
def test_a_run_that_is_killed_at_twenty_random_moments_comes_to_what_it_comes_to_at_once(at_once, working_directory):
    expected, rng, kills, runs = at_once("pool"), random.Random(0), 0, 0
    while kills < 20:
        runs += 1
        kills += killed_run(working_directory, f"run_{runs}", rng, most=20 - kills)
        check_same(f"run_{runs}", expected)
