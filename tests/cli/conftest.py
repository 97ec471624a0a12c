"""A run that the tests of a module read."""

import pytest

from tests.cli.small_run import SMALL
from warpav.cli.app import main
from warpav.runs.run_folder import RunFolder


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """A small run from its command to its report."""
    out = tmp_path_factory.mktemp("main") / "run"
    assert main(["optimise", *SMALL, f"run.out={out}"]) == 0
    return RunFolder.open(out)
