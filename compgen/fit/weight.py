"""How smooth a curve should be: from its uncertainties (REML), or by cross-validation where these are not known (GCV).

Both with m free unknowns, A = W + mu P (everything in the free unknowns), r = rank P, g the eigenvalues of P against W.

REML: data y ~ N(c, u0^2 W^-1), curve D2 c ~ N(0, tau^2 I), no prior on straight lines, mu = u0^2/tau^2. Twice the negative
log of the restricted likelihood is, up to a constant (Patterson & Thompson 1971; Wahba 1985, Ann. Statist. 13, 1378),

    J(mu) = sum(log(1 + mu g)) - r log(mu) + [sum(w (y - c)^2) + mu |D2 c|^2] / u0^2

GCV (Craven & Wahba 1979, Numer. Math. 31, 377): V(mu) = m sum(w (y - c)^2) / (m - sum(1/(1 + mu g)))^2
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.fit.smooth import Smoother

Method = Literal["REML", "GCV", "given"]
#: Cross-validation needs this many curvatures; with fewer it does not determine a weight and the data are kept.
_GCV_LEAST = 3
_ROUNDING = 1e-12


def reml_criterion(smoother: Smoother, y: FloatArray, u0: float) -> Callable[[float], float]:
    """J of the module's page as a function of mu, for data (n,) with the scale ``u0`` of their uncertainty."""
    costs = smoother.costs(y)

    def value(mu: float) -> float:
        misfit, bending = costs(mu)
        penalty = (misfit + mu * bending) / u0**2
        return float(np.sum(np.log1p(mu * smoother.eigenvalues)) - smoother.rank * np.log(mu) + penalty)

    return value


def gcv_criterion(smoother: Smoother, y: FloatArray) -> Callable[[float], float]:
    """V of the module's page as a function of mu, for data (n,)."""
    costs = smoother.costs(y)

    def value(mu: float) -> float:
        misfit, _ = costs(mu)
        left = np.sum(mu * smoother.eigenvalues / (1 + mu * smoother.eigenvalues))
        return float(smoother.unknowns * misfit / left**2)

    return value


def choose(smoother: Smoother, y: FloatArray, u0: float | None) -> float:
    """Return mu for data (n,): by REML if ``u0`` is known, by GCV if it is None.

    Data without curvature get the largest mu, too few nodes for cross-validation (or for any curvature) 0.
    """
    if smoother.rank == 0 or (u0 is None and smoother.rank < _GCV_LEAST):
        return 0.0
    if np.abs(smoother.bend(y[:, None])).max() <= _ROUNDING * np.abs(smoother.rows).max() * np.abs(y).max():
        return smoother.largest_mu
    criterion = gcv_criterion(smoother, y) if u0 is None else reml_criterion(smoother, y, u0)
    low, high = np.log10(1e-9 / smoother.eigenvalues[-1]), np.log10(smoother.largest_mu)
    return float(10 ** _minimise(lambda exponent: criterion(10**exponent), low, high))


def _minimise(function: Callable[[float], float], low: float, high: float) -> float:
    """Lowest point of a function on an interval: a grid of about one decade, then Brent's method around its best."""
    from scipy.optimize import minimize_scalar  # imported here: slow to load

    grid = np.linspace(low, high, max(3, int(np.ceil(high - low)) + 1))
    values = [function(point) for point in grid]
    best = int(np.argmin(values))
    around = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
    found = minimize_scalar(function, bounds=around, method="bounded", options={"xatol": 1e-3})
    return float(found.x) if found.fun < values[best] else float(grid[best])
