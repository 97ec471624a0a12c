"""What cameras see, written to disk: rendered images of a rig, and the figures of a run."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.devices import checked_device
from warpav.core.errors import ArgumentError, InputError
from warpav.core.files import check_folder
from warpav.raster.lens import Lens
from warpav.rig.rig import Rig, RigCamera
from warpav.runs.config import Config
from warpav.runs.events import trajectory
from warpav.runs.rig_source import find_rig
from warpav.runs.run_folder import RunFolder
from warpav.runs.scene_set import load_scene

if TYPE_CHECKING:
    from warpav.detection.images import CameraImage
    from warpav.detection.probability import DetectionProbability
    from warpav.optimisation.assignment import AssignedScene
    from warpav.optimisation.further_camera import FurtherCameras
    from warpav.optimisation.objective import RigObjective
    from warpav.raster.camera import CameraModel
    from warpav.rig.mount_surface import MountSurface
    from warpav.scene.scene import Scene
    from warpav.view.figures.detections import DetectionPanel

VIEW_PX = 960
"""Longer side of the images that are kept of what cameras see."""

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
    from warpav.detection.images import render_images

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


@dataclass(frozen=True)
class RigDrawing:
    """What the figures of a run's rigs are drawn from; it travels to another process.

    Attributes:
        folder: The run folder; its events are drawn too.
        start: The rig that the run started from.
        result: The rig that it found.
        scene: A test scene.
        surface: Where cameras may stand.
        min_spacing_m: Least distance of two cameras [m].
        shows_zone: Whether the zone for cameras is drawn.
        further: What further cameras would add to the result; None after a descent.
        objects: What is counted.
        probability: The model of detection probability of every camera; none: nobody knows the detection range.
    """

    folder: Path
    start: Rig
    result: Rig
    scene: Scene
    surface: MountSurface
    min_spacing_m: float
    shows_zone: bool
    further: FurtherCameras | None = None
    objects: str = "vehicles"
    probability: tuple[tuple[CameraModel, DetectionProbability], ...] = ()

    def probability_for(self, model: CameraModel) -> DetectionProbability:
        """That of the same camera, else of one whose images have the same size, as of zooms of one lens."""
        same = [each for camera, each in self.probability if camera == model]
        size = model.width_px, model.height_px
        alike = [each for camera, each in self.probability if (camera.width_px, camera.height_px) == size]
        return [*same, *alike][0]


def draw_rigs(drawing: RigDrawing) -> str | None:
    """Draw the figures of a run for which nothing has to be rendered as the cameras see it.

    Returns:
        Why this machine cannot draw the rig in three dimensions; None where it can.
    """
    from warpav.view import plot
    from warpav.view.figures.convergence import loss_figure, search_figure
    from warpav.view.figures.style import save_figure
    from warpav.view.figures.top_view import further_figure, top_view_figure
    from warpav.view.opengl import opengl_problem

    folder, scene, result = RunFolder.open(drawing.folder), drawing.scene, drawing.result
    events = folder.events()
    path_m = trajectory(events)
    search = search_figure(events)
    figures = {
        "search": search,
        "loss_curves": loss_figure(events, min_distance_m=drawing.min_spacing_m) if search is None else None,
        "further_cameras": None
        if drawing.further is None
        else further_figure(
            further=drawing.further,
            rig=result,
            ego=scene.ego,
            mount_surface=drawing.surface.over_ground,
            objects=drawing.objects,
        ),
        "rig_top_view": top_view_figure(
            rig=result,
            ego=scene.ego,
            mount_surface=drawing.surface.over_ground,
            rig_initial=drawing.start,
            trajectory_m=path_m,
            shows_zone=drawing.shows_zone,
        ),
    }
    for name, figure in figures.items():
        if figure is not None:
            save_figure(figure, folder.figure_path(name))
    rigs = {"start": drawing.start, "optimised": result}
    for kind in ("plan", "near_field", "redundancy"):
        plot(rigs, kind=kind, ego=scene.ego, out=folder.figure_path(kind))
    if drawing.probability:
        plot(rigs, kind="range", ego=scene.ego, probability=drawing.probability_for, out=folder.figure_path("range"))
    problem = opengl_problem()
    if problem is None:
        plot(result, scene=scene, trajectory_m=path_m, out=folder.figure_path("rig"))
    return problem


def draw_views(
    folder: RunFolder, rigs: Mapping[str, Rig], *, objective: RigObjective, assigned: Sequence[AssignedScene]
) -> None:
    """Draw what the cameras see into a run folder, and keep it for the report.

    Args:
        folder: The run folder.
        rigs: The start and the result, in this order, by their headings.
        objective: Observes the scenes through the rigs.
        assigned: The scene that is drawn, and others of which views are kept.
    """
    from warpav.view.figures.detections import detections_sheet

    seen = [{heading: _panels(rig, objective, each) for heading, rig in rigs.items()} for each in assigned]
    detections_sheet(seen[0], folder.figure_path("detections"))
    _keep_views(folder, [(each.scene.name, panels) for each, panels in zip(assigned, seen, strict=True)])


def _keep_views(folder: RunFolder, panels: Sequence[tuple[str, Mapping[str, Sequence[DetectionPanel]]]]) -> None:
    """Write what cameras see into a run folder, by scene and by rig, as images and boxes.

    Args:
        folder: The run folder.
        panels: Name of every scene, which others may have as well, and what the cameras see there by rig.
    """
    import io

    from PIL import Image

    views, image_of = [], {}
    for number, (scene, rigs) in enumerate(panels):
        for rig, cameras in rigs.items():
            for panel in cameras:
                name = f"{number}_{rig}_{panel.title}.webp"
                encoded, image = io.BytesIO(), Image.fromarray(panel.image_rgb)
                image.thumbnail((VIEW_PX, VIEW_PX))
                image.save(encoded, "WEBP", quality=88)
                image_of[name] = encoded.getvalue()
                height_px, width_px = panel.image_rgb.shape[:2]
                views.append(
                    {
                        "scene": scene,
                        "scene_number": number,
                        "rig": rig,
                        "camera": panel.title,
                        "image": name,
                        "size_px": [width_px, height_px],
                        "truth_box_px": [
                            box.tolist() if np.isfinite(box).all() else None for box in panel.truth_box_px
                        ],
                        "detection_box_px": panel.detection_box_px,
                        "detection_of_truth": panel.detection_of_truth,
                    }
                )
    folder.write_views(views, image_of)


def _panels(rig: Rig, objective: RigObjective, assigned: AssignedScene) -> list[DetectionPanel]:
    from warpav.evaluation.metrics import observe_scenes
    from warpav.view.figures.detections import DetectionPanel

    [seen] = observe_scenes(rig, [assigned], objective, with_objective=False).observations
    return [
        DetectionPanel(
            title=camera.name,
            image_rgb=of_camera.image_rgb,
            truth_box_px=of_camera.truth_box_px,
            detection_box_px=of_camera.detections.box_px,
            detection_of_truth=of_camera.match,
        )
        for camera, of_camera in zip(rig.cameras, seen.cameras, strict=True)
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

    from warpav.scene.device_scene import EGO, FIRST_VEHICLE

    value_of_object = np.full(FIRST_VEHICLE + len(scene.vehicles) + 1, OBJECT_BACKGROUND, np.uint16)  # last: nothing
    value_of_object[EGO] = OBJECT_EGO
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
