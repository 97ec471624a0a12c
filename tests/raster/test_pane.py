"""Scenes seen through a pane: the same as without its triangles, to the last bit, and as rays of another library."""

import math

import numpy as np
import pytest

from tests.driving_scene import camera_pose, ground, on_device, random_poses, street
from tests.raster.bodies import cuboid
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import merge
from warpav.raster.pane import Pane
from warpav.raster.renderer import Renderer
from warpav.raster.scene import Scene

FRONT = Pane(
    "windscreen", (1.0, 0.0, 0.0), ((2.2, -0.8, 1.0), (2.2, 0.8, 1.0), (2.2, 0.8, 1.5), (2.2, -0.8, 1.5)), (-0.02, 0.02)
)
"""Of the cabin in `street`."""


def scenes(device):
    """The street's meshes, and the same around an ego vehicle that has no pane."""
    whole = street()
    cars = {str(k): each.mesh for k, each in enumerate(whole.vehicles)}
    return [
        Scene(cars, [whole.environment], foreground=ego, device=device) for ego in (whole.ego, FRONT.opened(whole.ego))
    ]


def poses():
    inside = [camera_pose([x, y, 1.3], yaw, 0.1) for x, y, yaw in ((2.1, 0.0, 0.0), (2.15, 0.4, 0.5), (1.2, 0.0, -0.3))]
    return [*inside, *random_poses(np.random.default_rng(2), 5)]


def rendered(scene, device):
    renderer = Renderer([CameraModel(128, 96, math.radians(100.0), 0.01)] * len(poses()), device=device)
    frame = renderer.render(scene, *on_device(poses(), device))
    areas = frame.areas()
    return frame.object_id.numpy(), frame.depth_m.numpy(), areas.visible.numpy(), areas.jacobian.numpy()


def test_a_scene_through_a_pane_is_that_around_a_body_without_it(device):
    closed, opened = scenes(device)
    number, depth_m, area_px, jacobian = rendered(closed.through(FRONT), device)
    expected = rendered(opened, device)
    # triangles that share a sample's depth may win in another order
    np.testing.assert_array_equal(number, expected[0])
    np.testing.assert_allclose(depth_m, expected[1], rtol=1e-5)
    np.testing.assert_allclose(area_px, expected[2], atol=1e-3)
    np.testing.assert_allclose(jacobian, expected[3], rtol=1e-3, atol=1e-2)
    assert (area_px[0] > 0.0).any()


def test_a_scene_that_carries_a_body_is_that_around_both(device):
    whole = street()
    cars = {str(k): each.mesh for k, each in enumerate(whole.vehicles)}
    carried = merge([cuboid((0.3, 0.2, 0.2), (1.0, 0.4, 1.7)), cuboid((0.4, 0.4, 0.4), (2.8, -0.2, 1.2))])
    scene = Scene(cars, [whole.environment], foreground=whole.ego, device=device)
    expected = rendered(Scene(cars, [whole.environment], foreground=merge([whole.ego, carried]), device=device), device)
    number, depth_m, area_px, jacobian = rendered(scene.carrying(carried), device)
    np.testing.assert_array_equal(number, expected[0])
    np.testing.assert_allclose(depth_m, expected[1], rtol=1e-5)
    np.testing.assert_allclose(area_px, expected[2], atol=1e-3)
    np.testing.assert_allclose(jacobian, expected[3], rtol=1e-3, atol=1e-2)
    assert (number != rendered(scene, device)[0]).any()
    through = scene.through(FRONT).carrying(carried)
    np.testing.assert_array_equal(
        rendered(through, device)[0],
        rendered(
            Scene(cars, [whole.environment], foreground=merge([FRONT.opened(whole.ego), carried]), device=device),
            device,
        )[0],
    )


def test_what_cannot_be_carried():
    scene = Scene({"cube": cuboid((1, 1, 1), (0, 0, 0))})
    assert scene.carrying(None) is scene
    with pytest.raises(ValueError, match="expected a scene with a foreground, got none"):
        scene.carrying(cuboid((1, 1, 1), (0, 0, 0)))


def test_rays_of_another_library_see_the_same_bodies():
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    whole = street()
    model = CameraModel(64, 48, math.radians(100.0), 0.01)
    frame = Renderer([model]).render(scenes("cpu")[0].through(FRONT), *on_device(poses()[:1]))
    parts = [FRONT.opened(whole.ego), whole.environment, *(each.mesh for each in whole.vehicles)]
    number_of = [-3, -2, *range(len(whole.vehicles))]
    body, of_triangle = EmbreeScene(), []
    for mesh, number in zip(parts, number_of, strict=True):
        TriangleMesh(body, mesh.vertex_m[mesh.triangle])
        of_triangle.append(number)
    row, column = np.mgrid[:48, :64]
    pose = poses()[0]
    ray = model.rays(np.stack([column + 0.5, row + 0.5], axis=-1).reshape(-1, 2)) @ pose[:3, :3].T
    start = np.tile(pose[:3, 3].astype(np.float32), (len(ray), 1))
    hit = body.run(start, ray.astype(np.float32), output=True)["geomID"]
    expected = np.where(hit < 0, -1, np.array([*of_triangle, -1])[hit])
    found = frame.object_id.numpy()[0].ravel()
    assert (found == expected).mean() > 0.995  # rays along an edge go either way
    assert len(np.unique(found)) > 3


def test_half_of_a_triangle_decides():
    def triangle(share):
        """One of whose area a share lies in the pane, which ends at y = 0."""
        width = math.sqrt(share)  # its corner at y = -width is cut off in proportion to the square
        return [[[1.0, -width, 0.0], [1.0, 1.0 - width, 1.0], [1.0, 1.0 - width, -1.0]]]

    pane = Pane("p", (1.0, 0.0, 0.0), ((1, -9, -9), (1, 0, -9), (1, 0, 9), (1, -9, 9)), (-0.1, 0.1))
    assert not pane.is_clear(triangle(0.4))[0]
    assert pane.is_clear(triangle(0.6))[0]
    for moved_m in (0.11, -0.11):
        assert not pane.is_clear(np.add(triangle(0.6), [moved_m, 0.0, 0.0]))[0]
    # what faces elsewhere only ends there
    assert not pane.is_clear([[[1.0, -2.0, 0.0], [1.05, -2.0, 0.01], [1.0, -1.0, 0.0]]])[0]


def test_what_is_no_pane_is_refused():
    square = ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="unit vector"):
        Pane("p", (2.0, 0.0, 0.0), square, (0.0, 1.0))
    with pytest.raises(ValueError, match="polygon"):
        Pane("p", (1.0, 0.0, 0.0), square[:2], (0.0, 1.0))
    with pytest.raises(ValueError, match="outline_m: expected the corners of a polygon"):  # on one line
        Pane("p", (1.0, 0.0, 0.0), ((1, 0, 0), (1, 1, 1), (1, 2, 2)), (0.0, 1.0))
    with pytest.raises(ValueError, match="lower end first"):
        Pane("p", (1.0, 0.0, 0.0), square, (1.0, 0.0))
    with pytest.raises(ValueError, match="foreground"):
        Scene(occluders=[cuboid((1, 1, 1), (0, 0, 0)), ground(np.random.default_rng(0))]).through(FRONT)
