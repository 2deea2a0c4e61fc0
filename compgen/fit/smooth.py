"""The smoother: minimise sum(w (c - y)^2) + mu |D2 c|^2 with the curve held at zero, in banded form.

The held functionals are eliminated: each gives one node as a multiple of another one (or as zero), c = Z x. The
matrix A = Z^T W Z + mu Z^T D^T D Z keeps a half-bandwidth of at most 4 and Z^T W Z stays diagonal. An eliminated
unknown keeps its place in the arrays, with 1 on the diagonal and 0 beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.linalg import cho_solve_banded, cholesky_banded, eigvals_banded

from compgen.core.csvio import FloatArray
from compgen.fit.held import Row

#: One elimination: c[node] = factor * c[other], or zero for other = None.
Step = tuple[int, int | None, float]
_BAND = 4
_BLOCK = 512
#: Refinement ends when a step is smaller than this fraction, and after this many steps: it gains 2 digits or more each.
_SETTLED, _REFINEMENTS = 1e-12, 6
#: mu times the largest eigenvalue of the penalty is kept below this, so that 2 digits and the refinement remain.
_LARGEST_SPREAD = 1e14


def second_difference(position_mm: FloatArray) -> FloatArray:
    """Coefficients (n - 2, 3) of D2 on nodes (n,): row k acts on c[k], c[k+1], c[k+2].

    With the steps p, q beside a node and the mean spacing h, row = sqrt(h^3 (p + q)/2) * 2/(p + q) *
    (slope after - slope before). On even nodes this is the plain 1, -2, 1; on others |D2 c|^2 stays the sum that
    approaches h^3 times the integral of c''^2, however the nodes are spread.
    """
    step = np.diff(position_mm)
    before, after = step[:-1], step[1:]
    scale = np.sqrt(2 * np.mean(step) ** 3 / (before + after)) if len(before) else before
    return np.stack([scale / before, -scale / before - scale / after, scale / after], axis=1)


def eliminate(rows: tuple[Row, ...]) -> tuple[Step, ...]:
    """Turn functionals that must vanish into eliminations, each by its largest factor; a redundant one is left out."""
    steps: list[Step] = []
    for row in rows:
        factors: dict[int, float] = {}
        for node, factor in row:
            _add_through(factors, node, factor, steps)
        if not factors or max(map(abs, factors.values())) < 1e-12:
            continue
        pivot = max(factors, key=lambda node: abs(factors[node]))
        others = [node for node in factors if node != pivot and factors[node] != 0]
        steps.append((pivot, others[0], -factors[others[0]] / factors[pivot]) if others else (pivot, None, 0.0))
    return tuple(steps)


def _add_through(factors: dict[int, float], node: int, factor: float, steps: list[Step]) -> None:
    """Add ``factor`` times c[node], written in what earlier eliminations left."""
    for pivot, other, share in steps:
        if node == pivot:
            if other is None:
                return
            node, factor = other, factor * share
    factors[node] = factors.get(node, 0.0) + factor


def _penalty_band(rows: FloatArray, n: int) -> FloatArray:
    """D^T D as a lower band (5, n): entry [d, k] couples k and k + d."""
    band = np.zeros((_BAND + 1, n))
    for i in range(3):
        for j in range(i, 3):
            band[j - i, i : n - 2 + i] += rows[:, i] * rows[:, j]
    return band


def _eliminate_in_band(band: FloatArray, step: Step) -> None:
    """Replace the symmetric band matrix B by T^T B T, T being one elimination; row and column of the node become 0."""
    node, other, share = step
    ends = (node, node if other is None else other)
    low, high = max(0, min(ends) - _BAND), min(band.shape[1], max(ends) + _BAND + 1)
    size = high - low
    window = np.zeros((size, size))
    for d in range(min(_BAND + 1, size)):
        window[np.arange(d, size), np.arange(size - d)] = band[d, low : high - d]
    window += np.tril(window, -1).T
    turn = np.eye(size)
    turn[node - low, node - low] = 0.0
    if other is not None:
        turn[node - low, other - low] = share
    window = turn.T @ window @ turn
    for d in range(min(_BAND + 1, size)):
        band[d, low : high - d] = np.diagonal(window, -d)


@dataclass(frozen=True)
class Smoother:
    """One grid of n nodes with weights and held functionals; solves for any mu and any number of curves.

    ``weight`` (n,) is dimensionless with a mean near 1; ``rows`` the coefficients of D2 (n - 2, 3); ``steps`` the
    eliminations; ``free_weight`` (n,) the diagonal of Z^T W Z and ``penalty`` (5, n) the band of Z^T D^T D Z.
    """

    weight: FloatArray
    rows: FloatArray
    steps: tuple[Step, ...]
    free_weight: FloatArray
    penalty: FloatArray

    @classmethod
    def build(cls, position_mm: FloatArray, weight: FloatArray, held: tuple[Row, ...]) -> Smoother:
        """Prepare the smoother for nodes (n,), weights (n,) and the functionals that must stay zero."""
        rows, steps = second_difference(position_mm), eliminate(held)
        penalty = _penalty_band(rows, len(position_mm))
        free_weight = weight.copy()
        for step in steps:
            _eliminate_in_band(penalty, step)
            node, other, share = step
            if other is not None:
                free_weight[other] += share**2 * free_weight[node]
            free_weight[node] = 1.0
        return cls(weight, rows, steps, free_weight, penalty)

    @property
    def unknowns(self) -> int:
        """Number of free unknowns: nodes less held functionals."""
        return len(self.weight) - len(self.steps)

    @property
    def rank(self) -> int:
        """Rank of the penalty among the free unknowns."""
        return min(len(self.rows), self.unknowns)

    @cached_property
    def eigenvalues(self) -> FloatArray:
        """Eigenvalues (unknowns,) of the penalty against the weights, ascending; those of straight lines are 0.

        With these g, log|A| = log|Z^T W Z| + sum(log(1 + mu g)) and the trace of the smoother is sum(1/(1 + mu g)).
        """
        root = 1 / np.sqrt(self.free_weight)
        scaled = np.zeros_like(self.penalty)
        for d in range(min(_BAND + 1, len(root))):
            scaled[d, : len(root) - d] = self.penalty[d, : len(root) - d] * root[d:] * root[: len(root) - d]
        values = eigvals_banded(scaled[: len(root)], lower=True)
        found: FloatArray = np.zeros(self.unknowns)
        if self.rank:
            found[-self.rank :] = np.maximum(values[-self.rank :], 0.0)
        return found

    @property
    def largest_mu(self) -> float:
        """Weight beyond which a curve is straight for all purposes; larger ones are taken as this."""
        top = float(self.eigenvalues[-1]) if self.rank else 0.0
        if top == 0:
            return 0.0
        lowest = max(float(self.eigenvalues[-self.rank]), top * 1e-13)
        return min(1e4 / lowest, _LARGEST_SPREAD / top)

    def bend(self, c: FloatArray) -> FloatArray:
        """D2 c for curves (n, k): shape (n - 2, k)."""
        first, middle, last = self.rows.T[:, :, None]
        return np.asarray(first * c[:-2] + middle * c[1:-1] + last * c[2:])

    def _bend_transposed(self, v: FloatArray) -> FloatArray:
        out = np.zeros((len(self.weight), v.shape[1]))
        out[:-2] += self.rows[:, [0]] * v
        out[1:-1] += self.rows[:, [1]] * v
        out[2:] += self.rows[:, [2]] * v
        return out

    def expand(self, x: FloatArray) -> FloatArray:
        """Z x for unknowns (n, k): the curves, exactly zero at held nodes."""
        c = x.copy()
        for node, other, share in reversed(self.steps):
            c[node] = 0.0 if other is None else share * c[other]
        return c

    def gather(self, g: FloatArray) -> FloatArray:
        """Z^T g for node quantities (n, k)."""
        out = g.copy()
        for node, other, share in self.steps:
            if other is not None:
                out[other] += share * out[node]
            out[node] = 0.0
        return out

    def apply(self, mu: float, c: FloatArray) -> FloatArray:
        """Z^T (W c + mu D^T D c) for curves (n, k), without forming the product of the second differences."""
        return self.gather(self.weight[:, None] * c + mu * self._bend_transposed(self.bend(c)))

    def factor(self, mu: float) -> FloatArray:
        """Banded Cholesky factor of A."""
        width = 1 + (2 if all(other is None for _, other, _ in self.steps) else _BAND)
        band = mu * self.penalty[: min(width, len(self.weight))]
        band[0] += self.free_weight
        return np.asarray(cholesky_banded(band, lower=True, check_finite=False))

    def inverse(self, mu: float, gathered: FloatArray) -> FloatArray:
        """Z A^-1 g for gathered right-hand sides (n, k): curves (n, k), refined against the product form of A."""
        factor = (self.factor(mu), True)
        x = cho_solve_banded(factor, gathered, check_finite=False)
        for _ in range(_REFINEMENTS):
            rest = gathered - self.apply(mu, self.expand(x))
            step = cho_solve_banded(factor, rest, check_finite=False)
            x = x + step
            if np.abs(step).max(initial=0.0) <= _SETTLED * np.abs(x).max(initial=0.0):
                break
        return self.expand(x)

    def solve(self, mu: float, y: FloatArray) -> FloatArray:
        """Fitted curves (n, k) for data (n, k)."""
        return self.inverse(mu, self.load(y))

    def load(self, y: FloatArray) -> FloatArray:
        """Z^T W y, the right-hand side for data (n, k)."""
        return self.gather(self.weight[:, None] * y)

    def misfit(self, residual: FloatArray) -> float:
        """Weighted square sum of residuals (n,)."""
        return float(np.sum(self.weight * residual**2))

    def costs(self, y: FloatArray) -> Callable[[float], tuple[float, float]]:
        """Return the function of mu that gives the weighted square sum of y - c and |D2 c|^2 of the fitted curve c."""

        def at(mu: float) -> tuple[float, float]:
            c = self.solve(mu, y[:, None])
            return self.misfit(y - c[:, 0]), float(np.sum(self.bend(c) ** 2))

        return at

    def inverse_root(self, mu: float) -> FloatArray | None:
        """F (n, m) with F F^T = Z A^-1 Z^T where it is at hand; None here, where only bands are."""
        return None

    def matrix(self, mu: float) -> sp.csc_array:
        """A (n, n) with 1 on the diagonal of eliminated unknowns."""
        n = len(self.weight)
        band = mu * self.penalty
        band[0] += self.free_weight
        lower: Any = sp.dia_array((band, -np.arange(len(band))), shape=(n, n))
        middle: Any = sp.dia_array((band[:1], [0]), shape=(n, n))
        return sp.csc_array(lower + lower.T - middle)

    def columns(self, mu: float) -> Iterator[tuple[slice, FloatArray]]:
        """Yield the smoother's matrix S (c = S y) in blocks of columns: (which, (n, block))."""
        n = len(self.weight)
        for start in range(0, n, _BLOCK):
            picked = slice(start, min(start + _BLOCK, n))
            unit = np.zeros((n, picked.stop - start))
            unit[np.arange(start, picked.stop), np.arange(picked.stop - start)] = 1.0
            yield picked, self.solve(mu, unit)

    def degrees_of_freedom(self, mu: float) -> float:
        """Effective degrees of freedom: trace of the smoother over the free unknowns."""
        return float(np.sum(1 / (1 + mu * self.eigenvalues)))

    def residual_degrees(self, mu: float) -> float:
        """Expected weighted square sum of the residuals of noise of unit weight: trace of (1 - S)^2."""
        damped = mu * self.eigenvalues
        return float(np.sum((damped / (1 + damped)) ** 2))
