"""The guide's examples run as they are printed, and converge."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

GUIDE = Path(__file__).parents[2] / "docs" / "guide" / "rasteriser.md"


@pytest.fixture
def example(tmp_path):
    """Run the Python of one heading of the guide; its names."""

    def run(heading):
        (text,) = re.findall(rf"^#+ {re.escape(heading)}\n.*?^```python\n(.*?)^```$", GUIDE.read_text(), re.M | re.S)
        file = tmp_path / "example.py"
        file.write_text(text)
        return runpy.run_path(str(file))

    return run


def test_a_ball_behind_a_wall(example):
    found = example("The rasteriser on its own")
    frame = found["frame"]
    assert set(np.unique(frame.object_id.numpy())) == {-2, -1, 0}
    assert 0.0 < found["areas"].visible.numpy()[0, 0] < found["areas"].amodal.numpy()[0, 0]
    assert frame.depth_m.numpy().min() == pytest.approx(2.9, abs=1e-4)


def test_the_pose_of_a_box_from_its_silhouette_with_warp(example):
    found = example("Warp: the pose of an object from its silhouette")
    assert np.abs(found["pose"] - found["true_pose"]).max() < 0.005  # seen .0008


def test_the_pose_of_a_box_from_its_silhouette_with_pytorch(example):
    pytest.importorskip("torch")
    found = example("PyTorch: the same")
    assert (found["pose"] - found["true_pose"]).abs().max() < 0.005  # seen .0009
