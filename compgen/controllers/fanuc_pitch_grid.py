"""Section length of pitch compensation: the widest one that loses nothing and keeps every increment small enough."""

from __future__ import annotations

from decimal import ROUND_CEILING, Decimal

import numpy as np

from compgen.controllers.fanuc_pitch_settings import PitchSettings
from compgen.controllers.grids import NEGLIGIBLE_LOSS_MM, Grid, curve_nodes_mm, equidistant_grid
from compgen.controllers.terms import one_dimensional_terms
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine

#: The final curve may be steeper than the estimate by this factor: angular errors are spread over the volume.
STEEPER = 1.1
#: Loss by interpolation, in counts, that the rounding to whole counts hides.
NEGLIGIBLE_COUNTS = 0.05


def pitch_grid(machine: Machine, settings: PitchSettings, errors: ErrorTable, axis: int) -> Grid:
    """Return the section ends of an axis, the reference point among them.

    The user's interval is taken as it is. Otherwise sections get shorter until linear interpolation of the wanted
    correction loses nothing that matters and every increment, with a margin, stays within the limit (one count with a
    staircase), as far as the point numbers of this axis and the least interval permit.
    """
    most = max(3, (settings.last_number - settings.first_number + 1) // 3)
    asked_mm = settings.interval_mm[axis]
    if asked_mm is not None:
        return equidistant_grid(machine, errors, axis, most=most, step_mm=asked_mm, anchor=True)
    nodes_mm = curve_nodes_mm(machine, errors, axis, most)
    wanted_mm = _wanted_mm(machine, errors, axis, nodes_mm)
    best: Grid | None = None
    for intervals in range(min(len(nodes_mm) - 1, most - 2), most):
        step_mm = _step_mm(machine, settings, axis, intervals)
        grid = equidistant_grid(machine, errors, axis, most=most, step_mm=step_mm, anchor=True)
        if best is not None and (grid.count > most or grid.step == best.step):
            continue
        best = grid
        if _is_enough(settings, grid.nodes_mm, nodes_mm, wanted_mm):
            break
    assert best is not None  # the range above is never empty
    return best


def _wanted_mm(machine: Machine, errors: ErrorTable, axis: int, nodes_mm: FloatArray) -> FloatArray:
    """Correction of the axis by its own positioning error and by angular errors mid-volume, at nodes (n,), mm."""
    (term,) = one_dimensional_terms(machine, errors, [nodes_mm] * 3, [(axis, axis)])
    return term.start


def _step_mm(machine: Machine, settings: PitchSettings, axis: int, intervals: int) -> float:
    """Travel over ``intervals``, rounded up to what can be written, not below the least interval."""
    quantum = settings.interval_quantum_mm
    length = max(machine.axes[axis].length_mm / intervals, settings.least_interval_mm)
    steps = Decimal(repr(round(length, 9))) / quantum
    return float(max(Decimal(1), steps.to_integral_value(rounding=ROUND_CEILING)) * quantum)


def _is_enough(settings: PitchSettings, ends_mm: FloatArray, nodes_mm: FloatArray, wanted_mm: FloatArray) -> bool:
    """Whether sections with these ends hold the wanted correction (n,) at nodes (n,)."""
    at_ends_mm = _extended(ends_mm, nodes_mm, wanted_mm)
    loss_mm = float(np.max(np.abs(np.interp(nodes_mm, ends_mm, at_ends_mm) - wanted_mm)))
    largest = float(np.max(np.abs(np.diff(at_ends_mm)))) / settings.count_mm
    if loss_mm > max(NEGLIGIBLE_LOSS_MM, NEGLIGIBLE_COUNTS * settings.count_mm):
        return False
    if settings.interpolation == "staircase":
        return largest <= 1.0
    return STEEPER * largest + 1.0 <= settings.increment_limit


def _extended(position_mm: FloatArray, nodes_mm: FloatArray, value: FloatArray) -> FloatArray:
    """Interpolate linearly at positions (m,), the first and the last piece prolonged beyond the nodes (n,)."""
    inner = np.interp(position_mm, nodes_mm, value)
    below = np.minimum(position_mm - nodes_mm[0], 0.0) * (value[1] - value[0]) / (nodes_mm[1] - nodes_mm[0])
    above = np.maximum(position_mm - nodes_mm[-1], 0.0) * (value[-1] - value[-2]) / (nodes_mm[-1] - nodes_mm[-2])
    return np.asarray(inner + below + above, dtype=np.float64)
