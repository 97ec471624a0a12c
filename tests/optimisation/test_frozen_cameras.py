"""Cameras that stay as they are: exactly, wherever they stand, while the others are optimised around them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.driving_scene import roof
from tests.optimisation.objectives import rig_objective, thesis_losses
from tests.thesis.test_descent import WholeImageDetector, changed, street_scenes
from warpav.detection import FEATURES, DetectionProbability
from warpav.optimisation import (
    HEIGHT_DELTA_M,
    LOG_ZOOM,
    X_M,
    Y_M,
    YAW_RAD,
    CameraMount,
    FreeRanges,
    LossSchedule,
    LossSettings,
    SearchSpace,
    ZoneAndSpacing,
)
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.rig import Rig, RigCamera, read_rig, write_rig
from warpav.thesis import Descent

MODEL = CameraModel(64, 64, math.pi / 2)
WIDE = CameraModel(64, 64, math.radians(120.0))
NARROW = CameraModel(64, 64, math.radians(40.0))


def camera(name, position_m, yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0, model=MODEL):
    return RigCamera(name, np.array(position_m), *map(math.radians, (yaw_deg, pitch_deg, roll_deg)), model)


# one in the bumper, below the surface and outside of it, tilted all ways; one on the roof; one on a mast
BUMPER = camera("bumper", [3.9, -0.2345, 0.51], 12.3, -4.5, 6.7, WIDE)
ROOF = camera("roof", [0.6, 0.4, 1.77], 91.0)
MAST = camera("mast", [0.7, -0.3, 2.6], -170.0, 10.0, model=NARROW)


def frozen_mount(*cameras, names=("bumper",), free=None, model=MODEL, surface=None):
    mount = CameraMount(surface or roof(), camera=model, height_offset_m=0.25, free=free)
    return mount.freezing(Rig(cameras or (BUMPER, ROOF)), names)


def constraints_of(mount, **options):
    count = len(mount.frozen.is_frozen)
    return ZoneAndSpacing(mount.surface, camera_count=count, margin_m=0.02, frozen=mount.frozen, **options)


def objective_of(mount):
    return rig_objective(
        mount,
        WholeImageDetector(),
        camera_count=len(mount.frozen.is_frozen),
        settings=LossSettings(expected_miss_rate=1.0),
        multiplier_damping=10.0,
        constraints=constraints_of(mount),
        iou_min=0.01,
        probability=size_alone(),
    )


def size_alone():
    """The chance grows with the visible size."""
    coefficient = np.zeros((len(FEATURES), 4))
    coefficient[0] = [-2.0, 0.0, 2.0, 4.0]
    return DetectionProbability(np.zeros(len(FEATURES)), np.full(len(FEATURES), 2.0), coefficient, -1.0)


# --- the mount ------------------------------------------------------------------------------------------------------


def test_what_is_held_is_the_same_to_the_last_bit_whatever_the_pose(rng, tmp_path):
    mount = frozen_mount(MAST, ROOF, BUMPER, names=("bumper", "mast"))
    for k in range(5):
        rig = mount.rig(rng.normal(0.0, 2.0, (3, 7)) * [1, 1, 1, 1, 1, 1, 0])
        assert [each.name for each in rig.cameras] == ["mast", "roof", "bumper"]
        write_rig(rig, tmp_path / f"{k}.yaml")
    write_rig(Rig((MAST, ROOF, BUMPER)), tmp_path / "start.yaml")
    blocks = [(tmp_path / f"{name}.yaml").read_text().split("  - name: ") for name in (*range(5), "start")]
    for kept in (1, 3):
        assert len({block[kept] for block in blocks}) == 1
    assert len({block[2] for block in blocks}) == 6
    read = read_rig(tmp_path / "0.yaml").cameras[2]
    np.testing.assert_array_equal(read.position_m, BUMPER.position_m)


def test_another_lens_cannot_be_held():
    fisheye = CameraModel(64, 64, math.radians(190.0), lens=Lens.FISHEYE)
    for model in (CameraModel(64, 32, math.pi / 2), fisheye):
        with pytest.raises(ValueError, match="camera 'odd' must differ from the mount's in zoom alone"):
            frozen_mount(camera("odd", [0.5, 0.0, 1.8], model=model), ROOF, names=("odd",))
    other = CameraModel(64, 64, math.radians(150.0), lens=Lens.FISHEYE, distortion=(0.01, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="must differ from the mount's in zoom alone"):
        frozen_mount(camera("odd", [0.5, 0, 1.8], model=other), ROOF, names=("odd",), model=fisheye)


def test_losses_of_the_thesis_refuse_several_fields_of_view():
    with pytest.raises(ValueError, match="one field of view for all cameras, got several"):
        rig_objective(frozen_mount(), WholeImageDetector(), camera_count=2, settings=thesis_losses())
    same = frozen_mount(camera("bumper", BUMPER.position_m), ROOF)
    rig_objective(same, WholeImageDetector(), camera_count=2, settings=thesis_losses())


# --- constraints ----------------------------------------------------------------------------------------------------


def test_the_place_of_what_is_held_breaks_nothing_but_others_keep_away_from_it():
    pair = (camera("left", [0.6, 0.05, 1.75]), camera("right", [0.6, -0.05, 1.75]))
    mount = frozen_mount(*pair, BUMPER, ROOF, names=("left", "right", "bumper"))
    constraints = constraints_of(mount)
    assert constraints.names == ("zone_3", "spacing_0_3", "spacing_1_3", "spacing_2_3")
    assert constraints.violation_m(Rig((*pair, BUMPER, ROOF))) == 0.0
    near = camera("roof", [0.6, 0.15, 1.75])
    assert constraints.violation_m(Rig((*pair, BUMPER, near))) == pytest.approx(0.1, abs=1e-9)
    outside = camera("roof", [3.9, 0.5, 0.51])
    assert constraints.violation_m(Rig((*pair, BUMPER, outside))) > 1.0


@settings(max_examples=40)
@given(st.lists(st.floats(-3.0, 5.0), min_size=8, max_size=8), st.integers(0, 15))
def test_projections_go_around_what_is_held(numbers, which):
    rig = (MAST, ROOF, camera("other", [0.62, 0.5, 1.77]), BUMPER)
    names = [each.name for k, each in enumerate(rig) if which >> k & 1]
    if not 0 < len(names) < 4:
        return
    mount = frozen_mount(*rig, names=names)
    constraints = constraints_of(mount)
    space = SearchSpace.over(mount, 4, constraints=constraints)
    pose = np.zeros((4, 7))
    pose[:, [X_M, Y_M]] = np.reshape(numbers, (4, 2))
    found = space.feasible(pose)
    np.testing.assert_array_equal(found[mount.frozen.is_frozen], mount.frozen.mount_pose[mount.frozen.is_frozen])
    assert constraints.violation_m(mount.rig(found)) == 0.0
    np.testing.assert_allclose(space.feasible(found), found, atol=1e-6)


def test_random_places_keep_away_from_what_is_held(rng):
    mount = frozen_mount(ROOF, camera("a", [1, 0, 1.7]), camera("b", [1, 0.3, 1.7]), names=("roof",))
    constraints = constraints_of(mount, min_spacing_m=0.5)
    space = SearchSpace.over(mount, 3, constraints=constraints)
    for _ in range(20):
        pose = space.random(rng).astype(np.float32)
        np.testing.assert_array_equal(pose[0], mount.frozen.mount_pose[0])
        assert constraints.violation_m(mount.rig(pose)) == 0.0


# --- searches and starts --------------------------------------------------------------------------------------------


# --- the descent ----------------------------------------------------------------------------------------------------


def test_no_gradient_flows_to_it_and_that_of_the_others_is_as_without_holding():
    rig = Rig((ROOF, camera("bumper", BUMPER.position_m, 12.3, -4.5, 6.7)))
    mount = CameraMount(roof(), camera=MODEL, height_offset_m=0.25)
    frozen = mount.freezing(rig, ["bumper"])
    pose, scenes, stage = frozen.frozen.mount_pose, street_scenes(), LossSchedule(0.5, 0.0)
    objective = objective_of(frozen)
    found = objective.evaluate(pose, scenes, gradient=True, schedule=stage)
    free = rig_objective(
        mount,
        WholeImageDetector(),
        camera_count=2,
        settings=LossSettings(expected_miss_rate=1.0),
        constraints=ZoneAndSpacing(mount.surface, camera_count=2, margin_m=0.02),
        iou_min=0.01,
        probability=size_alone(),
    )
    # without multipliers the zone that the bumper is out of counts by its damping alone, and for itself
    expected = free.evaluate(pose, scenes, gradient=True, schedule=stage)
    np.testing.assert_array_equal(found.gradient[1], 0.0)
    assert np.abs(expected.gradient[1]).max() > 0.0
    assert np.abs(found.gradient[0, [X_M, Y_M, YAW_RAD]]).max() > 0.0
    np.testing.assert_array_equal(found.gradient[0], expected.gradient[0])
    assert found.objective == expected.objective
    assert "zone_1" not in found.terms
    assert set(found.terms) >= {"zone_0", "spacing_0_1"}


@pytest.mark.parametrize("free", [None, FreeRanges((-0.3, 0.3), (0.05, 0.6), (math.radians(60), math.radians(110)))])
def test_a_descent_leaves_it_alone_and_improves_the_others(free):
    rig = Rig((camera("roof", [1.2, 0.3, 1.75], 160.0), BUMPER))
    mount = CameraMount(roof(), camera=MODEL, height_offset_m=0.25, free=free).freezing(rig, ["bumper"])
    start = mount.within(mount.mount_pose_of_rig(rig, as_configured=True))
    further = start.copy()
    further[0, YAW_RAD] = -1.0
    descent = Descent(
        objective_of(mount),
        street_scenes(),
        changed(check_every=4, descents=2, starts=2, panorama_until=0.5),
        start,
        np.random.default_rng(0),
        16,
        2,
        further_starts=[further],
    )
    for _ in range(16):
        descent.step()
        np.testing.assert_array_equal(descent.mount_pose[1], mount.frozen.mount_pose[1])
    best = descent.finish()
    for each in descent.candidates:
        np.testing.assert_array_equal(each.mount_pose[1], mount.frozen.mount_pose[1])
    assert best.training_objective < descent.candidates[0].training_objective
    found = mount.rig(best.mount_pose)
    np.testing.assert_array_equal(found.cameras[1].ego_from_camera, BUMPER.ego_from_camera)
    assert found.cameras[1].model == WIDE
    assert descent.objective.constraints.violation_m(found) == 0.0
    assert mount.frozen.mount_pose[1, HEIGHT_DELTA_M] < -0.5
    assert mount.frozen.mount_pose[1, LOG_ZOOM] < -0.5  # wider than any other may be
