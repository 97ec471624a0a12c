"""Requirements on the ground around a rig: every point by how many cameras see enough of its test object."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.opengl import load_pyvista
from warpav.view.palette import COVERAGE_RGB

if TYPE_CHECKING:
    from warpav.sight.check import RequirementResult

    Plotter = Any
    PolyData = Any

_LIFT_M = 0.06  # above the coverage, which is above the ground
_DISC_CORNERS = 12
_SHARE_OF_GRID = 0.4


def requirements_to_pyvista(result: RequirementResult) -> PolyData:
    """The points of requirements as ``pyvista.PolyData`` on the ground: discs where they are met, crosses where not."""
    ghosts, is_met = result.ghosts, result.is_point_met
    radius_m = _SHARE_OF_GRID * ghosts.of_each("grid_m").astype(float)
    colour = np.array(COVERAGE_RGB, np.uint8)[np.minimum(result.camera_count, 3)]
    angle = 2.0 * np.pi * np.arange(_DISC_CORNERS) / _DISC_CORNERS
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    disc = np.stack([np.zeros_like(rim), rim, np.roll(rim, -1, axis=0)], axis=1)
    bar = np.array([[-1.0, -0.22], [1.0, -0.22], [1.0, 0.22], [-1.0, 0.22]])
    bars = [bar @ [[c, s], [-s, c]] for c, s in ((np.sqrt(0.5), np.sqrt(0.5)), (np.sqrt(0.5), -np.sqrt(0.5)))]
    cross = np.stack([each[[0, k, k + 1]] for each in bars for k in (1, 2)])
    corners, points = [], []
    for shape, chosen, lift_m in ((disc, is_met, _LIFT_M), (cross, ~is_met, 1.5 * _LIFT_M)):
        index = np.flatnonzero(chosen)
        plane_m = ghosts.position_m[index][:, None, None] + radius_m[index][:, None, None, None] * shape
        height_m = np.full((*plane_m.shape[:-1], 1), lift_m)
        corners.append(np.concatenate([plane_m, height_m], axis=-1).reshape(-1, 3))
        points.append(np.repeat(index, len(shape)))
    corner_m, point = np.concatenate(corners), np.concatenate(points)
    surface = load_pyvista().PolyData.from_regular_faces(corner_m, np.arange(len(corner_m)).reshape(-1, 3))
    surface.cell_data["rgb"] = colour[point]
    surface.cell_data["point"] = point
    return surface


def add_requirements(plotter: Plotter, result: RequirementResult | None, *, name: str = "requirements") -> None:
    """Lay the points of requirements on the ground, or take them away."""
    if result is None:
        plotter.remove_actor(name)
        return
    plotter.add_mesh(
        requirements_to_pyvista(result),
        scalars="rgb",
        rgb=True,
        lighting=False,
        name=name,
        reset_camera=False,
        pickable=False,
        render=False,
    )
