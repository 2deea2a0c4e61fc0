"""Mitsubishi machine error compensation (``mitsubishi``): positioning and relative position errors in whole numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controls.mitsubishi_tables import (
    BASE,
    FIRST_NUMBER,
    HIGHEST_VALUE,
    INTERVAL_QUANTUM_MM,
    SET_STEP,
    SYSTEM,
    ControlSet,
    MitsubishiSettings,
    MitsubishiTables,
    SetShortfall,
    SetTable,
    begins_with_mark,
    parse_tables,
    read_mitsubishi_settings,
    sheet_usage,
    sheet_violations,
    shortfall_text,
    values_of,
)
from compgen.controls.shared.base import Controller, SourceFile, Term, Usage, nodes_by_axis
from compgen.controls.shared.grids import EquidistantGrid, curve_nodes_mm, equidistant_grid
from compgen.controls.shared.integers import best_integers, lowest_free, travel_weights
from compgen.controls.shared.terms import one_dimensional_name, one_dimensional_terms
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.errors import InputError

# What the templates of machine error compensation show: rows of the set sheet, plan, worked numbers, warnings.


#: Name and meaning of the seven parameters of a set, in the order of their numbers.
MEANINGS = (
    ("cmpax", "base axis"),
    ("drcax", "axis that is compensated"),
    ("rdvno", "number at the reference point"),
    ("mdvno", "farthest number on the negative side"),
    ("pdvno", "farthest number on the positive side"),
    ("sc", "compensation scale factor"),
    ("spcdv", "division interval in mm"),
)


def _same(old: str, new: str) -> bool:
    try:
        return Decimal(old) == Decimal(new)
    except InvalidOperation:
        return old == new


def _row(number: int, value: str, meaning: str) -> dict[str, str]:
    return {"number": str(number), "value": value, "meaning": meaning}


# Mitsubishi machine error compensation: positioning and relative position errors as a set sheet of whole numbers.
#
# What the control is taken to do, and how sure that is, is in ``templates/mitsubishi/format.toml``.


#: The final curve may be steeper than the estimate by this factor: angular errors are spread over the volume.
STEEPER = 1.1


class Mitsubishi(Controller[MitsubishiSettings, MitsubishiTables]):
    """Tables of each axis over each axis in counts of half a setting unit, zero at the reference point."""

    name = "mitsubishi"
    settings_class = MitsubishiSettings
    anchored = True
    has_plan = True
    sample_setting = "style_from"

    @classmethod
    def read_settings(cls, machine: Machine) -> MitsubishiSettings:
        """Check ``[controllers.mitsubishi]``."""
        return read_mitsubishi_settings(machine)

    def missing(self) -> InputError | None:
        """Return the error of a mode that neither the machine file nor the control's own file states."""
        if self.settings.absolute is not None:
            return None
        return self.machine.controller_settings(self.name).fail(
            "mode",
            "is missing: #4000 holds for the tables of ALL axes, and values of the wrong system are summed up. Give the "
            "control's own parameter file (--style-from ALL.PRM), or look at #4000 and state mode = 'incremental' (1) or "
            "'absolute' (0)",
        )

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return one term per set, its nodes the division points, the reference point one of them."""
        chosen = [self._grid(errors, axis).nodes_mm for axis in range(3)]
        terms = []
        for pair in self.settings.pairs:
            kept, nodes = self.settings.kept(pair), chosen
            if kept is not None:
                if not kept.first <= kept.reference <= kept.last:
                    raise kept.entry.fail(
                        f"set {kept.index + 1} has the reference number {kept.reference} and the numbers {kept.first} to "
                        f"{kept.last}, which cannot be kept: state interval_mm in the machine file for new ones"
                    )
                reference = Decimal(repr(self.machine.reference_point_mm[pair[1]]))
                start = reference + (kept.first - kept.reference) * kept.interval_mm
                nodes = [EquidistantGrid(start, kept.interval_mm, kept.last - kept.first + 1).nodes_mm] * 3
            terms += one_dimensional_terms(self.machine, errors, nodes, [pair], anchored=True)
        return terms

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> MitsubishiTables:
        """Find the best whole curves within the range of the values, and give the sets consecutive numbers."""
        settings = self.settings
        incomplete = self.missing()
        if incomplete is not None:
            raise incomplete
        assert settings.absolute is not None
        terms = {term.name: term for term in basis}
        sets: list[SetTable] = []
        shortfalls: list[SetShortfall] = []
        taken = [item.span for item in settings.sample.sets]
        free = settings.free_sets()
        for pair in settings.pairs:
            output, base = pair
            term = terms[one_dimensional_name(output, base)]
            at = int(np.argmin(np.abs(term.nodes_mm - self.machine.reference_point_mm[base])))
            corrections = np.asarray(values[term.name])
            wanted = settings.sign * (corrections - corrections[at]) / settings.count_mm(pair)
            # sums can take steps of any size; violations say where one is out of range
            limit = int(2 * np.max(np.abs(wanted))) + 2 if settings.absolute else HIGHEST_VALUE
            best = best_integers(wanted, travel_weights(self.machine, base, term.nodes_mm), at, limit)
            numbers = values_of(best.counts, at, settings.kept_at_reference(pair), absolute=settings.absolute)
            kept, own = settings.kept(pair), settings.own_set(pair)
            first = lowest_free(taken, settings.first_number, len(numbers)) if kept is None else kept.first
            self._check_free(pair, first, first + len(numbers) - 1)
            taken.append((first, first + len(numbers) - 1))
            index = free.pop(0) if own is None else own.index
            interval = Decimal(repr(float(term.nodes_mm[1] - term.nodes_mm[0]))).quantize(INTERVAL_QUANTUM_MM)
            scale = settings.scale_of(pair)
            sets.append(SetTable(base, output, first + at, first, numbers, scale, interval, settings.absolute, index))
            if best.limited:
                shortfalls.append(SetShortfall(output, base, best.largest))
        return MitsubishiTables(tuple(sorted(sets, key=lambda table: table.index)), tuple(shortfalls))

    def context(self, tables: MitsubishiTables) -> dict[str, Any]:
        """Return the context beyond the common one; ``rows`` are the sheet's, ``plan`` holds number -> value."""
        settings = self.settings
        absolute = tables.sets[0].absolute
        parameters, values = self._rows(tables)
        return {
            "sign_statement": self._sign_statement(tables),
            "parameters": [
                {"name": f"#{row['number']}", "value": row["value"], "meaning": row["meaning"]} for row in parameters
            ],
            "warnings": self._warnings(tables),
            "rows": parameters + values,
            "plan": {
                "parameters": {row["number"]: row["value"] for row in parameters},
                "values": {row["number"]: int(row["value"]) for row in values},
                "setting_unit_um": settings.setting_unit_um,
                "stores": "correction" if settings.adds else "error",
            },
            "tables": [self._summary(table) for table in tables.sets],
            "check": self._check(tables.sets[0]),
            "stores": "correction" if settings.adds else "error",
            "count_um": settings.half_unit_mm / MM_PER_UM,
            "absolute": absolute,
            "has_sample": settings.sample.file is not None,
            "container": "control's file" if settings.sample.file is not None else "sheet",
            "control_file": self._control_file({row["number"]: row["value"] for row in parameters + values}),
            "overwrites": self._overwrites(tables, parameters + values),
        }

    def parse(self, files: Sequence[SourceFile]) -> MitsubishiTables:
        """Read the set sheet or the parameter file of the control; a ``.json`` plan is passed over."""
        return parse_tables(self.settings, files)

    def emulate(self, tables: MitsubishiTables, points: Points) -> FloatArray:
        """Return the sum of the sets' curves, linear between division points, held beyond the ends."""
        added = np.zeros((len(points), 3))
        for table in tables.sets:
            along = points.position_mm[:, table.base] - self.machine.reference_point_mm[table.base]
            counts = np.interp(along, table.along_mm, table.curve)
            added[:, table.output] += self.settings.sign * self.settings.half_unit_mm * table.scale * counts
        return added

    def violations(self, tables: MitsubishiTables) -> list[str]:
        """Return broken limits: values, numbers, overlaps, scale, travel left out."""
        return sheet_violations(self.machine, self.settings, tables)

    def table_nodes_mm(self, tables: MitsubishiTables) -> tuple[FloatArray, ...]:
        """Return the division points of each base axis."""
        return nodes_by_axis((t.base, self.machine.reference_point_mm[t.base] + t.along_mm) for t in tables.sets)

    def usage(self, tables: MitsubishiTables) -> list[Usage]:
        """Return the largest value, numbers and sets against their limits."""
        return sheet_usage(self.settings, tables)

    def keeping_others(self, tables: MitsubishiTables, files: Sequence[Path]) -> dict[str, dict[str, Any]]:
        """Return ``style_from`` with the parameter file of the control, if that is among the files."""
        own = [] if self.settings.sample.file is not None else list(filter(begins_with_mark, files))
        return {self.name: {"style_from": str(own[0].resolve())}} if len(own) == 1 else {}

    def resolution_mm(self) -> float:
        """Half a count of each table that acts on an axis, where the range of the values does not bind."""
        most = max(self.settings.count_mm(pair) for pair in self.settings.pairs)
        return 0.5 * most * max(sum(1 for output, _ in self.settings.pairs if output == axis) for axis in range(3))

    def _control_file(self, rows: dict[str, str]) -> SourceFile | None:
        """The control's own parameter file with the rows put in, every other line byte for byte as it was."""
        settings = self.settings
        if settings.sample.file is None:
            return None
        lines = settings.sample.file.text.split("\n")
        new = dict(rows)
        for number, entry in settings.sample.entries.items():
            value = new.pop(str(number), None)
            if value is not None and number != SYSTEM:
                line = lines[entry.line - 1]
                behind = "\r" if line.endswith("\r") else ""
                lines[entry.line - 1] = f"N{number}P{value}{behind}"
        if new:
            raise settings.sample.file.fail(
                f"has no #{next(iter(new))}, which the tables need; state last_number or first_set"
            )
        return SourceFile(settings.sample.file.path, "\n".join(lines))

    def _overwrites(self, tables: MitsubishiTables, rows: list[dict[str, str]]) -> list[str]:
        """Say what sheet and file overwrite, other axes first."""
        sample = self.settings.sample
        others = [
            f"set {item.index + 1} ({item.output} over {item.base}, numbers {item.span[0]} to {item.span[1]})"
            for item in sample.others(self.settings.axis_names)
        ]
        if sample.file is None:
            found = [
                "Of other axes: NOT KNOWN, the control's own file was not given (`--style-from ALL.PRM`). Sets and numbers below "
                f"that another axis uses are lost, and #{SYSTEM} changes how the values of every axis are read."
            ]
        else:
            found = [f"Of other axes: nothing. {'; '.join(others) + ' stay' if others else 'No other axis has a set'}."]
        for table in tables.sets:
            first = BASE + SET_STEP * table.index
            numbers = f"#{table.first} to #{table.last}"
            pair = table.name
            found.append(f"Set {table.index + 1} (#{first} to #{first + 6}) and numbers {numbers}: {pair}")
        changed = [
            row
            for row in rows
            if (old := sample.entries.get(int(row["number"]))) and not _same(old.value, row["value"])
        ]
        if sample.file is not None:
            parameters = [
                f"#{row['number']} = {row['value']} (was {sample.entries[int(row['number'])].value or 'empty'})"
                for row in changed
                if int(row["number"]) < FIRST_NUMBER
            ]
            found.append(f"Parameters that change: {', '.join(parameters) or 'none'}")
            found.append(f"Values that change: {len(changed) - len(parameters)}")
        for table in tables.sets:
            constant = table.at_reference * self.settings.half_unit_mm * table.scale / MM_PER_UM
            if table.absolute and constant:
                found.append(
                    f"The value at the reference number #{table.reference} stays {table.at_reference}: a constant of "
                    f"{constant:g} um in all values of {table.name}, which shifts the zero "
                    "of the axis as before"
                )
            own = self.settings.own_set((table.output, table.base))
            old = None if own is None else sample.entries.get(own.reference)
            if table.absolute and not table.at_reference and old is not None and not _same(old.value or "0", "0"):
                found.append(
                    f"The value at the reference number #{old.number} was {old.value} and is now 0: "
                    f"{AXES[table.output]} shifts by a constant, set the workpiece up anew"
                )
        cleared = [f"set {item.index + 1} ({item.output} over {item.base})" for item in self._no_longer_used(tables)]
        if cleared:
            found.append(f"Switched off, because this export has no such table: {', '.join(cleared)}")
        return found

    def _no_longer_used(self, tables: MitsubishiTables) -> list[ControlSet]:
        """Sets of X, Y, Z in the control's file that hold none of the tables: they would still act, with the new ones."""
        written = {table.index for table in tables.sets}
        others = self.settings.sample.others(self.settings.axis_names)
        return [item for item in self.settings.sample.sets if item.index not in written and item not in others]

    def _rows(self, tables: MitsubishiTables) -> tuple[list[dict[str, str]], list[dict[str, str]]]:
        """Rows of the sheet: parameters of the sets, and values."""
        names, absolute = self.settings.axis_names, tables.sets[0].absolute
        known = "as the control has it" if self.settings.sample.file is not None else "must be the control's own value"
        system = f"Pinc: {'absolute values' if absolute else 'increments'}; holds for the sets of ALL axes and {known}"
        parameters, values = [_row(SYSTEM, str(int(not absolute)), system)], []
        for table in tables.sets:
            numbers = (table.reference, table.first, table.last, table.scale)
            cells = (names[table.base], names[table.output], *map(str, numbers), f"{table.interval_mm:.3f}")
            parameters += [
                _row(BASE + k + SET_STEP * table.index, cell, f"{name}: {meaning}; set {table.index + 1}")
                for k, (cell, (name, meaning)) in enumerate(zip(cells, MEANINGS, strict=True))
            ]
            positions = self.machine.reference_point_mm[table.base] + table.along_mm
            values += [
                _row(table.first + k, str(value), f"{table.name} at {AXES[table.base]} {positions[k]:.3f} mm")
                for k, value in enumerate(table.values)
            ]
        for item in self._no_longer_used(tables):
            parameters += [
                _row(BASE + k + SET_STEP * item.index, "", f"set {item.index + 1} is no longer used") for k in (0, 1)
            ]
        return parameters, values

    def _summary(self, table: SetTable) -> dict[str, Any]:
        ends = self.machine.reference_point_mm[table.base] + table.along_mm
        return {
            "pair": table.name,
            "first": table.first,
            "last": table.last,
            "reference": table.reference,
            "interval_mm": float(table.interval_mm),
            "first_mm": float(ends[0]),
            "last_mm": float(ends[-1]),
            "largest": max(map(abs, table.values)),
        }

    def _sign_statement(self, tables: MitsubishiTables) -> str:
        settings = self.settings
        stored = "the correction" if settings.adds else "the error"
        scales = sorted({table.scale for table in tables.sets})
        count_um = settings.half_unit_mm * scales[0] / MM_PER_UM
        count = (
            f"one count is {count_um:g} um (half of the setting unit {settings.setting_unit_um:g} um, times the scale "
            f"{', '.join(map(str, scales))})"
        )
        if tables.sets[0].absolute:
            return (
                f"The numbers are {stored}, as sums up to their division point, zero at the reference point (#4000 = 0); "
                f"{count}. An axis that stands {20 * count_um:g} um too low at a point gets {20 * settings.sign:+d} there (scale "
                f"{scales[0]})."
            )
        return (
            f"The numbers are {stored}, as steps from one division point to the next away from the reference point (#4000 = 1); "
            f"{count}. An axis that travels {20 * count_um:g} um too short over one interval, in either direction away from the "
            f"reference point, gets {20 * settings.sign:+d} there (scale {scales[0]})."
        )

    def _warnings(self, tables: MitsubishiTables) -> list[str]:
        system = (
            f"#{SYSTEM} holds for the tables of ALL axes. Read it at the control first: if it is not "
            f"{int(not tables.sets[0].absolute)}, do not enter the sheet; set mode in the machine file and export again."
        )
        return [
            "The parameter numbers are those that are remembered of the M series; no document was read. Compare them with "
            "the parameter manual of the control before anything is entered.",
            *([] if self.settings.sample.file is not None else [system]),
            "The direction of the values on the negative side follows from the formula of the manual, not from an example: "
            "check it at one division on each side (part 3).",
            *(shortfall_text(self.settings, item) for item in tables.shortfalls if item.missed_counts <= 1.0),
        ]

    def _check(self, table: SetTable) -> dict[str, Any]:
        """A trial of one division next to the reference point: which number to set, what a laser must then read."""
        upper = table.last > table.reference
        number = table.reference + (1 if upper else -1)
        start_mm = self.machine.reference_point_mm[table.base]
        counts = min(20, HIGHEST_VALUE)
        step_mm = float(table.interval_mm) * (1 if upper else -1)
        outwards = 1 if upper or table.absolute else -1
        moved = self.settings.sign * counts * self.settings.half_unit_mm * table.scale / MM_PER_UM * outwards
        return {
            "axis": AXES[table.base],
            "number": number,
            "from_mm": start_mm,
            "to_mm": start_mm + step_mm,
            "counts": counts,
            "change_um": moved,
            "other_change_um": moved if table.absolute else -moved,
            "both_sides": table.first < table.reference < table.last,
            "other_number": table.reference - 1,
            "other_to_mm": start_mm - float(table.interval_mm),
            "interval_mm": float(table.interval_mm),
        }

    def _check_free(self, pair: tuple[int, int], first: int, last: int) -> None:
        """Refuse numbers that a set of another table in the control's file uses."""
        own = self.settings.own_set(pair)
        for item in self.settings.sample.sets:
            low, high = item.span
            if item is not own and first <= high and last >= low:
                raise item.entry.fail(
                    f"set {item.index + 1} ({item.output} over {item.base}) uses the numbers {low} to {high}; {first} to {last} "
                    f"of {one_dimensional_name(*pair)} would overwrite them. State interval_mm for new numbers"
                )

    def _grid(self, errors: ErrorTable, axis: int) -> EquidistantGrid:
        """Division points of a base axis: equal intervals in whole 0.001 mm, an equal share of the numbers for each set.

        The interval is the user's, else the widest that loses nothing that matters and keeps every value, with a margin,
        within its range, as far as the numbers suffice.
        """
        settings = self.settings
        new = [pair for pair in settings.pairs if settings.kept(pair) is None]
        used = sum(item.span[1] - item.span[0] + 1 for item in settings.sample.sets)
        most = max(3, (settings.last_number - settings.first_number + 1 - used) // max(len(new), 1))

        def grid_of(step_mm: float | None) -> EquidistantGrid:
            output = None if settings.across else axis
            return equidistant_grid(
                self.machine,
                errors,
                axis,
                most=most,
                step_mm=step_mm,
                anchor=True,
                loss_mm=settings.loss_mm,
                output=output,
            )

        asked = settings.interval_mm[axis]
        if asked is not None:
            return grid_of(asked)
        grid = grid_of(None)
        largest = 0.0  # change of a correction over one interval, in counts; it stays in proportion to the interval
        if not settings.absolute:
            fine = np.unique(np.concatenate([grid.nodes_mm, curve_nodes_mm(self.machine, errors, axis)]))
            pairs = [pair for pair in settings.pairs if pair[1] == axis]
            for term, pair in zip(one_dimensional_terms(self.machine, errors, [fine] * 3, pairs), pairs, strict=True):
                steepest = float(np.max(np.abs(np.diff(term.start) / np.diff(fine)))) / settings.count_mm(pair)
                largest = max(largest, steepest * float(grid.step))
        share = min(1.0, (HIGHEST_VALUE - 1) / max(STEEPER * largest, 1e-9))
        if share == 1.0 and not grid.step % INTERVAL_QUANTUM_MM:
            return grid
        rounding = ROUND_CEILING if share == 1.0 else ROUND_FLOOR
        quanta = (grid.step * Decimal(repr(share)) / INTERVAL_QUANTUM_MM).to_integral_value(rounding=rounding)
        # Two nodes less: with the reference point as a node the ends may need one more on either side.
        least = Decimal(repr(self.machine.axes[axis].length_mm)) / max(most - 3, 1) / INTERVAL_QUANTUM_MM
        return grid_of(float(max(quanta, least.to_integral_value(rounding=ROUND_CEILING)) * INTERVAL_QUANTUM_MM))
