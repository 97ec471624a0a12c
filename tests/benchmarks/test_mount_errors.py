"""Rigs that are to bear errors of mounting against rigs that are not, on town scenes that neither was made on.

Left out of the ordinary run; ``pytest tests/benchmarks/test_mount_errors.py --benchmark-only --benchmark-json FILE``
runs it, some ten minutes a case on two cores. Extra figures are what the rigs are expected to miss of 100 as designed
and with errors by chance, which are others than those of the search, and the differences with 95 % intervals.
"""

import math

import numpy as np
import pytest

import warpav as wa
from warpav.evaluation.statistics import paired_difference
from warpav.optimisation.miss_rate import expected_miss_rate
from warpav.optimisation.mount_errors import COLUMNS, MountErrors, outside_skin
from warpav.optimisation.objective import single_cameras_of
from warpav.optimisation.single_cameras import MisplacedCameras

CAMERAS, FOV_DEG = 6, 90.0
SCENES, UNSEEN, DRAWS = 40, range(20000, 20060), 48


def misses_per_scene(rig, placement, scenes, errors, seed=1):
    """Expected misses per 100 with errors by chance, scene by scene; NaN of those without objects.

    Every camera has draws of its own, and the mean is over all combinations of them.
    """
    cameras, pose = single_cameras_of(placement.objective), placement.mount_pose_of(rig)
    rng = np.random.default_rng(seed)
    off = np.tile(pose.astype(np.float64), (DRAWS, 1, 1))
    off[..., list(COLUMNS.values())] += errors.tolerance * rng.uniform(-1.0, 1.0, (DRAWS, len(pose), len(COLUMNS)))
    off = outside_skin(off, pose, cameras.mount).reshape(-1, pose.shape[1])
    found = []
    for each in placement.observed(scenes):
        seen = cameras.detection_probability(off, each.scene).reshape(DRAWS, len(pose), -1).mean(axis=0)
        found.append(100.0 * expected_miss_rate(seen) if seen.size else np.nan)
    return np.array(found)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("error_m", "error_deg"), [(0.05, 3.0), (0.02, 1.0)])
def test_what_errors_cost(benchmark, error_m, error_deg, seed):
    train, unseen = list(wa.town(range(100 * seed, 100 * seed + SCENES))), list(wa.town(UNSEEN))
    robust = {"mount_error_m": error_m, "mount_error_deg": error_deg}
    placements = {
        name: wa.Placement(train, cameras=CAMERAS, fov_deg=FOV_DEG, requirements=(), robust=options)
        for name, options in (("nominal", None), ("robust", robust))
    }
    found = {}

    def search():
        for name, placement in placements.items():
            found[name] = wa.optimise(placement, seed=seed)

    benchmark.pedantic(search, rounds=1)
    errors = MountErrors(error_m, math.radians(error_deg))
    for kind, each in (("as designed", MountErrors()), ("with errors", errors)):
        misses = {
            name: misses_per_scene(result.rig, placements["nominal"], unseen, each) for name, result in found.items()
        }
        benchmark.extra_info[kind] = {name: float(np.nanmean(values)) for name, values in misses.items()}
        benchmark.extra_info[f"{kind}, robust - nominal"] = str(paired_difference(misses["robust"], misses["nominal"]))
    misplaced = MisplacedCameras.of(single_cameras_of(placements["nominal"].objective), errors)
    pose = placements["nominal"].mount_pose_of(found["nominal"].rig)
    scenes = [each.scene for each in placements["nominal"].search_scenes]
    seen = np.concatenate([misplaced.detection_probability(pose, scene) for scene in scenes], axis=1)
    objective = {"nominal": expected_miss_rate(seen), "robust": found["robust"].objective}
    benchmark.extra_info["objective with errors"] = objective
    benchmark.extra_info["bound"] = found["robust"].bound
    # small errors change the objective less than the search differs from run to run
    assert objective["robust"] < 1.02 * objective["nominal"]
