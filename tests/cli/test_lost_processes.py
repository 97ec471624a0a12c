"""Commands that lose what they run on: a driver that is killed, a Ray head that goes away.

No process stays behind, what was finished is kept and not done again, and the same command then comes to what it comes
to undisturbed.
"""

import contextlib
import importlib.util
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

from tests.experiments.small_experiment import overrides
from tests.optimisation.test_pool import drawn
from warpav.cli.app import main

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")]

needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed")
EXECUTORS = ["process", pytest.param("ray", marks=needs_ray)]
RUNS = 8
EXPERIMENT = ["experiment", "table2", "--arms", "sgd_ifr_doa,random_ifr_doa", "--runs", str(RUNS)]
RAY_AGENTS = ("ray::DashboardA", "ray::RuntimeEnv")
"""They try for a minute to tell the head that it is gone, and then end as well (62 s, seen once)."""
COMMAND = "import sys; from warpav.cli.app import main; sys.exit(main())"
HASTY = f"from warpav.core import executor as ray; ray.GONE_S, ray._ANSWER_S = 4.0, 60.0; {COMMAND}"
"""The command line, which takes a head for gone after 4 s instead of 20, and lets it take its time before."""
DRAW = """
import sys
from pathlib import Path
from tests.optimisation.test_pool import drawn
from warpav.core.executor import Executor
from warpav.core.progress import NullProgress

class Told(NullProgress):
    def steps(self, name, items, *, count=None):
        for number, item in enumerate(items):
            yield item
            print("kept", number, flush=True)

folder, name = Path(sys.argv[1]), sys.argv[2]
drawn(40, executor=Executor(name, worker_count=2), cache=folder, chunk_cameras=1, progress=Told())
"""


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return tmp_path_factory.mktemp("scenes") / "street"


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory, scenes):
    """The experiment in one process; nobody may change it."""
    out = tmp_path_factory.mktemp("undisturbed") / "run"
    assert main([*EXPERIMENT, *overrides(scenes), "--out", str(out)]) == 0
    return out


def session_of(process):
    """All processes of a session, by their numbers."""
    found = {}
    for file in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has just ended
            name, _, numbers = file.read_text().rpartition(")")
            state, _, _, session, *_ = numbers.split()
            if int(session) == process.pid and state not in "ZX":
                found[int(file.parent.name)] = name.partition("(")[2]
    return found


@contextlib.contextmanager
def session(*command):
    """A program that begins a session; all that is left of it in the end is killed."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        "PYTHONUNBUFFERED": "1",
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_AUTH_MODE": "disabled",  # whatever tokens the user has
    }
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True, env=environment
    ) as program:
        try:
            yield program
        finally:
            for number in session_of(program):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(number, signal.SIGKILL)


def line_with(program, words):
    """Read on to the line of a program that has these words."""
    seen = []
    for line in program.stdout:
        if words in line:
            return line
        seen.append(line)
    raise AssertionError(f"{words!r} did not come: {seen} {program.stderr.read()}")


def killed_when(words, *command):
    """Kill a program, and it alone, when it has said some words; all that it started ends."""
    with session(*command) as program:
        line_with(program, words)
        assert len(session_of(program)) > 2  # workers as well
        program.kill()
        program.wait()
        until = time.monotonic() + 30.0  # worst seen 3 s
        while left := [name for name in session_of(program).values() if name not in RAY_AGENTS]:
            assert time.monotonic() < until, f"these stayed: {left}"
            time.sleep(0.1)


def timeless(value):
    """A result without times."""
    if isinstance(value, dict):
        return {name: timeless(each) for name, each in value.items() if name != "seconds"}
    return [timeless(each) for each in value] if isinstance(value, list) else value


def results_of(folder):
    """All results of an experiment but their times, and the bytes of its rigs and of its table."""
    results = {file.name: timeless(json.loads(file.read_text())) for file in folder.glob("results/*.json")}
    return results, {file.name: file.read_bytes() for file in [*folder.glob("results/*.yaml"), folder / "table.md"]}


def finished_in(folder):
    """The results that are there, and when each was written."""
    return {file: file.stat().st_mtime_ns for file in folder.glob("results/*.json")}


def check_goes_on(words, folder, undisturbed):
    """The same command does what is missing, all that and nothing else."""
    finished = finished_in(folder)
    assert 0 < len(finished) < 2 * RUNS
    with session(sys.executable, "-c", COMMAND, *words) as program:
        told = line_with(program, "new results")
        assert program.wait(60) == 0
    assert f"{2 * RUNS - len(finished)} new results" in told
    assert {file: written for file, written in finished_in(folder).items() if file in finished} == finished
    assert results_of(folder) == results_of(undisturbed)


@pytest.mark.parametrize("executor", EXECUTORS)
def test_an_experiment_whose_driver_is_killed_goes_on(tmp_path, scenes, undisturbed, executor):
    folder = tmp_path / "run"
    words = [*EXPERIMENT, *overrides(scenes), "--out", str(folder), "--executor", executor, "--workers", "2"]
    killed_when("run seed", sys.executable, "-c", COMMAND, *words)
    check_goes_on(words, folder, undisturbed)


@pytest.mark.parametrize("executor", EXECUTORS)
def test_a_draw_of_cameras_whose_driver_is_killed_goes_on(tmp_path, executor):
    killed_when("kept 4", sys.executable, "-c", DRAW, str(tmp_path), executor)
    kept = len(list(tmp_path.glob("pool_*.npz")))
    assert 5 <= kept <= 40 * 3  # all, where the signal comes late
    again, undisturbed = drawn(40, cache=tmp_path), drawn(40)
    assert (again.cached_count, again.drawn_count) == (kept, 40 * 3 - kept)
    np.testing.assert_array_equal(again.detection_probability, undisturbed.detection_probability)


@needs_ray
def test_a_ray_head_that_goes_away_ends_the_command_in_one_line(tmp_path, scenes, undisturbed):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    start = [str(Path(sys.executable).with_name("ray")), "start", "--head", "--block", f"--port={port}", "--num-cpus=2"]
    start += ["--include-dashboard=false", "--disable-usage-stats"]
    folder = tmp_path / "run"
    words = [*EXPERIMENT, *overrides(scenes), "--out", str(folder)]
    with (
        tempfile.TemporaryDirectory(prefix="ray-", ignore_cleanup_errors=True) as short,  # sockets have short paths
        session(*start, f"--temp-dir={short}") as head,
    ):
        line_with(head, "Ray runtime started")
        there = ["--executor", "ray", "--address", f"127.0.0.1:{port}"]
        with session(sys.executable, "-c", HASTY, *words, *there) as command:
            line_with(command, "run seed")
            for number in session_of(head):
                os.kill(number, signal.SIGKILL)
            began = time.monotonic()
            assert command.wait(60) == 2
            assert time.monotonic() - began < 30.0  # worst seen 10 s; it is 16 s more by default
            told = command.stderr.read()
    assert re.fullmatch(
        rf"command line \(executor\.address=127\.0\.0\.1:{port}\): executor\.address: expected the Ray cluster at "
        rf"127\.0\.0\.1:{port} to be there until all tasks have ended, got: Connection refused; start it again; .*\n",
        told,
    )
    check_goes_on(words, folder, undisturbed)
