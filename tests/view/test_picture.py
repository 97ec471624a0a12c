"""Files that pictures are written to."""

import functools
import importlib.util
import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from tests.view.stand_ins import ego, needs_opengl, rig, scene, vehicle
from warpav.core.errors import InputError
from warpav.view import picture
from warpav.view.rig_view import project_px, rig_plotter


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


@needs_opengl
def test_an_html_page_asks_nothing_of_the_network(tmp_path):
    """In a process of its own, as what is imported is imported once."""
    pytest.importorskip("trame_pyvista")
    code = (
        "import sys, socket\n"
        "def refuse(*a, **o): sys.stderr.write('network\\n'); raise OSError('no network')\n"
        "socket.getaddrinfo = refuse\n"
        "from tests.view.stand_ins import ego, rig\n"
        "from warpav.view import picture\n"
        "picture.inspect_rig(rig(), ego=ego(), out='rig.html')\n"
        "assert sys.modules.get('trame.widgets.vtklocal', ...) is not None\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "rig.html").stat().st_size > 10_000


def test_other_suffix_is_refused_before_anything_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(picture, "rig_plotter", lambda *_args, **_options: pytest.fail("drawn"))
    with pytest.raises(
        InputError, match=r"rig\.bmp: expected a name that ends in \.png, \.html, \.gif, \.mp4, got '\.bmp'"
    ):
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


# ------------------------------------------------------------------------------------------------ films


def moving_square(count=6):
    """A blue square that moves to the right over a grey ramp."""
    ramp = np.repeat(np.linspace(60, 240, 96).astype(np.uint8)[None, :, None], 64, axis=0).repeat(3, axis=2)
    for k in range(count):
        image = ramp.copy()
        image[20:30, 10 + 10 * k : 20 + 10 * k] = (36, 107, 224)
        yield image


def test_a_gif_keeps_colours_places_and_times(tmp_path):
    path = picture.save_movie(moving_square(), tmp_path / "film.gif", frame_s=0.1, last_s=2.0)
    with Image.open(path) as film:
        assert film.n_frames == 6
        for k, image in enumerate(moving_square()):
            film.seek(k)
            shown = np.asarray(film.convert("RGB")).astype(int)
            assert np.abs(shown - image).max() < 24
            assert film.info["duration"] == (100 if k < 5 else 2100)


def test_an_mp4_is_a_film_or_says_what_to_install(tmp_path):
    if not importlib.util.find_spec("imageio_ffmpeg"):
        with pytest.raises(
            InputError, match=r"film\.mp4: a film as MP4 needs .*; run `pip install \"warpav\[movie\]\"`"
        ):
            picture.save_movie(moving_square(), tmp_path / "film.mp4", frame_s=0.1)
        return
    import imageio.v2 as imageio

    path = picture.save_movie(moving_square(), tmp_path / "film.mp4", frame_s=0.1, last_s=0.5)
    with imageio.get_reader(path) as film:
        frames = [np.asarray(frame).astype(int) for frame in film]
    assert len(frames) == 6 + 5
    for frame, image in zip(frames, moving_square(), strict=False):
        assert np.abs(frame - image).mean() < 6.0
    assert list(tmp_path.iterdir()) == [path]


def test_an_mp4_without_imageio_is_refused_before_anything_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)

    def never():
        pytest.fail("drawn")
        yield

    with pytest.raises(InputError, match=r"film\.mp4: a film as MP4 needs the module imageio.*warpav\[movie\]"):
        picture.save_movie(never(), tmp_path / "film.mp4", frame_s=0.1)
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------------------------------------------ plot


@needs_opengl
def test_plot_writes_or_shows(tmp_path, monkeypatch):
    street = scene(vehicle(1, 9.0, 3.4))
    assert rig().plot(tmp_path / "rig.png", scene=street, window_size=(160, 100)) == tmp_path / "rig.png"
    assert street.plot(tmp_path / "street.png", window_size=(160, 100), cpos="xy") == tmp_path / "street.png"
    one, other = (np.asarray(Image.open(tmp_path / f"{name}.png")).astype(int) for name in ("rig", "street"))
    assert one.shape == other.shape == (100, 160, 3)
    assert np.abs(one - other).mean() > 5.0
    shown = rig().plot(off_screen=True, screenshot=tmp_path / "shot.png", return_img=True, window_size=(160, 100))
    assert shown.shape == (100, 160, 3)
    assert (tmp_path / "shot.png").is_file()
    with pytest.raises(InputError, match=r"expected a name that ends in .*, got '\.bmp'"):
        rig().plot(tmp_path / "rig.bmp")
    monkeypatch.setattr(picture, "has_display", lambda: False)
    monkeypatch.setattr("warpav.view.opengl.has_display", lambda: False)
    monkeypatch.setattr("pyvista.OFF_SCREEN", False)
    with pytest.raises(InputError, match=r"plot: expected a display .* write a file instead, such as plot"):
        rig().plot()


@needs_opengl
def test_a_rig_without_a_vehicle_floats_above_the_axes():
    alone = rig_plotter(rig(), off_screen=True, window_size=(160, 100))
    on_ego = rig_plotter(rig(), scene=scene(), off_screen=True, window_size=(160, 100))
    try:
        assert {"axis/x", "axis/y", "axis/z"} <= set(alone.actors)
        assert "ego" not in alone.actors
        assert "ego" in on_ego.actors
        centre_px = project_px(alone, np.array([camera.position_m for camera in rig().cameras]))
        assert ((centre_px > 0) & (centre_px < [160, 100])).all()
    finally:
        alone.close()
        on_ego.close()
