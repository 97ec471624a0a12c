"""The experiments of our own: tables, goals said both ways, correlations, rigs rescored, the page of results."""

import json
import shutil

import numpy as np
import pytest

from tests.experiments.small_experiment import complaint, overrides
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.experiments import open_experiments, rescore
from warpav.experiments.arms import common_fov_deg, default_like, odd_fields
from warpav.experiments.correlation import ALL_RANDOM, EVERY, correlate, correlation_goal
from warpav.experiments.experiment import overrides_of
from warpav.experiments.goals import goals_of, goals_text
from warpav.experiments.open_experiments import EXPERIMENTS, PRESETS
from warpav.experiments.rescore import same_order
from warpav.experiments.summary import write_results_page
from warpav.experiments.tables import compare_results
from warpav.runs.config import load_config

PLAIN = (
    "losses.probability=visible_share",  # needs no fit
    "optimiser.starts=2",
    "optimiser.pool_cameras=16",
    "optimiser.selection_time_s=2",
    "camera.width_px=144",
    "camera.height_px=144",
)
BUDGET = ("--budget", "100")
LARGER = ("camera.width_px=176", "camera.height_px=176")
SCENES = 12
GOAL_METRICS = ("tp_detection_rate", "ap50_pooled", "tp_in_frame_rate")


@pytest.fixture(autouse=True)
def working_directory(working_directory, monkeypatch):
    """An empty working directory; and few resamples, for time."""
    for function in (open_experiments.run_open, rescore.run_rescores):
        monkeypatch.setitem(function.__kwdefaults__, "resamples", 99)
    return working_directory


@pytest.fixture(scope="module")
def opened(tmp_path_factory, scenes):
    """Folder of a small open experiment; nobody may change it."""
    folder = tmp_path_factory.mktemp("open") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(open_experiments.run_open.__kwdefaults__, "resamples", 99)
        words = ["--arms", "default,highest,random,nuscenes", *BUDGET, "--runs", "2", "--out", str(folder)]
        assert main(["experiment", "open", *overrides(scenes, *PLAIN), *words]) == 0
    return folder


@pytest.fixture
def copied(working_directory, opened):
    """A copy of it."""
    return shutil.copytree(opened, working_directory / "run")


def made_run(arm, seed, recall, *, rng=None, objective=0.3, violation=0.0):
    """A result whose numbers follow from its recall."""
    noise = 0.0 if rng is None else rng.normal(0.0, 0.02, SCENES)
    per_scene = list(np.clip(recall + noise + np.linspace(-0.1, 0.1, SCENES), 0.0, 1.0))
    metrics = dict.fromkeys(("tp_detection_rate", "ap50_pooled", "tp_in_frame_rate", "detection_confidence"), recall)
    metrics |= {"misses_per_100": 100.0 * (1.0 - recall), "recall_at_equal_false_alarms": recall}
    metrics |= {"false_alarms_per_frame": 0.2, "objective": objective}
    return {
        "arm": arm,
        "seed": seed,
        "objects_of_scene": [4] * SCENES,
        "metrics": {
            **metrics,
            "constraint_violation": violation,
            "per_scene": {**dict.fromkeys(metrics, per_scene), "objective": [objective] * SCENES},
        },
        "validation_objectives": {"own": objective},
        "seconds": {"search": 3.0},
    }


def made_results(rng, *, ours=0.9, objective=0.1, violation=0.0, preset=0.7):
    recalls = {"highest": 0.8, "random": 0.75, "cma": 0.78}
    results = {
        "default": [
            made_run("default", seed, ours + 0.001 * seed, rng=rng, objective=objective, violation=violation)
            for seed in range(3)
        ]
    }
    for arm, recall in recalls.items():
        seeds = range(1 if arm == "highest" else 3)
        results[arm] = [made_run(arm, seed, recall, rng=rng) for seed in seeds]
    results["default_as_nuscenes"] = [made_run("default_as_nuscenes", seed, 0.85, rng=rng) for seed in range(3)]
    results["nuscenes"] = [made_run("nuscenes", 0, preset)]
    return results


def goals(results):
    return goals_of(
        results, compare_results(results, "default", metrics=GOAL_METRICS, resamples=49), PRESETS, resamples=49
    )


# ------------------------------------------------------------------------------------------------ arms


def test_the_experiments_have_the_arms_that_they_promise():
    names = [arm.name for arm in EXPERIMENTS["open"].arms]
    assert names[0] == "default"
    assert {*open_experiments._RIVALS, *PRESETS, *(f"default_as_{preset}" for preset in PRESETS)} < set(names)
    assert [EXPERIMENTS[name].runs for name in ("open", "ablations")] == [10, 10]
    assert sum(EXPERIMENTS["correlation"].runs_of.values()) >= 100
    config = load_config("default")
    for experiment in EXPERIMENTS.values():
        quick = load_config("default", overrides_of(experiment, [], quick=True))
        for arm in experiment.arms:
            assert arm.search_config(config) != arm.search_config(quick)
    for arm in EXPERIMENTS["ablations"].arms[1:]:
        assert arm.evaluation_config(config) == config
        assert arm.search_config(config) != config


def test_the_counterpart_of_a_preset_has_its_cameras():
    arm = default_like("nuscenes")
    assert arm.overrides == ("rig.cameras=6", "camera.fov_deg=64.8")
    assert odd_fields("nuscenes") == "default_as_nuscenes: 6 cameras of 64.8 deg, but 89.3 in the preset"
    assert default_like("argoverse2").evaluation_config(load_config("default")).rig.cameras == 9
    assert common_fov_deg("argoverse2") == 62.6
    assert odd_fields("argoverse2").endswith("but 49.4 in the preset")


# ------------------------------------------------------------------------------------------------ goals


def test_goals_that_are_reached_are_said_to_be(rng):
    found = goals(made_results(rng))
    assert [goal.reached for goal in found] == [True] * 12 + [None]
    text = goals_text(found)
    assert text.count("- **reached**") == 12
    assert "- **not measured**: recall at least 10% above argoverse2's" in text
    assert "0.8500 against 0.7000, +21.4%" in text
    assert str(found[0]) == "reached: constraint violation 0 on every run of every arm (worst of 14 runs 0 m)"


def test_an_arm_under_other_constraints_is_told_apart(rng):
    results = {**made_results(rng), "thesis_gradient": [made_run("thesis_gradient", 0, 0.6, violation=0.125)]}
    found = goals(results)[0]
    assert found.reached is True
    assert found.text.endswith("except thesis_gradient, searched in the thesis's bounding rectangle")
    assert found.numbers == "worst of 14 runs 0 m; thesis_gradient up to 0.125 m outside the mount zone"


def test_goals_that_are_not_reached_are_said_to_be(rng):
    found = goals(made_results(rng, ours=0.7, objective=0.31, violation=1e-3, preset=0.8))
    # the standard deviations are as small as before
    assert [goal.reached for goal in found] == [False] * 9 + [True, True, False, None]
    told = [str(goal) for goal in found]
    assert told[0].endswith("(worst of 14 runs 0.001 m, by default)")
    assert told[1].endswith("(0 of 3 runs; difference +0.0100 to +0.0100)")
    assert "0.7010 against highest 0.8000, random 0.7500, cma 0.7800" in told[3]
    assert "; paired difference to cma -0.0" in told[3]
    assert goals(made_results(rng, preset=0.95))[11].numbers.endswith("impossible: 110% of it exceeds 1")
    assert told[11].startswith("not reached: recall at least 10% above nuscenes's")


def test_what_was_not_measured_is_not_reached(rng):
    results = made_results(rng)
    del results["cma"]
    found = goals({arm: runs[:1] for arm, runs in results.items()})
    told = [str(goal) for goal in found if goal.reached is None]
    assert len(told) == 7
    assert any("no result of cma" in line for line in told)
    assert sum("(1 run)" in line for line in told) == 2
    # but a rival that is better is a loss, whoever is missing
    lost = made_results(rng, ours=0.7)
    del lost["cma"]
    assert goals(lost)[3].reached is False


# ------------------------------------------------------------------------------------------------ correlation


def correlated_results(rng, noise, count=60):
    results = {}
    for arm in ("random_rig", "random_place"):
        recall = rng.uniform(0.3, 0.9, count)
        objective = 1.0 - recall + rng.normal(0.0, noise, count)
        results[arm] = [
            {**made_run(arm, seed, recall[seed]), "validation_objectives": {"own": objective[seed], "thesis": 1.0}}
            for seed in range(count)
        ]
    results["default"] = [{**made_run("default", 0, 0.95), "validation_objectives": {"own": 0.01, "thesis": None}}]
    return results


def test_an_objective_that_ranks_rigs_is_told_from_one_that_does_not(rng, working_directory):
    file = working_directory / "scatter.png"
    good = correlate(correlated_results(rng, 0.02), file, resamples=99)
    assert good.spearman[ALL_RANDOM]["own"]["tp_detection_rate"].value > 0.95
    assert good.spearman[ALL_RANDOM]["own"]["tp_detection_rate"].count == 120
    assert good.spearman[EVERY]["own"]["ap50_pooled"].count == 121
    assert good.spearman[ALL_RANDOM]["thesis"]["ap50_pooled"].value is None  # always the same
    assert correlation_goal(good).reached is True
    assert len(good.rigs) == 121
    assert good.figure == "scatter.png"
    assert file.read_bytes().startswith(b"\x89PNG")
    assert good.markdown().count("\n| all random rigs | 120 |") == 2
    poor = correlate(correlated_results(rng, 1.0), resamples=99)
    assert correlation_goal(poor).reached is False
    few = correlate(correlated_results(rng, 0.02, count=20), resamples=99)
    assert correlation_goal(few).reached is None


# ------------------------------------------------------------------------------------------------ commands


def test_open_prints_and_writes_its_table_and_goals(copied, scenes, capsys):
    words = ["--arms", "default,highest,random,nuscenes", *BUDGET, "--runs", "2", "--out", str(copied)]
    assert main(["experiment", "open", *overrides(scenes, *PLAIN), *words]) == 0
    shown = capsys.readouterr().out
    assert "6 of 6 results are in" in shown
    assert "reached: constraint violation 0 on every run of every arm (worst of 6 runs 0 m)" in shown
    assert "not measured: interval of recall's paired difference to cma above 0 (no interval)" in shown
    text = (copied / "open.md").read_text()
    assert text.startswith("| arm | runs | recall of the rig |")
    assert "All searches compare rigs on the same 2 training scenes" in text
    written = json.loads((copied / "open.json").read_text())
    assert written["reference"] == "default"
    assert written["violation_m"] == dict.fromkeys(("default", "highest", "random", "nuscenes"), 0.0)
    assert len(written["goals"]) == 13
    result = json.loads((copied / "results" / "default_1.json").read_text())
    assert result["validation_objectives"]["configured"] == pytest.approx(result["training_objective"], abs=1e-6)
    moved = json.loads((copied / "results" / "nuscenes_0.json").read_text())
    assert moved["validation_objectives"] == {"configured": None}


def test_an_open_experiment_goes_on_where_it_stopped(copied, scenes, capsys):
    for file in (copied / "results").glob("highest*"):
        file.unlink()
    words = ["--arms", "default,highest,random,nuscenes", *BUDGET, "--runs", "2", "--out", str(copied)]
    assert main(["experiment", "open", *overrides(scenes, *PLAIN), *words]) == 0
    shown = capsys.readouterr().out
    assert "5 of 6 results are in" in shown
    assert "1 new results" in shown
    # what is there already is shown, whatever is asked for now
    assert (
        main(
            [
                "experiment",
                "open",
                *overrides(scenes, *PLAIN),
                "--arms",
                "start",
                *BUDGET,
                "--runs",
                "1",
                "--out",
                str(copied),
            ]
        )
        == 0
    )
    arms = list(json.loads((copied / "open.json").read_text())["runs"])
    assert arms == ["default", "highest", "random", "nuscenes", "start"]


def test_goals_are_the_default_methods_alone(working_directory, scenes, capsys):
    words = ["--arms", "highest,start", "--runs", "1"]
    assert main(["experiment", "open", *overrides(scenes, *PLAIN), *words]) == 0
    shown = capsys.readouterr().out
    assert "highest - arm" in shown
    assert "reached" not in shown
    assert json.loads((working_directory / "runs" / "open" / "open.json").read_text())["goals"] == []


def test_correlation_measures_every_rig_by_both_objectives(working_directory, scenes, capsys):
    words = ["--arms", "random_rig,random_place,highest", "--runs", "2"]
    plain = overrides(scenes, *PLAIN[:-2], "scenes.validation_seeds=[1]")
    assert main(["experiment", "correlation", *plain, *words]) == 0
    folder = working_directory / "runs" / "correlation"
    written = json.loads((folder / "correlation.json").read_text())
    assert [rig["arm"] for rig in written["rigs"]] == ["random_rig"] * 2 + ["random_place"] * 2 + ["highest"]
    for rig in written["rigs"]:
        assert rig["objectives"]["configured"] > 0.0
        assert rig["objectives"]["thesis"] > 0.0
    assert len({rig["objectives"]["configured"] for rig in written["rigs"]}) > 3
    assert (folder / "correlation.png").is_file()
    assert (
        "not measured: rank correlation of objective and held-out recall over 100 random rigs"
        in capsys.readouterr().out
    )


@pytest.fixture(scope="module")
def rescored(tmp_path_factory, opened):
    """A copy of it, rescored with larger images; nobody may change it."""
    folder = shutil.copytree(opened, tmp_path_factory.mktemp("rescored") / "run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(rescore.run_rescores.__kwdefaults__, "resamples", 99)
        assert main(["experiment", "rescore", str(folder), *LARGER]) == 0
    return folder


def test_rigs_are_rescored_and_stay_as_they_are(opened, rescored, working_directory, capsys):
    copied = shutil.copytree(rescored, working_directory / "run")
    before = {file.name: file.read_bytes() for file in (opened / "results").iterdir()}
    assert {file.name: file.read_bytes() for file in (copied / "results").iterdir()} == before
    folder = copied / "rescored_176_176"
    for name, content in before.items():
        if name.endswith(".json"):
            old, new = json.loads(content), json.loads((folder / "results" / name).read_text())
            assert new["rig"] == old["rig"]
            assert new["metrics"]["objective"] is None
            assert new["metrics"]["constraint_violation"] == old["metrics"]["constraint_violation"]
            assert new["metrics"]["objects"] == old["metrics"]["objects"]
            assert new["metrics"]["tp_in_frame_rate"] == pytest.approx(old["metrics"]["tp_in_frame_rate"], abs=0.11)
    assert "objective" not in json.loads((folder / "rescored.json").read_text())["numbers"]
    assert main(["experiment", "rescore", str(copied), *LARGER]) == 0
    shown = capsys.readouterr().out
    assert "6 of 6 results are in" in shown
    assert "0 new results" in shown
    assert "the arms keep their order by recall" in shown


def test_what_another_judge_said_is_none_of_it(copied, monkeypatch):
    words = ["experiment", "rescore", str(copied), "--name", "new"]
    assert main([*words, "camera.width_px=176"]) == 0
    real = rescore.observe_scenes

    def fails_for_nuscenes(rig, *given, **options):
        if len(rig.cameras) == 6:
            raise ValueError("a judge that fails")
        return real(rig, *given, **options)

    monkeypatch.setattr(rescore, "observe_scenes", fails_for_nuscenes)
    assert main([*words, "camera.width_px=160"]) == 1
    written = json.loads((copied / "rescored_new" / "rescored.json").read_text())
    assert written["missing"] == ["nuscenes"]
    assert list(written["runs"]) == ["default", "highest", "random"]


@pytest.mark.parametrize("executor", ["serial", "process"])
def test_a_judge_without_scenes_is_refused_before_the_rigs_are_looked_at(copied, capsys, executor):
    words = ["experiment", "rescore", str(copied), "scenes.test_seeds=[17]", "--executor", executor]
    assert "expected scene_17.glb" in complaint(capsys, *words)
    assert not list(copied.glob("rescored*"))


@pytest.mark.parametrize("executor", ["serial", "process"])
def test_cameras_that_do_not_fit_are_refused_before_any_run(working_directory, scenes, capsys, executor):
    words = ["experiment", "open", *overrides(scenes, *PLAIN), "rig.min_spacing_m=5", "--arms", "cma,highest"]
    words += ["--executor", executor]
    assert "rig.cameras: expected a number that fits on the mount" in complaint(capsys, *words)
    assert not list((working_directory / "runs" / "open" / "results").iterdir())


def change(file, **changes):
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


def test_files_of_another_version_are_told_by_name(copied, scenes, capsys):
    again = ["experiment", "open", *overrides(scenes, *PLAIN), "--arms", "highest", *BUDGET, "--out", str(copied)]
    anew = ["experiment", "rescore", str(copied), "camera.width_px=176"]
    stray = copied / "results" / "stray_0.json"
    for content, got in (("[]", "None"), ('{"schema": 2}', "2"), ('{"schema": 7, "arm": "stray", "seed": 0}', "7")):
        stray.write_text(content)
        for words in (again, anew):
            told = complaint(capsys, *words)
            assert "stray_0.json: schema: expected a result of schema 2 with an arm and a seed" in told
            assert told.endswith(f"got {got}; delete it")
    stray.unlink()
    change(copied / "summary.json", schema=3)
    assert "summary.json: schema: expected 1, got 3" in complaint(capsys, *anew)
    change(copied / "experiment.json", schema=7)
    for words in (again, anew):
        assert "experiment.json: schema: expected 2, got 7" in complaint(capsys, *words)
    (copied / "experiment.json").write_text("[]")
    assert "experiment.json: schema: expected 2, got None" in complaint(capsys, *anew)


def test_the_same_judge_gives_the_same_numbers(copied):
    assert main(["experiment", "rescore", str(copied), "detector.confidence_min=0.1", "--name", "same"]) == 0
    folders = (copied / "results", copied / "rescored_same" / "results")
    recalls = []
    for file in folders[0].glob("*.json"):
        old, new = (json.loads((folder / file.name).read_text()) for folder in folders)
        recalls.append(old["metrics"]["tp_detection_rate"])
        for name in ("tp_detection_rate", "ap50_pooled", "tp_in_frame_rate", "false_alarms_per_frame"):
            assert new["metrics"][name] == pytest.approx(old["metrics"][name], abs=1e-6)
    assert max(recalls) > 0.0


def test_orders_that_differ_are_said_to():
    before = {arm: [made_run(arm, 0, recall)] for arm, recall in (("default", 0.9), ("highest", 0.8), ("sobol", 0.7))}
    assert [goal.reached for goal in same_order(before, before)] == [True, True]
    after = {**before, "highest": [made_run("highest", 0, 0.95)]}
    order, ahead = same_order(before, after)
    assert (order.reached, ahead.reached) == (False, False)
    assert order.numbers.startswith("highest 0.950 > default 0.900 > sobol 0.700; 1 of 3 pairs swap ranks")
    assert "default and highest" in order.numbers


def test_results_become_a_page(rescored, working_directory, capsys):
    copied = shutil.copytree(rescored, working_directory / "run")
    page = working_directory / "docs" / "results.md"
    again = copied / "rescored_176_176"
    assert main(["experiment", "results", str(copied), str(again), "--out", str(page)]) == 0
    assert f"wrote {page}\n" in capsys.readouterr().out
    text = page.read_text()
    assert "## open\n" in text
    assert "## open rescored 176_176\n" in text
    assert "test 2..3; run seeds 0, 1" in text
    assert "- **not measured**" in text
    for name in ("open", "open_rescored_176_176"):
        assert f"[results/{name}.json](results/{name}.json)" in text
        published = json.loads((page.parent / "results" / f"{name}.json").read_text())
        assert [(run["arm"], run["seed"]) for run in published["runs"]][:2] == [("default", 0), ("default", 1)]
        assert all(len(run["recall_of_scene"]) == 2 for run in published["runs"])
        assert published["options"]["scenes.folder"] == "street"
    with pytest.raises(InputError, match=r"results\.txt: out: expected a Markdown file"):
        write_results_page([copied], working_directory / "results.txt")
    with pytest.raises(InputError, match="expected experiments of different names, got open twice"):
        write_results_page([copied, copied], page)


def test_bad_words_are_told_in_one_line(copied, scenes, capsys, working_directory):
    folder = str(copied)
    assert complaint(capsys, "experiment", "rescore", folder).startswith(
        "experiment rescore: expected evaluation options"
    )
    assert "losses.missed: expected an evaluation option" in complaint(
        capsys, "experiment", "rescore", folder, "losses.missed=2"
    )
    assert "camera.fov_deg: expected an evaluation option" in complaint(
        capsys, "experiment", "rescore", folder, "camera.fov_deg=60"
    )
    assert "(--name): expected lower-case letters" in complaint(
        capsys, "experiment", "rescore", folder, "camera.width_px=96", "--name", "../x"
    )
    assert complaint(capsys, "experiment", "rescore", folder, "device=cpu").startswith(
        "command line (--name): expected a name, as device=cpu makes none"
    )
    assert "got none" in complaint(capsys, "experiment", "rescore", str(working_directory), "camera.width_px=96")
    assert "detector.model=gone.onnx" in complaint(capsys, "experiment", "rescore", folder, "detector.model=gone.onnx")
    assert "summary.json, got none" in complaint(
        capsys, "experiment", "results", str(working_directory), "--out", "page.md"
    )
    assert "expected folders of experiments" in complaint(capsys, "experiment", "results", "--out", "page.md")
    assert "rig.cameras: expected an option that the arms of open leave alone" in complaint(
        capsys, "experiment", "open", "rig.cameras=2"
    )
    assert "losses.detector_share: expected an option that the arms of ablations leave alone" in complaint(
        capsys, "experiment", "ablations", "losses.detector_share=0.5"
    )
    assert "got 'descentt'; did you mean descent?" in complaint(
        capsys, "experiment", "open", *overrides(scenes, *PLAIN), "--arms", "descentt"
    )
    assert not list(copied.glob("rescored*"))
