"""Fingerprints of cached files: hashes of inputs, settings and the code that makes scenes."""

from __future__ import annotations

import hashlib
import importlib.util
from functools import cache
from pathlib import Path

_PACKAGES = ("core", "raster", "scene", "rig")
_DIGITS = 16


def fingerprint(*parts: object) -> str:
    """Hash of the parts and of the code that makes scenes, as `digest`."""
    return digest(_code_hash(), *parts)


def digest(*parts: object) -> str:
    """Hash of the parts' text or bytes, 16 hexadecimal digits."""
    found = hashlib.sha256()
    for part in parts:
        content = part if isinstance(part, bytes) else repr(part).encode()
        found.update(len(content).to_bytes(8, "little") + content)
    return found.hexdigest()[:_DIGITS]


@cache
def _code_hash() -> str:
    found = hashlib.sha256()
    for folder in _code_folders():
        for file in sorted(folder.rglob("*.py")):
            found.update(file.read_bytes())
    return found.hexdigest()


def _code_folders() -> list[Path]:
    kernels = importlib.util.find_spec("warpav_kernels")
    assert kernels is not None
    assert kernels.submodule_search_locations is not None
    return [
        *(Path(__file__).parents[1] / package for package in _PACKAGES),
        Path(kernels.submodule_search_locations[0]),
    ]
