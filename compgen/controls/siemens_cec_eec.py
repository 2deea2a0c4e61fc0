"""SINUMERIK with both kinds of tables: positioning in the encoder tables (EEC), the rest in the cross tables (CEC).

Sources as in :mod:`compgen.controls.siemens_eec` and :mod:`compgen.controls.siemens_cec`. The encoder tables act on
the actual position and are zero at the reference point, the cross tables act on the setpoint; the axis makes both
corrections. A CEC table must not contain the positioning error of an axis as well: the part that products fold into
the table of an axis over itself only cancels the direct term of their factor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from compgen.controls.shared.base import Controller, SourceFile, Term, Usage
from compgen.controls.shared.scanner import Findings
from compgen.controls.siemens_cec import VARIABLES as CEC_VARIABLES
from compgen.controls.siemens_cec import (
    CecTables,
    SiemensCec,
    cec_tables_from,
    foreign_cec_tables,
)
from compgen.controls.siemens_cec_tables import MULT_MODES, Choice, chosen_terms, term_names, terms_of_tables
from compgen.controls.siemens_eec import VARIABLES as EEC_VARIABLES
from compgen.controls.siemens_eec import EecTables, SiemensEec, eec_tables_from, eec_terms, foreign_eec_tables
from compgen.controls.siemens_machine_data import CecEecSettings, checked_cec_settings, checked_encoder_settings
from compgen.controls.siemens_text import ArchiveAssignments, foreign_assignments, read_assignments
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM
from compgen.data.toml_files import Section

#: Sections of the machine file that describe the same control: they supply keys missing in the section of this one.
OTHER_SECTIONS = ("siemens-cec", "siemens-eec")
#: Keys that both kinds of tables have, with separate values: the keys of the encoder tables have this prefix.
PREFIX, PREFIXED = "eec_", ("max_points", "step_mm", "decimals")
#: Residual that a CEC table of an axis over itself may leave after cancelling (rounding), mm.
ROUNDING_MM = 2e-6

_CROSS = [(output, axis) for output in range(3) for axis in range(3) if output != axis]


@dataclass(frozen=True)
class CecEecTables:
    """Tables of both kinds, with the numbers exactly as in the files."""

    cec: CecTables
    eec: EecTables


class SiemensCecEec(Controller[CecEecSettings, CecEecTables]):
    """SINUMERIK EEC and CEC together: positioning, straightness, squareness, angles as products of tables."""

    name = "siemens-cec-eec"
    settings_class = CecEecSettings
    bidirectional = True

    def __init__(self, machine: Machine, settings: CecEecSettings | None = None) -> None:
        super().__init__(machine, settings)
        self._cec, self._eec = SiemensCec(machine, self.settings), SiemensEec(machine, self.settings.eec)

    @classmethod
    def settings_section(cls, machine: Machine) -> Section:
        """Return the section; keys that it lacks come from the sections of both kinds of tables."""
        section = machine.controller_settings(cls.name)
        for other in OTHER_SECTIONS:
            for key, value in machine.controller_settings(other).data.items():
                section.data.setdefault(PREFIX + key if other == "siemens-eec" and key in PREFIXED else key, value)
        return section

    @classmethod
    def check_settings(cls, settings: CecEecSettings, section: Section, machine: Machine) -> CecEecSettings:
        """Check the settings of both kinds of tables."""
        return checked_encoder_settings(checked_cec_settings(settings, section, machine), section, machine, PREFIX)

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return positioning of each axis over itself, the six tables over another axis, and the products."""
        return self._pitch(errors) + self._choice(errors).kept

    def basis_of(self, errors: ErrorTable, tables: CecEecTables) -> list[Term]:
        """Return positioning, and the terms that the cross tables contain, unless a better set fits in the control."""
        choice, mode = self._choice(errors), self.settings.mult_mode
        terms = self._cec.terms(errors, _CROSS)
        cross = terms_of_tables(self.machine, errors, terms, mode, choice, term_names(tables.cec.tables))
        return self._pitch(errors) + cross

    def left_out(self, errors: ErrorTable) -> list[str]:
        """Return which CEC tables do not fit in the control, which products are not written, and what remains."""
        pitch = self._pitch(errors)
        products = self._cec.unwritten_products(errors, _CROSS, pitch)
        return self._choice(errors).statements() + products

    def reservations(self, tables: CecEecTables) -> list[str]:
        """Return what the verdict must say about the cross tables."""
        return self._cec.reservations(tables.cec)

    def _choice(self, errors: ErrorTable) -> Choice:
        terms = self._cec.terms(errors, _CROSS)
        pitch = self._pitch(errors)
        return chosen_terms(self.machine, errors, terms, self.settings.mult_mode, self.settings.tables_usable, pitch)

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> CecEecTables:
        """Return both kinds of tables, rounded as written."""
        pitch = [term for term in basis if term.axis == term.carrier[0].output and term.carrier[0].lever is None]
        cross = [term for term in basis if term not in pitch]
        cec = self._cec.build(cross, values)
        return CecEecTables(cec, self._eec.build(pitch, values))

    def with_reversal(self, tables: CecEecTables, reversal: ReversalCurves) -> CecEecTables:
        """Return the tables plus a pair of CEC tables, DIRECTION 1 and -1, for each reversal."""
        return CecEecTables(self._cec.with_reversal(tables.cec, reversal), tables.eec)

    def by_direction(self, tables: CecEecTables) -> bool:
        """Return whether a CEC table has a DIRECTION."""
        return self._cec.by_direction(tables.cec)

    def context(self, tables: CecEecTables) -> dict[str, Any]:
        """Return the contexts of both kinds under ``cec`` and ``eec``, and their combined texts."""
        cec = self._cec.context(tables.cec)
        eec = self._eec.context(tables.eec)
        return {
            "sign_statement": f"Encoder tables: {eec['sign_statement']} Cross tables: {cec['sign_statement']}",
            "parameters": [*eec["parameters"], *cec["parameters"]],
            "warnings": [*eec["warnings"], *cec["warnings"]],
            "tables": [*eec["tables"], *cec["tables"]],
            "container": cec["container"],
            "overwrites": [*cec["overwrites"], *eec["overwrites"]],
            "cec": cec,
            "eec": eec,
        }

    def parse(self, files: Sequence[SourceFile]) -> CecEecTables:
        """Read both kinds of tables from files in any order; both must be present."""
        items = read_assignments(files, {**EEC_VARIABLES, **CEC_VARIABLES})
        eec_items = [item for item in items if item.variable in EEC_VARIABLES]
        cec_items = [item for item in items if item.variable in CEC_VARIABLES]
        for found, array, what in ((eec_items, "AA_ENC_COMP", "encoder"), (cec_items, "AN_CEC", "cross")):
            if not any(item.variable == array for item in found):
                raise files[-1].fail(f"the files contain no {what} tables (${array}); give both AX_EEC and NC_CEC")
        return CecEecTables(
            cec_tables_from(cec_items, files, self.settings), eec_tables_from(eec_items, self.settings.eec)
        )

    def parse_foreign(self, files: Sequence[SourceFile]) -> tuple[CecEecTables, list[str]]:
        """Read an archive or programs from a real control: the active tables of both kinds, and what was skipped."""
        findings = Findings()
        given = foreign_assignments(files, {**EEC_VARIABLES, **CEC_VARIABLES}, findings)
        cec_part, eec_part = (
            ArchiveAssignments([item for item in given.items if item.variable in kind], given.machine_data)
            for kind in (CEC_VARIABLES, EEC_VARIABLES)
        )
        for part, array, what in ((cec_part, "AN_CEC", "cross"), (eec_part, "AA_ENC_COMP", "encoder")):
            if not any(item.variable == array for item in part.items):
                raise files[-1].fail(f"the files contain no {what} tables (${array}); give all files of the control")
        cec = foreign_cec_tables(cec_part, self.machine, self.settings, findings)
        eec = foreign_eec_tables(eec_part, self.machine, self.settings.eec, findings)
        return CecEecTables(cec, eec), findings.statements()

    def emulate(self, tables: CecEecTables, points: Points) -> FloatArray:
        """Return the sum of both corrections."""
        cec = self._cec.emulate(tables.cec, points)
        return cec + self._eec.emulate(tables.eec, points)

    def violations(self, tables: CecEecTables) -> list[str]:
        """Return the broken rules of either kind, and positioning that is in both kinds."""
        settings = self.settings
        found = [*self._eec.violations(tables.eec), *self._cec.violations(tables.cec)]
        first_stays, multiplier_stays = MULT_MODES[settings.mult_mode]
        entries = tables.cec.tables
        multipliers = {entry.multiplier - 1 for entry in entries.values() if entry.multiplier}
        # axes with an encoder table whose CEC tables over themselves do not cancel (mean of both directions)
        for axis in sorted({axis for axis, _ in tables.eec.tables}):
            over_itself = {
                index: entry
                for index, entry in entries.items()
                if entry.input_axis == entry.output_axis == axis
                and (first_stays or not entry.multiplier)
                and (multiplier_stays or index not in multipliers)
            }
            if not over_itself:
                continue
            where = np.unique(np.concatenate([entry.table.nodes_mm for entry in over_itself.values()]))
            total = sum(entry.at(where) * (0.5 if entry.direction else 1.0) for entry in over_itself.values())
            largest = float(np.max(np.abs(total)))
            if largest > ROUNDING_MM:
                found.append(
                    f"the positioning error of {settings.axis_names[axis]} is in its encoder table and, with up to "
                    f"{largest / MM_PER_UM:.3f} um, also in the CEC tables {sorted(over_itself)}: it would be corrected twice"
                )
        return found

    def keeping_others(self, tables: CecEecTables, files: Sequence[Path]) -> dict[str, dict[str, Any]]:
        """Return ``kept_tables`` extended by the cross tables of other axes that an archive contains."""
        return self._cec.keeping_others(tables.cec, files)

    def other_readings(self, tables: CecEecTables) -> dict[str, Self]:
        """Return the control with each of the other product modes of the cross tables."""
        others = self._cec.other_readings(tables.cec)
        return {
            words: type(self)(self.machine, replace(self.settings, mult_mode=cec.settings.mult_mode))
            for words, cec in others.items()
        }

    def table_nodes_mm(self, tables: CecEecTables) -> tuple[FloatArray, ...]:
        """Return the nodes of all tables by their input axis."""
        cec = self._cec.table_nodes_mm(tables.cec)
        eec = self._eec.table_nodes_mm(tables.eec)
        return tuple(np.union1d(a, b) for a, b in zip(cec, eec, strict=True))

    def usage(self, tables: CecEecTables) -> list[Usage]:
        """Return how much of each limit either kind uses."""
        return [
            *self._eec.usage(tables.eec),
            *self._cec.usage(tables.cec),
        ]

    def resolution_mm(self) -> float:
        """Rounding of both kinds together."""
        return self._cec.resolution_mm() + self._eec.resolution_mm()

    def _pitch(self, errors: ErrorTable) -> list[Term]:
        """Terms of the encoder tables; their angles use the same lever origin as the products."""
        return eec_terms(
            self.machine,
            self.settings.eec,
            errors,
            self.machine.reference_point_mm if self.settings.products else None,
        )
