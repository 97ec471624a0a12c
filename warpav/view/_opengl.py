"""Getting hold of pyvista on any machine: with a screen, without one, and without OpenGL at all."""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache
from typing import TYPE_CHECKING, Any

from warpav.core.errors import InputError, install_text

if TYPE_CHECKING:
    from types import ModuleType

_EGL_LIBRARY = "libEGL.so.1"
_OSMESA_LIBRARIES = ("libOSMesa.so.8", "libOSMesa.so")

_EGL_DEVICE_PLATFORM = 0x313F


def has_display() -> bool:
    """Whether a window can be opened: on Windows and macOS; else when an X server with GLX answers to DISPLAY."""
    if sys.platform in ("win32", "darwin"):
        return True
    name = os.environ.get("DISPLAY")
    return bool(name) and _x_server_answers(name)


def display_text() -> str:
    """Why there is no window, in words."""
    name = os.environ.get("DISPLAY")
    return f"no X server with GLX answers to DISPLAY={name}" if name else "DISPLAY is not set"


def opengl_problem() -> str | None:
    """Why nothing can be drawn here, in one line with the remedy; None when nothing does.

    VTK ends the whole process with a segmentation fault when it finds no OpenGL, which no ``except`` can catch. So it
    is looked for first: a library alone is not enough, it has to find something that draws.
    """
    if has_display() or _egl_draws() or _draws_in_memory():
        return None
    return (
        f"images need OpenGL: there is no display ({display_text()}), and neither {_EGL_LIBRARY} with a driver nor "
        f"{_OSMESA_LIBRARIES[0]} was found; install them with `apt install libegl1 libgl1-mesa-dri` (Debian, Ubuntu)"
    )


def tell_vtk_where_to_draw() -> None:
    """Without a display, choose VTK's window class by ``VTK_DEFAULT_OPENGL_WINDOW``, unless it is set already.

    To be called before VTK is first imported: left to itself it asks an X server first and can crash.
    """
    problem = opengl_problem()
    if problem:
        raise InputError(problem)
    _choose_window()


def load_pyvista() -> Any:  # noqa: ANN401 (pyvista builds much of itself at run time; checkers see little of it)
    """The module ``pyvista`` for plotters, imported so that it draws with or without a display."""
    tell_vtk_where_to_draw()
    import pyvista

    return pyvista


def load_pyvista_data() -> Any:  # noqa: ANN401 (as above)
    """The module ``pyvista`` for datasets, which need no OpenGL; plotters made later draw where anything can."""
    _choose_window()
    import pyvista

    return pyvista


def _choose_window() -> None:
    if not has_display() and opengl_problem() is None:
        window = "vtkEGLRenderWindow" if _egl_draws() else "vtkOSOpenGLRenderWindow"
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", window)


def _loaded(library: str) -> ctypes.CDLL | None:
    try:
        return ctypes.CDLL(library)
    except OSError:
        return None


@cache
def _x_server_answers(name: str) -> bool:
    x11 = _loaded("libX11.so.6")
    if x11 is None:
        return False
    x11.XOpenDisplay.restype = ctypes.c_void_p
    server = ctypes.c_void_p(x11.XOpenDisplay(name.encode()))
    if not server:
        return False
    unused = [ctypes.byref(ctypes.c_int()) for _ in range(3)]
    has_glx = bool(x11.XQueryExtension(server, b"GLX", *unused))  # windows of VTK need it
    x11.XCloseDisplay(server)
    return has_glx


@cache
def _egl_draws() -> bool:
    """Whether EGL has a device that can be used; the library is often there without any driver."""
    egl = _loaded(_EGL_LIBRARY)
    if egl is None:
        return False
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    query, display_of = (egl.eglGetProcAddress(name) for name in (b"eglQueryDevicesEXT", b"eglGetPlatformDisplayEXT"))
    if not (query and display_of):
        return False
    pointer, whole, flag = ctypes.c_void_p, ctypes.c_int, ctypes.c_uint
    query = ctypes.CFUNCTYPE(flag, whole, pointer, pointer)(query)
    display_of = ctypes.CFUNCTYPE(pointer, flag, pointer, pointer)(display_of)
    devices, count = (pointer * 16)(), whole(0)
    if not query(len(devices), ctypes.addressof(devices), ctypes.addressof(count)):
        return False
    for device in devices[: count.value]:
        display = display_of(_EGL_DEVICE_PLATFORM, device, None)
        if display and egl.eglInitialize(pointer(display), None, None):
            return True
    return False


@cache
def _draws_in_memory() -> bool:
    return any(_loaded(library) for library in _OSMESA_LIBRARIES)


def optional_module(name: str, *, purpose: str, extra: str) -> ModuleType:
    """An optional module, or a message that says how to get it."""
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(f"{purpose} needs the module {name}, which is not installed; {install_text(extra)}") from None
