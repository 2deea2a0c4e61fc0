"""Mitsubishi machine error compensation: positioning and relative position errors as a set sheet of whole numbers.

What the control is taken to do, and how sure that is, stands in ``templates/mitsubishi/format.toml``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controllers.base import Controller, SourceFile, Term, Usage, nodes_by_axis
from compgen.controllers.grids import Grid, curve_nodes_mm, equidistant_grid
from compgen.controllers.integers import IntegerCurve, best_integers, lowest_free, section_weights
from compgen.controllers.mitsubishi.context import sheet_context
from compgen.controllers.mitsubishi.records import begins_with_mark
from compgen.controllers.mitsubishi.settings import (
    HIGHEST_VALUE,
    INTERVAL_QUANTUM_MM,
    MitsubishiSettings,
    read_mitsubishi_settings,
)
from compgen.controllers.mitsubishi.tables import (
    MitsubishiTables,
    SetTable,
    Shortfall,
    parse_tables,
    sheet_usage,
    sheet_violations,
    values_of,
)
from compgen.controllers.terms import one_dimensional_name, one_dimensional_terms
from compgen.controllers.transfer_plan import plan_contradictions
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.core.points import Points
from compgen.errors import InputError

#: The final curve may be steeper than the estimate by this factor: angular errors are spread over the volume.
STEEPER = 1.1


class Mitsubishi(Controller[MitsubishiSettings, MitsubishiTables]):
    """Tables of each axis over each axis in counts of half a setting unit, zero at the reference point."""

    name = "mitsubishi"
    anchored = True
    sample_setting = "style_from"

    def read_settings(self, machine: Machine) -> MitsubishiSettings:
        """Check ``[controllers.mitsubishi]``."""
        return read_mitsubishi_settings(machine)

    def missing(self, machine: Machine, settings: MitsubishiSettings) -> InputError | None:
        """Return the error of a mode that neither the machine file nor the control's own file states."""
        if settings.absolute is not None:
            return None
        return machine.controller_settings(self.name).fail(
            "mode",
            "is missing: #4000 holds for the tables of ALL axes, and values of the wrong system are summed up. Give the "
            "control's own parameter file (--style-from ALL.PRM), or look at #4000 and state mode = 'incremental' (1) or "
            "'absolute' (0)",
        )

    def basis(self, machine: Machine, settings: MitsubishiSettings, errors: ErrorTable) -> list[Term]:
        """Return one term per set, its nodes the division points, the reference point one of them."""
        chosen = [_grid(machine, settings, errors, axis).nodes_mm for axis in range(3)]
        terms = []
        for pair in settings.pairs:
            kept = _kept_grid(machine, settings, pair)
            nodes = chosen if kept is None else [kept.nodes_mm] * 3
            terms += one_dimensional_terms(machine, errors, nodes, [pair], anchored=True)
        return terms

    def build(
        self, machine: Machine, settings: MitsubishiSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> MitsubishiTables:
        """Find the best whole curves within the range of the values, and give the sets consecutive numbers."""
        incomplete = self.missing(machine, settings)
        if incomplete is not None:
            raise incomplete
        assert settings.absolute is not None
        terms = {term.name: term for term in basis}
        sets: list[SetTable] = []
        shortfalls: list[Shortfall] = []
        taken = [item.span for item in settings.sample.sets]
        free = settings.free_sets()
        for pair in settings.pairs:
            output, base = pair
            term = terms[one_dimensional_name(output, base)]
            at = int(np.argmin(np.abs(term.nodes_mm - machine.reference_point_mm[base])))
            best = _best_counts(machine, settings, pair, term.nodes_mm, values[term.name], at)
            numbers = values_of(best.counts, at, settings.kept_at_reference(pair), absolute=settings.absolute)
            kept, own = settings.kept(pair), settings.own_set(pair)
            first = lowest_free(taken, settings.first_number, len(numbers)) if kept is None else kept.first
            _check_free(settings, pair, first, first + len(numbers) - 1)
            taken.append((first, first + len(numbers) - 1))
            index = free.pop(0) if own is None else own.index
            interval = _interval(term.nodes_mm)
            scale = settings.scale_of(pair)
            sets.append(SetTable(base, output, first + at, first, numbers, scale, interval, settings.absolute, index))
            if best.limited:
                shortfalls.append(Shortfall(output, base, best.largest))
        return MitsubishiTables(tuple(sorted(sets, key=lambda table: table.index)), tuple(shortfalls))

    def context(self, machine: Machine, settings: MitsubishiSettings, tables: MitsubishiTables) -> dict[str, Any]:
        """Return the rows of the sheet, the plan number -> value, parameters and the statement of the sign."""
        return sheet_context(machine, settings, tables)

    def parse(self, machine: Machine, settings: MitsubishiSettings, files: Sequence[SourceFile]) -> MitsubishiTables:
        """Read the set sheet or the parameter file of the control; a ``.json`` plan is passed over."""
        return parse_tables(settings, files)

    def contradictions(
        self, machine: Machine, settings: MitsubishiSettings, tables: MitsubishiTables, files: Sequence[SourceFile]
    ) -> list[str]:
        """Say where a plan beside the text differs from it."""
        return plan_contradictions(files, lambda: self.context(machine, settings, tables)["plan"])

    def remarks(
        self, machine: Machine, settings: MitsubishiSettings, tables: MitsubishiTables, files: Sequence[SourceFile]
    ) -> list[str]:
        """Say which system the values have, which sets were kept apart, and how many lines were passed over."""
        return list(tables.remarks)

    def emulate(
        self, machine: Machine, settings: MitsubishiSettings, tables: MitsubishiTables, points: Points
    ) -> FloatArray:
        """Return the sum of the sets' curves, linear between division points, held beyond the ends."""
        added = np.zeros((len(points), 3))
        for table in tables.sets:
            along = points.position_mm[:, table.base] - machine.reference_point_mm[table.base]
            counts = np.interp(along, table.along_mm, table.curve)
            added[:, table.output] += settings.sign * settings.half_unit_mm * table.scale * counts
        return added

    def violations(self, machine: Machine, settings: MitsubishiSettings, tables: MitsubishiTables) -> list[str]:
        """Return broken limits: values, numbers, overlaps, scale, travel left out."""
        return sheet_violations(machine, settings, tables)

    def table_nodes_mm(
        self, machine: Machine, settings: MitsubishiSettings, tables: MitsubishiTables
    ) -> tuple[FloatArray, ...]:
        """Return the division points of each base axis."""
        return nodes_by_axis((t.base, machine.reference_point_mm[t.base] + t.along_mm) for t in tables.sets)

    def usage(self, machine: Machine, settings: MitsubishiSettings, tables: MitsubishiTables) -> list[Usage]:
        """Return the largest value, numbers and sets against their limits."""
        return sheet_usage(settings, tables)

    def keeping_others(
        self, machine: Machine, settings: MitsubishiSettings, tables: MitsubishiTables, files: Sequence[Path]
    ) -> dict[str, dict[str, Any]]:
        """Return ``style_from`` with the parameter file of the control, if that is among the files."""
        own = [] if settings.sample.file is not None else list(filter(begins_with_mark, files))
        return {self.name: {"style_from": str(own[0].resolve())}} if len(own) == 1 else {}

    def resolution_mm(self, settings: MitsubishiSettings) -> float:
        """Half a count of each table that acts on an axis, where the range of the values does not bind."""
        most = max(settings.count_mm(pair) for pair in settings.pairs)
        return 0.5 * most * max(sum(1 for output, _ in settings.pairs if output == axis) for axis in range(3))


def _kept_grid(machine: Machine, settings: MitsubishiSettings, pair: tuple[int, int]) -> Grid | None:
    """Division points of the control's own set for a table, None if there is none that is kept."""
    kept = settings.kept(pair)
    if kept is None:
        return None
    if not kept.first <= kept.reference <= kept.last:
        raise kept.entry.fail(
            f"set {kept.index + 1} has the reference number {kept.reference} and the numbers {kept.first} to {kept.last}, "
            "which cannot be kept: state interval_mm in the machine file for new ones"
        )
    start = Decimal(repr(machine.reference_point_mm[pair[1]])) + (kept.first - kept.reference) * kept.interval_mm
    return Grid(start, kept.interval_mm, kept.last - kept.first + 1)


def _check_free(settings: MitsubishiSettings, pair: tuple[int, int], first: int, last: int) -> None:
    """Refuse numbers that a set of another table in the control's file uses."""
    own = settings.own_set(pair)
    for item in settings.sample.sets:
        low, high = item.span
        if item is not own and first <= high and last >= low:
            raise item.entry.fail(
                f"set {item.index + 1} ({item.output} over {item.base}) uses the numbers {low} to {high}; {first} to {last} of "
                f"{AXES[pair[0]]}({AXES[pair[1]].lower()}) would overwrite them. State interval_mm for new numbers"
            )


def _grid(machine: Machine, settings: MitsubishiSettings, errors: ErrorTable, axis: int) -> Grid:
    """Division points of a base axis: equal intervals in whole 0.001 mm, an equal share of the numbers for each set.

    The interval is the user's, else the widest that loses nothing that matters and keeps every value, with a margin,
    within its range, as far as the numbers suffice.
    """
    new = [pair for pair in settings.pairs if settings.kept(pair) is None]
    used = sum(item.span[1] - item.span[0] + 1 for item in settings.sample.sets)
    most = max(3, (settings.last_number - settings.first_number + 1 - used) // max(len(new), 1))

    def grid_of(step_mm: float | None) -> Grid:
        output = None if settings.across else axis
        return equidistant_grid(
            machine, errors, axis, most=most, step_mm=step_mm, anchor=True, loss_mm=settings.loss_mm, output=output
        )

    asked = settings.interval_mm[axis]
    if asked is not None:
        return grid_of(asked)
    grid = grid_of(None)
    largest = 0.0 if settings.absolute else _largest_step(machine, settings, errors, axis, grid)
    share = min(1.0, (HIGHEST_VALUE - 1) / max(STEEPER * largest, 1e-9))
    if share == 1.0 and not grid.step % INTERVAL_QUANTUM_MM:
        return grid
    rounding = ROUND_CEILING if share == 1.0 else ROUND_FLOOR
    quanta = (grid.step * Decimal(repr(share)) / INTERVAL_QUANTUM_MM).to_integral_value(rounding=rounding)
    # Two nodes less: with the reference point as a node the ends may need one more on either side.
    least = Decimal(repr(machine.axes[axis].length_mm)) / max(most - 3, 1) / INTERVAL_QUANTUM_MM
    return grid_of(float(max(quanta, least.to_integral_value(rounding=ROUND_CEILING)) * INTERVAL_QUANTUM_MM))


def _largest_step(machine: Machine, settings: MitsubishiSettings, errors: ErrorTable, axis: int, grid: Grid) -> float:
    """Largest change of a wanted correction over one interval, in counts; it stays in proportion to the interval."""
    fine = np.unique(np.concatenate([grid.nodes_mm, curve_nodes_mm(machine, errors, axis)]))
    pairs = [pair for pair in settings.pairs if pair[1] == axis]
    terms = one_dimensional_terms(machine, errors, [fine] * 3, pairs)
    steepest = max(
        float(np.max(np.abs(np.diff(term.start) / np.diff(fine)))) / settings.count_mm(pair)
        for term, pair in zip(terms, pairs, strict=True)
    )
    return steepest * float(grid.step)


def _interval(nodes_mm: FloatArray) -> Decimal:
    return Decimal(repr(float(nodes_mm[1] - nodes_mm[0]))).quantize(INTERVAL_QUANTUM_MM)


def _best_counts(
    machine: Machine,
    settings: MitsubishiSettings,
    pair: tuple[int, int],
    nodes_mm: FloatArray,
    values_mm: FloatArray,
    at: int,
) -> IntegerCurve:
    """Return the best curve in counts at the division points for corrections (n,), zero at index ``at``.

    In the absolute system steps of any size can be stored; the limits say where a sum is out of range.
    """
    base = pair[1]
    wanted = settings.sign * (np.asarray(values_mm) - values_mm[at]) / settings.count_mm(pair)
    emphasis = machine.emphasis
    sections = section_weights(nodes_mm, machine.axes[base].range_mm, emphasis.zone_mm[base], emphasis.zone_weight)
    limit = int(2 * np.max(np.abs(wanted))) + 2 if settings.absolute else HIGHEST_VALUE
    return best_integers(wanted, sections, at, limit)
