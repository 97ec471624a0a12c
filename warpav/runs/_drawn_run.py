"""What plots of a run show: its rigs on their vehicle, its iterations, what one more camera would bring."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from warpav.core.errors import ArgumentError, InputError
from warpav.rig import Rig
from warpav.runs._events import of_modules, trajectory
from warpav.runs.config import BY_HAND, Config
from warpav.view import ANIMATION_PX, Canvas, drawing_of, draws

if TYPE_CHECKING:
    from warpav.optimisation import FurtherCameras
    from warpav.rig import MountSurface
    from warpav.scene import Scene

COMPARED_KINDS = ("plan", "ground", "range", "near_field", "redundancy", "resolution")
"""Kinds that take several rigs."""

FITTING_KINDS = (*COMPARED_KINDS, "contact", "sheet")
"""Kinds of rigs that runs have as well: start and result side by side, of the last two the result."""


def heading_of(name: str) -> str:
    """A rig's name where it is read: above a column, on a figure."""
    return {"optimised": "found", "by_hand": "by hand"}.get(name, name)


def vehicle_name(config: Config) -> str:
    """What a drawing calls the vehicle of a configuration."""
    known = f"of scene_{config.scenes.test_seeds[0]}.glb" if config.scenes.source == "folder" else "embedded car"
    return known if config.scenes.ego is None else config.scenes.ego.name


def fitting(kind: str, rigs: Mapping[str, Rig], scene: Scene, config: Config) -> tuple[Any, dict[str, Any]]:
    """What `plot` draws of rigs on one vehicle for a kind out of `FITTING_KINDS`, and its options."""
    from warpav.runs._detector_fit import ensure_fit

    options: dict[str, Any] = {"scene": scene}
    if kind == "range":
        if config.losses.probability != "fitted":
            raise ArgumentError(
                "kind",
                f"expected losses.probability=fitted for 'range', got {config.losses.probability}; the detection "
                "range is unknown without a fitted model",
            )
        options["probability"] = lambda model: ensure_fit(config, camera=model)
    if kind == "sheet":
        options["vehicle"] = vehicle_name(config)
    is_comparison = kind in COMPARED_KINDS and len(rigs) > 1
    return {heading_of(name): rig for name, rig in rigs.items()} if is_comparison else list(rigs.values())[-1], options


@dataclasses.dataclass(frozen=True, eq=False)
class DrawnRun:
    """A run as its plots show it; the scene is loaded and the surface made for those that need them."""

    name: str
    config: Config
    start_name: str  # where rigs are compared
    start: Rig
    rig: Rig
    all_events: Sequence[Mapping[str, Any]]
    scene_of: Callable[[], Scene]
    surface_of: Callable[[Scene], MountSurface]
    further_of: Callable[[], FurtherCameras | None]

    def drawn(self, *, scene: Scene | None = None) -> DrawnRun:
        """Itself, with another scene where there is one."""
        return self if scene is None else dataclasses.replace(self, scene_of=lambda: scene)

    @cached_property
    def further(self) -> FurtherCameras | None:
        """What one more camera of the pool would add; None where no pool was drawn."""
        return self.further_of()

    @cached_property
    def scene(self) -> Scene:
        return self.scene_of()

    @cached_property
    def surface(self) -> MountSurface:
        return self.surface_of(self.scene)

    @cached_property
    def events(self) -> Sequence[Mapping[str, Any]]:
        """The iterations whose rigs have the cameras of the result."""
        return of_modules(self.all_events, [camera.module for camera in self.rig.cameras])

    @cached_property
    def frames(self) -> list[Rig]:
        """The rig of every iteration."""
        counts = {len(event["positions_m"]) for event in self.events}
        if counts - {len(self.rig.cameras)}:
            raise InputError(
                f"{self.name}: run folder: expected events.jsonl and the rig files of one run, got {min(counts)} "
                f"cameras in the one and {len(self.rig.cameras)} in the other; take the rig file instead of the folder"
            )
        return [self._rig_of(event) for event in self.events]

    def _rig_of(self, event: Mapping[str, Any]) -> Rig:
        free, cameras = event.get("free", {}), []
        for k, camera in enumerate(self.rig.cameras):
            pitch_deg, fov_deg = (free[name][k] if name in free else None for name in ("pitch_deg", "fov_deg"))
            model = camera.model
            if fov_deg is not None:
                try:
                    model = dataclasses.replace(model, fov_rad=math.radians(fov_deg), focal_px=None, centre_px=None)
                except ValueError as error:
                    raise InputError(
                        f"{self.name}: run folder: expected fields of view of {camera.name}, got: {error}"
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
        return Rig(cameras)

    @property
    def rigs(self) -> dict[str, Rig]:
        """Start and result by what they are called on figures."""
        return {heading_of(self.start_name): self.start, heading_of("optimised"): self.rig}

    def nearest_iteration(self) -> int:
        """The iteration before whose step the cameras stood nearest to those of the result; from 0."""
        end_m = np.array([camera.position_m for camera in self.rig.cameras])
        positions_m = np.array([event["positions_m"] for event in self.events], np.float64)
        return int(np.linalg.norm(positions_m - end_m, axis=2).max(axis=1).argmin())

    def checked_further(self, kind: str) -> FurtherCameras:
        """`further`, for a kind of plot that needs them."""
        if self.further is None or not len(self.further):
            raise ArgumentError(
                "kind",
                f"expected the folder of a run with optimiser.search=pool that has drawn its pool for {kind!r}, got "
                f"{self.name!r}",
            )
        return self.further

    def view(self, canvas: Canvas, *, iteration: int | None, arrows: bool, visibility: bool) -> Any:  # noqa: ANN401
        """The result in space, or the rig before the step of an iteration, with its trajectory and arrows."""
        from warpav.view import Steepest, add_descent, run_animation

        frames = self.frames
        if canvas.is_animation and iteration is None:  # the cameras move, and their trajectories grow
            if not self.events:
                raise InputError(f"{self.name}: expected iterations to animate, got none; write a .png instead")
            moving = {"scene": self.scene, "surface": self.surface if arrows else None}
            return run_animation(frames, self.events, end=self.rig, **moving, window_size=canvas.size_px(ANIMATION_PX))
        rig, path_m, index = self.rig, trajectory(self.events), None
        if iteration is not None:
            count = len(self.events)
            if not -count <= iteration < count:
                raise InputError(f"{self.name}: iteration: expected one of {count} from 0, got {iteration}")
            index = iteration % count
            rig, own = frames[index], self.events[index].get("descent")
            before = [event["positions_m"] for event in self.events[: index + 1] if event.get("descent") == own]
            path_m = np.array(before, np.float64)
        plotter = drawing_of(rig, canvas, kind="view", scene=self.scene, trajectory_m=path_m, visibility=visibility)
        if arrows and self.events:
            index = self.nearest_iteration() if index is None else index
            steepest = Steepest.of_event(self.events[index])
            if steepest is not None:
                add_descent(plotter, frames[index], steepest, self.surface)
        return plotter


class _Run(Protocol):
    def drawn(self, *, scene: Scene | None = None) -> DrawnRun: ...


def _view(
    run: _Run,
    canvas: Canvas,
    *,
    iteration: int | None = None,
    scene: Scene | None = None,
    arrows: bool = True,
    visibility: bool = False,
) -> Any:  # noqa: ANN401 (see warpav.view._plotting.Kind)
    return run.drawn(scene=scene).view(canvas, iteration=iteration, arrows=arrows, visibility=visibility)


def _fitting(kind: str, run: _Run, canvas: Canvas, *, scene: Scene | None = None, **parts: Any) -> Any:  # noqa: ANN401
    drawn = run.drawn(scene=scene)
    shown, options = fitting(kind, drawn.rigs, drawn.scene, drawn.config)
    by_name = {part: {heading_of(name): each for name, each in (found or {}).items()} for part, found in parts.items()}
    return drawing_of(shown, canvas, kind=kind, **options, **by_name)


def _top_view(run: _Run, canvas: Canvas, *, scene: Scene | None = None) -> Any:  # noqa: ANN401
    """How the cameras moved, and where they ended, from above; a start that is another rig, by hand, is left out."""
    from warpav.view import top_view_figure

    drawn = run.drawn(scene=scene)
    return top_view_figure(
        rig=drawn.rig,
        ego=drawn.scene.ego,
        mount_surface=drawn.surface.over_ground,
        rig_initial=None if drawn.start_name == BY_HAND else drawn.start,
        trajectory_m=trajectory(drawn.events),
        shows_zone=drawn.config.method != "thesis",
        heading=canvas.title,
    )


def _search(run: _Run, _canvas: Canvas, *, scene: Scene | None = None) -> Any:  # noqa: ANN401
    """Best rig and bound of a search by a pool over its renders; of a descent its losses over its iterations."""
    from warpav.view import loss_figure, search_figure

    drawn = run.drawn(scene=scene)
    found = search_figure(drawn.all_events)
    return loss_figure(drawn.all_events, min_distance_m=drawn.config.rig.min_spacing_m) if found is None else found


def _further(run: _Run, _canvas: Canvas, *, scene: Scene | None = None) -> Any:  # noqa: ANN401
    from warpav.view import further_figure

    drawn = run.drawn(scene=scene)
    return further_figure(
        further=drawn.checked_further("further"),
        rig=drawn.rig,
        ego=drawn.scene.ego,
        mount_surface=drawn.surface.over_ground,
        objects="vehicles" if drawn.config.scenes.targets == ("vehicle",) else "road users",
    )


def _gain(run: _Run, canvas: Canvas, *, scene: Scene | None = None) -> Any:  # noqa: ANN401
    drawn = run.drawn(scene=scene)
    further = drawn.checked_further("gain")
    return drawing_of(drawn.rig, canvas, kind="view", scene=drawn.scene, mount_surface=drawn.surface, further=further)


def draws_runs(cls: type) -> None:
    """Register the kinds of plots of runs for a class with a method ``drawn``."""
    draws(cls, "view")(_view)
    for kind in FITTING_KINDS:
        takes = ("scene", "misses_per_100") if kind == "ground" else ("scene",)
        draws(cls, kind, is_figure=True, options=takes)(partial(_fitting, kind))
    for kind, draw in (("top_view", _top_view), ("search", _search), ("further", _further)):
        draws(cls, kind, is_figure=True)(draw)
    draws(cls, "gain")(_gain)


draws_runs(DrawnRun)
