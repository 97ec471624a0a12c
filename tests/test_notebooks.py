"""Every notebook runs from top to bottom."""

import json
from pathlib import Path

import pytest

from warpav.view.opengl import opengl_problem

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.skipif(opengl_problem() is not None, reason=f"no OpenGL: {opengl_problem()}")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, monkeypatch, tmp_path):
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    for number, cell in enumerate(json.loads(path.read_text())["cells"]):
        if cell["cell_type"] == "code":
            assert not cell["outputs"], f"cell {number}: committed with outputs"
            exec(compile("".join(cell["source"]), f"{path.name}, cell {number}", "exec"), names)
    objectives = [candidate.training_objective for candidate in names["descent"].candidates]
    assert min(objectives) <= objectives[0]
