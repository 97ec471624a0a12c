"""The triangles of a scene, as all kernels take them, and on which side of them a camera is."""

import warp as wp

from warpav_kernels.raster._lens import BROWN_CONRADY, PINHOLE
from warpav_kernels.raster._view import View

wp.set_module_options({"enable_backward": False})

# How far behind a plane a camera surely sees the triangle's back [m], and how much more at large coordinates.
_BEHIND_M = wp.constant(1.0e-4)
_BEHIND_SHARE = wp.constant(1.0e-6)


@wp.struct
class Triangles:
    """The scene's triangles, sorted by body and by place, in clusters of one body each.

    A body is one mesh of the scene: the occluders in order, then the objects in order.
    """

    vertex_world_m: wp.array[wp.vec3]  # vertex positions in the world frame [m], [vertex]
    triangle: wp.array[wp.vec3i]  # vertex indices, [triangle]
    triangle_body: wp.array[wp.int32]  # body of every triangle, [triangle]
    # Plane of every triangle: unit normal, and its product with a point of the plane [m], [triangle]
    triangle_plane: wp.array[wp.vec4]
    # Triangles on the other sides of its three sides; -1 where there is none, or more than one, or one of the other
    # winding, [triangle]
    neighbour: wp.array[wp.vec3i]
    body_layer: wp.array[wp.int32]  # layer of every body; -1 where it has none, [body]
    cluster_first: wp.array[wp.int32]  # first triangle of each cluster, [cluster]
    cluster_count: wp.array[wp.int32]  # number of triangles of each cluster, [cluster]
    # First vertex of each cluster, and how many it has; no other cluster uses them, [cluster]
    cluster_vertices: wp.array[wp.vec2i]
    cluster_layer: wp.array[wp.int32]  # layer of each cluster's body; -1 where it has none, [cluster]
    cluster_sphere_world_m: wp.array[wp.vec4]  # bounding sphere, centre and radius [m], [cluster]
    # Lowest and highest corner of the closed surfaces that a cluster's triangles belong to [m]; infinite where one of
    # them is open, [cluster, 2]
    cluster_closed_world_m: wp.array2d[wp.vec3]


@wp.func
def faces(camera: View, plane: wp.vec4) -> bool:
    """Whether the camera is in front of a plane."""
    position_world_m = camera.position_world_m
    return plane[0] * position_world_m[0] + plane[1] * position_world_m[1] + plane[2] * position_world_m[2] > plane[3]


@wp.func
def may_be_outline(camera: View, scene: Triangles, is_facing: bool, neighbour: int) -> bool:
    """Whether an outline can run between a triangle and its neighbour: one faces the camera and the other does not."""
    if neighbour < 0:
        return True
    return faces(camera, scene.triangle_plane[neighbour]) != is_facing


@wp.func
def _near_reach_m(camera: View, frame: wp.vec4i) -> float:
    """How far from the camera its near cut is at most, inside a part of the grid [m]."""
    across = float(0.0)
    if camera.lens.kind == PINHOLE:
        x = wp.max(camera.centre[0] - float(frame[0]), float(frame[2]) - camera.centre[0]) / camera.focal[0]
        y = wp.max(camera.centre[1] - float(frame[1]), float(frame[3]) - camera.centre[1]) / camera.focal[1]
        across = wp.sqrt(x * x + y * y)
    elif camera.lens.kind == BROWN_CONRADY:
        across = camera.lens.limit
    return camera.near_m * wp.sqrt(1.0 + across * across)


@wp.func
def shows_no_back(camera: View, scene: Triangles, cluster: int, frame: wp.vec4i) -> bool:
    """Whether fronts hide all backs of a cluster's triangles, as they belong to closed surfaces seen from outside.

    Along a ray from outside of a closed surface there are as many fronts as backs, and neither the camera's centre nor
    its near cut is inside.
    """
    low = scene.cluster_closed_world_m[cluster, 0]
    high = scene.cluster_closed_world_m[cluster, 1]
    away = wp.max(low - camera.position_world_m, wp.max(camera.position_world_m - high, wp.vec3(0.0, 0.0, 0.0)))
    return wp.length(away) > _near_reach_m(camera, frame)


@wp.func
def behind_m(camera: View) -> float:
    """How far behind a triangle's plane a camera surely sees its back [m]."""
    return _BEHIND_M + _BEHIND_SHARE * wp.length(camera.position_world_m)


@wp.func
def is_behind(camera: View, plane: wp.vec4) -> bool:
    """Whether the camera surely sees the back of a triangle, by its plane."""
    position_world_m = camera.position_world_m
    height_m = (
        plane[0] * position_world_m[0] + plane[1] * position_world_m[1] + plane[2] * position_world_m[2] - plane[3]
    )
    return height_m < -behind_m(camera)
