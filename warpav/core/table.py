"""Tables: that print as text and show themselves in a notebook, and of pandas."""

from __future__ import annotations

import html
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas  # pyright: ignore[reportMissingImports]


def aligned(rows: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> list[str]:
    """Rows as lines of text in columns; some are aligned on the left, the others on the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if k in left else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


@dataclass(frozen=True)
class Table:
    """A table that prints as text and shows itself in a notebook."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""

    def __str__(self) -> str:
        head, *lines = aligned([self.columns, *self.rows])
        return "\n".join([head, "-" * len(head), *lines, *([self.caption] if self.caption else [])])

    @classmethod
    def of(cls, columns: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "") -> Table:
        return cls(tuple(columns), tuple(map(tuple, rows)), caption)

    def markdown(self) -> str:
        rule = ["---", *["---:"] * (len(self.columns) - 1)]
        lines = [" | ".join(cell.replace("|", "\\|") for cell in row) for row in (self.columns, rule, *self.rows)]
        return "\n".join([*(f"| {line} |" for line in lines), "", *([self.caption, ""] if self.caption else [])])

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{html.escape(name)}</th>" for name in self.columns)
        body = "".join(
            f"<tr><th style='text-align:left'>{html.escape(row[0])}</th>"
            + "".join(f"<td style='text-align:right'>{html.escape(cell)}</td>" for cell in row[1:])
            + "</tr>"
            for row in self.rows
        )
        caption = f"<caption style='caption-side:bottom'>{html.escape(self.caption)}</caption>" if self.caption else ""
        return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def data_frame(rows: Mapping[Any, Mapping[str, Any]]) -> pandas.DataFrame:
    """A table of pandas: a row for each key, which is its index, with columns by name."""
    try:
        import pandas  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ImportError("to_pandas needs pandas; run: pip install pandas") from None
    return pandas.DataFrame.from_dict(dict(rows), orient="index")
