"""Axis runs (ISO 230-2) as scalar readings.

Each target has a free value of its own, so that only what changes with direction, time or temperature can show.
"""

from __future__ import annotations

import numpy as np

from compgen.core.axis_runs import AxisRuns
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.diagnose.base import BaseFit
from compgen.diagnose.basis import CurveBasis
from compgen.diagnose.layout import IntArray, layout_of
from compgen.diagnose.observed import Observed, Poses
from compgen.effects import Readings


class ObservedAxis(Observed):
    """Deviations along axes; the placement holds the mean deviation at every target of every axis."""

    def __init__(self, machine: Machine, runs: AxisRuns) -> None:
        self.machine, self.runs = machine, runs
        self.value_mm = runs.deviation_mm
        targets = np.column_stack([runs.axis, np.round(runs.position_mm, 6)])
        unique, inverse = np.unique(targets, axis=0, return_inverse=True)
        self.target = inverse.ravel().astype(np.int64)
        self.placement_names = tuple(f"{AXES[int(axis)]} at {place:g} mm" for axis, place in unique)
        self._reads = _readings(machine, runs)
        self.poses = Poses(self._reads.position_mm, self._reads.tool_mm, np.arange(len(runs)))
        channel = np.zeros(len(runs), dtype=np.int64)
        self.layout = layout_of(self._reads, channel, np.arange(len(runs)))

    def start(self) -> FloatArray:
        """All means zero."""
        return np.zeros(len(self.placement_names))

    def placed(self, tip_mm: FloatArray, placement: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean at the target of each reading."""
        columns = np.zeros((len(self.value_mm), len(placement)))
        columns[np.arange(len(self.value_mm)), self.target] = 1.0
        return placement[self.target], self._reads.direction, columns

    def readings(self, tip_mm: FloatArray, placement: FloatArray) -> Readings:
        """Readings along the axes."""
        return self._reads

    def part(self, rows: IntArray) -> ObservedAxis:
        """Return some of the readings."""
        runs = self.runs
        covariates = {name: values[rows] for name, values in runs.covariates.items()}
        taken = AxisRuns(
            runs.axis[rows], runs.position_mm[rows], runs.direction[rows], runs.run[rows], runs.deviation_mm[rows],
            covariates,
        )  # fmt: skip
        return ObservedAxis(self.machine, taken)


def _readings(machine: Machine, runs: AxisRuns) -> Readings:
    count = len(runs)
    position = np.tile(np.asarray(machine.reference_point_mm, dtype=np.float64), (count, 1))
    position[np.arange(count), runs.axis] = runs.position_mm
    approach = np.zeros((count, 3))
    approach[np.arange(count), runs.axis] = runs.direction
    return Readings(
        machine=machine,
        kind="axis",
        position_mm=position,
        direction=np.eye(3)[runs.axis],
        tool_mm=np.tile(np.asarray(machine.tool_offset_mm, dtype=np.float64), (count, 1)),
        stations=(),
        station=np.zeros(count, dtype=np.int64),
        range_mm=np.zeros(count),
        approach=approach,
        covariates=dict(runs.covariates),
        labels={"run": runs.run, "line": runs.axis},
    )


def fit_axis(observed: ObservedAxis) -> BaseFit:
    """Fit the mean at every target."""
    placement = np.bincount(observed.target, observed.value_mm) / np.bincount(observed.target)
    model, _, columns = observed.placed(observed.value_mm, placement)
    basis = CurveBasis(observed.machine, (), (0, 0, 0))
    residual = observed.value_mm - model
    reads = observed.readings(observed.value_mm, placement)
    return BaseFit(observed, basis, placement, residual, columns, observed.placement_names, reads)
