"""A task runs beside the block, its result is there at the end, and nothing is left over."""

import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest

from warpav.core.errors import InputError
from warpav.core.executor import available_cores, background, gpu_processes, in_background


def wait_for(pair):
    """Answer once the caller has written the file."""
    file, seconds = pair
    end = time.monotonic() + seconds
    while not Path(file).exists():
        if time.monotonic() > end:
            raise InputError(f"{file}: not written")
        time.sleep(0.01)
    return os.getpid()


def die_elsewhere(parent):
    if os.getpid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)
    return "here"


def test_it_runs_while_the_block_does(tmp_path):
    with in_background(wait_for, (tmp_path / "file", 60.0)) as result:
        (tmp_path / "file").touch()
        assert not result.done()
    assert result.result() != os.getpid()


def test_its_error_is_that_of_the_block(tmp_path):
    with pytest.raises(InputError, match="file: not written"), in_background(wait_for, (tmp_path / "file", 0.0)):
        pass


def test_a_block_that_fails_stops_waiting(tmp_path):
    began = time.monotonic()
    with pytest.raises(KeyError), in_background(wait_for, (tmp_path / "file", 20.0)):
        raise KeyError
    assert time.monotonic() - began < 15.0
    (tmp_path / "file").touch()
    while multiprocessing.active_children() and time.monotonic() - began < 60.0:
        time.sleep(0.01)  # the pool's own thread collects its process, so that joining it here may come too early
    assert multiprocessing.active_children() == []


def test_where_its_process_is_killed_it_runs_here():
    with in_background(die_elsewhere, os.getpid()) as result:
        pass
    assert result.result() == "here"


def test_on_one_core_it_runs_after_the_block(monkeypatch, tmp_path):
    monkeypatch.setattr(background, "available_cores", lambda: 1)
    with in_background(wait_for, (tmp_path / "file", 0.0)) as result:
        (tmp_path / "file").touch()
    assert result.result() == os.getpid()


def share_of(_):
    return available_cores(), gpu_processes()


def test_it_has_half_of_the_cores_and_of_the_gpu():
    with in_background(share_of, None) as result:
        pass
    assert result.result() == ((available_cores() // 2, 2) if available_cores() > 1 else (1, 1))
