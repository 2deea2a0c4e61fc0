"""LinuxCNC volumetric compensation (``linuxcnc-volumetric``): the table of compgen's kinematics module ``volkins``."""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.controls.linuxcnc_comp import (
    SHOWN,
    check_size,
    lines_of,
    number_in,
    units_setting,
    whole_in,
    with_units,
)
from compgen.controls.shared.base import Controller, SourceFile, Term, Usage, coverage_violations, nodes_by_axis
from compgen.controls.shared.grids import equidistant_grid, loss_setting, rounded, trilinear
from compgen.controls.shared.terms import error_terms
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray, fixed
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Points
from compgen.data.machine import MM_PER_UNIT, Machine, Vector3
from compgen.data.names import AXES, ERROR_INDEX, error_named
from compgen.data.toml_files import choice, setting, whole
from compgen.errors import InputError
from compgen.kinematics.first_order import tool_of
from compgen.kinematics.many_points import blocks, full_grid

# The table of the LinuxCNC kinematics ``volkins``: E = C P or a grid, evaluated in the arithmetic of the C sources.
#
# E(q, t) is the error of the tool tip (actual minus commanded) with the axes at q and the tool offset t; the tip is at
# P = q + E(q, t) (minus the tool offset), so the control sends the axes to q = P - E(q, t), by iteration.


#: Factors of a term, as words in the file.
LEVERS = ("1", "x", "y", "z", "tx", "ty", "tz")
#: Limits of ``volcomp.h``.
MOST_CURVES, MOST_TERMS, MOST_NODES, MOST_VERTICES, LONGEST_NAME = 64, 512, 10_000, 100_000, 31
#: The inverse iteration ends when no axis moves by more than this plus this fraction of its coordinate (far from
#: machine zero, adjacent floating-point numbers differ by more than the first), or fails after so many iterations.
LAST_STEP_MM, LAST_PART, MOST_ROUNDS = 1e-13, 1e-15, 50


@dataclass(frozen=True)
class VolCurve:
    """One curve over ``axis``: values (n,) in mm or rad at ``first_mm + k step_mm``; constant outside."""

    name: str
    axis: int
    first_mm: float
    step_mm: float
    values: FloatArray

    @property
    def nodes_mm(self) -> FloatArray:
        """Positions of the values, shape (n,)."""
        return np.asarray(self.first_mm + self.step_mm * np.arange(len(self.values)), dtype=np.float64)

    def at(self, position_mm: FloatArray) -> FloatArray:
        """Value at positions (m,)."""
        return self.within(self.cells(position_mm))

    @property
    def grid(self) -> tuple[int, float, float, int]:
        """Axis, first position, step and count: curves on the same grid have the same :meth:`cells`."""
        return self.axis, self.first_mm, self.step_mm, len(self.values)

    def cells(
        self, position_mm: FloatArray
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray, NDArray[np.bool_]]:
        """Values before and after positions (m,), the weight of the one after, and whether a position is at the end."""
        last = len(self.values) - 1
        ratio = np.clip((position_mm - self.first_mm) / self.step_mm, 0.0, float(last))
        left = np.minimum(ratio.astype(np.int64), max(last - 1, 0))
        return left, np.minimum(left + 1, last), ratio - left, ratio >= last

    def within(self, cells: tuple[NDArray[np.int64], NDArray[np.int64], FloatArray, NDArray[np.bool_]]) -> FloatArray:
        """Value in the cells of :meth:`cells`, shape (m,)."""
        left, right, share, at_end = cells
        below, between = self.values.take(left), self.values.take(right)
        between -= below
        between *= share
        between += below
        between[at_end] = self.values[-1]
        return between


@dataclass(frozen=True)
class VolTerm:
    """Adds coefficient x lever x curve to the error of axis ``output``; ``lever`` is one of :data:`LEVERS`."""

    output: int
    curve: str
    coefficient: float
    lever: str


@dataclass(frozen=True)
class VolGrid:
    """Errors ``vertices_mm`` (nx, ny, nz, 3) at ``first_mm + (i, j, k) step_mm``, for one tool offset."""

    first_mm: tuple[float, float, float]
    step_mm: tuple[float, float, float]
    vertices_mm: FloatArray


@dataclass(frozen=True)
class VolTable:
    """A table as read by the kinematics module: curves with terms, or a grid.

    Numbers here are in mm; ``unit`` is the unit of lengths in the file, the machine unit: ``"mm"`` or ``"inch"``.
    """

    curves: tuple[VolCurve, ...]
    terms: tuple[VolTerm, ...]
    grid: VolGrid | None = None
    unit: str = "mm"

    def scaled(self, factor: float) -> VolTable:
        """Return the table with all lengths times ``factor``: from the file's unit to mm, or back.

        A curve is a length if a term uses it directly (lever 1). With a lever it is an angle and has no unit; a curve
        used in both ways is taken as a length, and the coefficient of the terms with a lever compensates for this.
        """
        if factor == 1.0:
            return self
        lengths = {term.curve for term in self.terms if term.lever == LEVERS[0]}
        curves = tuple(
            replace(
                curve,
                first_mm=curve.first_mm * factor,
                step_mm=curve.step_mm * factor,
                values=curve.values * factor if curve.name in lengths else curve.values,
            )
            for curve in self.curves
        )
        both = {term for term in self.terms if term.curve in lengths and term.lever != LEVERS[0]}
        terms = tuple(
            replace(term, coefficient=term.coefficient / factor) if term in both else term for term in self.terms
        )
        grid = self.grid
        if grid is not None:
            x, y, z = (value * factor for value in grid.first_mm)
            hx, hy, hz = (value * factor for value in grid.step_mm)
            grid = VolGrid((x, y, z), (hx, hy, hz), grid.vertices_mm * factor)
        return VolTable(curves, terms, grid, self.unit)

    def error(self, position_mm: FloatArray, tool_mm: FloatArray) -> FloatArray:
        """E at axis positions (n, 3) with tool offsets (3,) or (n, 3): shape (n, 3), mm, actual minus commanded."""
        if self.grid is not None:
            return trilinear(
                self.grid.vertices_mm, np.array(self.grid.first_mm), np.array(self.grid.step_mm), position_mm
            )
        tool = np.broadcast_to(tool_mm, position_mm.shape)
        # usually all curves over an axis have the same nodes: what depends only on these is computed once
        grids = {curve.grid: curve for curve in self.curves}
        error = np.zeros(position_mm.shape)
        for part in blocks(len(position_mm), _BLOCK):
            along = np.ascontiguousarray(position_mm[part].T)
            levers = dict(zip(LEVERS, [1.0, *along, *tool[part].T], strict=True))
            cells = {grid: curve.cells(along[curve.axis]) for grid, curve in grids.items()}
            values = {curve.name: curve.within(cells[curve.grid]) for curve in self.curves}
            for term in self.terms:
                error[part, term.output] += term.coefficient * levers[term.lever] * values[term.curve]
        return error

    def forward(self, position_mm: FloatArray, tool_mm: FloatArray) -> FloatArray:
        """Tip position minus the tool offset with the axes at positions (n, 3): shape (n, 3), mm."""
        return position_mm + self.error(position_mm, tool_mm)

    def inverse(self, commanded_mm: FloatArray, tool_mm: FloatArray) -> FloatArray:
        """Axis positions at which the tip (minus the tool offset) is at ``commanded_mm`` (n, 3): shape (n, 3), mm.

        InputError if the iteration does not converge: no machine has such errors, and the control refuses to move.
        """
        axes = np.array(commanded_mm, dtype=np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(MOST_ROUNDS):
                following = commanded_mm - self.error(axes, tool_mm)
                ended = np.abs(following - axes) <= LAST_STEP_MM + LAST_PART * np.abs(following)
                axes = following
                if np.all(ended):
                    return axes
        raise InputError(
            "the errors of the table change too fast with position: no axis position puts the tool at the commanded point"
        )

    def slope(self, lower_mm: FloatArray, upper_mm: FloatArray, tool_mm: FloatArray) -> float:
        """Upper bound of the change of E per mm of travel within a box; well below 1 the inverse exists and is unique."""
        if self.grid is not None:
            parts = [
                np.max(np.abs(np.diff(self.grid.vertices_mm, axis=axis)), initial=0.0) / step
                for axis, step in enumerate(self.grid.step_mm)
            ]
            return float(sum(parts))
        reach = np.concatenate([[1.0], np.maximum(np.abs(lower_mm), np.abs(upper_mm)), np.abs(tool_mm)])
        largest = dict(zip(LEVERS, reach.tolist(), strict=True))
        curves = {curve.name: curve for curve in self.curves}
        sums = np.zeros(3)
        for term in self.terms:
            curve = curves[term.curve]
            steepest = np.max(np.abs(np.diff(curve.values)), initial=0.0) / curve.step_mm
            value = np.max(np.abs(curve.values)) if term.lever in LEVERS[1:4] else 0.0
            sums[term.output] += abs(term.coefficient) * (largest[term.lever] * steepest + value)
        return float(np.max(sums))


def checksum(words: Iterable[str]) -> str:
    """CRC-32 of the words from ``volcomp`` to ``end`` separated by single blanks, as 8 hexadecimal digits.

    >>> checksum("volcomp 1 end".split())
    'CF835787'
    """
    total, joint = 0, b""
    for word in words:
        total = zlib.crc32(joint + word.encode("ascii", "replace"), total)
        joint = b" "
    return f"{total:08X}"


# Strict reading of the table of ``volkins``: as strict as the C sources, reporting the line of an error.
#
# White space separates words: ``volcomp 1``, ``unit mm`` or ``unit inch`` (mm if missing: tables of versions that
# wrote mm only), then ``curve NAME AXIS COUNT FIRST STEP`` with COUNT numbers, ``term OUTPUT
# CURVE COEFFICIENT LEVER``, or ``grid NX NY NZ X0 Y0 Z0 HX HY HZ`` with 3 NX NY NZ numbers (x fastest), then ``end``.
# One ``crc32 XXXXXXXX`` of all words up to ``end`` must follow; comments (``#`` to the end of the line) may be added.


#: Points at a time: intermediate arrays stay in the cache of one core.
_BLOCK = 4096
_LONGEST_LINE = 4096
_MOST_CHARACTERS = 32_000_000
_MAGIC = ("volcomp", "1")


class _WordReader:
    """The words of a file one by one, with their line; all words taken count for the checksum."""

    def __init__(self, source: SourceFile) -> None:
        self.source, self.line, self.taken = source, 1, list[str]()
        self._lines = lines_of(source)
        self._words: Iterator[str] = iter(())

    def take(self, what: str) -> str:
        """Return the next word; InputError at the end of the file."""
        word = next(self._words, None)
        while word is None:
            following = next(self._lines, None)
            if following is None:
                raise self.source.fail(f"expected {what}, but the file ends: it is truncated", self.line)
            self._words = iter(self._split(*following))
            word = next(self._words, None)
        self.taken.append(word)
        return word

    def _split(self, line: int, text: str, _: bool) -> list[str]:
        self.line = line
        if len(text) > _LONGEST_LINE:
            raise self.source.fail(f"has {len(text)} characters; at most {_LONGEST_LINE} are allowed", line)
        return text.split()

    def number(self, what: str) -> float:
        """Return the next word as a finite number."""
        word = self.take(what)  # first: it may be on the next line
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
        """Yield line and words of the rest, starting with the words left in the current line."""
        first = (self.line, list(self._words))
        split = ((line, self._split(line, text, ended)) for line, text, ended in self._lines)
        return ((line, words) for line, words in chain([first], split) if words)


def parse_volcomp(source: SourceFile) -> VolTable:
    """Read a table; InputError with the line for anything that the kinematics module rejects."""
    check_size(source, _MOST_CHARACTERS)
    words = _WordReader(source)
    for expected in _MAGIC:
        if (word := words.take("'volcomp 1'")) != expected:
            raise source.fail(f"expected 'volcomp 1' at the start, found {word[:SHOWN]!r}", words.line)
    curves: dict[str, VolCurve] = {}
    terms: list[VolTerm] = []
    grid: VolGrid | None = None
    unit = "mm"
    word = words.take("'end'")
    if word == "unit":
        unit, word = _unit(words), words.take("'end'")
    while word != "end":
        if word == "curve":
            curve = _read_curve(words, curves)
            curves[curve.name] = curve
        elif word == "term":
            if len(terms) == MOST_TERMS:
                raise source.fail(f"is term {len(terms) + 1}; at most {MOST_TERMS} are allowed", words.line)
            output, name = words.whole("an axis (0 X, 1 Y, 2 Z)", 0, 2), words.take("the name of a curve")
            if name not in curves:
                raise source.fail(f"no curve with the name {name[:SHOWN]!r} is defined above", words.line)
            coefficient, lever = words.number("a coefficient"), words.take("a lever")
            if lever not in LEVERS:
                raise source.fail(f"{lever[:SHOWN]!r} is not a lever; use {', '.join(LEVERS)}", words.line)
            terms.append(VolTerm(output, name, coefficient, lever))
        elif word == "grid" and grid is None:
            grid = _read_grid(words)
        else:
            raise source.fail(f"expected 'curve', 'term', one 'grid' or 'end', found {word[:SHOWN]!r}", words.line)
        word = words.take("'end'")
    if bool(terms) == (grid is not None):
        raise source.fail("expected either terms or a grid, but not both", words.line)
    _check_trailer(source, words)
    return VolTable(tuple(curves.values()), tuple(terms), grid, unit).scaled(MM_PER_UNIT[unit])


def _unit(words: _WordReader) -> str:
    word = words.take("a unit")
    if word not in MM_PER_UNIT:
        raise words.source.fail(f"{word[:SHOWN]!r} is not a unit; expected mm or inch", words.line)
    return word


def _read_curve(words: _WordReader, known: dict[str, VolCurve]) -> VolCurve:
    name = words.take("a name of a curve")
    if len(name) > LONGEST_NAME or name in known or len(known) == MOST_CURVES:
        message = f"expected a new name of at most {LONGEST_NAME} characters for one of at most {MOST_CURVES} curves"
        raise words.source.fail(f"{message}, found {name[:SHOWN]!r}", words.line)
    axis = words.whole("an axis (0 X, 1 Y, 2 Z)", 0, 2)
    count = words.whole("a number of nodes", 1, MOST_NODES)
    first_mm, step_mm = words.number("the first position"), words.step()
    return VolCurve(name, axis, first_mm, step_mm, words.numbers(count))


def _read_grid(words: _WordReader) -> VolGrid:
    nx, ny, nz = (words.whole("a number of vertices", 1, MOST_NODES) for _ in range(3))
    if nx * ny * nz > MOST_VERTICES:
        raise words.source.fail(f"{nx} x {ny} x {nz} vertices are more than {MOST_VERTICES}", words.line)
    x, y, z = (words.number("the position of the first vertex") for _ in range(3))
    hx, hy, hz = (words.step() for _ in range(3))
    values = words.numbers(3 * nx * ny * nz).reshape(nz, ny, nx, 3)
    return VolGrid((x, y, z), (hx, hy, hz), values.transpose(2, 1, 0, 3))


def _check_trailer(source: SourceFile, words: _WordReader) -> None:
    counted, found = checksum(words.taken), False
    for line, line_words in words.rest():
        plain = line_words[: next((k for k, word in enumerate(line_words) if word.startswith("#")), None)]
        if not plain:
            continue
        if found or len(plain) != 2 or plain[0] != "crc32":
            shown = " ".join(plain)[:SHOWN]
            raise source.fail(f"only comments and one 'crc32 XXXXXXXX' may follow 'end', found {shown!r}", line)
        if plain[1].upper() != counted:
            message = f"the checksum of the words up to 'end' is {counted}, but the file says {plain[1][:SHOWN]!r}"
            raise source.fail(f"{message}: the table was changed or damaged. Export it again", line)
        found = True
    if not found:
        raise source.fail("there is no 'crc32 XXXXXXXX' after 'end': the file is truncated", words.line)


# How the numbers of a ``volkins`` table are written, their checksum, and the files exported with a table.


#: Decimals of positions and of values in mm, and of angles in rad.
POSITION_DIGITS, LENGTH_DIGITS, ANGLE_DIGITS = 6, 9, 13
#: Decimals in inch: lengths are not coarser, and after 400 rounded steps a curve still ends at the end of travel.
_INCH_POSITION_DIGITS, _INCH_LENGTH_DIGITS = 12, 11
#: Name and last line of the licence text for the sources.
LICENCE, _LICENCE_ENDS = "COPYING", "Public License instead of this License."
#: Suffixes of other files exported with the table; each ends with a line containing ``end of`` and its name.
COMPANIONS = (".ini", ".hal", ".comp", ".h")


def position_digits(table: VolTable) -> int:
    """Return the decimals of positions in the unit of the table's file."""
    return POSITION_DIGITS if table.unit == "mm" else _INCH_POSITION_DIGITS


def length_digits(table: VolTable) -> int:
    """Return the decimals of lengths in the unit of the table's file."""
    return LENGTH_DIGITS if table.unit == "mm" else _INCH_LENGTH_DIGITS


def digits_of(table: VolTable, curve: VolCurve) -> int:
    """Return the decimals of a curve's values: lengths in the unit of the table's file, angles in rad."""
    linear = curve.name in ERROR_INDEX and error_named(curve.name).kind == "linear"
    return length_digits(table) if linear else ANGLE_DIGITS


def in_file_units(table: VolTable) -> VolTable:
    """Return the table with the numbers in its file: lengths in mm or inch (the fields keep their names)."""
    return table.scaled(1.0 / MM_PER_UNIT[table.unit])


def as_written(table: VolTable) -> VolTable:
    """Return the table as read back from its text, in mm."""
    inside, places = in_file_units(table), position_digits(table)
    curves = tuple(
        replace(
            curve,
            first_mm=float(fixed(curve.first_mm, places)),
            step_mm=float(fixed(curve.step_mm, places)),
            values=rounded(curve.values, digits_of(table, curve)),
        )
        for curve in inside.curves
    )
    grid = inside.grid
    if grid is not None:
        x, y, z = (float(fixed(value, places)) for value in grid.first_mm)
        hx, hy, hz = (float(fixed(value, places)) for value in grid.step_mm)
        grid = VolGrid((x, y, z), (hx, hy, hz), rounded(grid.vertices_mm, length_digits(table)))
    return replace(inside, curves=curves, grid=grid).scaled(MM_PER_UNIT[table.unit])


def words_of(table: VolTable) -> Iterator[str]:
    """Yield the words of the table from ``volcomp`` to ``end``, for its checksum."""
    inside, places = in_file_units(table), position_digits(table)
    yield from ("volcomp", "1", "unit", table.unit)
    for curve in inside.curves:
        yield from ("curve", curve.name, str(curve.axis), str(len(curve.values)))
        yield from (fixed(curve.first_mm, places), fixed(curve.step_mm, places))
        yield from (fixed(value, digits_of(table, curve)) for value in curve.values.tolist())
    for term in inside.terms:
        yield from ("term", str(term.output), term.curve, fixed(term.coefficient, 0), term.lever)
    if inside.grid is not None:
        yield from ("grid", *(str(count) for count in inside.grid.vertices_mm.shape[:3]))
        yield from (fixed(value, places) for value in (*inside.grid.first_mm, *inside.grid.step_mm))
        for row in grid_rows(inside.grid):
            yield from (fixed(value, length_digits(table)) for value in row)
    yield "end"


def grid_rows(grid: VolGrid) -> list[list[float]]:
    """Return ex, ey, ez of every vertex, x fastest."""
    rows: list[list[float]] = grid.vertices_mm.transpose(2, 1, 0, 3).reshape(-1, 3).tolist()
    return rows


def is_companion(source: SourceFile) -> bool:
    """Whether a file is one of those exported with the table, judged by its name."""
    return source.path.suffix.lower() in COMPANIONS or source.path.name.endswith(LICENCE)


def check_companion(source: SourceFile) -> None:
    """Raise InputError if INI, HAL, C source or licence text lacks its last line: it is truncated."""
    last = source.text.rstrip().rpartition("\n")[2]
    whole = (
        last == _LICENCE_ENDS if source.path.name.endswith(LICENCE) else last.startswith(("# end of ", "// end of "))
    )
    if not whole or not source.text.endswith("\n"):
        raise source.fail(
            "does not end with its last line ('... end of ...'): the file is truncated", source.text.count("\n") + 1
        )


# Information for the user of a ``volkins`` table, and what its template needs.


#: Decimals of travel limits in the INI file.
LIMIT_DIGITS = 6


def shown_table(table: VolTable) -> dict[str, Any]:
    """Return the table in plain numbers for its template, with the checksum."""
    inside = in_file_units(table)
    grid = inside.grid
    return {
        "unit": table.unit,
        "position_digits": position_digits(table),
        "curves": [
            {
                "name": curve.name,
                "axis": curve.axis,
                "first": curve.first_mm,
                "step": curve.step_mm,
                "digits": digits_of(table, curve),
                "values": curve.values.tolist(),
            }
            for curve in inside.curves
        ],
        "terms": [vars(term) for term in inside.terms],
        "grid": None
        if grid is None
        else {
            "count": list(grid.vertices_mm.shape[:3]),
            "corner": [*grid.first_mm, *grid.step_mm],
            "digits": length_digits(table),
            "rows": grid_rows(grid),
        },
        "crc32": checksum(words_of(table)),
    }


def _outward(range_mm: tuple[float, float], margin_mm: float, scale: float) -> list[float]:
    """Travel limits in machine units, rounded outward to the decimals of the INI file: the ends can be reached."""
    low, high = range_mm
    fine = 10.0**LIMIT_DIGITS
    # a rounding error of the division must not move a limit with few decimals
    below, above = (round(value / scale * fine, 3) for value in (low - margin_mm, high + margin_mm))
    return [float(np.floor(below)) / fine, float(np.ceil(above)) / fine]


def _parameters(gauge_mm: Vector3, coordinates: str, unit: str) -> list[dict[str, str]]:
    joints = ", ".join(f"{joint} is {letter}" for joint, letter in enumerate(coordinates))
    rows = [
        {
            "name": "[KINS] KINEMATICS",
            "value": f"volkins file=volcomp.tab coordinates={coordinates}",
            "meaning": "the table, relative to the folder of the INI file, and the axis of each joint",
        },
        {"name": "[KINS] JOINTS", "value": str(len(coordinates)), "meaning": f"joint {joints}"},
        {
            "name": "[TRAJ] LINEAR_UNITS",
            "value": unit,
            "meaning": "unit of all numbers in the exported files; on a machine in another unit volkins.loaded stays false",
        },
        {
            "name": "volkins.loaded",
            "value": "true",
            "meaning": "belongs in the e-stop chain (volkins.hal): false means that nothing is compensated",
        },
    ]
    rows += [
        {
            "name": f"volkins.gauge-{letter.lower()}",
            "value": f"{value / MM_PER_UNIT[unit]:.9g} {unit}",
            "meaning": "tool offset of the error model when the control's tool offset is zero",
        }
        for letter, value in zip(AXES, gauge_mm, strict=True)
    ]
    return rows


# LinuxCNC volumetric compensation: the table of the kinematics module ``volkins``, which comes with compgen.
#
# The module (``templates/linuxcnc-volumetric/``, GPL-2.0-or-later) evaluates E = C P, or a grid, in every servo cycle, and
# takes the tool offset from the control. Its arithmetic is the same as in :mod:`compgen.controls.linuxcnc_volumetric`.


#: Values of a grid have the digits of lengths; eight of them and the rounding of all curves of one axis.
_ROUNDED_CURVES = 12
#: Vertices of a grid along one axis: 46 x 46 x 46 is within the limit of the module.
MOST_ALONG_AXIS = 46
#: Axes and joints known to LinuxCNC.
_AXIS_LETTERS, _MOST_JOINTS = "XYZABCUVW", 16
#: A table whose errors change by more than this per mm of travel is rejected; real machines stay below 0.01.
STEEPEST = 0.5


@toml_files.accepts({"type": "string", "pattern": f"^[{_AXIS_LETTERS}{_AXIS_LETTERS.lower()}]{{3,{_MOST_JOINTS}}}$"})
def _coordinates(value: Any) -> str:
    """One letter of an axis for each joint, including X, Y and Z."""
    letters = str(value).upper() if isinstance(value, str) else ""
    if set(letters) - set(_AXIS_LETTERS) or not set(AXES) <= set(letters) or len(letters) > _MOST_JOINTS:
        raise ValueError(
            f"expected one axis letter for each of at most {_MOST_JOINTS} joints, including X, Y and Z, e.g. 'XYZA'"
        )
    return letters


@dataclass(frozen=True)
class VolumetricSettings:
    """Settings ``[controllers.linuxcnc-volumetric]``.

    A grid is valid only for the tool offset of the machine file. ``gauge_mm`` sets the pins ``volkins.gauge-*``.
    """

    form: str = setting(
        choice("curves", "grid"),
        "curves",
        meaning='"curves": E = C P with the tool in use; "grid": for the tool offset of the machine file only',
    )
    loss_mm: float = loss_setting()
    most_nodes: int = setting(whole(2, 1000), 400, meaning="largest number of nodes per axis (a grid has at most 46)")
    gauge_mm: tuple[float, float, float] = setting(
        toml_files.vector3,
        (0.0, 0.0, 0.0),
        meaning="tool offset of the error model when the control's tool offset is zero",
    )
    machine_units: str = units_setting(
        "[TRAJ] LINEAR_UNITS, mm or inch: the unit of all exported numbers; the module refuses a table in another unit"
    )
    coordinates: str = setting(
        _coordinates,
        "XYZ",
        meaning="axis of each joint from joint 0 on, as in trivkins coordinates=XYYZA; axes other than X, Y, Z pass unchanged",
    )


class LinuxcncVolumetric(Controller[VolumetricSettings, VolTable]):
    """``linuxcnc-volumetric``: all 21 errors on all 24 chains, for the current tool."""

    name = "linuxcnc-volumetric"
    settings_class = VolumetricSettings
    at_axes = True

    @classmethod
    def check_settings(
        cls, settings: VolumetricSettings, section: toml_files.Section, machine: Machine
    ) -> VolumetricSettings:
        """Take the unit of the machine, unless the section states it."""
        return with_units(settings, section, machine)

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return one term per error on equidistant nodes; the module evaluates E = C P; a grid also fits products."""
        settings = self.settings
        nodes = [
            equidistant_grid(
                self.machine,
                errors,
                axis,
                most=settings.most_nodes if settings.form == "curves" else min(settings.most_nodes, MOST_ALONG_AXIS),
                loss_mm=settings.loss_mm,
                products=settings.form == "grid",
            ).nodes_mm
            for axis in range(3)
        ]
        return error_terms(self.machine, errors, nodes)

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> VolTable:
        """Return curves and terms, or the grid made from them, rounded as written."""
        ordered = sorted(basis, key=lambda term: ERROR_INDEX[term.name])
        curves = []
        for term in ordered:
            axis, nodes, found = term.axis, term.nodes_mm, np.asarray(values[term.name])
            if axis is None:  # squareness is a constant: two equal nodes at the ends of the travel of its axis
                axis = AXES.index(term.name[-1])
                nodes, found = np.array(self.machine.axes[axis].range_mm), np.repeat(found[0], 2)
            curves.append(VolCurve(term.name, axis, float(nodes[0]), float(nodes[1] - nodes[0]), found))
        terms = tuple(
            VolTerm(part.output, term.name, float(-part.sign), LEVERS[0 if part.lever is None else part.lever + 1])
            for term in ordered
            for part in term.carrier
        )
        table = as_written(VolTable(tuple(curves), terms, unit=self.settings.machine_units))
        if self.settings.form == "curves":
            return table
        # the errors of the curves at the vertices of the grid of their nodes, with the tool offset of the machine file
        lines = []
        for axis in range(3):
            moving = [curve for curve in table.curves if curve.axis == axis and not re.match("E[ABC]0", curve.name)]
            lines.append(moving[0].nodes_mm if moving else np.array(self.machine.axes[axis].range_mm))
        vertices = np.array(list(product(*lines)))
        errors = table.error(vertices, tool_of(self.machine, None)).reshape(*(len(line) for line in lines), 3)
        x, y, z = ((float(line[0]), float(line[1] - line[0])) for line in lines)
        return as_written(VolTable((), (), VolGrid((x[0], y[0], z[0]), (x[1], y[1], z[1]), errors), table.unit))

    def context(self, tables: VolTable) -> dict[str, Any]:
        """Return curves, terms or grid as written, the checksum, and what INI and HAL need."""
        return {**shown_table(tables), **self._notes(self.settings.gauge_mm, self.settings.coordinates, tables)}

    def parse(self, files: Sequence[SourceFile]) -> VolTable:
        """Read the table; INI, HAL and C sources exported with it are only checked for their last line."""
        tables = [source for source in files if not is_companion(source)]
        for source in files:
            if is_companion(source):
                check_companion(source)
        if not tables:
            raise InputError("no table was given; expected volcomp.tab")
        if len(tables) > 1:
            raise tables[1].fail(f"is a second table; the first is {tables[0].path.name}, and volkins reads only one")
        return parse_volcomp(tables[0])

    def emulate(self, tables: VolTable, points: Points) -> FloatArray:
        """Return q - P, with q the axis positions that put the tip at the command P for the points' tool offset."""
        tool = tool_of(self.machine, points.tool_mm)
        return tables.inverse(points.position_mm, tool) - points.position_mm

    def violations(self, tables: VolTable) -> list[str]:
        """Return travel not covered by curves, errors too steep for the inverse, and a unit unlike the machine's."""
        machine, settings = self.machine, self.settings
        found = []
        if tables.unit != settings.machine_units:
            found.append(
                f"the table is in {tables.unit}, but machine_units is {settings.machine_units!r}: the control does not use "
                "such a table, and the machine cannot be switched on"
            )
        for axis, first, last, what in _spans(tables):
            found += coverage_violations(machine, axis, first, last, what)
        slope = tables.slope(machine.lower_mm, machine.upper_mm, tool_of(machine, None))
        if slope > STEEPEST:
            found.append(f"the errors change by up to {slope:.2f} mm per mm of travel; {STEEPEST} is the limit")
        return found

    def resolution_mm(self) -> float:
        """Half of the last decimal of every curve; angles with levers of up to 10 m."""
        return _ROUNDED_CURVES * 0.5 * (10.0**-LENGTH_DIGITS + 1e4 * 10.0**-ANGLE_DIGITS)

    def table_nodes_mm(self, tables: VolTable) -> tuple[FloatArray, ...]:
        """Return the nodes of curves or grid; a constant has none."""
        if tables.grid is not None:
            return nodes_by_axis(enumerate(_grid_lines(tables.grid)))
        return nodes_by_axis((curve.axis, curve.nodes_mm) for curve in tables.curves if np.ptp(curve.values) > 0)

    def usage(self, tables: VolTable) -> list[Usage]:
        """Return curves, terms and nodes, or vertices, against the limits of the module."""
        if tables.grid is not None:
            return [Usage("vertices", tables.grid.vertices_mm[..., 0].size, MOST_VERTICES, "vertices")]
        nodes = max(len(curve.values) for curve in tables.curves)
        return [
            Usage("curves", len(tables.curves), MOST_CURVES, "curves"),
            Usage("terms", len(tables.terms), MOST_TERMS, "terms"),
            Usage("nodes of a curve", nodes, MOST_NODES, "nodes"),
        ]

    def _notes(self, gauge_mm: Vector3, coordinates: str, table: VolTable) -> dict[str, Any]:
        """Return sign statement, parameters, warnings; travel, tool, joints for INI and HAL in machine units."""
        tool = np.array(gauge_mm) - np.array(self.machine.tool_offset_mm)
        scale = MM_PER_UNIT[table.unit]
        margin_mm = float(np.ceil(2.0 * np.max(np.abs(self._at_corners(table)[1])))) or 1.0
        axes = [
            {
                "letter": letter,
                "joint": coordinates.index(letter),
                "joints": [joint for joint, other in enumerate(coordinates) if other == letter],
                "gauge": gauge / scale,
                "limits": _outward(axis.range_mm, 0.0, scale),
                "joint_limits": _outward(axis.range_mm, margin_mm, scale),
            }
            for letter, gauge, axis in zip(AXES, gauge_mm, self.machine.axes, strict=True)
        ]
        return {
            "sign_statement": self._sign_statement(table),
            "parameters": _parameters(gauge_mm, coordinates, table.unit),
            "warnings": self._warnings(table),
            "tables": [],
            "control_tool_mm": tool.tolist(),
            "coordinates": coordinates,
            "axes": axes,
            "gantry": len({coordinates.count(letter) for letter in AXES}) > 1,
            "other_axes": sorted(set(coordinates) - set(AXES)),
            "margin_mm": margin_mm,
            "form": "curves" if table.grid is None else "grid",
        }

    def _at_corners(self, table: VolTable) -> tuple[FloatArray, FloatArray]:
        """Corners, mid-points and centre of the volume (27, 3) and the errors there, mm."""
        lines = [
            np.array([low, 0.5 * (low + high), high]) for low, high in (axis.range_mm for axis in self.machine.axes)
        ]
        points = full_grid(lines).reshape(-1, 3)
        return points, table.error(points, tool_of(self.machine, None))

    def _sign_statement(self, table: VolTable) -> str:
        """Return the sign in words, with the axis and corner of the largest error in the table."""
        points, error = self._at_corners(table)
        place, axis = divmod(int(np.argmax(np.abs(error))), 3)
        x, y, z = points[place]
        return (
            "The table contains ERRORS (actual minus commanded, ISO 230-1); volkins sends the axes to q = P - E(q). With the "
            f"axes at X {x:g} Y {y:g} Z {z:g} the error of {AXES[axis]} is {error[place, axis]:+.6f} mm, and the joint position "
            f"differs from the displayed position by {-error[place, axis]:+.6f} mm."
        )

    def _warnings(self, table: VolTable) -> list[str]:
        tool = tool_of(self.machine, None)
        at_home = table.error(np.zeros((1, 3)), tool)[0]
        found = []
        if np.max(np.abs(at_home)) > 1e-6:
            shown = ", ".join(f"{letter} {value:+.6f}" for letter, value in zip(AXES, at_home, strict=True))
            found.append(
                f"With the axes at 0 the tool is at {shown} mm: after homing there the display shows these numbers, not 0."
            )
        if table.grid is not None:
            found.append("A grid is made for one tool offset: with another tool, use form = 'curves'.")
        return found


def _grid_lines(grid: VolGrid) -> list[FloatArray]:
    counts = grid.vertices_mm.shape[:3]
    return [
        np.asarray(first + step * np.arange(count), dtype=np.float64)
        for first, step, count in zip(grid.first_mm, grid.step_mm, counts, strict=True)
    ]


def _spans(tables: VolTable) -> list[tuple[int, float, float, str]]:
    """Return (axis, first, last, what) for everything that depends on an axis."""
    if tables.grid is not None:
        lines = enumerate(_grid_lines(tables.grid))
        return [(axis, float(line[0]), float(line[-1]), "the grid") for axis, line in lines]
    return [
        (curve.axis, float(curve.nodes_mm[0]), float(curve.nodes_mm[-1]), f"the curve {curve.name}")
        for curve in tables.curves
        if np.ptp(curve.values) > 0
    ]
