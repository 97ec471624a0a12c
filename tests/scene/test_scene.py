"""What scenes say of themselves."""

import re

import numpy as np

from tests.view.stand_ins import scene, vehicle
from warpav.raster.mesh import Mesh
from warpav.scene.scene import Box, Vehicle


def pedestrian(instance_id, x, y):
    mesh = Mesh.create([[x, y, 0], [x + 0.4, y, 0], [x, y, 1.7]], [[0, 1, 2]], (20, 90, 160))
    return Vehicle(instance_id, "pedestrian", mesh, Box(np.array([x, y, 0.85]), np.array([0.5, 0.5, 1.7]), 0.0))


def test_a_scene_is_told_in_a_line():
    street = scene(vehicle(1, 9.0, 3.4), vehicle(2, -20.0, 0.0), pedestrian(3, 4.0, -3.0))
    assert repr(street) == "<Scene test: 3 targets (2 saloon, 1 pedestrian)>"
    assert repr(street.targeting(["vehicle"])) == "<Scene test: 2 targets, 1 not targeted (2 saloon, 1 pedestrian)>"
    assert repr(scene()) == "<Scene test: 0 targets (no road user)>"
    assert repr(street.vehicles[1]) == "<Vehicle 2: saloon at x -20.0, y 0.0 m>"


def cells(page):
    return dict(re.findall(r"<tr><th [^>]*>(.*?)</th><td [^>]*>(.*?)</td></tr>", page))


def test_a_notebook_shows_who_is_in_a_scene():
    street = scene(vehicle(1, 9.0, 3.4), vehicle(2, -20.0, 0.0), pedestrian(3, 4.0, -3.0)).targeting(["vehicle"])
    shown = cells(street._repr_html_())
    assert shown["road users"] == "2 saloon, 1 pedestrian"
    assert shown["not targeted"] == "1"
    assert shown["nearest"] == "pedestrian 3, 5.0 m away at -37°"
    assert shown["farthest"] == "saloon 2, 20.0 m away at +180°"
    # road 2, wall 12, the ego vehicle and two others 12 each, a pedestrian 1
    assert shown["triangles"] == str(2 + 12 + 12 + 2 * 12 + 1)
    assert cells(scene()._repr_html_())["road users"] == "none"
    assert "nearest" not in cells(scene()._repr_html_())


def test_names_are_text_not_markup():
    import dataclasses

    named = dataclasses.replace(scene(), name="<b>", source="a & b")
    assert "<b>" not in named._repr_html_()
    assert cells(named._repr_html_())["source"] == "a &amp; b"
