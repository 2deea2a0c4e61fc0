"""Compensation-value tables (.COM) and their assignment (.CMA): what they hold, read from text, and their limits.

[axis of the column in the .COM] = F([axis of the column of the .CMA in which that .COM is named]) (MANUALplus 620
technical manual, p. 718). Several tables may correct one axis; they add up.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal

import numpy as np

from compgen.controllers.base import SourceFile, Usage, coverage_violations
from compgen.controllers.heidenhain.grid import GRADIENT_SHARE, spacing_mm
from compgen.controllers.heidenhain.settings import (
    ACTIVE,
    BACKLASH,
    LARGEST_EXPONENT,
    POSITION,
    SMALLEST_EXPONENT,
    HeidenhainSettings,
)
from compgen.controllers.heidenhain.text import NUMBER_COLUMN, TextTable, read_table
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.errors import CompgenWarning, InputError

#: What an export or the serial transfer of older controls makes of names and extensions.
PREFIXES = ("NOT-ACCEPTED-", "PREVIOUS-")
EXTENSIONS = {"COM": "COM", "V": "COM", "CMA": "CMA", "S": "CMA"}


@dataclass(frozen=True)
class ComTable:
    """One .COM file: entries in mm, as the file has them.

    Parameters
    ----------
    positions : of the input axis, ascending.
    columns : entries by corrected axis 0..2.
    backlash : entries of the column BACKLASH, None if it is blank or not there.
    """

    positions: tuple[Decimal, ...]
    columns: Mapping[int, tuple[Decimal, ...]]
    backlash: tuple[Decimal, ...] | None = None

    @property
    def nodes_mm(self) -> FloatArray:
        """Positions, shape (n,), mm."""
        return np.array([float(position) for position in self.positions])

    def at(self, output: int, position_mm: FloatArray) -> FloatArray:
        """Interpolated entries of a column, the end values outside, shape of ``position_mm``."""
        return np.interp(position_mm, self.nodes_mm, [float(value) for value in self.columns[output]])

    def backlash_at(self, position_mm: FloatArray) -> FloatArray | None:
        """Interpolated entries of the column BACKLASH, None if they are all zero."""
        if self.backlash is None or not any(self.backlash):
            return None
        return np.interp(position_mm, self.nodes_mm, [float(value) for value in self.backlash])

    @property
    def steepest(self) -> float:
        """Largest change of an entry per travel, mm/mm."""
        steps = np.diff(self.nodes_mm)
        slopes = [np.abs(np.diff([float(value) for value in values])) / steps for values in self.columns.values()]
        return float(max((slope.max(initial=0.0) for slope in slopes), default=0.0))


@dataclass(frozen=True)
class ComTables:
    """The active tables by input axis 0..2."""

    tables: Mapping[int, ComTable]

    @property
    def total_points(self) -> int:
        """Entries of all tables together."""
        return sum(len(table.positions) for table in self.tables.values())


def parse_com(settings: HeidenhainSettings, files: Sequence[SourceFile]) -> ComTables:
    """Read a .CMA file and the .COM files that it names."""
    read = [(file, read_table(file)) for file in files]
    assignments = [(file, table) for file, table in read if _kind(file, table) == "CMA"]
    if not assignments:
        first = files[0].path if files else None
        raise InputError("no .CMA file is given; it says which .COM file belongs to which axis", file=first)
    if len(assignments) > 1:
        raise assignments[1][0].fail(f"is a second .CMA file beside {assignments[0][0].path.name}", 1)
    coms: dict[str, tuple[SourceFile, TextTable]] = {}
    for file, table in read:
        if _kind(file, table) == "COM":
            name = file_stem(file.path.name)
            if name in coms:
                raise file.fail(f"is the same table as {coms[name][0].path}", 1)
            coms[name] = file, table
    active = _active(settings, assignments[0][1], set(coms))
    unused = sorted(set(coms) - set(active.values()))
    if unused:
        warnings.warn(
            f"{', '.join(unused)}: not in the active line of the .CMA, not used", CompgenWarning, stacklevel=3
        )
    return ComTables({axis: _com_table(settings, axis, coms[name][1]) for axis, name in sorted(active.items())})


def file_stem(name: str) -> str:
    """Return the name of a file without extension and what an export put before it, in capitals.

    >>> file_stem("NOT-ACCEPTED-axis_y.com")
    'AXIS_Y'
    """
    for prefix in PREFIXES:
        name = name.removeprefix(prefix)
    return name.rsplit(".", 1)[0].upper()


def _kind(file: SourceFile, table: TextTable) -> str:
    """COM or CMA, by the first line of the file, else by the extension of its name."""
    found = EXTENSIONS.get(table.kind) or EXTENSIONS.get(file.path.suffix[1:].upper())
    if found is None:
        raise file.fail("is neither a .COM nor a .CMA table by its first line or its name", 1)
    return found


def _active(settings: HeidenhainSettings, table: TextTable, present: set[str]) -> dict[int, str]:
    """Stem of the .COM file by input axis of the line that is marked; every file that is named must be there."""
    marked: list[int] = []
    lines: list[dict[int, str]] = []
    if ACTIVE not in [column.name for column in table.columns]:
        raise table.file.fail(f"the table has no column {ACTIVE}", table.header_line)
    for row in table.rows:
        mark = row.cells.get(ACTIVE)
        if mark not in (None, "*"):
            raise table.file.fail(f"column {ACTIVE} holds {str(mark)[:20]!r}; '*' or nothing is due", row.line)
        named = {}
        for column, cell in row.cells.items():
            if column not in (NUMBER_COLUMN, ACTIVE):
                named[_axis(settings, table, column, row.line)] = _stem(table, cell, row.line, present)
        lines.append(named)
        marked += [len(lines) - 1] if mark else []
        if len(marked) > 1:
            raise table.file.fail(f"a second line is marked in column {ACTIVE}; exactly one may be active", row.line)
    if not marked:
        raise table.file.fail(f"no line is marked with '*' in column {ACTIVE}", table.header_line)
    if not lines[marked[0]]:
        raise table.file.fail("the active line names no .COM file", table.rows[marked[0]].line)
    return lines[marked[0]]


def _axis(settings: HeidenhainSettings, table: TextTable, column: str, line: int) -> int:
    if column not in settings.axis_names:
        known = ", ".join(settings.axis_names)
        raise table.file.fail(f"column {column} is no axis of the machine file ({known}; see axis_names)", line)
    return settings.axis_names.index(column)


def _stem(table: TextTable, cell: str, line: int, present: set[str]) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,32}\.(COM|V)", cell, re.ASCII | re.IGNORECASE):
        raise table.file.fail(f"{cell[:40]!r} is not the name of a .COM file", line)
    stem = file_stem(cell)
    if stem not in present:
        raise table.file.fail(f"names {cell}, which is not among the given files", line)
    return stem


def _com_table(settings: HeidenhainSettings, axis: int, table: TextTable) -> ComTable:
    """Read the entries of one .COM file over an input axis."""
    if len(table.rows) < 2:
        raise table.file.fail(f"holds {len(table.rows)} entries; at least 2 are due", table.header_line)
    positions = _positions(settings, axis, table)
    filled: dict[int, tuple[Decimal, ...]] = {}
    backlash = None
    for column in table.columns:
        if column.name in (NUMBER_COLUMN, POSITION):
            continue
        first = next((row for row in table.rows if column.name in row.cells), None)
        if first is None:
            continue
        values = tuple(table.number(row, column.name) for row in table.rows)
        if column.name == BACKLASH:
            backlash = values
        elif any(values) or column.name in settings.axis_names:
            filled[_axis(settings, table, column.name, first.line)] = values
    if not filled:
        raise table.file.fail("no column of an axis is filled", table.header_line)
    if backlash is not None and any(backlash) and settings.backlash == "empty":
        message = (
            "the column BACKLASH is filled; say with backlash_column what its values mean (absolute or difference)"
        )
        raise table.file.fail(message, table.header_line)
    return ComTable(positions, filled, backlash)


def _positions(settings: HeidenhainSettings, axis: int, table: TextTable) -> tuple[Decimal, ...]:
    """Positions of the rows, ascending: column AXISPOS, or datum and spacing of the machine file without one."""
    if POSITION in [column.name for column in table.columns]:
        found = [table.number(row, POSITION) for row in table.rows]
        for k in range(1, len(found)):
            if found[k] <= found[k - 1]:
                message = f"{POSITION} {found[k]} does not lie above {found[k - 1]}; positions ascend"
                raise table.file.fail(message, table.rows[k].line)
        return tuple(found)
    datum, exponent = settings.datum_mm[axis], settings.exponent[axis]
    if datum is None or exponent is None:
        raise table.file.fail(
            f"has no column {POSITION}; datum_mm and spacing_exponent of {AXES[axis]} in the machine file are needed",
            table.header_line,
        )
    return tuple(datum + k * spacing_mm(exponent) for k in range(len(table.rows)))


def com_violations(machine: Machine, settings: HeidenhainSettings, tables: ComTables) -> list[str]:
    """Return broken limits: entries, tables, spacing, travel that is left out."""
    found = []
    for axis, table in sorted(tables.tables.items()):
        what = f"the table over {AXES[axis]}"
        if len(table.positions) > settings.max_points:
            found.append(
                f"{what} has {len(table.positions)} entries, the limit is {settings.max_points} (9095 error 3)"
            )
        if settings.older:
            found += _spacing_violations(what, table)
        found += coverage_violations(machine, axis, float(table.positions[0]), float(table.positions[-1]), what)
    if settings.max_total_points is not None and tables.total_points > settings.max_total_points:
        found.append(
            f"all tables have {tables.total_points} entries, the limit is {settings.max_total_points} (9095 error 4)"
        )
    if settings.max_tables is not None and len(tables.tables) > settings.max_tables:
        found.append(f"{len(tables.tables)} tables are needed, the limit is {settings.max_tables} (9095 error 5)")
    return found


def _spacing_violations(what: str, table: ComTable) -> list[str]:
    steps = {b - a for a, b in zip(table.positions, table.positions[1:], strict=False)}
    allowed = {spacing_mm(n) for n in range(SMALLEST_EXPONENT, LARGEST_EXPONENT + 1)}
    if len(steps) == 1 and steps <= allowed:
        return []
    shown = ", ".join(f"{step:f}" for step in sorted(steps)[:3])
    return [f"{what} has the spacing {shown} mm; one power of two times 0.0001 mm is due (6.5536 mm: n = 16)"]


def com_usage(settings: HeidenhainSettings, tables: ComTables) -> list[Usage]:
    """Return entries, their total, tables and slope against the limits, as far as they are known."""
    longest = max(len(table.positions) for table in tables.tables.values())
    found = [Usage("entries of the longest table", longest, settings.max_points, "entries")]
    if settings.max_total_points is not None:
        found.append(Usage("entries of all tables", tables.total_points, settings.max_total_points, "entries"))
    if settings.max_tables is not None:
        found.append(Usage("tables", len(tables.tables), settings.max_tables, "tables"))
    steepest = 100.0 * max(table.steepest for table in tables.tables.values())
    return [*found, Usage("change of an entry per travel", steepest, 100.0 * GRADIENT_SHARE, "%", False)]
