"""A small workload with everything that the reference workload has not: other lenses, heights and near planes, forty
vehicles, three objects that only occlude, triangles through the cameras, and an image of 96 pixels."""

import numpy as np
import trimesh

SIZE = 96
VEHICLES = 40


def _box(rng, size, centre, yaw=0.0, subdivide=1):
    mesh = trimesh.creation.box(extents=size)
    for _ in range(subdivide):
        mesh = mesh.subdivide()
    c, s = np.cos(yaw), np.sin(yaw)
    vertex = np.asarray(mesh.vertices) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T + centre
    return vertex, np.asarray(mesh.faces), rng.uniform(0, 1, vertex.shape)


def _ground(rng):
    """Two triangles of 80 m that no near plane leaves whole."""
    vertex = np.array([[-40.0, 0, -40], [40, 0, -40], [40, 0, 40], [-40, 0, 40]])
    return vertex, np.array([[0, 2, 1], [0, 3, 2]]), rng.uniform(0, 1, (4, 3))


def small_workload(*, visible=1, vehicle_count=VEHICLES):
    """The arrays of the file."""
    rng = np.random.default_rng(11)
    objects = []
    for k in range(vehicle_count):
        bearing, distance = 2 * np.pi * k / max(vehicle_count, 1), rng.uniform(5, 14)
        size = rng.uniform([1.4, 1.0, 1.4], [2.0, 1.9, 3.0])
        centre = np.array([distance * np.sin(bearing), 0.1 + 0.5 * size[1], distance * np.cos(bearing)])
        objects.append(_box(rng, size, centre, rng.uniform(-np.pi, np.pi)))
    objects.append(_ground(rng))
    objects += [_box(rng, [1.5, 2.5, 0.3], [3.0, 1.2, 4.0]), _box(rng, [0.3, 4.0, 9.0], [-4.0, 2.0, 1.0], subdivide=0)]
    count = [len(faces) for _, faces, _ in objects]
    end = np.cumsum([len(vertex) for vertex, _, _ in objects])
    faces = [faces + at for (_, faces, _), at in zip(objects, np.r_[0, end[:-1]], strict=True)]
    return {
        "verts": np.concatenate([vertex for vertex, _, _ in objects]).astype(np.float32),
        "faces": np.concatenate(faces).astype(np.int32),
        "colors": np.concatenate([colour for _, _, colour in objects]).astype(np.float32),
        "face_counts": np.array(count),
        "vert_ends": end,
        "n_targets": np.int64(vehicle_count),
        "target_w": rng.uniform(-0.5, 1.5, vehicle_count),
        "cams": np.array([[0.0, 0.5, 0.2], [-0.6, -0.4, 1.3], [0.7, 0.1, -2.0]]),
        "cam_y": np.array([1.5, 1.9, 2.3]),
        "fov_deg": np.array([90.0, 120.0, 55.0]),
        "near": np.array([0.1, 0.8, 0.05]),
        "res": np.int64(SIZE),
        "visible": np.int64(visible),
        "w_white": rng.uniform(0, 1, (SIZE, SIZE)).astype(np.float32),
        "w_smooth": np.add.outer(np.linspace(0, 0.5, SIZE), np.sin(np.linspace(0, 3, SIZE)) / 2).astype(np.float32),
        "poses20": np.c_[rng.uniform(-0.8, 0.8, (20, 2)), rng.uniform(-np.pi, np.pi, 20)],
        "seed": np.int64(11),
        "scale": np.float64(1.0),
        "format": np.int64(1),
    }


def small_truth(arrays):
    """Arrays of a truth file for it; the numbers mean nothing."""
    rng = np.random.default_rng(5)
    image = (2, SIZE, SIZE)
    return {
        "poses": arrays["poses20"],
        "weights": np.array(["white", "smooth", "ones"]),
        "grad": rng.normal(size=(20, 3, 3)),
        "grad_check": rng.normal(size=(20, 3, 3)),
        "value": rng.normal(size=(20, 3)),
        "id_views": np.array([1, 7]),
        "ids": rng.integers(-1, 3, image).astype(np.int8),
        "depth": rng.uniform(1, 5, image).astype(np.float32),
    }
