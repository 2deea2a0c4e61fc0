"""What the package offers, for type checkers; ``__init__.py`` loads each name on first use."""

from compgen.controls import CONTROLLERS
from compgen.data.deviations import Deviations, read_deviations
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves, format_errors, read_errors, read_reversal
from compgen.data.lengths import Lengths, Points, read_lengths, read_points
from compgen.data.machine import Axis, Chain, Machine, load_machine
from compgen.errors import CompgenError, CompgenWarning, ConvergenceError, InputError, UndeterminedError
from compgen.fit import FitOptions, FitResult, fit
from compgen.identify import Identification, IdentifyOptions, identify
from compgen.kinematics import c_matrix, exact_error, observable_errors, predict, volumetric_error
from compgen.pipeline import RunResult, run
from compgen.plan import Plan, plan, planned_stations
from compgen.plugins import load_plugins
from compgen.simulate import read_scenario, simulate, write_simulation
from compgen.tables import Export, ReadTables, Verification, export, read_tables, verify, without_rigid_motion

__all__ = [
    "Axis",
    "CONTROLLERS",
    "Chain",
    "CompgenError",
    "CompgenWarning",
    "ConvergenceError",
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
    "Points",
    "ReadTables",
    "ReversalCurves",
    "RunResult",
    "UndeterminedError",
    "Verification",
    "c_matrix",
    "exact_error",
    "export",
    "fit",
    "format_errors",
    "identify",
    "load_machine",
    "load_plugins",
    "observable_errors",
    "plan",
    "planned_stations",
    "predict",
    "read_deviations",
    "read_errors",
    "read_lengths",
    "read_points",
    "read_reversal",
    "read_scenario",
    "read_tables",
    "run",
    "simulate",
    "verify",
    "volumetric_error",
    "without_rigid_motion",
    "write_simulation",
]
