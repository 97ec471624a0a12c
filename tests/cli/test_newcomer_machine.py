"""The command line on machines of newcomers: each command works, or ends in one line with nothing half-written.

What is taken away is really taken away: commands run in a namespace of their own (``unshare``) where libraries are
covered by empty files, and folders by read-only or full file systems.
"""

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from tests.cli.small_run import SMALL
from warpav.cli.app import main
from warpav.core.warp_setup import load_warp
from warpav.runs import RunFolder

pytestmark = pytest.mark.usefixtures("working_directory")

RIG = """
frame: ego
cameras:
  - {name: front, position_m: [1.0, 0.0, 1.9], yaw_deg: 0, pitch_deg: 0, roll_deg: 0, fov_deg: 90, width_px: 64,
     height_px: 64}
"""
FOLDER = "Größe & süß"
NO_OPENGL = """
for file in $(PATH=$PATH:/sbin:/usr/sbin ldconfig -p | sed -n 's/.*=> //p' |
    grep -E '/lib(EGL|GL|GLX|GLdispatch|OpenGL|OSMesa|X11)[._]' | xargs -rn1 readlink -f | sort -u)
do mount --bind /dev/null "$file"; done
"""
READ_ONLY = "mkdir -p {0}; mount -t tmpfs -o ro,size=4k none {0}"
FULL = "mkdir -p {0}; mount -t tmpfs -o size=4k none {0}; head -c 8192 /dev/zero 2>&- >{0}/all || true"
INSTALL = "apt install libegl1 libgl1-mesa-dri"


def _kernels():
    """Where the kernels of this machine are: to compile them again would take a minute."""
    return {"WARP_CACHE_PATH": str(Path(load_warp().config.kernel_cache_dir).parent)}


MACHINES = {
    "no OpenGL and no display": (NO_OPENGL, {"DISPLAY": None, "WAYLAND_DISPLAY": None}),
    "HOME not writable": (READ_ONLY.format("home"), {"HOME": "home", "XDG_CACHE_HOME": None, **_kernels()}),
    "no space in TMPDIR": (FULL.format("tmp"), {"TMPDIR": "tmp"}),
    "no TMPDIR": ("", {"TMPDIR": "/nowhere"}),
    "no locale": ("", {"LC_ALL": "C"}),
    "a locale without UTF-8": ("", {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}),
    "a locale that is not installed": ("", {"LC_ALL": "tr_TR.UTF-8"}),
    "output in ASCII": ("", {"PYTHONIOENCODING": "ascii"}),
    "no terminal": ("", {"TERM": None, "COLUMNS": None}),
}
ENCODINGS = list(MACHINES)[4:]
FIRST_ENCODINGS = ("a locale without UTF-8", "output in ASCII")


@cache
def _has_namespaces():
    try:
        done = subprocess.run(["unshare", "-rm", "mount", "-t", "tmpfs", "none", "/tmp"], capture_output=True)
    except OSError:
        return False
    return done.returncode == 0


def _command(argv, mounts=""):
    """A command line of warpav, in a namespace of its own where something is to be mounted."""
    command = [sys.executable, "-m", "warpav.cli.app", *argv]
    if not mounts:
        return command
    if not _has_namespaces():
        pytest.skip("no user may mount here")
    return ["unshare", "-rm", "sh", "-ec", f'{mounts}\nexec "$@"', "sh", *command]


def _environment(changed):
    here = {name: str(Path(value).absolute()) if value in ("home", "tmp") else value for name, value in changed.items()}
    kept = {name: value for name, value in os.environ.items() if here.get(name, "") is not None}
    return kept | {name: value for name, value in here.items() if value is not None}


def _run(argv, machine="no terminal", **changed):
    mounts, environment = MACHINES[machine]
    command = _command(argv, mounts)
    environment = _environment({**environment, **changed})
    return subprocess.run(command, env=environment, capture_output=True, text=True, errors="surrogateescape")


def _require_one_line(done, words):
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert words in done.stderr


# ------------------------------------------------------------------------------------------------ encodings


COMMANDS = [
    ["rig", "check", "Maß ä.yaml"],
    ["modules", "list"],
    ["config", "copy", "quick", "für.yaml"],
    ["report", "Größe"],
]
ONE_AFTER_ANOTHER = """
import sys
from warpav.cli.app import main
for words in sys.argv[1:]:
    status = main(words.split("|"))
    for stream in (sys.stdout, sys.stderr):
        print(f"{status}<end>", file=stream, flush=True)
"""


@pytest.mark.parametrize(
    "machine",
    [name if name in FIRST_ENCODINGS else pytest.param(name, marks=pytest.mark.nightly) for name in ENCODINGS],
)
def test_umlauts_and_degrees_are_printed_somehow(working_directory, machine):
    folder = working_directory / FOLDER
    folder.mkdir()
    (folder / "Maß ä.yaml").write_text(RIG)
    _, environment = MACHINES[machine]
    command = [sys.executable, "-c", ONE_AFTER_ANOTHER, *map("|".join, COMMANDS)]
    done = subprocess.run(command, env=_environment(environment), capture_output=True, cwd=folder, check=True)
    outs, errors = (stream.replace(b"\r", b"").split(b"<end>\n") for stream in (done.stdout, done.stderr))
    for argv, out, error in zip(COMMANDS, outs, errors, strict=False):
        *lines, status = error.split(b"\n")
        if argv[0] == "report":
            assert (status, len(lines)) == (b"2", 1)
        else:
            assert (status, lines) == (b"0", []), error
            assert out.strip(b"0")
        if "ASCII" in machine:
            assert out.isascii()
        if argv[0] == "modules":
            assert ("°" if "ASCII" not in machine and "without" not in machine else "\\xb0") in out.decode()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such paths")
def test_paths_that_are_not_utf_8_are_written_or_refused_in_one_line(capsys):
    path = os.fsdecode(b"F\xe4")
    assert main(["render", "3", "--rig", "nuscenes", "--out", path]) == 0  # OpenCV would end the process
    assert len(os.listdir(path)) == 3 * 6 + 1
    assert capsys.readouterr().out == "wrote F\\udce4\n"
    assert main(["optimise", *SMALL, f"run.out={path}/run"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("command line (run.out=F\\udce4/run): expected text, got half of a character")
    assert line.endswith("set LC_ALL=C.UTF-8")
    assert len(os.listdir(path)) == 3 * 6 + 1


# ------------------------------------------------------------------------------------------------ output


def _with_output(argv, redirection):
    script = f'exec "$@" {redirection}'
    return subprocess.run(["sh", "-c", script, "sh", *_command(argv)], capture_output=True, text=True)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is full")
def test_an_output_that_is_full_is_one_line():
    done = _with_output(["config", "show"], ">/dev/full")
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert "No space left on device" in done.stderr


# ------------------------------------------------------------------------------------------------ OpenGL


def test_an_image_without_opengl_is_one_line():
    done = _run(["inspect", "nuscenes", "--out", "x.png"], "no OpenGL and no display")
    _require_one_line(done, INSTALL)
    assert os.listdir() == []


@pytest.mark.slow
def test_the_doctor_names_what_is_missing():
    done = _run(["doctor", "--json", "found.json"], "no OpenGL and no display")
    assert done.returncode == 0, done.stdout
    (line,) = (line for line in done.stdout.splitlines() if " opengl " in line)
    assert line.startswith("warning")
    assert "libEGL.so.1" in line
    assert INSTALL in line
    with open("found.json") as stream:
        assert json.load(stream)["checks"]["opengl"]["status"] == "warning"
    done = _run(["doctor"], "HOME not writable", WARP_CACHE_PATH=None)
    assert done.returncode == 1
    (line,) = (line for line in done.stdout.splitlines() if " cache " in line)
    assert line.startswith("failed")
    assert "set WARP_CACHE_PATH" in line


# ------------------------------------------------------------------------------------------------ a whole run


@pytest.mark.slow
@pytest.mark.parametrize("machine", MACHINES)
def test_a_run_ends_well(working_directory, machine):
    folder = working_directory / FOLDER
    folder.mkdir()
    mounts, environment = MACHINES[machine]
    out = "first run" if machine == "a locale without UTF-8" else "Läufe/erster Lauf"
    done = subprocess.run(
        _command(["optimise", *SMALL, "run.pictures=few", f"run.out={out}"], mounts),
        env=_environment(environment),
        capture_output=True,
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    run = RunFolder.open(folder / out)
    assert (run.path / "report.html").is_file()
    figures = {file.name for file in (run.path / "figures").iterdir()}
    has_opengl = "OpenGL" not in machine
    assert ("rig.png" in figures) is has_opengl
    lines = done.stdout.decode(errors="replace").splitlines()
    told = [line for line in lines if line.startswith("no picture of the rig in three dimensions: ")]
    assert len(told) == (not has_opengl)
    assert not [name for name in os.listdir(run.path) if name.startswith(".draft")]
