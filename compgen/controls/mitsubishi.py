"""Mitsubishi machine error compensation (``mitsubishi``): positioning and relative position errors as whole numbers."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal, InvalidOperation
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.controls.shared.base import Controller, SourceFile, Term, Usage, coverage_violations, nodes_by_axis
from compgen.controls.shared.grids import EquidistantGrid, curve_nodes_mm, equidistant_grid, loss_setting
from compgen.controls.shared.integers import best_integers, lowest_free, travel_weights
from compgen.controls.shared.scanner import check_size
from compgen.controls.shared.terms import ACROSS, one_dimensional_name, one_dimensional_terms
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.files import read_bytes
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import (
    accepts,
    array_schema,
    axis_setting,
    file_setting,
    multiple_of,
    setting,
    whole,
    word_for,
)
from compgen.errors import CompgenWarning, InputError, one_line

# Rows of a set sheet and records of the control's parameter file, and what that file shows about all axes.
#
# The parameter file (``ALL.PRM``) has a line ``%`` at each end, comments starting with ``;``, a line ``PARA101()`` and
# records ``N4101P-2``: number, perhaps a word T, A or K with an index, and the value after P. This is the form of a
# public backup of an M80; no document describes it.


# Mitsubishi machine error compensation: records of the parameter file, settings, tables, and their limits.

#: Increment or absolute system, the same for all sets; unit of the values.
SYSTEM, UNIT = 4000, 1006
#: Parameters of set k have these numbers plus 10 (k - 1).
BASE, OUTPUT, REFERENCE, NEGATIVE, POSITIVE, SCALE, INTERVAL = range(4001, 4008)
SET_STEP, SETS = 10, 10
#: Numbers of compensation values: the last one on most controls, and on an M80.
FIRST_NUMBER, LAST_NUMBER, MOST_NUMBER = 4101, 5124, 5999
#: Values of #1006 as remembered, um.
UNITS_UM = {"A": 10.0, "B": 1.0, "C": 0.1, "D": 0.01, "E": 0.001}
#: Limits for sheets and parameter files: length of the text and of a line.
MOST_CHARACTERS, MOST_IN_LINE = 4_000_000, 500
MOST_IN_SHEET = 1_000_000

_WHOLE = re.compile(r"[+-]?\d{1,9}", re.ASCII)
_DECIMAL = re.compile(r"\d{1,6}(?:\.\d{1,6})?", re.ASCII)
_RECORD = re.compile(r"N(\d{1,6})((?:[A-OQ-Z]\d{1,4})*)P([^\r\n]*)", re.ASCII)

Span = tuple[int, int]


@dataclass(frozen=True)
class ParameterEntry:
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
            raise self.fail(f"expected a whole number from {low} to {high}, got {one_line(self.value)[:30]!r}")
        return int(self.value)

    def interval_mm(self) -> Decimal:
        """Return the value as a division interval, mm."""
        if not _DECIMAL.fullmatch(self.value) or not Decimal(self.value):
            raise self.fail(f"expected an interval in mm as a plain decimal number, got {one_line(self.value)[:30]!r}")
        return Decimal(self.value)


def is_parameter_file(file: SourceFile) -> bool:
    """Whether a text is a parameter file of the control: it starts with ``%``."""
    return file.text.removeprefix("\ufeff").lstrip().startswith("%")


def begins_with_mark(path: Path) -> bool:
    """Whether a file is a parameter file of the control."""
    return is_parameter_file(SourceFile(path, read_bytes(path)[:100].decode("ascii", "replace")))


def sheet_entries(file: SourceFile) -> list[ParameterEntry]:
    """Rows ``#number,value,meaning``; blank lines and lines starting with '#' but no digit (the header) are skipped."""
    check_size(file, MOST_IN_SHEET)
    found = []
    for line, raw in enumerate(file.text.removeprefix("\ufeff").split("\n"), start=1):
        text = raw.strip(" \t\r")
        if len(text) > MOST_IN_LINE or not text.isascii():
            raise file.fail(f"is not a row of a set sheet: {one_line(text[:30])!r} ...", line)
        if text and not re.match(r"#\s*(?!\d)", text):
            found.append(_row(file, line, text))
    return found


def _row(file: SourceFile, line: int, text: str) -> ParameterEntry:
    cells = [cell.strip() for cell in text.split(",", 2)]
    number = cells[0].removeprefix("#").strip()
    if not re.fullmatch(r"\d{1,6}", number, re.ASCII):
        raise file.fail(f"{one_line(cells[0])[:30]!r} is not a parameter number such as #4101", line)
    if len(cells) < 3:
        raise file.fail(
            f"#{number}: expected number, value and meaning, separated by commas (is the file truncated?)", line
        )
    return ParameterEntry(int(number), cells[1], file, line)


def file_entries(file: SourceFile) -> tuple[list[ParameterEntry], int]:
    """Records of a parameter file needed for compensation, and the number of skipped lines.

    InputError with the line for a compensation record that is not understood, and for a truncated file.
    """
    check_size(file, MOST_CHARACTERS)
    lines = [raw.strip(" \t\r") for raw in file.text.removeprefix("\ufeff").split("\n")]
    inside = [number for number, text in enumerate(lines, start=1) if text]
    if len(inside) < 2 or lines[inside[0] - 1] != "%" or lines[inside[-1] - 1] != "%":
        raise file.fail(
            "the '%' at the beginning or end of the file is missing; is the file truncated?",
            inside[-1] if inside else 1,
        )
    found, skipped = [], 0
    for line in inside[1:-1]:
        text = lines[line - 1]
        if text == "%":
            raise file.fail("'%' is only allowed as the first and the last line; it ends the file", line)
        record = _RECORD.fullmatch(text) if len(text) <= MOST_IN_LINE else None
        number = int(record[1]) if record else 0
        if number in (SYSTEM, *range(BASE, FIRST_NUMBER), *range(FIRST_NUMBER, MOST_NUMBER + 1)):
            assert record is not None
            if record[2]:
                raise file.fail(
                    f"#{number} has the word {record[2][:10]}; compensation parameters have no such word", line
                )
            found.append(ParameterEntry(number, record[3].strip(), file, line))
        elif number == UNIT and record is not None:
            if all(entry.number != UNIT for entry in found):
                found.append(ParameterEntry(UNIT, record[3].strip(), file, line))
        elif re.match(r"N\s*[45]\d{3}(?!\d)", text):
            raise file.fail(f"{one_line(text[:30])!r} is not understood; expected a record such as N4101P-2", line)
        else:
            skipped += not text.startswith(";")
    return found, skipped


def by_number(entries: Sequence[ParameterEntry]) -> dict[int, ParameterEntry]:
    """Return entries by their number; InputError for a duplicate number."""
    found: dict[int, ParameterEntry] = {}
    for entry in entries:
        before = found.setdefault(entry.number, entry)
        if before is not entry:
            raise entry.fail(f"is given a second time (first in {before.file.path}:{before.line})")
    return found


@dataclass(frozen=True)
class ControlSet:
    """A set of the control's file: its index 0 ... 9, axis names, numbers, scale and interval as in the file."""

    index: int
    base: str
    output: str
    reference: int
    first: int
    last: int
    scale: int
    interval_mm: Decimal
    entry: ParameterEntry

    @property
    def span(self) -> Span:
        """Numbers that the set uses, including its reference point."""
        return min(self.first, self.reference), max(self.last, self.reference)


@dataclass(frozen=True)
class ControlFile:
    """What the parameter file of the user's control shows; empty if there is none.

    ``absolute`` is the system of all sets (None: not known), ``unit_um`` the unit of the values as given by #1006.
    """

    file: SourceFile | None = None
    absolute: bool | None = None
    unit_um: float | None = None
    sets: tuple[ControlSet, ...] = ()
    last_number: int = LAST_NUMBER
    entries: Mapping[int, ParameterEntry] = field(default_factory=dict)

    def others(self, names: Sequence[str]) -> list[ControlSet]:
        """Return the sets of axes other than ``names``."""
        return [item for item in self.sets if not {item.base, item.output} <= set(names)]


def read_control_file(paths: Sequence[Path]) -> ControlFile:
    """Read the parameter file of the user's control; InputError for anything not understood."""
    if not paths:
        return ControlFile()
    if len(paths) > 1:
        raise InputError("expected one parameter file of the control (ALL.PRM)", file=paths[1])
    content = read_bytes(paths[0])
    file = SourceFile(paths[0], content.decode("ascii", errors="replace"))
    if "\ufffd" in file.text:
        line = file.text[: file.text.index("\ufffd")].count("\n") + 1
        raise file.fail("contains a byte that is not ASCII; a parameter file is ASCII text", line)
    if not is_parameter_file(file):
        raise file.fail("is not a parameter file of the control (ALL.PRM): the first line is not '%'", 1)
    entries = by_number(file_entries(file)[0])
    if SYSTEM not in entries:
        raise file.fail(f"#{SYSTEM} (absolute or incremental system) is missing", 1)
    sets = []
    for index in range(SETS):  # a set without axes is empty, whatever its numbers; the others may be of a rotary axis
        shift = SET_STEP * index
        expected = [entries.get(parameter + shift) for parameter in range(BASE, INTERVAL + 1)]
        present = [entry for entry in expected if entry is not None]
        names = [entry.value for entry in present if entry.number - shift in (BASE, OUTPUT)]
        if not any(names):
            continue
        if len(present) < len(expected) or not all(names):
            message = f"set {index + 1} is incomplete; expected #{BASE + shift} to #{INTERVAL + shift}"
            raise present[0].fail(message)
        reference, negative, positive, scale = (entry.whole(0, 99999) for entry in present[2:6])
        low, high = sorted((negative, positive))
        interval_mm = present[6].interval_mm()
        sets.append(ControlSet(index, names[0], names[1], reference, low, high, scale, interval_mm, present[3]))
    unit_um = UNITS_UM.get(entries[UNIT].value) if UNIT in entries else None
    numbers = [number for number in entries if number >= FIRST_NUMBER]
    full = sorted(numbers) == list(range(FIRST_NUMBER, FIRST_NUMBER + len(numbers)))
    last = max(numbers) if full and numbers else LAST_NUMBER
    return ControlFile(file, entries[SYSTEM].whole(0, 1) == 0, unit_um, tuple(sets), last, entries)


# Settings of ``[controllers.mitsubishi]``: counts of the control, section lengths, free numbers.


#: Smallest step of the division interval.
INTERVAL_QUANTUM_MM = Decimal("0.001")
#: Values per division point (E68 manual p. II-292, C64 manual 9.2).
LOWEST_VALUE, HIGHEST_VALUE = -128, 127


@accepts({"anyOf": [{"type": "boolean"}, {**array_schema({"enum": list(ACROSS)}), "uniqueItems": True}]})
def _across(value: Any) -> tuple[tuple[int, int], ...]:
    """True for all tables of one axis as a function of another, false for none, or a list of names."""
    if isinstance(value, bool):
        return tuple(ACROSS.values()) if value else ()
    if not isinstance(value, list) or any(item not in [*ACROSS] for item in value) or len(set(value)) < len(value):
        raise ValueError(f"expected true, false or a list of {', '.join(map(repr, ACROSS))}")
    return tuple(ACROSS[item] for item in value)


@accepts({"type": "string", "pattern": "^[A-Za-z][A-Za-z0-9]{0,3}$"})
def _name(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9]{0,3}", value, re.ASCII):
        raise ValueError("expected a name of at most four letters and digits")
    return value


@dataclass(frozen=True, kw_only=True)
class MitsubishiSettings:
    """Settings of machine error compensation.

    ``sample`` is the control's parameter file; ``absolute`` says whether values are sums up to their point (#4000 = 0)
    or steps (1), None: unknown; ``adds`` is True if the control adds the numbers (corrections), False if it
    subtracts them; ``across`` are (output, base axis) of the tables of one axis as a function of another.
    """

    sample: ControlFile = file_setting(
        read_control_file,
        several=True,
        key="style_from",
        meaning="parameter file of this control (ALL.PRM): the export keeps its mode, unit, sets, numbers, intervals and "
        "scales, and never overwrites those of other axes",
    )
    absolute: bool | None = setting(
        word_for({"incremental": False, "absolute": True}),
        None,
        key="mode",
        meaning="system of the values (#4000), the same for all axes: incremental or absolute. An export without style_from "
        "requires it",
    )
    setting_unit_um: float = setting(
        toml_files.positive, 1.0, meaning="setting unit of the control; one count is half of it times scale"
    )
    scale: int | None = setting(
        whole(1, 99),
        None,
        meaning="compensation scale factor (sc) of every set; default: that of the control's file, otherwise 1",
    )
    adds: bool = setting(
        word_for({"correction": True, "error": False}),
        key="stores",
        stated="correction",
        meaning="what the values are: the correction, which the control adds, or the error, which it subtracts",
    )
    across: tuple[tuple[int, int], ...] = setting(
        _across,
        key="relative_errors",
        stated=True,
        meaning="tables of one axis as a function of another (straightness, squareness): true, false, or a list, e.g. "
        '["Y(x)"]',
    )
    interval_mm: tuple[float | None, float | None, float | None] = axis_setting(
        multiple_of(INTERVAL_QUANTUM_MM),
        meaning="division interval of each base axis; chosen automatically if not stated",
    )
    loss_mm: float = loss_setting(
        "interpolation loss between division points that does not justify a shorter interval, um at the tool"
    )
    first_number: int = setting(
        whole(FIRST_NUMBER, MOST_NUMBER), FIRST_NUMBER, meaning="first free number for a compensation value"
    )
    last_number: int = setting(
        whole(FIRST_NUMBER, MOST_NUMBER), LAST_NUMBER, meaning="last free number for a compensation value"
    )
    first_set: int = setting(whole(1, SETS), 1, meaning="first free set of parameters, 1 to 10")
    axis_names: tuple[str, str, str] = axis_setting(
        _name, AXES, differ="{}: expected three different names", meaning="names of X, Y, Z on the control"
    )

    @property
    def sign(self) -> int:
        """+1 if the numbers are the correction, -1 if they are the error."""
        return 1 if self.adds else -1

    @property
    def half_unit_mm(self) -> float:
        """One unit of output: half of the setting unit, mm."""
        return 0.5 * self.setting_unit_um * MM_PER_UM

    def scale_of(self, pair: tuple[int, int]) -> int:
        """Scale of a table (output, base axis): from the machine file, else from the control's set, else 1."""
        in_file = self.set_in_file(pair)
        return self.scale or (in_file.scale if in_file is not None and in_file.scale else 1)

    def count_mm(self, pair: tuple[int, int]) -> float:
        """One count of a written table (output, base axis), mm."""
        return self.half_unit_mm * self.scale_of(pair)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """(output, base axis) of the tables: positioning of the three axes first."""
        return [*((axis, axis) for axis in range(3)), *self.across]

    def set_in_file(self, pair: tuple[int, int]) -> ControlSet | None:
        """Return the set in the control's file for a table (output, base axis)."""
        output, base = (self.axis_names[axis] for axis in pair)
        return next((item for item in self.sample.sets if (item.output, item.base) == (output, base)), None)

    def kept(self, pair: tuple[int, int]) -> ControlSet | None:
        """Return the control's set whose numbers and interval a table keeps, unless another interval is stated."""
        in_file, stated = self.set_in_file(pair), self.interval_mm[pair[1]]
        same = in_file is not None and (stated is None or Decimal(repr(stated)) == in_file.interval_mm)
        return in_file if same else None

    def kept_at_reference(self, pair: tuple[int, int]) -> int:
        """Return the value of a kept set at its reference number: a constant, which is preserved; else 0."""
        kept = self.kept(pair)
        entry = None if kept is None else self.sample.entries.get(kept.reference)
        return 0 if entry is None or not entry.value else entry.whole(LOWEST_VALUE, HIGHEST_VALUE)

    def free_sets(self) -> list[int]:
        """Return the sets (0 to 9) not used by a table in the control's file, from ``first_set`` on."""
        used = {item.index for item in self.sample.sets}
        return [index for index in range(self.first_set - 1, SETS) if index not in used]


def read_mitsubishi_settings(machine: Machine) -> MitsubishiSettings:
    """Read and check ``[controllers.mitsubishi]``.

    Every key except ``mode`` has a default; an export needs ``mode`` unless the control's file is given.
    """
    section = machine.controller_settings("mitsubishi")
    settings = toml_files.read_settings(MitsubishiSettings, section)
    sample = settings.sample
    shown = {"setting_unit_um": sample.unit_um or 1.0, "last_number": sample.last_number, "absolute": sample.absolute}
    settings = toml_files.unless_stated(settings, section, **shown)
    if sample.file is not None and settings.absolute != sample.absolute:
        stated = "absolute" if settings.absolute else "incremental"
        raise section.fail(
            "mode", f"the machine file says {stated!r}, but {sample.file.path} has #4000 = {int(not sample.absolute)}"
        )
    if settings.last_number - settings.first_number + 1 < 3 * len(settings.pairs):
        raise section.fail("last_number", f"leaves too few numbers from #{settings.first_number} on")
    new = [pair for pair in settings.pairs if settings.set_in_file(pair) is None]
    free = settings.free_sets()
    if len(new) > len(free):
        others = ", ".join(f"set {item.index + 1} of {item.base}" for item in sample.others(settings.axis_names))
        used = f" (other axes use {others})" if others else ""
        raise section.fail(
            "first_set",
            f"{len(new)} new sets are needed, but only {len(free)} of the {SETS} sets of the control are free{used}; select the "
            'tables, e.g. relative_errors = ["Y(x)", "X(y)"], or false for positioning only',
        )
    return settings


# Numbers of machine error compensation: tables read from text, the curves they represent, their limits.
#
# Increment system, E60/E68 manual p. II-292 and C64 manual 9.2. On the positive side of the reference point the value of
# point n is (division interval - actual movement) x 2 for a feed from n-1 to n, on the negative side (division interval +
# actual movement) x 2 for a feed from n+1 to n. So with the curve A in units of output, zero at the reference number,
#
#     A[n] = A[n-1] + v[n] on the positive side,   A[n] = A[n+1] - v[n] on the negative side.
#
# In the absolute system (#4000 = 0) the value of a point is A itself plus a constant: the value at the reference number
# only shifts the zero of the axis. The system applies to the sets of all axes.


@dataclass(frozen=True)
class SetTable:
    """One set: the axis ``output`` is corrected as a function of the axis ``base``.

    ``values`` are the numbers as stored for ``first`` ... ``last``; ``reference`` is the number of the reference point;
    ``absolute`` is their system; ``index`` is the number of the set, 0 to 9.
    """

    base: int
    output: int
    reference: int
    first: int
    values: tuple[int, ...]
    scale: int
    interval_mm: Decimal
    absolute: bool = False
    index: int = 0

    @property
    def name(self) -> str:
        """Name such as ``X(y)``."""
        return one_dimensional_name(self.output, self.base)

    @property
    def last(self) -> int:
        """Number farthest on the positive side."""
        return self.first + len(self.values) - 1

    @property
    def curve(self) -> NDArray[np.int64]:
        """Curve A in counts at the numbers ``first`` ... ``last``, zero at the reference number, shape (n,)."""
        at = self.reference - self.first
        values = np.array(self.values, dtype=np.int64)
        if self.absolute:
            return np.asarray(values - values[at], dtype=np.int64)
        above = np.cumsum(values[at + 1 :])
        below = -np.cumsum(values[:at][::-1])[::-1]
        return np.concatenate([below, [0], above]).astype(np.int64)

    @property
    def at_reference(self) -> int:
        """Value at the reference number."""
        return self.values[self.reference - self.first]

    @property
    def along_mm(self) -> FloatArray:
        """Positions of the numbers from the reference point, shape (n,), mm."""
        return np.array([float((self.first + k - self.reference) * self.interval_mm) for k in range(len(self.values))])


@dataclass(frozen=True)
class SetShortfall:
    """Deviation of a table from the request due to the limit of the values, in counts."""

    output: int
    base: int
    missed_counts: float


@dataclass(frozen=True)
class MitsubishiTables:
    """All sets of X, Y, Z; ``shortfalls`` is known only for tables that were built.

    ``others`` are the sets of other axes in a parameter file, as (name, first, last number); ``remarks`` state what was
    kept apart and skipped when reading.
    """

    sets: tuple[SetTable, ...]
    shortfalls: tuple[SetShortfall, ...] = field(default=(), compare=False)
    others: tuple[tuple[str, int, int], ...] = field(default=(), compare=False)
    remarks: tuple[str, ...] = field(default=(), compare=False)


def values_of(curve: NDArray[np.int64], at: int, at_reference: int = 0, *, absolute: bool = False) -> tuple[int, ...]:
    """Return the numbers for a curve (n,) in counts, zero at the index ``at`` where ``at_reference`` is stored."""
    if absolute:
        return tuple(int(value) + at_reference for value in curve)
    steps = np.diff(curve)
    return tuple(int(value) for value in (*steps[:at], at_reference, *steps[at:]))


def parse_tables(settings: MitsubishiSettings, files: Sequence[SourceFile]) -> MitsubishiTables:
    """Read set sheets, or the control's parameter file; ``.json`` files (the plan) are ignored.

    A parameter file given with a sheet must contain the same tables.
    """
    texts = [file for file in files if file.path.suffix.lower() != ".json"]
    if not texts:
        raise InputError("no set sheet or parameter file was given", file=files[0].path if files else None)
    parameter_files = [file for file in texts if is_parameter_file(file)]
    sheets = [file for file in texts if not is_parameter_file(file)]
    if len(parameter_files) > 1:
        raise parameter_files[1].fail("is a second parameter file; give only one")
    if not parameter_files:
        return _sets_of(settings, sheets[0], by_number([entry for file in sheets for entry in sheet_entries(file)]))
    entries, skipped = file_entries(parameter_files[0])
    found = _sets_of(settings, parameter_files[0], by_number(entries), skipped)
    if sheets and parse_tables(settings, sheets).sets != found.sets:
        raise parameter_files[0].fail(f"does not contain the same tables as {sheets[0].path.name}")
    return found


def _sets_of(
    settings: MitsubishiSettings, file: SourceFile, entries: dict[int, ParameterEntry], skipped: int | None = None
) -> MitsubishiTables:
    """Tables from the entries of a sheet or, if ``skipped`` is not None, of a parameter file of the control."""
    if SYSTEM not in entries:
        raise file.fail(f"#{SYSTEM} (absolute or incremental system) is missing", 1)
    absolute = entries[SYSTEM].whole(0, 1) == 0
    if settings.absolute is not None and absolute != settings.absolute:
        stated = "absolute" if settings.absolute else "incremental"
        raise entries[SYSTEM].fail(
            f"{int(not absolute)} selects the {'absolute' if absolute else 'incremental'} system, but the machine file or the "
            f"control's file requires mode = {stated!r}"
        )
    sets, others = [], []
    for number in range(1, SETS + 1):
        table, name = _set_table(settings, entries, number, absolute, skipped is not None)
        sets += [] if table is None else [table]
        others += [] if name is None else [(f"set {number} of {name[0]}", *name[1])]
    if not sets:
        raise file.fail(f"contains no set for the axes {', '.join(settings.axis_names)} (#4001, #4011, ...)", 1)
    if skipped is None:
        return MitsubishiTables(tuple(sets))
    system = "absolute values" if absolute else "increments"
    remarks = [
        f"#{SYSTEM} = {int(not absolute)}: {system}; assumed: a metric machine with the setting unit "
        f"{settings.setting_unit_um:g} um"
    ]
    remarks += [
        f"{set_name(table)}: the value {table.at_reference} at the reference number #{table.reference} only shifts the zero "
        "of the axis by a constant and is not part of the table"
        for table in sets
        if absolute and table.at_reference
    ]
    remarks += [
        f"{name}, numbers {first} to {last}: not in the machine file, kept separate" for name, first, last in others
    ]
    remarks += [f"skipped: {skipped} lines that cannot change a table"] if skipped else []
    return MitsubishiTables(tuple(sets), others=tuple(others), remarks=tuple(remarks))


def _set_table(
    settings: MitsubishiSettings, entries: dict[int, ParameterEntry], number: int, absolute: bool, is_file: bool
) -> tuple[SetTable | None, tuple[str, tuple[int, int]] | None]:
    """Return set ``number`` (1 to 10), None if it is empty; or the name of another axis and the numbers of its set.

    In a parameter file of the control, a set without axes is empty, whatever its numbers.
    """
    shift = SET_STEP * (number - 1)
    expected = {parameter: entries.get(parameter + shift) for parameter in range(BASE, INTERVAL + 1)}
    present = {parameter: entry for parameter, entry in expected.items() if entry is not None}
    names = [present[parameter].value for parameter in (BASE, OUTPUT) if parameter in present]
    if not any(names if is_file else [entry.value for entry in present.values()]):
        return None, None
    first_entry = next(iter(present.values()))
    missing = [f"#{parameter + shift}" for parameter, entry in expected.items() if entry is None or not entry.value]
    if missing:
        raise first_entry.file.fail(f"set {number} is incomplete: {', '.join(missing)} missing", first_entry.line)
    strange = [name for name in names if name not in settings.axis_names]
    if strange:
        name = one_line(strange[0])[:10]
        if not is_file:
            message = f"set {number} belongs to axis {name}, which is not in the machine file; the set is not used"
            warnings.warn(message, CompgenWarning, stacklevel=6)
        numbers = [present[key].whole(0, 99999) for key in (NEGATIVE, POSITIVE, REFERENCE)]
        return None, (name, (min(numbers), max(numbers)))
    first, last = (present[key].whole(FIRST_NUMBER, MOST_NUMBER) for key in (NEGATIVE, POSITIVE))
    reference = present[REFERENCE].whole(FIRST_NUMBER, MOST_NUMBER)
    if not first <= reference <= last:
        raise present[REFERENCE].fail(
            f"the reference number {reference} is outside the numbers {first} to {last} of its set"
        )
    table = SetTable(
        base=settings.axis_names.index(names[0]),
        output=settings.axis_names.index(names[1]),
        reference=reference,
        first=first,
        values=_values(entries, first, last, present[POSITIVE]),
        scale=present[SCALE].whole(0, 99),
        interval_mm=present[INTERVAL].interval_mm(),
        absolute=absolute,
        index=number - 1,
    )
    return table, None


def _values(entries: dict[int, ParameterEntry], first: int, last: int, entry: ParameterEntry) -> tuple[int, ...]:
    missing = [number for number in range(first, last + 1) if number not in entries]
    if missing:
        some = ", ".join(f"#{number}" for number in missing[:5])
        raise entry.fail(f"the set has the numbers {first} to {last}; missing: {some} ({len(missing)} in all)")
    return tuple(entries[number].whole(LOWEST_VALUE, HIGHEST_VALUE) for number in range(first, last + 1))


def sheet_violations(machine: Machine, settings: MitsubishiSettings, tables: MitsubishiTables) -> list[str]:
    """Return exceeded limits: range of values, numbers, overlaps, scale, duplicate pairs, uncovered travel."""
    found = []
    for table in tables.sets:
        what = set_name(table)
        start_mm, end_mm = machine.reference_point_mm[table.base] + table.along_mm[[0, -1]]
        found += coverage_violations(machine, table.base, float(start_mm), float(end_mm), what)
        wide = [value for value in table.values if not LOWEST_VALUE <= value <= HIGHEST_VALUE]
        if wide:
            most = max(map(abs, wide))
            cure = f"; set scale = {-(-most * table.scale // HIGHEST_VALUE)} or more" if table.absolute else ""
            found.append(f"{what}: the value {most} is outside {LOWEST_VALUE} ... {HIGHEST_VALUE}{cure}")
        if table.last > settings.last_number:
            found.append(f"{what}: numbers go up to {table.last}; the last free number is {settings.last_number}")
        if table.scale == 0:
            found.append(f"{what}: the scale is 0, so the table has no effect")
        kept = settings.kept_at_reference((table.output, table.base))
        if table.at_reference != kept:
            kept_from = " as in the control's file" if kept else ""
            found.append(f"{what}: the value at the reference number {table.reference} must be {kept}{kept_from}")
    for one, other in combinations(tables.sets, 2):
        if one.first <= other.last and other.first <= one.last:
            found.append(f"the numbers of {set_name(one)} and {set_name(other)} overlap")
        if (one.base, one.output) == (other.base, other.output):
            found.append(f"{set_name(one)} is given in two sets")
    others = [
        *tables.others,
        *((f"set {k.index + 1} of {k.base}", *k.span) for k in settings.sample.others(settings.axis_names)),
    ]
    for name, first, last in dict.fromkeys(others):
        for table in tables.sets:
            if table.first <= last and table.last >= first:
                found.append(f"the numbers of {set_name(table)} overwrite those of {name}, {first} to {last}")
    missing = [AXES[axis] for axis in range(3) if not any(t.base == t.output == axis for t in tables.sets)]
    found += [f"{letter} has no positioning table" for letter in missing]
    return found + [shortfall_text(settings, item) for item in tables.shortfalls if item.missed_counts > 1.0]


def set_name(table: SetTable) -> str:
    """Name of a set in messages, e.g. ``the table X(y)``."""
    return f"the table {table.name}"


def shortfall_text(settings: MitsubishiSettings, item: SetShortfall) -> str:
    """Say by how much a table misses the request because of the range of its values, and what helps."""
    count_um = settings.count_mm((item.output, item.base)) / MM_PER_UM
    return (
        f"the table {one_dimensional_name(item.output, item.base)} is too steep for {HIGHEST_VALUE} counts of "
        f"{count_um:g} um per division: it is off by up to {item.missed_counts * count_um:.1f} um; use a larger scale or a "
        "shorter interval_mm"
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


# Template content for machine error compensation: rows of the set sheet, plan, worked example, warnings.


#: Name and meaning of the seven parameters of a set, in the order of their numbers.
MEANINGS = (
    ("cmpax", "base axis"),
    ("drcax", "compensated axis"),
    ("rdvno", "number of the reference point"),
    ("mdvno", "farthest number on the negative side"),
    ("pdvno", "farthest number on the positive side"),
    ("sc", "compensation scale factor"),
    ("spcdv", "division interval in mm"),
)


def _same(old: str, new: str) -> bool:
    try:
        return Decimal(old) == Decimal(new)
    except InvalidOperation:
        return old == new


def _setting_row(number: int, value: str, meaning: str) -> dict[str, str]:
    return {"number": str(number), "value": value, "meaning": meaning}


# Mitsubishi machine error compensation: positioning and relative position errors as a set sheet of whole numbers.
#
# What the control is assumed to do, and how certain that is: see ``templates/mitsubishi/format.toml``.


#: Factor by which the final curve may be steeper than the estimate: angular errors are spread over the volume.
STEEPER = 1.1


class Mitsubishi(Controller[MitsubishiSettings, MitsubishiTables]):
    """Tables of each axis over each axis in counts of half a setting unit, zero at the reference point."""

    name = "mitsubishi"
    settings_class = MitsubishiSettings
    anchored = True
    has_plan = True
    sample_setting = "style_from"

    @classmethod
    def read_settings(cls, machine: Machine) -> MitsubishiSettings:
        """Check ``[controllers.mitsubishi]``."""
        return read_mitsubishi_settings(machine)

    def missing(self) -> InputError | None:
        """Return the error for a mode stated in neither the machine file nor the control's file."""
        if self.settings.absolute is not None:
            return None
        return self.machine.controller_settings(self.name).fail(
            "mode",
            "is missing: #4000 applies to the tables of ALL axes, and the control misreads values of the other system. Give "
            "the control's parameter file (--style-from ALL.PRM), or read #4000 at the control and set mode = 'incremental' "
            "(1) or 'absolute' (0)",
        )

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return one term per set, with the division points as nodes, including the reference point."""
        chosen = [self._grid(errors, axis).nodes_mm for axis in range(3)]
        terms = []
        for pair in self.settings.pairs:
            kept, nodes = self.settings.kept(pair), chosen
            if kept is not None:
                if not kept.first <= kept.reference <= kept.last:
                    raise kept.entry.fail(
                        f"set {kept.index + 1} has the reference number {kept.reference} outside its numbers {kept.first} to "
                        f"{kept.last} and cannot be kept; set interval_mm in the machine file to get new numbers"
                    )
                reference = Decimal(repr(self.machine.reference_point_mm[pair[1]]))
                start = reference + (kept.first - kept.reference) * kept.interval_mm
                nodes = [EquidistantGrid(start, kept.interval_mm, kept.last - kept.first + 1).nodes_mm] * 3
            terms += one_dimensional_terms(self.machine, errors, nodes, [pair], anchored=True)
        return terms

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> MitsubishiTables:
        """Find the best whole curves within the range of the values, and give the sets consecutive numbers."""
        settings = self.settings
        incomplete = self.missing()
        if incomplete is not None:
            raise incomplete
        assert settings.absolute is not None
        terms = {term.name: term for term in basis}
        sets: list[SetTable] = []
        shortfalls: list[SetShortfall] = []
        taken = [item.span for item in settings.sample.sets]
        free = settings.free_sets()
        for pair in settings.pairs:
            output, base = pair
            term = terms[one_dimensional_name(output, base)]
            at = int(np.argmin(np.abs(term.nodes_mm - self.machine.reference_point_mm[base])))
            corrections = np.asarray(values[term.name])
            requested = settings.sign * (corrections - corrections[at]) / settings.count_mm(pair)
            # sums allow steps of any size; violations report values out of range
            limit = int(2 * np.max(np.abs(requested))) + 2 if settings.absolute else HIGHEST_VALUE
            best = best_integers(requested, travel_weights(self.machine, base, term.nodes_mm), at, limit)
            numbers = values_of(best.counts, at, settings.kept_at_reference(pair), absolute=settings.absolute)
            kept, in_file = settings.kept(pair), settings.set_in_file(pair)
            first = lowest_free(taken, settings.first_number, len(numbers)) if kept is None else kept.first
            self._check_free(pair, first, first + len(numbers) - 1)
            taken.append((first, first + len(numbers) - 1))
            index = free.pop(0) if in_file is None else in_file.index
            interval = Decimal(repr(float(term.nodes_mm[1] - term.nodes_mm[0]))).quantize(INTERVAL_QUANTUM_MM)
            scale = settings.scale_of(pair)
            sets.append(SetTable(base, output, first + at, first, numbers, scale, interval, settings.absolute, index))
            if best.limited:
                shortfalls.append(SetShortfall(output, base, best.largest))
        return MitsubishiTables(tuple(sorted(sets, key=lambda table: table.index)), tuple(shortfalls))

    def context(self, tables: MitsubishiTables) -> dict[str, Any]:
        """Return the context beyond the common one; ``rows`` are the sheet's rows, ``plan`` maps number -> value."""
        settings = self.settings
        absolute = tables.sets[0].absolute
        parameters, values = self._rows(tables)
        return {
            "sign_statement": self._sign_statement(tables),
            "parameters": [
                {"name": f"#{row['number']}", "value": row["value"], "meaning": row["meaning"]} for row in parameters
            ],
            "warnings": self._warnings(tables),
            "rows": parameters + values,
            "plan": {
                "parameters": {row["number"]: row["value"] for row in parameters},
                "values": {row["number"]: int(row["value"]) for row in values},
                "setting_unit_um": settings.setting_unit_um,
                "stores": "correction" if settings.adds else "error",
            },
            "tables": [self._summary(table) for table in tables.sets],
            "check": self._check(tables.sets[0]),
            "stores": "correction" if settings.adds else "error",
            "count_um": settings.half_unit_mm / MM_PER_UM,
            "absolute": absolute,
            "has_sample": settings.sample.file is not None,
            "container": "control's file" if settings.sample.file is not None else "sheet",
            "control_file": self._control_file({row["number"]: row["value"] for row in parameters + values}),
            "overwrites": self._overwrites(tables, parameters + values),
        }

    def parse(self, files: Sequence[SourceFile]) -> MitsubishiTables:
        """Read the set sheet or the parameter file of the control; a ``.json`` plan is skipped."""
        return parse_tables(self.settings, files)

    def emulate(self, tables: MitsubishiTables, points: Points) -> FloatArray:
        """Return the sum of the sets' curves, linear between division points, constant beyond the ends."""
        added = np.zeros((len(points), 3))
        for table in tables.sets:
            along = points.position_mm[:, table.base] - self.machine.reference_point_mm[table.base]
            counts = np.interp(along, table.along_mm, table.curve)
            added[:, table.output] += self.settings.sign * self.settings.half_unit_mm * table.scale * counts
        return added

    def violations(self, tables: MitsubishiTables) -> list[str]:
        """Return exceeded limits: values, numbers, overlaps, scale, uncovered travel."""
        return sheet_violations(self.machine, self.settings, tables)

    def table_nodes_mm(self, tables: MitsubishiTables) -> tuple[FloatArray, ...]:
        """Return the division points of each base axis."""
        return nodes_by_axis((t.base, self.machine.reference_point_mm[t.base] + t.along_mm) for t in tables.sets)

    def usage(self, tables: MitsubishiTables) -> list[Usage]:
        """Return the largest value, the numbers and the sets against their limits."""
        return sheet_usage(self.settings, tables)

    def keeping_others(self, tables: MitsubishiTables, files: Sequence[Path]) -> dict[str, dict[str, Any]]:
        """Return ``style_from`` with the parameter file of the control, if it is among the files."""
        found = [] if self.settings.sample.file is not None else list(filter(begins_with_mark, files))
        return {self.name: {"style_from": str(found[0].resolve())}} if len(found) == 1 else {}

    def resolution_mm(self) -> float:
        """Half a count of each table that acts on an axis, where the range of the values is not active."""
        most = max(self.settings.count_mm(pair) for pair in self.settings.pairs)
        return 0.5 * most * max(sum(1 for output, _ in self.settings.pairs if output == axis) for axis in range(3))

    def _control_file(self, rows: dict[str, str]) -> SourceFile | None:
        """The control's parameter file with the rows inserted, every other line unchanged byte for byte."""
        settings = self.settings
        if settings.sample.file is None:
            return None
        lines = settings.sample.file.text.split("\n")
        new = dict(rows)
        for number, entry in settings.sample.entries.items():
            value = new.pop(str(number), None)
            if value is not None and number != SYSTEM:
                line = lines[entry.line - 1]
                line_end = "\r" if line.endswith("\r") else ""
                lines[entry.line - 1] = f"N{number}P{value}{line_end}"
        if new:
            raise settings.sample.file.fail(
                f"has no #{next(iter(new))}, which the tables need; set last_number or first_set in the machine file"
            )
        return SourceFile(settings.sample.file.path, "\n".join(lines))

    def _overwrites(self, tables: MitsubishiTables, rows: list[dict[str, str]]) -> list[str]:
        """Say what the sheet and file overwrite, other axes first."""
        sample = self.settings.sample
        others = [
            f"set {item.index + 1} ({item.output} over {item.base}, numbers {item.span[0]} to {item.span[1]})"
            for item in sample.others(self.settings.axis_names)
        ]
        if sample.file is None:
            found = [
                "Of other axes: NOT KNOWN, because the control's parameter file was not given (`--style-from ALL.PRM`). If "
                f"another axis uses one of the sets or numbers below, its data are lost; #{SYSTEM} changes how the control "
                "reads the values of every axis."
            ]
        else:
            found = [
                f"Of other axes: nothing. {'Kept: ' + '; '.join(others) if others else 'No other axis has a set'}."
            ]
        for table in tables.sets:
            first = BASE + SET_STEP * table.index
            numbers = f"#{table.first} to #{table.last}"
            pair = table.name
            found.append(f"Set {table.index + 1} (#{first} to #{first + 6}) and numbers {numbers}: {pair}")
        changed = [
            row
            for row in rows
            if (old := sample.entries.get(int(row["number"]))) and not _same(old.value, row["value"])
        ]
        if sample.file is not None:
            parameters = [
                f"#{row['number']} = {row['value']} (was {sample.entries[int(row['number'])].value or 'empty'})"
                for row in changed
                if int(row["number"]) < FIRST_NUMBER
            ]
            found.append(f"Parameters that change: {', '.join(parameters) or 'none'}")
            found.append(f"Values that change: {len(changed) - len(parameters)}")
        for table in tables.sets:
            constant = table.at_reference * self.settings.half_unit_mm * table.scale / MM_PER_UM
            if table.absolute and constant:
                found.append(
                    f"The value at the reference number #{table.reference} stays {table.at_reference}: a constant of "
                    f"{constant:g} um in all values of {table.name}, which shifts the zero "
                    "of the axis as before"
                )
            in_file = self.settings.set_in_file((table.output, table.base))
            old = None if in_file is None else sample.entries.get(in_file.reference)
            if table.absolute and not table.at_reference and old is not None and not _same(old.value or "0", "0"):
                found.append(
                    f"The value at the reference number #{old.number} was {old.value} and is now 0: "
                    f"{AXES[table.output]} shifts by a constant; set the workpiece zero again"
                )
        cleared = [f"set {item.index + 1} ({item.output} over {item.base})" for item in self._no_longer_used(tables)]
        if cleared:
            found.append(f"Switched off, because this export has no such table: {', '.join(cleared)}")
        return found

    def _no_longer_used(self, tables: MitsubishiTables) -> list[ControlSet]:
        """Sets of X, Y, Z in the control's file that contain none of the tables: they would act in addition."""
        written = {table.index for table in tables.sets}
        others = self.settings.sample.others(self.settings.axis_names)
        return [item for item in self.settings.sample.sets if item.index not in written and item not in others]

    def _rows(self, tables: MitsubishiTables) -> tuple[list[dict[str, str]], list[dict[str, str]]]:
        """Rows of the sheet: set parameters and values."""
        names, absolute = self.settings.axis_names, tables.sets[0].absolute
        known = "is the control's value" if self.settings.sample.file is not None else "must be the control's value"
        system = f"Pinc: {'absolute values' if absolute else 'increments'}; applies to the sets of ALL axes, {known}"
        parameters, values = [_setting_row(SYSTEM, str(int(not absolute)), system)], []
        for table in tables.sets:
            numbers = (table.reference, table.first, table.last, table.scale)
            cells = (names[table.base], names[table.output], *map(str, numbers), f"{table.interval_mm:.3f}")
            parameters += [
                _setting_row(BASE + k + SET_STEP * table.index, cell, f"{name}: {meaning}; set {table.index + 1}")
                for k, (cell, (name, meaning)) in enumerate(zip(cells, MEANINGS, strict=True))
            ]
            positions = self.machine.reference_point_mm[table.base] + table.along_mm
            values += [
                _setting_row(table.first + k, str(value), f"{table.name} at {AXES[table.base]} {positions[k]:.3f} mm")
                for k, value in enumerate(table.values)
            ]
        for item in self._no_longer_used(tables):
            parameters += [
                _setting_row(BASE + k + SET_STEP * item.index, "", f"set {item.index + 1} is no longer used")
                for k in (0, 1)
            ]
        return parameters, values

    def _summary(self, table: SetTable) -> dict[str, Any]:
        ends = self.machine.reference_point_mm[table.base] + table.along_mm
        return {
            "pair": table.name,
            "first": table.first,
            "last": table.last,
            "reference": table.reference,
            "interval_mm": float(table.interval_mm),
            "first_mm": float(ends[0]),
            "last_mm": float(ends[-1]),
            "largest": max(map(abs, table.values)),
        }

    def _sign_statement(self, tables: MitsubishiTables) -> str:
        settings = self.settings
        stored = "the correction" if settings.adds else "the error"
        scales = sorted({table.scale for table in tables.sets})
        count_um = settings.half_unit_mm * scales[0] / MM_PER_UM
        count = (
            f"one count is {count_um:g} um (half of the setting unit {settings.setting_unit_um:g} um, times the scale "
            f"{', '.join(map(str, scales))})"
        )
        if tables.sets[0].absolute:
            return (
                f"The values are {stored} at their division point, zero at the reference point (absolute values, #4000 = 0); "
                f"{count}. An axis whose actual position at a point is {20 * count_um:g} um too low gets "
                f"{20 * settings.sign:+d} there (scale {scales[0]})."
            )
        return (
            f"The values are {stored}, as steps from one division point to the next away from the reference point (increments, "
            f"#4000 = 1); {count}. An axis that travels {20 * count_um:g} um too little over one interval, in either direction "
            f"away from the reference point, gets {20 * settings.sign:+d} there (scale {scales[0]})."
        )

    def _warnings(self, tables: MitsubishiTables) -> list[str]:
        system = (
            f"#{SYSTEM} applies to the tables of ALL axes. Read it at the control first: if it is not "
            f"{int(not tables.sets[0].absolute)}, do not enter the sheet; set mode in the machine file and export again."
        )
        return [
            "The parameter numbers of the M series are from memory; no document was read. Compare them with the parameter "
            "manual of the control before you enter anything.",
            *([] if self.settings.sample.file is not None else [system]),
            "The direction of the values on the negative side follows from the formula of the manual, not from an example: "
            "check it at one division on each side (section 3).",
            *(shortfall_text(self.settings, item) for item in tables.shortfalls if item.missed_counts <= 1.0),
        ]

    def _check(self, table: SetTable) -> dict[str, Any]:
        """Trial of one division next to the reference point: which number to set, and the laser reading to expect."""
        upper = table.last > table.reference
        number = table.reference + (1 if upper else -1)
        start_mm = self.machine.reference_point_mm[table.base]
        counts = min(20, HIGHEST_VALUE)
        step_mm = float(table.interval_mm) * (1 if upper else -1)
        outwards = 1 if upper or table.absolute else -1
        moved = self.settings.sign * counts * self.settings.half_unit_mm * table.scale / MM_PER_UM * outwards
        return {
            "axis": AXES[table.base],
            "number": number,
            "from_mm": start_mm,
            "to_mm": start_mm + step_mm,
            "counts": counts,
            "change_um": moved,
            "other_change_um": moved if table.absolute else -moved,
            "both_sides": table.first < table.reference < table.last,
            "other_number": table.reference - 1,
            "other_to_mm": start_mm - float(table.interval_mm),
            "interval_mm": float(table.interval_mm),
        }

    def _check_free(self, pair: tuple[int, int], first: int, last: int) -> None:
        """Reject numbers used by a set of another table in the control's file."""
        in_file = self.settings.set_in_file(pair)
        for item in self.settings.sample.sets:
            low, high = item.span
            if item is not in_file and first <= high and last >= low:
                raise item.entry.fail(
                    f"set {item.index + 1} ({item.output} over {item.base}) uses the numbers {low} to {high}; {first} to {last} "
                    f"of {one_dimensional_name(*pair)} would overwrite them. Set interval_mm to get new numbers"
                )

    def _grid(self, errors: ErrorTable, axis: int) -> EquidistantGrid:
        """Division points of a base axis: equal intervals in whole 0.001 mm, equal shares of the numbers for each set.

        The interval is the user's, else the widest that has no significant loss and keeps every value, with a margin,
        within its range, as far as there are enough numbers.
        """
        settings = self.settings
        new = [pair for pair in settings.pairs if settings.kept(pair) is None]
        used = sum(item.span[1] - item.span[0] + 1 for item in settings.sample.sets)
        most = max(3, (settings.last_number - settings.first_number + 1 - used) // max(len(new), 1))

        def grid_of(step_mm: float | None) -> EquidistantGrid:
            output = None if settings.across else axis
            return equidistant_grid(
                self.machine,
                errors,
                axis,
                most=most,
                step_mm=step_mm,
                anchor=True,
                loss_mm=settings.loss_mm,
                output=output,
            )

        requested_mm = settings.interval_mm[axis]
        if requested_mm is not None:
            return grid_of(requested_mm)
        grid = grid_of(None)
        largest = 0.0  # change of a correction over one interval, in counts; it is proportional to the interval
        if not settings.absolute:
            fine = np.unique(np.concatenate([grid.nodes_mm, curve_nodes_mm(self.machine, errors, axis)]))
            pairs = [pair for pair in settings.pairs if pair[1] == axis]
            for term, pair in zip(one_dimensional_terms(self.machine, errors, [fine] * 3, pairs), pairs, strict=True):
                steepest = float(np.max(np.abs(np.diff(term.start) / np.diff(fine)))) / settings.count_mm(pair)
                largest = max(largest, steepest * float(grid.step))
        share = min(1.0, (HIGHEST_VALUE - 1) / max(STEEPER * largest, 1e-9))
        if share == 1.0 and not grid.step % INTERVAL_QUANTUM_MM:
            return grid
        rounding = ROUND_CEILING if share == 1.0 else ROUND_FLOOR
        quanta = (grid.step * Decimal(repr(share)) / INTERVAL_QUANTUM_MM).to_integral_value(rounding=rounding)
        # Two nodes fewer: with the reference point as a node, each end may need one more.
        least = Decimal(repr(self.machine.axes[axis].length_mm)) / max(most - 3, 1) / INTERVAL_QUANTUM_MM
        return grid_of(float(max(quanta, least.to_integral_value(rounding=ROUND_CEILING)) * INTERVAL_QUANTUM_MM))
