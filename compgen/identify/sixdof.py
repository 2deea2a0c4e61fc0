"""Errors from raw readings of the six-DOF instrument (``*.sixdof.csv`` and its instrument file), with uncertainties."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES, ERROR_NAMES, MM_PER_UM
from compgen.core.reversal import WORTH_MM, ReversalCurves
from compgen.errors import CompgenWarning, InputError
from compgen.identify.parameters import error_parameters
from compgen.identify.result import Identification, worst_uncertainty
from compgen.identify.reversal import SIGNIFICANT
from compgen.identify.sixdof_report import details_of
from compgen.identify.tables import metadata_of
from compgen.sixdof.as_printed import WARNING
from compgen.sixdof.budget import Budget, uncertainty_budget
from compgen.sixdof.chain import axis_runs
from compgen.sixdof.evaluation import AxisErrors, Evaluation, evaluate
from compgen.sixdof.frames import AxisRun, expected_away
from compgen.sixdof.health import Suspicion, sixdof_health
from compgen.sixdof.instrument import Instrument
from compgen.sixdof.interferometer import compensated, summary_of
from compgen.sixdof.readings import SixDof
from compgen.sixdof.reduction import reduce_runs
from compgen.sixdof.scatter import scatter_of


@dataclass(frozen=True)
class SixDofMeasurement:
    """Readings and the instrument that made them."""

    readings: SixDof
    instrument: Instrument

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.readings)


def identify_sixdof(machine: Machine, measurement: SixDofMeasurement) -> Identification:
    """Identify the errors of every measured axis, and squareness where both axes were measured.

    Parameters
    ----------
    machine : chain, travel and reference point.
    measurement : readings and instrument.

    Raises
    ------
    InputError
        for positions outside the travel, an axis that the instrument file does not describe, air that is not described,
        a displacement that does not follow the command.
    """
    _check_travel(machine, measurement.readings)
    instrument = measurement.instrument
    readings, notes = compensated(measurement.readings, instrument)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)  # said once below, not once a run
        runs = axis_runs(machine, readings, instrument)
        suspicions = [] if instrument.as_printed else sixdof_health(machine, readings, instrument)
    evaluation = evaluate(machine, instrument, runs)
    budget = None if instrument.as_printed else uncertainty_budget(machine, readings, instrument)
    objections = _objections(runs, as_printed=instrument.as_printed)
    remarks = [*objections, *_uncalibrated(instrument, evaluation), *_remarks(suspicions)]
    for text in remarks:
        warnings.warn(text, CompgenWarning, stacklevel=3)
    details = details_of(machine, readings, instrument, runs, evaluation, budget)
    details |= {"warnings": remarks, "health": [item.summary() for item in suspicions]}
    errors = (evaluation.errors if budget is None else budget.errors).replace(
        metadata=metadata_of(machine, readings.metadata)
    )
    reversal = None if budget is None else _reversal(machine, readings, instrument, evaluation)
    return _result(machine, runs, errors, budget, details, objections, reversal, summary_of(machine, readings, notes))


def _result(
    machine: Machine,
    runs: Sequence[AxisRun],
    errors: ErrorTable,
    budget: Budget | None,
    details: dict[str, Any],
    objections: tuple[str, ...],
    reversal: ReversalCurves | None,
    corrections: dict[str, Any],
) -> Identification:
    residual, freedom = _residuals(runs)
    missing = [name for name in ERROR_NAMES if name not in errors.names]
    known = budget is not None and budget.factor.size > 0
    size = len(residual)
    rms_um = float(np.sqrt(np.mean(residual**2))) / MM_PER_UM
    return Identification(
        errors=errors,
        stations=(),
        residual_mm=residual,
        accepted=np.ones(size, dtype=bool),
        rms_um=rms_um,
        degrees_of_freedom=freedom,
        reduced_chi_square=float("nan"),  # nothing is adjusted
        u_source="propagated" if known else "unknown",
        u_length_um=rms_um,
        u_length_um_per_m=0.0,
        u_scale=1.0,
        unobservable=tuple(f"{name}: its axis was not measured" for name in missing),
        rejected=(),
        rank=len(errors.names),
        unknowns=len(errors.names),
        condition=1.0,
        iterations=1,
        worst_u=worst_uncertainty(errors) if known else {},
        layout=error_parameters(machine, errors.names),
        values_factor=budget.factor if known and budget is not None else None,
        reversal_curves=reversal,
        corrections=corrections,
        method="sixdof",
        details=details,
        objections=objections,
    )


def _residuals(runs: Sequence[AxisRun]) -> tuple[FloatArray, int]:
    """Translations of every reading about the mean of its target position and direction (3 n,), mm; degrees of freedom."""
    parts, targets = [], 0
    for axis in sorted({run.axis for run in runs}):
        own = [run for run in runs if run.axis == axis]
        keys = np.vstack([np.column_stack([np.round(run.position_mm, 4), run.direction]) for run in own])
        values = np.vstack([run.delta_mm for run in own])
        _, group = np.unique(keys, axis=0, return_inverse=True)
        count = np.bincount(group.ravel())
        mean = np.column_stack([np.bincount(group.ravel(), values[:, k]) / count for k in range(3)])
        parts.append((values - mean[group.ravel()]).ravel())
        targets += len(count)
    residual = np.concatenate(parts)
    return residual, len(residual) - 3 * targets


def _check_travel(machine: Machine, readings: SixDof) -> None:
    """Positions lie within the travel of their axis."""
    for axis, letter in enumerate(AXES):
        low, high = machine.axes[axis].range_mm
        outside = (readings.axis == axis) & ((readings.position_mm < low - 1e-3) | (readings.position_mm > high + 1e-3))
        for row in np.flatnonzero(outside)[:1]:
            file, line = readings.origin[int(row)] if readings.origin else (None, None)
            raise InputError(
                f"{readings.position_mm[row]:g} mm is outside the travel of {letter}, {low:g} to {high:g} mm",
                file=file,
                line=line,
                field="column position_mm",
            )


def _objections(runs: Sequence[AxisRun], *, as_printed: bool) -> tuple[str, ...]:
    """Why nothing that is made of these errors may be accepted."""
    if as_printed:
        return (WARNING,)
    return tuple(dict.fromkeys(run.contradiction for run in runs if run.contradiction))


def _uncalibrated(instrument: Instrument, evaluation: Evaluation) -> list[str]:
    """What was not calibrated and cannot be seen in the readings."""
    known = {axis: {*instrument.axes[axis].systematics, *instrument.u_systematics} for axis in evaluation.axes}
    found = []
    letters = [AXES[axis] for axis, names in known.items() if "eps_PEy" not in names]
    if letters:
        h = abs(instrument.optics.beam_separation_mm)
        found.append(
            f"roll of {', '.join(letters)} may hold a line that no processing shows: calibrate eps_PEy and the angle "
            f"difference of the cube corners: 1 arcsec of eps_PEy is {1000.0 / h:.2f} arcsec/m at h = {h:g} mm"
        )
    bare = [AXES[axis] for axis in known if axis > 0 and not any(_of_prism(name) for name in known[axis])]
    if bare and evaluation.squareness_rad:
        found.append(
            f"squareness holds the deviation of the prism of {', '.join(bare)} from 90 degrees in full (1 arcsec of eps_zir "
            "is 2 arcsec of S_xy), and its uncertainty does not: calibrate the prism and give eps_?ir, eps_?mrs?"
        )
    return found


def _of_prism(name: str) -> bool:
    return name.endswith("ir") or "mrs" in name


def _remarks(suspicions: Sequence[Suspicion]) -> list[str]:
    return [f"{item.axis + ': ' if item.axis else ''}{item.text}" for item in suspicions if item.name != "mode"]


def _reversal(
    machine: Machine, readings: SixDof, instrument: Instrument, evaluation: Evaluation
) -> ReversalCurves | None:
    """Reversals that are far beyond their uncertainty and worth a table: displacement by axis and component, mm."""
    reduced = reduce_runs(readings, instrument, expected_away(machine, instrument))
    curves = {}
    for axis, entry in evaluation.axes.items():
        if entry.reversal is None:
            continue
        u = _u_of_reversal(machine, readings, instrument, axis, entry, reduced)
        for component in range(3):
            value = entry.reversal[:, component]
            known = np.isfinite(value)
            if np.any(np.abs(value[known]) > SIGNIFICANT * u[component]) and np.abs(value[known]).max() >= WORTH_MM:
                at = entry.position_mm[known]
                curves[axis, component] = Curve(at, value[known], np.full(len(at), u[component]))
    return ReversalCurves(curves, {"machine": machine.name}) if curves else None


def _u_of_reversal(
    machine: Machine, readings: SixDof, instrument: Instrument, axis: int, entry: AxisErrors, reduced: Sequence[Any]
) -> FloatArray:
    """Standard uncertainty (3,) of the difference of both directions, mm."""
    own = [run for run in reduced if run.axis == axis]
    scatter = scatter_of(machine, readings, instrument, own)
    variance = sum((value.mean(axis=0) for value in scatter.sources.values()), np.zeros((6, 6)))
    each = max(1.0, 0.5 * float(np.median(entry.count)))
    return np.asarray(np.sqrt(2.0 * np.diag(variance)[:3] / each))


__all__ = ["SixDofMeasurement", "identify_sixdof"]
