"""Write ``*.temperatures.csv`` while one measures: whole lines, gaps marked, the clock of the source noted."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from compgen.errors import InputError, visible_line
from compgen.heat.sessions import COLDEST_C, HOTTEST_C
from compgen.heat.sources import Reading, Source, SourceError

#: A source that cannot be reached is tried again after the interval, at most this often apart, s.
LONGEST_WAIT_S = 30.0
#: Rows of one file at most: a week at one a second.
MOST_ROWS = 604_800


@dataclass
class Recorded:
    """What was written: rows, gaps as (from, to, reason), readings that no sensor gives, clock of the source minus ours, s."""

    file: Path
    rows: int = 0
    gaps: list[tuple[str, str, str]] = field(default_factory=list)
    implausible: int = 0
    clock_offset_s: float | None = None

    def lines(self) -> list[str]:
        """What is said of it."""
        found = [f"{self.rows} rows -> {self.file}"]
        found += [f"gap from {begin} to {end}: {reason}" for begin, end, reason in self.gaps]
        if self.implausible:
            found.append(f"{self.implausible} readings outside {COLDEST_C:g} ... {HOTTEST_C:g} degC were left empty")
        if self.clock_offset_s is not None and abs(self.clock_offset_s) >= 1.0:
            found.append(
                f"the clock of the source is {self.clock_offset_s:+.1f} s off this computer's; times are those of this computer"
            )
        return found


@dataclass
class Recorder:
    """Reads a source every ``interval_s`` until ``stop`` is set, a number of rows or seconds is reached."""

    source: Source
    sensors: Sequence[str]
    file: Path
    interval_s: float
    origin: str
    #: Clocks of this computer: one that only rises, and the time of the day.
    monotonic: Callable[[], float] = time.monotonic
    now: Callable[[], datetime] = lambda: datetime.now(UTC)

    def run(self, stop: threading.Event, duration_s: float, say: Callable[[str], None]) -> Recorded:
        """Record; the file grows by whole lines, so that what is there can be read at any time.

        Raises
        ------
        InputError
            for a file that exists, or a key that the source does not have; nothing is written then.
        """
        first = self._first(stop, duration_s, say)
        done = Recorded(self.file)
        if first is None:
            return done
        try:
            self.file.absolute().parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(self.file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o666)
        except FileExistsError:
            raise InputError("exists already; give another name, so that no day is lost", file=self.file) from None
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", file=self.file) from None
        try:
            self._write(handle, self._head(first, done))
            self._record(handle, first, done, stop, duration_s, say)
        finally:
            os.close(handle)
            self.source.close()
        return done

    def _first(self, stop: threading.Event, duration_s: float, say: Callable[[str], None]) -> Reading | None:
        """Wait for the first reading; a file without one is not begun."""
        begin, wait_s = self.monotonic(), self.interval_s
        while not stop.is_set() and self.monotonic() - begin < duration_s:
            try:
                found = self.source.read()
                if found.celsius:
                    return found
                reason = "no sensor reads anything"
            except SourceError as error:
                reason = visible_line(str(error))[:200]
            say(f"waiting for {self.origin}: {reason}")
            stop.wait(wait_s)
            wait_s = min(2 * wait_s, LONGEST_WAIT_S)
        return None

    def _head(self, first: Reading, done: Recorded) -> str:
        lines = [f"# source = {visible_line(self.origin)}", f"# interval_s = {self.interval_s:g}"]
        if first.source_time is not None:
            done.clock_offset_s = (first.source_time - self.now()).total_seconds()
            lines.append(f"# source_clock_minus_ours_s = {done.clock_offset_s:.3f}")
        names = ",".join(f"temp_{name}_c" for name in self.sensors)
        return "\n".join([*lines, f"time,{names}"]) + "\n"

    def _record(
        self,
        handle: int,
        first: Reading,
        done: Recorded,
        stop: threading.Event,
        duration_s: float,
        say: Callable[[str], None],
    ) -> None:
        begin = due = self.monotonic()
        last = self._row(handle, first, done, None)
        lost: tuple[str, str] | None = None
        wait_s = self.interval_s
        while done.rows < MOST_ROWS:
            due = max(due + wait_s, self.monotonic())
            if due - begin > duration_s or stop.wait(max(0.0, due - self.monotonic())):
                break
            try:
                reading = self.source.read()
            except SourceError as error:
                if lost is None:
                    lost = last.isoformat(timespec="milliseconds"), visible_line(str(error))[:200].replace("=", ":")
                    say(f"no readings: {lost[1]}; trying again")
                wait_s = min(2 * wait_s, max(LONGEST_WAIT_S, self.interval_s))
                continue
            wait_s = self.interval_s
            moment = self.now()
            if lost is not None and (moment - last).total_seconds() > 1.5 * self.interval_s:
                gap = (lost[0], moment.isoformat(timespec="milliseconds"), lost[1])
                done.gaps.append(gap)
                self._write(handle, f"# gap {gap[0]} to {gap[1]}: {gap[2]}\n")
                say(f"readings again after {(moment - last).total_seconds():.0f} s")
            lost = None
            last = self._row(handle, reading, done, last)
        if lost is not None:
            gap = (lost[0], self.now().isoformat(timespec="milliseconds"), lost[1])
            done.gaps.append(gap)
            self._write(handle, f"# gap {gap[0]} to the end: {gap[2]}\n")

    def _row(self, handle: int, reading: Reading, done: Recorded, last: datetime | None) -> datetime:
        """Write one row; a clock that was set back is waited for, since times in a file rise."""
        moment = self.now()
        if last is not None and moment <= last:
            return last
        cells = []
        for name in self.sensors:
            value = reading.celsius.get(name)
            if value is not None and not COLDEST_C <= value <= HOTTEST_C:
                done.implausible += 1
                value = None
            cells.append("" if value is None else f"{value:.3f}")
        if any(cells):
            self._write(handle, f"{moment.isoformat(timespec='milliseconds')},{','.join(cells)}\n")
            done.rows += 1
            return moment
        return last or moment

    def _write(self, handle: int, text: str) -> None:
        """Write whole lines at once, and onto the disk."""
        left = text.encode()
        while left:
            left = left[os.write(handle, left) :]
        os.fsync(handle)
