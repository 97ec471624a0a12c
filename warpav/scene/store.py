"""Collections of scenes in a folder: built, captured, reconstructed; what is there already is not made again.

A folder of scenes holds ``scene_<seed>.glb`` files and ``collection.json``, which lists for each the fingerprint of its
inputs (``recipe``) and its content (``sha256``). A folder of captures holds one folder ``scene_<seed>`` each.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from warpav.core.atomic_write import atomic_write
from warpav.core.errors import InputError
from warpav.core.executor import ExecutorName, Outcome, Task, run_tasks
from warpav.core.fingerprint import fingerprint
from warpav.core.warp_setup import load_warp
from warpav.scene.cache import BuiltSource, built_scenes
from warpav.scene.capture.folder import DESCRIPTION, UNFINISHED, check_capture, read_capture, record_capture
from warpav.scene.capture.plan import PlanSettings
from warpav.scene.capture.simulator import Simulator
from warpav.scene.reconstruction.settings import ReconstructionSettings
from warpav.scene.town.levels import TownSource

SCHEMA = "warpav-collection/1"
INDEX = "collection.json"


@dataclass(frozen=True)
class SceneTask:
    """One scene to make.

    Attributes:
        seed: Its number.
        file: The GLB file to write.
        capture: Folder of its capture; None: it is built directly.
        settings: How a capture becomes a scene.
        source: What it is built of; None: it is captured, or the embedded scene of the seed.
    """

    seed: int
    file: Path
    capture: Path | None = None
    settings: ReconstructionSettings | None = None
    source: BuiltSource | None = None

    @property
    def fingerprint(self) -> str:
        """Hash of all that the file depends on."""
        if self.capture is None:
            source = self.source or TownSource(self.seed)
            return fingerprint(source.fingerprint, code=("warpav.scene.glb",))
        content = hashlib.sha256()
        for file in sorted(path for path in self.capture.rglob("*") if path.is_file()):
            content.update(file.relative_to(self.capture).as_posix().encode() + b"\0")
            content.update(file.read_bytes())
        code = ("warpav.scene.reconstruction.reconstruct", "warpav.scene.capture.folder", "warpav.scene.glb")
        return fingerprint("captured", content.hexdigest(), self.settings, code=code)


@dataclass(frozen=True)
class CaptureTask:
    """One situation to record with the embedded town.

    Attributes:
        seed: Chooses the situation.
        folder: Folder of the capture.
        settings: What to record.
    """

    seed: int
    folder: Path
    settings: PlanSettings


def capture_path(folder: Path, seed: int) -> Path:
    """Where the capture of a seed lies in a folder of captures."""
    return folder / f"scene_{seed}"


def scene_path(folder: Path, seed: int) -> Path:
    """Where the scene of a seed lies in a folder of scenes."""
    return folder / f"scene_{seed}.glb"


def captures_in(paths: Sequence[Path]) -> dict[int, Path]:
    """The captures that paths mean, by seed: folders of captures, and captures themselves, unfinished ones too.

    Raises:
        InputError: A path is neither, or two captures have the same number.
    """
    found: dict[int, Path] = {}
    for path in paths:
        names = (DESCRIPTION, UNFINISHED)
        if any((path / name).is_file() for name in names):
            captures = [path]
        else:
            captures = sorted({file.parent for name in names for file in path.glob(f"*/{name}")})
        if not captures:
            raise InputError(
                f"{path}: expected a capture (a folder with {DESCRIPTION}) or a folder of captures, got neither; "
                "warpav scenes capture --out writes them"
            )
        for capture in captures:
            match = re.search(r"(\d+)$", capture.name)
            seed = int(match[1]) if match else len(found)
            if seed in found:
                raise InputError(f"{capture}: expected every number once, got {found[seed].name} as well; rename one")
            found[seed] = capture
    return found


def make_scenes(
    tasks: Sequence[SceneTask], *, executor: ExecutorName = "serial", worker_count: int | None = None
) -> Iterator[Outcome[SceneTask, bool]]:
    """Make scene files that are not there yet, and note them in their folder's index.

    Yields:
        An outcome for each; its result is whether the file was generated.

    Raises:
        InputError: A folder cannot be written to.
    """
    for folder in {task.file.parent for task in tasks}:
        _make_folder(folder)
    fingerprints: dict[SceneTask, str] = {}  # of the missing ones, as they are before the work starts
    for task in tasks:
        made_with = task.fingerprint
        if _is_ready(task, made_with):
            yield Outcome(task, False)
        else:
            fingerprints[task] = made_with
    for outcome in run_tasks(_make_scene, list(fingerprints), executor=executor, worker_count=worker_count):
        if outcome.error is None:
            _note(outcome.task, fingerprints[outcome.task])
        yield _named(outcome, outcome.task.capture or outcome.task.file)


def capture_scenes(
    tasks: Sequence[CaptureTask], *, executor: ExecutorName = "serial", worker_count: int | None = None
) -> Iterator[Outcome[CaptureTask, bool]]:
    """Record situations of the embedded town that are not recorded yet; interrupted ones go on.

    Yields:
        An outcome for each; its result is whether images were recorded.

    Raises:
        InputError: A folder cannot be written to.
    """
    for folder in {task.folder.parent for task in tasks}:
        _make_folder(folder)
    for outcome in run_tasks(_capture_scene, tasks, executor=executor, worker_count=worker_count):
        yield _named(outcome, outcome.task.folder)


def capture_carla_scenes(tasks: Sequence[CaptureTask], *, host: str, port: int) -> Iterator[Outcome[CaptureTask, bool]]:
    """Record situations with a CARLA server, one after the other.

    Yields:
        An outcome for each; its result is whether images were recorded.

    Raises:
        InputError: The folder cannot be written to, the package is missing, or the server does not answer.
    """
    from warpav.scene.capture.carla_simulator import CarlaSimulator

    for folder in {task.folder.parent for task in tasks}:
        _make_folder(folder)
    with CarlaSimulator(host=host, port=port) as simulator:
        for outcome in run_tasks(lambda task: _record(simulator, task), tasks):
            yield _named(outcome, outcome.task.folder)


def check_captures(captures: Sequence[Path], say: Callable[[str], None]) -> int:
    """Tell everything that is wrong with captures; returns how many have something wrong."""
    bad = 0
    for capture in captures:
        troubles = list(check_capture(capture))
        for trouble in troubles:
            say(trouble)
        bad += bool(troubles)
    return bad


def split_seeds(seeds: Sequence[int]) -> dict[str, list[int]]:
    """Seeds for training, validation and test: the first 60 %, the next 20 %, the rest, in ascending order."""
    ordered = sorted(seeds)
    train, validation = round(0.6 * len(ordered)), round(0.8 * len(ordered))
    return {"train": ordered[:train], "validation": ordered[train:validation], "test": ordered[validation:]}


def _named(outcome: Outcome[Task, bool], place: Path) -> Outcome[Task, bool]:
    """The outcome with the location added to its error."""
    if outcome.error is None or outcome.error.startswith(str(place)):
        return outcome
    return replace(outcome, error=f"{place}: {outcome.error}")


def _make_scene(task: SceneTask) -> bool:
    from warpav.scene.glb import write_scene

    if task.capture is None:
        (scene,) = built_scenes([task.source or TownSource(task.seed)])
    else:
        from warpav.scene.reconstruction.reconstruct import reconstruct

        load_warp()
        scene = reconstruct(read_capture(task.capture), task.settings)
    write_scene(scene, task.file)
    return True


def _capture_scene(task: CaptureTask) -> bool:
    from warpav.scene.capture.town_simulator import TownSimulator

    with TownSimulator() as simulator:
        return _record(simulator, task)


def _record(simulator: Simulator, task: CaptureTask) -> bool:
    """Record a situation; returns whether images had to be taken."""
    views: list[int] = []
    record_capture(
        simulator, task.seed, task.folder, task.settings, on_image=lambda number, count: views.append(number)
    )
    return bool(views)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: expected a folder to write to, got: {error.strerror}") from None


def _is_ready(task: SceneTask, made_with: str) -> bool:
    entry = _index(task.file.parent).get(task.file.name)
    if entry is None or not task.file.is_file() or entry.get("recipe") != made_with:
        return False
    return entry.get("sha256") == _sha256(task.file)


def _note(task: SceneTask, made_with: str) -> None:
    """Enter a file into its folder's index."""
    file = task.file.parent / INDEX
    entries = _index(task.file.parent)
    entries[task.file.name] = {"seed": task.seed, "recipe": made_with, "sha256": _sha256(task.file)}
    entries = dict(sorted(entries.items(), key=lambda item: item[1].get("seed", 0)))
    with atomic_write(file) as draft:
        draft.write_text(json.dumps({"schema": SCHEMA, "scenes": entries}, indent=1) + "\n", encoding="utf-8")


def _index(folder: Path) -> dict[str, Any]:
    """The entries of a folder's index; empty if it is missing or invalid, so that the files are made again."""
    try:
        content = json.loads((folder / INDEX).read_text(encoding="utf-8"))
        entries = content["scenes"]
        return entries if content["schema"] == SCHEMA and all(isinstance(one, dict) for one in entries.values()) else {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
