"""Rows of two experiments: numbers that they print in their tables, to 1e-3."""

import re

import pytest

from tests.golden.conftest import numbers

SMALL = [
    *("scenes.train_seeds=[0, 1]", "scenes.test_seeds=[1000, 1001]", "rig.cameras=2", "run.batch_size=1"),
    *("camera.width_px=64", "camera.height_px=64", "run.iterations=2", "losses.probability=visible_share"),
]
EXPERIMENTS = {
    "table2": ["table2", "--arms", "sgd_ifr_doa,random_ifr_doa", "--runs", "2"],
    "open": ["open", "--arms", "random,highest", "--runs", "2", "--budget", "16"],
}


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_rows(warpav, golden, tmp_path, name):
    out = tmp_path / "study"
    status, printed, err = warpav("experiment", *EXPERIMENTS[name], *SMALL, "--out", out)
    assert status == 0, err
    rows = [line for line in printed.splitlines() if line.startswith("|") or re.match(r" *\w+ .*\d\.\d", line)]
    rows = [row for row in rows if " thesis " not in row]
    assert rows, printed
    golden(f"experiment_{name}", [numbers(row) for row in rows], rtol=1e-3, atol=1e-3)
