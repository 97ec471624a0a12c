"""Commands about runs: optimise, evaluate, render, inspect, view, report."""

from __future__ import annotations

import gc
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from warpav.cli._arguments import (
    DEFAULT_CONFIG,
    Beside,
    Config,
    Overrides,
    Requirements,
    RigConfig,
    RigSource,
    SceneSource,
    Verbose,
    configured,
    executor_overrides,
    of_rig,
    say,
)
from warpav.core.errors import ArgumentError, InputError, OptionError


def optimise(
    config: Config = DEFAULT_CONFIG,
    /,
    *overrides: Overrides,
    executor: Annotated[
        Literal["serial", "process", "ray", "slurm"] | None,
        Parameter(help="Where the search by a pool draws its cameras; by default here, with a thread for each core."),
    ] = None,
    workers: Annotated[int | None, Parameter(help="Scenes that are drawn at a time.")] = None,
    address: Annotated[str | None, Parameter(help="Of a Ray cluster.")] = None,
    resume: Annotated[
        Path | None,
        Parameter(
            help="Run folder: go on with the run that was stopped there, with its own configuration but for options "
            "that change nothing of what was computed, such as run.iterations and optimiser.pool_rounds."
        ),
    ] = None,
    verbose: Verbose = False,
) -> None:
    """Find where the cameras of a rig see traffic best, and compare the result with baselines."""
    from warpav.runs import RunDisplay
    from warpav.runs.config import find_config, placed_config

    if "=" in config:
        config, overrides = DEFAULT_CONFIG, (config, *overrides)
    folder = None
    if resume is not None:
        from warpav.runs import RunFolder

        folder = RunFolder.open(resume)
        if config != DEFAULT_CONFIG:
            raise ArgumentError("resume", f"expected no configuration, as the run has its own, got {config}")
        config = str(folder.path / "config.yaml")
    given = executor_overrides(executor, workers, address)
    with placed_config(config, [*overrides, *given]) as settings, RunDisplay(verbose=verbose) as display:
        if given and settings.optimiser.search == "descent":
            raise OptionError(
                "executor.name",
                f"expected none with optimiser.search={settings.optimiser.search}, whose steps follow one another, got "
                f"{settings.executor.name}; set optimiser.search=pool",
            )
        scenes = settings.scenes
        display.say(
            f"{find_config(config).name}: {scenes.search_scene_count} scenes to search on, {len(scenes.test_seeds)} to "
            f"compare on, {settings.device}"
        )
        from warpav.runs import optimise_rig, resume_rig  # a second of imports, after the first line
        from warpav.runs.report.tables import next_commands, show_everything, show_run

        gc.freeze()  # what was imported stays: collections need not look at it again
        if folder is None:
            folder, _, run = optimise_rig(settings, name=find_config(config).stem, progress=display)
        else:
            _, run = resume_rig(folder, settings, progress=display)
        (show_everything if verbose else show_run)(display.console, run)
        say(f"next: {' | '.join(next_commands(run, str(folder.path)))}")
        say(f"report: {folder.path / 'report.html'}")


def front(
    config: Config = DEFAULT_CONFIG,
    /,
    *overrides: Overrides,
    out: Annotated[Path, Parameter(help="Folder for the rigs, the table and the figure.")],
    by: Annotated[
        Literal["cameras", "cost"] | None,
        Parameter(
            help="One rig for every number of cameras, or one for every of some budgets; by default the numbers "
            "where rig.cameras is a range."
        ),
    ] = None,
) -> None:
    """Find the best rig of every number of cameras (rig.cameras=2..8) or of every cost."""
    from warpav.runs import FRONT_FILE, Placement, RunDisplay
    from warpav.runs import front as find_front

    if (out / FRONT_FILE).exists():  # before anything takes long
        raise ArgumentError("out", f"expected a folder without {FRONT_FILE}, got one that has it", place=out)
    with configured(config, overrides) as settings, RunDisplay() as display:
        found = find_front(Placement.from_config(settings), by=by, progress=display)
        folder = found.save(out)
    say(*str(found.table()).splitlines())
    say(f"wrote {folder}")


def evaluate(
    rig: RigSource,
    /,
    *overrides: Overrides,
    beside: Beside = None,
    json: Annotated[Path | None, Parameter(help="File to write the metrics to.")] = None,
    config: RigConfig = None,
    soiling: Annotated[
        tuple[Literal["disc", "rows", "columns"], float, float, float] | None,
        Parameter(
            help="Also what the rig misses with a part of one camera's image covered, for each camera: its shape, its "
            "middle as shares of width and height, its share of the image's area, such as disc 0.5 0.5 0.1."
        ),
    ] = None,
    load: Annotated[
        list[tuple[float, float]] | None,
        Parameter(
            allow_leading_hyphen=True,
            help="Also what it misses with the vehicle pitched by so many degrees, nose down positive, and raised by "
            "so many metres, such as -1 -0.05. May be given several times.",
        ),
    ] = None,
    verbose: Verbose = False,
) -> None:
    """Measure a rig on the test scenes."""
    from warpav.runs import RunDisplay, measure_rig, posed_otherwise
    from warpav.runs.report.tables import show_everything, show_run

    part, loads = posed_otherwise(soiling, load)
    with of_rig(rig, config, overrides) as settings, RunDisplay(verbose=verbose) as display:
        found = measure_rig(
            rig, settings, beside=beside or (), json_file=json, soiled=part, loads=loads, progress=display
        )
        (show_everything if verbose else show_run)(display.console, found)


def compare(
    rig: RigSource,
    other: RigSource,
    /,
    *further: Annotated[str, Parameter(help="A third rig, and key=value, such as scenes.test_seeds=1000..1029.")],
    out: Annotated[Path, Parameter(help="HTML file to write: a page that stands alone, to be sent to others.")],
    config: RigConfig = None,
) -> None:
    """Compare two or three rigs on the same unseen scenes, side by side on one page."""
    from warpav.runs import RunDisplay, compare_rigs

    sources, overrides = _rigs_and_overrides(rig, (other, *further))
    again = shlex.join(["warpav", "compare", *sources, "--out", out.name, *overrides])
    with of_rig(rig, config, overrides) as settings, RunDisplay(verbose=False) as display:
        say(f"wrote {compare_rigs(sources, settings, out, again=again, progress=display)}")


def check(
    rig: RigSource,
    /,
    *overrides: Overrides,
    requirements: Requirements = "near_field",
    out: Annotated[Path, Parameter(help="HTML file to write.")] = Path("check.html"),
    config: RigConfig = None,
) -> int:
    """Check whether a rig is all right: requirements and design rules with margins, on one page.

    Status 1 where a hard requirement or a design rule is broken.
    """
    from warpav.runs import check_rig_page

    with of_rig(rig, config, overrides) as settings:
        file, items = check_rig_page(rig, settings, requirements=requirements, out=out)
    failed = [each for each in items if each.is_kept is False and each.is_hard]
    for each in failed:
        say(f"FAIL {each.about}: {each.found}, asked {each.asked}")
    say(f"{'FAIL' if failed else 'PASS'}: wrote {file}")
    return 1 if failed else 0


def render(
    scene: SceneSource,
    /,
    *overrides: Overrides,
    rig: RigSource,
    out: Annotated[Path, Parameter(help="Folder for the images.")],
    config: RigConfig = None,
) -> None:
    """Render what every camera of a rig sees: colours, objects, depth, cameras."""
    from warpav.runs import render_rig

    with of_rig(rig, config, overrides) as settings:
        folder = render_rig(scene, rig, settings, out, overrides)
    say(f"wrote {folder}")


def inspect(
    run_or_rig: RigSource,
    /,
    *overrides: Overrides,
    out: Annotated[
        Path | None,
        Parameter(
            help="PNG, HTML, GIF or MP4 to write, of a sheet PDF, SVG or PNG. GIF and MP4 are one turn around the "
            "vehicle; of a run, without --show, animations of its iterations. RRD is a recording for the Rerun viewer, "
            "which needs the extra rerun."
        ),
    ] = None,
    show: Annotated[
        Literal["rig", "coverage", "redundancy", "outcomes", "visibility", "further", "zones", "gain", "sheet"],
        Parameter(
            help="Besides the rig: coverage, how many cameras see a child where; redundancy, how many see the ground "
            "itself; zones, where cameras may stand on the body; outcomes, which vehicles are "
            "detected, missed, hidden or out of frame; visibility, what every camera sees; "
            "further, of a run with optimiser.search=pool, where one more camera would help most, gain, the same "
            "painted on the body; sheet, instead of "
            "all that, a page to print (PDF, SVG or PNG) with the rig to scale from above and from the side."
        ),
    ] = "rig",
    requirements: Annotated[
        str | None,
        Parameter(help="YAML file of requirements, or a template such as near_field: which of their points are met."),
    ] = None,
    config: RigConfig = None,
) -> None:
    """Inspect a rig on its vehicle: interactively when there is a display, else in a file."""
    from warpav.runs import RunDisplay, inspect_rig, no_window_text

    with of_rig(run_or_rig, config, overrides) as settings, RunDisplay() as display:
        file = inspect_rig(run_or_rig, settings, out, shown=show, requirements=requirements, progress=display)
    if file is not None and out is None and show != "sheet":
        say(f"{no_window_text()}: wrote {file}")
    elif file is not None:
        say(f"wrote {file}")


def view(
    source: Annotated[str, Parameter(help="Run folder, rig YAML, preset, highest, or the GLB of a scene.")],
    /,
    *further: Annotated[
        str, Parameter(help="One or two more rigs, to see what each alone sees, and key=value, such as rig.cameras=6.")
    ],
    rig: Annotated[str, Parameter(help="Rig to show in the GLB of a scene.")] = "highest",
    port: Annotated[int, Parameter(help="Port of this machine, 0 for any that is free.")] = 8765,
    out: Annotated[
        Path | None, Parameter(help="HTML file to write instead: a page that stands alone, to be sent to others.")
    ] = None,
    config: RigConfig = None,
) -> None:
    """View a rig in a browser: the inspector, served to this machine only, or a page that stands alone."""
    from warpav.runs import serve_inspector, write_inspector_page

    is_scene = source.lower().endswith((".glb", ".usd", ".usda", ".usdc", ".usdz"))
    shown, scene = (rig, Path(source)) if is_scene else (source, None)
    if not is_scene and rig != "highest":
        raise ArgumentError(
            "rig", f"expected it beside the GLB of a scene, got {rig!r} beside {source!r}; leave one out"
        )
    rigs, overrides = _rigs_and_overrides(source, further)
    if len(rigs) > 1 and (is_scene or out is not None):
        hint = f"warpav compare {shlex.join(rigs)} --out page.html writes a page" if out else "leave the scene out"
        raise InputError(f"command line: expected one rig, got {shlex.join(rigs)}; {hint}")
    with of_rig(shown, config, overrides) as settings:
        if len(rigs) > 1:
            from warpav.runs import RunDisplay, comparison_view

            with RunDisplay(verbose=False) as display:
                compared = comparison_view(rigs, settings, progress=display)
            compared.serve(port=port, ready=_say_address)
        elif out is not None:
            say(f"wrote {write_inspector_page(shown, settings, out, scene=scene)}")
        else:
            gc.disable()  # until the address is printed: what is made up to there stays
            try:
                serve_inspector(shown, settings, scene=scene, port=port, ready=_say_address)
            finally:
                gc.enable()


def _rigs_and_overrides(rig: str, further: Sequence[str]) -> tuple[list[str], list[str]]:
    return [rig, *(each for each in further if "=" not in each)], [each for each in further if "=" in each]


def _say_address(url: str, port: int) -> None:
    gc.freeze()
    gc.enable()
    say(f"open {url}")
    say(f"from another machine first: ssh -L {port}:127.0.0.1:{port} THIS_MACHINE; Ctrl-C ends the viewer")


def plot(
    rig_or_run: RigSource,
    /,
    *overrides: Overrides,
    kind: Annotated[
        str,
        Parameter(
            help="plan, how far each camera's image of a car is large enough; ground, what near the vehicle no camera "
            "sees; range, how far road users are detected; near_field, how far from the body the first visible point "
            "is; redundancy, how many cameras see a road user where; resolution, pixels per degree; contact, images "
            "of all cameras; sheet, a page to print; view, in space; of a run also top_view, search, further and gain; "
            "or all."
        ),
    ],
    out: Annotated[
        Path | None, Parameter(help="PNG, SVG or PDF to write, of all kinds a folder; by default KIND.png.")
    ] = None,
    beside: Beside = None,
    config: RigConfig = None,
) -> None:
    """Draw a plot of a rig or a run to scale, for an engineer who fits it to a vehicle."""
    from warpav.runs import RunDisplay, asked_plots, draw_plots

    asked = asked_plots(rig_or_run, kind=kind, out=out, beside=beside or ())
    with of_rig(rig_or_run, config, overrides) as settings, RunDisplay() as display:
        files, left_out = draw_plots(rig_or_run, asked, settings, beside=beside or (), progress=display)
    for file in files:
        say(f"wrote {file}")
    for name, reason in left_out.items():
        say(f"no {name}: {reason}")


def report(
    run: Annotated[str, Parameter(help="Run folder.")],
    /,
    *,
    full: Annotated[bool, Parameter(negative=(), help="Draw all pictures first, not only those of a run.")] = False,
) -> None:
    """Write the HTML report of a run again."""
    from warpav.runs import RunFolder
    from warpav.runs.report.report import write_report

    folder = RunFolder.open(run)
    if full:
        from warpav.runs import RunDisplay, RunPictures

        with RunDisplay() as display:
            RunPictures.of_folder(folder, display).draw(display, full=True)
    say(f"wrote {write_report(folder)}")
