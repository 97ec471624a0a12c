"""Getting pyvista with and without a display and OpenGL."""

import ctypes
import os
import subprocess
import sys

import pytest

from warpav.core.errors import InputError
from warpav.view import _opengl as opengl


@pytest.fixture
def no_display(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


@pytest.fixture(autouse=True)
def nothing_known(monkeypatch):
    """What was found out about this machine is forgotten before and after."""
    probes = (opengl._x_server_answers, opengl._egl_draws, opengl._draws_in_memory)
    for probe in probes:
        probe.cache_clear()
    yield
    monkeypatch.undo()
    for probe in probes:
        probe.cache_clear()


def _only(*present):
    load = ctypes.CDLL

    def load_present(name, *args, **options):
        if name not in present:
            raise OSError(f"{name}: cannot open shared object file")
        return load(name, *args, **options) if name == "libEGL.so.1" else object()

    return load_present


def test_missing_libraries_are_named_instead_of_a_crash(no_display, monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", _only())
    with pytest.raises(InputError, match=r"DISPLAY is not set.*libEGL\.so\.1.*apt install libegl1"):
        opengl.load_pyvista()


def _without_opengl(code, folder, *window):
    """Run code in a process of its own: libEGL is there, but it finds no driver, and there is no OSMesa either."""
    before = (
        "import ctypes, sys; load = ctypes.CDLL\n"
        "def without_osmesa(name, *a, **o):\n"
        "    if 'OSMesa' in str(name): raise OSError(name)\n"
        "    return load(name, *a, **o)\n"
        "ctypes.CDLL = without_osmesa\n"
    )
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment |= dict(each.split("=") for each in window)
    environment |= {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent", "PYTHONPATH": os.pathsep.join(sys.path)}
    argv = [sys.executable, "-c", before + code]
    return subprocess.run(argv, capture_output=True, text=True, cwd=folder, env=environment)


@pytest.mark.skipif(sys.platform != "linux", reason="EGL is Linux's")
@pytest.mark.parametrize(
    "window",
    [
        pytest.param([], id="no display", marks=pytest.mark.nightly),
        pytest.param(["DISPLAY=:97"], id="a display that does not answer"),
    ],
)
def test_opengl_without_a_driver_is_a_message_and_no_crash(tmp_path, window):
    code = "from warpav.cli.app import main\nsys.exit(main(['inspect', 'nuscenes', '--out', 'x.png']))"
    done = _without_opengl(code, tmp_path, *window)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("images need OpenGL: there is no display")
    assert len(done.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform != "linux", reason="EGL is Linux's")
def test_data_needs_no_opengl(tmp_path):
    code = (
        "from tests.view.stand_ins import ego, rig, scene\n"
        "from warpav.view import accessor, _blocks as blocks\n"
        "from warpav.view import opengl_problem\n"
        "assert opengl_problem() is not None\n"
        "street = scene().to_pyvista()\n"
        "car = blocks.mesh_to_pyvista(ego())\n"
        "print(rig(2).to_pyvista().n_blocks, street.n_blocks, len(street.warpav.as_scene().vehicles))\n"
        "print(len(car.warpav.as_mesh().triangle), car.warpav.mount_surface(cell_m=0.3).n_cells > 0)\n"
    )
    done = _without_opengl(code, tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-2:] == ["2 2 0", "12 True"]


@pytest.mark.skipif(sys.platform != "linux", reason="X is Linux's")
def test_a_display_that_does_not_answer_is_none(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":97")
    assert not opengl.has_display()
    assert opengl.display_text() == "no X server with GLX answers to DISPLAY=:97"


@pytest.mark.parametrize(
    ("library", "window"), [("libEGL.so.1", "vtkEGLRenderWindow"), ("libOSMesa.so.8", "vtkOSOpenGLRenderWindow")]
)
def test_vtk_is_told_what_to_draw_with(no_display, monkeypatch, library, window):
    if library == "libEGL.so.1" and not opengl._egl_draws():
        pytest.skip("no EGL")
    opengl._egl_draws.cache_clear()
    monkeypatch.setattr(ctypes, "CDLL", _only(library))
    monkeypatch.setenv("VTK_DEFAULT_OPENGL_WINDOW", "to be removed")
    monkeypatch.delenv("VTK_DEFAULT_OPENGL_WINDOW")
    opengl.tell_vtk_where_to_draw()
    assert os.environ["VTK_DEFAULT_OPENGL_WINDOW"] == window


def test_own_choice_of_window_is_kept(no_display, monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", _only("libOSMesa.so.8"))
    monkeypatch.setenv("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    opengl.tell_vtk_where_to_draw()
    assert os.environ["VTK_DEFAULT_OPENGL_WINDOW"] == "vtkEGLRenderWindow"


def test_display_needs_no_library(no_display, monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", _only())
    monkeypatch.setattr(opengl, "_x_server_answers", lambda name: name == ":0")
    monkeypatch.setenv("DISPLAY", ":0")
    assert opengl.has_display()
    assert opengl.opengl_problem() is None


def test_optional_module_says_how_to_get_it():
    with pytest.raises(
        InputError, match=r'an orbit needs the module no_such_module.*; run: pip install "warpav\[it\]"'
    ):
        opengl.optional_module("no_such_module", purpose="an orbit", extra="it")


def test_importing_the_views_imports_neither_pyvista_nor_matplotlib():
    code = (
        "import sys, warpav.view.figures, warpav.view._output; "
        "print([name for name in ('pyvista', 'vtkmodules', 'matplotlib', 'warp') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
