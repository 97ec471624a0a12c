"""Placements, results and evaluations as objects: arguments, gradients, oracles, what is written and what is not."""

import re

import numpy as np
import pytest

import warpav as wa
from tests.cli.small_run import RESUMED_POOL
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.core.progress import NullProgress
from warpav.detection import Detections
from warpav.rig import write_rig
from warpav.runs import Optimisation, Placement, RunFolder
from warpav.scene import ego_vehicle

SMALL = [
    "camera.width_px=96",
    "camera.height_px=96",
    "rig.cameras=2",
    "optimiser.starts=2",
    "optimiser.check_every=2",
    "baselines.random_samples=2",
    "run.pictures=none",
    # detection probability would have to be fitted for so small a camera
    "losses={expected_miss_rate: 0, in_frame_rotation: 1, object_visibility: 10}",
]


class LowerHalf:
    """One box over the lower half of every image."""

    names = ("car",)

    def __init__(self):
        self.asked = 0

    def detect(self, images_rgb):
        images_rgb = np.asarray(images_rgb)
        self.asked += len(images_rgb)
        height, width = images_rgb.shape[1:3]
        box = np.array([[0.0, height / 2, width, height]], np.float32)
        return [Detections(box, np.ones(1, np.float32), np.zeros(1, np.int32), self.names) for _ in images_rgb]


@pytest.fixture(scope="module")
def config():
    return wa.Config.load("quick", *SMALL)


@pytest.fixture(scope="module")
def train():
    return wa.town([0, 1])


@pytest.fixture(scope="module")
def test_scenes():
    return wa.town([1000, 1001])


@pytest.fixture(scope="module")
def placement(config, train):
    return wa.Placement(train, config=config)


@pytest.fixture(scope="module")
def result(placement):
    return wa.optimise(placement, iterations=3, seed=1)


def test_objects_and_yaml_give_the_same_run(config, result):
    """The same scenes by seeds in a configuration: the same loss of every iteration and the same rig, bit by bit."""
    options = ["scenes.train_seeds=[0, 1]", "scenes.test_seeds=[1000]", "run.batch_size=2", "run.iterations=3"]
    by_file = wa.Config.load("quick", *SMALL, *options, "run.seed=1").placement()
    other = wa.optimise(by_file)
    assert other.history["loss"] == result.history["loss"]
    for one, two in zip(result.rig.cameras, other.rig.cameras, strict=True):
        np.testing.assert_array_equal(one.ego_from_camera, two.ego_from_camera)


def test_an_optimisation_writes_nothing(config, train, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wa.optimise(wa.Placement(train[:1], config=config), iterations=1)
    assert list(tmp_path.iterdir()) == []


def test_the_rig_of_a_result_that_is_worse_is_its_start(config, train):
    steps = ["optimiser.keep=last", "optimiser.learning_rate_position_m=2", "optimiser.starts=1", "rig.start=highest"]
    worse = wa.optimise(wa.Placement(train, config=wa.Config.load("quick", *SMALL, *steps)), iterations=4)
    assert worse.is_worse_than_start  # steps of 2 m throw the cameras about
    assert worse.rig is worse.start
    assert worse.objective == worse.start_objective < worse.found_objective
    assert "worse than its start" in repr(worse)


@pytest.mark.parametrize("column", ["x_m", "yaw_rad"])
def test_the_gradient_is_that_of_the_objective(train, result, column):
    """Against central differences over 10 mm and 10 mrad, where 8 x 8 samples a pixel make areas smooth."""
    losses = {"in_frame_rotation": 1.0}
    config = wa.Config.load("quick", *SMALL, "camera.supersampling=8")
    placement = wa.Placement(train, config=config, losses=losses)
    rig = result.start
    value, gradient = placement.value_and_grad(rig)
    pose, scenes = placement.mount.mount_pose_of_rig(rig), placement.assigned(placement.train, rig)
    assert value == pytest.approx(placement.objective.evaluate(pose, scenes).objective)
    assert [set(each) for each in gradient.values()] == [{"x_m", "y_m", "yaw_rad", "pitch_rad"}] * len(rig.cameras)
    number = {"x_m": 0, "yaw_rad": 2}[column]
    differences = []
    for k in range(len(rig.cameras)):
        moved = np.stack([pose, pose])
        moved[:, k, number] += [0.01, -0.01]
        high, low = (placement.objective.evaluate(each, scenes).objective for each in moved)
        differences.append((high - low) / 0.02)
    exact = [gradient[camera.name][column] for camera in rig.cameras]
    np.testing.assert_allclose(exact, differences, rtol=0.05, atol=0.02)


def test_a_rig_that_does_not_fit_is_named(placement):
    with pytest.raises(wa.InputError, match="rig: expected 2 cameras as the placement has, got 6"):
        placement.value_and_grad(wa.preset("nuscenes"))
    with pytest.raises(TypeError, match="rig: expected a Rig, got str"):
        placement.value_and_grad("highest")
    with pytest.raises(wa.InputError, match="losses: expected a loss that knows detection probabilities"):
        placement.detection_probabilities(Optimisation.begin(placement).start)


def test_any_object_that_detects_is_a_detector(config, train, test_scenes):
    detector = LowerHalf()
    placement = wa.Placement(train[:1], config=config, detector=detector, losses={"detected_area": 1.0})
    wa.optimise(placement, iterations=1)
    found = wa.evaluate(wa.optimise(placement, iterations=1).rig, test_scenes, placement)
    assert detector.asked > 0
    assert list(found.metrics) == ["rig"]
    with pytest.raises(TypeError, match="detector: expected the path of an ONNX file"):
        wa.Placement(train, detector=3)


def test_any_mesh_is_a_vehicle(config, train):
    mesh = ego_vehicle()
    pair = wa.Placement(train, config=config, ego=(mesh.vertex_m, mesh.triangle)).prepare()
    corner_m, own_m = (np.sort(each.vertex_m[each.triangle], axis=1) for each in (pair.ego, mesh))
    np.testing.assert_allclose(corner_m, own_m)  # shaded, so corners share no vertices
    with pytest.raises(wa.InputError, match=r"ego: expected .* \[vertex, 3\]|ego: expected vertices of shape"):
        wa.Placement(train, config=config, ego=(mesh.vertex_m[:, :2], mesh.triangle))
    with pytest.raises(wa.InputError, match=r"ego: .*NaN"):
        wa.Placement(train, config=config, ego=(mesh.vertex_m * np.nan, mesh.triangle))
    with pytest.raises(TypeError, match="ego: expected the path of a mesh file, a Mesh"):
        wa.Placement(train, config=config, ego=5)


def test_a_rig_can_be_the_start_and_cameras_of_it_stay(config, train, result):
    start = result.start
    name = start.cameras[0].name
    found = wa.optimise(wa.Placement(train, config=config, start=start, freeze=name), iterations=2)
    np.testing.assert_array_equal(found.rig.cameras[0].ego_from_camera, start.cameras[0].ego_from_camera)
    with pytest.raises(wa.InputError, match="freeze: expected a rig as `start`"):
        wa.Placement(train, config=config, freeze=["front"])
    with pytest.raises(wa.InputError, match=r"start: expected a rig of 3 cameras, .* name in `freeze` those that stay"):
        wa.Placement(train, config=config, start=start, cameras=3)
    more = wa.Placement(train, config=config, start=start, freeze=name, cameras=3)
    assert [camera.name for camera in more.start_rig.cameras] == [*(each.name for each in start.cameras), "added_1"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cameras": 0}, r"^rig.cameras: expected a whole number from 1 to 16, got 0"),
        ({"fov_deg": 400}, r"^camera.fov_deg: expected an angle"),
        ({"device": "cuda"}, r"^device: expected cpu or a GPU such as cuda:0, got 'cuda'"),
        ({"detector": "none.onnx"}, r"^detector.model: expected builtin or the path of an ONNX file"),
        ({"modules": {"fisheye_3mp_19": 1}}, r"^rig.modules: expected modules out of .* did you mean fisheye_3mp_190"),
        ({"rig": {"min_space": 1}}, r"^rig.min_space: expected one of cameras, start.*did you mean rig.min_spacing_m"),
    ],
)
def test_arguments_that_cannot_be_used_are_named(train, arguments, message):
    with pytest.raises(wa.InputError, match=message):
        wa.Placement(train, **arguments)


def test_an_evaluation_says_which_camera_sees_what(placement, result, test_scenes):
    found = wa.evaluate({"start": result.start, "optimised": result.rig}, test_scenes, placement)
    assert len(found.objects) == sum(len(scene.vehicles) for scene in test_scenes)
    for name in ("start", "optimised"):
        detected = sum(bool(seen.detected_by[name]) for seen in found.objects)
        assert found.misses[name] == pytest.approx(100.0 * (1.0 - detected / len(found.objects)))
        visible = sum(bool(seen.seen_by[name]) for seen in found.objects)
        assert found.metrics[name].visible_rate == pytest.approx(visible / len(found.objects))
        assert all(set(seen.detected_by[name]) <= set(seen.seen_by[name]) for seen in found.objects)
    same = found.difference("start", "start")
    assert (same.mean, same.low, same.high) == (0.0, 0.0, 0.0)
    assert "per 100" in str(found.table())
    assert str(found.table()).splitlines()[-1].endswith("difference() has intervals.")
    assert "<caption" in found._repr_html_()
    assert found._repr_html_().startswith("<table>")
    with pytest.raises(wa.InputError, match="other: expected one of start, optimised, got 'best'"):
        found.difference("start", "best")
    pandas = pytest.importorskip("pandas")
    frame = found.to_pandas()
    assert isinstance(frame, pandas.DataFrame)
    assert frame.loc["start", "tp_detection_rate"] == found.recall["start"]


def test_a_run_of_own_scenes_is_saved_with_them(config, train, test_scenes, tmp_path):
    """Scenes that no seed names go into the folder, and the folder can be evaluated from there."""
    from dataclasses import replace

    own = [replace(scene, source="a drone") for scene in train]
    placement = wa.Placement(own, config=config)
    result = wa.optimise(placement, iterations=1)
    with pytest.raises(wa.InputError, match="test: expected scenes to compare rigs on"):
        result.save(tmp_path / "run")
    folder = result.save(tmp_path / "run", test=test_scenes)
    assert len(list((folder / "scenes").glob("scene_*.glb"))) == 4
    saved = wa.read_run(folder).config()
    assert (saved.scenes.source, saved.scenes.train_seeds, saved.scenes.test_seeds) == ("folder", (0, 1), (2, 3))
    again = Placement.from_config(saved).prepare()
    assert len(again.test) == 2


def test_progress_is_any_object_with_its_methods(placement):
    class Lines:
        def __init__(self):
            self.lines = []

        def say(self, text):
            self.lines.append(text)

        stage = show = say

        def steps(self, description, items, *, count):
            self.lines.append(description)
            yield from items

        def iterations(self, records, *, count, min_spacing_m):
            for record in records:
                self.lines.append(record.iteration)
                yield record

    lines = Lines()
    wa.optimise(placement, progress=lines, iterations=2)
    assert lines.lines[-2:] == [0, 1]
    with pytest.raises(TypeError, match="progress: expected True, False or an object"):
        wa.optimise(placement, progress="yes")


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"iterations": 0}, ValueError, "iterations: expected at least 1, got 0"),
        ({"seed": -1}, ValueError, "seed: expected at least 0, got -1"),
        ({"iterations": 1.5}, TypeError, "iterations: expected a whole number, got 1.5"),
    ],
)
def test_bad_numbers_of_a_run_are_named(placement, arguments, error, message):
    with pytest.raises(error, match=message):
        wa.optimise(placement, **arguments)


def test_a_function_of_the_probabilities_is_a_loss(train):
    """The share of objects that no camera finds, written as a user would, is the loss that warpav has for it."""

    def missed(probability, objects):
        miss = 1.0 - probability
        others = np.stack([np.prod(np.delete(miss, k, axis=0), axis=0) for k in range(len(miss))])
        return float(miss.prod(axis=0).mean()), -others / probability.shape[1]

    config = wa.Config.load("quick", "optimiser.starts=1", "rig.start=random", "rig.symmetric=false")
    own = wa.Placement(train[:1], config=config, losses=[(2.0, missed)])
    built_in = wa.Placement(train[:1], config=config, losses=[(2.0, wa.losses.ExpectedMissRate())])
    rig = Optimisation.begin(built_in).start
    value, gradient = own.value_and_grad(rig)
    expected, expected_gradient = built_in.value_and_grad(rig)
    assert value == pytest.approx(expected, rel=1e-4)
    probability = built_in.detection_probabilities(rig)
    assert value == pytest.approx(2.0 * missed(probability, None)[0], rel=1e-4)
    slopes, expected_slopes = ([*map(dict.values, each.values())] for each in (gradient, expected_gradient))
    slopes, expected_slopes = (np.array([list(camera) for camera in each]) for each in (slopes, expected_slopes))
    # 1 - p of a p near 1 has few digits in single precision: worst seen 0.014 of the largest slope
    np.testing.assert_allclose(slopes, expected_slopes, rtol=1e-3, atol=2e-2 * np.abs(expected_slopes).max())


def test_what_is_optimised_is_what_is_reported_with_weights(train):
    """Objective and evaluation of one scene are one weighted mean of what the single cameras miss."""
    weights = {"distance_m": {0: 1.0, 20: 4.0}, "sector_deg": [{"from": 90, "to": 270, "weight": 0.5}]}
    config = wa.Config.load("quick", "rig.start=random", "rig.symmetric=false")
    placement = wa.Placement(train[:1], config=config, importance=weights)
    assert placement.config.importance.distance_m == {0.0: 1.0, 20.0: 4.0}
    rig = Optimisation.begin(placement).start
    missed = np.prod(1.0 - np.minimum(placement.detection_probabilities(rig), 0.9999), axis=0)
    place_m = np.array([vehicle.box.center_m[:2] for vehicle in train[0].vehicles])
    weight = np.where(np.hypot(*place_m.T) < 20.0, 1.0, 4.0) * np.where(place_m[:, 0] < 0.0, 0.5, 1.0)
    assert len(set(weight)) > 2
    expected = weight @ missed / weight.sum()
    assert expected != pytest.approx(missed.mean(), abs=1e-3)
    assert placement.value_and_grad(rig)[0] == pytest.approx(expected, rel=1e-5)
    found = wa.evaluate(rig, train[:1], placement)
    assert found.metrics["rig"].objective == pytest.approx(expected, rel=1e-4)
    outages = found.camera_outage["rig"]
    assert outages.weighted_expected_misses_per_100 == pytest.approx(100.0 * expected, rel=1e-4)
    assert outages.expected_misses_per_100 == pytest.approx(100.0 * missed.mean(), rel=1e-4)
    assert [each.camera for each in outages.cameras] == [camera.name for camera in rig.cameras]
    detected = np.array([bool(seen.detected_by["rig"]) for seen in found.objects])
    missed = 100.0 * (1.0 - weight @ detected / weight.sum())
    assert found.metrics["rig"].weighted_misses_per_100 == pytest.approx(missed)
    assert "the same, weighted" in str(found.table())
    assert "(worst)" in str(found.outage_table())
    with pytest.raises(wa.InputError, match=r"importance\.category: .* got 'buss'; did you mean bus\?"):
        wa.Placement(train[:1], importance={"category": {"buss": 2.0}}).prepare()


def test_a_run_of_a_detector_that_is_an_object_is_not_evaluated_with_another(config, tmp_path, capsys):
    folder = RunFolder.create(
        config.model_copy(update={"run": config.run.model_copy(update={"out": tmp_path / "run"})}),
        name="run",
        own_detector="LowerHalf",
    )
    write_rig(wa.preset("nuscenes"), folder.rig_path("best"))
    assert main(["evaluate", str(folder.path)]) == 2
    error = capsys.readouterr().err
    assert "detector.model: expected the ONNX file of the run's detector" in error
    assert "LowerHalf" in error
    assert "rig_best.yaml" in error


class Told(NullProgress):
    """Keeps the steps that it hears of; raises once a search has come to a stage."""

    def __init__(self, ends_at=None):
        self.ends_at, self.steps_of, self.said = ends_at, [], []

    def say(self, text):
        self.said.append(text)

    stage = say

    def steps(self, description, items, *, count):
        self.steps_of.append(description)
        return super().steps(description, items, count=count)

    def iterations(self, records, *, count, min_spacing_m):
        for record in records:
            yield record
            if record.stage == self.ends_at:
                raise KeyboardInterrupt


@pytest.mark.parametrize("scenes", ["embedded", "objects"])
def test_a_call_that_was_interrupted_goes_on_in_its_folder(tmp_path, scenes):
    config = wa.Config.load("quick", *RESUMED_POOL)
    train, test = wa.town([0, 1]), wa.town([1000])
    own = {} if scenes == "embedded" else {"ego": (ego_vehicle().vertex_m, ego_vehicle().triangle)}

    def optimised(name, progress=None, **others):
        placement = wa.Placement(train, config=config, **own, **others)
        return wa.optimise(placement, folder=tmp_path / name, test=test if own else None, progress=progress)

    told = Told("selection")
    with pytest.raises(KeyboardInterrupt) as stopped:
        optimised("stopped", told)
    ways = "" if own else rf"warpav optimise --resume {tmp_path}/stopped or "
    assert re.search(
        rf"is in {tmp_path}/stopped, .*; {ways}the same call of wa\.optimise goes on$", *stopped.value.__notes__
    )
    [forecast] = [each for each in told.said if each.startswith("forecast")]
    assert re.search(r"about \d+ s and \d\.\d GB of memory for the search, which draws some \d+", forecast)
    assert told.said.index(forecast) < told.said.index(next(each for each in told.said if "selecting" in each))
    assert RunFolder.open(tmp_path / "stopped").evaluation() is None
    told = Told()
    found, expected = optimised("stopped", told), optimised("at_once")
    assert not [each for each in told.steps_of if "seen by" in each]
    assert [each.objective for each in (found, expected)] == [found.objective] * 2
    for role in ("best", "final"):
        files = [RunFolder.open(tmp_path / name).rig_path(role) for name in ("stopped", "at_once")]
        assert files[0].read_bytes() == files[1].read_bytes()
    assert optimised("stopped").records == found.records  # it has ended
    with pytest.raises(InputError, match=r"^placement \(rig\.cameras\): expected the values of the run"):
        optimised("stopped", cameras=3)
    train = wa.town([0, 2])
    with pytest.raises(InputError, match=r"^(checkpoint: scenes|placement \(scenes\.train_seeds\)): expected"):
        optimised("stopped")
