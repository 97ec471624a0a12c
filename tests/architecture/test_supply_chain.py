"""What is installed with warpav: licences, true lower bounds, and a lock that belongs to pyproject.toml."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from tests.architecture.dependencies import WEAK_COPYLEFT, _permissive, core_dependencies, normalised

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_all_that_is_installed_has_a_permissive_licence():
    found = core_dependencies()
    assert {"numpy", "warp-lang", "pyvista"} <= {each.name for each in found if each.is_direct}
    others = {each.name: each.said for each in found if not each.licences and each.name not in WEAK_COPYLEFT}
    assert not others, f"neither permissive nor accepted by name: {others}"


@pytest.mark.parametrize(
    "said",
    ["AGPL-3.0-or-later", "GNU Lesser General Public License v3", "MPL-2.0", "MIT AND GPL-2.0", "", "Proprietary"],
)
def test_other_licences_are_seen(said):
    assert _permissive(said) == ()


def test_every_core_dependency_says_the_oldest_version_that_works():
    # .ci/run installs exactly these and runs the tests with them
    for text in PROJECT["dependencies"]:
        requirement = Requirement(text)
        assert [each.operator for each in requirement.specifier] == [">="], text


def test_the_lock_belongs_to_the_project():
    lock = (ROOT / ".ci" / "dev.lock").read_text(encoding="utf-8")
    pinned: dict[str, list[Version]] = {}
    for name, version in re.findall(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)", lock, re.MULTILINE):
        pinned.setdefault(normalised(name), []).append(Version(version))
    for text in [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["dev"]]:
        requirement = Requirement(text)
        versions = pinned.get(normalised(requirement.name), [])
        assert versions, f"{requirement.name} is not in .ci/dev.lock; CONTRIBUTING.md says how to make it again"
        assert all(requirement.specifier.contains(each, prereleases=True) for each in versions), (text, versions)
    assert lock.count("--hash=sha256:") > len(pinned)  # every file by its content, from whatever index
    assert "://" not in lock
