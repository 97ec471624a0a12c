"""The thesis stands apart: the default method imports nothing of it."""

import subprocess
import sys

CHECK = """
import sys
import warpav.cli.app, warpav.runs._jobs, warpav.runs._optimise, warpav.runs._placement, warpav.optimisation._rivals
print([name for name in sys.modules if name.startswith(("warpav.thesis", "warpav_kernels.thesis"))])
"""


def test_the_default_method_imports_nothing_of_the_thesis():
    found = subprocess.run([sys.executable, "-c", CHECK], capture_output=True, text=True, check=True)
    assert found.stdout.splitlines()[-1] == "[]"
