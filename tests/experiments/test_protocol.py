"""The protocol: page and file are one, seals cannot be known before, verdicts follow from the numbers."""

import dataclasses
import hashlib
import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.experiments.small_experiment import complaint
from warpav.core.errors import ArgumentError
from warpav.experiments import protocol as module
from warpav.experiments.judgement import judge, judgements_text
from warpav.experiments.protocol import (
    TEST_SCENES,
    code_since_seal,
    protocol,
    seal_of,
    sealed_override,
    sealed_seeds,
    sealed_test_seeds,
    unknown_code,
)
from warpav.experiments.rival_settings import SETTINGS
from warpav.runs import environment as git
from warpav.runs.config import config_names, load_config
from warpav.runs.detector_fit import TOWN_HELD_OUT, TOWN_SEEDS
from warpav.runs.environment import Commit, code_of, commit_of_code, history, is_known, running_commit

ROOT = Path(__file__).parents[2]
NOBODY = "0" * 40
SCENES = 20


def test_the_page_shows_the_file():
    shown = re.search(
        r"<!-- protocol -->\n(.*)<!-- end of protocol -->", (ROOT / "docs" / "protocol.md").read_text(), re.DOTALL
    )
    assert shown
    assert shown[1] == protocol().markdown(), "put protocol().markdown() between the marks of docs/protocol.md"


def test_hypotheses_name_arms_and_settings_that_there_are():
    for hypothesis in protocol().hypotheses.values():
        assert {*hypothesis.arms, *hypothesis.rivals} <= set(protocol().arms)
        assert protocol().settings_of(hypothesis)
    assert set(protocol().seedless) <= set(protocol().arms)


def test_the_experiments_are_those_of_the_protocol():
    assert list(SETTINGS) == list(protocol().settings)
    for name, experiment in SETTINGS.items():
        assert [arm.name for arm in experiment.arms] == sorted(
            protocol().arms, key=[arm.name for arm in experiment.arms].index
        )
        assert experiment.runs == len(protocol().seeds)
        config = load_config(experiment.config, experiment.options)
        assert len(config.scenes.test_seeds) == protocol().sealed_scenes
        assert (config.rig.free.pitch_deg is not None) == protocol().settings[name].pitch_free
        assert {arm.name for arm in experiment.arms if not arm.is_seeded} == set(protocol().seedless)


def test_settings_follow_from_what_is_free():
    assert protocol().settings_of(protocol().hypotheses["H1"]) == list(protocol().settings)
    free = {name for name, each in protocol().settings.items() if each.pitch_free}
    assert set(protocol().settings_of(protocol().hypotheses["H2"])) == free
    assert set(protocol().settings_of(protocol().hypotheses["H3"])) == set(protocol().settings) - free


# ------------------------------------------------------------------------------------------------ seals


def test_sealed_seeds_are_the_documented_hash():
    commit, expected, k = "ab" * 20, [], 0
    while len(expected) < 7:
        digest = hashlib.sha256(f"{commit}/test scenes/{k}".encode()).hexdigest()
        seed, k = int(digest[:8], 16) % 2**31, k + 1
        expected += [seed] if seed >= 10_000_000 else []
    assert list(sealed_seeds(commit, TEST_SCENES, 7)) == expected
    assert sealed_seeds(commit, TEST_SCENES, 3) == tuple(expected[:3])


def test_sealed_seeds_are_new_and_differ():
    seeds = sealed_seeds("12" * 20, TEST_SCENES, 4000)
    assert len(set(seeds)) == 4000
    assert min(seeds) >= protocol().sealed_from
    assert max(seeds) < 2**31
    assert 0.45 < np.mean(np.array(seeds) < 2**30) < 0.55
    others = {*sealed_seeds("12" * 20, "anything else", 100), *sealed_seeds("13" * 20, TEST_SCENES, 100)}
    assert not others & set(seeds)


def test_nothing_that_was_seen_can_be_sealed():
    seen = {*protocol().development_seeds, *protocol().shown_seeds, *TOWN_SEEDS, *TOWN_HELD_OUT}
    for name in config_names():
        scenes = load_config(name).scenes
        seen |= {*scenes.train_seeds, *(scenes.validation_seeds or ()), *scenes.test_seeds}
    assert max(seen) < protocol().sealed_from
    card = (ROOT / "warpav" / "detection" / "models" / "MODEL_CARD.md").read_text()
    assert max(int(seed) for seed in re.findall(r"\bseeds[^.|]*?\b(\d{6,7})\b", card)) < protocol().sealed_from


@pytest.mark.parametrize("name", ["quick", "default"])
def test_shown_test_scenes_are_not_those_of_development(name):
    shown = set(load_config(name).scenes.test_seeds)
    assert shown <= set(protocol().shown_seeds)
    assert not shown & set(protocol().development_seeds)


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A checkout of its own, where the protocol is changed once and then again; its commits, oldest first."""
    commits = []

    def run(*words):
        who = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
        done = subprocess.run(["git", "-C", str(tmp_path), *who, *words], check=True, capture_output=True, text=True)
        return done.stdout.strip()

    def commit(**files):
        for name, content in files.items():
            place = tmp_path / {"protocol": module.PLACE, "code": "warpav/code.py", "page": "warpav/design.md"}[name]
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(content)
        run("add", "-A")
        run("commit", "-q", "--allow-empty", "-m", "step")
        commits.append(run("rev-parse", "HEAD"))

    run("init", "-q")
    now = module.FILE.read_bytes()
    commit(code=b"one = 1\n")
    commit(protocol=now.replace(b"0.05", b"0.01"))
    commit(protocol=now)
    commit(page=b"words\n")
    commit(code=b"two = 2\n")
    # the module looks for its checkout two folders above itself
    monkeypatch.setattr(git, "__file__", str(tmp_path / "warpav" / "runs" / "commit.py"))
    for kept in (git.code_of, git.running_commit):
        kept.cache_clear()
    yield commits
    for kept in (git.code_of, git.running_commit):
        kept.cache_clear()


def test_a_seal_needs_a_commit_of_the_history_that_holds_this_protocol(repository):
    for commit in repository[2:]:
        assert sealed_test_seeds(commit) == sealed_seeds(commit, TEST_SCENES, protocol().sealed_scenes)
        assert seal_of(sealed_test_seeds(commit)) == commit
    for commit, got in zip(repository[:2], ("without one", "with another"), strict=True):
        with pytest.raises(ArgumentError, match=f"sealed: expected a commit with the protocol of this version.*{got}"):
            sealed_test_seeds(commit)
        assert seal_of(sealed_seeds(commit, TEST_SCENES, protocol().sealed_scenes)) is None
    for word in (NOBODY, "HEAD", repository[2][:10]):
        with pytest.raises(ArgumentError, match="sealed: expected the full hash of a commit that the checkout goes"):
            sealed_test_seeds(word)


def test_seeds_that_are_not_sealed_have_no_seal(repository):
    sealed = sealed_test_seeds(repository[2])
    assert seal_of(sealed[:-1]) is None
    assert seal_of((*sealed[:-1], 7)) is None
    assert seal_of(tuple(range(50))) is None


def test_a_commit_beside_the_history_is_unknown(repository, tmp_path):
    subprocess.run(["git", "-C", str(tmp_path), "reset", "-q", "--hard", repository[2]], check=True)
    assert is_known(repository[2])
    assert not is_known(repository[4])
    assert history() == repository[2::-1]


def test_code_is_told_by_its_content(repository):
    codes = [code_of(commit) for commit in repository]
    assert codes[2] == codes[3]  # documentation is no code
    assert len(set(codes)) == 4
    assert commit_of_code(codes[2]) == repository[3]
    assert commit_of_code(codes[0]) == repository[0]
    assert commit_of_code("f" * 64) is None
    assert code_since_seal(repository[2], [{"hash": repository[3]}]) == []
    assert code_since_seal(repository[2], [{"hash": repository[4]}]) == ["warpav/code.py"]


def test_published_results_of_unknown_or_changed_code_are_named(repository):
    good = {"hash": repository[2], "is_clean": True, "code": code_of(repository[2])}
    assert unknown_code([good]) == []
    assert unknown_code([]) == ["no commit of the code that made them"]
    assert "installed package" in unknown_code([{"hash": None, "is_clean": None, "code": "f" * 64}])[0]
    assert unknown_code([{**good, "hash": NOBODY}]) == [f"commit {NOBODY} is not in the history"]
    changed = unknown_code([good, {**good, "is_clean": False, "code": "f" * 64}])
    assert changed == [f"made by changed code, not by that of commit {repository[2]}"]


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="there is no history")
def test_the_code_that_runs_is_identified_like_that_of_a_commit():
    running = running_commit()
    assert running.hash == history()[0]
    assert running.is_clean is (code_of(running.hash) == running.code)
    status = subprocess.run(
        ["git", "-C", str(ROOT), "status", "--porcelain", "--", "warpav", "kernels/warpav_kernels"],
        capture_output=True,
        text=True,
        check=True,
    )
    changed = [line for line in status.stdout.splitlines() if not line.endswith(".md")]
    assert running.is_clean is (not changed)


def test_an_installed_package_has_no_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(git, "__file__", str(tmp_path / "warpav" / "runs" / "commit.py"))
    running = running_commit.__wrapped__()
    assert (running.hash, running.is_clean, len(running.code)) == (None, None, 64)
    assert (history(), git.has_history(), is_known(NOBODY)) == ([], False, False)
    # its seals are checked when results are published
    monkeypatch.setattr(module, "running_commit", lambda: Commit(None, None, running.code))
    assert sealed_test_seeds("ab" * 20) == sealed_seeds("ab" * 20, TEST_SCENES, protocol().sealed_scenes)
    with pytest.raises(ArgumentError, match="sealed: expected the full hash"):
        sealed_test_seeds("ab")


def test_the_command_takes_no_broken_seal(capsys, repository):
    words = ("experiment", "open", "--sealed")
    assert (
        f"(--sealed): expected the full hash of a commit that the checkout goes back to, got '{NOBODY}'"
        in complaint(capsys, *words, NOBODY)
    )
    sealed = repository[2]
    assert "(--sealed): expected the whole experiment, got --quick" in complaint(capsys, *words, sealed, "--quick")
    told = complaint(capsys, *words, sealed, "scenes.test_seeds=1000..1001")
    assert "(--sealed): expected the test scenes of the seal alone, got scenes.test_seeds=1000..1001" in told
    config = load_config("default", [sealed_override(sealed, (), quick=False)])
    assert config.scenes.test_seeds == sealed_test_seeds(sealed)


# ------------------------------------------------------------------------------------------------ verdicts


def runs_of(objective, *, spread=0.0, seeds=range(10), scenes=None, renders=1000):
    """Runs of an arm whose objectives differ by seed about a mean."""
    seeds = list(seeds)
    by_seed = objective + spread * np.linspace(-1.0, 1.0, len(seeds))
    offsets = np.zeros(SCENES) if scenes is None else scenes
    return [
        {
            "seed": seed,
            "camera_renders": renders,
            "objects_of_scene": [4] * SCENES,
            "test_objective_of_scene": list(value * (1.0 + offsets)),
        }
        for seed, value in zip(seeds, by_seed, strict=True)
    ]


def setting(rng, **objectives):
    """Results of all arms of a setting, scenes being harder and easier for all alike."""
    scenes = rng.normal(0.0, 0.2, SCENES)
    level = {"default": 0.07, "pool_only": 0.08, "descent": 0.071, "descent_only": 0.08, **objectives}
    made = {arm: runs_of(level.get(arm, 0.1), spread=0.001, scenes=scenes - scenes.mean()) for arm in protocol().arms}
    made["default"] = runs_of(level["default"], spread=0.0003, scenes=scenes - scenes.mean())
    made["highest"] = made["highest"][:1]
    return made


def verdicts(results):
    return {each.name: each.verdict for each in judge(results, resamples=99)}


def test_what_holds_everywhere_holds(rng):
    results = {name: setting(rng) for name in protocol().settings}
    found = judge(results, resamples=99)
    assert {each.name: each.verdict for each in found} == dict.fromkeys(protocol().hypotheses, "holds")
    for each in found:
        assert each.p_value == max(one.p_value for one in each.comparisons)
        assert each.p_holm >= each.p_value
        assert all(one.seeds == 10 for one in each.comparisons)


def test_one_run_that_is_above_fails_what_is_said_of_every_run(rng):
    results = {name: setting(rng) for name in protocol().settings}
    results["2x60"]["sobol"][3]["test_objective_of_scene"] = [0.05] * SCENES
    found = {each.name: each for each in judge(results, resamples=99)}
    assert (found["H1"].verdict, found["H4"].verdict, found["H3"].verdict) == ("failed", "failed", "holds")
    failed = [one for one in found["H1"].comparisons if one.holds is False]
    assert [(one.setting, one.rival, one.not_above) for one in failed] == [("2x60", "sobol", 9)]
    text = judgements_text(list(found.values()))
    assert "| H1 | 2x60 | default | sobol | 9 of 10 ✗ |" in text
    assert "**failed**" in text


def test_a_margin_is_relative_and_exact(rng):
    results = {name: setting(rng, default=0.077) for name in protocol().settings}
    found = verdicts(results)
    assert (found["H2"], found["H3"]) == ("failed", "holds")  # 3.75 % below
    results = {name: setting(rng, default=0.0779, descent=0.09) for name in protocol().settings}
    assert verdicts(results)["H3"] == "failed"  # 2.6 % below


def test_a_spread_is_compared_with_its_share(rng):
    results = {"4x90": setting(rng)}
    results["4x90"]["default"] = runs_of(0.07, spread=0.0006)
    assert verdicts(results)["H6"] == "failed"
    results["4x90"]["default"] = runs_of(0.07, spread=0.0005)
    assert verdicts(results)["H6"].startswith("holds")


def test_what_is_equal_holds_but_may_be_chance(rng):
    results = {"4x90": setting(rng)}
    results["4x90"]["descent"] = results["4x90"]["default"]
    assert verdicts(results)["H5"] == "holds, but may be chance"


def test_missing_runs_decide_nothing_but_what_is_said_of_every_run(rng):
    whole = {name: setting(rng) for name in protocol().settings}
    assert set(verdicts({})) == set(protocol().hypotheses)
    assert set(verdicts({}).values()) == {"not decided"}
    del whole["bus"]
    assert verdicts(whole)["H1"] == "not decided"
    assert verdicts(whole)["H5"] == "holds"
    few = {"4x90": {arm: runs[:4] for arm, runs in whole["4x90"].items()}}
    assert verdicts(few)["H5"] == "not decided"
    few["4x90"]["random"] = runs_of(0.01, seeds=range(4))
    assert verdicts(few)["H1"] == "failed"
    few["4x90"]["random"] = runs_of(0.2, seeds=[0])  # one run of ten is no arm without seeds
    assert next(one for one in judge(few, resamples=99)[0].comparisons if one.rival == "random").seeds == 1


def test_an_arm_that_spends_more_is_marked(rng):
    results = {"4x90": setting(rng)}
    results["4x90"]["default"] = runs_of(0.07, spread=0.0003, renders=1100)
    [found] = [each for each in judge(results, resamples=99) if each.name == "H5"]
    assert found.comparisons[0].renders == pytest.approx(1.1)
    assert "| 1.10! |" in judgements_text([found])
    assert dataclasses.replace(found.comparisons[0], renders=1.05).renders == 1.05


def test_the_command_decides_by_folders(capsys, tmp_path, monkeypatch, rng):
    monkeypatch.setitem(judge.__kwdefaults__, "resamples", 99)
    folder = tmp_path / "4x90"
    (folder / "results").mkdir(parents=True)
    options = {"scenes.test_seeds": "5000..5049"}
    (folder / "experiment.json").write_text(json.dumps({"schema": 2, "experiment": "rivals_4x90", "options": options}))
    for arm, runs in setting(rng).items():
        for run in runs:
            file = folder / "results" / f"{arm}_{run['seed']}.json"
            file.write_text(json.dumps({"schema": 2, "arm": arm, **run}))
    from warpav.cli.app import main

    assert main(["experiment", "judge", str(folder), "--out", str(tmp_path / "judged.md")]) == 0
    told = (tmp_path / "judged.md").read_text()
    assert "- 4x90: test scenes that nobody sealed: no evidence" in told
    assert "| H1: the default method is not above any rival, in every seed of every setting | **not decided** |" in told
    assert "experiment judge: expected folders" in complaint(capsys, "experiment", "judge")
    (folder / "experiment.json").write_text(json.dumps({"schema": 2, "experiment": "open", "options": options}))
    assert "experiment: expected a setting of the protocol, each once" in complaint(
        capsys, "experiment", "judge", str(folder)
    )
