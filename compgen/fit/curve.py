"""The fit of one curve, in um or urad: weights, smoothness, solution, bounds, uncertainty, report."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve
from compgen.core.names import error_named
from compgen.fit.bounded import constraint_rows, fit_bounded, is_within
from compgen.fit.held import HeldCurve
from compgen.fit.options import FitOptions
from compgen.fit.result import ActiveBound, CurveReport
from compgen.fit.smooth import Smoother
from compgen.fit.weight import Method, choose

#: An uncertainty counts at least this fraction of the curve's median one, and this much (um, urad): exact data.
_LEAST_FRACTION, _LEAST = 1e-3, 1e-6
#: With fewer degrees of freedom left than this the residuals say nothing about the noise.
_LEAST_LEFT = 0.5


@dataclass(frozen=True)
class _Solved:
    """A curve (n,) in um or urad with the weight and method that gave it."""

    curve: FloatArray
    mu: float
    method: Method
    active: tuple[ActiveBound, ...] = ()
    solver: str = "direct"


def weights(held: HeldCurve, unit: float) -> tuple[FloatArray, float | None]:
    """Dimensionless weights (u0/u)^2, shape (n,), and u0 in um or urad; ones and None if an uncertainty is unknown.

    Nodes that are held at zero do not count; u0 is the harmonic root mean square of the others.
    """
    weight = np.ones(len(held.value))
    free = np.ones(len(weight), dtype=bool)
    free[[row[0][0] for row in held.rows if len(row) == 1]] = False
    u = held.u[free] / unit
    if not np.isfinite(u).all() or not u.size:
        return weight, None
    positive = u[u > 0]
    least = max(_LEAST, _LEAST_FRACTION * float(np.median(positive))) if positive.size else _LEAST
    u = np.maximum(u, least)
    u0 = float(1 / np.sqrt(np.mean(1 / u**2)))
    weight[free] = (u0 / u) ** 2
    return weight, u0


def fit_curve(name: str, held: HeldCurve, options: FitOptions) -> tuple[Curve, CurveReport]:
    """Fit one held curve; returns it in mm or rad with its uncertainty, and the report.

    The uncertainty is that of the input (nodes independent) carried linearly through the zeroing and the smoother
    without bounds; it does not hold the smoothing bias, which the report states.
    """
    unit = error_named(name).si_per_unit
    weight, u0 = weights(held, unit)
    smoother = Smoother.build(held.position_mm, weight, held.rows)
    y = held.value / unit
    solved = _solve(name, held, smoother, u0, options)
    bias = smoother.solve(solved.mu, solved.curve[:, None])[:, 0] - solved.curve
    u = propagate(smoother, solved.mu, held)
    curve = Curve(held.position_mm, solved.curve * unit + 0.0, u)
    return curve, _report(name, smoother, y, u0, solved, bias, held.position_mm)


def _solve(name: str, held: HeldCurve, smoother: Smoother, u0: float | None, options: FitOptions) -> _Solved:
    unit = error_named(name).si_per_unit
    y = held.value / unit
    method: Method = "REML" if u0 is not None else "GCV"
    if options.smoothness is not None:
        mu, method = min(options.smoothness, smoother.largest_mu), "given"
    else:
        mu = choose(smoother, y, u0)
    curve = smoother.solve(mu, y[:, None])[:, 0]
    largest, steepest = (limit / unit for limit in options.limits(name))
    if is_within(held.position_mm, curve, largest, steepest):
        return _Solved(curve, mu, method)
    rows = constraint_rows(held.position_mm, smoother, largest, steepest)
    bounded = fit_bounded(smoother, mu, y, rows)
    return _Solved(bounded.curve, mu, method, _active(held.position_mm, bounded.active), bounded.solver)


def _active(position_mm: FloatArray, rows: FloatArray) -> tuple[ActiveBound, ...]:
    n = len(position_mm)
    nodes = [ActiveBound("max_abs", *[float(position_mm[k])] * 2) for k in np.flatnonzero(rows[:n])]
    slopes = np.flatnonzero(rows[n:])
    return (*nodes, *(ActiveBound("max_slope", float(position_mm[k]), float(position_mm[k + 1])) for k in slopes))


def propagate(smoother: Smoother, mu: float, held: HeldCurve) -> FloatArray:
    """Standard uncertainty (n,) of the fitted curve in mm or rad: sqrt of the diagonal of (S G) U^2 (S G)^T.

    G takes the line or constant out that zeroing removed (G = 1 where nothing was removed), U holds the input's u.
    An unknown u counts only where the fit uses it; if it does, the result is nan.
    """
    if np.isnan(held.u).all():
        return np.where(smoother.expand(np.ones((len(held.u), 1)))[:, 0] == 0, 0.0, np.nan)
    shapes = held.shapes * held.moved
    smooth_shapes = smoother.solve(mu, shapes)
    functional = np.zeros((len(held.rows), len(held.value)))
    for k, row in enumerate(held.rows):
        for node, factor in row:
            functional[k, node] += factor
    variance = np.zeros(len(held.value))
    for picked, columns in smoother.columns(mu):
        gain = columns - smooth_shapes @ functional[:, picked]
        used = np.where(gain != 0, gain**2 * held.u[picked] ** 2, 0.0)
        variance += used.sum(axis=1)
    return np.asarray(np.sqrt(variance))


def _report(
    name: str,
    smoother: Smoother,
    y: FloatArray,
    u0: float | None,
    solved: _Solved,
    bias: FloatArray,
    position_mm: FloatArray,
) -> CurveReport:
    residual = y - solved.curve
    used = smoother.degrees_of_freedom(solved.mu)
    left = smoother.residual_degrees(solved.mu)
    noise2 = float(np.sum(smoother.weight * residual**2)) / left if left >= _LEAST_LEFT else math.nan
    return CurveReport(
        error=name,
        unit=error_named(name).unit,
        smoothness=solved.mu,
        method=solved.method,
        half_gain_mm=half_gain_mm(solved.mu, position_mm),
        degrees_of_freedom=used,
        free_nodes=smoother.unknowns,
        rms_residual=float(np.sqrt(np.mean(residual**2))),
        reduced_chi_square=noise2 / u0**2 if u0 is not None else math.nan,
        noise=math.sqrt(noise2),
        smoothing_bias_max=float(np.abs(bias).max()),
        smoothing_bias_rms=float(np.sqrt(np.mean(bias**2))),
        smoothing_bias=bias,
        active_bounds=solved.active,
        solver=solved.solver,
    )


def half_gain_mm(mu: float, position_mm: FloatArray) -> float:
    """Wave length L with 1/(1 + mu (2 sin(pi h/L))^4) = 1/2 at the mean spacing h; 0 if no wave is halved.

    >>> round(half_gain_mm(1.0, np.array([0.0, 10.0, 20.0])), 6)  # six nodes
    60.0
    """
    mean = float(np.mean(np.diff(position_mm)))
    return math.pi * mean / math.asin(0.5 * mu**-0.25) if mu > 1 / 16 else 0.0
