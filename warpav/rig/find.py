"""Files of rigs that a name means without a run: a rig YAML or a preset."""

from __future__ import annotations

import difflib
from pathlib import Path

from warpav.core.errors import InputError
from warpav.rig.presets import preset_file, preset_names

HIGHEST = "highest"
"""The name of the thesis's baseline, cameras around the highest point; it needs a vehicle to stand on."""


def is_preset(source: str) -> bool:
    """Whether a preset has this name."""
    return source in preset_names()


def find_rig_file(source: str) -> Path:
    """The file of a rig YAML or a preset."""
    file = Path(source).expanduser()
    if file.is_file():
        return file
    names = preset_names()
    if source in names:
        return preset_file(source)
    near = difflib.get_close_matches(source, [*names, HIGHEST], 1, 0.6)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise InputError(
        f"{source}: rig: expected a rig YAML, a run folder, a preset ({', '.join(names)}) or {HIGHEST}, "
        f"got no file of that name{hint}"
    )
