"""What a rig's file says beside its vehicle."""

import dataclasses

import numpy as np
import pytest

import warpav as wa
from warpav.raster.mesh import Mesh
from warpav.rig.check import off_vehicle
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


def test_rigs_on_their_vehicle_are_not():
    assert off_vehicle(wa.preset("nuscenes"), ego_vehicle()) == ""
    assert "is the rig of another vehicle" in off_vehicle(at(1.0, 0.0, 3.2), ego_vehicle())
