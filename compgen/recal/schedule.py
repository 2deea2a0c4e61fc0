"""When a machine is looked at: a cron expression of five fields, or every so many minutes.

The expression means what it means to cron: Sunday is 0 or 7; where both the day of the month and the day of the week
are restricted, a day fits that fits either of them. Times are local.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
DAYS = ("sun", "mon", "tue", "wed", "thu", "fri", "sat")
MACROS = {
    "@hourly": "0 * * * *",
    "@daily": "0 0 * * *",
    "@weekly": "0 0 * * 0",
    "@monthly": "0 0 1 * *",
    "@yearly": "0 0 1 1 *",
}
#: Field: lowest and highest number, first number of its names, names.
FIELDS = (
    ("minute", 0, 59, ()),
    ("hour", 0, 23, ()),
    ("day of the month", 1, 31, ()),
    ("month", 1, 12, MONTHS),
    ("day of the week", 0, 7, DAYS),
)


@dataclass(frozen=True)
class Cron:
    """A cron expression: the numbers that fit each field; Sunday is 0. ``any_day``, ``any_weekday``: the field is ``*``."""

    expression: str
    minutes: tuple[int, ...]
    hours: tuple[int, ...]
    days: tuple[int, ...]
    months: tuple[int, ...]
    weekdays: tuple[int, ...]
    any_day: bool
    any_weekday: bool


@dataclass(frozen=True)
class Every:
    """Every so many minutes."""

    minutes: int


Schedule = Cron | Every


def cron(value: object) -> Cron:
    """Return a cron expression as numbers; ValueError says what is wrong with which field."""
    if not isinstance(value, str):
        raise ValueError("a cron expression, for example '30 6 * * mon', is expected")
    words = MACROS.get(value.strip().lower(), value).split()
    if len(words) != 5:
        raise ValueError(
            f"a cron expression has five fields (minute hour day month weekday), this one has {len(words)}"
        )
    fields = [_field(word.lower(), k) for k, word in enumerate(words)]
    weekdays = tuple(sorted({day % 7 for day in fields[4]}))
    minutes, hours, days, months = fields[:4]
    any_day, any_weekday = words[2].startswith("*"), words[4].startswith("*")
    found = Cron(" ".join(words), minutes, hours, days, months, weekdays, any_day, any_weekday)
    if found.any_weekday and not any(day <= _longest(month) for month in found.months for day in found.days):
        raise ValueError("a cron expression whose day exists in one of its months is expected")
    return found


def _longest(month: int) -> int:
    return 29 if month == 2 else 30 if month in (4, 6, 9, 11) else 31


def _field(word: str, number: int) -> tuple[int, ...]:
    name, low, high, names = FIELDS[number]
    found: set[int] = set()
    for part in word.split(","):
        match = re.fullmatch(r"(\*|\w+)(?:-(\w+))?(?:/(\d+))?", part)
        if match is None or (match[1] == "*" and match[2]):
            raise ValueError(f"{part!r} is not a {name}; numbers, a-b, lists and /step are expected")
        first = low if match[1] == "*" else _number(match[1], number)
        last = high if match[1] == "*" or (match[3] and not match[2]) else _number(match[2] or match[1], number)
        step = int(match[3] or 1)
        if names is DAYS and match[1] == "*":
            last = 6
        if first > last or step == 0:
            raise ValueError(f"{part!r} holds no {name}; the lower one stands first, a step is above 0")
        found.update(range(first, last + 1, step))
    return tuple(sorted(found))


def _number(word: str, number: int) -> int:
    name, low, high, names = FIELDS[number]
    if word in names:
        return names.index(word) + (low if names is MONTHS else 0)
    if not word.isascii() or not word.isdigit() or not low <= int(word) <= high:
        raise ValueError(f"{word!r} is not a {name}; {low} to {high} is expected")
    return int(word)


def systemd_lines(schedule: Schedule) -> list[str]:
    """Return the lines of a systemd timer that mean the schedule."""
    if isinstance(schedule, Every):
        return ["OnBootSec=1min", f"OnUnitActiveSec={schedule.minutes}min"]
    clock = f"{_listed(schedule.hours, 24)}:{_listed(schedule.minutes, 60)}:00"
    months, days = _listed(schedule.months, 12), _listed(schedule.days, 31)
    weekdays = ",".join(DAYS[day].capitalize() for day in schedule.weekdays)
    by_day, by_weekday = f"*-{months}-{days} {clock}", f"{weekdays} *-{months}-* {clock}"
    if schedule.any_weekday and len(schedule.weekdays) == 7:
        return [f"OnCalendar={by_day}"]
    if schedule.any_day or schedule.any_weekday:  # cron: only if neither begins with * does one of them suffice
        return [f"OnCalendar={weekdays} *-{months}-{days} {clock}"]
    return [f"OnCalendar={by_day}", f"OnCalendar={by_weekday}"]


def _listed(numbers: tuple[int, ...], all_of_them: int) -> str:
    return "*" if len(numbers) == all_of_them else ",".join(f"{number:02d}" for number in numbers)


def cron_expression(schedule: Schedule) -> str | None:
    """Return the five fields of a crontab; None where cron cannot express the interval."""
    if isinstance(schedule, Cron):
        return schedule.expression
    minutes = schedule.minutes
    if minutes < 60:
        return f"*/{minutes} * * * *" if 60 % minutes == 0 else None
    if minutes % 60 == 0 and 24 % (minutes // 60) == 0:
        return "0 0 * * *" if minutes == 1440 else f"0 */{minutes // 60} * * *"
    return None
