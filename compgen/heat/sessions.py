"""Temperatures over time (``*.temperatures.csv``), and a session of drift at the spindle nose (``*.drift.csv``).

Both have a time, ``time_s`` or ``time`` in ISO form with its zone, and columns ``temp_<name>_c``. A drift file has the
displacement of the tool relative to the workpiece, actual minus nominal, as every deviation in this program.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import CsvTable, FloatArray, format_csv, read_csv
from compgen.data.files import sha256_of_file
from compgen.errors import CompgenWarning, InputError, visible_line

#: Displacements that a drift file may have, and the unit of each.
DIRECTIONS = {"dx": "um", "dy": "um", "dz": "um", "ea": "urad", "eb": "urad"}
#: A sensor in a machine tool reads something within these, degC; an open or shorted one does not.
COLDEST_C, HOTTEST_C = -40.0, 200.0
#: Lags follow a straight line through a gap of up to this; after a longer one their state is not known.
LONGEST_GAP_S = 900.0
#: A reading is a jump if it is this much from the one before, and so many times the usual step.
JUMP_K, JUMP_STEPS = 1.5, 20.0
#: The same reading in this many rows or more may be a sensor that is stuck.
STUCK_ROWS = 30
#: Fewest rows of a session: from fewer no step of time is usual, and nothing is learned of a lag.
FEWEST_ROWS = 3
#: A stated offset of a clock beyond a hundred years is a typing error, s.
LONGEST_OFFSET_S = 3.2e9
#: A sensor that read other values rests if one value stands so many times as many rows as any other: coarse steps alternate.
REST_TIMES = 10
#: A scale, or the air, is colder than this in every workshop, degC: a log of 20 degC in degF reads 68.
WARMEST_HALL_C = 50.0
#: Sensors that are corrected for or compared by their name, whatever a model of heat says.
OF_THE_HALL = ("x", "y", "z", "ambient")


@dataclass(frozen=True)
class Temperatures:
    """Readings (n,) of each sensor in degC at ``time_s`` (n,), which rises.

    ``since`` is the time of ``time_s`` = 0 as seconds of the epoch, None for a time that counts from anywhere. ``notes``
    say what was bridged or left out; ``broken`` names sensors that jumped.
    """

    time_s: FloatArray
    celsius: Mapping[str, FloatArray]
    since: float | None = None
    notes: tuple[str, ...] = ()
    broken: tuple[str, ...] = ()
    #: The machine that the comment ``machine`` of the file names; "" if it names none.
    machine: str = ""

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.time_s)


@dataclass(frozen=True)
class DriftSession:
    """One session: temperatures, and displacements by direction (n,) in um or urad; nan where none was read."""

    name: str
    temperatures: Temperatures
    moved: Mapping[str, FloatArray]
    spindle_rpm: FloatArray | None = None
    sha256: str = ""
    metadata: Mapping[str, str] = field(default_factory=dict)


def read_temperatures(path: str | Path) -> Temperatures:
    """Read ``*.temperatures.csv``.

    Raises
    ------
    InputError
        with file, line and column, for a time that does not rise or has no zone, a temperature that no sensor reads, a file
        without sensors.
    """
    table = read_csv(path, (), ("time_s", "time"), ("temp_*_c",))
    return _temperatures(table)[0]


def read_drift(path: str | Path) -> DriftSession:
    """Read ``*.drift.csv``; rows after a gap that is too long are left out, and a note says so.

    Raises
    ------
    InputError
        as :func:`read_temperatures`, and for a file without any displacement.
    """
    columns = {f"{name}_{unit}": name for name, unit in DIRECTIONS.items()}
    table = read_csv(path, (), ("time_s", "time", "spindle_rpm", *columns), ("temp_*_c",))
    present = {column: name for column, name in columns.items() if column in table.columns}
    if not present:
        raise InputError(f"has no displacement; expected one of the columns {', '.join(columns)}", file=table.path)
    temperatures, count = _temperatures(table)
    if count < FEWEST_ROWS:
        message = f"is too short: a session has at least {FEWEST_ROWS} rows without a long gap, this one {count}; leave it out"
        raise InputError(message, file=table.path)
    moved = {name: table.numbers(column, empty=math.nan)[:count] for column, name in present.items()}
    for column, name in present.items():
        if not np.isfinite(moved[name]).any():
            raise table.fail(
                0, column, f"is empty in every row{_of_rows(table, count)}; leave the column out, or give readings"
            )
    rpm = table.numbers("spindle_rpm", empty=math.nan)[:count] if "spindle_rpm" in table.columns else None
    name = table.path.name.removesuffix(".csv").removesuffix(".drift")
    return DriftSession(name, temperatures, moved, rpm, sha256_of_file(table.path), table.metadata)


def write_temperatures(temperatures: Temperatures, metadata: Mapping[str, object] | None = None) -> str:
    """Return the text of a ``*.temperatures.csv``."""
    columns = {"time_s": temperatures.time_s, **{f"temp_{k}_c": v for k, v in temperatures.celsius.items()}}
    return format_csv(columns, metadata, {"time_s": 3, **dict.fromkeys(list(columns)[1:], 4)})


def check_machine(stated: str, machine: str, file: str | Path | None) -> None:
    """Refuse temperatures whose comment ``machine`` names another machine than ``machine``; InputError."""
    if stated.strip() and stated.strip().casefold() != machine.casefold():
        raise InputError(
            f"has temperatures of {visible_line(stated.strip())[:40]}, not of {machine}; give those of this machine, or correct "
            "the comment",
            file=file,
            field="comment machine",
        )


def temperatures_of(table: CsvTable) -> Temperatures:
    """Return the temperatures of a table, up to its first long gap; it warns of what was bridged."""
    return _temperatures(table)[0]


def _temperatures(table: CsvTable) -> tuple[Temperatures, int]:
    """Return the temperatures, and the number of rows before a gap that cannot be bridged."""
    sensors = {name[len("temp_") : -len("_c")]: name for name in table.columns if name.startswith("temp_")}
    if not sensors:
        raise InputError("has no temperatures; expected columns such as temp_spindle_c (degC)", file=table.path)
    time_s, since = times_of(table)
    count, notes = _before_gap(table, time_s)
    readings, broken = {}, []
    for sensor, column in sensors.items():
        values = _plausible(table, column)[:count]
        values, said = _bridged(table, column, time_s[:count], values)
        notes += said
        jumps = _jumps(values)
        notes += [] if jumps else _stuck(table, column, values)
        _check_unit(table, sensor, column, values, notes)
        if jumps:
            broken.append(sensor)
            notes.append(f"{table.path.name}: {column} jumps as no machine warms: the sensor is not used")
        readings[sensor] = values
    for text in notes:
        warnings.warn(text, CompgenWarning, stacklevel=3)
    return Temperatures(
        time_s[:count], readings, since, tuple(notes), tuple(broken), table.metadata.get("machine", "")
    ), count


def _stuck(table: CsvTable, column: str, values: FloatArray) -> list[str]:
    """Return what is said of a sensor that reads the same in all rows, or that read other values and rests now."""
    if len(values) < STUCK_ROWS:
        return []
    begins = np.flatnonzero(np.concatenate([[True], np.diff(values) != 0.0]))
    lasts = np.diff(np.append(begins, len(values)))
    longest = int(np.argmax(lasts))
    rows, first = int(lasts[longest]), int(begins[longest])
    if rows == len(values):
        where = f"all {rows} rows"
    elif rows >= STUCK_ROWS and rows >= REST_TIMES * int(np.delete(lasts, longest).max()):
        where = f"{rows} rows in succession (lines {table.lines[first]} to {table.lines[first + rows - 1]})"
    else:
        return []
    return [
        f"{table.path.name}: {column} is {values[first]:g} degC in {where}: a sensor that is stuck says nothing of the "
        "machine; leave the column out if it is"
    ]


def _check_unit(table: CsvTable, sensor: str, column: str, values: FloatArray, notes: list[str]) -> None:
    """Refuse scales or air that are always hotter than any workshop, as in degF; note it of any other sensor."""
    coldest = float(values.min())
    if coldest < WARMEST_HALL_C:
        return
    text = f"is never below {coldest:g} degC; is the log in degF? Temperatures are in degC: (degF - 32) / 1.8"
    if sensor.lower() in OF_THE_HALL:
        raise table.fail(int(np.argmin(values)), column, text)
    notes.append(f"{table.path.name}: {column} {text}")


def times_of(table: CsvTable) -> tuple[FloatArray, float | None]:
    """Return the times, s, and the moment from which they count; they rise from row to row."""
    both = [name for name in ("time_s", "time") if name in table.columns]
    if len(both) != 1:
        what = "has time_s and time; leave out one" if both else "has no time; expected time_s, or time (ISO with zone)"
        raise InputError(what, file=table.path)
    (column,) = both
    since = None
    if column == "time_s":
        found = table.numbers(column)
    else:
        moments = np.array([_moment(table, row, cell) for row, cell in enumerate(table.words(column))])
        since = float(moments[0])
        found = moments - since + 0.0
        since += _clock_offset_s(table)
    back = np.flatnonzero(np.diff(found) <= 0)
    if back.size:
        row = int(back[0]) + 1
        shown = f"{table.columns[column][row]} after {table.columns[column][row - 1]}"
        raise table.fail(row, column, f"the time does not rise: {shown}; was the clock set back, or are rows doubled?")
    return np.asarray(found, dtype=np.float64), since


def _moment(table: CsvTable, row: int, cell: str) -> float:
    try:
        moment = datetime.fromisoformat(cell)
    except ValueError:
        message = (
            f"{visible_line(cell)[:40]!r} is not a time; expected ISO with its zone, e.g. 2026-03-02T07:30:00+01:00"
        )
        raise table.fail(row, "time", message) from None
    if moment.tzinfo is None:
        raise table.fail(row, "time", f"{cell!r} has no zone; add it, e.g. {cell}+01:00, or {cell}Z for UTC")
    return moment.timestamp()


def _clock_offset_s(table: CsvTable) -> float:
    """Return what the comment ``clock_offset_s`` says: to be added to the clock of the logger, s."""
    stated = table.metadata.get("clock_offset_s", "0")
    try:
        offset = float(stated)
    except ValueError:
        offset = math.nan
    if not abs(offset) < LONGEST_OFFSET_S:
        raise InputError(
            f"clock_offset_s = {visible_line(stated)[:40]} is not a number of seconds below {LONGEST_OFFSET_S:g}",
            file=table.path,
        )
    return offset


def gaps_of(time_s: FloatArray) -> NDArray[np.intp]:
    """Return the rows behind which there is a gap that is too long to be bridged."""
    steps = np.diff(time_s)
    usual = float(np.median(steps)) if steps.size else 0.0
    return np.flatnonzero(steps > max(LONGEST_GAP_S, 3 * usual))


def _before_gap(table: CsvTable, time_s: FloatArray) -> tuple[int, list[str]]:
    """Return the rows before the first gap that is too long, with what to say of it."""
    steps, long = np.diff(time_s), gaps_of(time_s)
    if not long.size:
        return len(time_s), []
    count = int(long[0]) + 1
    text = (
        f"{table.path.name}:{table.lines[count]}: a gap of {steps[count - 1] / 60:.0f} min: how warm the machine was then is not "
        f"known, so the {len(time_s) - count} rows from here on are not used"
    )
    return count, [text]


def _of_rows(table: CsvTable, count: int) -> str:
    return "" if count == len(table) else f" of the {count} before the first gap that is too long"


def _plausible(table: CsvTable, column: str) -> FloatArray:
    """Return the readings of a sensor, nan where none was read; refuse what no sensor of a machine reads."""
    values = table.numbers(column, empty=math.nan)
    wrong = np.flatnonzero((values < COLDEST_C) | (values > HOTTEST_C))
    if wrong.size:
        row = int(wrong[0])
        message = (
            f"{table.columns[column][row]} degC is outside {COLDEST_C:g} ... {HOTTEST_C:g} degC: a broken sensor, "
            "or another unit? "
            "Leave the cell empty where nothing was read, or leave the column out"
        )
        raise table.fail(row, column, message)
    return values


def _bridged(table: CsvTable, column: str, time_s: FloatArray, values: FloatArray) -> tuple[FloatArray, list[str]]:
    """Return readings with short gaps filled by a straight line; refuse gaps that are too long."""
    known = np.isfinite(values)
    if known.all():
        return values, []
    rows = np.flatnonzero(known)
    if not rows.size:
        raise table.fail(0, column, f"is empty in every row{_of_rows(table, len(values))}; leave the column out")
    at = time_s[rows]
    usual = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    apart = np.diff(np.concatenate([time_s[:1], at, time_s[-1:]]))
    if apart.max() > max(LONGEST_GAP_S, 3 * usual):
        row = [0, *rows.tolist()][int(np.argmax(apart))]
        most = f"at most {LONGEST_GAP_S / 60:.0f} min are bridged"
        message = f"has no reading for {apart.max() / 60:.0f} min; {most}: leave the column out"
        raise table.fail(row, column, message)
    filled = np.interp(time_s, at, values[rows])
    return filled, [f"{table.path.name}: {column}: {int((~known).sum())} empty cells are filled by straight lines"]


def _jumps(values: FloatArray) -> bool:
    """Whether a sensor jumps: by more than any machine warms between readings, and unlike its other steps."""
    steps = np.abs(np.diff(values))
    if steps.size < 3:
        return False
    usual = float(np.percentile(steps, 90))
    return bool(steps.max() > max(JUMP_K, JUMP_STEPS * usual))
