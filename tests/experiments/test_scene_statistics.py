"""Statistics of scenes: of boxes whose places and shadows are known."""

import numpy as np
import pytest

from warpav.experiments import scene_statistics
from warpav.experiments._scene_statistics import _visible_shares_of
from warpav.raster.mesh import Mesh
from warpav.scene import Box, Scene, Vehicle, ego_vehicle, level_scene


def box_at(number, x_m, y_m, size_m, category="car", velocity=None):
    """A road user that is a box standing on the ground."""
    size = np.array(size_m, float)
    corner = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)]) * size
    place = np.array([x_m, y_m, 0.0])
    side = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
            [2, 3, 7], [2, 7, 6], [1, 5, 7], [1, 7, 3], [0, 2, 6], [0, 6, 4]]  # fmt: skip
    mesh = Mesh.create(corner + place, side, [200, 40, 40])
    box = Box(np.array([x_m, y_m, 0.5 * size[2]]), size, 0.0)
    return Vehicle(number, category, mesh, box, None if velocity is None else np.array(velocity))


def scene_of(*users):
    ground = Mesh.create([[-300, -300, -1], [300, -300, -1], [300, 300, -1], [-300, 300, -1]], [[0, 1, 2], [0, 2, 3]],
                         [90, 90, 90])  # fmt: skip
    return Scene("boxes", ground, ego_vehicle(), users).targeting(("vehicle",))


def test_road_users_are_counted_by_kind_and_distance():
    centre_m = ego_vehicle().bounds_m()[:, 0].mean()
    scene = scene_of(
        box_at(1, centre_m + 9.0, 0.0, (2.0, 2.0, 2.0), velocity=[-3.0, 4.0]),
        box_at(2, centre_m, 15.0, (2.0, 2.0, 2.0)),
        box_at(3, centre_m - 150.0, 0.0, (2.0, 2.0, 2.0)),
        box_at(4, centre_m + 30.0, 10.0, (0.5, 0.5, 1.7), "pedestrian"),
    )
    found = scene_statistics([scene, scene])
    assert found.scene_count == 2
    assert found.by_kind() == {"vehicle": 3.0, "pedestrian": 1.0, "cyclist": 0.0}
    assert found.by_category() == {"car": 3.0, "pedestrian": 1.0}
    assert list(found.by_distance().values()) == [0.25, 0.25, 0.25, 0.0, 0.25, 0.0]
    assert found.by_distance("pedestrian")["20-40 m"] == 1.0
    assert found.speed_m_s[0] == pytest.approx(5.0)
    assert np.isnan(found.speed_m_s[1])
    assert found.table()[0] == "2 scenes, 8 road users, 4.0 a scene"


def test_the_visible_share_is_that_of_a_box_behind_a_box_half_as_wide():
    """Seen from straight ahead, the shadow of a plate at half the distance is twice as wide as the plate."""
    centre_m = ego_vehicle().bounds_m()[:, 0].mean()
    behind = box_at(1, centre_m + 40.0, 0.0, (0.01, 8.0, 3.0))
    plate = box_at(2, centre_m + 20.0, 1.0, (0.01, 2.0, 4.0))  # its shadow goes from 0 to 4 of -4 to 4 m
    hidden = box_at(3, centre_m + 60.0, 0.0, (0.01, 1.0, 1.0))
    share = _visible_shares_of(scene_of(behind, plate, hidden))
    assert share == pytest.approx([0.5, 1.0, 0.0], abs=0.02)
    found = scene_statistics([scene_of(behind, plate, hidden)])
    assert list(found.by_visible_share().values()) == pytest.approx([1 / 3, 1 / 3, 0.0, 1 / 3])


def test_dense_streets_hide_more_than_easy_ones():
    easy, dense = (scene_statistics(level_scene(seed, level) for seed in range(1)) for level in ("easy", "dense"))
    assert dense.by_visible_share()["0-40 %"] > easy.by_visible_share()["0-40 %"] + 0.1
    assert sum(dense.by_kind().values()) > 3.0 * sum(easy.by_kind().values())
