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
        Literal["table1", "table2", "table3", "table4", "table5", "open", "ablations", "correlation", "scene_count"],
        Parameter(
            help="A table of the thesis; open: all methods at equal budgets; ablations: the default method "
            "with one thing changed at a time; correlation: whether its objective ranks rigs as the detector does; "
            "scene_count: the search by a pool on 50 to 1500 training scenes, judged on others."
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
        int | None,
        Parameter(
            help="Scene renders for every search, of scene_count camera renders; by default what the gradient method "
            "takes."
        ),
    ] = None,
    scenes: Annotated[
        str | None, Parameter(help="Of scene_count: numbers of training scenes; by default 50,150,500,1500.")
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
    given = executor_overrides(executor, workers, address)
    if name == "scene_count":
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
    is_thesis = name in thesis_experiments.EXPERIMENTS
    found = (thesis_experiments if is_thesis else open_experiments).EXPERIMENTS[name]
    run = thesis_experiments.run_table if is_thesis else open_experiments.run_open
    chosen = arms_of(found, arms)
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
    """Evaluate the rigs of an experiment with another detector, image size or source of scenes.

    Such as detector.model=FILE.onnx camera.width_px=640 camera.height_px=640, or scenes.source=captured. Prints the
    same table, and whether the arms rank in the same order; writes to FOLDER/rescored_NAME.
    """
    from warpav.experiments.rescore import check_rescored_options, config_file, folder_name, run_rescore
    from warpav.runs.config import placed_config
    from warpav.runs.progress import RunDisplay

    check_rescored_options(overrides)
    name = folder_name(name, overrides)
    given = executor_overrides(executor, workers, address)
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

    say(f"wrote {write_results_page(folders, out)}")
