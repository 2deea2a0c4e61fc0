"""What the package offers, for type checkers; ``__init__.py`` loads each name on first use."""

from compgen.controllers import CONTROLLERS
from compgen.core.deviations import Deviations, format_deviations, read_deviations
from compgen.core.error_table import Curve, ErrorTable, format_errors, read_errors
from compgen.core.lengths import Lengths, format_lengths, read_lengths
from compgen.core.machine import Axis, Chain, Machine, load_machine
from compgen.core.points import Points, format_points, read_points
from compgen.core.reversal import ReversalCurves, format_reversal, read_reversal
from compgen.errors import CompgenError, CompgenWarning, ConvergenceError, InputError, UndeterminedError
from compgen.export import Export, export, wanted_correction
from compgen.fit import FitOptions, FitResult, fit
from compgen.identify import (
    Covariance,
    Identification,
    IdentifyOptions,
    SystematicInputs,
    identify,
    identify_deviations,
    joint_covariance,
    predict_uncertainty,
    read_covariance,
)
from compgen.model import c_matrix, exact_error, modelled_errors, observable_errors, predict, volumetric_error
from compgen.pipeline import RunResult, run
from compgen.plan import Plan, PlannedStations, plan, planned_stations, suggest
from compgen.plugins import load_plugins
from compgen.simulate import Scenario, Simulation, read_scenario, simulate, write_simulation
from compgen.verify import ReadTables, Residuals, Verification, read_tables, residuals, verify, without_rigid_motion

__all__ = [
    "CONTROLLERS",
    "Axis",
    "Chain",
    "CompgenError",
    "CompgenWarning",
    "ConvergenceError",
    "Covariance",
    "Curve",
    "Deviations",
    "ErrorTable",
    "Export",
    "FitOptions",
    "FitResult",
    "Identification",
    "IdentifyOptions",
    "InputError",
    "Lengths",
    "Machine",
    "Plan",
    "PlannedStations",
    "Points",
    "ReadTables",
    "Residuals",
    "ReversalCurves",
    "RunResult",
    "Scenario",
    "Simulation",
    "SystematicInputs",
    "UndeterminedError",
    "Verification",
    "c_matrix",
    "exact_error",
    "export",
    "fit",
    "format_deviations",
    "format_errors",
    "format_lengths",
    "format_points",
    "format_reversal",
    "identify",
    "identify_deviations",
    "joint_covariance",
    "load_machine",
    "load_plugins",
    "modelled_errors",
    "observable_errors",
    "plan",
    "planned_stations",
    "predict",
    "predict_uncertainty",
    "read_covariance",
    "read_deviations",
    "read_errors",
    "read_lengths",
    "read_points",
    "read_reversal",
    "read_scenario",
    "read_tables",
    "residuals",
    "run",
    "simulate",
    "suggest",
    "verify",
    "volumetric_error",
    "wanted_correction",
    "without_rigid_motion",
    "write_simulation",
]
