"""Node positions for tables: where the error curves have theirs, or equidistant where a control demands it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import ROUND_CEILING, Decimal

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM, error_named

#: Loss by interpolation between table nodes that is not worth another node, as a displacement of the tool.
NEGLIGIBLE_LOSS_MM = 0.05 * MM_PER_UM
#: A table is not refined beyond this many intervals, whatever the control could take.
MOST_INTERVALS = 400
#: Where a bent curve is looked at within an interval; no simple fractions, which refined nodes would hit.
BETWEEN = np.array([0.13, 0.29, 0.41, 0.53, 0.67, 0.79, 0.91])


@dataclass(frozen=True)
class Grid:
    """Equidistant nodes ``start + k step``, k = 0 ... count - 1, in exact decimal numbers (mm)."""

    start: Decimal
    step: Decimal
    count: int

    @property
    def last(self) -> Decimal:
        """Position of the last node, exact."""
        return self.start + (self.count - 1) * self.step

    @property
    def nodes_mm(self) -> FloatArray:
        """Node positions, shape (count,)."""
        return np.array([float(self.start + k * self.step) for k in range(self.count)])


def curve_nodes_mm(machine: Machine, errors: ErrorTable, axis: int, most: int = 1000) -> FloatArray:
    """Return the union of the positions of all curves of an axis within its travel, the travel ends included."""
    low, high = machine.axes[axis].range_mm
    curves = [curve for name, curve in errors.curves.items() if error_named(name).axis == axis]
    positions = np.concatenate([[low, high], *(curve.position_mm for curve in curves)])
    inside = np.unique(np.round(positions[(positions >= low) & (positions <= high)], 6))
    return inside if len(inside) <= most else np.linspace(low, high, most)


def equidistant_grid(
    machine: Machine, errors: ErrorTable, axis: int, *, most: int, step_mm: float | None = None, anchor: bool = False
) -> Grid:
    """Return an equidistant grid that covers the travel.

    Parameters
    ----------
    machine, errors, axis : whose travel and curves are to be held.
    most : largest number of nodes that the control takes.
    step_mm : a step that the user asks for; otherwise the widest one that loses nothing that matters.
    anchor : True if the reference point must be a node.
    """
    low, high = machine.axes[axis].range_mm
    if step_mm is not None:
        return _grid(machine, axis, Decimal(repr(step_mm)), anchor)
    least = len(curve_nodes_mm(machine, errors, axis)) - 1
    best: tuple[float, Grid] | None = None
    for intervals in _interval_counts(least, most - 2 if anchor else most - 1):
        grid = _grid(machine, axis, _round_up(Decimal(repr(high - low)) / intervals), anchor)
        if grid.count > most:
            continue
        loss = _loss_mm(machine, errors, axis, grid)
        if best is None or loss < best[0]:
            best = loss, grid
        if loss <= NEGLIGIBLE_LOSS_MM:
            break
    return best[1] if best is not None else _grid(machine, axis, _round_up(Decimal(repr(high - low))), anchor)


def _interval_counts(least: int, most: int) -> list[int]:
    """Numbers of intervals to try: those of the curves, their multiples up to ten (nodes stay nodes), then 15 % more each."""
    counts = [least * k for k in range(1, 11)]
    while counts[-1] < min(most, MOST_INTERVALS):
        counts.append(int(1.15 * counts[-1]) + 1)
    return [count for count in counts if count <= most] or [max(1, most)]


def _round_up(step: Decimal) -> Decimal:
    rounded = step.quantize(Decimal("0.0001"), rounding=ROUND_CEILING)
    return max(rounded, Decimal("0.0001"))


def _grid(machine: Machine, axis: int, step: Decimal, anchor: bool) -> Grid:
    low, high = (Decimal(repr(end)) for end in machine.axes[axis].range_mm)
    origin = Decimal(repr(machine.reference_point_mm[axis])) if anchor else low
    below = math.ceil((origin - low) / step)
    above = math.ceil((high - origin) / step)
    return Grid(origin - below * step, step, below + above + 1)


def _loss_mm(machine: Machine, errors: ErrorTable, axis: int, grid: Grid) -> float:
    """Largest displacement that interpolation on ``grid`` loses of any curve of the axis (angles at their lever).

    An angular error whose lever holds its own axis' travel acts as curve times position, which is bent between the
    nodes of the curve; it is looked at there as well.
    """
    reach_mm = max(
        1.0,
        float(np.max(np.abs(np.concatenate([machine.lower_mm, machine.upper_mm, machine.tool_offset_mm])))),
    )
    own_travel = axis in machine.chain.lever_axes(axis)
    nodes = grid.nodes_mm
    loss = 0.0
    for name, curve in errors.curves.items():
        error = error_named(name)
        if error.axis == axis:
            lever = 1.0 if error.kind == "linear" else reach_mm
            loss = max(loss, lever * _missed(nodes, curve.position_mm, curve.at(nodes), curve.value))
            if own_travel and error.kind == "angular" and error.direction != axis:
                start, step = curve.position_mm[:-1, None], np.diff(curve.position_mm)[:, None]
                where = (start + step * BETWEEN).ravel()
                loss = max(loss, _missed(nodes, where, curve.at(nodes) * nodes, curve.at(where) * where))
    return loss


def _missed(nodes_mm: FloatArray, where_mm: FloatArray, at_nodes: FloatArray, wanted: FloatArray) -> float:
    return float(np.max(np.abs(np.interp(where_mm, nodes_mm, at_nodes) - wanted)))
