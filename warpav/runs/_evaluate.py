"""Rigs on the scenes of a placement, and those that need no search."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.cache import user_cache_folder
from warpav.core.errors import ArgumentError
from warpav.core.files import atomic_write, writing
from warpav.core.progress import Progress
from warpav.core.warp_setup import checked_device
from warpav.optimisation import (
    AssignedScene,
    CameraMount,
    CameraOutages,
    Constraints,
    Drawing,
    MountTolerance,
    PoolRules,
    SearchSpace,
    attainable_objects,
    highest_mount_pose,
    metrics_of,
    observe_scenes,
)
from warpav.rig import Rig
from warpav.runs._drawn_run import heading_of
from warpav.runs._mounts import camera_mount, constraints_of
from warpav.runs._placement import Placement
from warpav.runs._progress import shown_progress
from warpav.runs._rig_evaluation import RigEvaluation, seen_objects
from warpav.runs._rig_source import check_rig_source, find_rig, is_run_folder
from warpav.runs._run_folder import RunFolder
from warpav.runs._scene_set import first_scene
from warpav.runs.config import Config
from warpav.runs.report._content import read_evaluation
from warpav.scene import DeviceScene, Scene
from warpav.sight import (
    RequirementResult,
    RuleCheck,
    RuleMargin,
    Rules,
    check_requirements,
    check_rigs,
    read_requirements,
)
from warpav.view import Canvas, draws


def evaluate(
    rigs: Rig | Mapping[str, Rig],
    scenes: Sequence[Scene],
    placement: Placement,
    *,
    progress: bool | Progress | None = None,
) -> RigEvaluation:
    """Measure rigs on scenes, with the detector of a placement and around its vehicle. Nothing is written.

    Args:
        rigs: A rig, or several by name. They need not be the placement's: only of rigs with its number and model of
            cameras the objective is known.
        scenes: Scenes that no rig was optimised on.
        placement: Gives the detector, the vehicle, the targets and the objective.
        progress: As of `warpav.runs._optimise.optimise`.

    Raises:
        InputError: There is no rig or no scene, or a scene is around another vehicle.
        TypeError: An argument is of another type.
    """
    if not isinstance(placement, Placement):
        raise TypeError(f"placement: expected a Placement, got {type(placement).__name__}")
    named = {"rig": rigs} if isinstance(rigs, Rig) else dict(rigs)
    if not named:
        raise ArgumentError("rigs", "expected at least one rig, got none")
    for name, rig in named.items():
        if not isinstance(rig, Rig):
            raise TypeError(f"rigs: expected rigs by name, got {type(rig).__name__} as {name!r}")
    with shown_progress(progress) as shown:
        return evaluate_on(named, placement.observed(scenes, progress=shown), placement, progress=shown)


@draws(CameraOutages, "outages", is_figure=True)
def _outages_drawing(outages: CameraOutages, canvas: Canvas) -> Any:  # noqa: ANN401 (see warpav.view._plotting.Kind)
    return _tolerance_drawing(None, canvas, outages=outages)


@draws(MountTolerance, "tolerance", is_figure=True)
def _tolerance_drawing(
    tolerance: MountTolerance | None, canvas: Canvas, *, outages: CameraOutages | None = None
) -> Any:  # noqa: ANN401 (as above)
    from warpav.view import sensitivity_figure

    return sensitivity_figure(tolerance, outages, heading=canvas.title)


@draws(RigEvaluation, "recall", is_figure=True)
def _drawing(evaluation: RigEvaluation, canvas: Canvas) -> Any:  # noqa: ANN401 (see warpav.view._plotting.Kind)
    from warpav.view import recall_figure

    if not evaluation.objects:
        raise ArgumentError("kind", "expected an evaluation with objects, got none")
    headings = {"distance_m": "By distance [m]", "sector": "By sector", "category": "By class"}
    groupings = {
        heading: {heading_of(name): metrics.recall_by[by] for name, metrics in evaluation.metrics.items()}
        for by, heading in headings.items()
    }
    counted = f"{evaluation.scene_count} scenes, {len(evaluation.objects)} objects"
    return recall_figure(groupings, title=canvas.title or f"Share detected at equal false alarms, {counted}")


@draws(RigEvaluation, "differences", is_figure=True)
def _differences_drawing(evaluation: RigEvaluation, _canvas: Canvas) -> Any:  # noqa: ANN401 (as above)
    from warpav.view import differences_figure

    paired = evaluation.paired or evaluation.compared().paired
    rows = {heading_of(other): found.get("misses_at_equal_false_alarms") for other, found in paired.items()}
    known = {name: found for name, found in rows.items() if found and None not in (found.low, found.high)}
    if not known:
        raise ArgumentError("kind", "expected rigs to compare on several scenes, got none")
    return differences_figure(known, heading_of(evaluation.first))


def evaluate_on(
    rigs: Mapping[str, Rig],
    scenes: list[AssignedScene],
    placement: Placement,
    *,
    pairing_rig: Mapping[str, Rig | None] | None = None,
    progress: Progress,
) -> RigEvaluation:
    """Measure rigs on scenes that are on the device."""
    pairing_rig = {} if pairing_rig is None else pairing_rig
    observations = {
        name: observe_scenes(
            rig, placement.assigned(scenes, pairing_rig.get(name, rig)), placement.objective, with_probability=True
        )
        for name, rig in progress.steps("comparing", rigs.items(), count=len(rigs))
    }
    packed = [assigned.scene for assigned in scenes]
    names = {name: [camera.name for camera in rig.cameras] for name, rig in rigs.items()}
    objective = placement.objective
    weight, alike = weights_on(packed, placement), objective.weights_of(packed, alike=True)
    found = {
        name: None if (p := seen.detection_probability) is None else objective.columns_of(p, packed, seen.rig.is_lidar)
        for name, seen in observations.items()
    }
    attainable = attainable_objects(placement.objective, scenes, drawing=Drawing(cache=user_cache_folder("pools")))
    iou_min = placement.objective.options.iou_min
    metrics = {
        name: metrics_of(observed, placement.objective, attainable=attainable)
        for name, observed in observations.items()
    }
    counted = {
        name: observed.at(metrics[name].confidence_at_equal_false_alarms or 0.0, iou_min)
        for name, observed in observations.items()
    }
    return RigEvaluation.of(
        rigs,
        metrics,
        [scene.name for scene in packed],
        seen_objects(counted, packed, rigs),
        camera_outage={
            name: None
            if each is None
            else CameraOutages.of(names[name], each, None if objective.importance is None else weight, alike)
            for name, each in found.items()
        },
        requirements=requirements_of(rigs, placement),
    )


def requirements_of(rigs: Mapping[str, Rig], placement: Placement) -> dict[str, RequirementResult]:
    """What rigs meet of what a placement requires near the vehicle, by name; empty where it requires nothing."""
    points = placement.test_points
    return {} if points is None else check_rigs(rigs, points.world)


def weights_on(scenes: Sequence[DeviceScene], placement: Placement) -> np.ndarray | None:
    """Weights of the objects of scenes, or their columns; None where none are set, or all of these have none."""
    weight = placement.objective.weights_of(scenes)
    return weight if weight is not None and weight.any() else None


def check_rig(
    source: str, config: Config, *, requirements: str, json_file: Path | None = None, image: Path | None = None
) -> Iterator[str]:
    """Check a rig against requirements; lines that say what it meets."""
    from warpav.view import checked_figure, requirement_map

    if image is not None:
        checked_figure(image, (".png",))
    wanted = read_requirements(requirements)
    check_rig_source(source)
    ego = first_scene(config).ego
    rig = find_rig(source, config, ego)
    result = check_requirements(
        rig, ego, wanted, supersampling=config.camera.supersampling, device=checked_device(config.device)
    )
    yield from result.table().splitlines()
    unmet = [
        f"{each.requirement.name} (largest gap: {each.gap.area_m2:.2f} m², {each.gap.sector})"
        for each in result.outcomes
        if not each.is_met and each.gap is not None
    ]
    yield f"not met: {', '.join(unmet)}" if unmet else "all requirements are met"
    if json_file is not None:
        with writing(json_file), atomic_write(json_file) as draft:
            draft.write_text(json.dumps(result.to_json(), indent=1) + "\n", encoding="utf-8")
        yield f"wrote {json_file}"
    if image is not None:
        requirement_map(image, result=result, rig=rig, ego=ego)
        yield f"wrote {image}"


def rule_margins(
    rigs: Mapping[str, Rig], placement: Placement, searched: PoolRules | RigEvaluation | None = None
) -> dict[str, list[RuleMargin]] | None:
    """How far rigs are from breaking the design rules of a placement, with the limits that a search or a run kept.

    None where it keeps none. The gap of a run counts where the placement asks for the same.
    """
    if not placement.config.keeps_rules:
        return None
    asked_deg = math.degrees(placement.config.rules.limits.azimuth_gap_rad or math.inf)
    if isinstance(searched, PoolRules):
        settled, price = searched.settled, searched.price_of_gap
    else:
        settled, price = settled_limits(placement.config, searched)
    is_wider = math.degrees(settled.azimuth_gap_rad or 0.0) > asked_deg + 1e-9
    further = {"asked": asked_deg, "price": price if math.isfinite(price) else None} if is_wider else {}
    return {
        name: [
            replace(each, **further) if each.rule == "azimuth_gap" else each
            for each in RuleCheck(rig, placement.ego, settled).margins
        ]
        for name, rig in rigs.items()
    }


def settled_limits(config: Config, evaluation: RigEvaluation | None) -> tuple[Rules, float]:
    """The limits of the design rules that a run kept, and what the asked gap would have cost; else those asked for."""
    settled, price = config.rules.limits, math.inf
    if evaluation is not None and evaluation.rules:
        of_run = {each.rule: each for each in evaluation.rules.get(evaluation.first, ())}
        gap, near = of_run.get("azimuth_gap"), of_run.get("near_ground")
        asked_deg = math.degrees(settled.azimuth_gap_rad or math.inf)
        settled = replace(settled, near_m=near and near.limit)
        if gap is not None and gap.limit and gap.asked and math.isclose(gap.asked, asked_deg):
            settled = replace(settled, azimuth_gap_rad=math.radians(gap.limit))
            price = math.inf if gap.price is None else gap.price
    return settled, price


def limits_for(source: str, config: Config) -> Rules:
    """The limits by which the rig that ``source`` means is judged: of a run those that it kept."""
    return settled_limits(config, read_evaluation(RunFolder.open(source)) if is_run_folder(source) else None)[0]


def highest_rig(placement: Placement) -> Rig:
    """The cameras of a placement around the highest point of its mount surface, evenly turned, the first forward.

    On zones they stand as far off the skin as their zone lets them.

    Args:
        placement: Gives number and model of the cameras, the vehicle and the constraints; frozen cameras stay.

    Raises:
        InputError: The cameras do not fit.
    """
    mount, constraints, count = _one_by_one(placement)
    return mount.rig(mount.within(mount.off_the_skin(highest_mount_pose(constraints, count))))


def _one_by_one(placement: Placement) -> tuple[CameraMount, Constraints, int]:
    """Mount, constraints and number of a placement's cameras, equal ones each for itself also where they are pairs."""
    config, objective = placement.config, placement.objective
    if config.rig.modules is not None or not placement.mount.is_symmetric:
        return placement.mount, objective.constraints, objective.camera_count
    config = config.replace({"rig.symmetric": False})
    mount = camera_mount(config, placement.ego)
    return mount, constraints_of(config, mount.surface), config.rig.cameras


def random_rig(placement: Placement, seed: int = 0) -> Rig:
    """The cameras of a placement at random positions that satisfy the constraints, in random directions.

    Where zones limit directions, a direction beyond its limits is moved to the nearest one within.

    Args:
        placement: As of `highest_rig`.
        seed: The same seed gives the same rig, at least 0.

    Raises:
        InputError: The cameras do not fit.
    """
    mount, constraints, count = _one_by_one(placement)
    space = SearchSpace.over(mount, count, constraints=constraints)
    return mount.rig(mount.within(space.random(np.random.default_rng(seed)).astype(np.float32)))
