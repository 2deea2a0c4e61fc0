"""From identified errors to smooth, endpoint-zeroed ones: gauge, smoothing, bounds, uncertainty."""

from compgen.fit.bounds import ActiveBound, CurveReport, FitOptions, FitResult
from compgen.fit.fitting import fit
from compgen.fit.zeroing import FrameChange, Zeroed, zero_ends

__all__ = ["ActiveBound", "CurveReport", "FitOptions", "FitResult", "FrameChange", "Zeroed", "fit", "zero_ends"]
