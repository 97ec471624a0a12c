"""The doctor finds what is there and says what is not."""

import json

import pytest

from warpav.core.errors import InputError
from warpav.runs import _doctor as doctor


def test_a_healthy_machine_passes_every_check(tmp_path, capsys):
    file = tmp_path / "doctor.json"
    assert doctor.examine(file) == 0
    found = json.loads(file.read_text())
    assert found["healthy"] is True
    assert set(found["checks"]) == set(doctor.CHECKS)
    assert found["checks"]["versions"]["details"]["packages"]["numpy"]
    assert "cpu" in found["checks"]["devices"]["details"]["devices"]
    assert "CPUExecutionProvider" in found["checks"]["providers"]["details"]["providers"]
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines] == list(doctor.CHECKS)


def test_the_gradient_of_the_self_test_is_right(device):
    cosine, relative_error = doctor.gradient_error(device)
    assert cosine > 0.998  # worst seen 0.9990 on the CPU
    assert relative_error < 0.1


def test_a_failing_check_is_a_finding_and_the_exit_status(monkeypatch, capsys):
    def broken():
        raise OSError("the disk is full")

    good = doctor.Finding("good", "ok", "fine")
    monkeypatch.setattr(doctor, "CHECKS", {"bad": broken, "good": lambda: good})
    assert doctor.examine() == 1
    assert capsys.readouterr().out.splitlines()[0].split() == ["failed", "bad", "OSError:", "the", "disk", "is", "full"]


def test_a_warning_does_not_fail(monkeypatch):
    monkeypatch.setattr(doctor, "CHECKS", {"opengl": lambda: doctor.Finding("opengl", "warning", "no image")})
    assert doctor.examine() == 0


def test_two_builds_of_onnxruntime_are_reported(monkeypatch):
    monkeypatch.setattr(doctor, "package_versions", lambda: {"onnxruntime": "1", "onnxruntime-gpu": "1"})
    found = doctor.check_providers()
    assert found.status == "warning"
    assert "uninstall both" in found.text


def test_a_missing_package_is_reported(monkeypatch):
    monkeypatch.setattr(doctor, "package_versions", lambda: {"numpy": "2"})
    found = doctor.check_versions()
    assert found.status == "failed"
    assert "warp-lang" in found.text


def test_a_broken_opengl_is_a_warning(monkeypatch):
    monkeypatch.setattr(doctor, "_DRAW", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    found = doctor.check_opengl()
    assert found.status == "warning"
    assert "OpenGL ended with -11" in found.text


def test_the_findings_need_a_folder(tmp_path):
    with pytest.raises(InputError, match="json: expected an existing folder"):
        doctor.examine(tmp_path / "none" / "doctor.json")
