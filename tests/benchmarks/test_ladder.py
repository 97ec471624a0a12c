"""The ladder: W2 for more and more views of finer and finer scenes, each rung in a process of its own.

``pytest -m slow -s tests/benchmarks/test_ladder.py`` prints the rungs. The scenes are those of the outside
``workload.py`` where WARPAV_TEST_WORKLOADS names its folder, else the embedded scene, and the same with every triangle
cut into four, once and twice.
"""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import nnls

from warpav.experiments.bench.workload import embedded_workload

VIEWS = (8, 16, 64, 256, 1024)
FULL_CHUNK = 64  # views; memory is flat from here on


def subdivided(vertex, rgb, triangle):
    """Every triangle cut into four at the middles of its sides; the middles come last, without repeats."""
    side = np.sort(triangle[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    side, of = np.unique(side, axis=0, return_inverse=True)
    ab, bc, ca = (of.reshape(-1, 3) + len(vertex)).T
    a, b, c = triangle.T
    fine = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return np.r_[vertex, vertex[side].mean(axis=1)], np.r_[rgb, rgb[side].mean(axis=1)], fine


def scaled(level):
    """Arrays of the embedded scene with ``4 ** level`` times its triangles."""
    workload = embedded_workload()
    first = np.r_[0, workload.vertex_end[:-1]]
    faces = np.split(workload.triangle, np.cumsum(workload.triangle_count)[:-1])
    parts = []
    for start, end, face in zip(first, workload.vertex_end, faces, strict=True):
        part = (workload.vertex_m[start:end], workload.vertex_rgb[start:end], face - start)
        for _ in range(level):
            part = subdivided(*part)
        parts.append(part)
    vertex_end = np.cumsum([len(vertex) for vertex, _, _ in parts])
    triangle = [part[2] + start for part, start in zip(parts, np.r_[0, vertex_end[:-1]], strict=True)]
    return {
        "verts": np.concatenate([part[0] for part in parts]).astype(np.float32),
        "colors": np.concatenate([part[1] for part in parts]).astype(np.float32),
        "faces": np.concatenate(triangle).astype(np.int32),
        "face_counts": np.array([len(part[2]) for part in parts]),
        "vert_ends": vertex_end,
        "n_targets": np.int64(workload.vehicle_count),
        "target_w": workload.vehicle_weight,
        "res": np.int64(workload.size_px),
        "visible": np.int64(workload.is_visible),
        "w_white": workload.weight["white"],
        "w_smooth": workload.weight["smooth"],
        "poses20": workload.scored_pose,
        "seed": np.int64(workload.seed),
        "format": np.int64(1),
    }


def cameras(view_count):
    """Arrays of the embedded cameras and, where more are wanted, of random ones near them."""
    workload = embedded_workload()
    count = view_count // 4
    more = np.random.default_rng([workload.seed, 1]).uniform([-0.8, -2.0, -np.pi], [0.8, 2.0, np.pi], (count, 3))
    constant = {"cam_y": workload.height_m, "fov_deg": workload.fov_deg, "near": workload.near_m}
    own = {name: np.full(count, value[0]) for name, value in constant.items()}
    return {"cams": np.concatenate([workload.pose, more])[:count], **own}


def scenes():
    """Scale, and a function from the number of views to the workload's arrays."""
    file = Path(os.environ.get("WARPAV_TEST_WORKLOADS", ""), "workload.py")
    if not file.is_file():
        for level in (0, 1, 2):
            scene = scaled(level)
            yield 2.0**level, lambda views, scene=scene: scene | cameras(views)
        return
    spec = importlib.util.spec_from_file_location("outside_workload", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for scale in (0.5, 1.0, 2.0, 4.0):
        yield scale, lambda views, scale=scale: module.build(7, scale, views)


def climb(folder, arrays, device):
    """One rung: triangles, views, least time [ms], most memory [MiB]."""
    np.savez(folder / "rung.npz", **arrays)
    repeat = 9 if 4 * len(arrays["cams"]) <= FULL_CHUNK else 3
    command = [sys.executable, "-m", "warpav.cli.app", "bench", "--workload", "rung.npz", "--items", "w2"]
    command += ["--repeat", str(repeat), "--device", device, "--no-embree", "--json", "rung.json"]
    subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    content = json.loads((folder / "rung.json").read_text())
    entry, work = content["items"]["w2"], content["workload"]
    peak_mib = entry.get("peak_rss_mib", entry.get("peak_device_mib"))
    return work["faces"], work["views"], entry["min_ms"], peak_mib


@pytest.mark.slow
def test_time_grows_with_the_work_and_memory_does_not_grow_with_views(tmp_path, device):
    rungs = []
    for scale, build in scenes():
        peak_mib = {}
        for count in VIEWS:
            faces, views, min_ms, peak_mib[count] = climb(tmp_path, build(count), device)
            rungs.append((faces, views, min_ms))
            rate = f"{1e3 * views / min_ms:.0f} views/s, {peak_mib[count]:.0f} MiB"
            sys.stdout.write(f"scale {scale:g}: {faces} faces, {views} views: {min_ms:.1f} ms, {rate}\n")
        # memory stays what a full chunk takes
        assert peak_mib[VIEWS[-1]] < peak_mib[FULL_CHUNK] + 20
    faces, views, took_ms = np.array(rungs, float).T
    work = np.stack([np.ones(len(rungs)), views, views * faces], axis=1)
    cost, _ = nnls(work / took_ms[:, None], np.ones(len(rungs)))
    ratio = took_ms / (work @ cost)
    sys.stdout.write(
        f"time is {cost[0]:.3f} ms + views x ({cost[1]:.4f} ms + {1e6 * cost[2]:.3f} ns x faces); measured "
        f"{ratio.min():.2f} to {ratio.max():.2f} of that\n"
    )
    # on a CPU that does nothing else, within a fifth; a GPU waits for the host between the chunks of small scenes
    assert ratio.max() < 2.0
    assert ratio.min() > 0.6
