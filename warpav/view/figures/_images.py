"""Images of cameras: sheets of all cameras, images with detections, the types of images of a capture."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import InputError
from warpav.detection import render
from warpav.scene import EGO, EGO_INSTANCE, ENVIRONMENT_INSTANCE, Capture, CapturedImage, DeviceScene, ViewKind
from warpav.sight import body_shares
from warpav.view._palette import (
    CAMERA_RGB,
    FALSE_POSITIVE_RGB,
    INK_RGB,
    MISS_RGB,
    MUTED_RGB,
    PAPER_RGB,
    TRUE_POSITIVE_RGB,
    TRUTH_RGB,
    Rgb,
    camera_rgb,
    hex_colour,
)
from warpav.view.figures._style import WIDTH_INCH, caption, empty_panel, figure_style, new_figure, save_figure, title

if TYPE_CHECKING:
    from warpav.optimisation import CameraObservation
    from warpav.rig import Rig
    from warpav.scene import Scene

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
_OWN_BODY_RGB, _TINT = (138, 84, 214), 0.4  # of the own body, and its share: roads and paints are often one grey
_NOTABLE_SHARE = 0.002  # of an image's pixels: less of a vehicle is not worth showing


def image_types(capture: Capture, path: Path | str) -> Path:
    """Figure 4: colour, depth and instances from one position, that from which the ego vehicle sees most vehicles."""
    image = _telling_image(capture)
    height, width = image.depth_m.shape
    limits_m = _depth_limits_m([image])
    with figure_style():
        figure = new_figure(WIDTH_INCH, 0.9 + WIDTH_INCH / 3 * height / width)
        axes = figure.subplots(1, 3)
        for axis, text in zip(axes, ("Colour", "Depth", "Instance"), strict=True):
            _show(axis, _pixels(image, text.lower(), limits_m))
            title(axis, text)
        x, y, z = image.view.ego_from_camera[:3, 3]
        text = f"{capture.name}, view {image.view.name}\ncamera at ({x:.1f}, {y:.1f}, {z:.1f}) m in the ego frame"
        axes[0].set_xlabel(text, loc="left", fontsize=9, color=hex_colour(MUTED_RGB))
        _depth_bar(figure, axes[1], limits_m)
        _instance_legend(axes[2], image)
        return save_figure(figure, path)


def _show(axis: Any, rgb: np.ndarray) -> None:  # noqa: ANN401 (matplotlib)
    axis.imshow(rgb, interpolation="antialiased")
    axis.set_anchor("N")
    empty_panel(axis)


def _pixels(image: CapturedImage, what: str, limits_m: tuple[float, float]) -> np.ndarray:
    if what == "depth":
        return depth_rgb(image.depth_m, limits_m)
    return instance_rgb(image.instance) if what == "instance" else image.rgb


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
    counts = {kind: count for kind, count in counts.items() if count}
    legend_rows = math.ceil(len(counts) / _LEGEND_COLUMNS)
    below_inch = 0.2 + 0.21 * legend_rows + (0.6 if what == "depth" else 0.0)
    aspect = max(image.depth_m.shape[0] / image.depth_m.shape[1] for image in images)
    with figure_style():
        figure = new_figure(WIDTH_INCH, rows * WIDTH_INCH / columns * aspect + below_inch)
        axes = figure.subplots(rows, columns, squeeze=False)
        for axis in axes.flat[len(images) :]:
            axis.set_axis_off()
        for axis, image in zip(axes.flat, images, strict=False):
            _show(axis, _pixels(image, what, limits_m))
            axis.spines[:].set(color=hex_colour(KIND_RGB[image.view.kind]), linewidth=3.0)
        if what == "depth":
            _depth_bar(figure, axes, limits_m, shrink=0.6, aspect=40)
        named = ((hex_colour(KIND_RGB[kind]), f"{_KIND_TEXT[kind]} ({count})") for kind, count in counts.items())
        handles = [Patch(color=colour, label=text) for colour, text in named]
        style = {"ncols": math.ceil(len(counts) / legend_rows), "handlelength": 1.2, "columnspacing": 1.6}
        figure.legend(handles=handles, loc="outside lower center", **style)
        return save_figure(figure, path)


def depth_rgb(depth_m: np.ndarray, limits_m: tuple[float, float]) -> np.ndarray:
    """Depths [m] as colours on a logarithmic scale, near ones bright, uint8; a pale blue where nothing was hit."""
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
    shade, towards = [(0.0, PAPER_RGB), (0.45, PAPER_RGB), (0.4, INK_RGB)][(instance_id - 1) // len(CAMERA_RGB) % 3]
    mixed = (1.0 - shade) * np.array(camera_rgb(instance_id - 1)) + shade * np.array(towards)
    red, green, blue = np.rint(mixed).astype(int).tolist()
    return red, green, blue


def _telling_image(capture: Capture) -> CapturedImage:
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


def _depth_bar(figure: Any, axes: Any, limits_m: tuple[float, float], **style: Any) -> None:  # noqa: ANN401 (matplotlib)
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    style = {"orientation": "horizontal", "pad": 0.02, "panchor": False, "anchor": (0.5, 1.0)} | style
    bar = figure.colorbar(ScalarMappable(LogNorm(*limits_m), _DEPTH_COLOURS), ax=axes, **style)
    ticks = [tick for tick in _DEPTH_TICKS_M if limits_m[0] <= tick <= limits_m[1]]
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.ax.minorticks_off()
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=9)
    bar.set_label("depth [m]; sky pale blue", fontsize=9)


def _instance_legend(axis: Any, image: CapturedImage) -> None:  # noqa: ANN401 (matplotlib)
    from matplotlib.legend_handler import HandlerTuple
    from matplotlib.patches import Patch

    ids = [int(instance_id) for instance_id in np.unique(image.instance)]
    vehicles = [instance_id for instance_id in ids if instance_id not in (ENVIRONMENT_INSTANCE, EGO_INSTANCE)]
    entries: dict[str, Any] = {}
    if EGO_INSTANCE in ids:
        entries["ego vehicle"] = Patch(color=hex_colour(INK_RGB))
    if vehicles:
        name = "1 vehicle" if len(vehicles) == 1 else f"{len(vehicles)} vehicles"
        entries[name] = tuple(Patch(color=hex_colour(_instance_colour(one))) for one in vehicles[:4])
    entries["environment"] = Patch(color=hex_colour(_ENVIRONMENT_RGB))
    style = {"loc": "upper left", "bbox_to_anchor": (0.0, -0.02), "ncols": 2, "borderpad": 0.0, "borderaxespad": 0.0}
    stripes = {tuple: HandlerTuple(ndivide=None, pad=0.0)}
    axis.legend(list(entries.values()), list(entries), handler_map=stripes, handlelength=1.8, **style)


def own_body_tinted(image_rgb: np.ndarray, object_index: np.ndarray) -> np.ndarray:
    """An image of a camera with the own body tinted, uint8 [row, column, 3]; ``object_index`` as `CameraImage` has."""
    tinted = np.rint((1.0 - _TINT) * image_rgb + _TINT * np.array(_OWN_BODY_RGB)).astype(np.uint8)
    return np.where((object_index == EGO)[..., None], tinted, image_rgb)


def contact_figure(rig: Rig, scene: Scene, *, heading: str | None = None) -> Any:  # noqa: ANN401
    """The images of all cameras, from the left to the right of the vehicle and then behind it, in equal widths.

    Below each stand its yaw, pitch and horizontal field of view [degrees], its size [px] and the share of its pixels
    that show the own vehicle, which is rendered alone for that.
    """
    images = render(rig, scene, supersampling=2)
    share = body_shares(rig, DeviceScene.pack(scene))
    ahead = np.array([camera.ego_from_camera[:2, 2] for camera in rig.cameras])
    # from the left rear to the right
    order = np.argsort(
        (0.75 * math.pi - np.arctan2(ahead[:, 1], ahead[:, 0])) % (2.0 * math.pi), kind="stable"
    ).tolist()
    columns = min(3, len(order)) if len(order) != 4 else 2
    rows = -(-len(order) // columns)
    with figure_style():
        width_inch = WIDTH_INCH / columns
        shape = [rig.cameras[k].model.height_px / rig.cameras[k].model.width_px for k in order]
        row_inch = [0.94 * width_inch * max(shape[k : k + columns]) + 0.8 for k in range(0, len(order), columns)]
        figure = new_figure(WIDTH_INCH, sum(row_inch) + 0.6)
        axes = figure.subplots(rows, columns, squeeze=False, height_ratios=row_inch)
        for axis in axes.flat[len(order) :]:
            axis.set_axis_off()
        for axis, index in zip(axes.flat, order, strict=False):
            camera = rig.cameras[index]
            _show(axis, own_body_tinted(images[camera.name].rgb, images[camera.name].object_index))
            axis.spines[:].set(color=hex_colour(camera_rgb(index)), linewidth=2.0)
            axis.set_title(camera.name, fontsize=10, color=hex_colour(camera_rgb(index)))
            model = camera.model
            yaw_deg, pitch_deg, fov_deg = np.degrees([camera.yaw_rad, camera.pitch_rad, model.fov_rad]).tolist()
            yaw_deg, pitch_deg = math.remainder(yaw_deg, 360.0) + 0.0, pitch_deg + 0.0
            angles = f"yaw {yaw_deg:.0f}°, pitch {pitch_deg:.0f}°, fov {fov_deg:.0f}°"
            own = f"own body {100.0 * share[camera.name]:.1f} % of the image"
            said = f"{angles}\n{model.width_px} x {model.height_px} px, {own}"
            axis.set_xlabel(said, fontsize=8, color=hex_colour(INK_RGB))
        text = f"Scene {scene.name}. Yaw: 0 ahead, positive to the left. Pitch: positive nose down. Own body: violet."
        caption(figure, text, heading)
        return figure


def detections_sheet(rows: Mapping[str, Mapping[str, CameraObservation]], path: Path | str) -> Path:
    """Draw camera images in a grid with what was there, what was found and what was not.

    Ground truth is thin white, true positives green, false positives red, misses dashed orange.
    """
    column_count = max(map(len, rows.values()))
    height, width, _ = next(each for panels in rows.values() for each in panels.values()).image_rgb.shape
    edge_inch = min((WIDTH_INCH - 0.3) / column_count, 4.0)
    row_inch = edge_inch * height / width + 0.6
    with figure_style():
        figure = new_figure(edge_inch * column_count + 0.3, row_inch * len(rows) + (0.4 if column_count > 1 else 0.6))
        grid = figure.subplots(len(rows), column_count, squeeze=False)
        for (heading, panels), axes in zip(rows.items(), grid, strict=True):
            for axis in axes:
                axis.set(xticks=[], yticks=[], frame_on=False)
            for axis, (text, observed) in zip(axes, panels.items(), strict=False):
                draw_detections(axis, text, observed)
            axes[0].set_ylabel(heading, fontweight="bold", fontsize=11)
        figure.legend(handles=detection_handles(), loc="outside lower center", ncols=min(4, 2 * column_count))
        return save_figure(figure, path)


def detection_handles() -> list[Any]:
    """Handles of a legend for the colours of `draw_detections`."""
    from matplotlib.lines import Line2D

    return [
        Line2D([], [], color=hex_colour(TRUE_POSITIVE_RGB), linewidth=2.2, label="detected"),
        Line2D([], [], color=hex_colour(MISS_RGB), linewidth=2.2, linestyle=(0, (3, 2)), label="missed"),
        Line2D([], [], color=hex_colour(FALSE_POSITIVE_RGB), linewidth=2.2, label="false alarm"),
        Line2D([], [], color=hex_colour(MUTED_RGB), linewidth=1.0, label="ground truth (white)"),
    ]


def draw_detections(axis: Any, text: str, seen: CameraObservation) -> None:  # noqa: ANN401 (matplotlib)
    """Draw an image with its boxes, in the colours of `detections_sheet`, under a title."""
    height, width = seen.image_rgb.shape[:2]
    axis.imshow(seen.image_rgb, extent=(0, width, height, 0), interpolation="antialiased")
    match, truth, detection = seen.match, seen.truth_box_px, seen.detections.box_px
    present = np.isfinite(truth).all(axis=1)
    found_index = set(match[present & (match >= 0)].tolist())
    for index, box in enumerate(detection):
        is_found = index in found_index
        colour = TRUE_POSITIVE_RGB if is_found else FALSE_POSITIVE_RGB
        # many false alarms must not cover what was found, nor that what was not
        _draw_box(axis, box, colour, linewidth=1.6 if is_found else 1.2, zorder=4 if is_found else 2)
    for box, found in zip(truth[present], match[present] >= 0, strict=True):
        if found:
            _draw_box(axis, box, TRUTH_RGB, linewidth=0.9, zorder=3)
        else:
            _draw_box(axis, box, MISS_RGB, linewidth=1.6, linestyle=(0, (3, 2)), zorder=5)
    axis.set(xlim=(0, width), ylim=(height, 0))
    false = len(detection) - len(found_index)
    counts = f"{len(found_index)} of {int(present.sum())} detected\n{false} false alarm{'' if false == 1 else 's'}"
    axis.set_title(f"{text}\n{counts}", fontsize=8.5, fontweight="normal", pad=4)


def _draw_box(axis: Any, box_px: np.ndarray, colour: tuple[int, int, int], **line: Any) -> None:  # noqa: ANN401
    from matplotlib.patches import Rectangle

    x0, y0, x1, y1 = box_px
    axis.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=hex_colour(colour), **line))
