"""Which function holds which equation of the thesis, and which tests pin it down, read from the syntax trees.

As a program it writes the table of ``docs/method.md`` anew: ``python tests/architecture/equation_table.py``.
"""

import ast
import functools
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "method.md"
EQUATIONS = frozenset(range(1, 25))
LINE = re.compile(
    r"Equation: (?P<numbers>\d+(?:, \d+)*) \((?:(?P<printed>as printed)|(?P<status>changed|same value): .+)\)"
)
BEGIN, END = "<!-- equations -->\n", "<!-- end of equations -->\n"


@functools.cache
def functions_below(*folders):
    """Every module, class and function of the files that name equations, with the path of its file."""
    found = []
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            text = path.read_text()
            for node in ast.walk(ast.parse(text)) if "equation" in text.lower() else ():
                if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                    found.append((path.relative_to(ROOT), node))
    return found


@functools.cache
def equation_lines():
    """File, node and docstring line of everything that names equations."""
    found = []
    for path, node in functions_below("kernels", "warpav"):
        for line in (ast.get_docstring(node) or "").splitlines():
            if line.strip().lower().startswith("equation"):
                found.append((path, node, line.strip()))
    return found


def numbers(line):
    """The equations that a docstring line names."""
    found = LINE.fullmatch(line)
    return {int(number) for number in found["numbers"].split(",")} if found else set()


@functools.cache
def marked_tests():
    """File, name and equations of every test that is marked."""
    found = []
    for path, node in functions_below("tests"):
        for decorator in getattr(node, "decorator_list", []):
            if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "pytest.mark.equation":
                found.append((path, node.name, {ast.literal_eval(argument) for argument in decorator.args}))
    return found


def table():
    """The table as Markdown."""
    lines = [(path, node, LINE.fullmatch(line), numbers(line)) for path, node, line in equation_lines()]
    marked = marked_tests()
    rows = ["| equation | function | as the thesis has it | tests |", "|---|---|---|---|"]
    for equation in sorted(EQUATIONS):
        homes = [each[:3] for each in lines if equation in each[3]]
        tests = {}
        for path, name, marks in marked:
            if equation in marks:
                tests.setdefault(path, []).append(f"`{name}`")
        cells = [
            str(equation),
            "<br>".join(f"[`{node.name}`](../{path.as_posix()})" for path, node, _ in homes),
            "<br>".join(found["printed"] or found["status"] for _, _, found in homes),
            "<br>".join(f"[{path.name}](../{path.as_posix()}): {', '.join(names)}" for path, names in tests.items()),
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def with_table(page):
    """The page with the table between its two marks."""
    before, rest = page.split(BEGIN)
    return before + BEGIN + table() + END + rest.split(END)[1]


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
