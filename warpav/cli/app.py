"""The command line: one function per verb, which reads its input, calls what does the work, and prints.

Exit status: 0 done, 1 the run failed, 2 the input is wrong, 130 interrupted. Nothing heavy is imported before a verb
needs it, so that ``--help`` and ``config`` answer at once.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, Parameter

from warpav import __version__
from warpav.core.errors import ArgumentError, InputError

DEFAULT_CONFIG = "quick"

app = App(
    name="warpav",
    version=__version__,
    help="Find where cameras should sit on a vehicle, by gradient descent through a differentiable rasteriser.",
    help_epilogue="Options are key=value, such as rig.cameras=6 camera.fov_deg='80 deg'; 'warpav config show' lists "
    "them. --debug shows where an error was raised.",
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)
scenes_app = App(name="scenes", help="Make and look at traffic scenes.")
config_app = App(name="config", help="Show, check, copy and compare configurations.")
experiment_app = App(name="experiment", help="Run experiments, judge their rigs anew, write their results as a page.")
rig_app = App(name="rig", help="Known camera rigs; rig files of other tools; what is in a rig.")
detector_app = App(
    name="detector", help="Check, measure and train object detectors, and fit how probably they find objects."
)
vehicle_app = App(name="vehicle", help="Your own vehicle.")
for _group in (experiment_app, scenes_app, config_app, rig_app, detector_app, vehicle_app):
    app.command(_group)

Config = Annotated[str, Parameter(help="YAML file, or the name of a shipped configuration.")]
Overrides = Annotated[str, Parameter(help="key=value, such as rig.cameras=6.")]
Triple = tuple[float, float, float]
FileFormat = Annotated[
    str,
    Parameter(
        name="--format",
        help="nuscenes, argoverse2, urdf, autoware, carla-ros-bridge, carla-python, kitti, opencv; kalibr (import), "
        "camera-info (export).",
    ),
]
FileOrigin = Annotated[
    Triple | None,
    Parameter(
        help="Where the file's origin lies, from the ground below the middle of the rear axle: x y z.", negative=""
    ),
]
FileTurn = Annotated[
    Triple, Parameter(help="How the file's axes are turned on the vehicle: roll pitch yaw.", negative="")
]
RigSource = Annotated[str, Parameter(help="Rig YAML, preset, run folder, or highest.")]
Executor = Annotated[Literal["serial", "process"], Parameter(help="process spreads scenes over processes.")]
Workers = Annotated[int | None, Parameter(help="Processes; by default one for each core.")]
TaskExecutor = Annotated[
    Literal["serial", "process", "ray", "slurm"] | None, Parameter(help="Where the runs take place.")
]
FileAxis = Literal["x", "y", "z", "-x", "-y", "-z"]
SceneSource = Annotated[str, Parameter(help="Scene GLB, or the seed of an embedded scene.")]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Args:
        argv: Arguments without the program's name; those of the process when None.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    try:
        status = app(arguments, exit_on_error=False, print_error=False)
    except KeyboardInterrupt:
        _complain("interrupted")
        return 130
    except BrokenPipeError:
        return 1
    except (InputError, CycloptsError) as error:
        if debug:
            raise
        _complain(_text_of(error))
        return 2
    except Exception as error:
        if debug:
            raise
        text = " ".join(str(error).split())
        _complain(f"failed: {type(error).__name__}: {text}; run again with --debug to see where")
        return 1
    return status if isinstance(status, int) else 0


@app.command(alias="optimize")
def optimise(config: Config = DEFAULT_CONFIG, /, *overrides: Overrides) -> None:
    """Move the cameras of a rig until a detector sees more traffic, and compare the result with baselines."""
    from warpav.runs.config import find_config, placed_config
    from warpav.runs.jobs import optimise_rig
    from warpav.runs.progress import RunDisplay, show_verdict

    if "=" in config:
        config, overrides = DEFAULT_CONFIG, (config, *overrides)
    with placed_config(config, overrides) as settings, RunDisplay() as display:
        _, evaluation = optimise_rig(settings, name=find_config(config).stem, progress=display)
        show_verdict(display.console, evaluation)


@app.command
def evaluate(
    rig: RigSource,
    /,
    *overrides: Overrides,
    json: Annotated[Path | None, Parameter(help="File to write the metrics to.")] = None,
    config: Annotated[str | None, Parameter(help="Configuration; by default that of the run folder, or quick.")] = None,
) -> None:
    """Measure a rig on the test scenes."""
    from warpav.runs.jobs import measure_rig
    from warpav.runs.progress import RunDisplay, show_verdict
    from warpav.runs.rig_source import config_for

    with config_for(rig, config, overrides, default=DEFAULT_CONFIG) as settings, RunDisplay() as display:
        show_verdict(display.console, measure_rig(rig, settings, json_file=json, progress=display))


@experiment_app.default
def experiment(
    name: Annotated[
        Literal["table1", "table2", "table3", "table4", "table5", "open", "ablations", "correlation"],
        Parameter(
            help="A table of the thesis; open: all ways to find a rig at equal budgets; ablations: the default method "
            "with one thing changed at a time; correlation: whether its objective ranks rigs as the detector does."
        ),
    ],
    config: Annotated[
        str | None, Parameter(help="YAML file or shipped configuration; by default thesis for tables, else default.")
    ] = None,
    /,
    *overrides: Overrides,
    runs: Annotated[int | None, Parameter(help="Run seeds an arm, from run.seed; by default the experiment's.")] = None,
    arms: Annotated[str | None, Parameter(help="Only these, such as sgd_ifr,highest_ifr_doa,cma.")] = None,
    budget: Annotated[
        int | None, Parameter(help="Scene renders for every search; by default what the gradient method takes.")
    ] = None,
    executor: TaskExecutor = None,
    workers: Annotated[int | None, Parameter(help="Runs at a time.")] = None,
    address: Annotated[str | None, Parameter(help="Of a Ray cluster.")] = None,
    out: Annotated[Path | None, Parameter(help="Folder; by default runs/NAME.")] = None,
    quick: Annotated[bool, Parameter(help="A small version, of minutes.", negative="")] = False,
) -> int:
    """Run an experiment and print its table; the same command again does what is missing."""
    from warpav.experiments import open_experiments, thesis_experiments
    from warpav.experiments.experiment import arms_of, overrides_of
    from warpav.runs.config import placed_config
    from warpav.runs.progress import RunDisplay

    if config is not None and "=" in config:
        config, overrides = None, (config, *overrides)
    is_thesis = name in thesis_experiments.EXPERIMENTS
    found = (thesis_experiments if is_thesis else open_experiments).EXPERIMENTS[name]
    run = thesis_experiments.run_table if is_thesis else open_experiments.run_open
    chosen = arms_of(found, arms)
    given = _executor_overrides(executor, workers, address)
    whole = overrides_of(found, [*overrides, *given], arms=chosen, quick=quick)
    with placed_config(config or found.config, whole) as settings, RunDisplay() as display:
        done = run(
            name,
            settings,
            arms=chosen,
            runs=runs,
            render_budget=budget,
            out=out,
            quick=quick,
            progress=display,
        )
    return 1 if done.failed else 0


@experiment_app.command(name="rescore")
def experiment_rescore(
    folder: Annotated[Path, Parameter(help="Folder of an experiment.")],
    /,
    *overrides: Overrides,
    name: Annotated[str | None, Parameter(help="Of the new results; by default made of the options.")] = None,
    executor: TaskExecutor = None,
    workers: Annotated[int | None, Parameter(help="Rigs at a time.")] = None,
    address: Annotated[str | None, Parameter(help="Of a Ray cluster.")] = None,
) -> int:
    """Judge the rigs of an experiment by another detector, image size or source of scenes.

    Such as detector.model=FILE.onnx camera.width_px=640 camera.height_px=640, or scenes.source=captured. Prints the
    same table, and whether the arms come in the same order; writes to FOLDER/rescored_NAME.
    """
    from warpav.experiments.rescore import check_judging, config_file, folder_name, run_rescore
    from warpav.runs.config import placed_config
    from warpav.runs.progress import RunDisplay

    check_judging(overrides)
    name = folder_name(name, overrides)
    given = _executor_overrides(executor, workers, address)
    with placed_config(config_file(folder), [*overrides, *given]) as settings, RunDisplay() as display:
        done = run_rescore(folder, settings, name=name, progress=display)
    return 1 if done.failed else 0


@experiment_app.command(name="results")
def experiment_results(
    *folders: Annotated[Path, Parameter(help="Folders of experiments, or of rescored ones.")],
    out: Annotated[Path, Parameter(help="Markdown file; the numbers of every run go into a folder beside it.")],
) -> None:
    """Write the results of experiments as a page: tables, goals, seeds, commands, versions, every run."""
    from warpav.experiments.summary import write_results_page

    _say(f"wrote {write_results_page(folders, out)}")


@app.command
def render(
    scene: SceneSource,
    /,
    *overrides: Overrides,
    rig: RigSource,
    out: Annotated[Path, Parameter(help="Folder for the images.")],
) -> None:
    """Render what every camera of a rig sees: colours, objects, depth, and the cameras themselves."""
    from warpav.runs.rig_source import config_for
    from warpav.runs.run_figures import render_rig

    with config_for(rig, None, overrides, default=DEFAULT_CONFIG) as settings:
        folder = render_rig(scene, rig, settings, out, overrides)
    _say(f"wrote {folder}")


@app.command
def inspect(
    run_or_rig: RigSource,
    /,
    *overrides: Overrides,
    out: Annotated[
        Path | None,
        Parameter(
            help="PNG, HTML, GIF or MP4 to write. GIF and MP4 are one turn around the vehicle; of a run, without "
            "--show, films over its iterations."
        ),
    ] = None,
    show: Annotated[
        Literal["rig", "coverage", "outcomes", "sight"],
        Parameter(
            help="Besides the rig: coverage, how many cameras see a child where; outcomes, which vehicles are "
            "detected, missed, hidden or out of frame; sight, what every camera sees."
        ),
    ] = "rig",
) -> None:
    """Inspect a rig on its vehicle: interactively when there is a display, else in a file."""
    from warpav.runs.inspect import inspect_rig
    from warpav.runs.progress import RunDisplay
    from warpav.runs.rig_source import config_for

    with config_for(run_or_rig, None, overrides, default=DEFAULT_CONFIG) as settings:
        file = inspect_rig(run_or_rig, settings, out, shown=show, display=RunDisplay())
    if file is not None and out is None:
        from warpav.view.opengl import display_text

        _say(f"no window here, as {display_text()}: wrote {file}")
    elif file is not None:
        _say(f"wrote {file}")


@app.command
def report(run: Annotated[str, Parameter(help="Run folder.")], /) -> None:
    """Write the HTML report of a run again."""
    from warpav.runs.report.report import write_report
    from warpav.runs.run_folder import RunFolder

    _say(f"wrote {write_report(RunFolder.open(run))}")


@app.command
def doctor(*, json: Annotated[Path | None, Parameter(help="File to write the findings to.")] = None) -> int:
    """Check this machine: versions, devices, OpenGL, execution providers, cache, a self-test of the renderer."""
    from warpav.runs.doctor import examine

    return examine(json_file=json)


@app.command
def bench(
    *,
    workload: Annotated[Path | None, Parameter(help="Workload (.npz of format 1); by default the embedded.")] = None,
    truth: Annotated[Path | None, Parameter(help="Truth of the workload (.npz), to score the results.")] = None,
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
    from warpav.experiments.bench.run import run_bench
    from warpav.runs.progress import RunDisplay

    with RunDisplay() as display:
        run_bench(
            workload,
            truth,
            device=device,
            items=items,
            supersampling=supersample,
            repeat=repeat,
            json_file=json,
            with_embree=embree,
            with_sweep=sweep,
            progress=display,
        )


@scenes_app.command(name="make")
def scenes_make(
    *,
    out: Annotated[Path, Parameter(help="Folder for the files, scene_SEED.glb.")],
    seeds: Annotated[str | None, Parameter(help="Range such as 1000..1009 or list such as [1,2,3].")] = None,
    count: Annotated[int | None, Parameter(help="Instead of --seeds: this many, from seed 0.")] = None,
    executor: Executor = "serial",
    workers: Workers = None,
) -> int:
    """Build embedded street scenes and write each as a GLB file; what is there already stays."""
    from warpav.runs.scenes import build_scenes

    return build_scenes(_seeds(seeds, count), out, executor=executor, worker_count=workers)


@scenes_app.command(name="capture")
def scenes_capture(
    *overrides: Overrides,
    out: Annotated[Path, Parameter(help="Folder for the captures, scene_SEED.")],
    seeds: Annotated[str | None, Parameter(help="Range such as 1000..1009 or list such as [1,2,3].")] = None,
    count: Annotated[int | None, Parameter(help="Instead of --seeds: this many, from seed 0.")] = None,
    simulator: Annotated[
        Literal["town", "carla"], Parameter(help="town is embedded; carla needs a running server.")
    ] = "town",
    host: Annotated[str, Parameter(help="CARLA's host.")] = "localhost",
    port: Annotated[int, Parameter(help="CARLA's port.")] = 2000,
    executor: Executor = "serial",
    workers: Workers = None,
    config: Config = DEFAULT_CONFIG,
) -> int:
    """Take colour, depth and instance images of situations; interrupted captures go on."""
    from warpav.runs.config import placed_config
    from warpav.runs.scenes import record_scenes

    with placed_config(config, overrides) as settings:
        return record_scenes(
            settings,
            _seeds(seeds, count),
            out,
            server=(host, port) if simulator == "carla" else None,
            executor=executor,
            worker_count=workers,
        )


@scenes_app.command(name="reconstruct")
def scenes_reconstruct(
    captures: Annotated[Path, Parameter(help="Capture, or folder of captures.")],
    /,
    *overrides: Overrides,
    out: Annotated[Path, Parameter(help="Folder for the files, scene_SEED.glb.")],
    executor: Executor = "serial",
    workers: Workers = None,
    config: Config = DEFAULT_CONFIG,
) -> int:
    """Make scenes of captures: point clouds, triangle meshes, colours."""
    from warpav.runs.config import placed_config
    from warpav.runs.scenes import reconstruct_scenes

    with placed_config(config, overrides) as settings:
        return reconstruct_scenes(settings, captures, out, executor=executor, worker_count=workers)


@scenes_app.command(name="check")
def scenes_check(captures: Annotated[Path, Parameter(help="Capture, or folder of captures.")], /) -> int:
    """Check captures, also those of other simulators and cameras, and name everything that is wrong with them."""
    from warpav.scene.store import captures_in, check_captures

    found = list(captures_in([captures]).values())
    bad = check_captures(found, _complain)
    _say(f"{len(found) - bad} of {len(found)} captures are valid")
    return 2 if bad else 0


@scenes_app.command(name="show")
def scenes_show(
    scene: SceneSource,
    /,
    *,
    out: Annotated[Path | None, Parameter(help="PNG, HTML, GIF or MP4 to write; by default a window.")] = None,
) -> None:
    """Show a scene and list its vehicles."""
    from warpav.runs.scenes import show_scene

    for line in show_scene(scene, out):
        _say(line)


@scenes_app.command(name="figure")
def scenes_figure(
    number: Annotated[int, Parameter(help="Its number in the thesis: 4 to 12, or 14 to 16.")],
    /,
    *overrides: Overrides,
    out: Annotated[Path, Parameter(help="PNG file to write.")],
    seed: Annotated[int | None, Parameter(help="Record this embedded situation for it; by default 3.")] = None,
    capture: Annotated[Path | None, Parameter(help="Instead, a capture.")] = None,
    scenes: Annotated[Path | None, Parameter(help="For figure 8: folder of scenes, scene_SEED.glb.")] = None,
    run: Annotated[str | None, Parameter(help="For figures 10 and 11: run folder; by default it runs now.")] = None,
    config: Annotated[
        str | None, Parameter(help="For figures 10 to 12: configuration; by default that of the run folder, or quick.")
    ] = None,
) -> None:
    """Draw a figure of the thesis.

    4: image types. 5: stages from images to meshes. 6: sphere. 7: window filter. 8: where vehicles stand.
    9: mount surface. 10: ways of the cameras without constraints. 11: views before and after optimisation, and of
    test scenes. 12: highest rig. 14 to 16: all colour, depth and instance images.
    """
    from warpav.view.scene_figures.by_number import RIG_NUMBERS, draw_figure

    if number not in RIG_NUMBERS:
        if overrides or run or config:
            raise InputError(
                f"figure {number}: expected no --run, --config or key=value; they go with figures 10 to 12"
            )
        _say(f"wrote {draw_figure(number, out, seed=seed, capture_folder=capture, scenes_folder=scenes)}")
        return
    if seed is not None or capture is not None or scenes is not None:
        raise InputError(f"figure {number}: expected --run, --config or key=value, got --seed, --capture or --scenes")
    from warpav.experiments.method_figures import draw_method_figure
    from warpav.rig.find import HIGHEST
    from warpav.runs.progress import RunDisplay
    from warpav.runs.rig_source import config_for
    from warpav.runs.run_folder import RunFolder

    folder = None if run is None else RunFolder.open(run)
    with config_for(run or HIGHEST, config, overrides, default=DEFAULT_CONFIG) as settings, RunDisplay() as display:
        file = draw_method_figure(number, out, settings, run=folder, progress=display)
    _say(f"wrote {file}")


@scenes_app.command(name="heatmap")
def scenes_heatmap(
    scenes: Annotated[Path, Parameter(help="Folder of scenes, scene_SEED.glb.")],
    /,
    *,
    out: Annotated[Path, Parameter(help="PNG file to write.")],
    train: Annotated[
        str | None, Parameter(help="Seeds to train on, such as 0..119; by default the first 60 %.")
    ] = None,
    test: Annotated[
        str | None, Parameter(help="Seeds to test on, such as [160,161]; by default the last 20 %.")
    ] = None,
) -> None:
    """Draw where the vehicles of a collection stand: in all scenes, those to train on, those to test on."""
    from warpav.runs.config import read_seeds
    from warpav.view.scene_figures.occupancy import collection_heat_maps

    chosen = {
        name: None if seeds is None else read_seeds(seeds, place=f"command line (--{name})")
        for name, seeds in (("train", train), ("test", test))
    }
    _say(f"wrote {collection_heat_maps(scenes, out, **chosen)}")


@config_app.command(name="show")
def config_show(config: Config = DEFAULT_CONFIG, /, *overrides: Overrides) -> None:
    """Print a configuration with all its defaults."""
    from warpav.runs.config import dump_config

    _say(dump_config(_load(config, overrides)).rstrip())


@config_app.command(name="check")
def config_check(config: Config = DEFAULT_CONFIG, /, *overrides: Overrides) -> None:
    """Check a configuration, and name everything that is wrong with it."""
    _load(config, overrides)
    _say("the configuration is valid")


@config_app.command(name="schema")
def config_schema() -> None:
    """Print the JSON Schema with which editors complete and check configurations."""
    import json

    from warpav.runs.config import Config

    _say(json.dumps(Config.model_json_schema(), indent=1))


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
    _say(f"wrote {target}")


@config_app.command(name="diff")
def config_diff(one: Config, other: Config, /) -> None:
    """List the options in which two configurations differ."""
    from warpav.runs.config import load_config, option_values

    left, right = (option_values(load_config(name)) for name in (one, other))
    for name, value in left.items():
        if value != right[name]:
            _say(f"{name}: {value} -> {right[name]}")


@rig_app.command(name="presets")
def rig_presets() -> None:
    """List the rigs that ship with warpav, with their sources."""
    from warpav.rig.presets import preset_about, preset_names, preset_rig

    for name in preset_names():
        about = preset_about(name)
        _say(f"{name}: {len(preset_rig(name).cameras)} cameras. {about.title}")
        _say(f"  source: {about.source}")
        _say(f"  licence: {about.licence}")
    _say("highest: the thesis's baseline, cameras around the highest point of your vehicle's roof, as the run says")


@rig_app.command(name="import")
def rig_import(
    file: Annotated[Path, Parameter(help="File or folder of another tool.")],
    /,
    *,
    format_name: FileFormat,
    out: Annotated[Path | None, Parameter(help="Rig YAML to write; by default it is printed.")] = None,
    origin_m: FileOrigin = None,
    origin_rpy_deg: FileTurn = (0.0, 0.0, 0.0),
    width_px: Annotated[int | None, Parameter(help="Image width, where the file has none.")] = None,
    height_px: Annotated[int | None, Parameter(help="Image height, where the file has none.")] = None,
    fov_deg: Annotated[float | None, Parameter(help="Horizontal field of view, where the file has no lens.")] = None,
    intrinsics: Annotated[Path | None, Parameter(help="camera_info YAML, or a folder of such, for the lenses.")] = None,
    part: Annotated[str | None, Parameter(help="Which rig: scene of nuScenes, vehicle of the ros-bridge.")] = None,
    accept_mirrored: Annotated[
        bool, Parameter(help="Take cameras called left that lie or look right, and the other way.", negative="")
    ] = False,
    overwrite: Annotated[bool, Parameter(help="Replace the file that is there.", negative="")] = False,
) -> None:
    """Make a rig YAML of another tool's file, and say in which frame it was read."""
    from warpav.rig.formats.convert import ImportOptions, check_target, import_rig
    from warpav.rig.rig import rig_text, write_rig

    if out is not None:
        check_target(out, overwrite=overwrite)
    options = ImportOptions(
        origin_m, origin_rpy_deg, width_px, height_px, fov_deg, intrinsics, part, accept_mirrored=accept_mirrored
    )
    rig, notes = import_rig(file, format_name, options)
    for note in notes:
        (_complain if out is None else _say)(note)  # what is printed is the rig, and nothing else
    if out is None:
        _say(rig_text(rig).rstrip())
    else:
        write_rig(rig, out)
        _say(f"wrote {out}")


@rig_app.command(name="export")
def rig_export(
    rig: RigSource,
    /,
    *,
    format_name: FileFormat,
    out: Annotated[Path, Parameter(help="File or folder to write.")],
    origin_m: FileOrigin = None,
    origin_rpy_deg: FileTurn = (0.0, 0.0, 0.0),
    approximate: Annotated[
        bool, Parameter(help="Leave out what the format cannot hold, and say what.", negative="")
    ] = False,
    overwrite: Annotated[bool, Parameter(help="Replace files that are there.", negative="")] = False,
) -> None:
    """Write a rig for another tool."""
    from warpav.rig.formats.convert import export_rig
    from warpav.runs.rig_source import rig_to_export

    files, notes = export_rig(
        rig_to_export(rig),
        format_name,
        out,
        origin_m=origin_m,
        origin_rpy_deg=origin_rpy_deg,
        approximate=approximate,
        overwrite=overwrite,
    )
    for line in (*notes, *(f"wrote {file}" for file in files)):
        _say(line)


@rig_app.command(name="check")
def rig_check(
    rig: RigSource,
    /,
    *,
    accept_mirrored: Annotated[
        bool, Parameter(help="Take cameras called left that lie or look right, and the other way.", negative="")
    ] = False,
) -> int:
    """List the cameras of a rig, what is wrong or odd about them, and the formats that hold them all."""
    from warpav.rig.check import description, mirrored_cameras, oddities
    from warpav.rig.formats.convert import formats_for
    from warpav.runs.rig_source import is_run_folder, rig_to_export

    found = rig_to_export(rig)
    for camera in found.cameras:
        _say(description(camera))
    for text in oddities(found):
        _say(f"odd: {text}")
    fit, unfit = formats_for(found)
    _say(f"can be exported as {', '.join(fit)}")
    for name, reason in unfit.items():
        _say(f"not as {name}: {reason}")
    mirrored = [] if accept_mirrored else list(mirrored_cameras(found.cameras))
    if is_run_folder(rig):  # the optimiser knows no names
        for text in mirrored:
            _say(f"odd: {text}; the run moved it there, so it needs another name")
        return 0
    for text in mirrored:
        _complain(f"{rig}: {text}; was it made of a left-handed file? --accept-mirrored takes it as it is")
    return 2 if mirrored else 0


@vehicle_app.command(name="check")
def vehicle_check(
    file: Annotated[Path, Parameter(help="Mesh of the vehicle: GLB, glTF, OBJ, PLY or STL.")],
    /,
    *overrides: Overrides,
    up: Annotated[
        FileAxis | None,
        Parameter(help="The file's axis that points up; by default glTF's y, else z.", allow_leading_hyphen=True),
    ] = None,
    forward: Annotated[
        FileAxis | None,
        Parameter(help="The file's axis that points to the front; by default x.", allow_leading_hyphen=True),
    ] = None,
    scale: Annotated[float | None, Parameter(help="Metres for each unit of the file, 0.01 for centimetres.")] = None,
    rear_axle: Annotated[
        float | None, Parameter(help="Metres from the vehicle's rear end to its rear axle; by default its wheels tell.")
    ] = None,
    out: Annotated[Path | None, Parameter(help="GLB to write it to, mended, for scenes.ego.")] = None,
    picture: Annotated[Path | None, Parameter(help="PNG to draw it into, with the places for cameras.")] = None,
    config: Config = DEFAULT_CONFIG,
) -> int:
    """Tell whether a vehicle can carry the cameras: units, axes, ground, origin, faces, places for cameras.

    Status 0: scenes.ego takes it as it is, or what --out wrote; 2: something has to be mended, and how.
    """
    from warpav.runs.config import placed_config
    from warpav.runs.vehicle_check import check_vehicle

    with placed_config(config, overrides) as settings:
        report = check_vehicle(
            file, settings, up=up, forward=forward, scale=scale, rear_axle_m=rear_axle, out=out, picture=picture
        )
    for line in report.lines:
        _say(line)
    for problem in report.problems:
        _complain(problem)
    return 2 if report.problems else 0


@detector_app.command(name="check")
def detector_check(
    file: Annotated[str, Parameter(help="ONNX file, or builtin.")],
    /,
    *overrides: Overrides,
    image: Annotated[Path | None, Parameter(help="Picture to find road users in.")] = None,
    out: Annotated[Path | None, Parameter(help="PNG to draw them into; by default <picture>_boxes.png.")] = None,
    config: Config = DEFAULT_CONFIG,
) -> None:
    """Tell how warpav reads a detector's file, which labels count, where it runs and how fast, and try it."""
    from warpav.runs.config import placed_config
    from warpav.runs.detector_check import check_detector

    with placed_config(config, overrides) as settings:
        for line in check_detector(file, settings, image_file=image, out=out):
            _say(line)


@detector_app.command(name="fit")
def detector_fit(
    config: Config = DEFAULT_CONFIG,
    /,
    *overrides: Overrides,
    scenes: Annotated[str | None, Parameter(help="Seeds of scenes to fit, such as 500000..500049.")] = None,
    held_out: Annotated[str | None, Parameter(help="Seeds of other scenes, to judge the fit by.")] = None,
    out: Annotated[Path | None, Parameter(help="Folder; by default beside the model, else the user's cache.")] = None,
    again: Annotated[bool, Parameter(help="Fit even if there is a stored fit.", negative="")] = False,
) -> None:
    """Fit how probably the detector finds an object, from what a view shows of it; a stored fit is used again."""
    from warpav.runs.config import placed_config, read_seeds
    from warpav.runs.detector_fit import fit_detector
    from warpav.runs.progress import RunDisplay

    if "=" in config:
        config, overrides = DEFAULT_CONFIG, (config, *overrides)
    chosen = [
        None if seeds is None else read_seeds(seeds, place=f"command line (--{name})")
        for name, seeds in (("scenes", scenes), ("held-out", held_out))
    ]
    words = ["warpav", "detector", "fit", config, *overrides]
    words += [word for pair in (("--scenes", scenes), ("--held-out", held_out)) if pair[1] for word in pair if word]
    with placed_config(config, overrides) as settings, RunDisplay() as display:
        file = fit_detector(
            settings,
            words=words,
            fit_seeds=chosen[0],
            held_out_seeds=chosen[1],
            out=out,
            again=again,
            progress=display,
        )
    _say(f"p(detected): {file}")


@detector_app.command(name="evaluate")
def detector_evaluate(
    *overrides: Overrides,
    out: Annotated[Path, Parameter(help="Folder for evaluation.json and evaluation.md.")],
    pictures: Annotated[Path | None, Parameter(help="Folder of the pictures; by default OUT/pictures.")] = None,
    processes: Annotated[int, Parameter(help="Processes that render the pictures.")] = 2,
    images: Annotated[int | None, Parameter(help="Only so many images of every size.")] = None,
    config: Config = DEFAULT_CONFIG,
) -> None:
    """Measure how well the detector finds road users in held-out town scenes, direct and reconstructed."""
    from warpav.runs.config import placed_config
    from warpav.runs.detector_training import measure_detector

    with placed_config(config, overrides) as settings:
        measure_detector(settings, out, pictures=pictures, processes=processes, image_count=images, say=_say)


@detector_app.command(name="train")
def detector_train(
    *,
    out: Annotated[Path, Parameter(help="Folder for checkpoint.pt and detector.onnx.")],
    pictures: Annotated[Path | None, Parameter(help="Folder of the pictures; by default OUT/pictures.")] = None,
    device: Annotated[str, Parameter(help="cpu or cuda:0.")] = "cpu",
    processes: Annotated[int, Parameter(help="Processes that render the pictures.")] = 2,
    steps: Annotated[int, Parameter(help="Length of the training.")] = 11_000,
    batch_size: Annotated[int, Parameter(help="Images of 256 px a step.")] = 192,
    seed: Annotated[int, Parameter(help="Of the weights and of the batches.")] = 0,
    stop_after_minutes: Annotated[float, Parameter(help="Stop earlier; the same command goes on.")] = float("inf"),
) -> None:
    """Train the shipped detector on pictures of town scenes; an interrupted training goes on where it stopped."""
    from warpav.runs.detector_training import train_detector

    train_detector(
        out,
        pictures=pictures,
        device=device,
        processes=processes,
        steps=steps,
        batch_size=batch_size,
        seed=seed,
        stop_after_minutes=stop_after_minutes,
        say=_say,
    )


def _executor_overrides(name: str | None, workers: int | None, address: str | None) -> list[str]:
    flags = {"name": name, "workers": workers, "address": address}
    return [f"executor.{flag}={value}" for flag, value in flags.items() if value is not None]


def _seeds(seeds: str | None, count: int | None) -> tuple[int, ...]:
    from warpav.runs.config import read_seeds

    if (seeds is None) == (count is None):
        raise InputError("command line: expected either --seeds or --count, got both or none; write --seeds 0..9")
    if count is not None and count < 1:
        raise InputError(f"command line (--count): expected at least 1, got {count}")
    return tuple(range(count)) if count is not None else read_seeds(str(seeds), place="command line (--seeds)")


def _load(config: str, overrides: Sequence[str]):  # noqa: ANN202 (importing the type would cost start-up time)
    from warpav.runs.config import load_config

    if "=" in config:
        config, overrides = DEFAULT_CONFIG, (config, *overrides)
    return load_config(config, overrides)


def _text_of(error: InputError | CycloptsError) -> str:
    """What is wrong with the user's input, in the words of the command line: arguments of functions are flags here."""
    if isinstance(error, CycloptsError):
        return _usage_text(error)
    if not isinstance(error, ArgumentError):
        return str(error)
    text = re.sub(r"`(\w+)`", lambda found: _flag(found[1]), error.text)
    if "." in error.option:  # an option of the configuration
        return f"{error.option}: {text}"
    flag = _flag(error.option)
    return f"command line ({flag}): {text}" if error.place is None else f"{error.place}: {flag}: {text}"


def _flag(argument: str) -> str:
    return f"--{argument.replace('_', '-')}"


def _usage_text(error: CycloptsError) -> str:
    """What is wrong with the words of the command, in one line."""
    text = " ".join(str(error).split())
    text = text if text.endswith("...") else text.removesuffix(".")
    hint = "options of a run are key=value, such as rig.cameras=6; " if text.startswith("Unknown option") else ""
    return f"command line: {text}; {hint}see {' '.join(('warpav', *(error.command_chain or ()), '--help'))}"


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")


def _complain(text: str) -> None:
    for line in text.splitlines():
        sys.stderr.write(f"{line}\n")


if __name__ == "__main__":
    sys.exit(main())
