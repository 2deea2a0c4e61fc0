"""Levenberg-Marquardt on the scaled normal equations (Zha & Zhang 2024, eq. 28)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from compgen.core.csvio import FloatArray
from compgen.errors import ConvergenceError
from compgen.identify.problem import LengthProblem, State

#: A step below this (mm; angles count at a lever of one metre) ends the iteration. Convergence is linear with a
#: ratio below 1e-2, so the optimum is then met to about 1e-9 mm.
STEP_TOLERANCE_MM = 1e-7
MAX_ITERATIONS = 60


@dataclass(frozen=True)
class Solution:
    """Optimum of a problem; ``matrix`` is the normal matrix there, ``iterations`` the accepted steps."""

    state: State
    cost: float
    matrix: FloatArray
    iterations: int


def solve(problem: LengthProblem, start: State) -> Solution:
    """Minimise the weighted sum of squares from ``start``; ConvergenceError if no optimum is reached.

    The diagonal is scaled to 1. A plain Gauss-Newton step is tried first; the damping grows when the Cholesky
    factorisation fails or the cost rises, and falls after every success.
    """
    state, cost = start, problem.cost(start)
    damping = 0.0
    for iteration in range(MAX_ITERATIONS):
        matrix, gradient = problem.normal_equations(state)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        scaled = matrix * scale[:, None] * scale
        for _ in range(40):
            step = _damped_step(scaled, gradient * scale, damping)
            if step is not None:
                candidate = state.moved(scale * step)
                new_cost = problem.cost(candidate)
                if np.isfinite(new_cost) and new_cost <= cost * (1 + 1e-12) + 1e-18:
                    break
            damping = max(10.0 * damping, 1e-6)
        else:
            raise ConvergenceError("the iteration found no step that lowers the residuals; check stations and units")
        moved = _step_size_mm(problem, scale * step)
        state, cost = candidate, new_cost
        damping = damping / 10.0 if damping > 1e-9 else 0.0
        if moved < STEP_TOLERANCE_MM:
            return Solution(state, cost, matrix, iteration + 1)
    raise ConvergenceError(
        f"no optimum after {MAX_ITERATIONS} iterations (last step {moved * 1000:.3g} um); "
        "the data may not determine all unknowns"
    )


def _damped_step(scaled: FloatArray, gradient: FloatArray, damping: float) -> FloatArray | None:
    try:
        factor = cho_factor(scaled + damping * np.eye(len(scaled)), lower=True)
    except LinAlgError:
        return None
    return -np.asarray(cho_solve(factor, gradient))


def _step_size_mm(problem: LengthProblem, step: FloatArray) -> float:
    """Largest change of any unknown, angles at a lever of 1000 mm."""
    size = np.abs(step)
    for curve in problem.parameters.curves:
        if curve.error.kind == "angular":
            size[curve.columns] *= 1000.0
    first = problem.parameters.size - len(problem.parameters.squareness)
    size[first : problem.parameters.size] *= 1000.0
    return float(size.max())
