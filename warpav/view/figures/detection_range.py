"""How far road users are detected, and how many cameras see one, by direction."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.detection.probability import DetectionProbability
from warpav.evaluation.detection_range import LEAST_HEIGHT_PX, DetectionRange
from warpav.sight.around import CAR_HEIGHT_M, PIXELS, SectorCounts
from warpav.view.figures.from_above import (
    RINGS,
    draw_surroundings,
    middle_of,
    panels_with_key,
    ring_radii_m,
    write_distance,
    write_key,
)
from warpav.view.figures.style import paper, title
from warpav.view.palette import COVERAGE_RGB, INK_RGB, camera_rgb, hex_colour

if TYPE_CHECKING:
    from warpav.raster.camera import CameraModel
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
_DIRECTIONS = ["front", "45°", "left", "135°", "rear", "-135°", "right", "-45°"]


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
    first, is_one = next(iter(found.values())), len(rigs) == 1
    panels_of = [list(enumerate(first.categories))] if is_one else [[each] for each in enumerate(first.categories)]
    names = first.categories if is_one else list(rigs)
    limits_m = {name: each.limit_m() for name, each in found.items()}
    reach_m = max(float(np.minimum(each.range_m(0.5), limits_m[name]).max()) for name, each in found.items())
    reach_m = min(1.08 * max(reach_m, first.distances_m[0]), 1.02 * first.distances_m[-1])
    text = (
        f"From the middle of the vehicle, up to {first.distances_m[-1]:g} m. Nothing hides the road user. Fitted "
        f"model, best camera.\nIt speaks for images at least {LEAST_HEIGHT_PX:g} px high in the detector's input.\n"
        "Distances follow from sizes of images, not from tests at these distances."
    )
    size: Any = {"panel_inch": 6.2 if is_one else 3.4, "key_lines": 1 + max(len(names), 3), "projection": "polar"}
    columns = min(3, len(panels_of))
    with panels_with_key(len(panels_of), columns, **size, text=text, heading=heading) as (figure, panels, key):
        for axis, shown in zip(panels, panels_of, strict=True):
            _prepare(axis, reach_m, is_large=is_one)
            for index, (row, _) in enumerate(shown):
                for number, (name, each) in enumerate(found.items()):
                    ranges_m = {least: each.range_m(least)[row] for least in _LEVELS}
                    place = index if is_one else number
                    _draw_ranges(axis, first.azimuth_rad, ranges_m, limits_m[name][row], place, _TICK * reach_m)
            if not is_one:
                axis.set_title(shown[0][1], pad=_TITLE_PAD_PT)
        lines = [Line2D([], [], label=each, **_mark(k)) for k, each in enumerate(names)]
        ink, words = hex_colour(INK_RGB), "detected with a probability of at least"
        levels = [Line2D([], [], color=ink, linestyle=style, label=f"{words} {k:g}") for k, style in _LEVELS.items()]
        limit = f"at least so far (both): beyond the ticks, its image is less than {LEAST_HEIGHT_PX:g} px high"
        levels.append(Line2D([], [], color=ink, marker=2, markersize=5, label=limit))
        write_key(key, {"Road user" if is_one else "Rig": lines, "Up to this distance": levels}, widths=(1, 2))
        figure.get_layout_engine().set(w_pad=0.1)  # names of directions beside each other
    return figure


def _mark(place: int) -> dict[str, Any]:
    style = {"markersize": 5, "markeredgecolor": "white", "markeredgewidth": 0.6}
    return {"color": hex_colour(camera_rgb(place)), "marker": _MARKERS[place % len(_MARKERS)], **style}


def _draw_ranges(
    axis: Any,  # noqa: ANN401 (matplotlib)
    azimuth_rad: np.ndarray,
    ranges_m: Mapping[float, np.ndarray],
    limit_m: np.ndarray,
    place: int,
    tick_m: float,
) -> None:
    """Draw ranges by azimuth, one for each of `_LEVELS`, with marks by which they are known without their colour.

    Where one ends at the limit of the model it is whole, whatever its style elsewhere, and the widest has ticks there.
    """
    colour = hex_colour(camera_rgb(place))
    at = np.arange((2 * place) % _MARK_EVERY, len(azimuth_rad), _MARK_EVERY)
    for least, range_m in ranges_m.items():
        line_m, is_cut = np.minimum(range_m, limit_m), (range_m >= limit_m - 1e-6) & (limit_m > 0.0)
        # between a cut and an uncut direction the line belongs to the range
        is_range = ~is_cut | np.roll(~is_cut, 1) | np.roll(~is_cut, -1)
        for shown, dashes in ((is_range, _LEVELS[least]), (is_cut, "-")):
            part_m = np.where(shown, line_m, np.nan)
            turn_rad = np.append(azimuth_rad, 2.0 * np.pi)
            axis.plot(turn_rad, np.append(part_m, part_m[0]), color=colour, linestyle=dashes, linewidth=1.5)
        if least == min(ranges_m):
            cut = np.flatnonzero(is_cut)
            cut = cut[cut % _TICK_EVERY == 0]
            ends_m = np.stack([limit_m[cut], limit_m[cut] + tick_m, np.full(len(cut), np.nan)], axis=1)
            axis.plot(np.repeat(azimuth_rad[cut], 3), ends_m.ravel(), color=colour, linewidth=0.9)
        marked = at[line_m[at] > 0.0]
        axis.plot(azimuth_rad[marked], line_m[marked], linestyle="none", zorder=2.5, **_mark(place))


def _prepare(axis: Any, reach_m: float, *, is_large: bool) -> None:  # noqa: ANN401 (matplotlib)
    """Polar axes with the front up and the left on the left, rings in metres."""
    axis.set_theta_zero_location("N")
    axis.set_thetagrids(range(0, 360, 45), _DIRECTIONS, fontsize=8)
    ring_m = ring_radii_m(reach_m)
    axis.set_rgrids(ring_m, [""] * len(ring_m))
    axis.set_ylim(0.0, reach_m)
    # as many as there is room for: the innermost is among the lines, the outermost beside the names of directions
    step = 1 if is_large else 2
    for each in ring_m[step - 1 :: step]:
        if each < (1.0 - _LEAST_GAP) * reach_m:
            write_distance(axis, (_RING_AZIMUTH_RAD, each), each, bbox=paper(0.5, 0.5), zorder=3)


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
    from matplotlib.patches import Patch

    counts_of = {name: SectorCounts.of(rig, ego) for name, rig in rigs.items()}
    sectors = np.max([counts.sees.any(axis=0).sum(axis=0) for counts in counts_of.values()], axis=0)
    bands = int(np.flatnonzero(sectors >= _SECTOR_SHARE * sectors.max())[-1]) + 1
    text = f"{RINGS} Level ground, nothing but the own body in the way."
    size: Any = {"panel_inch": 4.65, "key_lines": 5, "text": text, "heading": heading}
    with panels_with_key(2 * len(rigs), 2, **size) as (figure, panels, key):
        for (name, rig), whole, less in zip(rigs.items(), panels[::2], panels[1::2], strict=True):
            counts, beyond = counts_of[name].within(bands), _beyond(counts_of[name], bands)
            prefix, lost = f"{name}: " if len(rigs) > 1 else "", counts.costliest
            without = f"without {counts.camera[lost]}"
            for axis, count, words in ((whole, counts.count, "all cameras"), (less, counts.without(lost), without)):
                draw_surroundings(axis, ego, rig, reach_m=1.02 * counts.edges_m[-1], camera_size=0.0)
                _draw_cells(axis, count, np.array(counts.edges_m), middle_of(ego))
                title(axis, f"{prefix}{words}")
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
    return figure


def _draw_cells(axis: Any, count: np.ndarray, edges_m: np.ndarray, middle_m: np.ndarray) -> None:  # noqa: ANN401
    """Paint cells around a place by how many cameras see them, [sector, band]."""
    from matplotlib.colors import ListedColormap

    edge_rad = (np.arange(len(count) + 1) - 0.5) * 2.0 * math.pi / len(count)
    x_m, y_m = (middle_m[k] + edges_m * of(edge_rad)[:, None] for k, of in enumerate((np.cos, np.sin)))
    shown = np.ma.masked_less(np.minimum(count, len(COVERAGE_RGB) - 1), 0)
    colours = ListedColormap([hex_colour(rgb) for rgb in COVERAGE_RGB])
    style = {"cmap": colours, "vmin": -0.5, "vmax": len(COVERAGE_RGB) - 0.5, "edgecolors": "white", "linewidth": 0.3}
    axis.pcolormesh(y_m, x_m, shown, **style, zorder=2)


def _beyond(counts: SectorCounts, bands: int) -> str:
    """What cameras see farther than a number of bands, in words; nothing where they do not."""
    seen = np.asarray(counts.sees.any(axis=0))[:, bands:]
    if not seen.any():
        return ""
    farthest_m = counts.edges_m[bands + 1 + int(np.flatnonzero(seen.any(axis=0))[-1])]
    return f"not drawn: seen up to {farthest_m:g} m in {int(seen.any(axis=1).sum())} of {len(seen)} directions"
