"""Tracer lengths on a full grid of axis levels: the fast path, with cost, exact gradient and normal matrix."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import SQUARENESS_NAMES
from compgen.identification.adjust.unknowns import ErrorParameters, IntArray, KnownPositions, State, TracerUnknowns
from compgen.kinematics.exact_chain import cross_matrices, level_rotations, passing_order, travel_directions
from compgen.kinematics.kernel_switch import use_compiled

# The sparse map from the unknown errors to the motion of the carriages at the levels of a grid.


# Readings sorted into a full grid of axis levels, and the motion of the carriages at those levels.


@dataclass(frozen=True)
class MotionMap:
    """Entries of the matrix from the unknown errors to delta and eps of every level, the levels of X, Y, Z in a row.

    Parameters
    ----------
    row, column, value : of each entry; row 6 l + k is component k of (delta, eps) at level l.
    shape : (levels * 6, unknown errors).
    """

    row: IntArray
    column: IntArray
    value: FloatArray
    shape: tuple[int, int]

    @cached_property
    def dense(self) -> FloatArray:
        """The whole matrix."""
        matrix = np.zeros(self.shape)
        np.add.at(matrix, (self.row, self.column), self.value)
        return matrix

    def to_unknowns(self, derivatives: FloatArray) -> FloatArray:
        """Return M^T d (unknown errors, k) for derivatives d (levels * 6, k) by delta and eps of every level, M this map."""
        order = np.lexsort((self.row, self.column))  # sums as a matrix in compressed rows makes them
        columns, starts = np.unique(self.column[order], return_index=True)
        found = np.zeros((self.shape[1], derivatives.shape[1]))
        if len(columns):
            found[columns] = np.add.reduceat(self.value[order, None] * derivatives[self.row[order]], starts, axis=0)
        return found

    def with_squareness(
        self, parameters: ErrorParameters, levels_mm: Sequence[FloatArray], derivatives: FloatArray
    ) -> MotionMap:
        """Add the columns of the squareness errors, which move each carriage in proportion to its travel.

        ``derivatives`` [axis, component, squareness] of the directions of travel, see ``exact_chain.travel_directions``.
        """
        axis = np.repeat(np.arange(3), [len(levels) for levels in levels_mm])
        places = [SQUARENESS_NAMES.index(name) for name in parameters.squareness]
        slopes = derivatives[axis][:, :, places] * np.concatenate(levels_mm)[:, None, None]
        level, component, place = np.nonzero(slopes)
        return MotionMap(
            np.concatenate([self.row, 6 * level + component]),
            np.concatenate([self.column, place + (parameters.size - len(places))]),
            np.concatenate([self.value, slopes[level, component, place]]),
            self.shape,
        )


def motion_map(parameters: ErrorParameters, bases: Sequence[FloatArray]) -> MotionMap:
    """Build the map of the curves; ``bases`` (levels, coefficients) are those of X, Y, Z at their levels."""
    starts = np.cumsum([0, *(len(basis) for basis in bases)]).tolist()
    known: dict[tuple[int, int], tuple[IntArray, IntArray, FloatArray]] = {}
    rows, columns, values = [], [], []
    for curve in parameters.curves:
        axis = curve.error.axis
        key = (axis, id(curve.free))
        if key not in known:
            reduced = bases[axis] @ curve.free
            level, column = np.nonzero(reduced)
            known[key] = (6 * (starts[axis] + level), column, reduced[level, column])
        level, column, value = known[key]
        rows.append(level + (curve.error.direction + (3 if curve.error.kind == "angular" else 0)))
        columns.append(column + curve.columns.start)
        values.append(value)
    nothing = np.zeros(0, dtype=np.int64)  # a model may consist of squareness errors only
    return MotionMap(
        np.concatenate([nothing, *rows]),
        np.concatenate([nothing, *columns]),
        np.concatenate([np.zeros(0), *values]),
        (6 * starts[3], parameters.size),
    )


# A full grid of levels with the merged readings on it, and the unknowns: common to all parts of the fast path.


#: Chain, levels, directions, rows, columns and values of the map, errors.
KernelArguments = tuple[IntArray, FloatArray, FloatArray, IntArray, IntArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class ToolData:
    """The merged readings taken with one tool: weight and length, each (groups, n_out, n_mid * n_in)."""

    tool_mm: FloatArray
    weight: FloatArray
    length_mm: FloatArray


@dataclass(frozen=True)
class LevelGrid(TracerUnknowns):
    """The unknowns and the merged readings on a full grid of levels.

    Parameters
    ----------
    parameters : the unknown errors.
    order : axes from the outermost body of the chain (the last to be passed) to the innermost.
    levels_mm, bases : levels of X, Y, Z, and the curve bases there.
    motion : from the unknowns to delta and eps at the levels of X, Y, Z in a row.
    tools : the data by tool.
    station_of : station of each group (dead length).
    compiled : whether compiled loops are used (:mod:`compgen.kinematics.kernel_switch`), decided once for the problem.
    """

    parameters: ErrorParameters
    order: tuple[int, int, int]
    levels_mm: tuple[FloatArray, FloatArray, FloatArray]
    bases: tuple[FloatArray, FloatArray, FloatArray]
    motion: MotionMap
    tools: tuple[ToolData, ...]
    station_of: IntArray
    compiled: bool

    @property
    def first_rows(self) -> list[int]:
        """First level of X, Y and Z in one list of all, and the number of all."""
        counts = [len(levels) for levels in self.levels_mm]
        return [0, counts[0], counts[0] + counts[1], sum(counts)]

    @cached_property
    def squareness_columns(self) -> IntArray:
        """Places of EC0Y, EB0Z, EA0Z among the unknowns, -1 if not modelled."""
        columns = np.full(3, -1, dtype=np.int64)
        names = self.parameters.squareness
        for k, name in enumerate(names):
            columns[SQUARENESS_NAMES.index(name)] = self.parameters.size - len(names) + k
        return columns

    def kernel_arguments(self, state: State) -> KernelArguments:
        """Chain, levels, directions, map and errors as arguments of the compiled loops, see ``grid_kernels.carriages``."""
        sides = dict(passing_order(self.parameters.machine))
        counts = [len(levels) for levels in self.levels_mm]
        side = [int(sides[axis]) for axis in range(3)]
        chain = np.array([self.order[::-1], self.first_rows[:3], counts, side], dtype=np.int64)
        motion, levels = self.motion, np.concatenate(self.levels_mm)
        directions, _ = self.travel_directions(state)
        return chain, levels, directions, motion.row, motion.column, motion.value, state.errors

    def travel_directions(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Directions of travel and their derivatives at the squareness of ``state``, see ``travel_directions``."""
        columns = self.squareness_columns
        values = np.where(columns >= 0, state.errors[columns] if len(state.errors) else 0.0, 0.0)
        return travel_directions(self.parameters.machine, values)


def nominal_targets(grid: LevelGrid) -> list[FloatArray]:
    """Nominal targets (commanded position plus tool offset) by tool, each (3, cells of one group)."""
    out, mid, inner = grid.order
    shape = tuple(len(grid.levels_mm[axis]) for axis in grid.order)
    target = np.empty((3, *shape))
    target[out] = grid.levels_mm[out][:, None, None]
    target[mid] = grid.levels_mm[mid][:, None]
    target[inner] = grid.levels_mm[inner]
    return [target.reshape(3, -1) + data.tool_mm[:, None] for data in grid.tools]


# Readings sorted into the levels and cells of a grid, and merged if several fall into one cell.


#: More levels of an axis than this are found by sorting.
MOST_LEVELS = 2000


def levels_of(position_mm: FloatArray, *, compiled: bool = False) -> tuple[FloatArray, IntArray]:
    """Distinct values (k,) of (n,), ascending, and the index of each position."""
    if compiled and position_mm.flags.writeable and position_mm.dtype == np.float64:
        from compgen.identification.adjust.grid_kernels import find_levels

        levels, index = find_levels(position_mm, MOST_LEVELS)
        if len(levels):
            return levels, index
    position_mm = np.ascontiguousarray(position_mm)
    sample = position_mm[:: max(1, len(position_mm) // 1999) | 1]  # tried first, because sorting all is slow
    sample, _ = np.unique(sample, return_index=True)  # without the index it would load numpy.ma, which is slow too
    found = np.minimum(np.searchsorted(sample, position_mm), len(sample) - 1)
    if np.array_equal(sample[found], position_mm):
        return sample, found
    levels = np.unique(position_mm)
    return levels, np.searchsorted(levels, position_mm)


def merge(
    tools: Sequence[ToolData],
    shape: tuple[int, ...],
    cell: tuple[IntArray, IntArray],
    reading_mm: FloatArray,
    weight: FloatArray,
    *,
    compiled: bool,
) -> tuple[tuple[ToolData, ...], float]:
    """Merge the readings of each cell into their weighted mean; also return the scatter about the means."""
    tool, index = cell
    merged, scatter = [], 0.0
    for k, data in enumerate(tools):
        rows = slice(None) if len(tools) == 1 else np.flatnonzero(tool == k)
        cells, own, reading, count = index[rows], weight[rows], reading_mm[rows], int(np.prod(shape))
        if compiled:
            from compgen.identification.adjust.grid_kernels import cell_means

            total, mean = np.zeros(count), np.zeros(count)
            scatter += float(cell_means(cells, _plain(own), _plain(reading), total, mean))
        else:
            total = np.bincount(cells, own, count).astype(np.float64)
            mean = np.bincount(cells, own * reading, count) / np.where(total > 0, total, 1.0)
            scatter += float(np.dot(own, (reading - mean[cells]) ** 2))
        merged.append(replace(data, weight=total.reshape(shape), length_mm=mean.reshape(shape)))
    return tuple(merged), scatter


def _plain(values: FloatArray) -> FloatArray:
    """Return the array in the form of the compiled loops: float64, contiguous, writeable."""
    return np.require(values, np.float64, ["C", "W"])


# The chain of the machine on a grid of levels: points after each body, and the gradient back along the same path.


@dataclass(frozen=True)
class Body:
    """One carriage at its levels: rotation R (n, 3, 3), J_l (n, 3, 3), travel plus delta (n, 3), rows of its levels."""

    axis: int
    tool_side: bool
    rotation: FloatArray
    jacobian: FloatArray
    shift: FloatArray
    position_mm: FloatArray
    direction_derivative: FloatArray
    rows: slice


def bodies_at(grid: LevelGrid, state: State) -> list[Body]:
    """Bodies in the order in which the tool point passes them (innermost first)."""
    directions, derivatives = grid.travel_directions(state)
    motion = (grid.motion.dense @ state.errors).reshape(-1, 6)
    rotation, jacobian = level_rotations(motion[:, 3:])
    own = level_slices(grid.levels_mm)
    return [
        Body(
            axis,
            tool_side,
            rotation[own[axis]],
            jacobian[own[axis]],
            grid.levels_mm[axis][:, None] * directions[axis] + motion[own[axis], :3],
            grid.levels_mm[axis],
            derivatives[axis],
            own[axis],
        )
        for axis, tool_side in passing_order(grid.parameters.machine)
    ]


def level_slices(levels_mm: Sequence[FloatArray]) -> list[slice]:
    """Rows of the levels of X, Y and Z, one after another."""
    bounds = np.cumsum([0, *(len(levels) for levels in levels_mm)]).tolist()
    return [slice(bounds[axis], bounds[axis + 1]) for axis in range(3)]


def points_along(bodies: Sequence[Body], tool_mm: FloatArray) -> list[FloatArray]:
    """Points before the first body (1, 3, 1) and after each body (n_axis, 3, product of the earlier levels)."""
    points = [tool_mm.reshape(1, 3, 1)]
    for body in bodies:
        before = _flat(points[-1])
        shift = body.shift if body.tool_side else np.einsum("lij,lj->li", body.rotation, body.shift)
        points.append(shift[:, :, None] + body.rotation @ before)
    return points


def lengths_of(vectors: FloatArray) -> FloatArray:
    """Lengths of vectors (..., 3, m): shape (..., m)."""
    squares = vectors * vectors
    total = squares[..., 0, :] + squares[..., 1, :]
    total += squares[..., 2, :]
    return np.asarray(np.sqrt(total, out=total))


def _flat(points: FloatArray) -> FloatArray:
    """(n, 3, m) -> (3, n * m)."""
    return np.ascontiguousarray(points.transpose(1, 0, 2)).reshape(3, -1)


def pull_back(
    grid: LevelGrid,
    bodies: Sequence[Body],
    tips: Sequence[FloatArray],
    force: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add the gradient by the errors for forces on the tips (n_out, 3, m): back along the chain, body by body."""
    parameters = grid.parameters
    first = parameters.size - len(parameters.squareness)
    by_motion = np.empty((grid.first_rows[3], 6))
    for body, before in zip(reversed(bodies), reversed(tips[:-1]), strict=True):
        turned = body.rotation.transpose(0, 2, 1) @ force
        arm = turned @ _flat(before).T  # [level, force component, arm component]
        moment = arm[:, (2, 0, 1), (1, 2, 0)] - arm[:, (1, 2, 0), (2, 0, 1)]
        total = turned.sum(axis=2)
        if body.tool_side:
            by_delta = force.sum(axis=2)
        else:
            by_delta = total
            moment += np.cross(body.shift, total)
        by_motion[body.rows, :3] = by_delta
        by_eps = body.jacobian.transpose(0, 2, 1) @ (body.rotation @ moment[:, :, None])
        by_motion[body.rows, 3:] = by_eps[:, :, 0]
        if parameters.squareness:
            by_squareness = (body.position_mm @ by_delta) @ body.direction_derivative
            for k, name in enumerate(parameters.squareness):
                gradient[first + k] += by_squareness[SQUARENESS_NAMES.index(name)]
        force = turned.sum(axis=0).reshape(3, before.shape[0], before.shape[2]).transpose(1, 0, 2)
    gradient[: parameters.size] += by_motion.ravel() @ grid.motion.dense


# Moments of w u u^T per level and per pair of levels (u the line of sight): all that the normal matrix needs.
#
# Every entry of C is linear in the coordinate of each axis, so small tables of moments contain all the information of
# the readings.


#: Numbers in a batch of stations: larger batches save calls, smaller ones fit in the cache.
BATCH = 60_000


@dataclass(frozen=True)
class Moments:
    """Sums over the readings of one tool; the axes out, mid, inner are those of ``LevelGrid.order``.

    Parameters
    ----------
    pairs : sums of w u u^T (xx, yy, zz, xy, xz, yz) of all groups at the levels of (out, mid), (out, inner) and
        (mid, inner), times the coordinate of the third axis to the power 0, 1, 2: each (3, 6, first, second).
    levels : for out, mid and inner the sums of w u u^T, w u (x, y, z) and w per group and level, times 1 and times the
        coordinates of the other two axes in the order inner, mid, out: each (groups, levels, 3, 10).
    """

    pairs: tuple[FloatArray, FloatArray, FloatArray]
    levels: tuple[FloatArray, FloatArray, FloatArray]


def compiled_moments(grid: LevelGrid, data: ToolData, state: State) -> Moments:
    """Moments by the compiled loops."""
    from compgen.identification.adjust.grid_kernels import moment_tables

    readings = data.tool_mm, state.stations_mm, grid.station_of, data.weight
    return Moments(*moment_tables(*grid.kernel_arguments(state), *readings))


def moments(grid: LevelGrid, data: ToolData, tip: FloatArray, state: State) -> Moments:
    """Moments by numpy; ``tip`` (n_out, 3, n_mid * n_in) are the tips of this tool."""
    shape = tuple(len(grid.levels_mm[axis]) for axis in grid.order)
    step = max(1, BATCH // tip.size)
    weighted = np.zeros((6, *shape))
    parts = []
    for start in range(0, grid.groups, step):
        batch = slice(start, min(start + step, grid.groups))
        sight = tip - state.stations_mm[grid.station_of[batch]][:, None, :, None]
        sight /= lengths_of(sight)[:, :, None, :]
        # w u u^T (xx, yy, zz, xy, xz, yz), w u (x, y, z) and w on the grid: (groups, 10, n_out, n_mid, n_in)
        weight = data.weight[batch]
        products = np.empty((len(weight), 10, *weight.shape[1:]))
        products[:, 9] = weight
        for k in range(3):
            np.multiply(weight, sight[:, :, k], out=products[:, 6 + k])
            np.multiply(products[:, 6 + k], sight[:, :, k], out=products[:, k])
        np.multiply(products[:, 6], sight[:, :, 1], out=products[:, 3])
        np.multiply(products[:, 6], sight[:, :, 2], out=products[:, 4])
        np.multiply(products[:, 7], sight[:, :, 2], out=products[:, 5])
        products = products.reshape(len(weight), 10, *shape)
        weighted += products[:, :6].sum(axis=0) if len(products) > 1 else products[0, :6]
        parts.append(_tables_by_level(grid, products))
    by_level = [np.concatenate(tables) for tables in zip(*parts, strict=True)]
    # w u u^T (6, n_out, n_mid, n_in) summed over one axis, times the powers of its coordinate
    out, mid, inner = (_powers(grid.levels_mm[axis], 3) for axis in grid.order)
    by_pair = (
        (weighted @ inner).transpose(3, 0, 1, 2),
        (mid.T @ weighted).transpose(2, 0, 1, 3),
        _contract_first(weighted, out).transpose(1, 0, 2, 3),
    )
    return Moments(by_pair, (by_level[0], by_level[1], by_level[2]))


def _powers(levels_mm: FloatArray, count: int) -> FloatArray:
    powers = np.ones((len(levels_mm), count))
    powers[:, 1] = levels_mm
    if count > 2:
        powers[:, 2] = levels_mm * levels_mm
    return powers


def _tables_by_level(grid: LevelGrid, products: FloatArray) -> list[FloatArray]:
    """Sum the products (groups, 10, n_out, n_mid, n_in) per level of the outer, middle and inner axis.

    Each table is (groups, levels, 3, 10): the sums times 1 and times the coordinates of the other two axes, in the
    order inner, mid, out.
    """
    out, mid, inner = (_powers(grid.levels_mm[axis], 2) for axis in grid.order)
    groups = len(products)
    over_inner = products @ inner  # [group, 10, out, mid, q_in]
    by_out = over_inner.swapaxes(3, 4) @ mid  # [group, 10, out, q_in, q_mid]
    by_mid = over_inner.transpose(0, 1, 3, 4, 2) @ out  # [group, 10, mid, q_in, q_out]
    flat = products.reshape(groups * 10, *products.shape[2:])
    over_out = _contract_first(flat, out)  # [group * 10, q_out, mid, in]
    by_inner = (over_out.swapaxes(2, 3) @ mid).transpose(0, 2, 3, 1)  # [group * 10, in, q_mid, q_out]
    tables = (by_out, by_mid, by_inner.reshape(groups, 10, *by_inner.shape[1:]))
    return [np.stack([t[..., 0, 0], t[..., 1, 0], t[..., 0, 1]]).transpose(1, 3, 0, 2) for t in tables]


def _contract_first(table: FloatArray, powers: FloatArray) -> FloatArray:
    """Sum over the second axis of (k, a, b, c) with powers (a, q): (k, q, b, c) by matrix products."""
    count, first = table.shape[:2]
    return (powers.T @ table.reshape(count, first, -1)).reshape(count, powers.shape[1], *table.shape[2:])


# The normal matrix of a grid from the moments of its readings.
#
# It uses C instead of the exact derivative: the matrix only steers the iteration; the optimum is where the exact
# gradient vanishes. The derivatives are first those by delta and eps of every level (delta: u, eps: r x u with the
# lever arm r), then the map of the curves converts them to the unknowns.


#: Place of the entries of w u u^T and w u in the ten moments, one row for each component of u.
ENTRIES = np.array([[0, 3, 4, 6], [3, 1, 5, 7], [4, 5, 2, 8]])


def add_normal(grid: LevelGrid, moments: Moments, tool_mm: FloatArray, state: State, matrix: FloatArray) -> None:
    """Add the part of one tool to the upper blocks of the normal matrix (size, size).

    Parameters
    ----------
    grid : the unknowns and the levels.
    moments, tool_mm : of the readings with this tool, and its offset (3,).
    state : gives the directions of travel.
    """
    directions, derivatives = grid.travel_directions(state)
    levers = lever_directions(grid.parameters.machine, directions)
    motion = grid.motion.with_squareness(grid.parameters, grid.levels_mm, derivatives)
    first = grid.parameters.size
    by_levels = np.zeros((motion.shape[0], motion.shape[0]))
    by_group = np.zeros((first, grid.groups, 4))
    if grid.compiled:
        from compgen.identification.adjust import grid_kernels as kernels

        rows, entries, levels = np.array(grid.first_rows), (motion.row, motion.column, motion.value), grid.levels_mm
        for axes, table, own_a, own_b in _ordered(grid, moments):
            a, b = levels[axes[0]], levels[axes[1]]
            kernels.add_pair(table, axes, a, b, levers, tool_mm, rows, own_a, own_b, by_levels)
        for of_axis, table in zip(_with_levers(grid), moments.levels, strict=True):
            along = levels[of_axis[0]]
            kernels.add_stations(table, np.array(of_axis), along, levers, tool_mm, rows, *entries, by_group)
        kernels.project(*entries, by_levels, matrix)
    else:
        _pairs(grid, moments, levers, tool_mm, by_levels)
        matrix[:first, :first] += motion.to_unknowns(motion.to_unknowns(by_levels).T)
        by_group += motion.to_unknowns(_stations(grid, moments, levers, tool_mm)).reshape(by_group.shape)
    add_own_blocks(matrix, first, grid.station_of, by_group, moments.levels[0][:, :, 0].sum(axis=1))


def lever_directions(machine: Machine, directions: FloatArray) -> FloatArray:
    """Directions of the axes that are part of the lever arm of each axis, others zero: [axis, lever, component]."""
    levers = np.zeros((3, 3, 3))
    for axis in range(3):
        for lever in machine.chain.lever_axes(axis):
            levers[axis, lever] = directions[lever]
    return levers


def add_own_blocks(
    matrix: FloatArray, first: int, station_of: IntArray, by_group: FloatArray, totals: FloatArray
) -> None:
    """Add the blocks of stations and dead lengths, which follow ``first`` unknown errors, to a normal matrix (size, size).

    Parameters
    ----------
    station_of : station of each dead length, (G,).
    by_group : sums of the derivatives by the errors times w u (x, y, z) and w, (first, G, 4).
    totals : sums of w u u^T (xx, yy, zz, xy, xz, yz), w u and w of all readings of each dead length, (G, 10).
    """
    second = len(matrix) - len(station_of)
    for group, station in enumerate(station_of.tolist()):
        columns = slice(first + 3 * station, first + 3 * station + 3)
        matrix[:first, columns] -= by_group[:, group, :3]
        matrix[:first, second + group] -= by_group[:, group, 3]
        matrix[columns, columns] += totals[group, ENTRIES[:, :3]]
        matrix[columns, second + group] += totals[group, 6:9]
        matrix[second + group, second + group] += totals[group, 9]
    matrix[first:, :first] = matrix[:first, first:].T
    matrix[second:, first:second] = matrix[first:second, second:].T


def _ordered(grid: LevelGrid, moments: Moments) -> list[tuple[IntArray, FloatArray, bool, bool]]:
    """Pairs of axes with the third, their table, and whether it gives the diagonal block of the first and of the second."""
    out, mid, inner = grid.order
    first, second, third = moments.pairs
    return [
        (np.array([out, mid, inner]), first, True, True),
        (np.array([out, inner, mid]), second, False, True),
        (np.array([mid, inner, out]), third, False, False),
    ]


def _with_levers(grid: LevelGrid) -> list[tuple[int, int, int]]:
    """Each axis in the order of ``LevelGrid.order`` with the two whose coordinates its table of moments has as factors."""
    out, mid, inner = grid.order
    return [(out, inner, mid), (mid, inner, out), (inner, mid, out)]


def _pairs(grid: LevelGrid, moments: Moments, levers: FloatArray, tool_mm: FloatArray, matrix: FloatArray) -> None:
    """Fill in the normal matrix of delta and eps of all levels (levels * 6, levels * 6)."""
    starts = [6 * row for row in grid.first_rows]
    for axes, table, own_a, own_b in _ordered(grid, moments):
        a, b, third = axes.tolist()
        count_a, count_b = table.shape[2:]
        sums = _extended(table)
        maps = []
        for axis in (a, b):
            arm = tool_mm + grid.levels_mm[a][:, None, None] * levers[axis, a]
            arm = arm + grid.levels_mm[b][:, None] * levers[axis, b]
            # from (u, q u) to the derivatives by delta and eps, with lever arms arm + q step
            derivatives = np.zeros((count_a, count_b, 6, 6))
            derivatives[:, :, :3, :3] = np.eye(3)
            derivatives[:, :, 3:, :3] = cross_matrices(arm.reshape(-1, 3)).reshape(*arm.shape, 3)
            derivatives[:, :, 3:, 3:] = cross_matrices(levers[axis, third][None])
            maps.append(derivatives)
        rows, columns = slice(starts[a], starts[a + 1]), slice(starts[b], starts[b + 1])
        half = maps[0] @ sums
        block = (half @ maps[1].swapaxes(2, 3)).transpose(0, 2, 1, 3).reshape(6 * count_a, 6 * count_b)
        matrix[rows, columns] = block
        matrix[columns, rows] = block.T
        if own_a:
            _set_own(matrix, starts[a], np.einsum("ijpk,ijqk->ipq", half, maps[0], optimize=True))
        if own_b:
            _set_own(matrix, starts[b], np.einsum("ijpk,ijqk->jpq", maps[1] @ sums, maps[1], optimize=True))


def _extended(table: FloatArray) -> FloatArray:
    """Moments of (u, q u) with the coordinate q of the third axis: (first, second, 6, 6)."""
    moments = table[:, ENTRIES[:, :3]].transpose(3, 4, 0, 1, 2)  # [first, second, power, 3, 3]
    sums = np.empty((*moments.shape[:2], 6, 6))
    sums[:, :, :3, :3] = moments[:, :, 0]
    sums[:, :, :3, 3:] = sums[:, :, 3:, :3] = moments[:, :, 1]
    sums[:, :, 3:, 3:] = moments[:, :, 2]
    return sums


def _set_own(matrix: FloatArray, start: int, blocks: FloatArray) -> None:
    """Set the blocks (levels, 6, 6) on the diagonal of the matrix, from row ``start`` on."""
    for k, block in enumerate(blocks):
        rows = slice(start + 6 * k, start + 6 * k + 6)
        matrix[rows, rows] = block


def _stations(grid: LevelGrid, moments: Moments, levers: FloatArray, tool_mm: FloatArray) -> FloatArray:
    """Sums of derivatives by delta and eps times w u (x, y, z) and w: shape (levels * 6, groups * 4)."""
    parts: dict[int, FloatArray] = {}
    for (axis, *others), table in zip(_with_levers(grid), moments.levels, strict=True):
        groups, count = table.shape[:2]
        sums = table[..., ENTRIES].reshape(groups, count, 9, 4)
        arm = tool_mm + grid.levels_mm[axis][:, None] * levers[axis, axis]
        maps = np.zeros((count, 6, 9))
        maps[:, :3, :3] = np.eye(3)
        maps[:, 3:, :3] = cross_matrices(arm)
        for k, other in enumerate(others):
            maps[:, 3:, 3 * k + 3 : 3 * k + 6] = cross_matrices(levers[axis, other][None])
        parts[axis] = (maps @ sums).transpose(1, 2, 0, 3).reshape(6 * count, 4 * groups)
    return np.concatenate([parts[axis] for axis in range(3)])


# The same least-squares problem on a grid of levels: the fast path (``docs/method.md``, "Fast solver").
#
# Every distinct axis position is a level. Readings of one station at one pose are merged into their weighted mean, so
# the data become arrays over (station, x, y, z) in which a missing reading has weight zero.
#
# * One pass (``evaluate``) gives cost and gradient of the EXACT model. The chain is passed body by body; each adds one
#   axis, so that only the outermost works on the full grid. The gradient runs back along the same chain.
# * ``normal_matrix`` needs only small moment tables of w u u^T over pairs of levels, because every entry of C is a
#   monomial in the axis coordinates. It uses C instead of the exact derivative: the matrix only steers the
#   iteration; the optimum is where the exact gradient vanishes.


@dataclass(frozen=True)
class GridProblem(LevelGrid):
    """Readings on a full grid of levels, with cost, exact gradient and normal matrix.

    Parameters
    ----------
    cell : for each reading (tool, index into the flattened (groups, n_out, n_mid * n_in)).
    reading_mm, reading_weight : the readings before merging.
    scatter : weighted square sum of the readings about their means, half of it is part of the cost.
    single : whether no cell holds more than one reading.
    known : stations whose coordinates were also observed.
    """

    cell: tuple[IntArray, IntArray]
    reading_mm: FloatArray
    reading_weight: FloatArray
    scatter: float
    single: bool
    known: KnownPositions | None = None

    def weighted(self, weight: FloatArray) -> GridProblem:
        """Return the same problem with other weights of the readings."""
        shape = self.tools[0].weight.shape
        if self.single and len(self.tools) == 1:
            cells = np.zeros(self.tools[0].weight.size)
            cells[self.cell[1]] = weight
            tools: tuple[ToolData, ...] = (replace(self.tools[0], weight=cells.reshape(shape)),)
            return replace(self, tools=tools, reading_weight=weight)
        tools, scatter = merge(self.tools, shape, self.cell, self.reading_mm, weight, compiled=self.compiled)
        return replace(self, tools=tools, reading_weight=weight, scatter=scatter)

    def evaluate(self, state: State) -> tuple[float, FloatArray]:
        """Half the weighted sum of squares with the exact model, and its exact gradient (size,)."""
        gradient = np.zeros(self.size)
        cost = 0.5 * self.scatter
        if self.compiled:
            from compgen.identification.adjust.grid_kernels import chain_gradient

            arguments, derivatives = self.kernel_arguments(state), self.travel_directions(state)[1]
            unknowns = state.stations_mm, state.dead_length_mm, self.station_of
            for data in self.tools:
                readings = data.tool_mm, *unknowns, data.weight, data.length_mm
                cost += chain_gradient(*arguments, derivatives, self.squareness_columns, *readings, gradient)
        else:
            bodies, places = self._geometry(state)
            for data, tips in zip(self.tools, places, strict=True):
                force = np.zeros_like(tips[-1])
                cost += self._forces(state, data, tips[-1], force, gradient)
                pull_back(self, bodies, tips, force, gradient)
        return cost + (self.known.add_gradient(state, gradient) if self.known else 0.0), gradient

    def _forces(self, state: State, data: ToolData, tip: FloatArray, force: FloatArray, gradient: FloatArray) -> float:
        """Return the cost; add forces on the tips and the gradient by stations and dead lengths (numpy)."""
        first, second = self.parameters.size, self.parameters.size + 3 * self.stations
        cost = 0.0
        step = max(1, BATCH // max(1, tip.size))
        for start in range(0, self.groups, step):
            batch = slice(start, min(start + step, self.groups))
            station = self.station_of[batch]
            sight = tip - state.stations_mm[station][:, None, :, None]
            distance = lengths_of(sight)
            residual = distance - data.length_mm[batch]
            residual -= state.dead_length_mm[batch, None, None]
            pull = data.weight[batch] * residual
            cost += 0.5 * float(np.vdot(pull, residual))
            gradient[second + batch.start : second + batch.stop] -= pull.sum(axis=(1, 2))
            pull /= distance
            sight *= pull[:, :, None, :]
            for group, total in zip(station.tolist(), sight.sum(axis=3).sum(axis=1), strict=True):
                gradient[first + 3 * group : first + 3 * group + 3] -= total
            force += sight.sum(axis=0)
        return cost

    def _geometry(self, state: State) -> tuple[list[Body], list[list[FloatArray]]]:
        """Bodies of the chain, and by tool the points after each body."""
        bodies = bodies_at(self, state)
        return bodies, [points_along(bodies, data.tool_mm) for data in self.tools]

    def _distances(self, state: State) -> list[FloatArray]:
        """Distances of stations and tips by tool, each (groups, n_out, n_mid * n_in), mm."""
        found = []
        if not self.compiled:
            for tips in self._geometry(state)[1]:
                found.append(lengths_of(tips[-1][None] - state.stations_mm[self.station_of][:, None, :, None]))
            return found
        from compgen.identification.adjust.grid_kernels import chain_distances

        arguments = self.kernel_arguments(state)
        for data in self.tools:
            distance = np.empty(data.weight.shape)
            chain_distances(*arguments, data.tool_mm, state.stations_mm, self.station_of, distance)
            found.append(distance)
        return found

    def residuals(self, state: State) -> FloatArray:
        """Model minus reading of every reading, shape (n,), mm."""
        parts = self._distances(state)
        for part in parts:
            part -= state.dead_length_mm[:, None, None]
        residual = self._at_readings(parts)
        residual -= self.reading_mm
        return residual

    def distances(self, state: State) -> FloatArray:
        """Distance from the station of every reading, shape (n,), mm."""
        return self._at_readings(self._distances(state))

    def _at_readings(self, parts: Sequence[FloatArray]) -> FloatArray:
        tool, cell = self.cell
        if len(parts) == 1:
            return np.asarray(parts[0].ravel()[cell])
        return np.asarray(np.stack([part.ravel() for part in parts])[tool, cell])

    def normal_matrix(self, state: State) -> FloatArray:
        """Return J^T W J (size, size) with C instead of the exact derivative."""
        matrix = np.zeros((self.size, self.size))
        places = [] if self.compiled else self._geometry(state)[1]
        for k, data in enumerate(self.tools):
            sums = compiled_moments(self, data, state) if self.compiled else moments(self, data, places[k][-1], state)
            add_normal(self, sums, data.tool_mm, state, matrix)
        if self.known:
            self.known.add_weight(state, matrix)
        return matrix


#: Number of readings from which the compiled loops pay off for a single identification.
LARGE = 100_000
#: A grid is used if at least this share of its cells has readings.
LEAST_FILL = 0.1


def grid_problem(
    parameters: ErrorParameters,
    position_mm: FloatArray,
    tool_mm: FloatArray,
    station: IntArray,
    group: IntArray,
    reading_mm: FloatArray,
) -> GridProblem | None:
    """Sort readings into a grid of levels, all weights 1; None if their positions do not form a grid.

    Parameters
    ----------
    parameters : the unknown errors.
    position_mm : commanded positions of the readings, shape (n, 3).
    tool_mm : their tool offsets, (3,) or (n, 3).
    station, group, reading_mm : of each reading, shape (n,).
    """
    count, groups = len(reading_mm), int(group.max()) + 1
    # some positions already show that those of a path form no grid, without sorting all of them
    some = position_mm[:: max(1, count // 1999) | 1]
    least = groups * math.prod(len(np.unique(column, return_index=True)[0]) for column in some.T)
    if least * LEAST_FILL > count:
        return None
    compiled = use_compiled(count, LARGE)
    found = [levels_of(position_mm[:, axis], compiled=compiled) for axis in range(3)]
    levels, at = [item[0] for item in found], [item[1] for item in found]
    if tool_mm.ndim == 1:
        tools, tool = tool_mm[None], np.zeros(count, dtype=np.int64)
    else:
        tools, tool = np.unique(tool_mm, axis=0, return_inverse=True)
        tool = tool.ravel()
    cells = groups * int(np.prod([len(level) for level in levels]))
    if len(tools) * cells * LEAST_FILL > count:
        return None
    order = tuple(axis for axis, _ in reversed(passing_order(parameters.machine)))
    out, mid, inner = order
    shape = (groups, len(levels[out]), len(levels[mid]) * len(levels[inner]))
    index = group * shape[1]
    index += at[out]
    index *= len(levels[mid])
    index += at[mid]
    index *= len(levels[inner])
    index += at[inner]
    station_of = np.arange(groups)
    if group is not station:
        station_of[group] = station
    bases = tuple(parameters.basis(axis, levels[axis]) for axis in range(3))
    nothing = np.zeros((0, 0, 0))
    empty = [ToolData(np.array(offset), nothing, nothing) for offset in tools]
    cell = (tool.astype(np.int64, copy=False), index.astype(np.int64, copy=False))
    weight = np.ones(count)
    merged, scatter = merge(empty, shape, cell, reading_mm, weight, compiled=compiled)
    return GridProblem(
        parameters=parameters,
        order=order,  # type: ignore[arg-type]
        levels_mm=tuple(levels),  # type: ignore[arg-type]
        bases=bases,  # type: ignore[arg-type]
        motion=motion_map(parameters, bases),
        tools=merged,
        station_of=station_of,
        compiled=compiled,
        cell=cell,
        reading_mm=reading_mm,
        reading_weight=weight,
        scatter=scatter,
        single=len(tools) == 1 and float(merged[0].weight.max()) == 1.0,
    )
