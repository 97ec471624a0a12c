"""Files around the code: versions agree, forms and workflows are what they say."""

import re
import tomllib
from pathlib import Path

import yaml

import warpav

ROOT = Path(__file__).parents[2]


def loaded(name):
    return yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))


def test_the_version_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    headings = re.findall(r"^## \[(\S+)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert headings[0] == "Unreleased"
    assert {project["version"], loaded("CITATION.cff")["version"], headings[1]} == {warpav.__version__}
    assert loaded("CITATION.cff")["license"] == project["license"]


def test_the_workflow_runs_the_full_check():
    [job] = loaded(".github/workflows/check.yml")["jobs"].values()
    assert job["steps"][-1] == {"run": ".ci/run"}
    assert (ROOT / ".ci/run").stat().st_mode & 0o111


def test_forms_ask_for_something():
    forms = [file for file in (ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml") if file.name != "config.yml"]
    assert len(forms) == 2
    for file in forms:
        form = yaml.safe_load(file.read_text(encoding="utf-8"))
        assert form.keys() >= {"name", "description", "body"}
        assert len({part["id"] for part in form["body"]}) == len(form["body"])


def test_the_image_runs_the_command_without_root():
    lines = (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines()
    order = [line.split()[0] for line in lines if re.match(r"[A-Z]+ ", line)]
    assert 'ENTRYPOINT ["warpav"]' in lines
    assert order.index("USER") < order.index("ENTRYPOINT")
