"""Warp without its start-up messages, and its kernels compiled several at a time."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

from warpav.core.executor import available_cores


@cache
def load_warp() -> Any:  # noqa: ANN401 (the module)
    """The module ``warp``, initialised without its start-up messages.

    Whoever wants messages raises ``warp.config.log_level`` after the first call.
    """
    import warp

    warp.config.log_level = warp.LOG_ERROR
    with _muted_stderr():  # without a GPU its native library complains whatever the log level
        warp.init()
    return warp


@contextlib.contextmanager
def compiling(modules: Sequence[str], *, device: str) -> Iterator[None]:
    """Compile and load modules of kernels while the block does something else; they are ready when it ends.

    Warp compiles a module when one of its kernels is launched first, one module after the other, for seconds each. The
    block must not launch kernels of these modules: it would compile them too.

    Args:
        modules: Such as ``warpav_kernels.raster.measure``, those that take longest first.
        device: Warp device.

    Raises:
        Exception: Of the compiler.
    """
    warp = load_warp()
    loaded = [warp.get_module(importlib.import_module(name).__name__) for name in modules]
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(warp.force_load, device, loaded, max_workers=available_cores())
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
