"""The report in a browser: no error, no request, no page wider than the window, whole pictures, sensible paper."""

import re

import pytest

from tests.runs.report.chromium import Chromium, find_chromium
from tests.runs.report.run_parts import evaluation, fill, folder_at, seen
from warpav.runs.report.report import write_report

CHROMIUM = find_chromium()
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")

TROUBLE = ("Log.entryAdded", "Runtime.consoleAPICalled", "Runtime.exceptionThrown")


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Of a run with long names, many vehicles and all parts."""
    content = evaluation(outcomes=[seen(float(k), "missed", scene=f"a_rather_long_name_{k}") for k in range(40)])
    folder = fill(folder_at(tmp_path_factory.mktemp("report") / ("a_very_long_name" * 8)), content)
    return write_report(folder)


@pytest.fixture(scope="module")
def browser():
    with Chromium(CHROMIUM) as browser:
        yield browser


def told(browser, *methods):
    return [event["params"] for event in browser.events if event["method"] in methods]


@pytest.mark.parametrize("width_px", [390, 768, 1280])
def test_the_page_fits_any_window(browser, report, width_px):
    browser.open(report, width_px=width_px)
    size = "[document.documentElement.scrollWidth, document.body.scrollWidth, innerWidth]"
    assert browser.evaluate(size) == [width_px] * 3
    # nothing sticks out but what scrolls in its own box
    outside = """[...document.querySelectorAll('main *')].filter(each => !each.closest('.wide, details') &&
        each.getBoundingClientRect().right > innerWidth + 1).map(each => each.outerHTML.slice(0, 80))"""
    assert browser.evaluate(outside) == []
    assert browser.evaluate("[...document.images].filter(each => !each.complete || !each.naturalWidth).length") == 0
    assert browser.evaluate("document.images.length") > 8
    assert told(browser, *TROUBLE) == []
    addresses = [each["request"]["url"] for each in told(browser, "Network.requestWillBeSent")]
    assert [address for address in addresses if not address.startswith("data:")] == [report.as_uri()]


def test_links_and_wide_tables_are_reached_by_keyboard(browser, report):
    browser.open(report, width_px=390)
    reached = """(() => { const boxes = [...document.querySelectorAll('.wide')];
        return boxes.length > 5 && boxes.every(each => each.tabIndex === 0 && each.getAttribute('aria-label')); })()"""
    assert browser.evaluate(reached)
    broken = """[...document.querySelectorAll('a[href^="#"]')].filter(
        each => !document.getElementById(each.getAttribute('href').slice(1))).length"""
    assert browser.evaluate(broken) == 0
    browser.ask("Input.dispatchKeyEvent", type="keyDown", key="Tab", windowsVirtualKeyCode=9)
    browser.ask("Input.dispatchKeyEvent", type="keyUp", key="Tab", windowsVirtualKeyCode=9)
    assert browser.evaluate("document.activeElement.getAttribute('href')") == "#built"


def test_the_page_is_dark_where_that_is_wanted(browser, report):
    colours = {}
    for scheme in ("light", "dark"):
        browser.ask("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        browser.open(report, width_px=768)
        found = browser.evaluate("['color', 'backgroundColor'].map(k => getComputedStyle(document.body)[k])")
        ink, paper = (sum(map(int, re.findall(r"\d+", colour)[:3])) for colour in found)
        colours[scheme] = ink < paper
    browser.ask("Emulation.setEmulatedMedia", features=[])
    assert colours == {"light": True, "dark": False}
