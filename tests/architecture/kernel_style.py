"""The house rules for Warp code, read from the syntax tree without importing Warp.

As a program it prints every breach and exits 1: ``python tests/architecture/kernel_style.py kernels/warpav_kernels``.
"""

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

INTEGER_ELEMENTS = re.compile(r"(bool|int|wp\.u?int(8|16|32|64)|wp\.vec\d(u?[bsil]|ub))$")
OLD_ARRAY = re.compile(r"wp\.(indexed)?array(\d?d)?\(")
ARRAY = re.compile(r"wp\.(indexed)?array(\d?d)?\b")


@dataclass(frozen=True)
class WarpFunction:
    """A kernel or a device function as its source shows it."""

    path: str
    node: ast.FunctionDef
    lines: list[str] = field(repr=False)
    kind: str  # kernel or func
    options: dict[str, object]  # keywords of the decorator

    @property
    def name(self) -> str:
        return self.node.name

    @cached_property
    def docstring(self) -> str:
        return ast.get_docstring(self.node) or ""

    @cached_property
    def arguments(self) -> list[ast.arg]:
        return self.node.args.args

    def comment_line(self, text: str) -> int | None:
        """Line of a comment that stands alone among the arguments."""
        for line in range(self.node.lineno, self.node.body[0].lineno):
            if self.lines[line - 1].strip() == text:
                return line
        return None

    def section(self, name: str) -> str:
        """Text of a docstring section such as ``Launch:``, up to the next one; empty when absent."""
        found = re.search(rf"^{name}:[ \n](.*?)(?=^\w[\w ]*:[ \n]|\Z)", self.docstring, re.MULTILINE | re.DOTALL)
        return " ".join(found[1].split()) if found else ""

    def is_differentiable(self, module_default: bool) -> bool:
        return bool(self.options.get("enable_backward", module_default))

    @cached_property
    def inputs(self) -> list[str]:
        out_line = self.comment_line("# out")
        return [a.arg for a in self.arguments if out_line is None or a.lineno < out_line]

    @cached_property
    def outputs(self) -> list[str]:
        return [a.arg for a in self.arguments if a.arg not in self.inputs]


@dataclass(frozen=True)
class WarpModule:
    """One file of kernels."""

    path: str
    functions: list[WarpFunction]
    struct_has_array: dict[str, bool]
    enable_backward: bool


def read_module(path: Path) -> WarpModule:
    source = path.read_text()
    tree = ast.parse(source)
    functions, structs, enable_backward = [], {}, True
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            for decorator in node.decorator_list:
                target = decorator.func if isinstance(decorator, ast.Call) else decorator
                kind = target.attr if isinstance(target, ast.Attribute) else ""
                if kind in ("kernel", "func", "func_native"):
                    functions.append(
                        WarpFunction(str(path), node, source.splitlines(), kind, _constant_keywords(decorator))
                    )
        elif isinstance(node, ast.ClassDef) and any(ast.unparse(d) == "wp.struct" for d in node.decorator_list):
            annotations = [ast.unparse(item.annotation) for item in node.body if isinstance(item, ast.AnnAssign)]
            structs[node.name] = any(ARRAY.match(annotation) for annotation in annotations)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "wp.set_module_options":
            enable_backward = bool(ast.literal_eval(node.args[0]).get("enable_backward", enable_backward))
    return WarpModule(str(path), functions, structs, enable_backward)


def read_modules(folder: Path) -> list[WarpModule]:
    return [read_module(path) for path in sorted(folder.rglob("*.py"))]


def breaches(modules: list[WarpModule]) -> Iterator[str]:
    """Every breach of the rules, as ``path:line name: what to change``."""
    functions = {function.name: function for module in modules for function in module.functions}
    struct_has_array = {name: has for module in modules for name, has in module.struct_has_array.items()}
    stored = _stored_arguments(functions)
    seen: dict[str, str] = {}
    for module in modules:
        for function in module.functions:
            where = f"{function.path}:{function.node.lineno} {function.name}:"
            if seen.setdefault(function.name, function.path) != function.path:
                yield f"{where} {seen[function.name]} has the same name"
            yield from _breaches_of_any(function, where)
            if function.kind == "kernel":
                is_differentiable = function.is_differentiable(module.enable_backward)
                yield from _breaches_of_kernel(function, where, is_differentiable, stored[function.name])
                for argument in function.arguments:
                    annotation = ast.unparse(argument.annotation) if argument.annotation else ""
                    if is_differentiable and struct_has_array.get(annotation):
                        yield f"{where} {argument.arg}: arrays of a differentiable kernel are plain arguments"


def _breaches_of_any(function: WarpFunction, where: str) -> Iterator[str]:
    node = function.node
    if not function.docstring:
        yield f"{where} write a docstring"
    if node.args.defaults or node.args.vararg or node.args.kwarg or node.args.kwonlyargs:
        yield f"{where} arguments have no defaults and are all named"
    for argument in function.arguments:
        annotation = ast.unparse(argument.annotation) if argument.annotation else ""
        if not annotation:
            yield f"{where} {argument.arg}: give it a type"
        elif OLD_ARRAY.search(annotation):
            yield f"{where} {argument.arg}: write wp.array2d[float], not wp.array2d(dtype=float)"
    for inner in ast.walk(node):
        if isinstance(inner, ast.AugAssign) and isinstance(inner.target, ast.Subscript):
            if isinstance(inner.op, ast.Mult | ast.Div):
                yield f"{function.path}:{inner.lineno} {function.name}: *= and /= on an array lose the gradient"
        elif isinstance(inner, ast.Call) and ast.unparse(inner.func) == "wp.where":
            yield f"{function.path}:{inner.lineno} {function.name}: guard with if: both sides of wp.where run backward"


def _breaches_of_kernel(
    function: WarpFunction, where: str, is_differentiable: bool, stored: dict[str, int]
) -> Iterator[str]:
    if not re.fullmatch(r"[a-z0-9]+_[a-z0-9_]*kernel", function.name):
        yield f"{where} name it <verb>_<noun>_kernel"
    for name in ("Launch", "Writes"):
        if not function.section(name):
            yield f"{where} the docstring lacks the section {name}:"
    in_line, out_line = function.comment_line("# in"), function.comment_line("# out")
    if out_line is None:
        yield f"{where} write '# out' above the outputs"
        return
    if not function.outputs:
        yield f"{where} no argument stands below '# out'"
    if function.inputs and (in_line is None or in_line > function.arguments[0].lineno):
        yield f"{where} write '# in' above the first argument"
    for argument in function.arguments:
        if argument.arg in function.outputs and argument.arg not in stored:
            yield f"{where} {argument.arg} stands below '# out' and is never written"
    for name, line in stored.items():
        if name in function.inputs:
            yield f"{function.path}:{line} {function.name}: writes {name}, which stands below '# in'"
    types = [ast.unparse(a.annotation) for a in function.arguments if a.arg in function.outputs and a.annotation]
    elements = [found[1] for found in (re.search(r"\[(.+)\]$", text) for text in types) if found]
    if is_differentiable and elements and all(INTEGER_ELEMENTS.match(element) for element in elements):
        yield f"{where} it writes integers only: mark it enable_backward=False"
    if is_differentiable:
        for name, line in _uses_of_loop_results(function.node):
            advice = f"backward, {name} is what it was before the loop: store it and use it in another kernel"
            yield f"{function.path}:{line} {function.name}: {advice}"
    if is_differentiable == ("Not taped" in function.section("Launch")):
        state = "differentiable" if is_differentiable else "marked enable_backward=False"
        yield f"{where} it is {state}; 'Not taped' in Launch: says the opposite"


def _uses_of_loop_results(node: ast.FunctionDef) -> Iterator[tuple[str, int]]:
    """Uses, other than storing it, of what a loop has changed; the backward pass does not run the loop before them."""
    for loop in (n for n in ast.walk(node) if isinstance(n, ast.For)):
        if isinstance(loop.iter, ast.Call) and all(isinstance(a, ast.Constant) for a in loop.iter.args):
            continue  # unrolled
        changed = {n.id for n in ast.walk(loop) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        before = {n.id for n in ast.walk(node) if isinstance(n, ast.Name) and n.lineno < loop.lineno}
        stored = {
            id(n.value) for n in ast.walk(node) if isinstance(n, ast.Assign) and isinstance(n.targets[0], ast.Subscript)
        } | {id(n.args[-1]) for n in ast.walk(node) if isinstance(n, ast.Call) and _text(n).startswith("wp.atomic_")}
        for use in ast.walk(node):
            is_read = isinstance(use, ast.Name) and isinstance(use.ctx, ast.Load) and id(use) not in stored
            if is_read and use.id in changed & before and use.lineno > (loop.end_lineno or 0):
                yield use.id, use.lineno


def _stored_arguments(functions: dict[str, WarpFunction]) -> dict[str, dict[str, int]]:
    """For every function, the arguments that it writes into, itself or by a function it calls, and the line."""
    stored: dict[str, dict[str, int]] = {name: dict(_stores(f)) for name, f in functions.items()}
    changed = True
    while changed:
        changed = False
        for name, function in functions.items():
            for call in (n for n in ast.walk(function.node) if isinstance(n, ast.Call)):
                called = functions.get(ast.unparse(call.func).rpartition(".")[2])
                if called is None:
                    continue
                for parameter, value in zip(called.arguments, call.args, strict=False):
                    root = _root(value)
                    if parameter.arg in stored[called.name] and root and root not in stored[name]:
                        stored[name][root] = call.lineno
                        changed = True
    arguments = {name: {a.arg for a in f.arguments} for name, f in functions.items()}
    return {name: {k: v for k, v in found.items() if k in arguments[name]} for name, found in stored.items()}


def _stores(function: WarpFunction) -> Iterator[tuple[str, int]]:
    if function.kind == "func_native":  # C++, so its docstring says what it writes
        for name in re.findall(r"``(\w+)``", function.section("Writes")):
            yield name, function.node.lineno
    for node in ast.walk(function.node):
        if isinstance(node, ast.Assign):
            targets = node.targets
        elif isinstance(node, ast.AugAssign | ast.AnnAssign):
            targets = [node.target]
        elif isinstance(node, ast.Call) and re.fullmatch(r"wp\.(atomic_\w+|tile_store|tile_atomic_\w+)", _text(node)):
            targets = node.args[:1]
            if root := _root(targets[0]):
                yield root, node.lineno
            continue
        else:
            continue
        for target in targets:
            for part in target.elts if isinstance(target, ast.Tuple) else [target]:
                if isinstance(part, ast.Subscript | ast.Attribute) and (root := _root(part)):
                    yield root, node.lineno


def _text(call: ast.Call) -> str:
    return ast.unparse(call.func)


def _root(node: ast.expr) -> str | None:
    """The variable at the bottom of ``a``, ``a[i]``, ``a.b[i][j]``."""
    while isinstance(node, ast.Subscript | ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else None


def _constant_keywords(decorator: ast.expr) -> dict[str, object]:
    if not isinstance(decorator, ast.Call):
        return {}
    return {k.arg: k.value.value for k in decorator.keywords if k.arg and isinstance(k.value, ast.Constant)}


if __name__ == "__main__":
    found = list(breaches(read_modules(Path(sys.argv[1]))))
    sys.stdout.write("".join(f"{line}\n" for line in found))
    sys.exit(bool(found))
