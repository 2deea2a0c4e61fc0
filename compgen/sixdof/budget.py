"""Uncertainty of every error: scatter of the readings, and calibration, through the whole reduction by differences."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.errors import CompgenWarning
from compgen.sixdof.calibration import calibration_changes
from compgen.sixdof.chain import axis_runs, evaluate_readings, values_of
from compgen.sixdof.comparison import each_run
from compgen.sixdof.evaluation import AxisErrors, Evaluation, axis_errors, evaluate, evaluate_axes
from compgen.sixdof.frames import errors_of_run, expected_away
from compgen.sixdof.instrument import Instrument
from compgen.sixdof.readings import SixDof
from compgen.sixdof.reduction import RelativeRun, reduce_runs
from compgen.sixdof.scatter import Scatter, moved_run, scatter_of, unit_moves

#: Steps of a body's motion for its derivative: mm and rad; everything behind it is linear but the minimum zone.
STEPS = (1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6)
#: Probability with which runs that differ by the scatter of their readings alone are taken to differ by more.
UNLIKELY = 0.02


@dataclass(frozen=True)
class Budget:
    """What makes the uncertainty of the error values.

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
        for name, rows in _rows_of(self.errors):
            part = {
                source: float(np.sqrt(np.sum(self.factor[rows][:, names == source] ** 2, axis=1)).max())
                for source in dict.fromkeys(self.sources)
            }
            part["combined"] = float(np.sqrt(np.sum(self.factor[rows] ** 2, axis=1)).max())
            result[name] = part
        return result


def _rows_of(errors: ErrorTable) -> Iterator[tuple[str, slice]]:
    first = 0
    for name in errors.names:
        size = 1 if name in errors.squareness else len(errors.curves[name].value)
        yield name, slice(first, first + size)
        first += size


def uncertainty_budget(machine: Machine, readings: SixDof, instrument: Instrument) -> Budget:
    """Propagate scatter, drift monitor and calibration through the whole reduction.

    Parameters
    ----------
    machine, readings, instrument : as for the evaluation; the readings hold true displacements.

    The scatter is that of the stated noise and of repeated runs (:mod:`scatter`); each mean of n runs has 1/sqrt(n) of
    it. Each uncertain constant is moved up and down by its standard uncertainty, and the whole chain repeated.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        runs = axis_runs(machine, readings, instrument)
        errors = evaluate(machine, instrument, runs).errors
        random = _random_columns(machine, readings, instrument)
        columns = [
            *random,
            *_run_to_run(errors, random, each_run(machine, instrument, runs)),
            *_constant_columns(machine, readings, instrument),
        ]
    sources = tuple(source for source, _ in columns)
    size = len(values_of(errors))
    factor = np.column_stack([column for _, column in columns]) if columns else np.zeros((size, 0))
    return Budget(with_u(errors, factor), factor, sources)


def with_u(errors: ErrorTable, factor: FloatArray) -> ErrorTable:
    """The table with the standard uncertainties that a factor (k, r) has; nan where it has none at all."""
    u = np.sqrt(np.einsum("ij,ij->i", factor, factor)) if factor.size else np.full(len(factor), np.nan)
    curves, squareness = {}, {}
    for name, rows in _rows_of(errors):
        if name in errors.squareness:
            squareness[name] = (errors.squareness[name][0], float(u[rows][0]))
        else:
            curves[name] = Curve(errors.curves[name].position_mm, errors.curves[name].value, u[rows])
    return errors.replace(curves=curves, squareness=squareness)


Column = tuple[str, FloatArray]


def _random_columns(machine: Machine, readings: SixDof, instrument: Instrument) -> list[Column]:
    """Responses of the values to the scatter of every target position of every axis."""
    reduced = reduce_runs(readings, instrument, expected_away(machine, instrument))
    by_axis = {axis: [run for run in reduced if run.axis == axis] for axis in sorted({run.axis for run in reduced})}
    means = {axis: _means(machine, instrument, runs) for axis, runs in by_axis.items()}
    columns: list[Column] = []
    for runs in by_axis.values():
        scatter = scatter_of(machine, readings, instrument, runs)
        responses = _responses(machine, instrument, runs, means, scatter)
        for source, covariance in scatter.sources.items():
            for group, response in enumerate(responses):
                root = _root(covariance[group] / scatter.count[group])
                columns += [(source, column) for column in (response @ root).T if np.any(column)]
    return columns


def _run_to_run(errors: ErrorTable, random: Sequence[Column], evaluations: Sequence[Evaluation]) -> list[Column]:
    """What whole runs differ by beyond the scatter of their readings: drift from run to run, slopes above all.

    The variance of the mean of R runs by their differences is compared with that by the scatter; where it is larger
    than chance has it (``UNLIKELY``), the differences themselves are a source, divided by the root of R (R - 1).
    """
    count = len(evaluations)
    if count < 2:
        return []
    tables = [_resampled(item.errors, errors) for item in evaluations]
    part = (np.array(tables) - np.mean(tables, axis=0)) / np.sqrt(count * (count - 1))
    limit = float(chdtri(count - 1, UNLIKELY)) / (count - 1)
    known = sum((column**2 for _, column in random), np.zeros(part.shape[1]))
    kept = np.zeros(part.shape[1], dtype=bool)
    for _, rows in _rows_of(errors):
        kept[rows] = np.mean(np.sum(part[:, rows] ** 2, axis=0)) > limit * np.mean(known[rows])
    return [("run to run", np.where(kept, column, 0.0)) for column in part] if np.any(kept) else []


def _resampled(errors: ErrorTable, like: ErrorTable) -> FloatArray:
    """Values of a table at the positions of another one, in the order of its file."""
    return np.concatenate(
        [
            np.array([errors.squareness[name][0]])
            if name in like.squareness
            else errors.curves[name].at(like.curves[name].position_mm)
            for name in like.names
        ]
    )


def _means(machine: Machine, instrument: Instrument, runs: Sequence[RelativeRun]) -> AxisErrors:
    return axis_errors(machine, [errors_of_run(machine, instrument, run) for run in runs])


def _root(covariance: FloatArray) -> FloatArray:
    """A root F of a covariance (6, 6), F F^T, which may be singular."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    return np.asarray(safe[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def _responses(
    machine: Machine,
    instrument: Instrument,
    runs: Sequence[RelativeRun],
    means: Mapping[int, AxisErrors],
    scatter: Scatter,
) -> list[FloatArray]:
    """Derivatives (k, 6) of all values by the body's motion at each group of readings, moved in all runs at once."""
    axis = runs[0].axis
    at_tool = unit_moves(machine, instrument, runs[0])

    def values(group: int, component: int, step: float) -> FloatArray:
        moved = []
        for run, rows in zip(runs, scatter.rows, strict=True):
            change = np.zeros((len(run.rows), 6))
            change[rows == group, component] = step
            moved.append(moved_run(instrument, run, at_tool, change))
        changed = {**means, axis: _means(machine, instrument, moved)}
        return values_of(evaluate_axes(machine, instrument, changed).errors)

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


def _constant_columns(machine: Machine, readings: SixDof, instrument: Instrument) -> list[Column]:
    """Half of the change of all values between each constant up and down by its standard uncertainty."""

    def values(case: tuple[SixDof, Instrument]) -> FloatArray:
        return values_of(evaluate_readings(machine, *case).errors)

    columns = []
    for source, change in calibration_changes(readings, instrument):
        column = 0.5 * (values(change(1.0)) - values(change(-1.0)))
        if np.any(column):
            columns.append((source, column))
    return columns
