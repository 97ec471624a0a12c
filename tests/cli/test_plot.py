"""``warpav plot``: rigs, runs and comparisons; what is wrong is said before anything is loaded."""

import os
from pathlib import Path

import pytest
from PIL import Image

import warpav as wa
from tests.cli.small_run import complaint
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.rig import Rig
from warpav.runs import RunFolder, asked_plots
from warpav.runs._drawn_run import COMPARED_KINDS, FITTING_KINDS, fitting
from warpav.scene import town_scene
from warpav.view import Canvas, drawing_of, kinds_of

pytestmark = pytest.mark.usefixtures("working_directory")


def test_a_preset_is_plotted(working_directory, capsys):
    assert main(["plot", "nuscenes", "--kind", "near_field", "--out", "new/near.svg"]) == 0
    assert capsys.readouterr().out == f"wrote {os.path.join('new', 'near.svg')}\n"
    assert (working_directory / "new" / "near.svg").read_text().startswith("<?xml")
    assert main(["plot", "nuscenes", "--kind", "near_field", "--beside", "highest", "--out", "two.png"]) == 0
    assert main(["plot", "nuscenes", "--kind", "resolution"]) == 0
    with Image.open("resolution.png") as image:
        assert image.width == 1350


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (
            ["nuscenes", "--kind", "plann"],
            "--kind): expected all, or a plot of a rig (view, sheet, plan, ground, range, near_field",
        ),
        (["nuscenes", "--kind", "plann"], "got 'plann'; did you mean plan?"),
        (["nuscenes", "--kind", "search"], "got 'search'; search is a plot of a run"),
        (["nope", "--kind", "plan"], "nope: rig: expected a rig YAML"),
        (["nuscenes", "--kind", "plan", "--beside", "nope"], "nope: rig: expected a rig YAML"),
        (["nuscenes", "--kind", "plan", "--out", "plan.gif"], "plan.gif: --out: expected a name that ends in .png"),
        (["nuscenes", "--kind", "view", "--out", "view.svg"], "view.svg: expected a name that ends in .png"),
        (["nuscenes", "--kind", "all", "--out", "plan.png"], "plan.png: --out: expected a folder for kind all"),
        (
            ["nuscenes", "--kind", "contact", "--beside", "edgar"],
            "expected all, or a plot of a comparison (plan, ground, range",
        ),
    ],
)
def test_what_cannot_be_is_said_before_anything_is_loaded(capsys, monkeypatch, argv, words):
    monkeypatch.setattr("warpav.runs._inspect.first_scene", lambda *_a, **_k: pytest.fail("loaded"))
    assert words in complaint(capsys, "plot", *argv)
    assert os.listdir() == []


def test_a_run_compares_its_start_with_its_result(run_folder):
    scene = town_scene(3)
    assert set(FITTING_KINDS) < set(kinds_of(RunFolder)) & set(kinds_of(Rig))
    assert tuple(kinds_of(dict)) == COMPARED_KINDS
    drawn = run_folder.drawn(scene=scene)
    assert list(drawn.rigs) == ["start", "found"]
    assert drawn.scene is scene
    figure = drawing_of(run_folder, Canvas(), kind="redundancy", scene=scene)
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    assert titles[::2] == ["start: all cameras", "found: all cameras", ""]
    sheet = drawing_of(run_folder, Canvas(), kind="contact", scene=scene)
    assert len([axis for axis in sheet.axes if axis.get_title(loc="left")]) == len(run_folder.rig().cameras)


def test_without_a_detector_there_is_no_range(run_folder):
    config = wa.Config.load("quick", "losses.probability=visible_share")
    with pytest.raises(InputError, match=r"expected losses.probability=fitted for 'range', got visible_share"):
        fitting("range", {"rig": run_folder.rig()}, town_scene(3), config)


def test_the_usual_file_has_the_name_of_its_kind():
    assert asked_plots("nuscenes", kind="plan") == {"plan": Path("plan.png")}
