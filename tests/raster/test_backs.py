"""Backs that fronts hide are left out: nothing of a render changes but its time."""

import math

import numpy as np
import pytest
import trimesh

from tests.driving_scene import camera_pose, on_device
from tests.raster.bodies import body, cuboid
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh, merge
from warpav.raster.renderer import Renderer
from warpav.raster.scene import Scene

SIZE = 96
LENSES = {
    "pinhole": CameraModel(SIZE, SIZE, math.radians(90.0), near_m=0.1),
    "fisheye": CameraModel(SIZE, SIZE, math.radians(190.0), lens="fisheye", near_m=0.1),
    "brown_conrady": CameraModel(
        SIZE, SIZE, math.radians(100.0), lens="brown_conrady", distortion=(-0.21, 0.06, 0.0, 0.0, -0.008), near_m=0.1
    ),
}


def turned_inside_out(mesh):
    """The same triangles, facing the other way."""
    return Mesh(mesh.vertex_m, mesh.triangle[:, ::-1].copy(), mesh.vertex_rgb)


def without(mesh, count):
    """The mesh without its last triangles."""
    return Mesh(mesh.vertex_m, mesh.triangle[:-count], mesh.vertex_rgb)


RING = body(trimesh.creation.torus(2.0, 0.7, major_sections=24, minor_sections=12))
BODIES = {
    "box": cuboid((2.0, 3.0, 1.5), (0.0, 0.0, 0.0), (0.3, 0.2, 0.1)),
    "ring": RING,
    "inside out": turned_inside_out(RING),
    "open": without(RING, 40),
    "shells that overlap": merge([RING, cuboid((2.0, 3.0, 1.5), (1.0, 0.0, 0.2))]),
    "hollow": merge([cuboid((4.0, 4.0, 4.0), (0.0, 0.0, 0.0)), turned_inside_out(cuboid((3.0, 3.0, 3.0), (0, 0, 0)))]),
}


def images(scene, poses, model, device):
    """Depths, ids, and amodal and visible areas with their Jacobians of all views."""
    frame = Renderer([model] * len(poses), device=device).render(scene, *on_device(poses, device))
    measures = frame.measure()
    arrays = (frame.depth_m, frame.object_id, measures.value, measures.jac_translation, measures.jac_rotation)
    return [array.numpy() for array in arrays]


def with_backs(scene):
    """Let a scene draw all backs, as if every surface were open."""
    bounds = scene.triangles.cluster_closed_world_m.numpy()
    bounds[:, 0], bounds[:, 1] = -np.inf, np.inf
    scene.triangles.cluster_closed_world_m.assign(bounds)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("name", BODIES)
def test_nothing_changes(device, name, lens):
    """From outside, from inside, and where the near cut passes through the surface."""
    rng = np.random.default_rng(5)
    poses = [
        camera_pose(rng.uniform((-4.0, -4.0, -2.0), (4.0, 4.0, 2.0)), *rng.uniform((-3.0, -1.0), (3.0, 1.0)))
        for _ in range(48)
    ]
    occluder = cuboid((1.0, 1.0, 1.0), (2.5, 2.5, 0.0))
    scene = Scene({"body": BODIES[name]}, [occluder], device=device)
    left_out = images(scene, poses, LENSES[lens], device)
    with_backs(scene)
    drawn = images(scene, poses, LENSES[lens], device)
    for one, other in zip(left_out[:2], drawn[:2], strict=True):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(left_out[2:], drawn[2:], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4 * np.abs(other).max())
