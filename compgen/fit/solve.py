"""Curves at a given smoothness: all without bounds at once, then only those that break a bound, again at once."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.fit.bounded import fit_bounded
from compgen.fit.bounds import KEPT, Bounds, constraint_rows
from compgen.fit.interior import RowStack, interior, row_stack
from compgen.fit.polish import polish
from compgen.fit.smooth import Smoother
from compgen.fit.stacked import CurveProblem, Stack, curvatures_of

#: The interior point method is broken off early, after this many steps and one more for each doubling of the nodes:
#: mostly the active bounds are known by then, or nearly.
_FIRST_STEPS, _FIRST_ROUNDS = 2, 4
#: Curves are laid together up to so many nodes: more would leave the cache.
_PORTION = 6000
BoolArray = NDArray[np.bool_]
DIRECT, INTERIOR = "direct", "interior point"


_UNTOUCHED: FloatArray = np.zeros(0)


class Solution(NamedTuple):
    """A fitted ``curve`` (n,) in the unit of its data, the bounds that it touches, and who found it.

    ``touched`` holds -1, 0, 1 for n values, n - 1 slopes and n - 2 curvatures; empty if no bound is touched.
    """

    curve: FloatArray
    touched: FloatArray = _UNTOUCHED
    solver: str = DIRECT


def solve_curves(problems: Sequence[CurveProblem]) -> list[Solution]:
    """Minimise every problem; ConvergenceError if no solver reaches an optimum that passes its check.

    One banded factorisation serves all curves. Those that keep their bounds are finished: a minimum that lies within
    the bounds is the bounded minimum. The others are solved together by :func:`compgen.fit.interior.interior`, and
    what does not pass there goes one by one to a general solver (:func:`compgen.fit.bounded.fit_bounded`).
    """
    found = [solution for part in _portions(problems) for solution in _without_bounds(part)]
    broken = [k for k, solution in enumerate(found) if solution is None]
    again = (solution for part in _portions([problems[k] for k in broken]) for solution in _bounded(part))
    return [next(again) if solution is None else solution for solution in found]


def _portions(problems: Sequence[CurveProblem]) -> Iterator[Sequence[CurveProblem]]:
    """Cut a list where about ``_PORTION`` nodes are together."""
    first, nodes = 0, 0
    for k, problem in enumerate(problems):
        if nodes and nodes + len(problem.y) > _PORTION:
            yield problems[first:k]
            first, nodes = k, 0
        nodes += len(problem.y)
    if nodes:
        yield problems[first:]


def _without_bounds(problems: Sequence[CurveProblem]) -> list[Solution | None]:
    """Fit without bounds; None for the curves that would break theirs."""
    stack = Stack.build(problems)
    curve = stack.solve()
    found: list[Solution | None] = [Solution(part) for part in stack.split(curve)]
    for k in np.flatnonzero(_breaks(stack, [problem.bounds for problem in problems], curve)):
        found[k] = None
    return found


def _breaks(stack: Stack, bounds: Sequence[Bounds], curve: FloatArray) -> BoolArray:
    """Which curves (k,) of a stack (N,) break a bound."""
    wrong: BoolArray = stack.largest(np.abs(curve)) > [bound.max_abs for bound in bounds]
    steepest, bent = [bound.max_slope for bound in bounds], [bound.max_curvature for bound in bounds]
    direction = [bound.direction for bound in bounds]
    if any(direction) or min(steepest) < math.inf:
        slope = stack.slopes(curve)
        if any(direction):
            wrong |= stack.largest(-slope * stack.of_each(direction)) > 0
        wrong |= stack.largest(np.abs(slope, out=slope)) > steepest
    if min(bent) < math.inf:
        wrong |= stack.largest(np.abs(curvatures_of(stack, curve))) > bent
    return wrong


def _bounded(problems: Sequence[CurveProblem]) -> list[Solution]:
    stack = Stack.build(problems)
    free = stack.solve()
    rows = row_stack(stack, [problem.bounds for problem in problems], free)
    near, multiplier, closed = interior(stack, rows, free, _FIRST_STEPS + round(math.log2(stack.sizes.max())))
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
