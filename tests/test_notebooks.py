"""The notebooks run with small settings, and what is committed of them is what ``notebooks/execute.py`` makes."""

import ast
import base64
import itertools
import json
import re
import sys
from pathlib import Path

import pytest

from notebooks.execute import SMALL, SOURCES, executed, read_source
from tests.architecture.test_docs import anchors
from tests.view.stand_ins import needs_opengl

MAX_BYTES = 600_000
PLACES = re.compile(r"(?<![\w.~])/(?:home|root|Users|tmp|work|var|mnt|opt|usr|private)/\S*|[A-Z]:\\\w\S*")
"""Absolute paths of a machine, which would name its user or its folders."""

each_notebook = pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)


def notebook_of(source):
    return json.loads(source.with_suffix(".ipynb").read_text())


def code_cells(source):
    return [cell for cell in notebook_of(source)["cells"] if cell["cell_type"] == "code"]


def texts(cell):
    for output in cell["outputs"]:
        yield "".join(output.get("text", ""))
        for kind, content in output.get("data", {}).items():
            if not kind.startswith("image/"):
                yield "".join(content)


def test_there_are_nine_notebooks_each_with_a_source():
    assert [source.stem[:2] for source in SOURCES] == ["01", "02", "03", "04", "05", "06", "07", "08", "09"]
    assert (
        {file.stem for file in SOURCES[0].parent.glob("*.ipynb")} == {source.stem for source in SOURCES} == set(SMALL)
    )


@each_notebook
def test_source_and_notebook_are_a_pair(source):
    """Fails after a change of the one that was not carried over: run ``python notebooks/execute.py NAME``."""
    wanted = [(cell.cell_type, cell.source, cell.metadata.get("tags")) for cell in read_source(source).cells]
    notebook = notebook_of(source)
    found = [(c["cell_type"], "".join(c["source"]), c["metadata"].get("tags")) for c in notebook["cells"]]
    assert found == wanted
    assert notebook["metadata"]["jupytext"]["formats"] == "ipynb,py:percent"


@each_notebook
def test_outputs_are_those_of_one_run_without_errors(source):
    cells = code_cells(source)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    kinds = [output["output_type"] for cell in cells for output in cell["outputs"]]
    assert "error" not in kinds
    assert not [text for cell in cells for text in texts(cell) if "Traceback" in text or "Warning" in text]
    assert not [text for cell in cells for text in texts(cell) if "\x1b" in text]  # of a terminal


@each_notebook
def test_pictures_are_there_and_small(source):
    pictures = [
        base64.b64decode("".join(content))
        for cell in code_cells(source)
        for output in cell["outputs"]
        for kind, content in output.get("data", {}).items()
        if kind in ("image/png", "image/jpeg")
    ]
    assert pictures
    assert all(picture.startswith((b"\x89PNG", b"\xff\xd8")) for picture in pictures)
    assert source.with_suffix(".ipynb").stat().st_size < MAX_BYTES


@each_notebook
def test_no_output_names_a_place_of_a_machine(source):
    assert not [text for cell in code_cells(source) for text in texts(cell) if PLACES.search(text)]
    assert str(Path.home()) not in source.with_suffix(".ipynb").read_text()


def test_places_of_a_machine_would_be_found():
    assert PLACES.search("wrote /home/ada/x.png")
    assert PLACES.search("(/tmp/tmpabc/van.glb)")
    assert not PLACES.search("~/.cache/warpav/x.json and van/figures/rig.png, 8/80")


@each_notebook
def test_reads_as_a_page(source):
    words = "\n\n".join(cell.source for cell in read_source(source).cells if cell.cell_type == "markdown")
    levels = [len(hashes) for hashes in re.findall(r"^(#+) ", words, re.MULTILINE)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(later <= earlier + 1 for earlier, later in itertools.pairwise(levels))
    for target in re.findall(r"\]\(([^)\s]+)\)", words):
        file, _, part = target.partition("#")
        place = source.parent / file
        assert "://" in target or (place.exists() and (not part or part in anchors(place))), target


@each_notebook
def test_opens_with_its_question_and_ends_with_what_to_do_next(source):
    words = [cell.source for cell in read_source(source).cells if cell.cell_type == "markdown"]
    assert re.match(r"# .+\n\n\*\*[^*]+\?\*\*", words[0])
    assert "\n## What to do next\n" in words[-1]
    assert read_source(source).cells[-1].cell_type == "markdown"


PUBLIC = {"warpav", "warpav.raster", "numpy", "matplotlib.pyplot", "IPython.display"}
FRAMEWORKS = {"warp", "torch", "warpav.raster.torch"}  # whose tapes and tensors the rasteriser takes


def beyond_the_public_api(code):
    """Imports of more than the public API, numpy and what draws; and what reaches for a shell or the environment."""
    found = re.findall(r"^\s*[%!].*|\b(?:subprocess|environ|getenv|popen|get_ipython|os\.system)\b", code, re.MULTILINE)
    for node in ast.walk(ast.parse("" if found else code)):
        names = [each.name for each in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{name}" for name in names] if node.module.startswith("warpav") else [node.module]
        found += [name for name in names if name not in PUBLIC and name.split(".")[0] not in sys.stdlib_module_names]
    return set(found)


@each_notebook
def test_uses_the_public_api_alone_in_few_cells(source):
    cells = read_source(source).cells
    found = set().union(*(beyond_the_public_api(cell.source) for cell in cells if cell.cell_type == "code"))
    assert found <= (FRAMEWORKS if source.stem == "03_rasteriser" else set())
    assert all(map(beyond_the_public_api, ["from warpav.runs import fit", "import scipy.ndimage", "!ls", "os.environ"]))
    assert len(cells) < 25


def assigned_names(code):
    targets = [target for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Assign) for target in node.targets]
    parts = [part for target in targets for part in (target.elts if isinstance(target, ast.Tuple) else [target])]
    return {ast.unparse(part) for part in parts}


@each_notebook
def test_small_settings_are_settings_of_the_notebook(source):
    (cell,) = [c.source for c in read_source(source).cells if "parameters" in c.metadata.get("tags", [])]
    assert assigned_names(SMALL[source.stem])
    assert assigned_names(SMALL[source.stem]) <= assigned_names(cell)


@pytest.mark.slow
@needs_opengl
@each_notebook
def test_notebook_runs_with_small_settings(source):
    notebook = executed(source, small=True)
    outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", [])]
    kinds = {kind for output in outputs for kind in output.get("data", {})}
    assert kinds & {"image/png", "image/jpeg"}
    text = "".join(output.get("text", "") for output in outputs)
    assert "Traceback" not in text
    assert not PLACES.search(text)
