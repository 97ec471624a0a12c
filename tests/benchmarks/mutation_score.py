"""Mutation score: the share of small faults, put into the code at random, that make a test fail.

A program, not a test; it needs the package coverage. ``python tests/benchmarks/mutation_score.py --seed 1`` copies the
tree, runs the tests there once, and notes which test executes which line. Each mutant changes one place of one module
of the copy; the tests that execute its statement run until one fails. The places are drawn at random, so that the
score is an estimate: of 120 mutants its standard error is 3 to 4 %. Prints killed and all by module, then the
survivors.

Not mutated: texts, annotations, decorators, assertions (which hold in a program that is right), and what only type
checkers read. Tests that are slow or of other folders do not run, so the score errs on the low side.
"""

from __future__ import annotations

import argparse
import ast
import functools
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MUTATED = (
    *("warpav/optimisation/*.py", "warpav/thesis/*.py", "warpav/raster/*.py", "warpav/core/frames.py"),
    *(f"warpav/rig/{name}.py" for name in ("mount_surface", "chart", "zone", "rig")),
)
TESTS = (
    *("tests/optimisation", "tests/thesis", "tests/raster", "tests/rig", "tests/sight"),
    *("tests/golden", "tests/core/test_frames.py", "tests/runs/test_rules.py", "tests/runs/test_config.py"),
)
COPIED = (
    *("configs", "docs", "kernels", "notebooks", "tests", "warpav"),
    *("pyproject.toml", "README.md", "CHANGELOG.md", "CONTRIBUTING.md"),
)
BUDGET_S = 40.0
"""Time of all tests that run for a mutant, when nothing is mutated [s]."""
CRASH = "the interpreter crashed"
PATIENCE = 4.0
"""A mutant whose tests take so many times as long does not end, and is killed."""

say = functools.partial(print, flush=True)
Swaps = dict[type[ast.AST], tuple[type[ast.AST], ...]]
COMPARISONS: Swaps = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
ARITHMETIC: Swaps = {
    ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,),
    ast.Mult: (ast.Div,),
    ast.Div: (ast.Mult,),
    ast.FloorDiv: (ast.Mult,),
    ast.Mod: (ast.Mult,),
    ast.Pow: (ast.Mult,),
    ast.BitAnd: (ast.BitOr,),
    ast.BitOr: (ast.BitAnd,),
}


@dataclass(frozen=True)
class Mutant:
    """A module with one change.

    Attributes:
        module: The module's file, relative to the root.
        line: Where the change is, from 1.
        lines: Those of the statement that it is in; none: it is executed when the module is imported.
        old: What stands there.
        new: What the mutant has there.
        text: The whole module.
    """

    module: str
    line: int
    lines: range
    old: str
    new: str
    text: str

    def __str__(self) -> str:
        """Where it is, and what it changes."""
        return f"{self.module}:{self.line}  {self.old[:160]}  ->  {self.new[:160]}"


def mutants_of(module: str, source: str) -> Iterator[Mutant]:
    """All mutants of a module that can be drawn."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line.encode()))
    whole = source.encode()
    for node, new, lines in _changes(ast.parse(source), range(0)):
        first = starts[node.lineno - 1] + node.col_offset
        last = starts[node.end_lineno - 1] + node.end_col_offset
        old = whole[first:last].decode()
        # in brackets, as the change may bind less than what stood there
        replacement = new if isinstance(node, ast.stmt) else f"({new})"
        text = (whole[:first] + replacement.encode() + whole[last:]).decode()
        yield Mutant(module, node.lineno, lines, " ".join(old.split()), " ".join(new.split()), text)


def _changes(node: ast.AST, lines: range) -> Iterator[tuple[ast.expr | ast.stmt, str, range]]:
    """Places below a node that can be changed, what stands there then, and the lines of the statement of a function."""
    is_in_function = bool(lines) or isinstance(node, ast.FunctionDef)
    for child in _mutable_children(node):
        of_child = lines
        if is_in_function and isinstance(child, ast.stmt):
            body = getattr(child, "body", None)
            of_child = range(child.lineno, max(body[0].lineno, child.lineno + 1) if body else child.end_lineno + 1)
        for changed in _changed(child):
            yield child, ast.unparse(ast.fix_missing_locations(changed)), of_child
        yield from _changes(child, of_child)


def _mutable_children(node: ast.AST) -> Iterator[ast.AST]:
    """What below a node a mutant may change."""
    for name, field in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        for child in field if isinstance(field, list) else [field]:
            if not isinstance(child, ast.AST) or isinstance(child, ast.Assert | ast.JoinedStr):
                continue
            if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
                continue
            is_text = isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant)
            if not is_text:
                yield child


def _changed(node: ast.AST) -> Iterator[ast.AST]:
    """A node with one change, for each change that can be made to the node itself."""
    match node:
        case ast.Compare(left, [operator], [right]):
            for new in COMPARISONS[type(operator)]:
                yield ast.Compare(left, [new()], [right])
        case ast.BinOp(left, operator, right) if type(operator) in ARITHMETIC:
            for new in ARITHMETIC[type(operator)]:
                yield ast.BinOp(left, new(), right)
        case ast.AugAssign(target, operator, value):
            yield ast.Pass()
            for new in ARITHMETIC.get(type(operator), ()):
                yield ast.AugAssign(target, new(), value)
        case ast.UnaryOp(ast.USub() | ast.Not() | ast.Invert(), operand):
            yield operand
        case ast.BoolOp(ast.And(), values):
            yield ast.BoolOp(ast.Or(), values)
        case ast.BoolOp(ast.Or(), values):
            yield ast.BoolOp(ast.And(), values)
        case ast.Constant(bool(value)):
            yield ast.Constant(not value)
        case ast.Constant(int(value) | float(value)):
            yield ast.Constant(value + 1)
        case ast.Return(value) if value is not None and not (isinstance(value, ast.Constant) and value.value is None):
            yield ast.Return(ast.Constant(None))
        case ast.Raise() | ast.Continue() | ast.Break() | ast.Expr(ast.Call()):
            yield ast.Pass()
        case ast.IfExp(ast.Name() | ast.Attribute() | ast.Call() as test, body, orelse):
            yield ast.IfExp(ast.UnaryOp(ast.Not(), test), body, orelse)


class Recorder:
    """A pytest plugin that notes how long each test takes, and tells coverage which one runs."""

    def __init__(self, tree: Path) -> None:
        """Start to measure in a tree."""
        import coverage

        self.coverage = coverage.Coverage(data_file=None, include=[str(tree / each) for each in MUTATED])
        self.seconds: dict[str, float] = defaultdict(float)
        self.failed: set[str] = set()
        self.coverage.start()

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """A test begins."""
        self.coverage.switch_context(nodeid)

    def pytest_runtest_logfinish(self) -> None:
        """A test has ended."""
        self.coverage.switch_context("")

    def pytest_runtest_logreport(self, report: object) -> None:
        """A part of a test has ended."""
        self.seconds[report.nodeid] += report.duration
        if report.failed or report.skipped:
            self.failed.add(report.nodeid)


def recorded(tree: Path) -> dict[str, dict]:
    """Seconds of each test that passes in a tree, and the tests that execute each line of each module."""
    os.chdir(tree)
    recorder = Recorder(tree)
    status = pytest.main(["-q", "-n", "0", "-p", "no:cacheprovider", *TESTS], plugins=[recorder])
    if status not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
        raise SystemExit(int(status))
    recorder.coverage.stop()
    data = recorder.coverage.get_data()
    lines = {}
    for file in data.measured_files():
        lines[str(Path(file).relative_to(tree))] = {
            str(line): [test for test in tests if test and test not in recorder.failed]
            for line, tests in data.contexts_by_lineno(file).items()
        }
    seconds = {test: took for test, took in recorder.seconds.items() if test not in recorder.failed}
    return {"seconds": seconds, "lines": lines}


def tests_of(mutant: Mutant, found: dict[str, dict]) -> list[str]:
    """Tests that execute a mutant's statement, then the others of their files, as many as there is time for.

    The others may use what a fixture or a cache has from it. A module's own tests come first, then the quickest. What
    is executed when the module is imported concerns all tests that execute anything in it.
    """
    lines, seconds = found["lines"].get(mutant.module, {}), found["seconds"]
    executed = [lines.get(str(line), ()) for line in mutant.lines] if mutant.lines else lines.values()
    tests = {test for each in executed for test in each}
    files = {test.partition("::")[0] for test in tests}
    candidates = [test for test in seconds if test.partition("::")[0] in files]
    own = f"/test_{Path(mutant.module).stem.lstrip('_')}.py"
    chosen, left_s = [], BUDGET_S
    for test in sorted(candidates, key=lambda test: (test not in tests, own not in test, seconds[test], test)):
        if seconds[test] <= left_s:
            chosen.append(test)
            left_s -= seconds[test]
    return chosen


def why_killed(mutant: Mutant, tests: list[str], expected_s: float, tree: Path) -> str | None:
    """The test that fails in the copy of the tree with the mutant; None where all pass."""
    file = tree / mutant.module
    healthy = file.read_text(encoding="utf-8")
    file.write_text(mutant.text, encoding="utf-8")
    try:
        said = outcome_of(tests, tree, timeout_s=30.0 + PATIENCE * expected_s)
    finally:
        file.write_text(healthy, encoding="utf-8")
    return "it did not end" if said is None else next(iter(failed_in(said)), None)


def outcome_of(tests: list[str], tree: Path, *, timeout_s: float, stop_at_first: bool = True) -> str | None:
    """What pytest says of some tests of a tree; None where they do not end in time."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(tree), str(tree / "kernels")]),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    # pytest does not find escaped characters of a parameter again: the whole function runs
    named = dict.fromkeys(test.partition("[")[0] if "\\" in test else test for test in tests)
    (tree / "tests.txt").write_text("\n".join(named), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "@tests.txt"]
    with subprocess.Popen(
        [*command, "-x"] if stop_at_first else command,
        cwd=tree,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as run:
        try:
            said, _ = run.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            return None
    if run.returncode == pytest.ExitCode.USAGE_ERROR and not failed_in(said):  # a mutant may stop a file's import
        raise SystemExit(said)
    return said if run.returncode == 0 or failed_in(said) else f"{said}\nERROR {CRASH}"


def failed_in(said: str) -> list[str]:
    """The tests, or files of tests, that failed by what pytest said."""
    return re.findall(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", said, re.MULTILINE)


def main() -> None:
    """Record, mutate and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--mutants", type=int, default=120)
    parser.add_argument("--recorded", type=Path, help="file to keep which test executes which line, or to read it from")
    settings = parser.parse_args()
    files = sorted(file for pattern in MUTATED for file in ROOT.glob(pattern))
    everything = [
        mutant for file in files for mutant in mutants_of(str(file.relative_to(ROOT)), file.read_text(encoding="utf-8"))
    ]
    drawn = random.Random(settings.seed).sample(everything, min(settings.mutants, len(everything)))
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        tree.mkdir()
        for name in COPIED:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            copy(ROOT / name, tree / name)
        if settings.recorded is not None and settings.recorded.exists():
            found = json.loads(settings.recorded.read_text(encoding="utf-8"))
        else:
            found = recorded(tree)
            if settings.recorded is not None:
                settings.recorded.write_text(json.dumps(found), encoding="utf-8")
        say(f"{len(drawn)} of {len(everything)} mutants, {len(found['seconds'])} tests, seed {settings.seed}")
        reasons, chosen = {}, {}
        began = time.perf_counter()
        for number, mutant in enumerate(drawn, 1):
            chosen[mutant] = tests = tests_of(mutant, found)
            expected_s = sum(found["seconds"][test] for test in tests)
            reasons[mutant] = why_killed(mutant, tests, expected_s, tree) if tests else None
            fate = "SURVIVED" if reasons[mutant] is None else "killed  "
            say(f"{number:4} {time.perf_counter() - began:6.0f} s  {fate}  {mutant}  {reasons[mutant] or ''}")
        # what fails without a mutant as well kills none
        killing = sorted({reason for reason in reasons.values() if reason is not None and reason.startswith("tests/")})
        control = outcome_of(killing, tree, timeout_s=1200.0, stop_at_first=False)
        unsound = failed_in(control or f"ERROR {CRASH}")
        if CRASH in unsound:
            raise SystemExit("the tests do not run without a mutant either, so what was killed says nothing")
    say(f"\n{len(killing)} tests killed mutants; of these fail without one: {unsound or 'none'}")
    killed = Counter(mutant.module for mutant, why in reasons.items() if why is not None and why not in unsound)
    survivors = [mutant for mutant, why in reasons.items() if why is None or why in unsound]
    of_module = Counter(mutant.module for mutant in drawn)
    say("\nkilled / all by module")
    for module, count in sorted(of_module.items()):
        say(f"{killed[module]:4} /{count:4}  {module}")
    say(f"{killed.total():4} /{len(drawn):4}  {killed.total() / len(drawn):.0%}")
    say("\nsurvivors")
    for mutant in sorted(survivors, key=lambda each: (each.module, each.line)):
        say(f"{mutant}  ({len(chosen[mutant])} tests)")


if __name__ == "__main__":
    main()
