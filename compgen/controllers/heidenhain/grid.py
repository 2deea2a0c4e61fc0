"""Node positions of HEIDENHAIN tables: free ones where the curves need them, or datum and power-of-two spacing.

Power of two: TNC 407 technical manual, p. 153. For a wanted spacing of 7 mm the largest spacing 2^n x 0.0001 mm that is
not wider is 6.5536 mm (n = 16).
"""

from __future__ import annotations

from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal

import numpy as np

from compgen.controllers.grids import RANGE_SHARE, UNCERTAINTY_SHARE, Grid, curve_nodes_mm, nearly_best
from compgen.controllers.heidenhain.settings import (
    LARGEST_EXPONENT,
    SMALLEST_EXPONENT,
    SPACING_UNIT_MM,
    HeidenhainSettings,
)
from compgen.controllers.node_choice import fewest_nodes
from compgen.controllers.terms import one_dimensional_terms
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES

#: Places for nodes between those of the curves: angular errors with a lever of their own travel are bent there.
MOST_CANDIDATES, MOST_PARTS = 200, 4
#: Free tables go on by this much beyond both ends with the end value, so that what lies outside does not matter.
MARGIN_MM = Decimal(10)
#: Neighbours of the oldest tables may differ by this share of their distance at most (TNC 407 manual, p. 156).
GRADIENT_SHARE = 1.0 / 64.0
QUANTUM_MM = Decimal("0.0001")


def spacing_mm(exponent: int) -> Decimal:
    """Spacing 2^n x 0.0001 mm.

    >>> spacing_mm(16)
    Decimal('6.5536')
    """
    return SPACING_UNIT_MM * Decimal(2) ** exponent


def widest_exponent(wanted_mm: float) -> int:
    """Return n of the widest spacing that is not wider than wanted.

    >>> widest_exponent(7.0)
    16
    """
    fitting = [n for n in range(SMALLEST_EXPONENT, LARGEST_EXPONENT + 1) if spacing_mm(n) <= Decimal(repr(wanted_mm))]
    return max(fitting, default=SMALLEST_EXPONENT)


def intervals(travel_mm: float, spacing: Decimal) -> int:
    """Return how many spacings cover a travel; one node more covers both of its ends.

    >>> intervals(500.0, spacing_mm(16)), intervals(800.0, spacing_mm(16))
    (77, 123)
    """
    return int((Decimal(repr(travel_mm)) / spacing).to_integral_value(rounding=ROUND_CEILING))


def com_nodes_mm(machine: Machine, settings: HeidenhainSettings, errors: ErrorTable, axis: int) -> FloatArray:
    """Return the nodes that hold the corrections over an axis, ascending, mm; those beyond the ends come later."""
    candidates = _candidates_mm(machine, errors, axis)
    terms = one_dimensional_terms(machine, errors, [candidates] * 3, [(output, axis) for output in range(3)])
    wanted = np.array([term.start for term in terms])
    tolerances = np.array([_tolerance_mm(errors, output, axis, settings.loss_mm) for output in range(3)])
    if settings.older:
        return _power_of_two(machine, settings, axis, candidates, wanted / tolerances[:, None])
    reference = np.flatnonzero(np.abs(candidates - machine.reference_point_mm[axis]) < 1e-6).tolist()
    chosen = candidates
    while True:
        chosen = candidates[fewest_nodes(candidates, wanted, tolerances, reference)]
        if len(chosen) <= settings.max_points - 2:
            return chosen
        tolerances = 1.3 * tolerances


def _candidates_mm(machine: Machine, errors: ErrorTable, axis: int) -> FloatArray:
    """Positions that may be nodes: those of the curves and some between them, in whole 0.0001 mm, all of the travel."""
    nodes = curve_nodes_mm(machine, errors, axis, MOST_CANDIDATES)
    parts = int(np.clip(MOST_CANDIDATES // len(nodes), 1, MOST_PARTS))
    fine = np.interp(np.arange(parts * (len(nodes) - 1) + 1) / parts, np.arange(len(nodes)), nodes)
    return np.unique(np.round(fine, 4))


def _tolerance_mm(errors: ErrorTable, output: int, axis: int, loss_mm: float) -> float:
    """Loss of a correction that is worth no node: as wanted, or what the uncertainty of its own error hides."""
    curve = errors.curves.get(f"E{AXES[output]}{AXES[axis]}")
    if curve is None or not np.all(np.isfinite(curve.u)):
        return loss_mm
    hidden = UNCERTAINTY_SHARE * float(np.sqrt(np.mean(curve.u**2)))
    return max(loss_mm, min(hidden, RANGE_SHARE * float(np.ptp(curve.value))))


def _power_of_two(
    machine: Machine, settings: HeidenhainSettings, axis: int, candidates: FloatArray, scaled: FloatArray
) -> FloatArray:
    """Nodes with the widest spacing that loses nothing; ``scaled`` are the corrections (3, n) in tolerances."""
    stated = settings.exponent[axis]
    tried: list[tuple[float, Grid]] = []
    for exponent in range(LARGEST_EXPONENT, SMALLEST_EXPONENT - 1, -1) if stated is None else (stated,):
        grid = _grid(machine, settings, axis, spacing_mm(exponent))
        if grid.count > settings.max_points - 2 and tried:
            break
        at = grid.nodes_mm
        lost = [np.interp(candidates, at, np.interp(at, candidates, row)) - row for row in scaled]
        tried.append((float(np.max(np.abs(lost))), grid))
        if tried[-1][0] <= 1.0:
            break
    if tried[-1][0] <= 1.0:
        return tried[-1][1].nodes_mm
    best = nearly_best(tried)
    return (best or tried[-1][1]).nodes_mm


def _grid(machine: Machine, settings: HeidenhainSettings, axis: int, step: Decimal) -> Grid:
    """Nodes of a spacing from the last one at or below the travel to the first one at or above its end."""
    low, high = (Decimal(repr(end)) for end in machine.axes[axis].range_mm)
    stated = settings.datum_mm[axis]
    datum = low.quantize(QUANTUM_MM, rounding=ROUND_FLOOR) if stated is None else stated
    first = max(datum, datum + step * ((low - datum) / step).to_integral_value(rounding=ROUND_FLOOR))
    count = int(((high - first) / step).to_integral_value(rounding=ROUND_CEILING)) + 1
    return Grid(first, step, max(count, 2))


def written_positions(settings: HeidenhainSettings, axis: int, nodes_mm: FloatArray) -> tuple[tuple[Decimal, ...], int]:
    """Return all positions of a table in exact numbers, and how many of them stand before the first of ``nodes_mm``.

    Beyond both ends stands at least one more, which gets the end value: tables end with no slope.
    """
    exact = [Decimal(repr(float(node))).quantize(QUANTUM_MM) for node in nodes_mm]
    if not settings.older:
        return (exact[0] - MARGIN_MM, *exact, exact[-1] + MARGIN_MM), 1
    step = exact[1] - exact[0]
    datum = settings.datum_mm[axis]
    before = 1 if datum is None else max(0, int((exact[0] - datum) / step))
    first = exact[0] - before * step
    return tuple(first + k * step for k in range(before + len(exact) + 1)), before
