"""Parts of JSON Schemas (draft 2020-12) of the files that people write, and the whole of one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

_DIALECT = "https://json-schema.org/draft/2020-12/schema"

Schema = dict[str, Any]

NUMBER: Schema = {"type": "number", "exclusiveMinimum": -1e9, "exclusiveMaximum": 1e9}
"""Finite, and of a size that can mean something."""

TEXT: Schema = {"type": "string"}
FLAG: Schema = {"type": ["boolean", "null"]}
NAME: Schema = {"type": "string", "pattern": "^[A-Za-z0-9_][A-Za-z0-9_.-]*$"}


def document(name: str, title: str, body: Mapping[str, Any]) -> Schema:
    """A whole schema: what a file of this name has to be."""
    return {"$schema": _DIALECT, "$id": f"urn:warpav:schema:{name}", "title": title, **body}


def mapping(
    properties: Mapping[str, Schema],
    required: Iterable[str] = (),
    *,
    about: str | None = None,
    **more: Any,  # noqa: ANN401
) -> Schema:
    """A mapping with these keys and no others."""
    said = {} if about is None else {"description": about}
    listed = {"required": list(required)} if list(required) else {}
    return {"type": "object", **said, "properties": dict(properties), **listed, "additionalProperties": False, **more}


def named(value: Schema, *, about: str) -> Schema:
    """A mapping from names to values of one kind, at least one."""
    return {"type": "object", "description": about, "additionalProperties": value, "minProperties": 1}


def items(value: Schema, count: int | None = None, *, least: int = 0) -> Schema:
    """A list of values of one kind, of so many or of at least so many."""
    bounds = {"minItems": least} if count is None else {"minItems": count, "maxItems": count}
    return {"type": "array", "items": value, **bounds}


def described(value: Schema, text: str) -> Schema:
    """The value with a description, which editors show."""
    return {**value, "description": text}


def either(*values: Schema) -> Schema:
    """One of several."""
    return {"anyOf": list(values)}
