"""Reading of any text file: limits of size, encodings, numbers, dates and times; and which files are native ones."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Literal

from compgen.data.csv_files import names_in_header
from compgen.data.files import check_lines, read_bytes
from compgen.data.records import ARCHIVE, HEAD_BYTES, LARGE_TEXT, PARQUET, format_of_columns, is_artefact
from compgen.errors import InputError, Message

# Reading foreign files: limits of size, encodings, and kinds of files that cannot be read.


MEGABYTE = 1_000_000
#: Larger files are not a measurement in text form: a million tracer lengths have 80 MB.
MOST_BYTES = 128 * MEGABYTE
#: Native files are read faster, but they must also fit into the memory of a workstation.
MOST_OWN_BYTES = LARGE_TEXT

#: Captures over time are read in pieces.
MOST_CAPTURE_BYTES = 4_000_000_000
#: Larger numbers are refused (a number of 400 digits becomes infinite).
LARGEST = 1e300
#: Encodings tried in turn without a byte-order mark; the last one reads everything.
ENCODINGS = ("utf-8", "cp1252", "latin-1")
#: Instruments of one maker write user text in the code page of the computer (see :mod:`compgen.foreign.laser_files`).
ENCODINGS_EAST = ("utf-8", "gbk", "latin-1")
#: Position, deviation, error, forward, backward, temperature, positioning; two characters do not occur by chance.
_CHINESE = (
    "\u4f4d\u7f6e", "\u504f\u5dee", "\u8bef\u5dee", "\u6b63\u5411", "\u53cd\u5411", "\u6e29\u5ea6",
    "\u5b9a\u4f4d",
)  # fmt: skip
_MARKS = ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))
_BINARY = (
    (b"\xd0\xcf\x11\xe0", "an old Excel workbook (.xls) or one with a password; save it as .xlsx without a password"),
    (b"%PDF", "a PDF; export the numbers as text or .xlsx"),
    (b"\x1f\x8b", "compressed (gzip); unpack it first (the archive of a control: then volcomp read, or --active)"),
    (b"7z\xbc\xaf", "compressed (7z); unpack it first"),
    (b"Rar!", "compressed (rar); unpack it first"),
    (b"\x89PNG", "a picture; give the numbers as text or .xlsx"),
    (b"\xff\xd8\xff", "a picture; give the numbers as text or .xlsx"),
)
#: Files of controls by what a line begins with, the control, and the name of a reader of their tables.
_BACKUPS = (
    (re.compile(rb"(?m)^\s*(?:N\d+\s+)?\$(?:AN|AA|MA|MN|MC|MM|SN|SC|SA)_\w+|^\s*CHANDATA\s*\(|\0_N_\w+_INI"), "SINUMERIK",
     "siemens-cec"),
    (re.compile(rb"(?m)^\s*PARA1\d\d\(\)|^\s*N4\d{3}P-?\d"), "Mitsubishi", "mitsubishi"),
    (re.compile(rb"(?m)^\s*N\d{4,5}\s?[QALTSP]\d{1,4}\s?[APLM]-?\d"), "FANUC", "fanuc-pitch"),
    (re.compile(rb"(?im)^\s*BEGIN\s+\S+\.(?:COM|CMA)\b"), "HEIDENHAIN", "heidenhain-com"),
    (re.compile(rb"(?m)^\s*kw\.ssfk"), "TwinCAT or ISG", "twincat-lists"),
    (re.compile(rb"(?im)^[^;\n]*\bDEFINE\s+COMP\b"), "PMAC", "pmac"),
)  # fmt: skip
_MARKUP = ("<?xml", "<!doctype", "<html", "<svg")


@dataclass(frozen=True)
class Text:
    """A text file as read, with line feeds as line ends, and its encoding."""

    path: Path
    text: str
    encoding: str

    def fail(self, message: str, line: int | None = None, field: str | None = None) -> InputError:
        """Return the error about a line of this file (counted from 1)."""
        return InputError(message, file=self.path, line=line, field=field)

    @property
    def ended(self) -> bool:
        """Whether the last line has a line end."""
        return self.text.endswith("\n")


def check_size(path: Path, most: int = MOST_BYTES) -> int:
    """Return the size in bytes; InputError for a missing, empty or too large file, or a folder."""
    if path.is_dir():
        raise InputError("is a folder; expected a file", file=path)
    try:
        size = os.stat(path).st_size
    except FileNotFoundError:
        raise InputError(Message("file-missing", "no such file"), file=path) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", file=path) from error
    if size > most:
        raise InputError(
            f"has {size / MEGABYTE:.0f} MB; at most {most / MEGABYTE:.0f} MB are read, more than a million readings need; "
            "is it the right file? If so, thin it out or split it",
            file=path,
        )
    if size == 0:
        raise InputError("is empty", file=path)
    return size


def read_head(path: Path) -> bytes:
    """Return the first bytes of a file; InputError for kinds of file that contain no readable numbers."""
    head = read_bytes(path, HEAD_BYTES)
    for mark, what in _BINARY:
        if head.startswith(mark):
            raise InputError(f"is {what}", file=path)
    for pattern, control, reader in _BACKUPS:
        if pattern.search(head):
            text = (
                f"is a backup or a table of a {control} control, not a measurement: 'volcomp read MACHINE FILE --controller "
                f"{reader} --points POINTS --out OUT' shows what it does, and run and identify take it with --active FILE as the "
                "compensation that was on while the machine was measured"
            )
            raise InputError(text, file=path)
    return head


def decode_head(head: bytes) -> str:
    """Return the beginning of a file as text, to identify it; nothing is refused here."""
    encoding = next((name for mark, name in _MARKS if head.startswith(mark)), None) or _without_mark(head) or "utf-8"
    return head.decode(encoding, errors="replace").replace("\r\n", "\n").replace("\r", "\n")


def read_source(path: Path, encodings: Sequence[str] = ENCODINGS, most: int = MOST_BYTES) -> Text:
    """Read a text file in whatever encoding it has.

    The order is: a byte-order mark, zero bytes in every second place (UTF-16), then ``encodings`` in turn.
    """
    check_size(path, most)
    content = read_bytes(path)
    encoding, text = _decode(path, content, encodings)
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if text.lstrip().lower().startswith(_MARKUP):
        raise InputError("is XML or HTML; export the numbers as text (CSV) or .xlsx", file=path)
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        why = "contains NUL bytes: it is not text, or was not written completely; the backup of a control goes to 'volcomp read'"
        raise InputError(f"{why}, or to run with --active", file=path, line=line)
    check_lines(text, path)
    return Text(path, text, encoding)


def _decode(path: Path, content: bytes, encodings: Sequence[str]) -> tuple[str, str]:
    marked = next((name for mark, name in _MARKS if content.startswith(mark)), None)
    chosen = [marked] if marked else [_without_mark(content[:HEAD_BYTES]) or "", *encodings]
    for encoding in filter(None, chosen):
        try:
            if encoding == "cp1252":  # words of a measurement in the code page of China
                head = content[:HEAD_BYTES].decode("gb18030", errors="ignore")
                if any(word in head for word in _CHINESE):
                    return "gb18030", content.decode("gb18030")
            return encoding, content.decode(encoding).lstrip("\ufeff")
        except UnicodeDecodeError as error:
            if encoding.startswith("utf-16"):
                raise InputError(f"is truncated or damaged UTF-16 text: {error.reason}", file=path) from error
            if encoding == chosen[-1]:
                line = content[: error.start].count(b"\n") + 1
                raise InputError(
                    "is not UTF-8 text although its byte-order mark says so", file=path, line=line
                ) from error
    raise InputError("is text in no known encoding; save it as UTF-8", file=path)


def _without_mark(head: bytes) -> str | None:
    """UTF-16 without a mark: Latin letters and digits leave every second byte zero."""
    if len(head) < 4 or b"\0" not in head:
        return None
    even, odd = head[0::2].count(0) / len(head[0::2]), head[1::2].count(0) / len(head[1::2])
    if odd > 0.6 and even < 0.2:
        return "utf-16-le"
    return "utf-16-be" if even > 0.6 and odd < 0.2 else None


def parse_number(word: str) -> float | None:
    """Return a plain finite number, decimal point or comma, or None for anything else.

    >>> parse_number("-.0033"), parse_number("1,25"), parse_number("1_0"), parse_number("inf")
    (-0.0033, 1.25, None, None)
    """
    try:
        plain = float(word)
    except ValueError:
        plain = LARGEST
    if abs(plain) < LARGEST and word.isascii() and "_" not in word:
        return plain
    text = word.strip().replace("\u2212", "-")
    if text.count(",") == 1 and "." not in text:
        text = text.replace(",", ".")
    if not text.isascii() or not any(char.isdigit() for char in text) or "_" in text:
        return None
    try:
        value = float(text)
    except ValueError:
        return None
    return value if abs(value) < LARGEST else None


def shown(word: object, most: int = 40) -> str:
    """Return a cell of a user's file for a message: one line, short, in its own script; repr escapes what is not printable."""
    return repr(" ".join(str(word).split())[:most])


# Dates and times of instruments and spreadsheets; the order of day and month is never guessed.
#
# A date whose numbers allow several orders (``03/04/2025``) is resolved by another date of the same column that allows
# only one order, or by the user (``--dates``). Dots mean day.month.year, a year of four digits in front year-month-day,
# and a month may have its English or German name.


Order = Literal["dmy", "mdy", "ymd"]
ORDERS: tuple[Order, ...] = ("dmy", "mdy", "ymd")
#: Days since 1899-12-30 that spreadsheets write for dates of the years 2000 to 2099.
SERIAL_DAYS = (36526.0, 73050.0)
MOST_CHARACTERS = 60
_SERIAL_ZERO = datetime(1899, 12, 30)
_CLOCK = re.compile(
    r"(?<![\d:])(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d{1,9}))?)?(?![\d:])\s{0,2}([aApP])?(?:\.?[mM]\b)?"
)
_ZONE = re.compile(r"\s?(Z|[+-]\d{2}:?\d{2})$")
_NUMBERS = re.compile(r"(?<!\d)(\d{4}|\d{1,2})\s?([./-])\s?(\d{1,2})\s?\2\s?(\d{4}|\d{1,2})(?!\d)")
_WORD = re.compile(r"[A-Za-z\u00e4\u00c4]{3,9}")
#: Month by the first three letters of its name, English or German.
_MONTHS = {
    "jan": 1, "feb": 2, "mar": 3, "apr": 4, "may": 5, "jun": 6, "jul": 7, "aug": 8, "sep": 9, "oct": 10, "nov": 11, "dec": 12,
    "m\u00e4r": 3, "mrz": 3, "mae": 3, "mai": 5, "okt": 10, "dez": 12,
}  # fmt: skip
_MONTH_NAMES = frozenset([
    "january", "february", "march", "april", "may", "june", "july", "august", "september", "october",
    "november", "december", "januar", "februar", "märz", "maerz", "mai", "juni", "juli", "oktober", "dezember",
    "sept",
])  # fmt: skip


@dataclass(frozen=True)
class Written:
    """One date as written: its value in each possible order (at midnight), seconds of the day, and the time zone.

    ``day_text`` is the text without the time of day.
    """

    text: str
    days: Mapping[Order, datetime]
    clock_s: float | None
    zone: str
    day_text: str = ""

    @property
    def settled(self) -> bool:
        """Whether all possible orders give the same day."""
        return len(set(self.days.values())) == 1


def read_date(text: str) -> Written | None:
    """Return the date, the time, or both, in a cell or a line; None if it is neither.

    >>> sorted(read_date("03/04/2025 12:58").days), read_date("13/04/2025").settled, read_date("10:46 Dec 12 2016").clock_s
    (['dmy', 'mdy'], True, 38760.0)
    """
    content = text.strip().strip("\"'")
    if not 4 <= len(content) <= MOST_CHARACTERS:
        return None
    found = _CLOCK.search(content)
    clock_s = _seconds(found) if found else None
    if found and clock_s is None:
        return None
    before, after = (content[: found.start()], content[found.end() :]) if found else (content, "")
    zone = _ZONE.match(after)
    rest = before if zone else f"{before} {after}"
    days = _days(rest)
    if not days and (clock_s is None or re.search(r"\d", rest)):
        return None
    return Written(content, days, clock_s, zone.group(1) if zone else "", rest)


@lru_cache(maxsize=4096)
def _days(text: str) -> Mapping[Order, datetime]:
    """Return the value in each order of a date in numbers, or of one whose month is a word (12 Dec 2016, 2016-Dec-12)."""
    found = _NUMBERS.search(text)
    if found:
        first, mark, second, third = found.group(1), found.group(2), found.group(3), found.group(4)
        if len(first) == 4:
            orders: tuple[Order, ...] = ("ymd",)
        elif mark == ".":
            orders = ("dmy",)
        else:
            orders = ("dmy", "mdy") if len(third) == 4 else ORDERS
        made = {order: _day(dict(zip(order, (first, second, third), strict=True))) for order in orders}
        if any(made.values()):
            return {order: day for order, day in made.items() if day is not None}
    words = [word.lower() for word in _WORD.findall(text)]
    named = [word[:3] for word in words if len(word) == 3 or word in _MONTH_NAMES]
    months = [_MONTHS.get(name) for name in named if name in _MONTHS]
    numbers = re.findall(r"\d+", text)
    years = [number for number in numbers if len(number) == 4]
    days = [number for number in numbers if len(number) <= 2]
    if not len(months) == len(years) == len(days) == 1 or len(numbers) != 2:
        return {}
    day = _day({"y": years[0], "m": str(months[0]), "d": days[0]})
    return {} if day is None else dict.fromkeys(ORDERS, day)


def _seconds(found: re.Match[str]) -> float | None:
    hour, minute, second = (int(found.group(k) or 0) for k in (1, 2, 3))
    half = (found.group(5) or "").lower()
    if hour > 23 or minute > 59 or second > 59 or (half and not 1 <= hour <= 12):
        return None
    hour = hour % 12 + 12 * (half == "p") if half else hour
    return 3600.0 * hour + 60.0 * minute + second + float(f"0.{found.group(4) or 0}")


def _day(parts: Mapping[str, str]) -> datetime | None:
    year = int(parts["y"]) + (2000 if len(parts["y"]) <= 2 else 0)
    try:
        return datetime(year, int(parts["m"]), int(parts["d"]))
    except ValueError:
        return None


def serial_date(days: float) -> Written | None:
    """Return the date that a spreadsheet wrote as a number of days; None for a number of no year 2000 to 2099."""
    if not SERIAL_DAYS[0] <= days < SERIAL_DAYS[1]:
        return None
    at = _SERIAL_ZERO + timedelta(seconds=round(86400.0 * days, 3))
    midnight = at.replace(hour=0, minute=0, second=0, microsecond=0)
    return Written(f"{days:g}", dict.fromkeys(ORDERS, midnight), (at - midnight).total_seconds(), "")


def order_of(dates: Sequence[Written], chosen: Order | None = None) -> Order | None:
    """Return the order of day, month and year in which all dates of a column can be read, None if it remains open.

    Raises
    ------
    InputError
        for dates that no order, or not the chosen one, fits.
    """
    dates = list({date.day_text or date.text: date for date in dates}.values())
    open_ones = [date for date in dates if not date.settled]
    possible = [order for order in ORDERS if all(order in date.days for date in open_ones + _telling(dates))]
    if chosen is not None and open_ones and chosen not in possible:
        wrong = next(date for date in [*open_ones, *_telling(dates)] if chosen not in date.days)
        raise InputError(f"{shown(wrong.text)} is not a date in the order {chosen}", field="--dates")
    if not open_ones:
        return chosen or "ymd"
    if not possible:
        raise InputError(f"dates such as {shown(open_ones[0].text)} do not all fit one order of day, month and year")
    if chosen is not None:
        return chosen
    days = [{date.days[order] for order in possible} for date in open_ones]
    return possible[0] if all(len(found) == 1 for found in days) else None


def _telling(dates: Sequence[Written]) -> list[Written]:
    """Return the dates with only one order, with the separators of the open ones (a leading year tells nothing)."""
    marks = {found.group(2) for date in dates if not date.settled and (found := _NUMBERS.search(date.text))}
    return [
        date
        for date in dates
        if date.settled and (found := _NUMBERS.search(date.text)) and found.group(2) in marks and "ymd" not in date.days
    ]


def moment(date: Written, order: Order) -> datetime:
    """Return date and time by an order; an unambiguous date needs none."""
    day = date.days.get(order) or next(iter(date.days.values()))
    return day + timedelta(seconds=date.clock_s or 0.0)


def iso(date: Written, order: Order) -> str:
    """Return a date in ISO 8601, without a time if none was written.

    >>> iso(read_date("13.4.2025 09:05"), "dmy"), iso(read_date("2025-04-13"), "dmy")
    ('2025-04-13T09:05:00', '2025-04-13')
    """
    at = moment(date, order)
    zone = date.zone if len(date.zone) != 5 else f"{date.zone[:3]}:{date.zone[3:]}"
    return at.date().isoformat() if date.clock_s is None else f"{at.isoformat(timespec='seconds')}{zone}"


def header_date(text: str, chosen: Order | None = None) -> tuple[str | None, str | None]:
    """Return the ISO form of a date in a header, and what is wrong with it: (iso, None), (None, why) or (None, None).

    >>> header_date("10/02/2025 12:58:22")[0], header_date("10/02/2025 12:58:22", "dmy")[0]
    (None, '2025-02-10T12:58:22')
    """
    if not text.strip():
        return None, None
    found = read_date(text)
    if found is None or not found.days:
        return None, f"the date {shown(text)} is not understood and was skipped"
    order = order_of([found], chosen)
    if order is None:
        days = " or ".join(sorted({day.date().isoformat() for day in found.days.values()}))
        return None, f"the date {shown(text)} may be {days}: it is skipped; give --dates dmy, mdy or ymd to keep it"
    return iso(found, order), None


# Which files are native ones, by their columns.


def native_format(path: Path, *, in_parts: bool = False) -> str | None:
    """Return the kind of a native file, None for a foreign one; InputError for files without data.

    With ``in_parts`` lengths may have any size.
    """
    if path.name.lower().endswith((ARCHIVE, PARQUET)):
        return "lengths"
    check_size(path, MOST_CAPTURE_BYTES)
    head = read_head(path)
    if head.startswith((b"PK\x03\x04", b"HEADER::", b"\xff\xfe", b"\xfe\xff")):
        return None
    text = decode_head(head).lstrip("\ufeff")
    kind = format_of_columns(names_in_header(text), complete=True)
    if kind == "part" and is_artefact(path, text):
        return "artefact"
    if kind not in (None, "sixdof", "part") and not (in_parts and kind == "lengths"):
        check_size(path, MOST_OWN_BYTES)
    return kind
