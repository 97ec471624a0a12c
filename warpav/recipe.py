"""Hashes of what something is made with, so that it is made once: inputs, settings, and the code itself."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

_PACKAGES = ("geometry", "scene", "rig", "capture", "reconstruction")
_DIGITS = 16


def recipe(*parts: object) -> str:
    """Hash of the parts' text or bytes and of the code that makes scenes, 16 hexadecimal digits."""
    digest = hashlib.sha256(_code_hash().encode())
    for part in parts:
        content = part if isinstance(part, bytes) else repr(part).encode()
        digest.update(len(content).to_bytes(8, "little") + content)
    return digest.hexdigest()[:_DIGITS]


@cache
def _code_hash() -> str:
    digest = hashlib.sha256()
    for package in _PACKAGES:
        for file in sorted((Path(__file__).parent / package).rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()
