"""Commands about studies."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from warpav.cli._arguments import Overrides, TaskExecutor, executor_overrides, say

_Study = Literal[
    "table1",
    "table2",
    "table3",
    "table4",
    "table5",
    "open",
    "rivals",
    "at_cost",
    "ablations",
    "correlation",
    "scene_count",
    "places",
    "sweep",
]
experiment_app = App(name="experiment", help="Run studies, rescore their rigs, join their results.")


@experiment_app.default
def experiment(
    name: Annotated[
        _Study,
        Parameter(
            help="A table of the thesis; open: all methods at equal budgets, judged by the detector; rivals: the "
            "search beside rigs by hand and other searches, in the setting of --setting; at_cost: the search beside "
            "known layouts of cameras and LiDARs at their cost, in such a setting; ablations: the descent with "
            "one thing changed at a time; correlation: whether the objective ranks rigs as the detector does; "
            "scene_count: the search on ever more training scenes, judged on others; places: the same on scenes of 1 "
            "to 48 streets; sweep: what a search gains over the highest point, by number of cameras, field of view, "
            "height and traffic."
        ),
    ],
    config: Annotated[
        str | None, Parameter(help="YAML file or shipped configuration; by default thesis for tables, else default.")
    ] = None,
    /,
    *overrides: Overrides,
    runs: Annotated[int | None, Parameter(help="Run seeds an arm, from run.seed; by default the study's.")] = None,
    arms: Annotated[str | None, Parameter(help="Only these, such as sgd_ifr,highest_ifr_doa,cma.")] = None,
    setting: Annotated[
        str | None,
        Parameter(
            help="Of rivals: traffic dense, sind or ngsim, 2, 4 or 6 cameras, rack, roof or body, such as sind_4_body; "
            "with _bus and _all (road users) behind. Of at_cost: nuscenes, argoverse2, edgar, robotaxi or series, "
            "_lidar or nothing, traffic dense, sind or motorway, such as nuscenes_lidar_sind."
        ),
    ] = None,
    vary: Annotated[
        list[str] | None,
        Parameter(
            help="Of sweep: a factor out of cameras, fov, height, traffic, maybe with values as in cameras=2,4; may be "
            "given several times. Of scene_count: scenes=50,150. By default all."
        ),
    ] = None,
    budget: Annotated[
        int | None, Parameter(help="Camera renders (one scene, one camera) for every search; by default the study's.")
    ] = None,
    executor: TaskExecutor = None,
    workers: Annotated[int | None, Parameter(help="Runs at a time.")] = None,
    address: Annotated[str | None, Parameter(help="Of a Ray cluster.")] = None,
    out: Annotated[Path | None, Parameter(help="Folder; by default runs/NAME.")] = None,
    quick: Annotated[bool, Parameter(help="A small version, of minutes.", negative="")] = False,
) -> int:
    """Run a study and print its table; the same command again does what is missing."""
    from warpav.experiments import find_study, run_study
    from warpav.runs import RunDisplay
    from warpav.runs.config import placed_config

    if config is not None and "=" in config:
        config, overrides = None, (config, *overrides)
    study = find_study(name, setting=setting, vary=vary, quick=quick)
    chosen = study.arms_of(arms)
    given = [*overrides, *executor_overrides(executor, workers, address)]
    with placed_config(config or study.config, study.overrides(given, chosen)) as settings, RunDisplay() as display:
        done = run_study(study, settings, arms=chosen, runs=runs, camera_renders_max=budget, out=out, progress=display)
    return 1 if done.failed else 0


@experiment_app.command(name="rescore")
def _experiment_rescore(
    folder: Annotated[Path, Parameter(help="Folder of a study.")],
    /,
    *overrides: Overrides,
    panel: Annotated[
        Path | None, Parameter(help="Folder of ONNX files: each judges the rigs, at its own image size.")
    ] = None,
    name: Annotated[str | None, Parameter(help="Of the new results; by default made of the options.")] = None,
    executor: TaskExecutor = None,
    workers: Annotated[int | None, Parameter(help="Rigs at a time.")] = None,
    address: Annotated[str | None, Parameter(help="Of a Ray cluster.")] = None,
) -> int:
    """Evaluate the rigs of a study with another detector, image size or source of scenes.

    Such as detector.model=FILE.onnx camera.width_px=640 camera.height_px=640, or scenes.source=captured. Prints the
    same table; writes to FOLDER/rescored_NAME. With --panel every network of a folder judges.
    """
    from warpav.experiments import (
        check_rescored_options,
        config_file,
        folder_name,
        plan_panel,
        plan_rescore,
        run_rescores,
    )
    from warpav.runs import RunDisplay, check_panel_options
    from warpav.runs.config import placed_config

    given = executor_overrides(executor, workers, address)
    check_rescored_options(overrides, needs_some=panel is None)
    if panel is not None:
        check_panel_options(overrides)
    name = folder_name(name, [*([f"panel={panel.resolve().name}"] if panel else []), *overrides])
    with placed_config(config_file(folder), [*overrides, *given]) as settings, RunDisplay() as display:
        if panel is None:
            planned = [plan_rescore(folder, settings, name=name)]
        else:
            planned = plan_panel(folder, settings, panel, name=name, progress=display)
        all_done = run_rescores(planned, progress=display)
    return 1 if any(done.failed for done in all_done) else 0


@experiment_app.command(name="results")
def _experiment_results(
    *folders: Annotated[Path, Parameter(help="Folders of studies, or of rescored ones.")],
    out: Annotated[
        Path, Parameter(help="CSV file for all their rows, or a Markdown page whose marked tables are filled by them.")
    ],
) -> None:
    """Join the rows of studies in one file, or fill the tables of a page: <!-- rows: arms open --> <!-- end -->."""
    from warpav.core.errors import InputError
    from warpav.core.files import write_text
    from warpav.experiments import ROWS, filled_page, read_rows, write_rows

    if not folders:
        raise InputError("experiment results: expected folders of studies such as runs/open, got none")
    rows = [row for folder in folders for row in read_rows(folder if folder.suffix == ".csv" else folder / ROWS)]
    if out.suffix == ".md":
        if not out.is_file():
            raise InputError(f"{out}: expected a page with marked tables, got no such file")
        write_text(out, filled_page(out.read_text(encoding="utf-8"), rows))
    else:
        write_rows(rows, out)
    say(f"wrote {out}")
