"""Arms of an experiment: named search methods, all on the same scenes and at the same budget of camera renders.

A camera render is one scene drawn once by one camera, with or without a gradient: a rig of N cameras on S scenes costs
N S of them. Every search compares rigs on all training scenes; a descent steps on batches of them, and compares rigs on
the validation scenes, where the configuration has any of its own. Unless a budget is given, it is what the descent of
the arm's own configuration spends.
"""

from __future__ import annotations

import importlib.util
import json
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from warpav.core.errors import ArgumentError, InputError, install_text
from warpav.core.records import nearest
from warpav.optimisation import (
    BudgetedValue,
    Constraints,
    Draw,
    Drawing,
    PoolRun,
    Search,
    SearchSpace,
    Selection,
    SingleCameraValues,
    cma_es,
    detections_of,
    edge_mount_pose,
    greedy_cover,
    highest_mount_pose,
    move_to_vehicle,
    random_mount_pose,
    random_rigs,
    random_search,
    rig_values_of,
    run_search,
    selected_search,
    sobol_rigs,
    sobol_search,
)
from warpav.rig import Rig, preset_names, preset_on_vehicle, preset_rig
from warpav.runs import (
    Optimisation,
    Placement,
    Stream,
    camera_mount,
    constraints_of,
    pool_search_settings,
    preset_for,
    read_baselines,
    read_start,
    searches_by_pool,
)
from warpav.runs.config import MOST_CAMERAS, Config, load_config, option_values
from warpav.thesis import BatchChooser, Descent, affordable_iterations, descent_camera_renders

_AS_BUILT = "_as_built"
"""Ending of the arms of presets that stand where their makers put them, with images in their own proportions."""
_GREEDY_DIRECTIONS = 8  # directions that greedy cover evaluates at each position


@dataclass(frozen=True)
class FoundRig:
    rig: Rig
    pairing_rig: Rig | None
    camera_renders: int = 0
    history: dict[str, list[Any]] = field(default_factory=dict)
    training_objective: float | None = None
    mount_pose: np.ndarray | None = None  # its mount poses, float32 [camera, 7]; None for cameras that are not level
    notes: dict[str, Any] = field(default_factory=dict)


_RigValues = Callable[[np.ndarray], Iterable[float]]
_Finder = Callable[[Placement, int | None], FoundRig]
"""Finds a rig on a placement; its random numbers come from ``run.seed``, its budget [camera renders] may be None."""


class Method(NamedTuple):
    find: _Finder
    starts: bool = False  # begins with the configuration's start
    holds: bool = False  # keeps the cameras of ``rig.freeze`` where they are
    is_seeded: bool = True  # another run seed may give another rig
    is_arm: bool = True  # also without options


@dataclass(frozen=True)
class Arm:
    """A search method with its options."""

    name: str
    method: str
    overrides: tuple[str, ...] = ()
    search_overrides: tuple[str, ...] = ()

    @property
    def is_seeded(self) -> bool:
        return not self.is_preset and (self.method not in METHODS or METHODS[self.method].is_seeded)

    @property
    def is_preset(self) -> bool:
        return self.method.removesuffix(_AS_BUILT) in preset_names()

    @property
    def own_overrides(self) -> tuple[str, ...]:
        """The options that set it apart from other arms; the thesis's whole method is not taken apart."""
        is_whole = self.name in ("thesis_gradient", "thesis_as_printed")
        return self.overrides if is_whole else (*self.overrides, *self.search_overrides)

    def evaluation_config(self, config: Config) -> Config:
        """The configuration that its rigs are evaluated with."""
        return load_config(config, self.overrides)

    def search_config(self, config: Config) -> Config:
        return load_config(config, (*self.overrides, *self.search_overrides))

    def check(self, config: Config, camera_renders_max: int | None) -> None:
        config, method = self.search_config(config), METHODS.get(self.method)
        if self.method.startswith("cma") and importlib.util.find_spec("cma") is None:
            raise InputError(
                f"arm {self.name}: expected the package cma to be installed, got none; " + install_text("rivals")
            )
        if config.rig.freeze and not (method and method.holds):
            raise InputError(
                f"arm {self.name}: rig.freeze: expected none, since it places all cameras, got "
                f"{', '.join(config.rig.freeze)}; leave the arm or the option out"
            )
        if (method and method.starts) or config.rig.freeze:
            read_start(config)
        if method in (METHODS["as_built"], METHODS["within_cost"]) and not (
            len(config.baselines.rigs or ()) == 1 and config.rig.modules
        ):
            raise InputError(
                f"arm {self.name}: expected one rig of modules in baselines.rigs, and those modules with their numbers "
                "in rig.modules; give both, or leave the arm out"
            )
        if self.method == "random_batches":  # it takes them whatever the configuration searches by
            load_config(config, ("optimiser.search=descent",))
        least = self._least_camera_renders(config)
        if camera_renders_max is not None and camera_renders_max < least:
            raise InputError(
                f"arm {self.name}: `budget`: expected at least {least} camera renders, got {camera_renders_max}; raise "
                "it, or leave it out for the experiment's own"
            )

    def _least_camera_renders(self, config: Config) -> int:
        """Camera renders without which its search cannot even begin."""
        cameras = config.rig.cameras
        train_count = len(config.scenes.train_seeds) * (1 + config.scenes.mirror)
        one_rig = cameras * train_count
        looked_at_count = len(config.scenes.validation_seeds or ()) or train_count
        one_step = descent_camera_renders(
            config.optimiser, looked_at_count, camera_count=cameras, iterations=1, batch_size=config.run.batch_size
        )
        match self.method:
            case "optimiser" if config.optimiser.search != "pool":
                return one_step
            case "optimiser" | "within_cost" | "pool_only":  # the start, and a pool of as many
                return 2 * one_rig
            case "random_batches":
                return cameras * config.run.batch_size
            case "greedy_cover":  # one position in all directions, and the evaluation of the rig
                return one_rig + _GREEDY_DIRECTIONS * train_count
        return one_rig if self.method in METHODS and self.is_seeded else 1


def find_rig_of(arm: Arm, placement: Placement, camera_renders_max: int | None) -> FoundRig:
    method = METHODS.get(arm.method)
    return _preset(placement, arm.method) if method is None else method.find(placement, camera_renders_max)


def resized(rig: Rig, config: Config) -> Rig:
    """The same rig with images of the configuration's size; positions, directions and fields of view stay."""
    camera = config.camera
    return Rig([replace(each, model=each.model.resized(camera.width_px, camera.height_px)) for each in rig.cameras])


def find_arm(name: str, arms: Mapping[str, Arm]) -> Arm:
    """The arm of this name: one of the given ones, or one of `_common_arms`."""
    every = {**_common_arms(), **arms}
    if name in every:
        return every[name]
    names = ", ".join(dict.fromkeys([*arms, *every]))
    raise ArgumentError("arms", f"expected names out of {names}, got {name!r}{nearest(name, every)}")


def _common_arms() -> dict[str, Arm]:
    """Arms by name that fit every experiment, under the losses of its configuration: one of each method and preset.

    ``thesis_as_printed`` is the search of the shipped configuration ``thesis`` with its own number of steps,
    ``thesis_gradient`` a hybrid of it and the descent; they are evaluated like all others.
    """
    own = [
        Arm("default", "optimiser", search_overrides=("optimiser.search=pool",)),
        Arm("descent", "optimiser", search_overrides=("optimiser.search=descent",)),
        # batch size, start, iterations and the detector's thresholds stay those of the configuration
        Arm(
            "thesis_gradient",
            "optimiser",
            search_overrides=_thesis_options("method", "losses", "visibility", "optimiser", "rig.free"),
        ),
        Arm(
            "thesis_as_printed",
            "as_configured",
            search_overrides=_thesis_options(
                *("method", "run.iterations", "run.batch_size", "rig", "mount", "thesis", "losses", "visibility"),
                *("optimiser", "detector.confidence_min", "detector.iou_min", "detector.nms_iou_max"),
            ),
        ),
    ]
    presets = [f"{name}{ending}" for ending in ("", _AS_BUILT) for name in preset_names()]
    others = [Arm(name, name) for name in (*METHODS, *presets) if name not in METHODS or METHODS[name].is_arm]
    return {arm.name: arm for arm in (*own, *others)}


def _thesis_options(*parts: str) -> tuple[str, ...]:
    """Overrides with the values of the shipped configuration ``thesis``, of sections or options; the task stays."""
    return tuple(
        f"{name}={json.dumps(value)}"
        for name, value in option_values(load_config("thesis")).items()
        if any(f"{name}.".startswith(f"{part}.") for part in parts) and name not in ("rig.cameras", "rig.freeze")
    )


def constraint_loss(placement: Placement, mount_pose: np.ndarray) -> float:
    """The broken constraints of a rig together, scaled as in the Lagrangian (the thesis's table III)."""
    objective = placement.objective
    terms = objective.evaluate(mount_pose, placement.train[:1]).terms
    broken = sum(max(terms[name], 0.0) for name in objective.constraints.names)
    return objective.constraint_scale * broken


def _found(
    placement: Placement,
    mount_pose: np.ndarray,
    pairing_rig: Rig | None,
    rows: Sequence[Mapping[str, Any]] = (),
    *,
    training_objective: float | None = None,
    **notes: Any,  # noqa: ANN401
) -> FoundRig:
    """The rig at mount poses [camera, 7], and the history that led there, a row for each look at a rig."""
    return FoundRig(
        placement.objective.mount.rig(mount_pose),
        pairing_rig,
        rows[-1]["camera_renders"] if rows else 0,
        {name: [row[name] for row in rows] for name in rows[0]} if rows else {},
        training_objective=training_objective,
        mount_pose=mount_pose,
        notes=notes,
    )


def _row(camera_renders: int, began_s: float, best_value: float | None, **more: Any) -> dict[str, Any]:  # noqa: ANN401
    seconds = time.perf_counter() - began_s
    return {"camera_renders": camera_renders, "seconds": seconds, "best_value": best_value, **more}


def _optimised(placement: Placement, camera_renders_max: int | None) -> FoundRig:
    """The configuration's own search, from its own start: a descent takes as many steps as the budget pays for."""
    if searches_by_pool(placement):
        return _pooled(placement, camera_renders_max)
    config = placement.config
    if camera_renders_max is not None:
        iterations = affordable_iterations(
            config.optimiser,
            len(placement.validation),
            camera_renders_max,
            camera_count=config.rig.cameras,
            batch_size=config.run.batch_size,
        )
        config = load_config(config, [f"run.iterations={iterations}"])
        placement = placement.with_config(config)
    optimisation = Optimisation.begin(placement)
    descent, rows, began = optimisation.descent, [], time.perf_counter()
    assert isinstance(descent, Descent)
    tried = config.optimiser.starts if config.optimiser.starts > 1 else 0

    def camera_renders() -> int:
        looks = tried + len(descent.candidates)
        return config.rig.cameras * (descent.iteration * config.run.batch_size + looks * len(placement.validation))

    while descent.iteration < config.run.iterations and descent.stop_reason is None:
        record = descent.step()
        rows.append(_row(camera_renders(), began, record.best_training_objective, loss=record.loss))
    unprojected = descent.mount_pose
    result = descent.finish()
    best = min(each.training_objective for each in descent.candidates)
    rows.append(_row(camera_renders(), began, best, loss=None))
    return _found(
        placement,
        result.mount_pose,
        optimisation.pairing_rig,
        rows,
        training_objective=result.training_objective,
        unprojected_constraint_loss=constraint_loss(placement, unprojected),
        stopped=descent.stop_reason,
    )


def _pooled(
    placement: Placement,
    camera_renders_max: int | None,
    *,
    only: Literal["pool", "by_hand"] | None = None,
    start_pose: np.ndarray | None = None,
) -> FoundRig:
    """The search by a pool, from ``start_pose`` [camera, 7] or the configured start.

    ``only`` the best rig of a pool that has the whole budget, or rigs by hand, polished. What the cache holds is drawn
    again, so that the seconds count.
    """
    start = ["rig.start=by_hand"] if only == "by_hand" else []
    placement = placement.with_config(load_config(placement.config, ["optimiser.search=pool", *start]))
    settings = replace(pool_search_settings(placement.config), camera_renders_max=camera_renders_max)
    if camera_renders_max is not None:  # rounds until it is spent, or until one brings nothing
        settings = replace(settings, rounds=camera_renders_max, refinements=camera_renders_max)
    if only == "by_hand":
        settings = replace(settings, selects=False)
    if only == "pool":
        most = _budget(placement, camera_renders_max)
        every = most // len(placement.train)
        settings = replace(settings, pool_cameras=every, camera_renders_max=most, rounds=0, polishes=False)
    begun = Optimisation.begin(placement, start=start_pose, pool=settings, drawing=Drawing())
    descent, began = begun.descent, time.perf_counter()
    assert isinstance(descent, PoolRun)
    rows, best = [], None
    while best is None or descent.stop_reason is None:
        descent.step()
        best = descent.found
        assert best is not None
        more = {"stage": best.stage, "round": best.round, "bound": best.bound or None}
        rows.append(_row(best.camera_renders, began, best.objective, **more))
    notes = {"bound": best.bound or None, "gap": best.gap if best.bound else None, "pool_cameras": best.pool_cameras}
    rig = descent.finish()
    found = _found(
        placement, rig.mount_pose, begun.pairing_rig, rows, training_objective=rig.training_objective, **notes
    )
    return replace(found, camera_renders=descent.camera_renders)


def _single_values(placement: Placement, values: _RigValues) -> SingleCameraValues:
    """Values of rigs, if they are known by single cameras."""
    if not isinstance(values, SingleCameraValues):
        names = ", ".join(loss.name for _, loss in placement.objective.losses)
        raise InputError(
            "losses: expected expected_miss_rate alone, with combine=any and detector_share=0, for an arm that knows "
            f"what single cameras detect, got {names}; leave the arm out"
        )
    return values


def _start(placement: Placement, _: int | None) -> FoundRig:
    """The rig that the configuration's search starts from, without trying others."""
    one = ["optimiser.search=descent", "optimiser.starts=1", "optimiser.descents=1", "run.batch_size=1"]
    begun = Optimisation.begin(placement.with_config(load_config(placement.config, one)))
    return FoundRig(begun.start, begun.pairing_rig, mount_pose=begun.descent.start)


def _random_rig(placement: Placement, _: int | None) -> FoundRig:
    """A random feasible rig with random directions, without evaluation."""
    mount, constraints = placement.objective.mount, placement.objective.constraints
    space = SearchSpace.over(mount, placement.config.rig.cameras, constraints=constraints)
    pose = space.random(placement.random_numbers(Stream.SEARCH)).astype(np.float32)
    return _found(placement, pose, placement.frozen_rig)


def _practice(placement: Placement, _: int | None, *, pose_of: Callable[[Constraints, int], np.ndarray]) -> FoundRig:
    """A rig that needs no search."""
    mount = placement.objective.mount
    pose = pose_of(placement.objective.constraints, placement.config.rig.cameras).astype(np.float32)
    pose = mount.within(mount.off_the_skin(pose))
    return _found(placement, pose, mount.rig(pose))


def _by_hand(placement: Placement, _: int | None, *, kind: str | None) -> FoundRig:
    """The best rig of a kind, None: of any, of all that a hand would try, on the training scenes."""
    search, pairing_rig = _hand_search(placement)
    rig = next((each for each in search.hand_rigs if kind in (None, each.name)), None)
    if rig is None:
        raise InputError(f"arm {kind}: expected a mount and a number of cameras for such a rig, got none that fits it")
    found = _found(placement, rig.mount_pose, pairing_rig, training_objective=rig.value, numbers=rig.numbers)
    return replace(found, camera_renders=search.camera_renders)


def _hand_search(placement: Placement) -> tuple[PoolRun, Rig | None]:
    """A search that has tried the rigs by hand and nothing else; and the rig that cameras are paired with."""
    placement = placement.with_config(load_config(placement.config, ["optimiser.search=pool"]))
    begun = Optimisation.begin(placement, drawing=Drawing())
    assert isinstance(begun.descent, PoolRun)
    begun.descent.try_by_hand()
    return begun.descent, begun.pairing_rig


def _cma_by_hand(placement: Placement, camera_renders_max: int | None) -> FoundRig:
    """CMA-ES around the best rig by hand, whose search is paid out of the same budget."""
    search, _ = _hand_search(placement)
    rig = search.hand_rigs[0].mount_pose

    def values_on(rigs: np.ndarray, scene: np.ndarray) -> np.ndarray:
        values_of = rig_values_of(placement.objective, [placement.train[k] for k in scene])
        return np.fromiter(values_of(rigs), np.float64, len(rigs))

    left = _budget(placement, camera_renders_max) - search.camera_renders
    found = _searched(placement, left, search=lambda *_: partial(cma_es, start=rig, values_on=values_on))
    return replace(found, camera_renders=found.camera_renders + search.camera_renders)


def _highest_raised(placement: Placement, _: int | None) -> FoundRig:
    """Cameras around the highest point, on a rack that is ``rig.height_offset_m`` high, whatever zones there are."""
    config = load_config(placement.config, ["mount.zones=null"])
    mount = camera_mount(config, placement.ego)
    pose = highest_mount_pose(constraints_of(config, mount.surface), config.rig.cameras).astype(np.float32)
    shared = placement.objective.mount.camera  # whose near plane may be another
    found = Rig([replace(each, model=shared) for each in mount.rig(mount.within(pose)).cameras])
    return FoundRig(found, found)


def _preset(placement: Placement, method: str) -> FoundRig:
    """A known rig on the roof with images like all others, or as built: on the body, with images of its own."""
    name, mount = method.removesuffix(_AS_BUILT), placement.objective.mount
    if name == method:
        constraints = placement.objective.constraints
        moved = move_to_vehicle(preset_rig(name), mount, placement.ego, constraints=constraints, image=mount.camera)
    else:
        moved = preset_for(name, placement.config, placement.ego)
        placement.add_camera_models(moved.rig)
    return FoundRig(moved.rig, moved.rig, notes={"moved_m": moved.moved_m, "blocked_share": moved.blocked_share})


def _layout(placement: Placement) -> FoundRig:
    """The rig of ``baselines.rigs``, without what is none of ``rig.modules``, on the vehicle as on its own."""
    [(name, rig)] = read_baselines(placement.config).items()
    kept = Rig(camera for camera in rig.cameras if camera.module in (placement.config.rig.modules or ()))
    moved = preset_on_vehicle(name, placement.ego, kept)
    return FoundRig(moved.rig, moved.rig, notes={"moved_m": moved.moved_m, "blocked_share": moved.blocked_share})


def _within_cost(placement: Placement, camera_renders_max: int | None) -> FoundRig:
    """The search by a pool from the best rig by hand: half of the layout's modules of each kind at least, at its cost.

    It is judged at as many false alarms a scene as the layout of ``baselines.rigs`` may raise.
    """
    config, limits, layout = placement.config, placement.limits, _layout(placement).rig
    assert limits is not None, "there are modules"
    search, _ = _hand_search(placement)
    cost = limits.cost([camera.module for camera in layout.cameras])
    most = {name: int(min(cost / max(price, 1e-9) + 1e-9, MOST_CAMERAS)) for name, price in limits.price.items()}
    built = [camera.module for camera in layout.cameras]
    modules = {name: f"{built.count(name) // 2}..{count}" for name, count in most.items()}
    free = {"rig.modules": modules, "rig.cameras": f"2..{MOST_CAMERAS}", "rig.max_cost": cost, "rig.start": "highest"}
    left = None if camera_renders_max is None else camera_renders_max - search.camera_renders
    freed = placement.with_config(config.replace(free))
    found = _pooled(freed, left, start_pose=search.hand_rigs[0].mount_pose)
    images = [len(rig.cameras) - sum(rig.is_lidar) for rig in (layout, found.rig)]
    rate = config.evaluation.false_alarms_per_image * images[0] / max(images[1], 1)
    notes = {**found.notes, "false_alarms_per_image": rate}
    return replace(found, camera_renders=found.camera_renders + search.camera_renders, notes=notes)


def _random_batches(placement: Placement, camera_renders_max: int | None) -> FoundRig:
    """The thesis's random arm: as many random rigs as a descent has iterations, each on a batch of its own.

    The lowest value wins, so the luck of the batch helps to choose; `random_search` on fixed scenes does not have that.
    """
    config, objective = placement.config, placement.objective
    rng = placement.random_numbers(Stream.SEARCH)
    batches = BatchChooser(placement.train, config.rig.cameras, placement.random_numbers(Stream.BATCHES))
    per_rig = config.rig.cameras * config.run.batch_size
    count = config.run.iterations if camera_renders_max is None else camera_renders_max // per_rig
    best_value, best_pose = math.inf, None
    rows, began = [], time.perf_counter()
    for number in range(1, count + 1):
        pose = random_mount_pose(objective.constraints, placement.segregation.yaw_rad, rng=rng).astype(np.float32)
        value = objective.evaluate(pose, [placement.train[k] for k in batches.choose(config.run.batch_size)]).objective
        if value < best_value:
            best_value, best_pose = value, pose
        rows.append(_row(number * per_rig, began, best_value if best_pose is not None else None))
    if best_pose is None:
        raise ValueError(f"none of {count} random rigs had a finite value")
    return _found(placement, best_pose, None, rows)


def _searched(
    placement: Placement,
    camera_renders_max: int | None,
    *,
    search: Callable[[Placement, _RigValues, dict[str, Any]], Search],
    free_yaw: bool = True,
) -> FoundRig:
    """A baseline search on all training scenes; ``search`` may take notes on what it finds besides."""
    notes: dict[str, Any] = {}
    objective, config = placement.objective, placement.config
    space = SearchSpace.over(
        objective.mount,
        config.rig.cameras,
        constraints=objective.constraints,
        yaw_rad=placement.yaw_rad,
        yaw_reach_rad=math.pi if free_yaw else 0.0,
    )
    values = rig_values_of(objective, placement.train)
    most = _budget(placement, camera_renders_max)
    value = BudgetedValue(values, space, scene_count=len(placement.train), camera_renders_max=most)
    result = run_search(search(placement, values, notes), value, placement.random_numbers(Stream.SEARCH))
    if result.error is not None:
        raise RuntimeError(f"the search ended early: {result.error}")
    rows = [
        {**vars(each), "best_value": each.best_value if math.isfinite(each.best_value) else None}
        for each in result.history
    ]
    pose, frozen = result.mount_pose, placement.frozen_rig
    found = _found(placement, pose, frozen, rows, training_objective=result.value, **notes)
    return replace(found, camera_renders=result.camera_renders)


def _selected(placement: Placement, values: _RigValues, notes: dict[str, Any], *, draw: Draw) -> Search:
    """Finds the best rig that can be made of the cameras of the rigs that a baseline draws."""
    single, config = _single_values(placement, values), placement.config

    def search(value: BudgetedValue, rng: np.random.Generator) -> None:
        def told(selection: Selection) -> None:
            count = len(value.history) * config.rig.cameras
            notes.update(bound=selection.bound, gap=selection.gap, pool_cameras=count)

        selected_search(
            value,
            rng,
            draw=draw,
            single=single,
            gap=config.optimiser.pool_gap,
            time_limit_s=config.optimiser.selection_time_s,
            seed=config.run.seed,
            on_selection=told,
        )

    return search


def _greedy(placement: Placement, *_: Any) -> Search:  # noqa: ANN401
    detections = detections_of(placement.objective, placement.train)
    weight = placement.objective.object_weight(placement.train)
    return partial(greedy_cover, detections=detections, yaw_count=_GREEDY_DIRECTIONS, object_weight=weight)


def _budget(placement: Placement, camera_renders_max: int | None) -> int:
    if camera_renders_max is not None:
        return camera_renders_max
    config = placement.config
    return descent_camera_renders(
        config.optimiser,
        len(placement.validation),
        camera_count=config.rig.cameras,
        iterations=config.run.iterations,
        batch_size=config.run.batch_size,
    )


METHODS = {
    "optimiser": Method(_optimised, starts=True, holds=True, is_arm=False),
    "as_configured": Method(lambda placement, _: _optimised(placement, None), starts=True, holds=True, is_arm=False),
    "pool_only": Method(partial(_pooled, only="pool"), starts=True, holds=True),
    "descent_by_hand": Method(partial(_pooled, only="by_hand"), is_seeded=False),
    "within_cost": Method(_within_cost, starts=True, is_arm=False),
    "as_built": Method(lambda placement, _: _layout(placement), is_seeded=False, is_arm=False),
    "start": Method(_start, starts=True, holds=True),
    "random_rig": Method(_random_rig, holds=True),
    "highest": Method(partial(_practice, pose_of=highest_mount_pose), holds=True, is_seeded=False),
    "highest_raised": Method(_highest_raised, is_seeded=False),
    "edge": Method(partial(_practice, pose_of=edge_mount_pose), is_seeded=False),
    "by_hand": Method(partial(_by_hand, kind=None), is_seeded=False),
    "corners": Method(partial(_by_hand, kind="corners"), is_seeded=False),
    "cross": Method(partial(_by_hand, kind="cross"), is_seeded=False),
    "nuscenes_layout": Method(partial(_by_hand, kind="nuscenes"), is_seeded=False),
    "random_batches": Method(_random_batches),
    "random": Method(partial(_searched, search=lambda *_: random_search, free_yaw=False), holds=True),
    "sobol": Method(partial(_searched, search=lambda *_: sobol_search, free_yaw=False), holds=True),
    "random_selected": Method(partial(_searched, search=partial(_selected, draw=random_rigs)), holds=True),
    "sobol_selected": Method(partial(_searched, search=partial(_selected, draw=sobol_rigs)), holds=True),
    "cma": Method(partial(_searched, search=lambda *_: cma_es), holds=True),
    "cma_by_hand": Method(_cma_by_hand),
    "greedy_cover": Method(partial(_searched, search=_greedy)),
}
"""How a rig can be found, by name; the presets' names are methods as well."""
