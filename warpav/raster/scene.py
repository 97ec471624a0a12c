"""Meshes packed on a device: triangles sorted into clusters, objects as layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import warp as wp

from warpav.core.errors import InputError
from warpav.core.warp_setup import load_warp
from warpav.raster.mesh import Mesh, merge
from warpav.raster.pane import Pane
from warpav_kernels.raster import Triangles

CLUSTER_SIZE = 64

_TYPES: dict[str, object] = {
    "vertex_world_m": wp.vec3,
    "triangle": wp.vec3i,
    "triangle_body": wp.int32,
    "triangle_plane": wp.vec4,
    "neighbour": wp.vec3i,
    "body_layer": wp.int32,
    "cluster_first": wp.int32,
    "cluster_count": wp.int32,
    "cluster_vertices": wp.vec2i,
    "cluster_layer": wp.int32,
    "cluster_sphere_world_m": wp.vec4,
    "cluster_closed_world_m": wp.vec3,
    "layer_body": wp.int32,
    "layer_bounds_world_m": wp.vec3,
    "vertex_rgb": wp.vec3,
}
"""Arrays of a scene on its device: the members of `Triangles`, then the scene's own."""

_OF_TRIANGLES = ("triangle", "triangle_body", "triangle_plane", "neighbour")
_OF_CLUSTERS = (
    *("cluster_first", "cluster_count", "cluster_vertices", "cluster_layer", "cluster_sphere_world_m"),
    "cluster_closed_world_m",
)
_CACHED = ("mesh", "occluder_mesh", "_through")

BACKGROUND_ID = -1
"""What ids say where nothing is hit. Object k is k, occluder j is ``-2 - j``; the foreground is the last occluder."""


def _spread_bits(value: np.ndarray) -> np.ndarray:
    """Every bit of a 10-bit number moved to three times its place, for Morton codes; uint64, same shape."""
    value = value.astype(np.uint64)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        value = (value | (value << np.uint64(shift))) & np.uint64(mask)
    return value


def _morton_order(centre_m: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Order that sorts triangles by body and, within a body, along a Morton curve; int64 [triangle]."""
    low, high = centre_m.min(axis=0), centre_m.max(axis=0)
    cell = ((centre_m - low) / np.maximum(high - low, 1e-9) * 1023.0).astype(np.uint64)
    code = (
        _spread_bits(cell[:, 0])
        | (_spread_bits(cell[:, 1]) << np.uint64(1))
        | (_spread_bits(cell[:, 2]) << np.uint64(2))
    )
    return np.lexsort((code, body))


def _planes(corner_m: np.ndarray) -> np.ndarray:
    """Unit normals and their products with a point of the plane [m], float32 [triangle, 4].

    ``corner_m`` is [triangle, corner, axis].
    """
    corner_m = corner_m.astype(np.float64)
    normal = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    return np.c_[normal, np.einsum("ij,ij->i", normal, corner_m[:, 0])].astype(np.float32)


def _neighbours(vertex_m: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Triangles across the sides (0, 1), (1, 2) and (2, 0), int32 [triangle, 3].

    -1 where a side has no neighbour, several, or one of the other winding. Vertices at one place count as one.
    """
    result = np.full((len(triangle), 3), -1, np.int32)
    coordinates = np.ascontiguousarray(vertex_m, np.float32) + np.float32(0.0)  # no negative zeros
    _, place = np.unique(coordinates.view(np.dtype((np.void, 12))).ravel(), return_inverse=True)
    start = place[triangle].astype(np.int64)
    end = np.roll(start, -1, axis=1)
    side = (np.minimum(start, end) * len(vertex_m) + np.maximum(start, end)).ravel()
    order = np.argsort(side, kind="stable")
    first = np.flatnonzero(np.diff(side[order], prepend=-1))
    first = first[np.diff(first, append=len(side)) == 2]
    a, b = order[first], order[first + 1]
    is_one_winding = start.ravel()[a] == end.ravel()[b]
    a, b = a[is_one_winding], b[is_one_winding]
    result[a // 3, a % 3] = b // 3
    result[b // 3, b % 3] = a // 3
    return result


def _closed_bounds(corner_m: np.ndarray, neighbour: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner of the surface of every triangle [m], infinite if that is open; [triangle, axis].

    A surface is what hangs together across sides. It is closed if no triangle lacks a neighbour and it holds a positive
    volume, so that its triangles face outwards. ``corner_m`` is [triangle, corner, axis].
    """
    row = np.arange(len(neighbour), dtype=np.int32)
    side = (np.repeat(row, 3), np.where(neighbour >= 0, neighbour, row[:, None]).ravel())
    hangs = scipy.sparse.coo_array((np.ones(3 * len(row), bool), side), shape=(len(row), len(row)))
    count, surface = scipy.sparse.csgraph.connected_components(hangs, directed=False)
    order = np.argsort(surface, kind="stable")
    first = np.searchsorted(surface[order], np.arange(count))
    corner_m = corner_m[order].astype(np.float64)
    low = np.minimum.reduceat(corner_m.min(axis=1), first, axis=0)
    high = np.maximum.reduceat(corner_m.max(axis=1), first, axis=0)
    local = corner_m - 0.5 * (low + high)[surface[order], None]
    volume = np.add.reduceat(np.einsum("ij,ij->i", local[:, 0], np.cross(local[:, 1], local[:, 2])), first)
    is_open = np.logical_or.reduceat((neighbour[order] < 0).any(axis=1), first) | (volume <= 0.0)
    low[is_open], high[is_open] = -np.inf, np.inf
    return low[surface], high[surface]


class Scene:
    """Triangle meshes on a device, in one world frame. A scene does not change: for other meshes make another scene.

    Objects have names, and are measured one by one. Occluders hide objects and have colours and depths, but are not
    measured.

    Attributes:
        device: Where it is.
        object_names: Names of the objects, in order.
        object_count: Number of objects.
        occluder_count: Number of occluders; the foreground is the last of them.
        foreground_layer: Layer of the foreground; -1 where there is none.
        layer_count: Number of layers: the objects, and the foreground where there is one.
        triangles: Sorted triangles and their clusters (struct of the kernels).
        layer_body: Body of every layer, int32 [layer]; bodies are the occluders in order, then the objects.
        layer_bounds_world_m: Lowest and highest corner of every layer's body [m], vec3 [layer, 2].
        vertex_rgb: Vertex colours 0..1, vec3 [vertex].
        background_rgb: Colours 0..1 of the background at and below the horizon, and overhead (along world z), vec3.
        cluster_count: Number of clusters.
        occluder_cluster_count: Number of those of the occluders, which come first.
        triangle_count: Number of triangles.
        source_triangle: Place of every sorted triangle in the bodies' triangles, one body behind the other, [triangle].
        source_vertex: The same of every vertex; one that several clusters use is there several times, [vertex].
    """

    def __init__(
        self,
        objects: Mapping[str, Mesh] | None = None,
        occluders: Sequence[Mesh] = (),
        *,
        foreground: Mesh | None = None,
        background_rgb: object = (0, 0, 0),
        device: str | wp.Device | None = "cpu",
    ) -> None:
        """Pack the meshes: triangles and vertices are sorted.

        Args:
            objects: Meshes to measure, by name.
            occluders: Meshes that hide them.
            foreground: One more occluder, whose own silhouette `Frame.unblocked_area` and the pairwise occlusion use:
                it counts as nearest everywhere there. For example the body that carries the cameras.
            background_rgb: sRGB colour 0..255 where nothing is hit, [3]; or two, at the horizon and overhead, [2, 3].
            device: Warp device.

        Raises:
            InputError: There is no mesh at all, a mesh cannot be drawn (see `Mesh.check`), a colour is out of range, or
                there are too many vertices or triangles.
            TypeError: Something else than meshes.
        """
        load_warp()
        if not isinstance(objects, Mapping | None):
            raise TypeError(f"objects: expected meshes by name, such as {{'cube': mesh}}, got {type(objects).__name__}")
        if isinstance(occluders, Mesh):
            raise TypeError("occluders: expected a list of meshes, got one mesh; write occluders=[mesh]")
        objects = dict(objects or {})
        occluders = [*occluders, *([foreground] if foreground is not None else [])]
        named = {f"occluders[{j}]": mesh for j, mesh in enumerate(occluders)}
        named |= {f"objects[{name!r}]": mesh for name, mesh in objects.items()}
        if not named:
            raise InputError("objects, occluders: expected at least one mesh, got none")
        for name, mesh in named.items():
            if not isinstance(mesh, Mesh):
                raise TypeError(f"{name}: expected a raster.Mesh, got {type(mesh).__name__}")
            mesh.check(name)
        self._name(tuple(objects), len(occluders), has_foreground=foreground is not None)
        self.background_rgb = _background(background_rgb)
        self._place(self._packed(list(named.values())), device)

    def arrays(self) -> dict[str, np.ndarray]:
        """All that the scene is, on the host, for `of_arrays`."""
        on_device = {name: getattr(self.triangles if name in Triangles.vars else self, name) for name in _TYPES}
        return {
            "object_names": np.array(self.object_names, str),
            "occluder_count": np.array(self.occluder_count),
            "has_foreground": np.array(self.foreground_layer >= 0),
            "background_rgb": np.array([list(rgb) for rgb in self.background_rgb], np.float32),
            "source_triangle": self.source_triangle,
            "source_vertex": self.source_vertex,
            **{name: array.numpy() for name, array in on_device.items()},
        }

    @classmethod
    def of_arrays(
        cls, arrays: Mapping[str, np.ndarray] | np.ndarray, *, device: str | wp.Device | None = "cpu"
    ) -> Scene:
        """The scene that `arrays` told of, maybe in another process; on the CPU nothing is copied."""
        load_warp()
        scene = cls.__new__(cls)
        names = tuple(str(name) for name in arrays["object_names"])
        scene._name(names, int(arrays["occluder_count"]), has_foreground=bool(arrays["has_foreground"]))
        horizon, zenith = arrays["background_rgb"]
        scene.background_rgb = wp.vec3(*horizon), wp.vec3(*zenith)
        scene._place(arrays, device, copy=False)
        return scene

    def _name(self, object_names: tuple[str, ...], occluder_count: int, *, has_foreground: bool) -> None:
        self.object_names = object_names
        self.object_count, self.occluder_count = len(object_names), occluder_count
        self.foreground_layer = self.object_count if has_foreground else -1
        self.layer_count = self.object_count + has_foreground

    def _packed(self, meshes: list[Mesh]) -> dict[str, np.ndarray]:
        """Arrays of the meshes: occluders, then objects."""
        whole = merge(meshes)
        body = np.repeat(np.arange(len(meshes)), [len(mesh.triangle) for mesh in meshes])
        order = _morton_order(whole.vertex_m[whole.triangle].mean(axis=1), body)
        triangle, body = whole.triangle[order], body[order].astype(np.int32)

        # cut every body's run of triangles into clusters
        run_first = np.searchsorted(body, np.arange(len(meshes)))
        run_end = np.searchsorted(body, np.arange(len(meshes)), side="right")
        first = np.concatenate([np.arange(a, b, CLUSTER_SIZE) for a, b in zip(run_first, run_end, strict=True)])
        count = np.diff(np.append(first, len(triangle)))
        corner_m = whole.vertex_m[triangle].reshape(-1, 3)
        low = np.minimum.reduceat(corner_m, 3 * first, axis=0)
        high = np.maximum.reduceat(corner_m, 3 * first, axis=0)
        centre = 0.5 * (low + high)
        reach = np.linalg.norm(corner_m - np.repeat(centre, 3 * count, axis=0), axis=1)
        radius = np.maximum.reduceat(reach, 3 * first) * (1.0 + 1e-5)

        layer_body = np.array([*range(self.occluder_count, len(meshes)), self.occluder_count - 1], np.int32)
        layer_body = layer_body[: self.layer_count]
        layer_of_body = np.full(len(meshes), -1, np.int32)
        layer_of_body[layer_body] = np.arange(len(layer_body))
        bounds_m = np.array([meshes[i].bounds_m() for i in layer_body], np.float32).reshape(-1, 2, 3)

        neighbour = _neighbours(whole.vertex_m, triangle)
        closed_low, closed_high = _closed_bounds(corner_m.reshape(-1, 3, 3), neighbour)
        closed = np.stack(
            [np.minimum.reduceat(closed_low, first, axis=0), np.maximum.reduceat(closed_high, first, axis=0)], axis=1
        )
        # every cluster gets vertices of its own
        cluster = np.repeat(np.arange(len(first)), count)
        owned = cluster[:, None] * np.int64(len(whole.vertex_m)) + triangle
        owned, triangle = np.unique(owned, return_inverse=True)
        source_vertex = owned % len(whole.vertex_m)
        vertex_end = np.searchsorted(owned, np.arange(1, len(first) + 1) * len(whole.vertex_m))
        vertex_count = np.diff(vertex_end, prepend=0)
        return {
            "vertex_world_m": whole.vertex_m[source_vertex],
            "triangle": triangle.astype(np.int32),
            "triangle_body": body,
            "triangle_plane": _planes(corner_m.reshape(-1, 3, 3)),
            "neighbour": neighbour,
            "body_layer": layer_of_body,
            "cluster_first": first.astype(np.int32),
            "cluster_count": count.astype(np.int32),
            "cluster_vertices": np.c_[vertex_end - vertex_count, vertex_count].astype(np.int32),
            "cluster_layer": layer_of_body[body[first]],
            "cluster_sphere_world_m": np.c_[centre, radius].astype(np.float32),
            "cluster_closed_world_m": closed.astype(np.float32),
            "layer_body": layer_body,
            "layer_bounds_world_m": bounds_m,
            "vertex_rgb": whole.vertex_rgb[source_vertex].astype(np.float32) / 255.0,
            "source_triangle": order,
            "source_vertex": source_vertex,
        }

    def _place(
        self, arrays: Mapping[str, np.ndarray] | np.ndarray, device: str | wp.Device | None, *, copy: bool = True
    ) -> None:
        self.device = _device(device)
        on_device = {
            name: wp.array(arrays[name], dtype=kind, device=self.device, copy=copy)  # pyright: ignore[reportArgumentType]
            for name, kind in _TYPES.items()
        }
        self.triangles: Any = Triangles()  # the struct is no type to a checker
        for name in Triangles.vars:
            setattr(self.triangles, name, on_device[name])
        self.layer_body, self.vertex_rgb = on_device["layer_body"], on_device["vertex_rgb"]
        self.layer_bounds_world_m = on_device["layer_bounds_world_m"]
        self.cluster_count, self.triangle_count = len(arrays["cluster_first"]), len(arrays["triangle"])
        self._occluder_triangle_count = int(np.searchsorted(arrays["triangle_body"], self.occluder_count))
        self.occluder_cluster_count = int(np.searchsorted(arrays["cluster_first"], self._occluder_triangle_count))
        self.source_triangle, self.source_vertex = arrays["source_triangle"], arrays["source_vertex"]

    def through(self, pane: Pane | None) -> Scene:
        """The scene for views that look through a pane: without what of the foreground is clear; kept for the next.

        Surfaces that have lost triangles are open: from the inside their backs are seen.
        """
        if pane is None:
            return self
        if self.foreground_layer < 0:
            raise ValueError("pane: expected a scene with a foreground, got none")
        kept: dict[Pane, Scene] = self.__dict__.setdefault("_through", {})
        if pane not in kept:
            kept[pane] = self._without(pane)
        return kept[pane]

    def foreground_mesh(self) -> Mesh:
        """The foreground as a mesh, without the vertices of the others; there has to be one."""
        body = self.layer_body.numpy()[self.foreground_layer]
        own = self.triangles.triangle.numpy()[(self.triangles.triangle_body.numpy() == body) & self._is_drawn]
        used, triangle = np.unique(own, return_inverse=True)
        vertex_rgb = np.rint(255.0 * self.vertex_rgb.numpy()[used]).astype(np.uint8)
        return Mesh(self.triangles.vertex_world_m.numpy()[used], triangle.reshape(-1, 3).astype(np.int32), vertex_rgb)

    def carrying(self, mesh: Mesh | None) -> Scene:
        """The scene with one more mesh as a part of its foreground, such as what a rig puts on the body.

        Args:
            mesh: In the world frame [m]; None: the scene itself is returned.

        Raises:
            ValueError: There is no foreground.
        """
        if mesh is None:
            return self
        if self.foreground_layer < 0:
            raise ValueError("mesh: expected a scene with a foreground, got none")
        known, added = self.arrays(), Scene(foreground=mesh, device="cpu").arrays()
        vertices, triangle, cluster = (
            len(known["vertex_rgb"]),
            self._occluder_triangle_count,
            self.occluder_cluster_count,
        )
        more = len(added["triangle"])
        # vertices join at the end, triangles and clusters behind those of the foreground, which is the last occluder
        added["triangle"] = added["triangle"] + vertices
        added["triangle_body"][:] = self.occluder_count - 1
        added["neighbour"] = np.where(added["neighbour"] >= 0, added["neighbour"] + triangle, -1)
        added["cluster_layer"][:] = self.foreground_layer
        added["cluster_first"] = added["cluster_first"] + triangle
        added["cluster_vertices"] = added["cluster_vertices"] + np.array([vertices, 0], np.int32)
        known["neighbour"] = np.where(known["neighbour"] >= triangle, known["neighbour"] + more, known["neighbour"])
        known["cluster_first"] = known["cluster_first"] + np.where(np.arange(self.cluster_count) >= cluster, more, 0)
        at = {**dict.fromkeys((*_OF_TRIANGLES, "source_triangle"), triangle), **dict.fromkeys(_OF_CLUSTERS, cluster)}
        at |= dict.fromkeys(("vertex_world_m", "vertex_rgb", "source_vertex"), vertices)
        for name, place in at.items():
            dtype = known[name].dtype
            known[name] = np.concatenate([known[name][:place], added[name], known[name][place:]]).astype(dtype)
        bounds_m = known["layer_bounds_world_m"] = known["layer_bounds_world_m"].copy()
        low_m, high_m = mesh.bounds_m()
        own_m = bounds_m[self.foreground_layer]
        bounds_m[self.foreground_layer] = np.minimum(own_m[0], low_m), np.maximum(own_m[1], high_m)
        return Scene.of_arrays(known, device=self.device)

    def _without(self, pane: Pane) -> Scene:
        """The scene whose clusters end where triangles are gone; but for those and neighbours the arrays are shared."""
        host = {name: getattr(self.triangles, name).numpy() for name in (*_OF_CLUSTERS, "triangle", "triangle_body")}
        body = self.occluder_count - 1  # the foreground is the last occluder
        own = np.flatnonzero(host["triangle_body"] == body)
        gone = own[pane.is_clear(self.triangles.vertex_world_m.numpy()[host["triangle"][own]])]
        cluster = np.repeat(np.arange(self.cluster_count), host["cluster_count"])
        index = np.flatnonzero(self._is_drawn)
        cluster, index = cluster[~np.isin(index, gone)], np.setdiff1d(index, gone)
        is_first = np.append(True, (np.diff(index) > 1) | (np.diff(cluster) > 0))[: len(index)]
        arrays = {name: host[name][cluster[is_first]] for name in _OF_CLUSTERS}
        arrays["cluster_first"] = index[is_first].astype(np.int32)
        arrays["cluster_count"] = np.diff(np.append(np.flatnonzero(is_first), len(index))).astype(np.int32)
        neighbour = arrays["neighbour"] = self.triangles.neighbour.numpy().copy()
        neighbour[np.isin(neighbour, gone)] = -1
        if len(gone):  # a hole lets see the backs of what hangs together with it
            is_own = host["triangle_body"][arrays["cluster_first"]] == body
            arrays["cluster_closed_world_m"][is_own] = (-np.inf, -np.inf, -np.inf), (np.inf, np.inf, np.inf)
        scene = Scene.__new__(Scene)
        scene.__dict__.update({name: value for name, value in vars(self).items() if name not in _CACHED})
        scene.triangles = Triangles()
        for name in Triangles.vars:
            array = getattr(self.triangles, name)
            if name in arrays:
                array = wp.array(arrays[name], dtype=_TYPES[name], device=self.device)  # pyright: ignore[reportArgumentType]
            setattr(scene.triangles, name, array)
        scene.cluster_count = len(arrays["cluster_first"])
        scene.occluder_cluster_count = int(np.searchsorted(arrays["cluster_first"], self._occluder_triangle_count))
        return scene

    @property
    def _solid(self) -> np.ndarray:
        """Triangles for ray queries: those that are not drawn are points, int32 [triangle, 3]."""
        return np.where(self._is_drawn[:, None], self.triangles.triangle.numpy(), 0)

    @property
    def _is_drawn(self) -> np.ndarray:
        """Which triangles are in a cluster: all but those of a pane that is looked through, bool [triangle]."""
        first, count = self.triangles.cluster_first.numpy(), self.triangles.cluster_count.numpy()
        ends = np.zeros(self.triangle_count + 1, np.int64)
        np.add.at(ends, first, 1)
        np.add.at(ends, first + count, -1)
        return np.cumsum(ends)[:-1] > 0

    @cached_property
    def mesh(self) -> wp.Mesh:
        """The triangles for ray queries, in their order, grouped by body; built when it is first asked for."""
        return wp.Mesh(
            self.triangles.vertex_world_m,
            wp.array(self._solid.ravel(), dtype=wp.int32, device=self.device),
            groups=self.triangles.triangle_body,
        )

    @cached_property
    def occluder_mesh(self) -> wp.Mesh:
        """The occluders' triangles, which come first, for ray queries; of at least one occluder."""
        triangle = self._solid[: self._occluder_triangle_count]
        return wp.Mesh(self.triangles.vertex_world_m, wp.array(triangle.ravel(), dtype=wp.int32, device=self.device))


def _device(device: str | wp.Device | None) -> wp.Device:
    try:
        return wp.get_device(device)
    except Exception as error:
        raise InputError(
            f"device: expected a Warp device such as 'cpu' or 'cuda:0', got {device!r} ({error})"
        ) from None


def _background(background_rgb: object) -> tuple[wp.vec3, wp.vec3]:
    colour = np.asarray(background_rgb)
    if colour.shape not in ((3,), (2, 3)) or not np.issubdtype(colour.dtype, np.number):
        raise InputError(f"background_rgb: expected one colour [3] or two [2, 3], got {background_rgb!r}")
    if not ((colour >= 0) & (colour <= 255)).all():
        raise InputError(f"background_rgb: expected colours 0..255, got {colour.tolist()}")
    horizon, zenith = np.broadcast_to(colour, (2, 3)) / 255.0
    return wp.vec3(*horizon), wp.vec3(*zenith)
