"""Meshes of warpav as datasets of pyvista."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warpav.view.opengl import load_pyvista_data

if TYPE_CHECKING:
    from pyvista import PolyData

    from warpav.raster.mesh import Mesh


def mesh_to_pyvista(mesh: Mesh) -> PolyData:
    """The mesh as ``pyvista.PolyData``; colours are the point data ``RGB`` (uint8, shape [vertex, 3])."""
    pyvista = load_pyvista_data()
    surface = pyvista.PolyData.from_regular_faces(np.asarray(mesh.vertex_m), np.asarray(mesh.triangle))
    surface.point_data["RGB"] = mesh.vertex_rgb
    return surface
