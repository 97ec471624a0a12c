"""What is told from sheet metal: wheels, what files name, glass by colour and shape, small patches, thin parts."""

import numpy as np
import pytest
import trimesh

from tests.raster.bodies import cuboid
from warpav.raster.mesh import Mesh, merge
from warpav.rig import NORMALS, chart_of, kinds_of_names, parts_of, propose_zones
from warpav.scene import read_vehicle


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("Window_front", "glass"),
        ("rearWindscreen material", "glass"),
        ("headlights.001", "lamp"),
        ("body lightgrey", ""),
        ("NumberPlate", "plate"),
        ("wheel_fl rim", "wheel"),
        ("roof", ""),
        ("tyres", "wheel"),
        ("primer", ""),
    ],
)
def test_names_say_what_parts_are(name, kind):
    assert kinds_of_names([name]).tolist() == [kind]


def painted(size_m, place_m, rgb):
    mesh = cuboid(size_m, place_m)
    return Mesh.create(mesh.vertex_m, mesh.triangle, rgb)


def body_with_parts():
    """A grey body with a white lamp, a dark side window, a blue logo, a rail on its roof, and a round wheel below."""
    return merge(
        [
            painted((4.0, 1.8, 1.0), (1.0, 0.0, 0.9), [120, 130, 140]),
            painted((0.02, 0.3, 0.1), (3.01, 0.5, 0.8), [250, 250, 240]),
            painted((1.0, 0.02, 0.4), (1.0, 0.91, 1.1), [5, 10, 20]),
            painted((0.8, 0.8, 0.01), (0.0, 0.0, 1.4), [20, 40, 250]),
            painted((3.0, 0.1, 0.2), (1.0, -0.6, 1.5), [120, 130, 140]),
            painted((0.6, 0.2, 0.62), (0.0, 0.8, 0.31), [120, 130, 140]),
        ]
    )


def test_pale_glass_in_the_skin_of_a_side_is_told_by_its_colour():
    box = trimesh.creation.box([4.0, 1.8, 1.4]).apply_translation([1.0, 0.0, 0.7]).subdivide_to_size(0.1)
    x_m, y_m, z_m = box.vertices.T
    is_pale = (y_m > 0.89) & (np.abs(x_m - 1.0) < 0.5) & (np.abs(z_m - 1.1) < 0.2)
    found = parts_of(Mesh.create(box.vertices, box.faces, np.where(is_pale[:, None], 230, [[150, 30, 30]])))
    assert "side windows by colour alone" in found.untold
    ((name, side, box_m),) = found.keep_out
    assert (name, side) == ("window", "left")
    np.testing.assert_allclose(box_m[:, ::2], [[0.5, 0.9], [1.5, 1.3]], atol=0.1)


def test_lamps_windows_rails_and_wheels_are_kept_out_and_logos_are_not():
    found = parts_of(body_with_parts()).keep_out
    expected_m = {
        ("wheel", ""): [[-0.38, -0.98, -0.08], [0.38, -0.62, 0.7]],
        ("other colour", "front"): [[3.0, 0.33, 0.73], [3.04, 0.67, 0.87]],
        ("window", "left"): [[0.48, 0.9, 0.88], [1.52, 0.94, 1.32]],
        ("thin part", "up"): [[-0.52, -0.67, 1.38], [2.52, -0.53, 1.62]],
    }
    for kind, box_m in expected_m.items():  # cells are 2.5 cm
        away_m = [np.abs(box - box_m).max() for *names, box in found if tuple(names) == kind]
        assert min(away_m) < 0.026, kind
    assert sum(name == "wheel" for name, _, _ in found) == 2
    assert not any(((box[0] <= [0.0, 0.0, 1.405]) & (box[1] >= [0.0, 0.0, 1.405])).all() for _, _, box in found)


def test_a_logo_takes_nothing_of_a_roof():
    zones = {zone.name: zone for zone in propose_zones(body_with_parts())}
    chart = chart_of([zones["roof"]], body_with_parts(), cell_m=0.04)
    assert chart.inside.sum() * chart.cell_m**2 == pytest.approx(4.0 * 1.8 - 3.04 * 0.14, rel=0.06)


def vehicle(name, rgb=None):
    mesh = read_vehicle(name)
    return mesh if rgb is None else Mesh.create(mesh.vertex_m, mesh.triangle, rgb)


@pytest.mark.parametrize("name", ["panel_van", "minibus", "bus", "truck"])
def test_glass_of_the_paint_s_colour_is_found_by_shape_where_dark_glass_is(name):
    coloured, plain = parts_of(vehicle(name)), parts_of(vehicle(name, [150, 150, 150]))
    assert coloured.untold == ""
    assert "windscreen" in plain.untold
    assert "side windows by shape alone" in plain.untold
    assert ("no rear window" in plain.untold) == (len(plain.panes) == 1)
    (one_m, other_m) = (np.asarray(parts.panes[0].outline_m) for parts in (coloured, plain))
    np.testing.assert_allclose(
        [one_m.min(axis=0), one_m.max(axis=0)], [other_m.min(axis=0), other_m.max(axis=0)], atol=0.08
    )
    boxes = {
        side: [box for word, at, box in plain.keep_out if (word, at) == ("window", side)] for side in ("left", "right")
    }
    for word, side, (low_m, high_m) in coloured.keep_out:
        if word == "window" and side in boxes:
            middle_m = 0.5 * (low_m + high_m)
            assert any(((box[0] <= middle_m) & (middle_m <= box[1])).all() for box in boxes[side]), side


@pytest.mark.parametrize(("name", "rgb"), [("panel_van", None), ("minibus", None), ("coupe", None), ("bus", [200] * 3)])
def test_no_two_proposed_zones_share_skin(name, rgb):
    mesh = vehicle(name, rgb)
    zones = propose_zones(mesh)
    assert {"roof", "left", "right", "front", "rear", "windscreen"} <= {zone.name for zone in zones}
    charts = [chart_of([zone], mesh, cell_m=0.03) for zone in zones]
    for one in charts:
        point_m = one.point_m(one.place_m[one.inside], one.height_m[one.inside])
        for other in charts:
            local_m = (point_m - other.plane_m[0]) @ other.axes[0].T
            away_m = np.abs(local_m[:, 2] - other.height_at_m(local_m[:, :2]))
            is_shared = (other.zone_distance_m(local_m[:, :2]) > other.cell_m) & (away_m < 0.01)
            # both sides of an edge have a row of cells there
            least_m2 = 0.0 if one.zones[0].is_behind_glass or other.zones[0].is_behind_glass else 0.04
            assert one is other or is_shared.sum() * one.cell_m**2 <= least_m2, (one.zones[0].name, other.zones[0].name)


@pytest.mark.parametrize("name", ["bus", "minibus", "moving_truck", "truck"])
def test_the_windows_of_the_shipped_vehicles_are_kept_out(name):
    mesh = vehicle(name)
    found = parts_of(mesh)
    assert [kind for kind, _, _ in found.keep_out].count("wheel") == 4
    corner_m = mesh.vertex_m[mesh.triangle]
    middle_m = corner_m.mean(axis=1)
    normal = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    is_glass = mesh.vertex_rgb[mesh.triangle].mean(axis=(1, 2)) < 40.0
    is_glass &= middle_m[:, 2] > 0.6 * mesh.bounds_m()[1, 2]
    for side in ("left", "right"):
        inside = np.zeros(len(middle_m), bool)
        for _, (low_m, high_m) in ((at, box) for _, at, box in found.keep_out if at == side):
            inside |= ((middle_m >= low_m) & (middle_m <= high_m)).all(axis=1)
        is_side = is_glass & (normal @ NORMALS[side] > 0.7 * np.linalg.norm(normal, axis=1))
        assert is_side.sum() >= 2
        assert inside[is_side].all()
