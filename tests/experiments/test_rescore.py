"""Rigs of a study before other judges: rigs stay, what is there is not measured again, networks judge side by side."""

import json
import shutil

import pytest

from tests.cli.small_run import complaint
from tests.experiments.small_experiment import overrides
from warpav.cli.app import main
from warpav.detection import BUILTIN_MODEL_PATH
from warpav.experiments import _rescore as rescore
from warpav.experiments import read_rows

PLAIN = (
    *("losses.probability=visible_share", "optimiser.pool_cameras=16", "optimiser.selection_time_s=2"),
    *("camera.width_px=144", "camera.height_px=144"),
)
LARGER = ("camera.width_px=176", "camera.height_px=176")


@pytest.fixture(scope="module")
def opened(tmp_path_factory, scenes):
    """Folder of a small study; nobody may change it."""
    folder = tmp_path_factory.mktemp("open") / "run"
    words = ["--arms", "default,highest,nuscenes", "--budget", "100", "--runs", "2", "--out", str(folder)]
    assert main(["experiment", "open", *overrides(scenes, *PLAIN), *words]) == 0
    return folder


@pytest.fixture
def copied(working_directory, opened):
    return shutil.copytree(opened, working_directory / "run")


def test_rigs_are_rescored_and_stay_as_they_are(copied, capsys):
    before = {file.name: file.read_bytes() for file in (copied / "results").iterdir()}
    assert main(["experiment", "rescore", str(copied), *LARGER]) == 0
    assert {file.name: file.read_bytes() for file in (copied / "results").iterdir()} == before
    folder = copied / "rescored_176_176"
    for name, content in before.items():
        if name.endswith(".json"):
            old, new = json.loads(content), json.loads((folder / "results" / name).read_text())
            assert new["rig"] == old["rig"]
            assert new["metrics"]["objective"] is None
            assert new["metrics"]["constraint_violation"] == old["metrics"]["constraint_violation"]
            assert new["metrics"]["tp_in_frame_rate"] == pytest.approx(old["metrics"]["tp_in_frame_rate"], abs=0.11)
    assert {row["judge"] for row in read_rows(folder / "rows.csv")} == {"176_176"}
    capsys.readouterr()
    assert main(["experiment", "rescore", str(copied), *LARGER]) == 0
    shown = capsys.readouterr().out
    assert "4 of 4 results are in" in shown
    assert "0 new results" in shown


def test_every_network_of_a_panel_judges(copied, tmp_path, capsys):
    networks = tmp_path / "networks"
    networks.mkdir()
    for name in ("One", "other"):
        shutil.copy(BUILTIN_MODEL_PATH, networks / f"{name}.onnx")
    assert main(["experiment", "rescore", str(copied), "--panel", str(networks)]) == 0
    one, other = (read_rows(copied / f"rescored_networks_{name}" / "rows.csv") for name in ("one", "other"))
    assert {row["judge"] for row in one} == {"one"}
    assert [{**row, "judge": "", "search_seconds": ""} for row in one] == [
        {**row, "judge": "", "search_seconds": ""} for row in other
    ]
    own = {(row["arm"], row["seed"]): row["misses_per_100"] for row in read_rows(copied / "rows.csv")}
    assert all(row["misses_per_100"] == own[row["arm"], row["seed"]] for row in one if row["seed"])
    both = copied / "all.csv"
    folders = [str(copied), *(str(copied / f"rescored_networks_{name}") for name in ("one", "other"))]
    assert main(["experiment", "results", *folders, "--out", str(both)]) == 0
    assert {row["judge"] for row in read_rows(both)} == {"builtin", "one", "other"}
    page = copied / "page.md"
    page.write_text("# Page\n\n<!-- rows: arms open one -->\n<!-- end -->\n")
    assert main(["experiment", "results", str(both), "--out", str(page)]) == 0
    assert "| highest | 1 |" in page.read_text()
    assert "expected folders of studies" in complaint(capsys, "experiment", "results", "--out", str(both))


def test_results_of_another_judge_do_not_count(copied, monkeypatch):
    words = ["experiment", "rescore", str(copied), "--name", "new"]
    assert main([*words, "camera.width_px=176"]) == 0
    real = rescore.observe_scenes

    def fails_for_nuscenes(rig, *given, **options):
        if len(rig.cameras) == 6:
            raise ValueError("a judge that fails")
        return real(rig, *given, **options)

    monkeypatch.setattr(rescore, "observe_scenes", fails_for_nuscenes)
    assert main([*words, "camera.width_px=160"]) == 1
    assert {row["arm"] for row in read_rows(copied / "rescored_new" / "rows.csv")} == {"default", "highest"}


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["scenes.test_seeds=[17]"], "expected scene_17.glb"),
        (["rig.cameras=3"], "rig.cameras: expected an evaluation option"),
        ([], "expected evaluation options such as"),
        (["camera.width_px=99", "--name", "My name"], "(--name): expected lower-case letters"),
        (["--panel", "none"], "none"),
    ],
)
def test_what_does_not_fit_is_refused_before_rigs_are_looked_at(copied, capsys, words, told):
    assert told in complaint(capsys, "experiment", "rescore", str(copied), *words)
    assert not list(copied.glob("rescored*"))
