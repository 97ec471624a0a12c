"""What a run depended on besides its configuration: versions, commit, command, time."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import shlex
import subprocess
import sys
import time
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from warpav.runs.config import Config

# worth knowing although warpav does not ask for them itself
_RELATED_PACKAGES = ("onnxruntime-gpu", "vtk")


def environment(config: Config, device: str) -> dict[str, Any]:
    """What a run depended on: versions, device, seeds, command, time."""
    return {
        "warpav": metadata.version("warpav"),
        "git_commit": git_commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
        "device": device or config.device,
        "packages": package_versions(),
        "seeds": {
            "run": config.run.seed,
            "train": list(config.scenes.train_seeds),
            "validation": list(config.scenes.validation_seeds or ()),
            "test": list(config.scenes.test_seeds),
        },
        "command": command_line(),
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }


def command_line() -> str:
    """The command that runs, as it can be typed again; that of the installed program where Python was given code."""
    name = Path(sys.argv[0]).name
    return shlex.join(["warpav" if name == "-c" else name, *sys.argv[1:]])


def required_packages() -> list[str]:
    """Distribution names of the packages that an installation of warpav needs, extras left out."""
    requirements = [each for each in metadata.requires("warpav") or [] if "extra ==" not in each]
    return [re.split(r"[^A-Za-z0-9._-]", each, maxsplit=1)[0] for each in requirements]


def package_versions() -> dict[str, str]:
    """Installed versions of the packages that warpav builds on, by distribution name; absent ones are left out."""
    versions = {}
    for package in (*required_packages(), *_RELATED_PACKAGES):
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return versions


@cache
def git_commit() -> str | None:
    """Commit of the checkout that runs, with ``+`` when its code has changes; None for an installed package."""
    head = _git("rev-parse", "HEAD")
    changes = _git("status", "--porcelain", "--", "warpav", "kernels", "configs")
    return None if head is None else head.decode().strip() + ("+" if changes else "")


_TIMEOUT_S = 60


def _git(*words: str) -> bytes | None:
    """What git says in the checkout that the code runs from; None if it says no, or there is no checkout or no git."""
    checkout = Path(__file__).resolve().parents[2]
    if not (checkout / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(checkout), *words], capture_output=True, timeout=_TIMEOUT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None
