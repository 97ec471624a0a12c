"""Runs from the command line: rigs, evaluation.json, the run folder, the report. Rigs agree to 1e-4 m and degrees."""

import json
import re

import pytest
import yaml

from tests.golden.conftest import numbers
from warpav.cli.app import main

SMALL = [
    *("scenes.train_seeds=[0, 1]", "scenes.test_seeds=[1000, 1001]", "rig.cameras=2", "baselines.random_samples=1"),
    *("camera.width_px=64", "camera.height_px=64", "run.iterations=3", "run.pictures=none"),
    "run.batch_size=2",
]
METHODS = {
    "pool": ["losses.probability=visible_share", "optimiser.pool_cameras=16", "optimiser.pool_rounds=1"],
    "descent": ["losses={expected_miss_rate: 0, in_frame_rotation: 1, detected_area: 10}", "optimiser.starts=2"],
    "thesis": ["method=thesis"],
}
CONTRACT = (
    *("config.yaml", "env.json", "events.jsonl", "metrics.csv", "rig_initial.yaml", "rig_best.yaml", "rig_final.yaml"),
    *("evaluation.json", "checkpoints/last.npz", "report.html"),
)
SECONDS = re.compile(r"second|_s$|time|version|warpav|python|date|commit")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    made = {}

    def run(name):
        if name not in made:
            made[name] = tmp_path_factory.mktemp(name) / "run"
            assert main(["optimise", *SMALL, *METHODS[name], f"run.out={made[name]}"]) == 0
        return made[name]

    return run


def timeless(value):
    """Without what differs from run to run: times and versions."""
    if isinstance(value, dict):
        return {key: timeless(each) for key, each in value.items() if not SECONDS.search(key.lower())}
    return [timeless(each) for each in value] if isinstance(value, list) else value


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("file", ["rig_initial", "rig_best", "rig_final"])
def test_the_rig(runs, golden, name, file):
    golden(f"{name}_{file}", yaml.safe_load((runs(name) / f"{file}.yaml").read_text()), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("name", METHODS)
def test_the_evaluation(runs, golden, name):
    found = json.loads((runs(name) / "evaluation.json").read_text())
    golden(f"{name}_evaluation", timeless(found), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", METHODS)
def test_the_folder_and_its_events(runs, golden, name):
    folder = runs(name)
    assert all((folder / file).is_file() for file in CONTRACT)
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    keep = ("iteration", "loss", "terms", "multipliers", "gradient_norm", "positions_m", "yaw_deg")
    golden(f"{name}_events", [{key: each[key] for key in keep if key in each} for each in events], rtol=1e-4, atol=1e-4)
    stages = {"total"} if name == "pool" else {"render", "detect", "backward", "total"}
    assert set(events[-1]["seconds"]) >= stages
    golden(f"{name}_metrics_columns", (folder / "metrics.csv").read_text().splitlines()[0].split(","))


@pytest.mark.parametrize("name", ["pool", "thesis"])
def test_the_report_states_the_evaluation(runs, name):
    page = (runs(name) / "report.html").read_text()
    text = re.sub(r"<(style|table|pre|details).*?</\1>|<[^>]*>", " ", page, flags=re.DOTALL)
    assert len(re.findall(r"[A-Za-z]{2,}", text)) <= 1200  # of sentences, headings and captions
    assert len(page) <= 2_000_000
    arms = json.loads((runs(name) / "evaluation.json").read_text())["arms"]
    row = page.partition("missed per 100, equal false alarms</th>")[2].partition("</tr>")[0]
    cells = [numbers(re.sub("<[^>]*>", " ", cell))[0] for cell in row.split("</td>")[:-1]]
    assert cells == [round(arm["misses_at_equal_false_alarms"], 1) for arm in arms.values()]
    assert "http://" not in page.replace("http://www.w3.org", "")


def test_a_run_goes_on_to_the_same_rig(runs, warpav, tmp_path):
    """A run told to stop early and then to go on ends where the whole one does."""
    short = tmp_path / "run"
    assert warpav("optimise", *SMALL, *METHODS["thesis"], "run.iterations=2", f"run.out={short}")[0] == 0
    assert warpav("optimise", "--resume", short, "run.iterations=3")[0] == 0
    assert (short / "rig_final.yaml").read_text() == (runs("thesis") / "rig_final.yaml").read_text()


def test_evaluate_writes_the_same_measures(runs, warpav, golden, tmp_path):
    out = tmp_path / "evaluation.json"
    assert warpav("evaluate", runs("pool"), "--beside", "highest", "--json", out)[0] == 0
    golden("evaluate_run", timeless(json.loads(out.read_text())), rtol=1e-4, atol=1e-5)
    assert warpav("evaluate", "nuscenes", "--json", out, *SMALL[:2], *SMALL[4:6], *METHODS["pool"][:1])[0] == 0
    golden("evaluate_preset", timeless(json.loads(out.read_text())), rtol=1e-4, atol=1e-5)
