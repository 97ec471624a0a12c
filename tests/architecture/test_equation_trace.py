"""Every equation of the thesis has a home in the code, named in a docstring line, and a test, named by its mark."""

from tests.architecture.equation_table import EQUATIONS, LINE, PAGE, equation_lines, marked_tests, numbers, with_table


def test_equation_lines_name_their_status():
    odd = [
        f"{path}:{getattr(node, 'lineno', 1)}: {line}"
        for path, node, line in equation_lines()
        if not LINE.fullmatch(line)
    ]
    assert not odd, "write 'Equation: 7, 9 (as printed | same value: why | changed: what)':\n" + "\n".join(odd)


def test_every_equation_has_a_home():
    homes = {number for _, _, line in equation_lines() for number in numbers(line)}
    assert homes == EQUATIONS


def test_every_equation_has_a_test():
    marked = {number for _, _, marks in marked_tests() for number in marks}
    assert EQUATIONS - marked == set()


def test_the_table_in_the_documentation_is_of_today():
    page = PAGE.read_text()
    assert with_table(page) == page, "run python tests/architecture/equation_table.py"
