"""Settings of ``[controllers.fanuc-pitch]``: what the control counts in, how its files look, which numbers are free."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any, Literal

from compgen.controllers.fanuc.sample import PointGrid, Sample, check_increments, take_sample
from compgen.controllers.fanuc.style import FanucStyle
from compgen.controllers.grids import take_loss_mm
from compgen.core import tomlio
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM

#: Smallest step of the interval (parameter 3624) when it is written with a decimal point.
INTERVAL_QUANTUM_MM = Decimal("0.001")


@dataclass(frozen=True)
class PitchSettings:
    """Settings of stored pitch error compensation.

    Parameters
    ----------
    detection_unit_um, magnifications : one count of the table of X, Y, Z is their product (parameter 3623 is the second,
        that of the sample if the machine file does not state it).
    stores : whether the control's numbers are the correction (added to the command) or the error.
    value_type : ``incremental`` (a value is the change over its section) or ``total`` (the sum up to its point).
    interpolation : what the control does inside a section; ``staircase`` puts the whole value out at its beginning.
    interval_mm : section length per axis, None: chosen.
    max_feed_mm_min : fastest feed; the section must be at least feed / 7500 long. None: not checked.
    loss_mm : loss by interpolation between section ends that is worth no shorter sections.
    increment_limit : largest magnitude of the change over a section, in counts.
    first_number, last_number : compensation point numbers that may be used. Number 0 is left out by default: axes
        without a table have 3620 ... 3622 = 0 and would take part in its value.
    first_numbers : first number of the block of each axis, None: assigned.
    reserved : blocks (first, last) of other axes, which are left free.
    bidirectional : a table for each direction of travel (3605#0 = 1).
    negative_first_number, negative_last_number : point numbers of the tables for travel in negative direction.
    reference_return : direction of the reference return of X, Y, Z, +1 or -1.
    axis_numbers : controlled axis numbers of X, Y, Z.
    kept : compensation points of X, Y, Z that the sample shows and that are kept; None: there are none, or the machine
        file states others.
    sample : what files of the user's control show.
    """

    detection_unit_um: float
    magnifications: tuple[int, int, int]
    stores: Literal["correction", "error"]
    value_type: Literal["incremental", "total"]
    interpolation: Literal["linear", "staircase"]
    interval_mm: tuple[float | None, float | None, float | None]
    max_feed_mm_min: float | None
    loss_mm: float
    increment_limit: int
    first_number: int
    last_number: int
    first_numbers: tuple[int | None, int | None, int | None]
    reserved: tuple[tuple[int, int], ...]
    bidirectional: bool
    negative_first_number: int
    negative_last_number: int
    reference_return: tuple[int, int, int]
    axis_numbers: tuple[int, int, int]
    kept: tuple[PointGrid | None, PointGrid | None, PointGrid | None] = (None, None, None)
    sample: Sample = field(default_factory=Sample, compare=False)

    @property
    def style(self) -> FanucStyle:
        """How the file is written."""
        return self.sample.style

    @property
    def style_notes(self) -> tuple[str, ...]:
        """What a sample of the user's control told of the style."""
        return self.sample.notes

    @property
    def interval_unit_mm(self) -> float:
        """Unit of 3624 without a decimal point."""
        return self.sample.interval_unit_mm

    @property
    def number_base(self) -> int:
        """Record number of compensation point 0."""
        return self.style.number_base

    @property
    def sign(self) -> int:
        """+1 if the numbers are the correction, -1 if they are the error."""
        return 1 if self.stores == "correction" else -1

    @property
    def total(self) -> bool:
        """Whether a value is the sum up to its point."""
        return self.value_type == "total"

    def count_mm(self, axis: int) -> float:
        """One count of the table that is written for an axis 0..2, mm."""
        return self.magnifications[axis] * self.detection_unit_um * MM_PER_UM

    @property
    def interval_quantum_mm(self) -> Decimal:
        """Step of the interval as it is written, mm."""
        if not self.style.real_point:
            return Decimal(repr(self.interval_unit_mm))
        return max(INTERVAL_QUANTUM_MM, Decimal(1).scaleb(-(self.style.decimals or 3)))

    @property
    def least_interval_mm(self) -> float:
        """Shortest section at the fastest feed, mm (0 if the feed is not given)."""
        return 0.0 if self.max_feed_mm_min is None else self.max_feed_mm_min / 7500.0


def read_pitch_settings(machine: Machine) -> PitchSettings:
    """Read and check ``[controllers.fanuc-pitch]``; every key has a default but ``interval_unit_mm`` (see there)."""
    section = machine.controller_settings("fanuc-pitch")
    sample = take_sample(section)
    numbers = _per_axis(section.section("axis_numbers", required=False), tomlio.whole(1, 99), (1, 2, 3))
    intervals = _per_axis(section.section("interval_mm", required=False), tomlio.positive, (None, None, None))
    firsts = _per_axis(section.section("first_numbers", required=False), tomlio.whole(0, 9999), (None, None, None))
    magnification = section.take("magnification", tomlio.whole(1, 100), None)
    settings = PitchSettings(
        detection_unit_um=section.take("detection_unit_um", tomlio.positive, 1.0),
        magnifications=_magnifications(sample, numbers, magnification),
        stores=_word(section, "stores", "correction", "error"),
        value_type=_word(section, "value_type", "incremental", "total"),
        interpolation=_word(section, "interpolation", "linear", "staircase"),
        interval_mm=intervals,
        max_feed_mm_min=section.take("max_feed_mm_min", tomlio.positive, None),
        increment_limit=section.take("increment_limit", tomlio.whole(1, 127), 7),
        loss_mm=take_loss_mm(section),
        first_number=section.take("first_number", tomlio.whole(0, 9999), 1),
        last_number=section.take("last_number", tomlio.whole(0, 9999), max(1023, _last_of(sample))),
        first_numbers=firsts,
        reserved=section.take("reserved_numbers", _spans, ()),
        bidirectional=section.take("bidirectional", tomlio.flag, False),
        negative_first_number=section.take("negative_first_number", tomlio.whole(0, 9999), 3000),
        negative_last_number=section.take("negative_last_number", tomlio.whole(0, 9999), 4023),
        reference_return=_per_axis(section.section("reference_return", required=False), _direction, (1, 1, 1)),
        axis_numbers=numbers,
        kept=_kept(sample, numbers, intervals, firsts),
        sample=sample,
    )
    _check_together(section, settings)
    section.finish()
    return settings


def _magnifications(sample: Sample, numbers: tuple[int, ...], stated: int | None) -> tuple[int, int, int]:
    """Magnification of X, Y, Z: that of the machine file, else that of the sample where it has one, else 1."""
    found = [sample.axes[n].magnification if n in sample.axes else 0 for n in numbers]
    x, y, z = (stated or own or 1 for own in found)
    return x, y, z


def _last_of(sample: Sample) -> int:
    """Last compensation point of a sample that holds all of them, from 0 on without a gap; else 0."""
    return max(sample.values, default=0) if sorted(sample.values) == list(range(len(sample.values))) else 0


def _kept(sample: Sample, numbers: tuple[int, ...], intervals: Any, firsts: Any) -> Any:
    """Compensation points of X, Y, Z in the sample, where the machine file does not state another interval or number."""
    found: list[PointGrid | None] = []
    for number, interval_mm, first in zip(numbers, intervals, firsts, strict=True):
        axis = sample.axes.get(number)
        grid = None if axis is None or not axis.grid.interval_mm or axis.grid.first == axis.grid.last else axis.grid
        if grid is not None and interval_mm is not None and Decimal(repr(interval_mm)) != grid.interval_mm:
            grid = None
        if grid is not None and first not in (None, grid.first):
            grid = None
        if grid is not None and axis is not None and not grid.first - 1 <= grid.reference <= grid.last:
            raise axis.record.fail(
                f"axis A{number} has the reference point {grid.reference} (3620) and the points {grid.first} to {grid.last}; "
                "these points cannot be kept: state first_numbers and interval_mm in the machine file for new ones"
            )
        found.append(grid)
    return tuple(found)


def _word(section: tomlio.Section, key: str, default: str, other: str) -> Any:
    return section.take(key, tomlio.choice(default, other), default)


def _per_axis(section: tomlio.Section, check: Callable[[Any], Any], default: tuple[Any, Any, Any]) -> Any:
    values = tuple(section.take(axis, check, value) for axis, value in zip(AXES, default, strict=True))
    section.finish()
    return values


def _direction(value: Any) -> int:
    """Direction of a reference return."""
    return {"positive": 1, "negative": -1}[tomlio.choice("positive", "negative")(value)]


def _spans(value: Any) -> tuple[tuple[int, int], ...]:
    """A list of blocks of numbers."""
    if not isinstance(value, list):
        raise ValueError("a list of blocks of numbers [[first, last], ...] is expected")
    whole, found = tomlio.whole(0, 9999), []
    for item in value:
        if not isinstance(item, list) or len(item) != 2 or whole(item[0]) > whole(item[1]):
            raise ValueError("blocks of numbers [first, last], the lower one first, are expected")
        found.append((item[0], item[1]))
    return tuple(found)


def _check_together(section: tomlio.Section, settings: PitchSettings) -> None:
    if settings.last_number < settings.first_number:
        raise section.fail("last_number", f"lies below first_number = {settings.first_number}")
    _check_bidirectional(section, settings)
    if not settings.total:
        check_increments(settings.sample.common)
    if settings.number_base < 10000 and not settings.style.q_word:
        raise section.fail(
            "number_base",
            f"{settings.number_base} makes pitch data look like parameters; 10000 or more, or q_word = true, is needed",
        )
    if len(set(settings.axis_numbers)) < 3:
        raise section.fail("axis_numbers", f"{settings.axis_numbers} gives two axes the same number")
    for axis, interval_mm in zip(AXES, settings.interval_mm, strict=True):
        if interval_mm is not None and Decimal(repr(interval_mm)) % settings.interval_quantum_mm:
            message = (
                f"{axis} = {interval_mm:g} mm cannot be written; multiples of {settings.interval_quantum_mm} mm can"
            )
            raise section.fail("interval_mm", message)


def _check_bidirectional(section: tomlio.Section, settings: PitchSettings) -> None:
    """Refuse what no public document settles: 3627 with total values, and with a magnification."""
    if not settings.bidirectional:
        for letter, number in zip(AXES, settings.axis_numbers, strict=True):
            if (settings.sample.bits(3605, number) or "0").endswith("1"):
                raise settings.sample.parameters[3605, number][1].fail(
                    f"bit 0 is 1 for {letter} (A{number}): this control has a table for each direction of travel. Set "
                    "bidirectional = true in [controllers.fanuc-pitch], or set the bit to 0 and punch the file again"
                )
        return
    if settings.total:
        raise section.fail("value_type", "how 3627 counts beside total values is not documented; use 'incremental'")
    if settings.magnifications != (1, 1, 1):
        raise section.fail(
            "magnification",
            "whether 3627 is multiplied by it is not documented; with bidirectional = true it must be 1 (a larger "
            "increment_limit or shorter sections hold steep curves)",
        )
    if settings.negative_last_number < settings.negative_first_number:
        raise section.fail("negative_last_number", f"lies below {settings.negative_first_number}")
