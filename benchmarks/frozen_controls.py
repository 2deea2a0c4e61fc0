"""What every control does, written down: compare before and after a change of its code, without the command line.

    python benchmarks/frozen_controls.py record DIR [--only TEXT]   # all controls on several machines, one file of text for each
    python benchmarks/frozen_controls.py compare DIR DIR            # prints what differs; exit code 1 if anything does

For each control, machine and set of options: the bytes of its files and of the preflight list, what is read back, what it
then adds (all bits, in and beyond the travel, in each direction of travel), limits and their use, the verdict of ``verify``,
and the refusal of files that were cut, doubled or had a number changed. Nothing here depends on the time or the folder.
"""

import argparse
import hashlib
import json
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import compgen
from compgen.controls import CONTROLLERS
from compgen.controls.shared.base import SourceFile
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import ERROR_NAMES, SQUARENESS_NAMES, error_named
from compgen.errors import InputError
from compgen.tables import ReadTables, verify
from compgen.tables.exporting import export

ROOT = Path(__file__).resolve().parents[1]

#: Ranges, node counts, signs of travel, reference points, tools and units have nothing in common.
MACHINES = {
    "negative": """
name = "negative"
chain = "WFYXZT"
tool_offset_mm = [0.0, 0.0, -80.0]
reference_point_mm = [-50.0, -100.0, -40.0]
axes.X = { range_mm = [-300.0, -20.0], nodes = 5 }
axes.Y = { range_mm = [-420.0, -70.0], nodes = 6 }
axes.Z = { range_mm = [-240.0, 0.0], nodes = 4 }
""",
    "mixed": """
name = "mixed"
chain = "WXYFZT"
tool_offset_mm = [15.0, -25.0, 60.0]
reference_point_mm = [250.0, -150.0, 120.0]
axes.X = { range_mm = [100.0, 700.0], nodes = 7 }
axes.Y = { range_mm = [-450.0, 50.0], nodes = 6 }
axes.Z = { range_mm = [-60.0, 340.0], nodes = 5 }
""",
    "reference-y": """
name = "reference-y"
chain = "WYFXZT"
squareness_reference = "Y"
tool_offset_mm = [-30.0, 40.0, -55.0]
reference_point_mm = [0.0, 200.0, -100.0]
axes.X = { range_mm = [-500.0, 300.0], nodes = 9 }
axes.Y = { range_mm = [0.0, 350.0], nodes = 8 }
axes.Z = { range_mm = [-200.0, 50.0], nodes = 6 }
""",
}

#: Options of a control that change its numbers, text or reading; each is recorded in addition to those of the shipped machine.
OPTIONS: dict[str, list[dict[str, Any]]] = {
    "aerotech": [{"reversed_axes": {"X": True, "Z": True}, "axis_numbers": {"X": 3, "Y": 1, "Z": 2}}],
    "aerotech-2d": [{"reversed_axes": {"Y": True}, "most_points": 5}],
    "centroid": [{"sign": "error", "values": "counts", "counts_per_mm": {"X": 2000.0, "Y": 1000.0, "Z": 4000.0}}],
    "ecmc": [{"version": "9.6.8"}],
    "fagor-8055": [{"sign": "correction", "most_points": 4}],
    "fanuc-3d": [{"magnification": {"X": 60, "Y": 60, "Z": 60}, "stores": "error", "order": "ZYX"}],
    "fanuc-pitch": [
        {"bidirectional": True, "detection_unit_um": 0.5, "stores": "error"},
        {"value_type": "total", "interval_mm": {"X": 25.0}, "interpolation": "staircase"},
    ],
    "fanuc-straightness": [{"stores": "error"}],
    "heidenhain-com": [
        {"generation": "power-of-two", "sign": "correction"},
        {"backlash_column": "absolute", "max_tables": 2, "max_total_points": 20},
        {"backlash_column": "difference", "decimals": 5, "max_points": 6},
    ],
    "kmotion": [{"units": "mm", "most_points": 6}],
    "linuxcnc-comp": [
        {"comp_file_type": 0},
        {"machine_units": "inch", "max_acceleration_mm_s2": [5000.0, 5000.0, 900.0]},
    ],
    "mach4": [{"sign": "error", "both_directions": True, "most_points": 5}],
    "mitsubishi": [{"mode": "absolute", "scale": 2}, {"mode": "incremental", "stores": "error"}],
    "neutral": [{"max_nodes": 5}],
    "pmac": [
        {"counts_per_mm": {"X": -1000.0, "Y": 2000.0, "Z": 500.0}, "two_dimensional": False},
        {"counts_per_mm": 1000.0, "max_entries": 12},
    ],
    "siemens-cec": [{"sign": "correction", "mult_mode": "S3"}, {"sign": "error", "mult_mode": "S2", "max_points": 20}],
    "siemens-cec-eec": [{"sign": "correction", "encoder": {"X": [0, 1], "Y": 0, "Z": 0}}],
    "siemens-eec": [{"encoder": {"X": [0, 1], "Y": 1, "Z": 0}, "step_mm": {"Y": 50.0}}, {"max_points": 5}],
    "smoothieware": [{"most_points": 4}],
    "twincat-lists": [
        {"cross_sign": "error", "ssfk_sign": "correction", "number_type": "REAL64", "own_setpoints": True},
        {"crosscomp2": False, "max_points": {"ssfk": 6, "crosscomp": 4}},
    ],
    "weihong": [{"sign": "correction"}],
}


@cache
def machine_named(name: str) -> Machine:
    """A machine of this script, or a shipped one, with the settings of the shipped gantry."""
    settings = compgen.load_machine("zha-gantry").controllers
    if name not in MACHINES:
        return replace(compgen.load_machine(name), controllers=settings)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.toml"
        path.write_text(MACHINES[name])
        return replace(compgen.load_machine(path), controllers=settings, source=None)


def errors_of(machine: Machine) -> ErrorTable:
    """Smooth errors of a machine: tens of micrometres and microradians, all 21, drawn with a seed."""
    random = np.random.default_rng(23)
    curves, squareness = {}, {}
    for name in ERROR_NAMES:
        size = 8e-3 if error_named(name).kind == "linear" else 1.5e-5
        if name in SQUARENESS_NAMES:
            squareness[name] = (float(random.normal(0.0, 4e-5)), np.nan)
            continue
        axis = machine.axes[error_named(name).axis or 0]
        nodes = np.linspace(*axis.range_mm, 7)
        along = (nodes - nodes[0]) / np.ptp(nodes)
        value = size * (random.normal() * np.sin(np.pi * along * random.uniform(0.5, 2.5)) + random.normal() * along)
        curves[name] = Curve(nodes, value, np.full(len(nodes), np.nan))
    return ErrorTable(curves, squareness)


def reversal_of(machine: Machine) -> ReversalCurves:
    """Reversals of micrometres: X along itself changes along its travel, Y does not, Z moves X as well."""
    nothing = np.full(3, np.nan)
    x, y, z = (np.linspace(*axis.range_mm, 3) for axis in machine.axes)
    return ReversalCurves(
        {
            (0, 0): Curve(x, np.array([4e-3, 7e-3, 5e-3]), nothing),
            (1, 1): Curve(y[1:2], np.array([-6e-3]), nothing[:1]),
            (2, 0): Curve(z, np.array([2e-3, 1e-3, 3e-3]), nothing),
        }
    )


def plain(value: Any) -> Any:
    """Anything as JSON without loss: bits of arrays, fields of dataclasses, numbers as they print."""
    if isinstance(value, np.ndarray):
        return [str(value.dtype), list(value.shape), [repr(item) for item in value.ravel().tolist()]]
    if is_dataclass(value) and not isinstance(value, type):
        return {item.name: plain(getattr(value, item.name)) for item in fields(value) if item.name != "source"}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in sorted(value.items(), key=lambda item: str(item[0]))}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return repr(value).replace(str(ROOT), "<root>") if not isinstance(value, str | int | float | bool) else repr(value)


def points_of(machine: Machine) -> list[Points]:
    """Places inside and outside of the travel, reached upwards, downwards, in mixed directions, and in unknown ones."""
    random = np.random.default_rng(5)
    size = machine.upper_mm - machine.lower_mm
    position = random.uniform(machine.lower_mm - 0.2 * size, machine.upper_mm + 0.2 * size, (60, 3))
    position[:4] = [
        machine.lower_mm,
        machine.upper_mm,
        machine.reference_point_mm,
        0.5 * (machine.lower_mm + machine.upper_mm),
    ]
    mixed = random.integers(-1, 2, (60, 3)).astype(float)
    ones = np.ones_like(position)
    return [Points(position), *(Points(position, approach=way) for way in (ones, -ones, mixed))]


def doings(
    control: Any, machine: Machine, files: Mapping[str, str], *, foreign: bool = False, digits: int = 40
) -> Iterator[tuple[str, Any]]:
    """What a control reads from its files and does with it; a refusal in words."""
    sources = [SourceFile(Path(name), text) for name, text in files.items()]
    read = control.parse_foreign if foreign else control.parse
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            tables = read(sources)
        except InputError as error:
            yield "refused", str(error)
            return
        if foreign:
            if tables is None:
                return
            tables, remarks = tables
            yield "remarks", remarks
        for k, points in enumerate(points_of(machine)):
            yield f"added {k}", plain(np.round(control.emulate(tables, points), digits) + 0.0)
        yield "violations", control.violations(tables)
        yield "usage", plain(control.usage(tables))
        yield "by direction", control.by_direction(tables)
        yield "nodes", plain(control.table_nodes_mm(tables))
        yield "contradictions", control.contradictions(tables, sources)
        yield "reservations", control.reservations(tables)
        yield "other readings", sorted(control.other_readings(tables))
        yield "remarks of the control", control.remarks(tables, sources)
        yield "warnings", [str(item.message) for item in caught]


def spoilt(files: Mapping[str, str], count: int) -> Iterator[tuple[str, dict[str, str]]]:
    """Files cut, with a line left out or twice, or with a digit, a sign, a letter changed: the same ones each time."""
    random = np.random.default_rng(11)
    for k in range(count):
        name = sorted(files)[int(random.integers(len(files)))]
        text, lines = files[name], files[name].split("\n")
        line, place = int(random.integers(len(lines))), int(random.integers(max(1, len(text))))
        kind = k % 6
        if kind == 0:
            new = text[:place]
        elif kind == 1:
            new = "\n".join(lines[:line] + lines[line + 1 :])
        elif kind == 2:
            new = "\n".join(lines[: line + 1] + lines[line:])
        elif kind == 3:
            digits = [i for i, letter in enumerate(text) if letter.isdigit()]
            at = digits[int(random.integers(len(digits)))] if digits else 0
            new = text[:at] + "9" + text[at + 1 :]
        elif kind == 4:
            at = text.find(".", place)
            new = text.replace("-", "", 1) if at < 0 else text[:at] + "," + text[at + 1 :]
        else:
            new = text[:place] + "#x -7"[k % 5] + text[place:]
        yield f"{k} {name}", {**files, name: new}
    for name in files if len(files) > 1 else ():
        yield f"without {name}", {other: text for other, text in files.items() if other != name}


def record_of(case: tuple[str, str, int]) -> list[str]:
    """The lines of one control on one machine with one set of options."""
    name, machine_name, option = case
    machine = machine_named(machine_name)
    if option:
        section = machine.controller_settings(name)
        stated = {**section.data, **OPTIONS[name][option - 1]}
        machine = replace(machine, controllers={**machine.controllers, name: section.again(stated)})
    lines: list[str] = []

    def say(what: str, value: Any) -> None:
        lines.append(f"{what}: {json.dumps(value)}")

    try:
        errors, reversal = errors_of(machine), reversal_of(machine)
        control = CONTROLLERS[name](machine)
        for way in (None, reversal):
            label = "plain" if way is None else "reversal"
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                made = export(machine, errors, name, allow_unverified=True, reversal=way)
            for file, text in made.files.items():
                say(f"{label} file {file}", text)
            say(f"{label} preflight", made.preflight)
            say(
                f"{label} said",
                [list(made.violations), list(made.warnings), plain(made.manifest), plain(made.companions)],
            )
            for foreign in (False, True):
                for what, value in doings(control, machine, made.files, foreign=foreign):
                    say(f"{label} {'foreign ' if foreign else ''}{what}", value)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                sources = [SourceFile(Path(file), text) for file, text in made.files.items()]
                tables = control.parse(sources)
                say(f"{label} context", plain(control.context(tables)))
                if option == 0 and machine_name == "mixed":
                    read = ReadTables(control, tables, ())
                    say(f"{label} verdict", plain(verify(machine, read, errors, reversal=way).summary()))
            larger = replace(
                machine,
                axes=tuple(replace(a, range_mm=(a.range_mm[0] - 50.0, a.range_mm[1] + 70.0)) for a in machine.axes),
            )
            say(f"{label} beyond", CONTROLLERS[name](larger).violations(tables))
            say(f"{label} backlash", control.backlash_parameters(reversal))
            if machine_name == "mixed" or option:
                for what, files in spoilt(made.files, 36):
                    for foreign in (False, True):
                        found = list(doings(control, machine, files, foreign=foreign, digits=9))
                        if found and found[0][0] == "refused":
                            say(f"{label} spoilt {what} {foreign}", found[0][1])
                        else:
                            text = json.dumps(found, default=repr)
                            say(f"{label} spoilt {what} {foreign}", hashlib.sha256(text.encode()).hexdigest())
        say("resolution", repr(control.resolution_mm()))
        say("anchor", plain(control.anchor_mm()))
        say("left out", control.left_out(errors))
    except Exception as error:  # a control that fails is recorded as failing: the comparison shows a change
        place = traceback.extract_tb(error.__traceback__)[-1].name
        say("fails", f"{type(error).__name__}: {error} ({place})" if isinstance(error, InputError) else repr(error))
    return [line.replace(str(ROOT), "<root>") for line in lines]


def cases(only: str) -> list[tuple[str, str, int]]:
    """Control, machine, number of the options (0: as shipped)."""
    names = [name for name in CONTROLLERS if any(part in name for part in only.split(","))]
    plain_ones = [(name, machine, 0) for name in names for machine in (*MACHINES, "zha-gantry")]
    return plain_ones + [(name, "mixed", k + 1) for name in names for k in range(len(OPTIONS.get(name, [])))]


def record(out: Path, only: str) -> None:
    """Write one file for each case."""
    out.mkdir(parents=True, exist_ok=True)
    chosen = cases(only)
    with ProcessPoolExecutor(2) as pool:
        for case, lines in zip(chosen, pool.map(record_of, chosen), strict=True):
            (out / f"{case[0]}-{case[1]}-{case[2]}.txt").write_text("\n".join(lines) + "\n")


#: What a control adds may differ by less than this, mm: the order of a sum or a product changes the last bits.
LAST_BITS_MM = 1e-14


def differing(old: Path, new: Path) -> tuple[list[str], float]:
    """Lines of two recordings that differ, and the largest difference of what is added that counts as last bits, mm."""
    before, after = old.read_text().splitlines(), new.read_text().splitlines()
    shown, largest = [], 0.0
    for one, other in zip(before, after, strict=False):
        if one == other:
            continue
        label, _, text = one.partition(": ")
        if "added" in label and other.startswith(label):
            values = [np.array(json.loads(part)[2], dtype=float) for part in (text, other.partition(": ")[2])]
            apart = float(np.max(np.abs(values[0] - values[1]))) if len(values[0]) == len(values[1]) else np.inf
            if apart < LAST_BITS_MM:
                largest = max(largest, apart)
                continue
        place = next((k for k, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), 0)
        start = max(0, place - 60)
        shown += [f"- {label}: {one[start : place + 90]}", f"+ {other[start : place + 90]}"]
    if len(before) != len(after):
        shown.append(f"{len(before)} lines before, {len(after)} after")
    return shown, largest


def compare(old: Path, new: Path, only: str = "") -> int:
    """Print the first lines that differ in each file, and which are missing; return how many files differ."""
    names = sorted({path.name for top in (old, new) for path in top.glob("*.txt")})
    names = [name for name in names if any(part in name for part in only.split(","))]
    count, largest = 0, 0.0
    for name in names:
        if not ((old / name).exists() and (new / name).exists()):
            print(f"only {'before' if (old / name).exists() else 'after'}: {name}")
            count += 1
            continue
        lines, bits = differing(old / name, new / name)
        largest = max(largest, bits)
        if lines:
            count += 1
            print(f"differs: {name}", *lines[:8], sep="\n")
    print(f"{count} of {len(names)} differ; last bits of what is added: {largest:.1g} mm")
    return count


def main() -> int:
    """Read the arguments, record or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=["record", "compare"])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    if given.action == "record":
        record(given.folders[0].resolve(), given.only)
        return 0
    return int(compare(*given.folders, given.only) > 0)


if __name__ == "__main__":
    sys.exit(main())
