"""The requirements that ship with warpav."""

from __future__ import annotations

from pathlib import Path

_FOLDER = Path(__file__).parent / "templates"


def template_names() -> list[str]:
    """Names of the shipped templates, sorted, such as ``near_field``."""
    return sorted(file.stem for file in _FOLDER.glob("*.yaml"))


def template_file(name: str) -> Path:
    """The file of a template."""
    return _FOLDER / f"{name}.yaml"
