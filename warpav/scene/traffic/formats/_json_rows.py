"""Long tables as JSON lists of objects, of which a block stands in memory at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from warpav.core.bounded_files import DATA_SET_NODES_MAX, parse_json, refuse_nodes
from warpav.core.errors import InputError

TABLE_BYTES_MAX = 2_000_000_000  # bytes of a table; there may be `DATA_SET_NODES_MAX` rows
_BLOCK_BYTES = 4_000_000
_T = TypeVar("_T")


def json_rows(file: Path, pick: Callable[[dict[str, Any]], _T]) -> Iterator[list[_T]]:
    """What ``pick`` takes of the rows of a table, some thousand at a time; rows hold no objects.

    In a table longer than a block no text may hold a closing brace. Raises `InputError` where the table is cut off, or
    ``pick`` finds a row without what it takes.
    """
    rest, size, count = b"", 0, 0
    try:
        with file.open("rb") as stream:
            while block := stream.read(_BLOCK_BYTES):
                rows, brace, rest = (rest + block).rpartition(b"}")
                text = b"[" + rows.lstrip(b"[, \r\n\t") + brace + b"]"
                found = parse_json(text, f"{file} (after row {count})", "a table", nodes_max=DATA_SET_NODES_MAX)
                size, count = size + len(block), count + len(found)
                if count > DATA_SET_NODES_MAX:
                    refuse_nodes(str(file), DATA_SET_NODES_MAX)
                if size > TABLE_BYTES_MAX or len(rest) > _BLOCK_BYTES:
                    raise InputError(f"{file}: expected a table of at most {TABLE_BYTES_MAX // 10**6} MB, got more")
                yield [pick(row) for row in found]
    except InputError:
        raise
    except (OSError, KeyError, TypeError, ValueError, OverflowError) as error:
        reason = f"a column {error}, got none" if isinstance(error, KeyError) else f"a table, got: {error}"
        raise InputError(f"{file}: expected {reason}") from None
    if b"".join(rest.split()) not in (b"]", b"[]"):
        raise InputError(f"{file}: expected a whole table, got one that is cut off")
