"""The fit stage: identified errors in, smooth and endpoint-zeroed errors out."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import error_named
from compgen.core.threads import one_thread
from compgen.errors import InputError
from compgen.fit.correlated import curve_covariances
from compgen.fit.curve import Prepared, Weighted, finish, prepare, smoothness, solve
from compgen.fit.endpoints import zero_ends
from compgen.fit.held import HeldCurve
from compgen.fit.options import FitOptions
from compgen.fit.own import OwnConstraints, solve_own
from compgen.fit.result import FitResult
from compgen.fit.robust import robust
from compgen.identify.covariance import Covariance

_DEFAULT = FitOptions()


def fit(
    machine: Machine,
    errors: ErrorTable,
    options: FitOptions = _DEFAULT,
    *,
    covariance: Covariance | Mapping[str, FloatArray] | None = None,
    constraints: OwnConstraints | None = None,
) -> FitResult:
    """Smooth every curve of a table, zero where it has to be, within bounds if these are asked for.

    First the curves are brought to zero without changing the machine (:func:`compgen.fit.zero_ends`), then each is
    the minimum of ``sum((u0/u)^2 (c - y)^2) + mu |D2 c|^2`` that stays zero there (Zha & Zhang 2024, section 5).

    Parameters
    ----------
    machine : travel, reference point, chain, tool offset and modelled errors count.
    errors : curves on any nodes, in mm and rad; the result has the same nodes, and the travel ends where these were
        missing. Uncertainties may be nan (unknown).
    options : smoothness, bounds, robust loss.
    covariance : that of an identification (:func:`compgen.joint_covariance`), or the covariance (n, n) of a curve's
        nodes by error name, mm and rad: (y - c)^T V^-1 (y - c) takes the place of the sum. Curves without have
        independent nodes with the table's uncertainties.
    constraints : your own. It is called with the node values of every curve as cvxpy variables in um or urad, by error
        name, and returns cvxpy constraints, as a list or by name; they may couple curves. The whole problem then goes to
        cvxpy, with the smoothness that the data ask for without them.

    Raises
    ------
    InputError
        for values that are not finite, a squareness that is needed but not in the machine's model, a covariance that
        does not fit, or constraints that no curves satisfy: the message names them and the least relaxation that helps.
    ConvergenceError
        when the bounded fit does not pass its check.
    """
    with one_thread():
        return _fit(machine, errors, options, covariance, constraints)


def _fit(
    machine: Machine,
    errors: ErrorTable,
    options: FitOptions,
    covariance: Covariance | Mapping[str, FloatArray] | None,
    constraints: OwnConstraints | None,
) -> FitResult:
    blocks = curve_covariances(errors, covariance) if covariance is not None else {}
    zeroed = zero_ends(machine, _as_independent(machine, errors, blocks), blocks)
    prepared, weighted = _prepared(zeroed.curves, options)
    mu = [item.mu for item in weighted]
    _check_monotone(prepared, mu)
    solved = solve(prepared, mu) if constraints is None else solve_own(prepared, mu, constraints)
    fitted = {
        item.name: finish(item, how, solution) for item, how, solution in zip(prepared, weighted, solved, strict=True)
    }
    reference = ", ".join(f"{value:g}" for value in machine.reference_point_mm)
    kept = {key: value for key, value in errors.metadata.items() if key != "covariance"}  # that of the unfitted values
    table = ErrorTable(
        curves={name: curve for name, (curve, _) in fitted.items()},
        squareness=zeroed.squareness,
        metadata={**kept, "reference_point_mm": reference},
    )
    return FitResult(table, {name: report for name, (_, report) in fitted.items()}, zeroed.change)


def _prepared(curves: Mapping[str, HeldCurve], options: FitOptions) -> tuple[list[Prepared], list[Weighted]]:
    if options.robust and curves:
        return robust(curves, options)
    prepared = [prepare(name, held, options) for name, held in curves.items()]
    return prepared, [smoothness(item, options) for item in prepared]


def _check_monotone(prepared: Sequence[Prepared], mu: Sequence[float]) -> None:
    """Refuse a direction for a curve that is zero at two points: only zero between them would be left."""
    for item, weight in zip(prepared, mu, strict=True):
        if item.bounds.direction == 0 or len(item.held.rows) < 2:
            continue
        free = item.smoother.solve(weight, item.y[:, None])[:, 0]
        backward = item.bounds.excess(item.held.position_mm, free)[3]
        unit = error_named(item.name).unit
        raise InputError(
            f"{item.name} is zero at both ends of the travel, so that a monotone one is zero all over; leave it out for "
            f"{item.name} (the least relaxation that lets its fit be: slopes of {1e3 * backward:.4g} {unit}/m against "
            "the direction)",
            field="monotone",
        )


def _as_independent(machine: Machine, errors: ErrorTable, known: Container[str]) -> ErrorTable:
    """Give the points of cubic curves the uncertainty that independent points of the same information would have.

    A cubic curve is written at more positions than it has coefficients, so that its points repeat each other; taken
    as independent they would claim too much, and the smoothing would believe them. Curves whose covariance is ``known``
    stay as they are.
    """
    if machine.curves != "cubic":
        return errors
    curves = {}
    for name, curve in errors.curves.items():
        if name in known:
            curves[name] = curve
            continue
        surplus = len(curve.position_mm) / len(machine.axes[error_named(name).axis].nodes_mm)
        curves[name] = Curve(curve.position_mm, curve.value, curve.u * max(1.0, surplus) ** 0.5)
    return errors.replace(curves=curves)
