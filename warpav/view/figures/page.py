"""Pages to print, in millimetres from the upper left corner, with panels to scale and tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from warpav.view.figures.style import new_figure
from warpav.view.palette import INK_RGB, camera_rgb, hex_colour

SCALES = (10, 20, 25, 50, 75, 100, 125, 150, 200, 250, 400, 500, 1000, 2000)
"""Of a drawing: 20 stands for 1 : 20."""


class Page:
    """A figure in the size of a page."""

    def __init__(self, width_mm: float, height_mm: float) -> None:
        """An empty page."""
        self.width_mm, self.height_mm = width_mm, height_mm
        self.figure = new_figure(width_mm / 25.4, height_mm / 25.4)
        self.figure.set_layout_engine("none")

    def panel(self, left_mm: float, top_mm: float, width_mm: float, height_mm: float) -> Any:  # noqa: ANN401 (matplotlib)
        """Axes without ticks or a frame, whose upper left corner is there."""
        bottom_mm = self.height_mm - top_mm - height_mm
        across, up = self.width_mm, self.height_mm
        axis = self.figure.add_axes((left_mm / across, bottom_mm / up, width_mm / across, height_mm / up))
        axis.set(xticks=[], yticks=[])
        axis.grid(visible=False)
        axis.spines[:].set_visible(False)
        return axis

    def text(self, left_mm: float, top_mm: float, text: str, *, va: str = "top", **style: Any) -> None:  # noqa: ANN401
        """Write a text; its upper edge is so far below the page's."""
        self.figure.text(left_mm / self.width_mm, 1.0 - top_mm / self.height_mm, text, va=va, **style)

    def camera_table(
        self,
        rows: Sequence[Sequence[str]],
        column_mm: Sequence[float],
        *,
        left_mm: float,
        top_mm: float,
        row_mm: float,
        fontsize: float = 7.0,
    ) -> None:
        """Write a table: a heading, then a row for each camera, whose first cell is in its colour."""
        for line, row in enumerate(rows):
            for column, text in enumerate(row):
                self.text(
                    left_mm + column_mm[column],
                    top_mm + line * row_mm,
                    text,
                    fontsize=fontsize,
                    color=hex_colour(camera_rgb(line - 1)) if line and not column else hex_colour(INK_RGB),
                    fontweight="bold" if not line or not column else "normal",
                )


def camera_mark(colour: str) -> dict[str, Any]:
    """How the place of a camera is drawn, for ``plot`` of an axis."""
    return {"marker": "o", "markersize": 6.5, "color": colour, "markeredgecolor": "white", "markeredgewidth": 0.6}


def camera_digit() -> dict[str, Any]:
    """How its number is written on that, for ``text`` of an axis."""
    return {"fontsize": 5, "color": "white", "fontweight": "bold", "ha": "center", "va": "center_baseline"}
