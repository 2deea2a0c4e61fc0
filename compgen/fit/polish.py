"""From a near-optimal bounded curve to the optimum: the active bounds become equations, solved to rounding.

With the active rows H c = h the method of multipliers (Hestenes 1969, Powell 1969) solves, with a large diagonal r,

    (A + H^T r H) c = W y + H^T (r h - v),    v <- v + r (H c - h)

whose matrix stays banded and is factored once. A row whose multiplier has the wrong sign leaves, a row outside its
limit enters. A curve counts as solved when the Karush-Kuhn-Tucker conditions hold: every limit kept to 1e-9 of it,
every multiplier of the right sign, the equations of the curve satisfied.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dpbtrs

from compgen.core.csvio import FloatArray
from compgen.fit.bounds import KEPT
from compgen.fit.interior import RowStack
from compgen.fit.stacked import Stack

ROUNDS, _PASSES = 12, 40
_WEIGHT = 1e7
_SIGN = 1e-8
_LEFT, _EQUAL = 1e-11, 1e-11
BoolArray = NDArray[np.bool_]


def polish(
    stack: Stack, rows: RowStack, curve: FloatArray, multiplier: FloatArray, rounds: int = ROUNDS
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Curves (N,), active rows (B, N) of -1, 0, 1, and which curves (k,) passed, from the interior point's result."""
    slack = np.where(rows.there, rows.limit - rows.values(curve), np.inf)
    scale = stack.largest(multiplier.max(axis=(0, 1)))
    tight = (multiplier > 1e-6 * stack.of_each(scale)) & (slack < 1e-3)
    tight[0] &= ~(tight[1] & (multiplier[1] > multiplier[0]))
    tight[1] &= ~tight[0]
    active = tight[0].astype(float) - tight[1]
    solved = np.zeros(len(stack.starts), bool)
    kept, held = curve.copy(), active.copy()
    for _ in range(rounds):
        found = equalities(stack, rows, active, curve)
        if found is None:
            break
        c, v, exact = found
        wrong = active * v < -_SIGN * stack.of_each(stack.largest(np.abs(v).max(axis=0)))
        over = rows.values(c) - rows.limit > KEPT
        good = exact & ~stack.largest((wrong | over.any(axis=0)).any(axis=0).astype(float)).astype(bool)
        fresh = stack.of_each(good & ~solved)
        kept, held = np.where(fresh, c, kept), np.where(fresh, active, held)
        solved |= good
        if solved.all():
            break
        active = np.where(wrong, 0.0, active)
        active = np.where(over[0], 1.0, np.where(over[1], -1.0, active))
    return kept, held, solved


def equalities(
    stack: Stack, rows: RowStack, active: FloatArray, start: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray] | None:
    """Curves (N,) with the ``active`` rows at their limits, multipliers (B, N), and where that is exact (k,)."""
    band = stack.band()
    height = stack.of_each(stack.largest(band[0]))
    norm = (rows.rows**2).sum(axis=1)
    weight = np.where(active != 0, _WEIGHT * height / np.where(norm > 0, norm, 1.0), 0.0)
    target = np.where(active > 0, rows.limit[0], np.where(active < 0, -rows.limit[1], 0.0))
    rows.add_band(band, weight)
    factor, info = dpbtrf(band, lower=1, overwrite_ab=1)
    if info:
        return None
    c, v, on = start.copy(), np.zeros_like(weight), active != 0
    miss = np.where(on, rows.along(c) - target, 0.0)
    for _ in range(_PASSES):
        rest = stack.pull - stack.apply(c) - rows.back(v + weight * miss)
        step = stack.free * dpbtrs(factor, rest, lower=1)[0].ravel()
        c = c + step
        miss = np.where(on, rows.along(c) - target, 0.0)
        v = v + weight * miss
        still = stack.largest(np.abs(step)) <= _LEFT * stack.largest(np.abs(c))
        exact = still & (stack.largest(np.abs(miss).max(axis=0)) <= _EQUAL)
        if exact.all():
            break
    return c, v, exact
