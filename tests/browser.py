"""Headless Chromium for tests over its DevTools protocol: open a page, collect what it reports, ask it, take pictures."""

import base64
import contextlib
import json
import re
import shutil
import subprocess
import time

import websocket

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",  # the tests may run as root
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-extensions",
    "--no-first-run",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
    "--remote-allow-origins=*",
)
PATIENCE_S = 60.0


def program():
    """Path of the browser, or None."""
    return next((path for path in map(shutil.which, NAMES) if path), None)


class Browser:
    """One running browser with one page."""

    def __init__(self, folder):
        self.log = folder / "chromium.log"
        with self.log.open("wb") as stream:
            command = [program(), *FLAGS, f"--user-data-dir={folder / 'profile'}", "about:blank"]
            self.process = subprocess.Popen(command, stdout=stream, stderr=stream)
        self.socket = websocket.create_connection(self._address(), timeout=PATIENCE_S)
        self.count, self.events, self.session = 0, [], None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def _address(self):
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            found = re.search(rb"DevTools listening on (ws://\S+)", self.log.read_bytes())
            if found:
                return found.group(1).decode()
            if self.process.poll() is not None:
                break
            time.sleep(0.05)
        raise RuntimeError(f"the browser did not start: {self.log.read_text(errors='replace')[-2000:]}")

    def call(self, method, **parameters):
        """Send one command and return its result; events that come in between are kept."""
        self.count += 1
        message = {"id": self.count, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        self.socket.send(json.dumps(message))
        while True:
            answer = json.loads(self.socket.recv())
            if answer.get("id") == self.count:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]
            self.events.append(answer)

    def next_page(self, action, patience_s=PATIENCE_S):
        """Do something that leads to another page, and wait until that has loaded."""
        self.events.clear()
        action()
        until = time.monotonic() + patience_s
        while not any(event.get("method") == "Page.loadEventFired" for event in self.events):
            assert time.monotonic() < until, "no page was loaded"
            with contextlib.suppress(AssertionError):  # a page that is being left does not answer
                self.ask("1")
            time.sleep(0.02)

    def open(self, path):
        """Open a file and wait until it is loaded; return the events from its beginning on."""
        self.events = []
        self.call("Page.navigate", url=path.resolve().as_uri())
        until = time.monotonic() + PATIENCE_S
        while not any(event.get("method") == "Page.loadEventFired" for event in self.events):
            assert time.monotonic() < until, "the page did not load"
            self.events.append(json.loads(self.socket.recv()))
        return self.events

    def ask(self, expression):
        """Value of a JavaScript expression in the page."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def picture(self, width=1280, height=900, dark=False, media=""):
        """PNG of the page in a window of the given size."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", media=media, features=[scheme])
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def close(self):
        """End this browser."""
        try:
            self.session = None
            self.call("Browser.close")
        except (OSError, websocket.WebSocketException):
            self.process.terminate()
        finally:
            self.socket.close()
            try:
                self.process.wait(timeout=20)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait(timeout=20)
