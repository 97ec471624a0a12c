"""The lenses of the kernels against those of the camera models, and their gradients against differences."""

import math

import numpy as np
import pytest
import warp as wp

from warpav.raster.lens import Lens, LensShape
from warpav_kernels.raster import _lens as lens

KINDS = {
    Lens.PINHOLE: int(lens.PINHOLE),
    Lens.BROWN_CONRADY: int(lens.BROWN_CONRADY),
    Lens.FISHEYE: int(lens.FISHEYE),
    Lens.PANORAMA: int(lens.PANORAMA),
}

SHAPES = [
    LensShape(Lens.BROWN_CONRADY),
    LensShape(Lens.BROWN_CONRADY, (-0.31, 0.11, 0.0008, -0.0005, -0.017)),
    LensShape(Lens.BROWN_CONRADY, (0.42, -0.09, 1e-4, 2e-4, 0.003, 0.78, 0.02, -0.004)),
    LensShape(Lens.FISHEYE),
    LensShape(Lens.FISHEYE, (-0.013, 0.0021, -0.0042, 0.0007)),
    LensShape(Lens.FISHEYE, (0.08, -0.02, 0.004, -0.0003)),
    LensShape(Lens.FISHEYE, (0.0, 0.0, 0.013671875, -0.001953125)),  # where Newton's steps alone go to and fro
    LensShape(Lens.PANORAMA),
]
NAMES = [f"{shape.lens}{i}" for i, shape in enumerate(SHAPES)]


@wp.kernel
def look_kernel(
    kind: int,
    limit: float,
    edge: float,
    distortion: wp.array[lens.vec8],
    place: wp.array[wp.vec2],
    ray: wp.array[wp.vec3],
    gradient: wp.array[lens.mat23],
):
    i = wp.tid()
    shape = lens.Lens()
    shape.kind = kind
    shape.limit = limit
    shape.edge = edge
    shape.distortion = distortion[0]
    ray[i] = lens.lens_ray(shape, place[i][0], place[i][1])
    gradient[i] = lens.place_gradient(shape, 3.0 * ray[i])


def look(shape, place, device):
    """Rays of places, and the gradients of the image places of points three times as far along them."""
    ray = wp.full(len(place), wp.vec3(math.nan), dtype=wp.vec3, device=device)
    gradient = wp.empty(len(place), dtype=lens.mat23, device=device)
    wp.launch(
        look_kernel,
        dim=len(place),
        inputs=[
            KINDS[shape.lens],
            shape.limit,
            shape.edge,
            wp.array([shape.coefficients], dtype=lens.vec8, device=device),
            wp.array(place, dtype=wp.vec2, device=device),
        ],
        outputs=[ray, gradient],
        device=device,
    )
    return ray.numpy(), gradient.numpy()


def places(shape):
    """Places all over the image, on the axis and beyond what the lens sees."""
    reach = min(1.1 * shape.edge, 3.0)
    line = np.linspace(-reach, reach, 81)
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2).astype(np.float32)


@pytest.mark.parametrize("shape", SHAPES, ids=NAMES)
def test_rays_are_the_models(device, shape):
    place = places(shape)
    ray, _ = look(shape, place, device)
    expected = shape.ray(place)
    seen = np.isfinite(expected[:, 0])
    radius = np.hypot(*place.T)
    # at the very edge rounding decides whether a place is seen
    well_inside = radius < 0.999 * shape.edge if shape.is_radial else seen
    np.testing.assert_array_equal((ray != 0.0).any(axis=1)[well_inside], seen[well_inside])
    if shape.is_radial:  # p1 and p2 shift the edge a little
        assert not ray[radius > 1.02 * shape.edge].any()
    assert seen.mean() > 0.5
    both = seen & well_inside
    scale = np.linalg.norm(expected[both], axis=1, keepdims=True)
    error = np.abs(ray[both] - expected[both]) / scale
    assert error.max() < 1e-5  # worst seen 1.3e-6, just before the edge, where few places are many directions
    assert np.quantile(error, 0.95) < 5e-7  # seen 1.1e-7


@pytest.mark.parametrize("shape", SHAPES, ids=NAMES)
def test_gradients_match_differences(device, shape):
    place = places(shape)
    place = place[np.isfinite(shape.ray(place)[:, 0])]
    if shape.is_radial:
        place = place[np.hypot(*place.T) < 0.95 * shape.edge]
    ray, gradient = look(shape, place, device)
    point, step = 3.0 * ray.astype(float), 1e-5
    expected = np.stack(
        [(shape.place(point + step * d) - shape.place(point - step * d)) / (2.0 * step) for d in np.eye(3)], axis=-1
    )
    known = np.isfinite(expected).all(axis=(1, 2))
    if shape.lens is Lens.PANORAMA:
        known &= np.abs(place[:, 0]) < math.pi - 0.01  # the azimuth jumps there
    assert known.mean() > 0.9
    scale = np.abs(expected[known]).max(axis=(1, 2), keepdims=True)
    error = np.abs(gradient[known] - expected[known]) / scale
    assert error.max() < 1e-4  # worst seen 2e-5
