"""Fingerprints of cached files: hashes of inputs, settings and the code that makes scenes."""

from __future__ import annotations

import hashlib
import importlib.util
import re
from collections.abc import Collection, Iterator
from functools import cache
from pathlib import Path

_PACKAGES = ("warpav", "warpav_kernels")
_DIGITS = 16
_IMPORT = re.compile(
    r"^(?:from +(?P<module>[\w.]+) +import +(?P<names>\([^)]*\)|.*)|import +(?P<modules>.*))", re.MULTILINE
)


def fingerprint(*parts: object, code: Collection[str]) -> str:
    """Hash of the parts and of the code that works on them, as `digest`.

    Args:
        *parts: Inputs and settings.
        code: Modules, such as ``warpav.scene.town.town``. With each counts what it imports when it is imported, and so
            on down to ``warpav.core``; what it imports inside functions counts only if it is named here.
    """
    return digest(_code_hash(tuple(code)), *parts)


def digest(*parts: object) -> str:
    """Hash of the parts' text or bytes, 16 hexadecimal digits."""
    found = hashlib.sha256()
    for part in parts:
        content = part if isinstance(part, bytes) else repr(part).encode()
        found.update(len(content).to_bytes(8, "little") + content)
    return found.hexdigest()[:_DIGITS]


@cache
def _code_hash(modules: tuple[str, ...]) -> str:
    sources: dict[str, bytes] = {}
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        if name in sources:
            continue
        file = _source_file(name)
        assert file is not None, name
        sources[name] = file.read_bytes()
        waiting += _imports(sources[name].decode())
    return digest(*(part for name in sorted(sources) for part in (name, sources[name])))


def _imports(source: str) -> Iterator[str]:
    """Own modules that a module imports when it is imported.

    They are read from its lines: the syntax tree of a hundred modules takes half a second.
    """
    for line in _IMPORT.finditer(source):
        module, names = line["module"], re.sub(r"#.*|[()]|\bas \w+", "", line["names"] or line["modules"])
        for name in (each.strip() for each in names.replace("\n", ",").split(",")):
            # what is imported is a module of a package, or something out of a module
            for found in (module, f"{module}.{name}") if module else (name,):
                if name and found.split(".")[0] in _PACKAGES and _source_file(found) is not None:
                    yield found


@cache
def _source_file(name: str) -> Path | None:
    """The file of a module of our own, found without importing anything; None where the name means no module."""
    package, *parts = name.split(".")
    spec = importlib.util.find_spec(package)
    assert spec is not None
    assert spec.origin is not None
    path = Path(spec.origin).parent.joinpath(*parts)
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)
