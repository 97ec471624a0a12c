"""The front door to images for what runs come to: results of optimisations and evaluations."""

import numpy as np
import pytest
from PIL import Image

import warpav as wa
from tests.view.stand_ins import needs_opengl
from warpav.core.errors import InputError
from warpav.view import Canvas, drawing_of

SMALL = (160, 100)


@pytest.fixture(scope="module")
def placement():
    options = [
        "camera.width_px=64",
        "camera.height_px=64",
        "run.iterations=2",
        "run.batch_size=1",
        "optimiser.search=descent",
        "optimiser.starts=1",
    ]
    return wa.Placement(wa.town([3]), cameras=2, fov_deg=90.0, config=wa.Config.load("quick", *options))


@pytest.fixture(scope="module")
def result(placement):
    return wa.optimise(placement)


def pixels(path):
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


@needs_opengl
def test_a_result_is_its_rig_with_trajectories_and_arrows(result, tmp_path):
    plotter = drawing_of(result, Canvas(off_screen=True, window_size=SMALL))
    try:
        names = set(plotter.actors)
        assert {f"rig/{camera.name}/body" for camera in result.rig.cameras} <= names
        assert any(name.startswith("trajectory/") for name in names)
        assert any(name.startswith("descent/") for name in names)
        assert "scene/ground" in names
    finally:
        plotter.close()
    assert result.plot(tmp_path / "result.png", window_size=SMALL, arrows=False) == tmp_path / "result.png"
    wa.plot(result, out=tmp_path / "street.png", window_size=SMALL, arrows=False, scene=wa.town([4])[0])
    assert np.abs(pixels(tmp_path / "result.png") - pixels(tmp_path / "street.png")).mean() > 1.0
    with pytest.raises(InputError, match="result: iteration: expected one of 2 from 0, got 2"):
        wa.plot(result, out=tmp_path / "x.png", iteration=2)


@needs_opengl
def test_an_animation_of_a_result_ends_with_it(result, tmp_path):
    wa.plot(result, out=tmp_path / "result.gif", window_size=SMALL)
    with Image.open(tmp_path / "result.gif") as shown:
        assert (shown.n_frames, shown.size) == (3, SMALL)  # two iterations and the result


def test_an_evaluation_is_a_figure_of_what_is_detected_and_of_differences(placement, result, tmp_path):
    rigs = {"optimised": result.rig, "start": result.start, "by_hand": wa.highest_rig(placement)}
    evaluation = wa.evaluate(rigs, wa.town([1000, 1001]), placement)
    [axis] = drawing_of(evaluation, Canvas(), kind="differences").axes
    assert [label.get_text() for label in axis.get_yticklabels()] == ["than start", "than by hand"]
    shown = [line.get_xdata()[0] for line in axis.lines if line.get_marker() == "o"]
    fewer = [evaluation.misses[name] - evaluation.misses["optimised"] for name in ("start", "by_hand")]
    np.testing.assert_allclose(shown, fewer, atol=1e-9)
    figure = drawing_of(evaluation, Canvas())
    titles = [axis.get_title("left") for axis in figure.axes]
    assert titles == ["By distance [m]", "By sector", "By class"]
    for axis, by in zip(figure.axes, ("distance_m", "sector", "category"), strict=True):
        groups = evaluation.metrics["start"].recall_by[by]
        shown = [f"{name}  ({group.objects})" for name, group in groups.items() if group.objects]
        assert [label.get_text() for label in axis.get_yticklabels()] == shown
        drawn = {line.get_label(): line.get_xdata() for line in axis.lines}
        expected = [group.recall for group in groups.values() if group.objects]
        np.testing.assert_allclose(drawn["start"], expected)
    assert wa.plot(evaluation, out=tmp_path / "recall.png") == tmp_path / "recall.png"
    assert pixels(tmp_path / "recall.png").std() > 5.0
