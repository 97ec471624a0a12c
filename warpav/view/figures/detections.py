"""Camera images with what is there, what a detector found and what it missed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.errors import InputError
from warpav.view.figures.style import WIDTH_INCH, figure_style, new_figure, save_figure
from warpav.view.palette import FALSE_POSITIVE_RGB, MISS_RGB, MUTED_RGB, TRUE_POSITIVE_RGB, TRUTH_RGB, hex_colour

LONG_TITLE = 14
"""Titles of more letters stand in a line of their own."""


@dataclass(frozen=True)
class DetectionPanel:
    """One camera image with what is there and what was found.

    Attributes:
        image_rgb: The image, uint8, shape [row, column, 3].
        truth_box_px: Ground-truth boxes (x0, y0, x1, y1) [px], shape [vehicle, 4]; NaN where a vehicle has none.
        detection_box_px: Detected boxes [px], shape [detection, 4].
        detection_of_truth: Index of the detection that found each vehicle, -1 for none, shape [vehicle].
    """

    title: str
    image_rgb: np.ndarray
    truth_box_px: np.ndarray
    detection_box_px: np.ndarray
    detection_of_truth: np.ndarray


def detections_sheet(rows: Mapping[str, Sequence[DetectionPanel]], path: Path | str) -> Path:
    """Draw camera images in a grid with what was there, what was found and what was not.

    Ground truth is thin white, true positives green, false positives red, misses dashed orange.
    """
    column_count = max((len(panels) for panels in rows.values()), default=0)
    if column_count == 0:
        raise InputError(f"{path}: there is no image to draw")
    sample = next(panels[0].image_rgb for panels in rows.values() if panels)
    edge_inch = min((WIDTH_INCH - 0.3) / column_count, 4.0)
    is_long = any(len(panel.title) > LONG_TITLE for panels in rows.values() for panel in panels)
    row_inch = edge_inch * sample.shape[0] / sample.shape[1] + (0.5 if is_long else 0.3)
    with figure_style():
        figure = new_figure(edge_inch * column_count + 0.3, row_inch * len(rows) + 0.4)
        grid = figure.subplots(len(rows), column_count, squeeze=False)
        for (heading, panels), axes in zip(rows.items(), grid, strict=True):
            for column, axis in enumerate(axes):
                axis.set(xticks=[], yticks=[], frame_on=False)
                if column < len(panels):
                    draw_detections(axis, panels[column])
            axes[0].set_ylabel(heading, fontweight="bold", fontsize=11)
        figure.legend(handles=detection_handles(), loc="outside lower center", ncols=4)
        return save_figure(figure, path)


def detection_handles() -> list[Any]:
    """Handles of a legend for the colours of `draw_detections`."""
    from matplotlib.lines import Line2D

    return [
        Line2D([], [], color=hex_colour(TRUE_POSITIVE_RGB), linewidth=2.2, label="found"),
        Line2D([], [], color=hex_colour(MISS_RGB), linewidth=2.2, linestyle=(0, (3, 2)), label="missed"),
        Line2D([], [], color=hex_colour(FALSE_POSITIVE_RGB), linewidth=2.2, label="false alarm"),
        Line2D([], [], color=hex_colour(MUTED_RGB), linewidth=1.0, label="ground truth (white)"),
    ]


def draw_detections(axis: Any, panel: DetectionPanel) -> None:  # noqa: ANN401 (matplotlib)
    """Draw an image with its boxes, in the colours of `detections_sheet`."""
    height, width = panel.image_rgb.shape[:2]
    axis.imshow(panel.image_rgb, extent=(0, width, height, 0), interpolation="antialiased")
    match = np.asarray(panel.detection_of_truth, dtype=int)
    truth = np.asarray(panel.truth_box_px, dtype=np.float64).reshape(-1, 4)
    detection = np.asarray(panel.detection_box_px, dtype=np.float64).reshape(-1, 4)
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
    axis.set_xlim(0, width)
    axis.set_ylim(height, 0)
    found = f"{len(found_index)} of {int(present.sum())} found"
    is_long = len(panel.title) > LONG_TITLE
    axis.set_title(
        f"{panel.title}\n{found}" if is_long else f"{panel.title}: {found}", fontsize=9.5, fontweight="normal", pad=4
    )


def _draw_box(axis: Any, box_px: np.ndarray, colour: tuple[int, int, int], **line: Any) -> None:  # noqa: ANN401
    from matplotlib.patches import Rectangle

    x0, y0, x1, y1 = box_px
    axis.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=hex_colour(colour), **line))
