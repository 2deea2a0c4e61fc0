"""Node positions for tables: as few as hold the error curves within a wanted loss, equidistant where a control demands it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from decimal import ROUND_CEILING, Decimal

import numpy as np

from compgen.controllers.node_choice import fewest_nodes
from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM, SQUARENESS_NAMES, error_named
from compgen.model.volumetric import coefficients

#: Loss by interpolation between table nodes that is not worth another node, as a displacement of the tool.
NEGLIGIBLE_LOSS_MM = 0.05 * MM_PER_UM
#: A loss of this share of the standard uncertainty of a curve is not worth another node either ...
UNCERTAINTY_SHARE = 0.1
#: ... as far as it does not exceed this share of the curve's range.
RANGE_SHARE = 0.02
#: A table is not refined beyond this many intervals, whatever the control could take.
MOST_INTERVALS = 400
#: Every number of intervals is tried up to this one, then 5 % more each.
EVERY_COUNT = 60
#: Where no grid reaches the wanted loss: the coarsest is taken that loses at most this much more than the best.
NEARLY_BEST = 1.25
#: Where a bent curve is looked at within an interval; no simple fractions, which refined nodes would hit.
BETWEEN = np.array([0.13, 0.29, 0.41, 0.53, 0.67, 0.79, 0.91])
#: Steps are whole multiples of this.
STEP_QUANTUM = Decimal("0.0001")


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


def take_loss_mm(section: tomlio.Section) -> float:
    """Take ``loss_um`` from a control's settings: the loss by interpolation that is worth no further node; in mm."""
    return section.take("loss_um", tomlio.positive, NEGLIGIBLE_LOSS_MM / MM_PER_UM) * MM_PER_UM


def curve_nodes_mm(machine: Machine, errors: ErrorTable, axis: int, most: int = 1000) -> FloatArray:
    """Return the union of the positions of all curves of an axis within its travel, the travel ends included."""
    low, high = machine.axes[axis].range_mm
    curves = [curve for name, curve in errors.curves.items() if error_named(name).axis == axis]
    positions = np.concatenate([[low, high], *(curve.position_mm for curve in curves)])
    inside = np.unique(np.round(positions[(positions >= low) & (positions <= high)], 6))
    return inside if len(inside) <= most else np.linspace(low, high, most)


def uneven_nodes_mm(
    machine: Machine, errors: ErrorTable, axis: int, *, loss_mm: float = NEGLIGIBLE_LOSS_MM, most: int = 1000
) -> FloatArray:
    """Return the fewest nodes, taken from those of the curves, with which no curve of the axis loses what matters.

    Travel ends are nodes, and so is the reference point if a curve has a node there.
    """
    candidates = curve_nodes_mm(machine, errors, axis, most)
    curves = [_Held.of(machine, name, curve, loss_mm) for name, curve in _curves_of(errors, axis)]
    if not curves:
        return candidates
    values = np.array([item.curve.at(candidates) for item in curves])
    tolerances = np.array([item.tolerance for item in curves])
    reference = np.flatnonzero(np.abs(candidates - machine.reference_point_mm[axis]) < 1e-6)
    return candidates[fewest_nodes(candidates, values, tolerances, reference.tolist())]


def equidistant_grid(
    machine: Machine,
    errors: ErrorTable,
    axis: int,
    *,
    most: int,
    step_mm: float | None = None,
    anchor: bool = False,
    loss_mm: float = NEGLIGIBLE_LOSS_MM,
    output: int | None = None,
    products: bool = True,
) -> Grid:
    """Return an equidistant grid that covers the travel.

    Parameters
    ----------
    machine, errors, axis : whose travel and curves are to be held.
    most : largest number of nodes that the control takes.
    step_mm : a step that the user asks for; otherwise the widest one that loses nothing that matters.
    anchor : True if the reference point must be a node.
    loss_mm : loss by interpolation, as a displacement of the tool, that is worth no further node; a tenth of the
        standard uncertainty of a curve is not either.
    output : only curves that move this axis count; default all.
    products : False if the control multiplies curves with levers itself, so that only the curves have to be held.
    """
    low, high = machine.axes[axis].range_mm
    if step_mm is not None:
        return _grid(machine, axis, Decimal(repr(step_mm)), anchor)
    curves = [_Held.of(machine, name, curve, loss_mm) for name, curve in _curves_of(errors, axis, machine, output)]
    curves = curves if products else [replace(item, bent=False) for item in curves]
    tried: list[tuple[float, Grid]] = []
    for grid in _candidates(machine, errors, axis, anchor, most):
        nodes_mm = grid.nodes_mm
        tried.append((max((item.loss(nodes_mm) for item in curves), default=0.0), grid))
        if tried[-1][0] <= 1.0:
            return grid
    return nearly_best(tried) or _grid(machine, axis, _round_up(Decimal(repr(high - low))), anchor)


def nearly_best(tried: Sequence[tuple[float, Grid]]) -> Grid | None:
    """Return the first of grids with their losses, coarsest first, that loses hardly more than the best one."""
    enough = NEARLY_BEST * min((loss for loss, _ in tried), default=0.0)
    return next((grid for loss, grid in tried if loss <= enough), None)


def worth_mm(errors: ErrorTable, axis: int, loss_mm: float) -> float:
    """Return the loss of positioning that is worth no further node: as wanted, or what its uncertainty makes idle."""
    curve = errors.curves.get(f"E{AXES[axis]}{AXES[axis]}")
    return loss_mm if curve is None else max(loss_mm, _idle_loss(curve))


def _idle_loss(curve: Curve) -> float:
    """Loss of a curve, in its own unit, that its uncertainty hides; 0 if that is not known."""
    if not np.all(np.isfinite(curve.u)):
        return 0.0
    return min(UNCERTAINTY_SHARE * float(np.sqrt(np.mean(curve.u**2))), RANGE_SHARE * float(np.ptp(curve.value)))


def _curves_of(
    errors: ErrorTable, axis: int, machine: Machine | None = None, output: int | None = None
) -> Iterator[tuple[str, Curve]]:
    """Curves over an axis, those only that move the axis ``output`` if one is given."""
    moving = None
    if machine is not None and output is not None:
        parts = coefficients(machine.chain, machine.squareness_reference)
        moving = {part.error for part in parts if part.output == output}
    for name, curve in errors.curves.items():
        if error_named(name).axis == axis and (moving is None or name in moving):
            yield name, curve


@dataclass(frozen=True)
class _Held:
    """A curve that tables have to hold to within ``tolerance`` (mm or rad); with ``bent`` also curve times position.

    An angular error whose lever holds its own axis' travel acts as curve times position, which is bent between the
    nodes of the curve; it is looked at there as well, to within ``bent_tolerance`` mm.
    """

    curve: Curve
    tolerance: float
    bent: bool
    bent_tolerance: float

    @classmethod
    def of(cls, machine: Machine, name: str, curve: Curve, loss_mm: float) -> _Held:
        error = error_named(name)
        ends = np.abs(np.concatenate([machine.lower_mm, machine.upper_mm, machine.tool_offset_mm]))
        lever_mm = 1.0 if error.kind == "linear" else max(1.0, float(np.max(ends)))
        u = _idle_loss(curve)
        bent = error.kind == "angular" and error.direction != error.axis and len(curve.position_mm) > 1
        bent = bent and name not in SQUARENESS_NAMES and error.axis in machine.chain.lever_axes(error.axis or 0)
        return cls(curve, max(loss_mm / lever_mm, u), bent, max(loss_mm, u * lever_mm))

    def loss(self, nodes_mm: FloatArray) -> float:
        """Largest loss by interpolation between the nodes, 1 where it is just tolerated."""
        curve, at_nodes = self.curve, self.curve.at(nodes_mm)
        loss = _missed(nodes_mm, curve.position_mm, at_nodes, curve.value) / self.tolerance
        if not self.bent:
            return loss
        start, step = curve.position_mm[:-1, None], np.diff(curve.position_mm)[:, None]
        where = (start + step * BETWEEN).ravel()
        missed = _missed(nodes_mm, where, at_nodes * nodes_mm, curve.at(where) * where)
        return max(loss, missed / self.bent_tolerance)


def _missed(nodes_mm: FloatArray, where_mm: FloatArray, at_nodes: FloatArray, wanted: FloatArray) -> float:
    return float(np.max(np.abs(np.interp(where_mm, nodes_mm, at_nodes) - wanted)))


def _candidates(machine: Machine, errors: ErrorTable, axis: int, anchor: bool, most: int) -> list[Grid]:
    """Grids within ``most`` nodes by their number: even parts of the travel, and steps that hit the curves' nodes."""
    low, high = machine.axes[axis].range_mm
    length = Decimal(repr(high)) - Decimal(repr(low))
    steps = {_round_up(length / count) for count in _interval_counts(most)}
    common = common_step(machine, errors, axis, anchor=anchor)
    parts = (common / part for part in range(1, 11))
    steps |= {step for step in parts if step % STEP_QUANTUM == 0 and length / step <= most}
    grids = [_grid(machine, axis, step, anchor) for step in steps]
    return sorted((grid for grid in grids if grid.count <= most), key=lambda grid: (grid.count, grid.step))


def _interval_counts(most: int) -> list[int]:
    counts = list(range(1, EVERY_COUNT + 1))
    while counts[-1] < MOST_INTERVALS:
        counts.append(int(1.05 * counts[-1]))
    return [count for count in counts if count < most]


def common_step(machine: Machine, errors: ErrorTable, axis: int, *, anchor: bool) -> Decimal:
    """Widest step with which the nodes of all curves, the travel ends and the origin of the grid are nodes."""
    origin = machine.reference_point_mm[axis] if anchor else machine.axes[axis].range_mm[0]
    distances = np.abs(curve_nodes_mm(machine, errors, axis) - origin) / float(STEP_QUANTUM)
    return max(1, math.gcd(*np.rint(distances).astype(np.int64).tolist())) * STEP_QUANTUM


def _round_up(step: Decimal) -> Decimal:
    return max(step.quantize(STEP_QUANTUM, rounding=ROUND_CEILING), STEP_QUANTUM)


def _grid(machine: Machine, axis: int, step: Decimal, anchor: bool) -> Grid:
    low, high = (Decimal(repr(end)) for end in machine.axes[axis].range_mm)
    origin = Decimal(repr(machine.reference_point_mm[axis])) if anchor else low
    below = math.ceil((origin - low) / step)
    above = math.ceil((high - origin) / step)
    return Grid(origin - below * step, step, below + above + 1)
