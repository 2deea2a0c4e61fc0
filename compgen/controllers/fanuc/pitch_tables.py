"""Numbers of stored pitch error compensation: reading them from text, the curve they mean, the limits they must keep.

Section n is ((n - 1 - ref) d, (n - ref) d] from the reference point, d the interval (parameter 3624), ref the number
of the reference point (3620). With incremental values v the cumulative curve A is zero at the reference point and
A[n] = A[n-1] + v[n]; with total values A[n] is stored. One count is magnification (3623) times detection unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from compgen.controllers.base import SourceFile
from compgen.controllers.fanuc.pitch_settings import PitchSettings
from compgen.controllers.fanuc.sample import (
    AXIS_PARAMETERS,
    MOST_NUMBER,
    TOTAL_PARAMETER,
    UNIT_PARAMETER,
    Parameters,
    PunchedRecords,
    check_increments,
    length_of,
)
from compgen.controllers.fanuc.text import Record, read_records, type_word
from compgen.core.csvio import FloatArray
from compgen.core.names import AXES
from compgen.errors import InputError

REFERENCE, FARTHEST_NEGATIVE, FARTHEST_POSITIVE, MAGNIFICATION, INTERVAL = PARAMETERS = (3620, 3621, 3622, 3623, 3624)
#: Travel per revolution of a rotary axis; bi-directional: farthest negative number and value at the reference point.
PER_TURN, NEGATIVE_FIRST, AT_REFERENCE = 3625, 3626, 3627
#: Bit 0: a table for each direction of travel.
DIRECTIONS = 3605
#: Total values travel as 16-bit numbers.
MOST_TOTAL = 32767


@dataclass(frozen=True)
class PitchBlock:
    """The table of one axis.

    ``values`` are the numbers as stored, for the point numbers ``first`` ... ``last``, shape (n,); ``total`` tells
    how they count; ``reference`` is the number of the reference point.

    Bi-directional: ``values`` act in travel in positive direction, ``negative`` (as many, from the number
    ``negative_first``, parameter 3626) in negative direction; ``at_reference`` (3627) is what the curve of the direction
    against the reference return has at the reference point, where the other one is zero.
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
        """Farthest number on the positive side."""
        return self.first + len(self.values) - 1

    @property
    def curve_numbers(self) -> NDArray[np.int64]:
        """Point numbers of the cumulative curve, shape (m,); its positions are (number - reference) intervals."""
        return np.arange(self.first if self.total else self.first - 1, self.last + 1)

    @property
    def curve(self) -> NDArray[np.int64]:
        """Cumulative curve A in counts at ``curve_numbers``, zero at the reference number, shape (m,)."""
        return self._sums(self.values)

    def points(self) -> list[tuple[int, int]]:
        """Return all (point number, value) of the axis, those for travel in negative direction behind the others."""
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
class Shortfall:
    """What the limit of the change per section costs an axis: how far the best table misses, and where it is full."""

    axis: int
    missed_counts: float
    sections: tuple[int, ...]


@dataclass(frozen=True)
class Wanted:
    """Wanted curve of one axis: ``counts`` (n,), real numbers, at section ends ``nodes_mm`` (n,) in machine coordinates."""

    nodes_mm: FloatArray
    counts: FloatArray


@dataclass(frozen=True)
class PitchTables:
    """Tables of X, Y, Z (None: the axis has none); ``others`` holds (axis number, first, last) of further axes.

    ``turns`` holds (axis number, sum of the values over a revolution) of rotary axes among these. ``shortfalls`` and
    ``wanted`` are known of tables that were built; tables read from text do not say what was wanted, but what ``remarks``
    there are on the reading.
    """

    blocks: tuple[PitchBlock | None, PitchBlock | None, PitchBlock | None]
    others: tuple[tuple[int, int, int], ...] = ()
    turns: tuple[tuple[int, int], ...] = field(default=(), compare=False)
    shortfalls: tuple[Shortfall, ...] = field(default=(), compare=False)
    wanted: tuple[Wanted | None, Wanted | None, Wanted | None] = field(default=(None, None, None), compare=False)
    remarks: tuple[str, ...] = field(default=(), compare=False)


Points = dict[int, list[Record]]


def parse_pitch(settings: PitchSettings, files: Sequence[SourceFile]) -> PitchTables:
    """Read the tables from FANUC text; files that end in ``.json`` (the plan beside them) are left out.

    Parameters that have nothing to do with compensation are passed over, the points of other axes are kept apart.
    InputError, with file and line, for a missing or doubled parameter of an axis or point of its block, for a cut file,
    for an inch machine, for a table of each direction that the machine file does not have, and for anything unreadable.
    """
    texts = [file for file in files if file.path.suffix.lower() != ".json"]
    if not texts:
        raise InputError("no FANUC text file is given; PITCH.TXT (or a file punched from the control) is needed")
    found, points = PunchedRecords(settings.sample.style.path or 1), Points()
    for file in texts:
        for record in read_records(file):
            _sort_in(record, settings.number_base, found, points)
    found.check_metric()
    if not settings.total:
        check_increments(found.common)
    parameters = found.axes
    _check_directions(settings, parameters)
    blocks = [_block(settings, texts[0], axis, parameters, points) for axis in range(3)]
    if not any(blocks):
        numbers = ", ".join(f"A{number}" for number in settings.axis_numbers)
        raise texts[0].fail(f"holds none of the parameters 3620 to 3624 for the axes {numbers}; punch them as well")
    others = _others(settings, parameters)
    turns = _turns(settings, others, parameters, points)
    return PitchTables(
        (blocks[0], blocks[1], blocks[2]), others, turns, remarks=_remarks(settings, found, others, points)
    )


def _sort_in(record: Record, base: int, found: PunchedRecords, points: Points) -> None:
    """Put a record where it belongs: among the points (a parameter of the same number is told later), or parameters."""
    point, parameter = record.number - base, record.number in (*AXIS_PARAMETERS, UNIT_PARAMETER, TOTAL_PARAMETER)
    kind = type_word(record, record.words())[0]
    if 0 <= point <= MOST_NUMBER and kind != 1:
        points.setdefault(point, []).append(record)
    elif not parameter:
        found.passed_over += 1
    if parameter and not (base < 10000 and kind == 0):
        found.take(record, is_point=False)


def _check_directions(settings: PitchSettings, parameters: Parameters) -> None:
    """Refuse a file whose 3605#0 says otherwise than ``bidirectional``: half of its tables would be read wrongly."""
    for letter, number in zip(AXES, settings.axis_numbers, strict=True):
        text, record = parameters.get((DIRECTIONS, number), ("", None))
        if record is not None and text.endswith("1") != settings.bidirectional:
            word = "true" if text.endswith("1") else "false"
            raise record.fail(
                f"bit 0 of {letter} (A{number}) is {text[-1:]}: set bidirectional = {word} in [controllers.fanuc-pitch] to "
                f"read this file"
            )


def _remarks(
    settings: PitchSettings, found: PunchedRecords, others: Sequence[tuple[int, int, int]], points: Points
) -> tuple[str, ...]:
    """Say what was assumed of the unit, which axes are kept apart, and how many records were passed over."""
    said = [found.unit_remark(settings.detection_unit_um)]
    for axis, first, last in others:
        said.append(
            f"axis A{axis} (not X, Y or Z of the machine file) has the compensation points {first} to {last}: kept apart"
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
            f"3605 of X, Y, Z is {', '.join(bits)} (bit 7 first); which bit makes the compensation interpolated is not settled, "
            f"read as {settings.interpolation}"
        )
    if found.passed_over:
        said.append(found.passed_over_remark("pitch"))
    return tuple(said)


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


def _others(settings: PitchSettings, parameters: Parameters) -> tuple[tuple[int, int, int], ...]:
    """Blocks of axes other than X, Y, Z that are switched on (magnification above zero)."""
    found = []
    for axis in sorted({axis for _, axis in parameters} - set(settings.axis_numbers)):
        entries = [parameters.get((number, axis)) for number in (FARTHEST_NEGATIVE, FARTHEST_POSITIVE, MAGNIFICATION)]
        numbers = [record.whole(text, 0, MOST_NUMBER) for text, record in (entry for entry in entries if entry)]
        if len(numbers) == 3 and numbers[2] > 0:
            found.append((axis, numbers[0], numbers[1]))
    return tuple(found)


def _turns(
    settings: PitchSettings, others: Sequence[tuple[int, int, int]], parameters: Parameters, points: Points
) -> tuple[tuple[int, int], ...]:
    """Sum of the values over a revolution, of further axes whose numbers span their travel per revolution (3625).

    Source: Series 0i-PB parameter manual B-63980EN/01, p. 100: the numbers go from the reference point's to it plus
    travel per revolution over interval; the values behind the first must sum to zero.
    """
    found = []
    for axis, first, last in others:
        text, record = parameters.get((PER_TURN, axis), ("0", None))
        interval = Decimal(parameters[INTERVAL, axis][0]) if (INTERVAL, axis) in parameters else Decimal(0)
        there = all(number in points for number in range(first + 1, last + 1))
        if there and record is not None and interval > 0 and Decimal(text) == (last - first) * interval:
            found.append((axis, sum(_values(settings, (first + 1, last), record, points))))
    return tuple(found)
