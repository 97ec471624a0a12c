"""Files from elsewhere, read within bounds that hold before any parser or array takes time or memory.

Every reader of user files begins here or in `warpav.core.yaml_file`. Messages name the bound that was exceeded.
"""

from __future__ import annotations

import contextlib
import gzip
import importlib
import io
import json
import math
import re
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING, Any, NoReturn
from xml.etree import ElementTree

from warpav.core.errors import InputError, install_text

if TYPE_CHECKING:
    import numpy as np

BYTES_MAX = 50_000_000
"""Bytes of a file, once it is unpacked."""
NODES_MAX = 100_000
"""Values in a file; what an alias stands for counts wherever the alias stands."""
LEVELS_MAX = 64
"""Levels of lists, mappings and elements inside one another."""
DIGITS_MAX = 300
"""Digits of a number, which a float can hold then."""
ARRAY_BYTES_MAX = 500_000_000
"""Bytes of all arrays of an archive together."""
DATA_SET_BYTES_MAX = 200_000_000
"""Bytes of the tables and recordings of data sets, and of the iterations of a run."""
DATA_SET_NODES_MAX = 5_000_000
"""Values in them."""
STREAM_NODES_MAX = 30_000_000
"""Values in those that are read part by part and never held."""
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
"""What a PNG file begins with."""

_QUOTED = re.compile(r'"(?:[^"\\]++|\\.)*+"?+', re.DOTALL)
_ANY_QUOTED = re.compile(r"\"(?:[^\"\\]++|\\.)*+\"?+|'(?:[^'\\]++|\\.)*+'?+", re.DOTALL)
_LONG_NUMBER = re.compile(rf"[0-9a-fA-F_]{{{DIGITS_MAX + 1}}}")
_HALF_CHARACTER = re.compile(
    r"(?<!\\)(?:\\\\)*+(?:\\u[dD][89abAB][0-9a-fA-F]{2}(?!\\u[dD][c-fC-F])"
    r"|(?<!\\u[dD][89abAB][0-9a-fA-F]{2})\\u[dD][c-fC-F][0-9a-fA-F]{2})"
)
_NOT_BRACKETS = bytes(byte for byte in range(256) if byte not in b"[]{}()")
_LFS = b"version https://git-lfs.github.com/spec/"  # what is kept elsewhere begins so
_STREAM_BYTES_MAX, _PART_BYTES = 1_000_000_000, 1_000_000
_Take = Callable[[ElementTree.Element], None] | None
_MEMORY_BYTES_MAX = 1_500_000_000
_ARRAYS_MAX = 10_000  # a checkpoint has some for every selection of its search


def read_bytes(file: Path, kind: str, *, bytes_max: int = BYTES_MAX) -> bytes:
    """The content of a file; of one whose name ends in ``.gz`` what is packed in it."""
    return b"".join(read_parts(file, kind, bytes_max=bytes_max, part_bytes=bytes_max + 1))


def read_parts(
    file: Path, kind: str, *, bytes_max: int = _STREAM_BYTES_MAX, part_bytes: int = _PART_BYTES
) -> Iterator[bytes]:
    """The same, part by part."""
    left = bytes_max
    try:
        with gzip.open(file) if file.name.endswith(".gz") else file.open("rb") as stream:
            while left >= 0 and (part := stream.read(part_bytes)):
                if left == bytes_max and part.startswith(_LFS):
                    raise InputError(f"{file}: expected {kind}, got a pointer of Git LFS to it; run: git lfs pull")
                left -= len(part)
                if left >= 0:
                    yield part
    except InputError:
        raise
    except (OSError, EOFError, zlib.error, ValueError) as error:  # the last for a name that no file can have
        reason = (error.strerror if isinstance(error, OSError) else None) or _one_line(error)
        raise InputError(f"{file}: expected {kind}, got: {reason}") from None
    if left < 0:
        raise InputError(f"{file}: expected {kind} of at most {_size(bytes_max)}, got more; is it another file?")


def read_text(file: Path, kind: str, *, bytes_max: int = BYTES_MAX) -> str:
    """The text of a UTF-8 file, without a mark at its beginning."""
    return _text(read_bytes(file, kind, bytes_max=bytes_max), str(file), kind)


def read_json(file: Path, kind: str, *, bytes_max: int = BYTES_MAX, nodes_max: int = NODES_MAX) -> Any:  # noqa: ANN401
    return parse_json(read_bytes(file, kind, bytes_max=bytes_max), str(file), kind, nodes_max=nodes_max)


def parse_json(content: bytes | str, place: str, kind: str, *, nodes_max: int = NODES_MAX) -> Any:  # noqa: ANN401
    text = content if isinstance(content, str) else _text(content, place, kind)
    check_nesting(text, place, nodes_max=nodes_max)
    if "\\u" in text and _HALF_CHARACTER.search(text):
        raise InputError(f"{_at(place)}expected {kind}, got half of a character, such as \\ud800 alone")
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        where = f"{place}:{error.lineno}: " if place else f"line {error.lineno}: "
        raise InputError(f"{where}expected valid JSON ({kind}), got: {error.msg}") from None


def check_nesting(text: str, place: str, *, nodes_max: int = NODES_MAX, quotes: str = '"') -> None:
    """Reject a text in JSON, or in another language with brackets and commas, that a parser should not be given."""
    bare = (_QUOTED if quotes == '"' else _ANY_QUOTED).sub("", text)
    brackets = bare.encode().translate(None, _NOT_BRACKETS)
    if bare.count(",") + len(brackets) // 2 > nodes_max:
        refuse_nodes(place, nodes_max)
    if len(brackets) > LEVELS_MAX:
        import numpy as np

        steps = np.where(np.isin(np.frombuffer(brackets, np.uint8), np.frombuffer(b"[{(", np.uint8)), 1, -1)
        if steps.cumsum().max() > LEVELS_MAX:
            refuse_levels(place)
    if _LONG_NUMBER.search(bare):
        refuse_digits(place)


def parse_xml(
    content: bytes | Iterable[bytes], place: str, kind: str, *, nodes_max: int = NODES_MAX, take: _Take = None
) -> ElementTree.Element:
    """The root of an XML document, which may have no DOCTYPE: its entities may expand without end, and read files.

    ``take`` gets every child of the root once it is whole, which is emptied then: a long document is never held.
    """
    parser = ElementTree.XMLParser(target=_BoundedBuilder(place, nodes_max, take))
    try:
        for part in [content] if isinstance(content, bytes) else content:
            parser.feed(part)
        return parser.close()
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # of encodings that Python does not have, too
        if isinstance(error, InputError):
            raise
        line = getattr(error, "position", (1,))[0]
        where = f"{place}:{line}: " if place else f"line {line}: "
        raise InputError(f"{where}expected {kind}, got a syntax error: {_one_line(error)}") from None


class _BoundedBuilder(ElementTree.TreeBuilder):
    def __init__(self, place: str, nodes_max: int, take: _Take) -> None:
        super().__init__()
        self._place, self._nodes_max, self._take = place, nodes_max, take
        self._nodes = self._levels = 0

    def start(self, tag: str, attrs: dict[str, str], /) -> ElementTree.Element:
        self._nodes += 1 + len(attrs)
        self._levels += 1
        if self._nodes > self._nodes_max:
            refuse_nodes(self._place, self._nodes_max)
        if self._levels > LEVELS_MAX:
            refuse_levels(self._place)
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self._levels -= 1
        element = super().end(tag)
        if self._take is not None and self._levels == 1:
            self._take(element)
            element.clear()
        return element

    def doctype(self, *_: object) -> None:
        raise InputError(f"{_at(self._place)}expected XML without a DOCTYPE, whose entities may expand without end")


def read_arrays(
    file: Path, kind: str, *, bytes_max: int = ARRAY_BYTES_MAX, names: tuple[str, ...] | None = None
) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz`` file by name; none are objects, which would have to be unpickled."""
    import numpy as np

    content = io.BytesIO(read_bytes(file, kind, bytes_max=bytes_max))
    found: dict[str, np.ndarray] = {}
    left = bytes_max
    try:
        with zipfile.ZipFile(content) as archive:
            members = archive.infolist()
            if len(members) > _ARRAYS_MAX:
                raise InputError(f"{file}: expected {kind} of at most {_ARRAYS_MAX} arrays, got {len(members)}")
            for member in members:
                name = member.filename.removesuffix(".npy")
                if names is not None and name not in names:
                    continue
                with archive.open(member) as stream:
                    shape, is_fortran, dtype = _header(stream)
                    size = math.prod(shape) * dtype.itemsize
                    if dtype.hasobject:
                        raise ValueError(f"{name}: Python objects, which are not read")
                    if size > left:
                        raise InputError(
                            f"{file}: {name}: expected arrays of at most {_size(bytes_max)} together, got the shape "
                            f"{list(shape)} of {dtype}"
                        )
                    left -= size
                    data = stream.read(size + 1)
                if len(data) != size:
                    raise ValueError(f"{name}: {'more' if len(data) > size else 'fewer'} bytes than its shape needs")
                array = np.frombuffer(bytearray(data), dtype)
                found[name] = array.reshape(shape[::-1]).T if is_fortran else array.reshape(shape)
    except InputError:
        raise
    except Exception as error:  # of archive, compression and header, which share no parent
        raise InputError(f"{file}: expected {kind}, got one that is unreadable: {_one_line(error)}") from None
    return found


def _header(stream: Any) -> tuple[tuple[int, ...], bool, np.dtype]:  # noqa: ANN401 (a member of an archive)
    from numpy.lib import format as npy

    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    version = npy.read_magic(stream)
    if version not in readers:
        raise ValueError(f"version {version} of NumPy's format")
    shape, is_fortran, dtype = readers[version](stream)
    if any(side < 0 for side in shape):
        raise ValueError(f"the shape {list(shape)}")
    return shape, is_fortran, dtype


def usd_library(place: str = "USD") -> Any:  # noqa: ANN401
    """The package pxr of the extra ``usd``, with its modules."""
    try:
        for name in ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdShade", "UsdSkel", "UsdUtils", "Vt", "Work"):
            importlib.import_module(f"pxr.{name}")
        return importlib.import_module("pxr")
    except ImportError as error:
        raise InputError(f"{place}: expected the package usd-core, got: {error}; {install_text('usd')}") from None


@contextlib.contextmanager
def bounded_memory() -> Iterator[None]:
    """Let this process take `_MEMORY_BYTES_MAX` more while the block runs, where the system can tell (on Linux).

    For libraries that believe the sizes that a file states, and say in words of their own that memory is short.
    """
    try:
        import resource

        held = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    except (ImportError, OSError):
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    least = min(each for each in (held + _MEMORY_BYTES_MAX, soft, hard) if each != resource.RLIM_INFINITY)
    resource.setrlimit(resource.RLIMIT_DATA, (least, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def feather_library() -> tuple[Any, Any]:
    """The modules pyarrow and pyarrow.feather of the extra ``av2``."""
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.feather")
    except ImportError as error:
        raise InputError(f"expected the package pyarrow, got: {error}; {install_text('av2')}") from None


def read_arrow(file: Path, kind: str) -> Any:  # noqa: ANN401
    """The table of a feather or Parquet file, a ``pyarrow.Table`` whose texts and offsets are checked."""
    arrow, reader = feather_library()
    if file.suffix == ".parquet":
        reader = importlib.import_module("pyarrow.parquet")
    content = read_bytes(file, kind, bytes_max=DATA_SET_BYTES_MAX)
    try:
        table = reader.read_table(arrow.BufferReader(content))
        table.validate(full=True)
    except (OSError, arrow.ArrowException, MemoryError, ValueError) as error:
        raise InputError(f"{file}: expected {kind}, got: {_one_line(error)[:120]}") from None
    if table.num_rows * table.num_columns > DATA_SET_NODES_MAX:
        refuse_nodes(str(file), DATA_SET_NODES_MAX)
    return table


def is_whole_png(data: bytes) -> bool:
    """Whether all parts of a PNG file lie within it; decoders may take memory for as long a part as it claims."""
    begin = len(PNG_SIGNATURE)
    while data.startswith(PNG_SIGNATURE) and begin + 12 <= len(data):
        if data[begin + 4 : begin + 8] == b"IEND":
            return True
        begin += 12 + int.from_bytes(data[begin : begin + 4], "big")
    return False


def is_inner_path(name: str) -> bool:
    """Whether a name in a file stays in the file's folder: relative, and without a way out, on any system."""
    posix, windows = PurePosixPath(name), PureWindowsPath(name)
    is_rooted = posix.is_absolute() or bool(windows.drive or windows.root)
    return bool(name) and "\0" not in name and not is_rooted and ".." not in windows.parts


def refuse_nodes(place: str, nodes_max: int = NODES_MAX) -> NoReturn:
    """Raise the error of a file with too many values."""
    raise InputError(f"{_at(place)}expected at most {nodes_max:,} values (aliases count as they expand), got more")


def refuse_levels(place: str) -> NoReturn:
    """Raise the error of a file that is nested too deeply."""
    raise InputError(f"{_at(place)}expected at most {LEVELS_MAX} levels inside one another, got more")


def refuse_digits(place: str) -> NoReturn:
    """Raise the error of a number that is too long."""
    raise InputError(f"{_at(place)}expected numbers of at most {DIGITS_MAX} digits, got a longer one")


def _text(content: bytes, place: str, kind: str) -> str:
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{_at(place)}expected {kind}, got: not UTF-8 text") from None


def _at(place: str) -> str:
    return f"{place}: " if place else ""


def _size(count: int) -> str:
    return f"{count // 1_000_000} MB"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
