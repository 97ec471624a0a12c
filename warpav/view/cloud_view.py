"""Images of point clouds and meshes in their own colours, from any position, without a window."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import KDTree

from warpav.raster.mesh import Mesh
from warpav.view.opengl import load_pyvista
from warpav.view.palette import PAPER_RGB, Rgb, hex_colour
from warpav.view.polydata import mesh_to_pyvista

if TYPE_CHECKING:
    from warpav.scene.reconstruction.point_cloud import PointCloud
    from warpav.scene.scene import Box

BACKGROUND_RGB: Rgb = (214, 205, 230)
"""Where an image shows nothing: not the colour of a vehicle, a road or the sky."""

_SUPERSAMPLING = 2
_BOX_LINE_PX = 1.6
_LARGEST_PX = 10.0  # of a point
_SPACING_SAMPLES = 2000


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """From where an image is drawn.

    Attributes:
        position_m: The viewer, in the ego frame [m], shape [3].
        target_m: What is in the middle of the image [m], shape [3].
        up: Direction that points up in the image, shape [3].
    """

    position_m: np.ndarray
    target_m: np.ndarray
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    height_rad: float = math.radians(50.0)
    height_m: float | None = None


def cloud_image(
    parts: Sequence[PointCloud | Mesh],
    viewpoint: Viewpoint,
    *,
    size_px: tuple[int, int],
    point_px: float = 1.5,
    cover: float = 0.0,
    boxes: Sequence[Box] = (),
    box_rgb: Rgb = (240, 126, 22),
    background_rgb: Rgb = PAPER_RGB,
) -> np.ndarray:
    """Draw clouds and meshes.

    Returns:
        uint8, shape [row, column, 3].
    """
    from PIL import Image

    pyvista = load_pyvista()

    drawn_px = [_SUPERSAMPLING * size for size in size_px]
    plotter = pyvista.Plotter(off_screen=True, window_size=drawn_px, lighting="none")
    try:
        plotter.set_background(hex_colour(background_rgb))
        for part in parts:
            if isinstance(part, Mesh):
                if len(part.triangle):
                    plotter.add_mesh(mesh_to_pyvista(part), scalars="RGB", rgb=True, lighting=False)
            elif len(part):
                for chosen, drawn_point_px in _by_size(part, viewpoint, size_px[1], point_px, cover):
                    points = pyvista.PolyData(part.point_m[chosen])
                    points.point_data["RGB"] = part.rgb[chosen]
                    plotter.add_mesh(
                        points,
                        scalars="RGB",
                        rgb=True,
                        style="points",
                        point_size=drawn_point_px * _SUPERSAMPLING,
                        lighting=False,
                    )
        for box in boxes:
            corner = box.corners_m()
            first, second = np.triu_indices(8, 1)
            is_edge = np.isin(first ^ second, (1, 2, 4))  # corners are numbered in binary
            lines = np.stack([np.full(is_edge.sum(), 2), first[is_edge], second[is_edge]], axis=1)
            wires = pyvista.PolyData(corner, lines=lines.ravel())
            plotter.add_mesh(wires, color=box_rgb, line_width=_BOX_LINE_PX * _SUPERSAMPLING, lighting=False)
        plotter.camera_position = [tuple(viewpoint.position_m), tuple(viewpoint.target_m), viewpoint.up]
        if viewpoint.height_m is None:
            plotter.camera.view_angle = math.degrees(viewpoint.height_rad)
        else:
            plotter.enable_parallel_projection()
            plotter.camera.parallel_scale = 0.5 * viewpoint.height_m
        plotter.camera_set = True
        plotter.reset_camera_clipping_range()
        drawn = Image.fromarray(np.ascontiguousarray(plotter.screenshot(return_img=True)))
        return np.asarray(drawn.resize(size_px, Image.Resampling.LANCZOS))
    finally:
        plotter.close()


def towards(bearing_rad: float, elevation_rad: float) -> np.ndarray:
    """Unit vector of a direction in the ego frame, shape [3]."""
    level = math.cos(elevation_rad)
    return np.array([level * math.cos(bearing_rad), level * math.sin(bearing_rad), math.sin(elevation_rad)])


def view_of(point_m: np.ndarray, direction: np.ndarray, size_px: tuple[int, int]) -> Viewpoint:
    """Without perspective, just so that all points are in the image.

    Args:
        point_m: Points in the ego frame [m], shape [point, 3].
    """
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= np.linalg.norm(right)
    above = np.cross(direction, right)
    low, high = (reduce(point_m @ np.stack([right, above], axis=1), axis=0) for reduce in (np.min, np.max))
    middle, (width_m, height_m) = 0.5 * (low + high), high - low
    target_m = middle[0] * right + middle[1] * above + np.median(point_m @ direction) * direction
    height_m = 1.08 * max(width_m * size_px[1] / size_px[0], height_m)
    return Viewpoint(target_m + 150.0 * direction, target_m, height_m=height_m)


def _by_size(
    cloud: PointCloud, viewpoint: Viewpoint, height_px: int, point_px: float, cover: float
) -> Iterator[tuple[np.ndarray, float]]:
    """Indices of the points of each size, and the size [px], in steps of half a doubling."""
    if cover <= 0.0:
        yield np.arange(len(cloud)), point_px
        return
    some_m = cloud.point_m[:: -(-len(cloud) // _SPACING_SAMPLES)]
    distance_m, _ = KDTree(cloud.point_m).query(some_m, k=2)
    edge_m = cover * float(np.median(distance_m[:, 1])) if len(cloud) > 1 else 0.0
    if viewpoint.height_m is not None:
        yield np.arange(len(cloud)), float(np.clip(edge_m * height_px / viewpoint.height_m, point_px, _LARGEST_PX))
        return
    depth_m = np.linalg.norm(cloud.point_m - np.asarray(viewpoint.position_m, np.float32), axis=1)
    focal_px = 0.5 * height_px / math.tan(0.5 * viewpoint.height_rad)
    wanted_px = np.clip(focal_px * edge_m / np.maximum(depth_m, 1e-3), point_px, _LARGEST_PX)
    step = np.round(2.0 * np.log2(wanted_px / point_px)).astype(int)
    for one in np.unique(step):
        yield np.flatnonzero(step == one), point_px * 2.0 ** (0.5 * one)
