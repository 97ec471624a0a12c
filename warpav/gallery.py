"""What a user looks at: rendered images on disk, pictures of scenes, rigs and runs."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from warpav.collection import (
    CaptureTask,
    SceneTask,
    capture_path,
    capture_scenes,
    captures_in,
    make_scenes,
    scene_path,
    split_seeds,
)
from warpav.config import Config
from warpav.console import RunDisplay
from warpav.errors import InputError
from warpav.executor import ExecutorName, Outcome
from warpav.results import RunFolder
from warpav.rig.lens import Lens
from warpav.rig.rig import Rig, RigCamera
from warpav.sources import (
    camera_mount,
    checked_device,
    constraints_of,
    find_rig,
    load_detector,
    load_scene,
    load_scenes,
    mount_surface,
    plan_settings,
    reconstruction_settings,
)

if TYPE_CHECKING:
    from warpav.detection.detector import Detector
    from warpav.evaluate import ObjectOutcome, RigObserver
    from warpav.figures import DetectionPanel
    from warpav.geometry.mount_surface import MountSurface
    from warpav.objective.objective import AssignedScene, RigObjective
    from warpav.render.images import CameraImage
    from warpav.scene.scene import Scene
    from warpav.view.inspector import Inspector

_SPLIT_FROM = 6  # scenes that make training, validation and test scenes, and a batch of the training scenes
OBJECT_BACKGROUND, OBJECT_EGO = 0, 65535
"""Values of object images; vehicles are their instance ids."""


def render_rig(source: str, rig_source: str, config: Config, out: Path, overrides: Sequence[str] = ()) -> Path:
    """Render a scene through every camera of a rig into files.

    Writes per camera ``<camera>_rgb.png``, ``<camera>_object.png`` (16 bit: 0 background and environment, 65535 ego,
    else the instance id) and ``<camera>_depth_m.npy`` (float32, inf where nothing; the distance for a fisheye or a
    panorama, else along the optical axis), and ``views.json``. The files appear once all images are rendered.

    Args:
        source: GLB file, or the seed of an embedded scene.
        rig_source: Rig YAML, preset, run folder, or ``highest``.
        config: Device, supersampling, near plane, and the cameras of ``highest``.
        out: Folder to write to; made when it does not exist.
        overrides: The overrides that the user gave; those of ``camera`` replace what the rig's file says.

    Raises:
        InputError: The scene, the rig, the device or the folder cannot be used.
    """
    from warpav.render.images import render_images

    _check_folder(out, "--out")
    scene = load_scene(source, config)
    device = checked_device(config.device)
    cameras = [_overridden(camera, config, overrides) for camera in find_rig(rig_source, config, scene.ego).cameras]
    images = render_images(scene, cameras, supersampling=config.camera.supersampling, device=device)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out, prefix=".draft-") as draft:
            for camera, image in zip(cameras, images, strict=True):
                _write_image(Path(draft), camera, image, scene)
            views = json.dumps([_view(camera) for camera in cameras], indent=2)
            (Path(draft) / "views.json").write_text(views + "\n", encoding="utf-8")
            for file in sorted(Path(draft).iterdir()):
                os.replace(file, out / file.name)
    except OSError as error:
        raise InputError(f"{out}: --out: expected a folder to write to, got: {error.strerror}") from None
    return out


def build_scenes(seeds: Sequence[int], out: Path, *, executor: ExecutorName, worker_count: int | None) -> int:
    """Build embedded scenes as GLB files that are not there yet; returns the exit status.

    Raises:
        InputError: The folder cannot be written to.
    """
    _check_folder(out, "--out")
    tasks = [SceneTask(seed, scene_path(out, seed)) for seed in seeds]
    status = _show_outcomes(
        "building scenes",
        (
            (str(outcome.task.file), outcome)
            for outcome in make_scenes(tasks, executor=executor, worker_count=worker_count)
        ),
        len(tasks),
    )
    _say_split(tasks, out)
    return status


def record_scenes(
    config: Config,
    seeds: Sequence[int],
    out: Path,
    *,
    server: tuple[str, int] | None,
    executor: ExecutorName,
    worker_count: int | None,
) -> int:
    """Record situations that are not recorded yet; returns the exit status.

    Args:
        config: What to record.
        seeds: Which situations.
        out: Folder for the captures.
        server: Host and port of CARLA; None: the embedded town.
        executor: How the embedded town's situations are spread; CARLA records one after the other.
        worker_count: Processes.

    Raises:
        InputError: The folder cannot be written to, or CARLA is not there.
    """
    _check_folder(out, "--out")
    tasks = [CaptureTask(seed, capture_path(out, seed), plan_settings(config)) for seed in seeds]
    if server is None:
        outcomes = capture_scenes(tasks, executor=executor, worker_count=worker_count)
    else:
        from warpav.collection import capture_carla_scenes

        outcomes = capture_carla_scenes(tasks, host=server[0], port=server[1])
    return _show_outcomes("recording", ((str(outcome.task.folder), outcome) for outcome in outcomes), len(tasks))


def reconstruct_scenes(
    config: Config, captures: Path, out: Path, *, executor: ExecutorName, worker_count: int | None
) -> int:
    """Make scenes of captures that are not there yet; one that cannot be used is refused, the others go on.

    Returns:
        The exit status: 2 if any was refused.

    Raises:
        InputError: There are no captures, or the folder cannot be written to.
    """
    _check_folder(out, "--out")
    settings = reconstruction_settings(config)
    tasks = [
        SceneTask(seed, scene_path(out, seed), capture, settings) for seed, capture in captures_in([captures]).items()
    ]
    outcomes = make_scenes(tasks, executor=executor, worker_count=worker_count)
    status = _show_outcomes("reconstructing", ((str(outcome.task.file), outcome) for outcome in outcomes), len(tasks))
    _say_split(tasks, out)
    return status


def _show_outcomes(title: str, outcomes: Iterable[tuple[str, Outcome[Any, bool]]], count: int) -> int:
    """Tell what became of every task, and what was refused once more at the end."""
    refused: list[str] = []
    with RunDisplay() as display:
        for name, outcome in display.steps(title, outcomes, count=count):
            if outcome.error is not None:
                refused.append(outcome.error)
            elif outcome.result:
                display.say(name)
            else:
                display.say(f"{name} is there already")
        if refused:
            display.say(f"{count - len(refused)} of {count} done; refused:")
            for error in refused:
                display.say(error)
    return 2 if refused else 0


def _say_split(tasks: Sequence[SceneTask], out: Path) -> None:
    """Tell how to train on some of the scenes that are there now and test on others, if they are enough for that."""
    seeds = [task.seed for task in tasks if task.file.is_file()]
    if len(seeds) < _SPLIT_FROM:
        return
    split = {name: _seed_text(part) for name, part in split_seeds(seeds).items()}
    with RunDisplay() as display:
        display.say(
            f"to train on 60 % and test on 20 % of them: warpav optimise scenes.source=folder scenes.folder={out} "
            f"scenes.train_seeds={split['train']} scenes.test_seeds={split['test']}"
        )


def _seed_text(seeds: Sequence[int]) -> str:
    is_range = list(seeds) == list(range(seeds[0], seeds[0] + len(seeds)))
    return f"{seeds[0]}..{seeds[-1]}" if is_range else f"[{','.join(map(str, seeds))}]"


Shown = Literal["rig", "coverage", "outcomes", "sight"]
"""What a picture of a rig shows besides: the ground by how many cameras see somebody there, traffic by what becomes of
it, or what every camera sees."""


def inspect_rig(source: str, config: Config, out: Path | None, *, shown: Shown = "rig") -> Path | None:
    """Show a rig on its vehicle in traffic: the interactive inspector when there is a display, else a file.

    Args:
        source: Run folder, rig YAML, preset, or ``highest``.
        config: Gives the scene: the first test scene; and the detector.
        out: PNG, HTML or GIF to write; None opens a window.
        shown: What is drawn besides the rig and the path of its cameras.

    Returns:
        The file that was written, if one was.

    Raises:
        InputError: The rig or the file cannot be used, or this machine cannot draw.
    """
    from warpav.view.opengl import has_display
    from warpav.view.picture import MOVIE_SUFFIXES
    from warpav.view.picture import inspect_rig as show

    if out is None and has_display():
        inspector(source, config).plotter.show()
        return None
    is_run = Path(source).is_dir()
    if is_run and shown == "rig" and out is not None and out.suffix.lower() in MOVIE_SUFFIXES:
        return ShownRun.of(RunFolder.open(source), config=config).save_film(out)
    if is_run and shown == "rig":
        run = ShownRun.of(RunFolder.open(source), config=config)
        return show(
            run.rig,
            ego=run.scene.ego,
            scene=run.scene,
            trajectory_m=trajectory(run.events),
            add=run.descent_at(None),
            out=out,
            out_without_display=run.folder.path / "inspect.png",
        )
    scene = next(load_scenes(config, config.scenes.test_seeds[:1]))
    rig = find_rig(source, config, scene.ego)
    return show(
        rig,
        ego=scene.ego,
        scene=scene,
        trajectory_m=trajectory(RunFolder.open(source).events()) if is_run else None,
        outcomes=_outcomes(rig, scene, config) if shown == "outcomes" else None,
        add=_addition(rig, scene, config, shown),
        is_wide=shown != "rig",
        out=out,
        out_without_display=Path(source) / "inspect.png" if is_run else Path("rig.png"),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class ShownRun:
    """A run as pictures need it.

    Attributes:
        folder: The run folder.
        config: Its configuration, or another one that says where to look at it.
        events: Its iterations.
        rig: Its result.
        frames: The rig before the step of every iteration.
        scene: Where it is shown.
    """

    folder: RunFolder
    config: Config
    events: list[dict[str, Any]]
    rig: Rig
    frames: list[Rig]
    scene: Scene

    @classmethod
    def of(cls, folder: RunFolder, *, config: Config | None = None, scene: Scene | None = None) -> ShownRun:
        """A run folder, read.

        Args:
            folder: The run folder.
            config: Says where to look at it; by default that of the run.
            scene: Where to look at it; by default the first test scene.

        Raises:
            InputError: A file of the folder is missing or cannot be used.
        """
        config = folder.config() if config is None else config
        scene = next(load_scenes(config, config.scenes.test_seeds[:1])) if scene is None else scene
        events, rig = folder.events(), find_rig(str(folder.path), config, scene.ego)
        return cls(folder, config, events, rig, rigs_of_events(events, rig, place=folder.path), scene)

    @functools.cached_property
    def surface(self) -> MountSurface:
        """What the cameras stand on."""
        return mount_surface(self.config, self.scene.ego)

    def plot(
        self, out: Path | str | None = None, *, iteration: int | None = None, arrows: bool = True, **options: object
    ) -> object:
        """What `RunFolder.plot` does; ``options`` are those of `warpav.view.picture.plot_rig`."""
        from warpav.view.picture import MOVIE_SUFFIXES, plot_rig

        if out is not None and iteration is None and Path(out).suffix.lower() in MOVIE_SUFFIXES:
            return self.save_film(Path(out), arrows=arrows)
        return plot_rig(
            self.rig if iteration is None else self.frames[self._checked(iteration)],
            out,
            scene=self.scene,
            trajectory_m=self.way_to(iteration),
            add=self.descent_at(iteration) if arrows else None,
            **options,
        )

    def to_pyvista(self) -> Any:  # noqa: ANN401 (a pyvista.MultiBlock)
        """What `RunFolder.to_pyvista` returns."""
        from warpav.view.blocks import run_to_pyvista

        start = find_rig(str(self.folder.path / "rig_initial.yaml"), self.config, self.scene.ego)
        return run_to_pyvista(self.frames, start=start, end=self.rig, scene=self.scene)

    def way_to(self, iteration: int | None) -> np.ndarray | None:
        """Camera positions up to an iteration of its descent [m], [iteration, camera, 3]; None: of the best descent."""
        if iteration is None:
            return trajectory(self.events)
        index = self._checked(iteration)
        own = self.events[index].get("descent")
        return np.array(
            [event["positions_m"] for event in self.events[: index + 1] if event.get("descent") == own], np.float64
        )

    def descent_at(self, iteration: int | None) -> Callable[[Any], object] | None:
        """What draws the arrows of an iteration into a picture; None where the run did not record gradients.

        Args:
            iteration: Its number; None: the one whose cameras stood nearest to the result.
        """
        from warpav.view.descent_view import Descent, add_descent

        if not self.events:
            return None
        index = self._nearest() if iteration is None else self._checked(iteration)
        descent = Descent.of_event(self.events[index])
        if descent is None:
            return None
        return lambda plotter: add_descent(plotter, self.frames[index], descent, self.surface)

    def save_film(self, out: Path, *, arrows: bool = True) -> Path:
        """Write the run as a film: the cameras move over the vehicle, their ways grow.

        Raises:
            InputError: The run has no iteration, the file cannot be written, or a module for it is missing.
        """
        from warpav.view.film import run_film
        from warpav.view.picture import MOVIE_FRAME_S, MOVIE_LAST_S, save_movie

        if not self.events:
            raise InputError(
                f"{self.folder.path / 'events.jsonl'}: expected iterations to make a film of, got none; "
                "a picture of the rig is made with --out rig.png"
            )
        film = run_film(
            self.frames,
            self.events,
            end=self.rig,
            scene=self.scene,
            surface=self.surface if arrows else None,
        )
        return save_movie(film, out, frame_s=MOVIE_FRAME_S, last_s=MOVIE_LAST_S)

    def _checked(self, iteration: int) -> int:
        count = len(self.events)
        if not -count <= iteration < count:
            raise InputError(f"{self.folder.path}: iteration: expected one of {count} from 0, got {iteration}")
        return iteration % count

    def _nearest(self) -> int:
        end_m = np.array([camera.position_m for camera in self.rig.cameras])
        places_m = np.array([event["positions_m"] for event in self.events], np.float64)
        return int(np.linalg.norm(places_m - end_m, axis=2).max(axis=1).argmin())


def inspector(source: str, config: Config, *, off_screen: bool | None = None) -> Inspector:
    """The interactive picture of a rig on the test scenes, with the iterations of a run; not yet shown.

    Args:
        source: Run folder, rig YAML, preset, or ``highest``.
        config: Gives scenes, detector, mount surface and constraints.
        off_screen: Draw without a window; by default when there is no display.

    Raises:
        InputError: The rig or a scene cannot be used, or this machine cannot draw.
    """
    from warpav.view.descent_view import Descent
    from warpav.view.inspected import InspectedRig
    from warpav.view.inspector import Inspector

    seeds, device = config.scenes.test_seeds, checked_device(config.device)
    first = next(load_scenes(config, seeds[:1]))
    rig = find_rig(source, config, first.ego)
    frames, descents, save_to = [rig], [None], Path("rig.yaml")
    if Path(source).is_dir():
        folder = RunFolder.open(source)
        events = folder.events()
        frames = [*rigs_of_events(events, rig, place=folder.path), rig]
        descents = [*map(Descent.of_event, events), None]
        save_to = folder.path / "rig_inspected.yaml"
    mount = camera_mount(config, first.ego)
    detector = load_detector(config)
    state = InspectedRig(
        frames,
        lambda index: first if index == 0 else next(load_scenes(config, seeds[index : index + 1])),
        len(seeds),
        constraints=constraints_of(config, mount.surface),
        height_offset_m=mount.height_offset_m,
        observer_of=lambda rig: _observer(rig, detector, config, device),
        descents=descents,
        device=device,
    )
    return Inspector(state, save_to=save_to, off_screen=off_screen)


def rigs_of_events(events: Sequence[Mapping[str, Any]], rig: Rig, *, place: Path | str = "run") -> list[Rig]:
    """The rigs of a run's iterations.

    Args:
        events: Lines of ``events.jsonl``.
        rig: The run's result; its names, and what the events do not tell, such as lenses that are not free.
        place: The run folder, for messages.

    Raises:
        InputError: The events are of another number of cameras.
    """
    rigs = []
    counts = {len(event["positions_m"]) for event in events}
    if counts - {len(rig.cameras)}:
        raise InputError(
            f"{place}: run folder: expected events.jsonl and the rig files of one run, got {min(counts)} cameras in "
            f"the one and {len(rig.cameras)} in the other; take the rig file instead of the folder"
        )
    for event in events:
        free, cameras = event.get("free", {}), []
        for k, camera in enumerate(rig.cameras):
            pitch_deg, fov_deg = (free[name][k] if name in free else None for name in ("pitch_deg", "fov_deg"))
            model = camera.model
            if fov_deg is not None:
                model = dataclasses.replace(model, fov_rad=math.radians(fov_deg), focal_px=None, centre_px=None)
            cameras.append(
                dataclasses.replace(
                    camera,
                    position_m=np.array(event["positions_m"][k]),
                    yaw_rad=math.radians(event["yaw_deg"][k]),
                    pitch_rad=camera.pitch_rad if pitch_deg is None else math.radians(pitch_deg),
                    model=model,
                )
            )
        rigs.append(Rig.create(cameras))
    return rigs


def _addition(rig: Rig, scene: Scene, config: Config, shown: Shown) -> Callable[[Any], object] | None:
    """What draws coverage or sight into the picture of a rig."""
    if shown not in ("coverage", "sight"):
        return None
    from warpav.render.coverage import Ground
    from warpav.render.device_scene import DeviceScene
    from warpav.view.sight_view import add_coverage, add_sight

    packed = DeviceScene.pack(scene, device=checked_device(config.device))
    if shown == "sight":
        return lambda plotter: add_sight(plotter, rig, packed)
    coverage = Ground.around(packed).coverage(rig.cameras)
    return lambda plotter: add_coverage(plotter, coverage)


def _outcomes(rig: Rig, scene: Scene, config: Config) -> list[ObjectOutcome]:
    """What the configuration's detector makes of every vehicle."""
    from warpav.render.device_scene import DeviceScene

    device = checked_device(config.device)
    observer = _observer(rig, load_detector(config), config, device)
    return observer.look(DeviceScene.pack(scene, device=device)).outcomes


def _observer(rig: Rig, detector: Detector, config: Config, device: str) -> RigObserver:
    from warpav.evaluate import RigObserver
    from warpav.render.renderer import Occlusion

    return RigObserver(
        rig,
        detector,
        confidence_min=config.detector.confidence_min,
        iou_min=config.detector.iou_min,
        occlusion=Occlusion(config.visibility.occlusion),
        supersampling=config.camera.supersampling,
        device=device,
    )


def show_scene(source: str, out: Path | None) -> Iterator[str]:
    """Show a scene, in a window when there is a display, else in ``<scene>.png``; yields lines about it.

    Raises:
        InputError: The scene or the file cannot be used, or this machine cannot draw.
    """
    from warpav.view.picture import inspect_rig as show

    scene = load_scene(source)
    meshes = [scene.surroundings(), scene.ego, *(vehicle.mesh for vehicle in scene.vehicles)]
    triangle_count = sum(len(mesh.triangle) for mesh in meshes)
    people = f", {len(scene.others)} people" if scene.others else ""
    yield f"{scene.name}: {len(scene.vehicles)} vehicles{people}, {triangle_count} triangles"
    for vehicle in (*scene.vehicles, *scene.others):
        x, y = vehicle.box.center_m[:2]
        length, width, height = vehicle.box.size_m
        yield (
            f"  {vehicle.instance_id:3}  {vehicle.category:10} {math.hypot(x, y):5.1f} m away at "
            f"{math.degrees(math.atan2(y, x)):+6.1f} deg, {length:.1f} x {width:.1f} x {height:.1f} m"
        )
    no_cameras = Rig(())
    fallback = Path(f"{scene.name}.png")
    file = show(no_cameras, ego=scene.ego, scene=scene, title=scene.name, out=out, out_without_display=fallback)
    if file is not None:
        yield f"wrote {file}"


def draw_run(
    folder: RunFolder,
    rigs: Mapping[str, Rig],
    *,
    objective: RigObjective,
    scene: Scene,
    assigned: AssignedScene,
    say: Callable[[str], None],
) -> None:
    """Draw the figures of a run into its folder.

    Args:
        folder: The run folder; its events are drawn too.
        rigs: The start and the result, in this order, by their headings.
        objective: Looks at the scene through the rigs.
        scene: A test scene.
        assigned: The same scene on the device.
        say: Told when this machine cannot draw.
    """
    from warpav import figures
    from warpav.view.opengl import opengl_problem
    from warpav.view.picture import inspect_rig as show

    start, result = rigs.values()
    path_m, surface = trajectory(folder.events()), objective.mount.surface
    spacing_m = objective.constraints.min_spacing_m
    figures.loss_curves(folder.events(), folder.figure_path("loss_curves"), min_distance_m=spacing_m)
    figures.rig_top_view(
        folder.figure_path("rig_top_view"),
        rig=result,
        ego=scene.ego,
        mount_surface=surface,
        rig_initial=start,
        trajectory_m=path_m,
        shows_zone=objective.constraints.are_inequalities,
    )
    sheet = {heading: _panels(rig, objective, assigned) for heading, rig in rigs.items()}
    figures.detections_sheet(sheet, folder.figure_path("detections"))
    problem = opengl_problem()
    if problem:
        say(f"no picture of the rig: {problem}")
        return
    show(result, ego=scene.ego, scene=scene, trajectory_m=path_m, out=folder.figure_path("rig"))


def trajectory(events: Sequence[dict[str, Any]]) -> np.ndarray | None:
    """Camera positions over the iterations [m], shape [iteration, camera, 3]; None for fewer than two iterations.

    Of several descents it is the way of the one that came upon the best rig.
    """
    looks = [event for event in events if event.get("training_objective") is not None]
    best = min(looks, key=lambda event: event["training_objective"], default=None)
    way = [event["positions_m"] for event in events if best is None or event.get("descent") == best.get("descent")]
    return np.array(way) if len(way) > 1 else None


def _check_folder(folder: Path, option: str) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: {option}: expected a folder to write to, got a file")


def _panels(rig: Rig, objective: RigObjective, assigned: AssignedScene) -> list[DetectionPanel]:
    from warpav.figures import DetectionPanel

    seen, _, _ = objective.observe_rig(rig, assigned)
    return [
        DetectionPanel(
            title=camera.name,
            image_rgb=seen.image_rgb[k],
            truth_box_px=seen.truth_box_px[k],
            detection_box_px=seen.detections[k].box_px,
            detection_of_truth=seen.match[k],
        )
        for k, camera in enumerate(rig.cameras)
    ]


def _overridden(camera: RigCamera, config: Config, overrides: Sequence[str]) -> RigCamera:
    """The camera with the image size and lens that the user asked for on the command line.

    A calibrated camera keeps its focal lengths and principal point unless its field of view or lens is given.
    """
    given = {override.partition("=")[0].strip() for override in overrides}
    wanted, model = config.camera, camera.model
    model = model.resized(
        wanted.width_px if "camera.width_px" in given else model.width_px,
        wanted.height_px if "camera.height_px" in given else model.height_px,
    )
    if given & {"camera.fov_deg", "camera.lens", "camera.distortion"}:
        keeps_lens = "camera.lens" not in given
        keeps_distortion = keeps_lens and "camera.distortion" not in given
        try:
            model = dataclasses.replace(
                model,
                fov_rad=math.radians(wanted.fov_deg) if "camera.fov_deg" in given else model.fov_rad,
                lens=model.lens if keeps_lens else Lens(wanted.lens),
                focal_px=None,
                centre_px=None,
                distortion=model.distortion if keeps_distortion else wanted.distortion,
            )
        except ValueError as error:
            raise InputError(f"camera: expected numbers that camera {camera.name!r} can have, got: {error}") from None
    return dataclasses.replace(camera, model=model)


def _write_image(folder: Path, camera: RigCamera, image: CameraImage, scene: Scene) -> None:
    import cv2

    from warpav.render.device_scene import EGO, FIRST_VEHICLE

    value_of_object = np.full(FIRST_VEHICLE + len(scene.vehicles) + 1, OBJECT_BACKGROUND, np.uint16)  # last: nothing
    value_of_object[EGO] = OBJECT_EGO
    value_of_object[FIRST_VEHICLE:-1] = [vehicle.instance_id for vehicle in scene.vehicles]
    files = {
        f"{camera.name}_rgb.png": np.ascontiguousarray(image.rgb[:, :, ::-1]),
        f"{camera.name}_object.png": value_of_object[image.object_index],
    }
    for name, pixels in files.items():
        if not cv2.imwrite(str(folder / name), pixels):
            raise OSError(0, f"{name} could not be written")
    np.save(folder / f"{camera.name}_depth_m.npy", image.depth_m.astype(np.float32))


def _view(camera: RigCamera) -> dict[str, Any]:
    return {
        "name": camera.name,
        "width_px": camera.model.width_px,
        "height_px": camera.model.height_px,
        "lens": camera.model.lens,
        "intrinsics": camera.model.intrinsics.tolist(),
        "distortion": list(camera.model.distortion),
        "ego_from_camera": camera.ego_from_camera.tolist(),
    }
