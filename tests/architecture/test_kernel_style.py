from pathlib import Path

import pytest

from tests.architecture.kernel_style import breaches, read_module, read_modules

ROOT = Path(__file__).parents[2]

GOOD = '''\
import warp as wp


@wp.struct
class Triangles:
    corner: wp.array[wp.vec3i]


@wp.func
def add_up(value: float, total: wp.array[float]):
    """Add a value to the total."""
    wp.atomic_add(total, 0, value)


@wp.kernel
def sum_squares_kernel(
    # in
    value: wp.array[float],
    # out
    total: wp.array[float],
):
    """Sum of squares.

    Launch: ``dim=count``; one thread per value.
    Writes: ``total[0]`` by atomic add; the caller zeroes it.
    """
    i = wp.tid()
    add_up(value[i] * value[i], total)


@wp.kernel(enable_backward=False)
def find_largest_kernel(
    # in
    value: wp.array[float],
    scene: Triangles,
    # out
    largest: wp.array[wp.int32],
):
    """Index of the largest value.

    Launch: ``dim=1``. Not taped.
    Writes: ``largest[0]``.
    """
    best = int(0)
    for i in range(value.shape[0]):
        if value[i] > value[best]:
            best = i
    largest[0] = best
'''


def breaches_of(source, folder):
    file = folder / "example.py"
    file.write_text(source)
    return list(breaches([read_module(file)]))


def test_kernels_keep_the_house_rules():
    modules = read_modules(ROOT / "kernels" / "warpav_kernels")
    assert sum(function.kind == "kernel" for module in modules for function in module.functions) >= 1
    found = list(breaches(modules))
    assert not found, "\n".join(found)


def test_good_kernels_pass(tmp_path):
    assert breaches_of(GOOD, tmp_path) == []


NATIVE = """
@wp.func_native("total.data[0] += value;")
def add_up(value: float, total: wp.array[float]):
    '''Add a value to the total.

    Writes: ``total``.
    '''
    ...
"""


def test_a_function_in_cpp_says_what_it_writes(tmp_path):
    first, last = GOOD.index("@wp.func\n"), GOOD.index("@wp.kernel\n")
    source = GOOD[:first] + NATIVE + GOOD[last:]
    assert breaches_of(source, tmp_path) == []
    silent = source.replace("Writes: ``total``.", "It is fast.")
    assert any("never written" in line for line in breaches_of(silent, tmp_path))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("sum_squares_kernel", "sum_squares", "name it <verb>_<noun>_kernel"),
        ("sum_squares_kernel", "kernel", "name it <verb>_<noun>_kernel"),
        ("    value: wp.array[float],\n    # out\n    total", "    value,\n    # out\n    total", "give it a type"),
        ("value: wp.array[float],\n    # out", "value: wp.array(dtype=float),\n    # out", "write wp.array2d"),
        ("    # in\n    value: wp.array[float],\n    # out", "    value: wp.array[float],\n    # out", "write '# in'"),
        ("    # out\n    total", "    total", "write '# out'"),
        ("    # out\n    total: wp.array[float],\n", "    total: wp.array[float],\n    # out\n", "below '# out'"),
        ("    Launch: ``dim=count``; one thread per value.\n", "", "lacks the section Launch:"),
        ("    Writes: ``total[0]`` by atomic add; the caller zeroes it.\n", "", "lacks the section Writes:"),
        ('    """Add a value to the total."""\n', "", "write a docstring"),
        ("add_up(value[i] * value[i], total)", "value[i] = 0.0", "writes value, which stands below '# in'"),
        ("add_up(value[i] * value[i], total)", "add_up(1.0, value)", "writes value, which stands below '# in'"),
        ("add_up(value[i] * value[i], total)", "wp.atomic_add(value, i, 1.0)", "writes value, which stands below"),
        ("add_up(value[i] * value[i], total)", "pass", "total stands below '# out' and is never written"),
        ("add_up(value[i] * value[i], total)", "total[0] *= 2.0", r"*= and /= on an array"),
        ("add_up(value[i] * value[i], total)", "total[0] = wp.where(i > 0, 1.0, 2.0)", "guard with if"),
        ('total: wp.array[float]):\n    """Add', 'total: wp.array[float] = None):\n    """Add', "no defaults"),
        (
            "add_up(value[i] * value[i], total)",
            "whole = float(0.0)\n    for k in range(i):\n        whole += value[k]\n    add_up(1.0 / whole, total)",
            "whole is what it was before the loop",
        ),
        ("(enable_backward=False)", "", "it writes integers only"),
        ("(enable_backward=False)", "", "'Not taped' in Launch: says the opposite"),
        ("``dim=1``. Not taped.", "``dim=1``.", "'Not taped' in Launch: says the opposite"),
        ("@wp.kernel\ndef", "@wp.kernel(enable_backward=False)\ndef", "'Not taped' in Launch: says the opposite"),
        ("(enable_backward=False)", "", "scene: arrays of a differentiable kernel are plain arguments"),
    ],
)
def test_breach_is_found(tmp_path, old, new, message):
    assert old in GOOD
    assert any(message in line for line in breaches_of(GOOD.replace(old, new), tmp_path))


def test_module_option_counts_as_the_mark(tmp_path):
    source = GOOD.replace("(enable_backward=False)", "").replace(
        "\n\n\n@wp.struct", '\n\nwp.set_module_options({"enable_backward": False})\n\n\n@wp.struct', 1
    )
    found = breaches_of(source, tmp_path)
    assert len(found) == 1  # sum_squares_kernel, whose docstring now says too little
    assert "sum_squares_kernel" in found[0]
