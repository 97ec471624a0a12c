"""Pitch, height and field of view: their bounds, their steps, and a world in which the best of them are known."""

import math

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.driving_scene import ConstantDetector, flat_surface, roof
from tests.optimisation.known_optimum import _block, _body, _scene, _vehicle
from tests.optimisation.objectives import rig_objective
from tests.optimisation.test_missed import FREE
from tests.thesis.test_descent import START, Slope, street_scenes
from warpav.detection import DetectionProbability
from warpav.optimisation import (
    HEIGHT_DELTA_M,
    LOG_ZOOM,
    PITCH_RAD,
    AssignedScene,
    CameraMount,
    FreeRanges,
    LossSettings,
    OptimiserSettings,
    SearchSpace,
)
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.lens import Lens
from warpav.rig import Rig
from warpav.scene import DeviceScene
from warpav.thesis import BoundsAndSpacing, Descent

MODEL = CameraModel(64, 64, math.pi / 2)
FOLDS = (-0.3, 0.0, 0.0, 0.0)
LENSES = [
    MODEL,
    CameraModel(64, 48, math.radians(90.0), lens="brown_conrady", distortion=(-0.1, 0.01, 0.0, 0.0)),
    CameraModel(64, 48, math.radians(100.0), lens="fisheye", distortion=(0.02, -0.01, 0.0, 0.0)),
    CameraModel(64, 48, math.radians(105.0), lens="panorama"),
]
OFFSET_M = 0.25


def mount_of(free=FREE, surface=None, model=MODEL):
    return CameraMount(surface or roof(), camera=model, height_offset_m=OFFSET_M, free=free)


def assert_within(mount, mount_pose):
    """Exactly, as the numbers that are kept; to rounding, as the rig's."""
    assert (mount.low <= mount_pose).all()
    assert (mount_pose <= mount.high).all()
    for camera in mount.rig(mount_pose).cameras:
        height_m = camera.position_m[2] - mount.surface.height_at_m(camera.position_m[:2])
        for value, (low, high) in zip(
            (camera.pitch_rad, height_m, camera.model.fov_rad), vars(mount.free).values(), strict=True
        ):
            assert low - 1e-6 <= value <= high + 1e-6


# --- the mount -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("free", "message"),
    [
        (lambda: FreeRanges(pitch_rad=(0.2, -0.2)), "pitch_rad must be a range"),
        (lambda: FreeRanges(height_m=(0.1, math.nan)), "height_m must be a range"),
        (lambda: mount_of(FreeRanges(height_m=(0.3, 0.4))), "must hold what is configured"),
        (lambda: mount_of(FreeRanges(fov_rad=(1.0, 1.5))), "must hold what is configured"),
        (lambda: mount_of(FREE, model=CameraModel(64, 64, lens=Lens.BROWN_CONRADY, distortion=FOLDS)), "at most 1.6"),
    ],
)
def test_ranges_that_make_no_sense_are_refused(free, message):
    with pytest.raises(ValueError, match=message):
        free()


def test_a_start_keeps_what_is_free_and_takes_the_rest_as_configured(rng):
    pose = np.array([[1.6, 0.3, 0.15, 0.1, 0.02, 0.2, 0.3], [0.4, -0.3, 3.0, -0.6, 0.0, 0.9, -0.9]], np.float32)
    rig = mount_of().rig(pose)
    assert isinstance(rig, Rig)
    kept = mount_of().within(mount_of().mount_pose_of_rig(rig, as_configured=True))
    np.testing.assert_allclose(kept[0], pose[0], atol=1e-6)
    assert_within(mount_of(), kept)
    fixed = mount_of(free=None).within(mount_of(free=None).mount_pose_of_rig(rig, as_configured=True))
    np.testing.assert_array_equal(fixed[:, [HEIGHT_DELTA_M, LOG_ZOOM]], 0.0)
    np.testing.assert_allclose(fixed[:, :5], pose[:, :5], atol=1e-6)


@pytest.mark.parametrize(
    ("model", "half_width_deg", "half_height_deg"),
    [
        (CameraModel(64, 64, math.pi / 2), 45.0, 45.0),
        (CameraModel(64, 32, math.pi / 2), 45.0, math.degrees(math.atan(0.5))),
        (CameraModel(64, 32, math.radians(200.0), lens="fisheye"), 100.0, 50.0),
        (CameraModel(64, 64, math.radians(200.0), lens="fisheye"), 100.0, 100.0),
        (CameraModel(64, 32, math.radians(170.0), lens="panorama"), 85.0, math.degrees(math.atan(math.radians(42.5)))),
    ],
)
def test_windows_are_as_wide_and_high_as_the_image_of_any_lens(model, half_width_deg, half_height_deg):
    mount = mount_of(free=None, model=model)
    window = mount.windows(mount.place(wp.array(START.astype(np.float32), dtype=float))).numpy()
    np.testing.assert_allclose(np.degrees(window[:, 2:]), [[half_width_deg, half_height_deg]] * len(window), atol=1e-3)


@pytest.mark.parametrize("model", LENSES, ids=lambda model: model.lens.value)
def test_any_lens_zooms_between_the_ends_of_its_field_of_view(model):
    mount = mount_of(FreeRanges(fov_rad=FREE.fov_rad), model=model)
    pose = np.repeat(START.astype(np.float32)[:1], 3, axis=0)
    pose[:, LOG_ZOOM] = mount.low[LOG_ZOOM], 0.0, mount.high[LOG_ZOOM]
    models = [camera.model for camera in mount.rig(pose).cameras]
    widest, narrowest = FREE.fov_rad[::-1]
    np.testing.assert_allclose([each.fov_rad for each in models], [widest, model.fov_rad, narrowest], atol=1e-5)
    window = mount.windows(mount.place(wp.array(pose, dtype=float))).numpy().reshape(3, mount.rotation_count, 4)
    for zoomed, of_camera in zip(models, window, strict=True):
        # the right edge and the lower edge of the image, on the principal axes
        ray = zoomed.rays(np.array([[64.0, 0.5 * model.height_px], [32.0, model.height_px]]))
        half_width, half_height = np.arctan2(ray[0, 0], ray[0, 2]), np.arctan2(ray[1, 1], ray[1, 2])
        np.testing.assert_allclose(of_camera[:, 2:], [[half_width, half_height]] * len(of_camera), atol=1e-5)


def test_the_gradient_to_the_zoom_of_a_fisheye_goes_on_through_its_window():
    mount = mount_of(FreeRanges(fov_rad=FREE.fov_rad), model=LENSES[2])
    pose = START.astype(np.float32)
    pose[:, LOG_ZOOM] = 0.1

    def half_width_rad(zoom):
        at = pose.copy()
        at[:, LOG_ZOOM] = zoom
        return mount.windows(mount.place(wp.array(at, dtype=float))).numpy()[0, 2]

    start = wp.array(pose, dtype=float, requires_grad=True)
    with wp.Tape() as tape:
        window = mount.windows(mount.place(start))
    seed = np.zeros((*window.shape, 4), np.float32)
    seed[0, 2] = 1.0
    tape.backward(grads={window: wp.array(seed, dtype=wp.vec4)})
    expected = (half_width_rad(0.11) - half_width_rad(0.09)) / 0.02
    assert start.grad.numpy()[0, LOG_ZOOM] == pytest.approx(expected, rel=1e-3)


# --- steps and samples stay within -----------------------------------------------------------------------------------


@given(
    st.lists(st.floats(-1e3, 1e3, width=32), min_size=14, max_size=14),
    st.floats(1e-3, 3.0),
    st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6),
)
@settings(max_examples=25)
def test_no_step_leaves_the_bounds(slope, rate, first):
    objective = Slope()
    objective.mount = mount_of()
    evaluate = objective.evaluate

    def steep(mount_pose, scenes, **options):
        assert_within(objective.mount, mount_pose)
        result = evaluate(mount_pose, scenes, **options)
        if result.gradient is not None:
            result.gradient[:] = np.reshape(slope, (2, 7))
        return result

    objective.evaluate = steep
    start = START.copy()
    start[:, [PITCH_RAD, HEIGHT_DELTA_M, LOG_ZOOM]] = np.reshape(first, (2, 3))
    steps = OptimiserSettings(keep="best", check_every=2).model_copy(
        update={
            "learning_rate_position_m": 0.01,
            "learning_rate_pitch_deg": math.degrees(rate),
            "learning_rate_height_m": rate,
            "learning_rate_zoom": rate,
        }
    )
    descent = Descent(objective, street_scenes(), steps, start, np.random.default_rng(0), 4, 1)
    records = [descent.step() for _ in range(4)]
    assert_within(objective.mount, descent.finish().mount_pose)
    assert set(records[0].free) == {"pitch_deg", "height_m", "fov_deg"}
    for record in records:
        for value in record.free["fov_deg"]:
            assert 60.0 - 1e-4 <= value <= 110.0 + 1e-4
        for value in record.free["height_m"]:
            assert 0.05 <= value <= 0.6
    moved = descent.mount_pose != objective.mount.within(start).astype(np.float32)
    assert not moved[:, 4].any()  # the roll


@given(st.integers(0, 1000))
@settings(max_examples=25)
def test_searches_try_all_that_is_free_and_nothing_else(seed):
    mount, rng = mount_of(), np.random.default_rng(seed)
    space = SearchSpace.over(mount, 2, constraints=BoundsAndSpacing(mount.surface))
    assert space.size == 12
    for unit in (rng.uniform(-0.5, 1.5, 12), np.zeros(12), np.ones(12)):
        assert_within(mount, space.pose_of(unit))
    random = space.random(rng)
    assert_within(mount, random.astype(np.float32))
    assert (np.ptp(random[:, [PITCH_RAD, HEIGHT_DELTA_M, LOG_ZOOM]], axis=0) > 0.0).all()
    np.testing.assert_allclose(space.pose_of(space.unit_of(random))[:, 3:], random[:, 3:], atol=1e-6)


# --- a world with a known answer -------------------------------------------------------------------------------------


def fenced_objective(free):
    """A camera that sees a far van over a fence: higher and narrower is better; it starts by looking up."""
    surface = flat_surface([-0.5, -0.5], [0.5, 0.5], height_m=1.5)
    fence = _block([0.2, 30.0, 2.0], [5.0, 0.0, 1.0])
    scene = _scene("fence", [fence], _body(surface), [_vehicle(0, [2.4, 4.0, 2.6], [14.0, 0.0, 1.3])])
    objective = rig_objective(
        mount_of(free, surface),
        ConstantDetector.silent(1),
        camera_count=1,
        settings=LossSettings(expected_miss_rate=1.0),
        occlusion=Occlusion.EXACT,
        supersampling=2,
        # more of it, less of it hidden, less of it cut off, farther from the border
        probability=DetectionProbability(
            np.array([1.0, 0.0, 0.0, -1.5, 1.2, 0.0, -1.0, -1.0]),
            np.array([8.0, 1.0, 0.8, 3.0, 3.6, 0.6, 2.0, 2.0]) / 6.0,
            np.array([[8.0], [6.0], [3.0], [0.0], [6.0], [0.0], [0.0], [0.0]]) * np.linspace(-0.5, 0.5, 7),
            -0.5,
        ),
    )
    return objective, [AssignedScene(DeviceScene.pack(scene), np.full(1, -1, np.int32))]


def test_a_descent_finds_the_best_pitch_height_and_field_of_view():
    steps = OptimiserSettings(
        learning_rate_position_m=0.01,
        learning_rate_yaw_deg=math.degrees(0.01),
        schedule="cosine",
        keep="best",
        check_every=5,
        weight_decay=0.0,
    )
    start = np.array([[0.0, 0.0, 0.0, -0.3, 0.0, 0.0, 0.0]])
    found = {}
    for name, free in (("free", FREE), ("fixed", None)):
        objective, scenes = fenced_objective(free)
        descent = Descent(objective, scenes, steps, start, np.random.default_rng(0), 60, 1)
        for _ in range(60):
            descent.step()
        found[name] = descent.finish()
    objective, scenes = fenced_objective(FREE)
    best, low, high = found["free"].mount_pose, objective.mount.low, objective.mount.high
    assert best[0, HEIGHT_DELTA_M] > high[HEIGHT_DELTA_M] - 0.02
    assert best[0, LOG_ZOOM] > high[LOG_ZOOM] - 0.02
    pitches = np.linspace(low[PITCH_RAD], high[PITCH_RAD], 41)
    values = []
    for pitch in pitches:
        pose = best.copy()
        pose[:, PITCH_RAD] = pitch
        values.append(objective.evaluate(pose, scenes).objective)
    # 6.2 and 6.0 degrees, .432 and .431; level at the configured height with the configured lens .98
    assert best[0, PITCH_RAD] == pytest.approx(pitches[np.argmin(values)], abs=math.radians(1.0))
    assert found["free"].training_objective < min(values) + 0.01
    assert found["free"].training_objective < 0.6 * found["fixed"].training_objective
