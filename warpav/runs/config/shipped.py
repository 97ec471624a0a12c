"""The configurations that come with warpav."""

from __future__ import annotations

import difflib
from functools import cache
from pathlib import Path
from typing import Any

from warpav.core.errors import InputError
from warpav.core.yaml_file import read_yaml


def config_dir() -> Path:
    """The folder of the shipped configurations: the installed package's own, else the checkout's."""
    package = Path(__file__).resolve().parents[2]
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / "quick.yaml").is_file():
            return folder
    raise InputError(f"shipped configurations: expected a folder configs in {package}, got none; reinstall warpav")


def config_names() -> list[str]:
    """Names of the shipped configurations, such as ``quick``."""
    return sorted(file.stem for file in config_dir().glob("*.yaml"))


def find_config(path: str | Path) -> Path:
    """The file that ``path`` means: an existing file, or a shipped configuration by its name.

    Raises:
        InputError: Neither exists.
    """
    file = Path(path).expanduser()
    if file.is_file():
        return file
    shipped = config_dir() / f"{file.stem}.yaml"
    named = str(path) in (file.stem, shipped.name, f"configs/{shipped.name}")
    if named and shipped.is_file():
        return shipped
    if (file / "config.yaml").is_file():
        raise InputError(
            f"{path}: config: expected a YAML file or a shipped name, got a run folder; {file / 'config.yaml'} repeats "
            f"it, rig.start={file} begins with its rig"
        )
    near = difflib.get_close_matches(file.stem, config_names(), 1, 0.6)
    hint = f"did you mean {near[0]}?" if near else f"shipped ones are {', '.join(config_names())}"
    if file.parent == Path() and file.suffix not in ("", ".yaml", ".yml"):  # as rig.cameras, of rig.cameras 6
        hint = f"an option is given with its value, as {path}=VALUE"
    raise InputError(f"{path}: config: expected a YAML file or a shipped name, got {str(path)!r}; {hint}")


@cache
def shipped_values(name: str) -> dict[str, Any]:
    """What a shipped configuration says, as its file has it; not to be changed."""
    return read_yaml(config_dir() / f"{name}.yaml")[0]
