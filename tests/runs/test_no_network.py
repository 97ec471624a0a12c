"""Optimise, evaluate and report reach no network: not even a socket that could is made."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.small_run import SMALL

WATCH = """
import sys

def watch(event, arguments):
    if event == "socket.__new__" and arguments[1] in (2, 10):
        sys.stderr.write(f"a socket of family {arguments[1]}\\n")
        raise PermissionError("the test allows no network")
    if event in ("socket.connect", "socket.getaddrinfo", "socket.sendto") and "127.0.0.1" not in str(arguments):
        sys.stderr.write(f"{event} {arguments[1:]}\\n")
        raise PermissionError("the test allows no network")

sys.addaudithook(watch)
"""
COMMANDS = """
import os, sys
from pathlib import Path
from warpav.cli.app import main

assert main(["optimise", *sys.argv[1:], "run.out=run"]) == 0
assert main(["evaluate", "run", "--json", "metrics.json"]) == 0
assert main(["report", "run"]) == 0
inodes = {
    line.split()[9]
    for name in ("tcp", "tcp6", "udp", "udp6")
    for line in Path(f"/proc/self/net/{name}").read_text().splitlines()[1:]
}
open_sockets = set()
for handle in Path("/proc/self/fd").iterdir():
    try:
        target = os.readlink(handle)
    except OSError:
        continue
    if target.startswith("socket:[") and target[8:-1] in inodes:
        open_sockets.add(target)
print("sockets:", len(open_sockets))
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/net/tcp").is_file(), reason="no /proc to list sockets of")
def test_commands_open_no_socket(tmp_path):
    """The hook of every Python process, workers too, refuses sockets; what libraries open themselves is counted."""
    (tmp_path / "sitecustomize.py").write_text(WATCH)
    kept = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    result = subprocess.run(
        [sys.executable, "-c", COMMANDS, *SMALL, "run.pictures=all"],
        env={**kept, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert "socket" not in result.stderr
    assert result.stdout.splitlines()[-1] == "sockets: 0"
    assert (tmp_path / "run" / "report.html").is_file()


def test_the_watch_sees_a_socket(tmp_path):
    (tmp_path / "sitecustomize.py").write_text(WATCH)
    result = subprocess.run(
        [sys.executable, "-c", "import socket; socket.socket(socket.AF_INET)"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "a socket of family 2" in result.stderr
