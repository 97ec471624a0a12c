"""Outlines of meshes seen along an axis, as closed lines."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh

STEP_M = 0.002
"""Between the lines of the raster in which an outline is found [m]; lines may be off by about as much."""

_GRID_MAX = 12_000  # steps along a side: of a larger mesh they are longer
_SUBSTEP_BITS = 6


def silhouette_m(mesh: Mesh, right: np.ndarray, up: np.ndarray, *, hole_m2: float = 0.01) -> list[np.ndarray]:
    """What a mesh covers seen from afar, as closed lines around it and around its holes.

    Args:
        right: Direction of the picture's first coordinate, unit length, shape [3].

    Returns:
        Lines [m], float64 [point, 2], within two of `STEP_M` of the mesh, the largest first. The first point is not
        repeated at the end.
    """
    import cv2

    place_m = mesh.vertex_m.astype(np.float64) @ np.stack([right, up], axis=1)
    low_m, high_m = place_m.min(axis=0), place_m.max(axis=0)
    step_m = max(STEP_M, float((high_m - low_m).max()) / _GRID_MAX)
    columns, rows = (math.ceil(each) + 3 for each in (high_m - low_m) / step_m)
    covered = np.zeros((rows, columns), np.uint8)
    corner = np.round(((place_m - low_m) / step_m + 1.0) * 2**_SUBSTEP_BITS).astype(np.int32)[mesh.triangle]
    for each in corner:
        cv2.fillConvexPoly(covered, each, 1, lineType=cv2.LINE_8, shift=_SUBSTEP_BITS)
    lines, _ = cv2.findContours(covered, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    lines = [line for line in lines if cv2.contourArea(line) * step_m**2 >= hole_m2]
    lines.sort(key=cv2.contourArea, reverse=True)
    simple = (cv2.approxPolyDP(line, 1.0, True)[:, 0] for line in lines)
    return [low_m + (line - 1.0) * step_m for line in simple if len(line) > 2]
