"""What warpav adds to pyvista's datasets, under the name ``warpav``.

pyvista finds this module by the entry point ``pyvista.accessors`` the first time that somebody asks a dataset for
``.warpav``; importing the module does the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from warpav.view._opengl import load_pyvista_data

if TYPE_CHECKING:
    from warpav.raster.mesh import Mesh
    from warpav.scene import Scene

    MultiBlock = Any
    PolyData = Any

pyvista = load_pyvista_data()


@pyvista.register_dataset_accessor("warpav", pyvista.PolyData)
class _SurfaceAccessor:
    """``surface.warpav`` of a surface in the ego frame, in metres."""

    def __init__(self, surface: PolyData) -> None:
        self._surface = surface

    def as_mesh(self) -> Mesh:
        """The triangles, with the colours of the point data ``RGB``, grey without; what warpav's functions take."""
        from warpav.view._blocks import mesh_from_pyvista

        return mesh_from_pyvista(self._surface)

    def mount_surface(self, *, cell_m: float = 0.02, min_upward_normal: float = 0.9) -> PolyData:
        """Where cameras may stand on this vehicle: one square for each cell that can carry one."""
        from warpav.rig import mount_surface_from_mesh
        from warpav.view._layers import zones_to_pyvista

        normals: Any = {"min_upward_normal": min_upward_normal, "min_zone_normal": min_upward_normal}
        return zones_to_pyvista(mount_surface_from_mesh(self.as_mesh(), cell_m=cell_m, **normals))


@pyvista.register_dataset_accessor("warpav", pyvista.MultiBlock)
class _BlocksAccessor:
    """``blocks.warpav`` of a tree of surfaces in the ego frame, in metres."""

    def __init__(self, blocks: MultiBlock) -> None:
        self._blocks = blocks

    def as_scene(self, name: str | None = None) -> Scene:
        """The scene of ``environment``, ``ego`` and ``vehicle_<instance id>``; the inverse of ``Scene.to_pyvista``."""
        from warpav.view._blocks import scene_from_pyvista

        return scene_from_pyvista(self._blocks, name=name)
