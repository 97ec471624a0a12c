"""What cameras see, written to disk: rendered images of a rig, and the figures of a run."""

from __future__ import annotations

import contextlib
import dataclasses
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import ArgumentError, InputError
from warpav.core.progress import Progress
from warpav.optimisation import ObjectOutcome, observe_scenes
from warpav.rig import Rig
from warpav.runs._drawn_run import DrawnRun
from warpav.runs._evaluate import requirements_of
from warpav.runs._events import trajectory
from warpav.runs._placement import Placement
from warpav.runs._rig_evaluation import RigEvaluation
from warpav.runs._run_folder import RunFolder
from warpav.runs.report._content import read_evaluation
from warpav.runs.report.report import SHOWN_SCENES
from warpav.sight import Body
from warpav.view import (
    Canvas,
    detections_sheet,
    drawing_of,
    figure_bytes,
    found_alone_figure,
    load_pyvista,
    opengl_problem,
    plot,
    render_rgb,
    save_rgb,
)

if TYPE_CHECKING:
    from warpav.detection import DetectionProbability
    from warpav.optimisation import AssignedScene, CameraObservation
    from warpav.raster.camera import CameraModel
    from warpav.raster.mesh import Mesh
    from warpav.scene import Scene

GROUND_SCENES = 10
"""Test scenes at most on which the ground that no camera sees is measured."""

_RIG_PX = (900, 750)


@dataclass(frozen=True, eq=False)
class RunPictures:
    """What the pictures of a run are drawn from."""

    folder: RunFolder
    placement: Placement
    start: Rig
    found: Rig
    test: Sequence[AssignedScene]
    scene: Scene
    evaluation: RigEvaluation

    @classmethod
    def of_folder(cls, folder: RunFolder, progress: Progress) -> RunPictures:
        """Those of a run that has ended: its scenes and its detector are loaded again."""
        evaluation = read_evaluation(folder)
        if evaluation is None:
            raise InputError(
                f"{folder.path}: run folder: expected an evaluation, got none; warpav optimise --resume {folder.path} "
                "goes on"
            )
        placement = Placement.from_config(folder.config()).prepare(progress)
        found = folder.found_rig()
        return cls(folder, placement, folder.rig("initial"), found, placement.test, placement.shown, evaluation)

    def draw(self, progress: Progress, *, full: bool) -> None:
        """Draw the pictures of the first page, or all; what this machine cannot draw is said."""
        problem = opengl_problem()
        if problem is None:
            load_pyvista().Plotter  # noqa: B018 (it imports matplotlib, as figures do: two threads must not)
        with ThreadPoolExecutor(1) as beside:  # VTK lets go of Python's lock, and some systems want it on this thread
            few = beside.submit(self._draw_few)
            if problem is None:
                self._draw_rig()
            else:
                progress.say(f"no picture of the rig in three dimensions: {problem}")
        few.result()
        if full:
            self._draw_further()

    def _draw_few(self) -> None:
        drawn = self._drawn
        has_search = any(event.get("stage") == "selection" for event in drawn.all_events)
        self._plot(drawn, "search", "search" if has_search else "loss_curves")
        self._plot(drawn, "ground", misses_per_100=self.evaluation.misses)
        seen = {name: self._seen(rig, self.test[0]) for name, rig in drawn.rigs.items()}
        detections_sheet(seen, self.folder.figure_path("detections"))

    def _draw_further(self) -> None:
        from warpav.view import requirement_map

        placement, drawn = self.placement, self._drawn
        if self.evaluation.mount_tolerance is not None:
            outages = self.evaluation.camera_outage.get("optimised")
            self._plot(self.evaluation.mount_tolerance.tolerance(), "tolerance", "sensitivity", outages=outages)
        self._plot(drawn, "top_view", "rig_top_view")
        if drawn.further is not None and len(drawn.further):
            self._plot(drawn, "further", "further_cameras")
        for kind in ("plan", "near_field", "redundancy"):
            self._plot(drawn, kind)
        if placement.fitted_probabilities:
            self._plot(drawn.rigs, "range", ego=self.scene.ego, probability=self._probability)
        for name, met in requirements_of(drawn.rigs, placement).items():
            file = self.folder.figure_path(f"requirements_{name.replace(' ', '_')}")
            requirement_map(file, result=met, rig=drawn.rigs[name], ego=placement.ego)
        for kind in ("recall", "differences"):
            with contextlib.suppress(ArgumentError):  # too few objects or scenes
                self._plot(self.evaluation, kind)
        objects = self.evaluation.objects
        left = Counter(each.scene for each in objects if each.outcome["optimised"] != ObjectOutcome.DETECTED)
        first, *others = self.test
        hardest = sorted((each for each in others if left[each.scene.name]), key=lambda each: -left[each.scene.name])
        for which, shown in zip(SHOWN_SCENES, (first, *hardest), strict=False):
            seen = {name: self._seen(rig, shown) for name, rig in drawn.rigs.items()}
            for camera in dict.fromkeys(camera for of_rig in seen.values() for camera in of_rig):
                row = {name: of_rig[camera] for name, of_rig in seen.items() if camera in of_rig}
                detections_sheet({shown.scene.name: row}, self.folder.figure_path(f"{which}_{camera}"))

    @cached_property
    def _drawn(self) -> DrawnRun:
        return DrawnRun(
            str(self.folder.path),
            self.placement.config,
            self.evaluation.start,
            self.start,
            self.found,
            self.folder.events(),
            lambda: self.scene,
            lambda _: self.placement.mount.surface,
            self.folder.further_cameras,
        )

    def _plot(self, shown: object, kind: str, name: str | None = None, **options: Any) -> None:  # noqa: ANN401
        plot(shown, kind=kind, out=self.folder.figure_path(name or kind), **options)

    def _draw_rig(self) -> None:
        drawn = self._drawn
        images = rig_images(drawn.rigs, self.scene, {id(self.found): trajectory(drawn.events)})
        save_rgb(np.hstack(images), self.folder.figure_path("rig"))

    def _seen(self, rig: Rig, assigned: AssignedScene) -> dict[str, CameraObservation]:
        """What the cameras of a rig see of a scene, by their names, without LiDARs; the own body is tinted."""
        from warpav.detection import render_images
        from warpav.view import own_body_tinted

        objective = self.placement.objective
        [seen] = observe_scenes(rig, [assigned], objective, with_objective=False).observations
        images = render_images(assigned.scene, rig.cameras, device=objective.device)
        return {
            camera.name: dataclasses.replace(each, image_rgb=own_body_tinted(each.image_rgb, image.object_index))
            for camera, each, image in zip(rig.cameras, seen.cameras, images, strict=True)
            if camera.model.beams is None
        }

    def _probability(self, model: CameraModel) -> DetectionProbability:
        """That of the same camera, else of one whose images have the same size, as of zooms of one lens."""
        known = self.placement.fitted_probabilities
        size = model.width_px, model.height_px
        alike = [each for camera, each in known if (camera.width_px, camera.height_px) == size]
        return [*(each for camera, each in known if camera == model), *alike][0]


def rig_images(
    rigs: Mapping[str, Rig], scene: Scene, trajectory_of: Mapping[int, Any] | None = None
) -> list[np.ndarray]:
    """Rigs on the vehicle in a scene, as images of one size."""
    images = []
    for name, rig in rigs.items():
        canvas = Canvas(title=name, window_size=_RIG_PX, off_screen=True)
        path_m = (trajectory_of or {}).get(id(rig))
        with contextlib.closing(drawing_of(rig, canvas, scene=scene, trajectory_m=path_m)) as plotter:
            images.append(render_rgb(plotter))
    return images


def comparison_figures(evaluation: RigEvaluation, placement: Placement, progress: Progress) -> dict[str, io.BytesIO]:
    """Figures of rigs side by side, as PNG."""
    from PIL import Image

    rigs, ego, canvas = evaluation.rigs, placement.ego, Canvas(off_screen=True)
    figures = {"alone": found_alone_figure(rigs, ego, _places_found_alone(evaluation, ego))}
    figures |= {kind: drawing_of(rigs, canvas, kind=kind, ego=ego) for kind in ("ground", "plan")}
    for kind in ("recall", "differences"):
        with contextlib.suppress(ArgumentError):  # too few objects or scenes
            figures[kind] = drawing_of(evaluation, canvas, kind=kind)
    files = {name: io.BytesIO(figure_bytes(figure, ".png")) for name, figure in figures.items()}
    problem = opengl_problem()
    if problem is not None:
        progress.say(f"no picture of the rigs in three dimensions: {problem}")
        return files
    files["rig"] = io.BytesIO()
    Image.fromarray(np.hstack(rig_images(rigs, placement.shown))).save(files["rig"], "PNG")
    files["rig"].seek(0)
    return files


def _places_found_alone(evaluation: RigEvaluation, ego: Mesh) -> dict[str, np.ndarray]:
    """Where road users stand that a rig alone finds, x and y [m] in the ego frame [object, 2], by rig."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in evaluation.arms}
    for seen in evaluation.objects:
        if seen.found_alone_by is not None:
            bearing_rad = np.radians(seen.bearing_deg)
            found[seen.found_alone_by].append(
                (np.cos(bearing_rad) * seen.distance_m, np.sin(bearing_rad) * seen.distance_m)
            )
    middle_m = Body.of(ego).centre_m
    return {name: np.array(each).reshape(-1, 2) + middle_m for name, each in found.items()}
