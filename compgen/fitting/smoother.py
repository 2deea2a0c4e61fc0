"""The penalised smoother of one curve, the choice of its smoothness, and correlated nodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.names import CURVE_NAMES
from compgen.errors import InputError, Message, nearest
from compgen.fitting.zeroing import SAME_POSITION_MM, FixedCurve, Row
from compgen.identification.covariance import Covariance
from compgen.kinematics.kernel_switch import lapack

if TYPE_CHECKING:
    from scipy.sparse import csc_array

# The smoother: minimise sum(w (c - y)^2) + mu |D2 c|^2 with the fixed functionals at zero, in banded form.
#
# The fixed functionals are eliminated: each gives one node as a multiple of another one (or as zero), c = Z x. The
# matrix A = Z^T W Z + mu Z^T D^T D Z keeps a half-bandwidth of at most 4 and Z^T W Z stays diagonal. An eliminated
# unknown keeps its place in the arrays, with 1 on the diagonal and 0 elsewhere in its row.


#: One elimination: c[node] = factor * c[other], or zero for other = None.
Step = tuple[int, int | None, float]
_BAND = 4
_BLOCK = 512
#: Refinement ends when a step is below this fraction, or after this many steps; each step gains 2 digits or more.
SETTLED, REFINEMENTS = 1e-12, 6
#: mu times the largest eigenvalue of the penalty is kept below this, so that 2 digits and the refinement remain.
_LARGEST_SPREAD = 1e14
#: No dense root of the inverse for more nodes than this: the general solvers with sparse matrices are faster.
_LARGEST_DENSE = 301


def second_difference(position_mm: FloatArray) -> FloatArray:
    """Coefficients (n - 2, 3) of D2 on nodes (n,): row k acts on c[k], c[k+1], c[k+2].

    With the steps p, q on either side of a node and the mean spacing h, row = sqrt(h^3 (p + q)/2) * 2/(p + q) *
    (slope after - slope before). On evenly spaced nodes this is 1, -2, 1; on any nodes |D2 c|^2 approaches h^3 times
    the integral of c''^2.
    """
    step = np.diff(position_mm)
    before, after = step[:-1], step[1:]
    scale = np.sqrt(2 * np.mean(step) ** 3 / (before + after)) if len(before) else before
    return np.stack([scale / before, -scale / before - scale / after, scale / after], axis=1)


def eliminate(rows: tuple[Row, ...]) -> tuple[Step, ...]:
    """Turn functionals that must vanish into eliminations, each by its largest factor; redundant ones are omitted."""
    steps: list[Step] = []
    for row in rows:
        factors: dict[int, float] = {}
        for given, given_factor in row:  # c[given], expressed in the unknowns left by earlier eliminations
            node, factor = given, given_factor
            for pivot, other, share in steps:
                if node == pivot:
                    if other is None:
                        break
                    node, factor = other, factor * share
            else:
                factors[node] = factors.get(node, 0.0) + factor
        if not factors or max(map(abs, factors.values())) < 1e-12:
            continue
        pivot = max(factors, key=lambda node: abs(factors[node]))
        others = [node for node in factors if node != pivot and factors[node] != 0]
        steps.append((pivot, others[0], -factors[others[0]] / factors[pivot]) if others else (pivot, None, 0.0))
    return tuple(steps)


def _eliminate_in_band(band: FloatArray, step: Step) -> None:
    """Replace the symmetric band matrix B by T^T B T, T one elimination; row and column of the node become 0."""
    node, other, share = step
    if other is None:  # the node is zero
        band[:, node] = 0.0
        for d in range(1, min(_BAND, node) + 1):
            band[d, node - d] = 0.0
        return
    low, high = max(0, min(node, other) - _BAND), min(band.shape[1], max(node, other) + _BAND + 1)
    size = high - low
    window = np.zeros((size, size))
    for d in range(min(_BAND + 1, size)):
        window[np.arange(d, size), np.arange(size - d)] = band[d, low : high - d]
    window += np.tril(window, -1).T
    turn = np.eye(size)
    turn[node - low, node - low] = 0.0
    turn[node - low, other - low] = share
    window = turn.T @ window @ turn
    for d in range(min(_BAND + 1, size)):
        band[d, low : high - d] = np.diagonal(window, -d)


@dataclass(frozen=True)
class Smoother:
    """One grid of n nodes with weights and fixed functionals; solves for any mu and any number of curves.

    ``weight`` (n,) is dimensionless with a mean near 1; ``rows`` the coefficients of D2 (n - 2, 3); ``steps`` the
    eliminations; ``free_weight`` (n,) the diagonal of Z^T W Z and ``penalty`` (5, n) the band of Z^T D^T D Z.
    """

    weight: FloatArray
    rows: FloatArray
    steps: tuple[Step, ...]
    free_weight: FloatArray
    penalty: FloatArray

    @classmethod
    def build(cls, position_mm: FloatArray, weight: FloatArray, fixed: tuple[Row, ...]) -> Smoother:
        """Prepare the smoother for nodes (n,), weights (n,) and the functionals that must stay zero."""
        rows, steps = second_difference(position_mm), eliminate(fixed)
        count = len(position_mm)
        penalty = np.zeros((_BAND + 1, count))  # D^T D as a lower band: entry [d, k] couples k and k + d
        for i in range(3):
            for j in range(i, 3):
                penalty[j - i, i : count - 2 + i] += rows[:, i] * rows[:, j]
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
        """Number of free unknowns: nodes minus fixed functionals."""
        return len(self.weight) - len(self.steps)

    @property
    def rank(self) -> int:
        """Rank of the penalty among the free unknowns."""
        return min(len(self.rows), self.unknowns)

    @cached_property
    def eigenvalues(self) -> FloatArray:
        """Eigenvalues (unknowns,) of the penalty relative to the weights, ascending; 0 for straight lines.

        With these g, log|A| = log|Z^T W Z| + sum(log(1 + mu g)) and the trace of the smoother is sum(1/(1 + mu g)).
        """
        root = 1 / np.sqrt(self.free_weight)
        scaled = np.zeros_like(self.penalty)
        for d in range(min(_BAND + 1, len(root))):
            scaled[d, : len(root) - d] = self.penalty[d, : len(root) - d] * root[d:] * root[: len(root) - d]
        values = lapack().dsbevd(scaled[: len(root)], compute_v=0, lower=1)[0]
        found: FloatArray = np.zeros(self.unknowns)
        if self.rank:
            found[-self.rank :] = np.maximum(values[-self.rank :], 0.0)
        return found

    @property
    def largest_mu(self) -> float:
        """Weight above which a curve is straight for all purposes; larger ones are set to this."""
        top = float(self.eigenvalues[-1]) if self.rank else 0.0
        if top == 0:
            return 0.0
        lowest = max(float(self.eigenvalues[-self.rank]), top * 1e-13)
        return min(1e4 / lowest, _LARGEST_SPREAD / top)

    def bend(self, c: FloatArray) -> FloatArray:
        """D2 c for curves (n, k): shape (n - 2, k)."""
        first, middle, last = self.rows.T[:, :, None]
        return np.asarray(first * c[:-2] + middle * c[1:-1] + last * c[2:])

    def bend_transposed(self, v: FloatArray) -> FloatArray:
        """D2^T v for values (n - 2, k): shape (n, k)."""
        out = np.zeros((len(self.weight), v.shape[1]))
        out[:-2] += self.rows[:, [0]] * v
        out[1:-1] += self.rows[:, [1]] * v
        out[2:] += self.rows[:, [2]] * v
        return out

    def expand(self, x: FloatArray) -> FloatArray:
        """Z x for unknowns (n, k): the curves, exactly zero at fixed nodes."""
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
        return self.gather(self.weight[:, None] * c + mu * self.bend_transposed(self.bend(c)))

    def factor(self, mu: float) -> FloatArray:
        """Banded Cholesky factor of A; LinAlgError if rounding left A not positive definite."""
        width = 1 + (2 if all(other is None for _, other, _ in self.steps) else _BAND)
        band = mu * self.penalty[: min(width, len(self.weight))]
        band[0] += self.free_weight
        found, failed = lapack().dpbtrf(band, lower=1)
        if failed:
            raise LinAlgError("not positive definite")
        return np.asarray(found)

    def inverse(self, mu: float, gathered: FloatArray) -> FloatArray:
        """Z A^-1 g for gathered right-hand sides (n, k): curves (n, k), refined against the product form of A."""
        factor, solved = self.factor(mu), lapack().dpbtrs
        x = solved(factor, gathered, lower=1)[0]
        for _ in range(REFINEMENTS):
            rest = gathered - self.apply(mu, self.expand(x))
            step = solved(factor, rest, lower=1)[0]
            x = x + step
            if np.abs(step).max(initial=0.0) <= SETTLED * np.abs(x).max(initial=0.0):
                break
        return self.expand(x)

    def solve(self, mu: float, y: FloatArray) -> FloatArray:
        """Fitted curves (n, k) for data (n, k)."""
        return self.inverse(mu, self.load(y))

    def load(self, y: FloatArray) -> FloatArray:
        """Z^T W y, the right-hand side for data (n, k)."""
        return self.gather(self.weight[:, None] * y)

    def misfit(self, residual: FloatArray) -> float:
        """Weighted sum of squared residuals (n,)."""
        return float(np.sum(self.weight * residual**2))

    def costs(self, y: FloatArray) -> Callable[[float], tuple[float, float]]:
        """Return the weighted sum of squares of y - c, and |D2 c|^2, for the fitted curve c, as a function of mu."""

        def at(mu: float) -> tuple[float, float]:
            c = self.solve(mu, y[:, None])
            return self.misfit(y - c[:, 0]), float(np.sum(self.bend(c) ** 2))

        return at

    def inverse_root(self, mu: float) -> FloatArray | None:
        """F (n, m) with F F^T = Z A^-1 Z^T: Z L^-T of A = L L^T; None if a dense matrix would be too large."""
        n = len(self.weight)
        if n > _LARGEST_DENSE:
            return None
        lower = self.factor(mu)
        upper = np.zeros_like(lower)  # L^T in banded storage
        for d in range(len(lower)):
            upper[len(lower) - 1 - d, d:] = lower[d, : n - d]
        turned = lapack().dgbsv(0, len(lower) - 1, upper, np.eye(n))[2]
        return np.delete(self.expand(turned), [node for node, _, _ in self.steps], axis=1)

    def matrix(self, mu: float) -> csc_array:
        """A (n, n) with 1 on the diagonal of eliminated unknowns."""
        import scipy.sparse as sp  # imported here: slow to load, needed only by the general solvers

        n = len(self.weight)
        band = mu * self.penalty
        band[0] += self.free_weight
        lower: Any = sp.dia_array((band, -np.arange(len(band))), shape=(n, n))
        middle: Any = sp.dia_array((band[:1], [0]), shape=(n, n))
        return sp.csc_array(lower + lower.T - middle)

    def columns(self, mu: float) -> Iterator[tuple[slice, FloatArray]]:
        """Yield the smoother's matrix S (c = S y) in blocks of columns: (column slice, (n, block))."""
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
        """Expected weighted sum of squared residuals for noise at unit weight: trace of (1 - S)^2."""
        damped = mu * self.eigenvalues
        return float(np.sum((damped / (1 + damped)) ** 2))


# How smooth a curve should be: from its uncertainties (REML), or by cross-validation if these are not known (GCV).
#
# Both with m free unknowns, A = W + mu P (all in the free unknowns), r = rank P, g the eigenvalues of P relative to W.
#
# REML: data y ~ N(c, u0^2 W^-1), curve D2 c ~ N(0, tau^2 I), no prior on straight lines, mu = u0^2/tau^2. Twice the
# negative log of the restricted likelihood is, up to a constant (Patterson & Thompson 1971; Wahba 1985, Ann. Statist.
# 13, 1378),
#
#     J(mu) = sum(log(1 + mu g)) - r log(mu) + [sum(w (y - c)^2) + mu |D2 c|^2] / u0^2
#
# GCV (Craven & Wahba 1979, Numer. Math. 31, 377): V(mu) = m sum(w (y - c)^2) / (m - sum(1/(1 + mu g)))^2


Method = Literal["REML", "GCV", "given"]
#: Cross-validation needs this many curvatures; with fewer it cannot determine a weight and the data are kept.
_GCV_LEAST = 3
_STRAIGHT_TO_ROUNDING = 1e-12
#: Smaller part of the golden section; step limit of Brent's method, which never needs as many.
_GOLDEN, _MOST_STEPS = 0.5 * (3.0 - math.sqrt(5.0)), 500


def reml_criterion(smoother: Smoother, y: FloatArray, u0: float) -> Callable[[float], float]:
    """J (equation above) as a function of mu, for data (n,) whose uncertainty has the scale ``u0``."""
    costs = smoother.costs(y)

    def value(mu: float) -> float:
        misfit, bending = costs(mu)
        penalty = (misfit + mu * bending) / u0**2
        return float(np.sum(np.log1p(mu * smoother.eigenvalues)) - smoother.rank * np.log(mu) + penalty)

    return value


def gcv_criterion(smoother: Smoother, y: FloatArray) -> Callable[[float], float]:
    """V (equation above) as a function of mu, for data (n,)."""
    costs = smoother.costs(y)

    def value(mu: float) -> float:
        misfit, _ = costs(mu)
        left = np.sum(mu * smoother.eigenvalues / (1 + mu * smoother.eigenvalues))
        return float(smoother.unknowns * misfit / left**2)

    return value


def choose(smoother: Smoother, y: FloatArray, u0: float | None) -> float:
    """Return mu for data (n,): by REML if ``u0`` is known, by GCV if it is None.

    Data without curvature get the largest mu; too few nodes for cross-validation (or for any curvature) get 0.
    """
    if smoother.rank == 0 or (u0 is None and smoother.rank < _GCV_LEAST):
        return 0.0
    if np.abs(smoother.bend(y[:, None])).max() <= _STRAIGHT_TO_ROUNDING * np.abs(smoother.rows).max() * np.abs(y).max():
        return smoother.largest_mu
    criterion = gcv_criterion(smoother, y) if u0 is None else reml_criterion(smoother, y, u0)
    low, high = np.log10(1e-9 / smoother.eigenvalues[-1]), np.log10(smoother.largest_mu)
    return float(10 ** _minimise(lambda exponent: criterion(10**exponent), low, high))


def _minimise(function: Callable[[float], float], low: float, high: float) -> float:
    """Minimum of a function on an interval: a grid of about one decade, then Brent's method around its best point.

    Brent (1973), Algorithms for Minimization without Derivatives, chapter 5; the same steps as ``minimize_scalar`` of
    scipy ("bounded"), whose module takes as long to load as fitting all curves.
    """
    grid = np.linspace(low, high, max(3, int(np.ceil(high - low)) + 1))
    values = [function(point) for point in grid]
    best = int(np.argmin(values))
    around = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
    x, least = _brent(function, float(around[0]), float(around[1]), 1e-3)
    return x if least < values[best] else float(grid[best])


def _brent(function: Callable[[float], float], a: float, b: float, tolerance: float) -> tuple[float, float]:
    """Minimum of a function between ``a`` and ``b``, and its value there.

    ``x``, ``w``, ``v`` are the best, second and third point. The parabola through them gives the next one, or the
    golden section if the parabola leaves the interval or does not halve the last step but one.
    """
    x = w = v = a + _GOLDEN * (b - a)
    fx = fw = fv = function(x)
    step = before = 0.0
    for _ in range(_MOST_STEPS):
        middle = 0.5 * (a + b)
        near = math.sqrt(2.2e-16) * abs(x) + tolerance / 3.0
        if abs(x - middle) <= 2.0 * near - 0.5 * (b - a):
            break
        golden = True
        if abs(before) > near:
            r, q = (x - w) * (fx - fv), (x - v) * (fx - fw)
            p, q = (x - v) * q - (x - w) * r, 2.0 * (q - r)
            p, q = -p if q > 0.0 else p, abs(q)
            golden = not (abs(p) < abs(0.5 * q * before) and q * (a - x) < p < q * (b - x))
            before = step
            if not golden:
                step = p / q
                if x + step - a < 2.0 * near or b - (x + step) < 2.0 * near:
                    step = near if middle >= x else -near
        if golden:
            before = a - x if x >= middle else b - x
            step = _GOLDEN * before
        u = x + max(abs(step), near) * (1.0 if step >= 0.0 else -1.0)
        fu = function(u)
        if fu <= fx:
            a, b = (x, b) if u >= x else (a, x)
            v, w, x, fv, fw, fx = w, x, u, fw, fx, fu
        else:
            a, b = (u, b) if u < x else (a, u)
            if fu <= fw or w == x:
                v, w, fv, fw = w, u, fw, fu
            elif fu <= fv or v in (x, w):
                v, fv = u, fu
    return x, fx


# Curves with correlated nodes: the covariance of the identification instead of independent uncertainties.
#
#     (y - c)^T W (y - c) + mu |D2 c|^2,   W = u0^2 V^-1
#
# over the free nodes, V being their covariance after zeroing. With V/u0^2 = L L^T and the singular values s of D2 L,
# everything the fit needs is diagonal: the eigenvalues of the penalty relative to W are s^2, and the smoother is
# L Q (1 + mu s^2)^-1 Q^T L^-1. Dense, O(n^3) once per curve.


#: Asymmetry and negative eigenvalues up to this fraction of the largest entry are rounding errors.
_MATRIX_ROUNDING = 1e-9


@dataclass(frozen=True)
class CorrelatedSmoother(Smoother):
    """A smoother whose weights are a matrix.

    ``nodes`` (m,) are the free ones, ``turn`` (n, m) turns their values into a curve, ``root`` (m, m) is L, ``basis``
    (m, m) Q, ``strength`` (m,) contains s^2 in ascending order.
    """

    nodes: NDArray[np.intp]
    turn: FloatArray
    root: FloatArray
    basis: FloatArray
    strength: FloatArray

    @classmethod
    def of(cls, simple: Smoother, covariance: FloatArray) -> CorrelatedSmoother:
        """Build from the zeros and D2 of a simple smoother; ``covariance`` (n, n) is V/u0^2, positive definite."""
        nodes = np.setdiff1d(np.arange(len(simple.weight)), [node for node, _, _ in simple.steps])
        turn = simple.expand(np.eye(len(simple.weight)))[:, nodes]
        root = np.linalg.cholesky(covariance[np.ix_(nodes, nodes)])
        _, values, across = np.linalg.svd(simple.bend(turn) @ root, full_matrices=True)
        strength = np.zeros(len(nodes))
        strength[: len(values)] = values**2
        strength[simple.rank :] = 0.0
        order = np.argsort(strength, kind="stable")
        return cls(
            simple.weight,
            simple.rows,
            simple.steps,
            simple.free_weight,
            simple.penalty,
            nodes,
            turn,
            root,
            across.T[:, order],
            strength[order],
        )

    @property
    def eigenvalues(self) -> FloatArray:
        """Eigenvalues (m,) of the penalty relative to W, ascending."""
        return self.strength

    def _weighted(self, x: FloatArray) -> FloatArray:
        return np.asarray(lapack().dpotrs(self.root, x, lower=1)[0])

    def _scattered(self, x: FloatArray) -> FloatArray:
        out = np.zeros((len(self.weight), x.shape[1]))
        out[self.nodes] = x
        return out

    def _curves(self, turned: FloatArray, mu: float) -> FloatArray:
        """Curves (n, k) from components (m, k) along Q, each damped according to its strength."""
        return np.asarray(self.turn @ (self.root @ (self.basis @ (turned / (1 + mu * self.strength)[:, None]))))

    def apply(self, mu: float, c: FloatArray) -> FloatArray:
        """A c for curves (n, k)."""
        bent = self.gather(mu * self.bend_transposed(self.bend(c)))
        return self._scattered(self._weighted(c[self.nodes])) + bent

    def inverse(self, mu: float, gathered: FloatArray) -> FloatArray:
        """Z A^-1 g for gathered right-hand sides (n, k)."""
        turned = self.basis.T @ (self.root.T @ gathered[self.nodes])
        return self._curves(turned, mu)

    def solve(self, mu: float, y: FloatArray) -> FloatArray:
        """Fitted curves (n, k) for data (n, k)."""
        white = lapack().dtrtrs(self.root, y[self.nodes], lower=1)[0]
        return self._curves(self.basis.T @ white, mu)

    def load(self, y: FloatArray) -> FloatArray:
        """Z^T W y for data (n, k)."""
        return self._scattered(self._weighted(y[self.nodes]))

    def misfit(self, residual: FloatArray) -> float:
        """r^T W r for residuals (n,)."""
        white = lapack().dtrtrs(self.root, residual[self.nodes], lower=1)[0]
        return float(white @ white)

    def costs(self, y: FloatArray) -> Callable[[float], tuple[float, float]]:
        """Return misfit and |D2 c|^2 as a function of mu; both are sums over the data's components t along Q.

        With t = Q^T L^-1 y the fitted curve has the components t/(1 + mu s^2), for zeroed data.
        """
        power = (self.basis.T @ lapack().dtrtrs(self.root, y[self.nodes], lower=1)[0]) ** 2

        def at(mu: float) -> tuple[float, float]:
            damping = 1 / (1 + mu * self.strength)
            bent = self.strength * damping
            return mu**2 * float(power @ bent**2), float(power @ (bent * damping))

        return at

    def inverse_root(self, mu: float) -> FloatArray:
        """F (n, m) with F F^T = Z A^-1 Z^T: L Q (1 + mu s^2)^-1/2."""
        return np.asarray(self.turn @ (self.root @ (self.basis / np.sqrt(1 + mu * self.strength))))

    def matrix(self, mu: float) -> csc_array:
        """A (n, n) with 1 on the diagonal of eliminated unknowns."""
        from scipy.sparse import csc_array  # imported here, as above

        full = np.eye(len(self.weight))
        bent = self.bend(self.turn)
        inner = self._weighted(np.eye(len(self.nodes))) + mu * bent.T @ bent
        full[np.ix_(self.nodes, self.nodes)] = 0.5 * (inner + inner.T)
        return csc_array(full)


def propagated(smoother: Smoother, mu: float, fixed: FixedCurve, covariance: FloatArray) -> FloatArray:
    """Standard uncertainty (n,) of the fitted curve for a covariance (n, n) of the input, in the input's unit."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    factor = vectors * np.sqrt(np.maximum(values, 0.0))
    carried = smoother.solve(mu, fixed.zeroing @ factor)
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", carried, carried)))


def curve_covariances(errors: ErrorTable, covariance: Covariance | Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Covariance (n, n) of each curve's nodes, mm and rad, checked against the table.

    ``covariance`` comes from an identification, or contains matrices by error name; curves without one have independent
    nodes.

    Raises
    ------
    InputError
        for a name that is not a curve, nodes that differ from the table's, or a matrix that is not a covariance.
    """
    if isinstance(covariance, Covariance):
        return _blocks(errors, covariance)
    for name in covariance:
        if name not in CURVE_NAMES:
            raise InputError(
                Message(
                    "covariance-curve-unknown",
                    "{name!r} is not one of the 18 curves; {suggestion}",
                    name=name,
                    suggestion=nearest(name, CURVE_NAMES),
                ),
                field="covariance",
            )
    found = {name: np.asarray(covariance[name], dtype=float) for name in errors.curves if name in covariance}
    for name, matrix in found.items():
        _check(name, errors.curves[name], matrix)
    return found


def _blocks(errors: ErrorTable, covariance: Covariance) -> dict[str, FloatArray]:
    names = np.array(covariance.error)
    blocks = {}
    for name, curve in errors.curves.items():
        at = np.flatnonzero(names == name)
        if not len(at):
            continue
        same = len(at) == len(curve.position_mm)
        if not same or np.abs(covariance.position_mm[at] - curve.position_mm).max() > SAME_POSITION_MM:
            raise InputError(
                Message(
                    "covariance-other-nodes",
                    "the covariance of {name} belongs to other nodes than those of the table; give the "
                    "one that was written with it",
                    name=name,
                ),
                field="covariance",
            )
        rows = covariance.errors_factor[at]
        blocks[name] = rows @ rows.T
    return blocks


def _check(name: str, curve: Curve, matrix: FloatArray) -> None:
    n = len(curve.position_mm)
    if matrix.shape != (n, n):
        raise InputError(
            Message(
                "covariance-shape",
                "{name} has {n} nodes and a covariance of shape {shape}; it needs ({n2}, {n3})",
                name=name,
                n=n,
                shape=matrix.shape,
                n2=n,
                n3=n,
            )
        )
    top = float(np.abs(matrix).max()) if np.isfinite(matrix).all() else -1.0
    if top < 0 or np.abs(matrix - matrix.T).max() > _MATRIX_ROUNDING * top:
        raise InputError(
            Message(
                "covariance-not-symmetric",
                "the covariance of {name} is not finite and symmetric; give that of its nodes",
                name=name,
            )
        )
    lowest = float(np.linalg.eigvalsh(matrix)[0])
    if lowest < -_MATRIX_ROUNDING * top * n:
        raise InputError(
            Message(
                "covariance-negative",
                "the covariance of {name} has a negative variance ({lowest:.3g}); give that of its nodes",
                name=name,
                lowest=lowest,
            )
        )
