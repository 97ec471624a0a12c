"""How many cameras see a road user, by sector and distance: of the whole rig, and without its most important camera."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.sight.around import CAR_HEIGHT_M, PIXELS, SectorCounts
from warpav.view.figures.from_above import RINGS, draw_surroundings, middle_of, panels_with_key, write_key
from warpav.view.figures.style import caption, figure_style, title
from warpav.view.palette import COVERAGE_RGB, hex_colour

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig

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
