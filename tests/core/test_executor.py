"""Independent tasks: the same outcomes wherever they run, failures that stay where they are, clusters not to be had.

Ray and submitit are extras; tests that need one are skipped without it. ``slurm`` is tested with submitit's processes
of this machine, which it treats like Slurm's but for who starts them.
"""

import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from typing import ClassVar

import numpy as np
import pytest

from warpav.core import cores
from warpav.core import executor as workers
from warpav.core.cores import available_cores, gpu_share
from warpav.core.errors import InputError, OptionError
from warpav.core.executor import Executor, Outcome

needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed")
needs_submitit = pytest.mark.skipif(importlib.util.find_spec("submitit") is None, reason="submitit is not installed")


@pytest.fixture(scope="module")
def importable_tests():
    """Processes that do not descend from this one by multiprocessing find this module as well."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(path for path in sys.path if path))
        patch.setenv("RAY_AUTH_MODE", "disabled")  # whatever tokens the user has
        yield


@pytest.fixture(scope="module", autouse=True)
def _no_ray_stays():
    yield
    if "ray" in sys.modules:
        sys.modules["ray"].shutdown()


@pytest.fixture
def ray_here(importable_tests):
    """A Ray of this machine that ``run_tasks`` finds started, as in a notebook; it outlives the test."""
    import ray

    if not ray.is_initialized():
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    yield ray.get_runtime_context().gcs_address
    assert ray.is_initialized(), "run_tasks ended a Ray that it had not started"


@pytest.fixture
def no_ray_here(importable_tests):
    """This process has no Ray."""
    import ray

    ray.shutdown()


@pytest.fixture
def slurm_here(importable_tests, monkeypatch, tmp_path):
    """Options for Slurm jobs as processes of this machine."""
    from submitit.core.core import Job

    monkeypatch.setattr(Job, "_results_timeout_s", 0.5)  # this file system is not a slow one
    return {"executor": "slurm", "address": "local", "folder": tmp_path / "jobs"}


EXECUTORS = ["process", pytest.param("ray", marks=needs_ray), pytest.param("slurm", marks=needs_submitit)]


def options_of(request, executor):
    """Options for an executor that runs tasks in other processes."""
    if executor == "slurm":
        return request.getfixturevalue("slurm_here")
    if executor == "ray":
        request.getfixturevalue("ray_here")
    return {"executor": executor}


@pytest.fixture(
    params=[
        "process",
        pytest.param("ray", marks=[needs_ray, pytest.mark.nightly]),
        pytest.param("slurm", marks=[needs_submitit, pytest.mark.nightly]),
    ]
)
def elsewhere(request):
    """Options for every executor that runs tasks in other processes; clusters every night."""
    return options_of(request, request.param)


def run_tasks(function, tasks, executor="serial", **options):
    return Executor(executor, **options).map(function, tasks)


def square(number):
    if number == 2:
        raise InputError("two.png: expected three, got two")
    if number == 3:
        raise ValueError("three\n  is odd")
    return number * number


def square_or_die(task):
    number, deadly = task
    if number == deadly:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.05)
    return number * number


EXPECTED = [
    Outcome(0, 0),
    Outcome(1, 1),
    Outcome(2, error="two.png: expected three, got two"),
    Outcome(3, error="ValueError: three is odd"),
    Outcome(4, 16),
]


def test_serial_keeps_the_order_and_goes_on_after_failures():
    assert list(run_tasks(square, range(5))) == EXPECTED


def bits_of(seed):
    """Numbers whose last bits depend on the order of their sums."""
    values = np.random.default_rng(seed).normal(size=1000)
    return np.array([np.exp(values).sum(), np.linalg.norm(values), values.std(), *np.sin(values)]).tobytes()


def square_or_bits(task):
    return square(task) if task < len(EXPECTED) else bits_of(task)


@pytest.mark.parametrize("executor", EXECUTORS)
def test_other_processes_give_the_same_outcomes_bit_for_bit(request, executor):
    options = options_of(request, executor)
    found = sorted(run_tasks(square_or_bits, range(8), **options, worker_count=2), key=lambda outcome: outcome.task)
    assert found[:5] == EXPECTED
    assert found == list(run_tasks(square_or_bits, range(8)))


@pytest.mark.parametrize("name", ["process", "ray", "slurm"])
def test_no_tasks_start_no_process(name):
    assert list(run_tasks(shares, [], executor=name)) == []


def shares(_):
    return available_cores(), gpu_share(8), gpu_share(1)


def process_and_shares(task):
    time.sleep(0.2)
    return os.getpid(), shares(task)


def threads_of_libraries(_):
    import cv2
    from threadpoolctl import threadpool_info

    return {cv2.getNumThreads(), *(each["num_threads"] for each in threadpool_info())}


@pytest.mark.parametrize(
    "worker_count", [pytest.param(1, marks=pytest.mark.nightly), 2, pytest.param(3, marks=pytest.mark.nightly)]
)
def test_as_many_processes_as_asked_for_share_the_machine(worker_count):
    tasks = range(3 * worker_count)
    found = [
        each.result for each in run_tasks(process_and_shares, tasks, executor="process", worker_count=worker_count)
    ]
    numbers, known = ({each[k] for each in found} for k in range(2))
    assert len(numbers) == worker_count
    assert os.getpid() not in numbers
    assert known == {(max(1, available_cores() // worker_count), 8 // worker_count, 1)}


def test_libraries_start_no_more_threads_than_the_share(monkeypatch):
    for variable in cores._THREAD_VARIABLES:
        monkeypatch.delenv(variable, raising=False)
    count = available_cores()
    outcome = next(run_tasks(threads_of_libraries, range(count), executor="process", worker_count=count))
    assert outcome.result == {1} if count > 1 else {count}


@pytest.mark.parametrize(
    ("groups", "own", "expected"),
    [
        ({"cpu.max": "max 100000"}, "0::/", None),
        ({"cpu.max": "250000 100000"}, "0::/", 2),
        ({"cpu.max": "20000 100000"}, "0::/", 1),
        ({"a/cpu.max": "400000 100000", "a/job/cpu.max": "max 100000"}, "0::/a/job", 4),
        ({"cpu.max": "300000 100000"}, "0::/a/job/outside", 3),
        ({"cpu/cpu.cfs_quota_us": "800000", "cpu/cpu.cfs_period_us": "100000"}, "1:cpu,cpuacct:/", 8),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, "1:cpu:/", None),
        ({}, "", None),
        ({"memory.max": "max"}, "0::/", None),
        ({"memory.max": "8000", "job/memory.max": "3000"}, "0::/job", 3000),
        ({"memory/memory.limit_in_bytes": "2000"}, "4:memory:/docker/1", 2000),
        ({"memory/memory.limit_in_bytes": "9223372036854771712"}, "4:memory:/", None),
    ],
)
def test_control_groups_limit_cores_and_memory(tmp_path, monkeypatch, groups, own, expected):
    for name, text in groups.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "own").write_text(own)
    limit = cores._limit_bytes if "memory" in str(groups) else cores._quota_cores
    assert limit(tmp_path, tmp_path / "own") == expected
    monkeypatch.setattr(cores, "available_cores", lambda: 16)
    for limit_bytes, count in ((None, 16), (3 << 30, 3), (1, 1)):
        monkeypatch.setattr(cores, "_limit_bytes", lambda limit_bytes=limit_bytes: limit_bytes)
        assert cores.available_processes() == count


def sleep_or_go(task):
    """The first task ends once the outcome of the second is known."""
    number, file = task
    while number == 0 and not file.exists():
        time.sleep(0.02)
    return number


def test_outcomes_come_as_tasks_finish(elsewhere, tmp_path):
    file = tmp_path / "go"
    found = []
    for outcome in run_tasks(sleep_or_go, [(0, file), (1, file)], **elsewhere, worker_count=2):
        found.append(outcome.result)
        file.touch()
    assert found == [1, 0]


def test_a_task_that_kills_its_process_fails_alone(elsewhere):
    # the deadly task comes while others run and wait: they must not be blamed
    tasks = [(number, 1) for number in range(3)]
    found = {outcome.task[0]: outcome for outcome in run_tasks(square_or_die, tasks, **elsewhere, worker_count=2)}
    assert sorted(found) == list(range(3))
    assert found.pop(1).error == "its process was killed; is there enough memory?"
    assert all(outcome.error is None and outcome.result == number**2 for number, outcome in found.items())


class DeadlyProcesses:
    """Stands in for processes: the task 0 kills itself, and with it all tasks that are under way."""

    counts: ClassVar[list[int]] = []

    def __init__(self, function, worker_count, gpu_count):
        self.counts.append(worker_count)
        self.function = function

    def start(self, tasks):
        return tasks  # a task is its own handle

    def wait(self, handles):
        self.are_killed = 0 in handles
        return list(handles)

    def outcome(self, handle):
        if self.are_killed:
            raise workers._WorkerKilledError
        return workers.outcome_of(self.function, handle)

    def close(self, handles):
        assert not handles


def test_what_was_killed_is_tried_again_by_a_quarter_as_many_and_so_on(monkeypatch):
    monkeypatch.setattr(workers, "Processes", DeadlyProcesses)
    monkeypatch.setattr(DeadlyProcesses, "counts", [])
    outcomes = list(run_tasks(abs, list(range(40)), executor="process", worker_count=33))
    assert DeadlyProcesses.counts == [33, 8, 2, 1]
    assert [outcome.task for outcome in outcomes] == [*range(33, 40), *range(8, 33), *range(2, 8), 1, 0]
    assert [outcome.task for outcome in outcomes if outcome.error] == [0]


def lack_memory(task):
    """Fail, one as Warp does where a GPU's memory does not suffice, one as Python does; 5 always, others once."""
    number, folder = task
    if number in (0, 1, 5) and (number == 5 or not (folder / str(number)).exists()):
        (folder / str(number)).touch()
        if number == 1:
            raise MemoryError
        raise RuntimeError("Failed to allocate 35389440 bytes on device 'cuda:0'")
    return number


def test_what_lacked_memory_is_tried_again_after_the_others_and_fails_with_what_it_said(elsewhere, tmp_path):
    tasks = [(number, tmp_path) for number in range(6)]
    outcomes = list(run_tasks(lack_memory, tasks, **elsewhere, worker_count=2))
    assert sorted(outcome.result for outcome in outcomes[:3]) == [2, 3, 4]
    assert sorted(outcome.task[0] for outcome in outcomes[3:]) == [0, 1, 5]
    assert {outcome.result for outcome in outcomes if outcome.error is None} == set(range(5))
    [failed] = [outcome for outcome in outcomes if outcome.error is not None]
    assert failed.error == "RuntimeError: Failed to allocate 35389440 bytes on device 'cuda:0'"
    assert list(run_tasks(lack_memory, tasks[5:])) == [failed]  # serial: there is nobody to wait for


def test_leaving_early_within_a_long_result_lets_the_program_end():
    """A process that is ended while it hands over a result leaves the rest of it out."""
    program = (
        "from warpav.core.executor import Executor\n"
        "outcomes = Executor('process', 4).map(bytes, [80_000_000] * 20)\n"
        "next(outcomes); outcomes.close()\n"
    )
    assert subprocess.run([sys.executable, "-c", program], timeout=60, check=False).returncode == 0


@pytest.mark.parametrize("name", ["serial", "process", "ray", "slurm"])
def test_no_workers_are_refused(name):
    with pytest.raises(OptionError, match=r"^executor\.workers: expected 1 or more, .* got 0$"):
        list(run_tasks(square, [1], executor=name, worker_count=0))


@pytest.mark.parametrize(("name", "package", "extra"), [("ray", "ray", "ray"), ("slurm", "submitit", "slurm")])
def test_a_missing_package_says_how_to_get_it(name, package, extra, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(OptionError, match=rf'^executor\.name: .*package {package} .*pip install "warpav\[{extra}\]"$'):
        list(run_tasks(square, [1], executor=name))


@needs_ray
@pytest.mark.parametrize("address", ["somewhere", "host:", ":6379", "host:99999", "http://host"])
def test_a_ray_address_without_host_and_port_is_refused(address, no_ray_here):
    with pytest.raises(
        OptionError, match=r"^executor\.address: expected host:port, ray://host:port, auto or local, got"
    ):
        list(run_tasks(square, [1], executor="ray", address=address))


@needs_ray
@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_a_ray_address_where_nobody_listens_is_refused_at_once(scheme, no_ray_here):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    began = time.perf_counter()
    with pytest.raises(
        OptionError, match=rf"^executor\.address: .* got '{scheme}127.0.0.1:{port}': Connection refused; "
    ):
        list(run_tasks(square, [1], executor="ray", address=f"{scheme}127.0.0.1:{port}"))
    assert time.perf_counter() - began < 5.0  # worst seen 0.1 s


@needs_ray
def test_a_host_that_listens_but_does_not_answer_is_refused_in_seconds(no_ray_here, monkeypatch):
    monkeypatch.setattr("warpav.core.executor._ANSWER_S", 3.0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        began = time.perf_counter()
        with pytest.raises(OptionError, match=r"^executor\.address: .*: no answer within 3 s; start one with"):
            list(run_tasks(square, [1], executor="ray", address=address))
    assert time.perf_counter() - began < 10.0  # worst seen 3.1 s; Ray's own patience is above 90 s


@needs_ray
def test_a_wrong_option_of_ray_is_refused(ray_here):
    with pytest.raises(OptionError, match=r"^executor\.options: expected options of ray\.remote, got: .*num_gpu\b"):
        list(run_tasks(square, [1], executor="ray", options={"num_gpu": 1}))


@needs_submitit
@pytest.mark.parametrize("options", [{"part": "fast"}, {"slurm_part": "fast"}, {"timeout_min": "long"}])
def test_a_wrong_option_of_slurm_is_refused(options, slurm_here):
    with pytest.raises(OptionError, match=r"^executor\.options: expected parameters of submitit, got: [^\n]+$"):
        list(run_tasks(square, [1], **slurm_here, options=options))


@needs_submitit
@pytest.mark.skipif(shutil.which("srun") is not None, reason="Slurm is here")
def test_slurm_that_is_not_here_is_refused(tmp_path):
    with pytest.raises(OptionError, match=r"^executor\.name: expected Slurm's commands on this machine"):
        list(run_tasks(square, [1], executor="slurm", folder=tmp_path))


def test_processes_end_with_the_one_that_started_them():
    """One that is killed cannot end them; they had stayed for ever, each with its memory."""
    program = (
        "import time; from warpav.core.executor import Processes\n"
        "pool = Processes(eval, 1)\n"
        "print(pool.outcome(pool.start(['__import__(\"os\").getpid()'])[0]).result, flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as driver:
        worker = int(driver.stdout.readline())
        driver.kill()
        try:
            for _ in range(200):
                os.kill(worker, 0)
                time.sleep(0.1)
            os.kill(worker, signal.SIGKILL)
            is_left = True
        except ProcessLookupError:
            is_left = False
    assert not is_left


@pytest.mark.parametrize(("executor", "expected"), [("serial", "expected 1 with"), ("process", "expected at most 2")])
def test_gpus_that_are_not_there_are_refused(monkeypatch, executor, expected):
    monkeypatch.setattr("warp.get_cuda_device_count", lambda: 2)
    with pytest.raises(OptionError, match=f"executor.gpus: {expected}"):
        list(run_tasks(str, [1], executor=executor, gpu_count=3))
