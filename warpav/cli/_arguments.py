"""Arguments that several commands share, and how commands print."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from warpav.core.errors import InputError, one_line, printable
from warpav.rig import EXPORTED_ONLY, IMPORTED_ONLY, RIG_FORMATS

if TYPE_CHECKING:
    from warpav.runs.config import Config as Settings

DEFAULT_CONFIG = "quick"
_LINES_MAX, _LINE_MAX = 60, 2000  # of a message; files may have a hundred thousand mistakes

Config = Annotated[str, Parameter(help="YAML file, or the name of a shipped configuration.")]
Overrides = Annotated[str, Parameter(help="key=value, such as rig.cameras=6.")]
_Triple = tuple[float, float, float]
FileFormat = Annotated[
    str,
    Parameter(
        name="--format",
        help=f"{', '.join(name for name in RIG_FORMATS if name not in (*IMPORTED_ONLY, *EXPORTED_ONLY))}; "
        f"{', '.join(IMPORTED_ONLY)} (import), {', '.join(EXPORTED_ONLY)} (export).",
    ),
]
FileOrigin = Annotated[
    _Triple | None,
    Parameter(
        help="Where the file's origin lies, from the ground below the centre of the rear axle: x y z.", negative=""
    ),
]
FileTurn = Annotated[
    _Triple, Parameter(help="How the file's axes are turned on the vehicle: roll pitch yaw.", negative="")
]
RigConfig = Annotated[
    str | None, Parameter(name="--config", help="Configuration; by default that of the run folder, or quick.")
]
Beside = Annotated[
    list[str] | None, Parameter(help="Another rig to compare with, as the first is given. May be given several times.")
]
Requirements = Annotated[
    str, Parameter(help="YAML file, or near_field, near_series, near_robot, r46_like, r158_like, r159_like.")
]
RigSource = Annotated[str, Parameter(help="Rig YAML, preset, run folder, or by hand: corners, cross, edge, highest.")]
Executor = Annotated[Literal["serial", "process"], Parameter(help="process spreads scenes over processes.")]
Workers = Annotated[int | None, Parameter(help="Processes; by default one for each core.")]
TaskExecutor = Annotated[
    Literal["serial", "process", "ray", "slurm"] | None, Parameter(help="Where the runs take place.")
]
FileAxis = Literal["x", "y", "z", "-x", "-y", "-z"]
Verbose = Annotated[bool, Parameter(help="Every stage, table and statement.", negative="")]
SceneSource = Annotated[str, Parameter(help="Scene as GLB or USD, or the seed of an embedded scene.")]


def flag_of(argument: str) -> str:
    """What the command line calls an argument of a function."""
    return "--format" if argument == "format_name" else f"--{argument.replace('_', '-')}"


def with_flags(text: str) -> str:
    """A message whose arguments, in backquotes, are written as the flags that they are here."""
    return re.sub(r"`([a-z_]+)`", lambda found: flag_of(found[1]), text)


def say(*lines: str) -> None:
    """Print lines to stdout."""
    sys.stdout.writelines(f"{one_line(line)}\n" for line in lines)


def complain(text: str) -> None:
    """Print to stderr; of what is endless the beginning."""
    lines = printable(text[: _LINES_MAX * _LINE_MAX]).split("\n")
    for line in lines[:_LINES_MAX]:
        sys.stderr.write(f"{line if len(line) <= _LINE_MAX else f'{line[:_LINE_MAX]}...'}\n")
    if len(lines) > _LINES_MAX:
        sys.stderr.write("and more of these\n")


def seeds_of(seeds: str | None, count: int | None) -> tuple[int, ...]:
    """The seeds that a user gave, as a text or as their number from 0."""
    from warpav.runs.config import read_seeds

    if (seeds is None) == (count is None):
        raise InputError("command line: expected either --seeds or --count, got both or none; write --seeds 0..9")
    if count is not None and count < 1:
        raise InputError(f"command line (--count): expected at least 1, got {count}")
    return tuple(range(count)) if count is not None else read_seeds(str(seeds), place="command line (--seeds)")


def configured(config: str, overrides: Sequence[str]) -> AbstractContextManager[Settings]:
    """The configuration of a command, for a ``with`` block; without one the first word may be an override."""
    from warpav.runs.config import placed_config

    if "=" in config:
        config, overrides = DEFAULT_CONFIG, (config, *overrides)
    return placed_config(config, overrides)


def loaded(config: str, overrides: Sequence[str]) -> Settings:
    """The configuration of a command that needs nothing else."""
    with configured(config, overrides) as settings:
        return settings


def of_rig(rig: str, config: str | None, overrides: Sequence[str]) -> AbstractContextManager[Settings]:
    """The same of a command about a rig: the given one, else that of the run folder, else the default."""
    from warpav.runs import config_for

    return config_for(rig, config, overrides, default=DEFAULT_CONFIG)


def executor_overrides(name: str | None, workers: int | None, address: str | None) -> list[str]:
    """Flags of an executor as overrides of the configuration."""
    flags = {"name": name, "workers": workers, "address": address}
    return [f"executor.{flag}={value}" for flag, value in flags.items() if value is not None]
