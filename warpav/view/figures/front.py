"""The front of rigs: how many misses are left at which number of cameras or cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from warpav.core.errors import InputError
from warpav.view.figures.style import WIDTH_INCH, figure_style, new_figure
from warpav.view.palette import FALSE_POSITIVE_RGB, INK_RGB, MUTED_RGB, camera_rgb, hex_colour


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
        ("unseen scenes, detector", "misses_per_100", 1.0, INK_RGB, "o-"),
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
