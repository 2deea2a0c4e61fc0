"""The constrained fit as it reads on paper, for comparison: the definition that the fast solver is held against."""

from __future__ import annotations

import math
from importlib import import_module
from typing import Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.errors import ConvergenceError
from compgen.fit.held import Row
from compgen.fit.smooth import second_difference


def reference_curve(
    position_mm: FloatArray,
    y: FloatArray,
    weight: FloatArray,
    held: tuple[Row, ...],
    mu: float,
    limits: tuple[float, float] = (math.inf, math.inf),
) -> FloatArray:
    """Minimise sum(w (c - y)^2) + mu |D2 c|^2 with held functionals zero, |c| and |slope| within ``limits``.

    Positions, data and weights have shape (n,), and so has the result, in the unit of ``y``. Slow and plain.
    """
    cp: Any = import_module("cvxpy")
    c = cp.Variable(len(y))
    cost = cp.sum_squares(cp.multiply(np.sqrt(weight), c - y))
    for k, (first, middle, last) in enumerate(second_difference(position_mm)):
        cost = cost + mu * cp.square(first * c[k] + middle * c[k + 1] + last * c[k + 2])
    rules = [sum(factor * c[node] for node, factor in row) == 0 for row in held]
    largest, steepest = limits
    if math.isfinite(largest):
        rules.append(cp.abs(c) <= largest)
    if math.isfinite(steepest):
        rules.append(cp.abs(cp.diff(c)) <= steepest * np.diff(position_mm))
    problem = cp.Problem(cp.Minimize(cost), rules)
    problem.solve(solver="CLARABEL", tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12)
    if c.value is None:
        raise ConvergenceError(f"the reference fit ended with {problem.status}")
    return np.asarray(c.value)
