"""HEIDENHAIN KinematicsComp as a draft: columns C1 to C6 in a .COM file per axis, and rows for the kinematics table.

Source: iTNC 530 HSCI technical manual (07.2013), p. 666-686, 722. For a linear axis X the columns are C1 EXX, C2 EYX,
C3 EZX, C4 EAX, C5 EBX, C6 ECX; rows ``Trans`` of the kinematics table refer to them in the column COMPTAB. What no
document settles stands in ``templates/heidenhain-kinematics/format.toml``; the maker of the machine must integrate it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from decimal import Decimal
from typing import Any

import numpy as np

from compgen.controllers.base import Controller, SourceFile, Term, Usage, coverage_violations, nodes_by_axis
from compgen.controllers.grids import uneven_nodes_mm
from compgen.controllers.heidenhain.draft import (
    COLUMNS,
    MARGIN_MM,
    MOST_COMPTAB,
    DraftSettings,
    DraftTable,
    DraftTables,
    comptab_rows,
    draft_context,
    parse_draft,
    read_draft_settings,
)
from compgen.controllers.terms import error_terms
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.core.points import Points
from compgen.model.exact import exact_error


class HeidenhainKinematics(Controller[DraftSettings, DraftTables]):
    """All 21 errors as columns C1 to C6 and constants of the kinematics table: a draft for hand integration."""

    name = "heidenhain-kinematics"
    finite_rotations = True

    def read_settings(self, machine: Machine) -> DraftSettings:
        """Check ``[controllers.heidenhain-kinematics]``."""
        return read_draft_settings(machine)

    def basis(self, machine: Machine, settings: DraftSettings, errors: ErrorTable) -> list[Term]:
        """Return one term per error, with nodes where the curves need them."""
        most = settings.max_points - 2
        nodes = [uneven_nodes_mm(machine, errors, axis, loss_mm=settings.loss_mm, most=most) for axis in range(3)]
        return error_terms(machine, errors, [np.unique(np.round(part, 4)) for part in nodes])

    def build(
        self, machine: Machine, settings: DraftSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> DraftTables:
        """Round the errors in the units of the file; the end values go on beyond the ends."""
        tables: dict[int, DraftTable] = {}
        constants: dict[str, Decimal] = {}
        for term in basis:
            if term.axis is None:
                constants[term.name] = settings.written(float(values[term.name][0]), angular=True)
                continue
            nodes = [Decimal(repr(float(node))).quantize(Decimal("0.0001")) for node in term.nodes_mm]
            positions = (nodes[0] - MARGIN_MM, *nodes, nodes[-1] + MARGIN_MM)
            column = 1 + COLUMNS[term.axis].index(term.name)
            entries = tuple(
                settings.written(float(v), angular=column > 3) for v in np.pad(values[term.name], 1, "edge")
            )
            table = tables.get(term.axis, DraftTable(positions, {}))
            tables[term.axis] = DraftTable(positions, {**table.columns, column: entries})
        return DraftTables(tables, constants)

    def context(self, machine: Machine, settings: DraftSettings, tables: DraftTables) -> dict[str, Any]:
        """Return layouts and cells of the .COM files and of the rows for the kinematics table."""
        return draft_context(machine, settings, tables)

    def parse(self, machine: Machine, settings: DraftSettings, files: Sequence[SourceFile]) -> DraftTables:
        """Read the .COM files and the rows that refer to them."""
        return parse_draft(settings, files)

    def emulate(self, machine: Machine, settings: DraftSettings, tables: DraftTables, points: Points) -> FloatArray:
        """Return minus the error of the tool tip in the chain with the entries as errors: exact finite rotations.

        The control moves to target minus error, worked out at the commanded position (one step). X is the only
        reference of squareness.
        """
        with_reference = replace(machine, squareness_reference="X")
        return -exact_error(with_reference, tables.errors(settings), points.position_mm, points.tool_mm) + 0.0

    def violations(self, machine: Machine, settings: DraftSettings, tables: DraftTables) -> list[str]:
        """Return broken limits: entries, rows of the kinematics table, travel left out."""
        found = []
        for axis, table in sorted(tables.tables.items()):
            what = f"the table over {AXES[axis]}"
            found += coverage_violations(machine, axis, float(table.positions[0]), float(table.positions[-1]), what)
            if len(table.positions) > settings.max_points:
                found.append(f"{what} has {len(table.positions)} entries, the limit is {settings.max_points}")
        rows = comptab_rows(tables)
        if rows > MOST_COMPTAB - 3:
            found.append(f"{rows} entries in COMPTAB, with three MachAxis rows {MOST_COMPTAB - 3} are left")
        return found

    def table_nodes_mm(self, machine: Machine, settings: DraftSettings, tables: DraftTables) -> tuple[FloatArray, ...]:
        """Return the positions of each table."""
        return nodes_by_axis((axis, table.nodes_mm) for axis, table in tables.tables.items())

    def usage(self, machine: Machine, settings: DraftSettings, tables: DraftTables) -> list[Usage]:
        """Return entries and COMPTAB rows against the limits."""
        longest = max((len(table.positions) for table in tables.tables.values()), default=0)
        return [
            Usage("entries of the longest table", longest, settings.max_points, "entries"),
            Usage("entries in COMPTAB", comptab_rows(tables), MOST_COMPTAB - 3, "entries"),
        ]

    def resolution_mm(self, settings: DraftSettings) -> float:
        """Half of the last decimal of three tables in mm, and of six angles at a lever of one metre."""
        angle_rad = 0.5 * 10.0**-settings.angle_decimals * settings.rad_per_unit
        return 3 * 0.5 * 10.0**-settings.decimals + 6 * 1000.0 * angle_rad
