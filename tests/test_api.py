"""The public names of ``import warpav as wa``, and the program of ten lines that its page prints."""

import inspect
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import warpav as wa
from tests.view.stand_ins import needs_opengl
from warpav.runs.config import load_config

TEN_LINES = """
import warpav as wa

train, test = wa.town(range(30)), wa.town(range(5000, 5040))   # or wa.read_scenes("scenes/*.glb")
placement = wa.Placement(train, cameras=4, fov_deg=90, detector="mine.onnx", device="cuda:0")
result = wa.optimise(placement, progress=True)                  # writes nothing
print(result.rig, result.history["objective"][-1])
print(wa.evaluate({"start": result.start, "optimised": result.rig}, test, placement).table())   # rich in a notebook
wa.plot(result, scene=test[0])                                  # a widget in Jupyter, out="rig.png" for a file
wa.export_rig(result.rig, "autoware", "sensor_kit")
result.save("runs/mine")                                        # the run folder that the command line leaves
"""

SMALLER = {
    "range(30)": "range(2)",
    "range(5000, 5040)": "range(5000, 5002)",
    '"mine.onnx"': '"builtin"',
    'device="cuda:0"': 'device="cpu", config=SMALL',
    "progress=True)": "progress=True, iterations=2)",
    "scene=test[0])": 'scene=test[0], out="rig.png")',
}
"""Scenes, detector, device and iterations of the program, and where there is no display, a file."""

SMALL = (
    "camera.width_px=64",
    "camera.height_px=64",
    "optimiser.pool_cameras=16",
    "baselines.random_samples=1",
    "run.pictures=none",
    "scenes.test_seeds=[5000, 5001]",
)


def test_import_takes_a_fraction_of_a_second():
    """CPU time of this import alone, so that other work on the machine does not count."""
    code = "import time; t = time.process_time(); import warpav; print(time.process_time() - t)"
    took = [
        float(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout) for _ in range(3)
    ]
    assert min(took) < 0.2  # worst seen 0.02


def test_every_public_name_is_there_and_nothing_else():
    assert set(dir(wa)) == {*wa.__all__, "__version__"}
    assert 20 <= len(wa.__all__) <= 48
    for name in wa.__all__:
        assert getattr(wa, name) is not None
    assert callable(wa.optimise)
    with pytest.raises(AttributeError, match="has no attribute 'optimize_all'"):
        _ = wa.optimize_all


@needs_opengl
def test_the_ten_lines_run_as_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    program = TEN_LINES
    for printed, small in SMALLER.items():
        assert printed in program
        program = program.replace(printed, small)
    names = {"SMALL": load_config(wa.Config(), SMALL, origin=None)}
    exec(program, names)
    result, out = names["result"], capsys.readouterr().out
    assert "missed per 100, equal false alarms" in out
    assert (tmp_path / "rig.png").stat().st_size > 10_000
    assert any((tmp_path / "sensor_kit").iterdir())
    run = wa.read_run("runs/mine")
    assert [camera.name for camera in run.rig().cameras] == [camera.name for camera in result.rig.cameras]
    assert len(run.events()) == len(result.records) == 2
    assert (run.path / "report.html").is_file()
    evaluation = json.loads((run.path / "evaluation.json").read_text())
    assert list(evaluation["arms"]) == ["optimised", "by_hand", "highest", "random"]
    assert run.config().scenes.train_seeds == (0, 1)


def test_bad_scenes_are_named():
    with pytest.raises(wa.InputError, match="seeds: expected at least one seed"):
        wa.town([])
    with pytest.raises(wa.InputError, match="seeds: expected 0 to 2147483647, got -1"):
        wa.town([-1])
    with pytest.raises(TypeError, match=r"seeds: expected whole numbers such as range\(30\), got 0.5"):
        wa.town([0.5])
    with pytest.raises(wa.InputError, match=r"nowhere/\*.glb: scenes: expected GLB files, got none"):
        wa.read_scenes("nowhere/*.glb")


def test_scenes_come_from_files_in_the_order_of_their_names(tmp_path):
    from warpav.scene import write_scene

    for seed in (1, 0):
        (scene,) = wa.town([seed])
        write_scene(scene, tmp_path / f"scene_{seed}.glb")
    assert [scene.name for scene in wa.read_scenes(tmp_path)] == ["town_0000", "town_0001"]
    assert [scene.name for scene in wa.read_scenes(str(tmp_path / "*1.glb"))] == ["town_0001"]
    assert len(wa.read_scenes([tmp_path / "scene_1.glb", tmp_path])) == 3


def test_the_page_of_names_lists_every_public_name():
    page = (Path(__file__).parents[1] / "docs/reference/api.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `wa\.(\w+)", page, re.MULTILINE)
    assert set(listed) == set(wa.__all__)


def test_written_scenes_are_read_in_the_same_order(tmp_path):
    from warpav.runs import load_scenes

    scenes = wa.town([3, 1]) * 6  # twelve files: scene_10 comes after scene_2
    files = wa.write_scenes(scenes, tmp_path / "new" / "folder")
    assert [file.name for file in files] == [f"scene_{k}.glb" for k in range(12)]
    read = wa.read_scenes(tmp_path / "new" / "folder")
    assert [scene.name for scene in read] == [scene.name for scene in scenes]
    np.testing.assert_array_equal(read[10].ego.vertex_m, scenes[10].ego.vertex_m)
    config = wa.Config.load("quick", "scenes.source=folder", f"scenes.folder={tmp_path / 'new' / 'folder'}")
    assert [scene.name for scene in load_scenes(config, [0, 11])] == ["town_0003", "town_0001"]
    assert [file.name for file in wa.write_scenes(scenes[0], tmp_path / "one")] == ["scene_0.glb"]
    with pytest.raises(wa.InputError, match="scenes: expected at least one scene, got none"):
        wa.write_scenes([], tmp_path)
    with pytest.raises(TypeError, match=r"scenes: expected scenes, .* got str"):
        wa.write_scenes(["scene"], tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(wa.InputError, match="file: folder: expected a folder to write to, got: File exists"):
        wa.write_scenes(scenes, tmp_path / "file")


def test_render_gives_the_images_of_every_camera_by_name():
    from warpav.detection import render_images

    (scene,) = wa.town([3])
    narrow, wide = wa.CameraModel(48, 32, 1.2), wa.CameraModel(64, 48, 2.0)
    rig = wa.Rig(
        (
            wa.Camera("front", np.array([1.2, 0.0, 1.8]), 0.0, 0.0, 0.0, narrow),
            wa.Camera("rear", np.array([0.0, 0.0, 1.9]), np.pi, 0.1, 0.0, wide),
        )
    )
    images = wa.render(rig, scene, supersampling=2)
    assert list(images) == ["front", "rear"]
    assert images["front"].rgb.shape == (32, 48, 3)
    assert images["rear"].depth_m.shape == (48, 64)
    for camera, image in zip(rig.cameras, images.values(), strict=True):
        (alone,) = render_images(scene, [camera], supersampling=2)
        np.testing.assert_array_equal(image.rgb, alone.rgb)
        np.testing.assert_array_equal(image.object_index, alone.object_index)
    with pytest.raises(wa.InputError, match="device: expected one of cpu"):
        wa.render(rig, scene, device="cuda:99")


def test_coverage_is_that_of_the_ground_around_the_vehicle():
    from warpav.scene import DeviceScene
    from warpav.sight import Ground

    (scene,) = wa.town([3])
    rig = wa.Rig((wa.Camera("front", np.array([1.2, 0.0, 1.8]), 0.0, 0.0, 0.0, wa.CameraModel(64, 64, 1.6)),))
    found = wa.coverage(rig, scene, heights_m=(1.1,), radius_m=8.0, cell_m=1.0)
    expected = Ground.around(DeviceScene.pack(scene, device="cpu"), radius_m=8.0, cell_m=1.0).coverage(
        rig.cameras, heights_m=(1.1,)
    )
    np.testing.assert_array_equal(found.count, expected.count)
    assert 0.0 < found.covered_share[0] < 0.5
    assert found.blind_area_m2.shape == (1,)
    with pytest.raises(ValueError, match="heights_m must be positive"):
        wa.coverage(rig, scene, heights_m=(0.0,))
    with pytest.raises(wa.InputError, match="device: expected one of cpu"):
        wa.coverage(rig, scene, device="cuda:99")


def test_a_detector_is_read_as_a_placement_reads_it():
    from warpav.runs import load_detector

    (scene,) = wa.town([3])
    rig = wa.Rig((wa.Camera("front", np.array([1.2, 0.0, 1.8]), 0.0, 0.0, 0.0, wa.CameraModel(256, 256, 1.6)),))
    image_rgb = wa.render(rig, scene)["front"].rgb[None]
    (found,) = wa.read_detector().detect(image_rgb)
    (expected,) = load_detector(wa.Config()).detect(image_rgb)
    np.testing.assert_array_equal(found.box_px, expected.box_px)
    assert len(found) > 0
    least = float(np.median(found.confidence))
    (sure,) = wa.read_detector(confidence_min=least).detect(image_rgb)
    assert len(sure) == np.count_nonzero(found.confidence >= least)
    (people,) = wa.read_detector(targets=["pedestrian"]).detect(image_rgb)
    assert set(people.label) <= {"pedestrian"}
    with pytest.raises(wa.InputError, match=r"detector\.label: expected one of .*did you mean detector\.labels"):
        wa.read_detector(label=["car"])
    with pytest.raises(wa.InputError, match=r"none\.onnx"):
        wa.read_detector("none.onnx")


def test_rigs_to_compare_with_need_no_search():
    placement = wa.Placement(wa.town([0]), cameras=3, rig={"symmetric": False})
    highest = wa.highest_rig(placement)
    assert len(highest.cameras) == 3
    top_m = placement.mount.surface.height_m.max() + placement.config.rig.height_offset_m
    assert max(camera.position_m[2] for camera in highest.cameras) == pytest.approx(top_m, abs=0.02)
    first, again, other = (wa.random_rig(placement, seed) for seed in (4, 4, 5))
    places = [np.array([camera.position_m for camera in rig.cameras]) for rig in (first, again, other)]
    np.testing.assert_array_equal(places[0], places[1])
    assert np.abs(places[0] - places[2]).max() > 0.01
    for rig in (highest, first, other):
        assert placement.objective.constraints.violation_m(rig) <= 1e-5


def test_a_search_begins_with_the_best_rig_by_hand_and_says_what_it_finds_more():
    placement = wa.Placement(wa.town([0]), cameras=4, requirements=None, config=wa.Config.load("quick", *SMALL))
    corners = wa.rig_by_hand("corners", placement, angle_deg=40)
    np.testing.assert_allclose(sorted(np.degrees([camera.yaw_rad for camera in corners.cameras])), [-140, -40, 40, 140])
    result, best = wa.optimise(placement), wa.rig_by_hand("best", placement)
    for one, other in zip(result.start.cameras, best.cameras, strict=True):
        np.testing.assert_allclose([*one.position_m, one.yaw_rad], [*other.position_m, other.yaw_rad])
    said = result.why(wa.town([5000]))
    assert re.match(r"It finds \d+ vehicles? that the best rig by hand does not detect.* It loses .*Its cameras", said)
    with pytest.raises(wa.InputError, match="angle_deg: expected 0 to 90 with corners, none with others, got 40"):
        wa.rig_by_hand("cross", placement, angle_deg=40)


def test_scenes_of_a_configuration_come_by_split():
    config = wa.Config.load("quick", "scenes.source=traffic", "scenes.train_seeds=[3]", "scenes.test_seeds=[4]")
    recordings = [[scene.source for scene in wa.load_scenes(config, split)] for split in ("train", "test")]
    assert recordings[0] != recordings[1]
    with pytest.raises(wa.InputError, match="seeds: expected numbers or one of train, validation, test, got 'all'"):
        next(wa.load_scenes(config, "all"))


def test_a_vehicle_is_read_into_the_ego_frame(tmp_path):
    import trimesh

    ego = wa.town([0])[0].ego
    x, y, z = ego.vertex_m.astype(float).T
    turned = 100.0 * np.stack([-y, x + 1.0, z], axis=1)  # centimetres, y forward, origin 1 m behind the axle
    trimesh.Trimesh(turned, ego.triangle, process=False).export(tmp_path / "car.stl")
    read = wa.read_vehicle(tmp_path / "car.stl", up="z", forward="y", scale=0.01)
    np.testing.assert_allclose(read.bounds_m(), ego.bounds_m(), atol=0.05)
    with pytest.raises(wa.InputError, match=r"car\.stl: units: .*right in centimetres; read it with scale=0\.01"):
        wa.read_vehicle(tmp_path / "car.stl", up="z", forward="y")
    with pytest.raises(wa.InputError, match="forward: expected an axis across z"):
        wa.read_vehicle(tmp_path / "car.stl", up="z", forward="-z")
    with pytest.raises(wa.InputError, match="up: expected one of x, y, z"):
        wa.read_vehicle(tmp_path / "car.stl", up="w")


def test_docstrings_of_what_is_exported_are_whole():
    """Ruff's rules on docstrings, of these names alone: every public method has one, which names every argument."""
    lacking = []
    for name in wa.__all__:
        found = getattr(wa, name)
        members = vars(found).items() if inspect.isclass(found) else ()
        for each in (found, *(each for key, each in members if inspect.isfunction(each) and key[0] != "_")):
            text = inspect.getdoc(each) or ""
            asked = set(inspect.signature(each).parameters) - {"self"} if inspect.isroutine(each) else ()
            missing = [argument for argument in asked if "Args:" in text and not re.search(rf"\b{argument}\b", text)]
            if not text or missing:
                lacking.append((name, getattr(each, "__qualname__", name), missing))
    assert not lacking
