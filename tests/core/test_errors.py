"""Errors are one line a mistake, whatever the names in them hold."""

import pickle

from warpav.core.errors import ArgumentError, InputError, OptionError


def test_a_name_cannot_begin_a_line_of_its_own():
    error = InputError("a\nb.yaml: one\x1b[31m", "two")
    assert str(error) == "a\\nb.yaml: one\\x1b[31m\ntwo"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    assert str(OptionError("rig.start", "got a\nb")) == "rig.start: got a\\nb"
    assert vars(ArgumentError("out", "got\nb", place="c\nd")) == {"option": "out", "text": "got\\nb", "place": "c\\nd"}
