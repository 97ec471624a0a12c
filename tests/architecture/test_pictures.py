"""Every picture that a document shows is made by `docs/pictures.py`."""

import importlib.util
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def made() -> set[str]:
    spec = importlib.util.spec_from_file_location("pictures", ROOT / "docs" / "pictures.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return {f"docs/pictures/{name}.webp" for name in module.DRAWN}


def shown() -> set[str]:
    pictures = set()
    for document in ROOT.rglob("*.md"):
        if not any(
            part.startswith(".") or part in ("runs", "build", "_build") for part in document.parts[len(ROOT.parts) :]
        ):
            for link in re.findall(r"!\[[^\]]*\]\(([^)\s]+)\)", document.read_text(encoding="utf-8")):
                pictures.add(str((document.parent / link).resolve().relative_to(ROOT)))
    return pictures


def test_every_picture_that_is_shown_is_made_by_a_command_and_there():
    assert shown()
    assert shown() == made()
    kept = [*(ROOT / "docs" / "pictures").iterdir()]
    assert {str(file.relative_to(ROOT)) for file in kept} == made()
    assert sum(file.stat().st_size for file in kept) <= 2_000_000
