"""Fixtures shared by all tests: devices, random numbers, folders of outside assets."""

import os
from pathlib import Path

import numpy as np
import pytest
import warp as wp

wp.config.log_level = 30


def _devices():
    yield pytest.param("cpu", id="cpu")
    yield pytest.param(
        "cuda:0",
        id="cuda",
        marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")],
    )


@pytest.fixture(params=list(_devices()))
def device(request):
    """Every Warp device that the test can run on."""
    return request.param


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
