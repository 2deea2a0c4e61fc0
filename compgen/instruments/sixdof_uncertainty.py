"""Scatter, calibration and uncertainty budget of a six-DOF measurement.

:func:`uncertainty_budget` propagates the scatter of the readings (:func:`scatter_of`) and everything that calibration
leaves uncertain (:func:`calibration_changes`) through the whole reduction by finite differences.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine
from compgen.data.names import AXES
from compgen.errors import CompgenWarning
from compgen.instruments.sixdof_evaluation import (
    AxisErrors,
    Evaluation,
    KnownAxes,
    axis_errors,
    axis_runs,
    each_run,
    evaluate,
    evaluate_axes,
    evaluate_readings,
)
from compgen.instruments.sixdof_instrument import (
    DIRECTIONS,
    ROTATIONS,
    U_CONSTANTS,
    Optics,
    SixDof,
    SixDofInstrument,
    known_systematics,
)
from compgen.instruments.sixdof_reduction import (
    RelativeRun,
    errors_of_run,
    expected_away,
    motion_of_unit,
    reduce_runs,
    relative_motion,
)

# Scatter of single readings: stated noise of the detectors, and additional scatter of repeated runs.
#
# Scatter is described where it arises: as motion of the body (translations and rotations of target or unit, (6,), before
# anything is zeroed), because an angle scatters together with the straightness that its arm causes.


DETECTORS = {
    "displacement_mm": "displacement",
    "y_qd1_mm": "qd",
    "z_qd1_mm": "qd",
    "z_qd2_mm": "qd",
    "y_psd1_mm": "psd",
    "z_psd1_mm": "psd",
}
MONITOR = {"y_psd2_mm": "psd", "z_psd2_mm": "psd"}
#: Steps of a signal for its derivative, mm; the reduction is linear in it.
STEP_MM = 1e-3


@dataclass(frozen=True)
class Scatter:
    """Covariance of one reading of an axis by source, each (groups, 6, 6), mm and rad.

    A group is a target position in one direction of travel; ``rows`` gives the group of each row of each run.
    """

    axis: int
    rows: tuple[NDArray[np.int64], ...]
    count: FloatArray
    sources: dict[str, FloatArray]


def body_motion(instrument: SixDofInstrument, run: RelativeRun, at_tool: bool) -> FloatArray:
    """Motion (n, 6) of the target, or of the unit if ``at_tool``, in machine axes, mm and rad."""
    if not at_tool:
        return np.hstack([run.shift_mm, run.turn_rad])
    return np.hstack(motion_of_unit(instrument, run))


def moved_run(instrument: SixDofInstrument, run: RelativeRun, at_tool: bool, change: FloatArray) -> RelativeRun:
    """The run with the body moved by ``change`` (n, 6) further; relative to its first row, as :func:`reduce_runs`."""
    if at_tool:
        beam = instrument.axes[run.axis].set_up.beam_direction * np.eye(3)[run.axis]
        reach = (run.distance_mm + instrument.optics.lever_mm(run.axis))[:, None] * beam
        turn = -change[:, 3:]
        shift = np.cross(turn, reach) - change[:, :3]
    else:
        shift, turn = change[:, :3], change[:, 3:]
    return replace(run, shift_mm=run.shift_mm + shift - shift[0], turn_rad=run.turn_rad + turn - turn[0])


def unit_moves(machine: Machine, instrument: SixDofInstrument, run: RelativeRun) -> bool:
    """Whether the errors are computed from the motion of the unit."""
    if run.away == expected_away(machine, instrument)[run.axis]:
        return run.away < 0
    return instrument.axes[run.axis].set_up.mode == 2


def groups_of(runs: Sequence[RelativeRun]) -> tuple[tuple[NDArray[np.int64], ...], int]:
    """Group of each row of each run by position (0.1 um) and direction, and how many groups there are."""
    keys = [np.column_stack([np.round(run.position_mm, 4), run.direction]) for run in runs]
    found, index = np.unique(np.vstack(keys), axis=0, return_inverse=True)
    ends = np.cumsum([len(key) for key in keys])[:-1]
    return tuple(part.astype(np.int64) for part in np.split(index.ravel(), ends)), len(found)


def scatter_of(
    machine: Machine, readings: SixDof, instrument: SixDofInstrument, runs: Sequence[RelativeRun]
) -> Scatter:
    """Scatter of the readings of one axis, whose runs are ``runs``.

    The stated noise counts unchanged. Additional scatter of repeated runs (each run without an offset and a line, which
    come from its first row) is the source ``repeatability``. Without repeats and without stated noise the differences
    of neighbouring positions are used instead.
    """
    rows, size = groups_of(runs)
    count = np.bincount(np.concatenate(rows), minlength=size).astype(np.float64)
    at_tool = unit_moves(machine, instrument, runs[0])
    stated = _stated(readings, instrument, runs, rows, size, at_tool) if instrument.noise else {}
    motion = [body_motion(instrument, run, at_tool) for run in runs]
    observed = _repeats(runs, motion, rows, size) if len(runs) > 1 else None
    if observed is None and not stated:  # second differences of neighbours, almost zero for a smooth curve
        seconds = [values[2:] - 2 * values[1:-1] + values[:-2] for values in motion if len(values) > 3]
        observed = np.diag(np.mean(np.vstack(seconds) ** 2, axis=0) / 6.0) if seconds else np.zeros((6, 6))
    sources = dict(stated)
    if observed is not None:
        known = sum((value.mean(axis=0) for value in stated.values()), np.zeros((6, 6)))
        if np.any(known):  # the part beyond what is known
            observed = np.diag(np.maximum(np.diag(observed) - np.diag(known), 0.0))
        sources["repeatability"] = np.tile(observed, (size, 1, 1))
    return Scatter(runs[0].axis, rows, count, sources)


def _repeats(
    runs: Sequence[RelativeRun], motion: Sequence[FloatArray], rows: Sequence[NDArray[np.int64]], size: int
) -> FloatArray | None:
    """Covariance (6, 6) of single readings about the mean of the runs; None if too few positions are repeated."""
    total, weight = np.zeros((6, 6)), 0.0
    table = np.full((len(runs), size, 6), np.nan)
    for table_run, values, index in zip(table, motion, rows, strict=True):
        table_run[index] = values
    position = np.full(size, np.nan)
    for run, index in zip(runs, rows, strict=True):
        position[index] = run.position_mm
    whole = ~np.isnan(table).any(axis=(0, 2))
    if np.count_nonzero(whole) < 4:
        return None
    rest = table[:, whole] - table[:, whole].mean(axis=0)
    line = np.column_stack([np.ones(int(whole.sum())), position[whole]])
    for values in rest:
        left = values - line @ np.linalg.lstsq(line, values, rcond=None)[0]
        total += left.T @ left
        weight += len(left) - 2
    freedom = weight * (len(runs) - 1) / len(runs)
    return total / freedom * student_variance(freedom)


def student_variance(freedom: float) -> float:
    """Variance of Student's t for these degrees of freedom: the factor for a variance from few readings."""
    return freedom / max(freedom - 2.0, 0.5)


def _stated(
    readings: SixDof,
    instrument: SixDofInstrument,
    runs: Sequence[RelativeRun],
    rows: Sequence[NDArray[np.int64]],
    size: int,
    at_tool: bool,
) -> dict[str, FloatArray]:
    """Covariances (groups, 6, 6) of the body's motion by the stated noise of detectors and drift monitor.

    The motion per mm of a signal, (n, 6), is found by finite differences of the actual reduction.
    """

    def motion(run: RelativeRun, name: str, step: float) -> FloatArray:
        moved = replace(readings, signals_mm={**readings.signals_mm, name: readings.signals_mm[name] + step})
        zero = np.zeros(len(run.rows))
        roles = relative_motion(moved, instrument, run.rows, run.axis, run.distance_mm, zero)
        part = replace(run, shift_mm=np.zeros((len(zero), 3)), turn_rad=np.zeros((len(zero), 3)))
        part.shift_mm[:, list(DIRECTIONS[run.axis])] = roles[:, :3]
        part.turn_rad[:, list(ROTATIONS[run.axis])] = roles[:, 3:]
        return body_motion(instrument, part, at_tool)

    result = {}
    for source, channels in (("detectors", DETECTORS), ("drift monitor", MONITOR)):
        covariance = np.zeros((size, 6, 6))
        for run, index in zip(runs, rows, strict=True):
            columns = [
                instrument.noise.get(kind, 0.0)
                * ((motion(run, name, STEP_MM) - motion(run, name, -STEP_MM)) / (2.0 * STEP_MM))
                for name, kind in channels.items()
            ]
            covariance[index] = sum(np.einsum("ni,nj->nij", column, column) for column in columns)
        result[source] = covariance
    return result


# Everything that calibration leaves uncertain, as changes of readings and instrument by standard uncertainties.


#: Parameters of the beams, one for all axes; the others belong to the prism or the target of one axis.
SHARED = ("eps_PEy", "eps_PEz")
Case = tuple[SixDof, SixDofInstrument]
#: Returns readings and instrument changed by a step of the uncertain quantity.
Change = Callable[[float], Case]


def calibration_changes(readings: SixDof, instrument: SixDofInstrument) -> Iterator[tuple[str, float, Change]]:
    """Everything that calibration leaves uncertain: its name, its standard uncertainty, and the change by a step."""
    u = {name: instrument.u_constants.get(name, 0.0) for name in U_CONSTANTS}
    cases: list[tuple[str, float, str, Sequence[str], Sequence[int]]] = []  # name, u, what changes, its names, axes
    cases += [(item.name, u[item.name], "optics", (item.name,), ()) for item in fields(Optics)]
    for axis in instrument.axes:
        cases.append((f"distance of {AXES[axis]}", u["distance_first_mm"], "distance", (), (axis,)))
        drift_mm = u["parallel_drift_um"] * 1e-3
        cases += [("parallel drift", drift_mm, "drift", (f"{k}_qd1_mm", f"{k}_qd2_mm"), (axis,)) for k in "yz"]
    cases.append(("drift gain", u["drift_gain_percent"] / 100.0, "scale", ("y_psd2_mm", "z_psd2_mm"), ()))
    cases.append(("wavelength", u["displacement_ppm"] * 1e-6, "scale", ("displacement_mm",), ()))
    for name, u_value in instrument.u_systematics.items():
        having = [axis for axis in instrument.axes if name in known_systematics(axis)]
        for axes in [having] if name in SHARED else [[axis] for axis in having]:
            where = "" if name in SHARED or len(having) == 1 else f" of {AXES[axes[0]]}"
            cases.append((name + where, u_value if axes else 0.0, "systematic", (name,), axes))
    for source, u_source, what, names, on in cases:
        if u_source > 0:
            yield source, u_source, partial(_changed, readings, instrument, what, names, on)


def _changed(
    readings: SixDof, instrument: SixDofInstrument, what: str, names: Sequence[str], on: Sequence[int], step: float
) -> Case:
    """Readings and instrument changed by a step of an optical constant, a systematic parameter, L, a scale or drift."""
    axes, signals = dict(instrument.axes), dict(readings.signals_mm)
    if what == "optics":
        values = {name: getattr(instrument.optics, name) + step for name in names}
        return readings, replace(instrument, optics=replace(instrument.optics, **values))
    if what == "systematic":
        for axis in on:
            changed = {name: axes[axis].systematics.get(name, 0.0) + step for name in names}
            axes[axis] = replace(axes[axis], systematics={**axes[axis].systematics, **changed})
        return readings, replace(instrument, axes=axes)
    if what == "distance":
        for axis in on:
            first = axes[axis].distance_first_mm
            axes[axis] = replace(axes[axis], distance_first_mm=None if first is None else first + step)
        distance = readings.distance_mm + np.where(np.isin(readings.axis, on), step, 0.0)
        return replace(readings, distance_mm=distance), replace(instrument, axes=axes)
    if what == "scale":
        signals |= {name: signals[name] * (1 + step) for name in names}
        return replace(readings, signals_mm=signals), instrument
    # both beams shift parallel to themselves by this amount from the first to the last row of each run of the axis
    ramp_mm = np.zeros(len(readings))
    for which, _, rows in readings.runs():
        if which in on:
            ramp_mm[rows] = np.linspace(0.0, step, len(rows))
    signals |= {name: signals[name] - ramp_mm for name in names if name in signals}
    return replace(readings, signals_mm=signals), instrument


# Uncertainty of every error: scatter and calibration, propagated through the whole reduction by finite differences.


#: Steps of a body's motion for its derivative: mm and rad; all later steps are linear except the minimum zone.
STEPS = (1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6)
#: Probability of a false alarm: runs that differ only by the scatter of their readings are taken to differ by more.
UNLIKELY = 0.02


@dataclass(frozen=True)
class SixDofBudget:
    """The uncertainty budget of the error values.

    Parameters
    ----------
    errors : the errors with their combined standard uncertainties.
    factor : (k, r): ``factor @ factor.T`` is the covariance of the values in the order of the errors file, mm and rad.
    sources : name of the source of each column, (r,).
    """

    errors: ErrorTable
    factor: FloatArray
    sources: tuple[str, ...]

    def contributions(self) -> dict[str, dict[str, float]]:
        """Largest standard uncertainty over the travel by error and source, and ``combined``, mm and rad."""
        names = np.array(self.sources)
        result = {}
        for name, rows in self.errors.rows().items():
            part = {
                source: float(np.sqrt(np.sum(self.factor[rows][:, names == source] ** 2, axis=1)).max())
                for source in dict.fromkeys(self.sources)
            }
            part["combined"] = float(np.sqrt(np.sum(self.factor[rows] ** 2, axis=1)).max())
            result[name] = part
        return result


def uncertainty_budget(machine: Machine, readings: SixDof, instrument: SixDofInstrument) -> SixDofBudget:
    """Propagate scatter, drift monitor and calibration through the whole reduction.

    Parameters
    ----------
    machine, readings, instrument : as for the evaluation; the readings contain true displacements.

    The scatter comes from the stated noise and repeated runs (:func:`scatter_of`); each mean of n runs has 1/sqrt(n) of
    it. Each uncertain constant is moved up and down by its standard uncertainty, and the whole chain is repeated.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        runs = axis_runs(machine, readings, instrument)
        errors = evaluate(machine, instrument, runs).errors
        # responses of the values to the scatter of every target position of every axis
        columns: list[Column] = []
        reduced = reduce_runs(readings, instrument, expected_away(machine, instrument))
        measured = sorted({run.axis for run in reduced})
        by_axis = {axis: [run for run in reduced if run.axis == axis] for axis in measured}
        means = {axis: _means(machine, instrument, part) for axis, part in by_axis.items()}
        for part in by_axis.values():
            scatter = scatter_of(machine, readings, instrument, part)
            responses = _responses(machine, instrument, part, means, scatter)
            for source, covariance in scatter.sources.items():
                for group, response in enumerate(responses):
                    root = _root(covariance[group] / scatter.count[group])
                    columns += [(source, column) for column in (response @ root).T if np.any(column)]
        columns += _run_to_run(errors, columns, each_run(machine, instrument, runs))
        # half of the change of all values between each constant up and down by its standard uncertainty
        for source, u, changed in calibration_changes(readings, instrument):
            up, down = (evaluate_readings(machine, *changed(step)).errors.values() for step in (u, -u))
            if np.any(up - down):
                columns.append((source, 0.5 * (up - down)))
    sources = tuple(source for source, _ in columns)
    size = len(errors.values())
    factor = np.column_stack([column for _, column in columns]) if columns else np.zeros((size, 0))
    return SixDofBudget(with_u(errors, factor), factor, sources)


def with_u(errors: ErrorTable, factor: FloatArray) -> ErrorTable:
    """The table with the standard uncertainties of a factor (k, r); nan if the factor is empty."""
    u = np.sqrt(np.einsum("ij,ij->i", factor, factor)) if factor.size else np.full(len(factor), np.nan)
    return errors.with_values(u=u)


Column = tuple[str, FloatArray]


def _run_to_run(errors: ErrorTable, random: Sequence[Column], evaluations: Sequence[Evaluation]) -> list[Column]:
    """Differences of whole runs beyond the scatter of their readings: run-to-run drift, mainly slopes.

    The variance of the mean of R runs from their differences is compared with the variance from the scatter; if it is
    larger than chance explains (``UNLIKELY``), the differences are a source, divided by the root of R (R - 1).
    """
    count = len(evaluations)
    if count < 2:
        return []
    from scipy.special import chdtri  # imported here: slow to load, and not needed for a single run

    tables = []  # the values of each at the positions of the errors
    for item in evaluations:
        curves = {name: item.errors.curves[name].at(curve.position_mm) for name, curve in errors.curves.items()}
        constants = {name: np.array([item.errors.squareness[name][0]]) for name in errors.squareness}
        tables.append(np.concatenate([{**curves, **constants}[name] for name in errors.names]))
    part = (np.array(tables) - np.mean(tables, axis=0)) / np.sqrt(count * (count - 1))
    limit = float(chdtri(count - 1, UNLIKELY)) / (count - 1)
    known = sum((column**2 for _, column in random), np.zeros(part.shape[1]))
    kept = np.zeros(part.shape[1], dtype=bool)
    for rows in errors.rows().values():
        kept[rows] = np.mean(np.sum(part[:, rows] ** 2, axis=0)) > limit * np.mean(known[rows])
    return [("run to run", np.where(kept, column, 0.0)) for column in part] if np.any(kept) else []


def _means(machine: Machine, instrument: SixDofInstrument, runs: Sequence[RelativeRun]) -> AxisErrors:
    return axis_errors(machine, [errors_of_run(machine, instrument, run) for run in runs])


def _root(covariance: FloatArray) -> FloatArray:
    """A root F of a covariance (6, 6), F F^T, which may be singular."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    return np.asarray(safe[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def _responses(
    machine: Machine,
    instrument: SixDofInstrument,
    runs: Sequence[RelativeRun],
    means: Mapping[int, AxisErrors],
    scatter: Scatter,
) -> list[FloatArray]:
    """Derivatives (k, 6) of all values by the body's motion at each group of readings, moved in all runs at once."""
    axis = runs[0].axis
    at_tool = unit_moves(machine, instrument, runs[0])
    known: KnownAxes = {}  # the other axes stay as they are

    def values(group: int, component: int, step: float) -> FloatArray:
        moved = []
        for run, rows in zip(runs, scatter.rows, strict=True):
            change = np.zeros((len(run.rows), 6))
            change[rows == group, component] = step
            moved.append(moved_run(instrument, run, at_tool, change))
        changed = {**means, axis: _means(machine, instrument, moved)}
        return evaluate_axes(machine, instrument, changed, known).errors.values()

    base = values(-1, 0, 0.0)
    two_sided = instrument.line == "minzone"
    found = []
    for group in range(len(scatter.count)):
        response = np.empty((len(base), 6))
        for component, step in enumerate(STEPS):
            other = values(group, component, -step) if two_sided else base
            response[:, component] = (values(group, component, step) - other) / (step * (1 + two_sided))
        found.append(response)
    return found
