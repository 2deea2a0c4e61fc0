"""What the fit returns: the fitted table, a report per curve, and what was moved out of the curves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.fit.frame import FrameChange
from compgen.fit.weight import Method


@dataclass(frozen=True)
class ActiveBound:
    """A bound that the fitted curve touches, positions in mm.

    ``max_abs`` at one node, ``max_slope`` and ``monotone`` between two, ``max_curvature`` over three.
    """

    bound: str
    from_mm: float
    to_mm: float


@dataclass(frozen=True)
class CurveReport:
    """How one curve was fitted; amounts are in ``unit`` (um or urad).

    Parameters
    ----------
    smoothness : the dimensionless weight that was used (:class:`compgen.fit.FitOptions` says what it means).
    method : how the weight was found: ``REML`` (uncertainties known), ``GCV`` (unknown) or ``given``.
    half_gain_mm : wave length that the smoothing halves, on even nodes; 0 if none is.
    degrees_of_freedom : effective ones, trace of the smoother without bounds; ``free_nodes`` is their largest number.
    rms_residual : root mean square of data minus fit, over all nodes, after the data were brought to zero ends.
    reduced_chi_square : weighted square sum of the residuals over its expectation, trace of (1 - S)^2 (Buckley,
        Eagleson & Silverman 1988, Biometrika 75, 189): near 1 if the uncertainties are right; nan where they are
        unknown or where less than half a degree of freedom is left.
    noise : standard deviation of the data's noise at unit weight, from the same quotient; nan if too little is left.
    smoothing_bias_max, smoothing_bias_rms : how much the smoothing flattens a curve like the fitted one, S c - c.
    smoothing_bias : the same per position, shape (n,).
    active_bounds : where the curve touches a bound.
    solver : ``direct``; ``interior point`` when a bound is active, ``active set`` when nodes are correlated as well
        (``OSQP`` or ``Clarabel`` where neither applies, or fails); ``cvxpy`` with constraints of your own.
    correlated : whether the covariance of the nodes was used.
    distrusted_mm : nodes that a robust loss gave less than their weight.
    """

    error: str
    unit: str
    smoothness: float
    method: Method
    half_gain_mm: float
    degrees_of_freedom: float
    free_nodes: int
    rms_residual: float
    reduced_chi_square: float
    noise: float
    smoothing_bias_max: float
    smoothing_bias_rms: float
    smoothing_bias: FloatArray = field(repr=False, compare=False)
    active_bounds: tuple[ActiveBound, ...] = ()
    solver: str = "direct"
    correlated: bool = False
    distrusted_mm: tuple[float, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Return plain values for JSON; unknown numbers are None."""
        plain = {**asdict(self), "smoothing_bias": self.smoothing_bias.tolist()}
        return {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in plain.items()}


@dataclass(frozen=True)
class FitResult:
    """Fitted ``errors`` with their uncertainty, the ``report`` by error name, and the ``change`` of the frame.

    E of the input and E of the zeroed input differ by ``change``; the fit itself then only smooths.
    """

    errors: ErrorTable
    report: Mapping[str, CurveReport]
    change: FrameChange

    def to_dict(self) -> dict[str, object]:
        """Return reports and frame change as plain values for JSON."""
        reports = {name: report.to_dict() for name, report in self.report.items()}
        return {"curves": reports, "frame_change": self.change.to_dict()}
