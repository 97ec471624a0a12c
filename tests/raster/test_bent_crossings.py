"""Where outlines cross between samples through lenses that are no pinholes: planes of rays against ray queries."""

import dataclasses

import numpy as np
import pytest

from tests.driving_scene import camera_pose, on_device, random_poses, street
from tests.raster.bodies import FAR_AWAY, cuboid
from tests.raster.ray_queries import trace_crossings
from tests.raster.test_lenses import models_of
from warpav.raster.lens import Lens
from warpav.raster.renderer import Renderer
from warpav.raster.scene import Scene
from warpav.scene import DeviceScene

BENT = {name: model for name, model in models_of(128).items() if model.lens is not Lens.PINHOLE}
STEPS = ((0, -1), (-1, 0), (1, 0), (0, 1))  # to the left, top, bottom and right
CUT = 0x80000000


def crossings(layers):
    """Offset [samples], inverse depth [1/m] or number of the cut triangle, and which; each [direction, sample]."""
    key = layers.crossing_key.numpy()
    low = key & 0xFFFFFFFF
    is_cut = low & CUT != 0
    end = np.where(is_cut, low & ~CUT, (low & ~CUT).astype(np.int32).view(np.float32))
    return (key >> 32).astype(np.int32).view(np.float32), end, is_cut


def outline(layers):
    """Whether a layer covers a sample and not its neighbour, [direction, sample]."""
    bits = layers.inverse_depth_bits.numpy()
    ends = np.zeros((4, len(bits)), bool)
    for (_, _, columns, rows), first in zip(
        layers.rectangle.numpy().reshape(-1, 4), layers.offset.numpy().ravel(), strict=True
    ):
        if columns:
            own = bits[first : first + rows * columns].reshape(rows, columns) != 0
            around = np.pad(own, 1, constant_values=True)
            for direction, (down, right) in enumerate(STEPS):
                beside = around[1 + down : 1 + down + rows, 1 + right : 1 + right + columns]
                ends[direction, first : first + rows * columns] = (own & ~beside).ravel()
    return ends


def both_ways(scene, poses, model):
    """Crossings in the space of rays, those of ray queries, and where there are any: a sample's object ends there."""
    renderer = Renderer([model] * len(poses))
    renderer.render(scene, *on_device(poses))
    buffers = renderer
    ours = crossings(buffers.layers)
    buffers.layers.crossing_key.zero_()
    trace_crossings(buffers, scene, scene.object_count)
    traced = crossings(buffers.layers)
    return ours, traced, outline(buffers.layers) & (traced[0] > 0.0)


@pytest.mark.parametrize("lens", BENT)
def test_outlines_end_where_rays_begin_to_miss(lens):
    scene = DeviceScene.pack(street()).raster
    ours, traced, ends = both_ways(scene, random_poses(np.random.default_rng(1), 12), BENT[lens])
    assert np.count_nonzero(ends) > 1000
    assert np.mean(ours[0][ends] > 0.0) > 0.999
    error = np.abs(ours[0] - traced[0])[ends]
    assert np.median(error) < 1e-4  # twelve halvings
    assert np.quantile(error, 0.99) < 3e-4
    assert np.quantile(np.abs(ours[1] / np.maximum(traced[1], 1e-9) - 1.0)[ends], 0.99) < 5e-3


@pytest.mark.parametrize("lens", BENT)
def test_the_near_cut_ends_an_object(lens):
    """Boxes that reach from far away to the camera: the cut is an outline, and the triangle that it cuts is known."""
    model = dataclasses.replace(BENT[lens], near_m=1.5)
    boxes = {str(k): cuboid((2.0, 0.6, 0.5), (1.6, 0.4 * k, 0.2), (0.0, 0.2 * k, 0.3)) for k in (-1, 0, 1)}
    scene = Scene(boxes, [FAR_AWAY])
    poses = [camera_pose((0.05 * i, 0.1 * i, 0.1), 0.1 * i, 0.05 * i, 0.2 * i) for i in range(-3, 4)]
    ours, traced, ends = both_ways(scene, poses, model)
    cut = ends & traced[2]
    assert np.count_nonzero(cut) > 100
    assert np.mean(ours[2][cut]) > 0.97
    both = cut & ours[2]
    assert np.quantile(np.abs(ours[0] - traced[0])[both], 0.98) < 5e-4
    assert np.mean(ours[1][both] == traced[1][both]) > 0.97
