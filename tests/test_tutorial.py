"""What the tutorial shows is what its commands print."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

TUTORIAL = Path(__file__).parents[1] / "docs" / "tutorial.md"
ELSEWHERE = ("pip ", "python3 ", "warpav doctor", "warpav optimise rig.")
"""Commands that are not run here: an installation, what differs from machine to machine, a second run, a mistake."""


def without_times(line):
    return re.sub(r"  [0-9.]+ s/it.*|took \d+ s", "", line).rstrip()


def console_of(page):
    """Commands and the lines below them, those of a ``text`` fence being further lines of the command before."""
    shown = []
    for _, text in re.findall(r"^```(console|text)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL):
        for line in text.splitlines():
            if line.startswith("$ "):
                shown.append((line.removeprefix("$ "), []))
            else:
                shown[-1][1].append(line)
    return shown


@pytest.mark.slow
def test_the_tutorial_shows_what_its_commands_print(tmp_path):
    shown = [each for each in console_of(TUTORIAL.read_text()) if not each[0].startswith(ELSEWHERE)]
    assert len(shown) == 4
    for command, lines in shown:
        words = [sys.executable, "-m", "warpav.cli", *command.split()[1:]]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True)
        printed = iter([without_times(line) for line in done.stdout.splitlines()])
        for line in lines:  # some are left out, none is changed
            assert without_times(line) in printed, f"{command}: {line}"
