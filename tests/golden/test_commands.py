"""Other commands: what they write and print, as names and numbers."""

import json
import re

import numpy as np
import pytest

from tests.golden.conftest import numbers

FAST = ["camera.width_px=64", "camera.height_px=64"]
COMMANDS = {
    "": "optimise evaluate render inspect plot report rig scenes detector vehicle modules config doctor front view",
    "rig": "presets import export check drawing requirements",
    "scenes": "make capture reconstruct show heatmap check traffic statistics",
    "detector": "check fit",
    "vehicle": "check zones",
    "modules": "list check",
    "config": "show check schema copy diff",
}
HIDDEN = [
    "bench",
    "experiment",
    "detector train",
    "detector evaluate",
    "detector score",
    "scenes figure",
    "vehicle list",
]
KEYS = (
    *("run.seed", "run.out", "run.iterations", "device", "method", "scenes.source", "scenes.train_seeds"),
    *("scenes.test_seeds", "rig.cameras", "rig.start", "camera.fov_deg", "camera.width_px", "camera.height_px"),
    "detector.model",
)


@pytest.mark.parametrize("group", COMMANDS)
def test_help_lists_the_commands(warpav, group):
    status, out, _ = warpav(*group.split(), "--help")
    assert status == 0
    for name in COMMANDS[group].split():
        assert re.search(rf"\b{name}\b", out), name


@pytest.mark.parametrize("command", HIDDEN)
def test_commands_of_developers_answer_as_before(warpav, command):
    assert warpav(*command.split(), "--help")[0] == 0


def test_config_show_has_the_keys_that_every_run_understands(warpav):
    status, out, _ = warpav("config", "show")
    assert status == 0
    import yaml

    shown = yaml.safe_load(out)
    for key in KEYS:
        value = shown
        for part in key.split("."):
            assert part in value, key
            value = value[part]


def test_a_scene_is_made_rendered_and_counted(warpav, golden, tmp_path):
    assert warpav("scenes", "make", "--seeds", "1000..1001", "--out", tmp_path / "scenes")[0] == 0
    glb = tmp_path / "scenes" / "scene_1000.glb"
    assert warpav("render", glb, "--rig", "nuscenes", "--out", tmp_path / "images", *FAST[:1])[0] == 0
    views = json.loads((tmp_path / "images" / "views.json").read_text())
    golden("render_views", views)
    depth = {
        path.name: np.sort(np.load(path)[np.isfinite(np.load(path))])[::211].astype(float)
        for path in sorted((tmp_path / "images").glob("*_depth_m.npy"))
    }
    golden("render_depth", depth, rtol=1e-5, atol=1e-4)
    assert {path.name.split("_", 2)[-1] for path in (tmp_path / "images").glob("CAM_FRONT_*")} >= {
        "rgb.png",
        "depth_m.npy",
    }
    status, out, _ = warpav("scenes", "statistics", "--seeds", "0..2")
    assert status == 0
    golden("scene_statistics", numbers(out))
    parts = ("--train", "1000..1000", "--test", "1001..1001")
    assert warpav("scenes", "heatmap", tmp_path / "scenes", "--out", tmp_path / "heat.png", *parts)[0] == 0
    assert (tmp_path / "heat.png").stat().st_size > 2000


def test_requirements_of_a_preset(warpav, golden, tmp_path):
    found = {}
    for template in ("near_field", "r158_like"):
        out = tmp_path / f"{template}.json"
        assert warpav("rig", "requirements", "nuscenes", "--requirements", template, "--json", out)[0] == 0
        found[template] = numbers(re.sub(r'"(version|warpav)[^,}]*', "", out.read_text()))
    golden("requirements", found, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("command", ["rig presets", "modules list", "rig check nuscenes", "vehicle list"])
def test_what_lists_print(warpav, golden, command):
    status, out, _ = warpav(*command.split())
    assert status == 0
    golden(command.replace(" ", "_"), numbers(out))


def test_a_vehicle_is_checked_and_its_zones_are_written(warpav, golden, tmp_path):
    found = {}
    status, out, _ = warpav("vehicle", "check", "car")
    found["check"] = numbers(out)
    assert status == 0
    assert warpav("vehicle", "zones", "car", "--out", tmp_path / "zones.yaml")[0] == 0
    found["zones"] = numbers((tmp_path / "zones.yaml").read_text())
    golden("vehicle", found, rtol=1e-4, atol=1e-3)


def test_the_benchmark_writes_its_json(warpav, golden, tmp_path):
    out = tmp_path / "bench.json"
    status, _, _ = warpav("bench", "--items", "w1", "--repeat", "1", "--no-embree", "--json", out)
    assert status == 0

    def keys(value):
        return {key: keys(each) for key, each in value.items()} if isinstance(value, dict) else ""

    golden("bench_keys", keys(json.loads(out.read_text())))
