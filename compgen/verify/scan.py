"""Lines along the axes, sampled densely: a single wrong node of a fine table shows here and not in any mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.model.volumetric import c_matrix

#: Positions along a line beside the nodes of the tables: evenly spread over the travel.
POSITIONS = 1001
#: At a point the correction may miss the best possible one by this share of its range, and of the largest range of all
#: axes without the linear parts (a squareness of millimetres must hide nothing) ...
POINT_SHARE = 0.3
#: ... or by this much, whichever is larger; on top come the quantum and this many standard uncertainties of the
#: errors, up to POINT_SHARE of the whole range.
POINT_FLOOR_MM = 1.0 * MM_PER_UM
POINT_UNCERTAINTIES = 5.0


def scan_lines(machine: Machine, nodes_mm: tuple[FloatArray, ...]) -> FloatArray:
    """Return the points (n, 3) of nine lines along each axis: the other two at both ends and in the middle."""
    low, high = machine.lower_mm, machine.upper_mm
    lines = []
    for axis in range(3):
        nodes = nodes_mm[axis][(nodes_mm[axis] >= low[axis]) & (nodes_mm[axis] <= high[axis])]
        levels = [np.array([low[k], 0.5 * (low[k] + high[k]), high[k]]) for k in range(3)]
        levels[axis] = np.unique(np.concatenate([np.linspace(low[axis], high[axis], POSITIONS), nodes]))
        lines.append(np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1).reshape(-1, 3))
    return np.vstack(lines)


def displacement_uncertainty(
    machine: Machine, errors: ErrorTable, position_mm: FloatArray, tool_mm: FloatArray | None = None
) -> FloatArray:
    """Standard uncertainty of E = C P at positions (n, 3) from those of the errors, shape (3,): the largest, mm.

    Correlations are left out; an uncertainty that is not known counts as zero.
    """
    curves = {name: replace(curve, value=np.nan_to_num(curve.u)) for name, curve in errors.curves.items()}
    squareness = {name: (float(np.nan_to_num(u)), 0.0) for name, (_, u) in errors.squareness.items()}
    u = ErrorTable(curves, squareness).at(position_mm)
    return np.asarray(np.sqrt(np.einsum("nij,nj->ni", c_matrix(machine, position_mm, tool_mm) ** 2, u**2)).max(axis=0))


def point_reasons(
    position_mm: FloatArray,
    correction_mm: FloatArray,
    best_mm: FloatArray,
    bent_mm: float,
    u_mm: FloatArray,
    resolution_mm: float,
) -> list[str]:
    """Name for each axis the point (of n) where the correction (n, 3) misses the best one most, if it is too far.

    ``bent_mm`` is the largest range of the best one without its linear part, ``u_mm`` (3,) the standard uncertainty
    that the errors give the correction, ``resolution_mm`` the format's.
    """
    reasons = []
    for output, letter in enumerate(AXES):
        miss = np.abs(correction_mm[:, output] - best_mm[:, output])
        worst = int(np.argmax(miss))
        share = POINT_SHARE * float(np.ptp(best_mm[:, output]))
        limit = max(min(share, POINT_SHARE * bent_mm), POINT_FLOOR_MM) + resolution_mm
        limit += min(POINT_UNCERTAINTIES * u_mm[output], share)
        if miss[worst] > limit:
            x, y, z = position_mm[worst]
            reasons.append(
                f"correction {letter} at X {x:g} Y {y:g} Z {z:g} mm: {_um(correction_mm[worst, output])} um in the table, "
                f"{_um(best_mm[worst, output])} um needed"
            )
    return reasons


def _um(value_mm: float) -> str:
    return f"{round(float(value_mm) / MM_PER_UM, 2) + 0.0:+.2f}"
