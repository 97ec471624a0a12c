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

from warpav.core.devices import checked_device
from warpav.core.errors import InputError
from warpav.core.progress import Progress
from warpav.evaluation.metrics import RigObserver
from warpav.optimisation.mount import RISE_M, X_M, Y_M
from warpav.raster.device_scene import DeviceScene
from warpav.raster.renderer import Occlusion
from warpav.rig.find import HIGHEST
from warpav.rig.rig import Rig
from warpav.runs.build import build
from warpav.runs.config import Config, changed_config
from warpav.runs.mounts import camera_mount
from warpav.runs.networks import load_detector, load_networks
from warpav.runs.optimise import Optimisation, descent_from
from warpav.runs.placement import Placement, needed_fit, placement_on
from warpav.runs.rig_source import find_rig
from warpav.runs.run_folder import RunFolder, trajectory
from warpav.runs.scene_set import load_scene_set, load_scenes
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

_UNCONSTRAINED = ("optimiser.multiplier_learning_rate=0", "optimiser.multiplier_damping=0")
_IMAGES_A_ROW = 4


def draw_method_figure(
    number: int, path: Path | str, config: Config, *, run: RunFolder | None, progress: Progress
) -> Path:
    """Draw a figure by its number in the thesis.

    Args:
        number: One of `RIG_NUMBERS`.
        path: PNG file to write.
        config: Scenes, cameras, detector, method; with a run its own.
        run: For figures 10 and 11: a run that has been optimised; None: it is done now, without a run folder.
        progress: Where to show what is going on.

    Raises:
        InputError: Inputs that do not go with it, or that cannot be used.
    """
    path = checked_png(path)
    match number:
        case 10:
            return unconstrained(config, path, run=run, progress=progress)
        case 11:
            return before_and_after(config, path, run=run, progress=progress)
        case 12:
            if run is not None:
                raise InputError("figure 12: expected a configuration, got --run; the highest rig needs no run")
            return highest(config, path, progress=progress)
    raise InputError(f"figure: expected one of {', '.join(map(str, RIG_NUMBERS))}, got {number}")


# ------------------------------------------------------------------------------------------------ without constraints


@dataclass(frozen=True)
class _Way:
    """What became of a rig: where it began, its camera positions over the iterations [m], and where it ended."""

    start: Rig
    trajectory_m: np.ndarray
    end: Rig


def unconstrained(config: Config, path: Path, *, run: RunFolder | None, progress: Progress) -> Path:
    """Figure 10: camera trajectories over the vehicle from one start, with and without all multipliers fixed at 0.

    Args:
        config: What to optimise.
        path: PNG file to write.
        run: Supplies the trajectory with constraints and its start; None: both are computed.
        progress: Where to show it.

    Raises:
        InputError: Something in the input is wrong.
    """
    # which iterate is kept and how often rigs are compared does not change the trajectory
    config = changed_config(config, ["optimiser.keep=last", "optimiser.patience=null", "optimiser.descents=1"])
    free = changed_config(config, _UNCONSTRAINED)
    traffic, networks = load_scene_set(config, progress), load_networks(config)
    probability = needed_fit(config, progress)
    placement = placement_on(traffic, config, networks, probability)
    if run is None:
        optimisation = Optimisation.begin(placement)
        start, began_as = optimisation.descent.start, optimisation.began_as
        kept = _walk(placement, optimisation.descent, progress, "with constraints")
    else:
        path_m, began = trajectory(run.events()), run.rig("initial")
        if path_m is None:
            raise InputError(f"{run.path}: run folder: expected at least two iterations, got fewer")
        start = placement.objective.mount.mount_pose_of_rig(began)
        began_as = None if placement.has_ordered_start else began
        kept = _Way(began, path_m, run.rig("final"))
    loose = placement_on(traffic, free, networks, probability)
    lost = _walk(loose, descent_from(loose, start, began_as), progress, "without constraints")

    constraints, surface = placement.objective.constraints, placement.objective.mount.surface
    point_m = np.concatenate([traffic.ego.bounds_m(), *(way.trajectory_m.reshape(-1, 3) for way in (lost, kept))])
    length_m, width_m = np.ptp(point_m[:, :2], axis=0)
    with figure_style():
        figure = new_figure(WIDTH_INCH, 1.9 + 2.0 * min(0.8 * WIDTH_INCH * width_m / length_m, 5.0))
        axes, image = figure.subplots(2, 1, sharex=True, sharey=True), None
        for axis, heading, track in zip(axes, ("Without constraints", "With constraints"), (lost, kept), strict=True):
            draw_vehicle(axis, traffic.ego)
            image = draw_height_map(axis, surface, colours=pale_map())
            if constraints.are_inequalities:
                draw_zone_border(axis, surface)
            else:
                _draw_bounds(axis, surface.bounds_m)
            draw_cameras(axis, track.end, rig_initial=track.start, trajectory_m=track.trajectory_m)
            excess_m = [constraints.violation_m(Rig.create([camera])) for camera in track.end.cameras]
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


def _walk(placement: Placement, descent: Descent, progress: Progress, how: str) -> _Way:
    """Run all iterations; the end is the last iterate, projected to a feasible rig if there are constraints."""
    mount, constraints = placement.objective.mount, placement.objective.constraints
    count = placement.config.run.iterations
    records = [descent.step() for _ in progress.steps(how, range(count), count=count)]
    pose = descent.state()["pose_value"]
    last = mount.rig(pose)
    positions = [record.positions_m for record in records] + [[camera.position_m for camera in last.cameras]]
    if placement.config.optimiser.multiplier_learning_rate != 0.0:
        pose[:, [X_M, Y_M]] = constraints.project(pose[:, [X_M, Y_M]], pose[:, RISE_M])
    return _Way(mount.rig(descent.start), np.array(positions, np.float64), mount.rig(pose))


def _draw_bounds(axis: Any, bounds_m: np.ndarray) -> None:  # noqa: ANN401 (matplotlib)
    from matplotlib.patches import Rectangle

    low, high = bounds_m
    axis.add_patch(Rectangle(low, *(high - low), fill=False, edgecolor=hex_colour(INK_RGB), linewidth=1.0, zorder=3))


# ---------------------------------------------------------------------------------------------- observations


@dataclass(frozen=True)
class _SceneObservation:
    """Observation of a scene by a rig's cameras and detector.

    Attributes:
        scene: The scene.
        is_found: Whether some camera detects a road user, bool [vehicle].
        panels: The image of every camera with its boxes.
    """

    scene: Scene
    is_found: np.ndarray
    panels: list[DetectionPanel]


class _Observer:
    """Looks at scenes through rigs, with the configuration's detector."""

    def __init__(self, config: Config, progress: Progress) -> None:
        self._config, self._progress = config, progress
        self._device, self._detector = checked_device(config.device), load_detector(config)

    def observe(self, rig: Rig, scenes: Sequence[Scene], how: str) -> list[_SceneObservation]:
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
        observations = []
        for scene in self._progress.steps(how, scenes, count=len(scenes)):
            observation = observer.observe(DeviceScene.pack(scene, device=self._device))
            panels = [
                DetectionPanel(camera.name, seen.image_rgb, seen.truth_box_px, seen.detections.box_px, seen.match)
                for camera, seen in zip(rig.cameras, observation.cameras, strict=True)
            ]
            observations.append(_SceneObservation(scene, observation.detected, panels))
        return observations


def before_and_after(config: Config, path: Path, *, run: RunFolder | None, progress: Progress) -> Path:
    """Figure 11: what a rig sees at the start and once optimised, on a batch of training scenes and on all test scenes.

    Args:
        config: The optimisation, and the scenes and detector of the observations.
        path: PNG file to write.
        run: Gives both rigs; None: the optimisation is done now.
        progress: Where to show it.

    Raises:
        InputError: Something in the input is wrong.
    """
    if run is None:
        placement = build(config).prepare(progress)
        descent, count = Optimisation.begin(placement).descent, config.run.iterations
        for _ in progress.steps("optimising", range(count), count=count):
            if descent.verdict is None:
                descent.step()
        mount = placement.objective.mount
        start, result = mount.rig(descent.start), mount.rig(descent.finish().mount_pose)
    else:
        start, result = run.rig("initial"), run.rig()
    train = list(load_scenes(config, config.scenes.train_seeds[: config.run.batch_size]))
    test = list(load_scenes(config, config.scenes.test_seeds))
    observer = _Observer(config, progress)
    rows = {
        "Start": (start, observer.observe(start, train, "start")),
        "Optimised": (result, observer.observe(result, train, "optimised")),
        "On test scenes": (result, observer.observe(result, test, "test scenes")),
    }
    columns = 1 + len(start.cameras)
    with figure_style():
        figure = new_figure(2.45 * columns, 9.2)
        figure.get_layout_engine().set(h_pad=0.08)
        grid = figure.subplots(len(rows), columns, squeeze=False)
        for (heading, (rig, observations)), axes in zip(rows.items(), grid, strict=True):
            _draw_plan(axes[0], rig, observations)
            axes[0].set_ylabel(heading, fontweight="bold", fontsize=11)
            _draw_images(axes[1:], _fullest(observations))
        _tell(
            figure,
            detection_handles(),
            "Left: all vehicles of the scenes from above, and the cameras' fields of view. "
            "Right: the one of these scenes with most vehicles, through every camera.",
        )
        return save_figure(figure, path)


def highest(config: Config, path: Path, *, progress: Progress) -> Path:
    """Figure 12: the rig around the vehicle's highest point, its sectors, and what it finds in all test scenes.

    Args:
        config: The cameras, the scenes, the detector.
        path: PNG file to write.
        progress: Where to show it.

    Raises:
        InputError: Something in the input is wrong.
    """
    scenes = list(
        progress.steps("scenes", load_scenes(config, config.scenes.test_seeds), count=len(config.scenes.test_seeds))
    )
    ego = scenes[0].ego
    rig = find_rig(HIGHEST, config, ego)
    surface = camera_mount(config, ego).surface
    observations = _Observer(config, progress).observe(rig, scenes, "test scenes")
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
        _draw_plan(around, rig, observations)
        axes = lower.subplots(image_rows, _IMAGES_A_ROW, squeeze=False).flat
        for axis in axes[len(rig.cameras) :]:
            axis.set_axis_off()
        _draw_images(axes[: len(rig.cameras)], _fullest(observations))
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


def _fullest(observations: Sequence[_SceneObservation]) -> _SceneObservation:
    return max(observations, key=lambda observation: len(observation.scene.vehicles))


def _draw_images(axes: Sequence[Any], observation: _SceneObservation) -> None:
    for k, (axis, panel) in enumerate(zip(axes, observation.panels, strict=True)):
        draw_detections(axis, panel)
        axis.set(xticks=[], yticks=[])
        axis.grid(visible=False)
        for spine in axis.spines.values():
            spine.set(visible=True, color=hex_colour(camera_rgb(k)), linewidth=2.0)


def _draw_plan(axis: Any, rig: Rig, observations: Sequence[_SceneObservation]) -> None:  # noqa: ANN401 (matplotlib)
    """Draw from above who is found and who is not in some scenes, x pointing right, and the rig's sectors."""
    boxes = [vehicle.box for observation in observations for vehicle in observation.scene.vehicles]
    is_found = np.concatenate([observation.is_found for observation in observations])
    reach_m = max((np.abs(box.corners_m()[:, :2]).max() for box in boxes), default=20.0)
    reach_m = 5.0 * math.ceil(reach_m / 5.0)
    draw_vehicle(axis, observations[0].scene.ego)
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
        f"{int(is_found.sum())} of {len(is_found)} found in {count_text(len(observations), 'scenes')}",
        fontsize=9.5,
        fontweight="normal",
        pad=4,
    )


def _tell(figure: Any, handles: Sequence[Any], text: str) -> None:  # noqa: ANN401 (matplotlib)
    """A caption with what the marks mean below all panels."""
    legend = figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), title=text)
    legend.get_title().set(fontsize=9, color=hex_colour(MUTED_RGB), multialignment="center")
