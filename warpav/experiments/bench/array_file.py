"""Arrays that are written to an ``.npz`` file some rows at a time, so that they need not fit into memory."""

from __future__ import annotations

import os
import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO

import numpy as np

_BLOCK_BYTES = 1 << 22


class ArrayFile:
    """An uncompressed ``.npz`` in the making; a context manager. The file appears whole, by `finish`, or not at all."""

    def __init__(self, file: Path, arrays: Mapping[str, tuple[tuple[int, ...], np.dtype]]) -> None:
        """Room for the arrays in temporary files beside ``file``."""
        self.file = file
        self._arrays = dict(arrays)
        self._parts: dict[str, IO[bytes]] = {}
        self._bytes = dict.fromkeys(arrays, 0)
        self._whole = file.with_name(f".{file.name}.part")

    def __enter__(self) -> ArrayFile:
        folder = self.file.absolute().parent
        self._parts = {name: tempfile.TemporaryFile(dir=folder) for name in self._arrays}  # noqa: SIM115
        return self

    def __exit__(self, *exception: object) -> None:
        for part in self._parts.values():
            part.close()
        self._whole.unlink(missing_ok=True)

    def append(self, name: str, rows: np.ndarray) -> None:
        """Write the next rows of an array."""
        shape, dtype = self._arrays[name]
        assert rows.dtype == dtype, (name, rows.dtype)
        assert rows.shape[1:] == shape[1:], (name, rows.shape)
        self._parts[name].write(np.ascontiguousarray(rows).data)
        self._bytes[name] += rows.nbytes

    def finish(self) -> None:
        """Put all arrays into the file, which must have all their rows by now."""
        with zipfile.ZipFile(self._whole, "w", zipfile.ZIP_STORED) as archive:
            for name, (shape, dtype) in self._arrays.items():
                assert self._bytes[name] == np.prod(shape, dtype=np.int64) * dtype.itemsize, name
                header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
                part = self._parts[name]
                part.seek(0)
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array_header_1_0(member, header)
                    shutil.copyfileobj(part, member, _BLOCK_BYTES)
        os.replace(self._whole, self.file)
