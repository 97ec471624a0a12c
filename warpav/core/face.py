"""The face of a package: its ``__init__.pyi`` says what others may use, and where that is."""

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def face_of(package: str) -> tuple[list[str], Callable[[str], Any]]:
    """``__all__`` and ``__getattr__`` of a package that imports each name of its stub when it is first used."""
    stub = ast.parse(Path(str(sys.modules[package].__file__)).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom) and str(node.module).startswith("warpav")]
    places = {each.asname or each.name: (str(node.module), each.name) for node in imports for each in node.names}

    def find(name: str) -> Any:  # noqa: ANN401
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, attribute = places[name]
        found = importlib.import_module(module)
        return getattr(found, attribute) if hasattr(found, attribute) else importlib.import_module(f"{module}.{name}")

    return sorted(places), find
