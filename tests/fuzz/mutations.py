"""Edits of valid files: bytes that are changed, lost, repeated, and values where none of the kind belongs."""

import re

from hypothesis import strategies as st

TOKENS = [
    b"",
    b"0",
    b"-1",
    b"1e308",
    b"-1e-320",
    b"1e999",
    b"nan",
    b".nan",
    b"NaN",
    b"-.inf",
    b"Infinity",
    b"9" * 400,
    b"4294967296",
    b"18446744073709551615",
    b"true",
    b"null",
    b"[]",
    b"{}",
    b"[[[[[[]]]]]]",
    b'{"a": {"b": [{}]}}',
    b"[1, 2]",
    b'"a"',
    b"''",
    b"&x [*x, *x]",
    b"*x",
    b"<<: *x",
    b"!!python/object/apply:os.system [id]",
    b"? [a]\n: b\n",
    b"<!DOCTYPE a [<!ENTITY b 'c'>]>",
    b"&b;",
    b"<a>" * 80,
    b"[" * 80,
    b"../../../etc/passwd",
    b"/etc/passwd",
    b"\\u0000",
    b"\\ud800",
    b"\x00",
    b"\x1b[31m",
    b"\xff\xfe",
    b"\xed\xa0\x80",
    "\u202e\u00fc".encode(),
    b"\n",
    b"\t",
    b": ",
    b"- ",
    b"#",
    b"0x7fffffff",
    b"\xff\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\x00\x00\x00\x00",
    b"\x00\x00\xc0\x7f",
]
VALUES = [
    b"[]",
    b"{}",
    b"[1, 2]",
    b'{"a": [0]}',
    b"null",
    b"true",
    b'"a"',
    b"0",
    b"-1",
    b"0.5",
    b"1e308",
    b"1e999",
    b"nan",
    b"9" * 400,
    b"4294967296",
    b"../../../etc/passwd",
]
"""What a value is replaced by."""
EDITS = (
    "number",
    "number",
    "word",
    "word",
    "quoted",
    "quoted",
    "insert",
    "overwrite",
    "flip",
    "cut",
    "end",
    "repeat",
    "move",
    "line",
)
_NUMBER = re.compile(rb"-?\d+\.?\d*(?:e[-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9]*")
_QUOTED = re.compile(rb"\"[^\"\n]*\"|'[^'\n]*'")
_LINE = re.compile(rb"[^\n]*\n")
_SPANS = {"number": _NUMBER, "word": _WORD, "quoted": _QUOTED, "line": _LINE}

edits = st.lists(
    st.tuples(
        st.sampled_from(EDITS),
        st.integers(0, (1 << 20) - 1),  # where, as a share of the file
        st.integers(0, (1 << 20) - 1),  # where else, or how long
        st.integers(0, len(TOKENS) - 1),
    ),
    min_size=1,
    max_size=4,
)
"""What is done to a file."""


def edited(content, done):
    """The content after these edits."""
    for kind, where, other, token in done:
        content = _edited(content, kind, where, other, TOKENS[token])
    return content


def _edited(content, kind, where, other, token):
    at = len(content) * where >> 20
    length = min(len(content) - at, 1 + other % 64)
    if kind in _SPANS:
        found = list(_SPANS[kind].finditer(content))
        if not found:
            return content + token
        start, end = found[len(found) * where >> 20].span()
        value = content[start:end] * (other % 4) if kind == "line" else VALUES[other % len(VALUES)]
        return content[:start] + value + content[end:]
    if kind == "insert":
        return content[:at] + token + content[at:]
    if kind == "overwrite":
        return content[:at] + token + content[at + len(token) :]
    if kind == "flip":
        return content[:at] + bytes([content[at] ^ (1 + other % 255)]) + content[at + 1 :] if content else token
    if kind == "cut":
        return content[:at] + content[at + length :]
    if kind == "end":
        return content[:at]
    if kind == "repeat":
        return content[: at + length] + content[at : at + length] * (other % 30) + content[at + length :]
    part = content[at : at + length]  # moved
    rest = content[:at] + content[at + length :]
    to = len(rest) * other >> 20
    return rest[:to] + part + rest[to:]
