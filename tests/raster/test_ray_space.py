"""Rasterisation in the space of rays against every ray with every triangle, and the bounds that it skips samples by."""

import functools
import math

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import camera_pose, on_device
from tests.raster.test_lenses import MODELS
from warpav.raster import chunks
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import Recording
from warpav.raster.frame import Frame
from warpav.raster.lens import _TABLE_ENTRIES, Lens, image_table
from warpav.raster.mesh import Mesh
from warpav.raster.renderer import Renderer
from warpav.raster.scene import Scene

NEAR_M = 0.1
POSE = camera_pose([0.3, -0.2, 0.1], 0.4, 0.2, -0.3)
WIDE = CameraModel(96, 96, math.radians(359.0), lens="fisheye")
LENSES = {**MODELS, "nearly all round": WIDE}


def soup(seed, count, size_m, distance_m):
    """Triangles all round, some about the camera: [triangle, 3, 3]."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 1, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    middle = direction * rng.uniform(*distance_m, size=(count, 1, 1))
    size = np.exp(rng.uniform(*np.log(size_m), size=(count, 1, 1)))
    return (middle + size * rng.normal(size=(count, 3, 3))).astype(np.float32)


SOUPS = {
    "small": functools.partial(soup, 1, 400, (0.01, 0.3), (1.0, 8.0)),
    "large": functools.partial(soup, 2, 60, (0.5, 20.0), (0.5, 10.0)),
    "through the camera": functools.partial(soup, 3, 8, (1.0, 30.0), (0.0, 0.3)),
}


def nearest(corner_m, model):
    """What every ray of an image meets first, by trying all: inverse depth, and triangle or -1, [row, column]."""
    row, column = np.indices((model.height_px, model.width_px)) + 0.5
    ray = model.rays(np.stack([column, row], axis=-1)).reshape(-1, 3)
    world_from_camera, centre_m = POSE[:3, :3], POSE[:3, 3]
    a, b, c = np.moveaxis((corner_m.astype(np.float64) - centre_m) @ world_from_camera, 1, 0)
    edge, other = b - a, c - a
    across = np.cross(ray[:, None], other)  # Moeller and Trumbore
    scale = np.einsum("rtk,tk->rt", across, edge)
    with np.errstate(all="ignore"):
        first = np.einsum("rtk,tk->rt", across, -a) / scale
        turned = np.cross(-a, edge)
        second = np.einsum("rk,tk->rt", ray, turned) / scale
        depth = np.einsum("tk,tk->t", turned, other) / scale
        inside = (first >= 0.0) & (second >= 0.0) & (first + second <= 1.0) & (depth >= NEAR_M)
        inverse = np.where(inside & np.isfinite(depth), 1.0 / depth, 0.0)
    shape = row.shape
    return inverse.max(axis=1).reshape(shape), np.where(inverse.any(axis=1), inverse.argmax(axis=1), -1).reshape(shape)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("name", SOUPS)
def test_every_sample_has_the_nearest_triangle(device, name, lens):
    corner_m, model = SOUPS[name](), LENSES[lens]
    meshes = {
        f"triangle {k}": Mesh.create(each, np.array([[0, 1, 2]]), [200, 200, 200]) for k, each in enumerate(corner_m)
    }
    scene = Scene(meshes, device=device)
    renderer = Renderer([model], device=device)
    frame = renderer.render(scene, *on_device([POSE], device))
    found_m, found = frame.depth_m.numpy()[0], frame.object_id.numpy()[0]
    inverse, triangle = nearest(corner_m, model)
    assert (triangle >= 0).any()
    wrong = found != triangle
    # an outline or an intersection within rounding of a sample's centre
    assert wrong.mean() <= 2e-4, f"{wrong.sum()} of {wrong.size} samples"
    hit = ~wrong & (triangle >= 0)
    np.testing.assert_allclose(1.0 / found_m[hit], inverse[hit], rtol=2e-3)
    assert np.median(np.abs(found_m[hit] * inverse[hit] - 1.0)) < 1e-5


def degenerate():
    """Triangles with a corner, an edge or their inside at the camera's centre, without area, and very large ones."""
    right, down, ahead = POSE[:3, :3]  # of ego_from_camera these are columns; any three directions will do
    centre = POSE[:3, 3]
    corners = [
        (0.0 * ahead, ahead + right, ahead - right),
        (ahead, -ahead, right),
        (ahead - down, -ahead - down, 2.0 * down),
        (ahead, ahead, ahead),
        (ahead, 2.0 * ahead, 3.0 * ahead),
        (1e5 * ahead, 1e5 * right, 1e5 * down),
        (1e-7 * ahead, 1e-7 * right, 1e-7 * down),
        (0.1 * ahead, 0.1 * ahead + right, 0.1 * ahead + down),
    ]
    return (np.array(corners) + centre).astype(np.float32)


@pytest.mark.parametrize("supersampling", [1, 2])
@pytest.mark.parametrize("lens", ["pinhole", *LENSES])
def test_triangles_at_the_camera_s_centre_leave_numbers(device, lens, supersampling):
    model = LENSES.get(lens) or CameraModel(96, 96)
    meshes = {f"{k}": Mesh.create(each, np.array([[0, 1, 2]]), [200, 100, 0]) for k, each in enumerate(degenerate())}
    scene = Scene(meshes, device=device)
    frame = Renderer([model], supersampling=supersampling, device=device).render(scene, *on_device([POSE], device))
    measures, coverage = frame.measure(), frame.coverage()
    window = frame.window_area(None, softness_rad=0.05, visible=True)
    for found in (
        frame.rgb, frame.object_id, frame.silhouettes(visible=True), measures.value, measures.jacobian, coverage.value,
        coverage.solid_angle_sr, frame.contrast(measures.value), frame.calibration_jacobian(), window.value,
    ):  # fmt: skip
        assert np.isfinite(found.numpy()).all()
    depth_m = frame.depth_m.numpy()
    assert not np.isnan(depth_m).any()
    assert (depth_m > 0.0).all()


RADIAL = [name for name, model in MODELS.items() if model.shape.is_radial]


def in_table(shape, direction, column):
    """A column of a lens's table at directions of unit length."""
    entry = 0.5 * (1.0 - direction[..., 2]) * (_TABLE_ENTRIES - 1)
    return np.interp(entry, np.arange(_TABLE_ENTRIES), image_table(shape, math.pi)[:, column].astype(np.float64))


def moves_aside(shape):
    """How far a lens moves a place sideways at most, over the squared tangent of the angle from the axis."""
    return 3.0 * np.abs(shape.coefficients[2:4]).sum() if shape.lens is Lens.BROWN_CONRADY else 0.0


@pytest.mark.parametrize("name", RADIAL)
def test_the_table_knows_the_image_of_a_direction(name):
    """Up to what a lens moves sideways, and beyond its limit it goes on growing."""
    shape = MODELS[name].shape
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(4000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    place = in_table(shape, direction, 0)[:, None] * direction[:, :2]
    truth = shape.place(direction)
    seen = np.isfinite(truth[:, 0]) & (np.arccos(direction[:, 2]) < math.radians(85.0))
    far = np.linalg.norm(direction[seen, :2], axis=1) / np.maximum(direction[seen, 2], 1e-3)
    error = np.linalg.norm(place[seen] - truth[seen], axis=1)
    assert seen.sum() > 500
    assert (error <= 1e-4 + math.sqrt(2.0) * moves_aside(shape) * far * far).all()
    radius = image_table(shape, math.pi)[:, 0].astype(np.float64) * np.sin(
        np.arccos(1.0 - 2.0 * np.linspace(0.0, 1.0, _TABLE_ENTRIES))
    )
    assert (np.diff(radius[:-20]) > 0.0).all()


@pytest.mark.parametrize("lens", ["brown_conrady", "fisheye"])
def test_recorded_launches_follow_the_zoom(device, lens, monkeypatch):
    """A zoom that changes between two replays changes the picture as it does without a recording, or room for one."""
    model = MODELS[lens]
    corner_m = SOUPS["small"]()
    scene = Scene(
        {"soup": Mesh.create(corner_m.reshape(-1, 3), np.arange(corner_m.size // 3).reshape(-1, 3), [9, 9, 9])},
        device=device,
    )
    zoom = wp.zeros(1, dtype=float, device=device)
    found, poses = {}, on_device([POSE], device)
    for name, is_recorded in (("recorded", True), ("launched", False), ("no room", True)):
        if name == "no room":
            monkeypatch.setattr(chunks, "_has_room", lambda device: False)
        renderer = Renderer([model], device=device, thread_count=1)
        depth_m = []
        draw = Recording(
            lambda renderer=renderer: renderer.render(scene, *poses, log_focal=zoom), renderer, enabled=is_recorded
        )
        for log_zoom in (0.0, 0.0, 0.0, 0.3, -0.1):
            zoom.fill_(log_zoom)
            draw()
            depth_m.append(Frame(renderer, renderer.state).depth_m.numpy())
        found[name] = np.array(depth_m)
    assert not np.array_equal(found["recorded"][2], found["recorded"][3])
    np.testing.assert_array_equal(found["recorded"], found["launched"])
    np.testing.assert_array_equal(found["no room"], found["launched"])
    assert draw._graph is None
