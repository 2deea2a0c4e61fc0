"""compgen: from a machine-tool measurement to checked compensation tables.

Each stage is a function on plain data, without side effects: :func:`load_machine`, :func:`read_lengths`,
:func:`identify`, :func:`fit`, :func:`export`, :func:`read_tables`, :func:`verify`, :func:`predict`.

Each name is loaded on first use: a program that needs only one does not wait for the rest.
"""

import os
import sys

# ``python -m compgen`` looks for modules in the working folder first, where there may be anybody's files: a ``numpy.py``, or a
# plug-in that looks installed. Python names the module "-m" until it has found it.
if sys.argv[:1] == ["-m"] and not sys.flags.safe_path and os.path.join(sys.path[0], __name__) not in __path__:
    del sys.path[0]

import warnings
from importlib import import_module
from typing import TYPE_CHECKING, Any

from compgen.resources import on_first_use

if TYPE_CHECKING:
    from compgen.controls import CONTROLLERS
    from compgen.data.deviations import Deviations, read_deviations
    from compgen.data.error_table import Curve, ErrorTable, ReversalCurves, format_errors, read_errors, read_reversal
    from compgen.data.lengths import Lengths, Points, read_lengths, read_points
    from compgen.data.machine import Axis, Chain, Machine, load_machine
    from compgen.errors import CompgenError, CompgenWarning, ConvergenceError, InputError, UndeterminedError
    from compgen.fitting import FitOptions, FitResult, fit
    from compgen.identification import Identification, IdentifyOptions, identify
    from compgen.kinematics import c_matrix, exact_error, observable_errors, predict, volumetric_error
    from compgen.pipeline import RunResult, run
    from compgen.planning import Plan, plan, planned_stations
    from compgen.plugins import load_plugins
    from compgen.simulation import read_scenario, simulate, write_simulation
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

#: Public in :mod:`compgen.readers`, and found here as well: `compgen.read_axis_runs`; ``read_artefact`` and ``read_part`` are
#: the readers of one file or several, by the name that one tries first.
_OF_READERS = (
    "ActiveTables Artefact AxisRuns Circles Diagonals DriftSession ImportOptions ReversalCurves SafetyLimits SixDof "
    "SixDofInstrument SphereCentres StatedNumbers Temperatures open_errors open_measurement read_active read_artefact "
    "read_artefacts read_axis_runs read_circles read_diagonals read_drift read_instrument read_part read_parts "
    "read_sixdof read_spheres read_stations read_temperatures"
)
#: Names that were public until 0.1; they remain in the modules that define them.
_DEPRECATED = {
    "compgen.data.error_table": "format_reversal",
    "compgen.data.deviations": "format_deviations",
    "compgen.data.lengths": "format_lengths format_points",
    "compgen.tables": "Residuals residuals wanted_correction",
    "compgen.identification": (
        "Covariance SystematicInputs identify_deviations joint_covariance predict_uncertainty read_covariance"
    ),
    "compgen.kinematics": "modelled_errors",
    "compgen.planning": "PlannedStations suggest",
    "compgen.simulation": "Scenario Simulation",
}
#: Version that removes the deprecated names.
_REMOVED_IN = "0.3"


def __dir__() -> list[str]:
    return __all__


if not TYPE_CHECKING:
    _public = on_first_use(__name__)

    def __getattr__(name: str) -> Any:
        """Load a public name on first use; a deprecated one with a warning that gives its replacement."""
        if name in _OF_READERS.split():
            return getattr(import_module("compgen.readers"), name)
        for home, names in _DEPRECATED.items():
            if name in names.split():
                text = f"compgen.{name} is deprecated and will be removed in {_REMOVED_IN}; use `from {home} import {name}`"
                warnings.warn(text, DeprecationWarning, stacklevel=2)
                return getattr(import_module(home), name)
        return _public(name)
