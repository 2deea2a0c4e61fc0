"""Beam breaks: runs of consecutive readings of one station that are off by one amount, seen as a step in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.core.names import MM_PER_UM
from compgen.identify.state import IntArray

#: Readings on either side of a step whose medians are compared.
WINDOW = 12
#: A step is a beam break when it exceeds this many robust standard deviations of the steps elsewhere in the series (of
#: the readings, if it is shorter than LONG) ...
STEP_LIMIT = 8.0
LONG = 8 * WINDOW
#: ... and this size: smaller steps are left to the test for whiteness.
SMALLEST_STEP_MM = 5.0 * MM_PER_UM
#: Steps smaller than this share of the largest are looked at after it has been dealt with.
SHARE_OF_LARGEST = 0.2
#: Levels that differ by less than this share of the largest step of the series are taken for one at first.
SAME_LEVEL = 0.3
#: A segment of at least so many readings gets a dead length of its own; a shorter one is rejected.
LEAST_OWN_READINGS = 20
#: More breaks than this at one station are no beam breaks but a model that does not describe the readings.
MOST_BREAKS = 8
#: Rejected readings that follow each other with the same offset are one segment from this number on.
LEAST_RUN = 3


@dataclass(frozen=True)
class Segment:
    """A run of readings of one station that is off by ``offset_mm`` against the rest (reading minus expected).

    ``kept`` says whether the readings were used, with a dead length of their own; ``rows`` are their
    places among all readings in order of time, ``line`` and ``last_line`` the lines of the first and the last of them
    in ``file`` (0 where there is no file).
    """

    station: str
    setup: int
    offset_mm: float
    kept: bool
    rows: tuple[int, ...]
    file: str = ""
    line: int = 0
    last_line: int = 0

    @property
    def text(self) -> str:
        """Return the report of the segment in one sentence."""
        where = f"line {self.line} to {self.last_line}" if self.line else f"reading {self.rows[0]} to {self.rows[-1]}"
        done = "kept with a dead length of their own" if self.kept else "rejected"
        return (
            f"station {self.station}: {self.offset_mm:+.3f} mm from {where}: beam break, dead length changed; "
            f"{self.readings} readings {done}"
        )

    @property
    def readings(self) -> int:
        """Number of readings."""
        return len(self.rows)

    def summary(self) -> dict[str, object]:
        """Return the entry of ``identify.json``."""
        return {
            "station": self.station,
            "setup": self.setup,
            "offset_um": self.offset_mm / MM_PER_UM,
            "readings": self.readings,
            "kept": self.kept,
            "file": self.file,
            "line": self.line,
            "last_line": self.last_line,
            "text": self.text,
        }


def time_order(lengths: Lengths) -> IntArray:
    """Return the rows in order of ``time_s``; in order of the file where that is not known."""
    time = lengths.covariates.get("time_s")
    if time is None or not np.isfinite(time).all():
        return np.arange(len(lengths))
    return np.argsort(time, kind="stable").astype(np.int64)


def split_at_breaks(
    lengths: Lengths, group: IntArray, residual_mm: FloatArray, sight: FloatArray
) -> tuple[IntArray, FloatArray] | None:
    """Give the readings behind a beam break a dead length of their own.

    A step that most stations show at the same stop is the machine's, not a station's, and splits nothing.

    Parameters
    ----------
    lengths, group : the readings, and the dead length of each, (n,).
    residual_mm : model minus reading, (n,).
    sight : unit vectors from station to target, (n, 3).

    Returns
    -------
    group : new index of the dead length of each reading, (n,), and by how much the readings of each are off, mm;
    None where no beam breaks.
    """
    order = time_order(lengths)
    members = {k: order[group[order] == k] for k in range(int(group.max()) + 1)}
    series = {k: _without_station(residual_mm[rows], sight[rows]) for k, rows in members.items()}
    steps = _without_common({k: _steps(values) for k, values in series.items()}, members, lengths)
    off = {k: _off_segments(members[k], series[k], found) for k, found in steps.items()}
    largest = max((abs(offset) for found in off.values() for _, offset in found), default=0.0)
    new = group.copy()
    offsets = [0.0] * len(members)
    for found in off.values():
        for rows, offset in found:
            if abs(offset) < SHARE_OF_LARGEST * largest:
                continue  # may be what the largest one does to the others
            if len(rows) >= LEAST_OWN_READINGS:
                new[rows] = len(offsets)
                offsets.append(offset)
    return (new, np.array(offsets)) if len(offsets) > len(members) else None


def _without_station(residual_mm: FloatArray, sight: FloatArray) -> FloatArray:
    """Take a wrong position of the station out of a series (n,), which a beam break leaves behind.

    Differences of successive residuals show a beam break only once; least absolute deviations against the
    differences of the lines of sight (n, 3) therefore give the position's error.
    """
    if len(residual_mm) < 2 * WINDOW:
        return residual_mm
    change, turn = np.diff(residual_mm), np.diff(sight, axis=0)
    weight: FloatArray = np.ones(len(change))
    moved: FloatArray = np.zeros(3)
    for _ in range(10):
        root = np.sqrt(weight)
        moved = np.asarray(np.linalg.lstsq(turn * root[:, None], change * root, rcond=1e-9)[0], dtype=np.float64)
        size = np.abs(change - turn @ moved)
        weight = 1.0 / np.maximum(size, 0.1 * np.median(size) + 1e-12)
    return np.asarray(residual_mm - sight @ moved)


def _steps(residual_mm: FloatArray) -> list[int]:
    """Indices at which a series (n,) in time steps to another level; empty where there are too many."""
    count = len(residual_mm)
    if count < 2 * WINDOW:
        return []
    medians = np.median(np.lib.stride_tricks.sliding_window_view(residual_mm, WINDOW), axis=1)
    step = np.abs(medians[WINDOW:] - medians[:-WINDOW])  # between [t - WINDOW, t) and [t, t + WINDOW), t = WINDOW ...
    if count >= LONG:
        noise = 1.4826 * float(np.median(step))
    else:
        noise = 1.4826 * float(np.median(np.abs(np.diff(residual_mm)))) / np.sqrt(2.0)
    limit = max(STEP_LIMIT * noise, SMALLEST_STEP_MM)
    found: list[int] = []
    while step.size and step.max() > limit:
        peak = int(np.argmax(step))
        found.append(_sharpened(residual_mm, peak + WINDOW))
        step[max(0, peak - WINDOW) : peak + WINDOW + 1] = 0.0
        if len(found) > MOST_BREAKS:
            return []
    return sorted(set(found))


def _sharpened(residual_mm: FloatArray, guess: int) -> int:
    """Index near ``guess`` at which two levels leave the smallest absolute residuals."""
    low, high = max(0, guess - WINDOW), min(len(residual_mm), guess + WINDOW)
    part = residual_mm[low:high]
    before, after = float(np.median(part[: WINDOW // 2])), float(np.median(part[-WINDOW // 2 :]))
    gain = np.abs(part - after) - np.abs(part - before)
    return low + int(np.argmax(np.concatenate([[0.0], np.cumsum(gain)])))


def _without_common(
    steps: dict[int, list[int]], members: dict[int, IntArray], lengths: Lengths
) -> dict[int, list[int]]:
    """Leave out the steps that more than half of the stations show within a few stops of each other."""
    shown: dict[tuple[int, str], set[int]] = {}
    run = lengths.labels.get("run", np.zeros(len(lengths), dtype=np.int64))

    def stops(rows: IntArray, step: int) -> set[tuple[int, str]]:
        near = rows[max(0, step - 2) : step + 3]
        return {(int(run[row]), str(lengths.point[row])) for row in near}

    for k, found in steps.items():
        for step in found:
            for stop in stops(members[k], step):
                shown.setdefault(stop, set()).add(int(lengths.station[members[k][0]]))
    most = len(lengths.stations) / 2
    return {
        k: [step for step in found if max(len(shown[stop]) for stop in stops(members[k], step)) <= most]
        for k, found in steps.items()
    }


def _off_segments(rows: IntArray, residual_mm: FloatArray, steps: Sequence[int]) -> list[tuple[IntArray, float]]:
    """Segments of one series that stand apart from its longest one, and by how much their readings are off."""
    if not steps:
        return []
    bounds = [0, *steps, len(rows)]
    levels = [0.0]
    for step in steps:
        before = np.median(residual_mm[max(bounds[bounds.index(step) - 1], step - WINDOW) : step])
        after = np.median(residual_mm[step : min(bounds[bounds.index(step) + 1], step + WINDOW)])
        levels.append(levels[-1] + float(after - before))
    sizes = np.diff(bounds)
    same = max(SAME_LEVEL * float(np.abs(np.diff(levels)).max()), SMALLEST_STEP_MM / 2)
    weight = [sum(sizes[j] for j in range(len(sizes)) if abs(levels[j] - level) < same) for level in levels]
    main = levels[int(np.argmax(weight))]
    return [
        (rows[bounds[j] : bounds[j + 1]], main - levels[j]) for j in range(len(levels)) if abs(levels[j] - main) >= same
    ]


def merged_groups(first: IntArray, group: IntArray, dead_mm: FloatArray, limit_mm: float) -> IntArray | None:
    """Join dead lengths of one station and set-up that agree within ``limit_mm``; None where all differ.

    ``first`` and ``group`` (n,) are the indices before and after the splitting, ``dead_mm`` the dead lengths.
    """
    owner = np.zeros(len(dead_mm), dtype=np.int64)
    owner[group] = first
    target = np.arange(len(dead_mm))
    for k in range(int(first.max()) + 1, len(dead_mm)):
        alike = [j for j in range(k) if owner[j] == owner[k] and abs(dead_mm[j] - dead_mm[k]) < limit_mm]
        if alike:
            target[k] = target[alike[0]]
    if np.array_equal(target, np.arange(len(dead_mm))):
        return None
    used = np.unique(np.concatenate([np.arange(int(first.max()) + 1), target]))
    return np.searchsorted(used, target)[group].astype(np.int64)


def kept_segments(lengths: Lengths, first: IntArray, group: IntArray, dead_mm: FloatArray) -> tuple[Segment, ...]:
    """Describe the dead lengths that ``split_at_breaks`` added.

    Parameters
    ----------
    first, group : index of the dead length of each reading before and after, (n,).
    dead_mm : dead lengths after the adjustment.
    """
    order = time_order(lengths)
    found = []
    for k in range(int(first.max()) + 1, len(dead_mm)):
        offset = float(dead_mm[first[group == k][0]] - dead_mm[k])
        own = order[first[order] == first[group == k][0]]
        edges = np.flatnonzero(np.diff(np.concatenate([[0], group[own] == k, [0]]).astype(int)))
        found += [_segment(lengths, own[a:b], offset, kept=True) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return tuple(found)


def rejected_runs(
    lengths: Lengths, group: IntArray, accepted: NDArray[np.bool_], residual_mm: FloatArray, spread_mm: FloatArray
) -> tuple[Segment, ...]:
    """Gather rejected readings that follow each other in time at one station with the same offset.

    ``spread_mm`` (n,) is the robust standard deviation of each reading.
    """
    order = time_order(lengths)
    found = []
    for k in range(int(group.max()) + 1):
        rows = order[group[order] == k]
        out = ~accepted[rows]
        edges = np.flatnonzero(np.diff(np.concatenate([[0], out.astype(int), [0]])))
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            for part in _alike(rows[first:last], residual_mm, spread_mm):
                offset = -float(np.median(residual_mm[part]))
                found.append(_segment(lengths, part, offset, kept=False))
    return tuple(found)


def _alike(rows: IntArray, residual_mm: FloatArray, spread_mm: FloatArray) -> list[IntArray]:
    """Split consecutive rows where the offset changes; only runs of some length are returned."""
    limit = 2 * STEP_LIMIT * spread_mm[rows]
    breaks = np.flatnonzero(np.abs(np.diff(residual_mm[rows])) > limit[1:]) + 1
    return [part for part in np.split(rows, breaks) if len(part) >= LEAST_RUN]


def _segment(lengths: Lengths, rows: IntArray, offset_mm: float, *, kept: bool) -> Segment:
    setup = lengths.labels.get("setup")
    first, last = int(rows[0]), int(rows[-1])
    file, line = lengths.origin[first] if lengths.origin else ("", 0)
    last_line = lengths.origin[last][1] if lengths.origin else 0
    return Segment(
        station=lengths.stations[int(lengths.station[first])],
        setup=0 if setup is None else int(setup[first]),
        offset_mm=offset_mm,
        kept=kept,
        rows=tuple(rows.tolist()),
        file=str(file),
        line=line,
        last_line=last_line,
    )
