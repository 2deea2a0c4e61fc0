"""Positioning errors from runs along single axes (ISO 230-2): the two-way mean at each target, and the reversal."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import numpy as np

from compgen.core.axis_runs import AxisRuns
from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, ERROR_NAMES, MM_PER_UM
from compgen.core.reversal import WORTH_MM, ReversalCurves
from compgen.errors import CompgenWarning, InputError
from compgen.identify.parameters import error_parameters
from compgen.identify.result import Identification, worst_uncertainty
from compgen.identify.reversal import SIGNIFICANT
from compgen.identify.tables import metadata_of

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
    gap = Curve(centre.position_mm[pairs], both[pairs, 0] - both[pairs, 1], np.sqrt(square[pairs].sum(axis=1)))
    return centre, gap, residual


def worth_a_table(gap: Curve) -> bool:
    """Whether a reversal is large enough, and beyond its uncertainty somewhere."""
    size = np.abs(gap.value)
    beyond = np.isnan(gap.u) | (size > SIGNIFICANT * gap.u)
    return bool(size.max() >= WORTH_MM and beyond.any())


def positioning_errors(
    runs: AxisRuns, metadata: Mapping[str, str]
) -> tuple[ErrorTable, ReversalCurves | None, FloatArray]:
    """Return EXX, EYY, EZZ of the axes that were measured, their reversals, and the residuals (n,), mm."""
    curves, gaps = {}, {}
    residual = np.zeros(len(runs))
    for axis in runs.axes:
        own = runs.axis == axis
        centre, gap, residual[own] = two_way_mean(runs.position_mm[own], runs.direction[own], runs.deviation_mm[own])
        curves[POSITIONING[axis]] = centre
        if gap is not None and worth_a_table(gap):
            gaps[axis, axis] = gap
    return ErrorTable(curves, {}, dict(metadata)), ReversalCurves(gaps, dict(metadata)) if gaps else None, residual


def identify_axis_runs(machine: Machine, runs: AxisRuns) -> Identification:
    """Take the positioning errors of the measured axes from their runs; nothing else shows in them.

    The curves are zero at the reference point, as those of every identification; what was taken off stands in the details.

    Raises
    ------
    InputError
        for targets outside the travel.
    """
    _check_travel(machine, runs)
    raw, reversal, residual = positioning_errors(runs, metadata_of(machine, runs.metadata))
    errors, offset_um = _zero_at_reference(machine, raw)
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
    rms_um = float(np.sqrt(np.mean(residual**2))) / MM_PER_UM
    known = all(np.isfinite(curve.u).all() for curve in errors.curves.values())
    return Identification(
        errors=errors,
        stations=(),
        residual_mm=-residual,
        accepted=np.ones(len(runs), dtype=bool),
        rms_um=rms_um,
        degrees_of_freedom=len(runs) - len(cells),
        reduced_chi_square=1.0,
        u_source="scatter" if known else "unknown",
        u_length_um=rms_um,
        u_length_um_per_m=0.0,
        u_scale=1.0,
        unobservable=tuple(f"{name}: runs along single axes do not show it" for name in _missing(errors)),
        rejected=(),
        rank=len(errors.names),
        unknowns=len(errors.names),
        condition=1.0,
        iterations=1,
        worst_u=worst_uncertainty(errors) if known else {},
        layout=error_parameters(machine, errors.names),
        reversal_curves=reversal,
        method="axis-runs",
        details={"axes": {AXES[axis]: _axis_summary(runs, axis, offset_um[axis]) for axis in runs.axes}},
    )


def _zero_at_reference(machine: Machine, raw: ErrorTable) -> tuple[ErrorTable, dict[int, float]]:
    """Take off each curve its value at the machine's reference point, um by axis: it depends on where the laser was zeroed."""
    curves, offset_um = {}, {}
    for name, curve in raw.curves.items():
        axis = POSITIONING.index(name)
        offset = float(np.interp(machine.reference_point_mm[axis], curve.position_mm, curve.value))
        curves[name] = Curve(curve.position_mm, curve.value - offset, curve.u)
        offset_um[axis] = offset / MM_PER_UM
    return raw.replace(curves=curves), offset_um


def _missing(errors: ErrorTable) -> list[str]:
    return [name for name in ERROR_NAMES if name not in errors.names]


def _axis_summary(runs: AxisRuns, axis: int, offset_um: float) -> dict[str, object]:
    own = runs.axis == axis
    return {
        "targets": len(np.unique(np.round(runs.position_mm[own] / SAME_TARGET_MM))),
        "runs": len(np.unique(runs.run[own])),
        "directions": sorted(set(runs.direction[own].tolist())),
        "from_mm": float(runs.position_mm[own].min()),
        "to_mm": float(runs.position_mm[own].max()),
        "taken_off_um": offset_um,
    }


def _check_travel(machine: Machine, runs: AxisRuns) -> None:
    """Targets lie within the travel of their axis."""
    for axis in runs.axes:
        low, high = machine.axes[axis].range_mm
        outside = (runs.axis == axis) & ((runs.position_mm < low - 1e-3) | (runs.position_mm > high + 1e-3))
        for row in np.flatnonzero(outside)[:1].tolist():
            file, line = runs.origin[row] if runs.origin else (None, None)
            raise InputError(
                f"{runs.position_mm[row]:g} mm is outside the travel of {AXES[axis]}, {low:g} to {high:g} mm",
                file=file,
                line=line,
            )
