"""Mitsubishi machine error compensation: positioning and relative position errors as a set sheet of whole numbers.

What the control is taken to do, and how sure that is, stands in ``templates/mitsubishi/format.toml``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from typing import Any

import numpy as np

from compgen.controllers.base import Controller, SourceFile, Term, Usage, nodes_by_axis
from compgen.controllers.grids import Grid, curve_nodes_mm, equidistant_grid
from compgen.controllers.integers import IntegerCurve, best_integers, section_weights
from compgen.controllers.mitsubishi.context import sheet_context
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
    parse_sheet,
    sheet_usage,
    sheet_violations,
    values_of,
)
from compgen.controllers.terms import one_dimensional_name, one_dimensional_terms
from compgen.controllers.transfer_plan import plan_contradictions
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.points import Points

#: The final curve may be steeper than the estimate by this factor: angular errors are spread over the volume.
STEEPER = 1.1


class Mitsubishi(Controller[MitsubishiSettings, MitsubishiTables]):
    """Tables of each axis over each axis in counts of half a setting unit, zero at the reference point."""

    name = "mitsubishi"
    anchored = True

    def read_settings(self, machine: Machine) -> MitsubishiSettings:
        """Check ``[controllers.mitsubishi]``."""
        return read_mitsubishi_settings(machine)

    def basis(self, machine: Machine, settings: MitsubishiSettings, errors: ErrorTable) -> list[Term]:
        """Return one term per set, its nodes the division points, the reference point one of them."""
        nodes = [_grid(machine, settings, errors, axis).nodes_mm for axis in range(3)]
        return one_dimensional_terms(machine, errors, nodes, settings.pairs, anchored=True)

    def build(
        self, machine: Machine, settings: MitsubishiSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> MitsubishiTables:
        """Find the best whole curves within the range of the values, and give the sets consecutive numbers."""
        terms = {term.name: term for term in basis}
        sets: list[SetTable] = []
        shortfalls: list[Shortfall] = []
        free = settings.first_number
        for output, base in settings.pairs:
            term = terms[one_dimensional_name(output, base)]
            at = int(np.argmin(np.abs(term.nodes_mm - machine.reference_point_mm[base])))
            best = _best_counts(machine, settings, base, term.nodes_mm, values[term.name], at)
            numbers = values_of(best.counts, at)
            sets.append(SetTable(base, output, free + at, free, numbers, settings.scale, _interval(term.nodes_mm)))
            free += len(numbers)
            if best.limited:
                shortfalls.append(Shortfall(output, base, best.largest))
        return MitsubishiTables(tuple(sets), tuple(shortfalls))

    def context(self, machine: Machine, settings: MitsubishiSettings, tables: MitsubishiTables) -> dict[str, Any]:
        """Return the rows of the sheet, the plan number -> value, parameters and the statement of the sign."""
        return sheet_context(machine, settings, tables)

    def parse(self, machine: Machine, settings: MitsubishiSettings, files: Sequence[SourceFile]) -> MitsubishiTables:
        """Read the set sheet; a ``.json`` plan is passed over."""
        return parse_sheet(settings, files)

    def contradictions(
        self, machine: Machine, settings: MitsubishiSettings, tables: MitsubishiTables, files: Sequence[SourceFile]
    ) -> list[str]:
        """Say where a plan beside the text differs from it."""
        return plan_contradictions(files, lambda: self.context(machine, settings, tables)["plan"])

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

    def resolution_mm(self, settings: MitsubishiSettings) -> float:
        """Half a count of each table that acts on an axis, where the range of the values does not bind."""
        return 0.5 * settings.count_mm * (3 if settings.relative else 1)


def _grid(machine: Machine, settings: MitsubishiSettings, errors: ErrorTable, axis: int) -> Grid:
    """Division points of a base axis: equal intervals in whole 0.001 mm, an equal share of the numbers for each set.

    The interval is the user's, else the widest that loses nothing that matters and keeps every value, with a margin,
    within its range, as far as the numbers suffice.
    """
    most = (settings.last_number - settings.first_number + 1) // len(settings.pairs)

    def grid_of(step_mm: float | None) -> Grid:
        output = None if settings.relative else axis
        return equidistant_grid(
            machine, errors, axis, most=most, step_mm=step_mm, anchor=True, loss_mm=settings.loss_mm, output=output
        )

    asked = settings.interval_mm[axis]
    if asked is not None:
        return grid_of(asked)
    grid = grid_of(None)
    largest = _largest_step(machine, settings, errors, axis, grid)
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
    steepest = max(float(np.max(np.abs(np.diff(term.start) / np.diff(fine)))) for term in terms)
    return steepest * float(grid.step) / settings.count_mm


def _interval(nodes_mm: FloatArray) -> Decimal:
    return Decimal(repr(float(nodes_mm[1] - nodes_mm[0]))).quantize(INTERVAL_QUANTUM_MM)


def _best_counts(
    machine: Machine, settings: MitsubishiSettings, base: int, nodes_mm: FloatArray, values_mm: FloatArray, at: int
) -> IntegerCurve:
    """Return the best curve in counts at the division points for corrections (n,), zero at index ``at``."""
    wanted = settings.sign * (np.asarray(values_mm) - values_mm[at]) / settings.count_mm
    emphasis = machine.emphasis
    sections = section_weights(nodes_mm, machine.axes[base].range_mm, emphasis.zone_mm[base], emphasis.zone_weight)
    return best_integers(wanted, sections, at, HIGHEST_VALUE)
