"""Figures of a run as PNG files: loss curves, the rig from above, the height map, detections before and after.

Every function draws one figure, writes it and returns its path. Colours of cameras are those of the 3D pictures.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.atomic_write import atomic_write
from warpav.core.errors import InputError
from warpav.view.frustum import sector_polygon_m
from warpav.view.palette import (
    FALSE_POSITIVE_RGB,
    GRID_RGB,
    INK_RGB,
    MISS_RGB,
    MUTED_RGB,
    PAPER_RGB,
    TRUE_POSITIVE_RGB,
    TRUTH_RGB,
    camera_rgb,
    hex_colour,
)

if TYPE_CHECKING:
    from warpav.detection.probability import DetectionProbability
    from warpav.detection.probability_fit import CalibrationBin
    from warpav.raster.mesh import Mesh
    from warpav.rig.mount_surface import MountSurface
    from warpav.rig.rig import Rig

WIDTH_INCH = 9.0
DOTS_PER_INCH = 150

STYLE: Any = {
    "font.size": 10.0,
    "axes.titlesize": 11.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": hex_colour(MUTED_RGB),
    "axes.labelcolor": hex_colour(INK_RGB),
    "axes.titlecolor": hex_colour(INK_RGB),
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": hex_colour(GRID_RGB),
    "grid.linewidth": 0.8,
    "xtick.color": hex_colour(MUTED_RGB),
    "ytick.color": hex_colour(MUTED_RGB),
    "text.color": hex_colour(INK_RGB),
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "lines.linewidth": 1.8,
    "lines.solid_capstyle": "round",
    "figure.facecolor": hex_colour(PAPER_RGB),
}


@dataclass(frozen=True)
class DetectionPanel:
    """One camera image with what is there and what was found.

    Attributes:
        title: A short line above the image.
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


def loss_curves(records: Sequence[Mapping[str, Any]], path: Path | str, *, min_distance_m: float | None = None) -> Path:
    """Draw loss, loss terms, multipliers and the smallest camera distance over the iterations.

    Of inequalities, whose terms are negative where there is room to spare, those that were broken are drawn, and by how
    much.

    Args:
        records: The lines of ``events.jsonl``, in order: ``iteration``, ``loss``, ``terms``, ``multipliers``,
            ``positions_m``.
        path: PNG file to write.
        min_distance_m: The distance that the cameras must keep [m]; drawn as a limit when given.

    Raises:
        InputError: No records, or one without these keys.
    """
    if not records:
        raise InputError(f"{path}: there is no iteration to draw; run at least one")
    missing = [key for key in ("iteration", "loss", "terms", "multipliers", "positions_m") if key not in records[0]]
    if missing:
        raise InputError(f"{path}: the records of a run need the keys {', '.join(missing)}, which are missing")
    with figure_style():
        figure = new_figure(WIDTH_INCH, 5.6)
        axes = figure.subplots(2, 2, sharex=True)
        for axis, draw in zip(axes.flat, convergence_panels(records, min_distance_m).values(), strict=True):
            draw(axis)
        for axis in axes[0]:
            axis.set_xlabel("")
        return save_figure(figure, path)


def convergence_panels(
    records: Sequence[Mapping[str, Any]], min_distance_m: float | None = None
) -> dict[str, Callable[[Any], None]]:
    """What draws loss, loss terms, multipliers and the smallest camera distance, each into an axis, by its title.

    The arguments are those of `loss_curves`.
    """
    iteration = np.array([record["iteration"] for record in records])
    terms = {name: _over_time(records, "terms", name) for name in records[0]["terms"]}
    kept = {name for name in records[0]["multipliers"] if name in terms and _is_always_kept(terms[name])}
    terms = {name: term for name, term in terms.items() if name not in kept}
    multiplier_names = [name for name in records[0]["multipliers"] if name not in kept]

    def begin(axis: Any, title: str) -> None:  # noqa: ANN401 (matplotlib)
        axis.set_title(title)
        axis.set_xlabel("iteration")
        axis.xaxis.get_major_locator().set_params(integer=True)

    def loss(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
        begin(axis, "Loss")
        value = np.array([record["loss"] for record in records], dtype=np.float64)
        axis.plot(iteration, value, color=hex_colour(INK_RGB), alpha=0.28, linewidth=1.2, label="batch")
        axis.plot(iteration, running_mean(value), color=hex_colour(INK_RGB), label="mean of batches")
        look = np.array([record.get("training_objective") for record in records], dtype=np.float64)
        if np.isfinite(look).any():
            at = np.isfinite(look)
            axis.plot(iteration[at], look[at], "o", color=hex_colour(camera_rgb(0)), label="all scenes")
            axis.legend(loc="best")

    def loss_terms(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
        begin(axis, "Loss terms")
        for index, (name, term) in enumerate(terms.items()):
            drawn = np.maximum(term, 0.0) if name in multiplier_names else term
            colour = hex_colour(camera_rgb(index))
            axis.plot(iteration, drawn, color=colour, alpha=0.25, linewidth=1.2)
            axis.plot(iteration, running_mean(drawn), color=colour, label=name)
        _name_lines(axis, terms)

    def multipliers(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
        begin(axis, "Multipliers")
        for index, name in enumerate(multiplier_names):
            value = [_highest(record["multipliers"].get(name, 0.0)) for record in records]
            axis.plot(iteration, value, color=hex_colour(camera_rgb(index)), label=name)
        _name_lines(axis, multiplier_names)
        if not multiplier_names:
            axis.text(0.5, 0.5, "all 0: no constraint was broken", ha="center", transform=axis.transAxes)
            axis.set_yticks([])

    def spacing(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
        begin(axis, "Smallest distance between cameras [m]")
        distance_m = [_smallest_distance_m(record["positions_m"]) for record in records]
        axis.plot(iteration, distance_m, color=hex_colour(INK_RGB))
        largest = np.nanmax([*distance_m, min_distance_m or 0.0, 1e-3])
        axis.set_ylim(0.0, 1.1 * float(largest))
        if min_distance_m is None:
            return
        axis.axhline(min_distance_m, color=hex_colour(FALSE_POSITIVE_RGB), linestyle=(0, (4, 3)), linewidth=1.3)
        axis.annotate(
            f"must keep {min_distance_m:g} m",
            (1.0, min_distance_m),
            xycoords=("axes fraction", "data"),
            xytext=(0, 4),
            textcoords="offset points",
            ha="right",
            color=hex_colour(FALSE_POSITIVE_RGB),
            fontsize=9,
        )

    return {"loss": loss, "loss terms": loss_terms, "multipliers": multipliers, "camera distance": spacing}


def _name_lines(axis: Any, names: Collection[str]) -> None:  # noqa: ANN401 (matplotlib)
    """Tell which line is which, where there is more than none."""
    if names:
        axis.legend(loc="best", ncols=2 if len(names) > 3 else 1)


def _over_time(records: Sequence[Mapping[str, Any]], key: str, name: str) -> np.ndarray:
    """One of the numbers under a key, float64 [record]; NaN where a record has none of that name."""
    return np.array([record[key].get(name, math.nan) for record in records], dtype=np.float64)


def _highest(multiplier: float | Sequence[float] | None) -> float:
    """The highest of what may be one multiplier or several; NaN where it was not finite."""
    return float(np.max(np.array(multiplier, dtype=np.float64), initial=0.0))


def _is_always_kept(term: np.ndarray) -> bool:
    """Whether a constraint is an inequality that no record breaks."""
    return bool(np.nanmin(term, initial=0.0) < 0.0 and np.nanmax(term, initial=0.0) <= 0.0)


def objective_scatter(
    rigs: Sequence[Mapping[str, Any]],
    spearman: Mapping[str, Mapping[str, Any]],
    path: Path | str,
    *,
    objectives: Sequence[str],
    metrics: Sequence[str],
) -> Path:
    """Draw training objectives against metrics on the test scenes, a dot for every rig, a panel for every pair.

    Args:
        rigs: Every rig with ``arm``, ``objectives`` by name and the metrics.
        spearman: By objective and metric: an estimate of their rank correlation; where it is missing none is written.
        path: PNG file to write.
        objectives: Names of the objectives, one column each.
        metrics: Names of the metrics, one row each.
    """
    names = {"tp_detection_rate": "recall of the rig", "ap50_pooled": "AP50"}
    arms = list(dict.fromkeys(rig["arm"] for rig in rigs))
    with figure_style():
        figure = new_figure(WIDTH_INCH, 3.3 * len(metrics) + 0.4)
        axes = figure.subplots(len(metrics), len(objectives), squeeze=False, sharey="row", sharex="col")
        for row, metric in enumerate(metrics):
            for column, objective in enumerate(objectives):
                axis = axes[row, column]
                for index, arm in enumerate(arms):
                    pairs = [(rig["objectives"].get(objective), rig[metric]) for rig in rigs if rig["arm"] == arm]
                    pairs = [pair for pair in pairs if None not in pair]
                    if pairs:
                        colour = hex_colour(camera_rgb(index))
                        axis.scatter(
                            *zip(*pairs, strict=True), s=16.0, color=colour, alpha=0.75, linewidths=0.0, label=arm
                        )
                estimate = spearman.get(objective, {}).get(metric)
                found = "" if estimate is None or estimate.value is None else f": rank correlation {estimate.value:.2f}"
                axis.set_title(f"{objective}{found}")
                if row == len(metrics) - 1:
                    axis.set_xlabel("objective on the validation scenes")
                if column == 0:
                    axis.set_ylabel(f"{names.get(metric, metric)}, test scenes")
        axes[0, 0].legend(loc="best")
        return save_figure(figure, path)


def rig_top_view(
    path: Path | str,
    *,
    rig: Rig,
    ego: Mesh,
    mount_surface: MountSurface,
    rig_initial: Rig | None = None,
    trajectory_m: np.ndarray | None = None,
    sector_radius_m: float = 1.6,
    shows_zone: bool = False,
) -> Path:
    """Draw the vehicle from above with the cameras, where they started, their paths and their sectors.

    Args:
        path: PNG file to write.
        rig: The cameras at the end.
        ego: The vehicle; its outline is drawn.
        mount_surface: The height map below the cameras.
        rig_initial: The cameras at the start, drawn hollow.
        trajectory_m: Camera positions over the iterations [m], shape [iteration, camera, 3] or [iteration, camera, 2].
        sector_radius_m: How far the sectors are drawn [m].
        shows_zone: Whether the border of the mountable zone is drawn.
    """
    with figure_style():
        figure = new_figure(WIDTH_INCH, 6.0)
        axis = figure.subplots()
        draw_vehicle(axis, ego)
        image = draw_height_map(axis, mount_surface, colours=pale_map())
        if shows_zone:
            draw_zone_border(axis, mount_surface)
        draw_cameras(
            axis,
            rig,
            rig_initial=rig_initial,
            trajectory_m=trajectory_m,
            sector_radius_m=sector_radius_m,
            has_names=True,
        )
        if rig_initial is not None:
            figure.legend(handles=start_and_end_handles(), loc="outside upper left", ncols=2)
        axis.set_aspect("equal")
        axis.use_sticky_edges = False
        axis.margins(0.04)
        axis.autoscale_view()
        axis.set_xlabel("x, forward [m]")
        axis.set_ylabel("y, left [m]")
        bar = figure.colorbar(image, ax=axis, shrink=0.7, pad=0.02, aspect=28)
        bar.set_label("height of the mount surface [m]")
        bar.outline.set_visible(False)
        return save_figure(figure, path)


def detections_sheet(rows: Mapping[str, Sequence[DetectionPanel]], path: Path | str) -> Path:
    """Draw camera images in a grid with what was there, what was found and what was not.

    Ground truth is thin white, true positives green, false positives red, misses dashed orange.

    Args:
        rows: The images of each row by the row's heading, for example ``start`` and ``after 100 iterations``.
        path: PNG file to write.

    Raises:
        InputError: There is no image.
    """
    column_count = max((len(panels) for panels in rows.values()), default=0)
    if column_count == 0:
        raise InputError(f"{path}: there is no image to draw")
    sample = next(panels[0].image_rgb for panels in rows.values() if panels)
    edge_inch = min((WIDTH_INCH - 0.3) / column_count, 4.0)
    row_inch = edge_inch * sample.shape[0] / sample.shape[1] + 0.3
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


def running_mean(value: np.ndarray, *, window: int = 9) -> np.ndarray:
    """Mean over the ``window`` entries around each one, fewer at the ends; NaN entries do not count."""
    value = np.asarray(value, dtype=np.float64)
    half = window // 2
    valid = np.isfinite(value)
    total = np.convolve(np.pad(np.where(valid, value, 0.0), half), np.ones(2 * half + 1), mode="valid")
    count = np.convolve(np.pad(valid.astype(np.float64), half), np.ones(2 * half + 1), mode="valid")
    return np.where(count > 0, total / np.maximum(count, 1.0), math.nan)


def _smallest_distance_m(position_m: object) -> float:
    position = np.asarray(position_m, dtype=np.float64)
    first, second = np.triu_indices(len(position), 1)
    if len(first) == 0:
        return math.nan
    return float(np.linalg.norm(position[first] - position[second], axis=1).min())


def draw_cameras(
    axis: Any,  # noqa: ANN401 (matplotlib)
    rig: Rig,
    *,
    rig_initial: Rig | None = None,
    trajectory_m: np.ndarray | None = None,
    sector_radius_m: float | None = None,
    has_names: bool = False,
) -> None:
    """Draw cameras from above, x pointing right, each in its colour; arguments as in `rig_top_view`.

    Args:
        axis: Where to draw.
        rig: The cameras at the end.
        rig_initial: The cameras at the start, drawn hollow.
        trajectory_m: Their paths.
        sector_radius_m: How far the sectors are drawn [m]; None: not at all.
        has_names: Whether every sector carries its camera's name.
    """
    if trajectory_m is not None:
        step = np.asarray(trajectory_m, dtype=np.float64)
        for index in range(step.shape[1]):
            axis.plot(*step[:, index, :2].T, color="white", linewidth=4.0, zorder=5)
            axis.plot(*step[:, index, :2].T, color=hex_colour(camera_rgb(index)), linewidth=1.8, zorder=6)
    for index, camera in enumerate(rig.cameras):
        colour = hex_colour(camera_rgb(index))
        if rig_initial is not None and index < len(rig_initial.cameras):
            start = rig_initial.cameras[index].position_m
            hollow = {"markerfacecolor": "white", "markeredgecolor": colour, "markeredgewidth": 1.8}
            axis.plot(start[0], start[1], "o", markersize=8, zorder=7, **hollow)
        solid = {"markerfacecolor": colour, "markeredgecolor": "white", "markeredgewidth": 1.5}
        axis.plot(camera.position_m[0], camera.position_m[1], "o", markersize=10, zorder=8, **solid)
        if sector_radius_m is None:
            continue
        outline = sector_polygon_m(camera, radius_m=sector_radius_m)
        axis.fill(*outline.T, color=colour, alpha=0.22, linewidth=0, zorder=3)
        axis.plot(*np.vstack([outline, outline[:1]]).T, color=colour, linewidth=1.2, alpha=0.8, zorder=4)
        if not has_names:
            continue
        arc_middle = outline[1:][(len(outline) - 1) // 2]
        direction = (arc_middle - outline[0]) / np.linalg.norm(arc_middle - outline[0])
        label = outline[0] + (sector_radius_m + 0.08 + 0.09 * np.abs(direction[1])) * direction
        side = "center" if abs(direction[0]) < 0.4 else "left" if direction[0] > 0 else "right"
        axis.text(*label, camera.name, color=colour, ha=side, va="center", fontweight="bold", zorder=9)
        axis.update_datalim([label + np.array([math.copysign(0.09 * len(camera.name), direction[0]), 0.0])])


def start_and_end_handles() -> list[Any]:
    """What tells in a legend which cameras are those at the start."""
    from matplotlib.lines import Line2D

    grey = hex_colour(MUTED_RGB)
    return [
        Line2D([], [], linestyle="", marker="o", markersize=8, color=grey, markerfacecolor="white", label="start"),
        Line2D([], [], linestyle="", marker="o", markersize=9, color=grey, label="end"),
    ]


def draw_vehicle(axis: Any, ego: Mesh) -> None:  # noqa: ANN401 (matplotlib)
    """Draw a vehicle from above as a silhouette in one flat colour; x points right."""
    from matplotlib.collections import PolyCollection

    corner_m = np.asarray(ego.vertex_m)[np.asarray(ego.triangle)][:, :, :2]
    colour = hex_colour(GRID_RGB)
    axis.add_collection(PolyCollection(list(corner_m), facecolors=colour, edgecolors=colour, linewidths=0.6, zorder=1))
    axis.autoscale_view()


def draw_height_map(axis: Any, mount_surface: MountSurface, *, colours: Any) -> Any:  # noqa: ANN401 (matplotlib)
    """Draw a height map from above, x pointing right; cells that are NaN stay empty. Returns matplotlib's image."""
    low, high = np.asarray(mount_surface.bounds_m, dtype=np.float64)
    half = mount_surface.cell_m / 2.0
    return axis.imshow(
        np.asarray(mount_surface.height_m).T,
        origin="lower",
        extent=(low[0] - half, high[0] + half, low[1] - half, high[1] + half),
        cmap=colours,
        zorder=2,
        interpolation="nearest",
    )


def draw_zone_border(axis: Any, mount_surface: MountSurface) -> None:  # noqa: ANN401 (matplotlib)
    """Draw the border of the mountable zone from above, x pointing right."""
    rows, columns = mount_surface.height_m.shape
    x_m, y_m = (
        start + mount_surface.cell_m * np.arange(-1, n + 1)
        for start, n in zip(mount_surface.origin_m, (rows, columns), strict=True)
    )
    distance_m = mount_surface.zone_distance_m(np.stack(np.meshgrid(x_m, y_m, indexing="xy"), axis=-1))
    axis.contour(x_m, y_m, distance_m, levels=[0.0], colors=hex_colour(INK_RGB), linewidths=1.0, zorder=3)


def pale_map() -> Any:  # noqa: ANN401 (matplotlib)
    """Greys that leave room for the colours of the cameras: low is light, high is darker."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("pale", ["#f4f6f9", "#a9b5c6"])


def detection_handles() -> list[Any]:
    """What tells in a legend what the colours of `draw_detections` mean."""
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
    axis.set_title(
        f"{panel.title}: {len(found_index)} of {int(present.sum())} found", fontsize=9.5, fontweight="normal", pad=4
    )


def _draw_box(axis: Any, box_px: np.ndarray, colour: tuple[int, int, int], **line: Any) -> None:  # noqa: ANN401
    from matplotlib.patches import Rectangle

    x0, y0, x1, y1 = box_px
    axis.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=hex_colour(colour), **line))


def reliability_diagram(
    bins: Sequence[CalibrationBin], probability: np.ndarray, is_detected: np.ndarray, path: Path | str, *, title: str
) -> Path:
    """Draw what share of objects was detected over the probability that was predicted, and how many there were.

    Args:
        bins: Objects of about one probability.
        probability: That was predicted for every object, 0..1, shape [object].
        is_detected: What came true, bool, shape [object].
        path: PNG file to write.
        title: A short line above.
    """
    predicted, detected, low, high = np.array(
        [[each.predicted, each.detected, each.low, each.high] for each in bins]
    ).T  # fmt: skip
    with figure_style():
        figure = new_figure(0.6 * WIDTH_INCH, 0.72 * WIDTH_INCH)
        axis, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
        axis.plot([0, 1], [0, 1], color=hex_colour(MUTED_RGB), linewidth=1.0, label="as predicted")
        axis.errorbar(
            predicted,
            detected,
            yerr=np.maximum([detected - low, high - detected], 0.0),  # ends at 0 and 1 are rounded
            fmt="o",
            markersize=4.5,
            linewidth=1.2,
            color=hex_colour(camera_rgb(0)),
            clip_on=False,
            label=f"share detected of {bins[0].count} objects, 95 % interval",
        )
        axis.set_ylabel("share detected")
        axis.set_ylim(-0.02, 1.02)
        axis.set_title(title)
        axis.legend(loc="upper left")
        edges = np.linspace(0.0, 1.0, 21)
        shown = [probability[is_detected], probability[~is_detected]]
        colours = [hex_colour(TRUE_POSITIVE_RGB), hex_colour(MISS_RGB)]
        labels = [f"{len(shown[0])} detected", f"{len(shown[1])} missed"]
        lower.hist(shown, bins=list(edges), stacked=True, color=colours, label=labels)
        lower.set_yscale("symlog", linthresh=10)
        lower.set_ylabel("objects")
        lower.set_xlabel("predicted probability")
        lower.set_xlim(-0.02, 1.02)
        lower.legend(loc="upper center", ncols=2)
        return save_figure(figure, path)


def detection_curves(model: DetectionProbability, feature: np.ndarray, path: Path | str) -> Path:
    """Draw what every feature adds to the logit of the probability of detection, over where objects have it.

    Args:
        model: The curves.
        feature: Features of the objects that they were fitted on, shape [object, feature].
        path: PNG file to write.
    """
    from warpav.detection.probability import FEATURES

    with figure_style():
        figure = new_figure(WIDTH_INCH, 0.62 * WIDTH_INCH)
        axes = figure.subplots(2, 3, sharey=True)
        for f, (axis, each) in enumerate(zip(axes.flat, FEATURES, strict=True)):
            low, high = np.quantile(feature[:, f], [0.002, 0.998])
            value = np.linspace(low, max(high, low + 1e-3), 200)
            share = axis.twinx()
            share.hist(feature[:, f], bins=30, range=(value[0], value[-1]), color=hex_colour(GRID_RGB), alpha=0.9)
            share.set_axis_off()
            share.set_ylim(0, share.get_ylim()[1] * 2.5)
            axis.set_zorder(share.get_zorder() + 1)
            axis.patch.set_visible(False)
            axis.plot(value, model.curve(f, value), color=hex_colour(camera_rgb(0)))
            axis.set_title(each.name.replace("_", " "))
            axis.set_xlabel(each.unit)
        for axis in axes[:, 0]:
            axis.set_ylabel("added to the logit")
        return save_figure(figure, path)


def figure_style() -> Any:  # noqa: ANN401 (a context manager of matplotlib)
    """A context in which figures have this module's fonts, lines and colours."""
    import matplotlib

    return matplotlib.rc_context(STYLE)


def new_figure(width_inch: float, height_inch: float) -> Any:  # noqa: ANN401 (matplotlib)
    """A figure that belongs to no window, whatever backend the caller's notebook uses."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_inch, height_inch), dpi=DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Any, path: Path | str) -> Path:  # noqa: ANN401 (matplotlib)
    """Write a figure as a PNG file that appears whole or not at all; missing folders are made.

    Returns:
        The path.

    Raises:
        InputError: It cannot be written.
    """
    path = Path(path)
    encoded = io.BytesIO()
    figure.savefig(encoded, format="png", metadata={"Software": None})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as draft:
            draft.write_bytes(encoded.getvalue())
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    return path
