"""FANUC straightness compensation (``fanuc-straightness``): one axis as a function of another, four knots each."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import ROUND_CEILING, Decimal
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controls.fanuc_pitch import pitch_points
from compgen.controls.fanuc_pitch_tables import read_pitch_settings
from compgen.controls.fanuc_records import (
    PointGrid,
    Punched,
    PunchedRecords,
    PunchedSettings,
    as_sample,
    length_of,
    read_records,
    take_punched,
    type_word,
)
from compgen.controls.shared.base import (
    Monomial,
    SourceFile,
    Term,
    Usage,
)
from compgen.controls.shared.grids import curve_nodes_mm, kept_by_numbers
from compgen.controls.shared.tables import Table1D, TableController
from compgen.controls.shared.terms import ACROSS, one_dimensional_name, one_dimensional_terms
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray, fixed
from compgen.data.error_table import ErrorTable, hat_matrix
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import setting, whole
from compgen.errors import InputError

# Settings of ``[controllers.fanuc-straightness]``: what is compensated, the point numbers, the style of the file.


#: Number of sections of a travel if the user does not state the compensation points of the control.
SECTIONS = 100


@toml_files.accepts(toml_files.array_schema({"enum": list(ACROSS)}, 1))
def _pairs(value: Any) -> tuple[tuple[int, int], ...]:
    """A list of at most three tables such as ``"Y(x)"``, with each moving axis used once."""
    if not isinstance(value, list) or not value or any(item not in [*ACROSS] for item in value):
        raise ValueError(f"expected a list of {', '.join(map(repr, ACROSS))}")
    found = tuple(ACROSS[item] for item in value)
    if len({moving for _, moving in found}) < len(found):
        raise ValueError(
            "each moving axis may be given only once: the control has one table of four points for each moving axis"
        )
    return found


_NUMBER = toml_files.whole(0, 9999)
#: Keys of the compensation points of an axis, each with its check.
_GRID_KEYS: Mapping[str, Callable[[Any], Any]] = {
    "reference": _NUMBER,
    "first": _NUMBER,
    "last": _NUMBER,
    "interval_mm": toml_files.positive,
}
_OF_AXIS = toml_files.table_schema(
    {key: toml_files.accepted(check) for key, check in _GRID_KEYS.items()}, [*_GRID_KEYS]
)
_points = toml_files.accepts(toml_files.table_schema(dict.fromkeys(AXES, _OF_AXIS)))(
    lambda value: toml_files.table(value)
)


@dataclass(frozen=True, kw_only=True)
class StraightnessSettings(PunchedSettings):
    """Settings of straightness compensation.

    ``grids`` are the compensation points of X, Y, Z; None if the sample shows that the axis has none. ``stated`` tells
    which the user or the sample gives, ``of_pitch`` which come from ``[controllers.fanuc-pitch]``; the others are
    assumed. ``pairs`` are (compensated axis, moving axis), 0..2; None: the best are chosen.
    """

    path: int = setting(whole(1, 99), 1, meaning="path of the control whose parameters are used, if they have a word L")
    grids: tuple[PointGrid | None, ...] = setting(
        _points,
        (None, None, None),
        key="points",
        meaning="compensation points of an axis in pitch error compensation, { X = { reference = 40, first = 33, last "
        "= 49, interval_mm = 50.0 } }; default: those of the sample, else of [controllers.fanuc-pitch], else "
        "assumed",
    )
    pairs: tuple[tuple[int, int], ...] | None = setting(
        _pairs,
        None,
        meaning='up to three tables, e.g. ["Y(x)", "X(y)"], each moving axis once; default: chosen automatically',
    )
    amount_limit: int = setting(whole(1, 32767), 32767, meaning="largest magnitude of an amount, counts")
    stated: tuple[bool, ...] = (False, False, False)
    of_pitch: tuple[bool, ...] = (False, False, False)

    @property
    def assumed(self) -> tuple[bool, ...]:
        """Whether the points of X, Y, Z are assumed."""
        return tuple(not one and not other for one, other in zip(self.stated, self.of_pitch, strict=True))

    @property
    def count_mm(self) -> float:
        """One count, mm."""
        return self.detection_unit_um * MM_PER_UM


def read_straightness_settings(machine: Machine) -> StraightnessSettings:
    """Read and check ``[controllers.fanuc-straightness]``; every key has a default, if necessary from fanuc-pitch."""
    section = machine.controller_settings("fanuc-straightness")
    points = section.section("points", required=False)
    settings = take_punched(StraightnessSettings, section, grids=(None, None, None))
    if "fanuc-pitch" in machine.controllers:
        pitch = read_pitch_settings(machine)
        same = {"detection_unit_um": pitch.detection_unit_um, "axis_numbers": pitch.axis_numbers}
        settings = toml_files.unless_stated(settings, section, **same)
        if settings.axis_numbers != pitch.axis_numbers:
            numbers_here, stated = (
                ", ".join(map(str, numbers)) for numbers in (settings.axis_numbers, pitch.axis_numbers)
            )
            part = section.section("axis_numbers")
            raise part.fail("X", f"the axis numbers are {numbers_here} here, but {stated} in [controllers.fanuc-pitch]")
    settings.finish(section)
    settings = _with_points(machine, settings, points)
    for _, moving in settings.pairs or ():
        if settings.grids[moving] is None:
            raise section.fail(
                "pairs",
                f"{AXES[moving]} (A{settings.axis_numbers[moving]}) has no compensation points in the sample (3620 to "
                f"3622 and 3624), and other axes must keep theirs; omit its table, or set points.{AXES[moving]}",
            )
    return settings


def _with_points(machine: Machine, settings: StraightnessSettings, points: toml_files.Section) -> StraightnessSettings:
    """Compensation points of X, Y, Z: as stated, from the sample, from ``[controllers.fanuc-pitch]``, or else assumed.

    Pitch error compensation uses these numbers too: with a sample only its numbers are written, and assumed
    ones are never written with the tables.
    """
    sample, pitch = settings.sample, pitch_points(machine)
    grids: list[PointGrid | None] = []
    of_pitch = [False, False, False]
    for axis, letter in enumerate(AXES):
        number = settings.axis_numbers[axis]
        shown, of_pitch_axis = sample.axes.get(number), pitch[axis]
        known = None if shown is None or not shown.grid.interval_mm else shown.grid
        if letter in points:
            grid = _grid(points.section(letter))
            if known is not None and grid != known:
                raise points.fail(
                    letter,
                    f"differs from the sample: A{number} has 3620 = {known.reference}, 3621 = {known.first}, 3622 = "
                    f"{known.last}, 3624 = {known.interval_mm:f} there; other values would shift its pitch table",
                )
        elif known is not None:
            grid = known
        elif any((parameter, number) in sample.parameters for parameter in GRID_PARAMETERS):
            grids.append(None)
            continue
        elif of_pitch_axis is not None:
            grid, of_pitch[axis] = of_pitch_axis, True
        else:
            used = [grid.last for grid in (*grids, *pitch) if grid is not None]
            used += [span[1] for _, span in sample.others(0)]
            grids.append(default_grid(machine, settings, axis, max(used, default=0) + 1))
            continue
        sample.check_free(number, letter, grid.first, grid.last)
        grids.append(grid if grid.last >= grid.first + 3 else None)
    points.finish()
    stated = tuple(letter in points or settings.axis_numbers[k] in sample.axes for k, letter in enumerate(AXES))
    return replace(settings, grids=tuple(grids), stated=stated, of_pitch=tuple(of_pitch))


def _grid(section: toml_files.Section) -> PointGrid:
    reference, first, last, interval_mm = (section.take(key, check) for key, check in _GRID_KEYS.items())
    grid = PointGrid(reference=reference, first=first, last=last, interval_mm=Decimal(repr(interval_mm)))
    section.finish()
    if grid.last < grid.first + 3:
        raise section.fail("last", f"points {grid.first} to {grid.last}: at least four are needed")
    return grid


def default_grid(machine: Machine, settings: StraightnessSettings, axis: int, free: int) -> PointGrid:
    """Return points over the whole travel, about 1/100 of it apart, numbered from ``free`` on."""
    quantum = Decimal("0.001") if settings.style.real_point else Decimal(repr(settings.interval_unit_mm))
    low, high = machine.axes[axis].range_mm
    reference = machine.reference_point_mm[axis]
    step = (Decimal(repr(high - low)) / SECTIONS / quantum).to_integral_value(rounding=ROUND_CEILING) * quantum
    below = math.ceil((reference - low) / float(step) - 1e-9)
    above = math.ceil((high - reference) / float(step) - 1e-9)
    return PointGrid(free + below, free, free + below + above, step)


# Numbers of straightness compensation: reading them from text, the polyline they represent, their limits.
#
# Entry k = 0, 1, 2 has the moving axis in parameter 5711 + k, the compensated axis in 5721 + k, four point numbers
# a < b < c < d from 5731 + 10 k on and four amounts from 5761 + 10 k on. Points are those of the moving axis
# (3620 ... 3622, 3624). The amount is linear between a, b, c, d and zero outside.


ENTRIES = range(3)
MOVING, COMPENSATED, POINTS, AMOUNTS = 5711, 5721, 5731, 5761
#: Additional moving axes on controls with more entries.
UNKNOWN_MOVING = range(5714, 5721)
#: Reference, first, last number and interval of the compensation points.
GRID_PARAMETERS = (3620, 3621, 3622, 3624)


def entry_numbers(entry: int) -> tuple[int, ...]:
    """Return the ten parameter numbers of an entry: moving, compensated axis, four points, four amounts."""
    points, amounts = POINTS + 10 * entry, AMOUNTS + 10 * entry
    return (MOVING + entry, COMPENSATED + entry, *range(points, points + 4), *range(amounts, amounts + 4))


@dataclass(frozen=True)
class StraightTable:
    """One entry: ``compensated`` and ``moving`` axis (0..2), point numbers and amounts (4 each), grid of the points."""

    compensated: int
    moving: int
    numbers: tuple[int, int, int, int]
    amounts: tuple[int, int, int, int]
    grid: PointGrid

    @property
    def name(self) -> str:
        """Name such as ``Y(x)``."""
        return one_dimensional_name(self.compensated, self.moving)

    @property
    def along_mm(self) -> FloatArray:
        """Positions of the four knots from the reference point, mm."""
        return np.array([self.grid.along_mm(number) for number in self.numbers])


@dataclass(frozen=True)
class StraightTables:
    """The entries in use, in order; ``remarks`` state what was assumed and kept apart when reading them."""

    entries: tuple[StraightTable, ...]
    remarks: tuple[str, ...] = field(default=(), compare=False)


# The best polyline of four knots for a curve: all pairs of inner knots are tried; the ends are given.
#
# With knots p < q of a segment and the hat functions h0, h1 on it, weighted sums over the samples of h0^2, h0 h1, h1^2, h0 y
# and h1 y follow from running sums of w, w x, w x^2, w y and w x y. For each pair of inner knots the normal matrix of the
# four knot values is tridiagonal; its elimination gives the decrease of the squared deviation.


#: Keeps a pivot from zero if a segment contains a single sample.
TINY = 1e-12


@dataclass(frozen=True)
class Polyline:
    """Indices of the four knots among the candidates, the knot values (4,), and the weighted squared deviation."""

    knots: tuple[int, int, int, int]
    values: FloatArray
    square: float


@kept_by_numbers
def best_polyline(
    candidates_mm: FloatArray, position_mm: FloatArray, requested: FloatArray, weight: FloatArray
) -> Polyline:
    """Return the polyline with knots at the first, the last and two other candidates that best fits the samples.

    Parameters
    ----------
    candidates_mm : allowed knots (m,), ascending, at least four.
    position_mm, requested, weight : samples (n,) within the candidates, ascending, including the candidates.
    """
    if len(candidates_mm) < 4:
        raise ValueError("at least four candidates are needed")
    gain = _gain_of_inner_knots(candidates_mm, position_mm, requested, weight)
    b, c = (int(k) for k in np.unravel_index(int(np.argmax(gain)), gain.shape))
    knots = (0, b, c, len(candidates_mm) - 1)
    matrix = hat_matrix(candidates_mm[list(knots)], position_mm)
    root = np.sqrt(weight)
    values = np.linalg.lstsq(matrix * root[:, None], requested * root, rcond=None)[0]
    return Polyline(knots, np.asarray(values), float(np.sum(weight * (matrix @ values - requested) ** 2)))


def _gain_of_inner_knots(
    candidates: FloatArray, position: FloatArray, requested: FloatArray, weight: FloatArray
) -> FloatArray:
    """Decrease of the squared deviation with inner knots b (row) and c (column), shape (m, m); -inf where b >= c."""
    # sums of h0^2, h0 h1, h1^2, h0 y, h1 y over the samples of each segment from candidate p to q, (m, m), only p < q
    middle = 0.5 * (candidates[0] + candidates[-1])
    x, y = position - middle, requested
    at = candidates - middle
    moments = np.array([weight, weight * x, weight * x**2, weight * y, weight * x * y])
    running = np.hstack([np.zeros((5, 1)), np.cumsum(moments, axis=1)])
    cut = np.searchsorted(position, candidates - 1e-9)
    cut[-1] = len(position)  # the last segment includes its end, the others do not
    s0, s1, s2, t0, t1 = running[:, cut][:, None, :] - running[:, cut][:, :, None]
    length = np.where(at[None, :] > at[:, None], at[None, :] - at[:, None], 1.0)
    first = at[:, None]
    h1 = (s1 - first * s0) / length
    h11 = (s2 - 2.0 * first * s1 + first**2 * s0) / length**2
    h1y = (t1 - first * t0) / length
    sums = (s0 - 2.0 * h1 + h11, h1 - h11, h11, t0 - h1y, h1y)
    count = len(candidates)
    b, c = np.arange(count)[:, None], np.arange(count)[None, :]
    # the three segments from knot to knot, each sum with the shape of all pairs (b, c)
    where = ((np.zeros_like(c), b), (b, c), (c, np.full_like(c, count - 1)))
    g00, g01, g11, r0, r1 = ([table[rows, columns] for rows, columns in where] for table in sums)
    diagonal = [g00[0], g11[0] + g00[1], g11[1] + g00[2], g11[2]]
    right = [r0[0], r1[0] + r0[1], r1[1] + r0[2], r1[2]]
    scale = float(np.max(np.abs(sums[0])))
    pivot, rest = np.maximum(diagonal[0], TINY * scale), right[0]
    gain = rest**2 / pivot
    for k in range(1, 4):
        factor = g01[k - 1] / pivot
        pivot, rest = np.maximum(diagonal[k] - factor * g01[k - 1], TINY * scale), right[k] - factor * rest
        gain = gain + rest**2 / pivot
    allowed = (b > 0) & (b < c) & (c < count - 1)
    return np.where(allowed, gain, -np.inf)


# FANUC straightness compensation: one axis corrected as a function of another, by a polyline of four knots.
#
# What the control is assumed to do, and how little of it is certain: see ``templates/fanuc-straightness/format.toml``.


class FanucStraightness(TableController[StraightnessSettings, StraightTables]):
    """Up to three tables such as Y(x), each moving axis once; zero at the reference point except for rounding."""

    name = "fanuc-straightness"
    settings_class = StraightnessSettings
    anchored = True
    has_plan = True
    sample_setting = "style_from"

    @classmethod
    def read_settings(cls, machine: Machine) -> StraightnessSettings:
        """Check ``[controllers.fanuc-straightness]``."""
        return read_straightness_settings(machine)

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return one term per chosen pair; its four nodes are the best of all allowed knots for the curve."""
        terms = []
        for output, axis in self._chosen(errors):
            candidates = self._candidates_mm(axis)
            line = self._fitted(errors, output, axis)
            nodes_mm = candidates[list(line.knots)]
            reference = self.machine.reference_point_mm[axis]
            start = line.values - np.interp(reference, nodes_mm, line.values)
            name = one_dimensional_name(output, axis)
            terms.append(Term(name, axis, nodes_mm, (Monomial(output),), start, reference))
        return terms

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> StraightTables:
        """Round the amounts: the only whole numbers within half a count at every knot, so everywhere between them."""
        entries = []
        for term in basis:
            assert term.axis is not None
            grid = self.settings.grids[term.axis]
            assert grid is not None
            steps = (term.nodes_mm - self.machine.reference_point_mm[term.axis]) / float(grid.interval_mm)
            a, b, c, d = (grid.reference + round(float(step)) for step in steps)
            counts = np.floor(self.settings.sign * np.asarray(values[term.name]) / self.settings.count_mm + 0.5)
            p, q, r, s = (int(value) for value in counts)
            entries.append(StraightTable(term.carrier[0].output, term.axis, (a, b, c, d), (p, q, r, s), grid))
        return StraightTables(tuple(sorted(entries, key=lambda entry: entry.moving)))

    def context(self, tables: StraightTables) -> dict[str, Any]:
        """Return the records, the plan parameter -> value, what to set, and the sign statement."""
        settings = self.settings
        common = self._common(tables)
        grids = self._point_grid_parameters(tables, settings.stated)
        assumed = self._point_grid_parameters(tables, settings.assumed)
        not_written = self._point_grid_parameters(tables, tuple(not stated for stated in settings.stated))
        return {
            "sign_statement": self._sign_statement(tables),
            "parameters": self._rows(tables, common, grids, not_written),
            "warnings": self._warnings(tables),
            "tables": [self._summary(entry) for entry in tables.entries],
            "settings": settings,
            "style_notes": list(settings.sample.notes),
            "overwrites": self._overwrites(common, grids, not_written),
            "file": self._punched(common, grids),
            "points_file": self._punched({}, assumed),
            "container": "assumed points" if assumed else "points known",
            "not_written": bool(not_written),
            "switches": [MOVING + k for k in self._free_entries()[0]],
            "plan": {
                "parameters": common,
                "axis_parameters": {number: dict(values) for number, values in grids.items()},
                "stores": settings.stores,
                "detection_unit_um": settings.detection_unit_um,
            },
            "check": self._check(tables) if tables.entries else None,
        }

    def parse(self, files: Sequence[SourceFile]) -> StraightTables:
        """Read the entries from FANUC text; ``.json`` files (the plan) are ignored.

        Entries of other axes are kept apart; a fourth moving axis, which is not supported, is rejected with its line.
        """
        texts = [file for file in files if file.path.suffix.lower() != ".json"]
        if not texts:
            raise InputError("no FANUC text file was given; expected STRAIGHT.TXT (or a punched parameter file)")
        found = PunchedRecords(self.settings.path)
        for file in texts:
            for record in read_records(file):
                if type_word(record, record.words())[0] != 0:
                    found.take(record, is_point=False)
        found.check_metric()
        for number in UNKNOWN_MOVING:
            text, unknown = found.common.get(number, ("0", None))
            if unknown is not None and Decimal(text):
                raise unknown.fail(
                    f"{text} is a fourth moving axis, whose points and amounts are not known; set it to 0"
                )
        apart: list[InputError] = []
        entries = tuple(entry for k in ENTRIES if (entry := self._entry(texts[0], k, found, apart)) is not None)
        if apart and not entries:
            raise apart[0]
        if not entries:
            raise texts[0].fail(
                "contains no moving axis (parameters 5711 to 5713); punch the parameters from 5711 on as well"
            )
        moving = [entry.moving for entry in entries]
        for k, entry in enumerate(entries):
            if entry.moving in moving[:k]:
                raise texts[0].fail(
                    f"{AXES[entry.moving]} is the moving axis of two entries; every axis may have only one"
                )
        remarks = [found.unit_remark(self.settings.detection_unit_um), *map(str, apart)]
        for entry in entries:
            number, grid = self.settings.axis_numbers[entry.moving], entry.grid
            if not any((parameter, number) in found.axes for parameter in GRID_PARAMETERS):
                remarks.append(
                    f"3620 to 3624 of {AXES[entry.moving]} (A{number}) are not in the file; the points {grid.first} to "
                    f"{grid.last}, reference point {grid.reference}, interval {grid.interval_mm:f} mm are taken from "
                    "the machine file"
                )
        if found.skipped:
            remarks.append(found.skipped_remark("straightness"))
        return StraightTables(entries, tuple(remarks))

    def curves(self, tables: StraightTables) -> list[Table1D]:
        """Return the polylines in counts, zero outside their knots."""
        return [self._polyline(entry) for entry in tables.entries]

    def _polyline(self, entry: StraightTable) -> Table1D:
        value_mm = self.settings.sign * self.settings.count_mm
        return Table1D(
            entry.moving,
            entry.compensated,
            entry.along_mm,
            np.array(entry.amounts, dtype=np.float64),
            value_mm=value_mm,
            origin_mm=self.machine.reference_point_mm[entry.moving],
            zero_outside=True,
        )

    def violations(self, tables: StraightTables) -> list[str]:
        """Return amounts beyond their range, and travel not covered by the knots."""
        settings = self.settings
        messages = []
        for entry in tables.entries:
            most = max(map(abs, entry.amounts))
            if most > settings.amount_limit:
                messages.append(f"{entry.name}: an amount is {most} counts; the limit is {settings.amount_limit}")
            short = self.not_covered(entry.moving, self._polyline(entry).nodes_mm, f"the polyline {entry.name}")
            messages += [
                f"{text}; {AXES[entry.moving]} needs a compensation point at or beyond each end" for text in short
            ]
            known = settings.grids[entry.moving]
            if known is not None and settings.stated[entry.moving] and entry.grid != known:
                messages.append(
                    f"{entry.name}: the file has the points {entry.grid.first} to {entry.grid.last} every "
                    f"{entry.grid.interval_mm:f} mm, which differ from those of the machine file or of the sample"
                )
        return messages

    def usage(self, tables: StraightTables) -> list[Usage]:
        """Return the largest amount of each entry against its range, and the entries in use."""
        found = [
            Usage(
                f"amount of {entry.name}",
                max(map(abs, entry.amounts)),
                self.settings.amount_limit,
                "counts",
                stated=False,
            )
            for entry in tables.entries
        ]
        return [*found, Usage("moving axes", len(tables.entries), len(ENTRIES), "entries", stated=False)]

    def keeping_others(self, tables: StraightTables, files: Sequence[Path]) -> dict[str, dict[str, Any]]:
        """Return ``style_from`` with these files: the points of X, Y and Z are those of pitch error compensation."""
        return as_sample(self.machine, files, ("fanuc-straightness",))

    def resolution_mm(self) -> float:
        """Return half a count for each of the two tables that may move one axis."""
        outputs = [output for output, _ in self.settings.pairs or ()]
        tables = max(map(outputs.count, outputs), default=2)
        return 0.5 * self.settings.count_mm * tables

    def _free_entries(self) -> tuple[list[int], set[int]]:
        """Return the entries 0 ... 2 that are free in the sample, and the moving axes 0 ... 2 it uses for other axes.

        An entry whose moving or compensated axis is not X, Y or Z is never overwritten.
        """
        settings = self.settings
        free, taken = [], set()
        for k in ENTRIES:
            axes = [int(Decimal(settings.sample.common.get(number, ("0",))[0])) for number in entry_numbers(k)[:2]]
            if axes[0] and not set(axes) <= {0, *settings.axis_numbers}:
                taken |= {settings.axis_numbers.index(axes[0])} if axes[0] in settings.axis_numbers else set()
            else:
                free.append(k)
        return free, taken

    def _entry(self, file: SourceFile, k: int, found: PunchedRecords, apart: list[InputError]) -> StraightTable | None:
        settings = self.settings
        numbers = entry_numbers(k)
        if numbers[0] not in found.common or Decimal(found.common[numbers[0]][0]) == 0:
            return None

        def whole(number: int, low: int, high: int) -> int:
            text, record = found.common[number]
            return record.whole(text, low, high)

        controlled = [whole(number, 1, 99) for number in numbers[:2] if number in found.common]
        if not set(controlled) <= set(settings.axis_numbers):
            number, axis = next(
                pair for pair in zip(numbers, controlled, strict=False) if pair[1] not in settings.axis_numbers
            )
            known = ", ".join(map(str, settings.axis_numbers))
            text = (
                f"axis {axis} is not X, Y or Z (axis numbers {known}): its straightness table is not part of these "
                "tables"
            )
            apart.append(found.common[number][1].fail(text))
            return None
        missing = [str(number) for number in numbers if number not in found.common]
        if missing:
            raise found.common[numbers[0]][1].fail(
                f"names a moving axis, but parameter {', '.join(missing)} is missing"
            )
        moving, compensated = (settings.axis_numbers.index(number) for number in controlled)
        if moving == compensated:
            raise found.common[numbers[1]][1].fail(f"{AXES[moving]} is both moving and compensated axis")
        grid = self._read_grid(file, moving, found)
        points = [whole(number, 0, 9999) for number in numbers[2:6]]
        for number, before, point in zip(numbers[3:6], points, points[1:], strict=False):
            if point <= before:
                raise found.common[number][1].fail(f"point {point} is not after {before}; expected a < b < c < d")
        if not grid.first <= points[0] <= points[-1] <= grid.last:
            raise found.common[numbers[2]][1].fail(
                f"points {points[0]} to {points[-1]} are not within those of {AXES[moving]}, {grid.first} to {grid.last}"
            )
        a, b, c, d = points
        p, q, r, s = (whole(number, -1_000_000, 1_000_000) for number in numbers[6:])
        return StraightTable(compensated, moving, (a, b, c, d), (p, q, r, s), grid)

    def _read_grid(self, file: SourceFile, axis: int, found: PunchedRecords) -> PointGrid:
        settings = self.settings
        number = settings.axis_numbers[axis]
        missing = [str(parameter) for parameter in GRID_PARAMETERS if (parameter, number) not in found.axes]
        known = settings.grids[axis]
        if len(missing) == len(GRID_PARAMETERS) and known is not None and not settings.assumed[axis]:
            return known
        if missing:
            raise file.fail(
                f"parameter {', '.join(missing)} is missing for {AXES[axis]} (axis A{number}); also give the file that "
                f"contains it, or set points.{AXES[axis]} in the machine file"
            )
        reference, first, last = (
            found.axes[parameter, number][1].whole(found.axes[parameter, number][0], 0, 9999)
            for parameter in GRID_PARAMETERS[:3]
        )
        text, record = found.axes[GRID_PARAMETERS[3], number]
        return PointGrid(reference, first, last, length_of(record, text, settings.interval_unit_mm))

    def _common(self, tables: StraightTables) -> dict[int, int]:
        """Parameter number -> value of the entries; an entry of X, Y, Z in the sample that is no longer used gets 0."""
        found: dict[int, int] = {}
        free, _ = self._free_entries()
        for k, entry in zip(free, tables.entries, strict=False):
            axes = (self.settings.axis_numbers[entry.moving], self.settings.axis_numbers[entry.compensated])
            found.update(zip(entry_numbers(k), (*axes, *entry.numbers, *entry.amounts), strict=True))
        for k in free[len(tables.entries) :]:
            if Decimal(self.settings.sample.common.get(MOVING + k, ("0",))[0]):
                found[MOVING + k] = 0
        return dict(sorted(found.items()))

    def _overwrites(
        self,
        common: dict[int, int],
        grids: dict[int, list[tuple[int, str]]],
        not_written: dict[int, list[tuple[int, str]]],
    ) -> list[str]:
        """Say what the file overwrites, other axes first."""
        sample, names = self.settings.sample, dict(zip(self.settings.axis_numbers, AXES, strict=True))
        kept = [
            f"entry {k + 1} (A{sample.common[MOVING + k][0]} moves, {COMPENSATED + k} = {sample.common[COMPENSATED + k][0]})"
            for k in ENTRIES
            if k not in self._free_entries()[0] and COMPENSATED + k in sample.common
        ]
        if any(MOVING + k in sample.common for k in ENTRIES):
            found = [f"Of other axes: nothing.{' Kept: ' + ', '.join(kept) + '.' if kept else ''}"]
        else:
            given = "the sample has no parameters 5711 to 5713" if sample.notes else "no file of this control was given"
            found = [f"Of other axes: NOT KNOWN, {given} (`--style-from`): check 5711 to 5723."]
        for number, values in grids.items():
            texts = [f"{names[axis]} (A{axis}) = {text}" for axis, text in values]
            found.append(f"{number}, also used by pitch error compensation: {', '.join(texts)}")
        if not_written:
            letters = ", ".join(names[axis] for axis, _ in not_written[GRID_PARAMETERS[0]])
            found.append(
                f"NOT written: 3620, 3621, 3622 and 3624 of {letters}, which belong to pitch error compensation"
            )
        old = {number: sample.common[number][0] for number in common if number in sample.common}
        changed = [
            f"{number} = {common[number]} (sample: {old[number]})"
            for number in common
            if number in old and Decimal(old[number]) != common[number]
        ]
        found.append(
            f"Straightness: {', '.join(map(str, common))}" + (f"; changed: {', '.join(changed)}" if changed else "")
        )
        return found

    def _point_grid_parameters(
        self, tables: StraightTables, chosen: Sequence[bool]
    ) -> dict[int, list[tuple[int, str]]]:
        """Parameters 3620 ... of the ``chosen`` moving axes: number -> (axis number, value as text)."""
        style = self.settings.style
        entries = [entry for entry in tables.entries if chosen[entry.moving]]
        found: dict[int, list[tuple[int, str]]] = {number: [] for number in GRID_PARAMETERS} if entries else {}
        for entry in entries:
            grid, axis = entry.grid, self.settings.axis_numbers[entry.moving]
            unit = Decimal(1) if style.real_point else Decimal(repr(self.settings.interval_unit_mm))
            length = style.length(grid.interval_mm / unit)
            texts = (*map(style.whole, (grid.reference, grid.first, grid.last)), length)
            for number, text in zip(GRID_PARAMETERS, texts, strict=True):
                found[number].append((axis, text))
        return {number: sorted(values) for number, values in found.items()}

    def _punched(self, common: dict[int, int], grids: dict[int, list[tuple[int, str]]]) -> Punched:
        style, records = self.settings.style, []
        for number, values in grids.items():
            records += style.parameter(number, values, style.real_letter if number == GRID_PARAMETERS[3] else "P")
        records += [style.common(number, value) for number, value in common.items()]
        return Punched(style.file(records, []))

    def _sign_statement(self, tables: StraightTables) -> str:
        settings = self.settings
        stored = "correction, which the control adds to"
        if settings.stores == "error":
            stored = "error, which the control subtracts from"
        text = (
            f"The amounts are the {stored} the command of the compensated axis; one count is "
            f"{settings.detection_unit_um:g} um. Between the four points the amount is linear, outside it is zero."
        )
        for entry in tables.entries[:1]:
            k = int(np.argmax(np.abs(entry.amounts)))
            moved = settings.sign * entry.amounts[k] * settings.detection_unit_um
            at = self.machine.reference_point_mm[entry.moving] + entry.along_mm[k]
            text += (
                f" Example: at point {entry.numbers[k]}, {AXES[entry.moving]} = {at:g} mm, the amount "
                f"{entry.amounts[k]:+d} moves {AXES[entry.compensated]} by {moved:+g} um."
            )
        return text

    def _rows(
        self,
        tables: StraightTables,
        common: dict[int, int],
        grids: dict[int, list[tuple[int, str]]],
        not_written: dict[int, list[tuple[int, str]]],
    ) -> list[dict[str, str]]:
        names = dict(zip(self.settings.axis_numbers, AXES, strict=True))
        meanings = dict(
            zip(GRID_PARAMETERS, ("point at the reference point", "first point", "last point", "interval"), strict=True)
        )
        rows = [
            {
                "name": f"{number} ({names[axis]}, A{axis})",
                "value": text,
                "meaning": f"{meanings[number]}; must be the value that stored pitch error compensation uses{remark}",
            }
            for part, remark in ((grids, ""), (not_written, ". COMPARE: not in `STRAIGHT.TXT`"))
            for number, values in part.items()
            for axis, text in values
        ]
        free, _ = self._free_entries()
        for k, entry in zip(free, tables.entries, strict=False):
            words = [
                "moving axis",
                "compensated axis",
                *(f"point {n}" for n in "abcd"),
                *(f"amount at {n}" for n in "abcd"),
            ]
            rows += [
                {"name": str(number), "value": str(common[number]), "meaning": f"{entry.name}: {word}"}
                for number, word in zip(entry_numbers(k), words, strict=True)
            ]
        rows += [
            {"name": str(MOVING + k), "value": "0", "meaning": "no moving axis: this entry is not used"}
            for k in free[len(tables.entries) :]
        ]
        return rows

    def _warnings(self, tables: StraightTables) -> list[str]:
        settings = self.settings
        found = ["Public documents do not settle sign, range and parameter numbers: check one entry first (part 3)."]
        if settings.sample.notes:
            found.append("The style was taken from the sample: " + "; ".join(settings.sample.notes) + ".")
            if not settings.sample.common:
                found.append("The sample has no parameters 5711 to 5799: whether they need a word L is NOT confirmed.")
        for entry in tables.entries:
            grid = entry.grid
            if not settings.stated[entry.moving]:
                source = "those of [controllers.fanuc-pitch]" if settings.of_pitch[entry.moving] else "assumed"
                found.append(
                    f"The compensation points of {AXES[entry.moving]} are {source}: {grid.first} to {grid.last}, "
                    f"reference point {grid.reference}, every {grid.interval_mm:f} mm. The table is right only on a "
                    "control with exactly these points; if yours has others, give its file with --style-from, or set "
                    f"points.{AXES[entry.moving]}, and export again."
                )
            ends = [settings.sign * entry.amounts[k] * settings.count_mm / MM_PER_UM for k in (0, 3)]
            if any(ends):
                found.append(
                    f"{entry.name}: beyond the outer points the correction is assumed to drop to zero, a step of "
                    f"{fixed(ends[0], 1)} and {fixed(ends[1], 1)} um."
                )
        return found

    def _summary(self, entry: StraightTable) -> dict[str, Any]:
        knots = self.machine.reference_point_mm[entry.moving] + entry.along_mm
        return {
            "name": entry.name,
            "knots": [
                {"number": number, "mm": float(mm), "amount": amount}
                for number, mm, amount in zip(entry.numbers, knots, entry.amounts, strict=True)
            ],
        }

    def _check(self, tables: StraightTables) -> dict[str, Any]:
        """Trial of one entry: all amounts 0 except one, and what the compensated axis must do there."""
        counts, place, entry = 10, self._free_entries()[0][0], tables.entries[0]
        amounts = entry_numbers(place)[6:]
        return {
            "moving": AXES[entry.moving],
            "compensated": AXES[entry.compensated],
            "parameter": amounts[1],
            "amounts": f"{amounts[0]} to {amounts[-1]}",
            "counts": counts,
            "at_mm": float(self.machine.reference_point_mm[entry.moving] + entry.along_mm[1]),
            "zero_mm": float(self.machine.reference_point_mm[entry.moving] + entry.along_mm[2]),
            "change_um": self.settings.sign * counts * self.settings.detection_unit_um,
        }

    def _candidates_mm(self, axis: int) -> FloatArray:
        """Positions of the compensation points that may be knots: those within the travel and one beyond each end."""
        grid = self.settings.grids[axis]
        assert grid is not None
        numbers = range(grid.first, grid.last + 1)
        positions = self.machine.reference_point_mm[axis] + np.array([grid.along_mm(number) for number in numbers])
        low, high = self.machine.axes[axis].range_mm
        first = max(int(np.searchsorted(positions, low + 1e-6, side="right")) - 1, 0)
        last = min(int(np.searchsorted(positions, high - 1e-6)), len(positions) - 1)
        if last - first < 3:
            first, last = max(0, min(first, len(positions) - 4)), max(last, 3)
        return np.asarray(positions[first : last + 1])

    def _fitted(self, errors: ErrorTable, output: int, axis: int) -> Polyline:
        """Best polyline for the requested correction of ``output`` over ``axis`` at mid-volume."""
        candidates = self._candidates_mm(axis)
        position = np.unique(np.concatenate([candidates, curve_nodes_mm(self.machine, errors, axis)]).round(9))
        position = np.unique(np.concatenate([position, 0.5 * (position[1:] + position[:-1])]).round(9))
        position = position[(position >= candidates[0] - 1e-9) & (position <= candidates[-1] + 1e-9)]
        (term,) = one_dimensional_terms(self.machine, errors, [position] * 3, [(output, axis)], anchored=False)
        # the length that each sample represents; more within the work zone, nearly 0 beyond the travel
        half = 0.5 * np.diff(position)
        weight = np.concatenate([half, [0.0]]) + np.concatenate([[0.0], half])
        low, high = self.machine.axes[axis].range_mm
        weight = np.where((position >= low - 1e-9) & (position <= high + 1e-9), weight, 1e-6 * weight)
        zone = self.machine.emphasis.zone_mm[axis]
        if zone is not None:
            inside = (position >= zone[0]) & (position <= zone[1])
            weight = np.where(inside, self.machine.emphasis.zone_weight * weight, weight)
        return best_polyline(candidates, position, term.start, weight)

    def _chosen(self, errors: ErrorTable) -> tuple[tuple[int, int], ...]:
        """Return the pairs of the settings, else for each moving axis the one that removes most, by mean square."""
        settings = self.settings
        free, taken = self._free_entries()
        possible = [axis for axis in range(3) if settings.grids[axis] is not None and axis not in taken]
        requested = settings.pairs or ()
        if any(axis in taken for _, axis in requested) or len(requested) > len(free) or not possible or not free:
            sample = ", ".join(
                f"{k} = {text}" for k, (text, _) in sorted(settings.sample.common.items()) if MOVING <= k < POINTS
            )
            raise InputError(
                "the sample leaves no room for the straightness tables: entries of other axes are never overwritten, and a "
                f"moving axis needs compensation points (3620 to 3624). The sample has {sample or 'none of 5711 to 5723'}"
            )
        if settings.pairs is not None:
            return settings.pairs
        # mean square over the travel removed by the polyline of each pair, without a constant
        gain: dict[tuple[int, int], float] = {}
        for axis, output in product(possible, range(3)):
            if output != axis:
                line = self._fitted(errors, output, axis)
                along = np.linspace(*self.machine.axes[axis].range_mm, 201)
                nodes = self._candidates_mm(axis)[list(line.knots)]
                gain[output, axis] = float(np.var(np.interp(along, nodes, line.values)))
        found = [max((pair for pair in gain if pair[1] == axis), key=gain.__getitem__) for axis in possible]
        return tuple(sorted(found, key=lambda pair: -gain[pair])[: len(free)])
