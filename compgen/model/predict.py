"""Predicted errors at given points: what ``volcomp predict`` computes."""

from __future__ import annotations

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.points import Points
from compgen.model.exact import exact_error
from compgen.model.volumetric import volumetric_error


def predict(machine: Machine, errors: ErrorTable, points: Points, *, exact: bool = False) -> FloatArray:
    """Return the error of the tool tip at commanded points, shape (n, 3), mm; warns outside the range of the curves.

    Parameters
    ----------
    machine, errors, points : what moves, how wrong, and where to.
    exact : finite rotations along the chain in place of E = C P.
    """
    errors.warn_outside(points.position_mm)
    model = exact_error if exact else volumetric_error
    return model(machine, errors, points.position_mm, points.tool_mm)
