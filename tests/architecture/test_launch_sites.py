"""A kernel is launched from exactly one place, with its inputs and outputs apart, and untaped when it only decides."""

import ast
from pathlib import Path

import pytest

from tests.architecture.kernel_style import read_modules

ROOT = Path(__file__).parents[2]


WARP = ("wp.launch", "wp.launch_tiled")
UNTAPED = ("buffers.launch", "buffers.launch_views", "self.launch")  # they hand ``record_tape=False`` on


def launches():
    """Kernel name, where it is launched, and the call."""
    for path in sorted((ROOT / "warpav").rglob("*.py")):
        text = path.read_text()
        for node in ast.walk(ast.parse(text)) if "launch" in text else ():
            if isinstance(node, ast.Call) and ast.unparse(node.func) in (*WARP, *UNTAPED):
                keywords = {keyword.arg: keyword.value for keyword in node.keywords}
                if ast.unparse(node.func) in UNTAPED:
                    keywords["record_tape"] = ast.Constant(False)
                kernel = node.args[0] if node.args else keywords["kernel"]
                if ast.unparse(kernel) == "kernel":
                    continue  # the hand-over itself
                yield ast.unparse(kernel).rpartition(".")[2], f"{path.relative_to(ROOT)}:{node.lineno}", keywords


MODULES = read_modules(ROOT / "kernels" / "warpav_kernels")
KERNELS = [(m, f) for m in MODULES for f in m.functions if f.kind == "kernel"]
LAUNCHES = list(launches())


@pytest.mark.parametrize(("module", "kernel"), [pytest.param(m, k, id=k.name) for m, k in KERNELS])
def test_kernel_is_launched_from_one_place(module, kernel):
    sites = [(where, keywords) for name, where, keywords in LAUNCHES if name == kernel.name]
    assert len(sites) == 1, f"{kernel.name} is launched from {[where for where, _ in sites] or 'nowhere'}"
    where, keywords = sites[0]
    for keyword, names in (("inputs", kernel.inputs), ("outputs", kernel.outputs)):
        values = keywords.get(keyword)
        assert values is not None or not names, f"{where}: name {keyword}="
        if isinstance(values, ast.List) and not any(isinstance(value, ast.Starred) for value in values.elts):
            assert len(values.elts) == len(names), f"{where}: {keyword} are {', '.join(names)}"
    is_untaped = "record_tape" in keywords and ast.literal_eval(keywords["record_tape"]) is False
    is_differentiable = kernel.is_differentiable(module.enable_backward)
    assert is_untaped != is_differentiable, f"{where}: record_tape=False belongs to enable_backward=False"


def test_every_launch_names_a_kernel_of_the_package():
    names = {kernel.name for _, kernel in KERNELS}
    assert [f"{where}: {name}" for name, where, _ in LAUNCHES if name not in names] == []
