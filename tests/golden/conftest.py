"""What a user gets through command line and API, kept as numbers: `golden` compares with ``expected/NAME.json``.

``WARPAV_RECORD=1 pytest tests/golden`` writes the files instead. Tests here import nothing but the public API and
`warpav.cli.app.main`, so that they hold whatever stands inside.
"""

import json
import math
import os
import re
from pathlib import Path

import numpy as np
import pytest

from warpav.cli.app import main

EXPECTED = Path(__file__).parent / "expected"
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def plain(value):
    """Nested lists, dictionaries, texts and numbers of anything, floats to 9 digits."""
    if isinstance(value, dict):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.9g}") if math.isfinite(value) else str(float(value))
    if isinstance(value, np.integer):
        return int(value)
    return value


def differences(got, expected, rtol, atol, place=""):
    """Where two such values differ, as lines."""
    if isinstance(expected, dict) and isinstance(got, dict):
        for key in expected:
            if key not in got:
                yield f"{place}.{key}: gone"
            else:
                yield from differences(got[key], expected[key], rtol, atol, f"{place}.{key}")
    elif isinstance(expected, list) and isinstance(got, list):
        if len(got) != len(expected):
            yield f"{place}: {len(got)} entries, expected {len(expected)}"
        for index, (one, other) in enumerate(zip(got, expected, strict=False)):
            yield from differences(one, other, rtol, atol, f"{place}[{index}]")
    elif isinstance(expected, float) or (isinstance(got, float) and isinstance(expected, int)):
        if not isinstance(got, int | float) or not math.isclose(got, expected, rel_tol=rtol, abs_tol=atol):
            yield f"{place}: {got}, expected {expected}"
    elif got != expected:
        yield f"{place}: {got!r}, expected {expected!r}"


@pytest.fixture
def golden():
    """Compares values with those that are kept; keys may join, none may go."""

    def compare(name, got, *, rtol=1e-6, atol=1e-7):
        path = EXPECTED / f"{name}.json"
        got = plain(got)
        if os.environ.get("WARPAV_RECORD"):
            path.write_text(json.dumps(got, indent=None, separators=(",", ":"), sort_keys=True) + "\n")
        found = list(differences(got, json.loads(path.read_text()), rtol, atol))
        assert not found, "\n".join(found[:20])

    return compare


@pytest.fixture
def warpav(capsys):
    """Runs a command in this process: its exit status, what it printed, what it complained of."""

    def run(*argv):
        capsys.readouterr()
        status = main([str(each) for each in argv])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run


def numbers(text):
    """All numbers of a text, in order."""
    return [float(each) for each in NUMBER.findall(text)]
