"""Scenes of a few bodies, what the renderer measures of them, and how far two Jacobians are apart."""

import math

import numpy as np
import trimesh
import warp as wp

from tests.driving_scene import camera_pose, on_device
from warpav.raster.mesh import Mesh
from warpav.raster.renderer import Renderer
from warpav.scene import Box, DeviceScene, Scene, Vehicle, object_index_of

FAR_AWAY = Mesh.create([[0, 0, -500], [1, 0, -500], [0, 1, -500]], [[0, 1, 2]], [0, 0, 0])
# 0.1 rad, and a tenth of the focal length, weigh as much as 1 m
WEIGHT = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1, 0.1])


def body(shape, place_m=(0.0, 0.0, 0.0)):
    """A trimesh at a place, as a Mesh."""
    return Mesh.create(np.asarray(shape.vertices) + place_m, shape.faces, [128, 128, 128])


def cuboid(size_m, place_m, turn=(0.0, 0.0, 0.0)):
    """A box of 12 triangles, turned by Euler angles [rad] about its middle."""
    shape = trimesh.creation.box(extents=size_m)
    shape.apply_transform(trimesh.transformations.euler_matrix(*turn))
    return body(shape, place_m)


def ball(radius_m, place_m, subdivisions=5):
    """A sphere of 20 * 4**subdivisions triangles of the same mean square radius."""
    return body(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius_m), place_m)


def edges_of(mesh):
    """Sides of the triangles, [side, 2]."""
    return mesh.triangle[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def scene_of(vehicles, environment=FAR_AWAY, ego=FAR_AWAY):
    """A scene whose vehicles are the given meshes."""
    box = Box(np.zeros(3), np.ones(3), 0.0)
    return Scene(
        "bodies", environment, ego, tuple(Vehicle(k + 1, "hatchback", mesh, box) for k, mesh in enumerate(vehicles))
    )


def rendered(scene, poses, models, device, *, supersampling=1, **settings):
    """The packed scene and its frame from every pose; one model for all, or one per pose."""
    models = models if isinstance(models, list) else [models] * len(poses)
    packed = DeviceScene.pack(scene, device=device).raster
    renderer = Renderer(models, supersampling=supersampling, device=device, **settings)
    return packed, renderer.render(packed, *on_device(poses, device))


def depth_and_index(frame):
    """Depths, and ids as the indices of a traffic scene, on the host."""
    return frame.depth_m.numpy(), object_index_of(frame.object_id.numpy())


def jacobian(measures):
    """Derivatives to ego x, y, z, spins, log focal length: [view, vehicle, measure, 7]."""
    jac_log_focal = measures.jac_log_focal.numpy()[..., None]
    return np.concatenate(
        [measures.jac_translation.numpy(), measures.jac_rotation.numpy(), jac_log_focal], axis=-1
    ).astype(float)


def measured(scene, poses, models, device, *, box_px=None, **settings):
    """All measures, [view, vehicle, measure], and their Jacobians."""
    _, frame = rendered(scene, poses, models, device, **settings)
    box = None if box_px is None else wp.array(np.asarray(box_px, np.float32), dtype=wp.vec4, device=device)
    measures = frame.measure(box)
    return measures.value.numpy(), jacobian(measures)


def weighed(scene, poses, models, device, weight_image, *, visible, **settings):
    """Weighted areas, [view, vehicle], and their Jacobians."""
    _, frame = rendered(scene, poses, models, device, **settings)
    weight = wp.array(np.asarray(weight_image, np.float32), dtype=float, device=device)
    measures = frame.weighted_area(weight, visible=visible)
    return measures.value.numpy()[..., 0], jacobian(measures)[..., 0, :]


def error(ours, truth, floor=0.0):
    """Length of the difference over the truth's length, or over ``floor`` where that is more; last axis 7."""
    difference = np.linalg.norm((ours - truth) * WEIGHT, axis=-1)
    return difference / np.maximum(np.linalg.norm(truth * WEIGHT, axis=-1), floor)


def poses_towards(rng, target_m, count, *, distance_m, aim_rad=0.2):
    """Poses at random bearings and distances that look at a target, but for ``aim_rad``, with pitch and roll."""
    poses = []
    for _ in range(count):
        bearing, distance = rng.uniform(-math.pi, math.pi), rng.uniform(*distance_m)
        place = np.add(target_m, distance * np.array([math.cos(bearing), math.sin(bearing), rng.uniform(-0.3, 0.3)]))
        x, y, z = np.subtract(target_m, place)
        turn = rng.uniform(-aim_rad, aim_rad, 2)
        pitch = -math.atan2(z, math.hypot(x, y)) + turn[1]
        poses.append(camera_pose(place, math.atan2(y, x) + turn[0], pitch, rng.uniform(-0.4, 0.4)))
    return np.array(poses)
