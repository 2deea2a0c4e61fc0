"""Both directions of travel: the mean of what tables do in each, and whether their difference takes the reversal out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.core.points import Points
from compgen.core.reversal import WORTH_MM, ReversalCurves, reversal_name

Correction = Callable[[Points], FloatArray]

#: Positions along the travel at which the difference of the directions is looked at.
POSITIONS = 201
#: The difference may miss the reversal by this share of its largest value, or by this much, whichever is larger.
REVERSAL_SHARE = 0.3
REVERSAL_FLOOR_MM = 0.2 * MM_PER_UM


def in_both_directions(points: Points) -> Points:
    """Return the points twice: reached by positive travel of all axes, then by negative travel of all."""
    up = np.ones_like(points.position_mm)
    tool_mm = None
    if points.tool_mm is not None:
        tool_mm = np.vstack([np.broadcast_to(points.tool_mm, up.shape)] * 2)
    return Points(np.vstack([points.position_mm] * 2), tool_mm, np.vstack([up, -up]))


def mean_correction(correction: Correction, position_mm: FloatArray, tool_mm: FloatArray | None = None) -> FloatArray:
    """Return the mean of the corrections after positive and after negative travel of all axes, shape (n, 3), mm."""
    both = correction(in_both_directions(Points(position_mm, tool_mm)))
    return np.asarray(0.5 * (both[: len(position_mm)] + both[len(position_mm) :]))


def reversal_reasons(
    machine: Machine, correction: Correction, reversal: ReversalCurves, resolution_mm: float
) -> list[str]:
    """Name each reversal that the tables do not take out, or that they add, axis by axis along the travel.

    The correction after positive travel minus the one after negative travel must be minus the reversal value.
    """
    reasons = []
    for axis in range(3):
        position_mm = np.tile(0.5 * (machine.lower_mm + machine.upper_mm), (POSITIONS, 1))
        position_mm[:, axis] = np.linspace(*machine.axes[axis].range_mm, POSITIONS)
        up, down = np.ones_like(position_mm), np.ones_like(position_mm)
        down[:, axis] = -1.0
        given = correction(Points(position_mm, approach=up)) - correction(Points(position_mm, approach=down))
        needed = reversal.displacement(position_mm, down) - reversal.displacement(position_mm, up)
        for component in range(3):
            miss = np.abs(given[:, component] - needed[:, component])
            limit = max(REVERSAL_SHARE * float(np.max(np.abs(needed[:, component]))), REVERSAL_FLOOR_MM)
            worst = int(np.argmax(miss))
            if miss[worst] > limit + resolution_mm:
                reasons.append(
                    f"{reversal_name(axis, component)} at {AXES[axis]} {position_mm[worst, axis]:g} mm: the tables differ by "
                    f"{given[worst, component] / MM_PER_UM:+.2f} um between positive and negative travel, "
                    f"{needed[worst, component] / MM_PER_UM:+.2f} um needed"
                )
    return reasons


def left_by_reversal(reversal: ReversalCurves | None, *, corrected: bool) -> dict[str, float]:
    """Return in um what a reversal leaves that no table takes out: half of its largest value, by name."""
    if reversal is None or corrected:
        return {}
    largest = {reversal_name(*key): 0.5 * abs(value) for key, value in reversal.largest_mm.items()}
    return {name: round(value / MM_PER_UM, 3) for name, value in largest.items() if value >= 0.5 * WORTH_MM}
