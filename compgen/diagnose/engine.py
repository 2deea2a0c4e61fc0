"""The engine of a diagnosis: generalised least squares with candidate columns, and the set that explains the readings.

    y = B b + S c + noise,   cov(noise) = sigma^2 V,   V_ij = (1 - w) phi^|t_i - t_j| + w 1[i = j]

B are the columns that are always there (means of cells, pose and machine), S those of the chosen candidates. A kind of
measurement contributes B, its candidates and its noise: a grid of (phi, w), or independent readings of a known or
unknown sigma. The likelihood is computed from the contrasts in which B cancels (REML), with sigma in closed form unless it
is known, and summed over the grid: wandering noise and a wandering effect are weighed against each other, not in sequence.
The criterion of a set S is 2 log likelihood minus a penalty for every member; the thresholds are calibrated with
simulated sessions without any effect (docs/diagnosis-benchmark.md). An effect with one parameter is fitted freely; the
coefficients of several columns have a normal prior of variance lambda sigma^2; otherwise they could explain everything.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from compgen.data.csv_files import FloatArray
from compgen.diagnose.layout import IntArray
from compgen.effects import Effect
from compgen.kinematics.kernel_switch import lapack

#: Named effects, what has no name, and names of which too little is seen to choose them: only alternatives to others.
Tier = Literal["named", "generic", "hidden"]

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
#: What every name beyond the first must gain to replace an unnamed smooth term: two events that happen to cancel or to
#: follow each other are less likely than one.
MORE_NAMES = 4.0
#: What readings with a separate value each must gain in addition to what a common offset must.
FREE_HANDICAP = 6.0
#: Gain in twice the log likelihood beyond the penalty that a small effect beside a large one needs, and its share.
LEAST_BESIDE, SMALL_BESIDE = 12.0, 0.2
#: Names whose criterion is within this of the best are reported as alternatives (99 %).
ALIAS = 9.2


@dataclass(frozen=True)
class Candidate:
    """Columns (n, k) that may be added; ``first`` ... ``last`` are the readings covered by a disturbance.

    ``scans`` is the number of scan positions (time constants, boundaries, windows) from which this one was chosen. Of the
    candidates with the same ``only_one``, if any, a set contains one at most. ``free``: a value for each reading.
    ``process``: columns of a random process, which are never fitted without their prior.
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
    only_one: str = ""
    process: bool = False

    def penalty(self, freedom: int) -> float:
        """Gain in twice the log likelihood that the columns must exceed."""
        scan = 2.0 * float(np.log(self.scans))
        if self.columns.shape[1] == 1 and self.tier != "generic":
            return float(np.log(freedom)) + scan
        own = float(np.log(freedom)) if self.columns.shape[1] == 1 else 2.0
        return own + scan + (GENERIC_HANDICAP if self.tier == "generic" else FREE_HANDICAP)


class NoiseGrid:
    """Inverse covariances of the noise for every (phi, w); sigma is 1.

    Noise with memory is a Markov chain: the inverse T of K_ij = phi^|t_i - t_j| is tridiagonal. With V = a K + b I,
    inv(V) = inv(a I + b T) T is applied to a vector in O(n) operations; no covariance is ever inverted.

    Parameters
    ----------
    apart : intervals between neighbouring readings in their order, in units of the usual one, (n - 1,).
    base : columns that are always fitted, of full rank, (n, p).
    points : (phi, w) to compare; (0, 0) are independent readings.
    sigma_mm : standard deviation of a reading if it is known, mm.
    """

    def __init__(
        self,
        apart: FloatArray,
        base: FloatArray,
        points: Sequence[tuple[float, float]] | None = None,
        sigma_mm: float | None = None,
    ) -> None:
        n, self.base, self.sigma_mm = len(base), base, sigma_mm
        self.freedom = n - base.shape[1]
        self.points = list(points or [(phi, w) for phi in PHI for w in (WHITE if phi else (0.0,))])
        self._bands = [_bands(apart, phi, w) for phi, w in self.points]
        #: inv(V) B and inv(B' inv(V) B), to remove the base from a vector.
        self._right, self._middle = [], []
        constant = []
        for point, (_, _, determinant) in enumerate(self._bands):
            right = self.solve(point, base)
            middle = base.T @ right
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
        found = self.solve(point, np.eye(len(self.base)))
        return 0.5 * (found + found.T)

    def free(self, point: int, columns: FloatArray) -> FloatArray:
        """P times columns (n, k); P is inv(V) with the base projected out."""
        right = self._right[point]
        return self.solve(point, columns) - right @ (self._middle[point] @ (right.T @ columns))

    def projector(self, point: int) -> FloatArray:
        """P, (n, n)."""
        right = self._right[point]
        return self.inverse(point) - right @ (self._middle[point] @ right.T)

    def log_likelihood(self, square: FloatArray, extra: FloatArray) -> FloatArray:
        """Log likelihood (...) summed over the grid, for y'Py and extra log determinants of shape (points, ...)."""
        shape = (-1, *([1] * (square.ndim - 1)))
        own = -0.5 * self._misfit(square) - 0.5 * (extra + self.constant.reshape(shape))
        return np.asarray(logsumexp(own + self.prior.reshape(shape), axis=0))

    def log_likelihoods(self, square: FloatArray) -> FloatArray:
        """Log likelihood at each grid point, (points,), for y'Py (points,)."""
        return np.asarray(-0.5 * self._misfit(square) - 0.5 * self.constant + self.prior)

    def _misfit(self, square: FloatArray) -> FloatArray:
        """Minus twice the log likelihood of y'Py, without its constant; sigma in closed form unless it is known."""
        if self.sigma_mm is not None:
            return np.asarray(square / self.sigma_mm**2)
        return np.asarray(self.freedom * np.log(square / self.freedom))

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

    def __init__(self, value_mm: FloatArray, grid: NoiseGrid, candidates: Sequence[Candidate], least_mm: float) -> None:
        self.y, self.grid, self.candidates = value_mm, grid, list(candidates)
        #: Least y'Py: no scatter is assumed to be smaller than the resolution.
        self.floor = grid.freedom * least_mm**2
        self._only_one = np.array([c.only_one for c in self.candidates], dtype=np.str_)
        self._named = np.array([c.tier == "named" for c in self.candidates], dtype=bool)
        self._generic = np.array([c.tier == "generic" for c in self.candidates], dtype=bool)
        self._freely = np.array([c.tier == "generic" and not c.process for c in self.candidates], dtype=bool)
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
            return np.zeros((len(self.y), 0))
        return np.hstack([self.candidates[k].columns for k in members])

    def square(self, members: Sequence[int]) -> FloatArray:
        """Return y'Py (points,) with the members fitted, never below the resolution."""
        return np.asarray(np.maximum(self._state(members).square, self.floor))

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
        square = np.maximum(state.square, self.floor)
        return 2.0 * float(self.grid.log_likelihood(square, state.determinant))

    def gains(self, members: Sequence[int]) -> FloatArray:
        """Gain of every candidate when added to a set: increase of twice the log likelihood, (candidates,)."""
        state = self._state(members)
        square = np.maximum(state.square, self.floor)
        base = 2.0 * float(self.grid.log_likelihood(square, state.determinant))
        found = np.zeros(len(self.candidates))
        for number, block in enumerate(self._blocks):
            parts = [self._explained(state, number, p) for p in range(len(square))]
            taken = np.stack([part[0] for part in parts])  # (points, m, lambdas)
            more = np.stack([part[1] for part in parts]) + state.determinant[:, None, None]
            value = self.grid.log_likelihood(np.maximum(square[:, None, None] - taken, self.floor), more)
            if value.shape[1] > len(LAMBDA):
                value[~self._freely[block.rows], -1] = -np.inf
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

    def alternatives(
        self, criteria: FloatArray, member: int, plausible: Callable[[int], bool] = lambda _: True
    ) -> tuple[tuple[str, float], ...]:
        """Names that explain the readings nearly as well as a member, with their weights; ``criteria`` beside the others."""
        best: dict[str, float] = {}
        for k, candidate in enumerate(self.candidates):
            near = candidate.tier != "generic" and criteria[member] - criteria[k] < ALIAS
            if near and (candidate.name == self.candidates[member].name or plausible(k)):
                best[candidate.name] = max(best.get(candidate.name, -np.inf), float(criteria[k]))
        weights = {name: float(np.exp(0.5 * (value - criteria[member]))) for name, value in best.items()}
        total = sum(weights.values())
        own = self.candidates[member].name
        ranked = sorted(weights.items(), key=lambda entry: (-entry[1], entry[0] != own))
        return tuple((name, value / total) for name, value in ranked if value / total >= 0.01 or name == own)

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
        everything = np.array([c.tier != "hidden" for c in self.candidates], dtype=bool)
        results = []

        def keep(members: list[int]) -> None:
            # criterion of the set, minus a charge because several names at once are unlikely
            named = sum(self.candidates[k].tier == "named" for k in members)
            results.append((self.total(members) - MORE_NAMES * max(named - 1, 0), members, dict(self._lambda)))

        keep(self._grown(self._grown([], self._named, most), everything, most))
        keep(self._grown([], everything, most))
        gains = np.where(self._generic, self.criteria([])[1], -np.inf)
        starts: dict[str, int] = {}
        for k in np.argsort(-gains, kind="stable").tolist():
            if gains[k] > LEAST_GAIN and len(starts) < STARTS and most > 1:
                starts.setdefault(self.candidates[k].name.partition(" at ")[0], k)
        for k in starts.values():
            self._choose([], k)
            keep(self._grown([k], everything, most))
        if most > 1:
            for k in self.further_starts(_first_of(results)[1]):
                keep(self._grown([k], self._named, most))
        _, members, self._lambda = _first_of(results)
        return members

    def further_starts(self, members: Sequence[int]) -> list[int]:
        """Candidates from which one more search each is started, given the best set so far; none unless a kind has some."""
        return []

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
        """Criteria of the candidates that may join the members."""
        criteria = np.where(allowed, self.criteria(members)[1], -np.inf)
        for kind in {self.candidates[k].only_one for k in members} - {""}:
            criteria[self._only_one == kind] = -np.inf
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


class Fit:
    """The members of a set, fitted together with the base, weighted over the grid of the noise."""

    def __init__(self, search: Search, members: Sequence[int]) -> None:
        self.search, self.members, self.grid = search, list(members), search.grid
        self.columns = search.columns_of(members)
        if self.grid.freedom - self.columns.shape[1] < 1:
            self.weights = np.zeros(len(self.grid.points))
            self.weights[0], self.freedom, self.sigma_mm, self.phi = 1.0, 0, float("nan"), 0.0
            self.square = np.full(len(self.grid.points), np.nan)
            return
        self.square = search.square(members)
        self.weights = self.grid.weights(self.square)
        self.freedom = max(self.grid.freedom - self.columns.shape[1], 1)
        self.sigma_mm = float(np.sqrt(self.weights @ self.square / self.freedom))
        points = np.array(self.grid.points)
        self.phi = float(self.weights @ (points[:, 0] * (1.0 - points[:, 1])))

    @property
    def names(self) -> list[str]:
        """Names of the members."""
        return [self.search.candidates[k].name for k in self.members]

    def estimate(self, columns: FloatArray, extra: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values and covariance of ``extra`` (n, k), fitted with ``columns`` (n, m), both weighted over the grid."""
        design = np.hstack([columns, extra])
        value, square, total = np.zeros(extra.shape[1]), np.zeros((extra.shape[1],) * 2), []
        for point, (weight, rss) in enumerate(zip(self.weights, self.square, strict=True)):
            if weight < 1e-4:
                continue
            pulled = self.grid.solve(point, design)
            inverse = np.linalg.pinv(design.T @ pulled, rcond=1e-10, hermitian=True)
            fitted = (inverse @ (pulled.T @ self.search.y))[-extra.shape[1] :]
            value += weight * fitted
            variance = self.grid.sigma_mm**2 if self.grid.sigma_mm is not None else rss / max(self.freedom, 1)
            square += weight * inverse[-extra.shape[1] :, -extra.shape[1] :] * variance
            total.append((weight, fitted))
        square += sum(w * np.outer(f - value, f - value) for w, f in total)
        return value, square
