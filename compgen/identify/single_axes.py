"""Positioning errors from runs along single axes (ISO 230-2): the two-way mean at each target, and the reversal."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from compgen.data.axis_runs import AxisRuns
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import WORTH_MM, Curve, ErrorTable, ReversalCurves
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.errors import CompgenWarning
from compgen.identify.adjust.unknowns import check_axis_travel
from compgen.identify.identification import Identification, metadata_of, without_adjustment
from compgen.identify.reversal_errors import SIGNIFICANT

#: Targets closer than this are the same one, mm.
SAME_TARGET_MM = 1e-4
POSITIONING = ("EXX", "EYY", "EZZ")


def two_way_mean(
    position_mm: FloatArray, direction: np.ndarray, value: FloatArray
) -> tuple[Curve, Curve | None, FloatArray]:
    """Return mean over both directions, reversal, and residuals of the readings along one axis.

    Parameters
    ----------
    position_mm, direction, value : targets, directions (+1, -1, or 0 where unknown) and readings, (n,), mm or rad.

    Returns
    -------
    mean : at each target the mean of the means of both directions (ISO 230-2), or that of the only one.
    reversal : positive minus negative approach where both were made; None if nowhere.
    residual : reading minus mean of its target and direction, (n,).

    Standard uncertainties come from the scatter within targets and directions, pooled over the axis, because a handful
    of runs says little about a single one; nan where nothing was repeated.
    """
    keys = np.round(position_mm / SAME_TARGET_MM).astype(np.int64)
    _, first, target = np.unique(keys, return_index=True, return_inverse=True)
    cell = 2 * target.ravel() + (np.asarray(direction) < 0)
    count = np.bincount(cell, minlength=2 * len(first)).astype(np.float64)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(cell, value, minlength=2 * len(first)) / count
    residual = value - mean[cell]
    freedom = len(value) - int(np.count_nonzero(count))
    variance = float(residual @ residual) / freedom if freedom else np.nan
    both = mean.reshape(-1, 2)
    with np.errstate(divide="ignore"):
        square = np.where(np.isfinite(both), variance / count.reshape(-1, 2), 0.0)
    ways = np.isfinite(both).sum(axis=1)
    centre = Curve(position_mm[first], np.nansum(both, axis=1) / ways, np.sqrt(square.sum(axis=1)) / ways)
    pairs = np.flatnonzero(ways == 2)
    if not pairs.size:
        return centre, None, residual
    reversal = Curve(centre.position_mm[pairs], both[pairs, 0] - both[pairs, 1], np.sqrt(square[pairs].sum(axis=1)))
    return centre, reversal, residual


def worth_a_table(reversal: Curve) -> bool:
    """Whether a reversal is large enough, and beyond its uncertainty somewhere."""
    size = np.abs(reversal.value)
    beyond = np.isnan(reversal.u) | (size > SIGNIFICANT * reversal.u)
    return bool(size.max() >= WORTH_MM and beyond.any())


def positioning_errors(
    runs: AxisRuns, metadata: Mapping[str, str]
) -> tuple[ErrorTable, ReversalCurves | None, FloatArray]:
    """Return EXX, EYY, EZZ of the axes that were measured, their reversals, and the residuals (n,), mm."""
    curves, reversals = {}, {}
    residual = np.zeros(len(runs))
    for axis in runs.axes:
        rows = runs.axis == axis
        readings = runs.position_mm[rows], runs.direction[rows], runs.deviation_mm[rows]
        curves[POSITIONING[axis]], reversal, residual[rows] = two_way_mean(*readings)
        if reversal is not None and worth_a_table(reversal):
            reversals[axis, axis] = reversal
    table = ErrorTable(curves, {}, dict(metadata))
    return table, ReversalCurves(reversals, dict(metadata)) if reversals else None, residual


def identify_axis_runs(machine: Machine, runs: AxisRuns) -> Identification:
    """Take the positioning errors of the measured axes from their runs; nothing else shows in them.

    The curves are zero at the reference point, as those of every identification; the details say what was taken off.

    Raises
    ------
    InputError
        for targets outside the travel.
    """
    check_axis_travel(machine, runs.axis, runs.position_mm, runs.origin)
    raw, reversal, residual = positioning_errors(runs, metadata_of(machine, runs.metadata))
    # where the laser was zeroed means nothing: each curve is zero at the machine's reference point
    offsets = {
        name: float(np.interp(machine.reference_point_mm[axis], raw.curves[name].position_mm, raw.curves[name].value))
        for axis, name in ((axis, POSITIONING[axis]) for axis in runs.axes)
    }
    curves = raw.curves
    errors = raw.replace(
        curves={
            name: Curve(curves[name].position_mm, curves[name].value - offset, curves[name].u)
            for name, offset in offsets.items()
        }
    )
    letters = ", ".join(AXES[axis] for axis in runs.axes)
    warnings.warn(
        f"positioning runs of {letters} show {', '.join(errors.names)} along the line that was measured; angular errors, "
        "straightness and squareness were not measured and count as zero",
        CompgenWarning,
        stacklevel=2,
    )
    cells = {
        (a, round(p / SAME_TARGET_MM), d)
        for a, p, d in zip(runs.axis.tolist(), runs.position_mm.tolist(), runs.direction.tolist(), strict=True)
    }
    summaries = {}
    for axis in runs.axes:
        rows = runs.axis == axis
        summaries[AXES[axis]] = {
            "targets": len(np.unique(np.round(runs.position_mm[rows] / SAME_TARGET_MM))),
            "runs": len(np.unique(runs.run[rows])),
            "directions": sorted(set(runs.direction[rows].tolist())),
            "from_mm": float(runs.position_mm[rows].min()),
            "to_mm": float(runs.position_mm[rows].max()),
            "taken_off_um": offsets[POSITIONING[axis]] / MM_PER_UM,
        }
    known = all(np.isfinite(curve.u).all() for curve in errors.curves.values())
    missing = "runs along single axes do not show it"
    return replace(
        without_adjustment(machine, errors, -residual, "scatter" if known else "unknown", missing),
        degrees_of_freedom=len(runs) - len(cells),
        reversal_curves=reversal,
        method="axis-runs",
        details={"axes": summaries},
    )
