"""Many curves in one banded system: their nodes follow one another, and nothing couples one curve with the next.

The smoother of ``smooth.py`` for curves that are held at whole nodes: A = W + mu D^T D has half-bandwidth 2, held nodes
keep their place with 1 on the diagonal. One factorisation serves all curves, whatever their nodes, weights and mu; the
arithmetic is done over all nodes at once, so that twenty short curves cost little more than one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dpbtrs

from compgen.core.csvio import FloatArray
from compgen.errors import ConvergenceError
from compgen.fit.bounds import Bounds

_SETTLED, _REFINEMENTS = 1e-12, 6
#: With the largest diagonal of A below this many of the smallest weights the first solution has 9 digits or more.
_EASY = 1e6
IntArray = NDArray[np.intp]


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

    ``starts`` (k,) and ``sizes`` (k,): where the curves stand; ``position_mm`` (N,); ``weight`` (N,), ``free`` (N,);
    ``bend`` (3, N): sqrt(mu) D2, entry [i, j] of the row j acts on node j + i; ``pull`` (N,): W y.
    """

    starts: IntArray
    sizes: IntArray
    position_mm: FloatArray
    weight: FloatArray
    free: FloatArray
    bend: FloatArray
    pull: FloatArray

    @classmethod
    def build(cls, problems: Sequence[CurveProblem]) -> Stack:
        """Lay the curves one behind the other."""
        sizes = np.array([len(problem.y) for problem in problems])
        ends = np.cumsum(sizes)
        starts = ends - sizes
        position = np.concatenate([problem.position_mm for problem in problems])
        free = np.ones(len(position))
        free[[start + k for start, problem in zip(starts.tolist(), problems, strict=True) for k in problem.held]] = 0.0
        weight = free * np.concatenate([problem.weight for problem in problems])
        span = position[ends - 1] - position[starts]
        root = np.array([problem.mu for problem in problems]) ** 0.5 * (span / np.maximum(sizes - 1, 1)) ** 1.5
        bend = _second_difference(position, ends, np.repeat(root, sizes)) * windows(free)
        return cls(
            starts, sizes, position, weight, free, bend, weight * np.concatenate([problem.y for problem in problems])
        )

    def pick(self, chosen: NDArray[np.bool_]) -> Stack:
        """Stack of the curves that are chosen (k,)."""
        nodes, sizes = self.of_each(chosen), self.sizes[chosen]
        parts = (self.position_mm, self.weight, self.free, self.bend, self.pull)
        return Stack(np.cumsum(sizes) - sizes, sizes, *(part[..., nodes] for part in parts))

    def of_each(self, values: Any) -> Any:
        """Repeat one value per curve (k,) over its nodes (N,)."""
        return np.repeat(values, self.sizes)

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
        slope = np.zeros(len(c))
        slope[:-1] = np.diff(c)
        slope[self.starts + self.sizes - 1] = 0.0
        return slope / steps_mm(self)

    def band(self) -> FloatArray:
        """A as a lower band (3, N), entry [d, j] couples j and j + d; held nodes have 1 on the diagonal."""
        band = np.empty((3, len(self.weight)))
        band_of(self.bend, band)
        band[0] += self.weight
        band[0] += 1.0 - self.free
        return band

    def apply(self, c: FloatArray) -> FloatArray:
        """A c for node values (N,) that are zero at held nodes, without forming the product of differences."""
        return self.weight * c + spread(self.bend, gather(self.bend, c))

    def solve(self) -> FloatArray:
        """Fitted curves (N,) without bounds, refined against the product form of A."""
        band = self.band()
        height = float(band[0].max())
        factor, info = dpbtrf(band, lower=1, overwrite_ab=1)
        if info:
            raise ConvergenceError("the system of the smooth curves is not positive definite; lower the smoothness")
        c = dpbtrs(factor, self.pull, lower=1)[0].ravel()
        if height <= _EASY * float((self.weight + (1.0 - self.free) * height).min()):
            return np.asarray(self.free * c)
        for _ in range(_REFINEMENTS):
            step = dpbtrs(factor, self.pull - self.apply(c), lower=1)[0].ravel()
            c += step
            if not (self.largest(np.abs(step)) > _SETTLED * self.largest(np.abs(c))).any():
                break
        return np.asarray(self.free * c)


def _second_difference(position_mm: FloatArray, ends: IntArray, root: FloatArray) -> FloatArray:
    """Coefficients (3, N) of ``root`` (N,) times D2/h^1.5, see :func:`compgen.fit.smooth.second_difference`."""
    slope = np.ones(len(position_mm))
    slope[:-1] = position_mm[1:] - position_mm[:-1]
    slope[ends - 1] = 1.0  # no step from one curve to the next
    slope = 1 / slope
    found = np.zeros((3, len(position_mm)))
    first, second = slope[:-1], slope[1:]
    scale = root[:-1] * np.sqrt(2 * first * second / (first + second))
    inside = np.ones(len(position_mm))
    inside[ends - 1] = 0.0
    inside[ends[ends > 1] - 2] = 0.0
    scale *= inside[:-1]
    found[0, :-1] = scale * first
    found[2, :-1] = scale * second
    found[1] = -found[0] - found[2]
    return found


def steps_mm(stack: Stack) -> FloatArray:
    """Distance (N,) from each node to the next of its curve, inf at the last."""
    step = np.full(len(stack.position_mm), math.inf)
    step[:-1] = np.diff(stack.position_mm)
    step[stack.starts + stack.sizes - 1] = math.inf
    return step


def curvature_rows(step: FloatArray) -> FloatArray:
    """Coefficients (3, N) of c'' in windows of three nodes; zero where a window leaves its curve."""
    rows = np.zeros((3, len(step)))
    before, after = step[:-1], step[1:]
    scale = np.where(np.isfinite(before) & np.isfinite(after), 2 / (before + after), 0.0)
    rows[0, :-1], rows[2, :-1] = scale / before, scale / after
    rows[1] = -rows[0] - rows[2]
    return rows


def curvatures_of(stack: Stack, c: FloatArray) -> FloatArray:
    """Second derivative (N,) in the window that begins at each node, see :func:`compgen.fit.bounds.curvature`."""
    return gather(curvature_rows(steps_mm(stack)), c)


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


def band_of(rows: FloatArray, out: FloatArray) -> None:
    """Write R^T R of rows (3, N) as a lower band (3, N)."""
    first, middle, last = rows
    np.multiply(first, first, out=out[0])
    out[0, 1:] += (middle * middle)[:-1]
    out[0, 2:] += (last * last)[:-2]
    np.multiply(first, middle, out=out[1])
    out[1, 1:] += (middle * last)[:-1]
    np.multiply(first, last, out=out[2])
