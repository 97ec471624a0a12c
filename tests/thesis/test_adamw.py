"""AdamW against its algorithm in double precision and against PyTorch's."""

import numpy as np
import pytest

from tests.oracle import thesis
from warpav.thesis import AdamW

STEPS = 60


def gradients(rng, shape):
    """Noisy gradients of very different sizes, some exactly 0."""
    scale = 10.0 ** rng.uniform(-4, 2, shape)
    series = [(scale * (rng.normal(size=shape) + 0.5)).astype(np.float32) for _ in range(STEPS)]
    for gradient in series:
        gradient[0] = 0.0
    return series


def trajectory(optimiser, series, rate):
    values = []
    for gradient in series:
        optimiser.step(gradient, rate)
        values.append(np.array(optimiser.value))
    return np.array(values)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["descent", "ascent"])
def test_adamw_matches_algorithm(rng, sign):
    start = rng.normal(size=(4, 5)).astype(np.float32)
    series = gradients(rng, (4, 5))
    rate = np.full((4, 5), 0.25 * sign, np.float32)
    rate[:, 2] *= 0.1
    ours = trajectory(AdamW(start, weight_decay=1e-2), series, rate)
    expected = trajectory(thesis.AdamW(start, weight_decay=1e-2), series, rate)
    np.testing.assert_allclose(ours, expected, atol=2e-4)  # worst seen 1e-5 after 60 steps of float32
    assert np.abs(ours[-1] - start).max() > 1.0


@pytest.mark.slow  # PyTorch takes its time to load
@pytest.mark.parametrize("maximise", [False, True])
def test_adamw_matches_pytorch(rng, maximise):
    torch = pytest.importorskip("torch")
    start = rng.normal(size=6).astype(np.float32)
    series = gradients(rng, (6,))
    parameter = torch.nn.Parameter(torch.tensor(start))
    theirs = torch.optim.AdamW([parameter], lr=0.25, weight_decay=1e-3)
    expected = []
    for gradient in series:
        parameter.grad = torch.tensor(-gradient if maximise else gradient)  # what its option to maximise does
        theirs.step()
        expected.append(parameter.detach().numpy().copy())
    rate = np.full(6, -0.25 if maximise else 0.25, np.float32)
    ours = trajectory(AdamW(start, weight_decay=1e-3), series, rate)
    np.testing.assert_allclose(ours, expected, atol=2e-4)  # worst seen 1e-5
