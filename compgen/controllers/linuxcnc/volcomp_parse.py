"""Strict reading of the table of ``volkins``: as strict as the C sources, with the line of what is wrong.

Words are separated by white space: ``volcomp 1``, ``unit mm`` or ``unit inch`` (mm where it is missing: tables of versions that
wrote mm only), then ``curve NAME AXIS COUNT FIRST STEP`` with COUNT numbers, ``term OUTPUT
CURVE COEFFICIENT LEVER``, or ``grid NX NY NZ X0 Y0 Z0 HX HY HZ`` with 3 NX NY NZ numbers (x fastest), then ``end``.
Comments (``#`` to the end of the line) and one ``crc32 XXXXXXXX`` of all words up to ``end`` follow.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np

from compgen.controllers.base import SourceFile
from compgen.controllers.linuxcnc.text import MM_PER_UNIT, SHOWN, check_size, lines_of, number_in, whole_in
from compgen.controllers.linuxcnc.volcomp import (
    LEVERS,
    LONGEST_NAME,
    MOST_CURVES,
    MOST_NODES,
    MOST_TERMS,
    MOST_VERTICES,
    VolCurve,
    VolGrid,
    VolTable,
    VolTerm,
    checksum,
)
from compgen.core.csvio import FloatArray

_LONGEST_LINE = 4096
_MOST_CHARACTERS = 32_000_000
_MAGIC = ("volcomp", "1")


class _Words:
    """The words of a file one by one, with the line they stand in; all that were taken count for the checksum."""

    def __init__(self, source: SourceFile) -> None:
        self.source, self.line, self.taken = source, 1, list[str]()
        self._lines = lines_of(source)
        self._words: Iterator[str] = iter(())

    def take(self, what: str) -> str:
        """Return the next word, which is due; InputError at the end of the file."""
        word = next(self._words, None)
        while word is None:
            following = next(self._lines, None)
            if following is None:
                raise self.source.fail(f"{what} is due, and the file ends: it was cut", self.line)
            self._words = iter(self._split(*following))
            word = next(self._words, None)
        self.taken.append(word)
        return word

    def _split(self, line: int, text: str, _: bool) -> list[str]:
        self.line = line
        if len(text) > _LONGEST_LINE:
            raise self.source.fail(f"has {len(text)} characters; {_LONGEST_LINE} are allowed", line)
        return text.split()

    def number(self, what: str) -> float:
        """Return the next word as a finite number."""
        word = self.take(what)  # first: it may stand in the next line
        return number_in(self.source, self.line, word, what)

    def whole(self, what: str, low: int, high: int) -> int:
        """Return the next word as a whole number from ``low`` to ``high``."""
        word = self.take(what)
        return whole_in(self.source, self.line, word, what, (low, high))

    def step(self) -> float:
        """Return the next word as a number above zero."""
        value = self.number("a step")
        if value <= 0:
            raise self.source.fail(f"the step {value:g} is not above zero", self.line)
        return value

    def numbers(self, count: int) -> FloatArray:
        """Return the next ``count`` words as numbers."""
        return np.array([self.number("a value") for _ in range(count)])

    def rest(self) -> Iterator[tuple[int, list[str]]]:
        """Yield line and words of what follows; the words left in the line that is being read come first."""
        first = (self.line, list(self._words))
        split = ((line, self._split(line, text, ended)) for line, text, ended in self._lines)
        return ((line, words) for line, words in chain([first], split) if words)


def parse_volcomp(source: SourceFile) -> VolTable:
    """Read a table; InputError with the line for anything that the kinematics module refuses."""
    check_size(source, _MOST_CHARACTERS)
    words = _Words(source)
    for due in _MAGIC:
        if (word := words.take("'volcomp 1'")) != due:
            raise source.fail(f"'volcomp 1' is due at the start, found {word[:SHOWN]!r}", words.line)
    curves: dict[str, VolCurve] = {}
    terms: list[VolTerm] = []
    grid: VolGrid | None = None
    unit = "mm"
    word = words.take("'end'")
    if word == "unit":
        unit, word = _unit(words), words.take("'end'")
    while word != "end":
        if word == "curve":
            curve = _curve(words, curves)
            curves[curve.name] = curve
        elif word == "term":
            terms.append(_term(words, curves, len(terms)))
        elif word == "grid" and grid is None:
            grid = _grid(words)
        else:
            raise source.fail(f"'curve', 'term', one 'grid' or 'end' is due, found {word[:SHOWN]!r}", words.line)
        word = words.take("'end'")
    if bool(terms) == (grid is not None):
        raise source.fail("either terms or a grid are due, not both and not none", words.line)
    _check_trailer(source, words)
    return VolTable(tuple(curves.values()), tuple(terms), grid, unit).scaled(MM_PER_UNIT[unit])


def _unit(words: _Words) -> str:
    word = words.take("a unit")
    if word not in MM_PER_UNIT:
        raise words.source.fail(f"{word[:SHOWN]!r} is not a unit; mm or inch is expected", words.line)
    return word


def _curve(words: _Words, known: dict[str, VolCurve]) -> VolCurve:
    name = words.take("a name of a curve")
    if len(name) > LONGEST_NAME or name in known or len(known) == MOST_CURVES:
        message = f"a new name of at most {LONGEST_NAME} characters is due for one of {MOST_CURVES} curves"
        raise words.source.fail(f"{message}, found {name[:SHOWN]!r}", words.line)
    axis = words.whole("an axis (0 X, 1 Y, 2 Z)", 0, 2)
    count = words.whole("a number of nodes", 1, MOST_NODES)
    first_mm, step_mm = words.number("the first position"), words.step()
    return VolCurve(name, axis, first_mm, step_mm, words.numbers(count))


def _term(words: _Words, curves: dict[str, VolCurve], count: int) -> VolTerm:
    if count == MOST_TERMS:
        raise words.source.fail(f"is term {count + 1}; {MOST_TERMS} are allowed", words.line)
    output = words.whole("an axis (0 X, 1 Y, 2 Z)", 0, 2)
    name = words.take("the name of a curve")
    if name not in curves:
        raise words.source.fail(f"no curve above is named {name[:SHOWN]!r}", words.line)
    coefficient, lever = words.number("a coefficient"), words.take("a lever")
    if lever not in LEVERS:
        raise words.source.fail(f"{lever[:SHOWN]!r} is not a lever; {', '.join(LEVERS)} are", words.line)
    return VolTerm(output, name, coefficient, lever)


def _grid(words: _Words) -> VolGrid:
    nx, ny, nz = (words.whole("a number of vertices", 1, MOST_NODES) for _ in range(3))
    if nx * ny * nz > MOST_VERTICES:
        raise words.source.fail(f"{nx} x {ny} x {nz} vertices are more than {MOST_VERTICES}", words.line)
    x, y, z = (words.number("the position of the first vertex") for _ in range(3))
    hx, hy, hz = (words.step() for _ in range(3))
    values = words.numbers(3 * nx * ny * nz).reshape(nz, ny, nx, 3)
    return VolGrid((x, y, z), (hx, hy, hz), values.transpose(2, 1, 0, 3))


def _check_trailer(source: SourceFile, words: _Words) -> None:
    counted, found = checksum(words.taken), False
    for line, line_words in words.rest():
        plain = line_words[: next((k for k, word in enumerate(line_words) if word.startswith("#")), None)]
        if not plain:
            continue
        if found or len(plain) != 2 or plain[0] != "crc32":
            shown = " ".join(plain)[:SHOWN]
            raise source.fail(f"only comments and one 'crc32 XXXXXXXX' may follow 'end', found {shown!r}", line)
        if plain[1].upper() != counted:
            message = f"the checksum of the words up to 'end' is {counted}, the file says {plain[1][:SHOWN]!r}"
            raise source.fail(f"{message}: it was changed or damaged; export it again", line)
        found = True
    if not found:
        raise source.fail("there is no 'crc32 XXXXXXXX' behind 'end': the file was cut", words.line)
