"""How many cameras, at what cost: the best rig of every number or budget, each selected, polished and judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.errors import ArgumentError, OptionError
from warpav.core.executor import Executor
from warpav.core.files import write_json
from warpav.core.progress import Progress
from warpav.core.table import Table
from warpav.detection import further_gain, missed_probability
from warpav.optimisation import PoolRun, RigLimits, range_text, rows_of, too_near
from warpav.rig import Rig, write_rig
from warpav.runs._evaluate import evaluate_on
from warpav.runs._mounts import check_one_unit, rig_modules
from warpav.runs._optimise import Optimisation, kept_drawing, pool_search_settings, searches_by_pool
from warpav.runs._placement import Placement
from warpav.runs._progress import shown_progress
from warpav.runs._rig_evaluation import RigEvaluation
from warpav.runs.config import AUTO
from warpav.scene import Scene
from warpav.view import Canvas, draws, plot

_MOST_BUDGETS = 8
"""Budgets of a front by cost, at most: evenly spread from the cheapest rig to the dearest."""
FRONT_FILE, FRONT_FIGURE = "front.json", "front.png"
"""What `Front.save` writes beside the rigs."""


@dataclass(frozen=True, eq=False)
class _FrontPoint:
    """The best rig of a number of cameras, or within a budget."""

    name: str
    rig: Rig
    cost: float
    objective: float
    bound: float
    pool_cameras: int
    misses_per_100: float | None = None
    expected_misses_per_100: float | None = None
    is_dominated: bool = False

    @property
    def modules(self) -> dict[str, int]:
        """How many cameras of each module it has; of equal cameras none."""
        names = [camera.module for camera in self.rig.cameras if camera.module is not None]
        return {name: names.count(name) for name in dict.fromkeys(names)}

    def to_json(self) -> dict[str, Any]:
        """As the front's file has it."""
        rig = {"cameras": len(self.rig.cameras), "modules": self.modules}
        numbers = {name: value for name, value in vars(self).items() if name not in ("name", "rig")}
        return {"name": self.name, **rig, **numbers}


@dataclass(frozen=True, eq=False)
class Front:
    """Rigs of rising number or cost, the best of each."""

    points: tuple[_FrontPoint, ...]
    by: str
    scenes: tuple[str, ...] = ()
    evaluation: RigEvaluation | None = field(repr=False, default=None)
    has_requirements: bool = False

    def table(self) -> Table:
        """One row a rig: text when printed, HTML in a notebook."""
        rows = [
            (
                each.name.replace("_", " "),
                str(len(each.rig.cameras)),
                ", ".join(f"{count} {name}" for name, count in each.modules.items()) or "-",
                f"{each.cost:g}",
                f"{100.0 * each.objective:.2f}",
                f"{100.0 * each.bound:.2f}",
                "-" if each.expected_misses_per_100 is None else f"{each.expected_misses_per_100:.2f}",
                "-" if each.misses_per_100 is None else f"{each.misses_per_100:.2f}",
                "dominated" if each.is_dominated else "",
            )
            for each in self.points
        ]
        columns = ("rig", "cameras", "modules", "cost", "seen", "bound", "unseen, expected", "unseen, detector", "")
        seen = "misses and points of the requirements together" if self.has_requirements else "misses"
        where = "on the scenes of the search, where no rig of the pool is below the bound"
        caption = f"Per 100: {seen} {where}; and misses on unseen ones, the detector's at equal false alarms."
        return Table(columns, tuple(rows), caption)

    def save(self, folder: str | Path) -> Path:
        """Write the rigs, one file each, ``front.json`` and ``front.png``."""
        path = Path(folder).expanduser()
        if (path / FRONT_FILE).exists():
            raise ArgumentError(
                "folder", f"expected one without {FRONT_FILE}, got one that has it; give another", place=path
            )
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ArgumentError("folder", f"expected a folder to write to, got: {error.strerror}", place=path) from None
        for each in self.points:
            write_rig(each.rig, path / f"rig_{each.name}.yaml")
        plot(self, out=path / FRONT_FIGURE)
        content = {
            "schema": 1,
            "by": self.by,
            "scenes": {"test": list(self.scenes)},
            "points": [each.to_json() for each in self.points],
            "evaluation": None if self.evaluation is None else self.evaluation.to_json(),
        }
        write_json(path / FRONT_FILE, content)
        return path

    def plot(self, out: str | Path | None = None, **options: Any) -> Any:  # noqa: ANN401
        """Show the front in a notebook or write its image to a file; see `warpav.view.plot`."""
        return plot(self, out=out, **options)

    def __str__(self) -> str:
        return str(self.table())

    def _repr_html_(self) -> str:
        return self.table()._repr_html_()


def front(
    placement: Placement,
    test: Sequence[Scene] | None = None,
    *,
    by: str | None = None,
    progress: bool | Progress | None = None,
    executor: Executor | None = None,
) -> Front:
    """The best rig of every number of cameras, or within every budget. Nothing is written.

    All share one pool of cameras: each search goes on with what those before have rendered, and begins with the rig
    before and the camera that helps it most, so no rig misses more on the scenes of the search than a smaller one.

    Args:
        placement: ``cameras="2..8"`` gives the numbers, ``modules=`` what there is to choose from, and
            ``rig={"max_cost": 12}`` the greatest budget.
        test: Scenes to judge the rigs on, that none was optimised on; None: those of the configuration, and none where
            the placement is made of objects.
        by: ``cameras``: one rig for every number; ``cost``: one for every of some budgets. None: by cost where the
            numbers are not a range.
        progress: As of `warpav.runs._optimise.optimise`.
        executor: Where the pool is drawn; None: here.

    Raises:
        InputError: There is nothing to choose from, the objective is not by a pool, or the limits exclude each other.
    """
    least, most = placement.config.rig.camera_range
    by = ("cost" if least == most else "cameras") if by is None else by
    if by not in ("cameras", "cost"):
        raise ArgumentError("by", f"expected cameras or cost, got {by!r}")
    if placement.parts.freeze:
        names = ", ".join(placement.parts.freeze)
        raise OptionError("rig.freeze", f"expected none, as the rigs have different numbers of cameras, got {names}")
    if by == "cameras" and least == most:
        raise OptionError("rig.cameras", f"expected a range, such as 2..8, got {most}")
    if by == "cost" and placement.config.rig.modules is None:
        raise OptionError("rig.modules", "expected modules with prices for a front by cost, got equal cameras")
    check_one_unit(rig_modules(placement.config) if by == "cost" else ())
    robust = placement.config.robust
    if robust.asked_for is not None:
        text = "expected null, as the rigs of a front are compared by their expected misses"
        raise OptionError(robust.asked_for, f"{text}, got {getattr(robust, robust.asked_for.partition('.')[2])}")
    # its rigs are compared by what they are expected to miss
    plain: dict[str, Any] = {"losses.false_alarms": 0.0}
    if placement.config.requirements == AUTO:
        plain["requirements"] = None
    placement = placement.with_config(placement.config.replace(plain))
    has_requirements = bool(placement.requirements)
    with shown_progress(progress) as shown:
        placement.prepare(shown)
        if not searches_by_pool(placement):
            raise OptionError(
                "optimiser.search", "expected the search by a pool, got a descent; set optimiser.search=pool"
            )
        steps = _by_cost(placement) if by == "cost" else _by_number(placement, least, most)
        points = _searched(placement, steps, shown, executor)
        if test is not None:
            scenes = placement.observed(test, progress=shown)
        else:
            scenes = [] if placement.parts.has_own_scenes else placement.test
        if not scenes:
            return Front(_without_dominated(points), by, has_requirements=has_requirements)
        evaluation = evaluate_on({each.name: each.rig for each in points}, scenes, placement, progress=shown)
    judged = []
    for each in points:
        outage = evaluation.camera_outage[each.name]
        expected = None if outage is None else outage.expected_misses_per_100
        found = evaluation.misses[each.name]
        judged.append(replace(each, misses_per_100=found, expected_misses_per_100=expected))
    return Front(_without_dominated(judged), by, evaluation.scenes, evaluation, has_requirements)


_Step = tuple[str, int, RigLimits | None]
"""Name of a rig, the cameras that it has at most, and its limits."""


def _by_number(placement: Placement, least: int, most: int) -> list[_Step]:
    limits = placement.limits
    return [
        (
            f"{count}_camera{'' if count == 1 else 's'}",
            count,
            None if limits is None else limits.within(count=(count, count)),
        )
        for count in range(least, most + 1)
    ]


def _by_cost(placement: Placement) -> list[_Step]:
    limits = placement.limits
    assert limits is not None, "there are modules"
    low, high = limits.cost_range()
    if not high > low:
        raise OptionError("rig.modules", f"expected modules to choose from, got one rig alone, of cost {low:g}")
    budgets = np.linspace(low, high, _MOST_BUDGETS)
    return [(f"cost_{budget:.4g}", limits.count[1], limits.within(cost_max=float(budget))) for budget in budgets]


def _searched(
    placement: Placement, steps: Sequence[_Step], progress: Progress, executor: Executor | None
) -> list[_FrontPoint]:
    points: list[_FrontPoint] = []
    search: PoolRun | None = None
    for name, count, limits in progress.steps("rigs", steps, count=len(steps)):
        start = None if search is None else _larger(search, count, limits)
        numbers = limits.count if limits is not None else (count, count)
        options: dict[str, object] = {"rig.cameras": numbers[0] if numbers[0] == numbers[1] else range_text(numbers)}
        if limits is not None and limits.cost_max is not None:
            options["rig.max_cost"] = limits.cost_max
        begun = Optimisation.begin(
            placement.with_config(placement.config.replace(options)),
            start=start,
            drawing=kept_drawing(executor),
            pool=pool_search_settings(placement.config),
            known_pool=None if search is None or search.found is None else search.found.pool,
            progress=progress,
        )
        assert isinstance(begun.descent, PoolRun)
        search = begun.descent
        records = []
        while search.stop_reason is None:
            records.append(search.step())
        found = search.finish()
        assert search.found is not None
        rig = placement.mount.rig(found.mount_pose)
        cost = 0.0 if limits is None else limits.cost([camera.module for camera in rig.cameras])
        bounds = [each.bound or 0.0 for each in records if each.stage == "selection"] or [0.0]
        points.append(_FrontPoint(name, rig, cost, found.training_objective, bounds[-1], search.found.pool_cameras))
        progress.say(f"{name.replace('_', ' ')}: expected misses {100.0 * found.training_objective:.2f} per 100")
    return points


def _larger(before: PoolRun, count: int, limits: RigLimits | None) -> np.ndarray | None:
    """A rig to begin with, float32 [camera, 7]: that of a smaller search, and the cameras that help it most.

    None where the limits leave no room for more, or ask for another mix.
    """
    assert before.found is not None
    pool, rig, mount = before.found.pool, before.found.mount_pose, before.task.cameras.mount

    def size(rig: np.ndarray) -> int:
        return len(rig) if limits is None else limits.size(mount.module_of(rig))

    while size(rig) < (count if limits is None else limits.count[0]):
        gain = further_gain(
            missed_probability(pool.detection_probability[rows_of(rig, pool.mount_pose)]),
            pool.detection_probability,
            before.task.whole_weight,
        )
        for camera in np.argsort(-gain, kind="stable"):
            larger = np.concatenate([rig, pool.mount_pose[camera][None]])
            is_part = limits is None or limits.holds(mount.module_of(larger), is_whole=False)
            if is_part and too_near(larger, before.task.constraints).nnz == 0:
                rig = larger
                break
        else:
            return None
    return rig if limits is None or limits.holds(mount.module_of(rig)) else None


def _without_dominated(points: Sequence[_FrontPoint]) -> tuple[_FrontPoint, ...]:
    """The points, those marked that another one beats in all: cameras, cost, and misses in the search."""

    def beats(one: _FrontPoint, other: _FrontPoint) -> bool:
        pair = [(len(each.rig.cameras), each.cost, each.objective) for each in (one, other)]
        return pair[0] != pair[1] and all(a <= b for a, b in zip(*pair, strict=True))

    return tuple(replace(each, is_dominated=any(beats(other, each) for other in points)) for each in points)


@draws(Front, "front", is_figure=True)
def _drawing(found: Front, canvas: Canvas) -> Any:  # noqa: ANN401 (see warpav.view._plotting.Kind)
    from warpav.view import front_figure

    return front_figure([each.to_json() for each in found.points], by=found.by, title=canvas.title)
