"""A small run, and the line with which a command rejects its input."""

from warpav.cli.app import main

SMALL = [
    "scenes.train_seeds=[0, 1]",
    "scenes.test_seeds=[1000, 1001]",
    "run.batch_size=2",
    "run.iterations=3",
    "rig.cameras=2",
    "camera.width_px=96",
    "camera.height_px=96",
    "baselines.random_samples=2",
    "run.pictures=none",
    "optimiser.check_every=2",
    "optimiser.starts=2",
    # the detection probability would have to be fitted for so small a camera
    "losses={expected_miss_rate: 0, in_frame_rotation: 1, detected_area: 10}",
]


def complaint(capsys, *argv):
    """Run a command that must end with status 2, and return the one line that it leaves."""
    assert main(list(argv)) == 2
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    return lines[0]
