"""Warp says nothing of itself where warpav is used from Python, and compiles kernels while something else is done."""

import multiprocessing
import os
import pwd
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor

import pytest

from warpav.core.cache import user_cache_folder
from warpav.core.errors import InputError
from warpav.core.warp_setup import checked_device, load_warp

PACK = """
from warpav.scene._device_scene import DeviceScene
from warpav.scene.town._town import town_scene
DeviceScene.pack(town_scene(3))
"""


def test_a_scene_is_packed_without_a_word():
    done = subprocess.run([sys.executable, "-c", PACK], check=True, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("", "")


COMPILE = """
import sys, warp
warp.config.kernel_cache_dir = sys.argv[1]
from warpav_kernels.detection import network_input
from warpav_kernels.placement import exchange
from warpav_kernels.reconstruction import plane_fit
from warpav.core.warp_setup import compiling
with compiling("cpu", but=["reconstruction.plane"]):
    print("meanwhile")
modules = [warp.get_module(module.__name__) for module in (network_input, exchange)]
before = [dict(module.execs) for module in modules]
warp.force_load("cpu", modules)  # nothing is left to do
print(all(one and one == module.execs for one, module in zip(before, modules)))
"""


def test_kernels_are_compiled_when_the_block_ends(tmp_path):
    done = subprocess.run([sys.executable, "-c", COMPILE, tmp_path], check=True, capture_output=True, text=True)
    assert (done.stdout.split(), done.stderr) == (["meanwhile", "True"], "")
    compiled = {file.name.rsplit("_", 1)[0].removeprefix("wp_warpav_kernels.") for file in tmp_path.glob("*/wp_*")}
    assert {"detection.network_input", "placement.exchange"} <= compiled
    assert "reconstruction.plane_fit" not in compiled


def test_a_cache_in_which_nothing_may_be_written_is_refused(monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(InputError, match=r"expected a folder .* written, got: Permission denied; set WARP_CACHE_PATH"):
        load_warp.__wrapped__()


def device_or_error(device):
    try:
        return checked_device(device)
    except InputError as error:
        return str(error)


def test_a_forked_process_is_told_that_it_has_no_gpu():
    load_warp()
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool:
        gpu, cpu = pool.map(device_or_error, ("cuda:0", "cpu"))
    assert "got one that was forked" in gpu
    assert 'start it by multiprocessing.get_context("spawn")' in gpu
    assert cpu == "cpu"


def test_without_a_home_nothing_is_kept_and_kernels_need_a_folder(monkeypatch):
    def unknown(user):
        raise KeyError(user)

    for variable in ("HOME", "XDG_CACHE_HOME", "WARP_CACHE_PATH"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    folder = user_cache_folder("scenes")
    with pytest.raises(OSError, match="Not a directory"):
        folder.mkdir(parents=True)
    assert not folder.exists()
    with pytest.raises(InputError, match=r"expected a home, .* got none; set WARP_CACHE_PATH to a folder"):
        load_warp.__wrapped__()


@pytest.mark.parametrize("place", [pytest.param("/proc/none", marks=pytest.mark.nightly), "file"])
def test_a_cache_that_cannot_be_written_names_its_variable(tmp_path, place):
    (tmp_path / "file").write_text("")
    code = "import sys; from warpav.cli.app import main; sys.exit(main(['bench', '--items', 'w1', '--json', 'o.json']))"
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / place), "HOME": "/proc/none"}
    result = subprocess.run(
        [sys.executable, "-c", code],
        env={**environment, "PYTHONPATH": os.pathsep.join(sys.path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert "expected a folder for Warp's compiled kernels that can be written" in result.stderr
    assert "set WARP_CACHE_PATH" in result.stderr
