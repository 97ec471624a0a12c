"""Numbers as figures: fits, differences, recall by group, the front of cameras or costs, sensitivity."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import InputError
from warpav.view._palette import (
    BASELINE_RGB,
    FALSE_POSITIVE_RGB,
    FURTHER_RGB,
    GRID_RGB,
    INK_RGB,
    MISS_RGB,
    MUTED_RGB,
    TRUE_POSITIVE_RGB,
    camera_rgb,
    hex_colour,
)
from warpav.view.figures._style import WIDTH_INCH, caption, colour_map, figure_style, new_figure, save_figure, title

if TYPE_CHECKING:
    from warpav.detection import CalibrationBin, DetectionProbability, DetectionSamples
    from warpav.optimisation import CameraOutages, Difference, MountTolerance


def reliability_diagram(
    bins: Sequence[CalibrationBin], probability: np.ndarray, is_detected: np.ndarray, path: Path | str, *, title: str
) -> Path:
    """Draw what share of objects [object] was detected over the probability that was predicted, and how many."""
    predicted, detected, low, high = np.array([[b.predicted, b.detected, b.low, b.high] for b in bins]).T
    with figure_style():
        figure = new_figure(0.6 * WIDTH_INCH, 0.72 * WIDTH_INCH)
        axis, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
        axis.plot([0, 1], [0, 1], color=hex_colour(MUTED_RGB), linewidth=1.0, label="as predicted")
        reach = np.maximum([detected - low, high - detected], 0.0)  # ends at 0 and 1 are rounded
        style = {"fmt": "o", "markersize": 4.5, "linewidth": 1.2, "color": hex_colour(camera_rgb(0)), "clip_on": False}
        label = f"share detected of {bins[0].count} objects, 95 % interval"
        axis.errorbar(predicted, detected, yerr=reach, label=label, **style)
        axis.set(ylabel="share detected", ylim=(-0.02, 1.02), title=title)
        axis.legend(loc="upper left")
        edges = np.linspace(0.0, 1.0, 21)
        shown = [probability[is_detected], probability[~is_detected]]
        colours = [hex_colour(TRUE_POSITIVE_RGB), hex_colour(MISS_RGB)]
        labels = [f"{len(shown[0])} detected", f"{len(shown[1])} missed"]
        lower.hist(shown, bins=list(edges), stacked=True, color=colours, label=labels)
        lower.set_yscale("symlog", linthresh=10)
        lower.yaxis.set_major_formatter("{x:,.0f}")
        lower.set(ylabel="objects", xlabel="predicted probability", xlim=(-0.02, 1.02))
        lower.legend(loc="upper center", ncols=2)
        return save_figure(figure, path)


def detection_curves(model: DetectionProbability, samples: DetectionSamples, path: Path | str) -> Path:
    """Draw what every feature adds to the logit of detection of each kind of road user, over where objects have it."""
    from warpav.detection import FEATURES, ROAD_USERS

    with figure_style():
        figure = new_figure(WIDTH_INCH, 0.62 * WIDTH_INCH)
        feature, kinds = samples.feature, range(len(model.constant))
        axes = figure.subplots(2, 4, sharey=True)
        for f, (axis, each) in enumerate(zip(axes.flat, FEATURES, strict=True)):
            low, high = np.quantile(feature[:, f], [0.002, 0.998])
            value = np.linspace(low, max(high, low + 1e-3), 200)
            share = axis.twinx()
            share.hist(feature[:, f], bins=30, range=(value[0], value[-1]), color=hex_colour(GRID_RGB), alpha=0.9)
            share.set_axis_off()
            share.set_ylim(0, share.get_ylim()[1] * 2.5)
            axis.set_zorder(share.get_zorder() + 1)
            axis.patch.set_visible(False)
            for kind in kinds:
                axis.plot(
                    value, model.curve(f, value, kind), color=hex_colour(camera_rgb(kind)), label=ROAD_USERS[kind]
                )
            axis.set(title=each.name.replace("_", " "), xlabel=each.unit)
        for axis in axes[:, 0]:
            axis.set_ylabel("added to the logit")
        axes.flat[-2].legend(loc="lower left")
        return save_figure(figure, path)


_Groups = Mapping[str, Any]
"""Objects of about one distance, sector or kind, by its name, as `warpav.optimisation.evaluation` counts them."""


def differences_figure(rows: Mapping[str, Difference], first: str) -> Any:  # noqa: ANN401 (matplotlib)
    """How many fewer of 100 one rig misses than others, by their names; ``rows``: what it misses more."""
    with figure_style():
        figure = new_figure(0.5 * WIDTH_INCH, 0.95 + 0.42 * len(rows))
        axis = figure.subplots()
        axis.axvline(0.0, color=hex_colour(INK_RGB), linewidth=1.2)
        for line, (name, row) in enumerate(rows.items()):
            colour = hex_colour(BASELINE_RGB.get(name, INK_RGB))
            fewer = -np.array([row.low, row.mean, row.high], np.float64)
            axis.plot(fewer[::2], [line, line], color=colour, linewidth=2.4)
            axis.plot(fewer[1], line, "o", color=colour, markersize=7)
        axis.set_yticks(range(len(rows)), [f"than {name}" for name in rows])
        axis.set(ylim=(len(rows) - 0.4, -0.6), title=f"{first}: fewer missed of 100")
        axis.locator_params(axis="x", nbins=5)
        axis.set_xlabel("at equal false alarms, 95 % intervals\n← worse        better →")
        axis.grid(visible=False, axis="y")
    return figure


def recall_figure(groupings: Mapping[str, Mapping[str, _Groups]], *, title: str) -> Any:  # noqa: ANN401
    """Share detected by rigs at equal false alarms, by groups of objects, a panel for every grouping."""
    shown = {heading: tables for heading, tables in groupings.items() if _groups(tables)}
    lines = max(len(_groups(tables)) for tables in shown.values())
    with figure_style():
        figure = new_figure(WIDTH_INCH, 1.5 + 0.3 * lines)
        handles, names = [], []
        axes = figure.subplots(1, len(shown), squeeze=False)[0]
        for axis, (heading, tables) in zip(axes, shown.items(), strict=True):
            handles, names = _draw_recall(axis, tables, heading)
        figure.suptitle(title, color=hex_colour(MUTED_RGB), fontsize=9.0)
        figure.legend(handles[::-1], names[::-1], loc="outside lower center", ncols=6)
    return figure


def _groups(tables: Mapping[str, _Groups]) -> list[str]:
    return [name for name, group in next(iter(tables.values())).items() if group.objects]


def _draw_recall(axis: Any, tables: Mapping[str, _Groups], title: str) -> tuple[list[Any], list[str]]:  # noqa: ANN401
    from scipy.stats import binomtest

    first, *others = tables
    groups = _groups(tables)
    colour = hex_colour(camera_rgb(0))
    tests = [binomtest(tables[first][name].detected, tables[first][name].objects) for name in groups]
    low, high = zip(*(test.proportion_ci(0.95, method="wilson") for test in tests), strict=True)
    axis.hlines(range(len(groups)), low, high, color=colour, linewidth=6.0, alpha=0.25)
    for k, name in reversed([*enumerate(others)]):
        values = [tables[name][group].recall if group in tables[name] else None for group in groups]
        style = {"marker": "Ds^v"[k % 4], "markersize": 6.5, "linestyle": "", "clip_on": False}
        style |= {"markeredgecolor": hex_colour(BASELINE_RGB.get(name, camera_rgb(k + 2))), "markeredgewidth": 1.6}
        axis.plot(np.array(values, float), range(len(groups)), markerfacecolor="none", label=name, **style)
    values = np.array([tables[first][group].recall for group in groups], np.float64)
    axis.plot(values, range(len(groups)), "o", color=colour, markersize=6, clip_on=False, zorder=5, label=first)
    handles, names = axis.get_legend_handles_labels()
    axis.set_yticks(range(len(groups)), [f"{group}  ({tables[first][group].objects})" for group in groups])
    axis.set(ylim=(len(groups) - 0.4, -0.6), xlim=(0.0, 1.02), title=title, xlabel="share detected (objects)")
    return handles, names


def front_figure(points: Sequence[Mapping[str, Any]], *, by: str, title: str | None = None) -> Any:  # noqa: ANN401
    """Draw a front: misses per 100 over cameras or cost, and below it what each rig is made of."""
    if not points:
        raise InputError("front: expected at least one rig to draw, got none")
    with figure_style():
        names = list(dict.fromkeys(name for point in points for name in point["modules"]))
        figure = new_figure(WIDTH_INCH, 4.6 + 0.22 * len(names))
        ratio = [1.0, 0.07 * len(names) + 0.05] if names else [1.0]
        axes = figure.subplots(len(ratio), 1, sharex=True, height_ratios=ratio, squeeze=False)[:, 0]
        x = [point["cameras" if by == "cameras" else "cost"] for point in points]
        _draw_misses(axes[0], points, x)
        axes[-1].set_xlabel("cameras" if by == "cameras" else "cost of all modules")
        if by == "cameras":
            axes[-1].set_xticks(sorted(set(x)))
        if names:
            _draw_modules(axes[1], points, x, names)
        axes[0].set_title(title or f"What {'another camera' if by == 'cameras' else 'a larger budget'} brings")
        return figure


def _draw_misses(axis: Any, points: Sequence[Mapping[str, Any]], x: Sequence[float]) -> None:  # noqa: ANN401 (matplotlib)
    series = (
        ("unseen scenes, equal false alarms", "misses_per_100", 1.0, INK_RGB, "o-"),
        ("unseen scenes, expected", "expected_misses_per_100", 1.0, camera_rgb(0), "s-"),
        ("scenes of the search, objective", "objective", 100.0, camera_rgb(1), "^--"),
        ("bound: no rig of the pool is below", "bound", 100.0, MUTED_RGB, "_:"),
    )
    for label, name, scale, rgb, line in series:
        if any(point[name] is None for point in points):
            continue
        values = [scale * point[name] for point in points]
        axis.plot(x, values, line, color=hex_colour(rgb), label=label, markersize=6)
    dominated = [k for k, point in enumerate(points) if point["is_dominated"]]
    if dominated:
        values = [100.0 * points[k]["objective"] for k in dominated]
        where = [x[k] for k in dominated]
        axis.plot(where, values, "x", color=hex_colour(FALSE_POSITIVE_RGB), label="dominated", markersize=10)
    axis.set_ylim(bottom=0.0)
    axis.set_ylabel("misses per 100")
    axis.legend()


def _draw_modules(axis: Any, points: Sequence[Mapping[str, Any]], x: Sequence[float], names: Sequence[str]) -> None:  # noqa: ANN401
    axis.set(yticks=range(len(names)), ylim=(len(names) - 0.5, -0.5))
    axis.set_yticklabels(names)
    axis.grid(visible=False)
    for place, point in zip(x, points, strict=True):
        for row, name in enumerate(names):
            count = point["modules"].get(name, 0)
            colour = hex_colour(INK_RGB if count else MUTED_RGB)
            axis.text(place, row, str(count) if count else "·", ha="center", va="center", color=colour)


_LEAST_SHOWN = 0.1  # misses per 100 that have the full colour at least: less is no sensitivity
_BELOW_RGB = ((120, 176, 226), (190, 218, 242))


def sensitivity_figure(
    tolerance: MountTolerance | None, outages: CameraOutages | None = None, *, heading: str | None = None
) -> Any:  # noqa: ANN401 (matplotlib)
    """A heat map of cameras by degrees of freedom, and beside it a bar for the loss of each camera."""
    effects = [] if tolerance is None else tolerance.effects
    lost = [] if outages is None else [each.camera for each in outages.cameras]
    names = list(dict.fromkeys(effect.camera for effect in effects)) or lost
    if lost and names != lost:
        raise ValueError("tolerance and outages must be of the same cameras")
    panels = [part for part in (tolerance, outages) if part is not None]
    with figure_style():
        figure = new_figure(WIDTH_INCH, 1.5 + 0.34 * len(names))
        widths = [1.7, 1.0] if len(panels) > 1 else None
        axes = figure.subplots(1, len(panels), squeeze=False, sharey=True, width_ratios=widths)[0]
        if heading:
            figure.suptitle(heading, fontweight="bold")
        if tolerance is not None:
            _draw_changes(axes[0], tolerance, names)
            scenes = f"{tolerance.scenes} scene{'' if tolerance.scenes == 1 else 's'}"
            chance = f"{tolerance.samples.mean() - tolerance.nominal:+z.2f} (mean of {len(tolerance.samples)} draws)"
            text = f"Change of the expected misses per 100. Cameras off: in {scenes}; all off by chance: {chance}."
            caption(figure, text)
        if outages is not None:
            _draw_losses(axes[-1], outages)
        axes[0].set_yticks(range(len(names)), names)
        for label, index in zip(axes[0].get_yticklabels(), range(len(names)), strict=True):
            label.set(color=hex_colour(camera_rgb(index)), fontweight="bold")
        axes[0].set_ylim(len(names) - 0.5, -0.5)
        return figure


def _draw_changes(axis: Any, tolerance: MountTolerance, names: list[str]) -> None:  # noqa: ANN401 (matplotlib)
    degrees = list(dict.fromkeys(effect.degree for effect in tolerance.effects))
    change = np.full((len(names), len(degrees)), math.nan)
    for effect in tolerance.effects:
        change[names.index(effect.camera), degrees.index(effect.degree)] = effect.worst
    most = max(float(np.abs(change).max()), _LEAST_SHOWN)
    colours = colour_map("change", *_BELOW_RGB, (255, 255, 255), FURTHER_RGB[1], (236, 140, 70))
    axis.imshow(change, cmap=colours, vmin=-most, vmax=most, aspect="auto")
    for (row, column), value in np.ndenumerate(change):
        axis.text(column, row, f"{value:+z.2f}", ha="center", va="center", fontsize=8.5, color=hex_colour(INK_RGB))
    axis.set_xticks(range(len(degrees)), degrees)
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
    axis.tick_params(length=0)
    off = f"{100.0 * tolerance.position_m:g} cm or {math.degrees(tolerance.angle_rad):g}°"
    title(axis, f"Camera off by {off}")


def _draw_losses(axis: Any, outages: CameraOutages) -> None:  # noqa: ANN401 (matplotlib)
    is_weighted = outages.weighted_expected_misses_per_100 is not None
    more = [
        each.difference_per_100 if each.weighted_difference_per_100 is None else each.weighted_difference_per_100
        for each in outages.cameras
    ]
    bars = axis.barh(range(len(more)), more, color=[hex_colour(camera_rgb(k)) for k in range(len(more))], height=0.62)
    axis.bar_label(bars, [f"{each:+z.1f}" for each in more], padding=3, fontsize=8.5)
    axis.margins(x=0.16)
    axis.grid(visible=False)
    axis.set_xticks([])
    axis.spines["bottom"].set_visible(False)
    axis.tick_params(left=False)
    title(axis, "Camera lost", "weighted" if is_weighted else "")
