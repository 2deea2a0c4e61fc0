"""The seven everyday jobs in the workbench, in a real browser: clicks, typed characters, questions, seconds, how each ended.

Every job begins with an empty folder and ends with the tables in an archive that was opened: the machine is described, the
files are dropped, questions are answered, the errors calculated, the tables made and verified, the preflight list ticked and the
archive saved. All of it is done with the mouse and the keyboard of Chromium; the seconds are those of waiting for the next
page, without the time to read, and those of the commands. The measurements are simulated on a machine with known errors:

    python benchmarks/app_everyday.py [--pictures FOLDER]     # a picture of every page on the way, 1280 px wide
"""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
import tempfile
import time
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import app_site  # noqa: E402  # the workbench on a port, from the tests
import browser  # noqa: E402  # Chromium over its DevTools protocol, from the tests

#: The form of the machine: what is written into which field.
MACHINE = {
    "Name": "mill", "What moves what": "table moves in X and Y, head in Z", "X from": "0", "X to": "600", "Y from": "0",
    "Y to": "400", "Z from": "-300", "Z to": "0", "reference point X": "300", "reference point Y": "200",
}  # fmt: skip
CONTROL = "siemens-cec"
#: Errors of the machine: positioning with a slope, straightness and rotations as one bow over the travel, and squareness, um and
#: urad. A bow has no slope in the middle, so the squareness within a small circle there is that of the whole axes.
SQUARENESS = {"EC0Y": 25.0, "EB0Z": -40.0, "EA0Z": 30.0}
TRAVEL = {"X": (0.0, 600.0), "Y": (0.0, 400.0), "Z": (-300.0, 0.0)}
ZERO_MM = {"X": 300.0, "Y": 200.0, "Z": 0.0}
SLOPES = {"EXX": -30.0, "EYY": 20.0, "EZZ": 35.0}
BOWS = {"EYX": 4.0, "EZX": -3.0, "EXY": 5.0, "EZY": 3.0, "EXZ": -4.0, "EYZ": 2.0}
TURNS = {"EAX": 8.0, "EBX": -6.0, "ECX": 7.0, "EAY": -8.0, "EBY": 5.0}


def truth() -> str:
    """Return the section ``[errors]`` of a scenario."""
    lines = ["[errors]", "random = false"]
    lines += ["[errors.squareness_urad]", *(f"{name} = {value}" for name, value in SQUARENESS.items())]
    for name, size in (SLOPES | BOWS | TURNS).items():
        low, high = TRAVEL[name[2]]
        at = np.linspace(low, high, 9)
        share = (at - low) / (high - low)
        value = 1e-3 * size * (at - ZERO_MM[name[2]]) if name in SLOPES else 4.0 * size * share * (1.0 - share)
        unit = "urad" if name in TURNS else "um"
        lines += ["[[errors.curve]]", f'name = "{name}"', f"position_mm = {at.tolist()}"]
        lines += [f"value_{unit} = {value.tolist()}"]
    return "\n".join(lines) + "\n"


LASER = '[instrument]\ntype = "axis-laser"\nnoise_um = 0.2\n'
BALLBAR = '[instrument]\ntype = "ballbar"\nruns = 2\nnoise_um = 0.1\n'
PLATE = (
    '[instrument]\ntype = "touch-probe"\ncalibrated = false\nform_um = 5\ncolumns = 7\nrows = 7\ncomponents = "xy"\n'
    "noise_um = 0.3\n"
    + "".join(
        f"[[instrument.poses]]\norigin_mm = [{x}, {y}, -250]\nrotation_deg = [0, 0, {turn}]\n"
        for x, y, turn in ((300, 200, 0), (300, 200, 90), (300, 200, 180), (350, 200, 0))
    )
)
SQUARE = "axes;squareness [um/m];U (k=2) [um/m]\nX-Y;25;6\n"


def simulated(folder: Path, machine: Path, name: str, text: str) -> Path:
    """Return the file of a simulated measurement."""
    scenario = folder / f"{name}.toml"
    scenario.write_text(f'name = "{name}"\nseed = 4\n{truth()}{text}')
    words = ["simulate", str(machine), "--scenario", str(scenario), "--out", str(folder / name)]
    subprocess.run([sys.executable, "-m", "compgen", *words], check=True, capture_output=True)
    return next(path for path in (folder / name).glob("*.csv") if "truth" not in path.name)


def tables_of(folder: Path, runs: Path) -> list[Path]:
    """Return axis runs as tables with decimal commas, one for each axis."""
    lines = [line.split(",") for line in runs.read_text().splitlines() if line and line[0] in "aXYZ"]
    found = []
    for letter in "XYZ":
        rows = [dict(zip(lines[0], line, strict=True)) for line in lines[1:] if line[0] == letter]
        table = [f"{row['position_mm']};{row['deviation_um']};{row['direction']};{row['run']}" for row in rows]
        found.append(folder / f"{letter}.csv")
        head = "target mm;deviation um;direction;run"
        found[-1].write_text("\n".join([f"axis;{letter}", head, *table]).replace(".", ",") + "\n")
    return found


def part(folder: Path, name: str, share: float) -> Path:
    """Return a part with drilled holes, measured on a CMM: nominal and measured coordinates, turned on its table.

    Scale and squareness of the machine are ``share`` of 40 um/m, 100 urad and -30 um/m. The coordinate measuring machine and the
    form of the holes scatter by 1 um.
    """
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(20, 580, 120), rng.uniform(20, 380, 120)])
    x, y = points.T
    made = points + 1e-6 * share * np.column_stack([40 * (x - 300) - 100 * (y - 200), -30 * (y - 200)])
    made += rng.normal(0.0, 1e-3, made.shape)
    c, s = np.cos(0.2), np.sin(0.2)
    measured = made @ np.array([[c, s], [-s, c]]) + [12.0, -7.0]
    path = folder / f"{name}.part.csv"
    rows = [
        f"H{k},{a:.4f},{b:.4f},0,{p:.6f},{q:.6f}"
        for k, ((a, b), (p, q)) in enumerate(zip(points, measured, strict=True))
    ]
    path.write_text("\n".join(["# origin_mm = 0, 0, 0", "feature,x_mm,y_mm,z_mm,mx_mm,my_mm", *rows]) + "\n")
    return path


# A person: what is on the page is found by its words.

NAMED = """(text => {
  const words = e => e.textContent.trim().replace(/\\s+/g, ' ');
  const shown = [...document.querySelectorAll('button, a, summary, label')].filter(e => e.checkVisibility());
  return shown.find(e => words(e) === text) || shown.find(e => words(e).startsWith(text));
})"""
FIELD = """(text => {
  const label = [...document.querySelectorAll('label')].find(e => e.checkVisibility() && e.textContent.trim().startsWith(text));
  return label?.control ?? document.querySelector(`[aria-label^="${text}"]`);
})"""


@dataclass
class Effort:
    """What a job cost: clicks, drops, typed characters, answered questions, seconds of waiting."""

    clicks: int = 0
    drops: int = 0
    typed: int = 0
    questions: int = 0
    waited_s: float = 0.0


@dataclass
class Person:
    """Does a job with mouse and keyboard; ``pictures`` is the folder for pictures of the pages, None for none."""

    page: app_site.Page
    saved: Path
    pictures: Path | None
    effort: Effort = field(default_factory=Effort)

    def __post_init__(self) -> None:
        """Let the browser save what is downloaded."""
        self.saved.mkdir(parents=True)
        options = {"behavior": "allow", "downloadPath": str(self.saved)}
        self.page.browser.call("Browser.setDownloadBehavior", **options)
        size = {"width": 1280, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        self.page.browser.call("Emulation.setDeviceMetricsOverride", **size)

    def _place(self, element: str) -> dict[str, float]:
        box = self.page.browser.ask(
            f"(e => {{ e?.scrollIntoView({{block: 'center', behavior: 'instant'}}); const b = e?.getClientRects()[0];"
            f" return b && {{x: b.left + b.width / 2, y: b.top + b.height / 2}}; }})({element})"
        )
        assert box, f"not on the page: {element[-60:]}\n{self.page.text().partition('Make and verify')[2]}"
        found: dict[str, float] = box
        return found

    def click(self, element: str) -> None:
        """Press the mouse on an element."""
        at = self._place(element)
        for kind in ("mousePressed", "mouseReleased"):
            self.page.browser.call("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, **at)
        self.effort.clicks += 1

    def press(self, text: str) -> None:
        """Press what begins with these words; the page stays."""
        self.click(f"{NAMED}({json.dumps(text)})")

    def go(self, text: str, name: str = "") -> None:
        """Press what begins with these words, and wait for the next page and its result."""
        self._wait(lambda: self.press(text))
        self.look(name)

    def _wait(self, action: Any) -> None:
        began = time.perf_counter()
        self.page.browser.next_page(action)
        self.page.settle()
        self.effort.waited_s += time.perf_counter() - began

    def write(self, label: str, text: str) -> None:
        """Click into a field and type."""
        self.click(f"{FIELD}({json.dumps(label)})")
        self.page.browser.call("Input.insertText", text=text)
        self.effort.typed += len(text)

    def pick(self, label: str, start: str) -> None:
        """Choose the entry of a list that begins with these words: one click opens it, one takes it."""
        list_of = f"{FIELD}({json.dumps(label)})"
        self.click(list_of)
        self.page.browser.call("Input.dispatchKeyEvent", type="keyDown", key="Escape", windowsVirtualKeyCode=27)
        chosen = f"[...e.options].find(o => o.text.startsWith({json.dumps(start)})).value"
        self.page.browser.ask(f"(e => {{ e.value = {chosen}; e.dispatchEvent(new Event('change')); }})({list_of})")
        self.effort.clicks += 1

    def drop(self, files: list[Path]) -> None:
        """Drag files from the desktop onto the page."""
        at = self._place("document.querySelector('[data-drop]')")
        data = {"items": [], "files": [str(path) for path in files], "dragOperationsMask": 1}

        def let_go() -> None:
            for kind in ("dragEnter", "dragOver", "drop"):
                self.page.browser.call("Input.dispatchDragEvent", type=kind, data=data, **at)

        self._wait(let_go)
        self.effort.drops += 1
        self.look("measurement")

    def save(self, text: str) -> Path:
        """Press a link that saves a file, and return the file."""
        known = set(self.saved.iterdir())
        began = time.perf_counter()
        self.press(text)
        while not (new := [path for path in set(self.saved.iterdir()) - known if path.suffix != ".crdownload"]):
            assert time.perf_counter() - began < app_site.PATIENCE_S, f"nothing was saved by {text!r}"
            time.sleep(0.02)
        self.effort.waited_s += time.perf_counter() - began
        return new[0]

    def look(self, name: str) -> None:
        """Take a picture of the whole page."""
        if self.pictures is not None and name:
            self.pictures.mkdir(parents=True, exist_ok=True)
            ask = self.page.browser.ask
            whole = {"x": 0, "y": 0, "width": 1280, "height": ask("document.documentElement.scrollHeight"), "scale": 1}
            number = len(list(self.pictures.iterdir())) + 1
            taken = self.page.browser.call("Page.captureScreenshot", captureBeyondViewport=True, clip=whole)["data"]
            (self.pictures / f"{number}-{name}.png").write_bytes(base64.b64decode(taken))


def job(site: app_site.Served, person: Person, files: list[Path], numbers: dict[str, str]) -> dict[str, Any]:
    """Do one job from the empty project to the opened archive; return the result of its tables."""
    page = person.page
    for label, text in MACHINE.items():
        person.write(label, text)
    person.pick("Control", CONTROL)
    person.look("describe")
    person.go("Save the machine", "machine")
    person.go("Next: the measurement")
    person.drop(files)
    # a choice in each question: the sign of a square is the only one that these files leave open
    while page.browser.ask("document.querySelectorAll('.questions').length"):
        person.press("positive: the angle between the positive axes is above 90°")
        person.effort.questions += 1
        person.go("Read it with these answers", "answered")
    if numbers:
        person.press("Squareness, lost motion or scale")
        for name, text in numbers.items():
            person.write(name, text)
        person.go("Save the numbers", "numbers")
    person.go("Next: calculate the errors", "result")
    person.go("Next: the tables")
    person.go("Make and verify", "tables")
    if "What it means, and what to do" in page.text():
        person.press("I know why")
        person.effort.questions += 1
        person.go("Make and verify again", "accepted")
    list_of = page.browser.ask(f"{NAMED}('Preflight to tick').href")
    archive = person.save("Tables, manifest and report")
    person.effort.clicks += 1  # the list opens in a window of its own
    page.visit(list_of)
    for k in range(page.browser.ask("document.querySelectorAll('input[type=checkbox]').length")):
        person.click(f"document.querySelectorAll('input[type=checkbox]')[{k}]")
    assert page.browser.ask("[...document.querySelectorAll('input[type=checkbox]')].every(e => e.checked)")
    person.look("preflight")
    step = site.project.state().last("run")
    assert step is not None
    packed = zipfile.ZipFile(archive)
    assert packed.testzip() is None
    names = {name.removeprefix(f"{step.folder}/") for name in packed.namelist()}
    assert {"manifest.json", "preflight.html", "report.html"} <= names
    result: dict[str, Any] = json.loads(packed.read(f"{step.folder}/result.json"))
    assert {file["name"] for file in result["files"]} <= names
    return result


def main() -> None:
    """Do the jobs and print a table."""
    pictures = Path(sys.argv[sys.argv.index("--pictures") + 1]) if "--pictures" in sys.argv else None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
        words = ["init", "mill", "--chain=WXYFZT", "--travel=X=0..600", "--travel=Y=0..400", "--travel=Z=-300..0"]
        command = [sys.executable, "-m", "compgen", *words, f"--out={folder}"]
        subprocess.run(command, check=True, capture_output=True)
        machine = folder / "mill.toml"
        text = machine.read_text()
        start = next(line for line in text.splitlines() if line.startswith("reference_point_mm"))
        machine.write_text(text.replace(start, "reference_point_mm = [300.0, 200.0, 0.0]"))
        laser, bar = simulated(folder, machine, "laser", LASER), simulated(folder, machine, "bar", BALLBAR)
        plate = simulated(folder, machine, "plate", PLATE)
        square = folder / "square.csv"
        square.write_text(SQUARE)
        jobs: dict[str, tuple[list[Path], dict[str, str]]] = {
            "pitch only": ([laser], {}),
            "pitch and a number for squareness": ([laser], {"EC0Y": "25±3"}),
            "ballbar only": ([bar], {}),
            "plate turned three times": ([plate], {}),
            "laser tables of three axes and a square": ([*tables_of(folder, laser), square], {}),
            "CMM of a test part": ([part(folder, "holes", 1.0)], {}),
            "CMM of a part of a better machine": ([part(folder, "fine", 0.2)], {}),
            "everything together": ([laser, bar, plate], {"EA0Z": "32±3"}),
        }
        running = browser.Browser(folder)
        print(f"{'':<40} clicks drops typed questions  waiting commands  verdict")
        for number, (title, (files, numbers)) in enumerate(jobs.items()):
            site = app_site.Served(folder / f"job-{number}")
            try:
                running.call("Network.clearBrowserCookies")
                page = app_site.Page(running, site.url)
                page.visit(site.start)
                seen = None if pictures is None else pictures / str(number + 1)
                person = Person(page, folder / f"saved-{number}", seen)
                result = job(site, person, files, numbers)
                cost, seconds = person.effort, sum(step.seconds for step in site.project.state().steps)
                spent = f"{cost.clicks:6} {cost.drops:5} {cost.typed:5} {cost.questions:9}"
                ended = f"{result['verdict']}: {result['measured']['text']}"
                print(f"{title:<40} {spent} {cost.waited_s:6.1f} s {seconds:6.1f} s  {ended}", flush=True)
            except AssertionError as error:
                print(f"{title:<40} failed: {str(error)[:600]}", flush=True)
            finally:
                site.close()
        running.close()


if __name__ == "__main__":
    main()
