"""Files from elsewhere: bounds hold before a parser or an array takes time or memory, and messages name them."""

import gzip
import io
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from warpav.core import bounded_files
from warpav.core.bounded_files import (
    DIGITS_MAX,
    LEVELS_MAX,
    NODES_MAX,
    is_inner_path,
    is_whole_png,
    parse_json,
    parse_xml,
    read_arrays,
    read_bytes,
    read_json,
    read_text,
)
from warpav.core.errors import InputError
from warpav.core.yaml_file import read_yaml

SECONDS_MAX = 5.0  # of processor time
MANY = "expected at most 100,000 values (aliases count as they expand), got more"
DEEP = "expected at most 64 levels inside one another, got more"
LONG = "expected numbers of at most 300 digits, got a longer one"
BOMB = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 10)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


def refusal(read, *arguments, **options):
    began = time.process_time()
    with pytest.raises(InputError) as caught:
        read(*arguments, **options)
    assert time.process_time() - began < SECONDS_MAX
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (BOMB, MANY),
        (f"a: [{'1, ' * NODES_MAX}]", MANY),
        ("a:\n" + "- {x: 1, y: [1, 2, 3]}\n" * 400_000, MANY),
        ("[" * 2000, DEEP),
        ("[" * 40_000, DEEP),
        ("{a: " * 3000, DEEP),
        ("a: &a [*a]", DEEP),
        ("- " * 200 + "1", DEEP),
        ("[" * (LEVELS_MAX + 1) + "]" * (LEVELS_MAX + 1), DEEP),
        (f"a: {{b: {'9' * (DIGITS_MAX + 1)}}}", f"a.b: {LONG}"),
        ("? [1, 1]\n: 1", "expected texts as keys, got a list or a mapping"),
        (f"{BOMB}? *i\n: 1", MANY),
        ("a: &a [1]\n? *a\n: 1", "expected texts as keys"),
        ("!!python/object/apply:os.system [id]", "expected plain YAML, got the tag"),
    ],
    ids=[
        *(
            "aliases",
            "values",
            "rows",
            "brackets",
            "more brackets",
            "mappings",
            "itself",
            "dashes",
            "one level",
            "digits",
        ),
        *("key", "key of aliases", "alias as key", "tag"),
    ],
)
def test_yaml_keeps_the_bounds(text, told):
    assert told in refusal(read_yaml, text, "here")


def test_yaml_at_the_bounds_is_read(monkeypatch):
    most = 1000  # another maximum, as reading 100,000 values takes a second; so many and more are refused above
    monkeypatch.setattr("warpav.core.yaml_file.NODES_MAX", most)
    assert read_yaml("[" * LEVELS_MAX + "]" * LEVELS_MAX)[0]
    assert read_yaml("9" * DIGITS_MAX)[0] == int("9" * DIGITS_MAX)
    assert len(read_yaml(f"a: [{'1, ' * (most - 2)}]")[0]["a"]) == most - 2
    assert MANY in refusal(read_yaml, f"a: [{'1, ' * most}]", "here")
    assert read_yaml("a: &a [1, 2]\nb: *a")[0] == {"a": [1, 2], "b": [1, 2]}


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (f"[{'1,' * NODES_MAX}1]", MANY),
        ("[" * 200_000, DEEP),
        ('{"a":' * 200_000, DEEP),
        (f'{{"a": {"9" * 5000}}}', LONG),
        ('"\\ud800"', "got half of a character"),
        ('"\\udc00\\ud800"', "got half of a character"),
        ('{"a": 1', "here:1: expected valid JSON (a list), got: Expecting"),
        (b"\xff\xfe[]", "here: expected a list, got: not UTF-8 text"),
    ],
)
def test_json_keeps_the_bounds(text, told):
    assert told in refusal(parse_json, text, "here", "a list")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("<a>" * 40_000, DEEP),
        (f"<a>{'<b/>' * NODES_MAX}</a>", MANY),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", "expected XML without a DOCTYPE"),
        ("<!DOCTYPE r [<!ENTITY x SYSTEM 'file:///etc/hostname'>]><r>&x;</r>", "expected XML without a DOCTYPE"),
        ("<a>", "here:1: expected a URDF file, got a syntax error: no element found"),
        ('<?xml version="1.0" encoding="klingon"?><a/>', "got a syntax error: unknown encoding"),
    ],
)
def test_xml_keeps_the_bounds(text, told):
    assert told in refusal(parse_xml, text.encode(), "here", "a URDF file")


def test_a_file_is_read_up_to_its_size(tmp_path, monkeypatch):
    file, packed = tmp_path / "a.json", tmp_path / "b.json.gz"
    file.write_bytes(b" " * 2_000_001)
    packed.write_bytes(gzip.compress(b" " * 30_000_000))
    for each in (file, packed, Path("/dev/zero")):
        assert "expected a list of at most 2 MB, got more" in refusal(read_bytes, each, "a list", bytes_max=2_000_000)
    assert "No such file" in refusal(read_text, tmp_path / "none", "a list")
    assert "Is a directory" in refusal(read_json, tmp_path, "a list")
    assert "null byte" in refusal(read_bytes, tmp_path / "a\0b", "a list")
    packed.write_bytes(packed.read_bytes()[:-9])
    assert "ended before" in refusal(read_bytes, packed, "a list")


def archive(**members):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, content in members.items():
            opened.writestr(f"{name}.npy", content)
    return packed.getvalue()


def npy(header):
    text = f"{header}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


HUGE = npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000)}")
WORSE = {
    "huge": (archive(a=HUGE), "a: expected arrays of at most 500 MB together, got the shape [1000000, 1000000]"),
    "many": (archive(**{f"a{i}": b"" for i in range(10_001)}), "of at most 10000 arrays, got 10001"),
    "objects": (archive(a=npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}")), "Python objects"),
    "tokens": (archive(a=npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1,")), "unreadable"),
    "negative": (archive(a=npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 8)}")), "unreadable"),
    "short": (archive(a=npy("{'descr': '<f8', 'fortran_order': False, 'shape': (9,)}") + b"1"), "fewer bytes"),
    "long": (archive(a=npy("{'descr': '|u1', 'fortran_order': False, 'shape': (1,)}") + b"12"), "more bytes"),
    "no array": (archive(a=b"text"), "unreadable"),
    "no archive": (b"text", "unreadable"),
    "broken": (archive(a=HUGE)[:60] + b"\xff" * 40 + archive(a=HUGE)[100:], "unreadable"),
}


@pytest.mark.parametrize(("content", "told"), WORSE.values(), ids=WORSE)
def test_arrays_keep_the_bounds(tmp_path, content, told):
    (tmp_path / "a.npz").write_bytes(content)
    assert told in refusal(read_arrays, tmp_path / "a.npz", "arrays")


def test_arrays_are_those_that_were_written(tmp_path, rng):
    arrays = {
        "plain": rng.random((3, 4)),
        "columns": np.asfortranarray(rng.random((3, 4)).astype(np.float32)),
        "scalar": np.int64(3),
        "words": np.array(["white", "ones"]),
        "none": np.zeros((0, 3)),
    }
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    found = read_arrays(tmp_path / "a.npz", "arrays")
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)
    found["plain"][0, 0] = 2.0  # may be changed
    assert read_arrays(tmp_path / "a.npz", "arrays", names=("words",)).keys() == {"words"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bounded_files, "_ARRAYS_MAX", 4)
        assert "of at most 4 arrays, got 5" in refusal(read_arrays, tmp_path / "a.npz", "arrays")


@pytest.mark.parametrize(
    ("name", "is_inside"),
    [
        *((name, True) for name in ("a.png", "images/a.png", "./a.png", "a..b/..c.png")),
        *(
            (name, False)
            for name in ("", "/etc/passwd", "..", "../a", "a/../../b", "a\\..\\b", "C:\\a", "C:a", "\\a", "a\0b")
        ),
    ],
)
def test_paths_that_stay_in_their_folder(name, is_inside):
    assert is_inner_path(name) is is_inside


def test_parts_of_a_png_lie_within_it():
    import cv2

    whole = cv2.imencode(".png", np.arange(60, dtype=np.uint8).reshape(6, 10))[1].tobytes()
    assert is_whole_png(whole)
    assert is_whole_png(whole + b"behind it")
    assert not any(is_whole_png(whole[:size]) for size in range(len(whole) - 11))
    claims_4_gb = whole[:33] + b"\xed\x9f\x00\x24" + whole[37:]
    assert not is_whole_png(claims_4_gb)
    assert not is_whole_png(b"\xff\xd8" + whole)
