"""A scene from a capture: point clouds, surfaces through them, colours from the images, few triangles.

The order is that of the thesis's figure 5, from its step 5 on.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from warpav.core.cores import available_cores
from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh, merge
from warpav.scene._scene import BLACK_SKY, Scene, Sky, Vehicle, triangle_caster
from warpav.scene.capture._capture import EGO_INSTANCE, ENVIRONMENT_INSTANCE, Capture, CapturedImage
from warpav.scene.reconstruction._point_cloud import ObjectCloud, PointCloud, fuse, seen_rgb
from warpav.scene.reconstruction._settings import MeshSettings, ReconstructionSettings
from warpav.scene.reconstruction._surface import (
    SURFACE_METHODS,
    cleaned,
    decimated,
    oriented_normals,
    thin_out,
    trimmed,
    vertex_normals,
)

_MIN_POINTS = 200  # a vehicle of fewer points is no vehicle
_MOST_RAYS = 40_000  # of more rays to where an object has surface without points, a part is enough
_BELOW_SPACING_M = 0.25  # of the ground points below a vehicle
_SKY_STEP = 7  # stride of the pixels that determine the sky's colour


@threadpool_limits.wrap(limits=1, user_api="blas")  # more threads of linear algebra would only wait for one another
def reconstruct(capture: Capture, settings: ReconstructionSettings | None = None) -> Scene:
    """The scene that a capture shows."""
    settings = settings or ReconstructionSettings()
    if settings.method not in SURFACE_METHODS:
        raise ValueError(f"expected one of {', '.join(SURFACE_METHODS)}, got {settings.method!r}")
    images: list[CapturedImage] = list(capture.images)
    threads = min(settings.thread_count, available_cores())
    clouds = fuse(capture, images, settings.cloud, thread_count=threads)
    for vehicle, one in zip(capture.vehicles, clouds.vehicles, strict=True):
        if len(one.cloud) < _MIN_POINTS:
            raise InputError(
                f"{capture.name}: vehicle {vehicle.instance_id}: expected at least {_MIN_POINTS} points in its 3D "
                f"box, got {len(one.cloud)}; record it from nearer or remove it"
            )
    if len(clouds.environment.point_m) < _MIN_POINTS or len(clouds.ego.cloud) < _MIN_POINTS:
        raise InputError(f"{capture.name}: expected images of the environment and of the ego vehicle, got none of one")
    # from the centres of vehicles down to the ground below them
    origin = []
    for box in [capture.ego_box, *(vehicle.box for vehicle in capture.vehicles)]:
        count = np.ceil(np.asarray(box.size_m[:2]) / _BELOW_SPACING_M).astype(int) + 1
        share = [np.linspace(-0.5, 0.5, n) for n in count]
        x, y = (axis.ravel() for axis in np.meshgrid(*share))
        local_m = np.stack([x, y, np.zeros(len(x))], axis=1) * box.size_m
        origin.append(box.center_m + local_m @ box.ego_from_box.T)
    origin_m = np.concatenate(origin)
    below = (origin_m, np.broadcast_to(np.array([0.0, 0.0, -1.0]), origin_m.shape))
    jobs: list[tuple[str, ObjectCloud, int, MeshSettings]] = [
        ("environment", ObjectCloud(clouds.environment, *below), ENVIRONMENT_INSTANCE, settings.environment),
        ("ego", clouds.ego, EGO_INSTANCE, settings.ego),
    ]
    for vehicle, one in zip(capture.vehicles, clouds.vehicles, strict=True):
        jobs.append((f"vehicle {vehicle.instance_id}", one, vehicle.instance_id, settings.vehicle))

    def work(job: tuple[str, ObjectCloud, int, MeshSettings]) -> Mesh:
        name, one, instance_id, how = job
        mesh = object_mesh(one, images, instance_id, how, settings)
        if len(mesh.triangle) == 0:
            raise InputError(f"{capture.name}: {name}: expected a surface through its points, got none")
        return mesh

    with ThreadPoolExecutor(threads) as pool:
        environment, ego, *meshes = pool.map(work, jobs)
    sphere = _sphere_mesh(clouds.sphere, settings)
    return Scene(
        capture.name,
        environment if sphere is None else merge([environment, sphere]),
        ego,
        tuple(
            Vehicle(vehicle.instance_id, vehicle.category, mesh, vehicle.box, vehicle.velocity_ego_m_s)
            for vehicle, mesh in zip(capture.vehicles, meshes, strict=True)
        ),
        _sky(images, settings.cloud.far_depth_m),
        f"{capture.source}, captured".removeprefix(", "),
    )


def object_mesh(
    one: ObjectCloud,
    images: Sequence[CapturedImage],
    instance_id: int,
    how: MeshSettings,
    settings: ReconstructionSettings,
) -> Mesh:
    """The surface of one object: no triangles where none goes through its points."""
    chosen = one.cloud.chosen(thin_out(one.cloud.point_m, how.point_count, seed=settings.seed))
    normal = oriented_normals(chosen.point_m, chosen.sensor_m)
    vertex_m, triangle = SURFACE_METHODS[settings.method](
        chosen.point_m.astype(np.float64), normal, chosen.sensor_m.astype(np.float64), how.cell_m
    )
    support_m = np.concatenate([chosen.point_m, _unseen_points(vertex_m, triangle, one)])
    vertex_m, triangle = trimmed(vertex_m, triangle, support_m, reach_m=how.reach_m, piece_m2=how.piece_m2)
    if len(triangle) == 0:
        return Mesh(vertex_m, triangle, np.zeros((len(vertex_m), 3), np.uint8))
    rgb = seen_rgb(vertex_m, vertex_normals(vertex_m, triangle), images, instance_id, tolerance_m=how.cell_m)
    return decimated(cleaned(Mesh(vertex_m, triangle, rgb)), how.triangle_count)


def _unseen_points(vertex_m: np.ndarray, triangle: np.ndarray, one: ObjectCloud) -> np.ndarray:
    """Where the rays to surface without points meet it first [m]."""
    if len(one.ray_origin_m) == 0 or len(triangle) == 0:
        return np.zeros((0, 3), np.float32)
    caster = triangle_caster(vertex_m[triangle])
    step = -(-len(one.ray_origin_m) // _MOST_RAYS)
    origin = np.ascontiguousarray(one.ray_origin_m[::step], np.float32)
    direction = np.ascontiguousarray(one.ray_direction[::step], np.float32)
    hit = caster.run(origin, direction, output=True)
    seen = hit["primID"] >= 0
    return origin[seen] + hit["tfar"][seen, None] * direction[seen]


def _sphere_mesh(cloud: PointCloud, settings: ReconstructionSettings) -> Mesh | None:
    """The sphere of what lies beyond the radius, seen from inside: a grid of directions, where it has points."""
    if len(cloud) == 0:
        return None
    step = np.radians(settings.sphere_deg)
    around = int(np.ceil(2.0 * np.pi / step))
    azimuth = np.arctan2(cloud.point_m[:, 1], cloud.point_m[:, 0])
    elevation = np.arcsin(np.clip(cloud.point_m[:, 2] / settings.cloud.radius_m, -1.0, 1.0))
    low = int(np.floor(elevation.min() / step))
    rows = int(np.floor(elevation.max() / step)) - low + 1
    row = np.floor(elevation / step).astype(int) - low
    column = np.floor((azimuth / (2.0 * np.pi) % 1.0) * around).astype(int) % around
    node = row * around + column
    count = np.bincount(node, minlength=rows * around)
    total = np.stack([np.bincount(node, cloud.rgb[:, k], rows * around) for k in range(3)], axis=1)
    known = count > 0
    rgb = np.zeros((rows * around, 3))
    rgb[known] = total[known] / count[known, None]
    place = np.arange(rows * around)
    node_elevation = (place // around + low + 0.5) * step
    node_azimuth = (place % around + 0.5) * 2.0 * np.pi / around
    direction = np.stack(
        [
            np.cos(node_elevation) * np.cos(node_azimuth),
            np.cos(node_elevation) * np.sin(node_azimuth),
            np.sin(node_elevation),
        ],
        axis=1,
    )
    # a cell without points between others has the colour of the nearest
    distance, nearest = KDTree(direction[known]).query(direction, distance_upper_bound=2.5 * step)
    filled = np.isfinite(distance)
    rgb[filled] = rgb[known][np.asarray(nearest)[filled]]
    first = place[: (rows - 1) * around]
    right = first - first % around + (first + 1) % around
    quad = np.stack([first, right, right + around, first + around], axis=1)
    quad = quad[filled[quad].all(axis=1)]
    if len(quad) == 0:
        return None
    triangle = np.concatenate([quad[:, [0, 2, 1]], quad[:, [0, 3, 2]]]).astype(np.int32)
    vertex_m = (settings.cloud.radius_m * direction).astype(np.float32)
    used, index = np.unique(triangle, return_inverse=True)
    return Mesh(vertex_m[used], index.reshape(-1, 3).astype(np.int32), np.round(rgb[used]).astype(np.uint8))


def _sky(images: Sequence[CapturedImage], far_depth_m: float) -> Sky:
    """The gradient from horizon to zenith that comes nearest to the pixels that show nothing else."""
    shares, colours = [], []
    for image in images:
        row, column = np.nonzero(image.depth_m >= far_depth_m)
        row, column = row[::_SKY_STEP], column[::_SKY_STEP]
        ray = image.view.model.rays(np.stack([column + 0.5, row + 0.5], axis=-1)).reshape(-1, 3)
        up = (ray @ image.view.ego_from_camera[2, :3]) / np.linalg.norm(ray, axis=1)
        above = up > 0.0
        shares.append(Sky.zenith_share(up[above]))
        colours.append(image.rgb[row[above], column[above]])
    share, colour = np.concatenate(shares), np.concatenate(colours).astype(np.float64)
    if len(share) < 3:
        return BLACK_SKY
    found = np.linalg.lstsq(np.stack([1.0 - share, share], axis=1), colour, rcond=None)[0]
    horizon, zenith = np.clip(np.round(found), 0, 255).astype(np.uint8)
    return Sky(horizon, zenith)
