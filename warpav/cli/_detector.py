"""Commands about object detectors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from warpav.cli._arguments import DEFAULT_CONFIG, Config, Overrides, configured, say

detector_app = App(
    name="detector", help="Object detectors: check one, and fit the probability that it finds an object."
)
dev_detector_app = App(name="detector", help="Measure and train object detectors.")


@detector_app.command(name="check")
def detector_check(
    file: Annotated[str, Parameter(help="ONNX file, or builtin.")],
    /,
    *overrides: Overrides,
    image: Annotated[Path | None, Parameter(help="Image to find road users in.")] = None,
    out: Annotated[Path | None, Parameter(help="PNG to draw them into; by default <image>_boxes.png.")] = None,
    config: Config = DEFAULT_CONFIG,
) -> None:
    """Report how warpav reads a detector's file, which labels count, where it runs and how fast, and try it."""
    from warpav.runs import check_detector

    with configured(config, overrides) as settings:
        for line in check_detector(file, settings, image_file=image, out=out):
            say(line)


@detector_app.command(name="fit")
def detector_fit(
    config: Config = DEFAULT_CONFIG,
    /,
    *overrides: Overrides,
    scenes: Annotated[str | None, Parameter(help="Seeds of scenes to fit, such as 500000..500049.")] = None,
    held_out: Annotated[str | None, Parameter(help="Seeds of other scenes, to evaluate the fit on.")] = None,
    out: Annotated[Path | None, Parameter(help="Folder; by default beside the model, else the user's cache.")] = None,
    again: Annotated[bool, Parameter(help="Fit even if there is a stored fit.", negative="")] = False,
    any_camera: Annotated[
        bool, Parameter(help="Fit for any camera, as a run does that finds no fit for its own.", negative="")
    ] = False,
) -> None:
    """Fit the probability that the detector finds an object to what a view shows of it; a stored fit is used again."""
    from warpav.runs import RunDisplay, fit_detector
    from warpav.runs.config import read_seeds

    chosen = [
        None if seeds is None else read_seeds(seeds, place=f"command line (--{name})")
        for name, seeds in (("scenes", scenes), ("held-out", held_out))
    ]
    words = ["warpav", "detector", "fit", config, *overrides]
    words += ["--any-camera"] if any_camera else []
    words += [word for pair in (("--scenes", scenes), ("--held-out", held_out)) if pair[1] for word in pair if word]
    with configured(config, overrides) as settings, RunDisplay() as display:
        file = fit_detector(
            settings,
            words=words,
            fit_seeds=chosen[0],
            held_out_seeds=chosen[1],
            out=out,
            again=again,
            any_camera=any_camera,
            progress=display,
        )
    say(f"detection probability model: {file}")


@detector_app.command(name="lidar")
def detector_lidar(
    table: Annotated[Path, Parameter(help="CSV file with the columns points, class and found (0 or 1).")], /
) -> None:
    """Fit how many points of a LiDAR it takes to find a road user, and print the options that say so."""
    from warpav.runs import lidar_options

    say(lidar_options(table))


@dev_detector_app.command(name="score")
def _detector_score(
    config: Config = DEFAULT_CONFIG,
    /,
    *overrides: Overrides,
    panel: Annotated[
        Path | None, Parameter(help="Folder of ONNX files, each at its own image size; by default detector.model.")
    ] = None,
    fitted_on: Annotated[
        Literal["town", "own"], Parameter(help="Which fit: that of the embedded scenes, or of the configuration's own.")
    ] = "town",
    scenes: Annotated[str | None, Parameter(help="Seeds of the scenes; by default scenes.test_seeds.")] = None,
    out: Annotated[Path | None, Parameter(help="Folder for scores.json, scores.md and reliability diagrams.")] = None,
) -> None:
    """Measure how well the fitted detection probability holds on other scenes, of any level or source."""
    from warpav.runs import RunDisplay, check_panel_options, score_detectors
    from warpav.runs.config import read_seeds

    if panel is not None:
        check_panel_options(overrides)
    seeds = None if scenes is None else read_seeds(scenes, place="command line (--scenes)")
    with configured(config, overrides) as settings, RunDisplay() as display:
        score_detectors(settings, panel=panel, fitted_on=fitted_on, seeds=seeds, out=out, progress=display)


@dev_detector_app.command(name="evaluate")
def _detector_evaluate(
    *overrides: Overrides,
    out: Annotated[Path, Parameter(help="Folder for evaluation.json and evaluation.md.")],
    image_folder: Annotated[Path | None, Parameter(help="Folder of the images; by default OUT/images.")] = None,
    processes: Annotated[int, Parameter(help="Processes that render the images.")] = 2,
    images: Annotated[int | None, Parameter(help="Only so many images of every size.")] = None,
    config: Config = DEFAULT_CONFIG,
) -> None:
    """Measure how well the detector finds road users in held-out town scenes, direct and reconstructed."""
    from warpav.runs import measure_detector

    with configured(config, overrides) as settings:
        measure_detector(settings, out, image_folder=image_folder, processes=processes, image_count=images, say=say)


@dev_detector_app.command(name="train")
def _detector_train(
    *,
    out: Annotated[Path, Parameter(help="Folder for checkpoint.pt and detector.onnx.")],
    image_folder: Annotated[Path | None, Parameter(help="Folder of the images; by default OUT/images.")] = None,
    device: Annotated[str, Parameter(help="cpu or cuda:0.")] = "cpu",
    processes: Annotated[int, Parameter(help="Processes that render the images.")] = 2,
    steps: Annotated[int, Parameter(help="Length of the training.")] = 13_632,
    batch_size: Annotated[int, Parameter(help="Images of 256 px a step.")] = 192,
    seed: Annotated[int, Parameter(help="Of the weights and of the batches.")] = 0,
    recordings: Annotated[
        tuple[Path, ...], Parameter(help="Recorded traffic of your own, besides what ships.", negative=())
    ] = (),
) -> None:
    """Train the shipped detector on images of town scenes; the same command resumes an interrupted training."""
    from warpav.runs import train_detector

    options = {"device": device, "processes": processes, "steps": steps, "batch_size": batch_size, "seed": seed}
    train_detector(out, image_folder=image_folder, say=say, recordings=recordings, **options)
