"""Where a picture goes: a window, a notebook, a PNG, an interactive HTML page, or a film as GIF or MP4."""

from __future__ import annotations

import io
import math
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.atomic_write import atomic_write
from warpav.core.errors import InputError
from warpav.view.opengl import display_text, has_display, load_pyvista, optional_module
from warpav.view.palette import CAMERA_RGB, DESCENT_RGB
from warpav.view.rig_view import WINDOW_PX, rig_plotter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from warpav.evaluation.metrics import ObjectOutcome
    from warpav.raster.mesh import Mesh
    from warpav.rig.mount_surface import MountSurface
    from warpav.rig.rig import Rig
    from warpav.scene.scene import Scene

    Plotter = Any
    Watch = Callable[[Iterable[np.ndarray], int], Iterable[np.ndarray]]
    """Passes the pictures of a film on, told how many will come: a progress bar."""

WIDE_ZOOM = 0.62
"""Of pictures of what a rig sees."""

PICTURE_SUFFIXES = (".png", ".html", ".gif", ".mp4")
MOVIE_SUFFIXES = (".gif", ".mp4")
MOVIE_PX = (800, 500)
"""Window of films, so that a GIF stays below 5 MB."""

MOVIE_FRAME_S, MOVIE_LAST_S = 0.12, 2.0
"""How long a picture of a film of a run is shown, and how much longer the last one."""

_ORBIT_FRAMES, _ORBIT_FRAME_S = 40, 0.1
_INSTALL_MOVIE = 'pip install "warpav[movie]"'
_GIF_COLOURS = 255  # and one for what stays as it was


def inspect_rig(
    rig: Rig,
    *,
    ego: Mesh,
    scene: Scene | None = None,
    trajectory_m: np.ndarray | None = None,
    mount_surface: MountSurface | None = None,
    outcomes: Sequence[ObjectOutcome] | None = None,
    sight: bool = False,
    add: Callable[[Plotter], object] | None = None,
    is_wide: bool = False,
    title: str | None = None,
    out: Path | str | None = None,
    out_without_display: Path | str = "rig.png",
    watch: Watch | None = None,
) -> Path | None:
    """Show a rig in a window, or write its picture to a file.

    Args:
        rig: The cameras.
        ego: The vehicle that carries them.
        scene: Traffic and street around it; an empty ground when None.
        trajectory_m: Camera positions over the iterations [m], shape [iteration, camera, 3].
        mount_surface: When given, drawn on the vehicle in colours of height.
        outcomes: What becomes of every vehicle of the scene; they are then coloured by it.
        sight: Whether to paint what every camera sees of the scene.
        add: Called with the plotter; draws more into the picture.
        is_wide: Whether the picture shows more around the vehicle.
        title: A line in the upper left corner.
        out: File to write, ``.png``, ``.html``, ``.gif`` or ``.mp4``; a window when None.
        out_without_display: File to write when ``out`` is None and there is no display.
        watch: Shows how many pictures of a film are done.

    Returns:
        The file written, or None after the window was closed.

    Raises:
        InputError: Another suffix, a file that cannot be written, or no OpenGL on this machine.
    """
    target = Path(out) if out is not None else None if has_display() else Path(out_without_display)
    if target is not None:
        _check_suffix(target)
    is_wide = is_wide or sight or outcomes is not None
    window_size = MOVIE_PX if target is not None and target.suffix.lower() in MOVIE_SUFFIXES else WINDOW_PX
    plotter = rig_plotter(
        rig,
        ego=ego,
        scene=scene,
        trajectory_m=trajectory_m,
        mount_surface=mount_surface,
        outcomes=outcomes,
        sight=sight,
        title=title,
        window_size=window_size,
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
        return save_picture(plotter, target, watch=watch)
    finally:
        plotter.close()


def plot_rig(
    rig: Rig,
    out: Path | str | None = None,
    *,
    off_screen: bool | None = None,
    window_size: tuple[int, int] = WINDOW_PX,
    show: Mapping[str, Any] | None = None,
    add: Callable[[Plotter], object] | None = None,
    **options: Any,  # noqa: ANN401 (those of rig_plotter)
) -> Any:  # noqa: ANN401 (what Plotter.show returns)
    """What ``.plot()`` of a rig, a scene or a run does: show it in a window or in a notebook, or write it to a file.

    Args:
        rig: The cameras.
        out: File to write; None: show it.
        off_screen: Draw without a window; by default when there is no display.
        window_size: Width and height [px].
        show: Keyword arguments for ``pyvista.Plotter.show``; with ``out`` only ``cpos`` has a meaning.
        add: Called with the plotter; draws more into the picture.
        **options: Those of `warpav.view.rig_view.rig_plotter`.

    Returns:
        The file that was written, else what ``show`` returns.

    Raises:
        InputError: The file cannot be written, there is nothing to show it on, or no OpenGL on this machine.
    """
    options_of_show = dict(show or {})
    if out is not None:
        _check_suffix(Path(out))
        off_screen = True
    plotter = rig_plotter(rig, off_screen=off_screen, window_size=window_size, **options)
    if add is not None:
        add(plotter)
    if out is None:
        is_asked = off_screen or any(options_of_show.get(name) for name in ("screenshot", "return_img"))
        if not (is_asked or plotter.notebook or has_display() or load_pyvista().OFF_SCREEN):
            plotter.close()
            raise InputError(
                f"plot: expected a display to show it on, got none ({display_text()}); "
                'write a file instead, such as plot("picture.png")'
            )
        return plotter.show(**options_of_show)
    try:
        if "cpos" in options_of_show:
            plotter.camera_position = options_of_show["cpos"]
        return save_picture(plotter, out)
    finally:
        plotter.close()


def save_picture(
    plotter: Plotter,
    path: Path | str,
    *,
    supersampling: int = 2,
    frame_count: int = _ORBIT_FRAMES,
    watch: Watch | None = None,
) -> Path:
    """Write what an off-screen plotter shows.

    ``.png``; ``.html``, which needs trame; ``.gif``, one turn around the ego; ``.mp4``, likewise, which needs imageio
    with ffmpeg. The file appears complete or not at all; missing folders are made.

    Args:
        plotter: What to write, not yet shown.
        path: Where to; the suffix decides what.
        supersampling: Rays per pixel and axis in PNG and films, 1 to 4.
        frame_count: Pictures in a film, at least 2.
        watch: Shows how many of them are done.

    Returns:
        The path.

    Raises:
        InputError: Another suffix, a file that cannot be written, or trame or imageio is missing.
    """
    path = Path(path)
    _check_suffix(path)
    if path.suffix.lower() in MOVIE_SUFFIXES:
        frame_count = max(2, frame_count)
        orbit = _orbit(plotter, frame_count=frame_count, supersampling=supersampling)
        return save_movie(watch(orbit, frame_count) if watch else orbit, path, frame_s=_ORBIT_FRAME_S)
    if path.suffix.lower() == ".png":
        encoded = io.BytesIO()
        _image(plotter, supersampling).save(encoded, format="PNG", optimize=True)
        return _write(path, encoded.getvalue())
    optional_module("trame_pyvista", purpose=f"{path}: an interactive page", install='pip install "pyvista[jupyter]"')
    with _without_module("trame.widgets.vtklocal"):  # it downloads VTK for browsers, which the page does not use
        return _write(path, plotter.trame.export_html(None).getvalue().encode())


def save_movie(image_rgb: Iterable[np.ndarray], path: Path | str, *, frame_s: float, last_s: float = 0.0) -> Path:
    """Write a film as ``.gif`` or ``.mp4``.

    The file appears complete or not at all; missing folders are made.

    Args:
        image_rgb: The pictures, at least one, all of one size, uint8 [row, column, 3].
        path: Where to; the suffix decides what.
        frame_s: How long each is shown [s].
        last_s: How much longer the last one is [s].

    Returns:
        The path.

    Raises:
        InputError: Another suffix, a file that cannot be written, or imageio with ffmpeg is missing.
    """
    path = Path(path)
    if path.suffix.lower() not in MOVIE_SUFFIXES:
        raise InputError(f"{path}: expected a name that ends in {', '.join(MOVIE_SUFFIXES)}, got {path.suffix!r}")
    if path.suffix.lower() == ".gif":
        return _write(path, _gif(list(image_rgb), frame_s=frame_s, last_s=last_s))
    for name in ("imageio", "imageio_ffmpeg"):
        optional_module(name, purpose=f"{path}: a film as MP4", install=_INSTALL_MOVIE)
    return _write(path, _mp4(image_rgb, frame_s=frame_s, last_s=last_s))


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


def _orbit(plotter: Plotter, *, frame_count: int, supersampling: int) -> Iterator[np.ndarray]:
    target = np.asarray(plotter.camera.focal_point)
    offset = np.asarray(plotter.camera.position) - target
    for angle in np.linspace(0.0, 2.0 * math.pi, frame_count, endpoint=False):
        cosine, sine = math.cos(angle), math.sin(angle)
        turned = np.array([cosine * offset[0] - sine * offset[1], sine * offset[0] + cosine * offset[1], offset[2]])
        plotter.camera.position = tuple(target + turned)
        yield picture_rgb(plotter, supersampling=supersampling)
    plotter.camera.position = tuple(target + offset)


def _gif(image_rgb: Sequence[np.ndarray], *, frame_s: float, last_s: float) -> bytes:
    """All pictures in the colours of a few of them and in those of the cameras.

    With one palette for all, what does not move costs nothing; the cameras' colours would be lost in it, as their lines
    cover few pixels.
    """
    from PIL import Image

    some = image_rgb[:: max(1, len(image_rgb) // 4)]
    accent = np.outer([1.0, 0.65], [*CAMERA_RGB, DESCENT_RGB]).round().astype(int).ravel().tolist()
    common = Image.fromarray(np.concatenate(some)).quantize(_GIF_COLOURS - len(accent) // 3, kmeans=2)
    palette = Image.new("P", (1, 1))
    palette.putpalette([*(common.getpalette() or []), *accent])
    frames = [Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.NONE) for image in image_rgb]
    shown_ms = [round(1000 * frame_s)] * len(frames)
    shown_ms[-1] += round(1000 * last_s)
    encoded = io.BytesIO()
    frames[0].save(
        encoded, format="GIF", save_all=True, append_images=frames[1:], duration=shown_ms, loop=0, optimize=False
    )
    return encoded.getvalue()


def _mp4(image_rgb: Iterable[np.ndarray], *, frame_s: float, last_s: float) -> bytes:
    import tempfile

    imageio = optional_module("imageio.v2", purpose="a film as MP4", install=_INSTALL_MOVIE)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "film.mp4"
        with imageio.get_writer(file, format="FFMPEG", fps=1.0 / frame_s, quality=7, macro_block_size=2) as film:
            image = None
            for image in image_rgb:
                film.append_data(image)
            for _ in range(round(last_s / frame_s)):
                film.append_data(image)
        return file.read_bytes()


@contextmanager
def _without_module(name: str) -> Iterator[None]:
    """Whoever imports the module meanwhile is told that it is not installed."""
    before = sys.modules.get(name)
    sys.modules[name] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        del sys.modules[name]
        if before is not None:
            sys.modules[name] = before


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() not in PICTURE_SUFFIXES:
        raise InputError(f"{path}: expected a name that ends in {', '.join(PICTURE_SUFFIXES)}, got {path.suffix!r}")


def _write(path: Path, content: bytes) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as draft:
            draft.write_bytes(content)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place with --out") from None
    return path
