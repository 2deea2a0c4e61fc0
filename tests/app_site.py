"""The workbench as tests use it: on a real port with its pages in a browser, or in a client of the framework."""

import contextlib
import threading
import time
from pathlib import Path

from compgen.app.pages import Workbench, make_app, make_server
from compgen.web.site import LocalSite

ROOT = Path(__file__).resolve().parents[1]
PATIENCE_S = 90.0


def few_lengths():
    """Name and contents of the shipped example, every third reading: the client of the framework leaves larger ones open."""
    path = ROOT / "examples" / "zha-gantry.lengths.csv"
    lines = path.read_text().splitlines(keepends=True)
    head = next(k for k, line in enumerate(lines) if line.startswith("station,"))
    comments = [line for line in lines[:head] if not line.startswith("# rows")]
    return path.name, "".join([*comments, lines[head], *lines[head + 1 :: 3]]).encode()


def until(done):
    """Wait until something has happened."""
    end = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < end
        time.sleep(0.02)


class Site:
    """The workbench in a test client, with one open project."""

    def __init__(self, folder, *, start=True, language="en"):
        self.workbench = Workbench(LocalSite(8765), language)
        self.number = self.workbench.open(folder)
        self.runner = self.workbench.projects[0]
        self.project = self.runner.project
        self.client = make_app(self.workbench).test_client()
        if start:
            assert self.get(f"/start?token={self.workbench.ticket}").status_code == 303

    url = "http://127.0.0.1:8765"

    def get(self, path, **options):
        return self.client.get(path, base_url=self.url, buffered=True, **options)

    def post(self, path, data=None, *, headers=None, fields=True):
        """Send a form of the project, as its page would; wait until what it started has ended."""
        whole = {"csrf": self.workbench.csrf, "revision": str(self.project.state().revision)} if fields else {}
        sent = {"Origin": self.url} if headers is None else headers
        answer = self.client.post(path, base_url=self.url, data={**whole, **(data or {})}, headers=sent)
        self.runner.wait(PATIENCE_S)
        return answer

    def do(self, path, data=None):
        """Send a form of the project; it must be done without a problem."""
        answer = self.post(f"/projects/1/{path}", data)
        assert answer.status_code == 303, answer.text
        assert self.runner.job is None or self.runner.job.problems == [], self.runner.job.problems
        return self.project.state()


class Served:
    """The workbench on a real port."""

    def __init__(self, folder, language="en"):
        self.workbench = Workbench(LocalSite(0), language)
        self.workbench.open(folder)
        self.runner = self.workbench.projects[0]
        self.project = self.runner.project
        self.server = make_server(self.workbench)
        port = int(self.server.effective_port)
        self.workbench.site = LocalSite(port)
        self.address, self.url = ("127.0.0.1", port), f"http://127.0.0.1:{port}"
        self.start = f"{self.url}/start?token={self.workbench.ticket}"
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self):
        with contextlib.suppress(OSError, ValueError):  # its sockets are closed under it at the end
            self.server.run()

    def close(self):
        self.workbench.close()
        self.server.close()
        self.server.asyncore.close_all(self.server._map, ignore_all=True)
        self.thread.join(timeout=20)
        self.server.task_dispatcher.shutdown()


class Page:
    """What a person does in the browser."""

    def __init__(self, browser, url):
        self.browser, self.url = browser, url
        browser.call("DOM.enable")

    def visit(self, path):
        self._then(lambda: self.browser.call("Page.navigate", url=self.url + path if path.startswith("/") else path))

    def press(self, text):
        """Press the first button or link that begins with these words, and wait for the next page and its result."""
        find = (
            "[...document.querySelectorAll('button, a')].find(e => e.offsetParent !== null && "
            f"e.textContent.trim().startsWith({text!r}))"
        )
        assert self.browser.ask(f"!!{find}"), f"no button {text!r}: {self.text()[:2000]}"
        self._then(lambda: self.browser.ask(f"{find}.click()"))
        self.settle()

    def send(self, selector):
        """Send the form that a field is in, and wait for the next page and its result."""
        self._then(lambda: self.browser.ask(f"document.querySelector({selector!r}).closest('form').requestSubmit()"))
        self.settle()

    def settle(self):
        """Wait until nothing runs and the page shows the result."""
        until = time.monotonic() + PATIENCE_S
        while self.browser.ask("document.readyState !== 'complete' || document.body.dataset.busy === 'yes'"):
            assert time.monotonic() < until, "still busy"
            time.sleep(0.1)

    def write(self, selector, text):
        """Type into a field, as a keyboard does."""
        self.browser.ask(f"(e => {{ e.focus(); e.select(); }})(document.querySelector({selector!r}))")
        self.browser.call("Input.insertText", text=text)

    def choose(self, selector, value):
        """Choose an entry of a list."""
        self.browser.ask(
            f"(e => {{ e.value = {value!r}; e.dispatchEvent(new Event('change')); }})(document.querySelector({selector!r}))"
        )

    def files(self, selector, *paths):
        """Put files into a field for files."""
        document = self.browser.call("DOM.getDocument")["root"]["nodeId"]
        node = self.browser.call("DOM.querySelector", nodeId=document, selector=selector)["nodeId"]
        self.browser.call("DOM.setFileInputFiles", nodeId=node, files=[str(path) for path in paths])

    def key(self, name, count=1):
        """Press Tab, Enter, Space or an arrow, as a keyboard does."""
        code, text = {"Tab": (9, ""), "Enter": (13, "\r"), "Space": (32, " "), "ArrowDown": (40, "")}[name]
        pressed = {"key": text if name == "Space" else name, "code": name, "windowsVirtualKeyCode": code}
        for _ in range(count):
            self.browser.call("Input.dispatchKeyEvent", type="keyDown" if text else "rawKeyDown", text=text, **pressed)
            self.browser.call("Input.dispatchKeyEvent", type="keyUp", **pressed)

    def text(self):
        return self.browser.ask("document.body.innerText")

    def _then(self, action):
        self.browser.next_page(action, PATIENCE_S)
