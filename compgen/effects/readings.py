"""Input of the effects: readings, the motion before each one, Legendre polynomials over the travel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Deviations
from compgen.data.lengths import Lengths, Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, SECONDS_PER_MIN
from compgen.kinematics.first_order import tool_of

# Scalar readings of the tool tip along known directions, on which every effect of the catalogue acts.
#
# Tracer lengths, measured deviations and axis runs differ in what a reading is, not in what moves the tip. A reading
# changes by ``direction . displacement``; a length also has a station and a range.


Kind = Literal["lengths", "deviations", "axis"]


@dataclass(frozen=True)
class Readings:
    """n scalar readings, with everything an effect may depend on.

    Parameters
    ----------
    machine : the machine.
    kind : type of the readings: tracer lengths, components of deviations, or readings of axis runs.
    position_mm : commanded positions, (n, 3).
    direction : unit vectors (n, 3); a displacement d of the tip in the workpiece frame increases the reading by
        ``direction . d`` to first order.
    tool_mm : tool offset, (n, 3).
    stations : names of the stations; empty if there are none.
    station : index into ``stations``, (n,); zeros if there are none.
    range_mm : distance of the tip from the station, (n,); zeros if there is no station.
    approach : last direction of travel of each axis, +1, -1, 0 if unknown, (n, 3); None if none is known.
    covariates : other values by column name (``time_s``, ``feed_mm_min``, ``load_kg``, ``temp_<name>_c``), each (n,).
    labels : integers by column name (line, repeat, block, setup, run, pose), each (n,).
    """

    machine: Machine
    kind: Kind
    position_mm: FloatArray
    direction: FloatArray
    tool_mm: FloatArray
    stations: tuple[str, ...]
    station: NDArray[np.int64]
    range_mm: FloatArray
    approach: FloatArray | None = None
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    labels: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.direction)

    def part(self, rows: NDArray[np.int64]) -> Readings:
        """Return some of the readings; all stations keep their index."""
        return replace(
            self,
            position_mm=self.position_mm[rows],
            direction=self.direction[rows],
            tool_mm=self.tool_mm[rows],
            station=self.station[rows],
            range_mm=self.range_mm[rows],
            approach=None if self.approach is None else self.approach[rows],
            covariates={name: values[rows] for name, values in self.covariates.items()},
            labels={name: values[rows] for name, values in self.labels.items()},
        )

    def covariate(self, name: str) -> FloatArray | None:
        """Return a covariate (n,); None if it was not logged for every reading."""
        logged = self.covariates.get(name)
        return None if logged is None or not np.isfinite(logged).all() else logged

    def temperature_k(self, name: str, reference_c: float | None = None) -> FloatArray | None:
        """Temperature of channel ``temp_<name>_c`` minus ``reference_c``, (n,); default: minus its mean.

        None if it was not logged for every reading, or if it never changed and no reference is given.
        """
        logged = self.covariate(f"temp_{name}_c")
        if logged is None or (reference_c is None and np.ptp(logged) == 0.0):
            return None
        return np.asarray(logged - (logged.mean() if reference_c is None else reference_c))

    def is_from(self, name: str) -> NDArray[np.bool_]:
        """Whether each reading was taken from station ``name``, (n,)."""
        if name not in self.stations:
            return np.zeros(len(self), dtype=np.bool_)
        return np.asarray(self.station == self.stations.index(name))

    def normalised(self, axis: int) -> FloatArray:
        """Position of an axis over its travel, -1 ... +1, (n,)."""
        low, high = self.machine.axes[axis].range_mm
        return np.asarray((2.0 * self.position_mm[:, axis] - low - high) / (high - low))


def readings_of_lengths(machine: Machine, lengths: Lengths, station_mm: FloatArray, tip_mm: FloatArray) -> Readings:
    """Return tracer readings; ``station_mm`` and ``tip_mm`` (n, 3) are station and tip position of each reading."""
    line_mm = tip_mm - station_mm
    range_mm = np.linalg.norm(line_mm, axis=1)
    return Readings(
        machine=machine,
        kind="lengths",
        position_mm=lengths.position_mm,
        direction=line_mm / range_mm[:, None],
        tool_mm=np.broadcast_to(tool_of(machine, lengths.tool_mm), lengths.position_mm.shape),
        stations=lengths.stations,
        station=lengths.station,
        range_mm=range_mm,
        approach=lengths.approach,
        covariates=lengths.covariates,
        labels=lengths.labels,
    )


def readings_of_deviations(machine: Machine, deviations: Deviations) -> Readings:
    """Return the measured components of deviations as readings: all dX, then all dY, then all dZ."""
    measured = ~np.isnan(deviations.deviation_mm)
    row = np.concatenate([np.flatnonzero(measured[:, k]) for k in range(len(AXES))])
    component = np.repeat(np.arange(len(AXES)), measured.sum(axis=0))
    tool_mm = np.broadcast_to(tool_of(machine, deviations.tool_mm), deviations.position_mm.shape)
    return Readings(
        machine=machine,
        kind="deviations",
        position_mm=deviations.position_mm[row],
        direction=np.eye(3)[component],
        tool_mm=tool_mm[row],
        stations=(),
        station=np.zeros(len(row), dtype=np.int64),
        range_mm=np.zeros(len(row)),
        approach=None if deviations.approach is None else deviations.approach[row],
        covariates={name: values[row] for name, values in deviations.covariates.items()},
        labels={name: values[row] for name, values in deviations.labels.items()},
    )


def readings_of_points(machine: Machine, points: Points) -> Readings:
    """Return commanded points as readings, one each, for effects that move the tip; the direction is Z."""
    count = len(points)
    setup = points.covariates.get("setup")
    return Readings(
        machine=machine,
        kind="deviations",
        position_mm=points.position_mm,
        direction=np.broadcast_to([0.0, 0.0, 1.0], (count, 3)),
        tool_mm=np.broadcast_to(tool_of(machine, points.tool_mm), (count, 3)),
        stations=(),
        station=np.zeros(count, dtype=np.int64),
        range_mm=np.zeros(count),
        approach=points.approach,
        covariates={name: values for name, values in points.covariates.items() if name != "setup"},
        labels={} if setup is None else {"setup": setup.astype(np.int64)},
    )


# Machine motion before each reading: runs, their starts, and the velocity of each axis.


#: Labels whose change starts a new run of the machine.
RUN_LABELS = ("block", "setup", "run", "line", "repeat")
#: An axis that moves by less than this between two stops is at rest, mm.
REST_MM = 1e-6
#: Largest number of scan positions in time.
MOST_TIMES = 200


def run_of(readings: Readings) -> NDArray[np.int64] | None:
    """Number of the run (same block, set-up, run, line, repeat) of each reading, (n,); None without such labels."""
    present = [readings.labels[name] for name in RUN_LABELS if name in readings.labels]
    if not present:
        return None
    run = np.zeros(len(readings), dtype=np.int64)
    for label in present:  # one label after another: many times faster than np.unique over rows, with the same numbers
        own = np.unique(label, return_inverse=True)[1]
        run = np.unique(run * (int(own.max(initial=0)) + 1) + own, return_inverse=True)[1].astype(np.int64)
    return run


def step_times_s(readings: Readings, rows: NDArray[np.bool_] | None = None) -> list[float]:
    """Times at which something may have changed: between runs, and between stops as far as there are no more than 200.

    ``rows`` (n,) selects readings.
    """
    time_s = readings.covariate("time_s")
    if time_s is None:
        return []
    rows = np.ones(len(readings), dtype=np.bool_) if rows is None else rows
    if not rows.any():
        return []
    order = np.argsort(time_s[rows], kind="stable")
    ordered = time_s[rows][order]
    run = run_of(readings)
    gap, middle = np.diff(ordered) > 0, 0.5 * (ordered[1:] + ordered[:-1])
    several = run is not None and np.any(run[rows] != run[rows][0])
    changed = gap & (np.diff(run[rows][order]) != 0) if several and run is not None else gap
    between, inside = middle[changed], middle[gap & ~changed]
    if len(between) > MOST_TIMES:
        between = between[np.linspace(0, len(between) - 1, MOST_TIMES).astype(int)]
    room = MOST_TIMES - len(between)
    if len(inside) > room:  # of many runs their ends are enough; within a few long ones, stops close to any event
        few = len(between) < MOST_TIMES // 4
        inside = inside[np.linspace(0, len(inside) - 1, room).astype(int)] if few else inside[:0]
    return [float(time) for time in np.sort(np.concatenate([between, inside]))]


def velocity_mm_s(readings: Readings) -> FloatArray | None:
    """Velocity of each axis on the way to each reading in mm/s, (n, 3): feed times the direction of the last motion.

    The motion is from the previous stop in the same run; for the first stop of a run, to the next one. An axis at rest
    has none. Its sign is the sign of the last approach if this is logged. Without runs and times: approach times feed.
    None without a feed, or if the direction is unknown.
    """
    feed = readings.covariate("feed_mm_min")
    if feed is None:
        return None
    if run_of(readings) is None and readings.covariate("time_s") is None:
        moved = readings.approach
        return None if moved is None else np.asarray(moved * feed[:, None] / SECONDS_PER_MIN)
    # motion from the previous stop to each reading in mm, (n, 3); zero for the only stop of a run
    run, time_s = run_of(readings), readings.covariate("time_s")
    component = readings.direction.argmax(axis=1) if readings.kind == "deviations" else readings.station
    row = np.arange(len(readings))
    keys = np.column_stack([0 * row if run is None else run, component])
    _, sequence = np.unique(keys, axis=0, return_inverse=True)
    order = np.lexsort((row, row if time_s is None else time_s, sequence.ravel()))
    ordered = sequence.ravel()[order]
    steps = np.diff(readings.position_mm[order], axis=0)
    moving = np.flatnonzero((np.abs(steps).max(axis=1, initial=0.0) > REST_MM) & (np.diff(ordered) == 0))
    motion = np.zeros((len(readings), 3))
    if len(moving):
        # the last motion before a reading, kept for repeated readings at a stop; before the first motion of a run: this
        last = np.searchsorted(moving, row, side="left") - 1
        before = (last >= 0) & (ordered[moving[np.maximum(last, 0)]] == ordered)
        taken = moving[np.minimum(np.where(before, last, last + 1), len(moving) - 1)]
        motion[order] = np.where((ordered[taken] == ordered)[:, None], steps[taken], 0.0)
    length = np.linalg.norm(motion, axis=1, keepdims=True)
    cosine = np.divide(motion, length, out=np.zeros_like(motion), where=length > REST_MM)
    if readings.approach is not None:
        known = readings.approach != 0
        cosine = np.where(known, np.abs(cosine) * readings.approach, cosine)
    return np.asarray(cosine * feed[:, None] / SECONDS_PER_MIN)


# Legendre polynomials over the travel of an axis: the shapes of effects that vary with position.


def legendre(s: FloatArray, degrees: range) -> FloatArray:
    """Legendre polynomials P_k(s) of normalised positions (n,) for the given degrees, (n, k).

    >>> legendre(np.array([0.5]), range(1, 3))
    array([[ 0.5  , -0.125]])
    """
    every = np.polynomial.legendre.legvander(s, max(degrees))
    return np.asarray(every[:, list(degrees)])
