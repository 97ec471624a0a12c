"""The section ``rules`` and pairs of plain cameras: read, refused, and what they become."""

import json
import math

import pytest

import warpav as wa
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.rig import PLAIN, write_rig
from warpav.runs import RunFolder, camera_mount, find_rig
from warpav.runs._mounts import rig_limits
from warpav.runs.config import Config, load_config
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


def judged(source, file, *overrides):
    """What ``warpav evaluate`` writes of a rig, and its margins by rule."""
    assert main(["evaluate", str(source), *overrides, "--json", str(file)]) == 0
    found = json.loads(file.read_text())
    [margins] = found["rules"].values()
    return found, {each["rule"]: each for each in margins}


def test_what_a_rig_breaks_is_said(capsys, tmp_path):
    _, found = judged("highest", tmp_path / "found.json", *SMALL)
    said = capsys.readouterr().out
    assert "Rules: 2 of 6 broken: own body in the image 32%, front, at most 30% asked" in said
    assert not found["crossing"]["is_kept"]
    assert found["azimuth_gap"]["value"] <= 3.0


def test_a_run_is_judged_by_the_rules_that_it_settled(tmp_path):
    config = load_config("quick", [*SMALL, f"run.out={tmp_path / 'run'}"])
    folder = RunFolder.create(config, name="run")
    for role in ("initial", "best"):
        write_rig(find_rig("highest", config, wa.town([0])[0].ego), folder.rig_path(role))
    content, found = judged(folder.path, tmp_path / "found.json")
    assert [found[rule]["limit"] for rule in ("azimuth_gap", "near_ground")] == [pytest.approx(3.0), None]  # as asked
    wider = {"limit": pytest.approx(9.0), "asked": found["azimuth_gap"]["limit"], "price": 0.02}
    found["azimuth_gap"] |= {**wider, "limit": 9.0}
    found["near_ground"] |= {"limit": 4.0}
    folder.write_evaluation({**content, "rules": {"optimised": list(found.values())}})
    _, again = judged(folder.path, tmp_path / "again.json")
    assert again["azimuth_gap"] == {**found["azimuth_gap"], **wider}
    assert again["near_ground"]["limit"] == 4.0
    _, other = judged(folder.path, tmp_path / "other.json", "rules.azimuth_gap_deg=6")  # asked anew
    assert (other["azimuth_gap"]["limit"], other["azimuth_gap"]["asked"]) == (pytest.approx(6.0), None)
