"""Settings of ``[controllers.fanuc-pitch]``: what the control counts in, how its files look, which numbers are free."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from typing import Any, Literal

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
    detection_unit_um, magnification : one count of the table is their product (parameter 3623 is the second).
    stores : whether the control's numbers are the correction (added to the command) or the error.
    value_type : ``incremental`` (a value is the change over its section) or ``total`` (the sum up to its point).
    interpolation : what the control does inside a section; ``staircase`` puts the whole value out at its beginning.
    interval_mm : section length per axis, None: chosen.
    max_feed_mm_min : fastest feed; the section must be at least feed / 7500 long. None: not checked.
    loss_mm : loss by interpolation between section ends that is worth no shorter sections.
    increment_limit : largest magnitude of the change over a section, in counts.
    first_number, last_number : compensation point numbers that may be used. Number 0 is left out by default: axes
        without a table have 3620 ... 3622 = 0 and would take part in its value.
    q_word, digits, real_point, number_base, crlf : style of the file.
    interval_unit_mm : unit of 3624 without a decimal point.
    axis_numbers : controlled axis numbers of X, Y, Z.
    """

    detection_unit_um: float
    magnification: int
    stores: Literal["correction", "error"]
    value_type: Literal["incremental", "total"]
    interpolation: Literal["linear", "staircase"]
    interval_mm: tuple[float | None, float | None, float | None]
    max_feed_mm_min: float | None
    loss_mm: float
    increment_limit: int
    first_number: int
    last_number: int
    q_word: bool
    digits: int
    real_point: bool
    number_base: int
    crlf: bool
    interval_unit_mm: float
    axis_numbers: tuple[int, int, int]

    @property
    def sign(self) -> int:
        """+1 if the numbers are the correction, -1 if they are the error."""
        return 1 if self.stores == "correction" else -1

    @property
    def total(self) -> bool:
        """Whether a value is the sum up to its point."""
        return self.value_type == "total"

    @property
    def count_mm(self) -> float:
        """One count of the table that is written, mm."""
        return self.magnification * self.detection_unit_um * MM_PER_UM

    @property
    def interval_quantum_mm(self) -> Decimal:
        """Step of the interval as it is written, mm."""
        return INTERVAL_QUANTUM_MM if self.real_point else Decimal(repr(self.interval_unit_mm))

    @property
    def least_interval_mm(self) -> float:
        """Shortest section at the fastest feed, mm (0 if the feed is not given)."""
        return 0.0 if self.max_feed_mm_min is None else self.max_feed_mm_min / 7500.0


def read_pitch_settings(machine: Machine) -> PitchSettings:
    """Read and check ``[controllers.fanuc-pitch]``; every key has a default but ``interval_unit_mm`` (see there)."""
    section = machine.controller_settings("fanuc-pitch")
    real_point = section.take("real_point", tomlio.flag, True)
    settings = PitchSettings(
        detection_unit_um=section.take("detection_unit_um", tomlio.positive, 1.0),
        magnification=section.take("magnification", tomlio.whole(1, 100), 1),
        stores=_word(section, "stores", "correction", "error"),
        value_type=_word(section, "value_type", "incremental", "total"),
        interpolation=_word(section, "interpolation", "linear", "staircase"),
        interval_mm=_per_axis(section.section("interval_mm", required=False), tomlio.positive, (None, None, None)),
        max_feed_mm_min=section.take("max_feed_mm_min", tomlio.positive, None),
        increment_limit=section.take("increment_limit", tomlio.whole(1, 127), 7),
        loss_mm=take_loss_mm(section),
        first_number=section.take("first_number", tomlio.whole(0, 9999), 1),
        last_number=section.take("last_number", tomlio.whole(0, 9999), 1023),
        q_word=section.take("q_word", tomlio.flag, False),
        digits=section.take("digits", tomlio.whole(1, 8), 5),
        real_point=real_point,
        number_base=section.take("number_base", tomlio.whole(0, 90000), 10000),
        crlf=section.take("eol", tomlio.choice("lf", "crlf"), "lf") == "crlf",
        interval_unit_mm=_interval_unit(section, real_point),
        axis_numbers=_per_axis(section.section("axis_numbers", required=False), tomlio.whole(1, 99), (1, 2, 3)),
    )
    _check_together(section, settings)
    section.finish()
    return settings


def _word(section: tomlio.Section, key: str, default: str, other: str) -> Any:
    return section.take(key, tomlio.choice(default, other), default)


def _per_axis(section: tomlio.Section, check: Callable[[Any], Any], default: tuple[Any, Any, Any]) -> Any:
    values = tuple(section.take(axis, check, value) for axis, value in zip(AXES, default, strict=True))
    section.finish()
    return values


def _interval_unit(section: tomlio.Section, real_point: bool) -> float:
    if not real_point and "interval_unit_mm" not in section:
        raise section.fail(
            "interval_unit_mm",
            "is missing; with real_point = false parameter 3624 is a whole number whose unit depends on the control "
            "(1.0 or 0.001 mm are common): read 3624 of a known axis and give the unit in mm",
        )
    return section.take("interval_unit_mm", tomlio.positive, 1.0)


def _check_together(section: tomlio.Section, settings: PitchSettings) -> None:
    if settings.last_number < settings.first_number:
        raise section.fail("last_number", f"lies below first_number = {settings.first_number}")
    if settings.number_base < 10000 and not settings.q_word:
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
