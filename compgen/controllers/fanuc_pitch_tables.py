"""Numbers of stored pitch error compensation: reading them from text, the curve they mean, the limits they must keep.

Section n is ((n - 1 - ref) d, (n - ref) d] from the reference point, d the interval (parameter 3624), ref the number
of the reference point (3620). With incremental values v the cumulative curve A is zero at the reference point and
A[n] = A[n-1] + v[n]; with total values A[n] is stored. One count is magnification (3623) times detection unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from compgen.controllers.base import SourceFile, Usage, coverage_violations
from compgen.controllers.fanuc_pitch_settings import PitchSettings
from compgen.controllers.fanuc_text import Record, axis_values, read_records, type_word
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.errors import InputError

REFERENCE, FARTHEST_NEGATIVE, FARTHEST_POSITIVE, MAGNIFICATION, INTERVAL = PARAMETERS = (3620, 3621, 3622, 3623, 3624)
#: Total values travel as 16-bit numbers.
MOST_TOTAL = 32767
#: A table that misses by more counts than this because its steps are limited is not acceptable.
MOST_MISSED = 1.0
#: Largest compensation point number that is read at all; what the control takes is checked by the limits.
MOST_NUMBER = 9999


@dataclass(frozen=True)
class PitchBlock:
    """The table of one axis.

    ``values`` are the numbers as stored, for the point numbers ``first`` ... ``last``, shape (n,); ``total`` tells
    how they count; ``reference`` is the number of the reference point.
    """

    reference: int
    first: int
    values: tuple[int, ...]
    total: bool
    magnification: int
    interval_mm: Decimal

    @property
    def last(self) -> int:
        """Farthest number on the positive side."""
        return self.first + len(self.values) - 1

    @property
    def curve_numbers(self) -> NDArray[np.int64]:
        """Point numbers of the cumulative curve, shape (m,); its positions are (number - reference) intervals."""
        return np.arange(self.first if self.total else self.first - 1, self.last + 1)

    @property
    def curve(self) -> NDArray[np.int64]:
        """Cumulative curve A in counts at ``curve_numbers``, zero at the reference number, shape (m,)."""
        values = np.array(self.values, dtype=np.int64)
        sums = values if self.total else np.concatenate([[0], np.cumsum(values)])
        return np.asarray(sums - sums[self.reference - self.curve_numbers[0]], dtype=np.int64)

    @property
    def curve_mm(self) -> FloatArray:
        """Positions of the cumulative curve from the reference point, shape (m,), mm."""
        return np.array([float(number * self.interval_mm) for number in (self.curve_numbers - self.reference).tolist()])


@dataclass(frozen=True)
class Shortfall:
    """What the limit of the change per section costs an axis: how far the best table misses, and where it is full."""

    axis: int
    missed_counts: float
    sections: tuple[int, ...]


@dataclass(frozen=True)
class PitchTables:
    """Tables of X, Y, Z (None: the axis has none); ``others`` holds (axis number, first, last) of further axes.

    ``shortfalls`` is known of tables that were built; tables read from text do not say what was wanted.
    """

    blocks: tuple[PitchBlock | None, PitchBlock | None, PitchBlock | None]
    others: tuple[tuple[int, int, int], ...] = ()
    shortfalls: tuple[Shortfall, ...] = field(default=(), compare=False)


Parameters = dict[tuple[int, int], tuple[str, Record]]
Points = dict[int, list[Record]]


def parse_pitch(settings: PitchSettings, files: Sequence[SourceFile]) -> PitchTables:
    """Read the tables from FANUC text; files that end in ``.json`` (the plan beside them) are left out.

    Parameters other than 3620 ... 3624 and points of other axes are passed over. InputError, with file and line, for
    a missing or doubled parameter of an axis or point of its block, for a cut file and for anything unreadable.
    """
    texts = [file for file in files if file.path.suffix.lower() != ".json"]
    if not texts:
        raise InputError("no FANUC text file is given; PITCH.TXT (or a file punched from the control) is needed")
    parameters: Parameters = {}
    points: Points = {}
    for file in texts:
        for record in read_records(file):
            _sort_in(record, settings.number_base, parameters, points)
    blocks = [_block(settings, texts[0], axis, parameters, points) for axis in range(3)]
    if not any(blocks):
        numbers = ", ".join(f"A{number}" for number in settings.axis_numbers)
        raise texts[0].fail(f"holds none of the parameters 3620 to 3624 for the axes {numbers}; punch them as well")
    return PitchTables((blocks[0], blocks[1], blocks[2]), _others(settings, parameters))


def _sort_in(record: Record, base: int, parameters: Parameters, points: Points) -> None:
    """Put a record where it belongs; one of another number is passed over."""
    point = record.number - base
    if 0 <= point <= MOST_NUMBER:
        points.setdefault(point, []).append(record)
    if record.number not in PARAMETERS:
        return
    kind, words = type_word(record, record.words())
    if kind == 0 and base < 10000:
        return
    if kind not in (None, 1):
        raise record.fail(f"the type word Q{kind} stands at a parameter; Q1 is due")
    for axis, text in axis_values(record, words):
        if (record.number, axis) in parameters:
            first = parameters[record.number, axis][1]
            raise record.fail(f"axis A{axis} stands here a second time (first in {first.file.path}:{first.line})")
        parameters[record.number, axis] = text, record


def _point_values(settings: PitchSettings, records: Sequence[Record]) -> list[tuple[int, Record]]:
    """Values of the records that are pitch data: of type Q0, or without type and axis word.

    A parameter of the same number has the type word Q1 or axis words.
    """
    found = []
    for record in records:
        kind, words = type_word(record, record.words())
        if kind == 0 or (kind is None and settings.number_base >= 10000 and not any(w[0] in "AS" for w in words)):
            if len(words) != 1 or words[0][0] != "P":
                raise record.fail("a single value word P is due for a compensation point, e.g. P-2")
            found.append((record.whole(words[0][1], -10 * MOST_TOTAL, 10 * MOST_TOTAL), record))
    return found


def _block(
    settings: PitchSettings, file: SourceFile, axis: int, parameters: Parameters, points: Points
) -> PitchBlock | None:
    number = settings.axis_numbers[axis]
    missing = [str(parameter) for parameter in PARAMETERS if (parameter, number) not in parameters]
    if len(missing) == len(PARAMETERS):
        return None
    if missing:
        raise file.fail(f"parameter {', '.join(missing)} is missing for {AXES[axis]} (axis A{number})")

    def whole(parameter: int, high: int) -> int:
        text, record = parameters[parameter, number]
        return record.whole(text, 0, high)

    first, last = whole(FARTHEST_NEGATIVE, MOST_NUMBER), whole(FARTHEST_POSITIVE, MOST_NUMBER)
    reference = whole(REFERENCE, MOST_NUMBER)
    lowest = first if settings.total else first - 1
    if last < first or not lowest <= reference <= last:
        raise parameters[REFERENCE, number][1].fail(
            f"{AXES[axis]} has the reference point {reference} and the points {first} to {last}; the reference point "
            f"must be one of {lowest} to {last}"
        )
    return PitchBlock(
        reference=reference,
        first=first,
        values=_values(settings, (first, last), parameters[FARTHEST_POSITIVE, number][1], points),
        total=settings.total,
        magnification=whole(MAGNIFICATION, 100),
        interval_mm=_interval(settings, *parameters[INTERVAL, number]),
    )


def _values(settings: PitchSettings, span: tuple[int, int], who: Record, points: Points) -> tuple[int, ...]:
    """Values of the points from ``span[0]`` to ``span[1]``, each of which must be there once."""
    values, absent = [], []
    for number in range(span[0], span[1] + 1):
        found = _point_values(settings, points.get(number, ()))
        if len(found) > 1:
            first = found[0][1]
            raise found[1][1].fail(f"stands here a second time (first in {first.file.path}:{first.line})")
        values += [value for value, _ in found]
        absent += [] if found else [number]
    if absent:
        some = ", ".join(map(str, absent[:5])) + (", ..." if len(absent) > 5 else "")
        raise who.fail(f"gives points {span[0]} to {span[1]}, but {some} ({len(absent)} in all) are missing")
    return tuple(values)


def _interval(settings: PitchSettings, text: str, record: Record) -> Decimal:
    """Interval in mm: a number with a decimal point is in mm, one without counts in the machine file's unit."""
    value = Decimal(text) if "." in text else Decimal(text) * Decimal(repr(settings.interval_unit_mm))
    if not 0 < value < 100000:
        raise record.fail(f"the interval {value} mm is not possible; it is the positive length of a section")
    return value


def _others(settings: PitchSettings, parameters: Parameters) -> tuple[tuple[int, int, int], ...]:
    """Blocks of axes other than X, Y, Z that are switched on (magnification above zero)."""
    found = []
    for axis in sorted({axis for _, axis in parameters} - set(settings.axis_numbers)):
        entries = [parameters.get((number, axis)) for number in (FARTHEST_NEGATIVE, FARTHEST_POSITIVE, MAGNIFICATION)]
        numbers = [record.whole(text, 0, MOST_NUMBER) for text, record in (entry for entry in entries if entry)]
        if len(numbers) == 3 and numbers[2] > 0:
            found.append((axis, numbers[0], numbers[1]))
    return tuple(found)


def pitch_violations(machine: Machine, settings: PitchSettings, tables: PitchTables) -> list[str]:
    """Return every limit that the tables break, and travel that they leave out, in words."""
    messages = []
    for axis, block in enumerate(tables.blocks):
        if block is None:
            messages.append(f"{AXES[axis]} has no pitch table: none of its travel is covered")
        else:
            messages += _block_violations(settings, AXES[axis], block)
            first_mm, last_mm = machine.reference_point_mm[axis] + block.curve_mm[[0, -1]]
            messages += coverage_violations(machine, axis, first_mm, last_mm, f"the pitch table of {AXES[axis]}")
    messages += [shortfall_text(settings, item) for item in tables.shortfalls if item.missed_counts > MOST_MISSED]
    return messages + _overlaps(tables)


def shortfall_text(settings: PitchSettings, shortfall: Shortfall) -> str:
    """Say that the limit of the change per section keeps a table from what was wanted, and what helps."""
    numbers = ", ".join(map(str, shortfall.sections[:5])) + (", ..." if len(shortfall.sections) > 5 else "")
    return (
        f"{AXES[shortfall.axis]}: the wanted curve is too steep, the limit is {settings.increment_limit} counts per "
        f"section: {len(shortfall.sections)} sections are full (points {numbers}), and even the best table misses by up "
        f"to {shortfall.missed_counts * settings.count_mm / MM_PER_UM:.1f} um; a shorter interval or a larger "
        f"magnification is needed"
    )


def _block_violations(settings: PitchSettings, name: str, block: PitchBlock) -> list[str]:
    messages = _value_violations(settings, name, block)
    if block.last > settings.last_number:
        messages.append(
            f"{name}: the points {block.first} to {block.last} go beyond the last number {settings.last_number}"
        )
    if block.magnification == 0:
        messages.append(f"{name}: the magnification is 0, which switches the table off")
    if float(block.interval_mm) < settings.least_interval_mm - 1e-9:
        messages.append(
            f"{name}: the interval {block.interval_mm:f} mm is shorter than the {settings.least_interval_mm:g} mm that "
            f"{settings.max_feed_mm_min:g} mm/min need"
        )
    return messages


def _value_violations(settings: PitchSettings, name: str, block: PitchBlock) -> list[str]:
    messages = []
    steps = np.abs(np.diff(block.curve))
    if steps.size and steps.max() > settings.increment_limit:
        worst = int(np.argmax(steps))
        messages.append(
            f"{name}: the change over section {block.curve_numbers[worst + 1]} is {steps[worst]} counts, the limit is "
            f"{settings.increment_limit}; a shorter interval or a larger magnification is needed"
        )
    if block.total and max(map(abs, block.values)) > MOST_TOTAL:
        most = max(map(abs, block.values))
        messages.append(f"{name}: a total value of {most} counts does not fit 16 bits ({MOST_TOTAL})")
    if block.total and block.values[block.reference - block.first] != 0:
        messages.append(f"{name}: the total value at the reference point {block.reference} must be 0")
    return messages


def _overlaps(tables: PitchTables) -> list[str]:
    spans = [(AXES[k], block.first, block.last) for k, block in enumerate(tables.blocks) if block is not None]
    spans += [(f"axis A{number}", first, last) for number, first, last in tables.others]
    return [
        f"the compensation points of {a} ({a_first} to {a_last}) and {b} ({b_first} to {b_last}) overlap"
        for (a, a_first, a_last), (b, b_first, b_last) in combinations(spans, 2)
        if a_first <= b_last and b_first <= a_last
    ]


def pitch_usage(settings: PitchSettings, tables: PitchTables) -> list[Usage]:
    """Return the largest change over a section, the point numbers and the interval against their limits."""
    found, used = [], 0
    for axis, block in enumerate(tables.blocks):
        if block is None:
            continue
        used += len(block.values)
        step = int(np.max(np.abs(np.diff(block.curve)), initial=0))
        found.append(Usage(f"change over a section of {AXES[axis]}", step, settings.increment_limit, "counts"))
        if settings.max_feed_mm_min is not None:
            least, own = settings.least_interval_mm, float(block.interval_mm)
            found.append(Usage(f"shortest section at the feed, {AXES[axis]}", least, own, "mm"))
    numbers = settings.last_number - settings.first_number + 1
    return [*found, Usage("compensation points", used, numbers, "points")]
