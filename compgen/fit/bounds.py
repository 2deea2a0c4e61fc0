"""Bounds on one curve: magnitude, slope, curvature, one direction; as numbers and as rows of linear inequalities."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from compgen.core.csvio import FloatArray
from compgen.fit.result import ActiveBound
from compgen.fit.smooth import Smoother

#: Bounds are kept to this fraction of them.
KEPT = 1e-9
#: Names of the bounds in the order of their rows: values (over one node), slopes (two), curvatures (three).
KINDS = ("max_abs", "max_slope", "max_curvature")
MONOTONE = "monotone"


@dataclass(frozen=True)
class Bounds:
    """Bounds of one curve in its unit (of the curve, per mm, per mm^2); inf and direction 0 are none.

    ``direction`` is +1 for a curve that must not fall, -1 for one that must not rise. The zero curve keeps every bound.
    """

    max_abs: float = math.inf
    max_slope: float = math.inf
    max_curvature: float = math.inf
    direction: int = 0

    @property
    def none(self) -> bool:
        """Whether nothing is bounded."""
        return math.isinf(self.max_abs) and math.isinf(self.max_slope + self.max_curvature) and not self._some

    @property
    def _some(self) -> bool:
        return self.direction != 0 or math.isfinite(self.max_slope) or math.isfinite(self.max_curvature)

    @property
    def limits(self) -> tuple[float, float, float]:
        """Magnitude, slope, curvature."""
        return self.max_abs, self.max_slope, self.max_curvature

    def in_unit(self, unit: float) -> Bounds:
        """Return the same bounds for a curve counted in ``unit``."""
        return Bounds(self.max_abs / unit, self.max_slope / unit, self.max_curvature / unit, self.direction)

    def excess(self, position_mm: FloatArray, curve: FloatArray) -> tuple[float, float, float, float]:
        """By how much a curve (n,) breaks magnitude, slope, curvature and direction; 0 where it keeps them."""
        slope = np.diff(curve) / np.diff(position_mm)
        bent = curvature(position_mm) * np.stack([curve[:-2], curve[1:-1], curve[2:]], axis=1)
        found = (np.abs(curve).max(), np.abs(slope).max(initial=0.0), np.abs(bent.sum(axis=1)).max(initial=0.0))
        over = [max(0.0, float(value - limit)) for value, limit in zip(found, self.limits, strict=True)]
        return over[0], over[1], over[2], float(np.max(-self.direction * slope, initial=0.0))

    def kept_by(self, position_mm: FloatArray, curve: FloatArray) -> bool:
        """Whether a curve (n,) keeps its bounds at every node and between them."""
        return self.none or not any(self.excess(position_mm, curve))


@dataclass(frozen=True)
class Rows:
    """lower <= dense @ x <= upper in the smoother's unknowns: dense (m, n), limits (m,).

    n values come first, then n - 1 slopes, then n - 2 curvatures, each over its bound; rows without limits are zero.
    """

    dense: FloatArray
    lower: FloatArray
    upper: FloatArray

    @cached_property
    def matrix(self) -> sp.csr_array:
        """The rows as the general solvers want them: sparse."""
        return sp.csr_array(self.dense)

    def excess(self, curve: FloatArray) -> FloatArray:
        """Amount (m,) by which a curve is above (positive) or below (negative) its limits, else 0."""
        values = self.dense @ curve
        return np.maximum(values - self.upper, 0.0) + np.minimum(values - self.lower, 0.0)


def curvature(position_mm: FloatArray) -> FloatArray:
    """Coefficients (n - 2, 3) of c'' at the inner nodes: (slope after - slope before) over half the two steps, 1/mm^2."""
    step = np.diff(position_mm)
    before, after = step[:-1], step[1:]
    scale = 2 / (before + after)
    return np.stack([scale / before, -scale / before - scale / after, scale / after], axis=1)


def slope_limits(bounds: Bounds, typical: float) -> tuple[float, float, float]:
    """Scale, lower and upper limit of the slope rows; without a bound on the slope they count in ``typical`` ones."""
    bounded = math.isfinite(bounds.max_slope)
    scale, top = (bounds.max_slope, 1.0) if bounded else (typical, math.inf)
    return scale, 0.0 if bounds.direction > 0 else -top, 0.0 if bounds.direction < 0 else top


def constraint_rows(
    position_mm: FloatArray,
    smoother: Smoother,
    largest: float,
    steepest: float,
    most_bent: float = math.inf,
    direction: int = 0,
) -> Rows:
    """Rows of a curve's bounds in the smoother's unknowns."""
    n = len(position_mm)
    bounds = Bounds(largest, steepest, most_bent, direction)
    turn = smoother.expand(np.eye(n))
    step = np.diff(position_mm)
    typical = 1.0 / float(np.ptp(position_mm)) if n > 1 else 1.0
    scale, low, high = slope_limits(bounds, typical)
    if math.isinf(low) and math.isinf(high):
        scale = math.inf
    slopes = np.diff(turn, axis=0) / (step[:, None] * scale)
    first, middle, last = (curvature(position_mm) / most_bent).T[:, :, None]
    bends = first * turn[:-2] + middle * turn[1:-1] + last * turn[2:]
    dense = np.concatenate([turn / largest, slopes, bends])
    dense[np.abs(dense) < 1e-13 * np.abs(dense).max(initial=0.0)] = 0.0
    count = (n, max(n - 1, 0), max(n - 2, 0))
    lower = np.repeat([-1.0, low, -1.0], count)
    upper = np.repeat([1.0, high, 1.0], count)
    empty = ~dense.any(axis=1)
    return Rows(dense, np.where(empty, -math.inf, lower), np.where(empty, math.inf, upper))


def active_bounds(position_mm: FloatArray, active: FloatArray, bounds: Bounds) -> tuple[ActiveBound, ...]:
    """Name the active rows (-1, 0, 1), shape (3 n - 3,) or less, in the order of :class:`Rows`."""
    n = len(position_mm)
    found = []
    for row in np.flatnonzero(active):
        kind, node = (0, row) if row < n else (1, row - n) if row < 2 * n - 1 else (2, row - 2 * n + 1)
        monotone = kind == 1 and bounds.direction != 0 and active[row] == -bounds.direction
        name = MONOTONE if monotone else KINDS[kind]
        found.append(ActiveBound(name, float(position_mm[node]), float(position_mm[node + kind])))
    return tuple(found)
