"""The dashboard in a real browser: log in, approve, reject, roll back; nothing runs, nothing is fetched from elsewhere."""

import time

import pytest

pytest.importorskip("websocket", reason="websocket-client is not installed: the dashboard is not opened in a browser")
pytest.importorskip("flask", reason="the extra compgen[serve] is not installed: the dashboard is not tested")
pytest.importorskip("waitress", reason="the extra compgen[serve] is not installed: the dashboard is not tested")
pytest.importorskip("argon2", reason="the extra compgen[serve] is not installed: the dashboard is not tested")

import browser as helper
import serve_site as serving

from compgen.fleet import decisions
from compgen.fleet.store import open_store

factory = serving.factory
pytestmark = pytest.mark.skipif(
    helper.program() is None,
    reason="chromium is not installed (.ci/system-packages): the dashboard is not opened in it",
)
PASSWORD = serving.PASSWORD
PATIENCE_S = 30.0


class Page:
    """What a person does in the browser."""

    def __init__(self, browser, url):
        self.browser, self.url = browser, url

    def visit(self, path):
        self._then(lambda: self.browser.call("Page.navigate", url=self.url + path))

    def press(self, button):
        """Press a button or link by its text, as a mouse does, and wait for the next page."""
        find = f"[...document.querySelectorAll('button, a')].find(e => e.textContent.trim().startsWith({button!r}))"
        place = self.browser.ask(
            f"(() => {{ const e = {find}; e.scrollIntoView({{block: 'center'}}); const r = e.getBoundingClientRect();"
            " return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )

        def click():
            for kind in ("mousePressed", "mouseReleased"):
                point = {"x": place[0], "y": place[1], "button": "left", "clickCount": 1}
                self.browser.call("Input.dispatchMouseEvent", type=kind, **point)

        self._then(click)

    def write(self, selector, text):
        self.browser.ask(f"document.querySelector({selector!r}).focus()")
        self.browser.call("Input.insertText", text=text)

    def text(self):
        return self.browser.ask("document.body.innerText")

    def path(self):
        return self.browser.ask("location.pathname")

    def login(self):
        self.visit("/login")
        self.write("#name", "meyer")
        self.write("#password", PASSWORD)
        self.submit_login()

    def submit_login(self):
        self._then(lambda: self.browser.ask("document.querySelector('main button').click()"))

    def _then(self, action):
        self.browser.next_page(action, PATIENCE_S)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    running = helper.Browser(tmp_path_factory.mktemp("browser"))
    yield running
    running.close()


@pytest.fixture
def site(tmp_path):
    """A dashboard whose store a test may change."""
    made = serving.Served(tmp_path)
    yield made
    made.close()


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """A dashboard that is only looked at; all tests share it."""
    made = serving.Served(tmp_path_factory.mktemp("shown"))
    yield made
    made.close()


@pytest.fixture
def page(browser, site):
    browser.call("Network.clearBrowserCookies")
    return Page(browser, site.url)


@pytest.fixture(scope="module")
def reader(browser, shown):
    """A person who is logged in and looks around."""
    browser.call("Network.clearBrowserCookies")
    looking = Page(browser, shown.url)
    looking.login()
    return looking


def problems(events, url):
    """What the browser complains about, and what it asked others for."""
    found = [str(e["params"]) for e in events if e.get("method") in ("Log.entryAdded", "Runtime.exceptionThrown")]
    asked = [e["params"]["request"]["url"] for e in events if e.get("method") == "Network.requestWillBeSent"]
    return found + [address for address in asked if not address.startswith(f"{url}/")]


PATHS = ("/", "/machines/1", "/machines/1/drift", "/machines/1/recheck", "/machines/1/tables/3", "/machines/4")
PATHS += ("/machines/4/tables/2", "/audit", "/login")


@pytest.mark.parametrize("path", PATHS)
def test_no_page_complains_runs_a_text_or_asks_others(reader, shown, browser, path):
    reader.visit(path)
    assert problems(browser.events, shown.url) == []
    assert browser.ask("document.scripts.length") == 0
    assert browser.ask("document.title").endswith("compgen")
    assert browser.ask("document.documentElement.scrollWidth <= window.innerWidth")


@pytest.mark.parametrize("path", PATHS)
def test_no_page_is_wider_than_a_phone(reader, browser, path):
    reader.visit(path)
    browser.picture(width=390)
    assert browser.ask("document.documentElement.scrollWidth <= 390")
    browser.picture()


@pytest.mark.parametrize("width", [390, 1300])
def test_the_fleet_shows_trend_and_tolerance_without_scrolling(reader, browser, width):
    reader.visit("/")
    browser.picture(width=width)
    beyond = "(() => { const e = document.querySelector('.wide'); return e.scrollWidth - e.clientWidth; })()"
    assert browser.ask(beyond) <= 0
    assert "Tolerance" in reader.text() or width == 390
    browser.picture()


def test_the_pages_follow_dark_and_light_and_narrow_windows(reader, browser):
    reader.visit("/machines/1")
    grounds = set()
    for dark in (False, True):
        browser.picture(dark=dark)
        grounds.add(browser.ask("getComputedStyle(document.body).backgroundColor"))
    assert grounds == {"rgb(255, 255, 255)", "rgb(18, 23, 30)"}
    browser.picture(width=400)
    assert browser.ask("document.documentElement.scrollWidth <= 400")
    browser.picture()


def test_a_person_logs_in_approves_rejects_and_rolls_back(page, site):
    page.visit("/")
    assert "waits for approval" in page.text()
    page.visit("/machines/1/tables/3")
    assert "Approve version" not in page.text()
    page.press("Log in")
    page.write("#name", "meyer")
    page.write("#password", PASSWORD)
    page.submit_login()
    assert "Logged in as meyer" in page.text()
    page.visit("/machines/1/tables/3")
    page.write("#approve-why", "residual shrinks to a quarter")
    page.press("Approve version 3")
    assert page.path() == "/machines/1"
    assert "mill-1: approve is done" in page.text()
    mill = site.store.machine("mill-1")
    assert decisions.active_table(site.store, mill).version == 3

    page.write("#why", "scrap after the change")
    page.press("Roll back")
    assert "mill-1: rollback is done" in page.text()
    assert decisions.active_table(site.store, mill).version == 2

    page.visit("/machines/2/tables/2")
    page.write("#reject-why", "too old")
    page.press("Reject version 2")
    assert "mill-2: reject is done" in page.text()
    assert [t.state for t in site.store.tables(site.store.machine("mill-2"))] == ["active", "rejected"]

    page.visit("/audit?who=people")
    for reason in ("residual shrinks to a quarter", "scrap after the change", "too old"):
        assert reason in page.text()
    page.press("Log out")
    assert "Logged in as" not in page.text()
    page.visit("/machines/2/tables/2")
    assert "Reject version" not in page.text()


def test_held_tables_need_the_box_and_a_reason_before_the_browser_even_sends(page, site, browser):
    page.login()
    page.visit("/machines/2/tables/2")
    before = factory.everything(site.store)
    browser.ask("document.querySelector('form[action$=approve] button').click()")
    time.sleep(0.3)
    assert page.path() == "/machines/2/tables/2"
    assert factory.everything(site.store) == before
    page.write("#approve-why", "measured again")
    browser.ask("document.querySelector('#override').click()")
    page.press("Approve version 2")
    assert "approve is done" in page.text()


def test_a_page_of_another_site_cannot_decide(page, site, browser, tmp_path):
    """The other site knows everything but the token; even with the token its origin is refused."""
    page.login()
    token = browser.ask("document.querySelector('[name=csrf]').value")
    before = factory.everything(site.store)
    other = tmp_path / "evil.html"
    other.write_text(
        f"<form method=post action='{site.url}/machines/1/tables/3/approve'><input name=csrf value='{token}'>"
        "<input name=seen value=2></form>"
    )
    page._then(lambda: browser.call("Page.navigate", url=other.as_uri()))
    page._then(lambda: browser.ask("document.forms[0].submit()"))
    assert "does not come from a page of this dashboard" in page.text()
    assert factory.everything(site.store) == before
    page.visit("/")
    assert "Logged in as meyer" in page.text()


def test_the_store_can_be_opened_again_after_the_dashboard(page, site, tmp_path):
    page.visit("/")
    again = open_store(str(tmp_path / "store.sqlite"))
    assert factory.everything(again) == factory.everything(site.store)
    again.close()
