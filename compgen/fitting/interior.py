"""Many bounded curves at once: an interior point method on their banded system, and the exact optimum from its result.

minimise c^T A c / 2 - c^T g   subject to   lower <= G c <= upper,   g = W y

Rows of G act on one node (value), two (slope) or three (curvature), so that the Newton matrix A + G^T D G keeps the
half-bandwidth 2 of A, and a step costs O(N) (Mehrotra 1992, SIAM J. Optim. 2, 575). Every curve has its own step length
and stops by itself; the arithmetic is done over all nodes, so that twenty short curves cost little more than one.

The method tells which bounds are active. With these as equations H c = h the method of multipliers (Hestenes 1969,
J. Optim. Theory Appl. 4, 303; Powell 1969) solves, with a large diagonal R,

    (A + H^T R H) c = g + H^T (R h - v),    v <- v + R (H c - h)

whose matrix stays banded and is factored once. A row whose multiplier has the wrong sign leaves, a row outside its
limit enters. A curve is solved when the Karush-Kuhn-Tucker conditions hold: every bound met to 1e-9 of it, every
multiplier of the right sign, the equations of the curve satisfied to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.fitting.bounds import KEPT, Bounds, slope_limits
from compgen.kinematics.kernel_switch import lapack

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]
Values = TypeVar("Values", FloatArray, BoolArray)
_TINY = float(np.finfo(float).tiny)
#: Most steps of the interior point method; a curve is done when its complementarity is below this share of the cost of
#: its bounds, and no bound is exceeded by more than this fraction of it.
_STEPS, _CLOSED, _NEARLY = 60, 1e-6, 1e-6
#: A step shorter than this is followed by one towards the middle of the bounds; the corrector changes no product of
#: slack and multiplier by more than this many times their mean (without limit the method can go round in a circle).
_SHORT, _CORRECTED = 0.3, 2.0
#: Changes of the set of active rows, and steps of the method of multipliers for each set.
_ROUNDS, _PASSES = 12, 40
#: R in units of the largest diagonal of A; wrong signs of multipliers up to this fraction of the largest are rounding.
_WEIGHT, _SIGN = 1e4, 1e-8
#: Relative change of a curve, and distance of an active row from its limit, at which the equations are satisfied.
_STILL, _EQUAL = 1e-11, 1e-11


@dataclass(frozen=True)
class Banded:
    """k curves with N nodes in all; everything that acts on a fixed node is zero.

    ``starts``, ``sizes`` (k,): location of the curves; ``weight``, ``free`` (N,); ``bend`` (3, N): root of mu times D2,
    entry [i, j] acts on node j + i; ``load`` (N,): W y.
    """

    starts: IntArray
    sizes: IntArray
    weight: FloatArray
    free: FloatArray
    bend: FloatArray
    load: FloatArray

    def each(self, values: Values) -> Values:
        """Repeat one value of each curve (k,) over its nodes (N,)."""
        return values.repeat(self.sizes)

    def largest(self, values: FloatArray) -> FloatArray:
        """Largest of node values (..., N) in each curve (..., k)."""
        return np.maximum.reduceat(values, self.starts, axis=-1)

    def total(self, values: FloatArray) -> FloatArray:
        """Sum of node values (..., N) over each curve (..., k)."""
        return np.add.reduceat(values, self.starts, axis=-1)

    def part(self, curves: BoolArray) -> Banded:
        """Some of the ``curves`` (k,) alone."""
        nodes, sizes = self.each(curves), self.sizes[curves]
        return Banded(
            np.cumsum(sizes) - sizes, sizes, self.weight[nodes], self.free[nodes], self.bend[:, nodes], self.load[nodes]
        )

    def band(self) -> FloatArray:
        """A as a lower band (3, N), entry [d, j] couples j and j + d; fixed nodes have 1 on the diagonal."""
        band = _band_of(self.bend)
        band[0] += self.weight + (1.0 - self.free)
        return band

    def apply(self, c: FloatArray) -> FloatArray:
        """A c for node values (N,) that are zero at fixed nodes, without forming the product of differences."""
        return self.weight * c + spread(self.bend, gather(self.bend, c))


def windows(values: FloatArray) -> FloatArray:
    """Values (N,) at the first, middle and last node of each window of three: (3, N), zero past the end."""
    seen = np.zeros((3, len(values)))
    seen[0], seen[1, :-1], seen[2, :-2] = values, values[1:], values[2:]
    return seen


def gather(rows: FloatArray, c: FloatArray, out: FloatArray | None = None) -> FloatArray:
    """Rows (..., 3, N), each acting on three nodes, times node values (N,): (..., N)."""
    out = np.multiply(rows[..., 0, :], c, out=out)
    out[..., :-1] += rows[..., 1, :-1] * c[1:]
    out[..., :-2] += rows[..., 2, :-2] * c[2:]
    return out


def spread(rows: FloatArray, v: FloatArray) -> FloatArray:
    """Transposed rows (3, N) times row values (N,): (N,)."""
    out: FloatArray = rows[0] * v
    out[1:] += (rows[1] * v)[:-1]
    out[2:] += (rows[2] * v)[:-2]
    return out


def _band_of(rows: FloatArray) -> FloatArray:
    """R^T R of rows (3, N) as a lower band (3, N)."""
    first, middle, last = rows
    out = np.empty_like(rows)
    np.multiply(first, first, out=out[0])
    out[0, 1:] += (middle * middle)[:-1]
    out[0, 2:] += (last * last)[:-2]
    np.multiply(first, middle, out=out[1])
    out[1, 1:] += (middle * last)[:-1]
    np.multiply(first, last, out=out[2])
    return out


@dataclass(frozen=True)
class BandedRows:
    """Rows of all bounds: ``rows`` (B, 3, N) over ``limit`` (2, B, N): G c <= upper, -G c <= -lower; inf: no limit.

    ``kinds`` (B,) says what each set of rows bounds: 0 values, 1 slopes, 2 curvatures.
    """

    kinds: tuple[int, ...]
    rows: FloatArray
    limit: FloatArray

    @classmethod
    def of(cls, system: Banded, position_mm: FloatArray, bounds: Sequence[Bounds]) -> BandedRows:
        """Build the rows of curves with nodes ``position_mm`` (N,)."""
        step = np.full(len(position_mm), math.inf)
        step[:-1] = np.diff(position_mm)
        last = system.starts + system.sizes - 1
        step[last] = math.inf
        typical = 1.0 / np.maximum(position_mm[last] - position_mm[system.starts], _TINY)
        slopes = np.array([slope_limits(bound, own) for bound, own in zip(bounds, typical.tolist(), strict=True)])
        limits = np.array([bound.limits for bound in bounds])
        one = np.ones(len(bounds))
        made = [
            _set(system, _values(step), limits[:, 0], -one, one),
            _set(system, np.stack([-1 / step, 1 / step, np.zeros(len(step))]), *slopes.T),
            _set(system, _curvatures(step), limits[:, 2], -one, one),
        ]
        used = tuple(kind for kind, (_, limit) in enumerate(made) if np.isfinite(limit).any())
        return cls(used, np.stack([made[kind][0] for kind in used]), np.stack([made[kind][1] for kind in used], axis=1))

    def part(self, nodes: BoolArray) -> BandedRows:
        """The rows of some ``nodes`` (N,), whole curves."""
        return BandedRows(self.kinds, self.rows[..., nodes], self.limit[..., nodes])

    def values(self, c: FloatArray) -> FloatArray:
        """G c and -G c: (2, B, N)."""
        both = np.empty((2, *self.rows.shape[::2]))
        np.negative(gather(self.rows, c, out=both[0]), out=both[1])
        return both

    def transposed(self, v: FloatArray) -> FloatArray:
        """G^T v for row values (B, N): (N,)."""
        first: FloatArray
        first, middle, last = np.einsum("bin,bn->in", self.rows, v)
        first[1:] += middle[:-1]
        first[2:] += last[:-2]
        return first

    @cached_property
    def _products(self) -> FloatArray:
        """Products (B, 6, N) of the coefficients of each row: three squares, two neighbours, first and last."""
        pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))
        return np.stack([self.rows[:, i] * self.rows[:, j] for i, j in pairs], axis=1)

    def weighted_band(self, v: FloatArray) -> FloatArray:
        """G^T diag(v) G for row weights (B, N), as a lower band (3, N)."""
        out: FloatArray = np.einsum("bin,bn->in", self._products, v)
        out[0, 1:] += out[1, :-1]
        out[0, 2:] += out[2, :-2]
        out[3, 1:] += out[4, :-1]
        return out[[0, 3, 5]]


def _values(step: FloatArray) -> FloatArray:
    rows = np.zeros((3, len(step)))
    rows[0] = 1.0
    return rows


def _curvatures(step: FloatArray) -> FloatArray:
    """Coefficients (3, N) of c'' in windows of three nodes; zero where a window leaves its curve."""
    rows = np.zeros((3, len(step)))
    before, after = step[:-1], step[1:]
    scale = np.where(np.isfinite(before) & np.isfinite(after), 2 / (before + after), 0.0)
    rows[0, :-1], rows[2, :-1] = scale / before, scale / after
    rows[1] = -rows[0] - rows[2]
    return rows


def _set(
    system: Banded, rows: FloatArray, scale: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Rows (3, N) over their bound, and limits (2, N); rows that act on fixed nodes only have none."""
    scaled = rows * windows(system.free) / system.each(scale)
    limit = np.stack([system.each(upper), system.each(-lower)])
    limit[:, ~scaled.any(axis=0)] = math.inf
    return scaled, limit


@dataclass
class _Iterate:
    """Curves (N,), slacks and multipliers (2, B, N), and the last step length of each curve (k,).

    Entries without limit have slack 1 and multiplier 0.
    """

    c: FloatArray
    slack: FloatArray
    multiplier: FloatArray
    length: FloatArray

    def part(self, system: Banded, curves: BoolArray) -> _Iterate:
        """Those of some ``curves`` (k,)."""
        nodes = system.each(curves)
        return _Iterate(self.c[nodes], self.slack[..., nodes], self.multiplier[..., nodes], self.length[curves])


def bounded_curves(
    system: Banded, rows: BandedRows, free_curve: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Optimal curves (N,), their active rows (B, N) of -1, 0, 1, and which curves (k,) satisfy the conditions.

    ``free_curve`` (N,) is the solution without bounds.
    """
    near = _begin(system, rows, free_curve)
    _interior(system, rows, free_curve, near)
    return _exact(system, rows, near.c, near.multiplier)


def _begin(system: Banded, rows: BandedRows, free_curve: FloatArray) -> _Iterate:
    """Start at the free curve, shrunk to half of the bounds that it breaks; one-sided rows begin with open slack."""
    there = np.isfinite(rows.limit)
    values = rows.values(free_curve)
    bounded = there & (rows.limit > 0)
    over = system.largest(np.where(bounded, values / np.where(bounded, rows.limit, 1.0), 0.0).max(axis=(0, 1)))
    c = free_curve * system.each(np.minimum(1.0, 0.5 / np.maximum(over, 0.5)))
    slack = np.where(there, np.maximum(np.where(there, rows.limit, 0.0) - rows.values(c), 0.3), 1.0)
    away = c - free_curve
    cost = system.total(away * system.apply(away)) + 1e-6 * system.total(free_curve * system.load) + _TINY
    level = cost / np.maximum(_sum(system, there.astype(float)), 1.0)
    return _Iterate(c, slack, np.where(there, system.each(level) / slack, 0.0), np.ones(len(system.starts)))


def _interior(system: Banded, rows: BandedRows, free_curve: FloatArray, now: _Iterate) -> None:
    """Bring curves and multipliers near the optimum, in place; when most curves are there, the rest goes on alone."""
    there = np.isfinite(rows.limit).astype(float)
    limit = np.where(there > 0, rows.limit, 1.0)  # 1: the slack of what has no limit
    count = np.maximum(_sum(system, there), 1.0)
    band = system.band()
    moving = np.ones(len(system.starts), bool)
    for _ in range(_STEPS):
        primal = limit - now.slack
        primal -= there * rows.values(now.c)
        gap = _sum(system, now.slack * now.multiplier)
        away = now.c - free_curve
        cost = 0.5 * system.total(away * system.apply(away))
        broken = system.largest(np.abs(primal).max(axis=(0, 1)))
        moving &= (gap > _CLOSED * np.maximum(cost, _TINY)) | (broken > _NEARLY)
        left = int(moving.sum())
        if left == 0:
            return
        if 3 * left <= len(moving):
            nodes: BoolArray = system.each(moving)
            rest = now.part(system, moving)
            _interior(system.part(moving), rows.part(nodes), free_curve[nodes], rest)
            now.c[nodes], now.slack[..., nodes], now.multiplier[..., nodes] = rest.c, rest.slack, rest.multiplier
            return
        moving[_step(system, band, rows, now, there, primal, gap / count, moving)] = False


def _sum(system: Banded, values: FloatArray) -> FloatArray:
    return system.total(values.sum(axis=(0, 1)))


def _step(
    system: Banded,
    band: FloatArray,
    rows: BandedRows,
    now: _Iterate,
    there: FloatArray,
    primal: FloatArray,
    mean: FloatArray,
    moving: BoolArray,
) -> list[int]:
    """One predictor and corrector step of the ``moving`` curves, in place; returns curves whose matrix broke down.

    A curve whose last step was short goes towards the middle of its bounds first, without the corrector.
    """
    weight = now.multiplier / now.slack
    factor, bad = _factor(system, band + rows.weighted_band(weight[0] + weight[1]))
    pull = system.load - system.apply(now.c)

    def towards(target: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        push = (target - now.multiplier * primal) / now.slack
        both = now.multiplier + push
        dc = system.free * lapack().dpbtrs(factor, pull - rows.transposed(both[0] - both[1]), lower=1)[0].ravel()
        moved = there * rows.values(dc)
        return dc, primal - moved, push + weight * moved

    full = now.slack * now.multiplier
    _, ds, dz = towards(-full)
    reach = system.each(_length(system, now, ds, dz))
    after = _sum(system, (now.slack + reach * ds) * (now.multiplier + reach * dz))
    short = now.length < _SHORT
    share = np.where(short, 0.5, (after / np.maximum(_sum(system, full), _TINY)) ** 3)
    centre = system.each(np.clip(share, 1e-10, 1.0) * mean)
    most = system.each(np.where(short, 0.0, _CORRECTED * mean))
    bent = np.minimum(np.maximum(ds * dz, -most), most)
    dc, ds, dz = towards(there * (centre - bent) - full)
    length = np.where(moving, np.minimum(1.0, 0.995 * _length(system, now, ds, dz)), 0.0)
    length[bad] = 0.0
    reach = system.each(length)
    now.c += reach * dc
    now.slack += reach * ds
    now.multiplier += reach * dz
    now.length = length
    return bad


def _length(system: Banded, now: _Iterate, ds: FloatArray, dz: FloatArray) -> FloatArray:
    """Longest step (k,) that keeps slacks and multipliers positive, at most 1000."""
    fastest = np.maximum(-ds / now.slack, -dz / np.maximum(now.multiplier, _TINY)).max(axis=(0, 1))
    return np.asarray(1.0 / np.maximum(system.largest(fastest), 1e-3))


def _factor(system: Banded, band: FloatArray) -> tuple[FloatArray, list[int]]:
    """Cholesky factor; a curve whose block is not positive definite is replaced by 1 and named."""
    bad: list[int] = []
    while True:
        factor, info = lapack().dpbtrf(band, lower=1)
        if info == 0:
            return factor, bad
        curve = int(np.searchsorted(system.starts, info - 1, side="right")) - 1
        bad.append(curve)
        block = slice(system.starts[curve], system.starts[curve] + system.sizes[curve])
        band[0, block], band[1:, block] = 1.0, 0.0


def _exact(
    system: Banded, rows: BandedRows, curve: FloatArray, multiplier: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Curves (N,), active rows (B, N), and which curves (k,) passed, from the interior point method's result."""
    slack = np.where(np.isfinite(rows.limit), rows.limit - rows.values(curve), np.inf)
    scale = system.largest(multiplier.max(axis=(0, 1)))
    tight = (multiplier > 1e-6 * system.each(scale)) & (slack < 1e-3)
    tight[0] &= ~(tight[1] & (multiplier[1] > multiplier[0]))
    tight[1] &= ~tight[0]
    active = tight[0].astype(float) - tight[1]
    solved = np.zeros(len(system.starts), bool)
    best, touched = curve.copy(), active.copy()
    for _ in range(_ROUNDS):
        found = _equalities(system, rows, active, curve)
        if found is None:
            break
        c, v, exact = found
        wrong = active * v < -_SIGN * system.each(system.largest(np.abs(v).max(axis=0)))
        over = rows.values(c) - rows.limit > KEPT
        good = exact & ~system.largest((wrong | over.any(axis=0)).any(axis=0).astype(float)).astype(bool)
        fresh = system.each(good & ~solved)
        best, touched = np.where(fresh, c, best), np.where(fresh, active, touched)
        solved |= good
        if solved.all():
            break
        active = np.where(wrong, 0.0, active)
        active = np.where(over[0], 1.0, np.where(over[1], -1.0, active))
    return best, touched, solved


def _equalities(
    system: Banded, rows: BandedRows, active: FloatArray, start: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray] | None:
    """Curves (N,) with the ``active`` rows at their limits, multipliers (B, N), and where that is exact (k,)."""
    band = system.band()
    norm = (rows.rows**2).sum(axis=1)
    height = system.each(system.largest(band[0]))
    weight = np.where(active != 0, _WEIGHT * height / np.where(norm > 0, norm, 1.0), 0.0)
    target = np.where(active > 0, rows.limit[0], np.where(active < 0, -rows.limit[1], 0.0))
    factor, info = lapack().dpbtrf(band + rows.weighted_band(weight), lower=1)
    if info:
        return None
    c, v, on = start.copy(), np.zeros_like(weight), active != 0
    miss = np.where(on, gather(rows.rows, c) - target, 0.0)
    exact = np.zeros(len(system.starts), bool)
    for _ in range(_PASSES):
        rest = system.load - system.apply(c) - rows.transposed(v + weight * miss)
        going = system.each(~exact)  # a finished curve stays as it is
        step = going * system.free * lapack().dpbtrs(factor, rest, lower=1)[0].ravel()
        c = c + step
        miss = np.where(on, gather(rows.rows, c) - target, 0.0)
        v = v + weight * miss * going
        still = system.largest(np.abs(step)) <= _STILL * system.largest(np.abs(c))
        exact |= still & (system.largest(np.abs(miss).max(axis=0)) <= _EQUAL)
        if exact.all():
            break
    return c, v, exact
