"""Plots on the ground, seen from above and to scale: how far cameras resolve a car, and pixels per degree."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.sight.around import CAR_HEIGHT_M, PIXELS, VisibleGround, px_per_degree, size_ranges_m
from warpav.view.figures.style import (
    WIDTH_INCH,
    camera_digit,
    camera_mark,
    caption,
    empty_panel,
    figure_style,
    new_figure,
    title,
)
from warpav.view.palette import COVERAGE_RGB, GRID_RGB, GROUND_RGB, INK_RGB, MUTED_RGB, camera_rgb, hex_colour

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.rig.rig import Rig
if TYPE_CHECKING:
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


_KEY_LINE_INCH = 0.185
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
    key_inch = _KEY_LINE_INCH * key_lines + 0.05
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


_STEP_DEG = 0.5
_ELEVATION_DEG = 60.0


def resolution_figure(rigs: Mapping[str, Rig], *, heading: str | None = None) -> Any:  # noqa: ANN401 (matplotlib)
    """Pixels that the best camera has for a degree, along the horizon for all rigs, and below for each as a map.

    The best camera of a direction is the one with most pixels per degree there: the square root of pixels per square
    degree, from the derivative of `CameraModel.project`. On the optical axis of a pinhole with the focal length f in
    pixels it is ``f pi / 180``. Directions are taken from each camera's own centre; nothing stands in the way.
    """
    azimuth_deg = np.arange(-180.0, 180.0 + _STEP_DEG, _STEP_DEG)
    elevation_deg = np.arange(-_ELEVATION_DEG, _ELEVATION_DEG + _STEP_DEG, _STEP_DEG)
    best = {name: _best(rig, azimuth_deg, elevation_deg) for name, rig in rigs.items()}
    horizon = len(elevation_deg) // 2
    most = max(float(each.max()) for each in best.values())
    with figure_style():
        figure = new_figure(WIDTH_INCH, 3.2 + 2.3 * len(rigs))
        axes = figure.subplots(1 + len(rigs), 1, sharex=True, height_ratios=[1.2, *[1.0] * len(rigs)])
        for index, (name, found) in enumerate(best.items()):
            line = np.where(found[horizon] > 0.0, found[horizon], np.nan)
            gap_deg = 360.0 * float((found[horizon] == 0.0).mean())
            label = f"{name}: mean {np.nanmean(line):.1f}, no image on {gap_deg:.0f}°"
            axes[0].plot(azimuth_deg, line, color=hex_colour(camera_rgb(index)), label=label)
        axes[0].set(ylim=(0.0, 1.1 * max(float(each[horizon].max()) for each in best.values()) or 1.0))
        axes[0].set_ylabel("pixels per degree")
        axes[0].legend(loc="lower right", ncols=min(2, len(rigs)))
        title(axes[0], "Along the horizon, best camera")
        image = None
        for axis, (name, found) in zip(axes[1:], best.items(), strict=True):
            image = axis.pcolormesh(
                azimuth_deg,
                elevation_deg,
                np.ma.masked_equal(found, 0.0),
                cmap="viridis",
                vmin=0.0,
                vmax=most,
                rasterized=True,
            )
            axis.set_facecolor(hex_colour(GROUND_RGB))
            axis.grid(visible=False)
            axis.axhline(0.0, color="white", linewidth=0.8, linestyle="--")
            axis.set(ylabel="elevation [°]", yticks=(-60, -30, 0, 30, 60))
            title(axis, f"{name}: over azimuth and elevation" if len(rigs) > 1 else "Over azimuth and elevation")
        axes[-1].set(xlim=(180.0, -180.0), xticks=range(180, -181, -45))
        axes[-1].set_xlabel("azimuth [°]: 0 ahead, 90 to the left, -90 to the right")
        bar = figure.colorbar(image, ax=list(axes[1:]), pad=0.01, aspect=14 * len(rigs))
        bar.set_label("pixels per degree")
        bar.outline.set_visible(False)
        caption(figure, "Grey: in no image. Dashed: horizon. The own body is left out of account.")
        if heading:
            figure.suptitle(heading, x=0.01, ha="left", fontweight="bold")
        return figure


def _best(rig: Rig, azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
    """Pixels per degree of the best camera, float64 [elevation, azimuth]; 0 where a direction is in no image."""
    elevation_rad, azimuth_rad = np.meshgrid(np.radians(elevation_deg), np.radians(azimuth_deg), indexing="ij")
    level = np.cos(elevation_rad)
    direction = np.stack([level * np.cos(azimuth_rad), level * np.sin(azimuth_rad), np.sin(elevation_rad)], axis=-1)
    return np.max([px_per_degree(camera, direction) for camera in rig.cameras], axis=0)
