"""``warpav vehicle check``, and a user's own vehicle in the place of every scene's: ``scenes.ego``."""

import shlex

import numpy as np
import pytest

from tests.runs.test_scenes import small_scene
from tests.scene.test_mesh_colours import write_obj, write_texture
from tests.scene.test_own_vehicle import of_kind, save
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.experiments._result_folder import unseeded
from warpav.runs import load_scenes
from warpav.runs._mounts import mount_surface
from warpav.runs._networks import detector_use
from warpav.runs._scene_set import own_vehicle
from warpav.runs.config import load_config, with_absolute_paths
from warpav.scene import (
    Box,
    Reading,
    Scene,
    Vehicle,
    ego_vehicle,
    read_vehicle,
    read_vehicle_file,
    town_scene,
    write_scene,
    write_vehicle,
)

pytestmark = pytest.mark.usefixtures("working_directory")


@pytest.fixture(scope="module")
def car():
    return ego_vehicle()


def check(*words):
    return main(["vehicle", "check", *map(str, words)])


# ----------------------------------------------------------------------------------------------- the command


def test_a_good_vehicle_is_described_and_can_be_used(car, tmp_path, capsys):
    write_vehicle(car, tmp_path / "car.glb")
    assert check("car.glb") == 0
    said = capsys.readouterr()
    assert said.err == ""
    for text in (
        "10040 triangles",
        "y up, x forward, metres",
        "4.699 x 2.217 x 1.55 m",
        "watertight, none without area",
        "left and right are alike",
        "lowest point at z = +0.000 m",
        "axles at x = 0.00, 2.82 m",
        "roof 2.73 m² at 1.53 m, bonnet 1.74 m² at 0.98 m",
        "1.55 m, at x 0.56, y 0.00",
        "it can be used as it is: scenes.ego=car.glb",
    ):
        assert text in said.out


@pytest.mark.parametrize(
    ("name", "reading", "words"),
    [
        ("my car.glb", Reading("z", "x", 0.01), "--scale 0.01 --up z"),
        pytest.param("cm.obj", Reading("z", "x", 0.01), "--scale 0.01", marks=pytest.mark.nightly),
        ("mm.stl", Reading("y", "z", 0.001), "--scale 0.001 --up y --forward z"),
        ("roof.ply", Reading("-z", "x"), "--up -z"),
    ],
)
def test_the_suggested_command_fixes_the_file(car, tmp_path, capsys, name, reading, words):
    save(car, tmp_path / name, reading=reading)
    assert check(name) == 2
    told = capsys.readouterr().err.splitlines()
    assert all(line.startswith(f"{name}: ") for line in told)
    fixed = f"{name.partition('.')[0]}_ego.glb"
    command = shlex.join(["warpav", "vehicle", "check", name, *words.split(), "--out", fixed])
    assert told[-1] == f"{name}: to fix it: {command}"
    assert main(shlex.split(command)[1:]) == 0
    assert shlex.split(capsys.readouterr().out.partition("use it with ")[2]) == [f"scenes.ego={fixed}"]
    assert check(fixed) == 0
    file = read_vehicle_file(fixed)
    np.testing.assert_allclose(
        np.sort(file.in_ego_frame(file.usual).bounds_m(), axis=0), np.sort(car.bounds_m(), axis=0), atol=0.01
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none.glb"], "none.glb: vehicle: expected a mesh file"),
        (["car.ply", "--up", "w"], 'command line: Invalid value "w" for --up'),
        (["car.ply", "--up", "x", "--forward", "x"], "command line (--forward): expected an axis across x"),
        (["car.ply", "--scale", "0"], "command line (--scale): expected a positive number, got 0.0"),
        (["car.ply", "--out", "car.obj"], "car.obj: --out: expected a name that ends in .glb"),
        (
            ["car.ply", "--rear-axle", "9"],
            "(--rear-axle): expected a distance from the rear end of up to 4.70 m",
        ),
        (["car.ply", "--image", "car.bmp"], "car.bmp: expected a name that ends in .png"),
        (["quad.obj", "--image", "quad.png"], "quad.png: --image: expected another file than those that the vehicle"),
        (["car.ply", "mount.cel_m=1"], "command line (mount.cel_m=1): mount.cel_m: expected one of cell_m"),
        (["car.ply", "--out", "none/car.glb"], "none/car.glb: cannot write the vehicle: No such file or directory"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(car, tmp_path, capsys, words, message):
    save(car, tmp_path / "car.ply")
    write_obj(tmp_path / "quad.obj")
    write_texture(tmp_path / "quad.png")
    assert check(*words) == 2
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1


# ----------------------------------------------------------------------------------------------- scenes.ego


def test_another_vehicle_carries_the_cameras_of_every_source(tmp_path):
    write_vehicle(van := moved_van(), tmp_path / "van.glb")
    (tmp_path / "scenes").mkdir()
    for seed in (3, 4):
        write_scene(town_scene(seed), tmp_path / "scenes" / f"scene_{seed}.glb")
    for source in (["scenes.source=town"], ["scenes.source=folder", "scenes.folder=scenes"]):
        config = load_config("quick", [*source, "scenes.ego=van.glb"])
        for scene in load_scenes(config, [3, 4]):
            np.testing.assert_array_equal(scene.ego.vertex_m, van.vertex_m)


def moved_van():
    mesh = of_kind("van")
    return mesh.transformed(np.eye(3), np.array([1.382, 0.0, 0.0]))


def test_who_stands_at_its_place_is_left_out_and_that_is_said(car):
    def user(number, x, y, yaw=0.0):
        box = Box(np.array([x, y, 0.7]), np.array([4.0, 1.8, 1.4]), yaw)
        return Vehicle(number, "van", car.transformed(np.eye(3), np.array([x, y, 0.0])), box)

    # the car reaches from -.99 to 3.71 m and 1.11 m to either side
    free = [(8.0, 0.0, 0.0), (1.0, 2.1, 0.0), (5.2, 2.9, np.pi / 4)]
    met = [(5.5, 0.0, 0.0), (1.0, 1.9, 0.0), (5.0, 2.0, np.pi / 4)]
    users = tuple(user(k, *place) for k, place in enumerate([*free, *met], start=1))
    scene = Scene("s", small_scene(1).environment, car, users)
    assert [each.instance_id for each in scene.around(car).vehicles] == [1, 2, 3]


def test_an_unfit_vehicle_is_rejected_with_the_command_that_examines_it(car, tmp_path, capsys):
    save(car, tmp_path / "cm.glb", reading=Reading("y", "x", 0.01))
    assert main(["inspect", "highest", "scenes.ego=cm.glb", "--out", "x.png"]) == 2
    err = capsys.readouterr().err
    assert err.startswith(
        "command line (scenes.ego=cm.glb): scenes.ego: cm.glb: units: expected a vehicle of 2 to 20 m"
    )
    assert err.endswith("; warpav vehicle check cm.glb says how to fix it\n")
    assert main(["inspect", "highest", "scenes.ego=none.glb", "--out", "x.png"]) == 2
    assert (
        "scenes.ego: expected the path of a mesh file, or null, got 'none.glb'; no such file" in capsys.readouterr().err
    )
    (tmp_path / "bad.glb").write_bytes(b"glTF")
    with pytest.raises(InputError, match=r"scenes\.ego: bad\.glb: vehicle: expected a readable glb file"):
        own_vehicle(load_config("quick", ["scenes.ego=bad.glb"]))


def test_what_was_made_with_another_vehicle_is_made_again(car, tmp_path):
    write_vehicle(car, tmp_path / "car.glb")
    plain = load_config("quick")
    own = load_config("quick", ["scenes.ego=car.glb"])
    assert detector_use(plain).settings.get("scenes.ego") is None
    assert "ego" not in detector_use(plain).settings["scenes"]  # fits from before there was the option stay good
    first = detector_use(own).identity, unseeded(own)
    assert first[0] != detector_use(plain).identity
    assert first[1] != unseeded(plain)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "car.glb").rename(tmp_path / "elsewhere" / "car.glb")
    moved = load_config("quick", ["scenes.ego=elsewhere/car.glb"])
    assert (detector_use(moved).identity, unseeded(moved)) == first
    write_vehicle(moved_van(), tmp_path / "elsewhere" / "car.glb")
    assert detector_use(moved).identity != first[0]
    assert unseeded(moved) != first[1]
    assert with_absolute_paths(moved).scenes.ego == tmp_path / "elsewhere" / "car.glb"


# ----------------------------------------------------------------------------------------------- shipped vehicles


def test_a_name_stands_for_a_shipped_vehicle(working_directory, capsys):
    config = load_config("quick", ["scenes.ego=bus"])
    assert own_vehicle(config).bounds_m()[1, 2] == pytest.approx(3.31, abs=0.01)
    assert str(with_absolute_paths(config).scenes.ego) == "bus"
    assert detector_use(config).identity != detector_use(load_config("quick", ["scenes.ego=truck"])).identity
    assert main(["inspect", "highest", "scenes.ego=buss", "--out", "x.png"]) == 2
    assert capsys.readouterr().err == (
        "command line (scenes.ego=buss): scenes.ego: expected one of bus, car, coupe, minibus, moving_truck, "
        "panel_van, truck, the path of a mesh file, or null, got 'buss'; did you mean bus?\n"
    )


# ----------------------------------------------------------------------------------------------- bonnets


@pytest.mark.parametrize(
    ("mesh", "bonnet"),
    [
        ("prius_hybrid/meshes/Hybrid.obj", "bonnet 0.80 m²"),
        ("hatchback/meshes/hatchback.obj", "bonnet 0.76 m²"),
    ],
)
def test_a_flat_windscreen_between_roof_and_bonnet_carries_no_camera(vehicle_folder, capsys, mesh, bonnet):
    check(vehicle_folder / mesh)
    said = capsys.readouterr().out
    assert "no bonnet was found" not in said
    assert bonnet in said
    assert "glass is left out, though flat enough to carry cameras: windscreen" in said


@pytest.mark.parametrize("is_symmetric", ["true", "false"])
def test_a_flat_rear_window_carries_no_camera(capsys, is_symmetric):
    assert check("coupe", f"rig.symmetric={is_symmetric}") == 0
    assert "glass is left out, though flat enough to carry cameras: rear window" in capsys.readouterr().out
    surface = mount_surface(load_config("quick", [f"rig.symmetric={is_symmetric}"]), read_vehicle("coupe"))
    x_m, y_m, _ = surface.point_m(surface.place_m, surface.height_m)[surface.inside].T
    assert not ((x_m > -0.3) & (x_m < 0.45) & (np.abs(y_m) < 0.55)).any()  # its dark glass
