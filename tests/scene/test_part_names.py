"""Names of the parts of a vehicle's file, triangle by triangle."""

import numpy as np
import trimesh

from warpav.rig.proposals import kinds_of_names
from warpav.runs.vehicle import part_names
from warpav.scene.own_vehicle import read_vehicle
from warpav.scene.town.vehicle_shapes import ego_glass, ego_mesh


def test_glass_is_found_again_in_a_file_by_its_name(tmp_path):
    """The town's car in two nodes, y up as glTF is; its triangles come in another order."""
    car, is_glass = ego_mesh(), ego_glass()
    scene = trimesh.Scene()
    vertex_m = car.vertex_m[:, [1, 2, 0]].astype(float)  # x forward becomes z, z up becomes y
    for name, kept in (("window panes", is_glass), ("body", ~is_glass)):
        part = trimesh.Trimesh(vertex_m, car.triangle[kept], vertex_colors=car.vertex_rgb, process=False)
        scene.add_geometry(part, node_name=name, geom_name=name)
    scene.export(tmp_path / "car.glb")
    mesh = read_vehicle(tmp_path / "car.glb", forward="z")
    names = part_names(tmp_path / "car.glb", mesh, forward="z")
    found = kinds_of_names(names) == "glass"
    assert found.sum() == is_glass.sum()
    middle_m = [each.vertex_m[each.triangle].mean(axis=1) for each in (mesh, car)]
    kept = zip(middle_m, (found, is_glass), strict=True)
    first, second = (np.sort(np.round(middle[flag], 2), axis=0) for middle, flag in kept)
    np.testing.assert_allclose(first, second, atol=0.011)
