"""The command that checks a rig against requirements."""

import json

from PIL import Image

from warpav.cli.app import main


def test_a_preset_is_checked_and_drawn(working_directory, capsys):
    arguments = ["rig", "requirements", "edgar", "--json", "out.json", "--image", "out.png"]
    assert main([*arguments, "--requirements", "r158_like"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:2] == ["requirement", "needs"]
    assert lines[1].startswith("rear_view ")
    assert lines[3] == "not met: rear_view (largest gap: 1.44 m², rear), rear_detection (largest gap: 0.96 m², rear)"
    assert lines[4:] == ["wrote out.json", "wrote out.png"]
    data = json.loads((working_directory / "out.json").read_text())
    assert not data["met"]
    assert [each["name"] for each in data["requirements"]] == ["rear_view", "rear_detection"]
    with Image.open("out.png") as image:
        assert image.width == 1350


def test_what_is_met_is_said(working_directory, capsys):
    (working_directory / "mine.yaml").write_text(
        "requirements:\n  ahead: {area: {box_m: [[20, -2], [30, 2]]}, grid_m: 2, object: adult}\n", encoding="utf-8"
    )
    assert main(["rig", "requirements", "edgar", "--requirements", "mine.yaml"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "100.0 %" in lines[1]
    assert lines[2] == "all requirements are met"


def test_a_picture_that_is_none_is_status_2(working_directory, capsys):
    assert main(["rig", "requirements", "edgar", "--image", "out.jpg"]) == 2
    assert "expected a name that ends in .png" in capsys.readouterr().err


def test_what_is_checked_besides_has_limits(working_directory, capsys):
    (working_directory / "mine.yaml").write_text(
        "requirements:\n  ahead: {area: {box_m: [[20, -2], [30, 2]]}, grid_m: 2, object: adult}\n"
        "checks: {redundancy: 1.0, camera_loss: 0.001, far_m: {vehicle: 10}, hard: [redundancy, far_m]}\n",
        encoding="utf-8",
    )
    main(["check", "edgar", "--requirements", "mine.yaml"])
    said, page = capsys.readouterr().out, (working_directory / "check.html").read_text(encoding="utf-8")
    assert "FAIL Redundancy: cars by two cameras, up to 20 m: " in said
    assert "Loss of one camera" not in said  # it fails, but is not hard
    assert "Far field" not in said
    assert "at most 0%" in page
    assert main(["check", "edgar", "--requirements", "near_field", "--out", "none/page.html"]) == 2
