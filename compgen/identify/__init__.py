"""From tracer lengths to error curves, stations and their uncertainty."""

from compgen.identify.identify import Identification, IdentifyOptions, StationResult, identify

__all__ = ["Identification", "IdentifyOptions", "StationResult", "identify"]
