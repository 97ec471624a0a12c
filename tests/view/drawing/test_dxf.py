"""The drawing as DXF, read back by ezdxf: clean, every camera at its coordinates, dimensions that measure them."""

import math
import re
import sys

import numpy as np
import pytest

from tests.view.stand_ins import ego, rig
from warpav.core.errors import InputError
from warpav.rig import Rig, RigCamera
from warpav.view import mount_drawing
from warpav.view.drawing._dxf import BLOCK, LAYERS

RIG = Rig(
    [*rig().cameras, RigCamera("low", np.array([-0.95, -0.4, 0.6]), math.pi, math.radians(12.0), math.radians(-3.0))]
)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    pytest.importorskip("ezdxf", reason="ezdxf is not installed")
    folder = tmp_path_factory.mktemp("dxf")
    return mount_drawing(RIG, ego=ego(), title="five"), folder


@pytest.fixture(scope="module")
def document(written):
    import ezdxf

    drawing, folder = written
    [file] = drawing.save(folder / "mounts.dxf")
    return ezdxf.readfile(file)


def test_it_is_clean_and_in_millimetres(document):
    audit = document.audit()
    assert (audit.errors, audit.fixes) == ([], [])
    assert document.units == 4  # ezdxf.units.MM
    assert {layer.dxf.name for layer in document.layers} >= LAYERS.keys()


def test_every_camera_is_at_its_coordinates_in_every_view(written, document):
    drawing, _ = written
    datum = {view.name: drawing.scale * (view.datum_mm - drawing.views[0].datum_mm) for view in drawing.views}
    assert datum["left"].tolist() == [0.0, 0.0]
    seen = {"left": lambda x, y, z: (-x, z), "front": lambda x, y, z: (y, z), "top": lambda x, y, z: (-x, -y)}
    inserts = document.modelspace().query(f'INSERT[name=="{BLOCK}"]')
    assert len(inserts) == 3 * len(RIG.cameras)
    by_name = {camera.name: camera for camera in RIG.cameras}
    for insert in inserts:
        of = {attribute.dxf.tag: attribute.dxf.text for attribute in insert.attribs}
        camera = by_name[of["NAME"]]
        expected = datum[of["VIEW"]] + 1000.0 * np.array(seen[of["VIEW"]](*camera.position_m))
        np.testing.assert_allclose(insert.dxf.insert.vec2, expected, atol=2e-3)  # rounded to a micrometre
        assert [float(of[f"{axis}_MM"]) for axis in "XYZ"] == pytest.approx(1000.0 * camera.position_m, abs=0.06)
        assert float(of["PITCH_DEG"]) == pytest.approx(math.degrees(camera.pitch_rad), abs=0.006)


def test_dimensions_measure_what_they_say(document):
    dimensions = document.modelspace().query("DIMENSION")
    said = [float(dimension.dxf.text.rpartition(":")[2]) for dimension in dimensions]
    assert len(said) > 8
    for dimension, value_mm in zip(dimensions, said, strict=True):
        assert dimension.dxf.layer == "DIMENSIONS"
        # what CAD measures: the feature from the datum; forward and left run backwards in some views
        along = 0 if dimension.dxf.dimtype & 64 else 1
        measured_mm = dimension.dxf.defpoint2[along] - dimension.dxf.defpoint[along]
        assert abs(measured_mm) == pytest.approx(abs(value_mm), abs=0.51)
    x_mm, y_mm, z_mm = 1000.0 * np.array([camera.position_m for camera in RIG.cameras]).T
    assert {*map(round, x_mm), *map(round, y_mm), *map(round, z_mm)} <= set(said)
    assert {-900, 3600, 1500} <= set(said)  # the ends of the vehicle


def test_the_outline_is_that_of_the_vehicle(document):
    lines = document.modelspace().query('LWPOLYLINE[layer=="OUTLINE"]')
    assert len(lines) == 3
    point_mm = np.array(lines[0].get_points("xy"))
    np.testing.assert_allclose(point_mm.min(axis=0), [-3600, 100], atol=3.0)
    np.testing.assert_allclose(point_mm.max(axis=0), [900, 1500], atol=3.0)


def test_the_same_drawing_has_the_same_bytes(written):
    drawing, folder = written
    first, second = (drawing.save(folder / f"{name}.dxf")[0].read_bytes() for name in "ab")
    assert first == second
    assert mount_drawing(RIG, ego=ego(), title="five").save(folder / "c.dxf")[0].read_bytes() == first
    # classes stand in the order of their names, not in that of a set
    names = re.findall(rb"\nCLASS\r?\n +1\r?\n(\w+)", first)
    own = [name for name in names if name in (b"ACDBPLACEHOLDER", b"LAYOUT", b"MATERIAL", b"VISUALSTYLE")]
    assert own == sorted(own)
    assert len(own) > 1


def test_without_ezdxf_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ezdxf", None)
    with pytest.raises(
        InputError, match=r'a\.dxf: a drawing as DXF needs the module ezdxf.*pip install "warpav\[cad\]"'
    ):
        mount_drawing(rig(), ego=ego()).save(tmp_path / "a.dxf")
    assert list(tmp_path.iterdir()) == []
    files = mount_drawing(rig(), ego=ego()).save(tmp_path / "folder")
    assert [file.name for file in files] == ["mounts.pdf", "mounts.csv", "mounts.glb"]
