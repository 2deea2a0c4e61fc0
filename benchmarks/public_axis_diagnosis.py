"""Public ISO 230-2 measurements through ``volcomp diagnose`` (python benchmarks/public_axis_diagnosis.py FOLDER...).

FOLDERs are checkouts of the repositories that docs/real-measurements.md names; nothing of them is part of this project.
Each ``.dat`` file is read as the commands read it and diagnosed; reports that print their readings (rounded) are taken
where there is no data file beside them: tables of one target each, ten times up and down, one target after the other; and
logs of a rotary axis (``repeat/*pos``; degrees stand in the place of mm, so that 1 um is 1 mdeg), which have times.
Prints names, grades, sizes, and the figures before and after. Exit code 1: R or A grows somewhere, or a case for which a
result by hand is known misses it by more than 10 %.
"""

from __future__ import annotations

import argparse
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
from public_iso230 import read_report

from compgen.data.axis_runs import AxisRuns
from compgen.data.machine import Machine, load_machine
from compgen.diagnose import DiagnoseOptions, diagnose
from compgen.errors import CompgenError
from compgen.foreign import ImportOptions, import_file

#: Worked by hand with the runs in their order of time: by a part of the file's name; figures before and after.
BY_HAND = {
    "target_y_report_ILD50": {
        "amplitude": 62.0, "cycles": 2.0, "R": (94.3, 25.0), "A": (96.7, 36.0), "B": (18.6, 19.7), "E": (26.5, 28.7),
    },
}  # fmt: skip
TOLERANCE = 0.1
#: Sessions with fewer targets went target by target, not run by run.
FEW_TARGETS = 5
_TARGET = re.compile(r"## Target Position (\S+) Positive and Negative.*?(?=\n## )", re.S)
_PAIR = re.compile(r"^\d+ \| (-?[\d.]+) \| (-?[\d.]+) \|", re.M)
_SCALE = re.compile(r"grep \$\{SSIPV\} \| awk -v CONVFMT=\S+ -v scale=(\S+) -v offset=(\S+)")
_COUNTS = re.compile(r"EL5002-CH1-PosAct\s+(\S+ \S+)\s+(\d+)")
_LOG = re.compile(r"(zero|\d+)_(above|below)_(\d+)")


def sessions(folders: Sequence[Path]) -> Iterator[tuple[Path, AxisRuns, DiagnoseOptions]]:
    """Every session below the folders, once."""
    paths = [path for folder in folders for path in folder.rglob("*") if path.suffix in (".dat", ".md")]
    paths += [path for folder in folders for path in folder.rglob("repeat") if (path / "zeropos").is_dir()]
    seen: set[bytes] = set()
    for path in sorted(paths):
        if path.suffix == ".md" and any(path.parent.glob("*ISO230*.dat")):
            continue
        try:
            runs = runs_of(path)
        except CompgenError as error:
            print(f"{path}\n  {error}")
            continue
        if runs is None or runs.deviation_mm.tobytes() in seen:
            continue
        seen.add(runs.deviation_mm.tobytes())
        by_rows = path.suffix == ".md" and len(np.unique(runs.position_mm)) < FEW_TARGETS
        yield path, runs, DiagnoseOptions(order="rows" if by_rows else "auto")


def runs_of(path: Path) -> AxisRuns | None:
    """Readings of a data file, a report or a folder of logs; None if it is none of these."""
    if path.is_dir():
        return rotary_logs(path)
    if path.suffix == ".dat":
        data = import_file(path, ImportOptions(axis="X")).data  # the letter does not stand in these files
        return data if isinstance(data, AxisRuns) else None
    tables = target_tables(path.read_text(encoding="utf-8", errors="replace"))
    report = None if tables is not None else read_report(path)
    if report is None:
        return tables
    ascending = 1 if report.target_mm[-1] > report.target_mm[0] else -1
    return _as_runs(
        [
            (float(target), way, run, float(actual - target))
            for name, way in (("forward", ascending), ("backward", -ascending))
            for k, target in enumerate(report.target_mm)
            for run, actual in enumerate(report.readings_mm[name][k], start=1)
        ]
    )


def target_tables(text: str) -> AxisRuns | None:
    """Readings of the verification sensor in a repeatability report, rows in the order of time: up, down at each target."""
    rows = []
    for match in _TARGET.finditer(text):
        target, body = float(match.group(1)), match.group(0)
        for run, (up, down) in enumerate(_PAIR.findall(body[body.find("ILD2300 Pos") :]), start=1):
            rows += [(target, 1, run, float(up) - target), (target, -1, run, float(down) - target)]
    return _as_runs(rows) if len({row[0] for row in rows}) > 1 else None


def rotary_logs(folder: Path) -> AxisRuns | None:
    """Readings of the encoder of a rotary axis, with their times; scale and offset from the script beside them."""
    scripts = sorted(folder.parent.rglob("scaledata_back.bash"))
    scale = _SCALE.search(scripts[0].read_text(encoding="utf-8")) if scripts else None
    if scale is None:
        return None
    rows, times = [], []
    for path in sorted(folder.rglob("*.log")):
        name, found = _LOG.fullmatch(path.stem), _COUNTS.search(path.read_text(encoding="utf-8"))
        if name is None or found is None:
            continue
        target = 0.0 if name[1] == "zero" else float(name[1])
        count = float(found[2]) - (2**31 if float(found[2]) > 1e9 else 0)  # the counter runs over below zero
        value = count * float(scale[1]) + float(scale[2]) - target
        rows.append((target, -1 if name[2] == "above" else 1, int(name[3]), value))
        times.append(datetime.fromisoformat(found[1]).timestamp())
    return replace(_as_runs(rows), covariates={"time_s": np.array(times) - min(times)})


def _as_runs(rows: Sequence[tuple[float, int, int, float]]) -> AxisRuns:
    position, way, run, value = (np.array(column) for column in zip(*rows, strict=True))
    return AxisRuns(np.zeros(len(rows), dtype=np.int64), position, way, run, value)


def said(data: dict) -> str:
    """Names with their grades and sizes, and what has no name."""
    found = []
    for item in data["effects"]:
        size = next((f" {p['value']:+.3g} um" for key, p in item["parameters"].items() if key.endswith("_um")), "")
        if item["name"] == "warmup_drift":
            size += f", time constant {item['parameters']['tau']['value']:.3g}"
        others = [other["name"] for other in item["alias_set"] if other["name"] != item["name"]]
        alias = f"; or {', '.join(others)}" if others else ""
        found.append(f"{item['name']}{size} ({item['grade'].replace('_', ' ')}{alias})")
    found += [f"unknown: {item['text']}" for item in data["unknown"]]
    return "; ".join(found) or "nothing"


def check(name: str, data: dict, cycle: int) -> list[str]:
    """What misses the result by hand, and whether R or A grows; ``cycle`` is the number of readings there and back."""
    figures = data["iso_230_2"]["X"]
    wrong = [
        f"{key} grows" for key in ("R", "A") if key in figures and figures[key]["after"] > figures[key]["before"] + 1e-9
    ]
    known = next((value for part, value in BY_HAND.items() if part in name), None)
    if known is None:
        return wrong
    warm = next((item["parameters"] for item in data["effects"] if item["name"] == "warmup_drift"), None)
    if warm is None:
        return [*wrong, "no warm-up"]
    pairs = [
        ("amplitude", abs(warm["c_um"]["value"]), known["amplitude"]),
        ("cycles", warm["tau"]["value"] / cycle, known["cycles"]),
    ]
    for key in ("R", "A", "B", "E"):
        pairs += [(f"{key} before", figures[key]["before"], known[key][0]), (key, figures[key]["after"], known[key][1])]
    wrong += [f"{key}: {ours:.3g}, by hand {hand:.3g}" for key, ours, hand in pairs if abs(ours / hand - 1) > TOLERANCE]
    return wrong


def shown(path: Path, runs: AxisRuns, options: DiagnoseOptions, machine: Machine) -> bool:
    """Print what the diagnosis says about a session; return whether something misses."""
    data = diagnose(machine, runs, options).to_dict()
    wrong = check(path.name, data, 2 * len(np.unique(runs.position_mm)))
    figures = ", ".join(f"{k} {p['before']:.1f} -> {p['after']:.1f}" for k, p in data["iso_230_2"]["X"].items())
    noise = data["noise"]
    print(f"{path}\n  {data['verdict']}: {said(data)}\n  {figures} um")
    print(f"  noise {noise['sigma_um']:.2f} um, correlation of neighbours {noise['correlation_of_neighbours']:.2f}")
    for text in wrong:
        print(f"  MISSES: {text}")
    return bool(wrong)


def main() -> int:
    """Diagnose every session below the folders."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--machine", default="zha-gantry", help="any machine; its travel does not matter here")
    given = parser.parse_args()
    machine = load_machine(given.machine)
    warnings.simplefilter("ignore")
    missed = [shown(path, runs, options, machine) for path, runs, options in sessions(given.folders)]
    print(f"\n{len(missed)} sessions, {sum(missed)} miss")
    return 1 if any(missed) or not missed else 0


if __name__ == "__main__":
    sys.exit(main())
