"""Numbers of the Python API, to 1e-6 unless said."""

import numpy as np
import pytest

import warpav as wa


@pytest.fixture(scope="module")
def placement():
    config = wa.Config.load("quick", "camera.width_px=64", "camera.height_px=64", "losses.probability=visible_share")
    config = config.replace({"rules": "none"})
    return wa.Placement(wa.town([0, 1]), cameras=3, rig={"symmetric": False}, config=config)


def summary(scene):
    """What tells a scene from another: bounds, sums of vertices, boxes."""
    bodies = [scene.ego, scene.environment]
    return {
        "name": scene.name,
        "vertices": [[len(each.vertex_m), np.asarray(each.vertex_m, float).sum(axis=0)] for each in bodies],
        "objects": [
            [each.category, each.instance_id, len(each.mesh.vertex_m), each.mesh.bounds_m()]
            for each in scene.road_users
        ],
    }


def test_a_town_scene(golden):
    golden("town", [summary(scene) for scene in wa.town([0, 7])], rtol=1e-6, atol=1e-4)


def test_the_objective_and_its_gradient(placement, golden):
    found = []
    for rig in (wa.highest_rig(placement), wa.random_rig(placement, 3)):
        value, gradient = placement.value_and_grad(rig)
        found.append([value, gradient])
    golden("value_and_grad", found, rtol=1e-4, atol=1e-6)


def test_the_detection_probabilities(placement, golden):
    rig = wa.highest_rig(placement)
    golden("detection_probabilities", np.asarray(placement.detection_probabilities(rig), float), rtol=1e-5, atol=1e-6)


def test_rigs_to_compare_with(placement, golden):
    rigs = [wa.highest_rig(placement), *(wa.random_rig(placement, seed) for seed in (0, 1))]
    golden(
        "rigs", [[[*c.position_m, c.yaw_rad, c.pitch_rad] for c in rig.cameras] for rig in rigs], rtol=1e-5, atol=1e-5
    )


def test_what_evaluate_measures(placement, golden):
    rigs = {"highest": wa.highest_rig(placement), "random": wa.random_rig(placement, 3)}
    found = wa.evaluate(rigs, wa.town([1000, 1001]), placement)
    assert "highest" in str(found.table())
    difference = found.difference("highest", "random")
    golden("evaluate", [list(found.recall.values()) if isinstance(found.recall, dict) else found.recall], rtol=1e-5)
    assert difference is not None


def test_what_optimise_finds(placement, golden):
    small = wa.Config.load(
        "quick",
        *("camera.width_px=64", "camera.height_px=64", "losses.probability=visible_share"),
        *("optimiser.pool_cameras=16", "optimiser.pool_rounds=1"),
    )
    result = wa.optimise(wa.Placement(wa.town([0, 1]), cameras=2, config=small), iterations=3, progress=False)
    poses = [[*each.position_m, each.yaw_rad, each.pitch_rad] for each in result.rig.cameras]
    golden("optimise", {"poses": poses, "objective": result.objective, "bound": result.bound}, rtol=1e-4, atol=1e-4)
    assert result.gap == pytest.approx(result.records[-1].training_objective - result.bound, abs=1e-9)


def test_coverage_and_robustness(placement, golden):
    (scene,) = wa.town([3])
    rig = wa.highest_rig(placement)
    found = wa.coverage(rig, scene, heights_m=(0.5, 1.1), radius_m=12.0, cell_m=1.0)
    golden("coverage", {"share": found.covered_share, "blind": found.blind_area_m2, "count": found.count.sum()})


def test_modules_and_requirements(golden):
    names = sorted(wa.read_modules())
    golden("modules", names)


def test_render_counts(golden):
    (scene,) = wa.town([3])
    rig = wa.Rig((wa.Camera("front", np.array([1.2, 0.0, 1.8]), 0.0, 0.0, 0.0, wa.CameraModel(64, 48, 1.6)),))
    image = wa.render(rig, scene)["front"]
    golden(
        "render",
        {"objects": np.unique(image.object_index, return_counts=True), "rgb": image.rgb.mean((0, 1))},
        rtol=1e-4,
    )
