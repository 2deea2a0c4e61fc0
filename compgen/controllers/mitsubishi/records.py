"""Rows of a set sheet and records of the control's own parameter file, and what that file shows of all axes.

The parameter file (``ALL.PRM``) has a line ``%`` at either end, comments that begin with ``;``, a line ``PARA101()`` and
records ``N4101P-2``: number, perhaps a word T, A or K with an index, and behind P the value. So a public backup of an M80
has it; no document describes it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path

from compgen.controllers.base import SourceFile
from compgen.core.files import read_bytes
from compgen.core.text import one_line
from compgen.errors import InputError

#: Increment or absolute system, for all sets alike; unit of the values.
SYSTEM, UNIT = 4000, 1006
#: Parameters of set k stand at these numbers plus 10 (k - 1).
BASE, OUTPUT, REFERENCE, NEGATIVE, POSITIVE, SCALE, INTERVAL = range(4001, 4008)
SET_STEP, SETS = 10, 10
#: Numbers of compensation values: the last one of most controls, and of an M80.
FIRST_NUMBER, LAST_NUMBER, MOST_NUMBER = 4101, 5124, 5999
#: Values of #1006 as they are remembered, um.
UNITS_UM = {"A": 10.0, "B": 1.0, "C": 0.1, "D": 0.01, "E": 0.001}
#: No sheet and no parameter file is longer than this, or has lines of this length.
MOST_CHARACTERS, MOST_IN_LINE = 4_000_000, 500
MOST_IN_SHEET = 1_000_000

_WHOLE = re.compile(r"[+-]?\d{1,9}", re.ASCII)
_DECIMAL = re.compile(r"\d{1,6}(?:\.\d{1,6})?", re.ASCII)
_RECORD = re.compile(r"N(\d{1,6})((?:[A-OQ-Z]\d{1,4})*)P([^\r\n]*)", re.ASCII)

Span = tuple[int, int]


@dataclass(frozen=True)
class Entry:
    """One row of a sheet, or one record of a parameter file."""

    number: int
    value: str
    file: SourceFile
    line: int

    def fail(self, message: str) -> InputError:
        """Return the error that points at this row."""
        return self.file.fail(f"#{self.number}: {message}", self.line)

    def whole(self, low: int, high: int) -> int:
        """Return the value as a whole number within limits."""
        if not _WHOLE.fullmatch(self.value) or not low <= int(self.value) <= high:
            raise self.fail(f"{one_line(self.value)[:30]!r} is given; a whole number from {low} to {high} is expected")
        return int(self.value)

    def interval_mm(self) -> Decimal:
        """Return the value as a division interval, mm."""
        if not _DECIMAL.fullmatch(self.value) or not Decimal(self.value):
            raise self.fail(
                f"{one_line(self.value)[:30]!r} is given; an interval in mm as a plain decimal number is expected"
            )
        return Decimal(self.value)


def is_parameter_file(file: SourceFile) -> bool:
    """Whether a text is a parameter file of the control: it begins with ``%``."""
    return file.text.removeprefix("\ufeff").lstrip().startswith("%")


def begins_with_mark(path: Path) -> bool:
    """Whether a file is a parameter file of the control."""
    return is_parameter_file(SourceFile(path, read_bytes(path)[:100].decode("ascii", "replace")))


def sheet_entries(file: SourceFile) -> list[Entry]:
    """Rows ``#number,value,meaning``; blank lines and lines that begin with '#' and no digit (the header) are skipped."""
    if len(file.text) > MOST_IN_SHEET:
        raise file.fail(f"holds {len(file.text)} characters; no set sheet is longer than {MOST_IN_SHEET}", 1)
    found = []
    for line, raw in enumerate(file.text.removeprefix("\ufeff").split("\n"), start=1):
        text = raw.strip(" \t\r")
        if len(text) > MOST_IN_LINE or not text.isascii():
            raise file.fail(f"is not a row of a set sheet: {one_line(text[:30])!r} ...", line)
        if text and not re.match(r"#\s*(?!\d)", text):
            found.append(_row(file, line, text))
    return found


def _row(file: SourceFile, line: int, text: str) -> Entry:
    cells = [cell.strip() for cell in text.split(",", 2)]
    number = cells[0].removeprefix("#").strip()
    if not re.fullmatch(r"\d{1,6}", number, re.ASCII):
        raise file.fail(f"{one_line(cells[0])[:30]!r} is not the number of a parameter such as #4101", line)
    if len(cells) < 3:
        raise file.fail(
            f"#{number}: number, value and meaning are expected, separated by commas (is the file cut?)", line
        )
    return Entry(int(number), cells[1], file, line)


def file_entries(file: SourceFile) -> tuple[list[Entry], int]:
    """Records of a parameter file that compensation needs, and how many lines were passed over.

    InputError with the line for a record of compensation that is not understood, and for a file that is cut.
    """
    if len(file.text) > MOST_CHARACTERS:
        raise file.fail(f"holds {len(file.text)} characters; no parameter file is longer than {MOST_CHARACTERS}", 1)
    lines = [raw.strip(" \t\r") for raw in file.text.removeprefix("\ufeff").split("\n")]
    inside = [number for number, text in enumerate(lines, start=1) if text]
    if len(inside) < 2 or lines[inside[0] - 1] != "%" or lines[inside[-1] - 1] != "%":
        raise file.fail("the '%' at its beginning or end is missing: is the file cut?", inside[-1] if inside else 1)
    found, passed_over = [], 0
    for line in inside[1:-1]:
        text = lines[line - 1]
        if text == "%":
            raise file.fail("a '%' within the file; it ends there", line)
        record = _RECORD.fullmatch(text) if len(text) <= MOST_IN_LINE else None
        number = int(record[1]) if record else 0
        if number in (SYSTEM, *range(BASE, FIRST_NUMBER), *range(FIRST_NUMBER, MOST_NUMBER + 1)):
            assert record is not None
            if record[2]:
                raise file.fail(f"#{number} has the word {record[2][:10]}; compensation parameters have none", line)
            found.append(Entry(number, record[3].strip(), file, line))
        elif number == UNIT and record is not None:
            found += (
                [] if any(entry.number == UNIT for entry in found) else [Entry(UNIT, record[3].strip(), file, line)]
            )
        elif re.match(r"N\s*[45]\d{3}(?!\d)", text):
            raise file.fail(f"{one_line(text[:30])!r} is not understood; a record such as N4101P-2 is expected", line)
        else:
            passed_over += not text.startswith(";")
    return found, passed_over


def by_number(entries: Sequence[Entry]) -> dict[int, Entry]:
    """Return entries by their number; InputError for a number that is given twice."""
    found: dict[int, Entry] = {}
    for entry in entries:
        before = found.setdefault(entry.number, entry)
        if before is not entry:
            raise entry.fail(f"stands here a second time (first in {before.file.path}:{before.line})")
    return found


@dataclass(frozen=True)
class ControlSet:
    """A set of the control's file: its index 0 ... 9, axis names, numbers, scale and interval as they are there."""

    index: int
    base: str
    output: str
    reference: int
    first: int
    last: int
    scale: int
    interval_mm: Decimal
    entry: Entry

    @property
    def span(self) -> Span:
        """Numbers that the set uses, that of its reference point among them."""
        return min(self.first, self.reference), max(self.last, self.reference)


@dataclass(frozen=True)
class ControlFile:
    """What the parameter file of the user's control shows; without one it is empty.

    ``absolute`` is the system of all sets (None: not known), ``unit_um`` the unit of the values as #1006 has it.
    """

    file: SourceFile | None = None
    absolute: bool | None = None
    unit_um: float | None = None
    sets: tuple[ControlSet, ...] = ()
    last_number: int = LAST_NUMBER
    entries: Mapping[int, Entry] = field(default_factory=dict)

    def others(self, names: Sequence[str]) -> list[ControlSet]:
        """Return the sets that belong to an axis other than ``names``."""
        return [item for item in self.sets if not {item.base, item.output} <= set(names)]


def read_control_file(paths: Sequence[Path]) -> ControlFile:
    """Read the parameter file of the user's control; InputError for what is not understood."""
    if not paths:
        return ControlFile()
    if len(paths) > 1:
        raise InputError("one parameter file of the control (ALL.PRM) is expected", file=paths[1])
    content = read_bytes(paths[0])
    file = SourceFile(paths[0], content.decode("ascii", errors="replace"))
    if "\ufffd" in file.text:
        line = file.text[: file.text.index("\ufffd")].count("\n") + 1
        raise file.fail("holds a byte that is not ASCII; a parameter file is ASCII text", line)
    return control_file(file)


def control_file(file: SourceFile) -> ControlFile:
    """Return what a parameter file shows; see :func:`read_control_file`."""
    if not is_parameter_file(file):
        raise file.fail("is not a parameter file of the control (ALL.PRM): the first line is not '%'", 1)
    entries = by_number(file_entries(file)[0])
    if SYSTEM not in entries:
        raise file.fail(f"#{SYSTEM} (absolute or increment system) is missing", 1)
    sets = [item for k in range(SETS) if (item := _control_set(entries, k)) is not None]
    unit = entries.get(UNIT)
    unit_um = None if unit is None else UNITS_UM.get(unit.value)
    numbers = [number for number in entries if number >= FIRST_NUMBER]
    full = sorted(numbers) == list(range(FIRST_NUMBER, FIRST_NUMBER + len(numbers)))
    last = max(numbers) if full and numbers else LAST_NUMBER
    return ControlFile(file, entries[SYSTEM].whole(0, 1) == 0, unit_um, tuple(sets), last, entries)


def _control_set(entries: Mapping[int, Entry], index: int) -> ControlSet | None:
    """Return a set, None if it has no axis; its numbers need not suit a linear axis."""
    shift = SET_STEP * index
    due = [entries.get(parameter + shift) for parameter in range(BASE, INTERVAL + 1)]
    present = [entry for entry in due if entry is not None]
    names = [entry.value for entry in present if entry.number - shift in (BASE, OUTPUT)]
    if not any(names):
        return None
    if len(present) < len(due) or not all(names):
        first = present[0]
        raise first.fail(f"set {index + 1} is not complete: #{BASE + shift} to #{INTERVAL + shift} are expected")
    reference, negative, positive, scale = (entry.whole(0, 99999) for entry in present[2:6])
    low, high = sorted((negative, positive))
    interval = present[6].interval_mm()
    return ControlSet(index, names[0], names[1], reference, low, high, scale, interval, present[3])
