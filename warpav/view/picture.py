"""Where a picture goes: a window, a PNG, an interactive HTML page or an animated GIF."""

from __future__ import annotations

import io
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.errors import InputError
from warpav.view.opengl import has_display, optional_module
from warpav.view.rig_view import rig_plotter

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from warpav.evaluate import ObjectOutcome
    from warpav.geometry.mesh import Mesh
    from warpav.geometry.mount_surface import MountSurface
    from warpav.rig.rig import Rig
    from warpav.scene.scene import Scene

    Plotter = Any

WIDE_ZOOM = 0.62
"""Of pictures of what a rig sees."""

PICTURE_SUFFIXES = (".png", ".html", ".gif")


def inspect_rig(
    rig: Rig,
    *,
    ego: Mesh,
    scene: Scene | None = None,
    trajectory_m: np.ndarray | None = None,
    mount_surface: MountSurface | None = None,
    outcomes: Sequence[ObjectOutcome] | None = None,
    add: Callable[[Plotter], object] | None = None,
    title: str | None = None,
    out: Path | str | None = None,
    out_without_display: Path | str = "rig.png",
) -> Path | None:
    """Show a rig in a window, or write its picture to a file.

    Args:
        rig: The cameras.
        ego: The vehicle that carries them.
        scene: Traffic and street around it; an empty ground when None.
        trajectory_m: Camera positions over the iterations [m], shape [iteration, camera, 3].
        mount_surface: When given, drawn on the vehicle in colours of height.
        outcomes: What becomes of every vehicle of the scene; they are then coloured by it.
        add: Called with the plotter; draws more into the picture, which then shows more around the vehicle.
        title: A line in the upper left corner.
        out: File to write, ``.png``, ``.html`` or ``.gif``; a window when None.
        out_without_display: File to write when ``out`` is None and there is no display.

    Returns:
        The file written, or None after the window was closed.

    Raises:
        InputError: Another suffix, a file that cannot be written, or no OpenGL on this machine.
    """
    target = Path(out) if out is not None else None if has_display() else Path(out_without_display)
    if target is not None:
        _check_suffix(target)
    is_wide = add is not None or outcomes is not None
    plotter = rig_plotter(
        rig,
        ego=ego,
        scene=scene,
        trajectory_m=trajectory_m,
        mount_surface=mount_surface,
        outcomes=outcomes,
        title=title,
        off_screen=target is not None,
        sectors=not is_wide,
        zoom=WIDE_ZOOM if is_wide else 1.0,
    )
    try:
        if add is not None:
            add(plotter)
        if target is None:
            plotter.show()
            return None
        return save_picture(plotter, target)
    finally:
        plotter.close()


def save_picture(plotter: Plotter, path: Path | str, *, supersampling: int = 2, frame_count: int = 60) -> Path:
    """Write what an off-screen plotter shows: ``.png``, ``.html`` (needs trame) or ``.gif`` (one turn around the ego).

    The file appears complete or not at all; missing folders are made.

    Args:
        plotter: What to write, not yet shown.
        path: Where to; the suffix decides what.
        supersampling: Rays per pixel and axis in PNG and GIF, 1 to 4.
        frame_count: Pictures in a GIF, at least 2.

    Returns:
        The path.

    Raises:
        InputError: Another suffix, a file that cannot be written, or trame is missing.
    """
    path = Path(path)
    _check_suffix(path)
    if path.suffix.lower() == ".png":
        encoded = io.BytesIO()
        _image(plotter, supersampling).save(encoded, format="PNG", optimize=True)
        return _write(path, encoded.getvalue())
    if path.suffix.lower() == ".gif":
        return _write(path, _orbit(plotter, frame_count=frame_count, supersampling=supersampling))
    optional_module("trame_pyvista", purpose=f"{path}: an interactive page", install='pip install "pyvista[jupyter]"')
    return _write(path, plotter.trame.export_html(None).getvalue().encode())


def picture_rgb(plotter: Plotter, *, supersampling: int = 2) -> np.ndarray:
    """What an off-screen plotter shows: uint8, shape [row, column, 3]."""
    return np.asarray(_image(plotter, supersampling))


def _image(plotter: Plotter, supersampling: int) -> Any:  # noqa: ANN401 (a Pillow image)
    """Draw larger and shrink: unlike multisampling, this also smooths translucent faces."""
    from PIL import Image

    width, height = plotter.window_size
    dots_per_inch = plotter.render_window.GetDPI()
    plotter.window_size = [width * supersampling, height * supersampling]
    plotter.render_window.SetDPI(dots_per_inch * supersampling)  # text grows with the picture
    try:
        plotter.render()
        large = plotter.screenshot(return_img=True)
    finally:
        plotter.window_size = [width, height]
        plotter.render_window.SetDPI(dots_per_inch)
    return Image.fromarray(np.ascontiguousarray(large)).resize((width, height), Image.Resampling.LANCZOS)


def _orbit(plotter: Plotter, *, frame_count: int, supersampling: int) -> bytes:
    from PIL import Image

    target = np.asarray(plotter.camera.focal_point)
    offset = np.asarray(plotter.camera.position) - target
    frames = []
    for angle in np.linspace(0.0, 2.0 * math.pi, max(2, frame_count), endpoint=False):
        cosine, sine = math.cos(angle), math.sin(angle)
        turned = np.array([cosine * offset[0] - sine * offset[1], sine * offset[0] + cosine * offset[1], offset[2]])
        plotter.camera.position = tuple(target + turned)
        frames.append(_image(plotter, supersampling).convert("P", palette=Image.Palette.ADAPTIVE, colors=255))
    plotter.camera.position = tuple(target + offset)
    encoded = io.BytesIO()
    frames[0].save(encoded, format="GIF", save_all=True, append_images=frames[1:], duration=80, loop=0, optimize=True)
    return encoded.getvalue()


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() not in PICTURE_SUFFIXES:
        raise InputError(f"{path}: expected a name that ends in {', '.join(PICTURE_SUFFIXES)}, got {path.suffix!r}")


def _write(path: Path, content: bytes) -> Path:
    unfinished = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished.write_bytes(content)
        os.replace(unfinished, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place with --out") from None
    return path
