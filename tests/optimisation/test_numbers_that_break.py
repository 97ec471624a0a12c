"""Settings and scenes at which numbers break: what comes is defined, finite, and never worse than the start."""

import math
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import warpav as wa
from tests.cli.small_run import SMALL
from tests.driving_scene import street
from warpav.core.errors import InputError
from warpav.core.progress import NullProgress
from warpav.detection import Detections
from warpav.runs import Optimisation, Placement
from warpav.runs.config import load_config
from warpav.scene import write_scene

ONE_SCENE = ["scenes.train_seeds=[0]", "scenes.test_seeds=[1000]", "run.batch_size=1"]
SEARCHES = {
    "descent": ["losses.probability=visible_share", "optimiser.search=descent"],
    "pool": ["losses.probability=visible_share", "optimiser.pool_cameras=16", "optimiser.pool_rounds=0"],
}


class Said(NullProgress):
    def __init__(self):
        self.lines = []

    def say(self, text):
        self.lines.append(text)


def searched(search, *options):
    """The search, over; and what it has said. No number of its steps may be anything but finite."""
    said = Said()
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        config = load_config("quick", [*SMALL[:-1], *ONE_SCENE, "optimiser.starts=1", *SEARCHES[search], *options])
        optimisation = Optimisation.begin(Placement.from_config(config).prepare(said), progress=said)
        optimisation.run(progress=said)
        result = optimisation.result()
    assert all(math.isfinite(record.loss) for record in optimisation.records)
    best = optimisation.descent.best
    assert math.isfinite(best.training_objective)
    assert np.isfinite(best.mount_pose).all()
    first = next(each for each in optimisation.records if each.training_objective is not None)
    assert best.training_objective <= first.training_objective
    violation_m = optimisation.placement.objective.constraints.violation_m(result.rig)
    assert violation_m <= 1e-6
    return optimisation, said.lines


@cache
def _scene(seed):
    return street(4, seed)


def scenes(folder, change):
    for seed in (0, 1000):
        write_scene(change(_scene(seed)), folder / f"scene_{seed}.glb")
    return [f"scenes.folder={folder}", "scenes.source=folder"]


def lifted(scene):
    """Everybody 5 km above the street."""
    up_m = np.array([0.0, 0.0, 5000.0])
    users = [
        replace(
            each,
            mesh=replace(each.mesh, vertex_m=(each.mesh.vertex_m + up_m).astype(np.float32)),
            box=replace(each.box, center_m=each.box.center_m + up_m),
        )
        for each in scene.vehicles
    ]
    return replace(scene, vehicles=tuple(users), others=())


RIG = "frame: ego\ncameras:\n"
CAMERA = (
    "  - {{name: camera_{}, position_m: [{}, {}, 1.7], yaw_deg: {}, pitch_deg: 0, roll_deg: 0, fov_deg: 90, "
    "width_px: 96, height_px: 96}}\n"
)


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize(
    "options",
    [
        ["rig.cameras=1"],
        ["camera.fov_deg=170"],
        ["camera.fov_deg=179", "camera.lens=fisheye"],
        ["optimiser.learning_rate_position_m=10", "optimiser.learning_rate_yaw_deg=180"],
    ],
    ids=["one camera", "170 degrees", "179 degrees", "long steps"],
)
def test_settings_at_the_edge_end_with_a_rig(search, options):
    searched(search, *options)


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("places", [[(0.8, 0.2, 0), (0.8, 0.2, 0)], [(9.0, 9.0, 0), (-9.0, -9.0, 180)]])
def test_cameras_in_one_place_and_beyond_the_borders_are_moved_apart_and_back(tmp_path, search, places):
    file = tmp_path / "start.yaml"
    file.write_text(RIG + "".join(CAMERA.format(i, *place) for i, place in enumerate(places)))
    searched(search, f"rig.start={file}")


def test_road_users_out_of_every_frame_are_missed_by_a_descent_and_refused_by_a_pool(tmp_path):
    options = scenes(tmp_path, lifted)
    assert searched("descent", *options)[0].descent.best.training_objective == 1.0
    with pytest.raises(InputError, match="expected cameras that see something, got 18 of which none sees any"):
        searched("pool", *options)


def test_a_loss_that_breaks_ends_the_run_once_and_keeps_the_best(monkeypatch):
    from warpav.optimisation import RigObjective

    evaluate, calls = RigObjective.evaluate, []

    def broken(self, *arguments, **options):
        found = evaluate(self, *arguments, **options)
        calls.append(bool(options.get("gradient")))
        return replace(found, total=math.nan) if options.get("gradient") and sum(calls) == 3 else found

    monkeypatch.setattr(RigObjective, "evaluate", broken)
    optimisation, said = searched("descent", "run.iterations=9", "optimiser.check_every=1")
    assert len(optimisation.records) == 2
    [told] = [line for line in said if "finite" in line]
    assert told.startswith("ended after 2 iterations: iteration 2: expected a finite loss and gradient, got nan; lower")


class Blind:
    """A detector that finds nothing, in a whole run."""

    names = ("car",)

    def detect(self, images_rgb):
        return [Detections.none(self.names) for _ in images_rgb]


def test_a_detector_that_finds_nothing_is_run_and_measured():
    losses = {"in_frame_rotation": 1.0, "detected_area": 10.0}
    config = load_config("quick", [*SMALL[:-1], "optimiser.search=descent", "optimiser.starts=1"])
    placement = wa.Placement(wa.town([0, 1]), config=config, detector=Blind(), losses=losses)
    result = wa.optimise(placement)
    assert np.isfinite(result.history["loss"]).all()
    found = wa.evaluate(result.rig, wa.town([1000]), placement)
    assert found.metrics["rig"].tp_detection_rate == 0.0
