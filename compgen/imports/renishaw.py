"""Renishaw laser files in text form: .rtl (linear, um), .rta (angular, mrad), .rts (straightness, um).

There is no public specification. The layout is what programs that write and read such files agree on: sections
``NAME::``, lines ``key : value``, N targets in free format, rows ``run target deviation``. The parser is tolerant in
spacing and in sections that it does not know, and strict in numbers: every run must hold every target.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from compgen.errors import InputError
from compgen.imports.one_axis import IntArray, OneAxis, cycles, motion
from compgen.imports.source import ENCODINGS_EAST, Text, parse_number, read_source, shown

#: What the deviations are by the letter of the file type; the unit does not stand in the file.
UNITS = {"l": "um", "a": "mrad", "s": "um"}
SUFFIXES = {".rtl": "l", ".rta": "a", ".rts": "s"}
REFUSED = {
    ".rtf": "flatness",
    ".rtp": "squareness",
    ".rtr": "a rotary axis",
}
#: Fifty runs of 10000 targets.
MOST_BYTES = 16_000_000
MOST_TARGETS, MOST_RUNS = 100_000, 1_000
_SECTION = re.compile(r"\s{0,20}([A-Za-z][A-Za-z0-9 _\-]{0,40})::\s*")
_KEY = re.compile(r"\s{0,40}([A-Za-z][^:]{0,60}?)\s{0,40}:(.*)")
#: Sections about the surroundings and the instrument; their keys are not those of the machine.
BESIDE = ("ENVIRONMENT", "EQUIPMENT")
#: Keys after which numbers follow; a line of user text that is called the same begins nothing.
_BLOCKS = ("targets", "run target data")
_SIGNS = ("run target data", "target-count", "run-count")


@dataclass
class _File:
    """What was read so far: values by lower-case key, numbers by section, and how the file ended."""

    keys: dict[str, str] = field(default_factory=dict)
    targets: list[float] = field(default_factory=list)
    rows: list[tuple[int, int, int, float]] = field(default_factory=list)
    beside: dict[str, dict[str, str]] = field(default_factory=dict)
    unread: list[str] = field(default_factory=list)
    section: str = ""
    reading: str = ""
    complete: bool = False
    commas: bool = False


@dataclass(frozen=True)
class Renishaw:
    """A text file of the laser software: ``letter`` of its type, axis runs in the file's unit, user text by key.

    ``one_way`` holds the run numbers of the file (n,); ``sorted_rows`` says that the flags name two directions, but all
    runs list their targets in the same order. ``beside`` holds the keys of ENVIRONMENT and EQUIPMENT, ``zero_runs`` the runs
    that are zero at every target while others are not; ``one_way_test`` says that the flags name one direction only.
    """

    letter: str
    runs: OneAxis
    keys: Mapping[str, str]
    encoding: str
    notes: tuple[str, ...]
    one_way: IntArray
    sorted_rows: bool
    beside: Mapping[str, Mapping[str, str]]
    zero_runs: tuple[int, ...]
    one_way_test: bool


def is_renishaw_text(head: str) -> bool:
    """Tell a text file of the laser software by its first lines."""
    low = head.lower()
    return low.lstrip().startswith("header::") or any(f"\n{sign}" in low for sign in _SIGNS)


def read_renishaw(path: Path) -> Renishaw:
    """Read a .rtl, .rta or .rts file; InputError with the line for one that is cut or does not fit together."""
    if path.suffix.lower() in REFUSED:
        what = REFUSED[path.suffix.lower()]
        raise InputError(f"holds {what}; .rtl, .rta and .rts of linear axes are read", file=path)
    source = read_source(path, ENCODINGS_EAST, MOST_BYTES)
    found = _File()
    for number, line in enumerate(source.text.split("\n"), start=1):
        _take_line(source, found, number, line)
    _check_end(source, found)
    return _assembled(source, found)


def _take_line(source: Text, found: _File, number: int, line: str) -> None:
    header = _SECTION.fullmatch(line)
    if header:
        found.section, found.reading = header.group(1).upper(), ""
        found.complete = found.complete or found.section == "EOF"
        return
    if not line.strip():
        return
    key = _KEY.fullmatch(line)
    if found.section in BESIDE:
        _take_beside(found, line, key)
        return
    if key and key.group(1).lower() in _BLOCKS and found.section != "USER-TEXT":
        found.reading, line = key.group(1).lower(), key.group(2)
    elif key and not (found.section == "DEVIATIONS" and parse_number(line.split()[0]) is not None):
        found.reading = ""
        found.keys.setdefault(key.group(1).lower(), key.group(2).strip())
        return
    if found.reading == "targets":
        _take_targets(source, found, number, line)
    elif found.reading == "run target data" and line.split():
        found.rows.append(_row(source, found, number, line))


def _take_beside(found: _File, line: str, key: re.Match[str] | None) -> None:
    if key is None:
        found.unread.append(line.strip())
    else:
        found.beside.setdefault(found.section, {}).setdefault(key.group(1).lower(), key.group(2).strip())


def _take_targets(source: Text, found: _File, number: int, line: str) -> None:
    for word in line.split():
        value = parse_number(word)
        if value is None:
            raise source.fail(f"a target position is due, found {shown(word)}", number, "TARGET DATA")
        found.commas = found.commas or "," in word
        found.targets.append(value)
    if len(found.targets) > MOST_TARGETS:
        raise source.fail(f"has more than {MOST_TARGETS} targets", number, "TARGET DATA")


def _row(source: Text, found: _File, number: int, line: str) -> tuple[int, int, int, float]:
    words = line.split()
    values = [parse_number(word) for word in words]
    if len(words) != 3 or None in values:
        cut = "; was the file cut?" if len(words) < 3 else ""
        message = f"three numbers 'run target deviation' are due, found {shown(line.strip())}{cut}"
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
        raise source.fail(f"{key} is {shown(text)}; a whole number from 1 to {most} is due")
    return int(value)


def _check_end(source: Text, found: _File) -> None:
    """Refuse a cut file: counts must hold, every run must have every target, and a last number must be whole."""
    targets, rows = len(found.targets), len(found.rows)
    declared = _count(source, found, "target-count", MOST_TARGETS)
    runs = _count(source, found, "run-count", MOST_RUNS)
    if not targets:
        raise source.fail("holds no target positions ('Targets :' in the section TARGET DATA); was it cut?")
    if declared is not None and targets != declared:
        raise source.fail(
            f"declares {declared} targets but holds {targets}; was it cut or edited?", None, "Target-count"
        )
    if not rows:
        raise source.fail("holds no readings ('Run Target Data:' in the section DEVIATIONS); was it cut?")
    runs = runs or max(row[1] for row in found.rows)
    if rows != runs * targets:
        cut = "" if found.complete else ", and has no end mark EOF::: it was cut"
        message = f"{runs} runs of {targets} targets are {runs * targets} readings, the file holds {rows}{cut}"
        raise source.fail(message, found.rows[-1][0], "DEVIATIONS")
    seen: set[tuple[int, int]] = set()
    for number, run, target, _ in found.rows:
        if not (1 <= run <= runs and 1 <= target <= targets) or (run, target) in seen:
            message = f"run {run}, target {target} stands here twice, or beyond {runs} runs and {targets} targets"
            raise source.fail(message, number, "DEVIATIONS")
        seen.add((run, target))
    if not found.complete and found.reading and not source.ended:
        raise source.fail("ends in the middle of a line, without an end mark: it was cut", found.rows[-1][0])


def _assembled(source: Text, found: _File) -> Renishaw:
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
        notes.append(f"{len(found.unread)} lines in {' and '.join(BESIDE)} without a key were not used")
    flags = found.keys.get("flags", "").split()
    runs = OneAxis(position, direction, cycles(direction, run), value, numbers, in_time=bool(np.all(np.diff(run) >= 0)))
    two_ways = flags[:2] == ["0", "0"] and alternating
    numbered = np.unique(run).tolist()
    zero = tuple(number for number in numbered if not value[run == number].any()) if value.any() else ()
    return Renishaw(
        letter, runs, found.keys, source.encoding, tuple(notes), run, two_ways, found.beside, zero, flags[1:2] == ["1"]
    )


def without_runs(found: Renishaw, numbers: tuple[int, ...]) -> Renishaw:
    """Return a file without some of its one-way runs."""
    keep = ~np.isin(found.one_way, numbers)
    one_way, old = found.one_way[keep], found.runs
    direction = old.direction[keep]
    runs = OneAxis(
        old.position_mm[keep], direction, cycles(direction, one_way), old.value[keep], old.line[keep], {}, old.in_time
    )
    return replace(found, runs=runs, one_way=one_way)


def _letter(source: Text, found: _File) -> str:
    """Type by the file's name, else by the value of 'File type'."""
    by_name = SUFFIXES.get(source.path.suffix.lower())
    kind = found.keys.get("file type", "").lower()
    by_key = next((SUFFIXES[suffix] for suffix in SUFFIXES if suffix[1:] in re.findall("[a-z]+", kind)), None)
    if by_key is None:
        words = {"linear": "l", "angular": "a", "straightness": "s"}
        by_key = next((letter for word, letter in words.items() if word in kind), None)
    if by_name and by_key and by_name != by_key:
        raise source.fail(f"is called {source.path.suffix} but says File type {shown(kind)}; rename it to what it is")
    chosen = by_name or by_key
    if chosen is None:
        raise source.fail("neither its name (.rtl, .rta, .rts) nor 'File type' says whether it is linear or angular")
    return chosen
