"""Temperatures joined to readings by time: what each sensor read when a reading was taken, and how sure that moment is.

A measurement has ``time_s``; the comment ``# time_zero = 2026-03-02T07:30:00+01:00`` of its file says when that was 0.
Temperatures have a clock of their own (``time`` with zone, or ``time_s``). Between two readings of a sensor the straight line
is taken, within :data:`compgen.heat.sessions.LONGEST_GAP_S`; before the first, after the last, and within a longer gap nothing
is known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from compgen.data.csv_files import CsvTable, FloatArray, read_csv
from compgen.errors import InputError, visible_line
from compgen.heat.sessions import LONGEST_GAP_S, LONGEST_OFFSET_S, Temperatures, gaps_of, temperatures_of, times_of

#: Comments of a measurement: when ``time_s`` was 0; seconds to add to the clock of its computer; seconds to add to ``time_s`` to
#: get ``time_s`` of the temperatures, where those have no time of the day.
TIME_ZERO, CLOCK_OFFSET, SECONDS_BETWEEN = "time_zero", "clock_offset_s", "temperatures_offset_s"
#: When a measurement was made; whether that is its first or its last reading is not stated.
MEASURED_AT = "measured_at"
#: Two clocks of which nothing is stated may differ by so much, s (standard uncertainty).
U_CLOCK_S = 60.0


@dataclass(frozen=True)
class Moments:
    """When readings were taken, s of the clock of ``since`` (n,); ``other_s`` the same if ``measured_at`` was the last reading.

    ``since`` True: seconds of the epoch; False: ``time_s`` of the temperatures.
    """

    at_s: FloatArray
    epoch: bool
    other_s: FloatArray | None = None

    @property
    def possible(self) -> tuple[FloatArray, ...]:
        """Both, where it is not known which."""
        return (self.at_s,) if self.other_s is None else (self.at_s, self.other_s)


@dataclass(frozen=True)
class Stretch:
    """Rows of a file of temperatures between two long gaps; sensors are checked when it is used."""

    table: CsvTable
    time_s: FloatArray
    since: float | None
    #: Whether it begins its file: the machine was switched on then, as far as anybody knows.
    begins: bool = True


def read_stretches(path: str | Path) -> tuple[Stretch, ...]:
    """Read ``*.temperatures.csv``, or all of a folder, as the stretches between long gaps.

    Raises
    ------
    InputError
        for a file without sensors, a time that does not rise or has no zone.
    """
    if Path(path).is_dir():
        files = sorted(Path(path).glob("*.temperatures.csv"))
        if not files:
            raise InputError("has no *.temperatures.csv", file=path)
        return tuple(item for file in files for item in read_stretches(file))
    table = read_csv(path, (), ("time_s", "time"), ("temp_*_c",))
    time_s, since = times_of(table)
    ends = [0, *(int(k) + 1 for k in gaps_of(time_s)), len(table)]
    return tuple(
        Stretch(
            _rows(table, a, b), time_s[a:b] - (0.0 if since is None else time_s[a]), _since(since, time_s[a]), a == 0
        )
        for a, b in zip(ends, ends[1:], strict=False)
        if b > a
    )


def _since(since: float | None, first_s: float) -> float | None:
    return None if since is None else since + first_s


def _rows(table: CsvTable, first: int, end: int) -> CsvTable:
    columns = {name: cells[first:end] for name, cells in table.columns.items()}
    return replace(table, columns=columns, lines=table.lines[first:end])


def moments_of(time_s: FloatArray, comments: Mapping[str, str], file: str | Path | None) -> Moments:
    """Return when readings of one file were taken, by its comments.

    Raises
    ------
    InputError
        for a file that does not say when ``time_s`` was 0, a time without zone, readings without a time.
    """
    if not np.isfinite(time_s).all():
        raise InputError("is empty for some readings; temperatures are joined by time", file=file, field="time_s")
    offset_s = _seconds(comments, CLOCK_OFFSET, file) or 0.0
    if TIME_ZERO in comments:
        return Moments(time_s + _epoch(comments, TIME_ZERO, file) + offset_s, epoch=True)
    between_s = _seconds(comments, SECONDS_BETWEEN, file)
    if between_s is not None:
        return Moments(time_s + between_s, epoch=False)
    if MEASURED_AT in comments:
        measured = _epoch(comments, MEASURED_AT, file) + offset_s
        return Moments(time_s - time_s.min() + measured, epoch=True, other_s=time_s - time_s.max() + measured)
    raise InputError(
        f"does not say when its time_s was 0, so no temperature can be joined; add a comment with the zone, e.g. "
        f"# {TIME_ZERO} = 2026-03-02T07:30:00+01:00, or # {SECONDS_BETWEEN} = SECONDS to add to get time_s of the temperatures",
        file=file,
    )


def _seconds(comments: Mapping[str, str], key: str, file: str | Path | None) -> float | None:
    if key not in comments:
        return None
    try:
        found = float(comments[key])
    except ValueError:
        found = math.nan
    if not abs(found) < LONGEST_OFFSET_S:
        raise InputError(
            f"{key} = {visible_line(comments[key])[:40]} is not a number of seconds below {LONGEST_OFFSET_S:g}",
            file=file,
        )
    return found


def _epoch(comments: Mapping[str, str], key: str, file: str | Path | None) -> float:
    text = comments[key]
    try:
        moment = datetime.fromisoformat(text.strip())
    except ValueError:
        message = (
            f"{visible_line(text)[:40]!r} is not a time; expected ISO with its zone, e.g. 2026-03-02T07:30:00+01:00"
        )
        raise InputError(message, file=file, field=f"comment {key}") from None
    if moment.tzinfo is None:
        raise InputError(
            f"{text} has no zone; add it, e.g. {text}+01:00: temperatures are joined by time",
            file=file,
            field=f"comment {key}",
        )
    return moment.timestamp()


def stretch_of(parts: Sequence[Stretch], moments: Sequence[Moments], source: str | Path) -> tuple[Temperatures, bool]:
    """Return the temperatures of the stretch in which all moments lie, and whether it begins its file.

    Raises
    ------
    InputError
        for moments before the first or after the last reading, in a gap, or of another kind of clock; for a sensor that reads
        what no machine has.
    """
    epoch = moments[0].epoch
    if any(item.epoch != epoch for item in moments) or (epoch and any(item.since is None for item in parts)):
        raise InputError(
            f"has time_s, which is no time of the day, and the measurement has one: write time (ISO with zone) there, or "
            f"# {SECONDS_BETWEEN} = SECONDS in the measurement",
            file=source,
        )
    low = min(float(at.min()) for item in moments for at in item.possible)
    high = max(float(at.max()) for item in moments for at in item.possible)
    for item in parts:
        start = _start(item, epoch=epoch)
        if start + item.time_s[0] <= low and high <= start + item.time_s[-1]:
            return temperatures_of(item.table), item.begins
    held = "; ".join(_span(_start(item, epoch=epoch) + item.time_s, epoch=epoch) for item in parts)
    raise InputError(
        f"has readings {held}, and the measurement was taken {_span(np.array([low, high]), epoch=epoch)}: outside, and across a "
        f"gap of more than {LONGEST_GAP_S / 60:.0f} min or three intervals, no temperature is known; "
        "do the clocks agree (zone, clock_offset_s)?",
        file=source,
    )


def _start(part: Stretch | Temperatures, *, epoch: bool) -> float:
    return float(part.since or 0.0) if epoch else 0.0


def _span(time_s: FloatArray, *, epoch: bool) -> str:
    """Words for a span of time."""
    if not epoch:
        return f"from time_s {time_s[0]:g} to {time_s[-1]:g}"
    return f"from {_in_words(float(time_s[0]))} to {_in_words(float(time_s[-1]))}"


def _in_words(epoch_s: float) -> str:
    """Return a moment in UTC; one beyond the calendar, from a wrong offset of a clock, as its year."""
    try:
        return (datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=epoch_s)).isoformat(timespec="seconds")
    except OverflowError:
        return f"the year {1970 + epoch_s / 31556952.0:.0f}"


def on_clock(part: Temperatures, at_s: FloatArray, *, epoch: bool) -> FloatArray:
    """Return moments (n,) as ``time_s`` of the temperatures."""
    return at_s - _start(part, epoch=epoch)


def columns_at(part: Temperatures, values: FloatArray, at_s: FloatArray) -> FloatArray:
    """Return values (m,) or (m, k) of the temperatures at moments of their clock (n,), on straight lines."""
    if values.ndim == 1:
        return np.asarray(np.interp(at_s, part.time_s, values))
    return np.stack([np.interp(at_s, part.time_s, column) for column in values.T], axis=1)
