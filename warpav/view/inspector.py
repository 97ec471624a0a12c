"""The interactive view of a rig: go through a run, switch scenes, look through cameras, move them, save the rig."""

from __future__ import annotations

import dataclasses
import math
import textwrap
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from warpav.core.errors import InputError
from warpav.sight.ground import HEIGHTS_M, PATCH_M
from warpav.view.body_view import add_gain, add_zones
from warpav.view.descent_view import add_descent, add_further_cameras
from warpav.view.frustum import frustum_points
from warpav.view.inspected import NEAR_M
from warpav.view.opengl import load_pyvista, tell_vtk_where_to_draw
from warpav.view.palette import FALSE_POSITIVE_RGB, INK_RGB, MISS_RGB, TRUE_POSITIVE_RGB, camera_rgb, hex_colour
from warpav.view.requirement_view import add_requirements
from warpav.view.rig_view import (
    FRUSTUM_DEPTH_M,
    WIDE_ZOOM,
    add_camera,
    add_range_rings,
    add_scene,
    no_render,
    rig_plotter,
)
from warpav.view.visibility_view import (
    RAYS_PX,
    add_camera_visibility,
    add_coverage,
    add_outcomes,
    colour_coverage,
    patch_words,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from warpav.evaluation.metrics import CameraObservation
    from warpav.rig.rig import RigCamera
    from warpav.sight.ground import Coverage, Ground
    from warpav.view.inspected import InspectedRig

    Plotter = Any

KEYS = {
    "n": "next scene",
    "c": "coverage: child, adult, ground, off",
    "d": "detections",
    "v": "views",
    "g": "descent arrows",
    "i": "range rings",
    "m": "one more camera",
    "z": "body: zones, one more camera, off",
    "o": "other module",
    "k": "requirements",
    "Left": "turn left",
    "Right": "turn right",
    "Return": "write the rig",
    "q": "quit",
}
"""What keys do, as the line of help in the window says; m, and the second of z, only after a search by a pool, o and k
only where there are modules and requirements.

VTK has uses of its own for w, s, r, f, p, u, e, a and 3.
"""

VIEW_PX = 300
"""Longer side of the view through the chosen camera."""

BEGINNINGS = Literal["coverage", "redundancy", "outcomes", "visibility", "further", "zones", "gain", "requirements"]
"""What an inspector may show at first."""

SHOWN_HEIGHTS_M = (*HEIGHTS_M, PATCH_M)
"""Of which the ground shows how many cameras see somebody, or at last the ground itself [m]."""

_BOTTOM = 0.1  # above the lines of help

TURN_RAD = math.radians(2.0)
_MESSAGE_CHARACTERS = 80
"""Longest line of a message in the window."""

_DRAGGED_RAYS_PX = 97
"""Rays along each side of the view of a camera while it is dragged."""

_BALL_RADIUS_M = 0.11


class Inspector:
    """A plotter whose cameras can be dragged over the mount surface.

    What moves is changed, not drawn again: while a camera is dragged no actor is made, and one image is drawn.
    """

    def __init__(
        self,
        state: InspectedRig,
        *,
        save_to: Path,
        trajectory_m: np.ndarray | None = None,
        begin_with: BEGINNINGS = "coverage",
        off_screen: bool | None = None,
        window_size: tuple[int, int] = (1280, 800),
        panel: Callable[[str], None] | None = None,
    ) -> None:
        """Draw everything once.

        Args:
            trajectory_m: Trajectories of the cameras over a run [m], [iteration, camera, 3].
            window_size: Width and height [px].
        """
        self.state, self.save_to, self._panel = state, save_to, panel
        self.chosen: int | None = None
        first_height = {"coverage": 0, "redundancy": SHOWN_HEIGHTS_M.index(PATCH_M)}
        self.shown_height: int | None = first_height.get(begin_with)
        self.shows_outcomes = begin_with == "outcomes"
        self.shows_visibility = begin_with == "visibility"
        self.shows_descent, self.shows_rings = True, False
        self.shows_further = begin_with == "further"
        self.shows_requirements = begin_with == "requirements"
        self.shown_on_body: Literal["zones", "gain"] | None = begin_with if begin_with in ("zones", "gain") else None
        tell_vtk_where_to_draw()
        with ThreadPoolExecutor(1) as beside:
            # neither holds up the other: the one is Warp's, the other VTK's
            coverage = beside.submit(lambda: state.coverage)
            self.plotter = rig_plotter(
                state.rig,
                ego=state.scene.ego,
                scene=state.scene,
                trajectory_m=trajectory_m,
                off_screen=off_screen,
                window_size=window_size,
                sectors=False,
                labels=False,
                zoom=WIDE_ZOOM,
            )
            coverage.result()
        # dragging has to be smooth; image files are made by other functions
        self.plotter.disable_anti_aliasing()
        self.plotter.renderer.SetUseOIT(False)
        self._drawn = list(state.rig.cameras)
        self._balls: list[Any] = []
        self._labels = [self._add_label(index) for index in range(len(self._drawn))]
        self._ground: tuple[Ground, tuple[float, ...], Any] | None = None
        self._numbers: Any = None
        self._view: Any = None
        self._add_controls()
        self._draw_descent()
        self._draw_further()
        self._draw_body()
        if self.shows_outcomes:
            self._draw_scene()
        self._draw_visibility()
        self._redraw()

    # ------------------------------------------------------------------------------------------------ what users do

    def go_to(self, frame: int) -> None:
        """Show the rig of an iteration."""
        if frame == self.state.frame and self.state.rig is self.state.frames[frame]:
            return  # the slider says so when it is made
        self.state.go_to(frame)
        with self._one_render():
            for index in range(len(self.state.rig.cameras)):
                self._draw_camera(index)
                self._put_ball(index)
            self._draw_descent()
            self._draw_further()
            self._draw_gain()
            self._draw_visibility()
            self._redraw()

    def next_scene(self) -> None:
        """Show the next scene, after the last the first."""
        self.show_scene(self.state.scene_index + 1)

    def show_scene(self, number: int) -> None:
        """Show a scene by its number, from 0; beyond the last they begin again."""
        self.state.show_scene(number)
        with self._one_render():
            self._draw_scene()
            self._draw_visibility()
            self._redraw()

    def cycle_coverage(self) -> None:
        """Show who is seen where for the next height, then the ground, nothing, the first height again; views go."""
        heights = [*range(len(SHOWN_HEIGHTS_M)), None]
        self.shown_height = heights[(heights.index(self.shown_height) + 1) % len(heights)]
        if self.shown_height is not None:
            self.shows_visibility = False
        with self._one_render():
            self._draw_visibility()
            self._redraw()

    def toggle_outcomes(self) -> None:
        """Colour traffic by what becomes of it, or no longer."""
        self.shows_outcomes = not self.shows_outcomes
        with self._one_render():
            self._draw_scene()
            self._redraw()

    def toggle_visibility(self) -> None:
        """Paint the views of the cameras up to what hides the rest, or no longer; the coverage goes."""
        self.shows_visibility = not self.shows_visibility
        if self.shows_visibility:
            self.shown_height = None
        with self._one_render():
            self._draw_visibility()
            self._draw_coverage()

    def toggle_descent(self) -> None:
        """Show the arrows of the descent, or no longer."""
        self.shows_descent = not self.shows_descent
        with self._one_render():
            self._draw_descent()

    def toggle_rings(self) -> None:
        """Show circles on the ground that say how far it is, or no longer."""
        self.shows_rings = not self.shows_rings
        with self._one_render():
            add_range_rings(self.plotter, self.state.scene.ego.bounds_m() if self.shows_rings else None)

    def toggle_further(self) -> None:
        """Show what one more camera would bring, or no longer; nothing happens where that is not known."""
        self.shows_further = not self.shows_further
        with self._one_render():
            self._draw_further()

    def cycle_body(self) -> None:
        """Paint the zones on the body, then what one more camera would bring if that is known, then nothing."""
        after = {None: "zones", "zones": "gain" if self.state.has_further_cameras else None, "gain": None}
        self.shown_on_body = after[self.shown_on_body]
        with self._one_render():
            self._draw_body()

    def toggle_requirements(self) -> None:
        """Lay the points of the requirements on the ground, or no longer; the coverage goes."""
        self.shows_requirements = not self.shows_requirements
        if self.shows_requirements:
            self.shown_height = None
        with self._one_render():
            self._redraw()

    def change_module(self) -> None:
        """Put the next module in the place of the chosen camera."""
        if self.chosen is not None and self.state.has_modules:
            self.state.change_module(self.chosen)
            self._after_change(self.chosen)

    def choose(self, camera: int | None) -> None:
        """Show the view through a camera, with boxes; None: through none."""
        self.chosen = camera
        with self._one_render():
            self._draw_view()
            self._say("\n".join(self._lines()))

    def drag(self, camera: int, position_m: np.ndarray) -> None:
        """Move a camera while it is dragged: all but what needs the detector follows."""
        with self._one_render():
            self._follow(camera, position_m)

    def drop(self, camera: int, position_m: np.ndarray) -> None:
        """Move a camera and let go of it: everything follows."""
        self.state.move(camera, position_m)
        self.chosen = camera
        self._after_change(camera)

    def turn(self, angle_rad: float) -> None:
        """Turn the chosen camera to the left by an angle [rad]."""
        if self.chosen is not None:
            self.state.turn(self.chosen, self.state.rig.cameras[self.chosen].yaw_rad + angle_rad)
            self._after_change(self.chosen)

    def save(self) -> Path:
        """Write the rig as it is now, to a file of its own: a number follows the name where that is taken."""
        path, number = self.save_to, 1
        while path.is_file():
            number += 1
            path = self.save_to.with_stem(f"{self.save_to.stem}-{number}")
        self.state.save(path)
        with self._one_render():
            self._say("\n".join([*self._lines(), f"wrote {path}"]))
        return path

    # ------------------------------------------------------------------------------------------------ what is drawn

    def _follow(self, camera: int, position_m: np.ndarray) -> None:
        """What a drag changes, not yet drawn."""
        was_descent, was_further = self.state.descent is not None, self.state.further is not None
        self.state.move(camera, position_m)
        self._draw_camera(camera)
        if was_descent:
            self._draw_descent()
        if was_further:
            self._draw_further()
            self._draw_gain()
        if self.shows_visibility:
            self._draw_visibility_of(camera, rays=_DRAGGED_RAYS_PX)
        self._redraw(detector=False)

    def _dragged(self, ball: Any, camera: int) -> None:  # noqa: ANN401 (a vtkSphereWidget)
        """Answer to a move of the mouse; the ball draws the window afterwards, so nothing else has to."""
        with no_render(self.plotter):
            self._follow(camera, np.array(ball.GetCenter()))

    def _after_change(self, camera: int) -> None:
        with self._one_render():
            self._draw_camera(camera)
            self._put_ball(camera)
            self._draw_descent()
            self._draw_further()
            self._draw_gain()
            if self.shows_visibility:
                self._draw_visibility_of(camera)
            if self.shows_outcomes:
                self._draw_scene()
            self._redraw()

    def _attempt(self, action: Callable[[], object]) -> None:
        """Do what a key stands for; what keeps it from being done is said in the window."""
        try:
            action()
        except InputError as error:
            with self._one_render():
                self._say(textwrap.fill(str(error), _MESSAGE_CHARACTERS))

    @contextmanager
    def _one_render(self) -> Iterator[None]:
        """Draw once when all is changed, instead of after every change."""
        with no_render(self.plotter):
            yield
        self.plotter.render()

    def _add_controls(self) -> None:
        plotter, count = self.plotter, len(self.state.frames)
        for index in range(len(self.state.rig.cameras)):
            self._add_ball(index)
        plotter.render_window.AddObserver("WindowResizeEvent", lambda *_: self._put_view())
        if self._panel is not None:
            return
        controls = {"click a ball": "look through the camera", "drag it": "move the camera", **KEYS}
        for key, is_there in (
            ("o", self.state.has_modules),
            ("k", self.state.has_requirements),
        ):
            if not is_there:
                del controls[key]
        if not self.state.has_further_cameras:
            del controls["m"]
            controls["z"] = "body: zones, off"
        help_texts = [f"{key}: {word}" for key, word in controls.items()]
        half = len(help_texts) // 2
        plotter.add_text(
            "   ".join(help_texts[:half]) + "\n" + "   ".join(help_texts[half:]),
            position=(0.02, 0.012),
            viewport=True,
            font_size=8,
            color=hex_colour(INK_RGB),
            name="help",
        )
        if count > 1:
            plotter.add_slider_widget(
                lambda value: self.go_to(round(value)),
                (0, count - 1),
                value=self.state.frame,
                title="iteration",
                pointa=(0.66, 0.93),
                pointb=(0.97, 0.93),
                fmt="%.0f",
                color=hex_colour(INK_RGB),
                interaction_event="end",
            )
        actions = {
            "n": self.next_scene,
            "c": self.cycle_coverage,
            "d": self.toggle_outcomes,
            "v": self.toggle_visibility,
            "g": self.toggle_descent,
            "i": self.toggle_rings,
            "m": self.toggle_further,
            "z": self.cycle_body,
            "o": self.change_module,
            "k": self.toggle_requirements,
            "Left": lambda: self.turn(TURN_RAD),
            "Right": lambda: self.turn(-TURN_RAD),
            "Return": self.save,
        }
        for key, action in actions.items():
            plotter.clear_events_for_key(key, raise_on_missing=False)
            plotter.add_key_event(key, partial(self._attempt, action))

    def _add_ball(self, index: int) -> None:
        """A ball around a camera that can be dragged."""
        widget = self.plotter.add_sphere_widget(
            lambda position_m: self.drop(index, np.array(position_m)),
            center=tuple(self.state.rig.cameras[index].position_m),
            radius=_BALL_RADIUS_M,
            color=hex_colour(camera_rgb(index)),
            selected_color=hex_colour(camera_rgb(index)),
            interaction_event="end",
            test_callback=False,
        )
        widget.AddObserver("InteractionEvent", lambda ball, _: self._dragged(ball, index))
        widget.AddObserver("StartInteractionEvent", lambda ball, _: self.choose(index))
        self._balls.append(widget)

    def _put_ball(self, index: int) -> None:
        self._balls[index].SetCenter(*self.state.rig.cameras[index].position_m)

    def _add_label(self, index: int) -> Any:  # noqa: ANN401 (a pyvista.Label)
        """The name of a camera above its frustum."""
        camera = self.state.rig.cameras[index]
        label = load_pyvista().Label(f" {camera.name} ", position=_label_m(camera), size=14)
        label.prop.color = "white"
        label.prop.background_color = hex_colour(camera_rgb(index))
        label.prop.background_opacity = 0.9
        label.prop.justification_horizontal = "center"
        self.plotter.add_actor(label, name=f"label/{camera.name}", reset_camera=False, pickable=False)
        return label

    def _draw_camera(self, index: int) -> None:
        """Move what is drawn of a camera to where it is now; only another lens is drawn again."""
        camera, drawn = self.state.rig.cameras[index], self._drawn[index]
        if camera.model == drawn.model:
            moved = camera.ego_from_camera @ np.linalg.inv(drawn.ego_from_camera)
            for name, actor in self.plotter.actors.items():
                if name.startswith(f"rig/{camera.name}/"):
                    actor.user_matrix = moved
        else:
            for name in [name for name in self.plotter.actors if name.startswith(f"rig/{camera.name}/")]:
                self.plotter.remove_actor(name)
            add_camera(self.plotter, camera, index)
            self._drawn[index] = camera
        self._labels[index].position = _label_m(camera)

    def _draw_descent(self) -> None:
        descent = self.state.descent if self.shows_descent else None
        add_descent(self.plotter, self.state.rig, descent, self.state.surface)

    def _draw_further(self) -> None:
        if self.state.has_further_cameras:
            add_further_cameras(self.plotter, self.state.further if self.shows_further else None)

    def _draw_body(self) -> None:
        """Paint the body; zones stay where they are, whatever becomes of the cameras."""
        shown = self.state.surface if self.shown_on_body == "zones" else None
        add_zones(self.plotter, shown, legend_bottom=_BOTTOM)
        self._draw_gain()

    def _draw_gain(self) -> None:
        if self.state.has_further_cameras:
            further = self.state.further if self.shown_on_body == "gain" else None
            add_gain(self.plotter, self.state.surface, further, scale_at=(0.325, _BOTTOM))

    def _draw_visibility(self) -> None:
        for index, camera in enumerate(self.state.rig.cameras):
            if self.shows_visibility:
                self._draw_visibility_of(index)
            else:
                self.plotter.remove_actor(f"visibility/{camera.name}")

    def _draw_visibility_of(self, index: int, *, rays: int = RAYS_PX) -> None:
        add_camera_visibility(self.plotter, self.state.rig.cameras[index], index, self.state.packed, rays=rays)

    def _draw_scene(self) -> None:
        scene, plotter = self.state.scene, self.plotter
        for name in [name for name in plotter.actors if name.startswith(("scene/", "legend/"))]:
            plotter.remove_actor(name)
        if self.shows_outcomes:
            add_outcomes(plotter, scene, self.state.observation.outcomes, legend=False)
            scene = dataclasses.replace(scene, vehicles=())
        add_scene(plotter, scene)

    def _redraw(self, *, detector: bool = True) -> None:
        """What follows from the rig: coverage, numbers, and the view through the chosen camera."""
        self._draw_coverage()
        self._say("\n".join(self._lines(detector=detector)))
        if detector:
            self._draw_view()
            add_requirements(self.plotter, self.state.requirements if self.shows_requirements else None)

    def _lines(self, *, detector: bool = True) -> list[str]:
        """What the corner says."""
        lines = self.state.lines
        if self.shown_height is not None:
            coverage, height_m = self._shown_coverage(self.shown_height)
            lines.append(f"{patch_words(height_m)}: seen by no camera (red), by one, two or more (blue)")
            if height_m == PATCH_M:
                shares = [float(coverage.share_seen_by(count, radius_m=NEAR_M)[0]) for count in (1, 2, 3)]
                seen = ", ".join(f"{share:.1%} by {count}" for count, share in zip((1, 2, 3), shares, strict=True))
                lines.append(f"the ground within {NEAR_M:g} m: {seen} cameras or more")
        if self.chosen is not None and self.state.rig.cameras[self.chosen].module is not None:
            lines.append(f"{self.state.rig.cameras[self.chosen].name}: {self.state.rig.cameras[self.chosen].module}")
        met = self.state.requirements if detector and self.shows_requirements else None
        if met is not None:
            lines.append(f"requirements: {met.is_point_met.mean():.1%} of points met (discs), the rest has crosses")
        if detector and (self.shows_outcomes or self.chosen is not None):
            observed = self.state.observation
            lines.append(f"{int(observed.detected.sum())} of {len(observed.detected)} vehicles detected")
        return lines

    def _draw_coverage(self) -> None:
        if self.shown_height is None:
            self.plotter.remove_actor("coverage")
            self._ground = None
            return
        coverage, height_m = self._shown_coverage(self.shown_height)
        if self._ground is not None and self._ground[1] == coverage.heights_m and self._ground[0] is coverage.ground:
            colour_coverage(self._ground[2], coverage, height_m)
        else:
            drawn = add_coverage(self.plotter, coverage, height_m=height_m, legend=False)
            self._ground = coverage.ground, coverage.heights_m, drawn

    def _shown_coverage(self, shown: int) -> tuple[Coverage, float]:
        """The coverage that one of `SHOWN_HEIGHTS_M` is part of, and the height [m]."""
        height_m = SHOWN_HEIGHTS_M[shown]
        return self.state.ground_coverage if height_m == PATCH_M else self.state.coverage, height_m

    def _say(self, text: str) -> None:
        if self._panel is not None:
            self._panel(text)
            return
        if self._numbers is None:
            self._numbers = self.plotter.add_text(
                text, position=(0.02, 0.80), viewport=True, font_size=10, color=hex_colour(INK_RGB), name="numbers"
            )
        self._numbers.input = text

    def _draw_view(self) -> None:
        """The image of the chosen camera with its boxes, in the lower right corner."""
        if self.chosen is None:
            self.plotter.remove_actor("view")
            self._view = None
            return
        self._view = _image_actor(self.view_rgb())
        self._put_view()
        self.plotter.add_actor(self._view, name="view")

    def _put_view(self) -> None:
        """Put the image of the chosen camera into the corner of the window as it is now."""
        if self._view is not None:
            width_px = self._view.GetMapper().GetInput().GetDimensions()[0]
            self._view.SetPosition(self.plotter.render_window.GetSize()[0] - 16 - width_px, 44)

    def view_rgb(self) -> np.ndarray:
        """The image of the chosen camera: green boxes are found, orange ones missed, red ones false; uint8."""
        assert self.chosen is not None
        observed = self.state.observation.cameras[self.chosen]
        return _framed_view(
            observed, scale=VIEW_PX / max(observed.image_rgb.shape[:2]), border_rgb=camera_rgb(self.chosen)
        )


def _label_m(camera: RigCamera) -> tuple[float, float, float]:
    """Where the name of a camera stands: above the far end of its frustum [m]."""
    corner = frustum_points(camera, depth_m=FRUSTUM_DEPTH_M)[1:]
    x, y = corner[:, :2].mean(axis=0)
    return float(x), float(y), float(corner[:, 2].max()) + 0.12


def _framed_view(observed: CameraObservation, *, scale: float, border_rgb: tuple[int, int, int]) -> np.ndarray:
    """A camera's image with boxes and a coloured border.

    Returns:
        uint8 [row, column, 3].
    """
    import cv2

    enlarged = cv2.resize(observed.image_rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)

    def draw(box: np.ndarray, rgb: tuple[int, int, int], width: int) -> None:
        x0, y0, x1, y1 = (int(round(float(value) * scale)) for value in box)
        cv2.rectangle(enlarged, (x0, y0), (x1, y1), rgb, width)

    matched = set(observed.match.tolist())
    for k, box in enumerate(observed.detections.box_px):
        draw(box, TRUE_POSITIVE_RGB if k in matched else FALSE_POSITIVE_RGB, 2)
    for box, found in zip(observed.truth_box_px, observed.match, strict=True):
        if found < 0 and np.isfinite(box).all():
            draw(box, MISS_RGB, 2)
    return cv2.copyMakeBorder(enlarged, 4, 4, 4, 4, cv2.BORDER_CONSTANT, value=border_rgb)


def _image_actor(image_rgb: np.ndarray) -> Any:  # noqa: ANN401 (a vtkActor2D)
    """An image in the plane of the window, with its lower left corner in that of the window."""
    from vtkmodules.vtkRenderingCore import vtkActor2D, vtkImageMapper

    pyvista = load_pyvista()
    rows, columns = image_rgb.shape[:2]
    grid = pyvista.ImageData(dimensions=(columns, rows, 1))
    grid.point_data["rgb"] = np.ascontiguousarray(image_rgb[::-1]).reshape(-1, 3)
    grid.set_active_scalars("rgb")
    mapper = vtkImageMapper()
    mapper.SetInputData(grid)
    mapper.SetColorWindow(255.0)
    mapper.SetColorLevel(127.5)
    actor = vtkActor2D()
    actor.SetMapper(mapper)
    return actor
