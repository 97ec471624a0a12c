"""How many mutated files are read."""

import pytest

CASES_IN_CI = 2000


def pytest_addoption(parser):
    parser.addoption(
        "--cases", type=int, default=CASES_IN_CI, help="mutated files in all kinds together (with -m nightly)"
    )


@pytest.fixture
def all_cases(request):
    """Cases of all kinds together; the option is known where this folder is named on the command line."""
    return request.config.getoption("--cases", CASES_IN_CI)
