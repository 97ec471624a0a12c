"""What a search adds to the view in space: its course, and where a further camera would help."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.body_view import lift_title, scale_of_gain
from warpav.view.opengl import load_pyvista
from warpav.view.palette import DESCENT_RGB, further_map

if TYPE_CHECKING:
    from collections.abc import Mapping

    from warpav.optimisation.further_camera import FurtherCameras
    from warpav.rig.mount_surface import MountSurface
    from warpav.rig.rig import Rig

    Plotter = Any
    PolyData = Any

LONGEST_M = 0.8
"""Length of the arrow of the camera on which the loss depends most [m]; the others are shorter in proportion."""

WIDEST_RAD = math.radians(60.0)
"""Angle of the bent arrow of the camera on whose yaw the loss depends most, likewise."""

_RADIUS_M = 0.42  # of the bent arrows
_RISE_M = 0.1  # of all arrows above the middle of a camera, so that its housing does not hide them
_SHAFT_M, _TIP_M = 0.022, 0.06
_LEAST = 1e-2  # of the longest; shorter arrows would be all tip


@dataclass(frozen=True, eq=False)
class Steepest:
    """Direction of steepest descent at a rig: minus the gradient of the loss.

    Attributes:
        along: To x and y of every camera on the mount surface [1/m], float64 [camera, 2].
        turn: To its yaw, left positive [1/rad], float64 [camera].
    """

    along: np.ndarray
    turn: np.ndarray

    @classmethod
    def of_event(cls, event: Mapping[str, Any]) -> Steepest | None:
        """That of a line of ``events.jsonl``; None for runs that did not record it."""
        gradient = event.get("gradient")
        if not gradient:
            return None
        return cls(
            -np.asarray(gradient["position_per_m"], np.float64).reshape(-1, 2),
            -np.asarray(gradient["yaw_per_rad"], np.float64),
        )


def arrows_m(rig: Rig, descent: Steepest, surface: MountSurface, *, longest_m: float = LONGEST_M) -> np.ndarray:
    """Arrows along the mount surface that show where the descent moves the cameras.

    Returns:
        float64 [camera, 3] in the ego frame [m]: tangential to the surface, lengths in proportion to the gradient's
        norm; all 0 where the loss depends on no position.
    """
    norm = np.linalg.norm(descent.along, axis=1, keepdims=True)
    if not norm.any():
        return np.zeros((len(rig.cameras), 3))
    ahead = np.divide(descent.along, norm, out=np.zeros_like(descent.along), where=norm > 0.0)
    position_m, _ = surface.place_of(np.array([camera.position_m for camera in rig.cameras]))
    reach_m = max(surface.cell_m, 0.05)
    rise_m = surface.height_at_m(position_m + reach_m * ahead) - surface.height_at_m(position_m - reach_m * ahead)
    tangent = np.column_stack([ahead, rise_m / (2.0 * reach_m)])
    tangent = np.einsum("ki,kij->kj", tangent, surface.axes[surface.zone_at(position_m)])
    length = np.linalg.norm(tangent, axis=1, keepdims=True)
    return tangent / np.maximum(length, 1e-12) * longest_m * norm / norm.max()


def add_descent(
    plotter: Plotter, rig: Rig, descent: Steepest | None, surface: MountSurface, *, name: str = "descent"
) -> None:
    """Add straight arrows for where a step moves the cameras and bent ones for the direction in which it turns them.

    Lengths and angles are in proportion to the gradient; the longest of each kind have a fixed size.
    """
    for actor in [actor for actor in plotter.actors if actor.startswith(f"{name}/")]:
        plotter.remove_actor(actor)
    if descent is None:
        return
    if len(descent.turn) != len(rig.cameras):
        raise ValueError(f"expected a gradient for each of {len(rig.cameras)} cameras, got {len(descent.turn)}")
    widest = np.abs(descent.turn).max(initial=0.0)
    turn_rad = WIDEST_RAD * descent.turn / widest if widest > 0.0 else np.zeros(len(rig.cameras))
    for camera, arrow, angle in zip(rig.cameras, arrows_m(rig, descent, surface), turn_rad, strict=True):
        start = camera.position_m + np.array([0.0, 0.0, _RISE_M])
        curves = {}
        if np.linalg.norm(arrow) > _LEAST * LONGEST_M:
            curves["move"] = start + np.linspace(0.0, 1.0, 2)[:, None] * arrow
        if abs(angle) > _LEAST * WIDEST_RAD:
            bearing = camera.yaw_rad + np.linspace(0.0, angle, 24)
            curves["turn"] = start + _RADIUS_M * np.stack(
                [np.cos(bearing), np.sin(bearing), np.zeros(len(bearing))], axis=1
            )
        for kind, curve_m in curves.items():
            plotter.add_mesh(
                _arrow(curve_m),
                color=DESCENT_RGB,
                ambient=0.7,
                name=f"{name}/{camera.name}/{kind}",
                smooth_shading=False,
            )


def _arrow(curve_m: np.ndarray) -> PolyData:
    """An arrow along a curve [m], shape [point, 3], with a tip at its end."""
    pyvista = load_pyvista()
    length_m = np.linalg.norm(np.diff(curve_m, axis=0), axis=1).sum()
    tip_m = min(3.0 * _TIP_M, 0.6 * float(length_m))
    ahead = (curve_m[-1] - curve_m[-2]) / np.linalg.norm(curve_m[-1] - curve_m[-2])
    shaft = pyvista.lines_from_points(curve_m).tube(radius=_SHAFT_M, n_sides=12)
    tip = pyvista.Cone(
        center=curve_m[-1] + 0.5 * tip_m * ahead, direction=ahead, height=tip_m, radius=_TIP_M, resolution=20
    )
    return pyvista.merge([shaft, tip])


ARROW_M = 0.32
"""Length of an arrow [m]."""

TITLE = "one more camera: further objects found of 100"
"""Of the scale."""

_DOT_RADIUS_M = 0.022


def _further_to_pyvista(further: FurtherCameras) -> PolyData:
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
        _further_to_pyvista(further),
        scalars="gain_of_100",
        cmap=further_map(),
        clim=(0.0, max(100.0 * float(further.gain.max()), 1e-9)),
        ambient=0.5,
        name=name,
        scalar_bar_args=scale_of_gain(plotter, TITLE, scale_at),
    )
    lift_title(plotter, TITLE)
