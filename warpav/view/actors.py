"""What pictures in space are made of: surfaces in their own colours, texts, legends and scales in a plotter."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.opengl import load_pyvista_data
from warpav.view.palette import INK_RGB, Rgb, further_map, hex_colour

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pyvista import PolyData

    from warpav.raster.mesh import Mesh

    Plotter = Any

SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
"""Corners of a cell around its middle, in cells."""

GAIN_TITLE = "one more camera: further objects found of 100"


def mesh_to_pyvista(mesh: Mesh) -> PolyData:
    """The mesh as ``pyvista.PolyData``; colours are the point data ``RGB`` (uint8, shape [vertex, 3])."""
    pyvista = load_pyvista_data()
    surface = pyvista.PolyData.from_regular_faces(np.asarray(mesh.vertex_m), np.asarray(mesh.triangle))
    surface.point_data["RGB"] = mesh.vertex_rgb
    return surface


def faces_to_pyvista(corner_m: np.ndarray, sides: int = 4) -> PolyData:
    """Faces of so many corners each that share none, from their corners [m], in order [corner, 3]."""
    return load_pyvista_data().PolyData.from_regular_faces(corner_m, np.arange(len(corner_m)).reshape(-1, sides))


def paint(plotter: Plotter, surface: PolyData, *, name: str, colours: str = "RGB") -> None:
    """Add a surface in the colours of its data as they are: those of meshes hold their light."""
    plotter.add_mesh(surface, scalars=colours, rgb=True, lighting=False, show_edges=False, name=name)


def remove(plotter: Plotter, name: str) -> None:
    """Take an actor away, and those whose names begin with its name and a slash."""
    for each in [each for each in plotter.actors if each == name or each.startswith(f"{name}/")]:
        plotter.remove_actor(each)


@contextmanager
def no_render(plotter: Plotter) -> Iterator[None]:
    """Change a plotter without drawing after every change, as pyvista does once it was drawn."""
    plotter.suppress_rendering = True
    try:
        yield
    finally:
        plotter.suppress_rendering = False


def add_text(plotter: Plotter, text: str, at: tuple[float, float], *, size: float, name: str, **style: Any) -> Any:  # noqa: ANN401
    """Write a text at a place of the image, as shares of it from the lower left corner."""
    style = {"color": hex_colour(INK_RGB)} | style
    return plotter.add_text(text, position=at, viewport=True, font_size=size, name=name, **style)


def add_legend(plotter: Plotter, labels: dict[str, Rgb], *, name: str = "legend", bottom: float = 0.025) -> None:
    """Say what colours mean, in the lower left corner; an earlier legend is replaced."""
    remove(plotter, name)
    size = 10.0 * plotter.window_size[1] / 800.0
    for line, (text, rgb) in enumerate(reversed(labels.items())):
        at = (0.015, bottom + 0.037 * line)
        actor = add_text(plotter, f" {text} ", at, size=size, name=f"{name}/{line}")
        actor.prop.background_color = hex_colour(rgb)
        actor.prop.background_opacity = 0.8


def add_labels(plotter: Plotter, point_m: np.ndarray, texts: list[str], *, size: int, name: str) -> None:
    """Write texts at points, without a frame, before everything else."""
    style = {"shape": None, "show_points": False, "always_visible": True}
    plotter.add_point_labels(point_m, texts, text_color=hex_colour(INK_RGB), font_size=size, name=name, **style)


def add_gains(
    plotter: Plotter,
    surface: PolyData | None,
    most: float,
    *,
    name: str,
    at: tuple[float, float],
    **style: Any,  # noqa: ANN401 (of pyvista)
) -> None:
    """Add a surface in the colours of its ``gain_of_100``, with a scale; what was drawn before under the name goes."""
    plotter.remove_actor(name)
    if GAIN_TITLE in plotter.scalar_bars:
        plotter.remove_scalar_bar(GAIN_TITLE)
    if surface is None or not surface.n_cells:
        return
    size = max(9, round(16 * min(1.0, plotter.window_size[0] / 1280)))
    scale = {"title": GAIN_TITLE, "color": hex_colour(INK_RGB), "fmt": "%.1f", "n_labels": 3}
    scale |= {"position_x": at[0], "position_y": at[1], "width": 0.35, "height": 0.115}
    scale |= {"title_font_size": size, "label_font_size": size}
    colours = {"scalars": "gain_of_100", "cmap": further_map(), "clim": (0.0, max(most, 1e-9))}
    plotter.add_mesh(surface, **colours, **style, name=name, scalar_bar_args=scale)
    plotter.scalar_bars[GAIN_TITLE].SetTitle(f"{GAIN_TITLE}\n ")  # VTK lets it touch its numbers
