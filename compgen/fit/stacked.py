"""Many curves in one banded system: their nodes follow one another, and nothing couples one curve with the next.

A = W + mu D2^T D2 of a curve with independent nodes that is fixed at whole nodes has half-bandwidth 2. Laid behind one
another such curves are one :class:`compgen.fit.smoother.Smoother` whose second differences across two curves are zero.
One factorisation serves all, whatever their nodes, weights and mu; each is refined by itself, so that no curve changes
with the company it has. What keeps its bounds is finished; the others are solved by
:func:`compgen.fit.bounds.solve_curve`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbsv, dpbtrs

from compgen.data.csv_files import FloatArray
from compgen.fit.bounds import Bounds, CurveSolution, curvature_at, solve_curve
from compgen.fit.smoother import REFINEMENTS, SETTLED, Smoother

#: Half-bandwidth of A, and one more.
_DIAGONALS = 3
#: What is put behind the second differences of a curve of n nodes: it has n - 2 of them, or none.
_NO_ROWS: FloatArray = np.zeros((2, 3))
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]


class CurveProblem(NamedTuple):
    """Data ``y`` (n,) at ``position_mm`` (n,), to be smoothed with weight ``mu`` within ``bounds`` in the unit of ``y``."""

    smoother: Smoother
    mu: float
    position_mm: FloatArray
    y: FloatArray
    bounds: Bounds = Bounds()


def solve_curves(problems: Sequence[CurveProblem]) -> list[CurveSolution]:
    """Minimise the cost of every curve within its bounds.

    Curves with independent nodes that are fixed at whole nodes are solved together first.

    Raises
    ------
    ConvergenceError
        when no solver's result for a curve that breaks a bound passes the optimality conditions.
    """
    # those whose nodes are independent (no subclass), and whose fixed functionals are values at nodes
    chosen = [
        k
        for k, problem in enumerate(problems)
        if type(problem.smoother) is Smoother and all([other is None for _, other, _ in problem.smoother.steps])
    ]
    found: dict[int, FloatArray] = {}
    if chosen:
        together = [problems[k] for k in chosen]
        stack = Stack.build(together)
        c = stack.solve(np.concatenate([problem.y for problem in together]))
        if c is not None:
            kept = (~_breaks(stack, together, c)).tolist()
            bounds = zip(stack.starts.tolist(), (stack.starts + stack.sizes).tolist(), strict=True)
            found = {k: c[start:end] for k, (start, end), own in zip(chosen, bounds, kept, strict=True) if own}
    return [CurveSolution(found[k]) if k in found else solve_curve(*problem) for k, problem in enumerate(problems)]


@dataclass(frozen=True)
class Stack:
    """k curves with N nodes in all.

    ``starts`` and ``sizes`` (k,): where the curves stand; ``laid``: one smoother of N nodes without eliminations;
    ``fixed``: the nodes at zero; ``mu`` (N,).
    """

    starts: IntArray
    sizes: IntArray
    laid: Smoother
    fixed: IntArray
    mu: FloatArray

    @classmethod
    def build(cls, problems: Sequence[CurveProblem]) -> Stack:
        """Lay the curves one behind the other."""
        smoothers = [problem.smoother for problem in problems]
        sizes = np.array([len(smoother.weight) for smoother in smoothers])
        starts = np.cumsum(sizes) - sizes
        rows: list[FloatArray] = []
        fixed: list[int] = []
        for start, smoother in zip(starts.tolist(), smoothers, strict=True):
            rows += (smoother.rows, _NO_ROWS[: len(smoother.weight) - len(smoother.rows)])
            fixed += [start + node for node, _, _ in smoother.steps]
        laid = Smoother(
            weight=np.concatenate([smoother.weight for smoother in smoothers]),
            rows=np.asfortranarray(np.concatenate(rows)[:-2]),  # read by columns
            steps=(),
            free_weight=np.concatenate([smoother.free_weight for smoother in smoothers]),
            penalty=np.concatenate([smoother.penalty[:_DIAGONALS] for smoother in smoothers], axis=1),
        )
        mu = np.array([problem.mu for problem in problems]).repeat(sizes)
        return cls(starts, sizes, laid, np.array(fixed, dtype=np.intp), mu)

    def largest(self, values: FloatArray) -> FloatArray:
        """Largest magnitude of node values (N,) in each curve (k,)."""
        return np.asarray(np.maximum.reduceat(np.abs(values), self.starts))

    def solve(self, y: FloatArray) -> FloatArray | None:
        """Fitted curves (N,) for data (N,) without bounds; None if A is not positive definite.

        Refined against the product form of A as in :meth:`compgen.fit.smoother.Smoother.inverse`, curve by curve.
        """
        band = self.mu * self.laid.penalty
        band[0] += self.laid.free_weight
        load = self._free(self.laid.load(y[:, None]))
        factor, x, info = dpbsv(band, load, lower=1)
        if info:
            return None
        rough = np.ones(len(self.sizes), dtype=bool)
        weight, mu = self.laid.weight[:, None], self.mu[:, None]
        for _ in range(REFINEMENTS):
            # A x without forming the product of the second differences
            applied = self._free(weight * x + mu * self.laid.bend_transposed(self.laid.bend(x)))
            step = dpbtrs(factor, load - applied, lower=1)[0]
            x = x + (step if rough.all() else step * rough.repeat(self.sizes)[:, None])
            rough &= ~(self.largest(step[:, 0]) <= SETTLED * self.largest(x[:, 0]))
            if not rough.any():
                break
        return np.ascontiguousarray(self._free(x)[:, 0])

    def _free(self, values: FloatArray) -> FloatArray:
        """Put zeros at the fixed nodes of (N, 1)."""
        values[self.fixed] = 0.0
        return values


def _breaks(stack: Stack, problems: Sequence[CurveProblem], c: FloatArray) -> BoolArray:
    """Which curves (k,) of a stack (N,) break a bound, as :meth:`compgen.fit.bounds.Bounds.kept_by` judges one."""
    bounds = [problem.bounds for problem in problems]
    wrong: BoolArray = stack.largest(c) > [bound.max_abs for bound in bounds]
    steepest, bent = [bound.max_slope for bound in bounds], [bound.max_curvature for bound in bounds]
    direction = [bound.direction for bound in bounds]
    sloped, curved = any(direction) or min(steepest) < math.inf, min(bent) < math.inf
    if not (sloped or curved):
        return wrong
    position = np.concatenate([problem.position_mm for problem in problems])
    step = position[1:] - position[:-1]
    step[stack.starts[1:] - 1] = math.inf  # no slope from one curve to the next
    if sloped:
        slope = np.zeros(len(c))
        slope[:-1] = (c[1:] - c[:-1]) / step
        wrong |= stack.largest(slope) > steepest
        if any(direction):
            wrong |= stack.largest(np.maximum(-slope * np.array(direction).repeat(stack.sizes), 0.0)) > 0
    if curved:
        bend = np.zeros(len(c))
        bend[:-2] = (curvature_at(step) * np.stack([c[:-2], c[1:-1], c[2:]], axis=1)).sum(axis=1)
        wrong |= stack.largest(bend) > bent
    return wrong
