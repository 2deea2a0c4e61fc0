"""Changes with time in the runs of one axis: noise with memory, candidates, and the set of candidates that explains it.

    y = cell means + S c + noise,   cov(noise) = sigma^2 V,   V_ij = (1 - w) phi^|t_i - t_j| + w 1[i = j]

The likelihood is computed from the contrasts in which the cell means cancel (REML), with sigma in closed form, and
summed over a grid of (phi, w): wandering noise and a wandering effect are weighed against each other, not in sequence.
The criterion of a set S is 2 log likelihood minus a penalty for every member; the thresholds are calibrated with
simulated sessions without any effect (docs/diagnosis-benchmark.md). An effect with one parameter is fitted freely; the
coefficients of several columns have a normal prior of variance lambda sigma^2; otherwise they could explain everything.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from compgen.data.csv_files import FloatArray
from compgen.diagnose.axis_session import AxisSession
from compgen.diagnose.layout import IntArray
from compgen.effects import Effect, catalogue
from compgen.kinematics.kernel_switch import lapack

Tier = Literal["named", "generic"]

#: Correlation of neighbouring readings, and share of white noise next to the part with memory.
PHI = (0.0, 0.25, 0.5, 0.7, 0.83, 0.92, 0.98)
WHITE = (0.0, 0.4, 0.8)
#: Log prior of each memory: what stays similar over more than ten readings is more likely a change than noise.
LOG_PRIOR = dict(zip(PHI, (0.0, 0.0, 0.0, 0.0, 0.0, -1.0, -3.0), strict=True))
#: Prior variances over sigma^2 that are tried for the coefficients of several columns.
LAMBDA = np.array([2.0, 20.0, 200.0, 2000.0])
#: The same for columns of a smooth term that are fitted freely, each with the penalty of a named effect: a large effect
#: must not cost more with four columns than with three names.
FREE = 1e9
LAMBDAS = np.append(LAMBDA, FREE)
#: Names of slow drifts.
DRIFTS = ("warmup_drift", "linear_drift")
#: Least share of a column that must remain after fitting the means and the other members.
LEAST_SEEN = 1e-3
#: Least improvement of the criterion by a member.
LEAST_GAIN = 5.5
#: Criteria closer than this are equal: a bad last run and a step before it affect the same readings.
SAME = 1e-6
#: What an unnamed smooth term must gain in addition to what a named effect must.
GENERIC_HANDICAP = 8.0
#: Kinds of smooth terms from which a search is started.
STARTS = 5
#: Bad runs or steps from which a search is started if the first searches found anything that depends on the run.
RUN_STARTS = 8
#: Names of effects on whole runs.
OF_RUNS = ("bad_run", "step_between_runs")
#: What every name beyond the first must gain to replace an unnamed smooth term: two events that happen to cancel or to
#: follow each other are less likely than one.
MORE_NAMES = 4.0
#: What readings with a separate value each must gain in addition to what a common offset must.
FREE_HANDICAP = 6.0
#: Readings of one run that may be off by themselves, at most, before the whole run counts as bad.
MOST_OFF = 3


@dataclass(frozen=True)
class Candidate:
    """Columns (n, k) that may be added; ``first`` ... ``last`` are the readings covered by a disturbance.

    ``scans`` is the number of scan positions (time constants, boundaries, windows) from which this one was chosen.
    """

    name: str
    tier: Tier
    columns: FloatArray
    scans: float
    text: str = ""
    covariates: tuple[str, ...] = ()
    effect: Effect | None = None
    first: int = -1
    last: int = -1
    free: bool = False

    def penalty(self, freedom: int) -> float:
        """Gain in twice the log likelihood that the columns must exceed."""
        scan = 2.0 * float(np.log(self.scans))
        if self.columns.shape[1] == 1 and self.tier == "named":
            return float(np.log(freedom)) + scan
        own = float(np.log(freedom)) if self.columns.shape[1] == 1 else 2.0
        return own + scan + (GENERIC_HANDICAP if self.tier == "generic" else FREE_HANDICAP)


class NoiseGrid:
    """Inverse covariances of the noise for every (phi, w); sigma is 1.

    Noise with memory is a Markov chain: the inverse T of K_ij = phi^|t_i - t_j| is tridiagonal. With V = a K + b I,
    inv(V) = inv(a I + b T) T is applied to a vector in O(n) operations; no covariance is ever inverted.
    """

    def __init__(
        self,
        session: AxisSession,
        scatter: FloatArray | None = None,
        points: Sequence[tuple[float, float]] | None = None,
    ) -> None:
        """Prepare the grid; ``scatter`` (n,) divides all readings if the noise is not uniform."""
        step = session.time / (np.median(np.diff(session.time)) if session.timed else 1.0)
        n = len(session)
        self.cells = np.zeros((n, int(session.cell.max()) + 1))
        self.cells[np.arange(n), session.cell] = 1.0 if scatter is None else 1.0 / scatter
        self.freedom = n - self.cells.shape[1]
        self.points = list(points or [(phi, w) for phi in PHI for w in (WHITE if phi else (0.0,))])
        self._bands = [_bands(np.diff(step), phi, w) for phi, w in self.points]
        #: inv(V) N and inv(N' inv(V) N) for the indicators N of the cells, to remove the cell means from a vector.
        self._right, self._middle = [], []
        constant = []
        for point, (_, _, determinant) in enumerate(self._bands):
            right = self.solve(point, self.cells)
            middle = self.cells.T @ right
            self._right.append(right)
            self._middle.append(np.linalg.inv(middle))
            constant.append(determinant + np.linalg.slogdet(middle)[1])
        self.constant = np.array(constant)
        self.prior = np.array([LOG_PRIOR[phi] - (np.log(len(WHITE)) if phi else 0.0) for phi, _ in self.points])

    def solve(self, point: int, columns: FloatArray) -> FloatArray:
        """inv(V) times columns (n, k)."""
        inverse, factor, _ = self._bands[point]
        return np.asarray(lapack().dpbtrs(factor, _times(inverse, columns), lower=1)[0])

    def inverse(self, point: int) -> FloatArray:
        """inv(V), (n, n)."""
        found = self.solve(point, np.eye(len(self.cells)))
        return 0.5 * (found + found.T)

    def free(self, point: int, columns: FloatArray) -> FloatArray:
        """P times columns (n, k); P is inv(V) with the cell means projected out."""
        right = self._right[point]
        return self.solve(point, columns) - right @ (self._middle[point] @ (right.T @ columns))

    def projector(self, point: int) -> FloatArray:
        """P, (n, n)."""
        right = self._right[point]
        return self.inverse(point) - right @ (self._middle[point] @ right.T)

    def log_likelihood(self, square: FloatArray, extra: FloatArray) -> FloatArray:
        """Log likelihood (...) summed over the grid, for y'Py and extra log determinants of shape (points, ...)."""
        shape = (-1, *([1] * (square.ndim - 1)))
        own = -0.5 * self.freedom * np.log(square / self.freedom) - 0.5 * (extra + self.constant.reshape(shape))
        return np.asarray(logsumexp(own + self.prior.reshape(shape), axis=0))

    def log_likelihoods(self, square: FloatArray) -> FloatArray:
        """Log likelihood at each grid point, (points,), for y'Py (points,)."""
        return np.asarray(-0.5 * self.freedom * np.log(square / self.freedom) - 0.5 * self.constant + self.prior)

    def weights(self, square: FloatArray) -> FloatArray:
        """Posterior weight of each grid point, (points,), for y'Py (points,)."""
        own = self.log_likelihoods(square)
        return np.asarray(np.exp(own - logsumexp(own)))


def _bands(apart: FloatArray, phi: float, w: float) -> tuple[FloatArray, FloatArray, float]:
    """Diagonal and lower diagonal of T (2, n), the banded Cholesky factor of a I + b T, and log det V.

    ``apart`` (n - 1,) are the time intervals between neighbouring readings. A little white noise keeps V regular.
    """
    n = len(apart) + 1
    r = np.minimum(phi**apart, 1.0 - 1e-9) if phi else np.zeros(n - 1)
    own = r**2 / (1.0 - r**2)
    inverse = np.zeros((2, n))
    inverse[0] = 1.0 + np.append(own, 0.0) + np.append(0.0, own)
    inverse[1, :-1] = -r / (1.0 - r**2)
    a, b = (1.0 - w, w + 1e-9) if phi else (1.0, 0.0)
    sum_of_both = b * inverse
    sum_of_both[0] += a
    factor, failed = lapack().dpbtrf(sum_of_both, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the covariance of the noise is not positive definite")
    determinant = 2.0 * float(np.sum(np.log(factor[0]))) + float(np.sum(np.log1p(-(r**2))))
    return inverse, factor, determinant


def _times(bands: FloatArray, columns: FloatArray) -> FloatArray:
    """A symmetric tridiagonal matrix times columns (n, k)."""
    found = bands[0][:, None] * columns
    found[1:] += bands[1, :-1, None] * columns[:-1]
    found[:-1] += bands[1, :-1, None] * columns[1:]
    return np.asarray(found)


@dataclass(frozen=True)
class _Block:
    """All candidates with k columns: numbers ``rows`` (m,), and their Gram matrix C'PC at each grid point.

    ``columns`` are (m, k, n). The matrix is stored as eigenvalues ``value`` (points, m, k) and eigenvectors ``turn``
    (points, m, k, k); ``right`` (points, m, k) is C'Py in these axes. ``size`` (m,) is the mean square of the columns.
    """

    rows: IntArray
    columns: FloatArray
    value: FloatArray
    turn: FloatArray
    right: FloatArray
    size: FloatArray


@dataclass(frozen=True)
class _State:
    """A set of orthonormalised members: remaining y'Py, log determinant, trace of P, and T'b, at each grid point.

    ``turn`` T (points, K, r) turns the Gram matrix of the members (with the prior of those with several columns) into
    the identity; the first ``free`` columns belong to members without a prior.
    """

    members: tuple[int, ...]
    free: list[int]
    square: FloatArray
    determinant: FloatArray
    trace: FloatArray
    turn: list[FloatArray]
    right: list[FloatArray]


class Search:
    """Search for the set of candidates that explains the readings.

    All comparisons depend only on the products C'PC and C'Py, which are computed once. The columns of a member are
    multiplied by those of all candidates when it is first tried; after that, no (n, n) matrix is used.
    """

    def __init__(self, session: AxisSession, grid: NoiseGrid, candidates: Sequence[Candidate]) -> None:
        self.session, self.grid, self.candidates = session, grid, list(candidates)
        self.y = session.deviation_mm - session.deviation_mm.mean()
        self._drifts = np.array([c.name in DRIFTS for c in self.candidates], dtype=bool)
        self._named = np.array([c.tier == "named" for c in self.candidates], dtype=bool)
        self._penalties = np.array([c.penalty(grid.freedom) for c in self.candidates])
        pulled = [grid.free(point, self.y[:, None])[:, 0] for point in range(len(grid.points))]
        self._square = np.array([self.y @ own for own in pulled])
        self._blocks, self._trace = _blocks_of(grid, self.candidates, pulled)
        #: P C (points, n, k) of a member, and C'P C of all candidates with it, per block, (points, m, k, member's k).
        self._pulled: dict[int, FloatArray] = {}
        self._cross: dict[int, list[FloatArray]] = {}
        #: Variance over sigma^2 of members with several columns, from when they were last chosen.
        self._lambda: dict[int, float] = {}
        self._best_lambda = np.full(len(self.candidates), LAMBDA[1])
        self._known: dict[frozenset[tuple[int, float]], tuple[FloatArray, FloatArray]] = {}

    def columns_of(self, members: Sequence[int]) -> FloatArray:
        """Columns of the given candidates side by side, (n, k)."""
        if not members:
            return np.zeros((len(self.session), 0))
        return np.hstack([self.candidates[k].columns for k in members])

    def square(self, members: Sequence[int]) -> FloatArray:
        """Return y'Py (points,) with the members fitted, never below the resolution."""
        return np.maximum(self._state(members).square, self.grid.freedom * self.session.least_mm**2)

    def scatter_mm(self, members: Sequence[int]) -> float:
        """Standard deviation of the readings with the members fitted, as it is, mm."""
        square = self._state(members).square
        return float(np.sqrt(max(square[0], 0.0) / max(self.grid.freedom - self.columns_of(members).shape[1], 1)))

    def suspects(self) -> tuple[tuple[str, float], ...]:
        """Names with the gain in twice the log likelihood of each on its own, the largest first."""
        best: dict[str, float] = {}
        for candidate, gain in zip(self.candidates, self.criteria([])[0].tolist(), strict=True):
            if candidate.tier == "named" and not candidate.free:
                best[candidate.name] = max(best.get(candidate.name, 0.0), gain)
        return tuple(sorted(best.items(), key=lambda item: -item[1]))

    def _pull(self, member: int) -> FloatArray:
        if member not in self._pulled:
            columns = self.candidates[member].columns
            self._pulled[member] = np.stack([self.grid.free(p, columns) for p in range(len(self.grid.points))])
        return self._pulled[member]

    def _crossed(self, member: int) -> list[FloatArray]:
        """Products of all candidates with a member, in the eigenvector axes of each candidate."""
        if member not in self._cross:
            own = self._pull(member)
            self._cross[member] = [_crossed(block, own) for block in self._blocks]
        return self._cross[member]

    def _state(self, members: Sequence[int]) -> _State:
        """Orthonormalise the members: first those with one column together, then those with several and their prior."""
        unbound = [k for k in members if self._lambda.get(k) == FREE and self.candidates[k].columns.shape[1] > 1]
        single = [k for k in members if self.candidates[k].columns.shape[1] == 1 or k in unbound]
        order = [*single, *(k for k in members if k not in single)]
        paid = np.log(self.grid.freedom) * sum(self.candidates[k].columns.shape[1] for k in unbound)
        columns = self.columns_of(order)
        ridge = np.concatenate([
            np.zeros(sum(self.candidates[k].columns.shape[1] for k in single)),
            *(
                np.full(self.candidates[k].columns.shape[1], 1.0 / self._lambda.get(k, LAMBDA[1]))
                for k in order[len(single) :]
            ),
        ])  # fmt: skip
        square, determinant, trace = self._square.copy(), np.zeros(len(self._square)), self._trace.copy()
        turn, right, free = [], [], []
        for p in range(len(square)):
            pulled = np.hstack([np.zeros((len(self.y), 0)), *(self._pull(k)[p] for k in order)])
            t, determinant[p] = _orthogonal(columns.T @ pulled, ridge, int(np.count_nonzero(ridge == 0.0)))
            turn.append(t)
            free.append(t.shape[1] - np.count_nonzero(ridge))
            right.append(t.T @ (pulled.T @ self.y))
            square[p] -= float(right[-1] @ right[-1])
            trace[p] -= float(np.sum((pulled @ t) ** 2))
        return _State(tuple(order), free, square, determinant + paid, trace, turn, right)

    def level(self, members: Sequence[int]) -> float:
        """Twice the log likelihood of a set."""
        state = self._state(members)
        square = np.maximum(state.square, self.grid.freedom * self.session.least_mm**2)
        return 2.0 * float(self.grid.log_likelihood(square, state.determinant))

    def gains(self, members: Sequence[int]) -> FloatArray:
        """Gain of every candidate when added to a set: increase of twice the log likelihood, (candidates,)."""
        state = self._state(members)
        floor = self.grid.freedom * self.session.least_mm**2
        square = np.maximum(state.square, floor)
        base = 2.0 * float(self.grid.log_likelihood(square, state.determinant))
        found = np.zeros(len(self.candidates))
        for number, block in enumerate(self._blocks):
            parts = [self._explained(state, number, p) for p in range(len(square))]
            taken = np.stack([part[0] for part in parts])  # (points, m, lambdas)
            more = np.stack([part[1] for part in parts]) + state.determinant[:, None, None]
            value = self.grid.log_likelihood(np.maximum(square[:, None, None] - taken, floor), more)
            if value.shape[1] > len(LAMBDA):
                value[self._named[block.rows], -1] = -np.inf
            found[block.rows] = 2.0 * value.max(axis=1) - base
            if block.columns.shape[1] > 1:
                self._best_lambda[block.rows] = LAMBDAS[value.argmax(axis=1)]
        return found

    def _explained(self, state: _State, number: int, point: int) -> tuple[FloatArray, FloatArray]:
        """Reduction of y'Py by the candidates of a block added to a set, and log det(1 + lambda C'PC), (m, lambdas).

        A single column is fitted freely (one lambda, no determinant) if enough of it is visible.
        """
        block = self._blocks[number]
        m, k = block.columns.shape[:2]
        crossed = [self._crossed(member)[number][point] for member in state.members]
        projected = np.concatenate([np.zeros((m, k, 0)), *crossed], axis=2) @ state.turn[point]
        right = block.right[point] - projected @ state.right[point]
        if k == 1:
            size = block.value[point, :, 0] - np.sum(projected[:, 0] ** 2, axis=1)
            seen = size > LEAST_SEEN * block.size * max(state.trace[point], 1e-12)
            taken = np.where(seen, right[:, 0] ** 2 / np.where(seen, size, 1.0), 0.0)
            # a free column takes over part of what the columns with a prior could explain: their determinant decreases
            alone = block.value[point, :, 0] - np.sum(projected[:, 0, : state.free[point]] ** 2, axis=1)
            more = np.where(seen, np.log(np.where(seen, size / np.where(seen, alone, 1.0), 1.0)), 0.0)
            return taken[:, None], more[:, None]
        price = float(np.log(self.grid.freedom))
        if projected.shape[2] < k:
            # C'PC is diagonal with the eigenvalues (m, k), minus B B' with B (m, k, r), r < k: Woodbury's formula
            value = block.value[point]
            taken, determinant = _ridged(value, right, price)
            if not projected.shape[2]:
                return taken, determinant
            inverse = LAMBDAS / (1.0 + LAMBDAS * value[:, :, None])  # (m, k, lambdas)
            scaled = inverse.transpose(0, 2, 1)[..., None] * projected[:, None]  # (m, lambdas, k, r)
            middle = np.eye(projected.shape[2]) - projected.transpose(0, 2, 1)[:, None] @ scaled
            pulled = np.einsum("mlkr,mk->mlr", scaled, right)
            more = np.einsum("mlr,mlr->ml", pulled, np.linalg.solve(middle, pulled[..., None])[..., 0])
            log_determinant = np.linalg.slogdet(middle)[1]
            log_determinant[:, -1] = 0.0
            return taken + more, determinant + log_determinant
        gram = np.eye(k) * block.value[point][:, None, :] - projected @ projected.transpose(0, 2, 1)
        value, vector = np.linalg.eigh(gram)
        turned = np.einsum("mkl,mk->ml", vector, right)
        return _ridged(np.maximum(value, 0.0), turned, price)

    def criteria(self, members: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Gain, and gain minus penalty, of every candidate when added to a set."""
        gains, _ = self._compared(members)
        return gains, gains - self._penalties

    def _compared(self, members: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Gain of every candidate when added to a set, and the variance over sigma^2 that gives it."""
        key = frozenset((k, self._lambda.get(k, 0.0)) for k in members)
        if key not in self._known:
            gains = self.gains(sorted(members))
            self._known[key] = gains, self._best_lambda.copy()
        return self._known[key]

    def _choose(self, members: Sequence[int], chosen: int) -> None:
        """Set the best variance of a candidate that is added to a set."""
        if self.candidates[chosen].columns.shape[1] > 1 and chosen not in members:
            self._lambda[chosen] = float(self._compared(members)[1][chosen])

    def total(self, members: Sequence[int]) -> float:
        """Criterion of a set relative to the empty set; members are added in order, each gain minus its penalty."""
        value, before = 0.0, self.level([])
        for count in range(1, len(members) + 1):
            now = self.level(members[:count])
            value += (now - before) - self.candidates[members[count - 1]].penalty(self.grid.freedom)
            before = now
        return value

    def run(self, most: int) -> list[int]:
        """Return the best set from several searches: names first and then all, all at once, or from one smooth term.

        Stepwise search alone can miss a smooth term that explains what several names explain together.
        """
        everything = np.ones(len(self.candidates), dtype=bool)
        results = []

        def keep(members: list[int]) -> None:
            # criterion of the set, minus a charge because several names at once are unlikely
            named = sum(self.candidates[k].tier == "named" for k in members)
            results.append((self.total(members) - MORE_NAMES * max(named - 1, 0), members, dict(self._lambda)))

        keep(self._grown(self._grown([], self._named, most), everything, most))
        keep(self._grown([], everything, most))
        gains = np.where(self._named, -np.inf, self.criteria([])[1])
        starts: dict[str, int] = {}
        for k in np.argsort(-gains, kind="stable").tolist():
            if gains[k] > LEAST_GAIN and len(starts) < STARTS and most > 1:
                starts.setdefault(self.candidates[k].name.partition(" at ")[0], k)
        for k in starts.values():
            self._choose([], k)
            keep(self._grown([k], everything, most))
        best = _first_of(results)[1]
        if most > 1 and sum("run" in " ".join(self.candidates[k].covariates) for k in best):
            for k in self._runs(RUN_STARTS):
                keep(self._grown([k], self._named, most))
        _, members, self._lambda = _first_of(results)
        return self._single(members)

    def _single(self, members: list[int]) -> list[int]:
        """Members with a run whose readings have separate values exchanged for the few readings that are off, if they tell more.

        Two outliers in one run together look like a bad run to a search that adds one candidate at a time.
        """
        for member in members:
            run = self.candidates[member]
            if not run.free or run.last - run.first < MOST_OFF:
                continue
            rest, chosen = [k for k in members if k != member], list[int]()
            inside = [
                k for k, c in enumerate(self.candidates)
                if not c.free and c.first == c.last >= 0 and run.first <= c.first <= run.last and k not in rest
            ]  # fmt: skip
            while inside and len(chosen) < MOST_OFF:
                criteria = self.criteria([*rest, *chosen])[1]
                best = max(inside, key=lambda k: float(criteria[k]))  # noqa: B023 - used at once
                if criteria[best] < LEAST_GAIN:
                    break
                chosen.append(best)
                inside.remove(best)
            if chosen and self.total([*rest, *chosen]) > self.total([*rest, member]):
                members = [*rest, *chosen]
        return members

    def _runs(self, most: int) -> list[int]:
        """Effects on whole runs, those that explain most first: two bad runs may hide each other in the first step."""
        gains = self.criteria([])[0]
        found = [k for k, c in enumerate(self.candidates) if c.name in OF_RUNS and c.columns.shape[1] == 1]
        return sorted(found, key=lambda k: -gains[k])[:most]

    def _grown(self, members: list[int], allowed: NDArray[np.bool_], most: int) -> list[int]:
        """Forward steps; after each, every member is exchanged if another candidate fits better with the rest."""
        while len(members) < most:
            best, criterion = self._best(members, allowed)
            if criterion < LEAST_GAIN:
                break
            self._choose(members, best)
            grown = [*members, best]
            for _ in range(3):
                changed = False
                for member in list(grown):
                    rest = [k for k in grown if k != member]
                    criteria = self._open(rest, allowed)
                    best = _first_best(criteria)
                    if criteria[best] < LEAST_GAIN:
                        grown, changed = rest, True
                    elif best != member and criteria[best] > criteria[member] + SAME:
                        self._choose(rest, best)
                        grown, changed = [*rest, best], True
                if not changed or len(grown) < 2:
                    break
            if len(grown) <= len(members) and self.total(grown) <= self.total(members):
                break
            members = grown
        return members

    def _open(self, members: Sequence[int], allowed: NDArray[np.bool_]) -> FloatArray:
        """Criteria of the candidates that may join the members; at most one named drift per session."""
        criteria = np.where(allowed, self.criteria(members)[1], -np.inf)
        if any(self._drifts[k] for k in members):
            criteria[self._drifts] = -np.inf
        return criteria

    def _best(self, members: Sequence[int], allowed: NDArray[np.bool_]) -> tuple[int, float]:
        criteria = self._open(members, allowed)
        best = _first_best(criteria)
        return best, float(criteria[best])


def _first_of(
    results: Sequence[tuple[float, list[int], dict[int, float]]],
) -> tuple[float, list[int], dict[int, float]]:
    """First of the results (criterion, members, variances) that has the best criterion."""
    most = max(result[0] for result in results)
    return next(result for result in results if result[0] >= most - SAME)


def _first_best(criteria: FloatArray) -> int:
    """First candidate with the best criterion: rounding must not decide between two that affect the same readings."""
    return int(np.flatnonzero(criteria >= criteria.max() - SAME)[0])


def _blocks_of(
    grid: NoiseGrid, candidates: Sequence[Candidate], pulled: Sequence[FloatArray]
) -> tuple[list[_Block], FloatArray]:
    """Candidates by number of columns, and the trace of P at each grid point; ``pulled`` contains Py (n,) per point."""
    sizes = np.array([c.columns.shape[1] for c in candidates], dtype=np.int64)
    numbers = [np.flatnonzero(sizes == k) for k in np.unique(sizes).tolist()]
    columns = [np.stack([candidates[r].columns.T for r in rows.tolist()]) for rows in numbers]
    windows = [[_window(candidates[r].columns) for r in rows.tolist()] for rows in numbers]
    grams: list[list[FloatArray]] = [[] for _ in numbers]
    trace = []
    for point in range(len(grid.points)):
        projector = grid.projector(point)
        trace.append(float(np.trace(projector)))
        # sums of P from each row and column on: the Gram matrix of windows is a combination of four of these
        summed = np.zeros((len(projector) + 1,) * 2)
        summed[:-1, :-1] = projector[::-1, ::-1].cumsum(axis=0).cumsum(axis=1)[::-1, ::-1]
        for gram, own, at in zip(grams, columns, windows, strict=True):
            gram.append(_gram(projector, summed, own, at))
    blocks = []
    for rows, own, gram in zip(numbers, columns, grams, strict=True):
        value, turn = np.linalg.eigh(np.stack(gram))
        right = np.stack([own.reshape(-1, own.shape[2]) @ each for each in pulled]).reshape(value.shape)
        right = np.einsum("pmkl,pmk->pml", turn, right)
        blocks.append(_Block(rows, own, np.maximum(value, 0.0), turn, right, np.mean(own**2, axis=(1, 2))))
    return blocks, np.array(trace)


def _window(columns: FloatArray) -> tuple[int, int, float] | None:
    """First reading, the one after the last, and value of a column that is constant between them and zero elsewhere.

    For several columns of one reading each, one after the other, the value is NaN. None for all other columns.
    """
    rows = np.flatnonzero(columns.any(axis=1))
    if not len(rows) or rows[-1] - rows[0] + 1 != len(rows):
        return None
    first, end, own = int(rows[0]), int(rows[-1]) + 1, columns[rows]
    if columns.shape[1] == 1:
        return (first, end, float(own[0, 0])) if np.all(own == own[0]) else None
    return (first, end, np.nan) if own.shape[0] == own.shape[1] and np.all(own == np.eye(len(own))) else None


def _gram(
    projector: FloatArray, summed: FloatArray, columns: FloatArray, windows: Sequence[tuple[int, int, float] | None]
) -> FloatArray:
    """C'PC of candidates with columns (m, k, n), (m, k, k)."""
    m, k, n = columns.shape
    found = np.empty((m, k, k))
    rest = [i for i, window in enumerate(windows) if window is None]
    if rest:
        flat = columns[rest].reshape(-1, n)
        found[rest] = columns[rest] @ (flat @ projector).reshape(-1, k, n).transpose(0, 2, 1)
    for i, window in enumerate(windows):
        if window is None:
            continue
        a, b, value = window
        if k == 1:
            found[i] = value**2 * (summed[a, a] - summed[a, b] - summed[b, a] + summed[b, b])
        else:
            found[i] = projector[a:b, a:b]
    return found


def _crossed(block: _Block, pulled: FloatArray) -> FloatArray:
    """C'P times a member's columns, in each candidate's axes, (points, m, k, own k), from PC (points, n, own k)."""
    m, k, n = block.columns.shape
    points, _, own = pulled.shape
    found = block.columns.reshape(m * k, n) @ pulled.transpose(1, 0, 2).reshape(n, points * own)
    found = found.reshape(m, k, points, own).transpose(2, 0, 1, 3)
    return np.asarray(found if k == 1 else block.turn.transpose(0, 1, 3, 2) @ found)


def _orthogonal(gram: FloatArray, ridge: FloatArray, single: int) -> tuple[FloatArray, float]:
    """T with T'(G + ridge) T = 1, and log det(1 + G / ridge) of the columns with a prior, given the ``single`` without.

    The first ``single`` columns have no prior; what they have in common is counted once.
    """
    if not len(gram):
        return np.zeros((0, 0)), 0.0
    value, vector = np.linalg.eigh(0.5 * (gram + gram.T)[:single, :single])
    kept = value > 1e-10 * value.max(initial=0.0)
    first = vector[:, kept] / np.sqrt(value[kept])
    if single == len(gram):
        return first, 0.0
    shared = first.T @ gram[:single, single:]
    prior = ridge[single:]
    factor = np.linalg.cholesky(gram[single:, single:] - shared.T @ shared + np.diag(prior))
    second = np.linalg.inv(factor).T
    turn = np.zeros((len(gram), first.shape[1] + len(second)))
    turn[:single, : first.shape[1]] = first
    turn[:single, first.shape[1] :] = -first @ shared @ second
    turn[single:, first.shape[1] :] = second
    return turn, 2.0 * float(np.sum(np.log(np.diag(factor)))) - float(np.sum(np.log(prior)))


def _ridged(value: FloatArray, right: FloatArray, price: float) -> tuple[FloatArray, FloatArray]:
    """Reduction of y'Py and log det(1 + lambda C'PC), (m, lambdas), from eigenvalues and C'Py in their axes, (m, k).

    The last lambda is the free fit, at a price for each column.
    """
    grown = LAMBDAS * value[:, :, None]
    taken = np.sum(right[:, :, None] ** 2 * LAMBDAS / (1.0 + grown), axis=1)
    determinant = np.sum(np.log1p(grown), axis=1)
    determinant[:, -1] = price * value.shape[1]
    return np.asarray(taken), np.asarray(determinant)


# Candidates: what may change within a session of axis runs; effects of the catalogue, and smooth terms without a name.


#: Scan positions charged for the time constant of a warm-up (the columns are nearly alike), and for a drift at a
#: constant rate: in sessions this slow, most drifts are the beginning or the end of a warm-up.
WARMUP_SCANS, LINEAR_SCANS = 2.0, 4.0
#: Numbers of waves per session that are tried, and the scan positions charged for them (neighbours are nearly alike).
WAVES, WAVE_SCANS = np.concatenate([np.arange(0.5, 4.1, 0.25), np.arange(4.5, 10.1, 0.5)]), 10.0
#: Waves per run from which a swing can be confused with a reversal, and the share of a swing that must remain visible.
RUN_LIKE, LEAST_WAVE = 0.6, 0.3
#: Time constants of a fading jump, as shares of the session, and the maximum number of readings at which it may begin.
FADING, MOST_ONSETS = (0.07, 0.2), 150
#: Most columns of "every target of every run has a separate value", and the degree of the curve of a run.
MOST_OF_RUNS, CURVE = 60, 4
#: Windows of disturbed readings that are tried; if there are k times as many, only every k-th.
MOST_WINDOWS = 800
#: Scan positions charged at most for the setting of an effect of a logged column: neighbours are nearly alike.
MOST_LOGGED_SCANS = 6
#: Readings before and after a step within a run, at least.
LEAST_OF_STEP = 5
#: A step within a run is charged as this many scan positions each: outliers next to the end of a run are more common.
RARE = 8.0
#: Burst lengths (readings) that are tried; in bursts up to LONGEST_FREE each reading may have a separate value.
BURSTS, LONGEST_FREE = (1, 2, 3, 5, 8), 3


def candidates_of(session: AxisSession, only: Sequence[str] = ()) -> list[Candidate]:
    """Return all candidates to compare; ``only`` limits the names."""
    known = catalogue()
    warm = known["warmup_drift"]
    slow = [_candidate(session, warm.at(tau), WARMUP_SCANS) for tau in warm.positions(session.readings)]
    slow.append(_candidate(session, known["linear_drift"], LINEAR_SCANS))
    drifts = [item for item in slow if item is not None]
    found = [*drifts, *_disturbed(session, known), *_steps(session, known), *_logged(session, known)]
    found = [c for c in found if not only or c.name in only]
    return [*found, *_generic(session)]


def invisible_of(session: AxisSession) -> tuple[str, ...]:
    """Names that these runs cannot show: whatever is the same in every run is part of the curve of the axis."""
    letter = session.letter
    hidden = [f"periodic_{letter}"]
    seen = {candidate.name for candidate in _logged(session, catalogue())}
    hidden += [name for name in _logged_names(letter) if name not in seen]
    if not len(session.both):
        hidden += [f"backlash_{letter}", f"lost_motion_{letter}"]
    return tuple(hidden)


def _logged_names(letter: str) -> tuple[str, ...]:
    return (f"thermal_scale_{letter}", f"spindle_growth_{letter}", f"settling_{letter}", f"servo_lag_{letter}")


def _candidate(session: AxisSession, effect: Effect, scans: float, text: str = "") -> Candidate | None:
    columns = effect.columns(session.readings)
    if columns is None or not np.isfinite(columns).all():
        return None
    first, last = (int(effect.settings.get(key, -1)) for key in ("first", "last"))
    card = effect.card
    return Candidate(card.name, "named", columns, scans, text or card.title, card.covariates, effect, first, last)


def _steps(session: AxisSession, known: Mapping[str, Effect]) -> list[Candidate]:
    if not session.in_runs:
        return []
    step = known["step_between_runs"]
    found = []
    for k in range(1, len(session)):
        end, between = int(np.flatnonzero(session.leg == session.leg[k])[-1]), session.leg[k] != session.leg[k - 1]
        if not between and min(k, len(session) - k) < LEAST_OF_STEP:
            continue  # a few readings at an end that are off are disturbed, not a step
        where = session.window(k, end) if between else session.place(k)
        scans = _runs(session) if between else RARE * float(len(session))
        found.append(_candidate(session, step.at(float(k)), scans, f"step before {where}"))
    return [item for item in found if item is not None]


def _runs(session: AxisSession) -> float:
    """Scan positions charged for a step or a bad run: equal, so a bad first run and a step after it weigh the same."""
    return float(session.leg.max()) + 1.0


def _disturbed(session: AxisSession, known: Mapping[str, Effect]) -> list[Candidate]:
    """One run that is off, in one or both directions, and shorter bursts."""
    bad, burst = known["bad_run"], known["disturbed_readings"]
    runs = set() if not session.in_runs else {_ends(session.leg == k) for k in range(int(session.leg.max()) + 1)}
    runs |= {_ends(session.cycle == k) for k in range(int(session.cycle.max()) + 1)} if runs else set()
    runs = runs if len(runs) > 1 else set()
    found = []
    for first, last in sorted(runs):
        chosen = bad.with_settings({"first": float(first), "last": float(last)})
        item = _candidate(session, chosen, _runs(session), session.window(first, last))
        assert item is not None
        found.append(item)
        found.append(_free(item, len(session)))
    n, longest = len(session), max(int(np.bincount(session.leg).max()), len(session) // 10) - 1
    windows = [(k, k + size - 1) for size in BURSTS if size <= longest for k in range(n - size + 1)]
    windows = windows[:: max(1, len(windows) // MOST_WINDOWS)] if len(windows) > MOST_WINDOWS else windows
    windows = [window for window in windows if window not in runs]
    for first, last in windows:
        item = _candidate(
            session, burst.with_settings({"first": float(first), "last": float(last)}), len(windows),
            session.window(first, last),
        )  # fmt: skip
        assert item is not None
        found.append(item)
        if 1 < last - first + 1 <= LONGEST_FREE:
            found.append(_free(item, n))
    return found


def _free(item: Candidate, count: int) -> Candidate:
    """The same readings, each with a separate value; the session has ``count`` readings."""
    return replace(item, columns=np.eye(count, item.last - item.first + 1, -item.first), free=True)


def _ends(chosen: NDArray[np.bool_]) -> tuple[int, int]:
    rows = np.flatnonzero(chosen)
    return int(rows[0]), int(rows[-1])


def _logged(session: AxisSession, known: Mapping[str, Effect]) -> list[Candidate]:
    """Effects that need a logged temperature or dwell that changed between repeats."""
    found = []
    for name in _logged_names(session.letter):
        effect = known[name]
        positions = effect.positions(session.readings)
        every = [effect.at(p) for p in positions] if positions else [effect]
        for item in (_candidate(session, one, float(np.clip(len(every), 1, MOST_LOGGED_SCANS))) for one in every):
            if item is not None and _varies(session, item.columns):
                found.append(item)
    return found


def _varies(session: AxisSession, columns: FloatArray, least: float = 1e-3) -> bool:
    """Whether anything is left of the columns after subtracting the means of the cells."""
    count = np.bincount(session.cell)[:, None]
    means = np.stack([np.bincount(session.cell, column) for column in columns.T], axis=1) / count
    return bool(np.linalg.norm(columns - means[session.cell]) > least * np.linalg.norm(columns))


def _generic(session: AxisSession) -> list[Candidate]:
    t = session.time - session.time[0]
    t = 2.0 * t / t[-1] - 1.0
    s, way = session.s, session.direction.astype(np.float64)
    found = []

    def add(
        text: str,
        covariates: tuple[str, ...],
        columns: FloatArray,
        scans: float = 1.0,
        least: float = 1e-3,
    ) -> None:
        columns = columns.reshape(len(session), -1)
        columns = columns / np.maximum(np.sqrt(np.mean(columns**2, axis=0)), 1e-12)
        if columns.shape[1] and columns.shape[1] <= len(session) // 2 and _varies(session, columns, least):
            found.append(Candidate(text, "generic", columns, scans, text, covariates))

    add("the readings drift smoothly with time", ("time",), np.column_stack([t, t**2, t**3]))
    add("the readings drift smoothly with time", ("time",), np.column_stack([t, t**2]))
    for waves in WAVES.tolist():
        angle = np.pi * (t + 1) * waves
        text = f"the readings oscillate with time, about {waves:.3g} periods in the session"
        # a wave about as long as a run looks like a reversal; one of exactly that length is part of the axis curve
        as_run = waves > RUN_LIKE * (int(session.cycle.max()) + 1)
        columns = np.column_stack([np.sin(angle), np.cos(angle)])
        add(text, ("time", "approach") if as_run else ("time",), columns, WAVE_SCANS, LEAST_WAVE)
    saturating = [-np.expm1(-(t + 1) / 2 / tau) for tau in (0.2, 0.6)]
    for shape in (t, *saturating):
        add("the scale of the axis changes with time", ("time", "x"), shape * s, 3)
        add("the reversal changes with time", ("time", "approach"), shape * way, 3)
        own = _indicators(session.target)
        own = own - own.mean(axis=1, keepdims=True)
        add("each target drifts in its own way", ("time", "x"), shape[:, None] * own, 3)
    cycles, legs = _indicators(session.cycle), _indicators(session.leg)
    if cycles.shape[1] > 2 and session.in_runs:
        add("every run has a separate level", ("run",), cycles[:, 1:])
        add("every run has a separate slope", ("run", "x"), cycles * s[:, None])
        curve = np.polynomial.legendre.legvander(s, min(CURVE, len(session.targets_mm) - 1))[:, 1:]
        add("every run has a separate curve", ("run", "x"), _products(cycles, np.asarray(curve, dtype=np.float64)))
        if cycles.shape[1] * len(session.targets_mm) <= MOST_OF_RUNS:
            text = "both directions of a run agree, and differ from the other runs"
            add(text, ("run", "x"), _products(cycles, _indicators(session.target)))
    if legs.shape[1] > cycles.shape[1] and session.in_runs:
        add("every direction of every run has a separate level", ("run", "approach"), legs[:, 1:])
    number = np.arange(len(session), dtype=np.float64)
    onsets = range(1, len(session) - 1, max(1, len(session) // MOST_ONSETS))
    for k in onsets:
        for fades in FADING:
            shape = np.where(number >= k, np.exp(-np.maximum(number - k, 0.0) / (fades * len(session))), 0.0)
            text = f"a jump before {session.place(k)} that fades"
            add(text, ("time",), shape, len(FADING) * len(onsets))
    for k in (np.flatnonzero(np.diff(session.leg)) + 1).tolist():
        legs_count = int(session.leg.max())
        add(f"the scale changes at {session.place(k)}", ("time", "x"), _from(session, k) * s, legs_count)
        add(f"the reversal changes at {session.place(k)}", ("time", "approach"), _from(session, k) * way, legs_count)
    return found


def _products(first: FloatArray, second: FloatArray) -> FloatArray:
    """Every column of ``first`` times every column of ``second``."""
    return np.asarray((first[:, :, None] * second[:, None, :]).reshape(len(first), -1))


def _from(session: AxisSession, k: int) -> FloatArray:
    return (np.arange(len(session)) >= k).astype(np.float64)


def _indicators(number: IntArray) -> FloatArray:
    return np.asarray(np.eye(int(number.max()) + 1)[number])
