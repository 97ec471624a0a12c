"""Style, spelling and types are tests: what is red here is red in every run."""

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
    ("basedpyright", "--pythonpath", sys.executable),
]


@pytest.mark.parametrize("command", TOOLS, ids=lambda command: command[0] + "-format" * ("format" in command))
def test_tool_finds_nothing(command):
    program = shutil.which(command[0], path=str(Path(sys.executable).parent)) or shutil.which(command[0])
    assert program, f"{command[0]} is not installed: pip install -e '.[dev]'"
    result = subprocess.run([program, *command[1:]], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
