"""Records of FANUC parameter and pitch data files: ``%``, blocks ``N... A... P...``, ``%``.

The grammar is that of the Series 15i (parameter manual B-63330EN, board manual B-63322EN-2); a type word ``Q``, white
space between words, ``(comments)``, ``;`` as printed block end, LF and CR LF are taken as well.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal

from compgen.controllers.base import SourceFile
from compgen.core.text import one_line
from compgen.errors import InputError

#: No parameter file of a control is anywhere near this long.
MOST_CHARACTERS = 4_000_000
#: Nor are there more numbers than this.
MOST_BLOCKS = 100_000
#: Nor is any block as long as this: 99 axes with 20 characters each.
MOST_IN_BLOCK = 2000

_COMMENT = re.compile(r"\([^()]*\)")
_RECORD = re.compile(r"[ \t]*N(\d{1,8})(?!\d)([A-Z0-9.+\- \t]*)", re.ASCII)
_WORD = re.compile(r"[ \t]*([A-Z])([+-]?(?:\d{1,12}(?:\.\d{0,12})?|\.\d{1,12}))(?![\d.])", re.ASCII)


@dataclass(frozen=True)
class Record:
    """One block of a file: its number (of so many digits, perhaps filled with zeros), and the text behind it."""

    number: int
    rest: str
    file: SourceFile
    line: int
    digits: int = 0
    filled: bool = False

    def fail(self, message: str) -> InputError:
        """Return the error that points at this record."""
        return self.file.fail(f"N{self.number:05d}: {message}", self.line)

    def words(self) -> list[tuple[str, str]]:
        """Return the words behind the number as (letter, number as text)."""
        text, found, at = self.rest.rstrip(), [], 0
        while at < len(text):
            word = _WORD.match(text, at)
            if word is None:
                raise self.fail(
                    f"{one_line(text[at : at + 20])!r} is not a word; a letter and a plain decimal number are due"
                )
            found.append((word[1], word[2]))
            at = word.end()
        return found

    def whole(self, text: str, low: int, high: int) -> int:
        """Return ``text`` as a whole number within limits (a decimal point with nothing behind it is harmless)."""
        value = Decimal(text)
        if value != value.to_integral_value() or not low <= value <= high:
            raise self.fail(f"{text} is given; a whole number from {low} to {high} is due")
        return int(value)


def read_records(file: SourceFile) -> Iterator[Record]:
    """Yield the records between pairs of ``%``; InputError for anything else, and for a missing last ``%``."""
    if len(file.text) > MOST_CHARACTERS:
        raise file.fail(f"holds {len(file.text)} characters; that is no parameter file (at most {MOST_CHARACTERS})")
    lines = file.text.split("\n" if "\n" in file.text else "\r")
    inside, marks, blocks = False, 0, 0
    for number, line in enumerate(lines, start=1):
        bare = _COMMENT.sub(" ", line) if "(" in line else line
        for piece in bare.split(";"):
            block = piece.strip(" \t\r\ufeff")
            if block == "%":
                inside, marks = not inside, marks + 1
            elif block:
                blocks += 1
                if blocks > MOST_BLOCKS:
                    raise file.fail(f"holds more than {MOST_BLOCKS} blocks; that is no parameter file", number)
                yield _record(file, block, number, inside)
    if marks == 0:
        raise file.fail("holds no '%'; a FANUC file begins and ends with one")
    if inside:
        raise file.fail("the last '%' is missing: the file is truncated", len(lines))


def _record(file: SourceFile, block: str, line: int, inside: bool) -> Record:
    if not inside:
        raise file.fail(f"{one_line(block[:20])!r} stands outside the pair of '%'", line)
    if len(block) > MOST_IN_BLOCK:
        raise file.fail(f"this block has {len(block)} characters; at most {MOST_IN_BLOCK} are possible", line)
    found = _RECORD.match(block)
    if found is None:
        raise file.fail(f"{one_line(block[:20])!r} is not a block; 'N' and a number of at most 8 digits are due", line)
    if found.end() != len(block):
        what = one_line(block[found.end() : found.end() + 20])
        raise file.fail(f"{what!r} has no place in a block; words are a letter and a decimal number with '.'", line)
    return Record(int(found[1]), found[2], file, line, len(found[1]), found[1].startswith("0"))


def type_word(record: Record, words: Sequence[tuple[str, str]]) -> tuple[int | None, list[tuple[str, str]]]:
    """Return the type word ``Q`` (0 pitch data, 1 parameter, None if there is none) and the other words."""
    for place in (0, -1):
        if words and words[place][0] == "Q":
            others = list(words)
            return record.whole(others.pop(place)[1], 0, 9), others
    return None, list(words)


def axis_values(record: Record, words: Sequence[tuple[str, str]]) -> list[tuple[int, str]]:
    """Return the (axis number, value as text) pairs ``A1P40A2P20`` (or ``P40A1``) of a parameter of the axis type."""
    if not words or len(words) % 2:
        raise record.fail("pairs of an axis word A and a value word P are due, e.g. A1P40A2P20")
    pairs = []
    for first, second in zip(words[::2], words[1::2], strict=True):
        (axis_letter, axis), (value_letter, value) = (second, first) if second[0] == "A" else (first, second)
        if axis_letter != "A":
            raise record.fail(f"{axis_letter}{axis} stands where an axis word A is due, e.g. A1P40")
        if value_letter == "I":
            raise record.fail("the value word I is inch data; punch the file with the control set to mm")
        if value_letter not in ("P", "M"):
            raise record.fail(f"{value_letter}{value} stands where a value word P is due, e.g. A1P40")
        pairs.append((record.whole(axis, 1, 99), value))
    return pairs
