"""The front door to images: `plot` shows an object of warpav in a window or a notebook, or writes it to a file.

What is drawn of an object is registered with `draws` by class and kind; packages above this one register their own.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, TypeVar

from warpav.core.errors import ArgumentError, InputError, one_line
from warpav.raster.mesh import Mesh
from warpav.rig import MountSurface, Rig
from warpav.scene import Scene
from warpav.view._opengl import display_text, has_display, load_pyvista
from warpav.view._output import Animation, Canvas, check_suffix, save_animation, save_image
from warpav.view._picture import Picture, rig_plotter, vehicle_plotter
from warpav.view.figures._style import FIGURE_SUFFIXES, checked_figure, figure_bytes, save_figure

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from warpav.core.progress import Progress

    Drawing = Any
    Plotter = Any


@dataclass(frozen=True)
class Kind:
    """One way of drawing the objects of a class."""

    draw: Callable[..., Drawing]
    is_figure: bool
    options: tuple[str, ...]


_KINDS: dict[type, dict[str, Kind]] = {}
"""By class and name; the first kind of a class is drawn where none is asked for."""

_Function = TypeVar("_Function", bound="Callable[..., Any]")


def draws(
    cls: type, kind: str, *, is_figure: bool = False, options: Sequence[str] | None = None
) -> Callable[[_Function], _Function]:
    """Registers a function as what draws a kind of a class, and of the classes below it.

    Options are what `plot` hands on by keyword; None: all that the function takes by keyword alone.
    """

    def register(draw: _Function) -> _Function:
        by_keyword = inspect.Parameter.KEYWORD_ONLY
        takes = (name for name, one in inspect.signature(draw).parameters.items() if one.kind is by_keyword)
        _KINDS.setdefault(cls, {})[kind] = Kind(draw, is_figure, tuple(takes if options is None else options))
        return draw

    return register


def kinds_of(cls: type) -> dict[str, Kind]:
    """The kinds of a class by name, the usual one first; none where nothing is registered for it."""
    found: dict[str, Kind] = {}
    abstract = [each for each in _KINDS if each not in cls.__mro__ and issubclass(cls, each)]
    for each in (*cls.__mro__, *abstract):
        for name, kind in _KINDS.get(each, {}).items():
            found.setdefault(name, kind)
    return found


def _checked_kind(cls: type, kind: str | None) -> Kind:
    kinds = kinds_of(cls)
    if not kinds:
        known = sorted(each.__name__ for each in _KINDS)
        hint = "; read it first: wa.read_rig, wa.read_run, wa.read_scenes or wa.read_vehicle"
        is_file = issubclass(cls, (str, PurePath))
        raise TypeError(f"plot: expected one of {', '.join(known)}, got {cls.__name__}{hint if is_file else ''}")
    name = next(iter(kinds)) if kind is None else kind
    if name not in kinds:
        raise ArgumentError("kind", f"expected one of a {cls.__name__} ({', '.join(kinds)}), got {kind!r}")
    return kinds[name]


def drawing_of(obj: object, canvas: Canvas, *, kind: str | None = None, **options: Any) -> Drawing:  # noqa: ANN401
    """What `plot` shows or saves of an object, to be added to or saved in other ways."""
    return _checked_kind(type(obj), kind).draw(obj, canvas, **options)


def plot(
    obj: object,
    *,
    kind: str | None = None,
    out: str | Path | None = None,
    title: str | None = None,
    window_size: tuple[int, int] | None = None,
    zoom: float | None = None,
    off_screen: bool | None = None,
    progress: Progress | None = None,
    **options: Any,  # noqa: ANN401 (by class, see below)
) -> Any:  # noqa: ANN401
    """Show an object in a window or a notebook, or write its image to a file.

    Kinds of a rig, of which the first is the usual one. All but it are figures, which may also be ``.pdf`` and
    ``.svg``; the modules of `warpav.view.figures` say how each is computed. Those marked with + also take several rigs
    by name, such as ``{"start": start, "optimised": result.rig}``.

    - ``view``: in space, on the vehicle and in traffic; its options are below.
    - ``sheet``: a page to print, to scale: from above, from the side, a table. ``range_m``: radii of the rings [m],
      ``vehicle``: its name.
    - ``plan`` +: to scale from above, how far a car is 40, 20 and 12 px high in each image.
    - ``ground`` +: to scale from above, the ground near the vehicle that is in no image or that the own body hides.
      ``misses_per_100`` of the rigs by name stand below, of a run those of its test scenes.
    - ``range`` +: by azimuth, up to which distance road users of each class are detected. ``probability`` gives the
      model for a camera; by default that of the detector that ships with warpav.
    - ``near_field`` +: how far from the body the first visible point is at three heights, with dimensions.
    - ``redundancy`` +: how many cameras see a road user by sector and distance, and without the camera whose loss
      leaves most ground to no camera, whatever traffic is there.
    - ``resolution`` +: pixels per degree along the horizon, and over azimuth and elevation.
    - ``points``: one scan of each LiDAR in ``scene``, from above and over azimuth and elevation.
    - ``contact``: the images of all cameras in ``scene``, with their angles and the share of the own body.

    Options of the view of a rig:

    - ``ego``: the `Mesh` that carries the cameras; by default that of the scene, else the axes of the ego frame.
    - ``scene``: the `Scene` around it; by default an empty ground.
    - ``mount_surface``: a `MountSurface`, drawn on the vehicle in colours of height, or of its zones.
    - ``trajectory_m``: camera positions over the iterations of an optimisation [m], shape [iteration, camera, 3].
    - ``outcomes``: for every vehicle of the scene an `ObjectOutcome`, which gives its colour.
    - ``coverage``: a `Coverage`, which paints the ground by how many cameras see somebody there.
    - ``visibility``: True paints what every camera sees of the scene, and the sides of its view.
    - ``further``: `FurtherCameras`, such as ``result.further_cameras``: arrows where one more camera would help; with
      ``mount_surface`` the body is painted instead, by what one more camera would bring there.
    - ``requirements``: what `warpav.check_requirements` gives, which lays the points on the ground: discs where
      they are met, crosses where not, in the colour of how many cameras see enough there.

    ``ego`` and ``scene`` go with every kind of a rig.

    Of a scene: ``rig``, ``outcomes``, ``coverage``, ``visibility``. Of a mesh, which is a vehicle in the ego frame:
    ``mount_surface`` (where it can carry cameras), ``axle_m`` (x of its axles [m]). Of a mount surface: ``vehicle``
    (the mesh below it). Of a run folder or the result of an optimisation:

    - ``iteration``: instead of the result, the rig before the step of this one; negative ones count from the end.
    - ``scene``: traffic and street; by default the first test scene.
    - ``arrows``: False leaves out the arrows for where the descent moves and turns the cameras.
    - ``visibility``: as of a rig; not in animations.

    Kinds of a run folder, besides this ``view`` and those of a rig, which show start and result side by side:
    ``top_view``, how the cameras moved; ``search``, best rig and bound over the renders, or the losses of a descent;
    ``further`` and ``gain``, what one more camera would bring, from above and painted on the body. All of them take
    ``scene``. A result has those of a rig.

    What errors of mounting cost (`warpav.mount_tolerance`) is a heat map of cameras by degrees of freedom,
    with ``outages`` (of ``evaluation.camera_outage``) beside a bar for the loss of each camera; they alone are the
    bars.
    An evaluation of rigs is a figure of what they detect at equal false alarms by distance, sector and class;
    ``differences``, how many fewer the first misses than others. They and sheets may also be ``.pdf`` and ``.svg``.

    Args:
        obj: What to show.
        kind: What is drawn of it, see above; None: the usual kind of its class.
        out: ``.png``; ``.html``, an interactive page; ``.gif`` or ``.mp4``, a turn around the vehicle or, of a run, its
            iterations. None: a widget in a notebook, else a window.
        title: A line in the upper left corner.
        window_size: Width and height [px]; by default 1280 x 800, of a vehicle 1280 x 720, of an animation 800 x 500.
        zoom: 1 fills the image with the vehicle, less shows more around it; by default 1, and 0.62 where outcomes,
            coverage or visibility are painted, 1.9 where further cameras are shown.
        off_screen: Whether to draw without a window; by default if there is no display.
        progress: Shows how many images of an animation are done.
        **options: Those of the object's class, and those of ``pyvista.Plotter.show``, such as ``jupyter_backend``; with
            ``out`` only ``cpos`` of them.

    Returns:
        The file that was written, else what ``pyvista.Plotter.show`` returns.

    Raises:
        InputError: The class has no such kind, the file cannot be written, or nothing can be drawn or shown here.
        TypeError: Objects of this class cannot be plotted, or have no such option.
    """
    title = None if title is None else one_line(title)
    chosen = _checked_kind(type(obj), kind)
    canvas = Canvas(None if out is None else Path(out), title, window_size, zoom, off_screen)
    if canvas.out is not None:
        if chosen.is_figure:
            checked_figure(canvas.out)
        else:
            check_suffix(canvas.out, further=FIGURE_SUFFIXES)
        canvas = replace(canvas, off_screen=True)
    own, of_show = _split(options, chosen, obj, is_file=out is not None)
    drawing = chosen.draw(obj, canvas, **own)
    if isinstance(drawing, Animation):
        assert canvas.out is not None, "animations are drawn where the canvas asks for one"
        return save_animation(drawing, canvas.out, progress=progress)
    if chosen.is_figure or not isinstance(drawing, load_pyvista().BasePlotter):
        return _deliver_figure(drawing, canvas)
    if canvas.out is None:
        return _show(drawing, of_show, off_screen=off_screen)
    try:
        if "cpos" in of_show:
            drawing.camera_position = of_show["cpos"]
        return save_image(drawing, canvas.out, progress=progress)
    finally:
        drawing.close()


def _split(
    options: Mapping[str, Any], kind: Kind, obj: object, *, is_file: bool
) -> tuple[dict[str, Any], dict[str, Any]]:
    takes = kind.options
    own = {name: value for name, value in options.items() if name in takes}
    of_show = {name: value for name, value in options.items() if name not in takes}
    known = (
        {"cpos"}
        if is_file or kind.is_figure or not of_show
        else {*inspect.signature(load_pyvista().Plotter.show).parameters, "jupyter_kwargs"}
    )
    unknown = sorted(set(of_show) - known)
    if unknown:
        named = list(inspect.signature(plot).parameters)[1:-1]
        near = difflib.get_close_matches(unknown[0], [*named, *takes, *known], 1, 0.6)
        raise TypeError(
            f"plot: {unknown[0]}: expected an option of a {type(obj).__name__} ({', '.join(takes)}) or of "
            f"{'an image file (cpos)' if is_file else 'pyvista.Plotter.show'}"
            + (f"; did you mean {near[0]}?" if near else "")
        )
    return own, of_show


def _show(plotter: Plotter, options: Mapping[str, Any], *, off_screen: bool | None) -> Any:  # noqa: ANN401
    is_asked = off_screen or any(options.get(name) for name in ("screenshot", "return_img"))
    if not (is_asked or plotter.notebook or has_display() or load_pyvista().OFF_SCREEN):
        plotter.close()
        raise _no_display()
    return plotter.show(**options)


def _deliver_figure(figure: Any, canvas: Canvas) -> Any:  # noqa: ANN401 (matplotlib)
    import io

    from PIL import Image

    if canvas.out is not None:
        return save_figure(figure, checked_figure(canvas.out))
    image = Image.open(io.BytesIO(figure_bytes(figure, ".png")))
    if canvas.off_screen or "ipykernel" in sys.modules:
        return image
    if not has_display():
        raise _no_display()
    image.show()
    return None


def _no_display() -> InputError:
    return InputError(
        f"plot: expected a display to show it on, got none ({display_text()}); "
        'write a file instead, such as plot(..., out="image.png")'
    )


# ------------------------------------------------------------------------------------------- classes of lower packages


@draws(Rig, "view", options=[each.name for each in fields(Picture) if each.name != "rig"])
def _draw_rig(rig: Rig, canvas: Canvas, **parts: Any) -> Plotter:  # noqa: ANN401 (of `Picture`)
    return rig_plotter(Picture(rig=rig, **parts), canvas)


@draws(Scene, "view", options=("rig", "outcomes", "coverage", "visibility"))
def _draw_scene(scene: Scene, canvas: Canvas, **parts: Any) -> Plotter:  # noqa: ANN401 (of `Picture`)
    return rig_plotter(Picture(scene=scene, **parts), canvas)


@draws(Mesh, "view")
def _draw_vehicle(
    vehicle: Mesh, canvas: Canvas, *, mount_surface: MountSurface | None = None, axle_m: Sequence[float] = ()
) -> Plotter:
    return vehicle_plotter(vehicle, canvas, surface=mount_surface, axle_m=axle_m)


@draws(MountSurface, "view")
def _draw_mount_surface(surface: MountSurface, canvas: Canvas, *, vehicle: Mesh | None = None) -> Plotter:
    return vehicle_plotter(vehicle, canvas, surface=surface)


@draws(Rig, "sheet", is_figure=True)
def _draw_sheet(
    rig: Rig,
    canvas: Canvas,
    *,
    ego: Mesh | None = None,
    scene: Scene | None = None,
    range_m: Sequence[float] | None = None,
    vehicle: str | None = None,
) -> Drawing:
    from warpav.view.figures._rig_sheet import rig_sheet

    carrier = Picture(ego=ego, scene=scene).vehicle
    return rig_sheet(rig, ego=carrier, range_m=range_m, title=canvas.title, vehicle=vehicle)


def _figure_of_rigs(module: str, kind: str, *further: str) -> None:
    """Registers ``<kind>_figure`` of a module of figures as what draws a kind of rigs on their vehicle."""

    def draw(rig: Any, canvas: Canvas, *, ego: Mesh | None = None, scene: Scene | None = None, **parts: Any) -> Drawing:  # noqa: ANN401
        figure = getattr(importlib.import_module(f"warpav.view.figures._{module}"), f"{kind}_figure")
        rigs = _by_name(rig) if kind == "ground" else _with_widths(_by_name(rig))
        rigs = rigs if kind in _GEOMETRIC else {name: _cameras_of(each, kind) for name, each in rigs.items()}
        vehicle = () if kind == "resolution" else (_vehicle(ego, scene, kind),)  # there the body is left out of account
        return figure(rigs, *vehicle, **parts, heading=canvas.title)

    for cls in (Rig, Mapping):
        draws(cls, kind, is_figure=True, options=("ego", "scene", *further))(draw)


_GEOMETRIC = ("ground", "near_field")
"""Kinds that ask what is in view, whether of a camera or of a LiDAR; all others count pixels of images."""


def _cameras_of(rig: Rig, kind: str) -> Rig:
    cameras = [each for each in rig.cameras if each.model.beams is None]
    if not cameras:
        raise ArgumentError("rig", f"expected a rig with a camera for kind={kind!r}, got LiDARs alone; ask for points")
    return Rig(cameras) if len(cameras) < len(rig.cameras) else rig


_figure_of_rigs("plan", "plan")
_figure_of_rigs("plan", "ground", "misses_per_100")
_figure_of_rigs("around", "range", "probability")
_figure_of_rigs("around", "near_field")
_figure_of_rigs("around", "redundancy")
_figure_of_rigs("plan", "resolution")


@draws(Rig, "contact", is_figure=True)
def _draw_contact(rig: Rig, canvas: Canvas, *, ego: Mesh | None = None, scene: Scene | None = None) -> Drawing:
    from warpav.view.figures._images import contact_figure

    if scene is None:
        raise ArgumentError("scene", "expected the scene for kind='contact', got none; give scene=wa.town([0])[0]")
    return contact_figure(rig, scene if ego is None else scene.around(ego), heading=canvas.title)


@draws(Rig, "points", is_figure=True)
def _draw_points(rig: Rig, canvas: Canvas, *, ego: Mesh | None = None, scene: Scene | None = None) -> Drawing:
    from warpav.view.figures._points import points_figure

    if scene is None:
        raise ArgumentError("scene", "expected the scene for kind='points', got none; give scene=wa.town([0])[0]")
    return points_figure(rig=rig, scene=scene if ego is None else scene.around(ego), heading=canvas.title)


def _by_name(rig: Rig | Mapping[str, Rig]) -> dict[str, Rig]:
    if isinstance(rig, Rig):
        return {"rig": rig}
    if not rig:
        raise ArgumentError("rigs", "expected at least one rig by name, got none")
    for name, each in rig.items():
        if not isinstance(each, Rig):
            raise TypeError(f"plot: expected rigs by name, got {type(each).__name__} as {name!r}")
    return dict(rig)


def _with_widths(rigs: Mapping[str, Rig]) -> dict[str, Rig]:
    """Rigs by name, with the width of their images where these differ: what is seen far away depends on it."""
    widths = {name: sorted({camera.model.width_px for camera in rig.cameras}) for name, rig in rigs.items()}
    if len(rigs) == 1 or len({tuple(each) for each in widths.values()}) == 1:
        return dict(rigs)
    said = {name: " to ".join(str(each) for each in dict.fromkeys((low[0], low[-1]))) for name, low in widths.items()}
    return {f"{name}, {said[name]} px wide": rig for name, rig in rigs.items()}


def _vehicle(ego: Mesh | None, scene: Scene | None, kind: str) -> Mesh:
    vehicle = Picture(ego=ego, scene=scene).vehicle
    if vehicle is None:
        hint = "give ego=wa.read_vehicle(...) or scene=..."
        raise ArgumentError("ego", f"expected the vehicle for kind={kind!r}, got none; {hint}")
    return vehicle
