"""Public ISO 230-2 measurements against the figures that their reports print (python benchmarks/public_iso230.py FOLDER...).

FOLDERs are checkouts of the repositories that docs/accuracy.md names; nothing of them is part of this project. Each ``.dat``
file is read as the commands read it (compgen.imports), evaluated (compgen.accuracy) and held against the report beside it
that shows the same readings. Reports without their data are evaluated from their own rounded tables with ``--reports``.

B, M and A must agree within half of the last printed digit (from rounded tables: what the rounding can do), else exit code
1. Other figures are explained: these reports take R as the larger of the two directions, and E as the largest mean minus the
LARGER of the two smallest means; their forward is the data's backward; and a straight line was fitted to the readings and
taken out of them before anything was evaluated, which the printed sum of squares proves.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgen.accuracy import PositioningTest, axis_statistics, positioning_test
from compgen.data.axis_runs import AxisRuns
from compgen.errors import CompgenError
from compgen.foreign import ImportOptions, import_file

Array = NDArray[np.float64]
#: Our figures by the names of the reports; the unidirectional ones by their labels "forward" and "backward".
OURS = {"B": "B", "M": "M", "A": "A", "R": "R", "E": "E", "B_avg": "B_mean"}
ONE_WAY = ("R", "E", "A")
MUST_AGREE = ("B", "M", "A")
UM_PER = {"mm": 1e3, "um": 1.0, "m": 1e6, "nm": 1e-3}
_FIGURE = re.compile(
    r"^\s*\**\s*([A-Z](?:_avg|_fwd|_bwd)?)\s*=\s*(-?[0-9.]+(?:e[-+]?\d+)?)\s*\[?(\w*)\]?\s*\**\s*$", re.M
)
_TABLE = re.compile(r"#+ Data (forward|backward) direction(.*?)(?=\n#)", re.S)
_AT_TARGETS = re.compile(r"^(i \|[^\n]*(?:B|R)\(i\) \[[^\n]*)\n((?:[-0-9][^\n]*\n)+)", re.M)
_GEAR = re.compile(r"^\S.*\|\s*Reference[^|]*\|\s*(\S+)\s*\|\s*(\S+)\s*\|[^|]*\|\s*([0-9.eE-]*)", re.M)


@dataclass(frozen=True)
class Report:
    """Printed figures (um) by name, readings (mm) as printed by direction (targets, cycles), and half of the last digit."""

    path: Path
    figures: Mapping[str, float]
    target_mm: Array
    readings_mm: Mapping[str, Array]
    half_um: float
    gear: tuple[str, str, str] | None
    at_targets: Mapping[str, Array]


@dataclass(frozen=True)
class Row:
    """One figure: ours and the printed one (um), and what the difference is."""

    name: str
    ours: float
    printed: float
    remark: str
    agrees: bool


def read_report(path: Path) -> Report | None:
    """Return what a report prints; None for one without figures or readings."""
    text = path.read_text(encoding="utf-8", errors="replace")
    tables = {name: _rows(body) for name, body in _TABLE.findall(text)}
    found = {name: (value, unit or "mm") for name, value, unit in _FIGURE.findall(text)}
    if len(tables) < 2 or not {"B", "M", "A"} <= found.keys() or any(len(rows) < 2 for rows in tables.values()):
        return None
    cells = [cell for rows in tables.values() for row in rows for cell in row[2:]]
    unit = found["B"][1]
    scale = UM_PER[unit]
    digits = max(_decimals(text) for text in [*cells, *(value for value, _ in found.values())])
    numbers = {name: np.array([[float(cell) for cell in row[1:]] for row in rows]) for name, rows in tables.items()}
    gear = _GEAR.search(text)
    return Report(
        path,
        {name: float(value) * scale for name, (value, _) in found.items()},
        numbers["forward"][:, 0] * scale * 1e-3,
        {name: table[:, 1:] * scale * 1e-3 for name, table in numbers.items()},
        0.5 * 10.0**-digits * scale,
        (gear.group(1), gear.group(2), gear.group(3)) if gear else None,
        {name: np.array(values) * scale for name, values in _columns(text).items()},
    )


def _columns(text: str) -> dict[str, list[float]]:
    """Columns of the tables over the targets by the start of their headings: B(i), S_fwd(i) ... R(i)."""
    found: dict[str, list[float]] = {}
    for header, body in _AT_TARGETS.findall(text):
        names = [cell.split()[0] for cell in header.split("|")[1:] if cell.strip()]
        for row in _rows(body):
            for name, cell in zip(names, row[1:], strict=False):
                found.setdefault(name, []).append(float(cell))
    return found


def _rows(body: str) -> list[list[str]]:
    rows = [line.rstrip().rstrip("|").split("|") for line in body.splitlines() if re.match(r"\s*\d+\s*\|", line)]
    return [[cell.strip() for cell in row] for row in rows]


def _decimals(text: str) -> int:
    try:
        return max(0, -int(Decimal(text).as_tuple().exponent))
    except (InvalidOperation, ValueError, TypeError):
        return 0


def evaluated(path: Path) -> tuple[PositioningTest, AxisRuns]:
    """Return figures and readings of a data file, read as the commands read it; CompgenError for one that they refuse."""
    item = import_file(path, ImportOptions(axis="X"))  # the letter does not stand in these files and changes no figure
    item.check_settled()
    assert isinstance(item.data, AxisRuns)
    return positioning_test(axis_statistics(item.data)["X"]), item.data


def readings_of(runs: AxisRuns) -> dict[int, Array]:
    """Readings (targets, cycles) in mm by direction, the targets ascending."""
    found = {}
    for way in (1, -1):
        own = runs.direction == way
        order = np.lexsort((runs.run[own], runs.position_mm[own]))
        actual = (runs.position_mm + runs.deviation_mm)[own][order]
        found[way] = actual.reshape(-1, len(np.unique(runs.run[own])))
    return found


def direction_of_forward(report: Report, runs: AxisRuns) -> int | None:
    """Direction (1, -1) of the data that the report calls forward; None if it is a report of other readings."""
    data, order = readings_of(runs), np.argsort(report.target_mm)
    shown = {name: table[order] for name, table in report.readings_mm.items()}
    for way in (1, -1):
        pairs = ((shown["forward"], data[way]), (shown["backward"], data[-way]))
        if all(a.shape == b.shape and np.max(np.abs(a - b)) <= 1.001e-3 * report.half_um + 1e-12 for a, b in pairs):
            return way
    return None


def compared(found: PositioningTest, report: Report, forward: int, rounded_um: float = 0.0) -> list[Row]:
    """Return one row for each printed figure; ``rounded_um`` is half the last digit of readings that are rounded."""
    ends = {"fwd": "up" if forward > 0 else "down", "bwd": "down" if forward > 0 else "up"}
    names = {**OURS, **{f"{k}_{label}": f"{k}_{end}" for k in ONE_WAY for label, end in ends.items()}}
    rows = []
    for name, key in names.items():
        if name not in report.figures or key not in found.figures:
            continue
        ours, printed = found.figures[key].value, report.figures[name]
        if name == "B_avg":
            ours *= forward
        allowed = report.half_um * 1.001 + rounded_um * _sensitivity(name, found)
        agrees = abs(ours - printed) <= allowed
        remark = "" if agrees else _explained(name, printed, found, allowed)
        rows.append(Row(name, ours, printed, remark, agrees))
    return rows


def at_targets(found: PositioningTest, report: Report, forward: int, rounded_um: float = 0.0) -> str:
    """Count the values at single targets that agree: mean, reversal, both s, all R."""
    ours = {
        "x_avg(i)": found.targets["mean_um"],
        "B(i)": forward * found.targets["B_um"],
        "R(i)": found.targets["R_um"],
    }
    for label, end in (("fwd", "up" if forward > 0 else "down"), ("bwd", "down" if forward > 0 else "up")):
        ours |= {f"S_{label}(i)": found.targets[f"s_{end}_um"], f"R_{label}(i)": found.targets[f"R_{end}_um"]}
    order, count, agree = np.argsort(report.target_mm), 0, 0
    for name, values in ours.items():
        printed = report.at_targets.get(name, np.zeros(0))
        if len(printed) == len(values):
            allowed = report.half_um * 1.001 + rounded_um * _sensitivity("R", found)
            count += len(values)
            agree += int(np.count_nonzero(np.abs(printed[order] - values) <= allowed))
    return f"values at the targets: {agree} of {count} agree"


def _sensitivity(name: str, found: PositioningTest) -> float:
    """How much a figure can change for each unit by which every reading changes."""
    runs = float(np.min(found.statistics.count))
    scatter = math.sqrt(runs / max(runs - 1.0, 1.0))
    return {"R": 4.0 * scatter + 2.0, "A": 2.0 + 4.0 * scatter}.get(name[0], 2.0)


def _explained(name: str, printed: float, found: PositioningTest, allowed: float) -> str:
    """Name the rule that gives the printed figure."""
    value = {key: item.value for key, item in found.figures.items()}
    up, down = found.targets["mean_up_um"], found.targets["mean_down_um"]
    largest = max(up.max(), down.max())
    rules = {
        "R": {"the larger of R up and R down": max(value["R_up"], value["R_down"])},
        "E": {"largest mean minus the larger of both smallest means": largest - max(up.min(), down.min())},
    }
    for text, other in rules.get(name, {}).items():
        if abs(other - printed) <= allowed:
            return f"printed: {text}, {100.0 * (1.0 - printed / value[name]):.1f} % too small"
    single = np.concatenate([found.targets["R_up_um"], found.targets["R_down_um"]])
    if name in ("R_fwd", "R_bwd") and np.min(np.abs(single - printed)) <= allowed:
        return "printed: 4 s of a single target, not the largest"
    return "NOT EXPLAINED"


def removed(report: Report, runs: AxisRuns, rounded_um: float = 0.0) -> str:
    """Say what was taken out of the readings before they were evaluated, and whether that was fitted to them."""
    if report.gear is None or not report.gear[2]:
        return "no gear ratio is printed, or no sum of squares beside it"
    ratio, offset, residual = report.gear
    squares = float(np.sum(runs.deviation_mm**2))
    allowed = 10.0 ** -_decimals(residual) + 2e-3 * rounded_um * math.sqrt(len(runs) * squares)  # last digit, cut off
    text = f"reference reading x {ratio} + {offset} mm"
    if float(residual) == 0.0:
        return f"{text}; the sum of squares is printed as 0"
    if abs(squares - float(residual)) > allowed:
        return f"{text}; our sum of squares {squares:.8f} mm2 is not the printed {residual}: fitted to other readings"
    fit = f"fitted to these readings (sum of squares {squares:.8f}, printed {residual} mm2)"
    return f"{text}, {fit}: the scale error of the axis is not in them"


def pairs_in(folder: Path, reports: bool) -> Iterator[tuple[str, Path | None, list[Report]]]:
    """Yield name, data file (None: evaluate the report itself) and the reports that may belong to it."""
    seen: set[frozenset[bytes]] = set()
    for path in sorted(folder.rglob("*.md" if reports else "*.dat")):
        lines = path.read_bytes().split(b"\n")
        content = frozenset(line.strip() for line in lines if reports or b"_DATA" in line.partition(b"#")[0])
        if not content or content in seen:
            continue
        seen.add(content)
        files = [path] if reports else sorted(path.parent.glob("*.md"))
        known = [item for item in map(read_report, files) if item is not None]
        if known or not reports:
            yield str(path.relative_to(folder)), None if reports else path, known


def data_text(report: Report) -> str:
    """Return the readings of a report as a data file, so that they go through the same door; its forward ascends."""
    lines = [f"UNIT=mm\nPOSITIONS={len(report.target_mm)}\nCYCLES={report.readings_mm['forward'].shape[1]}"]
    for i, target in enumerate(report.target_mm, start=1):
        lines.append(f"TGT_DATA[{i}]={float(target)!r}")
        for label, name in (("FWD", "forward"), ("BWD", "backward")):
            row = report.readings_mm[name][i - 1].tolist()
            lines += [f"REF_DATA_{label}[{i},{j}]={value!r}" for j, value in enumerate(row, start=1)]
    return "\n".join(lines) + "\n"


def checked(data: Path | None, reports: Sequence[Report]) -> tuple[list[Row], list[str]]:
    """Rows of one set and what is said of it; CompgenError for data that the commands refuse."""
    if data is None:
        report = reports[0]
        with tempfile.TemporaryDirectory() as scratch:
            copy = Path(scratch) / "from_report.dat"
            copy.write_text(data_text(report), encoding="utf-8")
            found, runs = evaluated(copy)
        rows, gear = compared(found, report, 1, report.half_um), removed(report, runs, report.half_um)
        said = ["from the rounded readings of the report; its forward taken as positive", gear]
        return rows, [*said, at_targets(found, report, 1, report.half_um)]
    found, runs = evaluated(data)
    for report in reports:
        forward = direction_of_forward(report, runs)
        if forward is not None:
            said = [f"report {report.path.name}", at_targets(found, report, forward), removed(report, runs)]
            if forward < 0:
                said.append(
                    "forward of the report is REF_DATA_BWD of the data: exchanged; the data's labels were followed"
                )
            return compared(found, report, forward), said
    return [], [f"no report shows these readings; ours: {_own(found)}"]


def _own(found: PositioningTest) -> str:
    return ", ".join(f"{key} {found.figures[key].value:.3f}" for key in ("B", "M", "A", "R", "E")) + " um"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print all sets; 1 if B, M or A of one differs beyond the printed digits or nothing was compared."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", metavar="FOLDER", nargs="+", type=Path)
    parser.add_argument(
        "--reports", action="store_true", help="evaluate the rounded readings of reports, not data files"
    )
    given = parser.parse_args(arguments)
    sets: list[list[Row]] = []
    wrong = []
    for folder in given.folders:
        for name, data, reports in pairs_in(folder, given.reports):
            try:
                rows, said = checked(data, reports)
            except CompgenError as error:
                print(f"\n{name}: refused: {error}")
                continue
            print(f"\n{name}")
            print(*(f"  {text}" for text in said), sep="\n")
            for row in rows:
                print(f"  {row.name:6}{row.ours:12.4f}{row.printed:12.4f}{row.ours - row.printed:+10.4f}  {row.remark}")
            sets += [rows] if rows else []
            wrong += [f"{name} {row.name}" for row in rows if row.name in MUST_AGREE and not row.agrees]
    print(
        f"\n{len(sets)} sets compared (ours, printed, difference in um); {_shortfall(sets, 'R')}; {_shortfall(sets, 'E')}"
    )
    print(f"B, M, A differ in: {', '.join(wrong) or 'none'}")
    return 1 if wrong or not sets else 0


def _shortfall(sets: Sequence[Sequence[Row]], name: str) -> str:
    """Say how often and by how much the printed figure is too small."""
    short = [1.0 - row.printed / row.ours for rows in sets for row in rows if row.name == name and not row.agrees]
    return f"{name} printed too small in {len(short)}" + (f", by up to {100.0 * max(short):.1f} %" if short else "")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    sys.exit(main())
