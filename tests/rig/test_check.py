"""What a rig's file says beside its vehicle."""

import dataclasses

import numpy as np
import pytest

import warpav as wa
from tests.raster.bodies import cuboid
from warpav.raster.pane import Pane
from warpav.rig import Rig, oddities, off_skin_m, off_vehicle
from warpav.scene import ego_vehicle


def at(*position_m):
    return Rig([dataclasses.replace(wa.preset("nuscenes").cameras[0], position_m=np.array(position_m))])


@pytest.mark.parametrize(
    ("position_m", "away_m", "told"),
    [
        ((5.0, 0.0, 3.45), 0.45, ""),  # a rack above the middle of a roof whose vertices are metres away
        ((5.0, 0.0, 4.5), 1.5, "CAM_FRONT 1.50 m off"),
        ((5.0, -2.9, 1.5), 1.7, "CAM_FRONT 1.70 m off"),
        ((5.0, 0.0, 1.5), -1.2, "CAM_FRONT 1.20 m inside"),
        ((-0.7, 0.0, 1.0), -0.3, "CAM_FRONT 0.30 m inside"),
        ((-0.99, 0.0, 1.0), 0.01, ""),  # flush
        ((-1.4, 0.0, 1.0), 0.4, ""),
    ],
)
def test_cameras_in_the_body_or_far_off_the_skin_are_told(position_m, away_m, told):
    bus = cuboid((12.0, 2.4, 2.7), (5.0, 0.0, 1.65))
    np.testing.assert_allclose(off_skin_m(at(*position_m), bus), [away_m], atol=1e-6)  # seen: 2e-7
    text = off_vehicle(at(*position_m), bus)
    assert told in text
    assert bool(text) == bool(told)


def test_a_camera_behind_glass_stands_in_the_cabin():
    bus = cuboid((12.0, 2.4, 2.7), (5.0, 0.0, 1.65))
    [camera] = at(10.9, 0.0, 2.4).cameras
    corners_m = ((11.0, -1.0, 2.0), (11.0, 1.0, 2.0), (11.0, 1.0, 2.8), (11.0, -1.0, 2.8))
    pane = Pane("windscreen", (1.0, 0.0, 0.0), corners_m, (-0.1, 0.1))
    assert off_vehicle(Rig([dataclasses.replace(camera, behind_glass=pane)]), bus) == ""
    assert "CAM_FRONT 0.10 m inside" in off_vehicle(Rig([camera]), bus)


def scaled(rig, factor):
    return Rig([dataclasses.replace(each, position_m=factor * each.position_m) for each in rig.cameras])


@pytest.mark.parametrize("preset", ["edgar", "nuscenes", "argoverse2"])
def test_positions_in_millimetres_are_told_in_one_line(preset):
    rig = scaled(wa.preset(preset), 1000.0)
    (text,) = oddities(rig)
    assert "expected position_m in metres, got [" in text
    assert text == off_vehicle(rig, ego_vehicle())
    first_m = wa.preset(preset).cameras[0].position_m
    assert text.endswith(f"look like millimetres: divide them by 1000, [{', '.join(f'{each:g}' for each in first_m)}]")
