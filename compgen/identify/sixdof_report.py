"""The object ``sixdof`` of ``identify.json``: what was done to the readings, repeatability and the uncertainty budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM, error_named
from compgen.sixdof.budget import Budget
from compgen.sixdof.comparison import each_run, format_table, half_ranges, in_table_units
from compgen.sixdof.evaluation import Evaluation
from compgen.sixdof.frames import AxisRun, expected_away
from compgen.sixdof.health import second_beam_lines
from compgen.sixdof.instrument import RAD_PER_ARCSEC, Instrument
from compgen.sixdof.model import SetUp, cross_talk_arm_mm, systematic_columns
from compgen.sixdof.optics import SIGNALS
from compgen.sixdof.readings import SixDof
from compgen.sixdof.reduction import RelativeRun, drift_of, reduce_runs


def details_of(
    machine: Machine,
    readings: SixDof,
    instrument: Instrument,
    runs: Sequence[AxisRun],
    evaluation: Evaluation,
    budget: Budget | None,
) -> dict[str, Any]:
    """Everything about the six-DOF evaluation that has no place in the errors file."""
    reduced = reduce_runs(readings, instrument, expected_away(machine, instrument))
    repeated = half_ranges(each_run(machine, instrument, runs))
    columns: dict[str, Mapping[str, float]] = {"repeatability": repeated} if repeated else {}
    contributions = {} if budget is None else budget.contributions()
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
        "repeatability_freedom": _freedom(reduced),
        "repeatability_half_range": in_table_units(repeated),
        "reversal_angles_urad": _reversal_angles(evaluation),
        "budget": {name: _in_units(name, part) for name, part in contributions.items()},
        "table": format_table(columns).splitlines() if columns else [],
    }


def _freedom(runs: Sequence[RelativeRun]) -> int | None:
    """Degrees of freedom of the scatter of repeated runs, the fewest of all axes; None without repeats."""
    found = []
    for axis in {run.axis for run in runs}:
        own = [run for run in runs if run.axis == axis]
        if len(own) > 1:
            found.append((len(own) - 1) * max(len(np.unique(own[0].position_mm)) - 2, 1))
    return min(found, default=None)


def _in_units(name: str, part: Mapping[str, float]) -> dict[str, Any]:
    error = error_named(name)
    return {"unit": error.unit, **{source: value / error.si_per_unit for source, value in part.items()}}


def _axis(readings: SixDof, instrument: Instrument, runs: Sequence[RelativeRun]) -> dict[str, Any]:
    """Set-up of one axis, and which systematic parts were taken out by which means."""
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


def _classes(instrument: Instrument, run: RelativeRun) -> tuple[list[str], list[str]]:
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


def _squareness(instrument: Instrument, evaluation: Evaluation) -> dict[str, Any]:
    names = ("EC0Y", "EB0Z", "EA0Z")
    signs = dict(zip(names, instrument.squareness_signs, strict=True))
    short = dict(zip(names, ("S_xy", "S_xz", "S_yz"), strict=True))
    return {
        name: {"of": short[name], "angle_less_arcsec": value / RAD_PER_ARCSEC, "sign": signs[name]}
        for name, value in evaluation.squareness_rad.items()
    }


def _reversal_angles(evaluation: Evaluation) -> dict[str, list[float]]:
    """Mean difference of both directions of the rotations of each axis, urad; none where one way was measured."""
    return {
        AXES[axis]: (1e6 * np.nanmean(entry.reversal[:, 3:], axis=0)).tolist()
        for axis, entry in evaluation.axes.items()
        if entry.reversal is not None
    }
