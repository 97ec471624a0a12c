"""What ``warpav scenes`` does: build, record, reconstruct and show traffic scenes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warpav.core.errors import ArgumentError
from warpav.core.executor import Executor, Outcome
from warpav.core.files import check_folder
from warpav.runs._progress import RunDisplay
from warpav.runs._scene_set import load_scene, plan_settings, reconstruction_settings
from warpav.runs.config import Config, SceneConfig
from warpav.scene import (
    CaptureTask,
    Level,
    SceneTask,
    TownSource,
    capture_path,
    capture_scenes,
    captures_in,
    check_captures,
    ego_vehicle,
    make_scenes,
    scene_path,
    split_seeds,
)
from warpav.scene.traffic.files import recordings_in, shipped_recordings
from warpav.scene.traffic.moments import moment_of, moments_of
from warpav.scene.traffic.traffic_scene import TrafficSource

if TYPE_CHECKING:
    from warpav.scene import Fleet

_SPLIT_FROM = 6  # scenes that make training, validation and test scenes, and a batch of the training scenes


def build_scenes(
    seeds: Sequence[int], out: Path, *, level: Level = "easy", fleet: Fleet | None = None, executor: Executor
) -> int:
    """Build embedded scenes of a level as GLB files that are not there yet; returns the exit status."""
    tasks = [SceneTask(seed, scene_path(out, seed), source=TownSource(seed, level, fleet)) for seed in seeds]
    return _build(tasks, out, executor)


def build_traffic_scenes(
    recordings: Sequence[Path], seeds: Sequence[int], out: Path, *, fleet: Fleet | None = None, executor: Executor
) -> int:
    """Build scenes of recorded traffic as GLB files that are not there yet; returns the exit status."""
    files = recordings_in(recordings) if recordings else shipped_recordings()
    moments = moments_of(files, ego_vehicle().bounds_m(), say=print)
    tasks = [
        SceneTask(seed, scene_path(out, seed), source=TrafficSource(moment_of(moments, seed), seed, fleet))
        for seed in seeds
    ]
    return _build(tasks, out, executor)


def _build(tasks: Sequence[SceneTask], out: Path, executor: Executor) -> int:
    check_folder(out, "out")
    status = _show_outcomes(
        "building scenes", ((str(outcome.task.file), outcome) for outcome in make_scenes(tasks, executor)), len(tasks)
    )
    _say_split(tasks, out)
    return status


def record_scenes(
    config: Config, seeds: Sequence[int], out: Path, *, server: tuple[str, int] | None, executor: Executor
) -> int:
    """Record situations that are not recorded yet; returns the exit status."""
    check_folder(out, "out")
    tasks = [CaptureTask(seed, capture_path(out, seed), plan_settings(config)) for seed in seeds]
    if server is None:
        outcomes = capture_scenes(tasks, executor)
    else:
        from warpav.scene import capture_carla_scenes

        outcomes = capture_carla_scenes(tasks, host=server[0], port=server[1])
    return _show_outcomes("recording", ((str(outcome.task.folder), outcome) for outcome in outcomes), len(tasks))


def reconstruct_scenes(config: Config, captures: Path, out: Path, *, executor: Executor) -> int:
    """Make scenes of captures that are not there yet; one that cannot be used is rejected, the others go on."""
    check_folder(out, "out")
    settings = reconstruction_settings(config)
    tasks = [
        SceneTask(seed, scene_path(out, seed), capture=capture, settings=settings)
        for seed, capture in captures_in(captures).items()
    ]
    outcomes = make_scenes(tasks, executor)
    status = _show_outcomes("reconstructing", ((str(outcome.task.file), outcome) for outcome in outcomes), len(tasks))
    _say_split(tasks, out)
    return status


def chosen_fleet(paths: Sequence[str] | None, share: float | None) -> Fleet | None:
    """The vehicles of other makers that arguments name; None where they name none."""
    if paths is None:
        if share is not None:
            raise ArgumentError("vehicles_share", f"expected none without `vehicles`, got {share:g}")
        return None
    if share is not None and not 0.0 < share <= 1.0:
        raise ArgumentError("vehicles_share", f"expected more than 0 and up to 1, got {share:g}")
    from warpav.scene import USUAL_SHARE, fleet_of

    return fleet_of(paths, share or USUAL_SHARE)


def check_captures_of(path: Path, say: Callable[[str], None]) -> tuple[int, int]:
    """How many captures there are, and how many of them are wrong, each of which is told."""
    found = list(captures_in(path).values())
    return len(found), check_captures(found, say)


def show_scene(source: str, out: Path | None, level: Level | None = None, fleet: Fleet | None = None) -> Iterator[str]:
    """Show a scene, in a window when there is a display, else in ``<scene>.png``; yields lines about it."""
    from warpav.view import has_display, plot

    scene = load_scene(source, Config(scenes=SceneConfig(level=None if level is None else (level,))), fleet=fleet)
    meshes = [scene.surroundings(), scene.ego, *(vehicle.mesh for vehicle in scene.vehicles)]
    triangle_count = sum(len(mesh.triangle) for mesh in meshes)
    people = f", {len(scene.others)} people" if scene.others else ""
    yield f"{scene.name}: {len(scene.vehicles)} vehicles{people}, {triangle_count} triangles"
    for vehicle in (*scene.vehicles, *scene.others):
        x, y = vehicle.box.center_m[:2]
        length, width, height = vehicle.box.size_m
        yield (
            f"  {vehicle.instance_id:3}  {vehicle.category:10} {math.hypot(x, y):5.1f} m away at "
            f"{math.degrees(math.atan2(y, x)):+6.1f} deg, {length:.1f} x {width:.1f} x {height:.1f} m"
        )
    out = out or (None if has_display() else Path(f"{scene.name}.png"))
    plot(scene, title=scene.name, out=out)
    if out is not None:
        yield f"wrote {out}"


def _show_outcomes(title: str, outcomes: Iterable[tuple[str, Outcome[Any, bool]]], count: int) -> int:
    rejected: list[str] = []
    with RunDisplay() as display:
        for name, outcome in display.steps(title, outcomes, count=count):
            if outcome.error is not None:
                rejected.append(outcome.error)
            elif outcome.result:
                display.say(name)
            else:
                display.say(f"{name} is there already")
        if rejected:
            display.say(f"{count - len(rejected)} of {count} done; rejected:")
            for error in rejected:
                display.say(error)
    return 2 if rejected else 0


def _say_split(tasks: Sequence[SceneTask], out: Path) -> None:
    """Tell how to train on some of the scenes that are there now and test on others, if they are enough for that."""
    seeds = [task.seed for task in tasks if task.file.is_file()]
    if len(seeds) < _SPLIT_FROM:
        return
    split = {name: _seed_text(part) for name, part in split_seeds(seeds).items()}
    with RunDisplay() as display:
        display.say(
            f"to train on 60 % and test on 20 % of them: warpav optimise scenes.source=folder scenes.folder={out} "
            f"scenes.train_seeds={split['train']} scenes.test_seeds={split['test']}"
        )


def _seed_text(seeds: Sequence[int]) -> str:
    is_range = list(seeds) == list(range(seeds[0], seeds[0] + len(seeds)))
    return f"{seeds[0]}..{seeds[-1]}" if is_range else f"[{','.join(map(str, seeds))}]"
