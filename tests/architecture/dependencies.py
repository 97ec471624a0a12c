"""What installing warpav brings along, and under which licences, from the metadata of the installed distributions.

A program as well: ``python tests/architecture/dependencies.py`` prints the table.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import Distribution, distribution

from packaging.requirements import Requirement

PERMISSIVE = {
    "0BSD": ("0bsd",),
    "Apache-2.0": ("apache",),
    "BSD": ("bsd", "redistribution and use in source and binary forms"),
    "CC0-1.0": ("cc0",),
    "MIT": ("mit",),
    "PSF-2.0": ("psf", "python software foundation"),
    "Zlib": ("zlib",),
}
"""Licences that the core may bring along, and how metadata spell them in lower case."""

WEAK_COPYLEFT = {"certifi": "MPL-2.0"}
"""What else is accepted, by name: a list of certificates that is used as it is."""


@dataclass(frozen=True)
class Dependency:
    """A distribution that comes with warpav.

    Attributes:
        name: Its name, normalised.
        is_direct: Whether warpav itself asks for it.
        said: What its metadata say of the licence.
        licences: Keys of `PERMISSIVE` that this names; none where it names another.
    """

    name: str
    is_direct: bool
    said: str
    licences: tuple[str, ...]


def normalised(name: str) -> str:
    """A distribution's name as package indices compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def core_dependencies() -> list[Dependency]:
    """All that ``pip install warpav`` brings along here, sorted by name.

    Raises:
        PackageNotFoundError: Something of it is not installed.
    """
    direct = {normalised(each.name) for each in _required(distribution("warpav"))}
    found: dict[str, Distribution] = {}
    waiting = sorted(direct)
    while waiting:
        name = waiting.pop()
        if name not in found:
            found[name] = distribution(name)
            waiting += [normalised(each.name) for each in _required(found[name])]
    return [
        Dependency(name, name in direct, _licence(found[name]), _permissive(_licence(found[name])))
        for name in sorted(found)
    ]


def _required(of: Distribution) -> Iterator[Requirement]:
    """What a distribution asks for without extras."""
    for text in of.requires or []:
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            yield requirement


def _licence(of: Distribution) -> str:
    """What metadata say: the expression, else the classifiers, else the free text."""
    metadata = of.metadata
    expression = metadata.get("License-Expression")
    if expression:
        return expression
    classifiers = [each for each in metadata.get_all("Classifier") or [] if each.startswith("License ::")]
    return ", ".join(each.rpartition(" :: ")[2] for each in classifiers) or metadata.get("License") or ""


def _permissive(said: str) -> tuple[str, ...]:
    """The permissive licences in a text; none if it names one that is not."""
    text = said.lower()
    if re.search(r"\b[al]?gpl|general public|mozilla|\bmpl\b|mpl-|non-?commercial|proprietary|sspl|busl", text):
        return ()
    return tuple(name for name, spellings in PERMISSIVE.items() if any(each in text for each in spellings))


if __name__ == "__main__":
    for each in core_dependencies():
        print(f"{each.name:32} {'direct' if each.is_direct else '':7} {', '.join(each.licences) or each.said[:60]}")  # noqa: T201
