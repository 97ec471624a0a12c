"""Images of a capture: the three kinds from one position (figure 4), and all of them (figures 14 to 16)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.errors import InputError
from warpav.scene.capture.capture import EGO_INSTANCE, ENVIRONMENT_INSTANCE, Capture, CapturedImage, ViewKind
from warpav.view.figures.style import WIDTH_INCH, figure_style, new_figure, save_figure, show_image, title
from warpav.view.palette import INK_RGB, MUTED_RGB, PAPER_RGB, Rgb, camera_rgb, hex_colour

KIND_RGB: Mapping[ViewKind, Rgb] = {
    ViewKind.EGO_TOP: (240, 126, 22),
    ViewKind.TOWARDS_VEHICLE: (244, 200, 32),
    ViewKind.VEHICLE_TOP: (52, 168, 83),
    ViewKind.SCENE_TOP: (36, 107, 224),
    ViewKind.ROTATION: (122, 86, 214),
    ViewKind.EGO_SIDE: (216, 60, 94),
    ViewKind.OTHER: MUTED_RGB,
}
"""Frames of the images of a capture: orange, yellow, green, blue and purple as in the thesis's appendix."""
_KIND_TEXT = {
    ViewKind.EGO_TOP: "over the ego vehicle",
    ViewKind.TOWARDS_VEHICLE: "towards another vehicle",
    ViewKind.VEHICLE_TOP: "over another vehicle",
    ViewKind.SCENE_TOP: "over the scene",
    ViewKind.ROTATION: "all around",
    ViewKind.EGO_SIDE: "beside the ego vehicle",
    ViewKind.OTHER: "other",
}
_SKY_RGB = (214, 226, 240)
_ENVIRONMENT_RGB = (214, 218, 224)
_DEPTH_COLOURS = "viridis_r"
_DEPTH_TICKS_M = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_SHEET_COLUMNS, _LEGEND_COLUMNS = 6, 5
_NOTABLE_SHARE = 0.002  # of an image's pixels: less of a vehicle is not worth showing


def image_types(capture: Capture, path: Path | str) -> Path:
    """Figure 4: colour, depth and instances from one position, that from which the ego vehicle sees most vehicles."""
    image = _telling_image(capture)
    height, width = image.depth_m.shape
    limits_m = _depth_limits_m([image])
    gap_inch, below_inch = 0.12, 0.9
    across_inch = (WIDTH_INCH - gap_inch) / 3  # from one image to the next
    width_inch = across_inch - gap_inch
    down_inch = width_inch * height / width
    with figure_style():
        figure = new_figure(WIDTH_INCH, below_inch + down_inch + 0.32)
        figure.set_layout_engine("none")
        for column, (text, pixels) in enumerate(
            (
                ("Colour", image.rgb),
                ("Depth", depth_rgb(image.depth_m, limits_m)),
                ("Instance", instance_rgb(image.instance)),
            )
        ):
            axis = _axes(figure, gap_inch + column * across_inch, below_inch, width_inch, down_inch)
            show_image(axis, pixels)
            title(axis, text)
        _depth_bar(figure, _axes(figure, gap_inch + across_inch, below_inch - 0.2, width_inch, 0.11), limits_m)
        _instance_legend(_axes(figure, gap_inch + 2 * across_inch, below_inch - 0.2, width_inch, 0.11), image)
        x, y, z = image.view.ego_from_camera[:3, 3]
        figure.text(
            gap_inch / WIDTH_INCH,
            (below_inch - 0.09) / figure.get_size_inches()[1],
            f"{capture.name}, view {image.view.name}\ncamera at ({x:.1f}, {y:.1f}, {z:.1f}) m in the ego frame",
            ha="left",
            va="top",
            fontsize=9,
            linespacing=1.4,
            color=hex_colour(MUTED_RGB),
        )
        return save_figure(figure, path)


def contact_sheet(capture: Capture, what: str, path: Path | str) -> Path:
    """Figures 14 to 16: all images of a capture, framed by the reason for which they were taken."""
    if what not in ("rgb", "depth", "instance"):
        raise ValueError(f"expected rgb, depth or instance, got {what!r}")
    order = list(ViewKind)
    images = sorted(capture.images, key=lambda image: order.index(image.view.kind))  # in the thesis's order
    if not images:
        raise InputError(f"{capture.name}: expected images, got none")
    from matplotlib.patches import Patch

    limits_m = _depth_limits_m(images)
    columns = min(_SHEET_COLUMNS, len(images))
    rows = math.ceil(len(images) / columns)
    counts = {kind: sum(image.view.kind == kind for image in images) for kind in order}
    named = sum(count > 0 for count in counts.values())
    legend_rows = math.ceil(named / _LEGEND_COLUMNS)
    gap_inch, frame_inch, below_inch = 0.1, 0.035, 0.19 + 0.21 * legend_rows + (0.55 if what == "depth" else 0.0)
    across_inch = (WIDTH_INCH - gap_inch) / columns  # from one image to the next
    aspect = max(image.depth_m.shape[0] / image.depth_m.shape[1] for image in images)
    down_inch = (across_inch - gap_inch) * aspect + gap_inch
    height_inch = rows * down_inch + gap_inch + below_inch
    with figure_style():
        figure = new_figure(WIDTH_INCH, height_inch)
        figure.set_layout_engine("none")
        for index, image in enumerate(images):
            row, column = divmod(index, columns)
            left_inch, low_inch = gap_inch + column * across_inch, height_inch - (row + 1) * down_inch
            wide_inch = across_inch - gap_inch
            high_inch = wide_inch * image.depth_m.shape[0] / image.depth_m.shape[1]
            low_inch += 0.5 * (down_inch - gap_inch - high_inch)
            frame = _axes(
                figure,
                left_inch - frame_inch,
                low_inch - frame_inch,
                wide_inch + 2 * frame_inch,
                high_inch + 2 * frame_inch,
            )
            frame.set(facecolor=hex_colour(KIND_RGB[image.view.kind]), xticks=[], yticks=[])
            frame.spines[:].set_visible(False)
            if what == "rgb":
                pixels = image.rgb
            elif what == "depth":
                pixels = depth_rgb(image.depth_m, limits_m)
            else:
                pixels = instance_rgb(image.instance)
            axis = _axes(figure, left_inch, low_inch, wide_inch, high_inch)
            show_image(axis, pixels)
            axis.spines[:].set_visible(False)
        if what == "depth":
            _depth_bar(figure, _axes(figure, 0.2 * WIDTH_INCH, below_inch - 0.15, 0.6 * WIDTH_INCH, 0.13), limits_m)
        handles = [
            Patch(color=hex_colour(KIND_RGB[kind]), label=f"{_KIND_TEXT[kind]} ({count})")
            for kind, count in counts.items()
            if count
        ]
        columns = math.ceil(named / legend_rows)
        figure.legend(handles=handles, loc="lower center", ncols=columns, handlelength=1.2, columnspacing=1.6)
        return save_figure(figure, path)


def depth_rgb(depth_m: np.ndarray, limits_m: tuple[float, float]) -> np.ndarray:
    """Depths as colours on a logarithmic scale, near ones bright; a pale blue where nothing was hit.

    Args:
        depth_m: Depth [m], shape [row, column].

    Returns:
        uint8 [row, column, 3].
    """
    import matplotlib

    low, high = np.log(limits_m)
    is_hit = np.isfinite(depth_m)
    share = (np.log(np.where(is_hit, np.maximum(depth_m, 1e-6), 1.0)) - low) / (high - low)
    rgb = matplotlib.colormaps[_DEPTH_COLOURS](np.clip(share, 0.0, 1.0))[..., :3]
    return np.where(is_hit[..., None], np.rint(255.0 * rgb), _SKY_RGB).astype(np.uint8)


def instance_rgb(instance: np.ndarray) -> np.ndarray:
    """Instances as colours: one for each vehicle, the ego vehicle dark, the rest pale; uint8 [row, column, 3]."""
    ids, index = np.unique(instance, return_inverse=True)
    colour = np.array([_instance_colour(int(instance_id)) for instance_id in ids], np.uint8)
    return colour[index.reshape(instance.shape)]


def _instance_colour(instance_id: int) -> Rgb:
    if instance_id == ENVIRONMENT_INSTANCE:
        return _ENVIRONMENT_RGB
    if instance_id == EGO_INSTANCE:
        return INK_RGB
    shade, towards = [(0.0, PAPER_RGB), (0.45, PAPER_RGB), (0.4, INK_RGB)][(instance_id - 1) // 8 % 3]
    mixed = (1.0 - shade) * np.array(camera_rgb(instance_id - 1)) + shade * np.array(towards)
    red, green, blue = np.rint(mixed).astype(int).tolist()
    return red, green, blue


def _telling_image(capture: Capture) -> CapturedImage:
    """Of the images from the ego vehicle, or else of all, the one with most vehicles, then with most of them."""

    def value(image: CapturedImage) -> tuple[bool, int, int]:
        ids, count = np.unique(image.instance, return_counts=True)
        count = count[(ids != ENVIRONMENT_INSTANCE) & (ids != EGO_INSTANCE)]
        is_level = image.view.kind in (ViewKind.TOWARDS_VEHICLE, ViewKind.ROTATION)
        return is_level, int((count >= _NOTABLE_SHARE * image.instance.size).sum()), int(count.sum())

    if not len(capture.images):
        raise InputError(f"{capture.name}: expected images, got none")
    return max(capture.images, key=value)


def _depth_limits_m(images: Sequence[CapturedImage]) -> tuple[float, float]:
    """Where the scale of depths begins and ends: all but the nearest fiftieth."""
    hit = np.concatenate([image.depth_m[np.isfinite(image.depth_m) & (image.depth_m > 0.0)] for image in images])
    if not hit.size:
        return 1.0, 10.0
    near, far = float(np.quantile(hit, 0.02)), float(hit.max())
    return near, max(far, 1.01 * near)


def _axes(figure: Any, left_inch: float, low_inch: float, width_inch: float, height_inch: float) -> Any:  # noqa: ANN401
    """Axes at a position in the figure that is not left to the layout."""
    width, height = figure.get_size_inches()
    return figure.add_axes((left_inch / width, low_inch / height, width_inch / width, height_inch / height))


def _depth_bar(figure: Any, axis: Any, limits_m: tuple[float, float]) -> None:  # noqa: ANN401 (matplotlib)
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    bar = figure.colorbar(ScalarMappable(LogNorm(*limits_m), _DEPTH_COLOURS), cax=axis, orientation="horizontal")
    ticks = [tick for tick in _DEPTH_TICKS_M if limits_m[0] <= tick <= limits_m[1]]
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.ax.minorticks_off()
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=9)
    bar.set_label("depth [m]; sky pale blue", fontsize=9)


def _instance_legend(axis: Any, image: CapturedImage) -> None:  # noqa: ANN401 (matplotlib)
    """A legend of the colours: those of vehicles as one swatch in stripes."""
    from matplotlib.legend_handler import HandlerTuple
    from matplotlib.patches import Patch

    axis.set_axis_off()
    ids = [int(instance_id) for instance_id in np.unique(image.instance)]
    vehicles = [instance_id for instance_id in ids if instance_id not in (ENVIRONMENT_INSTANCE, EGO_INSTANCE)]
    entries: dict[str, Any] = {}
    if EGO_INSTANCE in ids:
        entries["ego vehicle"] = Patch(color=hex_colour(INK_RGB))
    if vehicles:
        name = "1 vehicle" if len(vehicles) == 1 else f"{len(vehicles)} vehicles"
        entries[name] = tuple(Patch(color=hex_colour(_instance_colour(one))) for one in vehicles[:4])
    entries["environment"] = Patch(color=hex_colour(_ENVIRONMENT_RGB))
    axis.legend(
        list(entries.values()), list(entries), loc="upper left", bbox_to_anchor=(0.0, 1.6), ncols=2,
        handler_map={tuple: HandlerTuple(ndivide=None, pad=0.0)}, handlelength=1.8, columnspacing=1.6, borderpad=0.0,
    )  # fmt: skip
