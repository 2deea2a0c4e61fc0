"""HEIDENHAIN KinematicsComp draft (``heidenhain-kinematics``): columns C1 to C6 and rows of the kinematics table."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from typing import Any

import numpy as np

from compgen.controls.heidenhain_com import MOST_ENTRIES, POSITION, check_names, file_stem, name_on_control
from compgen.controls.heidenhain_text import NUMBER_COLUMN, Row, TextTable, default_layout, read_table
from compgen.controls.shared.base import Controller, SourceFile, Term, Usage, coverage_violations, nodes_by_axis
from compgen.controls.shared.grids import loss_setting, uneven_nodes_mm
from compgen.controls.shared.terms import error_terms
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, CURVE_NAMES, SQUARENESS_NAMES, error_named
from compgen.data.toml_files import axis_setting, setting, whole, word_for
from compgen.errors import InputError
from compgen.kinematics.exact_chain import exact_error

# Settings, numbers and text of the KinematicsComp draft: .COM files with C1 to C6, rows with a column COMPTAB.


#: Errors of the columns C1 to C6 by axis.
COLUMNS = tuple(tuple(name for name in CURVE_NAMES if name[2] == letter) for letter in AXES)
#: Limit of entries in COMPTAB; every MachAxis row reduces it by one (p. 686).
MOST_COMPTAB = 100
MARGIN_MM = Decimal(10)


@dataclass(frozen=True, kw_only=True)
class DraftSettings:
    """Settings ``[controllers.heidenhain-kinematics]``; rotations are named A, B, C on the control."""

    degrees: bool = setting(
        word_for({"deg": True, "rad": False}),
        key="angle_unit",
        stated="deg",
        meaning='unit of C4 to C6 and of the constants: "deg" or "rad"',
    )
    axis_names: tuple[str, str, str] = axis_setting(name_on_control, AXES, meaning="names of X, Y, Z on the control")
    prefixes: tuple[str, str, str] = axis_setting(
        name_on_control,
        AXES,
        key="comptab_prefix",
        differ="{}: expected three different names",
        meaning="text before ..C1 in COMPTAB for the .COM file of each axis",
    )
    decimals: int = setting(whole(3, 6), 4, meaning="decimals of C1 to C3 in mm")
    angle_decimals: int = setting(whole(5, 9), 7, meaning="decimals of C4 to C6 (default 7 for deg, 9 for rad)")
    loss_mm: float = loss_setting()
    max_points: int = setting(whole(4, 100_000), MOST_ENTRIES, meaning="largest number of entries in one .COM file")

    @property
    def rad_per_unit(self) -> float:
        """Size of the unit of angles, rad."""
        return math.radians(1.0) if self.degrees else 1.0

    def written(self, value: float, *, angular: bool) -> Decimal:
        """Return a value (mm or rad) in the unit of the file, rounded."""
        decimals = self.angle_decimals if angular else self.decimals
        scaled = value / self.rad_per_unit if angular else value
        return Decimal(int(np.rint(scaled * 10**decimals))).scaleb(-decimals)


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


def _plain(value: Decimal, decimals: int) -> str:
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if not text.strip("-0.") else text


# --- reading ---------------------------------------------------------------------------------------------------------


def _once(table: TextTable, row: Row, name: str, known: Mapping[str, Decimal]) -> Decimal:
    if name in known:
        raise table.file.fail(f"{name} is given a second time", row.line)
    return table.number(row, "COMPTAB")


def _positions(table: TextTable) -> tuple[Decimal, ...]:
    found = _entries(table, POSITION)
    for k in range(1, len(found)):
        if found[k] <= found[k - 1]:
            raise table.file.fail(f"{POSITION} {found[k]} is not above {found[k - 1]}", table.rows[k].line)
    if len(found) < 2:
        raise table.file.fail(f"contains {len(found)} entries; expected at least 2", table.header_line)
    return found


def _entries(table: TextTable, column: str) -> tuple[Decimal, ...]:
    if column not in [item.name for item in table.columns]:
        raise table.file.fail(f"the table has no column {column}", table.header_line)
    return tuple(table.number(row, column) for row in table.rows)


# HEIDENHAIN KinematicsComp as a draft: columns C1 to C6 in a .COM file per axis, and rows for the kinematics table.
#
# Source: iTNC 530 HSCI technical manual (07.2013), p. 666-686, 722. For a linear axis X the columns are C1 EXX, C2 EYX,
# C3 EZX, C4 EAX, C5 EBX, C6 ECX; rows ``Trans`` of the kinematics table refer to them in the column COMPTAB. Points
# that no document settles: see ``templates/heidenhain-kinematics/format.toml``; the machine builder must integrate it.


class HeidenhainKinematics(Controller[DraftSettings, DraftTables]):
    """All 21 errors as columns C1 to C6 and constants of the kinematics table: a draft to be integrated by hand."""

    name = "heidenhain-kinematics"
    settings_class = DraftSettings
    finite_rotations = True

    @classmethod
    def read_settings(cls, machine: Machine) -> DraftSettings:
        """Read ``[controllers.heidenhain-kinematics]``; every key has a default."""
        section = machine.controller_settings(cls.name)
        settings = toml_files.read_settings(DraftSettings, section)
        check_names(section, settings.axis_names)
        if not settings.degrees and "angle_decimals" not in section:
            settings = replace(settings, angle_decimals=9)
        return settings

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return one term per error, with nodes where the curves need them."""
        most = self.settings.max_points - 2
        nodes = [
            uneven_nodes_mm(self.machine, errors, axis, loss_mm=self.settings.loss_mm, most=most) for axis in range(3)
        ]
        return error_terms(self.machine, errors, [np.unique(np.round(part, 4)) for part in nodes])

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> DraftTables:
        """Round the errors in the units of the file; the end values continue beyond the ends."""
        tables: dict[int, DraftTable] = {}
        constants: dict[str, Decimal] = {}
        for term in basis:
            if term.axis is None:
                constants[term.name] = self.settings.written(float(values[term.name][0]), angular=True)
                continue
            nodes = [Decimal(repr(float(node))).quantize(Decimal("0.0001")) for node in term.nodes_mm]
            positions = (nodes[0] - MARGIN_MM, *nodes, nodes[-1] + MARGIN_MM)
            column = 1 + COLUMNS[term.axis].index(term.name)
            entries = tuple(
                self.settings.written(float(v), angular=column > 3) for v in np.pad(values[term.name], 1, "edge")
            )
            table = tables.get(term.axis, DraftTable(positions, {}))
            tables[term.axis] = DraftTable(positions, {**table.columns, column: entries})
        return DraftTables(tables, constants)

    def context(self, tables: DraftTables) -> dict[str, Any]:
        """Return layouts and cells of the .COM files and of the rows for the kinematics table."""
        settings = self.settings
        com = {}
        for axis, letter in enumerate(AXES):
            table = tables.tables.get(axis, DraftTable((Decimal(0), Decimal(1)), {}))
            widths = [(NUMBER_COLUMN, 5), (POSITION, 13), *((f"C{k}", 13) for k in range(1, 7))]
            com[letter] = {"layout": default_layout(f"AXIS_{letter}", "COM", widths), "rows": self._com_rows(table)}
        header = [(NUMBER_COLUMN, 5), ("DOC", 9), ("KEY", 10), ("AXIS", 14), ("COORD", 9), ("COMPTAB", 16)]
        rows = self._chain_rows(tables)
        return {
            "sign_statement": self._sign_statement(tables),
            "parameters": [
                {
                    "name": "COMPTAB",
                    "value": str(comptab_rows(tables)),
                    "meaning": "number of entries; at most 97 with three axes",
                },
                {"name": "MP4070", "value": "unchanged", "meaning": "how often the control computes the compensation"},
            ],
            "warnings": [
                "DRAFT: the machine builder must integrate these rows into the kinematics description and check them.",
                f"The unit of angles is not documented; they are written in {'degrees' if settings.degrees else 'rad'}.",
                "The text before '..C1' in COMPTAB is not documented; set comptab_prefix.",
            ],
            "com": com,
            "chain_rows": {
                "layout": default_layout("KINCOMP", "TAB", header),
                "rows": [[str(k), *row] for k, row in enumerate(rows)],
            },
            "angle_unit": "deg" if settings.degrees else "rad",
            "tables": [{"axis": AXES[axis], "entries": len(t.positions)} for axis, t in sorted(tables.tables.items())],
        }

    def parse(self, files: Sequence[SourceFile]) -> DraftTables:
        """Read the rows for the kinematics table and the .COM files that they refer to."""
        read = [read_table(file) for file in files]
        chains = [table for table in read if table.kind == "TAB"]
        if len(chains) != 1:
            first = files[0].path if files else None
            raise InputError(
                f"{len(chains)} files with rows for the kinematics table were given; expected one", file=first
            )
        coms = {file_stem(table.file.path.name): table for table in read if table.kind == "COM"}
        for item in coms.values():  # also in columns to which no row refers
            for given in item.columns:
                _entries(item, given.name)
        tables: dict[int, DraftTable] = {}
        constants: dict[str, Decimal] = {}
        for row in chains[0].rows:
            name = row.cells.get("DOC", "")
            if row.cells.get("KEY") == "MachAxis":
                continue
            if name.startswith("-"):
                constant = constants.get(name[1:])
                if constant is None or chains[0].number(row, "COMPTAB") != -constant:
                    fault = "there is no such constant before its axis" if constant is None else f"expected {-constant}"
                    raise chains[0].file.fail(f"cancels {name[1:][:10]} after its axis: {fault}", row.line)
                continue
            if name in SQUARENESS_NAMES:
                constants[name] = _once(chains[0], row, name, constants)
            else:
                axis, column = self._reference(chains[0], row, name)
                table = coms.get(f"AXIS_{AXES[axis]}")
                if table is None:
                    raise chains[0].file.fail(
                        f"refers to AXIS_{AXES[axis]}.COM, which is not among the files", row.line
                    )
                old = tables.get(axis)
                columns = {**(old.columns if old else {}), column: _entries(table, f"C{column}")}
                tables[axis] = DraftTable(old.positions if old else _positions(table), columns)
        return DraftTables(tables, constants)

    def emulate(self, tables: DraftTables, points: Points) -> FloatArray:
        """Return minus the error of the tool tip in the chain with the entries as errors: exact finite rotations.

        The control moves to target minus error, evaluated at the commanded position (one step). The squareness
        reference is always X.
        """
        with_reference = replace(self.machine, squareness_reference="X")
        return -exact_error(with_reference, tables.errors(self.settings), points.position_mm, points.tool_mm) + 0.0

    def violations(self, tables: DraftTables) -> list[str]:
        """Return broken limits: entries, rows of the kinematics table, travel not covered."""
        settings = self.settings
        found = []
        for axis, table in sorted(tables.tables.items()):
            what = f"the table over {AXES[axis]}"
            found += coverage_violations(
                self.machine, axis, float(table.positions[0]), float(table.positions[-1]), what
            )
            if len(table.positions) > settings.max_points:
                found.append(f"{what} has {len(table.positions)} entries; the limit is {settings.max_points}")
        rows = comptab_rows(tables)
        if rows > MOST_COMPTAB - 3:
            found.append(f"{rows} entries in COMPTAB; with three MachAxis rows at most {MOST_COMPTAB - 3} are possible")
        return found

    def table_nodes_mm(self, tables: DraftTables) -> tuple[FloatArray, ...]:
        """Return the positions of each table."""
        return nodes_by_axis((axis, table.nodes_mm) for axis, table in tables.tables.items())

    def usage(self, tables: DraftTables) -> list[Usage]:
        """Return entries and COMPTAB rows against the limits."""
        longest = max((len(table.positions) for table in tables.tables.values()), default=0)
        return [
            Usage("entries of the longest table", longest, self.settings.max_points, "entries"),
            Usage("entries in COMPTAB", comptab_rows(tables), MOST_COMPTAB - 3, "entries"),
        ]

    def resolution_mm(self) -> float:
        """Half of the last decimal of three tables in mm, plus that of six angles at a lever of one metre."""
        angle_rad = 0.5 * 10.0**-self.settings.angle_decimals * self.settings.rad_per_unit
        return 3 * 0.5 * 10.0**-self.settings.decimals + 6 * 1000.0 * angle_rad

    def _com_rows(self, table: DraftTable) -> list[list[str]]:
        zero = (Decimal(0),) * len(table.positions)
        columns = [[str(k) for k in range(len(table.positions))], [f"{position:.4f}" for position in table.positions]]
        for k in range(1, 7):
            decimals = self.settings.decimals if k < 4 else self.settings.angle_decimals
            columns.append([_plain(value, decimals) for value in table.columns.get(k, zero)])
        return [list(row) for row in zip(*columns, strict=True)]

    def _chain_rows(self, tables: DraftTables) -> list[list[str]]:
        """Cells DOC, KEY, AXIS, COORD, COMPTAB from tool to workpiece; errors come before their axis (p. 680)."""
        settings = self.settings
        rows = []
        for axis in (*reversed(self.machine.chain.tool_side), *self.machine.chain.workpiece_side):
            for column in sorted(tables.tables[axis].columns) if axis in tables.tables else ():
                name = COLUMNS[axis][column - 1]
                rows.append([name, "Trans", self._direction(name), "", f"{settings.prefixes[axis]}..C{column}"])
            constants = [name for name in SQUARENESS_NAMES if name in tables.constants and name[3] == AXES[axis]]
            rows += [self._constant(name, tables.constants[name], "") for name in constants]
            rows.append(["", "MachAxis", settings.axis_names[axis], "", ""])
            rows += [self._constant(name, -tables.constants[name], "-") for name in reversed(constants)]
        return rows

    def _direction(self, name: str) -> str:
        return self.settings.axis_names[AXES.index(name[1])] if name[1] in AXES else name[1]

    def _constant(self, name: str, value: Decimal, sign: str) -> list[str]:
        return [sign + name, "Trans", name[1], "", _plain(value, self.settings.angle_decimals)]

    def _sign_statement(self, tables: DraftTables) -> str:
        """Sign convention with an example value from the files."""
        settings = self.settings
        for axis, table in sorted(tables.tables.items()):
            if 1 in table.columns:
                node = int(np.argmax(np.abs([float(value) for value in table.columns[1]])))
                value = float(table.columns[1][node])
                example = (
                    f" Example: C1 of AXIS_{AXES[axis]}.COM at {float(table.positions[node]):.4f} mm is {value:+.4f} "
                    f"mm, so the control moves {AXES[axis]} by {-value:+.4f} mm."
                )
                break
        else:
            example = ""
        return (
            "An entry is an error in the sense of ISO 230-1 (tool relative to workpiece, actual minus nominal) in mm "
            f"or {'degrees' if settings.degrees else 'rad'}; the control is assumed to move to target minus "
            f"error.{example}"
        )

    def _reference(self, table: TextTable, row: Row, name: str) -> tuple[int, int]:
        """Axis and column number of a row such as ``EYX Trans Y X..C2``; they must match the name of the error."""
        found = re.fullmatch(r"([A-Za-z0-9_]{1,12})\.\.C([1-6])", row.cells.get("COMPTAB", ""), re.ASCII)
        if name not in CURVE_NAMES or row.cells.get("KEY") != "Trans" or found is None:
            raise table.file.fail("expected a row such as 'EYX Trans Y X..C2' with an error's name in DOC", row.line)
        axis = error_named(name).axis
        column = 1 + COLUMNS[axis].index(name)
        expected = (self.settings.prefixes[axis], str(column), self._direction(name))
        if (found.group(1), found.group(2), row.cells.get("AXIS")) != expected:
            raise table.file.fail(f"expected {name} along {expected[2]} with {expected[0]}..C{column}", row.line)
        return axis, column
