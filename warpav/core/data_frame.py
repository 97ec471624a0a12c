"""Tables of pandas, where it is installed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas  # pyright: ignore[reportMissingImports]


def data_frame(rows: Mapping[Any, Mapping[str, Any]]) -> pandas.DataFrame:
    """A table of pandas: a row for each key, which is its index, with columns by name."""
    try:
        import pandas  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ImportError("to_pandas needs pandas; run: pip install pandas") from None
    return pandas.DataFrame.from_dict(dict(rows), orient="index")
