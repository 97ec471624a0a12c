"""The editor of rigs in a browser: this machine draws, the browser shows the images and sends back what the mouse does.

Only this machine is listened to, and only who knows the token is answered. From elsewhere an SSH tunnel leads here.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
import os
import secrets
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import ArgumentError, InputError, install_text
from warpav.core.executor import Job, Outcome
from warpav.scene import DeviceScene
from warpav.sight import Ground
from warpav.view._editing import NUMBERS
from warpav.view._inspector import SHOWN_HEIGHTS_M, SWITCHES
from warpav.view._layers import add_coverage, no_render, patch_words, remove
from warpav.view._output import Canvas
from warpav.view._palette import NOT_ALONE_RGB, alone, camera_rgb, hex_colour
from warpav.view._picture import WIDE_ZOOM, Picture, add_camera, add_scene, rig_plotter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from warpav.rig import Rig
    from warpav.scene import Scene
    from warpav.view._editing import RigScore
    from warpav.view._inspector import Inspector

    Scorer = Callable[[Rig, Sequence[int], Callable[[], None]], RigScore]

    Server = Any

_HOST = "127.0.0.1"
"""The one address that is listened to."""

DEFAULT_PORT = 8765

_INTERACTIVE_QUALITY, _STILL_QUALITY = 70, 92
"""Of JPEG images while the mouse moves, and after it has."""

_IMAGES_A_SECOND = 40.0
"""Sent at most while the mouse moves."""

_AGAIN_S = 0.3
"""When the image after an action is sent once more, and how often a search is asked for news [s]."""

_SCORED = 8
"""Scenes of the score at first."""

_FIRST_SCORE_S, _QUIET_S = 2.0, 0.25
"""How long the score waits for the first picture, and after a move of the mouse with a camera held [s]."""

_SEARCHES = {"polish": "polish from here", "one_more": "best place for one more"}


def new_token() -> str:
    """A token that nobody guesses."""
    return secrets.token_urlsafe(24)


class _Page:
    """A page of a server on this machine: a panel of controls beside what a plotter shows."""

    def __init__(self, *, token: str, name: str) -> None:
        self._server, self._html, self._v = _new_server()
        self.token, self.port = token, 0
        self.state: Any = self._server.state
        self.state.update({"trame__title": f"{name} - warpav", "rig_name": name, "message": ""})

    @property
    def url(self) -> str:
        """The address to open."""
        return f"http://{_HOST}:{self.port}/index.html?secret={self.token}"

    def serve(self, *, port: int = DEFAULT_PORT, ready: Callable[[str, int], None] | None = None) -> None:
        """Answer browsers until this is interrupted."""

        def has_started(**_: Any) -> None:  # noqa: ANN401 (whatever the server tells)
            self.port = int(self._server.port)
            if ready is not None:
                ready(self.url, self.port)
            for each in self._server.protocol.getLinkProtocols():
                if hasattr(each, "min_frame_rate"):  # it would wait between images that take longer
                    each.min_frame_rate = each.max_frame_rate = each.target_frame_rate = _IMAGES_A_SECOND
            self._has_begun()

        self._server.controller.on_server_ready.add(has_started)
        # the server reads the words of the command line unless it is given others
        with _environment("TRAME_ARGS", f"--server --nosignalhandlers --no-ws-compress --authKey={self.token}"):
            try:
                asyncio.run(self._run(port))
            except OSError as error:
                raise ArgumentError(
                    "port", f"expected one that is free, got {port}: {error.strerror}; try another one"
                ) from None
            finally:
                self._has_ended()

    async def _run(self, port: int) -> None:
        for name in ("wslink", "aiohttp.server"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # a tab that is closed is no error
        await self._server.start(
            port=port,
            host=_HOST,
            open_browser=False,
            show_connection_info=False,
            disable_logging=True,
            exec_mode="coroutine",
            timeout=0,
        )

    def _follow(self) -> None:
        """Show in the controls what the plotter shows."""

    def _has_begun(self) -> None:
        """Browsers are answered from now on."""

    def _has_ended(self) -> None:
        """They no longer are."""

    def _do(self, action: Callable[..., object], *words: Any) -> None:  # noqa: ANN401 (of the action)
        """Do what a control stands for; the page follows, and says what keeps it from being done."""
        self.state.message = ""
        try:
            action(*words)
        except InputError as error:
            self.state.message = str(error)
        self._follow()
        self._update()
        # an image is left out while the browser has not yet answered for the one before
        asyncio.get_running_loop().call_later(_AGAIN_S, self._update)

    @contextlib.contextmanager
    def _panel_beside(self, plotter: Any) -> Iterator[None]:  # noqa: ANN401 (of pyvista)
        from trame.ui.vuetify3 import VAppLayout
        from trame.widgets import vtk

        html, v = self._html, self._v
        plotter.show(auto_close=False, interactive=False)
        # every image that is sent is drawn for it: one more for each move of the mouse would take twice the time
        plotter.iren.interactor.EnableRenderOff()
        with VAppLayout(self._server, full_height=True) as layout:
            layout.root.theme = "light"
            with v.VNavigationDrawer(permanent=True, width=_PANEL_PX, classes="pa-3"):
                yield
            with v.VMain(), html.Div(style="position: relative; width: 100%; height: 100%"):
                view = vtk.VtkRemoteView(
                    plotter.render_window,
                    interactive_ratio=1,
                    still_ratio=1,
                    interactive_quality=_INTERACTIVE_QUALITY,
                    still_quality=_STILL_QUALITY,
                )
        self._update = view.update

    def _make_message(self) -> None:
        self._html.Div("{{ message }}", v_if="message", classes="text-caption bg-amber-lighten-4 pa-1 my-1 message")

    def _select(
        self,
        name: str,
        label: str,
        action: Callable[[Any], object],
        choices: list[tuple[Any, str]],
        **options: Any,  # noqa: ANN401 (of Vuetify)
    ) -> Any:  # noqa: ANN401 (a widget)
        items = (f"{name}_choices", [{"value": value, "title": title} for value, title in choices])
        chosen = (partial(self._do, action), "[$event]")
        options |= {"label": label, "items": items, "classes": "my-2", **_SMALL}
        return self._v.VSelect(v_model=(name,), update_modelValue=chosen, **options)

    def _button(self, label: str, action: Callable[[], object], **options: Any) -> None:  # noqa: ANN401 (of Vuetify)
        self._v.VBtn(label, size="small", classes="my-1 mr-1 text-none", click=partial(self._do, action), **options)


class BrowserInspector(_Page):
    """An inspector as a page of a server on this machine."""

    def __init__(
        self,
        inspector_of: Callable[[Callable[[str], None]], Inspector],
        *,
        token: str,
        name: str = "rig",
        scorer_of: Callable[[Callable[[int], Scene]], Scorer] | None = None,
        search: Callable[..., None] | None = None,
    ) -> None:
        """Make the page; nothing is served yet.

        Args:
            name: Of the rig, for the title of the tab.
            scorer_of: Gives what scores rigs on scenes, by their numbers; None: no score.
            search: As `warpav.runs._editor.search_from`; None: no searches.
        """
        super().__init__(token=token, name=name)
        self.state.update({"tab": "edit", "lines": []})
        self.state.update({"score": None, "is_scoring": False, "searched": "", "found": "", "share": 0.0})
        self._search, self._job, self._last = search, None, None
        self._beside, self._scoring, self._quiet_until, self._is_judged = ThreadPoolExecutor(1), 0, 0.0, False
        self._scored: tuple[Any, ...] = ()
        self.inspector = inspector_of(self._tell)
        shown = self.inspector.state
        self.state.scored = list(range(min(_SCORED, shown.scene_count)))
        self._scorer = scorer_of and scorer_of(shown.scene_of)
        self._make_page()
        self._follow()

    def _has_begun(self) -> None:
        asyncio.get_running_loop().call_later(_FIRST_SCORE_S, self._judge)

    def _has_ended(self) -> None:
        self._scoring += 1
        if self._job is not None:
            self._job.stop()

    # ------------------------------------------------------------------------------------------------- what users do

    def _typed(self, number: str, text: str) -> None:
        try:
            self.inspector.edit_chosen("pose", **{number: float(text)})
        except ValueError:
            raise InputError(f"{number}: expected a finite number, got {text!r}") from None

    def _rescore(self, scenes: list[int]) -> None:
        self.state.scored = scenes

    def _write(self) -> None:
        self.state.message = f"wrote {self.inspector.save()}"

    def _look_through(self, camera: int) -> None:
        self.inspector.choose(None if camera == self.inspector.chosen else camera)

    # --------------------------------------------------------------------------------------- in the background

    def _judge(self) -> None:
        self._is_judged = True
        self._follow()

    def _score(self) -> None:
        """Score the rig as it is now, beside all else; what is scored for another rig ends."""
        wanted = (self.inspector.state.rig, tuple(self.state.scored))
        if self._scorer is None or wanted == self._scored or not wanted[1]:
            return
        loop, scorer = asyncio.get_running_loop(), self._scorer
        self._scored, self._scoring = wanted, self._scoring + 1
        number = self._scoring

        def breathe() -> None:
            while number == self._scoring and time.monotonic() < self._quiet_until:
                time.sleep(0.02)
            if number != self._scoring:
                raise InterruptedError

        def show(done: Future[RigScore]) -> None:
            error = done.exception()
            with self.state as state:
                state.is_scoring = False
                state.message = f"score: {error}" if error else state.message
                state.score = state.score if error else _score_words(done.result())

        self.state.is_scoring = True
        done = self._beside.submit(scorer, *wanted, breathe)
        done.add_done_callback(lambda done: number == self._scoring and loop.call_soon_threadsafe(show, done))

    def _begin(self, what: str) -> None:
        if self._job is None and self._search is not None:
            self.state.update({"searched": _SEARCHES[what], "share": 0.0, "found": "starts"})
            self._last = None
            self._job = Job(self._search, what, self.inspector.state.rig, tuple(self.state.scored))
            asyncio.get_running_loop().call_later(_AGAIN_S, self._watch)

    def _watch(self) -> None:
        if self._job is None:
            return
        with self.state as state:
            for said in self._job.news():
                if isinstance(said, Outcome):
                    state.message = said.error or ""
                    self._end()
                    return
                state.found, state.share, rig = said[0], 100.0 * said[1], said[2]
                self._last = rig or self._last
        asyncio.get_running_loop().call_later(_AGAIN_S, self._watch)

    def _end(self) -> None:
        if self._job is not None:
            self._job.stop()
            self._job, self.state.searched = None, ""
            if self._last is not None:
                self._do(self.inspector.edit, "replace", self._last)

    # ------------------------------------------------------------------------------------------------- what is shown

    def _tell(self, text: str) -> None:
        self.state.lines = text.splitlines()
        if hasattr(self, "_update"):
            self._quiet_until = time.monotonic() + _QUIET_S
            self._follow()

    def _follow(self) -> None:
        inspector, shown = self.inspector, self.inspector.state
        edits, chosen = shown.edits, inspector.chosen
        with self.state as state:
            state.coverage = "off" if inspector.shown_height is None else inspector.shown_height
            state.on_body = inspector.shown_on_body or "off"
            state.frame, state.scene = shown.frame, shown.scene_index
            state.chosen = -1 if chosen is None else chosen
            state.can_undo, state.can_redo, state.is_putting = (
                bool(edits.past),
                bool(edits.future),
                inspector.is_putting,
            )
            for name in SWITCHES:
                state[f"shows_{name}"] = name in inspector.shows
            state.cameras = [
                {
                    "name": camera.name,
                    "module": camera.module or "",
                    "colour": hex_colour(camera_rgb(index)),
                    "own_body": f"own body {share:.0%}",
                    "image": f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}",
                }
                for index, (camera, (jpeg, share)) in enumerate(zip(shown.rig.cameras, shown.images, strict=True))
            ]
            if chosen is not None:
                camera = shown.rig.cameras[chosen]
                angles_deg = np.degrees([camera.yaw_rad, camera.pitch_rad, camera.roll_rad])
                for name, value in zip(NUMBERS, [*camera.position_m, *angles_deg], strict=True):
                    state[name] = f"{round(float(value), 3 if name.endswith('_m') else 1) + 0.0:g}"
                state.module = camera.module
            state.findings = [each._asdict() for each in (edits.edit.findings if self._is_judged else ())]
        if self._is_judged:
            self._score()

    def _make_page(self) -> None:
        html, v = self._html, self._v
        with self._panel_beside(self.inspector.plotter):
            with html.Div(classes="d-flex align-center"):
                html.Div("{{ rig_name }}", classes="text-h6 text-truncate flex-grow-1", title=("rig_name",))
                style = {"variant": "text", "density": "comfortable"}
                for step in ("undo", "redo"):
                    options = {"icon": f"mdi-{step}", "title": step, "disabled": (f"!can_{step}",), **style}
                    self._button("", partial(self.inspector.edit, step), **options)
                self._button("", self._write, icon="mdi-content-save", title="save", **style)
            self._make_message()
            with v.VTabs(v_model=("tab",), density="compact", grow=True, show_arrows=False, classes="mb-2"):
                broken = "{{ findings.filter(each => each.is_kept === false).length }}"
                for tab, title in {"edit": "edit", "rules": f"rules ({broken} broken)", "view": "view"}.items():
                    v.VTab(title, value=tab, classes="text-none px-2", min_width=0)
            with html.Div(v_show="tab === 'edit'"):
                self._make_edit_tab()
            with html.Div(v_show="tab === 'rules'"):
                self._make_findings("findings")
            with html.Div(v_show="tab === 'view'"):
                self._make_view_tab()
                html.Div("{{ line }}", v_for="line, k in lines", key="k", classes="text-caption line")

    def _make_edit_tab(self) -> None:
        html, v = self._html, self._v
        if self._scorer is not None:
            with html.Div(classes="d-flex score", v_if="score", style=("`opacity: ${is_scoring ? 0.4 : 1}`",)):
                for number, words in {"expected": "expected misses of 100", "missed": "detector misses of 100"}.items():
                    with html.Div(style="width: 50%; line-height: 1.2"):
                        html.Div("{{ score." + number + " }}", classes="text-h6", style="line-height: 1.2")
                        html.Div(words, classes="text-caption", style="line-height: 1.1")
            scored = self._select("scored", "scenes of the score", self._rescore, self._scenes, multiple=True)
            with scored, v.Template(v_slot_selection="{ index }"):
                html.Span("{{ scored.length }} of {{ scored_choices.length }}{{ score?.of }}", v_if="index === 0")
        html.Div("{{ line }}", v_for="line, k in lines.slice(1, 3)", key="k", classes="text-caption")
        self._make_findings("findings.filter(each => each.is_kept !== true)")
        item = {"v_for": "camera, k in cameras", "key": "camera.name", "active": ("k === chosen",)}
        with (
            v.VList(density="compact", classes="py-0", style="max-height: 232px; overflow-y: auto"),
            v.VListItem(click=(partial(self._do, self._look_through), "[k]"), classes="camera px-1", **item),
        ):
            with v.Template(v_slot_prepend=True):
                html.Img(src=("camera.image",), style=(_THUMBNAIL,))
            with html.Div(classes="d-flex justify-space-between"):
                html.Div("{{ camera.name }}", classes="text-body-2 text-truncate name")
                html.Div("{{ camera.own_body }}", classes="text-caption", title="share of its image")
            html.Div("{{ camera.module }}", classes="text-caption text-truncate", v_if="camera.module")
        with html.Div(v_if="chosen >= 0", classes="mt-1"):
            with v.VRow(dense=True):
                for name in NUMBERS:
                    label, step = name.replace("_", " [") + "]", 0.01 if name.endswith("_m") else 1
                    typed = (partial(self._do, self._typed), f"['{name}', $event.target.value]")
                    with v.VCol(cols=4):
                        options = {"label": label, "type": "number", "step": step, "classes": name, "change": typed}
                        v.VTextField(v_model=(name, ""), **options, **_SMALL)
            if modules := self.inspector.state.edits.modules:
                action = partial(self.inspector.edit_chosen, "set_module")
                self._select("module", "module", action, [(name, name) for name in modules])
            with html.Div(classes="d-flex"):
                for step in ("copy", "mirror", "remove"):
                    self._button(step, partial(self.inspector.edit_chosen, step))
        self._button("{{ is_putting ? 'click the body ...' : 'put a camera' }}", self.inspector.put, width=_WIDE_PX)
        if self._search is not None:
            for what, words in _SEARCHES.items():
                self._button(words, partial(self._begin, what), width=_WIDE_PX, disabled=("searched !== ''",))
            with html.Div(v_if="searched", classes="search"):
                v.VProgressLinear(model_value=("share",), height=6, color="primary", classes="my-1")
                html.Div("{{ searched }}: {{ found }}, {{ share.toFixed(0) }} %", classes="text-caption")
                self._button("stop, take the best so far", self._end, width=_WIDE_PX)
        html.Div("Click a ball to look through its camera, drag it along the skin.", classes="text-caption mt-2")

    def _make_findings(self, which: str) -> None:
        colour = "each.is_kept === false ? 'error' : each.is_kept ? 'success' : 'grey'"
        icon = "{{ each.is_kept === null ? 'mdi-information' : `mdi-${each.is_kept ? 'check' : 'alert'}-circle` }}"
        words = "{{ each.about }}: {{ each.found }}{{ each.asked ? ', ' + each.asked : '' }}"
        with self._html.Div(v_for=f"each, k in {which}", key="k", classes="d-flex text-caption finding"):
            self._v.VIcon(icon, color=(colour,), size="small", classes="mr-1 mt-1")
            self._html.Div(words, style="line-height: 1.25")

    def _make_view_tab(self) -> None:
        inspector, shown = self.inspector, self.inspector.state
        if shown.scene_count > 1:
            self._select("scene", "scene", lambda number: inspector.show_scene(int(number)), self._scenes)
        if len(shown.frames) > 1:
            action = partial(self._do, lambda number: inspector.go_to(int(number)))
            ends = {"min": 0, "max": len(shown.frames) - 1, "step": 1, "end": (action, "[$event]")}
            self._v.VSlider(v_model=("frame",), label="iteration", thumb_label=True, **ends, **_SMALL)
        heights = [(k, patch_words(height_m)) for k, height_m in enumerate(SHOWN_HEIGHTS_M)]
        self._select("coverage", "coverage", partial(_or_off, inspector.show_coverage), [*heights, _OFF])
        gain = [("gain", SWITCHES["further"].words)] if "further" in shown.known else []
        on_body = [("zones", "zones"), *gain, _OFF]
        self._select("on_body", "body", partial(_or_off, inspector.show_on_body), on_body)
        for name, switch in SWITCHES.items():
            if switch.needs is None or switch.needs in shown.known:
                toggled = partial(self._do, inspector.toggle, name)
                options = {"label": switch.words, "color": "primary", "classes": "ml-2", **_SMALL}
                self._v.VSwitch(v_model=(f"shows_{name}",), update_modelValue=toggled, **options)

    @property
    def _scenes(self) -> list[tuple[Any, str]]:
        return [(k, f"scene {k + 1}") for k in range(self.inspector.state.scene_count)]


@dataclass(frozen=True, eq=False)
class RigsSideBySide:
    """Rigs on the same scenes, and what they miss there."""

    rigs: Mapping[str, Rig]
    scenes: Sequence[Scene]
    found: Sequence[np.ndarray]  # of each scene, whether a rig finds a road user, bool [rig, road user]
    verdict: str
    table: str  # HTML
    device: str = "cpu"


class BrowserComparison(_Page):
    """Rigs in one view: what of ground and road users which of them alone sees, and what they miss."""

    def __init__(self, compared: Callable[[], RigsSideBySide], *, token: str, name: str) -> None:
        """Compare the rigs, and make the page; nothing is served yet."""
        super().__init__(token=token, name=name)
        self.compared, self.hidden = compared(), set[int]()
        self._alone = [int((alone(found) < len(found)).sum()) for found in self.compared.found]
        self.shown, rigs = {"scene": int(np.argmax(self._alone)), "height": 0}, self.compared.rigs
        self._colours = {f"{name} alone": camera_rgb(k) for k, name in enumerate(rigs)} | dict(
            zip(("both" if len(rigs) == 2 else "two or more", "none"), NOT_ALONE_RGB, strict=True)
        )
        self.plotter = rig_plotter(Picture(scene=self._scene), Canvas(zoom=WIDE_ZOOM, off_screen=True))
        self.plotter.disable_anti_aliasing()
        self.plotter.renderer.SetUseOIT(False)
        for k, rig in enumerate(rigs.values()):
            for camera in rig.cameras:
                add_camera(self.plotter, replace(camera, name=f"{k}.{camera.name}"), k)
        self._make_page()
        self._follow()

    @property
    def _scene(self) -> Scene:
        return self.compared.scenes[self.shown["scene"]]

    def _show(self, name: str, value: int) -> None:
        self.shown[name] = value

    def _follow(self) -> None:
        plotter, rigs, height_m = self.plotter, self.compared.rigs, SHOWN_HEIGHTS_M[self.shown["height"]]
        cameras = [camera for rig in rigs.values() for camera in rig.cameras]
        ground = Ground.around(DeviceScene.pack(self._scene, device=self.compared.device))
        coverage = ground.coverage(cameras, heights_m=(height_m,))
        firsts = np.cumsum([0, *(len(rig.cameras) for rig in rigs.values())])[:-1]
        seen_by = alone(np.logical_or.reduceat(coverage.is_seen[:, 0], firsts))
        found_by = alone(self.compared.found[self.shown["scene"]])
        with no_render(plotter):
            remove(plotter, "scene")
            words = list(self._colours)
            add_scene(plotter, self._scene, [words[k] for k in found_by], colours=self._colours)
            surface = add_coverage(plotter, coverage, legend=False)
            rgb = np.array([*self._colours.values()], np.uint8)
            surface.cell_data["RGBA"][:, :3] = rgb[seen_by[coverage.is_open[0]]]
            for name, actor in plotter.actors.items():
                if name.startswith("rig/"):
                    actor.visibility = int(name.split("/")[1].split(".")[0]) not in self.hidden
        areas_m2 = np.bincount(seen_by[coverage.is_open[0]], minlength=len(rgb)) * ground.cell_m**2
        counts = np.bincount(found_by, minlength=len(rgb))
        with self.state as state:
            state.update(self.shown)
            state.seen = [
                {"who": who, "colour": hex_colour(colour), "area": f"{area_m2:.0f} m²", "users": int(count)}
                for (who, colour), area_m2, count in zip(self._colours.items(), areas_m2, counts, strict=True)
            ]

    def _make_page(self) -> None:
        from trame.widgets import client

        html, v, compared = self._html, self._v, self.compared
        with self._panel_beside(self.plotter):
            html.Div("{{ rig_name }}", classes="text-h6")
            self._make_message()
            html.Div(compared.verdict, classes="text-body-2 my-1")
            html.Div(v_html=("compared", compared.table), classes="text-caption compared")
            client.Style(
                ".compared :is(th, td) { padding: 0 3px; line-height: 1.2 } .compared td { white-space: nowrap }"
            )
            scenes = [(k, f"scene {k + 1}, {count} found by one alone") for k, count in enumerate(self._alone)]
            self._select("scene", "scene", partial(self._show, "scene"), scenes)
            heights = [(k, patch_words(height_m)) for k, height_m in enumerate(SHOWN_HEIGHTS_M)]
            self._select("height", "seen on the ground", partial(self._show, "height"), heights)
            with html.Div(v_for="each in seen", key="each.who", classes="d-flex text-caption seen"):
                html.Div(style=("`width: 14px; height: 14px; margin: 3px 6px 0 0; background: ${each.colour}`",))
                html.Div("{{ each.who }}: {{ each.area }}, {{ each.users }} road user{{ each.users === 1 ? '' : 's' }}")
            for k, name in enumerate(compared.rigs):
                toggled = partial(self._do, self.hidden.symmetric_difference_update, {k})
                options = {"label": f"cameras of {name}", "color": hex_colour(camera_rgb(k)), "classes": "ml-2"}
                v.VSwitch(v_model=(f"shows_{k}", True), update_modelValue=toggled, **options, **_SMALL)


_PANEL_PX, _WIDE_PX = 340, 312
_THUMBNAIL = "`height: 38px; max-width: 68px; margin-right: 8px; border: 2px solid ${camera.colour}`"
_SMALL = {"density": "compact", "hide_details": True}
_OFF = ("off", "off")


def _score_words(score: RigScore) -> dict[str, str]:
    numbers = {"expected": score.expected_per_100, "missed": score.missed_per_100}
    words = {name: "-" if value is None else f"{value:.1f}" for name, value in numbers.items()}
    return {**words, "of": f", {score.objects} road user{'' if score.objects == 1 else 's'}"}


def _or_off(action: Callable[[Any], object], wanted: Any) -> None:  # noqa: ANN401 (of the choice)
    action(None if wanted == "off" else wanted)


def _new_server() -> tuple[Server, Any, Any]:
    try:
        from trame.app import get_server
        from trame.widgets import html, vtk, vuetify3  # noqa: F401 (asked for before anything is made)
    except ImportError as error:
        raise InputError(
            f"the viewer in a browser: expected the extra web, got: {error}; {install_text('web')}, or write "
            "a page with --out rig.html"
        ) from None
    return get_server(f"warpav-{secrets.token_hex(4)}", client_type="vue3"), html, vuetify3


@contextlib.contextmanager
def _environment(name: str, value: str) -> Iterator[None]:
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
