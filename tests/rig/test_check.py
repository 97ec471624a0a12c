"""What a rig's file says beside its vehicle."""

import dataclasses

import numpy as np
import pytest

import warpav as wa
from warpav.raster.mesh import Mesh
from warpav.rig.check import oddities, off_vehicle
from warpav.rig.rig import Rig
from warpav.scene.town.town import ego_vehicle


def box(low_m, high_m):
    """A body of twelve large triangles."""
    corner_m = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    triangle = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    triangle += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    low_m, high_m = np.array(low_m, float), np.array(high_m, float)
    return Mesh(low_m + corner_m * (high_m - low_m), np.array(triangle, np.int32), (90, 90, 90))


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
    bus = box([-1.0, -1.2, 0.3], [11.0, 1.2, 3.0])
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
