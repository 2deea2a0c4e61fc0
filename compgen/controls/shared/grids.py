"""Fewest table nodes that represent the error curves within a given loss, and interpolation in regular grids."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from decimal import ROUND_CEILING, Decimal
from functools import cached_property, lru_cache, wraps
from itertools import product
from typing import Any, TypeVar

import numpy as np

from compgen.controls.shared.base import SourceFile
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray, fixed
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM, SQUARENESS_NAMES, error_named
from compgen.kinematics.first_order import coefficients

Result = TypeVar("Result")


def kept_by_numbers(calculation: Callable[..., Result]) -> Callable[..., Result]:
    """Keep the last results of a calculation with arrays and numbers: several tables and controls have the same nodes."""

    @lru_cache(maxsize=64)
    def result_of(arguments: bytes) -> Result:
        return calculation(*pickle.loads(arguments))

    @wraps(calculation)
    def wrapper(*arguments: Any) -> Result:
        return copy(result_of(pickle.dumps(arguments)))

    return wrapper


def rounded(values: FloatArray | float, digits: int) -> FloatArray:
    """Return numbers as read back from a text with so many decimals, in the shape of ``values``."""
    flat = [float(fixed(value, digits)) for value in np.asarray(values).ravel().tolist()]
    return np.array(flat).reshape(np.shape(values))


# Fewest nodes of a polyline that stays within tolerance of the curves: a shortest path over candidate nodes.


@kept_by_numbers
def fewest_nodes(
    position_mm: FloatArray, values: FloatArray, tolerances: FloatArray, required: Sequence[int] = ()
) -> list[int]:
    """Return the indices of the fewest candidates whose polylines fit every curve within tolerance, ends included.

    Parameters
    ----------
    position_mm : candidates (n,), ascending.
    values : curves at the candidates, shape (k, n), linear in between.
    tolerances : largest deviation of each curve at the candidates, shape (k,).
    required : indices that must be nodes.

    Of the smallest sets, the one with the least sum of squared deviations (in tolerances) is used. Exact: dynamic
    programming over all pairs; a pair is allowed if its line is within tolerance at all candidates in between.
    """
    count = len(position_mm)
    scaled = np.asarray(values, dtype=np.float64) / np.asarray(tolerances, dtype=np.float64)[:, None]
    best = np.full((count, 2), np.inf)  # number of pieces and sum of squares up to the node
    best[0], before = 0.0, np.zeros(count, dtype=np.int64)
    stops = sorted({*required, count - 1})
    for first in range(count - 1):
        stop = next(index for index in stops if index > first)
        # for the line to every later candidate: whether all in between are within 1; sum of squares
        along = position_mm[first + 1 : stop + 1] - position_mm[first]
        rise = scaled[:, first + 1 : stop + 1] - scaled[:, first : first + 1]
        slope = rise / along
        nothing = np.full((len(scaled), 1), np.inf)
        lowest = np.hstack([-nothing, np.maximum.accumulate((rise - 1.0) / along, axis=1)[:, :-1]])
        highest = np.hstack([nothing, np.minimum.accumulate((rise + 1.0) / along, axis=1)[:, :-1]])
        margin = 1e-9 * (1.0 + np.abs(slope))
        fits = np.all((slope >= lowest - margin) & (slope <= highest + margin), axis=0)
        xx, xy, yy = np.cumsum(along**2), np.cumsum(along * rise, axis=1), np.cumsum(rise**2, axis=1)
        squares = np.sum(yy - 2.0 * slope * xy + slope**2 * xx, axis=0)  # the end itself adds nothing
        squares = np.maximum(squares, 0.0)
        for last in (first + 1 + np.flatnonzero(fits)).tolist():
            pieces, square = best[first, 0] + 1.0, best[first, 1] + squares[last - first - 1]
            if pieces < best[last, 0] or (pieces == best[last, 0] and square < best[last, 1]):
                best[last], before[last] = (pieces, square), first
    path = [count - 1]
    while path[-1]:
        path.append(int(before[path[-1]]))
    return path[::-1]


# Node positions for tables: the fewest that meet the requested loss, equidistant where a control requires it.


#: Interpolation loss between table nodes that does not justify another node, as a tool displacement.
NEGLIGIBLE_LOSS_MM = 0.05 * MM_PER_UM
#: Nor does a loss of this share of the standard uncertainty of a curve ...
UNCERTAINTY_SHARE = 0.1
#: ... provided that it does not exceed this share of the curve's range.
RANGE_SHARE = 0.02
#: A table is not refined beyond this many intervals, whatever the control allows.
MOST_INTERVALS = 400
#: Every number of intervals up to this one is tried, then steps of 5 %.
EVERY_COUNT = 60
#: If no grid meets the requested loss: the coarsest that loses at most this much more than the best.
NEARLY_BEST = 1.25
#: Where a curved function is checked within an interval; not simple fractions, which refined nodes would hit.
BETWEEN = np.array([0.13, 0.29, 0.41, 0.53, 0.67, 0.79, 0.91])
#: Steps are integer multiples of this.
STEP_QUANTUM = Decimal("0.0001")


@dataclass(frozen=True)
class EquidistantGrid:
    """Equidistant nodes ``start + k step``, k = 0 ... count - 1, as exact decimals (mm)."""

    start: Decimal
    step: Decimal
    count: int

    @property
    def last(self) -> Decimal:
        """Position of the last node, exact."""
        return self.start + (self.count - 1) * self.step

    @cached_property
    def nodes_mm(self) -> FloatArray:
        """Node positions, shape (count,)."""
        return np.array([float(self.start + k * self.step) for k in range(self.count)])


def loss_setting(
    meaning: str = "interpolation loss between nodes that does not justify another node, um at the tool",
) -> Any:
    """Declare ``loss_um``: the interpolation loss, as a tool displacement, not worth another node; in mm."""
    default = NEGLIGIBLE_LOSS_MM / MM_PER_UM
    return toml_files.setting(toml_files.positive, key="loss_um", unit=MM_PER_UM, stated=default, meaning=meaning)


def curve_nodes_mm(machine: Machine, errors: ErrorTable, axis: int, most: int = 1000) -> FloatArray:
    """Return the union of the positions of all curves of an axis within its travel, including the travel ends."""
    low, high = machine.axes[axis].range_mm
    curves = [curve for name, curve in errors.curves.items() if error_named(name).axis == axis]
    positions = np.concatenate([[low, high], *(curve.position_mm for curve in curves)])
    inside = np.unique(np.round(positions[(positions >= low) & (positions <= high)], 6))
    return inside if len(inside) <= most else np.linspace(low, high, most)


def uneven_nodes_mm(
    machine: Machine, errors: ErrorTable, axis: int, *, loss_mm: float = NEGLIGIBLE_LOSS_MM, most: int = 1000
) -> FloatArray:
    """Return the fewest of the curves' nodes with which no curve of the axis loses anything significant.

    Travel ends are nodes, and so is the reference point if a curve has a node there.
    """
    candidates = curve_nodes_mm(machine, errors, axis, most)
    curves = [_ToleratedCurve.of(machine, name, curve, loss_mm) for name, curve in _curves_of(errors, axis)]
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
) -> EquidistantGrid:
    """Return an equidistant grid that covers the travel.

    Parameters
    ----------
    machine, errors, axis : the travel to cover and the curves to represent.
    most : largest number of nodes that the control accepts.
    step_mm : the step requested by the user; otherwise the widest one without significant loss.
    anchor : True if the reference point must be a node.
    loss_mm : interpolation loss, as a tool displacement, that does not justify another node; nor does a tenth of the
        standard uncertainty of a curve.
    output : only curves that move this axis count; default: all.
    products : False if the control multiplies curves with levers itself: only the curves have to be represented.
    """
    low, high = (Decimal(repr(end)) for end in machine.axes[axis].range_mm)
    travel = low, high, Decimal(repr(machine.reference_point_mm[axis])) if anchor else low
    if step_mm is not None:
        return grid_of_step(*travel, Decimal(repr(step_mm)))
    curves = [
        _ToleratedCurve.of(machine, name, curve, loss_mm) for name, curve in _curves_of(errors, axis, machine, output)
    ]
    curves = curves if products else [replace(item, bent=False) for item in curves]
    tried: list[tuple[float, EquidistantGrid]] = []
    for grid in _candidates(*travel, common_step(machine, errors, axis, anchor=anchor), most):
        nodes_mm = grid.nodes_mm
        tried.append((max((item.loss(nodes_mm) for item in curves), default=0.0), grid))
        if tried[-1][0] <= 1.0:
            return grid
    return nearly_best(tried) or grid_of_step(*travel, _round_up(high - low))


def nearly_best(tried: Sequence[tuple[float, EquidistantGrid]]) -> EquidistantGrid | None:
    """Return the first grid (coarsest first, with its loss) that loses hardly more than the best one."""
    enough = NEARLY_BEST * min((loss for loss, _ in tried), default=0.0)
    return next((grid for loss, grid in tried if loss <= enough), None)


def worth_mm(errors: ErrorTable, axis: int, loss_mm: float, output: int | None = None) -> float:
    """Return the loss that does not justify another node: as requested, or hidden by the uncertainty of the error.

    The error is the displacement of ``output`` over ``axis``, by default positioning.
    """
    curve = errors.curves.get(f"E{AXES[axis if output is None else output]}{AXES[axis]}")
    return loss_mm if curve is None else max(loss_mm, _idle_loss(curve))


def _idle_loss(curve: Curve) -> float:
    """Loss of a curve, in its unit, that is hidden by its uncertainty; 0 if that is unknown."""
    if not np.all(np.isfinite(curve.u)):
        return 0.0
    return min(UNCERTAINTY_SHARE * float(np.sqrt(np.mean(curve.u**2))), RANGE_SHARE * float(np.ptp(curve.value)))


def _curves_of(
    errors: ErrorTable, axis: int, machine: Machine | None = None, output: int | None = None
) -> Iterator[tuple[str, Curve]]:
    """Curves over an axis; if ``output`` is given, only those that move this axis."""
    moving = None
    if machine is not None and output is not None:
        parts = coefficients(machine.chain, machine.squareness_reference)
        moving = {part.error for part in parts if part.output == output}
    for name, curve in errors.curves.items():
        if error_named(name).axis == axis and (moving is None or name in moving):
            yield name, curve


@dataclass(frozen=True)
class _ToleratedCurve:
    """A curve that tables must fit to within ``tolerance`` (mm or rad); with ``bent`` also curve times position.

    An angular error whose lever contains the travel of its axis acts as curve times position, not linear between
    the nodes; it is checked there too, to within ``bent_tolerance`` mm.
    """

    curve: Curve
    tolerance: float
    bent: bool
    bent_tolerance: float

    @classmethod
    def of(cls, machine: Machine, name: str, curve: Curve, loss_mm: float) -> _ToleratedCurve:
        error = error_named(name)
        ends = np.abs(np.concatenate([machine.lower_mm, machine.upper_mm, machine.tool_offset_mm]))
        lever_mm = 1.0 if error.kind == "linear" else max(1.0, float(np.max(ends)))
        u = _idle_loss(curve)
        bent = error.kind == "angular" and error.direction != error.axis and len(curve.position_mm) > 1
        bent = bent and name not in SQUARENESS_NAMES and error.axis in machine.chain.lever_axes(error.axis or 0)
        return cls(curve, max(loss_mm / lever_mm, u), bent, max(loss_mm, u * lever_mm))

    def loss(self, nodes_mm: FloatArray) -> float:
        """Largest interpolation loss between the nodes; 1 is just tolerated."""
        curve, at_nodes = self.curve, self.curve.at(nodes_mm)
        loss = _missed(nodes_mm, curve.position_mm, at_nodes, curve.value) / self.tolerance
        if not self.bent:
            return loss
        start, step = curve.position_mm[:-1, None], np.diff(curve.position_mm)[:, None]
        where = (start + step * BETWEEN).ravel()
        missed = _missed(nodes_mm, where, at_nodes * nodes_mm, curve.at(where) * where)
        return max(loss, missed / self.bent_tolerance)


def _missed(nodes_mm: FloatArray, where_mm: FloatArray, at_nodes: FloatArray, exact: FloatArray) -> float:
    return float(np.max(np.abs(np.interp(where_mm, nodes_mm, at_nodes) - exact)))


@lru_cache(maxsize=64)  # a run asks for those of an axis a dozen times, a fleet of equal machines always for the same
def _candidates(
    low: Decimal, high: Decimal, origin: Decimal, common: Decimal, most: int
) -> tuple[EquidistantGrid, ...]:
    """Grids of at most ``most`` nodes, by number: equal parts of the travel, and steps that hit the curves' nodes."""
    length = high - low
    counts = list(range(1, EVERY_COUNT + 1))
    while counts[-1] < MOST_INTERVALS:
        counts.append(int(1.05 * counts[-1]))
    steps = {_round_up(length / count) for count in counts if count < most}
    parts = (common / part for part in range(1, 11))
    steps |= {step for step in parts if step % STEP_QUANTUM == 0 and length / step <= most}
    grids = [grid_of_step(low, high, origin, step) for step in steps]
    return tuple(sorted((grid for grid in grids if grid.count <= most), key=lambda grid: (grid.count, grid.step)))


def common_step(machine: Machine, errors: ErrorTable, axis: int, *, anchor: bool) -> Decimal:
    """Widest step for which all curve nodes, the travel ends and the grid origin are nodes."""
    origin = machine.reference_point_mm[axis] if anchor else machine.axes[axis].range_mm[0]
    distances = np.abs(curve_nodes_mm(machine, errors, axis) - origin) / float(STEP_QUANTUM)
    return max(1, math.gcd(*np.rint(distances).astype(np.int64).tolist())) * STEP_QUANTUM


def _round_up(step: Decimal) -> Decimal:
    return max(step.quantize(STEP_QUANTUM, rounding=ROUND_CEILING), STEP_QUANTUM)


def grid_of_step(low: Decimal, high: Decimal, origin: Decimal, step: Decimal) -> EquidistantGrid:
    """Return the nodes a whole number of steps from the origin that cover the travel from ``low`` to ``high``."""
    below = math.ceil((origin - low) / step)
    above = math.ceil((high - origin) / step)
    return EquidistantGrid(origin - below * step, step, below + above + 1)


# Trilinear interpolation in a regular grid of boxes, as in three-dimensional error compensation.
#
# FANUC, additional manual A-79351E, sheet 3/13: in a box, each component is the sum over the eight corners of the
# corner's value times (1 - x) or x, (1 - y) or y, (1 - z) or z, with x, y, z = 0 ... 1 the position within the box.


def _cells(ratio: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Cell number and fraction within it for positions (n,) in cells from the first vertex; clamped."""
    inside = np.clip(ratio, 0.0, count - 1)
    cell = np.minimum(np.floor(inside), max(count - 2, 0))
    return cell, inside - cell


def trilinear(vertices: FloatArray, start_mm: FloatArray, step_mm: FloatArray, position_mm: FloatArray) -> FloatArray:
    """Interpolate a regular grid of vertex values.

    Parameters
    ----------
    vertices : values (nx, ny, nz, k) in any unit; index [i, j, l] is at ``start_mm + (i, j, l) step_mm``. An
        axis with a single vertex is constant along that axis.
    start_mm, step_mm : position of vertex [0, 0, 0] and the (positive) spacings, shape (3,), mm.
    position_mm : shape (n, 3), mm; outside the grid the value at its surface applies (clamped).

    Returns
    -------
    values at the positions, shape (n, k).
    """
    grid = np.asarray(vertices, dtype=np.float64)
    ratio = (np.asarray(position_mm, dtype=np.float64) - start_mm) / step_mm
    cells, shares = zip(*(_cells(ratio[:, axis], grid.shape[axis]) for axis in range(3)), strict=True)
    result = np.zeros((len(ratio), grid.shape[3]))
    for corner in product((0, 1), repeat=3):
        weight = np.ones(len(ratio))
        index = []
        for axis, upper in enumerate(corner):
            weight = weight * (shares[axis] if upper else 1.0 - shares[axis])
            index.append(np.minimum(cells[axis] + upper, grid.shape[axis] - 1).astype(np.intp))
        result += weight[:, None] * grid[index[0], index[1], index[2]]
    return result


# Values over a grid of axis positions with uneven spacing, and reading it from rows in any order.


#: Index of the node before and after each position, and the weight of the one after.
Cell = tuple[np.ndarray, np.ndarray, FloatArray]


@dataclass(frozen=True)
class ParameterGrid:
    """One parameter over a grid of axis positions, linear between nodes, constant outside.

    Parameters
    ----------
    axes : the arguments, 0..2 for X, Y, Z; empty for a constant.
    nodes_mm : ascending positions, one array per argument.
    values : mm or rad, one dimension per argument.
    """

    axes: tuple[int, ...]
    nodes_mm: tuple[FloatArray, ...]
    values: FloatArray

    def at(self, position_mm: FloatArray, cells: dict[tuple[int, bytes], Cell] | None = None) -> FloatArray:
        """Values at axis positions (n, 3), shape (n,): multilinear between the 2^k nodes around each position.

        ``cells`` keeps the cells of these positions for other parameters with the same nodes.
        """
        known: dict[tuple[int, bytes], Cell] = {} if cells is None else cells
        own = []
        for axis, nodes in zip(self.axes, self.nodes_mm, strict=True):
            key = axis, nodes.tobytes()
            if key not in known:
                known[key] = _cell(nodes, position_mm[:, axis])
            own.append(known[key])
        if len(own) == 1:
            ((before, after, share),) = own
            return np.asarray(self.values.take(before) * (1.0 - share) + self.values.take(after) * share)
        result = np.zeros(len(position_mm))
        for corner in product((0, 1), repeat=len(own)):
            value = self.values[tuple(cell[side] for side, cell in zip(corner, own, strict=True))]
            for side, (_, _, share) in zip(corner, own, strict=True):
                value = value * (share if side else 1.0 - share)
            result += value
        return result


def _cell(nodes_mm: FloatArray, along_mm: FloatArray) -> Cell:
    """Index of the node before and after each position, and the weight of the one after; clamped outside."""
    if len(nodes_mm) == 1:
        zero = np.zeros(len(along_mm), dtype=np.intp)
        return zero, zero, np.zeros(len(along_mm))
    before = np.clip(np.searchsorted(nodes_mm, along_mm, side="right") - 1, 0, len(nodes_mm) - 2)
    share = (along_mm - nodes_mm[before]) / (nodes_mm[before + 1] - nodes_mm[before])
    return before, before + 1, np.clip(share, 0.0, 1.0)


def grid_order(
    source: SourceFile, lines: list[int], arguments: list[FloatArray]
) -> tuple[tuple[FloatArray, ...], np.ndarray]:
    """Return the nodes (ascending) of each argument, and the permutation that sorts the rows into C order of the grid.

    Raises InputError with the line for a duplicate position, and if grid positions are missing.
    """
    if not arguments:
        if len(lines) > 1:
            raise source.fail("a second row without an argument column; expected one row of constants", lines[1])
        return (), np.zeros(1, dtype=np.intp)
    nodes = tuple(np.unique(column) for column in arguments)
    shape = tuple(len(line) for line in nodes)
    cells = np.ravel_multi_index([np.searchsorted(*pair) for pair in zip(nodes, arguments, strict=True)], shape)
    order = np.argsort(cells, kind="stable")
    repeated = np.flatnonzero(np.diff(cells[order]) == 0)
    if repeated.size:
        row = int(order[repeated[0] + 1])
        raise source.fail(f"the position {[float(column[row]) for column in arguments]} is given twice", lines[row])
    if len(lines) != int(np.prod(shape)):
        sizes = " x ".join(map(str, shape))
        message = f"{len(lines)} rows do not fill the grid of {sizes} positions"
        raise source.fail(f"{message}; every combination of the arguments needs exactly one row", lines[-1])
    return nodes, order
