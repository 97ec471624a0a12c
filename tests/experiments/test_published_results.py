"""What is published follows from the numbers that are published with it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from warpav.experiments.summary import write_results_page

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "results.md"
SUMMARIES = {json.loads(file.read_text())["experiment"]: file for file in PAGE.with_suffix("").glob("*.json")}
ARM_OF = {
    "**warpav, `method: default`**": "gradient",
    "cameras around the highest point": "highest",
    "best of random rigs": "random",
    "Sobol sequence": "sobol",
    "CMA-ES, then the gradient": "cma_then_gradient",
    "CMA-ES": "cma",
    "differential evolution": "differential_evolution",
    "greedy set cover": "greedy_cover",
    "the thesis's losses and steps": "thesis_gradient",
}
"""Rows of README's table of arms."""


def test_the_page_is_what_the_command_writes(tmp_path):
    names = re.findall(r"^## (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(names) == sorted(SUMMARIES)
    folders = []
    for k, name in enumerate(names):
        folders.append(tmp_path / str(k))
        folders[-1].mkdir()
        (folders[-1] / "summary.json").write_bytes(SUMMARIES[name].read_bytes())
    written = write_results_page(folders, tmp_path / "results.md")
    assert written.read_text(encoding="utf-8") == PAGE.read_text(encoding="utf-8")


@pytest.mark.parametrize("label", ARM_OF)
def test_readme_quotes_the_runs(label):
    runs = [run for run in json.loads(SUMMARIES["open"].read_text())["runs"] if run["arm"] == ARM_OF[label]]
    [row] = [line for line in (ROOT / "README.md").read_text().splitlines() if line.startswith(f"| {label} |")]
    _, _, recall, lead, _ = (cell.strip(" *") for cell in row.split("|"))
    values = [run["tp_detection_rate"] for run in runs]
    quoted = re.findall(r"[\d.]+", recall)
    assert float(quoted[0]) == pytest.approx(np.mean(values), abs=6e-4)
    if len(quoted) > 1:
        assert float(quoted[1]) == pytest.approx(np.std(values, ddof=1), abs=6e-4)
    interval = re.search(rf"^\| {ARM_OF[label]} \|.*\n.*\n\|  \|  \| \S+ \[(\S+), (\S+)\]", _open_table(), re.MULTILINE)
    quoted = [float(end) for end in re.findall(r"[+-][\d.]+", lead)]
    assert quoted == ([float(end) for end in interval.groups()] if interval else [])


def _open_table():
    return json.loads(SUMMARIES["open"].read_text())["table"]
