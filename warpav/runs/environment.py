"""What a run depended on besides its configuration: versions, commit, command, time.

Code is identified by its content: `Commit.code` is a hash of all files of the packages, which the history gives for
every commit as well. So a result shows whether it was made by the code of its commit, and which commit made it where it
ran from a copy without a history.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
import platform
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
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
        "git_commit": _git_commit(),
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


def _git_commit() -> str | None:
    """Commit of the checkout that runs, with ``+`` when its code has changes; None for an installed package."""
    commit = running_commit()
    return None if commit.hash is None else commit.hash + ("" if commit.is_clean else "+")


_PACKAGES = {"warpav": "warpav", "warpav_kernels": "kernels/warpav_kernels"}
"""Our packages, and where they lie in a checkout."""

_TIMEOUT_S = 60


@dataclass(frozen=True)
class Commit:
    """The code that runs."""

    hash: str | None
    is_clean: bool | None
    code: str


@cache
def running_commit() -> Commit:
    """The commit of the code that runs, as it is when first asked for."""
    folders = {}
    for package, place in _PACKAGES.items():
        spec = importlib.util.find_spec(package)
        assert spec is not None
        assert spec.origin is not None
        folders[place] = Path(spec.origin).parent
    files = ((place, folder, file) for place, folder in folders.items() for file in folder.rglob("*"))
    code = _code_hash(
        (f"{place}/{file.relative_to(folder).as_posix()}", _blob(file))
        for place, folder, file in files
        if file.is_file()
    )
    head = _git("rev-parse", "HEAD")
    if head is None:
        return Commit(None, None, code)
    commit = head.decode().strip()
    return Commit(commit, _code_of(commit) == code, code)


@cache
def _code_of(commit: str) -> str | None:
    """`Commit.code` of a commit; None if the history does not hold it."""
    listed = _git("ls-tree", "-r", "-z", "--full-tree", commit, "--", *_PACKAGES.values())
    if not listed:
        return None
    entries = (line.split("\t", 1) for line in listed.decode().split("\0") if line)
    return _code_hash((place, about.split()[2]) for about, place in entries)


def _code_hash(blobs: Iterable[tuple[str, str]]) -> str:
    """Of paths in the checkout and git's hashes of their content."""
    counted = sorted(
        (place, blob)
        for place, blob in blobs
        if not place.endswith((".md", ".pyc")) and not place.startswith("warpav/configs/")  # a wheel has them there
    )
    return hashlib.sha256("".join(f"{blob} {place}\n" for place, blob in counted).encode()).hexdigest()


def _blob(file: Path) -> str:
    """Git's hash of a file's content."""
    content = file.read_bytes()
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()


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
