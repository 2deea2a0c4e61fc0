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
from dataclasses import dataclass, replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.kernels import use_compiled
from compgen.identify.grid import Grid, ToolData
from compgen.identify.grid_chain import Body, bodies_at, lengths_of, points_along, pull_back
from compgen.identify.grid_moments import BATCH, compiled_moments, moments
from compgen.identify.grid_normal import add_normal
from compgen.identify.grid_readings import levels_of, merge
from compgen.identify.motion import motion_map
from compgen.identify.parameters import ErrorParameters
from compgen.identify.state import IntArray, State
from compgen.model.exact import passing_order


@dataclass(frozen=True)
class GridProblem(Grid):
    """Readings on a full grid of levels; see the module's head.

    Parameters
    ----------
    cell : for each reading (tool, index into the flattened (groups, n_out, n_mid * n_in)).
    reading_mm, reading_weight : the readings before merging.
    scatter : weighted square sum of the readings about their means, half of it is part of the cost.
    single : whether no cell holds more than one reading.
    """

    cell: tuple[IntArray, IntArray]
    reading_mm: FloatArray
    reading_weight: FloatArray
    scatter: float
    single: bool

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
        if self.compiled:
            return 0.5 * self.scatter + self._compiled(state, gradient), gradient
        cost = 0.5 * self.scatter
        bodies, places = self._geometry(state)
        for data, tips in zip(self.tools, places, strict=True):
            force = np.zeros_like(tips[-1])
            cost += self._forces(state, data, tips[-1], force, gradient)
            pull_back(self, bodies, tips, force, gradient)
        return cost, gradient

    def _compiled(self, state: State, gradient: FloatArray) -> float:
        """Return the cost and add the gradient, all in one compiled pass."""
        from compgen.identify.compiled import chain_gradient

        chain, levels, squareness = self.plan
        motion = self.motion
        directions, derivatives = self.travel(state)
        cost = 0.0
        for data in self.tools:
            cost += chain_gradient(
                chain,
                levels,
                directions,
                derivatives,
                motion.row,
                motion.column,
                motion.value,
                state.errors,
                squareness,
                data.tool_mm,
                state.stations_mm,
                state.dead_length_mm,
                self.station_of,
                data.weight,
                data.length_mm,
                gradient,
            )
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
        from compgen.identify.compiled import chain_distances

        chain, levels, _ = self.plan
        motion = self.motion
        directions, _ = self.travel(state)
        for data in self.tools:
            distance = np.empty(data.weight.shape)
            chain_distances(
                chain,
                levels,
                directions,
                motion.row,
                motion.column,
                motion.value,
                state.errors,
                data.tool_mm,
                state.stations_mm,
                self.station_of,
                distance,
            )
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
        """J^T W J (size, size) with C in place of the exact derivative."""
        matrix = np.zeros((self.size, self.size))
        places = [] if self.compiled else self._geometry(state)[1]
        for k, data in enumerate(self.tools):
            sums = compiled_moments(self, data, state) if self.compiled else moments(self, data, places[k][-1], state)
            add_normal(self, sums, data.tool_mm, state, matrix)
        first, second = self.parameters.size, self.parameters.size + 3 * self.stations
        matrix[first:, :first] = matrix[:first, first:].T
        matrix[second:, first:second] = matrix[first:second, second:].T
        return matrix


#: Readings from which the compiled loops pay for a single identification.
LARGE = 100_000
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
    compiled = use_compiled(count, LARGE)
    found = [levels_of(position_mm[:, axis], compiled=compiled) for axis in range(3)]
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
