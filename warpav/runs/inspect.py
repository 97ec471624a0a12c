"""Images, animations and the interactive inspector of rigs and runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from warpav.core.devices import checked_device
from warpav.core.errors import ArgumentError
from warpav.rig.rig import Rig
from warpav.runs.config import Config
from warpav.runs.drawn_run import nearest_iteration, rigs_of_events
from warpav.runs.events import of_modules, trajectory
from warpav.runs.mounts import camera_mount, constraints_of, mount_surface, rig_modules
from warpav.runs.networks import load_detector
from warpav.runs.rig_source import find_rig, is_run_folder
from warpav.runs.run_folder import RunFolder
from warpav.runs.scene_set import load_scenes

if TYPE_CHECKING:
    from collections.abc import Callable

    from warpav.core.progress import Progress
    from warpav.detection.detector import Detector
    from warpav.evaluation.coverage import Coverage
    from warpav.evaluation.metrics import ObjectOutcome, RigObserver
    from warpav.optimisation.further_camera import FurtherCameras
    from warpav.raster.mesh import Mesh
    from warpav.requirements.check import RequirementResult
    from warpav.rig.module import Module
    from warpav.scene.scene import Scene
    from warpav.view.inspector import BEGINNINGS, Inspector

Shown = Literal["rig", "coverage", "redundancy", "outcomes", "visibility", "further", "zones", "gain", "sheet"]
"""What an image of a rig shows besides: the ground by how many cameras see somebody there, or see the ground itself;
traffic by what becomes of it; what every camera sees; what one more camera would bring, as arrows, or painted on the
body; the zones of the body; or, instead, a page to print."""


def inspect_rig(
    source: str,
    config: Config,
    out: Path | None,
    *,
    shown: Shown = "rig",
    requirements: str | None = None,
    progress: Progress | None = None,
) -> Path | None:
    """Show a rig on its vehicle in traffic: in the interactive inspector if there is a display, else in a file.

    Args:
        source: Run folder, rig YAML, preset, or ``highest``.
        config: Gives the scene, which is the first test scene, and the detector.
        out: PNG, HTML, GIF or MP4 to write; the last two are animations of a run. Of a sheet PNG, PDF or SVG. None
            opens a window, or writes ``sheet.pdf``.
        shown: What is drawn besides the rig and the trajectories of its cameras. The inspector begins with it, and with
            the coverage when it is the rig alone.
        requirements: YAML file, or a template's name: their points lie on the ground by what is met. In a file, only
            beside the rig alone.
        progress: Shows how many images of an animation are done.

    Returns:
        The file that was written, if one was.

    Raises:
        InputError: The rig or the file cannot be used, or this machine cannot draw.
    """
    from warpav.view import plot
    from warpav.view.opengl import has_display

    if requirements is not None and shown != "rig":
        raise ArgumentError(
            "requirements", f"expected none beside {shown!r}, got {requirements!r}; leave one of them out"
        )
    if shown == "sheet":
        return _write_sheet(source, config, out)
    if out is None and has_display():
        first = "requirements" if requirements is not None else "coverage" if shown == "rig" else shown
        inspector(source, config, begin_with=first, requirements=requirements).plotter.show()
        return None
    is_run = is_run_folder(source)
    further = _further(source, shown) if shown in ("further", "gain") else None
    out = out or (Path(source) / "inspect.png" if is_run else Path("rig.png"))
    if is_run and shown == "rig" and requirements is None:
        return plot(RunFolder.open(source).drawn(config), out=out, progress=progress)
    scene = next(load_scenes(config, config.scenes.test_seeds[:1]))
    rig = find_rig(source, config, scene.ego)
    on_body = shown in ("further", "zones", "gain")
    return plot(
        rig,
        out=out,
        progress=progress,
        scene=scene,
        trajectory_m=trajectory(RunFolder.open(source).events()) if is_run and not on_body else None,
        mount_surface=mount_surface(config, scene.ego) if shown in ("zones", "gain") else None,
        outcomes=_outcomes(rig, scene, config) if shown == "outcomes" else None,
        coverage=_coverage(rig, scene, config, shown) if shown in ("coverage", "redundancy") else None,
        visibility=shown == "visibility",
        further=further,
        requirements=None if requirements is None else _check(requirements, config)(rig, scene.ego),
    )


def _write_sheet(source: str, config: Config, out: Path | None) -> Path:
    """Write a page to print, of which the title is the source."""
    from warpav.view import plot

    out = out or (Path(source) / "sheet.pdf" if is_run_folder(source) else Path("sheet.pdf"))
    ego = next(load_scenes(config, config.scenes.test_seeds[:1])).ego
    return plot(find_rig(source, config, ego), kind="sheet", ego=ego, title=Path(source).name, out=out)


def inspector(
    source: str,
    config: Config,
    *,
    begin_with: BEGINNINGS = "coverage",
    requirements: str | None = None,
    off_screen: bool | None = None,
) -> Inspector:
    """The interactive view of a rig on the test scenes, with the iterations of a run; not yet shown.

    Args:
        source: Run folder, rig YAML, preset, or ``highest``.
        config: Gives scenes, detector, mount surface and constraints.
        begin_with: What is shown at first, see `warpav.view.inspector.Inspector`.
        requirements: YAML file, or a template's name; None: there are none.
        off_screen: Draw without a window; by default when there is no display.

    Raises:
        InputError: The rig or a scene cannot be used, or this machine cannot draw; to begin with what one more camera
            would bring, the source is no run of a search by a pool.
    """
    from warpav.view.descent_view import Steepest
    from warpav.view.inspected import InspectedRig
    from warpav.view.inspector import Inspector

    check = None if requirements is None else _check(requirements, config)
    further = _further(source, begin_with) if begin_with in ("further", "gain") else None
    seeds, device = config.scenes.test_seeds, checked_device(config.device)
    first = next(load_scenes(config, seeds[:1]))
    rig = find_rig(source, config, first.ego)
    frames, descents, trajectory_m, save_to = [rig], [None], None, Path("rig.yaml")
    if is_run_folder(source):
        folder = RunFolder.open(source)
        events = folder.events()
        events = of_modules(events, [camera.module for camera in rig.cameras])
        frames = [*rigs_of_events(events, rig, place=folder.path), rig]
        trajectory_m = trajectory(events)
        descents = [*map(Steepest.of_event, events), None]
        if events:  # as in images, the result has the arrows of the iteration nearest to it
            descents[-1] = descents[nearest_iteration(events, rig)]
        further = folder.further_cameras()
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
        further=further,
        modules=_modules(config),
        check=check,
        device=device,
    )
    return Inspector(state, save_to=save_to, trajectory_m=trajectory_m, begin_with=begin_with, off_screen=off_screen)


def _modules(config: Config) -> tuple[Module, ...]:
    """What cameras may be changed for: the modules of a run, or those of its catalogue."""
    from warpav.rig.catalogue import builtin_modules, read_modules

    catalogue = builtin_modules() if config.rig.catalogue is None else read_modules(config.rig.catalogue)
    return rig_modules(config) or tuple(catalogue.values())


def _check(requirements: str, config: Config) -> Callable[[Rig, Mesh], RequirementResult]:
    """Holds rigs against requirements, which are read now."""
    from warpav.requirements.check import check_requirements
    from warpav.requirements.read import read_requirements

    wanted, device = read_requirements(requirements), checked_device(config.device)
    return lambda rig, ego: check_requirements(
        rig, ego, wanted, supersampling=config.camera.supersampling, device=device
    )


def _further(source: str, shown: str) -> FurtherCameras:
    """What further cameras would add to the rig of a run."""
    found = RunFolder.open(source).further_cameras() if is_run_folder(source) else None
    if found is None:
        raise ArgumentError(
            "show",
            f"expected the folder of a run with optimiser.search=pool that has drawn its pool for {shown!r}, got "
            f"{source!r}",
        )
    return found


def _coverage(rig: Rig, scene: Scene, config: Config, shown: Shown) -> Coverage:
    """Which cameras see whom where, or the ground itself."""
    from warpav.evaluation.coverage import HEIGHTS_M, PATCH_M, Ground
    from warpav.scene.device_scene import DeviceScene

    packed = DeviceScene.pack(scene, device=checked_device(config.device))
    heights_m = HEIGHTS_M if shown == "coverage" else (PATCH_M,)
    return Ground.around(packed).coverage(rig.cameras, heights_m=heights_m)


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
