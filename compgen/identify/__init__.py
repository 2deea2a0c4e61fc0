"""From tracer lengths to error curves, stations and their uncertainty."""

from compgen.identify.identify import identify
from compgen.identify.noise import IdentifyOptions
from compgen.identify.result import Identification, StationResult

__all__ = ["Identification", "IdentifyOptions", "StationResult", "identify"]
