"""Every equation of the thesis has a home in the code, named in a docstring line, and a test, named by its mark."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
EQUATIONS = frozenset(range(1, 25))
LINE = re.compile(r"Equation: (\d+(?:, \d+)*) \((?:as printed|(?:changed|same value): .+)\)")


def functions_below(*folders):
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                    yield path.relative_to(ROOT), node


def equation_lines():
    """Where, and the docstring line that names equations."""
    for path, node in functions_below("kernels", "warpav"):
        for line in (ast.get_docstring(node) or "").splitlines():
            if line.strip().lower().startswith("equation"):
                yield f"{path}:{getattr(node, 'lineno', 1)}", line.strip()


def numbers(line):
    found = LINE.fullmatch(line)
    return {int(number) for number in found[1].split(",")} if found else set()


def test_equation_lines_name_their_status():
    odd = [f"{where}: {line}" for where, line in equation_lines() if not LINE.fullmatch(line)]
    assert not odd, "write 'Equation: 7, 9 (as printed | same value: why | changed: what)':\n" + "\n".join(odd)


def test_every_equation_has_a_home():
    homes = {number for _, line in equation_lines() for number in numbers(line)}
    assert homes == EQUATIONS


def test_every_equation_has_a_test():
    marked = set()
    for _, node in functions_below("tests"):
        for decorator in getattr(node, "decorator_list", []):
            if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "pytest.mark.equation":
                marked |= {ast.literal_eval(argument) for argument in decorator.args}
    assert EQUATIONS - marked == set()
