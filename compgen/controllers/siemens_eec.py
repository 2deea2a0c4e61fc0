"""SINUMERIK leadscrew and measuring-system error compensation (LEC, MSEC, EEC): one table per axis.

Sources: SINUMERIK 840D sl / 828D Extended Functions, chapter K3, 03/2013, p. 237-239, 242; 808D Function Manual p. 106.
The control adds the table value to the ACTUAL position, so that a positive value moves the axis in the negative
direction (p. 238): the table holds the measured error, actual minus nominal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import numpy as np

from compgen.controllers.base import Controller, SourceFile, Term, Usage, nodes_by_axis
from compgen.controllers.grids import equidistant_grid, take_loss_mm
from compgen.controllers.siemens_reversal import plain_backlash_rows
from compgen.controllers.siemens_settings import take_axis_names, take_steps
from compgen.controllers.siemens_syntax import (
    LinearTable,
    TableParts,
    axis_of,
    exact_grid,
    read_assignments,
    table_violations,
)
from compgen.controllers.terms import one_dimensional_terms
from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.core.points import Points
from compgen.core.reversal import ReversalCurves

#: Variables of the table without ``$``, with the number of their indices (K3-2013, p. 242).
VARIABLES = {
    "AA_ENC_COMP": 3,
    "AA_ENC_COMP_STEP": 2,
    "AA_ENC_COMP_MIN": 2,
    "AA_ENC_COMP_MAX": 2,
    "AA_ENC_COMP_IS_MODULO": 2,
}
BYTES_PER_VALUE = 8
_NODES_OF_808D = 200


@dataclass(frozen=True)
class EecSettings:
    """Settings ``[controllers.siemens-eec]``.

    Parameters
    ----------
    encoder : 0 for measuring system 1, 1 for measuring system 2.
    axis_names : names of X, Y, Z on the control.
    step_mm : node distances that the user asks for, or None.
    loss_mm : loss by interpolation between nodes, as a displacement of the tool, that is worth no further node.
    max_points : nodes that the control can hold per axis and measuring system.
    decimals : digits after the point of the values in mm.
    """

    encoder: int
    axis_names: tuple[str, str, str]
    step_mm: tuple[float | None, ...]
    loss_mm: float
    max_points: int
    decimals: int


@dataclass(frozen=True)
class EecTables:
    """Tables by axis 0..2; the values are errors in mm (actual minus nominal), as the file has them."""

    tables: Mapping[int, LinearTable]


class SiemensEec(Controller[EecSettings, EecTables]):
    """SINUMERIK measuring-system and leadscrew error compensation: positioning of X, Y, Z."""

    name = "siemens-eec"
    anchored = True

    def read_settings(self, machine: Machine) -> EecSettings:
        """Check the settings; all have defaults."""
        section = machine.controller_settings(self.name)
        max_points = section.take("max_points", tomlio.whole(3, 100_000), 5000)
        settings = EecSettings(
            encoder=section.take("encoder", tomlio.whole(0, 1), 0),
            axis_names=take_axis_names(section),
            step_mm=take_steps(section, machine, max_points),
            loss_mm=take_loss_mm(section),
            max_points=max_points,
            decimals=section.take("decimals", tomlio.whole(3, 9), 6),
        )
        section.finish()
        return settings

    def basis(self, machine: Machine, settings: EecSettings, errors: ErrorTable) -> list[Term]:
        """Return the terms X(x), Y(y), Z(z), zero at the reference point, which is a node."""
        nodes = [
            equidistant_grid(
                machine,
                errors,
                axis,
                most=settings.max_points,
                step_mm=settings.step_mm[axis],
                anchor=True,
                loss_mm=settings.loss_mm,
                output=axis,
            ).nodes_mm
            for axis in range(3)
        ]
        return one_dimensional_terms(machine, errors, nodes, [(axis, axis) for axis in range(3)], anchored=True)

    def build(
        self, machine: Machine, settings: EecSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> EecTables:
        """Return the tables: minus the correction, rounded to the decimals of the file."""
        tables = {}
        for term in basis:
            start, step, last = exact_grid(term.nodes_mm)
            quantum = 10**settings.decimals
            counts = np.rint(-np.asarray(values[term.name]) * quantum).astype(np.int64)
            numbers = tuple(Decimal(int(count)).scaleb(-settings.decimals) for count in counts)
            tables[term.carrier[0].output] = LinearTable(start, step, last, numbers)
        return EecTables(tables)

    def context(self, machine: Machine, settings: EecSettings, tables: EecTables) -> dict[str, Any]:
        """Return tables, machine data and the sign with a number from the file."""
        return {
            "sign_statement": self._sign_statement(settings, tables),
            "parameters": self._parameters(settings, tables),
            "warnings": self._warnings(machine, settings, tables),
            "encoder": settings.encoder,
            "decimals": settings.decimals,
            "tables": [
                {
                    "letter": AXES[axis],
                    "axis": settings.axis_names[axis],
                    "minimum_mm": float(table.start_mm),
                    "maximum_mm": float(table.last_mm),
                    "step_mm": float(table.step_mm),
                    "modulo": int(table.modulo),
                    "values_mm": [float(value) for value in table.values],
                }
                for axis, table in sorted(tables.tables.items())
            ],
        }

    def _sign_statement(self, settings: EecSettings, tables: EecTables) -> str:
        axis, table = max(tables.tables.items(), key=lambda item: float(np.max(np.abs(item[1].numbers))))
        node = int(np.argmax(np.abs(table.numbers)))
        value = float(table.values[node])
        return (
            "A table value is the measured error, actual minus nominal, in mm. The control adds it to the ACTUAL "
            f"position, so a positive value moves the axis in the negative direction. Here: at {AXES[axis]} = "
            f"{table.nodes_mm[node]:.3f} mm the table holds {value:+.6f} mm, the axis {settings.axis_names[axis]} is "
            f"moved by {-value:+.6f} mm."
        )

    def _parameters(self, settings: EecSettings, tables: EecTables) -> list[dict[str, str]]:
        rows = []
        for axis, table in sorted(tables.tables.items()):
            name, count = settings.axis_names[axis], len(table.values)
            rows.append(
                {
                    "name": f"MD38000 $MA_MM_ENC_COMP_MAX_POINTS[{settings.encoder},{name}]",
                    "value": f">= {count}",
                    "meaning": f"reserved nodes; {count * BYTES_PER_VALUE} bytes of static memory, which the change "
                    "re-formats: save all data first",
                }
            )
            rows.append(
                {
                    "name": f"MD32700 $MA_ENC_COMP_ENABLE[{settings.encoder}] of {name}",
                    "value": "0, then 1",
                    "meaning": "0 while the file is loaded; 1 makes the table act and write-protects it",
                }
            )
        return rows

    def _warnings(self, machine: Machine, settings: EecSettings, tables: EecTables) -> list[str]:
        found = []
        for axis, table in sorted(tables.tables.items()):
            at_reference = float(table.at(np.array([machine.reference_point_mm[axis]]))[0])
            if abs(at_reference) > self.resolution_mm(settings):
                found.append(
                    f"{settings.axis_names[axis]}: the table holds {at_reference:+.6f} mm at the reference point; the "
                    "axis jumps by it when the compensation is enabled"
                )
            if len(table.values) > _NODES_OF_808D:
                found.append(
                    f"{settings.axis_names[axis]}: {len(table.values)} nodes; a SINUMERIK 808D holds {_NODES_OF_808D}"
                )
        return found

    def parse(self, machine: Machine, settings: EecSettings, files: Sequence[SourceFile]) -> EecTables:
        """Read the tables of the machine's axes; an axis without any assignment has no table."""
        parts: dict[int, TableParts] = {}
        for item in read_assignments(files, VARIABLES):
            encoder = item.index_number(0, 1)
            if encoder != settings.encoder:
                raise item.fail(f"belongs to encoder {encoder}; the machine file has encoder = {settings.encoder}")
            axis = axis_of(item, item.index[-1], settings.axis_names)
            part = parts.setdefault(axis, TableParts(f"table of {settings.axis_names[axis]}", item.source))
            part.add(item, item.index_number(1, 999_999) if item.variable == "AA_ENC_COMP" else None)
        return EecTables({axis: part.table("$AA_ENC_COMP") for axis, part in sorted(parts.items())})

    def emulate(self, machine: Machine, settings: EecSettings, tables: EecTables, points: Points) -> FloatArray:
        """Return minus the interpolated table values: the control corrects the actual position by them."""
        correction = np.zeros((len(points), 3))
        for axis, table in tables.tables.items():
            correction[:, axis] = -table.at(points.position_mm[:, axis])
        return correction

    def violations(self, machine: Machine, settings: EecSettings, tables: EecTables) -> list[str]:
        """Return broken rules of the tables: whole number of steps, node count, travel."""
        found: list[str] = []
        for axis, table in sorted(tables.tables.items()):
            what = f"the table of {settings.axis_names[axis]}"
            found += table_violations(machine, axis, table, settings.max_points, what)
        return found

    def table_nodes_mm(self, machine: Machine, settings: EecSettings, tables: EecTables) -> tuple[FloatArray, ...]:
        """Return the nodes of each axis."""
        return nodes_by_axis((axis, table.nodes_mm) for axis, table in tables.tables.items())

    def backlash_parameters(
        self, machine: Machine, settings: EecSettings, reversal: ReversalCurves
    ) -> list[dict[str, str]]:
        """Return MD32450 of each axis with a reversal along itself."""
        return plain_backlash_rows(reversal, settings.axis_names, settings.encoder)

    def usage(self, machine: Machine, settings: EecSettings, tables: EecTables) -> list[Usage]:
        """Return the nodes of each axis against what the control can hold."""
        return [
            Usage(f"nodes of {settings.axis_names[axis]}", len(table.values), settings.max_points, "nodes")
            for axis, table in sorted(tables.tables.items())
        ]

    def resolution_mm(self, settings: EecSettings) -> float:
        """Half of the last decimal."""
        return 0.5 * 10.0**-settings.decimals
