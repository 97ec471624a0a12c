"""The viewer in a browser: who is answered, and that controls and the mouse do what they do in the window."""

import contextlib
import io
import os
import re
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.runs.report.chromium import Chromium, find_chromium
from tests.view.stand_ins import needs_opengl, rig, scene, vehicle
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.rig import Rig, read_rig, write_rig
from warpav.scene import DeviceScene, town_scene, write_scene
from warpav.sight import HEIGHTS_M, Ground
from warpav.view import _browser as module
from warpav.view._palette import camera_rgb

pytest.importorskip("trame.app")
CHROMIUM = find_chromium()
pytestmark = [needs_opengl, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")]
PANEL_PX = 345
SMALL = ["camera.width_px=64", "camera.height_px=64", "detector.input_px=64"]


@contextlib.contextmanager
def served(folder, *words):
    """The address of a viewer that runs in a process of its own."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-m", "warpav.cli.app", "view", *words]
    with subprocess.Popen(
        command,
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # the background of a shell ignores it
    ) as process:
        try:
            for line in process.stdout:
                if found := re.search(r"open (http\S+)", line):
                    yield found[1]
                    break
            else:
                raise AssertionError(f"no address, status {process.wait()}")
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(timeout=30)
    assert process.returncode == 128 + signal.SIGINT


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("viewer")
    write_scene(scene(vehicle(1, 9.0, 0.5), vehicle(2, -8.0, -2.0)), made / "street.glb")
    write_rig(rig(4), made / "four.yaml")
    write_rig(
        Rig(replace(each, pitch_rad=-0.1, yaw_rad=each.yaw_rad + 0.2) for each in rig(4).cameras), made / "up.yaml"
    )
    return made


@pytest.fixture(scope="module")
def address(folder):
    with served(folder, "street.glb", "--rig", "four.yaml", "--port", "0", *SMALL) as found:
        yield found


@contextlib.contextmanager
def shown(address):
    """A browser that shows the page of a rig of four cameras."""
    with Chromium(CHROMIUM) as browser:
        browser.open(address, width_px=1280, height_px=720)
        browser.wait_for("document.querySelectorAll('.camera').length === 4")
        browser.wait_for("[...document.images].some(each => each.naturalWidth > 300)")
        settle(browser)
        yield browser


@pytest.fixture(scope="module")
def browser(address):
    with shown(address) as browser:
        yield browser


def wait_until(condition):
    deadline = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def settle(browser):
    """Until the image has stayed the same for a while."""
    before = [None]

    def is_still():
        last, before[0] = before[0], pixels(browser)
        time.sleep(0.4)
        return last is not None and np.abs(before[0] - last).max() == 0

    wait_until(is_still)


def is_as(browser, image):
    """Whether the image is that one again, but for what JPEG loses."""
    return np.abs(pixels(browser) - image).max() < 50


def pixels(browser):
    """What is right of the panel."""
    shown = io.BytesIO(browser.screenshot(whole=False))
    return np.asarray(Image.open(shown).convert("RGB"))[:, PANEL_PX:].astype(int)


def click(browser, text):
    browser.evaluate(
        "[...document.querySelectorAll('label, button, .camera .name')].find(each => "
        f"[each.textContent.trim().toLowerCase(), each.title].includes({text!r})).click()"
    )


def lines(browser):
    return browser.evaluate("document.querySelector('.v-navigation-drawer').textContent")


def test_the_rig_is_shown_with_its_numbers(browser):
    assert "scene test, 2 vehicles" in lines(browser)
    assert browser.evaluate("document.title") == "four - warpav"
    assert len(np.unique(pixels(browser)[::8, ::8].reshape(-1, 3), axis=0)) > 50


def test_switches_change_the_image_and_back(browser):
    before = pixels(browser)
    click(browser, "range rings")
    wait_until(lambda: np.abs(pixels(browser) - before).max() > 60)
    click(browser, "range rings")
    wait_until(lambda: is_as(browser, before))


def test_a_camera_is_looked_through(browser):
    before = pixels(browser)
    click(browser, "cam_1")
    corner = np.s_[-350:-44, -320:]
    wait_until(lambda: np.abs(pixels(browser) - before)[corner].mean() > 10.0)
    wait_until(lambda: "vehicles detected" in lines(browser))
    click(browser, "cam_1")
    wait_until(lambda: is_as(browser, before))


def test_the_mouse_turns_the_view(browser):
    before = pixels(browser)
    drag(browser, (500, 600), (620, 600))
    wait_until(lambda: np.abs(pixels(browser) - before).mean() > 3.0)


@pytest.mark.slow
def test_a_rig_is_edited(folder):
    """Put, dragged, typed, mirrored, undone, polished, given one more camera, saved; each step is the file's."""
    with served(folder, "street.glb", "--rig", "four.yaml", "--port", "0", *SMALL) as found, shown(found) as browser:
        edit(browser, folder)


def edit(browser, folder):
    first = rig(4).cameras
    front, left, rear, right = polished(browser, folder)
    np.testing.assert_allclose(right.position_m, left.position_m * [1, -1, 1], atol=1e-5)
    assert [left.yaw_rad + right.yaw_rad, front.position_m[1], rear.position_m[1]] == pytest.approx([0.0] * 3, abs=1e-5)
    assert (left.position_m != first[1].position_m).any()
    click(browser, "undo")
    click(browser, "put a camera")
    browser.wait_for("[...document.querySelectorAll('button')].some(each => /click the body/.test(each.textContent))")
    middle_px = np.mean([ball(browser, 0), ball(browser, 2)], axis=0)  # of the roof
    browser.mouse("move", *middle_px, held=False)
    for kind in ("press", "release"):
        browser.mouse(kind, *middle_px)
    browser.wait_for("document.querySelectorAll('.camera').length === 5")
    put = saved(browser, folder)
    assert [each.name for each in put[:4]] == [each.name for each in first]
    assert 0.5 < put[4].position_m[0] < 2.1
    settle(browser)
    at_px = ball(browser, 3)
    drag(browser, at_px, (at_px[0] + 25, at_px[1] + 10))
    wait_until(lambda: number(browser, "x_m") != f"{first[3].position_m[0]:g}")
    settle(browser)
    dragged = saved(browser, folder)
    far_m = [np.linalg.norm(a.position_m - b.position_m) for a, b in zip(dragged, put, strict=True)]
    assert [each > 0.05 for each in far_m] == [False, False, False, True, False]
    type_number(browser, "y_m", -0.5)
    type_number(browser, "pitch_deg", 12)
    typed = saved(browser, folder)[3]
    assert (typed.position_m[1], np.degrees(typed.pitch_rad)) == pytest.approx((-0.5, 12.0), abs=1e-5)
    type_number(browser, "roll_deg", "")
    browser.wait_for("/roll_deg: expected a finite number/.test(document.querySelector('.message')?.textContent)")
    click(browser, "mirror")
    browser.wait_for("document.querySelectorAll('.camera').length === 6")
    np.testing.assert_allclose(saved(browser, folder)[5].position_m, typed.position_m * [1, -1, 1], atol=1e-5)
    click(browser, "undo")
    browser.wait_for("document.querySelectorAll('.camera').length === 5")
    browser.wait_for("/\\d/.test(document.querySelector('.score').textContent)")
    before = saved(browser, folder)
    after = polished(browser, folder)
    assert [each.name for each in after] == [each.name for each in before]
    assert any((a.position_m != b.position_m).any() for a, b in zip(after, before, strict=True))
    click(browser, "best place for one more")
    browser.wait_for("document.querySelectorAll('.camera').length === 6")
    assert [each.name for each in saved(browser, folder)[:5]] == [each.name for each in before]


@pytest.mark.slow
def test_two_rigs_are_side_by_side(folder):
    """Ground and road users by which rig alone sees them, one table, and each rig's cameras come and go."""
    words = ["four.yaml", "up.yaml", "scenes.test_seeds=1000..1001", "--port", "0", *SMALL]
    with served(folder, *words) as found, Chromium(CHROMIUM) as browser:
        browser.open(found, width_px=1280, height_px=720)
        browser.wait_for("[...document.images].some(each => each.naturalWidth > 300)")
        settle(browser)
        said = lines(browser)
        assert re.search(r"2 scenesfourupfewer than up \[95 %\]missed per 100, equal false alarms[\d.]+", said)
        scene = town_scene(1000 + int(re.search(r"scene (\d), \d+ found by one alone", said)[1]) - 1)
        ground = Ground.around(DeviceScene.pack(scene))
        one, other = (
            ground.coverage(read_rig(folder / file).cameras, heights_m=HEIGHTS_M[:1]).is_seen.any(axis=(0, 1))
            for file in ("four.yaml", "up.yaml")
        )
        is_open = ground.coverage(rig(1).cameras, heights_m=HEIGHTS_M[:1]).is_open[0]
        shares = {"four alone": one & ~other, "up alone": other & ~one, "both": one & other, "none": ~one & ~other}
        users = 0
        for who, cells in shares.items():
            area_m2, count = re.search(rf"{who}: (\d+) m², (\d+) road user", said).groups()
            assert int(area_m2) == round((cells & is_open).sum() * ground.cell_m**2)
            users += int(count)
        assert users == len(scene.vehicles)
        before = pixels(browser)
        click(browser, "cameras of four")
        wait_until(lambda: np.abs(pixels(browser) - before).max() > 60)
        click(browser, "cameras of four")
        wait_until(lambda: is_as(browser, before))


def test_side_by_side_is_served_alone(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    for words, hint in (
        (["four.yaml", "up.yaml", "--out", "page.html"], r"warpav compare four\.yaml up\.yaml --out page\.html writes"),
        (["street.glb", "up.yaml"], "leave the scene out"),
    ):
        assert main(["view", *words]) == 2
        assert re.fullmatch(rf"command line: expected one rig, got .*; {hint}.*\n", capsys.readouterr().err)


def polished(browser, folder):
    """The cameras after a polish of the rig as it is."""
    click(browser, "polish from here")
    browser.wait_for("document.querySelector('.search') !== null")
    browser.wait_for("document.querySelector('.search') === null")
    return saved(browser, folder)


def saved(browser, folder):
    """The cameras of the rig as the page saves it now."""
    files = set(folder.glob("rig*.yaml"))
    click(browser, "save")
    wait_until(lambda: set(folder.glob("rig*.yaml")) - files)
    [file] = set(folder.glob("rig*.yaml")) - files
    return read_rig(file).cameras


def number(browser, name):
    return browser.evaluate(f"(document.querySelector('.{name} input') || {{}}).value")


def type_number(browser, name, value):
    events = "for (const name of ['input', 'change']) each.dispatchEvent(new Event(name, { bubbles: true }));"
    browser.evaluate(f"((each) => {{ each.value = '{value}'; {events} }})(document.querySelector('.{name} input'))")


def ball(browser, camera):
    """Where the ball of a camera is [px]: the largest patch of its colour, as frustums are thin lines."""
    shown = pixels(browser).astype(np.uint8)
    hue = cv2.cvtColor(shown, cv2.COLOR_RGB2HSV)
    own = cv2.cvtColor(np.array([[camera_rgb(camera)]], np.uint8), cv2.COLOR_RGB2HSV)[0, 0]
    near = (np.abs(hue[..., 0].astype(int) - own[0]) < 8) & (hue[..., 1] > 130)
    depth = cv2.distanceTransform(near.astype(np.uint8), cv2.DIST_L2, 3)
    row, column = np.unravel_index(depth.argmax(), depth.shape)
    return int(column) + PANEL_PX, int(row)


def drag(browser, from_px, to_px, steps=8):
    browser.mouse("move", *from_px, held=False)
    browser.mouse("press", *from_px)
    for k in range(1, steps + 1):
        browser.mouse("move", *(a + (b - a) * k / steps for a, b in zip(from_px, to_px, strict=True)))
    browser.mouse("release", *to_px)


def test_who_does_not_know_the_token_is_not_answered(address):
    with Chromium(CHROMIUM) as browser:
        browser.open(address.split("?")[0] + "?secret=guessed", width_px=1280, height_px=720)
        with Chromium(CHROMIUM) as known:  # until one who knows it is answered
            known.open(address, width_px=1280, height_px=720)
            known.wait_for("document.querySelectorAll('.camera').length === 4")
        assert browser.evaluate("document.querySelectorAll('.camera').length") == 0


def test_no_other_address_is_listened_to(address):
    port = int(re.search(r":(\d+)/", address)[1])
    others = {each[4][0] for each in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)} - {"127.0.0.1"}
    for other in [*others, "127.0.0.2"]:
        with pytest.raises(OSError, match=r"refused|unreachable"):
            socket.create_connection((other, port), timeout=5.0)


def test_a_port_that_is_taken_is_told(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        status = main(["view", "street.glb", "--rig", "four.yaml", "--port", str(port), *SMALL])
    assert status == 2
    said = capsys.readouterr().err
    assert re.fullmatch(
        rf"command line \(--port\): expected one that is free, got {port}: .*; try another one\n", said
    ), said


def test_without_the_extra_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "trame.app", None)
    with pytest.raises(InputError, match=r'expected the extra web, .* pip install "warpav\[web\]"'):
        module.BrowserInspector(lambda panel: pytest.fail("made first"), token="secret")
