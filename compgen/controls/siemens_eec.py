"""SINUMERIK leadscrew and measuring-system error compensation (LEC, MSEC, EEC): one table per axis.

Sources: SINUMERIK 840D sl / 828D Extended Functions, chapter K3, 03/2013, p. 237-239, 242; 808D Function Manual p. 106.
The control adds the table value to the ACTUAL position, so a positive value moves the axis in the negative direction
(p. 238): the table contains the measured error, actual minus nominal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.controls.shared.base import Controller, SourceFile, Term, Usage, nodes_by_axis, parameter_row
from compgen.controls.shared.grids import equidistant_grid
from compgen.controls.shared.scanner import Findings
from compgen.controls.shared.terms import one_dimensional_terms
from compgen.controls.siemens_machine_data import PROFILES, EecSettings, checked_encoder_settings
from compgen.controls.siemens_text import (
    SWITCHES,
    ArchiveAssignments,
    Assignment,
    LinearTable,
    TableParts,
    axis_of,
    exact_grid,
    exact_values,
    foreign_assignments,
    noted_table,
    read_assignments,
    table_violations,
)
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import WORTH_MM, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES
from compgen.data.toml_files import Section

#: Variables of the table, without ``$``, and how many indices each has (K3-2013, p. 242).
VARIABLES = {
    "AA_ENC_COMP": 3,
    "AA_ENC_COMP_STEP": 2,
    "AA_ENC_COMP_MIN": 2,
    "AA_ENC_COMP_MAX": 2,
    "AA_ENC_COMP_IS_MODULO": 2,
    "MA_ENC_COMP_ENABLE": 2,
}
BYTES_PER_VALUE = 8


@dataclass(frozen=True)
class EecTables:
    """Tables by (axis 0..2, encoder); the values are errors in mm (actual minus nominal), exactly as in the file."""

    tables: Mapping[tuple[int, int], LinearTable]


class SiemensEec(Controller[EecSettings, EecTables]):
    """SINUMERIK measuring-system and leadscrew error compensation: positioning of X, Y, Z."""

    name = "siemens-eec"
    settings_class = EecSettings
    anchored = True

    @classmethod
    def check_settings(cls, settings: EecSettings, section: Section, machine: Machine) -> EecSettings:
        """Complete the settings from the model, and set the measuring systems used for position control."""
        return checked_encoder_settings(settings, section, machine)

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return the terms X(x), Y(y), Z(z), zero at the reference point, which is a node of each."""
        return eec_terms(self.machine, self.settings, errors)

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> EecTables:
        """Return the tables: minus the correction, rounded to the decimals of the file."""
        tables = {}
        for term in basis:
            start, step, last = exact_grid(term.nodes_mm)
            quantum = 10**self.settings.decimals
            counts = np.rint(-np.asarray(values[term.name]) * quantum).astype(np.int64)
            numbers = exact_values(counts, self.settings.decimals)
            axis = term.carrier[0].output
            for encoder in self.settings.encoders[axis]:
                tables[axis, encoder] = LinearTable(start, step, last, numbers)
        return EecTables(tables)

    def context(self, tables: EecTables) -> dict[str, Any]:
        """Return the tables, the machine data, and the sign convention with an example value from the file."""
        settings = self.settings
        return {
            "sign_statement": self._sign_statement(tables),
            "parameters": self._parameters(tables),
            "warnings": self._warnings(tables),
            "container": settings.container,
            "program_enables": settings.program_enables,
            "active": [
                f"{name}: {encoder + 1}" for name, encoder in zip(settings.axis_names, settings.active, strict=True)
            ],
            "decimals": settings.decimals,
            "overwrites": [
                "Encoder tables ($AA_ENC_COMP) of other axes: none.",
                *(
                    f"The encoder table of {settings.axis_names[axis]}, measuring system {encoder + 1}, whatever it contains "
                    "now."
                    for axis, encoder in sorted(tables.tables)
                ),
            ],
            "tables": [
                {
                    "letter": AXES[axis],
                    "axis": settings.axis_names[axis],
                    "encoder": encoder,
                    **table.context(),
                }
                for (axis, encoder), table in sorted(tables.tables.items())
            ],
        }

    def _sign_statement(self, tables: EecTables) -> str:
        settings = self.settings
        (axis, _), table = max(tables.tables.items(), key=lambda item: float(np.max(np.abs(item[1].numbers))))
        node = int(np.argmax(np.abs(table.numbers)))
        value = float(table.values[node])
        return (
            "A table value is the measured error, actual minus nominal, in mm. The control adds it to the ACTUAL "
            f"position, so a positive value moves the axis in the negative direction. Example: at {AXES[axis]} = "
            f"{table.nodes_mm[node]:.3f} mm the table value is {value:+.6f} mm, so the control moves the axis "
            f"{settings.axis_names[axis]} by {-value:+.6f} mm."
        )

    def _parameters(self, tables: EecTables) -> list[dict[str, str]]:
        rows = []
        for (axis, encoder), table in sorted(tables.tables.items()):
            name, count = self.settings.axis_names[axis], len(table.values)
            points = f"MD38000 $MA_MM_ENC_COMP_MAX_POINTS[{encoder},{name}]"
            memory = f"nodes to reserve ({count * BYTES_PER_VALUE} bytes); a change re-formats the static memory"
            rows.append(parameter_row(points, f">= {count}", f"{memory}: save all data first"))
            meaning = "0 while the file is loaded; 1 activates the table and write-protects it"
            rows.append(parameter_row(f"MD32700 $MA_ENC_COMP_ENABLE[{encoder}] of {name}", "0, then 1", meaning))
        return rows

    def _warnings(self, tables: EecTables) -> list[str]:
        settings = self.settings
        found, small = [], PROFILES["808D"].eec_nodes
        for (axis, encoder), table in sorted(tables.tables.items()):
            name = settings.axis_names[axis]
            at_reference = float(table.at(np.array([self.machine.reference_point_mm[axis]]))[0])
            if abs(at_reference) > self.resolution_mm():
                found.append(
                    f"{name}: the table value at the reference point is {at_reference:+.6f} mm; the axis jumps by this "
                    "amount when the compensation is enabled"
                )
            if len(table.values) > small and settings.max_points > small:
                found.append(f"{name}: {len(table.values)} nodes; a SINUMERIK 808D takes at most {small}")
            if encoder != settings.active[axis]:
                found.append(
                    f"{name}: the table of measuring system {encoder + 1} contains the same errors as that of measuring "
                    f"system {settings.active[axis] + 1}; this is correct only if measurements with both systems gave "
                    "these errors, or if the errors come from the guideway"
                )
        if not settings.eec_nodes_known:
            found.append(
                f"the number of nodes of this model is not documented; the limit is taken as {settings.max_points}, the "
                "smallest number documented for any model: set max_points"
            )
        return found

    def parse(self, files: Sequence[SourceFile]) -> EecTables:
        """Read the tables of the machine's axes; an axis without assignments has no table."""
        return eec_tables_from(read_assignments(files, VARIABLES), self.settings)

    def parse_foreign(self, files: Sequence[SourceFile]) -> tuple[EecTables, list[str]]:
        """Read an archive or a program from a real control: the active tables, and a list of what was skipped."""
        findings = Findings()
        given = foreign_assignments(files, VARIABLES, findings)
        return foreign_eec_tables(given, self.machine, self.settings, findings), findings.statements()

    def emulate(self, tables: EecTables, points: Points) -> FloatArray:
        """Return minus the interpolated values of the active measuring system: they correct the actual position."""
        correction = np.zeros((len(points), 3))
        for (axis, encoder), table in tables.tables.items():
            if encoder == self.settings.active[axis]:
                correction[:, axis] = -table.at(points.position_mm[:, axis])
        return correction

    def violations(self, tables: EecTables) -> list[str]:
        """Return broken rules of the tables: whole number of steps, node count, travel, a missing measuring system."""
        settings = self.settings
        found: list[str] = []
        for (axis, encoder), table in sorted(tables.tables.items()):
            what = f"the table of {settings.axis_names[axis]}"
            what += f", measuring system {encoder + 1}" if len(settings.encoders[axis]) > 1 else ""
            found += table_violations(self.machine, axis, table, settings.max_points, what)
        for axis in sorted({axis for axis, _ in tables.tables}):
            found += [
                f"{settings.axis_names[axis]} has no table for measuring system {encoder + 1}"
                for encoder in settings.encoders[axis]
                if (axis, encoder) not in tables.tables
            ]
        return found

    def table_nodes_mm(self, tables: EecTables) -> tuple[FloatArray, ...]:
        """Return the nodes of each axis."""
        return nodes_by_axis((axis, table.nodes_mm) for (axis, _), table in tables.tables.items())

    def backlash_parameters(self, reversal: ReversalCurves) -> list[dict[str, str]]:
        """Return MD32450 for the mean reversal of each axis along itself: positive where the tool stops short.

        Source: MD32450 is positive if the encoder leads the machine part (SINUMERIK parameter manuals), the usual case;
        then the position reached in the positive direction is the smaller, and the reversal value B is negative.
        """
        rows = []
        for axis, name in enumerate(self.settings.axis_names):
            meaning = f"minus the mean reversal value of {AXES[axis]}; these tables are the same for both directions. "
            meaning += "If a value was active while the machine was measured, add this one to it"
            mean_mm = reversal.mean_mm(axis)
            for encoder in self.settings.encoders[axis] if abs(mean_mm) >= WORTH_MM else ():
                rows.append(parameter_row(f"MD32450 $MA_BACKLASH[{encoder},{name}]", f"{-mean_mm:.4f} mm", meaning))
        return rows

    def usage(self, tables: EecTables) -> list[Usage]:
        """Return the number of nodes of each axis against the limit of the control."""
        settings = self.settings
        return [
            Usage(f"nodes of {settings.axis_names[axis]}", len(table.values), settings.max_points, "nodes")
            for (axis, _), table in sorted(tables.tables.items())
        ]

    def resolution_mm(self) -> float:
        """Half of the last decimal."""
        return 0.5 * 10.0**-self.settings.decimals


def eec_terms(
    machine: Machine, settings: EecSettings, errors: ErrorTable, lever_origin_mm: Sequence[float] | None = None
) -> list[Term]:
    """Return the terms X(x), Y(y), Z(z), zero at the reference point, which is a node of each grid.

    ``lever_origin_mm`` as in :func:`compgen.controls.shared.terms.one_dimensional_terms`.
    """
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
    pairs = [(axis, axis) for axis in range(3)]
    return one_dimensional_terms(machine, errors, nodes, pairs, anchored=True, lever_origin_mm=lever_origin_mm)


def foreign_eec_tables(
    given: ArchiveAssignments, machine: Machine, settings: EecSettings, findings: Findings
) -> EecTables:
    """Return the active tables from the files of a real control.

    Tables of axes that the machine file lacks, tables that the archive's machine data switch off, and tables of zeros
    are skipped and noted. A table that acts on a measuring system not named in the machine file raises an InputError
    with its line.
    """
    parts: dict[tuple[str, int], TableParts] = {}
    for item in given.items:
        if item.variable in SWITCHES:
            continue
        encoder, name = item.index_number(0, 1), item.index[-1]
        parts.setdefault((name, encoder), TableParts(f"table of {name}, encoder {encoder}", item.source)).add(item)
    tables = {}
    for (name, encoder), part in sorted(parts.items()):
        axis = settings.axis_names.index(name) if name in settings.axis_names else None
        stated = axis is not None and encoder in settings.encoders[axis]
        if part.is_zero and (not stated or part.scalar("$AA_ENC_COMP_STEP").number() == 0):
            findings.count("encoder tables of zeros, of other axes or measuring systems")
        elif axis is None:
            findings.apart.append(f"encoder table of {name} (encoder {encoder}, up to {part.largest})")
        elif given.switched_off("MA_ENC_COMP_ENABLE", (str(encoder), name)):
            findings.notes.append(f"$MA_ENC_COMP_ENABLE[{encoder},{name}] is 0 in the archive: its table has no effect")
        elif not stated:
            raise part.scalar("$AA_ENC_COMP_STEP").fail(
                f"the control has a table (up to {part.largest}) for encoder {encoder} of {name}, but the machine "
                f"file has encoder = {list(settings.encoders[axis])}: set the encoder that is in use, e.g. encoder = "
                f"{{ {AXES[axis]} = {encoder} }}"
            )
        else:
            tables[axis, encoder] = noted_table(part, "$AA_ENC_COMP", machine.axes[axis].range_mm, findings)
    if not tables:
        said = [*findings.apart, *findings.notes]
        raise next(iter(parts.values())).source.fail(
            f"contains no active table for the axes {', '.join(settings.axis_names)} and measuring systems of the machine "
            f"file{': ' if said else ''}{'; '.join(said)}"
        )
    return EecTables(dict(sorted(tables.items())))


def eec_tables_from(items: Sequence[Assignment], settings: EecSettings) -> EecTables:
    """Return the tables that the assignments define; InputError for an encoder that is not in the settings."""
    parts: dict[tuple[int, int], TableParts] = {}
    for item in items:
        encoder = item.index_number(0, 1)
        axis = axis_of(item, item.index[-1], settings.axis_names)
        stated = settings.encoders[axis]
        if encoder not in stated:
            shown = stated[0] if len(stated) == 1 else list(stated)
            raise item.fail(f"belongs to encoder {encoder}, but the machine file has encoder = {shown}")
        if item.variable in SWITCHES:
            continue
        what = f"table of {settings.axis_names[axis]}" + (f", encoder {encoder}" if len(stated) > 1 else "")
        parts.setdefault((axis, encoder), TableParts(what, item.source)).add(item)
    return EecTables({key: part.table("$AA_ENC_COMP") for key, part in sorted(parts.items())})
