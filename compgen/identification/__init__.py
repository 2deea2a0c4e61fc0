"""From tracer lengths to error curves, stations and their uncertainty."""

from typing import TYPE_CHECKING

from compgen.resources import on_first_use

if TYPE_CHECKING:
    from compgen.identification.adjust.propagation import SystematicInputs
    from compgen.identification.any_measurement import describe, identify_measurement, read_measurement
    from compgen.identification.covariance import Covariance, joint_covariance, predict_uncertainty, read_covariance
    from compgen.identification.monte_carlo import SelfCheck, sample_errors, self_check
    from compgen.identification.options import IdentifyOptions, KnownStations, locate_stations, read_stations
    from compgen.identification.positions import identify_deviations
    from compgen.identification.result import Identification, StationResult
    from compgen.identification.six_dof import SixDofMeasurement, identify_sixdof
    from compgen.identification.tracer_lengths import identify

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

if not TYPE_CHECKING:
    __getattr__ = on_first_use(__name__)
