"""Numbers of straightness compensation: reading them from text, the polyline that they mean, their limits.

Entry k = 0, 1, 2 has the moving axis in parameter 5711 + k, the compensated axis in 5721 + k, four point numbers
a < b < c < d from 5731 + 10 k on and four amounts from 5761 + 10 k on. Points are compensation points of the moving axis
(3620 ... 3622, 3624). Between a, b, c, d the amount is linear, outside it is zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal

import numpy as np

from compgen.controllers.base import SourceFile, Usage, coverage_violations
from compgen.controllers.fanuc.sample import PointGrid, PunchedRecords, length_of
from compgen.controllers.fanuc.straightness_settings import StraightnessSettings
from compgen.controllers.fanuc.text import read_records, type_word
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.errors import InputError

ENTRIES = range(3)
MOVING, COMPENSATED, POINTS, AMOUNTS = 5711, 5721, 5731, 5761
#: Further moving axes, which controls with more entries have.
FURTHER_MOVING = range(5714, 5721)
#: Reference, first, last number and interval of the compensation points.
GRID_PARAMETERS = (3620, 3621, 3622, 3624)
#: Positions closer than this are the same, mm.
SAME_MM = 1e-6


def entry_numbers(entry: int) -> tuple[int, ...]:
    """Return the ten parameter numbers of an entry: moving, compensated axis, four points, four amounts."""
    points, amounts = POINTS + 10 * entry, AMOUNTS + 10 * entry
    return (MOVING + entry, COMPENSATED + entry, *range(points, points + 4), *range(amounts, amounts + 4))


@dataclass(frozen=True)
class StraightTable:
    """One entry: ``compensated`` and ``moving`` axis (0..2), point numbers and amounts (4 each), the points' grid."""

    compensated: int
    moving: int
    numbers: tuple[int, int, int, int]
    amounts: tuple[int, int, int, int]
    grid: PointGrid

    @property
    def name(self) -> str:
        """Name such as ``Y(x)``."""
        return f"{AXES[self.compensated]}({AXES[self.moving].lower()})"

    @property
    def along_mm(self) -> FloatArray:
        """Positions of the four knots from the reference point, mm."""
        return np.array([self.grid.along_mm(number) for number in self.numbers])

    def counts(self, along_mm: FloatArray) -> FloatArray:
        """Amount in counts at positions (n,) from the reference point: linear between the knots, zero outside."""
        knots = self.along_mm
        inside = (along_mm >= knots[0] - SAME_MM) & (along_mm <= knots[-1] + SAME_MM)
        return np.where(inside, np.interp(along_mm, knots, self.amounts), 0.0)


@dataclass(frozen=True)
class StraightTables:
    """The entries in use, in their order; ``remarks`` say what reading them assumed and kept apart."""

    entries: tuple[StraightTable, ...]
    remarks: tuple[str, ...] = field(default=(), compare=False)


def free_entries(settings: StraightnessSettings) -> tuple[list[int], set[int]]:
    """Return the entries 0 ... 2 that the sample leaves free, and the moving axes 0 ... 2 that it uses for other axes.

    An entry that has an axis other than X, Y, Z as moving or compensated axis is never written over.
    """
    free, taken = [], set()
    for k in ENTRIES:
        axes = [int(Decimal(settings.sample.common.get(number, ("0",))[0])) for number in entry_numbers(k)[:2]]
        if axes[0] and not set(axes) <= {0, *settings.axis_numbers}:
            taken |= {settings.axis_numbers.index(axes[0])} if axes[0] in settings.axis_numbers else set()
        else:
            free.append(k)
    return free, taken


def parse_straightness(settings: StraightnessSettings, files: Sequence[SourceFile]) -> StraightTables:
    """Read the entries from FANUC text; files that end in ``.json`` (the plan beside them) are left out.

    Entries of other axes are kept apart; a fourth moving axis, which is not understood, is refused with its line.
    """
    texts = [file for file in files if file.path.suffix.lower() != ".json"]
    if not texts:
        raise InputError("no FANUC text file is given; STRAIGHT.TXT (or a punched parameter file) is needed")
    found = PunchedRecords(settings.path)
    for file in texts:
        for record in read_records(file):
            if type_word(record, record.words())[0] != 0:
                found.take(record, is_point=False)
    found.check_metric()
    for number in FURTHER_MOVING:
        text, further = found.common.get(number, ("0", None))
        if further is not None and Decimal(text):
            raise further.fail(
                f"{text} is given: a fourth moving axis, whose points and amounts are not known; set it to 0"
            )
    apart: list[InputError] = []
    entries = tuple(entry for k in ENTRIES if (entry := _entry(settings, texts[0], k, found, apart)) is not None)
    if apart and not entries:
        raise apart[0]
    if not entries:
        raise texts[0].fail("holds no moving axis (parameters 5711 to 5713); punch the parameters from 5711 on as well")
    moving = [entry.moving for entry in entries]
    for k, entry in enumerate(entries):
        if entry.moving in moving[:k]:
            raise texts[0].fail(f"{AXES[entry.moving]} is the moving axis of two entries; each may have one")
    remarks = [found.unit_remark(settings.detection_unit_um), *map(str, apart)]
    for entry in entries:
        number, grid = settings.axis_numbers[entry.moving], entry.grid
        if not any((parameter, number) in found.axes for parameter in GRID_PARAMETERS):
            remarks.append(
                f"3620 to 3624 of {AXES[entry.moving]} (A{number}) are not in the file; the points {grid.first} to "
                f"{grid.last}, reference point {grid.reference}, every {grid.interval_mm:f} mm are taken from the machine file"
            )
    if found.passed_over:
        remarks.append(found.passed_over_remark("straightness"))
    return StraightTables(entries, tuple(remarks))


def _entry(
    settings: StraightnessSettings, file: SourceFile, k: int, found: PunchedRecords, apart: list[InputError]
) -> StraightTable | None:
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
        text = f"axis {axis} is none of X, Y, Z (axis numbers {known}): its straightness table is kept apart"
        apart.append(found.common[number][1].fail(text))
        return None
    missing = [str(number) for number in numbers if number not in found.common]
    if missing:
        raise found.common[numbers[0]][1].fail(f"names a moving axis, but parameter {', '.join(missing)} is missing")
    moving, compensated = (settings.axis_numbers.index(number) for number in controlled)
    if moving == compensated:
        raise found.common[numbers[1]][1].fail(f"{AXES[moving]} is both moving and compensated axis")
    grid = _read_grid(settings, file, moving, found)
    points = [whole(number, 0, 9999) for number in numbers[2:6]]
    for number, before, point in zip(numbers[3:6], points, points[1:], strict=False):
        if point <= before:
            raise found.common[number][1].fail(f"point {point} does not lie behind {before}; a < b < c < d is due")
    if not grid.first <= points[0] <= points[-1] <= grid.last:
        raise found.common[numbers[2]][1].fail(
            f"points {points[0]} to {points[-1]} are not within those of {AXES[moving]}, {grid.first} to {grid.last}"
        )
    a, b, c, d = points
    p, q, r, s = (whole(number, -1_000_000, 1_000_000) for number in numbers[6:])
    return StraightTable(compensated, moving, (a, b, c, d), (p, q, r, s), grid)


def _read_grid(settings: StraightnessSettings, file: SourceFile, axis: int, found: PunchedRecords) -> PointGrid:
    number = settings.axis_numbers[axis]
    missing = [str(parameter) for parameter in GRID_PARAMETERS if (parameter, number) not in found.axes]
    known = settings.grids[axis]
    if len(missing) == len(GRID_PARAMETERS) and known is not None and not settings.assumed[axis]:
        return known
    if missing:
        raise file.fail(
            f"parameter {', '.join(missing)} is missing for {AXES[axis]} (axis A{number}); give the file that has it as "
            f"well, or state points.{AXES[axis]} in the machine file"
        )
    reference, first, last = (
        found.axes[parameter, number][1].whole(found.axes[parameter, number][0], 0, 9999)
        for parameter in GRID_PARAMETERS[:3]
    )
    text, record = found.axes[GRID_PARAMETERS[3], number]
    return PointGrid(reference, first, last, length_of(record, text, settings.interval_unit_mm))


def straightness_violations(machine: Machine, settings: StraightnessSettings, tables: StraightTables) -> list[str]:
    """Return amounts beyond their range, and travel that the knots leave out."""
    messages = []
    for entry in tables.entries:
        most = max(map(abs, entry.amounts))
        if most > settings.amount_limit:
            messages.append(f"{entry.name}: an amount of {most} counts, the limit is {settings.amount_limit}")
        knots = machine.reference_point_mm[entry.moving] + entry.along_mm
        short = coverage_violations(machine, entry.moving, knots[0], knots[-1], f"the polyline {entry.name}")
        messages += [f"{text}; {AXES[entry.moving]} needs a compensation point at or beyond each end" for text in short]
        known = settings.grids[entry.moving]
        if known is not None and settings.stated[entry.moving] and entry.grid != known:
            messages.append(
                f"{entry.name}: the file has the points {entry.grid.first} to {entry.grid.last} every "
                f"{entry.grid.interval_mm:f} mm, which are not those of the machine file or of the sample"
            )
    return messages


def straightness_usage(settings: StraightnessSettings, tables: StraightTables) -> list[Usage]:
    """Return the largest amount of each entry against its range, and the entries in use."""
    found = [
        Usage(f"amount of {entry.name}", max(map(abs, entry.amounts)), settings.amount_limit, "counts", stated=False)
        for entry in tables.entries
    ]
    return [*found, Usage("moving axes", len(tables.entries), len(ENTRIES), "entries", stated=False)]
