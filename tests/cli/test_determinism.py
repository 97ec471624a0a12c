"""The same command gives the same bytes, whatever the folder, the threads and the executor; only times differ."""

import os
from pathlib import Path

import pytest

from tests.cli.small_run import RESUMED_POOL as POOL
from tests.cli.test_resume import check_same, stopped
from warpav.cli.app import main
from warpav.core.warp_setup import load_warp
from warpav.runs import RunFolder

pytestmark = pytest.mark.usefixtures("working_directory")


@pytest.fixture
def expected(at_once):
    return at_once("pool")


def hashes_of(folder):
    return RunFolder.open(folder).environment()["hashes"]


@pytest.mark.nightly
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no way to take one core")
def test_one_core_gives_the_bytes_of_all(expected, monkeypatch):
    cores = os.sched_getaffinity(0)
    monkeypatch.setenv(
        "XDG_CACHE_HOME", str(expected.parent / "no_cache")
    )  # nothing is read that another run has drawn
    os.sched_setaffinity(0, {min(cores)})
    try:
        assert main(["optimise", *POOL, "run.out=alone"]) == 0
    finally:
        os.sched_setaffinity(0, cores)
    check_same("alone", expected)
    assert hashes_of("alone") == hashes_of(expected)


@pytest.mark.nightly
def test_processes_give_the_bytes_of_one(expected, monkeypatch):
    kernels = Path(load_warp().config.kernel_cache_dir).parent  # else each process compiles them again
    monkeypatch.setenv("WARP_CACHE_PATH", str(kernels))
    monkeypatch.setenv("XDG_CACHE_HOME", str(expected.parent / "no_cache_either"))
    assert main(["optimise", *POOL, "run.out=apart", "executor.name=process", "executor.workers=2"]) == 0
    check_same("apart", expected)
    known = hashes_of(expected)
    assert hashes_of("apart") == {**known, "configuration": hashes_of("apart")["configuration"]}


def test_hashes_tell_what_is_another(expected, monkeypatch):
    stopped("pool", "another", monkeypatch, "scenes.train_seeds=[0, 2]", "rig.height_offset_m=0.3", after=0)
    found, known = hashes_of("another"), hashes_of(expected)
    assert set(found) == {"configuration", "scenes", "vehicle", "cameras", "detector", "version", "start", "objective"}
    assert {name for name in found if found[name] != known[name]} == {"configuration", "scenes"}
