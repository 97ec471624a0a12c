"""The workshop's table: read back by csv, stand-offs and normals of known places."""

import csv
import io
import math

import numpy as np
import pytest

from tests.view.stand_ins import ego
from warpav.raster.camera import CameraModel
from warpav.rig.rig import Rig, RigCamera
from warpav.view.drawing.mounts import COLUMNS, mount_csv, mounts

WIDE = CameraModel(640, 480, math.radians(190.0), lens="fisheye")


def rig_of(*places_m, yaw_deg=0.0):
    return Rig(
        RigCamera(f"cam_{i}", np.array(place), math.radians(yaw_deg), math.radians(-0.001), 0.1, WIDE)
        for i, place in enumerate(places_m)
    )


@pytest.mark.parametrize(
    ("place_m", "off_m", "normal"),
    [
        ((1.0, 0.2, 1.55), 0.05, (0, 0, 1)),
        ((1.0, 0.98, 0.7), 0.08, (0, 1, 0)),
        ((3.7, 0.1, 0.7), 0.1, (1, 0, 0)),
        ((1.0, 0.2, 1.4), 0.1, (0, 0, -1)),  # inside, where the roof is above the camera
    ],
)
def test_stand_off_and_normal_are_those_of_the_nearest_point(place_m, off_m, normal):
    [mount] = mounts(rig_of(place_m), ego())
    assert mount.stand_off_m == pytest.approx(off_m, abs=1e-6)
    np.testing.assert_allclose(mount.normal, normal, atol=1e-6)


def test_beyond_an_edge_the_distance_is_to_the_edge():
    [mount] = mounts(rig_of((1.0, 0.9 + 0.03, 1.5 + 0.04)), ego())
    assert mount.stand_off_m == pytest.approx(0.05, abs=1e-6)
    np.testing.assert_allclose(mount.normal, (0, 0, 1), atol=1e-6)  # the face that looks at it most


def test_csv_is_read_back():
    rig = rig_of((1.0, 0.2, 1.55), (1.0, 0.98, 0.7), yaw_deg=190.0)
    head, *rows = csv.reader(io.StringIO(mount_csv(mounts(rig, ego())), newline=""))
    assert tuple(head) == COLUMNS
    first, second = (dict(zip(head, row, strict=True)) for row in rows)
    assert first | {"roll_deg": "5.73"} == {
        **{"name": "cam_0", "module": "", "x_mm": "1000.0", "y_mm": "200.0", "z_mm": "1550.0"},
        **{"yaw_deg": "-170.00", "pitch_deg": "0.00", "roll_deg": "5.73", "fov_deg": "190.00"},
        **{"width_px": "640", "height_px": "480", "lens": "fisheye", "stand_off_mm": "50.0"},
        **{"normal_x": "0.0000", "normal_y": "0.0000", "normal_z": "1.0000"},
    }
    assert second["normal_y"] == "1.0000"


def test_without_a_vehicle_these_are_empty():
    [row] = csv.DictReader(io.StringIO(mount_csv(mounts(rig_of((1.0, 0.2, 1.55)), None)), newline=""))
    assert [row["stand_off_mm"], row["normal_x"]] == ["", ""]
