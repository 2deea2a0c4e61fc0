"""Readings sorted into the levels and cells of a grid, and merged where several fall into one cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.identify.grid import ToolData
from compgen.identify.state import IntArray

#: More levels of an axis than this are found by sorting.
MOST_LEVELS = 2000


def levels_of(position_mm: FloatArray, *, compiled: bool = False) -> tuple[FloatArray, IntArray]:
    """Distinct values (k,) of (n,), ascending, and the index of each position."""
    if compiled and position_mm.flags.writeable and position_mm.dtype == np.float64:
        from compgen.identify.compiled import find_levels

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
        total, mean, square = _cell_means(index[rows], weight[rows], reading_mm[rows], int(np.prod(shape)), compiled)
        scatter += square
        merged.append(replace(data, weight=total.reshape(shape), length_mm=mean.reshape(shape)))
    return tuple(merged), scatter


def _cell_means(
    cells: IntArray, weight: FloatArray, reading: FloatArray, count: int, compiled: bool
) -> tuple[FloatArray, FloatArray, float]:
    """Weight and weighted mean (count,) of the readings of each cell, and their weighted square sum about the means."""
    if compiled:
        from compgen.identify.compiled import cell_means

        sums, mean = np.zeros(count), np.zeros(count)
        return sums, mean, float(cell_means(cells, _plain(weight), _plain(reading), sums, mean))
    total = np.bincount(cells, weight, count).astype(np.float64)
    mean = np.bincount(cells, weight * reading, count) / np.where(total > 0, total, 1.0)
    return total, mean, float(np.dot(weight, (reading - mean[cells]) ** 2))


def _plain(values: FloatArray) -> FloatArray:
    """Return the array as the compiled loops were made for: float64, in a row, writeable."""
    return np.require(values, np.float64, ["C", "W"])
