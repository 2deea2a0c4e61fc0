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
from scipy.sparse import coo_array, csr_array

from compgen.core.csvio import FloatArray
from compgen.core.names import SQUARENESS_NAMES
from compgen.identify.kernels import compiled_loops
from compgen.identify.parameters import ErrorParameters
from compgen.identify.state import IntArray, State
from compgen.model.exact import level_rotations, passing_order, travel_directions

#: Numbers that a batch of stations may hold: small ones save calls, larger ones leave the cache.
BATCH = 60_000
#: Index into the six different entries of a symmetric 3 x 3 matrix.
_SYMMETRIC = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])


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


@dataclass(frozen=True)
class ToolData:
    """The merged readings taken with one tool: weight and length, each (groups, n_out, n_mid * n_in)."""

    tool_mm: FloatArray
    weight: FloatArray
    length_mm: FloatArray


@dataclass(frozen=True)
class GridProblem:
    """Readings on a full grid of levels; see the module's head.

    Parameters
    ----------
    parameters : the unknown errors.
    order : axes from the outermost body of the chain (the last to be passed) to the innermost.
    levels_mm, bases, reduced : levels of X, Y, Z, the curve bases there, and these times the free coefficients.
    motion : from the unknowns to delta and eps at the levels of X, Y, Z in a row, shape (levels * 6, size).
    tools : the data by tool.
    station_of : station of each group (dead length).
    cell : for each reading (tool, index into the flattened (groups, n_out, n_mid * n_in)).
    reading_mm, reading_weight : the readings before merging.
    scatter : weighted square sum of the readings about their means, half of it is part of the cost.
    single : whether no cell holds more than one reading.
    memo : geometry at the state that was looked at last; it does not depend on the weights.
    """

    parameters: ErrorParameters
    order: tuple[int, int, int]
    levels_mm: tuple[FloatArray, FloatArray, FloatArray]
    bases: tuple[FloatArray, FloatArray, FloatArray]
    reduced: tuple[Entries, ...]
    motion: FloatArray
    tools: tuple[ToolData, ...]
    station_of: IntArray
    cell: tuple[IntArray, IntArray]
    reading_mm: FloatArray
    reading_weight: FloatArray
    scatter: float
    single: bool
    memo: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

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

    def weighted(self, weight: FloatArray) -> GridProblem:
        """Return the same problem with other weights of the readings."""
        shape = self.tools[0].weight.shape
        if self.single and len(self.tools) == 1:
            cells = np.zeros(self.tools[0].weight.size)
            cells[self.cell[1]] = weight
            tools: tuple[ToolData, ...] = (replace(self.tools[0], weight=cells.reshape(shape)),)
            return replace(self, tools=tools, reading_weight=weight)
        tools, scatter = _merge(self.tools, shape, self.cell, self.reading_mm, weight)
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
            _pull_back(self, bodies, tips, force, gradient)
        return cost, gradient

    def _compiled(self, loops: ModuleType, state: State, gradient: FloatArray) -> float:
        """Return the cost and add the gradient, all in one compiled pass."""
        parameters = self.parameters
        directions, derivatives = travel_directions(parameters.machine, _squareness(parameters, state))
        motion = (self.motion @ state.errors).reshape(-1, 6)
        own = _level_slices(self.levels_mm)
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
            distance = _lengths(sight)
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

    def _geometry(self, state: State) -> tuple[list[_Body], list[list[FloatArray]]]:
        """Bodies of the chain, and by tool the points after each body; kept for the next question about ``state``."""
        if self.memo.get("state") is not state:
            bodies = _bodies(self, state)
            self.memo.update(state=state, geometry=(bodies, [_tips(bodies, data.tool_mm) for data in self.tools]))
        bodies, places = self.memo["geometry"]
        return bodies, places

    def predicted(self, state: State) -> list[FloatArray]:
        """Model readings by tool, each (groups, n_out, n_mid * n_in), mm."""
        found = []
        for tips in self._geometry(state)[1]:
            sight = tips[-1][None] - state.stations_mm[self.station_of][:, None, :, None]
            found.append(_lengths(sight) - state.dead_length_mm[:, None, None])
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
            _add_normal(self, data, tips[-1], state, matrix)
        first, second = self.parameters.size, self.parameters.size + 3 * self.stations
        matrix[first:, :first] = matrix[:first, first:].T
        matrix[second:, first:second] = matrix[first:second, second:].T
        return matrix


@dataclass(frozen=True)
class _Body:
    """One carriage at its levels: rotation R (n, 3, 3), J_l (n, 3, 3), travel plus delta (n, 3), rows of its levels."""

    axis: int
    tool_side: bool
    rotation: FloatArray
    jacobian: FloatArray
    shift: FloatArray
    position_mm: FloatArray
    direction_derivative: FloatArray
    rows: slice


def _squareness(parameters: ErrorParameters, state: State) -> FloatArray:
    """EC0Y, EB0Z, EA0Z in rad, those that are not unknown being zero."""
    values = np.zeros(3)
    for k, name in enumerate(parameters.squareness):
        values[SQUARENESS_NAMES.index(name)] = state.errors[parameters.size - len(parameters.squareness) + k]
    return values


def _bodies(problem: GridProblem, state: State) -> list[_Body]:
    """Bodies in the order in which the tool point passes them (innermost first)."""
    parameters = problem.parameters
    directions, derivatives = travel_directions(parameters.machine, _squareness(parameters, state))
    motion = (problem.motion @ state.errors).reshape(-1, 6)
    rotation, jacobian = level_rotations(motion[:, 3:])
    own = _level_slices(problem.levels_mm)
    return [
        _Body(
            axis,
            tool_side,
            rotation[own[axis]],
            jacobian[own[axis]],
            problem.levels_mm[axis][:, None] * directions[axis] + motion[own[axis], :3],
            problem.levels_mm[axis],
            derivatives[axis],
            own[axis],
        )
        for axis, tool_side in passing_order(parameters.machine)
    ]


def _level_slices(levels_mm: Sequence[FloatArray]) -> list[slice]:
    """Rows of the levels of X, Y and Z where they stand one after another."""
    bounds = np.cumsum([0, *(len(levels) for levels in levels_mm)]).tolist()
    return [slice(bounds[axis], bounds[axis + 1]) for axis in range(3)]


def _motion_map(parameters: ErrorParameters, levels_mm: Sequence[FloatArray], reduced: Sequence[Entries]) -> FloatArray:
    own = _level_slices(levels_mm)
    matrix = np.zeros((own[2].stop, 6, parameters.size))
    for curve, entries in zip(parameters.curves, reduced, strict=True):
        column = curve.error.direction + (3 if curve.error.kind == "angular" else 0)
        matrix[own[curve.error.axis].start + entries.level, column, entries.column] = entries.value
    return matrix.reshape(-1, parameters.size)


def _tips(bodies: Sequence[_Body], tool_mm: FloatArray) -> list[FloatArray]:
    """Points before the first body (1, 3, 1) and after each body (n_axis, 3, product of the earlier levels)."""
    points = [tool_mm.reshape(1, 3, 1)]
    for body in bodies:
        before = _flat(points[-1])
        shift = body.shift if body.tool_side else np.einsum("lij,lj->li", body.rotation, body.shift)
        points.append(shift[:, :, None] + body.rotation @ before)
    return points


def _lengths(vectors: FloatArray) -> FloatArray:
    """Lengths of vectors (..., 3, m): shape (..., m)."""
    squares = vectors * vectors
    total = squares[..., 0, :] + squares[..., 1, :]
    total += squares[..., 2, :]
    return np.asarray(np.sqrt(total, out=total))


def _flat(points: FloatArray) -> FloatArray:
    """(n, 3, m) -> (3, n * m)."""
    return np.ascontiguousarray(points.transpose(1, 0, 2)).reshape(3, -1)


def _pull_back(
    problem: GridProblem,
    bodies: Sequence[_Body],
    tips: Sequence[FloatArray],
    force: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add the gradient by the errors for forces on the tips (n_out, 3, m): back along the chain, body by body."""
    parameters = problem.parameters
    first = parameters.size - len(parameters.squareness)
    by_motion = np.empty((len(problem.motion) // 6, 6))
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
    gradient[: parameters.size] += by_motion.ravel() @ problem.motion


def _add_normal(problem: GridProblem, data: ToolData, tip: FloatArray, state: State, matrix: FloatArray) -> None:
    """Add the part of one tool to the upper blocks of the normal matrix."""
    shape = tuple(len(problem.levels_mm[axis]) for axis in problem.order)
    level = level_map(
        problem.parameters, problem.levels_mm, problem.reduced, data.tool_mm, _squareness(problem.parameters, state)
    )
    first, second = problem.parameters.size, problem.parameters.size + 3 * problem.stations
    loops = compiled_loops()
    step = problem.groups if loops else max(1, BATCH // tip.size)
    weighted = np.zeros((6, *shape))
    for start in range(0, problem.groups, step):
        batch = slice(start, min(start + step, problem.groups))
        stations = problem.station_of[batch]
        if loops is None:
            sight = tip - state.stations_mm[stations][:, None, :, None]
            sight /= _lengths(sight)[:, :, None, :]
            products = _outer_products(sight, data.weight[batch], shape)  # 6 of w u u^T, 3 of w u, 1 of w
            weighted += products[:, :6].sum(axis=0) if len(stations) > 1 else products[0, :6]
            tables = _moment_tables(problem, products)
        else:
            coordinates = [problem.levels_mm[axis] for axis in problem.order]
            tables = [np.zeros((len(stations), count, 3, 10)) for count in shape]
            loops.moments(
                np.ascontiguousarray(tip),
                state.stations_mm[stations],
                data.weight[batch],
                *coordinates,
                weighted,
                *tables,
            )
        by_station, by_group = _station_moments(problem, level, tables)
        by_station = level.transposed @ by_station  # (size, batch * 3)
        sums = tables[0][:, :, 0].sum(axis=1)
        for k, station in enumerate(stations.tolist()):
            columns = slice(first + 3 * station, first + 3 * station + 3)
            matrix[:first, columns] -= by_station[:, 3 * k : 3 * k + 3]
            matrix[columns, columns] += sums[k, _SYMMETRIC]
            matrix[columns, second + start + k] += sums[k, 6:9]
            matrix[second + start + k, second + start + k] += sums[k, 9]
        matrix[:first, second + batch.start : second + batch.stop] -= level.transposed @ by_group
    levels = _level_matrix(problem, level, weighted)
    matrix[:first, :first] += level.transposed @ (level.transposed @ levels).T


def _outer_products(unit: FloatArray, weight: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Moments w u u^T (xx, yy, zz, xy, xz, yz), w u (x, y, z) and w on the grid: shape (groups, 10, n_out, n_mid, n_in)."""
    moments = np.empty((len(weight), 10, *weight.shape[1:]))
    moments[:, 9] = weight
    for k in range(3):
        np.multiply(weight, unit[:, :, k], out=moments[:, 6 + k])
        np.multiply(moments[:, 6 + k], unit[:, :, k], out=moments[:, k])
    np.multiply(moments[:, 6], unit[:, :, 1], out=moments[:, 3])
    np.multiply(moments[:, 6], unit[:, :, 2], out=moments[:, 4])
    np.multiply(moments[:, 7], unit[:, :, 2], out=moments[:, 5])
    return moments.reshape(len(weight), 10, *shape)


def _powers(levels_mm: FloatArray, count: int) -> FloatArray:
    powers = np.ones((len(levels_mm), count))
    powers[:, 1] = levels_mm
    if count > 2:
        powers[:, 2] = levels_mm * levels_mm
    return powers


def _moment_tables(problem: GridProblem, products: FloatArray) -> list[FloatArray]:
    """Sum the products (groups, 10, n_out, n_mid, n_in) per level of the outer, middle and inner axis.

    Each table is (groups, levels, 3, 10): the sums times 1 and times the coordinates of the other two axes, in the
    order inner, mid, out.
    """
    out, mid, inner = (_powers(problem.levels_mm[axis], 2) for axis in problem.order)
    groups = len(products)
    over_inner = products @ inner  # [group, 10, out, mid, q_in]
    by_out = over_inner.swapaxes(3, 4) @ mid  # [group, 10, out, q_in, q_mid]
    by_mid = over_inner.transpose(0, 1, 3, 4, 2) @ out  # [group, 10, mid, q_in, q_out]
    flat = products.reshape(groups * 10, *products.shape[2:])
    over_out = _contract_first(flat, out)  # [group * 10, q_out, mid, in]
    by_inner = (over_out.swapaxes(2, 3) @ mid).transpose(0, 2, 3, 1)  # [group * 10, in, q_mid, q_out]
    tables = (by_out, by_mid, by_inner.reshape(groups, 10, *by_inner.shape[1:]))
    return [np.stack([t[..., 0, 0], t[..., 1, 0], t[..., 0, 1]]).transpose(1, 3, 0, 2) for t in tables]


def _station_moments(
    problem: GridProblem, level: LevelMap, tables: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Per kind and level: sums of w q u_o u^T (levels, groups * 3) and of w q u_o (levels, groups), q the kind's lever."""
    out, mid, inner = problem.order
    place = {out: (tables[0], (inner, mid)), mid: (tables[1], (inner, out)), inner: (tables[2], (mid, out))}
    stations, dead = [], []
    for axis, kinds in enumerate(level.kinds):
        table, levers = place[axis]
        for kind in kinds:
            part = table[:, :, 0 if kind.lever is None else 1 + levers.index(kind.lever)]  # [group, level, 10]
            chosen = part[:, :, _SYMMETRIC[kind.output]]  # [group, level, 3]
            stations.append(chosen.transpose(1, 0, 2).reshape(part.shape[1], -1))
            dead.append(part[:, :, 6 + kind.output].T)
    return np.concatenate(stations), np.concatenate(dead)


def _contract_first(table: FloatArray, powers: FloatArray) -> FloatArray:
    """Sum over the second axis of (k, a, b, c) with powers (a, q): (k, q, b, c) by matrix products."""
    count, first = table.shape[:2]
    return (powers.T @ table.reshape(count, first, -1)).reshape(count, powers.shape[1], *table.shape[2:])


def _level_matrix(problem: GridProblem, level: LevelMap, weighted: FloatArray) -> FloatArray:
    """Normal matrix of the kinds at their levels, from moments of w u u^T (6, n_out, n_mid, n_in) over pairs."""
    out, mid, inner = problem.order
    powers = {axis: _powers(problem.levels_mm[axis], 3) for axis in range(3)}
    pair = {
        (out, mid): (weighted @ powers[inner]).transpose(3, 0, 1, 2),  # [power of the third, 6, first, second]
        (out, inner): (powers[mid].T @ weighted).transpose(2, 0, 1, 3),
        (mid, inner): _contract_first(weighted, powers[out]).transpose(1, 0, 2, 3),
    }
    sizes = [len(problem.levels_mm[axis]) for axis in range(3)]
    starts = np.cumsum([0, *(len(level.kinds[axis]) * sizes[axis] for axis in range(3))])
    result = np.zeros((int(starts[3]), int(starts[3])))
    for (a, b), table in pair.items():
        if not level.kinds[a] or not level.kinds[b]:  # the model may leave an axis without any error
            continue
        block = _pair_block(level.kinds[a], level.kinds[b], table, problem.levels_mm[a], problem.levels_mm[b])
        rows, columns = slice(starts[a], starts[a + 1]), slice(starts[b], starts[b + 1])
        result[rows, columns] = block
        result[columns, rows] = block.T
    for axis, (first, second) in {out: (out, mid), mid: (out, mid), inner: (out, inner)}.items():
        if not level.kinds[axis]:
            continue
        table = pair[(first, second)]
        other = second if axis == first else first
        turned = table if axis == first else table.transpose(0, 1, 3, 2)
        along = (turned @ powers[other]).transpose(3, 0, 1, 2)  # [power of other, of third, 6, level]
        third = 3 - first - second
        result[starts[axis] : starts[axis + 1], starts[axis] : starts[axis + 1]] = _own_block(
            level.kinds[axis], along, other, third
        )
    return result


def _pair_block(
    kinds_a: Sequence[Kind], kinds_b: Sequence[Kind], table: FloatArray, levels_a: FloatArray, levels_b: FloatArray
) -> FloatArray:
    """Block of two different axes: kinds and levels of the first by those of the second."""
    a, b = kinds_a[0].axis, kinds_b[0].axis
    third = 3 - a - b
    power = np.array([[int(p.lever == third) + int(q.lever == third) for q in kinds_b] for p in kinds_a])
    entry = _SYMMETRIC[np.ix_([p.output for p in kinds_a], [q.output for q in kinds_b])]
    block = table[power, entry]  # [kind a, kind b, level a, level b]
    scale_b = np.array([levels_b if p.lever == b else np.ones(len(levels_b)) for p in kinds_a])
    scale_a = np.array([levels_a if q.lever == a else np.ones(len(levels_a)) for q in kinds_b])
    block = block * scale_b[:, None, None, :] * scale_a[None, :, :, None]
    return np.ascontiguousarray(block.transpose(0, 2, 1, 3)).reshape(
        len(kinds_a) * len(levels_a), len(kinds_b) * len(levels_b)
    )


def _own_block(kinds: Sequence[Kind], along: FloatArray, other: int, third: int) -> FloatArray:
    """Block of one axis with itself: diagonal in the levels; ``along`` is [power of other, of third, 6, level]."""
    first = np.array([[int(p.lever == other) + int(q.lever == other) for q in kinds] for p in kinds])
    second = np.array([[int(p.lever == third) + int(q.lever == third) for q in kinds] for p in kinds])
    outputs = [kind.output for kind in kinds]
    diagonal = along[first, second, _SYMMETRIC[np.ix_(outputs, outputs)]]  # [kind, kind, level]
    count = along.shape[3]
    block = np.zeros((len(kinds), count, len(kinds), count))
    index = np.arange(count)
    block[:, index, :, index] = diagonal.transpose(2, 0, 1)
    return block.reshape(len(kinds) * count, -1)


def _merge(
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


def nominal_targets(problem: GridProblem) -> list[FloatArray]:
    """Nominal targets (commanded position plus tool offset) by tool, each (3, cells of one group)."""
    out, mid, inner = problem.order
    shape = tuple(len(problem.levels_mm[axis]) for axis in problem.order)
    target = np.empty((3, *shape))
    target[out] = problem.levels_mm[out][:, None, None]
    target[mid] = problem.levels_mm[mid][:, None]
    target[inner] = problem.levels_mm[inner]
    return [target.reshape(3, -1) + data.tool_mm[:, None] for data in problem.tools]


def start_moments(problem: GridProblem) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return what the closed-form start needs of the readings, in centred and scaled coordinates.

    With p = (target - centre)/scale and L = reading/scale - offset of the group: sums over the readings of each group
    of products of (2 p, 2 L, 1, |p|^2 - L^2).

    Returns
    -------
    moments (groups, 6, 6), offset (groups,), centre in mm (3,), scale in mm.
    """
    targets = nominal_targets(problem)
    centre = targets[0].mean(axis=1)
    scale = max(float(np.ptp(targets[0], axis=1).max()), 1.0)
    readings = np.sum([np.sum(data.length_mm * (data.weight > 0), axis=(1, 2)) for data in problem.tools], axis=0)
    counts = np.sum([np.count_nonzero(data.weight, axis=(1, 2)) for data in problem.tools], axis=0)
    offset = readings / np.maximum(counts, 1) / scale
    moments = np.zeros((problem.groups, 6, 6))
    for data, target in zip(problem.tools, targets, strict=True):
        p = (target - centre[:, None]) / scale
        columns = np.ones((6, p.shape[1]))
        columns[:3] = 2.0 * p
        square = np.einsum("km,km->m", p, p)
        for group in range(problem.groups):
            reading = data.length_mm[group].ravel() / scale - offset[group]
            columns[3] = 2.0 * reading
            columns[5] = square - reading**2
            present = (data.weight[group] > 0).ravel()
            moments[group] += (columns * present) @ columns.T
    return moments, offset, centre, scale


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
    merged, scatter = _merge(empty, shape, cell, reading_mm, weight)
    single = len(tools) == 1 and int(np.bincount(cell[1]).max()) == 1
    return GridProblem(
        parameters=parameters,
        order=order,  # type: ignore[arg-type]
        levels_mm=tuple(levels),  # type: ignore[arg-type]
        bases=bases,  # type: ignore[arg-type]
        reduced=reduced,
        motion=_motion_map(parameters, levels, reduced),
        tools=merged,
        station_of=station_of,
        cell=cell,
        reading_mm=reading_mm,
        reading_weight=weight,
        scatter=scatter,
        single=single,
    )
