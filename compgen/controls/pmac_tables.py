"""Compensation tables of PMAC and Turbo PMAC as the control keeps them, and their download files."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from compgen.controls.shared.base import SourceFile
from compgen.controls.shared.scanner import content_lines
from compgen.data.csv_files import FloatArray
from compgen.data.messages import one_line

# Compensation tables of PMAC and Turbo PMAC as the control keeps them: whole 1/16 counts that roll over.
#
# Source: PMAC User Manual p. 79-83, PMAC 2 Software Reference p. 207-211, Turbo PMAC Software Reference p. 301-306.


IntArray = NDArray[np.int64]

#: Entries are 1/16 count.
PER_COUNT = 16.0


@dataclass(frozen=True)
class CompTable1D:
    """``DEFINE COMP entries,#source,#target,length``: the table of motor ``motor``.

    ``entries`` (n,): the first is at one spacing (length / n) from the source's zero, where the value is 0 by
    definition; the last is at ``length``. ``desired``: over the commanded position of the source.
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
    """``DEFINE BLCOMP entries,length`` of motor ``motor``: taken off after negative travel only, in addition to Ixx86."""

    motor: int
    length: int
    entries: IntArray

    def at(self, counts: Mapping[int, FloatArray]) -> FloatArray:
        """Interpolated value in 1/16 count, shape (n,)."""
        return rolled(counts[self.motor], self.length, self.entries)


def _cell(counts: FloatArray, span: int, cells: int) -> tuple[np.ndarray, FloatArray]:
    """Cell and share within it of positions (n,) that are rolled over into 0 ... span."""
    ratio = np.mod(counts, span) * (cells / span)
    cell = np.minimum(ratio.astype(np.intp), cells - 1)
    return cell, ratio - cell


def rolled(counts: FloatArray, length: int, entries: IntArray) -> FloatArray:
    """Interpolate entries (n,) that begin one spacing above zero, at positions in counts that roll over.

    >>> rolled(np.array([250.0, -250.0]), 4000, np.array([160, 80, 0, -80, -160, -80, 80, 0])) / 16
    array([5. , 2.5])
    """
    values = np.concatenate([[0.0], entries])
    cell, share = _cell(np.asarray(counts, dtype=np.float64), length, len(entries))
    return np.asarray((1.0 - share) * values[cell] + share * values[cell + 1])


@dataclass(frozen=True)
class PmacTables:
    """What the control has: tables in the order of the file, Ixx86 by motor in 1/16 count, I51 (None: no file says)."""

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
#: Files of other programs: comments, programs, and what has to do with tables or their switches.
_COMMENT = re.compile(r";|//")
_OPEN = re.compile(r"OPEN\b", re.IGNORECASE)
_CLOSE = re.compile(r"CLOSE", re.IGNORECASE)
_OF_TABLES = re.compile(r"(?<!T)COMP\b|\bI ?(?:0?51|[0-9]{1,2}86)\b", re.IGNORECASE)
_NO_COMMA = re.compile(r"(COMP ?[0-9]{1,6}(?:\.[0-9]{1,6})?) ?(?=#)", re.IGNORECASE)
_MOST_MOTOR = 32
_MOST_ENTRIES = 150_000


@dataclass
class _Open:
    """A table whose entries are being read."""

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
            self._once(line, f"I{number}", f"I{number} is set")
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
            raise self.source.fail(f"{what} a second time; the first is in line {first}", line)

    def _define(self, line: int, text: str, match: re.Match[str]) -> None:
        if self.motor is None:
            raise self.source.fail("no motor is addressed; expected #1 (or another) before DEFINE", line)
        backlash, two = bool(match.group(1)), bool(match.group(3))
        self._once(line, f"{'BL' if backlash else ''}#{self.motor}", f"motor {self.motor} gets a table")
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
            raise self.source.fail(f"{text[:80]!r}: sizes and spans are whole numbers above zero", line)
        named = [(self._motor(line, found.group(1)), found.group(2) == "D") for found in sources if found]
        self.open = _Open(line, text, self.motor, backlash, shape, named, [int(word) for word in spans])
        if self.open.count > _MOST_ENTRIES:
            raise self.source.fail(f"{self.open.count} entries; at most {_MOST_ENTRIES} are read", line)

    def _entries(self, line: int, text: str) -> None:
        table = self.open
        assert table is not None
        for word in text.split():
            if not _WHOLE.fullmatch(word) or abs(int(word)) > _LARGEST:
                done = f"{len(table.entries)} of {table.count} entries of the table in line {table.line} are there"
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
    """Return the tables of all files; InputError with file and line for anything malformed or cut."""
    return _joined([_read(source) for source in files])


def _joined(readers: Sequence[_DownloadReader]) -> PmacTables:
    """The tables of all files; a motor has one of each kind."""
    owners: dict[tuple[bool, int], SourceFile] = {}
    for reader in readers:
        for table in (*reader.tables, *reader.backlash):
            first = owners.setdefault((isinstance(table, BacklashTable), table.motor), reader.source)
            if first is not reader.source:
                raise reader.source.fail(f"motor {table.motor} has a table in {first.path.name} already")
    switches = [reader.enabled for reader in readers if reader.enabled is not None]
    return PmacTables(
        tables=tuple(table for reader in readers for table in reader.tables),
        backlash=tuple(table for reader in readers for table in reader.backlash),
        constants={motor: value for reader in readers for motor, value in reader.constants.items()},
        enabled=switches[-1] if switches else None,
    )


def parse_foreign_pmac(files: Sequence[SourceFile]) -> tuple[PmacTables, list[str]]:
    """Return the tables of files that this program did not write, and what was passed over in one line.

    A size may be before the sources without a comma, entries may be separated by commas, comments hold any character.
    Motion and PLC programs and commands that have nothing to do with tables are passed over; a line with a table or its
    switch that is not understood is an InputError.
    """
    readers, passed = [], 0
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
                passed += 1
        readers.append(_complete(reader, len(text.split("\n"))))
    remarks = [f"passed over: commands and programs without a table ({passed} lines)"] if passed else []
    tables = _joined(readers)
    if tables.enabled is None:
        remarks.append("no file sets I51: the tables are taken as switched on")
    return tables, remarks


def _read(source: SourceFile) -> _DownloadReader:
    reader, line = _DownloadReader(source), 0
    for line, text in content_lines(source, ";"):
        reader.take(line, text)
    _complete(reader, line)
    count = len(reader.tables) + len(reader.backlash)
    declared = next((m for text in source.text.split("\n")[:50] if (m := _DECLARED.match(text[:200].strip()))), None)
    if declared and int(declared.group(1)) != count:
        raise source.fail(f"declares {declared.group(1)} tables but holds {count}: it was cut or edited by hand")
    if declared and (reader.enabled is None or not source.text.endswith("\n")):
        raise source.fail("has no I51 at its end: it was cut")
    return reader


def _complete(reader: _DownloadReader, line: int) -> _DownloadReader:
    """Return the reader if its file holds a table, and all of it."""
    if reader.open is not None:
        table = reader.open
        have = f"{len(table.entries)} of {table.count} entries"
        raise reader.source.fail(f"the table in line {table.line} has {have}: the file was cut", line)
    if not reader.tables and not reader.backlash:
        raise reader.source.fail("holds no compensation table")
    return reader
