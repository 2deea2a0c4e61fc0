"""How the unknown errors act at the levels of a grid: the sparse map behind the normal matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array

from compgen.core.csvio import FloatArray
from compgen.core.names import SQUARENESS_NAMES
from compgen.identify.parameters import ErrorParameters
from compgen.identify.state import IntArray
from compgen.model.exact import travel_directions


@dataclass(frozen=True)
class Kind:
    """An unknown displacement of ``output`` at every level of ``axis``, times the coordinate of ``lever`` (or 1)."""

    output: int
    axis: int
    lever: int | None


@dataclass(frozen=True)
class Entries:
    """Sparse matrix from unknowns to the levels of an axis: level, column of the unknown and value of each entry."""

    level: IntArray
    column: IntArray
    value: FloatArray

    def scaled(self, factor: FloatArray) -> Entries:
        """Return the entries with each level's row multiplied by ``factor`` (levels,)."""
        return Entries(self.level, self.column, self.value * factor[self.level])

    def times(self, factor: float) -> Entries:
        """Return the entries multiplied by a number."""
        return Entries(self.level, self.column, self.value * factor)


def reduced_entries(parameters: ErrorParameters, bases: Sequence[FloatArray]) -> tuple[Entries, ...]:
    """Return the entries of basis times free coefficients for every curve."""
    found = []
    for curve in parameters.curves:
        matrix = bases[curve.error.axis] @ curve.free
        level, column = np.nonzero(matrix)
        found.append(Entries(level, column + curve.columns.start, matrix[level, column]))
    return tuple(found)


@dataclass(frozen=True)
class LevelMap:
    """How the unknown errors act at the levels: as a list of kinds and a matrix from unknowns to kinds and levels.

    ``kinds`` by axis; ``transposed`` (size, levels of all kinds), sparse, the kinds of one axis after another.
    """

    kinds: tuple[tuple[Kind, ...], tuple[Kind, ...], tuple[Kind, ...]]
    transposed: csr_array


#: Entries of C smaller than this are left out of the normal matrix; they would only slow it down.
SMALL = 1e-3


def level_map(
    parameters: ErrorParameters,
    levels_mm: Sequence[FloatArray],
    reduced: Sequence[Entries],
    tool_mm: FloatArray,
    squareness_rad: FloatArray,
) -> LevelMap:
    """Build the map for one tool offset (3,) at given squareness errors (3,); curve errors count as zero.

    ``reduced`` holds the entries of basis times free coefficients of every curve.
    """
    chain = parameters.machine.chain
    directions, derivatives = travel_directions(parameters.machine, squareness_rad)
    parts: dict[Kind, list[Entries]] = {}
    for curve, entries in zip(parameters.curves, reduced, strict=True):
        axis, direction = curve.error.axis, curve.error.direction
        if curve.error.kind == "linear":
            parts.setdefault(Kind(direction, axis, None), []).append(entries)
            continue
        after, before = (direction + 1) % 3, (direction + 2) % 3
        levers: list[tuple[int | None, FloatArray]] = [(None, tool_mm)]
        levers += [(lever, directions[lever]) for lever in chain.lever_axes(axis)]
        for lever, arm in levers:
            for output, share in ((after, -float(arm[before])), (before, float(arm[after]))):  # e_direction x arm
                if abs(share) > SMALL:
                    kind = Kind(output, axis, None if lever == axis else lever)
                    scaled = entries.scaled(levels_mm[axis] * share) if lever == axis else entries.times(share)
                    parts.setdefault(kind, []).append(scaled)
    first = parameters.size - len(parameters.squareness)
    for k, name in enumerate(parameters.squareness):
        for axis, output in np.argwhere(np.abs(derivatives[:, :, SQUARENESS_NAMES.index(name)]) > SMALL).tolist():
            count = len(levels_mm[axis])
            values = derivatives[axis, output, SQUARENESS_NAMES.index(name)] * levels_mm[axis]
            column = Entries(np.arange(count), np.full(count, first + k), values)
            parts.setdefault(Kind(output, axis, None), []).append(column)
    return _assemble_map(parts, [len(levels) for levels in levels_mm], parameters.size)


def _assemble_map(parts: dict[Kind, list[Entries]], counts: Sequence[int], size: int) -> LevelMap:
    kinds = tuple(tuple(kind for kind in parts if kind.axis == axis) for axis in range(3))
    rows, columns, values, start = [], [], [], 0
    for group in kinds:
        for kind in group:
            for entries in parts[kind]:
                rows.append(entries.level + start)
                columns.append(entries.column)
                values.append(entries.value)
            start += counts[kind.axis]
    where = (np.concatenate(columns), np.concatenate(rows))
    return LevelMap(kinds, coo_array((np.concatenate(values), where), shape=(size, start)).tocsr())  # type: ignore[arg-type]
