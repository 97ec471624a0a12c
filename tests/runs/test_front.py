"""What a front is compared by."""

import pytest

import warpav as wa
from warpav.core.progress import NullProgress
from warpav.runs.config import Config, load_config

SMALL = ["camera.width_px=64", "camera.height_px=64", "optimiser.pool_cameras=16", "optimiser.pool_rounds=0"]


@pytest.mark.parametrize(("requirements", "counts"), [(None, False), ("near_field", True)])
def test_the_near_field_counts_where_it_is_asked_for_alone(requirements, counts):
    placement = wa.Placement(
        wa.town([1]),
        cameras="1..2",
        requirements=requirements,
        config=load_config(Config(), [*SMALL, "run.batch_size=1", "run.iterations=3"], origin=None),
    )
    found = wa.front(placement)
    assert ("points of the requirements together" in str(found.table())) is counts
    for point in found.points:
        seen = placement.with_config(load_config(placement.config, [f"rig.cameras={len(point.rig.cameras)}"]))
        probability = seen.detection_probabilities(point.rig)
        missed = float((1.0 - probability.clip(max=0.9999)).prod(axis=0).mean())
        if counts:
            missed = (
                missed + 0.1 * (1.0 - wa.check_requirements(point.rig, seen.ego, "near_field").outcomes[0].share)
            ) / 1.1
            assert point.objective == pytest.approx(missed, abs=0.03)  # points that are nearly met count in part
        else:
            assert point.objective == pytest.approx(missed, abs=1e-4)


class Unloaded(NullProgress):
    def steps(self, description, items, *, count):
        raise AssertionError(description)


@pytest.mark.parametrize(
    ("by", "message"),
    [("cost", "rig.modules: expected modules with prices"), ("cameras", "rig.cameras: expected a range")],
)
def test_the_question_is_checked_before_scenes_are_loaded(by, message):
    with pytest.raises(wa.InputError, match=message):
        wa.front(wa.Placement(wa.town([1])), by=by, progress=Unloaded())
