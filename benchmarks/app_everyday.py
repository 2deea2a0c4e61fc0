"""The seven everyday jobs in the workbench, from an empty folder to tables in an archive: seconds, and how each ended.

Every job is done by the forms of the pages, as a person in a browser sends them; the seconds are those of the program, without
the time to read and to type. The measurements are simulated on a machine with known errors:

    python benchmarks/app_everyday.py
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import app_site  # noqa: E402  # the forms of the pages, from the tests

MACHINE = {
    "name": "mill", "chain": "WXYFZT", "X-low": "0", "X-high": "600", "Y-low": "0", "Y-high": "400", "Z-low": "-300",
    "Z-high": "0",
    "reference_point_mm-X": "300", "reference_point_mm-Y": "200", "control": "siemens-cec",
}  # fmt: skip
TRUTH = """
[errors]
linear_peak_um = [4, 12]
angular_peak_urad = [5, 15]
"""
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
    scenario.write_text(f'name = "{name}"\nseed = 4\n{TRUTH}{text}')
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


def part(folder: Path) -> Path:
    """Return a part with drilled holes, measured on a CMM: nominal and measured coordinates, turned on the table."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(20, 580, 120), rng.uniform(20, 380, 120)])
    x, y = points.T
    made = points + 1e-3 * np.column_stack([8e-3 * (x - 300) - 20e-3 * (y - 200), -6e-3 * (y - 200)])
    made += rng.normal(0.0, 1e-3, made.shape)
    c, s = np.cos(0.2), np.sin(0.2)
    measured = made @ np.array([[c, s], [-s, c]]) + [12.0, -7.0]
    path = folder / "holes.part.csv"
    rows = [
        f"H{k},{a:.4f},{b:.4f},0,{p:.6f},{q:.6f}"
        for k, ((a, b), (p, q)) in enumerate(zip(points, measured, strict=True))
    ]
    path.write_text("\n".join(["feature,x_mm,y_mm,z_mm,mx_mm,my_mm", *rows]) + "\n")
    return path


def job(folder: Path, files: list[Path], numbers: dict[str, str]) -> tuple[float, dict[str, Any], int]:
    """Do one job by the forms; return the seconds, the result of the tables, and how many questions were answered."""
    began, answered = time.perf_counter(), 0
    site = app_site.Site(folder)
    site.do("machine/describe", MACHINE)
    if files:
        content = [(io.BytesIO(path.read_bytes()), path.name) for path in files]
        state = site.do("measurement/add", {"files": content})
        for item in state.measurements:
            if item.questions:
                answered += 1
                answers = {"axis": f"--axis={item.name[0]}", "sign": "--sign=angle-above-90"}
                page = site.get("/projects/1/measurement").text
                given = {f"answer-{k}": word for k, word in enumerate(answers.values(), 1) if f'"{word}"' in page}
                site.do(f"measurement/{item.number}/answer", given)
    if numbers:
        site.do("numbers", numbers)
    site.do("identify")
    state = site.do("run", {"control": "siemens-cec"})
    step = state.last("run")
    assert step is not None
    packed = zipfile.ZipFile(io.BytesIO(site.get(f"/projects/1/steps/{step.number}/files.zip").data))
    result = json.loads(packed.read(f"{step.folder}/result.json"))
    for name in ("machine", "measurement", "result", "tables", "after", "project"):
        assert site.get(f"/projects/1/{name}").status_code == 200, name
    return time.perf_counter() - began, result, answered


def main() -> None:
    """Do the jobs and print a table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
        site = app_site.Site(folder / "machine")
        machine = site.project.folder / str(site.do("machine/describe", MACHINE).machine)
        laser, bar = simulated(folder, machine, "laser", LASER), simulated(folder, machine, "bar", BALLBAR)
        plate, holes = simulated(folder, machine, "plate", PLATE), part(folder)
        square = folder / "square.csv"
        square.write_text(SQUARE)
        exported = tables_of(folder, laser)
        jobs: dict[str, tuple[list[Path], dict[str, str]]] = {
            "pitch only": ([laser], {}),
            "pitch and a number for squareness": ([laser], {"squareness-EC0Y": "25±3"}),
            "ballbar only": ([bar], {}),
            "plate turned three times": ([plate], {}),
            "laser tables of three axes and a square": ([*exported, square], {}),
            "CMM of a test part": ([holes], {}),
            "everything together": ([laser, bar, plate], {"squareness-EA0Z": "5±3"}),
        }
        for number, (title, (files, numbers)) in enumerate(jobs.items()):
            try:
                seconds, result, answered = job(folder / f"job-{number}", files, numbers)
                told = f"{result['verdict']}: {result['measured']['text']}"
                if "-v" in sys.argv:
                    told += f"\n    {result['headline']}"
                print(f"{title:<42} {seconds:6.1f} s  {answered} questions  {told}", flush=True)
            except AssertionError as error:
                print(f"{title:<42} failed: {str(error)[:600]}", flush=True)


if __name__ == "__main__":
    main()
