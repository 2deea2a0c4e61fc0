"""The same fit with bounds on magnitude and slope: a quadratic program in the unknowns of the smoother.

minimise x^T A x / 2 - x^T Z^T W y   subject to   -1 <= G x <= 1

with the rows of G the node values over their bound and the slopes over theirs. The zero curve satisfies every bound,
so the program always has a solution. It is written for cvxpy as a quadratic form of the banded A (a sum of squares
would add a variable per second difference and slow the solver down a hundredfold). The solver's result serves to find
the active bounds; with these as equations the system is solved directly, and the Karush-Kuhn-Tucker conditions
(every bound kept, every multiplier of the right sign) prove that it is the optimum. Where the active bounds depend on
one another, so that their multipliers are not unique, the solver's own curve is taken if its duality gap is closed.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import scipy.sparse as sp

from compgen.core.csvio import FloatArray
from compgen.errors import ConvergenceError
from compgen.fit.smooth import Smoother

#: Bounds are kept to this fraction of them.
KEPT = 1e-9
_SIGN = 1e-9
#: Largest duality gap, as a fraction of what the bounds cost, of a solution whose active rows depend on one another.
_GAP = 1e-8
_SOLVERS: tuple[tuple[str, dict[str, float]], ...] = (
    ("OSQP", {"eps_abs": 1e-8, "eps_rel": 1e-8, "max_iter": 20000}),
    ("CLARABEL", {}),
    ("CLARABEL", {"tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-12}),
)


@dataclass(frozen=True)
class Bounded:
    """A fit within bounds: ``curve`` (n,), the ``active`` rows of the constraints (-1, 0, 1 per row) and the solver.

    Rows count the n node values first, then the n - 1 slopes.
    """

    curve: FloatArray
    active: FloatArray
    solver: str


@dataclass(frozen=True)
class _Start:
    """A general solver's curve (n,), made to keep its bounds, its multipliers (rows,) and the active rows (-1, 0, 1)."""

    curve: FloatArray
    multiplier: FloatArray
    active: FloatArray


def constraint_rows(position_mm: FloatArray, smoother: Smoother, largest: float, steepest: float) -> sp.csr_array:
    """Rows (2 n - 1, n) of G in the smoother's unknowns: value/largest, slope/steepest; a bound of inf gives zeros."""
    n = len(position_mm)
    turn: Any = sp.csr_array(smoother.expand(np.eye(n)))
    per_step = 1 / (np.diff(position_mm) * steepest)
    bands = np.stack([np.append(-per_step, 0.0), np.append(0.0, per_step)])  # indexed by column
    slope: Any = sp.dia_array((bands, [0, 1]), shape=(n - 1, n))
    rows = sp.csr_array(sp.vstack([turn / largest, slope @ turn]))
    rows.eliminate_zeros()
    return rows


def is_within(position_mm: FloatArray, curve: FloatArray, largest: float, steepest: float) -> bool:
    """Whether a curve (n,) keeps its bounds at every node and between them."""
    slope = np.abs(np.diff(curve) / np.diff(position_mm))
    return bool(np.abs(curve).max() <= largest and slope.max(initial=0.0) <= steepest)


def fit_bounded(smoother: Smoother, mu: float, y: FloatArray, rows: sp.csr_array) -> Bounded:
    """Solve the program for data (n,); ``rows`` from :func:`constraint_rows`.

    Raises
    ------
    ConvergenceError
        when no solver's result passes the optimality conditions.
    """
    free = smoother.solve(mu, y[:, None])[:, 0]
    for solver, settings in _SOLVERS:
        start = _start(smoother, mu, y, rows, solver, settings)
        if start is not None:
            found = _active_set(smoother, mu, free, rows, start.active)
            if found is None and _gap(smoother, mu, free, rows, start) <= _GAP:
                found = start.curve, start.active
            if found is not None:
                return Bounded(*found, f"cvxpy+{solver}")
    raise ConvergenceError(
        "the bounded fit found no optimum that passes its check; loosen the bounds or the smoothness"
    )


def _quadratic(smoother: Smoother, mu: float) -> sp.csc_array:
    n = len(smoother.weight)
    band = mu * smoother.penalty
    band[0] += smoother.free_weight
    lower: Any = sp.dia_array((band, -np.arange(len(band))), shape=(n, n))
    middle: Any = sp.dia_array((band[:1], [0]), shape=(n, n))
    return sp.csc_array(lower + lower.T - middle)


def _start(
    smoother: Smoother, mu: float, y: FloatArray, rows: sp.csr_array, solver: str, settings: dict[str, float]
) -> _Start | None:
    """Ask a general solver; None if it fails."""
    cp: Any = import_module("cvxpy")  # takes more than a second: only when a bound is active

    quadratic = _quadratic(smoother, mu)
    scale = 1 / np.sqrt(quadratic.diagonal())
    stretch: Any = sp.dia_array((scale[None, :], [0]), shape=quadratic.shape)
    scaled = stretch @ quadratic @ stretch
    linear = scale * smoother.gather((smoother.weight * y)[:, None])[:, 0]
    used = np.flatnonzero(np.diff(rows.indptr))
    x = cp.Variable(len(y))
    values = sp.csr_array(rows[used] @ stretch) @ x
    limits = [values <= 1, values >= -1]
    problem = cp.Problem(cp.Minimize(0.5 * cp.quad_form(x, cp.psd_wrap(scaled)) - linear @ x), limits)
    try:
        with warnings.catch_warnings():  # an inaccurate solution is no harm: the active rows are checked afterwards
            warnings.simplefilter("ignore")
            problem.solve(solver=solver, **settings)
    except cp.error.SolverError:
        return None
    if problem.status not in ("optimal", "optimal_inaccurate"):
        return None
    upper, lower = (np.asarray(limit.dual_value) for limit in limits)
    multiplier = np.zeros(rows.shape[0])
    multiplier[used] = np.maximum(upper, 0.0) - np.maximum(lower, 0.0)
    curve = smoother.expand((scale * x.value)[:, None])[:, 0]
    curve = curve / max(1.0, float(np.abs(rows @ curve).max()))  # the bounds allow every smaller multiple of a curve
    active = np.where(np.abs(multiplier) > 1e-6 * np.abs(multiplier).max(), np.sign(multiplier), 0.0)
    return _Start(curve, multiplier, active)


def _gap(smoother: Smoother, mu: float, free: FloatArray, rows: sp.csr_array, start: _Start) -> float:
    """Duality gap over the cost of the bounds: how far, at most, the start is from the optimum.

    With e = x - free, cost e^T A e / 2 and the dual value for multipliers v (both against the free optimum), half the
    squared distance to the optimum in the norm of A is at most their difference (A is the program's only curvature).
    """
    e = start.curve - free
    cost = 0.5 * float(e @ smoother.apply(mu, e[:, None])[:, 0])
    pull = np.asarray(rows.T @ start.multiplier)
    reach = smoother.inverse(mu, pull[:, None])[:, 0]
    value = float(pull @ free - np.abs(start.multiplier).sum() - 0.5 * pull @ reach)
    return (cost - value) / cost


def _active_set(
    smoother: Smoother, mu: float, free: FloatArray, rows: sp.csr_array, active: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Curve and active rows that satisfy the optimality conditions, from a guess of the active rows; None if not found.

    One row enters (the one most outside its bound) or leaves (the one with the most wrong multiplier) at a time.
    """
    active = active.copy()
    for _ in range(20 + 4 * len(free)):
        picked = np.flatnonzero(active)
        curve, multiplier = _equalities(smoother, mu, free, rows[picked].toarray() * active[picked, None])
        if len(picked) and multiplier.min() < -_SIGN * np.abs(multiplier).max():
            active[picked[np.argmin(multiplier)]] = 0.0
            continue
        values = np.asarray(rows @ curve)
        if np.abs(values).max() <= 1.0 + KEPT:
            return curve, active
        worst = int(np.argmax(np.abs(values)))
        if active[worst] != 0:
            return None
        active[worst] = np.sign(values[worst])
    return None


def _equalities(smoother: Smoother, mu: float, free: FloatArray, signed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Curve (n,) with the ``signed`` rows (k, n) at 1, and their multipliers (k,) times the root of their reach.

    Solved by the Schur complement of A, each row scaled to 1 on its diagonal, and refined against what is left.
    """
    if not len(signed):
        return free, np.zeros(0)
    reach = smoother.inverse(mu, signed.T)
    schur = signed @ reach
    scale = 1 / np.sqrt(np.maximum(np.diag(schur), np.finfo(float).tiny))
    scaled, spread = schur * scale * scale[:, None], reach * scale
    curve, multiplier = free, np.zeros(len(signed))
    for _ in range(3):
        more = np.linalg.lstsq(scaled, scale * (signed @ curve - 1.0), rcond=1e-13)[0]
        curve = smoother.expand((curve - spread @ more)[:, None])[:, 0]
        multiplier = multiplier + more
    return curve, multiplier
