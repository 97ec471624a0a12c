"""Files appear whole or not at all; what errors and the command line print obeys no terminal; names as YAML."""

import os
import pickle
import threading

import pytest

from warpav.cli._arguments import complain, say
from warpav.core.errors import ArgumentError, InputError, OptionError, one_line, printable
from warpav.core.files import atomic_write
from warpav.core.yaml_file import read_yaml, yaml_name


def test_writers_at_the_same_time_do_not_share_a_draft(tmp_path):
    file = tmp_path / "a.txt"
    with atomic_write(file) as one, atomic_write(file) as other:
        one.write_text("one")
        other.write_text("other")
        assert not file.exists()
    assert file.read_text() == "one"  # the outer block ends last
    assert list(tmp_path.iterdir()) == [file]


def test_what_was_there_stays_when_writing_fails(tmp_path):
    file = tmp_path / "a.txt"
    file.write_text("before")

    def cut_off():
        with atomic_write(file) as draft:
            draft.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cut_off()
    assert file.read_text() == "before"
    assert list(tmp_path.iterdir()) == [file]


def test_a_pipe_stays_one_and_gets_the_content(tmp_path):
    pipe, got = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: got.append(pipe.read_text()))
    reader.start()
    with atomic_write(pipe) as draft:
        draft.write_text("content")
    reader.join(timeout=10)
    assert got == ["content"]
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


def test_what_a_terminal_would_obey_is_written_out():
    assert printable("fr\x1b[31mont\x07\x9b \u202e\u2028\ud800") == "fr\\x1b[31mont\\x07\\x9b \\u202e\\u2028\\ud800"
    assert printable("Straße\n\tfront\r") == "Straße\n\tfront\\r"
    assert one_line("Straße\n\tfront\r") == "Straße\\n\tfront\\r"


def test_the_command_line_prints_what_is_printable(capsys):
    say("a\x1b]0;title\x07\nb", "c")
    complain("b\x1b[2J\n" + "c" * 3000 + "\n" + "d\n" * 100)
    captured = capsys.readouterr()
    assert captured.out == "a\\x1b]0;title\\x07\\nb\nc\n"
    lines = captured.err.splitlines()
    assert lines[0] == "b\\x1b[2J"
    assert lines[1] == "c" * 2000 + "..."
    assert lines[-1] == "and more of these"
    assert len(lines) == 61


def test_a_name_cannot_begin_a_line_of_its_own():
    error = InputError("a\nb.yaml: one\x1b[31m", "two")
    assert str(error) == "a\\nb.yaml: one\\x1b[31m\ntwo"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    assert str(OptionError("rig.start", "got a\nb")) == "rig.start: got a\\nb"
    assert vars(ArgumentError("out", "got\nb", place="c\nd")) == {"option": "out", "text": "got\\nb", "place": "c\\nd"}


PLAIN = ["front", "front_left.2-b", "left pillar", "Haube ä"]
QUOTED = ["no", "1e3", "2026-01-01", "", " a"]
QUOTED += ["a: b", "a #b", "- a", "é\x1b[31m\n[/]\"'\\", "\x7f\x85\u2028\ufeff", "😀"]


@pytest.mark.parametrize("name", PLAIN + QUOTED)
def test_a_name_comes_back(name):
    text = yaml_name(name)
    assert (text == name) is (name in PLAIN)
    assert read_yaml(f"zones:\n  {text}:\n    name: {text}\n")[0] == {"zones": {name: {"name": name}}}
