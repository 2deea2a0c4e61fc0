"""Scanning the text files of controls: lines, numbers, and whether a file is complete.

Bad text of any size must lead to an :class:`InputError` with its line, never to a long wait: sizes are checked
first, and every repetition in a pattern has an upper bound.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from decimal import Decimal

from compgen.controls.shared.base import SourceFile
from compgen.data.names import LARGEST
from compgen.errors import one_line

MOST_LINES = 200_000
#: Number of characters quoted from a wrong word.
SHOWN = 40


@dataclass
class Findings:
    """What files of another program contain in addition to the tables, for a short summary.

    ``counts`` are by what was skipped, ``apart`` the tables of axes not in the machine file, ``notes`` what else the
    user should know.
    """

    counts: dict[str, int] = field(default_factory=dict)
    apart: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def count(self, what: str, number: int = 1) -> None:
        """Count something that was skipped or filled in."""
        self.counts[what] = self.counts.get(what, 0) + number

    def statements(self) -> list[str]:
        """Return the summary with at most one line of each kind."""
        skipped = ", ".join(f"{what} ({number})" for what, number in self.counts.items())
        found = [f"skipped or filled in: {skipped}"] if skipped else []
        if self.apart:
            found.append("tables of axes that are not in the machine file, kept separate: " + "; ".join(self.apart))
        return found + list(dict.fromkeys(self.notes))


def number_pattern(before: int = 40, after: int = 40, exponent: int = 0) -> re.Pattern[str]:
    """Return the pattern of a decimal number with at most so many digits before and after the point.

    ``exponent`` is the number of digits an exponent may have; 0: no exponent.
    """
    power = rf"(?:[eE][+-]?[0-9]{{1,{exponent}}})?" if exponent else ""
    return re.compile(rf"[+-]?(?:[0-9]{{1,{before}}}(?:\.[0-9]{{0,{after}}})?|\.[0-9]{{1,{after}}}){power}")


FLOATING, FIXED_POINT = number_pattern(exponent=3), number_pattern(15, 15)
_WITH_EXPONENT = re.compile(r"[+-]?[0-9.]{1,30} ?EX?[ +-]{0,2}[0-9]{1,10}", re.IGNORECASE)
_DECLARED = re.compile(r"(?://|#|;|')\s{0,9}(?:records|entries|tables):\s{0,9}([0-9]{1,9})\s*$")


def check_size(source: SourceFile, most: int) -> None:
    """Reject a text that is longer than any file of its kind."""
    if len(source.text) > most:
        raise source.fail(f"has {len(source.text)} characters; a file of this kind has at most {most}", 1)


def _check_lines(source: SourceFile) -> None:
    count = source.text.count("\n")
    if count > MOST_LINES:
        raise source.fail(f"has {count} lines; at most {MOST_LINES} are read", MOST_LINES)


def plain_lines(source: SourceFile, most: int, longest: int) -> list[str]:
    """Return all lines without line ends (LF, CRLF or CR).

    InputError for more than ``most`` characters or :data:`MOST_LINES`, a line longer than ``longest``, and any
    character, even in a comment, that is neither printable ASCII nor a tab.
    """
    check_size(source, most)
    _check_lines(source)
    text = source.text.replace("\r\n", "\n").replace("\r", "\n")
    if strange := re.search(r"[^\t\n -~]", text):
        message = f"contains the character {ascii(strange.group())}; only printable ASCII is allowed"
        raise source.fail(message, text.count("\n", 0, strange.start()) + 1)
    lines = text.split("\n")
    for number, line in enumerate(lines, start=1):
        if len(line) > longest:
            raise source.fail(f"the line has {len(line)} characters; at most {longest} are allowed", number)
    return lines


def content_lines(source: SourceFile, comment: str = "//", longest: int = 4000) -> list[tuple[int, str]]:
    """Return the lines of a file without comments and blank lines, with their line numbers; InputError for garbage.

    A comment may contain any character.
    """
    _check_lines(source)
    found = []
    for number, line in enumerate(source.text.split("\n"), start=1):
        if len(line) > longest:
            raise source.fail(f"the line has {len(line)} characters; at most {longest} are read", number)
        text = line.partition(comment)[0].strip(" \t\r\f")
        if not (text.isascii() and text.replace("\t", " ").isprintable()):
            raise source.fail(f"{one_line(text)[:SHOWN]!r} contains characters that are not printable ASCII", number)
        if text:
            found.append((number, text))
    if not found:
        raise source.fail("contains no data; is it the right file, or is it truncated?")
    return found


def floating(source: SourceFile, line: int, word: str, what: str, pattern: re.Pattern[str] = FLOATING) -> float:
    """Return a word as a finite number, with or without an exponent; InputError says why it is not one.

    ``what`` names the number in the message. No table has numbers beyond ``LARGEST``, and sums and products of others are finite.
    """
    if pattern.fullmatch(word) and math.isfinite(value := float(word)):
        if abs(value) > LARGEST:
            raise source.fail(f"{what}: {word[:SHOWN]} is larger than {LARGEST:g}, the largest number allowed", line)
        return value
    hint = "; the decimal mark is '.', columns are separated by blanks" if "," in word or ";" in word else ""
    raise source.fail(f"{what}: {one_line(word)[:SHOWN]!r} is not a finite number{hint}", line)


def fixed_point(
    source: SourceFile, line: int | None, word: str, what: str, pattern: re.Pattern[str] = FIXED_POINT
) -> Decimal:
    """Return a word as an exact decimal number; InputError for an exponent, a comma, or anything else."""
    if pattern.fullmatch(word):
        return Decimal(word)
    if _WITH_EXPONENT.fullmatch(word):
        fault = "has an exponent; expected plain decimals such as 0.000010"
    elif "," in word:
        fault = "has a comma; the decimal mark is '.'"
    else:
        fault = "is not a number; expected plain decimals such as -0.012"
    raise source.fail(f"{what}: {one_line(word)[:SHOWN]!r} {fault}", line)


def uses_exponent(words: Iterable[str]) -> bool:
    """Whether one of the numbers is written with an exponent."""
    return any("e" in word or "E" in word for word in words)


def check_complete(source: SourceFile, count: int, what: str = "records") -> None:
    """Reject a truncated file: if a comment declares its ``records``, it must contain them and end with a line end."""
    declared = next((found for line in source.text.split("\n") if (found := _DECLARED.match(line[:200].strip()))), None)
    if declared is None:
        return
    if int(declared.group(1)) != count:
        raise source.fail(
            f"declares {declared.group(1)} {what} but contains {count}: it is truncated or was edited by hand"
        )
    if not source.text.endswith("\n"):
        raise source.fail("the last line has no line end: the file is truncated", source.text.count("\n") + 1)
