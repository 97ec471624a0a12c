"""The documentation keeps its promises: links lead somewhere, tables are whole, options, commands and code are real."""

import importlib.util
import io
import pkgutil
import re
import shlex
import tomllib
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from cyclopts import CycloptsError

from warpav.cli._arguments import DEFAULT_CONFIG
from warpav.cli.app import app, main, placed
from warpav.runs.config import Config, load_config, option_values

ROOT = Path(__file__).parents[2]
DECISIONS = ROOT / "docs" / "decisions"
DOCS = sorted((ROOT / "docs").rglob("*.md"))
RECORDS = sorted(page for folder in ("warpav", "kernels") for page in (ROOT / folder).rglob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS, *RECORDS]
METHOD = ROOT / "docs" / "method.md"
TUTORIAL = ROOT / "docs" / "tutorial.md"
MISTAKE = "warpav optimise rig.camera=6"  # of the tutorial, on purpose


def name_of(page):
    return page.relative_to(ROOT).as_posix()


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


def blocks(page, language):
    """Texts of the fences of a language, each with the text of the fence that comes next."""
    fences = re.findall(r"^```(\S*)\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)
    for (kind, text), (_, after) in zip(fences, [*fences[1:], ("", "")], strict=False):
        if kind == language:
            yield text, after


def commands():
    """Page and words of every command of warpav that a page tells the reader to type."""
    for page in PAGES:
        found = [line.removeprefix("$ ") for text, _ in blocks(page, "console") for line in text.splitlines()]
        found += [line for text, _ in blocks(page, "") for line in text.splitlines()]
        if page.parent.name == "guide":  # in tables; the name of a command alone is none to type
            found += re.findall(r"^\|.*`(warpav [^`]+)`", page.read_text(), re.MULTILINE)
        for line in found:
            words = shlex.split(line, comments=True) if line.startswith("warpav ") else []
            if words and line != MISTAKE:
                yield pytest.param(words[1:], id=f"{name_of(page)}: {line}")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere_and_tables_are_whole(page):
    assert list(lost_links(page)) == []
    width = None
    for line in page.read_text().splitlines():
        cells = len(re.sub(r"\\\||`[^`]*`", "", line).strip().strip("|").split("|")) if line.startswith("|") else None
        assert width is None or cells in (None, width), line
        width = cells and (width or cells)


def test_all_thirty_two_open_places_are_answered_in_order():
    section = METHOD.read_text().partition("\n## Where the text of the thesis is open")[2].partition("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in section.splitlines() if re.match(r"\| \d", line)]
    assert [int(row[0]) for row in rows] == list(range(1, 33))
    assert all(row[4].count("](") == 2 for row in rows)  # a module and a test


def test_options_that_the_documentation_names_exist():
    options = option_values(Config())
    known = {".".join(name.split(".")[: length + 1]) for name in options for length in range(name.count(".") + 1)}
    named = {}
    for page in DOCS:
        for name in re.findall(r"`([a-z]+(?:\.[a-z_]+)+)(?:[:=][^`]*)?`", page.read_text()):
            if name.split(".")[0] in Config.model_fields and not name.endswith((".py", ".yaml", ".json")):
                named.setdefault(name, name_of(page))
    assert len(named) > 30
    assert {name: page for name, page in named.items() if name not in known} == {}


def test_modules_and_tests_that_the_documentation_names_exist():
    lost, count = [], 0
    for page in PAGES:
        tests = re.findall(r"(?<![:/\w])(tests/[\w/]+\.\w+)", page.read_text())
        lost += [f"{name_of(page)}: {test}" for test in tests if not (ROOT / test).exists()]
        for name in re.findall(r"`(warpav(?:\.[A-Za-z_]\w*)+)", page.read_text()):
            count += 1
            try:
                pkgutil.resolve_name(name.removesuffix(".torch"))  # may not be installed
            except (ImportError, AttributeError):
                lost.append(f"{name_of(page)}: {name}")
    assert lost == []
    assert count > 5


def understand(words):
    """Parse a command as the command line does, with the files that it names in place."""
    for value in (word.rpartition("=")[2].strip("[]") for word in words):
        if re.fullmatch(r"[\w/.-]+\.(yaml|glb|onnx)", value):
            Path(value).parent.mkdir(exist_ok=True)
            Path(value).touch()
        elif re.fullmatch(r"[a-z_]+", value):
            Path(value).mkdir(exist_ok=True)
    _, bound, _ = app.parse_args(placed(words), exit_on_error=False, print_error=False)
    config, overrides = bound.arguments.get("config"), [*bound.arguments.get("overrides", ())]
    if config is not None and "=" in config:
        config, overrides = None, [config, *overrides]
    load_config(config or DEFAULT_CONFIG, overrides)


@pytest.mark.parametrize("words", list(commands()))
def test_commands_of_the_documentation_are_understood(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    understand(words)


def test_a_slip_in_a_command_would_be_found(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CycloptsError, match="angle"):
        understand(["inspect", "mine", "--angle", "sight"])


@pytest.mark.parametrize("page", [page for page in DOCS if list(blocks(page, "python"))], ids=name_of)
def test_code_prints_what_the_page_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for code, expected in blocks(page, "python"):
        if "import torch\n" in code and importlib.util.find_spec("torch") is None:
            continue
        with redirect_stdout(io.StringIO()) as output:
            exec(compile(code, name_of(page), "exec"), {})
        assert output.getvalue() == expected


def test_the_refusal_in_the_tutorial_is_the_real_one(capsys):
    command = f"$ {MISTAKE}\n"
    shown = next(text for text, _ in blocks(TUTORIAL, "console") if text.startswith(command))
    assert main(MISTAKE.split()[1:]) == 2
    assert command + capsys.readouterr().err == shown


def test_the_reference_lists_every_module_from_top_to_bottom():
    floors = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]["layers"]
    modules = [f"warpav.{name}" for floor in floors for name in re.findall(r"\w+", floor)]
    listed = re.findall(r"^   (warpav\S*)$", (ROOT / "docs" / "reference" / "api.md").read_text(), re.MULTILINE)
    assert [name for name in listed if name.count(".") == 1] == modules
    packages = {".".join(file.parent.relative_to(ROOT).parts) for file in (ROOT / "warpav").rglob("__init__.py")}
    assert packages - {"warpav"} <= set(listed)


def test_decisions_are_dated_and_their_pages_listed():
    pages = sorted(page for page in DECISIONS.glob("*.md") if page.stem != "index")
    assert 0 < len(pages) < 12
    listed = re.findall(r"^\| \[\w+\]\((\w+\.md)\)", (DECISIONS / "index.md").read_text(), re.MULTILINE)
    assert sorted(listed) == [page.name for page in pages]
    for page in pages:
        entries = re.split(r"^- ", page.read_text(), flags=re.MULTILINE)[1:]
        assert [entry for entry in entries if not re.match(r"\*\*[^*]+\*\*[^*]*?\(2\d{3}-\d\d-\d\d[,)]", entry)] == []


def test_documents_stay_short():
    generated = ROOT / "docs" / "results.md"
    assert sum(page.stat().st_size for page in DOCS if page != generated) <= 290_000
    assert len([page for page in DOCS if page.parent.name == "guide"]) <= 12
    lines = PAGES[0].read_text().splitlines()
    assert sum(len(line.split()) for line in lines) <= 900
    assert len(lines) <= 120 >= max(map(len, lines))
