"""Commands that show and check what a run is given: configurations, catalogues of modules, this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from warpav.cli._arguments import DEFAULT_CONFIG, Config, Overrides, configured, loaded, say
from warpav.core.errors import InputError

config_app = App(name="config", help="Show, check, copy and compare configurations.")
modules_app = App(name="modules", help="Catalogues of camera modules.")


@config_app.command(name="show")
def _config_show(
    config: Config = DEFAULT_CONFIG,
    /,
    *overrides: Overrides,
    every: Annotated[bool, Parameter(name="--all", negative="", help="All options, not only the usual ones.")] = False,
) -> None:
    """Print the usual options of a configuration, and those that it sets; with --all every option."""
    from warpav.runs.config import USUAL_OPTIONS, Config, dump_config, option_values

    settings = loaded(config, overrides)
    values, default = option_values(settings), option_values(Config(method=settings.method))
    usual = [name for name in values if name in USUAL_OPTIONS or values[name] != default[name]]
    say(*dump_config(settings, only=None if every else usual).splitlines())
    if not every:
        say(f"# {len(values) - len(usual)} options more, all as by default: warpav config show --all")


@config_app.command(name="check")
def _config_check(config: Config = DEFAULT_CONFIG, /, *overrides: Overrides) -> None:
    """Check a configuration, and name everything that is wrong with it."""
    from warpav.runs import Placement

    with configured(config, overrides) as settings:
        Placement.from_config(settings)
    say("the configuration is valid")


@config_app.command(name="schema")
def _config_schema(
    *,
    of: Annotated[
        Literal["config", "rig", "modules", "zones", "requirements"], Parameter(help="Of which file.")
    ] = "config",
) -> None:
    """Print the JSON Schema with which editors complete and check configurations, or other files that people write."""
    import json

    from warpav.runs.config import file_schema

    say(*json.dumps(file_schema(of), indent=1).splitlines())


@config_app.command(name="copy")
def _config_copy(name: Config, target: Annotated[Path, Parameter(help="File to write.")], /) -> None:
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
def _config_diff(one: Config, other: Config, /) -> None:
    """List the options in which two configurations differ."""
    from warpav.runs.config import load_config, option_values

    left, right = (option_values(load_config(name)) for name in (one, other))
    for name, value in left.items():
        if value != right[name]:
            say(f"{name}: {value} -> {right[name]}")


@modules_app.command(name="list")
def _modules_list(
    file: Annotated[Path | None, Parameter(help="Catalogue, YAML; by default the one that ships with warpav.")] = None,
    /,
) -> None:
    """List camera modules: sensor, image of the network, lens, field of view, resolution, price, power, zones, source.

    Field of view and pixels per degree are those of the image that the network gets.
    """
    from warpav.rig import builtin_modules, module_table, read_modules

    say(*module_table(builtin_modules() if file is None else read_modules(file)).splitlines())


@modules_app.command(name="check")
def _modules_check(file: Annotated[Path, Parameter(help="Catalogue, YAML.")], /) -> None:
    """Check a catalogue: one line per problem with file, line, field, what was expected, what came, how to fix it.

    Status 0: every module can be used; 2: something has to be corrected.
    """
    from warpav.rig import read_modules

    modules = read_modules(file)
    say(f"{file}: {len(modules)} module{'' if len(modules) == 1 else 's'}, no problems")


def doctor(*, json: Annotated[Path | None, Parameter(help="File to write the findings to.")] = None) -> int:
    """Check this machine: versions, devices, OpenGL, cache, a self-test of the renderer."""
    from warpav.runs import examine

    return examine(json_file=json)


def bench(
    *,
    workload: Annotated[Path | None, Parameter(help="Workload (.npz of format 1); by default the embedded.")] = None,
    truth: Annotated[Path | None, Parameter(help="Truth of the workload (.npz), to score the results.")] = None,
    lens: Annotated[
        Literal["pinhole", "brown_conrady", "fisheye", "eucm", "double_sphere", "panorama", "equirectangular"],
        Parameter(help="What the cameras look through: fields of view of 100, 190 or 360 degrees but for a pinhole."),
    ] = "pinhole",
    device: Annotated[str, Parameter(help="cpu or cuda:0.")] = "cpu",
    items: Annotated[str, Parameter(help="W1 silhouettes, W2 depth and objects, W3 colours.")] = "w1,w2,w3",
    supersample: Annotated[Literal[1, 2, 4, 8], Parameter(help="Samples per pixel along each axis for W1.")] = 1,
    repeat: Annotated[int, Parameter(help="Measured runs of every item.")] = 7,
    json: Annotated[Path | None, Parameter(help="File to write; W2's and W3's arrays go beside it.")] = None,
    embree: Annotated[
        bool | None, Parameter(help="Measure embree too; by default on the CPU, unless the workload is very large.")
    ] = None,
    sweep: Annotated[bool, Parameter(help="Measure W1 with supersampling x1, x2, x4 and x8 as well.")] = False,
) -> None:
    """Measure the renderer on a benchmark, score its gradient, and set it beside other renderers."""
    from warpav.experiments import BenchOptions, run_bench
    from warpav.runs import RunDisplay

    with RunDisplay() as display:
        options = BenchOptions(device, lens, items, supersample, repeat, embree, sweep)
        run_bench(workload, truth, options, json_file=json, progress=display)
