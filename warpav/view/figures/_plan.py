"""Plots on the ground, seen from above and to scale: how far cameras resolve a car, and pixels per degree."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.sight import CAR_HEIGHT_M, PIXELS, VisibleGround, px_per_degree, size_ranges_m
from warpav.view._labels import Labels
from warpav.view._outlines import fan_outlines_m
from warpav.view._palette import COVERAGE_RGB, GROUND_RGB, NOT_ALONE_RGB, alone, camera_rgb, hex_colour
from warpav.view.figures._from_above import (
    RINGS,
    camera_handles,
    draw_surroundings,
    half_length_m,
    middle_of,
    panels_with_key,
    write_key,
)
from warpav.view.figures._style import (
    WIDTH_INCH,
    badge_pt,
    caption,
    closed,
    colour_bar,
    draw_badge,
    figure_style,
    mark_cameras,
    new_figure,
    short_names,
    title,
    unit_per_pt,
)

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig import Rig

_MARGIN_M = 6.0
"""How far the ground is drawn around the vehicle [m]."""

_FARTHEST_M = 200.0
"""How far fans are drawn [m], so that a telephoto camera does not press the others together."""

_AZIMUTH_RAD = np.linspace(-math.pi, math.pi, 720, endpoint=False)
_ACROSS = np.stack([np.cos(_AZIMUTH_RAD), np.sin(_AZIMUTH_RAD)], axis=-1)
_SIZE_NAMES = {40.0: "easily recognised", 20.0: "recognised", 12.0: "limit of detectors"}
_NUMBER_REACH = 0.74
"""How far out numbers of cameras stand, as a share of the panel: below the arrow to the front."""
_SHADE = (0.30, 0.17, 0.10)  # of 40, 20 and 12 px; each lies on the next one
_GROUND_OF = {
    "": (255, 255, 255),
    "hidden by the own body": COVERAGE_RGB[0],
    "in no image": (108, 76, 120),
    "seen by one camera": (208, 226, 243),
    "seen by two or more": (150, 190, 226),
}


def plan_figure(rigs: Mapping[str, Rig], ego: Mesh, *, heading: str | None = None) -> Any:  # noqa: ANN401 (matplotlib)
    """Every camera's field of view on the ground, one panel for each rig.

    The fan of a camera covers the places at which it sees the middle of a car 1.5 m high, out to where the car's image
    is still 40, 20 and 12 px high: the distance in the image between the car's foot and its top, both through the lens
    (`CameraModel.project`), so that distortion and the edges of wide lenses count. Of a level pinhole with the focal
    length f that is where the depth is ``f 1.5 m / 12 px``. Nothing stands in the way. Fans end at 200 m.
    """
    from matplotlib.patches import Patch

    ranges = {name: [size_ranges_m(camera, _AZIMUTH_RAD) for camera in rig.cameras] for name, rig in rigs.items()}
    farthest_m = {name: max(float(np.nanmax(each[..., 1], initial=0.0)) for each in ranges[name]) for name in rigs}
    far_m = max(half_length_m(ego) + _MARGIN_M, min(1.06 * max(farthest_m.values()) + 2.0, _FARTHEST_M))
    text = f"The darker a fan, the larger in that camera's image is a car {CAR_HEIGHT_M:g} m high.\n{RINGS}"
    if len({max(camera.model.width_px for camera in rig.cameras) for rig in rigs.values()}) > 1:
        text += " The rigs' images differ in size: with more pixels a fan reaches farther."
    shades = 1.0 - np.cumprod(1.0 - np.array(_SHADE)[::-1])[::-1]
    labels = [": ".join(filter(None, (f"≥ {least:g} px", _SIZE_NAMES.get(least)))) for least in PIXELS]
    sizes = [Patch(color=str(1.0 - 0.8 * shade), label=each) for each, shade in zip(labels, shades, strict=True)]
    with _panels(rigs, {"Height of a car's image": sizes}, text, heading) as panels:
        for (name, rig), axis in zip(rigs.items(), panels, strict=True):
            draw_surroundings(axis, ego, reach_m=far_m)
            _draw_fans(axis, rig, ranges[name], far_m)
            title(axis, name if len(rigs) > 1 else "How far a car is large enough")
            cut = f", drawn up to {far_m:g} m" if farthest_m[name] > far_m else ""
            axis.set_xlabel(f"farthest with {PIXELS[-1]:g} px: {farthest_m[name]:.0f} m{cut}", fontsize=8)
    return panels[0].figure


def ground_figure(
    rigs: Mapping[str, Rig],
    ego: Mesh,
    *,
    misses_per_100: Mapping[str, float | None] | None = None,
    heading: str | None = None,
) -> Any:  # noqa: ANN401 (matplotlib)
    """The level ground near the vehicle by what cameras see of it, one panel for each rig.

    In cells of 0.1 m: whether one is in some image, and whether the straight line from that camera to it is free of the
    own body (rays against the vehicle's mesh). Below stand the share that no camera sees and, where it is known, how
    many road users the rig misses.
    """
    from matplotlib.patches import Patch

    reach_m = half_length_m(ego) + _MARGIN_M
    grounds = [Patch(facecolor=hex_colour(rgb), label=name) for name, rgb in _GROUND_OF.items() if name]
    misses = {name: each for name, each in (misses_per_100 or {}).items() if each is not None}
    text = f"Misses of 100 road users in the test scenes, at equal false alarms.\n{RINGS}" if misses else RINGS
    with _panels(rigs, {"Ground that is": grounds}, text, heading) as panels:
        for (name, rig), axis in zip(rigs.items(), panels, strict=True):
            draw_surroundings(axis, ego, reach_m=reach_m)
            said = _draw_ground(axis, VisibleGround.of(rig, ego, margin_m=reach_m), middle_of(ego), reach_m)
            said = f"{misses[name]:.1f} misses per 100\n{said}" if name in misses else said
            axis.set_xlabel(said, fontsize=11, fontweight="bold")
            mark_cameras(axis, rig.cameras)
            title(axis, name if len(rigs) > 1 else "Ground near the vehicle")
    return panels[0].figure


def found_alone_figure(rigs: Mapping[str, Rig], ego: Mesh, place_m: Mapping[str, np.ndarray]) -> Any:  # noqa: ANN401
    """Level ground that one of several rigs alone sees, and where road users are that one alone finds [object, 2]."""
    from matplotlib.patches import Patch

    reach_m = half_length_m(ego) + _MARGIN_M
    colours = {name: hex_colour(camera_rgb(k)) for k, name in enumerate(rigs)}
    far_m = max(reach_m, *(float(np.abs(each - middle_of(ego)).max(initial=0.0)) + 3.0 for each in place_m.values()))
    grounds = [VisibleGround.of(rig, ego, margin_m=reach_m) for rig in rigs.values()]
    seen_by = alone(np.stack([each.seen > 0 for each in grounds]))
    shades = dict(zip(("seen by two or more", "seen by none"), map(hex_colour, NOT_ALONE_RGB), strict=True))
    keys = {"Seen, or found, by one alone": colours, "Other ground": shades}
    with panels_with_key(2, 2, panel_inch=4.65, key_lines=4, text=RINGS, heading=None) as (_, panels, key):
        for axis, far, name in zip(panels, (reach_m, far_m), ("Level ground", "Road users"), strict=True):
            draw_surroundings(axis, ego, reach_m=far)
            title(axis, f"{name} {'seen' if axis is panels[0] else 'found'} by one alone")
        seen_by[grounds[0].is_body] = len(rigs) + 2
        _paint(panels[0], grounds[0], seen_by, [*colours.values(), *shades.values(), "white"])
        area_m2 = [grounds[0].area_m2(seen_by == k) for k in range(len(rigs))]
        panels[0].set_xlabel(", ".join(f"{name} {area:.1f} m²" for name, area in zip(rigs, area_m2, strict=True)))
        for name, each in place_m.items():
            panels[1].scatter(
                each[:, 1], each[:, 0], s=70, alpha=0.8, color=colours[name], edgecolors="white", zorder=6
            )
        panels[1].set_xlabel(", ".join(f"{name} {len(each)}" for name, each in place_m.items()))
        write_key(key, {what: [Patch(color=rgb, label=n) for n, rgb in of.items()] for what, of in keys.items()})
    return panels[0].figure


@contextmanager
def _panels(
    rigs: Mapping[str, Rig], meaning: Mapping[str, Sequence[Any]], text: str, heading: str | None
) -> Iterator[list[Any]]:
    cameras = camera_handles(rigs)
    columns = [-(-len(each) // 6) if len(cameras) == 1 else 1 for each in cameras.values()]
    lines = max(-(-len(each) // count) for each, count in zip(cameras.values(), columns, strict=True))
    across = min(2, len(rigs))
    size: Any = {"panel_inch": 4.65 if across == 2 else 6.4, "key_lines": 1 + max(4, lines)}
    with panels_with_key(len(rigs), across, **size, text=text, heading=heading) as (_, panels, key):
        yield panels
        write_key(key, {**meaning, **cameras}, columns=(1, *columns))


def _draw_fans(axis: Any, rig: Rig, ranges_m: Sequence[np.ndarray], reach_m: float) -> None:  # noqa: ANN401 (matplotlib)
    """Draw the fans of all cameras, one for every size, and name them.

    A name stands on the outermost outline, in the direction in which its camera looks, off the labels of rings.
    """
    per_pt, ring_m = unit_per_pt(axis), np.array([text.get_position()[::-1] for text in axis.texts])
    half_m = per_pt * np.array([6.0, 14.0])
    labels = Labels(np.hstack([ring_m - half_m, ring_m + half_m]))
    for index, (camera, of_camera, name) in enumerate(
        zip(rig.cameras, ranges_m, short_names(rig.cameras), strict=True)
    ):
        colour, centre_m = hex_colour(camera_rgb(index)), camera.position_m[:2]
        for of_size, alpha in zip(of_camera, _SHADE, strict=False):
            for outline_m in fan_outlines_m(centre_m, _AZIMUTH_RAD, of_size):
                axis.fill(*outline_m.T[::-1], color=colour, alpha=alpha, linewidth=0, zorder=3)
                axis.plot(*closed(outline_m).T[::-1], color=colour, linewidth=0.5, alpha=0.9, zorder=4)
        far_m = of_camera[-1][:, 1]
        if not np.isfinite(far_m).any():
            continue
        ahead = camera.ego_from_camera[:2, 2]
        nearest = np.nanargmax(np.where(np.isfinite(far_m), _ACROSS @ ahead, np.nan))
        range_m = min(float(far_m[nearest]), _NUMBER_REACH * reach_m) * 0.9 ** np.arange(20)
        tried_m = centre_m + range_m[:, None] * _ACROSS[nearest]
        place_m = tried_m[labels.put(tried_m, per_pt * badge_pt(name)[::-1])]
        draw_badge(axis, place_m[::-1], name, colour)


def _draw_ground(axis: Any, ground: VisibleGround, middle_m: np.ndarray, reach_m: float) -> str:  # noqa: ANN401
    state = np.select([ground.is_body, ground.is_shadow, ground.is_outside, ground.seen == 1], [0, 1, 2, 3], default=4)
    _paint(axis, ground, state, [hex_colour(rgb) for rgb in _GROUND_OF.values()])
    is_near = np.hypot(ground.x_m[:, None] - middle_m[0], ground.y_m[None] - middle_m[1]) <= reach_m
    share = float((ground.seen == 0)[is_near & ~ground.is_body].mean())
    return f"{100.0 * share:.0f} % of the ground within {reach_m:.0f} m unseen"


def _paint(axis: Any, ground: VisibleGround, state: np.ndarray, colours: Sequence[str]) -> None:  # noqa: ANN401
    from matplotlib.colors import ListedColormap

    limits = axis.get_xlim(), axis.get_ylim()
    half_m = 0.5 * (ground.x_m[1] - ground.x_m[0])
    extent = (ground.y_m[0] - half_m, ground.y_m[-1] + half_m, ground.x_m[0] - half_m, ground.x_m[-1] + half_m)
    style = {"vmin": -0.5, "vmax": len(colours) - 0.5, "interpolation": "nearest", "zorder": 1}
    axis.imshow(state, origin="lower", extent=extent, cmap=ListedColormap(list(colours)), **style)
    axis.set(xlim=limits[0], ylim=limits[1])


_STEP_DEG, _ELEVATION_DEG = 0.5, 60.0


def resolution_figure(rigs: Mapping[str, Rig], *, heading: str | None = None) -> Any:  # noqa: ANN401 (matplotlib)
    """Pixels that the best camera has for a degree, along the horizon for all rigs, and below for each as a map.

    The best camera of a direction is the one with most pixels per degree there: the square root of pixels per square
    degree, from the derivative of `CameraModel.project`. On the optical axis of a pinhole with the focal length f in
    pixels it is ``f pi / 180``. Directions are taken from each camera's own centre; nothing stands in the way.
    """
    azimuth_deg = np.arange(-180.0, 180.0 + _STEP_DEG, _STEP_DEG)
    elevation_deg = np.arange(-_ELEVATION_DEG, _ELEVATION_DEG + _STEP_DEG, _STEP_DEG)
    elevation_rad, azimuth_rad = np.meshgrid(np.radians(elevation_deg), np.radians(azimuth_deg), indexing="ij")
    across = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=-1) * np.cos(elevation_rad)[..., None]
    direction = np.concatenate([across, np.sin(elevation_rad)[..., None]], axis=-1)
    best = {
        name: np.max([px_per_degree(camera, direction) for camera in rig.cameras], axis=0) for name, rig in rigs.items()
    }
    horizon = len(elevation_deg) // 2
    most = max(float(each.max()) for each in best.values())
    with figure_style():
        figure = new_figure(WIDTH_INCH, 3.2 + 2.3 * len(rigs))
        axes = figure.subplots(1 + len(rigs), 1, sharex=True, height_ratios=[1.2, *[1.0] * len(rigs)])
        for index, (name, found) in enumerate(best.items()):
            line = np.where(found[horizon] > 0.0, found[horizon], np.nan)
            gap_deg = 360.0 * float((found[horizon] == 0.0).mean())
            label = f"{name}: mean {np.nanmean(line):.1f}, {gap_deg:.0f}° in no image"
            axes[0].plot(azimuth_deg, line, color=hex_colour(camera_rgb(index)), label=label)
        axes[0].set(
            ylim=(0.0, 1.1 * max(float(each[horizon].max()) for each in best.values()) or 1.0),
            ylabel="pixels per degree",
        )
        axes[0].legend(loc="best", ncols=min(2, len(rigs)))
        title(axes[0], "Along the horizon, best camera")
        image = None
        for axis, (name, found) in zip(axes[1:], best.items(), strict=True):
            style = {"cmap": "viridis", "vmin": 0.0, "vmax": most, "rasterized": True}
            image = axis.pcolormesh(azimuth_deg, elevation_deg, np.ma.masked_equal(found, 0.0), **style)
            axis.set_facecolor(hex_colour(GROUND_RGB))
            axis.grid(visible=False)
            axis.axhline(0.0, color="white", linewidth=0.8, linestyle="--")
            axis.set(ylabel="elevation [°]", yticks=(-60, -30, 0, 30, 60))
            title(axis, f"{name}: over azimuth and elevation" if len(rigs) > 1 else "Over azimuth and elevation")
        axes[-1].set(
            xlim=(180.0, -180.0),
            xticks=range(180, -181, -45),
            xlabel="azimuth [°]: 0 ahead, 90 to the left, -90 to the right",
        )
        colour_bar(figure, image, list(axes[1:]), "pixels per degree", pad=0.01, aspect=14 * len(rigs))
        caption(figure, "Grey: in no image. Dashed: horizon. The own body is left out of account.", heading)
        return figure
