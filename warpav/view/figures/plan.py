"""A rig to scale from above: how far its images are large enough, and what ground the own body hides."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.sight.around import CAR_HEIGHT_M, PIXELS, VisibleGround, size_ranges_m
from warpav.view.figures.from_above import (
    RINGS,
    camera_handles,
    draw_surroundings,
    middle_of,
    panels_with_key,
    write_key,
)
from warpav.view.figures.page import camera_digit, camera_mark
from warpav.view.figures.style import caption, figure_style, title
from warpav.view.palette import COVERAGE_RGB, camera_rgb, hex_colour

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig

MARGIN_M = 6.0
"""How far the ground is drawn around the vehicle [m]."""

FARTHEST_M = 200.0
"""How far fans are drawn [m], so that a telephoto camera does not press the others together."""

_AZIMUTH_COUNT = 720
_SIZE_NAMES = {40.0: "easily recognised", 20.0: "recognised", 12.0: "limit of detectors"}
_NUMBER_REACH = 0.74
"""How far out numbers of cameras stand, as a share of the panel: below the arrow to the front."""
_SHADE = (0.30, 0.17, 0.10)  # of 40, 20 and 12 px; each lies on the next one
_GROUND_RGB = ((255, 255, 255), COVERAGE_RGB[0], (108, 76, 120), (208, 226, 243), (150, 190, 226))
_GROUND_NAMES = ("", "hidden by the own body", "in no image", "seen by one camera", "seen by two or more")


def plan_figure(
    rigs: Mapping[str, Rig], ego: Mesh, *, heading: str | None = None, pixels: Sequence[float] = PIXELS
) -> Any:  # noqa: ANN401 (matplotlib)
    """Every camera's field of view on the ground, and beside it the ground near the vehicle; one row for each rig.

    On the left, the fan of a camera covers the places at which it sees the middle of a car 1.5 m high, out to where the
    car's image is still 40, 20 and 12 px high: the distance in the image between the car's foot and its top, both
    through the lens (`CameraModel.project`), so that distortion and the edges of wide lenses count. Of a level pinhole
    with the focal length f that is where the depth is ``f 1.5 m / 12 px``. Nothing stands in the way. Fans end at
    200 m.

    On the right, level ground in cells of 0.1 m: whether it is in some image, and whether the straight line from that
    camera to it is free of the own body (rays against the vehicle's mesh).

    Args:
        pixels: Least heights of the image of a car [px], the largest first, at most three.
    """
    from matplotlib.patches import Patch

    azimuth_rad = np.linspace(-math.pi, math.pi, _AZIMUTH_COUNT, endpoint=False)
    ranges = {
        name: [size_ranges_m(camera, azimuth_rad, pixels=pixels) for camera in rig.cameras]
        for name, rig in rigs.items()
    }
    low_m, high_m = np.asarray(ego.bounds_m(), np.float64)
    near_m = 0.5 * float((high_m - low_m)[:2].max()) + MARGIN_M
    farthest_m = {name: max(float(np.nanmax(each[..., 1], initial=0.0)) for each in ranges[name]) for name in rigs}
    far_m = max(near_m, min(1.06 * max(farthest_m.values()) + 2.0, FARTHEST_M))
    with figure_style():
        cameras = camera_handles(rigs)
        columns = [-(-len(each) // 6) if len(cameras) == 1 else 1 for each in cameras.values()]
        lines = max(-(-len(each) // count) for each, count in zip(cameras.values(), columns, strict=True))
        figure, panels, key = panels_with_key(2 * len(rigs), 2, panel_inch=4.65, key_lines=1 + max(4, lines))
        for (name, rig), far, near in zip(rigs.items(), panels[::2], panels[1::2], strict=True):
            prefix = f"{name}: " if len(rigs) > 1 else ""
            draw_surroundings(far, ego, rig, reach_m=far_m, camera_size=0.0)
            _draw_sizes(far, rig, azimuth_rad, ranges[name])
            _number_fans(far, rig, azimuth_rad, ranges[name], reach_m=far_m)
            title(far, f"{prefix}how far a car is large enough")
            cut = f", drawn up to {far_m:g} m" if farthest_m[name] > far_m else ""
            text = f"farthest with {pixels[-1]:g} px: {farthest_m[name]:.0f} m{cut}"
            far.set_xlabel(text, fontsize=8)
            draw_surroundings(near, ego, rig, reach_m=near_m)
            _draw_ground(near, VisibleGround.of(rig, ego, margin_m=near_m), middle_of(ego), near_m)
            _number_cameras(near, rig)
            title(near, f"{prefix}ground near the vehicle")
        shades = 1.0 - np.cumprod(1.0 - np.array(_SHADE)[::-1])[::-1]
        sizes = [
            Patch(
                color=str(1.0 - 0.8 * shade), label=": ".join(filter(None, (f"≥ {least:g} px", _SIZE_NAMES.get(least))))
            )
            for least, shade in zip(pixels, shades, strict=False)
        ]
        grounds = [
            Patch(facecolor=hex_colour(rgb), label=name)
            for rgb, name in zip(_GROUND_RGB[1:], _GROUND_NAMES[1:], strict=True)
        ]
        groups = {
            "Left: height of a car's image": sizes,
            **{f"Both: {name}": each for name, each in cameras.items()},
            "Right: ground that is": grounds,
        }
        write_key(key, groups, columns=(1, *columns, 1))
        sizes_text = f"The darker a fan, the larger in that camera's image is a car {CAR_HEIGHT_M:g} m high."
        caption(figure, f"{sizes_text}\n{RINGS} Within a panel, vehicle and rings have one scale.")
        if heading:
            figure.suptitle(heading, x=0.01, ha="left", fontweight="bold")
        return figure


def _draw_sizes(axis: Any, rig: Rig, azimuth_rad: np.ndarray, ranges_m: Sequence[np.ndarray]) -> None:  # noqa: ANN401
    """Draw the fans of all cameras, for every size one."""
    for index, (camera, of_camera) in enumerate(zip(rig.cameras, ranges_m, strict=True)):
        colour = hex_colour(camera_rgb(index))
        for of_size, alpha in zip(of_camera, _SHADE, strict=False):
            for outline_m in _outlines_m(camera.position_m[:2], azimuth_rad, of_size):
                axis.fill(*outline_m.T[::-1], color=colour, alpha=alpha, linewidth=0, zorder=3)
                axis.plot(*outline_m.T[::-1], color=colour, linewidth=0.5, alpha=0.9, zorder=4)


def _number_fans(
    axis: Any,  # noqa: ANN401 (matplotlib)
    rig: Rig,
    azimuth_rad: np.ndarray,
    ranges_m: Sequence[np.ndarray],
    *,
    reach_m: float,
) -> None:
    """Number every fan on its outermost outline, in the direction in which its camera looks."""
    placed_m: list[np.ndarray] = []
    for index, (camera, of_camera) in enumerate(zip(rig.cameras, ranges_m, strict=True)):
        far_m = of_camera[-1][:, 1]
        ahead = camera.ego_from_camera[:2, 2]
        across = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=-1)
        if not np.isfinite(far_m).any():
            continue
        nearest = np.nanargmax(np.where(np.isfinite(far_m), across @ ahead, np.nan))
        range_m = min(float(far_m[nearest]), _NUMBER_REACH * reach_m)
        place_m = camera.position_m[:2] + range_m * across[nearest]
        while any(np.linalg.norm(place_m - other_m) < 0.06 * reach_m for other_m in placed_m) and range_m > 1.0:
            range_m *= 0.9
            place_m = camera.position_m[:2] + range_m * across[nearest]
        placed_m.append(place_m)
        mark = camera_mark(hex_colour(camera_rgb(index))) | {"markersize": 9.0}
        axis.plot(*place_m[::-1], **mark, zorder=9)
        axis.text(*place_m[::-1], str(index + 1), **camera_digit() | {"fontsize": 6}, zorder=10)


def _number_cameras(axis: Any, rig: Rig) -> None:  # noqa: ANN401 (matplotlib)
    """Write the numbers of cameras beside their marks: outwards, and away from marks nearby."""
    from matplotlib.patheffects import withStroke

    position_m = np.array([camera.position_m[:2] for camera in rig.cameras])
    for index, (camera, place_m) in enumerate(zip(rig.cameras, position_m, strict=True)):
        forward = camera.ego_from_camera[0, 2]
        near_m = position_m[np.linalg.norm(position_m - place_m, axis=1) < 0.35]
        away_m = place_m - near_m.mean(axis=0)
        outwards = (0.0, np.sign(place_m[1])) if abs(place_m[1]) > 0.2 else (0.3 * np.sign(forward), 0.01)
        towards = outwards + 0.4 * away_m / max(float(np.linalg.norm(away_m)), 0.01)
        ahead_pt, left_pt = 8.0 * towards / np.linalg.norm(towards)
        style = camera_digit() | {"fontsize": 6.5, "color": hex_colour(camera_rgb(index))}
        halo = withStroke(linewidth=1.8, foreground="white")
        offset = {"xytext": (-left_pt, ahead_pt), "textcoords": "offset points", "path_effects": [halo]}
        axis.annotate(str(index + 1), place_m[::-1], **offset, **style, zorder=8)


def _draw_ground(axis: Any, ground: VisibleGround, middle_m: np.ndarray, reach_m: float) -> None:  # noqa: ANN401
    """Paint the ground by what cameras see of it, and write how much of it they do not."""
    from matplotlib.colors import ListedColormap

    limits = axis.get_xlim(), axis.get_ylim()
    state = np.select([ground.is_body, ground.is_shadow, ground.is_outside, ground.seen == 1], [0, 1, 2, 3], default=4)
    half_m = 0.5 * (ground.x_m[1] - ground.x_m[0])
    axis.imshow(
        state,
        cmap=ListedColormap([hex_colour(rgb) for rgb in _GROUND_RGB]),
        vmin=-0.5,
        vmax=4.5,
        origin="lower",
        extent=(ground.y_m[0] - half_m, ground.y_m[-1] + half_m, ground.x_m[0] - half_m, ground.x_m[-1] + half_m),
        interpolation="nearest",
        zorder=1,
    )
    axis.set(xlim=limits[0], ylim=limits[1])
    is_near = np.hypot(ground.x_m[:, None] - middle_m[0], ground.y_m[None] - middle_m[1]) <= reach_m
    hidden_m2, outside_m2 = (ground.area_m2(flag & is_near) for flag in (ground.is_shadow, ground.is_outside))
    text = f"up to {reach_m:.1f} m: {hidden_m2:.0f} m² hidden by the own body, {outside_m2:.0f} m² in no image"
    axis.set_xlabel(text, fontsize=8)


def _outlines_m(centre_m: np.ndarray, azimuth_rad: np.ndarray, range_m: np.ndarray) -> list[np.ndarray]:
    """Closed outlines of a fan, one for each run of azimuths at which there is something, [point, 2] each."""
    across = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=-1)
    near, far = (centre_m + range_m[:, end, None] * across for end in (0, 1))
    has_any = np.isfinite(range_m[:, 0])
    if has_any.all():
        order = np.append(np.arange(len(near)), 0)
        return [np.vstack([far[order], near[order][::-1], far[:1]])]
    if not has_any.any():
        return []
    order = np.roll(np.arange(len(near)), -int(np.flatnonzero(~has_any)[0]))
    runs = np.split(order, np.flatnonzero(np.diff(has_any[order].astype(int))) + 1)
    return [np.vstack([far[run], near[run][::-1], far[run[:1]]]) for run in runs if has_any[run[0]]]
