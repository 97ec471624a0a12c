"""What is printed on the terminal, all of rich but the live display: text is shown, none of it is obeyed.

Names come from files. In a cell, a title or a line they may hold escape sequences, ends of lines or rich's markup; here
they come out as they are written. A test refuses other imports of rich.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from rich import box
from rich import table as rich_table
from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.measure import Measurement
from rich.segment import Segment
from rich.text import Text

from warpav.core.errors import one_line, printable
from warpav.core.table import Table

__all__ = ["Group", "RenderableType", "Terminal", "TerminalTable", "drawn", "shown"]


def shown(text: str, style: str = "") -> Text:
    """A text in one line, as it is; what standard output cannot encode is written as an escape sequence of Python."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    return Text(one_line(text).encode(encoding, "backslashreplace").decode(encoding), style)


class TerminalTable(rich_table.Table):
    """A table of texts, the first column to the left."""

    def __init__(self, title: str = "", *, has_frame: bool = True) -> None:
        frame: dict[str, Any] = {} if has_frame else {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0)}
        heading = shown(title, "table.title") if title else None
        super().__init__(title=heading, title_justify="left", header_style="bold", **frame)

    def add_column(self, header: RenderableType = "", *rest: Any, **style: Any) -> None:  # noqa: ANN401 (rich's own)
        super().add_column(shown(header) if isinstance(header, str) else header, *rest, **style)

    def add_row(self, *cells: RenderableType | None, **style: Any) -> None:  # noqa: ANN401 (rich's own)
        super().add_row(*(shown(cell) if isinstance(cell, str) else cell for cell in cells), **style)


class Terminal(Console):
    """A console without markup, emojis and highlights, whose texts a terminal cannot obey, wherever they come from."""

    def __init__(self, **options: Any) -> None:  # noqa: ANN401 (rich's own)
        super().__init__(markup=False, emoji=False, highlight=False, force_jupyter=False, **options)

    def width_of(self, renderable: RenderableType) -> int:
        """How many columns something takes if nothing of it is cut or wrapped, even if the console has fewer."""
        wide = self.options.update(max_width=10_000)
        return Measurement.get(self, wide, renderable).maximum

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """What something consists of."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(printable(segment.text), segment.style)


def drawn(table: Table, *, has_frame: bool = False) -> Group:
    """A table for the console, numbers to the right, and its caption below."""
    found = TerminalTable(has_frame=has_frame)
    for k, name in enumerate(table.columns):
        style = "bold" if name == "found" else None
        side = "right" if k else "left"
        found.add_column(name, no_wrap=has_frame and not k, justify=side, overflow="fold", style=style)
    for row in table.rows:
        found.add_row(*row)
    return Group(found, *([shown(table.caption)] if table.caption else []))
