"""Readings sorted into a full grid of levels, and merged where several fall into one cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.identify.level_map import Entries
from compgen.identify.parameters import ErrorParameters
from compgen.identify.state import IntArray


@dataclass(frozen=True)
class ToolData:
    """The merged readings taken with one tool: weight and length, each (groups, n_out, n_mid * n_in)."""

    tool_mm: FloatArray
    weight: FloatArray
    length_mm: FloatArray


@dataclass(frozen=True)
class Grid:
    """The unknowns and the merged readings on a full grid of levels.

    Parameters
    ----------
    parameters : the unknown errors.
    order : axes from the outermost body of the chain (the last to be passed) to the innermost.
    levels_mm, bases, reduced : levels of X, Y, Z, the curve bases there, and these times the free coefficients.
    motion : from the unknowns to delta and eps at the levels of X, Y, Z in a row, shape (levels * 6, size).
    tools : the data by tool.
    station_of : station of each group (dead length).
    """

    parameters: ErrorParameters
    order: tuple[int, int, int]
    levels_mm: tuple[FloatArray, FloatArray, FloatArray]
    bases: tuple[FloatArray, FloatArray, FloatArray]
    reduced: tuple[Entries, ...]
    motion: FloatArray
    tools: tuple[ToolData, ...]
    station_of: IntArray

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


def merge(
    tools: Sequence[ToolData],
    shape: tuple[int, ...],
    cell: tuple[IntArray, IntArray],
    reading_mm: FloatArray,
    weight: FloatArray,
) -> tuple[tuple[ToolData, ...], float]:
    """Merge the readings of each cell into their weighted mean; also return the scatter about the means."""
    tool, index = cell
    count = int(np.prod(shape))
    merged, scatter = [], 0.0
    for k, data in enumerate(tools):
        rows = slice(None) if len(tools) == 1 else np.flatnonzero(tool == k)
        cells, w, reading = index[rows], weight[rows], reading_mm[rows]
        total = np.bincount(cells, w, count).astype(np.float64)
        mean = np.bincount(cells, w * reading, count) / np.where(total > 0, total, 1.0)
        scatter += float(np.dot(w, (reading - mean[cells]) ** 2))
        merged.append(replace(data, weight=total.reshape(shape), length_mm=mean.reshape(shape)))
    return tuple(merged), scatter


def levels_of(position_mm: FloatArray) -> tuple[FloatArray, IntArray]:
    """Distinct values (k,) of (n,) and the index of each position; a sample is tried first, sorting all is slow."""
    sample = np.unique(position_mm[:: max(1, len(position_mm) // 1999) | 1])
    found = np.minimum(np.searchsorted(sample, position_mm), len(sample) - 1)
    if np.array_equal(sample[found], position_mm):
        return sample, found
    levels = np.unique(position_mm)
    return levels, np.searchsorted(levels, position_mm)


def nominal_targets(grid: Grid) -> list[FloatArray]:
    """Nominal targets (commanded position plus tool offset) by tool, each (3, cells of one group)."""
    out, mid, inner = grid.order
    shape = tuple(len(grid.levels_mm[axis]) for axis in grid.order)
    target = np.empty((3, *shape))
    target[out] = grid.levels_mm[out][:, None, None]
    target[mid] = grid.levels_mm[mid][:, None]
    target[inner] = grid.levels_mm[inner]
    return [target.reshape(3, -1) + data.tool_mm[:, None] for data in grid.tools]
