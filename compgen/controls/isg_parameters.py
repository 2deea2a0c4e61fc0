"""Error parameters and list file of the ISG kernel's volumetric compensation, read strictly from text."""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeVar

import numpy as np

from compgen.controls.shared.base import SourceFile
from compgen.controls.shared.grids import ParameterGrid
from compgen.controls.shared.scanner import check_complete, content_lines
from compgen.data.machine import Chain
from compgen.data.messages import nearest
from compgen.data.names import ERROR_NAMES, SQUARENESS_NAMES
from compgen.data.toml_files import choice
from compgen.errors import CompgenWarning

# Error parameters of the ISG kernel's volumetric compensation: names, grids and strict numbers of both file formats.
#
# Source: ISG kernel help "List of parameters supported" (page 296423819), "Units of measure" (296426379). Lengths are
# mm, angles rad, arguments of linear axes mm.


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


@dataclass(frozen=True)
class ErrorParameter:
    """One parameter as a file has it, with its place; ``name`` is the control's."""

    name: str
    field: ParameterGrid
    source: SourceFile
    line: int


@dataclass(frozen=True)
class ParameterFile:
    """What one error-parameter file holds; ``records`` counts its rows of numbers."""

    parameters: tuple[ErrorParameter, ...]
    records: int
    exponent_line: int | None = None


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


def collect(parameters: Sequence[ErrorParameter]) -> tuple[dict[str, ParameterGrid], dict[str, float]]:
    """Return the fields by ISO name and the other constants by the control's name.

    Each parameter may be given once, over all files. Parameters of rotary axes are left out with a warning; others that
    the model of three linear axes does not have must be zero.
    """
    seen: dict[str, ErrorParameter] = {}
    for item in parameters:
        if item.name in seen:
            first = seen[item.name]
            message = f"{item.name} is given a second time; the first is in {first.source.path.name}:{first.line}"
            raise item.source.fail(f"{message}, and what the control does then is not documented", item.line)
        seen[item.name] = item
    fields = {ISO_NAMES[name]: item.field for name, item in seen.items() if name in ISO_NAMES}
    constants = {name: _constant(item) for name, item in seen.items() if name in (*TOOL_NAMES, *LOGICAL_NAMES)}
    rest = {name: item for name, item in seen.items() if name not in ISO_NAMES and name not in constants}
    if rotary := [name for name in rest if is_rotary(name)]:
        source, listed = rest[rotary[0]].source.path, ", ".join(rotary)
        message = f"{source}: {listed} belong to rotary axes and are left out; the model has three linear axes"
        warnings.warn(message, CompgenWarning, stacklevel=2)
    for name, item in rest.items():
        if name not in rotary and name not in _ORIENTATION_NAMES and np.any(item.field.values != 0.0):
            message = f"{item.name} is not zero, but the model has only {', '.join(ISO_NAMES)}; express it by these"
            raise item.source.fail(message, item.line)
    if not fields:
        raise parameters[0].source.fail("holds none of the 21 errors of three linear axes", parameters[0].line)
    return {name: fields[name] for name in ERROR_NAMES if name in fields}, constants


def _constant(item: ErrorParameter) -> float:
    if item.field.axes:
        raise item.source.fail(f"{item.name} is a constant; it takes no argument", item.line)
    return float(item.field.values)


# The list file (``volcomp0.lis``) that configures one volumetric compensation of the ISG kernel.
#
# One ``name value`` a line, ``#`` starts a comment. Source: ISG kernel help "Overview of compensation parameters"
# (563009163), "Number of workpiece axes" (P-VOLC-00008, 106014347), Beckhoff TF5280 "Updating" (1218769547).


Direction = Literal["workpiece_to_tool", "tool_to_workpiece"]
T = TypeVar("T")

#: Keys that the emulator acts on, and those that change nothing for three linear axes at rest.
_ACTING = ("x", "y", "z", "chain", "workpiece_axes", "negate", "set_to_zero", "interpolation", "use_axis_offsets")
_INERT = (
    "a", "b", "c", "alternative_model", "enable_splicing", "diagnosis_file", "manual_activation", "filter_steps",
    "associate_to_channel",
)  # fmt: skip
_INDEXED = re.compile(r"(file|file_format)\[([0-9]{1,3})\]")


@dataclass(frozen=True)
class ListFile:
    """One list file; ``files`` and ``formats`` by their index, ``negate`` and ``set_to_zero`` as letters of XYZ.

    ``chain`` holds X, Y and Z in the order of the control, ``workpiece_axes`` how many of them carry the workpiece;
    the defaults are the control's.
    """

    logical_axes: tuple[int | None, int | None, int | None] = (None, None, None)
    chain: str = "XYZ"
    workpiece_axes: int = 0
    negate: str = ""
    set_to_zero: str = ""
    interpolation: str = "GRID"
    use_axis_offsets: int = 0
    files: Mapping[int, str] = field(default_factory=dict)
    formats: Mapping[int, str] = field(default_factory=dict)


def chain_text(chain: Chain, direction: Direction) -> str:
    """Return the axes of a chain in the order in which the control reads them."""
    order = "".join(letter for letter in chain.name if letter in "XYZ")
    return order if direction == "workpiece_to_tool" else order[::-1]


def chain_of(listing: ListFile, direction: Direction) -> Chain:
    """Return the chain that a list file means."""
    order = listing.chain if direction == "workpiece_to_tool" else listing.chain[::-1]
    return Chain(f"W{order[: listing.workpiece_axes]}F{order[listing.workpiece_axes :]}T")


def base_name(path: str) -> str:
    """Return the file name at the end of a path of the control (either kind of slash)."""
    return path.replace("\\", "/").rpartition("/")[2]


def is_list_file(source: SourceFile) -> bool:
    """Whether a file is a list file: by its suffix, else by its first line, which then is one key and one value."""
    if source.path.suffix.lower() in (".lis", ".csv"):
        return source.path.suffix.lower() == ".lis"
    for line in source.text[:20_000].split("\n"):
        words = line.partition("#")[0].split()
        if words and not words[0].startswith("//"):
            key = words[0].lower()
            if key in (*_ACTING, *_INERT) or _INDEXED.fullmatch(key):
                return len(words) == 2 and (len(key) > 1 or words[1].isdigit())
            return False
    return False


def parse_list(source: SourceFile) -> ListFile:
    """Read a list file; InputError with the line for an unknown or doubled key and for a wrong value."""
    entries = _entries(source)
    check_complete(source, len(entries), "entries")
    files = {int(key[5:-1]): value for key, (value, _) in entries.items() if key.startswith("file[")}
    formats = {int(key[12:-1]): value.upper() for key, (value, _) in entries.items() if key.startswith("file_format[")}
    if not files:
        raise source.fail("names no parameter file: file[0] is missing; was the list cut?")
    known = choice("GRID", "AUTO")  # other modes interpolate in a way that is not documented in public
    axes = tuple(_take(source, entries, letter, _whole(1, 65535), None) for letter in "xyz")
    return ListFile(
        logical_axes=(axes[0], axes[1], axes[2]),
        chain=_take(source, entries, "chain", choice(*map("".join, itertools.permutations("XYZ"))), "XYZ"),
        workpiece_axes=_take(source, entries, "workpiece_axes", _whole(0, 3), 0),
        negate=_take(source, entries, "negate", axis_letters, ""),
        set_to_zero=_take(source, entries, "set_to_zero", axis_letters, ""),
        interpolation=_take(source, entries, "interpolation", lambda word: known(word.upper()), "GRID"),
        use_axis_offsets=_take(source, entries, "use_axis_offsets", _whole(0, 1), 0),
        files=files,
        formats=formats,
    )


def _entries(source: SourceFile) -> dict[str, tuple[str, int]]:
    """Values and lines by key in lower case (the published examples differ in case)."""
    entries: dict[str, tuple[str, int]] = {}
    for line, text in content_lines(source, "#"):
        key, *value = text.split(maxsplit=1)
        name = key.lower()
        if name not in (*_ACTING, *_INERT) and not _INDEXED.fullmatch(name):
            known = (*_ACTING, *_INERT, "file[0]", "file_format[0]")
            raise source.fail(f"{key[:40]!r} is not a key of the list file; {nearest(name[:20], known)}", line)
        if name in entries:
            raise source.fail(f"{key} is given a second time; the first is in line {entries[name][1]}", line)
        if not value:
            raise source.fail(f"{key} has no value", line)
        entries[name] = (value[0], line)
    return entries


def _take(
    source: SourceFile, entries: Mapping[str, tuple[str, int]], key: str, check: Callable[[str], T], default: T
) -> T:
    if key not in entries:
        return default
    value, line = entries[key]
    try:
        return check(value)
    except ValueError as error:
        raise source.fail(f"{key}: {error}; got {value[:40]!r}", line) from None


def _whole(lowest: int, highest: int) -> Callable[[str], int]:
    def check(value: str) -> int:
        if not re.fullmatch(r"[0-9]{1,6}", value) or not lowest <= int(value) <= highest:
            raise ValueError(f"a whole number from {lowest} to {highest} is expected")
        return int(value)

    return check


def axis_letters(value: object) -> str:
    """Return some of the letters X, Y, Z, each once, in that order; ValueError for anything else."""
    if not isinstance(value, str) or len(set(value)) != len(value) or not set(value) <= set("XYZ"):
        raise ValueError("some of the letters X, Y, Z, each once, are expected")
    return "".join(sorted(value))
