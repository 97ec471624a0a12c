"""The thesis's figures of rigs: without constraints (10), before and after optimisation (11), the highest rig (12).

Each takes a run folder, or runs what it needs itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from warpav.core.errors import InputError
from warpav.core.progress import Progress
from warpav.core.warp_setup import checked_device
from warpav.experiments._scene_figures import RIG_NUMBERS
from warpav.optimisation import HEIGHT_DELTA_M, X_M, Y_M, RigObservation, RigObserver
from warpav.rig import Rig
from warpav.runs import (
    Optimisation,
    Placement,
    RunFolder,
    camera_mount,
    find_rig,
    load_detector,
    load_networks,
    load_scene_set,
    load_scenes,
    needed_fit,
    objective_options,
    placement_on,
    trajectory,
)
from warpav.runs.config import Config, load_config
from warpav.scene import DeviceScene, Scene
from warpav.view import OptimisedRig, before_and_after, checked_figure, highest_rig, without_and_with_constraints

if TYPE_CHECKING:
    from warpav.optimisation import PoolRun
    from warpav.thesis import Descent

_UNCONSTRAINED = ("optimiser.multiplier_learning_rate=0", "optimiser.multiplier_damping=0")


def draw_method_figure(
    number: int, path: Path | str, config: Config, *, run: RunFolder | None, progress: Progress
) -> Path:
    path = checked_figure(path, (".png",))
    match number:
        case 10:
            return _unconstrained(config, path, run=run, progress=progress)
        case 11:
            return _before_and_after(config, path, run=run, progress=progress)
        case 12:
            if run is not None:
                raise InputError("figure 12: expected a configuration, got a run; the highest rig needs none")
            scenes = list(
                progress.steps(
                    "scenes", load_scenes(config, config.scenes.test_seeds), count=len(config.scenes.test_seeds)
                )
            )
            ego = scenes[0].ego
            rig = find_rig("highest", config, ego)
            surface = camera_mount(config, ego).surface
            views = _observer(config, progress)(rig, scenes, "test scenes")
            return highest_rig(rig, views, path, surface=surface)
    raise InputError(f"figure: expected one of {', '.join(map(str, RIG_NUMBERS))}, got {number}")


# ------------------------------------------------------------------------------------------------ without constraints


def _unconstrained(config: Config, path: Path, *, run: RunFolder | None, progress: Progress) -> Path:
    """Figure 10: the trajectories of the cameras from one start, with all multipliers at 0 and without that."""
    # which iterate is kept and how often rigs are compared changes no trajectory
    config = load_config(config, ["optimiser.keep=last", "optimiser.patience=null", "optimiser.descents=1"])
    traffic, networks = load_scene_set(config, progress), load_networks(config)
    probability = needed_fit(config, progress)
    placement = placement_on(traffic, config, networks, probability)
    if run is None:
        optimisation = Optimisation.begin(placement)
        start, pairing_rig = optimisation.descent.start, optimisation.pairing_rig
        kept = _optimised(placement, optimisation.descent, progress, "with constraints")
    else:
        path_m, began = trajectory(run.events()), run.rig("initial")
        if path_m is None:
            raise InputError(f"{run.path}: run folder: expected at least two iterations, got fewer")
        start = placement.objective.mount.mount_pose_of_rig(began)
        pairing_rig = None if placement.has_ordered_start else began
        kept = OptimisedRig(began, path_m, run.rig("final"))
    loose = placement_on(traffic, load_config(config, _UNCONSTRAINED), networks, probability)
    freed = Optimisation.begin(loose, start=start, pairing_rig=pairing_rig)
    free = _optimised(loose, freed.descent, progress, "without constraints")

    steps = len(free.trajectory_m) - 1
    return without_and_with_constraints(
        free,
        kept,
        path,
        ego=traffic.ego,
        surface=placement.objective.mount.surface,
        constraints=placement.objective.constraints,
        remark=f"method: {config.method}, {steps} iterations from one start on the same batches.",
    )


def _optimised(placement: Placement, descent: Descent | PoolRun, progress: Progress, how: str) -> OptimisedRig:
    """Take all steps; the end is the rig after the last one, moved to a feasible position where constraints count."""
    mount, constraints = placement.objective.mount, placement.objective.constraints
    count = placement.config.run.iterations
    records = [descent.step() for _ in progress.steps(how, range(count), count=count)]
    pose = descent.mount_pose
    last = mount.rig(pose)
    positions = [record.positions_m for record in records] + [[camera.position_m for camera in last.cameras]]
    if placement.config.optimiser.multiplier_learning_rate != 0.0:
        pose[:, [X_M, Y_M]] = constraints.project(pose[:, [X_M, Y_M]], pose[:, HEIGHT_DELTA_M])
    return OptimisedRig(mount.rig(descent.start), np.array(positions, np.float64), mount.rig(pose))


# ------------------------------------------------------------------------------------------------ what a rig sees


_Views: TypeAlias = list[tuple[Scene, RigObservation]]


def _observer(config: Config, progress: Progress) -> Callable[[Rig, Sequence[Scene], str], _Views]:
    """Observes scenes through rigs, with the configuration's detector."""
    device, detector = checked_device(config.device), load_detector(config)

    def observe(rig: Rig, scenes: Sequence[Scene], how: str) -> _Views:
        observer = RigObserver(rig, detector, objective_options(config), device=device)
        shown = progress.steps(how, scenes, count=len(scenes))
        return [(scene, observer.observe(DeviceScene.pack(scene, device=device))) for scene in shown]

    return observe


def _before_and_after(config: Config, path: Path, *, run: RunFolder | None, progress: Progress) -> Path:
    """Figure 11: what a rig sees at the start and once optimised, on training scenes and on all test scenes."""
    if run is None:
        placement = Placement.from_config(config).prepare(progress)
        descent, count = Optimisation.begin(placement).descent, config.run.iterations
        for _ in progress.steps("optimising", range(count), count=count):
            if descent.stop_reason is None:
                descent.step()
        mount = placement.objective.mount
        start, result = mount.rig(descent.start), mount.rig(descent.finish().mount_pose)
    else:
        # the rig that was found, even where the run hands over its start because that is better
        start, result = run.rig("initial"), run.rig("final" if config.optimiser.keep == "last" else "best")
    train = list(load_scenes(config, config.scenes.train_seeds[: config.run.batch_size]))
    test = list(load_scenes(config, config.scenes.test_seeds))
    observe = _observer(config, progress)
    rows = {
        "Start": (start, observe(start, train, "start")),
        "Optimised": (result, observe(result, train, "optimised")),
        "On test scenes": (result, observe(result, test, "test scenes")),
    }
    return before_and_after(rows, path)
