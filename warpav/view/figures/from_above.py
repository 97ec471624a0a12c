"""What figures seen from above with the front up share: the vehicle to scale, range rings in metres, cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.figures.style import WIDTH_INCH, empty_panel, new_figure
from warpav.view.palette import GRID_RGB, INK_RGB, MUTED_RGB, camera_rgb, hex_colour

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig

KEY_LINE_INCH = 0.185
"""Height of a line of a key [inch]."""

RINGS = "Rings: distance from the middle of the vehicle."


def middle_of(ego: Mesh) -> np.ndarray:
    """Middle of a vehicle's bounds, x and y [m], float64 [2]."""
    return np.asarray(ego.bounds_m(), np.float64)[:, :2].mean(axis=0)


def ring_radii_m(reach_m: float) -> list[float]:
    """Round radii of range rings up to a distance [m], four to eight of them."""
    power = 10.0 ** math.floor(math.log10(reach_m / 4.0))
    step_m = max(step for step in (power, 2.0 * power, 5.0 * power) if step <= reach_m / 4.0)
    return [step_m * k for k in range(1, math.floor(reach_m / step_m + 1e-9) + 1)]


def draw_surroundings(
    axis: Any,  # noqa: ANN401 (matplotlib)
    ego: Mesh,
    rig: Rig,
    *,
    reach_m: float,
    ring_m: Sequence[float] | None = None,
    camera_size: float = 4.0,
) -> None:
    """Prepare a panel from above, x upwards and y to the left: the vehicle, its cameras, rings, an arrow to the front.

    What is drawn into it is drawn at (y, x).
    """
    from matplotlib.patches import Circle, PathPatch
    from matplotlib.path import Path

    empty_panel(axis)
    x_m, y_m = middle_of(ego)
    axis.set(xlim=(y_m + reach_m, y_m - reach_m), ylim=(x_m - reach_m, x_m + reach_m), aspect="equal")
    corner_m = np.asarray(ego.vertex_m)[np.asarray(ego.triangle)][:, [0, 1, 2, 0]][:, :, [1, 0]]
    along, across = corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0]
    is_back = along[:, 0] * across[:, 1] < along[:, 1] * across[:, 0]
    corner_m[is_back] = corner_m[is_back, ::-1]  # all one way round: what lies over another does not undo it
    triangle = [Path.MOVETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]
    outline = Path(corner_m.reshape(-1, 2), triangle * len(corner_m))  # one path: ten thousand would take a second
    for rgb, width, order in ((INK_RGB, 1.6, 5.0), (GRID_RGB, 0.5, 5.1)):
        colour = hex_colour(rgb)
        body = PathPatch(outline, facecolor=colour, edgecolor=colour, linewidth=width, zorder=order, rasterized=True)
        axis.add_artist(body)
    for index, camera in enumerate(rig.cameras if camera_size else ()):
        mark = {"color": hex_colour(camera_rgb(index)), "markeredgecolor": "white", "markeredgewidth": 0.5}
        axis.plot(camera.position_m[1], camera.position_m[0], "o", markersize=camera_size, zorder=7, **mark)
    grey, ink = hex_colour(MUTED_RGB), hex_colour(INK_RGB)
    paper = {"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.75}
    inside_m = 0.5 * float(np.ptp(np.asarray(ego.bounds_m()), axis=0)[:2].max())
    for radius_m in ring_radii_m(reach_m) if ring_m is None else ring_m:
        if radius_m < inside_m:
            continue
        ring = {"fill": False, "edgecolor": grey, "linewidth": 0.6, "linestyle": (0, (5, 3))}
        axis.add_patch(Circle((y_m, x_m), radius_m, zorder=6, **ring))
        turn = math.radians(225.0)  # behind on the right, where rarely anything is written
        place = (y_m + radius_m * math.sin(turn), x_m + radius_m * math.cos(turn))
        axis.text(*place, f"{radius_m:g} m", fontsize=7, color=ink, ha="center", va="center", bbox=paper, zorder=8)
    axis.annotate(
        "front",
        (0.5, 1.0),
        xytext=(0.5, 0.93),
        xycoords="axes fraction",
        ha="center",
        va="top",
        fontsize=7,
        color=ink,
        arrowprops={"arrowstyle": "-|>", "color": ink, "linewidth": 0.8},
        bbox=paper,
        zorder=8,
    )


def panels_with_key(
    count: int, columns: int, *, panel_inch: float, key_lines: int, projection: str | None = None
) -> tuple[Any, list[Any], Any]:
    """A figure with rows of square panels above a key."""
    rows = -(-count // columns)
    key_inch = KEY_LINE_INCH * key_lines + 0.05
    figure = new_figure(WIDTH_INCH, panel_inch * rows + key_inch + 0.3)
    grid = figure.add_gridspec(rows + 1, columns, height_ratios=[*[panel_inch] * rows, key_inch])
    panels = [figure.add_subplot(grid[k // columns, k % columns], projection=projection) for k in range(count)]
    return figure, panels, figure.add_subplot(grid[rows, :])


def write_key(
    axis: Any,  # noqa: ANN401 (matplotlib)
    groups: Mapping[str, Sequence[Any]],
    *,
    columns: Sequence[int] | None = None,
    widths: Sequence[float] | None = None,
) -> None:
    """Write the key of a figure into a panel of its own: groups side by side, each with a heading."""
    from matplotlib.lines import Line2D

    axis.set_axis_off()
    columns = [1] * len(groups) if columns is None else columns
    widths = columns if widths is None else widths
    place = 0.0
    for (name, lines), count, width in zip(groups.items(), columns, widths, strict=True):
        handles = [Line2D([], [], color="none", label=each) if isinstance(each, str) else each for each in lines]
        is_text = isinstance(lines[0], str)
        key = axis.legend(
            handles=handles,
            title=name,
            loc="upper left",
            bbox_to_anchor=(place, 1.0),
            ncols=count,
            fontsize=8,
            title_fontproperties={"size": 8, "weight": "bold"},
            alignment="left",
            borderaxespad=0.0,
            borderpad=0.0,
            handlelength=0.0 if is_text else 1.4,
            handletextpad=0.0 if is_text else 0.8,
            columnspacing=1.2,
        )
        axis.add_artist(key)
        place += width / sum(widths)
    axis.legend_ = None


def camera_handles(rigs: Mapping[str, Rig]) -> dict[str, list[Any]]:
    """Handles of a key for cameras: numbers and names.

    Where several rigs do not share the names, each rig's are under its own.
    """
    from matplotlib.patches import Patch

    def named(rig: Rig) -> list[Any]:
        return [
            Patch(color=hex_colour(camera_rgb(k)), label=f"{k + 1} {camera.name}")
            for k, camera in enumerate(rig.cameras)
        ]

    largest = max(rigs.values(), key=lambda rig: len(rig.cameras))
    name = [camera.name for camera in largest.cameras]
    if all([camera.name for camera in rig.cameras] == name[: len(rig.cameras)] for rig in rigs.values()):
        return {"cameras": named(largest)}
    return {f"cameras of {key}": named(rig) for key, rig in rigs.items()}
