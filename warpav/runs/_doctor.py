"""``warpav doctor``: what this machine can do for warpav, found out by doing it."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from warpav.core.errors import InputError
from warpav.core.files import check_parent
from warpav.core.warp_setup import load_warp
from warpav.runs._environment import package_versions, required_packages

_Status = Literal["ok", "warning", "failed"]
_OPENGL_TIMEOUT_S = 120
_SELF_TEST_MIN_COSINE = 0.99
_SELF_TEST_STEP_M = 0.02
_SELF_TEST_SUPERSAMPLING = 4  # long straight edges alias at 1


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    name: str
    status: _Status
    text: str
    details: dict[str, Any] = field(default_factory=dict)


def examine(json_file: Path | None = None) -> int:
    """Run all checks, print each as it ends, and return the exit status: 1 when one failed, else 0."""
    from warpav.runs._terminal import Terminal, shown

    check_parent(json_file, "json")
    console = Terminal(soft_wrap=True)
    styles = {"ok": "green", "warning": "yellow", "failed": "red"}
    findings = []
    for name, check in CHECKS.items():
        finding = _guarded(name, check)
        findings.append(finding)
        console.print(shown(f"{finding.status:8}", styles[finding.status]), f"{finding.name:10}", shown(finding.text))
    healthy = all(finding.status != "failed" for finding in findings)
    if json_file is not None:
        content = {"schema": 1, "healthy": healthy, "checks": {found.name: asdict(found) for found in findings}}
        json_file.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return 0 if healthy else 1


def _guarded(name: str, check: Callable[[], Finding]) -> Finding:
    try:
        return check()
    except InputError as error:
        return Finding(name, "failed", str(error))
    except Exception as error:
        return Finding(name, "failed", f"{type(error).__name__}: {' '.join(str(error).split())}")


def check_versions() -> Finding:
    """Python, the platform, and every package that warpav builds on."""
    versions = package_versions()
    missing = [package for package in required_packages() if package not in versions]
    details = {
        "warpav": metadata.version("warpav"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": versions,
    }
    if missing:
        return Finding("versions", "failed", f"not installed: {', '.join(missing)}; run pip install warpav", details)
    text = f"warpav {details['warpav']}, Python {details['python']}, {details['platform']}; "
    text += ", ".join(f"{name} {version}" for name, version in versions.items())
    return Finding("versions", "ok", text, details)


def _check_devices() -> Finding:
    wp = load_warp()
    names = {device.alias: device.name for device in wp.get_devices()}
    text = ", ".join(f"{alias} ({name})" for alias, name in names.items())
    return Finding("devices", "ok", text, {"devices": names, "cuda": wp.is_cuda_available()})


def _check_cache() -> Finding:
    import tempfile

    from warpav.core.cache import user_cache_folder

    wp = load_warp()
    caches = user_cache_folder("scenes").parent
    size_mb = {
        folder.name: sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6
        for folder in sorted(caches.glob("*"))
        if folder.is_dir()
    }
    data = {"folder": str(wp.config.kernel_cache_dir), "caches": str(caches), "cache_mb": size_mb}
    folder = Path(wp.config.kernel_cache_dir or "")
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        text = f"{folder}: {error.strerror}; set WARP_CACHE_PATH to a folder that can be written"
        return Finding("cache", "failed", text, data)
    text = f"kernels in {folder}, {sum(size_mb.values()):.0f} MB of scenes, pools and fits in {caches}"
    if caches == Path(os.devnull):
        text = f"kernels in {folder}; without a home scenes, pools and fits are not kept: set XDG_CACHE_HOME"
    return Finding("cache", "ok", text, data)


def check_providers() -> Finding:
    """What onnxruntime can run detectors on, and whether two builds of it overwrite each other."""
    import onnxruntime

    providers = onnxruntime.get_available_providers()
    installed = [name for name in ("onnxruntime", "onnxruntime-gpu") if name in package_versions()]
    details = {"providers": providers, "distributions": installed}
    if len(installed) == 2:
        text = (
            "onnxruntime and onnxruntime-gpu are both installed and overwrite each other's files; "
            "pip uninstall both, then install one"
        )
        return Finding("providers", "warning", text, details)
    return Finding("providers", "ok", ", ".join(providers), details)


_DRAW = """
import sys
from warpav.view import load_pyvista, opengl_problem
problem = opengl_problem()
if problem:
    sys.exit(problem)
pyvista = load_pyvista()
plotter = pyvista.Plotter(off_screen=True, window_size=[64, 64])
plotter.set_background("black")
plotter.add_mesh(pyvista.Cube(), color="white", lighting=False)
image = plotter.screenshot(return_img=True)
print(type(plotter.render_window).__name__ if image.max() > 200 and image.min() < 50 else "")
"""


def check_opengl() -> Finding:
    """Whether images can be drawn; in a process of its own, because a broken OpenGL ends the process."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", _DRAW], capture_output=True, text=True, timeout=_OPENGL_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return Finding("opengl", "warning", f"no image within {_OPENGL_TIMEOUT_S} s; warpav inspect will not work")
    window = done.stdout.strip().splitlines()[-1] if done.stdout.strip() else ""
    if done.returncode == 0 and window:
        return Finding("opengl", "ok", f"drew an image with {window}", {"window": window})
    reason = done.stderr.strip().splitlines()[-1] if done.returncode > 0 and done.stderr.strip() else ""
    reason = reason or ("the image was empty" if done.returncode == 0 else f"OpenGL ended with {done.returncode}")
    return Finding("opengl", "warning", f"{reason}; warpav inspect and the picture of the rig in a run will not work")


def _check_detector() -> Finding:
    import numpy as np

    from warpav.detection import OnnxDetector

    detector = OnnxDetector("builtin")
    began = time.perf_counter()
    detector.detect(np.zeros((1, 256, 256, 3), np.uint8))
    duration_ms = 1000.0 * (time.perf_counter() - began)
    text = f"the shipped detector knows {', '.join(detector.names[:8])}"
    return Finding("detector", "ok", text, {"names": list(detector.names), "first_image_ms": duration_ms})


def _check_renderer() -> Finding:
    """A small render on every device, with the error of its gradient against finite differences."""
    wp = load_warp()
    details = {}
    for device in wp.get_devices():
        cosine, error = gradient_error(device.alias)
        details[device.alias] = {"cosine": cosine, "relative_error": error}
    text = "gradient against finite differences: " + "; ".join(
        f"{alias} cosine {found['cosine']:.5f}, error {found['relative_error']:.2%}" for alias, found in details.items()
    )
    good = all(found["cosine"] >= _SELF_TEST_MIN_COSINE for found in details.values())
    return Finding("renderer", "ok" if good else "failed", text, details)


def gradient_error(device: str) -> tuple[float, float]:
    """How well the renderer's gradient agrees with finite differences on a small scene."""
    import numpy as np
    import warp as wp

    from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
    from warpav.raster.areas import VISIBLE_AREA
    from warpav.raster.camera import CameraModel
    from warpav.raster.mesh import Mesh
    from warpav.raster.renderer import Renderer
    from warpav.scene import Box, DeviceScene, Scene, Vehicle

    def block(centre_m: tuple[float, float, float], size_m: tuple[float, float, float]) -> Mesh:
        corner = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
        faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
        return Mesh.create(corner * size_m + centre_m, faces, [200, 60, 40])

    far, near = block((9.0, 0.4, 0.8), (4.0, 1.8, 1.5)), block((5.5, 1.6, 0.8), (1.0, 1.0, 1.6))
    box = Box(np.array([9.0, 0.4, 0.8]), np.array([4.0, 1.8, 1.5]), 0.0)
    scene = Scene("self-test", near, block((-3.0, 0.0, 0.1), (0.2, 0.2, 0.2)), (Vehicle(1, "van", far, box),))
    packed = DeviceScene.pack(scene, device=device)

    def visible_area(poses: np.ndarray, supersampling: int) -> tuple[np.ndarray, np.ndarray]:
        """Visible area [px^2] at poses (x, y, z, yaw), shape [view, 4], and its gradient, [view, 4]."""
        rotation = np.stack([rotation_from_yaw_pitch_roll(pose[3], 0.15, 0.3) @ FLU_FROM_RDF for pose in poses])
        renderer = Renderer([CameraModel(256, 256)] * len(poses), supersampling=supersampling, device=device)
        frame = renderer.render(
            packed.raster,
            wp.array(poses[:, :3].astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(rotation.transpose(0, 2, 1).astype(np.float32), dtype=wp.mat33, device=device),
        )
        measures = frame.measure()
        value, translation, rotation_about = (
            array.numpy()[:, 0, VISIBLE_AREA]
            for array in (measures.value, measures.jac_translation, measures.jac_rotation)
        )
        down_camera = -rotation[:, 2]  # turning the camera left turns the world about it the other way
        return value, np.concatenate([translation, (rotation_about * down_camera).sum(axis=1, keepdims=True)], axis=1)

    pose = np.array([[0.3, -0.2, 1.7, 0.1]])
    _, gradient = visible_area(pose, _SELF_TEST_SUPERSAMPLING)
    step = np.array([_SELF_TEST_STEP_M] * 3 + [_SELF_TEST_STEP_M / 4.0])
    area, _ = visible_area(np.concatenate([pose + np.diag(step), pose - np.diag(step)]), 2 * _SELF_TEST_SUPERSAMPLING)
    difference = (area[:4] - area[4:]) / (2.0 * step)
    cosine = float(gradient[0] @ difference / (np.linalg.norm(gradient[0]) * np.linalg.norm(difference)))
    error = float(np.linalg.norm(gradient[0] - difference) / np.linalg.norm(difference))
    return (cosine, error) if math.isfinite(cosine) else (-1.0, math.inf)


CHECKS: dict[str, Callable[[], Finding]] = {
    "versions": check_versions,
    "devices": _check_devices,
    "cache": _check_cache,
    "providers": check_providers,
    "detector": _check_detector,
    "opengl": check_opengl,
    "renderer": _check_renderer,
}
