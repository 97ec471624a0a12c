"""Files that images and animations are written to."""

import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from tests.view.stand_ins import ego, needs_opengl, rig
from warpav.core.errors import InputError
from warpav.view import Canvas, Picture, rig_plotter
from warpav.view import _output as output
from warpav.view._output import Animation


@pytest.fixture
def plotter():
    made = rig_plotter(Picture(rig=rig(), ego=ego()), Canvas(window_size=(160, 100), off_screen=True))
    yield made
    made.close()


@needs_opengl
def test_png_is_written_whole_in_a_new_folder(plotter, tmp_path):
    path = output.save_image(plotter, tmp_path / "new" / "rig.png")
    with Image.open(path) as image:
        assert image.size == (160, 100)
        assert np.asarray(image).std() > 10.0
    assert [entry.name for entry in path.parent.iterdir()] == ["rig.png"]


@needs_opengl
def test_supersampling_keeps_the_size_of_everything_text_included():
    made = rig_plotter(Picture(rig=rig(), ego=ego()), Canvas(None, "a title", (320, 200), off_screen=True))
    once = output.render_rgb(made, supersampling=1).astype(float)
    often = output.render_rgb(made, supersampling=3).astype(float)
    again = output.render_rgb(made, supersampling=1).astype(float)
    made.close()
    assert once.shape == often.shape == (200, 320, 3)
    assert np.abs(once - often).mean() < 4.0
    assert np.abs(once - again).max() == 0.0


@needs_opengl
def test_gif_turns_around_the_vehicle(plotter, tmp_path, monkeypatch):
    monkeypatch.setattr(output, "_ORBIT_FRAMES", 4)
    path = output.save_image(plotter, tmp_path / "orbit.gif")
    with Image.open(path) as image:
        assert image.n_frames == 4
        first = np.asarray(image.convert("RGB")).astype(float)
        image.seek(2)
        assert np.abs(np.asarray(image.convert("RGB")) - first).mean() > 2.0


@needs_opengl
def test_an_html_page_asks_nothing_of_the_network(tmp_path):
    """In a process of its own, as what is imported is imported once."""
    pytest.importorskip("k3d")
    code = (
        "import sys, socket\n"
        "def refuse(*a, **o): sys.stderr.write('network\\n'); raise OSError('no network')\n"
        "socket.getaddrinfo = refuse\n"
        "from tests.view.stand_ins import ego, rig\n"
        "from warpav.view import plot\n"
        "plot(rig(), ego=ego(), out='rig.html')\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "rig.html").stat().st_size > 10_000


@needs_opengl
def test_place_that_cannot_be_written_is_refused(plotter, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="expected a place to write to"):
        output.save_image(plotter, tmp_path / "file" / "rig.png")


# ------------------------------------------------------------------------------------------------ animations


def moving_square(count=6):
    """A blue square that moves to the right over a grey ramp."""
    ramp = np.repeat(np.linspace(60, 240, 96).astype(np.uint8)[None, :, None], 64, axis=0).repeat(3, axis=2)
    for k in range(count):
        image = ramp.copy()
        image[20:30, 10 + 10 * k : 20 + 10 * k] = (36, 107, 224)
        yield image


def test_a_gif_keeps_colours_places_and_times(tmp_path):
    path = output.save_animation(Animation(moving_square(), 6, 0.1, 2.0), tmp_path / "animation.gif")
    with Image.open(path) as shown:
        assert shown.n_frames == 6
        for k, image in enumerate(moving_square()):
            shown.seek(k)
            drawn = np.asarray(shown.convert("RGB")).astype(int)
            assert np.abs(drawn - image).max() < 24
            assert shown.info["duration"] == (100 if k < 5 else 2100)


def test_an_mp4_is_an_animation(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    import imageio.v2 as imageio

    path = output.save_animation(Animation(moving_square(), 6, 0.1, 0.5), tmp_path / "animation.mp4")
    with imageio.get_reader(path) as shown:
        frames = [np.asarray(frame).astype(int) for frame in shown]
    assert len(frames) == 6 + 5
    for frame, image in zip(frames, moving_square(), strict=False):
        assert np.abs(frame - image).mean() < 6.0
    assert list(tmp_path.iterdir()) == [path]


def test_an_mp4_without_imageio_is_refused_before_anything_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)

    def never():
        pytest.fail("drawn")
        yield

    with pytest.raises(
        InputError, match=r"animation\.mp4: an animation as MP4 needs the module imageio.*warpav\[movie\]"
    ):
        output.save_animation(Animation(never(), 1, 0.1), tmp_path / "animation.mp4")
    assert list(tmp_path.iterdir()) == []
