"""Loss, loss terms, multipliers and camera distances of a run over its iterations; objective and bound of a search."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from warpav.core.errors import InputError
from warpav.view._palette import FALSE_POSITIVE_RGB, INK_RGB, camera_rgb, hex_colour
from warpav.view.figures._style import WIDTH_INCH, figure_style, new_figure


def loss_figure(records: Sequence[Mapping[str, Any]], *, min_distance_m: float | None = None) -> Any:  # noqa: ANN401
    """Draw loss, loss terms, multipliers and the smallest camera distance over the iterations.

    Of inequalities, whose terms are negative where there is room to spare, those that were broken are drawn, and by how
    much. Panels that would say nothing are left out, see `_panels`.
    """
    if not records:
        raise InputError("run: expected an iteration to draw, got none; run at least one")
    missing = [key for key in ("iteration", "loss", "terms", "multipliers", "positions_m") if key not in records[0]]
    if missing:
        raise InputError(f"run: expected records with the keys {', '.join(missing)}, which are missing")
    panels = list(_panels(records, min_distance_m).values())
    with figure_style():
        rows = -(-len(panels) // 2)
        figure = new_figure(WIDTH_INCH, 0.4 + 2.6 * rows)
        grid = figure.add_gridspec(rows, 2)
        for k, draw in enumerate(panels):  # an odd last one is as wide as two
            draw(figure.add_subplot(grid[k // 2, k % 2 : None if k + 1 == len(panels) else k % 2 + 1]))
        return figure


_POOL = ("pool", "#e4e8ee")
"""What camera renders up to the first selection are spent on, and the colour of the band."""

_SPENT_ON = {"polish": ("polish", "#e3eefc"), "pricing": ("pricing", "#fbeedd")}
"""Likewise after it, by the stage of the state that follows; selections need none."""


def search_figure(records: Sequence[Mapping[str, Any]]) -> Any:  # noqa: ANN401 (matplotlib)
    """Draw the best rig and the bound of a search by a pool over its camera renders; None where there is no bound.

    Bands say what the renders were spent on. A start that is far above all that follows is written at the upper edge.
    """
    keys = ("stage", "training_objective", "camera_renders")
    shown = [record for record in records if all(record.get(key) is not None for key in keys)]
    proven = [record for record in shown if record["stage"] == "selection" and record.get("bound") is not None]
    if not proven:
        return None
    stage = [record["stage"] for record in shown]
    spent = np.array([record["camera_renders"] for record in shown])
    objective = np.array([record["training_objective"] for record in shown])
    end = max(1.03 * float(spent[-1]), 1.0)  # so that what came last is seen
    bound_spent = [*(record["camera_renders"] for record in proven), end]
    bound = [*(record["bound"] for record in proven), proven[-1]["bound"]]
    first_selection = stage.index("selection")
    later = [*objective[first_selection:], *bound]
    room = max(max(later) - min(later), 0.02 * max(later))

    with figure_style():
        figure = new_figure(WIDTH_INCH, 4.2)
        axis = figure.subplots()
        axis.set(title="Best rig and bound", xlabel="camera renders (one camera in one scene)", ylabel="objective")
        named: set[str] = set()
        for k, until in enumerate(spent):
            begin = spent[k - 1] if k else 0
            name, colour = _POOL if k <= first_selection else _SPENT_ON.get(stage[k], ("", ""))
            if name and until > begin:
                axis.axvspan(begin, until, color=colour, linewidth=0, label=None if name in named else name, zorder=0.5)
                named.add(name)
        colour = hex_colour(camera_rgb(0))
        best = {"color": colour, "label": "best rig so far", "zorder": 3}
        axis.step([*spent, end], [*objective, objective[-1]], where="post", **best)
        marks = {"linestyle": "", "color": colour, "markeredgecolor": hex_colour(INK_RGB), "markeredgewidth": 0.7}
        for name, mark, size, label in (("selection", "s", 6.5, "selected"), ("polish", "o", 4.0, "polished")):
            at = np.array(stage) == name
            axis.plot(spent[at], objective[at], mark, label=label, markersize=size, zorder=4, **marks)
        dashed = {"color": hex_colour(FALSE_POSITIVE_RGB), "linestyle": (0, (4, 3)), "linewidth": 1.5}
        axis.step(bound_spent, bound, where="post", label="bound of the pool", zorder=3, **dashed)
        top = max(later) + 0.15 * room
        if stage[0] == "start" and objective[0] > top:
            place = {"xycoords": ("data", "axes fraction"), "xytext": (4, -3), "textcoords": "offset points"}
            text = f"start {objective[0]:.4f} \N{UPWARDS ARROW}"
            axis.annotate(text, (spent[0], 1.0), va="top", fontsize=9, **place)
        elif stage[0] == "start":
            axis.plot(spent[:1], objective[:1], "D", label="start", markersize=6.5, zorder=4, **marks)
        axis.set(ylim=(min(later) - 0.1 * room, top), xlim=(0, end))
        figure.legend(loc="outside lower center", ncols=7)
        return figure


def _panels(
    records: Sequence[Mapping[str, Any]], min_distance_m: float | None = None
) -> dict[str, Callable[[Any], None]]:
    """What draws loss, loss terms, multipliers and the smallest camera distance, each into an axis, by its title.

    What says nothing is left out: a single term, which is the loss; multipliers that are all 0, as no constraint was
    broken; the distance of a single camera.
    """
    from scipy.spatial.distance import pdist

    iteration = np.array([record["iteration"] for record in records])
    terms = {  # NaN where a record has none of that name
        name: np.array([record["terms"].get(name, math.nan) for record in records], dtype=np.float64)
        for name in records[0]["terms"]
    }
    limits = {name: term for name, term in terms.items() if name in records[0]["multipliers"]}
    # inequalities that no record breaks
    kept = {name for name, term in limits.items() if np.nanmin(term, initial=0.0) < 0.0 >= np.nanmax(term)}
    terms = {name: term for name, term in terms.items() if name not in kept}
    multiplier = {  # of several under one name the highest; NaN where it was not finite
        name: [float(np.max(np.array(record["multipliers"].get(name, 0.0), float), initial=0.0)) for record in records]
        for name in records[0]["multipliers"]
        if name not in kept
    }
    distance_m = [min(pdist(record["positions_m"]), default=math.nan) for record in records]

    def begin(axis: Any, title: str, lines: Mapping[str, object] | None = None) -> None:  # noqa: ANN401 (matplotlib)
        axis.set(title=title, xlabel="iteration")
        if lines:
            axis.legend(loc="best", ncols=2 if len(lines) > 3 else 1)
        axis.xaxis.get_major_locator().set_params(integer=True)

    def loss(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
        begin(axis, "Loss")
        value = np.array([record["loss"] for record in records], dtype=np.float64)
        axis.plot(iteration, value, color=hex_colour(INK_RGB), alpha=0.28, linewidth=1.2, label="batch")
        axis.plot(iteration, _running_mean(value), color=hex_colour(INK_RGB), label="mean of batches")
        compared = np.array([record.get("training_objective") for record in records], dtype=np.float64)
        if np.isfinite(compared).any():
            at = np.isfinite(compared)
            axis.plot(iteration[at], compared[at], "o", color=hex_colour(camera_rgb(0)), label="all scenes")
            axis.legend(loc="best")

    def loss_terms(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
        for index, (name, term) in enumerate(terms.items()):
            drawn = np.maximum(term, 0.0) if name in multiplier else term
            colour = hex_colour(camera_rgb(index))
            axis.plot(iteration, drawn, color=colour, alpha=0.25, linewidth=1.2)
            axis.plot(iteration, _running_mean(drawn), color=colour, label=name)
        begin(axis, "Loss terms", terms)

    def multipliers(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
        for index, (name, value) in enumerate(multiplier.items()):
            axis.plot(iteration, value, color=hex_colour(camera_rgb(index)), label=name)
        begin(axis, "Multipliers", multiplier)

    def spacing(axis: Any) -> None:  # noqa: ANN401 (matplotlib)
        begin(axis, "Smallest distance between cameras [m]")
        axis.plot(iteration, distance_m, color=hex_colour(INK_RGB))
        largest = np.nanmax([*distance_m, min_distance_m or 0.0, 1e-3])
        axis.set_ylim(0.0, 1.1 * float(largest))
        if min_distance_m is None:
            return
        red = {"color": hex_colour(FALSE_POSITIVE_RGB)}
        axis.axhline(min_distance_m, linestyle=(0, (4, 3)), linewidth=1.3, **red)
        place = {"xycoords": ("axes fraction", "data"), "xytext": (0, 4), "textcoords": "offset points"}
        axis.annotate(f"must keep {min_distance_m:g} m", (1.0, min_distance_m), ha="right", fontsize=9, **place, **red)

    shown: dict[str, Callable[[Any], None]] = {"loss": loss}
    if len(terms) > 1:
        shown["loss terms"] = loss_terms
    if np.any(list(multiplier.values())):
        shown["multipliers"] = multipliers
    if np.isfinite(distance_m).any():
        shown["camera distance"] = spacing
    return shown


def _running_mean(value: np.ndarray, *, window: int = 9) -> np.ndarray:
    """Mean over the ``window`` entries around each one, fewer at the ends; NaN entries do not count."""
    value = np.asarray(value, dtype=np.float64)
    half = window // 2
    valid = np.isfinite(value)
    total = np.convolve(np.pad(np.where(valid, value, 0.0), half), np.ones(2 * half + 1), mode="valid")
    count = np.convolve(np.pad(valid.astype(np.float64), half), np.ones(2 * half + 1), mode="valid")
    return np.where(count > 0, total / np.maximum(count, 1.0), math.nan)
