"""Which of the 21 errors a machine's own motion can show (``docs/conventions.md``, "Names")."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import ERROR_NAMES, ERRORS

_SAME_TOOL_MM = 1e-9
_PARALLEL = 1e-6  # sine of the angle below which two lever arms count as parallel


def observable_errors(machine: Machine, tools_mm: FloatArray | None = None) -> tuple[str, ...]:
    """Return the names of the errors that can be told from every other one.

    A linear error and a squareness error always can. An angular error can if the travel of ANOTHER axis is a lever
    arm of it, or if tools of different offset were used: with its own travel or one tool alone it acts as a function
    of its own axis only, which is that axis' straightness or positioning. For one tool this leaves 17 on every chain.
    If all lever arms of an axis are parallel, the rotation about them moves nothing; one error is left out for it
    and the others, taken together, do what it would do for those tools.

    Parameters
    ----------
    machine : its chain counts.
    tools_mm : the tool offsets that were used, shape (n, 3); default: one tool.
    """
    tools = np.zeros((1, 3)) if tools_mm is None else np.atleast_2d(tools_mm)
    idle = [_idle_rotations(machine, axis, tools) for axis in range(3)]
    return tuple(error.name for error in ERRORS if error.kind != "angular" or error.direction not in idle[error.axis])


def _idle_rotations(machine: Machine, axis: int, tools_mm: FloatArray) -> set[int]:
    """Directions (0, 1, 2) of the angular errors of ``axis`` that its lever arms do not show."""
    others = [other for other in machine.chain.lever_axes(axis) if other != axis]
    if len(others) > 1:
        return set()
    travel = np.eye(3)[others]
    spread = tools_mm - tools_mm.mean(axis=0)
    longest = np.linalg.norm(spread, axis=1).max()
    if longest <= _SAME_TOOL_MM:
        return set(others) if others else {0, 1, 2}
    levers = np.vstack([travel, spread / longest])
    _, lengths, directions = np.linalg.svd(levers)
    if len(lengths) > 1 and lengths[1] > _PARALLEL:
        return set()
    components = np.abs(directions[0])
    return {int(np.flatnonzero(components > _PARALLEL)[-1])}


def modelled_errors(machine: Machine, tools_mm: FloatArray | None = None) -> tuple[str, ...]:
    """Return the names of the errors that the machine's model contains, as its ``errors`` entry asks for.

    ``"observable"`` follows the tools that were used, 17 takes those of one tool, 21 all, a list is taken as it is.
    """
    if machine.errors == 21:
        return ERROR_NAMES
    if machine.errors == 17:
        return observable_errors(machine)
    if machine.errors == "observable":
        return observable_errors(machine, tools_mm)
    return machine.errors
