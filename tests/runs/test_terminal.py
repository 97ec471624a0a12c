"""What names hold is shown on the terminal, not obeyed."""

import io
import sys

import pytest
from rich.table import Table

from warpav.runs import TerminalTable
from warpav.runs._terminal import Group, Terminal, shown

NAME = "e\x1b[31mvil\r\nEVIL [bold]x[/bold] [/] :car: \x07"
VISIBLE = "e\\x1b[31mvil\\r\\nEVIL [bold]x[/bold] [/] :car: \\x07"


def _printed(content, **options):
    stream = io.StringIO()
    Terminal(file=stream, width=200, **options).print(content)
    return stream.getvalue()


@pytest.mark.parametrize("is_terminal", [False, True])
def test_names_in_a_table_are_cells_of_one_line(is_terminal):
    table = TerminalTable(NAME)
    table.add_column(NAME)
    table.add_column(f"{NAME} again", justify="right")
    table.add_row(NAME, "1")
    text = _printed(table, force_terminal=is_terminal, color_system="truecolor" if is_terminal else None)
    lines = text.splitlines()
    assert [line.count(VISIBLE) for line in lines] == [1, 0, 2, 0, 1, 0]
    assert "\x1b[31m" not in text
    assert "\x07" not in text
    if not is_terminal:
        assert len(set(map(len, lines[1:]))) == 1


def test_a_table_of_somebody_else_obeys_nothing_either():
    table = Table(NAME)
    table.add_row(NAME)
    text = _printed(Group(table, NAME, "[bold]"))
    assert not set(text) & {"\x1b", "\r", "\x07"}
    assert "[bold]" in text


def test_a_line_is_one_line():
    assert _printed(shown(NAME)) == f"{VISIBLE}\n"


def test_what_cannot_be_encoded_is_written_out_and_the_table_stays_straight(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    table = TerminalTable("Größe")
    table.add_column("Höhe °")
    table.add_row("weiß")
    Terminal(width=80).print(table)
    stream.flush()
    lines = stream.buffer.getvalue().decode("ascii").splitlines()
    assert lines[0].strip() == "Gr\\xf6\\xdfe"
    assert lines[2] == "| H\\xf6he \\xb0 |"
    assert len(set(map(len, lines[1:]))) == 1
