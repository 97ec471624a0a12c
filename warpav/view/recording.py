"""A run as an animation, and as a recording for Rerun."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.files import atomic_write, writing
from warpav.detection.images import render
from warpav.raster.lens import Lens
from warpav.view.descent_view import Steepest, add_descent
from warpav.view.frustum import image_corners
from warpav.view.opengl import optional_module
from warpav.view.output import ANIMATION_FRAME_S, ANIMATION_LAST_S, ANIMATION_PX, Animation, render_rgb
from warpav.view.palette import INK_RGB, TRUTH_RGB, camera_rgb, hex_colour
from warpav.view.rig_view import add_rig, add_trajectory, no_render, rig_plotter
from warpav.view.visibility_view import add_legend

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig, RigCamera
    from warpav.scene.scene import Scene
if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from warpav.rig.mount_surface import MountSurface
    from warpav.rig.rig import Rig
    from warpav.scene.scene import Scene

FRUSTUM_DEPTH_M = 1.0
"""How far frustums reach [m]."""

TIMELINE = "iteration"


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
    are on the timeline `TIMELINE`, and the images belong to the rig at its end.
    """
    path = Path(path)
    rerun = load_rerun(path)
    images = render(rig, scene, supersampling=2, device=device)
    recording = rerun.RecordingStream("warpav", send_properties=False)
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    with writing(path), atomic_write(path) as draft:
        recording.save(draft)
        recording.log("/", rerun.ViewCoordinates.FLU, static=True)
        _log_scene(rerun, recording, scene)
        for number, frame in enumerate((*frames, rig)):
            if frames:
                recording.set_time(TIMELINE, sequence=number)
            for index, camera in enumerate(frame.cameras):
                _log_camera(rerun, recording, camera, index, static=not frames)
            if number < len(loss) and math.isfinite(loss[number]):
                recording.log("loss", rerun.Scalars(float(loss[number])))
        for camera in rig.cameras:
            place = f"rig/{camera.name}/image" if camera.model.lens is Lens.PINHOLE else f"image/{camera.name}"
            recording.log(place, rerun.Image(images[camera.name].rgb).compress(jpeg_quality=90), static=not frames)
        recording.flush()
        recording.disconnect()
    return path


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
    """The pose of a camera and what it sees, in its own frame."""
    transform, model, colour = camera.ego_from_camera, camera.model, camera_rgb(index)
    pose = rerun.Transform3D(translation=transform[:3, 3], mat3x3=transform[:3, :3])
    recording.log(f"rig/{camera.name}", pose, static=static)
    if model.lens is Lens.PINHOLE:
        pinhole = rerun.Pinhole(
            image_from_camera=model.intrinsics,
            resolution=[model.width_px, model.height_px],
            camera_xyz=rerun.ViewCoordinates.RDF,
            image_plane_distance=FRUSTUM_DEPTH_M,
            color=colour,
        )
        recording.log(f"rig/{camera.name}/image", pinhole, static=static)
        return
    corner_m = image_corners(model, depth_m=FRUSTUM_DEPTH_M)
    edges = [np.stack([np.zeros(3), corner]) for corner in corner_m] + [corner_m[[0, 1, 2, 3, 0]]]
    recording.log(f"rig/{camera.name}/frustum", rerun.LineStrips3D(edges, colors=[colour]), static=static)


ZOOM = 1.6
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
    supersampling: int = 2,
) -> Animation:
    """The iterations of a run, and at the end its result; drawn while the images are gone through.

    Args:
        window_size: Width and height [px].
    """
    images = _images(
        frames, events, end=end, scene=scene, surface=surface, window_size=window_size, supersampling=supersampling
    )
    count = len(shown_iterations(len(frames))) + 1
    return Animation(images, count, frame_s=ANIMATION_FRAME_S, last_s=ANIMATION_LAST_S)


def _images(
    frames: Sequence[Rig],
    events: Sequence[Mapping[str, Any]],
    *,
    end: Rig,
    scene: Scene,
    surface: MountSurface | None,
    window_size: tuple[int, int],
    supersampling: int,
) -> Iterator[np.ndarray]:
    plotter = rig_plotter(
        frames[0], scene=scene, off_screen=True, window_size=window_size, sectors=False, labels=False, zoom=ZOOM
    )
    plotter.disable_anti_aliasing()  # supersampling does that
    # in one place, as moving names would be most of a GIF
    add_legend(plotter, {camera.name: camera_rgb(k) for k, camera in enumerate(end.cameras)}, name="cameras")
    width = max(len(str(event["iteration"])) for event in events)
    try:
        for k in shown_iterations(len(frames)):
            event = events[k]
            # trajectories of an earlier descent go when another one begins
            own = [j for j in range(k + 1) if events[j].get("descent") == event.get("descent")]
            trajectory_m = np.array([[camera.position_m for camera in frames[j].cameras] for j in own])
            with no_render(plotter):
                add_rig(plotter, frames[k], sectors=False, labels=False)
                add_trajectory(plotter, trajectory_m)
                if surface is not None:
                    add_descent(plotter, frames[k], Steepest.of_event(event), surface)
                _write(plotter, [f"iteration {event['iteration']:{width}d}", _objective_text(events[: k + 1])])
            yield render_rgb(plotter, supersampling=supersampling)
        with no_render(plotter):
            add_rig(plotter, end, sectors=False, labels=False)
            if surface is not None:
                add_descent(plotter, end, None, surface)
            _write(plotter, ["result", _objective_text(events)])
        yield render_rgb(plotter, supersampling=supersampling)
    finally:
        plotter.close()


def shown_iterations(count: int, *, most: int = _MAX_FRAMES) -> list[int]:
    """Which of so many iterations are shown: the first, the last, and evenly spread ones between them."""
    return sorted({round(float(k)) for k in np.linspace(0, count - 1, min(count, most))})


def _objective_text(events: Sequence[Mapping[str, Any]]) -> str:
    """The best objective so far on the scenes that rigs are compared on, else the loss of the last batch."""
    best = events[-1].get("best_training_objective")
    if best is not None:
        return f"best objective so far {best:.4f}"
    loss = events[-1]["loss"]
    return "" if loss is None else f"loss {loss:.4f}"


def _write(plotter: Any, lines: Sequence[str]) -> None:  # noqa: ANN401 (a pyvista.Plotter)
    plotter.add_text(
        "\n".join(line for line in lines if line),
        position=(0.02, 0.88),
        viewport=True,
        font_size=9,
        font="courier",
        color=hex_colour(INK_RGB),
        name="iteration",
    )
