"""One bounded curve by itself: where the banded method does not apply, or did not pass its check.

minimise x^T A x / 2 - x^T g   subject to   lower <= G x <= upper

in the unknowns of the smoother, with g = Z^T W y. The zero curve satisfies every bound, so the program always has a
solution. For correlated nodes a root F of the inverse of A is at hand, and the program is that of the point nearest to
the free optimum, x = free + F d with the least |d|; its multipliers are a non-negative least-squares problem (Lawson &
Hanson 1974, Solving Least Squares Problems, chapter 23). Other curves go to a general solver.
The result serves to find the active bounds; with these as equations the system is solved directly,
and the Karush-Kuhn-Tucker conditions (every bound kept, every multiplier of the right sign) prove that it is the
optimum. Where the active bounds depend on one another, so that their multipliers are not unique, the solver's own curve
is taken if its duality gap is closed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import scipy.sparse as sp

from compgen.core.csvio import FloatArray
from compgen.errors import ConvergenceError
from compgen.fit.bounds import KEPT, Rows
from compgen.fit.smooth import Smoother

_SIGN = 1e-9
#: Combinations of active rows that reach less than this fraction of the largest take no part.
_DEPENDENT = 1e-13
ACTIVE_SET = "active set"
#: Largest duality gap, as a fraction of what the bounds cost, of a solution whose active rows depend on one another.
_GAP = 1e-8


@dataclass(frozen=True)
class Bounded:
    """A fit within bounds: ``curve`` (n,), the ``active`` rows of the constraints (-1, 0, 1 per row) and the solver."""

    curve: FloatArray
    active: FloatArray
    solver: str


@dataclass(frozen=True)
class _Program:
    """The program with unknowns scaled to 1 on the diagonal of A, and only the rows that have a limit."""

    quadratic: sp.csc_array
    linear: FloatArray
    matrix: sp.csc_array
    lower: FloatArray
    upper: FloatArray


@dataclass(frozen=True)
class _Start:
    """A general solver's curve (n,), made to keep its bounds, and its multipliers (rows,), positive at upper limits."""

    curve: FloatArray
    multiplier: FloatArray


def fit_bounded(smoother: Smoother, mu: float, y: FloatArray, rows: Rows) -> Bounded:
    """Solve the program for data (n,); ``rows`` from :func:`compgen.fit.bounds.constraint_rows`.

    Raises
    ------
    ConvergenceError
        when no solver's result passes the optimality conditions.
    """
    free = smoother.solve(mu, y[:, None])[:, 0]
    root = smoother.inverse_root(mu)
    if root is not None:
        found = _active_set(smoother, mu, free, rows, _nearest(root, free, rows))
        if found is not None:
            return Bounded(*found, ACTIVE_SET)
    for solver, call in SOLVERS.items():
        start = _start(smoother, mu, y, rows, call)
        if start is None:
            continue
        found = _active_set(smoother, mu, free, rows, _touched(start.multiplier))
        if found is None and _is_optimal(smoother, mu, free, rows, start):
            found = start.curve, _touched(start.multiplier)
        if found is not None:
            return Bounded(*found, solver)
    raise ConvergenceError(
        "the bounded fit found no optimum that passes its check; loosen the bounds or the smoothness"
    )


def _nearest(root: FloatArray, free: FloatArray, rows: Rows) -> FloatArray:
    """Active rows (-1, 0, 1) of the point within the bounds that is nearest to the free optimum; a good guess at least.

    With d in units of the greatest excess e, the rows G F over their lengths and the right side h = (G free - limit)/e,
    min |d| subject to -G F d >= h has the multipliers u of min |(-G F)^T u|^2 + (h^T u - 1)^2, u >= 0.
    """
    from scipy.optimize import nnls  # imported here: slow to load

    reach, value = rows.dense @ root, rows.dense @ free
    length = np.linalg.norm(reach, axis=1)
    above, below = (np.flatnonzero(np.isfinite(limit) & (length > 0)) for limit in (rows.upper, rows.lower))
    row = np.concatenate([above, below])
    excess = np.concatenate([value[above] - rows.upper[above], rows.lower[below] - value[below]]) / length[row]
    sign = np.repeat([1.0, -1.0], [len(above), len(below)])
    active = np.zeros(len(value))
    if not excess.max(initial=0.0) > 0.0:
        return active
    excess /= excess.max()
    system = np.vstack([-(sign / length[row]) * reach[row].T, excess])
    try:
        multiplier = nnls(system, np.append(np.zeros(reach.shape[1]), 1.0))[0]
    except RuntimeError:  # too many steps: the rows most outside their limits are where the search begins
        multiplier = np.maximum(excess, 0.0)
    chosen = multiplier > _SIGN * multiplier.max()
    active[row[chosen]] = sign[chosen]
    return active


def _touched(multiplier: FloatArray) -> FloatArray:
    return np.where(np.abs(multiplier) > 1e-6 * np.abs(multiplier).max(initial=0.0), np.sign(multiplier), 0.0)


def _start(
    smoother: Smoother,
    mu: float,
    y: FloatArray,
    rows: Rows,
    call: Callable[[_Program], tuple[FloatArray, FloatArray] | None],
) -> _Start | None:
    """Ask a general solver; None if it fails."""
    quadratic = smoother.matrix(mu)
    scale = 1 / np.sqrt(quadratic.diagonal())
    stretch: Any = sp.diags_array(scale)
    used = np.flatnonzero(np.isfinite(rows.lower) | np.isfinite(rows.upper))
    program = _Program(
        sp.csc_array(stretch @ quadratic @ stretch),
        -scale * smoother.load(y[:, None])[:, 0],
        sp.csc_array(rows.matrix[used] @ stretch),
        rows.lower[used],
        rows.upper[used],
    )
    found = call(program)
    if found is None or not np.isfinite(found[0]).all():
        return None
    multiplier = np.zeros(rows.matrix.shape[0])
    multiplier[used] = found[1]
    curve = smoother.expand((scale * found[0])[:, None])[:, 0]
    values = rows.dense @ curve
    limit = np.where(values > 0, rows.upper, -rows.lower)
    share = np.where((limit > 0) & np.isfinite(limit), np.abs(values) / np.where(limit > 0, limit, 1.0), 0.0)
    return _Start(
        curve / max(1.0, float(share.max())), multiplier
    )  # every smaller multiple of a curve keeps bounds too


def _osqp(program: _Program) -> tuple[FloatArray, FloatArray] | None:
    osqp: Any = import_module("osqp")
    solver = osqp.OSQP()
    upper = sp.csc_matrix(sp.triu(program.quadratic))
    settings = {"eps_abs": 1e-8, "eps_rel": 1e-8, "max_iter": 20000, "verbose": False}
    solver.setup(upper, program.linear, sp.csc_matrix(program.matrix), program.lower, program.upper, **settings)
    result = solver.solve(raise_error=False)
    return (result.x, result.y) if result.info.status in ("solved", "solved inaccurate") else None


def _clarabel(program: _Program) -> tuple[FloatArray, FloatArray] | None:
    clarabel: Any = import_module("clarabel")
    high, low = np.isfinite(program.upper), np.isfinite(program.lower)
    matrix = sp.csc_matrix(sp.vstack([program.matrix[high], -program.matrix[low]]))
    limit = np.concatenate([program.upper[high], -program.lower[low]])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    quadratic = sp.csc_matrix(sp.triu(program.quadratic))
    cones = [clarabel.NonnegativeConeT(len(limit))]
    result = clarabel.DefaultSolver(quadratic, program.linear, matrix, limit, cones, settings).solve()
    if "Solved" not in str(result.status):
        return None
    dual, multiplier = np.array(result.z), np.zeros(len(high))
    multiplier[high] += dual[: int(high.sum())]
    multiplier[low] -= dual[int(high.sum()) :]
    return np.array(result.x), multiplier


#: General solvers in the order in which they are asked.
SOLVERS: dict[str, Callable[[_Program], tuple[FloatArray, FloatArray] | None]] = {"OSQP": _osqp, "Clarabel": _clarabel}


def _is_optimal(smoother: Smoother, mu: float, free: FloatArray, rows: Rows, start: _Start) -> bool:
    """Whether the start keeps its bounds and its duality gap is closed.

    With e = x - free, cost e^T A e / 2 and the dual value for multipliers v (both against the free optimum), half the
    squared distance to the optimum in the norm of A is at most their difference (A is the program's only curvature).
    """
    if np.abs(rows.excess(start.curve)).max(initial=0.0) > KEPT:
        return False
    e, v = start.curve - free, start.multiplier
    cost = 0.5 * float(e @ smoother.apply(mu, e[:, None])[:, 0])
    pull = rows.dense.T @ v
    reach = smoother.inverse(mu, pull[:, None])[:, 0]
    limit = np.where(v > 0, rows.upper, rows.lower)
    value = float(pull @ free - np.sum(np.where(v != 0, v * limit, 0.0)) - 0.5 * pull @ reach)
    return cost - value <= _GAP * cost


def _active_set(
    smoother: Smoother, mu: float, free: FloatArray, rows: Rows, active: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Curve and active rows that satisfy the optimality conditions, from a guess of the active rows; None if not found.

    One row enters (the one most outside its bound) or leaves (the one with the most wrong multiplier) at a time.
    """
    active = active.copy()
    for _ in range(20 + 4 * len(free)):
        picked = np.flatnonzero(active)
        sign = active[picked]
        target = np.where(sign > 0, rows.upper[picked], -rows.lower[picked])
        if not np.isfinite(target).all():
            return None
        signed = rows.dense[picked] * sign[:, None]
        curve, multiplier = _equalities(smoother, mu, free, signed, target)
        if len(picked) and multiplier.min() < -_SIGN * np.abs(multiplier).max():
            active[picked[np.argmin(multiplier)]] = 0.0
            continue
        excess = rows.excess(curve)
        worst = int(np.argmax(np.abs(excess)))
        if abs(excess[worst]) <= KEPT:
            return curve, active
        if active[worst] != 0:
            return None
        active[worst] = np.sign(excess[worst])
    return None


def _equalities(
    smoother: Smoother, mu: float, free: FloatArray, signed: FloatArray, target: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Curve (n,) with the ``signed`` rows (k, n) at ``target`` (k,), and their multipliers times the root of their reach.

    Solved by the Schur complement of A, each row scaled to 1 on its diagonal, and refined against what is left.
    """
    if not len(signed):
        return free, np.zeros(0)
    reach = smoother.inverse(mu, signed.T)
    schur = signed @ reach
    scale = 1 / np.sqrt(np.maximum(np.diag(schur), np.finfo(float).tiny))
    spread = reach * scale
    value, vector = np.linalg.eigh(schur * scale * scale[:, None])
    used = value > _DEPENDENT * value[-1]
    value, vector = value[used], vector[:, used]
    curve, multiplier = free, np.zeros(len(signed))
    for _ in range(3):
        more = vector @ (vector.T @ (scale * (signed @ curve - target)) / value)
        curve = smoother.expand((curve - spread @ more)[:, None])[:, 0]
        multiplier = multiplier + more
    return curve, multiplier
