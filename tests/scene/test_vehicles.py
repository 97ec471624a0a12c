"""Vehicles of others as downloaded, sizes that are doubted, and the vehicles that ship with warpav."""

import numpy as np
import pytest
import trimesh

import warpav as wa
from warpav.raster.mesh import Mesh
from warpav.scene import Reading, examine, read_vehicle_file, vehicle_file, vehicle_mesh
from warpav.scene._mesh_colours import simulator_model
from warpav.scene._own_vehicle import is_plausible, wheels_of

# length, width, height [m]; forward; unit, of the folder's README
DOWNLOADED = {
    "prius_hybrid/meshes/Hybrid.obj": ((4.62, 2.01, 1.54), "-y", 0.01),
    "hatchback/meshes/hatchback.obj": ((4.00, 2.14, 1.57), "-y", 0.0254),
    "suv/meshes/suv.obj": ((5.02, 2.60, 2.16), "y", 0.06),
    "pickup/meshes/pickup.dae": ((5.66, None, None), "y", 0.0254),
    "bus/meshes/bus.obj": ((12.49, 2.71, 3.7), "-y", 0.01),
    "cc0/simple_car.glb": ((3.68, 1.47, 1.40), "-z", 1.0),
}


def remedy_of(found):
    return {name: value for problem in found.problems for name, value in (problem.remedy or {}).items()}


def as_suggested(path):
    """The vehicle with what the examination suggests, and its reading."""
    file = read_vehicle_file(path)
    remedy = remedy_of(examine(file, file.usual))
    scale = float(remedy["scale"]) if "scale" in remedy else None
    reading = file.usual.changed(up=remedy.get("up"), forward=remedy.get("forward"), scale=scale)
    found = examine(file, reading)
    assert remedy_of(found) == {}
    return found, reading


@pytest.mark.parametrize(
    "mesh",
    [
        each if each.startswith(("pickup", "cc0")) else pytest.param(each, marks=pytest.mark.nightly)
        for each in DOWNLOADED
    ],
)
def test_vehicles_of_others_have_their_size_and_axes(vehicle_folder, mesh):
    size_m, forward, scale = DOWNLOADED[mesh]
    found, reading = as_suggested(vehicle_folder / mesh)
    assert reading.forward == forward
    assert reading.scale == pytest.approx(scale)
    measured_m = np.ptp(found.corrected.bounds_m(), axis=0)
    for measured, expected in zip(measured_m, size_m, strict=True):
        assert expected is None or measured == pytest.approx(expected, rel=0.03)  # worst seen .002
    # the origin is on the ground, below the rear axle
    wheels = wheels_of(found.corrected.vertex_m.astype(float)) or found.wheels
    assert abs(found.corrected.bounds_m()[0, 2]) < 0.05
    assert len(wheels.axle_m) == 2


# ----------------------------------------------------------------------------------------------- sizes


def car_of(length_m):
    car = vehicle_mesh("saloon", np.array([200, 60, 50]), variant=0, scale=np.ones(3))
    factor = length_m / float(np.ptp(car.vertex_m[:, 0]))
    return Mesh(car.vertex_m * np.float32(factor), car.triangle, car.vertex_rgb)


def save(mesh, path):
    trimesh.Trimesh(mesh.vertex_m, mesh.triangle, process=False).export(path)
    return path


def test_a_car_that_is_too_low_is_doubted_and_the_user_may_insist(tmp_path):
    file = read_vehicle_file(save(car_of(2.6), tmp_path / "low.ply"))  # .8 m high
    (problem, *_) = examine(file, file.usual).problems
    assert problem.text.startswith("units: a vehicle 2.60 m long, ")
    assert "is doubtful, expected a width of 1 to 3.5 m and a height of 1.1 to 4.6 m" in problem.text
    assert "\n" not in problem.text
    scale = float(problem.remedy["scale"])
    assert 4.0 < 2.6 * scale < 5.2
    found = examine(file, Reading("z", "x"), stated=frozenset({"scale"}))
    assert not any(problem.text.startswith("units") for problem in found.problems)
    assert any("is doubtful" in hint and "accepted as stated" in hint for hint in found.hints)


@pytest.mark.parametrize(
    ("sdf", "expected"),
    [
        ("<pose>0 0 0 0 0 -1.57079632679</pose><geometry>{mesh}</geometry>", (0.06, "y")),
        ("<pose>0 0 0 0 0 1.5708</pose><geometry>{mesh}</geometry>", (0.06, "-y")),
        ("<pose>0 0 0 0 0 3.14159265</pose><geometry>{mesh}</geometry>", (0.06, "-x")),
        ("<geometry>{mesh}</geometry>", (0.06, None)),
        ("<pose>0 0 0 0.4 0 1.5708</pose><geometry>{mesh}</geometry>", (0.06, None)),
        ("<geometry><mesh><uri>model://suv/meshes/other.obj</uri></mesh></geometry>", None),
        ("<geometry><mesh><scale>1 2 1</scale><uri>suv.obj</uri></mesh></geometry>", None),
        ("<geometry><mesh><scale>big</scale><uri>suv.obj</uri></mesh></geometry>", None),
        ("<geometry>", None),
    ],
)
def test_the_model_of_a_simulator_says_scale_and_front(tmp_path, sdf, expected):
    mesh = "<mesh><scale>0.06 0.06 0.06</scale><uri>model://suv/meshes/suv.obj</uri></mesh>"
    text = f"<sdf><model><link><visual>{sdf.format(mesh=mesh)}</visual></link></model></sdf>"
    (tmp_path / "model.sdf").write_text(text)
    found = simulator_model(tmp_path / "meshes" / "suv.obj")
    assert (None if found is None else (found.scale, found.forward)) == expected


# ----------------------------------------------------------------------------------------------- shipped

SHIPPED = {
    "bus": (7.57, 2.42, 3.31),
    "car": (4.12, 1.76, 1.57),
    "coupe": (4.23, 1.81, 1.44),
    "minibus": (4.98, 1.88, 2.13),
    "moving_truck": (9.23, 2.50, 2.85),
    "panel_van": (6.08, 2.06, 2.19),
    "truck": (5.25, 2.01, 1.98),
}


@pytest.mark.parametrize("name", sorted(SHIPPED))
def test_a_shipped_vehicle_stands_on_its_wheels_above_its_rear_axle(name):
    mesh = wa.read_vehicle(name)
    low, high = mesh.bounds_m().astype(float)
    np.testing.assert_allclose(high - low, SHIPPED[name], atol=0.01)  # as its README says
    assert is_plausible(high - low)
    assert abs(low[2]) < 0.01
    found = examine(read_vehicle_file(vehicle_file(name)), Reading("y", "x"))
    assert found.problems == ()
    assert len(found.wheels.axle_m) == 2
    assert abs(found.wheels.axle_m[0]) < 0.02
    assert abs(found.wheels.centre_y_m) < 0.02
    assert 0.5 < found.wheels.axle_m[1] / (high[0] - low[0]) < 0.8
    assert len(np.unique(mesh.vertex_rgb, axis=0)) >= 5  # body, glass, tyres, rims, lamps
    faces = mesh.vertex_m[mesh.triangle].astype(float)
    volume = np.einsum("ij,ij->i", faces[:, 0], np.cross(faces[:, 1], faces[:, 2])).sum() / 6.0
    assert 0.3 < volume / np.prod(high - low) < 1.0  # faces outwards
