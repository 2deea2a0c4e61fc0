"""What zeroing takes out of the curves, as squareness and a rigid placement of the workpiece.

Straightness is zero at both ends of the travel, positioning and angular errors at the reference point. What a curve
has there is taken out of it: a line of a straightness, a constant of the others. Through C, these are an affine field
of the commanded position p,

    F(p) = f + M p

(a constant angle eps acts as eps x lever, and its lever is linear in p). M never has a diagonal: straightness acts
across its axis, eps x lever across the lever. Its six other entries are spanned by the three squareness errors and
the three rotations of the workpiece frame, so F is exactly

    F(p) = squareness(p) + translation + rotation x p

and the squareness of the table takes up its part; the rest is a rigid placement of the workpiece (Zha & Zhang 2024,
section 5, constraints of eq. 25; ``docs/conventions.md``, "Rigid motion").
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import SQUARENESS_NAMES, error_named
from compgen.errors import InputError
from compgen.fit.held import NOTHING, HeldCurve, end_lines
from compgen.model import coefficients


@dataclass(frozen=True)
class FrameChange:
    """What the zeroing moved out of the curves: E(input) = E(zeroed) + translation + rotation x position.

    ``position`` is the commanded one; the tool offset of the machine is part of ``translation_mm``. ``squareness`` is
    what was added to each squareness error, in rad. ``tool_rotation_rad`` is the sum of the constant angles taken out:
    for a tool that differs by d from the machine's offset, E(input) - E(zeroed) has a further constant
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
    """Field (3, 4) of one error at the constant value 1: columns f and M of F(p) = f + M p."""
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


def removed_fields(machine: Machine, name: str, held: HeldCurve) -> list[FloatArray]:
    """Fields (3, 4) that each unit of ``held.removed`` takes out of E."""
    error = error_named(name)
    along = np.zeros((3, 4))
    along[error.direction, 1 + error.axis] = 1.0  # only straightness loses a slope, and its entry of C is 1
    lines = end_lines(held.position_mm, held.rows)
    return [constant * _unit_field(machine, name) + slope * along for constant, slope in lines]


def target_basis(machine: Machine) -> FloatArray:
    """Columns (12, 9): fields of the three squareness errors, three rotations and three translations at 1."""
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


def _gained(held: HeldCurve, shares: FloatArray) -> FloatArray:
    """Variance (9,) that shares (k, 9) of the held functionals hand on; an unknown u counts only where it has a share."""
    gains = shares.T @ held.functional
    if held.covariance is not None:
        return np.asarray(np.einsum("ij,jk,ik->i", gains, held.covariance, gains))
    return np.asarray(np.where(gains != 0, gains**2 * held.u**2, 0.0).sum(axis=1))


def decompose(machine: Machine, curves: Mapping[str, HeldCurve]) -> tuple[FrameChange, dict[str, float]]:
    """Split the field that the curves lost into squareness and rigid motion; also the variance that squareness gains."""
    basis = target_basis(machine)
    inverse = np.linalg.pinv(basis)
    total, variance, turn = np.zeros(9), np.zeros(9), np.zeros(3)
    for name, held in curves.items():
        if error_named(name).kind == "angular":
            turn[error_named(name).direction] += held.removed[0]
        shares = []
        for field, removed in zip(removed_fields(machine, name, held), held.removed, strict=True):
            parts = inverse @ field.ravel()
            if np.abs(basis @ parts - field.ravel()).max() > 1e-9 * np.abs(field).max():
                raise InputError("leaves a field that neither squareness nor a rigid motion can take up", field=name)
            parts[np.abs(parts) < 1e-13 * np.abs(parts).max()] = 0.0
            total += parts * removed
            shares.append(parts * (abs(removed) > NOTHING))
        variance += _gained(held, np.array(shares))
    change = FrameChange(
        translation_mm=(float(total[6]), float(total[7]), float(total[8])),
        rotation_rad=(float(total[3]), float(total[4]), float(total[5])),
        tool_rotation_rad=(float(turn[0]), float(turn[1]), float(turn[2])),
        squareness=dict(zip(SQUARENESS_NAMES, total[:3].tolist(), strict=True)),
    )
    return change, dict(zip(SQUARENESS_NAMES, variance[:3].tolist(), strict=True))
