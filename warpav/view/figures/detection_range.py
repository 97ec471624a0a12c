"""How far road users are detected, and how many cameras see one, by direction."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.detection.probability import DetectionProbability
from warpav.evaluation.detection_range import LEAST_HEIGHT_PX, DetectionRange
from warpav.sight.around import CAR_HEIGHT_M, PIXELS, SectorCounts
from warpav.view.figures.plan import RINGS, draw_surroundings, middle_of, panels_with_key, ring_radii_m, write_key
from warpav.view.figures.style import caption, figure_style, title
from warpav.view.palette import COVERAGE_RGB, INK_RGB, camera_rgb, hex_colour

if TYPE_CHECKING:
    from warpav.raster.camera import CameraModel
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig
if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig

_LEVELS = {0.5: "-", 0.9: (0, (4, 1.5))}
_MARKERS = "os^Dv"
"""Of lines in their order; beyond the last they begin again."""
_MARK_EVERY = 9
"""Directions from mark to mark: those of lines after each other are between each other's."""
_TICK_EVERY = 2
"""Directions from tick to tick where a line ends at the limit of the model."""
_TICK = 0.022
"""Length of a tick over the radius of the panel."""
_TITLE_PAD_PT = 14.0
"""From a title to the panel: the name of the front is between them."""
_LEAST_GAP = 0.07
"""Between the outermost ring whose distance is written and the border, over the radius of the panel."""
_RING_AZIMUTH_RAD = math.radians(202.5)
"""Where distances of rings are written."""


def range_figure(
    rigs: Mapping[str, Rig],
    ego: Mesh,
    *,
    probability: Callable[[CameraModel], DetectionProbability] | None = None,
    heading: str | None = None,
) -> Any:  # noqa: ANN401 (matplotlib)
    """Distances up to which an unoccluded road user is found with a probability of .5 and of .9 by the best camera.

    The probability is that of the fitted model (`warpav.detection.probability`), from what a render shows of the road
    user alone: area, shape, distance from the image's border. It heads as the own vehicle does, has the contrast of an
    average object, and stands every 5 degrees at 18 distances from 5 to 500 m; see
    `warpav.evaluation.detection_range`. Lines end where the image becomes smaller than the model speaks for
    (`DetectionRange.limit_m`) and have ticks outwards there: the road user is found up to there, and nothing is known
    of what is farther. The model knows neither haze nor blur: it says what the detector makes of so many clean pixels.
    """
    from matplotlib.lines import Line2D

    model_of = DetectionProbability.builtin if probability is None else probability
    found = {name: DetectionRange.of(rig, ego, probability=model_of) for name, rig in rigs.items()}
    first = next(iter(found.values()))
    is_one = len(rigs) == 1
    panels_of = [list(enumerate(first.categories))] if is_one else [[each] for each in enumerate(first.categories)]
    names = first.categories if is_one else list(rigs)
    with figure_style():
        columns = min(3, len(panels_of))
        figure, panels, key = panels_with_key(
            len(panels_of),
            columns,
            panel_inch=6.2 if is_one else 3.4,
            key_lines=1 + max(len(names), 3),
            projection="polar",
        )
        turn = np.append(first.azimuth_rad, 2.0 * np.pi)
        limits_m = {name: each.limit_m() for name, each in found.items()}
        reach_m = max(float(np.minimum(each.range_m(0.5), limits_m[name]).max()) for name, each in found.items())
        reach_m = min(1.08 * max(reach_m, first.distances_m[0]), 1.02 * first.distances_m[-1])
        for axis, shown in zip(panels, panels_of, strict=True):
            _prepare(axis, reach_m, is_large=is_one)
            for index, (row, _) in enumerate(shown):
                for number, (name, each) in enumerate(found.items()):
                    place = index if is_one else number
                    colour = hex_colour(camera_rgb(place))
                    limit_m = limits_m[name][row]
                    for least, style in _LEVELS.items():
                        _draw_line(axis, turn, each.range_m(least)[row], limit_m, colour, style)
                    _draw_limit(axis, first.azimuth_rad, each.range_m(0.5)[row], limit_m, colour, _TICK * reach_m)
                    for least in _LEVELS:
                        _draw_marks(axis, first.azimuth_rad, np.minimum(each.range_m(least)[row], limit_m), place)
            if not is_one:
                axis.set_title(shown[0][1], pad=_TITLE_PAD_PT)
        lines = [
            Line2D([], [], color=hex_colour(camera_rgb(k)), label=name, **_mark(k)) for k, name in enumerate(names)
        ]
        ink = hex_colour(INK_RGB)
        levels = [
            Line2D([], [], color=ink, linestyle=style, label=f"detected with a probability of at least {least:g}")
            for least, style in _LEVELS.items()
        ]
        limit = f"at least so far (both): beyond the ticks, its image is less than {LEAST_HEIGHT_PX:g} px high"
        levels.append(Line2D([], [], color=ink, marker=2, markersize=5, label=limit))
        write_key(key, {"Road user" if is_one else "Rig": lines, "Up to this distance": levels}, widths=(1, 2))
        caption(
            figure,
            f"From the middle of the vehicle, up to {first.distances_m[-1]:g} m. Nothing hides the road user. Fitted "
            f"model, best camera.\nIt speaks for images at least {LEAST_HEIGHT_PX:g} px high in the detector's input.\n"
            "Distances follow from sizes of images, not from tests at these distances.",
        )
        figure.get_layout_engine().set(w_pad=0.1)  # names of directions beside each other
        if heading:
            figure.suptitle(heading, x=0.01, ha="left", fontweight="bold")
        return figure


def _mark(place: int) -> dict[str, Any]:
    return {
        "marker": _MARKERS[place % len(_MARKERS)],
        "markersize": 5,
        "markeredgecolor": "white",
        "markeredgewidth": 0.6,
    }


def _draw_line(
    axis: Any,  # noqa: ANN401 (matplotlib)
    turn: np.ndarray,
    range_m: np.ndarray,
    limit_m: np.ndarray,
    colour: str,
    style: Any,  # noqa: ANN401 (of lines, as matplotlib takes it)
) -> None:
    """Draw a range by azimuth; where it ends at the limit of the model, whole, whatever its style elsewhere."""
    line_m = np.minimum(range_m, limit_m)
    is_cut = _is_cut(range_m, limit_m)
    # between a cut and an uncut direction the line belongs to the range
    is_range = ~is_cut | np.roll(~is_cut, 1) | np.roll(~is_cut, -1)
    for shown, dashes in ((is_range, style), (is_cut, "-")):
        part_m = np.where(shown, line_m, np.nan)
        axis.plot(turn, np.append(part_m, part_m[0]), color=colour, linestyle=dashes, linewidth=1.5)


def _is_cut(range_m: np.ndarray, limit_m: np.ndarray) -> np.ndarray:
    """Where a range ends at the limit of the model, bool [azimuth]."""
    return np.asarray((range_m >= limit_m - 1e-6) & (limit_m > 0.0))


def _draw_limit(
    axis: Any,  # noqa: ANN401 (matplotlib)
    azimuth_rad: np.ndarray,
    range_m: np.ndarray,
    limit_m: np.ndarray,
    colour: str,
    tick_m: float,
) -> None:
    """Draw ticks outwards where a range ends at the limit of the model."""
    cut = np.flatnonzero(_is_cut(range_m, limit_m))
    cut = cut[cut % _TICK_EVERY == 0]
    ends_m = [limit_m[cut], limit_m[cut] + tick_m, np.full(len(cut), np.nan)]
    axis.plot(np.repeat(azimuth_rad[cut], 3), np.stack(ends_m, axis=1).ravel(), color=colour, linewidth=0.9)


def _draw_marks(axis: Any, azimuth_rad: np.ndarray, line_m: np.ndarray, place: int) -> None:  # noqa: ANN401 (matplotlib)
    """Draw a line's marks, by which it is known without its colour."""
    at = np.arange((2 * place) % _MARK_EVERY, len(line_m), _MARK_EVERY)
    at = at[line_m[at] > 0.0]
    axis.plot(azimuth_rad[at], line_m[at], color=hex_colour(camera_rgb(place)), linestyle="none", **_mark(place))


def _prepare(axis: Any, reach_m: float, *, is_large: bool) -> None:  # noqa: ANN401 (matplotlib)
    """Polar axes with the front up and the left on the left, rings in metres."""
    axis.set_theta_zero_location("N")
    axis.set_thetagrids(
        range(0, 360, 45), ["front", "45°", "left", "135°", "rear", "-135°", "right", "-45°"], fontsize=8
    )
    ring_m = ring_radii_m(reach_m)
    axis.set_rgrids(ring_m, [""] * len(ring_m))
    axis.set_ylim(0.0, reach_m)
    paper = {"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.5}
    # as many as there is room for: the innermost is among the lines, the outermost beside the names of directions
    step = 1 if is_large else 2
    for each in ring_m[step - 1 :: step]:
        if each < (1.0 - _LEAST_GAP) * reach_m:
            style = {"fontsize": 7, "color": hex_colour(INK_RGB), "ha": "center", "va": "center", "bbox": paper}
            axis.text(_RING_AZIMUTH_RAD, each, f"{each:g} m", zorder=3, **style)


_SECTOR_SHARE = 0.5
_NAMES = ("no camera", "one camera", "two cameras", "three or more")


def redundancy_figure(rigs: Mapping[str, Rig], ego: Mesh, *, heading: str | None = None) -> Any:  # noqa: ANN401
    """Cells of 10 degrees and distance bands by how many cameras see a road user there; one row for each rig.

    On the left the whole rig, on the right the rig without the camera whose loss leaves most ground, by area, to no
    camera. A camera sees a road user in the middle of a cell where the point 0.75 m above level ground is in its image,
    the own body does not stand before it (a ray against the vehicle's mesh), and the image of a car there, 1.5 m high,
    is at least 12 px high through the lens. Bands are drawn up to the last that is seen in half of the directions of
    the one that is seen in most: one narrow camera that sees far does not make the others small.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    counts_of = {name: SectorCounts.of(rig, ego) for name, rig in rigs.items()}
    sectors = np.max([counts.sees.any(axis=0).sum(axis=0) for counts in counts_of.values()], axis=0)
    bands = int(np.flatnonzero(sectors >= _SECTOR_SHARE * sectors.max())[-1]) + 1
    with figure_style():
        figure, panels, key = panels_with_key(2 * len(rigs), 2, panel_inch=4.65, key_lines=5)
        colours = ListedColormap([hex_colour(rgb) for rgb in COVERAGE_RGB])
        for (name, rig), whole, less in zip(rigs.items(), panels[::2], panels[1::2], strict=True):
            counts, beyond = counts_of[name].within(bands), _beyond(counts_of[name], bands)
            prefix = f"{name}: " if len(rigs) > 1 else ""
            lost = counts.costliest
            for axis, count, text in (
                (whole, counts.count, "all cameras"),
                (less, counts.without(lost), f"without {counts.camera[lost]}"),
            ):
                draw_surroundings(axis, ego, rig, reach_m=1.02 * counts.edges_m[-1], camera_size=0.0)
                edge_rad = (np.arange(len(count) + 1) - 0.5) * 2.0 * math.pi / len(count)
                x_m, y_m = middle_of(ego)
                axis.pcolormesh(
                    y_m + np.array(counts.edges_m) * np.sin(edge_rad)[:, None],
                    x_m + np.array(counts.edges_m) * np.cos(edge_rad)[:, None],
                    np.ma.masked_less(np.minimum(count, len(COVERAGE_RGB) - 1), 0),
                    cmap=colours,
                    vmin=-0.5,
                    vmax=len(COVERAGE_RGB) - 0.5,
                    edgecolors="white",
                    linewidth=0.3,
                    zorder=2,
                )
                title(axis, f"{prefix}{text}")
                share = 100.0 * counts.blind_share(count)
                label = f"no camera on {share:.0f} % of the area within {counts.edges_m[-1]:g} m"
                axis.set_xlabel(f"{label}\n{beyond}" if axis is whole and beyond else label, fontsize=8)
        seen = [Patch(facecolor=hex_colour(rgb), label=name) for rgb, name in zip(COVERAGE_RGB, _NAMES, strict=True)]
        rule = [
            f"its middle, {0.5 * CAR_HEIGHT_M:g} m above ground, is in the image,",
            "the own body does not hide it, and the image of",
            f"a car {CAR_HEIGHT_M:g} m high is at least {PIXELS[-1]:g} px high there",
        ]
        loss = ["without the camera whose loss", "leaves most ground to no camera,", "whatever traffic is there"]
        groups = {"A road user is seen by": seen, "A camera sees it where": rule, "Right": loss}
        write_key(key, groups, widths=(3, 5, 4))
        caption(figure, f"{RINGS} Level ground, nothing but the own body in the way.")
        if heading:
            figure.suptitle(heading, x=0.01, ha="left", fontweight="bold")
        return figure


def _beyond(counts: SectorCounts, bands: int) -> str:
    """What cameras see farther than a number of bands, in words; nothing where they do not."""
    seen = np.asarray(counts.sees.any(axis=0))[:, bands:]
    if not seen.any():
        return ""
    farthest_m = counts.edges_m[bands + 1 + int(np.flatnonzero(seen.any(axis=0))[-1])]
    return f"not drawn: seen up to {farthest_m:g} m in {int(seen.any(axis=1).sum())} of {len(seen)} directions"
