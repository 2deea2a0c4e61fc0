"""SINUMERIK cross-error compensation (CEC, sag): any axis as a function of any axis, and products of tables.

Source: SINUMERIK 840D sl / 828D Extended Functions, chapter K3, 03/2013, p. 245-252, 264; 802D sl, p. 215-222.
The available documents do not give the sign of the sum; it is inferred, see ``templates/siemens-cec/format.toml``.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from compgen.controls.shared.base import Controller, SourceFile, Term, Usage, nodes_by_axis
from compgen.controls.shared.grids import equidistant_grid
from compgen.controls.shared.scanner import Findings
from compgen.controls.shared.terms import one_dimensional_terms, product_terms
from compgen.controls.siemens_cec_tables import (
    MM_DECIMALS,
    MODE_WORDS,
    NEGLIGIBLE_PRODUCT_MM,
    CecMap,
    CecTable,
    Choice,
    around_kept,
    backlash_rows,
    chosen_terms,
    folded_tables,
    labels_in,
    reversal_statement,
    sum_into_axes,
    term_names,
    terms_of_tables,
    with_reversal_tables,
    without_products,
    written_decimals,
)
from compgen.controls.siemens_machine_data import (
    CecSettings,
    cec_overwrites,
    cec_parameters,
    cec_reservations,
    cec_sign_statement,
    cec_usage,
    cec_warnings,
    checked_cec_settings,
    largest_sums,
    set_violations,
    stated_limit_violations,
)
from compgen.controls.siemens_text import (
    PROTECTING,
    SWITCHES,
    ArchiveAssignments,
    Assignment,
    LinearTable,
    TableParts,
    axis_of,
    foreign_assignments,
    noted_table,
    read_assignments,
)
from compgen.data.csv_files import FloatArray, whole_number
from compgen.data.error_table import ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES
from compgen.data.toml_files import Section
from compgen.errors import CompgenWarning

#: Variables of the tables and their switches, without ``$``, and how many indices each has (K3-2013, p. 245-249).
VARIABLES = {
    "AN_CEC": 2,
    "AN_CEC_INPUT_AXIS": 1,
    "AN_CEC_OUTPUT_AXIS": 1,
    "AN_CEC_STEP": 1,
    "AN_CEC_MIN": 1,
    "AN_CEC_MAX": 1,
    "AN_CEC_DIRECTION": 1,
    "AN_CEC_MULT_BY_TABLE": 1,
    "AN_CEC_IS_MODULO": 1,
    "MA_CEC_ENABLE": 1,
    "SN_CEC_TABLE_ENABLE": 1,
    "SN_CEC_TABLE_WEIGHT": 1,
}
MODE_OF_A_FILE = (
    "the file multiplies tables, but the machine file does not say how the control combines them: set "
    'mult_mode = "S1", "S2", "S3" or "S4" in the section of the control'
)
#: (output, axis) of every table without products.
ALL_PAIRS = [(output, axis) for output in range(3) for axis in range(3)]
_AXIS_VALUE = re.compile(r'\(\s*([A-Z0-9_]{1,32})\s*\)|"([A-Z0-9_]{1,32})"')
#: Every output axis has three ordinary tables and, whatever the kinematic chain, at most three products.
_ORDINARY_PER_AXIS = _PRODUCTS_PER_AXIS = 3
#: Largest total rounding error on one axis from the factors of products (9 decimals, values of a few mm at most).
_FACTOR_ROUNDING_MM = 1e-8


@dataclass(frozen=True)
class CecTables:
    """Tables by index, with the numbers exactly as in the file; ``others`` are the indices of tables of other axes."""

    tables: CecMap
    others: tuple[int, ...] = field(default=(), compare=False)


class SiemensCec(Controller[CecSettings, CecTables]):
    """SINUMERIK CEC: straightness, squareness, positioning, and angular errors as products of tables."""

    name = "siemens-cec"
    settings_class = CecSettings
    bidirectional = True

    @classmethod
    def check_settings(cls, settings: CecSettings, section: Section, machine: Machine) -> CecSettings:
        """Complete the settings from the model; ``mult_mode`` is mandatory if ``products`` is true."""
        return checked_cec_settings(settings, section, machine)

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return nine tables (output over axis), and the products, with levers measured from the reference point.

        If the control has too few tables for all, return the set that leaves the smallest error over the volume.
        """
        return self._choice(errors).kept

    def basis_of(self, errors: ErrorTable, tables: CecTables) -> list[Term]:
        """Return the terms that the tables contain, unless a better set fits in the control."""
        choice = self._choice(errors)
        terms = self.terms(errors, ALL_PAIRS)
        return terms_of_tables(self.machine, errors, terms, self.settings.mult_mode, choice, term_names(tables.tables))

    def terms(self, errors: ErrorTable, pairs: Sequence[tuple[int, int]]) -> list[Term]:
        """Return the terms of the tables for the pairs (output, axis), and of the products if they are allowed."""
        machine, settings = self.machine, self.settings
        nodes = [
            equidistant_grid(
                machine,
                errors,
                axis,
                most=settings.max_points,
                step_mm=settings.step_mm[axis],
                loss_mm=settings.loss_mm,
            ).nodes_mm
            for axis in range(3)
        ]
        if not settings.products:
            return one_dimensional_terms(machine, errors, nodes, pairs)
        origin = machine.reference_point_mm
        ordinary = one_dimensional_terms(machine, errors, nodes, pairs, lever_origin_mm=origin)
        return ordinary + product_terms(machine, errors, nodes, origin)

    def unwritten_products(
        self, errors: ErrorTable, pairs: Sequence[tuple[int, int]], given: Sequence[Term] = ()
    ) -> list[str]:
        """Return, in words, what stays uncorrected because the settings allow no products; empty if they do."""
        if self.settings.products:
            return []
        everything = SiemensCec(self.machine, replace(self.settings, products=True)).terms(errors, pairs)
        return without_products(self.machine, errors, everything, given)

    def left_out(self, errors: ErrorTable) -> list[str]:
        """Return which tables do not fit in the control, which products are not written, and the error that remains."""
        return self._choice(errors).statements() + self.unwritten_products(errors, ALL_PAIRS)

    def reservations(self, tables: CecTables) -> list[str]:
        """Return what was inferred (sign), left out (products), or is unknown (number of tables)."""
        return cec_reservations(tables.tables, self.settings)

    def _choice(self, errors: ErrorTable) -> Choice:
        terms = self.terms(errors, ALL_PAIRS)
        return chosen_terms(self.machine, errors, terms, self.settings.mult_mode, self.settings.tables_usable)

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> CecTables:
        """Return the tables with balanced folding, in whole units of the last decimal."""
        settings = self.settings
        travel = [axis.range_mm for axis in self.machine.axes]
        tables = folded_tables(basis, values, flip=settings.subtracts, mode=settings.mult_mode, travel_mm=travel)
        return CecTables(around_kept(tables, settings.kept_tables))

    def with_reversal(self, tables: CecTables, reversal: ReversalCurves) -> CecTables:
        """Return the tables plus a pair with DIRECTION 1 and -1 for each reversal."""
        settings = self.settings
        found = with_reversal_tables(
            self.machine,
            tables.tables,
            reversal,
            subtracts=settings.subtracts,
            max_points=settings.max_points,
            step_mm=settings.step_mm,
        )
        return CecTables(around_kept(found, settings.kept_tables))

    def context(self, tables: CecTables) -> dict[str, Any]:
        """Return the tables, the machine data, and the sign convention with an example value from the file."""
        machine, settings = self.machine, self.settings
        sums = largest_sums(machine, tables.tables, settings.mult_mode)
        both = {index: entry for index, entry in tables.tables.items() if entry.direction == 0}
        mean_sums = largest_sums(machine, both, settings.mult_mode) if len(both) < len(tables.tables) else sums
        names, subtracts = settings.axis_names, settings.subtracts
        return {
            "sign_statement": cec_sign_statement(names, subtracts, mean_sums, stated=settings.sign_stated)
            + reversal_statement(tables.tables, names),
            "parameters": cec_parameters(machine, names, tables.tables, settings.mult_mode, sums)
            + backlash_rows(tables.tables, names),
            "warnings": cec_warnings(machine, names, tables.tables, settings, sums),
            "sign": settings.sign,
            "sign_stated": settings.sign_stated,
            "mult_mode": settings.mult_mode,
            "container": settings.container,
            "program_enables": settings.program_enables,
            "outputs": [names[axis] for axis in sorted({entry.output_axis for entry in tables.tables.values()})],
            "has_products": any(entry.multiplier for entry in tables.tables.values()),
            "kept_tables": list(settings.kept_tables),
            "test_tables": [
                index for index in range(len(settings.kept_tables) + 2) if index not in settings.kept_tables
            ],
            "overwrites": cec_overwrites(tables.tables, settings.kept_tables),
            "tables": [
                {
                    **entry.table.context(),
                    "index": index,
                    "label": entry.label,
                    "input": self._styled(entry.input_axis),
                    "output": self._styled(entry.output_axis),
                    "direction": entry.direction,
                    "multiplier": entry.multiplier,
                    "enabled": int(entry.enabled),
                    "weight": float(entry.weight),
                    "decimals": entry.decimals,
                }
                for index, entry in sorted(tables.tables.items())
            ],
        }

    def parse(self, files: Sequence[SourceFile]) -> CecTables:
        """Read the tables; all variables of a table must be present, because the control keeps old values otherwise."""
        return cec_tables_from(read_assignments(files, VARIABLES), files, self.settings)

    def parse_foreign(self, files: Sequence[SourceFile]) -> tuple[CecTables, list[str]]:
        """Read an archive or a program from a real control: the active tables, and a list of what was skipped."""
        findings = Findings()
        given = foreign_assignments(files, VARIABLES, findings)
        return foreign_cec_tables(given, self.machine, self.settings, findings), findings.statements()

    def emulate(self, tables: CecTables, points: Points) -> FloatArray:
        """Return what the control adds: the clipped sum of the tables, subtracted or added according to ``sign``.

        A table with DIRECTION 1 or -1 acts where the last motion of its input axis (``points.approach``) has that
        sign. Where the approach is unknown (0 or None) the table does not act, and a CompgenWarning is issued: the
        documents do not say what a control does before the first motion.
        """
        settings = self.settings
        outputs, position_mm = {}, np.ascontiguousarray(points.position_mm.T)
        for index, entry in tables.tables.items():
            outputs[index] = entry.at(position_mm[entry.input_axis])
            if entry.direction:
                unknown = np.zeros(len(points))
                travel = unknown if points.approach is None else np.sign(points.approach[:, entry.input_axis])
                if np.any(travel == 0):
                    message = (
                        f"a table acts in one direction of {AXES[entry.input_axis]} only, but some points have no approach "
                        "direction: the table is taken as inactive there; give approach_x, approach_y, approach_z"
                    )
                    warnings.warn(message, CompgenWarning, stacklevel=2)
                outputs[index] = np.where(travel == entry.direction, outputs[index], 0.0)
        totals = sum_into_axes(tables.tables, settings.mult_mode, outputs)
        total = np.column_stack([np.broadcast_to(part, (len(points),)) for part in totals])
        if settings.max_sum_mm is not None:
            total = np.clip(total, -np.array(settings.max_sum_mm), np.array(settings.max_sum_mm))
        return -total if settings.subtracts else total

    def by_direction(self, tables: CecTables) -> bool:
        """Return whether a table has a DIRECTION."""
        return any(entry.direction for entry in tables.tables.values())

    def violations(self, tables: CecTables) -> list[str]:
        """Return broken rules of the set, and sums above MD32720 or too fast for MD32730 if those limits are stated."""
        settings = self.settings
        found = set_violations(self.machine, tables.tables, settings.max_points, settings.tables_available)
        found += [
            f"table {index} belongs to another axis (kept_tables in the machine file) and would be overwritten"
            for index in sorted(set(tables.tables) & set(settings.kept_tables))
        ]
        return found + stated_limit_violations(self.machine, tables.tables, settings)

    def keeping_others(self, tables: CecTables, files: Sequence[Path]) -> dict[str, dict[str, Any]]:
        """Return ``kept_tables`` extended by the tables of other axes that an archive contains."""
        kept = sorted({*self.settings.kept_tables, *tables.others})
        if kept == sorted(self.settings.kept_tables):
            return {}
        return {name: {"kept_tables": kept} for name in ("siemens-cec", "siemens-cec-eec")}

    def other_readings(self, tables: CecTables) -> dict[str, Self]:
        """Return the control with each of the three other product modes; empty if there are no products."""
        if not any(entry.multiplier for entry in tables.tables.values()):
            return {}
        return {
            f"mult_mode {mode}: {words}": type(self)(self.machine, replace(self.settings, mult_mode=mode))
            for mode, words in MODE_WORDS.items()
            if mode != self.settings.mult_mode
        }

    def table_nodes_mm(self, tables: CecTables) -> tuple[FloatArray, ...]:
        """Return the nodes of all tables by their input axis."""
        return nodes_by_axis((entry.input_axis, entry.table.nodes_mm) for entry in tables.tables.values())

    def usage(self, tables: CecTables) -> list[Usage]:
        """Return nodes, tables, sums and their rate of change against the limits, or usual defaults if not stated."""
        return cec_usage(self.machine, tables.tables, self.settings)

    def resolution_mm(self) -> float:
        """Half of the last decimal of every ordinary table, plus every product that is too small to be written."""
        ordinary = _ORDINARY_PER_AXIS * 0.5 * 10.0**-MM_DECIMALS
        return ordinary + self.settings.products * (_PRODUCTS_PER_AXIS * NEGLIGIBLE_PRODUCT_MM + _FACTOR_ROUNDING_MM)

    def _styled(self, axis: int) -> str:
        name = self.settings.axis_names[axis]
        return f"({name})" if self.settings.axis_style == "paren" else f'"{name}"'


def cec_tables_from(items: Sequence[Assignment], files: Sequence[SourceFile], settings: CecSettings) -> CecTables:
    """Return the tables that the assignments define; table names are taken from the comments in ``files``."""
    parts: dict[int, TableParts] = {}
    switches: dict[tuple[str, int], Assignment] = {}
    for item in items:
        if item.variable in PROTECTING:
            axis_of(item, item.index[-1], settings.axis_names)
            continue
        index = item.index_number(0, 999)
        if item.variable in SWITCHES:
            switches[item.variable, index] = item
        else:
            parts.setdefault(index, TableParts(f"table {index}", item.source)).add(item)
    labels, found = labels_in(files), {}
    for index, part in sorted(parts.items()):
        part.scalar("$AN_CEC_MULT_BY_TABLE")
        table = part.table("$AN_CEC")
        found[index] = _cec_table(part, table, settings.axis_names, 1_000_000, labels.get(index, ""))
    if not settings.mode_stated:
        for index in (index for index, entry in found.items() if entry.multiplier):
            raise (parts[index].scalar("$AN_CEC_MULT_BY_TABLE").fail(MODE_OF_A_FILE))
    for (variable, index), item in switches.items():
        if variable == "SN_CEC_TABLE_ENABLE" and index in found:
            found[index] = replace(found[index], enabled=item.whole(0, 1) == 1)
        elif index in found:
            found[index] = replace(found[index], weight=item.number())
        elif item.number() != 0:
            raise item.fail(f"the files contain no table {index}")
    return CecTables(found)


def foreign_cec_tables(
    given: ArchiveAssignments, machine: Machine, settings: CecSettings, findings: Findings
) -> CecTables:
    """Return the active tables from the files of a real control.

    Tables with step 0 are not in use; tables of axes that the machine file lacks are listed separately; tables that
    machine data or setting data switch off are off. InputError with the line for anything unknown that could change a
    table.
    """
    parts: dict[int, TableParts] = {}
    for item in given.items:
        if item.variable in SWITCHES:
            continue
        index = item.index_number(0, 999)
        parts.setdefault(index, TableParts(f"table {index}", item.source)).add(item)
    found, apart = {}, set()
    for index, part in sorted(parts.items()):
        if part.is_zero and part.scalar("$AN_CEC_STEP").number() == 0:
            findings.count("unused tables (step 0)")
            continue
        axes = [_axis_name_of(part.scalar(f"$AN_CEC_{side}_AXIS")) for side in ("INPUT", "OUTPUT")]
        if set(axes) <= set(settings.axis_names):
            travel_mm = machine.axes[settings.axis_names.index(axes[0])].range_mm
            table = noted_table(part, "$AN_CEC", travel_mm, findings)
            if "$AN_CEC_MULT_BY_TABLE" not in part.scalars:
                findings.count("tables without MULT_BY_TABLE (taken as 0)")
            found[index] = _cec_table(part, table, settings.axis_names, 1)
        else:
            apart.add(index)
            findings.apart.append(f"table {index} ({axes[0]} into {axes[1]}, up to {part.largest})")
    if missing := sorted(apart - set(settings.kept_tables)):
        findings.notes.append(
            f"new tables must not overwrite those of other axes: export with --active, or set kept_tables = {missing} "
            "in the machine file"
        )
    # products that cannot be evaluated: an axis is missing, or no mode is stated
    for index, part in parts.items():
        factor = part.scalars.get("$AN_CEC_MULT_BY_TABLE")
        number = 0 if factor is None else factor.whole(0, 1_000_000)
        if not number or factor is None:
            continue
        if {index, number - 1} & set(found) and {index, number - 1} & apart:
            raise factor.fail(
                f"table {index} is multiplied by table {number - 1}, but one of the two belongs to an axis that is not in "
                "the machine file"
            )
        if index in found and not settings.mode_stated:
            raise factor.fail(MODE_OF_A_FILE)
    if not found:
        listed = f"; tables of other axes: {'; '.join(findings.apart)}" if apart else ""
        raise next(iter(parts.values())).source.fail(
            f"contains no table whose input and output axes are in the machine file ({', '.join(settings.axis_names)})"
            f"{listed}"
        )
    return CecTables(_switched(found, given, settings, findings), tuple(sorted(apart)))


def _switched(
    found: Mapping[int, CecTable], given: ArchiveAssignments, settings: CecSettings, findings: Findings
) -> dict[int, CecTable]:
    """Apply SD41300 and SD41310 to the tables; tables into an axis whose MD32710 is 0 in an archive are off."""
    result = dict(found)
    among_tables = {(item.variable, item.index): item for item in given.items if item.variable in SWITCHES}
    for (variable, index), item in {**given.machine_data, **among_tables}.items():
        number = whole_number(index[0]) if len(index) == 1 else None
        if number is None or number not in result:
            continue
        if variable == "SN_CEC_TABLE_ENABLE":
            result[number] = replace(result[number], enabled=item.whole(0, 1) == 1)
        elif variable == "SN_CEC_TABLE_WEIGHT":
            result[number] = replace(result[number], weight=item.number())
    for number, entry in result.items():
        name = settings.axis_names[entry.output_axis]
        if entry.enabled and given.switched_off("MA_CEC_ENABLE", (name,)):
            result[number] = replace(entry, enabled=False)
            findings.notes.append(f"$MA_CEC_ENABLE[{name}] is 0 in the archive: the tables into {name} have no effect")
    off = [str(number) for number, entry in result.items() if not entry.enabled]
    if off:
        verb = "tables {} are switched off and have" if len(off) > 1 else "table {} is switched off and has"
        findings.notes.append(f"{verb.format(', '.join(off))} no effect")
    return result


def _cec_table(
    part: TableParts, table: LinearTable, axis_names: Sequence[str], farthest: int, label: str = ""
) -> CecTable:
    """Return a table with its axes, direction (at most ``farthest`` in size) and multiplier (0 if not given)."""
    sides = (part.scalar(f"$AN_CEC_{side}_AXIS") for side in ("INPUT", "OUTPUT"))
    base, output = (axis_of(item, _axis_name_of(item), axis_names) for item in sides)
    factor = part.scalars.get("$AN_CEC_MULT_BY_TABLE")
    return CecTable(
        base,
        output,
        table,
        part.scalar("$AN_CEC_DIRECTION").whole(-farthest, farthest),
        0 if factor is None else factor.whole(0, 1_000_000),
        decimals=written_decimals(table),
        label=label,
    )


def _axis_name_of(item: Assignment) -> str:
    match = _AXIS_VALUE.fullmatch(item.value)
    if match is None:
        raise item.fail(f'{item.value[:40]!r} is not an axis name; write (AX1) or "AX1"')
    return match.group(1) or match.group(2)
