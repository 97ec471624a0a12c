"""Rigs against requirements: what is met, by how much not, and where."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import warpav as wa
from tests.sight.test_area import box
from warpav.raster.camera import CameraModel
from warpav.sight import SECTORS, Gap, Requirement
from warpav.sight._requirement import SIZES_M, Band, Strip, TestObject

POST = TestObject("post", SIZES_M["post"])
EGO = box((4.0, 2.0, 1.5), (1.0, 0.0, 0.75))
WIDE = CameraModel(320, 240, math.radians(120.0))


def camera(name, x, y, yaw_deg, pitch_deg=30.0, z=1.8):
    return wa.Camera(name, np.array([x, y, z]), math.radians(yaw_deg), math.radians(pitch_deg), 0.0, WIDE)


CAMERAS = [
    camera("rear", -0.9, 0.0, 180.0),
    camera("left", 1.0, 0.9, 90.0),
    camera("right", 1.0, -0.9, -90.0),
    camera("front", 2.9, 0.0, 0.0),
    camera("rear_left", -0.9, 0.9, 135.0),
    camera("level", 2.9, 0.5, 10.0, 0.0),
]
WANTED = (
    Requirement("behind", Strip("rear", (0.2, 3.5), (-2.5, 2.5)), 0.4, POST, visible_share=0.9),
    Requirement("around", Band((0.0, 4.0)), 0.8, POST, pixels=600.0, weight=2.0),
    Requirement("twice", Strip("left", (0.0, 2.0)), 0.5, POST, visible_share=0.8, cameras=2),
)


def test_what_is_met_is_counted_point_by_point():
    result = wa.check_requirements(wa.Rig(CAMERAS), EGO, WANTED)
    seen, ghosts = result.visibility, result.ghosts
    expected = 0.0
    for r, (requirement, outcome) in enumerate(zip(WANTED, result.outcomes, strict=True)):
        points = np.flatnonzero(ghosts.requirement == r)
        met = 0
        for g in points:
            count = sum(
                seen.visible_share[c, g] >= requirement.visible_share and seen.pixels[c, g] >= requirement.pixels
                for c in range(len(CAMERAS))
            )
            assert count == result.camera_count[g]
            met += count >= requirement.cameras
        assert (outcome.points, outcome.met) == (len(points), met)
        expected += (requirement.weight or 0.0) * (1.0 - met / len(points))
        assert len(outcome.worst) == min(5, len(points) - met)
    behind, around, twice = result.outcomes
    assert result.cost == pytest.approx(expected)
    assert result.is_met == (behind.is_met and around.is_met and twice.is_met)
    asked = [replace(each, weight=1.0, share=around.share) for each in WANTED]  # as much as it meets
    assert [each.is_met for each in wa.check_requirements(wa.Rig(CAMERAS), EGO, asked).outcomes][1]
    assert not twice.is_met  # one camera looks to the left, another one a little
    assert 0.0 < twice.share < 1.0
    assert 0.3 < around.share < 1.0


def test_the_worst_point_says_how_much_is_missing():
    result = wa.check_requirements(wa.Rig(CAMERAS[:1]), EGO, WANTED)
    behind, around, twice = result.outcomes
    closeness = result.visibility.closeness(result.ghosts)
    for outcome, r in ((behind, 0), (around, 1)):
        unmet = np.flatnonzero((result.ghosts.requirement == r) & ~result.is_point_met)
        worst = outcome.worst[0]
        place = np.flatnonzero(
            (result.ghosts.position_m == worst.position_m).all(axis=1) & (result.ghosts.requirement == r)
        )
        assert closeness[0, place[0]] == closeness[0, unmet].min()
        assert worst.visible_share == result.visibility.visible_share[0, place[0]]
        assert worst.cameras == 0
    assert around.worst[0].camera is None  # nobody looks to the front
    assert twice.met == 0


@pytest.mark.parametrize("sector", SECTORS)
def test_the_largest_gap_is_the_largest_patch_of_neighbours(sector):
    yaw_rad = 0.25 * math.pi * SECTORS.index(sector)
    middle_m = np.array([1.3, 0.2])
    patch = [(0, 0), (1, 0), (1, 1), (2, 2), (9, 9), (9, 10)]  # four, one of them by a corner, and two
    point_m = middle_m + 8.0 * np.array([math.cos(yaw_rad), math.sin(yaw_rad)]) + 0.2 * np.array(patch)
    gap = Gap.largest(point_m, 0.2, middle_m)
    assert gap.sector == sector
    assert gap.area_m2 == pytest.approx(4 * 0.04)


def test_the_table_and_json_say_the_same(tmp_path):
    result = wa.check_requirements(wa.Rig(CAMERAS), EGO, WANTED)
    lines = result.table().splitlines()
    assert [line.split()[0] for line in lines] == ["requirement", "behind", "around", "twice"]
    data = json.loads(json.dumps(result.to_json()))
    assert data["schema"] == "warpav-requirements/1"
    assert data["cameras"] == [each.name for each in CAMERAS]
    for outcome, entry, line in zip(result.outcomes, data["requirements"], lines[1:], strict=True):
        assert f"{100.0 * outcome.share:.1f} %" in line
        assert entry["met"] == outcome.met == sum(np.array(entry["camera_count"]) >= entry["need"]["cameras"])
        assert len(entry["position_m"]) == len(entry["camera_count"]) == entry["points"]
