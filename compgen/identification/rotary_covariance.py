"""Uncertainty of errors of rotary axes, and what it does to tip and orientation at poses."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.files import read_text
from compgen.data.machine import Machine
from compgen.data.names import AXES, SQUARENESS_NAMES
from compgen.data.rotary import Poses, RotaryErrors, si_per_unit
from compgen.errors import InputError, Message
from compgen.identification.covariance import Covariance, covariance_named_by
from compgen.identification.rotary_linear import LinearState
from compgen.kinematics.rotary_chain import linear_columns, pose_error

#: Names of constants and their covariance, mm and rad.
Known = tuple[tuple[str, ...], FloatArray]
_STEP_MM, _STEP_RAD = 1e-3, 1e-6


def constant_covariance(errors: Path, rotary: RotaryErrors) -> Known | None:
    """Covariance of the constants: of the identification beside the file if it is that of its errors, else from ``u_value``.

    None if an uncertainty is not stated.
    """
    found, names = errors.parent / "identify.json", tuple(rotary.constants)
    try:
        data = json.loads(read_text(found)) if found.is_file() else {}
    except ValueError:
        data = {}
    stated = data.get("errors", {}) if isinstance(data, dict) else {}
    units = np.array([si_per_unit(name) for name in names])
    if names and isinstance(stated, dict) and set(names) <= set(stated) and data.get("kind") == "sphere":
        pairs = zip(names, units, strict=True)
        if all(abs(stated[name]["value"] * unit - rotary.constants[name][0]) < 1e-5 * unit for name, unit in pairs):
            order = [list(stated).index(name) for name in names]
            return names, np.array(data["covariance"])[np.ix_(order, order)] * np.outer(units, units)
    u = np.array([rotary.constants[name][1] for name in names])
    return None if np.isnan(u).any() or not len(u) else (names, np.diag(u**2))


def known_covariance(errors: Path, rotary: RotaryErrors) -> Known:
    """As :func:`constant_covariance`; InputError if an uncertainty is not stated."""
    unknown = [name for name, curve in rotary.curves.items() if np.isnan(curve.u).any()]
    found = constant_covariance(errors, rotary)
    if (found is None and rotary.constants) or unknown:
        names = ", ".join(unknown or [name for name, (_, u) in rotary.constants.items() if np.isnan(u)])
        raise InputError(
            Message(
                "no-u-value", "states no uncertainty of {names}: --uncertainty needs u_value of each error", names=names
            ),
            file=errors,
        )
    return ((), np.zeros((0, 0))) if found is None else found


def joint_beside(errors: Path, table: ErrorTable, rotary: RotaryErrors) -> Covariance | None:
    """The covariance file of errors of linear and rotary axes that were adjusted together; None if there is none."""
    if "covariance" not in table.metadata:
        return None
    found = covariance_named_by(errors, table)
    if (
        found is None
        or found.rotary is None
        or found.posterior is None
        or set(found.rotary[0]) != set(rotary.constants)
    ):
        return None
    return found


def pose_uncertainty(
    machine: Machine, table: ErrorTable, rotary: RotaryErrors, poses: Poses, known: Known | Covariance
) -> tuple[FloatArray, FloatArray]:
    """Standard uncertainties of tip (n, 3), mm, and orientation (n, 3), rad: of constants, nodes of curves, squareness.

    Constants have their joint covariance, or that of everything (:func:`joint_beside`); nodes of curves of rotary axes, and
    errors of linear axes without a joint covariance, count as independent where their uncertainty is stated.
    """
    base = _flat(machine, table, rotary, poses)
    variance = np.zeros_like(base)
    if isinstance(known, Covariance):
        spread = _joint_spread(machine, table, rotary, poses, known)
        variance += np.einsum("ij,ij->i", spread, spread)
    elif known[0]:
        names, covariance = known
        columns = [_by_constant(machine, table, rotary, poses, name) for name in names]
        variance += np.einsum("ij,jk,ik->i", np.stack(columns, axis=1), covariance, np.stack(columns, axis=1))
    for changed in _nodes(rotary):
        variance += (_flat(machine, table, changed, poses) - base) ** 2
    for other in () if isinstance(known, Covariance) else _linear(table):
        variance += (_flat(machine, other, rotary, poses) - base) ** 2
    u = np.sqrt(variance).reshape(-1, 6)
    return u[:, :3], u[:, 3:]


def _joint_spread(
    machine: Machine, table: ErrorTable, rotary: RotaryErrors, poses: Poses, joint: Covariance
) -> FloatArray:
    """What is not known of tip and orientation (6 n, r), of linear and rotary axes together, also of what was not measured."""
    if joint.posterior is None or joint.rotary is None:
        raise ValueError("the covariance is not one of linear and rotary axes")
    state = LinearState.of_posterior(machine, joint.posterior.of(machine), poses.position_mm)
    matrix = linear_columns(machine, poses.position_mm, poses.angle_deg, poses.tool_mm)
    spread = state.at(poses.position_mm).design(matrix).reshape(6 * len(matrix), -1)
    names, rows = joint.rotary
    own = np.stack([_by_constant(machine, table, rotary, poses, name) for name in names], axis=1) @ rows
    wide = max(
        own.shape[1], spread.shape[1]
    )  # the first columns are those of the posterior in both, the others of neither
    first = joint.posterior.factor.shape[1]
    total = np.zeros((len(own), wide))
    total[:, : spread.shape[1]] = spread
    total[:, :first] += own[:, :first]
    return total


def _flat(machine: Machine, table: ErrorTable, rotary: RotaryErrors, poses: Poses) -> FloatArray:
    both = pose_error(machine, table, rotary, poses.position_mm, poses.angle_deg, poses.tool_mm)
    return np.hstack(both).ravel()


def _by_constant(machine: Machine, table: ErrorTable, rotary: RotaryErrors, poses: Poses, name: str) -> FloatArray:
    step = _STEP_MM if name[1] in AXES else _STEP_RAD
    value, u = rotary.constants[name]
    ends = [
        _flat(machine, table, replace(rotary, constants={**rotary.constants, name: (value + sign * step, u)}), poses)
        for sign in (1.0, -1.0)
    ]
    return np.asarray((ends[0] - ends[1]) / (2.0 * step))


def _nodes(rotary: RotaryErrors) -> Sequence[RotaryErrors]:
    """The errors with one node of one curve moved by its uncertainty, for each node."""
    found = []
    for name, curve in rotary.curves.items():
        for k in np.flatnonzero(curve.u > 0.0):
            value = curve.value.copy()
            value[k] += curve.u[k]
            found.append(replace(rotary, curves={**rotary.curves, name: replace(curve, value=value)}))
    return found


def _linear(table: ErrorTable) -> Sequence[ErrorTable]:
    """The errors of linear axes with one number moved by its uncertainty, for each that states one."""
    found = []
    for name, (value, u) in table.squareness.items():
        if name in SQUARENESS_NAMES and u > 0.0:
            found.append(replace(table, squareness={**table.squareness, name: (value + u, u)}))
    for name, curve in table.curves.items():
        for k in np.flatnonzero(curve.u > 0.0):
            moved = curve.value.copy()
            moved[k] += curve.u[k]
            found.append(replace(table, curves={**table.curves, name: replace(curve, value=moved)}))
    return found
