"""onnxruntime's telemetry is off in every process that imports warpav or is started by it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import warpav

VARIABLE = "ORT_DISABLE_TELEMETRY"

SESSION = """
import os, sys
from pathlib import Path

from warpav.detection._onnx_detector import BUILTIN_MODEL_PATH
import onnxruntime

session = onnxruntime.InferenceSession(str(BUILTIN_MODEL_PATH), providers=["CPUExecutionProvider"])
print(os.environ["ORT_DISABLE_TELEMETRY"])
handles = [os.readlink(each) for each in Path("/proc/self/fd").iterdir() if each.is_symlink()]
print(sum(handle.startswith("socket:") for handle in handles))
"""

WORKER = """
import os
from warpav.core.executor import Processes

if __name__ == "__main__":
    pool = Processes(os.getenv, 1)
    [task] = pool.start(["ORT_DISABLE_TELEMETRY"])
    print(pool.outcome(task).result)
    pool.close([task])
"""


def run_python(*words, **environment):
    kept = {name: value for name, value in os.environ.items() if name != VARIABLE}
    result = subprocess.run(
        [sys.executable, *words],
        env={**kept, **environment},
        cwd=Path(warpav.__file__).parents[1],
        capture_output=True,
        text=True,
        check=True,
    )
    return result.stdout.split()


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="no /proc to list sockets of")
def test_a_session_opens_no_socket():
    assert run_python("-c", SESSION) == ["1", "0"]


def test_what_the_user_set_stays():
    code = "import os, warpav; print(os.environ['ORT_DISABLE_TELEMETRY'])"
    assert run_python("-c", code, ORT_DISABLE_TELEMETRY="0") == ["0"]


def test_worker_processes_inherit_it(tmp_path):
    script = tmp_path / "worker.py"
    script.write_text(WORKER)
    assert run_python(str(script), PYTHONPATH=str(Path(warpav.__file__).parents[1])) == ["1"]
