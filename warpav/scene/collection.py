"""Scenes as lists: the embedded town, and files."""

from __future__ import annotations

import glob
import re
from collections.abc import Iterable
from pathlib import Path

from warpav.core.errors import ArgumentError, InputError
from warpav.scene.scene import Scene
from warpav.scene.traffic.files import is_recording, recordings_in

MAX_SEED = 2**31 - 1


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
    from warpav.scene.cache import built_scenes
    from warpav.scene.town.levels import TownSource, checked_level

    name = checked_level(level)
    numbers = [seeds] if isinstance(seeds, int) else list(seeds)
    for seed in numbers:
        if isinstance(seed, bool) or not hasattr(seed, "__index__"):
            raise TypeError(f"seeds: expected whole numbers such as range(30), got {seed!r}")
        if not 0 <= int(seed) <= MAX_SEED:
            raise ArgumentError("seeds", f"expected 0 to {MAX_SEED}, got {seed}")
    if not numbers:
        raise ArgumentError("seeds", "expected at least one seed such as [0], got none")
    if not 0.0 < vehicles_share <= 1.0:
        raise ArgumentError("vehicles_share", f"expected more than 0 and up to 1, got {vehicles_share!r}")
    fleet = None
    if vehicles is not None:
        from warpav.scene.fleet import fleet_of

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
    from warpav.scene.glb import write_scene
    from warpav.scene.store import scene_path

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
    from warpav.scene.glb import read_scene

    if not is_recording(file):
        return [read_scene(file)]
    from warpav.scene.cache import built_scenes
    from warpav.scene.town.town import ego_vehicle
    from warpav.scene.traffic.moments import Moment, moments_of
    from warpav.scene.traffic.traffic_scene import TrafficSource

    of_step: dict[int, Moment] = {}
    for moment in moments_of([file], ego_vehicle().bounds_m()):
        of_step.setdefault(moment.step, moment)
    return list(built_scenes([TrafficSource(of_step[step], seed) for seed, step in enumerate(sorted(of_step))]))


def _files_of(source: str | Path) -> list[Path]:
    path = Path(source).expanduser()
    if path.is_file() or is_recording(path):
        return [path]
    pattern = str(path / "*.glb") if path.is_dir() else str(path)
    matches = sorted(map(Path, glob.glob(pattern)), key=_natural_order)
    if not matches and path.is_dir() and any(is_recording(each) for each in path.rglob("*")):
        return recordings_in([path])
    if not matches:
        raise InputError(f"{source}: scenes: expected GLB files, got none; warpav scenes make writes some")
    return matches


def _natural_order(path: Path) -> list[tuple[str, int]]:
    """Sort key of a path in which numbers count by their value."""
    return [(text, int(digits or -1)) for text, digits in re.findall(r"(\D*)(\d*)", str(path))]
