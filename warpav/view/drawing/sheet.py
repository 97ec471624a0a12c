"""What is on a sheet: views, strokes, notes, dimensions and marks, in millimetres from its lower left corner."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warpav.view.drawing.mount_table import Mount

TEXT_MM = 2.2
"""Height of capital letters."""

MARK_MM = 1.0
"""Radius of the mark of a camera."""


@dataclass(frozen=True, eq=False)
class View:
    """A view of the vehicle on the page."""

    name: str
    right: np.ndarray
    up: np.ndarray
    datum_mm: np.ndarray
    scale: float

    def place_mm(self, point_m: np.ndarray) -> np.ndarray:
        """Where points of the ego frame [..., 3] are on the page, [..., 2]."""
        return self.datum_mm + 1000.0 / self.scale * (np.asarray(point_m) @ np.stack([self.right, self.up], axis=1))


@dataclass(frozen=True, eq=False)
class Stroke:
    """A line on the page through points [point, 2], on a layer; of a camera in its colour."""

    layer: str
    point_mm: np.ndarray
    is_closed: bool = False
    camera: int | None = None


@dataclass(frozen=True, eq=False)
class Note:
    """A line of text on the page; ``place_mm`` is the middle of its left end, of its middle or of its right end."""

    layer: str
    place_mm: tuple[float, float]
    text: str
    height_mm: float = TEXT_MM
    align: str = "left"
    camera: int | None = None


@dataclass(frozen=True, eq=False)
class Ordinate:
    """A coordinate of a point, from the datum of its view, as a line to its number (ISO 129 ordinate dimension)."""

    view: View
    feature_mm: np.ndarray
    end_mm: np.ndarray
    is_across: bool
    value_mm: float
    text: str


@dataclass(frozen=True, eq=False)
class Mark:
    """A camera in a view: its optical centre, and the end of its arrow."""

    view: View
    camera: int
    place_mm: np.ndarray
    tip_mm: np.ndarray


@dataclass(eq=False, kw_only=True)
class Sheet:
    """What is on a sheet."""

    scale: float
    views: tuple[View, ...]
    mounts: tuple[Mount, ...]
    strokes: list[Stroke] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    ordinates: list[Ordinate] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)


def ordinate_line_mm(ordinate: Ordinate) -> np.ndarray:
    """The line of a dimension on the page, from its feature to its number, with a bend where these are not in line."""
    along = 1 if ordinate.is_across else 0
    sign = 1.0 if ordinate.is_across else -1.0
    bend_mm = ordinate.feature_mm.copy()
    bend_mm[along] = ordinate.end_mm[along] - sign * 7.0
    before_mm = ordinate.end_mm.copy()
    before_mm[along] -= sign * 2.0
    return np.stack([ordinate.feature_mm, bend_mm, before_mm, ordinate.end_mm])


def text_width_mm(text: str, height_mm: float, *, is_bold: bool = False) -> float:
    """How wide a text is whose capital letters are so high."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(weight="bold" if is_bold else "normal", size=text_points(height_mm))
    return text_to_path.get_text_width_height_descent(text, font, ismath=False)[0] / 72.0 * 25.4


def text_points(height_mm: float) -> float:
    """The size of a font whose capital letters are so high, in points."""
    return height_mm / 0.72 / 25.4 * 72.0
