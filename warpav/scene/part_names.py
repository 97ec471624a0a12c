"""What a mesh file calls the parts of a vehicle: its nodes, geometries and materials."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.scene.own_vehicle import examine, read_vehicle_file
from warpav.scene.vehicles import file_of

SAME_M = 1e-3
"""A triangle of the file and one of the vehicle whose middles are so near are one [m]."""


def part_names(path: str | Path, mesh: Mesh, *, forward: str | None = None) -> list[str] | None:
    """Names of node, geometry and material of every triangle of a vehicle, each as one text.

    Shapes: returns [triangle].
    """
    import trimesh
    from scipy.spatial import KDTree

    file = read_vehicle_file(file_of(path))
    loaded = trimesh.load_scene(file.path, process=False)
    names: list[str] = []
    for node in loaded.graph.nodes_geometry:
        geometry_name = loaded.graph.get(node)[1]
        geometry: Any = loaded.geometry[geometry_name]
        material = getattr(getattr(geometry, "visual", None), "material", None)
        text = " ".join((str(node), str(geometry_name), str(getattr(material, "name", None) or "")))
        names += [text] * len(getattr(geometry, "faces", ()))
    if len(names) != len(file.triangle):
        return None
    found = examine(file, file.usual.changed(forward=forward))
    middle_m = found.mesh.vertex_m[found.mesh.triangle].mean(axis=1) + found.shift_m
    away_m, nearest = KDTree(middle_m).query(mesh.vertex_m[mesh.triangle].mean(axis=1))
    if np.max(away_m) > SAME_M:
        return None
    return [names[k] for k in np.asarray(nearest)]
