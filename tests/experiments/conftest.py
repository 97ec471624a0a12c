"""What the tests of experiments share."""

import pytest


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Folder that the small experiment's scenes go to; made once a module."""
    return tmp_path_factory.mktemp("scenes") / "street"
