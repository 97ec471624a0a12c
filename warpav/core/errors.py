"""The one exception that means: the user's input is wrong, and here is how to fix it."""

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


class InputError(ValueError):
    """The user's input cannot be used.

    The text is one line that says where it stands (file and line, or the override), which field, what was expected,
    what came, and how to fix it; where there are several mistakes, one line for each. The command line prints it
    without a traceback and leaves with status 2.
    """

    def __init__(self, *lines: str) -> None:
        """The error, one line a mistake; what a terminal would obey, ends of lines among it, is shown instead."""
        super().__init__(*map(one_line, lines))

    def __str__(self) -> str:
        return "\n".join(self.args)


class WriteError(InputError):
    """A file cannot be written: the disk is full, the folder is gone, or nobody may write there."""


class OptionError(InputError):
    """The value of one option turns out not to fit once it is used; its text begins with the option's name."""

    def __init__(self, option: str, text: str) -> None:
        """The error; ``text`` says what was expected, what came, and how to fix it."""
        super().__init__(f"{option}: {text}")
        self.option = option


class ArgumentError(InputError):
    """An argument of a function cannot be used; its text begins with the argument's name.

    Arguments that the text speaks of stand in backquotes, so that the command line can call them as it does.
    """

    def __init__(self, option: str, text: str, *, place: object = None) -> None:
        self.option, self.text = option, one_line(text)
        self.place = None if place is None else one_line(str(place))
        super().__init__(f"{'' if place is None else f'{place}: '}{option}: {text}")


def install_text(extra: str) -> str:
    """How to install an extra of warpav, as the end of an error; in quotes that every shell takes."""
    return f'run: pip install "warpav[{extra}]"'


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that a device has not the memory that was asked for; Warp has no class for it."""
    text = str(error).lower()
    return isinstance(error, RuntimeError) and ("failed to allocate" in text or "out of memory" in text)
