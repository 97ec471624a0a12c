"""Pages of documentation: their links lead somewhere, their tables are whole, their options exist."""

import re
from pathlib import Path

import pytest

from warpav.config import Config, option_values

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
METHOD = ROOT / "docs" / "method.md"


def anchor(heading):
    """What GitHub makes of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def anchors(page):
    return {anchor(found) for found in re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)}


def lost_links(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if "://" in target:
            continue
        file, _, part = target.partition("#")
        place = (page.parent / file).resolve() if file else page
        if not place.exists() or (part and part not in anchors(place)):
            yield target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    assert list(lost_links(page)) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_rows_of_a_table_have_as_many_cells_as_its_head(page):
    width = None
    for line in page.read_text().splitlines():
        if not line.startswith("|"):
            width = None
            continue
        cells = len(re.sub(r"\\\||`[^`]*`", "", line).strip().strip("|").split("|"))
        width = width or cells
        assert cells == width, line


def test_all_thirty_two_open_places_are_answered_in_order():
    section = METHOD.read_text().partition("\n## Where the text of the thesis is open")[2].partition("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in section.splitlines() if re.match(r"\| \d", line)]
    assert [int(row[0]) for row in rows] == list(range(1, 33))
    assert all(cell.strip() for row in rows for cell in row)
    assert all(row[4].count("](") == 2 for row in rows)  # a module and a test


def test_options_that_the_documentation_names_exist():
    options, sections = option_values(Config()), Config.model_fields
    named = set(re.findall(r"`([a-z]+)\.([a-z_]+)(?:: [^`]*)?`", METHOD.read_text()))
    named = {(section, option) for section, option in named if section in sections}
    assert len(named) > 15
    assert {f"{section}.{option}" for section, option in named} - set(options) <= {
        "detector.classes",
        "rig.free",
    }  # sections
