"""Levenberg-Marquardt on the scaled normal equations (Zha & Zhang 2024, eq. 28), and what the data leave undetermined.

The factor of one normal matrix is kept as long as it makes good progress: convergence is then linear with a small
ratio, and every pass costs only residuals and gradient. The exact gradient decides where the optimum is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.errors import ConvergenceError, Message, UndeterminedError
from compgen.identification.adjust.unknowns import ErrorParameters, IntArray, LeastSquaresProblem, State
from compgen.kinematics.kernel_switch import lapack

#: The remaining distance to the optimum, estimated from the last two steps, that ends the iteration (mm; angles at a
#: lever of one metre).
TOLERANCE_MM = 1e-10
#: If a smaller step of a new factor does not lower the cost, only rounding is left.
STALLED_MM = 1e-8
MAX_ITERATIONS = 80
#: After a step of this size the lines of sight have rotated so much that a new factor pays off.
FAR_MM = 0.5
#: A step that shrinks less than this relative to the previous one requires a new factor.
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
        solution, _ = lapack().dpotrs(self.lower, right * scale, lower=1)
        return np.asarray(scale * solution)

    def inverse_root(self) -> FloatArray:
        """Return the upper triangular F (size, size) with F F^T the inverse of the normal matrix.

        With S the scale that gives the normal matrix a unit diagonal and L its Cholesky factor, F = S L^-T.
        """
        inverse = np.zeros(self.lower.shape, order="F")
        _invert_lower(self.lower, inverse)
        return np.multiply(self.scale[:, None], inverse.T)


#: Triangles up to this size are inverted directly; larger ones in halves, mostly by matrix products.
_WHOLE = 64


def _invert_lower(lower: FloatArray, inverse: FloatArray) -> None:
    """Fill in the lower triangle of the inverse of a lower triangular matrix (n, n)."""
    count = len(lower)
    if count <= _WHOLE:
        inverse[:] = lapack().dtrtri(lower, lower=1)[0]
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
    lower, failed = lapack().dpotrf(scaled.T, lower=1, overwrite_a=1)  # symmetric; this order needs no copy
    if failed:
        raise LinAlgError("not positive definite")
    rcond, _ = lapack().dpocon(lower, norm, uplo="L")
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
    problem, start : the problem and its start values.
    factor : of a normal matrix near ``start``, if available.

    Raises
    ------
    ConvergenceError
        if no step lowers the cost, or no optimum is reached; it never returns a wrong result silently.
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
            if stalled and not damping:  # the cost cannot be distinguished from its rounding
                return LeastSquaresSolution(state, cost, factor, iteration, factorisations)
            if fresh:
                damping = max(10.0 * damping, 1e-6)
                if damping > 1e6:
                    raise ConvergenceError(
                        Message(
                            "no-reducing-step",
                            "the iteration found no step that reduces the residuals; check stations and units",
                        )
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
        Message(
            "no-optimum",
            "no optimum after {value} passes (last step {size:.3g} um); the data may not determine all unknowns",
            value=MAX_ITERATIONS,
            size=size * 1000,
        )
    )


def _positive_factor(matrix: FloatArray, damping: float) -> tuple[Factor, float]:
    while damping < 1e6:
        try:
            return factorise(matrix, damping), damping
        except LinAlgError:
            damping = max(10.0 * damping, 1e-6)
    raise ConvergenceError(
        Message(
            "normal-matrix-singular",
            "the normal matrix is not positive definite; the data do not determine the unknowns",
        )
    )


def step_levers(parameters: ErrorParameters, size: int) -> FloatArray:
    """Return the lever of each of ``size`` unknowns, errors first, in a step: 1 for lengths, 1000 mm for rotations, (size,)."""
    levers = np.ones(size)
    for curve in parameters.curves:
        if curve.error.kind == "angular":
            levers[curve.columns] = 1000.0
    levers[parameters.size - len(parameters.squareness) : parameters.size] = 1000.0
    return levers


# What the data do not determine: numerical rank, unobservable combinations in words, nodes without data.

#: Eigenvalues of the normal matrix with unit diagonal below this count as zero. In a determined problem they are above
#: about 1e-7, in an undetermined direction about 1e-14: a wide gap.
ZERO_EIGENVALUE = 1e-11
#: Reciprocal condition of the scaled normal matrix below which the rank is examined in detail.
SUSPICIOUS_RCOND = 1e-10
#: Number of unknowns without data that a message lists.
MOST_NAMED = 12


@dataclass(frozen=True)
class Rank:
    """Numerical rank of a problem.

    ``undetermined`` marks the unknowns (size,) that take part in a direction without data, ``combinations`` describes
    these directions, ``condition`` is the ratio of the kept eigenvalues of the scaled normal matrix.
    """

    rank: int
    size: int
    condition: float
    undetermined: NDArray[np.bool_]
    combinations: tuple[str, ...]


#: Begin of the text about unknowns that no reading depends on.
NO_DATA = "no data at all for"


def determined_factor(
    matrix: FloatArray, names: Callable[[], list[str]], what: str, suspicious: float = SUSPICIOUS_RCOND
) -> tuple[Factor, Rank | None]:
    """Return the factor of a normal matrix (size, size), and its rank if the condition requires it.

    ``names`` makes the names of the unknowns, ``what`` begins the message.

    Raises
    ------
    UndeterminedError
        if the matrix is singular; it lists the undetermined combinations.
    """
    factor = None
    try:
        factor = factorise(matrix)
        if factor.rcond > suspicious:
            return factor, None
    except LinAlgError:
        pass
    rank = describe_rank(matrix, names())
    if factor is None or rank.rank < rank.size:
        message = f"{what} determine {rank.rank} of {rank.size} unknowns; " + "; ".join(rank.combinations[:8])
        raise UndeterminedError(message, list(rank.combinations))
    return factor, rank


def describe_rank(matrix: FloatArray, names: list[str], zero: float = ZERO_EIGENVALUE) -> Rank:
    """Analyse a normal matrix (size, size) whose unknowns have ``names``; eigenvalues below ``zero`` count as none."""
    diagonal = np.diag(matrix)
    empty = diagonal <= 1e-14 * np.median(diagonal[diagonal > 0])
    scale = 1.0 / np.sqrt(np.where(empty, 1.0, diagonal))
    scaled = np.where(np.outer(empty, empty), 0.0, matrix * np.outer(scale, scale))
    eigenvalues, vectors = np.linalg.eigh(scaled)
    null = eigenvalues < zero
    kept = eigenvalues[~null]
    undetermined = np.sqrt(np.sum(vectors[:, null] ** 2, axis=1)) > 1e-4
    texts = []
    without = [names[k] for k in np.flatnonzero(empty)]
    if without:
        more = f" and {len(without) - MOST_NAMED} more" if len(without) > MOST_NAMED else ""
        texts.append(f"{NO_DATA}: {', '.join(without[:MOST_NAMED])}{more}")
    # each direction without data is described by the errors that take part in it, the leading one first
    others = vectors[:, null][:, np.sum(vectors[:, null][empty] ** 2, axis=0) < 0.5]
    for vector in _sparse_directions(others).T:
        share: dict[str, float] = {}
        for name, value in zip(names, vector, strict=True):
            share[name.split(" ")[0]] = share.get(name.split(" ")[0], 0.0) + float(value**2)
        leading = sorted((name for name in share if share[name] > 0.02), key=lambda name: -share[name])
        texts.append(
            "cannot be distinguished: " + " and ".join(leading[:6]) + (" and others" if len(leading) > 6 else "")
        )
    return Rank(
        rank=int(np.count_nonzero(~null)),
        size=len(matrix),
        condition=float(kept[-1] / kept[0]) if len(kept) else np.inf,
        undetermined=undetermined,
        combinations=tuple(dict.fromkeys(texts)),
    )


def _sparse_directions(vectors: FloatArray) -> FloatArray:
    """Rotate a null space (size, k) to vectors with few entries each (pivoted elimination), columns normalised."""
    rest = vectors.copy()
    found = []
    while rest.shape[1]:
        pivot = int(np.argmax(np.sum(rest**2, axis=1)))
        direction = rest @ rest[pivot]
        direction /= np.linalg.norm(direction)
        found.append(direction)
        rest = rest - np.outer(direction, direction @ rest)
        left, singular, _ = np.linalg.svd(rest, full_matrices=False)
        rest = left[:, singular > 1e-6]
    return np.column_stack(found) if found else vectors


def unknown_names(
    parameters: ErrorParameters, stations: tuple[str, ...], station: IntArray, group: IntArray
) -> list[str]:
    """Names of all unknowns, e.g. ``EXX at -80 mm``, ``EC0Y``, ``LT1 x``, ``LT1 dead length``."""
    names: list[str] = []
    for curve in parameters.curves:
        for column in curve.free.T:
            strongest = int(np.argmax(np.abs(column)))
            names.append(f"{curve.error.name} at {curve.nodes_mm[strongest]:g} mm")
    names += parameters.squareness
    names += [f"{name} {letter}" for name in stations for letter in "xyz"]
    owner = dict(zip(group.tolist(), station.tolist(), strict=True))
    names += [f"{stations[owner[k]]} dead length" for k in sorted(owner)]
    return names
