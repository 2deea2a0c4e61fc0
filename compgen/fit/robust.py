"""Huber's loss: nodes far from the curve pull with a constant force instead of one that grows (Huber 1964).

Solved by reweighting: a node at distance r from the curve has its weight times min(1, k u/r), k = 1.345, until nothing
changes; the curve is then the minimum of Huber's loss plus the smoothness. Bounds are not part of that (they would make
good data look like outliers): the fit within bounds takes the weights as they are. With correlated nodes the variances
of a distrusted node and its covariances are inflated alike. The start compares each node with the median of
five neighbours, because a curve chosen by the data might follow an outlier and see none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.errors import ConvergenceError
from compgen.fit.bounds import Bounds
from compgen.fit.curve import Prepared, Weighted, prepare, smoothness, solve
from compgen.fit.held import HeldCurve
from compgen.fit.options import FitOptions

#: Huber's constant: 95 % efficient for normal noise.
HUBER = 1.345
_SEARCHES, _ROUNDS, _SETTLED = 6, 400, 1e-8
_MAD = 1.4826
_NEIGHBOURS = 5
_LEAST_TRUST = 1e-9


def robust(curves: Mapping[str, HeldCurve], options: FitOptions) -> tuple[list[Prepared], list[Weighted]]:
    """Prepare every curve with the weights of Huber's loss and choose its smoothness.

    The smoothness follows the weights for the first rounds and is then kept.
    """
    prepared = [prepare(name, held, options) for name, held in curves.items()]
    scales = [_scale(item, item.y - running_median(item.y)) for item in prepared]
    trusts = [trust_of(item.y - running_median(item.y), scale) for item, scale in zip(prepared, scales, strict=True)]
    weighted: list[Weighted] = []
    for count in range(_ROUNDS):
        if count < _SEARCHES:
            weighted = [_search(item, options, trust) for item, trust in zip(prepared, trusts, strict=True)]
        prepared = [prepare(item.name, item.held, options, trust) for item, trust in zip(prepared, trusts, strict=True)]
        found = solve([replace(item, bounds=Bounds()) for item in prepared], [item.mu for item in weighted])
        residuals = [item.y - solution.curve for item, solution in zip(prepared, found, strict=True)]
        if count < _SEARCHES:
            scales = [_scale(item, residual) for item, residual in zip(prepared, residuals, strict=True)]
        fresh = [trust_of(residual, scale) for residual, scale in zip(residuals, scales, strict=True)]
        change = max(float(np.abs(new - old).max()) for new, old in zip(fresh, trusts, strict=True))
        if count >= _SEARCHES and change <= _SETTLED:
            return prepared, weighted
        trusts = fresh
    raise ConvergenceError(f"the robust fit did not settle in {_ROUNDS} rounds; fit without it or give a smoothness")


def _search(item: Prepared, options: FitOptions, trust: FloatArray) -> Weighted:
    """Smoothness with the variance of each node so large that it lies within Huber's distance: it sees no outliers."""
    return smoothness(prepare(item.name, item.held, options, trust**2), options)


def running_median(y: FloatArray) -> FloatArray:
    """Median (n,) of each node and its two neighbours on either side, fewer at the ends."""
    reach = _NEIGHBOURS // 2
    return np.array([np.median(y[max(0, k - reach) : k + reach + 1]) for k in range(len(y))])


def trust_of(residual: FloatArray, scale: FloatArray) -> FloatArray:
    """Huber's weights (n,) in (0, 1] for residuals and standard uncertainties (n,)."""
    far = np.abs(residual) / (HUBER * scale)
    return np.maximum(1 / np.maximum(far, 1.0), _LEAST_TRUST)


def _scale(prepared: Prepared, residual: FloatArray) -> FloatArray:
    """Standard uncertainty (n,) of each node: its own, or one for all from the residuals."""
    if prepared.u0 is not None:
        return prepared.u0 / np.sqrt(prepared.smoother.weight / prepared.trust)
    some = residual[residual != 0]
    spread = _MAD * float(np.median(np.abs(some))) if some.size else 0.0
    return np.full(len(residual), max(spread, 1e-9 * float(np.abs(prepared.y).max(initial=0.0)), 1e-12))
