"""The viewer in a headless browser: time to the first image, images a second while it turns, and a camera's drag.

A program, not a test: ``python tests/benchmarks/browser.py``. It makes a scene of 200,000 triangles, serves it, opens
it at 1280 x 720 px in Chromium without a GPU on the same machine, and reads the times of what arrives: a drag is timed
from the move of the mouse to the image with the coverage of the camera's new position.
"""

from __future__ import annotations

import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.benchmarks.test_inspector import large_scene
from tests.runs.report.chromium import Chromium, find_chromium
from tests.view.test_browser import ball
from warpav.rig.rig import write_rig
from warpav.runs.config import load_config
from warpav.runs.rig_source import find_rig
from warpav.scene.glb import write_scene

IMAGE_BYTES = 10_000
"""What arrives and is larger is an image."""


def main() -> None:
    """Serve, open, turn, drag, and print."""
    with tempfile.TemporaryDirectory() as folder:
        scene = large_scene()
        write_scene(scene, Path(folder) / "large.glb")
        write_rig(find_rig("highest", load_config("quick", []), scene.ego), Path(folder) / "four.yaml")
        command = [
            sys.executable,
            "-u",
            "-m",
            "warpav.cli.app",
            "view",
            "large.glb",
            "--rig",
            "four.yaml",
            "--port",
            "0",
        ]
        began = time.monotonic()
        with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as server:
            try:
                assert server.stdout is not None
                address = next(found[1] for line in server.stdout if (found := re.search(r"open (http\S+)", line)))
                print(f"from the shell to the address: {time.monotonic() - began:.1f} s")  # noqa: T201
                measure(address)
            finally:
                server.send_signal(signal.SIGINT)
                server.wait(timeout=30)


def measure(address: str) -> None:
    """Open an address and use what it shows."""
    file = find_chromium()
    assert file is not None, "no Chromium is installed"
    with Chromium(file) as browser:
        began = time.monotonic()
        browser.open(address, width_px=1280, height_px=720)
        browser.wait_for("[...document.images].some(each => each.naturalWidth > 300)")
        print(f"from the address to the first image: {time.monotonic() - began:.1f} s")  # noqa: T201
        browser.evaluate("new Promise(done => setTimeout(done, 2000))")

        for name, at_px in (("a camera dragged", ball(browser, 0)), ("turned", (500, 650))):
            browser.events.clear()
            browser.mouse("move", *at_px, held=False)
            browser.mouse("press", *at_px)
            moved_at, k, until = [], 0, time.monotonic() + 5.0
            while time.monotonic() < until:
                k += 1
                moved_at.append(time.monotonic())
                browser.mouse("move", at_px[0] + 40 * ((k % 20) - 10) / 10, at_px[1] + 5 * (k % 2))
                browser.evaluate("new Promise(done => setTimeout(done, 8))")
            browser.mouse("release", *at_px)
            browser.evaluate("new Promise(done => setTimeout(done, 1500))")
            report(f"{name} by {k / 5.0:.0f} moves a second", browser.events)


def report(name: str, events: list) -> None:
    """Images a second, and from each answered request of the browser to the image after it [ms]."""
    shown, asked = [], []
    for event in events:
        if event["method"] == "Network.webSocketFrameReceived":
            if len(event["params"]["response"]["payloadData"]) > IMAGE_BYTES:
                shown.append(event["params"]["timestamp"])
        elif event["method"] == "Network.webSocketFrameSent":
            asked.append(event["params"]["timestamp"])
    images = [each for each, last in zip(shown[1:], shown, strict=False) if each - last > 0.002]
    span = images[-1] - images[0]
    waits = [1e3 * (next((at for at in images if at > each), each) - each) for each in asked if each < images[-1]]
    print(  # noqa: T201
        f"{name}: {len(images) / span:.1f} images a second; from a message of the browser to the next image: median "
        f"{statistics.median(waits):.0f} ms, 90 % within {sorted(waits)[int(0.9 * len(waits))]:.0f} ms"
    )


if __name__ == "__main__":
    main()
