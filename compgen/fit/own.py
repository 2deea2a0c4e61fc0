"""Constraints of the user's own: the whole problem, all curves together, in cvxpy.

The sum of the curves' costs is a quadratic form (a sum of squares of differences would slow every solver down); zeros,
bounds and own constraints stand beside it as they are. Where no curves satisfy the own constraints, the elastic problem
(least sum of violations, zeros and bounds kept) says which of them to relax, and by how much.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np
import scipy.sparse as sp

from compgen.errors import ConvergenceError, InputError
from compgen.fit.bounds import constraint_rows
from compgen.fit.curve import Prepared
from compgen.fit.solve import Solution

#: Receives cvxpy variables by error name, returns cvxpy constraints, as a list or by name.
OwnConstraints = Callable[[Mapping[str, Any]], Iterable[Any] | Mapping[str, Any]]
#: Own constraints are kept to this, in um or urad; a violation below it is none.
TOLERANCE = 1e-6
_TIGHT = {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10}
_STATES = ("optimal", "optimal_inaccurate")


def solve_own(prepared: Sequence[Prepared], mu: Sequence[float], constraints: OwnConstraints) -> list[Solution]:
    """Fit all curves at given smoothness within their bounds and the user's constraints.

    Raises
    ------
    InputError
        if what the callable returns is not a set of cvxpy constraints, or cannot be satisfied.
    ConvergenceError
        if the solver fails.
    """
    cp: Any = import_module("cvxpy")
    inner = {item.name: cp.Variable(len(item.y), name=item.name) for item in prepared}
    shown = {item.name: cp.Variable(len(item.y), name=item.name) for item in prepared}
    own = _named(cp, constraints(shown))
    rules = [rule for item in prepared for rule in _rules(item, inner[item.name], shown[item.name])]
    cost = 0.0
    for item, weight in zip(prepared, mu, strict=True):
        cost = cost + _cost(cp, item, weight, inner[item.name])
    problem = cp.Problem(cp.Minimize(cost), [*rules, *own.values()])
    _solve(cp, problem)
    if problem.status in ("infeasible", "infeasible_inaccurate"):
        raise InputError(_relaxation(cp, rules, own), field="constraints")
    if problem.status not in _STATES:
        raise ConvergenceError(f"the fit with your constraints ended with {problem.status}; scale or loosen them")
    _check_kept(own)
    return [_solution(item, np.asarray(inner[item.name].value)) for item in prepared]


def _cost(cp: Any, item: Prepared, mu: float, x: Any) -> Any:
    """c^T A c / 2 - c^T W y in units of the weight of its data, so that all curves count alike."""
    matrix = item.smoother.matrix(mu)
    matrix = sp.csc_array(0.5 * (matrix + matrix.T))
    scale = item.u0**2 if item.u0 is not None else 1.0
    return (0.5 * cp.quad_form(x, cp.psd_wrap(matrix)) - item.smoother.load(item.y[:, None])[:, 0] @ x) / scale


def _rules(item: Prepared, x: Any, shown: Any) -> list[Any]:
    """Zeros and bounds: ``x`` are the smoother's unknowns (eliminated ones zero), ``shown`` the node values."""
    turn = sp.csr_array(item.smoother.expand(np.eye(len(item.y))))
    rows = constraint_rows(item.held.position_mm, item.smoother, *item.bounds.limits, item.bounds.direction)
    high, low = np.flatnonzero(np.isfinite(rows.upper)), np.flatnonzero(np.isfinite(rows.lower))
    rules = [shown == turn @ x]
    gone = [node for node, _, _ in item.smoother.steps]
    if gone:
        rules.append(x[gone] == 0)
    if len(high):
        rules.append(rows.matrix[high] @ x <= rows.upper[high])
    if len(low):
        rules.append(rows.matrix[low] @ x >= rows.lower[low])
    return rules


def _named(cp: Any, given: Any) -> dict[str, Any]:
    """Own constraints by name; a list gives them their place and text."""
    if isinstance(given, Mapping):
        own = {str(name): rule for name, rule in given.items()}
    elif isinstance(given, Iterable):
        own = {f"constraint {k} ({str(rule)[:80]})": rule for k, rule in enumerate(given, 1)}
    else:
        raise InputError(f"the callable returned {type(given).__name__}; return a list of cvxpy constraints")
    for name, rule in own.items():
        if not isinstance(rule, cp.constraints.constraint.Constraint):
            raise InputError(f"{name} is a {type(rule).__name__}; return cvxpy constraints", field="constraints")
        if not rule.is_dcp():
            raise InputError(f"{name} is not convex; write it as a convex one", field="constraints")
    return own


def _solve(cp: Any, problem: Any) -> None:
    """Solve to tight tolerances, to looser ones if that fails."""
    for settings in (_TIGHT, {}):
        try:
            with warnings.catch_warnings():  # what is inaccurate is checked by what it keeps
                warnings.simplefilter("ignore")
                problem.solve(solver="CLARABEL", **settings)
        except cp.error.SolverError:
            continue
        if problem.status != "user_limit":
            return
    if problem.status is None:
        raise ConvergenceError("no solver could work with your constraints; scale or loosen them")


def _check_kept(own: Mapping[str, Any]) -> None:
    for name, rule in own.items():
        broken = float(np.max(rule.violation(), initial=0.0))
        if not broken <= TOLERANCE:
            raise ConvergenceError(f"{name} is broken by {broken:.3g} in the solver's result; scale or loosen it")


def _relaxation(cp: Any, rules: Sequence[Any], own: Mapping[str, Any]) -> str:
    """Name the constraints that must give way and by how much: least sum of violations, zeros and bounds kept."""
    slack, elastic = {}, []
    for name, rule in own.items():
        if isinstance(rule, cp.constraints.Inequality):
            slack[name] = cp.Variable(rule.expr.shape, nonneg=True)
            elastic.append(rule.expr <= slack[name])
        elif isinstance(rule, cp.constraints.Equality | cp.constraints.Zero):
            slack[name] = cp.Variable(rule.expr.shape, nonneg=True)
            elastic.append(cp.abs(rule.expr) <= slack[name])
        else:
            elastic.append(rule)
    beginning = "no curves satisfy zeros, bounds and your constraints together; "
    if not slack:
        return beginning + "none of them can be relaxed by an amount; leave one out"
    problem = cp.Problem(cp.Minimize(sum(cp.sum(amount) for amount in slack.values())), [*rules, *elastic])
    _solve(cp, problem)
    if problem.status not in _STATES:
        return beginning + f"those that can be relaxed by an amount ({', '.join(slack)}) do not help; leave one out"
    amounts = {name: np.atleast_1d(np.asarray(amount.value)) for name, amount in slack.items()}
    named = [f"{name} by {_amount(amount)}" for name, amount in amounts.items() if amount.max() > TOLERANCE]
    return beginning + "the least relaxation that helps: " + "; ".join(named)


def _amount(amount: np.ndarray) -> str:
    over = amount[amount > TOLERANCE]
    entries = "" if amount.size == 1 else f" (largest of {over.size} of its {amount.size} entries)"
    return f"{math.ceil(over.max() * 1e6) / 1e6:.6g}{entries}"


def _solution(item: Prepared, x: np.ndarray) -> Solution:
    curve = item.smoother.expand(x[:, None])[:, 0]
    rows = constraint_rows(item.held.position_mm, item.smoother, *item.bounds.limits, item.bounds.direction)
    values = np.asarray(rows.matrix @ curve)
    near = np.where(values >= rows.upper - TOLERANCE, 1.0, np.where(values <= rows.lower + TOLERANCE, -1.0, 0.0))
    return Solution(curve, near, "cvxpy")
