"""First-order volumetric model E = C P, and which of the 21 errors are observable."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from compgen.data.arguments import numbers, of_kind, vectors
from compgen.data.csv_files import FloatArray
from compgen.data.machine import Chain, Machine, Reference
from compgen.data.names import ERROR_INDEX, ERROR_NAMES, ERRORS

# First-order volumetric model E = C P of Zha & Zhang 2024, eq. 9 and 10, for any chain (``docs/conventions.md``).
#
# Every entry of C is a sum of monomials of degree at most one in the axis coordinates and the tool offset, so C is
# kept as a list of :class:`Coefficient` and evaluated from it; tables, fits and emulators use the same list.


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


def tool_of(
    machine: Machine, tool_mm: FloatArray | None, count: int | None = None, name: str = "tool_mm"
) -> FloatArray:
    """Return the tool offset to use: the given one, else the machine's, shape (3,) or (n, 3).

    With ``count`` points there is one offset, or one for each of them.
    """
    if tool_mm is None:
        return np.asarray(machine.tool_offset_mm, dtype=np.float64)
    found = vectors(name, tool_mm)
    return (
        found if count is None or len(found) == 1 or found.ndim == 1 else numbers(name, found, count, 3, finite=False)
    )


def c_matrix(machine: Machine, position_mm: FloatArray, tool_mm: FloatArray | None = None) -> FloatArray:
    """Matrix C of E = C P at commanded positions.

    Parameters
    ----------
    machine : its chain, tool offset and squareness reference are used.
    position_mm : axis coordinates, shape (n, 3).
    tool_mm : tool offsets, shape (3,) or (n, 3), default the machine's.

    Returns
    -------
    array of shape (n, 3, 21), columns in the order of :data:`compgen.data.names.ERROR_NAMES`; mm per mm or mm per rad.

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> from compgen.data.names import ERROR_INDEX
    >>> machine = compgen.load_machine("zha-gantry")
    >>> C = compgen.c_matrix(machine, np.array([[-100.0, -200.0, -50.0]]))
    >>> C[0, :, ERROR_INDEX["EC0Y"]].tolist()  # dX = -Y EC0Y
    [200.0, 0.0, 0.0]
    """
    of_kind("machine", machine, Machine)
    position_mm = numbers("position_mm", position_mm, None, 3, finite=False)
    tool = tool_of(machine, tool_mm, len(position_mm))
    matrix = np.zeros((len(position_mm), 3, len(ERRORS)))
    for term in coefficients(machine.chain, machine.squareness_reference):
        matrix[:, term.output, ERROR_INDEX[term.error]] += term.sign * factor(term.lever, position_mm, tool)
    return matrix


# Which of the 21 errors the machine's motion can show (``docs/conventions.md``, "Names").


_SAME_TOOL_MM = 1e-9
_PARALLEL = 1e-6  # sine of the angle below which two lever arms count as parallel


def observable_errors(machine: Machine, tools_mm: FloatArray | None = None) -> tuple[str, ...]:
    """Return the names of the errors that can be separated from all others.

    Linear and squareness errors always can. An angular error can if the travel of ANOTHER axis is one of its lever
    arms, or if tools of different offset were used: with only its own travel or one tool it is a function of its own
    axis only, the same as straightness or positioning of that axis. For one tool this leaves 17 on every chain.
    If all lever arms of an axis are parallel, the rotation about them moves nothing; one error is omitted for it,
    and the others together have its effect for those tools.

    Parameters
    ----------
    machine : its chain is used.
    tools_mm : the tool offsets that were used, shape (n, 3); default: one tool.

    Examples
    --------
    >>> import compgen
    >>> names = compgen.observable_errors(compgen.load_machine("zha-gantry"))
    >>> len(names), "ECX" in names  # ECX has no lever arm on this chain
    (17, False)
    """
    of_kind("machine", machine, Machine)
    tools = np.zeros((1, 3)) if tools_mm is None else np.atleast_2d(tool_of(machine, tools_mm, name="tools_mm"))
    spread = tools - tools.mean(axis=0)
    longest = np.linalg.norm(spread, axis=1).max()
    idle: list[set[int]] = [
        set(),
        set(),
        set(),
    ]  # directions of the angular errors that have no effect with the lever arms of an axis
    for axis in range(3):
        others = [other for other in machine.chain.lever_axes(axis) if other != axis]
        if len(others) > 1:
            continue
        if longest <= _SAME_TOOL_MM:
            idle[axis] = set(others or range(3))
            continue
        _, lengths, directions = np.linalg.svd(np.vstack([np.eye(3)[others], spread / longest]))
        if len(lengths) == 1 or lengths[1] <= _PARALLEL:
            idle[axis] = {int(np.flatnonzero(np.abs(directions[0]) > _PARALLEL)[-1])}
    return tuple(error.name for error in ERRORS if error.kind != "angular" or error.direction not in idle[error.axis])


def modelled_errors(machine: Machine, tools_mm: FloatArray | None = None) -> tuple[str, ...]:
    """Return the names of the errors that the machine's model contains, as given by its ``errors`` entry.

    ``"observable"`` depends on the tools that were used, 17 means those of one tool, 21 all, a list is used unchanged.
    """
    if machine.errors == 21:
        return ERROR_NAMES
    if machine.errors == 17:
        return observable_errors(machine)
    if machine.errors == "observable":
        return observable_errors(machine, tools_mm)
    return machine.errors
