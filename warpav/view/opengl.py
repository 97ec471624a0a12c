"""Getting hold of pyvista on any machine: with a screen, without one, and without OpenGL at all."""

from __future__ import annotations

import ctypes
import os
import sys
from typing import TYPE_CHECKING, Any

from warpav.errors import InputError

if TYPE_CHECKING:
    from types import ModuleType

OFF_SCREEN_LIBRARIES = ("libEGL.so.1", "libOSMesa.so.8", "libOSMesa.so")


def has_display() -> bool:
    """Whether a window can be opened: always on Windows and macOS, elsewhere when X or Wayland answers to a name."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def opengl_problem() -> str | None:
    """What keeps pictures from being drawn here, in one line with its cure; None when nothing does.

    VTK ends the whole process with a segmentation fault when it finds no OpenGL library, which no ``except`` can
    catch. So the libraries are looked for first.
    """
    if has_display() or any(_loads(library) for library in OFF_SCREEN_LIBRARIES):
        return None
    return (
        "pictures need OpenGL: there is no display and neither libEGL.so.1 nor libOSMesa.so.8 was found; "
        "install it with `apt install libegl1 libgl1-mesa-dri` (Debian, Ubuntu) or set DISPLAY"
    )


def tell_vtk_where_to_draw() -> None:
    """Without a display, choose VTK's window class by ``VTK_DEFAULT_OPENGL_WINDOW``, unless it is set already.

    To be called before VTK is first imported: left to itself it asks an X server first and can crash.

    Raises:
        InputError: There is no display and no library that draws without one.
    """
    problem = opengl_problem()
    if problem:
        raise InputError(problem)
    if not has_display():
        window = "vtkEGLRenderWindow" if _loads("libEGL.so.1") else "vtkOSOpenGLRenderWindow"
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", window)


def load_pyvista() -> Any:  # noqa: ANN401 (pyvista builds much of itself at run time; checkers see little of it)
    """The module ``pyvista``, imported in a way that draws with or without a display.

    Raises:
        InputError: There is no display and no library that draws without one.
    """
    tell_vtk_where_to_draw()
    import pyvista

    return pyvista


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def optional_module(name: str, *, purpose: str, install: str) -> ModuleType:
    """An optional module, or a message that says how to get it.

    Args:
        name: Its import name.
        purpose: What it is needed for, as the start of the message.
        install: The command that installs it.

    Raises:
        InputError: It is not installed.
    """
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(f"{purpose} needs the module {name}, which is not installed; run `{install}`") from None
