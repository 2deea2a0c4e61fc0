"""A full grid of levels with the merged readings on it, and the unknowns: what all parts of the fast path share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import SQUARENESS_NAMES
from compgen.identify.motion import MotionMap
from compgen.identify.parameters import ErrorParameters
from compgen.identify.state import IntArray, State
from compgen.model.exact import passing_order, travel_directions


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
    levels_mm, bases : levels of X, Y, Z, and the curve bases there.
    motion : from the unknowns to delta and eps at the levels of X, Y, Z in a row.
    tools : the data by tool.
    station_of : station of each group (dead length).
    compiled : whether the compiled loops do the work (:mod:`compgen.core.kernels`), decided once for the problem.
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
        """First level of X, Y and Z where they stand one after another, and the number of all."""
        counts = [len(levels) for levels in self.levels_mm]
        return [0, counts[0], counts[0] + counts[1], sum(counts)]

    @cached_property
    def plan(self) -> tuple[IntArray, FloatArray, IntArray]:
        """Return what the compiled loops want to know about the chain, the levels, and the columns of squareness.

        See ``compiled_chain.carriages`` and ``compiled_chain.chain_gradient``.
        """
        sides = dict(passing_order(self.parameters.machine))
        counts = [len(levels) for levels in self.levels_mm]
        side = [int(sides[axis]) for axis in range(3)]
        chain = np.array([self.order[::-1], self.first_rows[:3], counts, side], dtype=np.int64)
        columns = np.full(3, -1, dtype=np.int64)
        names = self.parameters.squareness
        for k, name in enumerate(names):
            columns[SQUARENESS_NAMES.index(name)] = self.parameters.size - len(names) + k
        return chain, np.concatenate(self.levels_mm), columns

    def travel(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Directions of travel and their derivatives at the squareness of ``state``, see ``travel_directions``."""
        values = [0.0, 0.0, 0.0]
        names = self.parameters.squareness
        for k, name in enumerate(names):
            values[SQUARENESS_NAMES.index(name)] = float(state.errors[self.parameters.size - len(names) + k])
        return travel_directions(self.parameters.machine, np.array(values))


def nominal_targets(grid: Grid) -> list[FloatArray]:
    """Nominal targets (commanded position plus tool offset) by tool, each (3, cells of one group)."""
    out, mid, inner = grid.order
    shape = tuple(len(grid.levels_mm[axis]) for axis in grid.order)
    target = np.empty((3, *shape))
    target[out] = grid.levels_mm[out][:, None, None]
    target[mid] = grid.levels_mm[mid][:, None]
    target[inner] = grid.levels_mm[inner]
    return [target.reshape(3, -1) + data.tool_mm[:, None] for data in grid.tools]
