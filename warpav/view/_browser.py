"""The inspector in a browser: this machine draws, the browser shows the images and sends back what the mouse does.

Only this machine is listened to, and only who knows the token is answered. From elsewhere an SSH tunnel leads here.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import secrets
from functools import partial
from typing import TYPE_CHECKING, Any

from warpav.core.errors import ArgumentError, InputError, install_text
from warpav.view._inspector import SHOWN_HEIGHTS_M, SWITCHES, TURN_DEG
from warpav.view._layers import patch_words
from warpav.view._palette import camera_rgb, hex_colour

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from warpav.view._inspector import Inspector

    Server = Any

_HOST = "127.0.0.1"
"""The one address that is listened to."""

DEFAULT_PORT = 8765

_INTERACTIVE_QUALITY, _STILL_QUALITY = 70, 92
"""Of JPEG images while the mouse moves, and after it has."""

_AGAIN_S = 0.3
"""When the image after an action is sent once more [s]."""


def new_token() -> str:
    """A token that nobody guesses."""
    return secrets.token_urlsafe(24)


class BrowserInspector:
    """An inspector as a page of a server on this machine."""

    def __init__(self, inspector_of: Callable[[Callable[[str], None]], Inspector], *, token: str) -> None:
        """Make the page; nothing is served yet."""
        self._server, self.token, self.port = _new_server(), token, 0
        self.state: Any = self._server.state
        self.state.lines = []
        self.inspector = inspector_of(self._tell)
        self.inspector.plotter.show(auto_close=False, interactive=False)
        # every image that is sent is drawn for it: one more for each move of the mouse would take twice the time
        self.inspector.plotter.iren.interactor.EnableRenderOff()
        self._make_page()
        self._follow()

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

        self._server.controller.on_server_ready.add(has_started)
        # the server reads the words of the command line unless it is given others
        with _environment("TRAME_ARGS", f"--server --nosignalhandlers --authKey={self.token}"):
            try:
                asyncio.run(self._run(port))
            except OSError as error:
                raise ArgumentError(
                    "port", f"expected one that is free, got {port}: {error.strerror}; try another one"
                ) from None

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

    # ------------------------------------------------------------------------------------------------- what users do

    def _do(self, action: Callable[..., object], *words: Any) -> None:  # noqa: ANN401 (of the action)
        """Do what a control stands for; the page follows, and says what keeps it from being done."""
        try:
            action(*words)
        except InputError as error:
            self._tell(str(error))
        self._follow()
        self._update()
        # an image is left out while the browser has not yet answered for the one before
        asyncio.get_running_loop().call_later(_AGAIN_S, self._update)

    # ------------------------------------------------------------------------------------------------- what is shown

    def _tell(self, text: str) -> None:
        """Show lines in the panel."""
        with self.state as state:
            state.lines = text.splitlines()

    def _follow(self) -> None:
        """Show in the controls what the inspector shows."""
        inspector, shown = self.inspector, self.inspector.state
        with self.state as state:
            state.coverage = "off" if inspector.shown_height is None else inspector.shown_height
            state.on_body = inspector.shown_on_body or "off"
            state.frame, state.scene = shown.frame, shown.scene_index
            state.chosen = -1 if inspector.chosen is None else inspector.chosen
            for name in SWITCHES:
                state[f"shows_{name}"] = name in inspector.shows
            state.cameras = [
                {"name": camera.name, "module": camera.module or "", "colour": hex_colour(camera_rgb(index))}
                for index, camera in enumerate(shown.rig.cameras)
            ]

    def _make_page(self) -> None:
        from trame.ui.vuetify3 import VAppLayout
        from trame.widgets import html, vtk
        from trame.widgets import vuetify3 as v

        inspector, shown = self.inspector, self.inspector.state
        small = {"density": "compact", "hide_details": True}
        with VAppLayout(self._server, full_height=True) as layout:
            layout.root.theme = "light"
            with v.VNavigationDrawer(permanent=True, width=320, classes="pa-3"):
                line = {"classes": "text-caption", "style": "line-height: 1.35"}
                html.Div("{{ line }}", v_for="line, k in lines", key="k", **line)
                v.VDivider(classes="my-2")
                if shown.scene_count > 1:
                    scenes = [(k, f"scene {k + 1}") for k in range(shown.scene_count)]
                    self._select("scene", "scene", lambda number: inspector.show_scene(int(number)), scenes)
                if len(shown.frames) > 1:
                    action = partial(self._do, lambda number: inspector.go_to(int(number)))
                    ends = {"min": 0, "max": len(shown.frames) - 1, "step": 1, "end": (action, "[$event]")}
                    v.VSlider(v_model=("frame",), label="iteration", thumb_label=True, **ends, **small)
                heights = [(k, patch_words(height_m)) for k, height_m in enumerate(SHOWN_HEIGHTS_M)]
                self._select("coverage", "coverage", partial(_or_off, inspector.show_coverage), [*heights, _OFF])
                gain = [("gain", SWITCHES["further"].words)] if "further" in shown.known else []
                on_body = [("zones", "zones"), *gain, _OFF]
                self._select("on_body", "body", partial(_or_off, inspector.show_on_body), on_body)
                for name, switch in SWITCHES.items():
                    if switch.needs is None or switch.needs in shown.known:
                        v.VSwitch(
                            v_model=(f"shows_{name}",),
                            label=switch.words,
                            color="primary",
                            classes="ml-2",
                            update_modelValue=partial(self._do, inspector.toggle, name),
                            **small,
                        )
                v.VDivider(classes="my-2")
                with (
                    v.VList(density="compact"),
                    v.VListItem(
                        v_for="camera, k in cameras",
                        key="k",
                        active=("k === chosen",),
                        title=("camera.name",),
                        subtitle=("camera.module",),
                        click=(partial(self._do, self._look_through), "[k]"),
                        classes="camera",
                    ),
                    v.Template(v_slot_prepend=True),
                ):
                    v.VIcon("mdi-camera", color=("camera.colour",))
                with v.VRow(dense=True, classes="mt-1", v_if="chosen >= 0"):
                    self._button("turn left", lambda: inspector.turn(TURN_DEG))
                    self._button("turn right", lambda: inspector.turn(-TURN_DEG))
                    if "modules" in shown.known:
                        self._button("other module", inspector.change_module)
                v.VBtn("write the rig", block=True, classes="mt-3", click=partial(self._do, self._write))
                said = "Click a ball to look through its camera, drag it to move the camera."
                html.Div(said, classes="text-caption mt-2")
            with v.VMain(), html.Div(style="position: relative; width: 100%; height: 100%"):
                view = vtk.VtkRemoteView(
                    inspector.plotter.render_window,
                    interactive_ratio=1,
                    still_ratio=1,
                    interactive_quality=_INTERACTIVE_QUALITY,
                    still_quality=_STILL_QUALITY,
                )
        self._update = view.update

    def _select(self, name: str, label: str, action: Callable[[Any], object], choices: list[tuple[Any, str]]) -> None:
        from trame.widgets import vuetify3 as v

        v.VSelect(
            v_model=(name,),
            label=label,
            items=(f"{name}_choices", [{"value": value, "title": title} for value, title in choices]),
            update_modelValue=(partial(self._do, action), "[$event]"),
            density="compact",
            hide_details=True,
            classes="mb-2",
        )

    def _look_through(self, camera: int) -> None:
        self.inspector.choose(None if camera == self.inspector.chosen else camera)

    def _write(self) -> None:
        self._tell(f"wrote {self.inspector.save()}")

    def _button(self, label: str, action: Callable[[], object]) -> None:
        from trame.widgets import vuetify3 as v

        v.VBtn(label, size="small", classes="ma-1", click=partial(self._do, action))


_OFF = ("off", "off")


def _or_off(action: Callable[[Any], object], wanted: Any) -> None:  # noqa: ANN401 (of the choice)
    action(None if wanted == "off" else wanted)


def _new_server() -> Server:
    """A server of its own."""
    try:
        from trame.app import get_server
        from trame.widgets import vtk, vuetify3  # noqa: F401 (asked for before anything is made)
    except ImportError as error:
        raise InputError(
            f"the viewer in a browser: expected the extra web, got: {error}; {install_text('web')}, or write "
            "a page with --out rig.html"
        ) from None
    return get_server(f"warpav-{secrets.token_hex(4)}", client_type="vue3")


@contextlib.contextmanager
def _environment(name: str, value: str) -> Iterator[None]:
    """A variable of the environment for a while."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
