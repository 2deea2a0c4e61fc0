"""How a FANUC control writes its records: digits, words, decimal points, line ends."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal


@dataclass(frozen=True)
class FanucStyle:
    """Style of a file.

    Parameters
    ----------
    eol, block_end, space : line end, what stands before it (``;`` or nothing), what stands between words.
    mark : first and last line.
    digits, point_digits : digits of the N words of parameters and of compensation points, filled with zeros.
    q_word, q_last : type word Q1 (parameter) or Q0 (pitch data), behind the other words if ``q_last``.
    value_first : the value word stands before its axis word.
    axes_together : all axes of a parameter in one record.
    real_letter, real_point, decimals : value word of lengths, whether it has a decimal point, digits behind it (None: as
        few as needed, but one).
    whole_point, plus, zeros : whole numbers end with a point, have a plus sign, are filled with zeros to so many digits.
    number_base : record number of compensation point 0.
    points_first, containers : points before parameters; 1, or 2: each in a pair of ``%`` of its own.
    header, footer : lines behind the first ``%`` and before the last one.
    last_eol : whether a line end follows the last ``%``.
    even : a blank makes the number of characters of a record even.
    path : path of the control that parameters without axis belong to, written as a word L; 0: no such word.
    """

    eol: str = "\n"
    block_end: str = ""
    mark: str = "%"
    space: str = ""
    digits: int = 5
    point_digits: int = 5
    q_word: bool = False
    q_last: bool = False
    value_first: bool = False
    axes_together: bool = True
    real_letter: str = "P"
    real_point: bool = True
    decimals: int | None = None
    whole_point: bool = False
    plus: bool = False
    zeros: int = 0
    number_base: int = 10000
    points_first: bool = False
    containers: int = 1
    header: tuple[str, ...] = ()
    footer: tuple[str, ...] = ()
    last_eol: bool = True
    even: bool = False
    path: int = 0

    def whole(self, value: int) -> str:
        """Return a whole number as it is written."""
        sign = "-" if value < 0 else "+" if self.plus else ""
        return f"{sign}{abs(value):0{max(self.zeros, 1)}d}{'.' if self.whole_point else ''}"

    def length(self, value: Decimal) -> str:
        """Return a length, in the unit of the file, as it is written."""
        if not self.real_point:
            return str(int(value))
        if self.decimals is not None and self.decimals >= 2:
            return f"{value:.{self.decimals}f}"
        before, _, behind = f"{value:f}".partition(".")
        behind = behind.rstrip("0")
        return f"{before}.{behind or ('' if self.decimals == 0 else '0')}"

    def record(self, number: int, words: Sequence[str], kind: int, *, point: bool = False) -> str:
        """Return a record: N word, words, and the type word ``kind`` if the style has one."""
        name = f"N{number:0{self.point_digits if point else self.digits}d}"
        own = [f"Q{kind}"] if self.q_word else []
        text = self.space.join([name, *words, *own] if self.q_last else [name, *own, *words]) + self.block_end
        return text + " " if self.even and len(text) % 2 else text

    def parameter(self, number: int, values: Iterable[tuple[int, str]], letter: str = "P") -> list[str]:
        """Return the records of a parameter of the axis type from (axis number, value as text), axes ascending."""
        pairs = []
        for axis, text in sorted(values):
            pair = [f"A{axis}", f"{letter}{text}"]
            pairs.append(pair[::-1] if self.value_first else pair)
        if self.axes_together:
            return [self.record(number, [word for pair in pairs for word in pair], 1)]
        return [self.record(number, pair, 1) for pair in pairs]

    def common(self, number: int, value: int) -> str:
        """Return the record of a parameter of a path."""
        path = [f"L{self.path}"] if self.path else []
        return self.record(number, [*path, f"P{self.whole(value)}"], 1)

    def point(self, number: int, value: int) -> str:
        """Return the record of a compensation point."""
        return self.record(self.number_base + number, [f"P{self.whole(value)}"], 0, point=True)

    def file(self, parameters: Sequence[str], points: Sequence[str]) -> str:
        """Return the text of a file from its records."""
        parts = [points, parameters] if self.points_first else [parameters, points]
        between = [self.mark] * 2 if self.containers == 2 and parameters and points else []
        lines = [self.mark, *self.header, *parts[0], *between, *parts[1], *self.footer, self.mark]
        return self.eol.join(lines) + (self.eol if self.last_eol else "")


@dataclass(frozen=True)
class Punched:
    """Text of a file for the templates, line ends and white space and all."""

    text: str
