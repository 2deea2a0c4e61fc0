"""SINUMERIK tables as text: a strict reader for exported files, and a reader for start-up archives."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compgen.controls.shared.base import SourceFile, coverage_violations
from compgen.controls.shared.scanner import Findings, fixed_point, number_pattern, plain_lines
from compgen.data.csv_files import FloatArray, whole_number
from compgen.data.machine import Machine
from compgen.errors import CompgenWarning, InputError, nearest, one_line

# Shared by both kinds of SINUMERIK tables: reading assignments from text, and equidistant tables.
#
# Lexical grammar (SINUMERIK 840D sl / 828D Extended Functions K3, 03/2013, p. 242; 802D sl Function Manual, p. 222)::
#
#     file       = [ "%_N_" name "_INI" ] [ "CHANDATA(" int ")" ] { assignment | "NEWCONF" | ";" comment } "M17"
#     assignment = "$" variable "[" index { "," index } "]" "=" value [ ";" comment ]
#     value      = number without exponent | "(" axis name ")" | axis name in quotation marks
#
# The same assignments may be in a sub-program (name ``..._SPF``) that switches the function off first, makes this
# effective with NEWCONF, and may switch it on again after them.


#: Node positions are written in whole multiples of this.
POSITION_QUANTUM_MM = Decimal("0.000001")
POSITION_DIGITS = 6

#: Switches that may be among the tables, without ``$``, and how many indices each has (K3-2013, p. 239, 245).
SWITCHES = {
    "MA_ENC_COMP_ENABLE": 2,
    "MA_CEC_ENABLE": 1,
    "SN_CEC_TABLE_ENABLE": 1,
    "SN_CEC_TABLE_WEIGHT": 1,
}
#: Switches that write-protect the tables while set to 1 (MD32700, MD32710).
PROTECTING = ("MA_ENC_COMP_ENABLE", "MA_CEC_ENABLE")
MAKE_EFFECTIVE = "NEWCONF"

#: With a rounded step, the last node misses MAX by less than this fraction of the step: 39 x 19.7436 mm = 770.0004 mm.
_ROUNDED = Decimal("0.01")
_LONGEST_LINE = 1000
_MOST_CHARACTERS = 20_000_000
_HEADER = re.compile(r"%_N_[A-Z0-9_]{1,80}_(?:INI|SPF|MPF)")
_CHANNEL = re.compile(r"CHANDATA ?\( ?\d{1,3} ?\)")
_ASSIGNMENT = re.compile(r"\$([A-Z0-9_]{1,60})\s*\[([^\[\]=]{1,100})\]\s*=\s*(\S.*)")
_NUMBER = number_pattern(12, 15)


@dataclass(frozen=True)
class Assignment:
    """One assignment to a system variable: ``variable`` without ``$``, its indices, its value as text."""

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
        return fixed_point(self.source, self.line, self.value, self.label, _NUMBER)

    def whole(self, minimum: int, maximum: int) -> int:
        """Return the value as a whole number within limits."""
        value = self.number()
        if value != value.to_integral_value() or not minimum <= value <= maximum:
            raise self.fail(f"{self.value} is not a whole number from {minimum} to {maximum}")
        return int(value)

    def index_number(self, place: int, maximum: int) -> int:
        """Return one of the indices as a whole number from 0 to ``maximum``."""
        text = self.index[place]
        number = whole_number(text)
        if number is None or number > maximum:
            raise self.fail(f"index {one_line(text)[:20]!r} is not a whole number from 0 to {maximum}")
        return number


def read_assignments(files: Sequence[SourceFile], index_counts: Mapping[str, int]) -> list[Assignment]:
    """Return every assignment in the files, in order.

    Parameters
    ----------
    files : the texts; each ends with ``M17``.
    index_counts : the known variables, without ``$``, and how many indices each has. Variables in :data:`SWITCHES` may
        be assigned several times; the last assignment is returned.

    Raises
    ------
    InputError
        with file and line for an unknown variable, a wrong number of indices, a second assignment to one variable,
        text that is not an assignment, a table written while its function is on, or a file that does not end with M17.
    """
    seen: dict[tuple[str, tuple[str, ...]], Assignment] = {}
    for source in files:
        on: dict[tuple[str, ...], Assignment] = {}
        for item in _assignments(source, index_counts):
            if item.variable in PROTECTING:
                on.pop((item.variable, *item.index), None)
                if item.whole(0, 1):
                    on[item.variable, *item.index] = item
            elif item.variable not in SWITCHES and on:
                switch = next(iter(on.values()))
                raise item.fail(
                    f"is written while {switch.label} is 1 (line {switch.line}): the control then write-protects its tables"
                )
            if item.variable in SWITCHES:
                seen[item.variable, item.index] = item
                continue
            first = seen.setdefault((item.variable, item.index), item)
            if first is not item:
                path = f"{first.source.path}, " if first.source is not source else ""
                raise item.fail(f"is assigned a second time; the first is in {path}line {first.line}")
    if not any(item.variable not in SWITCHES for item in seen.values()):
        raise files[0].fail("contains no table") if files else InputError("no file was given")
    return list(seen.values())


def _assignments(source: SourceFile, index_counts: Mapping[str, int]) -> Iterator[Assignment]:
    """Yield the assignments of one file in order; a truncated file or any other content is an error."""
    ended, started, number, dotted = False, False, 1, False
    codes = (line.partition(";")[0].strip().upper() for line in plain_lines(source, _MOST_CHARACTERS, _LONGEST_LINE))
    for number, code in ((number, code) for number, code in enumerate(codes, start=1) if code):
        if ended:
            raise source.fail(f"{code[:40]!r} follows the end mark M17", number)
        if code == "M17":
            ended = True
            continue
        if code == MAKE_EFFECTIVE or not started and (_HEADER.fullmatch(code) or _CHANNEL.fullmatch(code)):
            continue
        started = True
        match = _ASSIGNMENT.fullmatch(code)
        if match is None:
            raise source.fail(f"{code[:60]!r} is not an assignment; expected e.g. $AN_CEC[0,1]=0.005000", number)
        variable, index_text, value = match.groups()
        if variable not in index_counts:
            known = [f"${name}" for name in index_counts]
            raise source.fail(
                f"${variable} is not a variable of these tables; {nearest('$' + variable, known)}", number
            )
        index = _plain_indices(index_text)
        if len(index) != index_counts[variable] or not all(index):
            raise source.fail(f"${variable} has {index_counts[variable]} indices; got [{index_text}]", number)
        dotted = dotted or "." in index_text
        yield Assignment(variable, index, value.strip(), source, number)
    if not ended:
        raise source.fail("the end mark M17 is missing: the file is truncated", number)
    if dotted:
        message = f"{source.path}: indices are separated by '.'; read as ',' (write a comma: the control requires it)"
        warnings.warn(message, CompgenWarning, stacklevel=3)


def _plain_indices(text: str) -> tuple[str, ...]:
    """The indices of a variable without blanks and leading zeros: [0,01] and [0,1] are the same."""
    words = [word.strip() for word in re.split(r"[,.]", text)]
    return tuple(word if (number := whole_number(word)) is None else str(number) for word in words)


@dataclass(frozen=True)
class LinearTable:
    """An equidistant table in exact decimal numbers (mm): nodes ``start + n step`` up to ``last``.

    ``values`` has one number per node. The control interpolates linearly between nodes and holds the end values
    outside; a ``modulo`` table repeats with the period ``last - start`` (K3-2013, p. 237, 242, 248).
    """

    start_mm: Decimal
    step_mm: Decimal
    last_mm: Decimal
    values: tuple[Decimal, ...]
    modulo: bool = False

    @property
    def intervals(self) -> Fraction:
        """Number of steps from the first to the last node, exact; a whole number in a valid table."""
        return (Fraction(self.last_mm) - Fraction(self.start_mm)) / Fraction(self.step_mm)

    @cached_property
    def nodes_mm(self) -> FloatArray:
        """Node positions, shape (n,)."""
        return np.array([float(self.start_mm + n * self.step_mm) for n in range(len(self.values))])

    @cached_property
    def numbers(self) -> FloatArray:
        """Values, shape (n,)."""
        return np.array([float(value) for value in self.values])

    def at(self, position_mm: FloatArray) -> FloatArray:
        """Interpolated value at positions of any shape; beyond ``last_mm`` the value at ``last_mm`` is held.

        The last node is at ``last_mm``, or beyond it if ``last_mm`` is not a whole number of steps from the start.
        """
        start, last = float(self.start_mm), float(self.last_mm)
        position = start + np.mod(position_mm - start, last - start) if self.modulo else np.minimum(position_mm, last)
        return np.interp(position, self.nodes_mm, self.numbers)

    def context(self) -> dict[str, object]:
        """Return the data of the table for the templates."""
        return {
            "step_mm": float(self.step_mm),
            "minimum_mm": float(self.start_mm),
            "maximum_mm": float(self.last_mm),
            "modulo": int(self.modulo),
            "values_mm": [float(value) for value in self.values],
        }


def exact_grid(nodes_mm: FloatArray) -> tuple[Decimal, Decimal, Decimal]:
    """Return start, step and last node of equidistant positions as exact decimal numbers; start + k step is last."""
    start, second = (Decimal(repr(float(node))).quantize(POSITION_QUANTUM_MM) for node in nodes_mm[:2])
    step = second - start
    last = start + (len(nodes_mm) - 1) * step
    if step <= 0 or abs(float(last) - float(nodes_mm[-1])) > 1e-3:
        raise ValueError("the nodes of a SINUMERIK table must be equidistant and ascending")
    return start, step, last


def exact_values(units: NDArray[np.int64], decimals: int) -> tuple[Decimal, ...]:
    """Return whole units of the last decimal (n,) as exact decimal numbers."""
    return tuple(Decimal(int(count)).scaleb(-decimals) for count in units)


@dataclass
class TableParts:
    """The assignments that define one table, collected in any order; ``what`` names the table in messages."""

    what: str
    source: SourceFile
    scalars: dict[str, Assignment] = field(default_factory=dict)
    nodes: dict[int, Assignment] = field(default_factory=dict)

    def add(self, item: Assignment) -> None:
        """Add one assignment: the value of a node, or a scalar variable of the table."""
        if item.variable in ("AN_CEC", "AA_ENC_COMP"):
            self.nodes[item.index_number(1, 999_999)] = item
        else:
            self.scalars[f"${item.variable}"] = item

    def scalar(self, name: str) -> Assignment:
        """Return the assignment of one scalar variable; InputError if it is missing from the files."""
        if name not in self.scalars:
            raise self.source.fail(
                f"{self.what}: {name} is missing (the control would keep its old value): is the file truncated?"
            )
        return self.scalars[name]

    @property
    def is_zero(self) -> bool:
        """Whether every node is zero: unknown details of such a table do not matter."""
        return all(item.number() == 0 for item in self.nodes.values())

    @property
    def largest(self) -> str:
        """Largest node value in magnitude, as text; degrees for a rotary axis."""
        return f"{max((abs(float(item.number())) for item in self.nodes.values()), default=0.0):g} mm or degrees"

    def foreign_table(self, prefix: str) -> tuple[LinearTable, int, float]:
        """Return a table as a real control may contain it, the number of reserved nodes beyond MAX, and a doubt in um.

        If MAX is not a whole number of steps from MIN, the next node ends the last, shorter interval; whether the
        control interpolates to it or holds the previous node is not documented. The doubt is the largest difference.
        """
        start_mm, last_mm, step_mm = self._grid(prefix)
        whole, part = divmod(last_mm - start_mm, step_mm)
        count = int(whole) + (2 if part else 1)
        if part and int(whole) + 1 not in self.nodes:
            count -= 1
        missing = next((n for n in range(count) if n not in self.nodes), None)
        if missing is not None:
            raise self.source.fail(
                f"{self.what}: node {missing} of 0 ... {count - 1} is missing: is the file truncated?",
                self.scalar(f"{prefix}_MIN").line,
            )
        values = tuple(self.nodes[n].number() for n in range(count))
        modulo = f"{prefix}_IS_MODULO" in self.scalars and self.scalars[f"{prefix}_IS_MODULO"].whole(-1, 1) == 1
        odd = _ROUNDED < part / step_mm < 1 - _ROUNDED and count > 1
        doubt = abs(float((values[-1] - values[-2]) * part / step_mm)) if odd else 0.0
        surplus = sum(1 for n in self.nodes if n >= count)
        return LinearTable(start_mm, step_mm, last_mm, values, modulo), surplus, 1000.0 * doubt

    def table(self, prefix: str) -> LinearTable:
        """Return the complete table; ``prefix`` is ``$AN_CEC`` or ``$AA_ENC_COMP``."""
        start_mm, last_mm, step_mm = self._grid(prefix)
        modulo = self.scalar(f"{prefix}_IS_MODULO").whole(0, 1) == 1
        count = max(round((Fraction(last_mm) - Fraction(start_mm)) / Fraction(step_mm)), 1) + 1
        surplus = next((node for n, node in self.nodes.items() if n >= count), None)
        if surplus is not None:
            raise surplus.fail(
                f"MIN, MAX and STEP of {self.what} give the nodes 0 ... {count - 1}; this node is not one of them"
            )
        missing = next((n for n in range(count) if n not in self.nodes), None)
        if missing is not None:
            raise self.source.fail(
                f"{self.what}: node {missing} of 0 ... {count - 1} is missing (the control would keep its old value): "
                f"is the file truncated?"
            )
        values = tuple(self.nodes[n].number() for n in range(count))
        return LinearTable(start_mm, step_mm, last_mm, values, modulo)

    def _grid(self, prefix: str) -> tuple[Decimal, Decimal, Decimal]:
        """Return MIN, MAX and STEP, checked."""
        first, last, step = (self.scalar(f"{prefix}_{key}") for key in ("MIN", "MAX", "STEP"))
        if step.number() <= 0:
            raise step.fail(f"{step.value} is not above zero")
        if last.number() <= first.number():
            raise last.fail(f"{last.value} is not above the position {first.value} of the first node")
        return first.number(), last.number(), step.number()


def table_violations(machine: Machine, axis: int, table: LinearTable, most: int, what: str) -> list[str]:
    """Return the broken rules of a single table: whole number of steps, node count, cycle, travel."""
    found = []
    if table.intervals.denominator != 1:
        found.append(
            f"{what}: MIN + k STEP never meets MAX ({table.start_mm} + k {table.step_mm}, {table.last_mm} mm); "
            f"the control's behaviour is not documented"
        )
    if len(table.values) > most:
        found.append(f"{what} has {len(table.values)} nodes; the control takes at most {most}")
    if table.modulo:
        if table.values[0] != table.values[-1]:
            found.append(f"{what} is cyclic, but its first and last value differ")
        return found
    return found + coverage_violations(machine, axis, float(table.start_mm), float(table.last_mm), what)


def axis_of(item: Assignment, name: str, axis_names: Sequence[str]) -> int:
    """Return the axis, 0..2, that has this name on the control; InputError if there is none."""
    if name not in axis_names:
        raise item.fail(f"no axis of the machine file is named {one_line(name)[:32]!r}; axis_names has {axis_names}")
    return list(axis_names).index(name)


# Files from real SINUMERIK controls: start-up archives, punched files and sub-programs not written by this program.
#
# An archive is a chain of files. Each is preceded by NUL bytes with the name ``_N_NC_CEC_INI`` in the binary form
# (``.arc``), or by a line ``%_N_NC_CEC_INI`` in the text form. The tables are in the initialisation files; part
# programs that write the same variables have no effect and are skipped. If a file contains only one part, that part is
# read, whether or not it is a program.
#
# Nothing that could change a table is skipped: a line of a table that is not understood is an error with its number.
# Everything else is counted and reported in one line.


#: Doubts about a table of a real control are reported from this size on, um.
WORTH_SAYING_UM = 0.1
#: Kinds of files (last word of the name) whose assignments are data of the control.
DATA_KINDS = ("INI", "TEA", "SEA", "EEC", "CEC")
#: Other machine data and variables that do not change a table, with their allowed values; None: any value.
HARMLESS: Mapping[str, tuple[str, ...] | None] = {
    "MN_MM_CEC_MAX_POINTS": None,
    "MA_MM_ENC_COMP_MAX_POINTS": None,
    "MA_CEC_MAX_SUM": None,
    "MA_CEC_MAX_VELO": None,
    "MA_CEC_SCALING_SYSTEM_METRIC": ("1", "TRUE"),
    "MN_SCALING_SYSTEM_IS_METRIC": ("1", "TRUE"),
    "AN_CEC_INPUT_NCU": ("0", "1"),
    "AN_CEC_OUTPUT_NCU": ("0", "1"),
    "AN_CEC_TYPE": ("0",),
}
#: Cylinder error compensation has the same abbreviation; it has no effect if it is zero.
_OTHER_CEC = re.compile(r"SN_CEC_(?:\d|BAS|COMP|CALC)[A-Z0-9_]*")
#: Program words that do not affect tables: units, path and display modes, dwells, messages, labels (jumps to them are
#: refused), declarations without a table.
_MODE = r"(?:G(?!70|700)\d{1,3}|D0|SUPA|DISPLOF|DISPLON|SBLOF|SBLON)"
_IDLE_WORD = re.compile(
    r"METRIC|NEWCONF|STOPRE|M0?[01]|MSG ?\(.*\)|G0?4 ?[FS] ?=?[\d.]+|CHANDATA ?\( ?\d{1,3} ?\)|"
    rf"PROC [A-Z0-9_]+.*|REDEF .*|%|{_MODE}(?: {_MODE})*|[A-Z_][A-Z0-9_]{{1,31}}:|"
    r"DEF (?:INT|REAL|BOOL|CHAR|AXIS|STRING ?\[\d{1,3}\]) [A-Z0-9_, ]+|EXTERN [A-Z0-9_]+(?: ?\([A-Z, ]*\))?"
)
_END_WORD = re.compile(r"M17|M30|M0?2|RET")
_INCH_WORD = re.compile(r"INCH|G70|G700")
_NAME = re.compile(r"(?<!/)_N_([A-Z0-9_]{1,80})_([A-Z0-9]{2,4})(?![A-Z0-9_])")
_TEXT_HEADER = re.compile(r"%_N_([A-Z0-9_]{1,80})_([A-Z0-9]{2,4})(?![A-Z0-9_])")
_ARCHIVE_ASSIGNMENT = re.compile(r"\$ ?([A-Z0-9_]{1,60}) ?(?:\[([^\[\]=]{0,100})\])? ?= ?(.*)")
_BLOCK_NUMBER = re.compile(r"N ?\d{1,8}\s+")
_COMMA_NUMBER = re.compile(r"[+-]?\d{1,12},\d{1,15}")
_ARCHIVE_EXPONENT = re.compile(r"([+-]?(?:\d{1,12}\.?\d{0,15}|\.\d{1,15})) ?EX?([+-]?\d{1,3})")
_LONGEST_EXPONENT = 12
_MENTIONS_TABLE = re.compile(r"A[NA]_(?:CEC|ENC_COMP)")
_WRITES_TABLE = re.compile(r"\s*(?:N\d{1,8}\s+)?\$(?:AN_CEC|AA_ENC_COMP)\s*\[")
_TRUTH = {"TRUE": "1", "FALSE": "0"}
_KEYS = ("", "_STEP", "_MIN", "_MAX", "_IS_MODULO", "_INPUT_AXIS", "_OUTPUT_AXIS", "_DIRECTION", "_MULT_BY_TABLE")
_TABLE_VARIABLES = {head + key for head in ("AN_CEC", "AA_ENC_COMP") for key in _KEYS}


def noted_table(part: TableParts, prefix: str, travel_mm: tuple[float, float], findings: Findings) -> LinearTable:
    """Return the table of a real control and note anything unusual; ``travel_mm`` is the travel of its input axis."""
    table, surplus, doubt_um = part.foreign_table(prefix)
    modulo = part.scalars.get(f"{prefix}_IS_MODULO")
    if modulo is None:
        findings.count("tables without IS_MODULO (taken as 0)")
    elif modulo.number() == -1:
        inside = float(table.start_mm) <= travel_mm[0] and travel_mm[1] <= float(table.last_mm)
        if not (inside or part.is_zero):
            raise modulo.fail(
                f"-1 is neither 0 nor 1, and the value matters because the travel {travel_mm[0]:g} ... {travel_mm[1]:g} mm "
                "extends beyond the table: write the value that the control uses"
            )
        findings.count("tables with IS_MODULO = -1 (taken as 0)")
    if surplus:
        findings.count("reserved nodes beyond MAX", surplus)
    if doubt_um >= WORTH_SAYING_UM:
        findings.notes.append(
            f"{part.what}: MIN + k STEP does not meet MAX; between the last node before MAX and MAX the control may "
            f"differ by up to {doubt_um:.1f} um from the straight line assumed here"
        )
    return table


@dataclass(frozen=True)
class _ArchivePart:
    """One file of an archive: its name, its kind (``INI``, ``SPF``; empty: not stated), and its numbered lines."""

    name: str
    kind: str
    lines: tuple[tuple[int, str], ...]

    @property
    def writes_tables(self) -> bool:
        """Whether any line other than a comment assigns a value to a table."""
        return any(_WRITES_TABLE.match(line.upper()) for _, line in self.lines)


@dataclass(frozen=True)
class ArchiveAssignments:
    """Assignments of a real file: table assignments, and switches elsewhere in an archive."""

    items: list[Assignment]
    machine_data: dict[tuple[str, tuple[str, ...]], Assignment]

    def switched_off(self, variable: str, index: tuple[str, ...]) -> bool:
        """Whether the machine data of an archive set a switch to 0; False if they do not contain it."""
        item = self.machine_data.get((variable, index))
        return item is not None and item.number() == 0


def foreign_assignments(
    files: Sequence[SourceFile], tables: Mapping[str, int], findings: Findings
) -> ArchiveAssignments:
    """Return the assignments to tables and switches in real files; InputError with the line if not understood.

    Parameters
    ----------
    files : archives, punched files, sub-programs; decoded text, NUL bytes included.
    tables : the variables to read, without ``$``, and how many indices each has.
    findings : receives what is skipped.
    """
    items: dict[tuple[str, tuple[str, ...]], Assignment] = {}
    machine_data: dict[tuple[str, tuple[str, ...]], Assignment] = {}
    for source in files:
        parts, archive = _parts(source, findings)
        for part in parts:
            elsewhere = archive and not part.writes_tables
            for item in _assignments_of_part(source, part, tables, findings, archive=archive):
                key = item.variable, item.index
                if item.variable in SWITCHES:
                    (machine_data if elsewhere else items)[key] = item
                    continue
                first = items.setdefault(key, item)
                if first is not item and first.value != item.value:
                    raise item.fail(
                        f"is assigned a second value; the first is in {first.source.path.name}, line {first.line}"
                    )
    if not any(item.variable not in SWITCHES for item in items.values()):
        expected = " or ".join(f"${name}" for name in tables if name in ("AN_CEC", "AA_ENC_COMP"))
        raise files[0].fail(f"contains no table; expected {expected}")
    return ArchiveAssignments(list(items.values()), machine_data)


def _parts(source: SourceFile, findings: Findings) -> tuple[list[_ArchivePart], bool]:
    """Return the parts of a text to read, and whether it is an archive of several files.

    These are the only part, or the initialisation files of an archive; other parts are counted.
    """
    found: list[_ArchivePart] = []
    name, kind = "", ""
    lines: list[tuple[int, str]] = []
    text = source.text.replace("\r\n", "\n").replace("\r", "\n")
    for number, line in enumerate(text.split("\n"), start=1):
        head, nul, rest = line.rpartition("\0")
        names = _NAME.findall(head) if nul else _TEXT_HEADER.findall(line.upper()[:120])
        if names or nul:  # NUL bytes without a name come before files that are not in the control's memory (drives)
            found.append(_ArchivePart(name, kind, tuple(lines)))
            (name, kind), lines = names[-1] if names else ("", ""), []
        if nul or not names:
            code = rest if nul else line
            if code.strip():
                lines.append((number, code))
    found.append(_ArchivePart(name, kind, tuple(lines)))
    found = [part for part in found if any(not code.lstrip().startswith(";") for _, code in part.lines)]
    if len(found) <= 1:
        return found, False
    chosen = [part for part in found if part.kind in DATA_KINDS]
    others = [part for part in found if part.kind not in DATA_KINDS]
    writing = [f"{part.name}.{part.kind}" for part in others if part.writes_tables]
    few = ", ".join(writing[:3]) + (f" and {len(writing) - 3} more" if len(writing) > 3 else "")
    if writing and not any(part.writes_tables for part in chosen):
        raise source.fail(f"only programs contain tables ({few}): give such a program as a separate file")
    if others := [part for part in others if part.name]:
        named = f" (including programs that write tables, not evaluated: {few})" if writing else ""
        findings.count(f"other files of the archive{named}", len(others))
    last = found[-1]
    ends = (_END_WORD.fullmatch(line.partition(";")[0].strip().upper()) for _, line in last.lines)
    if last.kind == "INI" and not any(ends):
        message = f"the archive ends within {last.name}.INI: it is truncated, and some of its switches are missing"
        raise source.fail(message, last.lines[-1][0])
    return chosen, True


def _assignments_of_part(
    source: SourceFile, part: _ArchivePart, tables: Mapping[str, int], findings: Findings, *, archive: bool
) -> Iterator[Assignment]:
    """Yield the relevant assignments of one part; others are counted, anything not understood is refused."""
    ended, any_table, number = False, False, 0
    for number, line in part.lines:
        code = _BLOCK_NUMBER.sub("", line.partition(";")[0].strip().upper(), count=1)
        if not code or _TEXT_HEADER.match(code):
            continue
        if _END_WORD.fullmatch(code):
            ended = True
            continue
        match = _ARCHIVE_ASSIGNMENT.fullmatch(" ".join(code.split())) if code.startswith("$") else None
        if match is None:
            # other statements must not change a table: refuse inch, jumps, calculations, anything that mentions a table
            if _INCH_WORD.fullmatch(code):
                raise source.fail(f"{code!r}: the file is in inches; only tables in mm are read", number)
            if not _IDLE_WORD.fullmatch(code) and (not archive or _MENTIONS_TABLE.search(code)):
                raise source.fail(
                    f"{one_line(code)[:60]!r} is not understood, and it could change a table; give the archive of the "
                    "control, or its NC_CEC.INI or AX_EEC.INI, or remove the line if it does not affect the tables",
                    number,
                )
            if archive:
                findings.count("other lines")
            continue
        item = _item(source, number, match, tables, findings)
        if item is not None:
            if item.variable not in SWITCHES:
                any_table, ended = True, False
            yield item
    if any_table and not ended:
        raise source.fail("the end mark (M17, M30) after the tables is missing: the file is truncated", number)


def _item(
    source: SourceFile, number: int, match: re.Match[str], tables: Mapping[str, int], findings: Findings
) -> Assignment | None:
    """One assignment if it belongs to the tables; None if it is skipped."""
    variable, index_text, value = match.group(1), match.group(2) or "", match.group(3).strip()
    index = _plain_indices(index_text) if index_text.strip() else ()
    plain, unusual = _plain_value(value)
    item = Assignment(variable, index, plain, source, number)
    if variable in tables or variable in SWITCHES:
        count = tables.get(variable) or SWITCHES[variable]
        if len(index) != count or not all(index):
            raise source.fail(f"${variable} has {count} indices; got [{one_line(index_text)[:40]}]", number)
        if variable in tables:
            if unusual:
                findings.count(unusual)
            return item
        what = "switches of other tables"
    elif variable in HARMLESS:
        allowed = HARMLESS[variable]
        if allowed is not None and item.value not in allowed and value not in allowed:
            raise item.fail(f"{one_line(value)[:30]!r} is not supported; expected {' or '.join(allowed[:1])}")
        what = "machine data other than the tables"
    elif _OTHER_CEC.fullmatch(variable) and item.value in ("0", "0.0", "FALSE"):
        what = "machine data other than the tables"
    elif variable in _TABLE_VARIABLES:
        what = "values of tables of the other kind (CEC, EEC)"
    elif "CEC" in variable or "ENC_COMP" in variable:
        raise item.fail("is an unknown variable that could change a table")
    elif variable.startswith("MA_BACKLASH"):
        what = "lines of $MA_BACKLASH, which is not a table: its effect is not removed"
    else:
        what = "other machine data"
    findings.count(what)
    return None


def _plain_value(value: str) -> tuple[str, str]:
    """A value as the control writes it (1 for TRUE, decimal point, no exponent), and what was unusual about it."""
    if value in _TRUTH:
        return _TRUTH[value], ""
    if _COMMA_NUMBER.fullmatch(value):
        return value.replace(",", "."), "decimal commas"
    exponent = _ARCHIVE_EXPONENT.fullmatch(value)
    if exponent and abs(int(exponent.group(2))) <= _LONGEST_EXPONENT:
        return f"{Decimal(exponent.group(1)).scaleb(int(exponent.group(2))):f}", "numbers with an exponent"
    return value, ""
