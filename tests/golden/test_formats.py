"""Rig files of other tools: what is written, to 1e-9, and that reading it gives the rig back."""

import numpy as np
import pytest

import warpav as wa
from tests.golden.conftest import numbers

RIG = wa.Rig(
    tuple(
        wa.Camera(name, np.array(position), yaw, pitch, roll, wa.CameraModel(width, height, fov))
        for name, position, yaw, pitch, roll, width, height, fov in (
            ("front", [1.6, 0.05, 1.55], 0.02, 0.1, 0.0, 1920, 1080, 1.2),
            ("left", [1.0, 0.7, 1.5], 1.5, 0.2, 0.03, 1280, 960, 1.9),
            ("rear", [-0.6, 0.0, 1.4], 3.1, 0.15, -0.02, 640, 480, 1.6),
        )
    )
)
ORIGIN = {"origin_m": (0.2, 0.0, 0.4)}
FORMATS = (
    *("nuscenes", "argoverse2", "urdf", "opencv", "alpasim", "kitti", "carla-ros-bridge"),
    *("carla-python", "autoware", "camera-info"),
)
ASKED_ORIGIN = {"carla-ros-bridge", "carla-python", "autoware", "opencv", "kitti", "urdf", "alpasim"}
ONLY_OUT = {"camera-info"}


def exported(format_, folder):
    """The files that a format writes of the rig, and where."""
    out = folder / f"rig_{format_}"
    wa.export_rig(RIG, format_, out, approximate=True, **(ORIGIN if format_ in ASKED_ORIGIN else {}))
    return out, sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_written(name, tmp_path, golden):
    _, files = exported(name, tmp_path)
    found = {
        str(path.relative_to(tmp_path)): numbers(path.read_text())
        for path in files
        if path.suffix != ".jpg" and path.suffix != ".feather"
    }
    golden(f"format_{name}", found, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", [name for name in FORMATS if name not in ONLY_OUT])
def test_what_is_read_back(name, tmp_path):
    out, files = exported(name, tmp_path)
    back = wa.import_rig(out if out.exists() else files[0], name, **(ORIGIN if name in ASKED_ORIGIN else {}))
    assert len(back.cameras) == len(RIG.cameras)
    for camera, again in zip(RIG.cameras, sorted(back.cameras, key=lambda each: each.name), strict=True):
        np.testing.assert_allclose(again.ego_from_camera, camera.ego_from_camera, atol=1e-5)
        assert (again.model.width_px, again.model.height_px) == (camera.model.width_px, camera.model.height_px)
        assert again.model.fov_rad == pytest.approx(camera.model.fov_rad, abs=1e-5)


def test_a_rig_yaml_is_written_and_read(tmp_path, golden):
    wa.write_rig(RIG, tmp_path / "rig.yaml")
    golden("rig_yaml", numbers((tmp_path / "rig.yaml").read_text()), rtol=1e-9, atol=1e-9)
    for camera, again in zip(RIG.cameras, wa.read_rig(tmp_path / "rig.yaml").cameras, strict=True):
        np.testing.assert_allclose(again.ego_from_camera, camera.ego_from_camera, atol=1e-6)


@pytest.mark.parametrize("name", ["nuscenes", "argoverse2"])
def test_a_preset(name, golden):
    rig = wa.preset(name)
    golden(f"preset_{name}", {each.name: [*each.position_m, each.yaw_rad, each.pitch_rad] for each in rig.cameras})
