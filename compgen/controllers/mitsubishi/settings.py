"""Settings of ``[controllers.mitsubishi]``: what the control counts in, section lengths, numbers that are free."""

from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from compgen.controllers.grids import take_loss_mm
from compgen.core import tomlio
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM

#: Smallest step of the division interval.
INTERVAL_QUANTUM_MM = Decimal("0.001")
#: Numbers of the compensation values, and how many sets of parameters there are before them.
FIRST_NUMBER, LAST_NUMBER, SETS = 4101, 5124, 10
#: Values per division point (E68 manual p. II-292, C64 manual 9.2).
LOWEST_VALUE, HIGHEST_VALUE = -128, 127


@dataclass(frozen=True)
class MitsubishiSettings:
    """Settings of machine error compensation.

    Parameters
    ----------
    setting_unit_um : setting unit of the control; one count of the table is half of it, times ``scale``.
    scale : compensation scale factor (parameter sc) of every set.
    adds : True if the control adds the numbers (corrections), False if it subtracts them.
    relative : whether one axis may be corrected as a function of another (straightness, squareness).
    interval_mm : division interval per base axis, None: chosen.
    loss_mm : loss by interpolation between division points that is worth no shorter interval.
    first_number, last_number : numbers of values that may be used.
    first_set : first set of parameters that may be used, 1 to 10.
    axis_names : names of X, Y, Z on the control.
    """

    setting_unit_um: float
    scale: int
    adds: bool
    relative: bool
    interval_mm: tuple[float | None, float | None, float | None]
    loss_mm: float
    first_number: int
    last_number: int
    first_set: int
    axis_names: tuple[str, str, str]

    @property
    def sign(self) -> int:
        """+1 if the numbers are the correction, -1 if they are the error."""
        return 1 if self.adds else -1

    @property
    def half_unit_mm(self) -> float:
        """One unit of output: half of the setting unit, mm."""
        return 0.5 * self.setting_unit_um * MM_PER_UM

    @property
    def count_mm(self) -> float:
        """One count of a written table, mm."""
        return self.half_unit_mm * self.scale

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """(output, base axis) of the tables: positioning of the three axes first."""
        own = [(axis, axis) for axis in range(3)]
        across = [(output, base) for base in range(3) for output in range(3) if output != base]
        return own + across if self.relative else own


def read_mitsubishi_settings(machine: Machine) -> MitsubishiSettings:
    """Read and check ``[controllers.mitsubishi]``; every key has a default."""
    section = machine.controller_settings("mitsubishi")
    settings = MitsubishiSettings(
        setting_unit_um=section.take("setting_unit_um", tomlio.positive, 1.0),
        scale=section.take("scale", tomlio.whole(1, 99), 1),
        adds=section.take("stores", tomlio.choice("correction", "error"), "correction") == "correction",
        relative=section.take("relative_errors", tomlio.flag, True),
        interval_mm=_intervals(section),
        loss_mm=take_loss_mm(section),
        first_number=section.take("first_number", tomlio.whole(FIRST_NUMBER, LAST_NUMBER), FIRST_NUMBER),
        last_number=section.take("last_number", tomlio.whole(FIRST_NUMBER, LAST_NUMBER), LAST_NUMBER),
        first_set=section.take("first_set", tomlio.whole(1, SETS), 1),
        axis_names=_names(section),
    )
    if settings.last_number - settings.first_number + 1 < 3 * len(settings.pairs):
        raise section.fail("last_number", f"leaves too few numbers from {settings.first_number} on")
    if settings.first_set + len(settings.pairs) - 1 > SETS:
        raise section.fail(
            "first_set",
            f"{len(settings.pairs)} sets from {settings.first_set} on go beyond the {SETS} sets of the control; "
            "relative_errors = false needs 3",
        )
    section.finish()
    return settings


def _intervals(section: tomlio.Section) -> tuple[float | None, float | None, float | None]:
    part = section.section("interval_mm", required=False)
    x, y, z = (part.take(letter, _interval, None) for letter in AXES)
    part.finish()
    return x, y, z


def _interval(value: Any) -> float:
    if Decimal(repr(tomlio.positive(value))) % INTERVAL_QUANTUM_MM:
        raise ValueError(f"a multiple of {INTERVAL_QUANTUM_MM} mm is expected")
    return float(value)


def _names(section: tomlio.Section) -> tuple[str, str, str]:
    part = section.section("axis_names", required=False)
    x, y, z = (part.take(letter, _name, letter) for letter in AXES)
    part.finish()
    if len({x, y, z}) < 3:
        raise section.fail("axis_names", f"{x}, {y}, {z}: three different names are due")
    return x, y, z


def _name(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9]{0,3}", value, re.ASCII):
        raise ValueError("a name of at most four letters and digits is expected")
    return value
