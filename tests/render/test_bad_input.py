"""What cannot be drawn or measured is refused, with the array and the place; nothing is read out of bounds."""

import dataclasses

import numpy as np
import pytest

from tests.driving_scene import street
from warpav.geometry import mesh as mesh_module
from warpav.geometry.mesh import Mesh
from warpav.render.device_scene import DeviceScene


def broken(vertex_m=None, triangle=None, vertex_rgb=None):
    """A street whose second car, made without checks, has other arrays."""
    scene = street(3)
    car = scene.vehicles[1].mesh
    mesh = Mesh(
        car.vertex_m if vertex_m is None else vertex_m,
        car.triangle if triangle is None else triangle,
        car.vertex_rgb if vertex_rgb is None else vertex_rgb,
    )
    vehicles = (scene.vehicles[0], dataclasses.replace(scene.vehicles[1], mesh=mesh), scene.vehicles[2])
    return dataclasses.replace(scene, vehicles=vehicles)


def test_a_mesh_that_cannot_be_drawn_is_not_packed(device):
    car = street(3).vehicles[1].mesh
    vertex_m, triangle = car.vertex_m.copy(), car.triangle.copy()
    vertex_m[[17, 30], 2] = np.nan, np.inf
    triangle[5, 1] = len(vertex_m)
    negative = np.where(np.arange(len(triangle))[:, None] == 8, np.int32(-1), car.triangle)
    for scene, message in (
        (broken(vertex_m=vertex_m), r"street_0: vehicle 2: 2 of \d+ vertices .*: vertex_m\[17\] is \[.*, nan\]"),
        (broken(triangle=triangle), r"street_0: vehicle 2: triangle indices must be 0\.\.\d+, .*: triangle\[5\] is"),
        (broken(triangle=negative), r"got -1\.\..*: triangle\[8\] is \[-1, -1, -1\]"),
        (broken(triangle=np.zeros((0, 3), np.int32)), "vehicle 2: expected at least one triangle"),
        (broken(vertex_m=np.zeros((0, 3), np.float32)), "vehicle 2: expected colours of shape"),
        (broken(vertex_rgb=car.vertex_rgb[1:]), "vehicle 2: expected colours of shape"),
    ):
        with pytest.raises(ValueError, match=message):
            DeviceScene.pack(scene, device=device)


def test_more_triangles_than_keys_tell_apart_are_not_packed(monkeypatch, device):
    # the key of a sample has 32 bits for the triangle, and a reach one less
    assert mesh_module.MAX_COUNT == 2**31 - 1
    scene = street(3)
    count = sum(len(m.triangle) for m in (scene.environment, scene.ego, *(v.mesh for v in scene.vehicles)))
    monkeypatch.setattr(mesh_module, "MAX_COUNT", count)
    assert DeviceScene.pack(scene, device=device).triangle_count == count
    monkeypatch.setattr(mesh_module, "MAX_COUNT", count - 1)
    with pytest.raises(ValueError, match=f"5 meshes have {count} triangles together, more than {count - 1}"):
        DeviceScene.pack(scene, device=device)
