"""What changes with time in the runs of one axis: noise with a memory, candidates, and the set of them that explains it.

    y = cell means + S c + noise,   cov(noise) = sigma^2 V,   V_ij = (1 - w) phi^|t_i - t_j| + w 1[i = j]

The likelihood is that of the contrasts in which the cell means cancel (REML), sigma in closed form, summed over a grid of
(phi, w): noise that wanders and an effect that wanders are weighed against each other and not fitted one after the other.
A set S is judged by 2 log likelihood less a penalty for every member; the thresholds are calibrated by simulated
sessions without any effect (docs/diagnosis-benchmark.md). An effect of one parameter is fitted freely; coefficients of
several columns have a normal distribution of width lambda sigma, so that many columns cannot explain everything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from compgen.core.csvio import FloatArray
from compgen.diagnose.axis_session import AxisSession
from compgen.effects import Effect

Tier = Literal["named", "generic"]

#: Correlation of neighbouring readings, and share of white noise beside the part with a memory.
PHI = (0.0, 0.25, 0.5, 0.7, 0.83, 0.92, 0.98)
WHITE = (0.0, 0.4, 0.8)
#: Readings of resolution: residuals are never taken to be smaller than this, mm.
LEAST_MM = 2e-6
#: Variances over sigma^2 that the coefficients of several columns may have.
LAMBDA = np.array([2.0, 20.0, 200.0, 2000.0])
#: Names of slow drifts.
DRIFTS = ("warmup_drift", "linear_drift")
#: Smallest share of a column that must be left beside the means and the other members.
LEAST_SEEN = 1e-3
#: Improvement of the criterion that a member must bring.
LEAST_GAIN = 5.5
#: What a smooth term without a name must bring beyond a name.
GENERIC_HANDICAP = 8.0
#: The same for levels of whole runs, which two names together (a warm-up and a bad run) explain nearly as well.
RUN_HANDICAP = 14.0
#: What readings with a value of their own each must bring beyond a common offset.
FREE_HANDICAP = 6.0


@dataclass(frozen=True)
class Candidate:
    """Columns (n, k) that may be added; ``first`` ... ``last`` are the readings that a disturbance covers.

    ``scans`` counts the positions (time constants, boundaries, windows) among which this one was chosen.
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
    handicap: float = GENERIC_HANDICAP

    def penalty(self, freedom: int) -> float:
        """Twice the log likelihood that the columns have to bring before they count."""
        scan = 2.0 * float(np.log(self.scans))
        if self.columns.shape[1] == 1 and self.tier == "named":
            return float(np.log(freedom)) + scan
        own = float(np.log(freedom)) if self.columns.shape[1] == 1 else 2.0
        return own + scan + (self.handicap if self.tier == "generic" else FREE_HANDICAP)


class NoiseGrid:
    """Inverse covariances of the noise for every (phi, w), freed from the cell means; sigma is 1."""

    def __init__(self, session: AxisSession) -> None:
        step = session.time / (np.median(np.diff(session.time)) if session.timed else 1.0)
        apart = np.abs(step[:, None] - step[None, :])
        n = len(session)
        cells = np.zeros((n, int(session.cell.max()) + 1))
        cells[np.arange(n), session.cell] = 1.0
        self.freedom = n - cells.shape[1]
        self.points = [(phi, w) for phi in PHI for w in (WHITE if phi else (0.0,))]
        inverse, free, constant, prior = [], [], [], []
        for phi, w in self.points:
            v = (1.0 - w) * phi**apart + w * np.eye(n) if phi else np.eye(n)
            v[np.diag_indices(n)] += 1e-9
            own = np.linalg.inv(v)
            middle = cells.T @ own @ cells
            right = own @ cells
            inverse.append(own)
            free.append(own - right @ np.linalg.solve(middle, right.T))
            constant.append(np.linalg.slogdet(v)[1] + np.linalg.slogdet(middle)[1])
            prior.append(-np.log(len(PHI)) - (np.log(len(WHITE)) if phi else 0.0))
        self.inverse, self.free = np.array(inverse), np.array(free)
        self.constant, self.prior = np.array(constant), np.array(prior)
        self.cells = cells

    def log_likelihood(self, square: FloatArray, extra: FloatArray) -> FloatArray:
        """Log likelihood (...) summed over the grid, for y'Py and further log determinants of shape (points, ...)."""
        shape = (-1, *([1] * (square.ndim - 1)))
        own = -0.5 * self.freedom * np.log(square / self.freedom) - 0.5 * (extra + self.constant.reshape(shape))
        return np.asarray(logsumexp(own + self.prior.reshape(shape), axis=0))

    def weights(self, square: FloatArray) -> FloatArray:
        """Posterior weight of every point of the grid, (points,), for y'Py (points,)."""
        own = -0.5 * self.freedom * np.log(square / self.freedom) - 0.5 * self.constant + self.prior
        return np.asarray(np.exp(own - logsumexp(own)))


def without(projector: FloatArray, columns: FloatArray, ridge: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Free projectors (points, n, n) from columns (n, k); with ``ridge`` = 1 / lambda also log det(1 + lambda C'PC)."""
    if not columns.shape[1]:
        return projector, np.zeros(len(projector))
    right = projector @ columns
    middle = columns.T @ right
    middle = 0.5 * (middle + middle.transpose(0, 2, 1))
    determinant = np.zeros(len(projector))
    if ridge:
        middle = middle + ridge * np.eye(columns.shape[1])
        determinant = np.linalg.slogdet(middle / ridge)[1]
    inverse = np.linalg.pinv(middle, rcond=1e-10, hermitian=True)
    return np.asarray(projector - right @ inverse @ right.transpose(0, 2, 1)), determinant


class Search:
    """Looks for the set of candidates that explains the readings."""

    def __init__(self, session: AxisSession, grid: NoiseGrid, candidates: Sequence[Candidate]) -> None:
        self.session, self.grid, self.candidates = session, grid, list(candidates)
        self.y = session.deviation_mm - session.deviation_mm.mean()
        self._drifts = np.array([c.name in DRIFTS for c in self.candidates], dtype=bool)
        sizes = np.array([c.columns.shape[1] for c in self.candidates], dtype=np.int64)
        #: Candidates of k columns: their numbers (m,) and columns (n, m, k).
        self._blocks = [
            (rows, np.stack([self.candidates[r].columns for r in rows], axis=1))
            for rows in (np.flatnonzero(sizes == k) for k in np.unique(sizes))
        ]
        #: Variance over sigma^2 of members of several columns, from when they were first chosen.
        self._lambda: dict[int, float] = {}
        self._best_lambda: dict[int, float] = {}
        self._known: dict[frozenset[int], tuple[FloatArray, FloatArray]] = {}

    def columns_of(self, members: Sequence[int]) -> FloatArray:
        """Columns of some candidates side by side, (n, k)."""
        if not members:
            return np.zeros((len(self.session), 0))
        return np.hstack([self.candidates[k].columns for k in members])

    def square(self, projector: FloatArray) -> FloatArray:
        """Return y'Py (points,), never below the resolution."""
        own = np.einsum("i,pij,j->p", self.y, projector, self.y)
        return np.asarray(np.maximum(own, self.grid.freedom * LEAST_MM**2))

    def state(self, members: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Projectors beside some members, and the log determinants of those of several columns."""
        single = [k for k in members if self.candidates[k].columns.shape[1] == 1]
        projector, total = without(self.grid.free, self.columns_of(single))
        for k in members:
            if k not in single:
                projector, own = without(projector, self.candidates[k].columns, 1.0 / self._lambda.get(k, LAMBDA[1]))
                total = total + own
        return projector, total

    def level(self, members: Sequence[int]) -> float:
        """Twice the log likelihood of a set."""
        projector, extra = self.state(members)
        return 2.0 * float(self.grid.log_likelihood(self.square(projector), extra))

    def gains(self, members: Sequence[int]) -> FloatArray:
        """What every candidate brings beside a set: rise of twice the log likelihood, (candidates,)."""
        projector, extra = self.state(members)
        square = self.square(projector)
        base = 2.0 * float(self.grid.log_likelihood(square, extra))
        floor = self.grid.freedom * LEAST_MM**2
        found = np.zeros(len(self.candidates))
        for rows, columns in self._blocks:
            parts = [_explained(own, self.y, columns) for own in projector]
            taken = np.stack([part[0] for part in parts])  # (points, m, lambdas)
            more = np.stack([part[1] for part in parts]) + extra[:, None, None]
            value = self.grid.log_likelihood(np.maximum(square[:, None, None] - taken, floor), more)
            found[rows] = 2.0 * value.max(axis=1) - base
            if columns.shape[2] > 1:
                for k, best in zip(rows.tolist(), LAMBDA[value.argmax(axis=1)].tolist(), strict=True):
                    if k not in members:
                        self._best_lambda[k] = best
        return found

    def criteria(self, members: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Gain and gain less penalty of every candidate beside a set."""
        key = frozenset(members)
        if key not in self._known:
            self._known[key] = self._criteria(sorted(members))
        return self._known[key]

    def _criteria(self, members: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        gains = self.gains(members)
        penalties = np.array([c.penalty(self.grid.freedom) for c in self.candidates])
        return gains, gains - penalties

    def total(self, members: Sequence[int]) -> float:
        """Criterion of a set against the empty one; every member pays by what it brings beside those before it."""
        value, before = 0.0, self.level([])
        for count in range(1, len(members) + 1):
            now = self.level(members[:count])
            value += (now - before) - self.candidates[members[count - 1]].penalty(self.grid.freedom)
            before = now
        return value

    def run(self, most: int) -> list[int]:
        """Return the best set: names first and then all, or all from the start, whichever explains more."""
        named = np.array([c.tier == "named" for c in self.candidates])
        first = self._grown([], named, most)
        found = self._grown(first, np.ones(len(named), dtype=bool), most)
        other = self._grown([], np.ones(len(named), dtype=bool), most)
        return max((found, other), key=self.total)

    def _grown(self, members: list[int], allowed: NDArray[np.bool_], most: int) -> list[int]:
        """Forward steps, and after each of them every member is exchanged if another suits better beside the rest."""
        while len(members) < most:
            best, criterion = self._best(members, allowed)
            if criterion < LEAST_GAIN:
                break
            self._lambda.setdefault(best, self._best_lambda.get(best, float(LAMBDA[1])))
            grown = self._exchanged([*members, best], allowed)
            if len(grown) <= len(members) and self.total(grown) <= self.total(members):
                break
            members = grown
        return members

    def _open(self, members: Sequence[int], allowed: NDArray[np.bool_]) -> FloatArray:
        """Criteria beside some members; a session has one drift with a name at most."""
        criteria = np.where(allowed, self.criteria(members)[1], -np.inf)
        if any(self._drifts[k] for k in members):
            criteria[self._drifts] = -np.inf
        return criteria

    def _best(self, members: Sequence[int], allowed: NDArray[np.bool_]) -> tuple[int, float]:
        criteria = self._open(members, allowed)
        best = int(np.argmax(criteria))
        return best, float(criteria[best])

    def _exchanged(self, members: list[int], allowed: NDArray[np.bool_]) -> list[int]:
        for _ in range(3):
            changed = False
            for member in list(members):
                rest = [k for k in members if k != member]
                criteria = self._open(rest, allowed)
                best = int(np.argmax(criteria))
                if criteria[best] < LEAST_GAIN:
                    members, changed = rest, True
                elif best != member and criteria[best] > criteria[member] + 1e-6:
                    self._lambda.setdefault(best, self._best_lambda.get(best, float(LAMBDA[1])))
                    members, changed = [*rest, best], True
            if not changed or len(members) < 2:
                break
        return members


def _explained(projector: FloatArray, y: FloatArray, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What candidates of k columns (n, m, k) take off y'Py, and log det(1 + lambda C'PC), (m, lambdas).

    One column is fitted freely (one lambda, no determinant) if enough of it can be seen.
    """
    n, count, k = columns.shape
    flat = columns.reshape(n, count * k)
    right = (projector @ y @ flat).reshape(count, k)
    pulled = (projector @ flat).reshape(n, count, k)
    if k == 1:
        size = np.einsum("nmk,nmk->m", columns, pulled)
        seen = size > LEAST_SEEN * np.einsum("nmk,nmk->m", columns, columns) * max(np.trace(projector) / n, 1e-12)
        taken = np.where(seen, right[:, 0] ** 2 / np.where(seen, size, 1.0), 0.0)
        return taken[:, None], np.zeros((count, 1))
    value, vector = np.linalg.eigh(np.einsum("nmk,nml->mkl", columns, pulled))
    turned = np.einsum("mkl,mk->ml", vector, right)
    value = np.maximum(value, 0.0)[:, :, None]
    taken = np.sum(turned[:, :, None] ** 2 * LAMBDA / (1.0 + LAMBDA * value), axis=1)
    return np.asarray(taken), np.asarray(np.sum(np.log1p(LAMBDA * value), axis=1))
