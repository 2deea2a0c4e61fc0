"""ISO 230-2 input files of the ecmc motion tools (``*.dat``): assignments as a shell reads them.

``TGT_DATA[i]=`` targets, ``REF_DATA_FWD[i,j]=`` and ``REF_DATA_BWD[i,j]=`` the reference readings at target i of cycle j,
``UNIT=``, ``CYCLES=``, ``POSITIONS=``. Deviation = reading - target; nothing is removed from it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from compgen.imports.one_axis import OneAxis
from compgen.imports.source import Text, parse_number, read_source, shown

MOST_BYTES = 16_000_000
#: Correlation below which readings are taken to have been fitted; by chance it is a few percent.
FITTED = 1e-4
MM_PER = {"mm": 1.0, "um": 1e-3, "m": 1e3, "nm": 1e-6}
_ASSIGNMENT = re.compile(r"\s{0,20}([A-Za-z_][A-Za-z0-9_]{0,40})(?:\[\s*(\d{1,6})\s*(?:,\s*(\d{1,6})\s*)?\])?\s*=(.*)")
_ARRAYS = {"TGT_DATA": 1, "REF_DATA_FWD": 2, "REF_DATA_BWD": 2}
_SIGN = re.compile(r"^\s*(TGT_DATA|REF_DATA_FWD|REF_DATA_BWD)\[", re.MULTILINE)


@dataclass(frozen=True)
class Ecmc:
    """Readings in mm, the other assignments by name, and what the readings say about slope and direction."""

    runs: OneAxis
    keys: Mapping[str, str]
    slope: float
    offset_mm: float

    @property
    def fitted(self) -> bool:
        """Whether a line from readings to targets was fitted to these very readings and taken out of them.

        Then the deviations have no mean and do not follow the readings (the normal equations of that fit).
        """
        deviation, actual = self.runs.value, self.runs.position_mm + self.runs.value
        sizes = np.linalg.norm(deviation), np.linalg.norm(actual - actual.mean())
        along = abs(float(deviation @ (actual - actual.mean())))
        level = abs(float(deviation.sum())) / np.sqrt(len(deviation))
        return bool(sizes[0] > 0.0 and along <= FITTED * sizes[0] * sizes[1] and level <= FITTED * sizes[0])


@dataclass(frozen=True)
class _Reading:
    way: int
    target: int
    cycle: int
    value: float
    line: int


def is_ecmc(head: str) -> bool:
    """Tell such a file by its first lines."""
    return _SIGN.search(head) is not None


def read_ecmc(path: Path) -> Ecmc:
    """Read an ISO 230-2 input file; InputError with the line for one that is cut or does not fit together."""
    source = read_source(path, most=MOST_BYTES)
    keys: dict[str, str] = {}
    targets: dict[int, tuple[float, int]] = {}
    readings: dict[tuple[str, int, int], _Reading] = {}
    decimals: list[int] = []
    for number, line in enumerate(source.text.split("\n"), start=1):
        content = line.partition("#")[0].strip()
        if content:
            decimals.append(_take(source, number, content, keys, (targets, readings)))
    if not source.ended and len(decimals) > 2 and decimals[-1] < min(decimals[len(keys) : -1], default=0):
        raise source.fail("the last line has no line end and fewer decimals than all others: it was cut")
    _check_complete(source, keys, targets, readings)
    return _assembled(source, keys, targets, list(readings.values()))


def _take(
    source: Text,
    number: int,
    content: str,
    keys: dict[str, str],
    data: tuple[dict[int, tuple[float, int]], dict[tuple[str, int, int], _Reading]],
) -> int:
    """Take one assignment and return the number of its decimals."""
    match = _ASSIGNMENT.fullmatch(content)
    if not match:
        raise source.fail(f"an assignment NAME=value is due, found {shown(content)}; was the file cut?", number)
    name, first, second, text = match.group(1).upper(), match.group(2), match.group(3), match.group(4).strip(" \t\"';")
    if name not in _ARRAYS:
        keys[name] = text
        return 99
    if (first is None) or (second is not None) != (_ARRAYS[name] == 2):
        due = "[target,cycle]" if _ARRAYS[name] == 2 else "[target]"
        raise source.fail(f"{name} takes {due}, found {shown(content)}", number)
    value = parse_number(text)
    if value is None:
        raise source.fail(f"{shown(text)} is not a number; was the file cut?", number, name)
    targets, readings = data
    if name == "TGT_DATA":
        if targets.setdefault(int(first), (value, number)) != (value, number) and targets[int(first)][0] != value:
            raise source.fail(f"target {first} has another value already in line {targets[int(first)][1]}", number)
        return len(text.partition(".")[2])
    key = (name, int(first), int(second))
    if key in readings:
        raise source.fail(f"{name}[{first},{second}] stands already in line {readings[key].line}", number)
    readings[key] = _Reading(1 if name.endswith("FWD") else -1, int(first), int(second), value, number)
    return len(text.partition(".")[2])


def _check_complete(
    source: Text,
    keys: Mapping[str, str],
    targets: Mapping[int, tuple[float, int]],
    readings: Mapping[tuple[str, int, int], _Reading],
) -> None:
    for name, found, what in (
        ("POSITIONS", len(targets), "targets"),
        ("CYCLES", len({item.cycle for item in readings.values()}), "cycles"),
    ):
        declared = parse_number(keys.get(name, ""))
        if declared is not None and declared != found:
            raise source.fail(f"declares {keys[name]} {what} but holds {found}: was it cut?", field=name)
    names = {name for name, _, _ in readings}
    cycles = {item.cycle for item in readings.values()}
    for name in sorted(names):
        missing = [(i, j) for j in sorted(cycles) for i in sorted(targets) if (name, i, j) not in readings]
        if missing:
            raise source.fail(f"{name}[{missing[0][0]},{missing[0][1]}] is missing: was it cut?")
    strange = next((item for item in readings.values() if item.target not in targets), None)
    if strange:
        raise source.fail(f"a reading of target {strange.target}, which has no TGT_DATA", strange.line)
    if len(targets) < 2 or not readings:
        raise source.fail("holds fewer than two targets with readings")


def _assembled(
    source: Text, keys: Mapping[str, str], targets: Mapping[int, tuple[float, int]], readings: list[_Reading]
) -> Ecmc:
    unit = keys.get("UNIT", "mm").lower().replace("\u00b5", "u").replace("\u03bc", "u")
    if unit not in MM_PER:
        raise source.fail(f"UNIT={shown(unit)} is no length; {', '.join(MM_PER)} are read (linear axes)", field="UNIT")
    scale = MM_PER[unit]
    order = [targets[k][0] for k in sorted(targets)]
    steps = np.sign(np.diff(order))
    if not (np.all(steps == steps[0]) and steps[0] != 0):
        raise source.fail("the targets neither ascend nor descend; the directions cannot be told")
    # a cycle goes through the targets in their order (FWD) and back (BWD); the file lists all FWD before all BWD
    readings = sorted(readings, key=lambda item: (item.cycle, -item.way, item.way * item.target))
    position = np.array([targets[item.target][0] for item in readings]) * scale
    actual = np.array([item.value for item in readings]) * scale
    # the direction of FWD is that of the motion, whatever its name says
    way = np.array([item.way for item in readings], dtype=np.int64) * int(steps[0])
    slope, offset = np.polyfit(position, actual, 1).tolist()
    cycle = np.array([item.cycle for item in readings], dtype=np.int64)
    line = np.array([item.line for item in readings], dtype=np.int64)
    return Ecmc(OneAxis(position, way, cycle, actual - position, line, in_time=True), keys, slope, offset)
