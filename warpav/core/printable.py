"""Text from files, made safe for a terminal."""

from __future__ import annotations

import re

# control characters but tabs and ends of lines, other ends of lines, marks that turn the direction of writing, halves
# of characters
_UNFIT = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    """The text, where what a terminal would obey instead of show is written as an escape sequence of Python."""
    return _UNFIT.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def one_line(text: str) -> str:
    """`printable` text whose ends of lines are shown as well: a name in it cannot begin a line of its own."""
    return printable(text).replace("\n", "\\n")
