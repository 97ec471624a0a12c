"""Pictures of point clouds and meshes in their own colours, from any place, without a window."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warpav.geometry.mesh import Mesh
from warpav.view.opengl import load_pyvista
from warpav.view.palette import PAPER_RGB, Rgb, hex_colour
from warpav.view.rig_view import mesh_to_pyvista

if TYPE_CHECKING:
    from warpav.reconstruction.point_cloud import PointCloud
    from warpav.scene.scene import Box

_SUPERSAMPLING = 2
_BOX_LINE_PX = 1.6


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """From where a picture is drawn.

    Attributes:
        position_m: The viewer, in the ego frame [m], shape [3].
        target_m: What is in the middle of the picture [m], shape [3].
        up: Direction that points up in the picture, shape [3].
        height_rad: Vertical field of view [rad].
        height_m: Instead, height of the picture [m]: lines stay parallel.
    """

    position_m: np.ndarray
    target_m: np.ndarray
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    height_rad: float = math.radians(50.0)
    height_m: float | None = None


def cloud_picture(
    parts: Sequence[PointCloud | Mesh],
    viewpoint: Viewpoint,
    *,
    size_px: tuple[int, int],
    point_px: float = 1.5,
    boxes: Sequence[Box] = (),
    box_rgb: Rgb = (240, 126, 22),
    background_rgb: Rgb = PAPER_RGB,
) -> np.ndarray:
    """Draw clouds and meshes.

    Args:
        parts: What to draw, in the ego frame.
        viewpoint: From where.
        size_px: Width and height of the picture [px].
        point_px: Size of a point [px].
        boxes: 3D boxes, drawn as wires.
        box_rgb: Their colour.
        background_rgb: Colour where nothing is.

    Returns:
        uint8, shape [row, column, 3].

    Raises:
        InputError: This machine cannot draw.
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
                points = pyvista.PolyData(np.asarray(part.point_m))
                points.point_data["RGB"] = part.rgb
                plotter.add_mesh(
                    points,
                    scalars="RGB",
                    rgb=True,
                    style="points",
                    point_size=point_px * _SUPERSAMPLING,
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
