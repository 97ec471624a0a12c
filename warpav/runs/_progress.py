"""What a run shows while it goes: a live table in a terminal, plain lines when piped."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, TypeVar

from rich import progress as progress_bar
from rich.live import Live
from rich.measure import Measurement
from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from warpav.core.progress import NullProgress, Progress
from warpav.runs._terminal import Group, RenderableType, Terminal, shown

if TYPE_CHECKING:
    from rich.progress import TaskID

_Item = TypeVar("_Item")
_Record = TypeVar("_Record")

_ONLY_LIVE = ("multiplier ", "gradient ")  # rows that plain lines leave out; events.jsonl has them
REFRESH_PER_SECOND = 4
_PLAIN_LINES_PER_STAGE, _BRIEF_LINES = 10, 4
_BRIEF_STAGES = {"start": "start", "selection": "selected", "settled": "polished"}


class RunDisplay:
    """Shows the stages of a run and its iterations; a context manager.

    Unless ``verbose`` a pipe gets what was found alone, with the time, as a terminal does below its bars.
    """

    def __init__(self, console: Terminal | None = None, *, verbose: bool = True) -> None:
        self._verbose, self._began = verbose, time.perf_counter()
        # in a notebook, and below one, which sets FORCE_COLOR, nothing can be redrawn either
        self.console = console or Terminal(soft_wrap=True, force_terminal=sys.stdout.isatty())
        self._bar = progress_bar.Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=32),
            MofNCompleteColumn(),
            TextColumn("{task.fields[speed]}"),
            TimeRemainingColumn(),
            console=self.console,
        )
        self._numbers: Table | None = None
        self._task: TaskID | None = None
        self._live = Live(
            console=self.console, refresh_per_second=REFRESH_PER_SECOND, transient=True, get_renderable=self._render
        )

    def __enter__(self) -> RunDisplay:
        if self.console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self.console.is_terminal:
            self._live.stop()

    def say(self, text: str) -> None:
        """Print a line above the table."""
        when = "" if self._verbose else f"[{time.perf_counter() - self._began:4.0f} s] "
        self.console.print(shown(f"{when}{text}"))

    def show(self, content: RenderableType) -> None:
        """Print tables and text within the terminal's width, or where output is piped as wide as they are."""
        console = self.console
        if not console.is_terminal:
            wide = console.options.update(width=1000)
            width = Measurement.get(console, wide, content).maximum
            console = Terminal(file=console.file, width=width, force_terminal=False)
        console.print(content, soft_wrap=False)

    def stage(self, description: str) -> None:
        """Show that something without countable steps begins."""
        self._start(description, None)

    def steps(self, description: str, items: Iterable[_Item], *, count: int) -> Iterator[_Item]:
        """Pass ``items`` on and show how many of ``count`` have come."""
        self._start(description, count)
        every = max(1, count // _PLAIN_LINES_PER_STAGE) if count > _PLAIN_LINES_PER_STAGE else count
        began = time.perf_counter()
        for number, item in enumerate(items, start=1):
            self._advance(number, (time.perf_counter() - began) / number)
            if self._is_told and number % every == 0 and number < count:
                left_s = (time.perf_counter() - began) / number * (count - number)
                self.say(f"{description}: {number}/{count}  {left_s:.0f} s left")
            yield item

    def iterations(self, records: Iterable[_Record], *, count: int | None, min_spacing_m: float) -> Iterator[_Record]:
        """Pass the records of an optimisation on and show their numbers."""
        if count is None:
            yield from self._states(records, min_spacing_m)
            return
        self._start("optimising", count)
        every = max(1, count // (_PLAIN_LINES_PER_STAGE if self._verbose else _BRIEF_LINES))
        began = time.perf_counter()
        for taken, record in enumerate(records, start=1):
            speed = (time.perf_counter() - began) / taken
            number = getattr(record, "iteration", taken - 1) + 1  # a run that goes on does not begin with the first
            rows = iteration_rows(record, min_spacing_m=min_spacing_m)
            self._advance(number, speed)
            if not self.console.is_terminal and (number % every == 0 or number in (1, count) or taken == 1):
                left_s = speed * (count - number)
                text = "  ".join(f"{name} {rows[name]}" for name in rows if not name.startswith(_ONLY_LIVE))
                self.say(f"iteration {number}/{count}  {text}  {speed:.2f} s/it  {left_s:.0f} s left")
            self._numbers = _grid(rows)
            yield record
        self._numbers = None

    def _states(self, records: Iterable[_Record], min_spacing_m: float) -> Iterator[_Record]:
        """Those of a search by a pool; lines have the last state of each stage, or briefly the first and the last."""
        self._start("searching", None)
        last: dict[str, str] = {}
        told = set[str]()

        def tell(rows: dict[str, str], *, is_last: bool = False) -> None:
            stage = rows["done"]
            if self._verbose and not self.console.is_terminal:
                self.say("  ".join(f"{name} {value}" for name, value in rows.items()))
            elif not self._verbose and (is_last or (stage in _BRIEF_STAGES and stage not in told)):
                bound = f"  bound {rows['bound']}" if stage == "selection" else ""
                words = _BRIEF_STAGES.get("settled" if is_last else stage, stage)
                self.say(f"{words:<12} objective {rows['objective']}{bound}")
            told.add(stage)

        try:
            for number, record in enumerate(records, start=1):
                rows = iteration_rows(record, min_spacing_m=min_spacing_m)
                if self._task is not None:  # what the search has said that it does
                    self._bar.update(self._task, completed=number, total=None)
                if last and rows["done"] != last["done"]:
                    tell(last)
                last, self._numbers = rows, _grid(rows)
                if rows["done"] == "start":  # there is but one, and the pool is drawn next, which takes long
                    tell(rows)
                    last = {}
                yield record
        finally:  # an interrupted search has come to something, too
            self._numbers = None
            if last:
                tell(last, is_last=True)

    @property
    def _is_told(self) -> bool:
        return self._verbose and not self.console.is_terminal

    def _start(self, description: str, count: int | None) -> None:
        if self._task is not None:
            self._bar.remove_task(self._task)
        self._task = self._bar.add_task(shown(description).plain, total=count, speed="")
        if self._is_told:
            self.say(description if count is None else f"{description}: {count}")

    def _advance(self, number: int, speed: float) -> None:
        if self._task is not None:
            self._bar.update(self._task, completed=number, speed=f"{speed:.2f} s/it" if number > 1 else "")

    def _render(self) -> RenderableType:
        return Group(self._bar, self._numbers) if self._numbers is not None else self._bar


@contextlib.contextmanager
def shown_progress(progress: bool | Progress | None) -> Iterator[Progress]:
    """What a job reports to: a display for True, nothing for False and None, else the object itself."""
    if progress is True:
        with RunDisplay() as display:
            yield display
    elif progress is None or progress is False:
        yield NullProgress()
    elif callable(getattr(progress, "steps", None)):
        yield progress
    else:
        raise TypeError(f"progress: expected True, False or an object with the Progress protocol, got {progress!r}")


def iteration_rows(record: object, *, min_spacing_m: float) -> dict[str, str]:
    """The numbers of one iteration as text by name: loss, terms, multipliers, gradient norms, spacing."""
    spacing_m = getattr(record, "min_camera_distance_m", None)
    closest = {"closest cameras": f"{_number(spacing_m)} m (limit {min_spacing_m:g} m)"}
    if getattr(record, "stage", None) is not None:
        bound, pool_cameras = getattr(record, "bound", None), getattr(record, "pool_cameras", None)
        return {
            "done": str(getattr(record, "stage", None)),
            "objective": _number(getattr(record, "best_training_objective", None)),
            "bound": "-" if bound is None else f"{_number(bound)} (of any rig of the {pool_cameras} candidate cameras)",
            "camera renders": str(getattr(record, "camera_renders", None)),
            **closest,
        }
    terms, multipliers = getattr(record, "terms", {}), getattr(record, "multipliers", {})
    # inequalities with room to spare and nothing to push are many, and say nothing
    idle = {name for name, value in multipliers.items() if not value and terms.get(name, 0.0) < 0.0}
    return {
        "loss": _number(getattr(record, "loss", None)),
        **{name: _number(value) for name, value in terms.items() if name not in idle},
        **{f"multiplier {name}": _number(value) for name, value in multipliers.items() if name not in idle},
        **{f"gradient {name}": _number(value) for name, value in getattr(record, "gradient_norm", {}).items()},
        **closest,
        "best on all scenes": _number(getattr(record, "best_training_objective", None)),
    }


def _grid(rows: Mapping[str, str]) -> Table:
    grid = Table.grid(padding=(0, 2))
    for name, value in rows.items():
        grid.add_row(shown(f"  {name}"), shown(value))
    return grid


def _number(value: float | None) -> str:
    return "-" if value is None else f"{float(value):.4g}"
