"""The CARLA server and the client of the capture tests."""

import pytest

from tests.scene.capture.carla_double import Server, install


@pytest.fixture
def server(monkeypatch):
    """The double, where the package would be."""
    one = Server()
    install(monkeypatch, one)
    return one


@pytest.fixture
def carla():
    """The installed client."""
    return pytest.importorskip("carla")
