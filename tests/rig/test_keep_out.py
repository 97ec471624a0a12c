"""What carries no camera: wheels, what files name, and what has another colour than the paint."""

import numpy as np
import pytest

from tests.raster.bodies import cuboid
from warpav.raster.mesh import Mesh, merge
from warpav.rig.proposals import kinds_of_names, propose_keep_out
from warpav.scene.own_vehicle import read_vehicle


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
    """A grey body, a white lamp on its front, a dark pane on its side, and a round wheel below."""
    return merge(
        [
            painted((4.0, 1.8, 1.0), (1.0, 0.0, 0.9), [120, 130, 140]),
            painted((0.02, 0.3, 0.1), (3.01, 0.5, 0.8), [250, 250, 240]),
            painted((1.0, 0.02, 0.4), (1.0, 0.91, 1.1), [5, 10, 20]),
            painted((0.6, 0.2, 0.62), (0.0, 0.8, 0.31), [120, 130, 140]),
        ]
    )


def test_another_colour_and_wheels_are_kept_out():
    found = propose_keep_out(body_with_parts())
    assert [name for name, _ in found] == ["wheel", "wheel", "other colour", "other colour"]
    wheel, other, pane, lamp = (box for _, box in found)
    np.testing.assert_allclose(other[:, 1], [-0.98, -0.62], atol=1e-3)
    np.testing.assert_allclose(wheel, [[-0.38, 0.62, -0.08], [0.38, 0.98, 0.7]], atol=1e-3)
    np.testing.assert_allclose(lamp, [[2.98, 0.33, 0.73], [3.04, 0.67, 0.87]], atol=1e-3)
    np.testing.assert_allclose(pane, [[0.48, 0.88, 0.88], [1.52, 0.94, 1.32]], atol=1e-3)


@pytest.mark.parametrize("name", ["bus", "minibus", "moving_truck", "truck"])
def test_the_windows_of_the_shipped_vehicles_are_kept_out(name):
    mesh = read_vehicle(name)
    found = propose_keep_out(mesh)
    assert [kind for kind, _ in found].count("wheel") == 4
    middle_m = mesh.vertex_m[mesh.triangle].mean(axis=1)
    is_dark = mesh.vertex_rgb[mesh.triangle].mean(axis=(1, 2)) < 40.0
    is_glass = is_dark & (middle_m[:, 2] > 0.6 * mesh.bounds_m()[1, 2])
    inside = np.zeros(len(middle_m), bool)
    for _, (low_m, high_m) in found:
        inside |= ((middle_m >= low_m) & (middle_m <= high_m)).all(axis=1)
    assert is_glass.sum() >= 8
    assert inside[is_glass].mean() > 0.95
