"""The rasteriser: meshes and cameras in; object ids, depths, colours, areas and their derivatives out.

It needs no vehicle, rig or traffic: ``scene = Scene({"cube": Mesh(vertices, faces, rgb)})``, ``frame = render(scene,
Cameras(intrinsics, width_px=640, height_px=480), camera_from_world)``, ``frame.areas().visible``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warpav.raster.areas import Areas, Measures
    from warpav.raster.camera import Cameras
    from warpav.raster.frame import Frame
    from warpav.raster.mesh import Mesh
    from warpav.raster.renderer import render
    from warpav.raster.scene import Scene

__all__ = ["Areas", "Cameras", "Frame", "Measures", "Mesh", "Scene", "render"]

_MODULE = {
    "Areas": "areas",
    "Cameras": "camera",
    "Frame": "frame",
    "Measures": "areas",
    "Mesh": "mesh",
    "Scene": "scene",
    "render": "renderer",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 (whatever the name stands for)
    """Public names, whose modules (and Warp) are loaded when they are first used."""
    if name not in _MODULE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE[name]}"), name)
