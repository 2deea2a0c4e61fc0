"""FANUC stored pitch error compensation: settings, the tables as numbers and as text, and their limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.controls.fanuc_records import (
    AXIS_PARAMETERS,
    MOST_NUMBER,
    TOTAL_PARAMETER,
    UNIT_PARAMETER,
    Parameters,
    PointGrid,
    PunchedRecords,
    PunchedSettings,
    Record,
    check_increments,
    length_of,
    read_records,
    take_punched,
    type_word,
)
from compgen.controls.shared.base import SourceFile, Usage, coverage_violations
from compgen.controls.shared.grids import loss_setting
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import (
    accepted,
    accepts,
    array_schema,
    axis_setting,
    choice,
    setting,
    whole,
    word_for,
)
from compgen.errors import InputError

# Settings of ``[controllers.fanuc-pitch]``: the control's counts, its file style, the free numbers.


#: Smallest step of the interval (parameter 3624) if written with a decimal point.
INTERVAL_QUANTUM_MM = Decimal("0.001")


@accepts(array_schema({"type": "array", "items": accepted(whole(0, MOST_NUMBER)), "minItems": 2, "maxItems": 2}))
def _spans(value: Any) -> tuple[tuple[int, int], ...]:
    """A list of blocks of numbers."""
    if not isinstance(value, list):
        raise ValueError("expected a list of blocks of numbers [[first, last], ...]")
    number = whole(0, MOST_NUMBER)
    for item in value:
        if not isinstance(item, list) or len(item) != 2 or number(item[0]) > number(item[1]):
            raise ValueError("expected blocks of numbers [first, last], the lower one first")
    return tuple((first, last) for first, last in value)


@dataclass(frozen=True, kw_only=True)
class PitchSettings(PunchedSettings):
    """Settings of stored pitch error compensation.

    Number 0 is not used by default: axes without a table have 3620 ... 3622 = 0 and would also use its value. ``kept``
    are the compensation points of X, Y, Z in the sample that are kept; None: there are none, or the machine
    file states others.
    """

    interval_mm: tuple[float | None, float | None, float | None] = axis_setting(
        toml_files.positive,
        meaning="length of a section, e.g. { X = 50.0 }; default: that of the sample, else chosen automatically",
    )
    first_numbers: tuple[int | None, int | None, int | None] = axis_setting(
        whole(0, MOST_NUMBER),
        meaning="first point number of the block of an axis, e.g. { X = 100 }; default: that of the sample, else "
        "assigned",
    )
    magnification: int | None = setting(
        whole(1, 100),
        None,
        meaning="parameter 3623, 1 to 100; one count is magnification times detection unit. Default: that of the sample, "
        "else 1",
    )
    value_type: str = setting(
        choice("incremental", "total"),
        "incremental",
        meaning='change over a section, or "total" (sum up to the point)',
    )
    interpolation: str = setting(
        choice("linear", "staircase"),
        "linear",
        meaning='how a value acts inside a section; "staircase" outputs the whole value at its beginning',
    )
    max_feed_mm_min: float | None = setting(
        toml_files.positive,
        None,
        meaning="fastest feed; if set, a section must be at least feed / 7500 mm long",
    )
    increment_limit: int = setting(whole(1, 127), 7, meaning="largest change over a section in counts, 1 to 127")
    loss_mm: float = loss_setting()
    first_number: int = setting(
        whole(0, MOST_NUMBER), 1, meaning="first compensation point number that may be used; by default 0 is not used"
    )
    last_number: int = setting(
        whole(0, MOST_NUMBER),
        1023,
        meaning="last compensation point number that may be used; default 1023, or the last one of a sample that has more",
    )
    reserved: tuple[tuple[int, int], ...] = setting(
        _spans,
        (),
        key="reserved_numbers",
        meaning="blocks of point numbers of other axes, e.g. [[60, 68]]: never written",
    )
    bidirectional: bool = setting(
        toml_files.flag,
        False,
        meaning="a table for each direction of travel (3605#0 = 1, 3626, 3627); false: backlash parameters 1851, 1852",
    )
    negative_first_number: int = setting(
        whole(0, MOST_NUMBER), 3000, meaning="first point number for travel in negative direction"
    )
    negative_last_number: int = setting(
        whole(0, MOST_NUMBER), 4023, meaning="last point number for travel in negative direction"
    )
    reference_return: tuple[int, int, int] = axis_setting(
        word_for({"positive": 1, "negative": -1}),
        (1, 1, 1),
        meaning='direction of the reference return, e.g. { X = "negative" }; default "positive". A wrong direction '
        "doubles the reversal",
    )
    kept: tuple[PointGrid | None, ...] = (None, None, None)

    @property
    def magnifications(self) -> tuple[int, ...]:
        """Magnification of X, Y, Z: from the machine file, else from the sample if it has one, else 1."""
        shown = [self.sample.axes.get(number) for number in self.axis_numbers]
        return tuple(self.magnification or (axis.magnification if axis else 0) or 1 for axis in shown)

    @property
    def total(self) -> bool:
        """Whether a value is the sum up to its point (total value)."""
        return self.value_type == "total"

    def count_mm(self, axis: int) -> float:
        """One count of the table written for an axis 0..2, mm."""
        return self.magnifications[axis] * self.detection_unit_um * MM_PER_UM

    @property
    def interval_quantum_mm(self) -> Decimal:
        """Step of the interval as written, mm."""
        if not self.style.real_point:
            return Decimal(repr(self.interval_unit_mm))
        return max(INTERVAL_QUANTUM_MM, Decimal(1).scaleb(-(self.style.decimals or 3)))

    @property
    def least_interval_mm(self) -> float:
        """Shortest section at the fastest feed, mm (0 if no feed is given)."""
        return 0.0 if self.max_feed_mm_min is None else self.max_feed_mm_min / 7500.0


def read_pitch_settings(machine: Machine) -> PitchSettings:
    """Read and check ``[controllers.fanuc-pitch]``; every key except ``interval_unit_mm`` (see there) has a default."""
    section = machine.controller_settings("fanuc-pitch")
    settings = take_punched(PitchSettings, section)
    settings.finish(section)
    shown = settings.sample.values
    # a sample containing all points from 0 on without a gap shows how many the control has
    last = len(shown) - 1 if sorted(shown) == list(range(len(shown))) else 0
    settings = toml_files.unless_stated(settings, section, last_number=max(settings.last_number, last))
    settings = replace(settings, kept=_kept(settings))
    _check_together(section, settings)
    return settings


def _kept(settings: PitchSettings) -> tuple[PointGrid | None, ...]:
    """Compensation points of X, Y, Z in the sample, unless the machine file states another interval or number."""
    found: list[PointGrid | None] = []
    for k, number in enumerate(settings.axis_numbers):
        axis, interval_mm, first = settings.sample.axes.get(number), settings.interval_mm[k], settings.first_numbers[k]
        if (
            axis is None
            or not axis.grid.interval_mm
            or axis.grid.first == axis.grid.last
            or (interval_mm is not None and Decimal(repr(interval_mm)) != axis.grid.interval_mm)
            or first not in (None, axis.grid.first)
        ):
            found.append(None)
            continue
        grid = axis.grid
        if not grid.first - 1 <= grid.reference <= grid.last:
            raise axis.record.fail(
                f"axis A{number} has the reference point {grid.reference} (3620) and the points {grid.first} to "
                f"{grid.last}; these points cannot be kept: for new ones set first_numbers and interval_mm in the "
                "machine file"
            )
        found.append(grid)
    return tuple(found)


def _check_together(section: toml_files.Section, settings: PitchSettings) -> None:
    if settings.last_number < settings.first_number:
        raise section.fail("last_number", f"is below first_number = {settings.first_number}")
    if settings.bidirectional:
        # no public document settles how 3627 counts with total values, and with a magnification
        if settings.total:
            raise section.fail("value_type", "how 3627 counts with total values is not documented; use 'incremental'")
        if settings.magnifications != (1, 1, 1):
            raise section.fail(
                "magnification",
                "whether 3627 is multiplied by it is not documented; with bidirectional = true it must be 1 (for steep "
                "curves use a larger increment_limit or shorter sections)",
            )
        if settings.negative_last_number < settings.negative_first_number:
            raise section.fail("negative_last_number", f"is below {settings.negative_first_number}")
    for letter, number in () if settings.bidirectional else zip(AXES, settings.axis_numbers, strict=True):
        if (settings.sample.bits(3605, number) or "0").endswith("1"):
            raise settings.sample.parameters[3605, number][1].fail(
                f"bit 0 is 1 for {letter} (A{number}): this control has a table for each direction of travel. Set "
                "bidirectional = true in [controllers.fanuc-pitch], or set the bit to 0 and punch the file again"
            )
    if not settings.total:
        check_increments(settings.sample.common)
    if settings.number_base < 10000 and not settings.style.q_word:
        raise section.fail(
            "number_base",
            f"{settings.number_base} makes pitch data look like parameters; set 10000 or more, or q_word = true",
        )
    for axis, interval_mm in zip(AXES, settings.interval_mm, strict=True):
        if interval_mm is not None and Decimal(repr(interval_mm)) % settings.interval_quantum_mm:
            message = (
                f"{axis} = {interval_mm:g} mm cannot be written; expected a multiple of {settings.interval_quantum_mm} "
                "mm"
            )
            raise section.fail("interval_mm", message)


# Numbers of stored pitch error compensation: reading them from text, the curve they represent, their limits.
#
# Section n is ((n - 1 - ref) d, (n - ref) d] from the reference point; d: interval (parameter 3624), ref: number
# of the reference point (3620). With incremental values v the cumulative curve A is zero at the reference point and
# A[n] = A[n-1] + v[n]; with total values A[n] is stored. One count is magnification (3623) times detection unit.


REFERENCE, FARTHEST_NEGATIVE, FARTHEST_POSITIVE, MAGNIFICATION, INTERVAL = PARAMETERS = (3620, 3621, 3622, 3623, 3624)
#: Travel per revolution of a rotary axis; bi-directional: farthest negative number and value at the reference point.
PER_TURN, NEGATIVE_FIRST, AT_REFERENCE = 3625, 3626, 3627
#: Bit 0: a table for each direction of travel.
DIRECTIONS = 3605
#: Total values are transferred as 16-bit numbers.
MOST_TOTAL = 32767


@dataclass(frozen=True)
class PitchBlock:
    """The table of one axis.

    ``values`` are the numbers as stored, for point numbers ``first`` ... ``last``, shape (n,); ``total`` tells
    whether they are total values; ``reference`` is the number of the reference point.

    Bi-directional: ``values`` act during travel in positive direction, ``negative`` (as many, from number
    ``negative_first``, parameter 3626) in negative direction; ``at_reference`` (3627) is the value at the reference
    point of the curve for the direction opposite to the reference return; the other curve is zero there.
    """

    reference: int
    first: int
    values: tuple[int, ...]
    total: bool
    magnification: int
    interval_mm: Decimal
    negative: tuple[int, ...] = ()
    negative_first: int = 0
    at_reference: int = 0

    @property
    def last(self) -> int:
        """Number farthest on the positive side."""
        return self.first + len(self.values) - 1

    @property
    def negative_last(self) -> int:
        """Last number for travel in negative direction."""
        return self.negative_first + len(self.negative) - 1

    @property
    def curve_numbers(self) -> NDArray[np.int64]:
        """Point numbers of the cumulative curve, shape (m,); its positions are (number - reference) intervals."""
        return np.arange(self.first if self.total else self.first - 1, self.last + 1)

    @property
    def curve(self) -> NDArray[np.int64]:
        """Cumulative curve A in counts at ``curve_numbers``, zero at the reference number, shape (m,)."""
        return self._sums(self.values)

    def points(self) -> list[tuple[int, int]]:
        """Return all (point number, value) of the axis, those for travel in negative direction last."""
        found = [(self.first + k, value) for k, value in enumerate(self.values)]
        return found + [(self.negative_first + k, value) for k, value in enumerate(self.negative)]

    def _sums(self, stored: tuple[int, ...]) -> NDArray[np.int64]:
        values = np.array(stored, dtype=np.int64)
        sums = values if self.total else np.concatenate([[0], np.cumsum(values)])
        return np.asarray(sums - sums[self.reference - self.curve_numbers[0]], dtype=np.int64)

    def curves(self, reference_return: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Curves after travel in positive and in negative direction, for a reference return in direction +1 or -1."""
        if not self.negative:
            return self.curve, self.curve
        positive, negative = self.curve, self._sums(self.negative)
        if reference_return > 0:
            return positive, negative + self.at_reference
        return positive + self.at_reference, negative

    @property
    def curve_mm(self) -> FloatArray:
        """Positions of the cumulative curve from the reference point, shape (m,), mm."""
        return np.array([float(number * self.interval_mm) for number in (self.curve_numbers - self.reference).tolist()])


@dataclass(frozen=True)
class PitchShortfall:
    """Effect of the limit of the change per section on an axis: deviation of the best table, where it is reached."""

    axis: int
    missed_counts: float
    sections: tuple[int, ...]


@dataclass(frozen=True)
class RequestedPitch:
    """Requested curve of one axis: real ``counts`` (n,) at section ends ``nodes_mm`` (n,), machine coordinates."""

    nodes_mm: FloatArray
    counts: FloatArray


@dataclass(frozen=True)
class PitchTables:
    """Tables of X, Y, Z (None: the axis has none); ``others`` contains (axis number, first, last) of other axes.

    ``turns`` contains (axis number, sum of the values over a revolution) for rotary ones of these. ``shortfalls`` and
    ``requested`` are known only for tables that were built: text does not tell what was requested. ``remarks`` are
    those from reading text.
    """

    blocks: tuple[PitchBlock | None, ...]
    others: tuple[tuple[int, int, int], ...] = ()
    turns: tuple[tuple[int, int], ...] = field(default=(), compare=False)
    shortfalls: tuple[PitchShortfall, ...] = field(default=(), compare=False)
    requested: tuple[RequestedPitch | None, ...] = field(default=(None, None, None), compare=False)
    remarks: tuple[str, ...] = field(default=(), compare=False)


PointRecords = dict[int, list[Record]]


def parse_pitch(settings: PitchSettings, files: Sequence[SourceFile]) -> PitchTables:
    """Read the tables from FANUC text; ``.json`` files (the plan) are ignored.

    Parameters unrelated to compensation are skipped; points of other axes are kept apart.
    InputError, with file and line, for a missing or duplicate parameter or point of an axis, a truncated file,
    an inch machine, direction-dependent tables not in the machine file, and for anything unreadable.
    """
    texts = [file for file in files if file.path.suffix.lower() != ".json"]
    if not texts:
        raise InputError("no FANUC text file was given; expected PITCH.TXT (or a file punched from the control)")
    found, points = PunchedRecords(settings.sample.style.path or 1), PointRecords()
    base, known = settings.number_base, (*AXIS_PARAMETERS, UNIT_PARAMETER, TOTAL_PARAMETER)
    for record in (record for file in texts for record in read_records(file)):
        kind = type_word(record, record.words())[0]
        # a parameter may have the number of a point: this is resolved when the points of a block are read
        if 0 <= record.number - base <= MOST_NUMBER and kind != 1:
            points.setdefault(record.number - base, []).append(record)
        elif record.number not in known:
            found.skipped += 1
        if record.number in known and not (base < 10000 and kind == 0):
            found.take(record, is_point=False)
    found.check_metric()
    if not settings.total:
        check_increments(found.common)
    blocks = tuple(_block(settings, texts[0], axis, found.axes, points) for axis in range(3))
    if not any(blocks):
        numbers = ", ".join(f"A{number}" for number in settings.axis_numbers)
        raise texts[0].fail(f"contains none of the parameters 3620 to 3624 for the axes {numbers}; punch them as well")
    others, turns = _other_axes(settings, found.axes, points)
    return PitchTables(blocks, others, turns, remarks=_remarks(settings, found, others))


def _remarks(settings: PitchSettings, found: PunchedRecords, others: Sequence[tuple[int, int, int]]) -> tuple[str, ...]:
    """Say which unit was assumed, which axes are kept apart, and how many records were skipped."""
    said = [found.unit_remark(settings.detection_unit_um)]
    for axis, first, last in others:
        said.append(
            f"axis A{axis} (not X, Y or Z of the machine file) has the compensation points {first} to {last}: not part "
            "of these tables"
        )
    bits = sorted(
        {
            text
            for (number, axis), (text, _) in found.axes.items()
            if number == DIRECTIONS and axis in settings.axis_numbers
        }
    )
    if bits:
        said.append(
            f"3605 of X, Y, Z is {', '.join(bits)} (bit 7 first); public documents do not settle which bit makes the "
            f"compensation interpolated; read as {settings.interpolation}"
        )
    if found.skipped:
        said.append(found.skipped_remark("pitch"))
    return tuple(said)


def _block(
    settings: PitchSettings, file: SourceFile, axis: int, parameters: Parameters, points: PointRecords
) -> PitchBlock | None:
    number = settings.axis_numbers[axis]
    bits, record = parameters.get((DIRECTIONS, number), ("", None))
    if record is not None and bits.endswith("1") != settings.bidirectional:  # half of the tables would be misread
        word = "true" if bits.endswith("1") else "false"
        raise record.fail(
            f"bit 0 of {AXES[axis]} (A{number}) is {bits[-1:]}: set bidirectional = {word} in [controllers.fanuc-pitch] to "
            f"read this file"
        )
    needed = (*PARAMETERS, NEGATIVE_FIRST, AT_REFERENCE) if settings.bidirectional else PARAMETERS
    missing = [str(parameter) for parameter in needed if (parameter, number) not in parameters]
    if set(map(str, PARAMETERS)) <= set(missing):
        return None
    if missing:
        raise file.fail(f"parameter {', '.join(missing)} is missing for {AXES[axis]} (axis A{number})")

    def whole(parameter: int, high: int, low: int = 0) -> int:
        text, record = parameters[parameter, number]
        return record.whole(text, low, high)

    first, last = whole(FARTHEST_NEGATIVE, MOST_NUMBER), whole(FARTHEST_POSITIVE, MOST_NUMBER)
    reference = whole(REFERENCE, MOST_NUMBER)
    lowest = first if settings.total else first - 1
    if last < first or not lowest <= reference <= last:
        raise parameters[REFERENCE, number][1].fail(
            f"{AXES[axis]} has the reference point {reference} and the points {first} to {last}; the reference point "
            f"must be one of {lowest} to {last}"
        )
    block = PitchBlock(
        reference=reference,
        first=first,
        values=_values(settings, (first, last), parameters[FARTHEST_POSITIVE, number][1], points),
        total=settings.total,
        magnification=whole(MAGNIFICATION, 100),
        interval_mm=length_of(
            parameters[INTERVAL, number][1], parameters[INTERVAL, number][0], settings.interval_unit_mm
        ),
    )
    if not settings.bidirectional:
        return block
    negative_first = whole(NEGATIVE_FIRST, MOST_NUMBER)
    span = (negative_first, negative_first + last - first)
    negative = _values(settings, span, parameters[NEGATIVE_FIRST, number][1], points)
    at_reference = whole(AT_REFERENCE, MOST_TOTAL, -MOST_TOTAL - 1)
    return replace(block, negative=negative, negative_first=negative_first, at_reference=at_reference)


def _values(settings: PitchSettings, span: tuple[int, int], who: Record, points: PointRecords) -> tuple[int, ...]:
    """Values of the points from ``span[0]`` to ``span[1]``, each of which must occur once.

    A record is pitch data if it is of type Q0, or has no type and axis words; a parameter of that number has them.
    """
    values, absent = [], []
    for number in range(span[0], span[1] + 1):
        found: list[tuple[str, Record]] = []
        for record in points.get(number, ()):
            kind, words = type_word(record, record.words())
            if kind == 0 or (kind is None and settings.number_base >= 10000 and not any(w[0] in "AS" for w in words)):
                if len(words) != 1 or words[0][0] != "P":
                    raise record.fail("expected a single value word P for a compensation point, e.g. P-2")
                found.append((words[0][1], record))
        if len(found) > 1:
            first = found[0][1]
            raise found[1][1].fail(f"is given a second time (first in {first.file.path}:{first.line})")
        values += [record.whole(text, -10 * MOST_TOTAL, 10 * MOST_TOTAL) for text, record in found]
        absent += [] if found else [number]
    if absent:
        some = ", ".join(map(str, absent[:5])) + (", ..." if len(absent) > 5 else "")
        raise who.fail(f"gives points {span[0]} to {span[1]}, but {some} ({len(absent)} in all) are missing")
    return tuple(values)


def _other_axes(
    settings: PitchSettings, parameters: Parameters, points: PointRecords
) -> tuple[tuple[tuple[int, int, int], ...], tuple[tuple[int, int], ...]]:
    """Active blocks (magnification above zero) of axes other than X, Y, Z, and sums over a revolution.

    Sums are given for rotary axes whose numbers span the travel per revolution (3625). Source: Series 0i-PB parameter
    manual B-63980EN/01, p. 100: the numbers run from the reference point's to that + travel per revolution / interval;
    the values after the first must sum to zero.
    """
    others, turns = [], []
    for axis in sorted({axis for _, axis in parameters} - set(settings.axis_numbers)):
        entries = [parameters.get((number, axis)) for number in (FARTHEST_NEGATIVE, FARTHEST_POSITIVE, MAGNIFICATION)]
        numbers = [record.whole(text, 0, MOST_NUMBER) for text, record in (entry for entry in entries if entry)]
        if len(numbers) < 3 or not numbers[2]:
            continue
        first, last, _ = numbers
        others.append((axis, first, last))
        travel, record = parameters.get((PER_TURN, axis), ("0", None))
        interval = Decimal(parameters[INTERVAL, axis][0]) if (INTERVAL, axis) in parameters else Decimal(0)
        there = all(number in points for number in range(first + 1, last + 1))
        if there and record is not None and interval > 0 and Decimal(travel) == (last - first) * interval:
            turns.append((axis, sum(_values(settings, (first + 1, last), record, points))))
    return tuple(others), tuple(turns)


# Limits of stored pitch error compensation: which ones the tables exceed, and how much of each they use.


#: A table that deviates by more counts than this because of the step limit is not acceptable.
MOST_MISSED = 1.0


def pitch_violations(machine: Machine, settings: PitchSettings, tables: PitchTables) -> list[str]:
    """Return, in words, every limit that the tables exceed and any travel they do not cover."""
    messages = []
    for axis, block in enumerate(tables.blocks):
        if block is None:
            messages.append(f"{AXES[axis]} has no pitch table: none of its travel is covered")
        else:
            messages += _block_violations(settings, AXES[axis], block)
            first_mm, last_mm = machine.reference_point_mm[axis] + block.curve_mm[[0, -1]]
            messages += coverage_violations(machine, axis, first_mm, last_mm, f"the pitch table of {AXES[axis]}")
    messages += [shortfall_text(settings, item) for item in tables.shortfalls if item.missed_counts > MOST_MISSED]
    for axis_number, total in tables.turns:
        if total:
            messages.append(
                f"the values of the rotary axis A{axis_number} sum to {total} counts over a revolution; they must sum "
                "to 0, otherwise every revolution adds to the error"
            )
    present = [(AXES[k], block) for k, block in enumerate(tables.blocks) if block is not None]
    spans = [(name, block.first, block.last) for name, block in present]
    spans += [
        (f"{name} in negative travel", block.negative_first, block.negative_last)
        for name, block in present
        if block.negative
    ]
    spans += [(f"axis A{number}", first, last) for number, first, last in tables.others]
    return messages + [
        f"the compensation points of {a} ({a_first} to {a_last}) and {b} ({b_first} to {b_last}) overlap"
        for (a, a_first, a_last), (b, b_first, b_last) in combinations(spans, 2)
        if a_first <= b_last and b_first <= a_last
    ]


def shortfall_text(settings: PitchSettings, shortfall: PitchShortfall) -> str:
    """Say that the limit on the change per section keeps a table from reaching the request, and what helps."""
    numbers = ", ".join(map(str, shortfall.sections[:5])) + (", ..." if len(shortfall.sections) > 5 else "")
    return (
        f"{AXES[shortfall.axis]}: the requested curve is too steep; the limit is {settings.increment_limit} counts per "
        f"section. {len(shortfall.sections)} sections reach it (points {numbers}), and even the best table misses the "
        f"curve by up to {shortfall.missed_counts * settings.count_mm(shortfall.axis) / MM_PER_UM:.1f} um; set a "
        "shorter interval or a larger magnification"
    )


def _block_violations(settings: PitchSettings, name: str, block: PitchBlock) -> list[str]:
    messages = []
    for curve, way in zip(block.curves(1), ("", " in negative travel"), strict=True):
        steps = np.abs(np.diff(curve))
        if steps.size and steps.max() > settings.increment_limit and (block.negative or not way):
            worst = int(np.argmax(steps))
            messages.append(
                f"{name}: the change over section {block.curve_numbers[worst + 1]}{way} is {steps[worst]} counts; the "
                f"limit is {settings.increment_limit}: set a shorter interval or a larger magnification"
            )
    if block.total and max(map(abs, block.values)) > MOST_TOTAL:
        most = max(map(abs, block.values))
        messages.append(f"{name}: a total value of {most} counts does not fit into 16 bits ({MOST_TOTAL})")
    if block.total and block.values[block.reference - block.first] != 0:
        messages.append(f"{name}: the total value at the reference point {block.reference} must be 0")
    if block.last > settings.last_number:
        messages.append(
            f"{name}: the points {block.first} to {block.last} go beyond the last number {settings.last_number}"
        )
    if block.negative and block.negative_last > settings.negative_last_number:
        messages.append(
            f"{name}: the points for travel in negative direction, from {block.negative_first} on, go beyond the last "
            f"number {settings.negative_last_number}"
        )
    if block.negative and block.magnification != 1:
        messages.append(f"{name}: whether 3627 counts with the magnification {block.magnification} is not documented")
    if block.magnification == 0:
        messages.append(f"{name}: the magnification is 0, which switches the table off")
    if float(block.interval_mm) < settings.least_interval_mm - 1e-9:
        messages.append(
            f"{name}: the interval {block.interval_mm:f} mm is shorter than the {settings.least_interval_mm:g} mm that "
            f"a feed of {settings.max_feed_mm_min:g} mm/min needs"
        )
    return messages


def pitch_usage(settings: PitchSettings, tables: PitchTables) -> list[Usage]:
    """Return the largest change over a section, the point numbers and the interval against their limits."""
    found, used = [], 0
    for axis, block in enumerate(tables.blocks):
        if block is None:
            continue
        used += len(block.values)
        step = max(int(np.max(np.abs(np.diff(curve)), initial=0)) for curve in block.curves(1))
        found.append(Usage(f"change over a section of {AXES[axis]}", step, settings.increment_limit, "counts"))
        if settings.max_feed_mm_min is not None:
            least, interval_mm = settings.least_interval_mm, float(block.interval_mm)
            found.append(Usage(f"shortest section at the feed, {AXES[axis]}", least, interval_mm, "mm"))
    numbers = settings.last_number - settings.first_number + 1
    return [*found, Usage("compensation points", used, numbers, "points")]
