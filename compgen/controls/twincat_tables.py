"""Axis lists of the TwinCAT CNC (TF5200): leadscrew, cross and plane tables, their lookup, and reading them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from compgen.controls.shared.base import SourceFile, Usage
from compgen.controls.shared.scanner import Findings, check_complete, content_lines, fixed_point
from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.messages import nearest
from compgen.data.names import AXES
from compgen.data.toml_files import setting, whole
from compgen.errors import InputError

# Axis lists of the TwinCAT CNC (TF5200): leadscrew, cross and plane tables as the control keeps them, and their lookup.
#
# Numbers stay in the unit of the files, 0.1 um (``unit 1``). Source: Beckhoff TF5200 "Axis compensation" (308687883,
# 308709003, 15327290891) and its parameters P-COMP-00004 ... P-COMP-00033.


#: 0.1 um in mm.
MM_PER_UNIT = 1e-4


@dataclass(frozen=True)
class LeadscrewTable:
    """``kw.ssfk``: values over the axis' own position, ``neg`` for negative travel (None: one table for both).

    ``setpoints`` (n,) ascend; ``interval`` is their distance, or 0 if each is in the file. All in 0.1 um.
    """

    setpoints: FloatArray
    pos: FloatArray
    neg: FloatArray | None = None
    interval: float = 0.0

    def at(self, along: FloatArray, direction: FloatArray) -> FloatArray:
        """Value at positions (n,) reached in directions (n,) (+1, -1, 0: unknown, the mean), end values held outside."""
        pos = np.interp(along, self.setpoints, self.pos)
        if self.neg is None:
            return pos
        neg = np.interp(along, self.setpoints, self.neg)
        return np.asarray(0.5 * (pos + neg) + 0.5 * np.sign(direction) * (pos - neg))


@dataclass(frozen=True)
class CrossTable:
    """``kw.crosscomp`` of a slave axis: values over the command position of axis ``master`` (0..2), in 0.1 um."""

    master: int
    setpoints: FloatArray
    values: FloatArray

    def at(self, along: FloatArray) -> FloatArray:
        """Value at positions (n,), end values held outside."""
        return np.interp(along, self.setpoints, self.values)


@dataclass(frozen=True)
class PlaneTable:
    """``kw.crosscomp2`` of a slave axis: values [j, i] with i along ``masters[0]`` and j along ``masters[1]``, 0.1 um.

    ``starts`` are the positions of i = 0 and j = 0; both axes have the distance ``interval``.
    """

    masters: tuple[int, int]
    starts: tuple[float, float]
    interval: float
    values: FloatArray

    def nodes(self, place: int) -> FloatArray:
        """Positions of the columns (``place`` 0: first master) or rows (1: second master), 0.1 um."""
        return np.asarray(
            self.starts[place] + self.interval * np.arange(self.values.shape[1 - place]), dtype=np.float64
        )

    def at(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Value at positions (n,) of both masters: bilinear between four corners, values of the margin held outside."""
        (i, u), (j, v) = (
            _cell(along, start, self.interval, count)
            for along, start, count in zip((first, second), self.starts, self.values.shape[::-1], strict=True)
        )
        i_next, j_next = np.minimum(i + 1, self.values.shape[1] - 1), np.minimum(j + 1, self.values.shape[0] - 1)
        low = (1.0 - u) * self.values[j, i] + u * self.values[j, i_next]
        high = (1.0 - u) * self.values[j_next, i] + u * self.values[j_next, i_next]
        return np.asarray((1.0 - v) * low + v * high)


def _cell(along: FloatArray, start: float, interval: float, count: int) -> tuple[np.ndarray, FloatArray]:
    ratio = np.clip((along - start) / interval, 0.0, count - 1)
    cell = np.minimum(ratio.astype(np.intp), max(count - 2, 0))
    return cell, ratio - cell


@dataclass(frozen=True)
class AxisList:
    """The tables in the list of one axis, which is the slave of ``cross`` and ``plane``."""

    screw: LeadscrewTable | None = None
    cross: CrossTable | None = None
    plane: PlaneTable | None = None

    @property
    def numbers(self) -> FloatArray:
        """Every position and value of the tables, shape (n,)."""
        parts: list[FloatArray | None] = [np.zeros(1)]
        if self.screw is not None:
            parts += [self.screw.setpoints, self.screw.pos, self.screw.neg]
        if self.cross is not None:
            parts += [self.cross.setpoints, self.cross.values]
        if self.plane is not None:
            parts += [np.array([*self.plane.starts, self.plane.interval]), self.plane.values]
        return np.concatenate([np.ravel(part) for part in parts if part is not None])


@dataclass(frozen=True)
class TwincatTables:
    """The lists of the axes 0..2."""

    lists: Mapping[int, AxisList]


@dataclass(frozen=True)
class PointLimits:
    """Largest number of points of each kind of table; builds without P-COMP-00059 ... 61 have the defaults."""

    ssfk: int = setting(whole(2, 100_000), 1500)
    crosscomp: int = setting(whole(2, 100_000), 1001)
    crosscomp2: int = setting(whole(4, 100_000), 10201)


def point_counts(item: AxisList) -> dict[str, int]:
    """Return the number of points of each table of a list, by its structure (``ssfk``, ``crosscomp``, ``crosscomp2``)."""
    counts = {} if item.screw is None else {"ssfk": len(item.screw.setpoints)}
    counts |= {} if item.cross is None else {"crosscomp": len(item.cross.setpoints)}
    return counts | ({} if item.plane is None else {"crosscomp2": item.plane.values.size})


def list_usage(name: str, item: AxisList, most: PointLimits) -> list[Usage]:
    """Return the points of one list (``name``: the axis) against what the control takes."""
    return [
        Usage(f"points of kw.{kind} of {name}", used, getattr(most, kind), "points")
        for kind, used in point_counts(item).items()
    ]


def spans_mm(item: AxisList, axis: int) -> list[tuple[str, int, FloatArray]]:
    """Return (structure, axis of the argument, its positions in mm) of every table in the list of ``axis``."""
    found: list[tuple[str, int, FloatArray]] = []
    if item.screw is not None:
        found.append(("kw.ssfk", axis, item.screw.setpoints * MM_PER_UNIT))
    if item.cross is not None:
        found.append(("kw.crosscomp", item.cross.master, item.cross.setpoints * MM_PER_UNIT))
    if item.plane is not None:
        found += [
            ("kw.crosscomp2", master, item.plane.nodes(place) * MM_PER_UNIT)
            for place, master in enumerate(item.plane.masters)
        ]
    return found


def stored_sums(item: AxisList, axis: int, position_mm: FloatArray, approach: FloatArray) -> tuple[FloatArray, ...]:
    """Return what ``ssfk`` and what the cross and plane tables of an axis hold at positions (n, 3), each (n,), mm."""
    along = np.asarray(position_mm) / MM_PER_UNIT
    screw, cross = np.zeros(len(along)), np.zeros(len(along))
    if item.screw is not None:
        screw = item.screw.at(along[:, axis], approach[:, axis])
    if item.cross is not None:
        cross = cross + item.cross.at(along[:, item.cross.master])
    if item.plane is not None:
        first, second = item.plane.masters
        cross = cross + item.plane.at(along[:, first], along[:, second])
    return screw * MM_PER_UNIT, cross * MM_PER_UNIT


def units_outwards(machine: Machine, axis: int, positions_mm: FloatArray) -> FloatArray:
    """Return positions (n,) in whole units of 0.1 um that still cover the travel where they did."""
    low, high = (end / MM_PER_UNIT for end in machine.axes[axis].range_mm)
    units = np.rint(positions_mm / MM_PER_UNIT)
    units[0] = min(units[0], np.floor(low + 1e-3)) if positions_mm[0] <= machine.axes[axis].range_mm[0] else units[0]
    units[-1] = (
        max(units[-1], np.ceil(high - 1e-3)) if positions_mm[-1] >= machine.axes[axis].range_mm[1] else units[-1]
    )
    return np.unique(units)


# Reading the axis lists of the TwinCAT CNC (``achskw*.lis``): one ``key value`` a line, strictly.
#
# ``#`` starts a comment line, ``/* ... */`` a comment behind a value. Key grammar::
#
#     kopf.achs_nr | kopf.log_achs_name | kw.<structure>.<parameter> | kw.<structure>.table[i].<parameter>
#     kw.crosscomp2.table[j][i].correction            j: second master


_SPACED_INDEX = re.compile(r"\[\s{0,9}([0-9]{1,6})\s{0,9}\]")
_KEY = re.compile(r"([a-z0-9_]{1,20})\.([a-z0-9_.]{1,60})((?:\[[0-9]{1,6}\]){0,2})(?:\.([a-z0-9_]{1,30}))?")
_SWITCHES = ("max_points", "manual_activation")
#: Parameters of each structure, those of its table with the number of their indices.
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
                raise self.source.fail(f"{structure}.{name} is missing; was the file cut?")
            return default
        return self.value(f"{structure}.{name}", entry)

    def value(self, label: str, entry: _Entry) -> float:
        """Return the number of an entry, or the error that says why it is none."""
        number = float(fixed_point(self.source, entry.line, entry.value, label))
        if abs(number) > 2.0**53:
            raise self.source.fail(f"{label}: {number:g} is beyond the whole numbers of the control", entry.line)
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
        """Return the axis 0..2 that a logical axis number means."""
        number = self.whole(structure, name, 0, 65535)
        if number not in self.logical_axes:
            known = ", ".join(map(str, self.logical_axes))
            raise self.fail(structure, name, f"no axis has the logical number {number}; logical_axes has {known}")
        return self.logical_axes.index(number)

    def column(self, structure: str, name: str, shape: tuple[int, ...]) -> FloatArray:
        """Return a column of the table of a structure with every index from 0 on, shape ``shape``."""
        entries = self.tables.get((structure, name), {})
        result = np.zeros(shape)
        for index, entry in entries.items():
            if any(k >= n for k, n in zip(index, shape, strict=True)):
                places = "".join(f"[0 ... {n - 1}]" for n in shape)
                raise self.source.fail(f"{_label(structure, name, index)}: the table goes over {places}", entry.line)
            result[index] = self.value(_label(structure, name, index), entry)
        if len(entries) != result.size:
            missing = next(index for index in np.ndindex(*shape) if index not in entries)
            raise self.source.fail(f"{_label(structure, name, missing)} is missing; was the file cut?")
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

    ``increment_mm`` are the encoder increments of the axes for lists with ``unit 0``. With ``foreign`` the list is that of
    another program: comments hold any character, reserved entries and other structures are passed over, and the axis is
    None where the machine file does not have it.
    """
    if foreign is not None:
        source = SourceFile(source.path, source.text.encode("ascii", "replace").decode().replace("\0", "?"))
    body = _Body(source, axis_names, logical_axes, increment_mm, foreign)
    count = 0
    for line, text in content_lines(source, "#"):
        code, start, rest = text.partition("/*")
        _, end, behind = rest.partition("*/")
        if start and (not end or behind.strip()):
            raise source.fail("a comment /* ... */ ends on its line, with nothing after it", line)
        if code.strip():
            _take(body, line, code.strip())
            count += 1
    if not count:
        raise source.fail("holds no entry; is it the right file?")
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
    """Whether a logical axis number is none of the machine file's."""
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
    """What an entry of another program's list is that has no bearing on the three tables; empty if it has."""
    if head in _TABLES:
        return f"reserved entries of {head}" if _RESERVED.fullmatch(name) else ""
    return "" if head == "kopf" and name in _KNOWN["kopf"] else f"entries of {head}"


def _unknown(body: _Body, line: int, key: str) -> InputError:
    known = [f"{head}.{name}" for head, names in _KNOWN.items() for name in names]
    known += [_label(head, name, [0] * count) for head, (count, names) in _TABLES.items() for name in names]
    return body.source.fail(f"{key[:60]!r} is not a parameter of these lists; {nearest(key[:60], known)}", line)


def _values(body: _Body, structure: str, axis: int, values: FloatArray) -> FloatArray:
    """Values of a table in 0.1 um: ``unit`` 1 as they are, 0 in encoder increments of the axis; positions are not concerned."""
    if body.whole(structure, "unit", 0, 1) == 1 or not np.any(values):
        return values
    length_mm = body.increment_mm[axis]
    if length_mm is None:
        raise body.fail(
            structure,
            "unit",
            f"0 means that the values are encoder increments, whose length the list does not hold: state it in the machine "
            f"file, e.g. increment_um = {{ {AXES[axis]} = 0.1 }}, or write unit 1 and values in 0.1 um",
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
        raise body.fail(name, "modulo", "1 belongs to rotary axes; the model has three linear ones")
    count = body.whole(name, "kw_nr_max", 1, _MOST_POINTS)
    interval = body.number(name, "interval")
    if interval < 0:
        raise body.fail(name, "interval", f"{interval:g} is negative")
    if interval:
        setpoints = np.asarray(body.number(name, "kw_startpos") + interval * np.arange(count), dtype=np.float64)
        _refuse(body, name, "setpoint", "an equidistant table (interval above 0) has no setpoints")
    else:
        setpoints = _ascending(body, name, body.column(name, "setpoint", (count,)))
    pos = body.column(name, "pos", (count,))
    two_sided = body.whole(name, "bilateral", 0, 1, 0) == 1
    if two_sided or (name, "neg") in body.tables:
        neg = body.column(name, "neg", (count,))
    other = _values(body, name, axis, neg) if two_sided else None
    return LeadscrewTable(setpoints, _values(body, name, axis, pos), other, interval)


def _refuse(body: _Body, structure: str, name: str, message: str) -> None:
    for index, entry in body.tables.get((structure, name), {}).items():
        raise body.source.fail(f"{_label(structure, name, index)}: {message}", entry.line)


def _cross(body: _Body, axis: int) -> CrossTable:
    name = "kw.crosscomp"
    count = body.whole(name, "last_index", 0, _MOST_POINTS - 1) + 1
    setpoints = _ascending(body, name, body.column(name, "setpoint", (count,)))
    values = _values(body, name, axis, body.column(name, "correction", (count,)))
    return CrossTable(body.axis(name, "master_ax_nr"), setpoints, values)


def _plane(body: _Body, axis: int) -> PlaneTable:
    name = "kw.crosscomp2"
    first, second = (body.whole(name, f"last_index_master{k}", 0, _MOST_POINTS - 1) + 1 for k in (1, 2))
    if first * second > _MOST_POINTS:
        raise body.fail(name, "last_index_master2", f"gives {first} x {second} points; at most {_MOST_POINTS} are read")
    interval = body.number(name, "interval")
    if interval <= 0:
        raise body.fail(name, "interval", f"{interval:g} is not above zero (the control's error 70430)")
    masters = (body.axis(name, "master1_ax_nr"), body.axis(name, "master2_ax_nr"))
    if masters[0] == masters[1]:
        raise body.fail(name, "master2_ax_nr", "is the first master too; a plane needs two axes")
    starts = (body.number(name, "start_position_master1"), body.number(name, "start_position_master2"))
    values = _values(body, name, axis, body.column(name, "correction", (second, first)))
    return PlaneTable(masters, starts, interval, values)
