"""Experiments from arms to files: what is finished stays, what is missing is done, what does not belong is refused."""

import dataclasses
import json
import shutil

import pytest

from tests.experiments.small_experiment import ARMS, SMALL, config
from warpav.core.errors import InputError
from warpav.experiments import _arms as arms_module
from warpav.experiments import _experiment as module
from warpav.experiments import run_study
from warpav.experiments._arms import Arm, Method
from warpav.rig import read_rig
from warpav.runs import Optimisation, Placement, RunDisplay, git_commit


@pytest.fixture(scope="module")
def finished(tmp_path_factory, scenes):
    """All of the small experiment; nobody may change it."""
    return run(tmp_path_factory.mktemp("small") / "run", scenes)


@pytest.fixture
def copied(tmp_path, finished):
    """A copy of its folder."""
    return shutil.copytree(finished.folder, tmp_path / "run")


def run(out, scenes, *more, **options):
    with RunDisplay() as display:
        return run_study(SMALL, config(scenes, *more), out=out, progress=display, **options)


def without_seconds(result):
    """A result but for its clock."""
    history = {name: column for name, column in result["history"].items() if name != "seconds"}
    return {**result, "seconds": None, "history": history}


def test_every_task_leaves_its_result(finished, scenes):
    assert (finished.failed, finished.done) == ([], 4)
    names = [f"{arm.name}_{seed}" for arm in ARMS for seed in (0, 1)]
    files = sorted(file.name for file in (finished.folder / "results").iterdir())
    assert files == sorted(f"{name}.{ending}" for name in names for ending in ("json", "yaml"))
    for arm in ARMS:
        assert [result["seed"] for result in finished.results[arm.name]] == [0, 1]
        for result in finished.results[arm.name]:
            name = f"{arm.name}_{result['seed']}"
            assert result == json.loads((finished.folder / "results" / f"{name}.json").read_text())
            assert (result["schema"], result["arm"]) == (3, arm.name)
            assert result["commit"] == git_commit()
            rig = read_rig(finished.folder / "results" / f"{name}.yaml")
            assert [camera["position_m"] for camera in result["rig"]["cameras"]] == [
                pytest.approx(camera.position_m, abs=1e-6) for camera in rig.cameras
            ]
            assert result["objects_of_scene"] == [5, 5]
            assert result["metrics"]["objects"] == 10
            assert result["metrics"]["constraint_violation"] == 0.0
            assert result["constraint_loss"] == pytest.approx(0.0, abs=1e-6)
            assert result["history"]["camera_renders"][-1] <= result["camera_renders"]
            assert set(result["seconds"]) == {"load", "search", "evaluate", "total"}
    one, other = finished.results["random_ifr_doa"]
    assert one["rig"] != other["rig"]
    environment = json.loads((finished.folder / "env.json").read_text())
    assert environment["seeds"]["test"] == [2, 3]


def test_the_gradient_arm_is_the_method_of_the_main_job(finished, scenes):
    with RunDisplay() as display:
        problem = Placement.from_config(ARMS[0].evaluation_config(config(scenes, "run.seed=1"))).prepare(display)
    descent = Optimisation.begin(problem).descent
    losses = [descent.step().loss for _ in range(2)]
    found = descent.finish()
    result = finished.results["sgd_ifr_doa"][1]
    assert result["history"]["loss"] == [*losses, None]
    assert result["training_objective"] == found.training_objective
    assert result["camera_renders"] == 2 * (2 * 2 + 2 * 2)  # two cameras: two batches of two, two looks at two scenes


def test_other_cameras_share_the_scenes(tmp_path, scenes, monkeypatch):
    loaded, real = [], module.load_scene_set
    monkeypatch.setattr(module, "load_scene_set", lambda *given: loaded.append(1) or real(*given))
    module.traffic_of_process.__init__()
    narrow = Arm("narrow", "highest", ("camera.fov_deg=60", "rig.cameras=3"))
    done = run(tmp_path / "run", scenes, arms=[Arm("highest", "highest"), narrow, Arm("again", "highest")])
    assert (done.failed, len(loaded)) == ([], 1)
    # and nothing of the ones gets into the others
    one, other, again = (done.results[name][0] for name in ("highest", "narrow", "again"))
    assert without_seconds(one)["metrics"] == without_seconds(again)["metrics"]
    assert {camera["fov_deg"] for camera in other["rig"]["cameras"]} == {60.0}
    module.traffic_of_process.__init__()
    alone = run(tmp_path / "alone", scenes, arms=[narrow])
    assert alone.results["narrow"][0]["metrics"] == other["metrics"]


def test_the_same_command_again_does_nothing(copied, scenes, monkeypatch):
    before = {file: file.stat().st_mtime_ns for file in (copied / "results").iterdir()}
    monkeypatch.setattr(module, "load_scene_set", None)
    monkeypatch.setattr(module, "find_rig_of", None)
    again = run(copied, scenes)
    assert (again.failed, again.done) == ([], 0)
    assert {file: file.stat().st_mtime_ns for file in (copied / "results").iterdir()} == before


def test_what_is_missing_is_done_and_comes_out_the_same(copied, finished, scenes):
    (copied / "results" / "random_ifr_doa_1.json").unlink()
    (copied / "results" / "random_ifr_doa_1.yaml").unlink()
    again = run(copied, scenes)
    assert again.done == 1
    for arm in ARMS:
        assert list(map(without_seconds, again.results[arm.name])) == list(
            map(without_seconds, finished.results[arm.name])
        )


def test_more_runs_and_other_arms_join(copied, scenes):
    highest = Arm("highest", "highest")
    more = run(copied, scenes, arms=[ARMS[1], highest], runs=3)
    assert more.done == 2  # a third random rig, and the highest, which needs one run alone
    assert [len(more.results[arm.name]) for arm in (ARMS[1], highest)] == [3, 1]


def fail(problem, camera_renders_max):
    raise ValueError("a search\n that fails")


def test_a_failing_arm_leaves_the_others_alone(tmp_path, scenes, monkeypatch, capsys):
    monkeypatch.setitem(arms_module.METHODS, "fails", Method(fail))
    chosen = [Arm("broken", "fails"), Arm("highest", "highest")]
    done = run(tmp_path / "run", scenes, arms=chosen, runs=1)
    assert done.failed == ["broken_0: ValueError: a search that fails"]
    assert {arm: len(runs) for arm, runs in done.results.items()} == {"highest": 1}
    assert "broken, run seed 0: failed: ValueError: a search that fails" in capsys.readouterr().out
    monkeypatch.setitem(arms_module.METHODS, "fails", arms_module.METHODS["highest"])
    mended = run(tmp_path / "run", scenes, arms=chosen, runs=1)
    assert (mended.failed, mended.done) == ([], 1)


def interrupt(problem, camera_renders_max):
    raise KeyboardInterrupt


def test_an_interrupted_experiment_goes_on(tmp_path, scenes, monkeypatch, capsys):
    chosen = [Arm("highest", "highest"), Arm("stopped", "start")]
    with monkeypatch.context() as patch:
        patch.setitem(arms_module.METHODS, "start", Method(interrupt))
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "run", scenes, arms=chosen, runs=1)
    assert "the same command goes on from there" in capsys.readouterr().out
    assert run(tmp_path / "run", scenes, arms=chosen, runs=1).done == 1


def test_an_arm_that_is_named_twice_runs_once():
    assert [arm.name for arm in SMALL.arms_of("highest, highest,sgd_ifr_doa ,sgd_ifr_doa")] == [
        "highest",
        "sgd_ifr_doa",
    ]
    both = dataclasses.replace(SMALL, arms=(Arm("highest", "highest"), *ARMS))
    with pytest.raises(InputError, match=r"arms: expected names out of highest, sgd_ifr_doa, .*, got ''") as refused:
        both.arms_of("highest,")
    names = str(refused.value).partition("out of ")[2].partition(", got")[0].split(", ")
    assert len(names) == len(set(names))


def description(folder, **changes):
    file = folder / "experiment.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


def test_a_folder_of_something_else_is_refused(copied, scenes, tmp_path):
    description(copied, schema=7)
    with pytest.raises(InputError, match=r"experiment\.json: schema: expected 3, got 7.*choose another .* `out`"):
        run(copied, scenes)
    description(copied, schema=3, experiment="table9")
    with pytest.raises(InputError, match="experiment: expected small, got 'table9'"):
        run(copied, scenes)
    (tmp_path / "diary").mkdir()
    (tmp_path / "diary" / "today.txt").touch()
    with pytest.raises(InputError, match="diary: out: expected a folder of this experiment"):
        run(tmp_path / "diary", scenes)
    with pytest.raises(InputError, match="expected a folder"):
        run(tmp_path / "diary" / "today.txt", scenes)


def test_results_of_another_configuration_are_refused(copied, scenes):
    with pytest.raises(InputError, match=r"run\.iterations is 2 there and 3 here; choose another folder"):
        run(copied, scenes, "run.iterations=3")
    with pytest.raises(InputError, match="camera_renders_max: expected 16, got None"):
        run(copied, scenes, camera_renders_max=16)
    changed = [dataclasses.replace(ARMS[0], method="start"), ARMS[1]]
    with pytest.raises(InputError, match=r"sgd_ifr_doa_0\.json: expected a result of schema 3 made with this"):
        run(copied, scenes, arms=changed)
    (copied / "results" / "sgd_ifr_doa_0.json").write_text("{")
    with pytest.raises(InputError, match=r"sgd_ifr_doa_0\.json:1: expected valid JSON .*, got: .*; delete it"):
        run(copied, scenes)


def test_a_folder_without_results_takes_another_configuration(copied, scenes):
    for file in (copied / "results").iterdir():
        file.unlink()
    assert run(copied, scenes, "run.iterations=1", arms=[Arm("highest", "highest")]).done == 1


def test_where_and_how_the_tasks_run_does_not_matter_to_the_folder(copied, scenes):
    assert run(copied, scenes, "executor.name=process", "executor.workers=2").done == 0


@pytest.mark.slow
def test_processes_find_what_serial_finds(tmp_path, finished, scenes):
    other = run(tmp_path / "run", scenes, "executor.name=process", "executor.workers=2")
    assert (other.failed, other.done) == ([], 4)
    for arm in ARMS:
        for one, two in zip(finished.results[arm.name], other.results[arm.name], strict=True):
            assert without_seconds(one) == without_seconds(two)
