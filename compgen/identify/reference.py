"""Identification at reference conditions: scales at 20 degC, the right wavelength, the mean of both directions.

What has to be taken out of the readings depends a little on stations and errors; so they are identified, and once or
twice again with better corrected readings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.identify.adjustment import Adjustment
from compgen.identify.corrections import Conditions, reading_conditions
from compgen.identify.misfit import Misfit, Series, labels_of, misfit_of, warn_of_misfit
from compgen.identify.parameters import ErrorParameters
from compgen.identify.result import Identification
from compgen.identify.reversal import Reversal, Stops, approach_signs, estimate_reversal, stop_cells
from compgen.identify.state import IntArray, State
from compgen.identify.whiteness import Whiteness, check_whiteness, warn_of_weakness
from compgen.model.volumetric import tool_of

ROUNDS = 3
#: Corrections that change by less than this are settled, mm.
SETTLED_MM = 1e-8


def identify_at_reference(
    machine: Machine,
    lengths: Lengths,
    adjust: Callable[[Lengths], Identification],
    rough: Callable[[Lengths], tuple[ErrorParameters, State, IntArray]],
    *,
    temperature: bool = True,
) -> Identification:
    """Identify from readings that are brought to reference conditions, and test the residuals.

    Parameters
    ----------
    machine, lengths : as in :func:`compgen.identify.identify`.
    adjust : identifies from readings as they are.
    rough : start values for stations and dead lengths.
    temperature : whether the scales are corrected to 20 degC.
    """
    lengths, conditions = reading_conditions(machine, lengths, temperature=temperature)
    still = np.zeros_like(lengths.position_mm)
    used = lengths
    if conditions.needs_geometry:
        used = _added(lengths, conditions.correction_mm(lengths, *rough(lengths), still))
    found = adjust(used)
    approach = approach_signs(lengths)
    reversal, removed, taken_mm = None, False, still[:, 0]
    for _ in range(ROUNDS if approach is not None or conditions.needs_geometry else 0):
        assert found.adjustment is not None
        geometry = (found.layout, found.adjustment.state, found.adjustment.group)
        plain = conditions.correction_mm(lengths, *geometry, still) if conditions.needs_geometry else still[:, 0]
        expected = used.length_mm + found.residual_mm
        moved = still
        if approach is not None:
            stops = _stops(machine, lengths, lengths.length_mm + plain - expected, found.adjustment)
            reversal = estimate_reversal(lengths, approach, stops)
            if reversal is not None and reversal.significant:
                moved = reversal.displacement(reversal.resolved(approach, lengths.station, stops))
                removed = True
        if not conditions.needs_geometry and not removed:
            break
        again = _added(lengths, conditions.correction_mm(lengths, *geometry, moved))
        settled = np.abs(again.length_mm - used.length_mm).max() < SETTLED_MM
        used, taken_mm = again, again.length_mm - lengths.length_mm - plain
        if settled:
            break
        found = adjust(used)
    if reversal is not None:
        reversal = replace(reversal, removed=removed)
    tested = _tested(machine, used, found, conditions, reversal)
    return replace(tested, misfit=_misfit(used, tested, taken_mm if removed else None))


def _added(lengths: Lengths, correction_mm: FloatArray) -> Lengths:
    return replace(lengths, length_mm=lengths.length_mm + correction_mm)


def _sight(machine: Machine, lengths: Lengths, stations_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors from station to nominal target (n, 3), and distances (n,)."""
    vector = lengths.position_mm + tool_of(machine, lengths.tool_mm) - stations_mm[lengths.station]
    distance = np.sqrt(np.einsum("ij,ij->i", vector, vector))
    return vector / distance[:, None], distance


def _stops(machine: Machine, lengths: Lengths, difference_mm: FloatArray, adjustment: Adjustment) -> Stops:
    sight, _ = _sight(machine, lengths, adjustment.state.stations_mm)
    return Stops(stop_cells(lengths, adjustment.group), difference_mm, sight, adjustment.weight)


def _tested(
    machine: Machine, used: Lengths, found: Identification, conditions: Conditions, reversal: Reversal | None
) -> Identification:
    """Add what was corrected, and the tests of the residuals, which are made when somebody looks at them."""
    adjustment = found.adjustment
    if adjustment is not None:
        if adjustment.held_weight is None:  # known stations bring their own uncertainty in
            typical = adjustment.sigma_mm / float(np.sqrt(max(adjustment.weight.mean(), 1e-12)))
            warn_of_weakness(machine, found.errors, found.worst_u, typical)
        warn_of_misfit(found.reduced_chi_square, found.u_source)

    def tests() -> Whiteness:
        if adjustment is None:
            return Whiteness({}, 1.0, {}, ())
        sigma = adjustment.sigma_mm / found.u_scale / np.sqrt(np.where(found.accepted, adjustment.weight, 1.0))
        standardised = np.where(found.accepted, found.residual_mm / sigma, np.nan)
        _, distance = _sight(machine, used, adjustment.state.stations_mm)
        return check_whiteness(used, adjustment.group, standardised, distance, found.unknowns)

    return replace(found, residual_tests=tests, reversal=reversal, corrections=conditions.notes)


def _misfit(used: Lengths, found: Identification, reversal_mm: FloatArray | None) -> Misfit | None:
    """Judge the size of the residuals; ``reversal_mm`` (n,) is what was added to each reading for a reversal."""
    adjustment = found.adjustment
    if adjustment is None:
        return None
    figures = (found.reduced_chi_square, found.degrees_of_freedom, found.u_scale, found.u_source)
    return misfit_of(*figures, lambda: _series(used, found, adjustment, reversal_mm))


def _series(used: Lengths, found: Identification, adjustment: Adjustment, reversal_mm: FloatArray | None) -> Series:
    """Residuals of the readings that were used, with what may explain them."""
    rows = found.accepted
    residual_mm = found.residual_mm[rows]
    labels = labels_of(used.labels, used.origin, used.position_mm, used.station)
    time = used.covariates.get("time_s")
    return Series(
        residual_um=residual_mm / MM_PER_UM,
        bare_um=None if reversal_mm is None else (residual_mm + reversal_mm[rows]) / MM_PER_UM,
        sigma_um=adjustment.sigma_mm / found.u_scale / np.sqrt(adjustment.weight[rows]) / MM_PER_UM,
        group=adjustment.group[rows],
        labels={name: label[rows] for name, label in labels.items()},
        time_s=None if time is None or not np.isfinite(time[rows]).all() else time[rows],
    )
