"""The page of a part in a real browser: nothing fails or is fetched, the picture turns, its legend has units, dark too."""

import io
import json

import browser as helper
import matplotlib.image
import numpy as np
import pytest

from compgen.programs.part import PartPrediction
from compgen.programs.path import PathFigures
from compgen.report.part_page import part_page

pytest.importorskip("websocket", reason="websocket-client is not installed: the page is not opened in a browser")
pytestmark = pytest.mark.skipif(
    helper.program() is None, reason="chromium is not installed (.ci/system-packages): the page is not opened in it"
)
EVIL = "</script><img src=x onerror='window.hacked=1'>.nc"
#: Number of pixels of the canvas that are not empty, a sum over their places, and the enlargement that is stated.
LOOK = """(() => {
  const canvas = document.getElementById("part"), draw = canvas.getContext("2d");
  const data = draw.getImageData(0, 0, canvas.width, canvas.height).data;
  let drawn = 0, sum = 0;
  for (let k = 0; k < data.length; k += 4) if (data[k + 3]) { drawn += 1; sum = (sum * 31 + k) % 1000003; }
  return { drawn, sum, says: document.getElementById("says").textContent };
})()"""
FRAMES = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    page = helper.Browser(tmp_path_factory.mktemp("browser"))
    yield page
    page.close()


@pytest.fixture(scope="module")
def opened(browser, tmp_path_factory):
    angle = np.linspace(0, 2 * np.pi, 6001)
    at = np.stack([60 * np.cos(angle), 40 * np.sin(angle), 5 * np.sin(3 * angle)], axis=1)
    off = 1e-3 * np.stack([3 * np.cos(angle), 8 * np.sin(angle), 0 * angle], axis=1)
    shown = {"as the machine is": off, "as the machine is, best fit": 0.5 * off}
    found = PartPrediction("mill", EVIL, PathFigures(), position_mm=at, deviation_mm=shown, every=16)
    path = tmp_path_factory.mktemp("page") / "part.html"
    path.write_text(part_page(found), encoding="utf-8")
    return browser.open(path)


def test_nothing_fails_and_nothing_is_fetched(browser, opened):
    kinds = [event["method"] for event in opened]
    assert "Runtime.exceptionThrown" not in kinds
    assert not [e for e in opened if e["method"] == "Log.entryAdded" and e["params"]["entry"]["level"] == "error"]
    requests = [e["params"]["request"]["url"] for e in opened if e["method"] == "Network.requestWillBeSent"]
    assert len(requests) == 1
    assert browser.ask("window.hacked") is None
    assert browser.ask("document.querySelector('h1').textContent") == EVIL
    assert "One of 16 samples" in browser.ask("document.body.textContent")


def test_mouse_keys_slider_and_view_change_the_picture(browser, opened):
    seen = [browser.ask(LOOK)]
    assert seen[0]["drawn"] > 3000
    assert seen[0]["says"].endswith(" times")

    def then(action):
        action()
        browser.ask(FRAMES)
        seen.append(browser.ask(LOOK))

    browser.ask("document.getElementById('part').scrollIntoView()")
    box = json.loads(browser.ask("JSON.stringify(document.getElementById('part').getBoundingClientRect())"))
    x, y = box["x"] + 300, box["y"] + 200

    def mouse(kind, x, y):
        browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def drag():
        mouse("mousePressed", x, y)
        mouse("mouseMoved", x + 80, y + 30)
        mouse("mouseReleased", x + 80, y + 30)

    def key(name):
        browser.ask("document.getElementById('part').focus()")
        browser.call("Input.dispatchKeyEvent", type="keyDown", key=name, text=name if len(name) == 1 else "")

    then(drag)
    then(lambda: key("ArrowLeft"))
    then(lambda: key("+"))
    then(
        lambda: browser.ask(
            "(() => { const s = document.getElementById('scale'); s.value = 90; s.dispatchEvent(new Event('input')); })()"
        )
    )
    then(
        lambda: browser.ask(
            "(() => { const v = document.getElementById('view'); v.value = '1'; v.dispatchEvent(new Event('change')); })()"
        )
    )
    then(lambda: browser.ask("document.getElementById('home').click()"))
    assert len({item["sum"] for item in seen}) == len(seen)
    assert seen[4]["says"] != seen[3]["says"]
    # the largest deviation is drawn at the same size in both views: with half of it the enlargement doubles
    times = [float(item["says"].split()[0]) for item in seen[4:6]]
    assert times[1] == pytest.approx(2 * times[0], rel=0.05)


@pytest.mark.parametrize("dark", [False, True])
def test_the_picture_is_seen_in_light_and_dark(browser, opened, dark):
    picture = matplotlib.image.imread(io.BytesIO(browser.picture(dark=dark)))[:, :, :3]
    light = picture.mean(axis=2)
    ground = np.median(light)
    assert (ground < 0.2) == dark
    assert (np.abs(light - ground) > 0.25).mean() > 0.005
