"""Files that pictures are written to."""

import functools
import importlib.util

import numpy as np
import pytest
from PIL import Image

from tests.view.stand_ins import ego, rig, scene, vehicle
from warpav.errors import InputError
from warpav.view import picture
from warpav.view.opengl import opengl_problem
from warpav.view.rig_view import rig_plotter

needs_opengl = pytest.mark.skipif(opengl_problem() is not None, reason=f"no OpenGL: {opengl_problem()}")


@pytest.fixture
def plotter():
    made = rig_plotter(rig(), ego=ego(), off_screen=True, window_size=(160, 100))
    yield made
    made.close()


@needs_opengl
def test_png_is_written_whole_in_a_new_folder(plotter, tmp_path):
    path = picture.save_picture(plotter, tmp_path / "new" / "rig.png")
    with Image.open(path) as image:
        assert image.size == (160, 100)
        assert np.asarray(image).std() > 10.0
    assert [entry.name for entry in path.parent.iterdir()] == ["rig.png"]


@needs_opengl
def test_supersampling_keeps_the_size_of_everything_text_included():
    made = rig_plotter(rig(), ego=ego(), off_screen=True, window_size=(320, 200), title="a title")
    once = picture.picture_rgb(made, supersampling=1).astype(float)
    often = picture.picture_rgb(made, supersampling=3).astype(float)
    again = picture.picture_rgb(made, supersampling=1).astype(float)
    made.close()
    assert once.shape == often.shape == (200, 320, 3)
    assert np.abs(once - often).mean() < 4.0
    assert np.abs(once - again).max() == 0.0


@needs_opengl
def test_gif_turns_around_the_vehicle(plotter, tmp_path):
    path = picture.save_picture(plotter, tmp_path / "orbit.gif", frame_count=4, supersampling=1)
    with Image.open(path) as image:
        assert image.n_frames == 4
        first = np.asarray(image.convert("RGB")).astype(float)
        image.seek(2)
        assert np.abs(np.asarray(image.convert("RGB")) - first).mean() > 2.0


@needs_opengl
def test_html_without_trame_says_what_to_install(plotter, tmp_path, monkeypatch):
    if importlib.util.find_spec("trame_pyvista"):
        path = picture.save_picture(plotter, tmp_path / "rig.html")
        assert path.read_bytes()[:200].lower().count(b"<html") == 1
    else:
        with pytest.raises(InputError, match=r"pip install \"pyvista\[jupyter\]\""):
            picture.save_picture(plotter, tmp_path / "rig.html")
        assert list(tmp_path.iterdir()) == []


def test_other_suffix_is_refused_before_anything_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(picture, "rig_plotter", lambda *_args, **_options: pytest.fail("drawn"))
    with pytest.raises(InputError, match=r"rig\.bmp: expected a name that ends in \.png, \.html, \.gif, got '\.bmp'"):
        picture.inspect_rig(rig(), ego=ego(), out=tmp_path / "rig.bmp")


@needs_opengl
def test_place_that_cannot_be_written_is_refused(plotter, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        picture.save_picture(plotter, tmp_path / "file" / "rig.png")


@needs_opengl
def test_without_a_display_and_without_a_name_a_file_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(picture, "has_display", lambda: False)
    monkeypatch.setattr(picture, "rig_plotter", functools.partial(rig_plotter, window_size=(320, 200)))
    path = picture.inspect_rig(
        rig(), ego=ego(), scene=scene(vehicle(1, 9.0, 3.4)), out_without_display=tmp_path / "here.png"
    )
    assert path == tmp_path / "here.png"
    assert path.stat().st_size > 10_000
