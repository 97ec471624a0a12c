"""The documentation of several versions, beside each other."""

import subprocess

import pytest

import versions


@pytest.fixture
def repository(tmp_path):
    """A repository whose pages say which version they are of, with two releases."""

    def git(*words):
        identity = ("-c", "user.name=a", "-c", "user.email=a@example.org")
        subprocess.run(["git", "-C", tmp_path, *identity, *words], check=True, capture_output=True)

    git("init", "-q")
    (tmp_path / "docs").mkdir()
    for tag in ("v0.2.0", "v0.10.0", "nightly", "v0.3.0-rc1", "later"):
        (tmp_path / "docs" / "page").write_text(tag)
        git("add", "-A")
        git("commit", "-qm", tag)
        git("tag", tag)
    return tmp_path


def test_tags_of_three_numbers_are_built_by_their_own_files_the_newest_first(repository, tmp_path, monkeypatch):
    built = {}

    def sphinx(command, **variables):
        if "sphinx" in command:
            source, target = command[-2:]
            built[target.name] = ((source / "page").read_text(), variables)
            target.mkdir(parents=True)
        else:
            subprocess.run(command, check=True, capture_output=True)

    monkeypatch.setattr(versions, "_run", sphinx)
    versions.build(repository, tmp_path / "site")
    assert {name: page for name, (page, _) in built.items()} == {
        "main": "later", "v0.10.0": "v0.10.0", "v0.2.0": "v0.2.0",
    }  # fmt: skip
    assert built["v0.2.0"][1] == {
        "WARPAV_DOCS_VERSIONS": "main v0.10.0 v0.2.0", "WARPAV_DOCS_VERSION": "v0.2.0",
    }  # fmt: skip
    assert "url=v0.10.0/index.html" in (tmp_path / "site" / "index.html").read_text()
    listed = subprocess.run(["git", "-C", repository, "worktree", "list"], check=True, capture_output=True, text=True)
    assert len(listed.stdout.splitlines()) == 1
