"""Getting pyvista with and without a display and OpenGL."""

import ctypes
import os
import subprocess
import sys

import pytest

from warpav.errors import InputError
from warpav.view import opengl


@pytest.fixture
def no_display(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


def _only(*present):
    def load(name, *_args, **_options):
        if name not in present:
            raise OSError(f"{name}: cannot open shared object file")
        return object()

    return load


def test_missing_libraries_are_named_instead_of_a_crash(no_display, monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", _only())
    with pytest.raises(InputError, match=r"libEGL\.so\.1.*apt install libegl1"):
        opengl.load_pyvista()


@pytest.mark.parametrize(
    ("library", "window"),
    [("libEGL.so.1", "vtkEGLRenderWindow"), ("libOSMesa.so.8", "vtkOSOpenGLRenderWindow")],
)
def test_vtk_is_told_what_to_draw_with(no_display, monkeypatch, library, window):
    monkeypatch.setattr(ctypes, "CDLL", _only(library))
    monkeypatch.setenv("VTK_DEFAULT_OPENGL_WINDOW", "to be removed")
    monkeypatch.delenv("VTK_DEFAULT_OPENGL_WINDOW")
    opengl.tell_vtk_where_to_draw()
    assert os.environ["VTK_DEFAULT_OPENGL_WINDOW"] == window


def test_own_choice_of_window_is_kept(no_display, monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", _only("libEGL.so.1"))
    monkeypatch.setenv("VTK_DEFAULT_OPENGL_WINDOW", "vtkOSOpenGLRenderWindow")
    opengl.tell_vtk_where_to_draw()
    assert os.environ["VTK_DEFAULT_OPENGL_WINDOW"] == "vtkOSOpenGLRenderWindow"


def test_display_needs_no_library(no_display, monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", _only())
    monkeypatch.setenv("DISPLAY", ":0")
    assert opengl.has_display()
    assert opengl.opengl_problem() is None


def test_optional_module_says_how_to_get_it():
    with pytest.raises(InputError, match=r"an orbit needs the module no_such_module.*run `pip install it`"):
        opengl.optional_module("no_such_module", purpose="an orbit", install="pip install it")


def test_importing_the_views_imports_neither_pyvista_nor_matplotlib():
    code = (
        "import sys, warpav.figures, warpav.view.picture; "
        "print([name for name in ('pyvista', 'vtkmodules', 'matplotlib', 'warp') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
