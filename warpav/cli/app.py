"""The command line: one function per verb, which reads its input, calls what does the work, and prints.

Exit status: 0 done, 1 the run failed, 2 the input is wrong, 130 interrupted (143 by SIGTERM, 129 by SIGHUP). Nothing
heavy is imported before a verb needs it, so that ``--help`` and ``config`` answer at once.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from types import FrameType
from typing import TextIO

from cyclopts import App, CycloptsError, Group, MissingArgumentError

from warpav import __version__
from warpav.cli._arguments import complain, flag_of, with_flags
from warpav.cli._checks import bench, config_app, doctor, modules_app
from warpav.cli._detector import detector_app, dev_detector_app
from warpav.cli._experiment import experiment_app
from warpav.cli._rig import rig_app
from warpav.cli._runs import check, compare, evaluate, front, inspect, optimise, plot, render, report, view
from warpav.cli._scenes import dev_scenes_app, scenes_app
from warpav.cli._vehicle import vehicle_app
from warpav.core.cores import own_share, take_share
from warpav.core.errors import ArgumentError, InputError

_GC_THRESHOLD = 50_000
"""New objects between two searches for unreachable ones: with Python's 700 they take a tenth of a short run."""

atexit.register(gc.freeze)  # what is held goes with the process: a last search for cycles would take a second

app = App(
    name="warpav",
    version=__version__,
    help="Find which cameras a vehicle should carry and where, by search with a bound and by gradients.",
    help_epilogue="Options are key=value, such as rig.cameras=6 camera.fov_deg='80 deg'; 'warpav config show' lists "
    "them, with --all every one. --debug shows where an error was raised.",
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)
_dev_app = App(name="dev", help="For developers: the renderer's benchmark, experiments, detectors, thesis figures.")
_dev_app.command(bench)
for _app in (experiment_app, dev_detector_app, dev_scenes_app):
    _dev_app.command(_app)
_GROUPS = {
    "Start": (optimise, evaluate, compare, check, report, front),
    "Look": (inspect, view, plot, render),
    "Inputs": (scenes_app, rig_app, vehicle_app, modules_app, detector_app, config_app),
    "Machine": (doctor, _dev_app),
}
for _order, (_title, _commands) in enumerate(_GROUPS.items()):
    _group = Group(_title, sort_key=_order)
    for _command in _commands:
        if isinstance(_command, App):
            _command.group = _group
            app.command(_command)
        else:
            app.command(_command, group=_group, alias="optimize" if _command is optimise else None)
_DEVELOPERS = (
    *(("bench",), ("experiment",), ("scenes", "figure")),
    *(("detector", "train"), ("detector", "evaluate"), ("detector", "score")),
)
"""Commands that work without the word dev as well."""

app.register_install_completion_command(help="Install completion for bash, zsh or fish.")


def placed(arguments: list[str]) -> list[str]:
    """The words of a command, those of developers below ``dev``."""
    is_moved = any(tuple(arguments[: len(words)]) == words for words in _DEVELOPERS)
    return ["dev", *arguments] if is_moved else arguments


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    arguments = placed(arguments)
    received: list[int] = []
    gc.set_threshold(_GC_THRESHOLD)
    take_share(own_share())  # libraries see the machine's cores, not those of the control group
    _ready_streams()
    try:
        with _as_ctrl_c(received):
            status = app(arguments, exit_on_error=False, print_error=False)
            sys.stdout.flush()
    except (KeyboardInterrupt, OSError) as error:
        if isinstance(error, KeyboardInterrupt) or received:  # with SIGHUP nobody may be there to be told anything
            number = received[0] if received else signal.SIGINT
            with contextlib.suppress(OSError):
                complain("interrupted" + (f" by {signal.Signals(number).name}" if received else ""))
            return 128 + number
        if isinstance(error, BrokenPipeError):  # nobody reads on: not a mistake, and nobody to be told
            _let_go(sys.stdout)
            return 1
        try:
            sys.stdout.flush()
        except OSError:  # what it still holds has no room either
            _let_go(sys.stdout)
        return _failed(error, debug)
    except (InputError, CycloptsError) as error:
        if debug:
            raise
        complain(_text_of(error))
        return 2
    except Exception as error:
        return _failed(error, debug)
    return status if isinstance(status, int) else 0


def _ready_streams() -> None:
    """Make sure that printing is possible: what the encoding does not have is written as an escape sequence of Python.

    What is printed on a stream that is closed goes nowhere, not into the file that is opened next.
    """
    for name, number in (("stdout", 1), ("stderr", 2)):
        stream = getattr(sys, name)
        if stream is None:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, number)
            os.set_inheritable(number, True)
            setattr(sys, name, open(number, "w", encoding="utf-8"))  # noqa: SIM115 (until the process ends)
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _let_go(stream: TextIO) -> None:
    """What a stream still holds goes nowhere; else Python would complain when it ends."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def _failed(error: Exception, debug: bool) -> int:
    """Say what went wrong that nobody expected, in one line; with ``--debug`` it goes on as it is."""
    if debug:
        raise error
    text = " ".join(str(error).split())
    complain(f"failed: {type(error).__name__}: {text}; run again with --debug to see where")
    return 1


@contextlib.contextmanager
def _as_ctrl_c(received: list[int]) -> Iterator[None]:
    """SIGTERM and SIGHUP end the block as Ctrl-C does, where nobody has said that they mean something else."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        del frame
        received.append(number)
        raise KeyboardInterrupt

    numbers = [getattr(signal, name, None) for name in ("SIGTERM", "SIGHUP")]
    taken = [each for each in numbers if each is not None and signal.getsignal(each) == signal.SIG_DFL]
    if threading.current_thread() is not threading.main_thread():  # no other may ask for signals
        taken = []
    for number in taken:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


def _text_of(error: InputError | CycloptsError) -> str:
    """What is wrong with the user's input, in the words of the command line: arguments of functions are flags here."""
    if isinstance(error, CycloptsError):
        return _usage_text(error)
    if not isinstance(error, ArgumentError):
        return with_flags(str(error))
    text, option = with_flags(error.text), error.option or ""
    if "." in option:  # an option of the configuration
        return f"{option}: {text}"
    named = flag_of(option)
    return f"command line ({named}): {text}" if error.place is None else f"{error.place}: {named}: {text}"


def _usage_text(error: CycloptsError) -> str:
    """What is wrong with the words of the command, in one line."""
    text = " ".join(str(error).split())
    text = text if text.endswith("...") else text.removesuffix(".")
    if isinstance(error, MissingArgumentError) and error.argument is not None:
        text = f"{error.argument.name}: expected a value, got none"
    hint = "options of a run are key=value, such as rig.cameras=6; " if text.startswith("Unknown option") else ""
    return f"command line: {text}; {hint}see {' '.join(('warpav', *(error.command_chain or ()), '--help'))}"


if __name__ == "__main__":
    sys.exit(main())
