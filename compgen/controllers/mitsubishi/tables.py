"""Numbers of machine error compensation: tables read from text, the curves they mean, the limits they must keep.

Increment system, E60/E68 manual p. II-292 and C64 manual 9.2. On the positive side of the reference point the value of
point n is (division interval - actual movement) x 2 for a feed from n-1 to n, on the negative side (division interval +
actual movement) x 2 for a feed from n+1 to n. So with the curve A in units of output, zero at the reference number,

    A[n] = A[n-1] + v[n] on the positive side,   A[n] = A[n+1] - v[n] on the negative side.

In the absolute system (#4000 = 0) the value of a point is A itself, but for a constant: what stands at the reference number
shifts the zero of the axis and nothing else. That system holds for the sets of all axes.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from compgen.controllers.base import SourceFile, Usage, coverage_violations
from compgen.controllers.mitsubishi.records import (
    BASE,
    FIRST_NUMBER,
    INTERVAL,
    MOST_NUMBER,
    NEGATIVE,
    OUTPUT,
    POSITIVE,
    REFERENCE,
    SCALE,
    SET_STEP,
    SETS,
    SYSTEM,
    Entry,
    by_number,
    file_entries,
    is_parameter_file,
    sheet_entries,
)
from compgen.controllers.mitsubishi.settings import HIGHEST_VALUE, LOWEST_VALUE, MitsubishiSettings
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.core.text import one_line
from compgen.errors import CompgenWarning, InputError


@dataclass(frozen=True)
class SetTable:
    """One set: the axis ``output`` is corrected as a function of the axis ``base``.

    ``values`` are the numbers as stored for ``first`` ... ``last``; ``reference`` is the number at the reference point;
    ``absolute`` tells how they count; ``index`` is the place of the set, 0 to 9.
    """

    base: int
    output: int
    reference: int
    first: int
    values: tuple[int, ...]
    scale: int
    interval_mm: Decimal
    absolute: bool = False
    index: int = 0

    @property
    def last(self) -> int:
        """Farthest number on the positive side."""
        return self.first + len(self.values) - 1

    @property
    def curve(self) -> NDArray[np.int64]:
        """Curve A in counts at the numbers ``first`` ... ``last``, zero at the reference number, shape (n,)."""
        at = self.reference - self.first
        values = np.array(self.values, dtype=np.int64)
        if self.absolute:
            return np.asarray(values - values[at], dtype=np.int64)
        above = np.cumsum(values[at + 1 :])
        below = -np.cumsum(values[:at][::-1])[::-1]
        return np.concatenate([below, [0], above]).astype(np.int64)

    @property
    def at_reference(self) -> int:
        """Value at the reference number."""
        return self.values[self.reference - self.first]

    @property
    def along_mm(self) -> FloatArray:
        """Positions of the numbers from the reference point, shape (n,), mm."""
        return np.array([float((self.first + k - self.reference) * self.interval_mm) for k in range(len(self.values))])


@dataclass(frozen=True)
class Shortfall:
    """How far the limit of the values keeps a table from what was wanted, in counts."""

    output: int
    base: int
    missed_counts: float


@dataclass(frozen=True)
class MitsubishiTables:
    """All sets of X, Y, Z; ``shortfalls`` is known of tables that were built.

    ``others`` are the sets of other axes in a parameter file, as (name, first, last number); ``remarks`` say what reading
    kept apart and passed over.
    """

    sets: tuple[SetTable, ...]
    shortfalls: tuple[Shortfall, ...] = field(default=(), compare=False)
    others: tuple[tuple[str, int, int], ...] = field(default=(), compare=False)
    remarks: tuple[str, ...] = field(default=(), compare=False)


def values_of(curve: NDArray[np.int64], at: int, at_reference: int = 0, *, absolute: bool = False) -> tuple[int, ...]:
    """Return the numbers for a curve (n,) in counts that is zero at the index ``at``, where ``at_reference`` is stored."""
    if absolute:
        return tuple(int(value) + at_reference for value in curve)
    steps = np.diff(curve)
    return tuple(int(value) for value in (*steps[:at], at_reference, *steps[at:]))


def parse_tables(settings: MitsubishiSettings, files: Sequence[SourceFile]) -> MitsubishiTables:
    """Read set sheets, or the control's own parameter file; files that end in ``.json`` (the plan) are left out.

    A parameter file beside a sheet must hold the same tables.
    """
    texts = [file for file in files if file.path.suffix.lower() != ".json"]
    if not texts:
        raise InputError("no set sheet or parameter file is given", file=files[0].path if files else None)
    own = [file for file in texts if is_parameter_file(file)]
    sheets = [file for file in texts if not is_parameter_file(file)]
    if len(own) > 1:
        raise own[1].fail("a second parameter file; one is expected")
    if not own:
        return _sets_of(settings, sheets[0], by_number([entry for file in sheets for entry in sheet_entries(file)]))
    entries, passed_over = file_entries(own[0])
    found = _sets_of(settings, own[0], by_number(entries), passed_over)
    if sheets and parse_tables(settings, sheets).sets != found.sets:
        raise own[0].fail(f"does not hold the same tables as {sheets[0].path.name} beside it")
    return found


def _sets_of(
    settings: MitsubishiSettings, file: SourceFile, entries: dict[int, Entry], passed_over: int | None = None
) -> MitsubishiTables:
    """Tables of the entries of a sheet, or (``passed_over`` is not None) of a parameter file of the control."""
    if SYSTEM not in entries:
        raise file.fail(f"#{SYSTEM} (absolute or increment system) is missing", 1)
    absolute = entries[SYSTEM].whole(0, 1) == 0
    if settings.absolute is not None and absolute != settings.absolute:
        stated = "absolute" if settings.absolute else "incremental"
        raise entries[SYSTEM].fail(
            f"{int(not absolute)} is the {'absolute' if absolute else 'increment'} system, but mode = {stated!r} is stated or is "
            "that of the control's file"
        )
    sets, others = [], []
    for number in range(1, SETS + 1):
        table, name = _set_table(settings, entries, number, absolute, passed_over is not None)
        sets += [] if table is None else [table]
        others += [] if name is None else [(f"set {number} of {name[0]}", *name[1])]
    if not sets:
        raise file.fail(f"holds no set of the axes {', '.join(settings.axis_names)} (#4001, #4011, ...)", 1)
    if passed_over is None:
        return MitsubishiTables(tuple(sets))
    system = "absolute values" if absolute else "increments"
    said = [
        f"#{SYSTEM} = {int(not absolute)}: {system}; unit: the machine is taken to be metric, the setting unit "
        f"{settings.setting_unit_um:g} um"
    ]
    said += [
        f"{set_name(table)}: the value {table.at_reference} at the reference number #{table.reference} shifts the zero of the "
        "axis by a constant, which is not counted"
        for table in sets
        if absolute and table.at_reference
    ]
    said += [f"{name}, numbers {first} to {last}: not of the machine file, kept apart" for name, first, last in others]
    said += [f"passed over: {passed_over} lines that cannot change a table"] if passed_over else []
    return MitsubishiTables(tuple(sets), others=tuple(others), remarks=tuple(said))


def _set_table(
    settings: MitsubishiSettings, entries: dict[int, Entry], number: int, absolute: bool, is_file: bool
) -> tuple[SetTable | None, tuple[str, tuple[int, int]] | None]:
    """Return set ``number`` (1 to 10), None if it is empty; or the name of another axis and the numbers of its set.

    In a parameter file of the control a set without axes is empty, whatever its numbers are.
    """
    shift = SET_STEP * (number - 1)
    due = {parameter: entries.get(parameter + shift) for parameter in range(BASE, INTERVAL + 1)}
    present = {parameter: entry for parameter, entry in due.items() if entry is not None}
    names = [present[parameter].value for parameter in (BASE, OUTPUT) if parameter in present]
    if not any(names if is_file else [entry.value for entry in present.values()]):
        return None, None
    first_entry = next(iter(present.values()))
    missing = [f"#{parameter + shift}" for parameter, entry in due.items() if entry is None or not entry.value]
    if missing:
        raise first_entry.file.fail(f"{', '.join(missing)} of set {number} missing", first_entry.line)
    strange = [name for name in names if name not in settings.axis_names]
    if strange:
        name = one_line(strange[0])[:10]
        if not is_file:
            message = f"set {number} belongs to the axis {name}, not of the machine file: not used"
            warnings.warn(message, CompgenWarning, stacklevel=6)
        numbers = [present[key].whole(0, 99999) for key in (NEGATIVE, POSITIVE, REFERENCE)]
        return None, (name, (min(numbers), max(numbers)))
    first, last = (present[key].whole(FIRST_NUMBER, MOST_NUMBER) for key in (NEGATIVE, POSITIVE))
    reference = present[REFERENCE].whole(FIRST_NUMBER, MOST_NUMBER)
    if not first <= reference <= last:
        raise present[REFERENCE].fail(f"the reference number {reference} is none of {first} to {last} of its set")
    table = SetTable(
        base=settings.axis_names.index(names[0]),
        output=settings.axis_names.index(names[1]),
        reference=reference,
        first=first,
        values=_values(entries, first, last, present[POSITIVE]),
        scale=present[SCALE].whole(0, 99),
        interval_mm=present[INTERVAL].interval_mm(),
        absolute=absolute,
        index=number - 1,
    )
    return table, None


def _values(entries: dict[int, Entry], first: int, last: int, who: Entry) -> tuple[int, ...]:
    missing = [number for number in range(first, last + 1) if number not in entries]
    if missing:
        some = ", ".join(f"#{number}" for number in missing[:5])
        raise who.fail(f"points {first} to {last} are given, {some} ({len(missing)} in all) missing")
    return tuple(entries[number].whole(LOWEST_VALUE, HIGHEST_VALUE) for number in range(first, last + 1))


def sheet_violations(machine: Machine, settings: MitsubishiSettings, tables: MitsubishiTables) -> list[str]:
    """Return broken limits: range of values, numbers, overlaps, scale, doubled pairs, travel left out."""
    found = []
    for table in tables.sets:
        what = set_name(table)
        start_mm, end_mm = machine.reference_point_mm[table.base] + table.along_mm[[0, -1]]
        found += coverage_violations(machine, table.base, float(start_mm), float(end_mm), what)
        wide = [value for value in table.values if not LOWEST_VALUE <= value <= HIGHEST_VALUE]
        if wide:
            most = max(map(abs, wide))
            cure = f"; set scale = {-(-most * table.scale // HIGHEST_VALUE)} or more" if table.absolute else ""
            found.append(f"{what}: the value {most} lies outside {LOWEST_VALUE} ... {HIGHEST_VALUE}{cure}")
        if table.last > settings.last_number:
            found.append(f"{what}: numbers go up to {table.last}, the last free one is {settings.last_number}")
        if table.scale == 0:
            found.append(f"{what}: the scale is 0, which leaves nothing of the table")
        kept = settings.kept_at_reference((table.output, table.base))
        if table.at_reference != kept:
            own = " as in the control's file" if kept else ""
            found.append(f"{what}: the value at the reference number {table.reference} must be {kept}{own}")
    for one, other in combinations(tables.sets, 2):
        if one.first <= other.last and other.first <= one.last:
            found.append(f"the numbers of {set_name(one)} and {set_name(other)} overlap")
        if (one.base, one.output) == (other.base, other.output):
            found.append(f"{set_name(one)} is given in two sets")
    others = [
        *tables.others,
        *((f"set {k.index + 1} of {k.base}", *k.span) for k in settings.sample.others(settings.axis_names)),
    ]
    for name, first, last in dict.fromkeys(others):
        for table in tables.sets:
            if table.first <= last and table.last >= first:
                found.append(f"the numbers of {set_name(table)} overwrite those of {name}, {first} to {last}")
    missing = [AXES[axis] for axis in range(3) if not any(t.base == t.output == axis for t in tables.sets)]
    found += [f"{letter} has no table of its own position" for letter in missing]
    return found + [shortfall_text(settings, item) for item in tables.shortfalls if item.missed_counts > 1.0]


def set_name(table: SetTable) -> str:
    """Name of a set in messages, e.g. ``the table X(y)``."""
    return f"the table {AXES[table.output]}({AXES[table.base].lower()})"


def shortfall_text(settings: MitsubishiSettings, item: Shortfall) -> str:
    """Say that the range of the values keeps a table from what was wanted, and what helps."""
    count_um = settings.count_mm((item.output, item.base)) / MM_PER_UM
    return (
        f"the table {AXES[item.output]}({AXES[item.base].lower()}) is too steep for {HIGHEST_VALUE} counts of "
        f"{count_um:g} um per division: it misses by up to {item.missed_counts * count_um:.1f} um; a larger scale or a "
        "shorter interval_mm is needed"
    )


def sheet_usage(settings: MitsubishiSettings, tables: MitsubishiTables) -> list[Usage]:
    """Return the largest value, the numbers and the sets against their limits."""
    largest = max(max(map(abs, table.values)) for table in tables.sets)
    used = sum(len(table.values) for table in tables.sets)
    return [
        Usage("largest value of a division", largest, HIGHEST_VALUE, "counts"),
        Usage("compensation numbers", used, settings.last_number - settings.first_number + 1, "numbers"),
        Usage("sets", len(tables.sets), SETS, "sets"),
    ]
