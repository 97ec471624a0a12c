"""Files of images: PNG, an interactive HTML page, or an animation as GIF or MP4."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import InputError
from warpav.core.files import atomic_write, writing
from warpav.view._layers import no_render
from warpav.view._opengl import optional_module
from warpav.view._palette import CAMERA_RGB, DESCENT_RGB

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from warpav.core.progress import Progress

    Plotter = Any

_SUFFIXES = (".png", ".html", ".gif", ".mp4")
_ANIMATION_SUFFIXES = (".gif", ".mp4")
ANIMATION_PX = (800, 500)
"""Window of animations, so that a GIF stays below 5 MB."""

ANIMATION_FRAME_S, ANIMATION_LAST_S = 0.12, 2.0
"""How long an image of a run's animation is shown, and how much longer the last one."""

_ORBIT_FRAMES, _ORBIT_FRAME_S = 40, 0.1
_GIF_COLOURS = 255  # and one for what stays as it was


@dataclass(frozen=True)
class Canvas:
    """What plots of all classes have in common; `warpav.view.plot` says what each means.

    Attributes:
        window_size: Width and height [px]; None: what suits the object and the file.
    """

    out: Path | None = None
    title: str | None = None
    window_size: tuple[int, int] | None = None
    zoom: float | None = None
    off_screen: bool | None = None

    @property
    def is_animation(self) -> bool:
        return self.out is not None and self.out.suffix.lower() in _ANIMATION_SUFFIXES

    def size_px(self, usual: tuple[int, int]) -> tuple[int, int]:
        """Width and height [px], where images have the usual size unless another one was asked for."""
        return self.window_size or (ANIMATION_PX if self.is_animation else usual)


@dataclass(frozen=True, eq=False)
class Animation:
    """Images of an animation, all of one size, uint8 [row, column, 3]; drawn as they are gone through, once."""

    image_rgb: Iterable[np.ndarray]
    count: int
    frame_s: float
    last_s: float = 0.0


def save_image(plotter: Plotter, path: Path | str, *, progress: Progress | None = None) -> Path:
    """Write what an off-screen plotter shows: an image, a page that stands alone, or one turn around the ego."""
    path = Path(path)
    check_suffix(path)
    if path.suffix.lower() in _ANIMATION_SUFFIXES:
        return save_animation(Animation(_orbit(plotter), _ORBIT_FRAMES, _ORBIT_FRAME_S), path, progress=progress)
    if path.suffix.lower() == ".png":
        return save_rgb(render_rgb(plotter), path)
    return save_page({path.stem: plotter}, path, title=path.stem)


def save_page(plotters: Mapping[str, Plotter], path: Path | str, *, title: str, lines: Sequence[str] = ()) -> Path:
    from warpav.view._page import page_of

    page = page_of(plotters, title=title, lines=lines)
    return write_bytes(Path(path), page.html().encode())


def save_animation(animation: Animation, path: Path | str, *, progress: Progress | None = None) -> Path:
    path = Path(path)
    if path.suffix.lower() not in _ANIMATION_SUFFIXES:
        raise InputError(f"{path}: expected a name that ends in {', '.join(_ANIMATION_SUFFIXES)}, got {path.suffix!r}")
    check_suffix(path)
    images = animation.image_rgb
    if progress is not None:
        images = progress.steps("images", images, count=animation.count)
    encode = _gif if path.suffix.lower() == ".gif" else _mp4
    return write_bytes(path, encode(images, frame_s=animation.frame_s, last_s=animation.last_s))


def save_rgb(image_rgb: np.ndarray, path: Path) -> Path:
    """Write an image as PNG, uint8 [row, column, 3]."""
    from PIL import Image

    encoded = io.BytesIO()
    Image.fromarray(image_rgb).save(encoded, format="PNG", compress_level=4)  # the default takes twice as long
    return write_bytes(path, encoded.getvalue())


def render_rgb(plotter: Plotter, *, supersampling: int = 2) -> np.ndarray:
    """What an off-screen plotter shows, uint8 [row, column, 3]: drawn larger, so that translucent faces are smooth."""
    from PIL import Image

    width, height = plotter.window_size
    window = plotter.render_window
    dots_per_inch, samples = window.GetDPI(), window.GetMultiSamples()
    if supersampling > 1:
        window.SetMultiSamples(0)  # on top of it they cost as much as the image, and change nothing
    window.SetDPI(dots_per_inch * supersampling)  # text grows with the image
    plotter.window_size = [width * supersampling, height * supersampling]  # draws, unless it is the first time
    try:
        large = plotter.screenshot(return_img=True)
    finally:
        window.SetMultiSamples(samples)
        window.SetDPI(dots_per_inch)
        with no_render(plotter):
            plotter.window_size = [width, height]
    return np.asarray(Image.fromarray(np.ascontiguousarray(large)).resize((width, height), Image.Resampling.LANCZOS))


def _orbit(plotter: Plotter) -> Iterator[np.ndarray]:
    target = np.asarray(plotter.camera.focal_point)
    x, y, z = np.asarray(plotter.camera.position) - target
    for angle in np.linspace(0.0, 2.0 * math.pi, _ORBIT_FRAMES, endpoint=False):
        cosine, sine = math.cos(angle), math.sin(angle)
        plotter.camera.position = tuple(target + np.array([cosine * x - sine * y, sine * x + cosine * y, z]))
        yield render_rgb(plotter)


def _gif(images: Iterable[np.ndarray], *, frame_s: float, last_s: float) -> bytes:
    """All images in the colours of a few of them and in those of the cameras.

    With one palette for all, what does not move costs nothing; the cameras' colours would be lost in it, as their lines
    cover few pixels.
    """
    from PIL import Image

    image_rgb = list(images)
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


def _mp4(images: Iterable[np.ndarray], *, frame_s: float, last_s: float) -> bytes:
    import tempfile

    imageio = _load_imageio("an animation as MP4")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "animation.mp4"
        with imageio.get_writer(file, format="FFMPEG", fps=1.0 / frame_s, quality=7, macro_block_size=2) as writer:
            image = None
            for image in images:
                writer.append_data(image)
            for _ in range(round(last_s / frame_s)):
                writer.append_data(image)
        return file.read_bytes()


def check_suffix(path: Path, *, further: tuple[str, ...] = ()) -> None:
    """Check that an image file has a suffix of `_SUFFIXES` or a further one, and that it can be made here."""
    suffix = path.suffix.lower()
    if suffix not in (*_SUFFIXES, *further):
        expected = ", ".join(dict.fromkeys((*_SUFFIXES, *further)))
        raise InputError(f"{path}: expected a name that ends in {expected}, got {path.suffix!r}")
    if suffix == ".html":
        from warpav.view._page import load_k3d

        load_k3d()
    if suffix == ".mp4":
        _load_imageio(f"{path}: an animation as MP4")


def _load_imageio(purpose: str) -> Any:  # noqa: ANN401 (a module)
    modules = [optional_module(name, purpose=purpose, extra="movie") for name in ("imageio_ffmpeg", "imageio.v2")]
    return modules[-1]


def write_bytes(path: Path, content: bytes) -> Path:
    """Write a file in one step, whole and on the disk when this returns it; makes folders. Raises `WriteError`."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path, is_durable=True) as draft:
            draft.write_bytes(content)
    return path
