"""A page that stands alone: what plotters show, turned and switched in any browser, without a network or a server.

K3D (WebGL) draws; the panel beside it is ours. What a page may hide has tags such as ``{"camera": "front"}``, and is
shown while every control has its value switched on.
"""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import resources
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from warpav.view._opengl import load_pyvista, optional_module
from warpav.view._palette import COVERAGE_RGB, INK_RGB, camera_rgb, hex_colour

if TYPE_CHECKING:
    Plotter = Any

_Tags = Mapping[str, str]
"""Values of controls, by their keys."""

_OPAQUE = 255
_SHIFTS = np.array([65536, 256, 1])
"""Of the parts of colours that are one number."""

_LABELS = "-labels"
"""What pyvista adds to the names of labels."""

_OF_SCENE = ("scene/", "coverage", "ground", "legend/", "visibility/", "outcomes/", "rings/")
"""First parts of the names of what another scene has another one of."""


@dataclass(frozen=True)
class _Control:
    key: str
    label: str
    kind: Literal["one", "any"]
    values: Sequence[str]
    shown: Sequence[str]
    colours: Sequence[str] = field(default=())


class _Page:
    def __init__(
        self, title: str, view_of: Plotter, *, controls: Sequence[_Control] = (), lines: Sequence[str] = ()
    ) -> None:
        self._k3d, self._title, self._controls, self._lines = load_k3d(), title, controls, lines
        self._plot = self._k3d.plot(
            grid_visible=False,
            axes_helper=0,
            menu_visibility=False,
            background_color=0xFFFFFF,
            camera_auto_fit=False,
            camera_up_axis="z",
            minimum_fps=-1,
            lighting=1.8,
        )
        self._tags: list[dict[str, str]] = []
        self._seen_by: dict[str, list[int]] = {}  # by which cameras triangles of the ground are seen, as bits
        camera = view_of.camera
        self._camera = [float(each) for each in (*camera.position, *camera.focal_point, *camera.up)]
        self._plot.camera, self._plot.camera_fov = self._camera, float(camera.view_angle)

    def add(self, plotter: Plotter, tags_by_name: Mapping[str, _Tags]) -> None:
        """Add what a plotter shows: surfaces, lines and names in space, not what lies in the plane of its window."""
        pyvista = load_pyvista()
        for name, tags in tags_by_name.items():
            actor = plotter.actors[name]
            if not actor.GetVisibility():
                continue
            if isinstance(actor, pyvista.Actor):
                self._add_mesh(actor, tags)
            elif name.endswith(_LABELS):
                self._add_labels(actor, tags)

    def _add_labels(self, actor: Any, tags: _Tags) -> None:  # noqa: ANN401 (a vtkActor2D)
        mapper = actor.GetMapper()
        named = load_pyvista().wrap(mapper.GetInputConnection(0, 0).GetProducer().GetInputDataObject(0, 0))
        shape_rgb = [round(255 * each) for each in mapper.GetBackgroundColor()]
        colour_rgb = shape_rgb if mapper.GetShape() else INK_RGB
        style = {"color": int(np.dot(colour_rgb, _SHIFTS)), "reference_point": "cc", "size": 0.8, "is_html": True}
        for at_m, text in zip(named.points, named["labels"], strict=True):
            position = [float(each) for each in at_m]
            self._put(self._k3d.text(html.escape(str(text).strip()), position=position, **style), tags)

    def _add_mesh(self, actor: Any, tags: _Tags) -> None:  # noqa: ANN401 (a pyvista.Actor)
        actor.mapper.Update()
        surface = load_pyvista().wrap(actor.mapper.GetInput())
        if surface is None or not surface.n_points:
            return
        surface = surface.transform(actor.user_matrix, inplace=False)
        if surface.n_lines:
            self._add_lines(surface, actor, tags)
        surface = surface.triangulate()
        if not surface.n_faces:
            return
        triangle = np.asarray(surface.regular_faces, np.uint32)
        point_m = np.asarray(surface.points, np.float32)
        at_corner, opacity = _colours(surface, actor), float(actor.prop.opacity)
        seen_by = np.asarray(surface.cell_data["seen_by"]) if "seen_by" in surface.cell_data else None
        if at_corner is not None:
            if at_corner.shape[1] == 4:  # of the ground: nobody stands where nothing is painted
                is_shown = at_corner[:, 3].reshape(-1, 3).any(axis=1)
                triangle, at_corner = triangle[is_shown], at_corner[np.repeat(is_shown, 3)]
                seen_by = None if seen_by is None else seen_by[is_shown]
                opacity *= float(at_corner[:, 3].mean()) / _OPAQUE if len(triangle) else 0.0
            point_m, triangle = point_m[triangle.ravel()], np.arange(triangle.size, dtype=np.uint32).reshape(-1, 3)
        if not triangle.size or opacity <= 0.0:
            return
        drawn = self._k3d.mesh(
            point_m,
            triangle,
            color=_packed(actor.prop.color) if at_corner is None else 0xFFFFFF,  # both are multiplied
            colors=[] if at_corner is None else (at_corner[:, :3] @ _SHIFTS).astype(np.uint32),
            opacity=opacity,
            flat_shading=True,
            side="double",
        )
        if seen_by is not None:
            self._seen_by[str(drawn.id)] = seen_by.tolist()
        self._put(drawn, tags)

    def _add_lines(self, surface: Any, actor: Any, tags: _Tags) -> None:  # noqa: ANN401 (of pyvista)
        cells, at = np.asarray(surface.lines), 0
        pieces = []
        while at < len(cells):
            run = cells[at + 1 : at + 1 + cells[at]]
            pieces.append(np.column_stack([run[:-1], run[1:]]))
            at += 1 + cells[at]
        self._put(
            self._k3d.lines(
                np.asarray(surface.points, np.float32),
                np.concatenate(pieces).astype(np.uint32),
                indices_type="segment",
                color=_packed(actor.prop.color),
                shader="simple",
                opacity=float(actor.prop.opacity),
            ),
            tags,
        )

    def _put(self, drawn: Any, tags: _Tags) -> None:  # noqa: ANN401 (an object of K3D)
        self._plot += drawn
        self._tags.append({**tags, "id": str(drawn.id)})

    def html(self) -> str:
        words = {
            "title": self._title,
            "lines": list(self._lines),
            "controls": [asdict(each) for each in self._controls],
            "tags": self._tags,
            "seenBy": self._seen_by,
            "palette": (np.array(COVERAGE_RGB) @ _SHIFTS).tolist(),
            "camera": self._camera,
        }
        panel = resources.files("warpav.view").joinpath("page_panel.js").read_text(encoding="utf-8")
        # nothing in it may end the script that it stands in
        told = json.dumps(words).replace("<", "\\u003c")
        page = self._plot.get_snapshot(additional_js_code=f"const words = {told};\n{panel}")
        begin, end = page.index("<title>"), page.index("</title>")
        return page[:begin] + "<title>" + html.escape(f"{self._title} - warpav") + page[end:]


_GROUND = "ground seen by no camera (red), one, two or more (blue)"


def page_of(plotters: Mapping[str, Plotter], *, title: str, lines: Sequence[str] = ()) -> _Page:
    """A page of what plotters show: the rig of the first, and the scenes of all, one at a time.

    The panel switches cameras, names, range rings and paths, and what the ground carries: every actor
    ``coverage/WORDS`` is one of the choices.
    """
    first, *_ = plotters
    tagged: dict[str, dict[str, _Tags]] = {}
    values: dict[str, dict[str, None]] = {"camera": {}, "show": {}, "ground": {}}  # in order, each once
    for scene, plotter in plotters.items():
        tagged[scene] = {}
        for name in plotter.actors:
            tags, is_of_scene = _tags_of(name), name.startswith(_OF_SCENE)
            for key, value in tags.items():
                values[key][value] = None
            if is_of_scene or scene == first:
                tagged[scene][name] = {**tags, "scene": scene} if is_of_scene else tags
    cameras, shown, ground = (list(each) for each in values.values())
    controls = [_Control("scene", "scene", "one", list(plotters), [first])] if len(plotters) > 1 else []
    if ground:
        controls.append(_Control("ground", _GROUND, "one", [*ground, "off"], ground[:1]))
    if shown:
        controls.append(_Control("show", "show", "any", shown, shown))
    if cameras:
        colours = [hex_colour(camera_rgb(k)) for k in range(len(cameras))]
        controls.append(_Control("camera", "cameras", "any", cameras, cameras, colours))
    page = _Page(title, plotters[first], controls=controls, lines=lines)
    for scene, plotter in plotters.items():
        page.add(plotter, tagged[scene])
    return page


def _tags_of(name: str) -> dict[str, str]:
    part = name.removesuffix(_LABELS).split("/")
    if part[0] in ("rig", "label") and len(part) > 1:
        is_name = part[0] == "label" or part[-1] == "label"
        return {"camera": part[1], **({"show": "names"} if is_name else {})}
    if part[0] == "visibility" and len(part) > 1:
        return {"camera": part[1], "show": "views of the cameras"}
    if part[0] == "coverage":
        return {"ground": part[1] if len(part) > 1 else "cameras"}
    shown = {"rings": "range rings", "trajectory": "paths of the search", "further": "one more camera"}
    return {"show": shown[part[0]]} if part[0] in shown else {}


def _colours(surface: Any, actor: Any) -> np.ndarray | None:  # noqa: ANN401 (of pyvista)
    mapper = actor.mapper
    if not mapper.scalar_visibility:
        return None
    for data, is_of_points in ((surface.point_data, True), (surface.cell_data, False)):
        name = mapper.array_name
        if name in data:
            rgb = np.asarray(data[name])
            if rgb.ndim != 2 or rgb.dtype != np.uint8:
                return None
            return rgb[np.asarray(surface.regular_faces).ravel()] if is_of_points else np.repeat(rgb, 3, axis=0)
    return None


def _packed(colour: Any) -> int:  # noqa: ANN401 (a pyvista.Color)
    return int(np.dot(np.asarray(colour.int_rgb), _SHIFTS))


def load_k3d() -> Any:  # noqa: ANN401 (a module)
    return optional_module("k3d", purpose="an interactive page", extra="web")
