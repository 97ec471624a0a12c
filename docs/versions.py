"""Build the documentation of every release beside that of this checkout: ``python docs/versions.py FOLDER``.

FOLDER holds a site of static pages, one folder a version: ``main``, which is this checkout as it is, and every tag such
as ``v0.1.0``, newest first. Their side bars lead from one to the other; the first page leads to the newest release, or
to ``main`` where there is none. Needs ``pip install -e ".[docs]"`` and git.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CURRENT = "main"
_RELEASE = re.compile(r"v(\d+)\.(\d+)\.(\d+)")
_FIRST_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>warpav</title>
<meta http-equiv="refresh" content="0; url={first}/index.html">
<a href="{first}/index.html">warpav</a>
</html>
"""


def releases(repository: Path) -> list[str]:
    """Tags of releases, the newest first; tags of any other form are none."""
    listed = subprocess.run(
        ["git", "-C", repository, "tag", "--list"], check=True, capture_output=True, text=True
    ).stdout.split()
    found = [(tuple(map(int, match.groups())), match.string) for tag in listed if (match := _RELEASE.fullmatch(tag))]
    return [tag for _, tag in sorted(found, reverse=True)]


def build(repository: Path, site: Path) -> None:
    """Build every version, each by its own code and configuration."""
    tags = releases(repository)
    versions = " ".join([CURRENT, *tags])
    with tempfile.TemporaryDirectory() as scratch:
        for version in (CURRENT, *tags):
            source = repository
            if version != CURRENT:
                source = Path(scratch) / version
                _run(["git", "-C", repository, "worktree", "add", "--detach", source, version])
            try:
                command = [sys.executable, "-m", "sphinx", "-q", "-b", "html", source / "docs", site / version]
                _run(command, WARPAV_DOCS_VERSIONS=versions, WARPAV_DOCS_VERSION=version)
            finally:
                if source != repository:
                    _run(["git", "-C", repository, "worktree", "remove", "--force", source])
    shutil.rmtree(site / "jupyter_execute", ignore_errors=True)  # what myst-nb leaves beside every version
    (site / "index.html").write_text(_FIRST_PAGE.format(first=(tags or [CURRENT])[0]), encoding="utf-8")


def _run(command: list[str | Path], **variables: str) -> None:
    subprocess.run(command, check=True, env={**os.environ, **variables})


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(f"expected one folder, got {len(sys.argv) - 1} arguments: python docs/versions.py FOLDER")
    build(ROOT, Path(sys.argv[1]).resolve())
