"""A run that tests read and do not change."""

import pytest

from tests.cli.small_run import SMALL
from warpav.cli.app import main
from warpav.runs.run_folder import RunFolder


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory):
    """A small run from its command to its report."""
    out = tmp_path_factory.mktemp("main") / "run"
    assert main(["optimise", *SMALL, "run.pictures=few", f"run.out={out}"]) == 0
    return RunFolder.open(out)
