"""Stops, runs, conditions and repeats of a measurement: which readings were taken together, and which were repeated.

A stop is one position at one time; its channels are the stations that read there, or the components of a deviation. A
run is a sequence of stops under one condition; stops of one cell agree in everything that an effect depends on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.effects import Readings

IntArray = NDArray[np.int64]

#: Positions, loads and feeds that differ by less than this are equal, mm (kg, mm/min).
SAME = 1e-4
#: Approach directions, also of axes at rest, distinguish stops if at least this share of the repeats remains.
ENOUGH_PAIRS = 0.9


@dataclass(frozen=True)
class Block:
    """Stops read by the same channels: ``rows`` (T, c) of readings in time order; ``stop`` (T,)."""

    rows: IntArray
    stop: IntArray

    @property
    def channels(self) -> int:
        """Number of channels of each stop."""
        return int(self.rows.shape[1])


@dataclass(frozen=True)
class MeasurementLayout:
    """The structure of a measurement; T stops, n readings.

    Parameters
    ----------
    stop, channel : index of stop (ascending in time) and channel of each reading, (n,).
    time : time of each stop in s, or its number in the file, (T,).
    timed : whether ``time`` is in s.
    run, condition, cell : labels of each stop, (T,); runs are numbered in time, equal cells are repeats.
    in_run : number of the stop within its run, standardised, (T,).
    blocks : stops grouped by their channels.
    kept : cache of what depends on the layout alone.
    """

    stop: IntArray
    channel: IntArray
    time: FloatArray
    timed: bool
    run: IntArray
    condition: IntArray
    cell: IntArray
    in_run: FloatArray
    blocks: tuple[Block, ...]
    kept: dict[Any, Any] = field(default_factory=dict)

    @property
    def stops(self) -> int:
        """Number of stops."""
        return len(self.time)

    @property
    def repeated(self) -> float:
        """Share of stops whose cell was measured more than once."""
        return _repeated(self.cell)


def _repeated(cell: IntArray) -> float:
    return float(np.mean(np.bincount(cell)[cell] > 1))


def _codes(columns: Sequence[FloatArray]) -> IntArray:
    """Number the distinct rows of ``columns``, (n,)."""
    stacked = np.column_stack([np.round(np.nan_to_num(column, nan=-9e9) / SAME) for column in columns])
    _, codes = np.unique(stacked, axis=0, return_inverse=True)
    return codes.ravel().astype(np.int64)


def layout_of(readings: Readings, channel: IntArray, given_stop: IntArray | None = None) -> MeasurementLayout:
    """Sort readings by stop and time.

    Parameters
    ----------
    readings : the readings.
    channel : station or component of each reading, (n,).
    given_stop : stop of each reading if known, (n,).
    """
    seconds = readings.covariates.get("time_s")
    timed = seconds is not None and not bool(np.isnan(seconds).any())
    stop = _stops(readings, channel, seconds if timed else None) if given_stop is None else given_stop
    time = np.asarray(
        (seconds if timed and seconds is not None else np.arange(len(stop), dtype=np.float64))[_first_rows(stop)]
    )
    order = np.argsort(time, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    stop = rank[stop]
    time = time[order]
    first = _first_rows(stop)
    run = _runs(readings, first)
    cell = _cells(readings, first, run)
    condition = _conditions(run, cell)
    # Number of each stop in its run, scaled to -1 ... +1; zeros for runs of one stop.
    start = np.unique(run, return_index=True)[1]
    count = np.bincount(run)
    number = np.arange(len(run)) - start[run]
    return MeasurementLayout(
        stop,
        channel,
        time,
        timed,
        run,
        condition,
        cell,
        np.asarray(np.where(count[run] > 1, 2.0 * number / np.maximum(count[run] - 1, 1) - 1.0, 0.0)),
        _blocks(stop, channel),
    )


def _first_rows(stop: IntArray) -> IntArray:
    return np.unique(stop, return_index=True)[1].astype(np.int64)


def _stops(readings: Readings, channel: IntArray, seconds: FloatArray | None) -> IntArray:
    """Index of the stop of each reading, in order of first appearance."""
    pose = readings.labels.get("pose")
    columns = [*readings.position_mm.T, *readings.tool_mm.T]
    columns += [values.astype(np.float64) for values in readings.labels.values()]
    if seconds is not None:
        columns.append(seconds)
    elif pose is None:
        columns += [readings.covariates[name] for name in ("feed_mm_min", "load_kg") if name in readings.covariates]
        if readings.approach is not None:
            columns += list(readings.approach.T)
    code = _codes(columns)
    # the k-th reading of a channel within one code gets a separate code
    order = np.lexsort((channel, code))
    same = (np.diff(code[order]) == 0) & (np.diff(channel[order]) == 0)
    nth = np.zeros(len(code), dtype=np.int64)
    for k in np.flatnonzero(same) + 1:
        nth[k] = nth[k - 1] + 1
    code[order] = code[order] * (nth.max() + 1) + nth
    _, index, inverse = np.unique(code, return_index=True, return_inverse=True)
    rank = np.empty(len(index), dtype=np.int64)
    rank[np.argsort(index)] = np.arange(len(index))
    return rank[inverse.ravel()]


def _runs(readings: Readings, first: IntArray) -> IntArray:
    """Number of the run of each stop: from the labels, otherwise a stretch with one direction and condition."""
    names = [name for name in ("run", "line", "repeat", "setup", "block") if name in readings.labels]
    columns = [readings.labels[name][first].astype(np.float64) for name in names]
    for name in ("feed_mm_min", "load_kg"):
        if name in readings.covariates:
            columns.append(readings.covariates[name][first])
    if not {"run", "line"} & set(names):
        columns += [np.asarray(part) for part in _heading(readings.position_mm[first]).T]
    changed = np.zeros(len(first), dtype=bool)
    for column in columns:
        changed[1:] |= np.abs(np.diff(np.nan_to_num(column))) > SAME
    return np.cumsum(changed).astype(np.int64)


def _heading(position_mm: FloatArray) -> FloatArray:
    """Direction of travel (T, 3) to each stop, rounded; the first stop of a stretch gets that of the second."""
    step = np.diff(position_mm, axis=0, prepend=position_mm[:1])
    length = np.linalg.norm(step, axis=1, keepdims=True)
    unit = np.round(step / np.maximum(length, 1e-9), 2)
    if len(unit) > 1:
        unit[0] = unit[1]
    for k in range(1, len(unit) - 1):
        if not np.array_equal(unit[k], unit[k - 1]) and not np.array_equal(unit[k], unit[k + 1]):
            unit[k] = unit[k + 1]
    return np.asarray(unit)


def _cells(readings: Readings, first: IntArray, run: IntArray) -> IntArray:
    """Give the same number to stops that agree in position, tool, load, feed and direction."""
    columns = [*readings.position_mm[first].T, *readings.tool_mm[first].T]
    columns += [readings.covariates[n][first] for n in ("feed_mm_min", "load_kg") if n in readings.covariates]
    columns += [readings.labels[n][first].astype(np.float64) for n in ("line", "setup") if n in readings.labels]
    travel = _travel(readings.position_mm[first], run)
    loose = _codes([*columns, *travel.T])
    if readings.approach is None:
        return loose
    strict = _codes([*columns, *readings.approach[first].T])
    return strict if _repeated(strict) >= ENOUGH_PAIRS * _repeated(loose) else loose


def _travel(position_mm: FloatArray, run: IntArray) -> FloatArray:
    """Sign of the travel of each axis from the first to the last stop of the run that each stop belongs to, (T, 3)."""
    _, start, inverse = np.unique(run, return_index=True, return_inverse=True)
    end = np.append(start[1:], len(run)) - 1
    moved = position_mm[end] - position_mm[start]
    return np.asarray(np.sign(np.where(np.abs(moved) > SAME, moved, 0.0))[inverse.ravel()])


def _conditions(run: IntArray, cell: IntArray) -> IntArray:
    """Give the same number to runs through the same cells: the smallest cell of a run represents it."""
    least = np.full(int(run.max()) + 1, np.iinfo(np.int64).max)
    np.minimum.at(least, run, cell)
    _, codes = np.unique(least, return_inverse=True)
    return codes.ravel().astype(np.int64)[run]


def _blocks(stop: IntArray, channel: IntArray) -> tuple[Block, ...]:
    """Group the stops by the set of channels that read there; if there are many small groups, channel by channel."""
    stops, channels = int(stop.max()) + 1, int(channel.max()) + 1
    rows = np.full((stops, channels), -1, dtype=np.int64)
    rows[stop, channel] = np.arange(len(stop))
    pattern = (rows >= 0) @ (1 << np.arange(channels))
    kinds, counts = np.unique(pattern, return_counts=True)
    if counts.max() < 0.6 * stops:
        return tuple(_block(rows[rows[:, c] >= 0][:, [c]], np.flatnonzero(rows[:, c] >= 0)) for c in range(channels))
    blocks = []
    for kind in kinds:
        here = np.flatnonzero(pattern == kind)
        present = np.flatnonzero(rows[here[0]] >= 0)
        blocks.append(_block(rows[np.ix_(here, present)], here))
    return tuple(blocks)


def _block(rows: IntArray, stop: IntArray) -> Block:
    return Block(rows.astype(np.int64), stop.astype(np.int64))
