"""compgen: from a machine-tool measurement to checked compensation tables.

Each stage is a function on plain data, without side effects: :func:`load_machine`, :func:`read_lengths`,
:func:`identify`, :func:`fit`, :func:`export`, :func:`read_tables`, :func:`verify`, :func:`predict`.

The names are loaded on first use, so that a program that needs one of them does not wait for all.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

#: The public names by the module that defines them.
_HOMES = {
    "compgen.controllers": "CONTROLLERS",
    "compgen.core.deviations": "Deviations format_deviations read_deviations",
    "compgen.core.error_table": "Curve ErrorTable format_errors read_errors",
    "compgen.core.lengths": "Lengths format_lengths read_lengths",
    "compgen.core.machine": "Axis Chain Machine load_machine",
    "compgen.core.points": "Points format_points read_points",
    "compgen.core.reversal": "ReversalCurves format_reversal read_reversal",
    "compgen.errors": "CompgenError CompgenWarning ConvergenceError InputError UndeterminedError",
    "compgen.export": "Export export wanted_correction",
    "compgen.fit": "FitOptions FitResult fit",
    "compgen.identify": (
        "Covariance Identification IdentifyOptions SystematicInputs "
        "identify identify_deviations joint_covariance predict_uncertainty read_covariance"
    ),
    "compgen.model": "c_matrix exact_error modelled_errors observable_errors predict volumetric_error",
    "compgen.pipeline": "RunResult run",
    "compgen.plan": "Plan PlannedStations plan planned_stations suggest",
    "compgen.plugins": "load_plugins",
    "compgen.simulate": "Scenario Simulation read_scenario simulate write_simulation",
    "compgen.verify": "ReadTables Residuals Verification read_tables residuals verify without_rigid_motion",
}
__all__ = sorted(name for names in _HOMES.values() for name in names.split())


def _on_first_use(name: str, home: str) -> property:
    """A public name as a property: importing the sub-package ``compgen.fit`` must not hide the function ``fit``."""

    def load(package: ModuleType) -> Any:
        return getattr(import_module(home), name)

    def keep(package: ModuleType, value: Any) -> None:
        # the import system sets every sub-package as an attribute of the package; the public name stays what it is
        if not isinstance(value, ModuleType):
            raise AttributeError(f"compgen.{name} cannot be replaced; it belongs to {home}")

    return property(load, keep)


def __dir__() -> list[str]:
    return __all__


sys.modules[__name__].__class__ = type(
    "_Package",
    (ModuleType,),
    {name: _on_first_use(name, home) for home, names in _HOMES.items() for name in names.split()},
)
