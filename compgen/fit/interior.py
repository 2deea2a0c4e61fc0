"""Bounded curves, many at once: a primal-dual interior point method on the banded system of all of them.

minimise c^T A c / 2 - c^T W y   subject to   lower <= G c <= upper

Rows of G act on one node (value), two (slope) or three (curvature), so that the Newton matrix A + G^T diag G keeps the
half-bandwidth 2 of A and a step costs O(N) (Mehrotra 1992, SIAM J. Optim. 2, 575). Every curve has its own step length
and stops by itself. The method finds which bounds are active; ``polish.py`` turns that into the exact optimum.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dpbtrs

from compgen.core.csvio import FloatArray
from compgen.fit.bounds import Bounds, slope_limits
from compgen.fit.stacked import Stack, curvature_rows, windows

STEPS = 60
#: A curve is done when its complementarity is below this share of what the bounds cost.
_CLOSED = 1e-9
_BROKEN = 1e-6
#: Curves that are done leave the stack when they are at least this share of it.
_SHRINK = 0.3
_TINY = float(np.finfo(float).tiny)
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class RowStack:
    """Rows of all bounds of a stack: ``rows`` (B, 3, N) over ``limit`` (2, B, N): G c <= upper, -G c <= -lower.

    ``kinds`` (B,) says what each of the B sets of rows bounds: 0 values, 1 slopes, 2 curvatures. A limit that is not
    there is inf.
    """

    kinds: tuple[int, ...]
    rows: FloatArray
    limit: FloatArray

    def pick(self, nodes: BoolArray) -> RowStack:
        """Keep the rows of the chosen nodes (N,)."""
        return RowStack(self.kinds, self.rows[..., nodes], self.limit[..., nodes])

    @cached_property
    def there(self) -> BoolArray:
        """Which limits exist, (2, B, N)."""
        return np.isfinite(self.limit)

    def values(self, c: FloatArray) -> FloatArray:
        """G c and -G c: (2, B, N)."""
        both = np.empty_like(self.limit)
        both[0] = self.along(c)
        np.negative(both[0], out=both[1])
        return both

    def along(self, c: FloatArray) -> FloatArray:
        """G c: (B, N). Rows of kind k act on k + 1 nodes."""
        found = self.rows[:, 0] * c
        for kind, rows, out in zip(self.kinds, self.rows, found, strict=True):
            for later in range(1, kind + 1):
                out[:-later] += rows[later, :-later] * c[later:]
        return found

    def back(self, v: FloatArray) -> FloatArray:
        """G^T v for row values (B, N): (N,)."""
        found: FloatArray = np.zeros(v.shape[1])
        for kind, rows, value in zip(self.kinds, self.rows, v, strict=True):
            found += rows[0] * value
            for later in range(1, kind + 1):
                found[later:] += rows[later, :-later] * value[:-later]
        return found

    def transposed(self, v: FloatArray) -> FloatArray:
        """G^T (v[0] - v[1]) for row values (2, B, N): (N,)."""
        return self.back(v[0] - v[1])

    def add_band(self, band: FloatArray, v: FloatArray) -> None:
        """Add G^T diag(v) G for row values (B, N) to a lower band (3, N)."""
        for kind, rows, value in zip(self.kinds, self.rows, v, strict=True):
            for first in range(kind + 1):
                part = rows[first] * value
                for last in range(first, kind + 1):
                    here = slice(first, None), slice(0, len(value) - first)
                    band[last - first, here[0]] += part[here[1]] * rows[last, here[1]]


def row_stack(stack: Stack, bounds: Sequence[Bounds], curve: FloatArray) -> RowStack:
    """Build the rows; ``curve`` (N,), the one without bounds, gives the scale of slopes that have only a direction."""
    limits = np.array([bound.limits for bound in bounds]).T
    steepest = np.maximum(stack.largest(np.abs(stack.slopes(curve))), _TINY)
    scaled = [slope_limits(bound, float(typical)) for bound, typical in zip(bounds, steepest, strict=True)]
    made = [
        _rows(stack, 0, _values(len(stack.free)), limits[0], (-np.ones(len(bounds)), np.ones(len(bounds)))),
        _rows(stack, 1, _slopes(stack.per_mm), np.array([item[0] for item in scaled]), _ends(scaled)),
        _rows(stack, 2, curvature_rows(stack.per_mm), limits[2], (-np.ones(len(bounds)), np.ones(len(bounds)))),
    ]
    used = [kind for kind, (_, limit) in enumerate(made) if np.isfinite(limit).any()]
    return RowStack(
        tuple(used), np.stack([made[kind][0] for kind in used]), np.stack([made[kind][1] for kind in used], axis=1)
    )


def _ends(scaled: list[tuple[float, float, float]]) -> tuple[FloatArray, FloatArray]:
    return np.array([item[1] for item in scaled]), np.array([item[2] for item in scaled])


def _values(n: int) -> FloatArray:
    rows = np.zeros((3, n))
    rows[0] = 1.0
    return rows


def _slopes(per_mm: FloatArray) -> FloatArray:
    return np.stack([-per_mm, per_mm, np.zeros(len(per_mm))])


def _rows(
    stack: Stack, kind: int, rows: FloatArray, scale: FloatArray, ends: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Rows (3, N) over their bound, and limits (2, N); rows that act on held nodes only have none."""
    scaled = rows * windows(stack.free) / stack.of_each(scale)
    limit = np.stack([stack.of_each(ends[1]), stack.of_each(-ends[0])])
    limit[:, ~scaled.any(axis=0)] = math.inf
    return scaled, limit


@dataclass
class _Iterate:
    """Curves (N,), slacks and multipliers (2, B, N); entries without limit have slack 1 and multiplier 0."""

    c: FloatArray
    slack: FloatArray
    multiplier: FloatArray

    def pick(self, nodes: BoolArray) -> _Iterate:
        """Keep the chosen nodes (N,)."""
        return _Iterate(self.c[nodes], self.slack[..., nodes], self.multiplier[..., nodes])


def interior(
    stack: Stack, rows: RowStack, free_curve: FloatArray, steps: int = STEPS
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Curves (N,), multipliers (2, B, N) near the optimum, and which curves (k,) came there.

    ``free_curve`` (N,) is the solution without bounds; ``steps`` the largest number of Newton steps.
    """
    owner = np.repeat(np.arange(len(stack.starts)), stack.sizes)
    now = _begin(stack, rows, free_curve)
    c, multiplier, done = free_curve.copy(), np.zeros_like(now.multiplier), np.zeros(len(stack.starts), bool)
    left = np.arange(len(stack.starts))  # the curves of the stack that are still worked on
    failed = np.zeros(len(left), bool)
    for count in range(steps + 1):
        gap = _sum(stack, now.slack * now.multiplier)
        closed = ~failed & _closed(stack, rows, now, free_curve, gap)
        stop = closed | failed | (count == steps)
        if stop.sum() >= _SHRINK * len(stop):  # the work goes with the number of nodes
            nodes = np.isin(owner, left[stop])
            c[nodes], multiplier[..., nodes] = now.c[stack.of_each(stop)], now.multiplier[..., stack.of_each(stop)]
            done[left[closed]] = True
            kept = stack.of_each(~stop)
            stack, rows, now, free_curve = stack.pick(~stop), rows.pick(kept), now.pick(kept), free_curve[kept]
            left, failed, gap, stop = left[~stop], failed[~stop], gap[~stop], stop[~stop]
        if not len(left):
            break
        failed[_step(stack, rows, now, gap, ~stop)] = True
    return c, multiplier, done


def _closed(stack: Stack, rows: RowStack, now: _Iterate, free_curve: FloatArray, gap: FloatArray) -> BoolArray:
    """Whether bounds are kept and the complementarity is small against what the bounds cost, for each curve (k,)."""
    away = now.c - free_curve
    cost = 0.5 * stack.total(away * stack.apply(away))
    broken = stack.largest(np.where(rows.there, rows.values(now.c) - rows.limit, 0.0).max(axis=(0, 1)))
    return np.asarray((gap <= _CLOSED * np.maximum(cost, _TINY)) & (broken <= _BROKEN))


def _sum(stack: Stack, values: FloatArray) -> FloatArray:
    return stack.total(values.sum(axis=(0, 1)))


def _begin(stack: Stack, rows: RowStack, free_curve: FloatArray) -> _Iterate:
    """Start at the free curve, shrunk to half of the bounds that it breaks; at zero where it goes the wrong way."""
    there = rows.there
    count = _rows_of_each(stack, there)
    values = rows.values(free_curve)
    bounded = there & (rows.limit > 0)
    over = stack.largest(np.where(bounded, values / np.where(bounded, rows.limit, 1.0), 0.0).max(axis=(0, 1)))
    turned = stack.largest(np.where(there & (rows.limit == 0), values, 0.0).max(axis=(0, 1))) > 0
    c = free_curve * stack.of_each(np.where(turned, 0.0, np.minimum(1.0, 0.5 / np.maximum(over, 0.5))))
    slack = np.where(there, np.maximum(rows.limit - rows.values(c), 0.3), 1.0)
    away = c - free_curve
    cost = stack.total(away * stack.apply(away)) + 1e-6 * stack.total(free_curve * stack.pull) + _TINY
    level = stack.of_each(cost / count)
    return _Iterate(c, slack, np.where(there, level / slack, 0.0))


def _rows_of_each(stack: Stack, there: BoolArray) -> FloatArray:
    return np.maximum(_sum(stack, there.astype(float)), 1.0)


def _step(stack: Stack, rows: RowStack, now: _Iterate, gap: FloatArray, moving: BoolArray) -> list[int]:
    """One predictor and corrector step of the ``moving`` curves, in place; returns curves whose matrix broke down.

    With the slacks s, multipliers z, residual p of the bounds and the shares r = ds/s of the slacks, a step with the
    products e s as target has dz = e - z (1 + r), so that z itself drops out of the right-hand side.
    """
    z, inverse = now.multiplier, rows.there / now.slack
    weight = z * inverse
    band = stack.band()
    rows.add_band(band, weight[0] + weight[1])
    factor, bad = _factor(stack, band)
    primal = np.where(rows.there, rows.limit - rows.values(now.c) - now.slack, 0.0)
    pull = stack.pull - stack.apply(now.c) + rows.transposed(weight * primal)

    def towards(push: FloatArray) -> tuple[FloatArray, FloatArray]:
        dc = stack.free * dpbtrs(factor, push, lower=1)[0].ravel()
        share = rows.values(dc)
        np.subtract(primal, share, out=share)
        share *= inverse
        return dc, share

    _, share = towards(pull)
    reach = _length(stack, np.maximum(-share, 1 + share))
    cross = share * (1 + share)
    complement = z * now.slack
    left = (1 - reach) * gap - reach**2 * _sum(stack, complement * cross)
    centre = np.clip((left / np.maximum(gap, _TINY)) ** 3, 1e-10, 1.0) * gap / _rows_of_each(stack, rows.there)
    target = stack.of_each(centre) * inverse + z * cross
    dc, share = towards(pull - rows.transposed(target))
    dz = target - z * (1 + share)
    sure = np.where(
        moving, np.minimum(1.0, 0.995 * _length(stack, np.maximum(-share, -dz / np.maximum(z, _TINY)))), 0.0
    )
    sure[bad] = 0.0
    far = stack.of_each(sure)
    now.c = now.c + far * dc
    now.slack = now.slack * (1 + far * share)
    now.multiplier = z + far * dz
    return bad


def _length(stack: Stack, fastest: FloatArray) -> FloatArray:
    """Longest step (k,) with no share (2, B, N) of a slack or multiplier gone; inf becomes large."""
    return np.asarray(1.0 / np.maximum(stack.largest(fastest.max(axis=(0, 1))), 1e-3))


def _factor(stack: Stack, band: FloatArray) -> tuple[FloatArray, list[int]]:
    """Cholesky factor; a curve whose block is not positive definite is replaced by 1 and named."""
    bad: list[int] = []
    while True:
        factor, info = dpbtrf(band, lower=1)
        if info == 0:
            return factor, bad
        curve = int(np.searchsorted(stack.starts, info - 1, side="right")) - 1
        bad.append(curve)
        block = slice(stack.starts[curve], stack.starts[curve] + stack.sizes[curve])
        band[0, block], band[1:, block] = 1.0, 0.0
