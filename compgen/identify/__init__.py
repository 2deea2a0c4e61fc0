"""From tracer lengths to error curves, stations and their uncertainty."""

from compgen.identify.covariance import Covariance, joint_covariance, predict_uncertainty, read_covariance
from compgen.identify.deviations import identify_deviations
from compgen.identify.identify import identify
from compgen.identify.known_stations import KnownStations, locate_stations, read_stations
from compgen.identify.measurement import describe, identify_measurement, read_measurement
from compgen.identify.monte_carlo import SelfCheck, sample_errors, self_check
from compgen.identify.noise import IdentifyOptions
from compgen.identify.result import Identification, StationResult
from compgen.identify.sixdof import SixDofMeasurement, identify_sixdof
from compgen.identify.systematic import SystematicInputs

__all__ = [
    "Covariance",
    "Identification",
    "IdentifyOptions",
    "KnownStations",
    "SelfCheck",
    "SixDofMeasurement",
    "StationResult",
    "SystematicInputs",
    "describe",
    "identify",
    "identify_deviations",
    "identify_measurement",
    "identify_sixdof",
    "joint_covariance",
    "locate_stations",
    "predict_uncertainty",
    "read_covariance",
    "read_measurement",
    "read_stations",
    "sample_errors",
    "self_check",
]
