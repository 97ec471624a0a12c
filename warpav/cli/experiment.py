"""Commands about experiments."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from warpav.cli.arguments import (
    Overrides,
    TaskExecutor,
    executor_overrides,
    say,
)

experiment_app = App(name="experiment", help="Run experiments, rescore their rigs, write their results as a page.")


@experiment_app.default
def experiment(
    name: Annotated[
        Literal[
            "table1",
            "table2",
            "table3",
            "table4",
            "table5",
            "open",
            "rivals",
            "ablations",
            "correlation",
            "scene_count",
            "sweep",
        ],
        Parameter(
            help="A table of the thesis; open: all methods at equal budgets, judged by the detector; rivals: the same "
            "by their objective, in the setting of --setting; ablations: the descent with one thing changed at a time; "
            "correlation: whether the objective ranks rigs as the detector does; "
            "scene_count: the search by a pool on 50 to 1500 training scenes, judged on others; sweep: what a search "
            "gains over the highest point, by number of cameras, field of view, height and traffic."
        ),
    ],
    config: Annotated[
        str | None, Parameter(help="YAML file or shipped configuration; by default thesis for tables, else default.")
    ] = None,
    /,
    *overrides: Overrides,
    runs: Annotated[int | None, Parameter(help="Run seeds an arm, from run.seed; by default the experiment's.")] = None,
    arms: Annotated[str | None, Parameter(help="Only these, such as sgd_ifr,highest_ifr_doa,cma.")] = None,
    scenes: Annotated[
        str | None, Parameter(help="Of scene_count: numbers of training scenes; by default 50,150,500,1500.")
    ] = None,
    setting: Annotated[
        str | None,
        Parameter(
            help="Of rivals: 4x90, 2x60, 1x120, 6x60 (pitch and height free, all road users), 8x90, bus; or on other "
            "traffic dense, sind or ngsim, 2, 4 or 6 cameras, rack, roof or body, such as sind_4_body, with _bus and "
            "_all (road users) behind."
        ),
    ] = None,
    vary: Annotated[
        list[str] | None,
        Parameter(
            help="Of sweep: a factor out of cameras, fov, height, traffic, maybe with values as in cameras=2,4; may be "
            "given several times. By default all."
        ),
    ] = None,
    budget: Annotated[
        int | None,
        Parameter(help="Camera renders (one scene, one camera) for every search; by default the experiment's."),
    ] = None,
    detector: Annotated[
        bool, Parameter(help="Of rivals: run the detector on the unseen scenes as well.", negative="")
    ] = False,
    executor: TaskExecutor = None,
    workers: Annotated[int | None, Parameter(help="Runs at a time.")] = None,
    address: Annotated[str | None, Parameter(help="Of a Ray cluster.")] = None,
    out: Annotated[Path | None, Parameter(help="Folder; by default runs/NAME.")] = None,
    quick: Annotated[bool, Parameter(help="A small version, of minutes.", negative="")] = False,
    sealed: Annotated[
        str | None,
        Parameter(help="Full hash of the commit that froze the method: test on the scenes that it seals (protocol)."),
    ] = None,
) -> int:
    """Run an experiment and print its table; the same command again does what is missing."""
    from functools import partial

    from warpav.core.errors import ArgumentError
    from warpav.experiments import open_experiments, rival_settings, thesis_experiments
    from warpav.experiments.experiment import arms_of, overrides_of
    from warpav.experiments.protocol import sealed_override
    from warpav.experiments.traffic_protocol import check_sealing
    from warpav.experiments.traffic_settings import is_traffic_setting
    from warpav.runs.config import placed_config
    from warpav.runs.progress import RunDisplay

    if config is not None and "=" in config:
        config, overrides = None, (config, *overrides)
    given = executor_overrides(executor, workers, address)
    if name != "scene_count" and scenes is not None:
        raise ArgumentError("scenes", f"expected nothing, as it is an option of scene_count, got it with {name}")
    if name != "sweep" and vary is not None:
        raise ArgumentError("vary", f"expected nothing, as it is an option of sweep, got it with {name}")
    if name == "sweep":
        if setting is not None or detector or sealed is not None or arms is not None:
            raise ArgumentError("setting", "expected no setting, arms, detector or seal with sweep, got one")
        from warpav.experiments import sweep

        whole = [*sweep.OPTIONS, *(sweep.QUICK if quick else ()), *overrides, *given]
        with placed_config(config or "default", whole) as settings, RunDisplay() as display:
            swept = sweep.run_sweep(
                settings, vary=vary, runs=runs, camera_renders_max=budget, out=out, quick=quick, progress=display
            )
        return 1 if swept.failed else 0
    if name == "scene_count":
        if setting is not None or detector or sealed is not None:
            raise ArgumentError("setting", "expected no setting, detector or seal with scene_count, got one")
        from warpav.experiments import scene_count

        whole = [*scene_count.OPTIONS, *(scene_count.QUICK if quick else ()), *overrides, *given]
        with placed_config(config or "default", whole) as settings, RunDisplay() as display:
            failed = scene_count.run_scene_count(
                settings,
                arms=arms,
                scene_counts=scenes,
                runs=runs,
                render_budget=budget,
                out=out,
                quick=quick,
                progress=display,
            )
        return 1 if failed else 0
    if name == "rivals":
        setting, found = rival_settings.find_setting(setting)
        run = partial(rival_settings.run_rivals, setting, is_judged=detector)
    elif setting is not None or detector:
        option = "setting" if setting is not None else "detector"
        raise ArgumentError(
            option, f"expected nothing, as it is an option of the experiment rivals, got it with {name}"
        )
    else:
        is_thesis = name in thesis_experiments.EXPERIMENTS
        found = (thesis_experiments if is_thesis else open_experiments).EXPERIMENTS[name]
        run = partial(thesis_experiments.run_table if is_thesis else open_experiments.run_open, name)
    if sealed is not None:
        if is_traffic_setting(setting):
            check_sealing(sealed)
        overrides = (*overrides, sealed_override(sealed, overrides, quick=quick))
    chosen = arms_of(found, arms)
    whole = overrides_of(found, [*overrides, *given], arms=chosen, quick=quick)
    with placed_config(config or found.config, whole) as settings, RunDisplay() as display:
        done = run(
            settings,
            arms=chosen,
            runs=runs,
            camera_renders_max=budget,
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
    panel: Annotated[
        Path | None, Parameter(help="Folder of ONNX files: each judges the rigs, at its own image size.")
    ] = None,
    also: Annotated[
        list[Path] | None, Parameter(help="With --panel: folder of a further experiment; may be given several times.")
    ] = None,
    false_alarms: Annotated[
        float | None, Parameter(help="With --panel: false alarms per image at which recalls are compared; 0.5.")
    ] = None,
    name: Annotated[str | None, Parameter(help="Of the new results; by default made of the options.")] = None,
    executor: TaskExecutor = None,
    workers: Annotated[int | None, Parameter(help="Rigs at a time.")] = None,
    address: Annotated[str | None, Parameter(help="Of a Ray cluster.")] = None,
) -> int:
    """Evaluate the rigs of an experiment with another detector, image size or source of scenes.

    Such as detector.model=FILE.onnx camera.width_px=640 camera.height_px=640, or scenes.source=captured. Prints the
    same table, and whether the arms rank in the same order; writes to FOLDER/rescored_NAME. With --panel the networks
    of a folder judge, and are compared: FOLDER/panel_NAME.
    """
    from warpav.core.errors import ArgumentError
    from warpav.evaluation.metrics import EQUAL_FALSE_ALARMS_PER_FRAME
    from warpav.experiments.panel import run_panel
    from warpav.experiments.rescore import (
        check_rescored_options,
        config_file,
        folder_name,
        planned_rescore,
        run_rescores,
    )
    from warpav.runs.config import placed_config
    from warpav.runs.networks import check_panel_options
    from warpav.runs.progress import RunDisplay

    given = executor_overrides(executor, workers, address)
    if panel is not None:
        check_rescored_options(overrides, needs_some=False)
        check_panel_options(overrides)
        name = folder_name(name, [f"panel={panel.resolve().name}", *overrides])
        many = EQUAL_FALSE_ALARMS_PER_FRAME if false_alarms is None else false_alarms
        folders = [folder, *(also or [])]
        with placed_config(config_file(folder), [*overrides, *given]) as settings, RunDisplay() as display:
            table = run_panel(folders, settings, panel, name=name, false_alarms_per_image=many, progress=display)
        return 1 if table.failed else 0
    for option, value in (("also", also), ("false_alarms", false_alarms)):
        if value is not None:
            raise ArgumentError(option, "expected nothing, as it is an option of --panel, got it without one")
    check_rescored_options(overrides)
    name = folder_name(name, overrides)
    with placed_config(config_file(folder), [*overrides, *given]) as settings, RunDisplay() as display:
        (done,) = run_rescores([planned_rescore(folder, settings, name=name)], progress=display)
    return 1 if done.failed else 0


@experiment_app.command(name="judge")
def experiment_judge(
    *folders: Annotated[Path, Parameter(help="Folders of the experiments of the protocol's settings.")],
    out: Annotated[Path | None, Parameter(help="Markdown file; by default the console alone.")] = None,
) -> None:
    """Decide the hypotheses of the protocol; failed ones are shown like all others."""
    from warpav.core.files import write_text
    from warpav.experiments.judgement import judged_text

    text = judged_text(folders)
    say(*text.splitlines())
    if out is not None:
        write_text(out, text)
        say(f"wrote {out}")


@experiment_app.command(name="results")
def experiment_results(
    *folders: Annotated[Path, Parameter(help="Folders of experiments, or of rescored ones.")],
    out: Annotated[Path, Parameter(help="Markdown file; the numbers of every run go into a folder beside it.")],
) -> None:
    """Write the results of experiments as a page: tables, goals, seeds, commands, versions, every run."""
    from warpav.experiments.protocol import unknown_code
    from warpav.experiments.summary import read_summary, with_history, write_results_page

    say(f"wrote {write_results_page(folders, out)}")
    for folder in folders:
        for doubt in unknown_code(with_history(read_summary(folder)).get("commits", [])):
            say(f"{folder}: {doubt}; not to be published as results of the protocol")
