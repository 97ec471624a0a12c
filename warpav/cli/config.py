"""Commands about configurations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from warpav.cli.arguments import (
    DEFAULT_CONFIG,
    Config,
    Overrides,
    loaded,
    say,
)
from warpav.core.errors import InputError

config_app = App(name="config", help="Show, check, copy and compare configurations.")


@config_app.command(name="show")
def config_show(config: Config = DEFAULT_CONFIG, /, *overrides: Overrides) -> None:
    """Print a configuration with all its defaults."""
    from warpav.runs.config import dump_config

    say(*dump_config(loaded(config, overrides)).splitlines())


@config_app.command(name="check")
def config_check(config: Config = DEFAULT_CONFIG, /, *overrides: Overrides) -> None:
    """Check a configuration, and name everything that is wrong with it."""
    from warpav.runs.config import placed_config
    from warpav.runs.placement import Placement

    if "=" in config:
        config, overrides = DEFAULT_CONFIG, (config, *overrides)
    with placed_config(config, overrides) as settings:
        Placement.from_config(settings)
    say("the configuration is valid")


@config_app.command(name="schema")
def config_schema(
    *,
    of: Annotated[
        Literal["config", "rig", "modules", "zones", "requirements"], Parameter(help="Of which file.")
    ] = "config",
) -> None:
    """Print the JSON Schema with which editors complete and check configurations, or other files that people write."""
    import json

    from warpav.runs.file_schemas import file_schema

    say(*json.dumps(file_schema(of), indent=1).splitlines())


@config_app.command(name="copy")
def config_copy(name: Config, target: Annotated[Path, Parameter(help="File to write.")], /) -> None:
    """Copy a shipped configuration, comments included, to start one's own from."""
    from warpav.runs.config import find_config

    source = find_config(name)
    if target.exists():
        raise InputError(f"{target}: expected a file that does not exist yet, got one that does")
    if not target.parent.is_dir():
        raise InputError(f"{target}: expected an existing folder to write to, got {str(target.parent)!r}")
    target.write_bytes(source.read_bytes())
    say(f"wrote {target}")


@config_app.command(name="diff")
def config_diff(one: Config, other: Config, /) -> None:
    """List the options in which two configurations differ."""
    from warpav.runs.config import load_config, option_values

    left, right = (option_values(load_config(name)) for name in (one, other))
    for name, value in left.items():
        if value != right[name]:
            say(f"{name}: {value} -> {right[name]}")
