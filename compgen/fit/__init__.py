"""From identified errors to smooth, endpoint-zeroed ones: gauge, smoothing, bounds, uncertainty."""

from compgen.fit.endpoints import Zeroed, zero_ends
from compgen.fit.frame import FrameChange
from compgen.fit.options import FitOptions
from compgen.fit.result import ActiveBound, CurveReport, FitResult
from compgen.fit.stage import fit

__all__ = ["ActiveBound", "CurveReport", "FitOptions", "FitResult", "FrameChange", "Zeroed", "fit", "zero_ends"]
