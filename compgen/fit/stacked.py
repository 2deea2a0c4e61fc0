"""Many curves in one banded system: their nodes follow one another, and nothing couples one curve with the next.

The smoother of ``smooth.py`` for curves that are held at whole nodes: A = W + mu D^T D has half-bandwidth 2, held nodes
keep their place with 1 on the diagonal. One factorisation serves all curves, whatever their nodes, weights and mu; the
arithmetic is done over all nodes at once, so that twenty short curves cost little more than one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbsv, dpbtrs

from compgen.core.csvio import FloatArray
from compgen.core.kernels import use_compiled
from compgen.errors import ConvergenceError
from compgen.fit.bounds import Bounds

_SETTLED, _REFINEMENTS = 1e-12, 6
#: With the largest diagonal of A below this many of the smallest weights the first solution has 9 digits or more.
_EASY = 1e6
#: Nodes from which loading the compiled solution pays for a single fit.
_LARGE = 10_000_000
_HELD = np.array([1.0, 0.0, 0.0])
_TINY = float(np.finfo(float).tiny)
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class CurveProblem:
    """minimise sum w (c - y)^2 + mu |D2 c|^2 with c zero at the ``held`` nodes and within ``bounds``.

    ``position_mm``, ``y``, ``weight`` have shape (n,); ``mu`` is dimensionless, ``bounds`` count in the unit of ``y``.
    """

    position_mm: FloatArray
    y: FloatArray
    weight: FloatArray
    held: tuple[int, ...]
    mu: float
    bounds: Bounds = Bounds()


@dataclass(frozen=True)
class Stack:
    """k curves with N nodes in all. Everything that acts on a held node is zero.

    ``starts`` (k,) and ``sizes`` (k,): where the curves stand; ``held``: the held nodes; ``per_mm`` (N,): inverse
    distance from each node to the next of its curve, zero at the last; ``weight`` (N,); ``stiff`` (N,): mu times the
    square of the factor of the difference of slopes that begins at a node; ``pull`` (N,): W y.
    """

    starts: IntArray
    sizes: IntArray
    held: IntArray
    per_mm: FloatArray
    weight: FloatArray
    stiff: FloatArray
    pull: FloatArray

    @classmethod
    def build(cls, problems: Sequence[CurveProblem]) -> Stack:
        """Lay the curves one behind the other."""
        count = [len(problem.y) for problem in problems]
        after = list(accumulate(count))
        each = zip(after, count, problems, strict=True)
        held = np.array([end - n + k for end, n, problem in each for k in problem.held], dtype=np.intp)
        sizes, ends = np.array(count), np.array(after)
        parts = [[p.position_mm for p in problems], [p.weight for p in problems], [p.y for p in problems]]
        position, weight, pull = np.concatenate([part for kind in parts for part in kind]).reshape(3, -1)
        weight[held] = 0.0
        pull *= weight
        starts = ends - sizes
        mean = (position[ends - 1] - position[starts]) / np.maximum(sizes - 1, 1)
        per_mm = _inverse_steps(position, ends)
        level = np.array([2 * problem.mu for problem in problems]) * mean * mean * mean
        return cls(starts, sizes, held, per_mm, weight, _stiffness(per_mm, level.repeat(sizes)), pull)

    @cached_property
    def free(self) -> FloatArray:
        """0 at held nodes, else 1: (N,)."""
        free = np.ones(len(self.weight))
        free[self.held] = 0.0
        return free

    @cached_property
    def bend(self) -> FloatArray:
        """sqrt(mu) D2 (3, N), entry [i, j] of the row j acts on node j + i."""
        bend = np.zeros((3, len(self.weight)))
        root = np.sqrt(self.stiff[:-1])
        bend[0, :-1], bend[2, :-1] = root * self.per_mm[:-1], root * self.per_mm[1:]
        bend[1] = -bend[0] - bend[2]
        bend *= windows(self.free)
        return bend

    def pick(self, chosen: BoolArray) -> Stack:
        """Keep the chosen curves (k,)."""
        nodes, sizes = self.of_each(chosen), self.sizes[chosen]
        parts = (self.per_mm, self.weight, self.stiff, self.pull)
        held = np.flatnonzero(self.free[nodes] == 0)
        return Stack(np.cumsum(sizes) - sizes, sizes, held, *(part[nodes] for part in parts))

    def of_each(self, values: Any) -> Any:
        """Repeat one value per curve (k,) over its nodes (N,)."""
        return np.asarray(values).repeat(self.sizes)

    def largest(self, values: FloatArray) -> FloatArray:
        """Largest of node values (..., N) in each curve (..., k)."""
        return np.maximum.reduceat(values, self.starts, axis=-1)

    def total(self, values: FloatArray) -> FloatArray:
        """Sum of node values (..., N) over each curve (..., k)."""
        return np.add.reduceat(values, self.starts, axis=-1)

    def split(self, values: FloatArray) -> list[FloatArray]:
        """Node values (N,) curve by curve."""
        starts = self.starts.tolist()
        return [values[start:end] for start, end in zip(starts, [*starts[1:], len(values)], strict=True)]

    def slopes(self, c: FloatArray) -> FloatArray:
        """Slope (N,) from each node to the next of its curve, zero at the last."""
        slope = np.empty(len(c))
        np.subtract(c[1:], c[:-1], out=slope[:-1])
        slope[-1] = 0.0
        slope *= self.per_mm
        return slope

    def band(self) -> FloatArray:
        """A as a lower band (3, N), entry [d, j] couples j and j + d; held nodes have 1 on the diagonal."""
        band, before, after = lower_band(len(self.weight)), self.per_mm[:-1], self.per_mm[1:]
        one = self.stiff[:-1] * before
        two = one * after  # first times last coefficient of a row
        band[2, :-1], band[2, -1] = two, 0.0
        one *= before
        diagonal = self.weight.copy()
        diagonal[:-1] += one
        one += two  # first times middle, less its sign
        beside = np.zeros(len(diagonal))
        np.negative(one, out=beside[:-1])
        diagonal[1:] += one
        np.multiply(self.stiff[:-1], after, out=one)
        one *= after
        diagonal[2:] += one[:-1]
        one += two  # middle times last, less its sign
        diagonal[1:] += one
        beside[1:] -= one
        band[0], band[1] = diagonal, beside
        self.hold(band)
        return band

    def hold(self, band: FloatArray) -> None:
        """Cut the held nodes from a lower band (3, N), 1 on the diagonal."""
        band.T[self.held] = _HELD
        band[1, self.held - 1] = band[2, self.held - 2] = 0.0  # those past an end are zero anyway

    def apply(self, c: FloatArray) -> FloatArray:
        """A c for node values (N,) that are zero at held nodes, without forming the product of differences."""
        product = spread(self.bend, gather(self.bend, c))
        product += self.weight * c
        return product

    def solve(self) -> FloatArray:
        """Fitted curves (N,) without bounds, refined against the product form of A."""
        band = self.band()
        own = self.weight.copy()
        own[self.held] = 1.0
        height, lowest = float(band[0].max()), float(own.min())
        if height <= _EASY * lowest and len(own) > 1 and use_compiled(len(own), _LARGE):
            return self._solved_at_once(band)
        factor, solved, info = dpbsv(band, self.pull, lower=1, overwrite_ab=1)
        if info:
            raise _singular()
        c: FloatArray = solved.ravel()
        if height <= _EASY * lowest:
            return c
        for _ in range(_REFINEMENTS):
            step = dpbtrs(factor, self.pull - self.apply(c), lower=1)[0].ravel()
            c += step
            if not (self.largest(np.abs(step)) > _SETTLED * self.largest(np.abs(c))).any():
                break
        return np.asarray(self.free * c)

    def _solved_at_once(self, band: FloatArray) -> FloatArray:
        """Solve by the compiled loop: half the time of LAPACK for so narrow a band."""
        from compgen.fit.compiled import band_solver

        c = np.empty(len(self.pull))
        if not band_solver()(band, self.pull, c):
            raise _singular()
        return c


def _singular() -> ConvergenceError:
    return ConvergenceError("the system of the smooth curves is not positive definite; lower the smoothness")


def lower_band(n: int) -> FloatArray:
    """Return room for a lower band (3, n) in the order of LAPACK, which works on it without a copy."""
    return np.empty((n, 3)).T


def _inverse_steps(position_mm: FloatArray, ends: IntArray) -> FloatArray:
    per_mm = np.ones(len(position_mm))
    np.subtract(position_mm[1:], position_mm[:-1], out=per_mm[:-1])
    per_mm[ends - 1] = math.inf  # no step from one curve to the next
    return np.divide(1.0, per_mm, out=per_mm)


def _stiffness(per_mm: FloatArray, level: FloatArray) -> FloatArray:
    """Square (N,) of the factor of rows of D2 by slopes, see :func:`compgen.fit.smooth.second_difference`.

    With p, q the inverses of the steps beside a node a row is sqrt(mu h^3 2 p q/(p + q)) (p, -p - q, q); ``level`` (N,)
    is 2 mu h^3.
    """
    first, second = per_mm[:-1], per_mm[1:]
    stiff = np.empty(len(per_mm))
    stiff[-1] = 0.0
    inner = np.add(first, second, out=stiff[:-1])
    inner += _TINY  # a curve of one node has no steps
    np.divide(first, inner, out=inner)
    inner *= second
    inner *= level[:-1]
    return stiff


def curvature_rows(per_mm: FloatArray) -> FloatArray:
    """Coefficients (3, N) of c'' in windows of three nodes; zero where a window leaves its curve."""
    rows = np.zeros((3, len(per_mm)))
    first, second = per_mm[:-1], per_mm[1:]
    scale = 2 * (first / (first + second + _TINY)) * second  # 2 / (step before + step after)
    rows[0, :-1], rows[2, :-1] = scale * first, scale * second
    rows[1] = -rows[0] - rows[2]
    return rows


def curvatures_of(stack: Stack, c: FloatArray) -> FloatArray:
    """Second derivative (N,) in the window that begins at each node, see :func:`compgen.fit.bounds.curvature`."""
    return gather(curvature_rows(stack.per_mm), c)


def windows(values: FloatArray) -> FloatArray:
    """Values (N,) seen from the first, middle and last node of each window of three: (3, N), zero past the end."""
    seen = np.zeros((3, len(values)))
    seen[0], seen[1, :-1], seen[2, :-2] = values, values[1:], values[2:]
    return seen


def gather(rows: FloatArray, c: FloatArray) -> FloatArray:
    """Rows (..., 3, N), each acting on three nodes, times node values (N,): (..., N)."""
    out = rows[..., 0, :] * c
    out[..., :-1] += rows[..., 1, :-1] * c[1:]
    out[..., :-2] += rows[..., 2, :-2] * c[2:]
    return out


def spread(rows: FloatArray, v: FloatArray) -> FloatArray:
    """Transposed rows (3, N) times row values (N,): (N,)."""
    out: FloatArray = rows[0] * v
    out[1:] += (rows[1] * v)[:-1]
    out[2:] += (rows[2] * v)[:-2]
    return out
