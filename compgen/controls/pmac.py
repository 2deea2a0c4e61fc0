"""Omron PMAC and Turbo PMAC (``pmac``): leadscrew, cross-axis, two-dimensional and backlash tables, and their files."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.controls.shared.base import Controller, SourceFile, Term, Usage, nodes_by_axis, travel_of
from compgen.controls.shared.grids import equidistant_grid, loss_setting
from compgen.controls.shared.scanner import content_lines
from compgen.controls.shared.tables import along_itself
from compgen.controls.shared.terms import continued, field_on_grid, one_dimensional_terms, product_terms
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import WORTH_MM, Curve, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import (
    accepted,
    accepts,
    axis_setting,
    setting,
    table_schema,
    whole,
    word_for,
)
from compgen.errors import CompgenWarning, InputError, one_line

# Compensation tables of PMAC and Turbo PMAC as stored in the control: whole 1/16 counts that roll over.
#
# Source: PMAC User Manual p. 79-83, PMAC 2 Software Reference p. 207-211, Turbo PMAC Software Reference p. 301-306.


# Compensation tables of PMAC and Turbo PMAC as stored in the control, and their download files.

IntArray = NDArray[np.int64]

#: Entries are 1/16 count.
PER_COUNT = 16.0


@dataclass(frozen=True)
class CompTable1D:
    """``DEFINE COMP entries,#source,#target,length``: the table of motor ``motor``.

    ``entries`` (n,): the first is one spacing (length / n) from the source's zero, where the value is 0 by
    definition; the last is at ``length``. ``desired``: as a function of the source's commanded position.
    """

    motor: int
    source: int
    target: int
    length: int
    entries: IntArray
    desired: bool = True

    def at(self, counts: Mapping[int, FloatArray]) -> FloatArray:
        """Interpolated value in 1/16 count for positions of the motors in counts, each (n,)."""
        return rolled(counts[self.source], self.length, self.entries)


@dataclass(frozen=True)
class CompTable2D:
    """``DEFINE COMP rows.columns,#row,#column,#target,row span,column span``: the table of motor ``motor``.

    ``values`` (rows + 1, columns + 1): row i along the column motor, column j along the row motor, [0, 0] is 0.
    """

    motor: int
    row: int
    column: int
    target: int
    row_span: int
    column_span: int
    values: IntArray
    row_desired: bool = True
    column_desired: bool = True

    def at(self, counts: Mapping[int, FloatArray]) -> FloatArray:
        """Bilinear value in 1/16 count for positions of the motors in counts, each (n,)."""
        rows, columns = (size - 1 for size in self.values.shape)
        j, u = _cell(counts[self.row], self.row_span, columns)
        i, v = _cell(counts[self.column], self.column_span, rows)
        low = (1.0 - u) * self.values[i, j] + u * self.values[i, j + 1]
        high = (1.0 - u) * self.values[i + 1, j] + u * self.values[i + 1, j + 1]
        return np.asarray((1.0 - v) * low + v * high)


@dataclass(frozen=True)
class BacklashTable:
    """``DEFINE BLCOMP entries,length`` of motor ``motor``: subtracted after negative travel only, on top of Ixx86."""

    motor: int
    length: int
    entries: IntArray

    def at(self, counts: Mapping[int, FloatArray]) -> FloatArray:
        """Interpolated value in 1/16 count, shape (n,)."""
        return rolled(counts[self.motor], self.length, self.entries)


def _cell(counts: FloatArray, span: int, cells: int) -> tuple[np.ndarray, FloatArray]:
    """Cell, and fraction within it, of positions (n,) rolled over into 0 ... span."""
    ratio = np.mod(counts, span) * (cells / span)
    cell = np.minimum(ratio.astype(np.intp), cells - 1)
    return cell, ratio - cell


def rolled(counts: FloatArray, length: int, entries: IntArray) -> FloatArray:
    """Interpolate entries (n,) that start one spacing above zero, at positions in counts that roll over.

    >>> rolled(np.array([250.0, -250.0]), 4000, np.array([160, 80, 0, -80, -160, -80, 80, 0])) / 16
    array([5. , 2.5])
    """
    values = np.concatenate([[0.0], entries])
    cell, share = _cell(np.asarray(counts, dtype=np.float64), length, len(entries))
    return np.asarray((1.0 - share) * values[cell] + share * values[cell + 1])


@dataclass(frozen=True)
class PmacTables:
    """Contents of the control: tables in file order, Ixx86 by motor in 1/16 count, I51 (None: not in any file)."""

    tables: tuple[CompTable1D | CompTable2D, ...]
    backlash: tuple[BacklashTable, ...] = ()
    constants: Mapping[int, int] = field(default_factory=dict)
    enabled: bool | None = True


# Reading PMAC download files with ``DEFINE COMP`` and ``DEFINE BLCOMP``, strictly; ``;`` starts a comment.


_DEFINE = re.compile(r"DEFINE ?(BL)?COMP ?([0-9]{1,6})(\.[0-9]{1,6})?,([#0-9D, ]{1,80})", re.IGNORECASE)
_ADDRESS = re.compile(r"#([0-9]{1,2})(?: |$)")
_SOURCE = re.compile(r"#([0-9]{1,2})(D?)")
_WHOLE = re.compile(r"[+-]?[0-9]{1,8}")
_VARIABLE = re.compile(r"I ?([0-9]{1,4}) ?= ?([+-]?[0-9]{1,9})")
_DELETE = re.compile(r"DELETE ?(?:BL|T)?(?:COMP|BUF)|DELETE ?(?:GATHER|ROTARY|LOOKAHEAD)|CLOSE", re.IGNORECASE)
_DECLARED = re.compile(r";\s{0,9}tables:\s{0,9}([0-9]{1,4})\s*$")
_LARGEST = 2**23 - 1
#: Files of other programs: comments, programs, and commands related to tables or their switches.
_COMMENT = re.compile(r";|//")
_OPEN = re.compile(r"OPEN\b", re.IGNORECASE)
_CLOSE = re.compile(r"CLOSE", re.IGNORECASE)
_OF_TABLES = re.compile(r"(?<!T)COMP\b|\bI ?(?:0?51|[0-9]{1,2}86)\b", re.IGNORECASE)
_NO_COMMA = re.compile(r"(COMP ?[0-9]{1,6}(?:\.[0-9]{1,6})?) ?(?=#)", re.IGNORECASE)
_MOST_MOTOR = 32
_MOST_ENTRIES = 150_000


@dataclass
class _Open:
    """Table whose entries are being read."""

    line: int
    head: str
    motor: int
    backlash: bool
    shape: tuple[int, ...]
    sources: list[tuple[int, bool]]
    spans: list[int]
    entries: list[int] = field(default_factory=list)

    @property
    def count(self) -> int:
        """Expected number of entries."""
        if len(self.shape) == 1:
            return self.shape[0]
        return (self.shape[0] + 1) * (self.shape[1] + 1) - 1


@dataclass
class _DownloadReader:
    source: SourceFile
    motor: int | None = None
    open: _Open | None = None
    tables: list[CompTable1D | CompTable2D] = field(default_factory=list)
    backlash: list[BacklashTable] = field(default_factory=list)
    constants: dict[int, int] = field(default_factory=dict)
    seen: dict[str, int] = field(default_factory=dict)
    enabled: bool | None = None

    def take(self, line: int, text: str) -> None:
        """Read one line without its comment."""
        rest = " ".join(text.split())
        if self.open is not None:
            self._entries(line, rest)
            return
        address = _ADDRESS.match(rest)
        if address:
            self.motor = self._motor(line, address.group(1))
            rest = rest[address.end() :].strip()
        if not rest or _DELETE.fullmatch(rest):
            return
        define, variable = _DEFINE.fullmatch(rest), _VARIABLE.fullmatch(rest.upper())
        if define:
            self._define(line, rest, define)
        elif variable:
            number, value = int(variable.group(1)), int(variable.group(2))
            self._once(line, f"I{number}", f"I{number} is set a second time")
            if number == 51 and value in (0, 1):
                self.enabled = value == 1
            elif number % 100 == 86 and 1 <= number // 100 <= _MOST_MOTOR and abs(value) <= _LARGEST:
                self.constants[number // 100] = value
            else:
                message = f"I{number}={value} is not part of compensation; expected I51=1 or Ixx86 (backlash)"
                raise self.source.fail(message, line)
        else:
            shown = one_line(rest)[:60]
            raise self.source.fail(f"{shown!r} is not understood; expected #1, DEFINE COMP 8,4000 or I51=1", line)

    def _motor(self, line: int, word: str) -> int:
        if not 1 <= int(word) <= _MOST_MOTOR:
            raise self.source.fail(f"motor #{word} does not exist; use 1 to {_MOST_MOTOR}", line)
        return int(word)

    def _once(self, line: int, key: str, what: str) -> None:
        first = self.seen.setdefault(key, line)
        if first != line:
            raise self.source.fail(f"{what}; the first is in line {first}", line)

    def _define(self, line: int, text: str, match: re.Match[str]) -> None:
        if self.motor is None:
            raise self.source.fail("no motor is addressed; expected #1 (or another) before DEFINE", line)
        backlash, two = bool(match.group(1)), bool(match.group(3))
        kind = "BLCOMP" if backlash else "COMP"
        self._once(line, f"{kind}#{self.motor}", f"motor {self.motor} has a second {kind} table")
        shape = (int(match.group(2)),) + ((int(match.group(3)[1:]),) if two else ())
        words = [word.strip() for word in match.group(4).upper().split(",")]
        spans = words[-2:] if two else words[-1:]
        sources = [_SOURCE.fullmatch(word) for word in words[: -len(spans)]]
        least, most = (0, 0) if backlash else (1, 3) if two else (0, 2)
        if (
            backlash
            and two
            or not least <= len(sources) <= most
            or not all(sources)
            or not all(map(_WHOLE.fullmatch, spans))
        ):
            raise self.source.fail(f"{text[:80]!r} has wrong arguments; expected {_SYNTAX[backlash, two]}", line)
        if min(shape) < 1 or min(map(int, spans)) < 1 or len(spans) != 1 + two:
            raise self.source.fail(f"{text[:80]!r}: sizes and spans must be whole numbers above zero", line)
        named = [(self._motor(line, found.group(1)), found.group(2) == "D") for found in sources if found]
        self.open = _Open(line, text, self.motor, backlash, shape, named, [int(word) for word in spans])
        if self.open.count > _MOST_ENTRIES:
            raise self.source.fail(f"the table has {self.open.count} entries; at most {_MOST_ENTRIES} are read", line)

    def _entries(self, line: int, text: str) -> None:
        table = self.open
        assert table is not None
        for word in text.split():
            if not _WHOLE.fullmatch(word) or abs(int(word)) > _LARGEST:
                done = f"{len(table.entries)} of {table.count} entries of the table in line {table.line} were read before it"
                shown = one_line(word)[:30]
                raise self.source.fail(f"{shown!r} is not a whole number of 1/16 counts; {done}", line)
            if len(table.entries) == table.count:
                raise self.source.fail(f"{word} is one entry too many for {table.head[:60]!r}", line)
            table.entries.append(int(word))
        if len(table.entries) == table.count:
            self.open = None
            values = np.array(table.entries, dtype=np.int64)
            if table.backlash:
                self.backlash.append(BacklashTable(table.motor, table.spans[0], values))
            else:
                self.tables.append((_line if len(table.shape) == 1 else _sheet)(table, values))


_SYNTAX = {
    (False, False): "DEFINE COMP entries,[#source[D],[#target],]length",
    (False, True): "DEFINE COMP rows.columns,#row[D],[#column[D],[#target],]row span,column span",
    (True, False): "DEFINE BLCOMP entries,length",
    (True, True): "DEFINE BLCOMP entries,length",
}


def _line(table: _Open, values: IntArray) -> CompTable1D:
    source, desired = table.sources[0] if table.sources else (table.motor, False)
    target = table.sources[1][0] if len(table.sources) > 1 else table.motor
    return CompTable1D(table.motor, source, target, table.spans[0], values, desired)


def _sheet(table: _Open, values: IntArray) -> CompTable2D:
    row, column, target = [*table.sources, *[(table.motor, False)] * 3][:3]
    rows, columns = table.shape
    grid = np.concatenate([[0], values]).reshape(rows + 1, columns + 1)
    row_span, column_span = table.spans
    return CompTable2D(table.motor, row[0], column[0], target[0], row_span, column_span, grid, row[1], column[1])


def parse_pmac(files: Sequence[SourceFile]) -> PmacTables:
    """Return the tables of all files; InputError with file and line for anything malformed or truncated."""
    return _joined([_read(source) for source in files])


def _joined(readers: Sequence[_DownloadReader]) -> PmacTables:
    """The tables of all files; a motor has at most one of each kind."""
    owners: dict[tuple[bool, int], SourceFile] = {}
    for reader in readers:
        for table in (*reader.tables, *reader.backlash):
            first = owners.setdefault((isinstance(table, BacklashTable), table.motor), reader.source)
            if first is not reader.source:
                raise reader.source.fail(f"motor {table.motor} already has a table in {first.path.name}")
    switches = [reader.enabled for reader in readers if reader.enabled is not None]
    return PmacTables(
        tables=tuple(table for reader in readers for table in reader.tables),
        backlash=tuple(table for reader in readers for table in reader.backlash),
        constants={motor: value for reader in readers for motor, value in reader.constants.items()},
        enabled=switches[-1] if switches else None,
    )


def parse_foreign_pmac(files: Sequence[SourceFile]) -> tuple[PmacTables, list[str]]:
    """Return the tables of files not written by this program, and one line on what was skipped.

    The size may precede the sources without a comma, commas may separate entries, comments may contain any character.
    Motion and PLC programs and commands unrelated to tables are skipped; a line with a table or its
    switch that is not understood is an InputError.
    """
    readers, skipped = [], 0
    for source in files:
        reader, program = _DownloadReader(source), False
        text = source.text.replace("\r\n", "\n").replace("\r", "\n")
        for line, raw in enumerate(text.split("\n"), start=1):
            code = " ".join(_COMMENT.split(raw, maxsplit=1)[0].split())
            program = (program or bool(_OPEN.match(code))) and not _CLOSE.fullmatch(code)
            if reader.open is not None:
                reader.take(line, code.replace(",", " "))
            elif code and not program and _OF_TABLES.search(code):
                reader.take(line, _NO_COMMA.sub(r"\1,", code))
            elif code and not program and (address := _ADDRESS.fullmatch(code)):
                reader.take(line, address.group())
            elif code:
                skipped += 1
        readers.append(_complete(reader, len(text.split("\n"))))
    remarks = [f"skipped: commands and programs without a table ({skipped} lines)"] if skipped else []
    tables = _joined(readers)
    if tables.enabled is None:
        remarks.append("no file sets I51: the tables are assumed to be switched on")
    return tables, remarks


def _read(source: SourceFile) -> _DownloadReader:
    reader, line = _DownloadReader(source), 0
    for line, text in content_lines(source, ";"):
        reader.take(line, text)
    _complete(reader, line)
    count = len(reader.tables) + len(reader.backlash)
    declared = next((m for text in source.text.split("\n")[:50] if (m := _DECLARED.match(text[:200].strip()))), None)
    if declared and int(declared.group(1)) != count:
        raise source.fail(
            f"declares {declared.group(1)} tables but contains {count}: it is truncated or was edited by hand"
        )
    if declared and (reader.enabled is None or not source.text.endswith("\n")):
        raise source.fail("has no I51 at its end: the file is truncated")
    return reader


def _complete(reader: _DownloadReader, line: int) -> _DownloadReader:
    """Return the reader if its file contains a complete table."""
    if reader.open is not None:
        table = reader.open
        have = f"{len(table.entries)} of {table.count} entries"
        raise reader.source.fail(f"the table in line {table.line} has {have}: the file is truncated", line)
    if not reader.tables and not reader.backlash:
        raise reader.source.fail("contains no compensation table")
    return reader


# Settings ``[controllers.pmac]`` of a machine file, and positions in counts.


_COUNTS_MISSING = (
    "is missing: the tables are in counts of the motors, and only the machine builder's data give the counts per mm; set e.g. "
    "counts_per_mm = { X = 1000.0, Y = 1000.0, Z = 2000.0 } (negative where a motor counts opposite to its axis)"
)


_EACH = table_schema(dict.fromkeys(AXES, accepted(toml_files.number)), AXES)


@accepts({"anyOf": [accepted(toml_files.number), _EACH], "examples": [1000.0]})
def _scales(value: Any) -> tuple[float, float, float]:
    """Counts per mm: one number for all axes, or a table with X, Y and Z; none is zero."""
    if isinstance(value, dict):
        if set(value) != set(AXES):
            raise ValueError("expected one number, or a table { X = ..., Y = ..., Z = ... }")
        x, y, z = (toml_files.number(value[axis]) for axis in AXES)
    else:
        x = y = z = toml_files.number(value)
    if not np.all(np.array([x, y, z])):
        raise ValueError("expected counts per mm other than zero")
    return x, y, z


@dataclass(frozen=True, kw_only=True)
class PmacSettings:
    """Settings ``[controllers.pmac]``; ``desired``: tables are functions of the commanded position of their source."""

    motors_available: int = setting(whole(3, 32), 32, meaning="motors that can have a table (Turbo PMAC 32, PMAC 8)")
    motors: tuple[int, int, int] = axis_setting(
        whole(1, 32),
        (1, 2, 3),
        differ="gives ({}) for X, Y, Z; three different motors are needed",
        meaning="motors of X, Y, Z",
    )
    home_mm: tuple[float, float, float] = axis_setting(
        toml_files.number, (0.0, 0.0, 0.0), meaning="machine coordinates of the motors' zero"
    )
    counts_per_mm: tuple[float, float, float] = setting(
        _scales, meaning="counts of a motor per mm, negative if it counts opposite to its axis"
    )
    two_dimensional: bool = setting(toml_files.flag, False, meaning="write angular errors as two-dimensional tables")
    desired: bool = setting(
        word_for({"desired": True, "actual": False}),
        key="source_position",
        stated="desired",
        meaning="position of the source motor that the tables are functions of: desired (commanded) or actual",
    )
    max_entries: int = setting(whole(8, 100_000), 20_000, meaning="largest number of entries of one table")
    loss_mm: float = loss_setting()

    def counts(self, position_mm: FloatArray) -> Mapping[int, FloatArray]:
        """Return the positions (n,) of the three motors in counts at axis positions (n, 3)."""
        return {
            motor: self.counts_per_mm[axis] * (position_mm[:, axis] - self.home_mm[axis])
            for axis, motor in enumerate(self.motors)
        }

    @property
    def free_motors(self) -> list[int]:
        """Motors without an axis that may have a table."""
        return [number for number in range(1, self.motors_available + 1) if number not in self.motors]


# Layout of PMAC tables: rings of nodes from the motor's zero, with negative travel at the far end.


#: A function or product that moves its target by less than this (rms) needs no table.
NOTHING_MM = 0.02 * MM_PER_UM


@dataclass(frozen=True)
class Ring:
    """Nodes ``number * step`` counts from the motor's zero: over the travel, and one more on each side.

    ``low`` ... ``high`` are the numbers over the travel, ``first`` <= 0 <= ``last`` all numbers in the table; the
    place in the table is ``number`` modulo ``size``.
    """

    axis: int
    step: int
    low: int
    high: int

    @property
    def first(self) -> int:
        """Lowest number in the table."""
        return min(self.low, 0) - 1

    @property
    def last(self) -> int:
        """Highest number in the table."""
        return max(self.high, 0) + 1

    @property
    def size(self) -> int:
        """Number of entries; length / step."""
        return self.last - self.first + 1

    def nodes_mm(self, settings: PmacSettings) -> FloatArray:
        """Positions of the nodes over the travel in mm, ascending."""
        return np.sort(self.to_mm(settings, np.arange(self.low, self.high + 1)))

    def to_mm(self, settings: PmacSettings, numbers: IntArray) -> FloatArray:
        """Positions of nodes in mm."""
        return settings.home_mm[self.axis] + self.step * numbers / settings.counts_per_mm[self.axis]

    def positions_mm(self, settings: PmacSettings) -> FloatArray:
        """Position that gives each place 0 ... size - 1 its value, mm: nodes beyond the travel use the travel end."""
        places = np.arange(self.size)
        numbers = np.where(places <= self.last, places, places - self.size)
        return self.to_mm(settings, np.clip(numbers, self.low, self.high))


def _pair(term: Term) -> tuple[int, int]:
    lever = term.carrier[0].lever
    first, second = sorted((term.axis or 0, lever or 0))
    return first, second


# Texts for PMAC users: sign, what must be set, warnings, and the tables as written by the template.


_ENTRIES_PER_LINE = 10


def table_context(table: CompTable1D | CompTable2D, letters: Mapping[int, str]) -> dict[str, Any]:
    """Return one table as written by the template: command, title, rows of entries."""
    if isinstance(table, CompTable1D):
        mark = "D" if table.desired else ""
        command = f"DEFINE COMP {len(table.entries)},#{table.source}{mark},#{table.target},{table.length}"
        title = f"{_letter(letters, table.target)} over {_letter(letters, table.source)}"
        rows = [
            table.entries[k : k + _ENTRIES_PER_LINE].tolist() for k in range(0, len(table.entries), _ENTRIES_PER_LINE)
        ]
        return {"motor": table.motor, "command": command, "title": title, "rows": rows}
    marks = ["D" if flag else "" for flag in (table.row_desired, table.column_desired)]
    size = f"{table.values.shape[0] - 1}.{table.values.shape[1] - 1}"
    sources = f"#{table.row}{marks[0]},#{table.column}{marks[1]},#{table.target}"
    names = [_letter(letters, motor) for motor in (table.target, table.row, table.column)]
    return {
        "motor": table.motor,
        "command": f"DEFINE COMP {size},{sources},{table.row_span},{table.column_span}",
        "title": f"{names[0]} over {names[1]} (row motor, along each line) and {names[2]} (column motor)",
        "rows": [table.values[0, 1:].tolist(), *table.values[1:].tolist()],
    }


def _letter(letters: Mapping[int, str], motor: int) -> str:
    return letters.get(motor, f"motor {motor}")


# ``pmac``: leadscrew, cross-axis, two-dimensional and backlash tables of PMAC and Turbo PMAC.
#
# Source: PMAC User Manual p. 79-83, PMAC 2 Software Reference p. 207-211, Turbo PMAC Software Reference p. 301-306. The
# tables add to the commanded position of the target; they are zero at the motor's zero and repeat beyond their span.


_MOST_PER_TARGET = 6
_SPAN_SLACK = 1e-6
#: Spacings of a pitch table are divided into at most this many parts to represent a reversal.
_MOST_PARTS = 64


class Pmac(Controller[PmacSettings, PmacTables]):
    """PMAC and Turbo PMAC ``DEFINE COMP``."""

    name = "pmac"
    settings_class = PmacSettings
    anchored = True
    bidirectional = True

    @classmethod
    def read_settings(cls, machine: Machine) -> PmacSettings:
        """Read the settings; ``counts_per_mm`` is required."""
        section = machine.controller_settings(cls.name)
        if "counts_per_mm" not in section:
            raise section.fail("counts_per_mm", _COUNTS_MISSING, kind="missing", instead=1000.0)
        settings = toml_files.read_settings(PmacSettings, section)
        if max(settings.motors) > settings.motors_available:
            raise section.fail(
                "motors",
                f"motor {max(settings.motors)} does not exist; use 1 to {settings.motors_available} (motors_available)",
            )
        return settings

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return the functions and products that get a table: pitch, and as many others as motors allow."""
        curves = [self._curve(errors, output, axis) for output in range(3) for axis in range(3)]
        pitch = [term for term in curves if term.axis == term.carrier[0].output]
        groups = [[term] for term in curves if term.axis != term.carrier[0].output]
        # products by output and pair of axes, levers from the motor's zero; each group fits one two-dimensional table
        sheets: dict[tuple[int, int, int], list[Term]] = {}
        for output in range(3) if self.settings.two_dimensional else ():
            rings = [self._ring_of(k, self._step_mm(errors, k, output)) for k in range(3)]
            nodes = [ring.nodes_mm(self.settings) for ring in rings]
            for term in product_terms(self.machine, errors, nodes, self.settings.home_mm):
                if term.carrier[0].output == output:
                    sheets.setdefault((output, *_pair(term)), []).append(term)
        groups += [group for _, group in sorted(sheets.items())]
        sizes = []  # squared rms over the volume without a constant
        for group in groups:
            levers = [term.carrier[0].lever for term in group]
            lengths = [1.0 if k is None or k > 2 else self.machine.axes[k].length_mm / math.sqrt(12.0) for k in levers]
            sizes.append(sum((float(np.std(t.start)) * length) ** 2 for t, length in zip(group, lengths, strict=True)))
        ranked = sorted(range(len(groups)), key=lambda k: -sizes[k])[: len(self.settings.free_motors)]
        kept = [groups[k] for k in sorted(ranked) if sizes[k] > NOTHING_MM**2]
        terms = pitch + [term for group in kept for term in group]
        return [continued(term, self.machine.axes[term.axis or 0].range_mm) for term in terms]

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> PmacTables:
        """Return the tables, from the highest motor to the lowest, in whole 1/16 counts."""
        free = iter(self.settings.free_motors)
        found: list[CompTable1D | CompTable2D] = []
        products: dict[tuple[int, int, int], list[Term]] = {}
        for term in basis:
            part = term.carrier[0]
            if part.lever is not None:
                products.setdefault((part.output, *_pair(term)), []).append(term)
                continue
            owner = self.settings.motors[part.output] if part.output == term.axis else next(free)
            found.append(self._line(owner, term, np.asarray(values[term.name])))
        for (output, *pair), terms in products.items():
            found.append(self._sheet(next(free), output, (pair[0], pair[1]), terms, values))
        return PmacTables(tuple(sorted(found, key=lambda table: -table.motor)))

    def reversal_in_tables(self, reversal: ReversalCurves) -> ReversalCurves:
        """Only the reversal of an axis along itself goes into tables."""
        return along_itself(reversal)

    def with_reversal(self, tables: PmacTables, reversal: ReversalCurves) -> PmacTables:
        """Return the tables with Ixx86 and, if the reversal varies, a backlash table and half of it in the pitch table.

        With the reversal B the control subtracts -B after negative travel, so both directions are at +B/2 from the
        mean; -(B - B at zero)/2 goes into the pitch table, the rest is a constant. B, both halves and "positive" refer
        to the motor: a motor that counts against its axis sees the same B in its counts.
        """
        lines, backlash, constants = list(tables.tables), [], {}
        for (axis, _), curve in sorted(reversal.curves.items()):
            if np.max(np.abs(curve.value)) < WORTH_MM:
                continue
            motor = self.settings.motors[axis]
            place = next(k for k, t in enumerate(lines) if isinstance(t, CompTable1D) and t.motor == motor)
            lines[place], table, constants[motor] = self._with_backlash(axis, lines[place], curve)
            backlash += [table] if table is not None else []
        backlash.sort(key=lambda table: -table.motor)
        return replace(tables, tables=tuple(lines), backlash=tuple(backlash), constants=constants)

    def context(self, tables: PmacTables) -> dict[str, Any]:
        """Return the tables with their entries, the sign with a worked example, and what must be set."""
        letters = {motor: AXES[axis] for axis, motor in enumerate(self.settings.motors)}
        return {
            "sign_statement": (
                "Entries are in 1/16 count of the target motor. The control ADDS them to its commanded position: 160 adds 10 "
                "counts. The first entry is for the position one spacing above the motor's zero. Negative positions are at the "
                "far end of the table; the last entry is the value at zero."
            ),
            "parameters": self._parameters(tables),
            "warnings": self._warnings(tables),
            "motors": [
                {"letter": letter, "motor": motor, "counts": counts, "home": home}
                for letter, motor, counts, home in zip(
                    AXES, self.settings.motors, self.settings.counts_per_mm, self.settings.home_mm, strict=True
                )
            ],
            "has_sheets": any(isinstance(table, CompTable2D) for table in tables.tables),
            "owners": sorted(table.motor for table in tables.tables),
            "overwrites": self._overwrites(tables),
            "tables": [table_context(table, letters) for table in tables.tables],
            "backlash": [
                {
                    "motor": t.motor,
                    "length": t.length,
                    "letter": letters.get(t.motor, "?"),
                    "entries": t.entries.tolist(),
                }
                for t in tables.backlash
            ],
            "constants": sorted(tables.constants.items()),
            "table_count": len(tables.tables) + len(tables.backlash),
        }

    def parse(self, files: Sequence[SourceFile]) -> PmacTables:
        """Read download files; motors that are not axes in the machine file cannot be sources or targets."""
        settings = self.settings
        if not files:
            raise InputError("no file was given; give a download file such as comp.pmc")
        tables = parse_pmac(files)
        for table in (*tables.tables, *tables.backlash):
            unknown = sorted(_motors(table) - set(settings.motors))
            if unknown:
                raise files[0].fail(
                    f"the table of motor {table.motor} uses motor {unknown[0]}, which is not an axis of the machine file "
                    f"(motors {', '.join(map(str, settings.motors))})"
                )
        return tables

    def parse_foreign(self, files: Sequence[SourceFile]) -> tuple[PmacTables, list[str]]:
        """Read a download file or backup of a real control; tables of other motors are kept separate and named."""
        tables, remarks = parse_foreign_pmac(files)
        known = set(self.settings.motors)
        apart = [t for t in (*tables.tables, *tables.backlash) if not _motors(t) <= known]
        kept = replace(
            tables,
            tables=tuple(t for t in tables.tables if _motors(t) <= known),
            backlash=tuple(t for t in tables.backlash if _motors(t) <= known),
            constants={motor: value for motor, value in tables.constants.items() if motor in known},
        )
        if apart:
            named = "; ".join(f"motor {t.motor} (uses {_listed(_motors(t))})" for t in apart)
            remarks.append(f"tables of motors that are not axes of the machine file, kept separate: {named}")
        if not kept.tables and not kept.backlash:
            raise files[0].fail(f"contains no table for the motors {_listed(known)}; {remarks[-1]}")
        return kept, remarks

    def emulate(self, tables: PmacTables, points: Points) -> FloatArray:
        """Return the sum of all tables of each target, minus the backlash after negative travel of a motor.

        If the last direction of travel is unknown, half of the backlash is subtracted, with a CompgenWarning.
        """
        settings = self.settings
        position = np.asarray(points.position_mm, dtype=np.float64)
        counts = settings.counts(position)
        total = {motor: np.zeros(len(position)) for motor in settings.motors}
        if tables.enabled is not False:
            for table in tables.tables:
                total[table.target] += table.at(counts)
        for motor in settings.motors:
            total[motor] -= self._backlash(tables, motor, counts, points)
        scale = PER_COUNT * np.array(settings.counts_per_mm)
        return np.column_stack([total[motor] for motor in settings.motors]) / scale + 0.0

    def _backlash(self, tables: PmacTables, motor: int, counts: Mapping[int, FloatArray], points: Points) -> FloatArray:
        size = np.full(len(points), float(tables.constants.get(motor, 0)))
        for table in tables.backlash if tables.enabled is not False else ():
            if table.motor == motor:
                size += table.at(counts)
        if not np.any(size):
            return size
        axis = self.settings.motors.index(motor)
        travel = travel_of(points, axis)
        if np.any(travel == 0):
            message = (
                f"motor {motor} has backlash compensation, but some points do not state the direction of approach: half of "
                "the backlash is subtracted there. Give approach_x, approach_y, approach_z"
            )
            warnings.warn(message, CompgenWarning, stacklevel=3)
        return np.asarray(size * 0.5 * (1.0 - np.sign(travel * self.settings.counts_per_mm[axis])))

    def by_direction(self, tables: PmacTables) -> bool:
        """Return whether there is a backlash, as a table or a constant."""
        return bool(tables.backlash) or any(tables.constants.values())

    def violations(self, tables: PmacTables) -> list[str]:
        """Return tables out of order, too long, shorter than the travel, or not enabled."""
        settings = self.settings
        found = [] if tables.enabled else ["I51 is not 1: the tables have no effect"]
        for kind, group in (("COMP", tables.tables), ("BLCOMP", tables.backlash)):
            owners = [table.motor for table in group]
            if owners != sorted(owners, reverse=True):
                found.append(
                    f"{kind} tables are defined in the order of motors {owners}; expected from the highest motor down (ERR003)"
                )
            if owners and max(owners) > settings.motors_available:
                found.append(
                    f"motor {max(owners)} has a {kind} table; the control has {settings.motors_available} motors"
                )
        for table in tables.tables:
            found += self._table_violations(table)
        return found

    def _table_violations(self, table: CompTable1D | CompTable2D) -> list[str]:
        settings = self.settings
        found = []
        if (size := _entries(table)) > settings.max_entries:
            found.append(f"the table of motor {table.motor} has {size} entries; max_entries is {settings.max_entries}")
        for motor, span in _spans(table):
            axis = settings.motors.index(motor)
            low, high = self.machine.axes[axis].range_mm
            ends = sorted(settings.counts_per_mm[axis] * (end - settings.home_mm[axis]) for end in (low, high))
            needed = max(ends[1], 0.0) - min(ends[0], 0.0)
            if needed > span * (1.0 + _SPAN_SLACK):
                found.append(
                    f"the table of motor {table.motor} spans {span} counts of motor {motor}, but the travel "
                    f"needs {needed:g}: positions roll over within the travel"
                )
        # at roll-over the last entry equals the value at zero, and the far edges equal the zero edges
        if isinstance(table, CompTable1D):
            if table.entries[-1]:
                found.append(
                    f"the table of motor {table.motor} ends with {table.entries[-1]}; expected 0: the value jumps at zero"
                )
        elif not np.array_equal(table.values, np.pad(table.values[:-1, :-1], ((0, 1), (0, 1)), mode="wrap")):
            found.append(
                f"the far edges of the table of motor {table.motor} differ from its zero edges: the value jumps at zero"
            )
        return found

    def usage(self, tables: PmacTables) -> list[Usage]:
        """Return the number of motors with a table against the number available, and the longest table."""
        longest = max((_entries(table) for table in tables.tables), default=0)
        return [
            Usage("motors with a COMP table", len(tables.tables), self.settings.motors_available, "tables"),
            Usage("entries of one table", longest, self.settings.max_entries, "entries", stated=False),
        ]

    def anchor_mm(self) -> FloatArray:
        """Return the motors' zero, where every table is zero."""
        return np.array(self.settings.home_mm)

    def table_nodes_mm(self, tables: PmacTables) -> tuple[FloatArray, ...]:
        """Return the positions of the entries over the travel and one beyond, by source."""
        settings = self.settings
        found = []
        for table in (*tables.tables, *tables.backlash):
            for motor, step in _steps(table):
                axis = settings.motors.index(motor)
                ring = self._ring_of(axis, 1.0)
                step_mm = step / abs(settings.counts_per_mm[axis])
                low, high = self.machine.axes[axis].range_mm
                first = np.floor((low - settings.home_mm[axis]) / step_mm)
                last = np.ceil((high - settings.home_mm[axis]) / step_mm)
                found.append((ring.axis, settings.home_mm[axis] + step_mm * np.arange(first, last + 1)))
        return nodes_by_axis(found)

    def resolution_mm(self) -> float:
        """Half of 1/16 count for each table that may act on one axis."""
        most = _MOST_PER_TARGET if self.settings.two_dimensional else 3
        return most * 0.5 / (PER_COUNT * float(np.min(np.abs(self.settings.counts_per_mm))))

    def _ring_of(self, axis: int, step_mm: float) -> Ring:
        """Return the ring of an axis with nodes about ``step_mm`` apart (at least one count)."""
        scale = self.settings.counts_per_mm[axis]
        step = max(1, math.ceil(step_mm * abs(scale) - 1e-6))
        ends = sorted(scale * (end - self.settings.home_mm[axis]) for end in self.machine.axes[axis].range_mm)
        low, high = math.floor(ends[0] / step + 1e-9), math.ceil(ends[1] / step - 1e-9)
        return Ring(axis, step, low, max(high, low + 1))

    def _step_mm(self, errors: ErrorTable, axis: int, output: int) -> float:
        """Widest step from the motor's zero without significant loss."""
        home = list(self.machine.reference_point_mm)
        low, high = self.machine.axes[axis].range_mm
        home[axis] = min(max(self.settings.home_mm[axis], low), high)
        anchored = replace(self.machine, reference_point_mm=(home[0], home[1], home[2]))
        most = min(self.settings.max_entries, 400)
        grid = equidistant_grid(
            anchored, errors, axis, most=most, anchor=True, loss_mm=self.settings.loss_mm, output=output
        )
        return float(grid.step)

    def _curve(self, errors: ErrorTable, output: int, axis: int) -> Term:
        settings = self.settings
        ring = self._ring_of(axis, self._step_mm(errors, axis, output))
        nodes = ring.nodes_mm(settings)
        lines = [nodes if k == axis else np.zeros(1) for k in range(3)]
        origin = settings.home_mm if settings.two_dimensional else None
        term = one_dimensional_terms(self.machine, errors, lines, [(output, axis)], lever_origin_mm=origin)[0]
        home = settings.home_mm[axis]
        if not nodes[0] - 1e-9 <= home <= nodes[-1] + 1e-9:
            return term
        start = term.start - np.interp(home, nodes, term.start)
        return replace(term, start=start, zero_at_mm=float(np.clip(home, nodes[0], nodes[-1])))

    def _ring_from(self, axis: int, nodes_mm: FloatArray) -> Ring:
        """Return the ring with these nodes over the travel."""
        step = round(abs(self.settings.counts_per_mm[axis]) * float(nodes_mm[1] - nodes_mm[0]))
        ring = self._ring_of(axis, step / abs(self.settings.counts_per_mm[axis]))
        return replace(ring, step=step)

    def _sixteenths(self, axis: int, values_mm: FloatArray) -> IntArray:
        """Return displacements of an axis in whole 1/16 counts of its motor."""
        return np.rint(PER_COUNT * self.settings.counts_per_mm[axis] * np.asarray(values_mm)).astype(np.int64)

    def _line(self, owner: int, term: Term, values: FloatArray) -> CompTable1D:
        settings = self.settings
        axis, output = int(term.axis or 0), term.carrier[0].output
        ring = self._ring_from(axis, term.nodes_mm)
        at = self._sixteenths(output, np.interp(ring.positions_mm(settings), term.nodes_mm, values))
        at[0] = 0
        return CompTable1D(
            motor=owner,
            source=settings.motors[axis],
            target=settings.motors[output],
            length=ring.step * ring.size,
            entries=np.append(at[1:], 0),
            desired=settings.desired,
        )

    def _sheet(
        self, owner: int, output: int, pair: tuple[int, int], terms: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> CompTable2D:
        """Two-dimensional table with the row motor of the first axis of the pair; the far edges repeat the zero edges."""
        settings = self.settings
        rings = []
        for axis in pair:  # the ring of its functions, or a wide one if the axis is only a lever
            nodes = next((term.nodes_mm for term in terms if term.axis == axis), None)
            wide_mm = 0.5 * self.machine.axes[axis].length_mm
            rings.append(self._ring_of(axis, wide_mm) if nodes is None else self._ring_from(axis, nodes))
        lines_mm = {
            axis: ring.positions_mm(settings) for axis, ring in zip(reversed(pair), reversed(rings), strict=True)
        }
        inner = self._sixteenths(output, field_on_grid(terms, values, lines_mm, np.zeros(3))[..., output])
        inner[0, 0] = 0
        row, column = (settings.motors[axis] for axis in pair)
        return CompTable2D(
            motor=owner,
            row=row,
            column=column,
            target=settings.motors[output],
            row_span=rings[0].step * rings[0].size,
            column_span=rings[1].step * rings[1].size,
            values=np.pad(inner, ((0, 1), (0, 1)), mode="wrap"),
            row_desired=settings.desired,
            column_desired=settings.desired,
        )

    def _parameters(self, tables: PmacTables) -> list[dict[str, object]]:
        rows: list[tuple[str, object, str]] = [
            ("I51", 1, "compensation tables enabled; set by the last line of the file")
        ]
        for motor, value in sorted(tables.constants.items()):
            rows.append((f"I{motor}86", value, "backlash at the motor's zero, 1/16 count; set by the file"))
        for letter, motor, counts, home in zip(
            AXES, self.settings.motors, self.settings.counts_per_mm, self.settings.home_mm, strict=True
        ):
            meaning = f"the tables assume {counts:g} counts per mm of {letter}, and the motor's zero at {letter} = {home:g} mm"
            rows.append((f"#{motor} -> {letter}", f"{counts:g}", meaning))
        return [{"name": name, "value": value, "meaning": meaning} for name, value, meaning in rows]

    def _overwrites(self, tables: PmacTables) -> list[str]:
        """Say which tables and variables the file overwrites, starting with motors without an axis."""
        of_axes = sorted(table.motor for table in tables.tables if table.motor in self.settings.motors)
        others = sorted(table.motor for table in tables.tables if table.motor not in self.settings.motors)
        names = {motor: letter for letter, motor in zip(AXES, self.settings.motors, strict=True)}
        first = "Of motors that are not X, Y or Z: nothing."
        if others:
            first = (
                f"Of motors that are not X, Y or Z: NOT KNOWN. These get a table: {', '.join(map(str, others))}. List "
                "their tables first: an existing one is lost."
            )
        found = [first, f"The tables of motors {', '.join(f'{motor} ({names[motor]})' for motor in of_axes)}."]
        variables = [
            "I51 (switches the tables of all motors)",
            *(f"I{motor}86" for motor in sorted(tables.constants)),
        ]
        return [*found, f"The variables {', '.join(variables)}."]

    def _warnings(self, tables: PmacTables) -> list[str]:
        found: list[str] = []
        owners = [table.motor for table in tables.tables if table.motor not in self.settings.motors]
        if owners:
            found.append(
                f"The file stores tables for X, Y and Z at the motors {', '.join(map(str, sorted(owners)))}, which are not axes "
                "of the machine file: a table that one of these motors already has on the control is lost."
            )
        if any(isinstance(table, CompTable2D) for table in tables.tables):
            found.append(
                "Two-dimensional tables: the order of the arguments (row motor, column motor, target, row span, column span) "
                "was inferred from remarks in the manuals; check it with section 3 of the preflight list."
            )
        if any(value < 0 for value in tables.constants.values()):
            found.append("A backlash Ixx86 is negative: the position reached in positive travel is the larger one.")
        return found

    def _with_backlash(
        self, axis: int, table: CompTable1D | CompTable2D, curve: Curve
    ) -> tuple[CompTable1D, BacklashTable | None, int]:
        """Pitch table with its part of the reversal, backlash table (None: constant) and Ixx86, in 1/16 count."""
        settings = self.settings
        assert isinstance(table, CompTable1D)
        scale, home = abs(settings.counts_per_mm[axis]), settings.home_mm[axis]
        at_home = float(curve.at(np.array([home]))[0])
        constant = round(-PER_COUNT * scale * at_home)
        if len(curve.position_mm) == 1:
            return table, None, constant
        # the spacing of the pitch table is divided as finely as the reversal needs
        travel, step = self.machine.axes[axis].range_mm, table.length // len(table.entries)
        where = np.clip(np.unique(np.concatenate([np.array(travel), curve.position_mm])), *travel)
        rings = []
        for part in (part for part in range(1, _MOST_PARTS + 1) if step % part == 0):
            ring = self._ring_of(axis, step / part / scale)
            nodes = ring.nodes_mm(settings)
            miss = float(np.max(np.abs(np.interp(where, nodes, curve.at(nodes)) - curve.at(where))))
            rings.append((miss, ring))
            if miss <= WORTH_MM:
                break
        ring = min(rings, key=lambda pair: pair[0])[1]
        counts = {motor: np.zeros(ring.size) for motor in settings.motors}
        counts[table.source] = settings.counts_per_mm[axis] * (ring.positions_mm(settings) - home)
        pitch = np.rint(table.at(counts)).astype(np.int64)
        varying = curve.at(ring.positions_mm(settings)) - at_home
        varying[0] = 0.0
        # In counts of the motor a reversal B is |counts per mm| B, whichever way the motor counts: if it counts
        # against its axis, both the position and the direction of travel change sign.
        size = np.rint(-PER_COUNT * scale * varying).astype(np.int64)
        half = np.rint(-0.5 * PER_COUNT * scale * varying).astype(np.int64)
        entries: IntArray = np.append(pitch[1:] + half[1:], 0)
        length = ring.step * ring.size
        backlash = BacklashTable(settings.motors[axis], length, np.append(size[1:], 0)) if np.any(size) else None
        return replace(table, entries=entries, length=length), backlash, constant


def _motors(table: CompTable1D | CompTable2D | BacklashTable) -> set[int]:
    if isinstance(table, BacklashTable):
        return {table.motor}
    sources = {table.source} if isinstance(table, CompTable1D) else {table.row, table.column}
    return sources | {table.target}


def _listed(motors: set[int]) -> str:
    return ", ".join(f"#{motor}" for motor in sorted(motors))


def _entries(table: CompTable1D | CompTable2D) -> int:
    return len(table.entries) if isinstance(table, CompTable1D) else int(table.values.size) - 1


def _spans(table: CompTable1D | CompTable2D) -> list[tuple[int, int]]:
    if isinstance(table, CompTable1D):
        return [(table.source, table.length)]
    return [(table.row, table.row_span), (table.column, table.column_span)]


def _steps(table: CompTable1D | CompTable2D | BacklashTable) -> list[tuple[int, float]]:
    """Sources and the spacing of their nodes in counts."""
    if isinstance(table, CompTable2D):
        rows, columns = (size - 1 for size in table.values.shape)
        return [(table.row, table.row_span / columns), (table.column, table.column_span / rows)]
    motor = table.motor if isinstance(table, BacklashTable) else table.source
    return [(motor, table.length / len(table.entries))]
