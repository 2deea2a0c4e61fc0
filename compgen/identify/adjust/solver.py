"""Levenberg-Marquardt on the scaled normal equations (Zha & Zhang 2024, eq. 28), with a frozen factor.

The factor of one normal matrix serves as long as it makes good progress: convergence is then linear with a small
ratio, and every pass costs only residuals and gradient. The exact gradient decides where the optimum is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg.lapack import dpocon, dpotrf, dpotrs, dtrtri

from compgen.data.csv_files import FloatArray
from compgen.errors import ConvergenceError
from compgen.identify.adjust.unknowns import ErrorParameters, LeastSquaresProblem, State

#: The remaining distance to the optimum, estimated from the last two steps, that ends the iteration (mm; angles count
#: at a lever of one metre).
TOLERANCE_MM = 1e-10
#: A step of a new factor below this that does not lower the cost shows that the cost is nothing but rounding.
STALLED_MM = 1e-8
MAX_ITERATIONS = 80
#: After a step of this size the lines of sight have turned so much that a new factor pays.
FAR_MM = 0.5
#: A step that shrinks less than this against the one before asks for a new factor.
SLOW = 0.2


@dataclass(frozen=True)
class Factor:
    """Cholesky factor of a normal matrix with unit diagonal, plus damping; ``rcond`` estimates 1/condition."""

    matrix: FloatArray
    lower: FloatArray
    scale: FloatArray
    rcond: float

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the solution for one right side (size,) or several (size, k)."""
        scale = self.scale if right.ndim == 1 else self.scale[:, None]
        solution, _ = dpotrs(self.lower, right * scale, lower=1)
        return np.asarray(scale * solution)

    def inverse_root(self) -> FloatArray:
        """Return the upper triangular F (size, size) with F F^T the inverse of the normal matrix.

        With S the scale that gives the normal matrix a unit diagonal and L its Cholesky factor, F = S L^-T.
        """
        inverse = np.zeros(self.lower.shape, order="F")
        _invert_lower(self.lower, inverse)
        return np.multiply(self.scale[:, None], inverse.T)


#: Triangles up to this size are inverted at once; larger ones in halves, where most of the work is matrix products.
_WHOLE = 64


def _invert_lower(lower: FloatArray, inverse: FloatArray) -> None:
    """Fill in the lower triangle of the inverse of a lower triangular matrix (n, n)."""
    count = len(lower)
    if count <= _WHOLE:
        inverse[:] = dtrtri(lower, lower=1)[0]
        return
    half = count // 2
    _invert_lower(lower[:half, :half], inverse[:half, :half])
    _invert_lower(lower[half:, half:], inverse[half:, half:])
    np.matmul(inverse[half:, half:], -(lower[half:, :half] @ inverse[:half, :half]), out=inverse[half:, :half])


def factorise(matrix: FloatArray, damping: float = 0.0) -> Factor:
    """Factorise a normal matrix (size, size); LinAlgError if it is not positive definite."""
    diagonal = np.diag(matrix)
    if not diagonal.min() > 0.0:
        raise LinAlgError("an unknown has no data")
    scale = 1.0 / np.sqrt(diagonal)
    scaled = matrix * (scale[:, None] * scale)
    if damping:
        scaled[np.diag_indices(len(scaled))] += damping
    norm = float(np.abs(scaled).sum(axis=0).max())
    lower, failed = dpotrf(scaled.T, lower=1, overwrite_a=1)  # symmetric, and in the order that needs no copy
    if failed:
        raise LinAlgError("not positive definite")
    rcond, _ = dpocon(lower, norm, uplo="L")
    return Factor(matrix, lower, scale, float(rcond))


@dataclass(frozen=True)
class LeastSquaresSolution:
    """Optimum of a problem; ``factor`` of the last normal matrix, ``iterations`` the passes over the data."""

    state: State
    cost: float
    factor: Factor
    iterations: int
    factorisations: int


def solve(problem: LeastSquaresProblem, start: State, factor: Factor | None = None) -> LeastSquaresSolution:
    """Minimise the weighted sum of squares from ``start``.

    Parameters
    ----------
    problem, start : what to minimise and from where.
    factor : of a normal matrix near ``start``, if there is one already.

    Raises
    ------
    ConvergenceError
        if no step lowers the cost, or no optimum is reached; never a silent wrong answer.
    """
    state = start
    cost, gradient = problem.evaluate(state)
    damping, previous, factorisations = 0.0, np.inf, 0
    levers = step_levers(problem.parameters, problem.size)
    fresh = False
    for iteration in range(1, MAX_ITERATIONS + 1):
        if factor is None:
            factor, damping = _positive_factor(problem.normal_matrix(state), damping)
            factorisations += 1
            fresh = True
        step = -factor.solve(gradient)
        size = float(np.max(np.abs(step) * levers))
        candidate = state.moved(step)
        new_cost, new_gradient = problem.evaluate(candidate)
        if not new_cost <= cost * (1 + 1e-9) + 1e-18:
            stalled = size < (STALLED_MM if fresh else TOLERANCE_MM)
            if stalled and not damping:  # the cost cannot be told from its rounding any more
                return LeastSquaresSolution(state, cost, factor, iteration, factorisations)
            if fresh:
                damping = max(10.0 * damping, 1e-6)
                if damping > 1e6:
                    raise ConvergenceError(
                        "the iteration found no step that lowers the residuals; check stations and units"
                    )
            factor = None
            continue
        state, cost, gradient = candidate, new_cost, new_gradient
        ratio = size / previous if np.isfinite(previous) else 1.0
        if not damping and size * min(ratio, 1.0) < TOLERANCE_MM:
            return LeastSquaresSolution(state, cost, factor, iteration, factorisations)
        if damping:
            damping = damping / 10.0 if damping > 1e-8 else 0.0
            factor = None
        elif size > FAR_MM or (ratio > SLOW and np.isfinite(previous)):
            factor = None
        previous, fresh = size, False
    raise ConvergenceError(
        f"no optimum after {MAX_ITERATIONS} passes (last step {size * 1000:.3g} um); "
        "the data may not determine all unknowns"
    )


def _positive_factor(matrix: FloatArray, damping: float) -> tuple[Factor, float]:
    while damping < 1e6:
        try:
            return factorise(matrix, damping), damping
        except LinAlgError:
            damping = max(10.0 * damping, 1e-6)
    raise ConvergenceError("the normal matrix is not positive definite; the data do not determine the unknowns")


def step_levers(parameters: ErrorParameters, size: int) -> FloatArray:
    """Lever of each of ``size`` unknowns, errors first, in a step: 1 for lengths, 1000 mm for rotations, (size,)."""
    levers = np.ones(size)
    for curve in parameters.curves:
        if curve.error.kind == "angular":
            levers[curve.columns] = 1000.0
    levers[parameters.size - len(parameters.squareness) : parameters.size] = 1000.0
    return levers
