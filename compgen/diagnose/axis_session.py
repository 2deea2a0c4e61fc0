"""One axis of ISO 230-2 runs in time order: readings, cells of repeats, and one-way runs.

A cell is one target in one direction: five runs give five repeats, and their scatter is the noise plus whatever
changes with time. Everything static (the curve of the axis, its reversal) is in the means of the cells and does not
affect the scatter within them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from compgen.data.axis_runs import AxisRuns
from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.diagnose.layout import IntArray
from compgen.effects import Readings
from compgen.errors import InputError

#: Time order of the readings: as logged, run by run up then down, down then up, all up runs first, rows of the file.
Order = Literal["auto", "up-down", "down-up", "one-way", "rows"]
ORDERS: tuple[Order, ...] = get_args(Order)
ORDER_TEXTS = {
    "time": "time_s",
    "label": "the column order",
    "up-down": "run by run, up then down",
    "down-up": "run by run, down then up",
    "one-way": "all runs up, then all runs down",
    "rows": "the rows of the file",
}
#: Resolution of the readings where nothing coarser is known: no scatter is assumed to be smaller, mm.
LEAST_MM = 2e-6
#: Readings are on a grid if this share of them is, within this share of its step; so many different ones show it.
ON_GRID, OFF_GRID, LEAST_VALUES = 0.999, 2e-3, 3
#: Steps that displays have, metric and inch, in units of a decimal place, the coarsest first.
DISPLAY_STEPS = (5.08, 5.0, 2.54, 2.5, 2.0, 1.27, 1.0)
#: Targets closer than this are the same target, mm.
SAME_TARGET_MM = 1e-4


@dataclass(frozen=True)
class AxisSession:
    """n readings of one axis in time order.

    Parameters
    ----------
    machine, axis : the machine, and the axis 0, 1, 2.
    row : row of each reading in the given runs.
    position_mm, direction, run, deviation_mm : as in :class:`AxisRuns`, each (n,).
    target : number of the target, ascending in position, (n,).
    cell : number of target and direction, (n,).
    leg : number of the one-way run in time, from 0, (n,).
    cycle : number of the run in time, from 0; both directions of a run have the same number, (n,).
    time : time in s if ``timed``, else number of the reading, (n,).
    timed : whether times were logged and used.
    order : where the order comes from, a key of ``ORDER_TEXTS``.
    readings : the same readings in the form that the effects of the catalogue use.
    step_mm : step in which the readings were displayed or logged, 0 if there is none.
    """

    machine: Machine
    axis: int
    row: IntArray
    position_mm: FloatArray
    direction: IntArray
    run: IntArray
    deviation_mm: FloatArray
    target: IntArray
    cell: IntArray
    leg: IntArray
    cycle: IntArray
    time: FloatArray
    timed: bool
    order: str
    readings: Readings
    step_mm: float = 0.0

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.row)

    @property
    def letter(self) -> str:
        """Letter of the axis."""
        return AXES[self.axis]

    @property
    def least_mm(self) -> float:
        """Least standard deviation of a reading, mm: that of rounding to the step of the readings."""
        return max(LEAST_MM, self.step_mm / float(np.sqrt(12.0)))

    @property
    def targets_mm(self) -> FloatArray:
        """Targets, ascending."""
        return self.position_mm[np.unique(self.target, return_index=True)[1]]

    @property
    def s(self) -> FloatArray:
        """Position over the measured range, -1 ... +1, (n,)."""
        low, high = self.targets_mm[[0, -1]]
        return np.asarray((2.0 * self.position_mm - low - high) / max(high - low, 1e-9))

    @property
    def both(self) -> IntArray:
        """Targets that were read in both directions."""
        return np.intersect1d(self.target[self.direction > 0], self.target[self.direction < 0])

    @property
    def repeated(self) -> bool:
        """Whether most readings have repeats in their cells."""
        return float(np.mean(np.bincount(self.cell)[self.cell] > 1)) >= 0.5

    @property
    def in_runs(self) -> bool:
        """Whether it was measured run by run; measured target by target, it has no bad runs or steps between runs."""
        return len(self) >= 2.5 * (int(self.leg.max()) + 1)

    def run_means_mm(self, values_mm: FloatArray, used: NDArray[np.bool_]) -> FloatArray:
        """Means of the runs up and down without the curve of the axis, mm, (ways, runs); each way has zero mean.

        Only readings ``used`` (n,) count; a run without a target is compared at the others. NaN: run without readings.
        """
        runs, targets = np.eye(int(self.cycle.max()) + 1)[self.cycle], np.eye(len(self.targets_mm))[self.target]
        means = []
        for way in np.unique(self.direction[used]):
            own = used & (self.direction == way)
            design = np.hstack([runs[own], targets[own]])
            found = np.linalg.lstsq(design, values_mm[own], rcond=None)[0][: runs.shape[1]]
            found[~runs[own].any(axis=0)] = np.nan
            means.append(found - np.nanmean(found))
        return np.array(means)

    @property
    def cycle_span(self) -> float:
        """Mean duration of a run there and back, in the unit of ``time``."""
        span = float(self.time[-1] - self.time[0]) * len(self) / max(len(self) - 1, 1)
        return span / (int(self.cycle.max()) + 1)

    def place(self, k: int) -> str:
        """Describe reading ``k``."""
        way = "up" if self.direction[k] > 0 else "down"
        return f"run {self.run[k]} {way} at {self.position_mm[k]:g} mm"

    def window(self, first: int, last: int) -> str:
        """Describe readings ``first`` ... ``last``: a run, one direction of a run, or readings from .. to .."""
        rows = np.arange(first, last + 1)
        legs = np.unique(self.leg[rows])
        if 1 < len(rows) == np.count_nonzero(np.isin(self.leg, legs)):
            if len(legs) == 1:
                return f"run {self.run[first]} {'up' if self.direction[first] > 0 else 'down'}"
            if len(np.unique(self.run[rows])) == 1:
                return f"run {self.run[first]}"
        return self.place(first) if first == last else f"from {self.place(first)} to {self.place(last)}"

    def part(self, kept: IntArray) -> AxisSession:
        """Return some of the readings; run numbers and times are unchanged."""
        names = ("row", "position_mm", "direction", "run", "deviation_mm", "target", "leg", "cycle", "time")
        taken = {name: getattr(self, name)[kept] for name in names}
        _, cell = np.unique(self.cell[kept], return_inverse=True)
        return replace(self, **taken, cell=cell.ravel(), readings=self.readings.part(kept))


def sessions_of(machine: Machine, runs: AxisRuns, order: Order = "auto") -> list[AxisSession]:
    """Return the readings of each axis separately, in time order."""
    found = []
    for axis in runs.axes:
        rows = np.flatnonzero(runs.axis == axis)
        sequence, time, source = _in_time(runs, rows, order)
        rows = rows[sequence]
        position, direction, run = runs.position_mm[rows], runs.direction[rows], runs.run[rows]
        _, target = np.unique(np.round(position / SAME_TARGET_MM), return_inverse=True)
        _, cell = np.unique(2 * target.ravel() + (direction > 0), return_inverse=True)
        changed = np.diff(run) != 0
        leg = np.cumsum(np.concatenate([[False], changed | (np.diff(direction) != 0)])).astype(np.int64)
        # a run there and back by its label, or two one-way runs if each has a separate number
        cycle = np.cumsum(np.concatenate([[False], changed])).astype(np.int64)
        single = all(len(np.unique(direction[cycle == k])) == 1 for k in range(int(cycle.max()) + 1))
        if single and len(np.unique(direction)) == 2:
            cycle = leg // 2
        number = np.arange(len(rows), dtype=np.float64)
        readings = _readings(machine, runs, axis, rows, number, timed=source == "time")
        found.append(
            AxisSession(
                machine, axis, rows, position, direction, run, runs.deviation_mm[rows], target.ravel(), cell.ravel(),
                leg, cycle, time, source == "time", source, readings, resolution_mm(runs, rows),
            )
        )  # fmt: skip
    return found


def resolution_mm(runs: AxisRuns, rows: IntArray) -> float:
    """Step of the readings, mm: as the file states it (``# resolution_um = 1``), and no less than that of the numbers."""
    text = runs.metadata.get("resolution_um", "0")
    try:
        stated = float(text)
    except ValueError:
        stated = np.nan
    if not 0.0 <= stated < np.inf:
        message = f"{text[:40]!r} is not a resolution; expected a number in um, e.g. # resolution_um = 0.1"
        raise InputError(message, file=runs.origin[0][0] if runs.origin else None, field="comment resolution_um")
    return max(stated * MM_PER_UM, grid_step_mm(runs.deviation_mm[rows]))


def grid_step_mm(values_mm: FloatArray) -> float:
    """Coarsest step of a display (metric or inch) of which all values are multiples, mm; 0 if none.

    Differences count, as a reading may have been set to zero anywhere.
    """
    off = values_mm - values_mm[0]
    for decimal in range(-1, -7, -1):
        for unit in DISPLAY_STEPS:
            step = unit * 10.0**decimal
            number = np.round(off / step)
            on_grid = np.mean(np.abs(off / step - number) < OFF_GRID) >= ON_GRID
            if on_grid and len(np.unique(number)) >= LEAST_VALUES:
                return step
    return 0.0


def _in_time(runs: AxisRuns, rows: IntArray, order: Order) -> tuple[IntArray, FloatArray, str]:
    """Rows in time order, the time of each (s, or number of the reading), and where the order comes from.

    The order of the rows is used only on request: files are sorted by direction or by target far more often than by
    time.
    """
    run, way = runs.run[rows], runs.direction[rows]
    along = runs.position_mm[rows] * way
    keys = {
        "up-down": (along, -way, run),
        "down-up": (along, way, run),
        "one-way": (along, run, -way),
    }
    number = np.arange(len(rows), dtype=np.float64)
    if order == "rows":
        return np.arange(len(rows)), number, "rows"
    if order in keys:
        return np.lexsort(keys[order]), number, order
    for name, source in (("time_s", "time"), ("order", "label")):
        logged = runs.covariates.get(name)
        if logged is None or not np.isfinite(logged[rows]).all() or np.ptp(logged[rows]) == 0.0:
            continue
        # readings with the same time (one time per run) are sorted as the axis moves
        sequence = np.lexsort((*keys["up-down"], logged[rows]))
        distinct = len(np.unique(logged[rows])) == len(rows)
        return (
            sequence,
            logged[rows][sequence] if distinct and source == "time" else number,
            (source if distinct else "label"),
        )
    return np.lexsort(keys["up-down"]), number, "up-down"


def _readings(
    machine: Machine, runs: AxisRuns, axis: int, rows: IntArray, number: FloatArray, *, timed: bool
) -> Readings:
    count = len(rows)
    position = np.tile(np.asarray(machine.reference_point_mm, dtype=np.float64), (count, 1))
    position[:, axis] = runs.position_mm[rows]
    approach = np.zeros((count, 3))
    approach[:, axis] = runs.direction[rows]
    covariates = {name: values[rows] for name, values in runs.covariates.items() if timed or name != "time_s"}
    return Readings(
        machine=machine,
        kind="axis",
        position_mm=position,
        direction=np.tile(np.eye(3)[axis], (count, 1)),
        tool_mm=np.tile(np.asarray(machine.tool_offset_mm, dtype=np.float64), (count, 1)),
        stations=(),
        station=np.zeros(count, dtype=np.int64),
        range_mm=np.zeros(count),
        approach=approach,
        covariates={**covariates, "order": number},
        labels={"run": runs.run[rows]},
    )
