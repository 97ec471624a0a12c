"""The rasteriser's functions for PyTorch against differences of supersampled renders, and against the taped ones."""

import functools
import math

import numpy as np
import pytest
import trimesh

from warpav import raster
from warpav.core.errors import InputError

torch = pytest.importorskip("torch")
from warpav.raster import torch as wt  # noqa: E402 (PyTorch has to be there)

SIZE_PX, TRUTH_SAMPLES, STEP_M, STEP_RAD = 96, 12, 0.02, 0.004


@functools.cache
def scene():
    """A rounded body behind a pillar, before a wall."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    rgb = np.clip(128 + 100 * ball.vertices, 0, 255)
    pillar = trimesh.creation.box(extents=[0.4, 4.0, 0.4])
    wall = trimesh.creation.box(extents=[30.0, 30.0, 0.5])
    return raster.Scene(
        {"body": raster.Mesh(ball.vertices * [1.2, 0.8, 1.0], ball.faces, rgb)},
        occluders=[
            raster.Mesh(np.add(pillar.vertices, [0.7, 0.0, -2.0]), pillar.faces, [30, 60, 30]),
            raster.Mesh(np.add(wall.vertices, [0.0, 0.0, 4.0]), wall.faces, [220, 220, 200]),
        ],
    )


def cameras(count, scale=1):
    """Cameras of 96 x 96 pixels, or of as many times more."""
    matrix = np.array([[90.0 * scale, 0, 48.0 * scale], [0, 90.0 * scale, 48.0 * scale], [0, 0, 1]])
    return raster.Cameras(np.tile(matrix, (count, 1, 1)), width_px=SIZE_PX * scale, height_px=SIZE_PX * scale)


def vectors(count, dtype=torch.float64):
    """Poses that see the body, as rotation vectors and translations."""
    rng = np.random.default_rng(3)
    pose = np.concatenate([rng.uniform(-0.15, 0.15, (count, 3)), rng.uniform(-0.3, 0.3, (count, 3))], axis=1)
    pose[:, 5] += 5.0
    return torch.tensor(pose, dtype=dtype)


def blocks(shape):
    """Weights of smooth blobs, so that a loss has no pixel's grain."""
    rng = np.random.default_rng(1)
    row = column = (np.arange(SIZE_PX) + 0.5) / SIZE_PX
    waves = sum(
        rng.normal() * np.sin(math.pi * (a * row[:, None] + b * column[None] + rng.uniform(0, 2)))
        for a in (1, 2)
        for b in (1, 2)
    )
    return torch.tensor(np.broadcast_to(waves[..., None] if shape[-1] == 3 else waves, shape).copy())


def weighed(image):
    return (image * blocks(image.shape)).sum()


def depth(pose, samples):
    """A depth is that of a sample, its gradient that of the mean over the pixel: the truth is a mean over pixels."""
    scale = samples if samples == TRUTH_SAMPLES else 1
    image = wt.depth(scene(), cameras(len(pose), scale), pose, background_m=20.0, samples=1 if scale > 1 else samples)
    return weighed(torch.nn.functional.avg_pool2d(image[:, None], scale)[:, 0])


LOSSES = {
    "visible_area": lambda pose, samples: wt.visible_area(scene(), cameras(len(pose)), pose, samples=samples).sum(),
    "amodal_area": lambda pose, samples: wt.amodal_area(scene(), cameras(len(pose)), pose, samples=samples).sum(),
    "silhouette": lambda pose, samples: weighed(wt.silhouette(scene(), cameras(len(pose)), pose, samples=samples)),
    "depth": depth,
    "rgb": lambda pose, samples: weighed(wt.rgb(scene(), cameras(len(pose)), pose, samples=samples)),
}


# error of the gradient over the truth's norm at 4 samples; worst seen in the comment
@pytest.mark.parametrize(
    ("name", "tolerance"),
    [
        ("visible_area", 0.02),
        ("amodal_area", 0.02),
        ("silhouette", 0.02),
        ("depth", 0.1),
        ("rgb", 0.1),
    ],
)
def test_gradients_match_differences_of_a_finer_render(name, tolerance):
    pose, loss = vectors(2), LOSSES[name]
    pose.requires_grad = True
    loss(pose, 4).backward()
    scale = np.array([STEP_RAD] * 3 + [STEP_M] * 3)
    truth = np.zeros((2, 6))
    for v in range(2):
        for column in range(6):
            sides = []
            for sign in (1.0, -1.0):
                at = pose.detach()[v : v + 1].clone()
                at[0, column] += sign * scale[column]
                sides.append(float(loss(at, TRUTH_SAMPLES)))
            truth[v, column] = (sides[0] - sides[1]) / (2.0 * scale[column])
    weight = np.array([0.2] * 3 + [1.0] * 3)
    error = np.linalg.norm((pose.grad.numpy() - truth) * weight) / np.linalg.norm(truth * weight)
    assert error < tolerance


def test_matrices_and_vectors_are_the_same_poses():
    vector = vectors(2).requires_grad_()
    rotation, translation = wt._rotation_and_translation(vector)
    bottom = torch.tensor([[[0.0, 0.0, 0.0, 1.0]]], dtype=vector.dtype).expand(2, 1, 4)
    matrix = torch.cat([torch.cat([rotation, translation[:, :, None]], dim=2), bottom], dim=1)
    by_vector, by_matrix = (wt.visible_area(scene(), cameras(2), pose) for pose in (vector, matrix))
    torch.testing.assert_close(by_vector, by_matrix)
    (one,) = torch.autograd.grad(by_vector.sum(), vector)
    (other,) = torch.autograd.grad(by_matrix.sum(), vector)
    torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-3)


def test_gradients_are_those_of_the_jacobian_and_can_be_asked_for_twice():
    pose, log_focal = vectors(2, torch.float32).requires_grad_(), torch.zeros(2, requires_grad=True)
    rotation, translation = wt._rotation_and_translation(pose.detach())
    matrix = np.tile(np.eye(4), (2, 1, 1))
    matrix[:, :3, :3], matrix[:, :3, 3] = rotation.numpy(), translation.numpy()
    jacobian = raster.render(scene(), cameras(2), matrix).areas().jacobian.numpy()[:, 0]
    area = wt.visible_area(scene(), cameras(2), pose, log_focal=log_focal)
    assert area.dtype == torch.float32
    for times in (1.0, 2.0):
        found = torch.autograd.grad((times * area).sum(), (pose, log_focal), retain_graph=True)
        expected = -np.einsum("vij,vj->vi", rotation.numpy(), times * jacobian[:, :3])
        np.testing.assert_allclose(found[0][:, 3:].numpy(), expected, rtol=1e-3, atol=0.5)
        np.testing.assert_allclose(found[1].numpy(), times * jacobian[:, 6], rtol=1e-4)


@pytest.mark.parametrize(
    ("pose", "kind", "message"),
    [
        (np.eye(4)[None], TypeError, "pose: expected a tensor of floats, got ndarray"),
        (torch.eye(4, dtype=torch.int64)[None], TypeError, "pose: expected a tensor of floats, got torch.int64"),
        (torch.eye(4), InputError, r"pose: expected \[1, 4, 4\] or \[1, 6\], one for each camera, got \[4, 4\]"),
        (torch.full((1, 6), float("nan")), InputError, "pose: expected finite numbers"),
        (2.0 * torch.eye(4)[None], InputError, "expected rotations and translations"),
        (
            torch.empty(1, 4, 4, device="meta"),
            InputError,
            "pose: expected a tensor on cpu, where the scene is, got one on meta",
        ),
    ],
)
def test_poses_that_are_none_are_rejected(pose, kind, message):
    with pytest.raises(kind, match=message):
        wt.visible_area(scene(), cameras(1), pose)


def test_tensors_that_want_a_gradient_are_sent_here():
    pose = torch.eye(4)[None].requires_grad_()
    with pytest.raises(InputError, match=r"warpav\.raster\.torch has functions with gradients"):
        raster.render(scene(), cameras(1), pose)
    assert raster.render(scene(), cameras(1), pose.detach()).object_id.shape == (1, SIZE_PX, SIZE_PX)
