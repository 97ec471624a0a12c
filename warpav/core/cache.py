"""The cache by content: files named after a hash of all that they are made of, in folders that do not grow without end.

Such a file never has to be checked for its age; one that cannot be read is made again.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
import re
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import TypeVar

import platformdirs

from warpav.core.cores import available_processes
from warpav.core.files import DRAFT

_Item = TypeVar("_Item")

_IN_USE_S = 3600.0
"""Other runs may still be using a file that was used so short a time ago; nobody writes one for so long."""
_FREE_MIN = 0.1
"""Share of the disk that has to be free for what is in use to stay beyond the capacity."""
_PARALLEL_MIN = 4  # fewer files are made sooner than processes start
_PACKAGES = ("warpav", "warpav_kernels")
_DIGITS = 16
_IMPORT = re.compile(
    r"^(?:from +(?P<module>[\w.]+) +import +(?P<names>\([^)]*\)|.*)|import +(?P<modules>.*))", re.MULTILINE
)


def user_cache_folder(name: str) -> Path:
    """A folder of the user's cache, by its name; it may not exist yet, and without a home it never does."""
    try:
        folder = Path(platformdirs.user_cache_dir("warpav", appauthor=False))
    except RuntimeError:
        folder = Path("~")
    # neither HOME nor a home of the user, as in containers
    return (Path(os.devnull) if folder.parts[0] == "~" else folder) / name


def made_files(
    make: Callable[[tuple[_Item, Path]], object],
    items: Sequence[_Item],
    files: Sequence[Path],
    *,
    worker_count: int | None = None,
) -> Iterator[tuple[_Item, Path]]:
    """Items with their files, in order, each once the processes that make what is missing are done with it.

    Where few are missing, or one could not be made, the file is not there: its reader makes it.
    """
    from warpav.core.executor import Executor

    missing = {file: item for item, file in zip(items, files, strict=True) if not file.is_file()}
    worker_count = min(worker_count or available_processes(), len(missing))
    outcomes = iter(())
    if worker_count > 1 and len(missing) >= _PARALLEL_MIN:
        tasks = [(item, file) for file, item in missing.items()]
        outcomes = Executor("process", worker_count, gpu_count=0).map(make, tasks)
    else:
        missing = {}
    for item, file in zip(items, files, strict=True):
        while file in missing:
            missing.pop(next(outcomes).task[1])
        yield item, file
    for _ in outcomes:
        pass


def remove_oldest(folder: Path, pattern: str, *, capacity_bytes: int) -> None:
    """Remove files not used for the longest time, and what killed writers left, until the others fit the capacity.

    What was used within the last hour stays unless the disk is nearly full: runs side by side would undo each other's
    work.
    """
    with contextlib.suppress(OSError):  # another process removes as well
        now = time.time()
        for draft in folder.glob(f"{DRAFT}*"):
            if now - draft.stat().st_mtime > _IN_USE_S:
                draft.unlink()
        found = [(file.stat(), file) for file in folder.glob(pattern)]
        left = sum(status.st_size for status, _ in found)
        for status, file in sorted(found, key=lambda each: each[0].st_mtime):
            if left <= capacity_bytes or (now - status.st_mtime < _IN_USE_S and _has_room(folder)):
                break
            file.unlink()
            left -= status.st_size


def _has_room(folder: Path) -> bool:
    disk = shutil.disk_usage(folder)
    return disk.free > _FREE_MIN * disk.total


def digest(*parts: object) -> str:
    """Hash of the parts' text or bytes, 16 hexadecimal digits."""
    found = hashlib.sha256()
    for part in parts:
        content = part if isinstance(part, bytes) else repr(part).encode()
        found.update(len(content).to_bytes(8, "little") + content)
    return found.hexdigest()[:_DIGITS]


def fingerprint(*parts: object, code: Collection[str]) -> str:
    """Hash of the parts and of the code that works on them, as `digest`."""
    return digest(_code_hash(tuple(code)), *parts)


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
    """Own modules that a module imports when it is imported, read from its lines: syntax trees take half a second."""
    for line in _IMPORT.finditer(source):
        module, names = line["module"], re.sub(r"#.*|[()]|\bas \w+", "", line["names"] or line["modules"])
        for name in (each.strip() for each in names.replace("\n", ",").split(",")):
            # what is imported is a module of a package, something out of a module, or out of one behind a face
            for found in (module, f"{module}.{name}", _face(module).get(name, module)) if module else (name,):
                if name and found.split(".")[0] in _PACKAGES and _source_file(found) is not None:
                    yield found


@cache
def _face(package: str) -> dict[str, str]:
    stub = _source_file(package) if package.split(".", maxsplit=1)[0] in _PACKAGES else None
    if stub is None or not (stub := stub.with_suffix(".pyi")).is_file():
        return {}
    lines = re.findall(r"^from (\S+) import (?:\w+ as )?(\w+)$", stub.read_text(encoding="utf-8"), re.MULTILINE)
    return {name: module for module, name in lines}


@cache
def _source_file(name: str) -> Path | None:
    package, *parts = name.split(".")
    spec = importlib.util.find_spec(package)
    assert spec is not None
    assert spec.origin is not None
    path = Path(spec.origin).parent.joinpath(*parts)
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)
