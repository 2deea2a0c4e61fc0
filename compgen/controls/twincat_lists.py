"""TwinCAT CNC axis lists (``twincat-lists``): leadscrew, cross and plane tables of the axes, file text and lookup."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from compgen.controls.shared.base import SourceFile, Term, Usage, travel_of
from compgen.controls.shared.grids import equidistant_grid, loss_setting, uneven_nodes_mm
from compgen.controls.shared.scanner import Findings, check_complete, content_lines, fixed_point
from compgen.controls.shared.tables import Table1D, TableController, TableGrid
from compgen.controls.shared.terms import continued, field_on_grid, one_dimensional_terms, product_terms
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import WORTH_MM, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import (
    accepts,
    axis_setting,
    choice,
    flag,
    positive,
    setting,
    table_setting,
    whole,
    word_for,
)
from compgen.errors import CompgenWarning, InputError, nearest

# Axis lists of the TwinCAT CNC (TF5200): leadscrew, cross and plane tables as stored on the control, and their lookup.
#
# Numbers are in the unit of the files, 0.1 um (``unit 1``). Source: Beckhoff TF5200 "Axis compensation" (308687883,
# 308709003, 15327290891) and its parameters P-COMP-00004 ... P-COMP-00033.


# Axis lists of the TwinCAT CNC (TF5200): leadscrew, cross and plane tables, lookup and reader.

#: 0.1 um in mm.
MM_PER_UNIT = 1e-4


@dataclass(frozen=True)
class LeadscrewTable(Table1D):
    """``kw.ssfk``: values over the position of the same axis; ``interval`` is their spacing, or 0 if the file lists each."""

    interval: float = 0.0


def leadscrew(
    axis: int, setpoints: FloatArray, pos: FloatArray, neg: FloatArray | None = None, interval: float = 0.0
) -> LeadscrewTable:
    """Return the leadscrew table of an axis, in 0.1 um."""
    return LeadscrewTable(axis, axis, setpoints, pos, neg, MM_PER_UNIT, MM_PER_UNIT, interval=interval)


@dataclass(frozen=True)
class CrossTable(Table1D):
    """``kw.crosscomp`` of a slave axis: values over the command position of another, the master, which the file names."""

    axis: int


def cross_table(slave: int, master: int, setpoints: FloatArray, values: FloatArray) -> CrossTable:
    """Return the cross table of a slave axis, in 0.1 um."""
    return CrossTable(master, slave, setpoints, values, None, MM_PER_UNIT, MM_PER_UNIT)


@dataclass(frozen=True)
class PlaneTable(TableGrid):
    """``kw.crosscomp2`` of a slave axis over two masters, which the file names; one spacing along both."""

    axes: tuple[int, ...]


def plane_table(
    slave: int, masters: tuple[int, int], starts: tuple[float, float], interval: float, values: FloatArray
) -> PlaneTable:
    """Return the plane of a slave axis, in 0.1 um.

    ``values`` [j, i] with i along ``masters[0]`` and j along ``masters[1]``, ``starts`` the positions of i = 0 and j = 0.
    """
    return PlaneTable(masters, (slave,), np.array(starts), interval, values.T[..., None], MM_PER_UNIT, MM_PER_UNIT)


@dataclass(frozen=True)
class AxisList:
    """The tables in the list of one axis, the slave of ``cross`` and ``plane``."""

    screw: LeadscrewTable | None = None
    cross: CrossTable | None = None
    plane: PlaneTable | None = None

    @property
    def numbers(self) -> FloatArray:
        """All positions and values of the tables, shape (n,)."""
        parts: list[FloatArray | None] = [np.zeros(1)]
        if self.screw is not None:
            parts += [self.screw.nodes, self.screw.positive, self.screw.negative]
        if self.cross is not None:
            parts += [self.cross.nodes, self.cross.positive]
        if self.plane is not None:
            parts += [self.plane.start, np.array(self.plane.step), self.plane.values]
        return np.concatenate([np.ravel(part) for part in parts if part is not None])


@dataclass(frozen=True)
class TwincatTables:
    """The lists of the axes 0..2."""

    lists: Mapping[int, AxisList]


@dataclass(frozen=True)
class PointLimits:
    """Maximum number of points for each kind of table; builds without P-COMP-00059 ... 61 have the defaults."""

    ssfk: int = setting(whole(2, 100_000), 1500)
    crosscomp: int = setting(whole(2, 100_000), 1001)
    crosscomp2: int = setting(whole(4, 100_000), 10201)


def point_counts(item: AxisList) -> dict[str, int]:
    """Return the number of points of each table in a list, by structure (``ssfk``, ``crosscomp``, ``crosscomp2``)."""
    counts = {} if item.screw is None else {"ssfk": len(item.screw.nodes)}
    counts |= {} if item.cross is None else {"crosscomp": len(item.cross.nodes)}
    return counts | ({} if item.plane is None else {"crosscomp2": item.plane.values.size})


def list_usage(name: str, item: AxisList, most: PointLimits) -> list[Usage]:
    """Return the points of one list (``name``: the axis) against the limits of the control."""
    return [
        Usage(f"points of kw.{kind} of {name}", used, getattr(most, kind), "points")
        for kind, used in point_counts(item).items()
    ]


def spans_mm(item: AxisList, axis: int) -> list[tuple[str, int, FloatArray]]:
    """Return (structure, input axis, positions in mm) for every table in the list of ``axis``."""
    found: list[tuple[str, int, FloatArray]] = []
    if item.screw is not None:
        found.append(("kw.ssfk", axis, item.screw.nodes_mm))
    if item.cross is not None:
        found.append(("kw.crosscomp", item.cross.axis, item.cross.nodes_mm))
    if item.plane is not None:
        found += [("kw.crosscomp2", master, nodes_mm) for master, nodes_mm in item.plane.spans]
    return found


def units_outwards(machine: Machine, axis: int, positions_mm: FloatArray) -> FloatArray:
    """Round positions (n,) to whole units of 0.1 um, outwards at the ends of the travel to keep it covered."""
    low, high = (end / MM_PER_UNIT for end in machine.axes[axis].range_mm)
    units = np.rint(positions_mm / MM_PER_UNIT)
    units[0] = min(units[0], np.floor(low + 1e-3)) if positions_mm[0] <= machine.axes[axis].range_mm[0] else units[0]
    units[-1] = (
        max(units[-1], np.ceil(high - 1e-3)) if positions_mm[-1] >= machine.axes[axis].range_mm[1] else units[-1]
    )
    return np.unique(units)


# Strict reader of the axis lists of the TwinCAT CNC (``achskw*.lis``): one ``key value`` per line.
#
# ``#`` starts a comment line, ``/* ... */`` is a comment after a value. Key grammar::
#
#     kopf.achs_nr | kopf.log_achs_name | kw.<structure>.<parameter> | kw.<structure>.table[i].<parameter>
#     kw.crosscomp2.table[j][i].correction            j: second master


_SPACED_INDEX = re.compile(r"\[\s{0,9}([0-9]{1,6})\s{0,9}\]")
_KEY = re.compile(r"([a-z0-9_]{1,20})\.([a-z0-9_.]{1,60})((?:\[[0-9]{1,6}\]){0,2})(?:\.([a-z0-9_]{1,30}))?")
_SWITCHES = ("max_points", "manual_activation")
#: Parameters of each structure; ``_TABLES`` has the parameters of its table and how many indices they have.
_KNOWN: dict[str, tuple[str, ...]] = {
    "kopf": ("achs_nr", "log_achs_nr", "log_achs_name"),
    "kw.ssfk": ("unit", "interval", "kw_startpos", "kw_nr_max", "bilateral", "modulo", *_SWITCHES),
    "kw.crosscomp": ("unit", "last_index", "master_ax_nr", "n_cycles", *_SWITCHES),
    "kw.crosscomp2": (
        "unit", "interval", "last_index_master1", "last_index_master2", "start_position_master1",
        "start_position_master2", "master1_ax_nr", "master2_ax_nr", "n_cycles", *_SWITCHES,
    ),
}  # fmt: skip
_TABLES: dict[str, tuple[int, tuple[str, ...]]] = {
    "kw.ssfk": (1, ("setpoint", "pos", "neg")),
    "kw.crosscomp": (1, ("setpoint", "correction")),
    "kw.crosscomp2": (2, ("correction",)),
}
_RESERVED = re.compile(r"res(?:erve)?[0-9]{0,2}")
_MOST_POINTS = 150_000


@dataclass(frozen=True)
class _Entry:
    value: str
    line: int


@dataclass
class _Body:
    """The entries of one file: parameters by structure and name, table entries by structure, name and index."""

    source: SourceFile
    axis_names: tuple[str, ...]
    logical_axes: tuple[int, ...]
    increment_mm: tuple[float | None, ...] = (None, None, None)
    foreign: Findings | None = None
    scalars: dict[tuple[str, str], _Entry] = field(default_factory=dict)
    tables: dict[tuple[str, str], dict[tuple[int, ...], _Entry]] = field(default_factory=dict)

    def number(self, structure: str, name: str, default: float | None = None) -> float:
        """Return a parameter as a number."""
        entry = self.scalars.get((structure, name))
        if entry is None:
            if default is None:
                raise self.source.fail(f"{structure}.{name} is missing; is the file truncated?")
            return default
        return self.value(f"{structure}.{name}", entry)

    def value(self, label: str, entry: _Entry) -> float:
        """Return the number of an entry, or raise the error that says why it is not a number."""
        number = float(fixed_point(self.source, entry.line, entry.value, label))
        if abs(number) > 2.0**53:
            raise self.source.fail(f"{label}: {number:g} is beyond the largest whole number of the control", entry.line)
        return number

    def whole(self, structure: str, name: str, low: int, high: int, default: int | None = None) -> int:
        """Return a parameter as a whole number within limits."""
        number = self.number(structure, name, default)
        if number != int(number) or not low <= number <= high:
            raise self.fail(structure, name, f"{number:g} is not a whole number from {low} to {high}")
        return int(number)

    def fail(self, structure: str, name: str, message: str) -> InputError:
        """Return the error that points at a parameter."""
        entry = self.scalars.get((structure, name))
        return self.source.fail(f"{structure}.{name}: {message}", entry.line if entry else None)

    def axis(self, structure: str, name: str) -> int:
        """Return the axis 0..2 with the logical axis number of a parameter."""
        number = self.whole(structure, name, 0, 65535)
        if number not in self.logical_axes:
            known = ", ".join(map(str, self.logical_axes))
            raise self.fail(structure, name, f"no axis has the logical number {number}; logical_axes is {known}")
        return self.logical_axes.index(number)

    def column(self, structure: str, name: str, shape: tuple[int, ...]) -> FloatArray:
        """Return a column of a structure's table, all indices from 0, shape ``shape``."""
        entries = self.tables.get((structure, name), {})
        result = np.zeros(shape)
        for index, entry in entries.items():
            if any(k >= n for k, n in zip(index, shape, strict=True)):
                places = "".join(f"[0 ... {n - 1}]" for n in shape)
                raise self.source.fail(
                    f"{_label(structure, name, index)}: the indices of the table are {places}", entry.line
                )
            result[index] = self.value(_label(structure, name, index), entry)
        if len(entries) != result.size:
            missing = next(index for index in np.ndindex(*shape) if index not in entries)
            raise self.source.fail(f"{_label(structure, name, missing)} is missing; is the file truncated?")
        return result


def _label(structure: str, name: str, index: Sequence[int]) -> str:
    return f"{structure}.table{''.join(f'[{k}]' for k in index)}.{name}"


def parse_axis_list(
    source: SourceFile,
    axis_names: tuple[str, ...],
    logical_axes: tuple[int, ...],
    increment_mm: tuple[float | None, ...],
    foreign: Findings | None = None,
) -> tuple[int | None, AxisList]:
    """Return the axis (0..2) of a list and its tables; InputError with file and line for anything malformed.

    ``increment_mm`` are the encoder increments of the axes for lists with ``unit 0``. With ``foreign`` the list comes
    from another program: comments may contain any character, reserved entries and other structures are skipped, and the
    axis is None if the machine file does not have it.
    """
    if foreign is not None:
        source = SourceFile(source.path, source.text.encode("ascii", "replace").decode().replace("\0", "?"))
    body = _Body(source, axis_names, logical_axes, increment_mm, foreign)
    count = 0
    for line, text in content_lines(source, "#"):
        code, start, rest = text.partition("/*")
        _, end, after = rest.partition("*/")
        if start and (not end or after.strip()):
            raise source.fail("a comment /* ... */ must end on its own line, with nothing after it", line)
        if code.strip():
            _take(body, line, code.strip())
            count += 1
    if not count:
        raise source.fail("contains no entry; is it the right file?")
    check_complete(source, count, "entries")
    older = ("kopf", "achs_nr") not in body.scalars and ("kopf", "log_achs_nr") in body.scalars
    key = "log_achs_nr" if older else "achs_nr"
    if foreign is not None and _is_apart(body, "kopf", key):
        foreign.apart.append(f"the list of axis {body.whole('kopf', key, 0, 65535)} ({source.path.name})")
        return None, AxisList()
    axis = body.axis("kopf", key)
    present = {structure for structure, _ in (*body.scalars, *body.tables)}
    if foreign is not None:
        for structure in sorted(present & set(_MASTERS)):
            missing = [name for name in _MASTERS[structure] if _is_apart(body, structure, name)]
            if missing:
                number = body.whole(structure, missing[0], 0, 65535)
                foreign.apart.append(f"{structure} of {source.path.name} (master {number})")
                present.remove(structure)
    return axis, AxisList(
        _screw(body, axis) if "kw.ssfk" in present else None,
        _cross(body, axis) if "kw.crosscomp" in present else None,
        _plane(body, axis) if "kw.crosscomp2" in present else None,
    )


_MASTERS = {"kw.crosscomp": ("master_ax_nr",), "kw.crosscomp2": ("master1_ax_nr", "master2_ax_nr")}


def _is_apart(body: _Body, structure: str, name: str) -> bool:
    """Whether a logical axis number is not in the machine file."""
    return body.whole(structure, name, 0, 65535) not in body.logical_axes


def _take(body: _Body, line: int, code: str) -> None:
    words = _SPACED_INDEX.sub(r"[\1]", code).split(maxsplit=1)
    key = words[0]
    match = _KEY.fullmatch(key)
    if match is None:
        raise body.source.fail(f"{code[:60]!r} is not an entry; expected e.g. kw.ssfk.table[0].pos 21", line)
    if len(words) == 1:
        raise body.source.fail(f"{key} has no value", line)
    entry = _Entry(words[1].strip(), line)
    head, _, name = f"{match.group(1)}.{match.group(2)}".rpartition(".")
    if body.foreign is not None and (what := _idle(head, name)):
        body.foreign.count(what)
        return
    if match.group(3):
        index = tuple(int(part) for part in match.group(3)[1:-1].split("]["))
        known = name == "table" and head in _TABLES and match.group(4) in _TABLES[head][1]
        if not known or len(index) != _TABLES[head][0]:
            raise _unknown(body, line, key)
        column = body.tables.setdefault((head, match.group(4)), {})
        first = column.setdefault(index, entry)
    else:
        if name not in _KNOWN.get(head, ()) or match.group(4):
            raise _unknown(body, line, key)
        first = body.scalars.setdefault((head, name), entry)
    if first is not entry:
        raise body.source.fail(f"{key} is given a second time; the first is in line {first.line}", line)


def _idle(head: str, name: str) -> str:
    """Describe an entry of another program's list that does not affect the three tables; empty if it does."""
    if head in _TABLES:
        return f"reserved entries of {head}" if _RESERVED.fullmatch(name) else ""
    return "" if head == "kopf" and name in _KNOWN["kopf"] else f"entries of {head}"


def _unknown(body: _Body, line: int, key: str) -> InputError:
    known = [f"{head}.{name}" for head, names in _KNOWN.items() for name in names]
    known += [_label(head, name, [0] * count) for head, (count, names) in _TABLES.items() for name in names]
    return body.source.fail(f"{key[:60]!r} is not a parameter of these lists; {nearest(key[:60], known)}", line)


def _values(body: _Body, structure: str, axis: int, values: FloatArray) -> FloatArray:
    """Convert table values to 0.1 um: ``unit`` 1 unchanged, 0 from encoder increments; positions are not affected."""
    if body.whole(structure, "unit", 0, 1) == 1 or not np.any(values):
        return values
    length_mm = body.increment_mm[axis]
    if length_mm is None:
        raise body.fail(
            structure,
            "unit",
            f"0 means that the values are encoder increments, but the list does not contain their length. Set it in the "
            f"machine file, e.g. increment_um = {{ {AXES[axis]} = 0.1 }}, or use unit 1 and values in 0.1 um",
        )
    return values * (length_mm / MM_PER_UNIT)


def _ascending(body: _Body, structure: str, setpoints: FloatArray) -> FloatArray:
    place = np.flatnonzero(np.diff(setpoints) <= 0)
    if place.size:
        index = (int(place[0]) + 1,)
        entry = body.tables[structure, "setpoint"][index]
        message = f"{_label(structure, 'setpoint', index)}: {entry.value} is not above the position before it"
        raise body.source.fail(message, entry.line)
    return setpoints


def _screw(body: _Body, axis: int) -> LeadscrewTable:
    name = "kw.ssfk"
    if body.whole(name, "modulo", 0, 1, 0):
        raise body.fail(name, "modulo", "1 belongs to rotary axes; the model has three linear axes")
    count = body.whole(name, "kw_nr_max", 1, _MOST_POINTS)
    interval = body.number(name, "interval")
    if interval < 0:
        raise body.fail(name, "interval", f"{interval:g} is negative")
    if interval:
        setpoints = np.asarray(body.number(name, "kw_startpos") + interval * np.arange(count), dtype=np.float64)
        for index, entry in body.tables.get((name, "setpoint"), {}).items():
            message = "an equidistant table (interval above 0) has no setpoints"
            raise body.source.fail(f"{_label(name, 'setpoint', index)}: {message}", entry.line)
    else:
        setpoints = _ascending(body, name, body.column(name, "setpoint", (count,)))
    pos = body.column(name, "pos", (count,))
    two_sided = body.whole(name, "bilateral", 0, 1, 0) == 1
    if two_sided or (name, "neg") in body.tables:
        neg = body.column(name, "neg", (count,))
    other = _values(body, name, axis, neg) if two_sided else None
    return leadscrew(axis, setpoints, _values(body, name, axis, pos), other, interval)


def _cross(body: _Body, axis: int) -> CrossTable:
    name = "kw.crosscomp"
    count = body.whole(name, "last_index", 0, _MOST_POINTS - 1) + 1
    setpoints = _ascending(body, name, body.column(name, "setpoint", (count,)))
    values = _values(body, name, axis, body.column(name, "correction", (count,)))
    return cross_table(axis, body.axis(name, "master_ax_nr"), setpoints, values)


def _plane(body: _Body, axis: int) -> PlaneTable:
    name = "kw.crosscomp2"
    first, second = (body.whole(name, f"last_index_master{k}", 0, _MOST_POINTS - 1) + 1 for k in (1, 2))
    if first * second > _MOST_POINTS:
        raise body.fail(name, "last_index_master2", f"gives {first} x {second} points; at most {_MOST_POINTS} are read")
    interval = body.number(name, "interval")
    if interval <= 0:
        raise body.fail(name, "interval", f"{interval:g} is not above zero (error 70430 on the control)")
    masters = (body.axis(name, "master1_ax_nr"), body.axis(name, "master2_ax_nr"))
    if masters[0] == masters[1]:
        raise body.fail(name, "master2_ax_nr", "is also the first master; a plane needs two different axes")
    starts = (body.number(name, "start_position_master1"), body.number(name, "start_position_master2"))
    values = _values(body, name, axis, body.column(name, "correction", (second, first)))
    return plane_table(axis, masters, starts, interval, values)


# Settings ``[controllers.twincat-lists]`` of a machine file.


_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_-]{0,31}")
_PLANES = {"XY": (0, 1), "YX": (1, 0), "XZ": (0, 2), "ZX": (2, 0), "YZ": (1, 2), "ZY": (2, 1), "none": None}
_DIFFER = "gives {} for X, Y, Z; expected three different values"


@accepts({"type": "string", "pattern": f"^{_NAME.pattern}$"})
def _axis_name(value: Any) -> str:
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        raise ValueError("expected an axis name of letters, digits, '_' and '-'")
    return value


@accepts({"enum": list(_PLANES)})
def plane_masters(value: Any) -> tuple[int, int] | None:
    """First and second master of a plane from their letters, e.g. "XZ"; None for "none"."""
    if not isinstance(value, str) or value not in _PLANES:
        raise ValueError(f"expected the letters of first and second master, or none: {', '.join(_PLANES)}")
    return _PLANES[value]


@dataclass(frozen=True)
class TwincatSettings:
    """``[controllers.twincat-lists]`` of a machine file.

    ``planes``: masters (first, second) of the plane of each slave, None: no plane, ``"auto"``: chosen automatically.
    """

    logical_axes: tuple[int, int, int] = axis_setting(
        whole(1, 65535), (1, 2, 3), differ=_DIFFER, meaning="numbers of the axes on the control"
    )
    axis_names: tuple[str, str, str] = axis_setting(
        _axis_name, ("X", "Y", "Z"), differ=_DIFFER, meaning="names of the axes on the control"
    )
    planes: tuple[tuple[int, int] | str | None, ...] = axis_setting(
        plane_masters,
        ("auto",) * 3,
        meaning="masters of the plane table of each slave; chosen automatically if not stated",
    )
    most: PointLimits = table_setting(
        PointLimits, key="max_points", meaning="largest number of points per table that the control accepts"
    )
    cross_sign: str = setting(
        choice("correction", "error"),
        "correction",
        meaning='"correction": the control adds crosscomp and crosscomp2 to the command of the slave; "error": it subtracts them',
    )
    ssfk_sign: str = setting(
        choice("error", "correction"),
        "error",
        meaning='"error": ssfk is actual minus nominal, which the control subtracts; "correction": it adds ssfk',
    )
    real64: bool = setting(
        word_for({"SGN32": False, "REAL64": True}),
        key="number_type",
        stated="SGN32",
        meaning="number format of the control: SGN32 whole numbers, REAL64 with decimals",
    )
    crosscomp2: bool = setting(flag, True, meaning="write plane tables")
    own_setpoints: bool = setting(flag, False, meaning="every ssfk point has its own position (interval 0)")
    n_cycles: int = setting(whole(0, 1000), 10, meaning="cycles over which a switched correction is smoothed")
    loss_mm: float = loss_setting()
    increment_mm: tuple[float | None, float | None, float | None] = axis_setting(
        positive,
        key="increment_um",
        unit=MM_PER_UM,
        meaning="encoder increments of the axes, e.g. { X = 0.1 }, needed to read lists of the control with unit 0",
    )

    @property
    def digits(self) -> int:
        """Decimals of numbers in 0.1 um."""
        return 4 if self.real64 else 0

    @property
    def screw_factor(self) -> float:
        """Factor with which the control adds a stored ``ssfk`` value: -1 or +1."""
        return -1.0 if self.ssfk_sign == "error" else 1.0

    @property
    def cross_factor(self) -> float:
        """Factor with which the control adds a stored cross or plane value: +1 or -1."""
        return 1.0 if self.cross_sign == "correction" else -1.0


# Allocation of the TwinCAT axis lists: which table of a slave axis contains which function, and the table values.
#
# A slave has one leadscrew table, one cross table (one master) and one plane (two masters; one may be the slave). The
# plane contains the largest products (function of one axis) x (lever of another).


#: A function or product that moves the slave by less than this (rms) does not need a table.
NOTHING_MM = 0.02 * MM_PER_UM


def _masters(term: Term) -> tuple[int, int]:
    lever = term.carrier[0].lever
    first, second = sorted((term.axis or 0, lever or 0))
    return first, second


def _units(nodes_mm: FloatArray) -> FloatArray:
    return np.rint(nodes_mm / MM_PER_UNIT)


# ``twincat-lists``: compensation value lists of the TwinCAT CNC axes (TF5200): leadscrew, cross and plane tables.
#
# Source: Beckhoff TF5200 "Axis compensation" and "Axis compensation parameters" (P-COMP-00001 ... 00061). The sign of
# cross and plane tables is not publicly documented; it is the setting ``cross_sign``.


_LARGEST_SGN32 = 2.0**31 - 1


class TwincatLists(TableController[TwincatSettings, TwincatTables]):
    """TwinCAT CNC axis lists: one file per axis."""

    name = "twincat-lists"
    settings_class = TwincatSettings
    bidirectional = True

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return pitch, one cross function and one plane of products per slave axis."""
        terms = [term for slave in range(3) for term in self._terms_of(slave, errors)]
        return [continued(term, self.machine.axes[term.axis or 0].range_mm) for term in terms]

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> TwincatTables:
        """Return the tables in 0.1 um, with the signs stored on the control."""
        # cross and plane tables of zeros are left out
        return TwincatTables({slave: self._list_of(slave, basis, values) for slave in range(3)})

    def with_reversal(self, tables: TwincatTables, reversal: ReversalCurves) -> TwincatTables:
        """Return the tables with a bilateral leadscrew table for the reversal of each axis along itself."""
        lists = dict(tables.lists)
        for (axis, _), curve in sorted(reversal.curves.items()):
            screw = lists[axis].screw
            if screw is not None and np.max(np.abs(curve.value)) >= WORTH_MM:
                nodes = screw.nodes
                if len(curve.position_mm) > 1:
                    between = np.interp(curve.position_mm, nodes * MM_PER_UNIT, curve.at(nodes * MM_PER_UNIT))
                    if np.max(np.abs(between - curve.value)) > WORTH_MM:
                        inside = np.clip(np.rint(curve.position_mm / MM_PER_UNIT), nodes[0], nodes[-1])
                        nodes = np.unique(np.concatenate([nodes, inside]))
                # reversal B: after positive travel -B/2 is added to the command, after negative travel +B/2
                base = np.round(np.interp(nodes, screw.nodes, screw.positive), self.settings.digits)
                half = self._rounded(0.5 * self.settings.screw_factor * curve.at(nodes * MM_PER_UNIT))
                interval = screw.interval if len(nodes) == len(screw.nodes) else 0.0
                lists[axis] = replace(lists[axis], screw=leadscrew(axis, nodes, base - half, base + half, interval))
        return TwincatTables(lists)

    def context(self, tables: TwincatTables) -> dict[str, Any]:
        """Return the lists with their numbers, the sign conventions with an example, and the parameters to set."""
        return {
            "sign_statement": f"{self._screw_statement()} {self._cross_statement()}",
            "screw_statement": self._screw_statement(),
            "cross_statement": self._cross_statement(),
            "cross_sign": self.settings.cross_sign,
            "ssfk_sign": self.settings.ssfk_sign,
            "parameters": self._parameters(tables),
            "warnings": self._warnings(tables),
            "overwrites": [
                "Of other axes: nothing.",
                "The complete compensation lists of X, Y and Z: anything else in the old lists, e.g. a table over a rotary axis, "
                "is lost.",
            ],
            "digits": self.settings.digits,
            "n_cycles": self.settings.n_cycles,
            "lists": [self._list_context(axis, tables.lists.get(axis, AxisList())) for axis in range(3)],
        }

    def parse(self, files: Sequence[SourceFile]) -> TwincatTables:
        """Read the lists of one or more axes, in any order."""
        if not files:
            raise InputError("no axis list was given; give a list such as achskw1.lis")
        return self._parsed(files, None)

    def parse_foreign(self, files: Sequence[SourceFile]) -> tuple[TwincatTables, list[str]]:
        """Read lists from a real control: reserved entries and other structures are skipped, other axes are noted."""
        foreign = Findings()
        tables = self._parsed(files, foreign)
        if not any(item != AxisList() for item in tables.lists.values()):
            raise files[0].fail("; ".join(["contains no table for an axis of the machine file", *foreign.statements()]))
        return tables, foreign.statements()

    def _parsed(self, files: Sequence[SourceFile], foreign: Findings | None) -> TwincatTables:
        lists: dict[int, AxisList] = {}
        seen: dict[int, SourceFile] = {}
        for source in files:
            axis, item = parse_axis_list(
                source, self.settings.axis_names, self.settings.logical_axes, self.settings.increment_mm, foreign
            )
            if axis is None:
                continue
            if axis in seen:
                raise source.fail(f"is a second list for axis {AXES[axis]}; the first is {seen[axis].path.name}")
            lists[axis], seen[axis] = item, source
        return TwincatTables(lists)

    def curves(self, tables: TwincatTables) -> list[Table1D]:
        """Return the leadscrew and cross tables with the signs of the settings."""
        screw_mm, cross_mm = self.settings.screw_factor * MM_PER_UNIT, self.settings.cross_factor * MM_PER_UNIT
        screws = [replace(item.screw, value_mm=screw_mm) for item in tables.lists.values() if item.screw is not None]
        return screws + [
            replace(item.cross, value_mm=cross_mm) for item in tables.lists.values() if item.cross is not None
        ]

    def grids(self, tables: TwincatTables) -> list[TableGrid]:
        """Return the planes with the sign of the settings."""
        value_mm = self.settings.cross_factor * MM_PER_UNIT
        return [replace(item.plane, value_mm=value_mm) for item in tables.lists.values() if item.plane is not None]

    def emulate(self, tables: TwincatTables, points: Points) -> FloatArray:
        """Return the sum of all tables of each axis with the signs of the settings.

        A bilateral leadscrew table needs the last direction of travel; if that is unknown, the mean of both directions
        is used and a CompgenWarning is issued.
        """
        for table in self.curves(tables):
            if table.negative is not None and np.any(travel_of(points, table.axis) == 0):
                message = (
                    f"kw.ssfk of {AXES[table.axis]} has values for both directions of travel, but some points do not state "
                    "the direction of approach: the mean of both is used there. Give approach_x, approach_y, approach_z"
                )
                warnings.warn(message, CompgenWarning, stacklevel=2)
        return super().emulate(tables, points)

    def by_direction(self, tables: TwincatTables) -> bool:
        """Return whether a leadscrew table has values for both directions of travel."""
        return any(table.negative is not None for table in self.curves(tables))

    def violations(self, tables: TwincatTables) -> list[str]:
        """Return tables with too many points, numbers that do not fit, travel not covered, missing lists."""
        settings = self.settings
        found = [
            f"no list for axis {AXES[axis]} ({settings.logical_axes[axis]}) was given"
            for axis in range(3)
            if axis not in tables.lists
        ]
        for axis, item in sorted(tables.lists.items()):
            found += [
                f"{use.name}: {use.used:g}; the control accepts {use.allowed:g}"
                for use in list_usage(AXES[axis], item, settings.most)
                if use.used > use.allowed
            ]
            found += [
                message
                for what, over, nodes in spans_mm(item, axis)
                for message in self.not_covered(over, nodes, f"{what} of {AXES[axis]}")
            ]
            numbers = item.numbers
            if not settings.real64 and np.any(numbers != np.round(numbers)):
                found.append(
                    f"the list of {AXES[axis]} has numbers with decimals; number_type SGN32 allows whole numbers only"
                )
            if np.any(np.abs(numbers) > _LARGEST_SGN32):
                found.append(f"the list of {AXES[axis]} has numbers beyond {_LARGEST_SGN32:g}")
        return found

    def usage(self, tables: TwincatTables) -> list[Usage]:
        """Return the points of every table against the limits of the control."""
        return [
            use
            for axis, item in sorted(tables.lists.items())
            for use in list_usage(AXES[axis], item, self.settings.most)
        ]

    def resolution_mm(self) -> float:
        """Half of the last digit of each of the three tables that act on one axis."""
        return 3 * 0.5 * 10.0**-self.settings.digits * MM_PER_UNIT

    def _masters_for(self, slave: int, errors: ErrorTable) -> tuple[int, tuple[int, int] | None]:
        """Return the master of the cross table and those of the plane: the pair with the largest products."""
        machine = self.machine
        probe = [np.linspace(*axis.range_mm, 41) for axis in machine.axes]
        others = [axis for axis in range(3) if axis != slave]
        pairs = [(slave, axis) for axis in others]
        curves = one_dimensional_terms(machine, errors, probe, pairs, lever_origin_mm=machine.reference_point_mm)
        sizes = [float(np.std(term.start)) for term in curves]
        plane = self.settings.planes[slave] if self.settings.crosscomp2 else None
        if isinstance(plane, str):  # "auto"
            captured: dict[tuple[int, int], float] = {}
            for term in product_terms(machine, errors, probe, (0.5 * (machine.lower_mm + machine.upper_mm)).tolist()):
                if term.carrier[0].output == slave:
                    # rms over the volume of the product, without the part that functions of one axis can represent
                    length = machine.axes[term.carrier[0].lever or 0].length_mm
                    size = float(np.std(term.start)) * length / math.sqrt(12.0)
                    captured[_masters(term)] = captured.get(_masters(term), 0.0) + size**2
            plane = max(captured, key=lambda pair: captured[pair], default=None)
            if plane is None or captured[plane] <= NOTHING_MM**2:
                plane = (others[0], others[1]) if min(sizes) > NOTHING_MM else None
        # the cross table uses the axis that the plane leaves out, else the axis with the larger function
        free = [axis for axis in others if plane is not None and axis not in plane]
        return free[0] if free else others[int(np.argmax(sizes))], plane

    def _terms_of(self, slave: int, errors: ErrorTable) -> list[Term]:
        """Return the terms of one slave: leadscrew, cross table, then function and products of its plane."""
        machine, settings, origin = self.machine, self.settings, self.machine.reference_point_mm
        cross, plane = self._masters_for(slave, errors)
        if settings.own_setpoints:
            screw_mm = self._cross_nodes_mm(errors, slave)
        else:
            most = settings.most.ssfk - 1
            grid = equidistant_grid(machine, errors, slave, most=most, loss_mm=settings.loss_mm, output=slave)
            screw_mm = self._even_units(slave, float(grid.step) / MM_PER_UNIT) * MM_PER_UNIT
        found = []
        for axis, nodes_mm in ((slave, screw_mm), (cross, self._cross_nodes_mm(errors, cross))):
            found += one_dimensional_terms(machine, errors, [nodes_mm] * 3, [(slave, axis)], lever_origin_mm=origin)
        if plane is None:
            return found
        # one spacing for both masters, within the limit of the control
        points = settings.most.crosscomp2
        grids = [
            equidistant_grid(
                machine, errors, axis, most=max(3, points // 2 - 1), loss_mm=settings.loss_mm, output=slave
            )
            for axis in plane
        ]
        step = min(float(grid.step) for grid in grids) / MM_PER_UNIT
        while True:
            first, second = (self._even_units(axis, step) for axis in plane)
            if len(first) * len(second) <= points:
                break
            step *= 1.02
        nodes = [np.zeros(1)] * 3
        nodes[plane[0]], nodes[plane[1]] = first * MM_PER_UNIT, second * MM_PER_UNIT
        pairs = [(slave, axis) for axis in plane if axis not in (slave, cross)]
        found += one_dimensional_terms(machine, errors, nodes, pairs, lever_origin_mm=origin)
        products = product_terms(machine, errors, nodes, origin)
        return found + [t for t in products if t.carrier[0].output == slave and set(_masters(t)) == set(plane)]

    def _cross_nodes_mm(self, errors: ErrorTable, axis: int) -> FloatArray:
        most = min(self.settings.most.crosscomp, self.settings.most.ssfk)
        nodes_mm = uneven_nodes_mm(self.machine, errors, axis, loss_mm=self.settings.loss_mm, most=most)
        return units_outwards(self.machine, axis, nodes_mm) * MM_PER_UNIT

    def _even_units(self, axis: int, step: float) -> FloatArray:
        """Return equidistant nodes in whole units of 0.1 um that cover the travel of an axis."""
        low, high = (end / MM_PER_UNIT for end in self.machine.axes[axis].range_mm)
        start, distance = math.floor(low + 1e-3), max(1, round(step))
        count = max(1, math.ceil((high - 1e-3 - start) / distance)) + 1
        return np.asarray(start + distance * np.arange(count), dtype=np.float64)

    def _list_of(self, slave: int, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> AxisList:
        screw_term, cross_term, *plane_terms = (term for term in basis if term.carrier[0].output == slave)
        cross = cross_table(
            slave,
            int(cross_term.axis or 0),
            _units(cross_term.nodes_mm),
            self._rounded(self.settings.cross_factor * values[cross_term.name]),
        )
        plane = None
        if plane_terms:
            # first and second master as in the machine file, else in the order X, Y, Z
            stated = self.settings.planes[slave]
            axes = {axis for term in plane_terms for axis in (term.axis, term.carrier[0].lever) if axis is not None}
            masters = stated if isinstance(stated, tuple) else sorted(axes if len(axes) == 2 else {*axes, cross.axis})
            one, other = masters
            step = float(np.diff(_units(plane_terms[0].nodes_mm))[0])
            lines = [self._even_units(axis, step) for axis in (one, other)]
            lines_mm = {axis: line * MM_PER_UNIT for axis, line in zip((one, other), lines, strict=True)}
            # bilinear between nodes, like each of the terms
            total = field_on_grid(plane_terms, values, lines_mm, np.zeros(3))[..., slave].T
            numbers = self._rounded(self.settings.cross_factor * total)
            plane = plane_table(slave, (one, other), (float(lines[0][0]), float(lines[1][0])), step, numbers)
        nodes = _units(screw_term.nodes_mm)
        return AxisList(
            leadscrew(
                slave,
                nodes,
                self._rounded(self.settings.screw_factor * values[screw_term.name]),
                interval=0.0 if self.settings.own_setpoints else float(nodes[1] - nodes[0]),
            ),
            cross if np.any(cross.positive) else None,
            plane if plane is not None and np.any(plane.values) else None,
        )

    def _rounded(self, values_mm: FloatArray) -> FloatArray:
        """Return values in 0.1 um, rounded as written to the file."""
        return np.round(np.asarray(values_mm) / MM_PER_UNIT, self.settings.digits) + 0.0

    def _screw_statement(self) -> str:
        if self.settings.ssfk_sign == "error":
            return (
                "kw.ssfk is actual minus nominal in 0.1 um, which the control subtracts: 21 at 100 mm means that the axis is "
                "0.0021 mm too far in the positive direction; the control then commands 99.9979 mm."
            )
        return "kw.ssfk is what the control adds, in 0.1 um: with 21 at 100 mm it commands 100.0021 mm."

    def _cross_statement(self) -> str:
        settings = self.settings
        added, sign = ("added to", "+") if settings.cross_sign == "correction" else ("subtracted from", "-")
        return (
            f"Values of kw.crosscomp and kw.crosscomp2 are {added} the command of the slave (cross_sign = "
            f'"{settings.cross_sign}"): 50 moves it by {sign}0.0050 mm.'
        )

    def _parameters(self, tables: TwincatTables) -> list[dict[str, object]]:
        settings = self.settings
        rows: list[tuple[str, object, str]] = []
        for axis, item in sorted(tables.lists.items()):
            where = f"axis parameter list of {AXES[axis]} (axis {settings.logical_axes[axis]})"
            for name, table in (("ssfk", item.screw), ("crosscomp", item.cross), ("crosscomp2", item.plane)):
                active = 1 if table is not None else 0
                rows.append((f"lr_param.{name} ({AXES[axis]})", active, where))
            if item.screw is not None and item.screw.negative is not None:
                meaning = "bilateral table: it contains the backlash, so backlash compensation of this axis must be off"
                rows.append((f"backlash compensation ({AXES[axis]})", "off", meaning))
                meaning = "cycles over which the change at a reversal is spread"
                rows.append((f"lr_param.n_backlash_cyc ({AXES[axis]})", "as required", meaning))
            for kind, used in point_counts(item).items():
                if used > (usual := getattr(PointLimits(), kind)):
                    meaning = f"this table has {used} points, more than the usual {usual}"
                    rows.append((f"kw.{kind}.max_points ({AXES[axis]})", f">= {used + 1}", meaning))
        return [{"name": name, "value": value, "meaning": meaning} for name, value, meaning in rows]

    def _warnings(self, tables: TwincatTables) -> list[str]:
        settings = self.settings
        found: list[str] = []
        if any(item.cross or item.plane for item in tables.lists.values()):
            found.append(
                f'cross_sign = "{settings.cross_sign}": no public document says whether kw.crosscomp and kw.crosscomp2 are '
                "added or subtracted. Do section 3 of the preflight list before you use them, and enter the result "
                "in the machine file."
            )
        slaves = [
            AXES[axis]
            for axis, item in sorted(tables.lists.items())
            if item.plane is not None and axis in item.plane.axes
        ]
        if slaves:
            found.append(
                f"The plane of {', '.join(slaves)} has its own slave as a master; this is documented for the older CNC builds."
            )
        idle = [
            AXES[axis]
            for axis, item in tables.lists.items()
            if not (item.cross or item.plane or (item.screw and (any(map(np.any, item.screw.columns)))))
        ]
        if idle:
            found.append(f"The tables of {', '.join(idle)} are zero everywhere.")
        return found

    def _list_context(self, axis: int, item: AxisList) -> dict[str, Any]:
        numbers = self.settings.logical_axes
        context: dict[str, Any] = {
            "letter": AXES[axis],
            "number": numbers[axis],
            "name": self.settings.axis_names[axis],
            "screw": None,
            "cross": None,
            "plane": None,
        }
        # number of entries that the template writes; it reveals a truncated file
        entries = 2
        if (screw := item.screw) is not None:
            context["screw"] = {
                "interval": screw.interval,
                "start": screw.nodes[0],
                "setpoints": [] if screw.interval else screw.nodes.tolist(),
                "pos": screw.positive.tolist(),
                "neg": [] if screw.negative is None else screw.negative.tolist(),
            }
            entries += 6 + sum(len(context["screw"][column]) for column in ("setpoints", "pos", "neg"))
        if (cross := item.cross) is not None:
            rows = list(zip(cross.nodes.tolist(), cross.positive.tolist(), strict=True))
            context["cross"] = {"master": numbers[cross.axis], "letter": AXES[cross.axis], "rows": rows}
            entries += 4 + 2 * len(rows)
        if (plane := item.plane) is not None:
            context["plane"] = {
                "masters": [numbers[master] for master in plane.axes],
                "letters": [AXES[master] for master in plane.axes],
                "starts": plane.start.tolist(),
                "interval": plane.step,
                "values": plane.values[..., 0].T.tolist(),
            }
            entries += 9 + plane.values.size
        return {**context, "entries": entries}
