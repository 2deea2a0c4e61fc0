"""The workbench in a real browser: the whole job, questions, stop, reopen, two windows, the end; accessibility by axe."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("websocket", reason="websocket-client is not installed: the workbench is not opened in a browser")
pytest.importorskip("flask", reason="the extra compgen[serve] is not installed: the workbench is not tested")
pytest.importorskip("waitress", reason="the extra compgen[serve] is not installed: the workbench is not tested")

import app_site
import browser as helper

from compgen.data.machine import load_machine

pytestmark = pytest.mark.skipif(
    helper.program() is None,
    reason="chromium is not installed (.ci/system-packages): the workbench is not opened in it",
)
ROOT = Path(__file__).resolve().parents[2]
IMPORTS = ROOT / "tests" / "golden" / "imports"
AXE = (Path(__file__).parent / "axe-core" / "axe.min.js").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    running = helper.Browser(tmp_path_factory.mktemp("browser"))
    yield running
    running.close()


@pytest.fixture
def site(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    made = app_site.Served(tmp_path / "project")
    yield made
    made.close()


@pytest.fixture
def page(browser, site):
    browser.call("Network.clearBrowserCookies")
    found = app_site.Page(browser, site.url)
    found.visit(site.start)
    return found


def complaints(browser, url):
    """What the browser complains about, and what it asked others for."""
    found = [
        str(e["params"]) for e in browser.events if e.get("method") in ("Log.entryAdded", "Runtime.exceptionThrown")
    ]
    asked = [e["params"]["request"]["url"] for e in browser.events if e.get("method") == "Network.requestWillBeSent"]
    return found + [address for address in asked if not address.startswith((f"{url}/", "data:"))]


def barriers(browser):
    """What axe finds against WCAG 2.2, levels A and AA, on the present page with all that is folded: rule and element."""
    browser.ask("document.querySelectorAll('details').forEach(e => { e.open = true; })")
    browser.ask(AXE + ";undefined")
    found = browser.ask(
        "axe.run(document, {runOnly: ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa', 'wcag22aa']}).then(result => "
        "result.violations.flatMap(v => v.nodes.map(n => v.id + ': ' + n.target.join(' ') + ' ' + n.failureSummary)))"
    )
    return found


def describe(page, control="siemens-cec", *, write_chain=True, press=True):
    page.write("#name", "my-mill")
    if write_chain:
        page.write("#chain", "table moves in X and Y, head in Z")
    for letter, low, high in (("X", "0", "400"), ("Y", "0", "400"), ("Z", "-240", "0")):
        page.write(f"[name={letter}-low]", low)
        page.write(f"[name={letter}-high]", high)
    page.choose("#control", control)
    if press:
        page.press("Save the machine")


def test_from_laser_files_to_checked_tables_without_a_command_line(page, site, browser):
    """Every page on the way is looked at by axe, in light and dark, wide and narrow."""
    seen = []

    def look(name):
        assert complaints(browser, site.url) == []
        for dark, width in ((False, 1280), (True, 1280), (False, 1000), (False, 2000)):
            browser.picture(width=width, dark=dark)
            wide = browser.ask(
                "[...document.querySelectorAll('main *')].filter(e => e.getBoundingClientRect().right > innerWidth + 1 &&"
                " e.checkVisibility() && !e.closest('.scroll, pre, .canvas')).map(e => e.outerHTML.slice(0, 100))"
            )
            assert wide == [], (name, width)
            if width == 1280:
                assert barriers(browser) == [], (name, dark)
        browser.picture()
        seen.append(name)

    look("no machine")
    describe(page)
    assert "Table moves in X, on a carriage in Y, on the bed; head moves in Z" in page.text()
    look("machine")
    page.press("Next: the measurement")
    page.files("#files-before", IMPORTS / "linear.rtl", IMPORTS / "ecmc_ISO230.dat")
    page.press("Add")
    assert "does not state X, Y or Z" in page.text()
    look("questions")
    browser.ask("document.querySelector('input[type=radio][value=\"--axis=Y\"]').click()")
    # the other file asks where Y and Z stood, which may stay open: each form has its own button
    page.send('input[type=radio][value="--axis=Y"]')
    browser.ask("document.querySelector('#squareness-EC0Y').closest('details').open = true")
    page.write("#squareness-EC0Y", "25±3")
    page.press("Save the numbers")
    look("measurement")
    page.press("Next: calculate the errors")
    assert "3 errors identified" in page.text()
    look("result")
    page.press("Next: the tables")
    browser.ask("document.querySelector('[name=allow-misfit]').click()")
    page.press("Make and verify")
    assert "2 of 17 errors measured" in page.text()
    look("tables")
    folder = site.project.state().last("run").folder
    assert (site.project.folder / folder / "manifest.json").is_file()
    for path in re.findall(
        r'href="(/projects/1/steps/\d+/(?:view/report.html|preflight.html))"', browser.ask("document.body.innerHTML")
    ):
        page.visit(path)
        assert complaints(browser, site.url) == []
        if "preflight" in path:
            browser.picture(width=390)
            assert browser.ask("document.documentElement.scrollWidth <= 390")
            assert browser.ask("document.querySelectorAll('input[type=checkbox]').length") > 5
            assert barriers(browser) == []
            browser.picture()
    page.visit("/projects/1/project")
    assert "volcomp run 01-machine/my-mill.toml" in page.text()
    look("project")
    page.visit("/projects/1/after")
    page.files("#files-after", IMPORTS / "linear.rtl")
    page.press("Add")
    page.press("Compare")
    assert "not separated" in page.text()
    look("after")
    assert len(seen) == 8


PROGRAM = "G21 G90 G17 G54\nG0 X0 Y0 Z0\nG81 X50. Y50. Z-5. R2. F300\nG80\nG1 X100. F500\nG1 Y50.\nM30\n"


@pytest.mark.parametrize("language", ["en", "de"])
def test_pages_in_both_languages_first_page_errors_and_nc_programs_have_no_barrier(
    browser, tmp_path, monkeypatch, language
):
    """In light and dark, by axe; each page states its language."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    site = app_site.Served(tmp_path / "project", language)
    browser.call("Network.clearBrowserCookies")
    page = app_site.Page(browser, site.url)
    looked = []

    def look(path):
        page.visit(path)
        for dark in (False, True):
            browser.picture(dark=dark)
            assert browser.ask("document.documentElement.lang") == language
            assert barriers(browser) == [], (path, dark)
        looked.append(path)

    def press(place):
        page._then(lambda: browser.ask(f"document.querySelector('form[action$=\"/{place}\"]').requestSubmit()"))
        page.settle()

    try:
        look("/projects/1/machine")  # refused: without a session
        page.visit(site.start)
        look("/")
        page.write("#folder", "/proc/none")
        page._then(lambda: browser.ask("document.querySelector('form.card').requestSubmit()"))
        assert "/proc/none" in page.text()
        assert barriers(browser) == []
        look("/projects/9/machine")
        look("/projects/1/program")
        page.visit("/projects/1/machine")
        describe(page, press=False)
        press("describe")
        page.visit("/projects/1/measurement")
        browser.ask("document.querySelectorAll('details').forEach(e => { e.open = true; })")
        page.write("#scale-X", "100")
        press("numbers")
        page.visit("/projects/1/result")
        press("identify")
        (tmp_path / "part.nc").write_text(PROGRAM)
        page.visit("/projects/1/program")
        page.files("#program", tmp_path / "part.nc")
        page.write("#wcs", "G54=0,0,-100")
        page.choose("#dialect", "fanuc")
        for what in ("part", "correct"):
            page._then(lambda what=what: browser.ask(f"document.querySelector('button[value={what}]').click()"))
            page.settle()
            assert site.project.state().last(what) is not None, page.text()
        page.visit("/projects/1/tables")
        browser.ask("document.querySelector('[name=allow-misfit]').click()")
        press("run")
        page.visit("/projects/1/plan")
        page.write("#circles", "XY:100")
        press("plan/make")
        for name in ("machine", "plan", "measurement", "result", "tables", "program", "after", "project"):
            look(f"/projects/1/{name}")
        for kind, name in (("part", "view/part.html"), ("correct", "preflight.html"), ("run", "preflight.html")):
            page.visit(f"/projects/1/steps/{site.project.state().last(kind).number}/{name}")
            assert barriers(browser) == [], name
        assert len(looked) == 12
    finally:
        browser.picture()
        site.close()


#: Elements of a page that the Tab key reaches, in their order; of radio buttons with one name only one.
REACHED = """(() => {
  const names = new Set();
  return [...document.querySelectorAll('a[href], button, input, select, textarea, summary, [tabindex="0"]')].filter(e => {
    if (!e.checkVisibility() || e.disabled || e.type === 'hidden') return false;
    if (e.type !== 'radio') return true;
    const group = document.querySelectorAll(`input[name="${e.name}"]`), chosen = [...group].find(r => r.checked);
    return chosen ? chosen === e : !names.has(e.name) && names.add(e.name);
  });
})()"""


#: The next Tab begins at the top of the page.
BEGIN = "document.body.tabIndex = -1; document.body.focus(); document.body.removeAttribute('tabindex')"


def test_the_whole_job_is_done_with_the_keyboard(page, site, browser):
    """On each page Tab reaches everything once, in order, visibly, and leads out again; then the button is pressed by Enter."""

    def walk(button):
        """Go once around the page; then once more to a button, and press it."""
        count = browser.ask(f"(window.reached = {REACHED}).length")
        browser.ask(BEGIN)
        page.key("Tab")
        assert browser.ask("document.activeElement.className") == "skip"
        for place in range(count):
            found = browser.ask(
                "(e => { const s = getComputedStyle(e), r = e.getBoundingClientRect(); return {place: reached.indexOf(e),"
                " ring: s.outlineStyle !== 'none' && parseFloat(s.outlineWidth) >= 2,"
                " seen: r.bottom > 0 && r.top < innerHeight && r.right > 0, what: e.outerHTML.slice(0, 120)}; })"
                "(document.activeElement)"
            )
            assert (found["place"], found["ring"], found["seen"]) == (place, True, True), (button, found)
            page.key("Tab")
        assert browser.ask("reached.indexOf(document.activeElement)") in (-1, 0)  # out of the page, or begun again
        press(button)

    def press(button):
        browser.ask(BEGIN)
        for _ in range(300):
            page.key("Tab")
            if browser.ask(f"document.activeElement.textContent.trim().startsWith({button!r})"):
                break
        page._then(lambda: page.key("Enter"))
        page.settle()

    def fill(selector, text):
        """Tab to a field and type."""
        for _ in range(300):
            if browser.ask(f"document.activeElement.matches({selector!r})"):
                break
            page.key("Tab")
        browser.call("Input.insertText", text=text)

    page.key("Tab")
    page.key("Enter")  # the link that leads to the content
    assert browser.ask("document.activeElement.id") == "content"
    for selector, text in (("#name", "my-mill"), ("#chain", "WXYFZT"), ("[name=X-low]", "0"), ("[name=X-high]", "400"),
                           ("[name=Y-low]", "0"), ("[name=Y-high]", "400"), ("[name=Z-low]", "-240"),
                           ("[name=Z-high]", "0")):  # fmt: skip
        fill(selector, text)
    for _ in range(300):
        if browser.ask("document.activeElement.id") == "control":
            break
        page.key("Tab")
    until = time.monotonic() + app_site.PATIENCE_S
    while browser.ask("document.activeElement.value") != "siemens-cec":  # down the list
        assert time.monotonic() < until
        page.key("ArrowDown")
    walk("Save the machine")
    page.visit("/projects/1/measurement")
    page.files("#files-before", IMPORTS / "linear.rtl")
    walk("Add")
    walk("Next: calculate the errors")
    page.visit("/projects/1/tables")
    for _ in range(300):
        page.key("Tab")
        if browser.ask(
            "document.activeElement.matches('summary') && document.activeElement.textContent.startsWith('Tables that')"
        ):
            break
    page.key("Enter")
    for _ in range(300):
        page.key("Tab")
        if browser.ask("document.activeElement.name") == "allow-misfit":
            break
    page.key("Space")
    walk("Make and verify")
    assert site.project.state().last("run").exit_code in (0, 1)
    walk("Project")
    assert browser.ask("location.pathname") == "/projects/1/project"
    walk("Undo the last step")
    assert site.project.state().last("run") is None


def test_nothing_moves_for_who_asked_for_that(page, browser):
    still = [{"name": "prefers-reduced-motion", "value": "reduce"}]
    browser.call("Emulation.setEmulatedMedia", media="", features=still)
    browser.ask("document.getElementById('job').hidden = false")
    assert browser.ask("getComputedStyle(document.querySelector('progress')).display") == "none"
    assert browser.ask("getComputedStyle(document.getElementById('job-title')).display") != "none"
    assert browser.ask("document.getAnimations().length") == 0
    browser.call("Emulation.setEmulatedMedia", media="", features=[])
    assert browser.ask("getComputedStyle(document.querySelector('progress')).display") != "none"


def test_the_drawing_follows_the_words_while_they_are_typed(page, browser):
    shown = {}
    for words in ("table moves in X and Y, head in Z", "Portal in Y, Kopf in X und Z", "WZXYFT"):
        page.write("#chain", words)
        until = time.monotonic() + app_site.PATIENCE_S
        while (drawn := browser.ask("document.querySelector('#drawing svg')?.outerHTML")) in (None, *shown.values()):
            assert time.monotonic() < until
            time.sleep(0.05)
        shown[words] = drawn
    assert "table does not move" in shown["Portal in Y, Kopf in X und Z"]
    assert "WZXYFT" in browser.ask("document.getElementById('meaning').textContent")


def test_words_with_two_meanings_are_a_question_on_the_page(page, browser, site):
    """Which carriage is below: the second one is chosen, and its drawing differs."""
    page.write("#chain", "table moves in X and Y, head in Z")
    until = time.monotonic() + app_site.PATIENCE_S
    while browser.ask("document.querySelectorAll('[name=fit]').length") != 2:
        assert time.monotonic() < until
        time.sleep(0.05)
    first = browser.ask("document.querySelector('#drawing svg').outerHTML")
    browser.ask("document.querySelector('[name=fit][value=WYXFZT]').click()")
    while browser.ask("document.querySelector('#drawing svg').outerHTML") == first:
        assert time.monotonic() < until
        time.sleep(0.05)
    describe(page, write_chain=False)
    machine = load_machine(str(site.project.folder / site.project.state().machine))
    assert machine.chain.name == "WYXFZT"


def test_what_was_typed_is_still_there_after_a_refusal(page, site):
    """By the form itself, and by the command that it starts; what is corrected is then taken."""

    def typed():
        return page.browser.ask(
            "[...document.querySelectorAll('#describe input:not([type=hidden])')].map(e => e.value)"
        )

    for letter, low, high in (("X", "0", "400"), ("Y", "0", "400"), ("Z", "-240", "zero")):
        page.write(f"[name={letter}-low]", low)
        page.write(f"[name={letter}-high]", high)
    page.write("#name", "my-mill")
    page.write("#chain", "WXYFZT")
    page.choose("#control", "siemens-cec")
    page.press("Save the machine")
    assert "'zero' is not a length in mm" in page.text()
    assert typed()[:8] == ["my-mill", "WXYFZT", "0", "400", "0", "400", "-240", "zero"]
    page.write("[name=Z-high]", "-300")
    page.press("Save the machine")
    assert "writing the machine file" in page.text()
    assert typed()[:8] == ["my-mill", "WXYFZT", "0", "400", "0", "400", "-240", "-300"]
    page.write("[name=Z-high]", "0")
    page.press("Save the machine")
    assert "my-mill" in page.text()
    assert list(load_machine(str(site.project.folder / site.project.state().machine)).controllers) == ["siemens-cec"]


def test_files_that_are_too_large_are_not_sent(page, site, browser, tmp_path):
    """600 MB: the page says the limit before anything is sent; a smaller file is then taken."""
    describe(page)
    page.visit("/projects/1/measurement")
    with (tmp_path / "huge.csv").open("wb") as file:
        file.truncate(600_000_000)  # without taking up the disk
    page.files("#files-before", tmp_path / "huge.csv")
    browser.events.clear()
    browser.ask("[...document.querySelectorAll('.drop button')].find(e => e.textContent === 'Add').click()")
    assert "These files have 600 MB; at most 200 MB are taken at once." in page.text()
    assert not [e for e in browser.events if e["params"].get("request", {}).get("url", "").endswith("/measurement/add")]
    page.files("#files-before", IMPORTS / "linear.rtl")
    page.press("Add")
    assert [item.name for item in site.project.state().measurements] == ["linear.rtl"]


def test_back_and_reload_after_a_step_show_the_present_state(page, site, browser):
    """The page before is asked for again, and a reload repeats no step."""
    describe(page)
    page.press("Next: the measurement")
    page.files("#files-before", IMPORTS / "linear.rtl")
    page.press("Add")
    page.press("Next: calculate the errors")
    steps = site.project.state().steps
    for move in ("history.back()", "history.back()", "location.reload()", "history.forward()", "location.reload()"):
        page._then(lambda move=move: browser.ask(f"setTimeout(() => {move}, 0)"))
        page.settle()
        shown = browser.ask("document.body.dataset.revision")
        assert shown == str(site.project.state().revision), move
    assert site.project.state().steps == steps


def test_a_refused_file_is_explained_where_it_was_dropped(page, browser, tmp_path):
    describe(page)
    (tmp_path / "bad.axis.csv").write_text("axis,position_mm,direction,run,deviation_um\nX,0,1,1,ten\n")
    page.visit("/projects/1/measurement")
    page.files("#files-before", tmp_path / "bad.axis.csv")
    page.press("Add")
    assert "bad.axis.csv:2: column deviation_um: 'ten' is not a number" in page.text()
    assert browser.ask("document.querySelectorAll('article').length") == 0


def test_a_diagnosis_shows_its_progress_and_can_be_stopped(page, site, browser):
    page.press("Choose")
    browser.ask("document.querySelector('#shipped').value = 'zha-gantry'")
    page.press("Choose")
    page.visit("/projects/1/measurement")
    page.files("#files-before", ROOT / "examples" / "zha-gantry.lengths.csv")
    page.press("Add")
    page.visit("/projects/1/result")
    page.press("Calculate")
    assert "17 errors identified" in page.text()
    steps = site.project.state().steps
    page._then(
        lambda: browser.ask("[...document.querySelectorAll('button')].find(e => e.textContent === 'Diagnose').click()")
    )
    lines = set()
    until = time.monotonic() + app_site.PATIENCE_S
    while not any("candidate" in line or "noise" in line for line in lines):
        assert time.monotonic() < until, lines
        lines.add(browser.ask("document.getElementById('job-line')?.textContent ?? ''"))
        time.sleep(0.1)
    page.press("Stop")
    assert "Stopped: looking for missing effects" in page.text()
    assert site.project.state().steps == steps
    assert "17 errors identified" in page.text()


def test_of_two_windows_on_one_project_the_second_is_told(page, site, browser, tmp_path):
    """Another window, of another program on the same folder, changes something; this one does not overwrite it."""
    describe(page)
    revision = site.project.state().revision
    other = app_site.Site(site.project.folder)
    other.do("measurement/add", {"files": [((IMPORTS / "linear.rtl").open("rb"), "linear.rtl")]})
    submit = "document.querySelector('form[action$=choose] button').closest('form').requestSubmit()"
    page._then(lambda: browser.ask(submit))
    until = time.monotonic() + app_site.PATIENCE_S
    while "changed in another window" not in page.text():
        assert time.monotonic() < until
        time.sleep(0.1)
    state = site.project.state()
    assert state.revision == revision + 1
    assert [step.kind for step in state.steps] == ["machine", "measurement"]
    assert state.machine.endswith("my-mill.toml")


def test_the_program_is_stopped_and_opened_again_and_ends_with_its_last_page(browser, tmp_path, monkeypatch):
    """The command itself: its address, killed without warning, opened again, and closed by closing the page."""

    def start():
        command = [sys.executable, "-m", "compgen", "app", str(tmp_path / "project"), "--no-browser"]
        variables = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache"), "PYTHONUNBUFFERED": "1"}
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=variables)
        address = re.search(r"http://127\.0\.0\.1:\d+/start\?token=\S+", process.stdout.readline())[0]
        return process, address

    first, address = start()
    try:
        page = app_site.Page(browser, address.partition("/start")[0])
        page.visit(address)
        describe(page)
        shown = page.text()
    finally:
        first.kill()
        first.communicate()
    second, address = start()
    try:
        page = app_site.Page(browser, address.partition("/start")[0])
        page.visit(address)
        page.visit("/projects/1/machine")
        assert "my-mill" in page.text()
        assert page.text().split("Controls")[0] == shown.split("Controls")[0]
        page.visit("about:blank")
        second.communicate(timeout=app_site.PATIENCE_S)
        assert second.returncode == 0
    finally:
        if second.poll() is None:
            second.send_signal(signal.SIGKILL)
            second.communicate()
