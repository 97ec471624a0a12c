"""What cameras see, written to disk: rendered images of a rig, and the figures of a run."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import InputError
from warpav.core.progress import Progress
from warpav.evaluation.metrics import ObjectOutcome
from warpav.evaluation.rig_evaluation import RigEvaluation
from warpav.rig.rig import Rig
from warpav.runs.evaluate import requirements_of
from warpav.runs.events import trajectory
from warpav.runs.placement import Placement
from warpav.runs.report.content import read_evaluation
from warpav.runs.run_folder import RunFolder

if TYPE_CHECKING:
    from warpav.detection.probability import DetectionProbability
    from warpav.optimisation.losses.scene_on_tape import AssignedScene
    from warpav.optimisation.objective import RigObjective
    from warpav.raster.camera import CameraModel
    from warpav.scene.scene import Scene
    from warpav.view.figures.images import DetectionPanel

VIEW_PX = 960
"""Longer side of the images that are kept of what cameras see."""

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

    @property
    def rigs(self) -> dict[str, Rig]:
        """Start and result by their headings."""
        return {"start": self.start, "optimised": self.found}

    def draw(self, progress: Progress, *, full: bool) -> None:
        """Draw the pictures of the first page, or all; what this machine cannot draw is said."""
        self._draw_few()
        if full:
            self._draw_further()
        problem = self._draw_rig()
        if problem is not None:
            progress.say(f"no picture of the rig in three dimensions: {problem}")

    def _draw_few(self) -> None:
        """The pictures of the first page, but for the rig."""
        from warpav.view import plot
        from warpav.view.figures.convergence import loss_figure, search_figure
        from warpav.view.figures.images import detections_sheet
        from warpav.view.figures.statistics import sensitivity_figure

        events, min_spacing_m = self.folder.events(), self.placement.objective.constraints.min_spacing_m
        search = search_figure(events)
        tolerance, outages = self.evaluation.mount_tolerance, self.evaluation.camera_outage.get("optimised")
        figures = {
            "search": search,
            "loss_curves": loss_figure(events, min_distance_m=min_spacing_m) if search is None else None,
            "sensitivity": None if tolerance is None else sensitivity_figure(tolerance.tolerance(), outages),
        }
        self._save(figures)
        for kind in ("plan", "near_field"):
            plot(self.rigs, kind=kind, ego=self.scene.ego, out=self.folder.figure_path(kind))
        detections_sheet(self._panels(self.test[0]), self.folder.figure_path("detections"))

    def _draw_further(self) -> None:
        """All other pictures, and what the report's maps of the ground are drawn from."""
        from warpav.sight.ground import BlindGround
        from warpav.view import plot
        from warpav.view.figures.near_field import requirement_map
        from warpav.view.figures.top_view import further_figure, top_view_figure

        placement, ego = self.placement, self.scene.ego
        constraints, surface = placement.objective.constraints, placement.mount.surface.over_ground
        further = self.folder.further_cameras()
        figures = {
            "rig_top_view": top_view_figure(
                rig=self.found,
                ego=ego,
                mount_surface=surface,
                rig_initial=self.start,
                trajectory_m=trajectory(self.folder.events()),
                shows_zone=constraints.are_inequalities,
            )
        }
        if further is not None:
            objects = "vehicles" if placement.config.scenes.targets == ("vehicle",) else "road users"
            figures["further_cameras"] = further_figure(
                further=further, rig=self.found, ego=ego, mount_surface=surface, objects=objects
            )
        self._save(figures)
        plot(self.rigs, kind="redundancy", ego=ego, out=self.folder.figure_path("redundancy"))
        if placement.fitted_probabilities:
            plot(self.rigs, kind="range", ego=ego, probability=self._probability, out=self.folder.figure_path("range"))
        for name, met in requirements_of(self.rigs, placement).items():
            file = self.folder.figure_path(f"requirements_{name}")
            requirement_map(file, result=met, rig=self.rigs[name], ego=placement.ego)
        scenes = [assigned.scene for assigned in self.test[:GROUND_SCENES]]
        self.folder.write_ground(BlindGround.of(self.rigs, scenes).arrays(placement.ego.bounds_m()))
        shown = _shown_scenes(self.test, self.evaluation)
        _keep_views(self.folder, [(each.scene.name, self._panels(each)) for each in shown])

    def _draw_rig(self) -> str | None:
        """Start and result on the vehicle in the first test scene, side by side."""
        from warpav.view.opengl import opengl_problem

        problem = opengl_problem()
        if problem is not None:
            return problem
        from PIL import Image

        from warpav.view import Canvas, drawing_of
        from warpav.view.output import render_rgb, write_whole

        path_m = {"optimised": trajectory(self.folder.events())}
        images = []
        for name, rig in self.rigs.items():
            canvas = Canvas(title=name, window_size=_RIG_PX, off_screen=True)
            plotter = drawing_of(rig, canvas, scene=self.scene, trajectory_m=path_m.get(name))
            try:
                images.append(render_rgb(plotter))
            finally:
                plotter.close()
        encoded = io.BytesIO()
        Image.fromarray(np.hstack(images)).save(encoded, format="PNG", compress_level=4)
        write_whole(self.folder.figure_path("rig"), encoded.getvalue())
        return None

    def _save(self, figures: Mapping[str, Any]) -> None:
        from warpav.view.figures.style import save_figure

        for name, figure in figures.items():
            if figure is not None:
                save_figure(figure, self.folder.figure_path(name))

    def _panels(self, assigned: AssignedScene) -> dict[str, list[DetectionPanel]]:
        """What the cameras of both rigs see of a scene."""
        return {heading: _panels(rig, self.placement.objective, assigned) for heading, rig in self.rigs.items()}

    def _probability(self, model: CameraModel) -> DetectionProbability:
        """That of the same camera, else of one whose images have the same size, as of zooms of one lens."""
        known = self.placement.fitted_probabilities
        same = [each for camera, each in known if camera == model]
        size = model.width_px, model.height_px
        alike = [each for camera, each in known if (camera.width_px, camera.height_px) == size]
        return [*same, *alike][0]


def _shown_scenes(scenes: Sequence[AssignedScene], evaluation: RigEvaluation) -> list[AssignedScene]:
    """The first scene, and of the others that in which the result leaves most objects undetected, if it leaves any."""
    left = Counter(each.scene for each in evaluation.objects if each.outcome["optimised"] != ObjectOutcome.DETECTED)
    others = [each for each in scenes[1:] if left[each.scene.name]]
    return [scenes[0], *sorted(others, key=lambda each: -left[each.scene.name])[:1]]


def _keep_views(folder: RunFolder, panels: Sequence[tuple[str, Mapping[str, Sequence[DetectionPanel]]]]) -> None:
    """Write what cameras see into a run folder, by scene and by rig, as images and boxes."""
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
    from warpav.view.figures.images import DetectionPanel

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
