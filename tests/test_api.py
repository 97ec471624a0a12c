"""The public names of ``import warpav as wa``, and the program of ten lines that its page prints."""

import ast
import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

import warpav as wa
from tests.view.stand_ins import needs_opengl

TEN_LINES = """
import warpav as wa

train, test = wa.town(range(30)), wa.town(range(1000, 1010))   # or wa.read_scenes("scenes/*.glb")
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
    "range(1000, 1010)": "range(1000, 1002)",
    '"mine.onnx"': '"builtin"',
    '"cuda:0"': '"cpu"',
    "progress=True)": "progress=True, iterations=2)",
    "scene=test[0])": 'scene=test[0], out="rig.png")',
}
"""Scenes, detector, device and iterations of the program, and where there is no display, a file."""


def test_import_takes_a_fraction_of_a_second():
    """CPU time of this import alone, so that other work on the machine does not count."""
    code = "import time; t = time.process_time(); import warpav; print(time.process_time() - t)"
    took = [
        float(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout) for _ in range(3)
    ]
    assert min(took) < 0.2  # worst seen 0.02


def test_every_public_name_is_there_and_nothing_else():
    assert set(dir(wa)) == {*wa.__all__, "__version__"}
    assert 20 <= len(wa.__all__) <= 30
    for name in wa.__all__:
        assert getattr(wa, name) is not None
    assert callable(wa.optimise)
    with pytest.raises(AttributeError, match="has no attribute 'optimize_all'"):
        _ = wa.optimize_all


def test_editors_know_the_same_names():
    """What the stub imports is what `__getattr__` gives."""
    tree = ast.parse(Path(wa.__file__).with_suffix(".pyi").read_text())
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom) and node.module != "typing"]
    typed = {alias.asname or alias.name: (node.module, alias.name) for node in imports for alias in node.names}
    assert typed.keys() == set(wa.__all__)
    for name, (module, attribute) in typed.items():
        assert getattr(importlib.import_module(module), attribute) is getattr(wa, name)


@needs_opengl
def test_the_ten_lines_run_as_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    program = TEN_LINES
    for printed, small in SMALLER.items():
        assert printed in program
        program = program.replace(printed, small)
    names = {}
    exec(program, names)
    result, out = names["result"], capsys.readouterr().out
    assert "recall of the rig" in out
    assert (tmp_path / "rig.png").stat().st_size > 10_000
    assert any((tmp_path / "sensor_kit").iterdir())
    run = wa.read_run("runs/mine")
    assert [camera.name for camera in run.rig().cameras] == [camera.name for camera in result.rig.cameras]
    assert len(run.events()) == len(result.records) == 2
    assert (run.path / "report.html").is_file()
    evaluation = json.loads((run.path / "evaluation.json").read_text())
    assert list(evaluation["arms"]) == ["optimised", "start", "highest", "random"]
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
    from warpav.scene.glb import write_scene

    for seed in (1, 0):
        (scene,) = wa.town([seed])
        write_scene(scene, tmp_path / f"scene_{seed}.glb")
    assert [scene.name for scene in wa.read_scenes(tmp_path)] == ["town_0000", "town_0001"]
    assert [scene.name for scene in wa.read_scenes(str(tmp_path / "*1.glb"))] == ["town_0001"]
    assert len(wa.read_scenes([tmp_path / "scene_1.glb", tmp_path])) == 3
