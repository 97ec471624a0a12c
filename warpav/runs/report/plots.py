"""Plots of a report as SVG: small panels, so that a phone shows one below the other and every letter can be read."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from warpav.rig.rig import Rig
from warpav.runs.report.reading import Arm, Evaluation, Event, GroundMap, Group
from warpav.runs.verdict import RECALL_GROUPS
from warpav.view.figures import convergence_panels, figure_style, new_figure
from warpav.view.palette import COVERAGE_RGB, INK_RGB, MUTED_RGB, Rgb, camera_rgb, hex_colour

WIDTH_INCH = 4.5

ARM_RGB: dict[str, Rgb] = {"start": MUTED_RGB, "highest": camera_rgb(1), "random": camera_rgb(4)}
"""Colours of baselines; the first arm has that of the first camera."""

_LEVEL_95 = 1.959964  # standard deviations of a normal number that hold 95 %


def convergence(events: Sequence[Event], *, min_distance_m: float | None) -> dict[str, str]:
    """Loss, loss terms, multipliers and the smallest camera distance over the iterations, as SVG by name.

    Empty for events that do not hold them all.
    """
    records = [event.model_dump() for event in events]
    if not records or any(record[key] is None for record in records for key in ("terms", "multipliers", "positions_m")):
        return {}
    records = [{**record, "loss": math.nan if record["loss"] is None else record["loss"]} for record in records]
    return {name: _svg(draw, 2.9) for name, draw in convergence_panels(records, min_distance_m).items()}


def differences(evaluation: Evaluation, metrics: Mapping[str, str]) -> str | None:
    """Differences of the first arm to the others with their intervals, as SVG; None without intervals.

    Args:
        evaluation: Holds them.
        metrics: Shares from 0 to 1 by their names, and how they are called.
    """
    rows = [
        (f"{heading}\nagainst {name}", found[metric], name)
        for metric, heading in metrics.items()
        for name, found in evaluation.paired.items()
        if metric in found and found[metric].low is not None
    ]
    if not rows:
        return None

    def draw(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
        axis.axvline(0.0, color=hex_colour(INK_RGB), linewidth=1.2)
        for place, (_, found, name) in enumerate(rows):
            colour = hex_colour(ARM_RGB.get(name, INK_RGB))
            axis.plot([found.low, found.high], [place, place], color=colour, linewidth=2.4)
            axis.plot(found.mean, place, "o", color=colour, markersize=7)
        axis.set_yticks(range(len(rows)), [text for text, _, _ in rows])
        axis.set_ylim(len(rows) - 0.4, -0.6)
        axis.set_title("Differences with 95 % intervals")
        axis.locator_params(axis="x", nbins=5)
        axis.set_xlabel(f"← worse    {evaluation.first} minus other    better →")
        axis.grid(visible=False, axis="y")

    return _svg(draw, 0.9 + 0.42 * len(rows))


def recall_of_groups(arms: Mapping[str, Arm], by: str, title: str) -> str | None:
    """Recall by group, a dot for every arm and the first one's 95 % interval, as SVG; None where it is not known.

    Args:
        arms: Metrics by arm.
        by: One of `RECALL_GROUPS`.
        title: A short line above.
    """
    tables = {name: arm.recall_by[by] for name, arm in arms.items() if arm.recall_by and by in arm.recall_by}
    if len(tables) < len(arms):
        return None
    first, *others = tables
    groups = [name for name, group in tables[first].items() if group.objects]
    if not groups:
        return None

    def draw(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
        colour = hex_colour(camera_rgb(0))
        low, high = zip(*(_wilson_interval(tables[first][name]) for name in groups), strict=True)
        axis.hlines(range(len(groups)), low, high, color=colour, linewidth=6.0, alpha=0.25)
        for name in reversed(others):
            values = [tables[name][group].recall if group in tables[name] else None for group in groups]
            style: dict[str, Any] = {"marker": "o" if name == "start" else "D", "markersize": 6.5, "linestyle": ""}
            axis.plot(
                np.array(values, np.float64),
                range(len(groups)),
                markerfacecolor="none",
                markeredgecolor=hex_colour(ARM_RGB.get(name, INK_RGB)),
                markeredgewidth=1.6,
                clip_on=False,
                label=name,
                **style,
            )
        values = np.array([tables[first][group].recall for group in groups], np.float64)
        axis.plot(values, range(len(groups)), "o", color=colour, markersize=6, clip_on=False, zorder=5, label=first)
        handles, names = axis.get_legend_handles_labels()
        unit = RECALL_GROUPS.get(by, "")
        axis.set_yticks(range(len(groups)), [f"{group}{unit}  ({tables[first][group].objects})" for group in groups])
        axis.set_ylim(len(groups) - 0.4, -0.6)
        axis.set_xlim(0.0, 1.02)
        axis.set_title(title)
        axis.set_xlabel("recall (number of objects)")
        below = (0.4, -0.55 / (0.3 * len(groups) + 0.6))
        axis.legend(handles[::-1], names[::-1], loc="upper center", bbox_to_anchor=below, ncols=4)

    return _svg(draw, 1.45 + 0.3 * len(groups))


def _wilson_interval(group: Group) -> tuple[float, float]:
    """Wilson's 95 % interval of a share, as if every object were found or not by itself."""
    n, share, z = group.objects, group.detected / group.objects, _LEVEL_95
    middle = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def blind_ground(ground: GroundMap, arm: str, height: int, rig: Rig | None, title: str) -> str:
    """Where no camera sees somebody, seen from above with the front up, as SVG.

    Args:
        ground: The cells.
        arm: Of which rig.
        height: How tall somebody is, an index.
        rig: Its cameras are drawn; None: none are.
        title: A short line above.
    """
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.patches import FancyBboxPatch

    share = ground.blind_share[arm][height]
    colours = LinearSegmentedColormap.from_list(
        "blind", ["#eaf1f8", *(hex_colour(rgb) for rgb in ((240, 170, 150), COVERAGE_RGB[0], (120, 16, 20)))]
    )
    low_m, high_m = ground.ego_bounds_m
    middle_m = 0.5 * (low_m + high_m)
    reach_m = 0.5 * ground.cell_m * len(share)

    def draw(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
        # rows are forward and shall point up, columns are left
        image = axis.imshow(
            share[::-1, ::-1],
            cmap=colours,
            vmin=0.0,
            vmax=1.0,
            extent=(reach_m, -reach_m, -reach_m, reach_m),
            interpolation="nearest",
        )
        length_m, width_m = (high_m - low_m)[:2]
        body = FancyBboxPatch(
            (-width_m / 2 + 0.4, -length_m / 2 + 0.4),
            width_m - 0.8,
            length_m - 0.8,
            boxstyle="round,pad=0.4",
            facecolor="#c9d1db",
            edgecolor=hex_colour(INK_RGB),
            linewidth=0.8,
        )
        axis.add_patch(body)
        axis.plot([0.0, 0.0], [0.0, 0.5 * length_m], color=hex_colour(INK_RGB), linewidth=0.8)
        for index, camera in enumerate(rig.cameras if rig else ()):
            forward_m, left_m = camera.position_m[:2] - middle_m[:2]
            axis.plot(left_m, forward_m, "o", color=hex_colour(camera_rgb(index)), markersize=3.0)
        for radius_m in (5, 10, 15, 20):
            turn = np.linspace(0.0, 2.0 * math.pi, 181)
            axis.plot(radius_m * np.cos(turn), radius_m * np.sin(turn), color="#8a94a0", linewidth=0.5, alpha=0.7)
            axis.text(0.0, -radius_m, f"{radius_m} m", fontsize=6.5, ha="center", va="bottom", color="#4a5360")
        axis.set(xticks=[], yticks=[], title=title)
        axis.grid(visible=False)
        for side in axis.spines.values():
            side.set_visible(False)
        bar = axis.figure.colorbar(image, ax=axis, shrink=0.8, pad=0.02, aspect=26, format="{x:.0%}")
        bar.outline.set_visible(False)

    return _svg(draw, 3.7)


def _svg(draw: Callable[[Any], None], height_inch: float) -> str:
    """What a function draws into an axis, as SVG; the same every time."""
    import matplotlib

    with (
        figure_style(),
        matplotlib.rc_context({"svg.hashsalt": "warpav", "figure.facecolor": "none", "axes.facecolor": "none"}),
    ):
        figure = new_figure(WIDTH_INCH, height_inch)
        draw(figure.subplots())
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return text.getvalue()
