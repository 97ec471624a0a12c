"""Images, animations and the interactive inspector of rigs and runs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from warpav.core.devices import checked_device
from warpav.core.errors import InputError
from warpav.rig.rig import Rig
from warpav.runs.config import Config
from warpav.runs.events import trajectory
from warpav.runs.mounts import camera_mount, constraints_of, mount_surface
from warpav.runs.networks import load_detector
from warpav.runs.rig_source import find_rig, is_run_folder
from warpav.runs.run_folder import RunFolder
from warpav.runs.scene_set import load_scenes
from warpav.view import Canvas, drawing_of
from warpav.view.output import ANIMATION_PX, Animation

if TYPE_CHECKING:
    from warpav.core.progress import Progress
    from warpav.detection.detector import Detector
    from warpav.evaluation.coverage import Coverage
    from warpav.evaluation.metrics import ObjectOutcome, RigObserver
    from warpav.rig.mount_surface import MountSurface
    from warpav.scene.scene import Scene
    from warpav.view.inspector import Inspector

Shown = Literal["rig", "coverage", "outcomes", "visibility"]
"""What an image of a rig shows besides: the ground by how many cameras see somebody there, traffic by what becomes of
it, or what every camera sees."""


def inspect_rig(
    source: str, config: Config, out: Path | None, *, shown: Shown = "rig", progress: Progress | None = None
) -> Path | None:
    """Show a rig on its vehicle in traffic: in the interactive inspector if there is a display, else in a file.

    Args:
        source: Run folder, rig YAML, preset, or ``highest``.
        config: Gives the scene, which is the first test scene, and the detector.
        out: PNG, HTML, GIF or MP4 to write; the last two are animations of a run. None opens a window.
        shown: What is drawn besides the rig and the trajectories of its cameras. The inspector begins with it, and with
            the coverage when it is the rig alone.
        progress: Shows how many images of an animation are done.

    Returns:
        The file that was written, if one was.

    Raises:
        InputError: The rig or the file cannot be used, or this machine cannot draw.
    """
    from warpav.view import plot
    from warpav.view.opengl import has_display

    if out is None and has_display():
        inspector(source, config, begin_with="coverage" if shown == "rig" else shown).plotter.show()
        return None
    is_run = is_run_folder(source)
    out = out or (Path(source) / "inspect.png" if is_run else Path("rig.png"))
    if is_run and shown == "rig":
        return plot(DrawnRun.of(RunFolder.open(source), config=config), out=out, progress=progress)
    scene = next(load_scenes(config, config.scenes.test_seeds[:1]))
    rig = find_rig(source, config, scene.ego)
    return plot(
        rig,
        out=out,
        progress=progress,
        scene=scene,
        trajectory_m=trajectory(RunFolder.open(source).events()) if is_run else None,
        outcomes=_outcomes(rig, scene, config) if shown == "outcomes" else None,
        coverage=_coverage(rig, scene, config) if shown == "coverage" else None,
        visibility=shown == "visibility",
    )


@dataclasses.dataclass(frozen=True, eq=False)
class DrawnRun:
    """What images of a run are drawn from.

    Attributes:
        name: Where it is, for messages.
        events: Its iterations, as in ``events.jsonl``.
        rig: Its result.
        frames: The rig before the step of every iteration.
        scene: Traffic and street around it.
        surface_of: Gives what the cameras stand on.
    """

    name: str
    events: Sequence[Mapping[str, Any]]
    rig: Rig
    frames: Sequence[Rig]
    scene: Scene
    surface_of: Callable[[], MountSurface]

    @classmethod
    def of(cls, folder: RunFolder, *, config: Config | None = None, scene: Scene | None = None) -> DrawnRun:
        """A run folder, read.

        Args:
            folder: The run folder.
            config: Names the scene; by default that of the run.
            scene: Traffic and street; by default the first test scene.

        Raises:
            InputError: A file of the folder is missing or cannot be used.
        """
        config = folder.config() if config is None else config
        scene = next(load_scenes(config, config.scenes.test_seeds[:1])) if scene is None else scene
        events, rig = folder.events(), find_rig(str(folder.path), config, scene.ego)
        frames = rigs_of_events(events, rig, place=folder.path)
        return cls(str(folder.path), events, rig, frames, scene, lambda: mount_surface(config, scene.ego))

    @cached_property
    def surface(self) -> MountSurface:
        """What the cameras stand on."""
        return self.surface_of()

    def drawing(
        self, canvas: Canvas, *, iteration: int | None = None, arrows: bool = True, visibility: bool = False
    ) -> Any:  # noqa: ANN401 (see warpav.view.drawing_of)
        """What `warpav.view.plot` shows of the run, with its options."""
        if canvas.is_animation and iteration is None:
            return self.animation(arrows=arrows, window_size=canvas.size_px(ANIMATION_PX))
        rig = self.rig_at(iteration)
        plotter = drawing_of.dispatch(Rig)(
            rig, canvas, scene=self.scene, trajectory_m=self.trajectory_to(iteration), visibility=visibility
        )
        if arrows:
            self._add_descent(plotter, iteration)
        return plotter

    def rig_at(self, iteration: int | None) -> Rig:
        """The rig before the step of an iteration; None: the result."""
        return self.rig if iteration is None else self.frames[self._checked(iteration)]

    def trajectory_to(self, iteration: int | None) -> np.ndarray | None:
        """Camera positions up to an iteration of its descent [m], [iteration, camera, 3]; None: of the best one."""
        if iteration is None:
            return trajectory(self.events)
        index = self._checked(iteration)
        own = self.events[index].get("descent")
        return np.array(
            [event["positions_m"] for event in self.events[: index + 1] if event.get("descent") == own], np.float64
        )

    def animation(self, *, arrows: bool = True, window_size: tuple[int, int] = ANIMATION_PX) -> Animation:
        """The cameras move over the vehicle, and their trajectories grow.

        Args:
            arrows: Whether to draw where the descent moves and turns the cameras.
            window_size: Width and height [px].

        Raises:
            InputError: The run has no iteration.
        """
        from warpav.view.animation import run_animation

        if not self.events:
            raise InputError(f"{self.name}: expected iterations to animate, got none; write a .png instead")
        return run_animation(
            self.frames,
            self.events,
            end=self.rig,
            scene=self.scene,
            surface=self.surface if arrows else None,
            window_size=window_size,
        )

    def _add_descent(self, plotter: Any, iteration: int | None) -> None:  # noqa: ANN401 (a pyvista.Plotter)
        """Add the arrows of an iteration where the run recorded gradients; None: of the one nearest to the result."""
        from warpav.view.descent_view import Steepest, add_descent

        if not self.events:
            return
        index = nearest_iteration(self.events, self.rig) if iteration is None else self._checked(iteration)
        steepest = Steepest.of_event(self.events[index])
        if steepest is not None:
            add_descent(plotter, self.frames[index], steepest, self.surface)

    def _checked(self, iteration: int) -> int:
        count = len(self.events)
        if not -count <= iteration < count:
            raise InputError(f"{self.name}: iteration: expected one of {count} from 0, got {iteration}")
        return iteration % count


drawing_of.register(DrawnRun, DrawnRun.drawing)


def inspector(
    source: str,
    config: Config,
    *,
    begin_with: Literal["coverage", "outcomes", "visibility"] = "coverage",
    off_screen: bool | None = None,
) -> Inspector:
    """The interactive view of a rig on the test scenes, with the iterations of a run; not yet shown.

    Args:
        source: Run folder, rig YAML, preset, or ``highest``.
        config: Gives scenes, detector, mount surface and constraints.
        begin_with: What is shown at first, see `warpav.view.inspector.Inspector`.
        off_screen: Draw without a window; by default when there is no display.

    Raises:
        InputError: The rig or a scene cannot be used, or this machine cannot draw.
    """
    from warpav.view.descent_view import Steepest
    from warpav.view.inspected import InspectedRig
    from warpav.view.inspector import Inspector

    seeds, device = config.scenes.test_seeds, checked_device(config.device)
    first = next(load_scenes(config, seeds[:1]))
    rig = find_rig(source, config, first.ego)
    frames, descents, trajectory_m, save_to = [rig], [None], None, Path("rig.yaml")
    if is_run_folder(source):
        folder = RunFolder.open(source)
        events = folder.events()
        frames = [*rigs_of_events(events, rig, place=folder.path), rig]
        trajectory_m = trajectory(events)
        descents = [*map(Steepest.of_event, events), None]
        if events:  # as in images, the result has the arrows of the iteration nearest to it
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
    return Inspector(state, save_to=save_to, trajectory_m=trajectory_m, begin_with=begin_with, off_screen=off_screen)


def nearest_iteration(events: Sequence[Mapping[str, Any]], rig: Rig) -> int:
    """The iteration before whose step the cameras stood nearest to those of a rig; from 0.

    Args:
        events: Lines of ``events.jsonl``, at least one, of as many cameras as the rig has.
        rig: The rig.
    """
    end_m = np.array([camera.position_m for camera in rig.cameras])
    positions_m = np.array([event["positions_m"] for event in events], np.float64)
    return int(np.linalg.norm(positions_m - end_m, axis=2).max(axis=1).argmin())


def rigs_of_events(events: Sequence[Mapping[str, Any]], rig: Rig, *, place: Path | str = "run") -> list[Rig]:
    """The rigs of a run's iterations.

    Args:
        events: Lines of ``events.jsonl``.
        rig: The run's result; its names, and what the events do not hold, such as lenses that are not free.
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


def _coverage(rig: Rig, scene: Scene, config: Config) -> Coverage:
    """Which cameras see whom where."""
    from warpav.evaluation.coverage import Ground
    from warpav.scene.device_scene import DeviceScene

    packed = DeviceScene.pack(scene, device=checked_device(config.device))
    return Ground.around(packed).coverage(rig.cameras)


def _outcomes(rig: Rig, scene: Scene, config: Config) -> list[ObjectOutcome]:
    """What the configuration's detector makes of every vehicle."""
    from warpav.scene.device_scene import DeviceScene

    device = checked_device(config.device)
    observer = _observer(rig, load_detector(config), config, device)
    return observer.observe(DeviceScene.pack(scene, device=device)).outcomes


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
