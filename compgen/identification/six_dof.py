"""Errors from readings of the six-DOF instrument (``*.sixdof.csv``), with uncertainties and the report in ``identify.json``."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import SIGNIFICANT, WORTH_MM, Curve, ReversalCurves
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM, error_named
from compgen.errors import CompgenWarning
from compgen.identification.adjust.unknowns import check_axis_travel
from compgen.identification.result import Identification, metadata_of, without_adjustment
from compgen.instruments.interferometer import compensated, summary_of
from compgen.instruments.sixdof_evaluation import (
    Evaluation,
    axis_runs,
    each_run,
    evaluate,
    format_table,
    half_ranges,
    in_table_units,
)
from compgen.instruments.sixdof_health import second_beam_lines, sixdof_health
from compgen.instruments.sixdof_instrument import (
    RAD_PER_ARCSEC,
    SIGNALS,
    SetUp,
    SixDof,
    SixDofInstrument,
    cross_talk_arm_mm,
    systematic_columns,
)
from compgen.instruments.sixdof_reduction import WARNING, AxisRun, RelativeRun, drift_of, expected_away, reduce_runs
from compgen.instruments.sixdof_uncertainty import SixDofBudget, scatter_of, uncertainty_budget

# The object ``sixdof`` of ``identify.json``: processing of the readings, repeatability and the uncertainty budget.


def details_of(
    machine: Machine,
    readings: SixDof,
    instrument: SixDofInstrument,
    runs: Sequence[AxisRun],
    evaluation: Evaluation,
    budget: SixDofBudget | None,
) -> dict[str, Any]:
    """Return all results of the six-DOF evaluation that are not in the errors file."""
    reduced = reduce_runs(readings, instrument, expected_away(machine, instrument))
    repeated = half_ranges(each_run(machine, instrument, runs))
    freedom = []  # of the scatter of repeated runs, by axis
    for axis in {run.axis for run in reduced}:
        own = [run for run in reduced if run.axis == axis]
        if len(own) > 1:
            freedom.append((len(own) - 1) * max(len(np.unique(own[0].position_mm)) - 2, 1))
    columns: dict[str, Mapping[str, float]] = {"repeatability": repeated} if repeated else {}
    contributions = {} if budget is None else budget.contributions()
    parts = {}
    for name, part in contributions.items():
        error = error_named(name)
        parts[name] = {"unit": error.unit, **{source: value / error.si_per_unit for source, value in part.items()}}
    if contributions:
        columns["u (k = 1)"] = {name: part["combined"] for name, part in contributions.items()}
    return {
        "as_printed": instrument.as_printed,
        "optics": asdict(instrument.optics) | {"reduced_depth_mm": instrument.optics.reduced_depth_mm},
        "line": instrument.line,
        "axes": {AXES[k]: _axis(readings, instrument, [r for r in reduced if r.axis == k]) for k in evaluation.axes},
        "slopes_arcsec": {name: value / RAD_PER_ARCSEC for name, value in evaluation.slopes.items()},
        "squareness": _squareness(instrument, evaluation),
        "contradictions": list(dict.fromkeys(run.contradiction for run in runs if run.contradiction)),
        "repeatability_freedom": min(freedom, default=None),
        "repeatability_half_range": in_table_units(repeated),
        "reversal_angles_urad": {  # mean difference of both directions
            AXES[axis]: (1e6 * np.nanmean(entry.reversal[:, 3:], axis=0)).tolist()
            for axis, entry in evaluation.axes.items()
            if entry.reversal is not None
        },
        "budget": parts,
        "table": format_table(columns).splitlines() if columns else [],
    }


def _axis(readings: SixDof, instrument: SixDofInstrument, runs: Sequence[RelativeRun]) -> dict[str, Any]:
    """Return the set-up of one axis, and how its systematic parts were removed."""
    run = runs[0]
    set_up = instrument.axes[run.axis].set_up
    constant, linear = _classes(instrument, run)
    drift = np.vstack([drift_of(readings, part.rows, instrument.optics.focal_length_mm) for part in runs])
    turn = np.vstack([part.turn_rad for part in runs])
    arm = cross_talk_arm_mm(instrument.optics, set_up, run.distance_mm)
    lines = second_beam_lines(readings, runs)
    return {
        "mode": set_up.mode,
        "beam_direction": set_up.beam_direction,
        "runs": len(runs),
        "positions": len(np.unique(run.position_mm)),
        "distance_mm": [float(run.distance_mm.min()), float(run.distance_mm.max())],
        "target_moves_along_beam": run.away * set_up.beam_direction > 0,
        "removed": {
            "constant": {"by": "first position", "parameters": constant},
            "linear": {"by": f"calibration, and the {instrument.line} line of straightness", "parameters": linear},
            "function": {
                "by": "computed before the line is fitted",
                "cross_talk_arm_mm": [float(arm.min()), float(arm.max())],
                "largest_angle_arcsec": float(np.abs(turn).max()) / RAD_PER_ARCSEC,
                "drift_range_arcsec": (np.ptp(drift, axis=0) / RAD_PER_ARCSEC).tolist(),
            },
        },
        "second_beam": {"slope": lines["slope"], "bow_um": lines["bow_mm"] / MM_PER_UM} if lines else None,
    }


def _classes(instrument: SixDofInstrument, run: RelativeRun) -> tuple[list[str], list[str]]:
    """Calibrated parameters whose signals are constant over L, and those with signals linear in L."""
    entry = instrument.axes[run.axis]
    columns = systematic_columns(
        instrument.optics, SetUp(run.axis, 1, entry.set_up.beam_direction), np.array([100.0, 1100.0])
    )
    spots = [SIGNALS.index(name) for name in SIGNALS[1:5]]
    constant: list[str] = []
    linear: list[str] = []
    for name in entry.systematics:
        change = np.ptp(columns[name][:, spots], axis=0).max()
        (linear if change > 1e-9 else constant).append(name)
    return constant, linear


def _squareness(instrument: SixDofInstrument, evaluation: Evaluation) -> dict[str, Any]:
    names = ("EC0Y", "EB0Z", "EA0Z")
    signs = dict(zip(names, instrument.squareness_signs, strict=True))
    short = dict(zip(names, ("S_xy", "S_xz", "S_yz"), strict=True))
    return {
        name: {"of": short[name], "angle_less_arcsec": value / RAD_PER_ARCSEC, "sign": signs[name]}
        for name, value in evaluation.squareness_rad.items()
    }


# Errors from raw readings of the six-DOF instrument (``*.sixdof.csv`` and its instrument file), with uncertainties.


@dataclass(frozen=True)
class SixDofMeasurement:
    """Readings and their instrument."""

    readings: SixDof
    instrument: SixDofInstrument

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.readings)

    @property
    def metadata(self) -> Mapping[str, str]:
        """Comments ``key = value`` of the file."""
        return self.readings.metadata


def identify_sixdof(machine: Machine, measurement: SixDofMeasurement) -> Identification:
    """Identify the errors of every measured axis, and squareness if both axes were measured.

    Parameters
    ----------
    machine : chain, travel and reference point.
    measurement : readings and instrument.

    Raises
    ------
    InputError
        for positions outside the travel, an axis that the instrument file does not describe, missing air data, a
        displacement that does not follow the command.
    """
    instrument, raw = measurement.instrument, measurement.readings
    check_axis_travel(machine, raw.axis, raw.position_mm, raw.origin, "column position_mm")
    readings, notes = compensated(measurement.readings, instrument)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)  # reported once below, not for every run
        runs = axis_runs(machine, readings, instrument)
        suspicions = [] if instrument.as_printed else sixdof_health(machine, readings, instrument)
    evaluation = evaluate(machine, instrument, runs)
    budget = None if instrument.as_printed else uncertainty_budget(machine, readings, instrument)
    objections = _objections(runs, as_printed=instrument.as_printed)
    remarks = [*objections, *_uncalibrated(instrument, evaluation)]
    remarks += [f"{item.axis + ': ' if item.axis else ''}{item.text}" for item in suspicions if item.name != "mode"]
    for text in remarks:
        warnings.warn(text, CompgenWarning, stacklevel=3)
    details = details_of(machine, readings, instrument, runs, evaluation, budget)
    details |= {"warnings": remarks, "health": [item.summary() for item in suspicions]}
    errors = (evaluation.errors if budget is None else budget.errors).replace(
        metadata=metadata_of(machine, readings.metadata)
    )
    reversal = None if budget is None else _reversal(machine, readings, instrument, evaluation)
    known = budget is not None and budget.factor.size > 0
    residual, freedom = _residuals(runs)
    missing = "its axis was not measured"
    return replace(
        without_adjustment(machine, errors, residual, "propagated" if known else "unknown", missing),
        degrees_of_freedom=freedom,
        reduced_chi_square=float("nan"),  # nothing is adjusted
        values_factor=budget.factor if known and budget is not None else None,
        reversal_curves=reversal,
        corrections=summary_of(machine, readings, notes),
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


def _objections(runs: Sequence[AxisRun], *, as_printed: bool) -> tuple[str, ...]:
    """Return why no result from these errors may be accepted."""
    if as_printed:
        return (WARNING,)
    return tuple(dict.fromkeys(run.contradiction for run in runs if run.contradiction))


def _uncalibrated(instrument: SixDofInstrument, evaluation: Evaluation) -> list[str]:
    """Return what was not calibrated and does not show in the readings."""
    known = {axis: {*instrument.axes[axis].systematics, *instrument.u_systematics} for axis in evaluation.axes}
    found = []
    letters = [AXES[axis] for axis, names in known.items() if "eps_PEy" not in names]
    if letters:
        h = abs(instrument.optics.beam_separation_mm)
        found.append(
            f"roll of {', '.join(letters)} may contain a slope that no evaluation can detect: calibrate eps_PEy and the angle "
            f"difference of the cube corners: 1 arcsec of eps_PEy is {1000.0 / h:.2f} arcsec/m at h = {h:g} mm"
        )
    bare = [
        AXES[axis]
        for axis in known
        if axis > 0 and not any(name.endswith("ir") or "mrs" in name for name in known[axis])
    ]
    if bare and evaluation.squareness_rad:
        found.append(
            f"squareness contains the full deviation of the prism of {', '.join(bare)} from 90 degrees (1 arcsec of eps_zir "
            "is 2 arcsec of S_xy), and its uncertainty does not: calibrate the prism and give eps_?ir, eps_?mrs?"
        )
    return found


def _reversal(
    machine: Machine, readings: SixDof, instrument: SixDofInstrument, evaluation: Evaluation
) -> ReversalCurves | None:
    """Return reversals well above their uncertainty and worth a table: displacement by axis and component, mm."""
    reduced = reduce_runs(readings, instrument, expected_away(machine, instrument))
    curves = {}
    for axis, entry in evaluation.axes.items():
        if entry.reversal is None:
            continue
        # standard uncertainty of the difference of both directions
        scatter = scatter_of(machine, readings, instrument, [run for run in reduced if run.axis == axis])
        variance = sum((value.mean(axis=0) for value in scatter.sources.values()), np.zeros((6, 6)))
        u = np.sqrt(2.0 * np.diag(variance)[:3] / max(1.0, 0.5 * float(np.median(entry.count))))
        for component in range(3):
            value = entry.reversal[:, component]
            known = np.isfinite(value)
            if np.any(np.abs(value[known]) > SIGNIFICANT * u[component]) and np.abs(value[known]).max() >= WORTH_MM:
                at = entry.position_mm[known]
                curves[axis, component] = Curve(at, value[known], np.full(len(at), u[component]))
    return ReversalCurves(curves, {"machine": machine.name}) if curves else None
