"""Points of LiDARs in one scene: from above with rings on the ground, and over azimuth and elevation."""

from __future__ import annotations

from typing import Any

import numpy as np

from warpav.core.errors import ArgumentError
from warpav.detection import Scan, scan
from warpav.rig import Rig
from warpav.scene import Scene
from warpav.view._palette import MUTED_RGB, camera_rgb, hex_colour
from warpav.view.figures._from_above import draw_surroundings
from warpav.view.figures._style import WIDTH_INCH, figure_style, new_figure

_REACH_M = 40.0
_GREY = "#a9b0ba"
_COUNTED = (1.0, 5.0)


def points_figure(*, rig: Rig, scene: Scene, heading: str | None = None) -> Any:  # noqa: ANN401 (matplotlib)
    """Draw one scan of every LiDAR of a rig: what is on road users in the LiDAR's colour, all else in grey."""
    scans = scan(rig, scene)
    if not scans:
        raise ArgumentError("rig", "expected a rig with a LiDAR for kind='points', got none")
    with figure_style():
        figure = new_figure(WIDTH_INCH, 5.6 + 1.3 * len(scans))
        grid = figure.add_gridspec(1 + len(scans), 1, height_ratios=[5.0, *([1.2] * len(scans))])
        axis = figure.add_subplot(grid[0])
        draw_surroundings(axis, scene.ego, reach_m=_REACH_M)
        number = {each.name: k for k, each in enumerate(rig.cameras)}
        colour = {name: hex_colour(camera_rgb(number[name])) for name in scans}
        for name, found in scans.items():
            _draw_from_above(axis, found, colour[name])
        axis.set_title(heading or _counted(scans, len(scene.vehicles)))
        for k, (name, found) in enumerate(scans.items()):
            below = figure.add_subplot(grid[1 + k])
            place_m = next(each.position_m for each in rig.cameras if each.name == name)
            _draw_around(below, found, place_m, colour[name])
            below.set_title(name, loc="left")
            below.set_xlabel("azimuth, to the left positive [°]" if k == len(scans) - 1 else "")
        return figure


def _draw_from_above(axis: Any, found: Scan, colour: str) -> None:  # noqa: ANN401 (matplotlib)
    is_user = found.object_index > 1
    for which, look in ((~is_user, {"color": _GREY, "s": 0.15}), (is_user, {"color": colour, "s": 0.8})):
        axis.scatter(found.point_m[which, 1], found.point_m[which, 0], **look, linewidths=0, rasterized=True)


def _draw_around(axis: Any, found: Scan, place_m: np.ndarray, colour: str) -> None:  # noqa: ANN401 (matplotlib)
    away_m = found.point_m - place_m
    azimuth = np.degrees(np.arctan2(away_m[:, 1], away_m[:, 0]))
    elevation = np.degrees(np.arctan2(away_m[:, 2], np.hypot(away_m[:, 0], away_m[:, 1])))
    is_user, is_body = found.object_index > 1, found.object_index == 1
    for which, look in ((~is_user & ~is_body, _GREY), (is_body, hex_colour(MUTED_RGB)), (is_user, colour)):
        axis.scatter(azimuth[which], elevation[which], color=look, s=0.2, linewidths=0, rasterized=True)
    axis.set_xlim(180.0, -180.0)
    axis.set_ylabel("elevation [°]")


def _counted(scans: dict[str, Scan], users: int) -> str:
    index = np.concatenate([each.object_index for each in scans.values()])
    count = np.bincount(index[index > 1] - 2, minlength=users)
    hit, enough = (int((count >= least).sum()) for least in _COUNTED)
    return f"{users} road users: {hit} with a point, {enough} with {_COUNTED[1]:g} and more"
