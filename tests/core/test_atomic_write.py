"""Files that appear whole or not at all."""

import os
import threading

import pytest

from warpav.core.files import atomic_write


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
