"""The same fit with bounds on magnitude and slope: a quadratic program in the unknowns of the smoother.

minimise x^T A x / 2 - x^T Z^T W y   subject to   -1 <= G x <= 1

with the rows of G the node values over their bound and the slopes over theirs. The zero curve satisfies every bound,
so the program always has a solution. It is written for cvxpy as a quadratic form of the banded A (a sum of squares
would add a variable per second difference and slow the solver down a hundredfold). The solver's result serves to find
the active bounds; with these as equations the system is solved directly, and the Karush-Kuhn-Tucker conditions
(every bound kept, every multiplier of the right sign) prove that it is the optimum.
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
_SOLVERS: tuple[tuple[str, dict[str, float]], ...] = (
    ("OSQP", {"eps_abs": 1e-8, "eps_rel": 1e-8, "max_iter": 20000}),
    ("CLARABEL", {}),
)


@dataclass(frozen=True)
class Bounded:
    """A fit within bounds: ``curve`` (n,), the ``active`` rows of the constraints (-1, 0, 1 per row) and the solver.

    Rows count the n node values first, then the n - 1 slopes.
    """

    curve: FloatArray
    active: FloatArray
    solver: str


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
        found = _active_set(smoother, mu, free, rows, start) if start is not None else None
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
) -> FloatArray | None:
    """Active rows (-1, 0, 1) as a general solver sees them; None if it fails."""
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
    strongest = max(upper.max(), lower.max())
    active = np.zeros(rows.shape[0])
    active[used] = (upper > 1e-6 * strongest).astype(float) - (lower > 1e-6 * strongest)
    return active


def _active_set(
    smoother: Smoother, mu: float, free: FloatArray, rows: sp.csr_array, active: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Curve and active rows that satisfy the optimality conditions, from a guess of the active rows; None if not found.

    One row enters (the one most outside its bound) or leaves (the one with the most wrong multiplier) at a time.
    """
    active = active.copy()
    scale = float(np.abs(smoother.free_weight).max() * np.abs(free).max())
    for _ in range(10 + 2 * len(free)):
        picked = np.flatnonzero(active)
        signed = rows[picked].toarray() * active[picked, None]
        reach = smoother.inverse(mu, signed.T) if len(picked) else np.zeros((len(free), 0))
        multiplier = np.linalg.lstsq(signed @ reach, signed @ free - 1.0, rcond=1e-13)[0]
        if len(picked) and multiplier.min() < -_SIGN * max(scale, np.abs(multiplier).max()):
            active[picked[np.argmin(multiplier)]] = 0.0
            continue
        curve = free - reach @ multiplier
        values = np.asarray(rows @ curve)
        if np.abs(values).max() <= 1.0 + KEPT:
            return curve, active
        worst = int(np.argmax(np.abs(values)))
        if active[worst] != 0:
            return None
        active[worst] = np.sign(values[worst])
    return None
