"""What images and animations of a run are drawn from."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import InputError
from warpav.rig.rig import Rig
from warpav.runs.events import trajectory
from warpav.view import Canvas, drawing_of, draws
from warpav.view.output import ANIMATION_PX, Animation

if TYPE_CHECKING:
    from warpav.rig.mount_surface import MountSurface
    from warpav.scene.scene import Scene


@dataclasses.dataclass(frozen=True, eq=False)
class DrawnRun:
    """What images of a run are drawn from."""

    name: str
    events: Sequence[Mapping[str, Any]]
    rig: Rig
    frames: Sequence[Rig]
    scene: Scene
    surface_of: Callable[[], MountSurface]

    @cached_property
    def surface(self) -> MountSurface:
        """What the cameras stand on."""
        return self.surface_of()

    def drawing(
        self, canvas: Canvas, *, iteration: int | None = None, arrows: bool = True, visibility: bool = False
    ) -> Any:  # noqa: ANN401 (see warpav.view.plotting.Kind)
        """What `warpav.view.plot` shows of the run, with its options."""
        if canvas.is_animation and iteration is None:
            return self.animation(arrows=arrows, window_size=canvas.size_px(ANIMATION_PX))
        rig = self.rig_at(iteration)
        plotter = drawing_of(
            rig,
            canvas,
            kind="view",
            scene=self.scene,
            trajectory_m=self.trajectory_to(iteration),
            visibility=visibility,
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
            window_size: Width and height [px].
        """
        from warpav.view.recording import run_animation

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


draws(DrawnRun, "view")(DrawnRun.drawing)


def nearest_iteration(events: Sequence[Mapping[str, Any]], rig: Rig) -> int:
    """The iteration before whose step the cameras stood nearest to those of a rig; from 0."""
    end_m = np.array([camera.position_m for camera in rig.cameras])
    positions_m = np.array([event["positions_m"] for event in events], np.float64)
    return int(np.linalg.norm(positions_m - end_m, axis=2).max(axis=1).argmin())


def rigs_of_events(events: Sequence[Mapping[str, Any]], rig: Rig, *, place: Path | str = "run") -> list[Rig]:
    """The rigs of a run's iterations."""
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
        rigs.append(Rig(cameras))
    return rigs
