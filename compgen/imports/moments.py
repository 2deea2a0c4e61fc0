"""The column of times of a foreign table as seconds since its first reading."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.errors import InputError
from compgen.imports.columns import Column
from compgen.imports.dates import Order, Written, header_date, iso, moment, order_of, read_date, serial_date
from compgen.imports.findings import Findings
from compgen.imports.source import parse_number, shown
from compgen.imports.units import S_PER_TIME, further_unit

_DAY_S = 86400.0
#: Keys of a header under which the day of the measurement stands, the clock, and both.
_DATE_KEYS = (
    "measured_at",
    "measured at",
    "measurement date",
    "messdatum",
    "date/time",
    "date time",
    "datum/zeit",
    "datum/uhrzeit",
    "date",
    "datum",
    "test date",
    "date of measurement",
    "start time",
    "created",
)
_CLOCK_KEYS = ("time", "zeit", "uhrzeit", "messzeit")


def times_of(findings: Findings, time: Column | None, date: Column | None) -> tuple[FloatArray | None, str | None]:
    """Return seconds since the earliest reading (rows,), None if only a day is known, and that reading's date in ISO form.

    Raises
    ------
    InputError
        for numbers without a unit, text that is no date, times of the day that cross midnight without a date.
    """
    column = time or date
    if column is None:
        raise InputError("no column of times")
    cells = findings.table.column(column.name)
    if time is not None and date is not None:
        cells = [
            f"{day.removesuffix('T00:00:00')} {clock}"
            for day, clock in zip(findings.table.column(date.name), cells, strict=True)
        ]
    numbers = [parse_number(cell) for cell in cells]
    if all(value is not None for value in numbers):
        return _of_numbers(findings, column, np.array(numbers, dtype=np.float64), dated=time is None)
    written = [read_date(cell) for cell in cells]
    wrong = next((k for k, item in enumerate(written) if item is None), None)
    if wrong is not None:
        line = findings.table.lines[wrong]
        raise InputError(f"{shown(cells[wrong])} is no date or time (line {line})")
    return _of_dates(findings, [item for item in written if item is not None])


def _of_numbers(
    findings: Findings, column: Column, values: FloatArray, *, dated: bool
) -> tuple[FloatArray | None, str | None]:
    """Seconds, minutes, ... by the unit; without one days of a spreadsheet, where all of them are of this century."""
    given = findings.options.units.get("time")
    unit = further_unit(given, "time") if given else column.unit
    if given and unit is None:
        raise InputError(f"{given!r} is no unit of time; {', '.join(S_PER_TIME)} are", field="--unit time")
    if unit in S_PER_TIME:
        return values * S_PER_TIME[unit], None
    serial = [serial_date(float(value)) for value in values]
    if all(item is not None for item in serial):
        findings.notes.append(
            f"the numbers in {shown(column.name)} are taken as days of a spreadsheet (1 is 1900-01-01)"
        )
        return _of_dates(findings, [item for item in serial if item is not None])
    raise InputError(
        "it holds numbers without a unit; " + ("it is no date" if dated else "say --unit time=s (ms, min, h)")
    )


def _of_dates(findings: Findings, dates: Sequence[Written]) -> tuple[FloatArray | None, str | None]:
    with_day = [bool(date.days) for date in dates]
    if any(with_day) != all(with_day) or len({bool(date.zone) for date in dates}) > 1:
        raise InputError("some cells have a date or a zone and some have none")
    if not all(with_day):
        return _of_clocks(dates)
    order = order_of(dates, findings.options.dates)
    if order is None:
        return _in_any_order(findings, dates)
    at = [_seconds(date, order) for date in dates]
    first = int(np.argmin(at))
    clocked = all(date.clock_s is not None for date in dates)
    return (np.array(at) - at[first] if clocked else None), iso(dates[first], order)


def _in_any_order(findings: Findings, dates: Sequence[Written]) -> tuple[FloatArray | None, str | None]:
    """Dates whose order stays open: times within one day do not depend on it, others are asked for."""
    days = sorted({tuple(sorted(day.date().isoformat() for day in date.days.values())) for date in dates})
    shown_days = " or ".join(dict.fromkeys(days[0]))
    if len(days) > 1:
        findings.doubts.append(f"{shown(dates[0].text)} may be {shown_days}; say --dates dmy, mdy or ymd")
        return None, None
    findings.notes.append(
        f"the date {shown(dates[0].text)} may be {shown_days}: it is left out; say --dates dmy, mdy or ymd to keep it"
    )
    if any(date.clock_s is None for date in dates):
        return None, None
    clock = np.array([date.clock_s for date in dates], dtype=np.float64)
    return clock - clock.min(), None


def _of_clocks(dates: Sequence[Written]) -> tuple[FloatArray, None]:
    clock = np.array([date.clock_s for date in dates], dtype=np.float64)
    if np.any(np.diff(clock) < 0):
        raise InputError("the times of the day do not ascend and have no date: the order of the readings is not known")
    return clock - clock[0], None


def _seconds(date: Written, order: Order) -> float:
    at = moment(date, order)
    ahead = 0.0
    if date.zone and date.zone != "Z":
        sign = -1.0 if date.zone[0] == "-" else 1.0
        ahead = sign * (3600.0 * int(date.zone[1:3]) + 60.0 * int(date.zone[-2:]))
    return (
        float(at.toordinal()) * _DAY_S
        + (at - at.replace(hour=0, minute=0, second=0, microsecond=0)).total_seconds()
        - ahead
    )


def date_in_header(findings: Findings) -> str | None:
    """Return the date of the measurement in ISO form by what stands above the table, None if it is not clear."""
    metadata = findings.table.metadata
    text = next((metadata[key] for key in _DATE_KEYS if metadata.get(key)), "")
    clock = next((metadata[key] for key in _CLOCK_KEYS if metadata.get(key)), "")
    both = f"{text} {clock}" if text and clock and (found := read_date(text)) and found.clock_s is None else text
    found_iso, against = header_date(both, findings.options.dates)
    if against:
        findings.notes.append(against)
    return found_iso
