"""Numbers of machine error compensation: the set sheet read from text, the curves it means, the limits it must keep.

Increment system, E60/E68 manual p. II-292 and C64 manual 9.2. On the positive side of the reference point the value of
point n is (division interval - actual movement) x 2 for a feed from n-1 to n, on the negative side (division interval +
actual movement) x 2 for a feed from n+1 to n. So with the curve A in units of output, zero at the reference number,

    A[n] = A[n-1] + v[n] on the positive side,   A[n] = A[n+1] - v[n] on the negative side.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from compgen.controllers.base import SourceFile, Usage, coverage_violations
from compgen.controllers.mitsubishi.settings import (
    FIRST_NUMBER,
    HIGHEST_VALUE,
    LAST_NUMBER,
    LOWEST_VALUE,
    SETS,
    MitsubishiSettings,
)
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.core.text import one_line
from compgen.errors import CompgenWarning, InputError

#: No set sheet is anywhere near this long, or has lines of this length.
MOST_CHARACTERS, MOST_IN_LINE = 1_000_000, 500
SYSTEM = 4000
#: Parameters of set k stand at these numbers plus 10 (k - 1).
BASE, OUTPUT, REFERENCE, NEGATIVE, POSITIVE, SCALE, INTERVAL = range(4001, 4008)
SET_STEP = 10

_WHOLE = re.compile(r"[+-]?\d{1,9}", re.ASCII)
_DECIMAL = re.compile(r"\d{1,6}(?:\.\d{1,6})?", re.ASCII)


@dataclass(frozen=True)
class SetTable:
    """One set: the axis ``output`` is corrected as a function of the axis ``base``.

    ``values`` are the numbers as stored for ``first`` ... ``last``; ``reference`` is the number at the reference point.
    """

    base: int
    output: int
    reference: int
    first: int
    values: tuple[int, ...]
    scale: int
    interval_mm: Decimal

    @property
    def last(self) -> int:
        """Farthest number on the positive side."""
        return self.first + len(self.values) - 1

    @property
    def curve(self) -> NDArray[np.int64]:
        """Curve A in counts at the numbers ``first`` ... ``last``, zero at the reference number, shape (n,)."""
        at = self.reference - self.first
        values = np.array(self.values, dtype=np.int64)
        above = np.cumsum(values[at + 1 :])
        below = -np.cumsum(values[:at][::-1])[::-1]
        return np.concatenate([below, [0], above]).astype(np.int64)

    @property
    def along_mm(self) -> FloatArray:
        """Positions of the numbers from the reference point, shape (n,), mm."""
        return np.array([float((self.first + k - self.reference) * self.interval_mm) for k in range(len(self.values))])


@dataclass(frozen=True)
class Shortfall:
    """How far the limit of the values keeps a table from what was wanted, in counts."""

    output: int
    base: int
    missed_counts: float


@dataclass(frozen=True)
class MitsubishiTables:
    """All sets of X, Y, Z; ``shortfalls`` is known of tables that were built."""

    sets: tuple[SetTable, ...]
    shortfalls: tuple[Shortfall, ...] = field(default=(), compare=False)


@dataclass(frozen=True)
class Entry:
    """One row of the sheet."""

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
            raise self.fail(f"{one_line(self.value)[:30]!r} is given; a whole number from {low} to {high} is due")
        return int(self.value)


def values_of(curve: NDArray[np.int64], at: int) -> tuple[int, ...]:
    """Return the numbers to store for a curve (n,) in counts that is zero at the index ``at``."""
    steps = np.diff(curve)
    return tuple(int(value) for value in (*steps[:at], 0, *steps[at:]))


def parse_sheet(settings: MitsubishiSettings, files: Sequence[SourceFile]) -> MitsubishiTables:
    """Read a set sheet; files that end in ``.json`` (the plan beside it) are left out."""
    sheets = [file for file in files if file.path.suffix.lower() != ".json"]
    if not sheets:
        raise InputError("no set sheet is given", file=files[0].path if files else None)
    entries: dict[int, Entry] = {}
    for file in sheets:
        for entry in _entries(file):
            before = entries.setdefault(entry.number, entry)
            if before is not entry:
                raise entry.fail(f"stands here a second time (first in {before.file.path}:{before.line})")
    if SYSTEM not in entries:
        raise sheets[0].fail(f"#{SYSTEM} (increment system) is missing", 1)
    if entries[SYSTEM].whole(0, 1) == 0:
        raise entries[SYSTEM].fail(
            "0 is the absolute system, whose values are not documented; only increments are read"
        )
    found = [_set_table(settings, entries, number) for number in range(1, SETS + 1)]
    tables = tuple(table for table in found if table is not None)
    if not tables:
        raise sheets[0].fail(f"holds no set of the axes {', '.join(settings.axis_names)} (#4001, #4011, ...)", 1)
    return MitsubishiTables(tables)


def _entries(file: SourceFile) -> list[Entry]:
    """Rows ``#number,value,meaning``; blank lines and lines that begin with '#' and no digit (the header) are skipped."""
    if len(file.text) > MOST_CHARACTERS:
        raise file.fail(f"holds {len(file.text)} characters; no set sheet is longer than {MOST_CHARACTERS}", 1)
    found = []
    for line, raw in enumerate(file.text.removeprefix("\ufeff").split("\n"), start=1):
        text = raw.strip(" \t\r")
        if len(text) > MOST_IN_LINE or not text.isascii():
            raise file.fail(f"is not a row of a set sheet: {one_line(text[:30])!r} ...", line)
        if text and not re.match(r"#\s*(?!\d)", text):
            found.append(_entry(file, line, text))
    return found


def _entry(file: SourceFile, line: int, text: str) -> Entry:
    cells = [cell.strip() for cell in text.split(",", 2)]
    number = cells[0].removeprefix("#").strip()
    if not re.fullmatch(r"\d{1,6}", number, re.ASCII):
        raise file.fail(f"{one_line(cells[0])[:30]!r} is not the number of a parameter such as #4101", line)
    if len(cells) < 3:
        raise file.fail(f"#{number}: number, value and meaning are due, separated by commas (is the file cut?)", line)
    return Entry(int(number), cells[1], file, line)


def _set_table(settings: MitsubishiSettings, entries: dict[int, Entry], number: int) -> SetTable | None:
    """Return set ``number`` (1 to 10), None if it is empty or belongs to another axis."""
    shift = SET_STEP * (number - 1)
    due = {parameter: entries.get(parameter + shift) for parameter in range(BASE, INTERVAL + 1)}
    present = {parameter: entry for parameter, entry in due.items() if entry is not None}
    if not any(entry.value for entry in present.values()):
        return None
    first_entry = next(iter(present.values()))
    missing = [f"#{parameter + shift}" for parameter, entry in due.items() if entry is None or not entry.value]
    if missing:
        raise first_entry.file.fail(f"{', '.join(missing)} of set {number} missing", first_entry.line)
    names = [present[parameter].value for parameter in (BASE, OUTPUT)]
    strange = [name for name in names if name not in settings.axis_names]
    if strange:
        message = f"set {number} belongs to the axis {one_line(strange[0])[:10]}, not of the machine file: not used"
        warnings.warn(message, CompgenWarning, stacklevel=5)
        return None
    first, last = (present[key].whole(FIRST_NUMBER, LAST_NUMBER) for key in (NEGATIVE, POSITIVE))
    reference = present[REFERENCE].whole(FIRST_NUMBER, LAST_NUMBER)
    if not first <= reference <= last:
        raise present[REFERENCE].fail(f"the reference number {reference} is none of {first} to {last} of its set")
    return SetTable(
        base=settings.axis_names.index(names[0]),
        output=settings.axis_names.index(names[1]),
        reference=reference,
        first=first,
        values=_values(entries, first, last, present[POSITIVE]),
        scale=present[SCALE].whole(0, 99),
        interval_mm=_interval(present[INTERVAL]),
    )


def _values(entries: dict[int, Entry], first: int, last: int, who: Entry) -> tuple[int, ...]:
    missing = [number for number in range(first, last + 1) if number not in entries]
    if missing:
        some = ", ".join(f"#{number}" for number in missing[:5])
        raise who.fail(f"points {first} to {last} are given, {some} ({len(missing)} in all) missing")
    return tuple(entries[number].whole(LOWEST_VALUE, HIGHEST_VALUE) for number in range(first, last + 1))


def _interval(entry: Entry) -> Decimal:
    if not _DECIMAL.fullmatch(entry.value) or not Decimal(entry.value):
        raise entry.fail(f"{one_line(entry.value)[:30]!r} is given; an interval in mm as a plain decimal number is due")
    return Decimal(entry.value)


def sheet_violations(machine: Machine, settings: MitsubishiSettings, tables: MitsubishiTables) -> list[str]:
    """Return broken limits: range of values, numbers, overlaps, scale, doubled pairs, travel left out."""
    found = []
    for table in tables.sets:
        what = set_name(table)
        start_mm, end_mm = machine.reference_point_mm[table.base] + table.along_mm[[0, -1]]
        found += coverage_violations(machine, table.base, float(start_mm), float(end_mm), what)
        wide = [value for value in table.values if not LOWEST_VALUE <= value <= HIGHEST_VALUE]
        if wide:
            found.append(f"{what}: the value {wide[0]} lies outside {LOWEST_VALUE} ... {HIGHEST_VALUE}")
        if table.last > settings.last_number:
            found.append(f"{what}: numbers go up to {table.last}, the last free one is {settings.last_number}")
        if table.scale == 0:
            found.append(f"{what}: the scale is 0, which leaves nothing of the table")
        if table.values[table.reference - table.first]:
            found.append(f"{what}: the value at the reference number {table.reference} must be 0")
    for one, other in combinations(tables.sets, 2):
        if one.first <= other.last and other.first <= one.last:
            found.append(f"the numbers of {set_name(one)} and {set_name(other)} overlap")
        if (one.base, one.output) == (other.base, other.output):
            found.append(f"{set_name(one)} stands in two sets")
    missing = [AXES[axis] for axis in range(3) if not any(t.base == t.output == axis for t in tables.sets)]
    found += [f"{letter} has no table of its own position" for letter in missing]
    return found + [shortfall_text(settings, item) for item in tables.shortfalls if item.missed_counts > 1.0]


def set_name(table: SetTable) -> str:
    """Name of a set in messages, e.g. ``the table X(y)``."""
    return f"the table {AXES[table.output]}({AXES[table.base].lower()})"


def shortfall_text(settings: MitsubishiSettings, item: Shortfall) -> str:
    """Say that the range of the values keeps a table from what was wanted, and what helps."""
    return (
        f"the table {AXES[item.output]}({AXES[item.base].lower()}) is too steep for {HIGHEST_VALUE} counts of "
        f"{settings.count_mm / MM_PER_UM:g} um per division: it misses by up to "
        f"{item.missed_counts * settings.count_mm / MM_PER_UM:.1f} um; a larger scale or a shorter interval_mm is needed"
    )


def sheet_usage(settings: MitsubishiSettings, tables: MitsubishiTables) -> list[Usage]:
    """Return the largest value, the numbers and the sets against their limits."""
    largest = max(max(map(abs, table.values)) for table in tables.sets)
    used = sum(len(table.values) for table in tables.sets)
    return [
        Usage("largest value of a division", largest, HIGHEST_VALUE, "counts"),
        Usage("compensation numbers", used, settings.last_number - settings.first_number + 1, "numbers"),
        Usage("sets", len(tables.sets), SETS, "sets"),
    ]
