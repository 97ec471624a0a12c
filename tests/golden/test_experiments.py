"""Rows of three experiments: every run by arm and seed, to 1e-4."""

import csv

import pytest

SMALL = [
    *("scenes.train_seeds=[0, 1]", "scenes.test_seeds=[1000, 1001]", "rig.cameras=2", "run.batch_size=1"),
    *("camera.width_px=64", "camera.height_px=64", "run.iterations=2", "losses.probability=visible_share"),
]
EXPERIMENTS = {
    "table2": ["table2", "--arms", "sgd_ifr_doa,random_ifr_doa", "--runs", "2"],
    "open": ["open", "--arms", "random,highest", "--runs", "2", "--budget", "16"],
    "rivals": [
        *("rivals", "--setting", "dense_2_rack", "--arms", "default,highest,descent_by_hand", "--runs", "2"),
        *("--budget", "400", "optimiser.pool_cameras=16"),
    ],
}
NUMBERS = ("objective", "detection_rate", "misses_per_100", "false_alarms_per_image", "ap50", "camera_renders")


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_rows(warpav, golden, tmp_path, name):
    out = tmp_path / "study"
    status, _, err = warpav("experiment", *EXPERIMENTS[name], *SMALL, "--out", out)
    assert status == 0, err
    with (out / "rows.csv").open() as file:
        runs = [row for row in csv.DictReader(file) if row["seed"]]
    found = {f"{row['arm']} {row['seed']}": [float(row[each]) for each in NUMBERS if row[each]] for row in runs}
    golden(f"experiment_{name}", found, rtol=1e-4, atol=1e-4)
