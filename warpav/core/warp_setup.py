"""Warp without its start-up messages."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from functools import cache
from typing import Any


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
