"""Settings, numbers and text of the KinematicsComp draft: .COM files with C1 to C6, rows with a column COMPTAB."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import numpy as np

from compgen.controllers.base import SourceFile
from compgen.controllers.grids import take_loss_mm
from compgen.controllers.heidenhain.settings import MOST_ENTRIES, POSITION, take_names
from compgen.controllers.heidenhain.tables import file_stem
from compgen.controllers.heidenhain.text import NUMBER_COLUMN, Row, TextTable, own_layout, read_table
from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, CURVE_NAMES, SQUARENESS_NAMES, error_named
from compgen.errors import InputError

#: Errors of the columns C1 to C6 by axis.
COLUMNS = tuple(tuple(name for name in CURVE_NAMES if name[2] == letter) for letter in AXES)
#: Entries in COMPTAB, from which every MachAxis row is deducted (p. 686).
MOST_COMPTAB = 100
MARGIN_MM = Decimal(10)


@dataclass(frozen=True)
class DraftSettings:
    """Settings ``[controllers.heidenhain-kinematics]``.

    Parameters
    ----------
    axis_names : names of X, Y, Z on the control; rotations are named A, B, C.
    prefixes : what stands before ``..C1`` in COMPTAB for the .COM file of each axis.
    degrees : whether angles are written in degrees, else in rad.
    decimals, angle_decimals : digits after the point of mm and of angles.
    loss_mm : loss by interpolation, as a displacement of the tool, that is worth no further node.
    max_points : entries that a .COM file may have.
    """

    axis_names: tuple[str, str, str]
    prefixes: tuple[str, str, str]
    degrees: bool
    decimals: int
    angle_decimals: int
    loss_mm: float
    max_points: int

    @property
    def rad_per_unit(self) -> float:
        """Size of the unit of angles, rad."""
        return math.radians(1.0) if self.degrees else 1.0

    def written(self, value: float, *, angular: bool) -> Decimal:
        """Return a value (mm or rad) rounded in the unit of the file."""
        decimals = self.angle_decimals if angular else self.decimals
        scaled = value / self.rad_per_unit if angular else value
        return Decimal(int(np.rint(scaled * 10**decimals))).scaleb(-decimals)


def read_draft_settings(machine: Machine) -> DraftSettings:
    """Read and check ``[controllers.heidenhain-kinematics]``; every key has a default."""
    section = machine.controller_settings("heidenhain-kinematics")
    degrees = section.take("angle_unit", tomlio.choice("deg", "rad"), "deg") == "deg"
    settings = DraftSettings(
        axis_names=take_names(section),
        prefixes=_prefixes(section),
        degrees=degrees,
        decimals=section.take("decimals", tomlio.whole(3, 6), 4),
        angle_decimals=section.take("angle_decimals", tomlio.whole(5, 9), 7 if degrees else 9),
        loss_mm=take_loss_mm(section),
        max_points=section.take("max_points", tomlio.whole(4, 100_000), MOST_ENTRIES),
    )
    section.finish()
    return settings


def _prefixes(section: tomlio.Section) -> tuple[str, str, str]:
    part = section.section("comptab_prefix", required=False)
    x, y, z = (part.take(letter, _prefix, letter) for letter in AXES)
    part.finish()
    if len({x, y, z}) < 3:
        raise section.fail("comptab_prefix", f"{x}, {y}, {z}: three different names are due")
    return x, y, z


def _prefix(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"[A-Za-z0-9_]{1,12}", value, re.ASCII):
        raise ValueError("a name of letters and digits is expected")
    return value


@dataclass(frozen=True)
class DraftTable:
    """One .COM file: positions, and entries by column number 1 to 6 in the unit of the file."""

    positions: tuple[Decimal, ...]
    columns: Mapping[int, tuple[Decimal, ...]]

    @property
    def nodes_mm(self) -> FloatArray:
        """Positions, shape (n,), mm."""
        return np.array([float(position) for position in self.positions])


@dataclass(frozen=True)
class DraftTables:
    """Tables by axis 0..2, and constants (squareness) by the name of the error, in the unit of the file."""

    tables: Mapping[int, DraftTable]
    constants: Mapping[str, Decimal]

    def errors(self, settings: DraftSettings) -> ErrorTable:
        """Return the entries as errors in mm and rad."""
        curves = {}
        for axis, table in self.tables.items():
            for column, entries in table.columns.items():
                factor = settings.rad_per_unit if column > 3 else 1.0
                value = np.array([float(entry) for entry in entries]) * factor
                curves[COLUMNS[axis][column - 1]] = Curve(table.nodes_mm, value, np.full(len(value), np.nan))
        constants = {name: (float(value) * settings.rad_per_unit, math.nan) for name, value in self.constants.items()}
        return ErrorTable(curves, constants)


def comptab_rows(tables: DraftTables) -> int:
    """Number of entries in COMPTAB: one per column, two per constant (before and after its axis)."""
    return sum(len(table.columns) for table in tables.tables.values()) + 2 * len(tables.constants)


# --- writing ---------------------------------------------------------------------------------------------------------


def draft_context(machine: Machine, settings: DraftSettings, tables: DraftTables) -> dict[str, Any]:
    """Return the context beyond the common one."""
    com = {}
    for axis, letter in enumerate(AXES):
        table = tables.tables.get(axis, DraftTable((Decimal(0), Decimal(1)), {}))
        widths = [(NUMBER_COLUMN, 5), (POSITION, 13), *((f"C{k}", 13) for k in range(1, 7))]
        com[letter] = {"layout": own_layout(f"AXIS_{letter}", "COM", widths), "rows": _com_rows(settings, table)}
    header = [(NUMBER_COLUMN, 5), ("DOC", 9), ("KEY", 10), ("AXIS", 14), ("COORD", 9), ("COMPTAB", 16)]
    rows = _chain_rows(machine, settings, tables)
    return {
        "sign_statement": _sign_statement(settings, tables),
        "parameters": [
            {"name": "COMPTAB", "value": str(comptab_rows(tables)), "meaning": "entries; 97 are left with three axes"},
            {"name": "MP4070", "value": "as it is", "meaning": "how often the control works the compensation out"},
        ],
        "warnings": [
            "DRAFT: the maker of the machine must integrate these rows into the kinematics description and check them.",
            f"Whether angles are degrees or rad is not documented; {'degrees' if settings.degrees else 'rad'} are written.",
            "What stands before '..C1' in COMPTAB is not documented; set comptab_prefix.",
        ],
        "com": com,
        "chain_rows": {
            "layout": own_layout("KINCOMP", "TAB", header),
            "rows": [[str(k), *row] for k, row in enumerate(rows)],
        },
        "angle_unit": "deg" if settings.degrees else "rad",
        "tables": [{"axis": AXES[axis], "entries": len(t.positions)} for axis, t in sorted(tables.tables.items())],
    }


def _com_rows(settings: DraftSettings, table: DraftTable) -> list[list[str]]:
    zero = (Decimal(0),) * len(table.positions)
    columns = [[str(k) for k in range(len(table.positions))], [f"{position:.4f}" for position in table.positions]]
    for k in range(1, 7):
        decimals = settings.decimals if k < 4 else settings.angle_decimals
        columns.append([_plain(value, decimals) for value in table.columns.get(k, zero)])
    return [list(row) for row in zip(*columns, strict=True)]


def _plain(value: Decimal, decimals: int) -> str:
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if not text.strip("-0.") else text


def _chain_rows(machine: Machine, settings: DraftSettings, tables: DraftTables) -> list[list[str]]:
    """Cells DOC, KEY, AXIS, COORD, COMPTAB from the tool to the workpiece; errors stand before their axis (p. 680)."""
    rows = []
    for axis in (*reversed(machine.chain.tool_side), *machine.chain.workpiece_side):
        for column in sorted(tables.tables[axis].columns) if axis in tables.tables else ():
            name = COLUMNS[axis][column - 1]
            rows.append([name, "Trans", _direction(settings, name), "", f"{settings.prefixes[axis]}..C{column}"])
        own = [name for name in SQUARENESS_NAMES if name in tables.constants and name[3] == AXES[axis]]
        rows += [_constant(settings, name, tables.constants[name], "") for name in own]
        rows.append(["", "MachAxis", settings.axis_names[axis], "", ""])
        rows += [_constant(settings, name, -tables.constants[name], "-") for name in reversed(own)]
    return rows


def _direction(settings: DraftSettings, name: str) -> str:
    return settings.axis_names[AXES.index(name[1])] if name[1] in AXES else name[1]


def _constant(settings: DraftSettings, name: str, value: Decimal, sign: str) -> list[str]:
    return [sign + name, "Trans", name[1], "", _plain(value, settings.angle_decimals)]


def _sign_statement(settings: DraftSettings, tables: DraftTables) -> str:
    """Sign with a number from the files."""
    for axis, table in sorted(tables.tables.items()):
        if 1 in table.columns:
            node = int(np.argmax(np.abs([float(value) for value in table.columns[1]])))
            value = float(table.columns[1][node])
            example = (
                f" Here: C1 of AXIS_{AXES[axis]}.COM at {float(table.positions[node]):.4f} mm is {value:+.4f} mm, so "
                f"{AXES[axis]} is moved by {-value:+.4f} mm."
            )
            break
    else:
        example = ""
    return (
        "An entry is an error in the sense of ISO 230-1 (tool against workpiece, actual minus nominal) in mm or "
        f"{'degrees' if settings.degrees else 'rad'}; the control is taken to move to target minus error.{example}"
    )


# --- reading ---------------------------------------------------------------------------------------------------------


def parse_draft(settings: DraftSettings, files: Sequence[SourceFile]) -> DraftTables:
    """Read the rows for the kinematics table and the .COM files to which they refer."""
    read = [read_table(file) for file in files]
    chains = [table for table in read if table.kind == "TAB"]
    if len(chains) != 1:
        first = files[0].path if files else None
        raise InputError(f"{len(chains)} files with rows for the kinematics table are given, one is due", file=first)
    coms = {file_stem(table.file.path.name): table for table in read if table.kind == "COM"}
    tables: dict[int, DraftTable] = {}
    constants: dict[str, Decimal] = {}
    for row in chains[0].rows:
        name = row.cells.get("DOC", "")
        if row.cells.get("KEY") == "MachAxis":
            continue
        if name.startswith("-"):
            _check_inverse(chains[0], row, constants.get(name[1:]))
            continue
        if name in SQUARENESS_NAMES:
            constants[name] = _once(chains[0], row, name, constants)
        else:
            axis, column = _reference(settings, chains[0], row, name)
            table = coms.get(f"AXIS_{AXES[axis]}")
            if table is None:
                raise chains[0].file.fail(f"refers to AXIS_{AXES[axis]}.COM, which is not among the files", row.line)
            old = tables.get(axis)
            columns = {**(old.columns if old else {}), column: _entries(table, f"C{column}")}
            tables[axis] = DraftTable(old.positions if old else _positions(table), columns)
    return DraftTables(tables, constants)


def _once(table: TextTable, row: Row, name: str, known: Mapping[str, Decimal]) -> Decimal:
    if name in known:
        raise table.file.fail(f"{name} stands here a second time", row.line)
    return table.number(row, "COMPTAB")


def _check_inverse(table: TextTable, row: Row, constant: Decimal | None) -> None:
    if constant is None or table.number(row, "COMPTAB") != -constant:
        due = "no such constant stands before" if constant is None else f"{-constant} is due"
        raise table.file.fail(f"takes {row.cells['DOC'][1:][:10]} back behind its axis: {due}", row.line)


def _reference(settings: DraftSettings, table: TextTable, row: Row, name: str) -> tuple[int, int]:
    """Axis and column number of a row such as ``EYX Trans Y X..C2``; they must agree with the name of the error."""
    found = re.fullmatch(r"([A-Za-z0-9_]{1,12})\.\.C([1-6])", row.cells.get("COMPTAB", ""), re.ASCII)
    if name not in CURVE_NAMES or row.cells.get("KEY") != "Trans" or found is None:
        raise table.file.fail("a row such as 'EYX Trans Y X..C2' with an error's name in DOC is due", row.line)
    axis = error_named(name).axis
    column = 1 + COLUMNS[axis].index(name)
    due = (settings.prefixes[axis], str(column), _direction(settings, name))
    if (found.group(1), found.group(2), row.cells.get("AXIS")) != due:
        raise table.file.fail(f"{name} is due along {due[2]} with {due[0]}..C{column}", row.line)
    return axis, column


def _positions(table: TextTable) -> tuple[Decimal, ...]:
    found = _entries(table, POSITION)
    for k in range(1, len(found)):
        if found[k] <= found[k - 1]:
            raise table.file.fail(f"{POSITION} {found[k]} does not lie above {found[k - 1]}", table.rows[k].line)
    if len(found) < 2:
        raise table.file.fail(f"holds {len(found)} entries; at least 2 are due", table.header_line)
    return found


def _entries(table: TextTable, column: str) -> tuple[Decimal, ...]:
    if column not in [item.name for item in table.columns]:
        raise table.file.fail(f"the table has no column {column}", table.header_line)
    return tuple(table.number(row, column) for row in table.rows)
