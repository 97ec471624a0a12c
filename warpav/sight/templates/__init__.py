"""The requirements that ship with warpav."""

from __future__ import annotations

from pathlib import Path


def template_names() -> list[str]:
    """Names of the shipped templates, sorted, such as ``near_field``."""
    return sorted(file.stem for file in Path(__file__).parent.glob("*.yaml"))


def template_file(name: str) -> Path:
    return Path(__file__).parent / f"{name}.yaml"
