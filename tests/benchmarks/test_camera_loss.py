"""Rigs that are to bear the loss of a camera against rigs that are not, on town scenes that neither was made on.

Left out of the ordinary run; ``pytest tests/benchmarks/test_camera_loss.py --benchmark-only --benchmark-json FILE``
runs it, some five minutes on two cores. Extra figures are expected misses per 100 with all cameras, and how many more
there are without the camera that is worst to lose; the recall of the detector; and the differences with 95 % intervals.
"""

import numpy as np
import pytest

import warpav as wa
from warpav.evaluation.statistics import paired_difference

CAMERAS, FOV_DEG = 6, 110.0
SCENES, UNSEEN = 40, range(20000, 20060)
ROBUST = {"camera_loss": "worst", "weight": 0.5}


def loss_per_scene(rig, placement, scenes):
    """Expected misses per 100 that the loss of the worst camera adds, scene by scene; NaN of those without objects."""
    found = [placement.detection_probabilities(rig, [scene]) for scene in scenes]
    missed = [1.0 - np.minimum(each, 0.9999) for each in found]
    without = [each.prod(axis=0) / each - each.prod(axis=0) for each in missed]
    worst = int(np.argmax(np.concatenate(without, axis=1).mean(axis=1)))
    return np.array([100.0 * each[worst].mean() if each.size else np.nan for each in without])


@pytest.mark.parametrize("seed", [0, 1])
def test_what_the_worst_loss_costs(benchmark, seed):
    train, unseen = list(wa.town(range(100 * seed, 100 * seed + SCENES))), list(wa.town(UNSEEN))
    placements = {
        name: wa.Placement(train, cameras=CAMERAS, fov_deg=FOV_DEG, requirements=(), robust=robust)
        for name, robust in (("nominal", None), ("robust", ROBUST))
    }
    found = {}

    def search():
        for name, placement in placements.items():
            found[name] = wa.optimise(placement, seed=seed)

    benchmark.pedantic(search, rounds=1)
    rigs = {name: result.rig for name, result in found.items()}
    evaluation = wa.evaluate(rigs, unseen, placements["nominal"])
    outage = evaluation.camera_outage
    worst = {name: outage[name].worst.difference_per_100 for name in rigs}
    per_scene = {name: loss_per_scene(rig, placements["nominal"], unseen) for name, rig in rigs.items()}
    recall = evaluation.difference("robust", "nominal")
    benchmark.extra_info["expected misses per 100"] = {name: outage[name].expected_misses_per_100 for name in rigs}
    benchmark.extra_info["lost with the worst camera"] = worst
    benchmark.extra_info["lost, robust - nominal"] = str(paired_difference(per_scene["robust"], per_scene["nominal"]))
    benchmark.extra_info["recall"] = evaluation.recall
    benchmark.extra_info["recall, robust - nominal"] = str(recall)
    benchmark.extra_info["objective and bound"] = {name: (each.objective, each.bound) for name, each in found.items()}
    assert worst["robust"] < worst["nominal"]
