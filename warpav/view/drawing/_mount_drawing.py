"""A rig on a drawing for the workshop: three views to scale, coordinates from datums, and a table, as PDF and DXF.

The drawing is composed once, of strokes, notes, ordinate dimensions and marks in millimetres of paper; `figure` and
`warpav.view.drawing._dxf` draw these.
"""

from __future__ import annotations

import hashlib
import importlib.util
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import ArgumentError
from warpav.rig import builtin_modules, corners_m, rig_text
from warpav.view._outlines import silhouette_m
from warpav.view._output import write_bytes
from warpav.view._palette import GRID_RGB, INK_RGB, MUTED_RGB, camera_rgb, hex_colour
from warpav.view.drawing._dxf import drawing_dxf, load_ezdxf
from warpav.view.drawing._mounts import Mount, angles_deg, mount_csv, mount_glb, mounts, plain
from warpav.view.drawing._sheet import TEXT_MM, Mark, Note, Ordinate, Sheet, Stroke, View, add_names, box_mm, circle_mm
from warpav.view.figures._style import (
    FIGURE_SUFFIXES,
    SCALES,
    Page,
    camera_cells,
    closed,
    date_text,
    figure_style,
    long_names,
    save_figure,
    short_names,
    text_points,
    text_width_mm,
)

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig import Module, Rig

_PAGE_MM = (420.0, 297.0)
"""A3, landscape."""

_SUFFIXES = (*FIGURE_SUFFIXES[::-1], ".dxf", ".csv", ".glb")
"""Of files that `MountDrawing.save` writes."""

_FRAME_MM = (20.0, 10.0, 410.0, 287.0)  # ISO 5457: 20 mm to the left, 10 mm to the others
_LABEL_MM, _ABOVE_MM, _GAP_MM = 33.0, 33.0, 17.0
_BESIDE_MM = 31.0
_TITLE_MM = (180.0, 36.0)
_ROW_MM, _APART_MM = 4.3, 3.2
_ARROW_MM = 9.0
_TABLE_MM, _COLUMN_GAP_MM, _COLUMN_GAP_LEAST_MM = 200.0, 6.0, 2.0
_TEXT_COLUMNS = 3
"""How many columns of the table are text, from the left; numbers stand at the right of theirs."""
_BOX_LEAST_MM = 1.5
_TABLE_HEAD = (
    *("camera", "module or lens", "image [px]", "fov [°]", "x [mm]", "y [mm]", "z [mm]"),
    *("yaw [°]", "pitch [°]", "roll [°]", "off [mm]"),
)
_NOTE = (
    "Coordinates are those of the optical centres in the vehicle's frame (ISO 8855): x forward from datum B, "
    "y to the left from datum C, z up from datum A.",
    "Angles turn a camera that looks forward about its own axes, in the order yaw (to the left), pitch (nose down), "
    "roll (right side down).",
    "Cameras are drawn through the body; arrows are optical axes. Off: from the nearest point of the mesh to the "
    "optical centre.",
)
_NOTE_HOUSINGS = " Dashed boxes: housings."
"""Where some can be seen: at least `_BOX_LEAST_MM` wide and high on paper."""


@dataclass(eq=False, kw_only=True)
class _MountDrawing(Sheet):
    """A composed drawing, with what its table and its model are made of."""

    title: str
    ego: Mesh | None
    modules: Mapping[str, Module]

    def figure(self) -> Any:  # noqa: ANN401 (matplotlib)
        """The drawing as a ``matplotlib.figure.Figure`` in the size of the page."""
        with figure_style():
            page = Page(*_PAGE_MM)
            axis = page.panel(0.0, 0.0, *_PAGE_MM)
            axis.set(xlim=(0.0, _PAGE_MM[0]), ylim=(0.0, _PAGE_MM[1]))
            for stroke in self.strokes:
                _draw_stroke(axis, stroke)
            for ordinate in self.ordinates:
                axis.plot(*ordinate.line_mm.T, color=hex_colour(MUTED_RGB), linewidth=0.35, zorder=3)
                style = {"va": "center_baseline", "fontsize": text_points(TEXT_MM), "rotation_mode": "default"}
                style |= {"rotation": 90, "va": "bottom", "ha": "center"} if ordinate.is_across else {"ha": "right"}
                axis.text(*ordinate.end_mm, f" {ordinate.text} ", **style)
            for mark in self.marks:
                colour = hex_colour(camera_rgb(mark.camera))
                if np.linalg.norm(mark.tip_mm - mark.place_mm) > 1e-9:
                    arrow = {"arrowstyle": "-|>,head_width=0.12,head_length=0.3", "color": colour, "linewidth": 0.9}
                    arrow |= {"shrinkA": 0.0, "shrinkB": 0.0}
                    axis.annotate("", mark.tip_mm, xytext=mark.place_mm, arrowprops=arrow, zorder=6)
                axis.plot(*circle_mm(mark.place_mm).T, color=colour, linewidth=0.8, zorder=7)
                for cross_mm in mark.cross_mm:
                    axis.plot(*cross_mm.T, color=colour, linewidth=0.5, zorder=7)
            for note in self.notes:
                style = {"color": hex_colour(INK_RGB)}
                if note.camera is not None:
                    style = {"color": hex_colour(camera_rgb(note.camera)), "fontweight": "bold"}
                style |= {"ha": "center" if note.align == "middle" else note.align, "va": "center_baseline"}
                axis.text(*note.place_mm, note.text, fontsize=text_points(note.height_mm), **style)
            return page.figure

    def save(self, path: Path | str) -> list[Path]:
        """Write the drawing, its table or its model; the same drawing gives the same bytes."""
        path = Path(path)
        check_out(path)
        if not path.suffix or path.is_dir():
            has_dxf = importlib.util.find_spec("ezdxf") is not None
            ends = (".pdf", *([".dxf"] if has_dxf else []), ".csv", ".glb")
            return [file for end in ends for file in self.save(path / f"mounts{end}")]
        match path.suffix.lower():
            case ".dxf":
                return [write_bytes(path, drawing_dxf(self, place=path))]
            case ".csv":
                return [write_bytes(path, mount_csv(self.mounts).encode())]
            case ".glb":
                return [write_bytes(path, mount_glb(self.mounts, self.ego, self.modules))]
            case _:
                return [save_figure(self.figure(), path)]


def check_out(path: Path) -> None:
    """Check that a drawing can be written as this file, or into this folder."""
    is_folder = not path.suffix or path.is_dir()
    if not is_folder and path.suffix.lower() not in _SUFFIXES:
        expected = f"a folder or a name that ends in {', '.join(_SUFFIXES)}"
        raise ArgumentError("out", f"expected {expected}, got {path.suffix!r}", place=path)
    if not is_folder and path.suffix.lower() == ".dxf":
        load_ezdxf(path)


def mount_drawing(
    rig: Rig,
    *,
    ego: Mesh | None = None,
    title: str = "rig",
    vehicle: str = "-",
    modules: Mapping[str, Module] | None = None,
) -> _MountDrawing:
    """Compose the drawing by which a workshop mounts a rig.

    Three views in first-angle projection, seen from the left, the front and the top, with the outline of the vehicle,
    the place and optical axis of every camera, housings of modules, and coordinates from the datums: A is the ground,
    B the rear axle, C the plane of symmetry. A table has all numbers, a block the title, vehicle, date and scale. The
    date is today's, or that of the environment variable ``SOURCE_DATE_EPOCH``, so that a drawing can be made again.
    """
    found = mounts(rig, ego)
    point_m = np.array([camera.position_m for camera in rig.cameras] + [[0.0, 0.0, 0.0]])
    if ego is not None:
        point_m = np.vstack([point_m, np.asarray(ego.bounds_m(), np.float64)])
    low_m, high_m = point_m.min(axis=0), point_m.max(axis=0)
    row_mm = min(_ROW_MM, 100.0 / (len(rig.cameras) + 1))
    table_mm = row_mm * (len(rig.cameras) + 1) + 4.0
    scale, views = _views(low_m, high_m, foot_mm=max(table_mm, _TITLE_MM[1]) + 15.5)
    catalogue = builtin_modules() if modules is None else modules
    drawing = _MountDrawing(scale=scale, views=views, mounts=found, title=title, ego=ego, modules=catalogue)
    _add_bodies(drawing)
    _add_datums(drawing, low_m, high_m)
    for view, (index, mount) in itertools.product(views, enumerate(found)):
        place_mm = view.place_mm(mount.camera.position_m)
        ahead = mount.camera.ego_from_camera[:3, 2] @ np.stack([view.right, view.up], axis=1)
        arrow_mm = _ARROW_MM * ahead if np.linalg.norm(ahead) > 0.1 else np.zeros(2)
        drawing.marks.append(Mark(view, index, place_mm, place_mm + arrow_mm))
    _add_ordinates(drawing)
    add_names(drawing)
    _add_table(drawing, row_mm)
    _add_title_block(drawing, vehicle, hashlib.sha256(rig_text(rig).encode()).hexdigest()[:12])
    return drawing


def _views(low_m: np.ndarray, high_m: np.ndarray, *, foot_mm: float) -> tuple[float, tuple[View, View, View]]:
    """The largest scale at which the views have room above the table, and where they are."""
    left_mm, bottom_mm, right_mm, top_mm = _FRAME_MM
    length_m, width_m, height_m = high_m - low_m
    room_mm = right_mm - left_mm - _LABEL_MM - _BESIDE_MM - _GAP_MM, top_mm - bottom_mm - foot_mm - _ABOVE_MM - _GAP_MM
    fitting = (
        one
        for one in SCALES
        if 1000.0 * (length_m + width_m) <= one * room_mm[0] and 1000.0 * (height_m + width_m) <= one * room_mm[1]
    )
    scale = next(fitting, SCALES[-1])
    per_m = 1000.0 / scale
    ahead, left, up = np.eye(3)
    # forward is to the left in the view from the left
    ground_mm = top_mm - _ABOVE_MM - per_m * high_m[2]
    axle_mm = left_mm + _LABEL_MM + per_m * high_m[0]
    middle_mm = axle_mm - per_m * low_m[0] + _BESIDE_MM - per_m * low_m[1]
    above_mm = ground_mm + per_m * min(low_m[2], 0.0) - _GAP_MM + per_m * low_m[1]
    return scale, (
        View("left", -ahead, up, np.array([axle_mm, ground_mm]), scale),
        View("front", left, up, np.array([middle_mm, ground_mm]), scale),
        View("top", -ahead, -left, np.array([axle_mm, above_mm]), scale),
    )


def _add_bodies(drawing: _MountDrawing) -> None:
    import cv2

    for view in drawing.views:
        if drawing.ego is not None:
            for line_m in silhouette_m(drawing.ego, view.right, view.up):
                place_mm = view.datum_mm + 1000.0 / view.scale * line_m
                drawing.strokes.append(Stroke("OUTLINE", place_mm, is_closed=True))
        for index, mount in enumerate(drawing.mounts):
            module = drawing.modules.get(mount.camera.module or "")
            if module is not None:
                corner_mm = view.place_mm(corners_m(mount.camera.ego_from_camera, module.housing))
                hull_mm = cv2.convexHull(corner_mm.astype(np.float32))[:, 0]
                drawing.strokes.append(Stroke("HOUSINGS", hull_mm, is_closed=True, camera=index))


def _add_datums(drawing: _MountDrawing, low_m: np.ndarray, high_m: np.ndarray) -> None:
    axis = np.eye(3)
    lines = {"left": (("A", 0), ("B", 2)), "front": (("A", 1), ("C", 2)), "top": (("C", 0), ("B", 1))}
    for view in drawing.views:
        for (name, along), is_across in zip(lines[view.name], (True, False), strict=True):
            beyond_mm = np.array([10.5, 0.0] if is_across else [0.0, 5.0])  # beyond arrows, and within the gap
            end_mm = view.place_mm(np.stack([min(low_m[along], 0.0) * axis[along], high_m[along] * axis[along]]))
            end_mm = np.stack([end_mm.min(axis=0) - beyond_mm, end_mm.max(axis=0) + beyond_mm])
            drawing.strokes.append(Stroke("DATUMS", end_mm))
            middle_mm = end_mm[1] + np.array([2.2, 0.0]) if is_across else end_mm[0] - np.array([0.0, 2.2])
            drawing.strokes.append(Stroke("DATUMS", box_mm(middle_mm - 2.2, middle_mm + 2.2), is_closed=True))
            drawing.notes.append(Note("DATUMS", tuple(middle_mm.tolist()), name, 2.5, "middle"))
    tip_mm = drawing.views[2].place_mm(high_m) - np.array([0.0, 6.0])  # below the left end of the view from the top
    drawing.strokes.append(Stroke("FRAME", tip_mm + np.array([[10, 0], [0, 0], [3, 0.8], [3, -0.8], [0, 0]])))
    drawing.notes.append(Note("FRAME", (float(tip_mm[0]) + 11.5, float(tip_mm[1])), "front"))


def _add_ordinates(drawing: _MountDrawing) -> None:
    """X above the view from the left, z at its left, y at the left of the view from the top; each value once."""
    side, _, top = drawing.views
    edge_mm = _FRAME_MM[0] + _LABEL_MM - 9.0
    head_mm = _FRAME_MM[3] - _ABOVE_MM + 9.0
    cameras = [mount.camera for mount in drawing.mounts]
    named = [(name, each.position_m) for name, each in zip(short_names(cameras), cameras, strict=True)]
    for view, axis in ((side, 0), (side, 2), (top, 1)):
        of_value: dict[int, list[str]] = {}
        at_mm: dict[int, np.ndarray] = {}
        features = [*named]
        if drawing.ego is not None:
            vertex_m = drawing.ego.vertex_m.astype(np.float64)
            ends_m = vertex_m[[vertex_m[:, axis].argmin(), vertex_m[:, axis].argmax()]]
            features += [("end", end_m) for end_m in ends_m if abs(end_m[axis]) > 1e-3]
        for name, point_m in features:
            value_mm = round(1000.0 * float(point_m[axis]))
            of_value.setdefault(value_mm, []).append(name)
            place_mm = view.place_mm(point_m)
            kept_mm = at_mm.setdefault(value_mm, place_mm)
            # the line begins at the one nearest to the numbers
            if name != "end" and (place_mm[1] > kept_mm[1] if axis == 0 else place_mm[0] < kept_mm[0]):
                at_mm[value_mm] = place_mm
        is_across = axis == 0
        values = list(of_value)
        wanted_mm = np.array([at_mm[value][0 if is_across else 1] for value in values])
        for value_mm, label_mm in zip(values, _spread(wanted_mm, _APART_MM), strict=True):
            end_mm = np.array([label_mm, head_mm] if is_across else [edge_mm, label_mm])
            first, *others = [name for name in of_value[value_mm] if name != "end"] or [""]
            names = ", ".join([first, *others])
            names = names if len(names) <= 7 or not others else f"{first}.."
            text = f"{value_mm:+d}" if value_mm else "0"
            text = f"{names}: {text}" if names else text
            drawing.ordinates.append(Ordinate(view, at_mm[value_mm], end_mm, is_across, float(value_mm), text))


def _spread(wanted_mm: np.ndarray, least_mm: float) -> np.ndarray:
    """The places nearest to the wanted ones, in the sense of least squares, that are so far apart."""
    from scipy.optimize import isotonic_regression

    order = np.argsort(wanted_mm, kind="stable")
    step_mm = least_mm * np.arange(len(wanted_mm))
    placed_mm = np.empty(len(wanted_mm))
    placed_mm[order] = isotonic_regression(wanted_mm[order] - step_mm).x + step_mm
    return placed_mm


def _add_table(drawing: _MountDrawing, row_mm: float) -> None:
    left_mm, bottom_mm = _FRAME_MM[0] + 3.0, _FRAME_MM[1] + 2.0
    height_mm = min(TEXT_MM, 0.55 * row_mm)
    names = long_names([mount.camera for mount in drawing.mounts])
    rows = [_TABLE_HEAD, *((name, *_row(mount)) for name, mount in zip(names, drawing.mounts, strict=True))]
    rows, edges_mm = _columns_mm(rows, height_mm)
    for line, row in enumerate(rows):
        at_mm = bottom_mm + (len(rows) - line - 0.5) * row_mm
        for column, (edge_mm, text) in enumerate(zip(edges_mm, row, strict=True)):
            colour = line - 1 if line and not column else None
            place_mm = left_mm + edge_mm, at_mm
            align = "left" if column < _TEXT_COLUMNS else "right"
            drawing.notes.append(Note("TABLE", place_mm, text, height_mm, align, colour))
    across_mm = np.array([left_mm, left_mm + edges_mm[-1]])
    rule_mm = bottom_mm + (len(rows) - 1) * row_mm
    drawing.strokes.append(Stroke("FRAME", np.stack([across_mm, np.full(2, rule_mm)], axis=1)))


def _row(mount: Mount) -> tuple[str, ...]:
    camera = mount.camera
    return (
        *camera_cells(camera),
        plain(math.degrees(camera.model.fov_rad), 1),
        *(plain(1000.0 * value, 0) for value in camera.position_m),
        *(plain(each, 1) for each in angles_deg(camera)),
        "-" if mount.stand_off_m is None else plain(1000.0 * mount.stand_off_m, 0),
    )


def _columns_mm(rows: Sequence[tuple[str, ...]], height_mm: float) -> tuple[list[tuple[str, ...]], list[float]]:
    """A table as it fits its room, and the edges of its columns: left ones of text, right ones of numbers.

    Columns are as wide as what they hold; where there is no room for that, names are cut in the middle, or nearest to
    it where they stay different.
    """

    def widths_mm() -> np.ndarray:
        each_mm = [
            [text_width_mm(text, height_mm, is_bold=not column and line > 0) for column, text in enumerate(row)]
            for line, row in enumerate(kept)
        ]
        return np.max(each_mm, axis=0)

    kept, longest = list(rows), max(len(text) for row in rows for text in row[:2])
    gaps = len(rows[0]) - 1
    while widths_mm().sum() + gaps * _COLUMN_GAP_LEAST_MM > _TABLE_MM and longest > 10:
        longest -= 1
        short = dict[str, str]()
        for text in (text for row in rows for text in row[:2]):
            heads = sorted(range(longest - 2), key=lambda head: abs(2 * head - longest + 2))
            cuts = [f"{text[:head]}..{text[head + 2 - longest :]}" for head in heads] if len(text) > longest else [text]
            others = {less for other, less in short.items() if other != text}
            short[text] = next((each for each in cuts if each not in others), cuts[0])
        kept = [(*(short[text] for text in row[:2]), *row[2:]) for row in rows]
    width_mm = widths_mm()
    gap_mm = min(_COLUMN_GAP_MM, (_TABLE_MM - float(width_mm.sum())) / gaps)
    start_mm = np.concatenate([[0.0], np.cumsum(width_mm + gap_mm)[:-1]])
    is_number = np.arange(len(width_mm)) >= _TEXT_COLUMNS
    return kept, (start_mm + np.where(is_number, width_mm, 0.0)).tolist()


def _add_title_block(drawing: _MountDrawing, vehicle: str, fingerprint: str) -> None:
    left_mm, bottom_mm, right_mm, top_mm = _FRAME_MM

    def box(low_mm: tuple[float, float], high_mm: tuple[float, float]) -> None:
        drawing.strokes.append(Stroke("FRAME", box_mm(low_mm, high_mm), is_closed=True))

    box((left_mm, bottom_mm), (right_mm, top_mm))
    width_mm, height_mm = _TITLE_MM
    x_mm, y_mm = right_mm - width_mm, bottom_mm
    box((x_mm, y_mm), (right_mm, y_mm + height_mm))
    cells = (
        (0.0, 24.0, 70.0, "camera mounts of the rig", drawing.title[:44], 4.0),
        (70.0, 24.0, 60.0, "vehicle", vehicle[:44], 4.0),
        (130.0, 24.0, 50.0, "projection: first angle", "", 3.0),
        (0.0, 12.0, 40.0, "scale", f"1 : {drawing.scale:g}", 3.5),
        (40.0, 12.0, 30.0, "sheet", "A3", 3.0),
        (70.0, 12.0, 60.0, "units", "mm, degrees", 3.0),
        (130.0, 12.0, 50.0, "date", date_text(), 3.0),
        (0.0, 0.0, 80.0, "datums", "A ground, B rear axle, C middle plane", 2.4),
        (80.0, 0.0, 100.0, "rig file, SHA-256 begins", fingerprint, 3.0),
    )
    for x, y, width, head, text, size_mm in cells:
        box((x_mm + x, y_mm + y), (x_mm + x + width, y_mm + y + 12.0))
        drawing.notes.append(Note("FRAME", (x_mm + x + 1.5, y_mm + y + 9.8), head, 1.8))
        if text:
            fitting_mm = min(size_mm, size_mm * (width - 3.0) / text_width_mm(text, size_mm))
            drawing.notes.append(Note("FRAME", (x_mm + x + 1.5, y_mm + y + 4.6), text, fitting_mm))
    # the sign of ISO 128: a cone from the side, and beyond it from its narrow end
    centre_mm = np.array([x_mm + 150.0, y_mm + 29.0])
    cone_mm = centre_mm + np.array([[-7.0, -1.5], [1.0, -3.0], [1.0, 3.0], [-7.0, 1.5]])
    drawing.strokes.append(Stroke("FRAME", cone_mm, is_closed=True))
    for radius_mm in (1.5, 3.0):
        drawing.strokes.append(Stroke("FRAME", circle_mm(centre_mm + np.array([8.0, 0.0]), radius_mm), is_closed=True))
    drawing.strokes.append(Stroke("DATUMS", centre_mm + np.array([[-9.0, 0.0], [13.0, 0.0]])))
    hulls_mm = [stroke.point_mm for stroke in drawing.strokes if stroke.layer == "HOUSINGS"]
    has_boxes = any(float(np.ptp(hull_mm, axis=0).min()) >= _BOX_LEAST_MM for hull_mm in hulls_mm)
    table_top_mm = max(note.place_mm[1] for note in drawing.notes if note.layer == "TABLE")
    for line, text in enumerate((*_NOTE[:-1], _NOTE[-1] + (_NOTE_HOUSINGS if has_boxes else ""))):
        place_mm = left_mm + 3.0, max(y_mm + height_mm, table_top_mm) + 11.0 - 3.2 * line
        drawing.notes.append(Note("FRAME", place_mm, text, 1.9))


def _draw_stroke(axis: Any, stroke: Stroke) -> None:  # noqa: ANN401 (matplotlib)
    ink, grey = hex_colour(INK_RGB), hex_colour(MUTED_RGB)
    style = {
        "OUTLINE": {"color": ink, "linewidth": 0.9, "zorder": 1},
        "DATUMS": {"color": ink, "linewidth": 0.5, "zorder": 2},
        "FRAME": {"color": ink, "linewidth": 0.5, "zorder": 2},
        "CAMERAS": {"linewidth": 0.35, "zorder": 5},
        "HOUSINGS": {"color": grey, "linewidth": 0.6, "linestyle": (0, (3, 2)), "zorder": 5},
    }[stroke.layer]
    if stroke.layer == "DATUMS" and not stroke.is_closed:
        style |= {"linestyle": (0, (12, 3, 2, 3))}
    if stroke.camera is not None:
        style |= {"color": hex_colour(camera_rgb(stroke.camera))}
    point_mm = closed(stroke.point_mm) if stroke.is_closed else stroke.point_mm
    if stroke.layer == "OUTLINE":
        axis.fill(*point_mm.T, facecolor=hex_colour(GRID_RGB), alpha=0.45, linewidth=0, zorder=0)
    axis.plot(*point_mm.T, **style)
