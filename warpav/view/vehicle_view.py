"""A vehicle that is to carry cameras: where they may stand, its origin, its axes, its wheels."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.body_view import LIFT_M, add_zones, mountable_zone_to_pyvista
from warpav.view.opengl import has_display, load_pyvista
from warpav.view.output import render_rgb
from warpav.view.palette import INK_RGB, PAPER_RGB, hex_colour
from warpav.view.rig_view import VIEW_AZIMUTH_RAD, add_axes, add_ego, add_ground, look_at_ego

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warpav.raster.mesh import Mesh
    from warpav.rig.mount_surface import MountSurface

    Plotter = Any

VEHICLE_PX = (1280, 720)
_ZONES_VIEW_PX = (880, 720)
"""Of each of the two views of zones."""


def vehicle_plotter(
    vehicle: Mesh | None,
    *,
    surface: MountSurface | None,
    axle_m: Sequence[float] = (),
    title: str | None = None,
    window_size: tuple[int, int] = VEHICLE_PX,
    zoom: float = 1.0,
    off_screen: bool | None = None,
    azimuth_rad: float = VIEW_AZIMUTH_RAD,
) -> Plotter:
    """A plotter that shows a vehicle, by default from its front left; not yet shown.

    Args:
        window_size: Width and height [px].
    """
    if vehicle is None and surface is None:
        raise ValueError("vehicle, surface: expected at least one of them, got neither")
    pyvista = load_pyvista()
    off_screen = not has_display() if off_screen is None else off_screen
    plotter = pyvista.Plotter(
        off_screen=off_screen, window_size=list(window_size), lighting="light kit", title="warpav"
    )
    plotter.set_background(hex_colour(PAPER_RGB))
    plotter.enable_anti_aliasing("msaa", multi_samples=8)
    bounds_m = vehicle.bounds_m().astype(np.float64) if vehicle is not None else _bounds_of_zone_m(surface)
    look_at_ego(plotter, bounds_m, azimuth_rad=azimuth_rad, elevation_rad=math.radians(36.0), zoom=zoom)
    plotter.camera.view_angle = 19.0
    if vehicle is not None:
        add_ego(plotter, vehicle)
    add_ground(plotter, bounds_m, rings=False, shadow=vehicle is not None)
    if surface is not None:
        _add_mountable_zone(plotter, surface)
    low, high = bounds_m
    thick = float(high[0] - low[0]) / 4.5  # what is drawn of a bus is seen from farther away
    add_axes(plotter, length_m=high + thick * np.array([0.9, 0.9, 0.7]), thick=thick)  # long enough to leave it
    for number, x in enumerate(axle_m):
        ends = [(x, low[1] - 0.25, 0.01), (x, high[1] + 0.25, 0.01)]
        line = pyvista.Line(*ends).tube(radius=0.015)
        plotter.add_mesh(line, color=INK_RGB, lighting=False, name=f"axle/{number}")
    if title:
        plotter.add_text(
            title, position=(0.02, 0.93), viewport=True, font_size=11, color=hex_colour(INK_RGB), name="title"
        )
    return plotter


def zones_image_rgb(vehicle: Mesh, surface: MountSurface, *, title: str) -> np.ndarray:
    """A vehicle with its zones from above, twice: from its front left and from its rear right, so that all are seen.

    Returns:
        uint8, shape [row, column, 3].
    """
    views = []
    for words, azimuth_rad in (
        (f"{title}, from the front left", VIEW_AZIMUTH_RAD),
        ("from the rear right", VIEW_AZIMUTH_RAD + math.pi),
    ):
        plotter = vehicle_plotter(
            vehicle,
            surface=surface,
            title=words,
            window_size=_ZONES_VIEW_PX,
            zoom=1.15,
            off_screen=True,
            azimuth_rad=azimuth_rad,
        )
        if views:  # the legend once is enough, and most of the axes is behind the body
            for each in [each for each in plotter.actors if "/legend/" in each or each.startswith(("axis", "origin"))]:
                plotter.remove_actor(each)
        views.append(render_rgb(plotter))
        plotter.close()
    return np.concatenate(views, axis=1)


def _bounds_of_zone_m(surface: MountSurface | None) -> np.ndarray:
    """The box from the ground to the highest cell of a surface [m], shape [2, 3]."""
    assert surface is not None
    surface = surface.over_ground
    low, high = surface.bounds_m
    return np.array([[*low, 0.0], [*high, np.nanmax(surface.height_m)]], np.float64)


def _add_mountable_zone(plotter: Plotter, surface: MountSurface, *, name: str = "mountable_zone") -> None:
    """Add the cells that can carry a camera: coloured by height with a scale, or zones in colours of their own."""
    if surface.zones:
        add_zones(plotter, surface, name=name)
        return
    font_size = max(11, round(18 * min(1.0, plotter.window_size[0] / VEHICLE_PX[0])))
    plotter.add_mesh(
        mountable_zone_to_pyvista(surface, lift_m=LIFT_M),
        scalars="height_m",
        cmap="viridis",
        lighting=False,
        name=name,
        scalar_bar_args={
            "title": "height above ground [m]",
            "color": hex_colour(INK_RGB),
            "fmt": "%.2f",
            "n_labels": 2,  # a label between would meet the title
            "position_x": 0.66,
            "width": 0.3,
            "height": 0.08,
            "position_y": 0.04,
            "title_font_size": font_size,
            "label_font_size": font_size,
        },
    )
