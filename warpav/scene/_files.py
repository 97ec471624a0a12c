"""Scenes as lists and in folders: the embedded town, recordings, GLB files, captures; made where they are not yet.

A folder of scenes holds ``scene_<seed>.glb`` files and ``collection.json``, which lists for each the fingerprint of its
inputs (``recipe``) and its content (``sha256``). A folder of captures holds one folder ``scene_<seed>`` each.
"""

from __future__ import annotations

import glob
import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warpav.core.cache import fingerprint
from warpav.core.errors import ArgumentError, InputError
from warpav.core.executor import Executor, Outcome
from warpav.core.files import atomic_write
from warpav.scene._cache import BuiltSource, built_scenes
from warpav.scene._glb import read_scene, write_scene
from warpav.scene._scene import Scene
from warpav.scene.town._levels import TownSource, checked_level
from warpav.scene.town._town import ego_vehicle
from warpav.scene.traffic.files import is_recording, natural_order, recordings_in
from warpav.scene.traffic.moments import Moment, moments_of
from warpav.scene.traffic.traffic_scene import TrafficSource

if TYPE_CHECKING:
    from warpav.scene.capture._capture import PlanSettings, Simulator
    from warpav.scene.reconstruction._settings import ReconstructionSettings

_MAX_SEED = 2**31 - 1
_SCHEMA = "warpav-collection/1"
_INDEX = "collection.json"


def town(
    seeds: Iterable[int],
    level: str = "easy",
    *,
    vehicles: str | Path | Iterable[str | Path] | None = None,
    vehicles_share: float = 0.5,
) -> list[Scene]:
    """Embedded street scenes: a street with houses, parked and moving vehicles, people, around one ego vehicle.

    They are kept in the user's cache folder; those that are not there yet are built in several processes.

    Args:
        seeds: Their numbers, 0 to 2^31 - 1; the same seed and level give the same scene.
        level: ``easy`` is a street in which everything is near and can be seen from the roof; ``urban`` is as long and
            busy as real ones, ``dense`` full of people and of what hides them, ``motorway`` fast, wide and far.
        vehicles: Vehicles of other makers in the places of some of the town's: ``"shipped"``, mesh files, folders of
            these, or several; None: none.
        vehicles_share: Of the vehicles in whose places one of these could stand, those in whose places one does, 0..1.

    Raises:
        InputError: There is none, one is out of range, there is no such level, or a mesh cannot be used.
        TypeError: One is no whole number.
    """
    name = checked_level(level)
    numbers = [seeds] if isinstance(seeds, int) else list(seeds)
    for seed in numbers:
        if isinstance(seed, bool) or not hasattr(seed, "__index__"):
            raise TypeError(f"seeds: expected whole numbers such as range(30), got {seed!r}")
        if not 0 <= int(seed) <= _MAX_SEED:
            raise ArgumentError("seeds", f"expected 0 to {_MAX_SEED}, got {seed}")
    if not numbers:
        raise ArgumentError("seeds", "expected at least one seed such as [0], got none")
    if not 0.0 < vehicles_share <= 1.0:
        raise ArgumentError("vehicles_share", f"expected more than 0 and up to 1, got {vehicles_share!r}")
    fleet = None
    if vehicles is not None:
        from warpav.scene._fleet import fleet_of

        fleet = fleet_of([vehicles] if isinstance(vehicles, (str, Path)) else list(vehicles), vehicles_share)
    return list(built_scenes([TownSource(int(seed), name, fleet) for seed in numbers]))


def read_scenes(files: str | Path | Iterable[str | Path]) -> list[Scene]:
    """Scenes from GLB files, in the order of their names, in which scene_2 stands before scene_10.

    A recording of traffic (the guide *Recorded traffic* says which files are) gives one scene for every moment, around
    another road user each: moments are 1 s apart or more.

    Args:
        files: A file, a folder, a pattern such as ``"scenes/*.glb"``, or several of these.

    Raises:
        InputError: There is no such file, or one is no scene and no recording.
    """
    sources = [files] if isinstance(files, (str, Path)) else list(files)
    found = [file for source in sources for file in _files_of(source)]
    if not found:
        raise ArgumentError("files", "expected at least one scene, got none")
    return [scene for file in found for scene in _scenes_in(file)]


def write_scenes(scenes: Scene | Iterable[Scene], folder: str | Path) -> list[Path]:
    """Write scenes as ``scene_0.glb``, ``scene_1.glb`` and so on, which `read_scenes` and ``scenes.folder`` read.

    Args:
        scenes: One or several.
        folder: Folder to write to; made when it does not exist. Files of these names are replaced.

    Returns:
        The files, in the order of the scenes.

    Raises:
        InputError: There is no scene, or the folder cannot be written to.
        TypeError: One is no scene.
    """
    found = [scenes] if isinstance(scenes, Scene) else list(scenes)
    if not found:
        raise ArgumentError("scenes", "expected at least one scene, got none")
    for scene in found:
        if not isinstance(scene, Scene):
            raise TypeError(f"scenes: expected scenes, such as town([0, 1]) gives, got {type(scene).__name__}")
    folder = Path(folder).expanduser()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArgumentError("folder", f"expected a folder to write to, got: {error.strerror}", place=folder) from None
    files = [scene_path(folder, number) for number in range(len(found))]
    for scene, file in zip(found, files, strict=True):
        write_scene(scene, file)
    return files


def _scenes_in(file: Path) -> list[Scene]:
    if not is_recording(file):
        return [read_scene(file)]
    of_step: dict[int, Moment] = {}
    for moment in moments_of([file], ego_vehicle().bounds_m()):
        of_step.setdefault(moment.step, moment)
    return list(built_scenes([TrafficSource(of_step[step], seed) for seed, step in enumerate(sorted(of_step))]))


def _files_of(source: str | Path) -> list[Path]:
    path = Path(source).expanduser()
    if path.is_file() or is_recording(path):
        return [path]
    pattern = str(path / "*.glb") if path.is_dir() else str(path)
    matches = sorted(map(Path, glob.glob(pattern)), key=natural_order)
    if not matches and path.is_dir() and any(is_recording(each) for each in path.rglob("*")):
        return recordings_in([path])
    if not matches:
        raise InputError(f"{source}: scenes: expected GLB files, got none; warpav scenes make writes some")
    return matches


@dataclass(frozen=True)
class SceneTask:
    """A scene to make in a file: of a source, or of the capture in a folder with some settings."""

    seed: int
    file: Path
    source: BuiltSource | None = None
    capture: Path | None = None
    settings: ReconstructionSettings | None = None

    @property
    def fingerprint(self) -> str:
        """Hash of all that the file depends on."""
        if self.source is not None:
            return fingerprint(self.source.fingerprint, code=("warpav.scene._glb",))
        assert self.capture is not None
        content = hashlib.sha256()
        for file in sorted(path for path in self.capture.rglob("*") if path.is_file()):
            content.update(file.relative_to(self.capture).as_posix().encode() + b"\0")
            content.update(file.read_bytes())
        code = ("warpav.scene.reconstruction._reconstruct", "warpav.scene.capture._folder", "warpav.scene._glb")
        return fingerprint("captured", content.hexdigest(), self.settings, code=code)


@dataclass(frozen=True)
class CaptureTask:
    """A situation to record, by its seed, into a folder."""

    seed: int
    folder: Path
    settings: PlanSettings


def capture_path(folder: Path, seed: int) -> Path:
    """Where the capture of a seed lies in a folder of captures."""
    return folder / f"scene_{seed}"


def scene_path(folder: Path, seed: int) -> Path:
    """Where the scene of a seed lies in a folder of scenes."""
    return folder / f"scene_{seed}.glb"


def captures_in(path: Path) -> dict[int, Path]:
    """The captures that a path means, by seed: a capture itself or those in a folder, unfinished ones too."""
    from warpav.scene.capture._folder import DESCRIPTION, UNFINISHED

    names = (DESCRIPTION, UNFINISHED)
    captures = [path] if any((path / name).is_file() for name in names) else []
    captures = captures or sorted({file.parent for name in names for file in path.glob(f"*/{name}")})
    if not captures:
        raise InputError(
            f"{path}: expected a capture (a folder with {DESCRIPTION}) or a folder of captures, got neither; "
            "warpav scenes capture --out writes them"
        )
    found: dict[int, Path] = {}
    for capture in captures:
        match = re.search(r"(\d+)$", capture.name)
        seed = int(match[1]) if match else len(found)
        if seed in found:
            raise InputError(f"{capture}: expected every number once, got {found[seed].name} as well; rename one")
        found[seed] = capture
    return found


def make_scenes(tasks: Sequence[SceneTask], executor: Executor | None = None) -> Iterator[Outcome[SceneTask, bool]]:
    """Make scene files that are not there yet and note them in their folder's index; outcomes tell which were made."""
    _make_folders(task.file for task in tasks)
    fingerprints: dict[SceneTask, str] = {}  # of the missing ones, as they are before the work starts
    for task in tasks:
        made_with = task.fingerprint
        if _is_ready(task, made_with):
            yield Outcome(task, False)
        else:
            fingerprints[task] = made_with
    for outcome in (executor or Executor()).map(_make_scene, list(fingerprints)):
        if outcome.error is None:
            _note(outcome.task, fingerprints[outcome.task])
        yield _named(outcome, outcome.task.capture or outcome.task.file)


def capture_scenes(
    tasks: Sequence[CaptureTask], executor: Executor | None = None
) -> Iterator[Outcome[CaptureTask, bool]]:
    """Record situations of the town that are not recorded yet; outcomes tell where images were taken."""
    _make_folders(task.folder for task in tasks)
    for outcome in (executor or Executor()).map(_capture_scene, tasks):
        yield _named(outcome, outcome.task.folder)


def capture_carla_scenes(tasks: Sequence[CaptureTask], *, host: str, port: int) -> Iterator[Outcome[CaptureTask, bool]]:
    """As `capture_scenes` with a CARLA server, one after the other; `InputError` where it does not answer."""
    from warpav.scene.capture._carla_simulator import CarlaSimulator

    _make_folders(task.folder for task in tasks)
    with CarlaSimulator(host=host, port=port) as simulator:
        for outcome in Executor().map(lambda task: _record(simulator, task), tasks):
            yield _named(outcome, outcome.task.folder)


def check_captures(captures: Sequence[Path], say: Callable[[str], None]) -> int:
    """Tell everything that is wrong with captures; returns how many have something wrong."""
    from warpav.scene.capture._folder import check_capture

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


def _named(outcome: Outcome[Any, bool], place: Path) -> Outcome[Any, bool]:
    if outcome.error is None or outcome.error.startswith(str(place)):
        return outcome
    return replace(outcome, error=f"{place}: {outcome.error}")


def _make_scene(task: SceneTask) -> bool:
    if task.source is not None:
        (scene,) = built_scenes([task.source])
    else:
        from warpav.core.warp_setup import load_warp
        from warpav.scene.capture._folder import read_capture
        from warpav.scene.reconstruction._reconstruct import reconstruct

        assert task.capture is not None
        load_warp()
        scene = reconstruct(read_capture(task.capture), task.settings)
    write_scene(scene, task.file)
    return True


def _capture_scene(task: CaptureTask) -> bool:
    from warpav.scene.capture._town_simulator import TownSimulator

    with TownSimulator() as simulator:
        return _record(simulator, task)


def _record(simulator: Simulator, task: CaptureTask) -> bool:
    """Record a situation; returns whether images had to be taken."""
    from warpav.scene.capture._folder import record_capture

    views: list[int] = []
    record_capture(
        simulator, task.seed, task.folder, task.settings, on_image=lambda number, count: views.append(number)
    )
    return bool(views)


def _make_folders(places: Iterable[Path]) -> None:
    for folder in {place.parent for place in places}:
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
    entries = _index(task.file.parent)
    entries[task.file.name] = {"seed": task.seed, "recipe": made_with, "sha256": _sha256(task.file)}
    entries = dict(sorted(entries.items(), key=lambda item: item[1].get("seed", 0)))
    with atomic_write(task.file.parent / _INDEX) as draft:
        draft.write_text(json.dumps({"schema": _SCHEMA, "scenes": entries}, indent=1) + "\n", encoding="utf-8")


def _index(folder: Path) -> dict[str, Any]:
    """The entries of a folder's index; empty if it is missing or invalid, so that the files are made again."""
    try:
        content = json.loads((folder / _INDEX).read_text(encoding="utf-8"))
        entries = content["scenes"]
        return (
            entries if content["schema"] == _SCHEMA and all(isinstance(one, dict) for one in entries.values()) else {}
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
