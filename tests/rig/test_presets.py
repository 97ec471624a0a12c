import math

import numpy as np
import pytest

from warpav.core.errors import InputError
from warpav.rig import preset_about, preset_names, preset_rig

CAMERA_COUNT = {"argoverse2": 9, "edgar": 10, "nuscenes": 6, "unidrive_6x60": 6}


@pytest.mark.parametrize("name", sorted(CAMERA_COUNT))
def test_preset_is_a_plausible_vehicle(name):
    rig = preset_rig(name)
    assert len(rig.cameras) == CAMERA_COUNT[name]
    position_m = np.array([camera.position_m for camera in rig.cameras])
    assert np.all((position_m[:, 0] > -1.0) & (position_m[:, 0] < 3.0))
    assert np.all(np.abs(position_m[:, 1]) < 1.0)
    assert np.all((position_m[:, 2] > 1.2) & (position_m[:, 2] < 2.2))
    assert all(abs(camera.pitch_rad) < math.radians(15.0) for camera in rig.cameras)


@pytest.mark.parametrize("name", sorted(CAMERA_COUNT))
def test_left_cameras_are_on_the_left_and_look_left(name):
    """A frame whose y points right would mirror the rig."""
    for camera in preset_rig(name).cameras:
        side = {"left": 1.0, "right": -1.0}.get(camera.name.casefold().split("_")[-1])
        if side is None:
            continue
        assert side * camera.position_m[1] >= 0.0
        if abs(camera.yaw_rad) > math.radians(2.0):
            assert side * camera.yaw_rad > 0.0


def test_what_is_known_of_a_preset_is_told_whole():
    about = preset_about("nuscenes")
    assert about.title == "nuScenes vehicle (Renault Zoe): six cameras."
    assert about.source.startswith("calibration of scene-0001")
    assert about.source.endswith("agrees with the published calibrated_sensor table.")
    assert "non-commercial" in about.licence
    assert all(preset_about(name).source for name in preset_names())


def test_preset_rig_rejects_an_unknown_name():
    with pytest.raises(InputError, match=r"expected one of argoverse2, .*, got 'nuscene'; did you mean nuscenes\?"):
        preset_rig("nuscene")
