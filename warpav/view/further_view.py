"""Where one more camera would help most, on the body: an arrow for each place, in the colour of what it would bring."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.body_view import lift_title, scale_of_gain
from warpav.view.opengl import load_pyvista
from warpav.view.palette import further_map

if TYPE_CHECKING:
    from warpav.optimisation.further_camera import FurtherCameras

    Plotter = Any
    PolyData = Any

ARROW_M = 0.32
"""Length of an arrow [m]."""

TITLE = "one more camera: further objects found of 100"
"""Of the scale."""

_DOT_RADIUS_M = 0.022


def further_to_pyvista(further: FurtherCameras) -> PolyData:
    """Arrows of the best cameras of all places, dots of the others, as ``pyvista.PolyData``.

    Point data: ``gain_of_100``, further objects found of 100.
    """
    pyvista = load_pyvista()
    best = further.best_places()
    is_best = np.zeros(len(further), bool)
    is_best[best] = True
    arrow = pyvista.Arrow(shaft_radius=0.06, tip_radius=0.16, tip_length=0.36, shaft_resolution=12, tip_resolution=16)
    dot = pyvista.Sphere(radius=_DOT_RADIUS_M, theta_resolution=10, phi_resolution=10)
    parts = []
    for chosen, shape in ((best, arrow.scale(ARROW_M)), (np.flatnonzero(~is_best), dot)):
        if not len(chosen):
            continue
        shown = further[chosen]
        points = pyvista.PolyData(shown.position_m)
        points.point_data["gain_of_100"] = 100.0 * shown.gain
        points.point_data["direction"] = shown.direction
        parts.append(points.glyph(geom=shape, orient="direction", scale=False))
    return pyvista.merge(parts)


def add_further_cameras(
    plotter: Plotter,
    further: FurtherCameras | None,
    *,
    name: str = "further_cameras",
    scale_at: tuple[float, float] = (0.325, 0.87),
) -> None:
    """Add what each further camera would bring, with a scale; what was drawn before under the same name goes."""
    plotter.remove_actor(name)
    if TITLE in plotter.scalar_bars:
        plotter.remove_scalar_bar(TITLE)
    if further is None or not len(further):
        return
    plotter.add_mesh(
        further_to_pyvista(further),
        scalars="gain_of_100",
        cmap=further_map(),
        clim=(0.0, max(100.0 * float(further.gain.max()), 1e-9)),
        ambient=0.5,
        name=name,
        scalar_bar_args=scale_of_gain(plotter, TITLE, scale_at),
    )
    lift_title(plotter, TITLE)
