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
from warpav.raster.beams import Beams
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
EXTRAS = {"argoverse2", "usd"}
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
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
        assert all(name in reason for other, reason in unfit.items() if other not in EXTRAS)
        fitting[name] = set(fit) - EXTRAS
    lenses = {"urdf", "autoware", "camera-info", "opencv", "alpasim", "driveworks"}
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


@given(st.tuples(*(st.floats(-1.0, 1.0),) * 4).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_quaternions_and_rotations_are_scipys(quaternion):
    w, x, y, z = quaternion
    expected = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(rotation_from_quaternion(np.array(quaternion)), expected, atol=1e-12)
    back = quaternion_from_rotation(expected)
    assert back[0] >= 0.0
    np.testing.assert_allclose(rotation_from_quaternion(back), expected, atol=1e-12)


FRAMES_OF_LIDARS = [param for param in BOTH_WAYS if param.values[0] in ("nuscenes", "argoverse2", "autoware")]


def rig_of_lidar(model, module=None):
    camera = RigCamera("front", np.array([1.8, 0.1, 1.4]), 0.1, 0.2, 0.05)
    return Rig([camera, RigCamera("roof", np.array([1.2, -0.3, 1.9]), -2.5, 0.15, -0.1, model, module)])


@pytest.mark.parametrize("name", ["urdf", *CENTRED])
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    lines=st.integers(2, 128),
    low_deg=st.floats(-60.0, 0.0),
    shots=st.integers(100, 3600),
    half_deg=st.floats(20.0, 170.0) | st.just(180.0),
    range_m=st.floats(10.0, 300.0),
    rate_hz=st.sampled_from([5.0, 10.0, 12.5, 20.0]),
)
def test_even_beams_survive_formats_that_hold_them(
    tmp_path_factory, name, lines, low_deg, shots, half_deg, range_m, rate_hz
):
    up_rad = np.radians(np.linspace(low_deg, low_deg + 25.0, lines))
    half_rad = math.radians(half_deg)
    azimuth_rad = (-half_rad, 0.5 * half_rad) if name == "urdf" and half_deg < 180.0 else (-half_rad, half_rad)
    step_rad = (azimuth_rad[1] - azimuth_rad[0]) / shots
    beams = Beams(tuple(up_rad), step_rad, azimuth_rad, (range_m, range_m), rate_hz=rate_hz)
    rig = rig_of_lidar(CameraModel.of_beams(beams, 0.1))
    back = through(rig, name, tmp_path_factory.mktemp("rig") / "out")
    found = back.cameras[1].model.beams
    np.testing.assert_allclose(np.degrees(found.elevation_rad), np.degrees(beams.elevation_rad), atol=2e-6)
    assert math.degrees(found.step_rad) == pytest.approx(math.degrees(beams.step_rad), rel=1e-5, abs=2e-6)
    # a step of whole microdegrees times shots differs that much from the sector
    np.testing.assert_allclose(np.degrees(found.azimuth_rad), np.degrees(azimuth_rad), atol=1e-6 * shots)
    assert found.range_m == pytest.approx(beams.range_m)
    assert (found.rate_hz, found.is_all_round) == (pytest.approx(rate_hz), half_deg == 180.0)
    assert back.cameras[1].model.near_m == 0.1
    np.testing.assert_allclose(back.cameras[1].ego_from_camera, rig.cameras[1].ego_from_camera, atol=1e-9)
    assert back.cameras[0].model.fov_rad == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("name", FRAMES_OF_LIDARS)
def test_frames_of_lidars_survive_and_take_the_beams_of_a_module(tmp_path, name):
    module = builtin_modules()["lidar_flat_120"]
    rig = rig_of_lidar(module.camera_model(), "lidar_flat_120")
    with pytest.raises(
        InputError, match=f"camera 'roof': {name} cannot represent the beams of a LiDAR .*`approximate`"
    ):
        export_rig_with_notes(rig, name, tmp_path / "out")
    export_rig_with_notes(rig, name, tmp_path / "out", approximate=True)
    back, notes = import_rig_with_notes(tmp_path / "out", name, ImportOptions(lidar="lidar_flat_120"))
    assert_same(rig, back)
    roof = back.cameras[1]
    assert (roof.model, roof.module, roof.housing) == (rig.cameras[1].model, "lidar_flat_120", module.housing)
    assert not any("not read" in note for note in notes)
    plain, notes = import_rig_with_notes(tmp_path / "out", name)
    assert [camera.name for camera in plain.cameras] == ["front"]
    assert any(note.startswith("roof: LiDARs whose beams the file does not hold, not read; `lidar`") for note in notes)
    export_rig_with_notes(Rig(rig.cameras[1:]), name, tmp_path / "alone", approximate=True)
    with pytest.raises(InputError, match="expected cameras, got LiDARs without beams, roof; `lidar` MODULE"):
        import_rig_with_notes(tmp_path / "alone", name)
    with pytest.raises(InputError, match=r"lidar: expected one of lidar_16, .*got 'lidar_flat'"):
        import_rig_with_notes(tmp_path / "out", name, ImportOptions(lidar="lidar_flat"))


def test_what_is_lost_of_lidars_is_said(tmp_path):
    uneven = rig_of_lidar(builtin_modules()["lidar_32_dense_middle"].camera_model())
    lost = {"urdf": ["uneven spread", "80 % reflectivity"], "kitti": ["a LiDAR"], "opencv": ["a LiDAR"]}
    lost |= {name: [*lost["urdf"], "least range, 0.5 m"] for name in CENTRED}
    for name, things in lost.items():
        with pytest.raises(InputError, match=f"camera 'roof': {name} cannot represent .*`approximate`"):
            export_rig_with_notes(uneven, name, tmp_path / name)
        _, notes = export_rig_with_notes(uneven, name, tmp_path / name, approximate=True)
        dropped = [note for note in notes if note.endswith("is dropped")]
        assert len(dropped) == len(things)
        assert all(thing in note for thing, note in zip(things, dropped, strict=True))
    with pytest.raises(InputError, match="lidar: expected a file with LiDARs that lack beams, got none"):
        import_rig_with_notes(tmp_path / "urdf", "urdf", ImportOptions(lidar="lidar_32"))
    aside = Beams((-0.1, 0.1), 0.01, (0.0, 1.0), (90.0, 90.0))
    with pytest.raises(InputError, match=r"represent a LiDAR's sector from 0 to 57\.2958 deg; choose another format"):
        export_rig_with_notes(rig_of_lidar(CameraModel.of_beams(aside, 0.1)), "carla-python", tmp_path / "b.json")
    with pytest.raises(InputError, match="kitti: expected a camera, got LiDARs alone"):
        export_rig_with_notes(Rig(uneven.cameras[1:]), "kitti", tmp_path / "c", approximate=True)
