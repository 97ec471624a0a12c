"""A headless Chromium that tests ask about a page, through its DevTools over two pipes."""

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
TIMEOUT_S = 60.0


def find_chromium():
    """Its file, or None."""
    return next((found for found in map(shutil.which, NAMES) if found), None)


class Chromium:
    """A browser with one page; a context manager.

    Attributes:
        events: Everything that the browser told of the page by itself, as DevTools' messages.
    """

    def __init__(self, file):
        self.file, self.events, self._number, self._rest = file, [], 0, b""

    def __enter__(self):
        with contextlib.ExitStack() as stack:
            profile = stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
            self._read, theirs_to_write = os.pipe()
            theirs_to_read, self._write = os.pipe()
            flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"]
            flags += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]  # WebGL without a GPU
            flags += ["--remote-debugging-pipe", f"--user-data-dir={profile}", "--hide-scrollbars", "about:blank"]
            # DevTools listen on descriptor 3 and answer on 4
            script = f'exec 3<&{theirs_to_read} 4>&{theirs_to_write}; exec "$0" "$@"'
            self._process = subprocess.Popen(
                ["bash", "-c", script, self.file, *flags],
                pass_fds=(theirs_to_read, theirs_to_write),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            os.close(theirs_to_read)
            os.close(theirs_to_write)
            stack.callback(self._stop)
            self._session = None
            target = next(each for each in self.ask("Target.getTargets")["targetInfos"] if each["type"] == "page")
            self._session = self.ask("Target.attachToTarget", targetId=target["targetId"], flatten=True)["sessionId"]
            for domain in ("Page", "Runtime", "Log", "Network"):
                self.ask(f"{domain}.enable")
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exception):
        self._stack.close()

    def _stop(self):
        self._process.terminate()
        self._process.wait(timeout=TIMEOUT_S)
        os.close(self._read)
        os.close(self._write)

    def ask(self, method, **parameters):
        """The answer to a DevTools command; what else comes meanwhile goes to `events`."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                assert "error" not in answer, answer["error"]
                return answer["result"]
            self.events.append(answer)

    def open(self, page, *, width_px, height_px=900):
        """Load a file, or what an address leads to, in a window of this size."""
        self.ask(
            "Emulation.setDeviceMetricsOverride",
            width=width_px,
            height=height_px,
            deviceScaleFactor=1,
            mobile=width_px < 600,
        )
        self.events.clear()
        address = page if str(page).startswith("http:") else Path(page).absolute().as_uri()
        self.ask("Page.navigate", url=address)
        while not any(event["method"] == "Page.loadEventFired" for event in self.events):
            self.events.append(self._next())

    def evaluate(self, expression):
        """What a JavaScript expression gives."""
        answer = self.ask("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait_for(self, expression):
        """Until a JavaScript expression is true."""
        deadline = time.monotonic() + TIMEOUT_S
        while not self.evaluate(expression):
            assert time.monotonic() < deadline, f"not within {TIMEOUT_S:g} s: {expression}"
            time.sleep(0.05)

    def mouse(self, kind, x_px, y_px, *, held=True):
        """A move, press or release of the left button."""
        which = {"move": "mouseMoved", "press": "mousePressed", "release": "mouseReleased"}[kind]
        self.ask(
            "Input.dispatchMouseEvent",
            type=which,
            x=x_px,
            y=y_px,
            button="left" if held else "none",
            buttons=int(held),
            clickCount=int(kind != "move"),
        )

    def pdf(self):
        """The page as it is printed, on the paper that it asks for."""
        answer = self.ask("Page.printToPDF", printBackground=True, preferCSSPageSize=True)
        return base64.b64decode(answer["data"])

    def screenshot(self, *, whole=True):
        """The page as a PNG file: the whole, which tells the page of another window, or what the window shows."""
        return base64.b64decode(self.ask("Page.captureScreenshot", captureBeyondViewport=whole)["data"])

    def _next(self):
        deadline = time.monotonic() + TIMEOUT_S
        while b"\0" not in self._rest:
            left = deadline - time.monotonic()
            ready, _, _ = select.select([self._read], [], [], max(left, 0.0))
            assert ready, f"{self.file} did not answer within {TIMEOUT_S:g} s"
            part = os.read(self._read, 1 << 20)
            assert part, f"{self.file} ended with status {self._process.wait()}"
            self._rest += part
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)
