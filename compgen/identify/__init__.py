"""From tracer lengths to error curves, stations and their uncertainty."""

from compgen.identify.covariance import Covariance, joint_covariance, predict_uncertainty, read_covariance
from compgen.identify.identify import identify
from compgen.identify.noise import IdentifyOptions
from compgen.identify.result import Identification, StationResult
from compgen.identify.systematic import SystematicInputs

__all__ = [
    "Covariance",
    "Identification",
    "IdentifyOptions",
    "StationResult",
    "SystematicInputs",
    "identify",
    "joint_covariance",
    "predict_uncertainty",
    "read_covariance",
]
