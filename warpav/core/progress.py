"""What a long job reports while it runs: the protocol, and the one that shows nothing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Protocol, TypeVar

_Item = TypeVar("_Item")
_Record = TypeVar("_Record")


class Progress(Protocol):
    """Receives what a long job reports.

    `steps` and `iterations` wrap what a job loops over: they pass every item on unchanged and in order.
    """

    def say(self, text: str) -> None:
        """A line worth reading: a file that was written, a surprise."""
        ...

    def show(self, content: Any) -> None:  # noqa: ANN401 (whatever rich prints)
        """A table or text of rich, the result of a job whose result is a table."""
        ...

    def stage(self, description: str) -> None:
        """Something without countable steps begins."""
        ...

    def steps(self, description: str, items: Iterable[_Item], *, count: int) -> Iterator[_Item]:
        """Something of ``count`` steps begins; one item for each."""
        ...

    def iterations(self, records: Iterable[_Record], *, count: int | None, min_spacing_m: float) -> Iterator[_Record]:
        """An optimisation begins.

        Args:
            records: `warpav.optimisation._records.IterationRecord`, one after each iteration.
            count: Iterations planned; None: nobody knows how many there will be.
            min_spacing_m: Least distance allowed between two cameras [m], to be shown beside the actual one.
        """
        ...


class NullProgress:
    """Shows nothing."""

    def say(self, text: str) -> None:
        del text

    def show(self, content: Any) -> None:  # noqa: ANN401
        del content

    def stage(self, description: str) -> None:
        del description

    def steps(self, description: str, items: Iterable[_Item], *, count: int) -> Iterator[_Item]:
        del description, count
        yield from items

    def iterations(self, records: Iterable[_Record], *, count: int | None, min_spacing_m: float) -> Iterator[_Record]:
        del count, min_spacing_m
        yield from records
