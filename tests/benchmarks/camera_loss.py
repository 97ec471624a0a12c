"""Rigs that are to bear the loss of a camera against rigs that are not, on town scenes that neither was made on.

A program, not a test: ``python tests/benchmarks/camera_loss.py --device cuda:0 --workers 8 --out FILE``. For each seed
it searches a rig for its expected misses alone, and rigs with ``robust.camera_loss=worst`` of some weights and with
``mean``. Figures are of unseen scenes: expected misses per 100 with all cameras, how many more there are without the
camera that is worst to lose, the recall of the detector; and the differences to the rig of the same seed, with 95 %
intervals.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

import warpav as wa
from warpav.evaluation.statistics import Difference, paired_difference
from warpav.runs.config import Config, load_config

UNSEEN_FROM = 20_000
NOMINAL = "nominal"


def main() -> None:
    """Search, judge, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int, default=1, help="seeds at a time")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--cameras", type=int, default=6)
    parser.add_argument("--fov-deg", type=float, default=110.0)
    parser.add_argument("--weights", default="0.5,0.8", help="of the loss of the worst camera")
    parser.add_argument("--train", type=int, default=40, help="scenes of a search, others for each seed")
    parser.add_argument("--unseen", type=int, default=60, help="scenes that judge")
    parser.add_argument("--pool", type=int, default=128, help="cameras of the first pool of a search")
    parser.add_argument("--out", type=Path, default=Path("camera_loss.json"))
    given = parser.parse_args()
    began = time.perf_counter()
    wa.town([*range(given.seeds * given.train), *range(UNSEEN_FROM, UNSEEN_FROM + given.unseen)])
    settings = {key: str(value) for key, value in vars(given).items() if key != "out"}
    rows: list[dict] = []
    with ProcessPoolExecutor(given.workers, mp_context=get_context("spawn")) as processes:
        for found in processes.map(of_seed, range(given.seeds), [given] * given.seeds):
            rows += found
            print(*map(json.dumps, found), sep="\n", flush=True)  # noqa: T201
            result = {"settings": settings, "rows": rows, "seconds": time.perf_counter() - began}
            given.out.write_text(json.dumps(result, indent=1), encoding="utf-8")


def of_seed(seed: int, given: argparse.Namespace) -> list[dict]:
    """The rigs of a seed: what they miss, what the loss of a camera costs, and how that compares."""
    train = wa.town(range(given.train * seed, given.train * (seed + 1)))
    unseen = list(wa.town(range(UNSEEN_FROM, UNSEEN_FROM + given.unseen)))
    options = [f"device={given.device}", f"optimiser.pool_cameras={given.pool}", f"run.seed={seed}"]
    config = load_config(Config(), options, origin=None)
    robust = {f"worst, {each}": {"camera_loss": "worst", "weight": float(each)} for each in given.weights.split(",")}
    robust = {NOMINAL: None} | robust | {"mean, 0.5": {"camera_loss": "mean", "weight": 0.5}}
    common = {"cameras": given.cameras, "fov_deg": given.fov_deg, "requirements": (), "config": config}
    placements = {name: wa.Placement(train, robust=each, **common) for name, each in robust.items()}
    rigs = {name: wa.optimise(placement).rig for name, placement in placements.items()}
    judge = placements[NOMINAL]
    evaluation = wa.evaluate(rigs, unseen, judge)
    lost = {name: lost_per_scene(rig, judge, unseen) for name, rig in rigs.items()}
    rows = []
    for name in rigs:
        outage = evaluation.camera_outage[name]
        row = {
            "seed": seed,
            "robust": name,
            "expected_misses_per_100": outage.expected_misses_per_100,
            "more_without_worst_camera_per_100": outage.worst.difference_per_100,
            "recall": evaluation.recall[name],
        }
        if name != NOMINAL:
            row["more_less_nominal"] = in_numbers(paired_difference(lost[name], lost[NOMINAL]))
            row["recall_less_nominal"] = in_numbers(evaluation.difference(name, NOMINAL))
        rows.append(row)
    return rows


def in_numbers(found: Difference) -> dict[str, float]:
    return {"mean": found.mean, "low": found.low, "high": found.high}


def lost_per_scene(rig: wa.Rig, placement: wa.Placement, scenes: list[wa.Scene]) -> np.ndarray:
    """Expected misses per 100 that the loss of the worst camera adds, scene by scene; NaN of those without objects."""
    found = [placement.detection_probabilities(rig, [scene]) for scene in scenes]
    missed = [1.0 - np.minimum(each, 0.9999) for each in found]
    without = [each.prod(axis=0) / each - each.prod(axis=0) for each in missed]
    worst = int(np.argmax(np.concatenate(without, axis=1).mean(axis=1)))
    return np.array([100.0 * each[worst].mean() if each.size else np.nan for each in without])


if __name__ == "__main__":
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    main()
