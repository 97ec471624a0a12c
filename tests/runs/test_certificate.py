"""What a search by a pool has proven, from the search to the report: bounds over the pool, and one more camera."""

import itertools

import numpy as np
import pytest

import warpav as wa
from tests.cli.small_run import SMALL
from tests.detection.test_probability import model_of
from warpav.rig import Rig, RigCamera
from warpav.runs._events import Certificate
from warpav.runs.report.report import write_report
from warpav.view import opengl_problem

BASE = [
    *(each for each in SMALL if not each.startswith(("losses", "run.pictures"))),
    *("losses={expected_miss_rate: 1.0}", "rules=none", "rig.symmetric=false", "rig.start=random"),
    "requirements=null",
]
POOL = ["optimiser.search=pool", "optimiser.pool_cameras=16", "optimiser.pool_rounds=1", "run.iterations=60"]


def selected(bound, pool_cameras=20, camera_renders=100, stage="selection"):
    return {
        "stage": stage,
        "bound": bound,
        "pool_cameras": pool_cameras,
        "camera_renders": camera_renders,
        "training_objective": 0.25,
    }


def placement_of(*options, **changed):
    probability = model_of(np.random.default_rng(0), 0.3)
    config = wa.Config.load("quick", *BASE, *options)
    return wa.Placement(wa.town([0, 1]), config=config, probability=probability, **changed)


@pytest.fixture(scope="module")
def placement():
    return placement_of(*POOL)


@pytest.fixture(scope="module")
def result(placement):
    return wa.optimise(placement)


@pytest.fixture(scope="module")
def folder(result, tmp_path_factory):
    return wa.read_run(result.save(tmp_path_factory.mktemp("run") / "pool", test=wa.town([1000])))


# ------------------------------------------------------------------------------------------------ what is proven


def test_the_bound_holds_for_every_rig_of_the_pool(placement, result):
    pool = result._descent.found.pool
    count = result.pool_cameras
    found = np.minimum(pool.detection_probability[:count].astype(float), 0.9999)
    missed = 1.0 - found
    place_m = placement.mount.position_m(pool.mount_pose[:count])
    spacing_m = placement.objective.constraints.min_spacing_m
    best = min(
        float((missed[i] * missed[j]).mean())
        for i, j in itertools.combinations(range(count), 2)
        if np.linalg.norm(place_m[i] - place_m[j]) > spacing_m + 1e-6
    )
    assert 0.0 < result.bound <= best + 1e-9
    assert result.bound > best - 2.0 * placement.config.optimiser.pool_gap  # and says something
    assert result.gap == pytest.approx(result.records[-1].training_objective - result.bound)


def test_every_selection_has_a_bound_over_its_own_pool(result):
    bounds = result.certificate.bounds
    assert len(bounds) == sum(record.stage == "selection" for record in result.records) >= 2
    assert result.certificate.scenes == 2
    for before, after in itertools.pairwise(bounds):
        assert after.pool_cameras > before.pool_cameras
        assert after.camera_renders > before.camera_renders
    # between two selections the records keep the bound together with the pool that it is over, not the larger one
    for record in result.records:
        known = [each for each in bounds if each.camera_renders <= record.camera_renders]
        if record.stage == "start":
            assert record.bound is record.pool_cameras is None
        elif record.stage != "selection":
            assert (record.bound, record.pool_cameras) in [(each.bound, each.pool_cameras) for each in known]


def test_a_gap_is_negative_where_the_polish_went_further():
    found = Certificate.of([selected(0.3, 10), selected(None, None, 50, "start"), selected(0.28)], scenes=3)
    assert (found.bound, found.pool_cameras, len(found.bounds)) == (0.28, 20, 2)
    assert found.gap == pytest.approx(-0.03)


@pytest.mark.parametrize(
    "events",
    [
        [],
        [{"iteration": 0, "training_objective": 0.3}],
        [selected(None, None, 0, "start")],
        [{"stage": "selection", "bound": 0.1, "camera_renders": 3, "training_objective": 0.2}],  # an older version's
    ],
)
def test_without_a_selection_there_is_no_certificate(events):
    assert Certificate.of(events) is None


# ------------------------------------------------------------------------------------------------ one more camera


def test_the_gain_is_what_the_objective_of_the_larger_rig_says(placement, result):
    larger = placement_of(*POOL, cameras=3)
    further = result.further_cameras
    assert further.gain[0] > 0.0
    for k in (0, 3):
        one_more = RigCamera(
            "one_more", further.position_m[k], further.yaw_rad[k], further.pitch_rad[k], model=placement.mount.camera
        )
        objective, _ = larger.value_and_grad(Rig([*result.found.cameras, one_more]))
        assert result.found_objective - objective == pytest.approx(further.gain[k], abs=1e-5)


# ------------------------------------------------------------------------------------------------ the run folder


def test_a_folder_gives_back_what_was_proven(result, folder):
    assert folder.certificate() == result.certificate
    content = folder.evaluation()["certificate"]
    assert content["bound"] == result.bound
    assert content["gap"] == pytest.approx(result.gap)
    assert content["pool_cameras"] == result.pool_cameras
    assert content["scenes"] == 2
    assert len(content["bounds"]) == len(result.certificate.bounds)
    last = (folder.path / "metrics.csv").read_text().splitlines()
    assert dict(zip(last[0].split(","), last[-1].split(","), strict=True))["pool_cameras"] == str(result.pool_cameras)


def test_the_report_shows_both_and_says_of_what(folder, result):
    names = {figure.stem for figure in folder.figures()}
    assert names - {"rig"} == {"ground", "search", "detections"}
    assert ("rig" in names) == (opengl_problem() is None)
    page = write_report(folder).read_text(encoding="utf-8")
    assert page.count("<img") == len(names)
    assert "The best rig so far, and the bound (dashed), over camera renders" in page
    assert f"no rig of the {result.pool_cameras} rendered candidate cameras" in page
    assert "On the training scenes" in page
