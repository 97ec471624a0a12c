"""Mutated scenes, vehicles, captures, recorded traffic, networks, run folders and workloads."""

import pytest

from tests.fuzz.harness import fuzz
from tests.fuzz.kinds import LARGE, SMALL

SHARE = 1.0 / (len(SMALL) + len(LARGE))
NAMED = [pytest.param(kind, id=kind.name) for kind in LARGE]


@pytest.mark.parametrize("kind", NAMED)
def test_a_mutated_file_is_read_or_refused(tmp_path, kind, all_cases):
    fuzz(kind, tmp_path, min(15, round(all_cases * SHARE)))


@pytest.mark.nightly
@pytest.mark.parametrize("kind", NAMED)
def test_many_mutated_files_are_read_or_refused(tmp_path, kind, all_cases):
    fuzz(kind, tmp_path, round(all_cases * SHARE), is_random=True)
