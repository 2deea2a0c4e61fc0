"""FANUC straightness compensation: one axis shifted as a function of another, a polyline of four knots each.

What the control is taken to do, and how little of it is settled, stands in ``templates/fanuc-straightness/format.toml``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controllers.base import Controller, Monomial, SourceFile, Term, Usage, nodes_by_axis
from compgen.controllers.fanuc.polyline import Polyline, best_polyline
from compgen.controllers.fanuc.sample import as_sample
from compgen.controllers.fanuc.straightness_context import straightness_context
from compgen.controllers.fanuc.straightness_settings import StraightnessSettings, read_straightness_settings
from compgen.controllers.fanuc.straightness_tables import (
    MOVING,
    POINTS,
    StraightTable,
    StraightTables,
    free_entries,
    parse_straightness,
    straightness_usage,
    straightness_violations,
)
from compgen.controllers.grids import curve_nodes_mm
from compgen.controllers.terms import one_dimensional_name, one_dimensional_terms
from compgen.controllers.transfer_plan import plan_contradictions
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.points import Points
from compgen.errors import InputError


class FanucStraightness(Controller[StraightnessSettings, StraightTables]):
    """Up to three tables such as Y(x), each moving axis once; zero at the reference point but for the rounding."""

    name = "fanuc-straightness"
    anchored = True
    sample_setting = "style_from"

    def read_settings(self, machine: Machine) -> StraightnessSettings:
        """Check ``[controllers.fanuc-straightness]``."""
        return read_straightness_settings(machine)

    def basis(self, machine: Machine, settings: StraightnessSettings, errors: ErrorTable) -> list[Term]:
        """Return one term per chosen pair; its four nodes are the best of all allowed knots for the curve."""
        terms = []
        for output, axis in _chosen(machine, settings, errors):
            candidates = _candidates_mm(machine, settings, axis)
            line = _fitted(machine, settings, errors, output, axis)
            nodes_mm = candidates[list(line.knots)]
            reference = machine.reference_point_mm[axis]
            start = line.values - np.interp(reference, nodes_mm, line.values)
            name = one_dimensional_name(output, axis)
            terms.append(Term(name, axis, nodes_mm, (Monomial(output),), start, reference))
        return terms

    def build(
        self,
        machine: Machine,
        settings: StraightnessSettings,
        basis: Sequence[Term],
        values: Mapping[str, FloatArray],
    ) -> StraightTables:
        """Round the amounts: the only whole numbers within half a count at every knot, so everywhere between them."""
        entries = []
        for term in basis:
            assert term.axis is not None
            grid = settings.grids[term.axis]
            assert grid is not None
            steps = (term.nodes_mm - machine.reference_point_mm[term.axis]) / float(grid.interval_mm)
            a, b, c, d = (grid.reference + round(float(step)) for step in steps)
            counts = np.floor(settings.sign * np.asarray(values[term.name]) / settings.count_mm + 0.5)
            p, q, r, s = (int(value) for value in counts)
            entries.append(StraightTable(term.carrier[0].output, term.axis, (a, b, c, d), (p, q, r, s), grid))
        return StraightTables(tuple(sorted(entries, key=lambda entry: entry.moving)))

    def context(self, machine: Machine, settings: StraightnessSettings, tables: StraightTables) -> dict[str, Any]:
        """Return the records, the plan parameter -> value, what to set, and the statement of the sign."""
        return straightness_context(machine, settings, tables)

    def parse(self, machine: Machine, settings: StraightnessSettings, files: Sequence[SourceFile]) -> StraightTables:
        """Read parameters 5711 ... 5784 and the points of the moving axes; a ``.json`` plan is passed over."""
        return parse_straightness(settings, files)

    def contradictions(
        self, machine: Machine, settings: StraightnessSettings, tables: StraightTables, files: Sequence[SourceFile]
    ) -> list[str]:
        """Say where a plan beside the text differs from it."""
        return plan_contradictions(files, lambda: self._plan(machine, settings, tables))

    def _plan(self, machine: Machine, settings: StraightnessSettings, tables: StraightTables) -> dict[str, Any]:
        plan = self.context(machine, settings, tables)["plan"]
        same = {key: plan[key] for key in ("stores", "detection_unit_um")}
        return {**same, "axis_parameters": plan["axes"], "parameters": plan["common"]}

    def remarks(
        self, machine: Machine, settings: StraightnessSettings, tables: StraightTables, files: Sequence[SourceFile]
    ) -> list[str]:
        """Say which unit was assumed, which entries were kept apart, and how many records were passed over."""
        return list(tables.remarks)

    def emulate(
        self, machine: Machine, settings: StraightnessSettings, tables: StraightTables, points: Points
    ) -> FloatArray:
        """Return sign * count * polyline at each point, zero outside the knots."""
        added = np.zeros((len(points), 3))
        for entry in tables.entries:
            along = points.position_mm[:, entry.moving] - machine.reference_point_mm[entry.moving]
            added[:, entry.compensated] += settings.sign * settings.count_mm * entry.counts(along)
        return added

    def violations(self, machine: Machine, settings: StraightnessSettings, tables: StraightTables) -> list[str]:
        """Return amounts out of range and travel left out."""
        return straightness_violations(machine, settings, tables)

    def table_nodes_mm(
        self, machine: Machine, settings: StraightnessSettings, tables: StraightTables
    ) -> tuple[FloatArray, ...]:
        """Return the knots over each moving axis."""
        return nodes_by_axis(
            (entry.moving, machine.reference_point_mm[entry.moving] + entry.along_mm) for entry in tables.entries
        )

    def usage(self, machine: Machine, settings: StraightnessSettings, tables: StraightTables) -> list[Usage]:
        """Return amounts and entries against their limits."""
        return straightness_usage(settings, tables)

    def keeping_others(
        self, machine: Machine, settings: StraightnessSettings, tables: StraightTables, files: Sequence[Path]
    ) -> dict[str, dict[str, Any]]:
        """Return ``style_from`` with these files: the points of X, Y and Z are those of pitch error compensation."""
        return as_sample(machine, files, ("fanuc-straightness",))

    def resolution_mm(self, settings: StraightnessSettings) -> float:
        """Return half a count for each of the two tables that may move one axis."""
        return 0.5 * settings.count_mm * _most_on_one_axis(settings)


def _most_on_one_axis(settings: StraightnessSettings) -> int:
    """How many tables may move the same axis."""
    if settings.pairs is None:
        return 2
    outputs = [output for output, _ in settings.pairs]
    return max(outputs.count(output) for output in outputs)


def _candidates_mm(machine: Machine, settings: StraightnessSettings, axis: int) -> FloatArray:
    """Positions of the compensation points that may be knots: those within the travel, and one beyond either end."""
    grid = settings.grids[axis]
    assert grid is not None
    numbers = range(grid.first, grid.last + 1)
    positions = machine.reference_point_mm[axis] + np.array([grid.along_mm(number) for number in numbers])
    low, high = machine.axes[axis].range_mm
    first = max(int(np.searchsorted(positions, low + 1e-6, side="right")) - 1, 0)
    last = min(int(np.searchsorted(positions, high - 1e-6)), len(positions) - 1)
    if last - first < 3:
        first, last = max(0, min(first, len(positions) - 4)), max(last, 3)
    return np.asarray(positions[first : last + 1])


def _fitted(machine: Machine, settings: StraightnessSettings, errors: ErrorTable, output: int, axis: int) -> Polyline:
    """Best polyline for the wanted correction of ``output`` over ``axis`` at mid-volume."""
    candidates = _candidates_mm(machine, settings, axis)
    position = np.unique(np.concatenate([candidates, curve_nodes_mm(machine, errors, axis)]).round(9))
    position = np.unique(np.concatenate([position, 0.5 * (position[1:] + position[:-1])]).round(9))
    position = position[(position >= candidates[0] - 1e-9) & (position <= candidates[-1] + 1e-9)]
    (term,) = one_dimensional_terms(machine, errors, [position] * 3, [(output, axis)], anchored=False)
    return best_polyline(candidates, position, term.start, _weights(machine, axis, position))


def _weights(machine: Machine, axis: int, position_mm: FloatArray) -> FloatArray:
    """Length that each sample stands for; more within the work zone, almost nothing beyond the travel."""
    half = 0.5 * np.diff(position_mm)
    weight = np.concatenate([half, [0.0]]) + np.concatenate([[0.0], half])
    low, high = machine.axes[axis].range_mm
    weight = np.where((position_mm >= low - 1e-9) & (position_mm <= high + 1e-9), weight, 1e-6 * weight)
    zone = machine.emphasis.zone_mm[axis]
    if zone is not None:
        inside = (position_mm >= zone[0]) & (position_mm <= zone[1])
        weight = np.where(inside, machine.emphasis.zone_weight * weight, weight)
    return np.asarray(weight)


def _chosen(machine: Machine, settings: StraightnessSettings, errors: ErrorTable) -> tuple[tuple[int, int], ...]:
    """Return the pairs of the settings, else for each moving axis the one that takes away most, by mean square."""
    free, taken = free_entries(settings)
    possible = [axis for axis in range(3) if settings.grids[axis] is not None and axis not in taken]
    asked = settings.pairs or ()
    if any(axis in taken for _, axis in asked) or len(asked) > len(free) or not possible or not free:
        sample = ", ".join(
            f"{k} = {text}" for k, (text, _) in sorted(settings.sample.common.items()) if MOVING <= k < POINTS
        )
        raise InputError(
            "the sample leaves no room for the straightness tables: entries of other axes are never overwritten, and a "
            f"moving axis needs compensation points (3620 to 3624). The sample has {sample or 'none of 5711 to 5723'}"
        )
    if settings.pairs is not None:
        return settings.pairs
    gain = {
        (k, axis): _gain(machine, settings, errors, k, axis) for k, axis in product(range(3), possible) if k != axis
    }
    found = []
    for axis in possible:
        output = max((k for k in range(3) if k != axis), key=lambda k: gain[k, axis])
        found.append((output, axis))
    return tuple(sorted(found, key=lambda pair: -gain[pair])[: len(free)])


def _gain(machine: Machine, settings: StraightnessSettings, errors: ErrorTable, output: int, axis: int) -> float:
    """Mean square over the travel that the polyline takes away, a constant apart."""
    line = _fitted(machine, settings, errors, output, axis)
    nodes = _candidates_mm(machine, settings, axis)[list(line.knots)]
    along = np.linspace(*machine.axes[axis].range_mm, 201)
    return float(np.var(np.interp(along, nodes, line.values)))
