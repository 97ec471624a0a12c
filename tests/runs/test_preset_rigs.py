"""Presets beside a run's rig: images in their own proportions, and values as of any other rig."""

import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

import warpav as wa
from warpav.core.errors import InputError
from warpav.core.progress import NullProgress
from warpav.optimisation import observe_scenes
from warpav.rig import Rig, off_vehicle, write_rig
from warpav.runs import find_rig, highest_rig, preset_for
from warpav.runs._evaluate import evaluate_on
from warpav.runs.config import load_config
from warpav.scene import ego_vehicle, file_of, read_vehicle

SMALL = ["scenes.train_seeds=[0]", "scenes.validation_seeds=null", "scenes.test_seeds=[5001, 5002]"]
SHORT = ["run.iterations=3", "optimiser.pool_cameras=16", "optimiser.pool_rounds=0"]
SHORT += ["baselines.random_samples=1", "run.pictures=none"]


@pytest.fixture(scope="module")
def placement():
    return wa.Placement.from_config(load_config("quick", SMALL)).prepare()


@pytest.mark.parametrize(
    ("options", "size_px", "portrait_px"),
    [
        ([], (341, 192), (223, 294)),
        pytest.param(
            ["baselines.preset_images=same_pixels"], (341, 192), (223, 294), marks=pytest.mark.nightly
        ),  # the default
        (["baselines.preset_images=same_width"], (256, 144), (256, 338)),
        (["baselines.preset_images=sensor"], (1600, 900), (1550, 2048)),
        (["camera.width_px=640", "camera.height_px=360"], (640, 360), (418, 552)),
    ],
)
def test_images_keep_their_proportions(options, size_px, portrait_px):
    config, ego = load_config("quick", options), ego_vehicle()
    for name, expected in (("nuscenes", size_px), ("argoverse2", portrait_px)):
        original, found = wa.preset(name).cameras[0].model, preset_for(name, config, ego).rig.cameras[0].model
        assert (found.width_px, found.height_px) == expected
        assert found.fov_rad == original.fov_rad
        assert found.width_px / found.height_px == pytest.approx(original.width_px / original.height_px, rel=5e-3)
        assert found.near_m == 0.01
        # square pixels, so the vertical angle is the original's too
        vertical_rad = [2.0 * math.atan(each.half_field[1]) for each in (original, found)]
        assert vertical_rad[0] == pytest.approx(vertical_rad[1], rel=5e-3)


def test_a_preset_has_the_value_that_its_cameras_give(placement):
    """The product of the misses, object by object, by another way than the objective's."""
    rig = preset_for("nuscenes", placement.config, placement.ego).rig
    before = evaluate_on({"nuscenes": rig}, placement.test, placement, progress=NullProgress())
    assert before.metrics["nuscenes"].objective is None
    placement.add_camera_models(rig)
    found = evaluate_on({"nuscenes": rig}, placement.test, placement, progress=NullProgress())
    metrics, outage = found.metrics["nuscenes"], found.camera_outage["nuscenes"]
    assert outage is not None
    observed = observe_scenes(rig, placement.test, placement.objective, with_probability=True)
    assert observed.detection_probability is not None
    missed = (1.0 - observed.detection_probability.astype(float)).prod(axis=0)
    assert missed.size == metrics.objects
    np.testing.assert_allclose(outage.expected_misses_per_100, 100.0 * missed.mean(), rtol=1e-5)
    np.testing.assert_allclose(metrics.objective, missed.mean(), rtol=1e-5)
    # detection itself is as it was
    assert metrics.tp_detection_rate == before.metrics["nuscenes"].tp_detection_rate


def test_the_mounts_own_cameras_have_the_same_value_either_way(placement):
    """A rig of the run's cameras but for a hair of the near plane, so of another model."""
    rig = highest_rig(placement)
    other = Rig(
        [
            dataclasses.replace(each, model=dataclasses.replace(each.model, near_m=1.0001 * each.model.near_m))
            for each in rig.cameras
        ]
    )
    placement.add_camera_models(other)
    found = evaluate_on({"own": rig, "other": other}, placement.test, placement, progress=NullProgress())
    own, others = (found.metrics[name].objective for name in ("own", "other"))
    assert others is not None
    assert own == pytest.approx(others, rel=1e-5)


def test_a_run_compares_its_rig_with_presets_and_rigs_of_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    today = wa.preset("argoverse2")
    write_rig(Rig(today.cameras[:2]), Path("today.yaml"))
    compared_with = ["baselines.presets=[nuscenes]", "baselines.rigs=[today.yaml]"]
    config = load_config("quick", [*SMALL, "scenes.test_seeds=[5001]", *SHORT, *compared_with])
    assert config.baselines.rigs == (Path("today.yaml"),)
    result = wa.optimise(wa.Placement.from_config(config), progress=False)
    result.save(tmp_path / "run", progress=False)
    arms = json.loads((tmp_path / "run" / "evaluation.json").read_text())["arms"]
    assert list(arms)[-2:] == ["nuscenes", "today"]
    for name, camera_count in (("nuscenes", 6), ("today", 2)):
        assert arms[name]["objective"] is not None
        assert arms[name]["frames"] == camera_count
    assert "nuscenes" in (tmp_path / "run" / "report.html").read_text()
    kept = load_config(str(tmp_path / "run" / "config.yaml"), [])
    assert kept.baselines.rigs == (tmp_path / "today.yaml",)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["highest.yaml"], "expected names unlike those of the other rigs, got 'highest'; rename highest.yaml"),
        (["one.yaml", "b/one.yaml"], "expected names unlike those of the other rigs, got 'one'; rename one.yaml"),
        (["nothing.yaml"], "nothing.yaml:1: expected a mapping with frame, cameras"),
    ],
)
def test_rigs_of_files_are_refused_before_scenes_are_made(names, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in names:
        file = Path(name)
        file.parent.mkdir(exist_ok=True)
        write_rig(wa.preset("nuscenes"), file)
    if names == ["nothing.yaml"]:
        Path("nothing.yaml").write_text("hello: 1\n")
    with pytest.raises(InputError, match=re.escape(message)):
        wa.Placement.from_config(load_config("quick", [f"baselines.rigs=[{', '.join(names)}]"]))


def test_a_preset_is_drawn_where_it_is_measured(caplog):
    config, bus = load_config("quick", ["scenes.ego=bus"]), read_vehicle(file_of("bus"))
    found = find_rig("nuscenes", config, bus)
    measured = preset_for("nuscenes", config, bus).rig
    assert np.allclose([each.position_m for each in found.cameras], [each.position_m for each in measured.cameras])
    assert [each.model for each in found.cameras] == [each.model for each in measured.cameras]
    assert off_vehicle(found, bus) == ""
    assert "nuscenes: put on the body of this vehicle" in caplog.text
    caplog.clear()
    own = find_rig("nuscenes", load_config("quick"), ego_vehicle())
    assert [camera.position_m.tolist() for camera in own.cameras] == [
        camera.position_m.tolist() for camera in wa.preset("nuscenes").cameras
    ]
    assert caplog.text == ""


def test_a_rig_of_another_vehicle_is_told(tmp_path, caplog):
    write_rig(wa.preset("nuscenes"), tmp_path / "mine.yaml")
    find_rig(str(tmp_path / "mine.yaml"), load_config("quick"), read_vehicle(file_of("bus")))
    [told] = caplog.messages
    assert (
        "mine.yaml: expected cameras outside of the vehicle's body and at most 0.5 m off its skin, got 6 of 6" in told
    )
    assert "CAM_FRONT 1.10 m inside" in told
    assert "name the vehicle that carries it by scenes.ego" in told
