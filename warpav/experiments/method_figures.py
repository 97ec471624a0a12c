"""The thesis's figures of rigs: without constraints (10), before and after optimisation (11), the highest rig (12).

Each takes a run folder, or runs what it needs itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import InputError
from warpav.evaluation.metrics import RigObserver
from warpav.optimisation.mount import RISE_M, X_M, Y_M
from warpav.raster.decide import Occlusion
from warpav.rig.rig import Rig
from warpav.runs.config import Config, changed_config
from warpav.runs.problem import (
    Problem,
    begin_descent,
    descent_from,
    has_ordered_start,
    load_networks,
    load_probability,
    load_problem,
    load_traffic,
    problem_on,
    read_start,
)
from warpav.runs.run_folder import RunFolder, trajectory
from warpav.runs.sources import HIGHEST, camera_mount, checked_device, find_rig, load_detector, load_scenes
from warpav.scene.device_scene import DeviceScene
from warpav.scene.scene import Scene
from warpav.view.figures import (
    WIDTH_INCH,
    DetectionPanel,
    detection_handles,
    draw_cameras,
    draw_detections,
    draw_height_map,
    draw_vehicle,
    draw_zone_border,
    figure_style,
    new_figure,
    pale_map,
    save_figure,
    start_and_end_handles,
)
from warpav.view.frustum import bearing_sector_rad, sector_polygon_m
from warpav.view.palette import INK_RGB, MISS_RGB, MUTED_RGB, TRUE_POSITIVE_RGB, camera_rgb, hex_colour
from warpav.view.scene_figures.by_number import RIG_NUMBERS
from warpav.view.scene_figures.panels import checked_png, count_text, title

if TYPE_CHECKING:
    from warpav.optimisation.gradient import Descent
    from warpav.runs.progress import RunDisplay

_UNCONSTRAINED = ("optimiser.multiplier_learning_rate=0", "optimiser.multiplier_damping=0")
_IMAGES_A_ROW = 4


def draw_method_figure(
    number: int, path: Path | str, config: Config, *, run: RunFolder | None, display: RunDisplay
) -> Path:
    """Draw a figure by its number in the thesis.

    Args:
        number: One of `RIG_NUMBERS`.
        path: PNG file to write.
        config: Scenes, cameras, detector, method; with a run its own.
        run: For figures 10 and 11: a run that has been optimised; None: it is done now, without a run folder.
        display: Where to show what is going on.

    Raises:
        InputError: Inputs that do not go with it, or that cannot be used.
    """
    path = checked_png(path)
    match number:
        case 10:
            return unconstrained(config, path, run=run, display=display)
        case 11:
            return before_and_after(config, path, run=run, display=display)
        case 12:
            if run is not None:
                raise InputError("figure 12: expected a configuration, got --run; the highest rig needs no run")
            return highest(config, path, display=display)
    raise InputError(f"figure: expected one of {', '.join(map(str, RIG_NUMBERS))}, got {number}")


# ------------------------------------------------------------------------------------------------ without constraints


@dataclass(frozen=True)
class _Way:
    """What became of a rig: where it began, its camera positions over the iterations [m], and where it ended."""

    start: Rig
    trajectory_m: np.ndarray
    end: Rig


def unconstrained(config: Config, path: Path, *, run: RunFolder | None, display: RunDisplay) -> Path:
    """Figure 10: the ways of the cameras over the vehicle from one start, with all multipliers held at 0 and without.

    Args:
        config: What to optimise.
        path: PNG file to write.
        run: Gives the way with constraints and its start; None: both are walked now.
        display: Where to show it.

    Raises:
        InputError: Something in the input is wrong.
    """
    # which iterate is kept and how often rigs are compared changes no way
    config = changed_config(config, ["optimiser.keep=last", "optimiser.patience=null", "optimiser.descents=1"])
    free = changed_config(config, _UNCONSTRAINED)
    traffic, networks = load_traffic(config, display), load_networks(config)
    probability = load_probability(config, display)
    problem = problem_on(traffic, config, networks, probability)
    if run is None:
        beginning = begin_descent(problem, read_start(config))
        start, began_as = beginning.descent.start, beginning.rig
        kept = _walk(problem, beginning.descent, display, "with constraints")
    else:
        path_m, began = trajectory(run.events()), run.rig("initial")
        if path_m is None:
            raise InputError(f"{run.path}: run folder: expected at least two iterations, got fewer")
        start = problem.objective.mount.mount_pose_of_rig(began)
        began_as = None if has_ordered_start(config) else began
        kept = _Way(began, path_m, run.rig("final"))
    loose = problem_on(traffic, free, networks, probability)
    lost = _walk(loose, descent_from(loose, start, began_as), display, "without constraints")

    constraints, surface = problem.objective.constraints, problem.objective.mount.surface
    point_m = np.concatenate([traffic.ego.bounds_m(), *(way.trajectory_m.reshape(-1, 3) for way in (lost, kept))])
    length_m, width_m = np.ptp(point_m[:, :2], axis=0)
    with figure_style():
        figure = new_figure(WIDTH_INCH, 1.9 + 2.0 * min(0.8 * WIDTH_INCH * width_m / length_m, 5.0))
        axes, image = figure.subplots(2, 1, sharex=True, sharey=True), None
        for axis, heading, way in zip(axes, ("Without constraints", "With constraints"), (lost, kept), strict=True):
            draw_vehicle(axis, traffic.ego)
            image = draw_height_map(axis, surface, colours=pale_map())
            if constraints.are_inequalities:
                draw_zone_border(axis, surface)
            else:
                _draw_bounds(axis, surface.bounds_m)
            draw_cameras(axis, way.end, rig_initial=way.start, trajectory_m=way.trajectory_m)
            excess_m = [constraints.violation_m(Rig.create([camera])) for camera in way.end.cameras]
            outside = int(np.count_nonzero(excess_m))
            remark = f"{outside} of {len(excess_m)} cameras end outside"
            title(axis, heading, f"{remark}, by up to {max(excess_m):.2f} m" if outside else remark)
            axis.set_aspect("equal")
            axis.set_ylabel("y, left [m]")
        axes[1].set_xlabel("x, forward [m]")
        bar = figure.colorbar(image, ax=axes, shrink=0.6, pad=0.02, aspect=28)
        bar.set_label("height of the mount surface [m]")
        bar.outline.set_visible(False)
        border = "border of the mountable zone" if constraints.are_inequalities else "bounds of the mount surface"
        _tell(
            figure,
            start_and_end_handles(),
            f"method: {config.method}, {len(lost.trajectory_m) - 1} iterations from one start on the same batches. "
            f"Black: {border}. Without: all multipliers stay 0.",
        )
        return save_figure(figure, path)


def _walk(problem: Problem, descent: Descent, display: RunDisplay, how: str) -> _Way:
    """Take all steps; the end is where the last of them led, moved to a feasible place where constraints count."""
    mount, constraints = problem.objective.mount, problem.objective.constraints
    count = problem.config.run.iterations
    records = [descent.step() for _ in display.steps(how, range(count), count=count)]
    pose = descent.state()["pose_value"]
    last = mount.rig(pose)
    positions = [record.positions_m for record in records] + [[camera.position_m for camera in last.cameras]]
    if problem.config.optimiser.multiplier_learning_rate != 0.0:
        pose[:, [X_M, Y_M]] = constraints.project(pose[:, [X_M, Y_M]], pose[:, RISE_M])
    return _Way(mount.rig(descent.start), np.array(positions, np.float64), mount.rig(pose))


def _draw_bounds(axis: Any, bounds_m: np.ndarray) -> None:  # noqa: ANN401 (matplotlib)
    from matplotlib.patches import Rectangle

    low, high = bounds_m
    axis.add_patch(Rectangle(low, *(high - low), fill=False, edgecolor=hex_colour(INK_RGB), linewidth=1.0, zorder=3))


# ---------------------------------------------------------------------------------------------- what a rig makes of it


@dataclass(frozen=True)
class _Look:
    """What a rig's cameras and detector make of a scene.

    Attributes:
        scene: The scene.
        is_found: Whether some camera detects a road user, bool [vehicle].
        panels: The image of every camera with its boxes.
    """

    scene: Scene
    is_found: np.ndarray
    panels: list[DetectionPanel]


class _Looker:
    """Looks at scenes through rigs, with the configuration's detector."""

    def __init__(self, config: Config, display: RunDisplay) -> None:
        self._config, self._display = config, display
        self._device, self._detector = checked_device(config.device), load_detector(config)

    def look(self, rig: Rig, scenes: Sequence[Scene], how: str) -> list[_Look]:
        config = self._config
        observer = RigObserver(
            rig,
            self._detector,
            confidence_min=config.detector.confidence_min,
            iou_min=config.detector.iou_min,
            occlusion=Occlusion(config.visibility.occlusion),
            supersampling=config.camera.supersampling,
            device=self._device,
        )
        looks = []
        for scene in self._display.steps(how, scenes, count=len(scenes)):
            look = observer.look(DeviceScene.pack(scene, device=self._device))
            panels = [
                DetectionPanel(camera.name, seen.image_rgb, seen.truth_box_px, seen.detections.box_px, seen.match)
                for camera, seen in zip(rig.cameras, look.cameras, strict=True)
            ]
            looks.append(_Look(scene, look.detected, panels))
        return looks


def before_and_after(config: Config, path: Path, *, run: RunFolder | None, display: RunDisplay) -> Path:
    """Figure 11: what a rig sees at the start and once optimised, on a batch of training scenes and on all test scenes.

    Args:
        config: What to optimise, and with which scenes and detector to look.
        path: PNG file to write.
        run: Gives both rigs; None: the optimisation is done now.
        display: Where to show it.

    Raises:
        InputError: Something in the input is wrong.
    """
    if run is None:
        problem = load_problem(config, display)
        descent, count = begin_descent(problem, read_start(config)).descent, config.run.iterations
        for _ in display.steps("optimising", range(count), count=count):
            if descent.verdict is None:
                descent.step()
        mount = problem.objective.mount
        start, result = mount.rig(descent.start), mount.rig(descent.finish().mount_pose)
    else:
        start, result = run.rig("initial"), run.rig()
    train = list(load_scenes(config, config.scenes.train_seeds[: config.run.batch_size]))
    test = list(load_scenes(config, config.scenes.test_seeds))
    looker = _Looker(config, display)
    rows = {
        "Start": (start, looker.look(start, train, "start")),
        "Optimised": (result, looker.look(result, train, "optimised")),
        "On test scenes": (result, looker.look(result, test, "test scenes")),
    }
    columns = 1 + len(start.cameras)
    with figure_style():
        figure = new_figure(2.45 * columns, 9.2)
        figure.get_layout_engine().set(h_pad=0.08)
        grid = figure.subplots(len(rows), columns, squeeze=False)
        for (heading, (rig, looks)), axes in zip(rows.items(), grid, strict=True):
            _draw_plan(axes[0], rig, looks)
            axes[0].set_ylabel(heading, fontweight="bold", fontsize=11)
            _draw_images(axes[1:], _fullest(looks))
        _tell(
            figure,
            detection_handles(),
            "Left: all vehicles of the scenes from above, and the cameras' fields of view. "
            "Right: the one of these scenes with most vehicles, through every camera.",
        )
        return save_figure(figure, path)


def highest(config: Config, path: Path, *, display: RunDisplay) -> Path:
    """Figure 12: the rig around the vehicle's highest point, its sectors, and what it finds in all test scenes.

    Args:
        config: The cameras, the scenes, the detector.
        path: PNG file to write.
        display: Where to show it.

    Raises:
        InputError: Something in the input is wrong.
    """
    scenes = list(
        display.steps("scenes", load_scenes(config, config.scenes.test_seeds), count=len(config.scenes.test_seeds))
    )
    ego = scenes[0].ego
    rig = find_rig(HIGHEST, config, ego)
    surface = camera_mount(config, ego).surface
    looks = _Looker(config, display).look(rig, scenes, "test scenes")
    image_rows = math.ceil(len(rig.cameras) / _IMAGES_A_ROW)
    with figure_style():
        figure = new_figure(WIDTH_INCH, 5.0 + 2.35 * image_rows)
        upper, lower = figure.subfigures(2, 1, height_ratios=[4.2, 2.35 * image_rows])
        near, around = upper.subplots(1, 2, width_ratios=[1.15, 1.0])
        draw_vehicle(near, ego)
        draw_height_map(near, surface, colours=pale_map())
        draw_cameras(near, rig, sector_radius_m=1.2, has_names=True)
        near.set_aspect("equal")
        near.margins(0.1)
        near.autoscale_view()
        near.set_xlabel("x, forward [m]")
        near.set_ylabel("y, left [m]")
        title(near, "Cameras around the highest point")
        _draw_plan(around, rig, looks)
        axes = lower.subplots(image_rows, _IMAGES_A_ROW, squeeze=False).flat
        for axis in axes[len(rig.cameras) :]:
            axis.set_axis_off()
        _draw_images(axes[: len(rig.cameras)], _fullest(looks))
        covered_deg = math.degrees(covered_rad(rig))
        _tell(
            figure,
            detection_handles(),
            f"Right: all vehicles of {count_text(len(scenes), 'test scenes')} from above. The fields of view cover "
            f"{covered_deg:.0f} of 360 degrees.\nBelow: the one of these scenes with most vehicles.",
        )
        return save_figure(figure, path)


def covered_rad(rig: Rig) -> float:
    """Angle of all bearings that lie in some camera's field of view [rad], 0 to 2 pi."""
    ranges = []
    for right, left in (bearing_sector_rad(camera) for camera in rig.cameras):
        first = right % (2.0 * math.pi)
        end = first + (left - right)
        ranges += [(first, min(end, 2.0 * math.pi)), (0.0, max(end - 2.0 * math.pi, 0.0))]
    covered, reached = 0.0, 0.0
    for first, end in sorted(ranges):
        covered += max(end - max(first, reached), 0.0)
        reached = max(reached, end)
    return covered


def _fullest(looks: Sequence[_Look]) -> _Look:
    return max(looks, key=lambda look: len(look.scene.vehicles))


def _draw_images(axes: Sequence[Any], look: _Look) -> None:
    for k, (axis, panel) in enumerate(zip(axes, look.panels, strict=True)):
        draw_detections(axis, panel)
        axis.set(xticks=[], yticks=[])
        axis.grid(visible=False)
        for spine in axis.spines.values():
            spine.set(visible=True, color=hex_colour(camera_rgb(k)), linewidth=2.0)


def _draw_plan(axis: Any, rig: Rig, looks: Sequence[_Look]) -> None:  # noqa: ANN401 (matplotlib)
    """Draw from above who is found and who is not in some scenes, x pointing right, and the rig's sectors."""
    boxes = [vehicle.box for look in looks for vehicle in look.scene.vehicles]
    is_found = np.concatenate([look.is_found for look in looks])
    reach_m = max((np.abs(box.corners_m()[:, :2]).max() for box in boxes), default=20.0)
    reach_m = 5.0 * math.ceil(reach_m / 5.0)
    draw_vehicle(axis, looks[0].scene.ego)
    for index, camera in enumerate(rig.cameras):
        outline = sector_polygon_m(camera, radius_m=1.5 * reach_m)  # to the corners of the panel
        axis.fill(*outline.T, color=hex_colour(camera_rgb(index)), alpha=0.13, linewidth=0, zorder=0)
    for box, found in zip(boxes, is_found, strict=True):
        colour = hex_colour(TRUE_POSITIVE_RGB if found else MISS_RGB)
        outline = box.corners_m()[[0, 4, 6, 2], :2]
        axis.fill(*outline.T, facecolor=colour, alpha=0.35, linewidth=0, zorder=3)
        line = {"linestyle": "-", "zorder": 4} if found else {"linestyle": (0, (3, 2)), "zorder": 5}
        axis.fill(*outline.T, facecolor="none", edgecolor=colour, linewidth=0.9 if found else 1.3, **line)
    axis.set(xlim=(-reach_m, reach_m), ylim=(-reach_m, reach_m), aspect="equal")
    axis.grid(visible=False)
    axis.locator_params(nbins=4)
    axis.tick_params(labelsize=8)
    axis.set_xlabel("x, forward [m]", fontsize=8)
    axis.set_title(
        f"{int(is_found.sum())} of {len(is_found)} found in {count_text(len(looks), 'scenes')}",
        fontsize=9.5,
        fontweight="normal",
        pad=4,
    )


def _tell(figure: Any, handles: Sequence[Any], text: str) -> None:  # noqa: ANN401 (matplotlib)
    """A caption with what the marks mean below all panels."""
    legend = figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), title=text)
    legend.get_title().set(fontsize=9, color=hex_colour(MUTED_RGB), multialignment="center")
