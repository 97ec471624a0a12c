"""Detection range by azimuth: polar lines up to which a detector is expected to find road users of each class."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.detection.probability import DetectionProbability
from warpav.evaluation.detection_range import DetectionRange
from warpav.view.figures.from_above import panels_with_key, ring_radii_m, write_key
from warpav.view.figures.style import caption, figure_style, title
from warpav.view.palette import INK_RGB, camera_rgb, hex_colour

if TYPE_CHECKING:
    from warpav.raster.camera import CameraModel
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig

_LEVELS = {0.5: "-", 0.9: (0, (4, 1.5))}


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
    `warpav.evaluation.detection_range`. Lines at 500 m mean that or more. The model knows neither haze nor blur:
    it says what the detector makes of so many clean pixels.

    Args:
        rigs: By name, at least one; of one, every class has a line; of several, every class has a panel.
        ego: The vehicle.
        probability: Gives the model for a camera; None: that of the detector which ships with warpav, for any camera.
        heading: Above the figure; None: none.

    Returns:
        A ``matplotlib.figure.Figure``.
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
            key_lines=1 + max(len(names), 2),
            projection="polar",
        )
        turn = np.append(first.azimuth_rad, 2.0 * np.pi)
        reach_m = max(float(each.range_m(0.5).max()) for each in found.values())
        reach_m = min(1.08 * max(reach_m, first.distances_m[0]), 1.02 * first.distances_m[-1])
        for axis, shown in zip(panels, panels_of, strict=True):
            _prepare(axis, reach_m)
            for index, (row, _) in enumerate(shown):
                for number, each in enumerate(found.values()):
                    colour = hex_colour(camera_rgb(index if is_one else number))
                    for least, style in _LEVELS.items():
                        line_m = each.range_m(least)[row]
                        axis.plot(turn, np.append(line_m, line_m[0]), color=colour, linestyle=style, linewidth=1.5)
            title(axis, "" if is_one else shown[0][1])
        lines = [Line2D([], [], color=hex_colour(camera_rgb(k)), label=name) for k, name in enumerate(names)]
        ink = hex_colour(INK_RGB)
        levels = [
            Line2D([], [], color=ink, linestyle=style, label=f"detected with a probability of at least {least:g}")
            for least, style in _LEVELS.items()
        ]
        write_key(key, {"Road user" if is_one else "Rig": lines, "Up to this distance": levels}, widths=(1, 2))
        caption(
            figure,
            f"Distance from the middle of the vehicle; {first.distances_m[-1]:g} m: that or more. Nothing hides "
            "the road user.\nFitted model of detection probability, best camera.",
        )
        if heading:
            figure.suptitle(heading, x=0.01, ha="left", fontweight="bold")
        return figure


def _prepare(axis: Any, reach_m: float) -> None:  # noqa: ANN401 (matplotlib)
    """Polar axes with the front up and the left on the left, rings in metres."""
    axis.set_theta_zero_location("N")
    axis.set_thetagrids(
        range(0, 360, 45), ["front", "45°", "left", "135°", "rear", "-135°", "right", "-45°"], fontsize=8
    )
    ring_m = ring_radii_m(reach_m)
    axis.set_rgrids(ring_m, [f"{each:g} m" for each in ring_m], angle=202.5, fontsize=7, color=hex_colour(INK_RGB))
    axis.set_ylim(0.0, reach_m)
