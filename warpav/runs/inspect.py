"""Pictures, films and the interactive inspector of rigs and runs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from warpav.core.errors import InputError
from warpav.rig.rig import Rig
from warpav.runs.config import Config
from warpav.runs.run_folder import RunFolder, trajectory
from warpav.runs.sources import (
    camera_mount,
    checked_device,
    constraints_of,
    find_rig,
    is_run_folder,
    load_detector,
    load_scenes,
    mount_surface,
)

if TYPE_CHECKING:
    from warpav.detection.detector import Detector
    from warpav.evaluation.metrics import ObjectOutcome, RigObserver
    from warpav.rig.mount_surface import MountSurface
    from warpav.runs.progress import RunDisplay
    from warpav.scene.scene import Scene
    from warpav.view.inspector import Inspector
    from warpav.view.picture import Watch

Shown = Literal["rig", "coverage", "outcomes", "sight"]
"""What a picture of a rig shows besides: the ground by how many cameras see somebody there, traffic by what becomes of
it, or what every camera sees."""


def inspect_rig(
    source: str, config: Config, out: Path | None, *, shown: Shown = "rig", display: RunDisplay | None = None
) -> Path | None:
    """Show a rig on its vehicle in traffic: the interactive inspector when there is a display, else a file.

    Args:
        source: Run folder, rig YAML, preset, or ``highest``.
        config: Gives the scene: the first test scene; and the detector.
        out: PNG, HTML, GIF or MP4 to write, the last two films of a run; None opens a window.
        shown: What is drawn besides the rig and the path of its cameras. The inspector begins with it, and with the
            coverage when it is the rig alone.
        display: Shows how many pictures of a film are done.

    Returns:
        The file that was written, if one was.

    Raises:
        InputError: The rig or the file cannot be used, or this machine cannot draw.
    """
    from warpav.view.opengl import has_display
    from warpav.view.picture import MOVIE_SUFFIXES
    from warpav.view.picture import inspect_rig as show

    if out is None and has_display():
        inspector(source, config, begin_with="coverage" if shown == "rig" else shown).plotter.show()
        return None
    watch = None if display is None else partial(_watched, display)
    is_run = is_run_folder(source)
    if is_run and shown == "rig" and out is not None and out.suffix.lower() in MOVIE_SUFFIXES:
        return ShownRun.of(RunFolder.open(source), config=config).save_film(out, watch=watch)
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
            watch=watch,
        )
    scene = next(load_scenes(config, config.scenes.test_seeds[:1]))
    rig = find_rig(source, config, scene.ego)
    return show(
        rig,
        ego=scene.ego,
        scene=scene,
        trajectory_m=trajectory(RunFolder.open(source).events()) if is_run else None,
        outcomes=_outcomes(rig, scene, config) if shown == "outcomes" else None,
        sight=shown == "sight",
        add=_coverage(rig, scene, config) if shown == "coverage" else None,
        is_wide=shown != "rig",
        out=out,
        out_without_display=Path(source) / "inspect.png" if is_run else Path("rig.png"),
        watch=watch,
    )


def _watched(display: RunDisplay, image_rgb: Iterable[np.ndarray], count: int) -> Iterator[np.ndarray]:
    with display:
        yield from display.steps("pictures", image_rgb, count=count)


def run_plotter(
    folder: RunFolder,
    *,
    iteration: int | None = None,
    scene: Scene | None = None,
    arrows: bool = True,
    **options: Any,  # noqa: ANN401
) -> Any:  # noqa: ANN401 (a pyvista.Plotter)
    """A plotter with the picture of a run, not yet shown: what `RunFolder.plot` shows, to add to.

    Args:
        folder: The run folder.
        iteration: Instead of the result, the rig before the step of this one; negative ones count from the end.
        scene: Traffic and street; by default the first test scene of the run.
        arrows: Whether to draw where the descent moves and turns the cameras.
        **options: Those of `warpav.view.rig_view.rig_plotter`.

    Raises:
        InputError: A file of the folder cannot be used, there is no such iteration, or nothing can be drawn here.
    """
    from warpav.view.rig_view import rig_plotter

    run = ShownRun.of(folder, scene=scene)
    add = run.descent_at(iteration) if arrows else None
    plotter = rig_plotter(run.rig_at(iteration), scene=run.scene, trajectory_m=run.way_to(iteration), **options)
    if add is not None:
        add(plotter)
    return plotter


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

    @cached_property
    def surface(self) -> MountSurface:
        """What the cameras stand on."""
        return mount_surface(self.config, self.scene.ego)

    def plot(
        self,
        out: Path | str | None = None,
        *,
        iteration: int | None = None,
        arrows: bool = True,
        **options: Any,  # noqa: ANN401
    ) -> object:
        """What `RunFolder.plot` does; ``options`` are those of `warpav.view.picture.plot_rig`."""
        from warpav.view.picture import MOVIE_SUFFIXES, plot_rig

        if out is not None and iteration is None and Path(out).suffix.lower() in MOVIE_SUFFIXES:
            return self.save_film(Path(out), arrows=arrows)
        return plot_rig(
            self.rig_at(iteration),
            out,
            scene=self.scene,
            trajectory_m=self.way_to(iteration),
            add=self.descent_at(iteration) if arrows else None,
            **options,
        )

    def rig_at(self, iteration: int | None) -> Rig:
        """The rig before the step of an iteration; None: the result."""
        return self.rig if iteration is None else self.frames[self._checked(iteration)]

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
        index = nearest_iteration(self.events, self.rig) if iteration is None else self._checked(iteration)
        descent = Descent.of_event(self.events[index])
        if descent is None:
            return None
        return lambda plotter: add_descent(plotter, self.frames[index], descent, self.surface)

    def save_film(self, out: Path, *, arrows: bool = True, watch: Watch | None = None) -> Path:
        """Write the run as a film: the cameras move over the vehicle, their ways grow.

        Args:
            out: ``.gif`` or ``.mp4``.
            arrows: Whether to draw where the descent moves and turns the cameras.
            watch: Shows how many pictures are done.

        Raises:
            InputError: The run has no iteration, the file cannot be written, or a module for it is missing.
        """
        from warpav.view.film import run_film, shown_iterations
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
        if watch is not None:
            film = watch(film, len(shown_iterations(len(self.frames))) + 1)
        return save_movie(film, out, frame_s=MOVIE_FRAME_S, last_s=MOVIE_LAST_S)

    def _checked(self, iteration: int) -> int:
        count = len(self.events)
        if not -count <= iteration < count:
            raise InputError(f"{self.folder.path}: iteration: expected one of {count} from 0, got {iteration}")
        return iteration % count


def inspector(
    source: str,
    config: Config,
    *,
    begin_with: Literal["coverage", "outcomes", "sight"] = "coverage",
    off_screen: bool | None = None,
) -> Inspector:
    """The interactive picture of a rig on the test scenes, with the iterations of a run; not yet shown.

    Args:
        source: Run folder, rig YAML, preset, or ``highest``.
        config: Gives scenes, detector, mount surface and constraints.
        begin_with: What is shown at first, see `warpav.view.inspector.Inspector`.
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
    frames, descents, way_m, save_to = [rig], [None], None, Path("rig.yaml")
    if is_run_folder(source):
        folder = RunFolder.open(source)
        events = folder.events()
        frames = [*rigs_of_events(events, rig, place=folder.path), rig]
        way_m = trajectory(events)
        descents = [*map(Descent.of_event, events), None]
        if events:  # as in pictures, the result has the arrows of the iteration nearest to it
            descents[-1] = descents[nearest_iteration(events, rig)]
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
    return Inspector(state, save_to=save_to, trajectory_m=way_m, begin_with=begin_with, off_screen=off_screen)


def nearest_iteration(events: Sequence[Mapping[str, Any]], rig: Rig) -> int:
    """The iteration before whose step the cameras stood nearest to those of a rig; from 0.

    Args:
        events: Lines of ``events.jsonl``, at least one, of as many cameras as the rig has.
        rig: The rig.
    """
    end_m = np.array([camera.position_m for camera in rig.cameras])
    places_m = np.array([event["positions_m"] for event in events], np.float64)
    return int(np.linalg.norm(places_m - end_m, axis=2).max(axis=1).argmin())


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
                try:
                    model = dataclasses.replace(model, fov_rad=math.radians(fov_deg), focal_px=None, centre_px=None)
                except ValueError as error:
                    raise InputError(
                        f"{place}: run folder: expected fields of view of {camera.name}, got: {error}"
                    ) from None
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


def _coverage(rig: Rig, scene: Scene, config: Config) -> Callable[[Any], object]:
    """What draws into the picture of a rig who is seen where."""
    from warpav.evaluation.coverage import Ground
    from warpav.scene.device_scene import DeviceScene
    from warpav.view.sight_view import add_coverage

    packed = DeviceScene.pack(scene, device=checked_device(config.device))
    coverage = Ground.around(packed).coverage(rig.cameras)
    return lambda plotter: add_coverage(plotter, coverage)


def _outcomes(rig: Rig, scene: Scene, config: Config) -> list[ObjectOutcome]:
    """What the configuration's detector makes of every vehicle."""
    from warpav.scene.device_scene import DeviceScene

    device = checked_device(config.device)
    observer = _observer(rig, load_detector(config), config, device)
    return observer.look(DeviceScene.pack(scene, device=device)).outcomes


def _observer(rig: Rig, detector: Detector, config: Config, device: str) -> RigObserver:
    from warpav.evaluation.metrics import RigObserver
    from warpav.raster.decide import Occlusion

    return RigObserver(
        rig,
        detector,
        confidence_min=config.detector.confidence_min,
        iou_min=config.detector.iou_min,
        occlusion=Occlusion(config.visibility.occlusion),
        supersampling=config.camera.supersampling,
        device=device,
    )
