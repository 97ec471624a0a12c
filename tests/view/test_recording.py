"""Recordings for Rerun, read back by its own SDK: entities, poses, pinholes, images, the timeline of a run."""

import io
import itertools
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import warpav
from tests.driving_scene import flat_surface
from tests.view.stand_ins import needs_opengl, rig, scene, vehicle
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.detection import render
from warpav.raster.camera import CameraModel
from warpav.rig import Rig, RigCamera
from warpav.view import own_body_tinted, run_animation, write_recording
from warpav.view._palette import camera_rgb
from warpav.view._recording import _TIMELINE, _shown_iterations

FISHEYE = RigCamera(
    "wide", np.array([1.0, 1.0, 1.0]), 1.5, 0.3, 0.0, CameraModel(128, 96, math.radians(190.0), lens="fisheye")
)


def rows_of(path):
    """Every component of every entity: its values in order of time, and the times (None where it is static)."""
    reader = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed").RrdReader(path)
    found = {}
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        times = batch.column(_TIMELINE).to_pylist() if _TIMELINE in batch.schema.names else [None] * batch.num_rows
        for name in batch.schema.names:
            for time, value in zip(times, batch.column(name).to_pylist(), strict=True):
                found.setdefault((chunk.entity_path.lstrip("/"), name), []).append((time, value))
    return {key: sorted(rows, key=lambda row: row[0] or 0) for key, rows in found.items() if key[1] != _TIMELINE}


def test_a_rig_is_there_with_images_meshes_and_boxes(tmp_path):
    pytest.importorskip("rerun")
    cameras = Rig([*rig(2).cameras, FISHEYE])
    around = scene(vehicle(7, 12.0, 3.0))
    path = write_recording(tmp_path / "new" / "rig.rrd", cameras, around)
    rows = rows_of(path)
    entities = {entity for entity, _ in rows}
    assert {"vehicle", "scene/environment", "scene/saloon_7", "box/saloon_7", "rig/wide/frustum"} <= entities
    assert "rig/wide/image" not in entities  # the viewer has no fisheye
    for camera in cameras.cameras:
        [(time, [place])] = rows[f"rig/{camera.name}", "Transform3D:translation"]
        assert time is None
        np.testing.assert_allclose(place, camera.position_m, atol=1e-6)
        [(_, [matrix])] = rows[f"rig/{camera.name}", "Transform3D:mat3x3"]
        np.testing.assert_allclose(np.reshape(matrix, (3, 3)).T, camera.ego_from_camera[:3, :3], atol=1e-6)
    [(_, [matrix])] = rows["rig/cam_0/image", "Pinhole:image_from_camera"]
    np.testing.assert_allclose(np.reshape(matrix, (3, 3)).T, cameras.cameras[0].model.intrinsics, rtol=1e-6)
    [(_, [half_m])] = rows["box/saloon_7", "Boxes3D:half_sizes"]
    np.testing.assert_allclose(half_m, 0.5 * around.vehicles[0].box.size_m)
    seen = render(cameras, around, supersampling=2)
    for entity, name in (("rig/cam_0/image", "cam_0"), ("image/wide", "wide")):
        [(_, [data])] = rows[entity, "EncodedImage:blob"]
        shown = np.asarray(Image.open(io.BytesIO(bytes(data))), float)
        assert (
            np.abs(shown - own_body_tinted(seen[name].rgb, seen[name].object_index)).mean() < 2.0
        )  # worst seen 0.4: JPEG
        assert seen[name].rgb.std() > 5.0


def test_iterations_are_a_timeline(tmp_path):
    pytest.importorskip("rerun")
    start, middle, end = (rig(1, fov_deg) for fov_deg in (60.0, 70.0, 80.0))
    path = write_recording(tmp_path / "run.rrd", end, scene(), frames=[start, middle], loss=[3.0, math.nan])
    rows = rows_of(path)
    pinholes = rows["rig/cam_0/image", "Pinhole:image_from_camera"]
    assert [time for time, _ in pinholes] == [0, 1, 2]
    for (_, [matrix]), frame in zip(pinholes, (start, middle, end), strict=True):
        assert matrix[0] == pytest.approx(frame.cameras[0].model.intrinsics[0, 0], rel=1e-6)
    assert rows["loss", "Scalars:scalars"] == [(0, [3.0])]
    [images] = [rows[key] for key in rows if key[0] == "rig/cam_0/image" and key[1].startswith("EncodedImage:blob")]
    assert [time for time, _ in images] == [2]  # what the rig at the end sees


SOCKETS = """
import sys
from pathlib import Path
sys.path.insert(0, str(Path({root!r})))
from tests.view.stand_ins import rig, scene
from warpav.view import write_recording
import os
write_recording({path!r}, rig(1), scene())
handles = {{os.readlink(each) for each in Path("/proc/self/fd").iterdir() if each.is_symlink()}}
ours = {{handle[8:-1] for handle in handles if handle.startswith("socket:")}}
internet = {{line.split()[9] for name in ("tcp", "tcp6", "udp", "udp6")
    for line in Path("/proc/self/net", name).read_text().splitlines()[1:]}}
print(len(ours & internet))
"""


@pytest.mark.skipif(not Path("/proc/self/net/tcp").is_file(), reason="no /proc to list sockets of")
def test_writing_opens_no_connection_and_leaves_no_settings(tmp_path):
    pytest.importorskip("rerun")
    code = SOCKETS.format(root=str(Path(warpav.__file__).parents[1]), path=str(tmp_path / "a.rrd"))
    home = tmp_path / "home"
    home.mkdir()
    kept = {name: value for name, value in os.environ.items() if not name.startswith("XDG_")}
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env={**kept, "HOME": str(home)}
    )
    assert result.stdout.split() == ["0"]
    assert [file for file in home.rglob("*") if "rerun" in str(file)] == []  # analytics would keep an identity there


def test_without_the_sdk_it_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=r'a\.rrd: a recording for Rerun needs .*pip install "warpav\[rerun\]"'):
        write_recording(tmp_path / "a.rrd", rig(), scene())
    assert main(["inspect", "nuscenes", "--out", str(tmp_path / "a.rrd")]) == 2
    assert "a recording for Rerun needs the module rerun" in capsys.readouterr().err


def test_a_recording_shows_the_rig_alone(tmp_path, capsys):
    assert main(["inspect", "nuscenes", "--show", "coverage", "--out", str(tmp_path / "a.rrd")]) == 2
    assert "expected a recording alone, got 'coverage' as well" in capsys.readouterr().err


# ---- animations

FLAT = flat_surface([-1.0, -1.0], [3.0, 1.0], height_m=1.5)
EVENT = {
    "iteration": 0,
    "loss": 0.5,
    "positions_m": [[2.1, 0.0, 1.58], [0.5, 0.0, 1.58]],
    "yaw_deg": [0.0, 180.0],
    "gradient": {"position_per_m": [[0.0, -4.0], [2.0, 0.0]], "yaw_per_rad": [-0.1, 0.05]},
}


def test_long_runs_are_thinned():
    assert _shown_iterations(3) == [0, 1, 2]
    shown = _shown_iterations(1000)
    assert (len(shown), shown[0], shown[-1]) == (60, 0, 999)
    assert set(np.diff(shown)) <= {16, 17, 18}


@needs_opengl
def test_an_animation_moves(tmp_path):
    events = [dict(EVENT, iteration=k, best_training_objective=1.0 / (k + 1)) for k in range(3)]
    animation = run_animation(
        [rig(2, fov_deg=60.0 + 10.0 * k) for k in range(3)],
        events,
        end=rig(2),
        scene=scene(vehicle(1, 9.0, 3.0)),
        surface=FLAT,
        window_size=(320, 200),
    )
    images = list(animation.image_rgb)
    assert len(images) == animation.count == 4
    assert all(image.shape == (200, 320, 3) for image in images)
    for image in images:  # the names of the cameras in their colours, lower left
        names = image[150:, :80].astype(int).reshape(-1, 3)
        for index in range(2):
            assert (np.abs(names - camera_rgb(index)).max(axis=1) < 60).sum() > 20
    for one, other in itertools.pairwise(images):
        assert np.abs(one.astype(int) - other).max() > 60
