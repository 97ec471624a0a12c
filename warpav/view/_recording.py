"""A run as an animation, and as a recording for Rerun."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.detection import render
from warpav.raster.lens import Lens
from warpav.view._layers import Steepest, add_descent, add_legend, add_text, no_render
from warpav.view._opengl import optional_module
from warpav.view._outlines import view_edges
from warpav.view._output import (
    ANIMATION_FRAME_S,
    ANIMATION_LAST_S,
    ANIMATION_PX,
    Animation,
    Canvas,
    render_rgb,
    write_bytes,
)
from warpav.view._palette import TRUTH_RGB, camera_rgb
from warpav.view._picture import Picture, add_rig, add_trajectory, rig_plotter
from warpav.view.figures._images import own_body_tinted

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from warpav.raster.mesh import Mesh
    from warpav.rig import MountSurface, Rig, RigCamera
    from warpav.scene import Scene

_FRUSTUM_DEPTH_M = 1.0
"""How far frustums reach [m]."""

_TIMELINE = "iteration"


def write_recording(
    path: Path | str,
    rig: Rig,
    scene: Scene,
    *,
    frames: Sequence[Rig] = (),
    loss: Sequence[float] = (),
    device: str = "cpu",
) -> Path:
    """Write a rig in a scene as a recording for the Rerun viewer; nothing is sent anywhere.

    Entities, all in the ego frame [m]: ``vehicle`` and ``scene/...`` are meshes, ``box/...`` the boxes of road users;
    ``rig/<camera>`` is a pose, below it ``image``, a pinhole with what the camera sees. Of another lens, which the
    viewer has not, ``frustum`` has the edges of its view, and ``image/<camera>`` what it sees. With frames the poses
    are on the timeline `_TIMELINE`, and the images belong to the rig at its end.
    """
    path = Path(path)
    rerun = load_rerun(path)
    images = render(rig, scene, supersampling=2, device=device)
    recording = rerun.RecordingStream("warpav", send_properties=False)
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    memory = recording.memory_recording()  # a file of Rerun's own may end short, or never
    recording.log("/", rerun.ViewCoordinates.FLU, static=True)
    _log_scene(rerun, recording, scene)
    for number, frame in enumerate((*frames, rig)):
        if frames:
            recording.set_time(_TIMELINE, sequence=number)
        for index, camera in enumerate(frame.cameras):
            _log_camera(rerun, recording, camera, index, static=not frames)
        if number < len(loss) and math.isfinite(loss[number]):
            recording.log("loss", rerun.Scalars(float(loss[number])))
    for camera in rig.cameras:
        place = f"rig/{camera.name}/image" if camera.model.lens is Lens.PINHOLE else f"image/{camera.name}"
        shown = own_body_tinted(images[camera.name].rgb, images[camera.name].object_index)
        recording.log(place, rerun.Image(shown).compress(jpeg_quality=90), static=not frames)
    return write_bytes(path, memory.drain_as_bytes())


def load_rerun(path: Path) -> Any:  # noqa: ANN401 (a module)
    """The module rerun, to write this file."""
    return optional_module("rerun", purpose=f"{path}: a recording for Rerun", extra="rerun")


def _log_scene(rerun: Any, recording: Any, scene: Scene) -> None:  # noqa: ANN401 (rerun)
    recording.log("vehicle", _mesh(rerun, scene.ego), static=True)
    recording.log("scene/environment", _mesh(rerun, scene.environment), static=True)
    for user in scene.road_users:
        name = f"{user.category}_{user.instance_id}"
        recording.log(f"scene/{name}", _mesh(rerun, user.mesh), static=True)
        half = 0.5 * user.box.yaw_rad
        box = rerun.Boxes3D(
            centers=[user.box.center_m],
            half_sizes=[0.5 * np.asarray(user.box.size_m)],
            quaternions=[rerun.Quaternion(xyzw=[0.0, 0.0, math.sin(half), math.cos(half)])],
            labels=[name],
            colors=[TRUTH_RGB],
            show_labels=False,
        )
        recording.log(f"box/{name}", box, static=True)


def _mesh(rerun: Any, mesh: Mesh) -> Any:  # noqa: ANN401 (rerun)
    return rerun.Mesh3D(vertex_positions=mesh.vertex_m, triangle_indices=mesh.triangle, vertex_colors=mesh.vertex_rgb)


def _log_camera(rerun: Any, recording: Any, camera: RigCamera, index: int, *, static: bool) -> None:  # noqa: ANN401 (rerun)
    transform, model, colour = camera.ego_from_camera, camera.model, camera_rgb(index)
    pose = rerun.Transform3D(translation=transform[:3, 3], mat3x3=transform[:3, :3])
    recording.log(f"rig/{camera.name}", pose, static=static)
    if model.lens is Lens.PINHOLE:
        pinhole = rerun.Pinhole(
            image_from_camera=model.intrinsics,
            resolution=[model.width_px, model.height_px],
            camera_xyz=rerun.ViewCoordinates.RDF,
            image_plane_distance=_FRUSTUM_DEPTH_M,
            color=colour,
        )
        recording.log(f"rig/{camera.name}/image", pinhole, static=static)
        return
    edges = view_edges(model, depth_m=_FRUSTUM_DEPTH_M)
    recording.log(f"rig/{camera.name}/frustum", rerun.LineStrips3D(edges, colors=[colour]), static=static)


_MAX_FRAMES = 60
"""Of a longer run every n-th iteration is shown, and always the last one."""


def run_animation(
    frames: Sequence[Rig],
    events: Sequence[Mapping[str, Any]],
    *,
    end: Rig,
    scene: Scene,
    surface: MountSurface | None = None,
    window_size: tuple[int, int] = ANIMATION_PX,
) -> Animation:
    """The iterations of a run, with arrows of the descent on a surface, and at the end its result."""
    canvas = Canvas(window_size=window_size, zoom=1.6, off_screen=True)

    def images() -> Iterator[np.ndarray]:
        plotter = rig_plotter(Picture(rig=frames[0], scene=scene), canvas, labels=False, sectors=False)
        plotter.disable_anti_aliasing()  # supersampling does that
        # in one place, as moving names would be most of a GIF
        add_legend(plotter, {camera.name: camera_rgb(k) for k, camera in enumerate(end.cameras)}, name="cameras")
        width = max(len(str(event["iteration"])) for event in events)

        def draw(rig: Rig, steepest: Steepest | None, line: str, shown: Sequence[Mapping[str, Any]]) -> None:
            add_rig(plotter, rig, sectors=False)
            if surface is not None:
                add_descent(plotter, rig, steepest, surface)
            best, loss = shown[-1].get("best_training_objective"), shown[-1]["loss"]
            reached = "" if loss is None else f"loss {loss:.4f}"  # of the last batch
            reached = reached if best is None else f"best objective so far {best:.4f}"
            text = "\n".join(filter(None, (line, reached)))
            add_text(plotter, text, (0.02, 0.88), size=9, name="iteration", font="courier")

        try:
            for k in _shown_iterations(len(frames)):
                # trajectories of an earlier descent go when another one begins
                own = [j for j in range(k + 1) if events[j].get("descent") == events[k].get("descent")]
                with no_render(plotter):
                    add_trajectory(plotter, [[camera.position_m for camera in frames[j].cameras] for j in own])
                    line = f"iteration {events[k]['iteration']:{width}d}"
                    draw(frames[k], Steepest.of_event(events[k]), line, events[: k + 1])
                yield render_rgb(plotter)
            with no_render(plotter):
                draw(end, None, "result", events)
            yield render_rgb(plotter)
        finally:
            plotter.close()

    count = len(_shown_iterations(len(frames))) + 1
    return Animation(images(), count, frame_s=ANIMATION_FRAME_S, last_s=ANIMATION_LAST_S)


def _shown_iterations(count: int) -> list[int]:
    return sorted({round(float(k)) for k in np.linspace(0, count - 1, min(count, _MAX_FRAMES))})
