"""`warpav experiment rescore --panel`: each network at its own size, equal false alarms, orders, cross-judging."""

import itertools
import json
import shutil
from collections import namedtuple

import numpy as np
import pytest
import scipy.stats

from tests.detection.tiny_networks import write_network
from tests.experiments.small_experiment import complaint, overrides
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.core.progress import NullProgress
from warpav.detection.onnx_detector import BUILTIN_MODEL_PATH
from warpav.experiments import open_experiments, panel, rescore
from warpav.experiments.experiment import Finished
from warpav.runs.config import load_config
from warpav.runs.networks import PanelNetwork, networks_in

SCENES = 12
OBJECTS = 20


@pytest.fixture(autouse=True)
def working_directory(working_directory, monkeypatch):
    """An empty working directory; and few resamples, for time."""
    for function in (open_experiments.run_open, rescore.run_rescores, panel.run_panel):
        monkeypatch.setitem(function.__kwdefaults__, "resamples", 99)
    return working_directory


# ------------------------------------------------------------------------------------------------ a real experiment


@pytest.fixture(scope="module")
def opened(tmp_path_factory, scenes):
    """Folder of a small open experiment; nobody may change it."""
    folder = tmp_path_factory.mktemp("open") / "run"
    plain = ("losses.probability=visible_share", "optimiser.starts=2", "optimiser.pool_cameras=16")
    plain += ("optimiser.selection_time_s=2", "camera.width_px=144", "camera.height_px=144")
    words = ["--arms", "default,highest,nuscenes", "--budget", "100", "--runs", "2", "--out", str(folder)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(open_experiments.run_open.__kwdefaults__, "resamples", 99)
        assert main(["experiment", "open", *overrides(scenes, *plain), *words]) == 0
    return folder


def test_a_panel_says_what_rescoring_by_each_network_says(working_directory, opened, capsys):
    folder, networks = shutil.copytree(opened, working_directory / "run"), working_directory / "networks"
    networks.mkdir()
    for name in ("One", "other"):
        shutil.copy(BUILTIN_MODEL_PATH, networks / f"{name}.onnx")
    words = ["experiment", "rescore", str(folder), "--panel", str(networks), "--false-alarms", "0.1"]
    assert main(words) == 0
    shown = capsys.readouterr().out
    assert "Recall at 0.1 false alarms per image" in shown
    written = json.loads((folder / "panel_networks" / "panel.json").read_text())
    assert [judge["name"] for judge in written["judges"]] == ["one", "other"]
    assert [(judge["width_px"], judge["height_px"]) for judge in written["judges"]] == [(144, 144)] * 2
    # the same network under two names is of one opinion
    one, other = (
        {name: value[judge] for name, value in written.items() if name.endswith(("per_100", "alarms"))}
        for judge in ("one", "other")
    )
    assert one == other
    (agreement,) = written["agreements"]
    assert agreement["kendall"]["value"] == agreement["spearman"]["value"] == 1.0
    assert written["disagreements"] == []
    # at the configured confidence these are the results of the experiment
    for row in written["rows"]:
        runs = [json.loads((folder / "results" / f"{row['arm']}_{seed}.json").read_text()) for seed in row["seeds"]]
        misses = np.mean([run["metrics"]["misses_per_100"] for run in runs])
        assert written["misses_per_100"]["one"][row["label"]]["mean"] == pytest.approx(misses, abs=1e-6)
    # and at equal false alarms those of a detector with that confidence from the beginning
    judge = written["judges"][0]
    equal = f"detector.confidence_min={judge['equal_confidence']!r}"
    assert main(["experiment", "rescore", str(folder), equal, "--name", "equal"]) == 0
    false_alarms = images = 0
    for row in written["rows"]:
        runs = [
            json.loads((folder / "rescored_equal" / "results" / f"{row['arm']}_{seed}.json").read_text())
            for seed in row["seeds"]
        ]
        recall = np.mean([run["metrics"]["tp_detection_rate"] for run in runs])
        found = written["recall_at_equal_false_alarms"]["one"][row["label"]]["mean"]
        assert found == pytest.approx(recall, abs=1e-6)
        false_alarms += sum(run["metrics"]["false_alarms_per_frame"] * run["metrics"]["frames"] for run in runs)
        images += sum(run["metrics"]["frames"] for run in runs)
    assert judge["equal_false_alarms_per_image"] == pytest.approx(false_alarms / images, abs=1e-9)
    assert 0.0 < judge["equal_false_alarms_per_image"] <= 0.1 < judge["false_alarms_per_image"]
    # what is there is not measured again
    capsys.readouterr()
    assert main(words) == 0
    assert capsys.readouterr().out.count("0 new results") == 2


# ------------------------------------------------------------------------------------------------ made results


def made_run(arm, seed, recall_of_scene, *, method="optimiser", search_overrides=()):
    """A result of `SCENES` scenes; object k of a scene is detected up to a confidence that says so of the recall."""
    recall_of_scene = np.asarray(recall_of_scene)
    up_to = np.where(np.arange(OBJECTS) < np.round(recall_of_scene[:, None] * OBJECTS), 0.6, 0.1)
    return {
        "arm": arm,
        "seed": seed,
        "method": method,
        "overrides": [],
        "search_overrides": list(search_overrides),
        "objects_of_scene": [OBJECTS] * len(recall_of_scene),
        "metrics": {"per_scene": {"tp_detection_rate": list(recall_of_scene)}},
        # half an alarm an image is more confident than .5
        "objects": {
            "images": 4 * SCENES,
            "false_alarm_confidence": [0.9, 0.3] * (2 * SCENES),
            "detected_up_to": up_to.tolist(),
        },
    }


Judging = namedtuple("Judging", "name detector")


@pytest.fixture
def judged(working_directory, monkeypatch):
    """Runs a panel on made results: ``judged({network: {folder: [run, ...]}}, detector of each folder)``."""
    networks = working_directory / "networks"
    networks.mkdir()
    for name in "abc":
        (networks / f"{name}.onnx").write_text(name)
    monkeypatch.setattr(
        panel, "networks_in", lambda folder, _: [PanelNetwork(n, folder / f"{n}.onnx", 64, 64) for n in "abc"]
    )
    monkeypatch.setattr(PanelNetwork, "config", lambda self, config: Judging(self.name, config.detector))

    def run(results, searched_with, failed=(), **options):
        def rescored(folder, config):
            arms = {}
            for each in results[config.name][folder.name]:
                arms.setdefault(each["arm"], []).append(each)
            return Finished(folder, arms, list(failed), 0)

        monkeypatch.setattr(panel, "planned_rescore", lambda folder, config, **_: (folder, config))
        monkeypatch.setattr(panel, "run_rescores", lambda planned, **_: [rescored(*each) for each in planned])
        folders = []
        for name, network in searched_with.items():
            folder = working_directory / name
            folder.mkdir(exist_ok=True)
            model = network if network == "builtin" else str(networks / f"{network}.onnx")
            described = {"detector.model": model, "scenes.source": "town", "scenes.train_seeds": [0, 1], **options}
            text = json.dumps({"schema": 2, "experiment": "open", "options": described})
            (folder / "experiment.json").write_text(text)
            folders.append(folder)
        config = load_config("quick")
        return panel.run_panel(
            folders, config, networks, name="made", false_alarms_per_image=0.5, progress=NullProgress()
        )

    return run


def test_pairs_in_another_order_are_shown_and_rated(judged):
    level, wave = np.full(SCENES, 0.5), np.where(np.arange(SCENES) % 2, 0.3, -0.3)
    of = {
        "a": {"good": level + 0.2, "middle": level, "poor": level - 0.2, "wavering": level + 0.05 + wave},
        "b": {"good": level + 0.2, "middle": level - 0.2, "poor": level, "wavering": level + 0.05 + wave},
        "c": {"good": level + 0.2, "middle": level, "poor": level - 0.2, "wavering": level - 0.05 + wave},
    }
    table = judged({n: {"x": [made_run(arm, 0, r) for arm, r in arms.items()]} for n, arms in of.items()}, {"x": "a"})
    means = {n: [r.mean() for r in arms.values()] for n, arms in of.items()}
    for each in table.agreements:
        pair = means[each.one], means[each.other]
        assert each.kendall.value == pytest.approx(scipy.stats.kendalltau(*pair).statistic)
        assert each.spearman_at_equal_false_alarms.value == pytest.approx(scipy.stats.spearmanr(*pair).statistic)
    expected = {
        (one, other)
        for one, other in itertools.combinations(of["a"], 2)
        if len({np.sign((of[n][one] - of[n][other]).mean().round(9)) for n in "abc"} - {0.0}) > 1
    }
    assert {each.rows for each in table.disagreements} == expected
    assert {each.rows for each in table.disagreements if each.is_sure} == {("middle", "poor")}
    swapped = next(each for each in table.disagreements if each.rows == ("middle", "poor"))
    assert [round(swapped.differences[name].mean, 9) for name in "abc"] == [0.2, -0.2, 0.2]
    text = table.markdown()
    assert f"Pairs of arms in another order: {len(expected)} of 6, 1 for sure" in text
    assert "| middle - poor | +0.200 [+0.200, +0.200] | -0.200 [-0.200, -0.200] |" in text


def test_recalls_are_compared_at_equal_false_alarms(judged):
    runs = {
        n: {"x": [made_run("one", 0, np.full(SCENES, 0.5)), made_run("two", 0, np.full(SCENES, 0.7))]} for n in "abc"
    }
    for run in runs["b"]["x"]:  # says twice as many, half of them sure: only above .9 there are few enough
        run["objects"]["false_alarm_confidence"] = [0.95] * SCENES + [0.9] * (3 * SCENES)
        run["objects"]["detected_up_to"] = [[0.92] * 5 + [0.9] * 15 for _ in range(SCENES)]
    for run in runs["c"]["x"]:  # never says much
        run["objects"]["false_alarm_confidence"] = [0.8]
    table = judged(runs, {"x": "a"})
    a, b, c = table.judges
    assert 0.3 < a.equal_confidence < 0.6
    assert (a.equal_false_alarms_per_image, a.false_alarms_per_image) == (0.5, 1.0)
    assert 0.9 < b.equal_confidence < 0.92
    assert b.equal_false_alarms_per_image == 0.25
    assert c.equal_confidence == rescore.CONFIDENCE_FLOOR
    assert c.equal_false_alarms_per_image == pytest.approx(1 / (4 * SCENES))
    recalls = {n: [each.mean for each in table.recall_at_equal_false_alarms[n].values()] for n in "abc"}
    assert recalls == {"a": pytest.approx([0.5, 0.7]), "b": pytest.approx([0.25, 0.25]), "c": pytest.approx([1.0, 1.0])}
    assert [each.mean for each in table.misses_per_100["b"].values()] == pytest.approx([50.0, 30.0])
    assert table.agreements[0].kendall_at_equal_false_alarms.value is None  # b sees no difference
    assert table.agreements[0].kendall.value == 1.0


def test_rigs_of_one_network_are_judged_by_the_others(judged, rng):
    names = {"of_a": "a", "of_b": "b", "of_c": "c"}
    worth = {(own, judge): 0.8 if own == judge else 0.6 for own in "abc" for judge in "abc"}
    worth["c", "a"] = 0.9  # what c finds is better for a than what a finds
    scene = rng.integers(-2, 3, SCENES) / OBJECTS
    results = {
        judge: {
            folder: [
                *(made_run("default", seed, worth[own, judge] + scene) for seed in (0, 1)),
                made_run("highest", 0, 0.4 + scene, method="highest"),
            ]
            for folder, own in names.items()
        }
        for judge in "abc"
    }
    table = judged(results, names)
    assert [row.searched_with for row in table.rows] == ["a", None, "b", None, "c", None]
    (crossed,) = table.crossed
    assert crossed.method == "default"
    assert crossed.rows == {"a": "of_a/default", "b": "of_b/default", "c": "of_c/default"}
    for own, judge in itertools.permutations("abc", 2):
        assert crossed.above_own[own][judge].mean == pytest.approx(worth[own, judge] - worth[judge, judge])
    text = table.markdown()
    assert "**Searched with one network, judged by another: default**" in text
    (shown,) = table.crossed_tables()  # what is published of it, too
    assert shown.markdown() in text
    line = [line for line in text.splitlines() if line.startswith("| c |")][-1]
    assert "(+0.100 [+0.100, +0.100])" in line
    assert line.endswith("(own) |")


def test_an_experiment_may_search_with_several_networks(judged, working_directory):
    arms = {
        f"by_{n}": [f"detector.model={working_directory / 'networks' / n}.onnx", "camera.width_px=64"] for n in "ab"
    }
    runs = [
        made_run(arm, 0, np.full(SCENES, recall), search_overrides=words)
        for (arm, words), recall in zip(arms.items(), (0.5, 0.7), strict=True)
    ]
    table = judged({n: {"x": runs} for n in "abc"}, {"x": "builtin"})
    (crossed,) = table.crossed
    assert crossed.rows == {"a": "by_a", "b": "by_b"}
    assert {own: set(judges) for own, judges in crossed.above_own.items()} == {"a": {"b"}, "b": {"a"}}
    assert crossed.above_own["a"]["b"].mean == pytest.approx(-0.2)


def test_rigs_that_a_network_could_not_judge_are_left_out_and_named(judged):
    both = [made_run("one", seed, np.full(SCENES, 0.5)) for seed in (0, 1)]
    results = {n: {"x": both} for n in "abc"}
    results["c"] = {"x": both[:1]}
    table = judged(results, {"x": "a"}, failed=["one_1: a judge that fails"])
    assert [row.seeds for row in table.rows] == [(0,)]
    assert "Failed: a, one_1: a judge that fails" in table.markdown()


def test_experiments_that_do_not_belong_together_are_refused(judged, working_directory):
    runs = {n: {name: [made_run("one", 0, np.full(SCENES, 0.5))] for name in "xy"} for n in "abc"}
    with pytest.raises(InputError, match=r"y: expected rigs that have not been searched for on the test scenes, got 1"):
        judged(runs, {"x": "a", "y": "b"}, **{"scenes.validation_seeds": [5003]})
    with pytest.raises(InputError, match="--also: expected folders of different names"):
        judged(runs, {"x": "a", "networks/x": "b"})
    described = {"schema": 2, "experiment": "open", "options": {"scenes.ego": "van.glb 17"}}
    judged(runs, {"x": "a"})
    other = working_directory / "z"
    other.mkdir()
    (other / "experiment.json").write_text(json.dumps(described))
    with pytest.raises(InputError, match=r"z: scenes\.ego: expected that of the first experiment, None, got 'van"):
        panel.run_panel(
            [working_directory / "x", other],
            load_config("quick"),
            working_directory / "networks",
            name="made",
            false_alarms_per_image=0.5,
            progress=NullProgress(),
        )


# ------------------------------------------------------------------------------------------------ the networks


def test_each_network_has_its_own_size(tmp_path):
    pytest.importorskip("onnx")
    names = {"metadata": {"names": "{0: 'car', 1: 'bus', 2: 'person'}"}}
    write_network(tmp_path / "Fixed-64.onnx", "ultralytics", **names)
    write_network(tmp_path / "any.onnx", "ultralytics", size_px=None, **names)
    (tmp_path / "README.md").write_text("not a network")
    config = load_config("quick", ["camera.width_px=192", "camera.height_px=96"])
    fixed, free = networks_in(tmp_path, config)
    assert (fixed.name, fixed.width_px, fixed.height_px) == ("fixed_64", 64, 32)
    assert (free.name, free.width_px, free.height_px) == ("any", 192, 96)
    changed = fixed.config(config)
    assert changed.detector.model == str(tmp_path / "Fixed-64.onnx")
    assert (changed.camera.width_px, changed.camera.height_px) == (64, 32)
    write_network(tmp_path / "fixed 64.onnx", "ultralytics", **names)
    with pytest.raises(InputError, match=r"expected networks of different names, got .* both fixed_64; rename one"):
        networks_in(tmp_path, config)


def test_a_description_says_what_a_file_does_not(tmp_path):
    pytest.importorskip("onnx")
    write_network(tmp_path / "bare.onnx", "ultralytics", size_px=None)
    config, file = load_config("quick"), tmp_path / "bare.yaml"
    with pytest.raises(InputError, match="labels"):
        networks_in(tmp_path, config)
    file.write_text("labels: [car, bus, person]\nconfidence_min: 0.4\nwidth_px: 320\nheight_px: 160\n")
    (found,) = networks_in(tmp_path, config)
    changed = found.config(config)
    assert changed.detector.labels == ("car", "bus", "person")
    assert changed.detector.confidence_min == 0.4
    assert (changed.camera.width_px, changed.camera.height_px) == (320, 160)
    for text, message in (
        ("label: [car]", r"bare\.yaml:1: expected one of format, .*, got 'label'; did you mean labels\?"),
        (
            "labels: [car, bus, person]\nwidth_px: 320",
            r"height_px: expected two whole .* got 320 and None",
        ),
        ("- car", r"bare\.yaml: expected options of a network such as input_px: 640, got list"),
        ("confidence_min: 2", "confidence_min"),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=message):
            networks_in(tmp_path, config)


def test_networks_that_others_made_have_their_sizes(asset_folder):
    sizes = {each.name: (each.width_px, each.height_px) for each in networks_in(asset_folder, load_config("quick"))}
    assert sizes["yolox_nano_coco"] == (640, 640)
    assert sizes["picodet_s_coco_416"] == sizes["nanodet_m_coco_416"] == (416, 416)


def test_bad_words_are_told_in_one_line(opened, working_directory, capsys):
    words = ["experiment", "rescore", str(opened)]
    assert "(--also): expected nothing, as it is an option of --panel" in complaint(
        capsys, *words, "camera.width_px=96", "--also", str(opened)
    )
    assert "(--false-alarms): expected nothing" in complaint(
        capsys, *words, "camera.width_px=96", "--false-alarms", "1"
    )
    assert "expected ONNX files such as" in complaint(capsys, *words, "--panel", str(working_directory))
    assert "expected a folder of ONNX files, got none" in complaint(capsys, *words, "--panel", "gone")
    assert "expected an option that all networks of a panel share" in complaint(
        capsys, *words, "--panel", ".", "detector.labels=[car]"
    )
    assert "losses.missed: expected an evaluation option" in complaint(
        capsys, *words, "--panel", ".", "losses.missed=2"
    )
    assert "--false-alarms: expected a number of at least 0, got -1" in complaint(
        capsys, *words, "--panel", ".", "--false-alarms", "-1"
    )
    assert not list(opened.glob("panel*"))
