"""A table of texts, for Markdown and for the console."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from warpav.runs.terminal import Group, TerminalTable, shown


@dataclass(frozen=True)
class TextTable:
    """A table; the first column is to the left, numbers to the right."""

    title: str
    headings: Sequence[str]
    lines: Sequence[Sequence[str]]
    note: str

    def markdown(self) -> str:
        """The table as Markdown."""
        rule = ["---", *["---:"] * (len(self.headings) - 1)]
        rows = [_markdown_row(cells) for cells in (self.headings, rule, *self.lines)]
        return "\n".join([f"**{self.title}**", "", *rows, "", self.note, ""])

    def terminal(self) -> Group:
        """The table for the console."""
        table = TerminalTable(has_frame=False)
        for k, heading in enumerate(self.headings):
            table.add_column(heading, justify="right" if k else "left", overflow="fold")
        for cells in self.lines:
            table.add_row(*cells)
        return Group(shown(self.title, "bold"), table, shown(self.note), shown(""))


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
