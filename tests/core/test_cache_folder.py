"""A cache folder: what goes, and what another run may be using."""

import os
import shutil
import time
from types import SimpleNamespace

import pytest

from warpav.core import cache as cache_folder


@pytest.fixture
def folder(tmp_path):
    """Three files of 100 bytes: one used long ago, one ten minutes ago, one now."""
    for name, age_s in (("old", 2.0 * cache_folder.IN_USE_S), ("used", 600.0), ("new", 0.0)):
        (tmp_path / name).write_bytes(bytes(100))
        os.utime(tmp_path / name, (time.time() - age_s,) * 2)
    return tmp_path


def left_in(folder, capacity_bytes):
    cache_folder.remove_oldest(folder, "*", capacity_bytes=capacity_bytes)
    return {file.name for file in folder.iterdir()}


def test_what_another_run_may_be_using_stays(folder):
    assert left_in(folder, 300) == {"old", "used", "new"}
    assert left_in(folder, 100) == {"used", "new"}


def test_on_a_full_disk_the_capacity_counts(folder, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(total=1000, used=950, free=50))
    assert left_in(folder, 100) == {"new"}


def test_a_folder_that_is_not_there_is_empty(tmp_path):
    cache_folder.remove_oldest(tmp_path / "none", "*", capacity_bytes=0)
