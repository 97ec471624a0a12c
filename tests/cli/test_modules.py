"""``warpav modules``: the table, and one line for every problem with status 2."""

import pytest

from tests.rig.test_catalogue import ONE
from warpav.cli.app import main
from warpav.rig import builtin_modules

pytestmark = pytest.mark.usefixtures("working_directory")


def test_the_shipped_modules_are_listed_with_their_columns(capsys):
    assert main(["modules", "list"]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    for word in ("sensor", "network", "lens", "field of view", "px/°", "price", "power", "zones", "source"):
        assert word in head
    assert [row.split()[0] for row in rows] == list(builtin_modules())
    tele = next(row for row in rows if row.startswith("tele_8mp_28"))
    for text in (
        "3840 x 2160",
        "1920 x 1080",
        "pinhole",
        "28.0",
        "67.2",
        "2.6 relative",
        " -  front     windscreen, roof ",
    ):
        assert text in tele


def test_a_catalogue_is_listed_and_checked(working_directory, capsys):
    (working_directory / "mine.yaml").write_text("extends: builtin\n" + ONE)
    assert main(["modules", "list", "mine.yaml"]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("mine ")
    assert main(["modules", "check", "mine.yaml"]) == 0
    assert capsys.readouterr().out == f"mine.yaml: {len(builtin_modules()) + 1} modules, no problems\n"


@pytest.mark.parametrize("command", ["list", "check"])
def test_every_problem_is_a_line_and_the_status_2(working_directory, capsys, command):
    text = ONE.replace("fov_deg: 100", "fov_deg: 500").replace("power_w: 0.8", "power_w: -1")
    (working_directory / "mine.yaml").write_text(text)
    assert main(["modules", command, "mine.yaml"]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err == (
        "mine.yaml:7: modules[0].fov_deg: expected more than 0 and below 360 degrees (fisheye), got 500 degrees; write "
        "that of the whole sensor\n"
        "mine.yaml:12: modules[0].power_w: expected watts from 0 on, got -1; write null where it is unknown\n"
    )
