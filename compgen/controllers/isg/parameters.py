"""Error parameters of the ISG kernel's volumetric compensation: names, grids and strict numbers of both file formats.

Source: ISG kernel help "List of parameters supported" (page 296423819), "Units of measure" (296426379). Lengths are
mm, angles rad, arguments of linear axes mm.
"""

from __future__ import annotations

import itertools
import math
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from compgen.controllers.base import SourceFile
from compgen.core.csvio import FloatArray
from compgen.core.names import ERROR_NAMES, SQUARENESS_NAMES
from compgen.core.text import nearest, one_line
from compgen.errors import CompgenWarning, InputError

#: Errors by the control's name (position errors have no leading E): ``"C0Y"`` -> ``"EC0Y"``, ``"EXX"`` -> ``"EXX"``.
ISO_NAMES: dict[str, str] = {(name[1:] if name in SQUARENESS_NAMES else name): name for name in ERROR_NAMES}
CONTROL_NAMES: dict[str, str] = {iso: control for control, iso in ISO_NAMES.items()}

#: Constants of the control that are no errors: tool position at machine zero (mm), logical axis numbers.
TOOL_NAMES = ("P0X", "P0Y", "P0Z")
LOGICAL_NAMES = ("LNX", "LNY", "LNZ")
ARGUMENTS = "XYZ"

_LETTERS = "XYZABC"
_PAIRS = tuple("".join(pair) for pair in itertools.product(_LETTERS, _LETTERS))
_ORIENTATION_NAMES = ("N0X", "N0Y", "N0Z")
#: Every parameter name that the control's documents list.
KNOWN_NAMES: frozenset[str] = frozenset(
    [
        *(f"{pair[0]}0{pair[1]}" for pair in _PAIRS),
        *(f"E{pair}" for pair in _PAIRS),
        *(f"V{a}{b}" for a in "XYZ" for b in _LETTERS),
        *(f"P{a}{b}" for a in "XYZ" for b in "ABC"),
        *(f"{head}{axis}" for head in ("ID", "LN") for axis in _LETTERS),
        *TOOL_NAMES,
        *_ORIENTATION_NAMES,
    ]
)

MOST_LINES = 200_000
MOST_CHARACTERS = 4_000
_NUMBER = re.compile(r"[+-]?(?:[0-9]{1,40}(?:\.[0-9]{0,40})?|\.[0-9]{1,40})(?:[eE][+-]?[0-9]{1,3})?")
_DECLARED = re.compile(r"(?://|#)\s{0,9}(?:records|entries):\s{0,9}([0-9]{1,9})\s*$")


@dataclass(frozen=True)
class Field:
    """One parameter over a grid of axis positions, linear between nodes, end values held outside.

    Parameters
    ----------
    axes : the arguments, 0..2 for X, Y, Z; empty for a constant.
    nodes_mm : ascending positions, one array per argument.
    values : mm or rad, one dimension per argument.
    """

    axes: tuple[int, ...]
    nodes_mm: tuple[FloatArray, ...]
    values: FloatArray

    def at(self, position_mm: FloatArray) -> FloatArray:
        """Value at axis positions (n, 3), shape (n,): multilinear between the 2^k nodes around each position."""
        result = np.zeros(len(position_mm))
        cells = [_cell(nodes, position_mm[:, axis]) for axis, nodes in zip(self.axes, self.nodes_mm, strict=True)]
        for corner in itertools.product((0, 1), repeat=len(cells)):
            weight = np.ones(len(position_mm))
            for side, (_, _, share) in zip(corner, cells, strict=True):
                weight = weight * (share if side else 1.0 - share)
            index = tuple(cell[side] for side, cell in zip(corner, cells, strict=True))
            result += weight * self.values[index]
        return result


def _cell(nodes_mm: FloatArray, along_mm: FloatArray) -> tuple[np.ndarray, np.ndarray, FloatArray]:
    """Index of the node before and after each position, and the share of the one after; clamped outside."""
    if len(nodes_mm) == 1:
        zero = np.zeros(len(along_mm), dtype=np.intp)
        return zero, zero, np.zeros(len(along_mm))
    before = np.clip(np.searchsorted(nodes_mm, along_mm, side="right") - 1, 0, len(nodes_mm) - 2)
    share = (along_mm - nodes_mm[before]) / (nodes_mm[before + 1] - nodes_mm[before])
    return before, before + 1, np.clip(share, 0.0, 1.0)


@dataclass(frozen=True)
class Parameter:
    """One parameter as a file has it, with the place where it stands; ``name`` is the control's."""

    name: str
    field: Field
    source: SourceFile
    line: int


@dataclass(frozen=True)
class ParameterFile:
    """What one error-parameter file holds; ``records`` counts its rows of numbers."""

    parameters: tuple[Parameter, ...]
    records: int
    exponent_line: int | None = None


def content_lines(source: SourceFile, comment: str = "//") -> list[tuple[int, str]]:
    """Return the lines of a file without comments and blank lines, with their numbers; InputError for garbage."""
    count = source.text.count("\n")
    if count > MOST_LINES:
        raise source.fail(f"has {count} lines; at most {MOST_LINES} are read", MOST_LINES)
    found = []
    for number, line in enumerate(source.text.split("\n"), start=1):
        if len(line) > MOST_CHARACTERS:
            raise source.fail(f"the line has {len(line)} characters; at most {MOST_CHARACTERS} are read", number)
        text = line.partition(comment)[0].strip(" \t\r\f")
        if not (text.isascii() and text.replace("\t", " ").isprintable()):
            raise source.fail(f"{one_line(text)[:40]!r} holds characters that are not printable ASCII", number)
        if text:
            found.append((number, text))
    if not found:
        raise source.fail("holds no data; is it the right file, or was it cut?")
    return found


def number(source: SourceFile, line: int, word: str, what: str) -> float:
    """Return ``word`` as a finite number or raise the InputError that says why it is none."""
    if not _NUMBER.fullmatch(word) or not math.isfinite(float(word)):
        hint = "; the decimal point is '.', columns are separated by white space" if "," in word or ";" in word else ""
        raise source.fail(f"{what}: {word[:40]!r} is not a finite number{hint}", line)
    return float(word)


def uses_exponent(words: Iterable[str]) -> bool:
    """Whether one of the numbers is written with an exponent, which no published example of the control shows."""
    return any("e" in word or "E" in word for word in words)


def grid_order(
    source: SourceFile, lines: list[int], arguments: list[FloatArray]
) -> tuple[tuple[FloatArray, ...], np.ndarray]:
    """Return the nodes (ascending) of each argument, and the order that sorts the rows into the grid's C order.

    Raises InputError with the line for a position that stands twice, and if positions of the grid are missing.
    """
    if not arguments:
        if len(lines) > 1:
            raise source.fail("a second row without an argument column: one row of constants is due", lines[1])
        return (), np.zeros(1, dtype=np.intp)
    nodes = tuple(np.unique(column) for column in arguments)
    shape = tuple(len(line) for line in nodes)
    cells = np.ravel_multi_index([np.searchsorted(*pair) for pair in zip(nodes, arguments, strict=True)], shape)
    order = np.argsort(cells, kind="stable")
    repeated = np.flatnonzero(np.diff(cells[order]) == 0)
    if repeated.size:
        row = int(order[repeated[0] + 1])
        raise source.fail(f"the position {[float(column[row]) for column in arguments]} stands here again", lines[row])
    if len(lines) != int(np.prod(shape)):
        sizes = " x ".join(map(str, shape))
        message = f"{len(lines)} rows do not fill the grid of {sizes} positions that their arguments name"
        raise source.fail(f"{message}; interpolation GRID needs every combination once", lines[-1])
    return nodes, order


def check_complete(source: SourceFile, count: int, what: str = "records") -> None:
    """Refuse a cut file: one that declares its ``records`` in a comment must hold them and end with a line end."""
    declared = next((found for line in source.text.split("\n") if (found := _DECLARED.match(line[:200].strip()))), None)
    if declared is None:
        return
    if int(declared.group(1)) != count:
        raise source.fail(f"declares {declared.group(1)} {what} but holds {count}: it was cut or edited by hand")
    if not source.text.endswith("\n"):
        raise source.fail("the last line has no line end: the file was cut", source.text.count("\n") + 1)


def check_name(source: SourceFile, line: int, name: str) -> None:
    """Refuse a name that is neither an argument nor a parameter of the control (its error 70468)."""
    if name not in KNOWN_NAMES and name not in _LETTERS:
        hint = nearest(name[:20], [*ISO_NAMES, *TOOL_NAMES, *ARGUMENTS])
        raise source.fail(
            f"{name[:40]!r} is not a parameter or argument of the control (its error 70468); {hint}", line
        )


def is_rotary(name: str) -> bool:
    """Whether a parameter belongs to a rotary axis."""
    return name[-1] in "ABC"


def collect(parameters: Sequence[Parameter]) -> tuple[dict[str, Field], dict[str, float]]:
    """Return the fields by ISO name and the other constants by the control's name.

    Each parameter may stand once, over all files. Parameters of rotary axes are left out with a warning; others that
    the model of three linear axes does not have must be zero.
    """
    seen: dict[str, Parameter] = {}
    for item in parameters:
        if item.name in seen:
            first = seen[item.name]
            message = f"{item.name} stands here a second time; the first is in {first.source.path.name}:{first.line}"
            raise item.source.fail(f"{message}, and what the control does then is not documented", item.line)
        seen[item.name] = item
    fields = {ISO_NAMES[name]: item.field for name, item in seen.items() if name in ISO_NAMES}
    constants = {name: _constant(item) for name, item in seen.items() if name in (*TOOL_NAMES, *LOGICAL_NAMES)}
    _check_rest({name: item for name, item in seen.items() if name not in ISO_NAMES and name not in constants})
    if not fields:
        raise parameters[0].source.fail("holds none of the 21 errors of three linear axes", parameters[0].line)
    return {name: fields[name] for name in ERROR_NAMES if name in fields}, constants


def _constant(item: Parameter) -> float:
    if item.field.axes:
        raise item.source.fail(f"{item.name} is a constant; it takes no argument", item.line)
    return float(item.field.values)


def _check_rest(rest: Mapping[str, Parameter]) -> None:
    rotary = [name for name in rest if is_rotary(name)]
    if rotary:
        source = rest[rotary[0]].source.path
        listed = ", ".join(rotary)
        warnings.warn(
            f"{source}: {listed} belong to rotary axes and are left out; the model has three linear axes",
            CompgenWarning,
            stacklevel=2,
        )
    for name, item in rest.items():
        if name not in rotary and name not in _ORIENTATION_NAMES and np.any(item.field.values != 0.0):
            raise _unmodelled(item)


def _unmodelled(item: Parameter) -> InputError:
    return item.source.fail(
        f"{item.name} is not zero, but the model has only {', '.join(ISO_NAMES)}; express it by these", item.line
    )
