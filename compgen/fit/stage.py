"""The fit stage: identified errors in, smooth and endpoint-zeroed errors out."""

from __future__ import annotations

from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import error_named
from compgen.fit.curve import fit_curve
from compgen.fit.endpoints import zero_ends
from compgen.fit.options import FitOptions
from compgen.fit.result import FitResult

_DEFAULT = FitOptions()


def fit(machine: Machine, errors: ErrorTable, options: FitOptions = _DEFAULT) -> FitResult:
    """Smooth every curve of a table, zero where it has to be, within bounds if these are asked for.

    First the curves are brought to zero without changing the machine (:func:`compgen.fit.zero_ends`), then each is
    the minimum of ``sum((u0/u)^2 (c - y)^2) + mu |D2 c|^2`` that stays zero there (Zha & Zhang 2024, section 5).

    Parameters
    ----------
    machine : travel, reference point, chain, tool offset and modelled errors count.
    errors : curves on any nodes, in mm and rad; the result has the same nodes, and the travel ends where these were
        missing. Uncertainties may be nan (unknown).
    options : smoothness and bounds.

    Raises
    ------
    InputError
        for values that are not finite, or a squareness that is needed but not in the machine's model.
    ConvergenceError
        when the bounded fit does not pass its check.
    """
    zeroed = zero_ends(machine, _as_independent(machine, errors))
    fitted = {name: fit_curve(name, held, options) for name, held in zeroed.curves.items()}
    reference = ", ".join(f"{value:g}" for value in machine.reference_point_mm)
    kept = {key: value for key, value in errors.metadata.items() if key != "covariance"}  # that of the unfitted values
    table = ErrorTable(
        curves={name: curve for name, (curve, _) in fitted.items()},
        squareness=zeroed.squareness,
        metadata={**kept, "reference_point_mm": reference},
    )
    return FitResult(table, {name: report for name, (_, report) in fitted.items()}, zeroed.change)


def _as_independent(machine: Machine, errors: ErrorTable) -> ErrorTable:
    """Give the points of cubic curves the uncertainty that independent points of the same information would have.

    A cubic curve is written at more positions than it has coefficients, so that its points repeat each other; taken
    as independent they would claim too much, and the smoothing would believe them.
    """
    if machine.curves != "cubic":
        return errors
    curves = {}
    for name, curve in errors.curves.items():
        surplus = len(curve.position_mm) / len(machine.axes[error_named(name).axis].nodes_mm)
        curves[name] = Curve(curve.position_mm, curve.value, curve.u * max(1.0, surplus) ** 0.5)
    return errors.replace(curves=curves)
