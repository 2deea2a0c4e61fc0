"""The noise of a measurement: white, slow parts of each channel and common to all, and parts that change from run to run.

The covariance is a sum of kernels whose variances are found by restricted maximum likelihood on the differences of
repeats (Patterson and Thompson 1971): every effect that depends on position, direction, feed, load or set-up cancels
there, known or not. Channels of a stop are rotated to their mean and contrasts, which decouples a common part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import csr_array

from compgen.core.csvio import FloatArray
from compgen.diagnose.layout import Block, IntArray, Layout

#: Time constants of the kernels, in distances between stops.
TAU = (3.0, 10.0, 40.0, 200.0, 2000.0)
#: Lower bound of a variance, as a share of the raw one.
LEAST_SHARE = 1e-5
#: Differences of repeats, and stops without repeats, beyond these numbers cost time and tell little more.
MOST_DIFFERENCES, MOST_STOPS = 640, 450


@dataclass(frozen=True)
class Variances:
    """Variances of the kernels, mm^2: white, own to each channel (K,), common to all (K,); ``runs`` of the last two."""

    white: float
    own: FloatArray
    common: FloatArray

    @property
    def slow(self) -> float:
        """Variance of everything but white in one channel."""
        return float(self.own.sum() + self.common.sum())

    @property
    def total(self) -> float:
        """Variance of one reading."""
        return self.white + self.slow


@dataclass(frozen=True)
class Noise:
    """The fitted noise model.

    Parameters
    ----------
    variances : of the kernels.
    scale : factor s of the standard deviation of every reading, (n,); 1 without dependence on range.
    quadratic : d' P d of the differences, the pure-error sum of squares.
    freedom : its degrees of freedom.
    criterion : twice the REML criterion, up to a constant.
    source : ``"repeats"``, ``"given"`` or ``"assumed"``.
    spacing_s : median distance between stops.
    """

    variances: Variances
    scale: FloatArray
    quadratic: float
    freedom: int
    criterion: float
    source: str
    spacing: float


def kernels(
    time: FloatArray, spacing: float, run: IntArray, in_run: FloatArray, *, runs: bool = True
) -> list[FloatArray]:
    """Correlation matrices (T, T) of a block: one per time constant, then two of single runs."""
    apart = np.abs(time[:, None] - time[None, :]) / spacing
    found = [np.exp(-apart / tau) for tau in TAU]
    if runs and len(np.unique(run)) > 1:
        same = (run[:, None] == run[None, :]).astype(np.float64)
        found += [same, same * np.outer(in_run, in_run)]
    else:
        found += [np.zeros_like(apart)] * 2
    return found


def rotation(channels: int) -> FloatArray:
    """Orthonormal matrix (c, c) whose first row takes the mean of the channels, the others contrasts."""
    matrix = np.zeros((channels, channels))
    matrix[0] = 1.0 / np.sqrt(channels)
    for k in range(1, channels):
        matrix[k, :k] = 1.0
        matrix[k, k] = -k
        matrix[k] /= np.sqrt(k * (k + 1.0))
    return matrix


def rotated(block: Block, columns: FloatArray) -> FloatArray:
    """Columns (n, k) of all readings in the rotated channels of a block, (c, T, k)."""
    picked = columns[block.rows]  # (T, c, k)
    if block.channels == 1:
        return np.ascontiguousarray(picked.transpose(1, 0, 2), dtype=np.float64)
    return np.asarray(np.einsum("dc,tck->dtk", rotation(block.channels), picked, optimize=True))


def spacing_of(layout: Layout) -> float:
    """Median distance between stops in time, 1 if they have none."""
    steps = np.diff(layout.time)
    steps = steps[steps > 0]
    return float(np.median(steps)) if steps.size else 1.0


def difference_matrix(layout: Layout, block: Block) -> csr_array:
    """Orthonormal differences (d, T) of the repeats in a block; stops of one cell in their order in time."""
    cells = layout.cell[block.stop]
    order = np.argsort(cells, kind="stable")
    rows, columns, values, at = [], [], [], 0
    bounds = np.flatnonzero(np.diff(cells[order], prepend=-1, append=-1))
    for first, last in zip(bounds[:-1], bounds[1:], strict=True):
        members = order[first:last]
        for k in range(1, len(members)):
            share = 1.0 / np.sqrt(k * (k + 1.0))
            rows += [at] * (k + 1)
            columns += members[: k + 1].tolist()
            values += [-share] * k + [k * share]
            at += 1
    return csr_array((values, (rows, columns)), shape=(at, len(cells)))


@dataclass(frozen=True)
class _Part:
    """One block in its differences: kernels (d, d), data (c, d), fixed effects (c, d, q)."""

    kernels: list[FloatArray]
    data: FloatArray
    fixed: FloatArray


@dataclass
class Reml:
    """The REML criterion of the differences of repeats; log-variances of white, own and common kernels."""

    parts: list[_Part]
    fixed: int
    common: bool
    starts: FloatArray

    def value(self, log_variance: FloatArray) -> tuple[float, FloatArray, float]:
        """Criterion, its gradient, and d' P d."""
        theta = np.exp(log_variance)
        count = len(TAU) + 2
        own, shared = theta[1 : 1 + count], theta[1 + count :] if self.common else np.zeros(count)
        solved = [self._solve(part, theta[0], own, shared) for part in self.parts]
        normal = sum((piece[2] for piece in solved), np.zeros((self.fixed, self.fixed)))
        right = sum((piece[3] for piece in solved), np.zeros(self.fixed))
        logdet = sum(piece[4] for piece in solved)
        quadratic = sum(piece[5] for piece in solved)
        inverse = np.zeros_like(normal)
        beta = np.zeros(self.fixed)
        if self.fixed:
            inverse = np.linalg.inv(normal)
            beta = inverse @ right
            quadratic -= float(right @ beta)
            logdet += float(np.linalg.slogdet(normal)[1])
        gradient = np.zeros(len(log_variance))
        for part, piece in zip(self.parts, solved, strict=True):
            self._add_gradient(gradient, part, piece, inverse, beta)
        return 0.5 * (logdet + quadratic), gradient * theta, quadratic

    @staticmethod
    def _solve(part: _Part, white: float, own: FloatArray, shared: FloatArray) -> tuple:  # type: ignore[type-arg]
        channels, size = part.data.shape
        contrast = white * np.eye(size)
        for theta, kernel in zip(own, part.kernels, strict=True):
            contrast += theta * kernel
        matrices = [contrast]
        if channels > 1 and shared.any():
            mean = contrast.copy()
            for theta, kernel in zip(shared, part.kernels, strict=True):
                mean += channels * theta * kernel
            matrices = [mean, contrast]
        inverses, logdets = zip(*(_inverse(matrix) for matrix in matrices), strict=True)
        which = [0, *[len(matrices) - 1] * (channels - 1)]
        weighted = np.stack([inverses[which[c]] @ part.fixed[c] for c in range(channels)])
        data = np.stack([inverses[which[c]] @ part.data[c] for c in range(channels)])
        normal = np.einsum("cdq,cdr->qr", part.fixed, weighted, optimize=True)
        right = np.einsum("cdq,cd->q", weighted, part.data)
        logdet = float(sum(logdets[which[c]] for c in range(channels)))
        quadratic = float(np.sum(part.data * data))
        return inverses, weighted, normal, right, logdet, quadratic, data, which

    def _add_gradient(
        self,
        gradient: FloatArray,
        part: _Part,
        piece: tuple,  # type: ignore[type-arg]
        inverse: FloatArray,
        beta: FloatArray,
    ) -> None:
        inverses, weighted, _, _, _, _, data, which = piece
        residual = data - weighted @ beta  # P d, (c, d)
        count = len(TAU) + 2
        for group in range(len(inverses)):
            mine = [c for c in range(len(which)) if which[c] == group]
            p = len(mine) * inverses[group]
            if self.fixed:
                tall = np.hstack([weighted[c] for c in mine])
                turned = np.hstack([weighted[c] @ inverse for c in mine])
                p = p - tall @ turned.T
            vectors = residual[mine]
            p -= vectors.T @ vectors
            trace = np.array([np.vdot(p, kernel) for kernel in part.kernels])
            gradient[0] += 0.5 * np.trace(p)
            gradient[1 : 1 + count] += 0.5 * trace
            if self.common and group == 0 and len(which) > 1:
                gradient[1 + count :] += 0.5 * len(which) * trace


def _inverse(matrix: FloatArray) -> tuple[FloatArray, float]:
    """Inverse and logarithm of the determinant of a covariance."""
    factor, failed = lapack.dpotrf(matrix, lower=1, overwrite_a=0)
    if failed:
        raise np.linalg.LinAlgError("the covariance is not positive definite")
    logdet = 2.0 * float(np.log(np.diag(factor)).sum())
    inverse, _ = lapack.dpotri(factor, lower=1, overwrite_c=1)
    inverse = np.tril(inverse) + np.tril(inverse, -1).T
    return inverse, logdet


def reml_problem(
    layout: Layout,
    residual: FloatArray,
    fixed: FloatArray,
    *,
    repeats: bool = True,
    runs: bool = True,
    numbered: bool = False,
) -> Reml:
    """Set up the criterion: residuals (n,) and fixed effects (n, q) in the differences of repeats.

    Without ``repeats`` the residuals themselves are taken; they must then hold nothing but noise. ``numbered``: noise
    goes on from stop to stop, however long that takes.
    """
    time = np.arange(layout.stops, dtype=np.float64) if numbered else layout.time
    spacing = 1.0 if numbered else spacing_of(layout)
    parts, columns = [], np.column_stack([residual, fixed])
    for block in layout.blocks:
        turned = rotated(block, columns)
        size = len(block.stop)
        matrix = difference_matrix(layout, block) if repeats else _thinned(size)
        if not matrix.shape[0]:
            continue
        if matrix.shape[0] > MOST_DIFFERENCES:
            matrix = matrix[:MOST_DIFFERENCES]
        pattern = kernels(time[block.stop], spacing, layout.run[block.stop], layout.in_run[block.stop], runs=runs)
        between = [np.ascontiguousarray((matrix @ (matrix @ kernel).T).T) for kernel in pattern]
        channels = np.stack([matrix @ turned[c] for c in range(block.channels)])
        parts.append(_Part(between, np.ascontiguousarray(channels[:, :, 0]), channels[:, :, 1:]))
    return _with_fixed(parts)


def _thinned(size: int) -> csr_array:
    keep = np.arange(min(size, MOST_STOPS))
    return csr_array((np.ones(len(keep)), (keep, keep)), shape=(len(keep), size))


def _with_fixed(parts: list[_Part]) -> Reml:
    """Orthonormalise the fixed effects over all parts, without directions that do not vary."""
    common = any(part.data.shape[0] > 1 for part in parts)
    stacked = np.concatenate([part.fixed.reshape(part.data.size, part.fixed.shape[2]) for part in parts])
    norm = np.linalg.norm(stacked, axis=0)
    varying = norm > 1e-9
    stacked = stacked[:, varying] / norm[varying]
    basis = np.zeros((len(stacked), 0))
    if stacked.shape[1]:
        u, singular, _ = np.linalg.svd(stacked, full_matrices=False)
        basis = u[:, singular > 1e-3 * singular[0]]
    raw = np.concatenate([part.data.ravel() for part in parts])
    start = float(np.mean((raw - basis @ (basis.T @ raw)) ** 2))
    done, at = [], 0
    for part in parts:
        rows = part.data.size
        fixed = basis[at : at + rows].reshape(*part.data.shape, basis.shape[1])
        done.append(_Part(part.kernels, part.data, np.ascontiguousarray(fixed)))
        at += rows
    count = len(TAU) + 2
    variances = np.full(1 + count * (2 if common else 1), 0.02 * start)
    variances[0] = 0.8 * start
    return Reml(done, basis.shape[1], common, variances)


def fit_reml(problem: Reml, *, start: FloatArray | None = None, steps: int = 60) -> tuple[Variances, float, float, int]:
    """Return variances, d' P d, the criterion, and the degrees of freedom of the differences."""
    raw = float(problem.starts[0]) / 0.8
    bound = (np.log(LEAST_SHARE * raw), np.log(100.0 * raw))
    first = np.clip(np.log(problem.starts if start is None else start), *bound)

    def value(x: FloatArray) -> tuple[float, FloatArray]:
        found = problem.value(x)
        return found[0], found[1]

    from scipy.optimize import minimize  # imported here: slow to load

    result = minimize(
        value, first, jac=True, method="L-BFGS-B", bounds=[bound] * len(first), options={"maxiter": steps, "ftol": 2e-6}
    )
    criterion, _, quadratic = problem.value(result.x)
    theta = np.exp(result.x)
    theta[theta <= LEAST_SHARE * raw * 1.01] = 0.0
    count = len(TAU) + 2
    common = theta[1 + count :] if problem.common else np.zeros(count)
    freedom = sum(part.data.size for part in problem.parts) - problem.fixed
    return (
        Variances(float(max(theta[0], LEAST_SHARE * raw)), theta[1 : 1 + count], common),
        quadratic,
        2 * criterion,
        freedom,
    )


def packed(variances: Variances, common: bool) -> FloatArray:
    """Variances as start values of :func:`fit_reml`."""
    parts: Sequence[FloatArray] = [np.array([variances.white]), variances.own, *([variances.common] if common else [])]
    return np.maximum(np.concatenate(parts), 1e-30)
