"""Lengths at positions off a grid, as from measurements on the fly: the compiled form, and large numbers in chunks.

The normal matrix needs the derivative of the tip by delta and eps of each carriage, interpolated between the nodes next
to the reading. In the cell of those nodes everything is a polynomial of the local coordinates, x = left + h xi: a hat
function is 1 - xi or xi, a lever arm is linear, so the derivative is u times a polynomial of degree 2, with u the line
of sight. Hence the sums of w u u^T times the 35 monomials of degree 4 and less contain all the information of the
readings of a cell, and the cost of the matrix does not grow with the number of unknowns. As on a grid, it uses C
instead of the exact derivative: the matrix only steers the iteration; the optimum is where the exact gradient vanishes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.names import SQUARENESS_NAMES
from compgen.identification.adjust.grid_problem import ENTRIES, MotionMap, add_own_blocks, lever_directions, motion_map
from compgen.identification.adjust.unknowns import ErrorParameters, IntArray, KnownPositions, State, TracerUnknowns
from compgen.kinematics.compiled_kernels import rotation_factors
from compgen.kinematics.exact_chain import passing_order, travel_directions
from compgen.kinematics.kernel_switch import FAST, SERIES_BELOW, loop

# Compiled pass over readings at any positions (numba, ``pip install compgen[fast]``): cost, gradient, normal matrix.

#: Powers of the three local coordinates in each monomial of degree 4 and less; those of degree 2 and less come first.
POWERS = np.array(
    sorted(((a, b, c) for a in range(5) for b in range(5 - a) for c in range(5 - a - b)), key=lambda p: (sum(p), p)),
    dtype=np.int64,
)
_PLACE = {tuple(power): k for k, power in enumerate(POWERS.tolist())}
#: Monomials of degree 2 and less.
LOW = 10
#: Place of the product of two of them, (10, 10).
PRODUCT = np.array([[_PLACE[tuple((a + b).tolist())] for b in POWERS[:LOW]] for a in POWERS[:LOW]], dtype=np.int64)
#: Two monomials of degree 2 and less with this product.
HIGH = len(POWERS)
_FIRST, _SECOND = np.array([np.argwhere(k == PRODUCT)[0] for k in range(HIGH)], dtype=np.int64).T.copy()
#: Room for the monomials of degree 4, and of degree 2: whole vector registers.
_HIGH_ROOM, _LOW_ROOM = 36, 12


@loop(fastmath=FAST, nogil=True)
def _add_products(table: FloatArray, factors: FloatArray, values: FloatArray) -> None:
    """Add the products of factors (k,) and values (m,) to a table (k, m); a separate loop is vectorised."""
    for j in range(len(factors)):
        line, factor = table[j], factors[j]
        for m in range(len(values)):
            line[m] += factor * values[m]


@loop(fastmath=FAST, nogil=True)
def pass_over(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    chain: IntArray,
    nodes: FloatArray,
    directions: FloatArray,
    motion: FloatArray,
    tool: FloatArray,
    stations: FloatArray,
    dead: FloatArray,
    position: tuple[FloatArray, FloatArray, FloatArray],
    station: IntArray,
    group: IntArray,
    length: FloatArray,
    weight: FloatArray,
    noise: tuple[float, float, float, float],
    by_motion: FloatArray,
    by_travel: FloatArray,
    by_station: FloatArray,
    by_group: FloatArray,
    residual: FloatArray,
    moments: bool,
    of_cells: FloatArray,
    of_groups: FloatArray,
) -> float:
    """Add the contributions of n readings, and return their weighted sum of squares.

    Parameters
    ----------
    chain : (4, 3) axes from the innermost body to the outermost; by axis the first node, the number of nodes, 1 for the
        tool side.
    nodes, motion : nodes of X, Y, Z in a row (k,), and delta and eps there (k, 6), linear in between.
    directions : of travel, (3, 3).
    tool, stations, dead : (3,), (S, 3), (G,).
    position, station, group, length, weight : of the readings, each (n,).
    noise : a, b, s and limit: the weight of a reading over the distance d is multiplied by (s / (a + b d))^2, and is 0
        if the residual exceeds limit (a + b d).
    by_motion, by_travel, by_station : gradient by motion (k, 6), by travel of each axis (3, 3), by stations (S, 3).
    by_group : of each dead length its gradient, the readings used, the square sum of their residuals, weights (G, 4).
    residual : output, model minus reading (n,), nan for a rejected reading.
    moments : whether to add the sums for the normal matrix: of w u u^T times the 35 monomials of the local coordinates
        by cell, ``of_cells`` (cells, 6, 36), and of w u u^T and w u times 10 monomials by dead length and cell,
        ``of_groups`` (G, cells, 9, 12); unused entries remain zero.
    """
    constant, slope, scale, limit = noise
    left, share, travel = np.zeros(3, dtype=np.int64), np.empty(3), np.full(3, np.nan)
    points, eps, factors = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    back, value, total, low, high = np.empty(6), np.empty(9), np.zeros(6), np.zeros(_LOW_ROOM), np.zeros(_HIGH_ROOM)
    inverse = np.empty(len(nodes))
    for k in range(len(nodes) - 1):
        inverse[k] = 1.0 / (nodes[k + 1] - nodes[k])
    cost = x = y = z = fx = fy = fz = 0.0
    cell, count = 0, len(length)
    for i in range(count + 1):
        # stations that read at the same stop are consecutive: chain and gradient are passed once for all of them
        if i == count or (position[0][i] != travel[0] or position[1][i] != travel[1] or position[2][i] != travel[2]):
            if i > 0:  # forces on the tip, back along the chain
                for step in range(3):
                    body = 2 - step
                    axis = chain[0, body]
                    a, b, c = eps[body, 0], eps[body, 1], eps[body, 2]
                    f1, f2, f3 = factors[body, 0], factors[body, 1], factors[body, 2]
                    px, py, pz = points[body, 0], points[body, 1], points[body, 2]
                    mx, my, mz = py * fz - pz * fy, pz * fx - px * fz, px * fy - py * fx
                    ox, oy, oz = b * mz - c * my, c * mx - a * mz, a * my - b * mx
                    back[3] = mx - f2 * ox + f3 * (b * oz - c * oy)
                    back[4] = my - f2 * oy + f3 * (c * ox - a * oz)
                    back[5] = mz - f2 * oz + f3 * (a * oy - b * ox)
                    ox, oy, oz = b * fz - c * fy, c * fx - a * fz, a * fy - b * fx
                    tx = fx - f1 * ox + f2 * (b * oz - c * oy)
                    ty = fy - f1 * oy + f2 * (c * ox - a * oz)
                    tz = fz - f1 * oz + f2 * (a * oy - b * ox)
                    if chain[3, axis] == 1:
                        back[0], back[1], back[2] = fx, fy, fz
                    else:
                        back[0], back[1], back[2] = tx, ty, tz
                    fx, fy, fz = tx, ty, tz
                    k, s = chain[1, axis] + left[axis], share[axis]
                    before, behind = by_motion[k], by_motion[k + 1]
                    for j in range(6):
                        part = s * back[j]
                        behind[j] += part
                        before[j] += back[j] - part
                    for j in range(3):
                        by_travel[axis, j] += travel[axis] * back[j]
                if moments:
                    _add_products(of_cells[cell], total, high)
                    total[:] = 0.0
                fx = fy = fz = 0.0
            if i == count:
                break
            # the interval between nodes, usually that of the previous stop, and the share of its right end
            for axis in range(3):
                q = position[axis][i]
                travel[axis] = q
                first = chain[1, axis]
                k = first + left[axis]
                if q < nodes[k] or q > nodes[k + 1]:
                    below, above = first, first + chain[2, axis] - 2
                    while below < above:
                        middle = (below + above + 1) // 2
                        if nodes[middle] <= q:
                            below = middle
                        else:
                            above = middle - 1
                    k = below
                    left[axis] = k - first
                share[axis] = min(max((q - nodes[k]) * inverse[k], 0.0), 1.0)
            # the tip: each body passed once, x -> q a + delta + R x on the tool side, R (x + q a + delta) on the other
            x, y, z = tool[0], tool[1], tool[2]
            for body in range(3):
                axis = chain[0, body]
                k, s, q = chain[1, axis] + left[axis], share[axis], travel[axis]
                before, behind = motion[k], motion[k + 1]
                dx = before[0] + s * (behind[0] - before[0]) + q * directions[axis, 0]
                dy = before[1] + s * (behind[1] - before[1]) + q * directions[axis, 1]
                dz = before[2] + s * (behind[2] - before[2]) + q * directions[axis, 2]
                a = before[3] + s * (behind[3] - before[3])
                b = before[4] + s * (behind[4] - before[4])
                c = before[5] + s * (behind[5] - before[5])
                square = a * a + b * b + c * c
                f1, f2 = rotation_factors(square)
                f3 = (1.0 - f1) / square if square >= SERIES_BELOW else 1.0 / 6.0 - square / 120.0
                eps[body, 0], eps[body, 1], eps[body, 2] = a, b, c
                factors[body, 0], factors[body, 1], factors[body, 2] = f1, f2, f3
                if chain[3, axis] == 0:
                    x, y, z = x + dx, y + dy, z + dz
                ox, oy, oz = b * z - c * y, c * x - a * z, a * y - b * x
                x, y, z = (
                    x + f1 * ox + f2 * (b * oz - c * oy),
                    y + f1 * oy + f2 * (c * ox - a * oz),
                    z + f1 * oz + f2 * (a * oy - b * ox),
                )
                points[body, 0], points[body, 1], points[body, 2] = x, y, z  # turned
                if chain[3, axis] == 1:
                    x, y, z = x + dx, y + dy, z + dz
            if moments:
                cell = (left[0] * (chain[2, 1] - 1) + left[1]) * (chain[2, 2] - 1) + left[2]
                p, q, r = share[0], share[1], share[2]
                low[0], low[1], low[2], low[3] = 1.0, r, q, p
                low[4], low[5], low[6], low[7], low[8], low[9] = r * r, q * r, q * q, p * r, p * q, p * p
                for m in range(HIGH):
                    high[m] = low[_FIRST[m]] * low[_SECOND[m]]
        here, g = station[i], group[i]
        ux, uy, uz = x - stations[here, 0], y - stations[here, 1], z - stations[here, 2]
        distance = np.sqrt(ux * ux + uy * uy + uz * uz)
        rest = distance - dead[g] - length[i]
        sigma = constant + slope * distance
        if abs(rest) > limit * sigma:
            residual[i] = np.nan
            continue
        residual[i] = rest
        ratio = scale / sigma
        w, one = weight[i] * ratio * ratio, 1.0 / distance
        ux, uy, uz = ux * one, uy * one, uz * one
        pull = w * rest
        cost += pull * rest
        gx, gy, gz = pull * ux, pull * uy, pull * uz
        fx, fy, fz = fx + gx, fy + gy, fz + gz
        by_station[here, 0] -= gx
        by_station[here, 1] -= gy
        by_station[here, 2] -= gz
        by_group[g, 0] -= pull
        by_group[g, 1] += 1.0
        by_group[g, 2] += rest * rest
        by_group[g, 3] += w
        if moments:
            value[6], value[7], value[8] = w * ux, w * uy, w * uz
            value[0], value[1], value[2] = value[6] * ux, value[7] * uy, value[8] * uz
            value[3], value[4], value[5] = value[6] * uy, value[6] * uz, value[7] * uz
            for j in range(6):
                total[j] += value[j]
            _add_products(of_groups[g, cell], value, low)
    return cost


#: Largest count of numbers in the sums of all cells; with more nodes the plain form is used.
MOST_SUMS = 40_000_000
#: Cells whose blocks are made at a time.
CELLS = 512
_CELL_SUMS, _GROUP_SUMS = 6 * 36, 9 * 12


@dataclass(frozen=True)
class Chunk:
    """n readings: coordinates x, y, z, station, dead length and reading, each (n,)."""

    position_mm: tuple[FloatArray, FloatArray, FloatArray]
    station: IntArray
    group: IntArray
    length_mm: FloatArray


@dataclass(frozen=True)
class DistanceNoise:
    """Standard uncertainty a + b d of a reading over the distance d, mm; its weight is (scale / (a + b d))^2.

    A reading whose residual exceeds ``limit`` of them has no weight.
    """

    constant_mm: float = 1.0
    proportional: float = 0.0
    scale_mm: float = 1.0
    limit: float = np.inf


@dataclass
class Sums:
    """The sums over readings: see :func:`compgen.identification.adjust.path_problem.pass_over`."""

    gradient: FloatArray
    #: Of each dead length: readings used, the square sum of their residuals, and their weights, (G, 3).
    by_group: FloatArray
    matrix: FloatArray | None = None
    cost: float = 0.0


@dataclass(frozen=True)
class PathModel(TracerUnknowns):
    """The unknowns of a machine with one tool, laid out for the compiled pass; only for curves linear between nodes.

    ``station_of`` (G,) is the station of each dead length.
    """

    parameters: ErrorParameters
    tool_mm: FloatArray
    station_of: IntArray
    motion: MotionMap

    @property
    def nodes_mm(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Nodes of X, Y and Z."""
        x, y, z = (axis.nodes_mm for axis in self.parameters.machine.axes)
        return x, y, z

    @property
    def first(self) -> list[int]:
        """First node of X, Y and Z in one list of all, and the number of all."""
        return [0, *np.cumsum([len(nodes) for nodes in self.nodes_mm]).tolist()]

    @property
    def cells(self) -> int:
        """Number of cells between the nodes."""
        return int(np.prod([len(nodes) - 1 for nodes in self.nodes_mm]))

    def directions(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Directions of travel and their derivatives, see ``travel_directions``."""
        names = self.parameters.squareness
        known = dict(zip(names, state.errors[self.parameters.size - len(names) :].tolist(), strict=True))
        return travel_directions(self.parameters.machine, np.array([known.get(name, 0.0) for name in SQUARENESS_NAMES]))

    def sums(
        self,
        state: State,
        chunks: Iterator[tuple[Chunk, FloatArray, FloatArray]],
        noise: DistanceNoise,
        *,
        matrix: bool,
        look: Callable[[Chunk, FloatArray], None] = lambda *_: None,
    ) -> Sums:
        """Pass over chunks of readings with their weights (n,) and room for their residuals (n,), passed to ``look``."""
        from compgen.identification.adjust.path_problem import pass_over

        directions, derivatives = self.directions(state)
        sides, first = dict(passing_order(self.parameters.machine)), self.first
        counts = [len(nodes) for nodes in self.nodes_mm]
        order = [axis for axis, _ in passing_order(self.parameters.machine)]
        chain = np.array([order, first[:3], counts, [int(sides[axis]) for axis in range(3)]], dtype=np.int64)
        motion = (self.motion.dense @ state.errors).reshape(-1, 6)
        nodes, tool = np.concatenate(self.nodes_mm), np.array(self.tool_mm)
        by_motion, by_travel = np.zeros_like(motion), np.zeros((3, 3))
        by_station, by_group = np.zeros((self.stations, 3)), np.zeros((self.groups, 4))
        cells = self.cells if matrix else 0
        of_cells, of_groups = np.zeros((cells, 6, 36)), np.zeros((self.groups, cells, 9, 12))
        model = chain, nodes, directions, motion, tool, state.stations_mm, state.dead_length_mm
        limits = noise.constant_mm, noise.proportional, noise.scale_mm, noise.limit
        totals, tables = (by_motion, by_travel, by_station, by_group), (matrix, of_cells, of_groups)
        square_sum = 0.0
        for chunk, weight, residual in chunks:
            readings = chunk.position_mm, chunk.station, chunk.group, chunk.length_mm, weight
            square_sum += pass_over(*model, *readings, limits, *totals, residual, *tables)
            look(chunk, residual)
        gradient = np.concatenate([by_motion.ravel() @ self.motion.dense, by_station.ravel(), by_group[:, 0]])
        start = self.parameters.size - len(self.parameters.squareness)
        by_squareness = np.einsum("ai,aik->k", by_travel, derivatives)
        for k, name in enumerate(self.parameters.squareness):
            gradient[start + k] += by_squareness[SQUARENESS_NAMES.index(name)]
        found = Sums(gradient, by_group[:, 1:], cost=0.5 * square_sum)
        if matrix:
            found.matrix = self._normal(directions, derivatives, of_cells, of_groups, by_group[:, 3])
        return found

    def _normal(
        self,
        directions: FloatArray,
        derivatives: FloatArray,
        of_cells: FloatArray,
        of_groups: FloatArray,
        weights: FloatArray,
    ) -> FloatArray:
        """Normal matrix (size, size) from the sums by cell: first by delta and eps at the nodes, then by the unknowns."""
        from compgen.identification.adjust.path_problem import LOW, PRODUCT

        count, groups = self.first[3], self.groups
        by_nodes, by_group = np.zeros((6 * count) ** 2), np.zeros((6 * count, groups, 4))
        for start in range(0, self.cells, CELLS):
            cells = np.arange(start, min(start + CELLS, self.cells))
            rows, maps = self._cell_maps(cells, directions)  # (c, 36), (c, 36, 10 monomials, 3 of u)
            sums = of_cells[cells][:, ENTRIES[:, :3]][..., PRODUCT]  # (c, 3, 3, 10, 10)
            sums = sums.transpose(0, 3, 1, 4, 2).reshape(len(cells), 3 * LOW, 3 * LOW)
            flat = maps.reshape(len(cells), 36, 3 * LOW)
            blocks = flat @ sums @ flat.swapaxes(1, 2)
            place = rows[:, :, None] * (6 * count) + rows[:, None, :]
            by_nodes += np.bincount(place.ravel(), blocks.ravel(), len(by_nodes))
            for group in range(groups):
                along = of_groups[group, cells][:, ENTRIES, :LOW].transpose(0, 3, 1, 2)  # (c, 10, 3, 4)
                part = flat @ along.reshape(len(cells), 3 * LOW, 4)
                for k in range(4):
                    by_group[:, group, k] += np.bincount(rows.ravel(), part[:, :, k].ravel(), 6 * count)
        motion = self.motion.with_squareness(self.parameters, self.nodes_mm, derivatives).dense
        size = self.parameters.size
        matrix = np.zeros((self.size, self.size))
        matrix[:size, :size] = motion.T @ by_nodes.reshape(6 * count, -1) @ motion
        by_unknowns = np.tensordot(motion, by_group, axes=(0, 0))
        totals = np.column_stack([of_groups[:, :, :, 0].sum(axis=1), weights])
        add_own_blocks(matrix, size, self.station_of, by_unknowns, totals)
        return matrix

    def _cell_maps(self, cells: IntArray, directions: FloatArray) -> tuple[IntArray, FloatArray]:
        """Places (c, 36) of delta and eps at the nodes of cells, and the derivatives by them (c, 36, 10, 3).

        The derivative by delta is u, by eps arm x u; both times the hat function of the node.
        """
        from compgen.identification.adjust.path_problem import LOW, PRODUCT

        index = np.unravel_index(cells, [len(nodes) - 1 for nodes in self.nodes_mm])
        left = np.stack([nodes[k] for nodes, k in zip(self.nodes_mm, index, strict=True)], axis=1)
        step = np.stack([np.diff(nodes)[k] for nodes, k in zip(self.nodes_mm, index, strict=True)], axis=1)
        levers = lever_directions(self.parameters.machine, directions)
        place = (3, 2, 1)  # of the local coordinates of X, Y, Z among the monomials
        rows, maps = np.zeros((len(cells), 36), dtype=np.int64), np.zeros((len(cells), 3, 2, 6, LOW, 3))
        for axis in range(3):
            arm = np.zeros((len(cells), 4, 3))  # constant, and along z, y, x as the monomials are sorted
            arm[:, 0] = self.tool_mm + left @ levers[axis]
            for other in range(3):
                arm[:, place[other]] = step[:, [other]] * levers[axis, other]
            for side in range(2):
                hat = {0: 1.0 - side, place[axis]: 2.0 * side - 1.0}
                at = 6 * (self.first[axis] + index[axis] + side)
                rows[:, 12 * axis + 6 * side : 12 * axis + 6 * side + 6] = at[:, None] + np.arange(6)
                for monomial, factor in hat.items():
                    for k in range(3):
                        n, o = (k + 1) % 3, (k + 2) % 3
                        maps[:, axis, side, k, monomial, k] += factor
                        for linear in range(4):
                            where = PRODUCT[monomial, linear]
                            maps[:, axis, side, 3 + k, where, o] += factor * arm[:, linear, n]
                            maps[:, axis, side, 3 + k, where, n] -= factor * arm[:, linear, o]
        return rows, maps.reshape(len(cells), 36, LOW, 3)


def path_model(parameters: ErrorParameters, tool_mm: FloatArray, station_of: IntArray) -> PathModel | None:
    """Lay out the compiled pass; None for several tools, cubic curves, or too many nodes for the sums."""
    machine = parameters.machine
    if tool_mm.ndim != 1 or machine.curves != "linear":
        return None
    bases = [np.eye(len(axis.nodes_mm)) for axis in machine.axes]
    found = PathModel(parameters, tool_mm, station_of, motion_map(parameters, bases))
    return found if found.cells * (_CELL_SUMS + found.groups * _GROUP_SUMS) <= MOST_SUMS else None


@dataclass(frozen=True)
class PathProblem:
    """n readings in memory, their weights (n,), and stations whose coordinates were also observed."""

    model: PathModel
    readings: Chunk
    weight: FloatArray
    known: KnownPositions | None = None
    _rest: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)

    @property
    def parameters(self) -> ErrorParameters:
        """The unknown errors."""
        return self.model.parameters

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.model.size

    def weighted(self, weight: FloatArray) -> PathProblem:
        """Return the same problem with other weights."""
        return replace(self, weight=np.require(weight, np.float64, ["C"]))

    def _sums(self, state: State, residual: FloatArray, *, matrix: bool) -> Sums:
        return self.model.sums(state, iter([(self.readings, self.weight, residual)]), DistanceNoise(), matrix=matrix)

    def evaluate(self, state: State) -> tuple[float, FloatArray]:
        """Half the weighted sum of squares with the exact model, and its exact gradient (size,)."""
        found = self._sums(state, np.empty(len(self.weight)), matrix=False)
        return found.cost + (self.known.add_gradient(state, found.gradient) if self.known else 0.0), found.gradient

    def normal_matrix(self, state: State) -> FloatArray:
        """J^T W J (size, size) with C instead of the exact derivative."""
        matrix = self._sums(state, np.empty(len(self.weight)), matrix=True).matrix
        assert matrix is not None
        if self.known:
            self.known.add_weight(state, matrix)
        return matrix

    def residuals(self, state: State) -> FloatArray:
        """Model minus reading of every reading, shape (n,), mm."""
        residual = np.empty(len(self.weight))
        self._sums(state, residual, matrix=False)
        return residual

    def distances(self, state: State) -> FloatArray:
        """Distance from the station of every reading, shape (n,), mm."""
        return self.residuals(state) + self.readings.length_mm + state.dead_length_mm[self.readings.group]


def path_problem(
    parameters: ErrorParameters,
    position_mm: FloatArray,
    tool_mm: FloatArray,
    station: IntArray,
    group: IntArray,
    reading_mm: FloatArray,
) -> PathProblem | None:
    """Sort readings for the compiled pass, all weights 1; None if :func:`path_model` has no such form."""
    station_of = np.zeros(int(group.max()) + 1, dtype=np.int64)
    station_of[group] = station
    model = path_model(parameters, tool_mm, station_of)
    if model is None:
        return None
    return PathProblem(model, chunk_of(position_mm.T, station, group, reading_mm), np.ones(len(reading_mm)))


def chunk_of(
    position_mm: FloatArray | tuple[FloatArray, ...],
    station: NDArray[np.integer],
    group: IntArray,
    length_mm: FloatArray,
) -> Chunk:
    """Return readings in the form of the compiled pass: 8-byte numbers, contiguous, positions by axis (3, n)."""
    x, y, z = (np.require(along, np.float64, ["C", "W"]) for along in position_mm)
    whole = [np.require(values, np.int64, ["C", "W"]) for values in (station, group)]
    return Chunk((x, y, z), whole[0], whole[1], np.require(length_mm, np.float64, ["C", "W"]))
