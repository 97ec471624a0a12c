"""Imports only ever point downwards; the floors stand in pyproject.toml under tool.importlinter."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
CHECK = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"


def lint_imports(folder, config):
    return subprocess.run(
        [sys.executable, "-c", CHECK.replace("no_cache", f"config_filename={str(config)!r}, no_cache")],
        cwd=folder,
        capture_output=True,
        text=True,
    )


def test_imports_point_downwards():
    result = lint_imports(ROOT, ROOT / "pyproject.toml")
    assert result.returncode == 0, result.stdout + result.stderr


def test_an_upward_import_is_found(tmp_path):
    for folder, text in (("upper", ""), ("lower", "import house.upper\n")):
        (tmp_path / "house" / folder).mkdir(parents=True)
        (tmp_path / "house" / folder / "__init__.py").write_text(text)
    (tmp_path / "house" / "__init__.py").write_text("")
    config = tmp_path / "importlinter.toml"
    config.write_text(
        '[tool.importlinter]\nroot_packages = ["house"]\n'
        '[[tool.importlinter.contracts]]\nname = "Floors"\ntype = "layers"\n'
        'containers = ["house"]\nexhaustive = true\nlayers = ["upper", "lower"]\n'
    )
    result = lint_imports(tmp_path, config)
    assert result.returncode == 1
    assert "house.lower is not allowed to import house.upper" in result.stdout
