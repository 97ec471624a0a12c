"""Commands about traffic scenes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from warpav.cli._arguments import (
    DEFAULT_CONFIG,
    Config,
    Executor,
    Overrides,
    SceneSource,
    Workers,
    complain,
    say,
    seeds_of,
)
from warpav.core.errors import InputError

if TYPE_CHECKING:
    from warpav.core.executor import Executor as TaskExecutor

SceneLevel = Annotated[
    Literal["easy", "urban", "dense", "motorway"],  # LEVELS, whose import would cost start-up time
    Parameter(help="Of the embedded town, for seeds: easy, urban, dense or motorway."),
]

_TrafficVehicles = Annotated[
    list[str] | None,
    Parameter(
        help="Vehicles of other makers in the places of some: shipped, a mesh file, or a folder of these; may be given "
        "several times.",
        negative=(),
    ),
]
_VehiclesShare = Annotated[
    float | None, Parameter(help="With --vehicles: of the vehicles in whose places one could stand; by default 0.5.")
]


def _tasks(name: Literal["serial", "process"], workers: int | None) -> TaskExecutor:
    from warpav.core.executor import Executor as TaskExecutor

    return TaskExecutor(name, workers)


scenes_app = App(name="scenes", help="Make and show traffic scenes.")
dev_scenes_app = App(name="scenes", help="Figures of the thesis.")


@scenes_app.command(name="make")
def _scenes_make(
    *,
    out: Annotated[Path, Parameter(help="Folder for the files, scene_SEED.glb.")],
    seeds: Annotated[str | None, Parameter(help="Range such as 1000..1009 or list such as [1,2,3].")] = None,
    count: Annotated[int | None, Parameter(help="Instead of --seeds: this many, from seed 0.")] = None,
    level: SceneLevel = "easy",
    vehicles: _TrafficVehicles = None,
    vehicles_share: _VehiclesShare = None,
    executor: Executor = "serial",
    workers: Workers = None,
) -> int:
    """Build embedded street scenes and write each as a GLB file; what is there already stays."""
    from warpav.runs import build_scenes, chosen_fleet

    fleet = chosen_fleet(vehicles, vehicles_share)
    return build_scenes(seeds_of(seeds, count), out, level=level, fleet=fleet, executor=_tasks(executor, workers))


@scenes_app.command(name="traffic")
def _scenes_traffic(
    *recordings: Annotated[
        Path,
        Parameter(
            help="Recorded traffic: JSON, CommonRoad, Argoverse 2, nuScenes, Waymo as JSON, SUMO, INTERACTION, inD and "
            "its kin, or folders of these; by default the crossing that ships with warpav."
        ),
    ],
    out: Annotated[Path, Parameter(help="Folder for the files, scene_SEED.glb.")],
    seeds: Annotated[str | None, Parameter(help="Range such as 1000..1009 or list such as [1,2,3].")] = None,
    count: Annotated[int | None, Parameter(help="Instead of --seeds: this many, from seed 0.")] = None,
    vehicles: _TrafficVehicles = None,
    vehicles_share: _VehiclesShare = None,
    executor: Executor = "serial",
    workers: Workers = None,
) -> int:
    """Build scenes of recorded traffic and write each as a GLB file; what is there already stays."""
    from warpav.runs import build_traffic_scenes, chosen_fleet

    fleet = chosen_fleet(vehicles, vehicles_share)
    return build_traffic_scenes(
        recordings, seeds_of(seeds, count), out, fleet=fleet, executor=_tasks(executor, workers)
    )


@scenes_app.command(name="capture")
def _scenes_capture(
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
    from warpav.runs import record_scenes
    from warpav.runs.config import placed_config

    with placed_config(config, overrides) as settings:
        return record_scenes(
            settings,
            seeds_of(seeds, count),
            out,
            server=(host, port) if simulator == "carla" else None,
            executor=_tasks(executor, workers),
        )


@scenes_app.command(name="reconstruct")
def _scenes_reconstruct(
    captures: Annotated[Path, Parameter(help="Capture, or folder of captures.")],
    /,
    *overrides: Overrides,
    out: Annotated[Path, Parameter(help="Folder for the files, scene_SEED.glb.")],
    executor: Executor = "serial",
    workers: Workers = None,
    config: Config = DEFAULT_CONFIG,
) -> int:
    """Make scenes of captures: point clouds, triangle meshes, colours."""
    from warpav.runs import reconstruct_scenes
    from warpav.runs.config import placed_config

    with placed_config(config, overrides) as settings:
        return reconstruct_scenes(settings, captures, out, executor=_tasks(executor, workers))


@scenes_app.command(name="check")
def _scenes_check(captures: Annotated[Path, Parameter(help="Capture, or folder of captures.")], /) -> int:
    """Check captures, also those of other simulators and cameras, and name everything that is wrong with them."""
    from warpav.runs import check_captures_of

    count, bad = check_captures_of(captures, complain)
    say(f"{count - bad} of {count} captures are valid")
    return 2 if bad else 0


@scenes_app.command(name="show")
def _scenes_show(
    scene: SceneSource,
    /,
    *,
    out: Annotated[Path | None, Parameter(help="PNG, HTML, GIF or MP4 to write; by default a window.")] = None,
    level: SceneLevel = "easy",
    vehicles: _TrafficVehicles = None,
    vehicles_share: _VehiclesShare = None,
) -> None:
    """Show a scene and list its vehicles."""
    from warpav.runs import chosen_fleet, show_scene

    for line in show_scene(scene, out, level, chosen_fleet(vehicles, vehicles_share)):
        say(line)


@scenes_app.command(name="statistics")
def _scenes_statistics(
    *overrides: Overrides,
    seeds: Annotated[
        str | None, Parameter(help="Range such as 0..39 or list such as [1,2,3]; by default scenes.train_seeds.")
    ] = None,
    config: Config = DEFAULT_CONFIG,
) -> None:
    """Count road users by kind, by distance and by how much of them can be seen, in scenes of any source.

    Such as scenes.level=dense --seeds 0..39, or scenes.source=folder scenes.folder=FOLDER --seeds 0..9.
    """
    from warpav.experiments import scene_statistics
    from warpav.runs import RunDisplay, load_scenes
    from warpav.runs.config import placed_config, read_seeds

    with placed_config(config, overrides) as settings:
        chosen = settings.scenes.train_seeds if seeds is None else read_seeds(seeds, place="command line (--seeds)")
        with RunDisplay() as display:
            scenes = display.steps("scenes", load_scenes(settings, chosen), count=len(chosen))
            table = scene_statistics(scenes, device=settings.device).table()
    for line in table:
        say(line)


@dev_scenes_app.command(name="figure")
def _scenes_figure(
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
    9: mount surface. 10: trajectories of the cameras without constraints. 11: images before and after optimisation, and
    of test scenes. 12: highest rig. 14 to 16: all colour, depth and instance images.
    """
    from warpav.experiments import RIG_NUMBERS, draw_figure

    if number not in RIG_NUMBERS:
        if overrides or run or config:
            raise InputError(
                f"figure {number}: expected no --run, --config or key=value; they go with figures 10 to 12"
            )
        say(f"wrote {draw_figure(number, out, seed=seed, capture=capture, scenes=scenes)}")
        return
    if seed is not None or capture is not None or scenes is not None:
        raise InputError(f"figure {number}: expected --run, --config or key=value, got --seed, --capture or --scenes")
    from warpav.experiments import draw_method_figure
    from warpav.runs import RunDisplay, RunFolder, config_for

    folder = None if run is None else RunFolder.open(run)
    with config_for(run or "highest", config, overrides, default=DEFAULT_CONFIG) as settings, RunDisplay() as display:
        file = draw_method_figure(number, out, settings, run=folder, progress=display)
    say(f"wrote {file}")


@scenes_app.command(name="heatmap")
def _scenes_heatmap(
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
    """Draw where the vehicles of a folder of scenes stand: in all scenes, those to train on, those to test on."""
    from warpav.experiments import scene_store_heat_maps
    from warpav.runs.config import read_seeds

    chosen = {
        name: None if seeds is None else read_seeds(seeds, place=f"command line (--{name})")
        for name, seeds in (("train", train), ("test", test))
    }
    say(f"wrote {scene_store_heat_maps(scenes, out, **chosen)}")
