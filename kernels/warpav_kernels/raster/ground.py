"""The ground around a vehicle, and how far one sees, by ray queries."""

import warp as wp

wp.set_module_options({"enable_backward": False})

_MAX_SURFACES = wp.constant(64)  # one above the other
_STEP_M = wp.constant(1.0e-3)  # from a surface to beyond it
_ABOVE_GROUND_M = wp.constant(0.05)  # where looking up from the ground begins
_FARTHEST_M = wp.constant(1.0e4)


@wp.func
def _is_seen_from_inside(normal: wp.vec3, direction: wp.vec3) -> bool:
    """Whether a ray comes upon a surface from behind."""
    return wp.dot(normal, direction) > 0.0


@wp.kernel(enable_backward=False)
def ground_kernel(
    # in
    mesh: wp.uint64,
    environment: int,
    place_m: wp.array[wp.vec2],
    lowest_m: float,
    highest_m: wp.array[float],
    step_m: float,
    # out
    ground_m: wp.array[float],
    headroom_m: wp.array[float],
):
    """Height of the ground at places, and how much air there is above it.

    The ground is the lowest surface of the environment (the group ``environment`` of the mesh) that looks upwards
    between ``lowest_m`` and ``highest_m``, or what lies on it by steps of at most ``step_m``, such as a pavement. Its
    headroom is the way up to the next surface of any object: infinite under the sky, 0 inside of a closed object such
    as a house.

    Launch: ``dim=place_count``. Not taped.
    Writes: every element of ``ground_m`` (NaN where there is none) and of ``headroom_m`` (0 there).
    """
    p = wp.tid()
    up = wp.vec3(0.0, 0.0, 1.0)
    place = place_m[p]
    top_m = float(highest_m[p])
    root = wp.mesh_get_group_root(mesh, environment)
    found_m = float(wp.nan)
    z_m = lowest_m
    for _ in range(_MAX_SURFACES):
        query = wp.mesh_query_ray(mesh, wp.vec3(place[0], place[1], z_m), up, _FARTHEST_M, root)
        if not query.result:
            break
        z_m += query.t
        if z_m > top_m:
            break
        if _is_seen_from_inside(query.normal, up):
            found_m = z_m
            top_m = wp.min(top_m, z_m + step_m)
        z_m += _STEP_M
    room_m = float(0.0)
    if wp.isfinite(found_m):
        above = wp.mesh_query_ray(mesh, wp.vec3(place[0], place[1], found_m + _ABOVE_GROUND_M), up, _FARTHEST_M)
        if not above.result:
            room_m = wp.inf
        elif not _is_seen_from_inside(above.normal, up):
            room_m = above.t + _ABOVE_GROUND_M
    ground_m[p] = found_m
    headroom_m[p] = room_m


@wp.kernel(enable_backward=False)
def free_share_kernel(
    # in
    mesh: wp.uint64,
    start_m: wp.vec3,
    end_m: wp.array[wp.vec3],
    near_m: float,
    first: int,
    # out
    share: wp.array[float],
):
    """How far one sees from a point towards others before something stands in the way, as a share of the whole way.

    What is nearer than ``near_m`` does not count.

    Launch: ``dim=points of this chunk``. Not taped.
    Writes: ``share`` from ``first`` on; 1 where nothing stands in the way.
    """
    p = first + wp.tid()
    way = end_m[p] - start_m
    length_m = wp.length(way)
    free = float(1.0)
    if length_m > near_m:
        direction = way / length_m
        query = wp.mesh_query_ray(mesh, start_m + near_m * direction, direction, length_m - near_m)
        if query.result:
            free = (near_m + query.t) / length_m
    share[p] = free
