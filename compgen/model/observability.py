"""Which of the 21 errors a machine's own motion can show (``docs/conventions.md``, "Names")."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import ERROR_NAMES, ERRORS


def observable_errors(machine: Machine, tools_mm: FloatArray | None = None) -> tuple[str, ...]:
    """Return the names of the errors that can be told from every other one.

    A linear error and a squareness error always can. An angular error can if the travel of ANOTHER axis is a lever
    arm of it, or if tools of different offset were used: with its own travel or one tool alone it acts as a function
    of its own axis only, which is that axis' straightness or positioning. For one tool this leaves 17 on every chain.

    Parameters
    ----------
    machine : its chain counts.
    tools_mm : the tool offsets that were used, shape (n, 3); default: one tool.
    """
    tools = np.zeros((1, 3)) if tools_mm is None else np.atleast_2d(tools_mm)
    spread = np.ptp(tools, axis=0) > 1e-9
    names = []
    for error in ERRORS:
        levers = [axis for axis in machine.chain.lever_axes(error.axis) if axis != error.axis]
        across = [axis for axis in range(3) if axis != error.direction]
        if error.kind != "angular" or any(axis in levers or spread[axis] for axis in across):
            names.append(error.name)
    return tuple(names)


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
