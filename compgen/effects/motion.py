"""How the machine moved before each reading: runs, their beginnings, and the velocity of each axis."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.effects.readings import Readings

#: Labels whose change begins a new run of the machine.
RUN_LABELS = ("block", "setup", "run", "line", "repeat")
SECONDS_PER_MIN = 60.0
#: An axis that moves by less than this between two stops is at rest, mm.
REST_MM = 1e-6
#: Most scan positions in time.
MOST_TIMES = 200


def run_of(readings: Readings) -> NDArray[np.int64] | None:
    """Number of the run (same block, set-up, run, line, repeat) of each reading, (n,); None without such labels."""
    present = [readings.labels[name] for name in RUN_LABELS if name in readings.labels]
    if not present:
        return None
    _, run = np.unique(np.column_stack(present), axis=0, return_inverse=True)
    return run.ravel().astype(np.int64)


def step_times_s(readings: Readings, rows: NDArray[np.bool_] | None = None) -> list[float]:
    """Times between runs at which something may have changed, at most 200; between stops if there is one run only.

    ``rows`` (n,) takes some of the readings.
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
    several = run is not None and np.any(run[rows] != run[rows][0])
    changed = np.diff(run[rows][order]) != 0 if several and run is not None else np.diff(ordered) > 0
    between = 0.5 * (ordered[1:] + ordered[:-1])[changed & (np.diff(ordered) > 0)]
    if len(between) > MOST_TIMES:
        between = between[np.linspace(0, len(between) - 1, MOST_TIMES).astype(int)]
    return [float(time) for time in between]


def velocity_mm_s(readings: Readings) -> FloatArray | None:
    """Velocity of each axis on the way to each reading in mm/s, (n, 3): feed times the direction of the last motion.

    The motion is that from the stop before in the same run; for the first stop of a run that to the next one. An axis
    at rest has none. Its sign is that of the last approach where this is logged. Without runs and times: approach times
    feed. None without a feed, or where nothing tells the direction.
    """
    feed = readings.covariate("feed_mm_min")
    if feed is None:
        return None
    if run_of(readings) is None and readings.covariate("time_s") is None:
        moved = readings.approach
        return None if moved is None else np.asarray(moved * feed[:, None] / SECONDS_PER_MIN)
    motion = _last_motion(readings)
    length = np.linalg.norm(motion, axis=1, keepdims=True)
    cosine = np.divide(motion, length, out=np.zeros_like(motion), where=length > REST_MM)
    if readings.approach is not None:
        known = readings.approach != 0
        cosine = np.where(known, np.abs(cosine) * readings.approach, cosine)
    return np.asarray(cosine * feed[:, None] / SECONDS_PER_MIN)


def _last_motion(readings: Readings) -> FloatArray:
    """Motion from the stop before to each reading in mm, (n, 3); zero where it is the only stop of its run."""
    run = run_of(readings)
    component = readings.direction.argmax(axis=1) if readings.kind == "deviations" else readings.station
    keys = np.column_stack([np.zeros(len(readings), dtype=np.int64) if run is None else run, component])
    _, sequence = np.unique(keys, axis=0, return_inverse=True)
    time_s = readings.covariate("time_s")
    row = np.arange(len(readings))
    order = np.lexsort((row, row if time_s is None else time_s, sequence.ravel()))
    motion = np.zeros((len(readings), 3))
    ends = np.flatnonzero(np.diff(sequence.ravel()[order], append=-1)) + 1
    for part in np.split(order, ends[:-1]):
        motion[part] = _within(readings.position_mm[part])
    return motion


def _within(position_mm: FloatArray) -> FloatArray:
    """Last motion at the stops (m, 3) of one run in order; a reading repeated at a stop keeps the motion to it."""
    steps = np.diff(position_mm, axis=0)
    moving = np.flatnonzero(np.abs(steps).max(axis=1, initial=0.0) > REST_MM)
    if not len(moving):
        return np.zeros_like(position_mm)
    last = np.searchsorted(moving, np.arange(len(position_mm)), side="left") - 1
    return np.asarray(steps[moving[np.maximum(last, 0)]])
