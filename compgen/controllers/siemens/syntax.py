"""What both kinds of SINUMERIK tables share: reading assignments from text, and equidistant tables.

Lexical grammar (SINUMERIK 840D sl / 828D Extended Functions K3, 03/2013, p. 242; 802D sl Function Manual, p. 222)::

    file       = [ "%_N_" name "_INI" ] [ "CHANDATA(" int ")" ] { assignment | "NEWCONF" | ";" comment } "M17"
    assignment = "$" variable "[" index { "," index } "]" "=" value [ ";" comment ]
    value      = number without exponent | "(" axis name ")" | axis name in quotation marks

The same assignments may stand in a sub-program (name ``..._SPF``) that switches the function off before them, makes
that effective by NEWCONF, and may switch it on again behind them.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction

import numpy as np

from compgen.controllers.base import SourceFile, coverage_violations
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.text import nearest, one_line
from compgen.errors import CompgenWarning, InputError

#: Positions of nodes are written in whole multiples of this.
POSITION_QUANTUM_MM = Decimal("0.000001")
POSITION_DIGITS = 6

#: Switches that may stand among the tables, without ``$``, with the number of their indices (K3-2013, p. 239, 245).
SWITCHES = {
    "MA_ENC_COMP_ENABLE": 2,
    "MA_CEC_ENABLE": 1,
    "SN_CEC_TABLE_ENABLE": 1,
    "SN_CEC_TABLE_WEIGHT": 1,
}
#: Switches that write-protect the tables while they are 1 (MD32700, MD32710).
PROTECTING = ("MA_ENC_COMP_ENABLE", "MA_CEC_ENABLE")
MAKE_EFFECTIVE = "NEWCONF"

#: A step that was rounded misses MAX by less than this share of itself: 39 steps of 19.7436 mm are 770.0004 mm.
_ROUNDED = Decimal("0.01")
_LONGEST_LINE = 1000
_MOST_LINES = 200_000
_MOST_CHARACTERS = 20_000_000
_HEADER = re.compile(r"%_N_[A-Z0-9_]{1,80}_(?:INI|SPF|MPF)")
_CHANNEL = re.compile(r"CHANDATA ?\( ?\d{1,3} ?\)")
_ASSIGNMENT = re.compile(r"\$([A-Z0-9_]{1,60})\s*\[([^\[\]=]{1,100})\]\s*=\s*(\S.*)")
_NUMBER = re.compile(r"[+-]?(?:\d{1,12}(?:\.\d{0,15})?|\.\d{1,15})")
_EXPONENT = re.compile(r"[+-]?[\d.]{1,30} ?EX?[ +-]{0,2}\d{1,10}")


@dataclass(frozen=True)
class Assignment:
    """One assignment to a system variable: ``variable`` without ``$``, its indices and its value as text."""

    variable: str
    index: tuple[str, ...]
    value: str
    source: SourceFile
    line: int

    @property
    def label(self) -> str:
        """The left-hand side, e.g. ``$AN_CEC[0,3]``."""
        return f"${self.variable}[{','.join(self.index)}]"

    def fail(self, message: str) -> InputError:
        """Return the error that points at this line."""
        return self.source.fail(f"{self.label}: {message}", self.line)

    def number(self) -> Decimal:
        """Return the value as an exact decimal number."""
        if _NUMBER.fullmatch(self.value):
            return Decimal(self.value)
        shown = one_line(self.value)[:40]
        if _EXPONENT.fullmatch(self.value):
            raise self.fail(f"{shown!r} has an exponent; the control reads fixed-point numbers, e.g. 0.000010")
        if "," in self.value:
            raise self.fail(f"{shown!r} has a comma; the decimal mark is '.'")
        raise self.fail(f"{shown!r} is not a number; a fixed-point number such as -0.012000 is due")

    def whole(self, minimum: int, maximum: int) -> int:
        """Return the value as a whole number within limits."""
        value = self.number()
        if value != value.to_integral_value() or not minimum <= value <= maximum:
            raise self.fail(f"{self.value} is not a whole number from {minimum} to {maximum}")
        return int(value)

    def index_number(self, place: int, maximum: int) -> int:
        """Return one of the indices as a whole number from 0 to ``maximum``."""
        text = self.index[place]
        if not text.isdigit() or len(text) > 9 or int(text) > maximum:
            raise self.fail(f"index {one_line(text)[:20]!r} is not a whole number from 0 to {maximum}")
        return int(text)


def read_assignments(files: Sequence[SourceFile], index_counts: Mapping[str, int]) -> list[Assignment]:
    """Return every assignment of the files in their order.

    Parameters
    ----------
    files : the texts; each ends with ``M17``.
    index_counts : the known variables, without ``$``, and how many indices each has. Those of :data:`SWITCHES` may
        be assigned several times; the last assignment is returned.

    Raises
    ------
    InputError
        with file and line for an unknown variable, a wrong number of indices, a second assignment to one variable,
        text that is no assignment, a table that is written while its function is on, a file that does not end with
        M17.
    """
    seen: dict[tuple[str, tuple[str, ...]], Assignment] = {}
    for source in files:
        for item in _unprotected(_assignments(source, index_counts)):
            if item.variable in SWITCHES:
                seen[item.variable, item.index] = item
                continue
            first = seen.setdefault((item.variable, item.index), item)
            if first is not item:
                where = (
                    f"{first.source.path}, line {first.line}" if first.source is not source else f"line {first.line}"
                )
                raise item.fail(f"is assigned a second time; the first is in {where}")
    if not any(item.variable not in SWITCHES for item in seen.values()):
        raise files[0].fail("holds no table") if files else InputError("no file was given")
    return list(seen.values())


def _unprotected(items: Iterator[Assignment]) -> Iterator[Assignment]:
    """Pass the assignments on; a table that is written while the file itself has switched its function on is an error."""
    on: dict[tuple[str, tuple[str, ...]], Assignment] = {}
    for item in items:
        if item.variable in PROTECTING:
            on.pop((item.variable, item.index), None)
            if item.whole(0, 1):
                on[item.variable, item.index] = item
        elif item.variable not in SWITCHES and on:
            switch = next(iter(on.values()))
            raise item.fail(
                f"is written while {switch.label} is 1 (line {switch.line}): the control write-protects its tables then"
            )
        yield item


def _code_lines(source: SourceFile) -> Iterator[tuple[int, str]]:
    """Lines without comments, upper-cased, with their numbers."""
    text = source.text.replace("\r\n", "\n").replace("\r", "\n")
    if len(text) > _MOST_CHARACTERS or text.count("\n") > _MOST_LINES:
        raise source.fail(f"has more than {_MOST_LINES} lines or {_MOST_CHARACTERS} characters; no set of tables has")
    strange = re.search(r"[^\t\n -~]", text)
    if strange:
        place = text.count("\n", 0, strange.start()) + 1
        raise source.fail(f"holds the character {ascii(strange.group())}; the file is plain ASCII text", place)
    for number, line in enumerate(text.split("\n"), start=1):
        code = line.partition(";")[0].strip()
        if len(code) > _LONGEST_LINE:
            raise source.fail(f"the line has {len(code)} characters; one assignment is due", number)
        if code:
            yield number, code.upper()


def _assignments(source: SourceFile, index_counts: Mapping[str, int]) -> Iterator[Assignment]:
    ended, started, number, dotted = False, False, 1, False
    for number, code in _code_lines(source):
        if ended:
            raise source.fail(f"{code[:40]!r} stands after the end mark M17", number)
        if code == "M17":
            ended = True
        elif code == MAKE_EFFECTIVE or not started and (_HEADER.fullmatch(code) or _CHANNEL.fullmatch(code)):
            continue
        else:
            started = True
            item = _assignment(source, number, code, index_counts)
            dotted = dotted or "." in code.partition("]")[0]
            yield item
    if not ended:
        raise source.fail("the end mark M17 is missing: the file is truncated", number)
    if dotted:
        message = f"{source.path}: indices are separated by '.'; read as ',' (write a comma: the control needs it)"
        warnings.warn(message, CompgenWarning, stacklevel=4)


def _assignment(source: SourceFile, number: int, code: str, index_counts: Mapping[str, int]) -> Assignment:
    match = _ASSIGNMENT.fullmatch(code)
    if match is None:
        raise source.fail(f"{code[:60]!r} is no assignment; e.g. $AN_CEC[0,1]=0.005000 is due", number)
    variable, index_text, value = match.groups()
    if variable not in index_counts:
        known = [f"${name}" for name in index_counts]
        raise source.fail(f"${variable} is not a variable of these tables; {nearest('$' + variable, known)}", number)
    index = tuple(_plain_index(part.strip()) for part in re.split(r"[,.]", index_text))
    if len(index) != index_counts[variable] or not all(index):
        raise source.fail(f"${variable} has {index_counts[variable]} indices; got [{index_text}]", number)
    return Assignment(variable, index, value.strip(), source, number)


def _plain_index(text: str) -> str:
    """An index without leading zeros, so that [0,01] and [0,1] are one."""
    return str(int(text)) if text.isdigit() and len(text) < 10 else text


@dataclass(frozen=True)
class LinearTable:
    """An equidistant table in exact decimal numbers (mm): nodes ``start + n step`` up to ``last``.

    ``values`` has one number per node; between nodes the control interpolates linearly, outside the end values hold,
    a ``modulo`` table repeats with the period ``last - start`` (K3-2013, p. 237, 242, 248).
    """

    start_mm: Decimal
    step_mm: Decimal
    last_mm: Decimal
    values: tuple[Decimal, ...]
    modulo: bool = False

    @property
    def intervals(self) -> Fraction:
        """Number of steps from the first to the last node, exact; a whole number in a proper table."""
        return (Fraction(self.last_mm) - Fraction(self.start_mm)) / Fraction(self.step_mm)

    @property
    def nodes_mm(self) -> FloatArray:
        """Node positions, shape (n,)."""
        return np.array([float(self.start_mm + n * self.step_mm) for n in range(len(self.values))])

    @property
    def numbers(self) -> FloatArray:
        """Values, shape (n,)."""
        return np.array([float(value) for value in self.values])

    def at(self, position_mm: FloatArray) -> FloatArray:
        """Interpolated value at positions of any shape; what lies beyond ``last_mm`` has the value there.

        The last node stands at ``last_mm``, or beyond it where that is no whole number of steps.
        """
        start, last = float(self.start_mm), float(self.last_mm)
        position = start + np.mod(position_mm - start, last - start) if self.modulo else np.minimum(position_mm, last)
        return np.interp(position, self.nodes_mm, self.numbers)


def exact_grid(nodes_mm: FloatArray) -> tuple[Decimal, Decimal, Decimal]:
    """Return start, step and last node of equidistant positions as exact decimal numbers; start + k step is last."""
    start, second = (Decimal(repr(float(node))).quantize(POSITION_QUANTUM_MM) for node in nodes_mm[:2])
    step = second - start
    last = start + (len(nodes_mm) - 1) * step
    if step <= 0 or abs(float(last) - float(nodes_mm[-1])) > 1e-3:
        raise ValueError("the nodes of a SINUMERIK table must be equidistant and ascending")
    return start, step, last


@dataclass
class TableParts:
    """The assignments that make one table, collected in any order; ``what`` names the table in messages."""

    what: str
    source: SourceFile
    scalars: dict[str, Assignment] = field(default_factory=dict)
    nodes: dict[int, Assignment] = field(default_factory=dict)

    def add(self, item: Assignment, node: int | None) -> None:
        """Take one assignment: the value of a node, or (None) a scalar variable of the table."""
        if node is None:
            self.scalars[f"${item.variable}"] = item
        else:
            self.nodes[node] = item

    def scalar(self, name: str) -> Assignment:
        """Return the assignment of one scalar variable; InputError if the files do not have it."""
        if name not in self.scalars:
            raise self.source.fail(
                f"{self.what}: {name} is missing (the control would keep an older value): is the file truncated?"
            )
        return self.scalars[name]

    @property
    def is_zero(self) -> bool:
        """Whether every node is zero: whatever is not known of such a table does not matter."""
        return all(item.number() == 0 for item in self.nodes.values())

    @property
    def largest(self) -> str:
        """Largest value of a node in size, as people read it; of a rotary axis it is in degrees."""
        return f"{max((abs(float(item.number())) for item in self.nodes.values()), default=0.0):g} mm or degrees"

    def foreign_table(self, prefix: str) -> tuple[LinearTable, int, float]:
        """Return a table as a real control may hold it, how many reserved nodes lie beyond MAX, and a doubt in um.

        Where MAX is no whole number of steps from MIN, the node behind it ends the last, shorter interval; whether the
        control interpolates to it or holds the node before is not documented, and the doubt is what that can matter.
        """
        first, last, step = (self.scalar(f"{prefix}_{key}") for key in ("MIN", "MAX", "STEP"))
        start_mm, last_mm, step_mm = first.number(), last.number(), step.number()
        if step_mm <= 0:
            raise step.fail(f"{step.value} is not above zero, and the table holds values")
        if last_mm <= start_mm:
            raise last.fail(f"{last.value} is not above the position {first.value} of the first node")
        whole, part = divmod(last_mm - start_mm, step_mm)
        count = int(whole) + (2 if part else 1)
        if part and int(whole) + 1 not in self.nodes:
            count -= 1
        missing = next((n for n in range(count) if n not in self.nodes), None)
        if missing is not None:
            raise self.source.fail(
                f"{self.what}: node {missing} of 0 ... {count - 1} is missing: is the file truncated?", first.line
            )
        values = tuple(self.nodes[n].number() for n in range(count))
        modulo = f"{prefix}_IS_MODULO" in self.scalars and self.scalars[f"{prefix}_IS_MODULO"].whole(-1, 1) == 1
        odd = _ROUNDED < part / step_mm < 1 - _ROUNDED and count > 1
        doubt = abs(float((values[-1] - values[-2]) * part / step_mm)) if odd else 0.0
        surplus = sum(1 for n in self.nodes if n >= count)
        return LinearTable(start_mm, step_mm, last_mm, values, modulo), surplus, 1000.0 * doubt

    def table(self, prefix: str) -> LinearTable:
        """Return the complete table; ``prefix`` is ``$AN_CEC`` or ``$AA_ENC_COMP``."""
        first, last, step = (self.scalar(f"{prefix}_{key}") for key in ("MIN", "MAX", "STEP"))
        start_mm, last_mm, step_mm = first.number(), last.number(), step.number()
        if step_mm <= 0:
            raise step.fail(f"{step.value} is not above zero")
        if last_mm <= start_mm:
            raise last.fail(f"{last.value} is not above the position {first.value} of the first node")
        modulo = self.scalar(f"{prefix}_IS_MODULO").whole(0, 1) == 1
        count = self._count(round((Fraction(last_mm) - Fraction(start_mm)) / Fraction(step_mm)))
        values = tuple(self.nodes[n].number() for n in range(count))
        return LinearTable(start_mm, step_mm, last_mm, values, modulo)

    def _count(self, intervals: int) -> int:
        count = max(intervals, 1) + 1
        surplus = next((node for n, node in self.nodes.items() if n >= count), None)
        if surplus is not None:
            raise surplus.fail(
                f"MIN, MAX and STEP of {self.what} give the nodes 0 ... {count - 1}; this one is too many"
            )
        missing = next((n for n in range(count) if n not in self.nodes), None)
        if missing is not None:
            raise self.source.fail(
                f"{self.what}: node {missing} of 0 ... {count - 1} is missing (the control would keep an older value): "
                f"is the file truncated?"
            )
        return count


def table_violations(machine: Machine, axis: int, table: LinearTable, most: int, what: str) -> list[str]:
    """Return the rules of a single table that are broken: whole number of steps, node count, cycle, travel."""
    found = []
    if table.intervals.denominator != 1:
        found.append(
            f"{what}: MIN + k STEP never meets MAX ({table.start_mm} + k {table.step_mm}, {table.last_mm} mm); the "
            f"control's behaviour is not documented"
        )
    if len(table.values) > most:
        found.append(f"{what} has {len(table.values)} nodes, the control takes {most}")
    if table.modulo:
        if table.values[0] != table.values[-1]:
            found.append(f"{what} is cyclic, but its first and last value differ")
        return found
    return found + coverage_violations(machine, axis, float(table.start_mm), float(table.last_mm), what)


def axis_of(item: Assignment, name: str, axis_names: Sequence[str]) -> int:
    """Return the axis, 0..2, that has this name on the control; InputError if none has."""
    if name not in axis_names:
        raise item.fail(f"no axis of the machine file is named {one_line(name)[:32]!r}; axis_names has {axis_names}")
    return list(axis_names).index(name)
