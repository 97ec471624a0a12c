"""Fixtures shared by all tests: devices, random numbers, folders of outside assets; and how the suite is spread."""

import gc
import os
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from hypothesis import settings
from threadpoolctl import threadpool_limits

from warpav.core.cores import available_cores

wp.config.log_level = 30
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")
MOST_WORKERS, MOST_WORKERS_ON_A_GPU = 8, 4


def pytest_report_header():
    return None if wp.is_cuda_available() else "no CUDA device: tests of cuda:0 are not collected"


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist's own, which acts on the options
def pytest_cmdline_main(config):
    """Spread the whole suite over the cores; what is named on the command line runs in this process, but for ``-n``.

    Files stay together, as their fixtures are expensive, and come in order: the type checker is in the first.
    """
    option = config.option
    is_whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    is_spread = getattr(option, "numprocesses", 0) is None and option.dist == "no"
    if not is_whole or not is_spread or option.usepdb or option.collectonly or option.benchmark_only:
        return
    if "PYTEST_XDIST_WORKER" in os.environ:
        return
    option.numprocesses = min(available_cores(), MOST_WORKERS_ON_A_GPU if wp.is_cuda_available() else MOST_WORKERS)
    option.dist = "loadfile"
    option.loadscopereorder = False


def pytest_configure(config):
    """Each process of pytest-xdist has cores of its own, and as many threads: those that wait take time of others."""
    worker = getattr(config, "workerinput", None)
    if worker is not None and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))[int(worker["workerid"].removeprefix("gw")) :: worker["workercount"]]
        if cores:
            os.sched_setaffinity(0, cores)
            threadpool_limits(len(cores))  # NumPy's were started for all cores


def pytest_collection_finish():
    """What is imported and collected stays: searches for what nothing reaches pass it by.

    An experiment makes one an arm, which among the objects of the whole suite would take a second each.
    """
    gc.collect()
    gc.freeze()


def _devices():
    yield pytest.param("cpu", id="cpu")
    if wp.is_cuda_available():
        yield pytest.param("cuda:0", id="cuda", marks=pytest.mark.gpu)


@pytest.fixture(params=list(_devices()))
def device(request):
    """Every Warp device that the test can run on."""
    return request.param


@pytest.fixture
def working_directory(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


SEARCHING = {"cli", "experiments", "optimisation", "runs", "view", "test_api.py"}


@pytest.fixture(scope="module", autouse=True)
def short_polish(request):
    """Searches by a pool in this process take three steps where they polish, not up to sixteen; till ``undo()``."""
    with pytest.MonkeyPatch.context() as patch:
        if request.path.relative_to(Path(__file__).parent).parts[0] in SEARCHING:
            for name in ("_FIRST_POLISH", "_FURTHER_POLISH", "_LAST_POLISH"):
                patch.setattr(f"warpav.optimisation._pool_search.{name}", (3, 0.4))
        yield patch


@pytest.fixture
def rng():
    """Random numbers with a fixed seed."""
    return np.random.default_rng(0)


def _folder(variable):
    value = os.environ.get(variable)
    if not value or not Path(value).is_dir():
        pytest.skip(f"{variable} names no folder")
    return Path(value)


@pytest.fixture
def asset_folder():
    """Outside detectors and photographs (see CONTRIBUTING.md); the test is skipped without them."""
    return _folder("WARPAV_TEST_ASSETS")


@pytest.fixture
def workload_folder():
    """Outside benchmark workloads with their truth; the test is skipped without them."""
    return _folder("WARPAV_TEST_WORKLOADS")


@pytest.fixture
def pool_folder():
    """Outside pools of rendered cameras, their detection probabilities; the test is skipped without them."""
    return _folder("WARPAV_TEST_POOLS")


@pytest.fixture
def vehicle_folder():
    """Outside vehicle meshes as downloaded, with their textures; the test is skipped without them."""
    return _folder("WARPAV_TEST_VEHICLES")


@pytest.fixture
def traffic_folder():
    """Outside recordings of traffic (`sind_json`, `ngsim_json`); the test is skipped without them."""
    return _folder("WARPAV_TEST_TRAFFIC")
