"""From identified errors to smooth, endpoint-zeroed ones: gauge, smoothing, bounds, uncertainty."""

from compgen.fitting.bounds import ActiveBound, CurveReport, FitOptions, FitResult
from compgen.fitting.curve_fit import fit
from compgen.fitting.zeroing import FrameChange, Zeroed, zero_ends

__all__ = ["ActiveBound", "CurveReport", "FitOptions", "FitResult", "FrameChange", "Zeroed", "fit", "zero_ends"]
