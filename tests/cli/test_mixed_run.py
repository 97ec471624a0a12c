"""Runs of rigs that mix modules, and fronts: ``warpav optimise rig.modules=...``, ``warpav front``."""

import json

import pytest

import warpav as wa
from tests.cli.small_run import complaint
from warpav.cli.app import main
from warpav.runs import front

pytestmark = pytest.mark.usefixtures("working_directory")

CATALOGUE = """
modules:
  - name: narrow
    sensor_px: [192, 96]
    fov_deg: 60
    housing: {size_m: [0.03, 0.03, 0.03]}
    price: {value: 2, unit: relative}
    power_w: null
    zones: [roof, bumper]
    source: made up
  - name: fisheye
    sensor_px: [128, 128]
    lens: fisheye
    fov_deg: 190
    housing: {size_m: [0.03, 0.03, 0.03]}
    price: {value: 1, unit: relative}
    power_w: null
    zones: []
    source: made up
"""
PLAIN = [
    "rig.catalogue=mine.yaml",
    "scenes.train_seeds=[0]",
    "scenes.test_seeds=[5000]",
    "run.batch_size=1",
    "optimiser.pool_cameras=16",
    "optimiser.pool_rounds=0",
    "baselines.random_samples=1",
    "run.pictures=none",
    "detector.confidence_min=0.25",
    "requirements=null",
]


@pytest.fixture
def catalogue(working_directory):
    (working_directory / "mine.yaml").write_text(CATALOGUE)
    euros = CATALOGUE.replace("name: fisheye", "name: euros").replace("1, unit: relative", "55, unit: EUR")
    (working_directory / "euros.yaml").write_text(euros)


@pytest.mark.usefixtures("catalogue")
def test_a_run_of_two_modules_leaves_a_whole_run_folder(working_directory, capsys):
    modules = "rig.modules={narrow: 1, fisheye: 1..2}"
    assert main(["optimise", "quick", modules, *PLAIN, "run.out=mixed"]) == 0
    folder = wa.read_run("mixed")
    rig = folder.rig("best")
    assert [camera.module for camera in rig.cameras].count("narrow") == 1
    assert {(camera.model.width_px, camera.model.height_px) for camera in rig.cameras} == {(192, 96), (128, 128)}
    assert (working_directory / "mixed" / "report.html").is_file()
    assert json.loads((working_directory / "mixed" / "evaluation.json").read_text())["arms"]["optimised"]["objects"] > 0
    assert folder.config().rig.catalogue.name == "modules.yaml"
    (working_directory / "mine.yaml").unlink()  # the folder needs no file from elsewhere
    assert main(["evaluate", "mixed", "--soiling", "disc", "0.5", "0.5", "0.2", "--load", "1", "0"]) == 0
    assert main(["inspect", "mixed", "--show", "gain", "--out", "gain.png"]) == 0
    assert main(["rig", "export", "mixed", "--format", "opencv", "--out", "opencv"]) == 0
    capsys.readouterr()


@pytest.mark.usefixtures("catalogue")
def test_a_front_by_number(working_directory, capsys):
    options = ["rig.modules={narrow: 0..1, fisheye: 0..2}", "rig.cameras=2..3", *PLAIN]
    assert main(["front", "quick", *options, "--out", "front"]) == 0
    found = json.loads((working_directory / "front" / "front.json").read_text())
    assert [point["cameras"] for point in found["points"]] == [2, 3]
    misses = [point["objective"] for point in found["points"]]
    assert misses == sorted(misses, reverse=True)
    for point in found["points"]:
        assert point["bound"] <= point["objective"] + 1e-6 or point["bound"] > 0.0
        assert sum(point["modules"].values()) == point["cameras"]
        assert point["cost"] == 2.0 * point["modules"].get("narrow", 0) + point["modules"].get("fisheye", 0)
        assert point["misses_per_100"] is not None
        rig = wa.read_rig(working_directory / "front" / f"rig_{point['name']}.yaml")
        assert len(rig.cameras) == point["cameras"]
    assert (working_directory / "front" / "front.png").stat().st_size > 10_000
    assert len(list((working_directory / "front").iterdir())) == 4
    assert "3 cameras" in capsys.readouterr().out
    message = complaint(capsys, "front", "quick", *options, "--out", "front")
    assert "expected a folder without front.json" in message


@pytest.mark.usefixtures("catalogue")
def test_a_front_by_cost_keeps_every_budget(monkeypatch):
    monkeypatch.setattr("warpav.runs._front._MOST_BUDGETS", 2)
    config = wa.Config.load("quick", *PLAIN)
    placement = wa.Placement(wa.town([0]), modules={"narrow": "0..1", "fisheye": (1, 2)}, config=config)
    found = front(placement, by="cost")
    budgets = [float(point.name.removeprefix("cost_")) for point in found.points]
    assert budgets == [1.0, 4.0]
    for point, budget in zip(found.points, budgets, strict=True):
        assert point.cost <= budget + 1e-3
        assert point.modules.get("fisheye", 0) >= 1
    objectives = [point.objective for point in found.points]
    assert objectives == sorted(objectives, reverse=True)
    assert found.scenes == ()
    assert found.points[0].misses_per_100 is None


@pytest.mark.usefixtures("catalogue")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["rig.modules={narow: 1}"], "rig.modules: expected modules out of narrow, fisheye, got 'narow'; did you mean"),
        (["rig.modules={narrow: 1}", "rig.cameras=4"], "rig.cameras: expected 1 to 1, as many as rig.modules allows"),
        (["rig.modules={narrow: 2}", "rig.max_cost=3"], "rig.max_cost: expected at least 4, what the cheapest rig"),
        (
            ["rig.modules={narrow: 2, euros: 1}", "rig.catalogue=euros.yaml", "rig.max_cost=30"],
            "rig.modules: expected prices of one unit, since they are added, got relative (narrow) and EUR (euros)",
        ),
        (["rig.modules={narrow: 1}", "rig.free.fov_deg=[50, 70]"], "rig.free.fov_deg: expected null, as every module"),
        (["rig.modules={narrow: 1}", "method=thesis"], "rig.modules: expected null, as the thesis has equal cameras"),
        (
            ["rig.modules={narrow: 1}", "optimiser.search=descent"],
            "rig.modules: expected null, as only the search by a",
        ),
        (["rig.modules={narrow: 4..1}"], "rig.modules: expected numbers from 0 to 16, the lower one first"),
    ],
)
def test_what_modules_cannot_be(capsys, options, message):
    assert message in complaint(capsys, "optimise", "quick", *PLAIN, *options, "run.out=run")
