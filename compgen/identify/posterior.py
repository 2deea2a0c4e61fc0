"""What is known of every error after the readings: the prior of the machine file, changed by what the readings show.

Each curve is a zero-mean Gaussian process, in the gauge of all results (zero at the reference point, straightness at both
ends of the travel), each squareness a normal number. With H = J' W J of the readings (their poses, zeros and stations
eliminated), b = J' W y and the prior covariance K = L L' of the state,

    B = I + L' H L,    mean m = L B^-1 L' b,    covariance S = L B^-1 L'
    at other positions x, with F = K_xg K_gg^-1:    mean F m,    covariance F S F' + K_xx - F K_gx

(Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, sections 2.2 and 5.4). Nothing is inverted but B, so
an error that no reading shows keeps its prior exactly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import Axis, Machine
from compgen.data.names import AXES, ERROR_INDEX, ERROR_NAMES, SQUARENESS_NAMES, error_named
from compgen.data.prior import DETERMINED, PriorSettings
from compgen.identify.adjust.determined import Observations
from compgen.identify.adjust.unknowns import ErrorParameters, error_parameters
from compgen.kinematics.first_order import c_matrix

#: Correlation lengths of the smooth and of the rough part, as shares of the travel, and the size of the rough part
#: relative to the smooth one. Any smooth kernel without a rough part is too sure between readings and beyond them.
SMOOTH_LENGTH, ROUGH_LENGTH, ROUGH = 0.3, 0.03, 0.1
#: Levels of an axis for readings at scattered positions, and the most that readings on a grid may have.
SCATTERED, MOST_LEVELS = 31, 60
#: Levels closer than this are one, mm.
SAME_MM = 1e-4
#: Added to the diagonal of a prior covariance, relative to it, against rounding.
JITTER = 1e-9
#: An error is listed if its standard uncertainty is at most this share of its prior, a curve and a squareness: what the
#: readings show less of is as good as unknown, and would put values into tables that hardly any reading supports.
LISTED_CURVE, LISTED_SQUARENESS = 0.75, 0.95
#: Standard deviations of the logarithm of the amplitude: of the machine, of a kind of errors, of one error.
OF_MACHINE, OF_KIND, OF_CURVE = 0.4, 0.3, 0.4
#: Standard deviation of the logarithm of the rough part, and its least size.
OF_ROUGH, LEAST_ROUGH = 0.7, 0.05
#: Steps of the search for the amplitudes.
LEARNING_STEPS = 12
#: Readings whose residuals exceed their noise by this factor get more of it, and everything is adjusted again so often.
TOO_LARGE, PASSES = 1.3, 3
#: rms of what is determined over its prior beyond which a machine is worse than its class: of one curve, of all.
WORSE_CURVE, WORSE_ALL = 2.2, 1.5
#: Factor by which the sizes of a class grow until the machine is no longer worse than it.
RAISE = 3.0


@dataclass(frozen=True)
class Process:
    """Prior of one curve: size ``s`` (mm or rad), ``scale`` per mm, travel and gauge, and the rough part.

    ``zero_mm`` are the positions at which the curve is zero: one for positioning and angles, two for straightness.
    """

    name: str
    s: float
    scale: float
    travel_mm: float
    zero_mm: tuple[float, ...]
    rough: float = ROUGH

    def _kernel(self, x: FloatArray, y: FloatArray) -> FloatArray:
        distance = np.abs(x[:, None] - y[None, :]) / self.travel_mm
        d = np.sqrt(5.0) * distance / SMOOTH_LENGTH
        matern = (1.0 + d + d * d / 3.0) * np.exp(-d)
        return np.asarray(self.s**2 * (matern + self.rough**2 * np.exp(-distance / ROUGH_LENGTH)))

    def _gauge(self, x: FloatArray) -> FloatArray:
        """Weights (m, pins) of the values at the zeros that the gauge takes off at positions (m,)."""
        if len(self.zero_mm) == 1:
            return np.ones((len(x), 1))
        low, high = self.zero_mm
        share = (x - low) / (high - low)
        return np.column_stack([1.0 - share, share])

    def covariance(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Prior covariance of the curve between positions (m,) and (n,), shape (m, n)."""
        pins = np.array(self.zero_mm)
        of_x, of_y = self._gauge(x), self._gauge(y)
        found = self._kernel(x, y) - self._kernel(x, pins) @ of_y.T - of_x @ self._kernel(pins, y)
        found += of_x @ self._kernel(pins, pins) @ of_y.T
        if self.scale:
            found += self.scale**2 * (x - pins[0])[:, None] * (y - pins[0])[None, :]
        return np.asarray(found)

    def sd(self, x: FloatArray) -> FloatArray:
        """Prior standard deviation at positions (m,)."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance(x, x)), 0.0)))


def processes_of(machine: Machine, prior: PriorSettings, names: Sequence[str]) -> dict[str, Process]:
    """Return the priors of the curves among the errors ``names`` of a machine."""
    found = {}
    for name in names:
        if name in SQUARENESS_NAMES:
            continue
        error = error_named(name)
        axis = machine.axes[error.axis]
        zero = axis.range_mm if error.is_straightness else (machine.reference_point_mm[error.axis],)
        found[name] = Process(name, prior.size(name), prior.scale(name), axis.length_mm, tuple(zero))
    return found


# --- the state ------------------------------------------------------------------------------------------------------


def state_layout(machine: Machine, levels_mm: Sequence[FloatArray], names: Sequence[str]) -> ErrorParameters:
    """Return the unknowns with nodes at the given levels, the nodes of the machine, the ends and the reference point."""
    axes = []
    for k, axis in enumerate(machine.axes):
        along = np.concatenate([axis.nodes_mm, levels_mm[k]])
        along = along[(along > axis.range_mm[0] + SAME_MM) & (along < axis.range_mm[1] - SAME_MM)]
        nodes = np.array([*axis.range_mm, machine.reference_point_mm[k]])
        far = np.abs(along[:, None] - nodes[None, :]).min(axis=1) > SAME_MM
        nodes = np.unique(np.concatenate([nodes, along[far]]))
        nodes = nodes[np.concatenate([[True], np.diff(nodes) > SAME_MM])]
        nodes[-1] = axis.range_mm[1]
        axes.append(replace(axis, nodes_mm=nodes))
    finer = replace(machine, axes=(axes[0], axes[1], axes[2]), curves="linear")
    return error_parameters(finer, names)


def reading_levels(axis: Axis, position_mm: FloatArray) -> FloatArray:
    """Return the levels of an axis at which readings determine its curves: their own, or a grid for scattered ones."""
    levels = np.unique(np.round(position_mm[np.isfinite(position_mm)], 4))
    if len(levels) + len(axis.nodes_mm) <= MOST_LEVELS:
        return levels
    return np.linspace(*axis.range_mm, SCATTERED)


@dataclass(frozen=True)
class Information:
    """What readings say about the state: ``matrix`` H (p, p), ``vector`` b (p,), and their weighted sum of squares.

    ``freedom`` is the number of readings minus that of their own unknowns.
    """

    matrix: FloatArray
    vector: FloatArray
    square_sum: float
    freedom: int

    @classmethod
    def of(cls, readings: Observations) -> Information:
        """Eliminate the own unknowns of readings."""
        design, value = readings.design / readings.sigma[:, None], readings.value / readings.sigma
        others = readings.others / readings.sigma[:, None]
        size = np.linalg.norm(others, axis=0)
        others = others[:, size > 0] / size[size > 0]
        matrix, vector, total = design.T @ design, design.T @ value, float(value @ value)
        rank = 0
        if others.shape[1]:
            values, directions = np.linalg.eigh(others.T @ others)
            used = values > 1e-12 * values[-1]
            rank = int(np.count_nonzero(used))
            basis = directions[:, used] / np.sqrt(values[used])
            of_design, of_value = basis.T @ (others.T @ design), basis.T @ (others.T @ value)
            matrix, vector = matrix - of_design.T @ of_design, vector - of_design.T @ of_value
            total -= float(of_value @ of_value)
        return cls(0.5 * (matrix + matrix.T), vector, max(total, 0.0), len(value) - rank)

    def scaled(self, factor: float) -> Information:
        """Return the information of readings whose noise is larger by a factor."""
        square = 1.0 / factor**2
        return Information(self.matrix * square, self.vector * square, self.square_sum * square, self.freedom)


@dataclass(frozen=True)
class _Solved:
    """Mean and covariance factor of the state, and what learning needs."""

    mean: FloatArray
    factor: FloatArray
    root: FloatArray
    half: FloatArray
    evidence: float


def _solve(layout: ErrorParameters, processes: Mapping[str, Process], sizes: FloatArray, known: Information) -> _Solved:
    """The posterior of the state; ``sizes`` are the standard deviations of the squareness errors."""
    root = np.zeros((layout.size, layout.size))
    for curve in layout.curves:
        at = _state_positions(curve.free, curve.nodes_mm)
        block = processes[curve.error.name].covariance(at, at)
        block[np.diag_indices(len(at))] *= 1.0 + JITTER
        root[curve.columns, curve.columns] = np.linalg.cholesky(block)
    first = layout.size - len(layout.squareness)
    root[np.arange(first, layout.size), np.arange(first, layout.size)] = sizes
    inner = root.T @ known.matrix @ root
    inner[np.diag_indices(layout.size)] += 1.0
    half = np.linalg.cholesky(0.5 * (inner + inner.T))
    factor = np.linalg.solve(half, root.T).T
    mean = factor @ (factor.T @ known.vector)
    evidence = -float(np.log(np.diag(half)).sum()) + 0.5 * float(known.vector @ mean)
    return _Solved(mean, factor, root, half, evidence)


def _state_positions(free: FloatArray, nodes_mm: FloatArray) -> FloatArray:
    """Positions of the unknown values of a curve whose fixed nodes are dropped."""
    return np.asarray(nodes_mm[free.argmax(axis=0)])


@dataclass(frozen=True)
class FieldSpread:
    """What is not known of E over points: ``factor`` (n, 3, r) of the part that the state resolves, and what it does not.

    ``between`` are, for each curve, the rows (points) of a factor of the variation between the levels of the state, and
    the columns of C that carry it.
    """

    factor: FloatArray
    between: tuple[tuple[FloatArray, FloatArray], ...]

    @property
    def variance(self) -> FloatArray:
        """Variance of each component, (n, 3), mm^2."""
        total = np.einsum("nij,nij->ni", self.factor, self.factor)
        for column, rows in self.between:
            total = total + column**2 * np.einsum("nr,nr->n", rows, rows)[:, None]
        return np.asarray(total)

    def draws(self, count: int, seed: int) -> FloatArray:
        """Return joint deviations of E from its mean, (count, n, 3), mm."""
        random = np.random.default_rng(seed)
        n, _, r = self.factor.shape
        flat = self.factor.reshape(3 * n, r) @ random.standard_normal((r, count))
        found = flat.T.reshape(count, n, 3)
        for column, rows in self.between:
            values = random.standard_normal((count, rows.shape[1])) @ rows.T
            found = found + values[:, :, None] * column[None]
        return np.asarray(found)


@dataclass(frozen=True)
class Posterior:
    """All errors of a machine after the readings: joint mean and covariance, at any position.

    Parameters
    ----------
    machine : with the levels of the state as nodes.
    prior : the sizes in use, with what the readings raised.
    processes : the prior of each curve, with its learnt size.
    names : the errors, curves and squareness, in the order of the state.
    mean, factor : of the state (p,), (p, r): the covariance is factor factor'; mm and rad.
    spans_mm : lowest and highest position of the readings that show the curves of each axis; nan if there are none.
    worse : errors that are larger than their class lets expect, with the ratio.
    """

    machine: Machine
    prior: PriorSettings
    processes: Mapping[str, Process]
    squareness_sd: Mapping[str, float]
    names: tuple[str, ...]
    mean: FloatArray
    factor: FloatArray
    spans_mm: FloatArray
    worse: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def layout(self) -> ErrorParameters:
        """The unknowns of the state."""
        return error_parameters(self.machine, self.names)

    def rows(self, name: str, position_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return F (m, columns of the curve) and what is left of the prior (m, m), at positions of one curve."""
        curve = next(item for item in self.layout.curves if item.error.name == name)
        at = _state_positions(curve.free, curve.nodes_mm)
        process = self.processes[name]
        inner, across = process.covariance(at, at), process.covariance(position_mm, at)
        inner[np.diag_indices(len(at))] *= 1.0 + JITTER
        weights = np.linalg.solve(inner, across.T).T
        return weights, process.covariance(position_mm, position_mm) - weights @ across.T

    def curve(self, name: str, position_mm: FloatArray) -> Curve:
        """Return mean and standard uncertainty of an error at positions (m,); of a squareness at one position."""
        columns = dict(self.layout.columns())[name]
        if name in SQUARENESS_NAMES:
            u = np.linalg.norm(self.factor[columns], axis=1)
            return Curve(np.zeros(1), self.mean[columns], u)
        position_mm = np.asarray(position_mm, dtype=np.float64)
        weights, left = self.rows(name, position_mm)
        square = np.einsum("ij,ij->i", *(2 * [weights @ self.factor[columns]])) + np.maximum(np.diag(left), 0.0)
        return Curve(position_mm, weights @ self.mean[columns], np.sqrt(square))

    def values_factor(self, names: Sequence[str], position_mm: Sequence[FloatArray]) -> FloatArray:
        """Return a factor of the joint covariance of errors at positions, their rows one after another."""
        columns, rows, apart = dict(self.layout.columns()), [], []
        for name, at in zip(names, position_mm, strict=True):
            if name in SQUARENESS_NAMES:
                rows.append(self.factor[columns[name]])
                apart.append(np.zeros((1, 0)))
                continue
            weights, left = self.rows(name, at)
            rows.append(weights @ self.factor[columns[name]])
            apart.append(root_of(left))
        wide = sum(item.shape[1] for item in apart)
        block, row, column = np.zeros((sum(map(len, rows)), wide)), 0, 0
        for item in apart:
            block[row : row + len(item), column : column + item.shape[1]] = item
            row, column = row + len(item), column + item.shape[1]
        return np.hstack([np.vstack(rows), block])

    @cached_property
    def shares(self) -> dict[str, float]:
        """Standard uncertainty of each error over that of its prior, rms along the travel: 1 if nothing shows it."""
        found = {}
        for name in self.names:
            if name in SQUARENESS_NAMES:
                found[name] = float(self.curve(name, np.zeros(1)).u[0]) / self.squareness_sd[name]
                continue
            at = np.linspace(*self.machine.axes[error_named(name).axis].range_mm, SCATTERED)
            own = self.curve(name, at).u
            found[name] = float(np.sqrt(np.mean(own**2) / np.mean(self.processes[name].sd(at) ** 2)))
        return found

    @property
    def determined(self) -> tuple[str, ...]:
        """Names of the errors of which the readings leave at most a third of the prior uncertainty."""
        return tuple(name for name in self.names if self.shares[name] <= DETERMINED)

    @property
    def shown(self) -> tuple[str, ...]:
        """Names of the errors that are listed: the readings show them."""
        least = {name: LISTED_SQUARENESS if name in SQUARENESS_NAMES else LISTED_CURVE for name in self.names}
        return tuple(name for name in self.names if self.shares[name] <= least[name])

    def field(self, position_mm: FloatArray, tool_mm: FloatArray | None = None) -> FieldSpread:
        """Return what is not known of E = C P at points (n, 3) with tool offsets (n, 3), (3,) or that of the machine."""
        matrix = c_matrix(self.machine, position_mm, tool_mm)
        spread = np.zeros((len(position_mm), 3, self.factor.shape[1]))
        between: list[tuple[FloatArray, FloatArray]] = []
        for name, columns in self.layout.columns():
            column = matrix[:, :, ERROR_INDEX[name]]
            if name in SQUARENESS_NAMES:
                rows = np.broadcast_to(self.factor[columns], (len(position_mm), self.factor.shape[1]))
            else:
                levels, of = np.unique(position_mm[:, error_named(name).axis], return_inverse=True)
                weights, left = self.rows(name, levels)
                rows = (weights @ self.factor[columns])[of.ravel()]
                between.append((column, root_of(left)[of.ravel()]))
            for output in np.flatnonzero(column.any(axis=0)):
                spread[:, output] += column[:, output, None] * rows
        between += self._other_tools(matrix, position_mm)
        return FieldSpread(spread, tuple(between))

    def _other_tools(self, matrix: FloatArray, position_mm: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Errors that one tool cannot show, for the part of the lever by which a tool differs from that of the machine."""
        more = matrix - c_matrix(self.machine, position_mm)
        names = [n for n in ERROR_NAMES if n not in self.names and np.abs(more[:, :, ERROR_INDEX[n]]).max() > 1e-6]
        processes = processes_of(self.machine, self.prior, names)
        found = []
        for name, process in processes.items():
            levels, of = np.unique(position_mm[:, error_named(name).axis], return_inverse=True)
            found.append((more[:, :, ERROR_INDEX[name]], root_of(process.covariance(levels, levels))[of.ravel()]))
        return found

    def mean_table(self, names: Sequence[str]) -> ErrorTable:
        """Return the means of errors at the levels of the state."""
        curves, squareness = {}, {}
        for name in names:
            if name in SQUARENESS_NAMES:
                found = self.curve(name, np.zeros(1))
                squareness[name] = (float(found.value[0]), float(found.u[0]))
            else:
                curves[name] = self.curve(name, self.machine.axes[error_named(name).axis].nodes_mm)
        return ErrorTable(curves, squareness, {})


def root_of(covariance: FloatArray) -> FloatArray:
    """A factor of a covariance that may be singular; columns of rounding errors are left out."""
    values, directions = np.linalg.eigh(0.5 * (covariance + covariance.T))
    used = values > 1e-10 * max(float(values[-1]), 1e-300)
    return np.asarray(directions[:, used] * np.sqrt(values[used]))


# --- sizes that the readings change ---------------------------------------------------------------------------------


_KINDS = ("positioning", "straightness", "angular", "squareness")


def _kind_of(name: str) -> str:
    error = error_named(name)
    if error.kind == "linear":
        return "straightness" if error.is_straightness else "positioning"
    return error.kind


def _hyperprior(names: Sequence[str]) -> FloatArray:
    """Covariance of the logarithms of the amplitudes of errors."""
    kind = np.array([_kind_of(name) for name in names])
    same: FloatArray = (kind[:, None] == kind[None, :]).astype(np.float64)
    return OF_MACHINE**2 + OF_KIND**2 * same + OF_CURVE**2 * np.eye(len(names))


def _learnt(
    layout: ErrorParameters, prior: PriorSettings, processes: dict[str, Process], sizes: FloatArray, known: Information
) -> tuple[dict[str, Process], FloatArray]:
    """Processes and squareness sizes with the amplitudes that the readings make likely, and what remains open about them.

    The maximum of marginal likelihood times hyperprior over the logarithm of each amplitude; amplitudes only grow unless
    ``learn`` is "both". The variance of what is not known of an amplitude widens its error (``exp(2 v)``).
    """
    names = [name for name, _ in layout.columns()]
    columns = [span for _, span in layout.columns()]
    precision = np.linalg.inv(_hyperprior(names))
    low = -np.inf if prior.learn == "both" else 0.0
    log_size = np.zeros(len(names))

    def grown(at: FloatArray) -> tuple[dict[str, Process], FloatArray]:
        factor = dict(zip(names, np.exp(at).tolist(), strict=True))
        larger = {
            name: replace(item, s=item.s * factor[name], scale=item.scale * factor[name])
            for name, item in processes.items()
        }
        return larger, sizes * np.array([factor[name] for name in layout.squareness])

    def value_and_gradient(at: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        solved = _solve(layout, *grown(at), known)
        rest = known.vector - known.matrix @ solved.mean
        # Q = H - H S H, with K Q by blocks: tr(Q K_i) = tr over the block of H K - H S H K
        reduced = known.matrix @ solved.factor
        quadratic = known.matrix - reduced @ reduced.T
        gradient, scaled = np.empty(len(names)), []
        for k, span in enumerate(columns):
            root = solved.root[span, span]
            pulled = root.T @ rest[span]
            inner = root.T @ quadratic[span, span] @ root
            gradient[k] = float(pulled @ pulled) - float(np.trace(inner))
            scaled.append(root)
        whole = solved.root.T @ quadratic @ solved.root
        starts = np.array([span.start for span in columns])
        fisher = np.add.reduceat(np.add.reduceat(whole**2, starts, axis=0), starts, axis=1) * 2.0
        return solved.evidence - 0.5 * float(at @ precision @ at), gradient - precision @ at, fisher

    value, gradient, fisher = value_and_gradient(log_size)
    for _ in range(LEARNING_STEPS):
        free = (log_size > low + 1e-9) | (gradient > 0)
        if not free.any() or np.abs(gradient[free]).max() < 0.05:
            break
        step = np.zeros(len(names))
        step[free] = np.linalg.solve((fisher + precision)[np.ix_(free, free)], gradient[free])
        size = float(np.abs(step).max())
        step *= min(1.0, 1.0 / size)
        for _ in range(4):  # a step that makes it less likely is halved
            trial = np.maximum(log_size + step, low)
            found = value_and_gradient(trial)
            if found[0] >= value - 1e-6:
                break
            step *= 0.5
        else:
            break
        done = found[0] - value < 0.01
        log_size, (value, gradient, fisher) = trial, found
        if done:
            break
    open_variance = np.diag(np.linalg.inv(fisher + precision))
    return grown(log_size + open_variance)  # exp(2 v) in variance


# --- the posterior of readings --------------------------------------------------------------------------------------


def solve_posterior(
    machine: Machine,
    layout: ErrorParameters,
    information: Sequence[Information],
    spans_mm: FloatArray,
    *,
    learn: bool,
) -> Posterior:
    """Return the posterior of the state of a layout (:func:`state_layout`) from the information of several sources.

    Sources whose residuals exceed their noise get more of it; a machine that is worse than its class gets larger sizes,
    and ``worse`` says so. With ``learn`` the readings change the size of each error (unless the machine file says no).
    """
    names = tuple(name for name, _ in layout.columns())
    prior, parts = machine.prior, list(information)
    worse: dict[str, float] = {}
    for _ in range(PASSES + 6):
        processes = processes_of(machine, prior, names)
        sizes = np.array([prior.size(name) for name in layout.squareness])
        known = _sum(parts, layout.size)
        solved = _solve(layout, processes, sizes, known)
        found = _posterior(machine, layout, prior, processes, sizes, solved, spans_mm)
        larger, ratios = _beyond_class(found)
        if larger != (1.0, 1.0) and max(prior.factor) < 1e4:
            worse = {**ratios, **worse}
            prior = prior.raised(*larger)
            continue
        noisier = [_excess(item, solved) for item in parts]
        if max(noisier, default=1.0) <= TOO_LARGE:
            break
        parts = [
            item.scaled(factor) if factor > TOO_LARGE else item for item, factor in zip(parts, noisier, strict=True)
        ]
    if learn and prior.learn != "no" and parts:
        processes, sizes = _learnt(layout, prior, processes, sizes, known)
        solved = _solve(layout, processes, sizes, known)
        found = _posterior(machine, layout, prior, processes, sizes, solved, spans_mm)
    return replace(found, worse=worse)


def with_information(found: Posterior, information: Sequence[Information]) -> Posterior:
    """Return the posterior from other readings, with the same prior as one that was found."""
    sizes = np.array([found.squareness_sd[name] for name in found.layout.squareness])
    known = _sum(information, found.layout.size)
    solved = _solve(found.layout, found.processes, sizes, known)
    return replace(found, mean=solved.mean, factor=solved.factor)


def _sum(parts: Sequence[Information], size: int) -> Information:
    return Information(
        sum((item.matrix for item in parts), np.zeros((size, size))),
        sum((item.vector for item in parts), np.zeros(size)),
        sum(item.square_sum for item in parts),
        sum(item.freedom for item in parts),
    )


def _excess(item: Information, solved: _Solved) -> float:
    """Root of the reduced chi-square of one source about the mean."""
    left = item.square_sum - 2.0 * float(solved.mean @ item.vector) + float(solved.mean @ item.matrix @ solved.mean)
    shown = item.matrix @ solved.factor
    effective = item.freedom - float(np.einsum("ij,ij->", shown, solved.factor))
    return float(np.sqrt(max(left, 0.0) / max(effective, 1.0)))


def _posterior(
    machine: Machine,
    layout: ErrorParameters,
    prior: PriorSettings,
    processes: Mapping[str, Process],
    sizes: FloatArray,
    solved: _Solved,
    spans_mm: FloatArray,
) -> Posterior:
    return Posterior(
        layout.machine,
        prior,
        dict(processes),
        dict(zip(layout.squareness, sizes.tolist(), strict=True)),
        tuple(name for name, _ in layout.columns()),
        solved.mean,
        solved.factor,
        spans_mm,
    )


def _beyond_class(found: Posterior) -> tuple[tuple[float, float], dict[str, float]]:
    """Factors by which the sizes of curves and squareness are too small, 1 or RAISE, and the ratios that show it.

    Only determined errors count. The scale of an axis is part of its prior.
    """
    ratios: dict[str, float] = {}
    for name in found.determined:
        if name in SQUARENESS_NAMES:
            ratios[name] = abs(float(found.curve(name, np.zeros(1)).value[0])) / found.squareness_sd[name]
            continue
        at = np.linspace(*found.machine.axes[error_named(name).axis].range_mm, SCATTERED)
        of_prior = float(np.sqrt(np.mean(found.processes[name].sd(at) ** 2)))
        ratios[name] = float(np.sqrt(np.mean(found.curve(name, at).value ** 2))) / of_prior
    factors = []
    beyond: dict[str, float] = {}
    for is_squareness in (False, True):
        own = {name: value for name, value in ratios.items() if (name in SQUARENESS_NAMES) == is_squareness}
        together = float(np.sqrt(np.mean(np.square(list(own.values()))))) if len(own) > 1 else 0.0
        over = {name: value for name, value in own.items() if value > WORSE_CURVE}
        if together > WORSE_ALL and not over:
            over = {name: value for name, value in own.items() if value > WORSE_ALL}
        beyond |= over
        factors.append(RAISE if over else 1.0)
    return (factors[0], factors[1]), beyond


# --- words ----------------------------------------------------------------------------------------------------------


def assumed_text(found: Posterior) -> str:
    """Return one sentence on what is assumed of the errors that no reading determines."""
    sizes: dict[str, tuple[float, str]] = {}
    words = {
        "positioning": "positioning",
        "straightness": "straightness",
        "angular": "angles",
        "squareness": "squareness",
    }
    for name in found.names:
        if name not in found.determined:
            kind, unit = words[_kind_of(name)], error_named(name).unit
            sizes[kind] = max(sizes.get(kind, (0.0, unit)), (2.0 * found.prior.size_um(name), unit))
    which = f"class {found.prior.stated_class}" + ("" if found.prior.class_name else " (the machine file states none)")
    if not sizes:
        return f"every error was measured; between the readings the prior of {which} holds"
    parts = [f"{kind} up to {size:.3g} {unit}" for kind, (size, unit) in sizes.items()]
    return f"assumed for what was not measured: {', '.join(parts)} (k = 2, {which})"


def worse_text(found: Posterior) -> str:
    """Return a sentence if the machine is worse than its class, else nothing."""
    if not found.worse:
        return ""
    listed = ", ".join(
        f"{name} ({ratio:.1f} times)" for name, ratio in sorted(found.worse.items(), key=lambda x: -x[1])[:4]
    )
    more = f" and {len(found.worse) - 4} more" if len(found.worse) > 4 else ""
    raised = [
        f"{what} by {factor:.3g}"
        for what, factor in zip(("curves", "squareness"), found.prior.factor, strict=True)
        if factor > 1.0
    ]
    return (
        f"the machine is worse than its class {found.prior.stated_class!r}: {listed}{more} of what the class lets expect; "
        f"assumed sizes are raised ({', '.join(raised)}). State class or sizes in [prior] of the machine file"
    )


def spans_of(observations: Sequence[Observations]) -> FloatArray:
    """Return the lowest and highest position of the readings on each axis (3, 2), nan where there are none."""
    spans = np.full((len(AXES), 2), np.nan)
    for item in observations:
        for axis in range(len(AXES)):
            along = item.at_mm[:, axis]
            along = along[np.isfinite(along)]
            if len(along):
                spans[axis, 0] = np.fmin(spans[axis, 0], along.min())
                spans[axis, 1] = np.fmax(spans[axis, 1], along.max())
    return spans
