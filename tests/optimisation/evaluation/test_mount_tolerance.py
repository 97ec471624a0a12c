"""What errors of mounting cost: against renders of rigs that are off, one by one."""

import importlib
import math

import numpy as np
import pytest

import warpav as wa
from tests.optimisation.test_modules import cameras_of as mixed_cameras
from tests.optimisation.test_modules import columns, spread, symmetric_cameras
from tests.optimisation.test_pool import cameras_of, mount_of, poses_of, streets
from warpav.core.errors import InputError
from warpav.optimisation import HEIGHT_DELTA_M, CameraOutages, MountErrors, MountTolerance, PosedRig
from warpav.optimisation.evaluation._perturbations import COLUMNS
from warpav.raster.camera import CameraModel
from warpav.view import sensitivity_figure

MODEL = CameraModel(128, 128, math.pi / 2)
NAMES = ("front", "left", "rear")
CAMERAS = cameras_of(mount=mount_of(model=MODEL))
POSE = poses_of(3, CAMERAS.mount)
WEIGHT = np.linspace(0.5, 2.0, 10)


def tolerance_of(position_m=0.05, angle_rad=0.03, sample_count=4, scenes=None, cameras=CAMERAS, weight=None, **options):
    scenes = streets() if scenes is None else scenes
    rig, errors = PosedRig(NAMES, POSE, cameras, weight), MountErrors(position_m, angle_rad)
    return MountTolerance.of(rig, scenes, errors, sample_count=sample_count, seed=0, **options)


def misses(pose, weight=None):
    """Expected misses per 100, a rig at a time and object by object."""
    found = np.concatenate(
        [CAMERAS.detection_probability(np.asarray(pose, np.float32), scene) for scene in streets()], axis=1
    )
    missed = [math.prod(1.0 - float(p) for p in column) for column in found.T]
    return 100.0 * float(np.average(missed, weights=weight))


@pytest.mark.parametrize("weight", [None, WEIGHT])
def test_every_effect_is_that_of_a_rig_that_is_off(weight):
    found = tolerance_of(weight=weight)
    nominal = misses(POSE, weight)
    assert found.nominal == pytest.approx(nominal, abs=1e-6)
    assert [(effect.camera, effect.degree) for effect in found.effects] == [(n, d) for n in NAMES for d in COLUMNS]
    for effect in found.effects:
        off = 0.03 if effect.degree in ("yaw", "pitch", "roll") else 0.05
        for sign, change in ((-1.0, effect.below), (1.0, effect.above)):
            pose = POSE.astype(np.float64)
            pose[NAMES.index(effect.camera), COLUMNS[effect.degree]] += sign * off
            assert change == pytest.approx(misses(pose, weight) - nominal, abs=1e-5)
    assert found.worst.worst == max(max(effect.below, effect.above) for effect in found.effects)
    assert found.worst.worst > 0.1


def test_derivatives_are_those_of_small_errors():
    """In finer images fewer objects come into sight within a centimetre, where there is no derivative."""
    cameras = cameras_of(mount=mount_of(model=CameraModel(256, 256, math.pi / 2)))
    small = tolerance_of(position_m=0.01, angle_rad=0.01, sample_count=1, cameras=cameras)
    slope = np.array([effect.per_unit for effect in small.effects])
    difference = np.array([(effect.above - effect.below) / 0.02 for effect in small.effects])
    assert np.abs(difference).max() > 100.0
    assert np.corrcoef(slope, difference)[0, 1] > 0.98  # .9956


def test_draws_stay_within_the_tolerance_and_repeat():
    few, many = tolerance_of(sample_count=3), tolerance_of(sample_count=8)
    np.testing.assert_array_equal(few.samples, many.samples[:3])
    tiny = tolerance_of(position_m=1e-6, angle_rad=1e-6, sample_count=3)
    np.testing.assert_allclose(tiny.samples, tiny.nominal, atol=1e-2)
    assert np.ptp(many.samples) > 0.05


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"position_m": 0.0}, "position_m: expected a positive number, got 0.0"),
        ({"angle_rad": math.nan}, "angle_rad: expected a finite number of at least 0, got nan"),
        ({"sample_count": 0}, "sample_count: expected a positive number, got 0"),
        ({"scenes": streets()[1:2]}, "scenes: expected at least one object, got none"),
    ],
)
def test_what_cannot_be_is_one_line(options, words):
    with pytest.raises(InputError, match=words):
        tolerance_of(**options)


def test_the_public_call_takes_a_rig_and_scenes():
    scenes = wa.town(range(2))
    placement = wa.Placement(scenes, cameras=2)
    rig = wa.highest_rig(placement)
    found = wa.robustness.mount_tolerance(rig, wa.town([1000]), placement, sample_count=4)
    assert {effect.camera for effect in found.effects} == {camera.name for camera in rig.cameras}
    assert found.position_m == 0.02
    assert found.angle_rad == pytest.approx(math.radians(1.0))
    assert 0.0 < found.nominal < 100.0
    thesis = wa.Placement(scenes, cameras=2, losses={"detected_area": 1.0})
    with pytest.raises(InputError, match="losses: expected the expected_miss_rate alone"):
        wa.robustness.mount_tolerance(rig, wa.town([1000]), thesis)


def test_the_figure_has_every_change_and_every_loss(tmp_path):
    importlib.import_module("warpav.runs.robustness")  # as whoever has a tolerance did
    found = tolerance_of()
    detected = np.concatenate([CAMERAS.detection_probability(POSE, scene) for scene in streets()], axis=1)
    outages = CameraOutages.of(NAMES, detected)
    figure = sensitivity_figure(found, outages)
    cells = {text.get_text() for text in figure.axes[0].texts}
    assert {f"{effect.worst:+z.2f}" for effect in found.effects} == cells
    assert [bar.get_width() for bar in figure.axes[1].patches] == [each.difference_per_100 for each in outages.cameras]
    [image] = figure.axes[0].images
    worst = np.unravel_index(np.argmax(image.get_array()), image.get_array().shape)
    assert (NAMES[worst[0]], list(COLUMNS)[worst[1]]) == (found.worst.camera, found.worst.degree)
    for name, drawn, options in (("both", found, {"outages": outages}), ("off", found, {}), ("lost", outages, {})):
        assert wa.plot(drawn, out=tmp_path / f"{name}.svg", **options).read_text().startswith("<?xml")
    with pytest.raises(ValueError, match="of the same cameras"):
        sensitivity_figure(found, CameraOutages.of(("a", "b", "c"), detected))


def test_errors_inwards_end_at_the_skin():
    """A camera behind the skin would be as good as lost: one that is flush with it is off outwards alone."""
    cameras, pose = mixed_cameras(), spread()[[0, 20, 40]].copy()
    pose[:, HEIGHT_DELTA_M] = 0.0, 0.03, 0.005
    scenes = streets()
    errors = MountErrors(0.02, 0.01)
    found = MountTolerance.of(PosedRig(NAMES, pose, cameras), scenes, errors, sample_count=16, seed=0)
    below = {effect.camera: effect.below for effect in found.effects if effect.degree == "z"}

    def missed(camera, height_m):
        moved = pose.copy()
        moved[camera, HEIGHT_DELTA_M] = height_m
        detected = np.concatenate([cameras.detection_probability(moved, each) for each in scenes], axis=1)
        return 100.0 * float(np.prod(1.0 - detected.astype(np.float64), axis=0).mean())

    assert below["front"] == 0.0
    assert below["left"] == pytest.approx(missed(1, 0.01) - found.nominal, abs=1e-4)
    assert below["rear"] == pytest.approx(missed(2, 0.0) - found.nominal, abs=1e-4)
    # without that, a camera would be lost at once
    lost = CameraOutages.of(
        NAMES, np.concatenate([cameras.detection_probability(pose, each) for each in scenes], axis=1)
    )
    inside = missed(0, -0.02) - found.nominal
    assert inside == pytest.approx(lost.cameras[0].difference_per_100, abs=0.5)
    assert inside > 1.0


def test_cameras_of_pairs_are_off_one_by_one():
    """As on a mount that knows no pairs; there the cameras may stand in other zones, with x, y and z of their own."""
    cameras = symmetric_cameras()
    seen = cameras.detection_probability(columns(), streets()[0]).sum(axis=1)
    first = columns()[np.argsort(-seen)]
    is_pair = cameras.mount.is_pair(first)
    pose = np.concatenate([first[is_pair][:2], first[~is_pair][:1]])
    rig = cameras.mount.rig(pose)
    names = [f"c{k}" for k in range(len(rig.cameras))]
    plain = mixed_cameras()
    options = {"errors": MountErrors(0.05, 0.03), "sample_count": 2, "seed": 0}
    found = MountTolerance.of(PosedRig(names, pose, cameras), streets(), **options)
    expected = MountTolerance.of(PosedRig(names, plain.mount.mount_pose_of_rig(rig), plain), streets(), **options)
    assert len(rig.cameras) == 5
    assert found.nominal == pytest.approx(expected.nominal, abs=1e-3)
    for one, other in zip(found.effects, expected.effects, strict=True):
        if one.degree in ("yaw", "pitch"):
            assert sorted((one.below, one.above)) == pytest.approx(sorted((other.below, other.above)), abs=2e-2), one
    assert found.worst.worst > 0.1
