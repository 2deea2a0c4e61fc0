"""Readings sorted into a full grid of axis levels, and the motion of the carriages at those levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.names import SQUARENESS_NAMES
from compgen.identify.adjust.unknowns import ErrorParameters, IntArray, State
from compgen.kinematics.exact_chain import passing_order, travel_directions

# The sparse map from the unknown errors to the motion of the carriages at the levels of a grid.


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
    nothing = np.zeros(0, dtype=np.int64)  # a model may hold squareness errors only
    return MotionMap(
        np.concatenate([nothing, *rows]),
        np.concatenate([nothing, *columns]),
        np.concatenate([np.zeros(0), *values]),
        (6 * starts[3], parameters.size),
    )


# A full grid of levels with the merged readings on it, and the unknowns: what all parts of the fast path share.


#: Chain, levels, directions, rows, columns and values of the map, errors.
KernelArguments = tuple[IntArray, FloatArray, FloatArray, IntArray, IntArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class ToolData:
    """The merged readings taken with one tool: weight and length, each (groups, n_out, n_mid * n_in)."""

    tool_mm: FloatArray
    weight: FloatArray
    length_mm: FloatArray


@dataclass(frozen=True)
class LevelGrid:
    """The unknowns and the merged readings on a full grid of levels.

    Parameters
    ----------
    parameters : the unknown errors.
    order : axes from the outermost body of the chain (the last to be passed) to the innermost.
    levels_mm, bases : levels of X, Y, Z, and the curve bases there.
    motion : from the unknowns to delta and eps at the levels of X, Y, Z in a row.
    tools : the data by tool.
    station_of : station of each group (dead length).
    compiled : whether the compiled loops do the work (:mod:`compgen.kinematics.kernel_switch`), decided once for the problem.
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
    def stations(self) -> int:
        """Number of stations."""
        return int(self.station_of.max()) + 1

    @property
    def groups(self) -> int:
        """Number of dead lengths."""
        return len(self.station_of)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.parameters.size + 3 * self.stations + self.groups

    @property
    def first_rows(self) -> list[int]:
        """First level of X, Y and Z in one list of all, and the number of all."""
        counts = [len(levels) for levels in self.levels_mm]
        return [0, counts[0], counts[0] + counts[1], sum(counts)]

    @cached_property
    def squareness_columns(self) -> IntArray:
        """Places of EC0Y, EB0Z, EA0Z among the unknowns, -1 where one is not modelled."""
        columns = np.full(3, -1, dtype=np.int64)
        names = self.parameters.squareness
        for k, name in enumerate(names):
            columns[SQUARENESS_NAMES.index(name)] = self.parameters.size - len(names) + k
        return columns

    def kernel_arguments(self, state: State) -> KernelArguments:
        """Chain, levels, directions, map and errors as the compiled loops take them, see ``grid_kernels.carriages``."""
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


# Readings sorted into the levels and cells of a grid, and merged where several fall into one cell.


#: More levels of an axis than this are found by sorting.
MOST_LEVELS = 2000


def levels_of(position_mm: FloatArray, *, compiled: bool = False) -> tuple[FloatArray, IntArray]:
    """Distinct values (k,) of (n,), ascending, and the index of each position."""
    if compiled and position_mm.flags.writeable and position_mm.dtype == np.float64:
        from compgen.identify.adjust.grid_kernels import find_levels

        levels, index = find_levels(position_mm, MOST_LEVELS)
        if len(levels):
            return levels, index
    position_mm = np.ascontiguousarray(position_mm)
    sample = np.unique(position_mm[:: max(1, len(position_mm) // 1999) | 1])  # tried first, sorting all is slow
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
            from compgen.identify.adjust.grid_kernels import cell_means

            total, mean = np.zeros(count), np.zeros(count)
            scatter += float(cell_means(cells, _plain(own), _plain(reading), total, mean))
        else:
            total = np.bincount(cells, own, count).astype(np.float64)
            mean = np.bincount(cells, own * reading, count) / np.where(total > 0, total, 1.0)
            scatter += float(np.dot(own, (reading - mean[cells]) ** 2))
        merged.append(replace(data, weight=total.reshape(shape), length_mm=mean.reshape(shape)))
    return tuple(merged), scatter


def _plain(values: FloatArray) -> FloatArray:
    """Return the array as the compiled loops were made for: float64, in a row, writeable."""
    return np.require(values, np.float64, ["C", "W"])
