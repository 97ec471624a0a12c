"""The section ``rules`` and pairs of plain cameras: read, refused, and what they become."""

import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest

import warpav as wa
from tests.runs.report.run_parts import evaluation, fill, folder_at
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.rig import PLAIN, Rig, write_rig
from warpav.runs import camera_mount, find_rig
from warpav.runs._editor import RigScorer
from warpav.runs._mounts import rig_limits
from warpav.runs.config import Config, load_config
from warpav.scene import town_scene
from warpav.sight import Rules


def test_limits_are_in_radians_and_kept_where_a_search_can():
    assert Config().rules.limits == Rules()
    assert [load_config(None, each).keeps_rules for each in ([], ["rules=default"], ["rules=none"])] == [
        True,
        True,
        False,
    ]
    assert not load_config(None, ["optimiser.search=descent"]).keeps_rules
    assert not load_config("thesis").keeps_rules
    limits = load_config(None, ["rules.enforced=true", "rules.crossing_deg=45", "rules.horizon=null"]).rules.limits
    assert limits.crossing_rad == pytest.approx(math.radians(45.0))
    assert limits.horizon is None
    assert limits.own_body == 0.3


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["rules.own_body=0"], r"rules\.own_body: expected"),
        (["rules.horizon=1.5"], r"rules\.horizon: expected"),
        (["rules.azimuth_gap_deg=1"], r"rules\.azimuth_gap_deg: expected"),
        (["rules=strict"], r"rules: expected default, none or its limits, got 'strict'"),
        (["rules.body=0.3"], r"rules\.body: expected one of enforced, own_body"),
        (
            ["rules=default", "optimiser.search=descent"],
            r"rules\.enforced: expected null, as only the search by a pool",
        ),
        (["method=thesis", "rules=default"], r"rules\.enforced: expected null, as only the search by a pool"),
        (["method=thesis", "rig.symmetric=true"], r"rig\.symmetric: expected auto, as only the search by a pool"),
        (
            ["rig.symmetric=true", "rig.free.fov_deg=[60, 100]"],
            r"rig\.free\.fov_deg: expected null, as the cameras of a pair have one lens",
        ),
    ],
)
def test_what_cannot_be_is_named(overrides, message):
    with pytest.raises(InputError, match=message):
        load_config(None, overrides)


def test_plain_cameras_stand_in_pairs_or_in_the_middle():
    config = load_config(None, ["rig.symmetric=true", "rig.cameras=5"])
    mount = camera_mount(config, wa.town([0])[0].ego)
    assert mount.surface.pairs == (True, False)
    limits = rig_limits(config, mount.surface)
    assert limits.count == (5, 5)
    assert limits.kinds == ((PLAIN, 2), (PLAIN, 1))
    assert limits.size(limits.first_kinds()) == 5


@pytest.mark.parametrize("is_symmetric", [False, True])
def test_rigs_by_hand_stand_on_any_vehicle_by_name(is_symmetric):
    config = load_config(None, ["rig.symmetric=true"] if is_symmetric else [])
    corners, cross = (find_rig(name, config, wa.town([0])[0].ego) for name in ("corners", "cross"))
    assert sorted(round(math.degrees(each.yaw_rad)) for each in corners.cameras) == [-136, -44, 44, 136]
    assert sorted(round(math.degrees(each.yaw_rad)) % 360 for each in cross.cameras) == [0, 90, 180, 270]
    for each in corners.cameras:  # each at its corner
        assert each.position_m[1] * each.yaw_rad > 0.0


SMALL = ["rules=default", "scenes.test_seeds=5000..5000", "camera.width_px=64", "camera.height_px=64"]


def test_what_a_rig_breaks_is_said(capsys, tmp_path):
    file = tmp_path / "found.json"
    assert main(["evaluate", "highest", *SMALL, "--json", str(file)]) == 0
    said = capsys.readouterr().out
    assert "Rules: 2 of 6 broken: own body in the image 32%, front, at most 30% asked" in said
    found = {each["rule"]: each for each in json.loads(file.read_text())["rules"]["highest"]}
    assert not found["crossing"]["is_kept"]
    assert found["azimuth_gap"]["value"] <= 3.0


def test_a_run_is_judged_by_the_rules_that_it_settled(tmp_path):
    folder, file = folder_at(tmp_path / "run", *SMALL, "rig.cameras=4", "camera.fov_deg=90"), tmp_path / "found.json"
    near = {"rule": "near_ground", "cameras": [], "value": 4.0, "limit": 4.0, "unit": "m", "is_kept": True}
    gap = {**near, "rule": "azimuth_gap", "limit": 9.0, "asked": 3.0, "price": 0.02}
    fill(folder, evaluation(rules={"optimised": [near, gap]}))
    write_rig(find_rig("highest", folder.config(), wa.town([0])[0].ego), folder.rig_path("best"))
    asked_anew = ["rules.azimuth_gap_deg=6"]
    page = tmp_path / "check.html"
    for overrides, told in (([], [4.0, 9.0, 3.0, 0.02]), (asked_anew, [4.0, 6.0, None, None])):
        assert main(["evaluate", str(folder.path), *overrides, "--json", str(file)]) == 0
        found = {each["rule"]: each for each in json.loads(file.read_text())["rules"]["optimised"]}
        settled = [found["azimuth_gap"][name] for name in ("limit", "asked", "price")]
        assert [found["near_ground"]["limit"], *settled] == pytest.approx(told)
        main(["check", str(folder.path), *overrides, "--out", str(page)])
        assert f"at most {told[1]:g}°" + (", as the run kept (3° wanted)" * (not overrides)) + "<" in page.read_text()
    shutil.copy(folder.rig_path("best"), tmp_path / "other.yaml")
    assert main(["compare", str(folder.path), str(tmp_path / "other.yaml"), "--out", str(page)]) == 0
    assert "at most 9°" in page.read_text()


@pytest.mark.slow
def test_the_editor_scores_past_housings_as_an_evaluation_does():
    scene, expected = town_scene(1000), []
    for overrides in ([], ["rules=none"]):
        config = load_config(None, overrides)
        seer, other, *more = find_rig("corners", config, scene.ego).cameras
        towards = scene.vehicles[4].box.center_m - seer.position_m
        before = replace(other, position_m=seer.position_m + 0.2 * towards / np.linalg.norm(towards))
        rig = Rig([seer, before, *more])
        score = RigScorer(config, lambda _: scene)(rig, [0])
        measured = wa.evaluate(rig, [scene], wa.Placement.from_config(config)).best
        assert score.expected_per_100 == pytest.approx(100.0 * measured.objective)
        assert score.missed_per_100 == pytest.approx(measured.misses_per_100)
        expected.append(score.expected_per_100)
    assert expected[0] > expected[1] + 0.05
