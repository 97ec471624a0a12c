"""Rigs that a name means without a run: a rig YAML or a preset."""

from __future__ import annotations

import difflib
from pathlib import Path

from warpav.core.errors import InputError
from warpav.rig.presets import preset_names, preset_rig
from warpav.rig.rig import Rig, read_rig

HIGHEST = "highest"
"""The name of the thesis's baseline, cameras around the highest point; it needs a vehicle to stand on."""


def is_preset(source: str) -> bool:
    """Whether a preset has this name."""
    return source in preset_names()


def find_rig_file(source: str) -> Rig:
    """The rig of a rig YAML or a preset, as its file has it.

    Args:
        source: Path of the file, or name of the preset; a file wins over a preset of the same name.

    Raises:
        InputError: It means none, or the file cannot be used.
    """
    if Path(source).is_file():
        return read_rig(source)
    names = preset_names()
    if source in names:
        return preset_rig(source)
    near = difflib.get_close_matches(source, [*names, HIGHEST], 1, 0.6)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise InputError(
        f"{source}: rig: expected a rig YAML, a run folder, a preset ({', '.join(names)}) or {HIGHEST}, "
        f"got no file of that name{hint}"
    )
