"""Style, spelling and types are tests. The type checker takes a minute of one core, so it is left to full runs."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TOOLS = [
    ("ruff", "check", "."),
    ("ruff", "format", "--check", "."),
    ("typos",),
    pytest.param(("basedpyright", "--pythonpath", sys.executable), marks=pytest.mark.slow),
]


@pytest.mark.parametrize("command", TOOLS, ids=lambda command: command[0] + "-format" * ("format" in command))
def test_tool_finds_nothing(command):
    program = shutil.which(command[0], path=str(Path(sys.executable).parent)) or shutil.which(command[0])
    assert program, f"{command[0]} is not installed: pip install -e '.[dev]'"
    result = subprocess.run([program, *command[1:]], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
