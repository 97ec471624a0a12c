"""A loss of one's own: its value, its gradient, what it must not return."""

import numpy as np
import pytest

from tests.optimisation.test_missed import POSE, objective_of, scenes_of
from warpav.core.errors import InputError
from warpav.optimisation import YAW_RAD, ExpectedMissRate


def misses(probability, objects):
    """What `ExpectedMissRate` is, in NumPy: the expected number of missed objects."""
    assert probability.shape == (2, len(objects.category)) == (2, len(objects.from_ego_m))
    missed = 1.0 - probability
    return missed.prod(axis=0).sum(), -missed[::-1]


def test_a_function_of_the_probabilities_is_as_good_as_a_kernel(device):
    pose, scenes = POSE.copy(), scenes_of(device, 10, 0, 4)
    pose[1, YAW_RAD] = 0.7
    ours = objective_of(device, others={"losses": [(0.5, misses)]}).evaluate(pose, scenes, gradient=True)
    built_in = objective_of(device, others={"losses": [(0.5, ExpectedMissRate())]}).evaluate(
        pose, scenes, gradient=True
    )
    # the mean over three scenes, and that over their fourteen objects
    assert 3 * ours.terms["misses"] == pytest.approx(14 * built_in.terms["expected_miss_rate"], rel=1e-5)
    assert ours.total == pytest.approx(0.5 * ours.terms["misses"], rel=1e-6)
    assert np.abs(built_in.gradient).max() > 1e-3
    np.testing.assert_allclose(3 * ours.gradient, 14 * built_in.gradient, rtol=1e-4, atol=1e-6)


def test_losses_of_the_host_and_of_the_device_add_up(device):
    scenes = scenes_of(device, 10, 0, 4)

    def found(*losses):
        return objective_of(device, others={"losses": losses}).evaluate(POSE, scenes, gradient=True)

    def squares(probability, objects):
        del objects
        return (probability**2).sum(), 2.0 * probability

    alone = [found((0.3, ExpectedMissRate())), found((0.1, misses)), found((0.2, squares))]
    together = found((0.3, ExpectedMissRate()), (0.1, misses), (0.2, squares))
    assert together.total == pytest.approx(sum(each.total for each in alone), rel=1e-6)
    assert list(together.terms)[:3] == ["expected_miss_rate", "misses", "squares"]
    np.testing.assert_allclose(together.gradient, sum(each.gradient for each in alone), rtol=1e-4, atol=1e-6)
    again = objective_of(device, others={"losses": [(0.3, ExpectedMissRate()), (0.1, misses), (0.2, squares)]})
    rig = again.mount.rig(POSE)
    _, _, observed, _ = again.observe_rig(rig, scenes[0])
    assert observed == pytest.approx(again.evaluate(POSE, scenes[:1]).objective, rel=1e-4)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda p, _: p.sum(), "expected a number and its gradient, got float64"),
        (lambda p, _: (p.sum(), p[0]), r"expected a gradient of shape \(2, 10\), \[camera, object\], got \(10,\)"),
        (lambda p, _: (np.nan, p), "expected finite numbers, got a loss of nan on street_0"),
    ],
)
def test_what_a_loss_must_not_return(function, message):
    with pytest.raises(InputError, match=f"losses: <lambda>: {message}"):
        objective_of(others={"losses": [(1.0, function)]}).evaluate(POSE, scenes_of("cpu", 10, 0, 4), gradient=True)


@pytest.mark.parametrize(
    ("losses", "error", "message"),
    [
        ([(1.0, 3)], TypeError, "losses: expected losses or functions, got 3"),
        ([], InputError, "losses: expected at least one of weight above 0, got none"),
        ([(0.0, misses)], InputError, "losses: expected at least one of weight above 0, got none"),
        ([(-1.0, misses)], InputError, "losses: misses: expected a weight of at least 0"),
        ([(1.0, misses), (2.0, misses)], InputError, "expected a name of its own for each, got misses twice"),
    ],
)
def test_losses_that_cannot_be_added_up(losses, error, message):
    with pytest.raises(error, match=message):
        objective_of(others={"losses": losses})
