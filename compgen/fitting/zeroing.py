"""Zeros at the reference point or at both ends: fixed points of each curve, and where the removed motion goes."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable, about_own_lines, is_apart
from compgen.data.machine import Machine
from compgen.data.names import AXES, ERROR_NAMES, SQUARENESS_NAMES, error_named
from compgen.errors import CompgenWarning, InputError, Message
from compgen.kinematics import coefficients, modelled_errors, observable_errors

# Curves that are zero at their fixed points: straightness at both travel ends, the others at the reference point.


#: A node closer to a position than this is at that position (file positions have six decimals).
SAME_POSITION_MM = 1e-6
#: Values below this (mm or rad) are rounding errors, not a removed motion.
NOTHING = 1e-12

#: A linear functional of the node values: (node, factor) pairs.
Row = tuple[tuple[int, float], ...]


@dataclass(frozen=True)
class FixedCurve:
    """A curve that is zero at its fixed points, with the functionals that must stay zero.

    ``position_mm``, ``value``, ``u`` have shape (n,), in mm or rad; ``u`` is the uncertainty of the input.
    ``rows`` are the k functionals (zero for ``value``); ``removed`` (k,) contains their values for the input and
    ``shapes`` (n, k) the curves removed per unit of these: value = input - shapes @ removed. ``covariance`` (n, n)
    belongs to the input, None for independent nodes.
    """

    position_mm: FloatArray
    value: FloatArray
    u: FloatArray
    rows: tuple[Row, ...]
    shapes: FloatArray
    removed: FloatArray
    covariance: FloatArray | None = None

    @property
    def functional(self) -> FloatArray:
        """The functionals as a matrix (k, n)."""
        matrix = np.zeros((len(self.rows), len(self.value)))
        for k, row in enumerate(self.rows):
            for node, factor in row:
                matrix[k, node] += factor
        return matrix

    @property
    def zeroing(self) -> FloatArray:
        """Matrix (n, n) that removes from a curve what was removed from this one; identity if nothing was."""
        return np.eye(len(self.value)) - (self.shapes * self.moved) @ self.functional

    @property
    def moved(self) -> FloatArray:
        """1 where something was removed, 0 where the input was already zero, shape (k,)."""
        return (np.abs(self.removed) > NOTHING).astype(np.float64)


def fixed_points_mm(machine: Machine, name: str) -> tuple[float, ...]:
    """Axis positions at which a curve is zero: both travel ends for straightness, else the reference point."""
    error = error_named(name)
    return machine.axes[error.axis].range_mm if error.is_straightness else (machine.reference_point_mm[error.axis],)


def interpolation_row(position_mm: FloatArray, at_mm: float) -> Row:
    """Functional for a curve's value at a position: one node, or the two around it; outside, the end node."""
    nearest = int(np.argmin(np.abs(position_mm - at_mm)))
    outside = at_mm < position_mm[0] or at_mm > position_mm[-1]
    if outside or abs(position_mm[nearest] - at_mm) <= SAME_POSITION_MM:
        return ((nearest, 1.0),)
    left = int(np.searchsorted(position_mm, at_mm)) - 1
    share = float((at_mm - position_mm[left]) / (position_mm[left + 1] - position_mm[left]))
    return ((left, 1.0 - share), (left + 1, share))


def apply_row(row: Row, values: FloatArray) -> float:
    """Value of a functional."""
    return float(sum(factor * values[node] for node, factor in row))


def fix_to_zero(machine: Machine, name: str, given: Curve, covariance: FloatArray | None = None) -> FixedCurve:
    """Zero one curve at its fixed points, in mm or rad; InputError for values that are not finite.

    ``covariance`` (n, n) of the given nodes replaces their uncertainties.
    """
    if not (np.isfinite(given.value).all() and np.isfinite(given.position_mm).all()):
        raise InputError(
            Message("node-not-finite", "contains a value or position that is not finite; remove that node"), field=name
        )
    if np.any(given.u < 0) or np.any(np.isinf(given.u)):
        raise InputError(
            Message("node-u-negative", "has a negative or infinite uncertainty; give a number >= 0 or leave it empty"),
            field=name,
        )
    curve, axis = given, error_named(name).axis
    low, high = machine.axes[axis].range_mm
    before, after = given.position_mm[0] > low + SAME_POSITION_MM, given.position_mm[-1] < high - SAME_POSITION_MM
    if before or after:  # add nodes with the end values at travel ends that the curve does not reach
        warnings.warn(
            Message(
                "curve-beyond-known",
                "{name} is known from {position_mm:g} to {position_mm2:g} mm, but {value} travels "
                "from {low:g} to {high:g} mm; beyond that nothing was measured: its end values stand "
                "there, and only U of the verification says how far they may be wrong",
                name=name,
                position_mm=given.position_mm[0],
                position_mm2=given.position_mm[-1],
                value=AXES[axis],
                low=low,
                high=high,
            ),
            CompgenWarning,
            stacklevel=4,
        )
        pad = (int(before), int(after))
        nodes_mm = np.concatenate([[low] * pad[0], given.position_mm, [high] * pad[1]])
        curve = Curve(nodes_mm, np.pad(given.value, pad, "edge"), np.pad(given.u, pad, "edge"))
    position = curve.position_mm
    rows = tuple(interpolation_row(position, at) for at in fixed_points_mm(machine, name))
    removed = np.array([apply_row(row, curve.value) for row in rows])
    shapes = np.stack([constant + slope * position for constant, slope in end_lines(position, rows)], axis=1)
    value = curve.value - shapes @ removed
    for row in rows:
        if len(row) == 1:
            value[row[0][0]] = 0.0
    if covariance is not None:
        at = np.abs(position[:, None] - given.position_mm).argmin(axis=1)  # added nodes repeat the ends
        covariance = covariance[np.ix_(at, at)]
    return FixedCurve(position, value, curve.u, rows, shapes, removed, covariance)


def end_lines(position_mm: FloatArray, rows: tuple[Row, ...]) -> list[tuple[float, float]]:
    """(constant, slope) of the lines that are 1 at one fixed point and 0 at the other; constant 1 for one point."""
    at = [apply_row(row, position_mm) for row in rows]
    if len(at) == 1:
        return [(1.0, 0.0)]
    span = at[1] - at[0]
    return [(at[1] / span, -1 / span), (-at[0] / span, 1 / span)]


# What zeroing removes from the curves, as squareness and a rigid placement of the workpiece.
#
# Straightness is zero at both ends of the travel, positioning and angular errors at the reference point. The curve's
# values there are removed: a line from a straightness, a constant from the others. Through C, these are an affine field
# of the commanded position p,
#
#     F(p) = f + M p
#
# (a constant angle eps acts as eps x lever, and its lever is linear in p). M never has a diagonal: straightness acts
# across its axis, eps x lever across the lever. Its six other entries are spanned by the three squareness errors and
# the three rotations of the workpiece frame, so F is exactly
#
#     F(p) = squareness(p) + translation + rotation x p
#
# and the squareness of the table absorbs its part; the rest is a rigid placement of the workpiece (Zha & Zhang 2024,
# section 5, constraints of eq. 25; ``docs/conventions.md``, "Rigid motion").


@dataclass(frozen=True)
class FrameChange:
    """Motion removed from the curves by zeroing: E(input) = E(zeroed) + translation + rotation x position.

    ``position`` is the commanded one; the tool offset of the machine is part of ``translation_mm``. ``squareness`` is
    what was added to each squareness error, in rad. ``tool_rotation_rad`` is the sum of the constant angles removed:
    for a tool that differs by d from the machine's offset, E(input) - E(zeroed) has an additional constant,
    tool_rotation x d (a rigid motion of all tool tips together would have rotation x d).
    """

    translation_mm: tuple[float, float, float]
    rotation_rad: tuple[float, float, float]
    tool_rotation_rad: tuple[float, float, float]
    squareness: Mapping[str, float]

    def field(self, position_mm: FloatArray) -> FloatArray:
        """Rigid displacement at commanded positions (n, 3): shape (n, 3), mm."""
        return np.array(self.translation_mm) + np.cross(np.array(self.rotation_rad), position_mm)

    def to_dict(self) -> dict[str, object]:
        """Return plain numbers in um and urad for JSON."""
        return {
            "translation_um": [1e3 * value for value in self.translation_mm],
            "rotation_urad": [1e6 * value for value in self.rotation_rad],
            "tool_rotation_urad": [1e6 * value for value in self.tool_rotation_rad],
            "squareness_urad": {name: 1e6 * value for name, value in self.squareness.items()},
        }


def _unit_field(machine: Machine, name: str) -> FloatArray:
    """Field (3, 4) of one error with the constant value 1: columns f and M of F(p) = f + M p."""
    field = np.zeros((3, 4))
    for term in coefficients(machine.chain, machine.squareness_reference):
        if term.error == name:
            if term.lever is None:
                field[term.output, 0] += term.sign
            elif term.lever < 3:
                field[term.output, 1 + term.lever] += term.sign
            else:
                field[term.output, 0] += term.sign * machine.tool_offset_mm[term.lever - 3]
    return field


def removed_fields(machine: Machine, name: str, fixed: FixedCurve) -> list[FloatArray]:
    """Fields (3, 4) that each unit of ``fixed.removed`` removes from E."""
    error = error_named(name)
    along = np.zeros((3, 4))
    along[error.direction, 1 + error.axis] = 1.0  # only straightness loses a slope, and its entry in C is 1
    lines = end_lines(fixed.position_mm, fixed.rows)
    return [constant * _unit_field(machine, name) + slope * along for constant, slope in lines]


def target_basis(machine: Machine) -> FloatArray:
    """Columns (12, 9): fields of three squareness errors, three rotations and three translations, each with value 1."""
    columns = [_unit_field(machine, name) for name in SQUARENESS_NAMES]
    for axis in range(3):
        turn = np.zeros((3, 4))
        turn[:, 1:] = np.cross(np.eye(3)[axis], np.eye(3)).T
        columns.append(turn)
    for axis in range(3):
        shift = np.zeros((3, 4))
        shift[axis, 0] = 1.0
        columns.append(shift)
    return np.stack([column.ravel() for column in columns], axis=1)


def decompose(machine: Machine, curves: Mapping[str, FixedCurve]) -> tuple[FrameChange, dict[str, float]]:
    """Split the field removed from the curves into squareness and rigid motion; also the variance squareness gains."""
    basis = target_basis(machine)
    inverse = np.linalg.pinv(basis)
    total, variance, turn = np.zeros(9), np.zeros(9), np.zeros(3)
    for name, fixed in curves.items():
        if error_named(name).kind == "angular":
            turn[error_named(name).direction] += fixed.removed[0]
        shares = []
        for field, removed in zip(removed_fields(machine, name, fixed), fixed.removed, strict=True):
            parts = inverse @ field.ravel()
            if np.abs(basis @ parts - field.ravel()).max() > 1e-9 * np.abs(field).max():
                raise InputError(
                    Message(
                        "field-not-absorbed", "leaves a field that neither squareness nor a rigid motion can absorb"
                    ),
                    field=name,
                )
            parts[np.abs(parts) < 1e-13 * np.abs(parts).max()] = 0.0
            total += parts * removed
            shares.append(parts * (abs(removed) > NOTHING))
        gains = np.array(shares).T @ fixed.functional
        if fixed.covariance is not None:
            variance += np.einsum("ij,jk,ik->i", gains, fixed.covariance, gains)
        else:  # an unknown u counts only where it contributes
            variance += np.where(gains != 0, gains**2 * fixed.u**2, 0.0).sum(axis=1)
    change = FrameChange(
        translation_mm=(float(total[6]), float(total[7]), float(total[8])),
        rotation_rad=(float(total[3]), float(total[4]), float(total[5])),
        tool_rotation_rad=(float(turn[0]), float(turn[1]), float(turn[2])),
        squareness=dict(zip(SQUARENESS_NAMES, total[:3].tolist(), strict=True)),
    )
    return change, dict(zip(SQUARENESS_NAMES, variance[:3].tolist(), strict=True))


# How the curves of a table are zeroed at their fixed points without changing the machine.


#: An absent squareness error stays absent if less than this would be added, in rad.
_ROUNDING = 1e-15


@dataclass(frozen=True)
class Zeroed:
    """An error table with every curve zero at its fixed points, and the motion this removed."""

    curves: Mapping[str, FixedCurve]
    squareness: Mapping[str, tuple[float, float]]
    change: FrameChange

    def table(self, metadata: Mapping[str, str] | None = None) -> ErrorTable:
        """Return the zeroed curves (with the uncertainty of the input) as an error table."""
        curves = {name: Curve(fixed.position_mm, fixed.value, fixed.u) for name, fixed in self.curves.items()}
        return ErrorTable(curves, self.squareness, metadata or {})


def zero_ends(machine: Machine, errors: ErrorTable, covariance: Mapping[str, FloatArray] | None = None) -> Zeroed:
    """Zero every curve at its fixed points; E stays the same over the travel up to a rigid motion.

    Of errors whose squareness was measured apart, the lines and constants are those of the instruments: they are removed.

    Parameters
    ----------
    machine : its travel, reference point, chain, tool offset and squareness reference are used.
    errors : curves that end within the travel are extended to its ends with their end values, with a warning.
    covariance : covariance (n, n) of the nodes by error name, mm and rad; other curves have independent nodes.

    Raises
    ------
    InputError
        for a value that is not finite, or if a squareness error that has to absorb a part is not in the machine's
        model.
    """
    known, apart = covariance or {}, is_apart(errors)
    errors = about_own_lines(errors)[0] if apart else errors
    curves = {name: fix_to_zero(machine, name, curve, known.get(name)) for name, curve in errors.curves.items()}
    change, variance = decompose(machine, curves)
    kept = {*modelled_errors(machine), *errors.squareness}
    for name, value in change.squareness.items():
        if name not in kept and abs(value) > NOTHING and not apart:
            raise _no_room(machine, name, value, curves)
    # the table may distinguish tools of different offset, and the removed motion differs between them
    one_tool = observable_errors(machine)
    told_apart = [name for name in curves if name not in one_tool]
    if told_apart and np.abs(np.subtract(change.tool_rotation_rad, change.rotation_rad)).max() > NOTHING:
        warnings.warn(
            Message(
                "rotation-removed-tools",
                "a rotation is removed from the curves; E stays the same for the machine's tool "
                "offset {tool_offset_mm} mm and changes by a constant for the other tools that "
                "{told_apart} refer to",
                tool_offset_mm=machine.tool_offset_mm,
                told_apart=", ".join(told_apart),
            ),
            CompgenWarning,
            stacklevel=3,
        )
    squareness = dict(errors.squareness)
    for name in () if apart else SQUARENESS_NAMES:
        if name in squareness or abs(change.squareness[name]) > _ROUNDING:
            value, u = errors.squareness.get(name, (0.0, np.nan))
            squareness[name] = (value + change.squareness[name], float(np.sqrt(u**2 + variance[name])))
    return Zeroed(curves, squareness, change)


def _no_room(machine: Machine, name: str, value: float, curves: Mapping[str, FixedCurve]) -> InputError:
    column = SQUARENESS_NAMES.index(name)
    inverse = np.linalg.pinv(target_basis(machine))
    sources = [
        source
        for source, fixed in curves.items()
        if any(
            abs(removed * (inverse @ field.ravel())[column]) > NOTHING
            for field, removed in zip(removed_fields(machine, source, fixed), fixed.removed, strict=True)
        )
    ]
    sources.sort(key=ERROR_NAMES.index)
    return InputError(
        Message(
            "line-into-squareness",
            "the end-to-end line or constant of {sources} is {value:.3f} urad of {name}, which "
            "the machine's model leaves out; add {name2} to its errors, or give curves that are "
            "zero at their ends",
            sources=", ".join(sources),
            value=1000000.0 * value,
            name=name,
            name2=name,
        ),
        file=machine.source,
        field="errors",
    )
