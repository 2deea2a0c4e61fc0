"""Text that LinuxCNC reads: lines one by one, so that garbage of any size fails at its first wrong line; numbers; units."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

from compgen.controllers.base import SourceFile
from compgen.core.tomlio import Section, choice

#: A number as C reads it with %lf, less hexadecimal digits, ``inf`` and ``nan``.
_NUMBER = re.compile(r"[+-]?(?:\d{1,40}(?:\.\d{0,40})?|\.\d{1,40})(?:[eE][+-]?\d{1,4})?")
_BLANK = re.compile(r"[ \t\r\n]*+")
#: What is quoted of a wrong word.
SHOWN = 40
#: Lengths of one unit of the machine, [TRAJ] LINEAR_UNITS: everything that LinuxCNC reads is in machine units.
MM_PER_UNIT = {"mm": 1.0, "inch": 25.4}


def take_machine_units(section: Section) -> str:
    """Return the setting ``machine_units``: [TRAJ] LINEAR_UNITS of the machine, ``"mm"`` (the default) or ``"inch"``."""
    units: str = section.take("machine_units", choice(*MM_PER_UNIT), "mm")
    return units


def check_size(source: SourceFile, most: int) -> None:
    """Raise InputError for a text that is longer than any file of its kind."""
    if len(source.text) > most:
        raise source.fail(f"has {len(source.text)} characters; such a file has at most {most}: it is no table", 1)


def lines_of(source: SourceFile) -> Iterator[tuple[int, str, bool]]:
    """Yield number (from 1), text without its end, and whether the line has an end, of each line (LF or CRLF).

    Of blank lines behind each other, however many, only the first is yielded.
    """
    text, start, number = source.text, 0, 1
    while start < len(text):
        blank = _BLANK.match(text, start)
        after = text.rfind("\n", start, blank.end() if blank else start) + 1
        if after > start:
            yield number, "", True
            start, number = after, number + text.count("\n", start, after)
            continue
        end = text.find("\n", start)
        last = len(text) if end < 0 else end
        yield number, text[start:last].removesuffix("\r"), end >= 0
        start, number = last + 1, number + 1


def number_in(source: SourceFile, line: int, word: str, what: str) -> float:
    """Return a finite number; InputError with the line for a decimal comma, nan, inf or anything else."""
    if _NUMBER.fullmatch(word) and math.isfinite(value := float(word)):
        return value
    hint = "; LinuxCNC reads '.' as decimal point" if "," in word else ""
    raise source.fail(f"{word[:SHOWN]!r} is not a number; {what} is due{hint}", line)


def whole_in(source: SourceFile, line: int, word: str, what: str, limits: tuple[int, int]) -> int:
    """Return a whole number within ``limits`` (both included); else InputError with the line."""
    if not re.fullmatch(r"\d{1,9}", word) or not limits[0] <= int(word) <= limits[1]:
        raise source.fail(f"{word[:SHOWN]!r} is not {what}; {limits[0]} ... {limits[1]} is due", line)
    return int(word)
