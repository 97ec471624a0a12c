"""Arms of an experiment: named search methods, all on the same scenes and at the same budget of renders.

The budget counts scene renders: one scene drawn in all views of a rig. Unless it is given, it is what the gradient
method of the arm's own configuration spends, including its evaluations of all validation scenes; the other searches get
the same.
"""

from __future__ import annotations

import difflib
import importlib.util
import json
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from warpav.core.errors import ArgumentError, InputError
from warpav.optimisation.baselines import highest_mount_pose, random_mount_pose
from warpav.optimisation.descent import Descent
from warpav.optimisation.moved_preset import move_to_vehicle
from warpav.optimisation.pool_descent import PoolDescent
from warpav.optimisation.rivals import (
    affordable_iterations,
    cma_es,
    detections_of,
    differential_evolution,
    gradient_renders,
    greedy_cover,
    random_search,
    sobol_search,
)
from warpav.optimisation.search import BudgetedValue, Search, SearchRecord, SearchSpace, run_search
from warpav.optimisation.segregation import BatchChooser
from warpav.rig.presets import preset_names, preset_rig
from warpav.rig.rig import Rig
from warpav.runs.config import Config, changed_config, load_config, option_values
from warpav.runs.optimise import Optimisation
from warpav.runs.placement import Placement, Stream
from warpav.runs.rig_source import read_start

CMA_SHARE = 0.5
"""Share of the budget that CMA-ES has before the gradient method takes over."""

GREEDY_DIRECTIONS = 8
"""Directions that greedy cover evaluates at each position."""


@dataclass(frozen=True)
class FoundRig:
    """A rig that an arm found.

    Attributes:
        rig: The rig.
        began_as: The rig that it began as, see `Placement.assigned`; None when camera k took orientation k.
        renders: Scene renders that finding it took.
        history: Columns of numbers, one per step or evaluation: ``renders``, ``seconds`` and ``best_value`` so far, on
            the scenes that the method compares rigs on, and with the gradient method ``loss``.
        training_objective: Its objective on all validation scenes; None if not evaluated.
        mount_pose: Its mount poses, float32 [camera, 7]; None for cameras that are not level.
        notes: What else is worth knowing, by name.
    """

    rig: Rig
    began_as: Rig | None
    renders: int
    history: dict[str, list[float | None]]
    training_objective: float | None = None
    mount_pose: np.ndarray | None = None
    notes: dict[str, Any] = field(default_factory=dict)


Finder = Callable[[Placement, int | None], FoundRig]
"""Finds a rig on a placement; its random numbers come from ``run.seed``, its budget [scene renders] may be None."""


@dataclass(frozen=True)
class Arm:
    """A search method with its options.

    Attributes:
        name: Its name, also in file names: lower-case letters, digits and underscores.
        method: A key of `METHODS`, or the name of a preset.
        overrides: Options that make the arm, such as ``losses.detected_area=0``; they also apply to the evaluation of
            its rigs.
        search_overrides: Options for the search alone; the evaluation ignores them.
    """

    name: str
    method: str
    overrides: tuple[str, ...] = ()
    search_overrides: tuple[str, ...] = ()

    @property
    def is_seeded(self) -> bool:
        """Whether another run seed may give another rig."""
        return self.method not in _SEEDLESS and self.method not in preset_names()

    @property
    def own_overrides(self) -> tuple[str, ...]:
        """The options that set it apart from other arms; the thesis's whole method is not taken apart."""
        return self.overrides if self.name in common_arms() else (*self.overrides, *self.search_overrides)

    def evaluation_config(self, config: Config) -> Config:
        """The configuration that its rigs are evaluated with.

        Raises:
            InputError: The arm's options do not fit the rest.
        """
        return changed_config(config, self.overrides)

    def search_config(self, config: Config) -> Config:
        """The configuration that it searches by.

        Raises:
            InputError: The arm's options do not fit the rest.
        """
        return changed_config(config, (*self.overrides, *self.search_overrides))

    def check(self, config: Config, render_budget: int | None) -> None:
        """Reject early what would fail in every run.

        Raises:
            InputError: A package is missing, the arm's options do not fit the rest, or the budget is too small.
        """
        config = self.search_config(config)
        package = _PACKAGES.get(self.method)
        if package and importlib.util.find_spec(package) is None:
            raise InputError(
                f"arm {self.name}: expected the package {package} to be installed, got none; "
                "run: pip install 'warpav[rivals]'"
            )
        if config.rig.freeze and self.method not in _HOLDING:
            raise InputError(
                f"arm {self.name}: rig.freeze: expected none, since it places all cameras, got "
                f"{', '.join(config.rig.freeze)}; leave the arm or the option out"
            )
        if self.method in _DESCENDING or config.rig.freeze:
            read_start(config)
        least = self._least_renders(config)
        if render_budget is not None and render_budget < least:
            raise InputError(
                f"arm {self.name}: `budget`: expected at least {least} scene renders, got {render_budget}; raise it, "
                "or leave it out for as many as the gradient method spends"
            )

    def _least_renders(self, config: Config) -> int:
        """Scene renders without which its search cannot even begin."""
        train_count = len(config.scenes.train_seeds) * (1 + config.scenes.mirror)
        ranked_count = min(config.baselines.random_scenes, train_count)
        looked_at_count = len(config.scenes.validation_seeds or ()) or train_count
        one_step = gradient_renders(config.optimiser, looked_at_count, iterations=1, batch_size=config.run.batch_size)
        if self.method == "gradient":
            return one_step
        if self.method == "cma_then_gradient":
            return max(math.ceil(one_step / (1.0 - CMA_SHARE)), math.ceil(ranked_count / CMA_SHARE))
        if self.method == "random_batches":
            return config.run.batch_size
        if self.method == "greedy_cover":  # one position in all directions, and the evaluation of the rig
            return ranked_count * (math.ceil(GREEDY_DIRECTIONS / config.rig.cameras) + 1)
        return ranked_count if self.method in METHODS and self.is_seeded else 1


def find_rig_of(arm: Arm, placement: Placement, render_budget: int | None) -> FoundRig:
    """The rig that an arm finds.

    Args:
        arm: The arm.
        placement: What to search on, with the arm's search options.
        render_budget: Scene renders that it may spend; None: as many as the gradient method of the configuration.

    Raises:
        InputError: The budget is too small, or something that the arm needs is missing.
    """
    finder = METHODS.get(arm.method) or partial(_preset, name=arm.method)
    return finder(placement, render_budget)


def find_arm(name: str, arms: Mapping[str, Arm]) -> Arm:
    """The arm of this name: one of the given ones, or one of `common_arms`.

    Raises:
        OptionError: There is none.
    """
    every = {**common_arms(), **arms}
    if name in every:
        return every[name]
    near = difflib.get_close_matches(name, list(every), 1, 0.5)
    hint = f"; did you mean {near[0]}?" if near else ""
    names = ", ".join(dict.fromkeys([*arms, *every]))
    raise ArgumentError("arms", f"expected names out of {names}, got {name!r}{hint}")


def common_arms() -> dict[str, Arm]:
    """Arms by name that fit every experiment, under the losses of its configuration: one of each method and preset.

    ``gradient`` is the gradient method of the configuration. ``thesis_as_printed`` is that of the shipped configuration
    ``thesis``, ``thesis_gradient`` a hybrid of both (`thesis_method`); they are evaluated like all others.
    """
    arms = [
        Arm("thesis_gradient", "gradient", search_overrides=thesis_method()),
        Arm("thesis_as_printed", "gradient", search_overrides=thesis_as_printed()),
        *(Arm(name, name) for name in (*METHODS, *preset_names())),
    ]
    return {arm.name: arm for arm in arms}


def common_fov_deg(preset: str) -> float:
    """The horizontal field of view that most cameras of a preset have, to a tenth of a degree."""
    angles = [round(math.degrees(camera.model.fov_rad), 1) for camera in preset_rig(preset).cameras]
    return Counter(angles).most_common(1)[0][0]


def gradient_like(preset: str) -> Arm:
    """The gradient method with as many cameras as a preset and its most frequent field of view.

    All cameras of an objective share one model, so a preset's odd fields of view have no counterpart; `odd_fields` says
    which.
    """
    overrides = (f"rig.cameras={len(preset_rig(preset).cameras)}", f"camera.fov_deg={common_fov_deg(preset)}")
    return Arm(f"gradient_as_{preset}", "gradient", overrides)


def odd_fields(preset: str) -> str:
    """In words, how the fields of view of a preset differ from those of its counterpart, `gradient_like`."""
    common = common_fov_deg(preset)
    angles = [math.degrees(camera.model.fov_rad) for camera in preset_rig(preset).cameras]
    odd = [f"{angle:.1f}" for angle in angles if abs(angle - common) > 1.0]
    differ = f", but {' and '.join(odd)} in the preset" if odd else ""
    return f"gradient_as_{preset}: {len(angles)} cameras of {common:g} deg{differ}"


def thesis_method() -> tuple[str, ...]:
    """Overrides for a search with the thesis's losses, occlusion, optimiser and bounding rectangle.

    A hybrid: batch size, start, iterations and the detector's thresholds stay those of the configuration.
    """
    return _thesis_options("method", "losses", "visibility", "optimiser")


def thesis_as_printed() -> tuple[str, ...]:
    """Overrides for a search by the whole shipped configuration ``thesis``.

    The task stays that of the configuration: scenes, number and model of the cameras, detection network.
    """
    whole = _thesis_options(
        *("method", "run.iterations", "run.batch_size", "rig", "mount", "detector", "segregation", "losses"),
        *("visibility", "optimiser"),
    )
    task = ("rig.cameras", "rig.freeze", "detector.")
    thresholds = ("detector.confidence_min", "detector.iou_min", "detector.nms_iou_max")
    return tuple(each for each in whole if not each.startswith(task) or each.startswith(thresholds))


def _thesis_options(*parts: str) -> tuple[str, ...]:
    """Overrides with the values of the shipped configuration ``thesis``, of whole sections or single options."""
    values = option_values(load_config("thesis"))
    return tuple(
        f"{name}={json.dumps(value)}"
        for name, value in values.items()
        if any(f"{name}.".startswith(f"{part}.") for part in parts)
    )


def constraint_loss(placement: Placement, mount_pose: np.ndarray) -> float:
    """The broken constraints of a rig together, scaled as in the Lagrangian (the thesis's table III)."""
    objective = placement.objective
    terms = objective.evaluate(mount_pose, placement.train[:1]).terms
    broken = sum(max(terms[name], 0.0) for name in objective.constraints.names)
    return objective.constraint_scale * broken


def _gradient(placement: Placement, render_budget: int | None) -> FoundRig:
    """The gradient method of the configuration, from the start of the configuration."""
    placement = _within(placement, render_budget)
    optimisation = Optimisation.begin(placement)
    starts = placement.config.optimiser.starts
    return _descended(placement, optimisation.descent, optimisation.began_as, start_count=starts if starts > 1 else 0)


def _within(placement: Placement, render_budget: int | None) -> Placement:
    """The same placement with as many iterations as a budget pays for, or as the configuration says."""
    if render_budget is None:
        return placement
    config = placement.config
    iterations = affordable_iterations(
        config.optimiser, len(placement.validation), render_budget, batch_size=config.run.batch_size
    )
    return placement.with_config(changed_config(config, [f"run.iterations={iterations}"]))


def _from_one_start(placement: Placement) -> Placement:
    """The same placement, whose descent tries no other starts."""
    return placement.with_config(changed_config(placement.config, ["optimiser.starts=1", "optimiser.descents=1"]))


def _descended(
    placement: Placement, descent: Descent | PoolDescent, began_as: Rig | None, *, start_count: int = 0
) -> FoundRig:
    """The rig at the end of a descent, preceded by the given number of evaluations on all validation scenes."""
    batch_size = placement.config.run.batch_size
    history: dict[str, list[float | None]] = {name: [] for name in ("renders", "seconds", "best_value", "loss")}
    began = time.perf_counter()

    def renders() -> int:
        return descent.iteration * batch_size + (start_count + len(descent.candidates)) * len(placement.validation)

    while descent.iteration < placement.config.run.iterations and descent.verdict is None:
        record = descent.step()
        row = (renders(), time.perf_counter() - began, record.best_training_objective, record.loss)
        for column, number in zip(history.values(), row, strict=True):
            column.append(number)
    unprojected = descent.mount_pose
    result = descent.finish()
    return FoundRig(
        placement.objective.mount.rig(result.mount_pose),
        began_as,
        renders(),
        history,
        training_objective=result.training_objective,
        mount_pose=result.mount_pose,
        notes={"unprojected_constraint_loss": constraint_loss(placement, unprojected), "stopped": descent.verdict},
    )


def _start(placement: Placement, render_budget: int | None) -> FoundRig:
    """The rig that the gradient method starts from."""
    del render_budget
    begun = Optimisation.begin(_from_one_start(placement))
    return FoundRig(begun.start, begun.began_as, 0, {}, mount_pose=begun.descent.start)


def _random_rig(placement: Placement, render_budget: int | None) -> FoundRig:
    """A random feasible rig with random directions, without evaluation."""
    del render_budget
    space = SearchSpace.over(
        placement.objective.mount, placement.config.rig.cameras, constraints=placement.objective.constraints
    )
    pose = space.random(placement.random_numbers(Stream.SEARCH)).astype(np.float32)
    return FoundRig(placement.objective.mount.rig(pose), placement.frozen_rig, 0, {}, mount_pose=pose)


def _highest(placement: Placement, render_budget: int | None) -> FoundRig:
    """Cameras around the highest point."""
    del render_budget
    mount = placement.objective.mount
    pose = highest_mount_pose(placement.objective.constraints, placement.config.rig.cameras).astype(np.float32)
    pose = mount.within(pose)
    found = mount.rig(pose)
    return FoundRig(found, found, 0, {}, mount_pose=pose)


def _preset(placement: Placement, render_budget: int | None, *, name: str) -> FoundRig:
    """A known rig, moved to the vehicle."""
    del render_budget
    mount = placement.objective.mount
    moved = move_to_vehicle(
        preset_rig(name), mount, placement.ego, constraints=placement.objective.constraints, image=mount.camera
    )
    notes = {"moved_m": moved.moved_m, "blocked_share": moved.blocked_share}
    return FoundRig(moved.rig, moved.rig, 0, {}, notes=notes)


def _random_batches(placement: Placement, render_budget: int | None) -> FoundRig:
    """The thesis's random arm: as many random rigs as a descent has iterations, each on a batch of its own.

    The lowest value wins, so the luck of the batch helps to choose; `random_search` on fixed scenes does not have that.
    """
    config, objective = placement.config, placement.objective
    rng = placement.random_numbers(Stream.SEARCH)
    batches = BatchChooser(placement.train, config.rig.cameras, placement.random_numbers(Stream.BATCHES))
    count = config.run.iterations if render_budget is None else render_budget // config.run.batch_size
    best_value, best_pose = math.inf, None
    history: list[SearchRecord] = []
    began = time.perf_counter()
    for number in range(1, count + 1):
        pose = random_mount_pose(objective.constraints, placement.segregation.yaw_rad, rng=rng).astype(np.float32)
        value = objective.evaluate(pose, [placement.train[k] for k in batches.choose(config.run.batch_size)]).objective
        if value < best_value:
            best_value, best_pose = value, pose
        history.append(SearchRecord(number * config.run.batch_size, best_value, time.perf_counter() - began))
    if best_pose is None:
        raise ValueError(f"none of {count} random rigs had a finite value")
    return FoundRig(
        objective.mount.rig(best_pose), None, count * config.run.batch_size, _columns(history), mount_pose=best_pose
    )


def _searched(
    placement: Placement,
    render_budget: int | None,
    *,
    search: Callable[[Placement, Sequence[Any]], Search],
    free_yaw: bool,
) -> FoundRig:
    """A baseline search on fixed training scenes."""
    rng = placement.random_numbers(Stream.SEARCH)
    value, scenes = _ranking(placement, rng, _budget(placement, render_budget), free_yaw=free_yaw)
    result = run_search(search(placement, scenes), value, rng)
    if result.error is not None:
        raise RuntimeError(f"the search ended early: {result.error}")
    return FoundRig(
        placement.objective.mount.rig(result.mount_pose),
        placement.frozen_rig,
        result.renders,
        _columns(result.history),
        mount_pose=result.mount_pose,
    )


def _cma_then_gradient(placement: Placement, render_budget: int | None) -> FoundRig:
    """CMA-ES on fixed training scenes, then the gradient method on all of them from the best rig."""
    rng = placement.random_numbers(Stream.SEARCH)
    whole = _budget(placement, render_budget)
    value, _ = _ranking(placement, rng, int(CMA_SHARE * whole), free_yaw=True)
    first = run_search(cma_es, value, rng)
    if first.error is not None:
        raise RuntimeError(f"the search ended early: {first.error}")
    # its start is found already
    rest = _within(_from_one_start(placement), whole - first.renders)
    begun = Optimisation.begin(rest, start=first.mount_pose, began_as=rest.frozen_rig)
    second = _descended(rest, begun.descent, rest.frozen_rig)
    both = _columns(first.history)
    for name, shift in (("renders", first.renders), ("seconds", first.history[-1].seconds), ("best_value", 0.0)):
        both[name] += [None if number is None else number + shift for number in second.history[name]]
    return replace(
        second,
        renders=first.renders + second.renders,
        history=both,
        notes={**second.notes, "cma_renders": first.renders},
    )


def _budget(placement: Placement, render_budget: int | None) -> int:
    if render_budget is not None:
        return render_budget
    run = placement.config.run
    return gradient_renders(
        placement.config.optimiser, len(placement.validation), iterations=run.iterations, batch_size=run.batch_size
    )


def _ranking(
    placement: Placement, rng: np.random.Generator, render_budget: int, *, free_yaw: bool
) -> tuple[BudgetedValue, list[Any]]:
    """The objective on ``baselines.random_scenes`` training scenes, at a price; and these scenes."""
    config = placement.config
    chosen = rng.choice(len(placement.train), min(config.baselines.random_scenes, len(placement.train)), replace=False)
    scenes = [placement.train[k] for k in chosen]
    space = SearchSpace.over(
        placement.objective.mount,
        config.rig.cameras,
        constraints=placement.objective.constraints,
        yaw_rad=placement.yaw_rad,
        yaw_reach_rad=math.pi if free_yaw else 0.0,
    )
    return BudgetedValue.of(placement.objective, scenes, space, render_budget=render_budget), scenes


def _columns(history: Sequence[SearchRecord]) -> dict[str, list[float | None]]:
    return {
        "renders": [each.renders for each in history],
        "seconds": [each.seconds for each in history],
        "best_value": [each.best_value if math.isfinite(each.best_value) else None for each in history],
    }


def _greedy(placement: Placement, scenes: Sequence[Any]) -> Search:
    return partial(
        greedy_cover, detected_objects=detections_of(placement.objective, scenes), yaw_count=GREEDY_DIRECTIONS
    )


METHODS: dict[str, Finder] = {
    "gradient": _gradient,
    "start": _start,
    "random_rig": _random_rig,
    "highest": _highest,
    "random_batches": _random_batches,
    # random directions would only weaken the baselines: these two keep those of the segregation
    "random": partial(_searched, search=lambda *_: random_search, free_yaw=False),
    "sobol": partial(_searched, search=lambda *_: sobol_search, free_yaw=False),
    "cma": partial(_searched, search=lambda *_: cma_es, free_yaw=True),
    "differential_evolution": partial(_searched, search=lambda *_: differential_evolution, free_yaw=True),
    "greedy_cover": partial(_searched, search=_greedy, free_yaw=True),
    "cma_then_gradient": _cma_then_gradient,
}
"""How a rig can be found, by name; the presets' names are methods as well."""

_SEEDLESS = ("highest",)
_DESCENDING = ("gradient", "start")
_HOLDING = (
    *("gradient", "start", "random_rig", "highest", "random", "sobol"),
    *("cma", "differential_evolution", "cma_then_gradient"),
)
"""Ways that keep the cameras of ``rig.freeze`` where they are."""

_PACKAGES = {"cma": "cma", "cma_then_gradient": "cma"}
