"""How a table is brought to zero where its curves have to be, without changing the machine (see ``frame.py``)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import ERROR_NAMES, SQUARENESS_NAMES
from compgen.errors import CompgenWarning, InputError
from compgen.fit.frame import FrameChange, decompose, removed_fields, target_basis
from compgen.fit.held import NOTHING, HeldCurve, hold
from compgen.model import modelled_errors, observable_errors

#: A squareness error that is absent stays so for less than this, in rad.
_ROUNDING = 1e-15


@dataclass(frozen=True)
class Zeroed:
    """An error table with every curve zero where it has to be, and what that moved."""

    curves: Mapping[str, HeldCurve]
    squareness: Mapping[str, tuple[float, float]]
    change: FrameChange

    def table(self, metadata: Mapping[str, str] | None = None) -> ErrorTable:
        """Return the zeroed curves (with the uncertainty of the input) as an error table."""
        curves = {name: Curve(held.position_mm, held.value, held.u) for name, held in self.curves.items()}
        return ErrorTable(curves, self.squareness, metadata or {})


def zero_ends(machine: Machine, errors: ErrorTable, covariance: Mapping[str, FloatArray] | None = None) -> Zeroed:
    """Bring every curve to zero where it has to be; E stays the same over the travel up to a rigid motion.

    Parameters
    ----------
    machine : its travel, reference point, chain, tool offset and squareness reference count.
    errors : curves that end within the travel are extended to its ends by their end values, with a warning.
    covariance : covariance (n, n) of the nodes by error name, mm and rad; other curves have independent nodes.

    Raises
    ------
    InputError
        for a value that is not finite, or when a squareness error that has to take up a part is not in the
        machine's model.
    """
    known = covariance or {}
    curves = {name: hold(machine, name, curve, known.get(name)) for name, curve in errors.curves.items()}
    change, variance = decompose(machine, curves)
    kept = {*modelled_errors(machine), *errors.squareness}
    for name, value in change.squareness.items():
        if name not in kept and abs(value) > NOTHING:
            raise _no_room(machine, name, value, curves)
    _warn_tools(machine, curves, change)
    squareness = dict(errors.squareness)
    for name in SQUARENESS_NAMES:
        if name in squareness or abs(change.squareness[name]) > _ROUNDING:
            value, u = errors.squareness.get(name, (0.0, np.nan))
            squareness[name] = (value + change.squareness[name], float(np.sqrt(u**2 + variance[name])))
    return Zeroed(curves, squareness, change)


def _no_room(machine: Machine, name: str, value: float, curves: Mapping[str, HeldCurve]) -> InputError:
    column = SQUARENESS_NAMES.index(name)
    inverse = np.linalg.pinv(target_basis(machine))
    sources = [
        source
        for source, held in curves.items()
        if any(
            abs(removed * (inverse @ field.ravel())[column]) > NOTHING
            for field, removed in zip(removed_fields(machine, source, held), held.removed, strict=True)
        )
    ]
    sources.sort(key=ERROR_NAMES.index)
    return InputError(
        f"the end-to-end line or constant of {', '.join(sources)} is {1e6 * value:.3f} urad of {name}, which the "
        f"machine's model leaves out; add {name} to its errors, or give curves that are zero at their ends",
        file=machine.source,
        field="errors",
    )


def _warn_tools(machine: Machine, curves: Mapping[str, HeldCurve], change: FrameChange) -> None:
    """Warn when the table tells tools of different offset apart, and what is taken out is not the same for them."""
    one_tool = observable_errors(machine)
    told_apart = [name for name in curves if name not in one_tool]
    turn = np.abs(np.subtract(change.tool_rotation_rad, change.rotation_rad))
    if told_apart and turn.max() > NOTHING:
        warnings.warn(
            f"a rotation is taken out of the curves; E stays the same for the machine's tool offset "
            f"{machine.tool_offset_mm} mm and changes by a constant for the other tools that "
            f"{', '.join(told_apart)} speak of",
            CompgenWarning,
            stacklevel=4,
        )
