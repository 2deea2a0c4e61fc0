"""The same least-squares problem on a grid of levels: the fast path (``docs/method.md``, "Fast solver").

Every distinct axis position is a level. Readings of one station at one pose are merged into their weighted mean, so
the data become arrays over (station, x, y, z) in which a missing reading has weight zero.

* One pass (``evaluate``) gives cost and gradient of the EXACT model. The chain is passed body by body; each adds one
  axis, so that only the outermost works on the full grid. The gradient runs back along the same chain.
* ``normal_matrix`` needs only small moment tables of w u u^T over pairs of levels, because every entry of C is a
  monomial in the axis coordinates. It uses C in place of the exact derivative: the matrix steers the iteration, the
  optimum is where the exact gradient vanishes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import SQUARENESS_NAMES
from compgen.identify.grid import Grid, ToolData, levels_of, merge
from compgen.identify.grid_chain import (
    Body,
    bodies_at,
    lengths_of,
    level_slices,
    motion_map,
    points_along,
    pull_back,
    squareness_of,
)
from compgen.identify.grid_moments import BATCH, add_normal
from compgen.identify.kernels import compiled_loops
from compgen.identify.level_map import reduced_entries
from compgen.identify.parameters import ErrorParameters
from compgen.identify.state import IntArray, State
from compgen.model.exact import passing_order, travel_directions


@dataclass(frozen=True)
class GridProblem(Grid):
    """Readings on a full grid of levels; see the module's head.

    Parameters
    ----------
    cell : for each reading (tool, index into the flattened (groups, n_out, n_mid * n_in)).
    reading_mm, reading_weight : the readings before merging.
    scatter : weighted square sum of the readings about their means, half of it is part of the cost.
    single : whether no cell holds more than one reading.
    memo : geometry at the state that was looked at last; it does not depend on the weights.
    """

    cell: tuple[IntArray, IntArray]
    reading_mm: FloatArray
    reading_weight: FloatArray
    scatter: float
    single: bool
    memo: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

    def weighted(self, weight: FloatArray) -> GridProblem:
        """Return the same problem with other weights of the readings."""
        shape = self.tools[0].weight.shape
        if self.single and len(self.tools) == 1:
            cells = np.zeros(self.tools[0].weight.size)
            cells[self.cell[1]] = weight
            tools: tuple[ToolData, ...] = (replace(self.tools[0], weight=cells.reshape(shape)),)
            return replace(self, tools=tools, reading_weight=weight)
        tools, scatter = merge(self.tools, shape, self.cell, self.reading_mm, weight)
        return replace(self, tools=tools, reading_weight=weight, scatter=scatter)

    def evaluate(self, state: State) -> tuple[float, FloatArray]:
        """Half the weighted sum of squares with the exact model, and its exact gradient (size,)."""
        gradient = np.zeros(self.size)
        loops = compiled_loops()
        if loops is not None:
            return 0.5 * self.scatter + self._compiled(loops, state, gradient), gradient
        cost = 0.5 * self.scatter
        bodies, places = self._geometry(state)
        for data, tips in zip(self.tools, places, strict=True):
            force = np.zeros_like(tips[-1])
            cost += self._forces(state, data, tips[-1], force, gradient)
            pull_back(self, bodies, tips, force, gradient)
        return cost, gradient

    def _compiled(self, loops: ModuleType, state: State, gradient: FloatArray) -> float:
        """Return the cost and add the gradient, all in one compiled pass."""
        parameters = self.parameters
        directions, derivatives = travel_directions(parameters.machine, squareness_of(parameters, state))
        motion = (self.motion @ state.errors).reshape(-1, 6)
        own = level_slices(self.levels_mm)
        travel = np.concatenate([self.levels_mm[axis][:, None] * directions[axis] for axis in range(3)])
        sides = dict(passing_order(parameters.machine))
        by_motion, by_group, cost = np.zeros_like(motion), np.zeros((self.groups, 4)), 0.0
        for data in self.tools:
            by_tool = np.zeros_like(motion)
            cost += float(
                loops.chain_gradient(
                    np.array(self.order[::-1]),
                    np.array([rows.start for rows in own]),
                    np.array([len(levels) for levels in self.levels_mm]),
                    np.array([int(sides[axis]) for axis in range(3)]),
                    motion,
                    travel,
                    data.tool_mm,
                    state.stations_mm[self.station_of],
                    state.dead_length_mm,
                    data.weight,
                    data.length_mm,
                    by_tool,
                    by_group,
                )
            )
            by_motion += by_tool
        first, second = parameters.size, parameters.size + 3 * self.stations
        gradient[:first] += by_motion.ravel() @ self.motion
        by_direction = [self.levels_mm[axis] @ by_motion[own[axis], :3] for axis in range(3)]
        for k, name in enumerate(parameters.squareness):
            part = np.vdot(by_direction, derivatives[:, :, SQUARENESS_NAMES.index(name)])
            gradient[first - len(parameters.squareness) + k] += float(part)
        for group, station in enumerate(self.station_of.tolist()):
            gradient[first + 3 * station : first + 3 * station + 3] += by_group[group, :3]
        gradient[second:] += by_group[:, 3]
        return cost

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
        """Bodies of the chain, and by tool the points after each body; kept for the next question about ``state``."""
        if self.memo.get("state") is not state:
            bodies = bodies_at(self, state)
            self.memo.update(
                state=state, geometry=(bodies, [points_along(bodies, data.tool_mm) for data in self.tools])
            )
        bodies, places = self.memo["geometry"]
        return bodies, places

    def predicted(self, state: State) -> list[FloatArray]:
        """Model readings by tool, each (groups, n_out, n_mid * n_in), mm."""
        found = []
        for tips in self._geometry(state)[1]:
            sight = tips[-1][None] - state.stations_mm[self.station_of][:, None, :, None]
            found.append(lengths_of(sight) - state.dead_length_mm[:, None, None])
        return found

    def residuals(self, state: State) -> FloatArray:
        """Model minus reading of every reading, shape (n,), mm."""
        return self._at_readings(self.predicted(state)) - self.reading_mm

    def distances(self, state: State) -> FloatArray:
        """Distance from the station of every reading, shape (n,), mm."""
        parts = [part + state.dead_length_mm[:, None, None] for part in self.predicted(state)]
        return self._at_readings(parts)

    def _at_readings(self, parts: Sequence[FloatArray]) -> FloatArray:
        tool, cell = self.cell
        if len(parts) == 1:
            return np.asarray(parts[0].ravel()[cell])
        return np.asarray(np.stack([part.ravel() for part in parts])[tool, cell])

    def normal_matrix(self, state: State) -> FloatArray:
        """J^T W J (size, size) with C in place of the exact derivative."""
        matrix = np.zeros((self.size, self.size))
        for data, tips in zip(self.tools, self._geometry(state)[1], strict=True):
            add_normal(self, data, tips[-1], state, matrix)
        first, second = self.parameters.size, self.parameters.size + 3 * self.stations
        matrix[first:, :first] = matrix[:first, first:].T
        matrix[second:, first:second] = matrix[first:second, second:].T
        return matrix


#: A grid is used when at least this share of its cells holds readings.
LEAST_FILL = 0.1


def grid_problem(
    parameters: ErrorParameters,
    position_mm: FloatArray,
    tool_mm: FloatArray,
    station: IntArray,
    group: IntArray,
    reading_mm: FloatArray,
) -> GridProblem | None:
    """Sort readings into a grid of levels, all weights 1; None where their positions form no grid.

    Parameters
    ----------
    parameters : the unknown errors.
    position_mm : commanded positions of the readings, shape (n, 3).
    tool_mm : their tool offsets, (3,) or (n, 3).
    station, group, reading_mm : of each reading, shape (n,).
    """
    count = len(reading_mm)
    compiled_loops(count)
    found = [levels_of(np.ascontiguousarray(position_mm[:, axis])) for axis in range(3)]
    levels, at = [item[0] for item in found], [item[1] for item in found]
    if tool_mm.ndim == 1:
        tools, tool = tool_mm[None], np.zeros(count, dtype=np.int64)
    else:
        tools, tool = np.unique(tool_mm, axis=0, return_inverse=True)
        tool = tool.ravel()
    groups = int(group.max()) + 1
    cells = groups * int(np.prod([len(level) for level in levels]))
    if len(tools) * cells * LEAST_FILL > count:
        return None
    order = tuple(axis for axis, _ in reversed(passing_order(parameters.machine)))
    out, mid, inner = order
    size_mid, size_in = len(levels[mid]), len(levels[inner])
    index = group * len(levels[out]) + at[out]
    index = (index * size_mid + at[mid]) * size_in + at[inner]
    station_of = np.zeros(groups, dtype=np.int64)
    station_of[group] = station
    shape = (groups, len(levels[out]), size_mid * size_in)
    bases = tuple(parameters.basis(axis, levels[axis]) for axis in range(3))
    reduced = reduced_entries(parameters, bases)
    nothing = np.zeros((0, 0, 0))
    empty = [ToolData(offset, nothing, nothing) for offset in tools]
    cell = (tool.astype(np.int64), index.astype(np.int64))
    weight = np.ones(count)
    merged, scatter = merge(empty, shape, cell, reading_mm, weight)
    single = len(tools) == 1 and int(np.bincount(cell[1]).max()) == 1
    return GridProblem(
        parameters=parameters,
        order=order,  # type: ignore[arg-type]
        levels_mm=tuple(levels),  # type: ignore[arg-type]
        bases=bases,  # type: ignore[arg-type]
        reduced=reduced,
        motion=motion_map(parameters, levels, reduced),
        tools=merged,
        station_of=station_of,
        cell=cell,
        reading_mm=reading_mm,
        reading_weight=weight,
        scatter=scatter,
        single=single,
    )
