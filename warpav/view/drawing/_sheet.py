"""A sheet to print: views, strokes, notes, dimensions and marks in millimetres of paper, and names clear of them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from warpav.view._labels import Labels, around
from warpav.view.figures._style import short_names, text_width_mm

if TYPE_CHECKING:
    from warpav.view.drawing._mounts import Mount

TEXT_MM = 2.2
"""Height of capital letters."""

_MARK_MM = 1.0
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

    @property
    def line_mm(self) -> np.ndarray:
        """Its line, from the feature to the number, with a bend where these are not in line."""
        along, sign = (1, 1.0) if self.is_across else (0, -1.0)
        bend_mm, before_mm = self.feature_mm.copy(), self.end_mm.copy()
        bend_mm[along] = self.end_mm[along] - sign * 7.0
        before_mm[along] -= sign * 2.0
        return np.stack([self.feature_mm, bend_mm, before_mm, self.end_mm])


@dataclass(frozen=True, eq=False)
class Mark:
    """A camera in a view: its optical centre, and the end of its arrow."""

    view: View
    camera: int
    place_mm: np.ndarray
    tip_mm: np.ndarray

    @property
    def cross_mm(self) -> np.ndarray:
        """The two lines through its place, [2, 2, 2]."""
        reach = 1.6 * _MARK_MM * np.eye(2)
        return np.stack([self.place_mm - reach, self.place_mm + reach], axis=1)


@dataclass(eq=False, kw_only=True)
class Sheet:
    scale: float
    views: tuple[View, ...]
    mounts: tuple[Mount, ...]
    strokes: list[Stroke] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    ordinates: list[Ordinate] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)


def circle_mm(centre_mm: np.ndarray, radius_mm: float = _MARK_MM, count: int = 49) -> np.ndarray:
    """Points around a place on the page, [point, 2]; the last is the first again."""
    turn_rad = np.linspace(0.0, 2.0 * math.pi, count)
    return centre_mm + radius_mm * np.stack([np.cos(turn_rad), np.sin(turn_rad)], axis=1)


def box_mm(low_mm: Sequence[float] | np.ndarray, high_mm: Sequence[float] | np.ndarray) -> np.ndarray:
    """Corners of a rectangle on the page, [4, 2]."""
    (x0, y0), (x1, y1) = low_mm, high_mm
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


_NAME_MM = 2.5
"""Height of the capital letters of a name."""

_CLEAR_MM = 0.6
"""Between a name and anything else."""

_AWAY_MM = (3.0, 4.0, 5.5, 7.0, 9.0, 11.0)
_SYMBOL_COST, _LINE_COST, _LEADER_COST = 1000.0, 1.0, 100.0
_STEP_MM = 0.4


def add_names(sheet: Sheet) -> None:
    """Name the marks of a sheet, after everything else in its views is there.

    A name stays off marks, arrows and other names, and where it can off lines. It is near its mark, behind the
    arrow rather than beside it. Marks that lie on each other and look the same way share a line of names.
    """
    symbols = [circle_mm(mark.place_mm, 1.6 * _MARK_MM, 17) for mark in sheet.marks]
    symbols += [_points_mm(np.stack([mark.place_mm, mark.tip_mm])) for mark in sheet.marks]
    symbol_mm, labels, names = np.concatenate(symbols), Labels(), short_names([mount.camera for mount in sheet.mounts])
    lines = [_points_mm(stroke.point_mm, is_closed=stroke.is_closed) for stroke in sheet.strokes]
    lines += [_points_mm(ordinate.line_mm) for ordinate in sheet.ordinates]
    for point_mm, weight in ((symbol_mm, _SYMBOL_COST), (np.concatenate(lines), _LINE_COST)):
        labels.take(np.hstack([point_mm, point_mm]), weight)
    for view in sheet.views:
        for group in _groups([mark for mark in sheet.marks if mark.view is view]):
            text = ", ".join(names[mark.camera] for mark in group)
            size_mm = np.array([text_width_mm(text, _NAME_MM, is_bold=True), _NAME_MM])
            place_mm = np.mean([mark.place_mm for mark in group], axis=0)
            ahead_mm = np.mean([mark.tip_mm for mark in group], axis=0) - place_mm
            back_rad = math.atan2(-ahead_mm[1], -ahead_mm[0]) if np.linalg.norm(ahead_mm) > 3.0 else 0.25 * math.pi
            tried_mm = around(place_mm, size_mm, _AWAY_MM, back_rad)
            leaders_mm = [_leader_mm(place_mm, each_mm, size_mm) for each_mm in tried_mm]
            from_mm, to_mm = np.swapaxes(leaders_mm, 0, 1)
            beyond_mm = np.linspace(from_mm, to_mm, 12, axis=1)[:, 3:, None]
            low_mm, high_mm = (end(beyond_mm, axis=(0, 1)) for end in (np.min, np.max))
            near_mm = symbol_mm[((symbol_mm > low_mm - _CLEAR_MM) & (symbol_mm < high_mm + _CLEAR_MM)).all(axis=1)]
            is_crossed = (np.linalg.norm(beyond_mm - near_mm, axis=-1) < 0.5 * _CLEAR_MM).any(axis=(1, 2))
            best = labels.put(tried_mm, size_mm + 2.0 * _CLEAR_MM, cost=_LEADER_COST * is_crossed, weight=_SYMBOL_COST)
            camera = group[0].camera
            sheet.notes.append(Note("CAMERAS", tuple(tried_mm[best].tolist()), text, _NAME_MM, "middle", camera))
            sheet.strokes.append(Stroke("CAMERAS", leaders_mm[best], camera=camera))
            leader_mm = _points_mm(leaders_mm[best])
            labels.take(np.hstack([leader_mm, leader_mm]), _SYMBOL_COST)
            symbol_mm = np.concatenate([symbol_mm, leader_mm])


def _leader_mm(place_mm: np.ndarray, middle_mm: np.ndarray, size_mm: np.ndarray) -> np.ndarray:
    half_mm = 0.5 * size_mm + 0.5 * _CLEAR_MM
    end_mm = np.clip(place_mm, middle_mm - half_mm, middle_mm + half_mm)
    towards = (end_mm - place_mm) / np.linalg.norm(end_mm - place_mm)
    return np.stack([place_mm + _MARK_MM * towards, end_mm])


def _points_mm(line_mm: np.ndarray, *, is_closed: bool = False) -> np.ndarray:
    line_mm = np.vstack([line_mm, line_mm[:1]]) if is_closed else line_mm
    parts = [
        np.linspace(start_mm, end_mm, 2 + int(np.linalg.norm(end_mm - start_mm) / _STEP_MM))
        for start_mm, end_mm in itertools.pairwise(line_mm)
    ]
    return np.concatenate(parts)


def _groups(marks: Sequence[Mark]) -> list[list[Mark]]:
    groups: list[list[Mark]] = []
    for mark in marks:
        for group in groups:
            first = group[0]
            apart_mm = max(np.linalg.norm(mark.place_mm - first.place_mm), np.linalg.norm(mark.tip_mm - first.tip_mm))
            if apart_mm < 2.0 * _MARK_MM:
                group.append(mark)
                break
        else:
            groups.append([mark])
    return groups
