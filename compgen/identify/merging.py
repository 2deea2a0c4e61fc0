"""Errors of one machine from two instruments: brought to the same gauge, compared, and averaged if they agree.

The six-DOF instrument measures all 21 errors, a tracer (or a set of measured positions) those observable with its chain
and tool, each in a different gauge. So the six-DOF errors are projected: least squares finds the errors of the other
identification's layout, plus a rigid motion, that move the tool in the same way. That combines what this layout cannot
distinguish (:func:`compgen.kinematics.gauge.align` gives the same if nothing has to be combined), and propagates the
covariance. Then every value is compared and averaged with the inverse variances as weights.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from compgen.data.comparison import Uncertain, compare, normalized_error, small_motion
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM, error_named
from compgen.errors import CompgenWarning, InputError
from compgen.identify.adjust.unknowns import ErrorParameters
from compgen.identify.covariance import error_design, error_values, joint_covariance, values_at_nodes
from compgen.identify.identification import Identification, table_of_values, worst_uncertainty
from compgen.kinematics.first_order import c_matrix, tool_of
from compgen.kinematics.many_points import full_grid

#: Probability of a false report that two measurements disagree.
FALSE_ALARM = 0.05
#: Degrees of freedom of a stated scatter.
MANY = 1e6
#: Levels of the other axes at which the motion of the tool is compared.
LEVELS = 3


@dataclass(frozen=True)
class InstrumentAgreement:
    """Comparison of two identifications, by error.

    Parameters
    ----------
    en : largest |difference| / (k u(difference)) over the positions of each error; above 1 they disagree.
    coverage_factor : k of Student's distribution, chosen so that ``FALSE_ALARM`` holds for all values together.
    not_expressed_mm : largest motion of the tool of the second one that the errors of the first cannot express.
    """

    en: dict[str, float]
    coverage_factor: float
    not_expressed_mm: float

    @property
    def disagree(self) -> list[str]:
        """Names of the errors that disagree."""
        return [name for name, value in self.en.items() if value > 1.0]


def merge(machine: Machine, first: Identification, second: Identification) -> Identification:
    """Merge the identification of lengths or deviations with that of six-DOF readings of the same machine.

    Values that agree are averaged. An error that disagrees keeps the value of ``first``, with half of the difference as
    additional uncertainty, and is listed in a CompgenWarning.

    Raises
    ------
    InputError
        if the six-DOF readings do not cover all three axes, or one of the two has no uncertainties.
    """
    _check(machine, first, second)
    own = joint_covariance(first)
    names, positions, turned, factor, left = projected(machine, first.layout, second)
    values = values_at_nodes(first.errors, names, positions)
    freedom = float(second.details.get("repeatability_freedom") or MANY)
    pair = (values, own.errors_factor), (turned, factor)
    agreement = _compare(names, *pair, left, freedom)
    merged, roots = _average(names, agreement, *pair)
    errors = _table(first.errors, names, positions, merged, roots)
    texts = _texts(agreement)
    for text in texts:
        warnings.warn(text, CompgenWarning, stacklevel=3)
    details = {
        "en": agreement.en,
        "coverage_factor": agreement.coverage_factor,
        "disagree": agreement.disagree,
        "not_expressed_um": agreement.not_expressed_mm / MM_PER_UM,
        "first": first.method,
        "sixdof": dict(second.details),
    }
    return replace(
        first,
        errors=errors,
        method="merged",
        adjustment=None,
        values_factor=roots,
        worst_u=worst_uncertainty(errors),
        reversal_curves=second.reversal_curves,
        corrections={**first.corrections, **({"sixdof": dict(second.corrections)} if second.corrections else {})},
        details=details,
        objections=(*first.objections, *second.objections, *texts),
    )


def _check(machine: Machine, first: Identification, second: Identification) -> None:
    missing = [axis for axis in AXES if f"E{axis}{axis}" not in second.errors.curves]
    if missing:
        message = f"the six-DOF readings lack {', '.join(missing)}; merging requires all three axes"
        raise InputError(message + "; otherwise identify the files separately")
    if not first.has_covariance or not second.has_covariance:
        raise InputError("one of the measurements has no uncertainties, so they cannot be compared or averaged")


def _points(machine: Machine) -> FloatArray:
    """Positions (m, 3): every axis at its nodes, the others at a few levels."""
    levels = [np.linspace(*axis.range_mm, LEVELS) for axis in machine.axes]
    parts = []
    for k, axis in enumerate(machine.axes):
        lists = [axis.nodes_mm if j == k else levels[j] for j in range(3)]
        parts.append(full_grid(lists).reshape(-1, 3))
    return np.vstack(parts)


Rows = tuple[list[str], FloatArray, FloatArray, FloatArray, float]


def projected(machine: Machine, layout: ErrorParameters, second: Identification) -> Rows:
    """Six-DOF errors in the layout of another identification.

    Returns name and position of each value (k,), the values (k,), their factor (k, r), and the largest motion of the
    tool that the layout cannot express, mm.
    """
    position = _points(machine)
    bases = [layout.basis(axis, position[:, axis]) for axis in range(3)]
    design = layout.design(c_matrix(machine, position, None), bases).reshape(-1, layout.size)
    covariance = joint_covariance(second)
    target = error_design(machine, covariance, position).reshape(len(design), -1)
    motion = small_motion(position + tool_of(machine, None))  # each instrument has a frame of its own
    design, target = motion.taken_out(design), motion.taken_out(target)
    scale = np.linalg.norm(design, axis=0)
    found = np.linalg.lstsq(design / scale, target, rcond=1e-11)[0] / scale[:, None]
    values = values_at_nodes(second.errors, list(covariance.error), covariance.position_mm)
    left = float(np.abs((design @ found - target) @ values).max())
    names, positions, rows = [], [], []
    for name, at, columns, matrix in error_values(layout):
        names += [name] * len(at)
        positions.append(at)
        rows.append(matrix @ found[columns])
    change = np.vstack(rows)
    return names, np.concatenate(positions), change @ values, change @ covariance.errors_factor, left


def _compare(
    names: Sequence[str], first: Uncertain, second: Uncertain, left_mm: float, freedom: float
) -> InstrumentAgreement:
    from scipy.special import stdtrit  # imported here: slow to load, and few measurements have two instruments

    found = compare(first, second)
    known = found.u > 1e-15
    k = -float(stdtrit(freedom, FALSE_ALARM / 2.0 / max(int(known.sum()), 1)))
    ratio = np.where(known, normalized_error(found.value, k * found.u), 0.0)
    label = np.array(names)
    en = {name: float(ratio[label == name].max()) for name in dict.fromkeys(names)}
    return InstrumentAgreement(en, k, left_mm)


def _average(
    names: Sequence[str], agreement: InstrumentAgreement, first: Uncertain, second: Uncertain
) -> tuple[FloatArray, FloatArray]:
    """Weighted means (k,) and a factor of their covariance; disagreeing errors keep the first value."""
    (one, root1), (other, root2) = first, second
    square1, square2 = (np.einsum("ij,ij->i", root, root) for root in (root1, root2))
    square = square1 + square2
    share = np.where(square > 0, square1 / np.where(square > 0, square, 1.0), 0.0)
    label = np.array(names)
    odd = np.zeros((len(names), len(agreement.disagree)))
    for column, name in enumerate(agreement.disagree):
        rows = label == name
        share[rows] = 0.0
        odd[rows, column] = 0.5 * (other - one)[rows]
    merged = (1.0 - share) * one + share * other
    return merged, np.hstack([(1.0 - share)[:, None] * root1, share[:, None] * root2, odd])


def _table(
    errors: ErrorTable, names: Sequence[str], positions: FloatArray, values: FloatArray, root: FloatArray
) -> ErrorTable:
    u = np.sqrt(np.einsum("ij,ij->i", root, root))
    label = np.array(names)
    rows = {name: label == name for name in dict.fromkeys(names)}
    found = table_of_values((name, positions[at], values[at], u[at]) for name, at in rows.items())
    return errors.replace(curves=found.curves, squareness=found.squareness)


def _texts(agreement: InstrumentAgreement) -> tuple[str, ...]:
    """Return the warnings; empty if everything agrees."""
    if not agreement.disagree:
        return ()
    listed = ", ".join(f"{name} ({agreement.en[name]:.1f})" for name in agreement.disagree)
    kinds = {error_named(name).kind for name in agreement.disagree}
    return (
        f"the two instruments disagree beyond their uncertainty in {listed} (En, 1 is the limit): these "
        f"{'angles and lengths' if len(kinds) > 1 else 'errors'} keep the value of the first one with half of the "
        "difference as uncertainty; check calibration, set-up and time between the measurements",
    )
