"""Commands that look: the inspector, images, plots, drawings for a workshop, rendered images of a rig."""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from warpav.core.errors import ArgumentError, InputError
from warpav.core.files import check_folder
from warpav.core.warp_setup import checked_device
from warpav.raster.lens import Lens
from warpav.rig import Rig, RigCamera
from warpav.runs._drawn_run import fitting, vehicle_name
from warpav.runs._editor import RigScorer, judge_of, search_from
from warpav.runs._events import trajectory
from warpav.runs._mounts import camera_mount, constraints_of, mount_surface, objective_options, rig_modules
from warpav.runs._networks import load_detector
from warpav.runs._rig_source import arm_names, find_rig, is_run_folder
from warpav.runs._run_folder import RunFolder
from warpav.runs._scene_set import first_scene, load_scene, load_scenes
from warpav.runs.config import Config
from warpav.scene import read_scene
from warpav.view import check_suffix, checked_figure, kinds_of, plot

if TYPE_CHECKING:
    from warpav.core.progress import Progress
    from warpav.detection import CameraImage
    from warpav.optimisation import FurtherCameras, RigObserver
    from warpav.raster.mesh import Mesh
    from warpav.rig import Module
    from warpav.scene import Scene
    from warpav.sight import RequirementResult
    from warpav.view import BEGINNINGS, Inspector

_Shown = Literal["rig", "coverage", "redundancy", "outcomes", "visibility", "further", "zones", "gain", "sheet"]
"""What an image of a rig shows besides: the ground by how many cameras see somebody there, or see the ground itself;
traffic by what becomes of it; what every camera sees; what one more camera would bring, as arrows, or painted on the
body; the zones of the body; or, instead, a page to print."""


_PAGE_SCENES = 3
"""Scenes that a page holds at most; each takes a megabyte."""


def no_window_text() -> str:
    """Why a file is written rather than a window opened."""
    from warpav.view import display_text

    return f"no window here, as {display_text()}"


def inspect_rig(
    source: str,
    config: Config,
    out: Path | None,
    *,
    shown: _Shown = "rig",
    requirements: str | None = None,
    progress: Progress | None = None,
) -> Path | None:
    """Show a rig on its vehicle in traffic: in the interactive inspector if there is a display, else in a file."""
    from warpav.optimisation import RigObserver
    from warpav.scene import DeviceScene
    from warpav.sight import HEIGHTS_M, PATCH_M, Ground
    from warpav.view import has_display

    if requirements is not None and shown != "rig":
        raise ArgumentError(
            "requirements", f"expected none beside {shown!r}, got {requirements!r}; leave one of them out"
        )
    is_run = is_run_folder(source)
    if shown == "sheet":
        out = out or (Path(source) / "sheet.pdf" if is_run else Path("sheet.pdf"))
        ego = first_scene(config).ego
        name, rig = Path(source).name, find_rig(source, config, ego)
        return plot(rig, kind="sheet", ego=ego, vehicle=vehicle_name(config), title=name, out=out)
    if out is not None and out.suffix.lower() == ".rrd":
        return _write_recording(source, config, out, shown, requirements)
    if out is not None:
        check_suffix(out)
    if out is None and has_display():
        first = "requirements" if requirements is not None else "coverage" if shown == "rig" else shown
        inspector(source, config, begin_with=first, requirements=requirements).plotter.show()
        return None
    further = _further(source, shown) if shown in ("further", "gain") else None
    out = out or (Path(source) / "inspect.png" if is_run else Path("rig.png"))
    if is_run and shown == "rig" and requirements is None:
        return plot(RunFolder.open(source).drawn(config), out=out, progress=progress)
    scene = first_scene(config)
    rig = find_rig(source, config, scene.ego)
    on_body = shown in ("further", "zones", "gain")
    outcomes = coverage = None
    if shown in ("coverage", "redundancy", "outcomes"):
        device = checked_device(config.device)
        packed = DeviceScene.pack(scene, device=device)
        if shown == "outcomes":
            observer = RigObserver(rig, load_detector(config), objective_options(config), device=device)
            outcomes = observer.observe(packed).outcomes
        else:
            heights_m = HEIGHTS_M if shown == "coverage" else (PATCH_M,)
            coverage = Ground.around(packed).coverage(rig.cameras, heights_m=heights_m)
    return plot(
        rig,
        out=out,
        progress=progress,
        scene=scene,
        trajectory_m=trajectory(RunFolder.open(source).events()) if is_run and not on_body else None,
        mount_surface=mount_surface(config, scene.ego) if shown in ("zones", "gain") else None,
        outcomes=outcomes,
        coverage=coverage,
        visibility=shown == "visibility",
        further=further,
        requirements=None if requirements is None else _check(requirements, config)(rig, scene.ego),
    )


def _write_recording(source: str, config: Config, out: Path, shown: _Shown, requirements: str | None) -> Path:
    """Write the rig in the first test scene as a recording for Rerun, of a run with all its iterations."""
    from warpav.view import load_rerun, write_recording

    if shown != "rig" or requirements is not None:
        option, value = ("requirements", requirements) if requirements is not None else ("show", shown)
        raise ArgumentError(option, f"expected a recording alone, got {value!r} as well; leave it out", place=out)
    load_rerun(out)
    device = checked_device(config.device)
    if not is_run_folder(source):
        scene = first_scene(config)
        return write_recording(out, find_rig(source, config, scene.ego), scene, device=device)
    run = RunFolder.open(source).drawn(config)
    loss = [math.nan if event.get("loss") is None else float(event["loss"]) for event in run.events]
    return write_recording(out, run.rig, run.scene, frames=run.frames, loss=loss, device=device)


def rig_with_vehicle(source: str, config: Config) -> tuple[Rig, Mesh]:
    """The rig that ``source`` means on the vehicle of a configuration, and this vehicle; both in the ego frame."""
    ego = first_scene(config).ego
    return find_rig(source, config, ego), ego


def write_mount_drawing(source: str, config: Config, out: Path) -> list[Path]:
    """Write the drawing by which a workshop mounts a rig; see `warpav.view.drawing._mount_drawing`."""
    from warpav.rig import BUILTIN, read_modules
    from warpav.view import check_out, mount_drawing

    check_out(out)
    rig, ego = rig_with_vehicle(source, config)
    modules = read_modules(config.rig.catalogue or BUILTIN)
    named = {"title": Path(source).name, "vehicle": vehicle_name(config)}
    return mount_drawing(rig, ego=ego, modules=modules, **named).save(out)


def inspector(
    source: str,
    config: Config,
    *,
    begin_with: BEGINNINGS = "coverage",
    requirements: str | None = None,
    scenes: Sequence[Scene] | None = None,
    off_screen: bool | None = None,
    panel: Callable[[str], None] | None = None,
) -> Inspector:
    """The interactive view of a rig on the test scenes, with the iterations of a run; not yet shown.

    Args:
        requirements: YAML file, or a template's name; None: there are none.
    """
    from warpav.view import Canvas, InspectedRig, Inspector, Steepest

    check = None if requirements is None else _check(requirements, config)
    further = _further(source, begin_with) if begin_with in ("further", "gain") else None
    seeds, device = config.scenes.test_seeds, checked_device(config.device)
    first = first_scene(config) if scenes is None else scenes[0]

    def scene_of(index: int) -> Scene:
        if scenes is not None:
            return scenes[index]
        return first if index == 0 else next(load_scenes(config, seeds[index : index + 1]))

    rig = find_rig(source, config, first.ego)
    frames, descents, trajectory_m, save_to = [rig], [None], None, Path("rig.yaml")
    if is_run_folder(source):
        folder = RunFolder.open(source)
        run = folder.drawn(config, scene=first)
        frames = [*run.frames, rig]
        trajectory_m = trajectory(run.events)
        descents = [*map(Steepest.of_event, run.events), None]
        if run.events:  # as in images, the result has the arrows of the iteration nearest to it
            descents[-1] = descents[run.nearest_iteration()]
        further = run.further
        save_to = folder.path / "rig_inspected.yaml"
    mount = camera_mount(config, first.ego)
    detector_of = cache(lambda: load_detector(config))

    def observer_of(rig: Rig) -> RigObserver:
        from warpav.optimisation import RigObserver

        return RigObserver(rig, detector_of(), objective_options(config), device=device)

    state = InspectedRig(
        frames,
        scene_of,
        len(seeds) if scenes is None else len(scenes),
        constraints=constraints_of(config, mount.surface),
        height_offset_m=mount.height_offset_m,
        observer_of=observer_of,
        descents=descents,
        further=further,
        modules=_modules(config),
        check=check,
        judge=judge_of(source, config, first.ego),
        device=device,
    )
    return Inspector(
        state,
        save_to=save_to,
        trajectory_m=trajectory_m,
        begin_with=begin_with,
        canvas=Canvas(off_screen=off_screen),
        panel=panel,
    )


def serve_inspector(
    source: str,
    config: Config,
    *,
    scene: Path | None = None,
    port: int | None = None,
    ready: Callable[[str, int], None] | None = None,
) -> None:
    """Serve the inspector to browsers of this machine until it is interrupted.

    Args:
        port: Where to listen, 0 for any that is free; None: `warpav.view.DEFAULT_PORT`.
    """
    from warpav.view import DEFAULT_PORT, BrowserInspector, new_token

    scenes = None if scene is None else [read_scene(scene)]
    shown = BrowserInspector(
        lambda panel: inspector(source, config, scenes=scenes, off_screen=True, panel=panel),
        token=new_token(),
        name=Path(source).stem,
        scorer_of=partial(RigScorer, config),
        search=partial(search_from, config=config, scenes=scenes),
    )
    shown.serve(port=DEFAULT_PORT if port is None else port, ready=ready)


def write_inspector_page(
    source: str, config: Config, out: Path, *, scene: Path | None = None, scene_count: int = _PAGE_SCENES
) -> Path:
    """Write a page that stands alone: a rig in some scenes, what its cameras see of the ground, switches for all."""
    from warpav.scene import DeviceScene
    from warpav.sight import HEIGHTS_M, PATCH_M, Ground
    from warpav.view import (
        WIDE_ZOOM,
        Canvas,
        Picture,
        add_coverage,
        add_range_rings,
        patch_words,
        rig_plotter,
        save_page,
    )

    check_suffix(checked_figure(out, (".html",)))
    seeds = config.scenes.test_seeds[:scene_count]
    shown = list(load_scenes(config, seeds)) if scene is None else [read_scene(scene)]
    rig = find_rig(source, config, shown[0].ego)
    is_run = is_run_folder(source)
    trajectory_m = trajectory(RunFolder.open(source).events()) if is_run else None
    plotters = {}
    for each in shown:
        picture = Picture(rig=rig, scene=each, trajectory_m=trajectory_m)
        plotter = rig_plotter(picture, Canvas(zoom=WIDE_ZOOM, off_screen=True), sectors=False)
        add_range_rings(plotter, each)
        ground = Ground.around(DeviceScene.pack(each, device=checked_device(config.device)))
        for height_m in (*HEIGHTS_M, PATCH_M):
            coverage = ground.coverage(rig.cameras, heights_m=(height_m,))
            add_coverage(plotter, coverage, name=f"coverage/{patch_words(height_m)}", legend=False)
        plotters[each.name] = plotter
    try:
        return save_page(plotters, out, title=Path(source).name, lines=[f"{len(rig.cameras)} cameras"])
    finally:
        for plotter in plotters.values():
            plotter.close()


def _modules(config: Config) -> tuple[Module, ...]:
    from warpav.rig import BUILTIN, read_modules

    return rig_modules(config) or tuple(read_modules(config.rig.catalogue or BUILTIN).values())


def _check(requirements: str, config: Config) -> Callable[[Rig, Mesh], RequirementResult]:
    """Holds rigs against requirements, which are read now."""
    from warpav.sight import check_requirements, read_requirements

    wanted, device = read_requirements(requirements), checked_device(config.device)
    return lambda rig, ego: check_requirements(
        rig, ego, wanted, supersampling=config.camera.supersampling, device=device
    )


def _further(source: str, shown: str) -> FurtherCameras:
    found = RunFolder.open(source).further_cameras() if is_run_folder(source) else None
    if found is None:
        raise ArgumentError(
            "show",
            f"expected the folder of a run with optimiser.search=pool that has drawn its pool for {shown!r}, got "
            f"{source!r}",
        )
    return found


# ---------------------------------------------------------------------------------------------------- plots

_KINDS_OF = {"run": RunFolder, "rig": Rig, "comparison": dict}


def asked_plots(source: str, *, kind: str, out: Path | None = None, beside: Sequence[str] = ()) -> dict[str, Path]:
    """The files that ``warpav plot`` was asked for by kind, found possible before anything is loaded.

    Args:
        out: File; of ``all`` the folder for the files. None: the kind's name in this folder, or this folder.
    """
    arm_names(source, beside)
    is_run = is_run_folder(source)
    kinds = kinds_of(dict if beside else RunFolder if is_run else Rig)
    figures = [name for name, each in kinds.items() if each.is_figure]
    if kind == "all":
        folder = Path() if out is None else out
        if folder.suffix:
            raise ArgumentError("out", "expected a folder for kind all, got a file", place=folder)
        check_folder(folder, "out")
        return {name: folder / f"{name}.png" for name in figures}
    if kind not in kinds:
        what = "comparison" if beside else "run" if is_run else "rig"
        of_others = [name for name, each in _KINDS_OF.items() if kind in kinds_of(each)]
        near = difflib.get_close_matches(kind, kinds, 1, 0.5)
        hint = f"; {kind} is a plot of a {of_others[0]}" if of_others else f"; did you mean {near[0]}?" if near else ""
        raise ArgumentError("kind", f"expected all, or a plot of a {what} ({', '.join(kinds)}), got {kind!r}{hint}")
    file = Path(f"{kind}.png") if out is None else out
    if kind in figures:
        checked_figure(file)
    else:
        check_suffix(file)
    return {kind: file}


def draw_plots(
    source: str, files: Mapping[str, Path], config: Config, *, beside: Sequence[str] = (), progress: Progress | None
) -> tuple[list[Path], dict[str, str]]:
    """Draw plots into files by kind; of several, why some cannot be drawn is returned beside those that are."""
    from warpav.runs.report._content import read_evaluation

    scene = first_scene(config)
    is_run = is_run_folder(source) and not beside
    title = None if beside else Path(source).name if is_run else Path(source).stem
    written, left_out = [], {}
    rigs = {name: find_rig(each, config, scene.ego) for name, each in arm_names(source, beside).items()}
    for kind, file in files.items():
        try:
            of_run: tuple[Any, dict[str, Any]] | None = (RunFolder.open(source), {"scene": scene}) if is_run else None
            if of_run and kind == "ground" and (evaluation := read_evaluation(RunFolder.open(source))):
                of_run[1]["misses_per_100"] = evaluation.misses
            shown, options = of_run or fitting(kind, rigs, scene, config)
            written.append(plot(shown, kind=kind, out=file, title=title, progress=progress, **options))
        except InputError as error:
            if len(files) == 1:
                raise
            left_out[kind] = str(error)
    return written, left_out


# ------------------------------------------------------------------------------------------------- rendering

_BACKGROUND, _EGO = 0, 65535
"""Values of object images; vehicles are their instance ids."""


def render_rig(source: str, rig_source: str, config: Config, out: Path, overrides: Sequence[str] = ()) -> Path:
    """Render a scene through every camera of a rig into files.

    Writes per camera ``<camera>_rgb.png``, ``<camera>_object.png`` (16 bit: 0 background and environment, 65535 ego,
    else the instance id) and ``<camera>_depth_m.npy`` (float32, inf where nothing; the distance for a fisheye or a
    panorama, else along the optical axis), and ``views.json``. The files appear once all images are rendered.
    """
    from warpav.detection import render_images

    check_folder(out, "out")
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
        raise ArgumentError("out", f"expected a folder to write to, got: {error.strerror}", place=out) from None
    return out


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

    from warpav.scene import EGO, FIRST_VEHICLE

    value_of_object = np.full(FIRST_VEHICLE + len(scene.vehicles) + 1, _BACKGROUND, np.uint16)  # last: nothing
    value_of_object[EGO] = _EGO
    value_of_object[FIRST_VEHICLE:-1] = [vehicle.instance_id for vehicle in scene.vehicles]
    files = {
        f"{camera.name}_rgb.png": np.ascontiguousarray(image.rgb[:, :, ::-1]),
        f"{camera.name}_object.png": value_of_object[image.object_index],
    }
    for name, pixels in files.items():
        (folder / name).write_bytes(cv2.imencode(".png", pixels)[1].tobytes())  # imwrite crashes at paths not in UTF-8
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
