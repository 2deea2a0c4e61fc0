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
from types import ModuleType
from typing import Any

from compgen.resources import on_first_use

#: The public names by the module that defines them.
_HOMES = {
    "compgen.controls": "CONTROLLERS",
    "compgen.data.error_table": "Curve ErrorTable ReversalCurves format_errors read_errors read_reversal",
    "compgen.data.deviations": "Deviations read_deviations",
    "compgen.data.lengths": "Lengths Points read_lengths read_points",
    "compgen.data.machine": "Axis Chain Machine load_machine",
    "compgen.errors": "CompgenError CompgenWarning ConvergenceError InputError UndeterminedError",
    "compgen.tables": "Export ReadTables Verification export read_tables verify without_rigid_motion",
    "compgen.fit": "FitOptions FitResult fit",
    "compgen.identify": "Identification IdentifyOptions identify",
    "compgen.kinematics": "c_matrix exact_error observable_errors predict volumetric_error",
    "compgen.pipeline": "RunResult run",
    "compgen.plan": "Plan plan planned_stations",
    "compgen.plugins": "load_plugins",
    "compgen.simulate": "read_scenario simulate write_simulation",
}
#: Public in :mod:`compgen.readers`, and found here as well: `compgen.read_axis_runs`; ``read_artefact`` and ``read_part`` are
#: the readers of one file or several, by the name that one tries first.
_OF_READERS = (
    "ActiveTables Artefact AxisRuns Circles Diagonals DriftSession ImportOptions ReversalCurves SafetyLimits SixDof "
    "SixDofInstrument SphereCentres StatedNumbers Temperatures open_errors open_measurement read_active read_artefact "
    "read_artefacts read_axis_runs read_circles read_diagonals read_drift read_instrument read_part read_parts read_sixdof "
    "read_spheres read_stations read_temperatures"
)
#: Names that were public until 0.1; they remain in the modules that define them.
_DEPRECATED = {
    "compgen.data.error_table": "format_reversal",
    "compgen.data.deviations": "format_deviations",
    "compgen.data.lengths": "format_lengths format_points",
    "compgen.tables": "Residuals residuals wanted_correction",
    "compgen.identify": (
        "Covariance SystematicInputs identify_deviations joint_covariance predict_uncertainty read_covariance"
    ),
    "compgen.kinematics": "modelled_errors",
    "compgen.plan": "PlannedStations suggest",
    "compgen.simulate": "Scenario Simulation",
}
#: Version that removes the deprecated names.
_REMOVED_IN = "0.3"
__all__ = sorted(name for names in _HOMES.values() for name in names.split())


def _deprecated(name: str, home: str) -> property:
    """Load a deprecated name like the others, with a warning that gives its replacement."""
    found = on_first_use(name, home)

    def load(package: ModuleType) -> Any:
        text = f"compgen.{name} is deprecated and will be removed in {_REMOVED_IN}; use `from {home} import {name}`"
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        return found.__get__(package)

    return property(load, found.fset)


def __dir__() -> list[str]:
    return __all__


sys.modules[__name__].__class__ = type(
    "_Package",
    (ModuleType,),
    {
        name: make(name, home)
        for table, make in (
            ({"compgen.readers": _OF_READERS}, on_first_use),
            (_HOMES, on_first_use),
            (_DEPRECATED, _deprecated),
        )
        for home, names in table.items()
        for name in names.split()
    },
)
