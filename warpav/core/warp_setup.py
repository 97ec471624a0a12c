"""Warp without its start-up messages, and its kernels compiled several at a time."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

from warpav.core.cores import available_cores
from warpav.core.errors import InputError, OptionError

_KERNELS = "warpav_kernels"
_MMAP_THRESHOLD, _LARGE_BYTES = -3, 2**22
"""Of glibc: blocks from this size go back to the system when they are freed, and leave no holes in the heap."""


@cache
def load_warp() -> Any:  # noqa: ANN401 (the module)
    """The module ``warp``, initialised without its start-up messages."""
    import warp

    warp.config.log_level = warp.LOG_ERROR
    with contextlib.suppress(AttributeError, OSError, TypeError):  # there is no glibc
        ctypes.CDLL(None).mallopt(_MMAP_THRESHOLD, _LARGE_BYTES)
    if os.path.expanduser("~") == "~" and not {"WARP_CACHE_PATH", "XDG_CACHE_HOME"} & os.environ.keys():
        # Warp would make a folder of that name here
        raise InputError(
            "expected a home, where Warp keeps compiled kernels, got none; set WARP_CACHE_PATH to a folder"
        )
    try:
        with _muted_stderr():  # without a GPU its native library complains whatever the log level
            warp.init()
        _process()
        folder = Path(warp.config.kernel_cache_dir or "")
        if not os.access(folder, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder))
    except OSError as error:
        raise InputError(
            f"{error.filename}: expected a folder for Warp's compiled kernels that can be written, got: "
            f"{error.strerror}; set WARP_CACHE_PATH to one"
        ) from None
    return warp


@cache
def _process() -> int:
    return os.getpid()


@contextlib.contextmanager
def compiling(device: str, *, but: Sequence[str] = ()) -> Iterator[None]:
    """Compile the kernels imported so far, long ones first, while the block does something else, but launch them."""
    warp = load_warp()
    own, left_out = f"{_KERNELS}.", tuple(f"{_KERNELS}.{name}" for name in but)
    names = [name for name in sys.modules if name.startswith(own) and not name.startswith(left_out)]
    sizes = {name: len(Path(file).read_bytes()) for name in names if (file := sys.modules[name].__file__)}
    found = [warp.get_module(name) for name in sorted(sizes, key=lambda name: -sizes[name])]
    modules = [module for module in found if module.kernels]
    _ = warp.get_device(device).context  # Warp makes it on first use, and two threads must not be the first at once
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(warp.force_load, device, modules, max_workers=available_cores())
        yield
        done.result()


@contextlib.contextmanager
def _muted_stderr() -> Iterator[None]:
    """Nothing that this process writes to file 2 comes through, not even from C."""
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(nowhere)
        os.close(kept)


def checked_device(device: str) -> str:
    """The name of a Warp device that this machine has; a GPU is lost to processes forked from one that found it."""
    names = [each.alias for each in load_warp().get_devices()]
    if device.startswith("cuda") and _process() != os.getpid():
        text = (
            f"expected a process that was started on its own for {device}, got one that was forked from one with Warp"
        )
        raise OptionError("device", f'{text}; start it by multiprocessing.get_context("spawn")')
    if device not in names:
        raise OptionError("device", f"expected one of {', '.join(names)}, got {device!r}; warpav doctor lists them")
    return device


def device_name(device: str) -> str:
    """Alias and name of a Warp device, such as ``cuda:0 (NVIDIA H100)``."""
    found = load_warp().get_device(device)
    return f"{found.alias} ({found.name})"
