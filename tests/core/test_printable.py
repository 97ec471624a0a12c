"""What a terminal would obey is shown."""

from warpav.cli.arguments import complain, say
from warpav.core.errors import one_line, printable


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
