"""Section length of pitch compensation: the widest one that loses nothing and keeps every increment small enough."""

from __future__ import annotations

from decimal import ROUND_CEILING, Decimal

import numpy as np

from compgen.controllers.fanuc.pitch_settings import PitchSettings
from compgen.controllers.grids import Grid, common_step, curve_nodes_mm, equidistant_grid, nearly_best, worth_mm
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

    Points that the sample of the control shows are kept: their section ends are taken as they are. The user's interval
    is taken as it is. Otherwise the fewest sections are taken with which linear interpolation of the wanted correction
    loses nothing that matters and every increment, with a margin, stays within the limit (one count with a staircase),
    as far as the point numbers of this axis and the least interval permit.
    """
    kept = settings.kept[axis]
    if kept is not None:
        lowest = kept.first if settings.total else kept.first - 1
        start = Decimal(repr(machine.reference_point_mm[axis])) + (lowest - kept.reference) * kept.interval_mm
        return Grid(start, kept.interval_mm, kept.last - lowest + 1)
    most = max(3, (settings.last_number - settings.first_number + 1) // 3)
    asked_mm = settings.interval_mm[axis]
    if asked_mm is not None:
        return equidistant_grid(machine, errors, axis, most=most, step_mm=asked_mm, anchor=True)
    nodes_mm = curve_nodes_mm(machine, errors, axis, most)
    wanted_mm = _wanted_mm(machine, errors, axis, nodes_mm)
    loss_mm = max(worth_mm(errors, axis, settings.loss_mm), NEGLIGIBLE_COUNTS * settings.count_mm(axis))
    flat: list[tuple[float, Grid]] = []
    grids = _grids(machine, settings, errors, axis, most)
    for grid in grids:
        at_ends_mm = _extended(grid.nodes_mm, nodes_mm, wanted_mm)
        if _is_flat(settings, axis, at_ends_mm):
            lost_mm = float(np.max(np.abs(np.interp(nodes_mm, grid.nodes_mm, at_ends_mm) - wanted_mm)))
            flat.append((lost_mm, grid))
            if lost_mm <= loss_mm:
                return grid
    return nearly_best(flat) or grids[-1]


def _grids(machine: Machine, settings: PitchSettings, errors: ErrorTable, axis: int, most: int) -> list[Grid]:
    """Possible section ends by their number; the widest sections alone if none keeps within ``most``."""
    common = common_step(machine, errors, axis, anchor=True)
    steps = {_step_mm(machine, settings, axis, intervals) for intervals in range(1, most)}
    parts = [common / part for part in range(1, 11)]
    steps |= {
        float(step) for step in parts if step >= settings.least_interval_mm and step % settings.interval_quantum_mm == 0
    }
    count_most = machine.axes[axis].length_mm / most
    grids = [
        equidistant_grid(machine, errors, axis, most=most, step_mm=step, anchor=True)
        for step in steps
        if step > count_most
    ]
    grids = sorted(grids, key=lambda grid: (grid.count, grid.step))
    return [grid for grid in grids if grid.count <= most] or grids[:1]


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


def _is_flat(settings: PitchSettings, axis: int, at_ends_mm: FloatArray) -> bool:
    """Whether the increments of a correction at the section ends (n,), with a margin, stay within the limit."""
    largest = float(np.max(np.abs(np.diff(at_ends_mm)))) / settings.count_mm(axis)
    if settings.interpolation == "staircase":
        return largest <= 1.0
    return STEEPER * largest + 1.0 <= settings.increment_limit


def _extended(position_mm: FloatArray, nodes_mm: FloatArray, value: FloatArray) -> FloatArray:
    """Interpolate linearly at positions (m,), the first and the last piece prolonged beyond the nodes (n,)."""
    inner = np.interp(position_mm, nodes_mm, value)
    below = np.minimum(position_mm - nodes_mm[0], 0.0) * (value[1] - value[0]) / (nodes_mm[1] - nodes_mm[0])
    above = np.maximum(position_mm - nodes_mm[-1], 0.0) * (value[-1] - value[-2]) / (nodes_mm[-1] - nodes_mm[-2])
    return np.asarray(inner + below + above, dtype=np.float64)
