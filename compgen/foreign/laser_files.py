"""Files of laser interferometers: Renishaw runs as text, ecmc input files, and dynamic captures in binary form.

Each reader refuses a truncated or inconsistent file, with the line; units and axis are determined by
:mod:`compgen.foreign.detect`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from compgen.data.csv_files import FloatArray, format_csv
from compgen.data.files import read_bytes
from compgen.data.records import HEAD_BYTES
from compgen.errors import InputError
from compgen.foreign.one_axis import IntArray, OneAxis, cycles, motion
from compgen.foreign.source import (
    ENCODINGS_EAST,
    MOST_CAPTURE_BYTES,
    Text,
    check_size,
    parse_number,
    read_source,
    shown,
)

# Renishaw laser files in text form: .rtl (linear, um), .rta (angular, mrad), .rts (straightness, um).
#
# There is no public specification. The layout is the common ground of programs that write and read such files: sections
# ``NAME::``, lines ``key : value``, N targets in free format, rows ``run target deviation``. The parser is tolerant in
# spacing and unknown sections, and strict in numbers: every run must contain every target.


#: Kind of the deviations by the letter of the file type; the file does not state the unit.
UNITS = {"l": "um", "a": "mrad", "s": "um"}
SUFFIXES = {".rtl": "l", ".rta": "a", ".rts": "s"}
REFUSED = {".rtf": "flatness", ".rtp": "squareness", ".rtr": "a rotary axis"}
#: Fifty runs of 10000 targets.
MOST_RENISHAW_BYTES = 16_000_000
MOST_TARGETS, MOST_RUNS = 100_000, 1_000
_SECTION = re.compile(r"\s{0,20}([A-Za-z][A-Za-z0-9 _\-]{0,40})::\s*")
_KEY = re.compile(r"\s{0,40}([A-Za-z][^:]{0,60}?)\s{0,40}:(.*)")
#: Sections about the surroundings and the instrument; their keys are not those of the machine.
INFORMATION = ("ENVIRONMENT", "EQUIPMENT")
#: Keys followed by numbers; a line of user text with the same key begins nothing.
_BLOCKS = ("targets", "run target data")
_SIGNS = ("run target data", "target-count", "run-count")


@dataclass
class _File:
    """The data read so far: values by lower-case key, numbers by section, and how the file ended."""

    keys: dict[str, str] = field(default_factory=dict)
    targets: list[float] = field(default_factory=list)
    rows: list[tuple[int, int, int, float]] = field(default_factory=list)
    information: dict[str, dict[str, str]] = field(default_factory=dict)
    unread: list[str] = field(default_factory=list)
    section: str = ""
    reading: str = ""
    complete: bool = False
    commas: bool = False


@dataclass(frozen=True)
class Renishaw:
    """A text file of the laser software: ``letter`` of its type, axis runs in the file's unit, user text by key.

    ``one_way`` holds the run numbers of the file (n,); ``sorted_rows`` is True if the flags indicate two directions,
    but all runs list their targets in the same order. ``information`` has the keys of ENVIRONMENT and EQUIPMENT,
    ``zero_runs`` the runs that are zero at every target while others are not; ``one_way_test`` is True if the flags
    indicate one direction only.
    """

    letter: str
    runs: OneAxis
    keys: Mapping[str, str]
    encoding: str
    notes: tuple[str, ...]
    one_way: IntArray
    sorted_rows: bool
    information: Mapping[str, Mapping[str, str]]
    zero_runs: tuple[int, ...]
    one_way_test: bool


def is_renishaw_text(head: str) -> bool:
    """Recognise a text file of the laser software by its first lines."""
    low = head.lower()
    return low.lstrip().startswith("header::") or any(f"\n{sign}" in low for sign in _SIGNS)


def read_renishaw(path: Path) -> Renishaw:
    """Read a .rtl, .rta or .rts file; InputError with the line for one that is truncated or inconsistent."""
    if path.suffix.lower() in REFUSED:
        what = REFUSED[path.suffix.lower()]
        raise InputError(f"contains {what}; .rtl, .rta and .rts of linear axes are read", file=path)
    source = read_source(path, ENCODINGS_EAST, MOST_RENISHAW_BYTES)
    found = _File()
    for number, line in enumerate(source.text.split("\n"), start=1):
        _take_line(source, found, number, line)
    _check_end(source, found)
    letter = _letter(source, found)
    targets = np.array(found.targets)
    numbers, run, target = (np.array([row[k] for row in found.rows], dtype=np.int64) for k in range(3))
    position = targets[target - 1]
    direction = motion(position, run)
    alternating = bool(len(np.unique(run)) > 1 and len(np.unique(direction)) == 1)
    value = np.array([row[3] for row in found.rows])
    notes = []
    if found.commas:
        notes.append("decimal commas were read as decimal points")
    if not found.complete:
        notes.append("there is no end mark EOF::; all declared readings are there")
    if source.encoding not in ("utf-8", "utf-8-sig"):
        notes.append(f"is not UTF-8; user text was read as {source.encoding}")
    if found.unread:
        notes.append(f"{len(found.unread)} lines in {' and '.join(INFORMATION)} without a key were not used")
    flags = found.keys.get("flags", "").split()
    runs = OneAxis(position, direction, cycles(direction, run), value, numbers, in_time=bool(np.all(np.diff(run) >= 0)))
    two_ways = flags[:2] == ["0", "0"] and alternating
    numbered = np.unique(run).tolist()
    zero = tuple(number for number in numbered if not value[run == number].any()) if value.any() else ()
    return Renishaw(
        letter,
        runs,
        found.keys,
        source.encoding,
        tuple(notes),
        run,
        two_ways,
        found.information,
        zero,
        flags[1:2] == ["1"],
    )


def _take_line(source: Text, found: _File, number: int, line: str) -> None:
    header = _SECTION.fullmatch(line)
    if header:
        found.section, found.reading = header.group(1).upper(), ""
        found.complete = found.complete or found.section == "EOF"
        return
    if not line.strip():
        return
    key = _KEY.fullmatch(line)
    if found.section in INFORMATION:
        if key is None:
            found.unread.append(line.strip())
        else:
            found.information.setdefault(found.section, {}).setdefault(key.group(1).lower(), key.group(2).strip())
        return
    if key and key.group(1).lower() in _BLOCKS and found.section != "USER-TEXT":
        found.reading, line = key.group(1).lower(), key.group(2)
    elif key and not (found.section == "DEVIATIONS" and parse_number(line.split()[0]) is not None):
        found.reading = ""
        found.keys.setdefault(key.group(1).lower(), key.group(2).strip())
        return
    if found.reading == "targets":
        for word in line.split():
            value = parse_number(word)
            if value is None:
                raise source.fail(f"expected a target position, found {shown(word)}", number, "TARGET DATA")
            found.commas = found.commas or "," in word
            found.targets.append(value)
        if len(found.targets) > MOST_TARGETS:
            raise source.fail(f"has more than {MOST_TARGETS} targets", number, "TARGET DATA")
    elif found.reading == "run target data" and line.split():
        found.rows.append(_row(source, found, number, line))


def _row(source: Text, found: _File, number: int, line: str) -> tuple[int, int, int, float]:
    words = line.split()
    values = [parse_number(word) for word in words]
    if len(words) != 3 or None in values:
        cut = "; is the file truncated?" if len(words) < 3 else ""
        message = f"expected three numbers 'run target deviation', found {shown(line.strip())}{cut}"
        raise source.fail(message, number, "DEVIATIONS")
    run, target, deviation = (float(value) for value in values if value is not None)
    if run != int(run) or target != int(target):
        raise source.fail(f"run and target are whole numbers, found {shown(line.strip())}", number, "DEVIATIONS")
    found.commas = found.commas or "," in words[2]
    return number, int(run), int(target), deviation


def _count(source: Text, found: _File, key: str, most: int) -> int | None:
    text = found.keys.get(key)
    if not text:
        return None
    value = parse_number(text.split()[0])
    if value is None or value != int(value) or not 0 < value <= most:
        raise source.fail(f"{key} is {shown(text)}; expected a whole number from 1 to {most}")
    return int(value)


def _check_end(source: Text, found: _File) -> None:
    """Refuse a truncated file: counts must match, every run must have every target, and the last number be complete."""
    targets, rows = len(found.targets), len(found.rows)
    declared = _count(source, found, "target-count", MOST_TARGETS)
    runs = _count(source, found, "run-count", MOST_RUNS)
    if not targets:
        raise source.fail("contains no target positions ('Targets :' in the section TARGET DATA); is it truncated?")
    if declared is not None and targets != declared:
        raise source.fail(
            f"declares {declared} targets but contains {targets}; is it truncated or edited?", None, "Target-count"
        )
    if not rows:
        raise source.fail("contains no readings ('Run Target Data:' in the section DEVIATIONS); is it truncated?")
    runs = runs or max(row[1] for row in found.rows)
    if rows != runs * targets:
        cut = "" if found.complete else ", and has no end mark EOF::: it is truncated"
        message = f"{runs} runs of {targets} targets are {runs * targets} readings, the file contains {rows}{cut}"
        raise source.fail(message, found.rows[-1][0], "DEVIATIONS")
    seen: set[tuple[int, int]] = set()
    for number, run, target, _ in found.rows:
        if not (1 <= run <= runs and 1 <= target <= targets) or (run, target) in seen:
            message = f"run {run}, target {target} appears twice or is beyond {runs} runs and {targets} targets"
            raise source.fail(message, number, "DEVIATIONS")
        seen.add((run, target))
    if not found.complete and found.reading and not source.ended:
        raise source.fail("ends in the middle of a line, without an end mark: it is truncated", found.rows[-1][0])


def without_runs(found: Renishaw, numbers: tuple[int, ...]) -> Renishaw:
    """Return a file without some of its one-way runs."""
    keep = ~np.isin(found.one_way, numbers)
    kept, one_way = found.runs.rows(np.flatnonzero(keep)), found.one_way[keep]
    return replace(found, runs=replace(kept, run=cycles(kept.direction, one_way)), one_way=one_way)


def _letter(source: Text, found: _File) -> str:
    """Return the type from the file's name, otherwise from 'File type'."""
    by_name = SUFFIXES.get(source.path.suffix.lower())
    kind = found.keys.get("file type", "").lower()
    by_key = next((SUFFIXES[suffix] for suffix in SUFFIXES if suffix[1:] in re.findall("[a-z]+", kind)), None)
    if by_key is None:
        words = {"linear": "l", "angular": "a", "straightness": "s"}
        by_key = next((letter for word, letter in words.items() if word in kind), None)
    if by_name and by_key and by_name != by_key:
        raise source.fail(f"has the ending {source.path.suffix} but File type {shown(kind)}; rename it accordingly")
    chosen = by_name or by_key
    if chosen is None:
        raise source.fail("neither its name (.rtl, .rta, .rts) nor 'File type' shows whether it is linear or angular")
    return chosen


# ISO 230-2 input files of the ecmc motion tools (``*.dat``): assignments in shell syntax.
#
# ``TGT_DATA[i]=`` targets, ``REF_DATA_FWD[i,j]=`` and ``REF_DATA_BWD[i,j]=`` the reference readings at target i of cycle j,
# ``UNIT=``, ``CYCLES=``, ``POSITIONS=``. Deviation = reading - target; nothing is removed from it.


MOST_ECMC_BYTES = 16_000_000
#: Correlation below which readings count as fitted; by chance it is a few percent.
FITTED = 1e-4
MM_PER = {"mm": 1.0, "um": 1e-3, "m": 1e3, "nm": 1e-6}
_ASSIGNMENT = re.compile(r"\s{0,20}([A-Za-z_][A-Za-z0-9_]{0,40})(?:\[\s*(\d{1,6})\s*(?:,\s*(\d{1,6})\s*)?\])?\s*=(.*)")
_ARRAYS = {"TGT_DATA": 1, "REF_DATA_FWD": 2, "REF_DATA_BWD": 2}
_SIGN = re.compile(r"^\s*(TGT_DATA|REF_DATA_FWD|REF_DATA_BWD)\[", re.MULTILINE)


@dataclass(frozen=True)
class Ecmc:
    """Readings in mm, the other assignments by name, and slope and direction of the readings."""

    runs: OneAxis
    keys: Mapping[str, str]
    slope: float
    offset_mm: float

    @property
    def fitted(self) -> bool:
        """Whether a line from readings to targets was fitted to these readings and removed from them.

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
    """Recognise such a file by its first lines."""
    return _SIGN.search(head) is not None


def read_ecmc(path: Path) -> Ecmc:
    """Read an ISO 230-2 input file; InputError with the line for one that is truncated or inconsistent."""
    source = read_source(path, most=MOST_ECMC_BYTES)
    keys: dict[str, str] = {}
    targets: dict[int, tuple[float, int]] = {}
    readings: dict[tuple[str, int, int], _Reading] = {}
    decimals: list[int] = []
    for number, line in enumerate(source.text.split("\n"), start=1):
        content = line.partition("#")[0].strip()
        if content:
            decimals.append(_take(source, number, content, keys, (targets, readings)))
    if not source.ended and len(decimals) > 2 and decimals[-1] < min(decimals[len(keys) : -1], default=0):
        raise source.fail("the last line has no line end and fewer decimals than all others: it is truncated")
    _check_complete(source, keys, targets, readings)
    unit = keys.get("UNIT", "mm").lower().replace("\u00b5", "u").replace("\u03bc", "u")
    if unit not in MM_PER:
        raise source.fail(
            f"UNIT={shown(unit)} is not a unit of length; use {', '.join(MM_PER)} (linear axes)", field="UNIT"
        )
    scale = MM_PER[unit]
    order = [targets[k][0] for k in sorted(targets)]
    steps = np.sign(np.diff(order))
    if not (np.all(steps == steps[0]) and steps[0] != 0):
        raise source.fail("the targets are neither ascending nor descending; the directions cannot be determined")
    # a cycle visits the targets in their order (FWD) and back (BWD); the file lists all FWD before all BWD
    rows = sorted(readings.values(), key=lambda item: (item.cycle, -item.way, item.way * item.target))
    position = np.array([targets[item.target][0] for item in rows]) * scale
    actual = np.array([item.value for item in rows]) * scale
    # the direction of FWD is that of the motion, whatever its name
    way, cycle, at = np.array([(item.way, item.cycle, item.line) for item in rows], dtype=np.int64).T
    slope, offset = np.polyfit(position, actual, 1).tolist()
    runs = OneAxis(position, way * int(steps[0]), cycle, actual - position, at, in_time=True)
    return Ecmc(runs, keys, slope, offset)


def _take(
    source: Text,
    number: int,
    content: str,
    keys: dict[str, str],
    data: tuple[dict[int, tuple[float, int]], dict[tuple[str, int, int], _Reading]],
) -> int:
    """Read one assignment and return the number of its decimals."""
    match = _ASSIGNMENT.fullmatch(content)
    if not match:
        raise source.fail(f"expected an assignment NAME=value, found {shown(content)}; is the file truncated?", number)
    name, first, second, text = match.group(1).upper(), match.group(2), match.group(3), match.group(4).strip(" \t\"';")
    if name not in _ARRAYS:
        keys[name] = text
        return 99
    if (first is None) or (second is not None) != (_ARRAYS[name] == 2):
        expected = "[target,cycle]" if _ARRAYS[name] == 2 else "[target]"
        raise source.fail(f"{name} requires {expected}, found {shown(content)}", number)
    value = parse_number(text)
    if value is None:
        raise source.fail(f"{shown(text)} is not a number; is the file truncated?", number, name)
    targets, readings = data
    if name == "TGT_DATA":
        if targets.setdefault(int(first), (value, number)) != (value, number) and targets[int(first)][0] != value:
            raise source.fail(f"target {first} already has another value in line {targets[int(first)][1]}", number)
        return len(text.partition(".")[2])
    key = (name, int(first), int(second))
    if key in readings:
        raise source.fail(f"{name}[{first},{second}] already appears in line {readings[key].line}", number)
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
            raise source.fail(f"declares {keys[name]} {what} but contains {found}; is it truncated?", field=name)
    names = {name for name, _, _ in readings}
    cycles = {item.cycle for item in readings.values()}
    for name in sorted(names):
        missing = [(i, j) for j in sorted(cycles) for i in sorted(targets) if (name, i, j) not in readings]
        if missing:
            raise source.fail(f"{name}[{missing[0][0]},{missing[0][1]}] is missing; is it truncated?")
    strange = next((item for item in readings.values() if item.target not in targets), None)
    if strange:
        raise source.fail(f"a reading of target {strange.target}, which has no TGT_DATA", strange.line)
    if len(targets) < 2 or not readings:
        raise source.fail("contains fewer than two targets with readings")


# Dynamic captures of a laser interferometer (.rtx): displacement over time, no targets.
#
# A header of lines ``key : value``, then ``Data:`` and ``Sample no`` little-endian doubles, then an end mark.


_START, _DATA = b"HEADER::\r\n", b"\nData:\r\n"
#: Number of bytes after the samples in which the end mark is searched.
_TRAILER_BYTES, _SAMPLE_BYTES = 16, 8
#: More samples than this are not written as text.
MOST_ROWS = 2_000_000


@dataclass(frozen=True)
class Capture:
    """n samples of one channel at a fixed rate: ``value`` (n,) in ``unit`` (mm or mrad), every ``step_s``."""

    value: FloatArray
    unit: str
    step_s: float
    keys: Mapping[str, str]

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.value)

    def summary(self) -> dict[str, object]:
        """Return a summary of the capture; the samples are processed in blocks."""
        low, high, first, last = np.inf, -np.inf, float(self.value[0]), float(self.value[-1])
        for start in range(0, len(self.value), 1_000_000):
            block = self.value[start : start + 1_000_000]
            low, high = min(low, float(block.min())), max(high, float(block.max()))
        return {
            "samples": len(self.value),
            "step_s": self.step_s,
            "duration_s": (len(self.value) - 1) * self.step_s,
            "unit": self.unit,
            "lowest": low,
            "highest": high,
            "first": first,
            "last": last,
        }


def is_capture(head: bytes) -> bool:
    """Recognise a binary capture by its first bytes."""
    return head.startswith(_START) and _DATA in head


def read_capture(path: Path) -> Capture:
    """Read a .rtx file without loading it whole; InputError for a truncated one."""
    size = check_size(path, MOST_CAPTURE_BYTES)
    head = read_bytes(path, HEAD_BYTES)
    if not is_capture(head):
        raise InputError("is not a capture; expected 'HEADER::' and 'Data:'", file=path)
    start = head.index(_DATA) + len(_DATA)
    pairs = (
        line.partition(":")
        for line in head[: start - len(_DATA) + 1].decode("utf-8", errors="replace").splitlines()
        if ":" in line and "::" not in line
    )
    keys = {key.strip().lower(): value.strip() for key, _, value in pairs}
    count = _whole(path, keys, "sample no")
    if size < start + _SAMPLE_BYTES * count:
        found = max(0, (size - start) // _SAMPLE_BYTES)
        raise InputError(
            f"declares {count} samples but contains {found}: it is truncated", file=path, field="Sample no"
        )
    with path.open("rb") as stream:
        stream.seek(start + _SAMPLE_BYTES * count)
        trailer = stream.read(_TRAILER_BYTES)
    if not 0 <= trailer.find(b"EOF") < _SAMPLE_BYTES:  # further off, there would be an uncounted sample before it
        raise InputError("has no end mark EOF:: after its samples: it is truncated, or Sample no is wrong", file=path)
    value = np.memmap(path, dtype="<f8", mode="r", offset=start, shape=(count,))
    for first in range(0, count, 1_000_000):
        if not np.isfinite(value[first : first + 1_000_000]).all():
            raise InputError("contains samples that are not finite numbers; is it damaged?", file=path)
    angular = "angular" in keys.get("file type", "").lower()
    return Capture(value, "mrad" if angular else "mm", _step(path, keys), keys)


def _whole(path: Path, keys: Mapping[str, str], key: str) -> int:
    value = parse_number(keys.get(key, ""))
    if value is None or value != int(value) or value < 1:
        raise InputError(f"{shown(keys.get(key, ''))} is not a number of samples", file=path, field=key)
    return int(value)


def _step(path: Path, keys: Mapping[str, str]) -> float:
    """Seconds between samples: by the actual rate, the interval, or the rate, whichever is given."""
    for key, is_rate in (("actual sample rate", True), ("trigger interval", False), ("sample rate", True)):
        value = parse_number(keys.get(key, ""))
        if value is not None and value > 0:
            return 1.0 / value if is_rate else value
    raise InputError("states neither a sample rate nor an interval", file=path, field="Sample rate")


def format_capture(capture: Capture) -> str:
    """Return CSV text with ``time_s`` and ``value_mm`` or ``value_mrad``."""
    if len(capture) > MOST_ROWS:
        raise InputError(f"{len(capture)} samples are too many for a text file; at most {MOST_ROWS} are written")
    time_s = np.arange(len(capture), dtype=np.float64) * capture.step_s
    return format_csv(
        {"time_s": time_s, f"value_{capture.unit}": np.asarray(capture.value)},
        dict(capture.keys),
        {"time_s": 9, f"value_{capture.unit}": 9},
    )
