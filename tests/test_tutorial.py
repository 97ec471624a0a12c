"""What the tutorial shows is what its commands print, but for the last digits of numbers."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

TUTORIAL = Path(__file__).parents[1] / "docs" / "tutorial.md"
README = (TUTORIAL.parents[1] / "README.md").read_text()
ELSEWHERE = ("pip ", "python3 ", "warpav doctor", "warpav optimise rig.")
"""Commands that are not run here: an installation, what differs from machine to machine, a second run, a mistake."""


def without_numbers(line):
    """Numbers differ from processor to processor after a hundred steps, and a busy one says minutes."""
    return re.sub(r"\s+", " ", re.sub(r"[-+]?\d[\d.]*", "#", line)).replace("# min ", "# s ").strip()


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


def test_the_readme_shows_lines_of_the_tutorial():
    told, (_, (_, shown)) = TUTORIAL.read_text(), console_of(README)
    assert len([line for line in shown if f"\n{line}\n" in told]) == len(shown) == 8


@pytest.mark.slow
def test_the_code_of_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    [code] = re.findall(r"^```python\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
    exec(code.replace("range(60)", "range(4)").replace("5040", "5006"), {})
    assert (tmp_path / "rig.png").stat().st_size


@pytest.mark.slow
def test_the_tutorial_shows_what_its_commands_print(tmp_path):
    shown = [each for each in console_of(TUTORIAL.read_text()) if not each[0].startswith(ELSEWHERE)]
    assert len(shown) == 5
    for command, lines in shown:
        words = [sys.executable, "-m", "warpav.cli.app", *command.split()[1:]]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True)
        printed = [line for line in done.stdout.splitlines() if line.strip()]
        text, at = " ".join(map(without_numbers, printed)), 0
        for line in lines:
            for piece in without_numbers(line).split("[...]"):  # in order; long sentences are wrapped on the page
                assert piece.strip() in text[at:], f"{command}: not printed: {line}"
                at = text.index(piece.strip(), at)
        told = " ".join(map(without_numbers, lines))
        for line in printed:
            assert without_numbers(line)[:30] in told, f"{command}: the tutorial lacks: {line}"
