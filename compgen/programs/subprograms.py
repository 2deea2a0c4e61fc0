"""Programs as their control executes them: calls are written out, and numbers without a decimal point get it.

Subprograms are those in the file of their program, or in files of folders that are given: each place that they lead to needs
its own correction. Variables that are known before the program runs become numbers; there are no jumps, so that each is known
where it is used.

``M98 P1001 L3`` calls the blocks from ``O1001`` to ``M99`` three times, as does ``M98 P31001`` of FANUC; ``M97 P100`` of
Haas those from ``N100``; ``G65 P1001 A5.`` of FANUC and ``o<hole> call [5]`` of LinuxCNC give them variables of their own.
What stands in comments, or in blocks that the control skips, calls nothing and ends nothing.
"""

from __future__ import annotations

import functools
import math
import operator
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, NoReturn

import numpy as np

from compgen.errors import InputError, visible_line
from compgen.programs.dialects import MARK
from compgen.programs.path import IntArray

#: Calls within calls, and blocks of a program that is written out.
DEEPEST, MOST_BLOCKS = 10, 5_000_000
#: Turns of all loops of a program.
MOST_TURNS = 100_000
#: What makes a program one that is followed here, in capitals; each begins with its letter, which is found fast.
_MENTIONED = (
    re.compile(rb"M[ \t]*+(?:\+[ \t]*+)?0*+9[78]"),
    re.compile(rb"G[ \t]*+0*+6[58](?![\d.])"),
    re.compile(rb"#"),
    re.compile(rb"\["),
    re.compile(rb"O(?:\d++|<[^<>\n]*+>)[ \t]*+CALL"),
)
_WORD = re.compile(rb"([A-Z])[ \t]*+((?:[+-][ \t]*+)?(?:\d++(?:\.\d*+)?|\.\d++))", re.IGNORECASE)
#: What is no code: comments, program names; of FANUC what follows a semicolon is another block, which is refused later.
_LATER = {
    "fanuc": re.compile(rb"\([^()\n]*\)|<[^<>\n]*>|;[^\n]*"),
    "linuxcnc": re.compile(rb"\([^()\n]*\)|;[^\n]*"),
}
#: Words with a number without a decimal point that may be a length or an angle, and codes that matter to it.
_INTEGER = re.compile(rb"([XYZUVWABCIJKQR])[ \t]*+((?:[+-][ \t]*+)?\d++)(?![\d.])", re.IGNORECASE)
_G_CODE = re.compile(rb"G[ \t]*+(\d++(?:\.\d*+)?)", re.IGNORECASE)
_DRILLS = frozenset(f"G{k}" for k in (73, 74, 76, *range(81, 90)))
_ENDS_DRILLING = frozenset(("G0", "G1", "G2", "G3", "G80"))
#: A line is read no further, bytes.
_LONGEST_LINE = 1 << 16
_SKIPPED = re.compile(rb"\s*/")


@dataclass(frozen=True)
class WrittenOut:
    """A program with its calls written out; ``line`` (n,) is for each of its lines the one in the file it is from.

    A line of a subprogram in another file has that of the call; ``places`` says where it is. ``resolved``: the text has
    no variables or macros any more, and the second reading takes it as it is.
    """

    content: bytes
    line: IntArray
    called: tuple[str, ...]
    places: Sequence[tuple[Path, int]] = ()
    resolved: bool = False
    #: Variables that became numbers.
    variables: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Block:
    """One line of a program: its text, its code without comments, and whether it is one with ``/``."""

    text: bytes
    code: bytes
    slash: bool

    @cached_property
    def words(self) -> list[tuple[bytes, float]]:
        """Its words; none where a parenthesis is open, which the reader refuses."""
        if b"(" in self.code or b")" in self.code:
            return []
        found = _WORD.finditer(self.code)
        return [(word[1].upper(), float(re.sub(rb"\s", b"", word[2]))) for word in found]

    def has(self, *codes: float) -> bool:
        """Whether it has one of the M codes."""
        return b"M" in self.code.upper() and any(letter == b"M" and value in codes for letter, value in self.words)

    def is_macro_call(self) -> bool:
        """Whether it calls a macro with variables of its own (G65)."""
        return any(letter == b"G" and value == 65.0 for letter, value in self.words)

    def given(self, letter: bytes) -> float | None:
        """The value of a word."""
        return next((value for found, value in self.words if found == letter), None)

    def number(self, letters: bytes) -> bytes | None:
        """The number of a program or block that begins here, after one of ``letters``."""
        found = re.match(rb"\s*(?:N\s*\d+\s*)?[" + letters + rb"]\s*0*(\d+)(?!\d)", self.code, re.IGNORECASE)
        return found[1] if found else None

    def without(self, letters: bytes) -> bytes:
        """Its text without its M97 to M99 and the words of ``letters``; comments stay."""
        text = self.text
        for word in reversed(list(_WORD.finditer(self.code))):
            letter, value = word[1].upper(), float(re.sub(rb"\s", b"", word[2]))
            if letter in letters or (letter == b"M" and value in (97, 98, 99)):
                start = len(text[: word.start()].rstrip(b" \t"))
                text = text[:start] + text[word.end() :]
        return text


class Pointed:
    """A program of FANUC whose numbers without a decimal point are given it: read in parts, as a stream.

    ``X500`` is ``X500.`` where integers are mm (inch in G20). Where they are increments it is ``X0.5`` with increments of 0.001
    mm, which are 0.0001 inch and 0.001 deg. Lengths, angles, radii and pecks are such numbers; G, M, T, H, D, N, O, P, S, F, L,
    repeats (K of a drilling cycle), and the words of dwells and of settings (``plain`` codes) are not. Zero stays as it is.
    """

    def __init__(self, stream: BinaryIO, increment_mm: float | None, plain: Collection[str], *, inch: bool) -> None:
        self._stream, self._plain, self._inch, self._drills = stream, plain, inch, False
        self._increment = None if increment_mm is None else Decimal(repr(increment_mm))
        #: Whether a number has been given its point.
        self.used = False

    def __enter__(self) -> Pointed:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def read(self, size: int) -> bytes:
        """Return the next lines, at least ``size`` bytes of the program if there are so many."""
        text = self._stream.read(size)
        text += self._stream.readline(_LONGEST_LINE) if text and not text.endswith(b"\n") else b""
        return b"".join(map(self._line, text.splitlines(keepends=True)))

    def _line(self, line: bytes) -> bytes:
        code = _LATER["fanuc"].sub(lambda part: b" " * len(part[0]), line)
        codes = [f"G{float(found[1]):g}" for found in _G_CODE.finditer(code)]
        for name in codes:
            self._inch = name == "G20" or (self._inch and name != "G21")
            self._drills = name in _DRILLS or (self._drills and name not in _ENDS_DRILLING)
        if any(name in self._plain for name in codes):
            return line
        counts = self._drills and not re.search(rb"[IJ]\s*[-+.\d]", code, re.IGNORECASE)
        for word in reversed(list(_INTEGER.finditer(code))):
            letter, number = word[1].upper(), re.sub(rb"\s", b"", word[2])
            if int(number) and not (counts and letter == b"K"):
                self.used = True
                line = line[: word.start(2)] + self._pointed(letter, number.decode()) + line[word.end(2) :]
        return line

    def _pointed(self, letter: bytes, number: str) -> bytes:
        if self._increment is None:
            return f"{number}.".encode()
        tenth = self._inch and letter not in b"ABC"
        text = f"{Decimal(number) * self._increment * (Decimal('0.1') if tenth else 1):f}"
        text = text.rstrip("0") if "." in text else f"{text}."
        return (f"+{text}" if number[0] == "+" else text).encode()


# Variables and expressions of FANUC and LinuxCNC.

FUNCTIONS: dict[str, Callable[[float], float]] = {
    "ABS": abs,
    "ACOS": lambda x: math.degrees(math.acos(x)),
    "ASIN": lambda x: math.degrees(math.asin(x)),
    "COS": lambda x: math.cos(math.radians(x)),
    "EXP": math.exp,
    "FIX": lambda x: float(math.trunc(x)),
    "FUP": lambda x: math.copysign(math.ceil(abs(x)), x),
    "LN": math.log,
    "ROUND": lambda x: math.copysign(math.floor(abs(x) + 0.5), x),
    "SIN": lambda x: math.sin(math.radians(x)),
    "SQRT": math.sqrt,
    "TAN": lambda x: math.tan(math.radians(x)),
}
#: FIX and FUP of LinuxCNC go down and up, those of FANUC towards zero and away from it.
_OF_LINUXCNC: dict[str, Callable[[float], float]] = {
    "FIX": lambda x: float(math.floor(x)),
    "FUP": lambda x: float(math.ceil(x)),
}
_ABOUT_EQUAL = 1e-4  # of LinuxCNC: numbers closer than that are equal


def _mod(a: float, b: float) -> float:
    found = math.fmod(a, b)
    return found + abs(b) if found < 0.0 else found


#: Operators of LinuxCNC, those that bind least first; FANUC has those of arithmetic, and no power.
_LEVELS: tuple[dict[str, Callable[[float, float], float]], ...] = (
    {
        "AND": lambda a, b: float(a != 0.0 and b != 0.0),
        "OR": lambda a, b: float(a != 0.0 or b != 0.0),
        "XOR": lambda a, b: float((a != 0.0) != (b != 0.0)),
    },
    {
        "EQ": lambda a, b: float(abs(a - b) < _ABOUT_EQUAL),
        "NE": lambda a, b: float(abs(a - b) >= _ABOUT_EQUAL),
        "GT": lambda a, b: float(a > b),
        "GE": lambda a, b: float(a >= b),
        "LT": lambda a, b: float(a < b),
        "LE": lambda a, b: float(a <= b),
    },
    {"+": operator.add, "-": operator.sub},
    {"*": operator.mul, "/": operator.truediv, "MOD": _mod},
    {"**": math.pow},
)
_TOKEN = re.compile(r"\s*+(\*\*|[-+*/]|[A-Z]++)", re.IGNORECASE)
_PLAIN_NUMBER = re.compile(r"\s*+(\d++\.?\d*+|\.\d++)")
_NAMED = re.compile(r"\s*+<([^<>\n]++)>")
MOST_NESTED = 40


class NotKnown(ValueError):
    """A variable or expression has no value before the program runs."""


@dataclass
class _Expression:
    """A text from which values are read, from ``at`` on."""

    text: str
    at: int
    variables: _Variables
    depth: int = 0

    def bracketed(self) -> float:
        """Read ``[...]``."""
        self.depth += 1
        if self.depth > MOST_NESTED:
            raise NotKnown("brackets are too deep")
        self.expect("[")
        found = self.level(0 if self.variables.linuxcnc else 2)
        self.expect("]")
        self.depth -= 1
        return found

    def condition(self) -> float:
        """Read the condition of a loop of FANUC: two expressions that are compared, in brackets."""
        self.expect("[")
        first = self.level(2)
        word = _TOKEN.match(self.text, self.at)
        if word is None or word[1].upper() not in _LEVELS[1]:
            raise NotKnown("expected a comparison such as [#1 LT 5]")
        self.at = word.end()
        second = self.level(2)
        self.expect("]")
        if 0.0 < abs(first - second) < _ABOUT_EQUAL:
            raise NotKnown(f"whether {first:.10g} and {second:.10g} are equal depends on the rounding of the control")
        return _LEVELS[1][word[1].upper()](first, second)

    def value(self) -> float:
        """Read a number, a variable, a function, or an expression in brackets, with its sign."""
        self._blank()
        sign = 1.0
        while self._next() in "+-" and self._next():
            sign, self.at = (-sign if self._next() == "-" else sign), self.at + 1
            self._blank()
        return sign * self._unsigned()

    def name(self) -> int | str:
        """Read which variable is meant, after ``#``."""
        self.expect("#")
        if named := _NAMED.match(self.text, self.at):
            self.at = named.end()
            return re.sub(r"\s", "", named[1]).lower()
        number = self._unsigned()
        if abs(number - round(number)) > _ABOUT_EQUAL:
            raise NotKnown(f"#{number:g} is no variable")
        return round(number)

    def _unsigned(self) -> float:
        self._blank()
        if self._next() == "[":
            return self.bracketed()
        if self._next() == "#":
            return self.variables.value(self.name())
        if number := _PLAIN_NUMBER.match(self.text, self.at):
            self.at = number.end()
            return float(number[1])
        word = _TOKEN.match(self.text, self.at)
        name = word[1].upper() if word else ""
        self.at = word.end() if word else self.at
        functions = {**FUNCTIONS, **(_OF_LINUXCNC if self.variables.linuxcnc else {})}
        if name == "ATAN":
            first = self.bracketed()
            self._blank()
            if self._next() != "/":
                if self.variables.linuxcnc:
                    raise NotKnown("ATAN needs two numbers: ATAN[1]/[2]")
                return math.degrees(math.atan(first))
            self.at += 1
            return math.degrees(math.atan2(first, self.bracketed()))
        if name not in functions:
            raise NotKnown(f"{self.text[self.at - len(name) :].strip()[:20]!r} is no number")
        return float(functions[name](self.bracketed()))

    def level(self, level: int) -> float:
        """Read what operators of this level and those that bind more leave."""
        if level == len(_LEVELS):
            return self.value()
        found = self.level(level + 1)
        while (word := _TOKEN.match(self.text, self.at)) and word[1].upper() in _LEVELS[level]:
            if not self.variables.linuxcnc and word[1].upper() in ("MOD", "**"):
                raise NotKnown(f"{word[1]} is not followed")
            self.at = word.end()
            found = _LEVELS[level][word[1].upper()](found, self.level(level + 1))
        return found

    def _blank(self) -> None:
        self.at += len(self.text) - self.at - len(self.text[self.at :].lstrip())

    def _next(self) -> str:
        return self.text[self.at : self.at + 1]

    def expect(self, sign: str) -> None:
        """Read a sign."""
        self._blank()
        if self._next() != sign:
            raise NotKnown(f"{self.text[self.at :].strip()[:20]!r}: expected {sign}")
        self.at += 1


#: Variables of FANUC and parameters of LinuxCNC from these numbers on are those of the control: state, offsets, alarms.
_OF_THE_CONTROL = {"fanuc": 1000, "linuxcnc": 5061}


@dataclass
class _Variables:
    """What variables are, where it is known; those of a call of its own are in ``local``."""

    dialect: str
    common: dict[int | str, float] = field(default_factory=dict)
    local: dict[int | str, float] = field(default_factory=dict)
    used: dict[str, None] = field(default_factory=dict)

    @property
    def linuxcnc(self) -> bool:
        """Whether the language is that of LinuxCNC."""
        return self.dialect == "linuxcnc"

    def _home(self, name: int | str) -> dict[int | str, float]:
        most = 30 if self.linuxcnc else 33
        is_local = 1 <= name <= most if isinstance(name, int) else not name.startswith("_")
        return self.local if is_local else self.common

    def value(self, name: int | str) -> float:
        """Return the value of a variable."""
        said = f"#{name}" if isinstance(name, int) else f"#<{name}>"
        found = self._home(name).get(name)
        if found is None:
            raise NotKnown(f"{said} is not known before the program runs")
        self.used[said] = None
        return found

    def assign(self, name: int | str, value: float) -> float:
        """Keep the value of a variable, and return it."""
        if isinstance(name, int) and (name < 1 or name >= _OF_THE_CONTROL[self.dialect]):
            raise NotKnown(f"#{name} is a variable of the control, which the program would change")
        if not math.isfinite(value):
            raise NotKnown(f"#{name} is no number")
        self._home(name)[name] = value
        return value


# Coordinates that the program turns about the tool axis.

_PLACE = re.compile(r"(?<![A-Z])([XYIJ])\s*+(=?)\s*+([-+]?\s*+(?:\d++\.?\d*+|\.\d++))(?![\d(])", re.IGNORECASE)
_TURN_CODE = re.compile(r"(?<![A-Z])G\s*+0*+(\d++(?:\.\d++)?)", re.IGNORECASE)
_SHIFTS_IN_TURN = frozenset(
    (28.0, 30.0, 52.0, 53.0, 92.0, 153.0, 10.0, *map(float, range(54, 60)), 54.1, 20.0, 21.0, 70.0, 71.0)
)


@dataclass
class Turn:
    """Writes blocks without the rotation that is in force: X and Y, I and J are turned about ``centre``, in G17.

    ``fail`` refuses a block. ``at`` is where the last block led in coordinates of the program, nan where that is not known.
    """

    fail: Callable[[str], NoReturn]
    digits: int
    pointed: bool = False
    angle_deg: float = 0.0
    centre: complex = 0.0
    on: bool = False
    absolute: bool = True
    plane: float = 17.0
    at: list[float] = field(default_factory=lambda: [math.nan, math.nan])

    def begin(self, angle_deg: float, centre: complex) -> None:
        """Turn from here on; X and Y have to be placed in absolute again."""
        if self.plane != 17.0:
            self.fail("turned coordinates outside the plane G17 are not followed; post the program without them")
        self.angle_deg, self.centre, self.on, self.at = angle_deg, centre, True, [math.nan, math.nan]

    def end(self) -> None:
        """Turn no more."""
        if self.on:
            self.on, self.at = False, [math.nan, math.nan]

    def codes(self, code: str) -> set[float]:
        """Take over the modes of a block; returns its G codes."""
        found = {float(value) for value in _TURN_CODE.findall(code)} if "G" in code or "g" in code else set()
        self.absolute = (self.absolute and 91.0 not in found) or 90.0 in found
        self.plane = next((k for k in (17.0, 18.0, 19.0) if k in found), self.plane)
        return found

    def block(self, text: str, code: str, codes: set[float]) -> str:
        """Return the block with turned coordinates; ``code`` is its text with blanks in place of comments."""
        words = {word[1].upper(): word for word in _PLACE.finditer(code)}
        if not self.on:
            return text
        if codes & _SHIFTS_IN_TURN or self.plane != 17.0:
            self.fail(
                "changes offset, unit or plane, or leaves its coordinates, while they are turned; end the turn before"
            )
        if re.search(r"(?<![A-Z])[XYIJ]\s*=\s*[A-Z]", code, re.IGNORECASE):
            self.fail("X, Y, I or J with AC or IC while coordinates are turned is not followed; post G90 or G91")
        if 4.0 in codes or not words:
            return text
        if self.pointed and any("." not in word[3] and float(re.sub(r"\s", "", word[3])) for word in words.values()):
            self.fail("a number without a decimal point while coordinates are turned; post it with one")
        new: dict[str, float] = {}
        if words.keys() & {"X", "Y"}:
            new |= dict(zip("XY", self._place(words), strict=True))
        if words.keys() & {"I", "J"}:
            turned = complex(*(self._number(words, letter) for letter in "IJ")) * self._factor()
            new |= {"I": turned.real, "J": turned.imag}
        return self._written(text, words, new)

    def _factor(self) -> complex:
        return complex(math.cos(math.radians(self.angle_deg)), math.sin(math.radians(self.angle_deg)))

    @staticmethod
    def _number(words: dict[str, re.Match[str]], letter: str) -> float:
        return float(re.sub(r"\s", "", words[letter][3])) if letter in words else 0.0

    def _place(self, words: dict[str, re.Match[str]]) -> tuple[float, float]:
        given = [self._number(words, letter) if letter in words else None for letter in "XY"]
        if not self.absolute:
            step = complex(given[0] or 0.0, given[1] or 0.0)
            self.at = [self.at[0] + step.real, self.at[1] + step.imag]
            if any(math.isnan(value) for value in self.at):
                self.fail("an increment before X and Y have been placed in absolute since the turn; place both")
            turned = step * self._factor()
            return turned.real, turned.imag
        self.at = [old if value is None else value for value, old in zip(given, self.at, strict=True)]
        if any(math.isnan(value) for value in self.at):
            self.fail("X or Y alone, before both have been placed since the coordinates were turned; place both")
        turned = self.centre + (complex(*self.at) - self.centre) * self._factor()
        return turned.real, turned.imag

    def _written(self, text: str, words: dict[str, re.Match[str]], new: dict[str, float]) -> str:
        def said(value: float) -> str:
            number = f"{round(value, self.digits) + 0.0:.{self.digits}f}".rstrip("0")
            return number if self.pointed else number.rstrip(".")

        last = max(word.end() for word in words.values())
        more = "".join(f" {letter}{said(value)}" for letter, value in new.items() if letter not in words)
        text = text[:last] + more + text[last:]
        for letter, word in sorted(words.items(), key=lambda item: -item[1].start()):
            if letter in new:
                text = text[: word.start(3)] + said(new[letter]) + text[word.end(3) :]
        return text


_COMPUTED = re.compile(
    r"(?<![A-Z#<])([A-Z])[ \t]*+(?=[-+]?[ \t]*+(?:[#\[]|(?:" + "|".join([*FUNCTIONS, "ATAN"]) + r")\[))", re.IGNORECASE
)
#: Letters whose numbers are written with a decimal point.
_LENGTHS = frozenset("XYZUVWABCIJKQREF")
_O_WORD = re.compile(
    r"\s*+(?:N\s*+\d++\s*+)?O\s*+(\d++|<[^<>\n]++>)\s*+(SUB|ENDSUB|CALL|RETURN|[A-Z]++)\b(.*)",
    re.IGNORECASE | re.DOTALL,
)
_LOOP = re.compile(r"\s*+(?:N\s*+\d++\s*+)?(WHILE|IF|GOTO|END\s*+\d)(?![A-Z])", re.IGNORECASE)
#: Variables of the words of a macro call: A is #1. With I, J or K more than once they are #4 to #33 in order.
_MACRO_WORDS = dict(zip("ABCIJKDEFHMQRSTUVWXYZ", (*range(1, 10), 11, 13, *range(17, 27)), strict=True))


def written_out(
    source: Path, dialect: str, *, skip_deleted: bool = False, folders: Sequence[Path] = ()
) -> WrittenOut | None:
    """Return a program of FANUC, Haas or LinuxCNC with calls written out and variables as numbers; None if it has none.

    The corrected program has no calls left. Calls of what is neither in the file nor in ``folders`` stay for the reader to
    refuse, as do variables that are not known before the program runs. ``skip_deleted``: the control skips blocks with ``/``.
    """
    if not mentions(source, _MENTIONED):
        return None
    program = linked(source, dialect, folders)
    if any(MARK.encode() in line for line in program.lines[:40]):  # the reader refuses it
        return None
    return _Program(program, dialect, skip_deleted).written_out()


def mentions(source: Path, patterns: Sequence[re.Pattern[bytes]]) -> bool:
    """Whether one of the patterns, of at most 64 bytes in capitals, is anywhere in a file."""
    with source.open("rb") as stream:
        before = b""
        while chunk := stream.read(1 << 20):
            text = before + chunk.upper()
            if any(pattern.search(text) for pattern in patterns):
                return True
            before = text[-64:]
    return False


# Subprograms in files of their own: they are put behind the program, as if they were in its file.


@dataclass
class Linked:
    """A program with the files that it calls behind it: lines, and the file and line that each is from.

    ``main_lines`` are lines of the program: of its own lines each itself, of a file the line of its first call.
    """

    lines: list[bytes]
    places: list[tuple[Path, int]]
    main_lines: list[int] = field(default_factory=list)

    def text(self) -> str:
        """Its text, each byte a character."""
        return b"".join(self.lines).decode("latin-1")


_PROGRAM_NUMBER = re.compile(rb"\s*+(?:N\s*+\d++\s*+)?[O:]\s*+0*+(\d++)", re.IGNORECASE)
_CALLED_NAME = re.compile(rb"\s*+(?:N\s*+\d++\s*+)?O\s*+(?:<([^<>\n]++)>|(\d++))\s*+CALL\b", re.IGNORECASE)
_DEFINED_NAME = re.compile(rb"\s*+(?:N\s*+\d++\s*+)?O\s*+(?:<([^<>\n]++)>|(\d++))\s*+SUB\b", re.IGNORECASE)
#: Ends of names of files that are no programs.
_NO_PROGRAM = (".bak", ".tmp", ".json", ".md", ".csv", ".toml", "~")


def file_of(pattern: str, folders: Sequence[Path], what: str, called_at: tuple[Path, int]) -> Path | None:
    """Return the file whose name fits ``pattern`` in the first of some folders that has one; InputError for several."""
    for folder in folders:
        try:
            entries = sorted(folder.iterdir())
        except OSError as error:
            raise InputError(
                f"cannot be read: {error.strerror or error}; --subprograms needs a folder", file=folder
            ) from error
        found = [
            path
            for path in entries
            if re.fullmatch(pattern, path.name, re.IGNORECASE)
            and path.is_file()
            and not path.name.lower().endswith(_NO_PROGRAM)
        ]
        if len(found) > 1:
            raise InputError(
                f"{what} may be {visible_line(found[0].name)} or {visible_line(found[1].name)} in {visible_line(str(folder))}; "
                "keep one of them",
                file=called_at[0],
                line=called_at[1],
            )
        if found:
            return found[0]
    return None


def linked(source: Path, dialect: str, folders: Sequence[Path]) -> Linked:
    """Put the files that a program calls, and those that they call, behind it, before its closing ``%``."""
    lines = source.read_bytes().splitlines(keepends=True)
    found = Linked(lines, [(source, k + 1) for k in range(len(lines))])
    if not folders:
        return found
    last = next((k for k in range(len(lines) - 1, max(len(lines) - 5, 0), -1) if lines[k].strip() == b"%"), len(lines))
    rest = lines[last:]
    del lines[last:]
    del found.places[last:]
    if lines and not lines[-1].endswith(b"\n"):
        lines[-1] += b"\n"
    numbers = {head[1] for line in lines if (head := _PROGRAM_NUMBER.match(line))}
    names = {_o_name(head) for line in lines if (head := _DEFINED_NAME.match(line))}
    at = 0
    while at < len(lines):
        code = _LATER[dialect].sub(b"", lines[at])
        for number in _called_numbers(code):
            short = number[-4:].lstrip(b"0") if len(number) > 4 else number
            if not {number, short} & numbers:
                _link_number(found, short, folders, found.places[at])
                numbers.add(short)
        named = _CALLED_NAME.match(code) if dialect == "linuxcnc" else None
        if named and _o_name(named) not in names:
            names.add(_o_name(named))
            _link_name(found, _o_name(named), folders, found.places[at])
        at += 1
    lines += rest
    found.places += [(source, last + k + 1) for k in range(len(rest))]
    return found


def _called_numbers(code: bytes) -> list[bytes]:
    """Numbers of the programs that a block calls by M98 or G65."""
    if b"98" not in code and b"65" not in code:
        return []
    words = [(word[1].upper(), word[2]) for word in _WORD.finditer(code)]
    calls = {(letter, text.lstrip(b"0 \t")) for letter, text in words} & {(b"M", b"98"), (b"G", b"65")}
    return [text.lstrip(b"0") for letter, text in words if letter == b"P" and text.isdigit()] if calls else []


def _o_name(found: re.Match[bytes]) -> str:
    return re.sub(r"\s", "", (found[1] or found[2]).decode("latin-1")).lower()


def _read_called(path: Path) -> list[bytes]:
    lines = path.read_bytes().splitlines(keepends=True)
    if lines and not lines[-1].endswith(b"\n"):
        lines[-1] += b"\n"
    return lines


def _link_number(found: Linked, number: bytes, folders: Sequence[Path], called_at: tuple[Path, int]) -> None:
    name = number.decode()
    path = file_of(rf"O?0*{name}(?:\.[^.]*)?", folders, f"O{name}", called_at)
    if path is None:
        return
    head, started = f"O{name}\n".encode(), False
    for k, line in enumerate(_read_called(path)):
        if line.strip() == b"%":
            continue
        begins = _PROGRAM_NUMBER.match(_LATER["linuxcnc"].sub(b"", line))
        if not started:
            if begins and begins[1] != number:
                raise InputError(f"begins with O{begins[1].decode()}; it is called as O{name}", file=path, line=k + 1)
            if not begins and not _LATER["linuxcnc"].sub(b"", line).strip():
                continue
            started = True
            if not begins:
                found.lines.append(head)
                found.places.append((path, k + 1))
        found.lines.append(line)
        found.places.append((path, k + 1))


def _link_name(found: Linked, name: str, folders: Sequence[Path], called_at: tuple[Path, int]) -> None:
    path = file_of(rf"{re.escape(name)}\.(?:ngc|nc)", folders, f"o<{name}>", called_at)
    if path is None:
        return
    lines = _read_called(path)
    if not any((head := _DEFINED_NAME.match(line)) and _o_name(head) == name for line in lines):
        raise InputError(f"has no o<{name}> sub; it is called as that", file=path)
    for k, line in enumerate(lines):
        if line.strip() != b"%":
            found.lines.append(line)
            found.places.append((path, k + 1))


def _name_of(text: str) -> str:
    return re.sub(r"\s", "", text.strip("<>")).lower()


def _end(text: bytes) -> bytes:
    """The end of a line."""
    return text[len(text.rstrip(b"\r\n")) :] or b"\n"


class _Program:
    """The blocks of a file, where its subprograms begin, and what is written while calls are followed."""

    def __init__(self, program: Linked, dialect: str, skip_deleted: bool) -> None:
        self.places, self.haas, self.dialect = program.places, dialect == "fanuc", dialect
        self.source = program.places[0][0] if program.places else Path()
        self.blocks: Sequence[_Block] = []
        for text in program.lines:
            slash = _SKIPPED.match(text) is not None
            code = b"" if slash and skip_deleted else _LATER[dialect].sub(lambda part: b" " * len(part[0]), text)
            self.blocks.append(_Block(text, code, slash))
        self.starts: dict[bytes, list[int]] = {}
        for k, block in enumerate(self.blocks):
            o_word = dialect == "linuxcnc" and _O_WORD.match(block.code.decode("latin-1"))
            if not o_word and (name := block.number(b"O:")) is not None:
                self.starts.setdefault(b"O" + name, []).append(k)
        self.subs = self._subs() if dialect == "linuxcnc" else {}
        self.ends = [k for k, block in enumerate(self.blocks) if block.has(2, 30)]
        self.out: list[bytes] = []
        #: For each line that is written its block, and the line of the program from which that was called.
        self.origin: list[int] = []
        self.main_lines: list[int] = []
        self._main_line, self._loops = 1, 0
        self.called: dict[str, int] = {}
        self.variables = _Variables(dialect)
        self.resolved = self.inch = False
        self.turn = Turn(functools.partial(self._fail_in, 0), 3, pointed=True)
        self.after_turn: set[str] = set()

    def _subs(self) -> dict[str, range]:
        """Blocks of each ``o<name> sub`` to its ``endsub``."""
        found: dict[str, range] = {}
        begun: dict[str, int] = {}
        for k, block in enumerate(self.blocks):
            if word := _O_WORD.match(block.code.decode("latin-1")):
                name, what = _name_of(word[1]), word[2].upper()
                if what == "SUB":
                    if name in found or name in begun:
                        self._fail(f"o<{name}> sub is given twice; give each its own name", k)
                    begun[name] = k
                elif what == "ENDSUB" and name in begun:
                    found[name] = range(begun.pop(name), k + 1)
        return found

    def written_out(self) -> WrittenOut | None:
        """Follow the program from its first block to the one that ends it."""
        stop = self.ends[0] + 1 if self.ends else len(self.blocks)
        self._follow(range(stop), 0)
        if not self.called and not self.resolved:
            return None
        for k in range(stop, len(self.blocks)):
            if self.blocks[k].code.strip() == b"%":
                self._add(self.blocks[k].text, k)
        said = tuple(f"{name} ({count} times)" if count > 1 else name for name, count in self.called.items())
        places = [self.places[k] for k in self.origin]
        # lines of the second reading are those of the program where all of it is in one file
        resolved = self.resolved or any(path != self.source for path, _ in places)
        known = tuple(self.variables.used)
        return WrittenOut(b"".join(self.out), np.array(self.main_lines), said, places, resolved, known)

    def _fail(self, message: str, k: int) -> NoReturn:
        path, line = self.places[k]
        raise InputError(message, file=path, line=line)

    def _add(self, text: bytes, k: int) -> None:
        if len(self.out) > MOST_BLOCKS:
            self._fail("calls make the program longer than 5e6 blocks; divide it", k)
        if self.places[k][0] == self.source:
            self._main_line = self.places[k][1]
        self.out.append(text)
        self.origin.append(k)
        self.main_lines.append(self._main_line)

    def _follow(self, rows: range, depth: int) -> bool:
        """Follow blocks; returns whether one of them has returned from the subprogram."""
        k = rows.start
        while k < rows.stop:
            found = self._structure(k, rows, depth)
            if found is not None:
                if found < 0:
                    return True
                k = found
                continue
            self._block(k, depth)
            k += 1
        return False

    def _block(self, k: int, depth: int) -> None:
        block = self._with_numbers(k)
        if block is None:
            return
        macro = self.haas and b"65" in block.code and block.is_macro_call()
        back = depth > 0 and block.has(99)
        target = self._target(k, block) if macro or block.has(97, 98) else None
        if target is None and not back:
            self._note_unit(block)
            self._add(self._turned(block, k) if self.haas else block.text, k)
            return
        if block.slash:
            what = "returns from" if back else "calls"
            self._fail(f"{what} a subprogram in a block with /; post it without", k)
        if back and target is None and block.given(b"P") is not None:
            self._fail("returns to another block than that of its call; post M99", k)
        name, first, repeats = target or (b"", 0, 0)
        arguments = self._arguments(block, k) if macro else None
        if macro:
            self._add(
                block.text[: len(block.text) - len(block.text.lstrip())] + b"(" + name + b")" + _end(block.text), k
            )
        else:
            self._write_rest(block, k, name, repeats)
        if target is not None:
            self._call(self._body(first, name, k), name.decode(), repeats, depth, k, arguments)

    def _turned(self, block: _Block, k: int) -> bytes:
        """The text of a block of FANUC without the rotation that is in force (G68 to G69)."""
        code = block.code.decode("latin-1")
        self.turn.fail = functools.partial(self._fail_in, k)
        codes = self.turn.codes(code)
        text = block.text.decode("latin-1")
        if 68.0 in codes:
            words = dict(block.words)
            wrong = words.keys() & {b"I", b"J", b"K", b"Z", b"M"} or len(codes - {17.0, 90.0}) > 1
            if wrong or self.turn.on or not self.turn.absolute or not {b"X", b"Y", b"R"} <= words.keys():
                self.turn.fail(
                    "turned coordinates: G68 is followed as G68 X Y R in a block of its own, in absolute, and not "
                    "within another; post it so, or the program without it"
                )
            if any(
                b"." not in word[2] and float(word[2])
                for word in _WORD.finditer(block.code)
                if word[1].upper() in b"XYR"
            ):
                self.turn.fail("a number without a decimal point beside G68; post it with one")
            self.turn.digits = 3 + self.inch
            self.turn.begin(words[b"R"], complex(words[b"X"], words[b"Y"]))
        elif 69.0 in codes and self.turn.on:
            self.turn.end()
            self.after_turn = {"X", "Y"}
            self.resolved = True
            return re.sub(r"G\s*0*69(?!\d)", "G69", text, count=1, flags=re.IGNORECASE).encode("latin-1")
        elif self.turn.on:
            self.resolved = True
            return self.turn.block(text, code, codes).encode("latin-1")
        else:
            self._first_after_turn(block)
            return block.text
        self.resolved = True
        said = re.sub(r"[()]", " ", text).strip()
        return f"({said})".encode("latin-1") + _end(block.text)

    def _first_after_turn(self, block: _Block) -> None:
        """Refuse X or Y alone after the end of a turn: where the other one then goes differs between controls."""
        named = {letter.decode() for letter, _ in block.words} & {"X", "Y"}
        if self.after_turn and named:
            if named != {"X", "Y"} or not self.turn.absolute:
                self.turn.fail("X or Y alone, or an increment, before both have been placed since G69; place both")
            self.after_turn = set()

    def _fail_in(self, k: int, message: str) -> NoReturn:
        self._fail(f"{message} (block: {visible_line(self.blocks[k].text.decode('latin-1').strip())[:60]})", k)

    def _call(
        self, rows: range, name: str, repeats: int, depth: int, k: int, arguments: dict[int | str, float] | None
    ) -> None:
        """Follow a subprogram; with ``arguments`` it has variables of its own."""
        if depth == DEEPEST:
            self._fail(f"calls are deeper than {DEEPEST}, or call themselves", k)
        path = self.places[rows.start][0]
        said = name if path == self.source else f"{name} of {path.name}"
        self.called[said] = self.called.get(said, 0) + repeats
        kept = self.variables.local
        for _ in range(repeats):
            if arguments is not None:
                self.variables.local = dict(arguments)
            self._follow(rows, depth + 1)
        self.variables.local = kept

    def _arguments(self, block: _Block, k: int) -> dict[int | str, float]:
        """Variables of a macro call, by the words of its block."""
        found: dict[int | str, float] = {}
        place = 3
        words = [(word[1].upper().decode(), word[2]) for word in _WORD.finditer(block.code)]
        letters = [letter for letter, _ in words]
        several = any(letters.count(letter) > 1 for letter in "IJK")
        for letter, text in words:
            value = float(re.sub(rb"\s", b"", text))
            if letter in "NPL" or (letter == "G" and value == 65.0):
                continue
            number = _MACRO_WORDS.get(letter)
            if number is None:
                self._fail(f"{letter}{value:g} beside G65 is no variable of a macro; divide the block", k)
            if b"." not in text and value and letter not in "DHMST":
                self._fail(
                    f"{letter}{text.decode()} of a macro call has no decimal point, and what it is depends on the control; "
                    "post it with one",
                    k,
                )
            if several and letter in "IJK":  # I1 J1 K1 I2 ... are #4, #5, #6, #7 ...
                place += 1 + ("IJK".index(letter) - (place + 1 - 4)) % 3
                number = place
            if number in found:
                self._fail(f"{letter} is given twice in a block", k)
            if number > 33:
                self._fail("a macro call has at most ten I, J and K", k)
            found[number] = value
        self.resolved = True
        return found

    # Loops and conditions, whose numbers are known.

    def _structure(self, k: int, rows: range, depth: int) -> int | None:
        """Follow what begins in block ``k`` if that is a call, a loop or a condition: the block that is next, -1 to return."""
        code = self.blocks[k].code.decode("latin-1")
        if self.haas:
            found = _LOOP.match(code)
            return self._while(k, rows, depth, found, code) if found else None
        word = _O_WORD.match(code) if "o" in code or "O" in code else None
        if word is None:
            return None
        if self.blocks[k].slash:
            self._fail("a call, loop or condition in a block with /; post it without", k)
        name, what = _name_of(word[1]), word[2].upper()
        rest, start = _Expression(code, word.start(3), self.variables), word[3].strip()
        if what == "SUB":
            return self.subs[name].stop if name in self.subs else None
        if what == "CALL":
            return self._o_call(name, rest, depth, k)
        if what in ("RETURN", "ENDSUB"):
            if start:
                self.variables.common["_value"] = self._calculated(rest.bracketed, k)
            self._said(k)
            return -1
        if what in ("IF", "WHILE", "REPEAT", "DO"):
            return self._branch(name, what, rest, rows, depth, k)
        self._fail(f"o<{name}> {what.lower()}: is not followed where it stands; post the program with numbers", k)

    def _o_call(self, name: str, rest: _Expression, depth: int, k: int) -> int | None:
        if name not in self.subs:
            return None
        values: list[float] = []
        while rest.text[rest.at :].strip():
            values.append(self._calculated(rest.bracketed, k))
        arguments: dict[int | str, float] = dict.fromkeys(range(1, 31), 0.0)
        arguments |= {number: value for number, value in enumerate(values, 1) if number <= 30}
        self.resolved = True
        self._said(k)
        rows = self.subs[name]
        self._call(range(rows.start + 1, rows.stop), f"o<{name}>", 1, depth, k, arguments)
        return k + 1

    def _branch(self, name: str, what: str, rest: _Expression, rows: range, depth: int, k: int) -> int:
        """Follow a loop or condition of LinuxCNC to its end."""
        self.resolved = True
        ends = {"IF": "ENDIF", "WHILE": "ENDWHILE", "REPEAT": "ENDREPEAT", "DO": "WHILE"}
        marks = [(k, what, rest)]
        for j in range(k + 1, rows.stop):
            code = self.blocks[j].code.decode("latin-1")
            if (word := _O_WORD.match(code)) and _name_of(word[1]) == name:
                marks.append((j, word[2].upper(), _Expression(code, word.start(3), self.variables)))
                if word[2].upper() == ends[what]:
                    break
        last, end, condition = marks[-1]
        if end != ends[what] or len(marks) == 1:
            self._fail(f"o<{name}> {what.lower()} has no {ends[what].lower()}; give the whole program", k)
        self._said(k)
        if what == "IF":
            for (j, kind, one), (stop, _, _) in zip(marks, marks[1:], strict=False):
                if kind == "ELSE" or self._calculated(one.bracketed, j):
                    return -1 if self._follow(range(j + 1, stop), depth) else last + 1
            return last + 1
        if len(marks) > 2:
            self._fail(f"o<{name}> {marks[1][1].lower()} is not followed; post the program with numbers", marks[1][0])
        times = self._calculated(rest.bracketed, k) if what == "REPEAT" else math.inf
        done = 0
        while done < times:
            if what == "WHILE" and not self._calculated(_Expression(rest.text, rest.at, self.variables).bracketed, k):
                break
            done += 1
            self._steps(k)
            if self._follow(range(k + 1, last), depth):
                return -1
            again = _Expression(condition.text, condition.at, self.variables)
            if what == "DO" and not self._calculated(again.bracketed, last):
                break
        return last + 1

    def _while(self, k: int, rows: range, depth: int, found: re.Match[str], code: str) -> int:
        """Follow a loop of FANUC: WHILE[...]DO1 to END1."""
        self.resolved = True
        if found[1].upper() != "WHILE" or self.blocks[k].slash:
            self._fail(
                "variables and expressions: jumps and conditions of macros are not followed (WHILE is, where its numbers are "
                "known); post the program without them",
                k,
            )
        begin = _Expression(code, found.end(1), self.variables)
        self._calculated(begin.condition, k)
        number = re.match(r"\s*DO\s*(\d+)", code[begin.at :], re.IGNORECASE)
        ends = rf"\s*(?:N\s*\d+\s*)?END\s*{number[1] if number else 'x'}(?!\d)"
        last = next(
            (
                j
                for j in range(k + 1, rows.stop)
                if re.match(ends, self.blocks[j].code.decode("latin-1"), re.IGNORECASE)
            ),
            None,
        )
        if last is None:
            self._fail("WHILE without DO and its END; give the whole program", k)
        self._said(k)
        while self._calculated(_Expression(code, found.end(1), self.variables).condition, k):
            self._steps(k)
            if self._follow(range(k + 1, last), depth):
                return -1
        return last + 1

    def _steps(self, k: int) -> None:
        self._loops += 1
        if self._loops > MOST_TURNS:
            self._fail(f"loops do not end within {MOST_TURNS} turns; post their blocks", k)

    def _calculated(self, read: Callable[[], float], k: int) -> float:
        """Return what ``read`` finds in block ``k``; refused if that is not known before the program runs."""
        self.resolved = True
        try:
            return float(read())
        except (NotKnown, ArithmeticError, ValueError) as error:
            said = visible_line(self.blocks[k].text.decode("latin-1").strip())[:60]
            why = str(error) if isinstance(error, NotKnown) else "it has no value"
            self._fail(
                f"{why}: variables and expressions are followed where they are constant; post the program with numbers "
                f"(block: {said})",
                k,
            )

    def _said(self, k: int) -> None:
        """Keep a block that is written out as a comment."""
        text = self.blocks[k].text
        said = re.sub(rb"[()]", b" ", text).strip()
        self._add(b"(" + said + b")" + _end(text), k)

    def _with_numbers(self, k: int) -> _Block | None:
        """The block with numbers in place of variables; None if it only assigns some, and is written as a comment."""
        block = self.blocks[k]
        code = block.code.decode("latin-1")
        if "#" not in code and "[" not in code:
            return block
        self._note_unit(block)
        text = block.text.decode("latin-1")
        if block.slash:
            self._fail(
                "variables and expressions in a block with /: whether it counts is not known; post it without", k
            )
        pieces, assigned, at = [], list[tuple[int | str, float]](), 0
        while at < len(code):
            if code[at] == "#":
                found = _Expression(code, at, self.variables)
                assigned.append(self._assigned(found, k))
                at = found.at
            elif (word := _COMPUTED.match(code, at)) is not None:
                found = _Expression(code, word.end(), self.variables)
                pieces.append(word[1] + self._number(word[1].upper(), self._calculated(found.value, k)))
                at = found.at
            else:
                pieces.append(text[at])
                at += 1
        pieces.append(text[len(code) :])
        self.resolved = True
        for name, value in assigned:
            self._calculated(functools.partial(self.variables.assign, name, value), k)
        rest = "".join(pieces).encode("latin-1")
        if assigned:
            if self.haas and re.sub(rb"\s*(N\d+)?[\s;]*", b"", _LATER[self.dialect].sub(b"", rest)):
                self._fail("variables and expressions: assigns a variable beside other words; divide the block", k)
            if not re.sub(rb"\s*(N\d+)?[\s;]*", b"", rest):
                self._said(k)
                return None
        return _Block(rest, _LATER[self.dialect].sub(lambda part: b" " * len(part[0]), rest), block.slash)

    def _note_unit(self, block: _Block) -> None:
        if self.haas and b"2" in block.code:
            for found in _G_CODE.finditer(block.code):
                self.inch = float(found[1]) == 20.0 or (self.inch and float(found[1]) != 21.0)

    def _assigned(self, found: _Expression, k: int) -> tuple[int | str, float]:
        name: list[int | str] = []

        def read() -> float:
            name.append(found.name())
            found.expect("=")
            return found.value() if self.variables.linuxcnc else found.level(2)

        value = self._calculated(read, k)
        return name[0], value

    def _number(self, letter: str, value: float) -> str:
        if letter not in _LENGTHS:
            return f"{value:.9g}"
        digits = 8 if self.dialect == "linuxcnc" else 3 + self.inch  # FANUC rounds to its least increment
        text = f"{round(value, digits) + 0.0:.{digits}f}".rstrip("0")
        return text

    def _write_rest(self, block: _Block, k: int, name: bytes, repeats: int) -> None:
        """Write what a block with a call or return does beside it, and what it called as a comment."""
        rest = block.without(b"PL" if name else b"")
        if name:
            said = name.decode() + (f" {repeats} times" if repeats != 1 else "")
            head = rest.rstrip(b"\r\n; ")
            rest = head + b" " * bool(head.strip()) + f"({said})".encode() + rest[len(head) :]
        if re.sub(rb"\s*/?\s*(N\d+)?[\s;]*", b"", rest):
            self._add(rest, k)

    def _target(self, k: int, block: _Block) -> tuple[bytes, int, int] | None:
        """Name of what a block calls, the block with which that begins, and how often; None if it is not in the file.

        ``P1001 L3``, or ``P31001`` of FANUC for 3 times O1001.
        """
        local, given, times = block.has(97), block.given(b"P"), block.given(b"L")
        if (local and not self.haas) or given is None or given != int(given) or given < 0:
            return None
        if times is not None and (times != int(times) or times < 0 or (times == 0 and self.haas)):
            self._fail(
                f"L{times:g} is no number of repeats that is followed; post the call without L, or with L1 or more", k
            )
        number, repeats = b"%d" % int(given), 1 if times is None else int(times)
        found = self._labels(number, k) if local else self.starts.get(b"O" + number, [])
        if not local and times is None and len(number) > 4:
            short = number[-4:].lstrip(b"0") or b"0"
            others = self.starts.get(b"O" + short, [])
            if others and found:
                self._fail(f"P{int(given)} may be O{int(given)}, or O{short.decode()} several times; post L", k)
            if others:
                repeats, number, found = int(number[:-4]), short, others
        if not found:
            return None
        self._check_call(k, block, local, number, found)
        return (b"N" if local else b"O") + number, found[0] + (not local), repeats

    def _check_call(self, k: int, block: _Block, local: bool, number: bytes, found: list[int]) -> None:
        name = f"{'N' if local else 'O'}{number.decode()}"
        if len(found) > 1:
            first, second = (self._where(j) for j in found[:2])
            self._fail(f"calls {name}, which begins in lines {first} and {second}; give each its own number", k)
        if block.is_macro_call():
            return
        others = {letter for letter, _ in block.words} - {b"N", b"M", b"P", b"L"}
        codes = [value for letter, value in block.words if letter == b"M"]
        if others & {b"Q", b"H"}:
            self._fail("calls a block within a subprogram; post M98 with P and L alone", k)
        if not self.haas and (others or len(codes) > 1):
            self._fail("has other words beside M98, which the control does not execute; divide the block", k)

    def _where(self, k: int) -> str:
        path, line = self.places[k]
        return str(line) if path == self.source else f"{line} of {path.name}"

    def _labels(self, number: bytes, k: int) -> list[int]:
        """Blocks with a number in the program, between two O numbers, that block ``k`` belongs to."""
        heads = sorted(start for starts in self.starts.values() for start in starts)
        low = max((head for head in heads if head <= k), default=0)
        high = min((head for head in heads if head > k), default=len(self.blocks))
        return [j for j in range(low, high) if self.blocks[j].number(b"N") == number]

    def _body(self, first: int, name: bytes, k: int) -> range:
        """Lines of a subprogram, from its number to its M99."""
        for j in self._rows_of(first):
            if self.blocks[j].has(99):
                return range(first, j + 1)
        self._fail(f"calls {name.decode()}, which does not end with M99; give the whole program", k)

    def _rows_of(self, first: int) -> Iterator[int]:
        for j in range(first, len(self.blocks)):
            if j > first and self.blocks[j].number(b"O:") is not None:
                return
            yield j
