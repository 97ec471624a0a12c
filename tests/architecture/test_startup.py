"""The command line answers at once because nothing heavy is imported before a verb needs it."""

import subprocess
import sys

HEAVY = {
    "warp",
    "pyvista",
    "vtkmodules",
    "trimesh",
    "collada",
    "embreex",
    "cv2",
    "onnxruntime",
    "onnx",
    "matplotlib",
    "scipy",
    "torch",
}


def modules_after(code):
    """Top-level names of all modules that a new interpreter has imported after running the code."""
    report = (
        f"import sys\n{code}\nsys.stderr.write(' '.join(sorted({{name.partition('.')[0] for name in sys.modules}})))"
    )
    result = subprocess.run([sys.executable, "-c", report], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr
    return set(result.stderr.splitlines()[-1].split()), result.stdout


def test_help_imports_nothing_heavy():
    modules, output = modules_after("from warpav.cli.app import main\nassert main(['--help']) in (0, None)")
    assert "optimise" in output
    assert modules & HEAVY == set()


def test_configuration_and_rigs_import_nothing_heavy():
    modules, _ = modules_after("import warpav, warpav.runs.config, warpav.rig.presets, warpav.rig._mount_surface")
    assert modules & HEAVY == set()
