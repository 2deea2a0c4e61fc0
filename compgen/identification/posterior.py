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

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ARMS, Curve, ErrorTable
from compgen.data.machine import Axis, Machine
from compgen.data.names import AXES, ERROR_INDEX, ERROR_NAMES, MM_PER_UM, SQUARENESS_NAMES, error_named
from compgen.data.prior import DETERMINED, PriorSettings
from compgen.errors import InputError, Message
from compgen.identification.adjust.determined import LEVER_MM, Observations
from compgen.identification.adjust.unknowns import ErrorParameters, error_parameters, state_names
from compgen.kinematics.first_order import c_matrix
from compgen.kinematics.many_points import full_grid

#: Correlation lengths of the smooth and of the rough part, as shares of the travel, and the size of the rough part
#: relative to the smooth one. Any smooth kernel without a rough part is too sure between readings and beyond them.
SMOOTH_LENGTH, ROUGH_LENGTH, ROUGH = 0.3, 0.03, 0.1
#: Levels of an axis for readings at scattered positions, and the most that readings on a grid may have.
SCATTERED, MOST_LEVELS = 31, 60
#: An error of this size, mm at a lever of a metre, that the readings would not notice is not shown by them.
NOTHING_MM = 1.0
#: Levels closer than this are one, mm; levels of readings, as a share of the travel.
SAME_MM, CLOSE = 1e-4, 1e-3
#: Ends of a travel that differ by more than this belong to another machine, mm.
OTHER_TRAVEL_MM = 20.0
#: Added to the diagonal of a prior covariance, relative to it, against rounding.
JITTER = 1e-9
#: An error is listed if its standard uncertainty is at most this share of its prior, a curve and a squareness: what the
#: readings show less of is as good as unknown, and would put values into tables that hardly any reading supports.
LISTED_CURVE, LISTED_SQUARENESS = 0.75, 0.95
#: Standard deviations of the logarithm of the amplitude: of the machine, of a kind of errors, of one error.
OF_MACHINE, OF_KIND, OF_CURVE = 0.4, 0.3, 0.4
#: Standard deviations of the logarithm of the size of the rough part, of a machine and of one curve about it; the factors
#: that are tried, and the fewest levels of a curve that say something about it.
OF_ROUGH, OF_ROUGH_CURVE, ROUGH_STEPS, FEW_LEVELS = 0.7, 0.4, 2.0 ** np.arange(-1.0, 5.5, 0.5), 5
#: Steps of the search for the amplitudes, and the gain of the logarithm of the likelihood that ends it.
LEARNING_STEPS, ENOUGH_LEARNT = 12, 0.05
#: Readings whose residuals exceed their noise by this factor get more of it, and everything is adjusted again so often;
#: fewer degrees of freedom than this say nothing about their noise.
TOO_LARGE, PASSES, FEW_FREE = 1.3, 3, 10
#: rms of what is determined over its prior beyond which a machine is worse than its class: of one curve, of all.
WORSE_CURVE, WORSE_ALL = 2.2, 1.5
#: The size of a slope that was measured, over the slope found: nothing is assumed about it.
FLAT = 10.0
#: Factor by which the sizes of a class grow until the machine is no longer worse than it.
RAISE = 3.0
#: Pitch of a screw that the machine file does not state, mm.
USUAL_PITCH_MM = 10.0
#: Places of a square over which its mean is taken, where nobody said where it stood.
_PLACES = 100


@dataclass(frozen=True)
class Process:
    """Prior of one curve: size ``s`` (mm or rad), ``scale`` per mm, travel and gauge, and the rough part.

    ``zero_mm`` are the positions at which the curve is zero: one for positioning and angles, two for straightness.
    ``slope`` per mm is that of a slope that was measured: about its size nothing is assumed, so that a curve is drawn
    straight between two readings however steep it is; ``sd`` leaves it out. ``cyclic`` (mm) is a sine over ``pitch_mm`` of
    any phase: readings determine it where they are, and say nothing of it a quarter of a turn beside.
    """

    name: str
    s: float
    scale: float
    travel_mm: float
    zero_mm: tuple[float, ...]
    rough: float = ROUGH
    slope: float = 0.0
    cyclic: float = 0.0
    pitch_mm: float = USUAL_PITCH_MM

    def _kernel(self, x: FloatArray, y: FloatArray) -> FloatArray:
        apart_mm = np.abs(x[:, None] - y[None, :])
        distance = apart_mm / self.travel_mm
        d = np.sqrt(5.0) * distance / SMOOTH_LENGTH
        matern = (1.0 + d + d * d / 3.0) * np.exp(-d)
        found = self.s**2 * (matern + self.rough**2 * np.exp(-distance / ROUGH_LENGTH))
        if self.cyclic:
            # curved at zero as cos(2 pi d / pitch) is, and forgotten after a turn: the phase drifts along a screw
            found += self.cyclic**2 * np.exp(-0.5 * (2.0 * np.pi * apart_mm / self.pitch_mm) ** 2)
        return np.asarray(found)

    def _gauge(self, x: FloatArray) -> FloatArray:
        """Weights (m, pins) of the values at the zeros that the gauge takes off at positions (m,)."""
        if len(self.zero_mm) == 1:
            return np.ones((len(x), 1))
        low, high = self.zero_mm
        share = (x - low) / (high - low)
        return np.column_stack([1.0 - share, share])

    def covariance(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Prior covariance of the curve between positions (m,) and (n,), shape (m, n)."""
        steep = self.slope**2 + self.scale**2
        pins = np.array(self.zero_mm)
        of_x, of_y = self._gauge(x), self._gauge(y)
        found = self._kernel(x, y) - self._kernel(x, pins) @ of_y.T - of_x @ self._kernel(pins, y)
        found += of_x @ self._kernel(pins, pins) @ of_y.T
        if steep:
            found += steep * (x - pins[0])[:, None] * (y - pins[0])[None, :]
        return np.asarray(found)

    def sd(self, x: FloatArray) -> FloatArray:
        """Prior standard deviation at positions (m,)."""
        own = replace(self, slope=0.0).covariance(x, x)
        return np.asarray(np.sqrt(np.maximum(np.diag(own), 0.0)))


def processes_of(machine: Machine, prior: PriorSettings, names: Sequence[str]) -> dict[str, Process]:
    """Return the priors of the curves among the errors ``names`` of a machine."""
    found = {}
    for name in names:
        if name in SQUARENESS_NAMES:
            continue
        error = error_named(name)
        axis = machine.axes[error.axis]
        zero = axis.range_mm if error.is_straightness else (machine.reference_point_mm[error.axis],)
        found[name] = Process(
            name,
            prior.size(name),
            prior.scale(name),
            axis.length_mm,
            tuple(zero),
            cyclic=prior.cyclic_sd(name),
            pitch_mm=axis.screw_pitch_mm or USUAL_PITCH_MM,
        )
    return found


def square_sd(machine: Machine, name: str, spans_mm: tuple[float, float]) -> float:
    """Standard deviation, rad, of what a square of the given arms reads beside the squareness ``name`` of the whole travel.

    The arms are shorter than the travel and stand anywhere: bent guides tilt them, and angles that change along an arm act with
    the distance from the reference lines. The mean over places of the prior variance; arms longer than the travel end with it.
    """
    if machine.prior.is_none:
        return 0.0
    pair = [error_named(curve) for curve in ARMS[name]]
    axes = [error.axis for error in pair]
    lower, upper = machine.lower_mm, machine.upper_mm
    span = np.minimum(spans_mm, (upper - lower)[axes])
    highest = upper.copy()
    highest[axes] -= span
    points = np.repeat(np.random.default_rng(0).uniform(lower, highest, (_PLACES, 3))[:, None], 3, axis=1)
    weight = np.zeros(
        (3, 3)
    )  # of the corner and the two ends by component: the sum of both slopes, a turn of the whole is out
    for k, error in enumerate(pair):
        points[:, k + 1, error.axis] += span[k]
        weight[[0, k + 1], error.direction] += np.array([-1.0, 1.0]) / span[k]
    matrix = c_matrix(machine, points.reshape(-1, 3)).reshape(_PLACES, 3, 3, -1)
    shown = np.einsum("po,lpon->nlp", weight, matrix)
    variance = 0.0
    for curve, process in processes_of(machine, machine.prior, ERROR_NAMES).items():
        at, own = points[:, :, error_named(curve).axis], shown[ERROR_INDEX[curve]]
        covariance = process.covariance(at.ravel(), at.ravel()).reshape(_PLACES, 3, _PLACES, 3)
        variance += float(np.einsum("lp,lplq,lq->", own, covariance, own)) / _PLACES
    return float(np.sqrt(max(variance, 0.0)))


# --- the state ------------------------------------------------------------------------------------------------------


def state_layout(machine: Machine, levels_mm: Sequence[FloatArray], names: Sequence[str]) -> ErrorParameters:
    """Return the unknowns with nodes at the given levels, the nodes of the machine, the ends and the reference point."""
    axes = []
    for k, axis in enumerate(machine.axes):
        few = np.unique(
            np.linspace(0, len(axis.nodes_mm) - 1, min(len(axis.nodes_mm), MOST_LEVELS)).round().astype(int)
        )
        along = np.concatenate([axis.nodes_mm[few], levels_mm[k]])
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
    """Return the levels of an axis at which readings determine its curves: their own, or a grid for scattered ones.

    Readings of a plate that lies a little askew share their levels: what a curve does from one ball of a row to the next
    is noise, and was taken for a rough curve.
    """
    closest, own = CLOSE * axis.length_mm, list[float]()
    for level in np.unique(np.round(position_mm[np.isfinite(position_mm)], 4)).tolist():
        if not own or level - own[-1] > closest:
            own.append(level)
    levels = np.array(own)
    apart = np.abs(levels[:, None] - axis.nodes_mm).min(axis=1, initial=np.inf)
    levels = np.asarray(levels[(apart <= SAME_MM) | (apart > closest)])
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
    evidence: float


def _solve(layout: ErrorParameters, processes: Mapping[str, Process], sizes: FloatArray, known: Information) -> _Solved:
    """The posterior of the state; ``sizes`` are the standard deviations of the squareness errors.

    Errors that no reading shows are independent of all others, so they keep the root of their prior.
    """
    root = np.zeros((layout.size, layout.size))
    for curve in layout.curves:
        at = _state_positions(curve.free, curve.nodes_mm)
        block = processes[curve.error.name].covariance(at, at)
        block[np.diag_indices(len(at))] *= 1.0 + JITTER
        root[curve.columns, curve.columns] = np.linalg.cholesky(block)
    first = layout.size - len(layout.squareness)
    root[np.arange(first, layout.size), np.arange(first, layout.size)] = sizes
    seen = _seen(layout, known)
    own = root[np.ix_(seen, seen)]
    inner = own.T @ known.matrix[np.ix_(seen, seen)] @ own
    inner[np.diag_indices(len(inner))] += 1.0
    half = np.linalg.cholesky(0.5 * (inner + inner.T))
    shown = np.linalg.solve(half, own.T).T
    factor, mean = root.copy(), np.zeros(layout.size)
    factor[np.ix_(seen, seen)] = shown
    mean[seen] = shown @ (shown.T @ known.vector[seen])
    evidence = -float(np.log(np.diag(half)).sum()) + 0.5 * float(known.vector[seen] @ mean[seen])
    return _Solved(mean, factor, root, evidence)


def _seen(layout: ErrorParameters, known: Information) -> NDArray[np.bool_]:
    """Which unknowns belong to errors that some reading shows, (size,)."""
    seen, strength = np.zeros(layout.size, dtype=bool), np.diag(known.matrix)
    for name, columns in layout.columns():
        size = 1.0 if error_named(name).kind == "linear" else 1.0 / LEVER_MM
        seen[columns] = bool((strength[columns] * (size * NOTHING_MM) ** 2).max(initial=0.0) > 1.0)
    return seen


def _state_positions(free: FloatArray, nodes_mm: FloatArray) -> FloatArray:
    """Positions of the unknown values of a curve whose fixed nodes are dropped."""
    return np.asarray(nodes_mm[free.argmax(axis=0)])


@dataclass(frozen=True)
class _Between:
    """Variation of one curve between the levels of the state: ``column`` (n, 3) of C, ``level`` (n,) of each point.

    ``left`` (m, m) is the covariance at the levels of the points.
    """

    column: FloatArray
    level: NDArray[np.int64]
    left: FloatArray


@dataclass(frozen=True)
class FieldSpread:
    """What is not known of E over n points: ``factor`` (n, 3, r) of what the state resolves, and what is between its levels."""

    factor: FloatArray
    between: tuple[_Between, ...]

    @property
    def variance(self) -> FloatArray:
        """Variance of each component, (n, 3), mm^2."""
        total = np.einsum("nij,nij->ni", self.factor, self.factor)
        for item in self.between:
            total = total + item.column**2 * np.maximum(np.diag(item.left), 0.0)[item.level, None]
        return np.asarray(total)

    def draws(self, count: int, seed: int) -> FloatArray:
        """Return joint deviations of E from its mean, (count, n, 3), mm."""
        random = np.random.default_rng(seed)
        n, _, r = self.factor.shape
        found = (self.factor.reshape(3 * n, r) @ random.standard_normal((r, count))).T.reshape(count, n, 3)
        for item in self.between:
            # of equal eigenvalues any directions are right, so that those of two computers differ; this root has none
            root = symmetric_root(item.left)
            values = (random.standard_normal((count, len(root))) @ root)[:, item.level]
            for output in np.flatnonzero(item.column.any(axis=0)):
                found[:, :, output] += values * item.column[:, output]
        return np.asarray(found)

    def u_of(self, weight: FloatArray) -> float:
        """Standard uncertainty of the sum of weights (n, 3) times E over the points."""
        square = float(np.sum(np.einsum("nk,nkr->r", weight, self.factor) ** 2))
        for item in self.between:
            at_level = np.bincount(item.level, np.sum(weight * item.column, axis=1), minlength=len(item.left))
            square += max(float(at_level @ item.left @ at_level), 0.0)
        return float(np.sqrt(square))


@dataclass(frozen=True)
class Posterior:
    """All errors of a machine after the readings: joint mean and covariance, at any position.

    Parameters
    ----------
    machine : with the levels of the state as nodes.
    prior : the sizes in use, with what the readings raised.
    processes : the prior of each curve, with its learnt size.
    names : the errors, curves and squareness, in the order of the state.
    state, factor : mean of the state (p,) and a factor (p, r) of its covariance, factor factor'; mm and rad.
    spans_mm : lowest and highest position of the readings that show the curves of each axis; nan if there are none.
    worse : errors that are larger than their class lets expect, with the ratio.
    follows_table : whether the errors that were listed with it have its gauge; those of a six-DOF instrument do not.
    """

    machine: Machine
    prior: PriorSettings
    processes: Mapping[str, Process]
    squareness_sd: Mapping[str, float]
    names: tuple[str, ...]
    state: FloatArray
    factor: FloatArray
    spans_mm: FloatArray
    worse: Mapping[str, float] = field(default_factory=dict)
    follows_table: bool = True

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
        return np.asarray(weights), process.covariance(position_mm, position_mm) - weights @ across.T

    def curve(self, name: str, position_mm: FloatArray) -> Curve:
        """Return mean and standard uncertainty of an error at positions (m,); of a squareness at one position."""
        columns = dict(self.layout.columns())[name]
        if name in SQUARENESS_NAMES:
            u = np.linalg.norm(self.factor[columns], axis=1)
            return Curve(np.zeros(1), self.state[columns], u)
        position_mm = np.asarray(position_mm, dtype=np.float64)
        weights, left = self.rows(name, position_mm)
        square = np.einsum("ij,ij->i", *(2 * [weights @ self.factor[columns]])) + np.maximum(np.diag(left), 0.0)
        return Curve(position_mm, weights @ self.state[columns], np.sqrt(square))

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
        between: list[_Between] = []
        for name, columns in self.layout.columns():
            column = matrix[:, :, ERROR_INDEX[name]]
            if name in SQUARENESS_NAMES:
                rows = np.broadcast_to(self.factor[columns], (len(position_mm), self.factor.shape[1]))
            else:
                levels, of = np.unique(position_mm[:, error_named(name).axis], return_inverse=True)
                weights, left = self.rows(name, levels)
                rows = (weights @ self.factor[columns])[of.ravel()]
                between.append(_Between(column, of.ravel(), left))
            for output in np.flatnonzero(column.any(axis=0)):
                spread[:, output] += column[:, output, None] * rows
        between += self._other_tools(matrix, position_mm)
        return FieldSpread(spread, tuple(between))

    def _other_tools(self, matrix: FloatArray, position_mm: FloatArray) -> list[_Between]:
        """Errors that one tool cannot show, for the part of the lever by which a tool differs from that of the machine."""
        more = matrix - c_matrix(self.machine, position_mm)
        names = [n for n in ERROR_NAMES if n not in self.names and np.abs(more[:, :, ERROR_INDEX[n]]).max() > 1e-6]
        processes = processes_of(self.machine, self.prior, names)
        found = []
        for name, process in processes.items():
            levels, of = np.unique(position_mm[:, error_named(name).axis], return_inverse=True)
            found.append(_Between(more[:, :, ERROR_INDEX[name]], of.ravel(), process.covariance(levels, levels)))
        return found

    def mean_beyond(self, errors: ErrorTable, position_mm: FloatArray) -> FloatArray:
        """Return the mean of E = C P at points (n, 3) minus that of an error table, mm: what the table does not have.

        Of errors in another gauge only those that the table does not list.
        """
        names = [name for name in self.names if self.follows_table or name not in errors.names]
        listed = errors.only(*names) if self.follows_table else ErrorTable({}, {}, {})
        own = self.mean_table([name for name in names if self.state[dict(self.layout.columns())[name]].any()])
        difference = own.at(position_mm) - listed.at(position_mm)
        return np.asarray(np.einsum("nij,nj->ni", c_matrix(self.machine, position_mm), difference))

    def stored(self) -> StoredPosterior:
        """Return it as a covariance file keeps it."""
        x, y, z = (axis.nodes_mm for axis in self.machine.axes)
        sizes = [
            (self.squareness_sd[name], 0.0, 0.0, 0.0)
            if name in SQUARENESS_NAMES
            else (
                self.processes[name].s,
                self.processes[name].scale,
                self.processes[name].rough,
                self.processes[name].slope,
            )
            for name in self.names
        ]
        prior = self.prior.stated()
        state = self.state, self.factor, self.spans_mm
        return StoredPosterior((x, y, z), self.names, np.array(sizes), *state, prior, self.follows_table)

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


def symmetric_root(covariance: FloatArray) -> FloatArray:
    """The symmetric square root of a covariance that may be singular: unlike any other factor there is only one."""
    values, directions = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray((directions * np.sqrt(np.maximum(values, 0.0))) @ directions.T)


def posterior_of_values(
    machine: Machine,
    names: Sequence[str],
    position_mm: FloatArray,
    value: FloatArray,
    factor: FloatArray,
    taken_off: FloatArray | None = None,
) -> Posterior:
    """Return the posterior of a machine of which error values are known (k,), with a factor (k, r) of their covariance.

    Values whose errors the chain does not show are left out. The sizes of the machine file stay, but for a machine that is
    worse than its class. ``taken_off`` (k, k) is the part of the values that their gauge took off.
    """
    own = set(state_names(machine))
    rows = np.array([name in own for name in names], dtype=bool)
    kept = [name for name in names if name in own]
    at, axis = position_mm[rows], np.array([error_named(name).axis for name in kept])
    curves = np.array([name not in SQUARENESS_NAMES for name in kept], dtype=bool)
    places = [at[curves & (axis == k)] if kept else np.zeros(0) for k in range(3)]
    within = [np.clip(place, *item.range_mm) for place, item in zip(places, machine.axes, strict=True)]
    layout = state_layout(machine, [np.unique(np.round(place, 6)) for place in within], state_names(machine))
    spans = np.array([[place.min(), place.max()] if len(place) else [np.nan, np.nan] for place in within])
    if not kept:
        return solve_posterior(machine, layout, (), spans, learn=False)
    part = factor[rows]
    gauge = None if taken_off is None else taken_off[np.ix_(rows, rows)]
    read = Observations.of_values(layout, kept, at, value[rows], part @ part.T, taken_off=gauge)
    return solve_posterior(machine, layout, (Information.of(read),), spans, learn=False)


@dataclass(frozen=True)
class StoredPosterior:
    """A posterior without its machine, as a covariance file keeps it.

    ``levels_mm`` are the levels of the state on X, Y and Z; ``names`` the errors, ``sizes`` (errors, 4) of each the size
    and the scale of its prior, its rough part, and the size of a measured slope; ``mean`` (p,) and ``factor`` (p, r) of the
    state; ``spans_mm`` (3, 2) where the readings were; ``prior`` the section of the machine file, with what was raised.
    """

    levels_mm: tuple[FloatArray, FloatArray, FloatArray]
    names: tuple[str, ...]
    sizes: FloatArray
    mean: FloatArray
    factor: FloatArray
    spans_mm: FloatArray
    prior: dict[str, Any]
    follows_table: bool = True

    def of(self, machine: Machine) -> Posterior:
        """Return the posterior of the errors of this machine."""
        return restored(machine, self)

    def members(self) -> dict[str, NDArray[np.generic]]:
        """Return the members of the file."""
        levels = {f"posterior_levels_{letter}_mm": at for letter, at in zip("xyz", self.levels_mm, strict=True)}
        return {
            **levels,
            "posterior_names": np.array(self.names),
            "posterior_sizes": self.sizes,
            "posterior_mean": self.mean,
            "posterior_factor": self.factor,
            "posterior_spans_mm": self.spans_mm,
            "posterior_prior": np.array(json.dumps(self.prior)),
            "posterior_follows_table": np.array(self.follows_table),
        }

    @classmethod
    def from_members(cls, members: dict[str, NDArray[np.generic]]) -> StoredPosterior | None:
        """Return what a file contains; None if it has no posterior; ValueError for parts that do not match."""
        if "posterior_names" not in members:
            return None
        try:
            numbers = {
                key: np.asarray(members[f"posterior_{key}"], dtype=np.float64)
                for key in ("sizes", "mean", "factor", "spans_mm", *(f"levels_{letter}_mm" for letter in "xyz"))
            }
            names = tuple(str(name) for name in members["posterior_names"].ravel())
            prior = json.loads(str(members["posterior_prior"]))
        except KeyError as error:
            raise ValueError(Message("part-missing", "{args} is missing", args=error.args[0])) from error
        finite = all(np.isfinite(array).all() for key, array in numbers.items() if key != "spans_mm")
        shapes = numbers["sizes"].shape == (len(names), 4) and numbers["factor"].shape[:1] == numbers["mean"].shape
        known = all(name in ERROR_INDEX for name in names) and isinstance(prior, dict)
        if not (finite and shapes and known and numbers["spans_mm"].shape == (3, 2)):
            raise ValueError("the parts of the posterior do not match")
        x, y, z = (numbers[f"levels_{letter}_mm"] for letter in "xyz")
        others = numbers["sizes"], numbers["mean"], numbers["factor"], numbers["spans_mm"]
        return cls((x, y, z), names, *others, prior, bool(members.get("posterior_follows_table", True)))


def restored(machine: Machine, stored: StoredPosterior) -> Posterior:
    """Return the posterior that a covariance file keeps, for its machine."""
    # measured with tables active, the travel of the state is wider by what they move
    ends = [(float(at[0]), float(at[-1])) for at in stored.levels_mm]
    far = max(np.abs(np.subtract(end, axis.range_mm)).max() for end, axis in zip(ends, machine.axes, strict=True))
    pairs = zip(machine.axes, ends, stored.levels_mm, strict=True)
    x, y, z = (replace(axis, range_mm=end, nodes_mm=at) for axis, end, at in pairs)
    machine = replace(machine, axes=(x, y, z), curves="linear")
    layout = error_parameters(machine, stored.names)
    if far > OTHER_TRAVEL_MM or layout.size != len(stored.mean):
        raise InputError(
            Message(
                "posterior-other-travel",
                "the covariance file belongs to another travel than that of machine {name!r}; "
                "identify the errors again",
                name=machine.name,
            )
        )
    prior = PriorSettings.from_stated(stored.prior)
    sizes = dict(zip(stored.names, stored.sizes.tolist(), strict=True))
    usual = processes_of(machine, prior, stored.names)
    processes = {
        name: replace(item, s=sizes[name][0], scale=sizes[name][1], rough=sizes[name][2], slope=sizes[name][3])
        for name, item in usual.items()
    }
    squareness = {name: size[0] for name, size in sizes.items() if name in SQUARENESS_NAMES}
    columns = [name for name, _ in layout.columns()]
    if columns != list(stored.names):
        raise InputError(
            Message(
                "posterior-order",
                "the errors of the covariance file are not in their usual order; identify the errors again",
            )
        )
    return Posterior(
        layout.machine, prior, processes, squareness, stored.names, stored.mean, stored.factor, stored.spans_mm,
        follows_table=stored.follows_table,
    )  # fmt: skip


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
    seen = _seen(layout, known)
    every = [name for name, _ in layout.columns()]
    shown = [name for name, span in layout.columns() if seen[span].any()]
    spans = {name: span for name, span in layout.columns() if seen[span].any()}
    covariance = _hyperprior(every)
    at_shown = np.array([every.index(name) for name in shown], dtype=np.int64)
    precision = np.linalg.inv(covariance[np.ix_(at_shown, at_shown)])
    low = -np.inf if prior.learn == "both" else 0.0
    if not shown:  # readings of which rounding leaves nothing
        return processes, sizes
    starts = np.cumsum([0, *(span.stop - span.start for span in spans.values())])[:-1]
    information, vector = known.matrix[np.ix_(seen, seen)], known.vector[seen]

    def grown(at: FloatArray, names: Sequence[str]) -> tuple[dict[str, Process], FloatArray]:
        factor = dict(zip(names, np.exp(at).tolist(), strict=True))
        larger = dict(processes) | {name: _grown(processes[name], factor[name]) for name in names if name in processes}
        return larger, sizes * np.array([factor.get(name, 1.0) for name in layout.squareness])

    def value_and_slopes(at: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Logarithm of the likelihood times the hyperprior, its gradient, and Fisher's information of the likelihood."""
        solved = _solve(layout, *grown(at, shown), known)
        root = solved.root[np.ix_(seen, seen)]
        reduced = information @ solved.factor[np.ix_(seen, seen)]
        inner = root.T @ (information - reduced @ reduced.T) @ root  # L' Q L with Q = H - H S H
        pulled = root.T @ (vector - information @ solved.mean[seen])
        gradient = np.add.reduceat(pulled**2 - np.diag(inner), starts)
        fisher = 2.0 * np.add.reduceat(np.add.reduceat(inner**2, starts, axis=0), starts, axis=1)
        return solved.evidence - 0.5 * float(at @ precision @ at), gradient - precision @ at, fisher

    log_size = np.zeros(len(shown))
    value, gradient, fisher = value_and_slopes(log_size)
    for _ in range(LEARNING_STEPS):
        free = (log_size > low + 1e-9) | (gradient > 0)
        if not free.any() or np.abs(gradient[free]).max() < 0.05:
            break
        step = np.zeros(len(shown))
        step[free] = np.linalg.solve((fisher + precision)[np.ix_(free, free)], gradient[free])
        step *= min(1.0, 1.0 / max(float(np.abs(step).max()), 1e-300))
        for _ in range(4):  # a step that makes it less likely is halved
            trial = np.maximum(log_size + step, low)
            found = value_and_slopes(trial)
            if found[0] >= value - 1e-6:
                break
            step *= 0.5
        else:
            break
        done = found[0] - value < ENOUGH_LEARNT
        log_size, (value, gradient, fisher) = trial, found
        if done:
            break
    # what is not shown follows by the hyperprior, and what stays open about an amplitude widens its error
    after = np.linalg.inv(fisher + precision)
    follow = covariance[:, at_shown] @ precision
    spread = covariance - follow @ covariance[at_shown] + follow @ after @ follow.T
    return grown(follow @ log_size + np.diag(spread), every)  # exp(2 v) in variance


# --- the posterior of readings --------------------------------------------------------------------------------------


def solve_posterior(
    machine: Machine,
    layout: ErrorParameters,
    information: Sequence[Information],
    spans_mm: FloatArray,
    *,
    learn: bool,
    passes: int = PASSES,
) -> Posterior:
    """Return the posterior of the state of a layout (:func:`state_layout`) from the information of several sources.

    Sources whose residuals exceed their noise get more of it; a machine that is worse than its class gets larger sizes,
    and ``worse`` says so; ``passes`` limits how often. With ``learn`` the readings change the size of each error, unless the
    machine file says no.

    Raises
    ------
    InputError
        for values and uncertainties so different in size that no number is left after rounding.
    """
    try:
        return _solved_posterior(machine, layout, information, spans_mm, learn=learn, passes=passes)
    except np.linalg.LinAlgError:
        raise InputError(
            Message(
                "readings-lost-in-rounding",
                "the readings and their uncertainties differ so much in size that nothing is left "
                "after rounding; check the units of values and uncertainties",
            )
        ) from None


def _solved_posterior(
    machine: Machine,
    layout: ErrorParameters,
    information: Sequence[Information],
    spans_mm: FloatArray,
    *,
    learn: bool,
    passes: int,
) -> Posterior:
    names, prior, parts = tuple(name for name, _ in layout.columns()), machine.prior, list(information)
    usual = processes_of(machine, prior, names)
    of_class = {name: prior.size(name) for name in layout.squareness}
    own: dict[str, float] = {}
    slopes: dict[str, tuple[float, float]] = {}
    for _ in range(passes):
        larger = processes_of(machine, prior, names) | {n: _grown(usual[n], own[n]) for n in own if n in usual}
        for name, (slope, shape) in slopes.items():
            larger[name] = replace(_grown(usual[name], max(1.0, shape)), slope=FLAT * slope)
        sizes = np.array([of_class[n] * own[n] if n in own else prior.size(n) for n in layout.squareness])
        known = _sum(parts, layout.size)
        solved = _solve(layout, larger, sizes, known)
        found = _posterior(layout, prior, larger, sizes, solved, spans_mm)
        ratios = _over_class(found, usual, of_class)
        raised = machine.prior.raised(*_raises(ratios))
        noisier = [_excess(item, solved) for item in parts]
        parts = [
            item.scaled(factor) if factor > TOO_LARGE else item for item, factor in zip(parts, noisier, strict=True)
        ]
        steep = _slopes(found, usual, slopes)
        same = set(ratios) == set(own) and set(steep) == set(slopes)
        if same and raised == prior and max(noisier, default=1.0) <= TOO_LARGE:
            break
        own, prior, slopes = {name: max(1.0, ratio) for name, ratio in ratios.items()}, raised, steep
    rough = _rough(found) if passes > 1 else {}
    if rough:
        larger = larger | {name: replace(larger[name], rough=share) for name, share in rough.items()}
        solved = _solve(layout, larger, sizes, known)
        found = _posterior(layout, prior, larger, sizes, solved, spans_mm)
    if learn and prior.learn != "no" and parts:
        larger, sizes = _learnt(layout, prior, larger, sizes, known)
        solved = _solve(layout, larger, sizes, known)
        found = _posterior(layout, prior, larger, sizes, solved, spans_mm)
    return replace(found, worse=_worse(ratios))


def _rough(found: Posterior) -> dict[str, float]:
    """Size of the rough part of curves, relative to their smooth parts, where another one is more likely than the usual.

    Values at neighbouring positions that jump show curves that are rough between them, too: jumps, a screw whose period
    the readings do not resolve. First one factor for all determined curves, then one for each of them about it. What the
    readings say of a curve is its posterior without its prior: H = S^-1 - K^-1, b = S^-1 m.
    """
    columns, likely = dict(found.layout.columns()), dict[str, FloatArray]()
    for curve in found.layout.curves:
        name, own = curve.error.name, columns[curve.error.name]
        at = _state_positions(curve.free, curve.nodes_mm)
        if found.shares[name] > DETERMINED or len(at) < FEW_LEVELS:
            continue
        process = found.processes[name]
        prior = process.covariance(at, at)
        tiny = JITTER * np.diag(np.diag(prior))
        inverse = np.linalg.inv(found.factor[own] @ found.factor[own].T + tiny)
        values, directions = np.linalg.eigh(inverse - np.linalg.inv(prior + tiny))
        shows = (directions * np.maximum(values, 0.0)) @ directions.T
        vector, found_of = inverse @ found.state[own], []
        for step in ROUGH_STEPS:
            root = np.linalg.cholesky(replace(process, rough=process.rough * step).covariance(at, at) + tiny)
            half = np.linalg.cholesky(root.T @ shows @ root + np.eye(len(at)))
            gained = np.linalg.solve(half, root.T @ vector)
            found_of.append(0.5 * float(gained @ gained) - float(np.log(np.diag(half)).sum()))
        likely[name] = np.array(found_of)
    if not likely:
        return {}
    size = np.log(ROUGH_STEPS)
    common = size[np.argmax(sum(likely.values()) - 0.5 * (size / OF_ROUGH) ** 2)]
    chosen = {
        name: size[np.argmax(each - 0.5 * ((size - common) / OF_ROUGH_CURVE) ** 2)] for name, each in likely.items()
    }
    of_machine = max(float(common), 0.0)  # of what was not measured
    factors = {name: float(np.exp(chosen.get(name, of_machine))) for name in found.processes}
    return {name: found.processes[name].rough * factor for name, factor in factors.items() if factor != 1.0}


def _grown(process: Process, factor: float) -> Process:
    """A process whose smooth part is larger; what is rough between the readings has the size of the class."""
    return replace(process, s=process.s * factor, scale=process.scale * factor, rough=process.rough / factor)


def with_information(found: Posterior, information: Sequence[Information]) -> Posterior:
    """Return the posterior from other readings, with the same prior as one that was found."""
    sizes = np.array([found.squareness_sd[name] for name in found.layout.squareness])
    known = _sum(information, found.layout.size)
    solved = _solve(found.layout, found.processes, sizes, known)
    return replace(found, state=solved.mean, factor=solved.factor)


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
    return float(np.sqrt(max(left, 0.0) / effective)) if effective >= FEW_FREE else 1.0


def _posterior(
    layout: ErrorParameters,
    prior: PriorSettings,
    processes: Mapping[str, Process],
    sizes: FloatArray,
    solved: _Solved,
    spans_mm: FloatArray,
) -> Posterior:
    names = tuple(name for name, _ in layout.columns())
    squareness = dict(zip(layout.squareness, sizes.tolist(), strict=True))
    return Posterior(layout.machine, prior, dict(processes), squareness, names, solved.mean, solved.factor, spans_mm)


def _over_class(found: Posterior, usual: Mapping[str, Process], of_class: Mapping[str, float]) -> dict[str, float]:
    """Size of each determined error over what its class lets expect, rms along the travel."""
    ratios = {}
    for name in found.determined:
        if name in of_class:
            ratios[name] = abs(float(found.curve(name, np.zeros(1)).value[0])) / of_class[name]
            continue
        at = np.linspace(*found.machine.axes[error_named(name).axis].range_mm, SCATTERED)
        ratios[name] = float(np.sqrt(np.mean(found.curve(name, at).value ** 2) / np.mean(usual[name].sd(at) ** 2)))
    return ratios


def _slopes(
    found: Posterior, usual: Mapping[str, Process], before: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Slope per mm about the reference point of each positioning error of which the readings show it, by least squares.

    With the size of what remains over that which the class lets expect: a steep curve need not be a bent one.
    """
    slopes = {}
    for name, process in usual.items():
        if not process.scale or not (name in before or DETERMINED < found.shares[name] <= LISTED_CURVE):
            continue  # what is determined everywhere is drawn by its readings
        at = np.linspace(*found.machine.axes[error_named(name).axis].range_mm, SCATTERED)
        away, value = at - process.zero_mm[0], found.curve(name, at).value
        gain = away / float(away @ away)
        slope = float(gain @ value)
        u = float(np.linalg.norm(gain @ found.values_factor([name], [at])))
        if abs(slope) > 3.0 * u and u < process.scale:
            shape = replace(process, scale=0.0).sd(at)
            slopes[name] = abs(slope), float(np.linalg.norm(value - slope * away) / np.linalg.norm(shape))
    return slopes


def _worse(ratios: Mapping[str, float]) -> dict[str, float]:
    """Errors that show a machine worse than its class: one far beyond it, or curves and squareness each together."""
    found: dict[str, float] = {}
    for is_squareness in (False, True):
        own = {name: value for name, value in ratios.items() if (name in SQUARENESS_NAMES) == is_squareness}
        over = {name: value for name, value in own.items() if value > WORSE_CURVE}
        if len(own) > 1 and not over and np.sqrt(np.mean(np.square(list(own.values())))) > WORSE_ALL:
            over = {name: value for name, value in own.items() if value > WORSE_ALL}
        found |= over
    return found


def _raises(ratios: Mapping[str, float]) -> tuple[float, float]:
    """Factors of the sizes of curves and of squareness with which the machine is no longer worse than its class.

    Curves that are worse raise the class, and squareness with it: who built them bent did not assemble them better. A
    squareness alone may come from transport or a crash.
    """
    worse, factors = _worse(ratios), []
    for is_squareness in (False, True):
        largest = max(
            (value for name, value in worse.items() if (name in SQUARENESS_NAMES) == is_squareness), default=0.0
        )
        steps = np.ceil(np.log(largest / WORSE_CURVE) / np.log(RAISE)) if largest > WORSE_CURVE else float(largest > 0)
        factors.append(float(RAISE**steps))
    return factors[0], max(factors)


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
    which, cyclic = found.prior.class_text, found.prior.cyclic_text
    if not sizes:
        class_text = f"{cyclic}, {which}" if cyclic else which
        return f"every error was measured; assumed between the readings: {class_text}"
    if cyclic:
        which = f"{cyclic} between the readings; {which}"
    parts = [f"{kind} up to {size:.3g} {unit}" for kind, (size, unit) in sizes.items()]
    return f"assumed for what was not measured: {', '.join(parts)} (k = 2; {which})"


def not_measured(found: Posterior, listed: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the errors that are not listed: the standard deviation assumed, its unit, and what it costs over the volume, um."""
    entries = {}
    for name, cost_um in _costs_um(found, [name for name in found.names if name not in listed], prior=True).items():
        entries[name] = {
            "assumed_sd": found.prior.size_um(name),
            "unit": error_named(name).unit,
            "rms_over_volume_um": cost_um,
        }
    return entries


def not_determined_um(found: Posterior) -> dict[str, float]:
    """Return the errors that are not determined with what their u does to the tool, rms over the volume, largest first."""
    costs = _costs_um(found, [name for name in found.names if name not in found.determined])
    return dict(sorted(costs.items(), key=lambda item: -item[1]))


def open_shares(found: Posterior, position_mm: FloatArray, tool_mm: FloatArray | None = None) -> dict[str, float]:
    """Return the share of the variance of E over points (n, 3) of each error that is not determined, the largest first.

    Errors that one tool does not show count with the part of the lever by which the tools differ from that of the machine.
    """
    spread = found.field(position_mm, tool_mm)
    matrix, total = c_matrix(found.machine, position_mm, tool_mm), float(spread.variance.sum())
    shares: dict[str, float] = {}
    for name in found.names:
        if name in found.determined or total <= 0.0:
            continue
        column = matrix[:, :, ERROR_INDEX[name]]
        at, of = np.unique(position_mm[:, error_named(name).axis], return_inverse=True)
        u = found.curve(name, at).u
        u = u if name in SQUARENESS_NAMES else u[of.ravel()]
        shares[name] = float(np.sum(column**2 * (u**2)[:, None])) / total
    known = FieldSpread(spread.factor, tuple(spread.between[: len(found.processes)]))
    beyond = 1.0 - float(known.variance.sum()) / total if total > 0.0 else 0.0
    if beyond > 1e-6:
        shares["angles that only another tool shows"] = beyond
    whole = sum(shares.values())
    return {name: value / max(whole, 1.0) for name, value in sorted(shares.items(), key=lambda item: -item[1])}


def _costs_um(found: Posterior, names: Sequence[str], *, prior: bool = False) -> dict[str, float]:
    """What is not known of errors, at the tool: rms over the volume, um; with ``prior`` as if nothing had been measured."""
    levels = [np.linspace(*axis.range_mm, 5) for axis in found.machine.axes]
    at_mm = full_grid(levels).reshape(-1, 3)
    matrix, costs = c_matrix(found.machine, at_mm), {}
    for name in names:
        column = matrix[:, :, ERROR_INDEX[name]]
        axis = error_named(name).axis
        if name in SQUARENESS_NAMES:
            sd = np.full(5, found.squareness_sd[name] if prior else found.curve(name, np.zeros(1)).u[0])
        else:
            sd = found.processes[name].sd(levels[axis]) if prior else found.curve(name, levels[axis]).u
        at_points = np.interp(at_mm[:, axis], levels[axis], sd)
        costs[name] = float(np.sqrt(np.mean(np.sum(column**2, axis=1) * at_points**2))) / MM_PER_UM
    return costs


def worse_text(found: Posterior) -> str:
    """Return a sentence if the machine is worse than its class, else nothing."""
    if not found.worse:
        return ""
    listed = ", ".join(f"{name} {ratio:.1f}" for name, ratio in sorted(found.worse.items(), key=lambda x: -x[1])[:4])
    if len(found.worse) > 4:
        listed = f"{listed} and {len(found.worse) - 4} more"
    return (
        f"the machine is worse than its class {found.prior.stated_class!r}, in multiples of what it lets expect: {listed}; "
        "larger errors are assumed. State class or sizes in [prior] of the machine file"
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
