"""What a rig's file says beside its vehicle."""

import dataclasses

import numpy as np
import pytest

import warpav as wa
from tests.raster.bodies import cuboid
from warpav.rig import Rig, oddities, off_vehicle
from warpav.scene import ego_vehicle


def at(*position_m):
    return Rig([dataclasses.replace(wa.preset("nuscenes").cameras[0], position_m=np.array(position_m))])


@pytest.mark.parametrize(
    ("position_m", "away"),
    [
        ((5.0, 0.0, 3.2), ""),  # above the middle of a roof whose vertices are metres away
        ((5.0, 0.0, 4.5), "CAM_FRONT 1.5 m"),
        ((5.0, -2.9, 1.5), "CAM_FRONT 1.7 m"),
        ((5.0, 0.0, 1.5), "CAM_FRONT 1.2 m"),  # inside
        ((-1.9, 0.0, 1.0), ""),
    ],
)
def test_cameras_far_from_the_surface_are_told(position_m, away):
    bus = cuboid((12.0, 2.4, 2.7), (5.0, 0.0, 1.65))
    text = off_vehicle(at(*position_m), bus)
    assert away in text
    assert bool(text) == bool(away)


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
