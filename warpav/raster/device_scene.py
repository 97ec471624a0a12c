"""A scene packed on a device: triangles sorted into clusters, vehicles as layers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from warpav.core.warp_setup import load_warp
from warpav.raster.mesh import merge
from warpav.scene.scene import ROAD_USERS, Scene, Sky
from warpav_kernels.raster.rasterise import Triangles

CLUSTER_SIZE = 64

# Object indices of a scene; vehicle k is FIRST_VEHICLE + k.
ENVIRONMENT = 0
EGO = 1
FIRST_VEHICLE = 2


def spread_bits(value: np.ndarray) -> np.ndarray:
    """Every bit of a 10-bit number moved to three times its place, for Morton codes; uint64, same shape."""
    value = value.astype(np.uint64)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        value = (value | (value << np.uint64(shift))) & np.uint64(mask)
    return value


def morton_order(centre_m: np.ndarray, object_index: np.ndarray) -> np.ndarray:
    """Order that sorts triangles by object and, within an object, along a Morton curve; int64 [triangle]."""
    low, high = centre_m.min(axis=0), centre_m.max(axis=0)
    cell = ((centre_m - low) / np.maximum(high - low, 1e-9) * 1023.0).astype(np.uint64)
    code = (
        spread_bits(cell[:, 0]) | (spread_bits(cell[:, 1]) << np.uint64(1)) | (spread_bits(cell[:, 2]) << np.uint64(2))
    )
    return np.lexsort((code, object_index))


def planes(corner_m: np.ndarray) -> np.ndarray:
    """Unit normals and their products with a point of the plane [m], float32 [triangle, 4].

    ``corner_m`` is [triangle, corner, axis].
    """
    corner_m = corner_m.astype(np.float64)
    normal = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    return np.c_[normal, np.einsum("ij,ij->i", normal, corner_m[:, 0])].astype(np.float32)


def neighbours(vertex_m: np.ndarray, triangle: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Triangles across the sides (0, 1), (1, 2) and (2, 0) of the wanted ones, int32 [triangle, 3].

    -1 where a triangle is not wanted, and where a side has no neighbour, several, or one of the other winding.
    Vertices at one place count as one.
    """
    result = np.full((len(triangle), 3), -1, np.int32)
    row = np.flatnonzero(wanted)
    if len(row) == 0:
        return result
    coordinates = np.ascontiguousarray(vertex_m, np.float32) + np.float32(0.0)  # no negative zeros
    _, place = np.unique(coordinates.view(np.dtype((np.void, 12))).ravel(), return_inverse=True)
    start = place[triangle[row]].astype(np.int64)
    end = np.roll(start, -1, axis=1)
    side = (np.minimum(start, end) * len(vertex_m) + np.maximum(start, end)).ravel()
    order = np.argsort(side, kind="stable")
    first = np.flatnonzero(np.diff(side[order], prepend=-1))
    first = first[np.diff(first, append=len(side)) == 2]
    a, b = order[first], order[first + 1]
    is_one_winding = start.ravel()[a] == end.ravel()[b]
    a, b = a[is_one_winding], b[is_one_winding]
    result[row[a // 3], a % 3] = row[b // 3]
    result[row[b // 3], b % 3] = row[a // 3]
    return result


@dataclass(frozen=True)
class UprightBoxes:
    """Boxes with a vertical axis, one for every layer of a scene, on its device.

    Attributes:
        centre_ego_m: Middles [m], vec3 [layer].
        half_size_m: Half of length, width and height [m], vec3 [layer].
        along: Unit vectors along the length in ego x and y, vec2 [layer].
    """

    centre_ego_m: wp.array
    half_size_m: wp.array
    along: wp.array


@dataclass(frozen=True)
class DeviceScene:
    """A scene on a device, ready for `Renderer`.

    Layers are the scene's vehicles in order, then the ego vehicle. Road users among its others are part of the
    environment.

    Attributes:
        name: The scene's name.
        triangles: Sorted triangles and their clusters (struct of the kernels).
        layer_object: Object of every layer, int32 [layer].
        layer_bounds_ego_m: Lowest and highest corner of every layer's object [m], vec3 [layer, 2].
        vertex_rgb: Vertex colours 0..1, vec3 [vertex].
        sky: The background.
        vehicle_count: Number of vehicles, at least 0.
        cluster_count: Number of clusters.
        triangle_count: Number of triangles.
        source_triangle: Place of every sorted triangle in environment, others, ego, vehicles, one behind the other,
            [triangle].
        category: What every vehicle is, [vehicle].
        road_user_index: The kind of every vehicle, index into `ROAD_USERS`, int32 [vehicle].
        from_ego_m: Middle of every vehicle's box as seen from the middle of the ego vehicle: forward and left [m],
            float64 [vehicle, 2].
    """

    name: str
    triangles: Any  # the struct Triangles, which is no type to a checker
    layer_object: wp.array
    layer_bounds_ego_m: wp.array
    vertex_rgb: wp.array
    sky: Sky
    vehicle_count: int
    cluster_count: int
    triangle_count: int
    source_triangle: np.ndarray
    category: tuple[str, ...]
    road_user_index: np.ndarray
    from_ego_m: np.ndarray

    @property
    def ego_layer(self) -> int:
        """Layer of the ego vehicle."""
        return self.vehicle_count

    @property
    def layer_count(self) -> int:
        """Number of layers: the vehicles and the ego vehicle."""
        return self.vehicle_count + 1

    @cached_property
    def mesh(self) -> wp.Mesh:
        """The triangles for ray queries, in their order, grouped by object; built when it is first asked for."""
        return wp.Mesh(
            self.triangles.vertex_ego_m,
            wp.array(self.triangles.triangle.numpy().ravel(), dtype=wp.int32, device=self.layer_object.device),
            groups=self.triangles.triangle_object,
        )

    @cached_property
    def upright_box(self) -> UprightBoxes:
        """The least upright box around every layer's object; found when it is first asked for."""
        import cv2

        vertex_ego_m = self.triangles.vertex_ego_m.numpy()
        triangle, object_index = self.triangles.triangle.numpy(), self.triangles.triangle_object.numpy()
        centre, half_size, along = [], [], []
        for index in self.layer_object.numpy():
            point_m = vertex_ego_m[np.unique(triangle[object_index == index])]
            middle_xy, (length, width), turn_deg = cv2.minAreaRect(np.ascontiguousarray(point_m[:, :2]))
            low_m, high_m = point_m[:, 2].min(), point_m[:, 2].max()
            centre.append([*middle_xy, 0.5 * (low_m + high_m)])
            half_size.append([0.5 * length, 0.5 * width, 0.5 * (high_m - low_m)])
            along.append([np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))])
        device = self.layer_object.device
        return UprightBoxes(
            wp.array(np.reshape(centre, (-1, 3)), dtype=wp.vec3, device=device),
            wp.array(np.reshape(half_size, (-1, 3)), dtype=wp.vec3, device=device),
            wp.array(np.reshape(along, (-1, 2)), dtype=wp.vec2, device=device),
        )

    @classmethod
    def pack(cls, scene: Scene, *, device: str = "cpu") -> DeviceScene:
        """The scene on ``device``. Triangles are sorted; vertices keep their order.

        Raises:
            ValueError: A mesh cannot be drawn (see `Mesh.check`), or there are too many vertices or triangles.
        """
        load_warp()
        for other in scene.others:
            other.mesh.check(f"{scene.name}: {other.category} {other.instance_id}")
        meshes = [scene.surroundings(), scene.ego, *(vehicle.mesh for vehicle in scene.vehicles)]
        names = ["environment", "ego", *(f"vehicle {vehicle.instance_id}" for vehicle in scene.vehicles)]
        for name, mesh in zip(names, meshes, strict=True):
            mesh.check(f"{scene.name}: {name}")
        whole = merge(meshes)
        object_index = np.repeat(np.arange(len(meshes)), [len(mesh.triangle) for mesh in meshes])
        order = morton_order(whole.vertex_m[whole.triangle].mean(axis=1), object_index)
        triangle, object_index = whole.triangle[order], object_index[order].astype(np.int32)

        # cut every object's run of triangles into clusters
        run_first = np.searchsorted(object_index, np.arange(len(meshes)))
        run_end = np.searchsorted(object_index, np.arange(len(meshes)), side="right")
        first = np.concatenate([np.arange(a, b, CLUSTER_SIZE) for a, b in zip(run_first, run_end, strict=True)])
        count = np.diff(np.append(first, len(triangle)))
        corner_m = whole.vertex_m[triangle].reshape(-1, 3)
        low = np.minimum.reduceat(corner_m, 3 * first, axis=0)
        high = np.maximum.reduceat(corner_m, 3 * first, axis=0)
        centre = 0.5 * (low + high)
        reach = np.linalg.norm(corner_m - np.repeat(centre, 3 * count, axis=0), axis=1)
        radius = np.maximum.reduceat(reach, 3 * first) * (1.0 + 1e-5)

        layer_object = np.array([*range(FIRST_VEHICLE, len(meshes)), EGO], np.int32)
        layer_of_object = np.full(len(meshes), -1, np.int32)
        layer_of_object[layer_object] = np.arange(len(layer_object))

        triangles = Triangles()
        triangles.vertex_ego_m = wp.array(whole.vertex_m, dtype=wp.vec3, device=device)
        triangles.triangle = wp.array(triangle, dtype=wp.vec3i, device=device)
        triangles.triangle_object = wp.array(object_index, dtype=wp.int32, device=device)
        triangles.triangle_plane = wp.array(planes(corner_m.reshape(-1, 3, 3)), dtype=wp.vec4, device=device)
        triangles.neighbour = wp.array(
            neighbours(whole.vertex_m, triangle, layer_of_object[object_index] >= 0), dtype=wp.vec3i, device=device
        )
        triangles.object_layer = wp.array(layer_of_object, dtype=wp.int32, device=device)
        triangles.cluster_first = wp.array(first.astype(np.int32), dtype=wp.int32, device=device)
        triangles.cluster_count = wp.array(count.astype(np.int32), dtype=wp.int32, device=device)
        triangles.cluster_layer = wp.array(layer_of_object[object_index[first]], dtype=wp.int32, device=device)
        triangles.cluster_sphere_ego_m = wp.array(
            np.c_[centre, radius].astype(np.float32), dtype=wp.vec4, device=device
        )
        return cls(
            name=scene.name,
            triangles=triangles,
            layer_object=wp.array(layer_object, dtype=wp.int32, device=device),
            layer_bounds_ego_m=wp.array(
                np.stack([meshes[i].bounds_m() for i in layer_object]), dtype=wp.vec3, device=device
            ),
            vertex_rgb=wp.array(whole.vertex_rgb.astype(np.float32) / 255.0, dtype=wp.vec3, device=device),
            sky=scene.sky,
            vehicle_count=len(scene.vehicles),
            cluster_count=len(first),
            triangle_count=len(triangle),
            source_triangle=order,
            category=tuple(vehicle.category for vehicle in scene.vehicles),
            road_user_index=np.array([ROAD_USERS.index(user.road_user) for user in scene.vehicles], np.int32),
            from_ego_m=np.array([vehicle.box.center_m[:2] for vehicle in scene.vehicles]).reshape(-1, 2)
            - scene.ego.bounds_m()[:, :2].mean(axis=0),
        )
