"""The report in a real browser: nothing fails, nothing is fetched, pictures are drawn, switches work, texts stay texts."""

import io
import json

import browser as helper
import matplotlib.image
import numpy as np
import pytest

from compgen.data.names import CURVE_NAMES, SQUARENESS_NAMES, error_named
from compgen.report.html import write_report

pytest.importorskip("websocket", reason="websocket-client is not installed: the report is not opened in a browser")


pytestmark = pytest.mark.skipif(
    helper.program() is None, reason="chromium is not installed (.ci/system-packages): the report is not opened in it"
)

NODES, POINTS_PER_SIDE, STATIONS = 101, 21, 4
MOST_BYTES = 5_000_000
MOST_MS = 2000.0
EVIL = "</script><script>window.hacked=1</script><img src=x onerror='window.hacked=2'>\u2028{{7*7}}"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    page = helper.Browser(tmp_path_factory.mktemp("browser"))
    yield page
    page.close()


def csv(path, columns, rows, comments=()):
    lines = [*(f"# {text}" for text in comments), ",".join(columns), *(",".join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def figures(scale):
    return {
        name: scale * (k + 1) for k, name in enumerate(("max_um", "rms_um", "p95_um", "v_x_um", "v_y_um", "v_z_um"))
    }


def errors_rows(nodes=NODES):
    position = np.linspace(-800.0, 0.0, nodes)
    for k, name in enumerate(CURVE_NAMES):
        for at, value in zip(position, 5.0 * np.sin(position / (90.0 + 7 * k)), strict=True):
            yield name, f"{at:.6f}", f"{value:.6f}", "0.2"
    for name in SQUARENESS_NAMES:
        yield name, "", "12.5", "0.4"


def volume_rows(side=POINTS_PER_SIDE):
    level = np.linspace(0.0, 1.0, side)
    for x in level * 800 - 800:
        for y in level * 1000:
            for z in level * 300:
                before = (0.02 * y, 0.01 * x, 5.0 + 0.003 * z)
                yield tuple(f"{v:.4f}" for v in (x, y, z, *before, *(0.01 * v for v in before)))


def big_folder(folder, text="plain", *, nodes=NODES, side=POINTS_PER_SIDE):
    """A folder as a run leaves it: 21 errors at 101 nodes, 4 x 9261 lengths, 9261 points; every label holds ``text``.

    Fewer ``nodes`` and points on a ``side`` make one that is drawn sooner, with the same sections.
    """
    folder.mkdir()
    stations = [
        {"station": f"{text} {k}", "setup": 0, "position_mm": [300.0 * k, -400.0, 200.0], "dead_length_mm": 400.0}
        | {"readings": 9261, "rms_um": 0.3}
        for k in range(STATIONS)
    ]
    inputs = [{"name": f"{text}.csv", "sha256": "0" * 64}]
    identify = {"method": "joint", "readings": 37044, "readings_used": 37044, "residual_rms_um": 0.3, "inputs": inputs}
    identify |= {"identified": [*CURVE_NAMES, *SQUARENESS_NAMES], "stations": stations, "unobservable": [text]}
    identify["rejected"] = [{"station": text, "point": text, "reason": text}]
    (folder / "identify.json").write_text(json.dumps(identify))
    result = {"accepted": True, "partial": False, "controller": text, "points": 9261, "unrepresentable_um": 0.3}
    result |= {"before": figures(40.0), "after": figures(0.4), "before_rigid_motion_removed": figures(20.0)}
    result |= {"after_rigid_motion_removed": figures(0.2), "uncorrected_um": {"EAX": 3.5, text: 1.0}}
    result |= {"reasons": [], "notes": [text], "files": [{"name": "TABLE.TXT", "sha256": "1" * 64}]}
    (folder / "result.json").write_text(json.dumps(result))
    manifest = {"program": text, "format": text, "sign_statement": text, "settings": {text: text}, "unverified": [text]}
    manifest |= {"machine": {"name": text, "chain": "WFYXZT"}, "inputs": inputs, "warnings": [text]}
    manifest["parameters"] = [{"name": text, "value": text, "meaning": text}]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    (folder / "TABLE.TXT").write_text(f"</pre>{text}\n", encoding="utf-8")
    (folder / "preflight.md").write_text(
        f"# {text}\n\n- [ ] {text}\n\n[x](javascript:alert(1)) ![y](http://e.x/a.png)\n"
    )
    csv(
        folder / "identified.errors.csv",
        ("error", "position_mm", "value", "u_value"),
        errors_rows(nodes),
        [f"date = {text}"],
    )
    columns = ("x_mm", "y_mm", "z_mm", *(f"{w}_{a}_um" for w in ("before", "after") for a in "xyz"))
    csv(folder / "volume.csv", columns, volume_rows(side), [f"note = {text}"])
    generator = np.random.default_rng(3)
    grid = [row[:3] for row in volume_rows(side)]
    quoted = [f'"{text.replace(chr(34), chr(34) * 2)} {k}"' for k in range(STATIONS)]
    rows = (
        (quoted[k], *place, f"{value:.4f}", 1)
        for k in range(STATIONS)
        for place, value in zip(grid, 0.3 * generator.standard_normal(len(grid)), strict=True)
    )
    csv(folder / "residuals.csv", ("station", "x_mm", "y_mm", "z_mm", "residual_um", "used"), rows)
    return folder


@pytest.fixture(scope="module")
def big(tmp_path_factory):
    folder = big_folder(tmp_path_factory.mktemp("big") / "run")
    with pytest.warns(Warning, match="is not the file that was verified"):
        write_report(folder)
    return folder / "report.html"


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = big_folder(tmp_path_factory.mktemp("small") / "run", nodes=11, side=5)
    with pytest.warns(Warning, match="is not the file that was verified"):
        write_report(folder)
    return folder / "report.html"


def problems(events):
    """Console errors, exceptions and complaints of the browser among events."""
    found = []
    for event in events:
        method, values = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            found.append(values["exceptionDetails"])
        elif method == "Log.entryAdded" and values["entry"]["level"] in ("error", "warning"):
            found.append(values["entry"]["text"])
        elif method == "Runtime.consoleAPICalled":
            found.append(values["args"])
    return found


def fetched(events):
    """Addresses that the page asked for, without itself and the pictures that it holds."""
    asked = [
        event["params"]["request"]["url"] for event in events if event.get("method") == "Network.requestWillBeSent"
    ]
    return [url for url in asked if not url.startswith("data:") and not url.endswith("report.html")]


def brightness(png):
    return float(matplotlib.image.imread(io.BytesIO(png))[..., :3].mean())


def test_the_page_loads_without_errors_and_without_the_network(browser, big):
    events = browser.open(big)
    assert problems(events) == []
    assert fetched(events) == []
    assert browser.ask("document.documentElement.dataset.ready") == "1"
    assert "http" not in browser.ask("document.querySelector('meta[http-equiv]').content")


def test_the_policy_stops_a_request_that_a_script_would_make(browser, big):
    """Shows that the two tests above would notice: the same listeners see a forbidden request."""
    browser.open(big)
    refused = browser.ask("fetch('http://127.0.0.1:9/').then(() => 'sent', () => 'refused')")
    assert refused == "refused"
    assert any("Content Security Policy" in str(text) for text in problems(browser.events))


def test_the_largest_usual_page_is_small_and_drawn_within_2_seconds(browser, big):
    assert big.stat().st_size < MOST_BYTES
    took = []
    for _ in range(3):
        browser.open(big)
        took.append(browser.ask("performance.getEntriesByType('navigation')[0].loadEventEnd"))
    assert 0.0 < min(took) < MOST_MS


def test_every_picture_has_shapes_of_some_size(browser, big):
    browser.open(big)
    browser.picture()
    boxes = browser.ask(
        "Array.from(document.querySelectorAll('svg.plot')).map(s => [s.id || s.querySelector('title').textContent, "
        "s.querySelectorAll('path, image, text').length, s.getBoundingClientRect().width, s.getBoundingClientRect().height])"
    )
    assert (
        len(boxes) == len(CURVE_NAMES) + 9 + STATIONS
    )  # squareness, space, 6 slices, stations; residuals of each station
    assert all(shapes >= 5 and width > 100 and height > 60 for _, shapes, width, height in boxes), boxes
    assert browser.ask("document.querySelectorAll('#figure-curve-EXX title').length") == 1
    line = browser.ask(
        "(() => { const p = Array.from(document.querySelectorAll('#figure-curve-EXX path'))"
        ".find(p => getComputedStyle(p).stroke === 'rgb(0, 114, 178)'); return p.getTotalLength(); })()"
    )
    assert line > 100


def test_ids_are_unique_and_every_reference_inside_the_page_has_a_target(browser, big):
    browser.open(big)
    assert (
        browser.ask(
            "(() => {const i = Array.from(document.querySelectorAll('[id]')).map(e => e.id);"
            " return i.length - new Set(i).size})()"
        )
        == 0
    )
    assert (
        browser.ask(
            "Array.from(document.querySelectorAll('use, a')).map(e => e.getAttribute('href') || e.getAttribute('xlink:href'))"
            ".filter(h => !document.getElementById(h.slice(1)))"
        )
        == []
    )


def test_layers_of_the_volume_are_switched(browser, big):
    browser.open(big)
    shown = "getComputedStyle(document.querySelector('.layer-{}')).display"
    press = "document.querySelector('button[data-layer={}]').click()"
    assert [browser.ask(shown.format(name)) for name in ("before", "after", "own")] == ["inline", "inline", "none"]
    browser.ask(press.format("before"))
    browser.ask(press.format("own"))
    assert [browser.ask(shown.format(name)) for name in ("before", "after", "own")] == ["none", "inline", "inline"]
    assert browser.ask("document.querySelector('button[data-layer=before]').getAttribute('aria-pressed')") == "false"


def test_an_error_is_chosen_and_enlarged(browser, big):
    browser.open(big)
    browser.picture()
    width = "document.querySelector('#figure-curve-{} svg').getBoundingClientRect().width"
    before = browser.ask(width.format("EBY"))
    browser.ask(
        "(() => {const s = document.getElementById('error'); s.value = 'curve-EBY';"
        " s.dispatchEvent(new Event('change'))})()"
    )
    assert browser.ask(width.format("EBY")) > 2.0 * before
    assert browser.ask(width.format("EAX")) == pytest.approx(before, rel=0.01)


def test_hover_and_arrow_keys_say_the_values_of_the_file(browser, big):
    """EYX at its middle node, -400 mm: 5 sin(-400 / 97) by hand; U is twice the 0.2 um of the file."""
    browser.open(big)
    browser.picture()
    browser.ask("document.getElementById('figure-curve-EYX').scrollIntoView({block: 'center'})")
    box = browser.ask(
        "(() => {const r = document.querySelector('#figure-curve-EYX svg').getBoundingClientRect();"
        " const f = JSON.parse(document.getElementById('data').textContent)['curve-EYX'].frame;"
        " const s = r.width / 250; return [r.left + s * (f[0] + f[2]) / 2, r.top + s * (f[1] + f[3]) / 2]})()"
    )
    browser.call("Input.dispatchMouseEvent", type="mouseMoved", x=box[0], y=box[1])
    expected = f"{5.0 * np.sin(-400.0 / 97.0):.4g}".replace("-", "\u2212")
    text = browser.ask("document.getElementById('tip').textContent")
    assert text.splitlines() == ["\u2212400 mm", f"identified: {expected} ± 0.4"]
    browser.ask("document.getElementById('figure-curve-EYX').focus()")
    browser.call("Input.dispatchKeyEvent", type="keyDown", key="ArrowRight", code="ArrowRight")
    assert browser.ask("document.getElementById('tip').textContent").startswith("\u2212392 mm")
    browser.call("Input.dispatchKeyEvent", type="keyDown", key="Escape", code="Escape")
    assert browser.ask("document.getElementById('tip').hidden") is True


def test_a_dragged_part_is_shown_larger_with_numbers_of_its_own_and_double_click_goes_back(browser, big):
    """The middle half of the axis of EYX: -800 ... 0 mm with a margin of 2 % shows -608 ... -192 mm after that."""
    browser.open(big)
    browser.picture()
    browser.ask("document.getElementById('figure-curve-EYX').scrollIntoView({block: 'center'})")
    left, right, y = browser.ask(
        "(() => {const r = document.querySelector('#figure-curve-EYX svg').getBoundingClientRect();"
        " const f = JSON.parse(document.getElementById('data').textContent)['curve-EYX'].frame, s = r.width / 250;"
        " return [r.left + s * (0.75 * f[0] + 0.25 * f[2]), r.left + s * (0.25 * f[0] + 0.75 * f[2]), r.top + s * f[3] / 2]})()"
    )
    numbers = "Array.from(document.querySelectorAll('#figure-curve-EYX .scale text')).map(t => t.textContent)"
    whole = browser.ask(numbers)
    for kind, x in (("mousePressed", left), ("mouseMoved", right), ("mouseReleased", right)):
        browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)
    shown = [float(text.replace("\u2212", "-")) for text in browser.ask(numbers)]
    assert "-600" not in whole
    assert {-600.0, -500.0, -400.0, -300.0, -200.0} <= set(shown)
    assert not {-800.0, 0.0} <= set(shown)
    matrix = browser.ask("document.querySelector('#figure-curve-EYX .drawn').getAttribute('transform')")
    assert float(matrix[7:].split()[0]) == pytest.approx(2.0, abs=0.05)
    browser.ask(
        "document.querySelector('#figure-curve-EYX svg').dispatchEvent(new MouseEvent('dblclick', {bubbles: true}))"
    )
    assert browser.ask(numbers) == whole
    assert browser.ask("document.querySelector('#figure-curve-EYX').classList.contains('large')") is False
    browser.ask("document.getElementById('figure-curve-EYX').focus()")
    browser.call("Input.dispatchKeyEvent", type="keyDown", key="+", code="Equal")
    assert browser.ask("document.querySelector('#figure-curve-EYX').classList.contains('zoomed')") is True
    assert problems(browser.events) == []


def test_cells_of_a_slice_say_the_error_of_the_file(browser, big):
    """Before, at the middle of the plane XY: the file has (0.02 y, 0.01 x, 5 + 0.003 z) um, so |e| follows by hand."""
    browser.open(big)
    browser.picture()
    browser.ask("document.getElementById('figure-slice-0-before-2').scrollIntoView({block: 'center'})")
    box = browser.ask(
        "(() => {const r = document.querySelector('#figure-slice-0-before-2 svg').getBoundingClientRect();"
        " const f = JSON.parse(document.getElementById('data').textContent)['slice-0-before-2'].frame, s = r.width / 250;"
        " return [r.left + s * (f[0] + 0.5 / 24 * (f[2] - f[0])), r.top + s * (f[3] - 0.5 / 24 * (f[3] - f[1]))]})()"
    )
    browser.call("Input.dispatchMouseEvent", type="mouseMoved", x=box[0], y=box[1])
    place, values = browser.ask("document.getElementById('tip').textContent").replace("\u2212", "-").splitlines()
    x, y = -800.0 + 800.0 / 48, 1000.0 / 48  # the lowest cell of 24 by 24
    assert place == f"X {x:.4g}, Y {y:.4g} mm"
    error = (0.02 * y, 0.01 * x, 5.45)
    numbers = [float(word.rstrip(",:")) for word in values.split() if word[-2:-1].isdigit() or word[-1:].isdigit()]
    assert numbers == pytest.approx([float(np.hypot(np.hypot(*error[:2]), error[2])), *error], rel=0.006)


def test_light_dark_and_the_button_between_them(browser, big):
    browser.open(big)
    light, dark = brightness(browser.picture()), brightness(browser.picture(dark=True))
    assert light > 0.85
    assert dark < 0.3
    browser.picture()
    browser.ask("document.getElementById('theme').click()")
    assert brightness(browser.picture()) < 0.3
    assert (
        browser.ask("getComputedStyle(document.querySelector('#figure-curve-EXX svg text')).fill")
        == "rgb(232, 235, 238)"
    )


@pytest.mark.parametrize("dark", [False, True])
def test_texts_and_lines_stand_out_against_the_page(browser, big, dark):
    """Contrast of WCAG 2: 4.5 for text, 3 for lines of pictures."""
    browser.open(big)
    browser.picture(dark=dark)
    names = {"ink": 4.5, "muted": 4.5, "link": 4.5, "good": 4.5, "warn": 4.5, "bad": 4.5}
    names |= dict.fromkeys(("line", "fit", "table", "before", "after", "c0", "c1", "c2", "c3", "c4", "c5"), 3.0)

    def luminance(name):
        text = browser.ask(f"getComputedStyle(document.documentElement).getPropertyValue('--{name}')").strip()
        parts = np.array([int(text[k : k + 2], 16) / 255 for k in (1, 3, 5)])
        linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    page = luminance("page")
    ratios = {name: (max(page, v) + 0.05) / (min(page, v) + 0.05) for name in names for v in [luminance(name)]}
    assert {name: ratio for name, ratio in ratios.items() if ratio < names[name]} == {}


def test_a_narrow_window_does_not_scroll_sideways(browser, big):
    browser.open(big)
    browser.picture(width=360, height=700)
    assert browser.ask("document.documentElement.scrollWidth") <= 360
    browser.picture()


def test_it_prints_every_section_on_white(browser, small):
    browser.open(small)
    shown = brightness(browser.picture(dark=True, media="print"))
    assert shown > 0.85
    assert browser.ask("getComputedStyle(document.querySelector('nav')).display") == "none"
    import base64

    pdf = base64.b64decode(browser.call("Page.printToPDF", printBackground=False)["data"])
    assert pdf.startswith(b"%PDF")
    assert pdf.count(b"/Type /Page\n") + pdf.count(b"/Type/Page\n") + pdf.count(b"/Type /Page ") in range(4, 9)
    browser.picture()


def test_the_numbers_are_there_without_a_script(browser, big):
    browser.call("Emulation.setScriptExecutionDisabled", value=True)
    try:
        browser.open(big)
        html = browser.call("DOM.getDocument", depth=0)["root"]["nodeId"]
        text = browser.call("DOM.getOuterHTML", nodeId=html)["outerHTML"]
    finally:
        browser.call("Emulation.setScriptExecutionDisabled", value=False)
    assert 'class="script"' not in text
    for word in ("EXX", "40.0", "0.40", "12.500", "37044"):
        assert word in text


def test_texts_of_the_user_stay_texts(browser, tmp_path):
    folder = big_folder(tmp_path / "evil", EVIL, nodes=11, side=5)
    with pytest.warns(Warning, match="is not the file that was verified"):
        write_report(folder)
    events = browser.open(folder / "report.html")
    assert problems(events) == []
    assert fetched(events) == []
    assert browser.ask("window.hacked === undefined")
    assert browser.ask("document.querySelectorAll('script').length") == 2
    assert (
        browser.ask("document.querySelectorAll('img, iframe, object, [onerror], [onload], a[href^=javascript]').length")
        == 0
    )
    assert browser.ask("document.querySelector('h1').textContent") == EVIL
    assert browser.ask("document.body.innerText.includes('{{7*7}}') && !document.body.innerText.includes('}49')")
    assert browser.ask("document.documentElement.dataset.ready") == "1"
    assert browser.ask("document.querySelector('#tables pre').textContent").startswith("</pre></script>")


def test_all_names_of_errors_are_known_to_the_page():
    assert all(error_named(name).unit in ("um", "urad") for name in (*CURVE_NAMES, *SQUARENESS_NAMES))
