"""Warp's kernels, functions and structs for autodoc: what stands behind the decorators, signatures as written."""

import ast
import importlib
import inspect
import pkgutil
import re
import textwrap

from sphinx.application import Sphinx

import warpav_kernels


def _unwrap_kernels() -> None:
    names = [found.name for found in pkgutil.walk_packages(warpav_kernels.__path__, "warpav_kernels.")]
    for module in [importlib.import_module(name) for name in names]:  # all first: a kernel may need another's struct
        for name, value in list(vars(module).items()):
            behind = {"Kernel": "func", "Function": "func", "Struct": "cls"}.get(type(value).__name__)
            if behind:
                setattr(module, name, getattr(value, behind))


def _signature(_app: Sphinx, what: str, name: str, value: object, *_: object) -> tuple[str, str] | None:
    if what != "function" or not name.startswith("warpav_kernels."):
        return None
    function = ast.parse(textwrap.dedent(inspect.getsource(value))).body[0]
    returns = f" -> {ast.unparse(function.returns)}" if function.returns else ""
    return f"({ast.unparse(function.args)})", returns.removeprefix(" -> ")


def _fields(_app: Sphinx, _what: str, _name: str, _value: object, _options: object, lines: list[str]) -> None:
    """Make fields of ``Launch:``, ``Writes:`` and ``Equation:``, which go on until the next one or an empty line."""
    is_open = False
    for number, line in enumerate(lines):
        if re.match(r"(Launch|Writes|Equation): ", line):
            lines[number], is_open = f":{line}", True
        elif not line.strip():
            is_open = False
        elif is_open:
            lines[number] = f"    {line.strip()}"


def setup(app: Sphinx) -> dict[str, bool]:
    """Make kernels look like the functions that they are written as."""
    _unwrap_kernels()
    app.connect("autodoc-process-signature", _signature)
    app.connect("autodoc-process-docstring", _fields, priority=400)  # before napoleon
    return {"parallel_read_safe": True, "parallel_write_safe": True}
