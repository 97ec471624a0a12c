"""A small run, and the line with which a command rejects its input."""

from warpav.cli.app import main
from warpav.optimisation import PoolRun
from warpav.thesis import Descent

SMALL = [
    "run.pictures=none",
    "scenes.train_seeds=[0, 1]",
    "scenes.test_seeds=[1000, 1001]",
    "run.batch_size=2",
    "run.iterations=3",
    "rig.cameras=2",
    "camera.width_px=96",
    "camera.height_px=96",
    "baselines.random_samples=1",
    "optimiser.check_every=2",
    "optimiser.starts=2",
    # the detection probability would have to be fitted for so small a camera
    "losses={expected_miss_rate: 0, in_frame_rotation: 1, detected_area: 10}",
]

FAST = [
    "run.pictures=none",
    *("scenes.train_seeds=[0, 1]", "scenes.test_seeds=[1000]", "run.batch_size=1", "baselines.random_samples=1"),
    *("camera.width_px=64", "camera.height_px=64", "rig.cameras=2"),
]
RESUMED_POOL = [
    *FAST,
    *("losses.probability=visible_share", "optimiser.pool_cameras=16", "optimiser.pool_rounds=1", "requirements=null"),
]
"""A small search by a pool."""
FEW = ["run.iterations=5", "optimiser.check_every=2", "optimiser.starts=2"]
RUNS = {
    "pool": (PoolRun, RESUMED_POOL),
    "descent": (Descent, [*FAST, *FEW, "losses={expected_miss_rate: 0, in_frame_rotation: 1, detected_area: 10}"]),
    "thesis": (Descent, [*FAST, *FEW, "method=thesis"]),
    "pool on a GPU": (PoolRun, [*RESUMED_POOL, "device=cuda:0"]),
    "descent on a GPU": (Descent, [*FAST, *FEW, "method=thesis", "device=cuda:0"]),
}
"""Runs that are compared with what they come to otherwise: what searches, and the options."""


def complaint(capsys, *argv):
    """Run a command that must end with status 2, and return the one line that it leaves."""
    assert main(list(argv)) == 2
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    return lines[0]
