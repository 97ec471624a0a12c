"""The thesis stands apart: the default method imports nothing of it."""

import subprocess
import sys

CHECK = """
import sys
import warpav.cli.app, warpav.runs.jobs, warpav.runs.optimise, warpav.runs.placement, warpav.optimisation.rivals
print([name for name in sys.modules if name.startswith(("warpav.thesis", "warpav_kernels.thesis"))])
"""


def test_the_default_method_imports_nothing_of_the_thesis():
    found = subprocess.run([sys.executable, "-c", CHECK], capture_output=True, text=True, check=True)
    assert found.stdout.splitlines()[-1] == "[]"
