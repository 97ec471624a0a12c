"""A run as an animation: the cameras move over the vehicle, and their trajectories grow."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.descent_view import Steepest, add_descent
from warpav.view.output import ANIMATION_FRAME_S, ANIMATION_LAST_S, ANIMATION_PX, Animation, render_rgb
from warpav.view.palette import INK_RGB, camera_rgb, hex_colour
from warpav.view.rig_view import add_rig, add_trajectory, no_render, rig_plotter
from warpav.view.visibility_view import add_legend

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from warpav.rig.mount_surface import MountSurface
    from warpav.rig.rig import Rig
    from warpav.scene.scene import Scene

ZOOM = 1.6
MAX_FRAMES = 60
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


def shown_iterations(count: int, *, most: int = MAX_FRAMES) -> list[int]:
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
