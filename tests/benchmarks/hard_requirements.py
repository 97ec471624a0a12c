"""The polish with hard requirements: inequalities and rejection against rejection alone, from the same rigs.

A program, not a test: ``python tests/benchmarks/hard_requirements.py --case car --seeds 6``. For each seed a pool is
drawn and the best rig of it selected that meets the hard requirements; this rig is polished twice, with as many camera
renders at most. A line for each seed: the objective before, and of each arm the objective after, steps that were
allowed and refused, and seconds.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace

import numpy as np

import warpav as wa
from tests.optimisation.calls import polish, pool_search
from warpav.core.errors import InputError
from warpav.optimisation.objective import single_cameras_of
from warpav.optimisation.pool_search import PoolSearchSettings
from warpav.optimisation.required_points import RequiredPoints
from warpav.optimisation.single_cameras import hard_points
from warpav.requirements.area import Band, Strip
from warpav.requirements.read import read_requirements
from warpav.requirements.requirement import Requirement
from warpav.runs.config import load_config

STEPS, RADIUS = 16, 0.4
ARMS = ("rejection", "inequalities")


def requirements_of(case: str) -> list[Requirement]:
    """What has to be seen: like R158 behind a car, or with `surround`, its four fisheyes in pairs, all round one."""
    rear = read_requirements("r158_like")[0]
    if case == "surround":
        near = read_requirements("near_field")[0]
        return [
            replace(near, weight=None, share=1.0, area=Band((0.0, 5.0)), grid_m=1.0, visible_share=0.9, pixels=300.0)
        ]
    return [replace(rear, area=Strip("rear", (1.5, 3.5)), grid_m=0.3)]


def main() -> None:
    """Polish twice, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", default="car", choices=("car", "two", "surround"))
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--scenes", type=int, default=8, help="of a search, others for each seed")
    parser.add_argument("--pool", type=int, default=96)
    settings = parser.parse_args()
    rows = []
    for seed in range(settings.first_seed, settings.first_seed + settings.seeds):
        try:
            rows.append(of_seed(seed, settings))
        except InputError as error:
            print(json.dumps({"seed": seed, "error": str(error)[:300]}), flush=True)  # noqa: T201
            continue
        print(json.dumps(rows[-1]), flush=True)  # noqa: T201
    mean = np.mean([[row[arm]["objective"] for arm in ARMS] for row in rows], axis=0)
    counts = np.sum([[[row[arm][name] for name in ("allowed", "refused")] for arm in ARMS] for row in rows], axis=0)
    print(json.dumps({"mean": mean.round(5).tolist(), "allowed, refused": counts.tolist()}))  # noqa: T201


def of_seed(seed: int, settings: argparse.Namespace) -> dict:
    """Both polishes of a seed's rig."""
    first = 400 + settings.scenes * seed
    surround = settings.case == "surround"
    config = load_config("surround" if surround else "quick", [f"run.seed={seed}", "requirements=null"])
    if surround:
        config = load_config(config, ["rig.modules={fisheye_1_3mp_190: 4}"])
    else:
        config = load_config(config, [f"rig.cameras={2 if settings.case == 'two' else 4}"])
    config = load_config(config, [f"scenes.train_seeds={first}..{first + settings.scenes - 1}"])
    placement = wa.Placement.from_config(config)
    cameras = single_cameras_of(placement.objective)
    assert cameras is not None
    scenes = [each.scene for each in placement.search_scenes]
    ghosts = RequiredPoints(requirements_of(settings.case), placement.ego)
    limits = placement.limits
    count = placement.objective.camera_count if limits is None else limits.count[1]
    selecting = PoolSearchSettings(pool_cameras=settings.pool, polishes=False, selection_time_s=10.0, gap=1e-3)
    *_, found = pool_search(
        cameras,
        scenes,
        placement.objective.constraints,
        count,
        settings=selecting,
        seed=seed,
        requirements=ghosts,
        limits=limits,
    )
    row: dict = {"seed": seed, "points": ghosts.vehicle_count, "before": round(found.objective, 5)}
    for arm in ARMS:
        row[arm] = polished(arm, found.mount_pose, cameras, scenes, ghosts, placement.objective.constraints)
    return row


def polished(arm, start, cameras, scenes, ghosts, constraints) -> dict:
    """How a polish ends."""
    verdicts: list[bool] = []

    def is_allowed(probability: np.ndarray) -> bool:
        verdicts.append(ghosts.is_kept(probability[:, -ghosts.vehicle_count :]))
        return verdicts[-1]

    all_scenes = [*scenes, ghosts]
    began = time.perf_counter()
    *_, last = polish(
        start,
        lambda pose: cameras.with_jacobian(pose, all_scenes),
        mount=cameras.mount,
        constraints=constraints.of_any_modules,
        scene_count=len(all_scenes),
        weight=ghosts.weights_with(None, sum(scene.vehicle_count for scene in scenes)),
        camera_renders_max=(1 + STEPS) * len(start) * len(all_scenes),
        step_count=STEPS,
        radius=RADIUS,
        is_allowed=is_allowed,
        hard_points=hard_points(cameras, ghosts) if arm == "inequalities" else None,
    )
    seconds = time.perf_counter() - began
    assert ghosts.is_kept(cameras.detection_probability(last.mount_pose, ghosts))
    return {
        "objective": round(last.objective, 5),
        "allowed": sum(verdicts),
        "refused": len(verdicts) - sum(verdicts),
        "camera_renders": last.camera_renders,
        "seconds": round(seconds, 1),
    }


if __name__ == "__main__":
    main()
