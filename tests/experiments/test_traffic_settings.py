"""The rivals on hard and recorded traffic: composed settings, shipped zones, what is attainable, before a panel too."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from tests.experiments.small_experiment import complaint
from warpav.cli.app import main
from warpav.detection.onnx_detector import BUILTIN_MODEL_PATH
from warpav.experiments import panel, rescore, rival_settings
from warpav.experiments.experiment import overrides_of
from warpav.experiments.traffic_settings import CAMERAS, EGOS, MOUNTS, TARGETS, TRAFFIC, traffic_settings
from warpav.optimisation.baselines import edge_mount_pose, highest_mount_pose
from warpav.optimisation.space import SearchSpace
from warpav.rig.rig import read_rig
from warpav.rig.zone import read_zones, write_zones
from warpav.runs.config import Config, changed_config, load_config
from warpav.runs.detector_fit import MIN_FIT_SCENES
from warpav.runs.mounts import camera_mount, constraints_of
from warpav.runs.vehicle_zones import propose
from warpav.scene.own_vehicle import read_vehicle
from warpav.scene.town.town import ego_vehicle
from warpav.scene.vehicles import file_of

SMALL = (
    "scenes.train_seeds=[0, 1]",
    "scenes.test_seeds=[1000, 1001, 1002]",
    "camera.width_px=96",
    "camera.height_px=96",
    "losses.probability=visible_share",  # needs no fit
    "optimiser.pool_cameras=16",
    "optimiser.selection_time_s=2",
    "run.batch_size=2",
)
ARMS = ("default", "highest", "roof_edge", "random_selected", "cma", "highest_raised")
SETTINGS = traffic_settings()


@pytest.fixture(autouse=True)
def working_directory(working_directory, monkeypatch):
    """An empty working directory; and few resamples, for time."""
    for function in (rival_settings.run_rivals, rescore.run_rescores, panel.run_panel):
        monkeypatch.setitem(function.__kwdefaults__, "resamples", 99)
    return working_directory


# ------------------------------------------------------------------------------------------------ what they are


def test_a_name_says_all_of_a_setting():
    assert len(SETTINGS) == len(TRAFFIC) * len(CAMERAS) * len(MOUNTS) * len(EGOS) * len(TARGETS)
    found = SETTINGS["dense_6_body_bus_all"]
    assert (found.traffic, found.cameras, found.mount, found.ego, found.targets) == ("dense", 6, "body", "bus", "all")
    assert not set(SETTINGS) & set(rival_settings.SETTINGS)


@pytest.mark.parametrize("name", ["dense_2_rack", "sind_4_roof", "sind_6_body", "ngsim_4_body_bus", "dense_6_roof_all"])
def test_settings_are_what_their_names_say(name):
    setting, experiment = SETTINGS[name], SETTINGS[name].experiment
    assert experiment.name == f"rivals_{name}"
    budgets = []
    for quick in (False, True):
        config = load_config("default", overrides_of(experiment, [], quick=quick))
        assert config.rig.cameras == setting.cameras
        assert (config.scenes.source == "traffic") == (setting.traffic != "dense")
        assert config.scenes.level == ("dense" if setting.traffic == "dense" else None)
        assert (config.mount.zones is None) == (setting.mount == "rack")
        assert (config.scenes.ego is not None) == (setting.ego == "bus")
        assert config.scenes.targets == TARGETS[setting.targets]
        assert not set(config.scenes.train_seeds) & set(config.scenes.test_seeds)
        budgets.append(experiment.made_quick().camera_renders_max if quick else experiment.camera_renders_max)
        assert (len(config.scenes.train_seeds) < MIN_FIT_SCENES) == quick  # a small version leaves no fit behind
        for arm in experiment.arms:
            arm.check(config, budgets[-1])
    arms = [arm.name for arm in experiment.arms]
    assert ("highest_raised" in arms) == (setting.mount != "rack")
    assert ("nuscenes_as_built" in arms) == (setting.cameras == 6 and setting.ego == "car")
    assert budgets[0] == {2: 30_000, 4: 45_000, 6: 50_000}[setting.cameras] * (2 if setting.mount == "body" else 1)


@pytest.mark.parametrize("ego", EGOS)
def test_zones_are_those_that_the_body_suggests(ego, tmp_path):
    source = file_of(ego) if ego == "bus" else tmp_path / "car.ply"
    if ego == "car":
        mesh = ego_vehicle()
        whole = trimesh.Trimesh(mesh.vertex_m, mesh.triangle, vertex_colors=mesh.vertex_rgb, process=False)
        whole.export(source)
    list(propose(source, changed_config(Config(), ["rig.free.pitch_deg=[-10, 30]"], origin=None), out=tmp_path / "all"))
    zones = [zone for zone in read_zones(tmp_path / "all") if not zone.is_behind_glass]
    zones = [replace(zone, stand_off_m=(0.0, 0.03)) for zone in zones]
    for mount, chosen in (("body", zones), ("roof", [zone for zone in zones if zone.name == "roof"])):
        write_zones(chosen, tmp_path / "chosen.yaml")
        assert (tmp_path / "chosen.yaml").read_text() == SETTINGS[
            f"dense_4_{mount}{'_bus' * (ego == 'bus')}"
        ].zones.read_text()


@pytest.mark.parametrize("ego", EGOS)
def test_rivals_search_the_whole_body_and_the_highest_rig_stays_on_the_roof(ego):
    setting = SETTINGS["dense_4_body" if ego == "car" else "dense_4_body_bus"]
    config = load_config("default", setting.options)
    mount = camera_mount(config, ego_vehicle() if ego == "car" else read_vehicle(file_of("bus")))
    constraints = constraints_of(config, mount.surface)
    names = [zone.name for zone in mount.surface.zones]
    assert {"roof", "left", "right", "front", "rear"} <= set(names)
    space, rng = SearchSpace.over(mount, 4, constraints=constraints), np.random.default_rng(0)
    drawn = np.concatenate([space.random(rng) for _ in range(40)])
    met = [space.pose_of(rng.uniform(size=space.size)) for _ in range(40)]
    for pose in (drawn, np.concatenate(met).astype(np.float64)):
        reached = {names[k] for k in mount.surface.zone_at(pose[:, :2])}
        assert {"roof", "left", "right", "rear"} <= reached
    for practice in (highest_mount_pose, edge_mount_pose):
        pose = practice(constraints, 4)
        assert {names[k] for k in mount.surface.zone_at(pose[:, :2])} == {"roof"}
    # at the edge, each on the side that it faces
    roof_m = mount.surface.point_m(pose[:, :2], mount.surface.height_at_m(pose[:, :2]))
    assert [roof_m[:, 0].argmax(), roof_m[:, 1].argmax(), roof_m[:, 0].argmin(), roof_m[:, 1].argmin()] == [0, 1, 2, 3]
    assert np.ptp(roof_m[:, 0]) > (1.2 if ego == "car" else 4.0)
    assert constraints.violation_m(mount.rig(pose.astype(np.float32))) == 0.0
    # on the bracket, not on the paint
    off = mount.within(mount.off_the_skin(pose.astype(np.float32)))
    apart_m = [
        b.position_m - a.position_m
        for a, b in zip(mount.rig(pose.astype(np.float32)).cameras, mount.rig(off).cameras, strict=True)
    ]
    np.testing.assert_allclose(np.linalg.norm(apart_m, axis=1), 0.03, atol=2e-3)


def test_bad_words_are_told_in_one_line(capsys):
    for name in ("sind_3_roof", "sind_4", "dense_4_roof_all_bus", "ngsim"):
        told = complaint(capsys, "experiment", "rivals", "--setting", name)
        assert "expected TRAFFIC_CAMERAS_MOUNT such as sind_4_rack" in told
        assert told.endswith(f"got {name}")
    told = complaint(capsys, "experiment", "rivals", "--setting", "ngsim_4_roof")
    assert "scenes.recordings: expected the folder of recordings of NGSIM for the setting ngsim_4_roof" in told
    told = complaint(capsys, "experiment", "rivals", "--setting", "sind_4_rack", "--sealed", "0" * 40)
    assert "--sealed" in told


# ------------------------------------------------------------------------------------------------ from end to end


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """Folder of a small setting on recorded traffic; nobody may change it."""
    folder = tmp_path_factory.mktemp("traffic") / "run"
    words = ["--arms", ",".join(ARMS), "--runs", "2", "--budget", "140", "--out", str(folder)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(rival_settings.run_rivals.__kwdefaults__, "resamples", 99)
        patch.chdir(tmp_path_factory.mktemp("empty"))
        assert main(["experiment", "rivals", "--setting", "sind_2_body", *SMALL, *words]) == 0
    return folder


def runs_in(folder):
    return [json.loads(file.read_text()) for file in sorted((folder / "results").glob("*.json"))]


@pytest.mark.slow
def test_a_setting_says_what_is_missed_of_what_can_be_found(done):
    data = json.loads((done / "rivals_sind_2_body.json").read_text())
    runs = runs_in(done)
    assert [row["arm"] for row in data["misses"]["rows"]] == list(ARMS)
    attainable = runs[0]["attainable"]
    assert 0 < sum(map(sum, attainable)) == data["misses"]["attainable"]
    assert data["misses"]["objects"] == sum(runs[0]["objects_of_scene"])
    for run in runs:
        assert run["attainable"] == attainable  # whatever the arm
        assert [len(each) for each in run["attainable"]] == run["objects_of_scene"]
        assert run["camera_renders"] <= 140
    for row in data["misses"]["rows"]:
        of_arm = [run for run in runs if run["arm"] == row["arm"]]
        for metric, name in (("misses", "misses_per_100"), ("attainable_misses", "attainable_misses_per_100")):
            assert row["misses"][metric]["mean"] == pytest.approx(np.mean([run["metrics"][name] for run in of_arm]))
    goals = [goal["text"] for goal in data["goals"]]
    assert [text.split(",")[0] for text in goals[:4]] == [
        f"fewer misses than {arm}" for arm in ("highest", "roof_edge", "random_selected", "cma")
    ]
    assert [text.split(", by")[0] for text in goals[4:]] == [
        f"attainable misses at least 25% below those of {arm}" for arm in ("highest", "roof_edge")
    ]
    text = (done / "rivals_sind_2_body.md").read_text()
    assert "misses per 100 attainable" in text
    assert "**Goals**" in text


@pytest.mark.slow
def test_the_practice_on_a_rack_is_raised_above_the_zones(done):
    flush, raised = (read_rig(done / "results" / f"{arm}_0.yaml") for arm in ("highest", "highest_raised"))
    for low, high in zip(flush.cameras, raised.cameras, strict=True):
        assert high.position_m[2] - low.position_m[2] == pytest.approx(0.25, abs=0.031)
    [run] = [run for run in runs_in(done) if run["arm"] == "highest_raised"]
    assert run["metrics"]["objective"] is not None


@pytest.mark.slow
def test_a_panel_judges_by_the_same_attainable_objects_and_the_page_shows_it(done, working_directory, capsys):
    folder, networks = shutil.copytree(done, working_directory / "run"), working_directory / "networks"
    networks.mkdir()
    for name in ("one", "other"):  # of the very network of the search
        shutil.copy(BUILTIN_MODEL_PATH, networks / f"{name}.onnx")
    assert main(["experiment", "rescore", str(folder), "--panel", str(networks), "--name", "small"]) == 0
    written = json.loads((folder / "panel_small" / "panel.json").read_text())
    own, one, other = written["misses"]
    assert own["judge"] == "the detector of the search"
    assert (one["judge"], other["judge"]) == ("one", "other")
    assert written["outside"] == []
    assert {goal["reached"] for goal in written["goals"] if "outside" in goal["text"]} == {None}
    assert {**one, "judge": "other"} == other
    assert one["attainable"] == own["attainable"]
    for row, ours in zip(one["rows"], own["rows"], strict=True):
        for metric in ("misses", "attainable_misses"):  # files round poses, which may move a pixel
            assert row["misses"][metric]["mean"] == pytest.approx(ours["misses"][metric]["mean"], abs=3.0)
    assert "outside networks" in (folder / "panel_small" / "panel.md").read_text()
    # the folder has all that judging takes, zones too, wherever it is taken
    assert load_config(folder / "config.yaml").mount.zones == folder / "zones.yaml"
    assert (folder / "zones.yaml").read_bytes() == SETTINGS["sind_2_body"].zones.read_bytes()
    # on other scenes nobody knows what can be found
    assert main(["experiment", "rescore", str(folder), "scenes.test_seeds=[1003]", "--name", "elsewhere"]) == 0
    assert all("attainable" not in run for run in runs_in(folder / "rescored_elsewhere"))
    assert main(["experiment", "results", str(folder), str(folder / "panel_small"), "--out", "page.md"]) == 0
    page = (working_directory / "page.md").read_text()
    assert "## rivals_sind_2_body\n" in page
    assert "## rivals_sind_2_body before the panel small\n" in page
    assert "**Misses by other**" in page


@pytest.mark.slow
def test_the_same_command_does_what_is_missing(done, working_directory, capsys):
    folder = shutil.copytree(done, working_directory / "run")
    (folder / "results" / "cma_1.json").unlink()
    words = ["--arms", ",".join(ARMS), "--runs", "2", "--budget", "140", "--out", str(folder)]
    assert main(["experiment", "rivals", "--setting", "sind_2_body", *SMALL, *words]) == 0
    assert "8 of 9 results are in" in capsys.readouterr().out
