"""From readings to the 21 errors in one call: reduce every run, turn it into errors of the machine, evaluate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.sixdof.as_printed import printed_run
from compgen.sixdof.evaluation import Evaluation, evaluate
from compgen.sixdof.frames import AxisRun, errors_of_run, expected_away
from compgen.sixdof.instrument import Instrument
from compgen.sixdof.interferometer import growth_mm
from compgen.sixdof.readings import SixDof
from compgen.sixdof.reduction import reduce_runs


def axis_runs(machine: Machine, readings: SixDof, instrument: Instrument) -> list[AxisRun]:
    """Errors of the moved axis over every run; a CompgenWarning where chain and readings contradict each other.

    ``as_printed`` of the instrument takes the paper's own equations in place of the traced ones.
    """
    reduced = reduce_runs(readings, instrument, expected_away(machine, instrument))
    grown = {axis: growth_mm(machine, readings, axis) for axis in {run.axis for run in reduced}}
    runs = [
        printed_run(machine, readings, instrument, run)
        if instrument.as_printed
        else errors_of_run(machine, instrument, run)
        for run in reduced
    ]
    return [_cold(run, grown[run.axis][part.rows]) for run, part in zip(runs, reduced, strict=True)]


def _cold(run: AxisRun, grown_mm: FloatArray) -> AxisRun:
    """The run of a machine whose scales are at 20 degC."""
    if not np.any(grown_mm):
        return run
    delta = run.delta_mm.copy()
    delta[:, run.axis] -= grown_mm
    return replace(run, delta_mm=delta)


def evaluate_readings(machine: Machine, readings: SixDof, instrument: Instrument) -> Evaluation:
    """Return errors, means of the axes, slopes and squareness of all readings."""
    return evaluate(machine, instrument, axis_runs(machine, readings, instrument))


def values_of(errors: ErrorTable) -> FloatArray:
    """All values of a table in the order of its file, (k,), mm and rad."""
    parts = [
        np.array([errors.squareness[name][0]]) if name in errors.squareness else errors.curves[name].value
        for name in errors.names
    ]
    return np.concatenate(parts)
