"""The picture of a vehicle that is to carry cameras: where they may stand, its origin, its axes, its wheels."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.opengl import load_pyvista
from warpav.view.palette import INK_RGB, PAPER_RGB, Rgb, hex_colour
from warpav.view.rig_view import add_ego, add_ground, look_at_ego

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from warpav.geometry.mesh import Mesh
    from warpav.geometry.mount_surface import MountSurface

    Plotter = Any

PICTURE_PX = (1280, 720)
AXIS_RGB: dict[str, Rgb] = {"x forward": (214, 58, 58), "y left": (38, 148, 68), "z up": (36, 92, 214)}
LIFT_M = 0.03
"""By how much the mountable zone is drawn above the surface."""


def vehicle_plotter(
    vehicle: Mesh,
    *,
    surface: MountSurface | None,
    axle_m: Sequence[float] = (),
    title: str | None = None,
    off_screen: bool = True,
) -> Plotter:
    """A plotter that shows a vehicle from its front left; not yet shown.

    Args:
        vehicle: In the ego frame.
        surface: Its mount surface; the cells that can carry a camera are coloured by height. None: nothing is.
        axle_m: x of its axles, drawn as lines on the ground [m].
        title: A line in the upper left corner.
        off_screen: Draw without a window.

    Raises:
        InputError: Nothing can be drawn on this machine.
    """
    pyvista = load_pyvista()
    plotter = pyvista.Plotter(off_screen=off_screen, window_size=list(PICTURE_PX), lighting="light kit")
    plotter.set_background(hex_colour(PAPER_RGB))
    plotter.enable_anti_aliasing("msaa", multi_samples=8)
    look_at_ego(plotter, vehicle, elevation_rad=math.radians(36.0))
    plotter.camera.view_angle = 19.0
    add_ego(plotter, vehicle)
    add_ground(plotter, vehicle, rings=False)
    if surface is not None:
        add_mountable_zone(plotter, surface)
    _add_axes(plotter, vehicle)
    low, high = vehicle.bounds_m().astype(np.float64)
    for number, x in enumerate(axle_m):
        ends = [(x, low[1] - 0.25, 0.01), (x, high[1] + 0.25, 0.01)]
        line = pyvista.Line(*ends).tube(radius=0.015)
        plotter.add_mesh(line, color=INK_RGB, lighting=False, name=f"axle/{number}")
    if title:
        plotter.add_text(
            title, position=(0.02, 0.93), viewport=True, font_size=11, color=hex_colour(INK_RGB), name="title"
        )
    return plotter


def add_mountable_zone(plotter: Plotter, surface: MountSurface, *, name: str = "mountable_zone") -> None:
    """Add the cells that can carry a camera, coloured by height from dark (low) to light (high), with a scale."""
    pyvista = load_pyvista()
    is_mountable = np.ones(surface.height_m.shape, bool) if surface.is_mountable is None else surface.is_mountable
    cell = np.argwhere(is_mountable)
    half_m = 0.5 * surface.cell_m
    middle_m = surface.origin_m + cell * surface.cell_m
    height_m = surface.height_m[is_mountable].astype(np.float64)
    corner = np.array([[-half_m, -half_m], [half_m, -half_m], [half_m, half_m], [-half_m, half_m]])
    place_m = (middle_m[:, None] + corner).reshape(-1, 2)
    point_m = np.column_stack([place_m, surface.height_at_m(place_m) + LIFT_M])
    zone = pyvista.PolyData.from_regular_faces(point_m, np.arange(len(point_m)).reshape(-1, 4))
    zone.cell_data["height above the ground [m]"] = height_m
    plotter.add_mesh(
        zone,
        scalars="height above the ground [m]",
        cmap="viridis",
        lighting=False,
        name=name,
        scalar_bar_args={
            "color": hex_colour(INK_RGB),
            "fmt": "%.2f",
            "n_labels": 3,
            "position_x": 0.66,
            "width": 0.3,
            "height": 0.08,
            "position_y": 0.04,
            "title_font_size": 18,
            "label_font_size": 18,
        },
    )


def save_vehicle_picture(
    vehicle: Mesh,
    path: Path,
    *,
    surface: MountSurface | None,
    axle_m: Sequence[float] = (),
    title: str | None = None,
) -> Path:
    """Write the picture of `vehicle_plotter` as PNG (also ``.html`` and ``.gif``); missing folders are made.

    Raises:
        InputError: Another suffix, a place that cannot be written to, or no OpenGL on this machine.
    """
    from warpav.view.picture import save_picture

    plotter = vehicle_plotter(vehicle, surface=surface, axle_m=axle_m, title=title)
    try:
        return save_picture(plotter, path)
    finally:
        plotter.close()


def _add_axes(plotter: Plotter, vehicle: Mesh) -> None:
    """Add the axes of the ego frame at its origin, long enough to leave the vehicle."""
    pyvista = load_pyvista()
    low, high = vehicle.bounds_m().astype(np.float64)
    thick = float(high[0] - low[0]) / 4.5  # what is drawn of a bus is seen from farther away
    length_m = (high[0] + 0.9 * thick, high[1] + 0.9 * thick, high[2] + 0.7 * thick)
    tips = []
    for axis, (label, colour) in enumerate(AXIS_RGB.items()):
        direction = np.eye(3)[axis]
        length = max(length_m[axis], 0.5)
        lift = np.array([0.0, 0.0, 0.02 if axis < 2 else 0.0])
        arrow = pyvista.Arrow(
            start=lift,
            direction=direction,
            scale=length,
            shaft_radius=0.016 * thick / length,
            tip_radius=0.055 * thick / length,
            tip_length=0.2 * thick / length,
        )
        plotter.add_mesh(arrow, color=colour, ambient=0.6, name=f"axis/{label[0]}")
        tips.append(lift + (length + 0.12 * thick) * direction)
    plotter.add_mesh(pyvista.Sphere(radius=0.07), color=INK_RGB, ambient=0.5, name="origin")
    plotter.add_point_labels(
        np.array([*tips]),
        list(AXIS_RGB),
        text_color=hex_colour(INK_RGB),
        font_size=15,
        shape=None,
        show_points=False,
        always_visible=True,
        name="axis_labels",
    )
