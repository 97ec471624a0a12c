"""Tables of misses follow from the runs, and the second part of the protocol decides by its rules."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from tests.experiments.small_experiment import complaint
from warpav.cli.app import main
from warpav.core.errors import ArgumentError
from warpav.core.files import json_ready
from warpav.experiments import traffic_judgement, traffic_protocol
from warpav.experiments.arms import common_arms
from warpav.experiments.miss_table import OWN_JUDGE, MissTable, miss_goals, miss_table
from warpav.experiments.traffic_judgement import JudgedSetting, judge_traffic
from warpav.experiments.traffic_settings import ARMS, traffic_settings
from warpav.runs.environment import has_history, history

ROOT = Path(__file__).parents[2]
SCENES, OBJECTS, ATTAINABLE = 40, 10, 8
MISSED = {"default": 0.2, "highest": 0.5, "roof_edge": 0.45, "random_selected": 0.35, "cma": 0.4}
"""Share that each arm misses, of all alike."""


def runs_of(arm, missed, rng, seeds=range(10)):
    """Runs of an arm that misses about such a share of all road users."""
    runs = []
    for seed in [0] if arm in ("highest", "roof_edge") else seeds:
        found = rng.random((SCENES, OBJECTS)) >= missed
        of_all, of_some = 100.0 * (1.0 - found.mean(axis=1)), 100.0 * (1.0 - found[:, :ATTAINABLE].mean(axis=1))
        runs.append(
            {
                "arm": arm,
                "seed": seed,
                "objects_of_scene": [OBJECTS] * SCENES,
                "attainable": [[1] * ATTAINABLE + [0] * (OBJECTS - ATTAINABLE)] * SCENES,
                "metrics": {
                    "misses_per_100": float(of_all.mean()),
                    "per_scene": {
                        "objective": [missed] * SCENES,
                        "misses_per_100": of_all.tolist(),
                        "attainable_misses_per_100": of_some.tolist(),
                    },
                },
            }
        )
    return runs


def results(rng, **changed):
    return {arm: runs_of(arm, missed, rng) for arm, missed in {**MISSED, **changed}.items()}


# ------------------------------------------------------------------------------------------------ table and goals


def test_a_table_is_what_the_runs_say(rng):
    found = results(rng)
    table = miss_table("me", found, resamples=199)
    assert (table.objects, table.attainable, table.practice) == (SCENES * OBJECTS, SCENES * ATTAINABLE, "roof_edge")
    mean = {
        arm: np.mean([run["metrics"]["per_scene"]["attainable_misses_per_100"] for run in runs])
        for arm, runs in found.items()
    }
    for row in table.rows:
        assert row.misses["attainable_misses"].mean == pytest.approx(mean[row.arm])
        assert row.misses["expected_misses"].mean == pytest.approx(100.0 * MISSED[row.arm])
        if row.arm != "default":
            less = row.less["attainable_misses"]
            assert less.mean == pytest.approx(mean[row.arm] - mean["default"])
            assert less.low < less.mean < less.high
            assert less.p_holm >= less.p_value
            assert (row.wins, row.compared) == (10, 10)
        assert set(row.reductions) == {"highest", "roof_edge"} - {row.arm}
        for practice, reduction in row.reductions.items():
            assert reduction.mean == pytest.approx(1.0 - mean[row.arm] / mean[practice])
            assert reduction.low < reduction.mean < reduction.high
    assert table.reduction_p < 0.01
    assert "% fewer attainable than highest | % fewer attainable than roof_edge" in table.text.markdown()
    assert MissTable.from_data(json.loads(json.dumps(json_ready(table)))) == table


def test_results_that_do_not_know_what_can_be_found_have_no_table(rng):
    found = results(rng)
    for run in found["cma"]:
        del run["attainable"]
    assert [row.arm for row in miss_table("me", found, resamples=9).rows] == [arm for arm in MISSED if arm != "cma"]
    assert miss_table("me", {"cma": found["cma"]}, resamples=9) is None


def test_goals_ask_the_own_detector_and_two_others(rng):
    own = miss_table(OWN_JUDGE, results(rng), resamples=199)
    good = miss_table("b", results(rng), resamples=199)
    even = miss_table("c", results(rng, default=0.42), resamples=199)
    assert [goal.reached for goal in miss_goals(own)] == [True] * 6
    verdicts = {goal.text: goal.reached for goal in miss_goals(own, [good, even])}
    asked = {text.split(",")[0]: reached for text, reached in verdicts.items() if "outside" in text}
    assert asked["fewer misses than highest"] is True
    assert asked["fewer misses than random_selected"] is False
    below = "attainable misses at least 25% below those of roof_edge, by "
    reductions = {text.removeprefix(below): reached for text, reached in verdicts.items() if text.startswith(below)}
    assert reductions == {OWN_JUDGE: True, "b": True, "c": False}
    assert [goal.reached for goal in miss_goals(own, [good]) if "outside" in goal.text] == [None] * 4


# ------------------------------------------------------------------------------------------------ the protocol


def test_the_page_shows_the_file():
    page = (ROOT / "docs" / "protocol.md").read_text()
    shown = re.search(r"<!-- traffic protocol -->\n(.*)<!-- end of traffic protocol -->", page, re.DOTALL)
    assert shown
    told = traffic_protocol.traffic_protocol().markdown()
    assert shown[1] == told, "put traffic_protocol().markdown() between the marks of docs/protocol.md"


def test_the_settings_are_those_of_the_protocol():
    protocol, settings = traffic_protocol.traffic_protocol(), traffic_settings()
    assert set(protocol.decided) <= set(settings)
    assert {*ARMS, "highest_raised", "nuscenes_as_built"} == set(protocol.arms)
    for name in protocol.decided:
        arms = {arm.name: arm for arm in settings[name].experiment.arms}
        assert {rival for each in protocol.hypotheses.values() for rival in each.rivals} <= set(arms)
        assert settings[name].experiment.runs == len(protocol.seeds)
        assert settings[name].experiment.knows_attainable
    assert set(protocol.arms) <= set(common_arms())


@pytest.mark.skipif(not has_history(), reason="there is no history, or a shallow one")
def test_a_seal_holds_both_parts():
    with pytest.raises(ArgumentError, match="expected a commit that holds warpav"):
        traffic_protocol.check_sealing(history()[-1])


# ------------------------------------------------------------------------------------------------ verdicts


@pytest.fixture(scope="module")
def tables():
    rng = np.random.default_rng(5)
    return {
        "good": miss_table("good", results(rng), resamples=1999),
        "bad": miss_table("bad", results(rng, default=0.5), resamples=1999),
    }


def judged(tables, outside=("good", "good"), **changed):
    names = traffic_protocol.traffic_protocol().decided
    usual = JudgedSetting(tables["good"], tuple(tables[name] for name in outside))
    return judge_traffic({**dict.fromkeys(names, usual), **changed})


def test_hypotheses_hold_where_their_rules_do(tables):
    found = judged(tables)
    assert [each.verdict for each in found] == ["holds"] * 4
    assert [each.name for each in found] == list(traffic_protocol.traffic_protocol().hypotheses)
    assert all(each.p_holm >= each.p_value for each in found)
    # four settings, three judges; two rivals of the first
    assert [len(each.comparisons) for each in found] == [24, 12, 12, 12]
    assert {one.rival for one in found[3].comparisons} == {"roof_edge"}


def test_one_setting_or_one_judge_too_many_fails_them(tables):
    assert {
        each.verdict for each in judged(tables, sind_4_body=JudgedSetting(tables["bad"], (tables["good"],) * 2))
    } == {"failed"}
    assert [each.verdict for each in judged(tables, outside=("good", "bad"))] == ["failed"] * 4
    assert [each.verdict for each in judged(tables, outside=("good", "bad", "good"))] == ["holds"] * 4


def test_at_least_two_of_three_networks_is_a_partial_conjunction(tables):
    three, two = judged(tables, outside=("good", "bad", "good"))[1], judged(tables)[1]
    largest = max(one.p_value for one in two.comparisons)
    assert two.p_value == pytest.approx(largest)
    assert three.p_value == pytest.approx(2.0 * largest)


def test_missing_results_decide_nothing(tables, rng):
    assert {each.verdict for each in judge_traffic({})} == {"not decided"}
    assert {each.verdict for each in judged(tables, outside=("good",))} == {"not decided"}
    few = {arm: runs_of(arm, missed, rng, seeds=range(4)) for arm, missed in MISSED.items()}
    few = JudgedSetting(miss_table("few", few, resamples=99), (tables["good"],) * 2)
    assert {each.verdict for each in judged(tables, sind_4_rack=few)} == {"not decided"}


def test_the_command_decides_by_folders(capsys, tmp_path, monkeypatch, tables, rng):
    monkeypatch.setitem(traffic_judgement.read_setting.__kwdefaults__, "resamples", 99)
    options = {"scenes.test_seeds": "5000..5049"}
    folders = []
    for name in traffic_protocol.traffic_protocol().decided:
        folder = tmp_path / name
        (folder / "results").mkdir(parents=True)
        (folder / "panel_two").mkdir()
        described = {"schema": 2, "experiment": f"rivals_{name}", "options": options}
        (folder / "experiment.json").write_text(json.dumps(described))
        for arm, runs in results(rng).items():
            for run in runs:
                (folder / "results" / f"{arm}_{run['seed']}.json").write_text(json.dumps({"schema": 2, **run}))
        misses = [{**json_ready(tables["good"]), "judge": judge} for judge in (OWN_JUDGE, "one", "two", "own")]
        (folder / "panel_two" / "panel.json").write_text(json.dumps({"misses": misses, "outside": ["one", "two"]}))
        folders.append(str(folder))
    assert main(["experiment", "judge", *folders, "--out", str(tmp_path / "judged.md")]) == 0
    told = (tmp_path / "judged.md").read_text()
    assert "| T2: it misses less than the best selection of random cameras | **holds" in told
    assert "| T1 | dense_4_rack | highest | one | +" in told
    assert "| own |" not in told
    assert "- sind_4_body: test scenes that nobody sealed: no evidence" in told
    (tmp_path / "sind_4_body" / "panel_two" / "panel.json").write_text("{}")
    assert "expected the numbers of a panel" in complaint(capsys, "experiment", "judge", *folders)
