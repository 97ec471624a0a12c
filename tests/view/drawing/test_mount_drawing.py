"""The drawing of the mounts: a page of A3 in the scale that it states, coordinates, labels apart, its files."""

import functools
import importlib.util
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from tests.view.stand_ins import ego, rig
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.rig import Rig, RigCamera, builtin_modules
from warpav.view import mount_drawing
from warpav.view.drawing._mount_drawing import _PAGE_MM
from warpav.view.figures._style import text_width_mm


def drawing_of(some=None, **options):
    return mount_drawing(some or rig(), ego=ego(), **options)


@functools.cache
def drawing_with(count):
    """Of so many cameras, drawn once."""
    return drawing_of(rig(count))


def test_the_page_is_a3_and_everything_is_on_it():
    for count in (4, 24):
        figure = drawing_with(count).figure()
        assert figure.get_size_inches() * 25.4 == pytest.approx(_PAGE_MM)
        figure.draw_without_rendering()
        [axis] = figure.axes
        for text in axis.texts:
            if text.get_text():
                low_mm, high_mm = text.get_window_extent().transformed(axis.transData.inverted()).get_points()
                assert low_mm[0] > 19.5, text
                assert low_mm[1] > 10.0, text
                assert high_mm[0] < 410.5, text
                assert high_mm[1] < 287.5, text


def test_views_are_in_the_scale_that_the_page_states():
    drawing = drawing_with(4)
    assert f"1 : {drawing.scale:g}" in [note.text for note in drawing.notes]
    for view in drawing.views:
        unit_mm = view.place_mm(np.eye(3)) - view.datum_mm
        assert sorted(np.linalg.norm(unit_mm, axis=1)) == pytest.approx([0.0, *[1000.0 / drawing.scale] * 2])
    # views of one row and of one column lie in line, as in first-angle projection
    left, front, top = (view.datum_mm for view in drawing.views)
    assert left[1] == front[1] > top[1]
    assert left[0] == top[0] < front[0]
    assert np.cross(drawing.views[0].right, drawing.views[0].up) == pytest.approx([0.0, 1.0, 0.0])  # seen from the left
    assert np.cross(drawing.views[1].right, drawing.views[1].up) == pytest.approx([1.0, 0.0, 0.0])
    assert np.cross(drawing.views[2].right, drawing.views[2].up) == pytest.approx([0.0, 0.0, 1.0])


def test_arrows_are_the_optical_axes():
    one = RigCamera("cam", np.array([1.0, 0.2, 1.6]), math.radians(30.0), math.radians(10.0))
    drawing = drawing_of(Rig([one]))
    for mark in drawing.marks:
        arrow_mm = mark.tip_mm - mark.place_mm
        ahead = one.ego_from_camera[:3, 2]
        expected = np.array([ahead @ mark.view.right, ahead @ mark.view.up])
        np.testing.assert_allclose(arrow_mm / 9.0, expected, atol=1e-9)


def test_coordinates_are_said_once_and_labels_keep_apart():
    drawing = drawing_with(4)
    texts = [each.text for each in drawing.ordinates]
    assert "0..: +1580" in texts  # all four are as high
    assert "2: +500" in texts
    assert "0, 2: 0" in texts
    drawing = drawing_with(24)  # many are nearer to each other than their numbers are high
    for view in drawing.views:
        for is_across in (True, False):
            end_mm = sorted(
                each.end_mm[0 if is_across else 1]
                for each in drawing.ordinates
                if each.view is view and each.is_across == is_across
            )
            assert np.diff(end_mm).min(initial=math.inf) >= 3.2 - 1e-9


@pytest.mark.parametrize("count", [3, 8, 12])
def test_numbers_lie_on_no_other_number_and_on_no_camera(count):
    drawing = drawing_with(count)
    numbers = [note for note in drawing.notes if note.layer == "CAMERAS"]
    assert sum(len(note.text.split(", ")) for note in numbers) == 3 * count  # each camera has its number in each view
    middle_mm = np.array([note.place_mm for note in numbers])
    half_mm = 0.5 * np.array([(text_width_mm(note.text, 2.5, is_bold=True), 2.5) for note in numbers])
    apart_mm = np.abs(middle_mm[:, None] - middle_mm) - half_mm[:, None] - half_mm
    assert (apart_mm.max(axis=-1)[~np.eye(len(numbers), dtype=bool)] > 0.4).all()
    for mark in drawing.marks:
        for along in np.linspace(0.0, 1.0, 41):
            point_mm = mark.place_mm + along * (mark.tip_mm - mark.place_mm)
            reach_mm = 1.6 if along == 0.0 else 0.0  # of the cross
            assert ((np.abs(middle_mm - point_mm) - half_mm).max(axis=1) > reach_mm).all()


def test_a_leader_joins_each_number_with_its_camera():
    drawing = drawing_with(3)
    leaders = [stroke for stroke in drawing.strokes if stroke.layer == "CAMERAS"]
    numbers = [note for note in drawing.notes if note.layer == "CAMERAS"]
    assert len(leaders) == len(numbers)
    for leader, number in zip(leaders, numbers, strict=True):
        at_mm = [mark.place_mm for mark in drawing.marks if str(mark.camera) in number.text.split(", ")]
        assert min(np.linalg.norm(leader.point_mm[0] - each) for each in at_mm) < 2.0
        assert np.linalg.norm(leader.point_mm[1] - number.place_mm) < 3.0 + 1.3 * len(number.text)


def test_the_title_block_names_rig_vehicle_and_date(monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    texts = [note.text for note in drawing_of(title="rig.yaml", vehicle="van.glb").notes if note.layer == "FRAME"]
    assert {"rig.yaml", "van.glb", "1970-01-02"} <= set(texts)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "noon")
    with pytest.raises(InputError, match="SOURCE_DATE_EPOCH: expected seconds since 1970, got 'noon'"):
        drawing_of()
    monkeypatch.delenv("SOURCE_DATE_EPOCH")
    assert any(re.fullmatch(r"20\d\d-\d\d-\d\d", note.text) for note in drawing_of().notes)


@pytest.mark.parametrize("name", ["m" * 60, "van"])
def test_names_stay_in_the_cells_of_the_title_block(name):
    notes = [note for note in drawing_of(title=name, vehicle=name).notes if note.layer == "FRAME"]
    rig_note, vehicle_note = (note for note in notes if note.text == name[:44])
    assert rig_note.place_mm[0] + text_width_mm(name[:44], rig_note.height_mm) < vehicle_note.place_mm[0]


def test_housings_of_modules_are_drawn():
    name = "side_2mp_100"
    one = RigCamera("cam", np.array([1.0, 1.0, 0.9]), math.pi / 2, module=name)
    drawing = drawing_of(Rig([one]))
    housings = [stroke for stroke in drawing.strokes if stroke.layer == "HOUSINGS"]
    assert len(housings) == 3
    width_m, height_m, _ = builtin_modules()[name].housing.size_m
    span_mm = np.ptp(housings[0].point_mm, axis=0)  # it looks at the reader
    np.testing.assert_allclose(span_mm, 1000.0 / drawing.scale * np.array([width_m, height_m]), rtol=1e-4)
    assert not [stroke for stroke in drawing_of(Rig([one]), modules={}).strokes if stroke.layer == "HOUSINGS"]


def test_columns_of_the_table_keep_apart():
    """Names and modules as long as they come: what has no room is cut, and nothing stands on anything else."""
    modules = [name for name, _ in sorted(builtin_modules().items(), key=lambda item: -len(item[0]))[:3]]
    some = Rig(
        replace(each, name=f"a_camera_on_the_{'left' * k}_side", module=modules[k])
        for k, each in enumerate(rig(3).cameras)
    )
    drawing = drawing_of(some)
    figure = drawing.figure()
    figure.draw_without_rendering()
    [axis] = figure.axes
    texts = {note.text for note in drawing.notes if note.layer == "TABLE"}
    boxes = [text.get_window_extent() for text in axis.texts if text.get_text() in texts]
    assert not any(one.overlaps(other) for k, one in enumerate(boxes) for other in boxes[:k])


def test_names_that_are_cut_stay_different():
    long = [f"a_module_of_a_long_name_{each}_degrees_and_many_words" for each in (190, 120, 100)]
    some = Rig(replace(each, module=long[k]) for k, each in enumerate(rig(3).cameras))
    cut = {note.text for note in drawing_of(some, modules={}).notes if note.layer == "TABLE" and ".." in note.text}
    assert len(cut) == 3


def test_housings_are_named_where_they_can_be_seen():
    module = next(iter(builtin_modules().values()))
    some = Rig(replace(each, module="m") for each in rig(2).cameras)
    for size_m, is_named in ((0.3, True), (0.01, False)):
        housing = replace(module.housing, size_m=(size_m,) * 3, offset_m=(0.0,) * 3)
        drawing = drawing_of(some, modules={"m": replace(module, housing=housing)})
        assert any("Dashed boxes" in note.text for note in drawing.notes) == is_named


def test_it_is_written_the_same_every_time(tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    drawings = drawing_of(), drawing_of()
    for suffix, begins in (("pdf", b"%PDF"), ("svg", b"<?xml"), ("png", b"\x89PNG")):
        [first] = drawings[0].save(tmp_path / "new" / f"a.{suffix}")
        [second] = drawings[1].save(tmp_path / f"b.{suffix}")
        assert first.read_bytes() == second.read_bytes()
        assert first.read_bytes().startswith(begins)
    page = (tmp_path / "b.pdf").read_bytes()
    [size] = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", page)
    assert [float(each) / 72.0 * 25.4 for each in size] == pytest.approx(_PAGE_MM, abs=0.01)
    assert b"/Subtype /Image" not in page  # vectors alone


def test_the_command_names_the_vehicle(tmp_path):
    for options, name in (([], "embedded car"), (["scenes.ego=bus"], "bus")):
        out = tmp_path / "mounts.svg"
        assert main(["rig", "drawing", "nuscenes", *options, "--out", str(out)]) == 0
        assert f"<!-- {name} -->" in out.read_text()


def test_the_command_writes_a_file_or_a_folder(tmp_path, capsys):
    out = tmp_path / "mounts.csv"
    assert main(["rig", "drawing", "nuscenes", "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"wrote {out}\n"
    assert out.read_text().count("CAM_") == 6
    assert main(["rig", "drawing", "nuscenes", "--out", str(tmp_path / "x.stp")]) == 2
    assert "--out: expected a folder" in capsys.readouterr().err
    if importlib.util.find_spec("ezdxf"):
        assert main(["rig", "drawing", "nuscenes", "--out", str(tmp_path / "folder")]) == 0
        assert sorted(file.name for file in (tmp_path / "folder").iterdir()) == [
            *("mounts.csv", "mounts.dxf", "mounts.glb", "mounts.pdf")
        ]
