"""Curves that are zero where they have to be: straightness at both travel ends, the others at the reference point."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve
from compgen.core.machine import Machine
from compgen.core.names import AXES, error_named
from compgen.errors import CompgenWarning, InputError

#: A node counts as standing at a position that is nearer than this (file positions have six decimals).
SAME_POSITION_MM = 1e-6
#: Values below this (mm or rad) are rounding, not something that was moved.
NOTHING = 1e-12

#: A linear functional of the node values: (node, factor) pairs.
Row = tuple[tuple[int, float], ...]


@dataclass(frozen=True)
class HeldCurve:
    """A curve that is zero where it has to be, with the functionals that must stay zero.

    ``position_mm``, ``value``, ``u`` have shape (n,), in mm or rad; ``u`` is the uncertainty of the input.
    ``rows`` are the k functionals (zero for ``value``); ``removed`` (k,) is what they gave before and ``shapes`` (n, k)
    the curves that were taken out per unit of it: value = input - shapes @ removed. ``covariance`` (n, n) is that of the
    input, None for independent nodes.
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
        """Matrix (n, n) that takes out of a curve what was taken out of this one; 1 where nothing was."""
        return np.eye(len(self.value)) - (self.shapes * self.moved) @ self.functional

    @property
    def moved(self) -> FloatArray:
        """1 where something was taken out, 0 where the input was zero already, shape (k,)."""
        return (np.abs(self.removed) > NOTHING).astype(np.float64)


def held_points_mm(machine: Machine, name: str) -> tuple[float, ...]:
    """Axis positions at which a curve is zero: both travel ends for a straightness, else the reference point."""
    error = error_named(name)
    return machine.axes[error.axis].range_mm if error.is_straightness else (machine.reference_point_mm[error.axis],)


def interpolation_row(position_mm: FloatArray, at_mm: float) -> Row:
    """Functional that gives a curve's value at a position: one node, or the two around it; the end node outside."""
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


def _extend(machine: Machine, name: str, curve: Curve) -> Curve:
    """Return the curve with nodes at the travel ends that it does not reach, at its own end values."""
    axis = error_named(name).axis
    low, high = machine.axes[axis].range_mm
    before, after = curve.position_mm[0] > low + SAME_POSITION_MM, curve.position_mm[-1] < high - SAME_POSITION_MM
    if not (before or after):
        return curve
    warnings.warn(
        f"{name} is known from {curve.position_mm[0]:g} to {curve.position_mm[-1]:g} mm, but {AXES[axis]} travels from "
        f"{low:g} to {high:g} mm; its end values are used beyond",
        CompgenWarning,
        stacklevel=5,
    )
    pad = (int(before), int(after))
    position = np.concatenate([[low] * pad[0], curve.position_mm, [high] * pad[1]])
    return Curve(position, np.pad(curve.value, pad, "edge"), np.pad(curve.u, pad, "edge"))


def hold(machine: Machine, name: str, given: Curve, covariance: FloatArray | None = None) -> HeldCurve:
    """Bring one curve to zero at its held points, in mm or rad; InputError for values that are not finite.

    ``covariance`` (n, n) of the given nodes takes the place of their uncertainties.
    """
    if not (np.isfinite(given.value).all() and np.isfinite(given.position_mm).all()):
        raise InputError("holds a value or position that is not finite; remove that node", field=name)
    if np.any(given.u < 0) or np.any(np.isinf(given.u)):
        raise InputError("has a negative or infinite uncertainty; give a number >= 0 or leave it empty", field=name)
    curve = _extend(machine, name, given)
    position = curve.position_mm
    rows = tuple(interpolation_row(position, at) for at in held_points_mm(machine, name))
    removed = np.array([apply_row(row, curve.value) for row in rows])
    shapes = np.stack([constant + slope * position for constant, slope in end_lines(position, rows)], axis=1)
    value = curve.value - shapes @ removed
    for row in rows:
        if len(row) == 1:
            value[row[0][0]] = 0.0
    if covariance is not None:
        at = np.abs(position[:, None] - given.position_mm).argmin(axis=1)  # nodes that were added repeat the ends
        covariance = covariance[np.ix_(at, at)]
    return HeldCurve(position, value, curve.u, rows, shapes, removed, covariance)


def end_lines(position_mm: FloatArray, rows: tuple[Row, ...]) -> list[tuple[float, float]]:
    """(constant, slope) of the line that is 1 at one held point and 0 at the other; the constant 1 for one point."""
    at = [apply_row(row, position_mm) for row in rows]
    if len(at) == 1:
        return [(1.0, 0.0)]
    span = at[1] - at[0]
    return [(at[1] / span, -1 / span), (-at[0] / span, 1 / span)]
