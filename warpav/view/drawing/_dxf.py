"""A mount drawing as DXF, in millimetres of the vehicle: R2010, with named layers, blocks and ordinate dimensions."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view._opengl import optional_module
from warpav.view._palette import camera_rgb
from warpav.view.drawing._mounts import angles_deg, plain

if TYPE_CHECKING:
    from warpav.view.drawing._sheet import Mark, Sheet

LAYERS = {
    "OUTLINE": (7, "CONTINUOUS"),
    "DATUMS": (1, "CENTER"),
    "DIMENSIONS": (8, "CONTINUOUS"),
    "CAMERAS": (5, "CONTINUOUS"),
    "HOUSINGS": (3, "DASHED"),
    "TABLE": (7, "CONTINUOUS"),
    "FRAME": (7, "CONTINUOUS"),
}
"""Colour (an index of AutoCAD) and kind of line of every layer."""

BLOCK = "WARPAV_CAMERA"
"""Of the mark of a camera; its attributes are the numbers of the camera."""

_ALIGN = {"left": "MIDDLE_LEFT", "middle": "MIDDLE_CENTER", "right": "MIDDLE_RIGHT"}


def load_ezdxf(place: Path) -> Any:  # noqa: ANN401 (a module)
    """The module ezdxf, to write this file."""
    return optional_module("ezdxf", purpose=f"{place}: a drawing as DXF", extra="cad")


def drawing_dxf(drawing: Sheet, *, place: Path) -> bytes:
    """The drawing as a DXF file; the same drawing gives the same bytes.

    Model space is in millimetres at 1 : 1. Its origin is the datum of the view from the left, where x of the ego frame
    runs to the left and z upwards; the other views, the frame and the table lie around it as on the page.
    """
    ezdxf = load_ezdxf(place)
    with _fixed_metadata(ezdxf):
        document = _document(ezdxf, drawing)
        for name in sorted(document.entitydb.dxf_types_in_use()):  # ezdxf's own order changes from process to process
            document.classes.add_class(name)
        text = io.StringIO()
        document.write(text)
    return text.getvalue().encode(document.output_encoding)


def _document(ezdxf: Any, drawing: Sheet) -> Any:  # noqa: ANN401 (ezdxf)
    scale, origin_mm = drawing.scale, drawing.views[0].datum_mm

    def model(page_mm: np.ndarray | tuple[float, float]) -> Any:  # noqa: ANN401 (numbers of the file)
        return np.round(scale * (np.asarray(page_mm) - origin_mm), 3).tolist()

    document = ezdxf.new("R2010", setup=True, units=4)
    document.header["$LTSCALE"] = scale
    for name, (colour, linetype) in LAYERS.items():
        document.layers.add(name, color=colour, linetype=linetype)
    style = document.dimstyles.duplicate_entry("EZDXF", "WARPAV")
    style.dxf.dimtxt, style.dxf.dimgap, style.dxf.dimasz = 2.2 * scale, 0.8 * scale, 2.0 * scale
    style.dxf.dimtad, style.dxf.dimclrd, style.dxf.dimclre, style.dxf.dimclrt = 0, 8, 8, 7
    block = document.blocks.new(BLOCK)
    as_insert = {"layer": "CAMERAS", "color": 0}
    block.add_circle((0.0, 0.0), radius=scale, dxfattribs=as_insert)
    for dx, dy in ((1.6 * scale, 0.0), (0.0, 1.6 * scale)):
        block.add_line((-dx, -dy), (dx, dy), dxfattribs=as_insert)
    space = document.modelspace()
    for stroke in drawing.strokes:
        colour = {} if stroke.camera is None else {"true_color": ezdxf.rgb2int(camera_rgb(stroke.camera))}
        line = {"layer": stroke.layer, **colour}
        if stroke.layer == "DATUMS" and stroke.is_closed:
            line["linetype"] = "CONTINUOUS"
        space.add_lwpolyline(model(stroke.point_mm), close=stroke.is_closed, dxfattribs=line)
    for note in drawing.notes:
        align = ezdxf.enums.TextEntityAlignment[_ALIGN[note.align]]
        text = space.add_text(note.text, height=note.height_mm * scale, dxfattribs={"layer": note.layer})
        text.set_placement(model(note.place_mm), align=align)
        if note.camera is not None:
            text.rgb = camera_rgb(note.camera)
    for mark in drawing.marks:
        _add_mark(space, drawing, mark, model(mark.place_mm), model(mark.tip_mm))
    for ordinate in drawing.ordinates:
        add = space.add_ordinate_x_dim if ordinate.is_across else space.add_ordinate_y_dim
        feature, end = np.array(model(ordinate.feature_mm)), np.array(model(ordinate.end_mm))
        place = {"offset": (end - feature).tolist(), "origin": model(ordinate.view.datum_mm), "text": ordinate.text}
        add(feature.tolist(), **place, dimstyle="WARPAV", dxfattribs={"layer": "DIMENSIONS"}).render()
    return document


def _add_mark(space: Any, drawing: Sheet, mark: Mark, place: list[float], tip: list[float]) -> None:  # noqa: ANN401 (ezdxf)
    camera, layer = drawing.mounts[mark.camera].camera, {"layer": "CAMERAS"}
    numbers = {"NAME": camera.name, "VIEW": mark.view.name, "MODULE": camera.module or ""}
    numbers |= {f"{axis}_MM": plain(1000.0 * value, 1) for axis, value in zip("XYZ", camera.position_m, strict=True)}
    turns = zip(("YAW_DEG", "PITCH_DEG", "ROLL_DEG"), angles_deg(camera), strict=True)
    numbers |= {name: plain(angle_deg, 2) for name, angle_deg in turns}
    drawn = [space.add_blockref(BLOCK, place, dxfattribs=layer)]
    for name, value in numbers.items():
        attribute = drawn[0].add_attrib(name, value, place, dxfattribs=layer | {"height": drawing.scale})
        attribute.is_invisible = True
    if place != tip:
        ahead = np.subtract(tip, place) / np.linalg.norm(np.subtract(tip, place))
        foot, side = (
            np.asarray(tip) - 2.2 * drawing.scale * ahead,
            0.6 * drawing.scale * np.array([-ahead[1], ahead[0]]),
        )
        corner = [np.round(each, 3).tolist() for each in (np.asarray(tip), foot + side, foot - side)]
        drawn += [space.add_line(place, tip, dxfattribs=layer), space.add_solid(corner, dxfattribs=layer)]
    for each in drawn:
        each.rgb = camera_rgb(mark.camera)


@contextlib.contextmanager
def _fixed_metadata(ezdxf: Any) -> Iterator[None]:  # noqa: ANN401 (a module)
    """The file carries no time and no random number."""
    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True
    try:
        yield
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before
