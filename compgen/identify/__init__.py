"""From tracer lengths to error curves, stations and their uncertainty."""

from typing import TYPE_CHECKING

from compgen.resources import load_on_first_use

if TYPE_CHECKING:
    from compgen.identify.adjust.propagation import SystematicInputs
    from compgen.identify.any_measurement import describe, identify_measurement, read_measurement
    from compgen.identify.covariance import Covariance, joint_covariance, predict_uncertainty, read_covariance
    from compgen.identify.identification import Identification, StationResult
    from compgen.identify.monte_carlo import SelfCheck, sample_errors, self_check
    from compgen.identify.options import IdentifyOptions, KnownStations, locate_stations, read_stations
    from compgen.identify.positions import identify_deviations
    from compgen.identify.six_dof import SixDofMeasurement, identify_sixdof
    from compgen.identify.tracer_lengths import identify

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

load_on_first_use(__name__, __all__)
