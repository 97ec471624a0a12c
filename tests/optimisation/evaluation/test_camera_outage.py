"""What a rig misses without any one camera: by brute force, in evaluations and their files; weighted recalls beside."""

import dataclasses
import json

import numpy as np
import pytest

from tests.driving_scene import ConstantDetector, roof
from tests.optimisation.evaluation.test_metrics import MODEL, WIDE, ScriptedDetector, answers, rig_of, scene_of
from tests.optimisation.evaluation.test_metrics import SCENES as PLACES
from tests.optimisation.test_missed import probability_model
from warpav.core.errors import InputError
from warpav.detection import Appearance
from warpav.optimisation import (
    OPTIONAL_METRICS,
    ArmMetrics,
    AssignedScene,
    CameraMount,
    CameraOutages,
    CameraProbability,
    ExpectedMissRate,
    Importance,
    ImportanceSettings,
    ObjectiveOptions,
    RigObjective,
    metrics_of,
    observe_scenes,
    paired_differences,
)
from warpav.optimisation._mount import views_of_rig
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.rig import Rig, RigCamera
from warpav.runs import RigEvaluation
from warpav.thesis import BoundsAndSpacing

NEAR = ImportanceSettings(sector_deg=[{"from": -60, "to": 60, "weight": 3.0}, {"from": 60, "to": 120, "weight": 0.5}])


@pytest.fixture(scope="module")
def scenes():
    none = np.full(3, -1, np.int32)
    return [AssignedScene(place(), none) for place in PLACES] + [AssignedScene(scene_of(), none[:0])]


def objective_of(detector=None, importance=None, camera_count=2):
    return RigObjective(
        CameraMount(roof(), camera=MODEL, height_offset_m=0.25),
        detector or ConstantDetector.silent(camera_count),
        camera_count=camera_count,
        losses=[(1.0, ExpectedMissRate())],
        camera_probability=CameraProbability(probability_model(np.random.default_rng(3))),
        constraints=BoundsAndSpacing(roof()),
        options=ObjectiveOptions(occlusion=Occlusion.EXACT),
        importance=importance,
    )


def brute_force(probability, weight):
    """Expected misses per 100 of the rig, and without each camera: a product over the others, object by object."""
    found = []
    for gone in range(-1, len(probability)):
        total = 0.0
        for k in range(probability.shape[1]):
            missed = 1.0
            for camera in range(len(probability)):
                if camera != gone:
                    missed *= 1.0 - min(float(probability[camera, k]), 0.9999)
            total += weight[k] * missed
        found.append(100.0 * total / sum(weight))
    return found


@pytest.mark.parametrize("is_weighted", [False, True])
def test_outages_are_products_over_the_others(rng, is_weighted):
    probability, weight = rng.uniform(0.0, 1.0, (4, 30)), rng.uniform(0.0, 2.0, 30)
    probability[2] = 0.0  # a camera that finds nothing is not missed
    probability[0, :3] = 1.0
    names = ["front", "left", "blind", "rear"]
    found = CameraOutages.of(names, probability, weight if is_weighted else None)
    whole, *without = brute_force(probability, np.ones(30))
    assert found.expected_misses_per_100 == pytest.approx(whole)
    for each, name, expected in zip(found.cameras, names, without, strict=True):
        assert each.camera == name
        assert each.expected_misses_per_100 == pytest.approx(expected)
        assert each.difference_per_100 == pytest.approx(expected - whole, abs=1e-12)
    assert found.cameras[2].difference_per_100 == pytest.approx(0.0, abs=1e-12)
    assert all(found.cameras[k].difference_per_100 > 1.0 for k in (0, 1, 3))
    if not is_weighted:
        assert found.worst.camera == names[int(np.argmax(without))]
        assert "weighted" not in json.dumps(found.to_json())
        return
    whole, *without = brute_force(probability, weight)
    assert found.weighted_expected_misses_per_100 == pytest.approx(whole)
    assert [each.weighted_expected_misses_per_100 for each in found.cameras] == pytest.approx(without)
    assert [each.weighted_difference_per_100 for each in found.cameras] == pytest.approx(np.array(without) - whole)
    assert found.worst.camera == names[int(np.argmax(without))]


def test_the_worst_camera_is_that_of_the_weights():
    probability = np.array([[0.9, 0.9, 0.0], [0.0, 0.0, 0.9]])
    assert CameraOutages.of(["one", "two"], probability).worst.camera == "one"
    assert CameraOutages.of(["one", "two"], probability, np.array([1.0, 1.0, 9.0])).worst.camera == "two"
    assert CameraOutages.of(["one", "two"], probability[:, :0]) is None
    unweighted = CameraOutages.of(["one", "two"], probability)
    assert CameraOutages.of(["one", "two"], probability, np.zeros(3)) == unweighted
    one = CameraOutages.of(["only"], probability[:1])
    assert one.cameras[0].expected_misses_per_100 == 100.0


def test_an_evaluation_knows_what_each_camera_detects(scenes):
    """By the objective's own renders, and those of a rig with another number of cameras: the same probabilities."""
    rig = rig_of()
    of_rig = observe_scenes(rig, scenes, objective_of(), with_probability=True).detection_probability
    assert of_rig.shape == (2, 6)
    assert (of_rig > 0.05).any(axis=1).all()
    third = RigCamera("camera_2", np.array([1.2, 0.3, 1.7]), 1.5, 0.0, 0.0, MODEL)
    wider = Rig([rig.cameras[1], third, rig.cameras[0]])
    of_more = observe_scenes(wider, scenes, objective_of(ConstantDetector.silent(3)), with_probability=True)
    np.testing.assert_allclose(of_more.detection_probability[[2, 0]], of_rig, atol=1e-6)
    assert of_more.losses == []
    # they are the model's own, camera by camera
    views = views_of_rig(wider, rotation_count=1, rotation_step_rad=0.0)
    model = probability_model(np.random.default_rng(3))
    renderer = Renderer([MODEL] * 3, occlusion=Occlusion.EXACT)
    frame = renderer.render(scenes[0].scene.raster, views.position_ego_m, views.camera_from_ego)
    seen = model.on_tape(Appearance.of(frame, scenes[0].scene), views.position_ego_m, views.camera_from_ego)
    np.testing.assert_allclose(of_more.detection_probability[:, :3], seen.probability.numpy(), atol=1e-6)
    # the objective is the expected misses of the whole rig
    expected = objective_of().evaluate(objective_of().mount.mount_pose_of_rig(rig), scenes)
    outages = CameraOutages.of(["a", "b"], of_rig)
    assert outages.expected_misses_per_100 == pytest.approx(100.0 * expected.objective, abs=0.5)
    # nobody has fitted the model for other cameras
    two_models = objective_of(ConstantDetector.silent(1))
    other = observe_scenes(rig_of((MODEL, WIDE)), scenes, two_models, with_probability=True)
    assert other.detection_probability is None


def metrics(scenes, importance):
    rig = rig_of()
    calls = [ConstantDetector(*answer) for answer in answers(rig, scenes[:2])] + [ConstantDetector.silent(2)]
    objective = objective_of(ScriptedDetector(calls), importance)
    return metrics_of(observe_scenes(rig, scenes, objective), objective)


def test_weighted_misses_stand_beside_the_plain_ones(scenes):
    """Found are the cars ahead and behind in the first scene, that ahead in the second; see `test_metrics`."""
    plain, weighted = metrics(scenes, None), metrics(scenes, Importance(NEAR))
    # weights: ahead 3, behind 1, to the left 0.5; ahead 3, ahead on the left 3, behind 1
    assert weighted.weighted_misses_per_100 == pytest.approx(100.0 * (1.0 - 7.0 / 11.5))
    of_scenes = weighted.per_scene["weighted_misses_per_100"]
    assert of_scenes == [pytest.approx(100.0 * 0.5 / 4.5), pytest.approx(100.0 * 4.0 / 7.0), None]
    assert weighted.tp_detection_rate == plain.tp_detection_rate == pytest.approx(3 / 6)
    # all the rest is as without weights, but the objective that takes them
    kept = {name for name in plain.to_json() if name not in ("objective", "per_scene")}
    assert {name: weighted.to_json()[name] for name in kept} == {name: plain.to_json()[name] for name in kept}
    of_weights = {"weighted_misses_per_100"}
    assert set(weighted.to_json()) - set(plain.to_json()) == of_weights
    assert set(weighted.per_scene) - set(plain.per_scene) == of_weights
    assert weighted.objective != pytest.approx(plain.objective, abs=1e-3)
    assert plain.weighted_misses_per_100 is None
    assert "weighted_misses_per_100" in paired_differences(weighted, weighted)
    assert "weighted_misses_per_100" not in paired_differences(weighted, plain)


def evaluation_of(weighted=False):
    outages = CameraOutages.of(
        ["left", "right"], np.array([[0.5, 0.0], [0.0, 0.9]]), np.array([1.0, 3.0]) if weighted else None
    )
    numbers = {each.name: 0.25 for each in dataclasses.fields(ArmMetrics)}
    numbers |= {"recall_by": {}, "per_scene": {}} | ({} if weighted else dict.fromkeys(OPTIONAL_METRICS))
    return RigEvaluation.of({"a": rig_of()}, {"a": ArmMetrics(**numbers)}, ("one",), (), camera_outage={"a": outages})


def test_outages_are_a_table_and_part_of_the_file():
    found = evaluation_of()
    assert [line.split() for line in str(found.outage_table()).splitlines()[2:]] == [
        ["no", "camera", "30.0"],
        ["left", "55.0", "+25.0"],
        ["right", "(worst)", "75.0", "+45.0"],
    ]
    assert found.to_json()["camera_outage"]["a"] == {
        "expected_misses_per_100": pytest.approx(30.0),
        "cameras": [
            {
                "camera": "left",
                "expected_misses_per_100": pytest.approx(55.0),
                "difference_per_100": pytest.approx(25.0),
            },
            {"camera": "right", "expected_misses_per_100": 75.0, "difference_per_100": pytest.approx(45.0)},
        ],
        "worst": "right",
    }
    assert "weighted" not in str(found.table())
    assert "weighted" not in json.dumps(found.to_json())
    with pytest.raises(InputError, match="name: expected one of a, got 'b'"):
        found.outage_table("b")
    unknown = found.model_copy(update={"camera_outage": {"a": None}})
    assert unknown.to_json()["camera_outage"] == {"a": None}
    with pytest.raises(InputError, match="name: expected a rig whose detection probabilities are known"):
        unknown.outage_table()
