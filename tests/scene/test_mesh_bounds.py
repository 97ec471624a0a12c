"""Mesh files that ask for more than they are, and for files of others."""

import time

import pytest

from warpav.core.errors import InputError
from warpav.scene.own_vehicle import read_vehicle_file


def refusal(read, path):
    began = time.process_time()
    with pytest.raises(InputError) as caught:
        read(path)
    assert time.process_time() - began < 5.0
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.obj", "v 0 0 0\n" * 2_000_001),
        ("a.off", "OFF\n1 1 0\n" + "1 " * 600_000),
        ("a.gltf", "[" * 200_000),
        ("a.dae", "<a>" * 40_000),
        ("a.dae", "<!DOCTYPE a [<!ENTITY b 'c'>]><COLLADA>&b;</COLLADA>"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n1\n"),
        ("a.zip", "PK"),
        ("a.zae", "PK"),
    ],
)
def test_vehicles_keep_the_bounds(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    told = refusal(read_vehicle_file, tmp_path / name)
    assert told.startswith(f"{tmp_path / name}: vehicle: expected a ")
