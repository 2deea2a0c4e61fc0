"""Volumetric compensation of the ISG kernel (Beckhoff TwinCAT CNC TF5280): parameters, list file, both file formats."""

from __future__ import annotations

import itertools
import re
import warnings
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from compgen.controls.shared.base import Controller, SourceFile, Term, Usage, coverage_violations, nodes_by_axis
from compgen.controls.shared.grids import Cell, ParameterGrid, grid_order, loss_setting, rounded, uneven_nodes_mm
from compgen.controls.shared.scanner import MOST_LINES, check_complete, content_lines, floating, uses_exponent
from compgen.controls.shared.terms import error_terms
from compgen.data.csv_files import FloatArray, fixed, whole_number
from compgen.data.error_table import Curve, ErrorTable, read_errors
from compgen.data.files import read_text
from compgen.data.lengths import Points
from compgen.data.machine import Chain, Machine
from compgen.data.names import AXES, ERROR_NAMES, SQUARENESS_NAMES, error_named
from compgen.data.toml_files import (
    Section,
    accepts,
    axis_setting,
    choice,
    flag,
    setting,
    unless_stated,
    whole,
)
from compgen.errors import CompgenWarning, InputError, doubled, nearest
from compgen.kinematics.first_order import coefficients
from compgen.kinematics.many_points import full_grid

# Error parameters of the ISG kernel's volumetric compensation: names, grids and number syntax of both file formats.
#
# Source: ISG kernel help "List of parameters supported" (page 296423819), "Units of measure" (296426379). Lengths are
# mm, angles rad, arguments of linear axes mm.


# Strict reader of the error parameters and the list file of the ISG kernel's volumetric compensation.

#: ISO names by the control's name (position errors have no leading E): ``"C0Y"`` -> ``"EC0Y"``, ``"EXX"`` -> ``"EXX"``.
ISO_NAMES: dict[str, str] = {(name[1:] if name in SQUARENESS_NAMES else name): name for name in ERROR_NAMES}
CONTROL_NAMES: dict[str, str] = {iso: control for control, iso in ISO_NAMES.items()}

#: Constants of the control that are not errors: tool position at machine zero (mm), logical axis numbers.
TOOL_NAMES = ("P0X", "P0Y", "P0Z")
LOGICAL_NAMES = ("LNX", "LNY", "LNZ")
ARGUMENTS = "XYZ"

_LETTERS = "XYZABC"
_PAIRS = tuple("".join(pair) for pair in itertools.product(_LETTERS, _LETTERS))
_ORIENTATION_NAMES = ("N0X", "N0Y", "N0Z")
#: Every parameter name listed in the documents of the control.
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
    """One parameter as in the file, with its line; ``name`` is the control's name."""

    name: str
    field: ParameterGrid
    source: SourceFile
    line: int


@dataclass(frozen=True)
class ParameterFile:
    """Contents of one error-parameter file; ``records`` counts its rows of numbers."""

    parameters: tuple[ErrorParameter, ...]
    records: int
    exponent_line: int | None = None


def check_name(source: SourceFile, line: int, name: str) -> None:
    """Refuse a name that is neither an argument nor a parameter of the control (error 70468 on the control)."""
    if name not in KNOWN_NAMES and name not in _LETTERS:
        hint = nearest(name[:20], [*ISO_NAMES, *TOOL_NAMES, *ARGUMENTS])
        raise source.fail(
            f"{name[:40]!r} is not a parameter or argument of the control (error 70468 on the control); {hint}", line
        )


def is_rotary(name: str) -> bool:
    """Whether a parameter belongs to a rotary axis."""
    return name[-1] in "ABC"


def collect(parameters: Sequence[ErrorParameter]) -> tuple[dict[str, ParameterGrid], dict[str, float]]:
    """Return the fields by ISO name and the other constants by the control's name.

    Each parameter may be given only once in all files. Parameters of rotary axes are left out with a warning; other
    parameters that are not in the model of three linear axes must be zero.
    """
    seen: dict[str, ErrorParameter] = {}
    for item in parameters:
        if item.name in seen:
            first = seen[item.name]
            message = f"{item.name} is given a second time; the first is in {first.source.path.name}:{first.line}"
            raise item.source.fail(f"{message}. What the control does then is not documented", item.line)
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
            message = (
                f"{item.name} is not zero, but the model has only {', '.join(ISO_NAMES)}; express it by these errors"
            )
            raise item.source.fail(message, item.line)
    if not fields:
        raise parameters[0].source.fail("contains none of the 21 errors of three linear axes", parameters[0].line)
    return {name: fields[name] for name in ERROR_NAMES if name in fields}, constants


def _constant(item: ErrorParameter) -> float:
    if item.field.axes:
        raise item.source.fail(f"{item.name} is a constant; it takes no argument", item.line)
    return float(item.field.values)


# The list file (``volcomp0.lis``) that configures one volumetric compensation of the ISG kernel.
#
# One ``name value`` per line, ``#`` starts a comment. Source: ISG kernel help "Overview of compensation parameters"
# (563009163), "Number of workpiece axes" (P-VOLC-00008, 106014347), Beckhoff TF5280 "Updating" (1218769547).


Direction = Literal["workpiece_to_tool", "tool_to_workpiece"]
T = TypeVar("T")

#: Keys that the emulator uses, and keys that have no effect for three linear axes at rest.
_ACTING = ("x", "y", "z", "chain", "workpiece_axes", "negate", "set_to_zero", "interpolation", "use_axis_offsets")
_INERT = (
    "a", "b", "c", "alternative_model", "enable_splicing", "diagnosis_file", "manual_activation", "filter_steps",
    "associate_to_channel",
)  # fmt: skip
_INDEXED = re.compile(r"(file|file_format)\[([0-9]{1,3})\]")


@dataclass(frozen=True)
class ListFile:
    """One list file; ``files`` and ``formats`` by index, ``negate`` and ``set_to_zero`` as letters of XYZ.

    ``chain`` lists X, Y and Z in the order of the control, ``workpiece_axes`` is how many of them carry the workpiece;
    the defaults are those of the control.
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
    """Return the axes of a kinematic chain in the order in which the control reads them."""
    order = "".join(letter for letter in chain.name if letter in "XYZ")
    return order if direction == "workpiece_to_tool" else order[::-1]


def chain_of(listing: ListFile, direction: Direction) -> Chain:
    """Return the kinematic chain that a list file describes."""
    order = listing.chain if direction == "workpiece_to_tool" else listing.chain[::-1]
    return Chain(f"W{order[: listing.workpiece_axes]}F{order[listing.workpiece_axes :]}T")


def base_name(path: str) -> str:
    """Return the file name at the end of a path on the control (either kind of slash)."""
    return path.replace("\\", "/").rpartition("/")[2]


def is_list_file(source: SourceFile) -> bool:
    """Whether a file is a list file: by its suffix, else by its first line (one key and one value)."""
    if source.path.suffix.lower() in (".lis", ".csv"):
        return source.path.suffix.lower() == ".lis"
    for line in source.text[:20_000].split("\n"):
        words = line.partition("#")[0].split()
        if words and not words[0].startswith("//"):
            key = words[0].lower()
            if key in (*_ACTING, *_INERT) or _INDEXED.fullmatch(key):
                return len(words) == 2 and (len(key) > 1 or whole_number(words[1]) is not None)
            return False
    return False


def parse_list(source: SourceFile) -> ListFile:
    """Read a list file; InputError with the line for an unknown or repeated key or a wrong value."""
    entries = _entries(source)
    check_complete(source, len(entries), "entries")
    files = {int(key[5:-1]): value for key, (value, _) in entries.items() if key.startswith("file[")}
    formats = {int(key[12:-1]): value.upper() for key, (value, _) in entries.items() if key.startswith("file_format[")}
    if not files:
        raise source.fail("names no parameter file: file[0] is missing; is the list truncated?")
    known = choice("GRID", "AUTO")  # the interpolation of other modes is not publicly documented
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
    """Values and lines by lower-case key (the published examples differ in case)."""
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
            raise ValueError(f"expected a whole number from {lowest} to {highest}")
        return int(value)

    return check


@accepts({"type": "string", "pattern": r"^(?!.*(.).*\1)[XYZ]*$"})
def axis_letters(value: object) -> str:
    """Return the given letters out of X, Y, Z in that order, each at most once; ValueError for anything else."""
    if not isinstance(value, str) or len(set(value)) != len(value) or not set(value) <= set("XYZ"):
        raise ValueError("expected some of the letters X, Y, Z, each at most once")
    return "".join(sorted(value))


# Settings in the machine file for the ISG kernel's volumetric compensation, and what the control has loaded.


@accepts({"type": "string", "maxLength": 200, "pattern": r"^[!-\"$-~]*$"})
def folder_of_control(value: object) -> str:
    """A folder on the control, ending with a slash; empty for none."""
    if not isinstance(value, str) or len(value) > 200 or any(not "!" <= char <= "~" or char == "#" for char in value):
        raise ValueError("expected a folder on the control: printable ASCII without blanks or '#'")
    if not value or value[-1] in "\\/":
        return value
    return value + ("\\" if "\\" in value or ":" in value else "/")


@dataclass(frozen=True)
class IsgSettings:
    """``[controllers.etalon-exchange]`` of a machine file."""

    logical_axes: tuple[int, int, int] = axis_setting(
        whole(1, 65535),
        (1, 2, 3),
        differ="gives ({}) for X, Y, Z; three different numbers are needed",
        meaning="logical axis numbers on the control",
    )
    reversed_axes: str = setting(
        axis_letters,
        "",
        meaning='axes, e.g. "XZ", for which the check at the machine showed that the control adds the error',
    )
    negate: str = setting(axis_letters, "", meaning="axes that the list file negates; default: reversed_axes")
    chain_direction: Direction = setting(
        choice("workpiece_to_tool", "tool_to_workpiece"),
        "workpiece_to_tool",
        meaning="direction in which the control reads chain",
    )
    use_axis_offsets: int = setting(
        whole(0, 1), 0, meaning="value in the list file; 1 is a violation, because its effect is not documented"
    )
    max_records: int = setting(whole(1, MOST_LINES), 2000, meaning="vol_comp[0].max_records of the control")
    path: str = setting(
        folder_of_control, "", meaning="folder of the parameter file on the control, ASCII without blanks"
    )
    write_tool_position: bool = False
    loss_mm: float = loss_setting()


@dataclass(frozen=True)
class IsgCsvSettings(IsgSettings):
    """``[controllers.isg-csv]`` of a machine file: this format can carry the tool position."""

    write_tool_position: bool = setting(flag, False, meaning="write the tool offset as P0X P0Y P0Z")


@dataclass(frozen=True)
class IsgTables:
    """What the control has loaded: errors by ISO name, other constants, and the list file if there is one.

    ``records`` counts the rows of numbers in all ``files`` (names of the parameter files); ``remarks`` are findings
    about syntax that the documents of the control do not cover.
    """

    fields: Mapping[str, ParameterGrid]
    constants: Mapping[str, float]
    records: int
    files: tuple[str, ...]
    listing: ListFile | None = None
    remarks: tuple[str, ...] = ()


# Texts for the people at the machine: meaning of the exported files, and what must be set and checked.


_DIRECTIONS = {
    "workpiece_to_tool": "from the workpiece to the tool",
    "tool_to_workpiece": "from the tool to the workpiece",
}


# Volumetric compensation of the ISG kernel (Beckhoff TwinCAT CNC TF5280): code shared by its two file formats.
#
# The control reads ISO 230 errors and evaluates E = C P itself; it then subtracts the error from the command. The list
# file gives the chain, the axes and the sign. Points that no public document settles are settings here and are noted in
# the files.


LENGTH_DIGITS, ANGLE_DIGITS, POSITION_DIGITS = 9, 12, 6
LIST_NAME = "volcomp0.lis"
MOST_FILES = 10
#: Entries of a list file that the template writes without ``negate``.
LIST_ENTRIES = 9


def rounded_error(name: str, values: FloatArray) -> FloatArray:
    """Return values of an error (ISO name) rounded as written to the file."""
    digits = LENGTH_DIGITS if error_named(name).kind == "linear" else ANGLE_DIGITS
    return rounded(values, digits)


class VolumetricController(Controller[IsgSettings, IsgTables]):
    """The kernel's volumetric compensation; each subclass handles one format of the parameter file.

    ``file_format`` is the control's name for the format, ``parameter_file`` the name of the exported file.
    """

    file_format: str
    parameter_file: str
    settings_class = IsgSettings

    @abstractmethod
    def parse_parameters(self, source: SourceFile) -> ParameterFile:
        """Read one error-parameter file."""

    @abstractmethod
    def count_records(self, fields: Mapping[str, ParameterGrid], constants: Mapping[str, float]) -> int:
        """Return how many rows of numbers the exported file has."""

    @abstractmethod
    def body(self, tables: IsgTables) -> dict[str, Any]:
        """Return the context for the template of the parameter file."""

    @classmethod
    def check_settings(cls, settings: IsgSettings, section: Section, machine: Machine) -> IsgSettings:
        """Let the list file negate the reversed axes, unless the machine file states ``negate``."""
        return unless_stated(settings, section, negate=settings.reversed_axes)

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return one term per error, with nodes where the curves need them; the control evaluates E = C P itself."""
        nodes = [uneven_nodes_mm(self.machine, errors, axis, loss_mm=self.settings.loss_mm) for axis in range(3)]
        return error_terms(self.machine, errors, nodes)

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> IsgTables:
        """Round the errors as written to the file, and add the list file."""
        fields = {}
        for term in sorted(basis, key=lambda term: ERROR_NAMES.index(term.name)):
            numbers = rounded_error(term.name, np.asarray(values[term.name], dtype=np.float64))
            nodes = rounded(term.nodes_mm, POSITION_DIGITS)
            one = ((term.axis,), (nodes,), numbers) if term.axis is not None else ((), (), numbers[0])
            fields[term.name] = ParameterGrid(*one)
        tool = [float(fixed(value, POSITION_DIGITS)) for value in self.machine.tool_offset_mm]
        constants = dict(zip(TOOL_NAMES, tool, strict=True)) if self.settings.write_tool_position and any(tool) else {}
        return IsgTables(
            fields=fields,
            constants=constants,
            records=self.count_records(fields, constants),
            files=(self.parameter_file,),
            listing=self._list_of(self.parameter_file, self.file_format),
        )

    def parse(self, files: Sequence[SourceFile]) -> IsgTables:
        """Read parameter files, and the list file if given, in any order."""
        lists = [source for source in files if is_list_file(source)]
        sources = [source for source in files if source not in lists]
        if len(lists) > 1:
            raise lists[1].fail(
                f"is a second list file; the first is {lists[0].path.name}; give one compensation at a time"
            )
        listing = parse_list(lists[0]) if lists else None
        if not sources:
            raise InputError(
                f"no error-parameter file was given; give {self.parameter_file}, with or without {LIST_NAME}"
            )
        parts = [self.parse_parameters(source) for source in sources]
        fields, constants = collect([item for part in parts for item in part.parameters])
        return IsgTables(
            fields=fields,
            constants=constants,
            records=sum(part.records for part in parts),
            files=tuple(source.path.name for source in sources),
            listing=listing,
            remarks=tuple(
                f"{source.path.name}:{part.exponent_line} has a number with an exponent; no public document says that "
                f"the control accepts this. Write plain decimals"
                for source, part in zip(sources, parts, strict=True)
                if part.exponent_line is not None
            ),
        )

    def emulate(self, tables: IsgTables, points: Points) -> FloatArray:
        """Return minus E = C P of the parsed numbers with the chain of the list file (without one, of the machine).

        The tool offset is that of the points, else P0X, P0Y, P0Z from the file, else that of the machine.
        """
        listing = tables.listing
        chain = self.machine.chain if listing is None else chain_of(listing, self.settings.chain_direction)
        position = np.asarray(points.position_mm, dtype=np.float64)
        tool = points.tool_mm if points.tool_mm is not None else self.tool_of(tables)
        # the error of each axis enters the command with -1, or +1, or 0 (set_to_zero)
        negate = self.settings.negate if listing is None else listing.negate
        blank = "" if listing is None else listing.set_to_zero
        signs = np.array([1.0 if letter in self.settings.reversed_axes else -1.0 for letter in AXES])
        signs[[letter in negate for letter in AXES]] *= -1.0
        signs[[letter in blank for letter in AXES]] = 0.0
        # E = C P (squareness reference X) from the parsed numbers
        cells: dict[tuple[int, bytes], Cell] = {}
        values = {name: item.at(position, cells) for name, item in tables.fields.items()}
        result = np.zeros((3, len(position)))
        levers = [*np.ascontiguousarray(position.T), *np.broadcast_to(tool, position.shape).T]
        for part in coefficients(chain, "X"):
            if part.error in values:
                lever = 1.0 if part.lever is None else levers[part.lever]
                result[part.output] += part.sign * lever * values[part.error]
        return np.asarray(np.ascontiguousarray(result.T) * signs + 0.0)

    def tool_of(self, tables: IsgTables) -> FloatArray:
        """Tool offset used if the points do not give one, shape (3,), mm."""
        if any(name in tables.constants for name in TOOL_NAMES):
            return np.array([tables.constants.get(name, 0.0) for name in TOOL_NAMES])
        return np.array(self.machine.tool_offset_mm)

    def violations(self, tables: IsgTables) -> list[str]:
        """Return broken limits, travel not covered, and differences between list file and machine file."""
        settings = self.settings
        found = list(tables.remarks)
        if tables.records > settings.max_records:
            found.append(
                f"{tables.records} records, but max_records is {settings.max_records}: the control refuses the file. Raise "
                f"vol_comp[0].max_records in the start-up list and max_records in the machine file"
            )
        uncovered: dict[str, list[str]] = {}  # one message per axis and range, with the errors that it applies to
        for name, item in tables.fields.items():
            for axis, nodes in zip(item.axes, item.nodes_mm, strict=True):
                for message in coverage_violations(self.machine, axis, float(nodes[0]), float(nodes[-1]), ""):
                    uncovered.setdefault(message, []).append(name)
        found += [f"{', '.join(listed)}:{message}" for message, listed in uncovered.items()]
        for k, name in enumerate(LOGICAL_NAMES):
            if name in tables.constants and tables.constants[name] != settings.logical_axes[k]:
                found.append(
                    f"{name} = {tables.constants[name]:g}, but the machine file says {settings.logical_axes[k]}"
                )
        return found + self._list_violations(tables)

    def _list_violations(self, tables: IsgTables) -> list[str]:
        """Return where the list file differs from the one that the machine file requires, or from the given files."""
        if tables.listing is None:
            return [f"{len(tables.files)} parameter files; the control accepts {MOST_FILES}"] * (
                len(tables.files) > MOST_FILES
            )
        listing, required = tables.listing, self._list_of(self.parameter_file, self.file_format)
        pairs: list[tuple[str, object, object]] = [
            ("chain", listing.chain, required.chain),
            ("workpiece_axes", listing.workpiece_axes, required.workpiece_axes),
            ("negate", listing.negate or "nothing", required.negate or "nothing"),
            *zip(AXES, listing.logical_axes, required.logical_axes, strict=True),
        ]
        found = [
            f"list file: {key} is {given if given is not None else 'missing'}; the machine file requires {needed}"
            for key, given, needed in pairs
            if given != needed
        ]
        if len(listing.files) > MOST_FILES or max(listing.files) >= MOST_FILES:
            found.append(
                f"list file: {len(listing.files)} files; the control accepts {MOST_FILES}, file[0] ... file[9]"
            )
        if listing.use_axis_offsets:
            found.append("list file: use_axis_offsets 1 shifts the positions in a way that is not publicly documented")
        named = {base_name(path).lower(): index for index, path in listing.files.items()}
        given = {base_name(name).lower() for name in tables.files}
        found += [f"list file: file[{named[name]}] is {name}, which was not given" for name in sorted({*named} - given)]
        found += [f"{name} is not named in the list file: the control ignores it" for name in sorted(given - {*named})]
        for name in sorted(given & {*named}):
            declared = listing.formats.get(named[name], "ISG_CSV")
            if declared != self.file_format:
                found.append(f"list file: {name} is declared {declared}, but it is {self.file_format}")
        return found

    def usage(self, tables: IsgTables) -> list[Usage]:
        """Return the records of the parameter files against the limit of the control."""
        return [Usage("records (max_records)", tables.records, self.settings.max_records, "records")]

    def resolution_mm(self) -> float:
        """Half of the last digit of three lengths, plus that of eight angles (two squareness) at the longest lever."""
        machine = self.machine
        lever_mm = np.maximum(np.abs(machine.lower_mm), np.abs(machine.upper_mm)) + np.abs(machine.tool_offset_mm)
        return 0.5 * (3 * 10.0**-LENGTH_DIGITS + 8 * 10.0**-ANGLE_DIGITS * float(np.max(lever_mm)))

    def table_nodes_mm(self, tables: IsgTables) -> tuple[FloatArray, ...]:
        """Return the arguments of all parameters, by axis."""
        return nodes_by_axis(
            pair for item in tables.fields.values() for pair in zip(item.axes, item.nodes_mm, strict=True)
        )

    def context(self, tables: IsgTables) -> dict[str, Any]:
        """Return the template context: numbers, list entries, the sign in words, parameters and checks."""
        listing = tables.listing or self._list_of(self.parameter_file, self.file_format)
        # the grid point of 3 x 3 x 3 with the largest correction of each axis
        lines = [(axis.range_mm[0], 0.5 * sum(axis.range_mm), axis.range_mm[1]) for axis in self.machine.axes]
        position = full_grid(lines).reshape(-1, 3)
        added = self.emulate(tables, Points(position))
        worst = np.argmax(np.abs(added), axis=0)
        reference = "the reference direction is X, as in the machine file"
        if self.machine.squareness_reference == "Y":
            reference = (
                "the machine file has Y as the reference direction: here its squareness of X and Y is a slope in EYX, and C0Y "
                "is zero"
            )
        return {
            "sign_statement": self._sign_statement(listing),
            "chain_statement": self._chain_statement(listing),
            "reference_statement": reference,
            "parameters": self._parameters(tables, listing),
            "warnings": self._warnings(listing),
            **self.body(tables),
            "tables": tables,
            "records": tables.records,
            "listing": listing,
            "list_entries": LIST_ENTRIES + (1 if listing.negate else 0),
            "axes": [
                {"letter": letter, "number": number} for letter, number in zip(AXES, listing.logical_axes, strict=True)
            ],
            "absent": [CONTROL_NAMES[name] for name in ERROR_NAMES if name not in tables.fields],
            "check": [
                {"axis": letter, "position": position[worst[k]].tolist(), "correction": float(added[worst[k], k])}
                for k, letter in enumerate(AXES)
            ],
        }

    def _list_of(self, parameter_file: str, file_format: str) -> ListFile:
        """Return the list file that the export writes."""
        settings = self.settings
        return ListFile(
            logical_axes=settings.logical_axes,
            chain=chain_text(self.machine.chain, settings.chain_direction),
            workpiece_axes=len(self.machine.chain.workpiece_side),
            negate=settings.negate,
            use_axis_offsets=settings.use_axis_offsets,
            files={0: settings.path + parameter_file},
            formats={0: file_format},
        )

    def _sign_statement(self, listing: ListFile) -> str:
        settings = self.settings
        text = (
            "Values are errors as ISO 230-1 defines them (actual minus commanded tool position relative to the workpiece), "
            "in mm and rad; the control subtracts them from its command. EXX = 0.005 mm at X = 100 mm means that the tool is "
            "0.005 mm too far in +X there, so the control must command X = 99.995 mm."
        )
        if settings.reversed_axes:
            text += f" For {settings.reversed_axes} the check at the machine showed the opposite."
        return text + (f" The list file negates {listing.negate}." if listing.negate else "")

    def _chain_statement(self, listing: ListFile) -> str:
        settings = self.settings
        return (
            f"chain {listing.chain} lists the axes {_DIRECTIONS[settings.chain_direction]}; number of axes that carry the "
            f"workpiece: {listing.workpiece_axes}"
        )

    def _parameters(self, tables: IsgTables, listing: ListFile) -> list[dict[str, object]]:
        settings = self.settings
        rows: list[tuple[str, object, str]] = [
            ("vol_comp[0].file_name", f"{settings.path}volcomp0.lis", "start-up list: the list file"),
            (
                "vol_comp[0].max_records",
                settings.max_records,
                f"start-up list: at least the {tables.records} records of this export",
            ),
            *(
                (letter, number or "", f"list file: logical axis number of {letter}")
                for letter, number in zip("XYZ", listing.logical_axes, strict=True)
            ),
            ("chain", listing.chain, f"list file: order of the axes {_DIRECTIONS[settings.chain_direction]}"),
            ("workpiece_axes", listing.workpiece_axes, "list file: how many axes of the chain carry the workpiece"),
            ("negate", listing.negate or "not set", "list file: axes whose compensation is reversed"),
            ("interpolation", listing.interpolation, "list file: linear between the positions of the grid"),
            ("use_axis_offsets", listing.use_axis_offsets, "list file: 0 means that positions are machine coordinates"),
        ]
        return [{"name": name, "value": value, "meaning": meaning} for name, value, meaning in rows]

    def _warnings(self, listing: ListFile) -> list[str]:
        found = [
            f"{self._chain_statement(listing)}. The documents do not say which end comes first: check it at the "
            f"machine, and change chain_direction in the machine file if it is the other end."
        ]
        if any(self.machine.tool_offset_mm) and not self.settings.write_tool_position:
            offset = ", ".join(f"{value:g}" for value in self.machine.tool_offset_mm)
            found.append(
                f"The lever arms include the tool offset ({offset}) mm. The control must know it too, from its tool data or "
                f"from P0X, P0Y, P0Z in a parameter file of format ISG_CSV; which of them it uses is not publicly documented."
            )
        differing = "".join(
            letter for letter in "XYZ" if (letter in listing.negate) != (letter in self.settings.reversed_axes)
        )
        if differing:
            found.append(
                f"negate and reversed_axes in the machine file differ for {differing}: the control then ADDS the error. Set "
                f"reversed_axes to what the check at the machine showed, and remove negate."
            )
        if self.settings.use_axis_offsets:
            found.append(
                "use_axis_offsets 1: the shift that the control then applies is not publicly documented and not emulated."
            )
        return found


# ISG_CSV: the error parameters as white-space separated columns (kernel help, page 296429067).
#
# A header names arguments and parameters; rows of numbers follow. ``//`` starts a comment, a line with ``#`` ends a
# block. Several argument columns make a grid, e.g. errors of X at several Z.

_Row = tuple[int, list[str]]


def parse_csv(source: SourceFile) -> ParameterFile:
    """Read an ISG_CSV file; InputError with file and line for anything outside the grammar."""
    parameters: list[ErrorParameter] = []
    records = 0
    exponent: int | None = None
    for block in _blocks(source):
        parameters += _block(source, block)
        records += len(block) - 1
        lines = (line for line, words in block[1:] if uses_exponent(words))
        exponent = next(lines, None) if exponent is None else exponent
    check_complete(source, records)
    return ParameterFile(tuple(parameters), records, exponent)


def _blocks(source: SourceFile) -> list[list[_Row]]:
    blocks: list[list[_Row]] = [[]]
    for line, text in content_lines(source):
        if text.startswith("#"):
            blocks.append([])
        elif "#" in text:
            raise source.fail("a '#' ends a block and must be at the start of its own line", line)
        else:
            blocks[-1].append((line, text.split()))
    filled = [block for block in blocks if block]
    if not filled:
        raise source.fail("contains no block; is it the right file, or is it truncated?")
    return filled


def _block(source: SourceFile, block: list[_Row]) -> list[ErrorParameter]:
    """Return the parameters of one block: a header, and rows that form a grid over its arguments."""
    (header_line, names), rows = block[0], block[1:]
    _check_header(source, header_line, names)
    if not rows:
        raise source.fail(f"the block {' '.join(names)[:60]!r} has no rows; is the file truncated?", header_line)
    for line, words in rows:
        if len(words) != len(names):
            raise source.fail(f"has {len(words)} columns, but its header in line {header_line} has {len(names)}", line)
    matrix = np.array(
        [[floating(source, line, word, name) for word, name in zip(words, names, strict=True)] for line, words in rows]
    )
    columns = {name: matrix[:, k] for k, name in enumerate(names)}
    if any(name in "ABC" for name in names):
        mixed = [name for name in names if len(name) > 1 and not is_rotary(name)]
        if mixed:
            raise source.fail(f"{mixed[0]} depends on a rotary axis; the model has three linear axes", header_line)
        where = f"{source.path}:{header_line}"
        warnings.warn(f"{where}: the block belongs to a rotary axis and is left out", CompgenWarning, stacklevel=2)
        return []
    arguments = [name for name in names if name in ARGUMENTS]
    nodes, order = grid_order(source, [line for line, _ in rows], [columns[name] for name in arguments])
    axes = tuple(ARGUMENTS.index(name) for name in arguments)
    shape = tuple(len(line) for line in nodes)
    return [
        ErrorParameter(name, ParameterGrid(axes, nodes, column[order].reshape(shape)), source, header_line)
        for name, column in columns.items()
        if name not in ARGUMENTS
    ]


def _check_header(source: SourceFile, line: int, names: list[str]) -> None:
    for name in names:
        if name[0] in "+-.0123456789":
            raise source.fail(f"expected a header with names at the start of a block, found {name[:40]!r}", line)
        check_name(source, line, name)
    twice = doubled(names)
    if twice is not None:
        raise source.fail(f"the header names {twice} twice (error 70469 on the control)", line)
    if all(len(name) == 1 for name in names):
        raise source.fail("the header has arguments only; expected at least one error parameter", line)


class IsgCsv(VolumetricController):
    """``isg-csv``: error parameters as columns, one block per axis."""

    name = "isg-csv"
    file_format = "ISG_CSV"
    parameter_file = "volcomp0.csv"
    settings_class = IsgCsvSettings

    def parse_parameters(self, source: SourceFile) -> ParameterFile:
        """Read one ISG_CSV file."""
        return parse_csv(source)

    def count_records(self, fields: Mapping[str, ParameterGrid], constants: Mapping[str, float]) -> int:
        """One row for the position errors, one for the tool, one per position of each axis."""
        return sum(len(block["rows"]) for block in _table_blocks(fields, constants))

    def body(self, tables: IsgTables) -> dict[str, Any]:
        """Return the blocks: title, names, rows and digits of each column."""
        return {"blocks": _table_blocks(tables.fields, tables.constants)}


def _table_blocks(fields: Mapping[str, ParameterGrid], constants: Mapping[str, float]) -> list[dict[str, Any]]:
    """Blocks in the order of the file: constants, tool position, then curves of X, Y, Z grouped by common nodes."""
    groups: dict[tuple[Any, ...], dict[str, ParameterGrid]] = {}
    for name, item in sorted(fields.items(), key=lambda pair: pair[1].axes):
        key = (item.axes, *(nodes.tobytes() for nodes in item.nodes_mm))
        groups.setdefault(key, {})[name] = item
    blocks = [_rows(group) for group in groups.values()]
    if constants:
        row = {"names": list(constants), "digits": [POSITION_DIGITS] * len(constants), "rows": [[*constants.values()]]}
        first_curve = next((k for k, block in enumerate(blocks) if block["names"][0] in ARGUMENTS), len(blocks))
        blocks.insert(first_curve, {"title": "tool position at machine zero, mm", **row})
    return blocks


def _rows(group: Mapping[str, ParameterGrid]) -> dict[str, Any]:
    """Block of the parameters on one grid: names, rows, and digits of each column."""
    first = next(iter(group.values()))
    letters = [AXES[axis] for axis in first.axes]
    positions = itertools.product(*(nodes.tolist() for nodes in first.nodes_mm))
    columns = [np.ravel(item.values).tolist() for item in group.values()]
    linear = [error_named(name).kind == "linear" for name in group]
    return {
        "title": f"errors over {' and '.join(letters)}, mm and rad" if letters else "position errors, rad",
        "names": [*letters, *(CONTROL_NAMES[name] for name in group)],
        "digits": [POSITION_DIGITS] * len(letters) + [LENGTH_DIGITS if flag else ANGLE_DIGITS for flag in linear],
        "rows": [[*at, *values] for at, *values in zip(positions, *columns, strict=True)],
    }


# ETALON_EXCHANGE: the exchange file of Etalon's software, variant "Vendor" (ISG kernel help, page 296430091).
#
# ``[EXY]`` starts a parameter; ``VALUE = number`` gives a constant; ``Gridpoints = {``, rows ``argument value`` and
# ``}`` give a curve over the position of the axis. ``//`` starts a comment. :func:`errors_from_etalon` imports such a
# file.


_SECTION = re.compile(r"\[\s{0,9}([A-Za-z0-9_]{1,40})\s{0,9}\]")
_VALUE = re.compile(r"value\s{0,40}=\s{0,40}(\S+)", re.IGNORECASE)
_GRID = re.compile(r"gridpoints\s{0,40}=\s{0,40}\{", re.IGNORECASE)


@dataclass
class _Section:
    """One ``[NAME]`` while being read; ``open`` is True between the braces of its grid points."""

    name: str
    line: int
    value: float | None = None
    rows: list[tuple[int, list[str]]] = field(default_factory=list)
    open: bool = False
    grid: bool = False


def parse_etalon(source: SourceFile) -> ParameterFile:
    """Read an ETALON_EXCHANGE file; InputError with file and line for anything outside the grammar."""
    sections: list[_Section] = []
    exponent: int | None = None
    for line, text in content_lines(source):
        _take_line(source, sections, line, text)
        if exponent is None and uses_exponent([word for word in text.split() if word[0] in "+-.0123456789"]):
            exponent = line
    if sections and sections[-1].open:
        raise source.fail(f"[{sections[-1].name}] has no closing brace: the file is truncated", sections[-1].line)
    records = sum(len(section.rows) if section.grid else 1 for section in sections)
    parameters = []
    for section in sections:
        name, line = section.name, section.line
        if section.value is not None:
            parameters.append(ErrorParameter(name, ParameterGrid((), (), np.array(section.value)), source, line))
            continue
        if not section.rows:
            raise source.fail(f"[{name}] has no values; is the file truncated?", line)
        if name in ISO_NAMES and ISO_NAMES[name] in SQUARENESS_NAMES:
            raise source.fail(f"[{name}] is a constant; expected 'VALUE = number'", line)
        pairs = np.array([[floating(source, at, word, name) for word in words] for at, words in section.rows])
        nodes, order = grid_order(source, [at for at, _ in section.rows], [pairs[:, 0]])
        axis = 0 if is_rotary(name) else ARGUMENTS.index(name[-1])
        parameters.append(ErrorParameter(name, ParameterGrid((axis,), nodes, pairs[order, 1]), source, line))
    check_complete(source, records)
    return ParameterFile(tuple(parameters), records, exponent)


def _take_line(source: SourceFile, sections: list[_Section], line: int, text: str) -> None:
    """Add one line to the current section, or start a new one."""
    current = sections[-1] if sections else None
    header = _SECTION.match(text)
    if header and not (current and current.open):
        check_name(source, line, header.group(1))
        if len(header.group(1)) == 1:
            raise source.fail(f"[{header.group(1)}] is an argument; expected a parameter such as [EXX]", line)
        sections.append(_Section(header.group(1), line))
        if rest := text[header.end() :].strip():
            _take_entry(source, sections[-1], line, rest)
    elif current is None:
        raise source.fail(f"expected a parameter name in brackets such as [EXX], found {text[:40]!r}", line)
    elif current.open:
        row, brace, rest = text.partition("}")
        words = row.split()
        if rest or len(words) not in ((0, 2) if brace else (2,)):
            message = f"expected two numbers 'argument value' or '}}' in [{current.name}], got {text[:40]!r}"
            raise source.fail(message, line)
        if words:
            current.rows.append((line, words))
        current.open = not brace
    else:
        _take_entry(source, current, line, text)


def _take_entry(source: SourceFile, section: _Section, line: int, text: str) -> None:
    if section.grid or section.value is not None:
        raise source.fail(f"[{section.name}] already has a value; expected a new [NAME], got {text[:40]!r}", line)
    value = _VALUE.fullmatch(text)
    if value:
        section.value = floating(source, line, value.group(1), section.name)
    elif _GRID.fullmatch(text):
        section.grid = section.open = True
    else:
        message = f"expected 'VALUE = number' or 'Gridpoints = {{' in [{section.name}], got {text[:40]!r}"
        raise source.fail(message, line)


def is_exchange_text(text: str) -> bool:
    """Whether a text starts, after comments, with a parameter name in brackets, as an exchange file does."""
    for line in text[:20_000].split("\n"):
        content = line.partition("//")[0].strip()
        if content:
            return _SECTION.match(content) is not None
    return False


def errors_from_etalon(text: str, path: Path | None = None) -> ErrorTable:
    """Import an exchange file written by laser tracer software ("Vendor" variant).

    Parameters
    ----------
    text : contents of the file; lengths in mm, angles in rad, positions in mm.
    path : path of the file, for messages.

    Returns
    -------
    the errors as in the file, squareness by the ISO 230-1 convention (reference X); uncertainties unknown.
    Errors of rotary axes are left out with a warning.
    """
    source = SourceFile(path or Path("exchange file"), text)
    fields, _ = collect(parse_etalon(source).parameters)
    curves = {name: _curve(item) for name, item in fields.items() if name not in SQUARENESS_NAMES}
    squareness = {name: (float(fields[name].values), np.nan) for name in SQUARENESS_NAMES if name in fields}
    return ErrorTable(curves, squareness, {"source": source.path.name, "format": "ETALON_EXCHANGE"})


def _curve(item: ParameterGrid) -> Curve:
    position = item.nodes_mm[0] if item.axes else np.zeros(1)
    value = np.atleast_1d(item.values)
    return Curve(position, value, np.full(len(value), np.nan))


class EtalonExchange(VolumetricController):
    """``etalon-exchange``: one section per parameter."""

    name = "etalon-exchange"
    file_format = "ETALON_EXCHANGE"
    parameter_file = "volcomp0.etalon.txt"

    def parse_parameters(self, source: SourceFile) -> ParameterFile:
        """Read one exchange file."""
        return parse_etalon(source)

    def count_records(self, fields: Mapping[str, ParameterGrid], constants: Mapping[str, float]) -> int:
        """One record per VALUE and per row of grid points."""
        return sum(int(np.size(item.values)) for item in fields.values()) + len(constants)

    def body(self, tables: IsgTables) -> dict[str, Any]:
        """Return the sections: squareness first, then the curves with their rows."""
        names = [*(name for name in SQUARENESS_NAMES if name in tables.fields)]
        names += [name for name in tables.fields if name not in names]
        return {"sections": [_section(name, tables.fields[name]) for name in names]}


def _section(name: str, item: ParameterGrid) -> dict[str, Any]:
    linear = error_named(name).kind == "linear"
    rows = list(zip(item.nodes_mm[0].tolist(), item.values.tolist(), strict=True)) if item.axes else []
    return {
        "name": CONTROL_NAMES[name],
        "unit": "mm" if linear else "rad",
        "digits": LENGTH_DIGITS if linear else ANGLE_DIGITS,
        "position_digits": POSITION_DIGITS,
        "value": None if item.axes else float(item.values),
        "rows": rows,
    }


# Errors from users' files: ``*.errors.csv``, or an exchange file written by laser tracer software.


def read_error_file(path: str | Path) -> ErrorTable:
    """Read an ``*.errors.csv`` file (um, urad) or an Etalon exchange file, variant Vendor (mm, rad).

    The format is detected from the text: an exchange file starts, after comments, with a name in brackets.
    """
    source = Path(path)
    text = read_text(source)
    return errors_from_etalon(text, source) if is_exchange_text(text) else read_errors(source)
