"""What is exported and imported again is the same rig, through every format and through any two of them."""

import importlib.util
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from warpav.core.errors import InputError
from warpav.core.frames import quaternion_from_rotation, rotation_from_quaternion
from warpav.raster.camera import CameraModel
from warpav.rig import (
    EXPORTED_ONLY,
    IMPORTED_ONLY,
    RIG_FORMATS,
    ImportOptions,
    Rig,
    RigCamera,
    builtin_modules,
    export_rig_with_notes,
    formats_for,
    import_rig_with_notes,
)
from warpav.rig.formats._convert import find_format

HAS_ARROW = importlib.util.find_spec("pyarrow") is not None
BOTH_WAYS = [
    pytest.param(name, marks=[] if name != "argoverse2" or HAS_ARROW else pytest.mark.skip(reason="needs pyarrow"))
    for name in RIG_FORMATS
    if name not in (*IMPORTED_ONLY, *EXPORTED_ONLY)
]
ANY_LENS = ("urdf", "autoware", "opencv", "alpasim")
CENTRED = ("carla-ros-bridge", "carla-python")

metres = st.floats(-5.0, 5.0)
# steep cameras too, and straight down, where yaw and roll are one
angles = st.tuples(
    st.floats(-math.pi, math.pi), st.floats(-1.5, 1.5) | st.just(math.pi / 2), st.floats(-math.pi, math.pi)
)
size = st.integers(64, 4000)
centred = st.builds(
    lambda width, height, fov: CameraModel(width, height, math.radians(fov)), size, size, st.floats(5.0, 170.0)
)
calibrated = st.builds(
    lambda width, height, focal, ratio, shift: CameraModel(
        width,
        height,
        focal_px=(focal * width, focal * width * ratio),
        centre_px=((0.5 + shift[0]) * width, (0.5 + shift[1]) * height),
    ),
    size,
    size,
    st.floats(0.2, 5.0),
    st.floats(0.9, 1.1),
    st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
)
small = st.floats(-0.05, 0.05)
distorted = st.builds(
    lambda width, height, lens: CameraModel(
        width,
        height,
        lens=lens[0],
        focal_px=(1.1 * width, 1.0 * width),
        centre_px=(0.5 * width, 30.0),
        distortion=lens[1],
    ),
    size,
    size,
    st.tuples(st.just("brown_conrady"), st.lists(small, min_size=4, max_size=4).map(tuple))
    | st.tuples(st.just("brown_conrady"), st.lists(small, min_size=5, max_size=5).map(tuple))
    | st.tuples(st.just("brown_conrady"), st.lists(small, min_size=8, max_size=8).map(tuple))
    | st.tuples(st.just("fisheye"), st.lists(small, min_size=4, max_size=4).map(tuple)),
)


@st.composite
def rigs(draw, models):
    return Rig(
        RigCamera(f"camera_{i}", np.array(draw(st.tuples(metres, metres, metres))), *draw(angles), draw(models))
        for i in range(draw(st.integers(1, 3)))
    )


def assert_same(before, after, *, tolerance=1e-6, focal_tolerance=1e-9):
    """Poses within a micrometre and a microdegree, lenses within a micropixel."""
    assert [camera.name for camera in before.cameras] == [camera.name for camera in after.cameras]
    for one, other in zip(before.cameras, after.cameras, strict=True):
        np.testing.assert_allclose(other.position_m, one.position_m, rtol=0, atol=tolerance)
        turn = other.ego_from_camera[:3, :3].T @ one.ego_from_camera[:3, :3]
        assert np.degrees(Rotation.from_matrix(turn).magnitude()) < tolerance
        assert (other.model.width_px, other.model.height_px) == (one.model.width_px, one.model.height_px)
        np.testing.assert_allclose(other.model.intrinsics, one.model.intrinsics, rtol=focal_tolerance, atol=tolerance)
        assert other.model.fov_rad == pytest.approx(one.model.fov_rad, abs=math.radians(tolerance))
        length = max(len(one.model.distortion), len(other.model.distortion))
        padded = [np.pad(model.distortion, (0, length - len(model.distortion))) for model in (one.model, other.model)]
        np.testing.assert_array_equal(*padded)
        if any(one.model.distortion):
            assert other.model.lens == one.model.lens


def through(rig, name, folder, **place):
    export_rig_with_notes(rig, name, folder, **place)
    return import_rig_with_notes(folder, name, ImportOptions(accept_mirrored=True, **place))[0]


def models_for(name):
    if name in CENTRED:
        return centred
    return centred | calibrated | distorted if name in ANY_LENS else centred | calibrated


@pytest.mark.parametrize("name", BOTH_WAYS)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_rig_survives_every_format(tmp_path_factory, name, data):
    rig = data.draw(rigs(models_for(name)))
    place = {}
    if data.draw(st.booleans()):
        place = {"origin_m": data.draw(st.tuples(metres, metres, metres))}
        place["origin_rpy_deg"] = data.draw(st.tuples(*(st.floats(-180.0, 180.0),) * 3))
    assert_same(rig, through(rig, name, tmp_path_factory.mktemp("rig") / "out", **place), tolerance=5e-7)


def test_the_help_says_which_way_formats_go():
    assert [name for name in RIG_FORMATS if find_format(name).write is None] == [*IMPORTED_ONLY]
    assert [name for name in RIG_FORMATS if find_format(name).read is None] == [*EXPORTED_ONLY]


def test_every_rig_says_which_formats_hold_it():
    cameras = {
        "plain": CameraModel(640, 480, 1.2),
        "calibrated": CameraModel(640, 480, focal_px=(500.0, 501.0), centre_px=(310.0, 240.0)),
        "barrel": CameraModel(640, 480, 1.2, lens="brown_conrady", distortion=(-0.2, 0.0, 0.0, 0.0)),
        "fisheye": CameraModel(640, 480, 3.3, lens="fisheye"),
        "panorama": CameraModel(640, 480, 6.0, lens="panorama"),
    }
    fitting = {}
    for name, model in cameras.items():
        fit, unfit = formats_for(Rig([RigCamera(name, np.zeros(3), 0.0, 0.0, 0.0, model)]))
        assert {*fit, *unfit} == set(RIG_FORMATS) - {*IMPORTED_ONLY}
        assert all(name in reason for other, reason in unfit.items() if other != "argoverse2")
        fitting[name] = set(fit) - {"argoverse2"}
    lenses = {"urdf", "autoware", "camera-info", "opencv", "alpasim", "usd", "driveworks"}
    assert fitting["plain"] == {*lenses, "nuscenes", "kitti", *CENTRED}
    assert fitting["calibrated"] == {*lenses, "nuscenes", "kitti"}
    assert fitting["barrel"] == fitting["fisheye"] == lenses
    assert fitting["panorama"] == set()


def test_what_is_left_out_is_said(tmp_path):
    model = CameraModel(
        640, 480, lens="brown_conrady", focal_px=(500.0, 501.0), centre_px=(310.0, 240.0), distortion=(-0.2, 0, 0, 0)
    )
    rig = Rig([RigCamera("front", np.zeros(3), 0.0, 0.0, 0.0, model)])
    with pytest.raises(
        InputError, match=r"camera 'front': carla-python cannot represent the lens's distortion; `approximate`"
    ):
        export_rig_with_notes(rig, "carla-python", tmp_path / "a.json")
    _, notes = export_rig_with_notes(rig, "carla-python", tmp_path / "a.json", approximate=True)
    text = "\n".join(notes)
    for thing in ("the lens's distortion is dropped", "focal lengths that differ", "a principal point (310, 240 px)"):
        assert thing in text
    back = import_rig_with_notes(tmp_path / "a.json", "carla-python")[0].cameras[0]
    assert back.model.intrinsics[0, 0] == pytest.approx(500.0)
    fisheye = Rig([RigCamera("f", np.zeros(3), 0.0, 0.0, 0.0, CameraModel(640, 480, 3.3, lens="fisheye"))])
    for name in ("carla-python", "nuscenes", "kitti"):
        with pytest.raises(InputError, match=rf"camera 'f': {name} cannot represent a fisheye lens; choose another"):
            export_rig_with_notes(fisheye, name, tmp_path / "b", approximate=True)


@settings(deadline=None)
@given(st.tuples(*(st.floats(-1.0, 1.0),) * 4).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_quaternions_and_rotations_are_scipys(quaternion):
    w, x, y, z = quaternion
    expected = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(rotation_from_quaternion(np.array(quaternion)), expected, atol=1e-12)
    back = quaternion_from_rotation(expected)
    assert back[0] >= 0.0
    np.testing.assert_allclose(rotation_from_quaternion(back), expected, atol=1e-12)


def test_lidars_are_dropped_by_name_where_asked(tmp_path):
    lidar = RigCamera("top", [1.0, 0.0, 2.0], model=builtin_modules()["lidar_32"].camera_model())
    rig = Rig([RigCamera("front", [2.0, 0.0, 1.5]), lidar])
    with pytest.raises(InputError, match=r"camera 'top': urdf cannot represent a LiDAR; `approximate` drops it"):
        export_rig_with_notes(rig, "urdf", tmp_path / "rig.urdf")
    _, notes = export_rig_with_notes(rig, "urdf", tmp_path / "rig.urdf", approximate=True)
    assert "camera 'top': a LiDAR is dropped" in notes
    assert [each.name for each in import_rig_with_notes(tmp_path / "rig.urdf", "urdf")[0].cameras] == ["front"]
