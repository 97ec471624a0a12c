"""Pages that stand alone: what they hold, and what a browser shows of them."""

import io
import re

import numpy as np
import pytest
from PIL import Image

from tests.runs.report.chromium import Chromium, find_chromium
from tests.view.stand_ins import needs_opengl, rig, scene, vehicle
from warpav.core.errors import InputError
from warpav.scene import DeviceScene
from warpav.sight import Ground
from warpav.view import Canvas, Picture, add_coverage, add_range_rings, patch_words, rig_plotter, save_page
from warpav.view import _page as module

pytest.importorskip("k3d")
pytestmark = needs_opengl
CHROMIUM = find_chromium()
HOSTILE = "</script><img src=x onerror=alert(1)>"
RED_RGB, BLUE_RGB = (220, 20, 30), (20, 40, 230)


@pytest.fixture(scope="module")
def plotters():
    """One rig in two scenes, of which the second has a blue vehicle where the first has a red one."""
    made = {}
    for name, colour in (("first", RED_RGB), ("second", BLUE_RGB)):
        street = scene(vehicle(1, 8.0, 0.5, rgb=colour))
        plotter = rig_plotter(Picture(rig=rig(3), scene=street), Canvas(off_screen=True, zoom=0.6), sectors=False)
        add_range_rings(plotter, street)
        ground = Ground.around(DeviceScene.pack(street))
        for height_m in (1.1, 1.7):
            coverage = ground.coverage(rig(3).cameras, heights_m=(height_m,))
            add_coverage(plotter, coverage, name=f"coverage/{patch_words(height_m)}", legend=False)
        made[name] = plotter
    yield made
    for plotter in made.values():
        plotter.close()


@pytest.fixture(scope="module")
def file(plotters, tmp_path_factory):
    return save_page(plotters, tmp_path_factory.mktemp("page") / "rig.html", title=HOSTILE, lines=[HOSTILE])


def test_the_panel_switches_what_is_there(plotters):
    page = module.page_of(plotters, title="rig")
    values = {control.key: list(control.values) for control in page._controls}
    assert values == {
        "scene": ["first", "second"],
        "ground": ["1.1 m tall", "1.7 m tall", "off"],
        "show": ["names", "range rings"],
        "camera": ["cam_0", "cam_1", "cam_2"],
    }
    tags = [{key: value for key, value in each.items() if key != "id"} for each in page._tags]
    for name in values["camera"]:
        assert {"camera": name} in tags
        assert tags.count({"camera": name, "show": "names"}) == 1
    assert {"scene": "second", "ground": "1.7 m tall"} in tags
    assert tags.count({"show": "range rings", "scene": "second"}) == 8  # circles and their radii


def test_one_scene_needs_no_switch(plotters):
    page = module.page_of({"first": plotters["first"]}, title="rig")
    assert [control.key for control in page._controls] == ["ground", "show", "camera"]


def test_colours_and_places_are_those_of_the_plotter(plotters):
    page = module.page_of(plotters, title="rig")
    meshes = [drawn for drawn in page._plot.objects if drawn.type == "Mesh"]
    colours = {int(each) for drawn in meshes for each in np.unique(drawn.colors)}
    vehicle_m = next(drawn for drawn in meshes if len(np.unique(drawn.colors)) and _is_red(drawn)).vertices
    np.testing.assert_allclose(vehicle_m.min(axis=0), [6.0, -0.4, 0.0], atol=1e-5)
    np.testing.assert_allclose(vehicle_m.max(axis=0), [10.0, 1.4, 1.5], atol=1e-5)
    assert len(colours) > 5


def _is_red(drawn):
    rgb = np.stack([np.asarray(drawn.colors) >> shift & 255 for shift in (16, 8, 0)], axis=-1)
    return len(rgb) == 36 and (rgb[:, 0] > rgb[:, 2] + 50).all()


def test_the_page_is_one_file_that_asks_for_nothing(file):
    text = file.read_text(encoding="utf-8")
    assert HOSTILE not in text
    assert "&lt;/script&gt;" in text.split("</title>")[0]
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=.https?:", text)


def test_without_the_extra_it_says_what_to_install(monkeypatch, plotters, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "k3d", None)
    with pytest.raises(InputError, match=r'needs the module k3d, .*pip install "warpav\[web\]"'):
        save_page(plotters, tmp_path / "rig.html", title="rig")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
def test_a_browser_shows_it_and_what_is_switched_off_goes(file):
    with Chromium(CHROMIUM) as browser:
        browser.open(file, width_px=700, height_px=420)
        browser.wait_for("document.querySelector('#panel') !== null")
        assert browser.evaluate("document.querySelector('#panel h1').textContent") == HOSTILE
        names = (
            "[...document.querySelectorAll('#canvasTarget > div > div')].filter("
            "each => /^cam_/.test(each.textContent) && each.style.display !== 'none' "
            "&& !/-1000px/.test(each.style.transform) && !/- 1000px/.test(each.style.transform)).length"
        )
        browser.wait_for(f"{names} === 3")
        assert red_and_blue(browser) == (True, False)
        browser.evaluate(
            "(s => { s.value = 'second'; s.dispatchEvent(new Event('change')); })(document.querySelector('select'))"
        )
        browser.wait_for("K3DInstance !== undefined")
        settle(browser)
        assert red_and_blue(browser) == (False, True)
        with_rings = pixels(browser)

        def click(label):
            browser.evaluate(f"[...document.querySelectorAll('label')].find(l => l.textContent === '{label}').click()")

        click("range rings")
        settle(browser)
        assert np.abs(pixels(browser).astype(int) - with_rings).max() > 60
        click("cam_1")
        browser.wait_for(f"{names} === 2")
        settle(browser)
        fewer = blind(browser)
        click("cam_1")
        settle(browser)
        assert fewer > blind(browser) + 0.005  # what only this camera sees is red while it is unticked
        before = pixels(browser)
        browser.mouse("move", 600, 200, held=False)
        browser.mouse("press", 600, 200)
        for k in range(1, 6):
            browser.mouse("move", 600 + 20 * k, 200)
        browser.mouse("release", 700, 200)
        settle(browser)
        assert np.abs(pixels(browser).astype(int) - before).mean() > 2.0  # it turned
        requests = [e["params"]["request"]["url"] for e in browser.events if e["method"] == "Network.requestWillBeSent"]
        assert [each for each in requests if not each.startswith(("data:", "blob:", file.as_uri()))] == []
        assert [e for e in browser.events if e["method"] == "Runtime.exceptionThrown"] == []


def blind(browser):
    """Share of the pixels that are as red as ground that nobody sees, but no vehicle."""
    red, green, blue = np.moveaxis(pixels(browser).astype(int), -1, 0)
    return float(((red > green + 40) & (red > blue + 40) & (green > 60)).mean())


def settle(browser):
    """Two images later."""
    browser.evaluate("new Promise(done => setTimeout(() => requestAnimationFrame(() => setTimeout(done, 200)), 200))")


def pixels(browser):
    return np.asarray(Image.open(io.BytesIO(browser.screenshot())).convert("RGB"))


def red_and_blue(browser):
    rgb = pixels(browser)[:, 330:].astype(int)  # beside the panel
    red = (rgb[..., 0] > rgb[..., 1] + 70) & (rgb[..., 0] > rgb[..., 2] + 60) & (rgb[..., 1] < 60)
    blue = (rgb[..., 2] > rgb[..., 0] + 110) & (rgb[..., 2] > rgb[..., 1] + 100)
    return int(red.sum()) > 300, int(blue.sum()) > 300
