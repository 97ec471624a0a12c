"""The interactive view of a rig: go through a run, switch scenes, look through cameras, move them, save the rig."""

from __future__ import annotations

import textwrap
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from warpav.core.errors import InputError
from warpav.sight import HEIGHTS_M, PATCH_M
from warpav.view._inspected import NEAR_M
from warpav.view._layers import (
    RAYS_PX,
    add_coverage,
    add_descent,
    add_further_cameras,
    add_gain,
    add_requirements,
    add_text,
    add_visibility,
    add_zones,
    colour_coverage,
    no_render,
    patch_words,
    remove,
)
from warpav.view._opengl import load_pyvista, tell_vtk_where_to_draw
from warpav.view._output import Canvas
from warpav.view._palette import FALSE_POSITIVE_RGB, INK_RGB, MISS_RGB, TRUE_POSITIVE_RGB, camera_rgb, hex_colour
from warpav.view._picture import (
    WIDE_ZOOM,
    WINDOW_PX,
    Picture,
    add_camera,
    add_range_rings,
    add_scene,
    label_point_m,
    project_px,
    rig_plotter,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from warpav.optimisation import CameraObservation
    from warpav.sight import Coverage, Ground
    from warpav.view._inspected import InspectedRig

    Plotter = Any


@dataclass(frozen=True)
class _Switch:
    """What can be shown or not; ``needs`` is what of `InspectedRig.known` has to be there."""

    key: str
    words: str
    needs: str | None = None


SWITCHES = {
    "rings": _Switch("i", "range rings"),
    "outcomes": _Switch("d", "detections"),
    "visibility": _Switch("v", "views of the cameras"),
    "descent": _Switch("g", "arrows of the descent", "descent"),
    "further": _Switch("m", "one more camera", "further"),
    "requirements": _Switch("k", "requirements", "requirements"),
}
"""By their names."""

_VIEW_PX = 300
"""Longer side of the view through the chosen camera."""

BEGINNINGS = Literal["coverage", "redundancy", "outcomes", "visibility", "further", "zones", "gain", "requirements"]
"""What an inspector may show at first."""

SHOWN_HEIGHTS_M = (*HEIGHTS_M, PATCH_M)
"""Of which the ground shows how many cameras see somebody, or at last the ground itself [m]."""

_BOTTOM = 0.1  # above the lines of help

_PARTS = ("descent", "further", "gain")  # what is known of the rigs of a run alone
TURN_DEG = 2.0
_MESSAGE_CHARACTERS, _HELP_CHARACTERS = 80, 120
"""Longest lines of a message and of the help in the window."""

_DRAGGED_RAYS_PX = 97
"""Rays along each side of the view of a camera while it is dragged."""

_BALL_RADIUS_M, _BALL_PX = 0.11, 6.0
"""Of the balls by which cameras are dragged, and how near to the middle of one the mouse takes it at least."""


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
        canvas: Canvas | None = None,
        panel: Callable[[str], None] | None = None,
    ) -> None:
        """Draw everything once; a panel shows the lines that else stand in the window."""
        self.state, self.save_to, self._panel = state, save_to, panel
        self.chosen: int | None = None
        first_height = {"coverage": 0, "redundancy": SHOWN_HEIGHTS_M.index(PATCH_M)}
        self.shown_height: int | None = first_height.get(begin_with)
        self.shows = {"descent", begin_with} & {*SWITCHES}
        self.shown_on_body = begin_with if begin_with in ("zones", "gain") else None
        tell_vtk_where_to_draw()
        canvas = canvas or Canvas()
        with ThreadPoolExecutor(1) as beside:
            # neither holds up the other: the one is Warp's, the other VTK's
            coverage = beside.submit(lambda: state.coverage)
            picture = Picture(rig=state.rig, scene=state.scene, trajectory_m=trajectory_m)
            zoom = WIDE_ZOOM if canvas.zoom is None else canvas.zoom
            canvas = Canvas(window_size=canvas.window_size or WINDOW_PX, zoom=zoom, off_screen=canvas.off_screen)
            self.plotter = rig_plotter(picture, canvas, labels=False, sectors=False)
            coverage.result()
        # dragging has to be smooth; image files are made by other functions
        self.plotter.disable_anti_aliasing()
        self.plotter.renderer.SetUseOIT(False)
        self._drawn = list(state.rig.cameras)
        self._labels = [self._add_label(index) for index in range(len(self._drawn))]
        self.is_putting = False
        self._held: int | None = None  # the camera that is dragged
        self._is_moved = False
        self._off_px = np.zeros(2)  # how far its place on the skin is from the mouse
        self._ground: tuple[Ground, tuple[float, ...], Any] | None = None
        self._numbers: Any = None
        self._view: Any = None
        self._add_controls()
        self._draw("descent", "further", "body", "visibility", *(["outcomes"] if "outcomes" in self.shows else []))
        self._redraw()

    # ------------------------------------------------------------------------------------------------ what users do

    def go_to(self, frame: int) -> None:
        """Show the rig of an iteration."""
        if frame == self.state.frame and self.state.rig is self.state.frames[frame]:
            return  # the slider says so when it is made
        self.state.go_to(frame)
        with self._one_render():
            self._move()
            self._draw(*_PARTS, "visibility")
            self._redraw()

    def show_scene(self, number: int) -> None:
        """Show a scene by its number, from 0; beyond the last they begin again."""
        self.state.show_scene(number)
        with self._one_render():
            self._draw("outcomes", "visibility")
            self._redraw()

    def show_coverage(self, height: int | None) -> None:
        """Show who is seen where for one of `SHOWN_HEIGHTS_M`, or nothing; views go."""
        self.shown_height = height
        if height is not None:
            self.shows.discard("visibility")
        with self._one_render():
            self._draw("visibility")
            self._redraw()

    def cycle_coverage(self) -> None:
        """Show the coverage for the next height, then of the ground, then nothing, then for the first height again."""
        heights = [*range(len(SHOWN_HEIGHTS_M)), None]
        self.show_coverage(heights[(heights.index(self.shown_height) + 1) % len(heights)])

    def toggle(self, name: str) -> None:
        """Show one of `SWITCHES`, or no longer; the coverage goes where the ground carries something else."""
        self.shows ^= {name}
        if name in ("visibility", "requirements") and name in self.shows:
            self.shown_height = None
        with self._one_render():
            if name != "requirements":
                self._draw(name)
            if name in ("outcomes", "requirements"):
                self._redraw()
            elif name == "visibility":
                self._draw_coverage()

    def show_on_body(self, shown: str | None) -> None:
        """Paint ``zones`` on the body, or ``gain``: what one more camera would bring; or nothing."""
        self.shown_on_body = shown
        with self._one_render():
            self._draw("body")

    def cycle_body(self) -> None:
        """Paint the zones on the body, then what one more camera would bring if that is known, then nothing."""
        gain = "gain" if "further" in self.state.known else None
        self.show_on_body({None: "zones", "zones": gain, "gain": None}[self.shown_on_body])

    def edit(self, step: str, *words: Any, **numbers: Any) -> None:  # noqa: ANN401 (of the step)
        """Take a step of `EditedRig` by its name, such as ``undo``; the camera that it was about is chosen."""
        edit = getattr(self.state.edits, step)(*words, **numbers)
        self.chosen = edit.camera
        with self._one_render():
            self._move()
            self._draw(*_PARTS, "visibility", *(["outcomes"] if "outcomes" in self.shows else []))
            self._redraw()

    def edit_chosen(self, step: str, *words: Any, **numbers: Any) -> None:  # noqa: ANN401 (of the step)
        """Take a step about the chosen camera, if there is one."""
        if self.chosen is not None:
            self.edit(step, self.chosen, *words, **numbers)

    def change_module(self) -> None:
        """Put the next module in the place of the chosen camera."""
        names = list(self.state.edits.modules)
        if self.chosen is not None and names:
            old = self.state.rig.cameras[self.chosen].module
            self.edit_chosen("set_module", names[(names.index(old) + 1) % len(names) if old in names else 0])

    def put(self) -> None:
        """From now on the next click on the body puts a camera there; once more, and it does not."""
        self.is_putting = not self.is_putting

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

    def drop(self, camera: int, position_m: np.ndarray, outward: np.ndarray | None = None) -> None:
        """Move a camera and let go of it: everything follows."""
        self.edit("move", camera, position_m, outward)

    def turn(self, angle_deg: float) -> None:
        """Turn the chosen camera to the left by an angle [degrees]."""
        if self.chosen is not None:
            self.edit_chosen("pose", yaw_deg=np.degrees(self.state.rig.cameras[self.chosen].yaw_rad) + angle_deg)

    def save(self) -> Path:
        """Write the rig as it is now, to a file of its own: a number follows the name where that is taken."""
        path, number = self.save_to, 1
        while path.is_file():
            number += 1
            path = self.save_to.with_stem(f"{self.save_to.stem}-{number}")
        self.state.edits.save(path)
        with self._one_render():
            self._say("\n".join([*self._lines(), f"wrote {path}"]))
        return path

    # ------------------------------------------------------------------------------------------------ controls

    @property
    def keys(self) -> dict[str, tuple[str, Callable[[], object]]]:
        """What keys do, in words and as functions. VTK has uses of its own for w, s, r, f, p, u, e, a and 3."""
        known = self.state.known
        body = "body: zones, one more camera, off" if "further" in known else "body: zones, off"
        found: dict[str, tuple[str, Callable[[], object]]] = {
            "n": ("next scene", lambda: self.show_scene(self.state.scene_index + 1)),
            "c": ("coverage: child, adult, ground, off", self.cycle_coverage),
        }
        for name, switch in SWITCHES.items():
            if switch.needs is None or switch.needs in known:
                found[switch.key] = (switch.words, partial(self.toggle, name))
        found["z"] = (body, self.cycle_body)
        if "modules" in known:
            found["o"] = ("other module", self.change_module)
        found["Left"] = ("turn left", lambda: self.turn(TURN_DEG))
        found["Right"] = ("turn right", lambda: self.turn(-TURN_DEG))
        found["b"] = ("put a camera: click the body", self.put)
        for key, step in {"h": "copy", "x": "mirror", "Delete": "remove"}.items():
            found[key] = step, partial(self.edit_chosen, step)
        found["BackSpace"], found["y"] = ("undo", partial(self.edit, "undo")), ("redo", partial(self.edit, "redo"))
        found["Return"] = ("write the rig", self.save)
        return found

    def _add_controls(self) -> None:
        plotter, count = self.plotter, len(self.state.frames)
        for index in range(len(self.state.rig.cameras)):
            self._add_ball(index)
        plotter.render_window.AddObserver("WindowResizeEvent", lambda *_: self._put_view())
        self._listen("LeftButtonPressEvent", self._pressed)
        self._listen("MouseMoveEvent", self._moved)
        self._listen("LeftButtonReleaseEvent", self._released)
        if self._panel is not None:
            return
        said = ["click a ball: look through the camera", "drag it: move the camera"]
        said += [*(f"{key}: {words}" for key, (words, _) in self.keys.items()), "q: quit"]
        lines = textwrap.fill("   ".join(each.replace(" ", "\xa0") for each in said), _HELP_CHARACTERS)
        add_text(plotter, lines.replace("\xa0", " "), (0.02, 0.012), size=8, name="help")
        if count > 1:
            place = {"pointa": (0.66, 0.93), "pointb": (0.97, 0.93), "color": hex_colour(INK_RGB), "fmt": "%.0f"}
            plotter.add_slider_widget(
                lambda value: self.go_to(round(value)),
                (0, count - 1),
                value=self.state.frame,
                title="iteration",
                interaction_event="end",
                **place,
            )
        for key, (_, action) in self.keys.items():
            plotter.clear_events_for_key(key, raise_on_missing=False)
            plotter.add_key_event(key, partial(self._attempt, action))

    def _attempt(self, action: Callable[[], object]) -> None:
        try:
            action()
        except InputError as error:
            with self._one_render():
                self._say(textwrap.fill(str(error), _MESSAGE_CHARACTERS))

    def _listen(self, event: str, answer: Callable[[], bool]) -> None:
        """Hear of the mouse before the view does, which does not hear of what is answered."""
        interactor = self.plotter.iren.interactor

        def hear(*_: object) -> None:
            if answer():
                command.AbortFlagOn()

        command = interactor.GetCommand(interactor.AddObserver(event, hear, 1.0))

    def _add_ball(self, index: int) -> None:
        camera = self.state.rig.cameras[index]
        ball = load_pyvista().Sphere(radius=_BALL_RADIUS_M, center=camera.position_m)
        name = f"rig/{camera.name}/ball"
        self.plotter.add_mesh(ball, color=hex_colour(camera_rgb(index)), ambient=0.4, name=name, reset_camera=False)

    def _add_label(self, index: int) -> Any:  # noqa: ANN401 (a pyvista.Label)
        camera = self.state.rig.cameras[index]
        label = load_pyvista().Label(f" {camera.name} ", position=tuple(label_point_m(camera)), size=14)
        label.prop.color = "white"
        label.prop.background_color = hex_colour(camera_rgb(index))
        label.prop.background_opacity = 0.9
        label.prop.justification_horizontal = "center"
        self.plotter.add_actor(label, name=f"label/{camera.name}", reset_camera=False, pickable=False)
        return label

    # ------------------------------------------------------------------------------------------------ what is drawn

    @contextmanager
    def _one_render(self) -> Iterator[None]:
        with no_render(self.plotter):
            yield
        self.plotter.render()

    def _mouse_px(self) -> np.ndarray:
        return np.array(self.plotter.iren.interactor.GetEventPosition(), np.float64)

    def _shown_px(self, point_m: np.ndarray) -> np.ndarray:
        return np.abs(project_px(self.plotter, point_m) - [0.0, self.plotter.window_size[1]])

    def _pointed(self) -> tuple[np.ndarray, np.ndarray | None] | None:
        """Where on the body the mouse points at, and the normal there; beside it as deep as the camera that is held."""
        renderer, ends = self.plotter.renderer, []
        for depth in (0.0, 1.0):
            renderer.SetDisplayPoint(*(self._mouse_px() + self._off_px), depth)
            renderer.DisplayToWorld()
            *end, scale = renderer.GetWorldPoint()
            ends.append(np.divide(end, scale))
        near, ray = ends[0], ends[1] - ends[0]
        found = self.state.skin_at(np.array([near, ray / np.linalg.norm(ray)]))
        if found is not None or self._held is None:
            return found
        ahead = np.array(self.plotter.camera.direction)
        depth = (self.state.edits.foot_m(self._held) - near) @ ahead / (ray @ ahead)
        return near + depth * ray, None

    def _pressed(self) -> bool:
        """Take the ball under the mouse, if there is one; where a camera is put, nothing else hears of the click."""
        if self.is_putting:
            return self._pointed() is not None
        position_m = np.array([camera.position_m for camera in self.state.rig.cameras])
        rim_m = position_m + _BALL_RADIUS_M * np.array(self.plotter.camera.up)
        middle_px, rim_px = self._shown_px(position_m), self._shown_px(rim_m)
        size_px = np.maximum(np.linalg.norm(rim_px - middle_px, axis=1), _BALL_PX)
        away = np.linalg.norm(middle_px - self._mouse_px(), axis=1) / size_px
        camera = int(away.argmin())
        if away[camera] > 1.0:
            return False
        self._off_px = self._shown_px(self.state.edits.foot_m(camera)[None])[0] - self._mouse_px()
        self._held, self._is_moved = camera, False
        self.choose(camera)
        return True

    def _moved(self) -> bool:
        if self._held is None:
            return False
        found, self._is_moved = self._pointed(), True
        assert found is not None
        with no_render(self.plotter):
            self._follow(self._held, *found)
        self.plotter.iren.interactor.Render()
        return True

    def _released(self) -> bool:
        held, found = self._held, self._pointed()
        if held is not None and found is not None:
            if self._is_moved:
                self.drop(held, *found)
            self._held, self._off_px = None, np.zeros(2)
        elif self.is_putting and found is not None:
            self.is_putting = False
            self._attempt(partial(self.edit, "put", *found, like=self.chosen or 0))
        else:
            return False
        return True

    def _follow(self, camera: int, position_m: np.ndarray, outward: np.ndarray | None = None) -> None:
        was_known = self.state.descent is not None or self.state.further is not None
        self.state.edits.move(camera, position_m, outward, held=True)
        self._draw_camera(camera)
        if was_known:
            self._draw(*_PARTS)
        if "visibility" in self.shows:
            self._draw_visibility([camera], rays=_DRAGGED_RAYS_PX)
        self._redraw(detector=False)

    def _move(self) -> None:
        cameras = self.state.rig.cameras
        if self.chosen is not None and self.chosen >= len(cameras):
            self.chosen = None
        if [each.name for each in cameras] != [each.name for each in self._drawn]:
            for old in self._drawn:
                remove(self.plotter, f"rig/{old.name}")
                for name in (f"label/{old.name}", f"visibility/{old.name}"):
                    self.plotter.remove_actor(name)
            self._drawn = list(cameras)
            for index, camera in enumerate(cameras):
                add_camera(self.plotter, camera, index)
                self._add_ball(index)
            self._labels = [self._add_label(index) for index in range(len(cameras))]
        for index in range(len(cameras)):
            self._draw_camera(index)

    def _draw_camera(self, index: int) -> None:
        camera, drawn = self.state.rig.cameras[index], self._drawn[index]
        if camera.model == drawn.model:
            moved = camera.ego_from_camera @ np.linalg.inv(drawn.ego_from_camera)
            for name, actor in self.plotter.actors.items():
                if name.startswith(f"rig/{camera.name}/"):
                    actor.user_matrix = moved
        else:
            remove(self.plotter, f"rig/{camera.name}")
            add_camera(self.plotter, camera, index)
            self._add_ball(index)
            self._drawn[index] = camera
        self._labels[index].position = tuple(label_point_m(camera))

    def _draw(self, *parts: str) -> None:
        state, plotter, shows = self.state, self.plotter, self.shows
        for part in parts:
            if part == "rings":
                add_range_rings(plotter, state.scene if part in shows else None)
            elif part == "outcomes":
                remove(plotter, "scene")
                add_scene(plotter, state.scene, state.observation.outcomes if part in shows else None)
            elif part == "visibility":
                self._draw_visibility(range(len(state.rig.cameras)))
            elif part == "descent":
                add_descent(plotter, state.rig, state.descent if part in shows else None, state.surface)
            elif part == "further" and "further" in state.known:
                add_further_cameras(plotter, state.further if part in shows else None)
            elif part == "body":  # zones stay where they are, whatever becomes of the cameras
                add_zones(plotter, state.surface if self.shown_on_body == "zones" else None, bottom=_BOTTOM)
            if part in ("body", "gain") and "further" in state.known:
                further = state.further if self.shown_on_body == "gain" else None
                add_gain(plotter, state.surface, further, at=(0.325, _BOTTOM))

    def _draw_visibility(self, cameras: Iterable[int], *, rays: int = RAYS_PX) -> None:
        for index in cameras:
            camera = self.state.rig.cameras[index]
            if "visibility" in self.shows:
                add_visibility(self.plotter, camera, index, self.state.packed, rays=rays)
            else:
                self.plotter.remove_actor(f"visibility/{camera.name}")

    def _redraw(self, *, detector: bool = True) -> None:
        self._draw_coverage()
        self._say("\n".join(self._lines(detector=detector)))
        self._draw_view(detector=detector)
        if detector:
            add_requirements(self.plotter, self.state.requirements if "requirements" in self.shows else None)

    def _lines(self, *, detector: bool = True) -> list[str]:
        lines = self.state.lines
        if self.shown_height is not None:
            coverage, height_m = self._shown_coverage(self.shown_height)
            lines.append(f"{patch_words(height_m)}: seen by no camera (red), by one, two or more (blue)")
            if height_m == PATCH_M:
                shares = [float(coverage.share_seen_by(count, radius_m=NEAR_M)[0]) for count in (1, 2, 3)]
                seen = ", ".join(f"{share:.1%} by {count}" for count, share in zip((1, 2, 3), shares, strict=True))
                lines.append(f"the ground within {NEAR_M:g} m: {seen} cameras or more")
        chosen = None if self.chosen is None else self.state.rig.cameras[self.chosen]
        if self._panel is None:  # which shows these in its own way
            broken = [each for each in self.state.edits.edit.findings if each.is_kept is False]
            lines += [f"{each.about} {each.found}, {each.asked} asked" for each in broken]
            if chosen is not None and chosen.module is not None:
                lines.append(f"{chosen.name}: {chosen.module}")
        met = self.state.requirements if detector and "requirements" in self.shows else None
        if met is not None:
            lines.append(f"requirements: {met.is_point_met.mean():.1%} of points met (discs), the rest has crosses")
        if detector and ("outcomes" in self.shows or self.chosen is not None):
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
            self._numbers = add_text(self.plotter, text, (0.02, 0.80), size=10, name="numbers")
        self._numbers.input = text

    def _draw_view(self, *, detector: bool = True) -> None:
        if self.chosen is None:
            self.plotter.remove_actor("view")
            self._view = None
            return
        image = _image(self.view_rgb(detector=detector))
        if self._view is None:
            self._view = _image_actor()
            self.plotter.add_actor(self._view, name="view")
        self._view.GetMapper().SetInputData(image)
        self._put_view()

    def _put_view(self) -> None:
        if self._view is not None:
            width_px = self._view.GetMapper().GetInput().GetDimensions()[0]
            self._view.SetPosition(self.plotter.render_window.GetSize()[0] - 16 - width_px, 44)

    def view_rgb(self, *, detector: bool = True) -> np.ndarray:
        """The image of the chosen camera: green boxes are found, orange ones missed, red ones false; uint8."""
        from warpav.detection import render_images
        from warpav.view.figures._images import own_body_tinted

        assert self.chosen is not None
        camera, packed = self.state.rig.cameras[self.chosen], self.state.packed
        if not detector:
            scale = _VIEW_PX / max(camera.model.width_px, camera.model.height_px)
            size_px = (max(8, round(scale * each)) for each in (camera.model.width_px, camera.model.height_px))
            camera = replace(camera, model=camera.model.resized(*size_px))
        [image] = render_images(packed, [camera], device=str(packed.raster.device))
        observed = self.state.observation.cameras[self.chosen] if detector else None
        shown_rgb = own_body_tinted(image.rgb if observed is None else observed.image_rgb, image.object_index)
        return _framed_view(shown_rgb, observed, camera_rgb(self.chosen))


def _framed_view(
    shown_rgb: np.ndarray, observed: CameraObservation | None, border_rgb: tuple[int, int, int]
) -> np.ndarray:
    import cv2

    scale = _VIEW_PX / max(shown_rgb.shape[:2])
    enlarged = cv2.resize(shown_rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)

    def draw(box: np.ndarray, rgb: tuple[int, int, int], width: int) -> None:
        x0, y0, x1, y1 = (int(round(float(value) * scale)) for value in box)
        cv2.rectangle(enlarged, (x0, y0), (x1, y1), rgb, width)

    if observed is not None:
        matched = set(observed.match.tolist())
        for k, box in enumerate(observed.detections.box_px):
            draw(box, TRUE_POSITIVE_RGB if k in matched else FALSE_POSITIVE_RGB, 2)
        for box, found in zip(observed.truth_box_px, observed.match, strict=True):
            if found < 0 and np.isfinite(box).all():
                draw(box, MISS_RGB, 2)
    return cv2.copyMakeBorder(enlarged, 4, 4, 4, 4, cv2.BORDER_CONSTANT, value=border_rgb)


def _image(image_rgb: np.ndarray) -> Any:  # noqa: ANN401 (a pyvista.ImageData)
    rows, columns = image_rgb.shape[:2]
    grid = load_pyvista().ImageData(dimensions=(columns, rows, 1))
    grid.point_data["rgb"] = np.ascontiguousarray(image_rgb[::-1]).reshape(-1, 3)
    grid.set_active_scalars("rgb")
    return grid


def _image_actor() -> Any:  # noqa: ANN401 (a vtkActor2D)
    from vtkmodules.vtkRenderingCore import vtkActor2D, vtkImageMapper

    mapper = vtkImageMapper()
    mapper.SetColorWindow(255.0)
    mapper.SetColorLevel(127.5)
    actor = vtkActor2D()
    actor.SetMapper(mapper)
    return actor
