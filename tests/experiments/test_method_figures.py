"""Figures of rigs: what they tell against the rigs and scenes that they show, and their words on the command line."""

import math
import re

import numpy as np
import pytest

from tests.experiments import small_experiment
from tests.optimisation.objectives import evaluate_rig
from tests.view.stand_ins import pixels, rig
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.experiments import draw_method_figure
from warpav.rig import Rig
from warpav.runs import Placement, RunDisplay, RunFolder, find_rig, load_scenes
from warpav.view._palette import MISS_RGB, TRUE_POSITIVE_RGB, camera_rgb
from warpav.view.figures import _rigs as rigs
from warpav.view.figures._rigs import covered_rad

WIDE_STEPS = "optimiser.learning_rate_position_m=4"  # the surface is 2 m wide
# large enough, and asking for little enough, that something is found
SEEN = ("camera.width_px=160", "camera.height_px=160", "detector.confidence_min=0.02", "detector.iou_min=0.2")


@pytest.fixture
def drawn(monkeypatch):
    """Matplotlib's figures of what was drawn, to read their texts."""
    figures = []

    def save(figure, path, real=rigs.save_figure):
        figures.append(figure)
        return real(figure, path)

    monkeypatch.setattr(rigs, "save_figure", save)
    return figures


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("figures") / "scenes"


@pytest.fixture(scope="module")
def run(folder):
    """A run whose steps lead off the vehicle, and back."""
    out = folder.parent / "run"
    short = ("run.iterations=3", "baselines.random_samples=1")
    words = small_experiment.overrides(folder, *SEEN, WIDE_STEPS, *short, f"run.out={out}")
    assert main(["optimise", "thesis", *words]) == 0
    return RunFolder.open(out)


def draw(number, path, config, run=None):
    with RunDisplay() as display:
        return draw_method_figure(number, path, config, run=run, progress=display)


def count(image, rgb, tolerance=12.0):
    return int((np.linalg.norm(image - np.asarray(rgb, float), axis=-1) < tolerance).sum())


def lines(axis, colour_index):
    """x and y of the lines in a camera's colour, those of more than one point."""
    from warpav.view._palette import hex_colour

    colour = hex_colour(camera_rgb(colour_index))
    return [line.get_xydata() for line in axis.lines if line.get_color() == colour and len(line.get_xydata()) > 1]


# -------------------------------------------------------------------------------------------- without constraints: 10


def test_without_constraints_cameras_leave_the_surface_and_with_them_they_do_not(folder, tmp_path, drawn):
    draw(10, tmp_path / "10.png", small_experiment.config(folder, WIDE_STEPS, "run.iterations=3"))
    free, kept = drawn[0].axes[:2]
    assert free.get_title("left") == "Without constraints"
    told = re.fullmatch(r"([12]) of 2 cameras end outside, by up to ([0-9.]+) m", free.get_xlabel().splitlines()[1])
    assert told
    assert float(told[2]) > 1.0  # steps of metres
    assert kept.get_xlabel().endswith("\n0 of 2 cameras end outside")
    for index in range(2):
        ways = [lines(axis, index) for axis in (free, kept)]
        assert all(len(way[0]) == 4 for way in ways)  # three steps
        assert ways[0][0][0] == pytest.approx(ways[1][0][0])  # from one start


def test_the_way_with_constraints_is_that_of_the_run(run, tmp_path, drawn):
    draw(10, tmp_path / "10.png", run.config(), run)
    kept = drawn[0].axes[1]
    for index in range(2):
        expected = [event["positions_m"][index][1::-1] for event in run.events()]  # the front is up
        assert lines(kept, index)[0] == pytest.approx(np.array(expected))
        assert lines(drawn[0].axes[0], index)[0][0] == pytest.approx(np.array(expected[0]), abs=1e-5)


def test_a_run_of_one_step_shows_no_way(run, tmp_path):
    short = tmp_path / "short"
    short.mkdir()
    (short / "config.yaml").write_bytes((run.path / "config.yaml").read_bytes())
    (short / "rig_initial.yaml").write_bytes((run.path / "rig_initial.yaml").read_bytes())
    first = (run.path / "events.jsonl").read_text().splitlines()[0]
    (short / "events.jsonl").write_text(first + "\n")
    with pytest.raises(InputError, match="expected at least two iterations"):
        draw(10, tmp_path / "10.png", run.config(), RunFolder.open(short))


# ------------------------------------------------------------------------------------- before and after 11, highest 12


def found_of(config, rig_shown, scenes):
    """How many road users the evaluation says that a rig finds."""
    with RunDisplay() as display:
        problem = Placement.from_config(config).prepare(display)
    chosen = problem.train if scenes == "train" else problem.test
    metrics = evaluate_rig(rig_shown, chosen, problem.objective)
    return f"{round(metrics.tp_detection_rate * metrics.objects)} of {metrics.objects} found in {len(chosen)} scenes"


def test_views_before_and_after_count_what_the_evaluation_counts(run, tmp_path, drawn):
    config = run.config()
    image = pixels(draw(11, tmp_path / "11.png", config, run))
    axes = drawn[0].axes
    rows = [axes[3 * k : 3 * k + 3] for k in range(3)]  # a plan and two cameras
    assert [row[0].get_ylabel() for row in rows] == ["Start", "Optimised", "On test scenes"]
    shown = [row[0].get_title("left") for row in rows]
    started, ended = (
        find_rig(str(run.path / f"rig_{role}.yaml"), config, next(load_scenes(config, (0,))).ego)
        for role in ("initial", "final")
    )
    assert shown == [
        found_of(config, started, "train"),
        found_of(config, ended, "train"),
        found_of(config, ended, "test"),
    ]
    assert count(image, MISS_RGB, 30.0) > 50  # six of ten are found at the start
    for index in range(2):
        assert count(image, camera_rgb(index)) > 1000  # the frames of its images


def test_the_highest_rig_covers_all_round_and_finds_what_the_evaluation_counts(folder, tmp_path, drawn):
    config = small_experiment.config(folder, *SEEN, "rig.cameras=5", "camera.fov_deg=80")
    image = pixels(draw(12, tmp_path / "12.png", config))
    near, around, *views = drawn[0].axes
    assert near.get_title("left") == "Cameras around the highest point"
    highest = find_rig("highest", config, next(load_scenes(config, (2,))).ego)
    assert around.get_title("left") == found_of(config, highest, "test")
    assert [bool(axis.get_title("left")) for axis in views] == [True] * 5 + [False] * 3  # two rows
    (legend,) = drawn[0].legends
    assert "cover 360 of 360 degrees" in legend.get_title().get_text()
    assert count(image, TRUE_POSITIVE_RGB, 30.0) > 50


@pytest.mark.parametrize(
    ("fov_deg", "turn_deg", "expected_deg"),
    [
        (90.0, (0, 90, 180, 270), 360.0),
        (80.0, (0, 90, 180, 270), 320.0),
        (90.0, (0, 0), 90.0),
        (90.0, (350, 80), 180.0),
        (120.0, (170, 200, 10), 270.0),
        (60.0, (-180, 180), 60.0),
    ],
)
def test_covered_angle_is_that_of_the_union(fov_deg, turn_deg, expected_deg):
    sample = rig(1, fov_deg=fov_deg).cameras[0]
    cameras = [
        type(sample)(f"c{k}", sample.position_m, math.radians(t), 0.0, 0.0, sample.model)
        for k, t in enumerate(turn_deg)
    ]
    # worst seen 6e-14 degrees
    assert math.degrees(covered_rad(Rig(cameras))) == pytest.approx(expected_deg, abs=1e-9)


# -------------------------------------------------------------------------------------------------- the command line


def test_the_highest_rig_takes_no_run(run, tmp_path, capsys):
    out = tmp_path / "12.png"
    assert main(["scenes", "figure", "12", "--out", str(out), "--run", str(run.path)]) == 2
    assert "the highest rig needs none" in capsys.readouterr().err
    assert not out.exists()


def test_a_figure_of_a_run_is_drawn_by_the_command(run, tmp_path, capsys):
    out = tmp_path / "new" / "11.png"
    assert main(["scenes", "figure", "11", "--out", str(out), "--run", str(run.path)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"wrote {out}"
    assert [file.name for file in out.parent.iterdir()] == ["11.png"]
