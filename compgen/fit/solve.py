"""Curves at a given smoothness: all without bounds at once, then only those that break a bound, again at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.fit.bounded import fit_bounded
from compgen.fit.bounds import KEPT, Bounds, constraint_rows
from compgen.fit.interior import RowStack, interior, row_stack
from compgen.fit.polish import polish
from compgen.fit.smooth import Smoother
from compgen.fit.stacked import CurveProblem, Stack, curvatures_of

#: The interior point method is broken off early: mostly the active bounds are known by then, or nearly.
_FIRST_STEPS, _FIRST_ROUNDS = 10, 4
DIRECT, INTERIOR = "direct", "interior point"


_UNTOUCHED: FloatArray = np.zeros(0)


@dataclass(frozen=True)
class Solution:
    """A fitted ``curve`` (n,) in the unit of its data, the bounds that it touches, and who found it.

    ``touched`` holds -1, 0, 1 for n values, n - 1 slopes and n - 2 curvatures; empty if no bound is touched.
    """

    curve: FloatArray
    touched: FloatArray = field(default_factory=lambda: _UNTOUCHED)
    solver: str = DIRECT


def solve_curves(problems: Sequence[CurveProblem]) -> list[Solution]:
    """Minimise every problem; ConvergenceError if no solver reaches an optimum that passes its check.

    One banded factorisation serves all curves. Those that keep their bounds are finished: a minimum that lies within
    the bounds is the bounded minimum. The others are solved together by :func:`compgen.fit.interior.interior`, and
    what does not pass there goes one by one to a general solver (:func:`compgen.fit.bounded.fit_bounded`).
    """
    stack = Stack.build(problems)
    free = stack.solve()
    found = [Solution(curve) for curve in stack.split(free)]
    broken = np.flatnonzero(_breaks(stack, [problem.bounds for problem in problems], free)).tolist()
    if broken:
        for k, solution in zip(broken, _bounded([problems[k] for k in broken]), strict=True):
            found[k] = solution
    return found


def _breaks(stack: Stack, bounds: Sequence[Bounds], curve: FloatArray) -> NDArray[np.bool_]:
    """Which curves (k,) of a stack (N,) break a bound."""
    limits = np.array([(b.max_abs, b.max_slope, b.max_curvature, b.direction) for b in bounds]).T
    wrong = stack.largest(np.abs(curve)) > limits[0]
    if np.isfinite(limits[1]).any() or limits[3].any():
        slope = stack.slopes(curve)
        wrong |= stack.largest(np.abs(slope)) > limits[1]
        if limits[3].any():
            wrong |= stack.largest(-slope * stack.of_each(limits[3])) > 0
    if np.isfinite(limits[2]).any():
        wrong |= stack.largest(np.abs(curvatures_of(stack, curve))) > limits[2]
    return np.asarray(wrong)


def _bounded(problems: Sequence[CurveProblem]) -> list[Solution]:
    stack = Stack.build(problems)
    free = stack.solve()
    rows = row_stack(stack, [problem.bounds for problem in problems], free)
    near, multiplier, closed = interior(stack, rows, free, _FIRST_STEPS)
    curve, active, exact = polish(stack, rows, near, multiplier, _FIRST_ROUNDS)
    if not exact.all():
        again, nodes = ~exact, stack.of_each(~exact)
        some, few = stack.pick(again), rows.pick(nodes)
        near[nodes], multiplier[..., nodes], closed[again] = interior(some, few, free[nodes])
        curve[nodes], active[..., nodes], exact[again] = polish(some, few, near[nodes], multiplier[..., nodes])
    curve = np.where(stack.of_each(exact), curve, near)
    within = stack.largest((rows.values(curve) - rows.limit).max(axis=(0, 1))) <= KEPT
    parts = zip(problems, stack.split(curve), _split_rows(stack, rows, active), exact | (closed & within), strict=True)
    return [Solution(part, touched, INTERIOR) if good else _one(problem) for problem, part, touched, good in parts]


def _split_rows(stack: Stack, rows: RowStack, active: FloatArray) -> list[FloatArray]:
    """Active rows (B, N) as n values, n - 1 slopes and n - 2 curvatures of each curve."""
    every = np.zeros((3, active.shape[1]))
    every[list(rows.kinds)] = active
    return [
        np.concatenate([every[kind, start : start + max(size - kind, 0)] for kind in range(3)])
        for start, size in zip(stack.starts.tolist(), stack.sizes.tolist(), strict=True)
    ]


def _one(problem: CurveProblem) -> Solution:
    held = tuple(((node, 1.0),) for node in problem.held)
    smoother = Smoother.build(problem.position_mm, problem.weight, held)
    return solve_general(problem, smoother)


def solve_general(problem: CurveProblem, smoother: Smoother) -> Solution:
    """Solve one curve whose smoother is not of the simple kind: held between nodes, or with correlated data."""
    curve = smoother.solve(problem.mu, problem.y[:, None])[:, 0]
    bounds = problem.bounds
    if bounds.kept_by(problem.position_mm, curve):
        return Solution(curve)
    unit = max(float(np.abs(problem.y).max()), float(np.finfo(float).tiny))  # solvers like numbers near 1
    scaled = replace(problem, bounds=bounds.in_unit(unit), y=problem.y / unit)
    rows = constraint_rows(problem.position_mm, smoother, *scaled.bounds.limits, bounds.direction)
    found = fit_bounded(smoother, problem.mu, scaled.y, rows)
    return Solution(found.curve * unit, found.active, found.solver)
