"""What all figures share: style, files, panels, headings, marks, and sheets to print."""

from __future__ import annotations

import io
import math
import os
import re
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import ArgumentError, InputError
from warpav.view._labels import Labels, around
from warpav.view._output import write_bytes
from warpav.view._palette import GRID_RGB, INK_RGB, MUTED_RGB, PAPER_RGB, camera_rgb, hex_colour

if TYPE_CHECKING:
    from warpav.rig import RigCamera

WIDTH_INCH = 9.0
DOTS_PER_INCH = 150
_METADATA: dict[str, Any] = {
    ".png": {"Software": None},
    ".pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    ".svg": {"Creator": None, "Date": None},
}
"""By suffix, without times and versions."""

FIGURE_SUFFIXES = tuple(_METADATA)

_STYLE: Any = {
    "font.size": 10.0,
    "text.parse_math": False,  # names may hold dollars
    "axes.titlesize": 11.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": hex_colour(MUTED_RGB),
    "axes.labelcolor": hex_colour(INK_RGB),
    "axes.titlecolor": hex_colour(INK_RGB),
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": hex_colour(GRID_RGB),
    "grid.linewidth": 0.8,
    "xtick.color": hex_colour(MUTED_RGB),
    "ytick.color": hex_colour(MUTED_RGB),
    "text.color": hex_colour(INK_RGB),
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "lines.linewidth": 1.8,
    "lines.solid_capstyle": "round",
    "figure.facecolor": hex_colour(PAPER_RGB),
}


PALE = ("pale", "#f4f6f9", "#a9b5c6")
"""Greys that leave room for the colours of the cameras, for `colour_map`: low is light, high is darker."""


def figure_style() -> Any:  # noqa: ANN401 (a context manager of matplotlib)
    """A context in which figures have this module's fonts, lines and colours."""
    import matplotlib

    return matplotlib.rc_context(_STYLE)


def new_figure(width_inch: float, height_inch: float) -> Any:  # noqa: ANN401 (matplotlib)
    """A figure that belongs to no window, whatever backend the caller's notebook uses."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_inch, height_inch), dpi=DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def figure_bytes(figure: Any, suffix: str) -> bytes:  # noqa: ANN401 (matplotlib)
    """A figure as a file of a kind, the same every time."""
    import matplotlib

    encoded = io.BytesIO()
    if suffix == ".png":  # `savefig` would draw twice; the default level takes twice as long
        figure.canvas.print_png(encoded, metadata=_METADATA[suffix], pil_kwargs={"compress_level": 4})
        return encoded.getvalue()
    with matplotlib.rc_context({"svg.hashsalt": "warpav"}):
        figure.savefig(encoded, format=suffix[1:], metadata=_METADATA[suffix])
    return encoded.getvalue()


def save_figure(figure: Any, path: Path | str) -> Path:  # noqa: ANN401 (matplotlib)
    """Write a figure as a file that appears whole or not at all, the same every time; missing folders are made."""
    path = Path(path)
    return write_bytes(path, figure_bytes(figure, path.suffix.lower()))


def checked_figure(path: Path | str, suffixes: Sequence[str] = FIGURE_SUFFIXES) -> Path:
    """The path of a figure to write, which has one of these suffixes."""
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        expected = ", ".join(suffixes)
        raise ArgumentError("out", f"expected a name that ends in {expected}, got {path.suffix!r}", place=path)
    return path


def show_image(axis: Any, rgb: np.ndarray) -> None:  # noqa: ANN401 (matplotlib)
    axis.imshow(rgb, interpolation="antialiased", aspect="auto")
    empty_panel(axis)


def empty_panel(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
    axis.grid(visible=False)
    axis.set(xticks=[], yticks=[])
    for spine in axis.spines.values():
        spine.set(visible=True, color=hex_colour(GRID_RGB), linewidth=1.0)


def panel_sizes_px(figure: Any, axes: Iterable[Any]) -> list[tuple[int, int]]:  # noqa: ANN401 (matplotlib)
    """Width and height of panels as the layout leaves them [px]; titles and captions come before."""
    figure.draw_without_rendering()
    extents = [axis.get_window_extent() for axis in axes]
    return [(round(extent.width), round(extent.height)) for extent in extents]


def title(axis: Any, text: str, remark: str = "") -> None:  # noqa: ANN401 (matplotlib)
    """A heading on the left and a remark on the right; no longer together than the panel is wide."""
    axis.set_title(text)
    axis.set_title(remark, loc="right", fontweight="normal", fontsize=9)


def caption(figure: Any, text: str, heading: str | None = None) -> None:  # noqa: ANN401 (matplotlib)
    """Lines below all panels, clear of their labels, and a heading above them."""
    figure.get_layout_engine().set(h_pad=0.07)
    figure.supxlabel(text, fontsize=9, color=hex_colour(MUTED_RGB))
    if heading:
        figure.suptitle(heading, x=0.01, ha="left", fontweight="bold")


def colour_bar(figure: Any, image: Any, axes: Any, label: str = "", **style: Any) -> None:  # noqa: ANN401 (matplotlib)
    """A bar that says what the colours of an image mean, without a frame."""
    bar = figure.colorbar(image, ax=axes, **{"pad": 0.02, "aspect": 28} | style)
    low, high = image.get_clim()
    ticks = np.linspace(low, high, 3)
    decimals = max(0, 1 - math.floor(math.log10(max(np.ptp(ticks) / 2.0, 1e-9))))
    bar.set_ticks(ticks, labels=None if "format" in style else [f"{each:.{decimals}f}" for each in ticks])
    bar.set_label(label)
    bar.outline.set_visible(False)


def colour_map(name: str, *stops: Any) -> Any:  # noqa: ANN401 (matplotlib)
    """A map of colours between stops, as hexadecimal text or sRGB."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list(name, [hex_colour(s) if isinstance(s, tuple) else s for s in stops])


def metre_axes(axis: Any, *, across: bool = True, up: bool = True) -> None:  # noqa: ANN401 (matplotlib)
    """A panel from above to scale that is drawn at (y, x): the front is up."""
    axis.set_aspect("equal")
    axis.xaxis.set_inverted(True)
    if across:
        axis.set_xlabel("y, left [m]")
    if up:
        axis.set_ylabel("x, forward [m]")


def closed(line: np.ndarray) -> np.ndarray:
    """A line through points [point, 2] and back to the first."""
    return np.vstack([line, line[:1]])


def paper(pad: float, alpha: float) -> dict[str, Any]:
    """What stands behind a text so that it is read on lines, for ``bbox``."""
    return {"facecolor": "white", "edgecolor": "none", "pad": pad, "alpha": alpha}


def halo(width: float = 2.5) -> list[Any]:
    """What surrounds a text so that it is read on colours, for ``path_effects``."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=width, foreground="white")]


def count_text(count: int, what: str = "points") -> str:
    """A count to three digits, such as 7.37 million points."""
    number = f"{count / 1e6:.3g} million" if count >= 1_000_000 else f"{count:,}".replace(",", " ")
    return f"{number} {what.removesuffix('s') if count == 1 else what}"


SCALES = (10, 20, 25, 50, 75, 100, 125, 150, 200, 250, 400, 500, 1000, 2000)
"""Of a drawing: 20 stands for 1 : 20."""


class Page:
    def __init__(self, width_mm: float, height_mm: float) -> None:
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


def short_names(cameras: Sequence[RigCamera]) -> list[str]:
    """The name of every camera in a few letters, unique: whole, else initials, such as FL of front_left, else numbers.

    What all names share, and words with digits, say nothing: of CAM_FRONT and CAM_BACK they are F and B, of camera_0
    and camera_1 they are 0 and 1.
    """
    names = [camera.name for camera in cameras]
    if all(len(name) <= 5 and name.isalnum() for name in names):
        return names
    words = [re.split(r"[\W_]+", name) for name in names]
    shared = set.intersection(*map(set, words)) if len(names) > 1 else set()
    for letters in (1, 2, 3):
        short = [
            "".join(word[:letters].title() for word in each if word.isalpha() and word not in shared)
            + (each[-1] if each[-1].isdigit() else "")
            for each in words
        ]
        if all(short) and len(set(short)) == len(short):
            return short
    return [str(index + 1) for index in range(len(names))]


def long_names(cameras: Sequence[RigCamera]) -> list[str]:
    """The name of every camera behind its short form, where this is another."""
    pairs = zip(short_names(cameras), cameras, strict=True)
    return [camera.name if short == camera.name else f"{short} {camera.name}" for short, camera in pairs]


def date_text() -> str:
    """The date of a drawing, such as 2026-11-27: today's, or that of ``SOURCE_DATE_EPOCH``."""
    seconds = os.environ.get("SOURCE_DATE_EPOCH")
    if not seconds:
        return time.strftime("%Y-%m-%d")
    try:
        return time.strftime("%Y-%m-%d", time.gmtime(int(seconds)))
    except (ValueError, OverflowError, OSError):
        raise InputError(f"SOURCE_DATE_EPOCH: expected seconds since 1970, got {seconds!r}") from None


def camera_cells(camera: RigCamera) -> tuple[str, str]:
    """Cells of a camera in a table: module or lens, size of the image."""
    model = camera.model
    lens = "" if model.lens == "pinhole" else f" {model.lens}"
    return camera.module or f"{math.degrees(model.fov_rad):.0f}°{lens}", model.size_text


def badge_pt(text: str) -> np.ndarray:
    """Width and height of a badge [pt]."""
    return np.array([3.9 * len(text) + 3.5, 7.6])


def draw_badge(axis: Any, at: np.ndarray, text: str, colour: str) -> None:  # noqa: ANN401 (matplotlib)
    """Write the name of a camera in white on its colour."""
    box = {"boxstyle": "round,pad=0.25", "facecolor": colour, "edgecolor": "white", "linewidth": 0.6}
    style = {"fontsize": 5.5, "color": "white", "fontweight": "bold", "ha": "center", "va": "center_baseline"}
    axis.text(*at, text, bbox=box, zorder=10, **style)


def unit_per_pt(axis: Any) -> float:  # noqa: ANN401 (matplotlib)
    """How many units of a panel to scale are a point, about: the layout may still change it."""
    box, ranges = axis.get_window_extent(), np.ptp([axis.get_xlim(), axis.get_ylim()], axis=1)
    return float((ranges / [box.width, box.height]).max()) * axis.figure.dpi / 72.0


def mark_cameras(axis: Any, cameras: Sequence[RigCamera], place: np.ndarray | None = None) -> None:  # noqa: ANN401
    """Mark places of cameras, by default (y, x), with their short names; beside the marks where these are close."""
    place = np.array([each.position_m[1::-1] for each in cameras]) if place is None else place
    names, per_pt = short_names(cameras), unit_per_pt(axis)
    half = 2.2 * per_pt
    labels = Labels(np.hstack([place - half, place + half]))
    dot = {"marker": "o", "markersize": 4.0, "markeredgecolor": "white", "markeredgewidth": 0.6, "zorder": 7}
    size = per_pt * (badge_pt(max(names, key=len)) + 1.0)
    for index, (at, text) in enumerate(zip(place, names, strict=True)):
        colour = hex_colour(camera_rgb(index))
        axis.plot(*at, color=colour, **dot)
        away = [per_pt * k for k in (3.0, 6.0, 10.0, 15.0, 21.0)]
        tried = around(at, size, away, math.atan2(*(at - place.mean(axis=0))[::-1]))
        if (np.abs(place - at) < size).all(axis=1).sum() == 1:
            tried = at[None]
        beside = tried[labels.put(tried, size)]
        axis.plot(*np.stack([at, beside]).T, color=colour, linewidth=0.5, zorder=6)
        draw_badge(axis, beside, text, colour)


def text_points(height_mm: float) -> float:
    """The size of a font whose capital letters are so high, in points."""
    return height_mm / 0.72 / 25.4 * 72.0


def text_width_mm(text: str, height_mm: float, *, is_bold: bool = False) -> float:
    """How wide a text is whose capital letters are so high."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(weight="bold" if is_bold else "normal", size=text_points(height_mm))
    return text_to_path.get_text_width_height_descent(text, font, ismath=False)[0] / 72.0 * 25.4
