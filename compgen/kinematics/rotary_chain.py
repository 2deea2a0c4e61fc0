"""The exact chain with rotary axes: one factor for each joint, linear or rotary (``docs/five-axis.md``).

A point passes the bodies from the tool to the workpiece as in :mod:`compgen.kinematics.exact_chain`. A rotary axis with
direction u through the point p, error motions D at its angle and position errors L adds

* tool side, from the tool to the foundation:   x -> p + L D R(u, theta) (x - p)
* workpiece side, from the foundation outwards: x -> p + R(u, theta) D L (x - p)

where D and L are x -> d + R(e) x in axes turned by the smallest rotation that takes x, y or z to u. The second line is the
inverse of Trans(p) L^-1 D^-1 R(u, -theta) Trans(-p): each factor of the pose inverted, in the same order, as for linear
axes. So a positive error always means: the tool moved too far in that direction relative to the workpiece.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.machine import OPPOSITE, ROTARY, Machine
from compgen.data.names import AXES, ERROR_NAMES
from compgen.data.rotary import RotaryErrors
from compgen.errors import InputError, Message
from compgen.kinematics.exact_chain import cross_matrices, level_rotations, rotate, travel_vectors


@cache
def _own_axes(letter: str, direction: tuple[float, float, float]) -> FloatArray:
    """Smallest rotation (3, 3) that takes x, y or z of the letter to the direction of the axis."""
    along, u = np.eye(3)[ROTARY.index(letter)], np.array(direction)
    cosine = float(along @ u)
    if cosine < -OPPOSITE:
        raise InputError(
            Message(
                "rotary-direction-opposite",
                "direction of {letter} is opposite to its axis; reverse the sign of its angles",
                letter=letter,
            ),
            field="direction",
        )
    matrix = cross_matrices(np.cross(along, u)[None])[0]
    return np.asarray(np.eye(3) + matrix + matrix @ matrix / (1.0 + cosine))


def tip_pose(
    machine: Machine,
    errors: ErrorTable,
    rotary: RotaryErrors,
    position_mm: FloatArray,
    angle_deg: Mapping[str, FloatArray],
    tool_mm: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Actual tip (n, 3) in the workpiece frame, mm, and orientation (n, 3, 3) of the tool in it.

    Parameters
    ----------
    errors, rotary : errors of the linear and of the rotary axes.
    position_mm, angle_deg : commanded positions (n, 3), and angles (n,) of every rotary axis by letter.
    tool_mm : offset of the tip, (3,) or (n, 3); None: that of the machine file.
    """
    return pose_of_values(machine, errors.at(position_mm), rotary, position_mm, angle_deg, tool_mm)


def pose_of_values(
    machine: Machine,
    values: FloatArray,
    rotary: RotaryErrors,
    position_mm: FloatArray,
    angle_deg: Mapping[str, FloatArray],
    tool_mm: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """As :func:`tip_pose`, for the 21 errors of the linear axes ``values`` (n, 21) at the positions."""
    count = len(position_mm)
    travel = travel_vectors(machine, values, position_mm)
    motions = rotary.motions(machine, angle_deg)
    tip = np.array(np.broadcast_to(machine.tool_offset_mm if tool_mm is None else tool_mm, (count, 3)), dtype=float)
    tip = tip + rotary.spindle_mm
    turned = np.tile(np.eye(3), (count, 1, 1))
    for letter, tool_side in machine.chain.passed:
        if letter in AXES:
            axis = AXES.index(letter)
            delta, eps = values[:, 6 * axis : 6 * axis + 3], values[:, 6 * axis + 3 : 6 * axis + 6]
            tip = travel[axis] + delta + rotate(eps, tip) if tool_side else rotate(eps, tip + travel[axis] + delta)
            turned = rotate(eps, turned)
            continue
        own = machine.rotary[letter]
        basis, point = _own_axes(letter, own.direction), np.array(own.point_mm)
        turn = np.radians(angle_deg[letter])[:, None] * np.array(own.direction)
        small = [
            (part[:, :3] @ basis.T, part[:, 3:] @ basis.T)
            for part in (motions[letter], np.tile(rotary.position(letter), (count, 1)))
        ]
        steps = [(None, turn), *small] if tool_side else [*small[::-1], (None, turn)]
        tip = tip - point
        for shift, rotation in steps:
            tip = _large(rotation, tip) + (0.0 if shift is None else shift)
            turned = _large(rotation, turned)
        tip = tip + point
    return tip, turned


#: Steps of the difference quotients by errors: mm, rad.
_STEP_MM, _STEP_RAD = 1e-3, 1e-6


def linear_columns(
    machine: Machine,
    position_mm: FloatArray,
    angle_deg: Mapping[str, FloatArray],
    tool_mm: FloatArray | None = None,
    rotary: RotaryErrors | None = None,
) -> FloatArray:
    """C with six rows: derivative of tip and orientation (n, 6) by the 21 errors of the linear axes, (n, 6, 21).

    Central differences of the exact chain at zero errors of the linear axes, mm and rad: tip in the workpiece frame, which turns
    with the table. ``rotary`` are errors of the rotary axes; None: none.
    """
    count, rotary = len(position_mm), RotaryErrors() if rotary is None else rotary
    straight = pose_of_values(machine, np.zeros((count, 21)), rotary, position_mm, angle_deg, tool_mm)[1]
    columns = np.zeros((count, 6, len(ERROR_NAMES)))
    for k, name in enumerate(ERROR_NAMES):
        step = _STEP_MM if name[1] in AXES else _STEP_RAD
        values, ends = np.zeros((count, 21)), []
        for sign in (1.0, -1.0):
            values[:, k] = sign * step
            tip, turned = pose_of_values(machine, values, rotary, position_mm, angle_deg, tool_mm)
            ends.append(np.hstack([tip, rotation_between(turned, straight)]))
        columns[:, :, k] = (ends[0] - ends[1]) / (2.0 * step)
    return columns


def _large(rotation: FloatArray, vectors: FloatArray) -> FloatArray:
    """Turn vectors (n, 3), or columns (n, 3, k), by rotation vectors (n, 3) of any size."""
    matrices = level_rotations(rotation)[0]
    return np.asarray(np.einsum("nij,nj...->ni...", matrices, vectors))


def pose_error(
    machine: Machine,
    errors: ErrorTable,
    rotary: RotaryErrors,
    position_mm: FloatArray,
    angle_deg: Mapping[str, FloatArray],
    tool_mm: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Error of the tip (n, 3) in the workpiece frame, mm, and of the orientation of the tool (n, 3) in it, rad."""
    tip, turned = tip_pose(machine, errors, rotary, position_mm, angle_deg, tool_mm)
    nominal, straight = tip_pose(machine, ErrorTable(), RotaryErrors(), position_mm, angle_deg, tool_mm)
    return tip - nominal, rotation_between(turned, straight)


def rotation_between(turned: FloatArray, straight: FloatArray) -> FloatArray:
    """Small rotations (n, 3), rad, that take orientations ``straight`` (n, 3, 3) to ``turned``: the antisymmetric part."""
    between = np.einsum("nij,nkj->nik", turned, straight)
    return np.asarray(0.5 * np.einsum("nij,kij->nk", between, cross_matrices(np.eye(3))))


def joints_of_tip(
    machine: Machine, tip_mm: FloatArray, angle_deg: Mapping[str, FloatArray], tool_mm: FloatArray
) -> FloatArray:
    """Positions of X, Y, Z (n, 3) at which the nominal machine has its tip at ``tip_mm`` (n, 3) of the workpiece frame."""
    count = len(tip_mm)

    def tip(position: FloatArray) -> FloatArray:
        where = np.tile(position, (count, 1))
        return tip_pose(machine, ErrorTable(), RotaryErrors(), where, angle_deg, tool_mm)[0]

    zero = tip(np.zeros(3))
    columns = np.stack([tip(unit) - zero for unit in np.eye(3)], axis=2)
    return np.asarray(np.linalg.solve(columns, (tip_mm - zero)[:, :, None])[:, :, 0])
