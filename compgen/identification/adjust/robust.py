"""Adjustment with gross errors: reweighting, beam breaks, and rejected readings with the reason for each."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.lengths import Lengths
from compgen.data.names import MM_PER_UM
from compgen.data.records import DEVIATION_COLUMNS
from compgen.errors import CompgenWarning, ConvergenceError, Message
from compgen.identification.adjust.solver import Factor, LeastSquaresSolution, solve
from compgen.identification.adjust.starts import robust_spread
from compgen.identification.adjust.unknowns import ErrorParameters, IntArray, LeastSquaresProblem, State, distinct_poses
from compgen.kinematics.first_order import tool_of

if TYPE_CHECKING:
    from compgen.data.deviations import Deviations

# Beam breaks: runs of consecutive readings of one station that are off by the same amount, a step in time.


#: Number of readings on either side of a step whose medians are compared.
WINDOW = 12
#: A step is a beam break when it exceeds this many robust standard deviations of the steps elsewhere in the series (of
#: the readings, if it is shorter than LONG) ...
STEP_LIMIT = 8.0
LONG = 8 * WINDOW
#: ... and this size: smaller steps are left to the test for whiteness.
SMALLEST_STEP_MM = 5.0 * MM_PER_UM
#: Steps smaller than this share of the largest are examined after the largest.
SHARE_OF_LARGEST = 0.2
#: Levels that differ by less than this share of the largest step of the series count as one at first.
SAME_LEVEL = 0.3
#: A segment of at least this many readings gets a separate dead length; a shorter one is rejected.
LEAST_OWN_READINGS = 20
#: More breaks than this at one station mean that the model does not describe the readings.
MOST_BREAKS = 8
#: At least this many consecutive rejected readings with the same offset are one segment.
LEAST_RUN = 3


@dataclass(frozen=True)
class Segment:
    """A run of readings of one station that is off by ``offset_mm`` from the rest (reading minus expected).

    ``kept`` says whether the readings were used, with a separate dead length; ``rows`` are their places among all
    readings in order of time, ``line`` and ``last_line`` the lines of the first and the last of them in ``file`` (0
    without a file).
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
        done = "kept with a separate dead length" if self.kept else "rejected"
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
    """Return the rows in order of ``time_s``, or of the file if the time is unknown."""
    time = lengths.covariates.get("time_s")
    if time is None or not np.isfinite(time).all():
        return np.arange(len(lengths))
    return np.argsort(time, kind="stable").astype(np.int64)


def split_at_breaks(
    lengths: Lengths, group: IntArray, residual_mm: FloatArray, sight: FloatArray
) -> tuple[IntArray, FloatArray] | None:
    """Give the readings after a beam break a separate dead length.

    A step of most stations at the same stop comes from the machine, not from a station, and splits nothing.

    Parameters
    ----------
    lengths, group : the readings, and the dead length of each, (n,).
    residual_mm : model minus reading, (n,).
    sight : unit vectors from station to target, (n, 3).

    Returns
    -------
    group : new index of the dead length of each reading, (n,), and by how much the readings of each are off, mm; None
    without beam breaks.
    """
    order = time_order(lengths)
    members = {k: order[group[order] == k] for k in range(int(group.max()) + 1)}
    series = {}
    for k, rows in members.items():
        series[k] = residual_mm[rows]
        if len(rows) < 2 * WINDOW:
            continue
        # Remove the error of the station's position that a beam break causes: differences of successive residuals show
        # a beam break only once, so least absolute deviations on the differences of the lines of sight give the error
        # of the position.
        change, turn = np.diff(residual_mm[rows]), np.diff(sight[rows], axis=0)
        weight: FloatArray = np.ones(len(change))
        moved: FloatArray = np.zeros(3)
        for _ in range(10):
            root = np.sqrt(weight)
            moved = np.asarray(np.linalg.lstsq(turn * root[:, None], change * root, rcond=1e-9)[0], dtype=np.float64)
            size = np.abs(change - turn @ moved)
            weight = 1.0 / np.maximum(size, 0.1 * np.median(size) + 1e-12)
        series[k] = np.asarray(residual_mm[rows] - sight[rows] @ moved)
    steps = _without_common({k: _steps(values) for k, values in series.items()}, members, lengths)
    off = {k: _off_segments(members[k], series[k], found) for k, found in steps.items()}
    largest = max((abs(offset) for found in off.values() for _, offset in found), default=0.0)
    new = group.copy()
    offsets = [0.0] * len(members)
    for found in off.values():
        for rows, offset in found:
            if abs(offset) < SHARE_OF_LARGEST * largest:
                continue  # may be caused by the largest one
            if len(rows) >= LEAST_OWN_READINGS:
                new[rows] = len(offsets)
                offsets.append(offset)
    return (new, np.array(offsets)) if len(offsets) > len(members) else None


def _steps(residual_mm: FloatArray) -> list[int]:
    """Indices at which a series (n,) in time steps to another level; empty if there are too many."""
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
        # the index near the peak at which two levels leave the smallest absolute residuals
        low, high = peak, min(count, peak + 2 * WINDOW)
        part = residual_mm[low:high]
        before, after = float(np.median(part[: WINDOW // 2])), float(np.median(part[-WINDOW // 2 :]))
        gain = np.abs(part - after) - np.abs(part - before)
        found.append(low + int(np.argmax(np.concatenate([[0.0], np.cumsum(gain)]))))
        step[max(0, peak - WINDOW) : peak + WINDOW + 1] = 0.0
        if len(found) > MOST_BREAKS:
            return []
    return sorted(set(found))


def _without_common(
    steps: dict[int, list[int]], members: dict[int, IntArray], lengths: Lengths
) -> dict[int, list[int]]:
    """Drop the steps that more than half of the stations show within a few stops."""
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
    """Return the segments of one series that are off its longest one, and their offsets."""
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
    """Join dead lengths of one station and set-up that agree within ``limit_mm``; None if all differ.

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
    """Combine consecutive rejected readings of one station with the same offset.

    ``spread_mm`` (n,) is the robust standard deviation of each reading.
    """
    order = time_order(lengths)
    found = []
    for k in range(int(group.max()) + 1):
        rows = order[group[order] == k]
        out = ~accepted[rows]
        edges = np.flatnonzero(np.diff(np.concatenate([[0], out.astype(int), [0]])))
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            some = rows[first:last]  # split where the offset changes
            breaks = np.abs(np.diff(residual_mm[some])) > 2 * STEP_LIMIT * spread_mm[some][1:]
            for part in np.split(some, np.flatnonzero(breaks) + 1):
                if len(part) < LEAST_RUN:
                    continue
                offset = -float(np.median(residual_mm[part]))
                found.append(_segment(lengths, part, offset, kept=False))
    return tuple(found)


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


# Gross errors: found by a robust limit, explained if the data allow it, never dropped silently.


#: A reading is rejected when its residual exceeds this many robust standard deviations (1.4826 MAD).
LIMIT = 6.0
#: Lower limit of the robust standard deviation, as a share of the stated uncertainty.
LEAST_SPREAD = 0.02
#: Residuals with a scatter above this many standard uncertainties are searched for gross mistakes.
LARGEST_SPREAD = 10.0
#: Number of residuals sufficient to estimate that scatter.
SAMPLE = 2000
#: A reading fits another point or station if it agrees within this many standard deviations.
CLOSE = 10.0
#: A smaller residual cannot be an exchange of points: neighbours in the volume are further apart.
SMALLEST_EXCHANGE_MM = 0.05


@dataclass(frozen=True)
class Rejected:
    """One rejected reading: its row, its residual in um, and the reason in words."""

    row: int
    station: str
    point: str
    residual_um: float
    reason: str
    file: str = ""
    line: int = 0


def standardised_spread(standardised: FloatArray) -> float:
    """Robust standard deviation (1.4826 MAD) of residuals over their standard uncertainties (n,).

    At least ``LEAST_SPREAD``, so that rounding in noise-free data rejects nothing.
    """
    return max(1.4826 * median(np.abs(standardised - median(standardised))), LEAST_SPREAD)


def median(values: FloatArray) -> float:
    """Return the median of values (n,), nan if one of them is; numpy's own loads ``numpy.ma``, a third of numpy's time.

    >>> median(np.array([4.0, 1.0, 2.0]))
    2.0
    """
    low, high = (len(values) - 1) // 2, len(values) // 2
    ordered = np.partition(values, [low, high, len(values) - 1])
    return float(ordered[-1] if np.isnan(ordered[-1]) else 0.5 * (ordered[low] + ordered[high]))


def accepted_readings(standardised: FloatArray) -> NDArray[np.bool_]:
    """Mark the readings whose residual over its standard uncertainty (n,) is within the robust limit."""
    size = np.abs(standardised)
    largest = float(size.max())
    quick = 1.25 * median(size[:: max(1, len(size) // 500) | 1])  # of a sample, conservative
    if largest <= LIMIT * max(quick, LEAST_SPREAD):
        return np.ones(len(size), dtype=bool)
    return np.asarray(size <= LIMIT * standardised_spread(standardised))


def belonging(standardised: FloatArray) -> bool:
    """Whether all readings are consistent: none beyond the limit, and no residuals large enough to hide a mistake."""
    return (
        bool(accepted_readings(standardised).all())
        and standardised_spread(standardised[:: max(7, len(standardised) // SAMPLE) | 1]) < LARGEST_SPREAD
    )


#: Share of all readings, and of those of one station, that may be rejected.
MOST_REJECTED = 0.3
MOST_REJECTED_OF_STATION = 0.5
#: Rounds after which the set of kept readings is final.
MOST_ROUNDS = 20

S = TypeVar("S")


def fit_accepted(
    fit: Callable[[NDArray[np.bool_], S | None], S],
    standardised: Callable[[S], FloatArray],
    count: int,
    advice: str,
    *,
    reject: bool,
    begin: NDArray[np.bool_] | None = None,
) -> tuple[S, NDArray[np.bool_]]:
    """Fit, reject what is beyond the robust limit, and repeat until the set of kept readings is stable.

    Parameters
    ----------
    fit : solves with the accepted readings (count,), from the previous solution (None at first).
    standardised : residuals of a solution over their standard uncertainty, (count,).
    advice : end of the message "n of count ...".
    begin : readings (count,) to begin with; the others come back where they fit. Default: all.

    Raises
    ------
    ConvergenceError
        if more than ``MOST_REJECTED`` of the readings do not fit.
    """
    accepted = np.ones(count, dtype=bool) if begin is None or not reject else begin
    solution = fit(accepted, None)
    for _ in range(MOST_ROUNDS if reject else 0):
        keep = accepted_readings(standardised(solution))
        check_rejected(keep, advice)
        if np.array_equal(keep, accepted):
            break
        accepted = keep
        solution = fit(accepted, solution)
    return solution, accepted


def check_rejected(keep: NDArray[np.bool_], advice: str) -> None:
    """Raise ConvergenceError if more than ``MOST_REJECTED`` of the readings (n,) are not kept."""
    rejected = int(np.count_nonzero(~keep))
    if rejected > MOST_REJECTED * len(keep):
        raise ConvergenceError(
            Message(
                "advice-before-rejection",
                "{rejected} of {keep} {advice} before anything is rejected",
                rejected=rejected,
                keep=len(keep),
                advice=advice,
            )
        )


@dataclass(frozen=True)
class _Expected:
    """What the model expects: distances of poses and stations (m, S), dead lengths and their stations (g,)."""

    distance_mm: FloatArray
    dead_mm: FloatArray
    station_of: IntArray
    pose: IntArray
    group: IntArray
    close_mm: FloatArray

    @classmethod
    def of(
        cls,
        lengths: Lengths,
        layout: ErrorParameters,
        state: State,
        group: IntArray,
        residual_mm: FloatArray,
        sigma_mm: FloatArray,
    ) -> _Expected:
        poses = distinct_poses(lengths.position_mm, tool_of(layout.machine, lengths.tool_mm))
        tip = layout.tips(state.errors, poses.position_mm, poses.tool_mm)
        station_of = np.zeros(len(state.dead_length_mm), dtype=np.int64)
        station_of[group] = lengths.station
        return cls(
            distance_mm=np.linalg.norm(tip[:, None, :] - state.stations_mm[None], axis=2),
            dead_mm=state.dead_length_mm,
            station_of=station_of,
            pose=poses.of,
            group=group,
            close_mm=CLOSE * sigma_mm * max(standardised_spread(residual_mm / sigma_mm), 0.1),
        )


def explain_rejected(
    lengths: Lengths,
    layout: ErrorParameters,
    state: State,
    group: IntArray,
    rejected: IntArray,
    residual_mm: FloatArray,
    sigma_mm: FloatArray,
    segments: Sequence[Segment] = (),
) -> tuple[Rejected, ...]:
    """Give every rejected reading a reason: length of another station or point, a beam break, or its size.

    Parameters
    ----------
    lengths, layout, state, group : readings, unknowns, their values, and the dead length of each reading.
    rejected : rows of the rejected readings.
    residual_mm, sigma_mm : model minus reading and standard uncertainty of every reading, (n,).
    segments : runs of readings with a common offset.
    """
    if not len(rejected):
        return ()
    expected = _Expected.of(lengths, layout, state, group, residual_mm, sigma_mm)
    rows = rejected.tolist()
    broken: dict[int, str] = {}  # rows of rejected segments, with the reason
    for segment in segments:
        if not segment.kept:
            where = f"lines {segment.line} to {segment.last_line}" if segment.line else "a run of readings"
            text = f"one of {segment.readings} readings off by {segment.offset_mm:+.3f} mm ({where}): beam break"
            broken.update({row: text for row in segment.rows if row in set(rows)})
    exchanged = _exchanges(lengths, expected, [row for row in rows if row not in broken], residual_mm)
    found = []
    for row in rows:
        many = abs(residual_mm[row]) / sigma_mm[row]
        size = f"differs from the model by {-residual_mm[row] * 1000.0:+.1f} um, {many:.0f} standard deviations"
        # the length of another station at this point?
        predicted = expected.distance_mm[expected.pose[row], expected.station_of] - expected.dead_mm
        off = np.abs(predicted - lengths.length_mm[row])
        off[expected.station_of == lengths.station[row]] = np.inf
        best, label = int(np.argmin(off)), None
        if off[best] <= expected.close_mm[row]:
            name = lengths.stations[expected.station_of[best]]
            label = f"it fits station {name!r} at this point: wrong station label?"
        why = broken.get(row) or label or exchanged.get(row)
        file, line = lengths.origin[row] if lengths.origin else ("", 0)
        found.append(
            Rejected(
                row=row,
                station=lengths.stations[lengths.station[row]],
                point=str(lengths.point[row]),
                residual_um=float(-residual_mm[row] * 1000.0),
                reason=f"{size}; {why or 'beam break or disturbed reading?'}",
                file=str(file),
                line=line,
            )
        )
    return tuple(found)


def _exchanges(lengths: Lengths, expected: _Expected, rows: Sequence[int], residual_mm: FloatArray) -> dict[int, str]:
    """Find readings that belong to another point: two points exchanged, or a duplicate reading of one point.

    All rejected readings of one stop must agree on the other point.
    """
    run = lengths.labels.get("run", np.zeros(len(lengths), dtype=np.int64))
    candidates: dict[tuple[int, int], set[int]] = {}
    members: dict[tuple[int, int], list[int]] = defaultdict(list)
    for row in rows:
        if abs(residual_mm[row]) <= SMALLEST_EXCHANGE_MM:
            continue
        predicted = expected.distance_mm[:, lengths.station[row]] - expected.dead_mm[expected.group[row]]
        off = np.abs(predicted - lengths.length_mm[row])
        off[expected.pose[row]] = np.inf
        fits = set(np.flatnonzero(off <= expected.close_mm[row]).tolist())
        if fits:
            stop = (int(expected.pose[row]), int(run[row]))
            candidates[stop] = candidates.get(stop, fits) & fits
            members[stop].append(row)
    found = {}
    for stop, fits in candidates.items():
        mutual = [pose for pose in fits if stop[0] in candidates.get((pose, stop[1]), set())]
        chosen = mutual or sorted(fits)
        if len(chosen) != 1:
            continue
        what = "the two points are exchanged" if mutual else "duplicated or wrong point?"
        row = int(np.flatnonzero(expected.pose == chosen[0])[0])
        where = ", ".join(f"{value:g}" for value in lengths.position_mm[row])
        text = f"it fits point {lengths.point[row]} at ({where}) mm: {what}"
        found.update(dict.fromkeys(members[stop], text))
    return found


def rejected_components(
    deviations: Deviations,
    row: IntArray,
    component: IntArray,
    residual_mm: FloatArray,
    sigma_mm: FloatArray,
    accepted: NDArray[np.bool_],
) -> tuple[Rejected, ...]:
    """Describe the rejected measured components (k,): row and component of each, residual as model minus measured."""
    found = []
    for k in np.flatnonzero(~accepted).tolist():
        at = int(row[k])
        file, line = deviations.origin[at] if deviations.origin else ("", 0)
        where = ", ".join(f"{value:g}" for value in deviations.position_mm[at])
        size_um = float(-residual_mm[k]) / MM_PER_UM
        many = abs(residual_mm[k]) / sigma_mm[k]
        reason = f"differs from the model by {size_um:+.1f} um, {many:.0f} standard deviations; disturbed reading?"
        name = DEVIATION_COLUMNS[component[k]]
        found.append(Rejected(at, name, f"({where}) mm", size_um, reason, str(file), line))
    return tuple(found)


# Adjustment in spite of gross errors: iteratively reweighted least squares, beam breaks, then plain least squares.
#
# Weights of Huber (1964), which have a single optimum, are followed by those of Tukey (Beaton & Tukey 1974), which give
# gross errors zero weight. Readings beyond the robust limit are then rejected, and all others have full weight.


#: Huber's constant: 95 % efficiency for normal readings.
HUBER = 1.345
HUBER_STEPS = 5
TUKEY_STEPS = 15
HARD_STEPS = 20
#: Shares of rejected readings from which a warning is given.
MANY_REJECTED = 0.1
MANY_REJECTED_OF_STATION = 0.25
#: A reading of less weight is reported as not fitting if nothing converges.
SUSPICIOUS_WEIGHT = 0.2
#: Rounds in which beam breaks may be found.
BREAK_ROUNDS = 6
#: At the start, before the errors of the machine are known, a reading this many deviations off gets no weight.
FAR_AT_START = 10.0

P = TypeVar("P", bound=LeastSquaresProblem)


@dataclass(frozen=True)
class WeightedReadings:
    """What the robust adjustment needs of n readings.

    ``target_mm`` (n, 3) are the nominal targets; dead length, weight and standard uncertainty of each have shape (n,).
    """

    lengths: Lengths
    target_mm: FloatArray
    group: IntArray
    weight: FloatArray
    sigma_mm: FloatArray


@dataclass(frozen=True)
class RobustFit(Generic[P]):
    """The problem with the dead lengths that beam breaks added, its optimum, and the state of the readings.

    ``accepted`` (n,) marks the used ones, ``residual_mm`` (n,) is model minus reading of all.
    """

    problem: P
    group: IntArray
    solution: LeastSquaresSolution
    accepted: NDArray[np.bool_]
    residual_mm: FloatArray
    segments: tuple[Segment, ...] = ()


def fit_robustly(
    problem: P,
    start: State,
    readings: WeightedReadings,
    factor: Factor | None,
    rebuild: Callable[[IntArray], P],
    *,
    disturbed: bool,
) -> RobustFit[P]:
    """Adjust, reject gross errors, and give the readings after a beam break a separate dead length.

    Parameters
    ----------
    problem : all readings with their weights.
    start, factor : start values and the factor of the normal matrix there.
    rebuild : makes the problem, weighted, for another index of dead lengths (n,).
    disturbed : whether gross errors are known to be among the readings.

    Raises
    ------
    ConvergenceError
        if more than 30 % of the readings, or more than half of those of a station, do not fit.
    """
    if disturbed:  # readings far off at the start are excluded from the first adjustment
        residual = problem.residuals(start)
        near = np.ones(len(residual), dtype=bool)
        for k in range(int(readings.group.max()) + 1):
            own = readings.group == k
            near[own] = np.abs(residual[own]) <= FAR_AT_START * max(robust_spread(residual[own]), 1e-6)
        solution = _weighted(problem, start, readings, near)
    else:
        solution = solve(problem, start, factor)
    residual = problem.residuals(solution.state)
    if not disturbed and (accepted := accepted_readings(residual / readings.sigma_mm)).all():
        return RobustFit(problem, readings.group, solution, accepted, residual)
    problem, group, solution = _split(problem, solution, readings, rebuild)
    solution = _tukey(problem, solution, readings)
    # dead lengths that turn out to be equal are merged
    spread, dead = standardised_spread(_standardised(problem, solution, readings)), solution.state.dead_length_mm
    again = merged_groups(readings.group, group, dead, LIMIT * spread * float(np.median(readings.sigma_mm)))
    if again is not None:
        kept = np.zeros(int(again.max()) + 1)
        kept[again[::-1]] = dead[group[::-1]]
        problem, group = rebuild(again), again
        solution = _tukey(problem, replace(solution, state=replace(solution.state, dead_length_mm=kept)), readings)
    fit = _rejected(problem, group, solution, readings)
    if 1.0 - np.mean(fit.accepted) > MANY_REJECTED or _shares(fit.accepted, readings).max() > MANY_REJECTED_OF_STATION:
        warnings.warn(
            Message(
                "many-rejected",
                "{accepted}; they were excluded, but their number suggests a mistake in the "
                "readings, their labels or the machine file",
                accepted=_suspicion(fit.accepted, readings),
            ),
            CompgenWarning,
            stacklevel=4,
        )
    lengths = readings.lengths
    spread_mm = standardised_spread(fit.residual_mm / readings.sigma_mm) * readings.sigma_mm
    segments = kept_segments(lengths, readings.group, group, fit.solution.state.dead_length_mm)
    segments += rejected_runs(lengths, group, fit.accepted, fit.residual_mm, spread_mm)
    return replace(fit, segments=segments)


def _split(
    problem: P, solution: LeastSquaresSolution, readings: WeightedReadings, rebuild: Callable[[IntArray], P]
) -> tuple[P, IntArray, LeastSquaresSolution]:
    """Reweighted adjustment in which beam breaks get separate dead lengths until no more are found."""
    group = readings.group
    for _ in range(BREAK_ROUNDS):
        for _ in range(HUBER_STEPS):
            standardised = _standardised(problem, solution, readings)
            size = np.abs(standardised) / standardised_spread(standardised)
            solution = _weighted(problem, solution.state, readings, HUBER / np.maximum(size, HUBER))
        state = solution.state
        sight = readings.target_mm - state.stations_mm[readings.lengths.station]
        sight = sight / np.linalg.norm(sight, axis=1)[:, None]
        split = split_at_breaks(readings.lengths, group, problem.residuals(state), sight)
        if split is None:
            break
        group, offset_mm = split
        problem = rebuild(group)
        # the groups split off by a break start with the original dead length minus the offset of their readings
        known, main = len(state.dead_length_mm), np.zeros(len(offset_mm), dtype=np.int64)
        main[group] = readings.group
        own = state.dead_length_mm[main[known:]] - offset_mm[known:]
        state = replace(state, dead_length_mm=np.concatenate([state.dead_length_mm, own]))
        solution = replace(solution, state=state)
    return problem, group, solution


def _standardised(
    problem: LeastSquaresProblem, solution: LeastSquaresSolution, readings: WeightedReadings
) -> FloatArray:
    return np.asarray(problem.residuals(solution.state) / readings.sigma_mm)


def _tukey(
    problem: LeastSquaresProblem, solution: LeastSquaresSolution, readings: WeightedReadings
) -> LeastSquaresSolution:
    """Iteratively reweighted least squares with Tukey's weights, until the set of used readings is stable."""
    kept: NDArray[np.bool_] | None = None
    for _ in range(TUKEY_STEPS):
        standardised = _standardised(problem, solution, readings)
        weight = np.clip(1.0 - (standardised / (LIMIT * standardised_spread(standardised))) ** 2, 0.0, None) ** 2
        if kept is not None and np.array_equal(kept, weight > 0):
            break
        kept = weight > 0
        _check_share(kept, readings)
        solution = _weighted(problem, solution.state, readings, weight)
    return solution


def _rejected(problem: P, group: IntArray, solution: LeastSquaresSolution, readings: WeightedReadings) -> RobustFit[P]:
    """Least squares of the readings within the limit, until the set is stable."""
    accepted: NDArray[np.bool_] | None = None
    for _ in range(HARD_STEPS):
        residual = problem.residuals(solution.state)
        keep = accepted_readings(residual / readings.sigma_mm)
        _check_share(keep, readings)
        if accepted is not None and np.array_equal(keep, accepted):
            break
        accepted = keep
        solution = _weighted(problem, solution.state, readings, accepted)
    assert accepted is not None
    return RobustFit(problem, group, solution, accepted, residual)


def _weighted(
    problem: LeastSquaresProblem, start: State, readings: WeightedReadings, weight: FloatArray | NDArray[np.bool_]
) -> LeastSquaresSolution:
    """Adjust with other weights; an error names the stations of the excluded readings."""
    try:
        return solve(problem.weighted(readings.weight * weight), start)
    except ConvergenceError as error:
        keep = np.asarray(weight > SUSPICIOUS_WEIGHT)
        if keep.all():
            raise
        raise ConvergenceError(
            Message("rest-undetermined", "{keep}; for the rest: {error}", keep=_suspicion(keep, readings), error=error)
        ) from error


def _suspicion(keep: NDArray[np.bool_], readings: WeightedReadings) -> str:
    out, names = _shares(keep, readings), readings.lengths.stations
    listed = ", ".join(f"{name} {100 * part:.0f} %" for name, part in zip(names, out, strict=True))
    return (
        f"{np.count_nonzero(~keep)} of {len(keep)} readings do not fit the model; the most suspicious station is "
        f"{names[int(np.argmax(out))]!r} ({listed} rejected)"
    )


def _shares(keep: NDArray[np.bool_], readings: WeightedReadings) -> FloatArray:
    """Share of the readings of each station that does not fit, (S,)."""
    station, count = readings.lengths.station, len(readings.lengths.stations)
    return np.asarray(np.bincount(station, ~keep, count) / np.maximum(np.bincount(station, minlength=count), 1))


def _check_share(keep: NDArray[np.bool_], readings: WeightedReadings) -> None:
    out = _shares(keep, readings)
    share = 1.0 - np.count_nonzero(keep) / len(keep)
    if share <= MOST_REJECTED and out.max() <= MOST_REJECTED_OF_STATION:
        return
    name = readings.lengths.stations[int(np.argmax(out))]
    if np.count_nonzero(out > MOST_REJECTED) > len(out) / 2:
        advice = "most stations are affected: check chain, travel and errors of the machine file, the axis order and "
        advice += "the units before anything is rejected"
    else:
        advice = f"check station {name!r}: its label, its unit, and whether readings of another station are "
        advice += "labelled with its name"
    raise ConvergenceError(f"{_suspicion(keep, readings)}; {advice}")
