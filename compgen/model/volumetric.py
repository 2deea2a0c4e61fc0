"""First-order volumetric model E = C P of Zha & Zhang 2024, eq. 9 and 10, for any chain (``docs/conventions.md``).

Every entry of C is a sum of monomials of degree at most one in the axis coordinates and the tool offset, so C is
kept as a list of :class:`Coefficient` and evaluated from it; tables, fits and emulators use the same list.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Chain, Machine, Reference
from compgen.core.names import ERROR_INDEX, ERRORS


@dataclass(frozen=True)
class Coefficient:
    """One monomial of one entry of C: ``sign`` times ``factor``, in row ``output`` and column ``error``.

    ``lever`` is None for the factor 1, 0..2 for the coordinate of that axis in mm, 3..5 for the tool offset x, y, z.
    """

    error: str
    output: int
    sign: int
    lever: int | None


def _cross(direction: int, lever: int) -> tuple[int, int]:
    """Row and sign of e_direction x e_lever (two different axes)."""
    output = 3 - direction - lever
    return output, 1 if (direction + 1) % 3 == lever else -1


@cache
def coefficients(chain: Chain, squareness_reference: Reference = "X") -> tuple[Coefficient, ...]:
    """Return C as a sparse list: E = sum of delta_i + eps_i x lever_i + squareness, for the given chain."""
    terms: list[Coefficient] = []
    for error in ERRORS:
        if error.kind == "linear":
            terms.append(Coefficient(error.name, error.direction, 1, None))
        elif error.kind == "angular":
            travel = chain.lever_axes(error.axis)
            for component in range(3):
                if component != error.direction:
                    output, sign = _cross(error.direction, component)
                    if component in travel:
                        terms.append(Coefficient(error.name, output, sign, component))
                    terms.append(Coefficient(error.name, output, sign, 3 + component))
        elif error.name == "EC0Y" and squareness_reference == "Y":
            terms.append(Coefficient(error.name, 1, -1, 0))  # dY = -X EC0Y: Y is the reference direction
        else:
            output, sign = _cross(error.direction, error.axis)
            terms.append(Coefficient(error.name, output, sign, error.axis))
    return tuple(terms)


def factor(lever: int | None, position_mm: FloatArray, tool_mm: FloatArray) -> FloatArray:
    """Value of a :class:`Coefficient`'s factor at points (n, 3) with tool offsets (n, 3) or (3,): shape (n,)."""
    if lever is None:
        return np.ones(len(position_mm))
    if lever < 3:
        return position_mm[:, lever]
    return np.broadcast_to(tool_mm, position_mm.shape)[:, lever - 3]


def tool_of(machine: Machine, tool_mm: FloatArray | None) -> FloatArray:
    """Return the tool offset to use: the given one, else the machine's, shape (3,) or (n, 3)."""
    return np.asarray(machine.tool_offset_mm if tool_mm is None else tool_mm, dtype=np.float64)


def c_matrix(machine: Machine, position_mm: FloatArray, tool_mm: FloatArray | None = None) -> FloatArray:
    """Matrix C of E = C P at commanded positions.

    Parameters
    ----------
    machine : chain, tool offset and squareness reference are taken from it.
    position_mm : axis coordinates, shape (n, 3).
    tool_mm : tool offsets, shape (3,) or (n, 3), default the machine's.

    Returns
    -------
    array of shape (n, 3, 21), columns in the order of :data:`compgen.core.names.ERROR_NAMES`; mm per mm or mm per rad.
    """
    position_mm = np.asarray(position_mm, dtype=np.float64)
    tool = tool_of(machine, tool_mm)
    matrix = np.zeros((len(position_mm), 3, len(ERRORS)))
    for term in coefficients(machine.chain, machine.squareness_reference):
        matrix[:, term.output, ERROR_INDEX[term.error]] += term.sign * factor(term.lever, position_mm, tool)
    return matrix


def volumetric_error(
    machine: Machine, errors: ErrorTable, position_mm: FloatArray, tool_mm: FloatArray | None = None
) -> FloatArray:
    """Error E = C P of the tool tip against the workpiece at commanded positions (n, 3): shape (n, 3), mm."""
    from compgen.model.evaluate import volumetric_error_at  # imported here: it builds on the list of terms above

    return volumetric_error_at(machine, errors, position_mm, tool_mm)
