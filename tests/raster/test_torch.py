"""The rasteriser's functions for PyTorch against differences of supersampled renders, and against the taped ones."""

import functools
import math

import numpy as np
import pytest
import trimesh

from warpav import raster

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
            raster.Mesh(pillar.vertices + [0.7, 0.0, -2.0], pillar.faces, [30, 60, 30]),
            raster.Mesh(wall.vertices + [0.0, 0.0, 4.0], wall.faces, [220, 220, 200]),
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
