"""How far bodies reach that the image's border cuts off, against their exactly clipped edges."""

import math

import numpy as np
import pytest

from tests.oracle import clipped_edges
from tests.raster.bodies import cuboid, error, measured, poses_towards, scene_of
from tests.raster.test_lenses import ZOOM, moved
from warpav.raster.areas import BOTTOM, LEFT, RIGHT, TOP
from warpav.raster.camera import CameraModel

MODEL = CameraModel(192, 160, math.radians(40.0), 0.1)
SIDES = [LEFT, TOP, RIGHT, BOTTOM]
SIZE_PX = np.array([192, 160, 192, 160])
# Differences of exact edges: the step is free of grain, and short beside the edges' curvature.
STEP = 1e-4


def bodies():
    """Two boxes so near that most views cut one."""
    return [
        cuboid([3.2, 1.6, 1.2], [6.0, 0.3, 0.2], (0.1, 0.2, 0.3)),
        cuboid([1.2, 3.0, 2.2], [9.0, -2.4, 0.1], (0.0, 0.1, 1.0)),
    ]


def exact(poses, models):
    """Places of the sides, [view, body, side]; NaN out of sight."""
    return np.array([clipped_edges.boxes(bodies(), *each) for each in zip(poses, models, strict=True)])


def exact_jacobian(poses, model):
    """Derivatives of the sides, [view, body, side, 7]."""
    columns = []
    for direction in range(ZOOM + 1):
        high, low = (
            exact(*zip(*[moved(pose, model, direction, sign * STEP) for pose in poses], strict=True))
            for sign in (1.0, -1.0)
        )
        columns.append((high - low) / (2.0 * STEP))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("supersampling", [1, 2])
def test_a_side_of_a_cut_body_slides_along_its_outline(device, supersampling):
    poses = poses_towards(np.random.default_rng(6), [6.0, 0.0, 0.2], 60, distance_m=(4.0, 7.0), aim_rad=0.3)
    value, jacobian = measured(scene_of(bodies()), poses, MODEL, device, supersampling=supersampling)
    box_px, truth = exact(poses, [MODEL] * len(poses)), exact_jacobian(poses, MODEL)
    value, jacobian = value[:, :, SIDES], jacobian[:, :, SIDES]
    free = (value > 1.0) & (value < SIZE_PX - 1.0)
    assert np.abs(value - box_px)[free].max() < 2.0 / supersampling
    cut = ~free.all(axis=2, keepdims=True)
    errors = error(jacobian, truth, floor=1e-9)
    # seen .008 .046 .14 and .004 .026 .07; where nothing slides .11 and .30
    assert (free & cut).sum() >= 200
    assert np.median(errors[free & cut]) < 0.02
    assert np.quantile(errors[free & cut], 0.75) < 0.07
    assert np.quantile(errors[free & cut], 0.9) < 0.2
    # whole bodies have nothing to slide along: seen .03
    assert (free & ~cut).sum() >= 10
    assert np.quantile(errors[free & ~cut], 0.9) < 0.06
