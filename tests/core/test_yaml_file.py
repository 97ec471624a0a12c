"""Names as YAML."""

import pytest

from warpav.core.yaml_file import read_yaml, yaml_name

PLAIN = ["front", "front_left.2-b", "left pillar", "Haube ä"]
QUOTED = ["no", "1e3", "2026-01-01", "", " a"]
QUOTED += [
    "no",
    "1e3",
    "2026-01-01",
    "",
    " a",
    "a: b",
    "a #b",
    "- a",
    "é\x1b[31m\n[/]\"'\\",
    "\x7f\x85\u2028\ufeff",
    "😀",
]


@pytest.mark.parametrize("name", PLAIN + QUOTED)
def test_a_name_comes_back(name):
    text = yaml_name(name)
    assert (text == name) is (name in PLAIN)
    assert read_yaml(f"zones:\n  {text}:\n    name: {text}\n")[0] == {"zones": {name: {"name": name}}}
