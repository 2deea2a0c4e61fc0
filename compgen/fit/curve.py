"""One curve from preparation to report, in um or urad: weights, smoothness, uncertainty; many are solved together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve
from compgen.core.names import error_named
from compgen.fit.bounds import Bounds, active_bounds
from compgen.fit.correlated import CorrelatedSmoother, propagated
from compgen.fit.held import HeldCurve
from compgen.fit.options import FitOptions
from compgen.fit.result import CurveReport
from compgen.fit.smooth import Smoother
from compgen.fit.solve import Solution, solve_curves, solve_general
from compgen.fit.stacked import CurveProblem
from compgen.fit.weight import Method, choose

#: An uncertainty counts at least this fraction of the curve's median one, and this much (um, urad): exact data.
_LEAST_FRACTION, _LEAST = 1e-3, 1e-6
#: With fewer degrees of freedom left than this the residuals say nothing about the noise.
_LEAST_LEFT = 0.5


@dataclass(frozen=True)
class Prepared:
    """One curve ready to be fitted, everything in um or urad (``unit`` in mm or rad).

    ``y`` (n,) is the zeroed input, ``u0`` the scale of its uncertainty (None: unknown), ``smoother`` holds weights and
    zeros, ``trust`` (n,) the share of each node's weight that a robust loss leaves, ``covariance`` (n, n) that of the
    input if it is used.
    """

    name: str
    held: HeldCurve
    unit: float
    y: FloatArray
    u0: float | None
    smoother: Smoother
    bounds: Bounds
    trust: FloatArray
    covariance: FloatArray | None = None

    def problem(self, mu: float) -> CurveProblem:
        """Return the curve as a problem to be solved at a given smoothness."""
        nodes = tuple(row[0][0] for row in self.held.rows if len(row) == 1)
        return CurveProblem(self.held.position_mm, self.y, self.smoother.weight, nodes, mu, self.bounds)

    @property
    def simple(self) -> bool:
        """Whether nodes are independent and the curve is held at whole nodes."""
        return self.covariance is None and all(other is None for _, other, _ in self.smoother.steps)


@dataclass(frozen=True)
class Weighted:
    """Smoothness and how it was found."""

    mu: float
    method: Method


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
    u = np.maximum(u, _least(u))
    u0 = float(1 / np.sqrt(np.mean(1 / u**2)))
    weight[free] = (u0 / u) ** 2
    return weight, u0


def _least(u: FloatArray) -> float:
    positive = u[u > 0]
    return max(_LEAST, _LEAST_FRACTION * float(np.median(positive))) if positive.size else _LEAST


def prepare(name: str, held: HeldCurve, options: FitOptions, trust: FloatArray | None = None) -> Prepared:
    """Set up the smoother of one held curve; ``trust`` (n,) in (0, 1] divides the variance of each node."""
    unit = error_named(name).si_per_unit
    share = np.ones(len(held.value)) if trust is None else trust
    weight, u0 = weights(held, unit)
    smoother = Smoother.build(held.position_mm, weight * share, held.rows)
    covariance = None
    if held.covariance is not None and u0 is not None and smoother.unknowns:
        covariance = held.covariance / unit**2 / np.sqrt(share[:, None] * share)
        smoother = CorrelatedSmoother.of(smoother, _zeroed_covariance(held, covariance) / u0**2)
    bounds = options.bounds(name).in_unit(unit)
    return Prepared(name, held, unit, held.value / unit, u0, smoother, bounds, share, covariance)


def _zeroed_covariance(held: HeldCurve, covariance: FloatArray) -> FloatArray:
    """Covariance (n, n) after zeroing, with the least variance that counts added, so that it has an inverse."""
    zeroed = held.zeroing @ covariance @ held.zeroing.T
    return np.asarray(zeroed + _least(np.sqrt(np.diag(covariance))) ** 2 * np.eye(len(zeroed)))


def smoothness(prepared: Prepared, options: FitOptions) -> Weighted:
    """Return the given smoothness, or the one that the data ask for."""
    if options.smoothness is not None:
        return Weighted(min(options.smoothness, prepared.smoother.largest_mu), "given")
    method: Method = "REML" if prepared.u0 is not None else "GCV"
    return Weighted(choose(prepared.smoother, prepared.y, prepared.u0), method)


def solve(prepared: Sequence[Prepared], mu: Sequence[float]) -> list[Solution]:
    """Fit curves at given smoothness within their bounds, the simple ones together."""
    simple = [k for k, item in enumerate(prepared) if item.simple]
    found = dict(zip(simple, solve_curves([prepared[k].problem(mu[k]) for k in simple]) if simple else [], strict=True))
    return [
        found[k] if k in found else solve_general(item.problem(mu[k]), item.smoother) for k, item in enumerate(prepared)
    ]


def finish(prepared: Prepared, weighted: Weighted, solution: Solution) -> tuple[Curve, CurveReport]:
    """Return the fitted curve in mm or rad with its uncertainty, and the report.

    The uncertainty is that of the input carried linearly through the zeroing and the smoother without bounds; it does
    not hold the smoothing bias, which the report states.
    """
    smoother, held = prepared.smoother, prepared.held
    bias = smoother.solve(weighted.mu, solution.curve[:, None])[:, 0] - solution.curve
    if prepared.covariance is not None:
        u = propagated(smoother, weighted.mu, held, prepared.covariance) * prepared.unit
    else:
        u = propagate(smoother, weighted.mu, held, prepared.trust)
    curve = Curve(held.position_mm, solution.curve * prepared.unit + 0.0, u)
    return curve, _report(prepared, weighted, solution, bias)


def propagate(smoother: Smoother, mu: float, held: HeldCurve, trust: FloatArray) -> FloatArray:
    """Standard uncertainty (n,) of the fitted curve in mm or rad: sqrt of the diagonal of (S G) U^2 (S G)^T.

    G takes the line or constant out that zeroing removed (G = 1 where nothing was removed), U holds the input's u over
    the root of ``trust`` (n,). An unknown u counts only where the fit uses it; if it does, the result is nan.
    """
    if np.isnan(held.u).all():
        return np.where(smoother.expand(np.ones((len(held.u), 1)))[:, 0] == 0, 0.0, np.nan)
    smooth_shapes = smoother.solve(mu, held.shapes * held.moved)
    functional, variance = held.functional, held.u**2 / trust
    total = np.zeros(len(held.value))
    for picked, columns in smoother.columns(mu):
        gain = columns - smooth_shapes @ functional[:, picked]
        total += np.where(gain != 0, gain**2 * variance[picked], 0.0).sum(axis=1)
    return np.asarray(np.sqrt(total))


def _report(prepared: Prepared, weighted: Weighted, solution: Solution, bias: FloatArray) -> CurveReport:
    smoother, residual = prepared.smoother, prepared.y - solution.curve
    left = smoother.residual_degrees(weighted.mu)
    noise2 = smoother.misfit(residual) / left if left >= _LEAST_LEFT else math.nan
    distrusted = np.flatnonzero(prepared.trust < 1)
    return CurveReport(
        error=prepared.name,
        unit=error_named(prepared.name).unit,
        smoothness=weighted.mu,
        method=weighted.method,
        half_gain_mm=half_gain_mm(weighted.mu, prepared.held.position_mm),
        degrees_of_freedom=smoother.degrees_of_freedom(weighted.mu),
        free_nodes=smoother.unknowns,
        rms_residual=float(np.sqrt(np.mean(residual**2))),
        reduced_chi_square=noise2 / prepared.u0**2 if prepared.u0 is not None else math.nan,
        noise=math.sqrt(noise2),
        smoothing_bias_max=float(np.abs(bias).max()),
        smoothing_bias_rms=float(np.sqrt(np.mean(bias**2))),
        smoothing_bias=bias,
        active_bounds=active_bounds(prepared.held.position_mm, solution.touched, prepared.bounds),
        solver=solution.solver,
        correlated=prepared.covariance is not None,
        distrusted_mm=tuple(float(prepared.held.position_mm[k]) for k in distrusted),
    )


def half_gain_mm(mu: float, position_mm: FloatArray) -> float:
    """Wave length L with 1/(1 + mu (2 sin(pi h/L))^4) = 1/2 at the mean spacing h; 0 if no wave is halved.

    >>> round(half_gain_mm(1.0, np.array([0.0, 10.0, 20.0])), 6)  # six nodes
    60.0
    """
    mean = float(np.mean(np.diff(position_mm)))
    return math.pi * mean / math.asin(0.5 * mu**-0.25) if mu > 1 / 16 else 0.0
