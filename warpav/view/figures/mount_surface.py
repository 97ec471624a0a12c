"""The ego vehicle's mount surface (figure 9)."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np

from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh
from warpav.rig.mount_surface import MountSurface, measured_surface, mount_surface_from_mesh
from warpav.scene.capture.capture import EGO_INSTANCE, Capture
from warpav.scene.reconstruction.point_cloud import fuse
from warpav.scene.reconstruction.reconstruct import object_mesh
from warpav.scene.reconstruction.settings import ReconstructionSettings
from warpav.view.cloud_view import BACKGROUND_RGB, cloud_image, towards, view_of
from warpav.view.figures.style import (
    WIDTH_INCH,
    caption,
    count_text,
    empty_panel,
    figure_style,
    new_figure,
    panel_sizes_px,
    save_figure,
    show_image,
    title,
)
from warpav.view.figures.top_view import draw_height_map, draw_vehicle


def mount_surface_stages(
    capture: Capture, path: Path | str, *, settings: ReconstructionSettings | None = None, cell_m: float = 0.02
) -> Path:
    """Figure 9: the ego vehicle's points with the height map on them, and how the map's holes are filled."""
    settings = settings or ReconstructionSettings()
    images = list(capture.images)
    cloud = fuse(dataclasses.replace(capture, vehicles=()), images, settings.cloud).ego
    if len(cloud.cloud) == 0:
        raise InputError(f"{capture.name}: expected images of the ego vehicle, got none")
    ego = object_mesh(cloud, images, EGO_INSTANCE, settings.ego, settings)
    maps = {
        "Measured": measured_surface(ego, cell_m=cell_m),
        "Filled": mount_surface_from_mesh(ego, cell_m=cell_m, smoothing_tolerance_m=math.inf),
        "Smoothed": mount_surface_from_mesh(ego, cell_m=cell_m),
    }
    surface = maps["Smoothed"]
    limits_m = float(surface.height_m.min()), float(surface.height_m.max())
    with figure_style():
        figure = new_figure(WIDTH_INCH, 5.5)
        axes = figure.subplots(2, 2)
        title(axes[0, 0], "Map and points", count_text(len(cloud.cloud)))
        empty_panel(axes[0, 0])
        low_m, high_m = ego.bounds_m()[:, :2] + np.array([[-0.15], [0.15]])
        axes[0, 0].set_box_aspect((high_m[1] - low_m[1]) / (high_m[0] - low_m[0]))
        image = None
        for axis, (text, one) in zip(axes.flat[1:], maps.items(), strict=True):
            draw_vehicle(axis, ego)
            image = draw_height_map(axis, one, colours="viridis")
            image.set_clim(*limits_m)
            share = float(np.isfinite(one.height_m).mean())
            title(axis, text, f"{100.0 * share:.0f} % of the cells" if share < 1.0 else "")
            axis.set(xlim=(low_m[0], high_m[0]), ylim=(low_m[1], high_m[1]), aspect="equal")
            axis.set_ylabel("y, left [m]")
            axis.set_xlabel("x, forward [m]")
        bar = figure.colorbar(image, ax=axes, shrink=0.7, pad=0.02, aspect=28)
        bar.set_label("height of the mount surface [m]")
        bar.outline.set_visible(False)
        caption(
            figure,
            f"{capture.name}. Measured: what looks upwards, seen from above, in cells of {100.0 * cell_m:g} cm. "
            "Filled: other cells have the height of the nearest.\nSmoothed: until they no longer change.",
        )
        (size_px,) = panel_sizes_px(figure, axes[:1, 0])
        viewpoint = view_of(cloud.cloud.point_m, towards(math.radians(38.0), math.radians(40.0)), size_px)
        parts = [cloud.cloud, _coloured(surface, limits_m)]
        show_image(
            axes[0, 0],
            cloud_image(parts, viewpoint, size_px=size_px, point_px=1.6, cover=1.0, background_rgb=BACKGROUND_RGB),
        )
        return save_figure(figure, path)


def _coloured(surface: MountSurface, limits_m: tuple[float, float]) -> Mesh:
    """A height map as squares, one for each cell, in colours of height."""
    import matplotlib

    height_m = surface.height_m.astype(np.float64)
    share = (height_m - limits_m[0]) / max(limits_m[1] - limits_m[0], 1e-9)
    rgb = np.rint(255.0 * matplotlib.colormaps["viridis"](np.clip(share, 0.0, 1.0))[..., :3]).astype(np.uint8)
    row, column = np.indices(height_m.shape)
    centre = np.stack(
        [
            surface.origin_m[0] + row * surface.cell_m,
            surface.origin_m[1] + column * surface.cell_m,
            height_m + 0.02,  # clear of the points that it was made of
        ],
        axis=-1,
    ).reshape(-1, 1, 3)
    corner = 0.5 * surface.cell_m * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    first = 4 * np.arange(height_m.size)[:, None]
    triangle = np.concatenate([first + np.array(half) for half in ([0, 1, 2], [0, 2, 3])])
    return Mesh(
        (centre + corner).reshape(-1, 3).astype(np.float32),
        triangle.astype(np.int32),
        np.repeat(rgb.reshape(-1, 3), 4, axis=0),
    )
