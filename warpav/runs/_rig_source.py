"""Rigs by what a user writes: a rig YAML, a preset, a run folder, or one by hand."""

from __future__ import annotations

import contextlib
import difflib
import itertools
import logging
import math
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpav.core.errors import ArgumentError, InputError, OptionError
from warpav.optimisation import mount_pose_by_hand
from warpav.rig import HAND_RIGS, Rig, RigCamera, find_rig_file, is_preset, off_vehicle, preset_names, read_rig
from warpav.runs._mounts import (
    camera_model,
    camera_mount,
    checked_frozen,
    constraints_of,
    preset_for,
    with_shared_model,
)
from warpav.runs._run_folder import RunFolder
from warpav.runs.config import BY_HAND, NAMED_STARTS, START_TEXT, Config, placed_config

if TYPE_CHECKING:
    from warpav.raster.camera import CameraModel
    from warpav.raster.mesh import Mesh

_logger = logging.getLogger(__name__)

_START_MOVED_M = 0.005
"""How far a camera of a start has to move for a run to say so [m]."""

_ADDED_AWAY_M = 0.5
"""How far cameras that a run adds to a rig stand from its middle at first [m]."""


def is_run_folder(source: str) -> bool:
    """Whether the source of a rig means a folder; one with a preset's name counts only if it holds a run."""
    folder = Path(source)
    return folder.is_dir() and (not is_preset(source) or (folder / "config.yaml").is_file())


def check_rig_source(source: str) -> None:
    """Reject early what :func:`find_rig` would reject after the scenes have been built."""
    if source not in HAND_RIGS:
        read_rig(_rig_file(source))


def is_shipped(source: str) -> bool:
    """Whether the source of a rig means a preset, and no file or folder of its name."""
    return is_preset(source) and not is_run_folder(source) and not Path(source).exists()


def find_rig(
    source: str,
    config: Config,
    ego: Mesh,
    *,
    say: Callable[[str], object] = _logger.warning,
    corner_deg: float | None = None,
) -> Rig:
    """The rig that ``source`` means: a rig YAML, a preset, a run folder, or one by hand (`HAND_RIGS`)."""
    if source in HAND_RIGS:
        if config.rig.symmetric == "auto" and config.rig.modules is None:
            config = config.replace({"rig.symmetric": False})  # cameras one by one
        mount = camera_mount(config, ego)
        constraints = constraints_of(config, mount.surface)
        return mount.rig(mount_pose_by_hand(source, mount, constraints, config.rig.cameras, corner_deg))
    rig = with_shared_model(read_rig(_rig_file(source)), config)
    away = off_vehicle(rig, ego)
    if is_shipped(source) and (away or config.scenes.ego is not None):
        say(f"{source}: put on the body of this vehicle, as warpav evaluate measures it")
        return preset_for(source, config, ego).rig
    if away:
        say(f"{source}: {away}")
    return rig


def config_for(
    source: str, config: str | None, overrides: Sequence[str], *, default: str
) -> contextlib.AbstractContextManager[Config]:
    """The configuration with which to look at a rig: the given one, else that of the run folder, else ``default``."""
    if config is None and is_run_folder(source):
        config = str(RunFolder.open(source).path / "config.yaml")
    return placed_config(config or default, overrides)


def _arm_name(source: str) -> str:
    return "optimised" if is_run_folder(source) else Path(source).stem


def arm_names(source: str, beside: Sequence[str] = ()) -> dict[str, str]:
    """Rigs that are compared, by what they are called in results."""
    names = {_arm_name(source): source}
    for each in beside:
        name = Path(each).absolute().name if is_run_folder(each) else _arm_name(each)
        name = each if name in names else name
        if name in names or each == source:
            raise ArgumentError("beside", f"expected every rig once, got {each!r} twice")
        names[name] = each
    for each in names.values():
        check_rig_source(each)
    return names


def rig_to_export(source: str) -> Rig:
    """The rig that ``source`` means; one by hand stands on the embedded vehicle, with the cameras of ``quick``."""
    if source not in HAND_RIGS:
        return read_rig(_rig_file(source))
    from warpav.scene import town_scene

    with placed_config("quick", ()) as config:
        return find_rig(source, config, town_scene(0).ego)


def _rig_file(source: str) -> Path:
    return RunFolder.open(source).rig_file() if is_run_folder(source) else find_rig_file(source)


def read_baselines(config: Config) -> dict[str, Rig]:
    """The rigs of ``baselines.rigs`` by their names, those of their files."""
    taken = {"optimised", BY_HAND, "start", "highest", "random", *(config.baselines.presets or ())}
    rigs: dict[str, Rig] = {}
    for path in config.baselines.rigs or ():
        if path.stem in taken | set(rigs):
            raise OptionError(
                "baselines.rigs",
                f"expected names unlike those of the other rigs, got {path.stem!r}; rename {path.name}",
            )
        rigs[path.stem] = with_shared_model(read_rig(_rig_file(str(path))), config)
    return rigs


def read_start(config: Config, freeze: Collection[str] = ()) -> Rig | None:
    """The rig that ``rig.start`` names; None where it names none."""
    if config.rig.start in NAMED_STARTS:
        return None
    start = config.rig.start
    if not Path(start).expanduser().exists() and not is_preset(start):
        near = difflib.get_close_matches(start, [*NAMED_STARTS, *preset_names()], 1, 0.6)
        hint = f"did you mean {near[0]}?" if near else "no such file"
        raise OptionError("rig.start", f"expected {START_TEXT}, got {start!r}; {hint}")
    freeze = freeze or config.rig.freeze
    rig = read_rig(_rig_file(start))
    found = len(with_added_cameras(rig, config, freeze).cameras)
    if found != config.rig.cameras:
        asked, hint = "rig.cameras says", f"set rig.cameras={found}"
        if config.rig.modules is not None:
            asked, hint = "rig.modules says", f"ask for {found} modules"
        elif found < config.rig.cameras:
            hint = f"{hint}, or name in rig.freeze the cameras that stay, and the run adds the missing ones"
        raise InputError(f"{config.rig.start}: cameras: expected {config.rig.cameras} as {asked}, got {found}; {hint}")
    checked_frozen(config, rig, freeze)
    return rig


def with_added_cameras(rig: Rig, config: Config, freeze: Collection[str]) -> Rig:
    """A rig with as many cameras as a run has, where the rig has fewer and some of them stay as they are."""
    if not freeze or config.rig.modules is not None:
        return rig
    cameras = list(rig.cameras)
    middle_m = np.mean([camera.position_m for camera in cameras], axis=0)
    names = (f"added_{number}" for number in itertools.count(1))
    free_names = (name for name in names if name not in {camera.name for camera in rig.cameras})
    while len(cameras) < config.rig.cameras:
        yaw_rad = np.sort([camera.yaw_rad % math.tau for camera in cameras])
        gap_rad = np.diff(yaw_rad, append=yaw_rad[0] + math.tau)
        widest = int(gap_rad.argmax())
        facing_rad = math.remainder(yaw_rad[widest] + 0.5 * gap_rad[widest], math.tau)
        away_m = _ADDED_AWAY_M * np.array([math.cos(facing_rad), math.sin(facing_rad), 0.0])
        cameras.append(RigCamera(next(free_names), middle_m + away_m, yaw_rad=facing_rad, model=camera_model(config)))
    return Rig(cameras)


def start_changes(start: Rig, begun: Rig) -> str:
    """What a run cannot keep of the rig that it starts from: one line, empty where that is nothing."""
    changes = []
    if len(start.cameras) < len(begun.cameras):
        changes.append(f"has {len(start.cameras)} of {len(begun.cameras)} cameras, and the run adds the others")
    position_m = np.array([camera.position_m for camera in begun.cameras])
    moved_m = 0.0
    with_other_lens: dict[tuple[str, str], list[str]] = {}
    for camera in start.cameras:
        away_m = np.linalg.norm(position_m - camera.position_m, axis=1)
        moved_m = max(moved_m, float(away_m.min()))
        was, now = (_model_words(each) for each in (camera.model, begun.cameras[int(away_m.argmin())].model))
        if was != now:
            with_other_lens.setdefault((now, was), []).append(camera.name)
    if with_other_lens:
        lenses = "; ".join(
            f"{' and '.join(names)} {'begins' if len(names) == 1 else 'begin'} as {now} instead of {was}"
            for (now, was), names in with_other_lens.items()
        )
        changes.append(
            f"{lenses}, since only cameras of rig.freeze keep their lens; "
            "camera.* or rig.modules say that of the others"
        )
    if moved_m > _START_MOVED_M:
        changes.append(f"cameras move by up to {moved_m:.2f} m to where the mount has them")
    return "; ".join(changes)


def _model_words(model: CameraModel) -> str:
    return f"{model.lens} {math.degrees(model.fov_rad):.0f} deg {model.width_px} x {model.height_px} px"
