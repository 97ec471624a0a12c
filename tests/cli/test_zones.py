"""``warpav vehicle zones`` and runs with ``mount.zones``."""

import json
import shutil

import numpy as np
import pytest
import trimesh

from tests.cli.small_run import complaint
from tests.cli.test_pool_run import POOL
from warpav.cli.app import main
from warpav.rig import chart_of, read_zones
from warpav.runs import RunFolder
from warpav.scene import ego_vehicle, write_vehicle

pytestmark = pytest.mark.usefixtures("working_directory")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The vehicle of the scenes, and the zones that are proposed for it."""
    folder = tmp_path_factory.mktemp("made")
    ego = ego_vehicle()
    write_vehicle(ego, folder / "car.glb")
    assert main(["vehicle", "zones", str(folder / "car.glb"), "--out", str(folder / "zones.yaml")]) == 0
    return ego, folder


@pytest.fixture
def car(working_directory, made):
    """A file of the vehicle of the scenes."""
    ego, folder = made
    shutil.copy(folder / "car.glb", working_directory)
    return ego


@pytest.fixture
def zones(working_directory, made):
    """A file of the zones that are proposed for it."""
    return shutil.copy(made[1] / "zones.yaml", working_directory)


def test_zones_are_proposed_edited_and_used(working_directory, car, capsys):
    assert main(["vehicle", "zones", "car.glb", "--out", "all.yaml", "--image", "zones.png"]) == 0
    said = capsys.readouterr().out
    assert all(f"  {name}" in said for name in ("roof", "bonnet", "left", "right", "front", "rear"))
    assert "mount.zones=all.yaml" in said
    assert (working_directory / "zones.png").stat().st_size > 10_000
    assert main(["vehicle", "zones", "car.glb", "--out", "again.yaml", "--image", "old.bmp"]) == 2
    assert capsys.readouterr().err.startswith("old.bmp: expected a name that ends in .png")
    assert not (working_directory / "again.yaml").exists()
    trimesh.Trimesh(1000.0 * car.vertex_m, car.triangle).export("in mm.stl")
    for words, told in (
        (["vehicle", "zones", "in mm.stl"], "millimetres; warpav vehicle check 'in mm.stl' says how to fix it"),
        (["inspect", "car.glb"], "car.glb: rig: expected a rig YAML, got a mesh; give a vehicle as scenes.ego=car.glb"),
        (["view", "car.glb"], "rename the node, or give a vehicle alone as scenes.ego"),
    ):
        assert main(words) == 2
        assert told in capsys.readouterr().err
    assert "kept out: 4 x wheel" in said
    zones = read_zones("all.yaml")
    assert len(zones) == 8
    assert [zone.name for zone in zones if zone.is_behind_glass] == ["windscreen", "rear_window"]
    assert "  not told    the windscreen has no name, and is not dark" in said
    assert any(zone.keep_out_m for zone in zones)
    # edited: the doors alone, flush
    (working_directory / "doors.yaml").write_text(
        "zones:\n  door:\n    normal: left\n    box_m: [[0.5, 0.5, 0.6], [2.0, 1.0, 1.0]]\n    stand_off_m: 0.02\n"
        "    yaw_deg: [40, 140]\n    pitch_deg: [5, 15]\n    mirror: true\n"
    )
    assert main(["optimise", *POOL, "mount.zones=doors.yaml", "run.out=doors"]) == 0
    folder = RunFolder.open("doors")
    chart = chart_of(read_zones("doors.yaml"), car)
    for rig in (folder.rig(), folder.rig("initial")):
        for camera in rig.cameras:
            place_m, rise_m = chart.place_of(camera.position_m)
            assert float(rise_m) == pytest.approx(
                0.02, abs=5e-3
            )  # cells of 2 and 4 cm differ a little, and numbers are rounded
            assert chart.zone_distance_m(place_m) > 0.0
            side = 1.0 if camera.position_m[1] > 0.0 else -1.0
            assert 39.9 < side * np.degrees(camera.yaw_rad) < 140.1
            assert 4.9 < np.degrees(camera.pitch_rad) < 15.1
    assert json.loads((folder.path / "evaluation.json").read_text())
    # the run is read again from its folder, which keeps the zones, wherever it lies
    (working_directory / "doors.yaml").unlink()
    (working_directory / "doors").rename(working_directory / "moved")
    folder = RunFolder.open("moved")
    assert folder.config().mount.zones == working_directory / "moved" / "zones.yaml"
    assert [zone.name for zone in read_zones(folder.config().mount.zones)] == ["door", "door_mirrored"]
    assert main(["report", "moved"]) == 0
    assert main(["inspect", "moved", "--out", "rig.png"]) == 0


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["mount.zones=zone.yaml"], ["mount.zones", "no such file"]),
        (["mount.zones=zones.yaml", "method=thesis"], ["mount.zones", "method: default"]),
        (["mount.zones=zones.yaml", "rig.free.height_m=[0.1,0.3]"], ["rig.free.height_m", "stand_off_m"]),
    ],
)
@pytest.mark.usefixtures("zones")
def test_what_does_not_go_with_zones_is_one_line(capsys, overrides, words):
    line = complaint(capsys, "optimise", *POOL, *overrides, "run.out=none")
    assert all(word in line for word in words)


def test_a_broken_file_of_zones_leaves_nothing(working_directory, capsys):
    (working_directory / "zones.yaml").write_text("zones: {door: {normal: lefft}}\n")
    line = complaint(capsys, "optimise", *POOL, "mount.zones=zones.yaml", "run.out=none")
    assert "zones.door.normal" in line
    assert "did you mean left" in line
    assert not (working_directory / "none").exists()
