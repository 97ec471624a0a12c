"""Runs that tests read and do not change, each made once a session, when it is first asked for."""

import pytest

from tests.cli.small_run import RUNS, SMALL
from warpav.cli.app import main
from warpav.runs import RunFolder


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory):
    """A small run from its command to its report, with the pictures of a first page."""
    out = tmp_path_factory.mktemp("main") / "run"
    assert main(["optimise", *SMALL, "run.pictures=few", f"run.out={out}"]) == 0
    return RunFolder.open(out)


@pytest.fixture(scope="session")
def at_once(tmp_path_factory):
    """The folders of small runs without pictures by their names."""
    runs = {}

    def run(name):
        if name not in runs:
            runs[name] = tmp_path_factory.mktemp(name.replace(" ", "_")) / "run"
            assert main(["optimise", *RUNS[name][1], f"run.out={runs[name]}"]) == 0
        return runs[name]

    return run
